"""The deep check behind ``mudg doctor SCENE``: reads every file of a scene and lists what is wrong or odd."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, log
from mudg.base.errors import MudgError
from mudg.base.types import Frame, Scene, Sweep, SweepPoints, Track, View
from mudg.core.calibration import MIN_CONTRAST, MIN_JUMPS, TURNS_DEG, EdgeAlignment, edge_alignment
from mudg.scene import motion
from mudg.scene.clouds import FLOAT32_SPACING_M, LEAST_RANGE_M, at_sensor, float32_spacing_m
from mudg.scene.labels import read_label
from mudg.scene.motion import VEHICLES
from mudg.scene.read import load_scene, read_image, read_points, spread, sweeps_beside

# how well the LiDAR fits each camera of a scene, by edges; see ``core/calibration.py`` ------------

IMAGES_PER_CAMERA = 6
MAX_GAP_S = 0.06


def camera_alignment(scene: Scene) -> dict[str, EdgeAlignment]:
    """Camera name -> how its images fit the sweeps of the same time, from up to six images; empty without sweeps."""
    if not scene.sweeps:
        return {}
    names = log.progress(scene.cameras, len(scene.cameras), "comparing LiDAR and image edges")
    return {name: edge_alignment(_shots(scene, name)) for name in names}


def _shots(scene: Scene, name: str) -> Iterator[tuple[View, Any, Any, Any]]:
    for frame in spread(scene.frames_of(name), IMAGES_PER_CAMERA):
        for sweep in sweeps_beside(scene, frame, MAX_GAP_S):
            yield frame.view, read_image(scene, frame), sweep.world_from_lidar, read_points(scene, sweep).xyz


def describe(name: str, alignment: EdgeAlignment) -> str:
    """One sentence about a camera."""
    if alignment.verdict == "unknown":
        if alignment.jumps < MIN_JUMPS:
            return f"camera {name}: too few depth edges to compare with its images ({alignment.jumps})"
        why = "other turns fit about as well"
        if alignment.contrast < MIN_CONTRAST:
            why = f"no turn of up to {TURNS_DEG[-1]:g} degrees stands out"
        elif max(abs(angle) for angle in alignment.best_turn_deg) == TURNS_DEG[-1]:
            why = "the best turn is at the end of the range tried"
        edges = f"{alignment.jumps} depth edges do not tell whether LiDAR and images agree"
        return f"camera {name}: {edges} ({why}); look at the contact sheet"
    score = f"score {alignment.score:.2f}, {alignment.jumps} depth edges"
    if alignment.verdict == "right":
        return f"camera {name}: LiDAR and image edges agree ({score})"
    right, up = alignment.best_turn_deg
    moved = f"when moved by {right:+.1f} degrees to the right and {up:+.1f} up ({score})"
    return f"camera {name}: LiDAR edges fit the image better {moved}; check calibration, poses and clocks"


def to_json(alignment: EdgeAlignment) -> dict[str, Any]:
    """Plain values for JSON."""
    values = {"verdict": alignment.verdict, "score": round(alignment.score, 3)}
    values |= {"best_turn_deg": list(alignment.best_turn_deg), "contrast": round(alignment.contrast, 3)}
    return {**values, "sigmas": round(alignment.sigmas, 2), "depth_edges": alignment.jumps}


# check --------------------------------------------------------------------------------------------

Level = Literal["error", "warning", "note"]
_EXAMPLES: Final = 3
_LEVELS: Final = ("error", "warning", "note")

MAX_SPEED_M_S: Final = 70.0
MAX_TIME_S: Final = 24 * 3600.0
MAX_TRACK_GAP_S: Final = 1.0
SAME_MOMENT_S: Final = 0.06
MAX_GAP_STEPS: Final = 1.8
MIN_STEP_M: Final = 0.05
MIN_TURN_DEG: Final = 1.0
MIN_COURSE_M: Final = 3.0
_JUMP_M: Final = 0.5
_TRACK_JUMP_M: Final = 1.5
_SAME_RANGE_SHARE: Final = 0.02
_SAME_RANGE_POINTS: Final = 50


WITHOUT_LIDAR: Final = (
    "no LiDAR sweeps: there is nothing to fuse, so `mudg fuse`, `mudg run`, and what starts from a fused cloud refuse"
    " this log; ingest, annotate, export, and fit with emernerf work"
)


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing a person should know: ``error`` = cannot be used, ``warning`` = probably wrong, ``note`` = worth
    knowing."""

    level: Level
    where: str
    message: str


