"""``mudg bench mdm`` and ``edit``: measures with known answers, and the commands on generated cities."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_networks import small_mdm

from mudg.benchmarks import cities
from mudg.benchmarks import run as bench
from mudg.benchmarks.settings import BenchConfig
from mudg.core import metrics
from mudg.diffusion import model_files
from mudg.diffusion.model import MDM
from mudg.editing.model import display_of


def still_wall(frames: int = 3, height: int = 12, width: int = 16) -> tuple[torch.Tensor, list[metrics.TrueFrame]]:
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


def test_flicker_is_change_relative_to_the_truth_and_leaves_movers_and_the_camera_out() -> None:
    rgb, frames = still_wall()
    blinking = rgb + torch.tensor([0.0, 0.1, 0.0]).view(3, 1, 1, 1)
    for made, truth in metrics.changes(blinking, rgb, frames):
        assert truth == pytest.approx(0.0, abs=1e-3)
        assert made == pytest.approx(0.1 * 12 * 15, rel=1e-3)
    noise = torch.randn(rgb.shape, generator=torch.Generator().manual_seed(1))
    truth, made = rgb + 0.1 * noise, rgb + 0.3 * noise
    assert metrics.flicker(made, truth, frames) == pytest.approx(3.0, rel=1e-3)
    cars = [replace(frame, ids=torch.full_like(frame.ids, 13)) for frame in frames]
    assert math.isnan(metrics.flicker(made, truth, cars))
    assert math.isnan(metrics.flicker(made[:1], truth[:1], frames[:1]))


@pytest.mark.slow
def test_the_command_measures_a_model(tmp_path: Path) -> None:
    model_files.save(MDM(small_mdm(window=8)), tmp_path / "model", "card", {})
    config = BenchConfig(model=str(tmp_path / "model"), cities="development", count=1, steps=(1,), precision="float32")
    out = bench.run("mdm", config, tmp_path / "out")
    content = json.loads((out / "bench.json").read_text())
    assert [row["given_classes"] for row in content["rows"]] == [True, False]
    average = content["rows"][0]["scores"]["average"]
    assert {"psnr", "psnr_condition", "flicker", "miou"} <= set(average)
    assert "classes withheld" in (out / "bench.md").read_text()


# -- edits of cities -------------------------------------------------------------------------------


def seen(vehicle: float, truth: float) -> cities.Seen:
    """Grey render and truth, in linear light, where the vehicle is; elsewhere they differ grossly, which must not
    count."""
    mask = np.zeros((48, 64), bool)
    mask[16:40, 16:56] = True
    made, true = (
        np.where(mask, display_of(np.array(v)), other)[..., None].repeat(3, 2)
        for v, other in ((vehicle, 0.0), (truth, 1.0))
    )
    return made.astype(np.float32), true.astype(np.float32), mask


def test_scores_are_those_of_the_vehicle_alone() -> None:
    scores = cities.vehicle_scores([seen(0.1, 0.2)] * 2, [seen(0.3, 0.3)])
    error = float(display_of(np.array(0.2)) - display_of(np.array(0.1)))
    assert scores["psnr"] == pytest.approx(-20 * math.log10(error), abs=1e-3)
    assert scores["light"] == pytest.approx(2.0, rel=1e-4)
    assert scores["psnr_recorded"] > 80
    right, wrong = (cities.vehicle_scores([seen(*tones)], [])["perceptual"] for tones in ((0.3, 0.3), (0.1, 0.4)))
    assert right < wrong
    nothing = cities.vehicle_scores([], [seen(0.3, 0.3)])
    assert nothing["psnr"] is None and nothing["light"] is None and nothing["perceptual"] is None


def test_the_summary_of_edits_leaves_out_what_no_frame_shows_and_takes_dark_and_bright_alike() -> None:
    row = {"psnr": 20.0, "psnr_recorded": 30.0, "perceptual": 0.2, "perceptual_recorded": 0.1}
    rows = [{"way": way, **row, "light": light} for way in cities.LIGHTS for light in (2.0, 0.5)]
    rows.append({"way": "as recorded", **dict.fromkeys(row), "light": None})
    one, two = cities.REPLACED.summary(rows)
    assert one["light"] == pytest.approx(2.0) and (one["cities"], two["cities"]) == (2, 2)
    assert "| as recorded | 20.00 | 30.00 | 0.2000 | 0.1000 | 2.0x | 2.00x |" in cities.REPLACED.table([one, two])


@pytest.mark.slow
def test_the_command_edits_cities_and_puts_vehicles_of_one_into_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted, case_of = [], cities.case_of
    noted = lambda config, city, out: (fitted.append(city), case_of(config, city, out))[1]
    monkeypatch.setattr(cities, "case_of", noted)
    out = bench.run("edit", BenchConfig(cities="development", count=2, edit_iterations=60), tmp_path / "out")
    content = json.loads((out / "bench.json").read_text())
    assert len(content["rows"]) == 14 and len(content["insert"]["rows"]) == 4
    assert "Vehicles of other cities" in (out / "bench.md").read_text()
    assert fitted == content["cities"]  # each once, although three parts read it
    assert all(row["psnr"] < row["psnr_recorded"] for row in content["insert"]["rows"])
    for row in content["rows"]:  # edits are as good as the fit
        assert row["edit"] != "remove" or row["vehicle"] is None
        if row["edit"] != "half the speed":  # in one city the camera drives into the slowed vehicle
            assert row["outside"] < 0.03
        if row["overlap"] is not None:
            assert row["overlap"] > row["overlap_before"] - 0.05
        if row["edit"] in ("move 3 m ahead", "move 1 m left", "brake"):  # others turn sides to view that nobody saw
            assert row["vehicle"] > row["vehicle_before"] - 3
