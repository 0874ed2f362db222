"""Verbs as functions: ``mudg.fit(...)``. Built from the steps on first use; what type checkers and editors read is in
``functions.pyi``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from mudg import steps
from mudg.steps.step import python_function

VERBS: Final = {
    **{name: name for name in "adapt annotate bench convert dataset demo doctor edit export".split()},
    "export_asset": "asset export",
    "fit": "fit",
    "fuse": "fuse",
    "import_asset": "asset import",
    **{name: name for name in "ingest learn page render report run score synthesize".split()},
}
"""Functions, and the verbs that they are."""


def __getattr__(name: str) -> Callable[..., Any]:
    if name not in VERBS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = python_function(steps.step_class(VERBS[name]), name)
    return globals()[name]
