"""The last stage of the small models: tiles, what it starts as, what it copies, what it learns from."""

from dataclasses import fields, replace

import pytest
import torch
from hypothesis import given as drawn
from hypothesis import strategies
from tiny_networks import FINISHING, TINY, randomise, randomised
from torch.nn import functional
from toy_clips import made_up_clip, some_condition, some_pixels, with_patch

from mudg.base.errors import UsageError
from mudg.diffusion import model as mdm
from mudg.diffusion import network, requests
from mudg.diffusion.model import BatchPart
from mudg.diffusion.models import draw_weights
from mudg.diffusion.network import Finisher, Made, Refined, finish_in_tiles
from mudg.diffusion.requests import SampleRequest


def some_made(height, width):
    pixels = some_pixels(height, width, seed=1)
    return Made(pixels.color, pixels.depth_code, pixels.ids, pixels.render_code - 3)


def random_finisher(blocks=(1, 1)):
    """One whose every weight matters."""
    made = Finisher((8, 16), blocks)
    randomise(made.parameters(), seed=2, gain=1.5, bias=0.3)
    return made.eval()


# tiles --------------------------------------------------------------------------------------------


@drawn(strategies.integers(1, 3000), strategies.integers(1, 700))
def test_spans_cover_the_length_without_overlap(length, longest):
    found = network.spans(length, longest)
    assert [first for first, _ in found] == [0, *(last for _, last in found[:-1])]
    assert found[-1][1] == length
    assert all(first < last and first % network.STRIDE_PX == 0 for first, last in found)
    assert max(last - first for first, last in found) <= max(longest, network.STRIDE_PX) + network.STRIDE_PX


@pytest.mark.parametrize(
    ("blocks", "size", "tile_px"), [((1, 1), (93, 131), 40), ((2, 2), (64, 117), 17), ((1, 3), (141, 50), 64)]
)
@torch.no_grad()
def test_tiles_equal_the_whole_image(blocks, size, tile_px):
    finisher, given, made = random_finisher(blocks), some_pixels(*size), some_made(24, 32)
    whole = finish_in_tiles(finisher, made, given.color.shape[-2:], given.crop, 1000)
    tiled = finish_in_tiles(finisher, made, given.color.shape[-2:], given.crop, tile_px)
    assert whole.rgb.shape == (2, 3, *size)
    for name in ("rgb", "depth_code", "log_error"):
        assert torch.allclose(getattr(tiled, name), getattr(whole, name), atol=2e-5), name
    assert torch.equal(tiled.ids, whole.ids)


@torch.no_grad()
def test_the_whole_image_is_one_pass_and_memory_that_of_a_tile(monkeypatch):
    finisher, given, made = random_finisher(), some_pixels(32, 48), some_made(16, 24)
    enlarged = made.enlarged((32, 48), (0, 32), (0, 48))
    once = finisher(enlarged, given, 2, torch.full((2,), 2.0))
    whole = finish_in_tiles(finisher, made, given.color.shape[-2:], given.crop)
    assert torch.allclose(whole.rgb, once.rgb, atol=1e-6)
    assert torch.equal(whole.ids[:, 0], once.shares().argmax(1).to(torch.uint8))
    forward, seen = finisher.forward, []
    noted = lambda made, given, *rest: (seen.append(given.color.shape), forward(made, given, *rest))[1]
    monkeypatch.setattr(finisher, "forward", noted)
    finish_in_tiles(finisher, some_made(24, 32), (150, 202), some_pixels(150, 202).crop, 40)
    longest = 40 + 2 * finisher.margin_px + 2 * network.STRIDE_PX
    assert len(seen) == 4 * 6
    assert all(max(shape[-2:]) <= longest for shape in seen)
    # with a smaller margin, seams would show: what the test above compares does depend on it
    given, made = some_pixels(93, 131), some_made(24, 32)
    whole = finish_in_tiles(finisher, made, given.color.shape[-2:], given.crop, 1000)
    monkeypatch.setattr(Finisher, "margin_px", 4)
    tiled = finish_in_tiles(finisher, made, given.color.shape[-2:], given.crop, 40)
    assert float((tiled.rgb - whole.rgb).abs().max()) > 1e-3


def test_enlarging_is_what_interpolation_does():
    made = some_made(12, 16)
    whole = made.enlarged((36, 48), (0, 36), (0, 48))
    smooth = lambda x: functional.interpolate(x, size=(36, 48), mode="bilinear", align_corners=False)
    sharp = lambda x: functional.interpolate(x.float(), size=(36, 48), mode="nearest-exact")
    assert torch.allclose(whole.rgb, smooth(made.rgb), atol=1e-5)
    assert torch.allclose(whole.log_error, smooth(made.log_error), atol=1e-5)
    assert torch.equal(whole.depth_code, sharp(made.depth_code))
    assert torch.equal(whole.ids.float(), sharp(made.ids))
    part = made.enlarged((36, 48), (6, 30), (15, 39))
    for f in fields(Made):
        assert torch.equal(getattr(part, f.name), getattr(whole.crop(slice(6, 30), slice(15, 39)), f.name)), f.name