Findings = Iterator[Finding]


def folded(findings: Sequence[Finding], rest: str) -> list[str]:
    """A line per finding; many that say the same of different things become one line with their number and three
    examples. ``rest``: the command that lists them all."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        kind = finding.where.split(" ")[0], re.sub(r"[\d.]*\d", "#", finding.message)
        groups.setdefault(kind, []).append(finding)
    lines = []
    for same in groups.values():
        if len(same) <= _EXAMPLES:
            lines += [f"{finding.where}: {finding.message}" for finding in same]
        else:
            examples = ", ".join(finding.where for finding in same[:_EXAMPLES])
            lines.append(f"{len(same)} times: {examples} and others: {same[0].message} (all of them: {rest})")
    return lines


def _warning(where: str, message: str) -> Finding:
    return Finding("warning", where, message)


def _note(where: str, message: str) -> Finding:
    return Finding("note", where, message)


def check_scene(path: Path | str) -> list[Finding]:
    """Check a scene directory, reading every image, sweep and label. Nothing is raised for what is wrong with the
    scene: it is all in the list, worst first. An empty list means that nothing was found."""
    findings: list[Finding] = []
    try:
        scene = load_scene(path, lambda problem: findings.append(finding_of(problem, str(path))))
    except MudgError as problem:
        return [*findings, finding_of(problem, str(path))]
    findings.extend(check_records(scene))
    records = (*scene.frames, *scene.sweeps)
    for record in log.progress(records, len(records), "checking files"):
        for name in (None, *record.labels) if isinstance(record, Frame) else (None,):
            findings.extend(collected(_check_file(scene, record, name), str(path)))
    return worst_first(findings)


def _check_file(scene: Scene, record: Frame | Sweep, label: str | None) -> Findings:
    """Of a sweep, or of a frame's image or label."""
    if not isinstance(record, Frame):
        yield from check_points(scene, record, read_points(scene, record))
    elif label is None:
        yield from check_image(record, read_image(scene, record))
    elif not np.isfinite(read_label(scene, record, label)).any():
        yield _warning(f"frame {record.id}", "its depth label has no valid pixel")


def collected(findings: Findings, where: str) -> list[Finding]:
    """The findings of a check; an error that it raises becomes the last one. ``where`` as in ``finding_of``."""
    found: list[Finding] = []
    try:
        found.extend(findings)
    except MudgError as problem:
        found.append(finding_of(problem, where))
    return found


def worst_first(findings: list[Finding]) -> list[Finding]:
    """Errors, then warnings, then notes; each in the order found."""
    return sorted(findings, key=lambda finding: _LEVELS.index(finding.level))


def finding_of(problem: MudgError, where: str) -> Finding:
    """A raised problem as a finding; ``where`` stands in for a missing place."""
    details = {"expected": problem.expected, "got": problem.got, "what to do": problem.remedy}
    message = "; ".join((problem.what, *(f"{name}: {text}" for name, text in details.items() if text)))
    return Finding("error", problem.where or where, message)


def check_records(scene: Scene) -> Findings:
    """What can be said without opening images and clouds: motion, boxes, how things relate."""
    for check in (_check_cameras, _check_ego, _check_gaps, _check_tracks, _check_relations):
        yield from check(scene)


