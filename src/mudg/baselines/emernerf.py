"""The fit of a radiance field (method emernerf): two batches of rays per step, one of pixels and one of LiDAR, each
with its own gradient step. OUT holds model.json and field.safetensors; else as ``gaussians/fit.py``."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from mudg.base import checkpoint, geometry, log, records, seeds, store
from mudg.base.devices import memory_of
from mudg.base.errors import InputError
from mudg.base.processes import one_torch_thread
from mudg.base.records import understood
from mudg.base.run_folder import RunDir
from mudg.base.types import Observation, Scene, View
from mudg.baselines import emernerf_field as fields
from mudg.core.pictures import panels_of, resize_area
from mudg.gaussians.rendering import COVERED
from mudg.gaussians.schedule import FiniteCheck, Progress, run_steps
from mudg.gaussians.settings import FitConfig
from mudg.gaussians.storage import RADIANCE, description_of, kind_of
from mudg.gaussians.views import StoredView, load_recorded, training_frames
from mudg.scene.read import read_points, read_scene

# rays ---------------------------------------------------------------------------------------------

MOST_LIDAR_RAYS = 8_000_000
NEAREST_RETURN_M = 0.5
AROUND_CAMERAS_M = 60.0
ERROR_CELL_PX = 8
ERROR_KEPT = 0.7
BOX_PERCENTILES = (2.0, 98.0)


LidarRays = tuple[fields.Rays, Tensor]
"""LiDAR measurements: rays with times in seconds f64[M, 1], and their ranges f32[M] in metres."""


def lidar_rays(scene: Scene) -> LidarRays | None:
    """All returns of all sweeps; None where there are none. Each has its own time and, along the vehicle's path, its
    own origin."""
    share = 1.0
    parts: list[tuple[np.ndarray, ...]] = []
    along_path = lambda t: [np.interp(t, scene.ego.times_s, axis) for axis in scene.ego.world_from_ego[:, :3, 3].T]
    for sweep in log.progress(scene.sweeps, len(scene.sweeps), "reading LiDAR rays"):
        points = read_points(scene, sweep)
        share = min(share, MOST_LIDAR_RAYS / max(1, len(points.xyz) * len(scene.sweeps)))
        kept = slice(None, None, max(1, round(1 / share)))
        world = geometry.transform_points(sweep.world_from_lidar, points.xyz[kept]).astype(np.float64)
        time_s = sweep.time_s + points.dt_s[kept].astype(np.float64)
        moved = [now - then for now, then in zip(along_path(time_s), along_path(sweep.time_s))]
        origins = sweep.world_from_lidar[:3, 3] + np.stack(moved, -1)
        along = world - origins
        far = np.linalg.norm(along, axis=1)
        good = far > NEAREST_RETURN_M
        parts.append((origins[good], along[good] / far[good, None], far[good], time_s[good]))
    if not sum(len(part[0]) for part in parts):
        return None
    origins, directions, range_m, time_s = (torch.from_numpy(np.concatenate(column)) for column in zip(*parts))
    cameras = torch.zeros(len(range_m), dtype=torch.int64)
    return fields.Rays(origins.float(), directions.float(), time_s[:, None], cameras), range_m.float()


def extent_of(scene: Scene, lidar: LidarRays | None) -> fields.Extent:
    """The box of the LiDAR points (without the outermost 2 % along every axis), and the time of the log."""
    if lidar is None:
        places = np.stack([frame.view.center_world for frame in scene.frames])
        low, high = places.min(0) - AROUND_CAMERAS_M, places.max(0) + AROUND_CAMERAS_M
        reach = f"the inner box reaches {AROUND_CAMERAS_M:.0f} m around the cameras"
        log.warn(f"no LiDAR: {reach}, and nothing measures distance")
    else:
        rays, range_m = lidar
        points = (rays.origins + range_m[:, None] * rays.directions).numpy()
        low, high = np.percentile(points, BOX_PERCENTILES, axis=0)
    center, half = (low + high) / 2, np.maximum((high - low) / 2, 1.0)
    times = np.array(sorted({frame.view.time_s for frame in scene.frames}))
    own = np.array([frame.view.time_s for frame in scene.frames_of(scene.frames[0].view.camera.name)])
    gaps = np.diff(np.sort(own))
    start, end = times.min(), times.max()
    step = float(np.median(gaps)) if len(gaps) else 0.1
    return fields.Extent(
        tuple(center.tolist()), tuple(half.tolist()), float(start), float(max(end - start, step)), step
    )


def view_rays(view: View, extent: fields.Extent, camera: int) -> tuple[fields.Rays, Tensor]:
    """A ray for every pixel, row by row, and the camera depth of each ray's unit length ``[R]``."""
    x, y = (torch.from_numpy(values.astype(np.float32)) for values in geometry.pixel_rays(view.camera))
    shape = len(y), len(x)
    plane = torch.stack([x.expand(shape), y[:, None].expand(shape), torch.ones(shape)], -1).reshape(-1, 3)
    poses = torch.tensor(view.world_from_cam, dtype=torch.float32).expand(len(plane), 4, 4)
    times = torch.full((len(plane), 1), extent.normalised(view.time_s))
    cameras = torch.full((len(plane),), camera, dtype=torch.int64)
    return _rays(plane, poses, times, cameras), 1 / plane.norm(dim=1)


