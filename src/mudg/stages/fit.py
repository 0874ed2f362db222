"""fit: recorded frames (and virtual observations) in, a dynamic Gaussian scene out.

The loop is ``optimise`` and reads top to bottom. What it calls: ``fit_views`` (what a view is), ``fit_start`` (where the
Gaussians start), ``models.nodes.compose`` (the scene at a time), ``core.raster`` (the renderer), ``core.losses`` (every
loss), ``models.densify``. Nothing else touches the parameters.

    OUT/model.json, gaussians.safetensors, nodes.safetensors    the fitted scene (``load_model``)
    OUT/appearance.json, appearance.safetensors                 corrections of cameras and colours, where learnt
    OUT/log.jsonl, preview/*.png                                how it went
    OUT/steps/                                                  checkpoints, while it runs
"""

from __future__ import annotations

import contextlib
import math
import shutil
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from mudg.base import checkpoint, log, palette, seeds, store
from mudg.base.config import to_dict
from mudg.base.errors import InputError, NumericsError, UsageError
from mudg.base.run_folder import RunDir, VerbOutput, refuse_overlap
from mudg.base.types import FusedCloud, Gaussians, Observation, Render, Scene, View
from mudg.core import fused as kernels
from mudg.core import losses, metrics
from mudg.core.pictures import class_colors, depth_colors, to_bytes
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.data.cloudfile import read_fused
from mudg.data.scene import read_scene
from mudg.models.scene.appearance import Appearance
from mudg.models.scene.densify import DensifySettings, DensifyStats, densify, reset_opacity, shorten_needles
from mudg.models.scene.mcmc import McmcSettings, drift, relocate_and_grow
from mudg.models.scene.nodes import RigidNode, SceneModel, compose, composite_semantics, composite_sky, sky_lift
from mudg.stages.config import FitConfig
from mudg.stages.fitting.objects import boxes_in_view, objects_only
from mudg.stages.fitting.perception import Perception, perception_of
from mudg.stages.fitting.poses import refine_poses
from mudg.stages.fitting.start import StartSettings, start_model
from mudg.stages.fitting.trust import unseen_maps, unseen_rows
from mudg.stages.fitting.views import (
    Sample,
    StoredView,
    ViewSet,
    classes_of,
    fused_lidar,
    load_recorded,
    load_virtual,
    offsets_from_path_m,
    training_frames,
)

OUTPUT = VerbOutput(
    "fit", 1,
    ("model.json", "gaussians.safetensors", "nodes.safetensors", "appearance.json", "appearance.safetensors", "preview/*.png", "steps/"),
)  # fmt: skip
PUBLISHED_STEPS = 30_000
FARTHEST_VIRTUAL_DEPTH_M = 100.0
SHAPE_EVERY = 10
LAST_POSE_ROUND = 0.85
NEAR_M = 0.2
MCMC_OPACITY_WEIGHT, MCMC_SCALE_WEIGHT = 0.01, 0.001
"""Published: 0.01 each, the scale in a scene of unit size; learning rates here belong to scenes of 10 m."""


@dataclass(frozen=True)
class Recipe:
    """What a method consists of: nodes of the scene and kinds of supervision."""

    objects: bool
    sky: bool
    lidar: bool
    virtual: bool


RECIPES: dict[str, Recipe] = {
    "gs3d": Recipe(objects=False, sky=False, lidar=False, virtual=False),
    "street_gaussians": Recipe(objects=True, sky=True, lidar=True, virtual=False),
    "mudg_s": Recipe(objects=True, sky=True, lidar=True, virtual=True),
}


