"""glTF 2.0 with KHR_gaussian_splatting, as one GLB file; objects are nodes of their own, which an animation moves.

Axes: y up; (x, y, z) of this program is (x, z, -y). Quaternions x, y, z, w; scales in metres; opacities 0 to 1; one
accessor per harmonic. An animation's times begin at 0. Where an object does not exist, its node has the scale `HIDDEN`.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import InputError
from mudg.core.harmonics import C0
from mudg.formats.splats import binary
from mudg.formats.splats.cloud import (
    LEAST_LOG,
    SplatCloud,
    SplatFile,
    SplatNode,
    SplatScene,
    checked,
    in_words,
    joined,
    logit,
    spacing_m,
    unit,
)
from mudg.formats.unknown_fields import listed, sentence

EXTENSION: Final = "KHR_gaussian_splatting"
PREFIX: Final = EXTENSION + ":"
FLOAT: Final = 5126
HIDDEN: Final = 1e-6
MAGIC: Final = 0x46546C67
JSON_CHUNK, BIN_CHUNK = 0x4E4F534A, 0x004E4942
_SHAPES: Final = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class _Buffer:
    """The binary chunk and the accessors into it."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, values: NDArray[np.floating], bounds: bool = False, vertices: bool = True) -> int:
        """Values f32[n] or f32[n, c] as an accessor; returns its index."""
        rows = np.ascontiguousarray(values, "<f4")
        width = 1 if rows.ndim == 1 else rows.shape[1]
        content = rows.tobytes()
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": len(content)}
        self.views.append(view | ({"target": 34962} if vertices else {}))
        accessor: dict[str, Any] = {"bufferView": len(self.views) - 1, "componentType": FLOAT, "count": len(rows)}
        accessor["type"] = _SHAPES[width]
        if bounds:
            low, high = rows.reshape(len(rows), -1).min(0), rows.reshape(len(rows), -1).max(0)
            accessor |= {"min": low.astype(float).tolist(), "max": high.astype(float).tolist()}
        self.accessors.append(accessor)
        self.parts.append(content)
        self.size += len(content)
        return len(self.accessors) - 1


def to_bytes(scene: SplatScene, time_s: float | None = None) -> bytes:
    """A scene as a GLB file: as it is at a time, in one mesh, or (None) with a node per object and an animation of
    their paths."""
    buffer = _Buffer()
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "mudg", "extras": dict(scene.facts)},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"name": scene.name, "nodes": []}],
        "nodes": [],
        "meshes": [],
    }
    channels, samplers = list[dict[str, Any]](), list[dict[str, Any]]()
    nodes = scene.nodes if time_s is None else (SplatNode("scene", scene.at(time_s)),)
    for node in nodes:
        cloud = middle_shape(node) if node.moves or time_s is not None else node.cloud.moved(scene.file_from_world)
        if not len(cloud):
            continue
        document["meshes"].append({"name": node.name, "primitives": [_primitive(buffer, cloud)]})
        index = len(document["nodes"])
        place = _placed(scene, node, index, (buffer, channels, samplers))
        document["nodes"].append({"name": node.name, "mesh": len(document["meshes"]) - 1, **place})
        document["scenes"][0]["nodes"].append(index)
    if channels:
        document["animations"] = [{"name": "drive", "channels": channels, "samplers": samplers}]
    document |= {"accessors": buffer.accessors, "bufferViews": buffer.views, "buffers": [{"byteLength": buffer.size}]}
    return glb(document, b"".join(buffer.parts))


