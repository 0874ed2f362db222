"""YAML of foreign files: plain values only, and bounded in size, depth and in what aliases stand for.

Values are built from the parser's events, one after the other, so that a file is refused at the first line that goes
too far.
"""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass, field
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
    builder = _Builder(where, largest // BYTES_A_VALUE, lines)
    try:
        if isinstance(text, bytes):
            text = text.decode("utf-16" if text[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "utf-8-sig")
        text.encode()  # refuses halves of surrogate pairs
        directive = _DIRECTIVE.search(text)
        if directive is not None:
            at = _at(where, text.count("\n", 0, directive.start()))
            raise InputError("directives of YAML are not read here", where=at, got="%", remedy="leave the line out")
        # the same events, the first ten times faster
        for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
            builder.take(event)
        return builder.root
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # ValueError: bytes that are no text, no such letters
        mark, got = getattr(error, "problem_mark", None), str(getattr(error, "problem", None) or error)
        last = str(text).rstrip().count("\n")
        line = str(text).count("\n", 0, getattr(error, "position", 0)) or builder.line
        line = line if mark is None else mark.line
        what = "YAML is nested too deeply" if "nesting depth" in got else "not valid YAML"
        raise InputError(what, where=_at(where, min(line, last)), got=got.replace("\n", " ")) from error


def _at(where: str, line: int) -> str:
    return f"{where}, line {line + 1}"


@dataclass(slots=True)
class _Open:
    """A list or mapping that is being read. count: values in it so far; key: of the value that comes next, if any."""

    value: Any
    anchor: str | None
    path: tuple[str | int, ...]
    key: str | None = None
    count: int = 1
    merged: list[Any] = field(default_factory=list)


class _Builder:
    """Makes a value of events. ``root`` is the result, ``line`` where the last event began, from 0."""

    def __init__(self, where: str, most: int, lines: Lines | None) -> None:
        self.root: Any = None
        self.line = 0
        self._where, self._most, self._lines = where, most, lines
        self._open: list[_Open] = []
        self._anchored: dict[str, tuple[Any, int]] = {}
        self._documents = 0

    def take(self, event: yaml.Event) -> None:
        """The next event."""
        line = self.line = event.start_mark.line
        if isinstance(event, yaml.DocumentStartEvent):
            self._documents += 1
            if self._documents > 1:
                where, remedy = _at(self._where, line), "leave out what follows ---"
                raise InputError("a file holds one YAML document", where=where, remedy=remedy)
        elif isinstance(event, yaml.CollectionEndEvent):
            closed = self._open.pop()
            if closed.merged:
                own = dict(closed.value)
                for one in (*reversed(closed.merged), own):
                    closed.value.update(one)
            if closed.anchor is not None:
                self._anchored[closed.anchor] = (closed.value, closed.count)
            self._add_count(closed.count, line)
        elif isinstance(event, yaml.NodeEvent):
            self._node(event, line)

    def _node(self, event: Any, line: int) -> None:
        at = _at(self._where, line)
        if getattr(event, "tag", None) is not None:
            what, remedy = "a value says of which type it is", "leave out the word that begins with !"
            raise InputError(what, where=at, got=f"{event.tag}", expected="a plain value", remedy=remedy)
        is_alias, is_scalar = isinstance(event, yaml.AliasEvent), isinstance(event, yaml.ScalarEvent)
        if not is_alias and event.anchor is not None and len(self._anchored) + len(self._open) > MOST_ANCHORS:
            expected = f"at most {MOST_ANCHORS}"
            raise InputError("YAML has too many anchors", where=at, expected=expected, remedy="write the values out")
        holder = self._open[-1] if self._open else None
        if holder is not None and isinstance(holder.value, dict) and holder.key is None:
            self._key(event, holder, line)
            return
        path: tuple[str | int, ...] = ()
        if holder is not None:
            path = (*holder.path, len(holder.value) if holder.key is None else holder.key)
            if self._lines is not None:
                self._lines.setdefault(path, line + 1)
        count = 1
        if is_alias:
            if any(one.anchor == event.anchor for one in self._open):
                got = f"*{event.anchor}"
                raise InputError("a value contains itself", where=at, got=got, remedy="write the value out")
            if event.anchor not in self._anchored:
                raise InputError("not valid YAML", where=at, got=f"*{event.anchor} without an anchor of this name")
            value, count = self._anchored[event.anchor]
        elif is_scalar:
            value = _scalar(event, at)
            if event.anchor is not None:
                self._anchored[event.anchor] = (value, 1)
        else:
            if len(self._open) >= DEEPEST:
                raise InputError("YAML is nested too deeply", where=at, expected=f"at most {DEEPEST} levels")
            value = {} if isinstance(event, yaml.MappingStartEvent) else []
        self._place(value, holder, at)
        if is_alias or is_scalar:
            self._add_count(count, line)
        else:
            self._open.append(_Open(value, event.anchor, path))

    def _key(self, event: Any, holder: _Open, line: int) -> None:
        at = _at(self._where, line)
        plain = isinstance(event, yaml.ScalarEvent)
        key = _scalar(event, at) if plain else None
        if not isinstance(key, str):
            collection = isinstance(event, yaml.CollectionStartEvent)
            got = event.value if plain else "a list or mapping" if collection else f"*{event.anchor}"
            what, remedy = "a key is no text", "put quotes around it, if it is a name"
            raise InputError(what, where=at, expected="the name of a setting", got=got or "nothing", remedy=remedy)
        if key in holder.value and not (key == _MERGE and event.implicit[0]):
            raise InputError(f"{key!r} is given twice", where=at, remedy="keep one of them")
        if event.anchor is not None:
            self._anchored[event.anchor] = (key, 1)
        holder.key = key
        if self._lines is not None:
            self._lines[*holder.path, key] = line + 1
        self._add_count(1, line)

    def _place(self, value: Any, holder: _Open | None, at: str) -> None:
        if holder is None:
            self.root = value
        elif isinstance(holder.value, list):
            holder.value.append(value)
        elif holder.key == _MERGE:
            many = value if isinstance(value, list) and value else [value]
            if not all(isinstance(one, dict) for one in many):
                raise InputError("what << merges is no mapping", where=at, expected="<<: *NAME of a mapping above")
            holder.merged += many
            holder.key = None
        else:
            holder.value[holder.key] = value
            holder.key = None

    def _add_count(self, count: int, line: int) -> None:
        if not self._open:
            return
        self._open[-1].count += count
        if self._open[-1].count > self._most:
            where = _at(self._where, line)
            got = f"{self._open[-1].count}" + (", repeated by aliases" if self._anchored else "")
            raise InputError("YAML stands for too many values", where=where, expected=f"at most {self._most}", got=got)


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
