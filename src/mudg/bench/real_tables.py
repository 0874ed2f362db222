"""Numbers of ``mudg bench real``: pooled over logs and compared with the fit without diffusion, as JSON values and as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

from mudg.bench.real_measure import COLUMNS, compared, compared_text, number_text
from mudg.bench.real_protocols import Protocol
from mudg.bench.shift_tables import virtual_fits_of
from mudg.report.score_tables import markdown_table

AGAINST: Final = "street_gaussians"
"""The method that every other one is compared with."""


def document(
    logs: Sequence[Mapping[str, Any]],
    rows: Sequence[Mapping[str, Any]],
    protocols: Sequence[Protocol],
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """Everything ``bench.json`` holds: per protocol, log and method the values by place and their mean; the means over logs; and
    differences (or ratios) to ``AGAINST``."""
    names = [row["name"] for row in rows]
    found = {}
    for protocol in protocols:
        entries = {entry["log"]: entry["protocols"][protocol.name] for entry in logs}
        counted = {log: entry for log, entry in entries.items() if "left_out" not in entry}
        pooled = {
            name: _pooled([entry["values"][name]["mean"] for entry in counted.values()], protocol) for name in names
        }
        found[protocol.name] = {
            "row": asdict(protocol), "logs": entries, "pooled": pooled,
            "left_out": {log: entry["left_out"] for log, entry in entries.items() if "left_out" in entry},
            "against": {
                name: {column: compared(column, pooled[name][column], pooled[AGAINST][column]) for column in protocol.columns}
                for name in names if AGAINST in names and name != AGAINST
            },
        }  # fmt: skip
    facts = [{key: value for key, value in entry.items() if key != "protocols"} for entry in logs]
    return {
        "schema": 1,
        "bench": "real",
        "settings": dict(settings),
        "methods": list(rows),
        "logs": facts,
        "protocols": found,
    }


def _pooled(means: Sequence[Mapping[str, Any]], protocol: Protocol) -> dict[str, float | str]:
    """Means over logs; a log without a number does not count."""
    pooled: dict[str, float | str] = {}
    for column in protocol.columns:
        numbers = [value for mean in means if not isinstance(value := mean[column], str)]
        pooled[column] = round(sum(numbers) / len(numbers), 6) if numbers else "none"
    return pooled


# ---- text ----


def table_of(
    doc: Mapping[str, Any], protocol: str, values: Mapping[str, Mapping[str, Any]]
) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of a table: a method's values, each with its comparison with ``AGAINST`` in brackets."""
    columns = doc["protocols"][protocol]["row"]["columns"]
    heads = ["method", *(COLUMNS[column].title for column in columns)]
    rows = []
    for method, of in values.items():
        cells = [method]
        for column in columns:
            text = number_text(column, of[column])
            more = (
                ""
                if method == AGAINST or AGAINST not in values
                else compared_text(column, of[column], values[AGAINST][column])
            )
            cells.append(f"{text} ({more})" if more else text)
        rows.append(cells)
    return heads, rows


def notes_of(doc: Mapping[str, Any], protocol: str) -> list[str]:
    """Sentences about a protocol: what was held out of each log, what was left out, and the colour maps of cameras."""
    found = doc["protocols"][protocol]
    lines = []
    for log in doc["logs"]:
        name = log["log"]
        if name in found["left_out"]:
            lines.append(f"{name} is left out: {found['left_out'][name]}.")
            continue
        held, facts = log["held_out"].get(found["row"]["split"], {}), found["logs"][name]["facts"]
        words = [f"{count} view{'' if count == 1 else 's'} of {place}" for place, count in facts["views"].items()]
        if "blocks" in held:
            blocks = ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in held["blocks"])
            words.append(f"held out of {held['moments']} frames: {blocks}")
        if "shown_cameras" in held:
            words.append("shown: " + ", ".join(held["shown_cameras"]))
        words += [
            f"{share:.0%} of {place} was seen, {facts['weight'].get(place, 0):.0%} of all seen pixels"
            for place, share in facts["seen_share"].items()
        ]
        words += [
            f"colour map of {place}: gain {' '.join(f'{g:.2f}' for g in of['gain'])}, offset {' '.join(f'{o:+.3f}' for o in of['offset'])}"
            for place, of in facts["color_maps"].items()
        ]
        words += [f"{place} is left out ({reason})" for place, reason in facts["left_out"].items()]
        lines.append(f"{name}: {'; '.join(words)}.")
        lines += [f"{name}: {words}." for words in _uses(log["diffusion"].get(found["row"]["split"], {}))]
    return lines


def _uses(diffusion: Mapping[str, Mapping[str, str]]) -> list[str]:
    """What is to be said of how methods used their diffusion model: ``mudg_r, mudg_s: the model was adapted (...)``."""
    notes = dict.fromkeys(use["note"] for use in diffusion.values() if use["note"])
    return [f"{', '.join(name for name, use in diffusion.items() if use['note'] == note)}: {note}" for note in notes]


def heading_of(doc: Mapping[str, Any], protocol: str) -> str:
    """Title of a protocol."""
    return f"{protocol}: {doc['protocols'][protocol]['row']['title']}"


def summary_of(doc: Mapping[str, Any]) -> str:
    """One line about the whole."""
    settings, count = doc["settings"], len(doc["logs"])
    return (
        f"{count} log{'s' if count != 1 else ''}, {settings['iterations']} iterations per fit, {virtual_fits_of(settings)}; "
        f"seed {settings['seed']}."
    )


def markdown(doc: Mapping[str, Any]) -> str:
    """The tables for people."""
    lines = [
        "# Real logs", "",
        f"{summary_of(doc)} In brackets: difference to {AGAINST}, or the ratio (x) where lower is better. Perceptual: features of the "
        "shipped codec, not LPIPS.", "",
        *markdown_table(LOG_HEADS, [log_cells(log) for log in doc["logs"]]), "",
    ]  # fmt: skip
    for name, found in doc["protocols"].items():
        counted = {log: entry for log, entry in found["logs"].items() if "left_out" not in entry}
        lines += [f"## {heading_of(doc, name)}", "", *(f"* {note}" for note in notes_of(doc, name)), ""]
        if counted:
            lines += [*markdown_table(*table_of(doc, name, found["pooled"])), ""]
        for log, entry in counted.items():
            for place, values in tables_of_log(entry).items():
                lines += [f"### {name}, {log}, {place}", "", *markdown_table(*table_of(doc, name, values)), ""]
    return "\n".join(lines)


def tables_of_log(entry: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Place -> method -> values of a log under a protocol; nothing where there is one place only, whose values are the mean."""
    places = dict.fromkeys(place for of in entry["values"].values() for place in of["places"])
    if len(places) < 2:
        return {}
    return {place: {method: of["places"][place] for method, of in entry["values"].items()} for place in places}


LOG_HEADS: Final = ("log", "dataset", "cameras", "frames", "size", "sweeps", "tracked boxes")


def log_cells(log: Mapping[str, Any]) -> list[str]:
    """A log's row under ``LOG_HEADS``."""
    cameras = log["cameras"]
    sizes = dict.fromkeys(f"{of['size_px'][0]}x{of['size_px'][1]}" for of in cameras.values())
    frames = dict.fromkeys(str(of["frames"]) for of in cameras.values())
    return [
        log["log"],
        log["dataset"],
        ", ".join(cameras),
        ", ".join(frames),
        ", ".join(sizes),
        str(log["sweeps"]),
        str(log["tracks"]),
    ]