def run(
    config: FitConfig, scene: Path, fused: Path, out: Path, *, observations: Path | None = None, overwrite: bool = False
) -> Path:
    """Fit a scene.

    Args:
        config: method, iterations, weights.
        scene: scene directory (ingest).
        fused: fused clouds (fuse).
        out: folder for the model.
        observations: folder of virtual observation sets (synthesize); needed by methods that use them, ignored by others.

    Returns:
        ``out``, finished. An interrupted run continues when called again with the same arguments.

    Raises:
        UsageError: a method with virtual views without ``observations``. NumericsError: a loss or gradient is not
        finite. InputError: damaged inputs.
    """
    recipe = RECIPES[config.method]
    if recipe.virtual and observations is None:
        raise UsageError(f"{config.method} needs virtual observations", remedy="run `mudg synthesize` and hand its folder on")
    virtual = observations if recipe.virtual else None
    refuse_overlap(
        out, {"scene": scene, "fused": fused, "observations": observations, "lpips-weights": config.lpips_weights}
    )
    inputs = {"scene": store.digest(Path(scene)), "fused": store.digest(Path(fused))}
    if virtual is not None:
        inputs["observations"] = store.digest(Path(virtual))
    if config.lpips_weights:
        inputs["lpips_weights"] = store.digest(Path(config.lpips_weights))
    folder = RunDir.open(out, OUTPUT, to_dict(config), inputs, overwrite)
    if folder.complete:
        return folder.reused()
    with _one_torch_thread():
        state = _prepare(config, recipe, Path(scene), Path(fused), virtual, folder.path)
        optimise(state, config, folder)
    save_model(state.model, folder.path)
    save_appearance(state.appearance, folder.path)
    shutil.rmtree(folder.path / "steps", ignore_errors=True)
    folder.finish(state.summary())
    return folder.path


@dataclass
class FitState:
    """Everything that changes while fitting, and what it is fitted to."""

    model: SceneModel
    views: ViewSet
    stats: DensifyStats
    schedule: DensifySettings | McmcSettings | None
    step: int
    seconds: float = 0.0
    last: Mapping[str, float] | None = None
    unseen: Tensor | None = None
    """u8[V, H, W] of the virtual views: 1 where no recorded view saw what they show; None before they join."""
    appearance: Appearance = field(default_factory=lambda: Appearance({}))

    def summary(self) -> dict[str, Any]:
        """For run.json."""
        return {"gaussians": len(self.model.table), "steps": self.step, "seconds": round(self.seconds, 2), **(self.last or {})}


def _prepare(config: FitConfig, recipe: Recipe, scene_path: Path, fused_path: Path, virtual: Path | None, out: Path) -> FitState:
    """Read views, then continue from the newest checkpoint or build the starting model."""
    scene = read_scene(scene_path)
    frames = training_frames(scene, config.cameras)
    classes = classes_of(scene, frames, virtual) if config.semantics else ()
    recorded = load_recorded(scene, frames, classes, config.width_px, recipe.lidar and config.lidar_weight > 0)
    fused = read_fused(fused_path)
    shown: tuple[StoredView, ...] = ()
    if virtual is not None:
        measured = fused_lidar(fused, scene.tracks) if config.virtual_lidar_weight else None
        shown = load_virtual(virtual, classes, measured)
    views = ViewSet(recorded, shown, offsets_from_path_m(recorded, shown))
    schedule = densify_schedule(config)
    found = checkpoint.latest(out / "steps")
    if found is not None:
        model = SceneModel.from_state(found.state["model"], {name: found.tensors(name) for name in ("gaussians", "nodes")})
        log.info(f"continuing at step {found.step} of {config.iterations}")
        stats = DensifyStats.from_state(found.tensors("stats"))
        unseen = found.tensors("unseen").get("maps") if found.state["virtual"] else None
        appearance = Appearance.from_state(found.state["appearance"], found.tensors("appearance"))
        return FitState(model, views, stats, schedule, found.step, float(found.state["seconds"]), found.state["last"], unseen, appearance)
    return start_state(config, recipe, scene, fused, views, classes)


