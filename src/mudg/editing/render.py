"""render: a fitted scene on recorded and shifted trajectories -> observation folders and videos.

OUT/<trajectory>/    observations (see scene/observations.py)
OUT/<trajectory>.mp4 colour, depth, semantics side by side
"""

from __future__ import annotations

import functools
import math
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mudg import native
from mudg.base import log, memory
from mudg.base.devices import choose_device, memory_of
from mudg.base.errors import UsageError
from mudg.base.palette import CLASSES
from mudg.base.processes import computed_ahead
from mudg.base.run_folder import RunDir
from mudg.base.types import Observation, Scene, Trajectory, View
from mudg.baselines.emernerf import load_field, observe
from mudg.core import trajectory
from mudg.core.pictures import panels_of, side_by_side
from mudg.core.raster.rasterize import drawing_device
from mudg.core.trajectory import readout_of
from mudg.diffusion import views as loading
from mudg.diffusion.model_files import is_published
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import JobInputs, ViewMaker, view_maker
from mudg.editing.apply import FACT, Drawer, carry_out, in_weather, scene_seen_by, weather_of
from mudg.editing.script import EditScript, conditions_of
from mudg.editing.settings import RenderConfig
from mudg.formats.exporters.video import write_mp4
from mudg.formats.paths import read_path
from mudg.gaussians.fit import load_model, render_view
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import raster_of
from mudg.gaussians.storage import RADIANCE, kind_of
from mudg.gaussians.views import resized_view
from mudg.scene.observations import ObservationWriter, read_observations
from mudg.scene.read import read_scene

VIEW_BYTES: Final = 4 * (3 + 1 + 1 + len(CLASSES))
"""Bytes per pixel that drawing a view needs at least: colour, depth, coverage and shares of the classes."""
AHEAD_PIXELS: Final = 1_000_000
"""Larger views are drawn one at a time by all threads: less memory."""
VIDEO_FPS: Final = 10.0
REPAIR_STEPS: Final = 2
"""Denoising steps of repairs."""
Edited = tuple[Scene, SceneModel]
"""Scene and fit as they are rendered."""
SHARE_PER_M: Final = 1.0
SHARES: Final = 0.5, 2.0
"""Repairs: a generated view counts as much as its confidence times its metres from the recorded path, with these
bounds, beside 1 for the render."""


def prepare(
    config: RenderConfig, scene: Path, model: Path, script: EditScript | None, path: Path | None = None
) -> Edited | None:
    """Carry out the edit script, if there is one: what cannot be done is told before anything is written. ``path``: as
    of ``trajectories``."""
    if path is not None:
        trajectories(read_scene(scene), config, path)
    if kind_of(model) == RADIANCE:
        if script is not None or config.repair:
            what = "a radiance field has no objects to edit, and cannot be repaired"
            raise UsageError(what, where=str(model), remedy="leave --edits and --repair out")
        choose_device(config.device, "render")
        return None
    drawing_device(config.device, "render", config.raster)
    edited = None if script is None and not config.repair else _scene_and_fit(scene, model, script)
    if edited is not None and config.repair:
        check_as_recorded(edited[1], "--repair")
    return edited


