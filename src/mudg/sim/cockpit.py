"""A vehicle in a reconstruction: the road and the road users of its log, and the cameras on the vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Camera
from mudg.gaussians.model import compose
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.views import resized_view
from mudg.scene.road import Road
from mudg.sim.drive import Drive, RoadUser, Traffic, beginning
from mudg.sim.optics import Pinhole
from mudg.sim.session import CameraReply, CameraRequest, Instant, Layer, Session

OPAQUE: Final = 0.5
"""Opacity from which on a Gaussian of the surroundings stops a vehicle."""


class Cockpit:
    """A session with a vehicle in it. ``session``: of a run, whose log tells the road. ``cameras``: names of the log's
    cameras (empty: the first one). ``width_px``: of their pictures (0 = as recorded). ``layers``: of
    ``session.LAYERS``, without motion. InputError: a fit without its log, or a log that stands still. UsageError: no
    such camera."""

    def __init__(
        self, session: Session, cameras: str | Sequence[str] = (), width_px: int = 0, layers: Sequence[Layer] = ("rgb",)
    ) -> None:
        if session.scene is None:
            remedy = "give the folder of a run, or scene="
            raise InputError("driving needs the log of a fit, which tells the road", remedy=remedy)
        self.session, self.ego, self.layers = session, session.scene.ego, tuple(layers)
        self.cameras: dict[str, Camera] = {}
        self.mounts: dict[str, NDArray[np.float64]] = {}
        for name in ((cameras,) if isinstance(cameras, str) else tuple(cameras)) or tuple(session.cameras)[:1]:
            frames = session.scene.frames_of(name) if name in session.cameras else ()
            known = [(frame.view, self.ego.pose_at(frame.view.time_s)) for frame in frames]
            view, ego = next(((view, pose) for view, pose in known if pose is not None), (None, None))
            if view is None or ego is None:
                raise UsageError("no such camera", where="cameras", expected=", ".join(session.cameras), got=name[:60])
            self.mounts[name] = geometry.invert(ego) @ view.world_from_cam
            self.cameras[name] = resized_view(view, width_px).camera
        self.road = Road(self.ego.world_from_ego)
        self.actors = {}
        for node in session.model.nodes:
            if isinstance(node, RigidNode):
                keys = [(time, pose) for time in node.times_s if (pose := node.pose_matrix(float(time))) is not None]
                times, poses = zip(*keys, strict=True)
                self.actors[node.name] = RoadUser(np.array(times), np.stack(poses), node.size_m)
        begin = session.time_range_s[0]
        still = compose(session.at(Instant(begin, np.eye(4), {})), begin)
        self.solid = still.means[still.opacity > OPAQUE].detach().cpu().numpy()

    def drive(self, time_s: float | None = None, shift_m: float = 0.0, traffic: Traffic = "log") -> Drive:
        """A drive that begins where the recorded vehicle was, moved to the left, at its speed. ``time_s``: None: as
        early as objects and vehicle were recorded. UsageError: a time outside the log."""
        first = max(self.session.time_range_s[0], float(self.ego.times_s[0]))
        begin = first if time_s is None else time_s
        pose = self.ego.pose_at(begin)
        if pose is None:
            span = f"{self.ego.times_s[0]:.2f} to {self.ego.times_s[-1]:.2f} s"
            raise UsageError("the drive begins outside the log", where="time_s", expected=span, got=f"{begin:.2f} s")
        speed = RoadUser(self.ego.times_s, self.ego.world_from_ego, ()).speed_at(begin)
        motion = beginning(pose, speed, shift_m)
        return Drive(self.road, self.actors, motion, begin, traffic, self.solid)

    def see(self, drive: Drive) -> dict[str, CameraReply]:
        """What the cameras see, by name; where road users move as recorded, all that the scene knows."""
        objects = {name: box.world_from_box for name, box in drive.boxes().items()} if drive.traffic != "log" else None
        moments = {name: Instant(drive.time_s, drive.pose @ mount, objects) for name, mount in self.mounts.items()}
        requests = [
            CameraRequest(
                optics=Pinhole(camera.width, camera.height, *camera.intrinsics),
                start=moments[name],
                layers=self.layers,
                colors_of=name,
            )
            for name, camera in self.cameras.items()
        ]
        return dict(zip(self.cameras, self.session.render(requests), strict=True))
