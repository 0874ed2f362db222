"""synthesize: dense colour, depth and semantics on trajectories that were never driven.

Whoever generates along a path, also repairs of edited views, asks a `ViewMaker`.
OUT/<trajectory>/state/ holds what an interrupted run needs to continue after the last finished window.
"""

from __future__ import annotations

import functools
import math
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mudg import native
from mudg.base import log, memory, palette, store
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import ResourceError, UsageError
from mudg.base.processes import run_in_processes
from mudg.base.records import understood
from mudg.base.run_folder import RunDir
from mudg.base.types import Condition, FusedCloud, Observation, Photo, RenderPlanes, Scene, Trajectory, View
from mudg.core import trajectory
from mudg.core.raster.cpu import release_memory
from mudg.diffusion import model_files, published
from mudg.diffusion.condition import FAR_M, ConditionRules, DriveInputs, PreparedImages, WarpSource, build_conditions
from mudg.diffusion.model import MDM
from mudg.diffusion.model_files import Model, generated, is_published
from mudg.diffusion.published import PublishedMDM, WorkSplit
from mudg.diffusion.requests import GeneratedClip, SampleRequest, half_format, picture_row
from mudg.diffusion.settings import ConditionParts, SynthesizeConfig
from mudg.gaussians.rendering import render_planes
from mudg.gaussians.storage import load_model
from mudg.networks.codec import Modality
from mudg.scene.clouds import read_fused
from mudg.scene.labels import read_label, read_trusted_classes
from mudg.scene.observations import ObservationWriter
from mudg.scene.read import read_image, read_scene

# with only some of its parts ----------------------------------------------------------------------


COVERED = 0.5
"""Opacity above which a render covers a pixel."""


def conditions_of(
    drive: DriveInputs, parts: ConditionParts, views: Sequence[View], rules: ConditionRules, kept: dict[int, WarpSource]
) -> tuple[Condition, Condition]:
    """The model's condition for ``views`` with some of its parts (`SynthesizeConfig.condition`), and the same on the
    fine grid. Reference, points and concat are without renders; the reference is put up far away. kept: recorded images
    that are prepared already (see ``build_conditions``)."""
    if parts == "full":
        return build_conditions(drive, views, rules, kept)
    if parts == "repair":
        return _of_renders(drive, views, rules, kept)
    drive = replace(drive, render_at=None, vacated_at=None)
    if rules.published:
        whole = build_conditions(drive, views, rules, kept)[0]
        if parts == "reference":
            whole = replace(whole, valid=torch.zeros_like(whole.valid), measured=None)
        else:
            whole = replace(whole, reference_in="frame" if parts == "concat" else "nowhere")
        return whole, whole
    bare = replace(rules, warp=False) if parts == "points" else replace(rules, images_per_view=0)
    built = build_conditions(drive, views, bare, kept)
    if parts != "reference":
        return built
    small, fine = (
        replace(
            c,
            color=c.backdrop,
            semantics=c.backdrop_semantics,
            valid=torch.zeros_like(c.valid),
            depth=torch.full_like(c.depth, FAR_M),
        )
        for c in built
    )
    return small, fine


def _of_renders(
    drive: DriveInputs, views: Sequence[View], rules: ConditionRules, kept: dict[int, WarpSource]
) -> tuple[Condition, Condition]:
    """Renders in the place of points, none of them measured, and the nearest recorded image. Where a render covers a
    pixel it counts as a recorded image that was warped there: it is the picture that is repaired."""
    if drive.render_at is None:
        raise UsageError("this condition needs renders of a fitted scene", got="repair")
    static = drive.cloud.static
    labels = None if static.semantics is None else static.semantics[:0]
    none = replace(static, xyz=static.xyz[:0], rgb=static.rgb[:0], semantics=labels)
    empty = replace(drive, cloud=FusedCloud(none, {}, drive.cloud.colors), tracks=(), vacated_at=None)
    built = build_conditions(empty, views, replace(rules, images_per_view=1), kept)
    renders = [cast("RenderPlanes", c.renders) for c in built]
    small, fine = (
        replace(
            c,
            color=r.color,
            depth=r.depth,
            semantics=r.semantics,
            valid=torch.zeros_like(c.valid),
            warped=r.alpha > COVERED,
        )
        for c, r in zip(built, renders, strict=True)
    )
    return small, fine


# the model that a configuration names, of whichever kind, ready to sample -------------------------


FEW_STEPS = 20


