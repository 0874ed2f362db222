"""Point cloud files: PCD (ascii, binary, binary_compressed), PLY (ascii, binary), KITTI BIN, NPZ.

Every size a file declares is compared with the bytes that are there before anything is allocated. Nothing in a file is
executed: NPZ is read without pickles.
"""

from __future__ import annotations

import io
import math
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.formats.importers.common import name_table
from mudg.formats.unknown_fields import note_unknown
from mudg.scene.clouds import is_return

MAX_POINTS: Final = 50_000_000
_MAX_HEADER_BYTES: Final = 1 << 16
_LZF_MAX_GROWTH: Final = 90
"""A token of 3 bytes makes at most 264."""

USUAL: Final = frozenset(
    """x y z intensity reflectivity reflectance remission i ring channel laser_id lidar_info line tag t time timestamp
    time_stamp offset_time offset_ns range distance azimuth elevation ambient noise near_ir signal return_type
    return_number number_of_returns confidence rgb rgba r g b a red green blue alpha nx ny nz normal_x normal_y
    normal_z curvature label class classification instance object velocity doppler""".split()
)
"""Fields that clouds of LiDARs usually have, whatever their case: no format of clouds closes its list."""

Fields = Mapping[str, NDArray]


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points as a file has them: ``xyz`` f64[N, 3], and every other named field of one number a point, ``fields`` [N]
    each. Beams without a return (``scene.clouds.is_return``) are left out; ``missing`` counts them."""

    xyz: NDArray[np.float64]
    fields: Fields
    missing: int


def read_cloud(path: Path, known: Collection[str] = ()) -> Cloud:
    """Read a cloud by the suffix of its name; ``known``: fields that the caller reads, or knows to be there, besides
    ``USUAL``. Raises InputError: unknown suffix, cut off, sizes that contradict each other, no coordinates, values not
    finite."""
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        what = "point cloud format is not known"
        raise InputError(what, where=str(path), expected=", ".join(READERS), got=path.suffix or "no suffix")
    columns = reader(store.read_bytes(path), str(path))
    absent = [name for name in "xyz" if name not in columns]
    if absent:
        what = "cloud has no coordinates"
        raise InputError(what, where=str(path), expected="fields x, y, z", got=", ".join(columns) or "no fields")
    note_unknown(f"*{path.suffix}", [name for name in columns if name.lower() not in USUAL], frozenset(known))
    xyz = np.stack([columns[name].astype(np.float64) for name in "xyz"], 1)
    nowhere = ~is_return(xyz)
    xyz = xyz[~nowhere]
    if not np.isfinite(xyz).all():
        bad = int((~np.isfinite(xyz).all(1)).sum())
        got, remedy = f"{bad} of {len(xyz)} points", "leave missing returns out, or write all three coordinates as NaN"
        raise InputError("cloud holds coordinates that are not finite", where=str(path), got=got, remedy=remedy)
    rest = {name: values[~nowhere] for name, values in columns.items() if name not in "xyz"}
    return Cloud(xyz, rest, int(nowhere.sum()))


# --- PCD ------------------------------------------------------------------------------------------
_PCD_TYPES: Final = {(name[0].upper(), int(name[1])): f"<{name}" for name in "f4 f8 i1 i2 i4 i8 u1 u2 u4 u8".split()}
_PCD_KEYS: Final = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")


@dataclass(frozen=True, slots=True)
class _PcdField:
    """One field of one number a point: its type, and where it stands in a row (byte and number)."""

    name: str
    kind: str
    byte: int
    column: int


def read_pcd(content: bytes, where: str) -> dict[str, NDArray]:
    """Point Cloud Data file of version 0.6 or 0.7: fields of one number a point, by name."""
    header, start = _pcd_header(content, where)
    fields, size, columns = _pcd_fields(header, where)
    points = _count(header["POINTS"][0], f"{where}: POINTS")
    width, height = (_count(header[key][0], f"{where}: {key}") for key in ("WIDTH", "HEIGHT"))
    if width * height != points:
        expected = f"WIDTH x HEIGHT = {width * height} points"
        raise InputError("cloud contradicts itself", where=where, expected=expected, got=f"POINTS {points}")
    body = content[start:]
    kind = header["DATA"][0].lower()
    if kind == "ascii":
        table = _number_table(body, columns, points, where)
        return {field.name: table[:, field.column] for field in fields}
    if kind == "binary":
        _enough(body, points * size, where)
        names, kinds, offsets = ([getattr(f, part) for f in fields] for part in ("name", "kind", "byte"))
        layout = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": size})
        rows = np.frombuffer(body, layout, points)
        return {name: rows[name].copy() for name in names}
    if kind == "binary_compressed":  # field after field, all points of one together
        _enough(body, 8, where)
        packed, unpacked = (int(n) for n in np.frombuffer(body, "<u4", 2))
        _enough(body, 8 + packed, where)
        if unpacked != points * size or unpacked > packed * _LZF_MAX_GROWTH + 1:
            what, expected = "compressed cloud contradicts itself", f"{points} points of {size} bytes"
            raise InputError(what, where=where, expected=expected, got=f"{packed} bytes said to unpack to {unpacked}")
        flat = lzf_decompress(body[8 : 8 + packed], unpacked, where)
        return {field.name: np.frombuffer(flat, field.kind, points, field.byte * points).copy() for field in fields}
    what = "cloud's DATA is of no known kind"
    raise InputError(what, where=where, expected="ascii, binary or binary_compressed", got=kind[:40])


def _pcd_header(content: bytes, where: str) -> tuple[dict[str, list[str]], int]:
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = content.find(b"\n", start, _MAX_HEADER_BYTES)
        if end < 0:
            expected, got = f"a header with {', '.join(_PCD_KEYS)}", f"{len(content)} bytes without the line DATA"
            raise InputError("not a PCD file", where=where, expected=expected, got=got, remedy="is the file cut off?")
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    header.setdefault("COUNT", ["1"] * len(header.get("FIELDS", [])))
    header.setdefault("HEIGHT", ["1"])
    absent = [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "POINTS", "DATA") if not header.get(key)]
    if absent:
        got = ", ".join(f"{key} {' '.join(values)}" for key, values in header.items())[:200]
        raise InputError("PCD header is incomplete", where=where, expected=", ".join(absent), got=got)
    return header, start


def _pcd_fields(header: dict[str, list[str]], where: str) -> tuple[list[_PcdField], int, int]:
    """Fields of one number a point, each name once (padding, called ``_``, and descriptors are passed over); bytes and
    numbers a row."""
    names, sizes, types, counts = (header[key] for key in ("FIELDS", "SIZE", "TYPE", "COUNT"))
    if not len(names) == len(sizes) == len(types) == len(counts):
        what, got = "PCD header contradicts itself", f"{len(names)}, {len(sizes)}, {len(types)}, {len(counts)}"
        raise InputError(what, where=where, expected="as many SIZE, TYPE and COUNT as FIELDS", got=got)
    fields: dict[str, _PcdField] = {}
    byte = column = 0
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        key = (kind.upper(), _count(size, f"{where}: SIZE"))
        if key not in _PCD_TYPES:
            raise InputError("PCD field has an unknown type", where=f"{where}: {name}", got=f"{kind}{size}")
        numbers = _count(count, f"{where}: COUNT", 65536)
        if numbers == 1 and name != "_":
            fields.setdefault(name, _PcdField(name, _PCD_TYPES[key], byte, column))
        byte, column = byte + key[1] * numbers, column + numbers
    return list(fields.values()), byte, column


def _number_table(body: bytes, columns: int, rows: int, where: str) -> NDArray[np.float64]:
    if rows * columns * 2 > len(body) + 1:  # a digit and a separator each
        raise InputError("cloud is cut off", where=where, expected=f"{rows} points", got=f"{len(body)} bytes")
    try:
        table = np.array(body.split(), np.float64)
    except ValueError as error:
        raise InputError("cloud holds a value that is no number", where=where, got=str(error)[:120]) from error
    if len(table) != rows * columns:
        what = "cloud is cut off or has rows of another length"
        raise InputError(what, where=where, got=f"{len(table)} numbers", expected=f"{rows} rows of {columns}")
    return table.reshape(rows, columns)


def lzf_decompress(packed: bytes, length: int, where: str) -> bytes:
    """Unpack LibLZF data to exactly ``length`` bytes.

    A token below 32 is that many + 1 literal bytes. Any other copies from what was unpacked: its upper 3 bits + 2 are
    the length (7: one more byte to add), its lower 5 bits and the next byte are how far back, less 1. Raises
    InputError: reads or writes beyond an end, or another length comes out."""
    out = bytearray(length)
    at = to = 0
    try:
        while at < len(packed):
            token = packed[at]
            at += 1
            if token < 32:
                count = token + 1
                piece = packed[at : at + count]
                at += count
            else:
                count = token >> 5
                if count == 7:
                    count += packed[at]
                    at += 1
                back = to - ((token & 31) << 8) - packed[at] - 1
                at += 1
                count += 2
                if back < 0:
                    raise IndexError
                piece = out[back : min(back + count, to)]
                if len(piece) < count:  # the copy overlaps what it makes: a repeated pattern
                    piece = (piece * (count // len(piece) + 1))[:count]
            if len(piece) != count or to + count > length:
                raise IndexError
            out[to : to + count] = piece
            to += count
    except IndexError as error:
        raise InputError("compressed cloud is damaged", where=where, got=f"broken at byte {at}") from error
    if to != length:
        raise InputError("compressed cloud is damaged", where=where, expected=f"{length} bytes", got=f"{to}")
    return bytes(out)


def _enough(body: bytes, needed: int, where: str) -> None:
    if len(body) < needed:
        what, expected = "cloud is cut off", f"at least {needed} bytes after the header"
        raise InputError(what, where=where, expected=expected, got=str(len(body)), remedy="copy the file again")


def _count(word: str, where: str, largest: int = MAX_POINTS) -> int:
    if not word.isascii() or not word.isdigit() or int(word[:20]) > largest:
        raise InputError("count makes no sense", where=where, expected=f"0 to {largest}", got=word[:40])
    return int(word)


# --- PLY ------------------------------------------------------------------------------------------
_PLY_TYPES: Final = name_table(
    """i1: char, int8; u1: uchar, uint8; i2: short, int16; u2: ushort, uint16; i4: int, int32;
    u4: uint, uint32; f4: float, float32; f8: double, float64"""
)
_PLY_ORDER: Final = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}


def read_ply(content: bytes, where: str) -> dict[str, NDArray]:
    """Vertices of a polygon file; they must come first and have plain properties. What follows (faces) is passed
    over."""
    end = content.find(b"end_header", 0, _MAX_HEADER_BYTES)
    start = content.find(b"\n", end) + 1
    if not content.startswith(b"ply") or end < 0 or start == 0:
        what = "not a PLY file"
        raise InputError(what, where=where, expected="a header from 'ply' to 'end_header'", got=f"{len(content)} bytes")
    order, points, properties, element = "?", -1, [], ""
    for line in content[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            order = words[1] if len(words) > 1 else "?"
        elif words[:1] == ["element"] and len(words) == 3:
            element = words[1]
            if element == "vertex":
                points = _count(words[2], f"{where}: element vertex")
            elif points < 0:
                raise InputError("vertices do not come first", where=where, got=f"element {element}")
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _PLY_TYPES:
                raise InputError("vertex property is of no known type", where=where, got=line.strip()[:80])
            properties.append((words[2], _PLY_TYPES[words[1]]))
    if order not in _PLY_ORDER or points < 0 or not properties or len({n for n, _ in properties}) != len(properties):
        what = "PLY header is incomplete"
        raise InputError(what, where=where, expected="format, element vertex, properties", got=order)
    body = content[start:]
    if order == "ascii":
        lines = body.split(b"\n", points)  # faces may follow
        table = _number_table(b"\n".join(lines[:points]), len(properties), points, where)
        return {name: table[:, index] for index, (name, _) in enumerate(properties)}
    layout = np.dtype([(name, _PLY_ORDER[order] + kind) for name, kind in properties])
    _enough(body, points * layout.itemsize, where)
    rows = np.frombuffer(body, layout, points)
    return {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name, _ in properties}


# --- BIN and NPZ ----------------------------------------------------------------------------------


def read_float_rows(path: Path, columns: int, what: str = "scan") -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Rows of little-endian float32 without a header, as raw scans are kept: f32[N, columns], of which the first three
    are coordinates in the sensor's frame, and which of them are returns bool[N]. ``what``: what one file holds, for
    messages. Raises InputError: missing, cut off, or values of a return that are not finite."""
    content = store.read_bytes(path)
    if len(content) % (4 * columns):
        what, got = f"{what} is cut off", f"{len(content)} bytes"
        expected = f"a multiple of {4 * columns} bytes ({columns} float32 a row)"
        raise InputError(what, where=str(path), got=got, expected=expected, remedy="copy the file again")
    rows = np.frombuffer(content, "<f4").reshape(-1, columns).astype(np.float32)
    returns = is_return(rows[:, :3])
    bad = ~np.isfinite(rows[returns]).all(1)
    if bad.any():
        what, where = f"{what} holds values that are not finite", str(path)
        raise InputError(what, where=where, got=f"{int(bad.sum())} of {len(rows)} rows", remedy="copy the file again")
    return rows, returns


