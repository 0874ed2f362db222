"""The views a fit learns from: recorded frames with their LiDAR depths, and virtual observations. All are stored as
bytes, in memory or in files, and become tensors when a step asks for one."""

from __future__ import annotations

import contextlib
import functools
import math
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg import native
from mudg.base import geometry, log, seeds
from mudg.base.errors import InputError, UsageError
from mudg.base.memory import mapped_array
from mudg.base.palette import ID, UNLABELLED
from mudg.base.processes import GIB, computed_ahead
from mudg.base.types import Frame, FusedCloud, ObservationKind, Scene, Sweep, Track, View
from mudg.core.fusion import largest_beam_gap
from mudg.core.pictures import resize_area, resize_nearest
from mudg.core.project import RULES as HIDING_RULES
from mudg.core.project import ProjectConfig, project_cloud, visible_depth
from mudg.core.trajectory import Readout, points_as_read, readout_of
from mudg.networks.featnets import WHOLE_PIXELS
from mudg.scene.labels import read_label
from mudg.scene.observations import ObservationSet, list_observation_sets, read_observations
from mudg.scene.read import read_image, read_points

MAX_LIDAR_M = 100.0
NEAREST_SWEEP_S = 0.1
READERS = 8
"""Threads that read views, at most; each holds one, and two wait for each."""
SWEEPS_PER_SENSOR = 6


@dataclass(frozen=True)
class LidarPixels:
    """Sparse LiDAR depth of one view: flat pixel indices i64[M] and depths f32[M] in metres."""

    pixel: Tensor
    depth_m: Tensor

    def __len__(self) -> int:
        return len(self.pixel)


@dataclass(frozen=True)
class TrainView:
    """One view as tensors, ready for a step. ``name``: e.g. ``front/000012`` or ``front_shift+2.0/000003``, for
    messages. ``kind``: recorded or virtual. ``rgb``: f32[3, H, W] in [0, 1]. ``channels``: i64[H, W], numbers of the
    model's class channels (255 = unlabelled), or None. ``confidence``: f32[1, H, W] in [0, 1]: of all that a virtual
    view shows, of the labels alone for a recorded one. ``mask``: bool[1, H, W], pixels that may be used at all.
    ``sky``: bool[1, H, W] or None if unknown. ``depth``: f32[1, H, W] metres of a virtual view (NaN = none), or None.
    ``lidar``: or None where nothing was measured."""

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
    readout: Readout | None

    @classmethod
    def of(cls, stored: StoredView, device: torch.device) -> TrainView:
        """A stored view on a device. The bytes travel and grow there: a fifth of what the tensors take."""

        def sent(array: NDArray[Any] | Tensor) -> Tensor:
            return torch.as_tensor(array).to(device, non_blocking=True)

        everywhere = torch.ones(1, *stored.rgb.shape[:2], device=device)
        return cls(
            name=stored.name,
            view=stored.view,
            kind=stored.kind,
            rgb=sent(stored.rgb).permute(2, 0, 1).contiguous().float().div_(255),
            channels=None if stored.channels is None else sent(stored.channels).long(),
            confidence=everywhere if stored.confidence is None else sent(stored.confidence)[None].float().div_(255),
            mask=everywhere.bool() if stored.mask is None else sent(stored.mask)[None],
            sky=None if stored.sky is None else sent(stored.sky)[None],
            depth=None if stored.depth is None else sent(stored.depth)[None],
            lidar=LidarPixels(*map(sent, vars(stored.lidar).values())) if stored.lidar else None,
            readout=stored.readout,
        )


@dataclass(frozen=True)
class StoredView:
    """A ``TrainView`` in bytes: rgb u8[H, W, 3]; channels u8[H, W]; sky, mask bool[H, W]; depth f32[H, W]; confidence
    u8[H, W] (255 = 1). None where there is none; no mask: all pixels, no confidence: 1."""

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
    readout: Readout | None = None

    def train_ids(
        self, row: NDArray[np.integer], column: NDArray[np.integer], classes: Sequence[int]
    ) -> NDArray[np.uint8]:
        """Train ids at pixels, by those of the channels; 255 where there is none."""
        if self.channels is None:
            return np.full(np.broadcast(row, column).shape, UNLABELLED, np.uint8)
        return np.array([*classes, UNLABELLED], np.uint8)[np.minimum(self.channels[row, column], len(classes))]


