"""Reading and writing bytes that nobody vouches for: parts within bounds, inflating within bounds, zips."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.formats.splats.cloud import MAX_GAUSSIANS, Floats

MAX_BYTES: Final = 8 << 30
"""No file, and nothing that a file inflates to, may be larger."""
MOST_FILES: Final = 100_000
"""Files of a zip."""


def part(content: bytes, start: int, size: int, what: str, where: str) -> memoryview:
    """``size`` bytes from ``start``; InputError if the content ends before."""
    if start < 0 or size < 0 or start + size > len(content):
        what, expected = f"the file ends within {what}", f"{start + size} bytes"
        remedy = "it was cut off, or its header is damaged: get the file again"
        raise InputError(what, where=where, expected=expected, got=f"{len(content)} bytes", remedy=remedy)
    return memoryview(content)[start : start + size]


def unpacked(layout: str, content: bytes, start: int, what: str, where: str) -> tuple[Any, ...]:
    """``struct.unpack`` within bounds."""
    return struct.unpack(layout, part(content, start, struct.calcsize(layout), what, where))


def refuse_count(count: int, where: str) -> None:
    """InputError for a number of Gaussians or points that no file holds."""
    if not 0 < count <= MAX_GAUSSIANS:
        what = "the number of rows in the header is not possible"
        raise InputError(what, where=where, expected=f"1 to {MAX_GAUSSIANS}", got=str(count))


def refuse_bomb(count: int, content: bytes, where: str) -> None:
    """InputError for more Gaussians than a compressed file of this size holds: at most 20 a byte, hundreds of times
    what is usual."""
    if count > 20 * len(content) + 65536:
        what = "the header names more Gaussians than a file of this size can hold"
        raise InputError(what, where=where, expected=f"at most {20 * len(content) + 65536}", got=str(count))


def text_table(body: bytes, columns: int, rows: int, where: str) -> NDArray[np.float64]:
    """Numbers between spaces as f64[rows, columns]; InputError: others, or more or fewer."""
    if rows * columns * 2 > len(body) + 1:  # a digit and a separator each
        raise InputError("the file is cut off", where=where, expected=f"{rows} rows", got=f"{len(body)} bytes")
    try:
        table = np.array(body.split(), np.float64)
    except ValueError as error:
        raise InputError("a value is no number", where=where, got=str(error)[:120]) from error
    if len(table) != rows * columns:
        what = "the file is cut off, or has rows of another length"
        raise InputError(what, where=where, got=f"{len(table)} numbers", expected=f"{rows} rows of {columns}")
    return table.reshape(rows, columns)


# -- compressed streams ----------------------------------------------------------------------------


def inflated(packer: Any, content: bytes, size: int, where: str) -> bytes:
    """Up to ``size`` bytes from a ``zlib.decompressobj`` that was fed ``content``; InputError: it is damaged."""
    try:
        return packer.decompress(content, size) if size else b""
    except zlib.error as error:
        raise InputError("the compressed content is damaged", where=where, got=str(error)) from error


# -- zips ------------------------------------------------------------------------------------------

_EPOCH: Final = (1980, 1, 1, 0, 0, 0)
_DAMAGE: Final = (zipfile.BadZipFile, ValueError, EOFError, struct.error, NotImplementedError, OSError)
"""What zipfile raises for damaged archives."""


def stored_zip(files: Mapping[str, bytes], align: int = 1) -> bytes:
    """A zip without compression, in the order given; the content of every file begins at a multiple of ``align`` bytes.

    The same bytes for the same files.
    """
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED, allowZip64=align == 1) as archive:
        for name, content in files.items():
            info = zipfile.ZipInfo(name, _EPOCH)
            info.external_attr = 0o644 << 16
            begins = target.tell() + 30 + len(name.encode())
            gap = -begins % align
            if gap:
                gap += align if gap < 4 else 0  # an extra field takes at least 4 bytes
                info.extra = struct.pack("<HH", 0x1986, gap - 4) + bytes(gap - 4)
            archive.writestr(info, content)
    return target.getvalue()


def opened_zip(content: bytes, where: str) -> zipfile.ZipFile:
    """An archive; InputError if it is damaged, or lists too many files."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(content))
    except _DAMAGE as error:
        raise InputError("not a readable zip file", where=where, got=str(error)) from error
    if len(archive.namelist()) > MOST_FILES:
        what, got = "the zip lists too many files", str(len(archive.namelist()))
        raise InputError(what, where=where, expected=f"at most {MOST_FILES}", got=got)
    return archive


def zip_member(archive: zipfile.ZipFile, name: str, most: int, where: str) -> bytes:
    """The content of a file; InputError if there is none, it is damaged, or larger than ``most`` bytes."""
    where = f"{where}: {name}"
    try:
        with archive.open(name) as handle:
            content = handle.read(most + 1)  # no more than the archive lists; at its end the checksum is compared
    except KeyError as error:
        raise InputError("a file is missing in the zip", where=where, got=", ".join(archive.namelist()[:8])) from error
    except (*_DAMAGE, RuntimeError, zlib.error) as error:
        raise InputError("a file in the zip is damaged", where=where, got=str(error)) from error
    if len(content) > most:
        raise InputError("a file in the zip is too large", where=where, expected=f"at most {most} bytes")
    return content


# -- order and packing -----------------------------------------------------------------------------


def morton_order(means: NDArray[np.floating]) -> NDArray[np.intp]:
    """Rows ordered along a curve that keeps neighbours together (Morton, 21 bits an axis); stable."""
    if len(means) == 0:
        return np.zeros(0, np.intp)
    low = means.min(0).astype(np.float64)
    span = np.maximum(means.max(0).astype(np.float64) - low, 1e-9)
    cells = ((means.astype(np.float64) - low) / span * ((1 << 21) - 1)).astype(np.uint64)
    key = with_gaps(cells) << np.arange(3, dtype=np.uint64)
    return np.argsort(np.bitwise_or.reduce(key, axis=1), kind="stable")


def with_gaps(bits: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Two zero bits after every bit of 21."""
    masks = (0x1F00000000FFFF, 0x1F0000FF0000FF, 0x100F00F00F00F00F, 0x10C30C30C30C30C3, 0x1249249249249249)
    for shift, mask in zip((32, 16, 8, 4, 2), masks):
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return bits


def smallest_three(quats: Floats) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Index of the largest of four components, i[n], and the other three in order, f64[n, 3], signed so that the
    largest is positive."""
    q = quats.astype(np.float64)
    q /= np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-30)
    largest = np.abs(q).argmax(1)
    rows = np.arange(len(q))
    q *= np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.arange(4)[None] != largest[:, None]
    return largest, q[others].reshape(-1, 3)


def from_smallest_three(largest: NDArray[np.integer], three: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of ``smallest_three``: four components, f64[n, 4]."""
    made = np.empty((len(three), 4))
    others = np.arange(4)[None] != np.asarray(largest)[:, None]
    made[others] = three.reshape(-1)
    made[~others] = np.sqrt(np.maximum(1 - (three**2).sum(1), 0))
    return made
