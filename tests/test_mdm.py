"""The diffusion model, its codec and its refiner: shapes, invariances, what is copied and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused
from tiny_networks import FINISHING, PLAIN, TINY, learn_part, randomised
from toy_clips import some_condition, some_pixels

from mudg.base.errors import UsageError
from mudg.base.types import Clip
from mudg.diffusion import model_files, models, network, requests
from mudg.diffusion.model import MDM, BatchPart
from mudg.diffusion.network import Refiner
from mudg.diffusion.requests import SampleRequest
from mudg.networks.codec import CodecConfig, PatchCodec, code_to_depth, depth_to_code, semantic_shares


def some_latents(codec, count, height=8, width=12):
    """Noise in place of the latents of some images."""
    generator = torch.Generator().manual_seed(1)
    return {m: torch.randn(count, c, height, width, generator=generator) for m, c in codec.channels.items()}


def test_sample_shapes_ranges_and_determinism():
    model, condition, passes = randomised(TINY), some_condition(), []
    forward = model.net.forward
    model.net.forward = lambda *given: (passes.append(1), forward(*given))[1]
    first = model.sample(condition, SampleRequest(3, seed=7, index=2))
    assert len(passes) == 3
    again = model.sample(condition, SampleRequest(3, seed=7, index=2))
    other = model.sample(condition, SampleRequest(3, seed=7, index=3))
    assert first.semantics.shape == (3, 16, 24)
    for name, channels, least, most in (("rgb", 3, 0, 1), ("depth", 1, 1e-9, 100), ("confidence", 1, 0, 1)):
        made = getattr(first, name)
        assert made.shape == (3, channels, 16, 24) and least <= float(made.min()) <= float(made.max()) <= most, name
    for name in ("rgb", "depth", "semantics", "confidence"):
        assert torch.equal(getattr(first, name), getattr(again, name)), name
    assert not torch.equal(first.rgb, other.rgb)


def test_a_model_with_a_new_refiner_has_the_same_denoiser_and_codec():
    small = randomised(PLAIN)
    big = models.extended(small, TINY)
    state = big.state_dict()
    assert all(torch.equal(value, state[name]) for name, value in small.state_dict().items())
    assert any(name.startswith("refiner.") for name in state)
    refined = randomised(TINY)
    again = models.extended(refined, replace(TINY, area_px=100)).state_dict()
    assert all(torch.equal(value, again[name]) for name, value in refined.state_dict().items())
    refused("another kind", models.extended, small, replace(TINY, widths=(16, 32)), raises=UsageError)


def test_given_classes_are_copied_where_they_are_known():
    """An untrained denoiser and refiner already say what the condition says, and nothing where it says nothing."""
    model, condition = MDM(TINY).eval(), some_condition()
    blocks = condition.semantics[..., ::4, ::4].repeat_interleave(4, -2).repeat_interleave(4, -1)
    sample = model.sample(replace(condition, semantics=blocks), SampleRequest(1))
    known = (blocks != 255)[:, 0]
    assert float((sample.semantics == blocks[:, 0])[known].float().mean()) > 0.95
    without = model.sample(replace(condition, semantics=None, backdrop_semantics=None), SampleRequest(1))
    assert float((without.semantics == blocks[:, 0])[known].float().mean()) < 0.2


def test_known_frames_are_kept():
    model, condition = randomised(TINY), some_condition(frames=4)
    earlier = model.sample(some_condition(frames=4, seed=9), SampleRequest(2, seed=1))
    known = {m: z[-2:] for m, z in earlier.latents.items()}
    sample = model.sample(condition, SampleRequest(2, seed=1, known=known))
    for name, z in sample.latents.items():
        assert torch.allclose(z[:2], known[name], atol=1e-5), name
        assert not torch.allclose(z[2:], earlier.latents[name][2:], atol=1e-3), name


def test_frames_and_clips_do_not_leak_across_the_batch():
    model = randomised(TINY)
    encoded = [model.encode_condition(some_condition(seed=s)) for s in (0, 1)]
    both = model.encode_condition([some_condition(seed=0), some_condition(seed=1)])
    x = {m: z.unflatten(0, (2, 3)) for m, z in some_latents(model.codec, 6).items()}
    together, _ = model.predict(x, both, torch.tensor([100, 700]))
    with torch.no_grad():
        for i, t in enumerate((100, 700)):
            alone, _ = model.predict({m: z[i : i + 1] for m, z in x.items()}, encoded[i], torch.tensor([t]))
            for name in alone:
                assert torch.allclose(alone[name][0], together[name][i], atol=2e-4), name


def test_training_and_inference_attention_agree():
    q, k, v = torch.randn(3, 2, 4, 10, 8, generator=torch.Generator().manual_seed(0)).unbind(0)
    trained = network.attend(q, k, v)
    with torch.no_grad():
        fused = network.attend(q, k, v)
    assert torch.allclose(trained, fused, atol=1e-5)


def clip_to_learn():
    """One that is not its own condition."""
    condition, generator = some_condition(), torch.Generator().manual_seed(0)
    ids = torch.randint(0, 19, (3, 16, 24), generator=generator)
    known = torch.ones_like(condition.valid)
    return Clip(condition, condition.color.flip(-1), condition.depth * 0.5 + 2, known, ids)


def test_loss_falls_when_a_clip_is_learnt():
    torch.manual_seed(0)
    model, clip = MDM(TINY), clip_to_learn()
    optimizer = torch.optim.Adam(learn_part(model), lr=3e-3)
    totals = []
    for step in range(28):
        # the same draws at every fourth step: a falling loss cannot come from an easier draw
        losses = model.loss([clip], BatchPart(0, step % 4, 0, 1))
        optimizer.zero_grad()
        losses.total.backward()
        optimizer.step()
        totals.append(float(losses.total.detach()))
    assert np.mean(totals[-4:]) < 0.8 * np.mean(totals[:4])


def test_loss_has_gradients_everywhere():
    model = randomised(TINY)
    losses = model.loss([clip_to_learn()], BatchPart(0, 0, 0, 1))
    losses.total.backward()
    assert all(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in learn_part(model))
    refined = {f"pixel_{m}" for m in ("rgb", "depth", "semantics", "error")}
    assert set(losses.terms) == {"rgb", "depth", "semantics"} | refined


def test_measured_depth_is_taken_and_what_contradicts_it_costs_confidence():
    condition = some_condition(frames=1)
    depth = torch.full((1, 1, 16, 24), 120.0)
    settled = requests.settle_depth(depth, condition, 100.0)
    assert torch.equal(settled[condition.valid], condition.depth[condition.valid])
    assert bool((settled[~condition.valid] == 100.0).all())
    same = requests.depth_agreement(condition.depth, condition)
    assert torch.allclose(same, torch.ones_like(same))
    valid = torch.zeros_like(condition.valid)
    valid[..., 8, 12] = True
    alone = replace(condition, valid=valid)
    off = requests.depth_agreement(condition.depth * 1.5, alone)
    assert float(off[0, 0, 8, 12]) == pytest.approx(max(0.2, 1.5**-5), rel=1e-4)
    assert float(off[0, 0, 6, 10]) == pytest.approx(float(off[0, 0, 8, 12]))
    assert float(off[0, 0, 0, 0]) == 1.0


@pytest.mark.parametrize("name", sorted(model_files.EMBEDDED))
def test_the_shipped_models_load(name):
    model = model_files.load(name)
    assert model.config.window == 8
    parts = list(model_files.EMBEDDED[name].glob("*.safetensors"))
    assert all(f.stat().st_size < 16 * 1024 * 1024 for f in parts)
    assert sum(f.stat().st_size for f in parts) < (8 if "tiny" in name else 40) * 1024 * 1024
    assert model_files.facts(name)["held_out"]["clips"] >= 12
    assert model.config.renders == (name == "embedded") and (model.finisher is not None) == model.config.renders


def test_confidence_falls_with_change_and_distance():
    seen = torch.zeros(1, 1, 8, 16)
    seen[..., :8] = 1
    still = requests.confidence_of(seen, torch.zeros_like(seen), 2)
    assert float(still[0, 0, 0, 0]) == pytest.approx(1.0)
    assert float(still[0, 0, 0, -1]) == pytest.approx(0.35)
    moving = requests.confidence_of(seen, torch.full_like(seen, 0.5), 2)
    assert bool((moving < still).all())


@pytest.mark.parametrize("config", [TINY, FINISHING])
def test_save_and_load_are_inverse(tmp_path, config):
    model = randomised(config)
    model_files.save(model, tmp_path / "m", "a card", {"note": 1})
    loaded = model_files.load(tmp_path / "m")
    assert loaded.config == model.config
    for name, value in model.state_dict().items():
        assert torch.allclose(loaded.state_dict()[name], value, rtol=1e-3, atol=1e-4), name
    assert (tmp_path / "m" / "MODEL_CARD.md").read_text() == "a card"


def test_wrong_requests_are_refused():
    model = MDM(TINY)
    refused("multiples of 4", model.sample, some_condition(height=18), SampleRequest(1), raises=UsageError)
    refused("guidance", model.sample, some_condition(), SampleRequest(1, guidance=2.0), raises=UsageError)
    model, condition = randomised(TINY), some_condition()
    plain, half = (model.sample(condition, SampleRequest(3, eta=eta)).rgb for eta in (None, 0.5))
    assert torch.equal(plain, model.sample(condition, SampleRequest(3, eta=1.0)).rgb)
    assert not torch.equal(plain, half)
    refused(".", CodecConfig, near_m=5.0, far_m=5.0, raises=UsageError)
    for change in ({"blocks": (1,)}, {"widths": (16, 20)}):
        refused(".", replace, TINY, raises=UsageError, **change)


def test_image_size_keeps_aspect_and_area():
    area = 128 * 192
    assert requests.sized_to_area(area, 480 / 320, 16) == (192, 128)
    assert requests.sized_to_area(area, 1920 / 1280, 16) == (192, 128)
    width, height = requests.sized_to_area(area, 1242 / 375, 16)
    assert width % 16 == height % 16 == 0
    assert abs(width / height / (1242 / 375) - 1) < 0.1
    assert abs(width * height / area - 1) < 0.3
    assert requests.sized_to_width(100, 480 / 320, 16) == (96, 64)
    assert MDM(TINY).image_size(480, 320) == (192, 128)


# ---- the latent codec ----------------------------------------------------------------------------


@pytest.mark.parametrize(("depth_m", "code"), [(2.0, -1.0), (math.sqrt(2.0 * 100.0), 0.0), (100.0, 1.0), (1e9, 1.0)])
def test_depth_code_and_its_inverse(depth_m, code):
    assert float(depth_to_code(torch.tensor(depth_m), CodecConfig())) == pytest.approx(code, abs=1e-6)
    depth = torch.tensor([2.0, 3.0, 10.0, 55.5, 100.0])
    assert torch.allclose(code_to_depth(depth_to_code(depth, CodecConfig()), CodecConfig()), depth, rtol=1e-5)


def decoded(codec, **given):
    """Pixels of some modalities' latents; the others are zeros."""
    some = next(iter(given.values()))
    zeros = {m: some.new_zeros(*some.shape[:-3], c, *some.shape[-2:]) for m, c in codec.channels.items()}
    return codec.decode({**zeros, **given})


