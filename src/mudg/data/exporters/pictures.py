"""Names and bytes of a log's pictures for data sets of cameras."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import PurePosixPath

from mudg.base.types import Scene
from mudg.data.scene.files import open_files


def picture_names(scene: Scene) -> dict[str, str]:
    """Frame id -> ``images/CAMERA/NUMBER.ending``."""
    return {frame.id: f"images/{frame.id}{PurePosixPath(frame.image.path).suffix}" for frame in scene.frames}


def pictures(scene: Scene) -> Iterator[tuple[str, bytes]]:
    """Name and bytes of every picture as the scene holds it."""
    files, names = open_files(scene.root), picture_names(scene)
    for frame in scene.frames:
        yield names[frame.id], files.read(frame.image.path)
