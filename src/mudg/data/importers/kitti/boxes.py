"""KITTI boxes: tracking and object label text, raw-data tracklets; all become boxes in the velodyne frame per frame number."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation, invert, yaw_matrix
from mudg.base.types import Track
from mudg.data.importers.box_tracks import BoxTracks, box_size
from mudg.data.importers.kitti.poses import read_lines
from mudg.data.importers.kitti.scans import azimuth_delay_s
from mudg.data.unknown_fields import note_unknown

Matrix = NDArray[np.float64]
MAX_TRACKLET_BYTES = 256 * 1024 * 1024
LABELS = frozenset(
    ("car", "van", "truck", "pedestrian", "person_sitting", "person (sitting)", "person", "cyclist", "tram", "misc")
)
"""Classes of the benchmarks, in lower case."""
_TRACKLET = frozenset({"objectType", "h", "w", "l", "first_frame", "poses", "finished"})
_TRACKLET_POSE = frozenset({
    "tx", "ty", "tz", "rx", "ry", "rz", "state", "occlusion", "occlusion_kf", "truncation", "amt_occlusion", "amt_occlusion_kf",
    "amt_border_l", "amt_border_r", "amt_border_kf",
})  # fmt: skip
"""Fields of the data set's tracklets, read or not."""


@dataclass(frozen=True, slots=True, eq=False)
class KittiBox:
    """One annotated box.

    Args:
        frame: frame number.
        track: track number; object labels count lines.
        label: lower-case class, e.g. ``car``.
        size_m: length, width, height.
        sensor_from_box: box frame (x forward, y left, z up, origin in the centre) to the velodyne, f64[4, 4].
        box2d_px: annotated rectangle (left, top, right, bottom) in KITTI's pixels, or None.
    """

    frame: int
    track: int
    label: str
    size_m: tuple[float, float, float]
    sensor_from_box: Matrix
    box2d_px: tuple[float, float, float, float] | None = None


def rect0_from_box(bottom_centre_m: Sequence[float], height_m: float, rotation_y: float) -> Matrix:
    """Box frame to rectified camera 0 from KITTI's bottom centre (y down) and turn about the camera's y axis, f64[4, 4]."""
    c, s = np.cos(rotation_y), np.sin(rotation_y)
    forward, left, up = (c, 0.0, -s), (s, 0.0, c), (0.0, -1.0, 0.0)
    centre = np.asarray(bottom_centre_m, np.float64) - [0, height_m / 2, 0]
    return from_rotation_translation(np.array([forward, left, up]).T, centre)


def read_label_text(path: Path, rect0_from_velo: Matrix, frame: int | None = None) -> list[KittiBox]:
    """Boxes of a tracking label file (17 columns and optionally a score), or of an object label file.

    Args:
        path: label text. ``DontCare`` regions are left out.
        rect0_from_velo: boxes are given in rectified camera 0 and returned in the velodyne frame, f64[4, 4].
        frame: frame number for an object label file (15 columns and optionally a score); None for a tracking file.

    Raises:
        InputError: another number of columns, values that are no finite numbers, or a size that makes no sense.
    """
    velo_from_rect0 = invert(rect0_from_velo)
    boxes = []
    skip = 2 if frame is None else 0
    for index, line in read_lines(path).items():
        columns, where = line.split(), f"{path}: line {index + 1}"
        if len(columns) - skip not in (15, 16):
            raise InputError("label line has the wrong number of columns", where=where, got=str(len(columns)),
                expected=f"{15 + skip} (or {16 + skip} with a score)",
                remedy="is this a tracking or an object label file?")  # fmt: skip
        if columns[skip] == "DontCare":
            continue
        try:
            number, track = (frame, index) if frame is not None else (int(columns[0]), int(columns[1]))
            values = [float(text) for text in columns[skip + 1 :]]
        except ValueError as error:
            raise InputError("label value is not a number", where=where, got=str(error)) from error
        if not np.isfinite(values).all():
            raise InputError("label value is not finite", where=where, got=line.strip()[:100])
        left, top, right, bottom, height, width, length, x, y, z, turn = values[3:14]
        size_m = box_size(length, width, height, where)
        pose = velo_from_rect0 @ rect0_from_box((x, y, z), height, turn)
        boxes.append(KittiBox(number, track, columns[skip].lower(), size_m, pose, (left, top, right, bottom)))
    return boxes


