"""synthesize: dense colour, depth and semantics on trajectories that were never driven.

For every trajectory: build the condition view by view from the fused cloud and the recorded images, run the diffusion
model over windows of frames, write one folder of observations. Windows overlap; the shared frames are fixed in the later
window, so that the video continues. The last window ends at the last frame: every frame of the trajectory is produced.

OUT/<trajectory>/        observations (see `data/observations.py`) and overview.png
OUT/<trajectory>/state/  what an interrupted run needs to continue after the last finished window; removed at the end
"""

from __future__ import annotations

import functools
import math
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mudg import native
from mudg.base import log, memory, palette, store
from mudg.base.config import result_settings
from mudg.base.errors import UsageError
from mudg.base.processes import run_in_processes
from mudg.base.records import understood
from mudg.base.run_folder import RunDir, VerbOutput, below, refuse_overlap
from mudg.base.types import Condition, Frame, FusedCloud, Observation, Photo, Scene, Trajectory, View
from mudg.core import trajectory
from mudg.core.fusion import SweepShots
from mudg.core.pictures import class_colors, depth_colors, gray, to_bytes
from mudg.core.raster.cpu import release_memory
from mudg.data.clips.ablated import ConditionParts, ConditionSources, conditions_of
from mudg.data.clips.condition import ConditionRules, WarpSource
from mudg.data.clips.near_points import NearSweeps
from mudg.data.clips.stacked import KeptImages
from mudg.data.clips.vacated import VacatedAt
from mudg.data.clips.weathered import InWeather
from mudg.data.cloudfile import read_fused
from mudg.data.edits import EditScript
from mudg.data.observations import OBSERVATION_FILES, ObservationWriter
from mudg.data.scene import read_image, read_label, read_scene, read_trusted_classes
from mudg.models.diffusion import GeneratedClip, SampleRequest, StartClip, generated, generated_and_finished
from mudg.models.mdm.codec import Modality
from mudg.models.mdm.files import digest, folder_of
from mudg.models.mdm.model import MDM
from mudg.models.published.files import is_published
from mudg.models.scene.model import SceneModel
from mudg.stages import fuse
from mudg.stages.config import FuseConfig, SynthesizeConfig
from mudg.stages.editing import weathered as editing_weather
from mudg.stages.editing.carried import read_and_digest
from mudg.stages.editing.vacated import DriveOfEdits, drive_of_edits, photos_of_edited, vacated_at
from mudg.stages.fitting.planes import render_planes
from mudg.stages.fitting.rendering import raster_of, render_view
from mudg.stages.fitting.storage import load_model, model_of_scene
from mudg.stages.learning import loading

SOURCE, FREEVS = "mudg_r", "freevs"
COLOR_ALONE = {FREEVS: FREEVS, "repair": "difix"}
"""Conditions of which only the colour counts, and the method that views made from them belong to."""
SKY = palette.ID["sky"]
FITS = "depth_fits.json"
"""Frame -> [scale, shift in metres, median relative residual before, after] of the alignment of its depth."""
EDITED_IMAGES_PER_VIEW = 24
"""Recorded images tried per view of an edited drive: what an object hid at one moment others show."""
PROCESS_BYTES = int(1.2 * memory.GIB)
PIXEL_BYTES, FRAME_PIXEL_BYTES = 240, 80
"""What a process takes: with the small models; for each pixel of the written size; and for each pixel of a window's frames. Measured:
2.0 GiB at 1242x375 with windows of eight frames, 3.85 GiB at 3840x2160 with three, where conditions lie in files (4.5 GiB before)."""
WINDOW_FRAMES = 8
COMPUTE = ("offload", "compiled")
"""Settings that say how is computed, not what: a result may be resumed and reused under others."""
_OUTPUT = VerbOutput("synthesize", 2, below("*", (*OBSERVATION_FILES, "overview.png", FITS, "state/")))


