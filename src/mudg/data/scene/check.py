"""The deep check behind ``mudg doctor SCENE``: reads every file of a scene and says in words what is wrong or odd."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mudg.base import geometry, log
from mudg.base.errors import MudgError
from mudg.base.types import Frame, Scene, Sweep, SweepPoints, Track
from mudg.data.scene import read as scene_read

Level = Literal["error", "warning", "note"]

MAX_SPEED_M_S = 70.0
MAX_TIME_S = 24 * 3600.0
MAX_TRACK_GAP_S = 1.0
SAME_MOMENT_S = 0.06
MAX_GAP_STEPS = 1.8
MIN_STEP_M = 0.05
MIN_COURSE_M = 3.0
VEHICLES = frozenset(
    ("car", "van", "truck", "bus", "vehicle", "trailer", "towed_object", "construction_vehicle", "tram", "train", "motorcycle",
     "bicycle")
)  # fmt: skip
"""Labels of what drives. These are longer than wide; barriers, signs and people need not be."""


Say = Callable[[Level, str, str], None]
Complain = Callable[[MudgError], None]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing a person should know: ``error`` = cannot be used, ``warning`` = probably wrong, ``note`` = worth knowing."""

    level: Level
    where: str
    words: str


def check_scene(path: Path | str) -> list[Finding]:
    """Check a scene directory or stored zip, reading every image, sweep and label.

    Nothing is raised for what is wrong with the scene: it is all in the list, worst first. An empty list means that
    nothing was found.
    """
    findings: list[Finding] = []

    def complain(problem: MudgError) -> None:
        findings.append(finding_of(problem, str(path)))

    def say(level: Level, where: str, words: str) -> None:
        findings.append(Finding(level, where, words))

    try:
        scene = scene_read.load_scene(path, complain)
    except MudgError as problem:
        complain(problem)
        return findings
    check_records(scene, say)
    with log.task("checking files", len(scene.frames) + len(scene.sweeps)) as bar:
        for frame in scene.frames:
            _check_frame(scene, frame, complain, say)
            bar.advance()
        for sweep in scene.sweeps:
            _check_sweep(scene, sweep, complain, say)
            bar.advance()
    return worst_first(findings)


def worst_first(findings: list[Finding]) -> list[Finding]:
    """Errors, then warnings, then notes; each in the order found."""
    rank = {"error": 0, "warning": 1, "note": 2}
    return sorted(findings, key=lambda finding: rank[finding.level])


def finding_of(problem: MudgError, where: str) -> Finding:
    """A raised problem as a finding; ``where`` stands in for a missing place."""
    words = "; ".join(
        part
        for part in (
            problem.what,
            _and("expected", problem.expected),
            _and("got", problem.got),
            _and("what to do", problem.remedy),
        )
        if part
    )
    return Finding("error", problem.where or where, words)


def check_records(scene: Scene, say: Say) -> None:
    """What can be said without opening images and clouds: motion, boxes, how things relate."""
    _check_motion(scene, say)
    _check_gaps(scene, say)
    _check_tracks(scene, say)
    _check_relations(scene, say)


def _and(name: str, value: str) -> str:
    return f"{name}: {value}" if value else ""