def check_config(config: SynthesizeConfig, fitted: bool, *, weather: bool = False) -> SynthesizeConfig:
    """The configuration with its device chosen, and the number of processes that its model wants; without reading
    weights of a published-type model. fitted: whether a fitted scene is given too. weather: and tells the distances by
    which views are brought into other weather. UsageError: a setting that does not apply to this kind of model, or to
    the device. InputError: no such model. ResourceError: no such device."""
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    if device.type != "cpu" and config.processes > 1:
        what, remedy = f"on {device} one process makes all trajectories", "leave it out, or give --device cpu"
        raise UsageError(what, where="--processes", expected="0 or 1", got=str(config.processes), remedy=remedy)
    config = replace(config, device=str(device))
    half_of(config)
    full_size, repairs = is_published(config.model), config.condition == "repair"
    if not full_size:
        MDM.check_request(request_of(config))
    if full_size and fitted and not weather:
        what = "a published-type model uses a fitted scene for weather and light of --edits only"
        raise UsageError(what, where="--fitted", remedy="leave it out")
    if repairs and not (fitted or full_size):
        what = "this condition is made of renders of a fitted scene"
        remedy = "give the folder of a finished fit as --fitted"
        raise UsageError(what, where="--condition", got="repair", remedy=remedy)
    if full_size and repairs:
        what, known = "a published-type model does not know this condition", "full, reference, points, concat"
        remedy = "leave it out, or choose another --model"
        raise UsageError(what, where="--condition", expected=known, got="repair", remedy=remedy)
    if config.condition != "full" and fitted and not repairs:
        what, remedy = "parts of the condition cannot be switched off here", "leave out --condition or --fitted"
        got = "--fitted: renders are left out of such a condition"
        raise UsageError(what, where="--condition", expected="full", got=got, remedy=remedy)
    if config.memory_budget_gb and not full_size:
        what = "this setting applies to published-type models only"
        raise UsageError(what, where="--memory-budget-gb", remedy="leave it out")
    if full_size:
        return replace(config, processes=config.processes or 1)  # one copy of a large model in memory
    model = model_files.load(config.model)  # fails now rather than in every process
    if fitted and not model.config.renders:
        what = "this model was not trained with renders of a fitted scene"
        remedy = "leave it out, or choose another --model"
        raise UsageError(what, where="--fitted", got=config.model, remedy=remedy)
    return config


def request_of(config: SynthesizeConfig, bf16: bool = False) -> SampleRequest:
    """What a configuration asks of the model for every window; the window's own number and known frames are to be put
    in."""
    return SampleRequest(
        config.steps,
        config.seed,
        eta=config.eta,
        guidance=config.guidance,
        guidance_rescale=config.guidance_rescale,
        align=config.align_depth,
        bf16=bf16,
    )


def half_of(config: SynthesizeConfig) -> torch.dtype | None:
    """The half precision that a configuration's model computes in, None for float32. Published-type models bear
    float16."""
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    return half_format(config.precision, device, float16=is_published(config.model))


def load_any(config: SynthesizeConfig) -> Model:
    """The model of a configuration. On another device than the CPU a published-type model has its weights in the number
    format that `precision` says. Its work is cut to fit `memory_budget_gb`, or, without one, what is free on a CUDA
    device. ResourceError: it does not fit however it is cut, or no such device."""
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    if not is_published(config.model):
        return model_files.load(config.model).to(device)
    if config.steps < FEW_STEPS:
        trained = "synthesize: the published model was trained for 50 denoising steps"
        log.warn(f"{trained}, but --steps is {config.steps} (recommended: --steps 50)")
    half = half_of(config)
    dtype = None if device.type == "cpu" else half or torch.float32
    model = model_files.load_published(config.model, dtype=dtype)
    model.split = WorkSplit(frames_at_once=1)
    free_gb = torch.cuda.mem_get_info(device)[0] / 1e9 if device.type == "cuda" else 0.0
    budget_gb = config.memory_budget_gb or free_gb  # 0: unknown
    if budget_gb:
        model.split = _choose_split(model, config, budget_gb, 4 if half is None else 2)
    return model.to(device)


