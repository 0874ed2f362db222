"""Files of Gaussians: golden bytes, an independent reader for each, round trips within one step of the format."""

from __future__ import annotations

import io
import json
import os
import re
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import foreign_splats
import numpy as np
import pytest
import splat_readers as slow
import torch
import toy_splats
from PIL import Image
from refusals import refused
from toy_splats import written

from mudg.base.errors import ResourceError
from mudg.base.geometry import matrix_from_quaternion
from mudg.core import harmonics
from mudg.core.raster.torch_twin import sh_basis
from mudg.formats.splats import binary, formats, gltf, ply, sog, spz, usd
from mudg.formats.splats.cloud import SplatCloud, joined

GOLDEN = Path(__file__).parent / "golden" / "splats.json"
READERS: dict[str, Callable[[bytes], list[slow.Splat]]] = {
    "ply": slow.read_ply,
    "compressed-ply": slow.read_compressed,
    "splat": slow.read_splat,
    "spz": slow.read_spz,
    "sog": slow.read_sog,
    "glb": lambda content: slow.read_glb_mesh(*slow.open_glb(content), 0),
    "usda": lambda content: slow.read_usd_splats(slow.parse_usda(content.decode())["World"]["scene"]["splats"]),
}
CASES = [(name, degree) for name in READERS for degree in (0, 1, 2, 3) if degree == 0 or name != "splat"]


def as_cloud(splats: list[slow.Splat]) -> SplatCloud:
    columns = zip(*((s.place, s.turn, np.log(s.size), s.opacity, s.sh) for s in splats), strict=True)
    return SplatCloud(*(np.asarray(values, np.float32) for values in columns))


def in_step(splats: SplatCloud, cloud: SplatCloud) -> np.ndarray:
    """For each Gaussian of ``splats`` the row of ``cloud`` nearest to it: some formats change the order."""
    found = ((splats.means[:, None] - cloud.means[None]) ** 2).sum(2).argmin(1)
    assert len(set(found.tolist())) == len(cloud)
    return found


def steps(name: str, cloud: SplatCloud) -> dict[str, np.ndarray | float]:
    """One step of each value in a format."""
    spread = lambda values: values.max(0) - values.min(0)
    exact, byte = 2e-6 * np.abs(cloud.means).max(), 1 / 255
    log_span = spread(np.sign(cloud.means) * np.log1p(np.abs(cloud.means)))
    grown = (1 + np.abs(cloud.means).max()) * log_span / 65535
    rough = 0.06 if len(cloud) > 256 else 1e-5  # tables are fine where many values are, and coarse at their ends
    packed = (spread(cloud.means) / np.array([2047, 1023, 2047]), spread(cloud.log_scales) / 1023)
    kinds: dict[str, tuple[np.ndarray | float, ...]] = {
        "spz": (2.0**-12, 1 / 16, byte, byte / 0.15, 1 / 8, 0.004),
        "splat": (exact, 1e-5, byte, byte / slow.C0, 0, 0.02),
        "compressed-ply": (*packed, byte, spread(cloud.sh[:, 0]) / 255 + 1e-5, 8 / 256, 0.004),
        "sog": (grown + exact, rough * 2, byte, rough, rough * 3, 0.02),
    }
    plain = (exact, 1e-5, 1e-5, 1e-5, 1e-5, 1e-5)
    return dict(zip(("means", "scales", "opacity", "dc", "rest", "turn"), kinds.get(name, plain), strict=True))


def assert_close(
    found: SplatCloud, cloud: SplatCloud, limits: dict[str, np.ndarray | float], activated: bool = False
) -> None:
    rows = cloud.take(in_step(found, cloud))
    assert (np.abs(found.means - rows.means) <= limits["means"]).all()
    assert (np.abs(found.log_scales - rows.log_scales) <= limits["scales"]).all()
    opacity = found.logits if activated else found.opacity
    assert (np.abs(opacity - rows.opacity) <= limits["opacity"]).all()
    assert (np.abs(found.sh[:, 0] - rows.sh[:, 0]) <= limits["dc"]).all()
    assert found.sh.shape == rows.sh.shape and (np.abs(found.sh[:, 1:] - rows.sh[:, 1:]) <= limits["rest"]).all()
    agreement = np.abs((found.quats / np.linalg.norm(found.quats, axis=1, keepdims=True) * rows.quats).sum(1))
    assert (1 - agreement <= np.asarray(limits["turn"]) ** 2 + 1e-6).all()


