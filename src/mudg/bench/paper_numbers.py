"""Numbers of ``mudg bench paper``: values of a log at a place, means over logs with standard errors, equal numbers of views. No torch.

A cell is a number or the reason why there is none. A mean over logs is one over all of them: a method that lacks a number on one
log has none in that cell, for means over other logs could not be compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean
from types import MappingProxyType
from typing import Any, Final

from mudg.base.errors import InputError
from mudg.bench.paper_tables import Better, PaperColumn, PaperTable, further_columns
from mudg.bench.shift_tables import standard_error
from mudg.report.score_tables import NO_TRUTH, NOT_COMPUTED, SET_METRICS

TRUTH, FILL = "truth", "nearest_fill"
ANCHORS: Final = {TRUTH: "the truth itself", FILL: "fused points, holes filled"}
"""Rows that every table has, with their titles; the first is no method and enters no ranking."""
BY_DEFINITION: Final = frozenset({"psnr", "ssim", "psnr_movers", "lpips", "perceptual", "abs_rel", "miou"})
"""Columns that compare view with view: the truth against itself says nothing there."""
SELF: Final = "perfect by definition"
NOT_SCORED: Final = "no score of this version"
OTHER_N: Final = "other n"
EXACT_TITLE, MEASURED_TITLE = "Exact truth", "Measured at LiDAR points and in recorded frames"
"""Titles of the further columns."""


# ---- one log ----


def at_place(
    documents: Sequence[Mapping[str, Any]], names: Sequence[str], columns: Sequence[PaperColumn]
) -> dict[str, dict[str, Any]]:
    """Values of one method on one log at a place: key -> ``{"value": number or reason, "n", "n_reference"}``.

    Args:
        documents: contents of ``metrics.json`` that hold its trajectories, one method each.
        names: trajectories of the place; the mean over them, and the sum of their numbers of views.
    """
    results = {row["trajectory"]: row for document in documents for row in document["results"]}
    here = [results.get(name) for name in names]
    known = {metric["name"] for document in documents for metric in document["metrics"]}
    return {column.key: _value(column, here, column.key in known) for column in columns}


def _value(column: PaperColumn, rows: Sequence[Mapping[str, Any] | None], known: bool) -> dict[str, Any]:
    if not known:
        return {"value": NOT_SCORED}
    given = [None if row is None else row["values"].get(column.key, NOT_COMPUTED) for row in rows]
    reasons = [v for v in given if isinstance(v, str)]
    if reasons or None in given:
        return {"value": _reason(column, reasons[0] if reasons else "not produced")}
    found: dict[str, Any] = {"value": fmean(given)}  # type: ignore[type-var]
    counts = [row if not column.counts else row.get(column.counts, {}) for row in rows if row is not None]
    found["n"] = sum(int(of["n" if column.counts else "views"]) for of in counts)
    if column.counts:
        found["n_reference"] = sum(int(of["n_reference"]) for of in counts)
    return found


def _reason(column: PaperColumn, reason: str) -> str:
    if reason == NOT_COMPUTED and column.needs:
        what = "no weights" if column.needs.endswith("_weights") else "not given"
        return f"{what}: --score.{column.needs.replace('_', '-')}"
    return "no truth off the path on a recorded log" if reason == NO_TRUTH else reason


def floors_at(
    documents: Sequence[Mapping[str, Any]], names: Sequence[str], columns: Sequence[PaperColumn]
) -> dict[str, dict[str, Any]]:
    """What the truth itself scores on a recorded log at a place: the scorer's floors, for measures of sets of views alone."""
    found: dict[str, dict[str, Any]] = {}
    for column in columns:
        entry = SET_METRICS.get(column.key, "")
        floors = {f["trajectory"]: f for document in documents for f in document.get(entry, {}).get("floors", [])}
        here = [floors[name] for name in names if name in floors]
        if here and len(here) == len(names):
            n, reference = sum(f["n"] for f in here), sum(f["n_reference"] for f in here)
            found[column.key] = {"value": fmean(f[column.key] for f in here), "n": n, "n_reference": reference}
        else:
            missing = SELF if column.key in BY_DEFINITION else NOT_COMPUTED if entry else NO_TRUTH
            found[column.key] = {"value": _reason(column, missing)}
    return found


