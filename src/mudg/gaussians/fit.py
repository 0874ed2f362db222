"""fit: recorded frames (and virtual observations) in, a dynamic Gaussian scene out. A step is ``optimise``, read top to
bottom; with ``start`` it goes on with a finished fit (``gaussians/storage.py``).

    OUT/model.json, gaussians.safetensors, nodes.safetensors    the fitted scene (``load_model``) and its certainty
    OUT/appearance.json, appearance.safetensors                 corrections of cameras and colours, where learnt
    OUT/log.jsonl, preview/*.png                                how it went
    OUT/steps/                                                  checkpoints, while it runs
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mudg.base import checkpoint, log, palette, store
from mudg.base.devices import memory_of
from mudg.base.errors import UsageError
from mudg.base.layout import MODEL_FILES
from mudg.base.processes import one_torch_thread
from mudg.base.run_folder import RunDir, VerbOutput
from mudg.base.types import FusedCloud, Gaussians, Render, Scene
from mudg.base.weights import read_checkpoint
from mudg.core import losses, metrics, native_ops
from mudg.core.pictures import panels_of
from mudg.core.raster.rasterize import RasterConfig, drawing_device, rasterize
from mudg.gaussians import storage, views
from mudg.gaussians.corrections import Appearance, refine_poses
from mudg.gaussians.densify import DensifySettings, DensifyStats, densify_if_due, shorten_needles
from mudg.gaussians.model import CERTAINTY, SceneModel, compose_as_read, composite_sky, sky_lift
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.recipes import DrawnView, recipe_of
from mudg.gaussians.rendering import boxes_in_view, drawing_facts, objects_only, raster_of
from mudg.gaussians.rendering import render_view as render_view
from mudg.gaussians.schedule import (
    FiniteCheck,
    Progress,
    appearance_rates,
    densify_schedule,
    learning_rates,
    pose_round_due,
    run_steps,
)
from mudg.gaussians.settings import METHODS, FitConfig, VirtualConfig
from mudg.gaussians.start import FitStart
from mudg.gaussians.storage import load_model as load_model
from mudg.gaussians.trust import certainty_of, unseen_maps, unseen_rows
from mudg.gaussians.views import TrainView, ViewSet, load_recorded
from mudg.networks.featnets import FilterBank, LpipsFeatures
from mudg.scene.clouds import read_fused
from mudg.scene.fuse import fused_without_boxes
from mudg.scene.observations import ObservationSet
from mudg.scene.read import read_scene

_FILES = (*MODEL_FILES, "appearance.json", "appearance.safetensors", "field.safetensors", "preview/*.png", "steps/")
OUTPUT = VerbOutput("fit", 3, _FILES)
FARTHEST_VIRTUAL_DEPTH_M = 100.0
SHAPE_EVERY = 10
EXPOSURE_WEIGHT = 0.01
"""Weight that pulls the colour maps of recorded and virtual views towards the identity."""
LEAST_WITNESSES, WITNESS_SHARE = 8, 0.015
"""Recorded views that the certainty is computed from, at most: this many, or this share of the steps (one costs about a
step)."""


def check(config: FitConfig, *, fused: bool, virtual: bool, continued: bool) -> None:
    """UsageError where a method lacks what it needs: fused clouds, virtual views, a finished fit, or a setting."""
    if not fused:
        raise UsageError(f"{config.method} needs fused clouds", remedy="run `mudg fuse` and give its folder as --fused")
    recipe_of(config.method).check(config, continued)
    if METHODS[config.method].learns_virtual and not virtual:
        remedy = "run `mudg synthesize` and give its folder as --observations, or choose --method street_gaussians"
        raise UsageError(f"{config.method} needs virtual observations", remedy=remedy)


def write_fit(
    config: FitConfig,
    scene: Path,
    fused: Path,
    work: RunDir,
    virtual: Mapping[str, ObservationSet] | None = None,
    start: storage.StartFit | None = None,
) -> dict[str, Any]:
    """Fit a scene, from its folder and that of its fused cloud, and write the model to the work folder; returns a
    summary. An interrupted fit goes on from its newest checkpoint. ``virtual``: sets of virtual views by name.
    ``start``: the finished fit that it goes on with. NumericsError: a loss or gradient is not finite. InputError:
    damaged inputs."""
    device = drawing_device(config.device, "fit", config.raster)
    config = recipe_of(config.method).used(config)
    if start is not None:
        config = storage.whole_run(config)
    with one_torch_thread(), memory_of(device, "fit"):
        state = _prepare(config, scene, fused, virtual or {}, start, work.path).to(device)
        optimise(state, config, work)
        add_certainty(state, config)
    storage.save_model(state.model, work.path)
    storage.save_appearance(state.appearance, work.path)
    shutil.rmtree(work.path / "steps", ignore_errors=True)
    return state.summary()


@dataclass
class FitState(Progress):
    """Everything that changes while fitting, and what it is fitted to. ``begun_at``: steps of the schedule that counted
    as done when the fit began, above 0 where it goes on with a finished one."""

    model: SceneModel
    views: ViewSet
    stats: DensifyStats
    schedule: DensifySettings | None
    appearance: Appearance
    begun_at: int = 0

    @classmethod
    def begun(
        cls, config: FitConfig, model: SceneModel, shown: ViewSet, start: storage.StartFit | None = None
    ) -> FitState:
        """The state before the first step, on the CPU; with ``start``, ``config`` is that of the whole run."""
        model.facts |= {"method": config.method, "classes": [palette.CLASSES[i] for i in model.classes]}
        known, step = Appearance.of_views([view.name for view in shown.recorded], config.appearance), 0
        if start is not None:
            known, step = storage.continued_appearance(start, known), storage.begun_at(config.iterations)
        schedule = densify_schedule(config, recipe_of(config.method).last_densified)
        return cls(model, shown, DensifyStats.zeros(len(model.table)), schedule, known, step, step=step)

    @property
    def device(self) -> torch.device:
        """Where everything is that a step changes; views are sent there one by one."""
        return self.model.device

    def to(self, device: torch.device) -> FitState:
        """The same state on a device."""
        model, stats, appearance = self.model.to(device), self.stats.to(device), self.appearance.to(device)
        return replace(self, model=model, stats=stats, appearance=appearance)

    def summary(self) -> dict[str, Any]:
        """For run.json."""
        counts = {"gaussians": len(self.model.table), "steps": self.step - self.begun_at}
        return {**counts, "seconds": round(self.seconds, 2), **(self.last or {})}


def _prepare(
    config: FitConfig,
    folder: Path,
    clouds: Path,
    virtual: Mapping[str, ObservationSet],
    start: storage.StartFit | None,
    out: Path,
) -> FitState:
    """Read views, then continue from the newest checkpoint or build the starting model."""
    scene, fused = read_scene(folder), read_fused(clouds)
    if not METHODS[config.method].boxes:
        scene, fused = replace(scene, tracks=()), fused_without_boxes(scene, clouds)
    shown, classes = recorded_views(config, scene, virtual, start, out)
    if virtual:
        measured = views.fused_lidar(fused, scene.tracks) if config.virtual.lidar_weight else None
        loaded = views.load_virtual(virtual, classes, measured)
        shown = replace(shown, virtual=views.keep(loaded, sum(map(len, virtual.values())), out))
    found = checkpoint.latest(out / "steps")
    if found is None and start is None:
        return start_state(config, scene, fused, shown, classes)
    if found is None:
        model = storage.continued_model(start, classes, config)
        log.info(f"start: {len(model.table)} Gaussians of {start.folder}")
        return FitState.begun(config, model, shown, start)
    log.info(f"resuming at step {found.step} of {config.iterations}")
    model = SceneModel.from_state(found.state["model"], {name: found.tensors(name) for name in ("gaussians", "nodes")})
    state = FitState.begun(config, model, shown, start)
    state.appearance = Appearance.from_state(found.state["appearance"], found.tensors("appearance"))
    state.stats = DensifyStats.from_state(found.tensors("stats"))
    state.resume(found)
    return state


def recorded_views(
    config: FitConfig,
    scene: Scene,
    virtual: Mapping[str, ObservationSet] | None = None,
    start: storage.StartFit | None = None,
    folder: Path | None = None,
) -> tuple[ViewSet, tuple[int, ...]]:
    """The recorded views of a configuration, without virtual ones, and the train ids of the model's class channels
    (those that ``virtual`` shows and ``start`` knows included). ``folder``: for those that memory has no
    room for."""
    frames = views.training_frames(scene, config.cameras)
    classes = views.classes_of(scene, frames, virtual or {}) if config.semantics else ()
    classes = classes if start is None else storage.all_classes(start, classes)
    with_lidar = "lidar" in METHODS[config.method].supervision and config.loss.lidar_weight > 0
    loaded = load_recorded(scene, frames, classes, config.width_px, with_lidar)
    return ViewSet(views.keep(loaded, len(frames), folder)), classes


def start_state(
    config: FitConfig, scene: Scene, cloud: FusedCloud, shown: ViewSet, classes: tuple[int, ...]
) -> FitState:
    """The state that a fit starts from, on the CPU: a model built from the fused cloud, nothing corrected yet."""
    model = recipe_of(config.method).start(FitStart(config, scene, cloud, shown.recorded, classes))
    model.facts |= {"method": config.method, "scene": scene.id, "classes": [], **drawing_facts(config.drawing)}
    return FitState.begun(config, model, shown)


def add_certainty(state: FitState, config: FitConfig) -> None:
    """Note in the model how well the photographs constrain every Gaussian (``gaussians/trust.py``)."""
    raster, most = raster_of(state.model, config.raster), max(LEAST_WITNESSES, round(WITNESS_SHARE * config.iterations))
    certainty = certainty_of(state.model, state.views.recorded, raster, state.appearance, most)
    state.model.table.labels[CERTAINTY] = certainty


# ---- a step --------------------------------------------------------------------------------------


def optimise(state: FitState, config: FitConfig, folder: RunDir) -> None:
    """Fit ``state.model`` to its views up to step ``config.iterations``, one view each (or two, see
    ``VirtualConfig.beside``). Same inputs, same result, also across an interruption: every draw comes from (seed,
    step), and checkpoints hold all that changes."""
    raster, perception = raster_of(state.model, config.raster), perception_of(config.virtual, state.device)
    virtual_from, virtual_to = (share * config.iterations for share in (config.virtual.start, config.virtual.stop))
    virtual_from = state.begun_at or virtual_from
    sizes = views.HalvedViews(config.virtual.half_size * config.iterations)

    def take(step: int) -> tuple[dict[str, Any], partial[dict[str, float]]]:
        if step - 1 <= virtual_from < step and state.views.virtual and config.virtual.gaussians:
            start_unseen_gaussians(state, config, raster)
        probability = config.virtual.probability if virtual_from < step <= virtual_to else 0.0
        chosen = state.views.choose(config.seed, step, probability, config.virtual.beside)
        # The one way to the device; results come back in gaussians/rendering.py.
        seen = [TrainView.of(sizes.sized(view, step), state.device) for view in chosen]
        check = FiniteCheck(step)
        learn = partial(_learn_from, state, config=config, raster=raster, perception=perception, check=check)
        learnt = [learn(view, step=step, first=view is seen[0]) for view in seen]
        check.refuse()
        adam_step(state.model, step, config.iterations, state.begun_at)
        rates = appearance_rates(step, config.iterations)
        state.appearance.adam_step(step - state.begun_at, rates)
        if step % SHAPE_EVERY == 0:
            shorten_needles(state.model.table, config.densify.longest_to_middle)
            now, first = (learning_rates(at, config.iterations)["deform"] for at in (step, 1))
            for node in state.model.nodes:
                if isinstance(node, RigidNode):  # less and less, as the steps of the optimiser shrink
                    node.after_step(now / first)
        if pose_round_due(config, step):
            moved_m = refine_poses(state.model, state.views.recorded, raster, state.appearance)
            folder.log(step=step, boxes_moved_m=round(moved_m, 5))
        densified = densify_if_due(state.model, state.stats, state.schedule, step, config.seed)
        if densified:
            state.stats = DensifyStats.zeros(len(state.model.table), state.device)
        return {"view": seen[0].name, **densified}, partial(_numbers, state, seen[0], *learnt[0])

    save = lambda: save_checkpoint(state, folder.path / "steps")
    run_steps(state, config, folder, take, save, lambda path: write_preview(state, raster, path))


def _learn_from(
    state: FitState,
    view: TrainView,
    *,
    step: int,
    first: bool,
    config: FitConfig,
    raster: RasterConfig,
    perception: Perception,
    check: FiniteCheck,
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Render a view and add the gradients of its loss to the parameters'. Returns colours f32[3, H, W] without the sky
    and coverage f32[1, H, W] (not all that was rendered: that would stay in memory while the next view is), and the
    weighted loss terms. ``first``: of the views of this step; terms that do not depend on the view count with it."""
    recipe, recorded = recipe_of(config.method), view.kind == "recorded"
    model = recipe.drawn_model(state.model, view, step, config) if recorded else state.model
    growing = recorded and isinstance(state.schedule, DensifySettings) and step <= state.schedule.stop
    with_classes = not recorded or step % config.loss.semantic_every == 0
    gaussians = compose_as_read(model, view.view, view.readout, with_classes)
    pose = state.appearance.world_from_cam(view.view, view.name) if recorded else None
    render = rasterize(gaussians, view.view, raster, absgrad=growing, world_from_cam=pose)
    if recorded:
        terms = recorded_terms(state, render, view, recipe.common(config))
        terms |= recipe.terms(DrawnView(model, gaussians, render, view, step, config, raster))
    else:
        terms = virtual_terms(state, render, view, config, perception)
    if first and config.loss.opacity_weight:
        terms["opacity"] = config.loss.opacity_weight * gaussians.opacity.mean()
    terms |= correction_terms(state, gaussians, view, config, raster, step)
    check.terms(view.name, terms)
    torch.stack(list(terms.values())).sum().backward()
    check.gradients(view.name, state.model, state.appearance)
    if growing:
        camera = view.view.camera
        timed = state.model.table["tau"].grad if "tau" in state.model.table.columns else None
        state.stats.observe(render.trace, camera.width, camera.height, state.model.counts()[0], timed)
    terms = {name: term.detach() for name, term in terms.items()}
    return render.rgb.detach(), render.alpha.detach(), terms


