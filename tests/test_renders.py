"""Renders of a fitted scene in the condition: what they tell, how they are stored, varied and taken up."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused
from scipy import ndimage
from test_clips import RULES, image_of_wall, stripes, view_at, wall
from tiny_networks import FINISHING, TINY, randomised
from toy_clips import made_up_clip, part_of, some_condition, some_ids, with_patch

from mudg import native
from mudg.base import palette
from mudg.base.errors import UsageError
from mudg.base.types import Camera, FusedCloud, Photo, PointCloud, RenderPlanes, Track
from mudg.diffusion import city_clips, clips, network
from mudg.diffusion import condition as conditions
from mudg.diffusion import model as mdm
from mudg.diffusion.city_clips import CityClipRules
from mudg.diffusion.condition import FAR_M, REACH_PX, SURE_ALPHA, DriveInputs, build_conditions
from mudg.diffusion.models import extended
from mudg.diffusion.requests import SampleRequest

NOTHING = FusedCloud(PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), "world"), {})


def flat_render(view, depth=40.0, alpha=1.0, color=(0.8, 0.2, 0.1), label=2):
    """One colour, depth, coverage and class all over a view."""
    plane = torch.ones(1, view.camera.height, view.camera.width)
    rgb = torch.tensor(color).view(3, 1, 1) * plane
    return RenderPlanes(rgb, depth * plane, alpha * plane, 0.5 * alpha * plane, (label * plane).to(torch.uint8))


def with_renders(condition, seed=5):
    generator = torch.Generator().manual_seed(seed)
    t, _, h, w = condition.color.shape
    draw = lambda c: torch.rand(t, c, h, w, generator=generator)
    alpha = draw(1)
    planes = RenderPlanes(draw(3), 3 + 60 * draw(1), alpha, alpha * draw(1), some_ids(generator, t, h, w))
    return replace(condition, renders=planes)


# the condition ------------------------------------------------------------------------------------


def test_renders_tell_the_depth_beyond_the_reach_of_measured_pixels():
    """A wall at 12 m whose upper part no point was measured on; the render says 12.5 m and red, all over."""
    cloud, view = FusedCloud(wall(12.0, stripes, z_range=(-9, 1)), {}), view_at()
    render = lambda view: flat_render(view, 12.5)
    plain = build_conditions(DriveInputs(cloud, [], []), [view], RULES)[0]
    helped = build_conditions(DriveInputs(cloud, [], [], render_at=render), [view], RULES)[0]
    measured = plain.valid[0, 0]
    near = torch.from_numpy(ndimage.binary_dilation(measured.numpy(), iterations=REACH_PX))
    assert bool((near & ~measured).any()) and bool((~near).any())
    assert torch.equal(helped.valid, plain.valid)
    assert torch.equal(helped.depth[0, 0][near], plain.depth[0, 0][near])
    assert bool((helped.depth[0, 0][~near] == 12.5).all())
    assert bool((plain.depth[0, 0][~near] < 12.4).all())
    assert torch.equal(helped.color[0][:, near], plain.color[0][:, near])
    assert torch.allclose(helped.color[0][:, ~near], torch.tensor([[0.8], [0.2], [0.1]]))
    assert bool((helped.semantics[0, 0][~near] == 2).all())
    assert torch.equal(helped.semantics[0, 0][near], plain.semantics[0, 0][near])
    assert plain.renders is None
    shown = render(view)
    assert torch.equal(helped.renders.color[0], shown.color) and torch.equal(helped.renders.depth[0], shown.depth)


@pytest.mark.parametrize(("alpha", "depth"), [(1.0, 40.0), (1.0, 4.0), (0.8, 40.0), (1.0, 12.5)])
def test_the_outline_of_a_measured_surface_is_that_of_the_render(alpha, depth):
    """A board 12 m away, measured on every third row and column. Beside it the render's surface stands, if it covers
    the pixel and is another one; between measured pixels the board goes on, whatever the render shows there."""
    cloud, view = FusedCloud(wall(12.0, stripes, y_range=(-2, 2), z_range=(-1, 1), step=0.9), {}), view_at()
    render_at = lambda view: flat_render(view, depth, alpha)
    made = build_conditions(DriveInputs(cloud, [], [], render_at), [view], RULES)[0]
    measured = made.valid[0, 0].numpy()
    rows, columns = np.nonzero(measured)
    board = np.zeros_like(measured)
    board[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = True
    assert (board & ~measured).sum() > 50
    beside = ndimage.binary_dilation(measured, iterations=REACH_PX) & ~board
    assert beside.sum() > 50
    z = made.depth[0, 0].numpy()
    assert np.allclose(z[board], 12.0)
    assert np.allclose(z[beside], depth if alpha > SURE_ALPHA and depth != 12.5 else 12.0)


def test_what_a_render_shows_in_the_box_of_an_object_moves_with_it():
    """A car 10 m ahead of which one point was measured; the render shows all of it. A photograph of one second earlier,
    when the car was elsewhere, must not colour it."""
    corner = PointCloud(np.array([[-1.9, 0.0, 0.0]], np.float32), np.full((1, 3), 90, np.uint8), "object")
    poses = np.stack([np.eye(4)] * 2)
    poses[0, :3, 3], poses[1, :3, 3] = (12.0, -6.0, 0.0), (12.0, 0.0, 0.0)
    track = Track("car", "car", np.array([4.0, 4.0, 4.0]), np.array([0.0, 1.0]), poses)
    cloud, now = FusedCloud(NOTHING.static, {"car": corner}), view_at(time_s=1.0)
    car = lambda view: flat_render(view, 10.1, label=palette.ID["car"])
    green = Photo(view_at(), np.full((32, 48, 3), (0, 255, 0), np.uint8))
    made = build_conditions(DriveInputs(cloud, [track], [green], render_at=car), [now], RULES)[0]
    across = (torch.arange(48) + 0.5 - 24).abs() / 40 * 10.1
    high = (torch.arange(32) + 0.5 - 16).abs() / 40 * 10.1
    in_box = (across[None] < 1.8) & (high[:, None] < 1.8)
    beside = (across[None] > 2.6) & (high[:, None] < 1.8) & (torch.arange(48) < 24)  # to the right it stood then
    assert not bool(made.warped[0, 0][in_box].any())
    assert bool(made.warped[0, 0][beside].all())


@pytest.mark.parametrize(("alpha", "depth", "expected"), [(0.4, 40.0, None), (0.6, 40.0, 40.0), (1.0, 5000.0, None)])
def test_what_the_render_hardly_covers_is_far_away(alpha, depth, expected):
    render_at = lambda view: flat_render(view, depth, alpha)
    drive = DriveInputs(NOTHING, [], [], render_at)
    made = build_conditions(drive, [view_at()], RULES)[0]
    assert not bool(made.valid.any()) and bool((made.depth == (expected or FAR_M)).all())
    published = build_conditions(drive, [view_at()], replace(RULES, published=True))[0]
    assert published.renders is None and not bool(published.depth.any())
    unfitted = build_conditions(replace(drive, render_at=None), [view_at()], RULES)[0]  # nothing in view is no error
    assert not bool(unfitted.valid.any()) and float(unfitted.depth.min()) == FAR_M
    refused("at least one view", build_conditions, drive, [], RULES)


@pytest.mark.parametrize(
    ("recorded", "above"), [(None, "far"), ("sky", "far"), ("building", "wall"), ("unlabelled", "far")]
)
def test_a_hole_below_the_horizon_is_no_sky(recorded, above):
    """A wall measured on a band of rows only; the render covers nothing. Below the horizon the wall goes on, above it
    there is sky, unless the recorded image shows a surface in that direction."""
    points = wall(12.0, stripes, z_range=(-3, -2))
    points = replace(points, semantics=np.full(len(points), 2, np.uint8))
    view = view_at()
    photos = []
    if recorded is not None:
        name = np.uint8(palette.UNLABELLED if recorded == "unlabelled" else palette.ID[recorded])
        photos = [Photo(view, np.zeros((32, 48, 3), np.uint8), np.full((32, 48), name))]
    empty = lambda view: flat_render(view, 1000.0, 0.1, (0.5, 0.7, 1.0), palette.ID["sky"])
    rules = replace(RULES, warp=recorded is not None, hidden_share=-100.0)
    made = build_conditions(DriveInputs(FusedCloud(points, {}), [], photos, render_at=empty), [view], rules)[0]
    depth, ids, shown = made.depth[0, 0], made.semantics[0, 0], made.renders
    below, top = slice(20, None), slice(0, 12)
    assert not bool(made.valid[0, 0][-4:].any())
    assert all(bool((x[below] == 2).all()) for x in (ids, shown.semantics[0, 0])) and bool((depth[below] < 12.01).all())
    assert not torch.allclose(shown.color[0][:, below], torch.tensor([0.5, 0.7, 1.0]).view(3, 1, 1), atol=0.1)
    if above == "far":
        assert bool((depth[top] == FAR_M).all()) and torch.equal(shown.color[0][:, top], empty(view).color[:, top])
    else:
        assert bool((depth[top] < 12.01).all()) and bool((ids[top] == 2).all())


@pytest.mark.parametrize("rendered", [True, False])
def test_ground_that_no_image_shows_is_level(rendered):
    """Road points from 8 m on, 1.6 m below the camera, rows as dense as pixels; nearer road is neither measured nor
    rendered: it goes on at the same height, its truth. Of another class it keeps the depth of the nearest pixel."""
    x, y = np.meshgrid(np.arange(8, 14, 0.04), np.arange(-10, 10, 0.04))
    xyz = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.6)], 1).astype(np.float32)
    view = view_at()
    falls = ((torch.arange(32) + 0.5 - 16) / 40)[:, None].expand(32, 48)
    empty = lambda view: flat_render(view, 1000.0, 0.0, label=palette.ID["sky"])
    for name in ("road", "building"):
        ids = np.full(x.size, palette.ID[name], np.uint8)
        cloud = FusedCloud(PointCloud(xyz, np.zeros((x.size, 3), np.uint8), "world", semantics=ids), {})
        made = build_conditions(DriveInputs(cloud, [], [], empty if rendered else None), [view], RULES)[0]
        hole = ~made.valid[0, 0] & (falls > 0.25)
        assert int(hole.sum()) > 100
        depth = made.depth[0, 0][hole]
        if name == "road":
            assert float((depth * falls[hole] / 1.6 - 1).abs().max()) < 0.07  # half a row
        else:
            assert float(depth.min()) > 7.5


def test_images_are_warped_by_rendered_depth():
    """No point at all: only the render knows that the wall stands at 12 m, here and where the image was recorded."""
    target, recorded = view_at(y=1.5), [Photo(view_at(), image_of_wall(view_at(), 12.0))]
    truth = conditions.image_tensor(image_of_wall(target, 12.0))
    render_at = lambda view: flat_render(view, 12.0)
    made = build_conditions(DriveInputs(NOTHING, [], recorded, render_at), [target], RULES)[0]
    found = made.warped[0, 0]
    assert float(found.float().mean()) > 0.8
    assert float((made.color[0] - truth).abs()[:, found].max()) < 0.01
    without = build_conditions(DriveInputs(NOTHING, [], recorded), [target], RULES)[0]
    both = found & without.warped[0, 0]
    assert float((without.color[0] - truth).abs()[:, both].mean()) > 0.1


def test_renders_reach_every_view_in_order_and_are_made_once_per_view_and_image():
    big = Camera("front", 96, 64, 80.0, 80.0, 48.0, 32.0)
    views = [view_at(y=0.2 * n, time_s=0.1 * n, camera=big) for n in range(3)]
    recorded = [Photo(view_at(camera=big), image_of_wall(view_at(camera=big), 12.0))]
    asked = []

    def render_at(view):
        asked.append(view)
        number = round(view.time_s / 0.1)
        return flat_render(view, 20.0 + number, 1.0, (0.1 * number, 0.5, 0.0), number)

    rules = replace(RULES, fine_width=96, fine_height=64)
    small, fine = build_conditions(DriveInputs(NOTHING, [], recorded, render_at=render_at), views, rules)
    assert len(asked) == len(views) + len(recorded)
    assert {(v.camera.width, v.camera.height) for v in asked} == {(96, 64)}
    for made, size in ((small, (32, 48)), (fine, (64, 96))):
        assert made.renders.color.shape == (3, 3, *size)
        for number in range(3):
            assert torch.allclose(made.depth[number], torch.tensor(20.0 + number))
            assert torch.allclose(made.renders.depth[number], torch.tensor(20.0 + number))
            assert torch.allclose(made.renders.color[number, 0], torch.tensor(0.1 * number), atol=1e-6)
            assert bool((made.renders.semantics[number] == number).all())


def test_renders_at_the_small_size_are_means_and_picks():
    big = Camera("front", 96, 64, 80.0, 80.0, 48.0, 32.0)
    chequered = (torch.arange(64).view(-1, 1) + torch.arange(96)) % 2

    def render_at(view):
        plain = flat_render(view)
        depth, ids = (torch.where(chequered > 0, *pair)[None] for pair in ((10.0, 30.0), (3, 7)))
        shown = {name: getattr(plain, name) * chequered for name in ("color", "alpha", "certainty")}
        return RenderPlanes(depth=depth, semantics=ids.to(torch.uint8), **shown)

    rules = replace(RULES, fine_width=96, fine_height=64)
    shown = build_conditions(DriveInputs(NOTHING, [], [], render_at), [view_at(camera=big)], rules)[0].renders
    assert torch.allclose(shown.alpha, torch.tensor(0.5)) and torch.allclose(shown.certainty, torch.tensor(0.25))
    assert torch.allclose(shown.color[:, 0], torch.tensor(0.4))
    assert set(shown.depth.unique().tolist()) <= {10.0, 30.0}  # never a mean of two surfaces
    assert set(shown.semantics.unique().tolist()) <= {3, 7}


# training clips -----------------------------------------------------------------------------------


def same_planes(read, planes, frames):
    assert torch.allclose(read.color, planes.color[frames], atol=0.5 / 255 + 1e-6)
    for name in ("alpha", "certainty"):
        assert torch.allclose(getattr(read, name), getattr(planes, name)[frames], atol=0.5 / 255 + 1e-6), name
    assert torch.allclose(read.depth, planes.depth[frames], rtol=1e-3)
    assert torch.equal(read.semantics, planes.semantics[frames])


def test_shards_give_back_renders_and_patches(tmp_path):
    first, second = (with_patch(made_up_clip(n), row=4 + n, column=7 + 2 * n, scale=2) for n in (0, 1))
    bare = replace(second, condition=replace(second.condition, renders=None))
    clips.write_shard(tmp_path, 0, [first, bare])
    frames = [1, 3]
    read, other = (clips.ShardFolder(tmp_path).clip(0, n, frames) for n in (0, 1))
    same_planes(read.condition.renders, first.condition.renders, frames)
    assert other.condition.renders is None
    for found, clip in ((read, first), (other, second)):
        assert all(getattr(found.fine, name) == getattr(clip.fine, name) for name in ("row", "column", "scale"))
        same_planes(found.fine.clip.condition.renders, clip.fine.clip.condition.renders, frames)
        assert torch.allclose(found.fine.clip.rgb, clip.fine.clip.rgb[frames], atol=0.5 / 255 + 1e-6)
        assert torch.equal(found.fine.clip.semantics, clip.fine.clip.semantics[frames])
        assert torch.equal(found.fine.clip.condition.valid, clip.fine.clip.condition.valid[frames])
        assert found.fine.clip.condition.views[0].camera.width == 24
        assert found.fine.clip.fine is None
    clips.write_shard(tmp_path, 1, [replace(bare, fine=None)])
    plain = clips.ShardFolder(tmp_path).clip(1, 0, frames)
    assert plain.fine is None and plain.condition.renders is None


def test_clip_and_patch_are_varied_in_the_same_way():
    """A patch that shows its part of the clip still does so after mirroring, colour curve and mistakes of classes."""
    unknown = torch.full_like(made_up_clip(0).condition.valid, 3, dtype=torch.uint8)
    plain = made_up_clip(0)
    given = replace(plain.condition, semantics=unknown, backdrop_semantics=unknown + 10)
    clip = with_patch(replace(plain, condition=given, shift_m=2.0), row=6, column=10)
    seen = set()
    for seed in range(60):
        made = clips.vary(clip, np.random.default_rng(seed))
        fine, part = made.fine, made.fine.clip
        mirrored, rendered = made.shift_m < 0, made.condition.renders is not None
        assert fine.column == (48 - 10 - 12 if mirrored else 10) and fine.row == 6
        assert (part.condition.renders is not None) == rendered
        images, given = ("rgb", "depth", "semantics"), ("color", "depth", "valid", "warped", "backdrop")
        exact, mistaken = [(part, made, images), (part.condition, made.condition, given)], []
        if rendered:
            exact.append((part.condition.renders, made.condition.renders, ("color", "depth", "alpha", "certainty")))
            mistaken.append((part.condition.renders, made.condition.renders, ("semantics",)))
        mistaken.append((part.condition, made.condition, ("semantics", "backdrop_semantics")))
        for of_patch, of_clip, names in exact:
            for name in names:
                wanted = part_of(getattr(of_clip, name), fine.row, fine.column)
                assert torch.equal(getattr(of_patch, name), wanted), name
        for of_patch, of_clip, names in mistaken:  # the holes lie elsewhere, the mistakes are the same
            for name in names:
                found, wanted = getattr(of_patch, name), part_of(getattr(of_clip, name), fine.row, fine.column)
                both = (found != 255) & (wanted != 255)
                assert torch.equal(found[both], wanted[both]), name
        seen.add((mirrored, rendered))
    assert seen == {(False, False), (False, True), (True, False), (True, True)}


def test_clips_of_a_fitted_city_show_its_full_size_in_their_patches():
    if native.library() is None:
        pytest.skip("the native library is not built")
    rules = CityClipRules(width=48, height=32, window=1, clips=2, fitted=True)
    scales = {city: city_clips.fine_of(rules, city) for city in range(40)}
    assert set(scales.values()) == {2, 3, 4}
    assert city_clips.fine_of(rules, city_clips.HELD_OUT) == rules.fine
    city = next(number for number, scale in scales.items() if scale == 3)
    log = city_clips.make_log(rules, city, rules.frames)
    front = next(view for view in log.world.frame_views("front"))
    assert (front.camera.width, front.camera.height) == (144, 96)
    made = city_clips.make_clips(rules, city, log, flat_render)
    for number, clip in enumerate(made):
        fine = clip.fine
        assert (fine.scale, *fine.clip.rgb.shape[-2:]) == (3, 60, 60)
        recorded = log.world.frame_views("front")[city_clips.start_of(rules, city, number)]
        view = city_clips.shifted_view(log.world, recorded, clip.shift_m)
        truth = torch.from_numpy(log.truth(view).rgb).permute(2, 0, 1).float()
        rows, columns = (slice(3 * start, 3 * start + 60) for start in (fine.row, fine.column))
        assert torch.equal(fine.clip.rgb[0], truth[:, rows, columns])
        assert fine.clip.condition.views[0].camera.width == 60
        assert fine.clip.condition.renders.color.shape == (1, 3, 60, 60)
        assert clip.condition.renders.color.shape == (1, 3, 32, 48)


def test_images_of_held_out_moments_are_not_given():
    if native.library() is None:
        pytest.skip("the native library is not built")
    rules = CityClipRules(width=48, height=32, window=1, clips=1, fitted=True)
    log = city_clips.make_log(rules, city_clips.HELD_OUT, 5)
    times = sorted({photo.view.time_s for photo in log.recorded})
    given = {photo.view.time_s for photo in city_clips.given_images(rules, city_clips.HELD_OUT, log)}
    assert set(times) - given == {times[4]}
    assert city_clips.given_images(replace(rules, fitted=False), city_clips.HELD_OUT, log) == log.recorded


# the model ----------------------------------------------------------------------------------------


def shut(model, value=-40.0):
    """Close the gates through which a render is copied."""
    area = model.net.patch**2
    with torch.no_grad():
        model.net.leave.bias[-mdm.RENDER_GATES * area :] = value
        model.refiner.leave.bias[-sum(model.refiner.RENDER_SIZES) :] = value
    return model


@pytest.mark.parametrize("patch", [1, 2])
def test_an_extended_model_is_the_earlier_one_but_for_the_gates_of_renders(patch):
    before = randomised(replace(TINY, patch=patch))
    after = extended(before, replace(FINISHING, patch=patch)).eval()
    plain, request = some_condition(), SampleRequest(2, seed=3)
    old, new = before.sample(plain, request), after.sample(plain, request)
    # without renders its gates take sigmoid(-8) of the denoiser's and sigmoid(-4) of the refiner's colour from the
    # condition's own
    assert float((old.rgb - new.rgb).abs().max()) < 0.05
    shut(after)
    for condition in (plain, with_renders(plain), with_renders(plain, 6)):
        new = after.sample(condition, request)
        assert torch.allclose(old.rgb, new.rgb, atol=1e-5)
        assert torch.allclose(old.depth, new.depth, rtol=1e-4)
        assert torch.equal(old.semantics, new.semantics)
        assert torch.allclose(old.confidence, new.confidence, atol=1e-5)


def test_open_gates_hand_the_render_through():
    model, condition = mdm.MDM(FINISHING).eval(), with_renders(some_condition())
    condition = replace(condition, renders=replace(condition.renders, alpha=torch.ones_like(condition.renders.alpha)))
    with torch.no_grad():
        parts = model.refiner.leave.bias.split(model.refiner.sizes)
        for number in (1, 2, 4, 6, 7):
            parts[number].fill_(-40.0)
        for number in (9, 10, 11):
            parts[number].fill_(40.0)
        encoded = model.encode_condition(condition)
        latents = {m: torch.zeros(3, c, 8, 12) for m, c in model.codec.channels.items()}
        made = model.refine(latents, encoded.pixels, 3)
    assert torch.allclose(made.rgb, condition.renders.color * 2 - 1, atol=1e-5)
    assert torch.allclose(made.depth_code, model.codec.linear_depth_code(condition.renders.depth), atol=1e-5)
    known = condition.renders.semantics[:, 0] != 255
    assert torch.equal(made.scores.argmax(1)[known], condition.renders.semantics[:, 0][known].long())


def test_no_render_is_told_from_an_empty_one():
    model = randomised(FINISHING)
    plain = some_condition()
    nothing = torch.zeros_like(plain.depth)
    unknown = torch.full_like(plain.valid, 255, dtype=torch.uint8)
    empty = RenderPlanes(plain.color, plain.depth, nothing, nothing, unknown)
    missing, blank = model.encode_condition(plain), model.encode_condition(replace(plain, renders=empty))
    assert bool((missing.pixels.alpha == network.NO_RENDER).all()) and bool((blank.pixels.alpha == 0).all())
    differ = (missing.planes != blank.planes).flatten(3).any(3).any(1)[0]
    assert int(differ.sum()) == 1  # the plane of coverage alone
    both = model.encode_condition([plain, with_renders(plain)])
    assert torch.equal(both.planes[:1], missing.planes)


def test_a_model_without_renders_ignores_them_and_one_with_them_does_not_give_them_up():
    model, plain = randomised(TINY), some_condition()
    first, second = (model.sample(c, SampleRequest(1)) for c in (plain, with_renders(plain)))
    assert torch.equal(first.rgb, second.rgb) and torch.equal(first.depth, second.depth)
    with pytest.raises(UsageError, match="another kind"):
        extended(randomised(FINISHING), TINY)
