"""YAML of foreign files: plain values only, and bounded in size, depth and in what aliases stand for."""

from __future__ import annotations

from typing import Any, Final

import yaml

from mudg.base.errors import InputError

LARGEST_BYTES: Final = 4_000_000
DEEPEST: Final = 32
MOST_VALUES: Final = 1_000_000
"""Values that a file may stand for, each alias counted as all that it repeats."""


def parse_yaml(text: str | bytes, where: str) -> Any:
    """The value that YAML text stands for.

    Raises:
        InputError: it is not YAML, or is larger, deeper or stands for more values than any file of settings or edits.
    """
    if len(text) > LARGEST_BYTES:
        raise InputError("YAML file is too large", where=where, expected=f"at most {LARGEST_BYTES} bytes", got=f"{len(text)}")
    try:
        _check_events(text, where)
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a date or number that does not exist, bytes that are no text
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark is not None else ""
        got = str(getattr(error, "problem", None) or error).replace("\n", " ")
        raise InputError("not valid YAML", where=f"{where}{line}", got=got[:200]) from error


def _check_events(text: str | bytes, where: str) -> None:
    """Bound depth and values from the events, which need no memory for what they nest or repeat."""
    counts: list[int] = [0]
    names: list[str | None] = [None]
    anchored: dict[str, int] = {}
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        line = f"{where}, line {event.start_mark.line + 1}" if event.start_mark is not None else where
        if isinstance(event, yaml.CollectionStartEvent):
            counts.append(1)
            names.append(event.anchor)
            if len(counts) > DEEPEST + 1:
                raise InputError("YAML is nested too deeply", where=line, expected=f"at most {DEEPEST} levels")
        elif isinstance(event, yaml.CollectionEndEvent):
            count, name = counts.pop(), names.pop()
            counts[-1] += count
            if name is not None:
                anchored[name] = count
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor in names:
                raise InputError("a value contains itself", where=line, got=f"*{event.anchor}", remedy="write the value out")
            counts[-1] += anchored.get(event.anchor, 1)
        elif isinstance(event, yaml.ScalarEvent):
            counts[-1] += 1
            if event.anchor is not None:
                anchored[event.anchor] = 1
        if counts[-1] > MOST_VALUES:
            raise InputError("YAML stands for too many values", where=line, expected=f"at most {MOST_VALUES}",
                got=f"{counts[-1]}, repeated by aliases" if anchored else str(counts[-1]))  # fmt: skip
