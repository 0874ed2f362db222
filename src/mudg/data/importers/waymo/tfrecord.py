"""TFRecord files: a row of records, each with its length and two checksums. Read one record at a time.

Layout of a record: u64 length, u32 masked CRC32C of these eight bytes, the payload, u32 masked CRC32C of the payload, all
little-endian. A mask turns the sum by 15 bits to the right and adds a constant.

Source: TensorFlow's documentation of the format; CRC32C is the Castagnoli polynomial of RFC 3720.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from mudg.base.errors import InputError

MAX_RECORD_BYTES: Final = 512 * 1024 * 1024
"""Real frames have 3 to 8 MB; what declares more than this is refused before any memory is taken."""

_HEADER_BYTES: Final = 12
_FOOTER_BYTES: Final = 4
_MASK_DELTA: Final = 0xA282EAD8
_POLYNOMIAL_REFLECTED: Final = 0x82F63B78

SPARSE_MULTIPLES: Final = ((5685, (1362, 426, 0)), (290, (136, 113, 107, 32, 0)))
"""Multiples of the CRC32C polynomial with few terms, as (degree, lower exponents): x^5685 + x^1362 + x^426 + 1, and one of
degree 290. Squaring a polynomial over GF(2) six times multiplies its exponents by 64, so each is also a multiple whose terms lie
whole 64-bit words apart: a word may be removed by adding it to the words that many places further on."""


def _make_table() -> tuple[int, ...]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (_POLYNOMIAL_REFLECTED if value & 1 else 0)
        table.append(value)
    return tuple(table)


_TABLE: Final = _make_table()


def crc32c(data: bytes | memoryview) -> int:
    """CRC-32C of ``data``, 0 .. 2^32 - 1.

    Long data is first folded: leading words are added (exclusive or) to later ones, where a sparse multiple of the
    polynomial says that the remainder stays the same. That needs three additions a word and runs at memory speed in
    numpy; the two kilobytes that are left go through the usual table.
    """
    count = len(data)
    if count < 64:
        return _through_table(data, 0xFFFFFFFF) ^ 0xFFFFFFFF
    padding = -count % 8
    padded = np.zeros(padding + count, np.uint8)  # zeros in front change nothing once the start value is in the data
    padded[padding:] = np.frombuffer(data, np.uint8)
    padded[padding : padding + 4] ^= 0xFF
    words = padded.view("<u8")
    start = 0
    for degree, lower in SPARSE_MULTIPLES:
        step = degree - lower[0]
        while (left := len(words) - start - degree) > 0:
            size = min(step, left)
            leading = words[start : start + size]
            for exponent in lower:
                place = start + degree - exponent
                words[place : place + size] ^= leading
            start += size
    return _through_table(words[start:].tobytes(), 0) ^ 0xFFFFFFFF


def _through_table(data: bytes | memoryview, crc: int) -> int:
    table = _TABLE
    for byte in bytes(data):
        crc = table[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc


def masked_crc32c(data: bytes | memoryview) -> int:
    """The checksum as TFRecord files store it."""
    crc = crc32c(data)
    return (((crc >> 15) | (crc << 17)) + _MASK_DELTA) & 0xFFFFFFFF


@dataclass(frozen=True, slots=True)
class RecordPlace:
    """Where a record lies: its number, the byte offset of its header, and the length of its payload."""

    number: int
    offset: int
    length: int


def record_places(path: Path) -> Iterator[RecordPlace]:
    """The records of a file in order; only headers are read, and their checksums compared.

    Raises:
        InputError: not a TFRecord file, cut off, a damaged header, or a length that no record has.
    """
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            offset, number = 0, 0
            while offset < size:
                file.seek(offset)
                place = _read_header(file, path, number, offset, size)
                yield place
                offset += _HEADER_BYTES + place.length + _FOOTER_BYTES
                number += 1
    except OSError as error:
        raise InputError("TFRecord file cannot be read", where=str(path), got=str(error)) from error


def _read_header(file: BinaryIO, path: Path, number: int, offset: int, size: int) -> RecordPlace:
    where = _where(path, number, offset)
    header = file.read(_HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        raise _cut_off(where, f"{len(header)} of {_HEADER_BYTES} header bytes")
    length, crc = struct.unpack("<QI", header)
    if masked_crc32c(header[:8]) != crc:
        if number:
            raise InputError(
                "record header is damaged",
                where=where,
                expected="a length that fits its checksum",
                remedy="copy the file again",
            )
        packed = header[:2] == b"\x1f\x8b"
        raise InputError(
            "file is compressed" if packed else "file is not a TFRecord",
            where=str(path),
            expected="a record's length and its checksum",
            got=f"{size} bytes starting {header!r}",
            remedy="unpack it with gunzip" if packed else "is it a download page, a placeholder, or of another format?",
        )
    if length > MAX_RECORD_BYTES:
        raise InputError(
            "record declares a length that no frame has",
            where=where,
            expected=f"at most {MAX_RECORD_BYTES} bytes",
            got=f"{length} bytes",
        )
    if offset + _HEADER_BYTES + length + _FOOTER_BYTES > size:
        raise _cut_off(where, f"{size - offset - _HEADER_BYTES} of {length + _FOOTER_BYTES} bytes")
    return RecordPlace(number, offset, length)


def read_record(file: BinaryIO, path: Path, place: RecordPlace) -> bytes:
    """The payload of a record, its checksum compared.

    Raises:
        InputError: cut off since the headers were read, or damaged.
    """
    where = _where(path, place.number, place.offset)
    file.seek(place.offset + _HEADER_BYTES)
    content = file.read(place.length + _FOOTER_BYTES)
    if len(content) != place.length + _FOOTER_BYTES:
        raise _cut_off(where, f"{len(content)} of {place.length + _FOOTER_BYTES} bytes")
    payload = content[: place.length]
    (crc,) = struct.unpack("<I", content[place.length :])
    if masked_crc32c(payload) != crc:
        raise InputError(
            "record is damaged: its bytes do not fit their checksum",
            where=where,
            expected=f"checksum {crc:#010x}",
            got=f"{masked_crc32c(payload):#010x} over {place.length} bytes",
            remedy="copy the file again, or choose other frames with --frames FIRST:END",
        )
    return payload


def _where(path: Path, number: int, offset: int) -> str:
    return f"{path}: record {number} at byte {offset}"


def _cut_off(where: str, got: str) -> InputError:
    return InputError(
        "TFRecord file is cut off", where=where, expected="a whole record", got=got, remedy="copy the file again"
    )
