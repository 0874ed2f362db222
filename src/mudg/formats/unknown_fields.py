"""Fields in files of other programs that this program neither reads nor knows: each kind of file is named once per
import.

A reader calls ``note_unknown`` with the names that a record or table has and those that its format is known to have,
whether they are read or not: these stand in literal tables beside the readers. What a format leaves to its users
(``extras``, ``metadata``) counts as known.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, Final

from mudg.base import log
from mudg.base.errors import short

Known = Mapping[str, "Known | None"]
"""Field -> fields of the records in it, or None: it holds no records, or what is in it is free."""


def known(names: str, **inner: Known) -> Known:
    """Fields by their names, of which ``inner`` hold records."""
    return {**dict.fromkeys(names.split()), **inner}


_MOST_NAMES: Final = 8
_MOST_LETTERS: Final = 60
_MOST_COLLECTED: Final = 1000
_unknown: dict[str, dict[str, None]] | None = None
"""Kind of file -> names, of the import that runs; None outside of one."""


@contextlib.contextmanager
def named_once() -> Iterator[None]:
    """An import: when it ends, well or not, a line on stderr for every kind of file names what was passed over."""
    global _unknown
    found = _unknown = dict[str, dict[str, None]]()
    try:
        yield
    finally:
        _unknown = None
        for kind, names in found.items():
            log.info(sentence(names, kind))


def note_unknown(kind: str, names: Collection[str], known: frozenset[str]) -> None:
    """Collect those of ``names`` that are not ``known``; ``kind``: of file, as the message calls it."""
    # half a microsecond: readers of millions of records call this
    if _unknown is not None and not known.issuperset(names):
        _collect(kind, (name for name in names if name not in known))


def note_unknown_within(kind: str, value: Any, known: Known, within: str = "") -> None:
    """``note_unknown`` for records in records and lists; a field of one is called ``record.field``."""
    if isinstance(value, list):
        for one in value:
            note_unknown_within(kind, one, known, within)
    elif isinstance(value, dict):
        _collect(kind, (f"{within}{name}" for name in value if name not in known))
        for name, inner in known.items():
            if inner is not None and name in value:
                note_unknown_within(kind, value[name], inner, f"{within}{name}.")


def _collect(kind: str, names: Iterable[str]) -> None:
    if _unknown is None:
        return
    for name in names:
        collected = _unknown.setdefault(kind, {})
        if len(collected) < _MOST_COLLECTED:
            collected[short(name, _MOST_LETTERS)] = None


def listed(names: Iterable[str]) -> str:
    """Names of a foreign file for a message: the first eight, 60 letters each, control characters escaped."""
    every = [f"'{short(name, _MOST_LETTERS)}'" for name in names]
    more = f" and {len(every) - _MOST_NAMES} more" if len(every) > _MOST_NAMES else ""
    return ", ".join(every[:_MOST_NAMES]) + more


def sentence(names: Iterable[str], kind: str) -> str:
    """What a message says of unknown names in a kind of file."""
    return f"passed over: {listed(names)} in {kind}, which this program does not know"
