"""SPZ (Niantic): about 20 bytes a Gaussian before compression. Versions 1 to 3 are one gzip stream; version 4 is zstandard.

    header: u32 "NGSP", u32 version, u32 N, u8 degree, u8 fractional bits, u8 flags, u8 0
    planes: positions 3 x i24   opacities u8   colours 3 x u8   scales 3 x u8   rotations u32 (version 2: 3 x u8)   harmonics u8

Position = value / 2^bits; scale (natural logarithm) = value / 16 - 10; colour f_dc = (value / 255 - 0.5) / 0.15; harmonics
(value - 128) / 128, coefficient by coefficient. Rotation of versions 3 and 4: 2 bits index of the largest of (x, y, z, w), the others in
order, a sign and 9 bits each. Axes x right, y up, z back.
"""

from __future__ import annotations

import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError, ResourceError
from mudg.data.splats import binary
from mudg.data.splats.cloud import Floats, SplatCloud, checked, logit

MAGIC: Final = 0x5053474E
BITS: Final = 12
"""Fractional bits of positions: steps of 0.24 mm, up to 2048 m from the origin."""
HEADER: Final = "<IIIBBBB"
_COLOR: Final = 0.15
_PLANES: Final = ("positions", "opacities", "colors", "scales", "rotations", "harmonics")
_MOST_STREAMS: Final = len(_PLANES)


def fractional_bits(means: Floats) -> int:
    """Fractional bits with which all places fit into 24 bits."""
    farthest = float(np.abs(means).max(initial=0))
    bits = BITS
    while bits > 0 and farthest * (1 << bits) > (1 << 23) - 1:
        bits -= 1
    return bits


def to_bytes(cloud: SplatCloud, version: int = 3, antialias: bool = False) -> bytes:
    """A cloud as an SPZ file of version 3, or 4; ``antialias``: it was fitted with an antialiased rasteriser.

    Raises:
        InputError: a place too far from the origin. ResourceError: version 4 without the package zstandard.
    """
    bits = fractional_bits(cloud.means)
    if float(np.abs(cloud.means).max(initial=0)) * (1 << bits) > (1 << 23) - 1:
        raise InputError("a Gaussian lies too far from the origin for SPZ", expected="at most 8388 km")
    planes = _planes(cloud, bits)
    if version == 3:
        head = struct.pack(HEADER, MAGIC, 3, len(cloud), cloud.degree, bits, int(antialias), 0)
        return binary.gzip_bytes(head + b"".join(planes))
    packer = _zstandard("written").ZstdCompressor(level=12, write_content_size=True)
    planes = [plane for plane in planes if plane]
    streams = [packer.compress(plane) for plane in planes]
    head = struct.pack("<IIIBBBBI12x", MAGIC, 4, len(cloud), cloud.degree, bits, int(antialias), len(streams), 32)
    toc = b"".join(struct.pack("<QQ", len(stream), len(plane)) for stream, plane in zip(streams, planes))
    return head + toc + b"".join(streams)


def from_bytes(content: bytes, where: str) -> SplatCloud:
    """The Gaussians of an SPZ file of version 2 to 4.

    Raises:
        InputError: no SPZ file, a damaged one, or of another version. ResourceError: version 4 without the package zstandard.
    """
    if content[:4] == struct.pack("<I", MAGIC):
        return _from_streams(content, where)
    if content[:2] != b"\x1f\x8b":
        raise InputError(
            "not an SPZ file", where=where, expected="a gzip file, or one that begins with NGSP", got=repr(content[:4])
        )
    stream = binary.GzipStream(content, where)
    magic, version, count, degree, bits, flags, _ = struct.unpack(
        HEADER, stream.read(struct.calcsize(HEADER), "the header")
    )
    if magic != MAGIC:
        raise InputError("not an SPZ file", where=where, expected="NGSP in the compressed content", got=f"{magic:#x}")
    if version not in (2, 3):
        raise InputError("this version of SPZ is not read", where=where, expected="2, 3 or 4", got=str(version))
    binary.refuse_bomb(count, content, where)
    sizes = _sizes(count, degree, bits, 3 if version == 2 else 4, where)
    planes = [stream.read(size, f"the {name}") for name, size in zip(_PLANES, sizes)]
    if not flags & 2:
        stream.close()
    return _cloud(planes, count, degree, bits, where)


def _sizes(count: int, degree: int, bits: int, rotation: int, where: str) -> list[int]:
    """Sizes of the planes, after the header was found possible."""
    binary.refuse_count(count, where)
    if degree > 3:
        raise InputError("harmonics of this degree are not read", where=where, expected="0 to 3", got=str(degree))
    if bits > 23:
        raise InputError(
            "the number of fractional bits is not possible", where=where, expected="0 to 23", got=str(bits)
        )
    return [9 * count, count, 3 * count, 3 * count, rotation * count, 3 * ((degree + 1) ** 2 - 1) * count]