def start_state(
    config: FitConfig, recipe: Recipe, scene: Scene, cloud: FusedCloud, views: ViewSet, classes: tuple[int, ...]
) -> FitState:
    """The state that a fit starts from: a model built from the fused cloud, nothing corrected yet."""
    start = StartSettings(
        config.initial_gaussians, config.voxel_m, config.far_m, config.sh_degree, recipe.objects, recipe.sky,
        config.learn_poses, config.seed, config.deformable, config.color_terms, config.mirror_start, config.outlier_deviations,
    )  # fmt: skip
    model = start_model(scene, cloud, views.recorded, classes, start)
    model.facts |= {"method": config.method, "scene": scene.id, "classes": [palette.CLASSES[i] for i in classes]}
    appearance = Appearance.of_views(
        [view.name for view in views.recorded], [view.name for view in views.virtual], config.exposure, config.learn_cameras,
        config.virtual_appearance,
    )  # fmt: skip
    return FitState(model, views, DensifyStats.zeros(len(model.table)), densify_schedule(config), 0, appearance=appearance)


# ---- the loop ------------------------------------------------------------------------------------------------------


def optimise(state: FitState, config: FitConfig, folder: RunDir) -> None:
    """Fit ``state.model`` to its views for ``config.iterations`` steps, one view each (or two, see ``virtual_beside``).

    Same inputs, same result, also across an interruption: every draw comes from (seed, step), and checkpoints hold all
    that changes. Ctrl-C is taken at the end of a step: checkpoint, then KeyboardInterrupt.
    """
    raster, perception = RasterConfig(backend=config.raster, near_m=NEAR_M), perception_of(config)
    virtual_from, virtual_to = (share * config.iterations for share in (config.virtual_start, config.virtual_stop))
    with log.task(f"fit {config.method}", config.iterations, state.step) as bar, _interrupt_at_end_of_step() as interrupted:
        while state.step < config.iterations:
            began = time.perf_counter()
            step = state.step + 1
            if step > virtual_from and state.unseen is None and state.views.virtual:
                state.unseen = admit_virtual_views(state, config, raster)
            probability = config.virtual_probability if virtual_from < step <= virtual_to else 0.0
            reach_m = _virtual_reach_m(state.views, config, step)
            samples = state.views.choose(config.seed, step, probability, state.unseen, reach_m, config.virtual_beside)
            learnt = [_learn_from(state, sample, config, raster, perception, step, index) for index, sample in enumerate(samples)]
            (render, terms), sample = learnt[0], samples[0]
            visible = render.trace.visible
            for other, _ in learnt[1:]:
                visible = visible | other.trace.visible
            adam_step(state.model, step, config, visible)
            state.appearance.adam_step(step, appearance_rates(step, config.iterations), kernels.adam_columns)
            if step % SHAPE_EVERY == 0:
                shorten_needles(state.model.table, config.longest_to_middle)
                settle_nodes(state.model, config, step)
            if pose_round_due(config, step):
                moved_m = refine_poses(state.model, state.views.recorded, raster, state.appearance)
                folder.log(step=step, boxes_moved_m=round(moved_m, 5))
            grown = _densify_if_due(state, config, step)

            state.step, state.seconds = step, state.seconds + time.perf_counter() - began
            if step % 20 == 0 or step == config.iterations or grown:
                state.last = _progress(state, render, sample, terms)
                folder.log(step=step, view=sample.name, seconds=round(state.seconds, 3), **state.last, **grown)
                bar.update(f"psnr {state.last['psnr']:.1f}, {len(state.model.table)} Gaussians")
            if step % config.preview_every == 0 or step == config.iterations:
                write_preview(state, raster, folder.path / "preview" / f"{step:06d}.png")
            if step % config.checkpoint_every == 0 or interrupted.is_set():
                save_checkpoint(state, folder.path / "steps")
            bar.advance()
            if interrupted.is_set():
                folder.pause(state.summary())
                raise KeyboardInterrupt