@dataclass(frozen=True)
class ViewSet:
    """All views of a fit. ``virtual`` may be empty."""

    recorded: Sequence[StoredView]
    virtual: Sequence[StoredView] = ()

    def choose(
        self, run_seed: int, step: int, virtual_probability: float, beside: bool = False
    ) -> tuple[StoredView, ...]:
        """The views of a step, a function of (run seed, step) alone: a virtual one with the given probability (if there
        are any), else the next recorded one. Recorded views come in a fresh random order per round. ``beside``: the
        virtual view comes after the recorded one, not in its place."""
        turn, place = divmod(step, len(self.recorded))
        order = seeds.numpy_rng(run_seed, turn, "recorded order").permutation(len(self.recorded))
        recorded, generator = self.recorded[int(order[place])], seeds.numpy_rng(run_seed, step, "view")
        if self.virtual and generator.random() < virtual_probability:
            drawn = self.virtual[int(generator.integers(len(self.virtual)))]
            return (recorded, drawn) if beside else (drawn,)
        return (recorded,)


# ---- recorded ------------------------------------------------------------------------------------


def training_frames(scene: Scene, cameras: Sequence[str]) -> tuple[Frame, ...]:
    """Training frames of the named cameras (empty = all). UsageError: an unknown camera, or no training frame at
    all."""
    for name in cameras:
        if name not in scene.cameras:
            what, known = f"the scene has no camera named {name!r}", ", ".join(scene.cameras)
            raise UsageError(what, where=scene.root, expected=known)
    frames = tuple(f for f in scene.frames_in("train") if not cameras or f.view.camera.name in cameras)
    if not frames:
        remedy = "ingest with a larger --test-every, or 0"
        raise UsageError("the scene has no training frames", where=scene.root, remedy=remedy)
    return frames


