"""Reading scenes: the index at once, images, points and labels when asked for."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from mudg.base import palette, store
from mudg.base.errors import InputError
from mudg.base.types import Camera, Frame, Ref, Scene, Sweep, SweepPoints
from mudg.data.scene import schema
from mudg.data.scene.files import open_files

MASK_LABELS: Final = ("sky", "ego", "dynamic")
_EXIF_ORIENTATION: Final = 0x0112
_PNG: Final = b"\x89PNG"


def read_scene(path: Path | str) -> Scene:
    """Read and check a scene; images, points and labels stay on disk until asked for.

    Args:
        path: a scene directory, or a stored zip of one.

    Raises:
        InputError: a record, reference or relation is wrong, or a referenced file is missing.
        IntegrityError: a file differs from the scene's manifest.
    """
    return load_scene(path, schema.raise_first)


def load_scene(path: Path | str, complain: schema.Complain) -> Scene:
    """``read_scene`` with a choice of what happens to a problem (see ``scene_schema``)."""
    files = open_files(path)
    where = f"{files.root}: scene.json" if Path(path).is_file() else str(Path(path) / "scene.json")
    scene_json = schema.parse_object(files.read("scene.json"), where)
    tracks_json = None
    if files.problem("tracks.json") is None:
        tracks_json = schema.parse_object(files.read("tracks.json"), where.replace("scene.json", "tracks.json"))
    scene = schema.scene_from_json(scene_json, tracks_json, files.root, where, complain)
    named: dict[str, str] = {}
    for owner, ref in all_refs(scene):
        problem = files.problem(ref.path)
        if problem is not None:
            complain(
                InputError(
                    problem,
                    where=f"{where}: {owner}",
                    expected="a readable file inside the scene",
                    got=ref.path,
                    remedy="restore the file, remove the record, or ingest the log again",
                )
            )
        if named.setdefault(ref.path, owner) != owner:
            complain(
                InputError(
                    "two records name the same file",
                    where=f"{where}: {owner}",
                    got=f"{ref.path}, also in {named[ref.path]}",
                )
            )
    return scene


def all_refs(scene: Scene) -> list[tuple[str, Ref]]:
    """Every file reference of a scene with words for its owner."""
    refs = [(f"frame {frame.id} image", frame.image) for frame in scene.frames]
    refs += [(f"frame {frame.id} label {name}", ref) for frame in scene.frames for name, ref in frame.labels.items()]
    return refs + [(f"sweep {sweep.id}", sweep.points) for sweep in scene.sweeps]


def read_image(scene: Scene, frame: Frame) -> NDArray[np.uint8]:
    """The recorded image, u8[H, W, 3] RGB. Grey images are repeated on three channels.

    Raises:
        InputError: missing, truncated, not 8-bit, or not of the camera's size.
    """
    content = open_files(scene.root).read(frame.image.path)
    return decode_image(content, f"{scene.root}: {frame.image.path}", frame.view.camera)


def decode_image(content: bytes, where: str, camera: Camera | None = None) -> NDArray[np.uint8]:
    """Decode PNG or JPEG bytes to u8[H, W, 3]; the size is compared with ``camera`` before anything is unpacked."""
    with _opened(content, where, camera) as image:
        return np.array(image.convert("RGB"))


def check_image(content: bytes, where: str, camera: Camera | None = None) -> bool:
    """Refuse PNG or JPEG bytes that ``decode_image`` would refuse, at less cost; returns whether the image is grey.

    All data are read. Of a JPEG they are turned into a picture of an eighth of the size, a tenth of the work; a PNG's
    checksums are compared, too, which decoding leaves out.
    """
    if content[:4] == _PNG:
        with _refusals(content, where), Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            image.verify()
    with _opened(content, where, camera) as image:
        grey = image.mode == "L"
        if image.format == "JPEG":
            image.draft("L", (max(1, image.width // 8), max(1, image.height // 8)))
        image.load()
        return grey


@contextlib.contextmanager
def _opened(content: bytes, where: str, camera: Camera | None) -> Iterator[Image.Image]:
    """An opened image of a kind that scenes hold; what goes wrong with it in the block becomes an InputError."""
    with _refusals(content, where), Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as image:
        if camera is not None and image.size != (camera.width, camera.height):
            raise InputError(
                "image does not have its camera's size",
                where=where,
                got=f"{image.width}x{image.height}",
                expected=f"{camera.width}x{camera.height}",
                remedy="correct the camera's size and intrinsics, or the image",
            )
        if max(image.size) > schema.MAX_IMAGE_SIDE_PX:
            raise InputError("image is too large", where=where, got=f"{image.width}x{image.height}")
        if image.getexif().get(_EXIF_ORIENTATION, 1) != 1:
            raise InputError(
                "image is stored rotated (EXIF orientation)",
                where=where,
                expected="upright pixels",
                remedy="apply the rotation and write the image again",
            )
        sixteen_bits = content[:4] == _PNG and content[24:25] == b"\x10"  # Pillow would drop the lower half
        if image.mode not in ("RGB", "L", "P", "RGBA") or sixteen_bits:
            raise InputError(
                "image is not 8-bit RGB or grey",
                where=where,
                expected="8 bits a channel",
                got="16 bits a channel" if sixteen_bits else f"mode {image.mode}",
                remedy="convert it to 8-bit RGB",
            )
        if image.mode == "RGBA" and image.getchannel("A").getextrema() != (255, 255):
            raise InputError("image has transparent pixels", where=where, expected="an opaque image")
        yield image


@contextlib.contextmanager
def _refusals(content: bytes, where: str) -> Iterator[None]:
    """What Pillow raises, in words."""
    try:
        yield
    except UnidentifiedImageError as error:
        raise InputError(
            "file is not a PNG or JPEG image",
            where=where,
            got=_first_bytes(content),
            remedy="is it an empty or placeholder file? copy it again",
        ) from error
    except Image.DecompressionBombError as error:
        raise InputError(
            "image is too large", where=where, got=str(error)[:120], remedy="is its header damaged? copy the file again"
        ) from error
    except (OSError, SyntaxError, ValueError, EOFError) as error:
        raise InputError(
            "image cannot be decoded (is it cut off?)",
            where=where,
            got=f"{error} after {len(content)} bytes",
            remedy="copy the file again",
        ) from error


def _first_bytes(content: bytes) -> str:
    return f"{len(content)} bytes starting {content[:12]!r}" if content else "an empty file"


def read_points(scene: Scene, sweep: Sweep) -> SweepPoints:
    """The points of a sweep in the LiDAR frame. A sweep with zero points is a sweep with zero points, not an error.

    Raises:
        InputError: missing, truncated, wrong tensors, or NaN coordinates.
    """
    where = f"{scene.root}: {sweep.points.path}"
    arrays = store.parse_safetensors(open_files(scene.root).read(sweep.points.path), where)
    for name in ("xyz", "intensity", "dt_s"):
        if name not in arrays:
            raise InputError(
                f"sweep has no tensor {name!r}",
                where=where,
                expected="xyz, intensity, dt_s",
                got=", ".join(arrays) or "nothing",
            )
    return checked_points(arrays["xyz"], arrays["intensity"], arrays["dt_s"], where)


def checked_points(xyz: NDArray[Any], intensity: NDArray[Any], dt_s: NDArray[Any], where: str) -> SweepPoints:
    """Points from their arrays; wrong shape or type, or values that are not finite, are refused with their place."""
    count = len(xyz)
    shapes = {"xyz": (xyz, (count, 3)), "intensity": (intensity, (count,)), "dt_s": (dt_s, (count,))}
    for name, (array, shape) in shapes.items():
        if array.shape != shape or array.dtype != np.float32:
            raise InputError(
                f"sweep tensor {name!r} has the wrong form",
                where=where,
                expected=f"float32 {shape}",
                got=f"{array.dtype} {array.shape}",
            )
        if not np.isfinite(array).all():
            bad = int((~np.isfinite(array.reshape(count, -1)).all(1)).sum())
            raise InputError(
                "sweep holds values that are not finite",
                where=f"{where}: {name}",
                got=f"{bad} of {count} points",
                expected="finite metres",
                remedy="drop missing returns when importing",
            )
    return SweepPoints(xyz, intensity, dt_s)


def read_label(scene: Scene, frame: Frame, name: str) -> NDArray[Any]:
    """One label of a frame.

    ==================== ============ ==================================================================
    name                 array        meaning
    ==================== ============ ==================================================================
    depth                f32[H, W]    camera z in metres; NaN = no depth there (not measured, or sky). ``mudg annotate``
                                      writes it dense: a value everywhere, the sky at 100 m
    semantics            u8[H, W]     Cityscapes train id 0..18, 255 = unlabelled
    sky, ego, dynamic    bool[H, W]   sky; own vehicle; object that moves
    instance             i32[H, W]    id of an object, 0 = none
    *_confidence         f32[H, W]    0 (unknown) .. 1 (measured)
    ==================== ============ ==================================================================

    Raises:
        InputError: the frame does not have the label, or the file is damaged.
    """
    where = f"{scene.root}: {frame.id}"
    if name not in schema.LABEL_NAMES:
        raise InputError("there is no such label", where=where, expected=", ".join(schema.LABEL_NAMES), got=name)
    ref = frame.labels.get(name)
    if ref is None:
        raise InputError(
            f"frame has no label {name!r}",
            where=where,
            got=", ".join(frame.labels) or "no labels",
            remedy="run `mudg annotate`, which makes a scene with labels",
        )
    return _decode_label(name, open_files(scene.root).read(ref.path), f"{scene.root}: {ref.path}", frame.view.camera)


def read_trusted_classes(scene: Scene, frame: Frame, least: float) -> NDArray[np.uint8] | None:
    """Class ids u8[H,W] of a frame, 255 where unlabelled or where the labels' confidence is below `least`; None without labels."""
    if "semantics" not in frame.labels:
        return None
    ids = read_label(scene, frame, "semantics")
    if "semantics_confidence" in frame.labels:
        ids = np.where(read_label(scene, frame, "semantics_confidence") >= least, ids, np.uint8(palette.UNLABELLED))
    return ids.astype(np.uint8)


