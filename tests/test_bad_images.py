"""Images that no camera of a data set writes: refused by name or taken and noted in every format, nothing half-written;
headers that claim 60,000 x 60,000 pixels are refused by every reader, without the memory they claim."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path

import bad_logs
import numpy as np
import pytest
from bad_logs import FORMATS, Change
from memory_limits import at_most
from PIL import Image
from roundtrip import needs_native

from mudg.base.errors import InputError
from mudg.base.types import Camera
from mudg.city import light as photos
from mudg.scene import labels
from mudg.scene.read import check_image, decode_image
from mudg.scoring.detections import read_mask
from mudg.viewer import gallery

IMAGES: dict[str, tuple[Change, str]] = {
    # what is wrong: (how the image is changed, words of the error)
    "cut off": (lambda c: c[: len(c) // 2], "cannot be decoded"),
    "empty": (lambda _: b"", "not a PNG or JPEG"),
    "16 bits": (bad_logs.sixteen_bits, "not 8-bit"),
    "EXIF-rotated": (bad_logs.turned, "stored rotated"),
    "declares a huge size": (bad_logs.declaring(60_000, 60_000), "too large"),
    "wrong checksum": (bad_logs.other_checksum, "cannot be decoded"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bad_logs.shared(tmp_path_factory)


@needs_native
@pytest.mark.parametrize("case", IMAGES)
@pytest.mark.parametrize("kind", FORMATS)
def test_a_bad_image_is_refused_by_name(kind: str, case: str, folder: Path, tmp_path: Path) -> None:
    log = bad_logs.written(kind, folder)
    change, words = IMAGES[case]
    with bad_logs.damaged(log, kind, "image", change, tmp_path) as (source, where):
        bad_logs.assert_refused(kind, source, tmp_path, bad_logs.options_of(log), words, where)


@needs_native
@pytest.mark.parametrize("kind", FORMATS)
def test_a_grey_image_is_taken_and_noted(kind: str, folder: Path, tmp_path: Path) -> None:
    log, grey = bad_logs.written(kind, folder), lambda content: bad_logs.png(bad_logs.opened(content).convert("L"))
    with bad_logs.damaged(log, kind, "image", grey, tmp_path) as (source, _):
        scene = bad_logs.ingest(kind, source, tmp_path / "out", bad_logs.options_of(log))
    assert "1 images of camera front are grey" in scene.source.notes


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_what_is_checked_is_what_can_be_decoded(kind: str) -> None:
    """Every cut, and many flipped bits: an image that passes the check is decoded, one that is refused here is refused
    there.

    Only a PNG's checksums are known to the check alone.
    """
    rng = np.random.default_rng(5)
    pixels = rng.integers(0, 255, (21, 34, 3)).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind, quality=80)
    whole = buffer.getvalue()
    spoilt = [whole[:size] for size in range(0, len(whole), 7)]
    for place in rng.integers(0, len(whole), 150):
        spoilt.append(whole[:place] + bytes([whole[place] ^ (1 << rng.integers(8))]) + whole[place + 1 :])
    refused = 0
    for content in [whole, *spoilt]:
        checked, decoded = (passes(content, function) for function in (check_image, decode_image))
        assert decoded or not checked
        assert checked == decoded or kind == "PNG"
        refused += not checked
    assert passes(whole, check_image)
    assert refused > len(whole) // 10


def passes(content: bytes, function: object) -> bool:
    try:
        function(content, "image")
    except InputError:
        return False
    return True


# -- headers that claim a huge size ------------------------------------------------------------------

CAMERA = Camera("front", 60_000, 60_000, 100.0, 100.0, 30_000.0, 30_000.0)


def huge_png(mode: str) -> bytes:
    """A PNG of one pixel whose header states another size, with the right checksum."""
    return bad_logs.declaring(60_000, 60_000)(bad_logs.png(Image.new(mode, (1, 1))))


def huge_jpeg(_mode: str) -> bytes:
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
    "label": ("L", lambda path: labels.decode_grey(path.read_bytes(), "here")),
    "label of 16 bits": ("I;16", lambda path: labels.decode_grey(path.read_bytes(), "here", (16,))),
}


@pytest.mark.parametrize("kind", [huge_png, huge_jpeg])
@pytest.mark.parametrize("name", READERS)
def test_an_image_that_claims_to_be_huge_is_refused(name: str, kind: Callable[[str], bytes], tmp_path: Path) -> None:
    mode, read = READERS[name]
    (tmp_path / "x.png").write_bytes(kind(mode))
    with at_most(512), pytest.raises(InputError):
        read(tmp_path / "x.png")


@pytest.mark.parametrize("kind", [huge_png, huge_jpeg])
def test_pages_leave_out_an_image_that_claims_to_be_huge(kind: Callable[[str], bytes], tmp_path: Path) -> None:
    (tmp_path / "x.png").write_bytes(kind("RGB"))
    with at_most(512):
        assert gallery._thumbnail(tmp_path / "x.png", 100) == ""
