"""Conditions in other weather or light, and exact pairs for learning what the edit of colours leaves wrong.

A condition is edited as views are (`core.weather`): the colours of what was seen, of the backdrop and of the renders, each with its own
depth and classes; then it says so in its effect vector. Its geometry and classes stay. What the published system is given, points and a
reference image, is edited before it is brought to the network's size (`WeatheredPoints`).

`pairs_of` makes training clips: the condition of a clear day, edited so, and the same city generated in that weather. Rain and snow that
fall, and the vehicle's headlights, are put into the generated image by the formulas of the edit, but from exact depth, normals, albedo,
light and camera response: the city has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import palette, seeds
from mudg.base.effects import effect_vector
from mudg.base.types import Condition, View
from mudg.base.weather_settings import Conditions, LightSettings, WeatherSettings
from mudg.core import trajectory, weather
from mudg.core.weather import DriveFacts, ShownView, relight
from mudg.core.weather.gbuffer import GBuffer, Surroundings, from_render
from mudg.core.weather.tone import SRGB
from mudg.data.city import CityConfig, CityTruth, CityWorld
from mudg.data.city.weather import city_light
from mudg.data.city.world import CitySurfaces
from mudg.data.clips.condition import ProjectedPoints, RenderAt

SKY: Final = palette.ID["sky"]
BACKDROP_M: Final = 80.0
"""Distance of what the backdrop alone shows."""
WITNESSES: Final = 8
"""Views of a log by which its light is estimated."""
KINDS: Final = ("fog", "overcast", "rain", "wet", "snow", "dusk", "night")


@dataclass(frozen=True, eq=False)
class InWeather:
    """Weather for the views of a drive: settings, light and ground of the drive, seed of drops and patches, and the velocity of the
    cameras at a time."""

    settings: Conditions
    drive: DriveFacts
    seed: int
    velocity_at: Callable[[float], tuple[float, float, float]]

    def image(self, view: View, rgb: Tensor, depth: Tensor, ids: Tensor) -> Tensor:
        """Colours f32[3,H,W] in this weather, from depth f32[1,H,W] and classes u8[1,H,W]; sky has no depth."""
        metres = torch.where(ids == SKY, torch.zeros_like(depth), depth)[0].numpy().astype(np.float32)
        shown = ShownView(view, rgb.permute(1, 2, 0).numpy(), metres, ids[0].numpy())
        made, _ = weather.edited_view(shown, self.settings, self.seed, self.drive, self.velocity_at(view.time_s))
        return torch.from_numpy(np.ascontiguousarray(made.transpose(2, 0, 1), np.float32)).clamp(0, 1)


@dataclass(frozen=True, eq=False)
class WeatheredPoints:
    """Points and recorded images of a drive in weather, with the surfaces of a fitted scene between the points and behind the images."""

    how: InWeather
    render_at: RenderAt

    def points(self, view: View, seen: ProjectedPoints) -> Tensor:
        """Colours f32[3,H,W] of projected points in this weather, each at its own distance; meaningless where there are none."""
        shown = self.render_at(view)
        ids = torch.where(seen.valid & (shown.semantics == SKY), palette.UNLABELLED, shown.semantics)
        depth = torch.where(seen.valid, seen.depth, shown.depth)
        return self.how.image(view, torch.where(seen.valid, seen.rgb, shown.color), depth, ids.to(torch.uint8))

    def photo(self, view: View, rgb: Tensor) -> Tensor:
        """A recorded image f32[3,H,W] in this weather."""
        shown = self.render_at(view)
        return self.how.image(view, rgb, shown.depth, shown.semantics)


def weathered(condition: Condition, how: InWeather) -> Condition:
    """The condition with its colours in other weather or light, and with the effect vector that says so. Its reference stays."""
    given, unknown = condition, torch.full_like(condition.valid, palette.UNLABELLED, dtype=torch.uint8)
    ids = unknown if given.semantics is None else given.semantics
    far_ids = unknown if given.backdrop_semantics is None else given.backdrop_semantics
    far_depth = torch.where(ids == SKY, BACKDROP_M, given.depth)

    def each(color: Tensor, depth: Tensor, classes: Tensor) -> Tensor:
        return torch.stack([how.image(*planes) for planes in zip(given.views, color, depth, classes, strict=True)])

    renders = given.renders
    if renders is not None:
        renders = replace(renders, color=each(renders.color, renders.depth, renders.semantics))
    vector = effect_vector(how.settings)
    return replace(
        given, color=each(given.color, given.depth, ids), renders=renders,
        backdrop=None if given.backdrop is None else each(given.backdrop, far_depth, far_ids),
        effect=None if vector is None else torch.tensor(vector),
    )  # fmt: skip


# exact pairs ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WeatherPair:
    """The same weather twice: as an edit says it, and as a change of the city's configuration."""

    settings: Conditions
    changes: dict[str, Any]


