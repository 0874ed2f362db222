"""Rain, snow and LiDAR returns: closed forms of how much is covered, lost and added."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mudg.base import geometry
from mudg.base.types import Camera, SweepPoints, View
from mudg.base.weather_settings import FogSettings, RainSettings, WeatherSettings
from mudg.core.weather import air, lidar


def view_at(x: float = 0.0, yaw: float = 0.0, time_s: float = 0.0, size: tuple[int, int] = (60, 40)) -> View:
    pose = np.eye(4)
    pose[:3, :3] = geometry.yaw_matrix(yaw)[:3, :3] @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:3, 3] = (x, 0, 1.5)
    width, height = size
    return View(Camera("front", width, height, 50.0, 50.0, width / 2, height / 2), pose, time_s)


@pytest.mark.parametrize("mm_h", [2.0, 10.0, 50.0])
def test_numbers_and_areas_of_drops_agree_with_integration(mm_h: float) -> None:
    d = np.linspace(1, 5, 400_001)
    n = 8000 * np.exp(-4.1 * mm_h**-0.21 * d)
    sizes = air.rain_sizes(mm_h)
    assert sum(s.density for s in sizes) == pytest.approx(np.trapezoid(n, d), rel=1e-6)
    assert air.area_per_m(sizes) == pytest.approx(np.trapezoid(n * math.pi / 4 * d**2, d) * 1e-6, rel=1e-6)


@pytest.mark.parametrize("mm_h", [5.0, 10.0, 50.0])
def test_the_published_extinction_of_rain_is_twice_the_area_of_the_drops(mm_h: float) -> None:
    slope = 4.1 * mm_h**-0.21
    both = 2 * math.pi / 4 * 8000 * 2 / slope**3 * 1e-6
    assert air.rain_extinction(mm_h) == pytest.approx(both, rel=0.2)


def test_drops_carry_the_water_of_the_rate() -> None:
    """Flux of water over all drops, by integration; known to be a bit high."""
    d = np.linspace(0.25, 8, 100_000)
    speed = 9.65 - 10.3 * np.exp(-0.6 * d)
    flux = np.trapezoid(8000 * np.exp(-4.1 * 10**-0.21 * d) * math.pi / 6 * d**3 * 1e-9 * speed, d)  # m/s
    assert flux * 3.6e6 == pytest.approx(10, rel=0.2)


SIZE = air.ParticleSize(60.0, 0.002, 5.0)
FALL = np.array([0.0, 0.0, -5.0])


def rows(xyz: np.ndarray) -> set[tuple[float, ...]]:
    return {tuple(np.round(p, 6)) for p in xyz}


def test_two_cameras_see_the_same_drops() -> None:
    left, right = view_at(yaw=0.15), view_at(yaw=-0.15)
    a, b = (air.places(SIZE, FALL, view, 6.0, 99) for view in (left, right))

    def both(xyz: np.ndarray) -> np.ndarray:
        seen = [geometry.project(view, xyz) for view in (left, right)]
        inside = [(uv[:, 0] > 0) & (uv[:, 0] < 60) & (uv[:, 1] > 0) & (uv[:, 1] < 40) & (z > 0.2) for uv, z in seen]
        return xyz[inside[0] & inside[1] & (np.linalg.norm(xyz - left.center_world, axis=1) < 6)]

    assert len(both(a)) > 200
    assert rows(both(a)) == rows(both(b))
    assert rows(air.places(SIZE, FALL, left, 6.0, 100)) != rows(a)


def test_drops_fall_with_their_speed() -> None:
    now, later = view_at(time_s=3.0), view_at(time_s=3.02)
    a = air.places(SIZE, FALL, now, 5.0, 1)
    b = air.places(SIZE, FALL, later, 5.0, 1)
    shared = rows(a + FALL * 0.02) & rows(b)
    assert len(shared) > 0.8 * len(a)


def test_the_number_of_drops_is_that_of_the_volume() -> None:
    view = view_at()
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
    view = view_at(size=(300, 200))
    moving = air.Moving(np.array([[4.0, 0.4, 1.6]]), np.array(velocity, float), 0.02, 0.02)
    depth = np.full((200, 300), 50.0, np.float32)
    shown = air.covered(view, depth, moving)
    stretch = math.sqrt(1 + 0.1**2 + 0.025**2)  # off the axis
    assert shown.sum() == pytest.approx(stretch * math.pi / 4 * (50 * 0.02 / 4.0) ** 2, rel=1e-6)
    assert air.covered(view, np.full_like(depth, 3.0), moving).sum() == 0  # behind a surface


def test_rows_of_a_streak_follow_the_motion() -> None:
    view = view_at(size=(300, 200))
    moving = air.Moving(np.array([[2.0, 0.0, 1.5]]), np.array([0, 0, -8.0]), 0.002, 0.05)
    shown = air.covered(view, np.full((200, 300), 50.0), moving)
    lit = np.flatnonzero(shown.sum(1))
    assert lit[-1] - lit[0] == pytest.approx(50 * 8 * 0.05 / 2.0, abs=2)
    assert np.flatnonzero(shown.sum(0)).tolist() == [149, 150]


def test_all_drops_together_cover_what_the_density_says() -> None:
    """Mean optical depth = area of the drops per metre x metres, within 5 %."""
    sizes = air.rain_sizes(50.0)
    what = air.Falling(sizes, (0.0, 0.0), 6.0, 0.01, "rain")
    depth = np.full((40, 60), 100.0)
    shown = [air.falling(view_at(time_s=t), depth, what, (0, 0, 0), 5).mean() for t in (0.0, 1.0, 2.0, 3.0)]
    assert np.mean(shown) == pytest.approx(air.area_per_m(sizes) * (6.0 - air.NEAREST_M), rel=0.05)


SENSOR = lidar.LidarSensor(range_10_m=90.0)
COUNT = 40_000


def beams() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(11)
    return rng.uniform(5, 120, COUNT), rng.uniform(0.02, 1, COUNT)


def detected_in(share: np.ndarray, at: np.ndarray, floor: np.ndarray | float = 0.0) -> float:
    """Share of reflectances uniform in 0.02..1 whose hard return exceeds the threshold or the fog's return."""
    limit = np.maximum(SENSOR.threshold, floor)
    least = limit * math.pi * at**2 / share
    return float(np.clip((1 - np.maximum(least, 0.02)) / 0.98, 0, 1).mean())


