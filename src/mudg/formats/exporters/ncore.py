"""A driving log as an NCore recording (version 4), written with NVIDIA's package: NAME.ncore4.zarr.itar and
NAME.ncore4.json. Conventions: docs/reference/formats.md. Sweeps, which the scene holds as seen at one moment, are
taken apart again into rays in the sensor's frame at their own times."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from mudg.base import log, store
from mudg.base.errors import InputError, ResourceError
from mudg.base.geometry import from_rotation_translation, invert
from mudg.base.types import Camera, Frame, Scene, Sweep, Track
from mudg.base.versions import version
from mudg.formats.exporters.messages import LogRecords, picture_format
from mudg.scene.labels import read_label

Matrix = NDArray[np.float64]
Times = NDArray[np.int64]

RIG: Final = "rig"
WORLD: Final = "world"
INSTANCE: Final = "default"
"""Name of a component of which a recording has one: poses, intrinsics, masks, boxes."""
EGO_MASK: Final = "ego"
"""Mask of a camera that is not 0 where the recording vehicle is seen."""
MARK: Final = ".ncore4"
"""What stands in the names of the files, after the name of the recording."""
ABOUT: Final = "mudg"
"""Key of what this program notes about a recording."""
SWEEP_TIME: Final = "sweep_timestamp_us"
"""Key of the moment of a sweep, of which the format knows only begin and end."""
MICRO: Final = 1_000_000
EULER: Final = "xyz"
"""Axes about which a box is turned; small letters: fixed ones."""
FILES: Final = (f"*{MARK}.zarr.itar", f"*{MARK}.json")
"""Names of what is written."""
START_US: Final = MICRO
"""Time of the first record: readers expect times that are not negative, and shutters open before."""
FIXED_M: Final = 1e-6
"""Metres (and entries of rotations) by which the place of a fixed sensor on the vehicle may vary."""
_LONGEST_STEP_US: Final = 500_000
"""Between the boxes of one object: readers split it where it is not seen for longer."""


# --- what reading shares with writing -------------------------------------------------------------


def package() -> Any:
    """The modules of the package ``nvidia-ncore``, loaded when they are first asked for: ``data`` (types), ``v4``
    (files), ``sensors`` (projection), ``transformations``. Raises ResourceError: it is not installed."""
    try:
        import ncore.data.v4
        import ncore.impl.common.transformations
        import ncore.sensors
    except ImportError as error:
        what = "NCore files need the package nvidia-ncore, which is not installed"
        raise ResourceError(what, got=str(error), remedy="pip install 'mudg[ncore]'") from error
    transformations = ncore.impl.common.transformations
    return SimpleNamespace(data=ncore.data, v4=ncore.data.v4, sensors=ncore.sensors, transformations=transformations)


def close(reader: Any) -> None:
    """Close the files of a ``SequenceComponentGroupsReader``, for which the package has no call."""
    for group, _ in reader._component_stores.values():
        files = getattr(group.store, "store", group.store)  # below what holds the consolidated metadata
        if hasattr(files, "close"):
            files.close()


@dataclass(frozen=True, slots=True, eq=False)
class PoseKeys:
    """A frame's poses over time. ``times_us``: i64[K], increasing, at least two. poses: f64[K, 4, 4], rigid."""

    times_us: Times
    poses: Matrix

    @classmethod
    def of(cls, poses: Mapping[int, Matrix]) -> PoseKeys:
        """Poses by microsecond, in order."""
        order = sorted(poses)
        return cls(np.array(order, np.int64), np.stack([poses[at] for at in order]))

    def at(self, times_us: Times) -> Matrix:
        """Poses f64[N, 4, 4] at times i64[N] from the first to the last key."""
        turned = Slerp(self.times_us, Rotation.from_matrix(self.poses[:, :3, :3]))(times_us)
        after = np.clip(np.searchsorted(self.times_us, times_us), 1, len(self.times_us) - 1)
        span = self.times_us[after] - self.times_us[after - 1]
        share = ((times_us - self.times_us[after - 1]) / span)[:, None]
        poses = np.tile(np.eye(4), (len(times_us), 1, 1))
        poses[:, :3, :3] = turned.as_matrix()
        poses[:, :3, 3] = (1 - share) * self.poses[after - 1, :3, 3] + share * self.poses[after, :3, 3]
        return poses

    def covering(self, start_us: int, end_us: int) -> PoseKeys:
        """With keys at both ends of a span of time, where it reaches beyond: the frame goes on as it did between its
        two nearest keys, for no longer than these lie apart, and then stands."""
        keys, found = self.times_us.tolist(), dict(zip(self.times_us.tolist(), self.poses, strict=True))
        for end, near, far in ((min(start_us, keys[0]), 0, 1), (max(end_us, keys[-1]), -1, -2)):
            if end != keys[near]:
                pose = self.poses[near]
                if len(keys) > 1:
                    share = min(abs((end - keys[near]) / (keys[near] - keys[far])), 1.0)
                    here, before = (Rotation.from_matrix(self.poses[n][:3, :3]) for n in (near, far))
                    turn = Rotation.from_rotvec(share * (here * before.inv()).as_rotvec()) * here
                    place = pose[:3, 3] + share * (pose[:3, 3] - self.poses[far][:3, 3])
                    pose = from_rotation_translation(turn.as_matrix(), place)
                found[end] = pose
        return PoseKeys.of(found)


