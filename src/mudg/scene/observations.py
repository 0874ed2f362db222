"""Folders of observations: what synthesize and render write, and fit, score and the report read.

observations.json    schema, trajectory, source, kind; one record per view (camera, pose, time, file names)
rgb/000000.png       8-bit colour, for people and programs
data/000000.safetensors   depth f32 (NaN = none), semantics u8 (255 = unlabelled), confidence f16, mask u8
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.types import Camera, Observation, ObservationKind, View
from mudg.core.pictures import to_bytes
from mudg.scene.schema import camera_to_json, parse_camera

_INDEX = "observations.json"
_SCHEMA = 1


class ObservationWriter:
    """Write observations of one trajectory, in order, resumably.

    Observations written by an interrupted run are kept: ``done`` says how many. The index appears when the writer is
    closed without an exception, so an unfinished folder is not readable as a finished one.
    """

    def __init__(self, out: Path, trajectory: str, source: str, kind: ObservationKind = "virtual") -> None:
        self._out, self._trajectory, self._source, self._kind = Path(out), trajectory, source, kind
        self._records: list[dict[str, Any]] = []
        self.done = 0
        while (self._out / "data" / f"{self.done:06d}.safetensors").is_file():
            self.done += 1

    def __enter__(self) -> ObservationWriter:
        return self

    def skip(self, view: View) -> None:
        """Record a view whose files an earlier run has written."""
        arrays = store.read_safetensors(self._out / "data" / f"{len(self._records):06d}.safetensors")
        self._record(view, "depth" in arrays, "semantics" in arrays)

    def add(self, observation: Observation) -> None:
        """Write one observation and record its view."""
        name = f"{len(self._records):06d}"
        if not bool(torch.isfinite(observation.rgb).all()):
            count = int((~torch.isfinite(observation.rgb)).sum())
            what = "colours of an observation are not finite"
            raise InputError(what, where=f"{self._out}, view {name}", got=f"{count} values")
        store.write_image(self._out / "rgb" / f"{name}.png", to_bytes(observation.rgb), compress_level=1)
        arrays = {
            "confidence": _numpy(observation.confidence[0], np.float16),
            "mask": _numpy(observation.mask[0], np.uint8),
        }
        if observation.depth is not None:
            arrays["depth"] = _numpy(observation.depth[0], np.float32)
        if observation.semantics is not None:
            arrays["semantics"] = _numpy(observation.semantics, np.uint8)
        store.write_safetensors(self._out / "data" / f"{name}.safetensors", arrays)
        self._record(observation.view, observation.depth is not None, observation.semantics is not None)

    def _record(self, view: View, has_depth: bool, has_semantics: bool) -> None:
        self._records.append(
            {
                "camera": {"name": view.camera.name, **camera_to_json(view.camera)},
                "world_from_cam": view.world_from_cam.tolist(),
                "time_s": view.time_s,
                "depth": has_depth,
                "semantics": has_semantics,
            }
        )

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            head = {"schema": _SCHEMA, "trajectory": self._trajectory, "source": self._source, "kind": self._kind}
            store.write_json(self._out / _INDEX, {**head, "observations": self._records})


def _numpy(tensor: torch.Tensor, dtype: type[np.generic]) -> NDArray[Any]:
    return tensor.detach().cpu().numpy().astype(dtype)


@dataclass(frozen=True)
class ObservationSet:
    """Observations of one trajectory on disk; indexing loads one."""

    path: Path
    trajectory: str
    source: str
    kind: ObservationKind
    views: tuple[View, ...]
    has_depth: tuple[bool, ...]
    has_semantics: tuple[bool, ...]

    def __len__(self) -> int:
        return len(self.views)

    def rgb_u8(self, index: int) -> NDArray[np.uint8]:
        """Colour u8[H, W, 3] of one observation."""
        return read_image_file(self.path / "rgb" / f"{index:06d}.png", self.views[index].camera)

    def arrays(self, index: int) -> dict[str, NDArray[Any]]:
        """What the data file of one observation holds, as stored: confidence f16, mask u8, and where there are any
        depth f32 and semantics u8, [H, W] each; InputError where an array is missing or of another size."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        camera = self.views[index].camera
        path = self.path / "data" / f"{index:06d}.safetensors"
        arrays = store.read_safetensors(path)
        shape = (camera.height, camera.width)
        wanted = ["confidence", "mask"] + ["depth"] * self.has_depth[index] + ["semantics"] * self.has_semantics[index]
        for name in wanted:
            if name not in arrays or arrays[name].shape != shape:
                got = "missing" if name not in arrays else str(arrays[name].shape)
                what = "an observation file does not fit its view"
                raise InputError(what, where=f"{path}: {name}", expected=str(shape), got=got)
        return {name: arrays[name] for name in wanted}

    def __getitem__(self, index: int) -> Observation:
        arrays, view = self.arrays(index), self.views[index]
        return Observation(
            view=view,
            rgb=torch.from_numpy(self.rgb_u8(index).copy()).permute(2, 0, 1).float() / 255,
            depth=torch.from_numpy(arrays["depth"].copy())[None] if self.has_depth[index] else None,
            semantics=torch.from_numpy(arrays["semantics"].astype(np.int64)) if self.has_semantics[index] else None,
            confidence=torch.from_numpy(arrays["confidence"].astype(np.float32))[None],
            mask=torch.from_numpy(arrays["mask"].astype(bool))[None],
            kind=self.kind,
            source=self.source,
        )


