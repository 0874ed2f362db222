"""Diffusion models, their training and the networks of annotate on a device: the same numbers, and nothing crosses on
the way."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from pretend_device import Transfer, pretend_device, transfers
from test_published import some_condition
from toy_clips import HEIGHT, WIDTH, interrupted_at, losses_of, made_up_clip, tiny, with_settings, write_clips
from toy_published import tiny_model, write_tiny
from toy_scene import ToyStreet

from mudg.base import log, store
from mudg.base.errors import ResourceError, UsageError
from mudg.base.types import Condition
from mudg.diffusion import model_files, parallel
from mudg.diffusion.model import MDM
from mudg.diffusion.model_files import generated
from mudg.diffusion.models import model_config
from mudg.diffusion.requests import GeneratedClip, SampleRequest, half_format
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import check_config
from mudg.labels.depth_networks import Preparation, TransformersDepth
from mudg.labels.inputs import DepthInput
from mudg.labels.segmenters import Segmenter
from mudg.labels.settings import AnnotateConfig
from mudg.scene.read import read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps.ingest import Annotate, Fuse
from mudg.steps.synthesize import Learn, Synthesize

NEAR = 1e-4
"""Relative to the largest value: attention sums in another order there. Measured: 1e-7 for the small model, 2e-5 with
guidance 7.5."""


def far_apart(one: torch.Tensor, other: torch.Tensor) -> float:
    """Largest difference of two tensors, as a share of the largest value; NaN must be in the same places."""
    a, b = one.double(), other.double()
    assert torch.equal(a.isnan(), b.isnan()) and not a.isinf().any()
    a, b = a.nan_to_num(), b.nan_to_num()
    return float((a - b).abs().max() / a.abs().max().clamp(min=1e-12))


def crossed(seen: list[Transfer], way: str, more_than: int = 1) -> list[int]:
    """Sizes of the tensors that went that way, sorted; single numbers are left out."""
    return sorted(copy.values for copy in seen if copy.way == way and copy.values > more_than)


def check_same_clip(one: GeneratedClip, other: GeneratedClip) -> None:
    for name in ("rgb", "depth", "confidence", "log_error"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None)
        assert a is None or (type(b) is torch.Tensor and far_apart(a, b) < NEAR), name
    assert (one.semantics != other.semantics).float().mean() < 1e-3
    assert all(far_apart(z, other.latents[m]) < NEAR for m, z in one.latents.items())
    assert [f.used for f in one.depth_fits] == [f.used for f in other.depth_fits]


def tensors_of(condition: Condition) -> Iterator[torch.Tensor]:
    for owner in (condition, condition.renders):
        for field in fields(owner) if owner is not None else ():
            if isinstance(value := getattr(owner, field.name), torch.Tensor):
                yield value


def enlarged(condition: Condition, scale: int = 2) -> Condition:
    """The condition at a higher resolution."""
    larger = lambda x: x.repeat_interleave(scale, -1).repeat_interleave(scale, -2)
    views = tuple(v.resized(v.camera.width * scale, v.camera.height * scale) for v in condition.views)
    own = {f.name: larger(x) for f in fields(condition) if isinstance(x := getattr(condition, f.name), torch.Tensor)}
    return replace(condition, views=views, renders=condition.renders.map(larger), **own)


@pytest.fixture
def small():
    """A small model with refiner, finisher and renders, every weight moved off its start."""
    torch.manual_seed(0)
    model = MDM(model_config(tiny("unused"))).eval()
    with torch.no_grad():
        for value in model.parameters():
            value.add_(0.05 * torch.randn(value.shape))
    return model


# sampling -----------------------------------------------------------------------------------------


def test_a_clip_of_the_small_model_is_the_same_on_a_device_and_crosses_once(small):
    condition = made_up_clip(1).condition
    fine, request = enlarged(condition), SampleRequest(3, 5, 2)
    clip, finished = small.sampled_and_finished(condition, fine, request)
    with pretend_device() as there:
        small.to(there)
        with transfers() as seen:
            clip_there, finished_there = small.sampled_and_finished(condition, fine, request)
    check_same_clip(clip, clip_there)
    check_same_clip(finished, finished_there)
    noise = [sum(clip.latents[m].numel() for m in clip.latents)] * 3  # a draw at the start and one between steps
    assert crossed(seen, "there") == sorted([*(x.numel() for c in (condition, fine) for x in tensors_of(c)), *noise])
    names = ("rgb", "depth", "semantics", "confidence", "log_error")
    back = [getattr(c, name).numel() for c in (clip, finished) for name in names]
    latents, fits = [z.numel() for z in clip.latents.values()], [4] * len(clip.depth_fits)
    assert crossed(seen, "back") == sorted(back + latents + fits)


def test_a_clip_of_the_published_kind_is_the_same_on_a_device_and_crosses_once():
    model, condition, request = tiny_model(), some_condition(), SampleRequest(2, 5)
    here = generated(model, condition, request)
    with pretend_device() as there:
        model.to(there)
        with transfers() as seen:
            made = generated(model, condition, request)
    check_same_clip(here, made)
    latent = here.latents["rgb"].numel()
    posterior, noise = [latent] * 2, [3 * latent] * 3  # of both planes; at the start and after each step
    palette = [19 * 3]
    given = [x.numel() for x in tensors_of(condition)]
    # besides: labels, statistics of colours
    assert crossed(seen, "there", 64) == sorted(n for n in given + posterior + noise + palette if n > 64)
    back = [x.numel() for x in (here.rgb, here.depth, here.semantics, here.confidence, *here.latents.values())]
    assert crossed(seen, "back", 4) == sorted(back)


# training -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips"))


@pytest.mark.slow
def test_learn_on_a_device_is_learn_and_resumes(clips, tmp_path):
    """Codec, network, refiner, finisher and scores; stopped after two steps and continued."""
    config = tiny(clips, device="cpu", log_every=1)
    here = Learn(out=tmp_path / "here", settings=config).run()
    with pretend_device():
        there = with_settings(config, device="pretend")
        with interrupted_at(1), pytest.raises(KeyboardInterrupt):
            Learn(out=tmp_path / "there", settings=there).run()
        made = Learn(out=tmp_path / "there", settings=there).run()
    assert losses_of(tmp_path / "there") == pytest.approx(losses_of(tmp_path / "here"), rel=1e-5)
    a, b = (model_files.load(folder).state_dict() for folder in (here, made))
    assert max(far_apart(a[name], b[name]) for name in a if a[name].any()) < 2e-3  # kept in 16 bits
    psnr = [store.read_json(tmp_path / name / "metrics.json")["average"]["psnr"] for name in ("there", "here")]
    assert psnr[0] == pytest.approx(psnr[1], abs=0.02)


# verbs --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    root = tmp_path_factory.mktemp("street")
    ToyStreet(times=[0.1 * n for n in range(5)]).write(root / "scene", labels=False, width=WIDTH, height=HEIGHT)
    Fuse(scene=root / "scene", out=root / "fuse", settings=FuseConfig()).run()
    return root


def synthesized(street, out, config):
    return Synthesize(scene=street / "scene", fused=street / "fuse", out=out, settings=config).run()


def labelled(street, out, config):
    return read_scene(Annotate(scene=street / "scene", out=out, settings=config).run())


def in_float16(folder):
    how = {"steps": 2, "guidance": 1.0, "device": "cpu", "precision": "float16"}
    return SynthesizeConfig(shifts_m=(1.0,), model=str(write_tiny(folder)), **how)


def test_float16_is_refused_on_the_cpu_and_for_other_models(street, tmp_path):
    config, out = in_float16(tmp_path), tmp_path / "out"
    said = r"float16 is for published-type models on CUDA devices(.|\n)*a published-type model on cpu"
    with pytest.raises(UsageError, match=said):
        synthesized(street, out, config)
    with pretend_device(), pytest.raises(UsageError, match="another model on pretend"):
        synthesized(street, out, replace(config, model="embedded-tiny", guidance=None, device="pretend"))
    assert not out.exists()


class Plain(torch.nn.Module):
    """Answers as networks of transformers do, without the package."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        torch.manual_seed(4)
        self.layer = torch.nn.Conv2d(3, channels, 3, padding=1)

    def forward(self, pixel_values: torch.Tensor) -> SimpleNamespace:
        made = self.layer(pixel_values)
        return SimpleNamespace(logits=made[..., ::2, ::2], predicted_depth=made[:, 0])