# what it makes ------------------------------------------------------------------------------------


@torch.no_grad()
def test_it_starts_as_fixed_shares_of_its_sources_and_an_unknown_class_takes_none():
    """Logits 2, 0, -2, 0: three quarters of the generated clip, a tenth of what was warped and of the render."""
    finisher, given, made = Finisher((8, 16), (1, 1)), some_pixels(32, 48), some_made(32, 48)
    draw_weights(finisher, 5, "finisher")
    finisher.reset()
    done = finisher(made, given, 2, torch.ones(2))
    clip, warped, far, render = torch.tensor([2.0, 0, -2, 0]).softmax(0).tolist()
    assert clip > 0.75
    expected = clip * made.rgb + warped * given.color + far * given.backdrop + render * given.render
    assert torch.allclose(done.rgb, expected, atol=1e-5)
    clip, measured, render = torch.tensor([2.0, 0, -2]).softmax(0).tolist()
    depth = clip * made.depth_code + measured * given.depth_code + render * given.render_code
    assert torch.allclose(done.depth_code, depth, atol=1e-5)
    assert torch.equal(done.shares().argmax(1, keepdim=True), made.ids.long())
    assert torch.allclose(done.log_error, made.log_error)
    finisher, given, made = Finisher((8, 16), (1, 1)), some_pixels(16, 16), some_made(16, 16)
    unknown = torch.full_like(given.ids, 255)
    done = finisher(made, replace(given, ids=unknown, backdrop_ids=unknown, render_ids=unknown), 2, torch.ones(2))
    share = float(torch.tensor([2.0, 0, -2, 0]).softmax(0)[0])
    assert torch.allclose(done.shares().sum(1), torch.full((2, 16, 16), share), atol=1e-5)
    assert bool(torch.isfinite(network.class_scores(done)).all())


@torch.no_grad()
@pytest.mark.parametrize("source", range(4))
def test_it_can_copy_each_source(source):
    finisher, given, made = Finisher((8, 16), (1, 1)), some_pixels(32, 48), some_made(32, 48)
    of_color, of_depth, of_class = finisher.leave.bias.split(Finisher.SIZES)[:3]
    of_color[4 * source : 4 * source + 4] = 30.0
    of_class[4 * source : 4 * source + 4] = 30.0
    depth_source = {0: 0, 1: 1, 3: 2}.get(source)
    if depth_source is not None:
        of_depth[4 * depth_source : 4 * depth_source + 4] = 30.0
    done = finisher(made, given, 2, torch.ones(2))
    colors = (made.rgb, given.color, given.backdrop, given.render)
    classes = (made.ids, given.ids, given.backdrop_ids, given.render_ids)
    assert torch.allclose(done.rgb, colors[source], atol=1e-5)
    assert torch.equal(done.shares().argmax(1, keepdim=True), classes[source].long())
    if depth_source is not None:
        depths = (made.depth_code, given.depth_code, given.render_code)
        assert torch.allclose(done.depth_code, depths[depth_source], atol=1e-5)


# clips --------------------------------------------------------------------------------------------


def test_clips_are_finished_at_any_size():
    model = randomised(FINISHING)
    small, fine = some_condition(), some_condition(height=45, width=67, seed=4)
    clip = model.sample(small, SampleRequest(1))
    done, again = model.finish(clip, fine), model.finish(clip, fine)
    assert done.rgb.shape == (3, 3, 45, 67) and done.depth.shape == done.confidence.shape == (3, 1, 45, 67)
    assert done.semantics.shape == (3, 45, 67) and int(done.semantics.max()) < 19
    assert float(done.rgb.min()) >= 0 and float(done.rgb.max()) <= 1
    assert float(done.confidence.min()) >= 0 and float(done.confidence.max()) <= 1
    assert torch.equal(done.depth[fine.valid], fine.depth[fine.valid].clamp(max=100.0))
    assert done.latents is clip.latents
    assert torch.equal(done.rgb, again.rgb)
    with pytest.raises(UsageError, match="no finisher"):
        randomised(TINY).finish(clip, fine)
    bare = {"refine_widths": (), "refine_blocks": ()}
    for change in ({"renders": False}, bare, {"finish_blocks": ()}, {"finish_widths": (8,)}):
        with pytest.raises(UsageError):
            replace(FINISHING, **change)


