"""Damaged files of Gaussians, by length, header and values, and bombs: always a clear error."""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import foreign_splats
import numpy as np
import pytest
import toy_splats
from refusals import refused

from mudg.formats.splats import binary, formats, gltf, ply, sog, spz
from mudg.formats.splats.cloud import SplatCloud

READ = [name for name, one in formats.FORMATS.items() if one.read]


def content_of(name: str) -> bytes:
    return toy_splats.written(name, toy_splats.cloud(3, 1))


def read(content: bytes, name: str) -> SplatCloud:
    """Read by the format's own reader; anything but an error of ours and a sound cloud is a failure."""
    reader = formats.FORMATS[name].read
    assert reader is not None
    cloud = reader(content, "bad.file").cloud
    assert np.isfinite(cloud.means).all() and np.isfinite(cloud.log_scales).all() and np.isfinite(cloud.sh).all()
    return cloud


@pytest.mark.parametrize("name", READ)
@pytest.mark.parametrize(
    "content", [b"", b"p", b"ply\n", b"\x1f\x8b", b"NGSP", b"glTF", b"PK\x03\x04", b"\0" * 4095, b"\xff" * 333]
)
def test_what_is_another_file_is_refused(name: str, content: bytes) -> None:
    refused("where: bad.file", read, content, name)


# -- numbers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", range(17))
def test_values_of_a_ply_that_are_no_numbers_are_refused(value: float, column: int) -> None:
    nothing = np.isneginf(value) and 10 <= column < 13  # a size of 0
    if 3 <= column < 6 or nothing or (column == 9 and np.isinf(value)):  # normals are not read, opacities may be 0 or 1
        return
    content = ply.to_bytes(toy_splats.cloud(3))
    at = content.index(b"end_header\n") + 11 + 4 * 17
    bad = content[: at + 4 * column] + struct.pack("<f", value) + content[at + 4 * column + 4 :]
    refused(r"bad.file: Gaussian 1", read, bad, "ply")


@pytest.mark.parametrize("count", ["0", "-1", "3.5", "99999999999", "5000000", "1" * 40, "three"])
@pytest.mark.parametrize("name", ["ply", "compressed-ply"])
def test_impossible_counts_of_a_ply_are_refused_at_once(name: str, count: str) -> None:
    bad = content_of(name).replace(b"element vertex 3", b"element vertex " + count.encode())
    with within(1 << 20):
        refused("bad.file", read, bad, name)


@pytest.mark.parametrize(
    ("place", "value"), [(4, 1), (4, 9), (8, 0), (8, 0xFFFFFFFF), (8, 40_000_000), (12, 4), (13, 60)]
)
def test_headers_of_spz_that_cannot_be_are_refused(place: int, value: int) -> None:
    raw = bytearray(zlib.decompress(spz.to_bytes(toy_splats.cloud(3)), 31))
    raw[place : place + (4 if place < 12 else 1)] = value.to_bytes(4 if place < 12 else 1, "little")
    with within(1 << 21):
        refused("bad.file", read, gzip.compress(bytes(raw)), "spz")


def test_spz_that_goes_on_and_other_damage_is_refused() -> None:
    content = spz.to_bytes(toy_splats.cloud(3))
    raw = zlib.decompress(content, 31)
    refused("goes on", read, gzip.compress(raw + b"x"), "spz")
    refused("damaged", read, content[:-8] + bytes(4) + content[-4:], "spz")
    head = struct.pack("<IIIBBBBI12x", spz.MAGIC, 4, 3, 0, 12, 0, 9, 32)
    refused("does not fit", read, head + bytes(200), "spz")
    content = bytearray(formats.splat_bytes(toy_splats.cloud(2)))
    content[32:36] = struct.pack("<f", np.nan)
    refused("Gaussian 1", read, bytes(content), "splat")


# -- bombs -----------------------------------------------------------------------------------------


def altered_sog(change: Callable[[dict[str, Any]], None], files: dict[str, bytes] | None = None) -> bytes:
    archive = zipfile.ZipFile(io.BytesIO(content_of("sog")))
    kept = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(kept["meta.json"])
    change(meta)
    return binary.stored_zip({**kept, "meta.json": json.dumps(meta).encode(), **(files or {})})


