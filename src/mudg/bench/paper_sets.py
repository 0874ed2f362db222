"""FID, KID and FVD of a table: the views of all logs at a place are one set, as in papers, against all recorded frames of their cameras.

A mean of the distances of small sets is mostly bias. The scorer keeps the features of every set it compared and notes their files
(``sets`` in metrics.json); here those of all logs are put together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.bench.paper_numbers import TRUTH
from mudg.stages.scoring.distributions import FEATURES_FOLDER, FEWEST, distances
from mudg.stages.scoring.videos import compared

Rows = NDArray[np.float32]
ENTRIES: Final = ("distributions", "videos")
"""Entries of metrics.json whose sets are pooled."""
Files = dict[str, dict[str, list[str]]]
"""Entry -> files of the features "made" and of their "reference", relative to the folder of the benchmark."""


def files_at(documents: Mapping[Path, Mapping[str, Any]], names: Sequence[str], out: Path) -> Files:
    """Files of features of one method on one log at a place; an entry that lacks a trajectory is left out.

    Args:
        documents: folder of scores -> its metrics.json, one method each. names: trajectories of the place. out: of the benchmark.
    """
    found: Files = {}
    for entry in ENTRIES:
        sets = {
            record["trajectory"]: [(folder / FEATURES_FOLDER / record[part]).relative_to(out).as_posix() for part in ("made", "reference")]
            for folder, document in documents.items() for record in document.get(entry, {}).get("sets", [])
        }  # fmt: skip
        here = [sets[name] for name in names if name in sets]
        if here and len(here) == len(names):
            made, reference = zip(*here, strict=True)
            found[entry] = {"made": list(made), "reference": list(dict.fromkeys(reference))}
    return found


def halves(files: Files) -> Files:
    """What a recorded log compares in place of an unknown truth: frames of the reference against others of it."""
    return {entry: {"made": [], "reference": of["reference"]} for entry, of in files.items()}


def pooled(logs: Sequence[Mapping[str, Any]], out: Path) -> dict[str, dict[str, dict[str, dict[str, Any]]]]:
    """Cells of pooled sets, row -> place -> metric -> values; only where every log has its features.

    Args:
        logs: per log its facts, with ``features[row][place]`` as from `files_at`. out: folder of the benchmark.
    """
    rows = {row: of for entry in logs for row, of in entry["features"].items()}
    found: dict[str, dict[str, dict[str, dict[str, Any]]]] = {}
    for row, places in rows.items():
        for place in places:
            for entry in ENTRIES:
                given = [one["features"].get(row, {}).get(place, {}).get(entry) for one in logs]
                if any(files is None for files in given):
                    continue
                made, reference = _sets(given, out, row == TRUTH)
                if min(len(made), len(reference)) >= FEWEST:
                    found.setdefault(row, {}).setdefault(place, {}).update(_cells(entry, made, reference))
    return found


def _sets(given: Sequence[Mapping[str, Sequence[str]]], out: Path, is_truth: bool) -> tuple[Rows, Rows]:
    """Features of all views, and of all recorded frames. Truth that was not made compares every second recorded frame with the others."""
    read = lambda part: [store.read_safetensors(out / name)["features"] for files in given for name in files[part]]  # noqa: E731
    made, reference = read("made"), read("reference")
    if is_truth and not made:
        made, reference = [rows[::2] for rows in reference], [rows[1::2] for rows in reference]
    return np.concatenate(made), np.concatenate(reference)


def _cells(entry: str, made: Rows, reference: Rows) -> dict[str, dict[str, Any]]:
    if entry == "videos":
        return {"fvd": {"mean": compared(made, reference)["fvd"], "standard_error": None}}
    both = distances(made, reference)
    return {
        "fid": {"mean": round(both.fid, 6), "standard_error": None},
        "kid": {"mean": round(both.kid, 6), "standard_error": both.kid_standard_error},
    }
