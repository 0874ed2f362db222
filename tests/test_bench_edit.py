"""``mudg bench edit`` on generated cities: scores of vehicles that are put into another city."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from mudg.benchmarks import cities
from mudg.benchmarks import run as bench
from mudg.benchmarks.settings import BenchConfig
from mudg.editing.model import display_of


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
    found = cities.vehicle_scores([seen(0.1, 0.2)] * 2, [seen(0.3, 0.3)])
    error = float(display_of(np.array(0.2)) - display_of(np.array(0.1)))
    assert found["psnr"] == pytest.approx(-20 * math.log10(error), abs=1e-3)
    assert found["light"] == pytest.approx(2.0, rel=1e-4)
    assert found["psnr_recorded"] > 80
    right, wrong = (cities.vehicle_scores([seen(*tones)], [])["perceptual"] for tones in ((0.3, 0.3), (0.1, 0.4)))
    assert right < wrong
    nothing = cities.vehicle_scores([], [seen(0.3, 0.3)])
    assert nothing["psnr"] is None and nothing["light"] is None and nothing["perceptual"] is None


def test_the_summary_leaves_out_what_no_frame_shows_and_takes_dark_and_bright_alike() -> None:
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
    out = bench.run("edit", BenchConfig(cities="development", count=2, pose_iterations=40), tmp_path / "out")
    content = json.loads((out / "bench.json").read_text())
    text = (out / "bench.md").read_text()
    assert len(content["rows"]) == 14 and len(content["insert"]["rows"]) == 4
    assert "Vehicles of other cities" in text
    assert fitted == content["cities"]  # each once, although three parts read it
    assert all(row["psnr"] < row["psnr_recorded"] for row in content["insert"]["rows"])