@pytest.mark.parametrize(("name", "degree"), CASES)
def test_an_independent_reader_finds_what_was_written(name: str, degree: int) -> None:
    cloud = toy_splats.cloud(5, degree)
    assert_close(as_cloud(READERS[name](written(name, cloud))), cloud, steps(name, cloud), activated=True)


@pytest.mark.parametrize(("name", "degree"), [case for case in CASES if case[0] != "usda"])
def test_what_is_read_back_differs_by_at_most_one_step(name: str, degree: int) -> None:
    cloud = toy_splats.cloud(700, degree, 4)
    content = written(name, cloud)
    assert formats.format_of(content, f"x.{name}") == name
    found, _ = formats.read_cloud(content, f"x.{name}", "world")
    limits = steps(name, cloud)
    if name == "compressed-ply":  # chunks of their own bounds: never coarser than those of all
        limits |= {"means": np.asarray(limits["means"]) + 1e-5}
    if name == "sog" and degree:  # the palette is as fine as there are Gaussians, its table is not
        limits |= {"rest": 0.1}
    assert_close(found, cloud, limits)
    assert written(name, cloud) == content


def rounded(content: bytes) -> str:
    """JSON text with 9 digits a number: the last ones depend on the processor."""
    return re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda found: f"{float(found[0]):.9g}", content.decode())


def test_golden_bytes_of_three_gaussians() -> None:
    cloud = toy_splats.cloud(3, 1, 11)
    made: dict[str, object] = {
        "ply": ply.to_bytes(cloud).hex(),
        "compressed-ply": ply.compressed_to_bytes(cloud).hex(),
        "splat": formats.splat_bytes(cloud.of_degree(0)).hex(),
        "spz": zlib.decompress(spz.to_bytes(cloud), 31).hex(),
        "glb": written("glb", cloud).hex(),
        "usda": written("usda", cloud).decode(),
    }
    archive = zipfile.ZipFile(io.BytesIO(sog.to_bytes(cloud)))
    names = [name for name in archive.namelist() if name.endswith("webp")]
    pictures = {name: np.asarray(Image.open(io.BytesIO(archive.read(name)))).tobytes().hex() for name in names}
    made["sog"] = {"meta.json": rounded(archive.read("meta.json")), **pictures}
    if os.environ.get("MUDG_UPDATE_FROZEN"):
        GOLDEN.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    assert made == json.loads(GOLDEN.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", [name for name, one in formats.FORMATS.items() if one.read])
@pytest.mark.parametrize("axes", ["viewer", "world"])
def test_axes_come_back_and_are_those_of_the_format(name: str, axes: formats.Axes) -> None:
    cloud = toy_splats.cloud(20, 0 if name == "splat" else 2, 8)
    found, _ = formats.read_cloud(written(name, cloud, formats.file_from_world(name, axes)), f"x.{name}", axes)
    assert np.abs(found.means - cloud.means[in_step(found, cloud)]).max() < 0.05
    up = formats.file_from_world(name, "viewer")[:3, :3] @ [0, 0, 1]
    assert up.tolist() == ([0, -1, 0] if formats.FORMATS[name].axes.startswith("RD") else [0, 1, 0])


def test_joined_clouds_keep_their_classes() -> None:
    both = joined([toy_splats.cloud(2, 1, classes=True), toy_splats.cloud(3, 2)])
    assert both.degree == 2 and both.class_ids is not None and both.class_ids[2:].tolist() == [255] * 3
    assert not both.sh[:2, 4:].any()


# -- particular formats ----------------------------------------------------------------------------


def test_the_ply_keeps_the_order_that_readers_by_position_expect() -> None:
    cloud = toy_splats.cloud(4, 3, classes=True)
    content = ply.to_bytes(cloud, classes=True)
    names = [line.split()[-1] for line in content.partition(b"end_header")[0].decode().splitlines()[3:]]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{i}" for i in range(45)]
    assert names[54:] == ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "class"]
    back = ply.from_bytes(content, "x").cloud
    assert back.class_ids is not None and cloud.class_ids is not None and (back.class_ids == cloud.class_ids).all()
    assert all(np.array_equal(getattr(back, name), getattr(cloud, name)) for name in ("means", "sh", "logits"))


