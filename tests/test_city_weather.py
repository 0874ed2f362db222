"""Fog, wet ground, snow and night of the generated city, against the same rules in Python."""

from __future__ import annotations

from dataclasses import replace

import city_camera
import numpy as np
import pytest
from city_camera import city_light

from mudg import native
from mudg.base.palette import ID
from mudg.base.types import View
from mudg.city.config import CityConfig
from mudg.city.light import LAMP_POWER, weather_numbers
from mudg.city.world import CityWorld
from mudg.core.weather import air as fog
from mudg.core.weather import light as relight
from mudg.core.weather.gbuffer import euclidean_range, world_points

pytestmark = pytest.mark.skipif(native.library() is None, reason="the city needs the native library")

CLEAR = CityConfig(seed=41, n_frames=3, width=96, height=64, light="day", supersample=1)
WET_IDS = (ID["road"], ID["sidewalk"])


@pytest.fixture(scope="module")
def clear() -> CityWorld:
    return CityWorld(CLEAR)


@pytest.fixture(scope="module")
def view(clear: CityWorld) -> View:
    return clear.frame_views("front")[1]


def test_surfaces_are_unit_normals_and_albedos_without_weather(clear: CityWorld, view: View) -> None:
    assert weather_numbers(CLEAR) is None
    surfaces = city_camera.surfaces(clear, view)
    assert not surfaces.snow.any() and not surfaces.water.any()
    surfaces, truth = city_camera.surfaces(clear, view), clear.render(view)
    solid = ~truth.sky
    np.testing.assert_allclose(np.linalg.norm(surfaces.normal[solid], axis=-1), 1, atol=2e-3)
    assert (surfaces.normal[truth.semantics == ID["road"]] == [0, 0, 1]).all()
    assert 0.03 < surfaces.albedo[truth.semantics == ID["road"]].mean() < 0.4
    assert not surfaces.openness[truth.sky].any()
    facing_away = surfaces.normal @ city_light(CLEAR).surroundings.sun_direction < 0
    leaves = truth.semantics == ID["vegetation"]  # light shines through them
    assert not surfaces.sunlit[facing_away & ~leaves].any()


def test_fog_follows_koschmieder(clear: CityWorld, view: View) -> None:
    """From the clear image by the law alone: the haze of the day is taken away, the fog added, all with the city's
    camera."""
    truth, light = clear.render(view), city_light(CLEAR)
    hazy = CityWorld(replace(CLEAR, fog_visibility_m=120.0)).render(view)
    curve, solid = light.response, ~truth.sky
    distance = euclidean_range(view, np.where(solid, truth.depth, 0))
    shares = [np.exp(-fog.extinction(v) * distance) for v in (light.visibility_m, 120.0)]
    air = light.surroundings.airlight
    shown = curve.encode(fog.veiled(fog.unveiled(curve.decode(truth.rgb), shares[0], air), shares[1], air))
    np.testing.assert_array_equal(hazy.depth, truth.depth)
    error = ((shown - hazy.rgb)[solid] ** 2).mean()
    assert -10 * np.log10(error) > 45
    assert -10 * np.log10(((truth.rgb - hazy.rgb)[solid] ** 2).mean()) < 25


def test_snow_lies_where_the_rule_says() -> None:
    world = CityWorld(replace(CLEAR, snow_cover=0.6))
    at = world.frame_views("front")[1]
    truth, surfaces = world.render(at), city_camera.surfaces(world, at)
    solid = ~truth.sky & ~np.isin(truth.semantics, (ID["person"], ID["rider"], ID["vegetation"]))
    expected = relight.snow_weight(
        world_points(at, truth.depth)[solid], surfaces.normal[solid], surfaces.openness[solid], 0.6, CLEAR.seed
    )
    assert (np.abs(surfaces.snow[solid] - expected) < 0.02).mean() > 0.99
    road = (truth.semantics == ID["road"]) & (surfaces.openness == 1)
    assert 0.2 < (surfaces.snow[road] > 0.5).mean() < 1
    white = road & (surfaces.snow > 0.99)
    np.testing.assert_allclose(surfaces.albedo[white], np.broadcast_to(relight.SNOW_COLOR, (white.sum(), 3)), atol=0.01)


def test_wet_ground_is_where_the_rule_says_and_nothing_else_changes(clear: CityWorld, view: View) -> None:
    world = CityWorld(replace(CLEAR, wet=1.0, puddles=0.4))
    dry, wet, surfaces = clear.render(view), world.render(view), city_camera.surfaces(world, view)
    np.testing.assert_array_equal(dry.depth, wet.depth)
    elsewhere = ~np.isin(dry.semantics, WET_IDS)
    np.testing.assert_array_equal(dry.rgb[elsewhere], wet.rgb[elsewhere])
    level = np.isin(dry.semantics, WET_IDS) & (surfaces.normal[..., 2] > 0.8)
    expected = relight.puddle_mask(world_points(view, dry.depth)[level][:, :2], 0.4, CLEAR.seed)
    assert (np.abs(surfaces.water[level] - expected) < 0.1).mean() > 0.98
    film = level & (surfaces.water == 0)
    np.testing.assert_allclose(
        surfaces.albedo[film], relight.WET_DARKENING * city_camera.surfaces(clear, view).albedo[film], rtol=1e-4
    )


def lamp_light(xyz: np.ndarray, normal: np.ndarray, lamps: np.ndarray) -> np.ndarray:
    """Green irradiance over pi f64[N] of lamps [M, 3] that shine down in a cone; nothing casts shadows."""
    to = lamps - xyz[:, None]
    d = np.maximum(np.linalg.norm(to, axis=-1), 0.5)
    edge = np.cos(np.radians(75.0))
    cone = fog.smoothstep(edge, edge + 0.25, to[..., 2] / d) * (d < 45.0)
    facing = np.maximum((normal[:, None] * to).sum(-1) / d, 0)
    return 0.82 * (LAMP_POWER * facing * cone / d**2).sum(1)


def test_lamps_light_the_road_at_night() -> None:
    config = replace(CLEAR, light="night", traffic=0.0)
    world = CityWorld(config)
    assert len(world.lamps) > 2
    at = world.frame_views("front")[1]
    surfaces, truth = city_camera.surfaces(world, at), world.render(at)
    road = truth.semantics == ID["road"]
    points = world_points(at, truth.depth)
    level = lamp_light(points[road], surfaces.normal[road], world.lamps)
    light = city_light(config)
    shown = light.response.decode(truth.rgb)[road][:, 1] / np.maximum(surfaces.albedo[road][:, 1], 1e-3)
    assert np.corrcoef(level, shown)[0, 1] > 0.85  # shadows of what stands between are all that differs
    assert np.median(shown / (level + light.surroundings.ambient[1])) == pytest.approx(1, abs=0.2)
