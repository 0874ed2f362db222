"""The generated city: exactness of its truth, agreement of its sensors, determinism, its recordings and photographs."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from refusals import refused

from mudg import native
from mudg.base import geometry, palette
from mudg.base.errors import ResourceError, UsageError
from mudg.base.types import Camera, Scene, Source, View
from mudg.city.config import CityConfig
from mudg.city.light import SKY_SLOT, draw_photos, panorama, radiance, surface
from mudg.city.logs import write_city
from mudg.city.sensors import ego_from_lidar
from mudg.city.world import CitySweep, CityTruth, CityWorld
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_points

pytestmark = pytest.mark.skipif(native.library() is None, reason="the city needs the native library")

CONFIG = CityConfig(seed=3, n_frames=12, width=96, height=64, lidar_azimuth_step_deg=1.0, crossing="yes", style="urban")
CLEAN = replace(CONFIG, lidar_noise_m=0.0, lidar_dropout=0.0, seed=5)


@pytest.fixture(scope="module")
def world() -> CityWorld:
    return CityWorld(CONFIG)


@pytest.fixture(scope="module")
def clean_world() -> CityWorld:
    return CityWorld(CLEAN)


def pixel_rays(view: View) -> np.ndarray:
    """World directions [H, W, 3] through pixel centres, scaled to camera z = 1."""
    camera = view.camera
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    return local @ view.world_from_cam[:3, :3].T


def looking_at(origin: np.ndarray, target: np.ndarray, time_s: float) -> View:
    """A one-pixel view whose only ray runs from ``origin`` to ``target``."""
    forward = (target - origin) / np.linalg.norm(target - origin)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = origin
    return View(Camera("probe", 1, 1, 100.0, 100.0, 0.5, 0.5), pose, time_s)


def left_of_ego(world: CityWorld, time_s: float) -> np.ndarray:
    pose = world.ego_path().pose_at(time_s)
    left = pose[:3, 1].copy()
    left[2] = 0
    return left / np.linalg.norm(left)


# --- exact geometry -------------------------------------------------------------------------------


def test_depth_of_the_road_is_the_plane_z_0(world: CityWorld) -> None:
    view = world.frame_views("front")[4]
    truth = world.render(view, supersample=1)
    road = truth.semantics == palette.ID["road"]
    assert road.mean() > 0.1
    analytic = -view.center_world[2] / pixel_rays(view)[..., 2]
    np.testing.assert_allclose(truth.depth[road], analytic[road], rtol=2e-4)


def test_sidewalks_lie_at_kerb_height_and_kerbs_between(world: CityWorld) -> None:
    heights = []
    for name in world.cameras():
        view = world.frame_views(name)[2]
        truth = world.render(view, supersample=1)
        walk = (truth.semantics == palette.ID["sidewalk"]) & (truth.depth < 40)
        points = view.center_world + pixel_rays(view) * truth.depth[..., None]
        heights.append(points[walk][:, 2])
    z = np.concatenate(heights)
    assert len(z) > 200 and -2e-3 < z.min() and z.max() < 0.13 + 2e-3
    assert (np.abs(z - 0.13) < 2e-3).mean() > 0.8


@pytest.mark.parametrize("shift_m", [3.0, -4.0])
def test_two_views_agree_on_what_both_see(world: CityWorld, shift_m: float) -> None:
    view = world.frame_views("front")[6]
    truth = world.render(view, supersample=1)
    origin = view.center_world + shift_m * left_of_ego(world, view.time_s)
    rows, cols = np.nonzero(~truth.sky)
    chosen = np.random.default_rng(1).choice(len(rows), 300, replace=False)
    rays = pixel_rays(view)
    agree = 0
    for row, col in zip(rows[chosen], cols[chosen]):
        point = view.center_world + rays[row, col] * truth.depth[row, col]
        other = world.render(looking_at(origin, point, view.time_s), supersample=1)
        distance = float(np.linalg.norm(point - origin))
        depth = float(other.depth[0, 0])
        assert depth <= distance + 2e-3 * distance + 0.02, "a surface seen from one view is missing from the other"
        if abs(depth - distance) < 1e-3 * distance:
            agree += 1
            assert other.semantics[0, 0] == truth.semantics[row, col]
            assert other.instance[0, 0] == truth.instance[row, col]
    assert agree > 180


def test_any_part_of_the_image_is_the_same_alone(world: CityWorld) -> None:
    """Rays of a tile share their candidates: the result must not depend on how the image is cut into tiles."""
    view = world.frame_views("front_right")[5]
    whole = world.render(view, supersample=1)
    camera = view.camera
    for x, y, w, h in ((3, 5, 61, 43), (41, 20, 19, 17), (1, 29, 90, 5), (45, 2, 5, 60)):
        part = Camera("part", w, h, camera.fx, camera.fy, camera.cx - x, camera.cy - y)
        alone = world.render(View(part, view.world_from_cam, view.time_s), supersample=1)
        np.testing.assert_allclose(alone.depth, whole.depth[y : y + h, x : x + w], rtol=1e-5)
        assert (alone.semantics == whole.semantics[y : y + h, x : x + w]).all()
        assert (alone.instance == whole.instance[y : y + h, x : x + w]).all()


def test_labels_come_from_the_pixel_centre_and_belong_together(world: CityWorld) -> None:
    view = world.frame_views("front_left")[7]
    one, two, three = (world.render(view, supersample=n) for n in (1, 2, 3))
    for other in (two, three):
        assert_same_truth(one, replace(other, rgb=one.rgb))
    assert abs(float(one.rgb.mean() - two.rgb.mean())) < 0.02
    assert (one.sky == (one.semantics == palette.ID["sky"])).all()
    movable = np.isin(one.semantics, palette.DYNAMIC_IDS)
    assert (one.instance[~movable] == 0).all()
    assert ((one.rgb >= 0) & (one.rgb <= 1)).all()


# --- LiDAR ----------------------------------------------------------------------------------------


def test_every_return_is_where_a_camera_ray_ends(clean_world: CityWorld) -> None:
    """Column by column: seen from the scanner's place and time of the return, the return is the nearest surface."""
    sweep = clean_world.lidar_sweep(5)
    points = world_points(sweep)
    rng, movers = np.random.default_rng(2), np.flatnonzero(sweep.instance > 0)
    chosen = np.concatenate([rng.choice(len(points), 250, replace=False), rng.choice(movers, 60, replace=False)])
    wrong = 0
    for i in chosen:
        time_s = sweep.time_s + float(sweep.points.dt_s[i])
        origin = (clean_world.ego_path().pose_at(time_s) @ ego_from_lidar())[:3, 3]
        probe = clean_world.render(looking_at(origin, points[i], time_s), supersample=1)
        distance = float(np.linalg.norm(points[i] - origin))
        # people's limbs keep the pose of the middle of the turn; thin things can be missed by a rounding of the
        # direction
        if abs(float(probe.depth[0, 0]) - distance) > 1e-3 * distance + 2e-3:
            wrong += 1
        else:
            assert probe.semantics[0, 0] == sweep.semantics[i]
            assert probe.instance[0, 0] == sweep.instance[i]
    assert wrong <= 0.03 * len(chosen)


