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
from typing import Any, Final, cast

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
from mudg.diffusion.synthesize import JobInputs
from mudg.editing import harmonised
from mudg.editing.apply import FACT, Drawer, EditedDrive, carry_out, in_weather, scene_seen_by, weather_of
from mudg.editing.harmonised import EditedSources, RepairedViews
from mudg.editing.script import EditScript, conditions_of
from mudg.editing.settings import RenderConfig
from mudg.formats.exporters.video import write_mp4
from mudg.formats.paths import read_path
from mudg.gaussians.fit import load_model, render_view
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import raster_of
from mudg.gaussians.storage import RADIANCE, kind_of
from mudg.gaussians.views import resized_view
from mudg.scene.clouds import read_fused
from mudg.scene.observations import ObservationWriter, read_observations
from mudg.scene.read import read_scene

VIEW_BYTES: Final = 4 * (3 + 1 + 1 + len(CLASSES))
"""Bytes per pixel that drawing a view needs at least: colour, depth, coverage and shares of the classes."""
AHEAD_PIXELS: Final = 1_000_000
"""Larger views are drawn one at a time by all threads: less memory."""
VIDEO_FPS: Final = 10.0
Edited = tuple[Scene, SceneModel, EditedDrive | None]
"""Scene and fit as they are rendered, and what an edit script did to them (None: there is none)."""


def prepare(
    config: RenderConfig,
    scene: Path,
    model: Path,
    script: EditScript | None,
    fused: Path | None,
    path: Path | None = None,
) -> Edited | None:
    """Carry out the edit script, if there is one: what cannot be done is told before anything is written. ``fused``:
    fused clouds of the scene, for ``config.harmonize``. ``path``: as of ``trajectories``."""
    if path is not None:
        trajectories(read_scene(scene), config, path)
    radiance = kind_of(model) == RADIANCE
    if radiance and (config.remove_tracks or script is not None):
        what = "a radiance field has no objects to leave out or to edit"
        raise UsageError(what, where=str(model), remedy="leave --remove-tracks and --edits out")
    choose_device(config.device, "render") if radiance else drawing_device(config.device, "render", config.raster)
    edited = None
    if script is not None or (config.repair and not radiance):
        edited = _edited(scene, model, script, fused if config.harmonize.on else None)
    if config.repair:
        if edited is None:
            what, expected = "a radiance field cannot be repaired", "Gaussians made by fit"
            raise UsageError(what, where="--repair", expected=expected, got=str(model), remedy="leave it out")
        harmonised.check_as_recorded(edited[1], "--repair")
    if edited is not None and config.harmonize.on:
        lengths = {one.name: len(one) for one in trajectories(edited[0], config, path)}
        harmonised.check_paths(config.harmonize, lengths)
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
    repaired, out = None, work.path
    if kind_of(model) == RADIANCE:
        device = choose_device(config.device, "render")
        loaded, (field, budget) = read_scene(scene), load_field(model)
        source = str(field.facts.get("method", "fit"))
        draw = functools.partial(observe, field.to(device), budget=budget, source=source)
    else:
        device = drawing_device(config.device, "render", config.raster)
        loaded, fitted, drive = edited or _edited(scene, model, None)
        draw, source = _scene_drawer(config, fitted.to(device), loaded)
        if config.repair:
            inputs = JobInputs(scene, cast("Path", fused), model)
            mixer, plain = harmonised.RenderMixer(inputs, config.harmonize, config.device), draw
            draw = lambda view: mixer(view, plain(view))
        if config.harmonize.on and drive is not None:
            draw = repaired = _repaired(config, drive, fitted, scene, model, draw)
        conditions = conditions_of(fitted.facts.get(FACT, {}).get("script", ()))
        if conditions is not None:
            draw = in_weather(draw, weather_of(draw, conditions, loaded))
    paths = trajectories(loaded, config, path)
    largest = max((view.camera for path in paths for view in path.views), key=lambda one: one.width * one.height)
    asked = f"a view of {largest.width} x {largest.height} pixels"
    memory.require(largest.width * largest.height * VIEW_BYTES, asked, "smaller views (--width-px)")
    threads = 1 if repaired or config.repair or device.type != "cpu" else native.threads()
    with (
        log.task(f"render {source}", sum(len(path) for path in paths)) as bar,
        memory_of(device, "render"),
        ThreadPoolExecutor(1) as encoder,
    ):
        videos = list[Future[None]]()
        for path in paths:
            if repaired:
                repaired.follow(path)
            _render_trajectory(draw, threads, path, out / path.name, source, bar)
            if config.video:
                videos.append(encoder.submit(_write_video, out / path.name, out / f"{path.name}.mp4"))
        for video in videos:
            video.result()
    return {"trajectories": [path.name for path in paths], "views": sum(len(path) for path in paths)}


def _edited(
    scene: Path, model: Path, script: EditScript | None, fused: Path | None = None
) -> tuple[Scene, SceneModel, EditedDrive | None]:
    """The scene, with the vehicle on the path that the fit asks for, and the fit; both edited if there is a script; and
    what it did."""
    fitted = load_model(Path(model))
    loaded = scene_seen_by(read_scene(Path(scene)), fitted.facts)
    if script is None:
        return loaded, fitted, None
    drive = carry_out(script, fitted, loaded, None if fused is None else read_fused(Path(fused)))
    return drive.scene or loaded, drive.model(fitted), drive


def _repaired(
    config: RenderConfig, drive: EditedDrive, fitted: SceneModel, scene: Path, model: Path, draw: Drawer
) -> RepairedViews:
    """What draws views of an edited fit with the touched pixels repaired; ``scene`` and ``model``: folders, as they are
    without the edits."""
    before = load_model(model)
    recorded = scene_seen_by(read_scene(scene), before.facts)
    usual, _ = _scene_drawer(config, before.to(fitted.device), recorded)
    sources = EditedSources.of(drive, fitted, recorded)
    camera = trajectories(recorded, config)[0].views[0].camera
    repair = harmonised.Harmoniser(sources, config.harmonize, (camera.width, camera.height), config.device)
    return RepairedViews(repair, lambda view: (usual(view), draw(view)))


def _scene_drawer(config: RenderConfig, fitted: SceneModel, scene: Scene) -> tuple[Drawer, str]:
    """What draws the views of a scene of Gaussians, and its name. Rolling shutters of recorded views are followed, but
    for repairs, which know global ones alone."""
    if config.remove_tracks:
        fitted = fitted.without_nodes(config.remove_tracks)
    source, raster = str(fitted.facts.get("method", "fit")), raster_of(fitted, config.raster)
    still = config.repair or config.harmonize.on
    rolls = lambda view: None if still else readout_of(scene, view)
    return lambda view: render_view(fitted, view, raster, source, rolls(view)), source


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
    optics = lambda path, view: _optics(view if path.origin == "recorded" else _still(view), config)
    return tuple(Trajectory(one.name, tuple(optics(one, view) for view in one.views), one.origin) for one in paths)


def _still(view: View) -> View:
    """A view whose camera has a global shutter."""
    return replace(view, camera=replace(view.camera, readout_s=0.0, shutter="global"))


def _optics(view: View, config: RenderConfig) -> View:
    """A view with the field of view and the width that are asked for."""
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


def _write_video(observations: Path, path: Path) -> None:
    if path.is_file():
        return
    views = read_observations(observations)
    write_mp4(path, (side_by_side(panels_of(views[index])) for index in range(len(views))), VIDEO_FPS)
