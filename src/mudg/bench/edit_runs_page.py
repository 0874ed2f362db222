"""Table and page of ``mudg bench edit RUN ...``. The page holds its pictures, which show the recorded drives: it is for their owner."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from mudg.base import store
from mudg.report import html

HEADS: Final = (
    "run", "edit", "warp error (lower)", "unedited", "outside changed (lower)", "structure (higher)", "LiDAR AbsRel (lower)", "unedited",
    "uncovered AbsRel (lower)", "uncovered PSNR dB (higher)", "overlap (higher)", "unedited", "collisions", "warnings",
)  # fmt: skip
_SHOWN: Final = {
    "warp": "{:.4f}", "warp_before": "{:.4f}", "outside": "{:.2%}", "structure": "{:.3f}", "lidar": "{:.4f}", "lidar_before": "{:.4f}",
    "uncovered": "{:.3f}", "uncovered_psnr": "{:.2f}",
    "overlap": "{:.2f}", "overlap_before": "{:.2f}", "collisions": "{}", "warnings": "{}",
}  # fmt: skip
_KINDS: Final = ("unedited", "edited", "difference")


def cells(row: Mapping[str, Any]) -> list[str]:
    """A row of the table as text; `-`: there is no such number."""
    return [row["run"], row["edit"], *("-" if row[key] is None else form.format(row[key]) for key, form in _SHOWN.items())]


def markdown(doc: Mapping[str, Any]) -> str:
    """The table as text."""
    lines = [f"# Edits of {len(doc['runs'])} recorded drives against their unedited fits", "",
             f"| {' | '.join(HEADS)} |", "|" + "---|" * len(HEADS)]  # fmt: skip
    return "\n".join([*lines, *(f"| {' | '.join(cells(row))} |" for row in doc["rows"])]) + "\n"


def page(doc: Mapping[str, Any], out: Path) -> str:
    """The whole page, from what ``bench.json`` holds and the pictures in ``out``."""
    walls = [wall for row in doc["rows"] for wall in _walls(row, out)]
    return html.render("edit_runs.html.j2", title="Edited drives", kicker="mudg bench edit",
        lead="Recorded drives, edited, against their unedited fits. The pictures show your recordings: share this page with care.",
        heads=HEADS, rows=[cells(row) for row in doc["rows"]], walls=walls)  # fmt: skip


def _walls(row: Mapping[str, Any], out: Path) -> list[dict[str, Any]]:
    """The pictures of an edit side by side, one wall per frame."""
    stem, found = f"{row['run']}_{row['edit'].replace(' ', '_')}", []
    for number in range(len(list((out / "pictures").glob(f"{stem}_[0-9]_edited.jpg")))):
        cells = [{"title": kind, "src": _inside(out / "pictures" / f"{stem}_{number}_{kind}.jpg")} for kind in _KINDS]
        found.append({"title": f"{row['run']}: {row['edit']}", "notes": row["notes"] if number == 0 else [], "cells": cells})
    return found


def _inside(path: Path) -> str:
    """A picture as a data address."""
    return "data:image/jpeg;base64," + base64.b64encode(store.read_bytes(path)).decode("ascii")