def world_points(sweep: CitySweep) -> np.ndarray:
    return geometry.transform_points(sweep.world_from_lidar, sweep.points.xyz.astype(np.float64))


def test_range_noise_and_dropout_are_as_configured() -> None:
    faults = ({}, {"lidar_noise_m": 0.05}, {"lidar_dropout": 0.5})
    sweeps = [CityWorld(replace(CLEAN, traffic=0.0, **fault)).lidar_sweep(3) for fault in faults]
    quiet, noisy, sparse = (np.linalg.norm(sweep.points.xyz, axis=1) for sweep in sweeps)
    error = noisy - quiet
    assert abs(error.std() - 0.05) < 0.004 and abs(error.mean()) < 0.002
    assert abs(len(sparse) / len(quiet) - 0.5) < 0.05


def test_sweep_times_directions_and_intensity(world: CityWorld) -> None:
    sweep = world.lidar_sweep(6)
    points = sweep.points
    period = 1 / CONFIG.rate_hz
    assert np.abs(points.dt_s).max() <= period / 2
    ahead = (np.abs(points.xyz[:, 1]) < 0.05 * points.xyz[:, 0]) & (points.xyz[:, 0] > 5)
    assert np.abs(points.dt_s[ahead]).max() < 0.04 * period, "the scanner looks ahead at the sweep's time"
    left = (points.xyz[:, 1] > 5) & (np.abs(points.xyz[:, 0]) < 1)
    assert (points.dt_s[left] < -0.2 * period).all()
    assert ((points.intensity >= 0) & (points.intensity <= 1)).all() and points.intensity.std() > 0.05
    elevation = np.rad2deg(np.arcsin(points.xyz[:, 2] / np.linalg.norm(points.xyz, axis=1)))
    assert elevation.min() > CONFIG.lidar_lower_deg - 1.5 and 10 < elevation.max() < CONFIG.lidar_upper_deg + 1.5


