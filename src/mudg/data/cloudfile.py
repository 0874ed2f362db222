"""Fused clouds on disk.

static.safetensors       xyz f32[N, 3] metres (world), rgb u8[N, 3], semantics u8[N] if there were labels
objects/000.safetensors  the same in the frame of one tracked box; fuse.json says which
fuse.json                counts, rules, a verdict per track; how the cameras show the points' colours
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mudg.base import store
from mudg.base.camera_colors import SAME_COLORS, CameraColors
from mudg.base.errors import InputError, IntegrityError
from mudg.base.types import FusedCloud, PointCloud


def write_fused(folder: Path | str, cloud: FusedCloud, report: Mapping[str, Any]) -> None:
    """Write a fused cloud and its report; ``fuse.json`` comes last, without it the folder is not a fused cloud."""
    folder = Path(folder)
    static = _write_cloud(folder, "static.safetensors", cloud.static)
    files = {
        track_id: _write_cloud(folder, f"objects/{index:03d}.safetensors", points)
        for index, (track_id, points) in enumerate(cloud.objects.items())
    }
    head = {"format": "mudg-fused", "schema_version": 1, "static": static, "objects": files}
    if cloud.colors.to_common:
        head["camera_colors"] = cloud.colors.record()
    store.write_json(folder / "fuse.json", {**head, **report})


def _write_cloud(folder: Path, name: str, cloud: PointCloud) -> dict[str, Any]:
    """Write a cloud; returns its entry in ``fuse.json``."""
    arrays = {"xyz": cloud.xyz, "rgb": cloud.rgb}
    if cloud.semantics is not None:
        arrays["semantics"] = cloud.semantics
    store.write_safetensors(folder / name, arrays)
    return {"file": name, "sha256": store.sha256_file(folder / name), "points": len(cloud)}


def read_fused(folder: Path | str) -> FusedCloud:
    """Read a fused cloud.

    Raises:
        InputError: not the output folder of ``fuse``.
        IntegrityError: a cloud differs from what was written.
    """
    folder = Path(folder)
    index = store.read_json(folder / "fuse.json")
    if not isinstance(index, dict) or index.get("format") != "mudg-fused" or index.get("schema_version") != 1:
        raise InputError("not a fused cloud", where=str(folder / "fuse.json"), remedy="make one with `mudg fuse`")
    try:
        static = _read_cloud(folder, index["static"], "world")
        objects = {str(track_id): _read_cloud(folder, entry, "object") for track_id, entry in index["objects"].items()}
        colors = CameraColors.of_record(index["camera_colors"]) if "camera_colors" in index else SAME_COLORS
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError("fuse.json is malformed", where=str(folder / "fuse.json"), got=repr(error)) from error
    return FusedCloud(static, objects, colors)


def _read_cloud(folder: Path, entry: Mapping[str, Any], frame: str) -> PointCloud:
    name = str(entry["file"])
    parts = name.split("/")
    if name != "static.safetensors" and not (len(parts) == 2 and parts[0] == "objects" and parts[1][:-12].isdigit()):
        raise InputError("fuse.json names a file that is not a cloud", where=str(folder / "fuse.json"), got=name)
    path = folder / name
    if not path.is_file():
        raise IntegrityError("a cloud is missing", where=str(path), remedy="run `mudg fuse` again")
    if store.sha256_file(path) != entry["sha256"]:
        raise IntegrityError("a cloud was altered after it was written", where=str(path),
            remedy="run `mudg fuse` again")  # fmt: skip
    arrays = store.read_safetensors(path)
    xyz = arrays["xyz"]
    if not np.isfinite(xyz).all():
        raise InputError("a cloud holds coordinates that are not finite", where=str(path))
    return PointCloud(xyz, arrays["rgb"], frame, arrays.get("semantics"))  # type: ignore[arg-type]
