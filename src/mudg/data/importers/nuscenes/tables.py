"""The tables of a nuScenes release: JSON arrays of flat records, read one record at a time.

The tables of the full release are large (``sample_data.json`` and ``ego_pose.json`` hold 2.6 million records each). What an
import needs of them is one scene, so records are found by the value of one field while the file passes through a
buffer of a few megabytes; only matching records become Python objects.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final

from mudg.base.errors import InputError

_BUFFER_BYTES: Final = 1 << 22
_MAX_RECORD_BYTES: Final = 1 << 20
_SPACE: Final = b" \t\r\n"
_NOT_SPACE: Final = re.compile(rb"[^ \t\r\n]")
_TOKEN: Final = re.compile(r"[A-Za-z0-9_\-]{1,128}")

Row = dict[str, Any]


def iter_records(path: Path, *, buffer_bytes: int = _BUFFER_BYTES) -> Iterator[Row]:
    """Every record of a table, in file order. The file is read in pieces; one record is an object at a time.

    Raises:
        InputError: not a JSON array of objects, a record over 1 MiB, or the file is cut off.
    """
    for content, where in _raw_records(path, buffer_bytes):
        yield _parse(content, where)


def find_records(
    path: Path, field: str, values: Collection[str], *, buffer_bytes: int = _BUFFER_BYTES
) -> Iterator[Row]:
    """Records whose text ``field`` is one of ``values``, in file order.

    Records that do not match are not parsed: the field is looked for in the bytes, and the record around a hit is cut
    out and parsed strictly. Where that fails (braces inside texts) every record is parsed instead. The file's first and
    last character are checked, so that a cut-off table is noticed. ``values`` are tokens: texts without escapes.

    Raises:
        InputError: no JSON array, a matching record that is malformed, or the file is cut off.
    """
    found = 0
    try:
        for record in _search(path, field, values, buffer_bytes):
            found += 1
            yield record
    except _Unclear:
        matching = (r for r in iter_records(path, buffer_bytes=buffer_bytes) if r.get(field) in values)
        yield from itertools.islice(matching, found, None)


class _Unclear(Exception):
    """The bytes around a hit are no record: the quick search cannot go on."""


def _search(path: Path, field: str, values: Collection[str], buffer_bytes: int) -> Iterator[Row]:
    wanted = {value.encode() for value in values}
    hit = re.compile(rb'"' + re.escape(field.encode()) + rb'"\s*:\s*"([^"\\]*)"')
    with _open(path) as file:
        buffer = file.read(buffer_bytes)
        if _first(buffer) != b"[":
            raise _not_an_array(path, buffer)
        offset, at_end = 0, False
        while not at_end:
            piece = file.read(buffer_bytes)
            at_end = not piece
            buffer += piece
            # what follows the last closing brace may be half a record: it waits for the next piece
            end = buffer.rfind(b"}") + 1
            for match in hit.finditer(buffer, 0, end):
                if match[1] in wanted:
                    start, stop = _record_around(buffer, match.start())
                    yield _parse(buffer[start:stop], f"{path}: byte {offset + start}")
            if at_end and not buffer.rstrip(_SPACE).endswith(b"]"):
                raise _cut_off(path)
            if len(buffer) - end > _MAX_RECORD_BYTES + buffer_bytes:
                raise InputError("a record is too long", where=f"{path}: byte {offset + end}", expected="under 1 MiB")
            buffer, offset = buffer[end:], offset + end


def _record_around(buffer: bytes, at: int) -> tuple[int, int]:
    """Start and end of the object that holds the byte ``at``."""
    start = buffer.rfind(b"{", max(0, at - _MAX_RECORD_BYTES), at)
    end = _object_end(buffer, start) if start >= 0 else None
    if end is None or end <= at:
        raise _Unclear
    return start, end


_STRUCTURE: Final = re.compile(rb'"[^"\\]*(?:\\.[^"\\]*)*(?:"|\\?\Z)|[{}\[\]]', re.DOTALL)
"""A text (to its closing quote, or to the end of the buffer) or a bracket."""


def _object_end(buffer: bytes, start: int) -> int | None:
    """Where the object that opens at ``start`` ends (exclusive); None when it does not end in the buffer."""
    depth = 0
    for match in _STRUCTURE.finditer(buffer, start, start + _MAX_RECORD_BYTES):
        mark = match[0]
        if mark in (b"{", b"["):
            depth += 1
        elif mark in (b"}", b"]"):
            depth -= 1
            if depth == 0:
                return match.end()
    return None


def _raw_records(path: Path, buffer_bytes: int) -> Iterator[tuple[bytes, str]]:
    """Bytes and place of each record of a JSON array of objects."""
    with _open(path) as file:
        buffer, position, offset = file.read(buffer_bytes), 0, 0
        if _first(buffer) != b"[":
            raise _not_an_array(path, buffer)
        position = buffer.index(b"[") + 1
        after_record = False
        while True:
            found = _NOT_SPACE.search(buffer, position)
            end = _object_end(buffer, found.start()) if found and buffer[found.start()] == ord("{") else None
            if found is None or (buffer[found.start()] == ord("{") and end is None):
                piece = file.read(buffer_bytes)
                if not piece:
                    raise _cut_off(path)
                if len(buffer) - position > _MAX_RECORD_BYTES:
                    raise InputError("a record is too long", where=f"{path}: byte {offset + position}")
                buffer, offset, position = buffer[position:] + piece, offset + position, 0
                continue
            start = found.start()
            mark = buffer[start : start + 1]
            if mark == b"]":
                return
            if mark == b"," and after_record:
                after_record, position = False, start + 1
            elif mark == b"{" and not after_record and end is not None:
                yield buffer[start:end], f"{path}: byte {offset + start}"
                after_record, position = True, end
            else:
                raise InputError(
                    "table is not an array of records",
                    where=f"{path}: byte {offset + start}",
                    expected="records {...} between commas",
                    got=repr(buffer[start : start + 20]),
                )


def _parse(content: bytes, where: str) -> Row:
    try:
        record = json.loads(content, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise InputError("table record is not valid JSON", where=where, got=str(error)) from error
    return record


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")


def _open(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except FileNotFoundError as error:
        raise InputError(
            "table is missing", where=str(path), remedy="unpack the release's metadata archive, which holds all tables"
        ) from error
    except OSError as error:
        raise InputError("table cannot be read", where=str(path), got=str(error)) from error


def _first(piece: bytes) -> bytes:
    return piece.lstrip(_SPACE)[:1]


def _not_an_array(path: Path, piece: bytes) -> InputError:
    return InputError(
        "table does not start as a JSON array",
        where=str(path),
        expected="[ {...}, ... ]",
        got=repr(piece[:20]) if piece else "an empty file",
        remedy="copy the table again",
    )


def _cut_off(path: Path) -> InputError:
    return InputError(
        "table is cut off", where=str(path), expected="a JSON array closed by ]", remedy="copy the table again"
    )


# --- rows -----------------------------------------------------------------------------------------------------------


def text(row: Row, key: str, where: str) -> str:
    """A text field."""
    value = row.get(key)
    if not isinstance(value, str):
        raise _bad_field(row, key, where, "a text")
    return value


def whole(row: Row, key: str, where: str) -> int:
    """An integer field."""
    value = row.get(key)
    if isinstance(value, bool) or not isinstance(value, int):
        raise _bad_field(row, key, where, "an integer")
    return value


def numbers(row: Row, key: str, count: int, where: str) -> list[float]:
    """A field that is a list of ``count`` numbers."""
    value = row.get(key)
    if not isinstance(value, list) or len(value) != count or not all(_is_number(item) for item in value):
        raise _bad_field(row, key, where, f"{count} numbers")
    return [float(item) for item in value]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _bad_field(row: Row, key: str, where: str, expected: str) -> InputError:
    return InputError(
        f"field {key!r} is missing or malformed",
        where=f"{where}: record {row.get('token', '?')!r}",
        expected=expected,
        got=repr(row.get(key))[:120],
    )


class Table:
    """Records of one table by their token; asking for one that is not there names who refers to it."""

    def __init__(self, path: Path, records: Iterator[Row]) -> None:
        self.where = str(path)
        self.rows: dict[str, Row] = {}
        for row in records:
            token = row.get("token")
            if not isinstance(token, str) or not _TOKEN.fullmatch(token):
                raise InputError("record has no token", where=self.where, got=repr(token)[:80])
            if self.rows.setdefault(token, row) is not row:
                raise InputError("two records have one token", where=self.where, got=token)

    def __getitem__(self, token: str) -> Row:
        if token not in self.rows:
            raise InputError(
                "a token points nowhere",
                where=self.where,
                got=f"no record {token!r}",
                remedy="are the tables of one release, and complete?",
            )
        return self.rows[token]

    def get(self, row: Row, key: str, where: str) -> Row:
        """The record that field ``key`` of ``row`` (in table ``where``) refers to."""
        token = row.get(key)
        if not isinstance(token, str) or token not in self.rows:
            raise InputError(
                "a token points nowhere",
                where=f"{where}: record {row.get('token', '?')!r}: {key}",
                got=repr(token),
                expected=f"a record of {self.where}",
                remedy="are the tables of one release, and complete?",
            )
        return self.rows[token]
