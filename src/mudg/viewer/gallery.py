"""``mudg report``: one page over many finished runs. A run that cannot be read is listed with its reason; the others go
on."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from PIL import Image, UnidentifiedImageError

from mudg.base import html, log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.records import understood
from mudg.base.run_folder import ResultFile
from mudg.fleet.plan import BOOKKEEPING
from mudg.scoring.tables import TERMINAL_METRICS, number_text
from mudg.viewer.report import data_uri, duration, viewer_address

THUMBNAIL_PX: Final = 320, 120
"""Width of the pictures on cards, and where there are more than `MANY` runs."""
MANY: Final = 200


@dataclass(frozen=True)
class GalleryEntry:
    """A finished folder on the page. ``kind``: what made it: run, score or bench. ``scores``: its metrics.json, None of
    a benchmark. ``facts``: words below its name. ``picture``: of a rendered view. ``pages``: title -> file, those that
    are there are linked."""

    folder: Path
    kind: str
    scores: Mapping[str, Any] | None = None
    facts: str = ""
    picture: Path | None = None
    pages: Mapping[str, Path] = field(default_factory=dict)


def read_shown(folder: Path) -> GalleryEntry:
    """What a folder of ``mudg run``, ``mudg score`` or ``mudg bench`` holds. InputError: it is none of them,
    unfinished, or damaged."""
    if not folder.is_dir():
        raise InputError("no such folder", where=str(folder))
    with understood("a finished run", str(folder)):
        entry = _read(folder)
        page([replace(entry, picture=None)], {}, folder / "page.html")  # what cannot be shown ends here
    return entry


def _read(folder: Path) -> GalleryEntry:
    if (folder / "bench.json").is_file():
        found = store.read_json(folder / "bench.json")
        name = str(found.get("bench", "")) if isinstance(found, dict) else ""
        return GalleryEntry(folder, f"bench {name}".strip(), pages={"tables": folder / "bench.md"})
    state = store.read_json(folder / store.RUN_STATE) if (folder / store.RUN_STATE).is_file() else {}
    state = state if isinstance(state, dict) else {}
    asked = state.get("asked", {})
    is_run = isinstance(asked, dict) and asked.get("verb") == "run"
    if not is_run and state.get("verb") != "score":
        raise InputError("not a folder of mudg run, score or bench", where=str(folder))
    if state.get("state") != "complete":
        got, remedy = str(state.get("state"))[:40], "repeat its command: it resumes"
        raise InputError("the run is not finished", where=str(folder), got=got, remedy=remedy)
    file = folder / "score" / "metrics.json" if is_run else folder / "metrics.json"
    scores = store.read_json(file)
    if not isinstance(scores, dict) or not {"scene", "methods", "metrics", "by_distance"} <= scores.keys():
        expected, remedy = "what mudg score wrote", "score the run again"
        raise InputError("the scores are malformed", where=str(file), expected=expected, remedy=remedy)
    if not is_run:
        return GalleryEntry(folder, "score", scores)
    taken = duration(sum(float(step.get("seconds", 0)) for step in state.get("steps", {}).values()))
    pages = {"report": folder / "report.html", "viewer": folder / viewer_address(folder)}
    pages["scores"] = folder / "score" / "metrics.md"
    return GalleryEntry(folder, "run", scores, taken, _picture(folder), pages)


def _picture(folder: Path) -> Path | None:
    """A rendered view of the last method: the middle of its first trajectory."""
    for views in sorted((folder / "render").glob("*"), reverse=True):
        for trajectory in sorted(views.glob("*_recorded")) or sorted(views.glob("*")):
            pictures = sorted((trajectory / "rgb").glob("*.png"))
            if pictures:
                return pictures[len(pictures) // 2]
    return None


# ---- the page ----


def page(shown: Sequence[GalleryEntry], unread: Mapping[Path, str], out: Path) -> str:
    """The whole page. Links are relative to ``out``, the file that it becomes; pictures lie inside. ``shown``: in this
    order. ``unread``: folders that are listed with the reason why they are not shown."""
    names = _names([one.folder for one in shown])
    width = THUMBNAIL_PX[len(shown) > MANY]
    cards = [_card(one, name, out, width) for one, name in zip(shown, names, strict=True)]
    found = {m["name"]: m for one in shown if one.scores is not None for m in one.scores["metrics"]}
    metrics = [found[name] for name in TERMINAL_METRICS if name in found]
    rows = [row for one, name in zip(shown, names, strict=True) for row in _rows(one, name, metrics)]
    return html.render(
        "gallery.html.j2",
        title="Runs",
        kicker="mudg report",
        lead=f"{len(shown)} finished runs, {len(rows)} rows of scores.",
        cards=cards,
        metrics=[{"title": m["title"], "unit": m["unit"], "better": m["better"]} for m in metrics],
        rows=rows,
        places=list(dict.fromkeys(row["place"] for row in rows)),
        unread=[{"name": str(folder), "reason": reason} for folder, reason in unread.items()],
    )


def _names(folders: Sequence[Path]) -> list[str]:
    """The last parts of the folders' paths, as many as tell them apart."""
    parts = [Path(os.path.abspath(folder)).parts for folder in folders]
    count = next(n for n in range(1, 99) if n == 98 or len({part[-n:] for part in parts}) == len(parts))
    return ["/".join(part[-count:]) for part in parts]


