"""The views a fit learns from: recorded frames with their LiDAR depths, and virtual observations; kept small in memory.

Everything is stored as bytes (8-bit colour and labels) and becomes tensors when a step asks for one view. Which view a step
gets is a function of (run seed, step) alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry, log, seeds
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import Frame, FusedCloud, ObservationKind, Scene, Sweep, Track, View
from mudg.core.fusion import largest_beam_gap
from mudg.core.pictures import resize_area, resize_nearest
from mudg.core.visible import RULES as HIDING_RULES
from mudg.core.visible import visible_depth
from mudg.data import scene as scenefile
from mudg.data.clips.condition import ConditionRules, project_sparse
from mudg.data.observations import ObservationSet, list_observation_sets, read_observations

MAX_LIDAR_M = 100.0
NEAREST_SWEEP_S = 0.1


@dataclass(frozen=True)
class LidarPixels:
    """Sparse LiDAR depth of one view: flat pixel indices i64[M] and depths f32[M] in metres."""

    pixel: Tensor
    depth_m: Tensor


@dataclass(frozen=True)
class TrainView:
    """One view as tensors, ready for a step.

    Args:
        name: e.g. ``front/000012`` or ``front_shift+2.0/000003``, for messages.
        kind: recorded or virtual.
        rgb: f32[3, H, W] in [0, 1].
        channels: i64[H, W], numbers of the model's class channels (255 = unlabelled), or None.
        confidence: f32[1, H, W] in [0, 1]: of all that a virtual view shows, of the labels alone for a recorded one.
        mask: bool[1, H, W], pixels that may be used at all.
        sky: bool[1, H, W] or None if unknown.
        depth: f32[1, H, W] metres of a virtual view (NaN = none), or None.
        lidar: or None.
    """

    name: str
    view: View
    kind: ObservationKind
    rgb: Tensor
    channels: Tensor | None
    confidence: Tensor
    mask: Tensor
    sky: Tensor | None
    depth: Tensor | None
    lidar: LidarPixels | None


@dataclass(frozen=True)
class StoredView:
    """A ``TrainView`` in bytes: rgb u8[H, W, 3]; channels u8[H, W]; sky, mask bool[H, W]; depth f32[H, W]; confidence u8[H, W] (255 =
    1). None where there is none; no mask: all pixels, no confidence: 1."""

    name: str
    view: View
    kind: ObservationKind
    rgb: NDArray[np.uint8]
    channels: NDArray[np.uint8] | None = None
    sky: NDArray[np.bool_] | None = None
    mask: NDArray[np.bool_] | None = None
    lidar: LidarPixels | None = None
    depth: NDArray[np.float32] | None = None
    confidence: NDArray[np.uint8] | None = None

    def as_tensors(self) -> TrainView:
        """The view for a step."""
        everywhere = torch.ones(1, *self.rgb.shape[:2])
        return TrainView(
            name=self.name,
            view=self.view,
            kind=self.kind,
            rgb=torch.from_numpy(self.rgb).permute(2, 0, 1).contiguous().float().div_(255),
            channels=None if self.channels is None else torch.from_numpy(self.channels).long(),
            confidence=everywhere if self.confidence is None else torch.from_numpy(self.confidence)[None].float().div_(255),
            mask=everywhere.bool() if self.mask is None else torch.from_numpy(self.mask)[None],
            sky=None if self.sky is None else torch.from_numpy(self.sky)[None],
            depth=None if self.depth is None else torch.from_numpy(self.depth)[None],
            lidar=self.lidar,
        )


@dataclass(frozen=True)
class ViewSet:
    """All views of a fit. ``virtual`` may be empty."""

    recorded: tuple[StoredView, ...]
    virtual: tuple[StoredView, ...]

    def choose(self, run_seed: int, step: int, virtual_probability: float, beside: bool = False) -> tuple[TrainView, ...]:
        """The views of a step: a virtual one with the given probability (if there are any), else the next recorded one.

        Recorded views come in a fresh random order per round, so that every one is seen equally often.

        Args:
            beside: the virtual view comes after the recorded one, not in its place.
        """
        generator = seeds.numpy_rng(run_seed, step, "view")
        if self.virtual and generator.random() < virtual_probability:
            drawn = self.virtual[int(generator.integers(len(self.virtual)))].as_tensors()
            return (self._recorded_of(run_seed, step), drawn) if beside else (drawn,)
        return (self._recorded_of(run_seed, step),)

    def _recorded_of(self, run_seed: int, step: int) -> TrainView:
        """The recorded view of a step."""
        turn, place = divmod(step, len(self.recorded))
        order = seeds.numpy_rng(run_seed, turn, "recorded order").permutation(len(self.recorded))
        return self.recorded[int(order[place])].as_tensors()


# ---- recorded ----------------------------------------------------------------------------------------------------


def training_frames(scene: Scene, cameras: Sequence[str]) -> tuple[Frame, ...]:
    """Training frames of the named cameras (empty = all).

    Raises:
        UsageError: an unknown camera, or no training frame at all.
    """
    for name in cameras:
        if name not in scene.cameras:
            raise UsageError(f"the scene has no camera named {name!r}", where=scene.root, expected=", ".join(scene.cameras))
    frames = tuple(f for f in scene.frames_in("train") if not cameras or f.view.camera.name in cameras)
    if not frames:
        raise UsageError("the scene has no training frames", where=scene.root, remedy="ingest with a larger --test-every, or 0")
    return frames


def classes_of(scene: Scene, frames: Sequence[Frame], virtual: Mapping[str, ObservationSet]) -> tuple[int, ...]:
    """Train ids that occur in the labels of the frames and in virtual views (a sample of both); sky always included.

    Empty when nothing is labelled.
    """
    found: set[int] = set()
    labelled = [frame for frame in frames if "semantics" in frame.labels]
    for frame in labelled[:: max(1, len(labelled) // 24)]:
        found |= set(np.unique(scenefile.read_label(scene, frame, "semantics")).tolist())
    for observations in virtual.values():
        for index in range(0, len(observations), 6):
            found |= set(np.unique(observations.arrays(index).get("semantics", UNLABELLED)).tolist())
    found -= {UNLABELLED}
    return tuple(sorted(found | {ID["sky"]})) if found else ()


def load_recorded(
    scene: Scene, frames: Sequence[Frame], classes: Sequence[int], width_px: int, with_lidar: bool
) -> tuple[StoredView, ...]:
    """Read frames, labels and LiDAR depths, resized to ``width_px`` (0 = as recorded).

    Frames whose time is further than 0.1 s from every sweep get no LiDAR depth; how many is said once.
    """
    stored = []
    without_lidar = 0
    points = _SweepCache(scene)
    for frame in log.progress(frames, len(frames), "reading frames"):
        view = resized_view(frame.view, width_px)
        size = (view.camera.height, view.camera.width)
        labels = {
            name: resize_nearest(scenefile.read_label(scene, frame, name), *size) if name in frame.labels else None
            for name in ("semantics", "sky", "ego", "semantics_confidence")
        }
        confidence = labels["semantics_confidence"]
        semantics = labels["semantics"]
        sky = labels["sky"] if labels["sky"] is not None else (None if semantics is None else semantics == ID["sky"])
        lidar = points.pixels_of(view) if with_lidar else None
        without_lidar += lidar is None
        stored.append(
            StoredView(
                frame.id, view, "recorded", resize_area(scenefile.read_image(scene, frame), *size[::-1]),
                None if semantics is None or not classes else to_channels(semantics, classes), sky,
                None if labels["ego"] is None else ~labels["ego"].astype(bool), lidar,
                confidence=None if confidence is None else (confidence * 255).round().astype(np.uint8),
            )
        )  # fmt: skip
    if with_lidar and without_lidar:
        log.warn(f"{without_lidar} of {len(frames)} frames have no LiDAR sweep within {NEAREST_SWEEP_S} s: no depth there")
    return tuple(stored)


def virtual_sets(folders: Sequence[Path]) -> dict[str, ObservationSet]:
    """The sets of virtual observations below some folders, by name; only their indices are read.

    Raises:
        InputError: a folder has none, two have sets of one name, or one of them holds recorded views.
    """
    sets: dict[str, ObservationSet] = {}
    for path in folders:
        found = {name: read_observations(folder) for name, folder in list_observation_sets(path).items()}
        if not found:
            raise InputError("this folder holds no finished virtual views", where=str(path), remedy="run `mudg synthesize` first")
        if twice := sorted(set(found) & set(sets)):
            raise InputError("two folders hold virtual views of the same name", where=str(path), got=", ".join(twice[:4]),
                             remedy="give one of them")  # fmt: skip
        sets |= found
    for found in sets.values():
        if found.kind == "recorded":
            raise InputError("recorded views among the virtual ones: held-out views must not be trained on", where=str(found.path),
                             expected="views of kind virtual", got=f"kind recorded, source {found.source}",
                             remedy="give the folder that `mudg synthesize` wrote")  # fmt: skip
    return sets


def load_virtual(
    sets: Mapping[str, ObservationSet], classes: Sequence[int], measured: Callable[[View], LidarPixels] | None = None
) -> tuple[StoredView, ...]:
    """All observations of these sets, with the sparse depth that ``measured`` gives for a view."""
    stored = []
    for name, observations in sets.items():
        for index, view in enumerate(observations.views):
            arrays = observations.arrays(index)
            semantics, confidence = arrays.get("semantics"), arrays["confidence"].astype(np.float32).clip(0, 1)
            stored.append(
                StoredView(
                    f"{name}/{index:06d}", view, "virtual", observations.rgb_u8(index).copy(),
                    None if semantics is None or not classes else to_channels(semantics, classes),
                    None if semantics is None else semantics == ID["sky"], arrays["mask"].astype(bool),
                    None if measured is None else measured(view), arrays["depth"].copy() if "depth" in arrays else None,
                    (confidence * 255).round().astype(np.uint8),
                )
            )  # fmt: skip
    return tuple(stored)


def fused_lidar(cloud: FusedCloud, tracks: Sequence[Track]) -> Callable[[View], LidarPixels]:
    """A function view -> depths of the fused points seen there: the static ones, and those of objects where they are then.

    Points behind others are left out as in the diffusion model's condition (``data.clips.project_sparse``).
    """

    def measured(view: View) -> LidarPixels:
        camera = view.camera
        seen = project_sparse(cloud, tracks, view, ConditionRules(camera.width, camera.height, far_m=MAX_LIDAR_M))
        pixel = seen.valid.reshape(-1).nonzero()[:, 0]
        return LidarPixels(pixel, seen.depth.reshape(-1)[pixel].contiguous())

    return measured


def to_channels(train_ids: NDArray[np.integer], classes: Sequence[int]) -> NDArray[np.uint8]:
    """Train ids to channel numbers of ``classes``; others become 255."""
    lookup = np.full(256, UNLABELLED, np.uint8)
    lookup[list(classes)] = np.arange(len(classes), dtype=np.uint8)
    return lookup[train_ids.astype(np.uint8)]


def resized_view(view: View, width_px: int) -> View:
    """The view on a grid of this width, aspect kept (0 = unchanged)."""
    camera = view.camera
    if width_px in (0, camera.width):
        return view
    return view.resized(width_px, max(1, round(camera.height * width_px / camera.width)))


# ---- LiDAR depth of a recorded view ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _WorldSweep:
    """World points f32[N, 3] of a sweep, their times after it f32[N] in seconds, and the largest angle between its beams."""

    xyz: NDArray[np.float32]
    dt_s: NDArray[np.float32]
    gap_deg: float


class _SweepCache:
    """World points of the sweeps nearest in time; each sweep is read once (several cameras share it)."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._read: dict[str, _WorldSweep] = {}

    def pixels_of(self, view: View) -> LidarPixels | None:
        """Depths of the nearest sweep of every sensor as seen by the view; None if no sweep is near in time."""
        clouds, gap_deg = [], 0.0
        for sensor in dict.fromkeys(sweep.sensor for sweep in self._scene.sweeps):
            sweeps = [sweep for sweep in self._scene.sweeps if sweep.sensor == sensor]
            nearest = min(sweeps, key=lambda sweep: abs(sweep.time_s - view.time_s))
            if abs(nearest.time_s - view.time_s) <= NEAREST_SWEEP_S:
                clouds.append(self._points_at(nearest, view.time_s))
                gap_deg = max(gap_deg, self._read[nearest.id].gap_deg)
        return lidar_pixels(view, np.concatenate(clouds), gap_deg) if clouds else None

    def _points_at(self, sweep: Sweep, time_s: float) -> NDArray[np.float32]:
        """World points of a sweep, the points of every tracked box carried from when they were measured to ``time_s``."""
        if sweep.id not in self._read:
            points = scenefile.read_points(self._scene, sweep)
            world = geometry.transform_points(sweep.world_from_lidar, points.xyz)
            self._read[sweep.id] = _WorldSweep(world, points.dt_s, largest_beam_gap(points.xyz))
        world, dt_s = self._read[sweep.id].xyz, self._read[sweep.id].dt_s
        moved = world.copy()
        for track in self._scene.tracks:
            then, soon, now = track.pose_at(sweep.time_s), track.pose_at(sweep.time_s + 0.05), track.pose_at(time_s)
            if then is None or now is None:
                continue
            velocity = np.zeros(3) if soon is None else (soon[:3, 3] - then[:3, 3]) / 0.05
            if np.abs(velocity).max() < 0.01 and np.abs(now - then).max() < 0.01:
                continue
            near = _within(world, then[:3, 3].astype(np.float32), float(np.linalg.norm(track.size_m)) + 2.0)
            at_sweep = world[near] - dt_s[near, None] * velocity.astype(np.float32)
            local = geometry.transform_points(geometry.invert(then), at_sweep)
            inside = (np.abs(local) < track.size_m / 2 + 0.1).all(1)
            moved[near[inside]] = geometry.transform_points(now, local[inside])
        return moved


def _within(xyz: NDArray[np.float32], center: NDArray[np.float32], reach_m: float) -> NDArray[np.int64]:
    """Indices of the points in the axis-aligned cube around ``center``; axis by axis, so that most points cost one test."""
    near = np.flatnonzero(np.abs(xyz[:, 0] - center[0]) < reach_m)
    for axis in (1, 2):
        near = near[np.abs(xyz[near, axis] - center[axis]) < reach_m]
    return near


def lidar_pixels(view: View, xyz_world: NDArray[np.float32], gap_deg: float) -> LidarPixels:
    """Depth of the points that the camera sees (``core.visible``); ``gap_deg``: largest angle between neighbouring beams."""
    depth = visible_depth(view, xyz_world, HIDING_RULES["sweep"], gap_deg=gap_deg, far_m=MAX_LIDAR_M).reshape(-1)
    pixel = np.flatnonzero(np.isfinite(depth))
    return LidarPixels(torch.from_numpy(pixel), torch.from_numpy(depth[pixel]))
