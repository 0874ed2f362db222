"""``mudg bench paper``: a table of a paper (``papers.yaml``), filled with our numbers, on cities or recorded logs. A
cell is a number or the reason why there is none; a method that lacks a number on one log has no mean. FID, KID and FVD
compare the views of all logs at a place, as one set: a mean of the distances of small sets is mostly bias."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from statistics import fmean
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import config as configuration
from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.html import ARROWS, best_of, markdown_table
from mudg.benchmarks.chain import compare, refuse, seconds_of, standard_error, virtual_fits_of
from mudg.benchmarks.places import TRUTH, Views, first_camera, logs_of, missing_scenes, of_log, score_settings
from mudg.benchmarks.rows import FILL, PAPERS, TABLES, Facts, PaperColumn, PaperTable, Row, paper_rows, settings_of
from mudg.benchmarks.settings import BenchConfig
from mudg.core.metrics import METRICS
from mudg.scoring.sets import FEATURES_FOLDER, FEWEST, distances, video_entry
from mudg.scoring.tables import NO_TRUTH, NOT_COMPUTED, SET_METRICS
from mudg.steps.settings import PresetName

ANCHORS: Final = {TRUTH: "the truth itself", FILL: "fused points, holes filled"}
"""Rows that every table has, with their titles; the first is no method and enters no ranking."""
BY_DEFINITION: Final = frozenset({"psnr", "ssim", "psnr_movers", "lpips", "perceptual", "abs_rel", "miou"})
"""Columns that compare view with view: the truth against itself says nothing there."""
SELF: Final = "perfect by definition"
NOT_SCORED: Final = "no score of this version"
OTHER_N: Final = "other n"
POOLED: Final = ("distributions", "videos")
"""Entries of metrics.json whose sets of features, one per trajectory, are put together over all logs."""
NONE: Final = "-"
"""What stands in a column without any number; a note gives the reason once."""
Files = dict[str, dict[str, list[str]]]
"""Entry of ``POOLED`` -> files of the features "made" and of their "reference", relative to the folder of the
benchmark."""
Values = dict[str, dict[str, Any]]
"""Column -> ``{"value": number or reason, "n", "n_reference"}``."""


class PaperLog(Views):
    """One log under a table."""

    def measure(self) -> dict[str, Any]:
        """Facts of the log, per row and place the values with their numbers of views, and seconds."""
        views, truth, out = self.of_rows(), self.truth, self.out.parent
        scored = {name: self.scores(name, folders) for name, folders in views.items()}
        if truth is not None:
            scored[TRUTH] = self.scores(TRUTH, (truth,))
        places = {place.name: self.trajectories(place.endings(self.log.side)) for place in self.table.places}
        keys = {column.key: column for column in (*self.table.columns, *further_columns(truth is not None))}
        columns, fill, values, features = tuple(keys.values()), tuple(scored[FILL].values()), {}, {}
        for row, of in scored.items():
            values[row] = {place: at_place(tuple(of.values()), names, columns) for place, names in places.items()}
            features[row] = {place: files_at(of, names, out) for place, names in places.items()}
        for row in self.rows:
            if row.left_out:
                why = "the model uses no renders"
                values[row.name] = dict.fromkeys(places, {key: {"value": why} for key in keys})
        # it is not known off the path: the scorer's floors, and frames of the reference against others of it
        if truth is None:
            values[TRUTH] = {place: floors_at(fill, names, columns) for place, names in places.items()}
            features[TRUTH] = {
                place: {entry: {"made": [], "reference": of["reference"]} for entry, of in files.items()}
                for place, files in features[FILL].items()
            }
        self.film(views)
        scene = self.loaded
        sizes = dict.fromkeys(f"{camera.width}x{camera.height}" for camera in scene.cameras.values())
        names = {"log": self.log.name, "dataset": scene.source.dataset, "cameras": list(scene.cameras)}
        counts = {"frames": len(scene.frames_of(first_camera(scene, ()))), "size": ", ".join(sizes)}
        counts |= {"held_out": len(scene.frames_in("test")), "tracks": len(scene.tracks)}
        about = {"note": self.log.note, "exact": truth is not None}
        # how distances of sets were made: networks, digests of their weights, resize rules, epsilon, clips
        made: dict[str, Any] = {"depth_rule": fill[0]["rules"][3] if len(fill[0]["rules"]) > 3 else ""}
        for entry, document in product(dict.fromkeys(SET_METRICS.values()), fill):
            if of := document.get(entry):
                made[entry] = {name: value for name, value in of.items() if name not in ("floors", "sets")}
        scores = {"values": values, "features": features, "made": made}
        return {**names, **counts, **about, **scores, "seconds": seconds_of(self.out)}


def run(
    config: BenchConfig, sources: Sequence[Path], out: Path, *, preset: PresetName = "default", overwrite: bool = False
) -> Path:
    """Fill a table; returns ``out`` with ``bench.json``, the table as Markdown and CSV, and ``page.html``; what
    lies there of the same settings is reused, and logs and methods may be added later. ``sources``: ``city:reported``
    (or another list of cities), or folders of recorded logs. ``preset``: what ``config`` started from. ``overwrite``:
    replace what other settings left in ``out``. UsageError: an unknown method or list, a setting that no row of the
    table uses, or ``out`` holds something else. InputError: methods have different numbers of views. Whatever a verb
    raises."""
    table, out = TABLES[config.table], Path(out)
    rows = paper_rows(config, table, preset)
    logs = logs_of(config, sources, table)
    read = {f"log {log.name}": log.source for log in logs if isinstance(log.source, Path)}
    files = {name: value for name, value in configuration.to_dict(config.score).items() if isinstance(value, str)}
    weights = {name: at for name, at in files.items() if at and (name.endswith("weights") or Path(at).exists())}
    digests = {name: store.digest(Path(path)) for name, path in weights.items()}  # before any work: one may be missing
    refuse("paper", config, preset, rows, out, read={**read, **weights}, table=table.name)
    measured = score_settings(config, table)
    jobs, first = {}, (table, (Row(FILL, ANCHORS[FILL]), *rows), config)
    for log in logs:
        own = of_log(measured, log.name)
        jobs[log.name] = PaperLog(log, out / log.name, *first, own, overwrite).measure
    which = {"list": "" if read else str(sources[0]), "missing_scenes": missing_scenes(table, logs)}
    how = {"score": configuration.result_settings(measured), "digests": digests}
    settings = settings_of(config, preset, which, how)
    values = [{"name": r.name, "title": r.title, "method": r.method, "changes": dict(r.changes)} for r in rows]
    return compare(out, jobs, config, lambda logs: document(table, logs, values, settings, pooled(logs, out)), markdown)


def further_columns(exact: bool) -> tuple[PaperColumn, ...]:
    """The further columns of logs with or without exact truth, as far as `mudg score` has them."""
    return tuple(PAPERS.columns[key] for key in PAPERS.further["exact" if exact else "measured"] if key in METRICS)


# ---- values of one log at a place ----


def at_place(documents: Sequence[Facts], names: Sequence[str], columns: Sequence[PaperColumn]) -> Values:
    """Values of one method on one log at a place. ``documents``: contents of ``metrics.json`` that hold its
    trajectories, one method each. ``names``: trajectories of the place; the mean over them, and the sum of their
    numbers of views."""
    results = {row["trajectory"]: row for document in documents for row in document["results"]}
    rows = [results.get(name) for name in names]
    known = {metric["name"] for document in documents for metric in document["metrics"]}
    return {column.key: _value(column, rows) if column.key in known else {"value": NOT_SCORED} for column in columns}


def _value(column: PaperColumn, rows: Sequence[Facts | None]) -> dict[str, Any]:
    values = [None if row is None else row["values"].get(column.key, NOT_COMPUTED) for row in rows]
    reasons = [value for value in values if isinstance(value, str)]
    if reasons or None in values:
        return {"value": _reason(column, reasons[0] if reasons else "not produced")}
    counts = [row.get(column.counts, {}) if column.counts else row for row in rows if row is not None]
    result = {"value": fmean(values), "n": sum(int(of["n" if column.counts else "views"]) for of in counts)}
    return result | ({"n_reference": sum(int(of["n_reference"]) for of in counts)} if column.counts else {})


def _reason(column: PaperColumn, reason: str) -> str:
    if reason == NOT_COMPUTED and column.needs:
        what = "no weights" if column.needs.endswith("_weights") else "not given"
        return f"{what}: --score.{column.needs.replace('_', '-')}"
    return "no truth off the path on a recorded log" if reason == NO_TRUTH else reason


def floors_at(documents: Sequence[Facts], names: Sequence[str], columns: Sequence[PaperColumn]) -> Values:
    """What the truth itself scores on a recorded log at a place: the scorer's floors, for measures of sets of views
    alone."""
    result: Values = {}
    for column in columns:
        entry = SET_METRICS.get(column.key, "")
        floors = {f["trajectory"]: f for document in documents for f in document.get(entry, {}).get("floors", [])}
        known = [floors[name] for name in names if name in floors]
        if known and len(known) == len(names):
            value = fmean(f[column.key] for f in known)
            result[column.key] = {"value": value, **{key: sum(f[key] for f in known) for key in ("n", "n_reference")}}
        else:
            missing = SELF if column.key in BY_DEFINITION else NOT_COMPUTED if entry else NO_TRUTH
            result[column.key] = {"value": _reason(column, missing)}
    return result


# ---- sets of all logs ----


def files_at(documents: Mapping[Path, Facts], names: Sequence[str], out: Path) -> Files:
    """Files of features of one method on one log at a place; an entry that lacks a trajectory is left out.
    ``documents``: folder of scores -> its metrics.json, one method each. ``names``: trajectories of the place. ``out``:
    of the benchmark."""
    result: Files = {}
    for entry in POOLED:
        sets: dict[str, list[str]] = {}
        for folder, document in documents.items():
            for record in document.get(entry, {}).get("sets", []):
                paths = (folder / FEATURES_FOLDER / record[part] for part in ("made", "reference"))
                sets[record["trajectory"]] = [path.relative_to(out).as_posix() for path in paths]
        known = [sets[name] for name in names if name in sets]
        if known and len(known) == len(names):
            made, reference = zip(*known, strict=True)
            result[entry] = {"made": list(made), "reference": list(dict.fromkeys(reference))}
    return result


def pooled(logs: Sequence[Facts], out: Path) -> dict[str, dict[str, Values]]:
    """Cells of pooled sets, row -> place -> metric -> mean and standard error; only where every log has its features.
    ``logs``: per log its facts, with ``features[row][place]`` as from `files_at`. ``out``: folder of the benchmark."""
    result: dict[str, dict[str, Values]] = {}
    for row, places in {row: of for entry in logs for row, of in entry["features"].items()}.items():
        for place in places:
            for entry in POOLED:
                files = [one["features"].get(row, {}).get(place, {}).get(entry) for one in logs]
                if any(of is None for of in files):
                    continue
                made, reference = _sets(files, out, row == TRUTH)
                if min(len(made), len(reference)) < FEWEST:
                    continue
                cells = result.setdefault(row, {}).setdefault(place, {})
                if entry == "videos":
                    cells["fvd"] = {"mean": video_entry(made, reference)["values"]["fvd"], "standard_error": None}
                else:
                    both = distances(made, reference)
                    cells["fid"] = {"mean": round(both["fid"], 6), "standard_error": None}
                    cells["kid"] = {"mean": round(both["kid"], 6), "standard_error": both["kid_standard_error"]}
    return result


def _sets(
    files: Sequence[Mapping[str, Sequence[str]]], out: Path, is_truth: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Features f32[n, d] of all views, and of all recorded frames. Truth that was not made compares every second
    recorded frame with the others."""

    def read(part: str) -> list[Any]:
        return [store.read_safetensors(out / name)["features"] for of in files for name in of[part]]

    made, reference = read("made"), read("reference")
    if is_truth and not made:
        made, reference = [rows[::2] for rows in reference], [rows[1::2] for rows in reference]
    return np.concatenate(made), np.concatenate(reference)


