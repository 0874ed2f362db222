"""Single frames described by an ``info.json``: the per-frame record of common detection code bases, written as JSON.

``data_list`` holds one record with ``images`` by camera, ``lidar_points`` and ``instances``: boxes as seven numbers
(``bbox_3d``) and the number of a class (``bbox_label_3d``, -1 for none). What the numbers mean differs per data set.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.types import Track
from mudg.data.importers.box_tracks import box_size, check_sides
from mudg.data.importers.columns import record_fields

Size = tuple[float, float, float]


@contextmanager
def info_record(path: Path, expected: str) -> Iterator[dict[str, Any]]:
    """The content of ``info.json``; what turns out to be missing in it, or of another type, is an InputError.

    Velocities that are not known are NaN there, so it is no strict JSON: check what is used.

    Args:
        path: the file.
        expected: what the record must hold, for the message.
    """
    with record_fields("frame record is malformed or incomplete", path, expected):
        try:
            record = json.loads(store.read_bytes(path))  # NaN is allowed: velocities that nobody knows
        except RecursionError as error:
            raise ValueError("nested too deeply") from error
        yield record


def info_tracks(
    instances: Sequence[Mapping[str, Any]],
    names: Mapping[int, str],
    where: str,
    shape: Callable[[list[float]], tuple[Size, NDArray[np.float64]]],
) -> list[Track]:
    """One track with one key, at 0 s, per box; boxes of no class (-1) are left out.

    Args:
        instances: the record's boxes.
        names: of the classes by their numbers.
        where: the file, for messages.
        shape: the seven numbers of a box -> length, width, height in metres, and world-from-box f64[4, 4].

    Raises:
        InputError: a class that does not exist, a size that makes no sense, or a box that is not finite.
    """
    tracks = []
    for index, item in enumerate(instances):
        number, here = int(item["bbox_label_3d"]), f"{where}: instances[{index}]"
        if number < 0:
            continue
        if number not in names:
            raise InputError("box has a class that does not exist", where=here, got=str(number),
                expected=", ".join(f"{n} ({name})" for n, name in names.items())[:200])  # fmt: skip
        values = [float(value) for value in item["bbox_3d"]]
        if not np.isfinite(values).all():
            raise InputError("box is not finite", where=here, got=str(item["bbox_3d"]))
        size_m, pose = shape(values)
        size_m = box_size(*size_m, where=here)
        tracks.append(Track(str(index), names[number], np.array(size_m), np.zeros(1), pose[None]))
    check_sides(tracks, where)
    return tracks
