"""Gaussians of GLB files with KHR_gaussian_splatting, in the axes and the place that the file's scene gives them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import InputError
from mudg.core.sh import C0
from mudg.data.splats import binary
from mudg.data.splats.cloud import LEAST_LOG, SplatCloud, checked, joined, logit, unit
from mudg.data.splats.gltf import BIN_CHUNK, EXTENSION, JSON_CHUNK, MAGIC, PREFIX

_KINDS: Final = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MOST_JSON: Final = 64 << 20
_DEPTH: Final = 32

Array = NDArray[np.float64]


def from_bytes(content: bytes, where: str) -> SplatCloud:
    """The Gaussians of a GLB file, all meshes where the scene's nodes put them (without its animations), in the axes of the file.

    Raises:
        InputError: no GLB file, one without Gaussians, or a damaged one.
    """
    file = _GlbFile(content, where)
    clouds = []
    for matrix, mesh in file.placed():
        for primitive in file.entries(mesh, "primitives"):
            extensions = primitive.get("extensions")
            if isinstance(extensions, dict) and EXTENSION in extensions:
                clouds.append(_moved(file.cloud(primitive, extensions[EXTENSION]), matrix, where))
    if not clouds:
        raise InputError("the GLB file holds no Gaussians", where=where, expected=f"meshes with {EXTENSION}",
            remedy="triangles and points cannot be imported")  # fmt: skip
    return joined(clouds)


def _moved(cloud: SplatCloud, matrix: Array, where: str) -> SplatCloud:
    """A cloud under a node's matrix: rotation, translation, and one positive scale for all axes."""
    if np.array_equal(matrix, np.eye(4)):
        return cloud
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not np.isfinite(scale) or scale <= 0 or geometry.rigid_problem(rigid := _without_scale(matrix, scale), 1e-3):
        raise InputError(
            "a node of the GLB file is mirrored or scaled unevenly", where=where, got=str(matrix[:3, :3].tolist())
        )
    if scale != 1:
        grown = (cloud.means * np.float32(scale)).astype(np.float32)
        logs = (cloud.log_scales + np.float32(np.log(scale))).astype(np.float32)
        cloud = checked(SplatCloud(grown, cloud.quats, logs, cloud.logits, cloud.sh), where)
    return cloud.moved(rigid)


def _without_scale(matrix: Array, scale: float) -> Array:
    rigid = matrix.copy()
    rigid[:3, :3] /= scale
    return rigid


