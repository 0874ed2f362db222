"""Writing scenes: built beside their destination, moved into place when complete."""

from __future__ import annotations

import hashlib
import os
import shutil
import threading
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.processes import process_alive
from mudg.base.run_folder import all_names
from mudg.base.types import Camera, EgoPath, Frame, Matrix, Photo, Ref, Scene, Source, Sweep, SweepPoints, Track, View
from mudg.scene import schema
from mudg.scene.labels import encode_label, encode_png, encode_safetensors, label_ref, read_label
from mudg.scene.read import check_image, checked_points, is_grey, open_files, read_points, read_scene

_MAX_PENDING_WRITES: Final = 8


class SceneWriter:
    """Writes a scene; use it as a context manager so that a failure leaves nothing behind. Images and labels are
    encoded and written by two threads while the caller goes on; ``add_*`` may be called from several threads. Frames
    and sweeps are stored in the order of their times. ``root``: destination directory; it must not hold a scene yet.
    Other files there (a run's bookkeeping) are left alone. ``source``: where the log comes from and under which
    licence. Example::

        with SceneWriter(root, "city-7", source) as writer:
            writer.add_camera(camera)
            writer.add_frame("front/000000", view, rgb, labels={"depth": depth, "semantics": ids})
            writer.add_sweep("lidar/000000", "lidar", time_s, world_from_lidar, points)
            writer.set_ego(ego)
            scene = writer.finish()
    """

    def __init__(self, root: Path | str, scene_id: str, source: Source) -> None:
        self.root = Path(root)
        self._scene_id, self._source = scene_id, source
        if (self.root / "scene.json").exists():
            remedy = "choose another folder or remove it"
            raise InputError("there is a scene here already", where=str(self.root), remedy=remedy)
        self._partial = _partial_folder(self.root)
        with store.disk_errors("cannot create the scene's folder", self.root):
            self._partial.mkdir(parents=True)
        self._cameras: dict[str, Camera] = {}
        self._frames: dict[str, Frame] = {}
        self._sweeps: dict[str, Sweep] = {}
        self._tracks: dict[str, Track] = {}
        self._ego: EgoPath | None = None
        self._split: dict[str, Literal["train", "test"]] = {}
        self._hashes: dict[str, dict[str, Any]] = {}
        self._grey: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(max_workers=2, thread_name_prefix="scene-writer")
        self._pending: deque[Future[None]] = deque()
        self._finished = False

    def __enter__(self) -> SceneWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if not self._finished:
            self.discard()

    def discard(self) -> None:
        """Give up: nothing of the scene stays on disk."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        shutil.rmtree(self._partial, ignore_errors=True)
        self._finished = True

    def add_camera(self, camera: Camera) -> None:
        """Add a camera; frames may use it from then on."""
        schema.parse_camera(camera.name, schema.camera_to_json(camera), f"SceneWriter: camera {camera.name}")
        if self._cameras.setdefault(camera.name, camera) != camera:
            raise InputError("two cameras have one name", where=f"SceneWriter: camera {camera.name}")

    def add_frame(
        self,
        frame_id: str,
        view: View,
        image: NDArray[np.uint8] | Path | bytes,
        labels: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        """Add one image. ``frame_id``: ``<camera>/<digits>``, e.g. ``front/000012``. ``view``: its camera (equal to the
        one added) and pose. ``image``: u8[H, W, 3] RGB; or the path or the bytes of a PNG or JPEG file, kept as they
        are after a check that they can be decoded. Grey ones are counted in the scene's notes. ``labels``: see
        ``add_label``."""
        where = f"SceneWriter: frame {frame_id}"
        if not isinstance(image, np.ndarray):
            content = image if isinstance(image, bytes) else store.read_bytes(image)
            grey = check_image(content, where if isinstance(image, bytes) else str(image), view.camera)
            self._add_image_file(frame_id, view, content, grey)
        else:
            size = (view.camera.height, view.camera.width, 3)
            if image.dtype != np.uint8 or image.shape != size:
                expected, got = f"uint8 {size}", f"{image.dtype} {image.shape}"
                raise InputError("image array has the wrong form", where=where, got=got, expected=expected)
            pixels = np.ascontiguousarray(image)
            self._submit(self._add_frame(frame_id, view, "png"), lambda: encode_png(pixels))
        for name, array in (labels or {}).items():
            self.add_label(frame_id, name, array)

    def _add_image_file(self, frame_id: str, view: View, content: bytes, grey: bool) -> None:
        ref = self._add_frame(frame_id, view, "png" if content[:4] == b"\x89PNG" else "jpg")
        with self._lock:
            self._grey[view.camera.name] += grey
        self._submit(ref, lambda: content)

    def _add_frame(self, frame_id: str, view: View, suffix: str) -> str:
        """Record a frame; returns where its image goes."""
        where, camera = f"SceneWriter: frame {frame_id}", self._cameras.get(view.camera.name)
        if camera is None or camera != view.camera:
            what, expected = "frame uses a camera that was not added like this", ", ".join(self._cameras)
            raise InputError(what, where=where, got=view.camera.name, expected=expected or "add_camera first")
        schema.check_frame_id(frame_id, camera.name, where)
        ref = f"images/{frame_id}.{suffix}"
        with self._lock:
            if frame_id in self._frames:
                raise InputError("frame was added twice", where=where)
            self._frames[frame_id] = Frame(frame_id, view, Ref(ref), {})
        return ref

    def add_label(self, frame_id: str, name: str, array: NDArray[Any]) -> None:
        """Add a label [H, W] to a frame; names, types and meaning as in ``read_label``."""
        where = f"SceneWriter: frame {frame_id}"
        with self._lock:
            frame = self._frames.get(frame_id)
        if frame is None:
            raise InputError("label for a frame that was not added", where=where, got=name)
        self._add_label_file(frame_id, name, encode_label(name, array, frame.view.camera, where))

    def _add_label_file(self, frame_id: str, name: str, content: bytes) -> None:
        ref = label_ref(name, frame_id)
        with self._lock:
            frame = self._frames[frame_id]
            self._frames[frame_id] = replace(frame, labels={**frame.labels, name: Ref(ref)})
        self._submit(ref, lambda: content)

    def add_sweep(
        self, sweep_id: str, sensor: str, time_s: float, world_from_lidar: NDArray[np.float64], points: SweepPoints
    ) -> None:
        """Add a LiDAR sweep: points in the LiDAR frame at ``time_s``, with classes if they have any. Ids are
        ``<sensor>/<digits>``."""
        sweep = Sweep(sweep_id, sensor, time_s, world_from_lidar, _sweep_ref(sweep_id))
        arrays: dict[str, NDArray[Any]] = {"xyz": points.xyz, "intensity": points.intensity, "dt_s": points.dt_s}
        if points.classes is not None:
            arrays["classes"] = points.classes
        checked_points(arrays, f"SceneWriter: sweep {sweep_id}")
        self._add_sweep_file(sweep, encode_safetensors(arrays))

    def _add_sweep_file(self, sweep: Sweep, content: bytes) -> None:
        where = f"SceneWriter: sweep {sweep.id}"
        schema.check_name(sweep.sensor, where)
        schema.check_frame_id(sweep.id, sweep.sensor, where)
        with self._lock:
            if sweep.id in self._sweeps:
                raise InputError("sweep was added twice", where=where)
            self._sweeps[sweep.id] = sweep
        self._submit(sweep.points.path, lambda: content)

    def copy_frame(self, scene: Scene, frame: Frame, labels: Mapping[str, NDArray[Any]] | None = None) -> None:
        """Add a frame of another scene with its image and its labels; ``labels`` (name -> array) fill in what it lacks.
        Files that the other scene's manifest proves to be as they were written are copied byte for byte; others are
        checked and labels encoded anew."""
        files, camera = open_files(scene.root), frame.view.camera
        where, content = f"{scene.root}: {frame.image.path}", files.read(frame.image.path)
        check = is_grey if files.is_hashed(frame.image.path) else check_image
        self._add_image_file(frame.id, frame.view, content, check(content, where, camera))
        given = labels or {}
        for name in dict.fromkeys((*schema.LABEL_NAMES, *given)):  # in one order, whatever that of ``labels``
            if name not in given and name not in frame.labels:
                continue
            ref = frame.labels.get(name)
            if ref is not None and ref.path == label_ref(name, frame.id) and files.is_hashed(ref.path):
                self._add_label_file(frame.id, name, files.read(ref.path))
            else:
                array = given[name] if ref is None else read_label(scene, frame, name)
                self.add_label(frame.id, name, array)

    def copy_all_but_frames(self, scene: Scene, point_classes: bool = True) -> None:
        """Add everything of another scene but its frames: cameras, sweeps (as in ``copy_frame``), tracks, ego path,
        split. ``point_classes``: whether the classes of LiDAR points are kept."""
        files = open_files(scene.root)
        for camera in scene.cameras.values():
            self.add_camera(camera)
        for sweep in log.progress(scene.sweeps, len(scene.sweeps), "copying sweeps"):
            points = None if point_classes else read_points(scene, sweep)
            if points is not None and points.classes is not None:
                points = replace(points, classes=None)
            elif sweep.points == _sweep_ref(sweep.id) and files.is_hashed(sweep.points.path):
                self._add_sweep_file(sweep, files.read(sweep.points.path))
                continue
            points = read_points(scene, sweep) if points is None else points
            self.add_sweep(sweep.id, sweep.sensor, sweep.time_s, sweep.world_from_lidar, points)
        for track in scene.tracks:
            self.add_track(track)
        self.set_ego(scene.ego)
        self.set_split(scene.split)

    def add_track(self, track: Track) -> None:
        """Add a tracked box."""
        if track.id in self._tracks:
            raise InputError("track was added twice", where=f"SceneWriter: track {track.id}")
        self._tracks[track.id] = track

    def set_ego(self, ego: EgoPath) -> None:
        """Set the path of the vehicle."""
        self._ego = ego

    def add_notes(self, notes: Iterable[str]) -> None:
        """Add sentences to the source's notes: what was learnt while the log was read."""
        self._source = replace(self._source, notes=(*self._source.notes, *notes))

    def set_split(self, split: Mapping[str, Literal["train", "test"]]) -> None:
        """Set which frames are held out: frame id -> ``train`` or ``test``. Frames not named are for training."""
        self._split = dict(split)

    def finish(self) -> Scene:
        """Check relations, write the index, read it back, and move the scene into place."""
        for future in self._pending:
            future.result()
        self._pool.shutdown(wait=True)
        where = f"SceneWriter: {self.root}"
        if self._ego is None:
            raise InputError("ego path was not set", where=where, remedy="call set_ego")
        grey = [f"{count} images of camera {name} are grey" for name, count in self._grey.items() if count]
        self.add_notes(note for note in grey if note not in self._source.notes)
        order = {name: index for index, name in enumerate(self._cameras)}
        frames = sorted(self._frames.values(), key=lambda f: (f.view.time_s, order[f.view.camera.name]))
        sweeps = sorted(self._sweeps.values(), key=lambda s: (s.time_s, s.sensor))
        split: dict[str, Literal["train", "test"]] = {**dict.fromkeys((f.id for f in frames), "train"), **self._split}
        records = (self._cameras, tuple(frames), tuple(sweeps), tuple(self._tracks.values()))
        scene = Scene(self._scene_id, str(self.root), *records, self._ego, split, self._source)
        schema.check_relations(scene, where)
        self._write("tracks.json", schema.tracks_to_json_text(scene.tracks).encode())
        self._write("scene.json", schema.scene_to_json_text(scene).encode())
        store.write_json(self._partial / store.MANIFEST, {"schema": 1, "files": dict(sorted(self._hashes.items()))})
        store.sync_tree(self._partial)
        checked = read_scene(self._partial)  # nothing that cannot be read back is moved into place
        self._move_into_place()
        self._finished = True
        return replace(checked, root=str(self.root.absolute()))

    def _move_into_place(self) -> None:
        with store.disk_errors("scene cannot be moved into place", self.root, ""):
            if not self.root.exists():
                self._partial.rename(self.root)
                return
            entries = sorted(self._partial.iterdir(), key=lambda entry: entry.name == "scene.json")
            for entry in entries:  # scene.json last: without it the folder is no scene
                if (self.root / entry.name).is_dir():  # file by file: what else lies there stays
                    for name in all_names(entry):
                        (self.root / entry.name / name).parent.mkdir(parents=True, exist_ok=True)
                        (entry / name).replace(self.root / entry.name / name)
                else:
                    entry.replace(self.root / entry.name)
            shutil.rmtree(self._partial)

    def _submit(self, ref: str, encode: Callable[[], bytes]) -> None:
        with self._lock:
            self._pending.append(self._pool.submit(lambda: self._write(ref, encode())))
            waited_for = self._pending.popleft() if len(self._pending) > _MAX_PENDING_WRITES else None
        if waited_for is not None:
            waited_for.result()

    def _write(self, ref: str, content: bytes) -> None:
        store.write_in_tree(self._partial / ref, content)
        with self._lock:
            self._hashes[ref] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _partial_folder(root: Path) -> Path:
    """Where to build a scene: inside its folder where that exists (a run's folder, a mounted one), else beside it. What
    killed writers left there is removed."""
    root = root.absolute()
    parent, prefix = (root, ".scene.") if root.is_dir() else (root.parent, f".{root.name}.")
    for stale in parent.iterdir() if parent.is_dir() else ():
        if stale.name.startswith(prefix) and stale.name.endswith(".part") and stale.is_dir():
            pid = stale.name.removeprefix(prefix).split("-")[0]
            if pid.isdigit() and not process_alive(int(pid)):
                shutil.rmtree(stale, ignore_errors=True)
    return parent / f"{prefix}{os.getpid()}-{threading.get_ident()}.part"


