"""The report: one self-contained page of a finished run. Needs no network and works by double click.

Each trajectory becomes one H.264 video that holds all panels (columns: truth and methods; rows: colour, depth, classes,
colour error), so that the panels can never run apart; the page cuts them out of it.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg import native
from mudg.base import log, store
from mudg.base.processes import computed_ahead
from mudg.base.records import understood
from mudg.data.exporters.video import Encoding, jpeg_bytes, mp4_within, video_encoders
from mudg.data.observations import ObservationSet, list_observation_sets, read_observations
from mudg.pages.page import FPS, PANEL_ROWS, Adaptation, TrajectoryVideo, page
from mudg.pages.panels import panel_grid, panel_size

PANEL_WIDTH: Final = 320
BUDGET_BYTES: Final = 9 * 2**19
"""For all videos together, before base64; with the posters the page stays under 8 MB."""
VIEWER: Final = "viewer.html"
VIEWER_FOLDER: Final = "viewer_page/index.html"
SAME_TIME_S: Final = 1e-4
ROWS: Final = tuple(name for name, _ in PANEL_ROWS)
ENCODING: Final = Encoding(FPS, first_crf=33, last_crf=45, preset="veryfast")


@dataclass(frozen=True)
class Columns:
    """The observation sets of one trajectory, by column name, and which view of each stands at each frame.

    ``has_truth``: the column "truth" shows this very trajectory, not the recorded path at the same moments.
    """

    sets: Mapping[str, ObservationSet]
    indices: Mapping[str, Sequence[int]]
    frames: int
    has_truth: bool


def film(out: Path) -> list[TrajectoryVideo]:
    """The costly half of ``OUT/report.html``: one video per trajectory, from what the chain left in ``out`` (see ``stages.run``).

    Raises:
        InputError: the run is not scored yet, or a folder of views is damaged.
    """
    out = Path(out)
    with understood("a scored run", str(out)):
        scores = store.read_json(out / "score" / "metrics.json")
        folders = _folders(out, scores)
        trajectories = [t for t in scores["trajectories"] if any(t["name"] in found for found in folders.values())]
    playable = bool(video_encoders())
    if not playable:
        log.warn("PyAV has no H.264 encoder here: the report shows one picture per trajectory instead of a video")
    budget = BUDGET_BYTES // max(1, len(trajectories)) if playable else 0
    videos = computed_ahead(lambda n: _video(trajectories[n], folders, budget), len(trajectories), native.default_threads())
    return list(log.progress(videos, len(trajectories), "report"))


def write_page(out: Path, videos: Sequence[TrajectoryVideo]) -> Path:
    """The cheap half: scores, times and settings around the videos, and a link to the viewer page if there is one."""
    out = Path(out)
    settings = out / "run.yaml"
    text = store.read_text(settings) if settings.is_file() else ""
    with understood("a scored run", str(out)):
        scores, ledger = store.read_json(out / "score" / "metrics.json"), store.read_json(out / "run.json")
        content = page(scores, ledger, text, videos, list(_folders(out, scores)), _adaptation(out / "adapt"), viewer_address(out), out)
    store.write_text(out / "report.html", content)
    return out / "report.html"


def viewer_address(out: Path) -> str:
    """The viewer page of a run, relative to its folder: one file, or the first page of a folder; empty if there is none."""
    return next((name for name in (VIEWER, VIEWER_FOLDER) if (out / name).is_file()), "")


def _adaptation(folder: Path) -> Adaptation | None:
    """The adaptation in a finished folder of the verb adapt; None if there is no such folder."""
    if not (folder / store.MANIFEST).is_file():
        return None
    names = (("Before", "before.png"), ("After", "after.png"))
    pictures = [(title, _data_uri("image/png", store.read_bytes(folder / name))) for title, name in names]
    return Adaptation(store.read_json(folder / "adapt.json"), pictures)


def _folders(out: Path, scores: Mapping[str, Any]) -> dict[str, dict[str, Path]]:
    """Column name -> trajectory -> folder, in the order of the page."""
    places = {"truth": out / "score" / "truth"}
    for method in scores["methods"]:
        name = method["name"]
        candidates = (out / "render" / name, out / "score" / name, out / "synthesize")
        places[name] = next(path for path in candidates if path.is_dir() or path.name == "synthesize")
    found = {name: list_observation_sets(path) for name, path in places.items()}
    return {name: sets for name, sets in found.items() if sets}


# ---- one trajectory as one video ----


def _video(trajectory: Mapping[str, Any], folders: Mapping[str, Mapping[str, Path]], budget: int) -> TrajectoryVideo:
    """All panels of a trajectory as one video of at most ``budget`` bytes; 0 = only the picture of its middle frame."""
    columns = _columns(trajectory, folders)
    size = panel_size(int(trajectory["width"]), int(trajectory["height"]), PANEL_WIDTH)
    order = list(folders)
    video = mp4_within(lambda: _frames(columns, order, size), ENCODING, budget) if budget else b""
    poster = jpeg_bytes(next(_frames(columns, order, size, first=columns.frames // 2)), quality=60)
    return TrajectoryVideo(
        name=trajectory["name"], camera=str(trajectory["camera"]), shift_m=trajectory["shift_m"], width=size[0], height=size[1],
        frames=columns.frames, panels={column: _rows(columns, column) for column in columns.sets},
        video=_data_uri("video/mp4", video) if video else "", poster=_data_uri("image/jpeg", poster),
    )  # fmt: skip


def _columns(trajectory: Mapping[str, Any], folders: Mapping[str, Mapping[str, Path]]) -> Columns:
    """Truth and baseline have just the scored views; of the methods' views the scorer's indices pick the same.

    Where a trajectory has no truth (a shifted view of a recorded log), its column shows the recorded path at the same moments.
    """
    name, frames, picked = trajectory["name"], int(trajectory["views"]), trajectory["indices"]
    sets = {column: read_observations(found[name]) for column, found in folders.items() if name in found}
    indices: dict[str, Sequence[int]] = {c: picked[c] if c in picked else range(frames) for c in sets}
    has_truth = "truth" in sets
    recorded_folder = folders.get("truth", {}).get(f"{trajectory['camera']}_recorded")
    if not has_truth and recorded_folder is not None:
        recorded = read_observations(recorded_folder)
        column = next(iter(sets))
        wanted = np.array([sets[column].views[i].time_s for i in indices[column]])
        apart = np.abs(np.array([view.time_s for view in recorded.views])[None] - wanted[:, None])
        if apart.min(1).max() < SAME_TIME_S:
            sets = {"truth": recorded, **sets}
            indices["truth"] = apart.argmin(1).tolist()
    return Columns(sets, indices, frames, has_truth)


def _rows(columns: Columns, column: str) -> tuple[str, ...]:
    """The rows that a column has, as its first view says."""
    first = columns.sets[column][columns.indices[column][0]]
    there = {
        "rgb": True, "depth": first.depth is not None, "semantics": first.semantics is not None,
        "error": columns.has_truth and column != "truth",
    }  # fmt: skip
    return tuple(row for row in ROWS if there[row])


def _frames(
    columns: Columns, order: Sequence[str], size: tuple[int, int], first: int = 0
) -> Iterator[NDArray[np.uint8]]:
    """One picture per frame: columns in page order, rows of ``ROWS``; what a method does not produce stays grey."""
    for frame in range(first, columns.frames):
        views = {c: columns.sets[c][columns.indices[c][frame]] if c in columns.sets else None for c in order}
        yield panel_grid(views, ROWS, size, views["truth"] if columns.has_truth else None)


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
