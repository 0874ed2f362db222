"""NTA-IoU and NTL-IoU from what detectors made of the images: boxes as COCO results, lanes as masks. Images are named
``METHOD/TRAJECTORY/000003``; ``truth/TRAJECTORY/...`` and ``recorded/CAMERA/...`` give the anchors beside every value.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from mudg.base import geometry, store
from mudg.base.errors import InputError
from mudg.base.types import Scene, Track, View
from mudg.city.world import CityWorld
from mudg.core import street_scores
from mudg.core.fusion import points_in_box
from mudg.scene.read import read_points
from mudg.scoring import tables as score_tables
from mudg.scoring.truth import SAME_SWEEP_S

CAR_AND_BUS: Final = (2, 5)
"""Numbers of two of the 80 classes of COCO, as YOLO counts them: those that ReconDreamer's score keeps;
DriveDreamer4D's keeps all."""
TRUTH: Final = "truth"
RECORDED: Final = "recorded"
_BOXES: Final = "a list of records with image_id, category_id, bbox [x, y, width, height] and score"


@dataclass(frozen=True)
class ViewImages:
    """Images of one method on one trajectory. ``key``: first part of their names. ``numbers``: of the images that
    count. ``views``: of these."""

    key: str
    numbers: tuple[int, ...]
    views: tuple[View, ...]

    def names(self) -> list[str]:
        """Names of the images."""
        return [f"{self.key}/{number:06d}" for number in self.numbers]


def read_detections(path: Path) -> dict[str, list[tuple[street_scores.ImageBox, int]]]:
    """Boxes in pixels of 480 x 320 and their classes by image name (``METHOD/TRAJECTORY/000003``, without a folder
    ``rgb`` and an ending), without those of a confidence of at most 0.5: COCO's result form, for images resized to 480
    x 320 as the published score does it. InputError: anything else."""
    content = store.read_json(path)
    if not isinstance(content, list):
        raise InputError("a file of boxes holds no list", where=str(path), expected=_BOXES, got=type(content).__name__)
    found: dict[str, list[tuple[street_scores.ImageBox, int]]] = {}
    for number, record in enumerate(content):
        where, got = f"{path}: record {number}", repr(record)[:120]
        try:
            name, category, score = str(record["image_id"]), int(record["category_id"]), float(record.get("score", 1.0))
            x, y, width, height = (float(v) for v in record["bbox"])
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError("a detected box is malformed", where=where, expected=_BOXES, got=got) from error
        if not all(map(math.isfinite, (x, y, width, height, score))) or width < 0 or height < 0 or not 0 <= score <= 1:
            expected = "finite numbers, sizes of at least 0, a score in 0..1"
            raise InputError("a detected box is impossible", where=where, expected=expected, got=got)
        name = name.replace("\\", "/").replace("/rgb/", "/")
        kept = found.setdefault(re.sub(r"\.(png|jpe?g)$", "", name, flags=re.IGNORECASE), [])
        if score > street_scores.NTA_CONFIDENCE:
            kept.append((np.array([x, y, x + width, y + height]), category))
    return found


