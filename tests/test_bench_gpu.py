"""The scripts of bench/gpu at their small sizes: the same code as on a card, and what they write."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "bench" / "gpu"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Run a script's main with --small on the CPU and give back the JSON that it wrote."""
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])

    def run(name: str, *words: str) -> dict[str, Any]:
        out = tmp_path / "result.json"
        module = importlib.import_module(name)
        module.main(
            [
                "--small",
                "--device",
                "cpu",
                "--repeats",
                "1",
                "--out",
                str(out),
                "--work",
                str(tmp_path / "work"),
                *words,
            ]
        )
        result = json.loads(out.read_text())
        assert result["device"] == "cpu" and result["card"] is None and result["small"] is True
        assert {"cuda", "packages", "python"} <= set(result["versions"])
        assert result["rows"]
        return result

    return run


@pytest.mark.slow
def test_passes_and_clips(script: Callable[..., dict[str, Any]]) -> None:
    rows = script("published_passes", "--batches", "3", "6")["rows"]
    passes = {row["batch"]: row["seconds"] for row in rows if row["what"] == "pass"}
    assert set(passes) == {3, 6} and all(row.get("peak_gb") is None for row in rows)  # not measured on a CPU
    clips = [row for row in rows if row["what"] == "clip with guidance"]
    assert [row["steps"] for row in clips] == [50, 20, 8, 4]
    assert clips[0]["computed seconds"] > 50 * passes[6]


@pytest.mark.parametrize("stage", ["1", "2"])
def test_training_steps(script: Callable[..., dict[str, Any]], stage: str) -> None:
    (row,) = script("published_training", "--stage", stage)["rows"]
    assert row["seconds"] > 0 and row["batch"] == 1


def test_the_rasterisers_agree(script: Callable[..., dict[str, Any]]) -> None:
    rows = script("raster_parity")["rows"]
    assert {"rgb", "depth", "d means", "d sh", "forward + backward"} <= {row["what"] for row in rows}
    assert all(row.get("holds", True) for row in rows), rows


@pytest.mark.slow
def test_fewer_passes_of_a_stand_in(script: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    picture = tmp_path / "rows.png"
    words = ("--batch", "2", "--clips", "2", "--rows", "2", "--picture", str(picture))
    coded, *rows = script("published_standin", *words)["rows"]
    assert coded["autoencoder PSNR"] > 0 and [row["passes"] for row in rows] == [300, 120] and picture.is_file()
    assert all(0 < row["perceptual"] < 5 and row["psnr"] > 0 for row in rows)
    again = script("published_standin", *words)["rows"]  # trained weights are used again
    assert again == [coded, *rows]


@pytest.mark.slow
def test_training_of_the_small_model(script: Callable[..., dict[str, Any]]) -> None:
    result = script("train_mdm")
    assert set(result["digests"]) == {"shipped", "trained"}
    assert result["rows"][0]["steps"] == 2


@pytest.mark.slow
def test_the_whole_chain(script: Callable[..., dict[str, Any]]) -> None:
    result = script("city_run")
    assert {"ingest", "fit with diffusion", "score"} <= {row["what"] for row in result["rows"]}
    assert len(result["digests"]["metrics"]) == 64
