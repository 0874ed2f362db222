"""Small images whose headers claim 60,000 x 60,000 pixels: every reader refuses them, without the memory they claim."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from memory_limits import at_most
from PIL import Image

from mudg.base.errors import InputError
from mudg.base.types import Camera
from mudg.city import light as photos
from mudg.formats.importers import kitti360
from mudg.formats.importers.waymo import importer as waymo
from mudg.scene import labels
from mudg.scene.read import check_image, decode_image
from mudg.scoring.detections import read_mask
from mudg.viewer import gallery

CAMERA = Camera("front", 60_000, 60_000, 100.0, 100.0, 30_000.0, 30_000.0)


def _png(mode: str) -> bytes:
    """A PNG of one pixel whose header states another size, with the right checksum."""
    out = io.BytesIO()
    Image.new(mode, (1, 1)).save(out, "PNG")
    content = out.getvalue()
    header = b"IHDR" + struct.pack(">II", 60_000, 60_000) + content[24:29]
    return content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:]


def _jpeg(_mode: str) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (8, 8)).save(out, "JPEG")
    content = bytearray(out.getvalue())
    at = content.index(b"\xff\xc0") + 5
    content[at : at + 4] = struct.pack(">HH", 60_000, 60_000)
    return bytes(content)


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "image of a scene": ("RGB", lambda path: decode_image(path.read_bytes(), "here", CAMERA)),
    "image of a scene, checked": ("RGB", lambda path: check_image(path.read_bytes(), "here", CAMERA)),
    "lane mask": ("L", read_mask),
    "texture": ("RGB", photos.surface),
    "label": ("L", lambda path: labels._decode_grey(path.read_bytes(), "here")),
    "label of KITTI-360": ("L", kitti360._grey),
    "label of Waymo": (
        "I;16",
        lambda path: waymo.panoptic_ids(SimpleNamespace(divisor=1000, png=path.read_bytes()), CAMERA, "here"),
    ),
}


@pytest.mark.parametrize("kind", [_png, _jpeg])
@pytest.mark.parametrize("name", READERS)
def test_an_image_that_claims_to_be_huge_is_refused(name: str, kind: Callable[[str], bytes], tmp_path: Path) -> None:
    mode, read = READERS[name]
    (tmp_path / "x.png").write_bytes(kind(mode))
    with at_most(512), pytest.raises(InputError):
        read(tmp_path / "x.png")


@pytest.mark.parametrize("kind", [_png, _jpeg])
def test_pages_leave_out_an_image_that_claims_to_be_huge(kind: Callable[[str], bytes], tmp_path: Path) -> None:
    (tmp_path / "x.png").write_bytes(kind("RGB"))
    with at_most(512):
        assert gallery._thumbnail(tmp_path / "x.png", 100) == ""