def label_ref(name: str, frame_id: str) -> str:
    """Where the label ``name`` of a frame lies in a scene."""
    return f"labels/{name}/{frame_id}.{'png' if _is_png(name) else 'safetensors'}"


def _is_png(name: str) -> bool:
    return name == "semantics" or name in MASK_LABELS


def _decode_label(name: str, content: bytes, where: str, camera: Camera) -> NDArray[Any]:
    shape = (camera.height, camera.width)
    if _is_png(name):
        array = _decode_grey(content, where)
        if name == "semantics" and not np.isin(np.unique(array), [*range(19), 255]).all():
            raise InputError(
                "semantics hold values that are no train id", where=where, expected="0..18 or 255 (unlabelled)"
            )
        if name != "semantics":
            array = array > 127
    else:
        arrays = store.parse_safetensors(content, where)
        kind = np.int32 if name == "instance" else np.float32
        if name not in arrays or arrays[name].dtype != kind or (name == "depth" and "valid" not in arrays):
            raise InputError(
                "label file has other tensors than it should",
                where=where,
                expected=f"{name} ({np.dtype(kind).name})",
                got=", ".join(f"{key} ({value.dtype})" for key, value in arrays.items()),
            )
        array = arrays[name]
        if name == "depth":
            if arrays["valid"].shape != array.shape:
                raise InputError(
                    "depth and its validity differ in size",
                    where=where,
                    got=f"{array.shape} and {arrays['valid'].shape}",
                )
            array = np.where(arrays["valid"] > 0, array, np.float32(np.nan))
    if array.shape != shape:
        raise InputError(
            "label does not have its camera's size", where=where, expected=str(list(shape)), got=str(list(array.shape))
        )
    return array


def _decode_grey(content: bytes, where: str) -> NDArray[np.uint8]:
    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            if image.mode not in ("L", "P", "1") or max(image.size) > schema.MAX_IMAGE_SIDE_PX:
                raise InputError(
                    "label image is not 8-bit grey",
                    where=where,
                    expected="mode L",
                    got=f"mode {image.mode}, {image.size}",
                )
            return np.array(image.convert("L") if image.mode == "1" else image, np.uint8)
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, EOFError) as error:
        raise InputError("label image cannot be decoded (is it cut off?)", where=where, got=str(error)) from error
