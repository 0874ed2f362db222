"""The PLY of Gaussian splatting (Kerbl et al. 2023): rows of f32 x y z, nx ny nz (zero), f_dc_0..2, f_rest (all red,
all green, all blue), opacity (logit), scale_0..2 (natural logarithm), rot_0..3 (w x y z); a column ``class`` of our own
(train id, 255 = unknown). What comments say of drawing and axes is read, and written where it differs from the usual.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.core.harmonics import C0
from mudg.formats.splats import binary
from mudg.formats.splats.cloud import VERTICAL, SplatCloud, SplatFile, checked, known, logit, refuse_rows, spacing_m
from mudg.formats.unknown_fields import listed, sentence

MAX_HEADER: Final = 1 << 16
FLAT_LOG: Final = float(np.log(1e-6))
"""Thickness of flat Gaussians, whose files state none."""
_MODES: Final = {"mip": True, "antialiased": True, "antialias": True, "default": False, "classic": False, "2dgs": False}
_UNREAD: Final = ("nx", "ny", "nz", "red", "green", "blue", "alpha")
_ELEMENTS: Final = (
    "face edge tristrips material camera extrinsic intrinsic image_size frame disparity color_space version".split()
)
"""Columns and elements of others that say nothing about Gaussians (from ``extrinsic`` on: ml-sharp). PLY has no closed
list."""
_MOTION: Final = tuple("trbf motion omega t_ time scale_t scaling_t rot_r rotation_r velocity duration".split())
"""Beginnings of columns with which methods for moving scenes move their Gaussians."""
_NAMES: Final = "char uchar short ushort int uint float double int8 uint8 int16 uint16 int32 uint32 float32 float64"
_TYPES: Final = dict(zip(_NAMES.split(), 2 * "i1 u1 i2 u2 i4 u4 f4 f8".split(), strict=True))
_ORDERS: Final = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_REST: Final = {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}
"""Number of ``f_rest`` columns: degree."""
_Element = tuple[str, int, list[tuple[str, str]], list[str]]
"""An element of the header: name, number of rows, columns (name, numpy type), names of those that are lists."""


def to_bytes(cloud: SplatCloud, classes: bool = False, marks: Sequence[str] = ()) -> bytes:
    """A cloud as a PLY file; ``classes`` adds the column of our own, ``marks`` are comments."""
    with_classes = classes and cloud.class_ids is not None
    columns = [cloud.means, np.zeros_like(cloud.means), cloud.sh[:, 0], channel_major(cloud.sh)]
    columns += [cloud.logits[:, None], cloud.log_scales, cloud.quats]
    if with_classes and cloud.class_ids is not None:
        columns.append(cloud.class_ids[:, None])
    rows = np.concatenate([column.astype("<f4") for column in columns], 1)
    names = [*_names(cloud.degree), *(["class"] if with_classes else [])]
    return header([("vertex", len(cloud), [("float", name) for name in names])], marks) + rows.tobytes()


def from_bytes(content: bytes, where: str) -> SplatFile:
    """The Gaussians of a PLY file; columns and elements that it does not know are passed over. Raises InputError:
    another kind of PLY, or a damaged one."""
    file = PlyFile(content, where, ("vertex",))
    table = file.tables.get("vertex")
    if table is None:
        raise InputError("the PLY file has no vertices", where=where)
    names = table.dtype.names or ()
    flat = "scale_2" not in names and "scale_1" in names
    sizes = _indexed("scale", 2 if flat else 3)
    wanted = ("x", "y", "z", *_indexed("f_dc", 3), "opacity", *sizes, *_indexed("rot", 4))
    _refuse_columns(table, wanted, where)
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in _REST or any(name not in names for name in _indexed("f_rest", rest)):
        what = "the number of f_rest columns fits no degree of harmonics"
        raise InputError(what, where=where, expected=", ".join(map(str, _REST)), got=str(rest))
    first, others = columns_of(table, _indexed("f_dc", 3)), columns_of(table, _indexed("f_rest", rest))
    sh = np.concatenate([first[:, None], coefficient_major(others)[:, :15]], 1)
    classes = None
    # others number classes in whole numbers, and otherwise
    if ours := "class" in names and table.dtype["class"].kind == "f":
        with np.errstate(invalid="ignore"):
            ids = np.asarray(table["class"], np.float64)
            classes = np.where((ids >= 0) & (ids <= 255), ids, 255).astype(np.uint8)
    means = np.stack([table[name].astype(np.float64) for name in "xyz"], 1)
    logs = columns_of(table, sizes)
    if flat:
        logs = np.column_stack([logs, np.full(len(logs), FLAT_LOG, np.float32)])
        file.notes.append("it has no scale_2: read as flat Gaussians (2DGS)")
    quats, logits = columns_of(table, _indexed("rot", 4)), np.asarray(table["opacity"], np.float32)
    cloud = checked(SplatCloud(means, quats, logs, logits, sh, classes, file.antialias), where)
    if filters := [name for name in names if name.lower() == "filter_3d"]:
        cloud = _filtered(cloud, np.asarray(table[filters[0]], np.float64), where)
        file.notes.append("the column filter_3D (Mip-Splatting) went into sizes and opacities")
    used = {*wanted, *_indexed("f_rest", rest), *_UNREAD, *filters, *(["class"] if ours else [])}
    moving = [name for name in names if name not in used and name.lower().startswith(_MOTION)]
    file.pass_over([name for name in names if name not in used and name not in moving], "element vertex")
    if _REST[rest] > 3:
        file.warnings.append("harmonics beyond degree 3 were dropped")
    if moving:
        words = f"columns of motion over time are not read: {listed(moving)}; the Gaussians are as they rest"
        file.warnings.append(words)
    single = [axis for axis, name in enumerate("xyz") if table.dtype[name] == np.float32]
    return file.of(cloud, spacing_m(means[:, single]) if single else 0.0)


def _refuse_columns(table: NDArray[Any], wanted: tuple[str, ...], where: str) -> None:
    """InputError unless all columns are there, as numbers with a fraction."""
    names = table.dtype.names or ()
    if missing := [name for name in wanted if name not in names]:
        starts = ("scal", "rot", "quat", "opac", "f_dc", "f_rest", "sh", "feat")
        alike = any(name.lower().startswith(starts) for name in names)
        rename = f"name the columns as 3D Gaussian Splatting does: {', '.join(wanted)}"
        remedy = rename if alike else "points or meshes cannot be imported"
        what = "the PLY file holds no Gaussians" if not alike else "a column of the Gaussians is missing"
        raise InputError(what, where=where, expected=f"a property {missing[0]!r}", got=listed(names), remedy=remedy)
    if whole := [name for name in wanted if name not in "xyz" and table.dtype[name].kind != "f"]:
        what, expected = "a column of the Gaussians holds whole numbers", f"{whole[0]} as float"
        remedy = "write logits, logarithms of sizes, and harmonics"
        raise InputError(what, where=where, expected=expected, got=str(table.dtype[whole[0]]), remedy=remedy)


def _filtered(cloud: SplatCloud, filter_m: NDArray[np.float64], where: str) -> SplatCloud:
    """Gaussians blurred by a filter f64[n] in metres (Mip-Splatting, eq. 7): sizes grow, opacities fall with the
    volume."""
    refuse_rows(~np.isfinite(filter_m), "a filter_3D is not finite", where, filter_m[:, None])
    variance = np.exp(2 * cloud.log_scales.astype(np.float64))
    grown = variance + (filter_m**2)[:, None]
    share = np.exp(0.5 * (np.log(variance) - np.log(grown)).sum(1))
    logs = (0.5 * np.log(grown)).astype(np.float32)
    return checked(replace(cloud, log_scales=logs, logits=logit(cloud.opacity * share)), where)


# -- headers ---------------------------------------------------------------------------------------


def header(elements: list[tuple[str, int, list[tuple[str, str]]]], comments: Sequence[str] = ()) -> bytes:
    """The header of a PLY file: elements with their number of rows and their properties (type, name)."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {kind} {column}" for kind, column in properties)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


