"""A scene made of photographs at hand: for short fits to a part of a log, or to pictures that nobody took."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from mudg.base.types import EgoPath, Matrix, Photo, Source, SweepPoints, Track
from mudg.data.scene.write import SceneWriter

PlacedSweep = tuple[str, float, Matrix, SweepPoints]
"""Sensor, time in seconds, world_from_lidar f64[4,4], points."""


def write_photos(
    folder: Path, source: Source, ego: EgoPath, tracks: Sequence[Track], photos: Sequence[Photo], sweeps: Iterable[PlacedSweep]
) -> None:  # fmt: skip
    """Write a scene of some photographs, with their classes where they have any, all of them for training.

    Frames and sweeps are numbered per camera and sensor in the order given. Photographs of one camera have one size.
    """
    counts: dict[str, int] = {}

    def numbered(name: str) -> str:
        counts[name] = counts.get(name, -1) + 1
        return f"{name}/{counts[name]:06d}"

    with SceneWriter(folder, "photographs", source) as writer:
        for photo in photos:
            writer.add_camera(photo.view.camera)
        writer.set_ego(ego)
        for track in tracks:
            writer.add_track(track)
        for photo in photos:
            labels = {} if photo.semantics is None else {"semantics": photo.semantics}
            writer.add_frame(numbered(photo.view.camera.name), photo.view, photo.rgb, labels)
        for sensor, time_s, world_from_lidar, points in sweeps:
            writer.add_sweep(numbered(sensor), sensor, time_s, world_from_lidar, points)
        writer.finish()