def _choose_split(model: PublishedMDM, config: SynthesizeConfig, budget_gb: float, bytes_per_value: int) -> WorkSplit:
    """How the model's work is cut to fit a memory budget in GB."""
    needs, guidance = published.needs_of(model.config, bytes_per_value), config.guidance != 1
    split, peak_bytes = published.choose(needs, int(budget_gb * 1e9), guidance=guidance)
    if peak_bytes > budget_gb * 1e9:
        what = "the model does not fit into the memory budget, however its work is split"
        where = "--memory-budget-gb" if config.memory_budget_gb else f"free memory of --device {config.device}"
        expected, got = f">= {peak_bytes / 1e9:.1f} GB", f"{budget_gb:.4g} GB"
        raise ResourceError(what, where=where, expected=expected, got=got, remedy="use the 320x512 model, or bfloat16")
    log.info(
        f"synthesize: modalities {'together' if split.modalities_together else 'one by one'}, guidance "
        f"{'together' if split.guidance_together else 'in two passes'}, {split.frames_at_once} frames per decoding, "
        f"about {peak_bytes / 1e9:.1f} GB at most"
    )
    return split


# views --------------------------------------------------------------------------------------------


EDITED_IMAGES_PER_VIEW = 24
"""Recorded images tried per view of an edited drive: what an object hid at one moment others show."""


def source_of(condition: ConditionParts) -> str:
    """The method that views made from a condition belong to. Of repaired renders only the colour counts."""
    return "difix" if condition == "repair" else "mudg_r"


def windows(frames: int, window: int, overlap: int) -> list[range]:
    """Frame ranges of the windows: all `frames` covered, each sharing at least `overlap` with the one before, the last
    one ending at the last frame. Fewer frames than a window give one short window. UsageError: the overlap leaves no
    new frame per window."""
    if overlap >= window:
        raise UsageError("the overlap is as long as a window", expected=f"overlap < {window}", got=str(overlap))
    if frames <= window:
        return [range(frames)]
    starts = list(range(0, frames - window, window - overlap)) + [frames - window]
    return [range(start, start + window) for start in starts]


def recorded_images(scene: Scene, config: SynthesizeConfig) -> list[Photo]:
    """Recorded images that may be warped in, of all cameras, with the classes that may be given."""
    frames = scene.frames_in("train")
    classes = lambda frame: read_trusted_classes(scene, frame) if config.given_classes else None
    # frames of an edited drive say which pixels are rendered
    recorded = lambda frame: ~read_label(scene, frame, "rendered") if "rendered" in frame.labels else None
    return [Photo(frame.view, read_image(scene, frame), classes(frame), recorded(frame)) for frame in frames]


class ViewMaker:
    """Conditions, samples and observations of one drive at one size. scratch: a folder for what is large (None: it
    stays in memory)."""

    def __init__(
        self, model: Model, drive: DriveInputs, rules: ConditionRules, config: SynthesizeConfig, scratch: Path | None
    ) -> None:
        if not drive.recorded:
            log.warn("synthesize: no recorded image is available; holes are filled with the nearest point's colour")
        self._model, self._drive, self._rules, self._full_size = model, drive, rules, config.full_size
        self._parts = config.condition
        self._images = drive.images.setdefault(rules.fine, PreparedImages(scratch))
        self._request = request_of(config, half_of(config) == torch.bfloat16)

    def sized(self, view: View) -> View:
        """The view at the size that is written."""
        return view if self._full_size else view.resized(*self._rules.size)

    def make(
        self, views: Sequence[View], number: int, known: dict[Modality, Tensor] | None
    ) -> tuple[GeneratedClip, Condition, list[Observation]]:
        """Sample window `number` at `views`; `known` latents [k,C,h,w] fix its first k frames."""
        condition, fine = conditions_of(self._drive, self._parts, views, self._rules, self._images)
        release_memory()  # of renders for the condition: the model needs more than they do
        request = replace(self._request, index=number, known=known)
        sample, made, made_views = self._generated(condition, fine, views, request)
        usable = torch.ones_like(made.confidence, dtype=torch.bool)
        if self._model.points_alone and not recorded_at_pose(views[0], self._drive.recorded):
            usable[0] = False
        trust = made.confidence * usable
        source, nothing = source_of(self._parts), [None] * len(made_views)
        depth, ids = (nothing, nothing) if self._parts == "repair" else (made.depth, made.semantics)
        planes = zip(made_views, made.rgb, depth, ids, trust, usable, strict=True)
        return sample, condition, [Observation(*one, "virtual", source) for one in planes]

    def _generated(
        self, condition: Condition, fine: Condition, views: Sequence[View], request: SampleRequest
    ) -> tuple[GeneratedClip, GeneratedClip, tuple[View, ...]]:
        """The clip at the size the model works at; it and its views at the size that is written, without depth in the
        sky."""
        model = self._model
        if self._full_size and isinstance(model, MDM) and model.finisher is not None:
            sample, finished = model.sampled_and_finished(condition, fine, request)
            return sample, without_sky_depth(finished, fine), tuple(views)
        sample = generated(model, condition, request)
        made = without_sky_depth(sample, condition)
        if not self._full_size:
            return sample, made, condition.views
        size = views[0].camera.height, views[0].camera.width
        conditions = None if model.points_alone else (condition, fine)
        return sample, enlarge(made, size, conditions), tuple(views)