def test_spz_takes_fewer_fractional_bits_for_far_places() -> None:
    cloud = toy_splats.cloud(5, spread=5000.0)
    assert spz.fractional_bits(cloud.means) == 10
    assert np.abs(spz.from_bytes(spz.to_bytes(cloud), "x").cloud.means - cloud.means).max() <= 2**-10
    far = SplatCloud(cloud.means * 1e4, cloud.quats, cloud.log_scales, cloud.logits, cloud.sh)
    refused("too far", spz.to_bytes, far)


def test_spz_of_version_4_needs_a_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zstandard", None)
    refused("zstandard", spz.from_bytes, foreign_splats.spz(4), "x", raises=ResourceError)


def test_morton_order_keeps_neighbours_together() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    mixed = grid[np.random.default_rng(0).permutation(len(grid))]
    ordered = mixed[binary.morton_order(mixed)]
    assert all((np.ptp(ordered[i : i + 8], axis=0) == 1).all() for i in range(0, 512, 8))


def test_what_is_lost_is_said() -> None:
    scene = toy_splats.scene(2)

    def lost(name: str, time_s: float | None) -> str:
        return "; ".join(formats.losses(name, formats.WriteRequest(scene, time_s)))

    assert lost("usdz", None) == ""
    assert lost("usda", None).startswith("the sky")
    assert lost("glb", None).startswith("deformation (1 person in the shape of the middle")
    assert "motion (2 objects as at 0.5 s)" in lost("ply", 0.5)
    assert "colours that depend" in lost("splat", 0.5) and "classes" in lost("spz", 0.5)


def test_names_of_prims_are_valid_and_times_of_animations_rise() -> None:
    assert usd.prim_names(["a-1", "a_1", "7", ""]) == ["a_1", "a_1_2", "_7", "node"]
    made = gltf.rising(np.array([-0.1, 0.0, 1e-50, 5.0, 5.0 + 1e-9]))
    assert (np.diff(made) > 0).all() and made[0] == 0


# -- harmonics: the basis of the rasterisers, and exact rotation ------------------------------------


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_rotated_harmonics_look_from_rotated_directions_as_the_old_ones_did(degree: int) -> None:
    d = np.random.default_rng(1).normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    assert np.abs(harmonics.basis(d, 3) - sh_basis(torch.from_numpy(d), 3).numpy()).max() < 1e-9  # the rasterisers'
    rotation = matrix_from_quaternion(np.random.default_rng(degree).normal(size=4))
    sh = np.random.default_rng(2).normal(size=(4, (degree + 1) ** 2, 3))
    rows = slice(degree**2, (degree + 1) ** 2)
    before = harmonics.basis(d, degree)[:, rows] @ sh[0, rows]
    mixed = harmonics.band_rotation(rotation, degree) @ sh[0, rows]
    after = harmonics.basis(d @ rotation.T, degree)[:, rows] @ mixed
    assert np.abs(after - before).max() < 1e-12  # float64 rounding
    made = harmonics.rotated(sh.astype(np.float32), rotation)
    seen = np.einsum("dk,nkc->dnc", harmonics.basis(d @ rotation.T, degree), made)
    assert np.abs(seen - np.einsum("dk,nkc->dnc", harmonics.basis(d, degree), sh)).max() < 1e-5
