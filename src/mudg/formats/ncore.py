"""What writing and reading NCore files (version 4 of NVIDIA's format of recordings) share: the package, names,
rotations of boxes, poses between keys.

Conventions, as the package's own functions apply them: world right-handed with z up; rig x forward, y left, z up;
cameras x right, y down, z forward, the centre of the top-left pixel at (0.5, 0.5); times in whole microseconds; between
keys poses move in straight lines and rotate evenly. A LiDAR's rays are directions in the sensor's frame at their own
time. A box is turned about x, then y, then z of the fixed frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from mudg.base.errors import ResourceError
from mudg.base.geometry import from_rotation_translation
from mudg.base.types import Camera

Matrix = NDArray[np.float64]
Times = NDArray[np.int64]

RIG: Final = "rig"
WORLD: Final = "world"
INSTANCE: Final = "default"
"""Name of a component of which a recording has one: poses, intrinsics, masks, boxes."""
EGO_MASK: Final = "ego"
"""Mask of a camera that is not 0 where the recording vehicle is seen."""
MARK: Final = ".ncore4"
"""What stands in the names of the files, after the name of the recording."""
ABOUT: Final = "mudg"
"""Key of what this program notes about a recording."""
SWEEP_TIME: Final = "sweep_timestamp_us"
"""Key of the moment of a sweep, of which the format knows only begin and end."""
MICRO: Final = 1_000_000
EULER: Final = "xyz"
"""Axes about which a box is turned; small letters: fixed ones."""


def package() -> Any:
    """The modules of the package ``nvidia-ncore``, loaded when they are first asked for: ``data`` (types), ``v4``
    (files), ``sensors`` (projection), ``transformations``. Raises ResourceError: it is not installed."""
    try:
        import ncore.data.v4
        import ncore.impl.common.transformations
        import ncore.sensors
    except ImportError as error:
        what = "NCore files need the package nvidia-ncore, which is not installed"
        raise ResourceError(what, got=str(error), remedy="pip install 'mudg[ncore]'") from error
    transformations = ncore.impl.common.transformations
    return SimpleNamespace(data=ncore.data, v4=ncore.data.v4, sensors=ncore.sensors, transformations=transformations)


def close(reader: Any) -> None:
    """Close the files of a ``SequenceComponentGroupsReader``, for which the package has no call."""
    for group, _ in reader._component_stores.values():
        files = getattr(group.store, "store", group.store)  # below what holds the consolidated metadata
        if hasattr(files, "close"):
            files.close()


@dataclass(frozen=True, slots=True, eq=False)
class PoseKeys:
    """A frame's poses over time. ``times_us``: i64[K], increasing, at least two. poses: f64[K, 4, 4], rigid."""

    times_us: Times
    poses: Matrix

    def at(self, times_us: Times) -> Matrix:
        """Poses f64[N, 4, 4] at times i64[N] from the first to the last key."""
        turned = Slerp(self.times_us, Rotation.from_matrix(self.poses[:, :3, :3]))(times_us)
        after = np.clip(np.searchsorted(self.times_us, times_us), 1, len(self.times_us) - 1)
        span = self.times_us[after] - self.times_us[after - 1]
        share = ((times_us - self.times_us[after - 1]) / span)[:, None]
        poses = np.tile(np.eye(4), (len(times_us), 1, 1))
        poses[:, :3, :3] = turned.as_matrix()
        poses[:, :3, 3] = (1 - share) * self.poses[after - 1, :3, 3] + share * self.poses[after, :3, 3]
        return poses

    def covering(self, start_us: int, end_us: int) -> PoseKeys:
        """With keys at both ends of a span of time, where it reaches beyond: the frame goes on as it did between its
        two nearest keys, for no longer than these lie apart, and then stands."""
        times, poses = [*self.times_us.tolist()], [*self.poses]
        for at, end, near, far in ((0, start_us, 0, 1), (len(times) + 1, end_us, -1, -2)):
            if not times[0] <= end <= times[-1]:
                pose = poses[near]
                if len(times) > 1:
                    share = min(abs((end - times[near]) / (times[near] - times[far])), 1.0)
                    here, before = (Rotation.from_matrix(poses[n][:3, :3]) for n in (near, far))
                    turn = Rotation.from_rotvec(share * (here * before.inv()).as_rotvec()) * here
                    place = pose[:3, 3] + share * (pose[:3, 3] - poses[far][:3, 3])
                    pose = from_rotation_translation(turn.as_matrix(), place)
                times.insert(at, end)
                poses.insert(at, pose)
        return PoseKeys(np.array(times, np.int64), np.stack(poses))


# shutters -----------------------------------------------------------------------------------------


def unknown_shutter(camera: Camera) -> bool:
    """Whether a camera has a rolling shutter of which the scene does not say the direction."""
    return camera.readout_s > 0 and camera.shutter == "global"


def shutter_type(camera: Camera) -> str:
    """The package's name of a camera's shutter; downwards where the scene does not say the direction."""
    if camera.readout_s <= 0:
        return "GLOBAL"
    return f"ROLLING_{'top_to_bottom' if unknown_shutter(camera) else camera.shutter}".upper()