def without_sky_depth(clip: GeneratedClip, condition: Condition) -> GeneratedClip:
    """The clip with NaN for the depth of what is classed as sky and was not measured."""
    sky = (clip.semantics == palette.ID["sky"]).unsqueeze(1) & ~condition.measurement.valid
    return replace(clip, depth=torch.where(sky, torch.nan, clip.depth))


def recorded_at_pose(view: View, recorded: Sequence[Photo]) -> bool:
    """Whether a recorded image was taken where `view` is (to 5 cm and 10 mrad). The published model puts the reference,
    as it was recorded, into frame 0 of a window. On a shifted trajectory that frame is a picture from another place,
    and must not be used as if it were one from there."""
    moves = (image.view.cam_from_world @ view.world_from_cam for image in recorded)
    return any(np.linalg.norm(m[:3, 3]) < 0.05 and np.abs(m[:3, :3] - np.eye(3)).max() < 0.01 for m in moves)


def enlarge(
    clip: GeneratedClip, size: tuple[int, int], conditions: tuple[Condition, Condition] | None
) -> GeneratedClip:
    """A clip at the size (height, width): colour bicubic, depth f32[T,1,h,w] (NaN = none) and classes nearest,
    confidence bilinear. With the clip's condition and the same at the new size, detail is put back: in colour by
    `add_detail`; the fine measured depth where it is within a tenth of the generated one; and the fine class where the
    clip has it in that pixel or beside it."""
    nearest = lambda x: functional.interpolate(x, size=size, mode="nearest-exact")
    depth, ids = nearest(clip.depth), nearest(clip.semantics.unsqueeze(1).float())[:, 0].long()
    if conditions is None:
        rgb = functional.interpolate(clip.rgb, size=size, mode="bicubic", align_corners=False).clamp(0, 1)
    else:
        small, fine = conditions
        rgb = add_detail(clip.rgb, small, fine)
        close = fine.valid & ((fine.depth - depth).abs() < 0.1 * depth)
        depth = torch.where(close, fine.depth, depth)
        if fine.semantics is not None:
            ids = finer_classes(ids, clip.semantics, fine.semantics)
    trust = functional.interpolate(clip.confidence, size=size, mode="bilinear", align_corners=False)
    return replace(clip, rgb=rgb, depth=depth, semantics=ids, confidence=trust)


def finer_classes(enlarged: Tensor, generated: Tensor, given: Tensor) -> Tensor:
    """Classes i64[T,H,W]: those of `given` u8[T,1,H,W] where `generated` i64[T,h,w] has that class in the pixel or one
    beside it, else `enlarged` i64[T,H,W]. The outline is the given one; what is there, the model has decided."""
    size = enlarged.shape[-2:]
    around = functional.pad(generated.unsqueeze(1).float(), (1, 1, 1, 1), mode="replicate")
    height, width = generated.shape[-2:]
    wanted, there = given.float(), torch.zeros_like(given, dtype=torch.bool)
    for row in range(3):
        for column in range(3):
            beside = around[..., row : row + height, column : column + width]
            there |= functional.interpolate(beside, size=size, mode="nearest-exact") == wanted
    return torch.where(there[:, 0], given[:, 0].long(), enlarged)


def add_detail(rgb: Tensor, small: Condition, full: Condition) -> Tensor:
    """Enlarge generated colour f32[T,3,h,w] to the size of `full`, with the detail that the warped images have there.
    Where the generated colour agrees with the small condition, the finer structure of the full condition (its
    difference from its own reduced copy) is added; the weight falls with the disagreement, to nothing at a difference
    of 0.12."""
    size = full.color.shape[-2:]
    larger = lambda x: functional.interpolate(x, size=size, mode="bicubic", align_corners=False)
    reduced = functional.interpolate(full.color, size=rgb.shape[-2:], mode="area")
    detail = full.color - larger(reduced)
    apart = torch.maximum((rgb - small.color).abs(), (rgb - reduced).abs()).amax(1, keepdim=True)
    seen = small.valid if small.warped is None else small.valid | small.warped
    weight = (1 - functional.max_pool2d(apart, 3, stride=1, padding=1) / 0.12).clamp(0, 1) * seen
    weight = functional.interpolate(weight, size=size, mode="bilinear", align_corners=False)
    return (larger(rgb) + weight * detail).clamp(0, 1)