def unknown_shutter(camera: Camera) -> bool:
    """Whether a camera has a rolling shutter of which the scene does not say the direction."""
    return camera.readout_s > 0 and camera.shutter == "global"


def shutter_type(camera: Camera) -> str:
    """The package's name of a camera's shutter; downwards where the scene does not say the direction."""
    if camera.readout_s <= 0:
        return "GLOBAL"
    return f"ROLLING_{'top_to_bottom' if unknown_shutter(camera) else camera.shutter}".upper()


# --- writing --------------------------------------------------------------------------------------


def write_ncore(folder: Path, records: LogRecords) -> list[Path]:
    """Write a log into a folder, in a hidden folder there until it is complete; returns the files. Raises
    ResourceError: the package is not installed. InputError: two sweeps or pictures of one sensor begin or end at one
    microsecond."""
    made = _WrittenLog(records)
    name = re.sub(r"[^A-Za-z0-9_.-]", "_", records.scene.id).strip(".") or "log"
    with tempfile.TemporaryDirectory(prefix=".ncore.", suffix=".part", dir=folder) as work:
        found = [Path(work) / path.name for path in made.write(Path(work), name)]
        files = [folder / path.name for path in found]
        store.sync_tree(Path(work))
        for temporary, path in zip(found, files, strict=True):
            store.take_place(temporary, path)
    return files


