"""One `Step` per verb, and the table of all verbs."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import Final

from mudg.steps.step import Step

_SECTIONS: Final[Mapping[str, Mapping[str, str]]] = {
    "start here": {"demo": ".run:Demo", "run": ".run:Run", "doctor": ".doctor:Doctor"},
    "single steps, in the order of use": {
        "ingest": ".ingest:Ingest",
        "annotate": ".ingest:Annotate",
        "fuse": ".ingest:Fuse",
        "learn": ".synthesize:Learn",
        "fit": ".fit:Fit",
        "synthesize": ".synthesize:Synthesize",
        "render": ".render:RenderViews",
        "score": ".render:Score",
    },
    "look at a drive": {
        "view": ".render:ViewScene",
        "page": ".render:Page",
        "serve": ".render:Serve",
        "report": ".render:Report",
    },
    "change a drive": {"edit": ".edit:Edit", "asset export": ".edit:AssetExport", "asset import": ".edit:AssetImport"},
    "other programs": {"export": ".export:Export", "dataset": ".export:Dataset"},
    "many drives": {
        "batch run": ".run:BatchRun",
        "batch status": ".run:BatchProgress",
        "batch retry": ".run:BatchRetry",
    },
    "benchmarks": {"bench": "..benchmarks.step:Bench"},
    "published models": {"convert": ".export:Convert"},
}
"""Titles of the overview, and the verbs of each with their steps."""
_HOMES: Final = {verb: home for homes in _SECTIONS.values() for verb, home in homes.items()}
VERBS: Final = tuple(_HOMES)
"""Names of all verbs, in the order in which the overview lists them."""


def step_class(verb: str) -> type[Step]:
    """The step of a verb; KeyError for a name that is none."""
    module, _, name = _HOMES[verb].partition(":")
    return getattr(importlib.import_module(module, __name__), name)


def sections() -> Iterator[tuple[str, list[str]]]:
    """Titles of the overview, each with its verbs."""
    return ((title, list(homes)) for title, homes in _SECTIONS.items())


def groups() -> dict[str, list[str]]:
    """Verbs of two words by their first one."""
    found: dict[str, list[str]] = {}
    for verb in VERBS:
        if " " in verb:
            found.setdefault(verb.split(" ")[0], []).append(verb)
    return found