def test_depth_and_uniform_classes_survive_the_codec():
    codec = PatchCodec(CodecConfig()).eval()
    depth = 2.0 + 90 * torch.rand(3, 1, 16, 24, generator=torch.Generator().manual_seed(0))
    codec.fit_depth(depth)
    with torch.no_grad():
        back = decoded(codec, depth=codec.encode_depth(depth)).depth
    assert torch.allclose(back, depth, rtol=1e-4)
    ids = torch.arange(19).view(19, 1, 1).expand(19, 4, 4)
    with torch.no_grad():
        assert torch.equal(decoded(codec, semantics=codec.encode_semantics(ids)).semantics, ids)


def test_colour_basis_keeps_smooth_and_constant_images_and_whitens():
    codec = PatchCodec(CodecConfig()).eval()
    coarse = torch.rand(40, 3, 3, 4, generator=torch.Generator().manual_seed(0))
    images = torch.nn.functional.interpolate(coarse, (16, 24), mode="bicubic").clamp(0, 1)
    codec.fit_color(images)
    z = codec.encode_rgb(images)
    assert z.shape == (40, 4, 8, 12)
    deviation = z.std((0, 2, 3))
    assert float(deviation[0]) == pytest.approx(1.0, abs=0.02)
    assert float(deviation[2]) == pytest.approx(1 / 1.5, abs=0.02)
    with torch.no_grad():
        back = decoded(codec, rgb=z).rgb
    assert float((back - images).square().mean()) < 2e-3
    flat = torch.tensor([0.2, 0.5, 0.8]).view(1, 3, 1, 1).expand(1, 3, 16, 24)
    with torch.no_grad():
        back = decoded(codec, rgb=codec.encode_rgb(flat)).rgb
    assert float((back - flat).abs().max()) < 0.05


