"""The files of an NCore recording, checked before NVIDIA's package reads them: nothing is larger in memory than its file can hold, and
nothing is run.

A store is a zarr hierarchy in one tar file (``.zarr.itar``: members, then an index, then a block that says where the index is) or in a
folder (``.zarr``). All metadata stand once more in one compressed member, which is what the package reads. The package trusts sizes and
codecs; here every size is held against the bytes that are there, and codecs other than the format's own (pickle is one) are refused.
"""

from __future__ import annotations

import lzma
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from mudg.base import memory, store
from mudg.base.errors import InputError, MudgError
from mudg.data.importers.columns import record_fields
from mudg.data.unknown_fields import note_unknown

METADATA: Final = ".zmetadata.cbor.xz"
_BLOCK: Final = 512
_HEADER: Final = struct.Struct("<4sIQI")
_XZ_MEMORY: Final = 256 << 20
_LEAST_UNPACKED: Final = 1 << 20
_MOST_GROWTH: Final = 40
"""Metadata unpack to no more than this times their compressed size (poses and boxes: some 5 to 20)."""
_CONTAINERS: Final = bytes(range(0x80, 0xC0))
"""Bytes that begin a list or a map in CBOR."""
_CONTAINER_BYTES: Final = 72
_MOST_LZ4: Final = 256
_BLOSC_HEADER: Final = struct.Struct("<4B3I")
_KINDS: Final = "biufS"
COMPONENTS: Final = frozenset({
    "poses", "intrinsics", "masks", "cameras", "lidars", "radars", "cuboids", "point_clouds", "camera_labels",
})  # fmt: skip
"""Components of the format, read or not."""


@dataclass(frozen=True, slots=True)
class _StoredMember:
    """Where a member's bytes are."""

    path: Path
    offset: int
    size: int

    def read(self, most: int | None = None) -> bytes:
        """Its bytes, or the first of them."""
        with store.open_file(self.path) as handle:
            handle.seek(self.offset)
            return handle.read(self.size if most is None else min(most, self.size))


@contextmanager
def foreign_reader(where: str) -> Iterator[None]:
    """Code of the package that reads a file: whatever it raises becomes an InputError. It reports damage by errors of every kind."""
    try:
        yield
    except MudgError:
        raise
    except Exception as error:
        raise InputError("NCore recording cannot be read", where=where, got=f"{type(error).__name__}: {error}"[:300],
            remedy="is a file of it damaged, missing, or of another version? copy it again") from error  # fmt: skip


def check_store(path: Path) -> None:
    """Refuse a store that is cut off, that contradicts itself, or that would take more memory than its files can need.

    Raises:
        InputError: so it is; nothing of the size that was promised has been allocated.
    """
    members = _members_of_folder(path) if path.is_dir() else _members_of_tar(path)
    where = f"{path}: {METADATA}"
    if METADATA not in members:
        raise InputError("NCore store has no metadata", where=where, expected="a store that was finished",
            remedy="was the program that wrote it stopped?")  # fmt: skip
    with record_fields("NCore metadata make no sense", where, "groups and arrays of zarr 2"):
        metadata = _cbor(_unpacked(members[METADATA].read(), where), where)["metadata"]
        chunks = _chunk_sizes(members)
        groups = dict.fromkeys(name.partition("/")[0] for name in metadata if "/" in name)
        note_unknown("the stores of the recording", groups, COMPONENTS)
        for name, about in metadata.items():
            if name.endswith(".zarray"):
                place = name.removesuffix(".zarray")
                _check_array(about, chunks.get(place, {}), f"{path}: {place.rstrip('/')}")


# --- containers -----------------------------------------------------------------------------------------------------


def _members_of_folder(path: Path) -> dict[str, _StoredMember]:
    files = [store.regular(file) for file in sorted(path.rglob("*")) if not file.is_dir()]
    return {file.relative_to(path).as_posix(): _StoredMember(file, 0, file.stat().st_size) for file in files}


def _members_of_tar(path: Path) -> dict[str, _StoredMember]:
    size = store.regular(path).stat().st_size
    where = f"{path}: index"
    last = _StoredMember(path, max(0, size - _BLOCK), _BLOCK).read()
    magic, kind, offset, length = _HEADER.unpack(last[: _HEADER.size].ljust(_HEADER.size, b"\0"))
    if magic != b"itar" or kind != 1 or size % _BLOCK:
        raise InputError("not an indexed tar file, or cut off", where=str(path), expected="an index in the last 512 bytes",
            got=f"{size} bytes, the last block begins with {last[:8]!r}", remedy="copy the file again")  # fmt: skip
    if offset + length > size - _BLOCK:
        raise InputError("index lies outside of the file", where=where, expected=f"at most {size - _BLOCK} bytes",
            got=f"{length} bytes from {offset} on", remedy="copy the file again")  # fmt: skip
    with record_fields("index makes no sense", where, "names, offsets and sizes of members"):
        table = _cbor(_unpacked(_StoredMember(path, offset, length).read(), where), where)
        names, offsets, sizes = table["items"], table["offset_datas"], table["sizes"]
        if not len(names) == len(offsets) == len(sizes):
            raise InputError(
                "index contradicts itself", where=where, got=f"{len(names)}, {len(offsets)}, {len(sizes)} entries"
            )
        for name, begin, count in zip(names, offsets, sizes, strict=True):
            if not (isinstance(name, str) and _whole(begin) and _whole(count) and begin + count <= size):
                raise InputError("member lies outside of the file", where=f"{path}: {str(name)[:80]}", expected=f"at most {size} bytes",
                    got=f"{count} bytes from {begin} on"[:120], remedy="copy the file again")  # fmt: skip
        return {
            name: _StoredMember(path, begin, count) for name, begin, count in zip(names, offsets, sizes, strict=True)
        }


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _unpacked(packed: bytes, where: str) -> bytes:
    """An xz file that is not larger than such metadata can be."""
    most = max(_LEAST_UNPACKED, _MOST_GROWTH * len(packed))
    unpacker = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY)
    try:
        content = unpacker.decompress(packed, most + 1)
    except (lzma.LZMAError, EOFError) as error:
        raise InputError(
            "compressed metadata are damaged", where=where, got=str(error), remedy="copy the file again"
        ) from error
    if len(content) > most:
        raise InputError("compressed metadata unpack to more than metadata can be", where=where, got=f"{len(packed)} bytes",
            expected=f"at most {most} bytes when unpacked")  # fmt: skip
    if not unpacker.eof:
        raise InputError(
            "compressed metadata are cut off", where=where, got=f"{len(packed)} bytes", remedy="copy the file again"
        )
    return content