def _rays(plane: Tensor, poses: Tensor, times: Tensor, cameras: Tensor) -> fields.Rays:
    along = (poses[:, :3, :3] * plane[:, None, :]).sum(2)
    return fields.Rays(poses[:, :3, 3], along / along.norm(dim=1, keepdim=True), times, cameras)


class Pixels:
    """All pixels of recorded views, and how badly they are met so far. ``cameras``: names; a ray carries the number of
    its camera."""

    def __init__(self, views: Sequence[StoredView], cameras: Sequence[str], extent: fields.Extent) -> None:
        sizes = [view.rgb.shape[:2] for view in views]
        self._starts = torch.tensor([0, *np.cumsum([h * w for h, w in sizes])])
        self._sizes = torch.tensor(sizes)
        self._cells = (self._sizes + ERROR_CELL_PX - 1) // ERROR_CELL_PX
        self._cell_starts = torch.cat([torch.zeros(1, dtype=torch.int64), self._cells.prod(1).cumsum(0)])
        self.errors = torch.ones(int(self._cell_starts[-1]))
        self._rgb = torch.from_numpy(np.concatenate([view.rgb.reshape(-1, 3) for view in views]))
        masks = [np.ones(s, bool) if view.mask is None else view.mask for view, s in zip(views, sizes)]
        self._counts = torch.from_numpy(np.concatenate([mask.reshape(-1) for mask in masks]))
        skies = [np.asarray(view.sky, bool).reshape(-1) for view in views if view.sky is not None]
        self.sky = torch.from_numpy(np.concatenate(skies)) if len(skies) == len(views) else None  # known in all views
        self._poses = torch.from_numpy(np.stack([view.view.world_from_cam for view in views])).float()
        self._lenses = torch.tensor([view.view.camera.intrinsics for view in views], dtype=torch.float32)
        self._times = torch.tensor([[extent.normalised(view.view.time_s)] for view in views])
        self._cameras = torch.tensor([cameras.index(view.view.camera.name) for view in views])

    def batch(
        self, count: int, error_share: float, generator: torch.Generator
    ) -> tuple[fields.Rays, tuple[Tensor, Tensor, Tensor | None], Tensor]:
        """``count`` pixels, a share of them drawn where the error was large: rays; colours f32[R, 3], whether they
        count f32[R] and sky bool[R] or None; and cells of the error map i64[R]."""
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
        sky = None if self.sky is None else self.sky[pixel]
        return rays, (self._rgb[pixel].float() / 255, self._counts[pixel].float(), sky), cell

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


# views of a field ---------------------------------------------------------------------------------

RAYS_AT_ONCE = 2048
PREVIEW_RAYS = 6000


@torch.no_grad()
def observe(field: fields.RadianceField, view: View, budget: fields.Budget, source: str = "") -> Observation:
    """One view as an observation of kind "virtual", on the CPU, without classes; depth is that of the median. Where
    opacity is below ``COVERED`` there is no depth."""
    camera, parts = view.camera, []
    rays, z_per_m = view_rays(
        view, field.extent, field.cameras.index(camera.name) if camera.name in field.cameras else 0
    )
    for begin in range(0, len(rays), RAYS_AT_ONCE):
        part = rays[begin : begin + RAYS_AT_ONCE].to(field.device)
        marched = fields.march(field, part, budget)
        rest = torch.stack([marched.median_m, marched.opacity], 1)
        parts.append(torch.cat([fields.colors(field, part, marched)[0], rest], 1).cpu())
    seen = torch.cat(parts).view(camera.height, camera.width, 5).permute(2, 0, 1)
    depth, opacity = seen[3:4] * z_per_m.view(1, camera.height, camera.width), seen[4:5]
    covered, opacity = opacity >= COVERED, opacity.clamp(0, 1)
    depth, sure = torch.where(covered, depth, torch.nan), torch.where(covered, opacity, 1 - opacity)
    return Observation(view, seen[:3].clamp(0, 1), depth, None, sure, torch.ones_like(covered), "virtual", source)


