"""``mudg render --layers``: further layers of every rendered view, its boxes, and how far to trust it.

OUT/layers/<trajectory>/layers.json            objects by number; per view its file, time, pose, trust and boxes
OUT/layers/<trajectory>/000000.safetensors     arrays as in ``CameraReply.layers``
OUT/layers/<trajectory>/000000_instances.png   u16; 000000_normals.png u8, (n + 1) / 2, black where there is no surface
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Final, cast

import numpy as np

from mudg.base import log, store
from mudg.base.types import Trajectory
from mudg.datasets.samples import LabelledView, Labeller
from mudg.datasets.write import object_record, trust_record
from mudg.editing.render import trajectories
from mudg.editing.script import EditScript
from mudg.editing.settings import RenderConfig
from mudg.scene.read import read_scene
from mudg.sim.session import Instant, Layer, Session

INDEX: Final = "layers.json"


def write_layers(
    config: RenderConfig, scene: Path, model: Path, script: EditScript | None, path: Path | None, out: Path
) -> list[str]:
    """Draw the layers of all views that ``mudg render`` draws; returns names of the trajectories. Views that an
    interrupted run wrote are kept."""
    loaded = read_scene(scene)
    labeller = Labeller(Session(model, script, loaded, config.device))
    paths = trajectories(loaded, config, path)
    with log.task("render layers", sum(len(one) for one in paths)) as bar:
        for one in paths:
            folder = out / "layers" / one.name
            records = []
            for number in range(len(one)):
                record = folder / f"{number:06d}.json"
                if not record.is_file():
                    store.write_json(record, _write_view(labeller, config, one, number, folder))
                records.append(store.read_json(record))
                bar.advance()
            objects = {str(number): name for number, name in enumerate(labeller.names, 1)}
            store.write_json(folder / INDEX, {"schema": 1, "objects": objects, "views": records})
            for number in range(len(one)):
                (folder / f"{number:06d}.json").unlink()
    return [one.name for one in paths]


def _write_view(
    labeller: Labeller, config: RenderConfig, path: Trajectory, number: int, folder: Path
) -> dict[str, Any]:
    view, name = path.views[number], f"{number:06d}"
    later = path.views[number + 1] if number + 1 < len(path) else None
    layers = [layer for layer in config.layers if layer != "motion" or later is not None]
    motion_to = None if later is None else Instant(later.time_s, later.world_from_cam)
    labelled = labeller.label(name, view, cast("list[Layer]", layers), motion_to=motion_to)
    arrays = {layer: np.ascontiguousarray(labelled.layers[layer]) for layer in layers}
    store.write_safetensors(folder / f"{name}.safetensors", arrays)
    if "instances" in arrays:
        store.write_image(folder / f"{name}_instances.png", arrays["instances"])
    if "normals" in arrays:
        toward = np.nan_to_num(np.round(127.5 * (arrays["normals"] + 1)), nan=0.0)
        store.write_image(folder / f"{name}_normals.png", toward.astype(np.uint8))
    return _record(labelled, layers)


def _record(view: LabelledView, layers: list[str]) -> dict[str, Any]:
    camera = dataclasses.asdict(view.view.camera)
    return {
        "file": f"{view.name}.safetensors",
        "layers": layers,
        "camera": camera,
        "time_s": view.view.time_s,
        "world_from_camera": view.view.world_from_cam.tolist(),
        "trust": trust_record(view.trust),
        "boxes": [
            {**object_record(box), "number": box.number, "amodal_px": box.amodal_px, "visible_px": box.visible_px}
            for box in view.boxes
        ],
    }