def _check_motion(scene: Scene, say: Say) -> None:
    """Speeds, units of time, and which way is up."""
    for name in scene.cameras:
        frames = scene.frames_of(name)
        times = np.array([frame.view.time_s for frame in frames])
        if len(times) and np.abs(times).max() > MAX_TIME_S:
            say(
                "warning",
                f"camera {name}",
                f"times reach {np.abs(times).max():.6g}; are they seconds since the start of the log?",
            )
        if len(frames) > 1:
            centers = np.stack([frame.view.center_world for frame in frames])
            speed = np.linalg.norm(np.diff(centers, axis=0), axis=1) / np.diff(times).clip(1e-9)
            if speed.max() > MAX_SPEED_M_S:
                at = frames[int(speed.argmax())].id
                say(
                    "warning",
                    f"frame {at}",
                    f"the camera moves at {speed.max():.0f} m/s to the next frame; check units of time and place",
                )
            if np.allclose(centers, centers[0], atol=1e-6):
                say("note", f"camera {name}", "all poses are the same: nothing can be learnt about depth from motion")
        downs = [float(frame.view.world_from_cam[2, 1]) for frame in frames]
        if downs and np.median(downs) > -0.5:
            say(
                "warning",
                f"camera {name}",
                "its image's down direction does not point to the ground; is the world z up and the camera "
                "x right, y down, z forward?",
            )
    ego = scene.ego
    if len(ego.times_s) > 1:
        speed = np.linalg.norm(np.diff(ego.world_from_ego[:, :3, 3], axis=0), axis=1) / np.diff(ego.times_s)
        if speed.max() > MAX_SPEED_M_S:
            say("warning", "ego path", f"the vehicle moves at {speed.max():.0f} m/s; check units of time and place")
    if scene.frames:
        first = scene.frames[0].view.center_world
        distance = float(np.linalg.norm(first - ego.world_from_ego[0, :3, 3]))
        if distance > 20:
            say("warning", f"frame {scene.frames[0].id}", f"the camera is {distance:.0f} m away from the vehicle")
        if np.linalg.norm(first) > 10_000:
            say(
                "warning",
                "world",
                f"the log starts {np.linalg.norm(first):.0f} m from the origin; float32 points lose precision there: "
                "put the origin near the first pose",
            )


def _check_gaps(scene: Scene, say: Say) -> None:
    """Images or sweeps that seem to be missing: a step in time much longer than usual."""
    streams = {f"camera {name}": [f.view.time_s for f in scene.frames_of(name)] for name in scene.cameras}
    for sweep in scene.sweeps:
        streams.setdefault(f"sensor {sweep.sensor}", []).append(sweep.time_s)
    for where, times in streams.items():
        steps = np.diff(times)
        if len(steps) < 3:
            continue
        usual = float(np.median(steps))
        gaps = np.flatnonzero(steps > MAX_GAP_STEPS * usual)
        if len(gaps):
            missing = int(np.round(steps[gaps] / max(usual, 1e-9) - 1).sum())
            say(
                "warning",
                where,
                f"about {missing} records are missing: {len(gaps)} gaps, the first of {steps[gaps[0]]:.2f} s after "
                f"{times[int(gaps[0])]:.2f} s (usual: {usual:.3f} s)",
            )


def _check_course(track: Track, where: str, say: Say) -> None:
    """Whether a moving box looks where it goes: a quarter turn means swapped sides or another zero of the yaw."""
    steps = np.diff(track.world_from_object[:, :2, 3], axis=0)
    length = np.linalg.norm(steps, axis=1)
    moving = length > MIN_STEP_M
    if length[moving].sum() < MIN_COURSE_M:
        return
    forward = track.world_from_object[:-1, :2, 0][moving]
    turn = np.rad2deg(np.arccos(np.clip((forward * steps[moving]).sum(1) / length[moving], -1, 1)))
    typical = float(np.median(turn))
    if 60 < typical < 120:
        sides = "its width is larger than its length: they are swapped" if track.size_m[1] > track.size_m[0] else (
            "are width and length swapped, or is yaw counted from another axis?"
        )  # fmt: skip
        say("warning", where, f"it moves sideways, {typical:.0f} degrees from where it looks; {sides}")
    elif typical > 150:
        say("warning", where, "it moves backwards all the time; is its yaw turned by 180 degrees?")


def _check_tracks(scene: Scene, say: Say) -> None:
    if not scene.tracks:
        say("note", "tracks", "no tracked boxes: everything counts as static")
    for track in scene.tracks:
        where = f"track {track.id} ({track.label})"
        length, width, _ = track.size_m
        if track.label in VEHICLES and width > 1.5 * length and length > 0.5:
            say("warning", where, f"it is {width:.1f} m wide and {length:.1f} m long; are width and length swapped?")
        if max(track.size_m) > 60:
            say("warning", where, f"its box measures {max(track.size_m):.0f} m")
        steps = np.diff(track.times_s)
        if len(steps):
            if steps.max() > MAX_TRACK_GAP_S:
                say(
                    "warning",
                    where,
                    f"it is not seen for {steps.max():.1f} s from {track.times_s[int(steps.argmax())]:.1f} s on; its path "
                    "across the gap is a guess: split the track",
                )
            speed = np.linalg.norm(np.diff(track.world_from_object[:, :3, 3], axis=0), axis=1) / steps
            if speed.max() > MAX_SPEED_M_S:
                say("warning", where, f"it moves at {speed.max():.0f} m/s; check ids and poses")
            _check_course(track, where, say)
        tilt = np.rad2deg(np.arccos(np.clip(track.world_from_object[:, 2, 2], -1, 1))).max()
        if tilt > 30:
            say(
                "warning", where, f"its z axis is tilted by {tilt:.0f} degrees; object axes are x forward, y left, z up"
            )