def start_unseen_gaussians(state: FitState, config: FitConfig, raster: RasterConfig) -> None:
    """When virtual views join: start Gaussians at the surfaces that only they show (see ``gaussians/trust.py``)."""
    unseen = unseen_maps(state.model, state.views.recorded, state.views.virtual, raster)
    columns, labels, share = unseen_rows(state.model, unseen, config.virtual.gaussians, config.seed)
    state.model.table.append(*({k: value.to(state.device) for k, value in of.items()} for of in (columns, labels)))
    state.model.sort_rows()
    state.stats = DensifyStats.zeros(len(state.model.table), state.device)
    log.info(f"virtual views: {share:.0%} of their pixels show what no recorded view saw")


def _picture(state: FitState, render: Render, view: TrainView) -> Tensor:
    """The rendered colours ``[3, H, W]`` over the sky, as the camera (or generator) of the view would show them."""
    rgb = composite_sky(state.model, view.view, render.rgb, render.alpha)
    return state.appearance.colored(rgb, view.name, view.kind)


def recorded_terms(state: FitState, render: Render, view: TrainView, config: FitConfig) -> dict[str, Tensor]:
    """Weighted loss terms of a recorded view: colour, LiDAR depth, sky, semantics (those that apply).

    The view's confidence is that of its labels (a labeller may be unsure; the photograph is not).
    """
    weights = config.loss
    labels = view.confidence * view.mask
    everywhere = state.device.type == "cpu" and bool(view.mask.all())  # to ask another device is to wait for it
    rgb = losses.outside_mask_copied(_picture(state, render, view), view.rgb, None if everywhere else view.mask)
    terms = {"color": native_ops.photometric(rgb, view.rgb, weights.ssim_weight)}
    if view.lidar is not None and weights.lidar_weight:
        terms["lidar"] = weights.lidar_weight * losses.sparse_depth(render.depth, view.lidar.pixel, view.lidar.depth_m)
    if view.sky is not None and weights.sky_weight and state.model.sky is not None:
        terms["sky"] = weights.sky_weight * losses.weighted_mean(losses.sky_map(render.alpha, view.sky), labels)
    if render.extra is not None and view.channels is not None and weights.semantic_weight:
        total, lift = labels.sum().double().clamp_min(1e-12), sky_lift(state.model, render.alpha)
        total = total / weights.semantic_weight
        terms["semantics"] = native_ops.class_loss(render.extra, view.channels, labels[0], total, lift)
    return terms


