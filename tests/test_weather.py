"""Weather on G-buffers and LiDAR returns: closed forms, exact inverses, invariants."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from city_camera import FilmicResponse
from refusals import refused

from mudg.base import geometry
from mudg.base.config import build
from mudg.base.errors import UsageError
from mudg.base.palette import ID
from mudg.base.types import Camera, SweepPoints, View
from mudg.base.weather_settings import Conditions, FogSettings, LightSettings, RainSettings, SnowSettings
from mudg.base.weather_settings import WeatherSettings as Weather
from mudg.core import weather
from mudg.core.weather import air
from mudg.core.weather import gbuffer as surfaces
from mudg.core.weather import light as relight
from mudg.core.weather.gbuffer import GBuffer, OccluderMap, Surroundings, world_points, world_rays

WIDTH, HEIGHT, CAMERA_Z = 60, 40, 1.5
WALL_X = 20.0


def forward_view(
    yaw: float = 0.0, pitch: float = 0.0, x: float = 0.0, time_s: float = 0.0, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> View:
    """A camera 1.5 m above the ground that looks along world x, turned by yaw and downwards by pitch (radians)."""
    c, s = np.cos(pitch), np.sin(pitch)
    body = geometry.yaw_matrix(yaw)[:3, :3] @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    turn = body @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    camera = Camera("front", *size, 50.0, 50.0, size[0] / 2, size[1] / 2)
    return View(camera, geometry.from_rotation_translation(turn, (x, 0, CAMERA_Z)), time_s)


def street(view: View) -> GBuffer:
    """Level road up to a wall across it, 6 m high and with a bright stripe; sky above."""
    rays, _ = world_rays(view)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_ground = np.where(rays[..., 2] < 0, -CAMERA_Z / rays[..., 2], np.inf)
        to_wall = np.where(rays[..., 0] > 0, WALL_X / rays[..., 0], np.inf)
    at_wall = CAMERA_Z + to_wall * rays[..., 2]
    to_wall = np.where((at_wall < 0) | (at_wall > 6), np.inf, to_wall)
    depth = np.minimum(to_ground, to_wall).astype(np.float32)
    classes = np.where(to_ground < to_wall, ID["road"], ID["building"]).astype(np.uint8)
    classes[~np.isfinite(depth)] = ID["sky"]
    color = np.full((*depth.shape, 3), 0.08, np.float32)
    color[classes == ID["building"]] = (0.3, 0.2, 0.1)
    color[(classes == ID["building"]) & (at_wall > 3) & (at_wall < 4)] = (0.9, 0.8, 0.2)
    color[classes == ID["sky"]] = (0.5, 0.6, 0.8)
    normal = np.zeros_like(color)
    normal[classes == ID["road"]] = (0, 0, 1)
    normal[classes == ID["building"]] = (-1, 0, 0)
    return GBuffer(color, depth, classes, normal, surfaces.openness_by_class(classes, normal))


HAZY, BLUE, SKY = np.array([[0.7, 0.75, 0.8], [0.3, 0.5, 0.9], [0.8, 0.9, 1.0]])
LIGHT = Surroundings(HAZY, BLUE, SKY, np.zeros(3), np.array([0.0, 0, 1]), HAZY)
SUNNY = replace(LIGHT, sun=np.array([2.0, 1.9, 1.7]), sun_direction=np.array([-0.6, 0, 0.8]))


# --- response -------------------------------------------------------------------------------------


def test_srgb_has_its_known_values_and_is_inverted_as_is_a_filmic_camera_where_nothing_was_clipped() -> None:
    light = np.linspace(0, 1, 300, dtype=np.float32).reshape(10, 10, 3)
    np.testing.assert_allclose(relight.srgb_decode(relight.srgb_encode(light)), light, atol=2e-6)
    known = [0, 0.04045, 0.46135, 1]
    assert relight.srgb_encode(np.array([0.0, 0.0031308, 0.18, 1.0])) == pytest.approx(known, abs=2e-5)
    curve = FilmicResponse(0.6, (1.02, 1.0, 0.97), saturation=0.9, contrast=1.05, vignette=0.3)
    light = np.random.default_rng(1).uniform(0.05, 1.2, (12, 16, 3))
    shown = curve.encode(light)
    inside = ((shown > 0.001) & (shown < 0.999)).all(-1)
    assert inside.mean() > 0.9
    np.testing.assert_allclose(curve.decode(shown)[inside], light[inside], rtol=2e-4)


# --- geometry -------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", [forward_view(), forward_view(0.4, 0.2)], ids=["level", "turned"])
def test_normals_of_planes_come_out_exactly(view: View) -> None:
    scene = street(view)
    found = surfaces.normals_from_depth(view, scene.depth)
    surface = ~scene.sky
    error = np.degrees(np.arccos(np.clip((found * scene.normal).sum(-1)[surface], -1, 1)))
    assert np.median(error) < 0.05
    assert (error < 1).mean() > 0.95  # all but pixels at the corner of road and wall
    assert not found[scene.sky].any()


def test_near_kerbs_stay_steep_and_far_noise_of_the_ground_does_not() -> None:
    view, classes = forward_view(), np.full((HEIGHT, WIDTH), ID["sidewalk"], np.uint8)
    depths = (np.full((HEIGHT, WIDTH), metres, np.float32) for metres in (5.0, 30.0))
    near, far = (surfaces.normals_from_depth(view, depth, classes) for depth in depths)
    np.testing.assert_allclose(near[20, 30], [-1, 0, 0], atol=1e-5)
    np.testing.assert_allclose(far[20, 30], [0, 0, 1], atol=1e-5)


@pytest.mark.parametrize(("time", "share"), [("overcast", 1.0), ("dusk", 0.5)])
def test_new_light_is_exposed_as_a_camera_would(time: str, share: float) -> None:
    target = relight.target_light(SUNNY, LightSettings(time=time))
    assert relight.ground_level(target) == pytest.approx(share * relight.ground_level(SUNNY), rel=0.01)


def test_a_height_map_sees_a_wall_on_one_side() -> None:
    x, y = np.meshgrid(np.arange(0, 20, 0.25), np.arange(-10, 10, 0.25))
    z = np.where(x > 10, 12.0, 0.0)
    heights = OccluderMap.from_points(np.stack([x, y, z], -1).reshape(-1, 3), 0.5)
    far, near = np.array([[1.0, 0, 0]]), np.array([[8.5, 0, 0]])
    assert heights.openness(far)[0] == 1  # at 9 m a ray of 60 degrees is 15 m up
    assert heights.openness(near)[0] == pytest.approx(6 / 9)  # three of eight directions lead to the wall
    assert heights.free(near, np.array([1.0, 0, 0.5])).tolist() == [False]
    assert heights.free(near, np.array([-1.0, 0, 0.5])).tolist() == [True]
    assert heights.free(near, np.array([0, 0, -1.0])).tolist() == [False]


# --- noise ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_patches_cover_the_share_that_is_asked(share: float) -> None:
    x, y = np.random.default_rng(5).uniform(-400, 400, (2, 200_000))
    level = air.patch_threshold(share, 77)
    assert (air.patches(x, y, 1.0, 77) > level).mean() == pytest.approx(share, abs=0.02)


# --- fog ------------------------------------------------------------------------------------------


def test_fog_by_hand() -> None:
    share = air.transmittance(np.array([150.0]), np.array([0.0]), 1.5, FogSettings(visibility_m=150))
    assert share[0] == pytest.approx(0.05, rel=0.01)
    way = air.way_below(np.array([np.inf, 10.0, np.inf]), np.array([1.0, 1.0, 0.0]), 2.0, 50.0)
    assert way == pytest.approx([48, 10, np.inf])
    assert air.way_below(np.array([100.0]), np.array([-1.0]), 80.0, 50.0) == pytest.approx([70])
    color, haze = np.random.default_rng(2).uniform(0, 1, (50, 3)), np.array([0.7, 0.7, 0.8])
    a, b = np.full(50, 0.6), np.full(50, 0.5)
    once, twice = air.veiled(color, a, haze), air.veiled(color, a * b, haze)
    np.testing.assert_allclose(air.veiled(once, b, haze), twice, atol=1e-6)
    np.testing.assert_allclose(air.unveiled(once, a, haze), color, atol=1e-6)


# --- wet ground and snow --------------------------------------------------------------------------


def test_water_mirrors_by_fresnel() -> None:
    assert relight.fresnel(np.array([1.0, 0.0])) == pytest.approx([0.02, 1.0])
    exact = np.cos(np.radians(60)), np.sqrt(1 - (np.sin(np.radians(60)) / 1.33) ** 2)
    rs = ((exact[0] - 1.33 * exact[1]) / (exact[0] + 1.33 * exact[1])) ** 2
    rp = ((exact[1] - 1.33 * exact[0]) / (exact[1] + 1.33 * exact[0])) ** 2
    assert float(relight.fresnel(np.array(exact[0]))) == pytest.approx((rs + rp) / 2, abs=0.012)


def test_the_image_of_a_wall_is_found_in_the_road() -> None:
    """A ray from the road at distance x meets the wall at the height that similar triangles give."""
    view = forward_view()
    scene = street(view)
    mirror = relight.screen_mirror(scene, view, LIGHT)
    rays, _ = world_rays(view)
    points = world_points(view, scene.depth)
    road = (scene.classes == ID["road"]) & (np.abs(rays[..., 1]) < 0.2)
    with np.errstate(invalid="ignore"):
        height = (WALL_X - points[..., 0]) * -rays[..., 2] / rays[..., 0]
    stripe = road & (height > 3.2) & (height < 3.8)
    plain = road & (height > 0.4) & (height < 2.7)
    assert stripe.sum() > 5
    np.testing.assert_allclose(mirror[stripe], np.broadcast_to([0.9, 0.8, 0.2], (stripe.sum(), 3)), atol=0.02)
    np.testing.assert_allclose(mirror[plain], np.broadcast_to([0.3, 0.2, 0.1], (plain.sum(), 3)), atol=0.02)


def test_wet_road_is_darker_below_the_camera_and_changes_nothing_else() -> None:
    view = forward_view(pitch=0.6)
    scene = street(view)
    wet = relight.wet_ground(scene, view, LIGHT, 1.0, 0.0, 3)
    road = scene.classes == ID["road"]
    np.testing.assert_array_equal(wet[~road], scene.color[~road])
    steep = road & (world_points(view, scene.depth)[..., 0] < 2.5)
    assert steep.sum() > 20
    np.testing.assert_allclose(wet[steep], 0.08 * relight.WET_DARKENING, atol=0.03)


def test_snow_lies_on_level_open_ground_only() -> None:
    view = forward_view()
    scene = street(view)
    cover = relight.snow_cover(scene, view, 1.0, 4)
    assert (cover[scene.classes == ID["road"]] == 1).all()
    assert not cover[scene.classes == ID["building"]].any() and not cover[scene.sky].any()
    covered_over = replace(scene, openness=np.zeros_like(scene.openness))
    assert not relight.snow_cover(covered_over, view, 1.0, 4).any()


# --- light ----------------------------------------------------------------------------------------


def test_the_same_light_changes_nothing_but_the_sky() -> None:
    view, light = forward_view(), SUNNY
    scene = street(view)
    lit = np.ones_like(scene.openness)
    albedo = np.where(scene.classes[..., None] == ID["road"], 0.1, 0.4) * np.ones(3)
    color = (albedo * relight.irradiance(scene.normal, scene.openness, lit, light)).astype(np.float32)
    scene = replace(scene, color=color, sunlit=lit)
    found = relight.albedo_of(scene, light, lit)
    np.testing.assert_allclose(found[~scene.sky], albedo[~scene.sky], rtol=1e-5)
    for name, value in (("overcast", 0.0), ("sunny", 1.0)):
        target = replace(light, sun=value * light.sun)
        changed = relight.relit(scene, view, light, target)
        expected = albedo * relight.irradiance(scene.normal, scene.openness, lit, target)
        np.testing.assert_allclose(changed[~scene.sky], expected[~scene.sky], rtol=2e-2, err_msg=name)


def test_a_shadow_is_found_from_a_rough_guess() -> None:
    view, light = forward_view(pitch=0.3), SUNNY
    scene = street(view)
    x = world_points(view, scene.depth)[..., 1]
    road = scene.classes == ID["road"]
    truth = (~scene.sky & ~(road & (x > 0.0))).astype(np.float32)
    guess = (~scene.sky & ~(road & (x > 0.25))).astype(np.float32)
    albedo = np.where(road, 0.1, 0.4)[..., None] * np.ones(3)
    color = (albedo * relight.irradiance(scene.normal, scene.openness, truth, light)).astype(np.float32)
    found = relight.refined_sunlit(replace(scene, color=color), light, guess)
    assert ((found > 0.5) == (truth > 0.5))[road].mean() > 0.98
    assert ((guess > 0.5) == (truth > 0.5))[road].mean() < 0.97


def test_headlights_have_a_cut_off_and_shine_ahead() -> None:
    vehicle = geometry.yaw_matrix(0.0, (0, 0, 0.65))
    wall = np.array([[-1.0, 0, 0]] * 3)
    places = np.array([[20.0, 0, 0.1], [20, 0, 2.0], [-5, 0, 0.1]])
    low, high, behind = relight.headlight(places, wall, vehicle)[:, 0]
    assert low > 20 * high and behind == 0


# --- all together ---------------------------------------------------------------------------------


def test_defaults_change_nothing_and_fallen_snow_no_sky_without_end() -> None:
    view = forward_view()
    scene = street(view)
    shown = weather.apply(scene, Conditions(), view, 0.0, 1)
    np.testing.assert_array_equal(shown, scene.color)
    far = np.full_like(scene.depth, np.inf)  # below the horizon, too: nothing was seen there
    scene = surfaces.from_render(view, scene.color, far, np.full_like(scene.classes, ID["sky"]))
    shown = weather.apply(scene, conditions(snow=SnowSettings(cover=0.7)), view, 0.4, 7)
    np.testing.assert_allclose(shown, scene.color, atol=1e-6)


def conditions(**weather_settings: object) -> Conditions:
    return Conditions(weather=Weather(**weather_settings))


CASES = {
    "fog": conditions(fog=FogSettings(visibility_m=60)),
    "rain": conditions(rain=RainSettings(mm_h=20), wet=0.8, puddles=0.3),
    "snow": conditions(snow=SnowSettings(cover=0.7, mm_h=2)),
    "haze removed": conditions(recorded_visibility_m=500.0, fog=FogSettings(visibility_m=100)),
    "dusk": Conditions(light=LightSettings(time="dusk")),
    "overcast": Conditions(light=LightSettings(time="overcast")),
    "night": Conditions(light=LightSettings(time="night", exposure_ev=1.0), weather=Weather(wet=1.0)),
}


@pytest.mark.parametrize("name", CASES)
def test_every_effect_is_finite_repeatable_and_visible(name: str) -> None:
    view = forward_view()
    scene = surfaces.from_render(view, street(view).color, street(view).depth, street(view).classes)
    first = weather.apply(scene, CASES[name], view, 0.4, 7)
    again = weather.apply(scene, CASES[name], view, 0.4, 7)
    np.testing.assert_array_equal(first, again)
    assert np.isfinite(first).all() and first.min() >= 0
    assert np.abs(first - scene.color).mean() > 0.005


def test_settings_go_through_plain_values_and_refuse_what_is_out_of_range() -> None:
    for case in CASES.values():
        assert build(Conditions, case.model_dump(mode="json"), "edits") == case
    refused("visibility_m", build, Conditions, {"weather": {"fog": {"visibility_m": 0.1}}}, "e.yaml", raises=UsageError)
    refused("openness", replace, street(forward_view()), openness=np.zeros((3, 3), np.float32))


def test_a_drive_is_edited_image_by_image() -> None:
    shown = []
    for yaw in (-0.2, 0.2):
        view = forward_view(yaw)
        scene = street(view)
        shown.append(weather.ShownView(view, relight.srgb_encode(scene.color), scene.depth, scene.classes))
    drive = weather.drive_facts(shown)
    assert drive.ground_z_m == pytest.approx(0, abs=1e-3)
    assert drive.heights.top_m.max() == pytest.approx(6, abs=0.3)
    same = weather.edited_view(shown[0], Conditions(), 1, drive)
    np.testing.assert_allclose(same, shown[0].rgb, atol=1e-5)
    foggy = weather.edited_view(shown[0], CASES["fog"], 1, drive)
    wall = shown[0].classes == ID["building"]
    haze = relight.srgb_encode(drive.airlight[None])[0]
    assert np.abs(foggy - haze)[wall].mean() < 0.5 * np.abs(shown[0].rgb - haze)[wall].mean()
    refused("estimated from views", weather.drive_facts, [])


# --- drops, flakes and LiDAR returns --------------------------------------------------------------


def area_per_m(sizes: list[air.ParticleSize]) -> float:
    """Area of the particles in a cubic metre: what a ray meets per metre."""
    return sum(s.density * math.pi / 4 * s.diameter_m**2 for s in sizes)


@pytest.mark.parametrize("mm_h", [2.0, 10.0, 50.0])
def test_numbers_and_areas_of_drops_agree_with_integration(mm_h: float) -> None:
    d = np.linspace(1, 5, 400_001)
    n = 8000 * np.exp(-4.1 * mm_h**-0.21 * d)
    sizes = air.rain_sizes(mm_h)
    assert area_per_m(sizes) == pytest.approx(np.trapezoid(n * math.pi / 4 * d**2, d) * 1e-6, rel=1e-6)
    assert sum(s.density for s in sizes) == pytest.approx(np.trapezoid(n, d), rel=1e-6)


SIZE = air.ParticleSize(60.0, 0.002, 5.0)
FALL = np.array([0.0, 0.0, -5.0])


def rows(xyz: np.ndarray) -> set[tuple[float, ...]]:
    return {tuple(np.round(p, 6)) for p in xyz}


def test_two_cameras_see_the_same_drops() -> None:
    left, right = forward_view(yaw=0.15), forward_view(yaw=-0.15)
    a, b = (air.places(SIZE, FALL, view, 6.0, 99) for view in (left, right))

    def both(xyz: np.ndarray) -> np.ndarray:
        seen = [geometry.project(view, xyz) for view in (left, right)]
        inside = [(uv[:, 0] > 0) & (uv[:, 0] < 60) & (uv[:, 1] > 0) & (uv[:, 1] < 40) & (z > 0.2) for uv, z in seen]
        return xyz[inside[0] & inside[1] & (np.linalg.norm(xyz - left.center_world, axis=1) < 6)]

    assert len(both(a)) > 200 and rows(both(a)) == rows(both(b))
    assert rows(air.places(SIZE, FALL, left, 6.0, 100)) != rows(a)


def test_drops_fall_with_their_speed_and_are_as_many_as_the_volume_holds() -> None:
    a, b = (air.places(SIZE, FALL, forward_view(time_s=time_s), 5.0, 1) for time_s in (3.0, 3.02))
    shared = rows(a + FALL * 0.02) & rows(b)
    assert len(shared) > 0.8 * len(a)
    view = forward_view()
    counts = []
    for key in range(12):
        xyz = air.places(SIZE, FALL, view, 6.0, key)
        uv, z = geometry.project(view, xyz)
        inside = (uv[:, 0] > 0) & (uv[:, 0] < 60) & (uv[:, 1] > 0) & (uv[:, 1] < 40)
        counts.append(np.sum(inside & (z > 0) & (z < 5)))
    volume = 5**3 / 3 * (60 / 50) * (40 / 50)
    assert np.mean(counts) == pytest.approx(60 * volume, rel=0.02)
    assert np.std(counts) == pytest.approx(math.sqrt(60 * volume), rel=0.6)


@pytest.mark.parametrize("velocity", [(0, 0, 0), (0, 0, -6.0), (15.0, 0, -6)], ids=["still", "falling", "driving"])
def test_a_drop_covers_the_area_of_its_disc_whatever_its_streak(velocity: tuple[float, float, float]) -> None:
    view = forward_view(size=(300, 200))
    moving = np.array([[4.0, 0.4, 1.6]]), 2 * np.array(velocity, float), 0.02
    depth = np.full((200, 300), 50.0, np.float32)
    shown = air.covered(view, depth, *moving)
    stretch = math.sqrt(1 + 0.1**2 + 0.025**2)  # off the axis
    assert shown.sum() == pytest.approx(stretch * math.pi / 4 * (50 * 0.02 / 4.0) ** 2, rel=1e-6)
    assert air.covered(view, np.full_like(depth, 3.0), *moving).sum() == 0  # behind a surface


def test_rows_of_a_streak_follow_the_motion() -> None:
    view = forward_view(size=(300, 200))
    moving = np.array([[2.0, 0.0, 1.5]]), np.array([0, 0, -40.0]), 0.002
    shown = air.covered(view, np.full((200, 300), 50.0), *moving)
    lit = np.flatnonzero(shown.sum(1))
    assert lit[-1] - lit[0] == pytest.approx(50 * 40 * air.SHUTTER_S / 2.0, abs=2)
    assert np.flatnonzero(shown.sum(0)).tolist() == [149, 150]


def test_all_drops_together_cover_what_the_density_says() -> None:
    """Mean optical depth = area of the drops per metre x metres, within 5 %."""
    sizes = air.rain_sizes(50.0)
    what, depth = RainSettings(reach_m=6.0), np.full((40, 60), 100.0)
    drawn = [air.falling(forward_view(time_s=t), depth, sizes, what, (0, 0, 0), 5, "rain") for t in range(4)]
    shown = [one.mean() for one in drawn]
    assert np.mean(shown) == pytest.approx(area_per_m(sizes) * (6.0 - air.NEAREST_M), rel=0.05)


COUNT = 40_000


def beams() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(11)
    return rng.uniform(5, 120, COUNT), rng.uniform(0.02, 1, COUNT)


def detected_in(share: np.ndarray, at: np.ndarray, floor: np.ndarray | float = 0.0) -> float:
    """Share of reflectances uniform in 0.02..1 whose hard return exceeds the threshold or the fog's return."""
    limit = np.maximum(air.THRESHOLD, floor)
    least = limit * math.pi * at**2 / share
    return float(np.clip((1 - np.maximum(least, 0.02)) / 0.98, 0, 1).mean())