def test_boxes_contain_the_returns_of_their_objects(world: CityWorld) -> None:
    total = outside = 0
    for index in (2, 8):
        sweep = world.lidar_sweep(index)
        points = world_points(sweep)
        for track in world.tracks():
            mine = np.flatnonzero(sweep.instance == world.instance_of(track.id))
            for dt in np.unique(sweep.points.dt_s[mine]):
                rows = mine[sweep.points.dt_s[mine] == dt]
                pose = track.pose_at(sweep.time_s + float(dt))
                local = geometry.transform_points(geometry.invert(pose), points[rows])
                outside += int((np.abs(local) > track.size_m / 2 + 0.12).any(1).sum())
                total += len(rows)
    assert total > 500
    assert outside <= 0.02 * total  # door mirrors


# --- the log --------------------------------------------------------------------------------------


def test_the_drive_starts_at_the_origin_and_curves_and_changes_speed() -> None:
    bends, speeds = [], []
    for seed in range(8):
        world = CityWorld(replace(CONFIG, seed=seed, n_frames=60, crossing="auto"))
        ego = world.ego_path()
        np.testing.assert_allclose(ego.pose_at(0.0), np.eye(4), atol=1e-12)
        steps = np.linalg.norm(np.diff(ego.world_from_ego[:, :3, 3], axis=0), axis=1) / np.diff(ego.times_s)
        assert 0.3 < steps.min() and steps.max() < 25
        bends.append(np.ptp([geometry.yaw_of(pose) for pose in ego.world_from_ego]))
        speeds.append(np.ptp(steps) / steps.mean())
    assert np.mean(np.array(bends) > np.deg2rad(3)) >= 0.5
    assert np.mean(np.array(speeds) > 0.1) >= 0.5


def test_frame_views_follow_the_vehicle(world: CityWorld) -> None:
    for name, yaw_deg in (("front", 0), ("front_left", 50), ("front_right", -50)):
        for view in world.frame_views(name):
            ego = world.ego_path().pose_at(view.time_s)
            ego_from_cam = geometry.invert(ego) @ view.world_from_cam
            forward = ego_from_cam[:3, 2]
            assert abs(np.rad2deg(np.arctan2(forward[1], forward[0])) - yaw_deg) < 0.01
            assert 1.3 < ego_from_cam[2, 3] < 2.2


def test_tracks_move_as_the_world_renders_them(world: CityWorld) -> None:
    """Between two keys the rendered car stands where Track.pose_at says."""
    time_s = 0.537
    view = world.frame_views("front")[5]
    truth = world.render(View(view.camera, view.world_from_cam, time_s), supersample=1)
    points = view.center_world + pixel_rays(view) * np.where(truth.sky, 1, truth.depth)[..., None]
    checked = 0
    for track in world.tracks():
        mine = truth.instance == world.instance_of(track.id)
        if track.label != "car" or mine.sum() < 25:
            continue
        pose = track.pose_at(time_s)
        local = geometry.transform_points(geometry.invert(pose), points[mine])
        assert (np.abs(local) < track.size_m / 2 + [0.15, 0.3, 0.1]).all()
        checked += 1
    assert checked >= 2


def test_traffic_has_all_kinds() -> None:
    kinds: set[str] = set()
    oncoming = turning = walking = parked = 0
    for seed in range(9):
        world = CityWorld(replace(CONFIG, seed=seed, n_frames=40))
        labels = [t.label for t in world.tracks()]
        kinds |= set(labels)
        assert len(labels) == len({t.id for t in world.tracks()})
        for posed, label in zip(world.objects, labels):
            travelled = np.linalg.norm(np.diff(posed.keys[:, :2], axis=0), axis=1).sum()
            turned = np.ptp(np.unwrap(posed.keys[:, 3]))
            vehicle = label in ("car", "truck", "bus")
            oncoming += vehicle and posed.moving and np.cos(posed.keys[0, 3]) < -0.5
            turning += vehicle and turned > 0.9
            walking += label == "pedestrian" and travelled > 2
            parked += label == "car" and not posed.moving
            if not posed.moving:
                assert travelled == 0
    assert kinds == {"car", "truck", "bus", "pedestrian", "cyclist"}
    assert min(oncoming, walking, parked) >= 9
    assert turning >= 3