def virtual_terms(
    state: FitState, render: Render, view: TrainView, config: FitConfig, perception: Perception
) -> dict[str, Tensor]:
    """Weighted loss terms of a virtual view, every pixel weighted by the view's confidence."""
    weights = config.virtual
    sure = view.confidence if weights.confidence_power == 1 else view.confidence**weights.confidence_power
    weight = sure * view.mask
    rgb = _picture(state, render, view)
    terms: dict[str, Tensor] = {}
    if weights.color_weight:
        loss = native_ops.photometric(rgb, view.rgb, weights.ssim_weight, weight[0])
        terms["virtual_color"] = weights.color_weight * loss
    if weights.perceptual_weight:
        terms["virtual_perceptual"] = weights.perceptual_weight * perception(rgb, view.rgb, weight)
    if view.depth is not None and weights.depth_weight:
        valid = torch.isfinite(view.depth) & (view.depth > 0) & (view.depth < FARTHEST_VIRTUAL_DEPTH_M)
        loss = losses.dense_depth_map(render.depth, torch.where(valid, view.depth, 1.0))
        terms["virtual_depth"] = weights.depth_weight * losses.confident_mean(loss, weight * valid)
    if view.lidar is not None and weights.lidar_weight:
        loss = losses.sparse_depth(render.depth, view.lidar.pixel, view.lidar.depth_m)
        terms["virtual_lidar"] = weights.lidar_weight * loss
    if view.sky is not None and weights.sky_weight and state.model.sky is not None:
        loss = losses.confident_mean(losses.sky_map(render.alpha, view.sky), weight)
        terms["virtual_sky"] = weights.sky_weight * loss
    if render.extra is not None and view.channels is not None and weights.semantic_weight:
        total, lift = weight[0].numel() / weights.semantic_weight, sky_lift(state.model, render.alpha)
        terms["virtual_semantics"] = native_ops.class_loss(render.extra, view.channels, weight[0], total, lift)
    return terms