def write_views(
    config: RenderConfig,
    scene: Path,
    model: Path,
    edited: Edited | None,
    work: RunDir,
    *,
    path: Path | None = None,
    fused: Path | None = None,
) -> dict[str, Any]:
    """Render every camera and shift of the configuration, one observation folder (and video) per trajectory; returns a
    summary. An interrupted run continues with the next missing view. ``scene``: gives cameras, times and the path of
    the vehicle. ``model``: folder made by fit. ``edited``: what ``prepare`` made of them. ``path``: as of
    ``trajectories``. ``fused``: fused clouds of the scene, for ``config.repair``."""
    out = work.path
    if kind_of(model) == RADIANCE:
        device = choose_device(config.device, "render")
        loaded, (field, budget) = read_scene(scene), load_field(model)
        source = str(field.facts.get("method", "fit"))
        draw = functools.partial(observe, field.to(device), budget=budget, source=source)
    else:
        device = drawing_device(config.device, "render", config.raster)
        loaded, fitted = edited or _scene_and_fit(scene, model, None)
        fitted = fitted.to(device)
        source, raster = str(fitted.facts.get("method", "fit")), raster_of(fitted, config.raster)
        if config.repair and fused is not None:  # of a global shutter, which is all that the diffusion model knows
            mixer = RenderMixer(JobInputs(scene, fused, model), config.repair_model, config.device)
            draw = lambda view: mixer(view, render_view(fitted, view, raster, source))
        else:
            draw = lambda view: render_view(fitted, view, raster, source, readout_of(loaded, view))
        conditions = conditions_of(fitted.facts.get(FACT, {}).get("script", ()))
        if conditions is not None:
            draw = in_weather(draw, weather_of(draw, conditions, loaded))
    paths = trajectories(loaded, config, path)
    largest = max((view.camera for path in paths for view in path.views), key=lambda one: one.width * one.height)
    asked = f"a view of {largest.width} x {largest.height} pixels"
    memory.require(largest.width * largest.height * VIEW_BYTES, asked, "smaller views (--width-px)")
    threads = 1 if config.repair or device.type != "cpu" else native.threads()
    with (
        log.task(f"render {source}", sum(len(path) for path in paths)) as bar,
        memory_of(device, "render"),
        ThreadPoolExecutor(1) as encoder,
    ):
        videos = list[Future[None]]()
        for path in paths:
            _render_trajectory(draw, threads, path, out / path.name, source, bar)
            if config.video and not (out / f"{path.name}.mp4").is_file():
                videos.append(encoder.submit(_write_video, out / path.name))
        for video in videos:
            video.result()
    return {"trajectories": [path.name for path in paths], "views": sum(len(path) for path in paths)}


def _scene_and_fit(scene: Path, model: Path, script: EditScript | None) -> Edited:
    """The scene, with the vehicle on the path that the fit asks for, and the fit; both edited if there is a script."""
    fitted = load_model(model)
    loaded = scene_seen_by(read_scene(scene), fitted.facts)
    if script is None:
        return loaded, fitted
    drive = carry_out(script, fitted, loaded)
    return drive.scene or loaded, drive.model(fitted)


def trajectories(scene: Scene, config: RenderConfig, path: Path | None = None) -> tuple[Trajectory, ...]:
    """The trajectories a configuration names: every camera at every shift (0 = recorded), and on every further path; or
    that in the file ``path`` alone, with the optics of the first camera. UsageError: an unknown camera, or nothing to
    render. InputError: the file holds no path."""
    cameras = config.cameras or tuple(scene.cameras)[:1]
    if path is not None:
        camera = scene.frames_of(cameras[0])[0].view.camera
        paths = [read_path(path, scene, camera)]
    elif not config.shifts_m and not config.paths:
        what, remedy = "nothing to render: no shifts were given", "at least one of --shifts-m; 0 is the recorded path"
        raise UsageError(what, remedy=remedy)
    else:
        paths = []
        for camera in cameras:
            paths += [trajectory.at_shift(scene, camera, shift_m) for shift_m in config.shifts_m]
            paths += [trajectory.named(scene, camera, name) for name in config.paths]
    optics = lambda path, view: _optics(view, config, rolls=path.origin == "recorded")
    return tuple(Trajectory(one.name, tuple(optics(one, view) for view in one.views), one.origin) for one in paths)


def _optics(view: View, config: RenderConfig, rolls: bool) -> View:
    """A view with the field of view and the width that are asked for; its shutter is a global one unless it rolls."""
    if not rolls:
        view = replace(view, camera=replace(view.camera, readout_s=0.0, shutter="global"))
    if config.fov_deg:
        focal = view.camera.width / 2 / math.tan(math.radians(config.fov_deg) / 2)
        view = replace(view, camera=replace(view.camera, fx=focal, fy=focal * view.camera.fy / view.camera.fx))
    return resized_view(view, config.width_px)


def _drawn(draw: Drawer, views: Sequence[View], threads: int) -> Generator[Observation, None, None]:
    """Views in order; small ones beforehand, in as many threads, so that a thread draws while another writes."""
    if threads == 1 or any(view.camera.width * view.camera.height > AHEAD_PIXELS for view in views):
        yield from map(draw, views)
        return
    with native.one_thread():
        yield from computed_ahead(lambda number: draw(views[number]), len(views), threads)


