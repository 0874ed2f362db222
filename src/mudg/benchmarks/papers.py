"""The tables of papers: ``papers.yaml`` as checked records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

from pydantic import model_validator

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.plain_yaml import parse_yaml
from mudg.base.records import StrictRecord, checked_by, parse_record
from mudg.gaussians.methods import METHODS
from mudg.networks.inception import ResizeRule

FILE: Final = Path(__file__).with_name("papers.yaml")
RECORDED: Final = "0"
"""Name of the place that is the recorded path."""


class SceneRange(StrictRecord):
    """A segment of a dataset, by a part of its name, with its first and last frame (from 0, both included); ``side``:
    to which side one-sided shifts go (1 left, -1 right)."""

    segment: str
    first: int
    last: int
    side: int = 1


class PaperPlace(StrictRecord):
    """Where views are scored.

    Args:
        name: in result files. title: in headings. shifts_m: lateral shifts, metres, positive to the left (0 = the
            recorded path), and
        paths: further paths by name (``core.trajectory.named``); their scores are averaged.
    """

    name: str
    title: str
    shifts_m: list[float] = []
    paths: list[str] = []

    def endings(self, side: int = 1) -> tuple[str, ...]:
        """How the names of its trajectories end; ``side``: see `SceneRange`."""
        shifts = self.shifts_m if len(self.shifts_m) > 1 else [side * shift_m for shift_m in self.shifts_m]
        return (*("recorded" if not s else f"shift{s:+.1f}" for s in shifts), *self.paths)


class PaperColumn(StrictRecord):
    """A number of ``metrics.json``: its name there, heading, better side, digits, the setting of ``mudg score`` that it
    needs, and the entry of a result that holds its ``n`` (empty: the views that count)."""

    key: str
    title: str
    better: Literal["higher", "lower", "one"]
    digits: int
    needs: str = ""
    counts: Literal["", "distribution", "video"] = ""

    def values(self) -> dict[str, Any]:
        """For JSON."""
        return {"key": self.key, "title": self.title, "better": self.better, "digits": self.digits, "factor": 1.0}


class PaperRow(StrictRecord):
    """A row that is computed: a method of `METHODS`, with other settings of its fit (or of synthesize) where it is an
    ablation's."""

    name: str
    title: str
    method: str
    changes: dict[str, Any] = {}


class PublishedRow(StrictRecord):
    """What a paper prints for a method: place, column and number, and where it is printed."""

    title: str
    source: str
    values: list[tuple[str, str, float]]


class PaperTable(StrictRecord):
    """A table of a paper; the fields are explained in ``papers.yaml``. Without ``only`` every column stands at every
    place."""

    name: str
    title: str = ""
    data: str = ""
    scenes: str = ""
    places: list[PaperPlace]
    columns: list[PaperColumn]
    published: list[PublishedRow] = []
    only: dict[str, list[str]] = {}
    rows: list[PaperRow] = []
    front_only: bool = False
    all_cameras: bool = False
    held_out_every: int = 4
    size: str = ""
    resize: ResizeRule = "pytorch-fid"
    virtual_shifts_m: list[float] = []
    notes: list[str] = []

    def cells(self) -> tuple[tuple[PaperPlace, PaperColumn], ...]:
        """All places and columns, in the order of the table."""
        return tuple((p, c) for p in self.places for c in self.columns if c.key in self.only.get(p.name, (c.key,)))

    @model_validator(mode="after")
    @checked_by
    def _check(self) -> PaperTable:
        cells = [(place.name, column.key) for place, column in self.cells()]
        _refuse(set(self.only) - {place.name for place in self.places}, "only: no such place")
        _refuse({cell for cell in cells if cells.count(cell) > 1}, "a place has a column twice")
        for row in self.published:
            _refuse(
                {(place, key) for place, key, _ in row.values} - set(cells),
                f"published {row.title!r}: not in the table",
            )
        _refuse({row.method for row in self.rows} - set(METHODS), "rows: no such method")
        if self.virtual_shifts_m and any(any(place.shifts_m) or place.paths for place in self.places):
            raise InputError(
                "generated views lie at the places off the path", where="virtual_shifts_m", remedy="leave it out"
            )
        return self

    def values(self) -> dict[str, Any]:
        """For JSON, without published rows."""
        return {
            "name": self.name,
            "title": self.title,
            "data": self.data,
            "scenes": self.scenes,
            "notes": self.notes,
            "places": [
                {"name": p.name, "title": p.title, "shifts_m": p.shifts_m, "paths": p.paths} for p in self.places
            ],
            "cells": [[place.name, column.key] for place, column in self.cells()],
            "columns": [c.values() for c in self.columns],
            "held_out_every": self.held_out_every,
            "front_only": self.front_only,
            "all_cameras": self.all_cameras,
        }


class Papers(StrictRecord):
    """All of ``papers.yaml``."""

    columns: dict[str, PaperColumn]
    further: dict[Literal["exact", "measured"], list[str]]
    scene_lists: dict[str, list[SceneRange]]
    tables: dict[str, PaperTable]


def _refuse(unknown: set[Any], what: str) -> None:
    if unknown:
        raise InputError(what, got=", ".join(sorted(map(str, unknown))))


def read_papers(text: str, where: str) -> Papers:
    """The tables of a text in the form of ``papers.yaml``; names of columns and places stand for their records, and
    lines of text for published rows.

    Raises:
        InputError: it is not YAML, or not such tables.
    """
    raw = parse_yaml(text, where)
    try:
        columns = {key: {"key": key, **column} for key, column in raw["columns"].items()}
        tables = {
            name: {
                **table,
                "name": name,
                "columns": [columns[key] for key in table["columns"]],
                "places": [raw["places"][place] for place in table["places"]],
                "published": [row for group in table.get("published", ()) for row in _printed(**group)],
            }
            for name, table in raw["tables"].items()
        }
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(
            "these are no tables of papers", where=where, got=f"{type(error).__name__}: {error}"
        ) from error
    papers = parse_record(
        Papers, {**{k: v for k, v in raw.items() if k != "places"}, "columns": columns, "tables": tables}, f"{where}: "
    )
    _refuse({table.scenes for table in papers.tables.values()} - {"", *papers.scene_lists}, "scenes: no such list")
    _refuse({key for keys in papers.further.values() for key in keys} - set(columns), "further: no such column")
    return papers


def _printed(source: str, cells: str, rows: str) -> list[dict[str, Any]]:
    """Published rows from ``title | numbers`` in the order of ``cells``, each ``place:column``; ``-``: not printed."""
    keys = [tuple(cell.split(":")) for cell in cells.split()]
    records = []
    for line in rows.strip().splitlines():
        title, _, numbers = line.partition("|")
        values = [(*key, float(word)) for key, word in zip(keys, numbers.split(), strict=True) if word != "-"]
        records.append({"title": title.strip(), "source": source, "values": values})
    return records


PAPERS: Final = read_papers(store.read_text(FILE), FILE.name)
TABLES: Final[Mapping[str, PaperTable]] = PAPERS.tables
SCENE_LISTS: Final[Mapping[str, Sequence[SceneRange]]] = PAPERS.scene_lists