LATE = lidar.LidarSensor(range_10_m=90.0, cross_from_m=10.0, cross_to_m=20.0)


@pytest.mark.parametrize("sensor", [SENSOR, LATE], ids=["near", "far"])
@pytest.mark.parametrize("visibility_m", [50.0, 150.0, 600.0, 3000.0])
def test_shares_of_lost_hard_and_soft_returns_in_fog(visibility_m: float, sensor: lidar.LidarSensor) -> None:
    """Against an integration: the fog's return by a direct sum, the shares by the reflectances."""
    ranges, reflectances = beams()
    found = lidar.in_fog(ranges, reflectances, visibility_m, 3, sensor)
    at = np.linspace(5, 120, 2001)
    alpha = math.log(20) / visibility_m
    r = np.arange(sensor.cross_from_m, 40, 0.01)
    crossover = np.clip((r - sensor.cross_from_m) / (sensor.cross_to_m - sensor.cross_from_m), 0, 1)
    centers = np.arange(0.5, 30, 0.05)
    pulse = [np.where(np.abs(c - r) < 3, np.cos(math.pi * (c - r) / 6) ** 2, 0) for c in centers]
    power = [0.046 / visibility_m * np.trapezoid(np.exp(-2 * alpha * r) / r**2 * crossover * p, r) for p in pulse]
    soft = np.interp(at, centers, np.maximum.accumulate(power))
    hard_share = detected_in(np.exp(-2 * alpha * at), at, soft)
    assert (found.kind == 1).mean() == pytest.approx(hard_share, abs=0.02)
    above = soft > sensor.threshold
    least = np.clip(soft * math.pi * at**2 / np.exp(-2 * alpha * at), 0.02, 1)
    soft_share = float((above * (least - 0.02) / 0.98).mean())
    assert found.soft.mean() == pytest.approx(soft_share, abs=0.02)
    assert (~found.kept).mean() == pytest.approx(1 - hard_share - soft_share, abs=0.02)
    assert (found.range_m[found.soft] < ranges[found.soft] + 1e-9).all()
    hard = found.kind == 1
    np.testing.assert_array_equal(found.range_m[hard], ranges[hard])
    np.testing.assert_allclose(found.intensity[hard], (reflectances * np.exp(-2 * alpha * ranges))[hard])


