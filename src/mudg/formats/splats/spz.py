"""SPZ (Niantic): about 20 bytes a Gaussian before compression. Versions 1 to 3 are one gzip stream; version 4 is
zstandard.

    header: u32 "NGSP", u32 version, u32 N, u8 degree, u8 fractional bits, u8 flags (1 antialiased, 2 extensions), u8 0
    planes: positions 3 x i24 (version 1: 3 x f16)   opacities u8   colours 3 x u8   scales 3 x u8
            rotations u32 (versions 1 and 2: 3 x u8)   harmonics u8
    extensions: u32 type, u32 length, content; after the planes, in version 4 between header and table. 0xADBE0003: u32
        axes

Position = value / 2^bits; scale (natural logarithm) = value / 16 - 10; colour f_dc = (value / 255 - 0.5) / 0.15;
harmonics (value - 128) / 128, coefficient by coefficient. Rotation of versions 3 and 4: 2 bits index of the largest of
(x, y, z, w), the others in order, a sign and 9 bits each. Axes x right, y up, z back, or those of the extension.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError, ResourceError
from mudg.formats.splats import binary
from mudg.formats.splats.cloud import Floats, SplatCloud, SplatFile, checked, logit, spacing_m
from mudg.formats.unknown_fields import listed

MAGIC: Final = 0x5053474E
BITS: Final = 12
"""Fractional bits of positions: steps of 0.24 mm, up to 2048 m from the origin."""
HEADER: Final = "<IIIBBBB"
_COLOR: Final = 0.15
_PLANES: Final = ("positions", "opacities", "colors", "scales", "rotations", "harmonics")
_ANTIALIAS, _EXTENSIONS = 1, 2
_AXES: Final = 0xADBE0003
_AXES_CODES: Final = ("", *"LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split())
_MOST_EXTENSIONS: Final = 1 << 20
_HARMLESS: Final = {0xADBE0002}
"""Extensions that say nothing about the Gaussians: where a viewer's camera may go."""


def fractional_bits(means: NDArray[np.floating]) -> int:
    """Fractional bits with which all places fit into 24 bits."""
    farthest = float(np.abs(means).max(initial=0))
    bits = BITS
    while bits > 0 and farthest * (1 << bits) > (1 << 23) - 1:
        bits -= 1
    return bits


def to_bytes(cloud: SplatCloud, antialias: bool = False) -> bytes:
    """A cloud as an SPZ file of version 3; ``antialias``: it was fitted with an antialiased rasteriser. Raises
    InputError: a place too far from the origin."""
    bits = fractional_bits(cloud.means)
    if float(np.abs(cloud.means).max(initial=0)) * (1 << bits) > (1 << 23) - 1:
        raise InputError("a Gaussian lies too far from the origin for SPZ", expected="at most 8388 km")
    head = struct.pack(HEADER, MAGIC, 3, len(cloud), cloud.degree, bits, _ANTIALIAS * antialias, 0)
    return zlib.compress(head + b"".join(_planes(cloud, bits)), 9, 31)


@dataclass(frozen=True, slots=True)
class _Header:
    """What stands before the planes."""

    version: int
    count: int
    degree: int
    bits: int
    flags: int

    def sizes(self, where: str) -> list[int]:
        """Sizes of the planes, after the header was found possible."""
        binary.refuse_count(self.count, where)
        if self.degree > 4:
            what = "harmonics of this degree are not read"
            raise InputError(what, where=where, expected="0 to 3", got=str(self.degree))
        if self.bits > 23:
            what = "the number of fractional bits is not possible"
            raise InputError(what, where=where, expected="0 to 23", got=str(self.bits))
        places, rotation = (6 if self.version == 1 else 9), (4 if self.version > 2 else 3)
        harmonics = 3 * ((self.degree + 1) ** 2 - 1)
        return [size * self.count for size in (places, 1, 3, 3, rotation, harmonics)]


