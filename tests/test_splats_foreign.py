"""Files of Gaussians as other programs write them (``foreign_splats.py``): their meaning is kept, said or refused."""

from __future__ import annotations

import gzip
import importlib.util
import io
import json
import math
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy_splats
from foreign_splats import C1, F_REST, ROWS, compressed_ply, glb, ply, rows, sog, splat, spz
from refusals import refused
from scipy.spatial.transform import Rotation

from mudg import app
from mudg.editing.apply import read_asset
from mudg.formats.splats import formats
from mudg.formats.splats.cloud import SplatCloud
from mudg.gaussians.rendering import raster_of
from mudg.gaussians.storage import load_model

UNIT = {"F": (1, 0, 0), "B": (-1, 0, 0), "L": (0, 1, 0), "R": (0, -1, 0), "U": (0, 0, 1), "D": (0, 0, -1)}
"""The world: x forward, y left, z up."""
PLACES = np.array([[row[name] for name in "xyz"] for row in ROWS])
FACES = ("element face 2\nproperty list uchar int vertex_indices", b"\3" + bytes(12) + b"\4" + bytes(16))
zstandard = pytest.mark.skipif(importlib.util.find_spec("zstandard") is None, reason="needs zstandard")


def world(places: np.ndarray, axes: str) -> np.ndarray:
    """Places [n, 3] of a file whose x, y and z point along three letters."""
    return sum(places[:, [n]] * np.array(UNIT[letter]) for n, letter in enumerate(axes))


def covariance(row: dict[str, float]) -> np.ndarray:
    """Of a row of `ROWS`, in the file's axes."""
    turn = Rotation.from_quat([row[f"rot_{n}"] for n in range(4)], scalar_first=True).as_matrix()
    return turn @ np.diag([math.exp(2 * row[f"scale_{n}"]) for n in range(3)]) @ turn.T


def shape(cloud: SplatCloud, index: int) -> np.ndarray:
    """Covariance of a Gaussian that was read."""
    row = {f"rot_{n}": float(cloud.quats[index, n]) for n in range(4)}
    return covariance(row | {f"scale_{n}": float(cloud.log_scales[index, n]) for n in range(3)})


