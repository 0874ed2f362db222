"""Measurements of the diffusion model: flicker at known values, the command end to end."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_networks import small_mdm

from mudg.base.errors import MudgError, UsageError
from mudg.benchmarks import run as bench
from mudg.benchmarks.settings import BenchConfig
from mudg.core import metrics
from mudg.diffusion import files
from mudg.diffusion.clips import from_city
from mudg.diffusion.model import MDM

SMALL = small_mdm(widths=(16, 24), head_width=8, window=8)


def still_wall(frames=3, height=12, width=16):
    """A wall 10 m ahead, camera moving 0.5 m sideways (so 1 pixel) per frame: its picture moves, its surface does not
    change."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = 0.5 * np.arange(frames)
    lens = torch.tensor([[20.0, 20.0, width / 2, height / 2]] * frames, dtype=torch.float64)
    row = torch.rand(1, 3, height, width + frames, generator=torch.Generator().manual_seed(0))
    rgb = torch.cat([row[..., t : t + width] for t in range(frames)])
    depth = torch.full((frames, 1, height, width), 10.0)
    ids = torch.full((frames, height, width), 2)
    return rgb, [metrics.TrueFrame(*one) for one in zip(depth, ids, torch.from_numpy(poses), lens, strict=True)]


def test_a_moving_camera_alone_is_no_change():
    rgb, frames = still_wall()
    blinking = rgb + torch.tensor([0.0, 0.1, 0.0]).view(3, 1, 1, 1)
    for made, truth in metrics.changes(blinking, rgb, frames):
        assert truth == pytest.approx(0.0, abs=1e-3)
        assert made == pytest.approx(0.1 * 12 * 15, rel=1e-3)


def test_flicker_is_relative_to_the_truth_and_leaves_movers_out():
    rgb, frames = still_wall()
    noise = torch.randn(rgb.shape, generator=torch.Generator().manual_seed(1))
    truth, made = rgb + 0.1 * noise, rgb + 0.3 * noise
    assert metrics.flicker(made, truth, frames) == pytest.approx(3.0, rel=1e-3)
    cars = [replace(frame, ids=torch.full_like(frame.ids, 13)) for frame in frames]
    assert math.isnan(metrics.flicker(made, truth, cars))
    assert math.isnan(metrics.flicker(made[:1], truth[:1], frames[:1]))


def test_reported_and_development_cities_differ():
    assert not set(from_city.REPORTED) & set(from_city.DEVELOPMENT)
    assert min(from_city.REPORTED + from_city.DEVELOPMENT) >= from_city.HELD_OUT
    rules = from_city.CityClipRules()
    for number in (from_city.REPORTED[0], from_city.DEVELOPMENT[0]):
        assert from_city.city_config(rules, number) == from_city.city_config(replace(rules, seed=7), number)


def test_what_reads_no_model_takes_none(tmp_path, monkeypatch):
    monkeypatch.setitem(bench.BENCHES, "poses", lambda config, out: ({"cities": []}, "nothing"))
    out = bench.run("poses", BenchConfig(), tmp_path / "out")
    assert json.loads((out / "run.json").read_text())["inputs"] == {}
    absent = BenchConfig(model=str(tmp_path / "no model here"))
    with pytest.raises(UsageError, match="does not use this setting"):
        bench.run("poses", absent, tmp_path / "other")
    with pytest.raises(MudgError, match="no such file or folder"):
        bench.run("mdm", absent, tmp_path / "other")


@pytest.mark.slow
def test_the_command_measures_a_model(tmp_path):
    files.save(MDM(SMALL), tmp_path / "model", "card", {})
    config = BenchConfig(model=str(tmp_path / "model"), cities="development", count=1, steps=(1,), precision="float32")
    out = bench.run("mdm", config, tmp_path / "out")
    content = json.loads((out / "bench.json").read_text())
    assert [row["given_classes"] for row in content["rows"]] == [True, False]
    average = content["rows"][0]["scores"]["average"]
    assert {"psnr", "psnr_points", "psnr_reference", "flicker", "miou"} <= set(average)
    assert content["seam"]["seams"] == [7, 13, 19]
    assert "Seam" in (out / "bench.md").read_text()
    with pytest.raises(UsageError, match="no such benchmark"):
        bench.run("nothing", config, tmp_path / "other")
