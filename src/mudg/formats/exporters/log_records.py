"""A driving log as records over time: what every format of messages is made of, collected in one place.

Times count from the first record. Pictures and sweeps are read when they are asked for, one at a time.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import PurePosixPath
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.palette import CLASSES, DISPLAY_COLORS, ID
from mudg.base.types import Frame, PointCloud, Scene, Sweep, SweepPoints, Track

NANO: Final = 1_000_000_000
BOX_LIFE_S: Final = 0.15
"""Boxes vanish if no message follows for this long."""
MOUNT_M: Final = 1e-4
"""Metres (and entries of rotations) by which the place of a fixed sensor on the vehicle may vary."""

Matrix = NDArray[np.float64]


class LogRecords:
    """The records of a log.

    Args:
        picture: bytes of a frame's image. points: of a sweep. fused: a cloud that is sent once, or None.
    """

    def __init__(
        self,
        scene: Scene,
        picture: Callable[[Frame], bytes],
        points: Callable[[Sweep], SweepPoints],
        fused: PointCloud | None = None,
    ) -> None:
        self.scene, self.picture, self.points = scene, picture, points
        self.fused = fused if fused is not None and len(fused) else None
        times = [f.view.time_s for f in scene.frames] + [s.time_s for s in scene.sweeps] + scene.ego.times_s.tolist()
        self.start_s = min(times, default=0.0)

    def nanoseconds(self, time_s: float) -> int:
        """Since the first record."""
        return max(0, round((time_s - self.start_s) * NANO))

    def moments(self) -> list[float]:
        """Seconds of all pictures and sweeps, each once, in order."""
        return sorted({f.view.time_s for f in self.scene.frames} | {s.time_s for s in self.scene.sweeps})

    def boxes(self, time_s: float) -> list[tuple[Track, Matrix]]:
        """The objects that are there at a time, and their poses."""
        found = [(track, track.pose_at(time_s)) for track in self.scene.tracks]
        return [(track, pose) for track, pose in found if pose is not None]

    def mounts(self, tolerance_m: float = MOUNT_M) -> dict[str, Matrix]:
        """Ego-from-sensor f64[4, 4] of the sensors that do not move on the vehicle: ``camera/NAME``, ``lidar/NAME``.

        A sensor whose recorded poses the vehicle's path does not explain to ``tolerance_m`` is left out.
        """
        first: dict[str, Matrix] = {}
        moving: set[str] = set()
        for name, time_s, pose in self.sensor_poses():
            ego = self.scene.ego.pose_at(time_s)
            mount = None if ego is None else geometry.invert(ego) @ pose
            if mount is None or np.abs(first.setdefault(name, mount) - mount).max() > tolerance_m:
                moving.add(name)
        return {name: mount for name, mount in first.items() if name not in moving}

    def sensor_poses(self) -> list[tuple[str, float, Matrix]]:
        """``camera/NAME`` or ``lidar/NAME``, seconds, and world-from-sensor of every picture and sweep."""
        return [
            *((f"camera/{f.view.camera.name}", f.view.time_s, f.view.world_from_cam) for f in self.scene.frames),
            *((f"lidar/{s.sensor}", s.time_s, s.world_from_lidar) for s in self.scene.sweeps),
        ]


def picture_format(frame: Frame) -> str:
    """``jpeg``, ``png``, ..., by the name of the file."""
    ending = PurePosixPath(frame.image.path).suffix.lower().lstrip(".")
    return {"jpg": "jpeg"}.get(ending, ending)


def box_color(label: str) -> tuple[float, float, float]:
    """Red, green, blue in [0, 1] of a class name."""
    name = {"pedestrian": "person", "cyclist": "rider", "van": "car"}.get(label.lower(), label.lower())
    red, green, blue = DISPLAY_COLORS[ID[name]].tolist() if name in CLASSES else (160, 160, 160)
    return red / 255, green / 255, blue / 255


def above(pose: Matrix, track: Track) -> Matrix:
    """Where the name of an object stands: 0.4 m over its box."""
    return pose @ geometry.yaw_matrix(0.0, (0, 0, float(track.size_m[2]) / 2 + 0.4))
