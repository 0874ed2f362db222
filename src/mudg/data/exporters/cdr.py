"""Messages of ROS 2 as bytes: definitions as ``.msg`` files state them, and values as CDR (OMG's XCDR version 1, little endian).

A definition is lines of ``type name``. Every value is aligned to its size, counted after the four bytes of the header; texts and lists
begin with their length.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from mudg.base.errors import InputError

HEADER: Final = b"\0\1\0\0"
LINE: Final = "=" * 80
PRIMITIVES: Final = {
    "bool": "?", "byte": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I",
    "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_FIELD: Final = re.compile(r"([A-Za-z][\w/]*)(\[(\d*)\])? ([a-z]\w*)")


@dataclass(frozen=True, slots=True)
class CdrField:
    """One field: its type, its name, and how often it stands there (None: once; -1: any number, stated before; else fixed)."""

    kind: str
    name: str
    count: int | None


class Definitions:
    """Types of messages by name, ``package/Type``.

    Args:
        texts: name -> the lines of its definition.
    """

    def __init__(self, texts: Mapping[str, str]) -> None:
        self._texts = {name: text.strip() + "\n" for name, text in texts.items()}
        self._fields = {name: [_field(line, name) for line in text.splitlines()] for name, text in self._texts.items()}

    def schema(self, name: str) -> str:
        """The definition of a type, followed by those of all types that it uses."""
        parts, waiting, seen = [self._texts[name]], [name], {name}
        while waiting:
            for field in self._fields[waiting.pop(0)]:
                if field.kind not in PRIMITIVES and field.kind != "string" and field.kind not in seen:
                    seen.add(field.kind)
                    waiting.append(field.kind)
                    parts.append(f"{LINE}\nMSG: {field.kind}\n{self._texts[field.kind]}")
        return "".join(parts)

    def content(self, name: str, value: Mapping[str, Any]) -> bytes:
        """The bytes of a message.

        Args:
            value: its fields; those that are left out are zero or empty. ``uint8[]`` takes bytes.

        Raises:
            KeyError: a field that the type does not have.
        """
        out = bytearray(HEADER)
        self._record(out, name, value)
        return bytes(out)

    def _record(self, out: bytearray, name: str, value: Mapping[str, Any]) -> None:
        fields = self._fields[name]
        unknown = set(value) - {field.name for field in fields}
        if unknown:
            raise KeyError(f"{name} has no field {sorted(unknown)[0]}")
        for field in fields:
            self._value(out, field, value.get(field.name))

    def _value(self, out: bytearray, field: CdrField, value: Any) -> None:
        if field.count is None:
            self._one(out, field.kind, value)
            return
        items: Sequence[Any] = value if value is not None else [None] * max(field.count, 0)
        if field.count < 0:
            _number(out, "I", len(items))
        elif len(items) != field.count:
            raise ValueError(f"{field.name} takes {field.count} values, not {len(items)}")
        if field.kind == "uint8" and isinstance(items, bytes):
            out += items
            return
        for item in items:
            self._one(out, field.kind, item)

    def _one(self, out: bytearray, kind: str, value: Any) -> None:
        if kind == "string":
            text = str(value or "").encode()
            if b"\0" in text:
                raise InputError("a name holds a zero byte, which ROS cannot carry", got=repr(value))
            _number(out, "I", len(text) + 1)
            out += text + b"\0"
        elif kind in PRIMITIVES:
            _number(out, PRIMITIVES[kind], value or 0)
        else:
            self._record(out, kind, value or {})


def _field(line: str, where: str) -> CdrField:
    found = _FIELD.fullmatch(line.strip())
    if found is None:
        raise ValueError(f"{where}: not a field: {line!r}")
    kind, several, count, name = found.groups()
    return CdrField(kind, name, None if several is None else int(count) if count else -1)


def _number(out: bytearray, code: str, value: float) -> None:
    size = struct.calcsize(f"<{code}")
    out += b"\0" * (-(len(out) - len(HEADER)) % size)
    out += struct.pack(f"<{code}", value)
