"""Point cloud files: PCD (ascii, binary, binary_compressed), PLY (ascii, binary), KITTI BIN, NPZ.

Every size a file declares is compared with the bytes that are there before anything is allocated. Nothing in a file is
executed: NPZ is read without pickles.
"""

from __future__ import annotations

import io
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.formats.splats import binary, ply
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

    def field(self, name: str, what: str, path: Path, remedy: str = "") -> NDArray:
        """A field that the cloud must have; ``what`` it holds, for messages."""
        if name not in self.fields:
            got, expected = ", ".join(self.fields) or "coordinates only", f"a field {name!r}"
            raise InputError(f"cloud has no {what}", where=str(path), expected=expected, got=got, remedy=remedy)
        return self.fields[name]


def read_cloud(path: Path, known: Collection[str] = ()) -> Cloud:
    """Read a cloud by the suffix of its name; ``known``: fields that the caller reads, or knows to be there, besides
    ``USUAL``. Raises InputError: another suffix, cut off, contradictory, without coordinates, not finite."""
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
_PCD_KEYS: Final = ("FIELDS", "SIZE", "TYPE", "WIDTH", "HEIGHT", "POINTS", "DATA")


def read_pcd(content: bytes, where: str) -> dict[str, NDArray]:
    """Point Cloud Data file of version 0.6 or 0.7: fields of one number a point, by name."""
    header, start = _pcd_header(content, where)
    fields, size, columns = _pcd_fields(header, where)
    points, width, height = (_count(header[key][0], f"{where}: {key}") for key in ("POINTS", "WIDTH", "HEIGHT"))
    if width * height != points:
        expected = f"WIDTH x HEIGHT = {width * height} points"
        raise InputError("cloud contradicts itself", where=where, expected=expected, got=f"POINTS {points}")
    kind = header["DATA"][0].lower()
    if kind == "ascii":
        table = binary.text_table(content[start:], columns, points, where)
        return {name: table[:, column] for name, (_, _, column) in fields.items()}
    if kind == "binary":
        kinds, offsets, _ = ([field[part] for field in fields.values()] for part in range(3))
        layout = np.dtype({"names": list(fields), "formats": kinds, "offsets": offsets, "itemsize": size})
        rows = np.frombuffer(binary.part(content, start, points * size, "its points", where), layout, points)
        return {name: rows[name].copy() for name in fields}
    if kind == "binary_compressed":  # field after field, all points of one together
        packed, unpacked = binary.unpacked("<II", content, start, "its points", where)
        body = bytes(binary.part(content, start + 8, packed, "its points", where))
        if unpacked != points * size or unpacked > packed * _LZF_MAX_GROWTH + 1:
            what, expected = "compressed cloud contradicts itself", f"{points} points of {size} bytes"
            raise InputError(what, where=where, expected=expected, got=f"{packed} bytes said to unpack to {unpacked}")
        flat = lzf_decompress(body, unpacked, where)
        return {n: np.frombuffer(flat, kind, points, byte * points).copy() for n, (kind, byte, _) in fields.items()}
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
    absent = [key for key in _PCD_KEYS if not header.get(key)]
    if absent:
        got = ", ".join(f"{key} {' '.join(values)}" for key, values in header.items())[:200]
        raise InputError("PCD header is incomplete", where=where, expected=", ".join(absent), got=got)
    return header, start


def _pcd_fields(header: dict[str, list[str]], where: str) -> tuple[dict[str, tuple[str, int, int]], int, int]:
    """Fields of one number a point: name -> type, and where it stands in a row (byte and number); then bytes and
    numbers a row. Padding (``_``) and fields of many numbers are passed over."""
    names, sizes, types, counts = (header[key] for key in ("FIELDS", "SIZE", "TYPE", "COUNT"))
    if not len(names) == len(sizes) == len(types) == len(counts):
        what, got = "PCD header contradicts itself", f"{len(names)}, {len(sizes)}, {len(types)}, {len(counts)}"
        raise InputError(what, where=where, expected="as many SIZE, TYPE and COUNT as FIELDS", got=got)
    fields: dict[str, tuple[str, int, int]] = {}
    byte = column = 0
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        key = (kind.upper(), _count(size, f"{where}: SIZE"))
        if key not in _PCD_TYPES:
            raise InputError("PCD field has an unknown type", where=f"{where}: {name}", got=f"{kind}{size}")
        numbers = _count(count, f"{where}: COUNT", 65536)
        if numbers == 1 and name != "_":
            fields.setdefault(name, (_PCD_TYPES[key], byte, column))
        byte, column = byte + key[1] * numbers, column + numbers
    return fields, byte, column