def read_image_file(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Read an 8-bit colour image u8[H, W, 3]; InputError if it is missing, truncated or of another size."""
    content = store.read_bytes(path)
    try:
        with Image.open(io.BytesIO(content)) as image:
            if image.size != (camera.width, camera.height):
                what, expected = "an image has another size than its camera", f"{camera.width}x{camera.height}"
                raise InputError(what, where=str(path), expected=expected, got=f"{image.size[0]}x{image.size[1]}")
            return np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise InputError("an image cannot be decoded", where=str(path), got=str(error)) from error


def read_observations(path: Path) -> ObservationSet:
    """Open a folder of observations; nothing but the index is read.

    Raises:
        InputError: the folder has no index (unfinished or not an observation folder) or a record is malformed.
    """
    index = Path(path) / _INDEX
    if not index.is_file():
        raise InputError("not a finished folder of observations", where=str(path), expected=f"a file {_INDEX}")
    content = store.read_json(index)
    try:
        if content["schema"] != _SCHEMA:
            what = "unknown schema version"
            raise InputError(what, where=str(index), expected=str(_SCHEMA), got=str(content["schema"]))
        records = content["observations"]
        if not records:
            raise InputError("no views are listed", where=str(index))
        cameras = [_camera(r["camera"], f"{index}: observations[{i}].camera") for i, r in enumerate(records)]
        poses = [np.asarray(r["world_from_cam"], np.float64) for r in records]
        views = tuple(View(c, p, float(r["time_s"])) for c, p, r in zip(cameras, poses, records, strict=True))
        has_depth, has_semantics = (tuple(bool(r[key]) for r in records) for key in ("depth", "semantics"))
        kind: ObservationKind = "recorded" if content["kind"] == "recorded" else "virtual"
        trajectory, source = str(content["trajectory"]), str(content["source"])
        return ObservationSet(Path(path), trajectory, source, kind, views, has_depth, has_semantics)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError("a record of the index is malformed", where=str(index), got=repr(error)) from error


def _camera(record: Any, where: str) -> Camera:
    return parse_camera(str(record["name"]), {key: value for key, value in record.items() if key != "name"}, where)


def list_observation_sets(path: Path) -> dict[str, Path]:
    """Trajectory folders below ``path``, by name; ``path`` itself if it is one."""
    path = Path(path)
    places = [path] if (path / _INDEX).is_file() else sorted(path.iterdir()) if path.is_dir() else []
    return {p.name: p for p in places if (p / _INDEX).is_file()}
