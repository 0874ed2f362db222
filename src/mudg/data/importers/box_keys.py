"""Boxes of a data set to tracks: keys in time order, split where a box was not seen, sizes checked for swapped sides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log
from mudg.base.errors import InputError
from mudg.base.types import Track

Matrix = NDArray[np.float64]

LONGER_THAN_WIDE: Final = frozenset({"car", "van", "bus"})
"""Labels whose boxes are longer than wide in every data set (a truck's cab may be a box of its own)."""
_MAX_SIDE_M: Final = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class BoxKey:
    """One annotated box.

    Args:
        track: the data set's id of the object.
        label: lower-case class, e.g. ``car``.
        time_s: moment of the annotation.
        size_m: length (x), width (y), height (z).
        map_from_box: box frame (x forward, y left, z up, origin in the centre) to the map, f64[4, 4].
    """

    track: str
    label: str
    time_s: float
    size_m: tuple[float, float, float]
    map_from_box: Matrix


def box_size(length: Any, width: Any, height: Any, where: str) -> tuple[float, float, float]:
    """Length, width, height as finite positive metres, or an InputError."""
    try:
        size = (float(length), float(width), float(height))
    except (TypeError, ValueError) as error:
        raise InputError("box size is not made of numbers", where=where, got=str(error)) from error
    if not all(np.isfinite(side) and 0 < side < _MAX_SIDE_M for side in size):
        raise InputError(
            "box size makes no sense",
            where=where,
            expected=f"length, width, height in metres, positive, under {_MAX_SIDE_M:.0f}",
            got=f"length {length}, width {width}, height {height}",
        )
    return size


def label_of(category: str, names: Mapping[str, str], unknown: set[str]) -> str:
    """The product's word for a data set's category; one that is not in ``names`` keeps its own word and is remembered.

    Its own word is the last part after a dot, in lower case.
    """
    if category in names:
        return names[category]
    unknown.add(category)
    return category.rsplit(".", 1)[-1].strip().lower().replace(" ", "_") or "unknown"


def warn_unknown(dataset: str, unknown: set[str]) -> None:
    """Say which categories were not known."""
    if unknown:
        log.warn(
            f"{dataset}: categories that are not known keep their own names and get no class: {', '.join(sorted(unknown))}"
        )


def build_tracks(boxes: Sequence[BoxKey], max_gap_s: float, where: str) -> tuple[list[Track], list[str]]:
    """Tracks from boxes in any order.

    A track with a gap longer than ``max_gap_s`` is split into ``id``, ``id.1``, ...: interpolating across would invent
    its path. The size is the median over the object's boxes, the label its commonest one.

    Args:
        where: what the boxes were read from, for messages.

    Returns:
        The tracks in the order of their first boxes, and notes for people.

    Raises:
        InputError: two boxes of one object at one time, or sizes whose length and width are swapped.
    """
    members: dict[str, list[BoxKey]] = {}
    for box in boxes:
        members.setdefault(box.track, []).append(box)
    tracks: list[Track] = []
    split = 0
    for name, keys in members.items():
        keys.sort(key=lambda key: key.time_s)
        times = np.array([key.time_s for key in keys])
        if (np.diff(times) <= 0).any():
            at = times[int(np.flatnonzero(np.diff(times) <= 0)[0])]
            raise InputError("an object has two boxes at one time", where=where, got=f"object {name}, time {at:.6f} s")
        size = np.median([key.size_m for key in keys], axis=0)
        labels = [key.label for key in keys]
        label = max(dict.fromkeys(labels), key=labels.count)
        pieces = np.split(np.arange(len(keys)), np.flatnonzero(np.diff(times) > max_gap_s) + 1)
        split += len(pieces) > 1
        for part, piece in enumerate(pieces):
            poses = np.stack([keys[i].map_from_box for i in piece])
            tracks.append(Track(f"{name}.{part}" if part else name, label, size, times[piece], poses))
    check_sides(tracks, where)
    tracks.sort(key=lambda track: float(track.times_s[0]))
    return tracks, [f"{split} tracks were split where a box is not seen for more than {max_gap_s:g} s"] if split else []


def check_sides(tracks: Sequence[Track], where: str) -> None:
    """Refuse a log in which most vehicles are wider than long: length and width were read in the wrong order."""
    vehicles = [track for track in tracks if track.label in LONGER_THAN_WIDE]
    wide = [track for track in vehicles if track.size_m[1] > track.size_m[0]]
    if vehicles and 2 * len(wide) > len(vehicles):
        length, width, _ = wide[0].size_m
        raise InputError(
            "length and width of boxes are swapped",
            where=where,
            expected="vehicles longer than wide",
            got=f"{len(wide)} of {len(vehicles)} are wider than long, e.g. {wide[0].label} {wide[0].id}: "
            f"{length:.2f} m long, {width:.2f} m wide",
            remedy="check the order in which the sizes were written",
        )


def clip_track(track: Track, start_s: float, end_s: float) -> Track | None:
    """The keys of a track that matter from ``start_s`` to ``end_s``: those inside and one beyond each end; None if it is not there then."""
    if track.times_s[-1] < start_s - 1e-6 or track.times_s[0] > end_s + 1e-6:
        return None
    first = max(0, int(np.searchsorted(track.times_s, start_s + 1e-6)) - 1)
    last = min(len(track.times_s), int(np.searchsorted(track.times_s, end_s - 1e-6)) + 1)
    return Track(track.id, track.label, track.size_m, track.times_s[first:last], track.world_from_object[first:last])
