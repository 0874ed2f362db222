"""Photographic surfaces and skies of a city: read exactly, used as stated, and geometry stays what it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mudg import native
from mudg.base.errors import InputError
from mudg.city.config import CityConfig
from mudg.city.light import SKY_SLOT, draw_photos, panorama, radiance, surface
from mudg.city.world import CityWorld


def hdr_bytes(rgbe: np.ndarray) -> bytes:
    """A run-length coded Radiance file of u8[H, W, 4]; the first half of every row as runs of literals, the second as
    runs."""
    height, width = rgbe.shape[:2]
    out = bytearray(f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode())
    for row in rgbe:
        out += bytes([2, 2, width >> 8, width & 255])
        for channel in range(4):
            values = row[:, channel].tolist()
            half = width // 2
            out += bytes([half, *values[:half]])
            for value in values[half:]:
                out += bytes([129, value])
    return bytes(out)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    (tmp_path / "textures").mkdir()
    (tmp_path / "sky").mkdir()
    for name in ("Asphalt1.png", "Concrete1.png", "Bricks1.png", "Plaster1.png", "Grass1.png", "unknown.png"):
        Image.fromarray(rng.integers(40, 200, (32, 32, 3), np.uint8)).save(tmp_path / "textures" / name)
    rgbe = np.full((64, 128, 4), 128, np.uint8)
    rgbe[:32, :, 2] = 255  # blue above
    rgbe[..., 3] = 129
    (tmp_path / "sky" / "blue.hdr").write_bytes(hdr_bytes(rgbe))
    return tmp_path


def test_radiance_pixels_are_mantissa_times_two_to_the_exponent() -> None:
    rgbe = np.zeros((2, 16, 4), np.uint8)
    rgbe[0, :, :] = (128, 64, 32, 129)
    rgbe[1, :, :] = (200, 100, 50, 131)
    rgbe[1, 3] = (9, 9, 9, 0)
    image = radiance(hdr_bytes(rgbe), Path("a.hdr"))
    assert image.shape == (2, 16, 3)
    assert np.allclose(image[0, 5], [1.0, 0.5, 0.25])
    assert np.allclose(image[1, 12], np.array([200, 100, 50]) / 32)
    assert (image[1, 3] == 0).all()


@pytest.mark.parametrize(
    "spoil",
    [lambda b: b[:-7], lambda b: b[2:], lambda b: b.replace(b"-Y", b"+Y"), lambda b: b.replace(b"+X 16", b"+X 24")],
)
def test_spoiled_radiance_files_are_refused(spoil) -> None:
    with pytest.raises(InputError):
        radiance(spoil(hdr_bytes(np.full((2, 16, 4), 130, np.uint8))), Path("a.hdr"))


def test_surfaces_vary_around_one_and_skies_around_their_median(folder: Path) -> None:
    pixels = surface(folder / "textures" / "Asphalt1.png")
    assert pixels.mean() == pytest.approx(1.0, abs=0.05)
    sky = panorama(folder / "sky" / "blue.hdr")
    assert float(np.median(sky.mean(-1))) == pytest.approx(1.0, abs=0.05)
    assert (sky[..., 2] > sky[..., 0]).all()


def test_photographs_follow_from_folder_and_seed(folder: Path) -> None:
    first, again = draw_photos(folder, 3), draw_photos(folder, 3)
    assert [(s, m) for s, _, m in first] == [(s, m) for s, _, m in again]
    assert all(np.array_equal(a[1], b[1]) for a, b in zip(first, again, strict=True))
    slots = [{s for s, _, _ in draw_photos(folder, seed)} for seed in range(30)]
    assert 0.3 < np.mean([SKY_SLOT in s for s in slots]) < 0.8
    assert set.union(*slots) <= {0, 1, 2, 3, 4, 5, SKY_SLOT}
    with pytest.raises(InputError, match="no such folder"):
        draw_photos(folder / "missing", 3)


@pytest.mark.skipif(native.library() is None, reason="the native library is not built")
def test_photographs_change_colours_and_nothing_else(folder: Path) -> None:
    plain = CityConfig(seed=4, n_frames=2, width=96, height=64, cameras=("front",))
    seed = next(
        s
        for s in range(4, 60)
        if SKY_SLOT in {p[0] for p in draw_photos(folder, s)} and len(draw_photos(folder, s)) > 5
    )
    plain = replace(plain, seed=seed)
    without, with_photos = CityWorld(plain), CityWorld(replace(plain, textures=str(folder)))
    view = without.frame_views("front")[0]
    a, b = without.render(view), with_photos.render(view)
    assert np.array_equal(a.depth, b.depth)
    assert np.array_equal(a.semantics, b.semantics)
    road = a.semantics == 0
    assert np.abs(a.rgb[road] - b.rgb[road]).mean() > 0.005
    assert a.rgb[road].mean() == pytest.approx(b.rgb[road].mean(), rel=0.15)
    if a.sky.any():
        assert (b.rgb[b.sky][:, 2] >= b.rgb[b.sky][:, 0]).all()
    again = CityWorld(replace(plain, textures=str(folder))).render(view)
    assert np.array_equal(b.rgb, again.rgb)