def read_tracklets(path: Path) -> list[KittiBox]:
    """Boxes of a raw-data ``tracklet_labels.xml``: velodyne frame, bottom centre, turn about z."""
    content = store.read_bytes(path)
    if len(content) > MAX_TRACKLET_BYTES:
        raise InputError("tracklet file is too large", where=str(path), got=f"{len(content)} bytes")
    if b"<!ENTITY" in content:
        raise InputError("tracklet file declares XML entities, which no KITTI file does", where=str(path),
            remedy="use the file from the data set")  # fmt: skip
    try:
        root = ElementTree.fromstring(content)  # noqa: S314 - entities are refused above, the size is bounded
    except ElementTree.ParseError as error:
        raise InputError("tracklet file is not valid XML (is it cut off?)", where=str(path), got=str(error)) from error
    boxes = []
    for track, item in enumerate(root.findall("./tracklets/item")):
        where = f"{path}: tracklet {track}"
        note_unknown(path.name, [field.tag for field in item], _TRACKLET)
        length, width, height = (_xml_number(item, key, where) for key in ("l", "w", "h"))
        size_m = box_size(length, width, height, where)
        first = int(_xml_number(item, "first_frame", where))
        label = (item.findtext("objectType") or "").strip().lower()
        for step, pose in enumerate(item.findall("./poses/item")):
            here = f"{where} pose {step}"
            note_unknown(path.name, [field.tag for field in pose], _TRACKLET_POSE)
            tx, ty, tz, rz = (_xml_number(pose, key, here) for key in ("tx", "ty", "tz", "rz"))
            boxes.append(KittiBox(first + step, track, label, size_m, yaw_matrix(rz, (tx, ty, tz + height / 2))))
    return boxes


def _xml_number(element: ElementTree.Element, key: str, where: str) -> float:
    text = element.findtext(key)
    try:
        value = float(text) if text is not None else float("nan")
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise InputError(f"tracklet field {key!r} is missing or not a number", where=where, got=repr(text))
    return value


def build_tracks(
    boxes: Sequence[KittiBox],
    world_from_velo: Mapping[int, Matrix],
    times_s: Mapping[int, float],
    where: str,
    velo_at: Callable[[float], Matrix] | None = None,
) -> tuple[list[Track], list[str]]:
    """Tracks in the world from boxes per frame, in the order of their numbers.

    Boxes of frames that are not imported are left out. A track that is not seen for longer than ``box_tracks.MAX_GAP_S``
    is split into ``7``, ``7.1``, ... The size is the median over the track.

    Args:
        boxes: in any order.
        world_from_velo: pose of the velodyne f64[4, 4] by frame number.
        times_s: time of the scan by frame number, seconds.
        where: the file the boxes come from, for messages.
        velo_at: pose of the velodyne at any time, when boxes were drawn into scans that were still twisted: each box then
            belongs to the moment its azimuth was measured, and is moved to the scan's time with the track's velocity.

    Returns:
        The tracks, and notes for people (splits, boxes left out).
    """
    collected = BoxTracks(where, {label: label for label in LABELS})
    delays_s: dict[tuple[str, float], float] = {}
    outside = 0
    for box in boxes:
        if box.frame not in world_from_velo:
            outside += 1
            continue
        name, time_s, pose = str(box.track), times_s[box.frame], world_from_velo[box.frame]
        if velo_at is not None:
            x, y = box.sensor_from_box[:2, 3]
            delay_s = delays_s[name, time_s] = float(azimuth_delay_s(float(np.arctan2(y, x))))
            pose = velo_at(time_s + delay_s)
        record = f"{where}: track {name}, frame {box.frame}"
        collected.add(name, collected.label_of(box.label), time_s, box.size_m, pose @ box.sensor_from_box, where=record)
    found, notes = collected.tracks()
    if velo_at is not None:
        found = [_at_scan_times(track, delays_s) for track in found]
    if outside:
        notes.insert(0, f"{outside} boxes lie in frames that were not imported and were left out")
    return sorted(found, key=lambda track: [int(part) for part in track.id.split(".")]), notes


def _at_scan_times(track: Track, delays_s: Mapping[tuple[str, float], float]) -> Track:
    """The track moved from the moments at which its boxes were measured to the times of the scans."""
    late_s = np.array([delays_s[track.id.split(".")[0], time_s] for time_s in track.times_s])
    if len(late_s) == 1:
        return track
    poses = track.world_from_object.copy()
    poses[:, :3, 3] -= np.gradient(poses[:, :3, 3], track.times_s + late_s, axis=0) * late_s[:, None]
    return replace(track, world_from_object=poses)
