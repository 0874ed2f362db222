"""Errors a user can act on.

Every error says what is wrong, where (path, record, field), what was expected, what was found and what to do.
The command line maps each class to an exit code; nothing else in the package knows about exit codes.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Final, Self

MOST_LETTERS: Final = 200
"""Of a value in a message: names and values of foreign files may be megabytes long."""
_CONTROLS: Final = re.compile(
    "[\x00-\x1f\x7f-\x9f\xad\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u2069\ufeff\ud800-\udfff]"
)
"""What a terminal obeys, what turns the direction of writing, what is not seen, and halves of letters."""
_LONGEST_LINE: Final = 2000
_CONTINUED: Final = "\n    "
"""A further line of a remedy."""


def plain(text: object) -> str:
    """A text as one line without control characters: they are written as escapes, as in ``\\x1b`` and ``\\n``."""
    return _CONTROLS.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), str(text))


def short(value: object, most: int = MOST_LETTERS) -> str:
    """``plain`` of a value's text; of one longer than ``most`` letters the middle is left out."""
    text = str(value)
    text = plain(text if len(text) <= 2 * most else text[:most] + text[-most:])
    return text if len(text) <= most else f"{text[: most - most // 3 - 5]} ... {text[-(most // 3) :]}"


def plain_lines(lines: Iterable[object]) -> str:
    """Lines of a report or table for a terminal: none of them can be broken, or say something to the terminal."""
    return "\n".join(short(line, _LONGEST_LINE) for line in lines)


def nearest(name: object, known: Iterable[str], least: float = 0.6) -> str:
    """The known name that is most like another; empty where none is. least: likeness from 0 to 1."""
    return next(iter(difflib.get_close_matches(str(name)[:MOST_LETTERS], list(known), 1, least)), "")


def similar_path(path: str | os.PathLike[str]) -> str:
    """A remedy for a path at which nothing is: the existing one that is most like it; empty where none is."""
    whole = Path(path)
    for part in (whole, *whole.parents):
        if not part.exists() and part.parent.is_dir():
            with contextlib.suppress(OSError):
                names = [entry.name for entry in part.parent.iterdir() if not entry.name.startswith(".")]
                near = nearest(part.name, names)
                return f"did you mean {part.parent / near / whole.relative_to(part)}?" if near else ""
    return ""


def _listed(text: str, separator: str, most: int) -> str:
    """``short`` of a list of values, and of each of them."""
    text = text if len(text) <= 2 * most else f"{text[:most]} ... {text[-most:]}"
    return short(separator.join(short(part) for part in text.split(separator)), most)


class MudgError(Exception):
    """Base of all errors raised on purpose. what: one sentence: what is wrong. where: path, record and field, e.g.
    ``scene.json: frames[12].world_from_cam``. expected: what would have been right. got: what was found. remedy: what
    the user can do about it. Long values are cut and control characters escaped, here for all messages."""

    exit_code = 1

    def __init__(self, what: str, *, where: str = "", expected: str = "", got: str = "", remedy: str = "") -> None:
        self.what = short(what, 300)
        self.where = _listed(where, "/", 400)
        self.expected = _listed(expected, ", ", 1000)
        self.got = _listed(got.replace("\n  ", "; "), "; ", 800)  # of an error that holds another one
        self.remedy = _CONTINUED.join(_listed(line, ", ", 1000) for line in remedy.split(_CONTINUED)[:100])
        fields = (("where", self.where), ("expected", self.expected), ("got", self.got), ("what to do", self.remedy))
        super().__init__("\n".join([self.what, *(f"  {name}: {value}" for name, value in fields if value)]))

    @property
    def fields(self) -> dict[str, str]:
        """All but what is wrong, as this class takes them."""
        return {"where": self.where, "expected": self.expected, "got": self.got, "remedy": self.remedy}

    def located(self, where: str) -> Self:
        """The same error with another place."""
        return type(self)(self.what, **{**self.fields, "where": where})

    def __reduce__(self) -> tuple[object, ...]:
        """Keep the fields when the error crosses a process boundary."""
        return functools.partial(type(self), **self.fields), (self.what,)


class UsageError(MudgError):
    """Wrong command, flag or configuration value (exit code 2)."""

    exit_code = 2


class InputError(MudgError):
    """A file or value handed in by the user is missing, malformed or contradictory (exit code 3)."""

    exit_code = 3


class IntegrityError(MudgError):
    """Something this program wrote earlier no longer matches its recorded hash (exit code 4)."""

    exit_code = 4


class ResourceError(MudgError):
    """Missing: disk, memory, compiler, device or package; or another process is in the way (5)."""

    exit_code = 5


class NumericsError(MudgError):
    """A non-finite loss, gradient or value that must not reach the parameters (exit code 6)."""

    exit_code = 6