def _render_trajectory(
    draw: Drawer, threads: int, path: Trajectory, out: Path, source: str, bar: log.ProgressTask
) -> None:
    """One folder of observations; views that an earlier, interrupted run wrote are kept."""
    if (out / "observations.json").is_file():
        bar.advance(len(path))
        return
    with ObservationWriter(out, path.name, source) as writer:
        kept = path.views[: writer.done]
        for view in kept:
            writer.skip(view)
            bar.advance()
        with closing(_drawn(draw, path.views[len(kept) :], threads)) as made:
            for observation in made:
                writer.add(observation)
                bar.advance()


def _write_video(folder: Path) -> None:
    """Of a folder of observations, beside it."""
    views = read_observations(folder)
    pictures = (side_by_side(panels_of(views[index])) for index in range(len(views)))
    write_mp4(folder.with_name(f"{folder.name}.mp4"), pictures, VIDEO_FPS)


# -- repairs ---


def check_as_recorded(fitted: SceneModel, where: str) -> None:
    """UsageError if the Gaussians are of an edited drive: photographs may still show what was removed."""
    if FACT in fitted.facts:
        what = "only a fit of the drive as it was recorded can be repaired"
        got, expected = "Gaussians of an edited drive", "Gaussians made by fit"
        raise UsageError(what, where=where, expected=expected, got=got, remedy="leave it out")


class RenderMixer:
    """Views of a fit, each mixed with what the diffusion model makes of it. UsageError: a published-type model, which
    makes clips of many frames from noise, or one that uses no renders.

    The model makes the view once more, from the fused points, the photographs and the render, and says how sure it is.
    What it makes of a view does not depend on other views: in windows of a path they come out the same to 58 dB.
    Near the recorded path the render counts for more, since photographs of the same places made it; away from there
    the generated view does (`SHARE_PER_M`)."""

    def __init__(self, inputs: JobInputs, model: str = "embedded", device: str = "auto") -> None:
        if is_published(model):
            what, expected = "a published-type model uses no renders and cannot repair them", "a small model"
            raise UsageError(what, where="--repair-model", expected=expected, got=model)
        config = SynthesizeConfig(model=model, steps=REPAIR_STEPS, device=device, processes=1)
        self._settings = loading.check_config(config, fitted=True)
        self._inputs, self._model = inputs, loading.load_any(self._settings)
        self._maker: tuple[tuple[int, int], ViewMaker] | None = None
        recorded = read_scene(inputs.scene)
        self._paths = [
            np.array([frame.view.world_from_cam[:3, 3] for frame in recorded.frames_of(name)])
            for name in recorded.cameras
        ]

    def __call__(self, view: View, render: Observation) -> Observation:
        """The view, from its render, which has its depth."""
        size = view.camera.width, view.camera.height
        if self._maker is None or self._maker[0] != size:
            self._maker = size, view_maker(self._settings, self._inputs, [view], self._model, None)
        off_m = min(off_path_m(view.world_from_cam[:3, 3], path) for path in self._paths)
        share = min(max(SHARE_PER_M * off_m, SHARES[0]), SHARES[1])
        return mixed(render, self._maker[1].make([view], 0, None)[2][0], share)


def off_path_m(place: NDArray[np.float64], path: NDArray[np.float64]) -> float:
    """Metres from a place f64[3] to a path f64[N,3] of straight pieces."""
    along = np.diff(path, axis=0, append=path[-1:])
    at = ((place - path) * along).sum(1) / np.maximum((along**2).sum(1), 1e-12)
    return float(np.linalg.norm(place - path - at.clip(0, 1)[:, None] * along, axis=1).min())


def mixed(render: Observation, generated: Observation, share: float) -> Observation:
    """The mean of a render and of the generated view with ``share`` times its confidence as weight, colour and depth;
    depth that only one of them has is taken from it. Classes and confidence are the render's."""
    weight = share * generated.confidence * generated.mask
    mean = lambda a, b: (a + weight * b) / (1 + weight)
    depth = render.depth
    if depth is not None and generated.depth is not None:
        known = torch.isfinite(depth)
        depth = torch.where(known & torch.isfinite(generated.depth), mean(depth, generated.depth), depth)
        depth = torch.where(known, depth, generated.depth)
    return replace(render, rgb=mean(render.rgb, generated.rgb).clamp(0, 1), depth=depth)
