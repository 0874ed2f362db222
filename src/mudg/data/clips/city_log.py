"""A generated log as its training clips need it, and its recording with the faults of real sensors.

With faults, the cameras are the reference: the view of a clip is where the camera truly was (moved sideways), and its truth is exact. What
the condition knows may be wrong. Its views carry the recorded poses, which have errors; an image recorded at the time of a view has
the same error and so still fits it; points and images of other times, and points of a LiDAR that is not where the calibration says,
do not. The truth has the look of the camera at that time (exposure, white balance, vignetting, contrast) but none of its noise and blur.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, seeds
from mudg.base.types import FusedCloud, Photo, SweepPoints, Track, View
from mudg.core.fusion import FusionRules, SweepShots, fuse_sweeps
from mudg.data.city import CityTruth, CityWorld
from mudg.data.city.config import CityConfig
from mudg.data.city.rig import LidarScan, beam_elevations, ego_from_lidar, lidar_elevations
from mudg.data.city.sensors import SensorFaults, noisy_tracks, pose_errors, recorded, thinned, with_look


@dataclass(frozen=True)
class CityLog:
    """A generated log as its training clips need it: world, fused cloud, recorded images of all frames and cameras.

    ``sweeps``: what was fused.
    ``boxes``: the annotated tracks (None = the exact ones); ``errors`` f64[frames, 4, 4]: recorded pose = true pose @ error.
    """

    world: CityWorld
    cloud: FusedCloud
    recorded: tuple[Photo, ...]
    sweeps: tuple[SweepShots, ...] = ()
    sensors: SensorFaults = field(default_factory=SensorFaults)
    boxes: tuple[Track, ...] | None = None
    errors: NDArray[np.float64] | None = None

    def tracks(self) -> tuple[Track, ...]:
        """The boxes as annotated."""
        return self.world.tracks() if self.boxes is None else self.boxes

    def claimed(self, view: View) -> View:
        """A true view of a frame's time with the pose that the log's poses make of it."""
        return view if self.errors is None else claimed_view(self.world, self.errors, view)

    def truth(self, view: View) -> CityTruth:
        """The truth at a true view, with the look of its camera."""
        found = self.world.render(view)
        look = self.sensors.looks.get(view.camera.name)
        return found if look is None else replace(found, rgb=with_look(found.rgb, look, view.time_s))


def claimed_view(world: CityWorld, errors: NDArray[np.float64], view: View) -> View:
    """`CityLog.claimed` for the errors of a log's poses."""
    ego = world.frame_pose(view.time_s)
    error = errors[min(max(round(view.time_s * world.config.rate_hz), 0), len(errors) - 1)]
    return View(view.camera, ego @ error @ geometry.invert(ego) @ view.world_from_cam, view.time_s)


def record_with_faults(config: CityConfig, sensors: SensorFaults, used: Sequence[int], key: int) -> CityLog:
    """Record and fuse a city with faulty sensors; ``used``: the frames that have a sweep. Everything follows from ``key``."""
    world = CityWorld(config)
    errors = pose_errors(sensors.poses, config.n_frames, key)
    photos = {name: _photos(world, sensors, errors, name, key) for name in config.cameras}
    boxes = noisy_tracks(world.tracks(), sensors.boxes, key)
    delay_s, mounting = sensors.lidar.delay_s, sensors.lidar.mounting_error()
    scans = [LidarScan(ego_from_lidar(), lidar_elevations(config), delay_s)]
    if sensors.second_lidar is not None:
        second, pose = sensors.second_lidar, np.eye(4)
        pose[:3, 3] = second.place
        scans.append(
            LidarScan(pose, beam_elevations(second.beams, second.lower_deg, second.upper_deg), delay_s, " second")
        )
    sweeps = []
    for index in used:
        shots = [photos[name][index] for name in config.cameras]
        ego = world.frame_pose(world.frame_time(index))
        wrong = ego @ errors[index] @ geometry.invert(ego)
        for scan in scans:
            sweep = world.lidar_sweep(index, scan)
            points = thinned(sweep.points, sensors.lidar, seeds.key(key, index, f"points{scan.name}"))
            sweeps.append(SweepShots(sweep.time_s, wrong @ sweep.world_from_lidar @ mounting, points, shots))
    sweeps = [s for s in sweeps if _usable(s.points)]
    cloud, _ = fuse_sweeps(sweeps, boxes, FusionRules(min_object_points=40))
    images = tuple(p for name in config.cameras for p in photos[name])
    return CityLog(world, cloud, images, tuple(sweeps), sensors, boxes, errors)


def _usable(points: SweepPoints) -> bool:
    return len(points.xyz) > 0


def _photos(world: CityWorld, sensors: SensorFaults, errors: NDArray[np.float64], name: str, key: int) -> list[Photo]:
    faults, look, photos = sensors.faults_of(name), sensors.look_of(name), []
    for index, view in enumerate(world.frame_views(name)):
        truth = world.render_rolling(view, faults.readout_s) if faults.readout_s else world.render(view)
        image = recorded(with_look(truth.rgb, look, view.time_s), faults, seeds.key(key, index, f"image {name}"))
        photos.append(Photo(claimed_view(world, errors, view), image, truth.semantics))
    return photos
