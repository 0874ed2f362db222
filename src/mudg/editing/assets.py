"""Objects of fitted scenes as files: one safetensors file each, with the description as JSON in its header.

means f32[n, 3]  quats f32[n, 4]  log_scales f32[n, 3]  logits f32[n]  sh_dc f32[n, 1, 3]   raw, in the frame of the box
class_ids u8[n] (255 = unknown)   certainty f16[n], if it is known
header "mudg_asset": {schema, label, size_m, light_rgb, seen_deg, origin}
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import torch
from pydantic import Field

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.palette import CLASSES, UNLABELLED
from mudg.base.processes import one_torch_thread
from mudg.base.records import Number, StrictRecord, parse_record
from mudg.base.run_folder import ResultFile
from mudg.base.types import View
from mudg.editing.apply import views_of
from mudg.editing.light import surface_light
from mudg.editing.model import Asset, asset_of, motion_of
from mudg.editing.plan import Actor, sides_seen
from mudg.editing.runs import RunParts
from mudg.editing.street import with_closed_sides
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import raster_of
from mudg.gaussians.storage import load_model
from mudg.scene.read import read_scene

HEADER: Final = "mudg_asset"
_SHAPES: Final = {"means": (3,), "quats": (4,), "log_scales": (3,), "logits": (), "sh_dc": (1, 3)}
Size = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class AssetHeader(StrictRecord):
    """Description of an asset file."""

    schema_: Literal[2] = Field(alias="schema")
    label: str
    size_m: Annotated[list[Size], Field(min_length=3, max_length=3)]
    light_rgb: Annotated[list[Number], Field(min_length=3, max_length=3)] | None
    seen_deg: list[Number]
    origin: str


def write_asset_from(parts: RunParts, name: str, file: ResultFile) -> dict[str, Any]:
    """Write one object of a fit, or of a run, to a file; returns what it is. UsageError where there is no such
    object."""
    asset = asset_from(parts, name)
    write_asset(file.path, asset)
    log.info(f"asset: {name} ({asset.label}, {len(asset)} Gaussians, seen from {len(asset.seen_rad)} directions)")
    return {"id": name}


def asset_from(parts: RunParts, name: str) -> Asset:
    """An object of a run, with the sides from which its scene shows it; those that it never shows are closed."""
    model = load_model(parts.model)
    if parts.scene is None:
        return asset_of(model, name)
    recorded = read_scene(parts.scene)
    return complete_asset(model, name, [frame.view for frame in recorded.frames])


@one_torch_thread()
def complete_asset(model: SceneModel, name: str, views: Sequence[View]) -> Asset:
    """An object of a fitted scene, with the sides from which views show it; the others are closed
    (``editing/street.py``)."""
    node = model.dynamic_object(name)
    actor = Actor(node.label, (node.size_m[0], node.size_m[1], node.size_m[2]), motion_of(node))
    closed = with_closed_sides(model, [name], views_of([actor], views), raster_of(model))
    return asset_of(closed, name, sides_seen(actor, views).tolist(), light_rgb=surface_light(model, views))


def write_asset(path: Path, asset: Asset) -> None:
    """Write an asset file."""
    arrays = {key: asset.columns[key].numpy() for key in _SHAPES}
    arrays["class_ids"] = np.where(asset.class_ids < 0, UNLABELLED, asset.class_ids).astype(np.uint8)
    if asset.certainty is not None:
        arrays["certainty"] = asset.certainty.astype(np.float16)
    header = {
        "schema": 2,
        "label": asset.label,
        "size_m": list(asset.size_m),
        "origin": asset.origin,
        "light_rgb": None if asset.light_rgb is None else list(asset.light_rgb),
        "seen_deg": [round(float(np.degrees(a)), 2) for a in asset.seen_rad],
    }
    store.write_safetensors(path, arrays, {HEADER: store.json_text(header, indent=None)})


def read_asset(path: Path) -> Asset:
    """Read an asset file.

    Raises:
        InputError: it is missing, damaged, or no asset.
    """
    content = store.read_bytes(path)
    arrays, text = (
        store.parse_safetensors(content, str(path)),
        store.safetensors_metadata(content, str(path)).get(HEADER),
    )
    if text is None:
        raise InputError("this file is no asset", where=str(path), expected="a file written by `mudg asset export`")
    facts = store.parse_json(text, f"{path}: header")
    header = parse_record(AssetHeader, facts, f"{path}: header: ")
    count = len(arrays["means"]) if "means" in arrays else 0
    wanted = {**{key: (count, *shape) for key, shape in _SHAPES.items()}, "class_ids": (count,)}
    for name, shape in wanted.items():
        kind = np.uint8 if name == "class_ids" else np.float32
        if name not in arrays or arrays[name].shape != shape or arrays[name].dtype != kind or not count:
            got = f"{arrays[name].dtype} {arrays[name].shape}" if name in arrays else "nothing"
            expected = f"{kind.__name__} {shape}"
            raise InputError(
                f"tensor {name!r} of an asset has the wrong form", where=str(path), expected=expected, got=got
            )
        if not np.isfinite(arrays[name]).all():
            raise InputError(f"tensor {name!r} of an asset holds values that are not finite", where=str(path))
    ids = arrays["class_ids"].astype(np.int64)
    known = arrays.get("certainty")
    length, width, height = header.size_m
    return Asset(
        {key: torch.from_numpy(arrays[key].copy()) for key in _SHAPES},
        np.where(ids < len(CLASSES), ids, -1),
        None if known is None or known.shape != (count,) else known.astype(np.float32),
        header.label,
        (length, width, height),
        None if header.light_rgb is None else (header.light_rgb[0], header.light_rgb[1], header.light_rgb[2]),
        tuple(float(a) for a in np.radians(header.seen_deg)),
        header.origin,
    )
