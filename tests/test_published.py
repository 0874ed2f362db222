"""The published networks against golden values; a tiny model of that kind from condition to observation, its passes and
its memory."""

import json
import math
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
import toy_clips
from refusals import refused
from toy_published import TINY, fill, tiny_model, write_tiny
from toy_scene import ToyStreet

from mudg.base import palette
from mudg.base.errors import ResourceError, UsageError
from mudg.base.store import read_safetensors
from mudg.base.types import View
from mudg.core import noise
from mudg.diffusion import published, views
from mudg.diffusion.condition import ConditionRules, DriveInputs, build_conditions
from mudg.diffusion.published import PublishedConfig, WorkSplit
from mudg.diffusion.published_network import (
    LATENT_SCALE,
    Autoencoder,
    AutoencoderConfig,
    Decoder,
    Encoder,
    Resampler,
    ResamplerConfig,
    VideoUNet,
    VideoUNetConfig,
    nearest_class,
)
from mudg.diffusion.requests import SampleRequest
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import recorded_at_pose, recorded_images
from mudg.networks import clip
from mudg.networks.clip import ImageTower, TextTower, TowerConfig
from mudg.scene.clouds import read_fused
from mudg.scene.observations import read_observations
from mudg.scene.read import read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps.ingest import Fuse
from mudg.steps.synthesize import Synthesize

GOLDEN = Path(__file__).parent / "golden"
TOLERANCE = 1e-4


def golden(name):
    return {k: torch.from_numpy(v.copy()) for k, v in read_safetensors(GOLDEN / f"{name}.safetensors").items()}


def error(made, wanted):
    return float((made - wanted).norm() / wanted.norm())


def some_condition(frames=4, height=8, width=12, seed=0):
    """Points alone, as the published condition has them."""
    absent = dict.fromkeys(("warped", "backdrop", "semantics", "backdrop_semantics"))
    return replace(toy_clips.some_condition(frames, height, width, seed), **absent)


@pytest.fixture(scope="module")
def model():
    return tiny_model()


# golden values ------------------------------------------------------------------------------------


@torch.no_grad()
def test_denoising_network_equals_the_reference():
    values, theirs = golden("published_unet"), json.loads((GOLDEN / "published_unet.json").read_text())
    config = VideoUNetConfig(
        channels_in=theirs["in_channels"],
        channels_out=theirs["out_channels"],
        width=theirs["model_channels"],
        multipliers=tuple(theirs["channel_mult"]),
        blocks=theirs["num_res_blocks"],
        attention=tuple(2**level in theirs["attention_resolutions"] for level in range(len(theirs["channel_mult"]))),
        head_width=theirs["num_head_channels"],
        context_width=theirs["context_dim"],
        dropout=theirs["dropout"],
    )
    net = fill(VideoUNet(config), "net.", "model.diffusion_model.")
    text, image = values["context"][:, :77], values["context"][:, 77:].unflatten(1, (16, 16))
    made = net(values["x"].transpose(1, 2), values["timesteps"], values["labels"], values["fps"], text, image)
    assert error(made.transpose(1, 2), values["y"]) < TOLERANCE


@torch.no_grad()
def test_autoencoder_equals_the_reference():
    values = golden("published_vae")
    codec = fill(Autoencoder(AutoencoderConfig(width=32)), "codec.", "first_stage_model.")
    mean, log_variance = codec.moments(values["x"])
    assert error(torch.cat([mean, log_variance], 1), values["moments"]) < TOLERANCE
    assert error(codec.encode(values["x"]), values["z"] * LATENT_SCALE) < TOLERANCE
    assert error(codec.decode_image(values["z"] * LATENT_SCALE), values["decoded"]) < TOLERANCE


@torch.no_grad()
def test_resampler_equals_the_reference():
    values = golden("published_resampler")
    config = ResamplerConfig(64, 2, 16, 3, 4, 16, 80, 48, 4)
    made = fill(Resampler(config), "image_tokens.", "image_proj_model.")(values["x"])
    assert made.shape == (len(values["x"]), 16, 4, 48)
    assert error(made.flatten(1, 2), values["y"]) < TOLERANCE


