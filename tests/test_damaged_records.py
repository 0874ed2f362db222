"""Records that the program wrote itself, damaged where no manifest vouches for them: whoever reads them ends in words,
or does not mind."""

from __future__ import annotations

import functools
import json
import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import toy_views
from test_damaged_models import altered, ends_in_words
from test_faults import small_run
from test_gallery import run_of
from test_report import finished_run

from mudg.base import checkpoint, store
from mudg.base.config import result_settings
from mudg.base.types import FusedCloud, PointCloud
from mudg.diffusion import convert
from mudg.gaussians.storage import StartFit
from mudg.scene.clouds import read_fused, write_fused
from mudg.scene.observations import read_observations
from mudg.scoring import score
from mudg.scoring.detections import read_detections
from mudg.steps import pipeline
from mudg.steps.settings import RunConfig
from mudg.viewer import gallery, report

CASES = 24
"""Of each record, by seeded chance; there may be thousands."""


def begun(folder: Path) -> Path:
    """A run that was interrupted."""
    small_run(folder)
    record = store.read_json(folder / "run.json").items()
    state = {name: value for name, value in record if name not in ("check", "sealed")}
    store.write_json(folder / "run.json", {**state, "state": "interrupted"})
    (folder / "manifest.json").unlink()
    return folder / "run.json"


def fitted(folder: Path) -> Path:
    small_run(folder)
    store.write_json(folder / "model.json", {"schema": 1, "facts": {"method": "street_gaussians"}})
    state = store.read_json(folder / "run.json")
    store.write_json(folder / "run.json", {**state, "verb": "fit", "inputs": {"scene": "1", "fused": "2"}})
    return folder / "run.json"


def fused(folder: Path) -> Path:
    points = PointCloud(np.zeros((3, 3), np.float32), np.zeros((3, 3), np.uint8), "world")
    car = PointCloud(np.zeros((2, 3), np.float32), np.zeros((2, 3), np.uint8), "object")
    write_fused(folder, FusedCloud(points, {"car": car}), {"tracks": {"car": {"verdict": "moves"}}, "rules": {}})
    return folder / "fuse.json"


def observed(folder: Path) -> Path:
    toy_views.write_views(toy_views.write_scene(folder / "scene"), folder / "views", "a", (0.0,))
    return folder / "views" / "front_recorded" / "observations.json"


def chain(folder: Path) -> Path:
    ledger = pipeline._Ledger(folder, {"verb": "run", "source": "city", **result_settings(RunConfig())}, {})
    cost = {"seconds": 1.5, "processor_s": 2.5, "peak_bytes": 3, "written_bytes": 4}
    ledger.steps, ledger.digests = {"fit": {"state": "complete", **cost}}, {"fit": "s"}
    folder.mkdir()
    ledger.save("complete")
    return folder / "run.json"


def scored(folder: Path, name: str = "score/metrics.json") -> Path:
    """A run with its scores, made once."""
    whole = folder.parent.parent / "scored run"
    if not whole.is_dir():
        finished_run(whole)
    shutil.copytree(whole, folder)
    return folder / name


def saved_checkpoint(folder: Path) -> Path:
    checkpoint.save(folder, 3, {}, {"a": 1})
    store.write_json(folder / "step_00000003" / "manifest.json", {"schema": 1, "files": {}})
    return folder / "step_00000003" / "state.json"


def written(name: str, value: object) -> Callable[[Path], Path]:
    def save(folder: Path) -> Path:
        store.write_json(folder / name, value)
        return folder / name

    return save


MODEL = {"files": {"a.safetensors": ""}, "parts": {"unet": {"files": {"b.safetensors": ""}}}}
BOXES = [{"image_id": "a/000001.png", "category_id": 3, "score": 0.9, "bbox": [1, 2, 3, 4]}]
READERS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], object]]] = {
    "interrupted run": (begun, small_run),
    "interrupted run, replaced": (begun, lambda folder: small_run(folder, 2, overwrite=True)),
    "fit to go on with": (fitted, lambda folder: StartFit.of_folder(folder, {"scene": "1", "fused": "2"})),
    "fused clouds": (fused, read_fused),
    "observations": (observed, lambda folder: read_observations(folder / "views" / "front_recorded")[0]),
    "whole run": (chain, lambda folder: pipeline._Ledger.open(folder, RunConfig(), "city", False).seconds()),
    "whole run on a page": (lambda folder: run_of(folder) / "run.json", gallery.read_shown),
    "scores on a page": (lambda folder: run_of(folder) / "score" / "metrics.json", gallery.read_shown),
    "scores in a terminal": (scored, lambda folder: score.summary_table(folder / "score")),
    "scores in a report": (scored, lambda folder: report.write_page(folder, [])),
    "times in a report": (functools.partial(scored, name="run.json"), lambda folder: report.write_page(folder, [])),
    "checkpoint": (saved_checkpoint, checkpoint.latest),
    "model folder": (written("model.json", MODEL), convert.own_names),
    "boxes": (written("boxes.json", BOXES), lambda folder: read_detections(folder / "boxes.json")),
}


@pytest.mark.parametrize("kind", READERS)
def test_a_damaged_record_ends_in_words(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda _fd: None)
    save, read = READERS[kind]
    file = save(tmp_path / "a")
    whole = json.loads(file.read_text())
    others = sorted({json.dumps(value) for value in altered(whole)})
    chosen = random.Random(kind).sample(others, min(CASES, len(others)))
    refused = 0
    for number, text in enumerate(["", "[", "\xff", *chosen]):
        folder = tmp_path / str(number) if kind.startswith("interrupted") else tmp_path / "a"
        file = save(folder) if kind.startswith("interrupted") else file
        file.write_text(text, encoding="latin-1")
        refused += ends_in_words(lambda folder=folder: read(folder))
    assert refused > 2 or kind in ("model folder",)
