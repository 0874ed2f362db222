"""What a radiance field learns from: pixels of recorded frames and LiDAR rays, as rays in the world. Tracked boxes are not read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mudg.base import geometry, log, seeds
from mudg.base.types import Frame, Scene, View
from mudg.data.scene import read_points
from mudg.models.radiance.field import Extent
from mudg.models.radiance.march import Rays
from mudg.stages.fitting.views import StoredView, load_recorded

MOST_LIDAR_RAYS = 8_000_000
NEAREST_RETURN_M = 0.5
AROUND_CAMERAS_M = 60.0
ERROR_CELL_PX = 8
ERROR_KEPT = 0.7
BOX_PERCENTILES = (2.0, 98.0)


@dataclass(frozen=True, eq=False)
class LidarRays:
    """M LiDAR measurements: origins and unit directions f32[M, 3], ranges f32[M] in metres, times f32[M] in seconds."""

    origins: Tensor
    directions: Tensor
    range_m: Tensor
    time_s: Tensor

    def __len__(self) -> int:
        return len(self.origins)

    def batch(self, count: int, extent: Extent, generator: torch.Generator) -> tuple[Rays, Tensor]:
        """``count`` of them, drawn with replacement, and their ranges."""
        chosen = torch.randint(0, len(self), (count,), generator=generator)
        times = ((self.time_s[chosen] - extent.start_s) / extent.span_s).clamp(0, 1)[:, None]
        rays = Rays(self.origins[chosen], self.directions[chosen], times.float(), torch.zeros(count, dtype=torch.int64))
        return rays, self.range_m[chosen]


def lidar_rays(scene: Scene) -> LidarRays | None:
    """All returns of all sweeps as rays; None where there are none. Each has its own time and, along the vehicle's path, its own origin."""
    share = 1.0
    parts: list[tuple[np.ndarray, ...]] = []
    for sweep in log.progress(scene.sweeps, len(scene.sweeps), "reading LiDAR rays"):
        points = read_points(scene, sweep)
        share = min(share, MOST_LIDAR_RAYS / max(1, len(points.xyz) * len(scene.sweeps)))
        kept = slice(None, None, max(1, round(1 / share)))
        world = geometry.transform_points(sweep.world_from_lidar, points.xyz[kept]).astype(np.float64)
        time_s = sweep.time_s + points.dt_s[kept].astype(np.float64)
        path, keys = scene.ego.world_from_ego[:, :3, 3], scene.ego.times_s
        moved = [
            np.interp(time_s, keys, path[:, axis]) - np.interp(sweep.time_s, keys, path[:, axis]) for axis in range(3)
        ]
        origins = sweep.world_from_lidar[:3, 3] + np.stack(moved, -1)
        along = world - origins
        far = np.linalg.norm(along, axis=1)
        good = far > NEAREST_RETURN_M
        parts.append((origins[good], along[good] / far[good, None], far[good], time_s[good]))
    if not sum(len(part[0]) for part in parts):
        return None
    columns = (torch.from_numpy(np.concatenate(column)) for column in zip(*parts))
    origins, directions, range_m, time_s = columns
    return LidarRays(origins.float(), directions.float(), range_m.float(), time_s)


def extent_of(scene: Scene, lidar: LidarRays | None) -> Extent:
    """The box of the LiDAR points (without the outermost 2 % along every axis), and the time of the log."""
    if lidar is None:
        places = np.stack([frame.view.center_world for frame in scene.frames])
        low, high = places.min(0) - AROUND_CAMERAS_M, places.max(0) + AROUND_CAMERAS_M
        log.warn(
            f"no LiDAR: the inner box reaches {AROUND_CAMERAS_M:.0f} m around the cameras, and nothing measures distance"
        )
    else:
        points = (lidar.origins + lidar.range_m[:, None] * lidar.directions).numpy()
        low, high = np.percentile(points, BOX_PERCENTILES, axis=0)
    center, half = (low + high) / 2, np.maximum((high - low) / 2, 1.0)
    times = np.array(sorted({frame.view.time_s for frame in scene.frames}))
    own = np.array([frame.view.time_s for frame in scene.frames_of(scene.frames[0].view.camera.name)])
    gaps = np.diff(np.sort(own))
    start, end = times.min(), times.max()
    step = float(np.median(gaps)) if len(gaps) else 0.1
    return Extent(tuple(center.tolist()), tuple(half.tolist()), float(start), float(max(end - start, step)), step)


def view_rays(view: View, extent: Extent, camera: int, stride: int = 1) -> tuple[Rays, Tensor]:
    """A ray for every (``stride``-th) pixel, row by row, and the camera depth of each ray's unit length ``[R]``."""
    x, y = (torch.from_numpy(values[::stride].astype(np.float32)) for values in geometry.pixel_rays(view.camera))
    plane = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x)), torch.ones(len(y), len(x))], -1).reshape(
        -1, 3
    )
    return _rays(plane, torch.tensor(view.world_from_cam, dtype=torch.float32).expand(len(plane), 4, 4),
                 torch.full((len(plane), 1), extent.normalised(view.time_s)),
                 torch.full((len(plane),), camera, dtype=torch.int64)), 1 / plane.norm(dim=1)  # fmt: skip