# towers -------------------------------------------------------------------------------------------


def twin_block(x, block, mask):
    """A pre-norm block by torch's own multi-head attention."""
    width = x.shape[-1]
    attention = torch.nn.MultiheadAttention(width, block.heads, batch_first=True).double()
    with torch.no_grad():
        attention.in_proj_weight.copy_(block.query_key_value.weight)
        attention.in_proj_bias.copy_(block.query_key_value.bias)
        attention.out_proj.weight.copy_(block.out.weight)
        attention.out_proj.bias.copy_(block.out.bias)
    normed = torch.nn.functional.layer_norm(x, (width,), block.norm1.weight.double(), block.norm1.bias.double())
    x = x + attention(normed, normed, normed, attn_mask=mask, need_weights=False)[0]
    normed = torch.nn.functional.layer_norm(x, (width,), block.norm2.weight.double(), block.norm2.bias.double())
    h = normed @ block.feed_in.weight.double().T + block.feed_in.bias.double()
    h = h * 0.5 * (1 + torch.erf(h / math.sqrt(2)))
    return x + h @ block.feed_out.weight.double().T + block.feed_out.bias.double()


@torch.no_grad()
def test_text_tower_equals_its_float64_twin():
    tower = fill(TextTower(TowerConfig(32, 3, 4)), "text.", "cond_stage_model.model.")
    ids = torch.stack([clip.padded_tokens(clip.CAPTION_IDS), clip.padded_tokens(clip.EMPTY_IDS)])
    assert ids[0].tolist() == [49406, 320, 1125, 320, 539, 4161, 3562, 269, 49407] + [0] * 68
    x = tower.tokens.weight.double()[ids] + tower.places.double()
    mask = torch.full((77, 77), float("-inf"), dtype=torch.float64).triu(1)
    for block in list(tower.blocks)[:-1]:  # the last block is not run
        x = twin_block(x, block, mask)
    x = torch.nn.functional.layer_norm(x, (32,), tower.norm.weight.double(), tower.norm.bias.double())
    assert error(tower(ids).double(), x) < 1e-5


@torch.no_grad()
def test_image_tower_equals_its_float64_twin():
    tower = fill(ImageTower(TowerConfig(32, 2, 4), side=42), "image.", "embedder.model.")
    image = torch.rand(2, 3, 50, 90, generator=torch.Generator().manual_seed(0)) * 2 - 1
    cells = clip.prepare_image(image, 42).double().unfold(2, 14, 14).unfold(3, 14, 14)
    cells = cells.permute(0, 2, 3, 1, 4, 5).reshape(2, 9, -1) @ tower.patches.weight.double().flatten(1).T
    x = torch.cat([tower.whole.double().expand(2, 1, -1), cells], 1) + tower.places.double()
    x = torch.nn.functional.layer_norm(x, (32,), tower.norm.weight.double(), tower.norm.bias.double())
    for block in tower.blocks:
        x = twin_block(x, block, None)
    made = tower(image)
    assert made.shape == (2, 10, 32)
    assert error(made.double(), x) < 1e-5


def test_images_are_prepared_as_the_tower_wants_them():
    flat = torch.tensor([-1.0, 0.0, 1.0]).view(1, 3, 1, 1).expand(1, 3, 100, 300)
    made = clip.prepare_image(flat)
    assert made.shape == (1, 3, 224, 224)
    mean, deviation = torch.tensor([0.4815, 0.4578, 0.4082]), torch.tensor([0.2686, 0.2613, 0.2758])
    wanted = (torch.tensor([0.0, 0.5, 1.0]) - mean) / deviation
    assert torch.allclose(made.amax((0, 2, 3)), wanted, atol=2e-3)
    assert torch.allclose(made.amin((0, 2, 3)), wanted, atol=2e-3)
    corner = torch.zeros(1, 3, 20, 20)
    corner[..., 0, 0] = 1.0  # where the image grows, corner pixels keep their values
    assert float(clip.prepare_image(corner)[0, 0, 0, 0]) == pytest.approx((1.0 - 0.48145466) / 0.26862954, abs=1e-4)
    stripes = torch.ones(1, 3, 900, 224)
    stripes[..., ::2, :] = -1  # finer than can be shown: grey after the blur, not an alias of it
    grey = (0.5 - 0.48145466) / 0.26862954
    assert torch.allclose(clip.prepare_image(stripes)[0, 0, 4:-4], torch.tensor(grey), atol=0.05)


