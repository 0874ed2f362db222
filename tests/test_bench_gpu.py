"""The scripts of bench/gpu at their small sizes: the same code as on a card, and what they write."""

from __future__ import annotations

import hashlib
import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

FOLDER = Path(__file__).resolve().parents[1] / "bench" / "gpu"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Run a script's main with --small on the CPU and give back the JSON that it wrote."""
    monkeypatch.setattr(sys, "path", [str(FOLDER), *sys.path])

    def run(name: str, *words: str) -> dict[str, Any]:
        out = tmp_path / "result.json"
        module = importlib.import_module(name)
        folders = ["--out", str(out), "--work", str(tmp_path / "work")]
        module.main(["--small", "--device", "cpu", "--repeats", "1", *folders, *words])
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
    decoding_s = [row["seconds"] for row in rows if row["what"] == "decoding 4 frames"][-1]
    for what, batch in (("clip with guidance", 6), ("clip without guidance", 3)):
        clips = {row["steps"]: row["computed seconds"] for row in rows if row["what"] == what}
        assert clips == pytest.approx({steps: steps * passes[batch] + 3 * decoding_s for steps in (50, 20, 8, 4)})


@pytest.mark.parametrize("stage", ["1", "2"])
def test_training_steps(script: Callable[..., dict[str, Any]], monkeypatch: pytest.MonkeyPatch, stage: str) -> None:
    """A stage moves what it is said to move, and nothing else."""
    training, drawn = importlib.import_module("published_training"), []
    draw = training.drawn_model
    monkeypatch.setattr(training, "drawn_model", lambda *given: (drawn.append(draw(*given)), drawn[0])[1])
    (row,) = script("published_training", "--stage", stage)["rows"]
    assert row["what"] == f"training step, stage {stage}" and row["batch"] == 1
    before = dict(draw(training.SMALL_PUBLISHED, torch.device("cpu"), torch.float32).named_parameters())
    moved = {name for name, value in drawn[0].named_parameters() if not torch.equal(value, before[name])}
    assert moved and all(name.startswith(("net.", "image_tokens.")) for name in moved)
    temporal = {name for name in before if name.startswith("net.") and ".temporal.block." in name}
    assert temporal and bool(moved & temporal) == (stage == "1")


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
def test_training_of_the_small_model(script: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    result = script("train_mdm")
    shipped = FOLDER.parents[1] / "src" / "mudg" / "assets" / "mdm_small" / "model.json"
    (trained,) = (tmp_path / "work" / "learned").rglob("model.json")
    files = {"shipped": shipped, "trained": trained}
    assert result["digests"] == {n: hashlib.sha256(p.read_bytes()).hexdigest() for n, p in files.items()}
    training, *scores = result["rows"]
    assert training["steps"] == json.loads(trained.read_text())["facts"]["recipe"]["steps"] == 2
    for row, path in zip(scores, (shipped, trained), strict=True):
        assert json.loads(row["held_out"]) == json.loads(path.read_text())["facts"]["held_out"]


@pytest.mark.slow
def test_the_whole_chain(script: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    result, run = script("city_run"), tmp_path / "work" / "run"
    assert result["digests"]["metrics"] == hashlib.sha256((run / "score" / "metrics.json").read_bytes()).hexdigest()
    steps = json.loads((run / "run.json").read_text())["steps"]
    seconds = {row["what"]: row["seconds"] for row in result["rows"]}
    assert seconds == pytest.approx({name: of["seconds"] for name, of in steps.items()})
    assert {"ingest", "fit with diffusion", "score"} <= set(steps)