def read_bin(content: bytes, where: str) -> dict[str, NDArray]:
    """KITTI's form: little-endian float32 rows x, y, z, intensity, nothing else."""
    if len(content) % 16:
        got, expected = f"{len(content)} bytes", "a multiple of 16 bytes: float32 x, y, z, intensity a point"
        raise InputError("cloud is cut off, or is not of this form", where=where, got=got, expected=expected)
    rows = np.frombuffer(content, "<f4").reshape(-1, 4)
    return {name: rows[:, index].copy() for index, name in enumerate(("x", "y", "z", "intensity"))}


def npz_arrays(content: bytes, where: str) -> dict[str, NDArray]:
    """All arrays of a numpy archive by name. Raises InputError: damaged, cut off, or not plain numbers of the declared
    size."""
    arrays = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for entry in archive.infolist():
                with archive.open(entry) as handle:
                    member = f"{where}: {entry.filename}"
                    arrays[entry.filename.removesuffix(".npy")] = read_npy(handle, entry.file_size, member)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, NotImplementedError, RuntimeError, zlib.error) as error:
        what = "not a readable NPZ file, or cut off"
        raise InputError(what, where=where, got=str(error)[:120], remedy="copy the file again") from error
    return arrays


def read_npz(content: bytes, where: str) -> dict[str, NDArray]:
    """numpy archive: ``xyz`` [N, 3] and any number of arrays [N]."""
    columns = npz_arrays(content, where)
    xyz = columns.pop("xyz", None)
    if xyz is None or xyz.ndim != 2 or xyz.shape[1] != 3 or xyz.dtype.kind not in "fiu":
        what = "NPZ cloud has no coordinates"
        got = ", ".join(columns) or ("nothing" if xyz is None else f"{xyz.dtype} {xyz.shape}")
        raise InputError(what, where=where, expected="an array xyz [N, 3] of numbers", got=got)
    for name, values in columns.items():
        if values.shape != (len(xyz),) or values.dtype.kind not in "fiub":
            what, where = "NPZ array does not fit the points", f"{where}: {name}"
            raise InputError(what, where=where, expected=f"numbers [{len(xyz)}]", got=f"{values.dtype} {values.shape}")
    return {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], **columns}