Perception = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Render ``[3, H, W]`` and target ``[3, H, W]`` in [0, 1], weight ``[1, H, W]`` -> distance, differentiable in the
render."""


def perception_of(config: VirtualConfig, device: torch.device | None = None) -> Perception:
    """The distance that ``config.perception`` names, of images on a device (None: the CPU). UsageError: LPIPS without a
    file of its weights. InputError: the file holds something else."""
    features: nn.Module = FilterBank()
    distance = losses.feature_distance
    if config.perception == "lpips":
        if not config.lpips_weights:
            what, remedy = "LPIPS needs a weight file", "set virtual.lpips_weights"
            raise UsageError(what, where="virtual.perception lpips", remedy=remedy)
        features = trunk = LpipsFeatures(read_checkpoint(Path(config.lpips_weights)), config.lpips_weights)
        distance = lambda render, target, weight: losses.lpips_distance(
            render, losses.unit_features(target), weight, trunk.channel_weights
        )
    features = features.to(device)

    def compare(render: Tensor, target: Tensor, weight: Tensor) -> Tensor:
        with torch.no_grad():
            wanted = features(target)
        return distance(features(render), wanted, weight)

    return compare


def correction_terms(
    state: FitState, gaussians: Gaussians, view: TrainView, config: FitConfig, raster: RasterConfig, step: int
) -> dict[str, Tensor]:
    """Weighted terms that hold what is learnt to what is known: colour maps near the identity, objects within their
    boxes (once densification is over)."""
    terms: dict[str, Tensor] = {}
    distance = state.appearance.penalty(view.name, view.kind)
    if distance is not None:
        terms["exposure"] = EXPOSURE_WEIGHT * distance
    settled = state.schedule is None or step > state.schedule.stop
    if config.loss.object_weight and view.kind == "recorded" and settled and len(state.model.nodes) > 1:
        alpha = rasterize(objects_only(gaussians), view.view, raster).alpha
        inside = boxes_in_view(state.model, view.view).to(state.device, non_blocking=True)
        terms["objects"] = config.loss.object_weight * losses.object_map(alpha, inside).mean()
    return terms


def adam_step(model: SceneModel, step: int, iterations: int, begun_at: int = 0) -> None:
    """One Adam step on every table of the model, then gradients are dropped; moments are those of the steps after
    ``begun_at``."""
    rates = learning_rates(step, iterations)
    for table in (model.table, *model.node_tables().values()):
        table.adam_step(step - begun_at, rates)
        table.clear_gradients()


def save_checkpoint(state: FitState, folder: Path) -> None:
    """All that changes: model with moments, statistics, step."""
    values, groups = state.model.state()
    groups = {**groups, "stats": state.stats.state()}
    names, groups["appearance"] = state.appearance.state()
    groups["appearance"] = groups["appearance"] or {"none": torch.zeros(1)}
    checkpoint.save(folder, state.step, groups, {"model": values, **state.facts(), "appearance": names})


def _numbers(
    state: FitState, view: TrainView, rgb: Tensor, alpha: Tensor, terms: Mapping[str, Tensor]
) -> dict[str, float]:
    with torch.no_grad():
        psnr = metrics.psnr(composite_sky(state.model, view.view, rgb, alpha), view.rgb, view.mask)
        values = torch.stack(list(terms.values())).tolist()
    seen = {} if math.isnan(psnr) else {"psnr": round(min(psnr, 99.0), 3)}  # no pixel of a generated view may count
    return {**seen, **{f"loss_{name}": round(value, 6) for name, value in zip(terms, values)}}


def write_preview(state: FitState, raster: RasterConfig, path: Path) -> None:
    """A picture: truth, render, depth, semantics of the middle recorded view."""
    stored = state.views.recorded[len(state.views.recorded) // 2]
    seen = render_view(state.model, stored.view, raster)
    store.write_image(path, np.concatenate([stored.rgb, *panels_of(seen)], 1))
