"""Camera paths: the recorded one, the same drive shifted sideways or raised, drives that leave it bit by bit, and what
rolling shutters make of them.

Left is the y axis of ``world_from_ego`` at that moment, made horizontal: left of travel for a car driving forwards, and
the vehicle's left also while it stands or reverses.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError
from mudg.base.types import EgoPath, Scene, Trajectory, View

WORLD_UP = np.array([0.0, 0.0, 1.0])
_NAMED: Final = re.compile(r"(?P<kind>up|lane|speed)(?P<metres>[+-]\d+(?:\.\d+)?)")


def trajectory_name(camera: str, shift_m: float | None = None) -> str:
    """Name of a trajectory as used for folders: ``front_recorded``, ``front_shift+2.0`` (left), ``front_shift-4.0``."""
    return f"{camera}_recorded" if shift_m is None else f"{camera}_shift{shift_m:+.1f}"


def ego_left_world(world_from_ego: NDArray[np.float64]) -> NDArray[np.float64]:
    """Horizontal unit vector to the left of the vehicle, ``f64[3]`` in world axes. InputError: when the vehicle lies on
    its side, so that its left axis is vertical."""
    left = world_from_ego[:3, 1].copy()
    left[2] = 0.0
    length = float(np.linalg.norm(left))
    if length < 1e-3:
        what = "the vehicle's left axis is vertical, so there is no lateral direction"
        expected = "ego poses with x forward, y left, z up"
        raise InputError(what, expected=expected, got=f"left axis {world_from_ego[:3, 1].tolist()}")
    return left / length


def recorded(scene: Scene, camera: str) -> Trajectory:
    """The recorded views of one camera in time order. UsageError: unknown camera name, or a camera without frames."""
    views = sorted((frame.view for frame in _frames(scene, camera)), key=lambda view: view.time_s)
    return Trajectory(trajectory_name(camera), tuple(views), "recorded")


def shifted(scene: Scene, camera: str, shift_m: float) -> Trajectory:
    """The drive of one camera, of any mounting direction, with the vehicle moved sideways, one view per recorded frame:
    each camera centre moves by exactly ``shift_m``, positive to the left of the direction of travel; orientation is
    kept. UsageError: unknown camera or a number that is not finite. InputError: no ego pose at a frame's time."""
    if not np.isfinite(shift_m):
        raise UsageError("shift_m must be a finite number", got=str(shift_m))
    views = []
    for view in recorded(scene, camera).views:
        left = ego_left_world(_ego_pose(scene.ego, view))
        world_from_cam = np.array(view.world_from_cam, np.float64)
        world_from_cam[:3, 3] += shift_m * left
        views.append(View(view.camera, world_from_cam, view.time_s))
    return Trajectory(trajectory_name(camera, shift_m), tuple(views), "shifted")


def at_shift(scene: Scene, camera: str, shift_m: float) -> Trajectory:
    """The recorded trajectory where nothing is shifted, else ``shifted``."""
    return shifted(scene, camera, shift_m) if shift_m else recorded(scene, camera)


def named(scene: Scene, camera: str, name: str) -> Trajectory:
    """A path by its name (kind, sign and metres; tables of papers use them), with one view per recorded frame, at its
    time and with its orientation.

    ``up+1``: the drive raised by 1 m. ``lane+0.1``: a lane change, with every frame 0.1 m further to the left of where
    the recorded vehicle is, along the left axis of the first frame. ``speed+0.1``: a faster drive, with every frame 0.1
    m further ahead, along the forward axis of the first frame. A minus means down, right, slower. UsageError: a
    malformed name, or an unknown camera. InputError: no ego pose at the first frame's time.
    """
    found = _NAMED.fullmatch(name)
    if found is None:
        expected = "up+1, lane+0.1 or speed-0.1 (kind, sign, metres)"
        raise UsageError("malformed name of a path", expected=expected, got=name)
    views = recorded(scene, camera).views
    left = ego_left_world(_ego_pose(scene.ego, views[0]))
    direction = {"up": WORLD_UP, "lane": left, "speed": np.cross(left, WORLD_UP)}[found["kind"]]
    moved = []
    for number, view in enumerate(views):
        world_from_cam = np.array(view.world_from_cam, np.float64)
        world_from_cam[:3, 3] += float(found["metres"]) * (1 if found["kind"] == "up" else number) * direction
        moved.append(View(view.camera, world_from_cam, view.time_s))
    return Trajectory(f"{camera}_{name}", tuple(moved), "shifted")