def _cbor(content: bytes, where: str) -> Any:
    import cbor2  # type: ignore[import-not-found]

    heads = len(content) - len(
        content.translate(None, _CONTAINERS)
    )  # as many lists and maps at most: a byte makes an object
    memory.require(_CONTAINER_BYTES * heads + 8 * len(content), f"reading {where}", "a machine with more memory")
    try:
        found = cbor2.loads(content)
    except (
        cbor2.CBORError,
        ValueError,
        TypeError,
        OverflowError,
        RecursionError,
        MemoryError,
        UnicodeDecodeError,
    ) as error:
        raise InputError(
            "metadata are damaged", where=where, got=str(error)[:120], remedy="copy the file again"
        ) from error
    if not isinstance(found, dict):
        raise InputError("metadata are of another kind", where=where, expected="a map", got=type(found).__name__)
    return found


# --- arrays ---------------------------------------------------------------------------------------------------------


def _chunk_sizes(members: Mapping[str, _StoredMember]) -> dict[str, dict[str, _StoredMember]]:
    """Array (with a slash at the end) -> its chunks by their names."""
    found: dict[str, dict[str, _StoredMember]] = {}
    for name, member in members.items():
        folder, slash, last = name.rpartition("/")
        if not last.startswith("."):
            found.setdefault(folder + slash, {})[last] = member
    return found


def _check_array(about: Mapping[str, Any], chunks: Mapping[str, _StoredMember], where: str) -> None:
    """Refuse an array that its chunks cannot fill, that is not of plain numbers or bytes, or that is packed in another way."""
    codec, nested = about["compressor"], about.get("dimension_separator", ".") != "."
    if nested or about.get("filters") or not (codec is None or codec["id"] == "blosc"):
        raise InputError("array is packed in a way that is not read", where=where, expected="blosc or nothing, chunks named 0.0",
            got=str(about.get("filters") or (about["dimension_separator"] if nested else codec))[:120])  # fmt: skip
    kind = np.dtype(about["dtype"])
    if kind.hasobject or kind.kind not in _KINDS:
        raise InputError("array is not of plain numbers or bytes", where=where, got=str(about["dtype"])[:80])
    shape, pieces = about["shape"], about["chunks"]
    if len(shape) != len(pieces) or not all(map(_whole, (*shape, *pieces))) or 0 in pieces:
        raise InputError(
            "array has a shape that makes no sense", where=where, got=f"{shape} in chunks of {pieces}"[:120]
        )
    grid = [-(-side // piece) for side, piece in zip(shape, pieces, strict=True)]
    names = (".".join(map(str, place)) or "0" for place in (_places(grid) if math.prod(shape) else ()))
    if (lost := next((name for name in names if name not in chunks), None)) is not None:  # the package would fill it with a constant
        raise InputError("chunk of an array is missing", where=f"{where}/{lost}", expected=f"chunks of {pieces} for {shape}"[:120],
            got=f"{len(chunks)} chunks", remedy="copy the recording again")  # fmt: skip
    stored, growth = sum(chunk.size for chunk in chunks.values()), 1 if codec is None else _MOST_LZ4
    piece = math.prod(pieces) * kind.itemsize
    if max(math.prod(shape) * kind.itemsize, piece if math.prod(shape) else 0) > growth * stored:
        raise InputError("array is larger than its file can hold", where=where, got=f"{shape} of {kind} in {stored} bytes"[:120],
            remedy="is the file cut off?")  # fmt: skip
    for name, chunk in chunks.items():
        size = chunk.size if codec is None else _blosc_size(chunk, f"{where}/{name}")
        if size != piece:
            raise InputError("chunk of an array is of another size", where=f"{where}/{name}", expected=f"{piece} bytes", got=f"{size}",
                remedy="copy the file again")  # fmt: skip


def _places(grid: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """Indices of a grid of chunks one by one: a file may promise more of them than memory holds."""
    for first in range(grid[0]) if grid else ():
        yield from ((first, *rest) for rest in _places(grid[1:]))
    if not grid:
        yield ()


def _blosc_size(chunk: _StoredMember, where: str) -> int:
    """Bytes that a chunk unpacks to."""
    head = chunk.read(_BLOSC_HEADER.size)
    if len(head) < _BLOSC_HEADER.size:
        raise InputError("chunk of an array is cut off", where=where, got=f"{len(head)} bytes")
    *_, unpacked, block, packed = _BLOSC_HEADER.unpack(head)
    if packed != chunk.size or block > max(unpacked, 1):
        raise InputError("chunk of an array is damaged", where=where, got=f"{chunk.size} bytes", expected=f"{packed}")
    return unpacked