def _sweep_ref(sweep_id: str) -> Ref:
    return Ref(f"lidar/{sweep_id}.safetensors")


# some photographs, for short fits to a part of a log, or to pictures that nobody took ---------------------------------

PlacedSweep = tuple[str, float, Matrix, SweepPoints]
"""Sensor, time in seconds, world_from_lidar f64[4,4], points."""


def write_photos(
    folder: Path,
    source: Source,
    ego: EgoPath,
    tracks: Sequence[Track],
    photos: Sequence[Photo],
    sweeps: Iterable[PlacedSweep],
) -> None:
    """Write a scene of some photographs, with their classes where they have any, all of them for training. Frames and
    sweeps are numbered per camera and sensor in the order given. Photographs of one camera have one size."""
    counts: dict[str, int] = {}

    def numbered(name: str) -> str:
        counts[name] = counts.get(name, -1) + 1
        return f"{name}/{counts[name]:06d}"

    with SceneWriter(folder, "photographs", source) as writer:
        writer.set_ego(ego)
        for track in tracks:
            writer.add_track(track)
        for photo in photos:
            writer.add_camera(photo.view.camera)
            labels = {} if photo.semantics is None else {"semantics": photo.semantics}
            writer.add_frame(numbered(photo.view.camera.name), photo.view, photo.rgb, labels)
        for sensor, time_s, world_from_lidar, points in sweeps:
            writer.add_sweep(numbered(sensor), sensor, time_s, world_from_lidar, points)
        writer.finish()