def made_of(documents: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """How distances of sets were made: networks, digests of their weights, resize rules, epsilon, clips."""
    found: dict[str, Any] = {"depth_rule": documents[0]["rules"][3] if len(documents[0]["rules"]) > 3 else ""}
    for document in documents:
        for entry in dict.fromkeys(SET_METRICS.values()):
            if document.get(entry):
                found[entry] = {name: value for name, value in document[entry].items() if name not in ("floors", "sets")}
    return found


# ---- all logs ----


def document(
    table: PaperTable, logs: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]], settings: Mapping[str, Any],
    pooled: Mapping[str, Mapping[str, Mapping[str, Mapping[str, Any]]]] = MappingProxyType({}),
) -> dict[str, Any]:  # fmt: skip
    """Everything ``bench.json`` holds.

    Args:
        logs: per log its facts, ``exact``, ``values[row][place][key]`` as from `at_place`, ``made``, ``films``, ``columns``, seconds.
        rows: name, title, method and changes of what was computed. settings: of the benchmark.
        pooled: row -> place -> metric -> mean and standard error of the sets of all logs together, where there are such.

    Raises:
        InputError: methods have different numbers of views.
    """
    exact = all(entry["exact"] for entry in logs)
    every = [*({"name": name, "title": title, "method": "", "changes": {}} for name, title in ANCHORS.items()), *rows]
    main = [(place.name, column) for place, column in table.cells()]
    columns = further_columns(exact)
    further = [(place.name, column) for place in table.places for column in columns]
    of_sets = lambda row, place, key: pooled.get(row, {}).get(place, {}).get(key)  # noqa: E731
    cells = {
        row["name"]: {place: {c.key: _cell(logs, row["name"], place, c, of_sets(row["name"], place, c.key))
                              for p, c in (*main, *further) if p == place}
                      for place in dict.fromkeys(p for p, _ in main)}
        for row in every
    }  # fmt: skip
    _equalise(cells, main + further)
    ranked = [row["name"] for row in every if row["name"] != TRUTH]
    best: dict[str, dict[str, list[str]]] = {}
    for place, column in (*main, *further):
        here = {name: cells[name][place][column.key] for name in ranked}
        best.setdefault(place, {})[column.key] = best_of(column.better, here, column.digits, column.factor)
    return {
        "schema": 1, "bench": "paper", "table": values_of(table), "exact": exact, "settings": dict(settings), "rows": every,
        "cells": cells, "best": best, "further": [_column_values(c) for c in columns],
        "further_title": EXACT_TITLE if exact else MEASURED_TITLE,
        "published": [
            {"title": row.title, "source": row.source, "values": [[*key, value] for key, value in row.values.items()]}
            for row in table.published
        ],
        "made": logs[0]["made"], "logs": [dict(entry) for entry in logs],
    }  # fmt: skip


def _cell(
    logs: Sequence[Mapping[str, Any]], row: str, place: str, column: PaperColumn, pooled: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Mean over all logs, or the value of their ``pooled`` sets; or the reason why there is none."""
    found = [entry["values"][row][place].get(column.key, {"value": NOT_SCORED}) for entry in logs]
    if row == TRUTH and column.key in BY_DEFINITION:
        return {"reason": SELF}
    reasons = [one["value"] for one in found if isinstance(one["value"], str)]
    if reasons:
        few = f" ({len(reasons)} of {len(found)} logs)" if len(reasons) < len(found) else ""
        return {"reason": reasons[0] + few}
    numbers = [one["value"] for one in found]
    reference = {"n_reference": [one["n_reference"] for one in found]} if "n_reference" in found[0] else {}
    return {
        "mean": fmean(numbers), "standard_error": standard_error(fmean, numbers), "logs": len(numbers), "n": [one["n"] for one in found],
        **reference, **({} if pooled is None else {**pooled, "mean_over_logs": fmean(numbers)}),
    }  # fmt: skip


def _equalise(cells: dict[str, dict[str, dict[str, Any]]], columns: Sequence[tuple[str, PaperColumn]]) -> None:
    """Refuse methods with different numbers of views in a column; a floor with another number is left out of the table, with the reason.

    Raises:
        InputError: they differ.
    """
    for place, column in columns:
        counts = {name: of[place][column.key].get("n") for name, of in cells.items()}
        wanted = {tuple(n) for name, n in counts.items() if n is not None and name != TRUTH}
        if len(wanted) > 1:
            got = ", ".join(f"{name}: {sum(n)}" for name, n in counts.items() if n is not None and name != TRUTH)
            raise InputError(
                "methods with different numbers of views cannot stand in one table", where=f"{column.title} at {place}",
                expected="the same n on every log", got=got, remedy="make the table anew with --overwrite",
            )  # fmt: skip
        floor = counts.get(TRUTH)
        if floor is not None and wanted and tuple(floor) not in wanted:
            cells[TRUTH][place][column.key] = {"reason": OTHER_N, "floor": cells[TRUTH][place][column.key]}


def best_of(better: Better, cells: Mapping[str, Mapping[str, Any]], digits: int, factor: float) -> list[str]:
    """Rows whose printed number is the best one; none where fewer than two have a number."""
    numbers = {name: round(cell["mean"] * factor, digits) for name, cell in cells.items() if "mean" in cell}
    if len(numbers) < 2:
        return []
    apart = {
        name: {"higher": -number, "lower": number, "one": abs(number - 1)}[better] for name, number in numbers.items()
    }
    return [name for name, number in apart.items() if number == min(apart.values())]


def values_of(table: PaperTable) -> dict[str, Any]:
    """A table as JSON values, without its published rows."""
    return {
        "name": table.name, "title": table.title, "data": table.data, "scenes": table.scenes, "notes": list(table.notes),
        "places": [{"name": p.name, "title": p.title, "shifts_m": list(p.shifts_m), "paths": list(p.paths)} for p in table.places],
        "cells": [[place.name, column.key] for place, column in table.cells()], "columns": [_column_values(c) for c in table.columns],
        "held_out_every": table.held_out_every, "front_only": table.front_only, "all_cameras": table.all_cameras,
    }  # fmt: skip


def _column_values(column: PaperColumn) -> dict[str, Any]:
    return {
        "key": column.key,
        "title": column.title,
        "better": column.better,
        "digits": column.digits,
        "factor": column.factor,
    }
