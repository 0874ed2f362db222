"""Pages of benchmarks: tables, and pictures or videos that hold all methods side by side.

Pages of ``shift`` and ``paper`` name their pictures, which are files beside them (``<log>/film/<trajectory>.jpg`` and
``.mp4``); those of ``real`` and ``edit`` hold them.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import html, store
from mudg.base.errors import InputError
from mudg.base.run_folder import RunDir
from mudg.base.types import Trajectory
from mudg.core.pictures import resize_area
from mudg.formats.exporters.video import Encoding, jpeg_bytes, mp4_within, video_encoders
from mudg.scene.observations import ObservationSet, list_observation_sets, read_observations
from mudg.steps.outputs import Output
from mudg.viewer.report import FPS, panel_grid, panel_size, shift_title

PANEL_WIDTH: Final = 320
ENCODING: Final = Encoding(FPS, first_crf=29, last_crf=41, preset="veryfast")
VIDEO_BYTES: Final = 900 * 1024
"""A video larger than this is made anew in lower quality: eight logs of seven trajectories stay under 60 MB."""
ROWS: Final = {"rgb": "colour", "error": "colour error", "depth": "depth"}
"""Rows of a video, and their titles."""


class Film(Output):
    """Write one video and one picture per trajectory: columns truth and methods, rows as ``ROWS``."""

    version, files = 1, ("*.mp4", "*.jpg")
    views: Mapping[str, tuple[Path, ...]]
    """Column -> folders of observation folders. Where "truth" is among them, it has every trajectory; else there is no
    row of errors."""
    paths: tuple[Trajectory, ...]
    videos: bool = True
    """Off: only the pictures, of the middle view and in full size."""

    def key_settings(self) -> dict[str, Any]:
        settings = {
            "columns": list(self.views),
            "trajectories": [path.name for path in self.paths],
            "panel_width_px": PANEL_WIDTH,
        }
        return settings if self.videos else {**settings, "videos": False}

    def make(self, work: RunDir) -> dict[str, Any]:
        listed = {
            name: {k: v for one in of for k, v in list_observation_sets(one).items()} for name, of in self.views.items()
        }
        playable = self.videos and bool(video_encoders())
        for path in self.paths:
            sets = {name: read_observations(sets[path.name]) for name, sets in listed.items() if path.name in sets}
            if "truth" in self.views and "truth" not in sets:
                raise InputError("no ground truth to show", where=f"{self.views['truth'][0]}: {path.name}")
            if not sets:
                continue
            pictures = list(_frames(sets, list(self.views), range(len(path)) if playable else [len(path) // 2]))
            if playable:
                store.atomic_write(
                    work.path / f"{path.name}.mp4", mp4_within(lambda frames=pictures: frames, ENCODING, VIDEO_BYTES)
                )
            middle = pictures[len(pictures) // 2]
            poster = resize_area(middle, middle.shape[1] // 2, middle.shape[0] // 2) if self.videos else middle
            store.atomic_write(work.path / f"{path.name}.jpg", jpeg_bytes(poster, quality=75))
        return {"columns": list(self.views), "videos": playable}


def _frames(
    sets: Mapping[str, ObservationSet], order: Sequence[str], frames: Sequence[int]
) -> Iterator[NDArray[np.uint8]]:
    camera = next(iter(sets.values())).views[0].camera
    size = panel_size(camera.width, camera.height, PANEL_WIDTH)
    rows = [row for row in ROWS if row != "error" or "truth" in sets]
    for frame in frames:
        seen = {column: sets[column][frame] if column in sets else None for column in order}
        yield panel_grid(seen, rows, size, seen.get("truth"))


def inside(path: Path) -> str:
    """A picture as a data address."""
    return "data:image/jpeg;base64," + base64.b64encode(store.read_bytes(path)).decode("ascii")


def wall(title: str, pictures: Mapping[str, Path], notes: Sequence[str] = ()) -> dict[str, Any]:
    """Pictures side by side, by title, which a page holds."""
    return {
        "title": title,
        "notes": notes,
        "cells": [{"title": name, "src": inside(path)} for name, path in pictures.items()],
    }


def films(
    doc: Mapping[str, Any], columns: Sequence[str], *, videos: bool, exact: bool = True, choice: bool = False
) -> dict[str, Any]:
    """Values of a page's section with the films of all logs; with a choice among them, the largest shift to the left
    comes first."""
    named = [(entry["log"], name) for entry in doc["logs"] for name in entry["films"]]
    titles = {name: shift_title(_shift_of(name), name) if choice else name for _, name in named}
    names = sorted(titles, key=_shift_of)
    return {
        "title": "Rendered views",
        "columns": columns,
        "videos": videos,
        "panel_rows": [title for row, title in ROWS.items() if row != "error" or exact],
        "films": [{"log": log, "name": name, "title": titles[name]} for log, name in named],
        "log_choices": [entry["log"] for entry in doc["logs"] if entry["films"]] if choice else [],
        "shift_choices": (
            [{"name": name, "title": titles[name], "selected": name == names[-1]} for name in names] if choice else []
        ),
    }


def _shift_of(name: str) -> float:
    _, _, shift = name.partition("_shift")
    return float(shift) if shift else 0.0


def render(title: str, command: str, lead: str, sections: Sequence[Mapping[str, Any]], footer: str = "") -> str:
    """A page.

    Args:
        command: what makes it. lead: first sentence. sections: each with ``title``, and any of ``tables``
            (``report.tables.TextTable``), ``notes`` above and ``below`` them, the values of `films`, and ``walls``.
            footer: where the pictures lie.
    """
    usual = {"tables": (), "notes": (), "below": (), "films": (), "walls": (), "log_choices": (), "shift_choices": ()}
    return html.render(
        "bench.html.j2",
        title=title,
        kicker=command,
        lead=lead,
        footer=footer,
        sections=[{**usual, **section} for section in sections],
    )
