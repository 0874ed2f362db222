"""Rolling shutters, followed in one pass: points are moved to where a camera that stands still sees them.

Rows (or columns) of an image are read one after the other, while the camera and objects move. A point that lies on a
row is therefore seen from where the camera was when it read that row. In the frame of the camera at the middle of the
read-out this is a displacement of the point: the share of the read-out that has passed by its row, times its motion
against the camera over the whole read-out. So an image needs no strips and has no seams, and any backend draws it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry
from mudg.base.types import Camera, Scene, View
from mudg.core.trajectory import readout_poses

ROUNDS = 3
"""Times that the row of a point is found again where the last round put it."""
NEAREST_M = 0.2
"""Nearer points, and those behind the camera, stay where they are."""


@dataclass(frozen=True, eq=False)
class Readout:
    """How a view's image was read: ``world_from_cam`` f64[2, 4, 4] at the first and at the last row (or column),
    ``begin_s`` and ``end_s`` then."""

    world_from_cam: NDArray[np.float64]
    begin_s: float
    end_s: float

    def motion(
        self, view: View, first: NDArray[np.float64] | None = None, last: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """f64[3, 4]: takes a point (x, y, z, 1) of the world to its motion against the camera over the read-out,
        metres, seen by the camera of ``view``. ``first``, ``last``: f64[4, 4], where points are then that belong to an
        object, from where they are at the view's time; None: they stand still."""
        ends = (np.eye(4) if first is None else first), (np.eye(4) if last is None else last)
        seen = [view.world_from_cam @ geometry.invert(pose) @ end for pose, end in zip(self.world_from_cam, ends)]
        return (seen[1] - seen[0])[:3]


def readout_of(scene: Scene, view: View) -> Readout | None:
    """How a recorded view was read; None for a global shutter, and where the direction of the shutter is unknown."""
    camera = view.camera
    if camera.readout_s <= 0 or camera.shutter == "global":
        return None
    half = camera.readout_s / 2
    return Readout(readout_poses(scene.ego, view), view.time_s - half, view.time_s + half)


def moved_by(points: Tensor, motion: Tensor) -> Tensor:
    """Motion ``[N, 3]`` of points ``[N, 3]`` by a matrix of ``Readout.motion`` ``[3, 4]``."""
    return torch.addmm(motion[:, 3], points, motion[:, :3].T)


def as_read(points: Tensor, motions: Tensor, view: View) -> Tensor:
    """World points ``[N, 3]`` moved to where the camera of ``view``, standing still, sees them as its shutter did;
    ``motions`` ``[N, 3]`` over the read-out. Differentiable in both; the row on which a point lies counts as fixed."""
    with torch.no_grad():
        share = torch.zeros_like(points[:, 0])
        for _ in range(ROUNDS):
            share = _share(points + share[:, None] * motions, view)
    return points + share[:, None] * motions


def points_as_read(scene: Scene, view: View, xyz_world: NDArray[np.float32]) -> NDArray[np.float32]:
    """Points f32[N, 3] that stand still, moved to where the recorded view shows them; as they are for a global
    shutter. NaN stays NaN."""
    readout = readout_of(scene, view)
    if readout is None:
        return xyz_world
    points, motion = torch.from_numpy(xyz_world), torch.from_numpy(readout.motion(view)).to(torch.float32)
    return as_read(points, moved_by(points, motion), view).numpy()


def _share(points: Tensor, view: View) -> Tensor:
    """Share of the read-out that has passed when the row or column of a point is read, from the middle: -0.5 to 0.5,
    ``[N]``."""
    camera, pose = view.camera, torch.from_numpy(view.cam_from_world.copy()).to(points)
    across = camera.shutter in ("left_to_right", "right_to_left")
    axis, focal, center, length = _axis(camera, across)
    z = points @ pose[2, :3] + pose[2, 3]
    side = points @ pose[axis, :3] + pose[axis, 3]
    share = ((focal * side / z.clamp_min(NEAREST_M) + center) / length - 0.5).clamp(-0.5, 0.5)
    share = torch.where(z > NEAREST_M, share, 0.0)
    return -share if camera.shutter in ("bottom_to_top", "right_to_left") else share


def _axis(camera: Camera, across: bool) -> tuple[int, float, float, int]:
    return (0, camera.fx, camera.cx, camera.width) if across else (1, camera.fy, camera.cy, camera.height)