def glb(document: dict[str, Any], content: bytes) -> bytes:
    """A JSON document and its binary chunk as one file."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    content += bytes(-len(content) % 4)
    size = 12 + 8 + len(text) + 8 + len(content)
    head = struct.pack("<III", MAGIC, 2, size) + struct.pack("<II", len(text), JSON_CHUNK)
    return head + text + struct.pack("<II", len(content), BIN_CHUNK) + content


def _primitive(buffer: _Buffer, cloud: SplatCloud) -> dict[str, Any]:
    color = (cloud.sh[:, 0] * C0 + 0.5).clip(0, 1).astype(np.float64)
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    attributes = {
        "POSITION": buffer.add(cloud.means, bounds=True),
        "COLOR_0": buffer.add(np.column_stack([linear, cloud.opacity])),
        PREFIX + "ROTATION": buffer.add(cloud.quats[:, [1, 2, 3, 0]]),
        PREFIX + "SCALE": buffer.add(np.exp(cloud.log_scales.astype(np.float64))),
        PREFIX + "OPACITY": buffer.add(cloud.opacity),
    }
    for degree in range(cloud.degree + 1):
        for order in range(2 * degree + 1):
            attributes[f"{PREFIX}SH_DEGREE_{degree}_COEF_{order}"] = buffer.add(cloud.sh[:, degree**2 + order])
    kind = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    kind |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    return {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: kind}}


def _placed(
    scene: SplatScene, node: SplatNode, index: int, into: tuple[_Buffer, list[dict[str, Any]], list[dict[str, Any]]]
) -> dict[str, Any]:
    """The pose of a node at its first key, and its animation."""
    if not node.moves:
        return {}
    buffer, channels, samplers = into
    start_s = scene.span_s[0]
    poses = scene.file_from_world @ node.world_from_node
    quats = np.stack([geometry.quaternion_from_matrix(pose) for pose in poses])[:, [1, 2, 3, 0]]
    times = rising(node.times_s - start_s)

    def animate(path: str, moments: NDArray[np.float32], values: NDArray[np.floating], how: str = "LINEAR") -> None:
        given, made = buffer.add(moments, True, False), buffer.add(values, False, False)
        samplers.append({"input": given, "output": made, "interpolation": how})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": index, "path": path}})

    animate("translation", times, poses[:, :3, 3])
    animate("rotation", times, quats)
    first, last = float(times[0]), float(times[-1])
    shown = [(0.0, HIDDEN), (first, 1.0)] if first > 0 else [(0.0, 1.0)]
    if last < scene.span_s[1] - start_s - 1e-4:
        shown.append((float(np.nextafter(np.float32(last), np.float32(np.inf))), HIDDEN))
    if len(shown) > 1:
        scales = np.repeat([[size] for _, size in shown], 3, 1)
        animate("scale", np.array([moment for moment, _ in shown], np.float32), scales, "STEP")
    found: dict[str, Any] = {"translation": poses[0, :3, 3].tolist(), "rotation": quats[0].tolist()}
    if shown[0][1] != 1.0:
        found["scale"] = [HIDDEN] * 3
    facts: dict[str, Any] = {"label": node.label, "size_m": list(node.size_m)}
    return found | {"extras": facts}


def middle_shape(node: SplatNode) -> SplatCloud:
    """The Gaussians of a node, bent as in the middle of its track."""
    if node.displacement is None:
        return node.cloud
    moved = node.displacement[len(node.displacement) // 2]
    return replace(node.cloud, means=(node.cloud.means + moved).astype(np.float32))


def rising(times: NDArray[np.float64]) -> NDArray[np.float32]:
    """Times as f32 that still rise strictly, and never fall below 0."""
    made = np.maximum(times, 0).astype(np.float32)
    for index in range(1, len(made)):
        if made[index] <= made[index - 1]:
            made[index] = np.nextafter(made[index - 1], np.float32(np.inf))
    return made


# gltf read ----------------------------------------------------------------------------------------
#
# Gaussians of GLB files with KHR_gaussian_splatting, in the axes and the place that the file's scene gives them.


_KINDS: Final = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_READ: Final = (EXTENSION, "KHR_mesh_quantization", "KHR_node_visibility", "KHR_materials_unlit")
"""Extensions without which a file can be read, or that are read."""
_LINEAR: Final = {"srgb_rec709_display": False, "lin_rec709_display": True, "BT.709-sRGB": False, "BT.709-linear": True}
"""Colour spaces and whether they are linear; the last two are names of the drafts."""
_KIND: Final = ("kernel", "colorSpace", "projection", "sortingMethod", "extensions", "extras")
_STANDARD: Final[Mapping[str, frozenset[str]]] = {
    owner: frozenset(f"{fields} extensions extras".split())
    for owner, fields in {
        "": "accessors animations asset buffers bufferViews cameras extensionsRequired extensionsUsed images materials "
        "meshes nodes samplers scene scenes skins textures",
        "nodes.": "camera children matrix mesh name rotation scale skin translation weights",
        "primitives.": "attributes indices material mode targets",
        "accessors.": "bufferView byteOffset componentType count max min name normalized sparse type",
    }.items()
}
"""Objects of glTF 2.0 -> their fields, read or not; ``extras`` belong to users."""
_ATTRIBUTE: Final = re.compile(
    r"POSITION|NORMAL|TANGENT|(TEXCOORD|COLOR|JOINTS|WEIGHTS)_\d+|" + re.escape(PREFIX) + r".*", re.DOTALL
)
_ROUNDING: Final = 1e-3
_MOST_JSON: Final = 64 << 20
_DEPTH: Final = 32

Array = NDArray[np.float64]


def from_bytes(content: bytes, where: str) -> SplatFile:
    """The Gaussians of a GLB file, all meshes where the scene's nodes put them (without its animations), in the axes of
    the file. Fields that it does not know are passed over, unless the file says that they are required. Raises
    InputError: no GLB file, one without Gaussians, or a damaged one."""
    file = _GlbFile(content, where)
    clouds, triangles = [], 0
    for matrix, mesh in file.placed():
        for primitive in file.entries(mesh, "primitives"):
            extensions = primitive.get("extensions")
            if isinstance(extensions, dict) and EXTENSION in extensions:
                clouds.append(_moved(file.cloud(primitive, extensions[EXTENSION]), matrix, where))
            else:
                triangles += 1
    if not clouds:
        what, expected = "the GLB file holds no Gaussians", f"meshes with {EXTENSION}"
        raise InputError(what, where=where, expected=expected, remedy="triangles and points cannot be imported")
    if triangles:
        file.warn(f"{triangles} meshes without Gaussians were passed over")
    if file.entries(file.document, "animations"):
        file.warn("its animations are not read: everything is where the nodes put it at rest")
    notes: tuple[str, ...] = ()
    if file.passed:
        notes = (sentence(sorted(file.passed), "the document"),)
    axes = "RDF" if file.of_old_transform(2) else ""
    if axes:
        file.warn(f"{file.generator} wrote {in_words(axes)}, where glTF has y up: read so; --axes viewer reads as glTF")
    cloud = replace(joined(clouds), antialias=file.antialias)
    return SplatFile(cloud, axes, f"its program {file.generator}", file.step_m, notes, tuple(file.warnings))


def _moved(cloud: SplatCloud, matrix: Array, where: str) -> SplatCloud:
    """A cloud under a node's matrix: rotation, translation, and one positive scale for all axes."""
    if np.array_equal(matrix, np.eye(4)):
        return cloud
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    rigid = matrix.copy()
    if np.isfinite(scale) and scale > 0:
        rigid[:3, :3] /= scale
    if not np.isfinite(scale) or scale <= 0 or geometry.rigid_problem(rigid, 1e-3):
        what = "a node of the GLB file is mirrored or scaled unevenly"
        remedy = "apply the scale of the node to its Gaussians in the program that wrote the file"
        raise InputError(what, where=where, got=str(matrix[:3, :3].tolist()), remedy=remedy)
    if scale != 1:
        logs = (cloud.log_scales + np.float32(np.log(scale))).astype(np.float32)
        cloud = checked(replace(cloud, means=cloud.means * scale, log_scales=logs), where)
    return cloud.moved(rigid)


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
            what, remedy = "the GLB file has another length than it says", "it was cut off: get it again"
            raise InputError(what, where=where, expected=f"{size} bytes", got=f"{len(content)}", remedy=remedy)
        length, kind = binary.unpacked("<II", content, 12, "the first chunk", where)
        if kind != JSON_CHUNK or length > _MOST_JSON:
            what = "the first chunk of a GLB file is its JSON document"
            raise InputError(what, where=where, got=f"{length} bytes of {kind:#x}")
        text = bytes(binary.part(content, 20, length, "the JSON chunk", where))
        document = store.parse_json(text.decode("utf-8", "replace"), f"{where}: JSON")
        if not isinstance(document, dict):
            raise InputError("the document of a GLB file is an object", where=f"{where}: JSON")
        self.document: dict[str, Any] = document
        self.binary = memoryview(b"")
        self.total, self.step_m = 0, 0.0
        self.passed: set[str] = set()
        self.warnings = dict[str, None]()  # each once, in order
        asset = document.get("asset")
        asset = asset if isinstance(asset, dict) else {}
        self.generator = "".join(c for c in str(asset.get("generator", ""))[:60] if c.isprintable())
        extras = asset.get("extras")
        drawing = extras.get("drawing") if isinstance(extras, dict) else None
        self.antialias = isinstance(drawing, dict) and drawing.get("antialias") is True
        self._note("", document)
        self._check_extensions()
        place = 20 + length
        if place < len(content):
            length, kind = binary.unpacked("<II", content, place, "the second chunk", where)
            if kind == BIN_CHUNK:
                self.binary = binary.part(content, place + 8, length, "the binary chunk", where)

    def warn(self, sentence: str) -> None:
        """Say something of the file once."""
        self.warnings[sentence] = None

    def _note(self, within: str, owner: dict[str, Any]) -> None:
        """Note the fields of an object of the document that glTF does not have."""
        self.passed.update(f"{within}{name}" for name in owner if name not in _STANDARD[within])

    def _check_extensions(self) -> None:
        """Refuse a file that cannot be read without extensions that are not known here; list those that it can be read
        without."""
        for name in ("extensionsRequired", "extensionsUsed"):
            stated = self.document.get(name, [])
            if not isinstance(stated, list) or any(not isinstance(one, str) for one in stated):
                raise InputError(f"{name} is no list of names", where=f"{self.where}: JSON", got=repr(stated)[:60])
            unknown = [one for one in stated if one not in _READ]
            if unknown and name == "extensionsRequired":
                what, where = "the GLB file needs an extension that is not read", f"{self.where}: JSON"
                remedy = "write the file without it, or as SPZ"
                raise InputError(what, where=where, got=listed(unknown), expected=", ".join(_READ), remedy=remedy)
            self.passed.update(unknown)

    def of_old_transform(self, before: int) -> bool:
        """Whether splat-transform of a major version below this one wrote the file."""
        match = re.match(r"splat-transform v?(\d{1,4})\.", self.generator)
        return match is not None and int(match[1]) < before

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
            what = f"an index names nothing in {name}"
            raise InputError(what, where=f"{self.where}: JSON", expected=f"0 to {len(found) - 1}", got=repr(index)[:40])
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
            what = f"{name} is no list of {len(default)} numbers"
            raise InputError(what, where=f"{self.where}: JSON", got=repr(value)[:60])
        try:
            made = np.array(value, np.float64)
        except OverflowError as error:
            raise InputError(f"{name} holds a number that is too large", where=f"{self.where}: JSON") from error
        if not np.isfinite(made).all():
            raise InputError(f"{name} holds a number that is not finite", where=f"{self.where}: JSON")
        return made

    # -- nodes -------------------------------------------------------------------------------------

    def placed(self) -> Iterator[tuple[Array, dict[str, Any]]]:
        """Matrix and mesh of every node of the scene."""
        scene = self.entry("scenes", self.document.get("scene", 0))
        waiting = [(np.eye(4), index, 0) for index in self._indices(scene, "nodes")]
        seen: set[int] = set()
        while waiting:
            matrix, index, depth = waiting.pop(0)
            node = self.entry("nodes", index)
            if index in seen or depth > _DEPTH:
                what = "the nodes of the GLB file are no tree"
                raise InputError(what, where=f"{self.where}: JSON", got=f"node {index} twice")
            seen.add(index)
            self._note("nodes.", node)
            matrix = matrix @ self._matrix(node)
            extensions = node.get("extensions")
            extensions = extensions if isinstance(extensions, dict) else {}
            visible = extensions.get("KHR_node_visibility")
            if isinstance(visible, dict) and visible.get("visible") is False:
                self.warn("nodes that the file hides were left out")
                continue
            if "EXT_mesh_gpu_instancing" in extensions:
                self.warn("instances (EXT_mesh_gpu_instancing) are not read: their mesh is there once")
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

    # -- accessors ---------------------------------------------------------------------------------

    def cloud(self, primitive: dict[str, Any], kind: Any) -> SplatCloud:
        """The Gaussians of a primitive, in the frame of its node."""
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict) or not isinstance(kind, dict):
            raise InputError("a primitive has no attributes", where=f"{self.where}: JSON")
        if kind.get("kernel", "ellipse") != "ellipse":
            what = "only ellipsoids are read"
            raise InputError(what, where=f"{self.where}: {EXTENSION}", got=repr(kind.get("kernel"))[:40])
        space = kind.get("colorSpace")
        if space is None:
            self.warn("it names no colorSpace, which the standard requires: read as sRGB")
        elif not isinstance(space, str) or space not in _LINEAR:
            what, where = "the colour space of the Gaussians is not known", f"{self.where}: {EXTENSION}: colorSpace"
            remedy = "convert the colours to sRGB"
            raise InputError(what, where=where, expected=", ".join(_LINEAR), got=repr(space)[:60], remedy=remedy)
        self._note("primitives.", primitive)
        self.passed.update(f"attributes.{name}" for name in attributes if not _ATTRIBUTE.fullmatch(name))
        inner = kind.get("extensions")
        compressed = [name for name in inner if "compression" in name] if isinstance(inner, dict) else []
        if compressed:
            what, where = "the Gaussians of the GLB file are compressed", f"{self.where}: {EXTENSION}"
            got, expected = listed(compressed), "attributes without compression"
            raise InputError(what, where=where, got=got, expected=expected, remedy="write it without, or as SPZ")
        self.passed.update(f"{EXTENSION}.{name}" for name in kind if name not in _KIND)
        self.passed.update(f"{EXTENSION}.extensions.{name}" for name in (inner if isinstance(inner, dict) else ()))
        for name, usual in (("projection", "perspective"), ("sortingMethod", "cameraDistance")):
            if kind.get(name, usual) != usual:
                self.warn(f"{name} {kind[name]!r:.40} is not drawn: {usual} instead")
        means = self.values(attributes, "POSITION", 3)
        count = len(means)
        self.total += count
        if self.total > len(self.binary):
            what = "the nodes of the GLB file repeat its Gaussians too often"
            raise InputError(what, where=self.where, got=f"{self.total} Gaussians")
        rotation = self.values(attributes, PREFIX + "ROTATION", 4, count)
        if np.abs(np.linalg.norm(rotation, axis=1) - 1).max(initial=0) > 0.05:
            self.warn("rotations are not of length 1, as the standard requires: they were brought to it")
        scale = self.values(attributes, PREFIX + "SCALE", 3, count)
        opacity = self.values(attributes, PREFIX + "OPACITY", 1, count)[:, 0]
        if not np.isfinite(opacity).all():
            raise InputError("the opacity of a Gaussian is not finite", where=self.where)
        logits, logs = self._logits_and_logs(opacity, scale)
        degrees = [d for d in range(4) if f"{PREFIX}SH_DEGREE_{d}_COEF_0" in attributes]
        if degrees != list(range(len(degrees))) or not degrees:
            what = "the harmonics of a primitive leave a degree out"
            raise InputError(what, where=f"{self.where}: JSON", got=str(degrees))
        bands = [f"{PREFIX}SH_DEGREE_{degree}_COEF_{order}" for degree in degrees for order in range(2 * degree + 1)]
        sh = np.stack([self.values(attributes, band, 3, count) for band in bands], 1)
        if _LINEAR.get(str(space), False):
            sh = _of_display(sh)
        read = tuple(f"{PREFIX}SH_DEGREE_{d}_" for d in degrees)
        beyond = [name for name in attributes if name.startswith(f"{PREFIX}SH_DEGREE_") and not name.startswith(read)]
        if beyond:
            self.warn(f"harmonics beyond degree 3 were dropped: {listed(beyond)}")
        self.step_m = max(self.step_m, spacing_m(means))
        columns = [values.astype(np.float32) for values in (rotation[:, [3, 0, 1, 2]], logs, logits, sh)]
        return checked(SplatCloud(means, *columns), self.where)

    def _logits_and_logs(self, opacity: Array, scale: Array) -> tuple[NDArray[np.floating], Array]:
        """Logits f64[n] and logarithms f64[n, 3]; a program that is known for it wrote these in place of opacities and
        sizes."""
        raw = (scale < 0).any() or (opacity < -_ROUNDING).any() or (opacity > 1 + _ROUNDING).any()
        if raw and self.of_old_transform(3):
            self.warn(f"{self.generator} wrote logits and logarithms, where glTF has opacities and sizes: read so")
            return opacity, scale
        if (bad := (opacity < -_ROUNDING) | (opacity > 1 + _ROUNDING)).any():
            row = int(bad.argmax())
            what = "the opacity of a Gaussian is not between 0 and 1"
            got = f"{opacity[row]:.4g}; {int(bad.sum())} of {len(opacity)}: they look like logits"
            remedy = "write 1 / (1 + exp(-logit)) into the file"
            raise InputError(what, where=f"{self.where}: Gaussian {row}", expected="0 to 1", got=got, remedy=remedy)
        if raw:
            row = int((scale < 0).any(1).argmax())
            what, where = "the size of a Gaussian is negative", f"{self.where}: Gaussian {row}"
            got = f"{scale[row].tolist()}: they look like logarithms"
            raise InputError(what, where=where, expected="metres", got=got, remedy="write exp(scale) into the file")
        with np.errstate(divide="ignore", invalid="ignore"):
            return logit(opacity), np.maximum(np.log(scale), LEAST_LOG)

    def values(self, attributes: dict[str, Any], name: str, width: int, count: int | None = None) -> Array:
        """An attribute as f64[count, width], normalised integers as numbers."""
        if name not in attributes:
            what = "an attribute of the Gaussians is missing"
            raise InputError(what, where=self.where, expected=name, got=", ".join(attributes)[:160])
        accessor = self.entry("accessors", attributes[name])
        self._note("accessors.", accessor)
        component = accessor.get("componentType")
        if component not in _KINDS or _WIDTHS.get(str(accessor.get("type"))) != width or "sparse" in accessor:
            what, got = "an attribute of the Gaussians has the wrong type", f"{accessor.get('type')} of {component}"
            raise InputError(what, where=f"{self.where}: {name}", expected=f"{width} numbers", got=got)
        rows, dtype = self.number(accessor, "count", 0), np.dtype(_KINDS[component])
        binary.refuse_count(rows, f"{self.where}: {name}")
        if count is not None and rows != count:
            what = "the attributes of the Gaussians differ in length"
            raise InputError(what, where=f"{self.where}: {name}", expected=str(count), got=str(rows))
        view = self.entry("bufferViews", accessor.get("bufferView"))
        packed = view.get("extensions")
        buffers = self.entries(self.document, "buffers")
        if view.get("buffer", 0) != 0 or packed or (buffers and "uri" in buffers[0]):
            what = "an attribute of the Gaussians lies outside the file, or is compressed"
            got = f"buffer {view.get('buffer', 0)!r:.20}, extensions {listed(packed or ())}"
            remedy = "pack the file with its buffers, without compression"
            raise InputError(what, where=f"{self.where}: {name}", expected="the binary chunk", got=got, remedy=remedy)
        stride = self.number(view, "byteStride", 0) or width * dtype.itemsize
        begins, inner = self.number(view, "byteOffset", 0), self.number(accessor, "byteOffset", 0)
        size = (rows - 1) * stride + width * dtype.itemsize
        if (
            stride < width * dtype.itemsize
            or inner + size > self.number(view, "byteLength", 0)
            or begins + inner + size > len(self.binary)
        ):
            what = "an attribute reaches beyond the file's content"
            raise InputError(what, where=f"{self.where}: {name}", got=f"{size} bytes")
        raw = np.ndarray((rows, width), dtype, self.binary, begins + inner, (stride, dtype.itemsize)).astype(np.float64)
        if dtype.kind == "f" or not accessor.get("normalized", False):
            return raw
        return np.maximum(raw / np.iinfo(dtype).max, -1.0)


def _of_display(sh: Array) -> Array:
    """Harmonics of linear light to such of display values: exact for the constant band, to first order for the
    others."""
    linear = np.maximum(sh[:, :1] * C0 + 0.5, 1e-4)
    display = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    slope = np.where(linear <= 0.0031308, 12.92, 1.055 / 2.4 * linear ** (1 / 2.4 - 1))
    return np.concatenate([(display - 0.5) / C0, sh[:, 1:] * slope], 1)
