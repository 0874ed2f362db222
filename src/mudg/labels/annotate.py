"""``mudg annotate``: a scene -> a new one with dense depth, classes, sky and dynamic objects, each pixel with a
confidence. A label that a frame has already is kept; what made the others is said in the scene's notes. Frames are
labelled in processes, and each is staged when it is done: repeat the command to resume."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from mudg import native
from mudg.base import geometry, html, log, store
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import UsageError
from mudg.base.processes import one_torch_thread, run_in_processes
from mudg.base.run_folder import RunDir
from mudg.base.types import Frame, Scene, Sweep
from mudg.core.depth import MIN_POINTS
from mudg.core.fusion import STATIC, FusionRules, SweepShots, judge_track, largest_beam_gap, separate
from mudg.core.pictures import class_colors, depth_colors, gray, resize_area
from mudg.labels import street_net
from mudg.labels.depth_networks import align_to_lidar, kind_of, load_depth_network
from mudg.labels.evidence import driven_path
from mudg.labels.inputs import DepthInput, DepthNetwork, LabelInput, Labeller, Labels, label_by_network
from mudg.labels.segmenters import Segmenter
from mudg.labels.settings import AnnotateConfig
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_points, read_scene, spread
from mudg.scene.write import SceneWriter

# labellers ----------------------------------------------------------------------------------------
#
# embedded: classes from the small shipped network, which reads image and `evidence.py` (`street_net.py`). network:
# classes from a segmentation network in a folder (`segmenters.py`). Depth and dynamic objects are found in the same way
# for both (`inputs.py`).


def _network(weights: str, device: torch.device) -> Labeller:
    segmenter = Segmenter.load(weights, device)
    return lambda given: label_by_network(given, *segmenter.classes(given.rgb))


LABELLERS: Mapping[str, Callable[[str, torch.device], Labeller]] = {
    "embedded": street_net.StreetLabeller.load,
    "network": _network,
}
"""Name -> what makes a labeller of one image from a folder of weights and a place to compute.

Raises: ResourceError: weights, or the packages that read them, are missing."""


# depth --------------------------------------------------------------------------------------------
#
# A frame whose LiDAR returns are too few, or do not fit the network's depth, keeps the depth that was filled from them;
# it is marked by a small file beside its labels, warned of, and counted in the notes.


def place(config: AnnotateConfig) -> torch.device:
    """Where the networks of a configuration compute."""
    return choose_device(config.device, "networks of annotate", NETWORK_KINDS)


def placed(config: AnnotateConfig) -> AnnotateConfig:
    """The configuration with its device chosen. UsageError: not a device for networks. ResourceError: it is not on this
    machine."""
    return replace(config, device=str(place(config)))


def folders(config: AnnotateConfig) -> dict[str, Path]:
    """Flag that names a network's folder -> that folder, where one is named."""
    named = {"weights": config.weights, "depth-network": config.depth_network}
    return {flag: Path(text) for flag, text in named.items() if text}


def digests(config: AnnotateConfig) -> dict[str, str]:
    """Field of the configuration that names a network's folder -> digest of the folder, for the networks that are used.
    UsageError: a depth network, but no depth. ResourceError: its folder is missing. InputError: it holds another
    kind."""
    found: dict[str, str] = {}
    if config.labeller == "network" and config.weights and Path(config.weights).is_dir():
        found["weights"] = store.digest(Path(config.weights))
    if config.labeller == "embedded":
        found["weights"] = street_net.digest(config.weights or street_net.EMBEDDED)
    if config.depth_network:
        if not config.depth:
            what, remedy = "--depth-network contradicts --no-depth", "leave out one of them"
            raise UsageError(what, where="--depth-network", remedy=remedy)
        kind_of(config.depth_network)
        found["depth_network"] = store.digest(Path(config.depth_network))
    return found