@pytest.mark.slow
def test_classes_of_the_city() -> None:
    seen: set[int] = set()
    for seed in range(14):
        world = CityWorld(replace(CONFIG, seed=seed, style="auto", crossing="auto", width=192, height=128))
        for name in world.cameras():
            seen |= set(np.unique(world.render(world.frame_views(name)[5], supersample=1).semantics).tolist())
    missing = {palette.CLASSES[i] for i in range(19)} - {palette.CLASSES[i] for i in seen}
    assert missing <= {"train", "motorcycle"}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_no_shifted_camera_meets_an_object(seed: int) -> None:
    world = CityWorld(replace(CONFIG, seed=seed, width=24, height=16, crossing="auto", style="auto"))
    for name in world.cameras():
        for view in world.frame_views(name)[::3]:
            left = left_of_ego(world, view.time_s)
            for shift in (-4.0, -2.0, 2.0, 4.0):
                beside = geometry.from_rotation_translation(np.eye(3), shift * left) @ view.world_from_cam
                truth = world.render(replace(view, world_from_cam=beside), supersample=1)
                assert truth.depth.min() > 0.4
                spread = np.partition(truth.depth.ravel(), 20)[20]
                assert spread > 0.6, "the view is blocked by something right in front of the camera"


def test_light_and_weather() -> None:
    red_to_blue = {}
    for light in ("day", "dusk", "overcast"):
        world = CityWorld(replace(CONFIG, light=light))
        mean = world.render(world.frame_views("front")[3]).rgb.mean((0, 1))
        assert world.light_name == light and 0.1 < mean.mean() < 0.9
        red_to_blue[light] = mean[0] / mean[2]
    assert red_to_blue["dusk"] > red_to_blue["day"]


# --- same in, same out ----------------------------------------------------------------------------


def assert_same_truth(one: CityTruth, other: CityTruth) -> None:
    for name in ("rgb", "depth", "semantics", "instance"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_same_result_with_any_number_of_threads(world: CityWorld) -> None:
    before = native.threads()
    try:
        native.set_threads(1)
        other = CityWorld(CONFIG)
        view = world.frame_views("front_right")[2]
        one, one_sweep = world.render(view), world.lidar_sweep(2)
        native.set_threads(2)
        two, two_sweep = other.render(view), other.lidar_sweep(2)
    finally:
        native.set_threads(before)
    assert_same_truth(one, two)
    np.testing.assert_array_equal(one_sweep.points.xyz, two_sweep.points.xyz)


def test_noise_is_small_and_differs_between_frames(world: CityWorld) -> None:
    views = world.frame_views("front")
    noise = [world.render(v, sensor_noise=True).rgb - world.render(v).rgb for v in views[:2]]
    assert 0.001 < noise[0].std() < 0.03
    assert abs(float(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1])) < 0.1


# --- interface and errors -------------------------------------------------------------------------


def test_observation_matches_the_render(world: CityWorld) -> None:
    view = world.frame_views("front")[2]
    truth, seen = world.render(view), world.observation(view)
    np.testing.assert_array_equal(seen.rgb.permute(1, 2, 0).numpy(), truth.rgb)
    np.testing.assert_array_equal(seen.depth[0].numpy() == 0, truth.sky)
    np.testing.assert_array_equal(seen.semantics.numpy(), truth.semantics)
    assert bool(seen.mask.all())


def test_what_the_log_has_not_is_refused(world: CityWorld) -> None:
    view = world.frame_views("front")[0]
    first, last = world.span_s
    for said, change in (
        ("outside the log", {"time_s": first - 0.2}),
        ("outside the log", {"time_s": last + 0.2}),
        ("undistorted", {"camera": replace(view.camera, readout_s=0.01)}),
        ("undistorted", {"camera": replace(view.camera, distortion=(0.1, 0.0))}),
    ):
        refused(said, world.render, replace(view, **change), raises=UsageError)
    world.render(replace(view, time_s=first), supersample=1)
    refused("supersample", world.render, view, supersample=0, raises=UsageError)
    refused("no such sweep", world.lidar_sweep, CONFIG.n_frames, raises=UsageError)
    refused("no such camera", world.frame_views, "rear", raises=UsageError)
    refused("was not generated", CityWorld.from_source, Source("kitti", "CC-BY-NC-SA", None))
    recipe = {**dict(world.source().recipe or {}), "generator_version": 999}
    refused("another version", CityWorld.from_source, Source("city", "CC0-1.0", recipe))