class _GlbFile:
    """The JSON document and the binary chunk, every index checked before it is used."""

    def __init__(self, content: bytes, where: str) -> None:
        self.where = where
        magic, version, size = binary.unpacked("<III", content, 0, "the header", where)
        if magic != MAGIC:
            raise InputError("not a GLB file", where=where, expected="the first bytes glTF", got=repr(content[:4]))
        if version != 2:
            raise InputError("this version of glTF is not read", where=where, expected="2", got=str(version))
        if size != len(content):
            raise InputError("the GLB file has another length than it says", where=where, expected=f"{size} bytes", got=f"{len(content)}",
                remedy="it was cut off: get it again")  # fmt: skip
        length, kind = binary.unpacked("<II", content, 12, "the first chunk", where)
        if kind != JSON_CHUNK or length > _MOST_JSON:
            raise InputError(
                "the first chunk of a GLB file is its JSON document", where=where, got=f"{length} bytes of {kind:#x}"
            )
        text = bytes(binary.part(content, 20, length, "the JSON chunk", where))
        document = store.parse_json(text.decode("utf-8", "replace"), f"{where}: JSON")
        if not isinstance(document, dict):
            raise InputError("the document of a GLB file is an object", where=f"{where}: JSON")
        self.document: dict[str, Any] = document
        self.binary = memoryview(b"")
        self.total = 0
        place = 20 + length
        if place < len(content):
            length, kind = binary.unpacked("<II", content, place, "the second chunk", where)
            if kind == BIN_CHUNK:
                self.binary = binary.part(content, place + 8, length, "the binary chunk", where)

    def entries(self, owner: dict[str, Any], name: str) -> list[dict[str, Any]]:
        """A list of objects in the document; empty if it is not there."""
        found = owner.get(name, [])
        if not isinstance(found, list) or any(not isinstance(entry, dict) for entry in found):
            raise InputError(f"{name} is no list of objects", where=f"{self.where}: JSON")
        return found

    def entry(self, name: str, index: Any) -> dict[str, Any]:
        """The object that an index names."""
        found = self.entries(self.document, name)
        if type(index) is not int or not 0 <= index < len(found):
            raise InputError(f"an index names nothing in {name}", where=f"{self.where}: JSON", expected=f"0 to {len(found) - 1}",
                got=repr(index)[:40])  # fmt: skip
        return found[index]

    def number(self, owner: dict[str, Any], name: str, default: int) -> int:
        """A whole number that is not negative."""
        value = owner.get(name, default)
        if type(value) is not int or not 0 <= value < 1 << 40:
            raise InputError(f"{name} is no size", where=f"{self.where}: JSON", got=repr(value)[:40])
        return value

    def vector(self, owner: dict[str, Any], name: str, default: tuple[float, ...]) -> Array:
        """A list of finite numbers."""
        value = owner.get(name, default)
        if (
            not isinstance(value, list | tuple)
            or len(value) != len(default)
            or any(type(v) not in (int, float) for v in value)
        ):
            raise InputError(
                f"{name} is no list of {len(default)} numbers", where=f"{self.where}: JSON", got=repr(value)[:60]
            )
        try:
            made = np.array(value, np.float64)
        except OverflowError as error:
            raise InputError(f"{name} holds a number that is too large", where=f"{self.where}: JSON") from error
        if not np.isfinite(made).all():
            raise InputError(f"{name} holds a number that is not finite", where=f"{self.where}: JSON")
        return made

    # -- nodes -----------------------------------------------------------------------------------------------------------

    def placed(self) -> Iterator[tuple[Array, dict[str, Any]]]:
        """Matrix and mesh of every node of the scene."""
        scene = self.entry("scenes", self.document.get("scene", 0))
        waiting = [(np.eye(4), index, 0) for index in self._indices(scene, "nodes")]
        seen: set[int] = set()
        while waiting:
            matrix, index, depth = waiting.pop(0)
            node = self.entry("nodes", index)
            if index in seen or depth > _DEPTH:
                raise InputError(
                    "the nodes of the GLB file are no tree", where=f"{self.where}: JSON", got=f"node {index} twice"
                )
            seen.add(index)
            matrix = matrix @ self._matrix(node)
            if "mesh" in node:
                yield matrix, self.entry("meshes", node["mesh"])
            waiting += [(matrix, child, depth + 1) for child in self._indices(node, "children")]

    def _indices(self, owner: dict[str, Any], name: str) -> list[int]:
        found = owner.get(name, [])
        if not isinstance(found, list) or any(type(index) is not int for index in found):
            raise InputError(f"{name} is no list of indices", where=f"{self.where}: JSON", got=repr(found)[:60])
        return found

    def _matrix(self, node: dict[str, Any]) -> Array:
        if "matrix" in node:
            return self.vector(node, "matrix", tuple(np.eye(4).reshape(-1))).reshape(4, 4).T
        quat = unit(self.vector(node, "rotation", (0.0, 0.0, 0.0, 1.0))[None, [3, 0, 1, 2]], f"{self.where}: JSON")[0]
        matrix = geometry.from_rotation_translation(
            geometry.matrix_from_quaternion(quat), self.vector(node, "translation", (0.0,) * 3)
        )
        scale = self.vector(node, "scale", (1.0, 1.0, 1.0))
        if (scale < 1e-5).all():  # a node that an animation hides
            scale = np.ones(3)
        matrix[:3, :3] *= scale
        return matrix

    # -- accessors -------------------------------------------------------------------------------------------------------

    def cloud(self, primitive: dict[str, Any], kind: Any) -> SplatCloud:
        """The Gaussians of a primitive, in the frame of its node."""
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict) or not isinstance(kind, dict):
            raise InputError("a primitive has no attributes", where=f"{self.where}: JSON")
        if kind.get("kernel", "ellipse") != "ellipse":
            raise InputError(
                "only ellipsoids are read", where=f"{self.where}: {EXTENSION}", got=repr(kind.get("kernel"))[:40]
            )
        means = self.values(attributes, "POSITION", 3)
        count = len(means)
        self.total += count
        if self.total > len(self.binary):
            raise InputError(
                "the nodes of the GLB file repeat its Gaussians too often",
                where=self.where,
                got=f"{self.total} Gaussians",
            )
        rotation = self.values(attributes, PREFIX + "ROTATION", 4, count)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.maximum(np.log(self.values(attributes, PREFIX + "SCALE", 3, count)), LEAST_LOG)
        opacity = self.values(attributes, PREFIX + "OPACITY", 1, count)[:, 0]
        degrees = [d for d in range(4) if f"{PREFIX}SH_DEGREE_{d}_COEF_0" in attributes]
        if degrees != list(range(len(degrees))) or not degrees:
            raise InputError(
                "the harmonics of a primitive leave a degree out", where=f"{self.where}: JSON", got=str(degrees)
            )
        sh = np.stack(
            [
                self.values(attributes, f"{PREFIX}SH_DEGREE_{d}_COEF_{n}", 3, count)
                for d in degrees
                for n in range(2 * d + 1)
            ],
            1,
        )
        if kind.get("colorSpace") == "lin_rec709_display":
            sh = _of_display(sh)
        columns = [values.astype(np.float32) for values in (means, rotation[:, [3, 0, 1, 2]], logs)]
        if not np.isfinite(opacity).all():
            raise InputError("the opacity of a Gaussian is not finite", where=self.where)
        return checked(SplatCloud(*columns, logit(opacity), sh.astype(np.float32)), self.where)

    def values(self, attributes: dict[str, Any], name: str, width: int, count: int | None = None) -> Array:
        """An attribute as f64[count, width], normalised integers as numbers."""
        if name not in attributes:
            raise InputError(
                "an attribute of the Gaussians is missing",
                where=self.where,
                expected=name,
                got=", ".join(attributes)[:160],
            )
        accessor = self.entry("accessors", attributes[name])
        component = accessor.get("componentType")
        if component not in _KINDS or _WIDTHS.get(str(accessor.get("type"))) != width or "sparse" in accessor:
            raise InputError("an attribute of the Gaussians has the wrong type", where=f"{self.where}: {name}", expected=f"{width} numbers",
                got=f"{accessor.get('type')} of {component}")  # fmt: skip
        rows, dtype = self.number(accessor, "count", 0), np.dtype(_KINDS[component])
        binary.refuse_count(rows, f"{self.where}: {name}")
        if count is not None and rows != count:
            raise InputError("the attributes of the Gaussians differ in length", where=f"{self.where}: {name}", expected=str(count),
                got=str(rows))  # fmt: skip
        view = self.entry("bufferViews", accessor.get("bufferView"))
        stride = self.number(view, "byteStride", 0) or width * dtype.itemsize
        begins, inner = self.number(view, "byteOffset", 0), self.number(accessor, "byteOffset", 0)
        size = (rows - 1) * stride + width * dtype.itemsize
        if (
            stride < width * dtype.itemsize
            or inner + size > self.number(view, "byteLength", 0)
            or begins + inner + size > len(self.binary)
        ):
            raise InputError(
                "an attribute reaches beyond the file's content", where=f"{self.where}: {name}", got=f"{size} bytes"
            )
        raw = np.ndarray((rows, width), dtype, self.binary, begins + inner, (stride, dtype.itemsize)).astype(np.float64)
        if dtype.kind == "f" or not accessor.get("normalized", False):
            return raw
        return np.maximum(raw / np.iinfo(dtype).max, -1.0)


def _of_display(sh: Array) -> Array:
    """Harmonics of linear light to such of display values: exact for the constant band, to first order for the others."""
    linear = np.maximum(sh[:, :1] * C0 + 0.5, 1e-4)
    display = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    slope = np.where(linear <= 0.0031308, 12.92, 1.055 / 2.4 * linear ** (1 / 2.4 - 1))
    return np.concatenate([(display - 0.5) / C0, sh[:, 1:] * slope], 1)