class _WrittenLog:
    """One log on its way into a recording."""

    def __init__(self, records: LogRecords) -> None:
        self._package = package()
        self._log, self._scene = records, records.scene
        if not len(self._scene.ego.times_s):
            raise InputError("a recording needs the vehicle's path, and the scene has none", where=self._scene.id)
        self._zero_us = START_US - round(records.start_s * MICRO)
        self._frames = {name: list(self._scene.frames_of(name)) for name in self._scene.cameras}
        self._sweeps: dict[str, list[Sweep]] = {}
        for sweep in self._scene.sweeps:
            self._sweeps.setdefault(sweep.sensor, []).append(sweep)
        self._ids = sensor_ids(self._scene.cameras, self._sweeps)
        self._spans = {sweep.id: self._span(sweep) for sweep in self._scene.sweeps}
        ego = self._scene.ego
        spans = [*self._spans.values(), *(self._shutter(frame) for frame in self._scene.frames)]
        times = [time for span in spans for time in span] + [self._us(float(time)) for time in ego.times_s]
        if min(times) < 0:
            raise InputError("times of points reach more than a second before the log", where=self._scene.id)
        self._start_us, self._end_us = min(times), max(max(times), min(times) + 1)
        self._rig = self._keys(ego.times_s, lambda time_s: ego.pose_at(time_s)).covering(self._start_us, self._end_us)
        self._mounts = records.mounts(FIXED_M)
        self._paths = {sensor: self._path(sensor) for sensor in self._ids if sensor not in self._mounts}

    def write(self, folder: Path, name: str) -> list[Path]:
        """The files, in the order in which they take their place."""
        interval = self._package.transformations.HalfClosedInterval.from_start_end(self._start_us, self._end_us)
        source = self._scene.source
        origin: dict[str, Any] = {"version": version(), "dataset": source.dataset, "licence": source.licence}
        origin["clock_zero_us"] = self._zero_us
        writer = self._package.v4.SequenceComponentGroupsWriter(folder, name, self._scene.id, interval, {ABOUT: origin})

        def component(kind: str, instance: str = INSTANCE) -> Any:
            return writer.register_component_writer(getattr(self._package.v4, f"{kind}Component").Writer, instance)

        self._poses(component("Poses"))
        intrinsics, masks = component("Intrinsics"), component("Masks")
        for camera, recorded in self._scene.cameras.items():
            sensor = self._ids[f"camera/{camera}"]
            model = self._package.data.OpenCVPinholeCameraModelParameters.from_dict(intrinsics_of(recorded))
            intrinsics.store_camera_intrinsics(sensor, model)
            masks.store_camera_masks(sensor, _masks(self._scene, self._frames[camera]))
        with log.task("export", len(self._scene.frames) + len(self._scene.sweeps)) as bar:
            for camera, frames in self._frames.items():
                pictures = component("CameraSensor", self._ids[f"camera/{camera}"])
                for frame in _in_order(frames, self._shutter, camera):
                    content, kind = self._log.picture(frame), picture_format(frame)
                    pictures.store_frame(content, kind, _unsigned(self._shutter(frame)), {}, {})
                    bar.advance()
            for lidar, sweeps in self._sweeps.items():
                rays = component("LidarSensor", self._ids[f"lidar/{lidar}"])
                for sweep in _in_order(sweeps, lambda sweep: self._spans[sweep.id], lidar):
                    self._sweep(rays, sweep)
                    bar.advance()
        component("Cuboids").store_observations(list(self._boxes()))
        stores = [Path(str(path)) for path in writer.finalize()]
        about = folder / f"{name}{MARK}.json"
        reader = self._package.v4.SequenceComponentGroupsReader(stores)
        store.write_text(about, store.json_text(reader.get_sequence_meta().to_dict()) + "\n")
        close(reader)
        return [*stores, about]

    # -- times

    def _us(self, time_s: float) -> int:
        return round(time_s * MICRO) + self._zero_us

    def _shutter(self, frame: Frame) -> tuple[int, int]:
        """First and last microsecond of an image; its view is that of the middle."""
        middle, half = self._us(frame.view.time_s), round(frame.view.camera.readout_s * MICRO / 2)
        return middle - half, middle + half

    def _span(self, sweep: Sweep) -> tuple[int, int]:
        """First and last microsecond of a sweep; its own moment lies between."""
        at, dt_s = self._us(sweep.time_s), self._log.points(sweep).dt_s
        first, last = (round(float(late_s) * MICRO) for late_s in (dt_s.min(initial=0), dt_s.max(initial=0)))
        return at + first, at + last

    # -- poses

    def _keys(self, times_s: Iterable[float], pose_at: Any) -> PoseKeys:
        """Poses at whole microseconds, each once."""
        keys: dict[int, Matrix] = {}
        for time_s in map(float, times_s):
            keys.setdefault(self._us(time_s), pose_at(time_s))
        return PoseKeys.of(keys)

    def _path(self, sensor: str) -> PoseKeys:
        """The path in the world of a sensor that is not fixed; beyond its records it keeps its place on the vehicle."""
        found = {self._us(time_s): pose for name, time_s, pose in self._log.sensor_poses() if name == sensor}
        for end, near in ((self._start_us, min(found)), (self._end_us, max(found))):
            if end not in found:
                there, here = self._rig.at(np.array([end, near]))
                found[end] = there @ invert(here) @ found[near]
        return PoseKeys.of(found)

    def _poses(self, component: Any) -> None:
        component.store_dynamic_pose(RIG, WORLD, self._rig.poses, self._rig.times_us.astype(np.uint64))
        for sensor, name in self._ids.items():
            if sensor in self._mounts:
                mount = self._mounts[sensor]  # its last row must be 0 0 0 1 to the last bit
                component.store_static_pose(name, RIG, from_rotation_translation(mount[:3, :3], mount[:3, 3]))
            else:
                path = self._paths[sensor]
                component.store_dynamic_pose(name, WORLD, path.poses, path.times_us.astype(np.uint64))

    # -- sensors

    def _sweep(self, component: Any, sweep: Sweep) -> None:
        """Store the rays of a sweep."""
        points, at = self._log.points(sweep), self._us(sweep.time_s)
        times = at + np.round(points.dt_s.astype(np.float64) * MICRO).astype(np.int64)
        raw = points.xyz.astype(np.float64)  # in the sensor's frame at their own times
        moments, which = np.unique(times, return_inverse=True)
        if (moments != at).any():
            path, sensor = self._paths.get(name := f"lidar/{sweep.sensor}"), self._rig.at(moments)
            sensor = sensor @ self._mounts[name] if path is None else path.at(moments)
            moved = np.linalg.inv(sensor) @ sweep.world_from_lidar
            raw = np.einsum("nij,nj->ni", moved[which, :3, :3], raw) + moved[which, :3, 3]
        distance = np.linalg.norm(raw, axis=1)
        ray = np.where(distance[:, None] > 0, raw / np.maximum(distance, 1e-12)[:, None], [1.0, 0.0, 0.0])
        measured = distance.astype(np.float32)[None], points.intensity.clip(0, 1)[None]
        span, about = _unsigned(self._spans[sweep.id]), {SWEEP_TIME: at}
        component.store_frame(ray.astype(np.float32), times.astype(np.uint64), None, *measured, span, {}, about)

    # -- objects

    def _boxes(self) -> Iterator[Any]:
        data = self._package.data
        kind = data.LabelSource.EXTERNAL if self._scene.source.recipe is None else data.LabelSource.GT_SYNTHETIC
        for track in self._scene.tracks:
            for at, pose in self._keys_of(track):
                angles = Rotation.from_matrix(pose[:3, :3]).as_euler(EULER).tolist()
                box = data.BBox3(*map(tuple, (pose[:3, 3].tolist(), track.size_m.tolist(), angles)))
                yield data.CuboidTrackObservation(track.id, track.label, at, WORLD, at, box, kind)

    def _keys_of(self, track: Track) -> Iterator[tuple[int, Matrix]]:
        """Poses of an object at its keys within the recording, at its ends where it reaches beyond, and where keys lie
        far apart."""
        own = self._keys(track.times_s, track.pose_at)
        first, last = max(int(own.times_us[0]), self._start_us), min(int(own.times_us[-1]), self._end_us)
        if first > last:
            return
        inside = own.times_us[(own.times_us >= first) & (own.times_us <= last)].tolist()
        times = sorted({first, last, *inside})
        for before, after in zip(times[:-1], times[1:], strict=True):
            parts = -(-(after - before) // _LONGEST_STEP_US)
            times = [*times, *(before + (after - before) * part // parts for part in range(1, parts))]
        times = sorted(set(times))
        poses = own.at(np.array(times)) if len(own.times_us) > 1 else own.poses
        yield from zip(times, poses, strict=True)


def sensor_ids(cameras: Iterable[str], lidars: Iterable[str]) -> dict[str, str]:
    """``camera/NAME`` and ``lidar/NAME`` -> the name of the sensor's frame, each once and apart from ``rig`` and
    ``world``."""
    made: dict[str, str] = {}
    for kind, names in (("camera", cameras), ("lidar", lidars)):
        for name in names:
            taken, chosen = {RIG, WORLD, *made.values()}, name
            while chosen in taken:
                chosen = f"{kind}_{chosen}"
            made[f"{kind}/{name}"] = chosen
    return made


def intrinsics_of(camera: Camera) -> dict[str, Any]:
    """A pinhole camera as a record: principal point from the corner of the image."""
    return {
        "resolution": [camera.width, camera.height],
        "shutter_type": shutter_type(camera),
        "external_distortion_parameters": None,
        "principal_point": [camera.cx, camera.cy],
        "focal_length": [camera.fx, camera.fy],
        "radial_coeffs": [0.0] * 6,
        "tangential_coeffs": [0.0] * 2,
        "thin_prism_coeffs": [0.0] * 4,
    }


def _masks(scene: Scene, frames: list[Frame]) -> dict[str, Any]:
    """Where the own vehicle is seen, by most of the frames that say so."""
    from PIL import Image

    named = [frame for frame in frames if "ego" in frame.labels]
    if not named:
        return {}
    seen = np.mean([read_label(scene, frame, "ego") for frame in named], axis=0) > 0.5
    return {EGO_MASK: Image.fromarray(seen.astype(np.uint8) * 255)}


def _in_order(records: list[Any], span: Any, sensor: str) -> list[Any]:
    """Records of one sensor in order of time; InputError where two begin or end together."""
    ordered = sorted(records, key=lambda record: span(record)[1])
    spans = np.array([span(record) for record in ordered], np.int64).reshape(-1, 2)
    if (np.diff(spans, axis=0) <= 0).any():
        at = int(np.flatnonzero((np.diff(spans, axis=0) <= 0).any(1))[0])
        what = "two records of a sensor overlap so that neither is the earlier one"
        expected = f"one that begins and ends after {ordered[at].id}"
        got, remedy = f"{spans[at].tolist()} and {spans[at + 1].tolist()} us", f"leave sensor {sensor} out of the scene"
        raise InputError(what, where=ordered[at + 1].id, expected=expected, got=got, remedy=remedy)
    return ordered


def _unsigned(span: tuple[int, int]) -> NDArray[np.uint64]:
    return np.array(span, np.uint64)