# modalities ---------------------------------------------------------------------------------------


def test_modalities_have_no_eight_bit_step(model):
    codec = model.codec
    depth = torch.linspace(-5, 130, 4000).view(1, 1, 40, 100)
    image = codec.depth_image(depth)
    assert image.shape == (1, 3, 40, 100)
    assert float(image.min()) == -1
    assert float(image.max()) == 1
    back = (image.mean(1, keepdim=True) + 1) * 50
    assert torch.allclose(back, depth.clamp(0, 100), atol=1e-4)
    ids = torch.arange(19).repeat(2).view(1, 2, 19)
    assert torch.equal(nearest_class(codec.semantic_image(ids)), ids)
    road, pole = (codec.semantic_image(torch.tensor([[[palette.ID[name]]]])) for name in ("road", "pole"))
    mixed = 0.6 * road + 0.4 * pole
    assert nearest_class(mixed).tolist() == [[[0]]]
    assert torch.equal(codec.semantic_image(torch.tensor([[[255]]])), torch.full((1, 3, 1, 1), -1.0))


def test_posterior_is_sampled_or_not_as_asked(model):
    image, codec = torch.rand(40, 3, 16, 16, generator=torch.Generator().manual_seed(0)) * 2 - 1, model.codec
    with torch.no_grad():
        mean, log_variance = codec.moments(image)
        drawn = codec.encode(image, torch.Generator().manual_seed(3))
        again = codec.encode(image, torch.Generator().manual_seed(3))
    assert torch.equal(drawn, again)
    standard = (drawn / LATENT_SCALE - mean) / (0.5 * log_variance).exp()
    assert abs(float(standard.mean())) < 0.05
    assert float(standard.std()) == pytest.approx(1.0, abs=0.03)


def test_missing_is_zero_and_the_reference_is_frame_zero():
    model = tiny_model()
    model.config = replace(TINY, codec=replace(TINY.codec, posterior="mean"))
    condition = some_condition()
    planes = model.encode_condition(condition).planes
    encode = lambda image: model.codec.encode(image).detach()
    color = condition.color * condition.valid
    assert torch.allclose(planes[0, 0, :4], encode(condition.reference * 2 - 1), atol=1e-5)
    assert torch.allclose(planes[0, 1, :4], encode(color[1] * 2 - 1), atol=1e-5)
    depth = condition.depth * condition.valid
    assert torch.allclose(planes[0, 0, 4:], encode(model.codec.depth_image(depth[0])), atol=1e-5)
    generated = torch.rand(2, 3, 8, 12, generator=torch.Generator().manual_seed(5))
    continued = model.encode_condition(condition, known=generated).planes
    assert torch.allclose(continued[0, 0], planes[0, 0], atol=1e-5)
    assert torch.allclose(continued[0, 1, :4], encode(generated[1] * 2 - 1), atol=1e-5)
    assert torch.allclose(continued[0, 2], planes[0, 2], atol=1e-5)


# sampling -----------------------------------------------------------------------------------------


def test_cuts_of_the_work_do_not_change_the_sample(model):
    condition = some_condition()
    samples = []
    for split in (WorkSplit(True, True, 4), WorkSplit(False, False, 1)):
        model.split = split
        samples.append(model.sample(condition, SampleRequest(3, seed=5, index=1)))
    model.split = WorkSplit()
    first, second = samples
    for name, z in first.latents.items():
        assert torch.allclose(z, second.latents[name], rtol=1e-3, atol=1e-3), name
    assert torch.allclose(first.rgb, second.rgb, atol=1e-3)
    assert torch.allclose(first.depth, second.depth, atol=0.1)
    shapes = [tuple(x.shape) for x in (first.rgb, first.depth, first.semantics)]
    assert shapes == [(4, 3, 8, 12), (4, 1, 8, 12), (4, 8, 12)]
    assert 0 <= float(first.confidence.min()) <= float(first.confidence.max()) <= 1
    again = model.sample(condition, SampleRequest(3, seed=5, index=1))
    assert torch.equal(again.rgb, first.rgb)
    assert not torch.equal(model.sample(condition, SampleRequest(3, seed=5, index=2)).rgb, first.rgb)


