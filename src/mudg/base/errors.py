"""Errors a user can act on.

Every error says what is wrong, where (path, record, field), what was expected, what was found and what to do.
The command line maps each class to an exit code; nothing else in the package knows about exit codes.
"""

from __future__ import annotations

from typing import Self


class MudgError(Exception):
    """Base of all errors raised on purpose.

    Args:
        what: one sentence: what is wrong.
        where: path, record and field, e.g. ``scene.json: frames[12].world_from_cam``.
        expected: what would have been right.
        got: what was found.
        remedy: what the user can do about it.
    """

    exit_code = 1

    def __init__(self, what: str, *, where: str = "", expected: str = "", got: str = "", remedy: str = "") -> None:
        self.what = what
        self.where = where
        self.expected = expected
        self.got = got
        self.remedy = remedy
        super().__init__(self._text())

    def _text(self) -> str:
        lines = [self.what]
        fields = (("where", self.where), ("expected", self.expected), ("got", self.got), ("what to do", self.remedy))
        lines.extend(f"  {name}: {value}" for name, value in fields if value)
        return "\n".join(lines)

    def located(self, where: str) -> Self:
        """The same error with another place."""
        return type(self)(self.what, where=where, expected=self.expected, got=self.got, remedy=self.remedy)

    def __reduce__(self) -> tuple[object, ...]:
        """Keep the fields when the error crosses a process boundary."""
        fields = {"where": self.where, "expected": self.expected, "got": self.got, "remedy": self.remedy}
        return (_rebuild, (type(self), self.what, fields))


def _rebuild(cls: type[MudgError], what: str, fields: dict[str, str]) -> MudgError:
    return cls(what, **fields)


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
