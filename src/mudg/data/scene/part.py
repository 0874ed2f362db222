"""A part of a scene as a scene of its own: some frames and sweeps as they are, and frames of which only the place is told.

For measurements on held-out frames. What is held out is not in the files: an image is replaced by a black one, labels and sweeps are
left out, and so are the classes of LiDAR points, which are truth that is scored, and the recipe by which a generated city could be
drawn again. Whatever reads the part cannot have seen more.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mudg.base.types import Frame, Scene
from mudg.data.scene.write import SceneWriter


def write_part(
    scene: Scene, root: Path, frames: Collection[str], sweeps: Collection[str], places: Sequence[Frame] = (),
    held_out: Collection[str] = (),
) -> Scene:  # fmt: skip
    """Write some frames and sweeps of a scene, with all tracks and the whole ego path, without classes of points.

    Args:
        scene: what is copied, byte by byte where its manifest allows.
        frames, sweeps: ids of what is shown; these frames are for training, but for those of ``held_out``, which are for scoring.
        places: frames of which camera, pose and time are told, with a black image; they are held out. They may belong to a larger
            scene of the same log.
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
