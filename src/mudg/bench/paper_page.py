"""The page of ``mudg bench paper``: the table, and per log and path a picture (or video) of truth and methods side by side.

Pictures are files beside the page (``<log>/film/<trajectory>.jpg``, with ``.mp4`` where videos were made).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mudg.bench import paper_text
from mudg.bench.shift_page import ROWS
from mudg.report import html


def page(doc: Mapping[str, Any]) -> str:
    """The whole page from what ``bench.json`` holds."""
    columns = {column["key"]: column for column in doc["further"]}
    further = [
        {"title": place["title"], "heads": ["", *(f"{c['title']} {paper_text.ARROWS[c['better']]}" for c in columns.values())],
         "lines": paper_text.further_lines(doc, place["name"])}
        for place in doc["table"]["places"]
    ] if columns else []  # fmt: skip
    return html.render(
        "paper.html.j2", title=paper_text.heading(doc), kicker=f"mudg bench paper --table {doc['table']['name']}",
        lead=paper_text.notes_of(doc)[0],
        notes=paper_text.notes_of(doc)[1:], heads=["", *paper_text.heads_of(doc)], lines=paper_text.lines_of(doc),
        further=further, further_title=doc["further_title"],
        log_heads=paper_text.LOG_HEADS, logs=[paper_text.log_cells(entry) for entry in doc["logs"]],
        films=[{"log": entry["log"], "name": name} for entry in doc["logs"] for name in entry["films"]],
        columns=doc["logs"][0]["columns"], videos=doc["settings"]["videos"],
        panel_rows=[title for row, title in ROWS.items() if row != "error" or doc["exact"]],
    )  # fmt: skip
