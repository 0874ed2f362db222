"""FID, KID and FVD of a table: one set of all logs' views."""

from pathlib import Path

import numpy as np
import pytest
from test_bench_paper import FIDS, ROWS, SETTINGS, TOY, toy_logs

from mudg.base import store
from mudg.bench import paper_numbers, paper_sets
from mudg.core.feature_distances import frechet_distance, kernel_distance

NAMES = ("front_shift+2.0", "front_shift-2.0")


def log_of(out: Path, number: int, entries: tuple[str, ...] = paper_sets.ENTRIES) -> tuple[dict, dict[str, np.ndarray]]:
    """Scores of one method on one log, with files of features; and these by name."""
    rng = np.random.default_rng(number)
    kept = {name: rng.normal(number, 1, (12, 6)).astype(np.float32) for name in (*NAMES, "reference")}
    folder = out / f"log{number}" / "score" / "a"
    for name, rows in kept.items():
        store.write_safetensors(folder / "features" / f"{name}.safetensors", {"features": rows})
    sets = [
        {"trajectory": name, "method": "a", "made": f"{name}.safetensors", "reference": "reference.safetensors"} for name in NAMES
    ]  # fmt: skip
    return {folder: {entry: {"sets": sets} for entry in entries}}, kept


def test_views_of_all_logs_are_one_set(tmp_path: Path) -> None:
    logs, parts = [], []
    for number in range(2):
        documents, kept = log_of(tmp_path, number)
        files = paper_sets.files_at(documents, NAMES, tmp_path)
        assert files["distributions"]["reference"] == [f"log{number}/score/a/features/reference.safetensors"]
        logs.append({"features": {"a": {"2": files}, "truth": {"2": paper_sets.halves(files)}}})
        parts.append(kept)
    found = paper_sets.pooled(logs, tmp_path)
    made = np.concatenate([kept[name] for kept in parts for name in NAMES])
    reference = np.concatenate([kept["reference"] for kept in parts])
    cells = found["a"]["2"]
    assert cells["fid"]["mean"] == pytest.approx(frechet_distance(made, reference), abs=1e-5)
    assert cells["kid"]["mean"] == pytest.approx(kernel_distance(made, reference), abs=1e-5)
    assert cells["kid"]["standard_error"] is None or cells["kid"]["standard_error"] > 0
    assert cells["fvd"]["mean"] == pytest.approx(frechet_distance(made, reference), abs=1e-5)
    single = np.mean([frechet_distance(np.concatenate([kept[name] for name in NAMES]), kept["reference"]) for kept in parts])
    assert abs(cells["fid"]["mean"] - single) > 0.01  # not the mean over logs
    one, other = (np.concatenate([kept["reference"][start::2] for kept in parts]) for start in (0, 1))
    assert found["truth"]["2"]["fid"]["mean"] == pytest.approx(frechet_distance(one, other), abs=1e-5)


def test_a_log_without_features_leaves_the_mean(tmp_path: Path) -> None:
    whole, _ = log_of(tmp_path, 0)
    part, _ = log_of(tmp_path, 1, ("distributions",))
    logs = [{"features": {"a": {"2": paper_sets.files_at(documents, NAMES, tmp_path)}}} for documents in (whole, part)]
    assert set(paper_sets.pooled(logs, tmp_path)["a"]["2"]) == {"fid", "kid"}
    assert paper_sets.files_at(part, (*NAMES, "front_shift+3.0"), tmp_path) == {}


def test_the_table_prints_the_pooled_number_and_ranks_by_it() -> None:
    together = {"gs3d": {"2": {"fid": {"mean": 30.0, "standard_error": None}}}}
    cells = paper_numbers.document(TOY, toy_logs(FIDS), ROWS, SETTINGS, together)
    found = cells["cells"]["gs3d"]["2"]["fid"]
    assert (found["mean"], found["mean_over_logs"], found["standard_error"]) == (30.0, 50.0, None)
    assert (found["n"], found["logs"]) == ([12, 12], 2)
    assert cells["best"]["2"]["fid"] == ["gs3d"]
    assert "mean_over_logs" not in cells["cells"]["mudg_s"]["2"]["fid"]
