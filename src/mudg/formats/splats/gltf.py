"""glTF 2.0 with KHR_gaussian_splatting, as one GLB file; objects are nodes of their own, which an animation moves.

Axes: y up; (x, y, z) of this program is (x, z, -y). Quaternions x, y, z, w; scales in metres; opacities 0 to 1; one
accessor per harmonic. An animation's times begin at 0. Where an object does not exist, its node has the scale `HIDDEN`.
"""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.core.harmonics import C0
from mudg.formats.splats.cloud import SplatCloud, SplatNode, SplatScene

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
