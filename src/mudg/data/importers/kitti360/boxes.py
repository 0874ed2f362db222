"""KITTI-360 bounding primitives: ``data_3d_bboxes/*/<drive>.xml``, OpenCV-style matrices in XML, boxes in the world.

An object's ``transform`` maps its ``vertices`` (a unit cube for the classes read here) to the world and holds the size as scale.
Static objects have ``timestamp`` -1 and a window of frames; objects that move have one entry per frame.

The files hold a hundred thousand objects of all classes; they are read in pieces and only the classes of ``LABEL_OF`` are kept.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation
from mudg.data.unknown_fields import note_unknown

Matrix = NDArray[np.float64]
LABEL_OF_ID: Final = {
    13: "car", 14: "truck", 34: "bus", 16: "caravan", 15: "trailer", 33: "train", 17: "motorcycle", 18: "bicycle",
    19: "person", 20: "rider", 36: "unknown vehicle",
}  # fmt: skip
"""The annotation tool's class numbers (``semanticId``) of what can move. Source: the data set's label table (kittiId)."""
LABEL_OF: Final = {
    "car": "car", "truck": "truck", "bus": "bus", "caravan": "caravan", "trailer": "trailer", "train": "train",
    "motorcycle": "motorcycle", "bicycle": "bicycle", "person": "pedestrian", "pedestrian": "pedestrian",
    "rider": "cyclist", "unknown vehicle": "vehicle",
}  # fmt: skip
"""Classes that become tracks -> the labels of this package. Buildings, poles, vegetation and ground are no tracks."""
_OFFICIAL: Final = frozenset({
    "index", "label", "category", "semanticId", "semanticId_orig", "instanceId", "timestamp", "start_frame", "end_frame", "dynamic",
    "dynamicSeq", "dynamicIdx", "dynamicIndex", "level_min", "level_max", "color", "transform", "vertices", "faces",
})  # fmt: skip
"""Fields of the data set's objects, read or not."""
VEHICLES: Final = frozenset(("car", "truck", "bus", "caravan", "trailer", "train", "motorcycle", "bicycle"))
MAX_FILE_BYTES: Final = 8 * 1024**3
_CHUNK: Final = 1 << 20
_MAX_VALUES: Final = 100_000
_MAX_SHEAR: Final = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Kitti360Box:
    """One box in the data set's world.

    Args:
        object_id: the same for all boxes of an object.
        label: class as in ``LABEL_OF``.
        frame: frame number of a box that moves; -1 for an object that stands.
        window: first and last frame of the part of the drive the box was drawn in.
        size_m: length, width, height.
        world_from_box: f64[4, 4], x forward, y left, z up, origin in the centre.
    """

    object_id: str
    label: str
    frame: int
    window: tuple[int, int]
    size_m: tuple[float, float, float]
    world_from_box: Matrix


def read_boxes(path: Path, left_out: Counter[str]) -> Iterator[Kitti360Box]:
    """Boxes of the classes in ``LABEL_OF``, one by one.

    Args:
        path: the XML file.
        left_out: filled with what is not read (``that are not cuboids``) and how often.

    Raises:
        InputError: missing, cut off, malformed, or it declares XML entities.
    """
    for number, item in enumerate(_objects(path)):
        where = f"{path}: object {number} ({item.tag})"
        if item.find("transform") is None:
            continue
        note_unknown(path.name, [field.tag for field in item], _OFFICIAL)
        label = _label(item, where)
        if label not in LABEL_OF:
            left_out["of classes that do not move"] += 1
            continue
        frame = _integer(item, "timestamp", where)
        shape = _shape(_matrix(item, "transform", where), _matrix(item, "vertices", where), label, where)
        if shape is None:
            left_out["that are not cuboids"] += 1
            continue
        size_m, pose = shape
        if item.find("start_frame") is not None:
            window = (_integer(item, "start_frame", where), _integer(item, "end_frame", where))
        else:
            window = (0, 2**31) if frame < 0 else (frame, frame)
        yield Kitti360Box(_object_id(item, frame, where), label, frame, window, size_m, pose)


def _objects(path: Path) -> Iterator[ElementTree.Element]:
    """The children of the top element, each freed after use."""
    parser = ElementTree.XMLPullParser(("start", "end"))
    depth = 0
    top: ElementTree.Element | None = None
    tail = b""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError("box file is too large", where=str(path), expected=f"<= {MAX_FILE_BYTES} bytes")
        with store.open_file(path) as handle:
            while chunk := handle.read(_CHUNK):
                _refuse_entities(tail + chunk, str(path), first=not tail)
                tail = chunk[-16:]
                parser.feed(chunk)
                events: Iterator[Any] = parser.read_events()
                for event, element in events:
                    if event == "start":
                        depth += 1
                        top = element if depth == 1 else top
                    else:
                        depth -= 1
                        if depth == 1:
                            yield element
                            element.clear()
                            if top is not None:
                                top.clear()
        parser.close()
    except FileNotFoundError as error:
        raise InputError("box file does not exist", where=str(path)) from error
    except OSError as error:
        raise InputError("box file cannot be read", where=str(path), got=str(error)) from error
    except ElementTree.ParseError as error:
        raise InputError("box file is not valid XML (is it cut off?)", where=str(path), got=str(error)) from error


