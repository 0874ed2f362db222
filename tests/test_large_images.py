"""Large images: compared at half their size; views that cannot fit are refused."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_fitted import write_toy_run

import mudg
from mudg.base.errors import ResourceError
from mudg.base.types import Camera, Condition, Trajectory, View
from mudg.core.metrics import Pair
from mudg.diffusion import views as generating
from mudg.diffusion.settings import SynthesizeConfig
from mudg.editing import render
from mudg.networks import featnets
from mudg.networks.codec import CodecConfig, PatchCodec
from mudg.networks.featnets import CodecFeatures, PerceptualDistance


def pair_of(height: int, width: int) -> Pair:
    made, truth = torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(4)).unbind(0)
    return Pair(made, None, None, truth, None, None, None)


def small_distance() -> PerceptualDistance:
    torch.manual_seed(1)
    codec = PatchCodec(CodecConfig(decoder_width=8, decoder_blocks=2))
    for block in codec.blocks:  # as after training: a fresh block adds nothing
        torch.nn.init.normal_(block.conv2.weight, std=0.1)
    return PerceptualDistance(CodecFeatures(codec.eval()))


def test_where_nothing_counts_there_is_no_distance() -> None:
    empty = replace(pair_of(40, 24), mask=torch.zeros(1, 40, 24, dtype=torch.bool))
    assert math.isnan(small_distance()(empty))


def test_a_view_that_cannot_fit_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, fit, *_ = write_toy_run(tmp_path)
    monkeypatch.setattr(render.memory, "free_bytes", lambda: 64 << 30)
    with pytest.raises(ResourceError, match="1000000 x 600000 pixels needs more memory") as refused:
        mudg.render(scene, fit, out=tmp_path / "views", width_px=1_000_000)
    assert "TiB" in refused.value.expected and refused.value.got == "64.0 GiB free"
    assert "--width-px" in refused.value.remedy


def test_trajectories_are_made_one_after_another_where_memory_lasts_for_one(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    camera = Camera("front", 3840, 2160, 2000.0, 2000.0, 1920.0, 1080.0)
    views = (View(camera, np.eye(4), 0.0),) * 3
    paths = [Trajectory(f"front_shift+{n}.0", views, None) for n in (2, 3)]
    monkeypatch.setattr(generating.native, "default_threads", lambda: 2)
    said: list[str] = []
    monkeypatch.setattr(generating.log, "info", said.append)
    for free_gib, expected in ((64, 2), (8, 1), (1, 1), (0, 2)):
        monkeypatch.setattr(generating.memory, "free_bytes", lambda f=free_gib: f << 30)
        assert generating.usual_processes(SynthesizeConfig(device="cpu"), paths) == expected
    assert len(said) == 2 and "8.0 GiB are free" in said[0]
    assert "1 of 2 processes: at 3840x2160 each takes about" in said[0]
    monkeypatch.setattr(generating.memory, "free_bytes", lambda: 8 << 30)
    assert generating.usual_processes(SynthesizeConfig(device="cpu", full_size=False), paths) == 2


def test_tiles_of_a_condition_are_those_of_the_whole() -> None:
    noise = torch.Generator().manual_seed(3)
    camera = Camera("front", 44, 36, 40.0, 40.0, 22.0, 18.0)
    views = tuple(View(camera, np.eye(4), 0.1 * t) for t in range(2))
    one = lambda *shape: torch.rand(*shape, generator=noise)
    planes = (one(2, 3, 36, 44), one(2, 1, 36, 44), one(2, 1, 36, 44) > 0.5, one(3, 36, 44))
    whole = Condition(views, *planes, backdrop=one(2, 3, 36, 44))
    part = whole.cropped(slice(4, 20), slice(8, 40))
    for name in ("color", "backdrop"):
        assert torch.equal(getattr(part, name), getattr(whole, name)[..., 4:20, 8:40])
    assert part.warped is None and {(v.camera.width, v.camera.height) for v in part.views} == {(32, 16)}


def test_perceptual_distance_of_large_images_is_that_of_their_halves(monkeypatch: pytest.MonkeyPatch) -> None:
    pair, distance = pair_of(136, 40), small_distance()
    made, truth = (featnets.F.avg_pool2d(x[None], 2)[0] for x in (pair.rgb, pair.truth_rgb))
    expected = distance(Pair(made, None, None, truth, None, None, None))
    monkeypatch.setattr(featnets, "WHOLE_PIXELS", 136 * 40 - 1)
    assert distance(pair) == expected