class PlyFile:
    """The wanted elements of a PLY as structured arrays (``tables``; those of a binary one look into ``content``), and
    what its comments say: the rest as in ``SplatFile``. Raises InputError: no PLY, a malformed header, lists in or
    before wanted elements, or content that is too short."""

    def __init__(self, content: bytes, where: str, wanted: tuple[str, ...]) -> None:
        self.tables, self.notes, self.warnings = dict[str, NDArray[Any]](), list[str](), list[str]()
        elements, comments, place, order = _parsed_header(content, where)
        last = max((index for index, (name, *_) in enumerate(elements) if name in wanted), default=-1)
        for name, count, columns, lists in elements[: last + 1]:
            here = f"{where}: element {name!r}"
            if lists and (count or name in wanted):
                what, got = "a PLY file has lists in its vertices, or before them", f"property list {lists[0]!r}"
                raise InputError(what, where=here, got=got, remedy="write vertices first, one property for each number")
            try:
                dtype = np.dtype([(column, (order or "<") + kind) for column, kind in columns])
            except ValueError as error:
                what = "two properties of a PLY element have one name"
                raise InputError(what, where=where, got=str(error)[:200]) from error
            size = count * dtype.itemsize
            if not order:
                rows = b"\n".join(content[place:].split(b"\n", count)[:count])
                dtype = np.dtype([(column, "<f8") for column, _ in columns])
                table, size = binary.text_table(rows, len(columns), count, here), len(rows) + 1
            else:
                table = binary.part(content, place, size, f"element {name!r}", where)
            if dtype.itemsize and name in wanted:
                self.tables[name] = np.frombuffer(table, dtype)
            place += size
        self.pass_over(
            [name for name, count, *_ in elements if name not in (*wanted, *_ELEMENTS) and count], "the header"
        )
        self.antialias = self._antialias(comments)
        self.axes, self.axes_by = self._axes(comments)
        if colors := [name for name, *_ in elements if "color" in name.lower() and name not in wanted]:
            words = f"the colour space in element {listed(colors)} is not read: colours are taken as sRGB"
            self.warnings.append(words)
        for line in comments:
            if re.search(r"(?i)\b(offset|shift|epsg|utm|georef\w*|crs)\b", line):
                places = "places are as the file has them (--origin-m chooses the origin)"
                self.warnings.append(f"the comment {line[:80]!r} is not used: {places}")

    def pass_over(self, names: list[str], within: str) -> None:
        """Note names, if there are any, that are not read."""
        if names:
            self.notes.append(sentence(names, within))

    def of(self, cloud: SplatCloud, step_m: float) -> SplatFile:
        """The file with the Gaussians in it."""
        return SplatFile(cloud, self.axes, self.axes_by, step_m, self.notes, self.warnings)

    def _antialias(self, comments: list[str]) -> bool:
        """Whether the last comment on it says that the Gaussians are drawn antialiased."""
        found = False
        for line in comments:
            mode = re.search(r"(?i)\b(?:splat|raster\w*|render)[ _-]?(?:render)?[ _-]?mode\W*(\w+)", line)
            mark = re.search(r"(?i)(\bnot? )?\banti[ _-]?alias(?:ed|ing)?\b\W*(\w*)", line)
            if mode and mode[1].lower() in _MODES:
                found = _MODES[mode[1].lower()]
            elif mode:
                words = f"the comment {line[:80]!r} names a way of drawing that is not known: drawn as usual"
                self.warnings.append(words)
            elif mark:
                found = not mark[1] and mark[2].lower() not in ("0", "false", "no", "off", "none", "disabled")
        return found

    def _axes(self, comments: list[str]) -> tuple[str, str]:
        """Axes that a comment states, and the comment."""
        for line in comments:
            by = f"the comment {line[:80]!r}"
            system = re.search(r"(?i)\bcoordinate[ _-]?(?:system|frame)\W*\b([LRUDFB]{3})\b", line)
            if system and known(system[1].upper()):
                return system[1].upper(), by
            up = re.search(r"(?i)\b(vertical|up)[ _-]?(?:axis)?\s*[:=]?\s*([+-]?[xyz])\b", line)
            after = re.search(r"(?i)(?<![\w+-])([+-]?[xyz])[ _-]?(?:axis )?(?:is )?up\b", line)
            if up is None and after is None:
                continue
            axis = (up[2] if up else after[1] if after else "").lower().removeprefix("+")
            if axis == "y" and (up is None or up[1].lower() == "up"):
                return "RUB", by
            if axis in VERTICAL:
                return VERTICAL[axis], by
            if not any("brush" in other.lower() for other in comments):  # which writes it into every file
                words = "does not tell whether y points up or down: read with y down, as usual"
                self.warnings.append(f"{by} {words}; if it stands on its head, add --axes RUB")
        return "", ""


