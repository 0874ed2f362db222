"""What real sensors add to a generated log: every effect has the stated size, and the default changes nothing."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace

import numpy as np
import pytest

from mudg import native
from mudg.base.types import SweepPoints, Track
from mudg.city.config import CityConfig
from mudg.city.furnish import furnish
from mudg.city.layout import plan_streets
from mudg.city.light import light_numbers
from mudg.city.sensors import (
    BoxFaults,
    CameraFaults,
    CameraLook,
    LidarFaults,
    LidarScan,
    PoseFaults,
    SensorFaults,
    cameras,
    ego_from_lidar,
    lidar_elevations,
    noisy_tracks,
    recorded,
    thinned,
    with_look,
)
from mudg.city.traffic import ego_keys, plan_traffic
from mudg.city.world import CityWorld
from mudg.core.weather.light import srgb_decode, srgb_encode
from mudg.diffusion import city_clips
from mudg.diffusion.city_clips import record_with_faults

needs_native = pytest.mark.skipif(native.library() is None, reason="the native library is not built")


def picture(height: int = 40, width: int = 60) -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.uniform(0.1, 0.6, (height, width, 3)).astype(np.float32)


def points(count: int = 4000) -> SweepPoints:
    rng = np.random.default_rng(1)
    xyz = rng.normal(0, 10, (count, 3)).astype(np.float32)
    return SweepPoints(xyz, np.full(count, 0.5, np.float32), np.zeros(count, np.float32))


def test_the_default_look_and_faults_change_nothing() -> None:
    image = picture()
    assert np.allclose(with_look(image, CameraLook(), 1.0), image, atol=2e-6)
    assert np.array_equal(recorded(image, CameraFaults(), 5), (image * 255 + 0.5).astype(np.uint8))
    assert thinned(points(), LidarFaults(), 1).xyz.shape == (4000, 3)
    assert np.array_equal(PoseFaults().errors(3, 1), np.tile(np.eye(4), (3, 1, 1)))


def test_a_look_is_what_it_states() -> None:
    image = picture()
    shown = with_look(image, CameraLook(gain=1.5, white=(1.1, 1.0, 0.8)), 0.7)
    assert np.allclose(srgb_decode(shown) / srgb_decode(image), 1.5 * np.array([1.1, 1.0, 0.8]), rtol=1e-3)
    look = CameraLook(drift_stops=0.5, drift_period_s=4.0)
    gains = [look.gains(t)[1] for t in (0.0, 1.0, 2.0, 3.0)]
    assert np.allclose(gains, [1, math.sqrt(2), 1, math.sqrt(0.5)])
    balance = CameraLook(drift_white=0.05).gains(0.0)
    assert balance[0] / balance[2] == pytest.approx(1.05 / 0.95)
    flat = np.full((200, 300, 3), 0.5, np.float32)
    light = srgb_decode(with_look(flat, CameraLook(vignette=0.4), 0.0)) / srgb_decode(flat)
    assert light[100, 150, 0] == pytest.approx(1.0, abs=1e-3) and light[0, 0, 0] == pytest.approx(0.6, abs=0.01)
    image = np.full((2, 2, 3), 0.6, np.float32)
    assert np.allclose(with_look(image, CameraLook(contrast=1.5), 0.0), 0.65, atol=1e-5)
    values = np.linspace(0, 1, 11, dtype=np.float32)
    assert np.allclose(srgb_encode(srgb_decode(values)), values, atol=1e-6)
    assert srgb_decode(np.float32([0.5]))[0] == pytest.approx(0.2140, abs=1e-4)


def test_varied_clips_stay_in_the_free_space() -> None:
    rules = city_clips.CityClipRules(realism="varied")
    margins = [city_clips.city_config(rules, city).shift_margin_m for city in range(40)]
    assert 0.3 < np.mean(np.array(margins) < 4) < 0.65
    for city, margin in enumerate(margins):
        assert max(abs(s) for s in city_clips.shifts_of(rules, city)) <= margin


def test_noise_has_the_stated_size_and_follows_the_key() -> None:
    flat = np.full((200, 300, 3), 0.25, np.float32)
    first, again, other = (recorded(flat, CameraFaults(noise=0.02, grain_px=0.7), key) for key in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    assert first.std() / 255 == pytest.approx(0.02, rel=0.1)  # 0.6 + 0.8 * sqrt(0.25) = 1


def test_blur_and_bloom_and_compression_do_what_they_say() -> None:
    edge = np.zeros((40, 60, 3), np.float32)
    edge[:, 30:] = 0.6
    width = lambda image: int(((image[20, :, 0] > 15) & (image[20, :, 0] < 140)).sum())
    assert width(recorded(edge, CameraFaults(), 0)) == 0
    assert width(recorded(edge, CameraFaults(defocus_px=1.5), 0)) >= 3
    assert width(recorded(edge, CameraFaults(motion_px=5), 0)) >= 3
    assert width(recorded(edge, CameraFaults(motion_px=5, motion_rad=math.pi / 2), 0)) == 0
    spot = np.full((60, 60, 3), 0.2, np.float32)
    spot[25:35, 25:35] = 1.0
    assert recorded(spot, CameraFaults(bloom=0.3), 0)[40, 30, 0] > recorded(spot, CameraFaults(), 0)[40, 30, 0] + 5
    assert recorded(spot, CameraFaults(veil=0.3), 0)[5, 5, 0] > recorded(spot, CameraFaults(), 0)[5, 5, 0]
    image = np.repeat(picture()[..., :1], 3, -1)
    coarse, fine = (recorded(image, CameraFaults(jpeg_quality=q), 0).astype(float) for q in (40, 95))
    plain = recorded(image, CameraFaults(), 0)
    assert np.abs(coarse - plain).mean() > 2 * np.abs(fine - plain).mean() > 0


def test_points_are_lost_where_and_as_often_as_stated() -> None:
    cloud = points(20000)
    azimuth = np.degrees(np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0]))
    kept = lambda key, **faults: thinned(cloud, LidarFaults(**faults), key).xyz
    assert np.array_equal(kept(1, cut_deg=60), cloud.xyz[np.abs(azimuth) <= 60])
    hole = kept(1, hole_share=0.25)
    assert len(hole) / 20000 == pytest.approx(0.75, abs=0.02)
    assert not np.array_equal(hole, kept(2, hole_share=0.25))
    assert len(kept(1, dropout=0.4)) / 20000 == pytest.approx(0.6, abs=0.02)


def test_pose_errors_have_the_stated_size_and_drift_grows() -> None:
    jitter = PoseFaults(jitter_m=0.03, jitter_deg=0.1).errors(2000, 4)
    assert jitter[:, :3, 3].std() == pytest.approx(0.03, rel=0.06)
    yaw = np.degrees(np.arctan2(jitter[:, 1, 0], jitter[:, 0, 0]))
    assert yaw.std() == pytest.approx(0.1, rel=0.06)
    drift = PoseFaults(drift_m=0.05).errors(11, 4)[:, :3, 3]
    assert np.allclose(drift[0], 0) and np.allclose(drift[5], drift[10] / 2) and np.abs(drift[10]).max() > 0.01


def test_boxes_err_as_stated_each_by_itself() -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    tracks = tuple(Track(f"car-{n:03d}", "car", np.array([4.0, 2.0, 1.5]), np.arange(5.0), poses) for n in range(300))
    faults = BoxFaults(0.2, 3.0, 0.1)
    noisy = noisy_tracks(tracks, faults, 9)
    along = np.array([t.world_from_object[:, 0, 3].mean() for t in noisy])
    size = np.log(np.array([t.size_m for t in noisy]) / [4.0, 2.0, 1.5])
    yaw = np.degrees([np.arctan2(t.world_from_object[0, 1, 0], t.world_from_object[0, 0, 0]) for t in noisy])
    assert along.std() == pytest.approx(0.2, rel=0.2)
    assert size.std() == pytest.approx(0.1, rel=0.1)
    assert yaw.std() == pytest.approx(3.0, rel=0.3)
    alone = noisy_tracks(tracks[7:8], faults, 9)[0]  # whatever the other boxes are
    assert np.array_equal(alone.world_from_object, noisy[7].world_from_object)
    exact = noisy_tracks(tracks[:2], BoxFaults(), 9)
    assert np.array_equal(exact[0].world_from_object, poses)


# --- in a city ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small() -> CityConfig:
    lidar = {"lidar_beams": 16, "lidar_azimuth_step_deg": 1.0}
    return CityConfig(seed=11, n_frames=4, width=64, height=48, cameras=("front",), supersample=1, **lidar)


@needs_native
def test_a_rolling_shutter_without_readout_is_the_plain_image_and_with_it_is_not(small: CityConfig) -> None:
    world = CityWorld(small)
    view = world.frame_views("front")[1]
    plain, still, rolling = world.render(view), world.render_rolling(view, 0.0), world.render_rolling(view, 0.03)
    assert np.array_equal(plain.depth, still.depth) and np.array_equal(plain.semantics, still.semantics)
    assert rolling.depth.shape == plain.depth.shape and not np.array_equal(rolling.depth, plain.depth)


@needs_native
def test_a_wrong_clock_moves_the_points_by_the_way_driven(small: CityConfig) -> None:
    world = CityWorld(small)
    scan = LidarScan(ego_from_lidar(), lidar_elevations(small))
    right, late = world.lidar_sweep(1), world.lidar_sweep(1, replace(scan, delay_s=0.02))
    assert np.array_equal(right.points.xyz, world.lidar_sweep(1, scan).points.xyz)
    assert late.time_s == right.time_s and np.array_equal(late.world_from_lidar, right.world_from_lidar)
    driven = np.linalg.norm(world.frame_pose(0.12)[:3, 3] - world.frame_pose(0.1)[:3, 3])

    def wall(sweep: object) -> float:  # distance of the nearest return ahead at the height of the sensor
        xyz, ids = sweep.points.xyz, sweep.semantics
        return float(np.median(np.linalg.norm(xyz[(ids == 2) & (xyz[:, 0] > 5) & (np.abs(xyz[:, 1]) < 25)], axis=1)))

    assert 0.05 < driven < 0.4
    assert abs(wall(late) - wall(right)) < 3 * driven


@needs_native
def test_the_image_of_a_view_fits_it_and_the_truth_is_exact(small: CityConfig) -> None:
    """With faulty poses the image of a moment keeps its place relative to the views of that moment; the truth has its
    look only."""
    looks = {"front": CameraLook(gain=1.4)}
    poses, boxes = PoseFaults(0.05, 0.2, 0.05, 0.2), BoxFaults(0.1, 2, 0.1)
    log = record_with_faults(small, SensorFaults(looks, {}, LidarFaults((0.3, 0, 0)), poses, boxes), range(4), 77)
    view = log.world.frame_views("front")[2]
    claimed = city_clips.claimed_view(log.world, log.errors, view)
    assert 0.001 < np.linalg.norm(claimed.center_world - view.center_world) < 0.5
    assert np.allclose(log.recorded[2].view.world_from_cam, claimed.world_from_cam)
    assert np.array_equal(log.truth(view).rgb_u8, log.recorded[2].rgb)  # no noise or blur was asked for
    assert np.array_equal(log.truth(view).depth, log.world.render(view).depth)
    sideways = city_clips.shifted_view(log.world, view, 1.0)
    step = city_clips.claimed_view(log.world, log.errors, sideways).center_world - claimed.center_world
    assert np.linalg.norm(step) == pytest.approx(1.0, abs=1e-9)


# --- the distribution -----------------------------------------------------------------------------


def test_the_distribution_covers_what_it_says() -> None:
    rules = city_clips.CityClipRules(realism="varied")
    configs = [city_clips.city_config(rules, city) for city in range(200)]
    sensors = [city_clips.sensors_of(rules, city) for city in range(200)]
    lens = [2 * math.degrees(math.atan(c.width / 2 / cameras(c)["front"].fx)) for c in configs]
    assert 30 <= min(lens) < 42 and 105 < max(lens) <= 120.01
    aspects = {round(c.width / c.height, 1) for c in configs}
    assert len(aspects) == 5 and min(aspects) <= 1.4 and max(aspects) > 3.2
    assert {c.lidar_beams for c in configs} == {16, 32, 40, 64, 128}
    assert 0.4 < np.mean([c.lidar_upper_deg < 5 for c in configs]) < 0.8
    turns = np.array([np.linalg.norm(s.lidar.turn_deg) for s in sensors])
    assert turns.max() <= 0.5 and 0.2 < np.mean(turns == 0) < 0.5
    assert max(float(np.linalg.norm(s.lidar.shift_m)) for s in sensors) <= 0.03
    assert 0.1 < np.mean([s.second_lidar is not None for s in sensors]) < 0.3
    assert 0.1 < np.mean([s.lidar.cut_deg < 180 for s in sensors]) < 0.3


def test_sizes_have_one_area_and_go_round() -> None:
    rules = city_clips.CityClipRules(realism="varied")
    sizes = [city_clips.size_of(rules, city) for city in range(10)]
    assert sizes[:5] == sizes[5:] and sizes[0] == (192, 128)
    for width, height in sizes:
        assert width % 16 == height % 16 == 0 and 0.85 < width * height / (192 * 128) < 1.1
    assert city_clips.sized(192, 128, 4) == (272, 80)
    assert city_clips.size_of(replace(rules, published=True), 4) == (192, 128)
    assert city_clips.size_of(rules, city_clips.HELD_OUT + 4) == (192, 128)


def test_mixed_cities_are_varied_and_plain_by_turns_and_have_all_sizes_of_both() -> None:
    mixed, rules = city_clips.CityClipRules(realism="mixed"), city_clips.CityClipRules(realism="varied")
    kinds = [city_clips.is_varied(mixed, city) for city in range(20)]
    assert kinds == [True] * 5 + [False] * 5 + [True] * 5 + [False] * 5
    assert not city_clips.is_varied(mixed, city_clips.HELD_OUT)
    for city in range(10):
        assert city_clips.size_of(mixed, city) == city_clips.size_of(rules, city)
        config, fine = city_clips.city_config(mixed, city), city_clips.fine_of(mixed, city)
        assert (config.width, config.height) == tuple(fine * side for side in city_clips.size_of(mixed, city))
    assert city_clips.city_config(mixed, 3) == city_clips.city_config(rules, 3)
    assert city_clips.city_config(mixed, 8).skies == "plain" and city_clips.sensors_of(mixed, 8) == SensorFaults()


def test_clips_of_longer_logs_begin_anywhere_but_at_the_ends() -> None:
    rules = city_clips.CityClipRules(log_frames=24)
    starts = {city_clips.start_of(rules, city, number) for city in range(20) for number in range(6)}
    assert starts == set(range(2, 24 - 2 - 8 + 1))
    for short in (city_clips.CityClipRules(), city_clips.CityClipRules(window=16)):
        assert {city_clips.start_of(short, city, number) for city in range(9) for number in range(6)} == {2}
        assert short.frames == max(12, 2 + short.window)


@needs_native
def test_varied_clips_are_reproducible() -> None:
    rules = city_clips.CityClipRules(width=48, height=32, window=1, clips=1, realism="varied", fine=1)
    first, again = (city_clips.make_clips(rules, 4) for _ in range(2))
    assert first[0].rgb.shape[-2:] == city_clips.size_of(rules, 4)[::-1]
    for a, b in zip(first, again, strict=True):
        assert a.rgb.equal(b.rgb) and a.condition.color.equal(b.condition.color)


# --- above the LiDAR ------------------------------------------------------------------------------


def _golden(config: CityConfig) -> str:
    """Digest of what a configuration draws, up to the last digits of a machine's sines."""
    plan = plan_streets(config)
    ego = ego_keys(config, plan)
    objects = plan_traffic(config, plan, *ego)
    rows = np.array(furnish(config, plan) + [m.row for m in objects])
    numbers = [rows, light_numbers(config)[1], ego[1], *(m.keys for m in objects)]
    digest = hashlib.sha256()
    for part in numbers:
        digest.update((np.round(part, 5) + 0.0).tobytes())
    return digest.hexdigest()[:16]


