"""Conditions for the diffusion model: geometry of the warp, what is removed, filled and marked; training clips."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_clips import some_clip

from mudg import native
from mudg.base import palette
from mudg.base.errors import InputError
from mudg.base.types import Camera, FusedCloud, Photo, PointCloud, Track, View
from mudg.core import project as visible
from mudg.diffusion import city_clips, clips
from mudg.diffusion import condition as conditions
from mudg.diffusion.city_clips import HELD_OUT, CityClipRules, shifts_of
from mudg.diffusion.condition import FAR_M, ConditionRules, DriveInputs, WarpSource, build_conditions
from mudg.diffusion.views import conditions_of

CAMERA = Camera("front", 48, 32, 40.0, 40.0, 24.0, 16.0)
RULES = ConditionRules(48, 32, occluder_m=0.0)
# camera axes in the world: x right = -y, y down = -z, z forward = x
LOOKING_ALONG_X = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def view_at(x=0.0, y=0.0, time_s=0.0, camera=CAMERA):
    pose = LOOKING_ALONG_X.copy()
    pose[:3, 3] = [x, y, 0]
    return View(camera, pose, time_s)


def wall(x_m, color_of_y, y_range=(-20, 20), z_range=(-9, 9), step=0.05):
    """A wall across the view at x = x_m with colours by lateral position."""
    y, z = np.meshgrid(np.arange(*y_range, step), np.arange(*z_range, step))
    xyz = np.stack([np.full(y.size, x_m), y.ravel(), z.ravel()], 1).astype(np.float32)
    return PointCloud(xyz, color_of_y(y.ravel()).astype(np.uint8), "world")


def stripes(y):
    """Smooth stripes so that bilinear look-ups can be compared."""
    return np.stack([127 + 120 * np.sin(y), 127 + 120 * np.cos(0.7 * y), 60 + 0 * y], -1)


def image_of_wall(view, x_m):
    """What the striped wall looks like from a view: exact, per pixel centre."""
    camera = view.camera
    u = np.arange(camera.width) + 0.5
    y = view.center_world[1] - (u - camera.cx) / camera.fx * (x_m - view.center_world[0])
    return np.broadcast_to(stripes(y)[None], (camera.height, camera.width, 3)).round().astype(np.uint8).copy()


def test_warp_of_a_plane_is_exact_and_moves_left_when_the_camera_does():
    """A striped wall 10 m ahead, seen from 1.5 m beside: the warped recorded image equals the true one. At depth Z a
    shift s to the left moves content f s / Z pixels to the right in the new image."""
    recorded, target = view_at(), view_at(y=1.5)
    image, depth = conditions.image_tensor(image_of_wall(recorded, 10.0)), torch.full((32, 48), 10.0)
    source = WarpSource(recorded, image, depth, depth < 0, torch.zeros(32, 48, dtype=torch.uint8))
    rgb, _, found = source.warped(target, torch.full((32, 48), 10.0), source.depth, 0.08)
    truth = conditions.image_tensor(image_of_wall(target, 10.0))
    assert float(found.float().mean()) > 0.85
    assert float((rgb - truth).abs()[:, found].max()) < 0.01
    recorded, target = view_at(), view_at(y=1.0)
    x, _, _ = conditions.carry(target, torch.full((1, 32, 48), 10.0), recorded)
    assert float((x[0, 0] - (torch.arange(48) + 0.5)).mean()) == pytest.approx(-40.0 * 1.0 / 10.0)


def test_hidden_pixels_are_not_taken():
    recorded, target = view_at(), view_at(y=1.0)
    surface = torch.full((32, 48), 10.0)
    surface[:, 20:28] = 4.0  # something near stands there in the recorded image
    source = WarpSource(recorded, torch.zeros(3, 32, 48), surface, surface < 0, torch.zeros(32, 48, dtype=torch.uint8))
    _, _, found = source.warped(target, torch.full((32, 48), 10.0), surface, 0.08)
    x, _, _ = conditions.carry(target, torch.full((1, 32, 48), 10.0), recorded)
    behind = (x[0] > 20.5) & (x[0] < 27.5)
    assert bool(behind.any())
    assert not bool(found[behind].any())


def test_shine_through_is_removed_and_edges_stay():
    depth, valid = np.full((20, 20), 5.0, np.float32), np.ones((20, 20), bool)
    depth[10, 10] = 30.0  # a far point seen through a near wall
    depth[:, :6] = 30.0  # an ordinary edge: far on one side only
    kept = visible.seen_pixels(depth, valid, visible.RULES["condition"])
    assert not kept[10, 10]
    assert int((~kept).sum()) == 1


def test_condition_of_a_wall():
    """Shifted view of a striped wall: depth exact where measured, colour near the truth, masks where they should be."""
    cloud = FusedCloud(wall(12.0, stripes, z_range=(-9, 1)), {})
    recorded = [Photo(view_at(time_s=t), image_of_wall(view_at(), 12.0)) for t in (0.0, 0.1)]
    target = view_at(y=2.0, time_s=0.1)
    condition = build_conditions(DriveInputs(cloud, [], recorded), [target], RULES)[0]
    valid = condition.valid[0, 0]
    assert condition.color.shape == (1, 3, 32, 48)
    assert bool(valid[-8:].all())
    assert not bool(valid[:4].any())
    assert torch.allclose(condition.depth[0, 0][valid], torch.tensor(12.0), atol=1e-4)
    assert torch.allclose(condition.depth, torch.full_like(condition.depth, 12.0), atol=1e-3)
    truth = conditions.image_tensor(image_of_wall(target, 12.0))
    warped = condition.warped[0, 0]
    assert float((condition.color[0] - truth).abs()[:, warped].max()) < 0.02
    assert bool(warped[:4, 10:38].all())
    assert torch.equal(condition.reference, conditions.image_tensor(recorded[1].rgb))


@pytest.mark.parametrize("fine", [0, 2])
def test_above_the_lidar_stands_what_recorded_images_show(fine):
    """A house 20 m away to the left, sky to the right of it, and a car 6 m ahead; points were measured below the
    horizon alone, most of them nearest to the car. Above it the house goes on and the sky is far away."""
    house, car, sky = (palette.ID[name] for name in ("building", "car", "sky"))
    grey = lambda y: np.full((len(y), 3), 128)
    parts = [(wall(20.0, grey, (0, 20), (-9, -0.1)), house), (wall(6.0, grey, (-1, 1), (-0.6, -0.1)), car)]
    xyz, rgb = (np.concatenate([getattr(part, name) for part, _ in parts]) for name in ("xyz", "rgb"))
    labels = np.concatenate([np.full(len(part), name, np.uint8) for part, name in parts])
    cloud = FusedCloud(PointCloud(xyz, rgb, "world", labels), {})
    y_at_house = lambda view: view.center_world[1] - (np.arange(48) + 0.5 - 24) / 40 * 20
    recorded, target = view_at(), view_at(y=1.5)
    ids = np.tile(np.where(y_at_house(recorded) > 0, house, sky).astype(np.uint8), (32, 1))
    y, z = (np.arange(n) + 0.5 - n / 2 for n in (48, 32))
    ids[(np.abs(y)[None] / 40 * 6 < 1) & (z[:, None] / 40 * 6 > 0.1) & (z[:, None] / 40 * 6 < 0.6)] = car
    drive = DriveInputs(cloud, [], [Photo(recorded, np.full((32, 48, 3), 128, np.uint8), ids)])
    rules = replace(RULES, fine_width=48 * fine, fine_height=32 * fine)
    made = build_conditions(drive, [target], rules)[0]
    above = slice(0, 12)
    assert not bool(made.valid[0, 0][above].any())
    depth, found = made.depth[0, 0][above], made.semantics[0, 0][above]
    for part, expected, name in ((y_at_house(target) > 1.5, 20.0, house), (y_at_house(target) < -1.5, FAR_M, sky)):
        part &= np.arange(48) < 40  # what the image shows
        assert part.sum() > 8
        assert torch.allclose(depth[:, part], torch.tensor(expected), atol=1e-3)
        assert bool((found[:, part] == name).all())


def test_the_backdrop_and_the_published_condition():
    cloud = FusedCloud(wall(12.0, stripes), {})
    recorded = [Photo(view_at(), image_of_wall(view_at(), 12.0))]
    condition = build_conditions(DriveInputs(cloud, [], recorded), [view_at()], RULES)[0]
    assert torch.allclose(condition.backdrop[0], conditions.image_tensor(recorded[0].rgb), atol=1e-5)
    cloud = FusedCloud(wall(12.0, stripes, z_range=(-9, 1)), {})
    condition = build_conditions(DriveInputs(cloud, [], recorded), [view_at(y=1.0)], replace(RULES, published=True))[0]
    hole = ~condition.valid
    assert bool(hole.any())
    assert float(condition.depth[hole].abs().max()) == 0
    assert float((condition.color * hole).abs().max()) == 0
    assert condition.warped is None


def test_images_that_show_the_same_surface_are_averaged():
    """Three photographs of one wall from one place: two differ by noise, the third has the sun on it."""
    random = np.random.default_rng(5)
    wall_now = image_of_wall(view_at(), 12.0).clip(20, 200)
    noisy = [(wall_now + random.integers(-12, 13, wall_now.shape)).astype(np.uint8) for _ in range(2)]
    photos = [Photo(view_at(time_s=0.1 * n), rgb) for n, rgb in enumerate([*noisy, (wall_now + 50).astype(np.uint8)])]
    drive = DriveInputs(FusedCloud(wall(12.0, stripes), {}), [], photos)
    made = build_conditions(drive, [view_at()], RULES)[0]
    assert bool(made.warped.all())
    mean = np.stack(noisy).astype(np.float32).mean(0) / 255
    assert torch.allclose(made.color[0], torch.from_numpy(mean).permute(2, 0, 1), atol=1e-4)


@pytest.mark.parametrize(("depth", "labelled"), [(6.0, True), (60.0, True), (6.0, False)])
def test_near_road_users_are_no_part_of_the_backdrop(depth, labelled):
    """A red bus ahead in a grey street: the street goes on behind it, unless it is far away."""
    bus, house = palette.ID["bus"], palette.ID["building"]
    there = torch.zeros(32, 48, dtype=torch.bool)
    there[10:22, 18:30] = True
    ids = torch.where(there, bus, house).to(torch.uint8)
    ids = ids if labelled else torch.full_like(ids, palette.UNLABELLED)
    grey, red = torch.full((3, 1, 1), 0.5), torch.tensor([1.0, 0.0, 0.0])[:, None, None]
    photo = WarpSource(view_at(), torch.where(there, red, grey), torch.where(there, depth, 50.0), there, ids)
    color, found, usable = conditions._backdrop(view_at(), photo)
    near = depth < 40
    assert bool(usable.all())
    assert torch.allclose(color, grey if near else photo.rgb, atol=1e-5)
    assert torch.equal(found[0], torch.where(there & near & labelled, house, ids).to(torch.uint8))
    spoilt = torch.zeros_like(there)
    spoilt[:, :18] = True  # what an edit took away to the left of the bus must not be continued behind it
    blue = torch.where(spoilt, torch.tensor([0.0, 0.0, 1.0])[:, None, None], photo.rgb)
    color, found, usable = conditions._backdrop(view_at(), replace(photo, rgb=blue, usable=~spoilt))
    assert torch.equal(usable[0], ~spoilt)
    assert torch.allclose(color[:, there], (grey if near else red)[:, 0], atol=1e-5)
    assert not near or not labelled or bool((found[0][there] == house).all())


@pytest.mark.parametrize("fine", [0, 2])
def test_parts_of_a_condition_are_switched_off(fine):
    cloud = FusedCloud(wall(12.0, stripes, z_range=(-9, 1)), {})
    recorded = [Photo(view_at(time_s=t), image_of_wall(view_at(), 12.0)) for t in (0.0, 0.1)]
    rules = replace(RULES, fine_width=48 * fine, fine_height=32 * fine)
    views = [view_at(y=2.0, time_s=0.1)]
    given = DriveInputs(cloud, (), recorded)
    full, points, reference, concat = (
        conditions_of(given, parts, views, rules, {}) for parts in ("full", "points", "reference", "concat")
    )
    for grid in (0, 1):
        whole, bare, image, both = full[grid], points[grid], reference[grid], concat[grid]
        assert bool(whole.warped.any()) and not any(bool(c.warped.any()) for c in (bare, image, both))
        assert torch.equal(bare.valid, whole.valid) and torch.equal(bare.depth, whole.depth)
        assert torch.equal(bare.backdrop, bare.color)
        assert torch.equal(both.color, bare.color) and torch.equal(both.depth, bare.depth)
        assert torch.equal(both.backdrop, whole.backdrop) and torch.equal(image.color, whole.backdrop)
        assert not bool(image.valid.any()) and bool((image.depth == conditions.FAR_M).all())
    assert torch.equal(full[0].color, build_conditions(DriveInputs(cloud, [], recorded), views, rules)[0].color)


def test_moving_things_take_no_colour_from_another_time():
    """The car's points are green; the only recorded image, one second older, shows red where the car now stands."""
    red = np.zeros((32, 48, 3), np.uint8)
    red[..., 0] = 255
    grid = np.stack(np.meshgrid([-2.0], np.arange(-1, 1, 0.02), np.arange(-0.7, 0.7, 0.02)), -1).reshape(-1, 3)
    green = np.tile(np.array([[0, 255, 0]], np.uint8), (len(grid), 1))
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[:, 0, 3] = 10.0
    track = Track("car-1", "car", np.array([4.0, 2.0, 1.5]), np.array([0.0, 1.0]), poses)
    static = wall(30.0, lambda y: np.tile([[0, 0, 255]], (len(y), 1)), step=0.1)
    cloud = FusedCloud(static, {"car-1": PointCloud(grid.astype(np.float32), green, "object")})
    old, fresh = Photo(view_at(time_s=0.0), red), Photo(view_at(time_s=1.0), red)
    target = view_at(time_s=1.0)
    car = (slice(14, 18), slice(22, 26))
    held = build_conditions(DriveInputs(cloud, [track], [old]), [target], RULES)[0]
    assert torch.equal(held.color[0][:, car[0], car[1]].amax((1, 2)), torch.tensor([0.0, 1.0, 0.0]))
    assert not bool(held.warped[0, 0][car].any())
    now = build_conditions(DriveInputs(cloud, [track], [fresh]), [target], RULES)[0]
    assert torch.allclose(now.color[0][:, car[0], car[1]].amax((1, 2)), torch.tensor([1.0, 0.0, 0.0]), atol=1e-5)