def _parsed_header(content: bytes, where: str) -> tuple[list[_Element], list[str], int, str]:
    """Elements, comments, where the rows begin, and the order of bytes; empty: text."""
    if content[:3] != b"ply":
        raise InputError("not a PLY file", where=where, expected="the first line 'ply'", got=repr(content[:16]))
    end = content.find(b"end_header", 0, MAX_HEADER)
    line_end = content.find(b"\n", end, end + 16) if end >= 0 else -1
    if line_end < 0:
        what = "the header of the PLY file does not end"
        raise InputError(what, where=where, expected=f"end_header within {MAX_HEADER} bytes")
    order, elements, comments = None, list[_Element](), list[str]()
    for line in content[:end].decode("ascii", "replace").splitlines():
        match line.split():
            case [] | ["ply"]:
                pass
            case ["comment" | "obj_info", *words]:
                comments.append(" ".join(words))
            case ["format", kind, _] if kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count] if count.isdecimal() and len(count) < 12:
                elements.append((name, int(count), [], []))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1][2].append((name, _TYPES[kind]))
            case ["property", "list", length, kind, name] if {length, kind} <= _TYPES.keys() and elements:
                elements[-1][3].append(name)
            case _:
                what = "a line in the header of the PLY file is not understood"
                expected = f"format {' or '.join(_ORDERS)}, element NAME COUNT, property TYPE NAME, or property list"
                raise InputError(what, where=where, got=repr(line[:80]), expected=expected)
    if order is None or not elements:
        raise InputError("the header of the PLY file names no format or no elements", where=where)
    for name, count, *_ in elements:
        if name in ("vertex", "chunk", "sh"):
            binary.refuse_count(count, f"{where}: element {name}")
    return elements, comments, line_end + 1, order