def classes_of(scene: Scene, frames: Sequence[Frame], virtual: Mapping[str, ObservationSet]) -> tuple[int, ...]:
    """Train ids that occur in the labels of the frames and in virtual views (a sample of both), with sky; empty when
    nothing is labelled."""
    found: set[int] = set()
    labelled = [frame for frame in frames if "semantics" in frame.labels]
    for frame in labelled[:: max(1, len(labelled) // 24)]:
        found |= set(np.unique(read_label(scene, frame, "semantics")).tolist())
    for observations in virtual.values():
        for index in range(0, len(observations), 6):
            found |= set(np.unique(observations.arrays(index).get("semantics", UNLABELLED)).tolist())
    found -= {UNLABELLED}
    return tuple(sorted(found | {ID["sky"]})) if found else ()


LoadedViews = Generator[tuple[int, StoredView], None, None]
"""Views with their places among all, in any order."""


def load_recorded(
    scene: Scene, frames: Sequence[Frame], classes: Sequence[int], width_px: int, with_lidar: bool
) -> LoadedViews:
    """Read frames, labels and LiDAR depths, resized to ``width_px`` (0 = as recorded), by several threads in the order
    of time, so that all cameras need a sweep at once. Frames further than 0.1 s from every sweep get no LiDAR depth."""
    points = _SweepCache(scene)

    def read(frame: Frame) -> StoredView:
        view = resized_view(frame.view, width_px)
        size = (view.camera.height, view.camera.width)
        labels = {
            name: resize_nearest(read_label(scene, frame, name), *size) if name in frame.labels else None
            for name in ("semantics", "sky", "ego", "semantics_confidence")
        }
        semantics, sky, ego, confidence = labels.values()
        rgb, lidar = resize_area(read_image(scene, frame), *size[::-1]), points.pixels_of(view) if with_lidar else None
        channels = None if semantics is None or not classes else to_channels(semantics, classes)
        sky = semantics == ID["sky"] if sky is None and semantics is not None else sky
        mask = None if ego is None else ~ego.astype(bool)
        sure = None if confidence is None else (confidence * 255).round().astype(np.uint8)
        readout = readout_of(scene, view)
        return StoredView(frame.id, view, "recorded", rgb, channels, sky, mask, lidar, None, sure, readout)

    order = sorted(range(len(frames)), key=lambda index: frames[index].view.time_s)
    without_lidar = 0
    for index, stored in _read_by_threads(order, lambda index: read(frames[index]), "reading frames"):
        without_lidar += stored.lidar is None
        yield index, stored
    if with_lidar and without_lidar:
        count = f"{without_lidar} of {len(frames)}"
        log.warn(f"{count} frames have no LiDAR sweep within {NEAREST_SWEEP_S} s: no depth there")


def _read_by_threads(order: Sequence[int], read: Callable[[int], StoredView], doing: str) -> LoadedViews:
    """``read`` of each of these numbers, with progress."""
    with native.one_thread():
        views = computed_ahead(lambda turn: read(order[turn]), len(order), min(native.default_threads(), READERS))
        for turn, stored in enumerate(log.progress(views, len(order), doing)):
            yield order[turn], stored


def virtual_sets(folders: Sequence[Path]) -> dict[str, ObservationSet]:
    """The sets of virtual observations in some folders, of all trajectories or of one, by name; only their indices are
    read. InputError: a folder has none, two have sets of one name, or one of them holds recorded views."""
    sets: dict[str, ObservationSet] = {}
    for path in folders:
        found = {name: read_observations(folder) for name, folder in list_observation_sets(path).items()}
        if not found:
            what = "this folder holds no finished virtual views"
            raise InputError(what, where=str(path), remedy="run `mudg synthesize` first")
        if twice := sorted(set(found) & set(sets)):
            what = "two folders hold virtual views of the same name"
            raise InputError(what, where=str(path), got=", ".join(twice[:4]), remedy="give one of them")
        sets |= found
    for found in sets.values():
        if found.kind == "recorded":
            what = "recorded views among the virtual ones: held-out views must not be trained on"
            got, remedy = f"kind recorded, source {found.source}", "give the folder that `mudg synthesize` wrote"
            raise InputError(what, where=str(found.path), expected="views of kind virtual", got=got, remedy=remedy)
    return sets


def load_virtual(
    sets: Mapping[str, ObservationSet], classes: Sequence[int], measured: Callable[[View], LidarPixels] | None = None
) -> LoadedViews:
    """All observations of these sets, with the sparse depth that ``measured`` gives for a view."""
    every = [(name, observations, index) for name, observations in sets.items() for index in range(len(observations))]

    def read(place: int) -> StoredView:
        name, observations, index = every[place]
        view, arrays = observations.views[index], observations.arrays(index)
        semantics, confidence = arrays.get("semantics"), arrays["confidence"].astype(np.float32).clip(0, 1)
        channels = None if semantics is None or not classes else to_channels(semantics, classes)
        sky, mask = None if semantics is None else semantics == ID["sky"], arrays["mask"].astype(bool)
        lidar = None if measured is None else measured(view)
        depth = arrays["depth"].copy() if "depth" in arrays else None
        head, rgb = (f"{name}/{index:06d}", view, "virtual"), observations.rgb_u8(index).copy()
        return StoredView(*head, rgb, channels, sky, mask, lidar, depth, (confidence * 255).round().astype(np.uint8))

    yield from _read_by_threads(range(len(every)), read, "reading virtual views")


def fused_lidar(cloud: FusedCloud, tracks: Sequence[Track]) -> Callable[[View], LidarPixels]:
    """A function view -> depths of the fused points seen there: the static ones, and those of objects where they are
    then. Points behind others are left out as in the diffusion model's condition."""
    drawn = ProjectConfig(near_m=1.0, far_m=MAX_LIDAR_M, occluder_m=0.2)

    def measured(view: View) -> LidarPixels:
        seen = project_cloud(cloud, {t.id: t.pose_at(view.time_s) for t in tracks}, view, drawn, hide=True)
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


# ---- LiDAR depth of a recorded view --------------------------------------------------------------


_WorldSweep = tuple[NDArray[np.float32], NDArray[np.float32], float]
"""World points f32[N, 3] of a sweep, their times after it f32[N] in seconds, and the largest angle between its beams in
degrees."""


class _SweepCache:
    """World points of the sweeps nearest in time; several cameras share a sweep, and the last few are kept. Any thread
    may ask."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._sweeps = scene, dict[str, list[Sweep]]()
        for sweep in scene.sweeps:
            self._sweeps.setdefault(sweep.sensor, []).append(sweep)
        self._lock = threading.Lock()  # who waits for a sweep that is being read need not read it, too
        self._world = functools.lru_cache(SWEEPS_PER_SENSOR * len(self._sweeps))(self._read)

    def pixels_of(self, view: View) -> LidarPixels | None:
        """Depths of the nearest sweep of every sensor as seen by the view; None if no sweep is near in time."""
        clouds, gap_deg = [], 0.0
        for sensor, sweeps in self._sweeps.items():
            index = min(range(len(sweeps)), key=lambda index: abs(sweeps[index].time_s - view.time_s))
            if abs(sweeps[index].time_s - view.time_s) <= NEAREST_SWEEP_S:
                with self._lock:
                    found = self._world(sensor, index)
                clouds.append(self._points_at(found, sweeps[index], view.time_s))
                gap_deg = max(gap_deg, found[2])
        if not clouds:
            return None
        return lidar_pixels(view, points_as_read(self._scene, view, np.concatenate(clouds)), gap_deg)

    def _read(self, sensor: str, index: int) -> _WorldSweep:
        sweep = self._sweeps[sensor][index]
        points = read_points(self._scene, sweep)
        world = geometry.transform_points(sweep.world_from_lidar, points.xyz)
        return world, points.dt_s, largest_beam_gap(points.xyz)

    def _points_at(self, found: _WorldSweep, sweep: Sweep, time_s: float) -> NDArray[np.float32]:
        """World points of a sweep, the points of every tracked box carried from when they were measured to
        ``time_s``."""
        world, dt_s, _ = found
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
    """Indices of the points in the axis-aligned cube around ``center``; axis by axis, so that most points cost one
    test."""
    near = np.flatnonzero(np.abs(xyz[:, 0] - center[0]) < reach_m)
    for axis in (1, 2):
        near = near[np.abs(xyz[near, axis] - center[axis]) < reach_m]
    return near


def lidar_pixels(view: View, xyz_world: NDArray[np.float32], gap_deg: float) -> LidarPixels:
    """Depth of the points that the camera sees (``core.project``); ``gap_deg``: largest angle between neighbouring
    beams."""
    depth = visible_depth(view, xyz_world, HIDING_RULES["sweep"], gap_deg=gap_deg, far_m=MAX_LIDAR_M).reshape(-1)
    pixel = np.flatnonzero(np.isfinite(depth))
    return LidarPixels(torch.from_numpy(pixel), torch.from_numpy(depth[pixel]))


# ---- where views lie -----------------------------------------------------------------------------
#
# Decoded views of a long log at full size need more memory than the fit itself: 1,000 of 1600 x 1066 pixels 8 to 11
# GiB, 1,000 virtual ones with dense depth 18. Beyond ``IN_MEMORY_BYTES`` they are mapped from files without names in
# the folder of the fit: the system keeps as much of them in memory as it can spare.

IN_MEMORY_BYTES = GIB
FILE_BYTES = GIB // 4


def keep(loaded: LoadedViews, count: int, folder: Path | None) -> Sequence[StoredView]:
    """The views in their places: the first in memory, others mapped from files in ``folder`` (None: all in memory).
    ResourceError: the disk has no room for them."""
    places, total, left = dict[int, StoredView](), 0, np.zeros(0, np.uint8)
    with contextlib.closing(loaded) as pairs:
        for index, stored in pairs:
            places[index] = stored
            own = {name: plane for name, plane in vars(stored).items() if isinstance(plane, np.ndarray)}
            if stored.lidar is not None:
                own |= {name: values.numpy() for name, values in vars(stored.lidar).items()}
            room = {name: -(-plane.nbytes // 8) * 8 for name, plane in own.items()}
            size, before = sum(room.values()), total
            total += size
            if folder is None or total <= IN_MEMORY_BYTES:
                continue
            if before <= IN_MEMORY_BYTES:
                log.info(f"views: more than fit into memory are kept in files without names in {folder}")
            if size > len(left):
                left = np.asarray(mapped_array(folder, (max(FILE_BYTES, size),), np.uint8))
            for name, plane in own.items():
                place, left = left[: plane.nbytes].view(plane.dtype).reshape(plane.shape), left[room[name] :]
                place[...] = plane
                own[name] = place
            if stored.lidar is not None:
                own["lidar"] = LidarPixels(*(torch.from_numpy(own.pop(name)) for name in vars(stored.lidar)))
            places[index] = replace(stored, **own)
    return tuple(places[index] for index in range(count))


# ---- halved --------------------------------------------------------------------------------------
#
# Virtual views at half their size, for the steps of a fit that need no more: their finest structure is blurred by the
# diffusion model and teaches a scene little (docs/research/supervision.md), and a step costs about as much per pixel as
# it costs per Gaussian.

LEAST_PX: Final = 96
"""No side of a halved view is shorter: smaller views stay as they are."""


class HalvedViews:
    """Gives the steps up to ``until`` virtual views at half their size; of views above ``WHOLE_PIXELS`` all steps, for
    want of memory. ``until``: 0 leaves every view as it is. Halved views stay in memory, a quarter of what the views
    themselves take, up to a quarter of ``IN_MEMORY_BYTES`` of colours."""

    def __init__(self, until: float) -> None:
        self._until, self._room = until, IN_MEMORY_BYTES // 4
        self._kept: dict[str, StoredView] = {}

    def sized(self, view: StoredView, step: int) -> StoredView:
        """The view as a step is to see it."""
        height, width = view.rgb.shape[:2]
        until = math.inf if self._until and height * width > WHOLE_PIXELS else self._until
        if view.kind == "recorded" or step > until:
            return view
        made = self._kept.get(view.name) or halved(view)
        if view.name not in self._kept and made.rgb.nbytes <= self._room:
            self._kept[view.name], self._room = made, self._room - made.rgb.nbytes
        return made


def halved(view: StoredView) -> StoredView:
    """The view at half its size: colours and confidence are means, labels and depth those of the nearest pixel. A pixel
    is masked where any of those that it is made of is."""
    tall, wide = view.rgb.shape[:2]
    height, width = tall // 2, wide // 2
    if min(height, width) < LEAST_PX:
        return view
    planes: dict[str, Any] = {"rgb": resize_area(view.rgb, width, height), "view": view.view.resized(width, height)}
    for name in ("channels", "sky", "depth"):
        plane = getattr(view, name)
        planes[name] = None if plane is None else resize_nearest(plane, height, width)
    if view.mask is not None:
        planes["mask"] = resize_area(view.mask.astype(np.uint8) * 255, width, height) == 255
    if view.confidence is not None:
        planes["confidence"] = resize_area(view.confidence, width, height)
    if view.lidar is not None:  # every measurement, in the pixel that it falls into
        row, column = view.lidar.pixel // wide, view.lidar.pixel % wide
        row, column = (2 * row + 1) * height // (2 * tall), (2 * column + 1) * width // (2 * wide)
        planes["lidar"] = LidarPixels(row * width + column, view.lidar.depth_m)
    return replace(view, **planes)