def test_the_finisher_starts_from_the_stated_error_not_from_the_confidence():
    """Disagreement with measured depth lowers the confidence once, at the new size, and not a second time through the
    error."""
    model = mdm.MDM(FINISHING).eval()
    clip = model.sample(some_condition(), SampleRequest(1))
    doubted = replace(clip, confidence=clip.confidence * 0.1)
    fine = replace(some_condition(height=32, width=48, seed=4), valid=torch.zeros(3, 1, 32, 48) > 0)
    done = model.finish(doubted, fine)
    stated = functional.interpolate(clip.log_error, size=(32, 48), mode="bilinear", align_corners=False)
    assert torch.allclose(done.confidence, torch.exp(-stated.exp() / 2 / mdm.TRUSTED_ERROR), atol=1e-4)
    assert torch.equal(requests.depth_agreement(done.depth, fine), torch.ones_like(done.depth))


# training -----------------------------------------------------------------------------------------


def gradients(model, clips):
    model.zero_grad(set_to_none=True)
    loss = model.loss(clips, BatchPart(0, 0, 0, len(clips)))
    loss.total.backward()
    return loss, {name: None if p.grad is None else p.grad.clone() for name, p in model.named_parameters()}


def test_patches_teach_the_finisher_alone_also_several_scales_together():
    model, plain = randomised(FINISHING), [made_up_clip(0), made_up_clip(1)]
    without, before = gradients(model, plain)
    with_them, after = gradients(model, [with_patch(clip) for clip in plain])
    added = {name for name in with_them.terms if name not in without.terms}
    assert added == {"fine_rgb", "fine_depth", "fine_semantics", "fine_error"}
    for name, gradient in after.items():
        if name.startswith("finisher."):
            assert before[name] is None
            assert gradient is not None and float(gradient.abs().sum()) > 0, name
        elif gradient is not None:
            assert torch.equal(gradient, before[name]), name
    assert all(bool(torch.isfinite(torch.tensor(value))) for value in with_them.terms.values())
    model = randomised(FINISHING)
    several = with_patch(made_up_clip(2), 4, 20, side=8, scale=3)
    loss, found = gradients(model, [with_patch(made_up_clip(0), side=12, scale=2), made_up_clip(1), several])
    assert "fine_rgb" in loss.terms
    assert all(found[name] is not None for name in found if name.startswith("finisher."))


PLACES = [(6, 10, 12), (0, 0, 48), (80, 144, 48), (40, 72, 32), (33, 91, 24), (104, 0, 24), (0, 156, 36)]
"""Row, column and side of patches of an image of 192x128: within it, odd ones, and at each of its borders."""


@pytest.mark.parametrize(("row", "column", "side"), PLACES)
def test_a_patch_is_finished_from_its_own_part_of_its_own_clip(monkeypatch, row, column, side):
    """Condition and latents of the clips are ramps of places; what the finisher is given are the places of the
    patch."""
    model, seen = randomised(FINISHING), []
    clips = [made_up_clip(0, 192, 128), with_patch(made_up_clip(1, 192, 128), row, column, side, scale=2)]
    frames, (height, width) = 4, (128, 192)
    ramp = torch.stack(torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij"))
    numbered = [torch.cat([ramp, torch.full((1, height, width), float(n))]) for n in range(2)]
    of_clips = torch.stack(numbered).repeat_interleave(frames, 0)

    def refined(latents, pixels, frames):
        # latents and condition are of one place
        assert torch.equal(latents["rgb"][:, :3], functional.avg_pool2d(pixels.color, 2))
        one = pixels.color[:, :1]
        return Refined(pixels.color, one, functional.one_hot(one[:, 0].long() * 0, 19).permute(0, 3, 1, 2), one)

    def finished(made, given, frames, scale):
        seen.append((made, scale))
        whole = torch.ones_like(made.log_error)
        return network.Finished(made.rgb, made.depth_code, made.ids[:, None], whole, made.log_error)

    encoded = model.encode_condition([clip.condition for clip in clips])
    encoded = replace(encoded, pixels=replace(encoded.pixels, color=of_clips))
    stated = {m: torch.zeros(2, frames, c, height // 2, width // 2) for m, c in model.codec.channels.items()}
    stated["rgb"][:, :, :3] = functional.avg_pool2d(of_clips, 2).unflatten(0, (2, frames))
    monkeypatch.setattr(model, "refine", refined)
    monkeypatch.setattr(model.finisher, "forward", finished)
    model._finisher_terms(stated, encoded, clips, BatchPart(0, 0, 0, len(clips)))
    made, scale = seen[0]
    assert scale.tolist() == [2.0] * frames
    assert made.rgb.shape == (frames, 3, 2 * side, 2 * side)
    for axis, (start, length) in enumerate([(row, height), (column, width)]):
        expected = (start + (torch.arange(2 * side) + 0.5) / 2).clamp(0.5, length - 0.5)
        along = made.rgb[:, axis, :, 0] if axis == 0 else made.rgb[:, axis, 0]
        assert torch.allclose(along, expected.expand(frames, -1), atol=1e-3)
    assert bool((made.rgb[:, 2] == 1).all())
