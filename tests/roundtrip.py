"""Round trips for importers: a small known log, and a comparison of what was read back with it.

A test of a format writes ``small_log`` in that format with a writer of its own, imports it and calls
``assert_same_log``:

    truth = roundtrip.small_log(tmp_path / "truth")
    write_waymo(truth, tmp_path / "log")
    scene = IMPORTERS["waymo"](tmp_path / "log", tmp_path / "scene", ImportOptions())
    roundtrip.assert_same_log(scene, truth, cloud_m=2e-3, color_levels=3)

Importers may put the world's origin and the clock's zero where they like; both are taken from the first image of the
first camera. Everything else must agree within the tolerances.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mudg import native
from mudg.base.errors import InputError
from mudg.base.geometry import invert, transform_points, yaw_matrix, yaw_of
from mudg.base.types import Frame, Scene, Sweep, Track
from mudg.city.config import CityConfig
from mudg.city.logs import write_city
from mudg.scene.read import read_image, read_points

_LIDAR = {"lidar_beams": 16, "lidar_azimuth_step_deg": 1.5}
SMALL = CityConfig(seed=3, n_frames=5, width=96, height=64, cameras=("front", "front_left"), supersample=1, **_LIDAR)

BOX_REACH_M = 30.0

needs_native = pytest.mark.skipif(native.library() is None, reason="the city needs the native library")
"""Mark for tests that call ``small_log``."""


def small_log(folder: Path, **changes: object) -> Scene:
    """A tiny city: 2 cameras, 5 moments, one LiDAR, the boxes within 30 m, moving and parked ones.

    As logs have them, boxes have keys at the times of the sweeps only and stand upright. Use the returned scene, not
    one read from ``folder``, which holds the city's own tracks. ``changes``: other values of ``CityConfig``.
    """
    scene = write_city(replace(SMALL, **changes), folder)
    times = np.array([sweep.time_s for sweep in scene.sweeps])
    start = scene.ego.world_from_ego[0, :3, 3]
    tracks = []
    for track in scene.tracks:
        poses = [track.pose_at(float(time)) for time in times]
        upright = np.stack([yaw_matrix(yaw_of(pose), pose[:3, 3]) for pose in poses if pose is not None])
        if len(upright) == len(times) and np.linalg.norm(upright[0, :3, 3] - start) < BOX_REACH_M:
            tracks.append(Track(track.id, track.label, track.size_m, times, upright))
    return replace(scene, tracks=tuple(tracks))


def assert_same_log(
    scene: Scene,
    truth: Scene,
    *,
    cameras: Mapping[str, str] | None = None,
    labels: Mapping[str, str] | None = None,
    pose: float = 1e-6,
    time_s: float = 1e-6,
    intrinsics_px: float = 1e-6,
    box_pose: float = 1e-6,
    box_size_m: float = 1e-6,
    cloud_m: float = 1e-4,
    cloud_share: float = 1.0,
    intensity: float | None = 1e-3,
    dt_s: float | None = None,
    color_levels: float = 0.0,
    missing_tracks: int = 0,
    sweeps: bool = True,
) -> None:
    """Compare a scene read back with the log it was written from; fails with everything that differs.

    Args:
        cameras: truth camera name -> name in ``scene``; None = the same names.
        labels: truth class -> class in ``scene``; classes not named keep their word.
        pose: largest difference in any element of a camera's, LiDAR's or vehicle's 4x4 pose (rotation, and metres).
        time_s: of all times, relative to the first image's.
        intrinsics_px: fx, fy, cx, cy.
        box_pose: as ``pose``, for tracked boxes at the truth's key times.
        box_size_m: length, width, height.
        cloud_m: each point must have a partner this near, both ways, in the world.
        cloud_share: share of points that must have one; 1 also asks for equal counts.
        intensity: largest difference to the partner; None = not compared.
        dt_s: the same for point times relative to the first image's time; None = not compared.
        color_levels: mean absolute difference of images, 0..255; 0 = equal.
        missing_tracks: so many boxes may be left out by the format (say why at the call).
        sweeps: whether the format has LiDAR.
    """
    names = dict(cameras) if cameras is not None else {name: name for name in truth.cameras}
    if set(names.values()) != set(scene.cameras):
        raise AssertionError(f"cameras are {sorted(scene.cameras)}, expected {sorted(names.values())}")
    first = truth.frames_of(next(iter(names)))[0]
    first_here = scene.frames_of(next(iter(names.values())))[0]
    compared = _Comparison(
        truth,
        scene,
        first_here.view.world_from_cam @ invert(first.view.world_from_cam),
        first_here.view.time_s - first.view.time_s,
    )
    problems = compared.problems
    for theirs, ours in names.items():
        a, b = truth.frames_of(theirs), scene.frames_of(ours)
        if len(a) != len(b):
            problems.append(f"camera {ours}: {len(b)} frames, expected {len(a)}")
        for one, other in zip(a, b):
            compared.frame(one, other, pose, time_s, intrinsics_px, color_levels)
    if sweeps:
        if len(truth.sweeps) != len(scene.sweeps):
            problems.append(f"{len(scene.sweeps)} sweeps, expected {len(truth.sweeps)}")
        for one, other in zip(truth.sweeps, scene.sweeps):
            compared.sweep(one, other, pose, time_s)
            compared.cloud(one, other, cloud_m, cloud_share, intensity, dt_s)
    compared.tracks(labels or {}, box_pose, box_size_m, missing_tracks)
    assert not problems, "\n".join(problems)


def assert_refused(ingest: Callable[[Path, Path], Scene], source: Path, out: Path, words: str) -> InputError:
    """The import of ``source`` fails with an ``InputError`` that says ``words`` (a pattern) and a place, and leaves
    nothing at ``out``."""
    with pytest.raises(InputError) as caught:
        ingest(source, out)
    error = caught.value
    assert re.search(words, str(error)), str(error)
    assert error.where
    left = [path.name for path in out.parent.iterdir() if path.name.startswith((out.name, f".{out.name}"))]
    assert not left, f"something half-written is left: {left}"
    return error


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Two logs, how one lies in the other's world and clock, and what differs so far."""

    truth: Scene
    scene: Scene
    world_from_truth: NDArray[np.float64]
    shift_s: float
    problems: list[str] = field(default_factory=list)

    def posed(
        self,
        where: str,
        found: NDArray[np.float64],
        expected: NDArray[np.float64],
        late_s: float,
        pose: float,
        time_s: float,
    ) -> None:
        """Pose and time of an image or sweep."""
        if (off := _pose_difference(found, self.world_from_truth @ expected)) > pose:
            self.problems.append(f"{where}: pose differs by {off:.3g}")
        if (off := abs(late_s - self.shift_s)) > time_s:
            self.problems.append(f"{where}: time differs by {off:.3g} s")

    def frame(self, a: Frame, b: Frame, pose: float, time_s: float, intrinsics_px: float, color_levels: float) -> None:
        """An image ``b`` of the scene with its original."""
        where = f"frame {b.id}"
        ca, cb = a.view.camera, b.view.camera
        if (ca.width, ca.height) != (cb.width, cb.height):
            self.problems.append(f"{where}: size {cb.width}x{cb.height}, expected {ca.width}x{ca.height}")
            return
        off = max(abs(getattr(ca, name) - getattr(cb, name)) for name in ("fx", "fy", "cx", "cy"))
        if off > intrinsics_px:
            self.problems.append(f"{where}: intrinsics differ by {off:.3g} px")
        self.posed(where, b.view.world_from_cam, a.view.world_from_cam, b.view.time_s - a.view.time_s, pose, time_s)
        one, other = read_image(self.truth, a).astype(int), read_image(self.scene, b).astype(int)
        if (mean := float(np.abs(one - other).mean())) > color_levels:
            self.problems.append(f"{where}: colours differ by {mean:.3g} levels on average")

    def sweep(self, a: Sweep, b: Sweep, pose: float, time_s: float) -> None:
        """Pose and time of a sweep ``b`` of the scene."""
        self.posed(f"sweep {b.id}", b.world_from_lidar, a.world_from_lidar, b.time_s - a.time_s, pose, time_s)

    def cloud(
        self, a: Sweep, b: Sweep, cloud_m: float, cloud_share: float, intensity: float | None, dt_s: float | None
    ) -> None:
        """The points of a sweep ``b`` of the scene."""
        where = f"sweep {b.id}"
        one, other = read_points(self.truth, a), read_points(self.scene, b)
        if cloud_share == 1 and len(one.xyz) != len(other.xyz):
            self.problems.append(f"{where}: {len(other.xyz)} points, expected {len(one.xyz)}")
        if not len(one.xyz) or not len(other.xyz):
            return
        expected = transform_points(self.world_from_truth @ a.world_from_lidar, one.xyz.astype(np.float64))
        found = transform_points(b.world_from_lidar, other.xyz.astype(np.float64))
        distance, partner = KDTree(expected).query(found)
        back, _ = KDTree(found).query(expected)
        share = min(float((distance <= cloud_m).mean()), float((back <= cloud_m).mean()))
        if share < cloud_share:
            worst = max(distance.max(), back.max())
            self.problems.append(
                f"{where}: {share:.2%} of points lie within {cloud_m} m of their partners, worst {worst:.3g} m"
            )
        near = distance <= cloud_m
        if intensity is not None and near.any():
            off = float(np.abs(other.intensity - one.intensity[partner])[near].max())
            if off > intensity:
                self.problems.append(f"{where}: intensity differs by {off:.3g}")
        if dt_s is not None and near.any():
            at, expected_at = (t.dt_s.astype(float) + s.time_s for t, s in ((other, b), (one, a)))
            expected_at, at = expected_at[partner], at - self.shift_s
            if (off := float(np.abs(at - expected_at)[near].max())) > dt_s:
                self.problems.append(f"{where}: point times differ by {off:.3g} s")

    def tracks(self, labels: Mapping[str, str], box_pose: float, box_size_m: float, missing_tracks: int) -> None:
        """All tracked boxes."""
        left = {track.id: track for track in self.scene.tracks}
        missing = []
        for track in self.truth.tracks:
            partner = _partner(track, left, self.world_from_truth, self.shift_s)
            if partner is None:
                missing.append(track.id)
                continue
            del left[partner.id]
            where = f"track {partner.id} (truth {track.id})"
            if partner.label != (label := labels.get(track.label, track.label)):
                self.problems.append(f"{where}: class {partner.label}, expected {label}")
            if (off := float(np.abs(partner.size_m - track.size_m).max())) > box_size_m:
                self.problems.append(f"{where}: size {partner.size_m} differs from {track.size_m} by {off:.3g} m")
            for time, pose in zip(track.times_s, track.world_from_object, strict=True):
                found = partner.pose_at(float(time) + self.shift_s)
                if found is None:
                    self.problems.append(f"{where}: no box at {time:.3f} s")
                elif (off := _pose_difference(found, self.world_from_truth @ pose)) > box_pose:
                    self.problems.append(f"{where}: pose at {time:.3f} s differs by {off:.3g}")
        if len(missing) > missing_tracks:
            self.problems.append(f"tracks {', '.join(missing)} are missing")
        if left:
            self.problems.append(f"tracks {', '.join(left)} are in the scene, not in the log")


def _pose_difference(pose: NDArray[np.float64], expected: NDArray[np.float64]) -> float:
    return float(np.abs(pose - expected).max())


def _partner(
    track: Track, left: Mapping[str, Track], world_from_truth: NDArray[np.float64], shift_s: float
) -> Track | None:
    """The track of the scene at the same place at the middle key; ids may have changed."""
    middle = len(track.times_s) // 2
    place = (world_from_truth @ track.world_from_object[middle])[:3, 3]
    best, best_m = None, 0.5
    for other in left.values():
        pose = other.pose_at(float(track.times_s[middle]) + shift_s)
        if pose is not None and (off := float(np.linalg.norm(pose[:3, 3] - place))) < best_m:
            best, best_m = other, off
    return best
