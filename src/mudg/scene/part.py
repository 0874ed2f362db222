"""A part of a scene as a scene of its own: some frames and sweeps as they are, and frames of which only the place is
told.

For measurements on held-out frames. What is held out is not in the files: an image is replaced by a black one, labels
and sweeps are left out, and so are the classes of LiDAR points, which are truth that is scored, and the recipe by which
a generated city could be drawn again. Whatever reads the part cannot have seen more.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mudg.base.types import EgoPath, Frame, Matrix, Photo, Scene, Source, SweepPoints, Track
from mudg.scene.write import SceneWriter

# a scene made of photographs at hand: for short fits to a part of a log, or to pictures that nobody took --------------


PlacedSweep = tuple[str, float, Matrix, SweepPoints]
"""Sensor, time in seconds, world_from_lidar f64[4,4], points."""


def write_photos(
    folder: Path,
    source: Source,
    ego: EgoPath,
    tracks: Sequence[Track],
    photos: Sequence[Photo],
    sweeps: Iterable[PlacedSweep],
) -> None:
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


# part ---------------------------------------------------------------------------------------------


def write_part(
    scene: Scene,
    root: Path,
    frames: Collection[str],
    sweeps: Collection[str],
    places: Sequence[Frame] = (),
    held_out: Collection[str] = (),
) -> Scene:
    """Write some frames and sweeps of a scene, with all tracks and the whole ego path, without classes of points.

    Args:
        scene: what is copied, byte by byte where its manifest allows.
        frames, sweeps: ids of what is shown; these frames are for training, but for those of ``held_out``, which are
            for scoring.
        places: frames of which camera, pose and time are told, with a black image; they are held out. They may belong
            to a larger scene of the same log.
    """
    shown = [frame for frame in scene.frames if frame.id in frames]
    cameras = {frame.view.camera.name: frame.view.camera for frame in (*shown, *places)}
    ordered = {name: cameras[name] for name in dict.fromkeys((*scene.cameras, *cameras)) if name in cameras}
    base = replace(
        scene, cameras=ordered, split={}, sweeps=tuple(sweep for sweep in scene.sweeps if sweep.id in sweeps)
    )
    with SceneWriter(root, scene.id, replace(scene.source, recipe=None)) as writer:
        writer.copy_all_but_frames(base, point_classes=False)
        for frame in shown:
            writer.copy_frame(scene, frame)
        for frame in places:
            camera = frame.view.camera
            writer.add_frame(frame.id, frame.view, np.zeros((camera.height, camera.width, 3), np.uint8))
        writer.set_split(dict.fromkeys((*(frame.id for frame in places), *held_out), "test"))
        return writer.finish()
