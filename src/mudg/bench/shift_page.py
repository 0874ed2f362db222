"""The page of ``mudg bench shift``: tables, and per log and trajectory one video that holds all methods side by side.

The videos are files beside the page (``<log>/film/<trajectory>.mp4``); the page itself loads nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.run_folder import RunDir, VerbOutput, refuse_overlap
from mudg.base.types import Trajectory
from mudg.bench import shift_tables as tables
from mudg.core.pictures import resize_area
from mudg.data.exporters.video import Encoding, jpeg_bytes, mp4_within, video_encoders
from mudg.data.observations import ObservationSet, list_observation_sets, read_observations
from mudg.report import html
from mudg.report.page import FPS, shift_title
from mudg.report.panels import panel_grid, panel_size

SHOWN: Final = ("nearest_fill", "gs3d", "street_gaussians", "mudg_r", "mudg_s")
PANEL_WIDTH: Final = 320
ENCODING: Final = Encoding(FPS, first_crf=29, last_crf=41, preset="veryfast")
VIDEO_BYTES: Final = 900 * 1024
"""A video larger than this is made anew in lower quality: eight logs of seven trajectories stay under 60 MB."""
ROWS: Final = {"rgb": "colour", "error": "colour error", "depth": "depth"}
"""Rows of a video, and their titles."""
_OUTPUT: Final = VerbOutput("film", 1, ("*.mp4", "*.jpg"))


# ---- videos ----


def film(
    views: Mapping[str, Path | Sequence[Path]], paths: Sequence[Trajectory], out: Path, *, videos: bool = True, overwrite: bool = False
) -> Path:  # fmt: skip
    """Write one video and one picture per trajectory: columns truth and methods, rows as ``ROWS``.

    Args:
        views: column -> folder of observation folders, or several. Where "truth" is among them, it has every trajectory; else there is
            no row of errors.
        videos: off: only the pictures, of the middle view and in full size.
    """
    folders = {name: (given,) if isinstance(given, Path) else tuple(given) for name, given in views.items()}
    named = {f"{name} {n}" if n else name: folder for name, of in folders.items() for n, folder in enumerate(of)}
    refuse_overlap(out, named)
    inputs = {name: store.digest(folder) for name, folder in named.items()}
    asked: dict[str, Any] = {"columns": list(views), "trajectories": [path.name for path in paths], "panel_width_px": PANEL_WIDTH}
    folder = RunDir.open(out, _OUTPUT, asked if videos else {**asked, "videos": False}, inputs, overwrite)
    if folder.complete:
        return folder.reused()
    found = {
        name: {k: v for one in of for k, v in list_observation_sets(one).items()} for name, of in folders.items()
    }
    playable = videos and bool(video_encoders())
    for path in paths:
        sets = {name: read_observations(listed[path.name]) for name, listed in found.items() if path.name in listed}
        if "truth" in views and "truth" not in sets:
            raise InputError("no ground truth to show", where=f"{views['truth']}: {path.name}")
        if not sets:
            continue
        numbers = range(len(path)) if playable else [len(path) // 2]
        pictures = list(_frames(sets, list(views), numbers))
        if playable:
            store.atomic_write(folder.path / f"{path.name}.mp4", mp4_within(lambda made=pictures: made, ENCODING, VIDEO_BYTES))
        middle = pictures[len(pictures) // 2]
        poster = resize_area(middle, middle.shape[1] // 2, middle.shape[0] // 2) if videos else middle
        store.atomic_write(folder.path / f"{path.name}.jpg", jpeg_bytes(poster, quality=75))
    folder.finish({"columns": list(views), "videos": playable})
    return folder.path


def _frames(sets: Mapping[str, ObservationSet], order: Sequence[str], frames: Sequence[int]) -> Iterator[NDArray[np.uint8]]:
    camera = next(iter(sets.values())).views[0].camera
    size = panel_size(camera.width, camera.height, PANEL_WIDTH)
    rows = [row for row in ROWS if row != "error" or "truth" in sets]
    for frame in frames:
        seen = {column: sets[column][frame] if column in sets else None for column in order}
        yield panel_grid(seen, rows, size, seen.get("truth"))


# ---- the page ----


def page(doc: Mapping[str, Any]) -> str:
    """The whole page from what ``bench.json`` holds."""
    settings = doc["settings"]
    *places, mean = tables.places_of(doc)
    names = [row["name"] for row in doc["methods"]]
    return html.render(
        "shift.html.j2", title=f"Off the recorded path: {tables.logs_text(doc)}, {settings['list']} list", kicker="mudg bench shift",
        lead=f"Generated logs of {settings['frames']} frames with exact ground truth at every view; {settings['iterations']} iterations "
        f"per fit, {tables.further_of(settings)}. Means over logs and both sides of the path.",
        comparisons=[[c["title"], *tables.compared_text(c), c["kind"], c["logs"]] for c in doc["comparisons"]],
        score_heads=["method", *(heading for _, heading, _ in tables.COLUMNS)],
        places=[
            {"title": tables.place_title(doc, place), "rows": [[n, *tables.score_cells(doc, n, place, with_error=True)] for n in names]}
            for place in (mean, *places)
        ],
        log_heads=tables.FACTS, logs=[tables.facts_of(entry) for entry in doc["logs"]], **_video_values(doc),
    )  # fmt: skip


def _video_values(doc: Mapping[str, Any]) -> dict[str, Any]:
    """The videos, and what the reader can choose among them; the largest shift to the left comes first."""
    videos = [(entry["log"], name) for entry in doc["logs"] for name in entry["films"]]
    names = sorted({name for _, name in videos}, key=_shift_of)
    return {
        "videos": [{"log": log, "name": name, "title": _shift_title(name)} for log, name in videos],
        "columns": ["truth", *(r["name"] for r in doc["methods"] if r["name"] in SHOWN)],
        "panel_rows": ROWS.values(),
        "log_choices": [entry["log"] for entry in doc["logs"] if entry["films"]],
        "shift_choices": [{"name": name, "title": _shift_title(name), "selected": name == names[-1]} for name in names],
    }


def _shift_of(name: str) -> float:
    _, _, shift = name.partition("_shift")
    return float(shift) if shift else 0.0


def _shift_title(name: str) -> str:
    return shift_title(_shift_of(name), name)
