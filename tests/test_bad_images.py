"""Images that no camera of a data set writes, in every format: refused by name, or taken and noted; nothing
half-written."""

from __future__ import annotations

import io
from pathlib import Path

import bad_logs
import numpy as np
import pytest
from bad_logs import FORMATS, Change
from PIL import Image
from roundtrip import needs_native

from mudg.base.errors import InputError
from mudg.scene.read import check_image, decode_image

pytestmark = needs_native

IMAGES: dict[str, tuple[Change, str]] = {
    # what is wrong: (how the image is changed, words of the error)
    "cut off": (lambda c: c[: len(c) // 2], "cannot be decoded"),
    "empty": (lambda _: b"", "not a PNG or JPEG|frame lacks images"),
    "16 bits": (bad_logs.sixteen_bits, "not 8-bit"),
    "EXIF-rotated": (bad_logs.turned, "stored rotated"),
    "declares a huge size": (bad_logs.declaring(60_000, 60_000), "too large"),
    "wrong checksum": (bad_logs.other_checksum, "cannot be decoded"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bad_logs.shared(tmp_path_factory)


@pytest.mark.parametrize("case", IMAGES)
@pytest.mark.parametrize("kind", FORMATS)
def test_a_bad_image_is_refused_by_name(kind: str, case: str, folder: Path, tmp_path: Path) -> None:
    log = bad_logs.written(kind, folder)
    change, words = IMAGES[case]
    with bad_logs.damaged(log, kind, "image", change, tmp_path) as (source, where):
        bad_logs.assert_refused(kind, source, tmp_path, bad_logs.options_of(log), words, where)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_grey_image_is_taken_and_noted_but_not_from_a_log_of_ones_own(
    kind: str, folder: Path, tmp_path: Path
) -> None:
    log = bad_logs.written(kind, folder)

    def grey(content: bytes) -> bytes:
        return bad_logs.png(bad_logs.opened(content).convert("L"))

    with bad_logs.damaged(log, kind, "image", grey, tmp_path) as (source, where):
        if kind == "custom":
            bad_logs.assert_refused(kind, source, tmp_path, bad_logs.options_of(log), "image is grey", where)
            return
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
