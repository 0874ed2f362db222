"""The page of ``mudg bench real``: tables, and the truth beside every method for some views of each protocol. One file: pictures lie
inside."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mudg.base import store
from mudg.bench import real_tables as tables
from mudg.report import html


def page(doc: Mapping[str, Any], out: Path) -> str:
    """The whole page, from what ``bench.json`` holds and the pictures in the folders of ``out``."""
    return html.render(
        "real.html.j2", title="Real logs", kicker="mudg bench real", lead=tables.summary_of(doc), against=tables.AGAINST,
        log_heads=tables.LOG_HEADS, logs=[tables.log_cells(log) for log in doc["logs"]],
        protocols=[_section(doc, name, out) for name in doc["protocols"]],
    )  # fmt: skip


def _section(doc: Mapping[str, Any], name: str, out: Path) -> dict[str, Any]:
    found = doc["protocols"][name]
    counted = {log: entry for log, entry in found["logs"].items() if "left_out" not in entry}
    heads, rows = tables.table_of(doc, name, found["pooled"]) if counted else ([], [])
    walls = [wall for log, entry in counted.items() for wall in _walls(name, log, entry, out)]
    return {
        "title": tables.heading_of(doc, name), "notes": tables.notes_of(doc, name), "heads": heads, "rows": rows, "walls": walls,
        "below": _below(found["row"]["maps"]),
    }  # fmt: skip


def _below(maps: list[str]) -> str:
    """What the lower pictures of a protocol show."""
    if "seen" in maps:
        return "Below: of the truth the part that the shown cameras saw; of the methods the colour error."
    if "photo" in maps:
        return "Below: of the truth the depth of LiDAR points; of the methods the colour error."
    if "classes" in maps:
        return "Truth: the classes of LiDAR points."
    return "Truth: LiDAR points in their recorded colours, below in the colours of their depth; of the methods colour and depth."


def _walls(protocol: str, log: str, entry: Mapping[str, Any], out: Path) -> list[dict[str, Any]]:
    """The pictures of a log under a protocol, one wall per view."""
    folders = {
        "truth": out / log / "truth" / protocol,
        **{m: out / log / "score" / protocol / m for m in entry["values"]},
    }
    views = store.read_json(folders["truth"] / "targets.json")["views"]
    walls = []
    for number in entry["pictures"]:
        record = views[number]
        shift = f", {record['shift_m']:+g} m" if record["shift_m"] else ""
        cells = [
            {"title": title, "src": _inside(folder / "pictures" / f"{number:06d}.jpg")}
            for title, folder in folders.items()
        ]
        walls.append({"title": f"{log}: {record['frame']}{shift}", "cells": cells})
    return walls


def _inside(path: Path) -> str:
    """A picture as a data address."""
    return "data:image/jpeg;base64," + base64.b64encode(store.read_bytes(path)).decode("ascii")
