"""Labels of frames (depth, classes, masks, confidences): arrays to file bytes and back."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from mudg.base import palette, store
from mudg.base.errors import InputError
from mudg.base.types import Camera, Frame, Scene
from mudg.scene.read import open_files
from mudg.scene.schema import LABEL_NAMES, MAX_IMAGE_SIDE_PX

_PNG_LABELS: Final = ("semantics", "sky", "ego", "dynamic", "rendered")
"""Kept as PNG, the rest as safetensors; all but the first are masks."""
TRUSTED_LABELS: Final = 0.5
"""Labels with less confidence than this are given to no model."""


def read_label(scene: Scene, frame: Frame, name: str) -> NDArray[Any]:
    """One label of a frame.

    ==================== ============ ==================================================================
    name                 array        meaning
    ==================== ============ ==================================================================
    depth                f32[H, W]    camera z in metres; NaN = no depth there (not measured, or sky). ``mudg annotate``
                                      writes it dense: a value everywhere, the sky at 100 m
    semantics            u8[H, W]     Cityscapes train id 0..18, 255 = unlabelled
    sky, ego, dynamic    bool[H, W]   sky; own vehicle; dynamic object
    rendered             bool[H, W]   not recorded: rendered or generated for an edited drive
    instance             i32[H, W]    id of an object, 0 = none
    *_confidence         f32[H, W]    0 (unknown) .. 1 (measured)
    ==================== ============ ==================================================================

    InputError: the frame does not have the label, or the file is damaged.
    """
    _check_label_name(name, f"{scene.root}: {frame.id}")
    ref = frame.labels.get(name)
    if ref is None:
        got, remedy = ", ".join(frame.labels) or "no labels", "run `mudg annotate`, which makes a scene with labels"
        raise InputError(f"frame has no label {name!r}", where=f"{scene.root}: {frame.id}", got=got, remedy=remedy)
    return _decode_label(name, open_files(scene.root).read(ref.path), f"{scene.root}: {ref.path}", frame.view.camera)


def photographs(scene: Scene) -> tuple[Frame, ...]:
    """Frames to learn from whose images a camera recorded whole: not held out, and without pixels that an edit of the
    drive rendered."""
    return tuple(frame for frame in scene.frames_in("train") if "rendered" not in frame.labels)


def read_trusted_classes(scene: Scene, frame: Frame, least: float = TRUSTED_LABELS) -> NDArray[np.uint8] | None:
    """Class ids u8[H, W] of a frame, 255 where unlabelled or where their confidence is below ``least``; None without
    labels."""
    if "semantics" not in frame.labels:
        return None
    ids = read_label(scene, frame, "semantics")
    if "semantics_confidence" in frame.labels:
        ids = np.where(read_label(scene, frame, "semantics_confidence") >= least, ids, np.uint8(palette.UNLABELLED))
    return ids.astype(np.uint8)


def label_ref(name: str, frame_id: str) -> str:
    """Where the label ``name`` of a frame lies in a scene."""
    return f"labels/{name}/{frame_id}.{'png' if name in _PNG_LABELS else 'safetensors'}"


def encode_label(name: str, array: NDArray[Any], camera: Camera, where: str) -> bytes:
    """File bytes of a label; see ``read_label`` for the arrays. Depth that is not finite or not positive is missing.
    InputError: no such label, another size than the camera's, or values out of range."""
    array = np.asarray(array)
    _check_label_name(name, where)
    _check_size(array, camera, f"{where}: {name}")
    if name == "semantics":
        _check_class_ids(array, where)
        return encode_png(array.astype(np.uint8))
    if name in _PNG_LABELS:
        return encode_png(array.astype(bool).astype(np.uint8) * np.uint8(255))
    if name == "instance":
        return encode_safetensors({name: array.astype(np.int32)})
    if name == "depth":
        with np.errstate(invalid="ignore"):
            valid = np.isfinite(array) & (array > 0)
        return encode_safetensors({name: np.where(valid, array, 0).astype(np.float32), "valid": valid.astype(np.uint8)})
    if not ((array >= 0) & (array <= 1)).all():
        raise InputError("confidence lies outside 0..1", where=f"{where}: {name}")
    return encode_safetensors({name: array.astype(np.float32)})


def _decode_label(name: str, content: bytes, where: str, camera: Camera) -> NDArray[Any]:
    if name in _PNG_LABELS:
        array = decode_grey(content, where)
        if name == "semantics":
            _check_class_ids(array, where)
        else:
            array = array > 127
    else:
        arrays = store.parse_safetensors(content, where)
        dtype = np.int32 if name == "instance" else np.float32
        if name not in arrays or arrays[name].dtype != dtype or (name == "depth" and "valid" not in arrays):
            expected = f"{name} ({np.dtype(dtype).name})"
            got = ", ".join(f"{key} ({value.dtype})" for key, value in arrays.items())
            raise InputError("label file has other tensors than it should", where=where, expected=expected, got=got)
        array = arrays[name]
        if name == "depth":
            valid = arrays["valid"]
            if valid.shape != array.shape:
                got = f"{array.shape} and {valid.shape}"
                raise InputError("depth and its validity differ in size", where=where, got=got)
            array = np.where(valid > 0, array, np.float32(np.nan))
    _check_size(array, camera, where)
    return array


def _check_label_name(name: str, where: str) -> None:
    if name not in LABEL_NAMES:
        raise InputError("there is no such label", where=where, expected=", ".join(LABEL_NAMES), got=name)


def _check_size(array: NDArray[Any], camera: Camera, where: str) -> None:
    if array.shape != (camera.height, camera.width):
        expected, got = f"[{camera.height}, {camera.width}]", str(list(array.shape))
        raise InputError("label does not have its camera's size", where=where, expected=expected, got=got)


def _check_class_ids(array: NDArray[Any], where: str) -> None:
    if wrong := palette.other_ids(array):
        what, expected = "semantics hold values that are no train id", "0..18 or 255 (unlabelled)"
        raise InputError(what, where=where, expected=expected, got=str(wrong))


def decode_grey(content: bytes, where: str, bits: tuple[int, ...] = (8,)) -> NDArray[Any]:
    """A PNG of one channel of 8 or 16 ``bits``, u8 or u16 [H, W]. Raises InputError: another one, or damaged."""
    modes = ("L", "P", "1") * (8 in bits) + ("I;16", "I") * (16 in bits)
    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            if image.mode not in modes or max(image.size) > MAX_IMAGE_SIDE_PX:
                got, expected = f"mode {image.mode}, {image.size}", f"{' or '.join(map(str, bits))} bits"
                raise InputError(f"label image is not {bits[0]}-bit grey", where=where, expected=expected, got=got)
            array = np.array(image.convert("L") if image.mode == "1" else image)
            return array.astype(np.uint8 if image.mode in ("L", "P", "1") else np.uint16)
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError, EOFError) as error:
        raise InputError("label image cannot be decoded (is it cut off?)", where=where, got=str(error)) from error


def encode_png(array: NDArray[np.uint8]) -> bytes:
    """A lossless PNG of u8[H, W] or u8[H, W, 3]."""
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def encode_safetensors(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """A safetensors file of named arrays."""
    from safetensors.numpy import save

    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()})