# -- columns ---------------------------------------------------------------------------------------


def columns_of(table: NDArray[Any], names: tuple[str, ...]) -> NDArray[np.float32]:
    """Columns of a structured array as f32[n, len(names)]."""
    made = np.empty((len(table), len(names)), np.float32)
    for index, name in enumerate(names):
        with np.errstate(over="ignore", invalid="ignore"):
            made[:, index] = table[name]
    return made


def _indexed(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}_{index}" for index in range(count))


def _names(degree: int) -> tuple[str, ...]:
    rest = 3 * ((degree + 1) ** 2 - 1)
    head = ("x", "y", "z", "nx", "ny", "nz", *_indexed("f_dc", 3), *_indexed("f_rest", rest))
    return (*head, "opacity", *_indexed("scale", 3), *_indexed("rot", 4))


def channel_major(sh: NDArray[np.float32]) -> NDArray[np.float32]:
    """Harmonics from degree 1 on, f32[n, K, 3] to f32[n, 3 (K - 1)]: all of red, all of green, all of blue."""
    return sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1)


def coefficient_major(rest: NDArray[np.float32]) -> NDArray[np.float32]:
    """Inverse of ``channel_major``: f32[n, K - 1, 3]."""
    return rest.reshape(len(rest), 3, rest.shape[1] // 3).transpose(0, 2, 1)


# compressed ply ------------------------------------------------------------------------------------
# Of SuperSplat and PlayCanvas: 16 bytes a Gaussian, values within the f32 bounds of chunks of 256; harmonics as u8.
# Positions and scales (natural logarithm): 11, 10, 11 bits from the top. Rotation: 2 bits index of the largest of (w,
# x, y, z), the others in order, 10 bits each, ``v / sqrt 2 + 0.5``. Colour of degree 0 and opacity: 8 bits each.

CHUNK: Final = 256
_BOUNDS: Final = tuple(
    f"{side}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for side in ("min", "max")
    for name in names
)
_PACKED: Final = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_COMPRESSED_REST: Final = {9: 1, 24: 2, 45: 3}
_PLACE, _TURN, _RGBA = (11, 10, 11), (2, 10, 10, 10), (8, 8, 8, 8)
"""Bits of the numbers in a word."""
_LOG_RANGE: Final = 20.0

Array = NDArray[np.float64]


def compressed_to_bytes(cloud: SplatCloud, marks: Sequence[str] = ()) -> bytes:
    """A cloud as a compressed PLY file; rows are brought into Morton order. ``marks``: comments."""
    cloud = cloud.take(binary.morton_order(cloud.means))
    chunks = -(-len(cloud) // CHUNK)
    of_chunk = np.arange(len(cloud)) // CHUNK
    bounds, shares = [], []
    for values in (cloud.means, cloud.log_scales.clip(-_LOG_RANGE, _LOG_RANGE), cloud.sh[:, 0] * C0 + 0.5):
        padded = np.concatenate([values, np.repeat(values[-1:], chunks * CHUNK - len(cloud), 0)])
        low, high = (bound(padded.reshape(chunks, CHUNK, 3), 1).astype("<f4") for bound in (np.min, np.max))
        bounds += [low, high]
        span = (high - low).astype(np.float64)
        inside = (values - low[of_chunk]) / np.where(span > 1e-5, span, 1)[of_chunk]
        shares.append(np.where(span[of_chunk] > 1e-5, inside, 0.0))
    place, scale, color = shares
    largest, three = binary.smallest_three(cloud.quats)
    turn = np.column_stack([largest / 3, three / np.sqrt(2) + 0.5])
    rgba = np.concatenate([color, cloud.opacity[:, None]], 1)
    words = (_packed(place, _PLACE), _packed(turn, _TURN), _packed(scale, _PLACE), _packed(rgba, _RGBA))
    packed = np.stack(words, 1).astype("<u4")
    elements = [
        ("chunk", chunks, [("float", name) for name in _BOUNDS]),
        ("vertex", len(cloud), [("uint", name) for name in _PACKED]),
    ]
    tables = [np.concatenate(bounds, 1).tobytes(), packed.tobytes()]
    if cloud.degree:
        rest = channel_major(cloud.sh)
        elements.append(("sh", len(cloud), [("uchar", f"f_rest_{index}") for index in range(rest.shape[1])]))
        tables.append(np.trunc((rest / 8 + 0.5) * 256).clip(0, 255).astype(np.uint8).tobytes())
    return header(elements, marks) + b"".join(tables)


def compressed_from_bytes(content: bytes, where: str) -> SplatFile:
    """The Gaussians of a compressed PLY file; columns and elements that it does not know are passed over. Raises
    InputError: another kind of PLY, or a damaged one."""
    file = PlyFile(content, where, ("chunk", "vertex", "sh"))
    chunk, vertex = file.tables.get("chunk"), file.tables.get("vertex")
    if chunk is None or vertex is None or any(name not in (vertex.dtype.names or ()) for name in _PACKED):
        what = "not a compressed PLY of Gaussians"
        raise InputError(what, where=where, expected="elements chunk and vertex with " + ", ".join(_PACKED))
    if any(vertex.dtype[name].kind not in "iu" or vertex.dtype[name].itemsize != 4 for name in _PACKED):
        what = "the packed columns of a compressed PLY are no words"
        raise InputError(what, where=where, expected="uint", got=str(vertex.dtype)[:200])
    words = {name: vertex[name].astype("<u4") for name in _PACKED}
    names = chunk.dtype.names or ()
    if len(chunk) != -(-len(vertex) // CHUNK) or any(name not in names for name in _BOUNDS[:12]):
        what = "the chunks of the compressed PLY do not fit its vertices"
        expected = f"{-(-len(vertex) // CHUNK)} chunks"
        raise InputError(what, where=where, expected=expected, got=f"{len(chunk)}: {listed(names[:4])}, ...")
    of_chunk = np.arange(len(vertex)) // CHUNK
    tinted = all(name in names for name in _BOUNDS[12:])  # files of the first version state no bounds of colours
    bounds = np.stack([chunk[name].astype(np.float64) for name in _BOUNDS[: 18 if tinted else 12]], 1)
    bounds = bounds.reshape(len(chunk), -1, 2, 3)

    def between(shares: Array, kind: int) -> Array:
        """Values at shares [n, 3] of the way from the lower to the upper bounds of their chunks."""
        low, high = bounds[:, kind, 0], bounds[:, kind, 1]
        with np.errstate(over="ignore", invalid="ignore"):
            return low[of_chunk] + shares * (high - low)[of_chunk]

    means, scales = (
        between(_unpacked(words[f"packed_{name}"], _PLACE), n) for n, name in enumerate(("position", "scale"))
    )
    rgba, turn = _unpacked(words["packed_color"], _RGBA), _unpacked(words["packed_rotation"], _TURN)
    color = between(rgba[:, :3], 2) if tinted else rgba[:, :3]
    quats = binary.from_smallest_three(words["packed_rotation"] >> 30, (turn[:, 1:] - 0.5) * np.sqrt(2))
    sh = np.concatenate([((color - 0.5) / C0)[:, None], _rest(file.tables.get("sh"), len(vertex), where)], 1)
    quats, logs, logits, sh = (values.astype(np.float32) for values in (quats, scales, logit(rgba[:, 3]), sh))
    cloud = checked(SplatCloud(means, quats, logs, logits, sh, antialias=file.antialias), where)
    step = spacing_m(bounds[:, 0].reshape(-1, 3)) if chunk.dtype["min_x"].itemsize == 4 else 0.0
    known = {"chunk": _BOUNDS, "vertex": _PACKED, "sh": _indexed("f_rest", max(_COMPRESSED_REST))}
    for element, table in file.tables.items():
        file.pass_over([name for name in table.dtype.names or () if name not in known[element]], f"element {element}")
    return file.of(cloud, step)


def _rest(table: NDArray[np.void] | None, count: int, where: str) -> Array:
    if table is None:
        return np.zeros((count, 0, 3))
    names = table.dtype.names or ()
    rest = tuple(f"f_rest_{index}" for index in range(sum(name.startswith("f_rest_") for name in names)))
    if (
        len(table) != count
        or len(rest) not in _COMPRESSED_REST
        or any(name not in names or table.dtype[name] != np.uint8 for name in rest)
    ):
        what = "the harmonics of the compressed PLY do not fit its vertices"
        expected = f"{count} rows of 9, 24 or 45 uchar"
        raise InputError(what, where=where, expected=expected, got=f"{len(table)} rows of {listed(names)}")
    raw = columns_of(table, rest)
    values = np.where(raw == 0, 0.0, np.where(raw == 255, 1.0, (raw + 0.5) / 256))
    return coefficient_major(((values - 0.5) * 8).astype(np.float32)).astype(np.float64)


def _packed(shares: NDArray[np.floating], bits: Sequence[int]) -> NDArray[np.uint32]:
    """Shares [n, c] as whole numbers of so many bits each, from the top of a word."""
    words = np.zeros(len(shares), np.uint32)
    for share, width in zip(shares.T, bits, strict=True):
        words = words << width | np.floor(share * ((1 << width) - 1) + 0.5).clip(0, (1 << width) - 1).astype(np.uint32)
    return words


def _unpacked(words: NDArray[np.uint32], bits: Sequence[int]) -> Array:
    """Inverse of ``_packed``: shares f64[n, c]."""
    shifts = [sum(bits[n + 1 :]) for n in range(len(bits))]
    return np.stack([(words >> at & (1 << width) - 1) / ((1 << width) - 1) for at, width in zip(shifts, bits)], 1)