# ---- all logs ----


def document(
    table: PaperTable,
    logs: Sequence[Facts],
    rows: Sequence[Facts],
    settings: Facts,
    pooled: Mapping[str, Mapping[str, Values]] = MappingProxyType({}),
) -> dict[str, Any]:
    """Everything ``bench.json`` holds. ``logs``: per log its facts, ``exact``, ``values[row][place][key]`` as from
    `at_place`, ``made``, seconds. ``rows``: name, title, method and changes of what was
    computed. ``pooled``: row -> place -> metric -> mean and standard error of the sets of all logs together, where
    there are such. InputError: methods have different numbers of views."""
    exact = all(entry["exact"] for entry in logs)
    every = [*({"name": name, "title": title, "method": "", "changes": {}} for name, title in ANCHORS.items()), *rows]
    columns = further_columns(exact)
    wanted = [(p.name, c) for p, c in table.cells()] + [(p.name, c) for p in table.places for c in columns]
    cells: dict[str, dict[str, Values]] = {row["name"]: {} for row in every}
    for row, of in cells.items():
        for place, column in wanted:
            together = pooled.get(row, {}).get(place, {}).get(column.key)
            of.setdefault(place, {})[column.key] = _cell(logs, row, place, column, together)
    best: dict[str, dict[str, list[str]]] = {}
    for place, column in wanted:
        _refuse_other_counts(cells, place, column)
        results = {row: of[place][column.key] for row, of in cells.items() if row != TRUTH}
        numbers = {row: round(of["mean"], column.digits) for row, of in results.items() if "mean" in of}
        best.setdefault(place, {})[column.key] = best_of(column.better, numbers)
    published = [{"title": r.title, "source": r.source, "values": list(map(list, r.values))} for r in table.published]
    head = {"schema": 1, "bench": "paper", "table": table.values(), "exact": exact, "settings": dict(settings)}
    numbers = {"rows": every, "cells": cells, "best": best, "further": [column.values() for column in columns]}
    title = "Exact truth" if exact else "Measured at LiDAR points and in recorded frames"
    whence = {"further_title": title, "published": published, "made": logs[0]["made"]}
    return {**head, **numbers, **whence, "logs": [dict(entry) for entry in logs]}