def velocity(path: EgoPath, time_s: float) -> tuple[float, float, float]:
    """Velocity of the vehicle between the recorded poses around a time, metres per second along the world's axes;
    outside the recording that of its first or last two poses, 0 with a single one."""
    if len(path.times_s) < 2:
        return 0.0, 0.0, 0.0
    after = int(np.clip(np.searchsorted(path.times_s, time_s), 1, len(path.times_s) - 1))
    moved_m = path.world_from_ego[after, :3, 3] - path.world_from_ego[after - 1, :3, 3]
    x, y, z = moved_m / (path.times_s[after] - path.times_s[after - 1])
    return float(x), float(y), float(z)


def readout_poses(path: EgoPath, view: View) -> NDArray[np.float64]:
    """Poses of a rolling shutter: world_from_cam f64[2, 4, 4] when the first and when the last row (or column) is read.

    The middle one is read at the view's time; ``camera.readout_s`` lies between first and last. The camera moves as the
    vehicle does; before the first and after the last recorded pose the motion next to it goes on. InputError: the
    view's time is more than 0.2 s outside the vehicle's path.
    """
    _ego_pose(path, view)
    times, poses = path.times_s, path.world_from_ego

    def ego(time_s: float) -> NDArray[np.float64]:
        if len(times) == 1:
            return poses[0]
        after = int(np.clip(np.searchsorted(times, time_s), 1, len(times) - 1))
        fraction = (time_s - times[after - 1]) / (times[after] - times[after - 1])
        return geometry.interpolate_pose(poses[after - 1], poses[after], float(fraction))

    ego_from_cam = geometry.invert(ego(view.time_s)) @ view.world_from_cam
    half = view.camera.readout_s / 2
    return np.stack([ego(view.time_s - half) @ ego_from_cam, ego(view.time_s + half) @ ego_from_cam])


# rolling shutters, followed in one pass ---------------------------------------------------------------
# Rows (or columns) of an image are read one after the other, while the camera and objects move. In the frame of the
# camera at the middle of the read-out this displaces a point by the share of the read-out that has passed by its row,
# times its motion against the camera over the whole read-out. So an image needs no strips, and any backend draws it.


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
    axis, focal, center, length = 1, camera.fy, camera.cy, camera.height
    if camera.shutter in ("left_to_right", "right_to_left"):
        axis, focal, center, length = 0, camera.fx, camera.cx, camera.width
    z = points @ pose[2, :3] + pose[2, 3]
    side = points @ pose[axis, :3] + pose[axis, 3]
    share = ((focal * side / z.clamp_min(NEAREST_M) + center) / length - 0.5).clamp(-0.5, 0.5)
    share = torch.where(z > NEAREST_M, share, 0.0)
    return -share if camera.shutter in ("bottom_to_top", "right_to_left") else share


def _frames(scene: Scene, camera: str) -> tuple:
    if camera not in scene.cameras:
        what = f"the scene has no camera named {camera!r}"
        raise UsageError(what, where=f"scene {scene.id}", expected=f"one of {', '.join(scene.cameras)}")
    frames = tuple(scene.frames_of(camera))
    if not frames:
        raise UsageError(f"camera {camera!r} has no frames", where=f"scene {scene.id}")
    return frames


def _ego_pose(path: EgoPath, view: View) -> NDArray[np.float64]:
    """Ego pose at the view's time; a camera that fires up to 0.2 s outside the ego track uses the nearest end."""
    pose = path.pose_at(view.time_s)
    if pose is not None:
        return pose
    nearest = 0 if view.time_s < path.times_s[0] else -1
    if abs(path.times_s[nearest] - view.time_s) <= 0.2:
        return path.world_from_ego[nearest]
    what = "no ego pose at the time of a camera frame, so there is no left direction"
    expected = f"a time within [{path.times_s[0]}, {path.times_s[-1]}] s"
    raise InputError(what, where=f"camera {view.camera.name}", expected=expected, got=f"{view.time_s} s")
