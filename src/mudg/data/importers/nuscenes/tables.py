"""The tables of a nuScenes release: JSON arrays of flat records, read one record at a time.

The tables of the full release are large (``sample_data.json`` and ``ego_pose.json`` hold 2.6 million records each). What an
import needs of them is one scene, so records are found by the value of one field while the file passes through a
buffer of a few megabytes; only matching records become Python objects.
"""

from __future__ import annotations

import functools
import itertools
import json
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Final

from mudg.base import store
from mudg.base.errors import InputError
from mudg.data.unknown_fields import note_unknown

_BUFFER_BYTES: Final = 1 << 22
_MAX_RECORD_BYTES: Final = 1 << 20
_FLAT_RECORD: Final = rb'\{(?:[^{}"]++|"(?:[^"\\]++|\\.)*+")*+\}'
"""An object whose fields are not objects; braces may stand in its texts."""
_RECORD: Final = functools.reduce(lambda inner, _: _FLAT_RECORD.replace(rb')*+\}', b"|" + inner + rb')*+\}'), range(3), _FLAT_RECORD)
"""An object with objects in it, three deep: the data set has none, but programs add fields of their own."""
_FLAT: Final = re.compile(_FLAT_RECORD, re.DOTALL)
_ENTRY: Final = re.compile(rb"\s*+(,?)\s*+(" + _RECORD + rb"|\])", re.DOTALL)
_TOKEN: Final = re.compile(r"[A-Za-z0-9_\-]{1,128}")

OFFICIAL: Final[Mapping[str, frozenset[str]]] = {
    "attribute.json": frozenset({"token", "name", "description"}),
    "calibrated_sensor.json": frozenset({"token", "sensor_token", "translation", "rotation", "camera_intrinsic"}),
    "category.json": frozenset({"token", "name", "description", "index"}),
    "ego_pose.json": frozenset({"token", "timestamp", "translation", "rotation"}),
    "instance.json": frozenset({
        "token", "category_token", "nbr_annotations", "first_annotation_token", "last_annotation_token",
    }),
    "sample.json": frozenset({"token", "timestamp", "scene_token", "next", "prev"}),
    "sample_annotation.json": frozenset({
        "token", "sample_token", "instance_token", "attribute_tokens", "visibility_token", "translation", "size", "rotation",
        "num_lidar_pts", "num_radar_pts", "next", "prev",
    }),
    "sample_data.json": frozenset({
        "token", "sample_token", "ego_pose_token", "calibrated_sensor_token", "filename", "fileformat", "width", "height", "timestamp",
        "is_key_frame", "next", "prev",
    }),
    "scene.json": frozenset({
        "token", "name", "description", "log_token", "nbr_samples", "first_sample_token", "last_sample_token",
    }),
    "sensor.json": frozenset({"token", "channel", "modality"}),
}  # fmt: skip
"""Tables that are read -> their fields. Source: the release's published schema; ``index`` came with nuScenes-lidarseg."""

Row = dict[str, Any]


def iter_records(path: Path, *, buffer_bytes: int = _BUFFER_BYTES) -> Iterator[Row]:
    """Every record of a table, in file order. The file is read in pieces; one record is an object at a time.

    Raises:
        InputError: not a JSON array of flat objects, a record over 1 MiB, or the file is cut off.
    """
    with _open(path) as file:
        buffer, offset, first = _start_of_array(file, path, buffer_bytes), 0, True
        position = buffer.index(b"[") + 1
        while True:
            entry = _ENTRY.match(buffer, position)
            if entry is None:
                piece, rest = file.read(buffer_bytes), buffer[position:]
                if not piece and rest.lstrip()[:1] in (b"", b",", b"{"):
                    raise _cut_off(path)
                if not piece or len(rest) > _MAX_RECORD_BYTES:
                    raise _no_records(path, offset + position, rest)
                buffer, offset, position = rest + piece, offset + position, 0
                continue
            if entry[2] == b"]" and not entry[1]:
                return
            if entry[2] == b"]" or first == bool(entry[1]):
                raise _no_records(path, offset + position, entry[0])
            yield _parse(entry[2], path, offset + entry.start(2))
            first, position = False, entry.end()


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
        buffer, offset, piece = _start_of_array(file, path, buffer_bytes), 0, b" "
        while piece:
            piece = file.read(buffer_bytes)
            buffer += piece
            # what follows the last closing brace may be half a record: it waits for the next piece
            end = buffer.rfind(b"}") + 1
            for match in hit.finditer(buffer, 0, end):
                if match[1] in wanted:
                    record = _FLAT.match(buffer, max(0, buffer.rfind(b"{", 0, match.start())))
                    if record is None or record.end() <= match.start():
                        raise _Unclear
                    yield _parse(record[0], path, offset + record.start())
            if not piece and not buffer.rstrip().endswith(b"]"):
                raise _cut_off(path)
            if len(buffer) - end > _MAX_RECORD_BYTES + buffer_bytes:
                raise _no_records(path, offset + end, buffer[end:])
            buffer, offset = buffer[end:], offset + end


def _parse(content: bytes, path: Path, byte: int) -> Row:
    try:
        record = json.loads(content, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise InputError("table record is not valid JSON", where=f"{path}: byte {byte}", got=str(error)) from error
    if path.name in OFFICIAL:
        note_unknown(path.name, record, OFFICIAL[path.name])
    return record


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")


def _open(path: Path) -> BinaryIO:
    if not path.exists():
        raise InputError("table is missing", where=str(path),
            remedy="unpack the release's metadata archive, which holds all tables")  # fmt: skip
    return store.open_file(path)


def _start_of_array(file: BinaryIO, path: Path, buffer_bytes: int) -> bytes:
    """The first piece of the file, to its opening bracket at least."""
    start = file.read(buffer_bytes)
    if start.lstrip()[:1] != b"[":
        raise InputError("table does not start as a JSON array", where=str(path), expected="[ {...}, ... ]",
            got=repr(start[:20]) if start else "an empty file", remedy="copy the table again")  # fmt: skip
    return start


def _cut_off(path: Path) -> InputError:
    expected = "a JSON array closed by ]"
    return InputError("table is cut off", where=str(path), expected=expected, remedy="copy the table again")


def _no_records(path: Path, place: int, got: bytes) -> InputError:
    return InputError("table is not an array of records", where=f"{path}: byte {place}", got=repr(got[:20]),
        expected="flat records {...} of less than 1 MiB between commas")  # fmt: skip


# --- rows -----------------------------------------------------------------------------------------------------------


def text(row: Row, key: str, where: str) -> str:
    """A text field."""
    value = row.get(key)
    if not isinstance(value, str):
        raise _bad_field(row, key, where, "a text")
    return value


def integer(row: Row, key: str, where: str) -> int:
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
    return InputError(f"field {key!r} is missing or malformed", where=f"{where}: record {row.get('token', '?')!r}",
        expected=expected, got=repr(row.get(key))[:120])  # fmt: skip


class TokenTable:
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

    def record(self, token: Any, where: str) -> Row:
        """The record of a token; ``where`` says who refers to it."""
        if not isinstance(token, str) or token not in self.rows:
            raise InputError("a token points nowhere", where=where, got=repr(token),
                expected=f"a record of {self.where}", remedy="are the tables of one release, and complete?")  # fmt: skip
        return self.rows[token]

    def get(self, row: Row, key: str, where: str) -> Row:
        """The record that field ``key`` of ``row`` (in table ``where``) refers to."""
        return self.record(row.get(key), f"{where}: record {row.get('token', '?')!r}: {key}")
