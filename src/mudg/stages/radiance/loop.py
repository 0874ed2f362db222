"""The fit of a radiance field (method emernerf): two batches of rays per step, one of pixels and one of LiDAR, each with its own gradient
step.

    OUT/model.json, field.safetensors    the field (``storage.py``)
    OUT/preview/*.png                    truth, colour, depth, what moves, flow
    OUT/log.jsonl, steps/                how it went; checkpoints, while it runs
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mudg.base import checkpoint, log
from mudg.base.devices import memory_of
from mudg.base.errors import NumericsError
from mudg.base.processes import Interruption, one_torch_thread
from mudg.base.run_folder import RunDir
from mudg.base.types import Scene
from mudg.models.radiance.field import FieldSizes, RadianceField
from mudg.models.radiance.march import (
    Budget,
    Marched,
    RayDraws,
    Rays,
    Weights,
    lidar_terms,
    march,
    pixel_terms,
    proposal_loss,
)
from mudg.stages.config import FitConfig
from mudg.stages.config.radiance import RadianceConfig
from mudg.stages.fitting.views import StoredView, training_frames
from mudg.stages.radiance.pictures import write_preview
from mudg.stages.radiance.rays import LidarRays, Pixels, batch_generator, extent_of, lidar_rays, recorded_pixels
from mudg.stages.radiance.storage import save_field

WARM_UP = 0.1
FALLS_AT, FALL = (0.25, 0.5, 0.75, 0.9), 0.33
RATE, BETAS, EPSILON, WEIGHT_DECAY = 0.01, (0.9, 0.99), 1e-15, 1e-5
"""Of Adam. The rate rises over the first WARM_UP of the run and falls at the shares FALLS_AT; the decay is added to the gradient."""
PROPOSALS_EVERY = 5
"""After the warm-up the proposal networks learn at every n-th step only."""
ERROR_SHARE = 0.25
"""Share of the pixels that are drawn where the colour error was large."""
NEAR_M, FAR_M = 0.1, 1000.0
"""Distances of the nearest and of the farthest sample."""
APPEARANCE = 16
"""Numbers that describe the appearance of a camera."""
WEIGHTS = Weights(sky=0.001, lidar=1.0, sight=0.1, dynamic=0.002, shadow=0.01, cycle=0.01)
"""Published, but for the dynamic density: 0.01, at once."""
SIGHT_START, SIGHT_M, SIGHT_LEAST_M, SIGHT_HALVES = 0.08, 6.0, 0.6, 0.2
"""Share of the run before the line of sight counts; half width of its surface then, and at the end (published: 2.5 m); share of the run in
which it halves."""
DYNAMIC_RISE = (0.1, 0.5)
"""Shares of the run between which the weight of the dynamic density grows. From the first step on it would empty that field."""
LOG_EVERY = 20


@dataclass
class RadianceState:
    """Everything that changes while fitting, and what it is fitted to."""

    field: RadianceField
    optimisers: tuple[torch.optim.Adam, torch.optim.Adam]
    """Of the fields, and of the proposal networks."""
    pixels: Pixels
    lidar: LidarRays | None
    shown: StoredView
    step: int = 0
    seconds: float = 0.0
    last: Mapping[str, float] | None = None

    def summary(self) -> dict[str, Any]:
        """For run.json."""
        count = sum(value.numel() for value in self.field.parameters())
        return {"parameters": count, "steps": self.step, "seconds": round(self.seconds, 2), **(self.last or {})}


def fit_radiance(config: FitConfig, scene: Scene, folder: RunDir, device: torch.device) -> dict[str, Any]:
    """Fit a field to a scene and write it to the folder; an interrupted fit goes on from its newest checkpoint. Returns a summary."""
    with one_torch_thread(), memory_of(device, "fit"):
        state = prepare(config, scene, folder, device)
        optimise(state, config, folder)
    budget = budget_of(config.radiance)
    write_preview(state.field, state.shown, budget, folder.path / "preview" / "final.png", whole=True)
    save_field(state.field, budget, folder.path)
    shutil.rmtree(folder.path / "steps", ignore_errors=True)
    return state.summary()


def prepare(config: FitConfig, scene: Scene, folder: RunDir, device: torch.device) -> RadianceState:
    """Read what is fitted to, and start from the newest checkpoint or from nothing."""
    frames = training_frames(scene, config.cameras)
    cameras = tuple(dict.fromkeys(frame.view.camera.name for frame in frames))
    lidar = lidar_rays(scene)
    extent = extent_of(scene, lidar)
    pixels, shown = recorded_pixels(scene, frames, config.width_px, cameras, extent)
    if not pixels.sky_known:
        log.info("the sky of this scene is not labelled: fitted without the sky term")
    facts = {"method": config.method, "scene": scene.id}
    field = RadianceField(sizes_of(config.radiance), extent, cameras, facts, config.seed).to(device)
    state = RadianceState(field, _optimisers(field), pixels, lidar, shown)
    found = checkpoint.latest(folder.path / "steps")
    if found is not None:
        log.info(f"resuming at step {found.step} of {config.iterations}")
        _restore(state, found)
    return state


def sizes_of(settings: RadianceConfig) -> FieldSizes:
    """The sizes of the networks."""
    proposals = (settings.first_proposal_grid, settings.second_proposal_grid)
    return FieldSizes(settings.static_grid, settings.dynamic_grid, settings.flow_grid, proposals, settings.width,
                      settings.proposal_width, APPEARANCE)  # fmt: skip


def budget_of(settings: RadianceConfig) -> Budget:
    """The samples of a ray."""
    return Budget(settings.proposal_samples, settings.samples, NEAR_M, FAR_M)


# ---- the loop --------------------------------------------------------------------------------------------------------


def optimise(state: RadianceState, config: FitConfig, folder: RunDir) -> None:
    """Fit up to step ``config.iterations``. Same inputs, same result, also across an interruption."""
    pace = checkpoint.Pace()
    with log.task(f"fit {config.method}", config.iterations, state.step) as bar, Interruption() as interruption:
        while state.step < config.iterations:
            began, step = time.perf_counter(), state.step + 1
            terms = take_step(state, config, step)
            state.step, state.seconds = step, state.seconds + time.perf_counter() - began
            if step % LOG_EVERY == 0 or step == config.iterations:
                state.last = _progress(terms)
                folder.log(step=step, seconds=round(state.seconds, 3), **state.last)
                bar.update(f"psnr {state.last['psnr']:.1f}")
            if step % config.preview_every == 0 and step < config.iterations:
                write_preview(
                    state.field, state.shown, budget_of(config.radiance), folder.path / "preview" / f"{step:06d}.png"
                )
            if interruption.requested or (step % config.checkpoint_every == 0 and pace.due()):
                with pace.saving():
                    save_checkpoint(state, folder)
            bar.advance()
            if interruption.requested:
                folder.pause(state.summary())
                interruption.stop_now()


def take_step(state: RadianceState, config: FitConfig, step: int) -> dict[str, Tensor]:
    """A gradient step from pixels and one from LiDAR rays; the weighted loss terms of both."""
    settings, field = config.radiance, state.field
    device, budget = field.device, budget_of(settings)
    weights = replace(WEIGHTS, dynamic=WEIGHTS.dynamic * dynamic_share(step, config.iterations))
    learns = step <= WARM_UP * config.iterations or step % PROPOSALS_EVERY == 0
    for optimiser in state.optimisers:
        for group in optimiser.param_groups:
            group["lr"] = RATE * rate_share(step, config.iterations)

    generator = batch_generator(config.seed, step, "pixels")
    batch = state.pixels.batch(settings.rays, ERROR_SHARE, generator)
    marched, draws, rays = _marched(field, batch.rays, budget, generator, learns)
    sky = None if batch.sky is None else batch.sky.to(device)
    terms, error = pixel_terms(
        field, rays, marched, draws, (batch.rgb.to(device), batch.counts.to(device), sky), weights
    )
    _learn(state, terms, marched, learns, f"step {step}, pixels")
    state.pixels.note(batch.cells, error)
    if state.lidar is None:
        return terms

    generator = batch_generator(config.seed, step, "lidar")
    given, range_m = state.lidar.batch(settings.lidar_rays, field.extent, generator)
    marched, draws, _ = _marched(field, given, budget, generator, learns)
    sight_m = sight_width(step, config.iterations)
    measured = lidar_terms(field, marched, draws, range_m.to(device), weights, sight_m)
    _learn(state, measured, marched, learns, f"step {step}, LiDAR")
    return terms | {name if name not in terms else f"{name}_lidar": value for name, value in measured.items()}


def _marched(
    field: RadianceField, rays: Rays, budget: Budget, generator: torch.Generator, learns: bool
) -> tuple[Marched, RayDraws, Rays]:
    """A training batch on the device: marched, with what was drawn for it. The one way there."""
    there = rays.to(field.device)
    draws = RayDraws.of(len(rays), budget, generator, field.device)
    return march(field, there, budget, draws, learns), draws, there


def _learn(state: RadianceState, terms: Mapping[str, Tensor], marched: Marched, learns: bool, where: str) -> None:
    """One step of the optimisers down the sum of the terms; NumericsError before that if something is not finite."""
    total = torch.stack(list(terms.values())).sum()
    total = total + proposal_loss(marched) if learns else total
    if not bool(torch.isfinite(total)):
        odd = [name for name, value in terms.items() if not bool(torch.isfinite(value))]
        raise NumericsError("a loss term is not finite", where=where, got=", ".join(odd) or "proposals",
                            remedy="the parameters are those of the step before; another --seed draws other rays")  # fmt: skip
    for optimiser in state.optimisers:
        optimiser.zero_grad(set_to_none=True)
    total.backward()
    named = [(name, value.grad) for name, value in state.field.named_parameters() if value.grad is not None]
    sums = torch.stack([gradient.sum() for _, gradient in named])
    if not bool(torch.isfinite(sums).all()):
        odd = [name for name, gradient in named if not bool(torch.isfinite(gradient).all())]
        if odd:
            raise NumericsError("a gradient is not finite", where=where, got=", ".join(odd[:3]),
                                remedy="the parameters are those of the step before; another --seed draws other rays")  # fmt: skip
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


def _progress(terms: Mapping[str, Tensor]) -> dict[str, float]:
    values = torch.stack([value.detach() for value in terms.values()]).tolist()
    named = {f"loss_{name}": round(value, 7) for name, value in zip(terms, values)}
    return {"psnr": round(-10 * math.log10(max(named["loss_color"], 1e-10)), 3), **named}


# ---- the optimisers, and checkpoints ---------------------------------------------------------------------------------


def _optimisers(field: RadianceField) -> tuple[torch.optim.Adam, torch.optim.Adam]:
    proposals = list(field.proposals.parameters())
    own = {id(value) for value in proposals}
    fused = field.device.type in ("cpu", "cuda")
    first, second = (
        torch.optim.Adam(
            given, RATE, BETAS, EPSILON, WEIGHT_DECAY, fused=fused, foreach=None if fused else False
        )
        for given in ([value for value in field.parameters() if id(value) not in own], proposals)
    )
    return first, second


def _moments(state: RadianceState) -> dict[str, Tensor]:
    made = {}
    for name, value in state.field.named_parameters():
        for optimiser in state.optimisers:
            for kind, moment in optimiser.state.get(value, {}).items():
                made[f"{kind}.{name}"] = moment.detach().cpu()
    return made


def save_checkpoint(state: RadianceState, folder: RunDir) -> None:
    """All that changes: parameters, moments, the error map, the step."""
    groups = {
        "field": {name: value.cpu() for name, value in state.field.state_dict().items()},
        "moments": _moments(state), "errors": {"errors": state.pixels.errors},
    }  # fmt: skip
    checkpoint.save(
        folder.path / "steps", state.step, groups, {"seconds": state.seconds, "last": dict(state.last or {})}
    )


def _restore(state: RadianceState, found: checkpoint.Checkpoint) -> None:
    state.field.load_state_dict(found.tensors("field"))
    moments = found.tensors("moments")
    for name, value in state.field.named_parameters():
        for optimiser in state.optimisers:
            if any(value is one for group in optimiser.param_groups for one in group["params"]):
                kept = {
                    kind: moments[f"{kind}.{name}"]
                    for kind in ("step", "exp_avg", "exp_avg_sq")
                    if f"{kind}.{name}" in moments
                }
                if kept:
                    optimiser.state[value] = {kind: tensor.to(value.device) for kind, tensor in kept.items()}
    state.pixels.errors = found.tensors("errors")["errors"]
    state.step, state.seconds, state.last = found.step, float(found.state["seconds"]), found.state["last"]
