"""YAML of foreign files: plain values only, and bounded in size, depth and in what aliases stand for.

Values are built from the parser's events, one after the other, so that a file is refused at the first line that goes
too far.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable, Iterator
from typing import Any, Final

import yaml

from mudg.base.errors import InputError

LARGEST_BYTES: Final = 100_000
"""Of settings and edits; lists of scenes may be larger."""
DEEPEST: Final = 32
BYTES_A_VALUE: Final = 5
"""So many times fewer values than bytes a file may stand for, each alias counted as all that it repeats."""
MOST_ANCHORS: Final = 1000
MOST_LETTERS: Final = 10_000
"""Of one text or key."""
MOST_DIGITS: Final = 100
"""Characters of one number."""

_WORDS: Final = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys("yes Yes YES true True TRUE on On ON".split(), True),
    **dict.fromkeys("no No NO false False FALSE off Off OFF".split(), False),
}
_INTEGER: Final = re.compile(r"[-+]?(0|[1-9][0-9_]*)")
_FLOAT: Final = re.compile(
    r"[-+]?([0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
)
_DIRECTIVE: Final = re.compile(r"^%", re.MULTILINE)
_MERGE: Final = "<<"
Lines = dict[tuple[str | int, ...], int]
"""Where a value stands, as keys and numbers of entries from the outermost value in -> line, from 1."""


def parse_yaml(text: str | bytes, where: str, largest: int = LARGEST_BYTES) -> Any:
    """The value that YAML text stands for: null, true or false, decimal numbers, texts, lists, and mappings whose keys
    are texts.

    Dates, numbers in other bases and numbers with colons are texts.

    Args:
        where: name of the file for messages. largest: bytes that it may have.

    Raises:
        InputError: it is not YAML, says what a plain value is, or is larger, deeper or stands for more values than any
            file of its kind.
    """
    return _parse(text, where, largest, None)


def parse_with_lines(text: str | bytes, where: str) -> tuple[Any, Lines]:
    """``parse_yaml``, and the line of each of the values."""
    lines: Lines = {}
    return _parse(text, where, LARGEST_BYTES, lines), lines


def _parse(text: str | bytes, where: str, largest: int, lines: Lines | None) -> Any:
    if len(text) > largest:
        raise InputError("YAML file is too large", where=where, expected=f"at most {largest} bytes", got=f"{len(text)}")
    reader = _Reader(where, largest // BYTES_A_VALUE, lines)
    try:
        if isinstance(text, bytes):
            text = text.decode("utf-16" if text[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig")
        text.encode()  # refuses halves of surrogate pairs
        directive = _DIRECTIVE.search(text)
        if directive is not None:
            reader.line = text.count("\n", 0, directive.start())
            remedy = "leave the line out"
            raise InputError("directives of YAML are not read here", where=reader.at(), got="%", remedy=remedy)
        # the same events, the first ten times faster
        return reader.read(yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)))
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # ValueError: bytes that are no text, no such letters
        mark, got = getattr(error, "problem_mark", None), str(getattr(error, "problem", None) or error)
        line = str(text).count("\n", 0, getattr(error, "position", 0)) or reader.line
        reader.line = min(line if mark is None else mark.line, str(text).rstrip().count("\n"))
        what = "YAML is nested too deeply" if "nesting depth" in got else "not valid YAML"
        raise InputError(what, where=reader.at(), got=got.replace("\n", " ")) from error


class _Reader:
    """Makes a value of events. ``line``: where the last of them began, from 0."""

    def __init__(self, where: str, most: int, lines: Lines | None) -> None:
        self.line = 0
        self._events: Iterator[Any] = iter(())
        self._where, self._most, self._lines = where, most, lines
        self._open: list[str | None] = []
        """Anchors of the lists and mappings that are being read."""
        self._anchored: dict[str, tuple[Any, int]] = {}
        """Anchor -> its value, and how many values that stands for."""

    def at(self) -> str:
        """The place, for messages."""
        return f"{self._where}, line {self.line + 1}"

    def read(self, events: Iterable[Any]) -> Any:
        """The value that all events together stand for."""
        root, documents, self._events = None, 0, iter(events)
        while (event := self._next()) is not None:
            documents += isinstance(event, yaml.DocumentStartEvent)
            if documents > 1:
                raise InputError("a file holds one YAML document", where=self.at(), remedy="leave out what follows ---")
            if isinstance(event, yaml.NodeEvent):
                root, _ = self._value(event, ())
        return root

    def _next(self) -> Any:
        event = next(self._events, None)
        if event is None:
            return None
        self.line = event.start_mark.line
        if getattr(event, "tag", None) is not None:
            what, remedy = "a value says of which type it is", "leave out the word that begins with !"
            raise InputError(what, where=self.at(), got=event.tag, expected="a plain value", remedy=remedy)
        anchors = len(self._anchored) + len(self._open)
        if anchors > MOST_ANCHORS and not isinstance(event, yaml.AliasEvent) and getattr(event, "anchor", None):
            expected, remedy = f"at most {MOST_ANCHORS}", "write the values out"
            raise InputError("YAML has too many anchors", where=self.at(), expected=expected, remedy=remedy)
        return event

    def _value(self, event: Any, path: tuple[str | int, ...]) -> tuple[Any, int]:
        """What a node stands for, and how many values that are."""
        if isinstance(event, yaml.AliasEvent):
            got = f"*{event.anchor}"
            if event.anchor in self._open:
                raise InputError("a value contains itself", where=self.at(), got=got, remedy="write the value out")
            if event.anchor not in self._anchored:
                raise InputError("not valid YAML", where=self.at(), got=f"{got} without an anchor of this name")
            return self._anchored[event.anchor]
        if isinstance(event, yaml.ScalarEvent):
            found: tuple[Any, int] = (_scalar(event, self.at()), 1)
        else:
            if len(self._open) >= DEEPEST:
                raise InputError("YAML is nested too deeply", where=self.at(), expected=f"at most {DEEPEST} levels")
            self._open.append(event.anchor)
            found = self._mapping(path) if isinstance(event, yaml.MappingStartEvent) else self._list(path)
            self._open.pop()
        if event.anchor is not None:
            self._anchored[event.anchor] = found
        return found

    def _list(self, path: tuple[str | int, ...]) -> tuple[list[Any], int]:
        items, count = list[Any](), 1
        while not isinstance(event := self._next(), yaml.CollectionEndEvent):
            value, more = self._value(event, self._noted(path, len(items)))
            items.append(value)
            count = self._bounded(count + more)
        return items, count

    def _mapping(self, path: tuple[str | int, ...]) -> tuple[dict[str, Any], int]:
        made, merged, count = dict[str, Any](), list[Any](), 1
        while not isinstance(event := self._next(), yaml.CollectionEndEvent):
            key = self._key(event, made)
            inside, count = self._noted(path, key), self._bounded(count + 1)
            event, at = self._next(), self.at()
            a_list = key == _MERGE and isinstance(event, yaml.SequenceStartEvent) and len(self._open) < DEEPEST
            value, more = (None, 0) if a_list else self._value(event, inside)
            if key == _MERGE:
                many = value if isinstance(value, list) and value else [value]
                if not all(isinstance(one, dict) for one in many):
                    raise InputError("what << merges is no mapping", where=at, expected="<<: *NAME of a mapping above")
                merged += many
            else:
                made[key] = value
            count = self._bounded(count + more)
        for one in (*reversed(merged), dict(made)):  # later ones win; own keys come first
            made.update(one)
        return made, count

    def _key(self, event: Any, made: dict[str, Any]) -> str:
        plain = isinstance(event, yaml.ScalarEvent)
        key = _scalar(event, self.at()) if plain else None
        if not isinstance(key, str):
            collection = isinstance(event, yaml.CollectionStartEvent)
            got = event.value if plain else "a list or mapping" if collection else f"*{event.anchor}"
            what, remedy = "a key is no text", "put quotes around it, if it is a name"
            expected = "the name of a setting"
            raise InputError(what, where=self.at(), expected=expected, got=got or "nothing", remedy=remedy)
        if key in made and not (key == _MERGE and event.implicit[0]):
            raise InputError(f"{key!r} is given twice", where=self.at(), remedy="keep one of them")
        if event.anchor is not None:
            self._anchored[event.anchor] = (key, 1)
        return key

    def _noted(self, path: tuple[str | int, ...], step: str | int) -> tuple[str | int, ...]:
        """The place below a list or mapping; its line is kept."""
        if self._lines is not None:
            self._lines[*path, step] = self.line + 1
        return (*path, step)

    def _bounded(self, count: int) -> int:
        if count > self._most:
            got = f"{count}" + (", repeated by aliases" if self._anchored else "")
            expected = f"at most {self._most}"
            raise InputError("YAML stands for too many values", where=self.at(), expected=expected, got=got)
        return count


def _scalar(event: yaml.ScalarEvent, at: str) -> Any:
    """The value of a word or a text."""
    text = event.value
    if len(text) > MOST_LETTERS:
        what = "a text is too long"
        raise InputError(what, where=at, expected=f"at most {MOST_LETTERS} letters", got=f"{len(text)}: {text[:40]}...")
    if not text.isascii():
        text.encode()  # ValueError: half of a surrogate pair, as an escape
    if not event.implicit[0]:
        return text
    if text in _WORDS:
        return _WORDS[text]
    number = int if _INTEGER.fullmatch(text) else float if _FLOAT.fullmatch(text) else None
    if number is None:
        return text
    if len(text) > MOST_DIGITS:
        what = "a number is too long"
        raise InputError(what, where=at, expected=f"at most {MOST_DIGITS} digits", got=f"{len(text)}: {text[:40]}...")
    return number(text.lower().replace("_", "").replace(".inf", "inf").replace(".nan", "nan"))