def _check_relations(scene: Scene, say: Say) -> None:
    if not scene.sweeps:
        say("note", "sweeps", "no LiDAR: there is nothing to fuse")
    sweep_times = np.array([sweep.time_s for sweep in scene.sweeps])
    alone = [
        f.id for f in scene.frames if len(sweep_times) and np.abs(sweep_times - f.view.time_s).min() > SAME_MOMENT_S
    ]
    if alone:
        say(
            "note",
            f"frame {alone[0]}",
            f"{len(alone)} frames have no sweep within {SAME_MOMENT_S} s and colour no points",
        )
    if not any(split == "test" for split in scene.split.values()):
        say("note", "split", "no frame is held out: nothing can be scored at recorded views")
    if not any(split == "train" for split in scene.split.values()):
        say("error", "split", "no frame is left for training")
    outside = [t.id for t in scene.tracks if scene.frames and not _overlaps(t.times_s, scene)]
    if outside:
        say(
            "warning",
            "tracks",
            f"{len(outside)} tracks lie outside the time of the frames (first: {outside[0]}); are the clocks the same?",
        )


def _overlaps(times_s: np.ndarray, scene: Scene) -> bool:
    frame_times = [frame.view.time_s for frame in scene.frames]
    return times_s[0] <= max(frame_times) + 1e-6 and times_s[-1] >= min(frame_times) - 1e-6


def _check_frame(scene: Scene, frame: Frame, complain: Complain, say: Say) -> None:
    try:
        check_image(frame, scene_read.read_image(scene, frame), say)
    except MudgError as problem:
        complain(problem)
    for name in frame.labels:
        try:
            label = scene_read.read_label(scene, frame, name)
            if name == "depth" and not np.isfinite(label).any():
                say("warning", f"frame {frame.id}", "its depth label has no valid pixel")
        except MudgError as problem:
            complain(problem)


def check_image(frame: Frame, image: np.ndarray, say: Say) -> None:
    """What is odd about a decoded image u8[H, W, 3]."""
    if image.max() == image.min():
        say("warning", f"frame {frame.id}", f"the image is one flat colour ({image.flat[0]})")


def _check_sweep(scene: Scene, sweep: Sweep, complain: Complain, say: Say) -> None:
    try:
        check_points(scene, sweep, scene_read.read_points(scene, sweep), say)
    except MudgError as problem:
        complain(problem)


def check_points(scene: Scene, sweep: Sweep, points: SweepPoints, say: Say) -> None:
    """What is odd about the points of a sweep."""
    where = f"sweep {sweep.id}"
    if len(points.xyz) == 0:
        say("warning", where, "it has no points")
        return
    reach = np.linalg.norm(points.xyz, axis=1)
    if np.median(reach) > 500:
        say(
            "warning",
            where,
            f"half of its points are farther than {np.median(reach):.0f} m; are they metres in the LiDAR's frame?",
        )
    if points.intensity.max(initial=0) > 1 or points.intensity.min(initial=0) < 0:
        say("warning", where, f"intensity reaches {points.intensity.max():g}; expected 0..1")
    if np.abs(points.dt_s).max(initial=0) > 1:
        say(
            "warning", where, f"point times reach {np.abs(points.dt_s).max():g} s beside the sweep's; are they seconds?"
        )
    beside = [f for f in scene.frames if abs(f.view.time_s - sweep.time_s) <= SAME_MOMENT_S]
    if beside:
        world = geometry.transform_points(sweep.world_from_lidar, points.xyz)
        if not any(_sees(frame, world) for frame in beside):
            say("warning", where, "none of its points falls into the images taken at its time; check the calibration")


def _sees(frame: Frame, xyz_world: np.ndarray) -> bool:
    uv, z = geometry.project(frame.view, xyz_world)
    camera = frame.view.camera
    with np.errstate(invalid="ignore"):
        return bool(((z > 0.1) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)).any())