def _rays(plane: Tensor, poses: Tensor, times: Tensor, cameras: Tensor) -> Rays:
    along = (poses[:, :3, :3] * plane[:, None, :]).sum(2)
    return Rays(poses[:, :3, 3], along / along.norm(dim=1, keepdim=True), times, cameras)


@dataclass(frozen=True, eq=False)
class PixelBatch:
    """Rays of pixels with what they show: colours f32[R, 3], whether they count f32[R], sky bool[R] or None; cells of the error map."""

    rays: Rays
    rgb: Tensor
    counts: Tensor
    sky: Tensor | None
    cells: Tensor


class Pixels:
    """All pixels of the recorded views, and how badly they are met so far.

    Args:
        views: recorded; each needs an image.
        cameras: names; a ray carries the number of its camera.
    """

    def __init__(self, views: Sequence[StoredView], cameras: Sequence[str], extent: Extent) -> None:
        sizes = [view.rgb.shape[:2] for view in views]
        self._starts = torch.tensor([0, *np.cumsum([h * w for h, w in sizes])])
        self._sizes = torch.tensor(sizes)
        cells = (self._sizes + ERROR_CELL_PX - 1) // ERROR_CELL_PX
        self._cells = cells
        self._cell_starts = torch.cat([torch.zeros(1, dtype=torch.int64), cells.prod(1).cumsum(0)])
        self.errors = torch.ones(int(self._cell_starts[-1]))
        self._rgb = torch.from_numpy(np.concatenate([view.rgb.reshape(-1, 3) for view in views]))
        masks = [np.ones(s, bool) if view.mask is None else view.mask for view, s in zip(views, sizes)]
        self._counts = torch.from_numpy(np.concatenate([mask.reshape(-1) for mask in masks]))
        skies = [view.sky for view in views]
        known = all(sky is not None for sky in skies)
        self._sky = (
            torch.from_numpy(np.concatenate([np.asarray(sky, bool).reshape(-1) for sky in skies])) if known else None
        )
        self._poses = torch.from_numpy(np.stack([view.view.world_from_cam for view in views])).float()
        lenses = [view.view.camera.intrinsics for view in views]
        self._lenses = torch.tensor(lenses, dtype=torch.float32)
        self._times = torch.tensor([[extent.normalised(view.view.time_s)] for view in views])
        self._cameras = torch.tensor([cameras.index(view.view.camera.name) for view in views])

    @property
    def sky_known(self) -> bool:
        """Whether all views say where the sky is."""
        return self._sky is not None

    def batch(self, count: int, error_share: float, generator: torch.Generator) -> PixelBatch:
        """``count`` pixels, a share of them drawn where the error was large."""
        guided = round(count * error_share)
        draws = torch.rand(count, 3, generator=generator, dtype=torch.float64)
        even = (draws[guided:, 0] * float(self._starts[-1])).long()
        view = torch.searchsorted(self._starts, even, right=True) - 1
        inside = even - self._starts[view]
        width = self._sizes[view, 1]
        row, column = inside // width, inside % width
        if guided:
            found = self._badly_met(draws[:guided])
            view, row, column = (torch.cat(pair) for pair in zip(found, (view, row, column)))
        pixel = self._starts[view] + row * self._sizes[view, 1] + column
        cell = self._cell_starts[view] + (row // ERROR_CELL_PX) * self._cells[view, 1] + column // ERROR_CELL_PX
        fx, fy, cx, cy = self._lenses[view].unbind(1)
        plane = torch.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, torch.ones_like(fx)], 1)
        rays = _rays(plane, self._poses[view], self._times[view], self._cameras[view])
        sky = None if self._sky is None else self._sky[pixel]
        return PixelBatch(rays, self._rgb[pixel].float() / 255, self._counts[pixel].float(), sky, cell)

    def _badly_met(self, draws: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """View, row and column of pixels in cells drawn by their error."""
        upto = self.errors.double().cumsum(0)
        cell = torch.searchsorted(upto, draws[:, 0] * upto[-1], right=True).clamp(max=len(upto) - 1)
        view = torch.searchsorted(self._cell_starts, cell, right=True) - 1
        inside, across = cell - self._cell_starts[view], self._cells[view, 1]
        size = self._sizes[view]
        row = (inside // across * ERROR_CELL_PX + (draws[:, 1] * ERROR_CELL_PX).long()).minimum(size[:, 0] - 1)
        column = (inside % across * ERROR_CELL_PX + (draws[:, 2] * ERROR_CELL_PX).long()).minimum(size[:, 1] - 1)
        return view, row, column

    def note(self, cells: Tensor, error: Tensor) -> None:
        """Take the errors of a batch into the map (a moving average; of several pixels in a cell, the last)."""
        self.errors[cells] = ERROR_KEPT * self.errors[cells] + (1 - ERROR_KEPT) * error.cpu().sqrt()


def recorded_pixels(
    scene: Scene, frames: Sequence[Frame], width_px: int, cameras: Sequence[str], extent: Extent
) -> tuple[Pixels, StoredView]:
    """The pixels of these frames, and the middle view."""
    places = dict(load_recorded(scene, frames, (), width_px, False))
    views = [places[index] for index in range(len(frames))]
    return Pixels(views, cameras, extent), views[len(views) // 2]


def batch_generator(seed: int, step: int, purpose: str) -> torch.Generator:
    """What a batch is drawn with: a function of seed, step and purpose alone."""
    return seeds.torch_generator(seed, step, f"radiance {purpose}")
