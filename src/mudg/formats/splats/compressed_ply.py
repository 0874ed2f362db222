"""The compressed PLY of SuperSplat and PlayCanvas: 16 bytes a Gaussian, values within the bounds of chunks of 256.

    element chunk ceil(N / 256): min_x y z max_x y z  min_scale_x y z max_scale_x y z  min_r g b max_r g b   f32
    element vertex N: packed_position packed_rotation packed_scale packed_color                              u32
    element sh N: f_rest_0..                                                                                 u8, from
                                                                                                             degree 1 on

Positions and scales (natural logarithm): 11, 10, 11 bits from the top. Rotation: 2 bits index of the largest of (w, x,
y, z), the others in order, 10 bits each, ``v / sqrt 2 + 0.5``. Colour: 8 bits each of the colour of degree 0 within the
chunk, and opacity.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.core.harmonics import C0
from mudg.formats.splats import binary, ply
from mudg.formats.splats.cloud import SplatCloud, SplatFile, checked, logit, spacing_m
from mudg.formats.unknown_fields import listed, sentence

CHUNK: Final = 256
_BOUNDS: Final = tuple(
    f"{side}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for side in ("min", "max")
    for name in names
)
_PACKED: Final = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_REST: Final = {9: 1, 24: 2, 45: 3}
_LOG_RANGE: Final = 20.0

Array = NDArray[np.float64]


def to_bytes(cloud: SplatCloud, marks: Sequence[str] = ()) -> bytes:
    """A cloud as a compressed PLY file; rows are brought into Morton order. ``marks``: comments, as in
    ``ply.marks_of``."""
    cloud = cloud.take(binary.morton_order(cloud.means))
    chunks = -(-len(cloud) // CHUNK)
    of_chunk = np.arange(len(cloud)) // CHUNK
    bounds, shares = [], []
    for values in (cloud.means, cloud.log_scales.clip(-_LOG_RANGE, _LOG_RANGE), cloud.sh[:, 0] * C0 + 0.5):
        padded = np.concatenate([values, np.repeat(values[-1:], chunks * CHUNK - len(cloud), 0)]).reshape(
            chunks, CHUNK, 3
        )
        low, high = padded.min(1).astype("<f4"), padded.max(1).astype("<f4")
        bounds += [low, high]
        span = (high - low).astype(np.float64)
        inside = (values - low[of_chunk]) / np.where(span > 1e-5, span, 1)[of_chunk]
        shares.append(np.where(span[of_chunk] > 1e-5, inside, 0.0))
    place, scale, color = shares
    largest, three = binary.smallest_three(cloud.quats)
    turn = _unorm(three / np.sqrt(2) + 0.5, 10)
    packed = np.empty((len(cloud), 4), "<u4")
    packed[:, 0], packed[:, 2] = _pack_11_10_11(place), _pack_11_10_11(scale)
    packed[:, 1] = largest.astype(np.uint32) << 30 | turn[:, 0] << 20 | turn[:, 1] << 10 | turn[:, 2]
    rgba = _unorm(np.concatenate([color, cloud.opacity[:, None]], 1), 8)
    packed[:, 3] = rgba[:, 0] << 24 | rgba[:, 1] << 16 | rgba[:, 2] << 8 | rgba[:, 3]
    elements = [
        ("chunk", chunks, [("float", name) for name in _BOUNDS]),
        ("vertex", len(cloud), [("uint", name) for name in _PACKED]),
    ]
    tables = [np.concatenate(bounds, 1).tobytes(), packed.tobytes()]
    if cloud.degree:
        rest = ply.channel_major(cloud.sh)
        elements.append(("sh", len(cloud), [("uchar", f"f_rest_{index}") for index in range(rest.shape[1])]))
        tables.append(np.trunc((rest / 8 + 0.5) * 256).clip(0, 255).astype(np.uint8).tobytes())
    return ply.header(elements, marks) + b"".join(tables)


def is_compressed(content: bytes) -> bool:
    """Whether the header of a PLY file announces chunks."""
    return b"element chunk" in content[: content.find(b"end_header", 0, ply.MAX_HEADER) + 1]


def from_bytes(content: bytes, where: str) -> SplatFile:
    """The Gaussians of a compressed PLY file; columns and elements that it does not know are passed over.

    Raises:
        InputError: another kind of PLY, or a damaged one.
    """
    file = ply.read_elements(content, where, ("chunk", "vertex", "sh"))
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
    bounds = {name: chunk[name].astype(np.float64) for name in _BOUNDS if name in names}
    low, high = (np.stack([bounds[name] for name in _BOUNDS[at : at + 3]], 1) for at in (0, 3))
    means = _between(_unpack_11_10_11(words["packed_position"]), low, high, of_chunk)
    low_size, high_size = (np.stack([bounds[name] for name in _BOUNDS[at : at + 3]], 1) for at in (6, 9))
    scales = _between(_unpack_11_10_11(words["packed_scale"]), low_size, high_size, of_chunk)
    rgba = np.stack([words["packed_color"] >> shift & 255 for shift in (24, 16, 8, 0)], 1) / 255
    color = rgba[:, :3]  # files of the first version state no bounds of colours
    if all(name in names for name in _BOUNDS[12:]):
        dark, bright = (np.stack([bounds[name] for name in _BOUNDS[at : at + 3]], 1) for at in (12, 15))
        color = _between(color, dark, bright, of_chunk)
    word = words["packed_rotation"]
    three = (np.stack([word >> shift & 1023 for shift in (20, 10, 0)], 1) / 1023 - 0.5) * np.sqrt(2)
    quats = binary.from_smallest_three(word >> 30, three)
    sh = np.concatenate([((color - 0.5) / C0)[:, None], _rest(file.tables.get("sh"), len(vertex), where)], 1)
    columns = [values.astype(np.float32) for values in (quats, scales, logit(rgba[:, 3]), sh)]
    cloud = checked(SplatCloud(means, *columns, antialias=file.antialias), where)
    step = spacing_m(np.concatenate([low, high])) if chunk.dtype["min_x"].itemsize == 4 else 0.0
    known = {"chunk": _BOUNDS, "vertex": _PACKED, "sh": tuple(f"f_rest_{index}" for index in range(max(_REST)))}
    unknown = {
        element: [n for n in table.dtype.names or () if n not in known[element]]
        for element, table in file.tables.items()
    }
    notes = [sentence(names, f"element {element}") for element, names in unknown.items() if names]
    return SplatFile(cloud, file.axes, file.axes_by, step, (*file.notes, *notes), file.warnings)


def _rest(table: NDArray[np.void] | None, count: int, where: str) -> Array:
    if table is None:
        return np.zeros((count, 0, 3))
    names = table.dtype.names or ()
    rest = tuple(f"f_rest_{index}" for index in range(sum(name.startswith("f_rest_") for name in names)))
    if (
        len(table) != count
        or len(rest) not in _REST
        or any(name not in names or table.dtype[name] != np.uint8 for name in rest)
    ):
        what = "the harmonics of the compressed PLY do not fit its vertices"
        expected = f"{count} rows of 9, 24 or 45 uchar"
        raise InputError(what, where=where, expected=expected, got=f"{len(table)} rows of {listed(names)}")
    raw = ply.columns_of(table, rest)
    values = np.where(raw == 0, 0.0, np.where(raw == 255, 1.0, (raw + 0.5) / 256))
    return ply.coefficient_major(((values - 0.5) * 8).astype(np.float32)).astype(np.float64)


def _unorm(values: Array, bits: int) -> NDArray[np.uint32]:
    most = (1 << bits) - 1
    return np.floor(values * most + 0.5).clip(0, most).astype(np.uint32)


def _pack_11_10_11(values: Array) -> NDArray[np.uint32]:
    return _unorm(values[:, 0], 11) << 21 | _unorm(values[:, 1], 10) << 11 | _unorm(values[:, 2], 11)


def _unpack_11_10_11(words: NDArray[np.uint32]) -> Array:
    return np.stack([(words >> 21) / 2047, (words >> 11 & 1023) / 1023, (words & 2047) / 2047], 1)


def _between(shares: Array, low: Array, high: Array, of_chunk: NDArray[np.intp]) -> Array:
    """Values at shares [n, 3] of the way from the lower to the upper bounds [chunks, 3]."""
    with np.errstate(over="ignore", invalid="ignore"):
        return low[of_chunk] + shares * (high - low)[of_chunk]
