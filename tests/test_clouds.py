"""Point cloud files: what was written is read back, and what lies is refused before anything is allocated."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from bad_logs import refused
from hypothesis import given
from hypothesis import strategies as st

from mudg.base.errors import InputError
from mudg.formats.importers import clouds

XYZ = np.array([[1.5, -2, 3], [4, 5.25, -6], [0, 0, 0.5]], np.float32)
LEVEL = np.array([0, 128, 255], np.uint16)


def pcd_header(kind: str, points: int, fields: str = "x y z _ level", counts: str = "1 1 1 6 1") -> bytes:
    sizes = " ".join({"level": "2", "_": "1"}.get(f, "4") for f in fields.split())
    types = " ".join({"level": "U", "_": "U"}.get(f, "F") for f in fields.split())
    return (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n"
        f"COUNT {counts}\nWIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {kind}\n"
    ).encode()


def lzf_literals(data: bytes) -> bytes:
    """LZF that never refers back."""
    pieces = [data[n : n + 32] for n in range(0, len(data), 32)]
    return b"".join(bytes([len(piece) - 1]) + piece for piece in pieces)


def pcd(kind: str) -> bytes:
    if kind == "ascii":
        points = zip(XYZ.tolist(), LEVEL.tolist(), strict=True)
        rows = "".join(f"{x} {y} {z} 0 0 0 0 0 0 {v}\n" for (x, y, z), v in points)
        return pcd_header(kind, 3) + rows.encode()
    rows = [p.tobytes() + bytes(6) + v.tobytes() for p, v in zip(XYZ, LEVEL, strict=True)]
    if kind == "binary":
        return pcd_header(kind, 3) + b"".join(rows)
    flat = XYZ.T.tobytes() + bytes(18) + LEVEL.tobytes()
    packed = lzf_literals(flat)
    return pcd_header(kind, 3) + np.array([len(packed), len(flat)], "<u4").tobytes() + packed


def ply(order: str) -> bytes:
    properties = "".join(f"property {kind}\n" for kind in ("float x", "float y", "float z", "ushort level"))
    header = f"ply\nformat {order} 1.0\ncomment made by hand\nelement vertex 3\n{properties}"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    if order == "ascii":
        rows = "".join(f"{x} {y} {z} {v}\n" for (x, y, z), v in zip(XYZ.tolist(), LEVEL.tolist(), strict=True))
        return (header + rows + "3 0 1 2\n").encode()
    mark = "<" if "little" in order else ">"
    layout = np.dtype([("xyz", f"{mark}f4", 3), ("level", f"{mark}u2")])
    rows = np.array([(tuple(p), v) for p, v in zip(XYZ, LEVEL, strict=True)], layout).tobytes()
    return header.encode() + rows + b"\3" + np.arange(3, dtype=f"{mark}i4").tobytes()


def npz(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


GOOD = {
    "a.pcd": pcd("ascii"),
    "b.pcd": pcd("binary"),
    "c.pcd": pcd("binary_compressed"),
    "a.ply": ply("ascii"),
    "b.ply": ply("binary_little_endian"),
    "c.ply": ply("binary_big_endian"),
    "a.npz": npz(xyz=XYZ, level=LEVEL),
}


@pytest.mark.parametrize("name", GOOD)
def test_every_form_gives_the_same_points(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(GOOD[name])
    cloud = clouds.read_cloud(tmp_path / name)
    assert (cloud.xyz == XYZ).all()
    assert (cloud.fields["level"] == LEVEL).all()
    assert set(cloud.fields) == {"level"}
    assert cloud.missing == 0


@pytest.mark.parametrize("name", GOOD)
def test_every_cut_is_refused_and_never_something_else(name: str) -> None:
    reader = clouds.READERS[Path(name).suffix]
    whole = GOOD[name]
    # what may be lost unseen: faces behind the points, and in text the digits of the very last number
    tail = {"b.ply": 13, "c.ply": 13, "a.ply": len(b"255\n3 0 1 2\n"), "a.pcd": len(b"255\n")}.get(name, 0)
    for length in range(0, len(whole) - tail, 3):
        with pytest.raises(InputError):
            reader(whole[:length], "x")


def test_kitti_rows(tmp_path: Path) -> None:
    rows = np.concatenate([XYZ, [[0.5], [0.25], [1]]], 1).astype("<f4")
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    cloud = clouds.read_cloud(tmp_path / "a.bin")
    assert (cloud.xyz == XYZ).all()
    assert cloud.fields["intensity"].tolist() == [0.5, 0.25, 1]
    (tmp_path / "a.bin").write_bytes(rows.tobytes()[:-2])
    refused("cut off", clouds.read_cloud, tmp_path / "a.bin")


def test_missing_returns_files_without_coordinates_and_other_kinds(tmp_path: Path) -> None:
    xyz = XYZ.copy()
    xyz[1] = np.nan
    (tmp_path / "a.npz").write_bytes(npz(xyz=xyz, level=LEVEL))
    cloud = clouds.read_cloud(tmp_path / "a.npz")
    assert cloud.missing == 1 and (cloud.xyz == XYZ[[0, 2]]).all() and cloud.fields["level"].tolist() == [0, 255]
    xyz[0, 2] = np.inf
    (tmp_path / "a.npz").write_bytes(npz(xyz=xyz))
    refused("not finite", clouds.read_cloud, tmp_path / "a.npz")
    (tmp_path / "a.pcd").write_bytes(pcd_header("ascii", 1, "a b", "1 1") + b"1 2\n")
    assert "a, b" in refused("no coordinates", clouds.read_cloud, tmp_path / "a.pcd").got
    (tmp_path / "a.las").write_bytes(b"LASF")
    refused("format is not known", clouds.read_cloud, tmp_path / "a.las")


ASCII = b"ply\nformat ascii 1.0\n"


def npy_lie() -> bytes:
    """An archive whose array says it has 10^12 rows."""
    honest = npz(xyz=np.zeros((1, 3)))
    with zipfile.ZipFile(io.BytesIO(honest)) as archive:
        member = archive.read("xyz.npy").replace(b"(1, 3), }" + b" " * 12, b"(1" + b"0" * 12 + b", 3), }")
    assert b"1000000000000" in member
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("xyz.npy", member)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("suffix", "content", "words"),
    [
        (".pcd", pcd_header("binary", 10**7), "cut off"),
        (".pcd", pcd_header("ascii", 10**7), "cut off"),
        (".pcd", pcd_header("binary", 10**30), "count makes no sense"),
        (".pcd", pcd_header("binary_compressed", 10**7) + struct.pack("<3I", 4, 26 * 10**7, 0), "contradicts"),
        (".pcd", pcd_header("binary", 3).replace(b"WIDTH 3", b"WIDTH 4") + bytes(99), "contradicts"),
        (".pcd", pcd_header("zipped", 3) + bytes(99), "no known kind"),
        (".pcd", pcd_header("binary", 3, "a b", "1 1").replace(b"TYPE F F", b"TYPE Q F") + bytes(99), "unknown type"),
        (".pcd", b"not a cloud at all", "not a PCD file"),
        (".ply", ASCII + b"element vertex 999999999\nproperty float x\nend_header\n1 2\n", "is not possible"),
        (".ply", ASCII + b"element vertex 9\nproperty list uchar int x\nend_header\n1 2\n", "write vertices first"),
        (".ply", ASCII + b"element face 9\nelement vertex 9\nend_header\n", "no vertices"),
        (".npz", npy_lie(), "cut off"),
        (".npz", npz(xyz=np.array([[1, 2, object()]], object)), "plain numbers"),
        (".npz", npz(points=XYZ), "no coordinates"),
        (".npz", npz(xyz=XYZ, level=LEVEL[:2]), "does not fit"),
    ],
)
def test_lies_are_refused(suffix: str, content: bytes, words: str) -> None:
    refused(words, clouds.READERS[suffix], content, "cloud")


def lzf_repeated(piece: bytes, times: int) -> bytes:
    """A piece as literals, and then as references back to it, which overlap; what is too short for one as literals."""
    packed, left = lzf_literals(piece), len(piece) * (times - 1)
    high, low = divmod(len(piece) - 1, 256)
    while left >= 3:
        length = min(left, 264)
        packed += bytes([(min(length - 2, 7) << 5) | high, *([length - 9] if length >= 9 else []), low])
        left -= length
    return packed + lzf_literals((piece * times)[len(piece) * times - left :])


@given(st.lists(st.tuples(st.binary(min_size=1, max_size=300), st.integers(1, 20)), max_size=8))
def test_lzf_unpacks_what_was_packed_overlaps_too(pieces: list[tuple[bytes, int]]) -> None:
    data = b"".join(piece * times for piece, times in pieces)
    packed = b"".join(lzf_repeated(piece, times) for piece, times in pieces)
    assert clouds.lzf_decompress(packed, len(data), "x") == data


@given(st.binary(max_size=60), st.integers(0, 300))
def test_lzf_noise_is_refused_or_has_the_length_asked_for(noise: bytes, length: int) -> None:
    try:
        assert len(clouds.lzf_decompress(noise, length, "x")) == length
    except InputError:
        pass


@pytest.mark.parametrize("key", ["FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "POINTS", "DATA"])
@pytest.mark.parametrize("value", ["", "\n 1", " -1", " x", " 1e9", " 999999999999999999999999", " \u0663", " 0"])
@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_every_header_field_of_a_pcd_may_be_wrong(key: str, value: str, kind: str) -> None:
    lines = pcd(kind).split(b"\n", 11)
    spoilt = [key.encode() + value.encode() if line.startswith(key.encode() + b" ") else line for line in lines]
    try:  # in words, or a cloud without a point or a field: nothing else may be raised
        columns = clouds.read_pcd(b"\n".join(spoilt), "a.pcd")
    except InputError:
        columns = {}
    assert all(len(values) in (0, 3) for values in columns.values())