# the verb -----------------------------------------------------------------------------------------


FITS = "depth_fits.json"
"""Frame -> [scale, shift in metres, median relative residual before, after] of the alignment of its depth."""
PROCESS_BYTES = int(1.2 * memory.GIB)
PIXEL_BYTES, FRAME_PIXEL_BYTES = 240, 80
"""What a process takes: with the small models; for each pixel of the written size; and for each pixel of a window's
frames. Measured: 2.0 GiB at 1242x375 with windows of eight frames, 3.85 GiB at 3840x2160 with three, where conditions
lie in files (4.5 GiB before)."""
WINDOW_FRAMES = 8


@dataclass(frozen=True, slots=True)
class JobInputs:
    """What every trajectory is made from: folders of the scene, its fused clouds and its fit. edited: reads an edited
    drive in place of the recorded one; processes are sent it."""

    scene: Path
    fused: Path
    fitted: Path | None = None
    edited: Callable[[SynthesizeConfig, JobInputs], DriveInputs] | None = None


@functools.lru_cache(maxsize=1)
def recorded_drive(config: SynthesizeConfig, inputs: JobInputs) -> DriveInputs:
    """The drive as it was recorded; the same for the next trajectory of a run, which forgets it at its end."""
    scene = read_scene(inputs.scene)
    render_at = None if inputs.fitted is None else functools.partial(render_planes, load_model(inputs.fitted))
    return DriveInputs(read_fused(inputs.fused), scene.tracks, recorded_images(scene, config), render_at)


def write_views(config: SynthesizeConfig, inputs: JobInputs, loaded: Scene, work: RunDir) -> dict[str, Any]:
    """Generate all trajectories of the configuration, one folder of observations each; returns a summary. UsageError:
    unknown camera, nothing to make."""
    cameras = config.cameras or tuple(loaded.cameras)[:1]
    if not cameras or not (config.shifts_m or config.paths):
        raise UsageError("nothing to synthesize", where=str(inputs.scene), expected="at least one camera and one shift")
    paths = [
        *(trajectory.at_shift(loaded, camera, shift_m) for camera in cameras for shift_m in config.shifts_m),
        *(trajectory.named(loaded, camera, name) for camera in cameras for name in config.paths),
    ]
    names = [path.name for path in paths]
    if len(set(names)) < len(names):
        raise UsageError("two shifts give the same trajectory", got=", ".join(names))
    half_of(config)  # said before other processes begin
    started, frames = time.monotonic(), 0
    processes = config.processes or usual_processes(config, paths)
    model = load_any(config) if processes == 1 else None  # several processes load one each
    jobs = [(config, inputs, work.path, path, model) for path in paths]
    processes = min(processes, len(jobs))
    if processes > 1:
        release_memory()
        log.info_once(f"synthesize: {processes} processes with one thread each")
    try:
        with log.task("synthesize", len(jobs)) as bar:
            for index, views in run_in_processes(make_trajectory, jobs, processes):
                frames += views
                bar.update(names[index])
                bar.advance()
    finally:
        recorded_drive.cache_clear()
    seconds = time.monotonic() - started
    log.info(f"synthesize: {frames} views in {seconds:.1f} s, {seconds / max(frames, 1):.2f} s each")
    return {"trajectories": names, "views": frames}


