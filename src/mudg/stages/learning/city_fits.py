"""Short fits to generated cities, whose renders become part of the conditions that the diffusion model is trained on."""

from __future__ import annotations

import tempfile
from pathlib import Path

from mudg.base import seeds
from mudg.base.renders import RenderPlanes
from mudg.base.types import Photo, View
from mudg.core.fusion import SweepShots
from mudg.data.clips import from_city
from mudg.data.clips.city_log import CityLog
from mudg.data.clips.condition import RenderAt
from mudg.data.clips.from_city import CityClipRules
from mudg.data.cloudfile import write_fused
from mudg.data.scene import SceneWriter
from mudg.stages import fit
from mudg.stages.config import FitConfig
from mudg.stages.config.fit import DensifyConfig, StartConfig
from mudg.stages.fitting.planes import render_planes

FEWEST_STEPS, MOST_STEPS = 100, 300
"""Steps of a training city's fit; those for scoring have the middle of them. How good the renders are varies from log to log."""
MOST_GAUSSIANS, VOXEL_M = 40_000, 0.25
FIT_WIDTHS = 2
"""The images are fitted at this many times the width of the clips."""


def write_fitted_city(rules: CityClipRules, city: int, folder: Path) -> int:
    """Make one city's clips with renders of a fit and write its shard; returns the number of clips. For a process of its own."""
    return from_city.write_city(rules, city, folder, fit_city)


def fit_city(rules: CityClipRules, city: int, log: CityLog) -> RenderAt:
    """Fit a scene to the images that the clips of a city may know; returns what it shows at a view."""
    rng = seeds.numpy_rng(rules.seed, city, "fit")
    steps = int(rng.integers(FEWEST_STEPS, MOST_STEPS)) if city < from_city.HELD_OUT else (FEWEST_STEPS + MOST_STEPS) // 2
    width = from_city.size_of(rules, city)[0] * FIT_WIDTHS
    config = FitConfig(
        method="street_gaussians", iterations=steps, width_px=width, seed=city, preview_every=1_000_000,
        densify=DensifyConfig(max_gaussians=MOST_GAUSSIANS), start=StartConfig(gaussians=MOST_GAUSSIANS, voxel_m=VOXEL_M),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        write_scene(folder / "scene", log, from_city.given_images(rules, city, log))
        write_fused(folder / "fused", log.cloud, {})
        model = fit.load_model(fit.run(config, folder / "scene", folder / "fused", folder / "fit"))

    def render_at(view: View) -> RenderPlanes:
        return render_planes(model, view)

    return render_at


def write_scene(folder: Path, log: CityLog, images: tuple[Photo, ...]) -> None:
    """A scene of some images of a generated log, its boxes and its sweeps."""
    with SceneWriter(folder, "city", log.world.source()) as writer:
        for name in dict.fromkeys(photo.view.camera.name for photo in images):
            writer.add_camera(next(photo.view.camera for photo in images if photo.view.camera.name == name))
        writer.set_ego(log.world.ego_path())
        for track in log.tracks():
            writer.add_track(track)
        counts: dict[str, int] = {}
        for photo in images:
            name = photo.view.camera.name
            labels = {} if photo.semantics is None else {"semantics": photo.semantics}
            writer.add_frame(f"{name}/{counts.setdefault(name, 0):06d}", photo.view, photo.rgb, labels)
            counts[name] += 1
        _add_sweeps(writer, log.sweeps)
        writer.finish()


def _add_sweeps(writer: SceneWriter, sweeps: tuple[SweepShots, ...]) -> None:
    counts: dict[float, int] = {}
    for number, sweep in enumerate(sweeps):
        sensor = "lidar" if counts.setdefault(sweep.time_s, 0) == 0 else "lidar_second"
        counts[sweep.time_s] += 1
        writer.add_sweep(f"{sensor}/{number:06d}", sensor, sweep.time_s, sweep.world_from_lidar, sweep.points)
