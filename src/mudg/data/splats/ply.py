"""The PLY of Gaussian splatting (Kerbl et al. 2023), which every viewer reads.

    ply / format binary_little_endian 1.0 / element vertex N / property float x ... / end_header, then rows of f32:
    x y z  nx ny nz (zero)  f_dc_0..2  f_rest_0..(3 (K - 1) - 1)  opacity (logit)  scale_0..2 (natural logarithm)  rot_0..3 (w x y z)

``f_rest`` holds all red coefficients, then green, then blue. Columns of our own stand last (``class``: train id, 255 = unknown).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.data.splats import binary
from mudg.data.splats.cloud import SplatCloud, checked

MAX_HEADER: Final = 1 << 16
_TYPES: Final = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_REST: Final = {0: 0, 9: 1, 24: 2, 45: 3}
"""Number of ``f_rest`` columns: degree."""


def to_bytes(cloud: SplatCloud, *, classes: bool = False) -> bytes:
    """A cloud as a PLY file; ``classes`` adds the column of our own."""
    with_classes = classes and cloud.class_ids is not None
    columns = [cloud.means, np.zeros_like(cloud.means), cloud.sh[:, 0], channel_major(cloud.sh), cloud.logits[:, None],
               cloud.log_scales, cloud.quats]  # fmt: skip
    if with_classes and cloud.class_ids is not None:
        columns.append(cloud.class_ids[:, None])
    rows = np.concatenate([column.astype("<f4") for column in columns], 1)
    names = [*_names(cloud.degree), *(["class"] if with_classes else [])]
    return header([("vertex", len(cloud), [("float", name) for name in names])]) + rows.tobytes()


def from_bytes(content: bytes, where: str) -> SplatCloud:
    """The Gaussians of a PLY file; columns that it does not know are passed over.

    Raises:
        InputError: another kind of PLY, or a damaged one.
    """
    table = read_elements(content, where).get("vertex")
    if table is None:
        raise InputError("the PLY file has no vertices", where=where)
    names = table.dtype.names or ()
    missing = [name for name in ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *_indexed("scale", 3), *_indexed("rot", 4))
               if name not in names]  # fmt: skip
    if missing:
        raise InputError("the PLY file holds no Gaussians", where=where, expected=f"a property {missing[0]!r}",
            got=", ".join(names[:12]), remedy="points or meshes cannot be imported")  # fmt: skip
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in _REST or any(name not in names for name in _indexed("f_rest", rest)):
        raise InputError(
            "the number of f_rest columns fits no degree of harmonics",
            where=where,
            expected="0, 9, 24 or 45",
            got=str(rest),
        )
    sh = np.concatenate(
        [
            columns_of(table, _indexed("f_dc", 3))[:, None],
            coefficient_major(columns_of(table, _indexed("f_rest", rest))),
        ],
        1,
    )
    classes = None
    if "class" in names:
        with np.errstate(invalid="ignore"):
            ids = np.asarray(table["class"], np.float64)
            classes = np.where((ids >= 0) & (ids <= 255), ids, 255).astype(np.uint8)
    cloud = SplatCloud(columns_of(table, ("x", "y", "z")), columns_of(table, _indexed("rot", 4)), columns_of(table, _indexed("scale", 3)),
                       np.asarray(table["opacity"], np.float32), sh, classes)  # fmt: skip
    return checked(cloud, where)


# -- headers -------------------------------------------------------------------------------------------------------------


def header(elements: list[tuple[str, int, list[tuple[str, str]]]]) -> bytes:
    """The header of a PLY file: elements with their number of rows and their properties (type, name)."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for name, count, properties in elements:
        lines += [f"element {name} {count}", *(f"property {kind} {column}" for kind, column in properties)]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


@dataclass
class _Element:
    name: str
    count: int
    columns: list[tuple[str, str]]


def read_elements(content: bytes, where: str) -> dict[str, NDArray[Any]]:
    """Elements of a binary PLY as structured arrays that look into ``content``.

    Raises:
        InputError: no PLY, an ASCII one, lists, a malformed header, or content that is too short.
    """
    elements, place, order = _parsed_header(content, where)
    found: dict[str, NDArray[Any]] = {}
    for element in elements:
        try:
            dtype = np.dtype([(name, order + kind) for name, kind in element.columns])
        except ValueError as error:
            raise InputError("two properties of a PLY element have one name", where=where, got=str(error)) from error
        if dtype.itemsize == 0:
            continue
        size = element.count * dtype.itemsize
        found[element.name] = np.frombuffer(
            binary.part(content, place, size, f"element {element.name!r}", where), dtype
        )
        place += size
    return found


def _parsed_header(content: bytes, where: str) -> tuple[list[_Element], int, str]:
    """Elements, where their rows begin, and the order of bytes."""
    if content[:3] != b"ply":
        raise InputError("not a PLY file", where=where, expected="the first line 'ply'", got=repr(content[:16]))
    end = content.find(b"end_header", 0, MAX_HEADER)
    line_end = content.find(b"\n", end, end + 16) if end >= 0 else -1
    if end < 0 or line_end < 0:
        raise InputError(
            "the header of the PLY file does not end", where=where, expected=f"end_header within {MAX_HEADER} bytes"
        )
    order, elements = "", list[_Element]()
    for line in content[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3:
            order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(words[1], "")
            if not order:
                raise InputError("this kind of PLY is not read", where=where, expected="binary_little_endian", got=words[1][:40],
                    remedy="save it as a binary PLY")  # fmt: skip
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 12:
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[0] == "property" and len(words) == 3 and words[1] in _TYPES and elements:
            elements[-1].columns.append((words[2], _TYPES[words[1]]))
        else:
            raise InputError("a line in the header of the PLY file is not understood", where=where, got=repr(line[:80]),
                expected="format, element NAME COUNT, or property TYPE NAME")  # fmt: skip
    if not order or not elements:
        raise InputError("the header of the PLY file names no format or no elements", where=where)
    for element in elements:
        if element.name in ("vertex", "chunk", "sh"):
            binary.refuse_count(element.count, f"{where}: element {element.name}")
    return elements, line_end + 1, order


# -- columns -------------------------------------------------------------------------------------------------------------


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
    return ("x", "y", "z", "nx", "ny", "nz", *_indexed("f_dc", 3), *_indexed("f_rest", rest), "opacity", *_indexed("scale", 3),
            *_indexed("rot", 4))  # fmt: skip


def channel_major(sh: NDArray[np.float32]) -> NDArray[np.float32]:
    """Harmonics from degree 1 on, f32[n, K, 3] to f32[n, 3 (K - 1)]: all of red, all of green, all of blue."""
    return sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), -1)


def coefficient_major(rest: NDArray[np.float32]) -> NDArray[np.float32]:
    """Inverse of ``channel_major``: f32[n, K - 1, 3]."""
    return rest.reshape(len(rest), 3, rest.shape[1] // 3).transpose(0, 2, 1)
