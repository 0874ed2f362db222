"""Sampling of published models: how often which network runs, what is shared, what fits into which memory."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from test_published import some_condition
from toy_published import tiny_model

from mudg.base.errors import UsageError
from mudg.diffusion import memory_plan, views
from mudg.diffusion.published import PublishedConfig, PublishedMDM, WorkSplit
from mudg.diffusion.published_network import Attention, Decoder, Encoder, Resampler, VideoUNet
from mudg.diffusion.requests import SampleRequest
from mudg.diffusion.settings import SynthesizeConfig
from mudg.networks.clip import ImageTower


@pytest.fixture(scope="module")
def model():
    return tiny_model()


def same(one, other):
    return all(
        torch.equal(getattr(one, name), getattr(other, name)) for name in ("rgb", "depth", "semantics", "confidence")
    )


@pytest.mark.parametrize("steps", [50, 20, 8])
@pytest.mark.parametrize("guidance", [None, 1.0])
def test_passes_for_a_clip(model, monkeypatch, steps, guidance):
    """The numbers of docs/research/published.md: the denoiser once per step, the rest once per clip."""
    rows: dict[str, list[int]] = {}

    def watch(owner, name="forward", answer=None):
        original = getattr(owner, name)

        def counted(self, x, *rest):
            rows.setdefault(owner.__name__, []).append(len(x[0]) if name == "keys" else len(x))
            return original(self, x, *rest) if answer is None else answer(x)

        monkeypatch.setattr(owner, name, counted)

    watch(VideoUNet, answer=lambda x: torch.zeros_like(x[:, :, :4]))
    for owner in (Encoder, Decoder, ImageTower, Resampler):
        watch(owner)
    watch(Attention, "keys")
    layers = len(model.net.context_keys(model.text[:1], torch.zeros(1, 4, 2, 16)))
    rows.clear()
    model.sample(some_condition(), SampleRequest(steps, guidance=guidance))
    halves = 1 if guidance == 1 else 2
    assert rows["VideoUNet"] == [3 * halves] * steps
    assert rows["Encoder"] == [4, 4] and rows["Decoder"] == [4, 4, 4]  # colour and depth condition; three modalities
    assert rows["ImageTower"] == [2] and rows["Resampler"] == [2]  # the reference, and grey for its absence
    assert rows["Attention"] == [3 * halves] * layers


@pytest.mark.parametrize("split", [WorkSplit(), WorkSplit(False, False, 1), WorkSplit(offload=True)])
@pytest.mark.parametrize("bf16", [False, True])
def test_keys_computed_once_change_nothing(model, monkeypatch, split, bf16):
    monkeypatch.setattr(model, "split", split)
    condition, request = some_condition(), SampleRequest(3, 7, bf16=bf16)
    once = model.sample(condition, request)
    told = PublishedMDM._told
    monkeypatch.setattr(PublishedMDM, "_told", lambda self, *given, ahead: told(self, *given, ahead=False))
    assert same(once, model.sample(condition, request))


@torch.no_grad()
def test_keys_belong_to_their_layers(model):
    """Exactly the network's own; and keys of another context give another result."""
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(2, 4, 12, 4, 6, generator=draw)
    at, label, fps = (torch.tensor(pair) for pair in ([700, 3], [0, 500], [10, 10]))
    text, image = torch.randn(2, 77, 16, generator=draw), torch.randn(2, 4, 2, 16, generator=draw)
    plain = model.net(x, at, label, fps, text, image)
    assert torch.equal(plain, model.net(x, at, label, fps, text, image, model.net.context_keys(text, image)))
    assert not torch.equal(
        plain, model.net(x, at, label, fps, text, image, model.net.context_keys(text.flip(0), image))
    )