def with_network(network: DepthNetwork, inputs: LabelInput, labels: Labels, frame_id: str, staging: Path) -> Labels:
    """Labels with the network's depth, aligned to the frame's LiDAR, or as they are if it cannot be."""
    asked = DepthInput(inputs.rgb, inputs.measured(), labels.depth, labels.sky)
    reason = "too few LiDAR returns"
    if asked.known.sum() >= MIN_POINTS:
        dense, fit = align_to_lidar(network(asked), asked)
        if dense is not None:
            return replace(labels, depth=dense.depth, depth_confidence=dense.confidence)
        reason = "the network's depth does not increase with the LiDAR's"
        if np.isfinite(fit.residual):
            off = f"half of the returns off by more than {fit.residual:.0%}"
            reason = f"the network's depth does not fit the LiDAR ({off})"
    log.warn(f"frame {frame_id}: {reason}; its depth is filled from LiDAR instead")
    store.write_json(_mark(staging, frame_id), {"reason": reason})
    return labels


def depth_origin(config: AnnotateConfig, networks: Mapping[str, str], made: Sequence[str], staging: Path) -> str:
    """Where the depth of these frames comes from, in words for the scene's notes."""
    filled = f"points of {config.sweeps} sweeps, filled along the image, sky at a fixed distance"
    if "depth_network" not in networks:
        return filled
    without = sum(_mark(staging, frame_id).is_file() for frame_id in made)
    network = f"'{kind_of(config.depth_network)}'{describe_folder(config.depth_network, networks['depth_network'])}"
    words = f"network {network}, aligned to points of {config.sweeps} sweeps, sky at a fixed distance"
    return words + (f"; {without} of them, where it did not fit: {filled}" if without else "")


def describe_folder(folder: str, digest: str) -> str:
    """Name (of one that the package does not ship) and digest of a network's folder, for the scene's notes."""
    where = f" in folder '{Path(folder).name}'" if folder else ""
    return f"{where} (sha256 {digest[:16]})"


def _mark(staging: Path, frame_id: str) -> Path:
    """File that says that a frame kept its filled depth."""
    return staging / f"{frame_id}.filled.json"


# the own vehicle in an image: what stays the same at the bottom of the image while everything else goes by ------------

FRAMES: Final = 16
MIN_TRAVEL_M: Final = 10.0
MIN_SHARE: Final = 0.002
"""A piece smaller than this share of the image is no bonnet."""


def find_ego(scene: Scene, camera: str) -> NDArray[np.bool_]:
    """Own vehicle in the images of a camera, bool[H, W]; empty (and said so) on a drive too short to tell."""
    frames = scene.frames_of(camera)
    size = (scene.cameras[camera].height, scene.cameras[camera].width)
    steps = np.diff(scene.ego.world_from_ego[:, :3, 3], axis=0)
    travel_m = float(np.linalg.norm(steps, axis=1).sum())
    if len(frames) < 4 or travel_m < MIN_TRAVEL_M:
        length = f"{len(frames)} images, {travel_m:.0f} m"
        log.warn(f"camera {camera}: the log is too short to find the own vehicle ({length})")
        return np.zeros(size, bool)
    at = np.unique(np.linspace(0, len(frames) - 1, FRAMES).astype(int))
    return steady_bottom(np.stack([read_image(scene, frames[index]).mean(2) for index in at]))