def _learn_from(
    state: FitState, sample: Sample, config: FitConfig, raster: RasterConfig, perception: Perception, step: int, index: int
) -> tuple[Render, dict[str, Tensor]]:
    """Render a view and add the gradients of its loss to the parameters'.

    Args:
        index: place of the view among those of this step; what does not depend on the view counts with the first.

    Returns:
        The picture, and the weighted loss terms.
    """
    observation = sample.observation
    recorded = observation.kind == "recorded"
    wanted = recorded or config.virtual_densify
    growing = wanted and isinstance(state.schedule, DensifySettings) and step <= state.schedule.stop
    with_classes = not recorded or step % config.semantic_every == 0
    gaussians = compose(state.model, observation.view.time_s, None, with_classes, recorded and shows_mirrored(config, step))
    pose = state.appearance.world_from_cam(observation.view, sample.name) if recorded else None
    render = rasterize(gaussians, observation.view, raster, absgrad=growing, world_from_cam=pose)
    terms = (recorded_terms if recorded else virtual_terms)(state.model, render, sample, config, perception, state.appearance)
    terms |= (regularisers(gaussians, config) if index == 0 else {}) | correction_terms(state, gaussians, sample, config, raster, step)
    finite_or_refuse(terms, sample.name, step)
    torch.stack(list(terms.values())).sum().backward()
    gradients_or_refuse(state.model, sample.name, step)
    state.appearance.refuse_non_finite(sample.name, step)
    if growing:
        camera = observation.view.camera
        state.stats.observe(render.trace, camera.width, camera.height, state.model.counts()[0])
    return render, terms


def _virtual_reach_m(views: ViewSet, config: FitConfig, step: int) -> float:
    """How far from the recorded path virtual views may be at a step, metres: grows from the nearest one to all of them."""
    if not views.virtual or not config.virtual_grow:
        return math.inf
    nearest, farthest = min(views.offsets_m), max(views.offsets_m)
    along = (step / config.iterations - config.virtual_start) / config.virtual_grow
    return nearest + (farthest - nearest) * min(max(along, 0.0), 1.0)


def admit_virtual_views(state: FitState, config: FitConfig, raster: RasterConfig) -> Tensor:
    """Before virtual views join: work out what only they see, and start Gaussians there (see ``fit_trust``).

    Returns:
        Maps u8[V, H, W], 1 where no recorded view saw what a virtual view shows; padded to the largest view.
    """
    maps = unseen_maps(state.model, state.views.recorded, state.views.virtual, raster)
    if config.virtual_gaussians:
        columns, labels = unseen_rows(state.model, state.views.virtual, maps, config.virtual_gaussians, config.seed)
        state.model.table.append(columns, labels)
        state.model.sort_rows()
        state.stats = DensifyStats.zeros(len(state.model.table))
    height, width = (max(size) for size in zip(*(found.shape for found in maps)))
    stacked = torch.zeros(len(maps), height, width, dtype=torch.uint8)
    for index, found in enumerate(maps):
        stacked[index, : found.shape[0], : found.shape[1]] = torch.from_numpy(found)
    log.info(f"virtual views: {float(np.mean([found.mean() for found in maps])):.0%} of their pixels show what no recorded view saw")
    return stacked


def recorded_terms(
    model: SceneModel, render: Render, sample: Sample, config: FitConfig, perception: Perception, appearance: Appearance | None = None
) -> dict[str, Tensor]:
    """Weighted loss terms of a recorded view: colour, LiDAR depth, sky, semantics (those that apply).

    The observation's confidence is that of its labels (a labeller may be unsure; the photograph is not).
    """
    seen = sample.observation
    labels = seen.confidence * seen.mask
    rgb = composite_sky(model, seen.view, render.rgb, render.alpha)
    rgb = rgb if appearance is None else appearance.colored(rgb, sample.name, seen.kind)
    rgb = losses.outside_mask_copied(rgb, seen.rgb, None if seen.mask.all() else seen.mask)
    terms = {"color": kernels.photometric(rgb, seen.rgb, config.ssim_weight)}
    if sample.lidar is not None and len(sample.lidar.pixel) and config.lidar_weight:
        terms["lidar"] = config.lidar_weight * losses.sparse_depth(render.depth, sample.lidar.pixel, sample.lidar.depth_m)
    if sample.sky is not None and config.sky_weight and model.sky is not None:
        terms["sky"] = config.sky_weight * losses.weighted_mean(losses.sky_map(render.alpha, sample.sky), labels)
    if render.extra is not None and seen.semantics is not None and config.semantic_weight:
        total = max(float(labels.sum()), 1e-12) / config.semantic_weight
        terms["semantics"] = kernels.class_loss(render.extra, seen.semantics, labels[0], total, sky_lift(model, render.alpha))
    return terms