@pytest.mark.slow
def test_a_compiled_network_makes_the_same(model):
    """Traced by torch.compile without its code generator, so that no compiler is needed."""
    request = SampleRequest(2, 3)
    plain = model.sample(some_condition(), request)
    other = tiny_model()
    names = list(other.state_dict())
    other.net.compile(backend="eager")
    made = other.sample(some_condition(), request)
    assert list(other.state_dict()) == names
    assert torch.allclose(made.rgb, plain.rgb, atol=1e-5) and torch.allclose(made.depth, plain.depth, atol=1e-2)
    torch._dynamo.reset()


@pytest.fixture(scope="module")
def full():
    """The full model in bfloat16 on the meta device, and what it needs."""
    config = PublishedConfig()
    return memory_plan.meta_model(config, torch.bfloat16), memory_plan.needs_of(config, 2)


def test_inputs_that_die_hide_nothing():
    """A tensor that gets the address of an input that is gone is counted all the same."""
    inputs = [torch.empty(1, device="meta") for _ in range(64)]

    def work():
        while inputs:
            inputs.pop().add(1)
        return [torch.empty(1024, device="meta") for _ in range(256)]

    assert memory_plan.peak_activations(work) == 256 * 4096


@pytest.mark.parametrize(
    ("card_gb", "together", "frames"),
    [(16, (True, False), 8), (24, (True, True), 16), (40, (True, True), 16), (80, (True, True), 16)],
)
@pytest.mark.slow
def test_what_fits_on_a_card(full, card_gb, together, frames):
    """At 576x1024; a whole clip, run on the meta device as the plan says, takes no more."""
    model, needs = full
    split, peak_bytes = memory_plan.choose(needs, card_gb * 10**9)
    assert ((split.modalities_together, split.guidance_together), split.frames_at_once, split.offload) == (
        together,
        frames,
        False,
    )
    assert peak_bytes <= card_gb * 10**9
    if card_gb > 24:
        return  # as with 24
    counted = needs.parameters + memory_plan.sampling_bytes(model, split) + memory_plan.RESERVE_BYTES
    assert 0.97 * peak_bytes < counted <= 1.01 * peak_bytes


@pytest.mark.slow
def test_the_tower_goes_where_that_avoids_a_smaller_cut(full):
    _, needs = full
    assert needs.tower == pytest.approx(1.26e9, rel=0.01)
    split, peak_bytes = memory_plan.choose(needs, 14_000_000_000)
    assert split.offload and split.modalities_together and peak_bytes <= 14_000_000_000
    kept, more = memory_plan.choose(needs, 14_000_000_000, offload=(False,))  # on a CPU
    assert not kept.offload and not kept.modalities_together and more > peak_bytes - needs.tower
    asked, _ = memory_plan.choose(needs, 80_000_000_000, offload=(True,))
    assert asked.offload and asked.guidance_together
    _, least = memory_plan.choose(needs, 1)
    assert least == pytest.approx(
        needs.parameters - needs.tower + needs.clip + needs.one_video + memory_plan.RESERVE_BYTES, rel=0.1
    )


def test_frames_go_through_the_autoencoder_in_any_number(model):
    z = torch.randn(4, 4, 4, 6, generator=torch.Generator().manual_seed(1))
    whole = model.codec.decode_image(z, 4)
    for at_once in (1, 2, 3):
        assert torch.allclose(model.codec.decode_image(z, at_once), whole, atol=1e-5)


def test_settings_of_the_published_kind_alone(tmp_path):
    from toy_published import write_tiny

    folder = write_tiny(tmp_path)
    config = SynthesizeConfig(model=str(folder), device="cpu", steps=20)
    with pytest.raises(UsageError, match="on the CPU already"):
        views.check_config(replace(config, offload=True), False)
    checked = views.check_config(config, False)
    assert (checked.processes, checked.device) == (1, "cpu")
    assert views.load_any(checked).split == WorkSplit(frames_at_once=1)
    assert views.load_any(replace(checked, memory_budget_gb=4.0)).split.frames_at_once == 16