def _cell(logs: Sequence[Facts], row: str, place: str, column: PaperColumn, pooled: Facts | None) -> dict[str, Any]:
    """Mean over all logs, or the value of their ``pooled`` sets; or the reason why there is none."""
    values = [entry["values"][row][place].get(column.key, {"value": NOT_SCORED}) for entry in logs]
    if row == TRUTH and column.key in BY_DEFINITION:
        return {"reason": SELF}
    reasons = [one["value"] for one in values if isinstance(one["value"], str)]
    if reasons:
        few = f" ({len(reasons)} of {len(values)} logs)" if len(reasons) < len(values) else ""
        return {"reason": reasons[0] + few}
    numbers = [one["value"] for one in values]
    counts = {key: [one[key] for one in values] for key in ("n", "n_reference") if key in values[0]}
    result = {"mean": fmean(numbers), "standard_error": standard_error(fmean, numbers), "logs": len(numbers), **counts}
    return result if pooled is None else {**result, **pooled, "mean_over_logs": fmean(numbers)}


def _refuse_other_counts(cells: dict[str, dict[str, Values]], place: str, column: PaperColumn) -> None:
    """Refuse methods with different numbers of views in a column; a floor with another number is left out of the table,
    with the reason. InputError: they differ."""
    counts = {name: of[place][column.key].get("n") for name, of in cells.items()}
    floor = counts.pop(TRUTH)
    wanted = {tuple(n) for n in counts.values() if n is not None}
    if len(wanted) > 1:
        what, where = "methods with different numbers of views cannot stand in one table", f"{column.title} at {place}"
        expected = "the same n on every log"
        got = ", ".join(f"{name}: {sum(n)}" for name, n in counts.items() if n is not None)
        raise InputError(what, where=where, expected=expected, got=got, remedy="make the table anew with --overwrite")
    if floor is not None and wanted and tuple(floor) not in wanted:
        cells[TRUTH][place][column.key] = {"reason": OTHER_N, "floor": cells[TRUTH][place][column.key]}