def steady_bottom(grey: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Pixels bool[H, W] joined to the lower edge that vary much less over time than the rest of the lower half, in
    images [N, H, W] over a drive, 0..255."""
    middle = np.median(grey, axis=0)
    spread = ndimage.uniform_filter(np.median(np.abs(grey - middle), axis=0), 3)
    height, width = spread.shape
    limit = 0.35 * float(np.median(spread[height // 2 :]))
    steady = ndimage.binary_opening(np.pad(spread < limit, 2, mode="edge"), np.ones((5, 5), bool))[2:-2, 2:-2]
    steady[: height // 2] = False
    pieces, count = ndimage.label(steady)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    joined = [piece for piece in np.unique(pieces[-1]) if piece and sizes[piece] > MIN_SHARE * height * width]
    return ndimage.binary_fill_holes(np.isin(pieces, joined)) if joined else np.zeros((height, width), bool)


# points -------------------------------------------------------------------------------------------

MAX_GAP_S = 2.0
"""Sweeps farther in time than this from an image do not help: what moves without a track has gone elsewhere."""


class NearbyReturns:
    """Points of the ``sweeps`` sweeps of each LiDAR that are nearest in time to an image; sweeps are read once."""

    def __init__(self, scene: Scene, sweeps: int) -> None:
        self._scene, self._count = scene, sweeps
        self._rules = FusionRules()
        moving = [n for n, track in enumerate(scene.tracks) if judge_track(track, self._rules).moving]
        self.moving = frozenset(moving)
        """Numbers of the scene's tracks that move."""
        self._dynamic_tracks = [scene.tracks[n] for n in moving]
        self._sensors: dict[str, list[Sweep]] = {}
        for sweep in scene.sweeps:
            self._sensors.setdefault(sweep.sensor, []).append(sweep)
        self._kept: dict[str, tuple[NDArray[np.float32], dict[int, NDArray[np.float32]], float, float]] = {}

    def of(self, frame: Frame) -> tuple[NDArray[np.float32], float, float]:
        """Static points and dynamic objects as they stand at the frame's time, f32[N, 3] metres in the world (none
        where no sweep is near); the largest angle between neighbouring beams, and the highest beam's elevation."""
        time_s = frame.view.time_s
        chosen = [s for sweeps in self._sensors.values() for s in nearest_sweeps(sweeps, time_s, self._count)]
        ids = {sweep.id for sweep in chosen}
        self._kept = {key: value for key, value in self._kept.items() if key in ids}
        parts, known = [np.zeros((0, 3), np.float32)], [self._separated(sweep) for sweep in chosen]
        for static, owned, _, _ in known:
            parts.append(static)
            for index, xyz_object in owned.items():
                pose = self._dynamic_tracks[index].pose_at(time_s)
                if pose is not None:
                    parts.append(geometry.transform_points(pose, xyz_object).astype(np.float32))
        gap = min((gap_deg for _, _, gap_deg, _ in known), default=0.6)
        return np.concatenate(parts), gap, max((highest_rad for *_, highest_rad in known), default=0.0)

    def _separated(self, sweep: Sweep) -> tuple[NDArray[np.float32], dict[int, NDArray[np.float32]], float, float]:
        """Static points in the world, those of each dynamic object in its frame, largest angle between neighbouring
        beams in degrees, and elevation of the highest beam in radians (all but a few stray returns lie below it)."""
        if sweep.id not in self._kept:
            points = read_points(self._scene, sweep)
            shots = SweepShots(sweep.time_s, sweep.world_from_lidar, points, ())
            owner, owned = separate(shots, self._dynamic_tracks, self._rules)
            world = geometry.transform_points(sweep.world_from_lidar, points.xyz).astype(np.float32)
            highest_rad = 0.0
            if len(world) >= 100:
                ray = world - sweep.world_from_lidar[:3, 3].astype(np.float32)
                highest_rad = float(np.quantile(np.arctan2(ray[:, 2], np.hypot(ray[:, 0], ray[:, 1])), 0.998))
            self._kept[sweep.id] = world[owner == STATIC], owned, largest_beam_gap(points.xyz), highest_rad
        return self._kept[sweep.id]


def nearest_sweeps(sweeps: Sequence[Sweep], time_s: float, count: int) -> list[Sweep]:
    """The ``count`` sweeps nearest in time, none farther than ``MAX_GAP_S``, in the order of their times."""
    near = sorted((s for s in sweeps if abs(s.time_s - time_s) <= MAX_GAP_S), key=lambda s: abs(s.time_s - time_s))
    return sorted(near[:count], key=lambda s: s.time_s)


# annotate page ------------------------------------------------------------------------------------
#
# What to look for: edges of the depth lie on edges of the image, the road has no steps, sky ends at the roofs.

NAME: Final = "labels.html"
_FRAMES: Final = 6
_WIDTH_PX: Final = 480
_OUTLINE: Final = np.array([255, 40, 40], np.uint8)


def write_page(scene: Scene, made: set[str], out: Path) -> Path:
    """Write ``labels.html`` and ``pictures/``: some frames of every camera; ``made``: ids of frames that got labels."""
    pictures: list[dict[str, str]] = []
    for camera in scene.cameras:
        labelled = [frame for frame in scene.frames_of(camera) if frame.id in made]
        for frame in spread(labelled or scene.frames_of(camera), _FRAMES):
            name = f"pictures/{frame.id.replace('/', '_')}.jpg"
            store.write_image(out / name, picture(scene, frame), quality=88)
            pictures.append({"file": name, "caption": f"{frame.id}, {frame.view.time_s:.2f} s"})
    lead = "Image; depth (near warm, far cold, darker where unsure); classes, with dynamic objects outlined in red; "
    known = {"title": f"Labels of {scene.id}", "kicker": "mudg annotate", "notes": scene.source.notes}
    known |= {"lead": f"{lead}confidence of the classes.", "class_legend": html.class_legend(), "pictures": pictures}
    store.write_text(out / NAME, html.render("labels.html.j2", **known))
    return out / NAME


def picture(scene: Scene, frame: Frame) -> Image.Image:
    """Image, depth, classes and confidence beside each other; what a frame lacks is black."""
    rgb = read_image(scene, frame)
    panels = [rgb, np.zeros_like(rgb), np.zeros_like(rgb), np.zeros_like(rgb)]
    found = {name: read_label(scene, frame, name) for name in frame.labels}
    if "depth" in found:
        panels[1] = depth_colors(found["depth"])
    if "depth_confidence" in found:
        panels[1] = (panels[1] * (0.35 + 0.65 * found["depth_confidence"][..., None])).astype(np.uint8)
    if "semantics" in found:
        panels[2] = (0.45 * rgb + 0.55 * class_colors(found["semantics"])).astype(np.uint8)
    if "dynamic" in found:
        mask = found["dynamic"].astype(bool)
        panels[2][mask & ~ndimage.binary_erosion(mask, iterations=max(1, rgb.shape[1] // 500))] = _OUTLINE
    if "semantics_confidence" in found:
        panels[3] = gray(found["semantics_confidence"])
    height = max(1, round(rgb.shape[0] * _WIDTH_PX / rgb.shape[1]))
    return Image.fromarray(np.concatenate([resize_area(panel, _WIDTH_PX, height) for panel in panels], 1))


# annotate -----------------------------------------------------------------------------------------

_STAGING = "labelled"
_SHARING = 4
"""Processes that share a device with the shipped network: each holds a context of some hundred megabytes there."""
_FRAMES_PER_PROCESS = 8
"""Fewer frames than this are not worth the start of a process."""


def write_labelled(config: AnnotateConfig, scene: Path, work: RunDir) -> dict[str, Any]:
    """Label a scene: the work folder becomes one with labels, and ``labels.html`` shows some. Returns a summary."""
    loaded, out = read_scene(scene), work.path
    wanted = wanted_labels(config)
    missing = [frame for frame in loaded.frames if not wanted <= set(frame.labels)]
    if not missing:
        log.info("annotate: the scene already has all labels; nothing to add")
    if not (out / "scene.json").is_file():
        staging = out / _STAGING
        _label_frames(config, scene, loaded, missing, staging)
        notes = (*loaded.source.notes, *_notes(config, missing, work.inputs, staging))
        source = replace(loaded.source, notes=notes)
        with SceneWriter(out, loaded.id, source) as writer:
            writer.copy_all_but_frames(loaded)
            _add_frames(config, loaded, missing, staging, writer)
            writer.finish()
    write_page(read_scene(out), {frame.id for frame in missing}, out)
    shutil.rmtree(out / _STAGING, ignore_errors=True)
    return {"labelled": len(missing), "labeller": config.labeller if missing else "labels present"}


def wanted_labels(config: AnnotateConfig) -> set[str]:
    """Names of the labels that every frame shall have; a confidence comes only with a label that was made."""
    optional = {"depth": config.depth, "dynamic": config.dynamic, "ego": config.ego}
    return {"semantics", "sky", *(name for name, wanted in optional.items() if wanted)}


def _notes(config: AnnotateConfig, missing: Sequence[Frame], inputs: Mapping[str, str], staging: Path) -> Iterator[str]:
    """A sentence for each label that was made: for how many frames, and from what."""
    made_by = f"labeller '{config.labeller}'"
    if "weights" in inputs:
        made_by += describe_folder(config.weights, inputs["weights"])
    depth = depth_origin(config, inputs, [frame.id for frame in missing if "depth" not in frame.labels], staging)
    origins = {
        "semantics": made_by,
        "sky": made_by,
        "depth": depth,
        "dynamic": "tracked boxes that move and dense depth",
        "ego": "pixels that stay the same while the vehicle moves",
    }
    for name, origin in origins.items():
        count = sum(name in wanted_labels(config) and name not in frame.labels for frame in missing)
        if count:
            yield f"{name} of {count} frames: {origin}, not truth"


def _label_frames(config: AnnotateConfig, path: Path, scene: Scene, missing: Sequence[Frame], staging: Path) -> None:
    """Put the labels of every frame that has none yet into ``staging``."""
    todo = [frame.id for frame in missing if not staged_labels(staging, frame.id).is_file()]
    if done := len(missing) - len(todo):
        log.info(f"annotate: {done} frames are labelled already")
    usual = native.default_threads()
    if config.device != "cpu":  # a pretrained network fills the device; the shipped one waits for its evidence
        usual = 1 if config.labeller == "network" or config.depth_network else min(usual, _SHARING)
    processes = min(config.processes or usual, len(todo) // _FRAMES_PER_PROCESS)
    with log.task("labelling frames", len(missing), done) as bar:
        if processes <= 1:
            for _ in label_into_staging(config, scene, todo, staging):
                bar.advance()
            return
        parts = np.array_split(np.array(todo, dtype=object), 4 * processes)
        work = [(config, path, list(part), staging) for part in parts if len(part)]
        for _, labelled in run_in_processes(_label_part, work, processes):
            bar.advance(labelled)


def _label_part(config: AnnotateConfig, path: Path, ids: list[str], staging: Path) -> int:
    return sum(1 for _ in label_into_staging(config, read_scene(path), ids, staging))


def label_into_staging(config: AnnotateConfig, scene: Scene, ids: Sequence[str], staging: Path) -> Iterator[str]:
    """Label these frames one after the other, write each to ``staging``, and name it when it is there."""
    if not ids:
        return
    label = LABELLERS[config.labeller](config.weights, place(config))
    folder = config.depth_network
    network = load_depth_network(folder, place(config), config.depth_steps) if folder else None
    returns = NearbyReturns(scene, config.sweeps)
    path = driven_path(scene.ego.world_from_ego)
    frames = {frame.id: frame for frame in scene.frames}
    for frame_id in ids:
        frame = frames[frame_id]
        xyz_world, *beams = returns.of(frame)
        seen = (read_image(scene, frame), xyz_world, scene.tracks, path, *beams, returns.moving)
        given = LabelInput(frame.view, *seen)
        with one_torch_thread():
            labels = label(given)
            if network is not None and "depth" not in frame.labels:
                labels = with_network(network, given, labels, frame_id, staging)
        store.write_safetensors(staged_labels(staging, frame_id), labels.arrays(config.depth, config.dynamic))
        yield frame_id


def staged_labels(staging: Path, frame_id: str) -> Path:
    """Where the labels of a frame lie until the scene is written."""
    return staging / f"{frame_id}.safetensors"


def _add_frames(
    config: AnnotateConfig, scene: Scene, missing: Sequence[Frame], staging: Path, writer: SceneWriter
) -> None:
    ego = {name: find_ego(scene, name) for name in scene.cameras} if config.ego else {}
    lacking = {frame.id for frame in missing}
    for frame in scene.frames:
        if frame.id not in lacking:
            writer.copy_frame(scene, frame)
            continue
        arrays = store.read_safetensors(staged_labels(staging, frame.id))
        for name in ("semantics", "depth"):  # a confidence tells that a label was made: none beside one that was given
            if name in frame.labels:
                arrays.pop(f"{name}_confidence", None)
        if config.ego:
            arrays["ego"] = ego[frame.view.camera.name]
        writer.copy_frame(scene, frame, arrays)