def run(
    config: SynthesizeConfig, scene: Path, fused: Path, out: Path, *,
    fitted: Path | None = None, edits: Path | None = None, overwrite: bool = False,
) -> Path:  # fmt: skip
    """Generate all trajectories of the configuration; returns `out`, one folder of observations per trajectory inside.

    Args:
        config: see `SynthesizeConfig`.
        scene: scene directory or stored zip. fused: output of fuse for this scene.
        out: a finished result of the same configuration and inputs is verified and reused.
        fitted: output of fit for this scene, whose renders become part of the condition. For models that were trained with renders, and
            for the weather and light of `edits`.
        edits: an edit script; views are made of the drive as it says.

    Raises:
        UsageError: unknown camera, nothing to make, model that does not fit. InputError: scene, cloud or model malformed.
    """
    script, named, asked = None, {}, {}
    if edits is not None:
        script, asked["edits"] = read_and_digest(Path(edits))
        named = {f"{edits}: {name}": path for name, path in script.files().items()}
    refuse_overlap(out, {"scene": scene, "fused": fused, "fitted": fitted, "edits": edits, "model": folder_of(config.model), **named})
    weather = script is not None and shows_weather(config, script, fitted is not None)
    config = loading.check_config(config, fitted is not None, weather=weather)
    inputs = {"scene": store.digest(scene), "fused": store.digest(fused), "model": digest(config.model), **asked}
    loaded = read_scene(scene)
    if fitted is not None:
        inputs["fitted"] = store.digest(fitted)
        model_of_scene(fitted, loaded)
    loaded = loaded if script is None else _edited(config, script, (loaded, fused, fitted)).scene
    settings = {name: value for name, value in result_settings(config).items() if name not in COMPUTE}
    directory = RunDir.open(out, _OUTPUT, settings, inputs, overwrite)
    if directory.complete:
        return directory.reused()
    cameras = config.cameras or tuple(loaded.cameras)[:1]
    if not cameras or not (config.shifts_m or config.paths):
        raise UsageError("nothing to synthesize", where=str(scene), expected="at least one camera and one shift")
    paths = [
        *(trajectory.at_shift(loaded, camera, shift_m) for camera in cameras for shift_m in config.shifts_m),
        *(trajectory.named(loaded, camera, name) for camera in cameras for name in config.paths),
    ]
    names = [path.name for path in paths]
    if len(set(names)) < len(names):
        raise UsageError("two shifts give the same trajectory", got=", ".join(names))
    loading.half_of(config)  # said before other processes begin
    started = time.monotonic()
    processes = config.processes or usual_processes(config, paths)
    model = loading.load_any(config) if processes == 1 else None  # several processes load one each
    inputs_of = JobInputs(Path(scene), Path(fused), fitted, script)
    jobs = [(config, inputs_of, directory.path, path, model) for path in paths]
    try:
        frames = _run_jobs(jobs, names, processes)
    finally:
        _drive_again.cache_clear()
    seconds = time.monotonic() - started
    log.info(f"synthesize: {frames} views in {seconds:.1f} s, {seconds / max(frames, 1):.2f} s each")
    directory.finish({"trajectories": names, "views": frames})
    return directory.path


def usual_processes(config: SynthesizeConfig, paths: Sequence[Trajectory]) -> int:
    """Trajectories made at the same time where the configuration names no number: as many as there are cores and as memory lasts for;
    one where they would share a GPU. Says so where memory decides."""
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
        log.info(f"synthesize: {possible} of {wanted} processes: at {camera.width}x{camera.height} each takes about "
                 f"{memory.in_words(need)}, and {memory.in_words(free)} are free")  # fmt: skip
    return possible


def _edited(config: SynthesizeConfig, script: EditScript, given: tuple[Scene, Path, Path | None]) -> DriveOfEdits:
    """The drive that a script makes of scene, clouds and fit; what cannot be done is told here, before anything is written."""
    scene, fused, fitted = given
    if config.condition == FREEVS:
        raise UsageError("this condition is made of recorded sweeps, which show no edits", where="--condition", got=FREEVS,
            remedy="edit a whole run with `mudg edit` and give its scene")  # fmt: skip
    told = not shows_weather(config, script, fitted is not None)
    return drive_of_edits(script, scene, read_fused(fused), None if fitted is None else load_model(fitted), told=told)


def shows_weather(config: SynthesizeConfig, script: EditScript, fitted: bool) -> bool:
    """Whether views are generated in the weather and light of a script: by a published-type model, from points and a reference in that
    weather, whose distances a fit tells."""
    asked = editing_weather.conditions_of(script.canonical())
    wanted = asked is not None and asked.changes_air_ground_or_light and fitted and config.condition == "full"
    return wanted and is_published(config.model)


