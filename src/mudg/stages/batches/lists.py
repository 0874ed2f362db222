"""The list of a batch: one source a line, with a name and settings of its own; and its shards."""

from __future__ import annotations

import hashlib
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from mudg.base.errors import InputError, UsageError
from mudg.base.location import Location
from mudg.data.scene.schema import NAME_PATTERN

CITY: Final = "city"
BOOKKEEPING: Final = "_batch"
"""Folder of a batch's own records, in its output."""
REVIEW: Final = "_review"
"""Folder of results that people are to look at, in a batch's output."""
_LEFT_OUT: Final = re.compile(rf"{BOOKKEEPING}|{REVIEW}|\..*|status(-\d+-of-\d+)?\.json")


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of a list: the source, the name of its output folder, and settings of its own (``sequence``, ``frames``, ...)."""

    name: str
    source: str
    settings: Mapping[str, str] = field(default_factory=dict)


def read_list(listed: Path | str, settings: Sequence[str] = ()) -> list[Entry]:
    """Entries of a list file, or one for each entry of a folder (but for what an earlier run over a list wrote there).

    A line is ``SOURCE [name=NAME] [setting=value ...]``, quoted as in a shell; ``#`` starts a comment. Relative sources count
    from the list's folder. Without a name, the last part of the source is taken.

    Args:
        listed: a path, or an address (``s3://...``). settings: settings a line may give.

    Raises:
        InputError: missing, empty, malformed, or two lines that would write one folder.
    """
    place = Location.of(listed)
    if place.local is not None and place.local.is_dir():
        lines = [
            (str(entry), shlex.quote(entry.name))
            for entry in sorted(place.local.iterdir())
            if not _LEFT_OUT.fullmatch(entry.name)
        ]
        folder = place.text
    else:
        text = place.load().decode("utf-8", "replace")
        lines = [(f"{place}: line {index + 1}", line) for index, line in enumerate(text.splitlines())]
        folder = place.text.rpartition("/")[0] if place.local is None else str(place.local.parent)
    entries = [entry for where, line in lines if (entry := _entry(line, where, folder, settings)) is not None]
    if not entries:
        raise InputError("the list is empty", where=str(place), expected="one source per line")
    sources: dict[str, str] = {}
    for entry in entries:
        if entry.name in sources:
            raise InputError(
                "two entries would write the same folder", where=str(place), got=f"{sources[entry.name]} and {entry.source}",
                remedy=f"give one of them another name: SOURCE name={entry.name}-2",
            )  # fmt: skip
        sources[entry.name] = entry.source
    return entries


def _entry(line: str, where: str, folder: str, settings: Sequence[str]) -> Entry | None:
    try:
        words = shlex.split(line, comments=True)
    except ValueError as error:
        raise InputError("cannot parse the line", where=where, got=line[:80]) from error
    if not words:
        return None
    given: dict[str, str] = {}
    for word in words[1:]:
        key, separator, value = word.partition("=")
        if not separator or key not in ("name", *settings):
            raise InputError(
                "unknown setting in the line", where=where, got=word[:80],
                expected=", ".join(f"{key}=..." for key in ("name", *settings)),
                remedy="put quotes around a path with spaces")  # fmt: skip
        given[key] = value
    source = words[0] if words[0] == CITY else _below(folder, words[0])
    name = given.pop("name", "") or Path(source).name.removesuffix(".zip")
    if not NAME_PATTERN.fullmatch(name) or name in (BOOKKEEPING, REVIEW):
        raise InputError("name cannot be a folder name", where=where, got=name[:80], remedy="add name=NAME to the line")
    return Entry(name, source, given)


def _below(folder: str, source: str) -> str:
    """A source of a list in this folder; both may be addresses."""
    if "://" in source:
        return Location.of(source).text
    if "://" in folder and not source.startswith(("/", "~")):
        return f"{folder}/{source}"
    return str(Path("" if "://" in folder else folder) / Path(source).expanduser())


def shard_of(name: str, count: int) -> int:
    """Which of ``count`` shards a scene belongs to: a hash of its name, so that it stays there when the list grows."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8]) % count


def parse_shard(text: str) -> tuple[int, int]:
    """(i, n) of ``"i/n"``; UsageError if it is not of this form."""
    first, separator, count = text.partition("/")
    if not separator or not first.isdecimal() or not count.isdecimal() or not int(first) < int(count):
        raise UsageError("invalid shard", where="--shard", expected="i/n with i from 0 to n-1, e.g. 0/4", got=text)
    return int(first), int(count)


def shard(entries: list[Entry], text: str) -> list[Entry]:
    """Entries of the i-th of n shards, for ``"i/n"`` with i from 0 to n - 1; an empty text takes all.

    Raises:
        UsageError: not of this form.
    """
    if not text:
        return entries
    index, count = parse_shard(text)
    return [entry for entry in entries if shard_of(entry.name, count) == index]
