"""Classes that people gave to PandaSet's points: ``annotations/semseg`` -> train ids of ``base/palette.py``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, palette, store
from mudg.base.errors import InputError
from mudg.data.importers import layout
from mudg.data.importers.columns import finite_columns, require_columns
from mudg.data.importers.options import ImportOptions
from mudg.data.importers.pandaset.pandas_frame import read_frame
from mudg.data.unknown_fields import note_unknown

CLASS_OF: Final[dict[str, str]] = {
    "Smoke": "", "Exhaust": "", "Spray or rain": "",  # no surface
    "Reflection": "",  # a ghost: nothing is there
    "Vegetation": "vegetation",
    "Ground": "terrain",  # unpaved ground
    "Road": "road", "Lane Line Marking": "road", "Stop Line Marking": "road", "Other Road Marking": "road",
    "Sidewalk": "sidewalk",
    "Driveway": "",  # crosses the sidewalk and is driven on: people label it either way
    "Car": "car",
    "Pickup Truck": "truck",  # by definition of Cityscapes, as their boxes here
    "Medium-sized Truck": "truck", "Semi-truck": "truck",
    "Towed Object": "",  # trailers behind cars have no class of their own
    "Motorcycle": "motorcycle", "Motorized Scooter": "motorcycle",
    "Other Vehicle - Construction Vehicle": "truck",
    "Other Vehicle - Uncommon": "", "Other Vehicle - Pedicab": "",
    "Emergency Vehicle": "",  # cars and trucks
    "Bus": "bus",
    "Personal Mobility Device": "",
    "Bicycle": "bicycle",
    "Train": "train", "Trolley": "train", "Tram / Subway": "train",
    "Pedestrian": "person", "Pedestrian with Object": "person",
    "Animals - Bird": "", "Animals - Other": "",
    "Pylons": "", "Cones": "", "Rolling Containers": "",
    "Road Barriers": "", "Temporary Construction Barriers": "",  # walls, fences and guard rails
    "Signs": "traffic sign", "Construction Signs": "traffic sign",
    "Building": "building",
    "Other Static Object": "",  # poles, traffic lights, walls, fences and more
}  # fmt: skip
"""The data set's classes -> classes of ``palette.CLASSES``; empty = unlabelled, because no class or several would fit."""


class PointClasses:
    """The class tables of the chosen frames.

    Args:
        folder: ``annotations/semseg``. Without any table there no point has a class.
        frames: numbers of the chosen frames.
        options: ``skip_missing`` allows frames without a table.

    Raises:
        InputError: a frame has no table though others have one, or ``classes.json`` is missing or malformed.
    """

    def __init__(self, folder: Path, frames: Sequence[int], options: ImportOptions) -> None:
        self._files: dict[int, Path] = layout.numbered_files(folder, (".pkl.gz", ".pkl"))
        lacks = [number for number in frames if number not in self._files]
        if self._files and lacks and not options.skip_missing:
            raise InputError("a frame has no classes of points", where=str(folder), expected=f"{lacks[0]:02d}.pkl.gz",
                remedy="copy it, choose frames with --frames FIRST:END, or add --skip-missing")  # fmt: skip
        self._names = _names(folder / "classes.json") if self._files else {}
        unknown = sorted(set(self._names.values()) - set(CLASS_OF))
        self.notes = (
            [f"classes of points that are not known here are unlabelled: {', '.join(unknown[:8])}"] if unknown else []
        )
        """Sentences about the tables, for people."""

    def of(self, frame: int, points: int) -> NDArray[np.uint8] | None:
        """Train ids u8[points] of a frame's cloud, 255 where unlabelled; None for a frame without a table."""
        path = self._files.get(frame)
        if path is None:
            return None
        table = read_frame(path)
        require_columns(("class",), table, path)
        note_unknown("annotations/semseg/*.pkl.gz", table, frozenset({"class"}))
        numbers = finite_columns(table, ("class",), path)[:, 0].astype(np.int64)
        if len(numbers) != points:
            raise InputError("classes do not fit the points", where=f"{path}: class", got=f"{len(numbers)} rows",
                expected=f"{points} rows, one for each point of the frame's cloud",
                remedy="is the file of another frame or sequence?")  # fmt: skip
        return self._train_ids(numbers, path)

    def _train_ids(self, numbers: NDArray[np.int64], path: Path) -> NDArray[np.uint8]:
        present, where = np.unique(numbers, return_inverse=True)
        strange = [int(number) for number in present if int(number) not in self._names]
        if strange:
            log.warn(f"pandaset: {path}: classes {strange[:8]} are not in classes.json; their points are unlabelled")
        ids = [train_id(self._names.get(int(number), "")) for number in present]
        return np.array(ids, np.uint8)[where]


def train_id(name: str) -> int:
    """The train id of one of the data set's classes; ``UNLABELLED`` where it has none."""
    return palette.ID.get(CLASS_OF.get(name, ""), palette.UNLABELLED)


def _names(path: Path) -> Mapping[int, str]:
    """Number -> name of the data set's classes."""
    if not path.is_file():
        raise InputError("table of class names is missing", where=str(path), expected='{"1": "Smoke", ...}',
            remedy="copy annotations/semseg/classes.json, or leave out annotations/semseg")  # fmt: skip
    values: Any = store.read_json(path)
    if not isinstance(values, dict) or not all(str(key).isdigit() and isinstance(values[key], str) for key in values):
        raise InputError("table of class names is malformed", where=str(path), expected='{"1": "Smoke", ...}',
            got=str(values)[:80])  # fmt: skip
    return {int(key): name for key, name in values.items()}