def _speeds(places_m: NDArray[np.float64], times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Speed in m/s of each step between places f64[T, 3]."""
    return np.linalg.norm(np.diff(places_m, axis=0), axis=1) / np.diff(times_s).clip(1e-9)


def _check_cameras(scene: Scene) -> Findings:
    """Speeds, units of time, and which way is up."""
    for name in scene.cameras:
        frames, where = scene.frames_of(name), f"camera {name}"
        times = np.array([frame.view.time_s for frame in frames])
        if len(times) and np.abs(times).max() > MAX_TIME_S:
            latest = f"times reach {np.abs(times).max():.6g}"
            yield _warning(where, f"{latest}; are they seconds since the start of the log?")
        if len(frames) > 1:
            centers = np.stack([frame.view.center_world for frame in frames])
            speed = _speeds(centers, times)
            if speed.max() > MAX_SPEED_M_S:
                fastest = f"the camera moves at {speed.max():.0f} m/s to the next frame"
                yield _warning(f"frame {frames[int(speed.argmax())].id}", f"{fastest}; check units of time and place")
            if np.allclose(centers, centers[0], atol=1e-6):
                yield _note(where, "all poses are the same: nothing can be learnt about depth from motion")
        downs = [float(frame.view.world_from_cam[2, 1]) for frame in frames]
        if downs and np.median(downs) > -0.5:
            axes = "is the world z up and the camera x right, y down, z forward?"
            yield _warning(where, f"its image's down direction does not point to the ground; {axes}")


def _check_ego(scene: Scene) -> Findings:
    ego = scene.ego
    for gap in motion.gaps(ego.times_s, ego.world_from_ego):
        yield _warning("ego path", str(gap))
    yield from _check_keys("ego path", ego.times_s, ego.world_from_ego, motion.MOST_TURN_RAD_S, of_box=False)
    if scene.frames:
        first = scene.frames[0].view.center_world
        distance = float(np.linalg.norm(first - ego.world_from_ego[0, :3, 3]))
        if distance > 20:
            yield _warning(f"frame {scene.frames[0].id}", f"the camera is {distance:.0f} m away from the vehicle")
    yield from check_distance(scene)


def check_distance(scene: Scene) -> Findings:
    """Whether float32 numbers hold the places of a scene: vehicle, cameras, sensors, and boxes."""
    paths = [scene.ego.world_from_ego, *(track.world_from_object for track in scene.tracks)]
    paths += [frame.view.world_from_cam[None] for frame in scene.frames]
    paths += [sweep.world_from_lidar[None] for sweep in scene.sweeps]
    places = np.concatenate(paths)[:, :3, 3]
    spacing_m = float32_spacing_m(places)
    if spacing_m > FLOAT32_SPACING_M:
        reach = f"the log reaches {np.linalg.norm(places, axis=1).max():.0f} m from the origin"
        rounds = f"float32 rounds points there to {spacing_m * 1e3:.3g} mm"
        yield _warning("world", f"{reach}; {rounds}: put the origin near the first pose, subtracted in float64")


def _check_keys(
    where: str, times_s: NDArray[np.float64], poses: NDArray[np.float64], most_rad_s: float, *, of_box: bool
) -> Findings:
    """Speeds, headings that flip, turns and jumps that nothing on wheels makes: of each, how many and the first or
    largest."""
    if len(times_s) < 2:
        return
    speed = _speeds(poses[:, :3, 3], times_s).max()
    if speed > MAX_SPEED_M_S:
        yield _warning(where, f"it moves at {speed:.0f} m/s; check ids, poses, and units of time and place")
    flips = motion.heading_flips(times_s, poses, most_rad_s)
    if len(flips):
        mended = len(motion.unflipped(times_s, poses, most_rad_s)[1])
        side = "ingest turns it back" if mended else "which side is right is not clear"
        first = f"first after {times_s[flips[0]]:.3f} s (key {flips[0]})"
        yield _warning(where, f"its heading flips by 180 degrees {len(flips)} times, {first}: {side}")
    angle, rate = motion.turns(times_s, poses)
    fast = np.flatnonzero((rate > most_rad_s) & (angle > np.deg2rad(motion.MIN_TURN_DEG)))
    fast = fast[~np.isin(fast, flips)]
    if len(fast):
        key = int(fast[np.argmax(angle[fast])])
        turn = f"{np.rad2deg(angle[key]):.0f} degrees within {times_s[key + 1] - times_s[key]:.2f} s"
        at = f"after {times_s[key]:.3f} s (key {key}; {len(fast)} such turns)"
        yield _warning(where, f"it turns by {turn} {at}; check headings and times")
    if jumps := motion.jumps(times_s, poses, _TRACK_JUMP_M if of_box else _JUMP_M):
        key, off_m, acceleration = jumps[0]
        at = f"after {times_s[key]:.3f} s (key {key}, {acceleration:.0f} m/s^2; {len(jumps)} such steps)"
        yield _warning(where, f"it jumps by {off_m:.1f} m {at}; check poses, times and ids")


def _check_gaps(scene: Scene) -> Findings:
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
            first = f"the first of {steps[gaps[0]]:.2f} s after {times[int(gaps[0])]:.2f} s (usual: {usual:.3f} s)"
            yield _warning(where, f"about {missing} records are missing: {len(gaps)} gaps, {first}")


def _check_tracks(scene: Scene) -> Findings:
    if not scene.tracks:
        yield _note("tracks", "no tracked boxes: everything counts as static")
    for track in scene.tracks:
        where = f"track {track.id} ({track.label})"
        length, width, _ = track.size_m
        if track.label in VEHICLES and width > 1.5 * length and length > 0.5:
            sides = f"it is {width:.1f} m wide and {length:.1f} m long"
            yield _warning(where, f"{sides}; are width and length swapped?")
        if max(track.size_m) > 60:
            yield _warning(where, f"its box measures {max(track.size_m):.0f} m")
        steps = np.diff(track.times_s)
        if len(steps):
            poses = track.world_from_object  # what stands needs no keys in between
            step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
            cosine = (np.einsum("nij,nij->n", poses[:-1, :3, :3], poses[1:, :3, :3]) - 1) / 2
            gaps = np.where((step_m > MIN_STEP_M) | (cosine < np.cos(np.deg2rad(MIN_TURN_DEG))), steps, 0.0)
            if gaps.max() > MAX_TRACK_GAP_S:
                unseen = f"it is not seen for {gaps.max():.1f} s from {track.times_s[int(gaps.argmax())]:.1f} s on"
                yield _warning(where, f"{unseen}; its path across the gap is a guess: split the track")
            most_rad_s = motion.most_turn_rad_s(track.label)
            yield from _check_keys(where, track.times_s, track.world_from_object, most_rad_s, of_box=True)
            yield from _check_course(track, where)
        tilt = np.rad2deg(np.arccos(np.clip(track.world_from_object[:, 2, 2], -1, 1))).max()
        if tilt > 30:
            axes = "object axes are x forward, y left, z up"
            yield _warning(where, f"its z axis is tilted by {tilt:.0f} degrees; {axes}")


def _check_course(track: Track, where: str) -> Findings:
    """Whether a dynamic box faces its direction of travel: a quarter turn means swapped sides or another zero of the
    yaw."""
    steps = np.diff(track.world_from_object[:, :2, 3], axis=0)
    length = np.linalg.norm(steps, axis=1)
    moving = length > MIN_STEP_M
    if length[moving].sum() < MIN_COURSE_M:
        return
    forward = track.world_from_object[:-1, :2, 0][moving]
    turn = np.rad2deg(np.arccos(np.clip((forward * steps[moving]).sum(1) / length[moving], -1, 1)))
    typical = float(np.median(turn))
    if 60 < typical < 120:
        sides = "are width and length swapped, or is yaw counted from another axis?"
        if track.size_m[1] > track.size_m[0]:
            sides = "its width is larger than its length: they are swapped"
        yield _warning(where, f"it moves sideways, {typical:.0f} degrees from its x axis; {sides}")
    elif typical > 150:
        yield _warning(where, "it moves backwards all the time; is its yaw turned by 180 degrees?")


def _check_relations(scene: Scene) -> Findings:
    if not scene.sweeps:
        yield _warning("sweeps", WITHOUT_LIDAR)
    sweep_times = np.array([sweep.time_s for sweep in scene.sweeps])
    frame_times = np.array([frame.view.time_s for frame in scene.frames])
    if len(sweep_times):
        if alone := [f.id for f in scene.frames if np.abs(sweep_times - f.view.time_s).min() > SAME_MOMENT_S]:
            message = f"{len(alone)} frames have no sweep within {SAME_MOMENT_S} s and colour no points"
            yield _note(f"frame {alone[0]}", message)
    if "test" not in scene.split.values():
        yield _note("split", "no frame is held out: nothing can be scored at recorded views")
    if "train" not in scene.split.values():
        yield Finding("error", "split", "no frame is left for training")
    if len(frame_times):
        first_s, last_s = frame_times.min() - 1e-6, frame_times.max() + 1e-6
        if outside := [t.id for t in scene.tracks if t.times_s[0] > last_s or t.times_s[-1] < first_s]:
            lie = f"{len(outside)} tracks lie outside the time of the frames (first: {outside[0]})"
            yield _warning("tracks", f"{lie}; are the clocks the same?")


def check_image(frame: Frame, image: NDArray[np.uint8]) -> Findings:
    """What is odd about a decoded image u8[H, W, 3]."""
    if image.max() == image.min():
        yield _warning(f"frame {frame.id}", f"the image is one flat colour ({image.flat[0]})")


def check_points(scene: Scene, sweep: Sweep, points: SweepPoints) -> Findings:
    """What is odd about the points of a sweep."""
    where = f"sweep {sweep.id}"
    if len(points.xyz) == 0:
        yield _warning(where, "it has no points")
        return
    if zeros := int(at_sensor(points, sweep.time_s, sweep.world_from_lidar, scene.ego).sum()):
        near = f"{zeros} of {len(points.xyz)} points lie within {LEAST_RANGE_M:g} m of the LiDAR"
        yield _warning(where, f"{near}: beams without a return? leave them out, or ingest the log again")
    ranges = np.linalg.norm(points.xyz, axis=1)
    farthest = int((ranges > ranges.max() * (1 - 1e-5)).sum())
    if farthest >= max(_SAME_RANGE_POINTS, _SAME_RANGE_SHARE * len(ranges)):
        same = f"{farthest} of {len(ranges)} points lie at the same largest range, {ranges.max():.2f} m"
        yield _warning(where, f"{same}: does it mark beams without a return? leave them out")
    reach = np.median(ranges)
    if reach > 500:
        far = f"half of its points are farther than {reach:.0f} m"
        yield _warning(where, f"{far}; are they metres in the LiDAR's frame?")
    if points.intensity.max(initial=0) > 1 or points.intensity.min(initial=0) < 0:
        yield _warning(where, f"intensity reaches {points.intensity.max():g}; expected 0..1")
    latest_s = np.abs(points.dt_s).max(initial=0)
    if latest_s > 1:
        yield _warning(where, f"point times reach {latest_s:g} s beside the sweep's; are they seconds?")
    beside = [f for f in scene.frames if abs(f.view.time_s - sweep.time_s) <= SAME_MOMENT_S]
    if beside:
        world = geometry.transform_points(sweep.world_from_lidar, points.xyz)

        def sees(frame: Frame) -> bool:
            uv, z = geometry.project(frame.view, world)
            size = frame.view.camera.width, frame.view.camera.height
            with np.errstate(invalid="ignore"):
                return bool(((z > 0.1) & (uv >= 0).all(1) & (uv < size).all(1)).any())

        if not any(map(sees, beside)):
            yield _warning(where, "none of its points falls into the images taken at its time; check the calibration")