def _run_jobs(jobs: Sequence[tuple[Any, ...]], names: Sequence[str], processes: int) -> int:
    """Make the trajectories, each in one thread, several processes at a time; returns the number of views."""
    processes = min(processes, len(jobs))
    if processes > 1:
        release_memory()
        log.info_once(f"synthesize: {processes} processes with one thread each")
    made = 0
    with log.task("synthesize", len(jobs)) as bar:
        for index, views in run_in_processes(make_trajectory, jobs, processes):
            made += views
            bar.update(names[index])
            bar.advance()
    return made


# one trajectory -------------------------------------------------------------------------------------------------------


def windows(frames: int, window: int, overlap: int) -> list[range]:
    """Frame ranges of the windows: all `frames` covered, each sharing at least `overlap` with the one before, the last
    one ending at the last frame. Fewer frames than a window give one short window.

    Raises:
        UsageError: the overlap leaves no new frame per window.
    """
    if overlap >= window:
        raise UsageError("the overlap is as long as a window", expected=f"overlap < {window}", got=str(overlap))
    if frames <= window:
        return [range(frames)]
    starts = list(range(0, frames - window, window - overlap)) + [frames - window]
    return [range(start, start + window) for start in starts]


def recorded_images(scene: Scene, config: SynthesizeConfig) -> list[Photo]:
    """Recorded images that may be warped in, of all cameras, with the classes that may be given."""
    frames = scene.frames_in("train")
    classes = lambda frame: read_trusted_classes(scene, frame) if config.given_classes else None  # noqa: E731
    return [Photo(frame.view, read_image(scene, frame), classes(frame), recorded_pixels(scene, frame)) for frame in frames]


def recorded_pixels(scene: Scene, frame: Frame) -> NDArray[np.bool_] | None:
    """Which pixels bool[H, W] of a frame a camera recorded; None = all. Frames of an edited drive say which are rendered."""
    return ~read_label(scene, frame, "rendered") if "rendered" in frame.labels else None


def near_sweeps(scene: Scene, cloud: FusedCloud, path: Trajectory) -> NearSweeps:
    """The sweeps of a scene for FreeVS' condition, each coloured by the images of its time that are not held out."""
    times = [view.time_s for view in path.views]
    period_s = float(np.median(np.diff(times))) if len(times) > 1 else 0.1

    def read(number: int) -> SweepShots:
        return next(iter(fuse.scene_sweeps(replace(scene, sweeps=(scene.sweeps[number],)), FuseConfig())))

    return NearSweeps(tuple(sweep.time_s for sweep in scene.sweeps), read, scene.tracks, period_s, cloud.colors)


def without_classes(cloud: FusedCloud) -> FusedCloud:
    """The cloud without its points' classes."""
    bare = lambda points: replace(points, semantics=None)  # noqa: E731
    return FusedCloud(bare(cloud.static), {name: bare(points) for name, points in cloud.objects.items()}, cloud.colors)


@dataclass(frozen=True, slots=True)
class JobInputs:
    """What every trajectory is made from: folders of the scene, its fused clouds and its fit, and the edit script."""

    scene: Path
    fused: Path
    fitted: Path | None = None
    script: EditScript | None = None


