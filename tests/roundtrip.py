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
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mudg import native
from mudg.base.errors import InputError
from mudg.base.geometry import invert, transform_points, yaw_matrix, yaw_of
from mudg.base.types import Scene, Track
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


def mounts(scene: Scene) -> dict[str, NDArray[np.float64]]:
    """Camera or LiDAR -> where it sits on the vehicle, f64[4, 4], by its first record."""
    placed = [(frame.view.camera.name, frame.view.time_s, frame.view.world_from_cam) for frame in scene.frames]
    placed += [(sweep.sensor, sweep.time_s, sweep.world_from_lidar) for sweep in scene.sweeps]
    return {name: invert(scene.ego.pose_at(time_s)) @ pose for name, time_s, pose in reversed(placed)}


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
        intensity, dt_s: largest difference to the partner (times relative to the first image's); None = not compared.
        color_levels: mean absolute difference of images, 0..255; 0 = equal.
        missing_tracks: so many boxes may be left out by the format (say why at the call).
        sweeps: whether the format has LiDAR.
    """
    names = dict(cameras) if cameras is not None else {name: name for name in truth.cameras}
    assert set(names.values()) == set(scene.cameras), "cameras"
    problems: list[str] = []

    def compare(where: str, what: str, off: float, most: float) -> None:
        if off > most:
            problems.append(f"{where}: {what} differs by {off:.3g}")

    first, here = truth.frames_of(next(iter(names)))[0].view, scene.frames_of(next(iter(names.values())))[0].view
    world_from_truth, shift_s = here.world_from_cam @ invert(first.world_from_cam), here.time_s - first.time_s
    apart = lambda found, expected: float(np.abs(found - world_from_truth @ expected).max())
    for theirs, ours in names.items():
        originals, images = truth.frames_of(theirs), scene.frames_of(ours)
        compare(f"camera {ours}", "number of frames", abs(len(originals) - len(images)), 0)
        for a, b in zip(originals, images):
            where, ca, cb = f"frame {b.id}", a.view.camera, b.view.camera
            off = max(abs(getattr(ca, name) - getattr(cb, name)) for name in ("fx", "fy", "cx", "cy"))
            compare(where, "intrinsics", off, intrinsics_px)
            compare(where, "pose", apart(b.view.world_from_cam, a.view.world_from_cam), pose)
            compare(where, "time", abs(b.view.time_s - a.view.time_s - shift_s), time_s)
            one, other = read_image(truth, a).astype(int), read_image(scene, b).astype(int)
            compare(where, "colour", float(np.abs(one - other).mean()), color_levels)
    if sweeps:
        compare("LiDAR", "number of sweeps", abs(len(truth.sweeps) - len(scene.sweeps)), 0)
    for a, b in zip(truth.sweeps, scene.sweeps if sweeps else ()):
        where, one, other = f"sweep {b.id}", read_points(truth, a), read_points(scene, b)
        compare(where, "pose", apart(b.world_from_lidar, a.world_from_lidar), pose)
        compare(where, "time", abs(b.time_s - a.time_s - shift_s), time_s)
        if cloud_share == 1:
            compare(where, "number of points", abs(len(one.xyz) - len(other.xyz)), 0)
        if not len(one.xyz) or not len(other.xyz):
            continue
        expected = transform_points(world_from_truth @ a.world_from_lidar, one.xyz.astype(np.float64))
        found = transform_points(b.world_from_lidar, other.xyz.astype(np.float64))
        distance, partner = KDTree(expected).query(found)
        back, _ = KDTree(found).query(expected)
        if (share := min(float((distance <= cloud_m).mean()), float((back <= cloud_m).mean()))) < cloud_share:
            worst = max(distance.max(), back.max())
            problems.append(f"{where}: {share:.2%} of points lie within {cloud_m} m of their partners, worst {worst} m")
        near = distance <= cloud_m
        if intensity is not None and near.any():
            compare(where, "intensity", np.abs(other.intensity - one.intensity[partner])[near].max(), intensity)
        if dt_s is not None and near.any():
            at, expected_at = (points.dt_s.astype(float) + s.time_s for points, s in ((other, b), (one, a)))
            compare(where, "time of points", np.abs(at - shift_s - expected_at[partner])[near].max(), dt_s)
    left = {track.id: track for track in scene.tracks}
    missing = []
    for track in truth.tracks:
        partner = _partner(track, left, world_from_truth, shift_s)
        if partner is None:
            missing.append(track.id)
            continue
        del left[partner.id]
        where, label = f"track {partner.id} (truth {track.id})", (labels or {}).get(track.label, track.label)
        if partner.label != label:
            problems.append(f"{where}: class {partner.label}, expected {label}")
        compare(where, "size", float(np.abs(partner.size_m - track.size_m).max()), box_size_m)
        for time, expected in zip(track.times_s, track.world_from_object, strict=True):
            found = partner.pose_at(float(time) + shift_s)
            compare(where, f"box at {time:.3f} s", np.inf if found is None else apart(found, expected), box_pose)
    if len(missing) > missing_tracks:
        problems.append(f"tracks {', '.join(missing)} are missing")
    if left:
        problems.append(f"tracks {', '.join(left)} are in the scene, not in the log")
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