def test_without_the_library_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    from mudg.city import world as layer

    layer.library.cache_clear()
    monkeypatch.setattr(native, "library", lambda: None)
    assert refused("native library", CityWorld, CONFIG, raises=ResourceError).remedy
    layer.library.cache_clear()


def test_no_traffic_and_one_camera_work() -> None:
    world = CityWorld(replace(CONFIG, traffic=0.0, cameras=("front",), n_frames=1))
    assert world.tracks() == () and list(world.cameras()) == ["front"] and len(world.lidar_sweep(0).points.xyz) > 100
    assert (world.render(world.frame_views("front")[0]).instance == 0).all()


def test_importing_the_city_loads_no_torch() -> None:
    code = "import sys, mudg.city, mudg.city.world; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


# --- a recorded city: the scene on disk is the world, rebuilt bit for bit from its recipe ----------

WEATHER = {"light": "night", "wet": 0.5, "snow_cover": 0.3, "fog_visibility_m": 300.0}
SIZE = {"n_frames": 9, "width": 60, "height": 40, "lidar_azimuth_step_deg": 2.0}
RECORDED = CityConfig(seed=9, cameras=("front", "front_left"), **SIZE, **WEATHER)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return write_city(RECORDED, tmp_path_factory.mktemp("city") / "scene")


@pytest.fixture(scope="module")
def recorded(scene: Scene) -> CityWorld:
    return CityWorld.from_source(scene.source)


def test_images_and_labels_are_the_truth(scene: Scene, recorded: CityWorld) -> None:
    assert len(scene.frames) == 2 * RECORDED.n_frames
    moving = {i + 1 for i, posed in enumerate(recorded.objects) if posed.moving}
    for frame in (scene.frames_of("front")[3], scene.frames_of("front_left")[8]):
        truth = recorded.render(frame.view, sensor_noise=True)
        np.testing.assert_array_equal(read_image(scene, frame), truth.rgb_u8)
        depth = read_label(scene, frame, "depth")
        np.testing.assert_array_equal(np.isnan(depth), truth.sky)
        np.testing.assert_array_equal(depth[~truth.sky], truth.depth[~truth.sky])
        for name in ("semantics", "instance", "sky"):
            np.testing.assert_array_equal(read_label(scene, frame, name), getattr(truth, name))
        np.testing.assert_array_equal(read_label(scene, frame, "dynamic"), np.isin(truth.instance, sorted(moving)))


def test_sweeps_tracks_and_ego_are_the_truth(scene: Scene, recorded: CityWorld) -> None:
    assert len(scene.sweeps) == RECORDED.n_frames
    points, sweep = read_points(scene, scene.sweeps[4]), recorded.lidar_sweep(4)
    np.testing.assert_array_equal(points.xyz, sweep.points.xyz)
    np.testing.assert_array_equal(points.intensity, sweep.points.intensity)
    for stored, true in zip(scene.tracks, recorded.tracks(), strict=True):
        assert (stored.id, stored.label) == (true.id, true.label)
        np.testing.assert_allclose(stored.world_from_object, true.world_from_object, atol=1e-9)
    for time_s in (frame.view.time_s for frame in scene.frames):
        np.testing.assert_allclose(scene.ego.pose_at(time_s), recorded.ego_path().pose_at(time_s), atol=1e-9)


def test_held_out_frames(scene: Scene, tmp_path: Path) -> None:
    held_out = sorted(frame.id for frame in scene.frames_in("test"))
    assert held_out == ["front/000004", "front/000008", "front_left/000004", "front_left/000008"]
    refused("negative", write_city, RECORDED, tmp_path / "x", test_every=-1, raises=UsageError)
    refused("scene here already", write_city, RECORDED, scene.root)


def test_the_same_call_writes_the_same_bytes(scene: Scene, tmp_path: Path) -> None:
    again = write_city(RECORDED, tmp_path / "again")
    manifest = (Path(scene.root) / "manifest.json").read_text()
    assert (Path(again.root) / "manifest.json").read_text() == manifest


# --- photographic surfaces and skies ---------------------------------------------------------------


