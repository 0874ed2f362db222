"""Damage to bytes, by seeded chance: cut, flipped, overwritten, taken out, put in; also within what has a checksum of
its own."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import PurePath

import numpy as np

from mudg.formats.importers.waymo_logs import masked_crc32c
from mudg.formats.splats import binary

Damage = Callable[[bytes, np.random.Generator], bytes]
HEAD = 400


def _cut(content: bytearray, rng: np.random.Generator) -> None:
    del content[int(rng.integers(len(content))) :]


def _flip(content: bytearray, rng: np.random.Generator) -> None:
    for _ in range(int(rng.integers(1, 4))):
        content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))


def _set_in_head(content: bytearray, rng: np.random.Generator) -> None:
    content[int(rng.integers(min(len(content), HEAD)))] = int(rng.integers(256))


def _largest(content: bytearray, rng: np.random.Generator) -> None:
    at, count = int(rng.integers(len(content))), int(rng.integers(1, 9))
    content[at : at + count] = b"\xff" * count


def _take_out(content: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(content)))
    del content[at : at + int(rng.integers(1, 64))]


def _put_in(content: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(content)))
    content[at:at] = rng.bytes(int(rng.integers(1, 32)))


def _no_number(content: bytearray, rng: np.random.Generator) -> None:
    value = float(rng.choice([np.nan, np.inf, -np.inf, 1e38, -1e38, 0]))
    at = int(rng.integers(max(len(content) - 3, 1)))
    content[at : at + 4] = struct.pack("<f", value)


KINDS = (_cut, _flip, _set_in_head, _largest, _take_out, _put_in, _no_number)


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """The bytes with one kind of damage."""
    changed = bytearray(content)
    if changed:
        KINDS[int(rng.integers(len(KINDS)))](changed, rng)
    return bytes(changed)


def damaged_within(name: str, content: bytes, rng: np.random.Generator) -> bytes:
    """The bytes of a file damaged below its own compression or checksums, which then fit again; as ``damaged`` where it
    has none."""
    found = _within(PurePath(name).suffix.lower())
    return damaged(content, rng) if found is None else found(content, rng)


def _within(suffix: str) -> Damage | None:
    return {
        ".gz": _in_gzip,
        ".spz": _in_gzip,
        ".npz": _in_zip,
        ".sog": _in_zip,
        ".glb": _in_json_of_glb,
        ".tfrecord": _in_record,
        ".png": _in_png,
    }.get(suffix)


def _in_gzip(content: bytes, rng: np.random.Generator) -> bytes:
    return (
        gzip.compress(damaged(gzip.decompress(content), rng), mtime=0)
        if content[:2] == b"\x1f\x8b"
        else damaged(content, rng)
    )


def _in_zip(content: bytes, rng: np.random.Generator) -> bytes:
    archive = zipfile.ZipFile(io.BytesIO(content))
    files = {name: archive.read(name) for name in archive.namelist()}
    chosen = list(files)[int(rng.integers(len(files)))]
    return binary.stored_zip({**files, chosen: damaged(files[chosen], rng)})


def _in_json_of_glb(content: bytes, rng: np.random.Generator) -> bytes:
    size = int.from_bytes(content[12:16], "little")
    text = damaged(content[20 : 20 + size], rng)
    text += b" " * (-len(text) % 4)
    rest = content[20 + size :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def _in_record(content: bytes, rng: np.random.Generator) -> bytes:
    records, at = [], 0
    while at < len(content):
        (size,) = struct.unpack_from("<Q", content, at)
        records.append(content[at + 12 : at + 12 + size])
        at += 16 + size
    chosen = int(rng.integers(len(records)))
    records[chosen] = damaged(records[chosen], rng)
    made = b""
    for record in records:
        head = struct.pack("<Q", len(record))
        made += head + struct.pack("<I", masked_crc32c(head)) + record + struct.pack("<I", masked_crc32c(record))
    return made


def _in_png(content: bytes, rng: np.random.Generator) -> bytes:
    """A chunk of a PNG with the checksum of what it holds now."""
    chunks, at = [], 8
    while at < len(content):
        (size,) = struct.unpack_from(">I", content, at)
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + size]))
        at += 12 + size
    chosen = int(rng.integers(len(chunks)))
    chunks[chosen] = (chunks[chosen][0], damaged(chunks[chosen][1], rng))
    made = content[:8]
    for kind, body in chunks:
        made += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return made