def _refuse_entities(content: bytes, where: str, first: bool) -> None:
    """Entities can blow a small file up; other encodings could hide them from this look."""
    head = content[:200].lower()
    other = first and b"encoding" in head and not any(name in head for name in (b"utf-8", b"ascii"))
    if b"<!ENTITY" in content or b"<!DOCTYPE" in content or b"\0" in content or other:
        raise InputError(
            "box file declares a document type, entities or another encoding, which the data set's files do not",
            where=where, remedy="use the file from the data set")  # fmt: skip


def _label(item: ElementTree.Element, where: str) -> str:
    if item.find("semanticId") is not None:
        return LABEL_OF_ID.get(_integer(item, "semanticId", where), "")
    text = (item.findtext("label") or "").strip()
    return "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in text).strip()


def _object_id(item: ElementTree.Element, frame: int, where: str) -> str:
    if item.find("instanceId") is not None and item.find("semanticId") is not None:
        return f"{_integer(item, 'semanticId', where)}-{_integer(item, 'instanceId', where)}"
    if frame >= 0 and item.find("dynamicSeq") is not None:
        return f"d-{_integer(item, 'dynamicSeq', where)}"
    return f"i-{_integer(item, 'index', where)}"


def _integer(item: ElementTree.Element, key: str, where: str) -> int:
    text = item.findtext(key)
    try:
        return int(text) if text is not None else int("")
    except ValueError as error:
        raise InputError(f"field {key!r} is missing or no whole number", where=where, got=repr(text)[:40]) from error


def _matrix(item: ElementTree.Element, key: str, where: str) -> Matrix:
    node = item.find(key)
    if node is None:
        raise InputError(f"box has no {key}", where=where)
    rows, columns = _integer(node, "rows", f"{where}.{key}"), _integer(node, "cols", f"{where}.{key}")
    texts = (node.findtext("data") or "").split()
    if rows * columns != len(texts) or not 0 < rows * columns <= _MAX_VALUES:
        raise InputError("matrix does not have the size it declares", where=f"{where}.{key}",
            expected=f"{rows} x {columns} numbers", got=f"{len(texts)} values")  # fmt: skip
    try:
        values = np.array([float(text) for text in texts])
    except ValueError as error:
        raise InputError("matrix holds no number", where=f"{where}.{key}", got=str(error)) from error
    if not np.isfinite(values).all():
        raise InputError("matrix holds a value that is not finite", where=f"{where}.{key}")
    return values.reshape(rows, columns)


def _shape(
    transform: Matrix, vertices: Matrix, label: str, where: str
) -> tuple[tuple[float, float, float], Matrix] | None:
    """Size and pose of the box, or None if it is sheared.

    The axis that stands upright becomes z. Of the others, the first becomes x, for vehicles the longer one: which of them
    the annotation tool called x does not matter for the box.
    """
    if transform.shape != (4, 4) or vertices.shape[1] != 3 or np.abs(transform[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError("box is not a 4x4 transform of 3-D vertices", where=where,
            got=f"transform {transform.shape} ending {transform[-1].tolist()}, vertices {vertices.shape}")  # fmt: skip
    low, high = vertices.min(0), vertices.max(0)
    scale = np.linalg.norm(transform[:3, :3], axis=0)
    sizes = scale * (high - low)
    if (sizes <= 0).any():
        raise InputError("box size is not positive", where=where, got=str(sizes.tolist()))
    axes = transform[:3, :3] / scale
    if max(abs(axes[:, a] @ axes[:, b]) for a, b in ((0, 1), (0, 2), (1, 2))) > _MAX_SHEAR:
        return None
    up = int(np.abs(axes[2]).argmax())
    first, second = (index for index in range(3) if index != up)
    if label in VEHICLES and sizes[second] > sizes[first]:
        first, second = second, first
    z = axes[:, up] * (1 if axes[2, up] > 0 else -1)
    x = axes[:, first] - z * (axes[:, first] @ z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z], 1)
    centre = transform[:3, :3] @ ((low + high) / 2) + transform[:3, 3]
    return (float(sizes[first]), float(sizes[second]), float(sizes[up])), from_rotation_translation(rotation, centre)
