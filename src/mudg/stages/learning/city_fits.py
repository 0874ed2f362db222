"""Short fits to generated cities, whose renders become part of the conditions that the diffusion model is trained on."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

from mudg.base import seeds
from mudg.base.config import result_settings
from mudg.base.renders import RenderPlanes
from mudg.base.run_folder import RunDir
from mudg.base.types import View
from mudg.data.clips import from_city
from mudg.data.clips.city_log import CityLog
from mudg.data.clips.condition import RenderAt
from mudg.data.clips.from_city import CityClipRules
from mudg.data.cloudfile import write_fused
from mudg.data.scene.photos import PlacedSweep, write_photos
from mudg.stages import fit
from mudg.stages.fitting.planes import render_planes
from mudg.stages.fitting.short import short_fit


def write_fitted_city(rules: CityClipRules, city: int, folder: Path) -> int:
    """Make one city's clips with renders of a fit and write its shard; returns the number of clips. For a process of its own."""
    return from_city.write_city(rules, city, folder, fit_city)


def fit_city(rules: CityClipRules, city: int, log: CityLog) -> RenderAt:
    """Fit a scene to the images that the clips of a city may know; returns what it shows at a view."""
    steps = steps_of(rules, city)
    width = from_city.size_of(rules, city)[0]
    images = from_city.given_images(rules, city, log)
    config = short_fit(steps, width, images[0].view.camera.width, seed=city)
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        write_photos(folder / "scene", log.world.source(), log.world.ego_path(), log.tracks(), images, placed_sweeps(log))
        write_fused(folder / "fused", log.cloud, {})
        work = RunDir.open(folder / "fit", fit.OUTPUT, result_settings(config), {})
        fit.write_fit(config, fit.FitInputs(folder / "scene", folder / "fused"), work)
        model = fit.load_model(work.path)

    def render_at(view: View) -> RenderPlanes:
        return render_planes(model, view)

    return render_at


def steps_of(rules: CityClipRules, city: int) -> int:
    """Steps of a city's fit, drawn from `rules.fit_steps`, because renders of logs are of different quality, too."""
    fewest, most = rules.fit_steps
    if city >= from_city.HELD_OUT or fewest == most:
        return (fewest + most) // 2
    return int(seeds.numpy_rng(rules.seed, city, "fit").integers(fewest, most))


def placed_sweeps(log: CityLog) -> Iterator[PlacedSweep]:
    """The sweeps of a generated log; a second one at the same time comes from a second sensor."""
    last_s = -math.inf
    for sweep in log.sweeps:
        yield "lidar_second" if sweep.time_s == last_s else "lidar", sweep.time_s, sweep.world_from_lidar, sweep.points
        last_s = sweep.time_s