def colors(dc: np.ndarray, first: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Colours [d, 3] less the constant, of harmonics dc [3] and first [3, 3] (rows: -y, z, -x) in directions [d, 3]."""
    x, y, z = directions.T
    return 0.28209479 * dc + C1 * np.stack([-y, z, -x], 1) @ first


def read(content: bytes, name: str = "a.ply", axes: str = "file") -> SplatCloud:
    return formats.read_cloud(content, name, axes)[0]


def command(tmp_path: Path, content: bytes, suffix: str, *flags: str) -> int:
    (tmp_path / f"in{suffix}").write_bytes(content)
    out = str(tmp_path / "out")
    options = ["--kind", "scene", "--out", out, "--overwrite", "--quiet", *flags]
    return app.main(["asset", "import", str(tmp_path / f"in{suffix}"), *options])


# -- drawing ---------------------------------------------------------------------------------------

MIP = "comment SplatRenderMode: mip"
DRAWING = {"extras": {"drawing": {"antialias": True}}}
MARKED: dict[str, tuple[bytes, str, bool]] = {
    "ply Brush": (ply(head=["comment Exported from Brush", MIP]), ".ply", True),
    "ply gsplat, default": (ply(head=["comment SplatRenderMode: default"]), ".ply", False),
    "ply, the last one counts": (ply(head=[MIP, "comment splatrendermode: DEFAULT"]), ".ply", False),
    "ply, small letters": (ply(head=["comment splatrendermode: Mip"]), ".ply", True),
    "ply Postshot 1": (ply(head=["comment antialiased 1"]), ".ply", True),
    "ply Postshot 0": (ply(head=["comment antialiased 0"]), ".ply", False),
    "ply flags": (ply(head=["comment train_flags antialiasing"]), ".ply", True),
    "ply nerfstudio": (ply(head=["comment rasterize_mode: antialiased"]), ".ply", True),
    "ply obj_info": (ply(head=["obj_info anti_aliased: true"]), ".ply", True),
    "ply negated": (ply(head=["comment not antialiased"]), ".ply", False),
    "ply disabled": (ply(head=["comment antialiasing: disabled"]), ".ply", False),
    "sog number": (sog(antialias=1), ".sog", True),
    "ply silent": (ply(head=["comment made elsewhere"]), ".ply", False),
    "compressed ply": (compressed_ply(-1, 1, head=[MIP]), ".ply", True),
    "compressed ply silent": (compressed_ply(-1, 1), ".ply", False),
    **{f"spz {v} {flags}": (spz(v, flags), ".spz", bool(flags)) for v in (1, 2, 3, 4) for flags in (0, 1)},
    "sog antialias": (sog(antialias=True), ".sog", True),
    "sog no antialias": (sog(antialias=False), ".sog", False),
    "sog model": (sog(model="antialiased"), ".sog", True),
    "sog model default": (sog(model="default", antialias=True), ".sog", False),
    "sog 2dgs": (sog(model="2dgs"), ".sog", False),
    "glb facts": (glb(document={"asset": {"version": "2.0", **DRAWING}}), ".glb", True),
    "glb silent": (glb(), ".glb", False),
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=zstandard if n.startswith("spz 4") else ()) for n in MARKED])
def test_marks_of_antialiasing_are_read(name: str) -> None:
    content, suffix, wanted = MARKED[name]
    assert read(content, "a" + suffix).antialias is wanted


@pytest.mark.parametrize("name", ["ply Brush", "spz 3 1", "sog model", "glb facts", "ply silent"])
def test_an_imported_scene_is_drawn_as_its_file_says(name: str, tmp_path: Path) -> None:
    content, suffix, wanted = MARKED[name]
    assert command(tmp_path, content, suffix) == 0
    model = load_model(tmp_path / "out")
    assert raster_of(model).antialias is wanted
    assert model.facts.get("drawing") == ({"antialias": True} if wanted else None)


def test_what_is_drawn_antialiased_is_exported_with_the_marks_of_each_format() -> None:
    cloud, facts = toy_splats.cloud(5), {"drawing": {"antialias": True}}
    request = formats.WriteRequest(toy_splats.still(cloud, **facts), 0.0)
    names = ("ply", "compressed-ply", "spz", "sog", "glb")
    written = {name: toy_splats.written(name, cloud, **facts) for name in names}
    for name in ("ply", "compressed-ply"):
        assert b"\ncomment SplatRenderMode: mip\n" in written[name].partition(b"end_header")[0]
    assert gzip.decompress(written["spz"])[14] == 1
    meta = json.loads(zipfile.ZipFile(io.BytesIO(written["sog"])).read("meta.json"))
    assert meta["antialias"] is True and meta["model"] == "antialiased"
    assert all(read(content, f"a.{name}").antialias for name, content in written.items())
    assert not any(formats.losses(name, request) for name in written)
    assert formats.losses("splat", request)[-1].endswith("draws Gaussians (antialias True)")


@pytest.mark.parametrize("name", ["ply", "compressed-ply"])
@pytest.mark.parametrize("choice", ["viewer", "world"])
def test_a_ply_with_the_axes_of_this_program_says_so(name: str, choice: str) -> None:
    cloud = toy_splats.cloud(5, 1)
    content = toy_splats.written(name, cloud, formats.file_from_world(name, choice))
    assert (b"\ncomment Vertical Axis: z\n" in content) is (choice == "world")
    nearest = np.abs(read(content).means[:, None] - cloud.means[None]).max(2).min(0)
    assert nearest.max() < 0.05


def test_an_object_of_antialiased_gaussians_says_that_it_is_drawn_otherwise(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.ply").write_bytes(MARKED["ply Brush"][0])
    assert app.main(["asset", "import", str(tmp_path / "a.ply"), "--out", str(tmp_path / "a.safetensors")]) == 0
    assert "antialiased" in capsys.readouterr().err


# -- sizes and opacities ---------------------------------------------------------------------------


@pytest.mark.parametrize("column", ["filter_3D", "filter_3d"])
@pytest.mark.parametrize("kind", ["float", "double"])
def test_the_filter_of_mip_splatting_goes_into_sizes_and_opacities(column: str, kind: str) -> None:
    filters = [0.2, 0.0, 3.0]
    cloud = read(ply(rows(**{column: filters}), kinds={column: kind}))
    for n, (row, filter_m) in enumerate(zip(ROWS, filters, strict=True)):
        sizes = [math.exp(row[f"scale_{c}"]) for c in range(3)]
        grown = [math.hypot(size, filter_m) for size in sizes]
        assert np.allclose(np.exp(cloud.log_scales[n]), grown, rtol=1e-5)
        opacity = 1 / (1 + math.exp(-row["opacity"])) * math.prod(sizes) / math.prod(grown)
        assert cloud.opacity[n] == pytest.approx(opacity, abs=1e-5)


def test_flat_gaussians_rotations_of_any_length_and_classes_of_others() -> None:
    cloud = read(ply(rows(scale_2=None)), axes="world")
    assert np.allclose(cloud.log_scales[:, :2], [[row["scale_0"], row["scale_1"]] for row in ROWS])
    assert (np.exp(cloud.log_scales[:, 2]) <= 1e-6).all()
    normal = shape(cloud, 1) @ [1, 0, 0]  # the second is turned so that z becomes x
    assert np.abs(normal).max() < 1e-11
    long = {f"rot_{n}": [7.5 * row[f"rot_{n}"] for row in ROWS] for n in range(4)}
    assert np.allclose(read(ply(rows(**long))).quats, read(ply()).quats, atol=1e-6)
    assert read(ply(rows(**{"class": [2, 5, 6]}), kinds={"class": "uchar"})).class_ids is None
    ids = read(ply(rows(**{"class": [2.0, 255.0, 6.0]}))).class_ids
    assert ids is not None and ids.tolist() == [2, 255, 6]


# -- other elements and columns --------------------------------------------------------------------


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    "around",
    [
        {"after": ("element face 0\nproperty list uchar int vertex_indices", b"")},
        {"after": FACES},
        {"after": ("element edge 1\nproperty int a\nproperty list int float b", b"cut")},
        {"before": ("element camera 1\nproperty float focal\nproperty uchar k", b"abcde")},
        {"before": ("element empty 5", b"")},
        {"before": ("element face 0\nproperty list uchar uint vertex_index", b""), "after": FACES},
    ],
)
def test_other_elements_of_a_ply_are_passed_over(around: dict[str, Any], order: str) -> None:
    assert np.array_equal(read(ply(order=order, **around), axes="world").means, PLACES)


def test_fields_of_others_are_passed_over_and_listed_once(capsys: pytest.CaptureFixture[str]) -> None:
    cloud = read(sog(extras={"a": 1}, lod=3, **{"means.order": "morton", "sh0.gamma": 2}), "a.sog")
    said = capsys.readouterr().err.replace("\n", " ")
    assert "'extras', 'lod', 'means.order', 'sh0.gamma' in meta.json" in said and "warning" not in said
    assert np.allclose(sorted(np.abs(cloud.means).max(1)), [0, math.e - 1])
    assert read(compressed_ply(-1, 1, more="state"), "a.ply").opacity[0] == pytest.approx(200 / 255, abs=1e-6)
    read(
        glb(kind={"lod": 2, "extras": {}}, document={"extensionsUsed": ["KHR_gaussian_splatting", "EXT_other"]}),
        "a.glb",
    )
    assert "'EXT_other', 'KHR_gaussian_splatting.lod' in the document" in capsys.readouterr().err.replace("\n", " ")


OFFICIAL = {
    "a.ply": ply(rows(nx=0.0, ny=0.0, nz=0.0, red=1.0)),
    "zero.ply": ply(rows(opacity=0.0, scale_0=0.0, scale_1=0.0)),
    "flat.ply": ply(rows(scale_2=None)),
    "packed.ply": compressed_ply(-9, 9),
    "a.spz": spz(),
    "a.splat": splat(),
    "a.sog": sog(asset={"generator": "x"}, model="default", antialias=False),
    "a.glb": glb(node={"name": "n", "extras": {"a": 1}}, document={"extras": {}, "materials": [], "cameras": []}),
}


@pytest.mark.parametrize("name", OFFICIAL)
def test_official_fields_and_usual_values_are_not_worth_a_word(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    read(OFFICIAL[name], name)
    said = capsys.readouterr().err
    assert "passed over" not in said and "warning" not in said


ODD = "\x1b]0;t\x07" + "n" * 5000
MANY = {f"field{number}": 1.0 for number in range(100)}
FOO = ("element foo 1\nproperty float x", b"\0" * 4)


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("a.ply", ply(rows(foo=1.0)), "passed over: 'foo' in element vertex, which"),
        ("a.ply", ply(after=FOO), "passed over: 'foo' in the header, which"),
        ("a.ply", ply(before=FOO), "passed over: 'foo' in the header, which"),
        ("a.ply", ply(rows(**MANY)), "'field7' and 92 more in element vertex, which"),
        ("a.ply", ply(rows(**{"a\x1b[31m": 0.0})), r"passed over: 'a\x1b[31m' in element vertex, which"),
        ("a.ply", compressed_ply(-1, 1, more="state"), "passed over: 'state' in element vertex, which"),
        ("a.sog", sog(**{ODD: 1}), r"passed over: '\x1b]0;t\x07nnnnnn"),
        ("a.sog", sog(**MANY), "'field7' and 92 more in meta.json, which"),
        ("a.glb", glb(node={"foo": 1}), "passed over: 'nodes.foo' in the document, which"),
        ("a.glb", glb(document={ODD: 1, "foo": 2}), r"passed over: '\x1b]0;t\x07nnnnnn"),
    ],
)
def test_fields_of_others_are_named_shortly(
    name: str, content: bytes, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    read(content, name)
    said = [one for one in capsys.readouterr().err.splitlines() if "passed over" in one]
    assert [line in one and len(one) < 700 and one.isprintable() for one in said] == [True]


def test_harmonics_beyond_degree_3_are_lost() -> None:
    cloud = read(ply(FOURTH), axes="world")
    assert np.allclose(cloud.sh[0, 1:], [[float(k), 24.0 + k, 48.0 + k] for k in range(15)])


# -- what is said of a file, what is refused --------------------------------------------------------


def by(generator: str) -> dict[str, Any]:
    return {"asset": {"version": "2.0", "generator": generator}}


def axes_field(payload: bytes) -> list[tuple[int, bytes]]:
    """The extension of an SPZ file that states its axes."""
    return [(0xADBE0003, payload)]


UTM = np.array([500_123.0, 5_412_345.0, 210.0])
ECEF = np.array([4_157_222.0, 664_789.0, 4_774_952.0])
NEAR = np.array([[0.0, 0.0, 0.0], [0.0123, -0.0456, 0.0789], [3.0017, 1.0029, -2.0031]])


def far_ply(offset: np.ndarray, kind: str = "double") -> bytes:
    places = offset + NEAR
    return ply(rows(**{name: places[:, n].tolist() for n, name in enumerate("xyz")}), kinds=dict.fromkeys("xyz", kind))


NO_TURN = rows(**{f"rot_{n}": [1.0 - n, 0.0, 1.0] for n in range(4)})
FOURTH = rows(**{f"f_rest_{n}": float(n) for n in range(72)})
LINEAR = {"opacity": [0.9, 0.2, 0.7], "scale_0": [0.1, 0.3, 0.2], "scale_1": [0.2, 0.1, 0.3]}
HIDDEN = {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}}
LINEAR["scale_2"] = [0.01, 0.05, 0.2]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.ply", ply(rows(opacity=[0.9, 0.2, 0.7])), "logits are due"),
        ("a.ply", ply(rows(opacity=1.0)), "logits are due"),
        ("a.ply", ply(rows(**{name: value for name, value in LINEAR.items() if name != "opacity"})), "logarithms are"),
        ("a.ply", ply(rows(opacity=[255.0, 40.0, 128.0])), "from 0 to 255"),
        ("a.ply", ply(rows(f_dc_0=200.0, f_dc_1=120.0, f_dc_2=90.0)), "from 0 to 255"),
        ("a.ply", ply(rows(trbf_center=0.5, motion_0=0.1)), "motion over time are not read: 'trbf_center', 'motion_0'"),
        ("a.ply", ply(after=("element color_space 1\nproperty uchar color_space", b"\1")), "'color_space' is not read"),
        ("a.ply", ply(FOURTH), "beyond degree 3"),
        ("a.ply", ply(head=["comment offset 500000 5400000 200"]), "offset 500000 5400000 200"),
        ("a.ply", far_ply(UTM, "float"), "steps of 500 mm"),
        ("a.ply", compressed_ply(600_000, 600_010), "steps of 62.5 mm"),
        ("a.splat", splat(rows(x=40_000.0)), "steps of 3.91 mm"),
        ("a.sog", sog(lossy="c"), "with loss"),
        *(("a.sog", sog(model=model), "not known") for model in ("gabor", 7, {"name": "x"})),
        ("a.spz", spz(3, 2, [(0x4E490001, bytes(64))]), "0x4e490001 (64 bytes)"),
        ("a.spz", spz(3, 0x80, more=bytes(999)), "flags that are not known"),
        ("a.spz", spz(3, 0, degree=4), "degree 3"),
        ("a.spz", spz(3, 0, bits=8), "steps of 3.91 mm"),
        pytest.param("a.spz", spz(4), "--axes RDF", marks=zstandard),
        ("far.glb", glb(rows(x=300_000.0)), "steps of 31.2 mm"),
        ("a.glb", glb(kind={"colorSpace": None}), "names no colorSpace"),
        ("a.glb", glb(kind={"sortingMethod": "zDepth"}), "zDepth"),
        ("a.glb", glb(kind={"projection": "orthographic"}), "orthographic"),
        ("a.glb", glb(document={"animations": [{"channels": [], "samplers": []}]}), "animations"),
        ("a.glb", glb(node={"extensions": {"EXT_mesh_gpu_instancing": {}}}), "instances"),
        ("a.glb", glb(turn_length=3.0), "length 1"),
        ("a.glb", glb(more="SH_DEGREE_4_COEF_0"), "degree 3"),
        ("a.glb", glb(document={"nodes": [{"mesh": 0}, HIDDEN], "scenes": [{"nodes": [0, 1]}]}), "hides"),
    ],
)
def test_what_a_file_means_besides_is_said(
    name: str, content: bytes, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = read(content, name, "world" if name == "a.glb" else "file")
    assert said in capsys.readouterr().err.replace("\n", " ")
    assert len(cloud) in (2, 3) and cloud.degree <= 3
    if name in ("a.spz", "a.glb"):
        assert np.allclose(cloud.means, PLACES if name == "a.glb" else world(PLACES, "RUB"), atol=4e-3)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        *(("a.ply", ply(rows(filter_3D=[0.1, value, 0.1])), "filter_3D") for value in (math.nan, math.inf)),
        ("a.ply", ply(rows(**LINEAR)), r"plain values[\s\S]*log\(scale\)"),
        ("a.ply", ply(rows(**LINEAR | {"scale_2": None})), "plain values"),
        *(
            ("a.ply", ply(rows(**{column: 1}), kinds={column: "uchar"}), rf"whole numbers[\s\S]*{column}")
            for column in ("opacity", "scale_1", "f_dc_0", "rot_2")
        ),
        ("a.splat", splat(logs=True), r"negative[\s\S]*exp\(scale\)"),
        # damaged Gaussians are counted
        ("a.ply", ply(NO_TURN), r"no quaternion[\s\S]*Gaussian 1[\s\S]*1 of 3[\s\S]*take them out"),
        ("a.ply", ply(rows(scale_1=[0.0, 0.0, math.nan])), r"Gaussian 2[\s\S]*1 of 3[\s\S]*take them out"),
        ("a.ply", ply(rows(x=[math.inf, 0.0, 0.0])), r"Gaussian 0[\s\S]*take them out"),
        # lists
        ("a.ply", ply(before=("element face 1\nproperty list uchar int vertices", b"\0")), "write vertices first"),
        ("a.ply", ply(before=("element vertex 1\nproperty list uchar float features", b"\0")), "lists"),
        ("a.ply", ply(before=("element face 1\nproperty list uchar number a", b"")), "not understood"),
        # columns of other names
        *(
            ("a.ply", ply(rows(**changes)), rf"missing[\s\S]*'{next(iter(changes))}'[\s\S]*name the columns")
            for changes in (
                {"f_dc_0": None, "red": 1.0},
                {"rot_0": None, "quat_w": 1.0},
                {"scale_1": None, "scale_2": None},
                {"opacity": None, "alpha": 1.0},
            )
        ),
        ("a.ply", ply([{"x": 0.0, "y": 0.0, "z": 0.0, "red": 1.0}]), "points or meshes"),
        # extensions of SPZ
        *(("a.spz", spz(3, 2, axes_field(p)), "0xadbe0003") for p in (struct.pack("<I", 17), b"\6", bytes(8))),
        ("a.spz", spz(3, 2, more=struct.pack("<II", 0xADBE0003, 400)), "a.spz"),
        # glTF
        ("a.glb", glb(plain=False), r"opacity[\s\S]*between 0 and 1[\s\S]*logits"),
        ("a.glb", glb(rows(opacity=0.5), plain=False), r"size[\s\S]*negative[\s\S]*exp\(scale\)"),
        ("a.glb", glb(rows(opacity=-9.0), plain=False, document=by("splat-transform 3.7.0")), "logits"),
        ("a.glb", glb(kind={"colorSpace": "ACEScg"}), r"colorSpace[\s\S]*srgb_rec709_display[\s\S]*ACEScg"),
        ("a.glb", glb(kind={"kernel": "gabor"}), r"kernel[\s\S]*ellipse"),
        ("a.glb", glb(kind={"extensions": {"KHR_gaussian_splatting_compression_spz_2": {}}}), "compressed"),
        ("a.glb", glb(document={"extensionsRequired": ["KHR_draco_mesh_compression"]}), "KHR_draco"),
        ("a.glb", glb(document={"extensionsRequired": "all"}), "not a list"),
        ("a.glb", glb(view={"extensions": {"EXT_meshopt_compression": {}}}), "EXT_meshopt_compression"),
        ("a.glb", glb(view={"buffer": 1}), r"bufferViews\[0\].buffer"),
        ("a.glb", glb(document={"buffers": [{"byteLength": 9, "uri": "a.bin"}]}), "outside the file"),
        # other files
        ("a.ksplat", b"\0\1" * 99, r"what to do: [\s\S]*splat-transform"),
        ("a.gltf", b'{"asset": {}}', r"what to do: [\s\S]*glb"),
        ("meta.json", b'{"version": 2}', r"what to do: [\s\S]*\.sog"),
        ("a.usdz", b"PK\3\4" + bytes(99), r"what to do: [\s\S]*ply, spz or glb"),
        ("a.usda", b"#usda 1.0", r"what to do: [\s\S]*ply, spz or glb"),
        ("a.ckpt", b"\x80\2" * 9, r"what to do: [\s\S]*PLY"),
        ("a.obj", b"hello", r"\.glb, \.ply, \.sog, \.splat, \.spz"),
    ],
)
def test_what_cannot_be_read_is_refused_in_words(name: str, content: bytes, said: str) -> None:
    refused(said, read, content, name)


# -- axes ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("comment", "axes"),
    [
        ("comment Vertical Axis: z", "FLU"),
        ("comment Vertical axis: Z", "FLU"),
        ("comment up_axis = +z", "FLU"),
        ("comment Z-up", "FLU"),
        ("comment Vertical Axis: -y", "RDF"),
        ("comment y-up", "RUB"),
        ("comment Vertical Axis: x", "UFL"),
        ("comment coordinate_system: RUB", "RUB"),
        ("obj_info Vertical Axis: z", "FLU"),
        ("comment size up to z9", "RDF"),
        ("comment Vertical Axis: y", "RDF"),
        ("comment made elsewhere", "RDF"),
    ],
)
def test_axes_of_a_ply_are_those_that_its_comments_state(comment: str, axes: str) -> None:
    cloud = read(ply(head=["comment Generated by Nerfstudio 1.1.5", comment]))
    assert np.allclose(cloud.means, world(PLACES, axes))


def test_a_vertical_axis_y_that_may_mean_down_is_said_unless_brush_wrote_it(capsys: pytest.CaptureFixture[str]) -> None:
    read(ply(head=["comment Vertical Axis: y"]))
    assert "--axes RUB" in capsys.readouterr().err
    read(ply(head=["comment Exported from Brush", "comment Vertical axis: y"]))
    assert "--axes" not in capsys.readouterr().err


SPZ_AXES = "RUB LDB RDB LUB RUB LDF RDF LUF RUF LFD RFD LFU RFU LBD RBD LBU RBU".split()
"""By the number in the extension; 0 is unspecified."""


@pytest.mark.parametrize("version", [1, 2, 3, pytest.param(4, marks=zstandard)])
@pytest.mark.parametrize("code", range(17))
def test_axes_of_spz_are_those_of_its_extension(code: int, version: int) -> None:
    axes = SPZ_AXES[code]
    cloud = read(spz(version, 2, [(0xADBE0002, bytes(12)), *axes_field(struct.pack("<I", code))]), "a.spz")
    assert np.allclose(cloud.means, world(PLACES, axes), atol=2e-3 if version == 1 else 2e-4)
    turn = np.array([UNIT[letter] for letter in axes]).T
    ways = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8], [-0.48, 0.6, 0.64]])
    for n, row in enumerate(ROWS):
        largest = max(math.exp(2 * row[f"scale_{c}"]) for c in range(3))
        assert np.allclose(shape(cloud, n), turn @ covariance(row) @ turn.T, atol=0.1 * largest)
        dc, first = np.array([row[f"f_dc_{c}"] for c in range(3)]), np.array(F_REST).reshape(3, 3).T
        assert np.allclose(colors(cloud.sh[n, 0], cloud.sh[n, 1:4], ways), colors(dc, first, ways @ turn), atol=0.02)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_values_of_spz_of_every_version(version: int) -> None:
    cloud = read(spz(version), "a.spz", "world")
    assert np.allclose(cloud.means, PLACES, atol=2e-3)
    for n, row in enumerate(ROWS):
        assert abs(cloud.quats[n] @ [row[f"rot_{c}"] for c in range(4)]) > 0.99995
        assert np.allclose(cloud.log_scales[n], [row[f"scale_{c}"] for c in range(3)], atol=1 / 32)
        assert cloud.opacity[n] == pytest.approx(1 / (1 + math.exp(-row["opacity"])), abs=1 / 255)
        assert np.allclose(cloud.sh[n, 1:].T.ravel(), F_REST, atol=0.01)


@pytest.mark.parametrize(
    ("content", "suffix", "flag", "axes", "warned"),
    [
        (ply(head=["comment Vertical Axis: z"]), ".ply", "viewer", "RDF", True),
        (ply(head=["comment Vertical Axis: z"]), ".ply", "world", "FLU", False),
        (ply(head=["comment Vertical Axis: z"]), ".ply", "file", "FLU", False),
        (ply(head=["comment Vertical Axis: z"]), ".ply", "RUB", "RUB", True),
        (ply(), ".ply", "RUF", "RUF", False),
        (spz(3, 2, axes_field(struct.pack("<I", 6))), ".spz", "viewer", "RUB", True),
        (spz(), ".spz", "RDF", "RDF", False),
        (glb(), ".glb", "LUF", "LUF", False),
    ],
)
def test_axes_that_are_set_win_and_a_contradiction_is_said(
    content: bytes, suffix: str, flag: str, axes: str, warned: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(tmp_path, content, suffix, "--axes", flag) == 0
    assert np.allclose(load_model(tmp_path / "out").table["means"].detach().numpy(), world(PLACES, axes), atol=3e-4)
    assert (f"--axes {flag}" in capsys.readouterr().err.replace("\n", " ")) is warned


@pytest.mark.parametrize("flag", ["RRU", "XYZ", "rdf", "RDFB", "LRU", ""])
def test_letters_that_are_no_axes_are_refused(flag: str, tmp_path: Path) -> None:
    assert command(tmp_path, ply(), ".ply", "--axes", flag) == 2


# -- glTF ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("space", ["srgb_rec709_display", "BT.709-sRGB", None, "lin_rec709_display", "BT.709-linear"])
def test_colour_spaces_of_the_standard_and_of_its_drafts(space: str | None) -> None:
    linear = "lin" in (space or "")
    table = rows(f_dc_0=[-1.0, 0.0, 1.0], f_dc_1=[-0.5, 0.5, 1.5], f_dc_2=[0.25, -0.25, 0.75])
    cloud = read(glb(table, kind={"colorSpace": space}), "a.glb")
    for n, row in enumerate(table):
        for c in range(3):
            color = 0.5 + 0.28209479177387814 * row[f"f_dc_{c}"]
            shown = (1.055 * color ** (1 / 2.4) - 0.055 if color > 0.0031308 else 12.92 * color) if linear else color
            assert 0.5 + 0.28209479177387814 * float(cloud.sh[n, 0, c]) == pytest.approx(shown, abs=1e-5)


# -- far away --------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [UTM, ECEF], ids=["UTM", "ECEF"])
@pytest.mark.parametrize("given", [True, False])
def test_an_offset_is_taken_away_before_places_are_rounded(
    offset: np.ndarray, given: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--origin-m", *(f"{value}" for value in offset)] if given else []
    assert command(tmp_path, far_ply(offset), ".ply", "--axes", "world", *flags) == 0
    means = load_model(tmp_path / "out").table["means"].detach().numpy().astype(np.float64)
    assert np.abs((means - means[0]) - NEAR).max() < 1e-5
    if given:
        assert np.abs(means - NEAR).max() < 1e-5
    else:
        assert np.abs(means).max() < 10 and "becomes the origin" in capsys.readouterr().err.replace("\n", " ")
        summary = (tmp_path / "out" / "run.json").read_text()
        assert f"{offset[0]:.1f}"[:6] in summary


def test_an_offset_that_stays_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command(tmp_path, far_ply(UTM), ".ply", "--axes", "world", "--origin-m", "0", "0", "0") == 0
    assert "rounded to 500 mm" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.parametrize(
    ("node", "scale"),
    [
        ({"translation": UTM.tolist()}, 1),
        ({"matrix": [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, *UTM.tolist(), 1]}, 2),
        ({"translation": UTM.tolist(), "scale": [0.5] * 3}, 0.5),
    ],
)
def test_translations_of_nodes_are_added_in_double(
    node: dict[str, Any], scale: float, capsys: pytest.CaptureFixture[str]
) -> None:
    means = read(glb(node=node), "a.glb", "world").means
    assert np.abs(means - UTM - scale * PLACES).max() < 1e-6
    assert "steps" not in capsys.readouterr().err


def test_bounds_of_chunks_in_double_keep_their_places() -> None:
    means = read(compressed_ply(5_412_345.678, 5_412_346.678, "double"), "a.ply", "world").means
    assert np.abs(means[:, 0] - [5_412_345.678, 5_412_346.678]).max() < 1e-6


def test_a_far_object_keeps_its_shape(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(far_ply(UTM))
    flags = ["--axes", "world", "--out", str(tmp_path / "a.safetensors")]
    assert app.main(["asset", "import", str(tmp_path / "a.ply"), *flags]) == 0
    means = read_asset(tmp_path / "a.safetensors").columns["means"].numpy()
    assert np.abs((means - means[0]) - NEAR).max() < 1e-6


def test_gaussians_far_out_in_a_scene_that_is_near_move_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A sky of Gaussians, 100 km away."""
    table = [row for _ in range(20) for row in ROWS] + rows(x=1e5)[:1]
    assert command(tmp_path, ply(table), ".ply", "--axes", "world") == 0
    means = load_model(tmp_path / "out").table["means"].detach().numpy()
    assert np.array_equal(means[:3], PLACES.astype(np.float32)) and "warning" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("generator", "plain", "axes"),
    [
        ("splat-transform 1.10.1", False, "RDF"),
        ("splat-transform 2.3.1", False, "FUR"),
        ("splat-transform 2.7.1", True, "FUR"),
        ("splat-transform 3.7.0", True, "FUR"),
        ("another 1.0", True, "FUR"),
    ],
)
def test_a_program_that_disagrees_with_gltf_is_named_and_read_as_it_writes(
    generator: str, plain: bool, axes: str, capsys: pytest.CaptureFixture[str]
) -> None:
    content = glb(plain=plain, document=by(generator))
    cloud = read(content, "a.glb")
    assert np.allclose(cloud.means, world(PLACES, axes))
    assert np.allclose(cloud.log_scales, [[row[f"scale_{c}"] for c in range(3)] for row in ROWS], atol=1e-5)
    assert np.allclose(cloud.logits, [row["opacity"] for row in ROWS], atol=1e-5)
    assert (generator in capsys.readouterr().err) is not plain
    assert np.allclose(read(content, "a.glb", "viewer").means, world(PLACES, "FUR"))  # what is asked for wins