class BoxDetections:
    """NTA-IoU of methods. ``scene``: whose tracked boxes are the truth. ``path``: file of boxes."""

    def __init__(self, scene: Scene, path: Path) -> None:
        self._scene = scene
        self._found = read_detections(path)
        self.sha256 = store.sha256_file(path)
        self._counts: dict[str, dict[str, int]] = {}

    def of(self, images: ViewImages) -> dict[str, Any] | str:
        """``value`` with all classes, ``car_and_bus`` with these alone, number of ``truths``; or why there is none."""
        if not any(name in self._found for name in images.names()):
            return score_tables.NO_DETECTIONS
        values: dict[str, list[float]] = {"value": [], "car_and_bus": []}
        for name, view in zip(images.names(), images.views, strict=True):
            truths = [box for _, box in street_scores.nta_truths(view, self._tracks_at(view))]
            own = self._found.get(name, [])
            values["value"] += street_scores.nta_iou(truths, [box for box, _ in own])
            values["car_and_bus"] += street_scores.nta_iou(truths, [box for box, of in own if of in CAR_AND_BUS])
        if not values["value"]:
            return score_tables.NO_TRUTH
        return {"truths": len(values["value"]), **{k: round(sum(v) / len(v), 6) for k, v in values.items()}}

    def record(self) -> dict[str, Any]:
        """How the numbers were made, for metrics.json."""
        sweeps, counted = bool(self._scene.sweeps), "counted in the sweeps taken with the view"
        return {
            "file_sha256": self.sha256,
            "confidence_above": street_scores.NTA_CONFIDENCE,
            "reach_px": street_scores.NTA_REACH_PX,
            "size": [street_scores.NTA_WIDTH_PX, street_scores.NTA_HEIGHT_PX],
            "classes": "all; beside it COCO's car and bus alone (2 and 5)",
            "boxes": "cut at the near plane",
            "fewest_points": street_scores.NTA_FEWEST_POINTS if sweeps else None,
            "points": counted if sweeps else "no sweeps: boxes of any number count",
        }

    def _tracks_at(self, view: View) -> Sequence[Track]:
        """Tracks with at least ten LiDAR points at a view's time; all of them where no sweep was taken then."""
        sweeps = [s for s in self._scene.sweeps if abs(s.time_s - view.time_s) <= SAME_SWEEP_S]
        if not sweeps:
            return self._scene.tracks
        vehicles = [track for track in self._scene.tracks if track.label in street_scores.VEHICLE_LABELS]
        totals = dict.fromkeys((track.id for track in vehicles), 0)
        for sweep in sweeps:
            if sweep.id not in self._counts:
                xyz = read_points(self._scene, sweep).xyz.astype(np.float64)
                self._counts[sweep.id] = {}
                for track in vehicles:
                    pose = track.pose_at(sweep.time_s)
                    if pose is not None:
                        local = geometry.transform_points(geometry.invert(pose) @ sweep.world_from_lidar, xyz)
                        self._counts[sweep.id][track.id] = int(points_in_box(local, track.size_m, 0.0, 0.0).sum())
            for name, count in self._counts[sweep.id].items():
                totals[name] += count
        return [track for track in vehicles if totals[track.id] >= street_scores.NTA_FEWEST_POINTS]


class LaneDetections:
    """NTL-IoU of methods. ``scene``: a generated city, whose markings and kerbs take the place of a map. ``folder``:
    masks ``METHOD/TRAJECTORY/000003.png``. InputError: the scene has no lane lines, or the folder is missing."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        if scene.source.recipe is None:
            what = "the log has no lane lines to hold detected lanes against"
            got, expected = scene.source.dataset, "a generated city: prepared logs keep no map"
            raise InputError(what, where=scene.root, got=got, expected=expected, remedy="leave out --lanes")
        if not folder.is_dir():
            raise InputError("no such folder of lane masks", where=str(folder))
        self._lines = CityWorld.from_source(scene.source).lane_lines()
        self._folder = folder

    def of(self, images: ViewImages) -> dict[str, Any] | str:
        """``value``, IoU of ``lanes`` alone, and number of ``frames``; or why there is none. InputError: some masks of
        a set are missing, or one cannot be read."""
        files = [self._folder / f"{name}.png" for name in images.names()]
        if not any(path.is_file() for path in files):
            return score_tables.NO_DETECTIONS
        values, lanes = [], []
        for path, view in zip(files, images.views, strict=True):
            found, true = street_scores.at_lane_size(read_mask(path)), street_scores.lane_truth(view, self._lines)
            values.append(street_scores.ntl_iou(found, true))
            union = int((found | true).sum())
            lanes.append(float((found & true).sum() / union) if union else 0.0)
        mean = lambda numbers: round(sum(numbers) / len(numbers), 6)
        return {"frames": len(values), "value": mean(values), "lanes": mean(lanes)}

    def record(self) -> dict[str, Any]:
        """How the numbers were made, for metrics.json."""
        return {"lines": "markings, kerbs and crosswalks of the generated city; nothing hides them", "size": [640, 360]}


def read_mask(path: Path) -> NDArray[np.uint8]:
    """A mask u8[H, W]; InputError if it is missing or no picture."""
    if not path.is_file():
        raise InputError("a lane mask is missing", where=str(path), expected="one mask for each scored view")
    try:
        with Image.open(io.BytesIO(store.read_bytes(path))) as picture:
            return np.asarray(picture.convert("L"))
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError, ValueError) as error:
        raise InputError("a lane mask cannot be decoded", where=str(path), got=str(error)) from error
