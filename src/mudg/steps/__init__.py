"""One `Step` per verb, and the table of all verbs."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from typing import Final

from mudg.steps.step import Step

_HOMES: Final[Mapping[str, str]] = {
    "demo": "mudg.steps.run:Demo",
    "run": "mudg.steps.run:Run",
    "doctor": "mudg.steps.doctor:Doctor",
    "ingest": "mudg.steps.ingest:Ingest",
    "annotate": "mudg.steps.ingest:Annotate",
    "fuse": "mudg.steps.ingest:Fuse",
    "learn": "mudg.steps.synthesize:Learn",
    "fit": "mudg.steps.fit:Fit",
    "adapt": "mudg.steps.synthesize:Adapt",
    "synthesize": "mudg.steps.synthesize:Synthesize",
    "render": "mudg.steps.render:RenderViews",
    "score": "mudg.steps.render:Score",
    "view": "mudg.steps.view:ViewScene",
    "page": "mudg.steps.view:Page",
    "serve": "mudg.steps.view:Serve",
    "report": "mudg.steps.view:Report",
    "edit": "mudg.steps.edit:Edit",
    "asset export": "mudg.steps.edit:AssetExport",
    "asset import": "mudg.steps.edit:AssetImport",
    "export": "mudg.steps.export:Export",
    "dataset": "mudg.steps.dataset:Dataset",
    "batch run": "mudg.steps.batch:BatchRun",
    "batch status": "mudg.steps.batch:BatchProgress",
    "batch retry": "mudg.steps.batch:BatchRetry",
    "bench": "mudg.benchmarks.step:Bench",
    "convert": "mudg.steps.convert:Convert",
}
VERBS: Final = tuple(_HOMES)
"""Names of all verbs, in the order in which the overview lists them."""


def step_class(verb: str) -> type[Step]:
    """The step of a verb; KeyError for a name that is none."""
    module, _, name = _HOMES[verb].partition(":")
    return getattr(importlib.import_module(module), name)


def sections() -> Iterator[tuple[str, list[str]]]:
    """Titles of the overview, each with its verbs."""
    by_title: dict[str, list[str]] = {}
    for verb in VERBS:
        by_title.setdefault(step_class(verb).section, []).append(verb)
    yield from by_title.items()


def groups() -> dict[str, list[str]]:
    """Verbs of two words by their first one."""
    found: dict[str, list[str]] = {}
    for verb in VERBS:
        if " " in verb:
            found.setdefault(verb.split(" ")[0], []).append(verb)
    return found
