"""Verbs as functions: ``mudg.fit(...)``. Built from the steps on first use; what type checkers and editors read is in
``functions.pyi``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from mudg import steps
from mudg.steps.step import python_function

_COMMANDS: Final = ("view", "serve", "batch run", "batch status", "batch retry")
"""Verbs that are no functions."""
VERBS: Final = dict(sorted(("_".join(verb.split()[::-1]), verb) for verb in steps.VERBS if verb not in _COMMANDS))
"""Functions, and the verbs that they are: ``export_asset`` is ``asset export``."""


def __getattr__(name: str) -> Callable[..., Any]:
    if name not in VERBS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = python_function(steps.step_class(VERBS[name]), name)
    return globals()[name]