def test_shares_count_labelled_pixels_only():
    ids = torch.tensor([[0, 0, 10, 255], [0, 13, 255, 255]])
    shares = semantic_shares(ids)
    assert shares.shape == (19, 1, 2) and float(shares[0, 0, 0]) == pytest.approx(0.75)
    assert float(shares[13, 0, 0]) == pytest.approx(0.25) and float(shares[10, 0, 1]) == 1.0
    assert float(semantic_shares(torch.full((2, 2), 255)).sum()) == 0.0


# ---- the refiner: what is copied, shapes ---------------------------------------------------------


def some(count=4, height=16, width=24):
    """A codec, a refiner whose last layer is untouched, latents and a condition of random pixels."""
    codec = PatchCodec(CodecConfig(decoder_width=8, decoder_blocks=1))
    refiner = Refiner(sum(codec.channels.values()), (16, 24), (1, 1))
    latents = some_latents(codec, count, height // 2, width // 2)
    return codec, refiner, latents, some_pixels(height, width, count)


@torch.no_grad()
def test_open_gates_hand_the_condition_through_and_shut_ones_leave_what_the_codec_makes():
    codec, refiner, latents, given = some()
    starts = refiner.leave.bias.split(Refiner.SIZES)
    for number in (1, 4, 6):  # colour, depth and classes of the condition
        starts[number].fill_(30.0)
    made, base = refiner(codec, latents, given, 4), codec.decode_raw(latents)
    assert torch.allclose(made.depth_code, given.depth_code, atol=1e-5)
    far = torch.sigmoid(torch.tensor(-4.0)) * (given.backdrop - given.color)
    assert torch.allclose(made.rgb, given.color + far, atol=1e-5)
    gained = (made.scores - base[2]).gather(1, given.ids.long())
    assert float(gained.min()) > network.COPY_SCORE - 0.01
    for number in (1, 2, 4, 6, 7):
        starts[number].fill_(-30.0)
    made = refiner(codec, latents, given, 4)
    for stated, wanted in zip((made.rgb, made.depth_code, made.scores), base):
        assert torch.allclose(stated, wanted, atol=1e-5)


def test_a_crop_is_refined_as_in_the_whole_image_away_from_its_border():
    """Training on a rectangle teaches what inference on the whole image does: the receptive field is local."""
    codec, refiner, latents, given = some(2, 48, 48)
    with torch.no_grad():
        refiner.leave.weight.normal_(0, 0.05, generator=torch.Generator().manual_seed(1))
        whole = refiner(codec, latents, given, 2)
        cells, pixels = slice(4, 24), slice(8, 48)
        part = refiner(codec, {m: z[..., cells, cells] for m, z in latents.items()}, given.crop(pixels, pixels), 2)
    assert torch.allclose(part.rgb[..., 14:40, 14:40], whole.rgb[..., 22:48, 22:48], atol=1e-4)
    assert not torch.allclose(part.rgb[..., :4, :4], whole.rgb[..., 8:12, 8:12], atol=1e-4)


def test_class_weights_are_taken_back():
    codec, refiner, latents, given = some()
    weights = torch.linspace(0.5, 3.0, 19)
    with torch.no_grad():
        before = refiner(codec, latents, given, 4)
        refiner.take_back(weights)
        after = refiner(codec, latents, given, 4)
    lost = before.scores - after.scores
    assert torch.allclose(lost, weights.log().view(1, -1, 1, 1).expand_as(lost), atol=1e-5)
    assert torch.equal(before.rgb, after.rgb)
    assert torch.equal(before.depth_code, after.depth_code)
