"""Labelled views as a map-style dataset of torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, default_collate

from mudg.base import config as configuration
from mudg.datasets.samples import LabelledView, Labeller
from mudg.datasets.settings import DatasetConfig
from mudg.datasets.write import LabelledDrive
from mudg.sim.session import Layer

LAYERS: Final[tuple[Layer, ...]] = ("rgb", "depth", "classes", "instances", "confidence")
RAGGED: Final = tuple(
    "boxes_2d boxes_amodal cam_from_box sizes_m numbers occlusion truncation labels ids points".split()
)
"""Entries that have as many rows as a view has objects, or a sweep has returns."""


class LabelledViews(Dataset[dict[str, Any]]):
    """Views of a reconstruction, drawn when they are asked for.

    An entry is a dict: ``rgb`` f32[3, H, W] in [0, 1]; ``depth`` f32[1, H, W] metres, 0 where there is none;
    ``classes`` and ``instances`` i64[H, W] (255 and 0: none); ``confidence`` f32[1, H, W]; ``intrinsics`` f32[3, 3]
    pixels; ``world_from_cam`` f64[4, 4]; ``time_s`` f64; ``trust`` f32, the determined share; of N objects ``boxes_2d``
    and ``boxes_amodal`` f32[N, 4] (left, top, right, bottom in pixels), ``cam_from_box`` f32[N, 4, 4], ``sizes_m``
    f32[N, 3], ``numbers`` i64[N] (values in ``instances``), ``occlusion`` f32[N] (NaN: not known), ``truncation``
    f32[N], ``labels`` and ``ids`` lists of text; and ``name``. With ``lidar`` in the settings also ``points``
    f32[P, 4]: x, y, z in metres in the frame of the sensor, intensity in [0, 1]; and ``world_from_lidar`` f64[4, 4].
    Nothing is drawn at random: the same index gives the same bytes in any process.

    ``run``, ``scene``: as for ``mudg.sim.Session``, as paths, so that every worker opens its own. ``settings``: which
    views. ``path``: file of a camera path that stands for the shifts, as of ``mudg render --path``. Raises what
    ``Session`` and ``Labeller`` raise."""

    def __init__(
        self,
        run: str | Path,
        scene: str | Path | None = None,
        edits: str | Path | None = None,
        settings: DatasetConfig | None = None,
        path: str | Path | None = None,
    ) -> None:
        scene, edits, path = (None if one is None else Path(one) for one in (scene, edits, path))
        self.drive = LabelledDrive(Path(run).name, Path(run), scene, edits, path=path)
        self.settings = settings or DatasetConfig()
        self.views = self.drive.views(self.settings)
        self._labeller: Labeller | None = self.drive.labeller(self.settings)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_labeller": None}

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"view {index} of {len(self)}")
        self._labeller = self._labeller or self.drive.labeller(self.settings)
        name, view = self.views[index]
        return entry(self._labeller.label(name, view, LAYERS).wanted(self.settings))


def entry(view: LabelledView) -> dict[str, Any]:
    """A labelled view as tensors."""
    camera, boxes, layers = view.view.camera, view.boxes, view.layers
    depth = np.nan_to_num(layers["depth"], nan=0.0)
    rows = lambda values, shape: torch.tensor(np.array(list(values), np.float32).reshape(len(boxes), *shape))
    swept: dict[str, Tensor] = {}
    if view.sweep is not None:
        swept["points"] = torch.from_numpy(view.sweep.points)
        swept["world_from_lidar"] = torch.from_numpy(view.sweep.world_from_lidar.copy())
    return {
        **swept,
        "name": view.name,
        "rgb": torch.from_numpy(layers["rgb"]).permute(2, 0, 1).float() / 255,
        "depth": torch.from_numpy(depth)[None],
        "classes": torch.from_numpy(layers["classes"].astype(np.int64)),
        "instances": torch.from_numpy(layers["instances"].astype(np.int64)),
        "confidence": torch.from_numpy(layers["confidence"])[None],
        "intrinsics": torch.from_numpy(camera.matrix.astype(np.float32)),
        "world_from_cam": torch.from_numpy(view.view.world_from_cam.copy()),
        "time_s": torch.tensor(view.view.time_s, dtype=torch.float64),
        "trust": torch.tensor(view.trust.determined),
        "boxes_2d": rows((box.visible_px or (0.0,) * 4 for box in boxes), (4,)),
        "boxes_amodal": rows((box.amodal_px for box in boxes), (4,)),
        "cam_from_box": rows((view.view.cam_from_world @ box.world_from_box for box in boxes), (4, 4)),
        "sizes_m": rows((box.size_m for box in boxes), (3,)),
        "numbers": torch.tensor([box.number for box in boxes], dtype=torch.int64),
        "occlusion": rows((box.occlusion for box in boxes), ()),
        "truncation": rows((box.truncation for box in boxes), ()),
        "labels": [box.label for box in boxes],
        "ids": [box.track_id for box in boxes],
    }


def collate(entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A batch: what all views have is stacked, what belongs to objects stays a list per view."""
    shared = [{name: value for name, value in one.items() if name not in RAGGED} for one in entries]
    batch: dict[str, Any] = default_collate(shared)
    there = [name for name in RAGGED if name in entries[0]]
    ragged: dict[str, list[Tensor | list[str]]] = {name: [one[name] for one in entries] for name in there}
    return {**batch, **ragged}


def as_dataset(
    run: str | Path,
    scene: str | Path | None = None,
    edits: str | Path | None = None,
    path: str | Path | None = None,
    **settings: Any,
) -> LabelledViews:
    """Labelled views of a reconstruction for a ``DataLoader`` (see ``LabelledViews``; batches need ``mudg.collate``).

    Args:
        run: folder of a run, or of a fit with its ``scene``. edits: an edit script to carry out before.
        path: file of a camera path that stands for the shifts.
        settings: those of ``mudg dataset``, such as ``cameras="front"``, ``shifts_m=(0, 2)``, ``width_px=480``.

    Raises:
        UsageError: an unknown setting, or a value that is none. InputError: no such run.
    """
    if isinstance(settings.get("cameras"), str):
        settings["cameras"] = (settings["cameras"],)
    return LabelledViews(run, scene, edits, configuration.load(DatasetConfig, overrides=settings), path)
