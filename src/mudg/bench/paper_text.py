"""The table of ``mudg bench paper`` as Markdown, CSV and LaTeX, from what ``bench.json`` holds. No torch."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from mudg.bench.shift_tables import virtual_fits_of
from mudg.report.score_tables import markdown_table

ARROWS: Final = {"higher": "↑", "lower": "↓", "one": "→ 1"}
PUBLISHED: Final = "published"
NONE: Final = "-"
"""What stands in a column without any number; a note gives the reason once."""
_LATEX: Final = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "↑": r"$\uparrow$", "↓": r"$\downarrow$", "→": r"$\to$",
}  # fmt: skip


@dataclass(frozen=True)
class PrintedCell:
    """A printed cell: ``best``, the best number of its column among ours; ``reason``, why there is no number."""

    text: str
    best: bool = False
    reason: str = ""


@dataclass(frozen=True)
class PrintedRow:
    """A printed row. ``kind``: ours, anchor (truth, filled points), published, or n (numbers of views)."""

    title: str
    kind: str
    cells: tuple[PrintedCell, ...]


def heading(doc: Mapping[str, Any]) -> str:
    """What the table is, and what it is filled with."""
    return f"{doc['table']['title']}, {data_of(doc)}"


def data_of(doc: Mapping[str, Any]) -> str:
    """What the table is filled with, in words."""
    count, name = len(doc["logs"]), doc["settings"]["list"]
    logs = f"{count} log{'s' if count != 1 else ''}"
    return f"on {logs} of generated cities ({name})" if name else f"on {logs} recorded"


def notes_of(doc: Mapping[str, Any]) -> list[str]:
    """What is to be said of a table, one sentence or two per line."""
    table, settings = doc["table"], doc["settings"]
    sizes = dict.fromkeys(f"{e['size']}, {e['frames']} frames, {e['held_out']} images held out" for e in doc["logs"])
    ours = "generated cities, not the paper's data" if settings["list"] else "the logs below"
    notes = [
        f"Published rows: {table['data']}. Ours: {ours} ({'; '.join(sizes)}). The two cannot be compared number by number.",
        f"Every fit has {settings['iterations']} iterations, {virtual_fits_of(settings)}; seed {settings['seed']}.",
        "Means over logs; in brackets the standard error over logs. Bold: best of ours; truth and published rows are not ranked.",
        *table["notes"],
        *_empty_columns(doc),
        *_notes_of_sets(doc["made"]),
        *(f"{entry['log']}: {entry['note']}." for entry in doc["logs"] if entry["note"]),
    ]
    if settings["missing_scenes"]:
        notes.append(
            f"Segments of list {table['scenes']} that were not given: {', '.join(settings['missing_scenes'])}."
        )
    return notes


def _notes_of_sets(made: Mapping[str, Any]) -> list[str]:
    notes = []
    sets, videos = made.get("distributions"), made.get("videos")
    if sets:
        whose = "published weights" if sets["published_weights"] else "weights that are not the published file"
        notes.append(
            f"FID, KID and FVD: all logs' views of a place are one set, against all recorded frames of their cameras; "
            f"{whose} ({sets['weights_sha256'][:12]}), resize rule {sets['resize']}, "
            f"covariance with {sets['covariance']}. FID of few frames is mostly bias: read it beside the truth itself."
        )  # fmt: skip
    if videos:
        notes.append(
            f"FVD: clips of {videos['clip_frames']} views, one at every {videos['hop_frames']}th; weights {videos['weights_sha256'][:12]}, "
            f"resize rule {videos['resize']}, epsilon {videos['norm_epsilon']:g}."
        )
    return notes


# ---- lines ----


def heads_of(doc: Mapping[str, Any]) -> list[str]:
    """Headings of the numbers."""
    columns = _columns(doc)
    titles = {place["name"]: place["title"] for place in doc["table"]["places"]}
    return [
        f"{columns[key]['title']} {ARROWS[columns[key]['better']]}, {titles[place]}"
        for place, key in doc["table"]["cells"]
    ]


def _columns(doc: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return {column["key"]: column for column in (*doc["further"], *doc["table"]["columns"])}


def lines_of(doc: Mapping[str, Any]) -> list[PrintedRow]:
    """The table: published rows, ours, and the numbers of views."""
    wanted = [tuple(cell) for cell in doc["table"]["cells"]]
    lines = []
    for row in doc["published"]:
        values = {(place, key): value for place, key, value in row["values"]}
        if values.keys() & set(wanted):
            texts = (
                PrintedCell(_digits(values[cell], _columns(doc)[cell[1]]) if cell in values else "") for cell in wanted
            )
            lines.append(PrintedRow(f"{row['title']} ({PUBLISHED}: {row['source']})", PUBLISHED, tuple(texts)))
    return [*lines, *_ours(doc, wanted)]


def further_lines(doc: Mapping[str, Any], place: str) -> list[PrintedRow]:
    """The further columns at a place."""
    return _ours(doc, [(place, column["key"]) for column in doc["further"]])


def _shared_reason(doc: Mapping[str, Any], place: str, key: str) -> str:
    """Why no row at all has a number in a column; empty if one has, or if reasons differ."""
    reasons = {found[place][key].get("reason", "") for found in doc["cells"].values()}
    return reasons.pop() if len(reasons) == 1 else ""


def _empty_columns(doc: Mapping[str, Any]) -> list[str]:
    """Sentences on columns in which no row has a number."""
    columns = _columns(doc)
    wanted = [tuple(cell) for cell in doc["table"]["cells"]]
    wanted += [(place["name"], column["key"]) for place in doc["table"]["places"] for column in doc["further"]]
    of: dict[str, dict[str, None]] = {}
    for place, key in wanted:
        if reason := _shared_reason(doc, place, key):
            of.setdefault(reason, {})[columns[key]["title"]] = None
    return [f"{', '.join(titles)} ({NONE}): {reason}." for reason, titles in of.items()]


def _ours(doc: Mapping[str, Any], wanted: Sequence[tuple[str, str]]) -> list[PrintedRow]:
    lines = []
    shared = [_shared_reason(doc, place, key) for place, key in wanted]
    for row in doc["rows"]:
        cells = [
            PrintedCell(NONE, reason=reason) if reason else _cell(doc, row["name"], place, key)
            for (place, key), reason in zip(wanted, shared, strict=True)
        ]
        lines.append(PrintedRow(row["title"], "ours" if row["method"] else "anchor", tuple(cells)))
    counts = [_count(doc, place, key) for place, key in wanted]
    return [*lines, PrintedRow("n", "n", tuple(map(PrintedCell, counts)))]


def _cell(doc: Mapping[str, Any], row: str, place: str, key: str) -> PrintedCell:
    found, column = doc["cells"][row][place][key], _columns(doc)[key]
    if "mean" not in found:
        return PrintedCell(found["reason"], reason=found["reason"])
    error = found["standard_error"]
    behind = "" if error is None else f" ({_digits(error, column)})"
    return PrintedCell(_digits(found["mean"], column) + behind, row in doc["best"][place][key])


def _digits(value: float, column: Mapping[str, Any]) -> str:
    return f"{value * column['factor']:.{column['digits']}f}"


def _count(doc: Mapping[str, Any], place: str, key: str) -> str:
    """Views (or clips) behind the numbers of a column, over all logs; the same for every row that has one."""
    counts = [of[place][key] for of in doc["cells"].values() if "n" in of[place][key]]
    if not counts:
        return NONE
    reference = counts[0].get("n_reference")
    return str(sum(counts[0]["n"])) + (f" against {sum(reference)}" if reference else "")


# ---- formats ----


def markdown(doc: Mapping[str, Any]) -> str:
    """The table for people."""
    bold = lambda cell: f"**{cell.text}**" if cell.best else cell.text  # noqa: E731
    rows = lambda lines: [[line.title, *map(bold, line.cells)] for line in lines]  # noqa: E731
    lines = [
        f"# {heading(doc)}",
        "",
        *(f"* {note}" for note in notes_of(doc)),
        "",
        *markdown_table(["", *heads_of(doc)], rows(lines_of(doc))),
        "",
    ]
    for place in doc["table"]["places"] if doc["further"] else ():
        heads = [f"{column['title']} {ARROWS[column['better']]}" for column in doc["further"]]
        lines += [
            f"## {doc['further_title']}: {place['title']}",
            "",
            *markdown_table(["", *heads], rows(further_lines(doc, place["name"]))),
            "",
        ]
    return "\n".join(
        [*lines, "## Logs", "", *markdown_table(LOG_HEADS, [log_cells(entry) for entry in doc["logs"]]), ""]
    )


LOG_HEADS: Final = ("log", "dataset", "cameras", "frames", "size", "images held out", "tracked boxes", "seconds")


def log_cells(entry: Mapping[str, Any]) -> list[str]:
    """A log's row under ``LOG_HEADS``."""
    seconds = sum(entry["seconds"].values())
    facts = (
        entry["log"],
        entry["dataset"],
        ", ".join(entry["cameras"]),
        entry["frames"],
        entry["size"],
        entry["held_out"],
        entry["tracks"],
    )
    return [*map(str, facts), f"{seconds:.0f}"]