# a part of a scene, for measurements on held-out frames ---------------------------------------------------------------
# What is held out is not in the files: an image is replaced by a black one, labels and sweeps are left out, and so are
# the classes of LiDAR points, which are truth that is scored, and the recipe by which a generated city could be drawn
# again. Whatever reads the part cannot have seen more.


def write_part(
    scene: Scene,
    root: Path,
    frames: Collection[str],
    sweeps: Collection[str],
    places: Sequence[Frame] = (),
    held_out: Collection[str] = (),
) -> Scene:
    """Write some frames and sweeps of a scene, with all tracks and the whole ego path, without classes of points; byte
    by byte where its manifest allows. ``frames``, ``sweeps``: ids of what is shown; these frames are for training, but
    for those of ``held_out``, which are for scoring. ``places``: frames of which camera, pose and time are told, with a
    black image; they are held out. They may belong to a larger scene of the same log."""
    shown = [frame for frame in scene.frames if frame.id in frames]
    cameras = {frame.view.camera.name: frame.view.camera for frame in (*shown, *places)}
    ordered = {name: cameras[name] for name in dict.fromkeys((*scene.cameras, *cameras)) if name in cameras}
    kept = tuple(sweep for sweep in scene.sweeps if sweep.id in sweeps)
    base = replace(scene, cameras=ordered, split={}, sweeps=kept)
    with SceneWriter(root, scene.id, replace(scene.source, recipe=None)) as writer:
        writer.copy_all_but_frames(base, point_classes=False)
        for frame in shown:
            writer.copy_frame(scene, frame)
        for frame in places:
            camera = frame.view.camera
            writer.add_frame(frame.id, frame.view, np.zeros((camera.height, camera.width, 3), np.uint8))
        writer.set_split(dict.fromkeys((*(frame.id for frame in places), *held_out), "test"))
        return writer.finish()