def write_preview(field: fields.RadianceField, stored: StoredView, budget: fields.Budget, path: Path) -> None:
    """A picture of three panels, coarser than the view: truth, colour, depth."""
    camera = stored.view.camera
    share = min(1.0, (PREVIEW_RAYS / (camera.width * camera.height)) ** 0.5)
    view = stored.view.resized(*(max(1, round(size * share)) for size in (camera.width, camera.height)))
    truth = resize_area(stored.rgb, view.camera.width, view.camera.height)
    store.write_image(path, np.concatenate([truth, *panels_of(observe(field, view, budget))], 1))


# on disk ------------------------------------------------------------------------------------------


def save_field(field: fields.RadianceField, budget: fields.Budget, folder: Path) -> None:
    """Field and sampling, without optimiser moments."""
    description = {"schema": 1, "kind": RADIANCE, **field.description(), "budget": asdict(budget)}
    store.write_json(folder / "model.json", description)
    store.write_safetensors(folder / "field.safetensors", {k: value.cpu() for k, value in field.state_dict().items()})


def load_field(folder: Path) -> tuple[fields.RadianceField, fields.Budget]:
    """Inverse of ``save_field``. InputError: not the folder of a finished fit of a radiance field. IntegrityError: a
    file was altered."""
    folder = Path(folder)
    if kind_of(folder) != RADIANCE:
        expected = "made by `mudg fit --method emernerf`"
        raise InputError("this folder holds no radiance field", where=str(folder), expected=expected)
    if (folder / store.MANIFEST).is_file():
        store.verify_manifest(folder)
    values, tensors = description_of(folder), store.read_tensors(folder / "field.safetensors")
    with understood("a radiance field", str(folder)):
        budget = records.parse_dataclass(fields.Budget, values["budget"], "budget: ")
        return fields.RadianceField.from_state(values, tensors), budget


# fit ----------------------------------------------------------------------------------------------

WARM_UP = 0.1
FALLS_AT, FALL = (0.25, 0.5, 0.75, 0.9), 0.33
RATE, BETAS, EPSILON, WEIGHT_DECAY = 0.01, (0.9, 0.99), 1e-15, 1e-5
"""Of Adam. The rate rises over the first WARM_UP of the run and falls at the shares FALLS_AT; the decay is added to the
gradient."""
PROPOSALS_EVERY = 5
"""After the warm-up the proposal networks learn at every n-th step only."""
ERROR_SHARE = 0.25
"""Share of the pixels that are drawn where the colour error was large."""
NEAR_M, FAR_M = 0.1, 1000.0
BUDGETS: Final[Mapping[str, fields.Budget]] = {
    "small": fields.Budget((64, 32), 32, NEAR_M, FAR_M),
    "published": fields.Budget((128, 64), 64, NEAR_M, FAR_M),
    "tiny": fields.Budget((16, 12), 8, NEAR_M, FAR_M),
}
"""Samples of a ray, by setting."""
BATCHES: Final[Mapping[str, tuple[int, int]]] = {"small": (512, 256), "published": (8192, 8192), "tiny": (48, 24)}
"""Pixels, and LiDAR rays, of a step, by setting."""
DYNAMIC_WEIGHT = 0.002
"""Of the dynamic density (published: 0.01, at once)."""
SIGHT_START, SIGHT_M, SIGHT_LEAST_M, SIGHT_HALVES = 0.08, 6.0, 0.6, 0.2
"""Share of the run before the line of sight counts; half width of its surface then, and at the end (published: 2.5 m);
share of the run in which it halves."""
DYNAMIC_RISE = (0.1, 0.5)
"""Shares of the run between which the weight of the dynamic density grows. From the first step on it would empty that
field."""


