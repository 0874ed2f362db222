"""YAML of foreign files: plain values without anchors, bounded in size, depth and number.

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
"""So many times fewer values than bytes a file may hold."""
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
Lines = dict[tuple[str | int, ...], int]
"""Where a value stands, as keys and numbers of entries from the outermost value in -> line, from 1."""


def parse_yaml(text: str | bytes, where: str, largest: int = LARGEST_BYTES, lines: Lines | None = None) -> Any:
    """The value that YAML text stands for: null, true or false, decimal numbers, texts, lists, and mappings whose keys
    are texts. Dates, numbers in other bases and numbers with colons are texts. where: name of the file for messages.
    largest: bytes that it may have. lines: gets the line of each value. InputError: it is not YAML, says what a plain
    value is, has anchors, or is larger, deeper or holds more values than any file of its kind."""
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
        self.line = self._count = 0
        self._events: Iterator[Any] = iter(())
        self._where, self._most, self._lines = where, most, lines

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
                root = self._value(event, ())
        return root

    def _next(self) -> Any:
        event = next(self._events, None)
        if event is None:
            return None
        self.line = event.start_mark.line
        if getattr(event, "tag", None) is not None:
            what, remedy = "a value says of which type it is", "leave out the word that begins with !"
            raise InputError(what, where=self.at(), got=event.tag, expected="a plain value", remedy=remedy)
        if getattr(event, "anchor", None) is not None:
            what, got = "anchors and aliases of YAML are not read here", event.anchor
            raise InputError(what, where=self.at(), got=got, remedy="write the value out")
        return event

    def _value(self, event: Any, path: tuple[str | int, ...]) -> Any:
        self._count += 1
        if self._count > self._most:
            raise InputError("YAML holds too many values", where=self.at(), expected=f"at most {self._most}")
        if isinstance(event, yaml.ScalarEvent):
            return _scalar(event, self.at())
        if len(path) >= DEEPEST:
            raise InputError("YAML is nested too deeply", where=self.at(), expected=f"at most {DEEPEST} levels")
        items, values = list[Any](), dict[str, Any]()
        is_list = isinstance(event, yaml.SequenceStartEvent)
        while not isinstance(event := self._next(), yaml.CollectionEndEvent):
            if is_list:
                items.append(self._value(event, self._noted(path, len(items))))
            else:
                key = self._key(event, values)
                inside = self._noted(path, key)
                values[key] = self._value(self._next(), inside)
        return items if is_list else values

    def _key(self, event: Any, values: dict[str, Any]) -> str:
        plain = isinstance(event, yaml.ScalarEvent)
        key = _scalar(event, self.at()) if plain else None
        if not isinstance(key, str):
            what, remedy = "a key is no text", "put quotes around it, if it is a name"
            got = event.value or "nothing" if plain else "a list or mapping"
            raise InputError(what, where=self.at(), expected="the name of a setting", got=got, remedy=remedy)
        if key in values:
            raise InputError(f"{key!r} is given twice", where=self.at(), remedy="keep one of them")
        return key

    def _noted(self, path: tuple[str | int, ...], step: str | int) -> tuple[str | int, ...]:
        """The place below a list or mapping; its line is kept."""
        if self._lines is not None:
            self._lines[*path, step] = self.line + 1
        return (*path, step)


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