def test_guidance_is_that_of_the_schedule_module(model):
    """The guided velocity equals `noise.guide` of two plain passes with the contexts written out here."""
    with torch.no_grad():
        encoded = model.encode_condition(some_condition(), torch.Generator().manual_seed(0))
        tokens = model.image_tokens(torch.cat([encoded.features, encoded.grey]))
        x = torch.randn(1, 4, 4, 4, 6, generator=torch.Generator().manual_seed(1))
        made = model._guided(encoded, ("depth",), tokens, SampleRequest(1))(x, 700)
        inputs, step = torch.cat([x, encoded.planes], 2), torch.tensor([700])
        fixed = (step, torch.tensor([500]), torch.tensor([10]))
        with_context = model.net(inputs, *fixed, model.text[:1], tokens[:1])
        without = model.net(inputs, *fixed, model.text[1:], tokens[1:])
    assert torch.allclose(made, noise.guide(with_context, without, 7.5, 0.7), atol=1e-4)
    assert not torch.allclose(with_context, without, atol=1e-3)


def test_sequences_and_frames_go_through_in_parts(monkeypatch, model):
    q, k, v = torch.randn(3, 13, 5, 8, generator=torch.Generator().manual_seed(0)).unbind(0)
    whole = clip.attend(q, k, v, 2)
    monkeypatch.setattr(clip, "MAX_ATTENTION_BATCH", 4)
    assert torch.allclose(clip.attend(q, k, v, 2), whole, atol=1e-6)
    z = torch.randn(4, 4, 4, 6, generator=torch.Generator().manual_seed(1))
    whole = model.codec.decode_image(z, 4)
    for at_once in (1, 2, 3):
        assert torch.allclose(model.codec.decode_image(z, at_once), whole, atol=1e-5)


def test_other_numbers_of_frames_and_parts_of_different_widths_are_refused(model):
    for count in (1, 3, 5):
        refused("fixed number", model.sample, some_condition(count), SampleRequest(1), raises=UsageError)
    refused("multiples of 4", model.sample, some_condition(height=10), SampleRequest(1), raises=UsageError)
    refused("context", replace, TINY, text=TowerConfig(32, 2, 2), raises=UsageError)


# training -----------------------------------------------------------------------------------------


def batch_of(model, count=6):
    conditions = [some_condition(seed=n) for n in range(count)]
    encoded = model.encode_condition(conditions, torch.Generator().manual_seed(0))
    rgb = torch.stack([c.color for c in conditions])
    depth = torch.stack([c.depth for c in conditions])
    ids = torch.randint(0, 19, (count, 4, 8, 12), generator=torch.Generator().manual_seed(1))
    return model.encode_truth(rgb, depth, ids, torch.Generator().manual_seed(2)), encoded


@contextmanager
def watched(model):
    """What the network is asked for, while a known function stands in for it."""
    seen = {}

    def stand_in(x, planes, t, names, text, tokens):
        seen.update(x=x, t=t, names=names, text=text, tokens=tokens)
        return torch.zeros_like(x)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model, "predict", stand_in)
        yield seen


def test_loss_is_the_velocity_error_and_repeats(model):
    """Against the numbers computed here from the same draws."""
    truth, encoded = batch_of(model)
    with watched(model) as seen:
        losses = model.velocity_loss(truth, encoded, torch.Generator().manual_seed(0))
    x0 = torch.stack([truth[m][n] for n, m in enumerate(seen["names"])])
    alpha, sigma = model.schedule.alpha_sigma(seen["t"], 5)
    scale = model.schedule.scale[seen["t"]].view(-1, 1, 1, 1, 1)
    eps = (seen["x"] - alpha * scale * x0) / sigma
    wanted = (alpha * eps - sigma * scale * x0).square().mean()
    assert float(losses.total.detach()) == pytest.approx(float(wanted), rel=1e-4)
    one, two = (model.velocity_loss(truth, encoded, torch.Generator().manual_seed(9)).total for _ in range(2))
    assert float(one.detach()) == float(two.detach())