def test_the_fog_cases_cover_all_three_kinds() -> None:
    ranges, reflectances = beams()
    kinds = {int(k) for s in (SENSOR, LATE) for k in lidar.in_fog(ranges, reflectances, 150.0, 3, s).kind}
    assert kinds == {0, 1, 2}


@pytest.mark.parametrize("mm_h", [0.0, 10.0, 50.0])
def test_shares_and_noise_of_returns_in_rain(mm_h: float) -> None:
    ranges, reflectances = beams()
    found = lidar.in_rain(ranges, reflectances, mm_h, 3, SENSOR)
    at = np.linspace(5, 120, 4001)
    assert found.kept.mean() == pytest.approx(
        detected_in(np.exp(-0.02 * mm_h**0.6 * at) if mm_h else np.ones_like(at), at), abs=0.02
    )
    error = ((found.range_m - ranges) / ranges)[found.kept]
    assert error.std() == pytest.approx(0.02 * (1 - math.exp(-mm_h)) ** 2, rel=0.02)


def test_thicker_fog_never_returns_more_of_the_surfaces() -> None:
    ranges, reflectances = beams()
    hard = [(lidar.in_fog(ranges, reflectances, v, 1, SENSOR).kind == 1).mean() for v in (30, 100, 300, 3000, 1e5)]
    assert hard == sorted(hard)
    clear = lidar.in_fog(ranges, reflectances, 1e9, 1, SENSOR)
    assert (clear.kind == 1).mean() == pytest.approx(detected_in(np.ones(4001), np.linspace(5, 120, 4001)), abs=0.02)
    assert replace(SENSOR, range_10_m=45).threshold == pytest.approx(4 * SENSOR.threshold)


def test_a_sweep_in_fog_and_rain_keeps_its_beams() -> None:
    rng = np.random.default_rng(4)
    ranges, reflectances = beams()
    directions = rng.normal(size=(COUNT, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = SweepPoints(
        (directions * ranges[:, None]).astype(np.float32),
        reflectances.astype(np.float32),
        np.zeros(COUNT, np.float32),
        np.full(COUNT, 2, np.uint8),
    )
    clear, kinds = lidar.sweep_in_weather(points, WeatherSettings(), 1, LATE)
    np.testing.assert_allclose(clear.xyz, points.xyz, rtol=1e-5, atol=1e-5)
    assert (kinds == 1).all()
    bad = WeatherSettings(fog=FogSettings(visibility_m=150), rain=RainSettings(mm_h=10))
    found, _ = lidar.sweep_in_weather(points, bad, 1, LATE)
    assert 0 < len(found.xyz) < COUNT
    near, kinds = lidar.sweep_in_weather(points, bad, 1, SENSOR)
    assert set(near.classes[kinds == 2].tolist()) == {255}
    assert set(near.classes[kinds == 1].tolist()) == {2}
    again = lidar.sweep_in_weather(points, bad, 1, LATE)[0]
    np.testing.assert_array_equal(found.xyz, again.xyz)
    fog_alone, _ = lidar.sweep_in_weather(points, WeatherSettings(fog=FogSettings(visibility_m=150)), 1, LATE)
    assert len(found.xyz) < len(fog_alone.xyz)
    got = found.xyz / np.linalg.norm(found.xyz, axis=1, keepdims=True)
    assert {tuple(d) for d in np.round(got[:200], 4)} <= {tuple(d) for d in np.round(directions.astype(np.float32), 4)}