def virtual_terms(
    model: SceneModel, render: Render, sample: Sample, config: FitConfig, perception: Perception, appearance: Appearance | None = None
) -> dict[str, Tensor]:
    """Weighted loss terms of a virtual view, every pixel weighted by the observation's confidence."""
    seen = sample.observation
    sure = seen.confidence if config.virtual_confidence_power == 1 else seen.confidence**config.virtual_confidence_power
    weight = sure * seen.mask * torch.where(sample.unseen, 1.0, config.virtual_seen_weight)
    rgb = composite_sky(model, seen.view, render.rgb, render.alpha)
    rgb = rgb if appearance is None else appearance.colored(rgb, sample.name, seen.kind)
    terms: dict[str, Tensor] = {}
    if config.virtual_color_weight:
        terms["virtual_color"] = config.virtual_color_weight * kernels.photometric(rgb, seen.rgb, config.virtual_ssim_weight, weight[0])
    if config.virtual_perceptual_weight:
        terms["virtual_perceptual"] = config.virtual_perceptual_weight * perception(rgb, seen.rgb, weight)
    if seen.depth is not None and config.virtual_depth_weight:
        valid = torch.isfinite(seen.depth) & (seen.depth > 0) & (seen.depth < FARTHEST_VIRTUAL_DEPTH_M)
        loss = losses.dense_depth_map(render.depth, torch.where(valid, seen.depth, 1.0))
        terms["virtual_depth"] = config.virtual_depth_weight * losses.confident_mean(loss, weight * valid)
    if sample.lidar is not None and len(sample.lidar.pixel) and config.virtual_lidar_weight:
        loss = losses.sparse_depth(render.depth, sample.lidar.pixel, sample.lidar.depth_m)
        terms["virtual_lidar"] = config.virtual_lidar_weight * loss
    if sample.sky is not None and config.sky_weight and model.sky is not None:
        terms["virtual_sky"] = config.sky_weight * losses.confident_mean(losses.sky_map(render.alpha, sample.sky), weight)
    if render.extra is not None and seen.semantics is not None and config.virtual_semantic_weight:
        total, lift = weight[0].numel() / config.virtual_semantic_weight, sky_lift(model, render.alpha)
        terms["virtual_semantics"] = kernels.class_loss(render.extra, seen.semantics, weight[0], total, lift)
    return terms


def regularisers(gaussians: Gaussians, config: FitConfig) -> dict[str, Tensor]:
    """Weighted mean opacity and mean scale in metres of all Gaussians, where their weights are not 0."""
    published = config.densify == "mcmc"
    opacity_weight = (MCMC_OPACITY_WEIGHT if published else 0.0) if config.opacity_weight is None else config.opacity_weight
    scale_weight = (MCMC_SCALE_WEIGHT if published else 0.0) if config.scale_weight is None else config.scale_weight
    terms = {}
    if opacity_weight:
        terms["opacity"] = opacity_weight * gaussians.opacity.mean()
    if scale_weight:
        terms["scale"] = scale_weight * gaussians.scales.mean()
    return terms


def correction_terms(
    state: FitState, gaussians: Gaussians, sample: Sample, config: FitConfig, raster: RasterConfig, step: int
) -> dict[str, Tensor]:
    """Weighted terms that hold what is learnt to what is known: colour maps near the identity, objects within their boxes
    (once densification is over)."""
    seen = sample.observation
    terms: dict[str, Tensor] = {}
    distance = state.appearance.penalty(sample.name, seen.kind)
    if distance is not None and config.exposure_weight:
        terms["exposure"] = config.exposure_weight * distance
    if config.object_weight and seen.kind == "recorded" and _settled(state.schedule, step) and len(state.model.nodes) > 1:
        alpha = rasterize(objects_only(gaussians), seen.view, raster).alpha
        inside = boxes_in_view(state.model, seen.view)
        terms["objects"] = config.object_weight * losses.object_map(alpha, inside).mean()
    return terms


