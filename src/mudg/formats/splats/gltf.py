"""glTF 2.0 with KHR_gaussian_splatting, as one GLB file, y up: (x, y, z) of this program is (x, z, -y). Objects are
nodes of their own, which an animation from 0 s on moves; where one does not exist, its node has the scale ``HIDDEN``.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mudg.base import geometry, store
from mudg.base.errors import InputError
from mudg.base.records import ForeignRecord, Number, parse_record
from mudg.core.harmonics import C0
from mudg.formats.splats import binary
from mudg.formats.splats.cloud import (
    SplatCloud,
    SplatFile,
    SplatNode,
    SplatScene,
    checked,
    in_words,
    joined,
    logarithms,
    logit,
    refuse_rows,
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
    """The binary chunk, the accessors into it, and the animation of nodes."""

    def __init__(self) -> None:
        self.content = bytearray()
        self.views, self.accessors = list[dict[str, Any]](), list[dict[str, Any]]()
        self.channels, self.samplers = list[dict[str, Any]](), list[dict[str, Any]]()

    def add(self, values: NDArray[np.floating], bounds: bool = False, vertices: bool = True) -> int:
        """Values f32[n] or f32[n, c] as an accessor; returns its index."""
        rows = np.ascontiguousarray(values, "<f4").reshape(len(values), -1)
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": rows.nbytes}
        self.views.append(view | ({"target": 34962} if vertices else {}))
        accessor: dict[str, Any] = {"bufferView": len(self.views) - 1, "componentType": FLOAT, "count": len(rows)}
        accessor["type"] = _SHAPES[rows.shape[1]]
        if bounds:
            accessor |= {"min": rows.min(0).astype(float).tolist(), "max": rows.max(0).astype(float).tolist()}
        self.accessors.append(accessor)
        self.content += rows.tobytes()
        return len(self.accessors) - 1

    def animate(
        self, node: int, path: str, moments: NDArray[np.float32], values: NDArray[np.floating], how: str = "LINEAR"
    ) -> None:
        """Let ``path`` of a node (rotation, ...) take values at moments."""
        given, made = self.add(moments, True, False), self.add(values, False, False)
        self.samplers.append({"input": given, "output": made, "interpolation": how})
        self.channels.append({"sampler": len(self.samplers) - 1, "target": {"node": node, "path": path}})


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
    nodes = scene.nodes if time_s is None else (SplatNode("scene", scene.at(time_s)),)
    for node in nodes:
        cloud = middle_shape(node) if node.moves or time_s is not None else node.cloud.moved(scene.file_from_world)
        if not len(cloud):
            continue
        document["meshes"].append({"name": node.name, "primitives": [_primitive(buffer, cloud)]})
        index = len(document["nodes"])
        place = _placed(buffer, scene, node, index) if node.moves else {}
        document["nodes"].append({"name": node.name, "mesh": len(document["meshes"]) - 1, **place})
        document["scenes"][0]["nodes"].append(index)
    if buffer.channels:
        document["animations"] = [{"name": "drive", "channels": buffer.channels, "samplers": buffer.samplers}]
    document |= {"accessors": buffer.accessors, "bufferViews": buffer.views}
    return glb(document | {"buffers": [{"byteLength": len(buffer.content)}]}, bytes(buffer.content))


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


def _placed(buffer: _Buffer, scene: SplatScene, node: SplatNode, index: int) -> dict[str, Any]:
    """The pose of a node that moves at its first key, and its animation."""
    start_s = scene.span_s[0]
    poses = scene.file_from_world @ node.world_from_node
    quats = np.stack([geometry.quaternion_from_matrix(pose) for pose in poses])[:, [1, 2, 3, 0]]
    times = rising(node.times_s - start_s)
    buffer.animate(index, "translation", times, poses[:, :3, 3])
    buffer.animate(index, "rotation", times, quats)
    first, last = float(times[0]), float(times[-1])
    shown = [(0.0, HIDDEN), (first, 1.0)] if first > 0 else [(0.0, 1.0)]
    if last < scene.span_s[1] - start_s - 1e-4:
        shown.append((float(np.nextafter(np.float32(last), np.float32(np.inf))), HIDDEN))
    if len(shown) > 1:
        scales = np.repeat([[size] for _, size in shown], 3, 1)
        buffer.animate(index, "scale", np.array([moment for moment, _ in shown], np.float32), scales, "STEP")
    found: dict[str, Any] = {"translation": poses[0, :3, 3].tolist(), "rotation": quats[0].tolist()}
    if shown[0][1] != 1.0:
        found["scale"] = [HIDDEN] * 3
    return found | {"extras": {"label": node.label, "size_m": list(node.size_m)}}


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


# reading ------------------------------------------------------------------------------------------

_KINDS: Final = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_READ: Final = (EXTENSION, "KHR_mesh_quantization", "KHR_node_visibility", "KHR_materials_unlit")
"""Extensions without which a file can be read, or that are read."""
_ATTRIBUTE: Final = re.compile(
    r"POSITION|NORMAL|TANGENT|(TEXCOORD|COLOR|JOINTS|WEIGHTS)_\d+|" + re.escape(PREFIX) + r".*", re.DOTALL
)
_STANDARD: Final = frozenset(
    """extensions extras name camera skin weights indices material mode targets max min cameras images materials
    samplers skins textures""".split()
)
"""Fields of glTF 2.0 that are not read."""
_ROUNDING: Final = 1e-3
_MOST_JSON: Final = 64 << 20
_DEPTH: Final = 32

Array = NDArray[np.float64]
Size = Annotated[int, Field(ge=0, lt=1 << 40)]
Three = Annotated[list[Number], Field(min_length=3, max_length=3)]
Four = Annotated[list[Number], Field(min_length=4, max_length=4)]
Sixteen = Annotated[list[Number], Field(min_length=16, max_length=16)]


class _Node(ForeignRecord):
    children: list[Size] = []
    mesh: Size | None = None
    matrix: Sixteen | None = None
    rotation: Four = [0.0, 0.0, 0.0, 1.0]
    translation: Three = [0.0, 0.0, 0.0]
    scale: Three = [1.0, 1.0, 1.0]
    extensions: dict[str, Any] = {}


class _Primitive(ForeignRecord):
    attributes: dict[str, Size]
    extensions: dict[str, Any] = {}


class _Mesh(ForeignRecord):
    primitives: list[_Primitive] = []


class _Accessor(ForeignRecord):
    bufferView: Size
    byteOffset: Size = 0
    componentType: Literal[5120, 5121, 5122, 5123, 5126]
    count: Size
    type: str
    normalized: bool = False


class _View(ForeignRecord):
    buffer: Literal[0] = 0
    byteOffset: Size = 0
    byteLength: Size
    byteStride: Size = 0
    extensions: dict[str, Any] = {}


class _GltfScene(ForeignRecord):
    nodes: list[Size] = []


class _Document(ForeignRecord):
    asset: dict[str, Any] = {}
    extensionsUsed: list[str] = []
    extensionsRequired: list[str] = []
    scene: Size = 0
    scenes: list[_GltfScene] = []
    nodes: list[_Node] = []
    meshes: list[_Mesh] = []
    accessors: list[_Accessor] = []
    bufferViews: list[_View] = []
    buffers: list[dict[str, Any]] = []
    animations: list[Any] = []


class _Splatting(ForeignRecord):
    """The extension; the last two colour spaces are names of its drafts."""

    kernel: Literal["ellipse"] = "ellipse"
    colorSpace: Literal["srgb_rec709_display", "lin_rec709_display", "BT.709-sRGB", "BT.709-linear"] | None = None
    projection: Any = None
    sortingMethod: Any = None
    extensions: dict[str, Any] = {}


def from_bytes(content: bytes, where: str) -> SplatFile:
    """The Gaussians of a GLB file, all meshes where the scene's nodes put them (without its animations), in the axes of
    the file. Fields that it does not know are passed over, unless the file says that they are required. Raises
    InputError: no GLB file, one without Gaussians, or a damaged one."""
    file = _GlbFile(content, where)
    clouds, triangles = [], 0
    for matrix, mesh in file.placed():
        for primitive in mesh.primitives:
            if EXTENSION in primitive.extensions:
                clouds.append(_moved(file.cloud(primitive), matrix, where))
            else:
                triangles += 1
    if not clouds:
        what, expected = "the GLB file holds no Gaussians", f"meshes with {EXTENSION}"
        raise InputError(what, where=where, expected=expected, remedy="triangles and points cannot be imported")
    if triangles:
        file.warnings.append(f"{triangles} meshes without Gaussians were passed over")
    if file.document.animations:
        file.warnings.append("its animations are not read: everything is where the nodes put it at rest")
    notes = [sentence(sorted(file.passed), "the document")] if file.passed else []
    axes = "RDF" if file.of_old_transform(2) else ""
    if axes:
        reads = f"{file.generator} wrote {in_words(axes)}, where glTF has y up: read so"
        file.warnings.append(f"{reads}; --axes viewer reads as glTF")
    extras = file.document.asset.get("extras")
    drawing = extras.get("drawing") if isinstance(extras, dict) else None
    antialias = isinstance(drawing, dict) and drawing.get("antialias") is True
    cloud, warnings = replace(joined(clouds), antialias=antialias), list(dict.fromkeys(file.warnings))
    return SplatFile(cloud, axes, f"its program {file.generator}", file.step_m, notes, warnings)


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


Entry = TypeVar("Entry")


class _GlbFile:
    """The JSON document and the binary chunk, every index checked before it is used."""

    def __init__(self, content: bytes, where: str) -> None:
        self.where, self.total, self.step_m = where, 0, 0.0
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
        value = store.parse_json(text.decode("utf-8", "replace"), f"{where}: JSON")
        self.document = parse_record(_Document, value, f"{where}: JSON: ")
        self.binary, place = memoryview(b""), 20 + length
        if place < len(content):
            length, kind = binary.unpacked("<II", content, place, "the second chunk", where)
            if kind == BIN_CHUNK:
                self.binary = binary.part(content, place + 8, length, "the binary chunk", where)
        if unknown := [name for name in self.document.extensionsRequired if name not in _READ]:
            what, expected = "the GLB file needs an extension that is not read", ", ".join(_READ)
            remedy = "write the file without it, or as SPZ"
            raise InputError(what, where=f"{where}: JSON", got=listed(unknown), expected=expected, remedy=remedy)
        self.passed = {name for name in self.document.extensionsUsed if name not in _READ}
        self.warnings = list[str]()
        generator = str(self.document.asset.get("generator", ""))[:60]
        self.generator = "".join(letter for letter in generator if letter.isprintable())
        self.note("", self.document)
        for name in ("nodes", "accessors"):
            for record in getattr(self.document, name):
                self.note(f"{name}.", record)

    def note(self, within: str, record: ForeignRecord) -> None:
        """Note the fields of a record that glTF does not have."""
        self.passed.update(within + name for name in record.model_extra or () if name not in _STANDARD)

    def of_old_transform(self, before: int) -> bool:
        """Whether splat-transform of a major version below this one wrote the file."""
        match = re.match(r"splat-transform v?(\d{1,4})\.", self.generator)
        return match is not None and int(match[1]) < before

    def entry(self, name: str, entries: Sequence[Entry], index: int) -> Entry:
        """The object that an index names."""
        if index >= len(entries):
            what, expected = f"an index names nothing in {name}", f"below {len(entries)}"
            raise InputError(what, where=f"{self.where}: JSON", expected=expected, got=str(index))
        return entries[index]

    def placed(self) -> Iterator[tuple[Array, _Mesh]]:
        """Matrix and mesh of every node of the scene."""
        scene = self.entry("scenes", self.document.scenes, self.document.scene)
        waiting = [(np.eye(4), index, 0) for index in scene.nodes]
        seen: set[int] = set()
        while waiting:
            matrix, index, depth = waiting.pop(0)
            node = self.entry("nodes", self.document.nodes, index)
            if index in seen or depth > _DEPTH:
                what = "the nodes of the GLB file are no tree"
                raise InputError(what, where=f"{self.where}: JSON", got=f"node {index} twice")
            seen.add(index)
            if node.matrix is not None:
                own = np.array(node.matrix, np.float64).reshape(4, 4).T
            else:
                turn = unit(np.array([node.rotation])[:, [3, 0, 1, 2]], f"{self.where}: JSON")[0]
                scale = np.array(node.scale, np.float64)
                scale = np.ones(3) if (scale < 1e-5).all() else scale  # a node that an animation hides
                own = geometry.from_rotation_translation(
                    geometry.matrix_from_quaternion(turn), np.array(node.translation, np.float64)
                )
                own[:3, :3] *= scale
            matrix = matrix @ own
            visible = node.extensions.get("KHR_node_visibility")
            if isinstance(visible, dict) and visible.get("visible") is False:
                self.warnings.append("nodes that the file hides were left out")
                continue
            if "EXT_mesh_gpu_instancing" in node.extensions:
                self.warnings.append("instances (EXT_mesh_gpu_instancing) are not read: their mesh is there once")
            if node.mesh is not None:
                yield matrix, self.entry("meshes", self.document.meshes, node.mesh)
            waiting += [(matrix, child, depth + 1) for child in node.children]

    def cloud(self, primitive: _Primitive) -> SplatCloud:
        """The Gaussians of a primitive, in the frame of its node."""
        attributes, where = primitive.attributes, f"{self.where}: {EXTENSION}"
        kind = parse_record(_Splatting, primitive.extensions[EXTENSION], f"{where}: ")
        if compressed := [name for name in kind.extensions if "compression" in name]:
            what, got = "the Gaussians of the GLB file are compressed", listed(compressed)
            expected, remedy = "attributes without compression", "write it without, or as SPZ"
            raise InputError(what, where=where, got=got, expected=expected, remedy=remedy)
        self.note("primitives.", primitive)
        self.passed.update(f"attributes.{name}" for name in attributes if not _ATTRIBUTE.fullmatch(name))
        self.note(f"{EXTENSION}.", kind)
        self.passed.update(f"{EXTENSION}.extensions.{name}" for name in kind.extensions)
        if kind.colorSpace is None:
            self.warnings.append("it names no colorSpace, which the standard requires: read as sRGB")
        for name, usual in (("projection", "perspective"), ("sortingMethod", "cameraDistance")):
            if (stated := getattr(kind, name) or usual) != usual:
                self.warnings.append(f"{name} {stated!r:.40} is not drawn: {usual} instead")
        means = self.values(attributes, "POSITION", 3)
        count = len(means)
        self.total += count
        if self.total > len(self.binary):
            what = "the nodes of the GLB file repeat its Gaussians too often"
            raise InputError(what, where=self.where, got=f"{self.total} Gaussians")
        rotation = self.values(attributes, PREFIX + "ROTATION", 4, count)
        if np.abs(np.linalg.norm(rotation, axis=1) - 1).max(initial=0) > 0.05:
            self.warnings.append("rotations are not of length 1, as the standard requires: they were brought to it")
        opacity = self.values(attributes, PREFIX + "OPACITY", 1, count)[:, 0]
        scale = self.values(attributes, PREFIX + "SCALE", 3, count)
        outside = (scale < 0).any() or (np.abs(opacity - 0.5) > 0.5 + _ROUNDING).any()
        if outside and self.of_old_transform(3):
            words = "wrote logits and logarithms, where glTF has opacities and sizes: read so"
            self.warnings.append(f"{self.generator} {words}")
            logits, logs = opacity, scale
        else:
            bad = ~((opacity >= -_ROUNDING) & (opacity <= 1 + _ROUNDING))
            what, remedy = "the opacity of a Gaussian is not between 0 and 1", "they look like logits: write"
            remedy = f"{remedy} 1 / (1 + exp(-logit)) into the file"
            refuse_rows(bad, what, self.where, opacity[:, None], "0 to 1", remedy)
            logits, logs = logit(opacity), logarithms(scale, self.where)
        degrees = [d for d in range(4) if f"{PREFIX}SH_DEGREE_{d}_COEF_0" in attributes]
        if degrees != list(range(len(degrees))) or not degrees:
            what = "the harmonics of a primitive leave a degree out"
            raise InputError(what, where=f"{self.where}: JSON", got=str(degrees))
        bands = [f"{PREFIX}SH_DEGREE_{degree}_COEF_{order}" for degree in degrees for order in range(2 * degree + 1)]
        sh = np.stack([self.values(attributes, band, 3, count) for band in bands], 1)
        if kind.colorSpace in ("lin_rec709_display", "BT.709-linear"):
            sh = _of_display(sh)
        if any(name.startswith(f"{PREFIX}SH_DEGREE_") and name not in bands for name in attributes):
            self.warnings.append("harmonics beyond degree 3 were dropped")
        self.step_m = max(self.step_m, spacing_m(means))
        quats, logs, logits, sh = (
            values.astype(np.float32) for values in (rotation[:, [3, 0, 1, 2]], logs, logits, sh)
        )
        return checked(SplatCloud(means, quats, logs, logits, sh), self.where)

    def values(self, attributes: Mapping[str, int], name: str, width: int, count: int | None = None) -> Array:
        """An attribute as f64[count, width], normalised integers as numbers."""
        where = f"{self.where}: {name}"
        if name not in attributes:
            what = "an attribute of the Gaussians is missing"
            raise InputError(what, where=self.where, expected=name, got=", ".join(attributes)[:160])
        accessor = self.entry("accessors", self.document.accessors, attributes[name])
        if accessor.type != _SHAPES[width] or "sparse" in (accessor.model_extra or ()):
            what, got = "an attribute of the Gaussians has the wrong type", accessor.type
            raise InputError(what, where=where, expected=_SHAPES[width], got=got)
        rows, dtype = accessor.count, np.dtype(_KINDS[accessor.componentType])
        binary.refuse_count(rows, where)
        if count is not None and rows != count:
            what = "the attributes of the Gaussians differ in length"
            raise InputError(what, where=where, expected=str(count), got=str(rows))
        view = self.entry("bufferViews", self.document.bufferViews, accessor.bufferView)
        if view.extensions or "uri" in (self.document.buffers or [{}])[0]:
            what = "an attribute of the Gaussians lies outside the file, or is compressed"
            got, remedy = f"extensions {listed(view.extensions)}", "pack the file with its buffers, without compression"
            raise InputError(what, where=where, expected="the binary chunk", got=got, remedy=remedy)
        stride = view.byteStride or width * dtype.itemsize
        size = (rows - 1) * stride + width * dtype.itemsize
        begin, end = view.byteOffset + accessor.byteOffset, accessor.byteOffset + size
        if stride < width * dtype.itemsize or end > view.byteLength or begin + size > len(self.binary):
            raise InputError("an attribute reaches beyond the file's content", where=where, got=f"{size} bytes")
        raw = np.ndarray((rows, width), dtype, self.binary, begin, (stride, dtype.itemsize)).astype(np.float64)
        if dtype.kind == "f" or not accessor.normalized:
            return raw
        return np.maximum(raw / np.iinfo(dtype).max, -1.0)


def _of_display(sh: Array) -> Array:
    """Harmonics of linear light to such of display values: exact for the constant band, to first order for the
    others."""
    linear = np.maximum(sh[:, :1] * C0 + 0.5, 1e-4)
    display = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    slope = np.where(linear <= 0.0031308, 12.92, 1.055 / 2.4 * linear ** (1 / 2.4 - 1))
    return np.concatenate([(display - 0.5) / C0, sh[:, 1:] * slope], 1)