def test_sizes_follow_the_rules_and_a_fine_grid_gives_cleaner_colour():
    cloud = FusedCloud(wall(12.0, stripes), {})
    big = Camera("front", 96, 64, 80.0, 80.0, 48.0, 32.0)
    recorded = [Photo(view_at(camera=big), image_of_wall(view_at(camera=big), 12.0))]
    condition = build_conditions(DriveInputs(cloud, [], recorded), [view_at(y=0.5, camera=big)], RULES)[0]
    assert condition.views[0].camera.width == 48
    truth = conditions.image_tensor(image_of_wall(view_at(y=0.5), 12.0))
    warped = condition.warped[0, 0]
    assert float((condition.color[0] - truth).abs()[:, warped].mean()) < 0.02
    drive, target, plain = DriveInputs(cloud, [], recorded), view_at(y=0.5, camera=big), condition
    small, fine = build_conditions(drive, [target], replace(RULES, fine_width=96, fine_height=64))
    assert fine.color.shape[-2:] == (64, 96)
    assert small.color.shape == plain.color.shape
    assert torch.equal(small.depth, plain.depth)
    assert torch.equal(small.valid, plain.valid)
    large = conditions.image_tensor(image_of_wall(target, 12.0))
    truth = torch.nn.functional.interpolate(large[None], size=(32, 48), mode="area")[0]
    both = plain.warped[0, 0] & small.warped[0, 0]
    error = [float((c.color[0] - truth).abs()[:, both].mean()) for c in (small, plain)]
    assert error[0] <= error[1] + 1e-4