@pytest.mark.parametrize(
    ("seed", "digest"), [(7, "e455847fb5e099da"), (2100000, "4e2b2611be399a77"), (2100103, "ae150abf9186cbf9")]
)
def test_default_cities_are_what_they_always_were(seed: int, digest: str) -> None:
    assert _golden(CityConfig(seed=seed, n_frames=12)) == digest


def test_overhead_and_skies_change_the_city() -> None:
    plain, tall = (CityConfig(seed=7, n_frames=12, overhead=overhead) for overhead in (0.0, 0.8))
    assert _golden(tall) == _golden(tall) != _golden(plain) != _golden(replace(plain, skies="varied"))


@pytest.mark.slow
@needs_native
def test_cities_with_overhead_have_more_above_and_nothing_in_the_way() -> None:
    less, more, brightest = [], [], []
    for seed in range(30, 38):
        base = CityConfig(seed=seed, n_frames=6, width=96, height=64, supersample=1, cameras=("front",))
        for amount, shares in ((0.0, less), (1.0, more)):
            world = CityWorld(replace(base, overhead=amount, skies="varied" if amount else "plain"))
            for view in world.frame_views("front")[::5]:
                truth = world.render(view)
                shares.append(1 - truth.sky[:21].mean())
                if amount and truth.sky.any():
                    brightest.append(truth.rgb[truth.sky].mean())
                for shift_m in (-4.0, 4.0):
                    assert world.render(city_clips.shifted_view(world, view, shift_m)).depth.min() > 0.5
    assert np.mean(more) > np.mean(less) + 0.1
    assert max(brightest) > 0.9 and max(brightest) - min(brightest) > 0.2
