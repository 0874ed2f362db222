"""synthesize: dense colour, depth and semantics on trajectories that were never driven.

For every trajectory: build the condition view by view from the fused cloud and the recorded images, run the diffusion
model over windows of frames, write one folder of observations. Windows overlap; the shared frames are fixed in the
later window, so that the video continues. The last window ends at the last frame: every frame of the trajectory is
produced.

OUT/<trajectory>/        observations (see `scene/observations.py`) and overview.png
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

from mudg import native
from mudg.base import log, memory, store
from mudg.base.errors import UsageError
from mudg.base.processes import run_in_processes
from mudg.base.records import understood
from mudg.base.run_folder import RunDir
from mudg.base.types import Condition, FusedCloud, Photo, Scene, Trajectory, View
from mudg.core import trajectory
from mudg.core.pictures import class_colors, depth_colors, gray, to_bytes
from mudg.core.raster.cpu import release_memory
from mudg.diffusion.condition import ConditionRules, PreparedImages, VacatedAt
from mudg.diffusion.inputs import ConditionSources, InWeather
from mudg.diffusion.requests import GeneratedClip
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import (
    EDITED_IMAGES_PER_VIEW,
    DiffusionModel,
    ViewMaker,
    half_of,
    load_any,
    recorded_images,
    source_of,
)
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import render_planes
from mudg.gaussians.storage import load_model
from mudg.scene.clouds import read_fused
from mudg.scene.observations import ObservationWriter
from mudg.scene.read import read_scene

FITS = "depth_fits.json"
"""Frame -> [scale, shift in metres, median relative residual before, after] of the alignment of its depth."""
PROCESS_BYTES = int(1.2 * memory.GIB)
PIXEL_BYTES, FRAME_PIXEL_BYTES = 240, 80
"""What a process takes: with the small models; for each pixel of the written size; and for each pixel of a window's
frames. Measured: 2.0 GiB at 1242x375 with windows of eight frames, 3.85 GiB at 3840x2160 with three, where conditions
lie in files (4.5 GiB before)."""
WINDOW_FRAMES = 8


@dataclass(frozen=True, slots=True, eq=False)
class DriveInputs:
    """What all trajectories are made from, read; ``images``: the recorded ones, as they have been prepared for views of
    a size."""

    scene: Scene
    cloud: FusedCloud
    recorded: list[Photo]
    fit: SceneModel | None = None
    vacated: VacatedAt | None = None
    weather: InWeather | None = None
    images: dict[tuple[int, int], PreparedImages] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class JobInputs:
    """What every trajectory is made from: folders of the scene, its fused clouds and its fit.

    Args:
        edited: reads an edited drive in place of the recorded one; processes are sent it.
    """

    scene: Path
    fused: Path
    fitted: Path | None = None
    edited: Callable[[SynthesizeConfig, JobInputs], DriveInputs] | None = None


def recorded_drive(config: SynthesizeConfig, inputs: JobInputs) -> DriveInputs:
    """The drive as it was recorded."""
    scene = read_scene(inputs.scene)
    fit = None if inputs.fitted is None else load_model(inputs.fitted)
    return DriveInputs(scene, read_fused(inputs.fused), recorded_images(scene, config), fit)


def write_views(config: SynthesizeConfig, inputs: JobInputs, loaded: Scene, work: RunDir) -> dict[str, Any]:
    """Generate all trajectories of the configuration, one folder of observations each; returns a summary.

    Raises:
        UsageError: unknown camera, nothing to make.
    """
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
        _recorded_again.cache_clear()
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
        log.info(
            f"synthesize: {possible} of {wanted} processes: at {camera.width}x{camera.height} each takes about "
            f"{memory.in_words(need)}, and {memory.in_words(free)} are free"
        )
    return possible


# one trajectory -----------------------------------------------------------------------------------


def without_classes(cloud: FusedCloud) -> FusedCloud:
    """The cloud without its points' classes."""
    objects = {name: replace(points, semantics=None) for name, points in cloud.objects.items()}
    return FusedCloud(replace(cloud.static, semantics=None), objects, cloud.colors)