def hdr_bytes(rgbe: np.ndarray) -> bytes:
    """A run-length coded Radiance file of u8[H, W, 4]; the first half of every row as runs of literals, the second as
    runs."""
    height, width = rgbe.shape[:2]
    half, out = width // 2, f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode()
    for row in rgbe:
        out += bytes([2, 2, width >> 8, width & 255])
        for values in row.T.tolist():
            out += bytes([half, *values[:half], *(byte for value in values[half:] for byte in (129, value))])
    return out


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    (tmp_path / "textures").mkdir()
    (tmp_path / "sky").mkdir()
    for name in ("Asphalt1.png", "Concrete1.png", "Bricks1.png", "Plaster1.png", "Grass1.png", "unknown.png"):
        Image.fromarray(rng.integers(40, 200, (32, 32, 3), np.uint8)).save(tmp_path / "textures" / name)
    rgbe = np.full((64, 128, 4), 128, np.uint8)
    rgbe[:32, :, 2] = 255  # blue above
    rgbe[..., 3] = 129
    (tmp_path / "sky" / "blue.hdr").write_bytes(hdr_bytes(rgbe))
    return tmp_path


def test_radiance_pixels_are_mantissa_times_two_to_the_exponent() -> None:
    rgbe = np.array([[(128, 64, 32, 129)] * 16, [(200, 100, 50, 131)] * 16], np.uint8)
    rgbe[1, 3] = (9, 9, 9, 0)
    image = radiance(hdr_bytes(rgbe), Path("a.hdr"))
    assert image.shape == (2, 16, 3) and (image[1, 3] == 0).all()
    assert np.allclose(image[0, 5], [1.0, 0.5, 0.25]) and np.allclose(image[1, 12], np.array([200, 100, 50]) / 32)


@pytest.mark.parametrize(
    "spoil",
    [lambda b: b[:-7], lambda b: b[2:], lambda b: b.replace(b"-Y", b"+Y"), lambda b: b.replace(b"+X 16", b"+X 24")],
)
def test_spoiled_radiance_files_are_refused(spoil) -> None:
    refused("Radiance", radiance, spoil(hdr_bytes(np.full((2, 16, 4), 130, np.uint8))), Path("a.hdr"))


def test_surfaces_vary_around_one_and_skies_around_their_median(folder: Path) -> None:
    pixels = surface(folder / "textures" / "Asphalt1.png")
    assert pixels.mean() == pytest.approx(1.0, abs=0.05)
    sky = panorama(folder / "sky" / "blue.hdr")
    assert float(np.median(sky.mean(-1))) == pytest.approx(1.0, abs=0.05)
    assert (sky[..., 2] > sky[..., 0]).all()


def test_photographs_follow_from_folder_and_seed(folder: Path) -> None:
    first, again = draw_photos(folder, 3), draw_photos(folder, 3)
    assert [(s, m) for s, _, m in first] == [(s, m) for s, _, m in again]
    assert all(np.array_equal(a[1], b[1]) for a, b in zip(first, again, strict=True))
    slots = [{s for s, _, _ in draw_photos(folder, seed)} for seed in range(30)]
    assert 0.3 < np.mean([SKY_SLOT in s for s in slots]) < 0.8
    assert set.union(*slots) <= {0, 1, 2, 3, 4, 5, SKY_SLOT}
    refused("no such folder", draw_photos, folder / "missing", 3)


def test_photographs_change_colours_and_nothing_else(folder: Path) -> None:
    plain = CityConfig(seed=4, n_frames=2, width=96, height=64, cameras=("front",))
    many = lambda seed: SKY_SLOT in {p[0] for p in draw_photos(folder, seed)} and len(draw_photos(folder, seed)) > 5
    plain = replace(plain, seed=next(seed for seed in range(4, 60) if many(seed)))
    without, with_photos = CityWorld(plain), CityWorld(replace(plain, textures=str(folder)))
    view = without.frame_views("front")[0]
    a, b = without.render(view), with_photos.render(view)
    assert_same_truth(replace(a, rgb=b.rgb), b)
    road = a.semantics == 0
    assert np.abs(a.rgb[road] - b.rgb[road]).mean() > 0.005
    assert a.rgb[road].mean() == pytest.approx(b.rgb[road].mean(), rel=0.15)
    if a.sky.any():
        assert (b.rgb[b.sky][:, 2] >= b.rgb[b.sky][:, 0]).all()
    again = CityWorld(replace(plain, textures=str(folder))).render(view)
    assert np.array_equal(b.rgb, again.rgb)
