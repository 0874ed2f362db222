"""Write the reference pages that the program prints: commands with their settings, and the public names of Python.

    python tools/reference.py

`tests/house` compares the pages with what the program says now.
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path

import mudg
from mudg import steps
from mudg.base import store
from mudg.steps import command

DOCS = Path(__file__).resolve().parents[1] / "docs" / "reference"
SHORT = ("run", "demo", "bench", "batch")
"""Verbs whose settings are mostly those of others."""


def command_line() -> str:
    """The page of all commands."""
    lines = ["# Command line", "", "What `mudg VERB --help-all` prints. [Which command does what](../commands.md)."]
    for verb in steps.VERBS:
        text = command.help_page(steps.step_class(verb), everything=verb not in SHORT).rstrip()
        lines += ["", f"## mudg {verb}", "", "```text", *(line.rstrip() for line in text.splitlines()), "```"]
    return "\n".join(lines) + "\n"


def python_names() -> str:
    """The page of the public names of the package."""
    lines = ["# Python names", "", "What `help(mudg.NAME)` shows. [How to begin](../python.md)."]
    for name in sorted(mudg.__all__):
        value = getattr(mudg, name)
        if name.startswith("_"):
            continue
        lines += ["", f"## mudg.{name}", "", "```text", *_told(value), "```"]
        for method, member in sorted(vars(value).items()) if inspect.isclass(value) else ():
            text = (
                inspect.getdoc(member) if callable(getattr(value, method, None)) or isinstance(member, property) else ""
            )
            if text and not method.startswith("_"):
                lines += [
                    "",
                    f"### {name}.{method}",
                    "",
                    "```text",
                    *_told(getattr(value, method, member), member),
                    "```",
                ]
    return "\n".join(lines) + "\n"


def _told(value: object, member: object = None) -> list[str]:
    """Signature and docstring."""
    text = inspect.getdoc(value if member is None else member) or ""
    try:
        head = [str(inspect.signature(value)).replace("typing.", "")] if callable(value) else []
    except ValueError:
        head = []
    return [*(line for line in head if len(line) < 400), *text.splitlines()]


PAGES = {"commands.md": command_line, "names.md": python_names}


def main() -> None:
    """Write both pages."""
    for name, made in PAGES.items():
        store.write_text(DOCS / name, made())
        sys.stdout.write(f"{DOCS / name}\n")


if __name__ == "__main__":
    main()