# training clips -----------------------------------------------------------------------------------


def test_shards_give_back_what_was_packed_and_a_missing_one_is_named(tmp_path):
    clip = some_clip()
    clips.write_shard(tmp_path, 3, [replace(clip, shift_m=1.5), clip])
    shards = clips.ShardFolder(tmp_path)
    assert shards.clips_in(3) == 2
    first, second = shards.clip(3, 0, [0, 2]), shards.clip(3, 1, [1, 2])
    assert (first.shift_m, second.shift_m) == (1.5, 0.0)
    assert torch.allclose(first.rgb, clip.rgb[[0, 2]], atol=0.5 / 255 + 1e-6)
    assert torch.allclose(second.condition.color, clip.condition.color[[1, 2]], atol=0.5 / 255 + 1e-6)
    assert torch.equal(first.condition.valid, clip.condition.valid[[0, 2]])
    assert torch.equal(second.condition.warped, clip.condition.warped[[1, 2]])
    assert torch.equal(first.semantics, clip.semantics[[0, 2]])
    known = clip.depth_valid[[0, 2]]
    assert torch.allclose(first.depth[known], clip.depth[[0, 2]][known], rtol=1e-3)
    assert bool((first.depth[~known] == clips.FAR_M).all())
    for view, original in zip(first.condition.views, (clip.condition.views[0], clip.condition.views[2])):
        assert np.array_equal(view.world_from_cam, original.world_from_cam)
        assert replace(view.camera, name="front") == original.camera
    with pytest.raises(InputError, match="city_0000007"):
        clips.clip_at(clips.shard_path(tmp_path, 7), 0, [0])