def from_bytes(content: bytes, where: str) -> SplatFile:
    """The Gaussians of an SPZ file of version 1 to 4. Raises InputError: no SPZ file, a damaged one, or of another
    version. ResourceError: version 4 without the package zstandard."""
    if content[:4] == struct.pack("<I", MAGIC):
        return _from_streams(content, where)
    if content[:2] != b"\x1f\x8b":
        what = "not an SPZ file"
        raise InputError(what, where=where, expected="a gzip file, or one that begins with NGSP", got=repr(content[:4]))
    packer, size = zlib.decompressobj(31), struct.calcsize(HEADER)
    head_bytes = binary.inflated(packer, content, size, where)
    magic, *fields, _ = binary.unpacked(HEADER, head_bytes, 0, "the header", where)
    if magic != MAGIC:
        raise InputError("not an SPZ file", where=where, expected="NGSP in the compressed content", got=f"{magic:#x}")
    head = _Header(*fields)
    if head.version not in (1, 2, 3):
        raise InputError("this version of SPZ is not read", where=where, expected="1 to 4", got=str(head.version))
    binary.refuse_bomb(head.count, content, where)
    sizes, extended = head.sizes(where), bool(head.flags & _EXTENSIONS)
    body = binary.inflated(packer, packer.unconsumed_tail, sum(sizes) + _MOST_EXTENSIONS * extended, where)
    planes, place = [], 0
    for size, name in zip(sizes, _PLANES):
        planes.append(bytes(binary.part(body, place, size, f"the {name}", where)))
        place += size
    if head.flags <= _ANTIALIAS | _EXTENSIONS:  # programs with further flags may have further planes
        more = binary.inflated(packer, packer.unconsumed_tail, 1, where)
        if more or not packer.eof:
            what = "goes on after its last value" if more else "ends before its checksum"
            what, remedy = f"the compressed content {what}", "the header does not fit the content"
            raise InputError(what, where=where, remedy=remedy)
    return _file(planes, head, _extensions(body[place:], where) if extended else {}, where)


def _from_streams(content: bytes, where: str) -> SplatFile:
    """Version 4: one zstandard frame per plane."""
    try:
        import zstandard
    except ImportError as error:
        what = "SPZ of version 4 is read with the package zstandard, which is not installed"
        raise ResourceError(what, remedy="pip install zstandard, or write the file as version 3") from error
    _, *fields, streams, toc = binary.unpacked("<IIIBBBBI", content, 0, "the header", where)
    head = _Header(*fields)
    if head.version != 4:
        what = "this version of SPZ is not read"
        raise InputError(what, where=where, expected="4 without gzip, 1 to 3 within", got=str(head.version))
    binary.refuse_bomb(head.count, content, where)
    sizes = [size for size in head.sizes(where) if size]
    if streams != len(sizes) or toc < 32:
        what = "the header of the SPZ file does not fit its content"
        raise InputError(what, where=where, expected=f"{len(sizes)} streams", got=f"{streams} streams, table at {toc}")
    table = struct.iter_unpack("<QQ", binary.part(content, toc, 16 * streams, "the table of streams", where))
    extensions = _extensions(content[32:toc], where) if head.flags & _EXTENSIONS else {}
    place, planes = toc + 16 * streams, list[bytes]()
    for name, size, (packed, raw) in zip(_PLANES, sizes, table):
        if raw != size:
            what = f"the {name} have another size than the header says"
            raise InputError(what, where=where, expected=str(size), got=str(raw))
        part = binary.part(content, place, packed, f"the {name}", where)
        try:
            with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(bytes(part)) as reader:
                planes.append(reader.read(size + 1))
        except zstandard.ZstdError as error:
            raise InputError("the compressed content is damaged", where=f"{where}: {name}", got=str(error)) from error
        if len(planes[-1]) != size:
            raise InputError(f"the {name} have another size than the header says", where=where, expected=str(size))
        place += packed
    return _file([*planes, b""][:6], head, extensions, where)


def _extensions(content: bytes, where: str) -> dict[int, bytes]:
    """Records of extensions by type, the last of each."""
    found, place = dict[int, bytes](), 0
    while place + 8 <= len(content):
        kind, size = struct.unpack_from("<II", content, place)
        found[kind] = bytes(binary.part(content, place + 8, size, f"extension {kind:#010x}", where))
        place += 8 + size
    return found