def _settled(schedule: DensifySettings | McmcSettings | None, step: int) -> bool:
    """Whether the number of Gaussians does not change any more after a step."""
    return schedule is None or step > schedule.stop


def shows_mirrored(config: FitConfig, step: int) -> bool:
    """Whether symmetric objects are shown mirrored at a step."""
    probability = config.mirror_probability
    return probability > 0 and float(seeds.numpy_rng(config.seed, step, "mirrored").random()) < probability


def settle_nodes(model: SceneModel, config: FitConfig, step: int) -> None:
    """Regularise what nodes learn per key of their track, less and less as the steps of the optimiser shrink."""
    share = learning_rates(step, config.iterations)["deform"] / learning_rates(1, config.iterations)["deform"]
    for node in model.nodes:
        if isinstance(node, RigidNode):
            node.after_step(share)


def pose_round_due(config: FitConfig, step: int) -> bool:
    """Whether boxes are corrected after a step."""
    if not config.learn_poses or not config.pose_rounds:
        return False
    first, last = config.pose_start, max(config.pose_start, LAST_POSE_ROUND)
    shares = np.linspace(first, last, config.pose_rounds)
    return step in {max(1, round(float(share) * config.iterations)) for share in shares}


def finite_or_refuse(terms: Mapping[str, Tensor], view: str, step: int) -> None:
    """NumericsError naming term, view and step if a loss term is not finite; nothing has been changed by then."""
    for name, value in terms.items():
        if not math.isfinite(value.item()):
            raise NumericsError(
                f"the loss term {name!r} is not finite", where=f"view {view}, step {step}", got=str(value.item()),
                remedy="check this view's image and labels; the parameters are those of the step before",
            )  # fmt: skip


def gradients_or_refuse(model: SceneModel, view: str, step: int) -> None:
    """NumericsError naming the parameter if a gradient is not finite; the parameters have not been touched."""
    for owner, table in {"gaussians": model.table, **model.node_tables()}.items():
        for name, gradient in table.gradients().items():
            # A sum is the cheapest pass over memory there is; it may overflow, so what it finds is counted.
            if not math.isfinite(gradient.sum().item()) and (count := int((~torch.isfinite(gradient)).sum())):
                table.clear_gradients()
                raise NumericsError(
                    "a gradient is not finite", where=f"{owner}.{name}, view {view}, step {step}",
                    got=f"{count} values",
                    remedy="the parameters are those of the step before; report the scene, or leave this view out",
                )  # fmt: skip


# ---- schedules -----------------------------------------------------------------------------------------------------


def learning_rates(step: int, iterations: int) -> dict[str, float]:
    """Learning rate of every column at a step (from 1).

    Published rates belong to 30,000 steps. A shorter run takes larger steps, by the square root of the ratio and at most
    4 times; positions decay to a hundredth over the run, scales and colours to a fifth.
    """
    boost = min(4.0, math.sqrt(max(1.0, PUBLISHED_STEPS / iterations)))
    along = step / max(1, iterations)
    decay, gentle = 0.01**along, 0.2**along
    return {
        "means": 1.6e-4 * 10.0 * boost * decay,
        "quats": 1e-3 * boost,
        "log_scales": 5e-3 * boost * gentle,
        "logits": 5e-2 * math.sqrt(boost),
        "sh_dc": 2.5e-3 * boost * gentle,
        "sh_rest": 1.25e-4 * boost * gentle,
        "semantics": 1e-2 * boost,
        "panorama": 1e-2 * gentle,
        "deform": 1e-3 * boost * gentle,
        "sh_time": 2.5e-3 * boost * gentle,
    }


