"""The views a fit learns from: recorded frames with their LiDAR depths, and virtual observations; kept small in memory.

Everything is stored as bytes (8-bit colour and labels) and becomes tensors when a step asks for one view. Which view a step
gets is a function of (run seed, step) alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry, log, seeds
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import ID, UNLABELLED
from mudg.base.types import Frame, FusedCloud, Observation, Scene, Sweep, Track, View
from mudg.core.pictures import resize_area, resize_nearest
from mudg.data import scene as scenefile
from mudg.data.clips.condition import ConditionRules, project_sparse
from mudg.data.observations import list_observation_sets, read_observations

MAX_LIDAR_M = 100.0
NEAREST_SWEEP_S = 0.1
OCCLUSION_CELL_PX = (8, 3)
"""Columns and rows of the neighbourhood in which a nearer point hides a farther one (rows: about one beam apart)."""
OCCLUSION_MARGIN = 0.15
NEXT_TO_M = 0.05
"""Distances from the recorded path that differ by less are the same distance."""


@dataclass(frozen=True)
class LidarPixels:
    """Sparse LiDAR depth of one view: flat pixel indices i64[M] and depths f32[M] in metres."""

    pixel: Tensor
    depth_m: Tensor


@dataclass(frozen=True)
class Sample:
    """One view to learn from.

    Args:
        name: e.g. ``front/000012`` or ``front_shift+2.0/000003``, for messages.
        observation: semantics hold *channel numbers* of the model's classes here (255 = unlabelled).
        sky: bool[1, H, W] or None if unknown.
        lidar: or None.
        unseen: bool[1, H, W] of a virtual view: no recorded view saw what it shows here.
    """

    name: str
    observation: Observation
    sky: Tensor | None
    lidar: LidarPixels | None
    unseen: Tensor


@dataclass(frozen=True)
class StoredView:
    """One view in bytes: rgb u8[H, W, 3]; channel u8[H, W] or None; sky, mask bool[H, W] or None; depth f16 m (NaN = none)
    of virtual views; confidence u8 of all a virtual view shows, of the labels alone for a recorded one (None = 1)."""

    name: str
    view: View
    kind: str
    source: str
    rgb: NDArray[np.uint8]
    channel: NDArray[np.uint8] | None
    sky: NDArray[np.bool_] | None
    mask: NDArray[np.bool_] | None
    lidar: LidarPixels | None = None
    depth: NDArray[np.float32] | None = None
    confidence: NDArray[np.uint8] | None = None

    def sample(self, unseen: Tensor | None = None) -> Sample:
        """The view as tensors; ``unseen`` u8, at least [H, W] (None: all of it)."""
        height, width = self.rgb.shape[:2]
        everywhere = torch.ones(1, height, width)
        observation = Observation(
            view=self.view,
            rgb=torch.from_numpy(self.rgb).permute(2, 0, 1).float().div_(255),
            depth=None if self.depth is None else torch.from_numpy(self.depth)[None],
            semantics=None if self.channel is None else torch.from_numpy(self.channel).long(),
            confidence=everywhere if self.confidence is None else torch.from_numpy(self.confidence)[None].float().div_(255),
            mask=everywhere.bool() if self.mask is None else torch.from_numpy(self.mask)[None],
            kind="recorded" if self.kind == "recorded" else "virtual",
            source=self.source,
        )
        sky = None if self.sky is None else torch.from_numpy(self.sky)[None]
        unseen = everywhere.bool() if unseen is None else unseen[None, :height, :width].bool()
        return Sample(self.name, observation, sky, self.lidar, unseen)


@dataclass(frozen=True)
class ViewSet:
    """All views of a fit. ``virtual`` may be empty; ``offsets_m``: how far each of them is from the recorded path."""

    recorded: tuple[StoredView, ...]
    virtual: tuple[StoredView, ...]
    offsets_m: tuple[float, ...] = ()

    def choose(
        self, run_seed: int, step: int, virtual_probability: float, unseen: Tensor | None = None, reach_m: float = math.inf,
        beside: bool = False,
    ) -> tuple[Sample, ...]:  # fmt: skip
        """The views of a step: a virtual one with the given probability (if there are any), else the next recorded one.

        Recorded views come in a fresh random order per round, so that every one is seen equally often.

        Args:
            unseen: u8[V, H, W], what only the virtual views see (see ``fit_trust``).
            reach_m: virtual views farther than this from the recorded path are not taken yet.
            beside: the virtual view comes after the recorded one, not in its place.
        """
        generator = seeds.numpy_rng(run_seed, step, "view")
        if self.virtual and generator.random() < virtual_probability:
            within = range(len(self.virtual))
            if math.isfinite(reach_m):
                within = [i for i, offset in enumerate(self.offsets_m) if offset <= reach_m + NEXT_TO_M]
            index = within[int(generator.integers(len(within)))]
            drawn = self.virtual[index].sample(None if unseen is None else unseen[index])
            return (self._recorded_of(run_seed, step), drawn) if beside else (drawn,)
        return (self._recorded_of(run_seed, step),)

    def _recorded_of(self, run_seed: int, step: int) -> Sample:
        """The recorded view of a step."""
        turn, place = divmod(step, len(self.recorded))
        order = seeds.numpy_rng(run_seed, turn, "recorded order").permutation(len(self.recorded))
        return self.recorded[int(order[place])].sample()


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
        raise UsageError("the scene has no training frames", where=scene.root, remedy="ingest with a smaller held-out share")
    return frames


def classes_of(scene: Scene, frames: Sequence[Frame], virtual: Path | None) -> tuple[int, ...]:
    """Train ids that occur in the labels of the frames (a sample of them) and in virtual views; sky always included.

    Empty when nothing is labelled.
    """
    found: set[int] = set()
    labelled = [frame for frame in frames if "semantics" in frame.labels]
    for frame in labelled[:: max(1, len(labelled) // 24)]:
        found |= set(np.unique(scenefile.read_label(scene, frame, "semantics")).tolist())
    if virtual is not None:
        for path in list_observation_sets(virtual).values():
            observations = read_observations(path)
            for index in range(0, len(observations), 6):
                semantics = observations[index].semantics
                found |= set() if semantics is None else set(torch.unique(semantics).tolist())
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
                frame.id, view, "recorded", "camera", resize_area(scenefile.read_image(scene, frame), *size[::-1]),
                None if semantics is None or not classes else to_channels(semantics, classes), sky,
                None if labels["ego"] is None else ~labels["ego"].astype(bool), lidar,
                confidence=None if confidence is None else (confidence * 255).round().astype(np.uint8),
            )
        )  # fmt: skip
    if with_lidar and without_lidar:
        log.warn(f"{without_lidar} of {len(frames)} frames have no LiDAR sweep within {NEAREST_SWEEP_S} s: no depth there")
    return tuple(stored)


def load_virtual(
    path: Path, classes: Sequence[int], measured: Callable[[View], LidarPixels] | None = None
) -> tuple[StoredView, ...]:
    """All observations below ``path``, with the sparse depth that ``measured`` gives for a view.

    Raises:
        InputError: no observation folder there, or a recorded one among them.
    """
    sets = list_observation_sets(path)
    if not sets:
        raise InputError("no finished folders of observations here", where=str(path), remedy="run `mudg synthesize` first")
    stored = []
    for name, folder in sets.items():
        observations = read_observations(folder)
        for index in range(len(observations)):
            seen = observations[index]
            lidar = None if measured is None else measured(seen.view)
            stored.append(replace(stored_observation(f"{name}/{index:06d}", seen, classes), lidar=lidar))
    return tuple(stored)


def offsets_from_path_m(recorded: Sequence[StoredView], virtual: Sequence[StoredView]) -> tuple[float, ...]:
    """Distance of each virtual view from the nearest recorded one of the same camera (of any, if it recorded nothing)."""
    if not virtual:
        return ()
    every = np.stack([view.view.center_world for view in recorded])
    names = [view.view.camera.name for view in recorded]
    found = []
    for view in virtual:
        own = [name == view.view.camera.name for name in names]
        centres = every[own] if any(own) else every
        found.append(float(np.linalg.norm(centres - view.view.center_world, axis=1).min()))
    return tuple(found)


def fused_lidar(cloud: FusedCloud, tracks: Sequence[Track]) -> Callable[[View], LidarPixels]:
    """A function view -> depths of the fused points seen there: the static ones, and those of objects where they are then.

    Points behind others are left out as in the diffusion model's condition (``data.clips.project_sparse``).
    """

    def at(view: View) -> LidarPixels:
        camera = view.camera
        seen = project_sparse(cloud, tracks, view, ConditionRules(camera.width, camera.height, far_m=MAX_LIDAR_M))
        pixel = seen.valid.reshape(-1).nonzero()[:, 0]
        return LidarPixels(pixel, seen.depth.reshape(-1)[pixel].contiguous())

    return at


def stored_observation(name: str, observation: Observation, classes: Sequence[int]) -> StoredView:
    """One virtual observation in bytes."""
    semantics = None if observation.semantics is None else observation.semantics.numpy().astype(np.uint8)
    return StoredView(
        name, observation.view, observation.kind, observation.source,
        (observation.rgb.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy(),
        None if semantics is None or not classes else to_channels(semantics, classes),
        None if semantics is None else semantics == ID["sky"],
        observation.mask[0].numpy(), None,
        None if observation.depth is None else observation.depth[0].numpy().astype(np.float32),
        (observation.confidence[0].clamp(0, 1) * 255).round().byte().numpy(),
    )  # fmt: skip


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


class _SweepCache:
    """World points of the sweeps nearest in time; each sweep is read once (several cameras share it)."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._read: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}

    def pixels_of(self, view: View) -> LidarPixels | None:
        """Depths of the nearest sweep of every sensor as seen by the view; None if no sweep is near in time."""
        clouds = []
        for sensor in dict.fromkeys(sweep.sensor for sweep in self._scene.sweeps):
            sweeps = [sweep for sweep in self._scene.sweeps if sweep.sensor == sensor]
            nearest = min(sweeps, key=lambda sweep: abs(sweep.time_s - view.time_s))
            if abs(nearest.time_s - view.time_s) <= NEAREST_SWEEP_S:
                clouds.append(self._at(nearest, view.time_s))
        return visible_lidar(view, np.concatenate(clouds)) if clouds else None

    def _at(self, sweep: Sweep, time_s: float) -> NDArray[np.float32]:
        """World points of a sweep, the points of every tracked box carried from when they were measured to ``time_s``."""
        if sweep.id not in self._read:
            points = scenefile.read_points(self._scene, sweep)
            self._read[sweep.id] = geometry.transform_points(sweep.world_from_lidar, points.xyz), points.dt_s
        world, dt_s = self._read[sweep.id]
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