def _file(planes: list[bytes], head: _Header, extensions: dict[int, bytes], where: str) -> SplatFile:
    """The Gaussians with what header and extensions say about them."""
    notes, warnings, axes = list[str](), list[str](), ""
    if _AXES in extensions:
        code = int.from_bytes(extensions[_AXES], "little")
        if len(extensions[_AXES]) != 4 or code >= len(_AXES_CODES):
            what, where = "the axes of the SPZ file are not known", f"{where}: extension {_AXES:#010x}"
            expected, remedy = f"a number up to {len(_AXES_CODES) - 1}", "convert it with the program that wrote it"
            raise InputError(what, where=where, expected=expected, got=extensions[_AXES][:8].hex(), remedy=remedy)
        axes = _AXES_CODES[code]
    else:
        newer, remedy = head.version == 4, "if it stands on its head, add --axes RDF"
        doubt = "splat-transform from 3 on writes y down: " if newer else ""
        words = f"it does not state its axes: read with y up, as the format says; {doubt}{remedy}"
        (warnings if newer else notes).append(words)
    known = {_AXES, *_HARMLESS}
    if unknown := [f"{kind:#010x} ({len(part)} bytes)" for kind, part in extensions.items() if kind not in known]:
        warnings.append(f"extensions that are not known were passed over: {listed(unknown)}")
    if head.flags & ~(_ANTIALIAS | _EXTENSIONS):
        warnings.append(f"flags that are not known were passed over: {head.flags:#x}")
    if head.degree > 3:
        warnings.append("harmonics beyond degree 3 were dropped")
    cloud = _cloud(planes, head, where)
    step = spacing_m(cloud.means, np.float16) if head.version == 1 else 2.0**-head.bits
    return SplatFile(cloud, axes, f"extension {_AXES:#010x}", step, notes, warnings)


# -- values ----------------------------------------------------------------------------------------


def _planes(cloud: SplatCloud, bits: int) -> list[bytes]:
    fixed = np.round(cloud.means.astype(np.float64) * (1 << bits)).astype("<i4")
    scales = np.round((cloud.log_scales.astype(np.float64) + 10) * 16)
    colors = np.round(cloud.sh[:, 0].astype(np.float64) * _COLOR * 255 + 127.5)
    harmonics = np.round(cloud.sh[:, 1:].astype(np.float64) * 128) + 128
    bucket = np.full(harmonics.shape[1], 16)
    bucket[:3] = 8
    snapped = (harmonics + bucket[:, None] // 2) // bucket[:, None] * bucket[:, None]
    parts = (np.round(cloud.opacity * 255.0), colors, scales, snapped)
    opacity, color, scale, rest = (part.clip(0, 255).astype(np.uint8).tobytes() for part in parts)
    places = fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
    return [places, opacity, color, scale, _packed_rotations(cloud.quats).tobytes(), rest]


def _packed_rotations(quats: Floats) -> NDArray[np.uint32]:
    largest, three = binary.smallest_three(quats[:, [1, 2, 3, 0]])
    words = largest.astype(np.uint32)
    size = np.floor(np.abs(three) * np.sqrt(2) * 511 + 0.5).clip(0, 511).astype(np.uint32)
    for index in range(3):
        words = words << 10 | (three[:, index] < 0).astype(np.uint32) << 9 | size[:, index]
    return words.astype("<u4")


def _cloud(planes: list[bytes], head: _Header, where: str) -> SplatCloud:
    count = head.count
    positions, opacities, colors, scales, rotations, rest = (np.frombuffer(plane, np.uint8) for plane in planes)
    if head.version == 1:
        means = np.frombuffer(planes[0], "<f2").astype(np.float64).reshape(-1, 3)
    else:
        fixed = np.zeros((3 * count, 4), np.uint8)
        fixed[:, 1:] = positions.reshape(-1, 3)
        means = (fixed.view("<i4")[:, 0] >> 8).reshape(-1, 3) / (1 << head.bits)
    if head.version > 2:
        words = np.frombuffer(planes[4], "<u4")
        parts = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], 1).astype(np.int64)
        three = (parts & 511) / 511 / np.sqrt(2) * np.where(parts >> 9 == 1, -1, 1)
        xyzw = binary.from_smallest_three(words >> 30, three)
    else:
        xyz = rotations.reshape(-1, 3) / 127.5 - 1
        xyzw = np.column_stack([xyz, np.sqrt(np.maximum(1 - (xyz**2).sum(1), 0))])
    dc = (colors.reshape(-1, 1, 3) / 255 - 0.5) / _COLOR
    sh = np.concatenate([dc, (rest.reshape(count, -1, 3)[:, :15].astype(np.float64) - 128) / 128], 1)
    opacity = opacities.astype(np.float64).clip(0.5, 254.5) / 255
    stated = (xyzw[:, [3, 0, 1, 2]], scales.reshape(-1, 3) / 16 - 10, logit(opacity), sh)
    quats, logs, logits, sh = (values.astype(np.float32) for values in stated)
    return checked(SplatCloud(means, quats, logs, logits, sh, antialias=bool(head.flags & _ANTIALIAS)), where)
