"""The sensor simulator: a reconstruction answers what a camera or LiDAR would measure, wherever a planner drives.

Importing this loads no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mudg.sim.drive import Car, Cockpit, Controls, Drive
    from mudg.sim.env import Env
    from mudg.sim.lidar import BeamTable, LidarReply, LidarRequest
    from mudg.sim.optics import Fisheye, FTheta, Pinhole
    from mudg.sim.session import CameraReply, CameraRequest, Instant, Session, Trust

__all__ = [
    "BeamTable",
    "CameraReply",
    "CameraRequest",
    "Car",
    "Cockpit",
    "Controls",
    "Drive",
    "Env",
    "FTheta",
    "Fisheye",
    "LidarReply",
    "LidarRequest",
    "Instant",
    "Pinhole",
    "Session",
    "Trust",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name == "Env":
        from mudg.sim import env

        return env.Env
    from mudg.sim import drive, lidar, optics, session

    return next(vars(home)[name] for home in (session, lidar, optics, drive) if name in vars(home))