@dataclass
class RadianceState(Progress):
    """Everything that changes while fitting, and what it is fitted to."""

    field: fields.RadianceField
    optimisers: tuple[torch.optim.Adam, torch.optim.Adam]  # of the fields, and of the proposal networks
    pixels: Pixels
    lidar: LidarRays | None
    shown: StoredView

    def summary(self) -> dict[str, Any]:
        """For run.json."""
        count = sum(value.numel() for value in self.field.parameters())
        return {"parameters": count, "steps": self.step, "seconds": round(self.seconds, 2), **(self.last or {})}


def fit_radiance(config: FitConfig, scene: Path, device: torch.device, folder: RunDir) -> dict[str, Any]:
    """Fit a field to a scene and write it to the folder; an interrupted fit goes on from its newest checkpoint. Returns
    a summary."""
    with one_torch_thread(), memory_of(device, "fit"):
        state = prepare(config, read_scene(scene), folder, device)
        optimise(state, config, folder)
    save_field(state.field, BUDGETS[config.radiance.size], folder.path)
    shutil.rmtree(folder.path / "steps", ignore_errors=True)
    return state.summary()


def prepare(config: FitConfig, scene: Scene, folder: RunDir, device: torch.device) -> RadianceState:
    """Read what is fitted to, and start from the newest checkpoint or from nothing."""
    frames = training_frames(scene, config.cameras)
    cameras = tuple(dict.fromkeys(frame.view.camera.name for frame in frames))
    lidar = lidar_rays(scene)
    extent = extent_of(scene, lidar)
    places = dict(load_recorded(scene, frames, (), config.width_px, False))
    views = [places[index] for index in range(len(frames))]
    pixels = Pixels(views, cameras, extent)
    if pixels.sky is None:
        log.info("the sky of this scene is not labelled: fitted without the sky term")
    facts = {"method": config.method, "scene": scene.id}
    field = fields.RadianceField(fields.SIZES[config.radiance.size], extent, cameras, facts, config.seed).to(device)
    proposals = list(field.proposals.parameters())
    own = {id(value) for value in proposals}
    fused = device.type in ("cpu", "cuda")
    of_fields, of_proposals = (
        torch.optim.Adam(given, RATE, BETAS, EPSILON, WEIGHT_DECAY, fused=fused, foreach=None if fused else False)
        for given in ([value for value in field.parameters() if id(value) not in own], proposals)
    )
    state = RadianceState(field, (of_fields, of_proposals), pixels, lidar, views[len(views) // 2])
    found = checkpoint.latest(folder.path / "steps")
    if found is not None:
        log.info(f"resuming at step {found.step} of {config.iterations}")
        _restore(state, found)
    return state


# ---- a step --------------------------------------------------------------------------------------


def optimise(state: RadianceState, config: FitConfig, folder: RunDir) -> None:
    """Fit up to step ``config.iterations``. Same inputs, same result, also across an interruption."""

    def take(step: int) -> tuple[dict[str, Any], partial[dict[str, float]]]:
        return {}, partial(_numbers, take_step(state, config, step))

    draw = lambda path: write_preview(state.field, state.shown, BUDGETS[config.radiance.size], path)
    run_steps(state, config, folder, take, lambda: save_checkpoint(state, folder), draw)


def take_step(state: RadianceState, config: FitConfig, step: int) -> dict[str, Tensor]:
    """A gradient step from pixels and one from LiDAR rays; the weighted loss terms of both."""
    field, device = state.field, state.field.device
    budget, (pixels, returns) = BUDGETS[config.radiance.size], BATCHES[config.radiance.size]
    dynamic = DYNAMIC_WEIGHT * dynamic_share(step, config.iterations)
    learns = step <= WARM_UP * config.iterations or step % PROPOSALS_EVERY == 0
    for optimiser in state.optimisers:
        for group in optimiser.param_groups:
            group["lr"] = RATE * rate_share(step, config.iterations)

    generator = seeds.torch_generator(config.seed, step, "radiance pixels")
    given, (rgb, counts, sky), cells = state.pixels.batch(pixels, ERROR_SHARE, generator)
    marched, draws, rays = _marched(field, given, budget, generator, learns)
    truth = rgb.to(device), counts.to(device), None if sky is None else sky.to(device)
    terms, error = fields.pixel_terms(field, rays, marched, draws, truth, dynamic)
    _learn(state, terms, marched, learns, step, "of pixels")
    state.pixels.note(cells, error)
    if state.lidar is None:
        return terms

    generator = seeds.torch_generator(config.seed, step, "radiance lidar")
    every, ranges = state.lidar
    chosen = torch.randint(0, len(every), (returns,), generator=generator)
    given, range_m = every[chosen], ranges[chosen]
    times = ((given.times - field.extent.start_s) / field.extent.span_s).clamp(0, 1)
    given = replace(given, times=times.float())
    marched, draws, _ = _marched(field, given, budget, generator, learns)
    sight_m = sight_width(step, config.iterations)
    measured = fields.lidar_terms(field, marched, draws, range_m.to(device), dynamic, sight_m)
    _learn(state, measured, marched, learns, step, "of LiDAR")
    return terms | {name if name not in terms else f"{name}_lidar": value for name, value in measured.items()}


def _marched(
    field: fields.RadianceField, rays: fields.Rays, budget: fields.Budget, generator: torch.Generator, learns: bool
) -> tuple[fields.Marched, fields.RayDraws, fields.Rays]:
    """A training batch on the device: marched, with what was drawn for it. The one way there."""
    there = rays.to(field.device)
    draws = fields.RayDraws.of(len(rays), budget, generator, field.device)
    return fields.march(field, there, budget, draws, learns), draws, there


def _learn(
    state: RadianceState, terms: Mapping[str, Tensor], marched: fields.Marched, learns: bool, step: int, view: str
) -> None:
    """One step of the optimisers down the sum of the terms; NumericsError before that if something is not finite."""
    check, clear = FiniteCheck(step), state.field.zero_grad
    remedy = "the parameters are those of the step before; another --seed draws other rays"
    every = {**terms, **({"proposals": fields.proposal_loss(marched)} if learns else {})}
    check.terms(view, every)
    clear()
    torch.stack(list(every.values())).sum().backward()
    named = {name: value.grad for name, value in state.field.named_parameters() if value.grad is not None}
    check.sums(view, named, remedy, clear)
    check.refuse()
    for optimiser in state.optimisers[: 2 if learns else 1]:
        optimiser.step()


def rate_share(step: int, iterations: int) -> float:
    """Learning rate of a step (from 1) as a share of the full one."""
    rising = min(1.0, step / max(1.0, WARM_UP * iterations))
    return rising * FALL ** sum(step > share * iterations for share in FALLS_AT)


def dynamic_share(step: int, iterations: int) -> float:
    """Weight of the dynamic density at a step as a share of the full one."""
    first, last = DYNAMIC_RISE
    return min(1.0, max(0.0, (step / iterations - first) / max(last - first, 1e-9)))


def sight_width(step: int, iterations: int) -> float:
    """Half width of the surface in the line-of-sight term at a step, metres; 0 before it begins."""
    since = step / iterations - SIGHT_START
    return 0.0 if since <= 0 else max(SIGHT_LEAST_M, SIGHT_M * 0.5 ** math.floor(since / SIGHT_HALVES))


def _numbers(terms: Mapping[str, Tensor]) -> dict[str, float]:
    values = torch.stack([value.detach() for value in terms.values()]).tolist()
    named = {f"loss_{name}": round(value, 7) for name, value in zip(terms, values)}
    return {"psnr": round(-10 * math.log10(max(named["loss_color"], 1e-10)), 3), **named}


def save_checkpoint(state: RadianceState, folder: RunDir) -> None:
    """All that changes: parameters, moments, the error map, the step."""
    field = {name: value.cpu() for name, value in state.field.state_dict().items()}
    moments = {
        f"{kind}.{name}": moment.detach().cpu()
        for name, value in state.field.named_parameters()
        for optimiser in state.optimisers
        for kind, moment in optimiser.state.get(value, {}).items()
    }
    groups = {"field": field, "moments": moments, "errors": {"errors": state.pixels.errors}}
    checkpoint.save(folder.path / "steps", state.step, groups, state.facts())


def _restore(state: RadianceState, found: checkpoint.Checkpoint) -> None:
    state.field.load_state_dict(found.tensors("field"))
    moments = found.tensors("moments")
    for name, value in state.field.named_parameters():
        own = {kind: moments.get(f"{kind}.{name}") for kind in ("step", "exp_avg", "exp_avg_sq")}
        for optimiser in state.optimisers:
            if own["step"] is not None and any(value is one for one in optimiser.param_groups[0]["params"]):
                optimiser.state[value] = {kind: tensor.to(value.device) for kind, tensor in own.items()}
    state.pixels.errors = found.tensors("errors")["errors"]
    state.resume(found)