def lzf_decompress(packed: bytes, length: int, where: str) -> bytes:
    """Unpack LibLZF data to exactly ``length`` bytes. A token below 32 is that many + 1 literal bytes. Any other copies
    from what was unpacked: its upper 3 bits + 2 are the length (7: one more byte to add), its lower 5 bits and the next
    byte are how far back, less 1."""
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


def _count(word: str, where: str, largest: int = MAX_POINTS) -> int:
    if not word.isascii() or not word.isdigit() or int(word[:20]) > largest:
        raise InputError("count makes no sense", where=where, expected=f"0 to {largest}", got=word[:40])
    return int(word)


# --- PLY, BIN and NPZ -----------------------------------------------------------------------------


def read_ply(content: bytes, where: str) -> dict[str, NDArray]:
    """Vertices of a polygon file, text or binary; what follows (faces) is passed over."""
    table = ply.PlyFile(content, where, ("vertex",)).tables.get("vertex")
    if table is None:
        raise InputError("the PLY file has no vertices", where=where)
    return {name: table[name].astype(table.dtype[name].newbyteorder("=")) for name in table.dtype.names or ()}


def _float_rows(content: bytes, columns: int, what: str, where: str) -> NDArray[np.float32]:
    if len(content) % (4 * columns):
        what, got = f"{what} is cut off, or is not of this form", f"{len(content)} bytes"
        expected = f"a multiple of {4 * columns} bytes ({columns} float32 a row)"
        raise InputError(what, where=where, got=got, expected=expected, remedy="copy the file again")
    return np.frombuffer(content, "<f4").reshape(-1, columns).astype(np.float32)


def read_float_rows(path: Path, columns: int, what: str = "scan") -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Rows of little-endian float32 without a header, as raw scans are kept: f32[N, columns], of which the first three
    are coordinates in the sensor's frame, and which of them are returns bool[N]. ``what``: what one file holds, for
    messages."""
    rows = _float_rows(store.read_bytes(path), columns, what, str(path))
    returns = is_return(rows[:, :3])
    bad = ~np.isfinite(rows[returns]).all(1)
    if bad.any():
        what, where = f"{what} holds values that are not finite", str(path)
        raise InputError(what, where=where, got=f"{int(bad.sum())} of {len(rows)} rows", remedy="copy the file again")
    return rows, returns


def read_bin(content: bytes, where: str) -> dict[str, NDArray]:
    """KITTI's form: little-endian float32 rows x, y, z, intensity, nothing else."""
    rows = _float_rows(content, 4, "cloud", where)
    return {name: rows[:, index].copy() for index, name in enumerate(("x", "y", "z", "intensity"))}


_DAMAGE: Final = (ValueError, OSError, EOFError, zipfile.BadZipFile, NotImplementedError, RuntimeError, zlib.error)
_DAMAGE_OF_HEADERS: Final = (SyntaxError, TypeError, tokenize.TokenError, OverflowError, MemoryError)
"""What zipfile, and numpy's parser of headers, raise for damaged archives."""


def read_npz(content: bytes, where: str) -> dict[str, NDArray]:
    """numpy archive: ``xyz`` [N, 3] and any number of arrays [N]."""
    columns: dict[str, NDArray] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for entry in archive.infolist():
                if entry.file_size > 24 * MAX_POINTS + _MAX_HEADER_BYTES:
                    raise ValueError(f"{entry.filename}: {entry.file_size} bytes are too many")
                with archive.open(entry) as handle:
                    columns[entry.filename.removesuffix(".npy")] = np.lib.format.read_array(handle, allow_pickle=False)
                    if handle.read(1):  # at its end the checksum is compared
                        raise ValueError(f"{entry.filename} goes on after its array")
    except (*_DAMAGE, *_DAMAGE_OF_HEADERS) as error:
        what = "not a readable NPZ file of plain numbers, or cut off"
        raise InputError(what, where=where, got=str(error)[:120], remedy="write it again with numpy.savez") from error
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


READERS: Final[dict[str, Callable[[bytes, str], dict[str, NDArray]]]]
READERS = {".pcd": read_pcd, ".ply": read_ply, ".bin": read_bin, ".npz": read_npz}
"""Suffix -> reader of its bytes; fields by name."""
