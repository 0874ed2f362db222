"""Files of Gaussians as other programs write them, put together byte by byte from the formats' descriptions.

They share no code with ``mudg.formats.splats``. `ROWS` are the Gaussians that all of them hold, before a format rounds
them.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from PIL import Image

C1 = 0.4886025119029199
"""Factor of the harmonics of degree 1: of -y, z and -x of the direction."""
HALF = math.sqrt(0.5)
NAMES = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
ROWS: list[dict[str, float]] = [
    dict(zip(NAMES, values, strict=True))
    for values in (
        (1.0, 2.0, 3.0, 0.5, -0.25, 0.0, 2.0, -1.0, -2.0, -3.0, HALF, HALF, 0.0, 0.0),
        (-4.0, 0.5, 0.25, -0.5, 0.75, 1.0, -1.0, -2.5, -0.5, -4.0, 0.5, 0.5, 0.5, 0.5),
        (2.0, -3.0, -1.0, 0.25, 0.25, -1.0, 0.5, -1.5, -3.5, 0.25, HALF, 0.0, 0.0, HALF),
    )
]
"""Values as the PLY stores them: opacities as logits, sizes as natural logarithms, rotations w, x, y, z."""
F_REST = [0.25, 0.0, -0.25, 0.5, 0.0, 0.0, 0.0, 0.125, 0.375]
"""Harmonics of degree 1 of each of them: red, green, blue, three values each."""
KINDS = {"float": "f", "double": "d", "uchar": "B", "char": "b", "int": "i", "uint": "I", "ushort": "H"}


def rows(**changes: Any) -> list[dict[str, float]]:
    """`ROWS` with a value, or one for each, in some columns; None takes a column out."""
    made = []
    for index, row in enumerate(ROWS):
        own = {name: value[index] if isinstance(value, list) else value for name, value in changes.items()}
        made.append({name: value for name, value in {**row, **own}.items() if value is not None})
    return made


def ply(
    table: Sequence[Mapping[str, float]] = ROWS,
    head: Iterable[str] = (),
    kinds: Mapping[str, str] | None = None,
    before: tuple[str, bytes] = ("", b""),
    after: tuple[str, bytes] = ("", b""),
    order: str = "<",
) -> bytes:
    """A binary PLY. head: comments. kinds: types of columns other than float. before, after: lines and bytes of other
    elements."""
    kinds = kinds or {}
    names = list(table[0])
    lines = ["ply", f"format binary_{'little' if order == '<' else 'big'}_endian 1.0", *head]
    lines += filter(None, before[0].split("\n"))
    lines += [f"element vertex {len(table)}", *(f"property {kinds.get(name, 'float')} {name}" for name in names)]
    lines += [*filter(None, after[0].split("\n")), "end_header\n"]
    packed = struct.Struct(order + "".join(KINDS[kinds.get(name, "float")] for name in names))
    body = b"".join(packed.pack(*(row[name] for name in names)) for row in table)
    return "\n".join(lines).encode() + before[1] + body + after[1]


def compressed_ply(low: float, high: float, kind: str = "float", head: Iterable[str] = (), more: str = "") -> bytes:
    """Two Gaussians at both ends of a chunk that reaches from ``low`` to ``high`` metres on every axis."""
    groups = (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    bounds = [f"{side}_{name}" for names in groups for side in ("min", "max") for name in names]
    lines = ["ply", "format binary_little_endian 1.0", *head, "element chunk 1"]
    lines += [*(f"property {kind} {name}" for name in bounds), "element vertex 2"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    lines += [*([f"property uchar {more}"] if more else []), "end_header\n"]
    chunk = struct.pack(f"<18{KINDS[kind]}", *[low] * 3, *[high] * 3, *[-4] * 3, *[-1] * 3, *[0] * 3, *[1] * 3)
    half = (1 << 9) | (1 << 19) | (1 << 29)  # three components near 0, the largest is w
    body = b"".join(struct.pack("<4I", word, half, 0, 200) + (b"\7" if more else b"") for word in (0, 0xFFFFFFFF))
    return "\n".join(lines).encode() + chunk + body


def spz(
    version: int = 3,
    flags: int = 0,
    extensions: Iterable[tuple[int, bytes]] = (),
    degree: int = 1,
    bits: int = 12,
    more: bytes = b"",
) -> bytes:
    """`ROWS` with `F_REST` as an SPZ file of version 1 to 4; those of version 4 have stored frames."""
    count, rest = len(ROWS), (degree + 1) ** 2 - 1
    planes: list[bytes] = [b"", b"", b"", b"", b"", b""]
    for row in ROWS:
        for name in "xyz":
            fixed = round(row[name] * (1 << bits)) & 0xFFFFFF
            planes[0] += struct.pack("<e", row[name]) if version == 1 else fixed.to_bytes(3, "little")
        planes[1] += bytes([round(255 / (1 + math.exp(-row["opacity"])))])
        planes[2] += bytes(round(row[f"f_dc_{c}"] * 0.15 * 255 + 127.5) for c in range(3))
        planes[3] += bytes(round((row[f"scale_{c}"] + 10) * 16) for c in range(3))
        w, *xyz = (row[f"rot_{c}"] for c in range(4))
        if version < 3:
            planes[4] += bytes(round((v + 1) * 127.5) for v in xyz)
        else:
            word = 3
            for v in xyz:
                word = word << 10 | (v < 0) << 9 | round(abs(v) * math.sqrt(2) * 511)
            planes[4] += struct.pack("<I", word)
        for k in range(rest):
            planes[5] += bytes(round(128 + 128 * F_REST[3 * c + k]) if k < 3 else 128 for c in range(3))
    zone = b"".join(struct.pack("<II", kind, len(part)) + part for kind, part in extensions)
    head = struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, bits, flags, 0)
    if version < 4:
        return gzip.compress(head + b"".join(planes) + zone + more, mtime=0)
    planes = [plane for plane in planes if plane]
    magic = b"\x28\xb5\x2f\xfd\xa0"
    frames = [magic + struct.pack("<I", len(p)) + (len(p) << 3 | 1).to_bytes(3, "little") + p for p in planes]
    head = head[:15] + bytes([len(frames)]) + struct.pack("<I12x", 32 + len(zone))
    toc = b"".join(struct.pack("<QQ", len(frame), len(plane)) for frame, plane in zip(frames, planes))
    return head + zone + toc + b"".join(frames)


def sog(lossy: str = "", **fields: Any) -> bytes:
    """Two solid Gaussians at (0, 0, 0) and (e - 1, ...) as a SOG file; ``fields`` are added to meta.json, ``a.b``
    within ``a``; ``lossy``: the picture that is written with loss."""
    table = [-5.0 + 0.01 * n for n in range(256)]
    meta: dict[str, Any] = {
        "version": 2,
        "count": 2,
        "means": {"mins": [0.0] * 3, "maxs": [1.0] * 3, "files": ["l.png", "u.png"]},
        "scales": {"codebook": table, "files": ["s.png"]},
        "quats": {"files": ["q.png"]},
        "sh0": {"codebook": table, "files": ["c.png"]},
    }
    for name, value in fields.items():
        owner, _, inner = name.rpartition(".")
        (meta[owner] if owner else meta)[inner] = value
    black, white = (0, 0, 0, 255), (255, 255, 255, 255)
    pixels = dict.fromkeys("lus", (black, white))
    pixels |= {"q": ((128, 128, 128, 252),) * 2, "c": ((9, 9, 9, 230),) * 2}
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("meta.json", json.dumps(meta))
        for name, (first, second) in pixels.items():
            image, picture = Image.new("RGBA", (2, 1)), io.BytesIO()
            image.putpixel((0, 0), first)
            image.putpixel((1, 0), second)
            image.save(picture, "WEBP" if name == lossy else "PNG")
            archive.writestr(f"{name}.png", picture.getvalue())
    return target.getvalue()


def glb(
    table: Sequence[Mapping[str, float]] = ROWS,
    *,
    plain: bool = True,
    kind: Mapping[str, Any] | None = None,
    node: Mapping[str, Any] | None = None,
    document: Mapping[str, Any] | None = None,
    view: Mapping[str, Any] | None = None,
    turn_length: float = 1.0,
    more: str = "",
) -> bytes:
    """Gaussians as a GLB file. plain: opacities and sizes as the standard says, else logits and logarithms. kind:
    fields of the extension. node, document, view: further fields of the node, the document, the first buffer view.
    more: name of a further attribute."""
    prefix = "KHR_gaussian_splatting:"
    width = {"POSITION": 3, "ROTATION": 4, "SCALE": 3, "OPACITY": 1, "SH_DEGREE_0_COEF_0": 3}
    width |= {more: 3} if more else {}
    parts = dict.fromkeys(width, b"")
    for row in table:
        size = [row[f"scale_{c}"] for c in range(3)]
        w, x, y, z = (turn_length * row[f"rot_{c}"] for c in range(4))
        opacity = row["opacity"]
        parts["POSITION"] += struct.pack("<3f", row["x"], row["y"], row["z"])
        parts["ROTATION"] += struct.pack("<4f", x, y, z, w)
        parts["SCALE"] += struct.pack("<3f", *(map(math.exp, size) if plain else size))
        parts["OPACITY"] += struct.pack("<f", 1 / (1 + math.exp(-opacity)) if plain else opacity)
        parts["SH_DEGREE_0_COEF_0"] += struct.pack("<3f", *(row[f"f_dc_{c}"] for c in range(3)))
        if more:
            parts[more] += bytes(12)
    offsets = [sum(len(p) for p in list(parts.values())[:n]) for n in range(len(parts))]
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", **(kind or {})}
    extension = {name: value for name, value in extension.items() if value is not None}
    attributes = {name if name == "POSITION" else prefix + name: n for n, name in enumerate(width)}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {"KHR_gaussian_splatting": extension}}
    types = [{1: "SCALAR", 3: "VEC3", 4: "VEC4"}[w] for w in width.values()]
    made: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": sum(map(len, parts.values()))}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": at, "byteLength": len(p)} for at, p in zip(offsets, parts.values())
        ],
        "accessors": [
            {"bufferView": n, "componentType": 5126, "count": len(table), "type": kind} for n, kind in enumerate(types)
        ],
        **(document or {}),
    }
    made["bufferViews"][0] |= view or {}
    text = json.dumps(made).encode()
    text += b" " * (-len(text) % 4)
    content = b"".join(parts.values())
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(content), b"BIN\0") + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def splat(table: Sequence[Mapping[str, float]] = ROWS, logs: bool = False) -> bytes:
    """Gaussians as a .splat file; logs: with logarithms of sizes, which the format does not have."""
    made = b""
    for row in table:
        size = [row[f"scale_{c}"] for c in range(3)]
        turn = [round((row[f"rot_{c}"] + 1) / 2 * 255) for c in range(4)]
        place, size = [row[axis] for axis in "xyz"], size if logs else map(math.exp, size)
        made += struct.pack("<6f8B", *place, *size, 99, 99, 99, 200, *turn)
    return made
