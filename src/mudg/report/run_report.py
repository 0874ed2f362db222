"""The report: one self-contained page of a finished run. Needs no network and works by double click.

Each trajectory becomes one H.264 video that holds all panels (columns: truth and methods; rows: colour, depth, classes,
colour error), so that the panels can never run apart; the page cuts them out of it.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg import native
from mudg.base import log, store
from mudg.base.types import Observation
from mudg.core.pictures import error_image, resize_nearest, resize_rgb, to_bytes
from mudg.data.exporters.video import depth_colors, mp4_bytes, semantic_colors, video_encoders
from mudg.data.observations import ObservationSet, list_observation_sets, read_observations
from mudg.report.page import FAR_M, NEAR_M, Reel, page

PANEL_WIDTH: Final = 416
BUDGET_BYTES: Final = 16 * 2**20
"""For all videos together, before base64; the page stays under 25 MB."""
FPS: Final = 10
SAME_TIME_S: Final = 1e-4
ROWS: Final = ("rgb", "depth", "semantics", "error")
FIRST_CRF, LAST_CRF = 27, 45


@dataclass(frozen=True)
class Columns:
    """The observation sets of one trajectory, by column name, and which view of each stands at each frame.

    ``has_truth``: the column "truth" shows this very trajectory, not the recorded path at the same moments.
    """

    sets: Mapping[str, ObservationSet]
    indices: Mapping[str, Sequence[int]]
    frames: int
    has_truth: bool


def write_report(out: Path) -> Path:
    """Write ``OUT/report.html`` from what the chain left in ``out`` (see ``stages.run``).

    Raises:
        InputError: the run is not scored yet, or a folder of views is damaged.
    """
    return write_page(out, film(out))


def film(out: Path) -> list[Reel]:
    """The costly half of a report: one video per trajectory. Raises as ``write_report``."""
    out = Path(out)
    scores = store.read_json(out / "score" / "metrics.json")
    folders = _folders(out, scores)
    playable = bool(video_encoders())
    if not playable:
        log.warn("PyAV has no H.264 encoder here: the report shows one picture per trajectory instead of a video")
    courses = [course for course in scores["trajectories"] if any(course["name"] in of for of in folders.values())]
    budget = BUDGET_BYTES // max(1, len(courses))
    with log.task("report", len(courses)) as bar, ThreadPoolExecutor(native.default_threads()) as pool:

        def make(course: Mapping[str, Any]) -> Reel:
            reel = _reel(course, folders, playable, budget)
            bar.advance()
            return reel

        return list(pool.map(make, courses))


def write_page(out: Path, reels: Sequence[Reel]) -> Path:
    """The cheap half: scores, times and settings around the videos."""
    out = Path(out)
    scores = store.read_json(out / "score" / "metrics.json")
    ledger = store.read_json(out / "run.json")
    columns = list(_folders(out, scores))
    store.write_text(out / "report.html", page(scores, ledger, _settings(out), reels, columns))
    return out / "report.html"


def _settings(out: Path) -> str:
    path = out / "run.yaml"
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def _folders(out: Path, scores: Mapping[str, Any]) -> dict[str, dict[str, Path]]:
    """Column name -> trajectory -> folder, in the order of the page."""
    places = {"truth": out / "score" / "truth"}
    for method in scores["methods"]:
        name = method["name"]
        candidates = (out / "render" / name, out / "score" / name, out / "synthesize")
        places[name] = next(path for path in candidates if path.is_dir() or path.name == "synthesize")
    found = {name: list_observation_sets(path) for name, path in places.items()}
    return {name: of for name, of in found.items() if of}


# ---- one trajectory as one video ----


def _reel(course: Mapping[str, Any], folders: Mapping[str, Mapping[str, Path]], playable: bool, budget: int) -> Reel:
    name = course["name"]
    columns = _columns(course, folders)
    width = min(PANEL_WIDTH, int(course["width"])) // 2 * 2
    height = max(2, round(int(course["height"]) * width / int(course["width"])) // 2 * 2)
    panels = {column: tuple(_modalities(columns, column)) for column in columns.sets}
    order = list(folders)
    video, crf = b"", FIRST_CRF
    while playable:
        video = mp4_bytes(_atlases(columns, order, panels, width, height), FPS, crf, "veryfast")
        if len(video) <= budget or crf >= LAST_CRF:
            break
        # Six steps of the quality halve the size, about.
        crf = min(LAST_CRF, crf + max(1, math.ceil(6 * math.log2(len(video) / budget))))
    middle = columns.frames // 2
    poster = _jpeg(next(_atlases(columns, order, panels, width, height, first=middle)))
    return Reel(
        name=name, camera=str(course["camera"]), shift_m=course["shift_m"], width=width, height=height,
        frames=columns.frames, panels=panels, video=_data_uri("video/mp4", video) if video else "",
        poster=_data_uri("image/jpeg", poster),
    )  # fmt: skip


def _columns(course: Mapping[str, Any], folders: Mapping[str, Mapping[str, Path]]) -> Columns:
    """Truth and baseline have just the scored views; of the methods' views the scorer's indices pick the same.

    Where a trajectory has no truth (a shifted view of a recorded log), its column shows the recorded path at the same moments.
    """
    name, frames, picked = course["name"], int(course["views"]), course["indices"]
    sets = {column: read_observations(of[name]) for column, of in folders.items() if name in of}
    indices: dict[str, Sequence[int]] = {c: picked[c] if c in picked else range(frames) for c in sets}
    has_truth = "truth" in sets
    driven = folders.get("truth", {}).get(f"{course['camera']}_recorded")
    if not has_truth and driven is not None:
        recorded = read_observations(driven)
        column = next(iter(sets))
        wanted = np.array([sets[column].views[i].time_s for i in indices[column]])
        apart = np.abs(np.array([view.time_s for view in recorded.views])[None] - wanted[:, None])
        if apart.min(1).max() < SAME_TIME_S:
            sets = {"truth": recorded, **sets}
            indices["truth"] = apart.argmin(1).tolist()
    return Columns(sets, indices, frames, has_truth)


def _modalities(columns: Columns, column: str) -> Iterator[str]:
    first = columns.sets[column][columns.indices[column][0]]
    yield "rgb"
    if first.depth is not None:
        yield "depth"
    if first.semantics is not None:
        yield "semantics"
    if columns.has_truth and column != "truth":
        yield "error"


def _atlases(
    columns: Columns, order: Sequence[str], panels: Mapping[str, Sequence[str]], width: int, height: int, first: int = 0
) -> Iterator[NDArray[np.uint8]]:
    """One picture per frame: columns in page order, rows of ``ROWS``; what a method does not produce stays grey."""
    for frame in range(first, columns.frames):
        atlas = np.full((height * len(ROWS), width * len(order), 3), 24, np.uint8)
        seen = {c: of[columns.indices[c][frame]] for c, of in columns.sets.items()}
        colours = {c: resize_rgb(o.rgb, height, width) for c, o in seen.items()}
        for x, column in enumerate(order):
            for y, row in enumerate(ROWS):
                if row in panels.get(column, ()):
                    place = atlas[y * height : (y + 1) * height, x * width : (x + 1) * width]
                    if row == "rgb":
                        place[:] = to_bytes(colours[column])
                    elif row == "error":
                        place[:] = error_image(colours[column], colours["truth"].clamp(0, 1))
                    else:
                        place[:] = _picture(seen[column], row, width, height)
        yield atlas


def _picture(seen: Observation, row: str, width: int, height: int) -> NDArray[np.uint8]:
    if row == "depth" and seen.depth is not None:
        return depth_colors(resize_nearest(seen.depth, height, width)[0].numpy(), NEAR_M, FAR_M)
    if row == "semantics" and seen.semantics is not None:
        return semantic_colors(resize_nearest(seen.semantics[None], height, width)[0].numpy())
    return np.zeros((height, width, 3), np.uint8)


def _jpeg(picture: NDArray[np.uint8]) -> bytes:
    target = io.BytesIO()
    Image.fromarray(picture).save(target, "JPEG", quality=70)
    return target.getvalue()


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
