"""Skeleton of a sensor: an ultrasonic parking sensor, which hears the nearest surface (docs/extend/sensor.md)."""

import math
from dataclasses import dataclass

import numpy as np

from mudg.sim import CameraRequest, Instant, Pinhole, Session

PIXELS = 48


@dataclass(frozen=True)
class Echo:
    """Metres to the nearest surface, infinite where nothing answers, and the object that it belongs to ("" = none)."""

    range_m: float
    object: str


@dataclass(frozen=True)
class UltrasonicRequest:
    """What a sensor hears that looks along the z axis of `start.world_from_sensor`, `angle_deg` wide."""

    start: Instant
    angle_deg: float = 60.0
    farthest_m: float = 5.0

    def answer(self, session: Session) -> Echo:
        """The measurement, from the surfaces that a square picture of the cone shows."""
        focal = PIXELS / 2 / math.tan(math.radians(self.angle_deg) / 2)
        lens = Pinhole(PIXELS, PIXELS, focal, focal, PIXELS / 2, PIXELS / 2)
        seen = session.picture(CameraRequest(optics=lens, start=self.start, layers=("distance", "instances")))
        cone = lens.rays()[..., 2] >= math.cos(math.radians(self.angle_deg) / 2)
        distance = seen.layers["distance"]
        distance = np.where(cone & np.isfinite(distance) & (distance <= self.farthest_m), distance, np.inf)
        nearest = int(distance.argmin())
        instance = int(seen.layers["instances"].flat[nearest])
        heard = bool(np.isfinite(distance.flat[nearest])) and instance > 0
        return Echo(float(distance.flat[nearest]), seen.objects[instance - 1] if heard else "")