def _from_streams(content: bytes, where: str) -> SplatCloud:
    """Version 4: one zstandard frame per plane."""
    _, version, count, degree, bits, _, streams, toc = binary.unpacked("<IIIBBBBI", content, 0, "the header", where)
    if version != 4:
        raise InputError(
            "this version of SPZ is not read", where=where, expected="4 without gzip, 2 and 3 within", got=str(version)
        )
    binary.refuse_bomb(count, content, where)
    sizes = [size for size in _sizes(count, degree, bits, 4, where) if size]
    if streams != len(sizes) or toc < 32:
        raise InputError("the header of the SPZ file does not fit its content", where=where, expected=f"{len(sizes)} streams",
            got=f"{streams} streams, table at {toc}")  # fmt: skip
    table = binary.numbers(content, toc, "<u8", 2 * streams, "the table of streams", where).reshape(-1, 2)
    package, place, planes = _zstandard("read"), toc + 16 * streams, list[bytes]()
    for name, size, (packed, raw) in zip(_PLANES, sizes, table.tolist()):
        if raw != size:
            raise InputError(
                f"the {name} have another size than the header says", where=where, expected=str(size), got=str(raw)
            )
        part = binary.part(content, place, packed, f"the {name}", where)
        try:
            with package.ZstdDecompressor(max_window_size=1 << 27).stream_reader(bytes(part)) as reader:
                planes.append(reader.read(size + 1))
        except package.ZstdError as error:
            raise InputError("the compressed content is damaged", where=f"{where}: {name}", got=str(error)) from error
        if len(planes[-1]) != size:
            raise InputError(f"the {name} have another size than the header says", where=where, expected=str(size))
        place += packed
    return _cloud([*planes, b""][:6], count, degree, bits, where)


def _zstandard(done: str) -> Any:
    """The optional package."""
    try:
        import zstandard
    except ImportError as error:
        raise ResourceError(f"SPZ of version 4 is {done} with the package zstandard, which is not installed",
            remedy="pip install zstandard, or use version 3 (--spz-version 3)") from error  # fmt: skip
    return zstandard


# -- values --------------------------------------------------------------------------------------------------------------


def _planes(cloud: SplatCloud, bits: int) -> list[bytes]:
    fixed = np.round(cloud.means.astype(np.float64) * (1 << bits)).astype("<i4")
    scales = np.round((cloud.log_scales.astype(np.float64) + 10) * 16)
    colors = np.round(cloud.sh[:, 0].astype(np.float64) * _COLOR * 255 + 127.5)
    harmonics = np.round(cloud.sh[:, 1:].astype(np.float64) * 128) + 128
    bucket = np.full(harmonics.shape[1], 16)
    bucket[:3] = 8
    snapped = (harmonics + bucket[:, None] // 2) // bucket[:, None] * bucket[:, None]
    return [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes(), _bytes(np.round(cloud.opacity * 255.0)), _bytes(colors), _bytes(scales),
        _packed_rotations(cloud.quats).tobytes(), _bytes(snapped),
    ]  # fmt: skip


def _bytes(values: NDArray[np.floating]) -> bytes:
    return values.clip(0, 255).astype(np.uint8).tobytes()


def _packed_rotations(quats: Floats) -> NDArray[np.uint32]:
    largest, three = binary.smallest_three(quats[:, [1, 2, 3, 0]])
    words = largest.astype(np.uint32)
    size = np.floor(np.abs(three) * np.sqrt(2) * 511 + 0.5).clip(0, 511).astype(np.uint32)
    for index in range(3):
        words = words << 10 | (three[:, index] < 0).astype(np.uint32) << 9 | size[:, index]
    return words.astype("<u4")


def _cloud(planes: list[bytes], count: int, degree: int, bits: int, where: str) -> SplatCloud:
    positions, opacities, colors, scales, rotations, rest = (np.frombuffer(plane, np.uint8) for plane in planes)
    fixed = np.zeros((3 * count, 4), np.uint8)
    fixed[:, 1:] = positions.reshape(-1, 3)
    means = (fixed.view("<i4")[:, 0] >> 8).reshape(-1, 3) / (1 << bits)
    if len(rotations) == 4 * count:
        words = np.frombuffer(planes[4], "<u4")
        parts = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], 1).astype(np.int64)
        three = (parts & 511) / 511 / np.sqrt(2) * np.where(parts >> 9 == 1, -1, 1)
        xyzw = binary.from_smallest_three(words >> 30, three)
    else:
        xyz = rotations.reshape(-1, 3) / 127.5 - 1
        xyzw = np.column_stack([xyz, np.sqrt(np.maximum(1 - (xyz**2).sum(1), 0))])
    dc = (colors.reshape(-1, 1, 3) / 255 - 0.5) / _COLOR
    sh = np.concatenate([dc, (rest.reshape(count, -1, 3).astype(np.float64) - 128) / 128], 1)
    columns = [values.astype(np.float32) for values in (means, xyzw[:, [3, 0, 1, 2]], scales.reshape(-1, 3) / 16 - 10)]
    opacity = opacities.astype(np.float64).clip(0.5, 254.5) / 255
    return checked(SplatCloud(*columns, logit(opacity), sh.astype(np.float32)), where)