def altered_glb(change: Callable[[dict[str, Any]], Any]) -> bytes:
    content = content_of("glb")
    size = int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : 20 + size])
    change(document)
    return gltf.glb(document, content[28 + size :])


@contextlib.contextmanager
def within(most: int) -> Iterator[None]:
    """Fails if the block takes more memory than this (Python's and numpy's)."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < most
    finally:
        tracemalloc.stop()


def test_bombs_are_refused_before_they_are_unpacked() -> None:
    head = struct.pack(spz.HEADER, spz.MAGIC, 3, 10, 0, 12, 0, 0)
    bomb = gzip.compress(head + bytes(12 << 20))
    with within(4 << 20):
        refused("goes on", read, bomb, "spz")
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (12 << 20))
    with within(8 << 20):
        refused("too large", read, target.getvalue(), "sog")
    picture = io.BytesIO()
    sog.Image.new("RGBA", (1024, 1024)).save(picture, "WEBP", lossless=True)
    bad = altered_sog(lambda meta: None, {"sh0.webp": picture.getvalue()})
    with within(4 << 20):
        refused("impossible size", read, bad, "sog")


@pytest.mark.parametrize("name", ["spz", "sog"])
def test_more_gaussians_than_a_file_can_hold_are_refused_before_anything_is_inflated(name: str) -> None:
    raw = struct.pack(spz.HEADER, spz.MAGIC, 3, 200_000, 0, 12, 0, 0) + bytes(19 * 200_000)
    bad = gzip.compress(raw) if name == "spz" else altered_sog(lambda meta: meta.update(count=20_000_000))
    with within(3 << 20):
        refused("than a file of this size", read, bad, name)


# -- headers of SOG and glTF -----------------------------------------------------------------------


def primitive(document: dict[str, Any]) -> dict[str, Any]:
    return document["meshes"][0]["primitives"][0]


def without(document: dict[str, Any], name: str) -> None:
    del primitive(document)["attributes"][f"KHR_gaussian_splatting:{name}"]


def rotation(document: dict[str, Any], **values: Any) -> None:
    document["accessors"][primitive(document)["attributes"]["KHR_gaussian_splatting:ROTATION"]].update(values)


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("sog", lambda meta: meta.update(count=70_000), "impossible size"),
        ("sog", lambda meta: meta.update(count=0), "count"),
        ("sog", lambda meta: meta.update(version=1), "version"),
        ("sog", lambda meta: meta["means"].update(mins=[0, 0]), "mins"),
        ("sog", lambda meta: meta["means"].update(maxs=[0, 0, 1e9]), "bad.file"),
        ("sog", lambda meta: meta["scales"].update(codebook=[0.0] * 255), "codebook"),
        ("sog", lambda meta: meta["scales"].update(codebook=[1e9] * 256), "too far"),
        ("sog", lambda meta: meta["sh0"].update(files=["../../etc/passwd"]), "missing"),
        ("sog", lambda meta: meta["shN"].update(count=65536), "impossible size"),
        ("sog", lambda meta: meta["shN"].update(bands=3), "impossible size"),
        ("sog", lambda meta: meta["quats"].update(files=["sh0.webp"]), "names no component"),
        ("glb", lambda d: d.update(meshes=3), "not a list"),
        ("glb", lambda d: d["nodes"][0].update(mesh=7), "names nothing"),
        ("glb", lambda d: d["nodes"][0].update(mesh=-1), r"nodes\[0\].mesh"),
        ("glb", lambda d: d["nodes"][0].update(children=[0]), "no tree"),
        ("glb", lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 0]), "no quaternion"),
        ("glb", lambda d: d["nodes"][0].update(scale=[1, 2, 1]), "unevenly"),
        ("glb", lambda d: d["nodes"][0].update(scale=[-1, 1, 1]), "unevenly"),
        ("glb", lambda d: d["nodes"][0].update(translation=["a", 0, 0]), r"nodes\[0\].translation\[0\]"),
        ("glb", lambda d: d["nodes"][0].update(translation=[10**400, 0, 0]), "beyond what a number can be"),
        ("glb", lambda d: d["scenes"][0].update(nodes=[0] * 100), "no tree"),
        ("glb", lambda d: rotation(d, count=10**9), "not possible"),
        ("glb", lambda d: rotation(d, count=4), "beyond|differ"),
        ("glb", lambda d: rotation(d, count=2), "differ"),
        ("glb", lambda d: rotation(d, type="VEC3"), "wrong type"),
        ("glb", lambda d: rotation(d, componentType=5125), "componentType"),
        ("glb", lambda d: rotation(d, byteOffset=-4), "byteOffset"),
        ("glb", lambda d: rotation(d, byteOffset=10**9), "beyond"),
        ("glb", lambda d: d["bufferViews"][0].update(byteOffset=10**9), "beyond"),
        ("glb", lambda d: d["bufferViews"][0].update(byteStride=4), "beyond"),
        ("glb", lambda d: primitive(d).pop("extensions"), "no Gaussians"),
        ("glb", lambda d: without(d, "SH_DEGREE_0_COEF_0"), "degree out"),
        ("glb", lambda d: without(d, "SH_DEGREE_1_COEF_2"), "missing"),
        ("glb", lambda d: d.update(nodes=d["nodes"] * 400, scenes=[{"nodes": list(range(400))}]), "too often"),
    ],
)
def test_headers_that_cannot_be_are_refused(name: str, change: Callable[[dict[str, Any]], Any], said: str) -> None:
    refused(said, read, (altered_sog if name == "sog" else altered_glb)(change), name)


# --- frames of zstandard, in SPZ of version 4 -------------------------------------------------------


def with_first_plane(content: bytes, frame: bytes, raw: int | None = None) -> bytes:
    """An SPZ file of version 4 with another compressed first plane."""
    streams, toc = content[15], int.from_bytes(content[16:20], "little")
    table = [list(struct.unpack_from("<QQ", content, toc + 16 * n)) for n in range(streams)]
    begin = toc + 16 * streams
    rest = content[begin + table[0][0] :]
    table[0] = [len(frame), table[0][1] if raw is None else raw]
    return content[:toc] + b"".join(struct.pack("<QQ", *row) for row in table) + frame + rest


def broken_frames() -> dict[str, Callable[[Any, bytes], bytes]]:
    """What happens to the frame of a plane: name -> from the package and the plane's bytes to a frame."""
    frame = lambda package, plane: package.ZstdCompressor(write_content_size=True).compress(plane)

    def flipped(package: Any, plane: bytes) -> bytes:
        made = bytearray(package.ZstdCompressor(write_checksum=True).compress(plane))
        made[-6] ^= 0x55
        return bytes(made)

    return {
        "truncated": lambda package, plane: frame(package, plane)[:-9],
        "flipped": flipped,
        "another size": lambda package, plane: frame(package, plane[:-9]),
        "bomb": lambda package, plane: frame(package, bytes(1 << 30)),
        "no frame": lambda package, plane: plane[:64],
        "empty": lambda package, plane: b"",
        "dictionary": lambda package, plane: b"\x28\xb5\x2f\xfd\x23\xff\xff\xff\x7f" + frame(package, plane)[5:],
    }


@pytest.mark.parametrize("kind", broken_frames())
def test_broken_frames_of_zstandard_are_refused_in_words_and_little_memory(kind: str) -> None:
    package = pytest.importorskip("zstandard", reason="zstandard is not installed")
    content = foreign_splats.spz(4)
    streams, toc = content[15], int.from_bytes(content[16:20], "little")
    size = struct.unpack_from("<Q", content, toc)[0]
    begin = toc + 16 * streams
    plane = package.ZstdDecompressor().decompress(content[begin : begin + size])
    whole = package.ZstdCompressor().compress(plane)
    assert len(spz.from_bytes(with_first_plane(content, whole), "x").cloud.means) == 3
    bad = with_first_plane(content, broken_frames()[kind](package, plane))
    with within(32 << 20):
        refused("bad.file", read, bad, "spz")