def _card(one: GalleryEntry, name: str, out: Path, width: int) -> dict[str, Any]:
    scene = {} if one.scores is None else one.scores["scene"]
    frames = f"{scene['frames']} frames of {len(scene['cameras'])} cameras" if scene else ""
    facts = [one.kind, scene.get("id", ""), scene.get("dataset", ""), frames, one.facts]
    address = lambda path: quote(os.path.relpath(path, out.parent).replace(os.sep, "/"))
    links = [{"title": title, "href": address(path)} for title, path in one.pages.items() if path.is_file()]
    shown = [str(fact) for fact in facts if fact]
    return {"name": name, "facts": shown, "links": links, "picture": _thumbnail(one.picture, width)}


def _thumbnail(picture: Path | None, width: int) -> str:
    """A small picture as a data address; empty where there is none that can be read."""
    if picture is None:
        return ""
    try:
        image = Image.open(io.BytesIO(store.read_bytes(picture))).convert("RGB")
    except (InputError, UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError):
        return ""
    image.thumbnail((width, width))
    content = io.BytesIO()
    image.save(content, "JPEG", quality=80)
    return data_uri("image/jpeg", content.getvalue())


def _rows(one: GalleryEntry, name: str, metrics: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    if one.scores is None:
        return []
    titles = {method["name"]: method["title"] for method in one.scores["methods"]}
    rows = []
    for entry in sorted(one.scores["by_distance"], key=lambda e: float(e["distance_m"])):
        distance, values = float(entry["distance_m"]), [entry["values"].get(metric["name"]) for metric in metrics]
        if not any(isinstance(value, float) for value in values):
            continue
        cells = [
            {"text": number_text(metric["name"], value), "value": value}
            if isinstance(value, float)
            else {"text": "", "value": ""}
            for metric, value in zip(metrics, values, strict=True)
        ]
        place = "recorded path" if distance == 0 else f"{distance:g} m aside"
        words = {"run": name, "scene": str(one.scores["scene"]["id"]), "place": place}
        rows.append({**words, "method": str(titles.get(entry["method"], entry["method"])), "cells": cells})
    return rows


def run(runs: Sequence[Path], out: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """Write the page of finished runs, scores and benchmarks (``_folders``); returns ``page``, the file, ``shown``, how
    many folders are on it, and ``text``. UsageError: another page is there, or the output is no HTML file. InputError:
    nothing can be shown."""
    out = Path(out)
    if out.suffix != ".html":
        raise UsageError("the page is an HTML file", where="--out", expected="a name that ends in .html", got=str(out))
    shown: list[GalleryEntry] = []
    unread: dict[Path, str] = {}
    for folder in _folders(runs):
        try:
            shown.append(read_shown(folder))
        except InputError as error:
            log.warn(f"{folder}: {error.what}")
            unread[folder] = error.what if not error.got else f"{error.what}: {error.got}"
        except PermissionError as error:
            log.warn(f"{folder}: access was refused")
            unread[folder] = f"access was refused: {error.filename}"
    if not shown:
        where, got = ", ".join(map(str, [*unread][:4])), dict.fromkeys([*unread.values()][:4])
        expected = "folders of mudg run, score or bench"
        raise InputError("no finished run to show", where=where, got="; ".join(got), expected=expected)
    content = page(shown, unread, out.resolve()).encode()
    with ResultFile.open(out, "report", {}, {"page": hashlib.sha256(content).hexdigest()}, overwrite=overwrite) as file:
        if file.complete:
            file.reused()
        else:
            store.atomic_write(file.staged(), content)
            file.finish({"runs": len(shown)})
    left = f", {len(unread)} not shown" if unread else ""
    text = f"page: {out.resolve()} ({len(shown)} runs{left}, {len(content) / 1e6:.1f} MB)"
    return {"page": out, "shown": len(shown), "text": text}


def _folders(runs: Sequence[Path]) -> list[Path]:
    """The folders asked for, each once; a folder that is no run stands for the folders in it, one of ``mudg batch`` for
    the runs of its logs."""
    found: list[Path] = []
    for given in map(Path, runs):
        own = any((given / name).is_file() for name in (store.RUN_STATE, "bench.json"))
        pattern = "*/run/*" if (given / BOOKKEEPING).is_dir() else "*"
        below = [] if own or not given.is_dir() else sorted(given.glob(pattern))
        inside = [one for one in below if one.is_dir() and not one.name.startswith((".", "_"))]
        found += [one for one in inside or [given] if one.resolve() not in {known.resolve() for known in found}]
    return found
