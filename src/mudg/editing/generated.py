"""Views of edited drives that a diffusion model generates: the drive that ``synthesize --edits`` reads in place of the
recorded one."""

from __future__ import annotations

import functools

from mudg.base.errors import UsageError
from mudg.base.types import Scene
from mudg.diffusion.published import is_published
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.synthesize import Drive, JobInputs
from mudg.diffusion.views import FREEVS, recorded_images
from mudg.editing import weathered
from mudg.editing.recorded import drive_of_edits, photos_of_edited, vacated_at
from mudg.editing.script import EditScript
from mudg.gaussians.rendering import raster_of, render_view
from mudg.gaussians.storage import load_model
from mudg.scene.clouds import read_fused
from mudg.scene.read import read_scene


def edited_scene(script: EditScript, config: SynthesizeConfig, given: JobInputs, scene: Scene) -> Scene:
    """The scene as the script leaves it. What cannot be done is told here, before anything is written.

    Raises:
        UsageError: a condition that shows no edits, or an edit that the drive does not allow.
    """
    if config.condition == FREEVS:
        raise UsageError(
            "this condition is made of recorded sweeps, which show no edits",
            where="--condition",
            got=FREEVS,
            remedy="edit a whole run with `mudg edit` and give its scene",
        )
    told = not shows_weather(config, script, given.fitted is not None)
    fitted = None if given.fitted is None else load_model(given.fitted)
    return drive_of_edits(script, scene, read_fused(given.fused), fitted, told=told).scene


def edited_drive(script: EditScript, config: SynthesizeConfig, given: JobInputs) -> Drive:
    """The drive as the script leaves it: its scene, clouds and fit, recorded images without what they show wrongly, and
    its weather."""
    scene, cloud = read_scene(given.scene), read_fused(given.fused)
    fit = None if given.fitted is None else load_model(given.fitted)
    drive = drive_of_edits(script, scene, cloud, fit)
    conditions, weather = weathered.conditions_of(script.canonical()), None
    if conditions is not None and drive.model is not None and shows_weather(config, script, True):
        draw = functools.partial(render_view, drive.model, raster=raster_of(drive.model))
        weather = weathered.weather_of(draw, conditions, drive.scene)
    recorded = photos_of_edited(recorded_images(scene, config), drive.plan)
    return Drive(drive.scene, drive.cloud, recorded, drive.model, vacated_at(drive.plan), weather)


def shows_weather(config: SynthesizeConfig, script: EditScript, fitted: bool) -> bool:
    """Whether views are generated in the weather and light of a script: by a published-type model, from points and a
    reference in that weather, whose distances a fit tells."""
    conditions = weathered.conditions_of(script.canonical())
    wanted = conditions is not None and conditions.changes_air_ground_or_light and fitted and config.condition == "full"
    return wanted and is_published(config.model)