def csv_text(doc: Mapping[str, Any]) -> str:
    """One line per number: ``kind,row,source,place,metric,value,standard_error,logs,n,n_reference,reason,best``."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow("kind row source place metric value standard_error logs n n_reference reason best".split())
    for row in doc["published"]:
        for place, key, value in row["values"]:
            writer.writerow([PUBLISHED, row["title"], row["source"], place, key, value, "", "", "", "", "", ""])
    for row in doc["rows"]:
        for place, of in doc["cells"][row["name"]].items():
            for key, found in of.items():
                numbers = [_number(found.get(name)) for name in ("mean", "standard_error")]
                counts = [sum(found[name]) if name in found else "" for name in ("n", "n_reference")]
                best = int(row["name"] in doc["best"][place][key])
                kind = "ours" if row["method"] else "anchor"
                writer.writerow(
                    [
                        kind,
                        row["name"],
                        "",
                        place,
                        key,
                        *numbers,
                        found.get("logs", ""),
                        *counts,
                        found.get("reason", ""),
                        best,
                    ]
                )
    return out.getvalue()


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def latex(doc: Mapping[str, Any]) -> str:
    """The tables as LaTeX ``tabular``; notes, and the reasons behind cells without a number (--), as comments above them."""
    parts = [("", heads_of(doc), lines_of(doc))]
    for place in doc["table"]["places"] if doc["further"] else ():
        heads = [f"{column['title']} {ARROWS[column['better']]}" for column in doc["further"]]
        parts.append((f"{doc['further_title']}: {place['title']}", heads, further_lines(doc, place["name"])))
    lines = [f"% {note}" for note in (heading(doc), *notes_of(doc))]
    for title, heads, rows in parts:
        lines += [*([f"% {title}"] if title else []), *_tabular(heads, rows), ""]
    return "\n".join(lines)


def _tabular(heads: Sequence[str], rows: Sequence[PrintedRow]) -> list[str]:
    reasons = dict.fromkeys(
        f"{head}: {cell.reason}" for row in rows for head, cell in zip(heads, row.cells, strict=True) if cell.reason
    )
    lines = [*(f"% -- {reason}" for reason in reasons), r"\begin{tabular}{l" + "r" * len(heads) + "}", r"\hline"]
    lines += [" & ".join(["", *map(escaped, heads)]) + r" \\", r"\hline"]
    kind = ""
    for row in rows:
        if kind and PUBLISHED in (kind, row.kind) and kind != row.kind:
            lines.append(r"\hline")
        kind = row.kind
        texts = (
            "--" if c.reason else rf"\textbf{{{escaped(c.text)}}}" if c.best else escaped(c.text) for c in row.cells
        )
        lines.append(" & ".join([escaped(row.title), *texts]) + r" \\")
    return [*lines, r"\hline", r"\end{tabular}"]


def escaped(text: str) -> str:
    """Text with LaTeX's own characters written out."""
    return "".join(_LATEX.get(character, character) for character in text)