def make_trajectory(
    config: SynthesizeConfig, inputs: JobInputs, out: Path, path: Trajectory, model: DiffusionModel | None = None
) -> int:
    """Generate one trajectory and write its folder; returns the number of views. Continues an interrupted one. `model`:
    that of the configuration, if it is in memory already."""
    folder = out / path.name
    if (folder / "observations.json").is_file():
        return len(path)
    model = model or load_any(config)
    maker = view_maker(config, inputs, path.views, model, out)
    spans = maker.spans(len(path), config.overlap)
    state = folder / "state"
    finished = sorted(state.glob("[0-9]*.safetensors"))  # the last one's latents, by the number of windows
    first, tail = (int(finished[-1].stem), store.read_tensors(finished[-1])) if finished else (0, None)
    with understood("depth fits of an interrupted synthesis", str(state / FITS)):
        fits: dict[str, list[float | None]] = dict(store.read_json(state / FITS)) if (state / FITS).is_file() else {}
    every = max(1, len(path) // 5)
    with ObservationWriter(folder, path.name, source_of(config.condition)) as writer:
        for view in path.views[: spans[first - 1].stop if first else 0]:
            writer.skip(maker.sized(view))
        for number, fresh, (sample, condition, observations) in maker.along(path.views, spans, first, tail):
            for index in fresh:
                place = index - spans[number].start
                writer.add(observations[place])
                if sample.depth_fits:
                    fit = sample.depth_fits[place]
                    numbers = (fit.scale, fit.shift_m, fit.residual_before, fit.residual)
                    fits[f"{index:06d}"] = [round(x, 5) if math.isfinite(x) else None for x in numbers]
                if index % every == 0:
                    row = {"row": _sheet_row(condition, sample, place)}
                    store.write_safetensors(state / f"row{index:06d}.safetensors", row)
            store.write_json(state / FITS, fits)
            store.write_safetensors(state / f"{number + 1:04d}.safetensors", dict(sample.latents))
            (state / f"{number:04d}.safetensors").unlink(missing_ok=True)
            del sample, condition, observations  # before the next window is made
        rows = [store.read_safetensors(file)["row"] for file in sorted(state.glob("row*.safetensors"))]
        if rows:
            store.write_image(folder / "overview.png", np.concatenate(rows))
        if fits:
            store.write_json(folder / FITS, fits)
        shutil.rmtree(state, ignore_errors=True)
    return len(path)


_recorded_again = functools.lru_cache(maxsize=1)(recorded_drive)
"""The same for the next trajectory of a run, which forgets it at its end."""


def view_maker(
    config: SynthesizeConfig, inputs: JobInputs, views: Sequence[View], model: DiffusionModel, scratch: Path | None
) -> ViewMaker:
    """What makes the views of one path; ``scratch``: a folder for what is large (None: it stays in memory)."""
    drive = _recorded_again(config, inputs) if inputs.edited is None else inputs.edited(config, inputs)
    cloud = drive.cloud if config.given_classes else without_classes(drive.cloud)
    camera = views[0].camera
    width, height = model.image_size(camera.width, camera.height, config.width_px)
    model.check_clip(min(len(views), model.config.window), height, width)
    fine = (camera.width, camera.height) if config.full_size or model.points_alone else (2 * width, 2 * height)
    rules = ConditionRules(width, height, *fine, published=model.points_alone)
    rules = rules if inputs.edited is None else replace(rules, images_per_view=EDITED_IMAGES_PER_VIEW)
    render_at = None if drive.fit is None else functools.partial(render_planes, drive.fit)
    sources = ConditionSources(
        cloud, drive.scene.tracks, drive.recorded, rules, render_at, drive.vacated, drive.weather
    )
    return ViewMaker(model, sources, config, images=drive.images.setdefault(fine, PreparedImages(scratch)))


def _sheet_row(condition: Condition, sample: GeneratedClip, i: int) -> np.ndarray:
    """Condition, colour, depth, classes and confidence of one frame side by side, u8[H,5W,3]."""
    depth, ids = depth_colors(sample.depth[i, 0].numpy()), class_colors(sample.semantics[i].numpy())
    cells = [to_bytes(condition.color[i]), to_bytes(sample.rgb[i]), depth, ids, gray(sample.confidence[i, 0].numpy())]
    return np.concatenate(cells, 1)