def read_npy(handle: IO[bytes], size: int, where: str) -> NDArray:
    """One array of an archive, from its member of ``size`` bytes.

    Its header is compared with this size before anything is allocated; arrays of objects (pickles) are refused. Raises
    InputError: not numbers, or of another size than declared. ValueError, zipfile.BadZipFile, zlib.error: no array, or
    damaged."""
    version = np.lib.format.read_magic(handle)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise InputError("array is of a version that is not read", where=where, got=str(version))
    try:
        shape, fortran, dtype = readers[version](handle)
    except (tokenize.TokenError, SyntaxError, RecursionError, MemoryError) as error:  # of numpy's parser
        what = "array's header makes no sense"
        raise InputError(what, where=where, got=str(error)[:120], remedy="copy the file again") from error
    length = math.prod(shape) * dtype.itemsize
    plain = not dtype.hasobject and dtype.kind in "fiub"
    if not plain or length > min(size, MAX_POINTS * 24) or handle.tell() + length != size:
        what, got = "array is not plain numbers of the declared size", f"{dtype} {shape} in {size} bytes"
        raise InputError(what, where=where, got=got, remedy="save it with numpy.savez from an array of numbers")
    content = handle.read(length)
    handle.read(1)  # at its end an archive's member compares its checksum
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")


READERS: Final[dict[str, Callable[[bytes, str], dict[str, NDArray]]]]
READERS = {".pcd": read_pcd, ".ply": read_ply, ".bin": read_bin, ".npz": read_npz}
"""Suffix -> reader of its bytes; fields by name."""