def test_shares_of_modalities_and_missing_context(model):
    truth, encoded = batch_of(model, 1)
    planes, features = (x.expand(4000, *x.shape[1:]) for x in (encoded.planes, encoded.features))
    many = replace(encoded, planes=planes, features=features)
    small = {m: z[:, :1, :1, :1, :1].expand(4000, -1, -1, -1, -1) for m, z in truth.items()}
    tower, model.image_tokens = model.image_tokens, torch.nn.Identity()
    with watched(model) as seen:
        model.velocity_loss(small, many, torch.Generator().manual_seed(0))
    model.image_tokens = tower
    share = lambda flags: float(torch.tensor(flags).float().mean())
    for name, wanted in (("rgb", 0.5), ("semantics", 0.25), ("depth", 0.25)):
        assert share([n == name for n in seen["names"]]) == pytest.approx(wanted, abs=0.03)
    no_text = (seen["text"] == model.text[1]).flatten(1).all(1)
    no_reference = (seen["tokens"] == encoded.grey).flatten(1).all(1)
    assert float(no_reference.float().mean()) == pytest.approx(0.20, abs=0.02)
    assert float(no_text.float().mean()) == pytest.approx(0.10, abs=0.02)
    assert float((no_text & no_reference).float().mean()) == pytest.approx(0.05, abs=0.015)


# published, command, memory ---------------------------------------------------------------------------


def one_path(street):
    """Settings of one trajectory by the model of ``street``."""
    paths = {"cameras": ("front",), "shifts_m": (1.0,)}
    return SynthesizeConfig(**paths, model=str(street / "model"), steps=6, overlap=2, precision="float32")


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """A made-up street as a scene, its fused cloud, and a converted tiny model."""
    root = tmp_path_factory.mktemp("street")
    ToyStreet(times=[0.1 * n for n in range(6)]).write(root / "scene", width=48, height=32)
    Fuse(scene=root / "scene", out=root / "fused", settings=FuseConfig()).run()
    write_tiny(root)
    return root


def test_synthesize_with_a_converted_model(street, tmp_path, monkeypatch):
    """Guidance 7.5, rescale 0.7, three modalities: every frame of the trajectory becomes an observation."""
    passes, forward = [], VideoUNet.forward
    noted = lambda net, x, t, label, *rest: (passes.append(label.tolist()), forward(net, x, t, label, *rest))[1]
    work = partial(Synthesize, scene=street / "scene", fused=street / "fused")
    with monkeypatch.context() as patched:
        patched.setattr(VideoUNet, "forward", noted)
        out = work(out=tmp_path / "out", settings=one_path(street)).run()
    found = read_observations(out / "front_shift+1.0")
    assert len(found) == 6
    assert passes == [[0, 500, 1] * 2] * 12
    for n in range(6):
        assert found[n].rgb.shape == (3, 32, 48)
        assert bool(torch.isfinite(found[n].rgb).all())
        depth = found[n].depth[torch.isfinite(found[n].depth)]
        assert bool(((depth >= 0) & (depth <= 100)).all())
        assert bool(found[n].mask.all()) == (n > 0)  # frame 0 shows the recorded place, not the shifted one
    step = work(out=tmp_path / "none", settings=replace(one_path(street), memory_budget_gb=0.5))
    refused("memory budget", step.run, raises=ResourceError)


def test_the_released_resizing(street):
    """Colours by the nearest pixel, depth bilinearly with its zeros mixed in; nothing is filled."""
    scene, cloud = read_scene(street / "scene"), read_fused(street / "fused")
    view = scene.frames_of("front")[0].view
    native = ConditionRules(48, 32, published=True)
    sparse = native.project(cloud, scene.tracks, view.resized(48, 32))
    recorded = recorded_images(scene, SynthesizeConfig(given_classes=False))
    drive = DriveInputs(cloud, scene.tracks, recorded)
    made, _ = build_conditions(drive, [view], ConditionRules(12, 8, 48, 32, published=True))
    assert torch.equal(made.color[0], (sparse.rgb * sparse.valid)[:, ::4, ::4])
    depth = sparse.depth * sparse.valid
    middle = (depth[1::4, 1::4] + depth[2::4, 1::4] + depth[1::4, 2::4] + depth[2::4, 2::4]) / 4
    assert torch.allclose(made.depth[0, 0], middle, atol=1e-4)
    assert bool((made.depth == 0).any())
    assert made.reference.shape == (3, 8, 12)