def usual_processes(config: SynthesizeConfig, paths: Sequence[Trajectory]) -> int:
    """Trajectories made at the same time where the configuration names no number: as many as there are cores and as
    memory lasts for; one where they would share a GPU. Says so where memory decides."""
    cores = native.default_threads() if config.device == "cpu" else 1
    wanted, free = min(cores, len(paths)), memory.free_bytes()
    if wanted == 1 or not free:
        return max(1, wanted)
    camera = max((path.views[0].camera for path in paths), key=lambda c: c.width * c.height)
    pixels = camera.width * camera.height if config.full_size else 0
    frames = min(WINDOW_FRAMES, max(map(len, paths)))
    need = PROCESS_BYTES + pixels * (PIXEL_BYTES + frames * FRAME_PIXEL_BYTES)
    possible = max(1, min(wanted, free // need))
    if possible < wanted:
        each = f"at {camera.width}x{camera.height} each takes about {memory.in_words(need)}"
        log.info(f"synthesize: {possible} of {wanted} processes: {each}, and {memory.in_words(free)} are free")
    return possible


# one trajectory -----------------------------------------------------------------------------------


def without_classes(cloud: FusedCloud) -> FusedCloud:
    """The cloud without its points' classes."""
    objects = {name: replace(points, semantics=None) for name, points in cloud.objects.items()}
    return FusedCloud(replace(cloud.static, semantics=None), objects, cloud.colors)


def make_trajectory(
    config: SynthesizeConfig, inputs: JobInputs, out: Path, path: Trajectory, model: Model | None = None
) -> int:
    """Generate one trajectory and write its folder; returns the number of views. Continues an interrupted one. `model`:
    that of the configuration, if it is in memory already."""
    folder = out / path.name
    if (folder / "observations.json").is_file():
        return len(path)
    model = model or load_any(config)
    maker = view_maker(config, inputs, path.views, model, out)
    window = model.config.window
    spans = windows(len(path), window, min(config.overlap, window - 1))
    state = folder / "state"
    finished = sorted(state.glob("[0-9]*.safetensors"))  # the last one's latents, by the number of windows
    first, tail = (int(finished[-1].stem), store.read_tensors(finished[-1])) if finished else (0, None)
    with understood("depth fits of an interrupted synthesis", str(state / FITS)):
        fits: dict[str, list[float | None]] = dict(store.read_json(state / FITS)) if (state / FITS).is_file() else {}
    every = max(1, len(path) // 5)
    with ObservationWriter(folder, path.name, source_of(config.condition)) as writer:
        done = spans[first - 1].stop if first else 0
        for view in path.views[:done]:
            writer.skip(maker.sized(view))
        for number, span in list(enumerate(spans))[first:]:
            shared = done - span.start  # frames of the window before
            known = {m: z[-shared:] for m, z in tail.items()} if shared and tail else None
            sample, condition, observations = maker.make([path.views[i] for i in span], number, known)
            for index in range(done, span.stop):
                place = index - span.start
                writer.add(observations[place])
                if sample.depth_fits:
                    fit = sample.depth_fits[place]
                    numbers = (fit.scale, fit.shift_m, fit.residual_before, fit.residual)
                    fits[f"{index:06d}"] = [round(x, 5) if math.isfinite(x) else None for x in numbers]
                if index % every == 0:
                    colors, own = (condition.color[place], sample.rgb[place]), sample.semantics[place]
                    row = picture_row(colors, [sample.depth[place]], [own], sample.confidence[place])
                    store.write_safetensors(state / f"row{index:06d}.safetensors", {"row": row})
            store.write_json(state / FITS, fits)
            store.write_safetensors(state / f"{number + 1:04d}.safetensors", dict(sample.latents))
            (state / f"{number:04d}.safetensors").unlink(missing_ok=True)
            done, tail = span.stop, sample.latents
            del sample, condition, observations  # before the next window is made
        rows = [store.read_safetensors(file)["row"] for file in sorted(state.glob("row*.safetensors"))]
        if rows:
            store.write_image(folder / "overview.png", np.concatenate(rows))
        if fits:
            store.write_json(folder / FITS, fits)
        shutil.rmtree(state, ignore_errors=True)
    return len(path)


def view_maker(
    config: SynthesizeConfig, inputs: JobInputs, views: Sequence[View], model: Model, scratch: Path | None
) -> ViewMaker:
    """What makes the views of one path; ``scratch``: a folder for what is large (None: it stays in memory)."""
    drive = recorded_drive(config, inputs) if inputs.edited is None else inputs.edited(config, inputs)
    drive = drive if config.given_classes else replace(drive, cloud=without_classes(drive.cloud))
    camera = views[0].camera
    width, height = model.image_size(camera.width, camera.height, config.width_px)
    model.check_clip(min(len(views), model.config.window), height, width)
    fine = (camera.width, camera.height) if config.full_size or model.points_alone else (2 * width, 2 * height)
    rules = ConditionRules(width, height, *fine, published=model.points_alone)
    rules = rules if inputs.edited is None else replace(rules, images_per_view=EDITED_IMAGES_PER_VIEW)
    return ViewMaker(model, drive, rules, config, scratch)
