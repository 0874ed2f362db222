"""The small city as a Waymo log, made once for all tests of the format, and handed out as copies to change."""

from __future__ import annotations

import copy
import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import roundtrip
import write_waymo as made

from mudg.base import geometry
from mudg.base.geometry import invert, yaw_matrix
from mudg.base.types import Scene, Track
from mudg.city import sensors
from mudg.formats.importers import IMPORTERS
from mudg.formats.importers.common import ImportOptions
from mudg.scene.read import read_scene

COLUMNS = 240


def ingest(source: Path, out: Path, **options: Any) -> Scene:
    """Import a Waymo log."""
    return IMPORTERS["waymo"](source, out, ImportOptions(**options))


def write(log: made.Log, form: str, folder: Path) -> Path:
    """The log in format ``v1`` or ``v2``."""
    if form == "v1":
        return made.write_tfrecord(log, folder / f"segment-{log.name}_with_camera_labels.tfrecord")
    pytest.importorskip("pyarrow")
    return made.write_parquet(log, folder)


def city(factory: pytest.TempPathFactory) -> tuple[Scene, tuple[Track, ...]]:
    """A tiny city whose boxes stand upright in the vehicle, as the data set's do, and its tracks at all times."""
    return _city(factory.getbasetemp() / "waymo city")


def whole(factory: pytest.TempPathFactory) -> made.Log:
    """The city as a Waymo log that the test may change."""
    return copy.deepcopy(_written(factory.getbasetemp() / "waymo city"))


@functools.cache
def _city(folder: Path) -> tuple[Scene, tuple[Track, ...]]:
    truth = roundtrip.small_log(folder)
    tracks = []
    for track in truth.tracks:
        poses = track.world_from_object.copy()
        for index, time in enumerate(track.times_s):
            vehicle = truth.ego.pose_at(float(time))
            assert vehicle is not None
            local = invert(vehicle) @ poses[index]
            poses[index, :3, :3] = (vehicle @ yaw_matrix(geometry.yaw_of(local)))[:3, :3]
        tracks.append(Track(track.id, track.label, track.size_m, track.times_s, poses))
    return replace(truth, tracks=tuple(tracks)), read_scene(folder).tracks


@functools.cache
def _written(folder: Path) -> made.Log:
    return made.log_of(*_city(folder), beams=sensors.lidar_elevations(roundtrip.SMALL), columns=COLUMNS)