# ---- texts ----


def heading(doc: Facts) -> str:
    """What the table is, and what it is filled with."""
    count, name = len(doc["logs"]), doc["settings"]["list"]
    logs = f"{count} log{'s' if count != 1 else ''}"
    return f"{doc['table']['title']}, on {logs} " + (f"of generated cities ({name})" if name else "recorded")


def notes_of(doc: Facts) -> list[str]:
    """What is to be said of a table, one sentence or two per line."""
    table, settings = doc["table"], doc["settings"]
    sizes = dict.fromkeys(f"{e['size']}, {e['frames']} frames, {e['held_out']} images held out" for e in doc["logs"])
    ours = "generated cities, not the paper's data" if settings["list"] else "the logs below"
    missing, ranked = ", ".join(settings["missing_scenes"]), "best of ours; truth and published rows are not ranked"
    cells = [*table["cells"], *((place["name"], c["key"]) for place in table["places"] for c in doc["further"])]
    empty: dict[str, dict[str, None]] = {}
    for place, key in cells:
        if reason := _shared_reason(doc, place, key):
            empty.setdefault(reason, {})[_columns(doc)[key]["title"]] = None
    return [
        f"Published rows: {table['data']}. Ours: {ours} ({'; '.join(sizes)}). The two cannot be compared number by"
        " number.",
        f"Every fit has {settings['iterations']} iterations, {virtual_fits_of(settings)}; seed {settings['seed']}.",
        f"Means over logs; in brackets the standard error over logs. Bold: {ranked}.",
        *table["notes"],
        *(f"{', '.join(titles)} ({NONE}): {reason}." for reason, titles in empty.items()),
        *_notes_of_sets(doc["made"]),
        *(f"{entry['log']}: {entry['note']}." for entry in doc["logs"] if entry["note"]),
        *([f"Segments of list {table['scenes']} that were not given: {missing}."] if missing else []),
    ]