def test_pretrained_networks_compute_on_the_device_and_answer_on_the_cpu():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (20, 30, 3), np.uint8)
    ones = np.ones((20, 30), np.float32)
    asked = DepthInput(rgb, np.nan * ones, ones, ones < 0)
    preparation = Preparation(20, 30, 1, True, (0.5,) * 3, (0.5,) * 3)

    def answers(place: torch.device):
        net = Plain(3).to(place).eval()
        segmenter = Segmenter(net, "segformer", np.array([0, 2, 10]), (0.5,) * 3, (0.2,) * 3, device=place)
        depth = TransformersDepth(net, preparation, "depth", with_lidar=False, device=place)
        return [*segmenter.classes(rgb), depth(asked).values]

    here = answers(torch.device("cpu"))
    with pretend_device() as place, transfers() as seen:
        there = answers(place)
    for a, b in zip(here, there, strict=True):
        assert isinstance(b, np.ndarray) and np.allclose(a, b, atol=1e-5)
    assert crossed(seen, "back") == [600, 3 * 600]  # depth, probabilities
    assert crossed(seen, "there")[-2:] == [3 * 600, 3 * 600]  # two images


def test_what_a_device_does_not_do_is_said(street, small, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    model_files.save(small, tmp_path / "model", "", {})
    for device, error in (("cuda", ResourceError), ("mps:1", ResourceError), ("tpu", UsageError)):
        config = SynthesizeConfig(model=str(tmp_path / "model"), device=device)
        with pytest.raises(error, match="--device"):
            synthesized(street, tmp_path / "out", config)
        with pytest.raises(error, match="--device"), parallel.join_processes(device):
            pass
        with pytest.raises(error, match="--device"):
            Annotate(scene=street / "scene", out=tmp_path / "out", settings=AnnotateConfig(device=device)).run()
    assert not (tmp_path / "out").exists()
    with pytest.raises(UsageError, match="published-type models only"):
        check_config(SynthesizeConfig(model=str(tmp_path / "model"), memory_budget_gb=4), False)


def test_processes_take_a_device_each_and_the_number_format_follows_it(monkeypatch):
    taken = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (10 * 2**30, 24 * 2**30))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Card")
    monkeypatch.setattr(torch.cuda, "set_device", taken.append)
    monkeypatch.setenv("LOCAL_RANK", "3")
    assert parallel._ranks_on_device(3, 4, "auto").device == torch.device("cuda", 3)
    assert parallel._ranks_on_device(0, 1, "cuda:2").device == torch.device("cuda", 2)
    assert parallel._ranks_on_device(3, 4, "cpu").device == torch.device("cpu")
    assert taken == [torch.device("cuda", 3), torch.device("cuda", 2)]
    with pytest.raises(UsageError, match="cannot share"):
        parallel._ranks_on_device(3, 4, "cuda:0")
    with pytest.raises(UsageError, match="not implemented"):
        parallel._ranks_on_device(3, 4, "mps")
    said: list[str] = []
    monkeypatch.setattr(log, "info_once", said.append)
    card, apple = torch.device("cuda", 0), torch.device("mps", 0)
    for capability, half, narrow in (((8, 0), torch.bfloat16, torch.bfloat16), ((7, 5), None, torch.float16)):
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _, found=capability: found)
        assert half_format("auto", card) == half
        assert half_format("auto", card, float16=True) == narrow
        assert half_format("bfloat16", card) == torch.bfloat16 and half_format("float32", card) is None
    assert half_format("auto", apple) is None
    assert "diffusion model: bfloat16 (cuda:0 has bfloat16)" in said
    assert "diffusion model: float16 (cuda:0 has no bfloat16)" in said
    assert said[-1] == "diffusion model: float32 (on mps:0)"