def make_trajectory(
    config: SynthesizeConfig, given: JobInputs, out: Path, path: Trajectory, model: loading.DiffusionModel | None = None
) -> int:
    """Generate one trajectory and write its folder; returns the number of views. Continues an interrupted one. `model`: that of the
    configuration, if it is in memory already."""
    folder = out / path.name
    if (folder / "observations.json").is_file():
        return len(path)
    model = model or loading.load_any(config)
    maker = _view_maker(config, given, path, model, out)
    spans = windows(len(path), model.config.window, min(config.overlap, model.config.window - 1))
    state = folder / "state"
    first, tail = _read_state(state)
    with understood("depth fits of an interrupted synthesis", str(state / FITS)):
        fits: dict[str, list[float | None]] = dict(store.read_json(state / FITS)) if (state / FITS).is_file() else {}
    every = max(1, len(path) // 5)
    with ObservationWriter(folder, path.name, COLOR_ALONE.get(config.condition, SOURCE)) as writer:
        done = spans[first - 1].stop if first else 0
        for view in path.views[:done]:
            writer.skip(maker.sized(view))
        for number in range(first, len(spans)):
            span = spans[number]
            shared = done - span.start
            known = {m: z[-shared:] for m, z in tail.items()} if shared and tail else None
            views = [path.views[i] for i in span]
            sample, condition, observations = maker.make(views, number, known)
            for place, (index, observation) in enumerate(zip(span, observations)):
                if index >= done:
                    writer.add(observation)
                if index >= done and sample.depth_fits:
                    fit = sample.depth_fits[place]
                    numbers = (fit.scale, fit.shift_m, fit.residual_before, fit.residual)
                    fits[f"{index:06d}"] = [round(x, 5) if math.isfinite(x) else None for x in numbers]
                if index >= done and index % every == 0:
                    row = {"row": _sheet_row(condition, sample, index - span.start)}
                    store.write_safetensors(state / f"row{index:06d}.safetensors", row)
            done, tail = span.stop, sample.latents
            store.write_json(state / FITS, fits)
            store.write_safetensors(state / f"{number + 1:04d}.safetensors", dict(tail))
            (state / f"{number:04d}.safetensors").unlink(missing_ok=True)
            del sample, condition, observations, observation  # before the next window is made
        rows = [store.read_safetensors(file)["row"] for file in sorted(state.glob("row*.safetensors"))]
        if rows:
            store.write_image(folder / "overview.png", np.concatenate(rows))
        if fits:
            store.write_json(folder / FITS, fits)
        shutil.rmtree(state, ignore_errors=True)
    return len(path)


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    """What all trajectories are made from, read; ``images``: the recorded ones, as they have been prepared for views of a size."""

    scene: Scene
    cloud: FusedCloud
    recorded: list[Photo]
    fit: SceneModel | None = None
    vacated: VacatedAt | None = None
    weather: InWeather | None = None
    images: dict[tuple[int, int], PreparedImages] = field(default_factory=dict)


def _drive_of(config: SynthesizeConfig, given: JobInputs) -> _Drive:
    scene, cloud = read_scene(given.scene), read_fused(given.fused)
    fit = None if given.fitted is None else load_model(given.fitted)
    recorded, vacated, weather = recorded_images(scene, config), None, None
    if given.script is not None:
        drive = drive_of_edits(given.script, scene, cloud, fit)
        scene, cloud, fit, recorded = drive.scene, drive.cloud, drive.model, photos_of_edited(recorded, drive.plan)
        vacated = vacated_at(drive.plan)
        asked = editing_weather.conditions_of(given.script.canonical())
        if asked is not None and fit is not None and shows_weather(config, given.script, True):
            weather = editing_weather.weather_of(functools.partial(render_view, fit, raster=raster_of(fit)), asked, scene)
    return _Drive(scene, cloud if config.given_classes else without_classes(cloud), recorded, fit, vacated, weather)


_drive_again = functools.lru_cache(maxsize=1)(_drive_of)
"""The same for the next trajectory of a run; ``run`` forgets it."""


def _view_maker(
    config: SynthesizeConfig, given: JobInputs, path: Trajectory, model: loading.DiffusionModel, scratch: Path
) -> ViewMaker:
    """What makes the views of one trajectory; ``scratch``: a folder for what is large."""
    drive = _drive_again(config, given) if given.script is None else _drive_of(config, given)
    camera = path.views[0].camera
    width, height = model.image_size(camera.width, camera.height, config.width_px)
    model.check_clip(min(len(path), model.config.window), height, width)
    fine = (camera.width, camera.height) if config.full_size or model.points_alone else (2 * width, 2 * height)
    rules = ConditionRules(width, height, *fine, published=model.points_alone)
    rules = rules if given.script is None else replace(rules, images_per_view=EDITED_IMAGES_PER_VIEW)
    render_at = None if drive.fit is None else functools.partial(render_planes, drive.fit)
    near = near_sweeps(drive.scene, drive.cloud, path) if config.condition == FREEVS else None
    sources = ConditionSources(
        drive.cloud, drive.scene.tracks, drive.recorded, rules, render_at, near, drive.vacated, drive.weather
    )
    return ViewMaker(model, sources, config, images=drive.images.setdefault(fine, PreparedImages(scratch)))


def _read_state(state: Path) -> tuple[int, dict[Modality, Tensor]]:
    """Number of finished windows and the latents of the last one."""
    files = sorted(state.glob("[0-9]*.safetensors"))
    if not files:
        return 0, {}
    return int(files[-1].stem), store.read_tensors(files[-1])  # type: ignore[return-value]


class PreparedImages(KeptImages):
    """Images made ready for warping, for all windows and trajectories that a process makes; colours as bytes where that is exact."""

    def __setitem__(self, number: int, image: WarpSource) -> None:
        coarse = (image.rgb * 255).round().clamp(0, 255).to(torch.uint8)
        super().__setitem__(number, replace(image, rgb=coarse) if torch.equal(coarse.float() / 255, image.rgb) else image)

    def __getitem__(self, number: int) -> WarpSource:
        image = super().__getitem__(number)
        return image if image.rgb.is_floating_point() else replace(image, rgb=image.rgb.float() / 255)


StartAt = Callable[[Sequence[View]], StartClip]
"""What a clip of some views, of the size that the model works at, is to stay like."""


class ViewMaker:
    """Conditions, samples and observations of one scene at one size.

    Args:
        start_at: what clips begin from, and how far they may leave it (``StartClip``).
        images: recorded images that were prepared before, for views of this size; None: none.
    """

    def __init__(
        self, model: loading.DiffusionModel, given: ConditionSources, config: SynthesizeConfig, start_at: StartAt | None = None,
        images: PreparedImages | None = None,
    ) -> None:  # fmt: skip
        if not given.recorded:
            log.warn("synthesize: no recorded image is available; holes are filled with the nearest point's colour")
        self._model, self._given, self._full_size = model, given, config.full_size
        self._parts: ConditionParts = config.condition
        self._images = PreparedImages() if images is None else images
        self._request = loading.request_of(config, loading.half_of(config) == torch.bfloat16)
        self._start_at = start_at

    def sized(self, view: View) -> View:
        """The view at the size that is written."""
        return view if self._full_size else view.resized(self._given.rules.width, self._given.rules.height)

    def make(
        self, views: Sequence[View], number: int, known: dict[Modality, Tensor] | None
    ) -> tuple[GeneratedClip, Condition, list[Observation]]:
        """Sample window `number` at `views`; `known` latents [k,C,h,w] fix its first k frames."""
        condition, fine = conditions_of(self._given, self._parts, views, self._images)
        release_memory()  # of renders for the condition: the model needs more than they do
        start = None if self._start_at is None else self._start_at(condition.views)
        request = replace(self._request, index=number, known=known, start=start)
        sample, made, made_views = self._generated(condition, fine, views, request)
        usable = torch.ones_like(made.confidence, dtype=torch.bool)
        if self._model.points_alone and not recorded_at_pose(views[0], self._given.recorded):
            usable[0] = False
        trust = made.confidence * usable
        source, color_alone = COLOR_ALONE.get(self._parts, SOURCE), self._parts in COLOR_ALONE
        observations = [
            Observation(
                view, made.rgb[i], None if color_alone else made.depth[i], None if color_alone else made.semantics[i], trust[i],
                usable[i], "virtual", source,
            )
            for i, view in enumerate(made_views)
        ]  # fmt: skip
        return sample, condition, observations

    def _generated(
        self, condition: Condition, fine: Condition, views: Sequence[View], request: SampleRequest
    ) -> tuple[GeneratedClip, GeneratedClip, tuple[View, ...]]:
        """The clip at the size the model works at; it and its views at the size that is written, without depth in the sky."""
        model = self._model
        if self._full_size and isinstance(model, MDM) and model.finisher is not None and self._parts != FREEVS:
            sample, finished = generated_and_finished(model, condition, fine, request)
            return sample, without_sky_depth(finished, fine), tuple(views)
        sample = generated(model, condition, request)
        made = without_sky_depth(sample, condition)
        if not self._full_size:
            return sample, made, condition.views
        size = views[0].camera.height, views[0].camera.width
        conditions = None if model.points_alone or self._parts == FREEVS else (condition, fine)
        return sample, enlarge(made, size, conditions), tuple(views)


def without_sky_depth(clip: GeneratedClip, condition: Condition) -> GeneratedClip:
    """The clip with NaN for the depth of what is classed as sky and was not measured."""
    sky = (clip.semantics == SKY).unsqueeze(1) & ~condition.measurement.valid
    return replace(clip, depth=torch.where(sky, torch.nan, clip.depth))


def recorded_at_pose(view: View, recorded: Sequence[Photo]) -> bool:
    """Whether a recorded image was taken where `view` is (to 5 cm and 10 mrad).

    The published model puts the reference, as it was recorded, into frame 0 of a window. On a shifted trajectory that frame is a
    picture from another place, and must not be used as if it were one from there.
    """
    for image in recorded:
        moved = image.view.cam_from_world @ view.world_from_cam
        if np.linalg.norm(moved[:3, 3]) < 0.05 and np.abs(moved[:3, :3] - np.eye(3)).max() < 0.01:
            return True
    return False


def enlarge(
    clip: GeneratedClip, size: tuple[int, int], conditions: tuple[Condition, Condition] | None
) -> GeneratedClip:
    """A clip at the size (height, width): colour bicubic, depth f32[T,1,h,w] (NaN = none) and classes nearest, confidence bilinear.

    With the clip's condition and the same at the new size, detail is put back: in colour by `add_detail`; the fine measured depth
    where it is within a tenth of the generated one; and the fine class where the clip has it in that pixel or beside it.
    """
    nearest = lambda x: functional.interpolate(x, size=size, mode="nearest-exact")  # noqa: E731
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


def finer_classes(enlarged: Tensor, made: Tensor, given: Tensor) -> Tensor:
    """Classes i64[T,H,W]: those of `given` u8[T,1,H,W] where `made` i64[T,h,w] has that class in the pixel or one beside it,
    else `enlarged` i64[T,H,W]. The outline is the given one; what is there, the model has decided."""
    size = enlarged.shape[-2:]
    around = functional.pad(made.unsqueeze(1).float(), (1, 1, 1, 1), mode="replicate")
    height, width = made.shape[-2:]
    wanted, there = given.float(), torch.zeros_like(given, dtype=torch.bool)
    for row in range(3):
        for column in range(3):
            beside = around[..., row : row + height, column : column + width]
            there |= functional.interpolate(beside, size=size, mode="nearest-exact") == wanted
    return torch.where(there[:, 0], given[:, 0].long(), enlarged)


def add_detail(rgb: Tensor, small: Condition, full: Condition) -> Tensor:
    """Enlarge generated colour f32[T,3,h,w] to the size of `full`, with the detail that the warped images have there.

    Where the generated colour agrees with the small condition, the finer structure of the full condition (its difference
    from its own reduced copy) is added; the weight falls with the disagreement, to nothing at a difference of 0.12.
    """
    size = full.color.shape[-2:]
    larger = lambda x: functional.interpolate(x, size=size, mode="bicubic", align_corners=False)  # noqa: E731
    reduced = functional.interpolate(full.color, size=rgb.shape[-2:], mode="area")
    detail = full.color - larger(reduced)
    apart = torch.maximum((rgb - small.color).abs(), (rgb - reduced).abs()).amax(1, keepdim=True)
    seen = small.valid if small.warped is None else small.valid | small.warped
    weight = (1 - functional.max_pool2d(apart, 3, stride=1, padding=1) / 0.12).clamp(0, 1) * seen
    weight = functional.interpolate(weight, size=size, mode="bilinear", align_corners=False)
    return (larger(rgb) + weight * detail).clamp(0, 1)


def _sheet_row(condition: Condition, sample: GeneratedClip, i: int) -> np.ndarray:
    """Condition, colour, depth, classes and confidence of one frame side by side, u8[H,5W,3]."""
    cells = [
        to_bytes(condition.color[i]), to_bytes(sample.rgb[i]), depth_colors(sample.depth[i, 0].numpy()),
        class_colors(sample.semantics[i].numpy()), gray(sample.confidence[i, 0].numpy()),
    ]  # fmt: skip
    return np.concatenate(cells, 1)
