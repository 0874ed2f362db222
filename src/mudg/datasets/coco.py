"""COCO: instances with masks as run lengths, and panoptic segmentation. Categories are the 19 classes of Cityscapes.

Source: the data format page of cocodataset.org. Category ids are train ids plus 1; a panoptic id is
``R + 256 G + 65536 B``; run lengths count down the columns and begin with pixels outside the mask.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.palette import CLASSES, DISPLAY_COLORS, DYNAMIC_IDS, ID, UNLABELLED
from mudg.base.versions import version
from mudg.datasets.samples import LabelledView, ObjectBox, around

FILES: Final = ("images/*.png", "panoptic/*.png", "annotations/*.json", "provenance.jsonl")
CATEGORY_OF: Final = {
    **dict.fromkeys(("vehicle", "van"), "car"),
    **dict.fromkeys(("pedestrian", "adult", "child", "person_sitting"), "person"),
    **dict.fromkeys(("cyclist", "bicyclist", "motorcyclist"), "rider"),
    "tram": "train",
}
"""Label -> class, where they differ."""


def write_view(folder: Path, view: LabelledView) -> dict[str, Any]:
    """The image, its panoptic image, and its annotations."""
    name, classes, instances = f"{view.number:06d}.png", view.layers["classes"], view.layers["instances"]
    height, width = classes.shape
    store.write_image(folder / "images" / name, view.layers["rgb"])
    segments, ids, annotations = [], np.zeros((height, width), np.uint32), []
    for box in view.boxes:
        mask = instances == box.number
        whole = _segment(mask, ids, segments, class_of(box, classes[mask]), False)
        mask_of = {"size": [height, width], "counts": run_lengths(mask)}
        more = {"segmentation": mask_of, "track_id": box.track_id, "seen_from_deg": box.seen_from_deg}
        annotations.append({**whole, **more})
    for train_id in np.unique(classes[ids == 0]).tolist():
        if train_id != UNLABELLED:
            _segment((classes == train_id) & (ids == 0), ids, segments, train_id, train_id in DYNAMIC_IDS)
    panoptic = np.stack([(ids >> s) & 255 for s in (0, 8, 16)], -1).astype(np.uint8)
    store.write_image(folder / "panoptic" / name, panoptic)
    image = {"id": view.number, "file_name": name, "width": width, "height": height}
    return {"entry": image, "annotations": annotations, "segments": segments}


def _segment(
    mask: NDArray[np.bool_], ids: NDArray[np.uint32], segments: list[dict[str, Any]], train_id: int, crowd: bool
) -> dict[str, Any]:
    """Add a segment of some pixels to the list and to the picture of ids; returns it."""
    left, top, right, bottom = around(mask)
    whole = {"id": len(segments) + 1, "category_id": 1 + train_id, "area": int(mask.sum())}
    segments.append({**whole, "bbox": [left, top, right - left, bottom - top], "iscrowd": int(crowd)})
    ids[mask] = len(segments)
    return segments[-1]


def write_whole(folder: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """``annotations/instances.json`` and ``annotations/panoptic.json``; ``instances_train.json`` and so on of several
    splits."""
    splits = list(dict.fromkeys(record["split"] for record in records))
    categories = [
        {"id": index + 1, "name": name, "isthing": int(index in DYNAMIC_IDS), "color": DISPLAY_COLORS[index].tolist()}
        for index, name in enumerate(CLASSES)
    ]
    info = {"description": "rendered by mudg", "version": version()}
    for split in splits:
        own = [record for record in records if record["split"] == split]
        images = [record["entry"] for record in own]
        whole = {"info": info, "licenses": [], "images": images, "categories": categories}
        each = ({**one, "image_id": record["entry"]["id"]} for record in own for one in record["annotations"])
        instances = [{**one, "id": number + 1} for number, one in enumerate(each)]
        names = ({"image_id": image["id"], "file_name": image["file_name"]} for image in images)
        panoptic = [{**name, "segments_info": one["segments"]} for name, one in zip(names, own, strict=True)]
        ending = f"_{split}.json" if len(splits) > 1 else ".json"
        store.write_json(folder / "annotations" / f"instances{ending}", {**whole, "annotations": instances})
        store.write_json(folder / "annotations" / f"panoptic{ending}", {**whole, "annotations": panoptic})


def class_of(box: ObjectBox, seen: NDArray[np.uint8]) -> int:
    """The class of an object: of its label, or most of its pixels where the label is none of the classes."""
    name = CATEGORY_OF.get(box.label, box.label)
    if name in ID:
        return ID[name]
    known = seen[np.isin(seen, DYNAMIC_IDS)]
    return int(np.bincount(known).argmax()) if len(known) else ID["car"]


def run_lengths(mask: NDArray[np.bool_]) -> list[int]:
    """Lengths of runs of pixels outside and inside a mask in turn, down the columns."""
    flat = mask.T.reshape(-1)
    edges = np.flatnonzero(np.diff(flat)) + 1
    lengths = np.diff(np.concatenate([[0], edges, [len(flat)]])).tolist()
    return [0, *lengths] if flat[0] else lengths