def _notes_of_sets(made: Facts) -> list[str]:
    notes, sets, videos = [], made.get("distributions"), made.get("videos")
    if sets:
        whose = "published weights" if sets["published_weights"] else "weights that are not the published file"
        notes.append(
            "FID, KID and FVD: all logs' views of a place are one set, against all recorded frames of their cameras; "
            f"{whose} ({sets['weights_sha256'][:12]}), resize rule {sets['resize']}, "
            f"covariance with {sets['covariance']}. FID of few frames is mostly bias: read it beside the truth itself."
        )
    if videos:
        notes.append(
            f"FVD: clips of {videos['clip_frames']} views, one at every {videos['hop_frames']}th; weights"
            f" {videos['weights_sha256'][:12]}, resize rule {videos['resize']}, epsilon {videos['norm_epsilon']:g}."
        )
    return notes


def _columns(doc: Facts) -> dict[str, Facts]:
    return {column["key"]: column for column in (*doc["further"], *doc["table"]["columns"])}


def _shared_reason(doc: Facts, place: str, key: str) -> str:
    """Why no row at all has a number in a column; empty if one has, or if reasons differ."""
    reasons = {of[place][key].get("reason", "") for of in doc["cells"].values()}
    return reasons.pop() if len(reasons) == 1 else ""


def main_table(doc: Facts) -> list[str]:
    """Lines of the table: published rows, ours, and the numbers of views."""
    wanted, columns = [tuple(cell) for cell in doc["table"]["cells"]], _columns(doc)
    titles = {place["name"]: place["title"] for place in doc["table"]["places"]}
    rows = []
    for row in doc["published"]:
        values = {(place, key): value for place, key, value in row["values"]}
        if values.keys() & set(wanted):
            texts = [_digits(values[cell], columns[cell[1]]) if cell in values else "" for cell in wanted]
            rows.append([f"{row['title']} (published: {row['source']})", *texts])
    return markdown_table(
        ["", *(f"{_headed(columns[key])}, {titles[place]}" for place, key in wanted)], [*rows, *_ours(doc, wanted)]
    )


def _headed(column: Facts) -> str:
    return f"{column['title']} {ARROWS[column['better']]}"


def _ours(doc: Facts, wanted: Sequence[tuple[str, str]]) -> Iterator[list[str]]:
    shared = {cell: _shared_reason(doc, *cell) for cell in wanted}
    for row in doc["rows"]:
        yield [row["title"], *(NONE if shared[cell] else _printed(doc, row["name"], *cell) for cell in wanted)]
    yield ["n", *(_count(doc, *cell) for cell in wanted)]


def _printed(doc: Facts, row: str, place: str, key: str) -> str:
    result, column = doc["cells"][row][place][key], _columns(doc)[key]
    if "mean" not in result:
        return result["reason"]
    error = result["standard_error"]
    text = _digits(result["mean"], column) + ("" if error is None else f" ({_digits(error, column)})")
    return f"**{text}**" if row in doc["best"][place][key] else text


def _digits(value: float, column: Facts) -> str:
    return f"{value:.{column['digits']}f}"


def _count(doc: Facts, place: str, key: str) -> str:
    """Views (or clips) behind the numbers of a column, over all logs; the same for every row that has one."""
    counts = next((of[place][key] for of in doc["cells"].values() if "n" in of[place][key]), None)
    if counts is None:
        return NONE
    reference = counts.get("n_reference")
    return str(sum(counts["n"])) + (f" against {sum(reference)}" if reference else "")


def markdown(doc: Facts) -> str:
    """The table for people; below it the further columns, one table per place."""
    lines = [f"# {heading(doc)}", "", *(f"* {note}" for note in notes_of(doc)), "", *main_table(doc), ""]
    for place in doc["table"]["places"] if doc["further"] else ():
        own = [(place["name"], column["key"]) for column in doc["further"]]
        table = markdown_table(["", *map(_headed, doc["further"])], _ours(doc, own))
        lines += [f"## {doc['further_title']}: {place['title']}", "", *table, ""]
    heads = ("log", "dataset", "cameras", "frames", "size", "images held out", "tracked boxes", "seconds")
    rows = []
    for entry in doc["logs"]:
        facts = [str(entry[key]) for key in ("frames", "size", "held_out", "tracks")]
        seconds = f"{sum(entry['seconds'].values()):.0f}"
        rows.append([entry["log"], entry["dataset"], ", ".join(entry["cameras"]), *facts, seconds])
    return "\n".join([*lines, "## Logs", "", *markdown_table(heads, rows), ""])