@pytest.mark.parametrize("visibility_m", [50.0, 150.0, 600.0, 3000.0])
def test_shares_of_lost_hard_and_soft_returns_in_fog(visibility_m: float) -> None:
    """Against an integration: the fog's return by a direct sum, the shares by the reflectances."""
    ranges, reflectances = beams()
    found = air.in_fog(ranges, reflectances, visibility_m, 3)
    at = np.linspace(5, 120, 2001)
    alpha = math.log(20) / visibility_m
    r = np.arange(air.CROSS_FROM_M, 40, 0.01)
    crossover = np.clip((r - air.CROSS_FROM_M) / (air.CROSS_TO_M - air.CROSS_FROM_M), 0, 1)
    centers = np.arange(0.5, 30, 0.05)
    pulse = [np.where(np.abs(c - r) < 3, np.cos(math.pi * (c - r) / 6) ** 2, 0) for c in centers]
    power = [0.046 / visibility_m * np.trapezoid(np.exp(-2 * alpha * r) / r**2 * crossover * p, r) for p in pulse]
    soft = np.interp(at, centers, np.maximum.accumulate(power))
    hard_share = detected_in(np.exp(-2 * alpha * at), at, soft)
    assert (found.kind == 1).mean() == pytest.approx(hard_share, abs=0.02)
    above = soft > air.THRESHOLD
    least = np.clip(soft * math.pi * at**2 / np.exp(-2 * alpha * at), 0.02, 1)
    soft_share = float((above * (least - 0.02) / 0.98).mean())
    soft_ones = found.kind == air.SOFT
    assert soft_ones.mean() == pytest.approx(soft_share, abs=0.02)
    assert (found.kind == air.LOST).mean() == pytest.approx(1 - hard_share - soft_share, abs=0.02)
    assert (found.range_m[soft_ones] < ranges[soft_ones] + 1e-9).all()
    hard = found.kind == 1
    np.testing.assert_array_equal(found.range_m[hard], ranges[hard])
    np.testing.assert_allclose(found.intensity[hard], (reflectances * np.exp(-2 * alpha * ranges))[hard])