def test_the_reference_fits_only_where_it_was_taken(street):
    scene = read_scene(street / "scene")
    recorded = recorded_images(scene, SynthesizeConfig(given_classes=False))
    view = recorded[0].view
    moved = view.world_from_cam.copy()
    moved[:3, 3] += [0.0, 1.0, 0.0]
    assert recorded_at_pose(view, recorded)
    assert not recorded_at_pose(View(view.camera, moved, view.time_s), recorded)
    assert not recorded_at_pose(view, [])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("budget_gb", "guidance", "split"),
    [
        (8, True, WorkSplit(False, False, 2)),
        (10, True, WorkSplit(False, False, 4)),
        (16, True, WorkSplit(True, False, 8)),
        (15, False, WorkSplit(True, True, 8)),
        (80, True, WorkSplit(True, True, 16)),
    ],
)
def test_full_size_fits_ten_gigabytes(budget_gb, guidance, split):
    """See docs/research/published.md for the table."""
    needs = published.needs_of(PublishedConfig(), 2)
    assert needs.parameters == pytest.approx(4.41e9, rel=0.01)
    found, peak_bytes = published.choose(needs, budget_gb * 10**9, guidance=guidance)
    assert found == split
    assert (peak_bytes <= budget_gb * 1e9) is (budget_gb >= 10)
    at_once = (3 if split.modalities_together else 1) * (2 if split.guidance_together * guidance else 1)
    most = max(at_once * needs.one_video, needs.one_frame * split.frames_at_once)
    assert peak_bytes == needs.parameters + needs.clip + most + published.RESERVE_BYTES


def test_stage_two_freezes_the_published_number_of_weights():
    model = published.meta_model(PublishedConfig(), torch.float32)
    sizes = {name: p.numel() for name, p in model.trained_part().named_parameters()}
    assert sum(sizes.values()) == 1_440_917_060 + 48_787_456
    frozen = {which: model.temporal_parameters(which) for which in ("transformers", "all")}
    assert sum(sizes[name] for name in frozen["transformers"]) == 272_850_880
    assert sum(sizes[name] for name in frozen["all"]) == 272_850_880 + 266_891_520 + 5_580_736
    assert all(".temporal." in n and ".res" not in n for n in frozen["transformers"])


# passes, memory -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("steps", "guidance"), [(5, None), (3, 1.0)])
def test_passes_for_a_clip(model, monkeypatch, steps, guidance):
    """The numbers of docs/research/published.md: the denoiser once per step, the rest once per clip."""
    rows: dict[str, list[int]] = {}
    for owner in (VideoUNet, Encoder, Decoder, ImageTower, Resampler):

        def counted(self, x, *rest, forward=owner.forward):
            rows.setdefault(type(self).__name__, []).append(len(x))
            return forward(self, x, *rest)

        monkeypatch.setattr(owner, "forward", counted)
    model.sample(some_condition(), SampleRequest(steps, guidance=guidance))
    halves = 1 if guidance == 1 else 2
    assert rows["VideoUNet"] == [3 * halves] * steps
    assert rows["Encoder"] == [4, 4] and rows["Decoder"] == [4, 4, 4]  # colour and depth condition; three modalities
    assert rows["ImageTower"] == [2] and rows["Resampler"] == [2]  # the reference, and grey for its absence


def test_settings_of_the_published_kind_alone(street):
    config = SynthesizeConfig(model=str(street / "model"), device="cpu", steps=20)
    checked = views.check_config(config, False)
    assert (checked.processes, checked.device) == (1, "cpu")
    assert views.load_any(checked).split == WorkSplit(frames_at_once=1)
    assert views.load_any(replace(checked, memory_budget_gb=4.0)).split.frames_at_once == 16