def draw_pair(kind: str, rng: np.random.Generator, clear: CityConfig) -> WeatherPair:
    """Weather of one of `KINDS`, with strengths drawn."""
    uniform = lambda low, high: round(float(rng.uniform(low, high)), 3)  # noqa: E731
    sky: dict[str, Any] = {"weather": {}, "light": {"headlights": False}}
    changes: dict[str, Any] = {}
    light = {"overcast": "overcast", "rain": "overcast", "dusk": "dusk", "night": "night"}.get(kind)
    if kind in ("fog", "snow") and rng.random() < 0.5:
        light = "overcast"
    if kind == "fog":
        visibility_m = round(float(np.exp(rng.uniform(np.log(40), np.log(400)))), 1)
        sky["weather"]["fog"], changes["fog_visibility_m"] = {"visibility_m": visibility_m}, visibility_m
    if kind in ("rain", "wet") or (kind == "night" and rng.random() < 0.4):
        puddles = uniform(0, 0.5) if rng.random() < 0.6 else 0.0
        wet = uniform(0.4, 1)
        sky["weather"] |= {"wet": wet, "puddles": puddles}
        changes |= {"wet": wet, "puddles": puddles}
    if kind == "rain":
        sky["weather"]["rain"] = {"mm_h": uniform(2, 30)}
    if kind == "snow":
        cover = uniform(0.4, 1)
        sky["weather"]["snow"] = {"cover": cover, "mm_h": uniform(0.5, 3) if rng.random() < 0.5 else 0.0, "tracks": 1.0}
        changes["snow_cover"] = cover
    if kind == "night" and rng.random() < 0.6:
        sky["light"]["headlights"] = True
    if light:
        changes["light"] = sky["light"]["time"] = light
    if light == "dusk":
        x, y, z = city_light(replace(clear, light="dusk")).surroundings.sun_direction
        sky["light"] |= {
            "sun_azimuth_deg": float(np.degrees(np.arctan2(y, x))), "sun_elevation_deg": float(np.degrees(np.arcsin(z))),
        }  # fmt: skip
    return WeatherPair(Conditions.model_validate(sky), changes)


def witnesses(world: CityWorld, render_at: RenderAt, size: tuple[int, int]) -> DriveFacts:
    """Light and ground of a drive as an edit finds them: from what its fitted scene shows at some recorded views."""
    views = world.frame_views("front")
    chosen = np.unique(np.linspace(0, len(views) - 1, min(WITNESSES, len(views))).round().astype(int))
    shown = []
    for number in chosen:
        view = views[int(number)].resized(*size)
        seen = render_at(view)
        depth = torch.where(seen.semantics == SKY, torch.zeros_like(seen.depth), seen.depth)[0].numpy()
        shown.append(
            ShownView(view, seen.color.permute(1, 2, 0).numpy(), depth.astype(np.float32), seen.semantics[0].numpy())
        )
    return weather.drive_facts(shown, SRGB)


def pairs_of(
    conditions: Sequence[Condition], world: CityWorld, drive: DriveFacts, key: int
) -> list[tuple[Condition, list[CityTruth], WeatherPair]]:
    """Each condition in one weather, with the truth of its views; every kind in turn.

    Args:
        conditions: of exact views of a city on a clear day. drive: its light and ground. key: fixes what is drawn.
    """
    made = []
    for number, condition in enumerate(conditions):
        rng = seeds.numpy_rng(key, number, "weather")
        pair = draw_pair(KINDS[(key + number) % len(KINDS)], rng, world.config)
        how = InWeather(
            pair.settings, drive, world.config.seed, lambda time_s: trajectory.velocity(world.ego_path(), time_s)
        )
        there = CityWorld(replace(world.config, **pair.changes))
        truths = [_completed(there, there.render(view), view, how) for view in condition.views]
        made.append((weathered(condition, how), truths, pair))
    return made


def _completed(world: CityWorld, truth: CityTruth, view: View, how: InWeather) -> CityTruth:
    """The truth with what the city has none of: rain and snow in the air, headlights."""
    asked, light = how.settings.weather, how.settings.light
    rain, snow = (
        asked.rain,
        None if asked.snow is None or not asked.snow.mm_h else asked.snow.model_copy(update={"cover": 0.0}),
    )
    headlights = light.time == "night" and light.headlights
    if rain is None and snow is None and not headlights:
        return truth
    around = city_light(world.config, world.lamps)
    curve = around.response.curve()
    gbuffer = from_render(view, curve.decode(truth.rgb), truth.depth, truth.semantics)
    gbuffer = replace(gbuffer, camera_velocity=how.velocity_at(view.time_s))
    if headlights:
        gbuffer = replace(gbuffer, color=_with_headlights(gbuffer, world.surfaces(view), view, light))
    falling = Conditions(weather=WeatherSettings(rain=rain, snow=snow), response=how.settings.response)
    made = weather.apply(gbuffer, falling, view, view.time_s, how.seed, around.surroundings)
    shown: NDArray[np.float32] = curve.encode(made.color).astype(np.float32)
    return replace(truth, rgb=np.clip(shown, 0, 1))


def _with_headlights(gbuffer: GBuffer, exact: CitySurfaces, view: View, light: LightSettings) -> NDArray[np.float32]:
    """Linear light f32[H,W,3] with that of the vehicle's headlights on exact surfaces."""
    alone = light.model_copy(update={"lamps": False})
    surfaces = replace(gbuffer, normal=exact.normal)
    nothing = Surroundings(*(np.zeros(3) for _ in range(3)), np.zeros(3), np.array([0.0, 0.0, 1.0]), np.zeros(3))
    added = exact.albedo * relight.night_lights(surfaces, view, nothing, alone)
    return (gbuffer.color + np.where(gbuffer.sky[..., None], 0, added)).astype(np.float32)