@pytest.mark.parametrize("mm_h", [0.0, 10.0, 50.0])
def test_shares_and_noise_of_returns_in_rain(mm_h: float) -> None:
    ranges, reflectances = beams()
    found = air.in_rain(ranges, reflectances, mm_h, 3)
    at = np.linspace(5, 120, 4001)
    kept = found.kind != air.LOST
    share = np.exp(-0.02 * mm_h**0.6 * at) if mm_h else np.ones_like(at)
    assert kept.mean() == pytest.approx(detected_in(share, at), abs=0.02)
    error = ((found.range_m - ranges) / ranges)[kept]
    assert error.std() == pytest.approx(0.02 * (1 - math.exp(-mm_h)) ** 2, rel=0.02)


def test_a_sweep_in_fog_and_rain_keeps_its_beams() -> None:
    rng = np.random.default_rng(4)
    ranges, reflectances = beams()
    directions = rng.normal(size=(COUNT, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    xyz, light = (directions * ranges[:, None]).astype(np.float32), reflectances.astype(np.float32)
    points = SweepPoints(xyz, light, np.zeros(COUNT, np.float32), np.full(COUNT, 2, np.uint8))
    clear, kinds = air.sweep_in_weather(points, Weather(), 1)
    np.testing.assert_allclose(clear.xyz, points.xyz, rtol=1e-5, atol=1e-5)
    assert (kinds == 1).all()
    bad = Weather(fog=FogSettings(visibility_m=3000), rain=RainSettings(mm_h=10))
    found, kinds = air.sweep_in_weather(points, bad, 1)
    assert 0 < len(found.xyz) < COUNT and set(found.classes[kinds == 2].tolist()) == {255}
    assert set(found.classes[kinds == 1].tolist()) == {2}
    again = air.sweep_in_weather(points, bad, 1)[0]
    np.testing.assert_array_equal(found.xyz, again.xyz)
    fog_alone, _ = air.sweep_in_weather(points, Weather(fog=FogSettings(visibility_m=3000)), 1)
    assert len(found.xyz) < len(fog_alone.xyz)
    got = found.xyz / np.linalg.norm(found.xyz, axis=1, keepdims=True)
    assert {tuple(d) for d in np.round(got[:200], 4)} <= {tuple(d) for d in np.round(directions.astype(np.float32), 4)}