def test_variation_treats_truth_and_condition_alike(tmp_path):
    clip = some_clip()
    same = replace(clip, condition=replace(clip.condition, color=clip.rgb, backdrop=clip.rgb))
    clips.write_shard(tmp_path, 0, [replace(same, shift_m=2.0)])
    read = clips.ShardFolder(tmp_path).clip(0, 0, [0, 1, 2])
    flips = set()
    for seed in range(6):
        varied = clips.vary(read, np.random.default_rng(seed))
        assert float((varied.rgb - varied.condition.color).abs().mean()) < 0.04
        assert torch.equal(varied.semantics.flip(-1), read.semantics) or torch.equal(varied.semantics, read.semantics)
        flips.add(varied.shift_m)
        again = clips.vary(read, np.random.default_rng(seed))
        assert torch.equal(varied.rgb, again.rgb)
    assert flips == {2.0, -2.0}


def test_city_clips_are_a_function_of_seed_and_number():
    if native.library() is None:
        pytest.skip("the native library is not built")
    rules = CityClipRules(width=48, height=32, window=1, clips=1)
    first, again = (city_clips.make_clips(rules, 5) for _ in range(2))
    assert [clip.shift_m for clip in first] == list(city_clips.shifts_of(rules, 5)) and len(first) == 1
    for name in ("rgb", "depth", "semantics"):
        assert torch.equal(getattr(first[0], name), getattr(again[0], name)), name
    assert torch.equal(first[0].condition.color, again[0].condition.color)
    measured = first[0].condition.valid & first[0].depth_valid
    error = (first[0].condition.depth - first[0].depth).abs() / first[0].depth
    assert float(measured.float().mean()) > 0.1
    assert float(error[measured].median()) < 0.05


def test_held_out_cities_have_the_stated_shifts():
    rules = CityClipRules()
    assert shifts_of(rules, HELD_OUT) == (2.0, -3.0, 4.0, 0.0)
    assert shifts_of(rules, HELD_OUT + 1) == (-2.0, 3.0, -4.0, 0.0)
    for city in range(20):
        shifts = shifts_of(rules, city)
        assert len(shifts) == 4
        assert min(shifts) < 0 < max(shifts)
        assert shifts[-1] == 0.0
        assert all(0.5 <= abs(s) <= 4.2 for s in shifts[:-1])