def appearance_rates(step: int, iterations: int) -> dict[str, float]:
    """Learning rates of the corrections of appearance at a step (from 1)."""
    gentle = 0.2 ** (step / max(1, iterations))
    return {"affine": 2e-3 * gentle, "shift": 1e-3 * gentle, "turn": 1e-4 * gentle}


def densify_schedule(config: FitConfig) -> DensifySettings | McmcSettings | None:
    """The published schedules, scaled to the iterations; None without densification.

    gradient: from 500, every 100, until 0.6 of the run, opacity reset every 3000. mcmc: the same rounds until 0.8.
    """
    total = config.iterations
    every = max(10, min(100, total // 20))
    start = max(every, min(500, total // 10))
    if config.densify == "mcmc":
        return McmcSettings(start, int(0.8 * total), every, max_rows=config.max_gaussians)
    if config.densify == "none":
        return None
    return DensifySettings(
        start, int(0.6 * total), every, max_rows=config.max_gaussians, reset_every=3000 if total >= 10_000 else 0
    )


def adam_step(model: SceneModel, step: int, config: FitConfig, visible: Tensor) -> None:
    """One Adam step on every table of the model, then gradients are dropped.

    Args:
        visible: bool[N], the Gaussians this step's view shows; with ``config.selective_adam`` the others rest.
    """
    rates = learning_rates(step, config.iterations)
    model.table.adam_step(step, rates, kernels.adam_columns, visible if config.selective_adam else None)
    for table in model.node_tables().values():
        table.adam_step(step, rates, kernels.adam_columns)
    for table in (model.table, *model.node_tables().values()):
        table.clear_gradients()


def _densify_if_due(state: FitState, config: FitConfig, step: int) -> dict[str, Any]:
    """What the schedule has for this step, after the optimiser's; a report if rows changed."""
    model, schedule = state.model, state.schedule
    report: dict[str, Any] = {}
    if isinstance(schedule, McmcSettings):
        if schedule.due(step):
            report = relocate_and_grow(model, step, schedule, config.seed)
        drift(model, step, learning_rates(step, config.iterations)["means"], schedule, config.seed)
    elif schedule is not None:
        if schedule.due(step):
            report = densify(model, state.stats, step, schedule, config.seed)
        if schedule.reset_due(step):
            reset_opacity(model, schedule)
    if report:
        state.stats = DensifyStats.zeros(len(model.table))
    return report


# ---- on disk -------------------------------------------------------------------------------------------------------


def save_checkpoint(state: FitState, folder: Path) -> None:
    """All that changes: model with moments, statistics, step."""
    values, groups = state.model.state()
    groups = {**groups, "stats": state.stats.state()}
    if state.unseen is not None:
        groups["unseen"] = {"maps": state.unseen}
    names, groups["appearance"] = state.appearance.state()
    groups["appearance"] = groups["appearance"] or {"none": torch.zeros(1)}
    facts = {"model": values, "seconds": state.seconds, "last": dict(state.last or {}), "virtual": state.unseen is not None,
             "appearance": names}  # fmt: skip
    checkpoint.save(folder, state.step, groups, facts)


def save_model(model: SceneModel, folder: Path) -> None:
    """The fitted scene without optimiser moments."""
    values, groups = model.state()
    store.write_json(folder / "model.json", {"schema": 1, **values})
    for name, tensors in groups.items():
        kept = {key: value for key, value in tensors.items() if "moment" not in key}
        store.write_safetensors(folder / f"{name}.safetensors", kept)


def save_appearance(appearance: Appearance, folder: Path) -> None:
    """What was learnt about cameras, images and virtual sets, for those who want to know; renders do not use it."""
    if appearance:
        names, tensors = appearance.state()
        store.write_json(folder / "appearance.json", {"schema": 1, "names": names})
        store.write_safetensors(folder / "appearance.safetensors", {k: v for k, v in tensors.items() if "moment" not in k})


def load_model(folder: Path) -> SceneModel:
    """Read a fitted scene.

    Raises:
        InputError: not the folder of a finished fit, or of another schema. IntegrityError: a file was altered.
    """
    folder = Path(folder)
    if not (folder / "model.json").is_file():
        raise InputError("no fitted scene here", where=str(folder), expected="a folder made by `mudg fit`")
    if (folder / store.MANIFEST).is_file():
        store.verify_manifest(folder)
    values = store.read_json(folder / "model.json")
    if values.get("schema") != 1:
        raise InputError("unknown schema of a fitted scene", where=str(folder / "model.json"), expected="1", got=str(values.get("schema")))
    groups = {}
    for name in ("gaussians", "nodes"):
        arrays = store.read_safetensors(folder / f"{name}.safetensors")
        groups[name] = {key: torch.from_numpy(value.copy()) for key, value in arrays.items()}
    return SceneModel.from_state(values, groups)


# ---- looking at it --------------------------------------------------------------------------------------------------


def _progress(state: FitState, render: Render, sample: Sample, terms: Mapping[str, Tensor]) -> dict[str, float]:
    seen = sample.observation
    with torch.no_grad():
        rgb = composite_sky(state.model, seen.view, render.rgb, render.alpha)
        psnr = metrics.psnr(rgb, seen.rgb, seen.mask)
    shown = {f"loss_{name}": round(value.item(), 6) for name, value in terms.items()}
    return {"psnr": round(min(psnr, 99.0), 3), **shown}


@torch.no_grad()
def render_view(model: SceneModel, view: View, raster: RasterConfig, sky_below_alpha: float = 0.5, source: str = "") -> Observation:
    """Render one view of a fitted scene as an observation of kind "virtual".

    Where coverage is below ``sky_below_alpha``: no depth (NaN), and semantics sky if the scene has a sky; what is classed as
    sky has no depth. Confidence is the coverage (1 where the sky is a valid answer).
    """
    render = rasterize(compose(model, view.time_s), view, raster)
    rgb = composite_sky(model, view, render.rgb, render.alpha).clamp(0, 1)
    covered = render.alpha >= sky_below_alpha
    depth = torch.where(covered, render.depth, torch.nan)
    semantics = None
    if render.extra is not None:
        channel = composite_semantics(model, render.extra, render.alpha).argmax(0)
        semantics = torch.tensor(model.classes)[channel]
        if model.sky is not None:
            semantics = torch.where(covered[0], semantics, palette.ID["sky"])
            depth = torch.where(semantics[None] == palette.ID["sky"], torch.nan, depth)
    confidence = render.alpha if model.sky is None else torch.where(covered, render.alpha, 1 - render.alpha)
    source = source or str(model.facts.get("method", "fit"))
    return Observation(view, rgb, depth, semantics, confidence.clamp(0, 1), torch.ones_like(covered), "virtual", source)


def write_preview(state: FitState, raster: RasterConfig, path: Path) -> None:
    """A picture: truth, render, depth, semantics of the middle recorded view."""
    stored = state.views.recorded[len(state.views.recorded) // 2]
    seen = render_view(state.model, stored.view, raster)
    panels = [stored.rgb, to_bytes(seen.rgb), depth_colors(seen.depth[0].numpy())]  # type: ignore[index]
    if seen.semantics is not None:
        panels.append(class_colors(seen.semantics.numpy()))
    with store.atomic_path(path) as temporary:
        Image.fromarray(np.concatenate(panels, 1)).save(temporary)


@contextlib.contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Results must not depend on how many cores are free; the native library's do not, torch's do. Its short loops gain nothing
    from a second thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def _interrupt_at_end_of_step() -> Iterator[threading.Event]:
    """Turn the first Ctrl-C into a flag, so that a step is never cut in half; a second one interrupts at once."""
    flag = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    before = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: Any) -> None:
        if flag.is_set() and callable(before):
            before(number, frame)
        flag.set()

    signal.signal(signal.SIGINT, note)
    try:
        yield flag
    finally:
        signal.signal(signal.SIGINT, before)