def visible_lidar(view: View, xyz_world: NDArray[np.float32], far_m: float = MAX_LIDAR_M) -> LidarPixels:
    """Project points and keep those the camera can see.

    The scanner sits elsewhere than the camera, so it sees past edges that hide things from the camera: a point more than
    15 % and 0.5 m behind the nearest point of its 8 x 3 px neighbourhood is dropped (a flat road, seen at a grazing angle,
    stays within that); of several in one pixel the nearest stays.
    """
    camera = view.camera
    uv, z = geometry.project(view, xyz_world)
    inside = (z > 0.5) & (z < far_m)
    inside &= (uv[:, 0] >= 0) & (uv[:, 0] < camera.width) & (uv[:, 1] >= 0) & (uv[:, 1] < camera.height)
    uv, z = uv[inside], z[inside]
    column, row = uv[:, 0].astype(np.int64), uv[:, 1].astype(np.int64)
    cell_x, cell_y = column // OCCLUSION_CELL_PX[0], row // OCCLUSION_CELL_PX[1]
    nearest = np.full((camera.height // OCCLUSION_CELL_PX[1] + 1, camera.width // OCCLUSION_CELL_PX[0] + 1), np.inf)
    np.minimum.at(nearest, (cell_y, cell_x), z)
    kept = z <= nearest[cell_y, cell_x] * (1 + OCCLUSION_MARGIN) + 0.5
    pixel, z = (row * camera.width + column)[kept], z[kept]
    order = np.lexsort((z, pixel))
    pixel, z = pixel[order], z[order]
    first = np.concatenate([[True], pixel[1:] != pixel[:-1]]) if len(pixel) else np.zeros(0, bool)
    return LidarPixels(torch.from_numpy(pixel[first]), torch.from_numpy(z[first].astype(np.float32)))
