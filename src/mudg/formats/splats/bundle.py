"""The bundle: everything that an export can carry, for programs that move objects themselves. A stored zip:

bundle.json            what it is: names, files, axes, classes, times
static.ply             what stands, in the axes of the file          objects/NAME.ply   objects in the frame of their
                       box
tracks.json            paths of the objects: layout splatsim.sequence_tracks/v2 (times in microseconds, translation,
                       rotation x y z w)
deform/NAME.safetensors  ``displacement`` f32[K, n, 3]: what the Gaussians of a deforming object are moved by at each
                         key, linear between
sky.png                panorama: zenith on top, longitude from -pi to pi growing to the right of the picture (to the
                       left as one looks)
cameras.json           intrinsics and recorded poses, where the log is known
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from mudg.base import geometry, store
from mudg.base.palette import CLASSES
from mudg.base.types import Scene
from mudg.formats.splats import binary, ply
from mudg.formats.splats.cloud import SplatNode, SplatScene
from mudg.formats.splats.usd import png

SCHEMA: Final = "mudg.bundle/v1"
TRACKS: Final = "splatsim.sequence_tracks/v2"
MICROSECONDS: Final = 1_000_000
CONVENTION: Final = {
    "world": "right-handed, z up",
    "object": "centre of the box, x forward, y left, z up",
    "camera": "opencv: x right, y down, z forward",
    "rotation": "x y z w",
    "matrix": "row-major, a_from_b",
    "unit": "metre",
    "time_unit": "microsecond",
}


def to_bytes(scene: SplatScene, log: Scene | None = None) -> bytes:
    """A scene with its motion as a bundle; ``log``: whose cameras are listed."""
    names = file_names([node.name for node in scene.nodes])
    files: dict[str, bytes] = {}
    listed: list[dict[str, Any]] = []
    antialias = bool(scene.facts.get("drawing", {}).get("antialias", False))
    for name, node in zip(names, scene.nodes):
        place = f"objects/{name}.ply" if node.moves else ("static.ply" if node is scene.nodes[0] else f"{name}.ply")
        cloud = node.cloud if node.moves else node.cloud.moved(scene.file_from_world)
        files[place] = ply.to_bytes(cloud, classes=True, marks=ply.marks_of(antialias, z_up=True))
        entry = {"name": node.name, "file": place, "gaussians": len(cloud), "degree": cloud.degree, "moves": node.moves}
        if node.displacement is not None:
            entry["deform"] = f"deform/{name}.safetensors"
            files[entry["deform"]] = _safetensors(node)
        listed.append(entry)
    files["tracks.json"] = _json(tracks_of(scene, listed))
    if scene.sky is not None:
        files["sky.png"] = png(scene.sky)
    if log is not None:
        files["cameras.json"] = _json(cameras_of(log, scene))
    about = {
        "schema": SCHEMA,
        "name": scene.name,
        "nodes": listed,
        "frame_convention": CONVENTION,
        "classes": list(CLASSES),
        "file_from_world": scene.file_from_world.tolist(),
        "span_s": list(scene.span_s),
        "facts": dict(scene.facts),
    }
    return binary.stored_zip({"bundle.json": _json(about), **files})


def tracks_of(scene: SplatScene, listed: list[dict[str, Any]]) -> dict[str, Any]:
    """The paths of what moves."""
    tracks = []
    for node, entry in zip(scene.nodes, listed):
        if not node.moves:
            continue
        poses = scene.file_from_world @ node.world_from_node
        frames = [
            {
                "timestamp_us": round(float(time_s) * MICROSECONDS),
                "translation": pose[:3, 3].tolist(),
                "rotation": geometry.quaternion_from_matrix(pose)[[1, 2, 3, 0]].tolist(),
            }
            for time_s, pose in zip(node.times_s, poses)
        ]
        tracks.append(
            {
                "track_id": node.name,
                "class_name": node.label,
                "size": list(node.size_m),
                "flag": "CONTROLLABLE",
                "frames": frames,
                "metadata": {"file": entry["file"], "deform": entry.get("deform")},
            }
        )
    return {"schema": TRACKS, "frame": "world", "frame_convention": CONVENTION, "tracks": tracks}


def cameras_of(log: Scene, scene: SplatScene) -> dict[str, Any]:
    """Intrinsics of the cameras of a log and the poses of its images, in the axes of the file."""
    cameras = {
        name: {
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
        }
        for name, camera in log.cameras.items()
    }
    frames = [
        {
            "id": frame.id,
            "camera": frame.view.camera.name,
            "timestamp_us": round(frame.view.time_s * MICROSECONDS),
            "world_from_camera": (scene.file_from_world @ frame.view.world_from_cam).tolist(),
        }
        for frame in log.frames
    ]
    return {"frame_convention": CONVENTION, "cameras": cameras, "frames": frames}


def file_names(names: list[str]) -> list[str]:
    """Names that every file system accepts, each once."""
    made: dict[str, None] = {}
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_.-]", "_", name).strip(".") or "node"
        chosen, count = plain, 1
        while chosen.lower() in {known.lower() for known in made}:
            count += 1
            chosen = f"{plain}_{count}"
        made[chosen] = None
    return list(made)


def _safetensors(node: SplatNode) -> bytes:
    from safetensors.numpy import save

    displacement = np.ascontiguousarray(node.displacement, np.float32)
    return save({"displacement": displacement, "times_s": np.ascontiguousarray(node.times_s)})


def _json(value: Mapping[str, Any]) -> bytes:
    return (store.json_text(value) + "\n").encode()
