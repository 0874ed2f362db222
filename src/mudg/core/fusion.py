"""Fusing LiDAR sweeps and images into one static coloured cloud and one cloud per moving object: pure functions on
arrays, one sweep in memory at a time. Each function states its rule."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg.base import palette
from mudg.base.errors import InputError
from mudg.base.geometry import invert, pinhole, yaw_of
from mudg.base.types import SAME_COLORS, CameraColors, FusedCloud, Photo, PointCloud, SweepPoints, Track, View
from mudg.core.project import RULES, DrawLimits, PointLayer, draw_points, nearer_depth

Matrix = NDArray[np.float64]
STATIC: Final = -1
GAP_SPREAD: Final = 1.4
"""Largest usual angle between beams as a multiple of the median one."""
NEAR_M, FAR_M = 0.5, 200.0
"""Camera depth limits of colouring, metres."""
MOVING_TURN_DEG: Final = 15.0
"""Turn from which a long box moves (half turns, a habit of annotators, do not count)."""


@dataclass(frozen=True, slots=True)
class FusionRules:
    """The numbers of the rules of fusion: keep one point per voxel of side ``voxel_m``, the one seen from nearest by (0
    keeps all); leave out colours from behind nearer surfaces; grow moving boxes on each side and on top; points closer
    than ``floor_margin_m`` above the box's floor stay static; a track moves from this dead-banded displacement or path
    length on; leave out dynamic objects with fewer coloured points."""

    voxel_m: float = 0.0
    occlusion_test: bool = True
    box_growth_m: float = 0.1
    floor_margin_m: float = 0.1
    moving_distance_m: float = 0.5
    min_object_points: int = 100


@dataclass(frozen=True, slots=True, eq=False)
class SweepShots:
    """A sweep (points in the LiDAR frame at ``time_s``) and the images that may colour it."""

    time_s: float
    world_from_lidar: Matrix
    points: SweepPoints
    shots: Sequence[Photo]


@dataclass(frozen=True, slots=True)
class TrackVerdict:
    """Whether a track moves, and why, in words."""

    moving: bool
    words: str


@dataclass(slots=True)
class FusionReport:
    """What happened: counts of points; of tracks a verdict, and of moving ones the points, or why they are left
    out."""

    sweeps: int = 0
    points_in: int = 0
    points_moving_in: int = 0
    points_colored: int = 0
    points_hidden: int = 0
    points_static: int = 0
    verdicts: dict[str, TrackVerdict] = field(default_factory=dict)
    object_points: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)

    @property
    def points_unseen(self) -> int:
        """Points in no image."""
        return self.points_in - self.points_colored - self.points_hidden


# --- dynamic objects ------------------------------------------------------------------------------


def judge_track(track: Track, rules: FusionRules) -> TrackVerdict:
    """A track moves if its centre gets far from where it started, or travels a path (with a dead band, so that jitter
    of annotations does not count; going out and coming back does), or if a long box turns (modulo half turns, after a
    median over three keys). Everything else, parked cars included, belongs to the static world."""
    centers, limit = track.world_from_object[:, :3, 3], rules.moving_distance_m
    displacement = float(np.linalg.norm(centers - np.median(centers[:3], axis=0), axis=1).max())
    anchor, path = centers[0], 0.0
    for center in centers[1:]:
        step = float(np.linalg.norm(center - anchor))
        if step > limit / 2:
            anchor, path = center, path + step
    turn = 0.0
    if track.size_m[0] >= 1.3 * track.size_m[1]:
        yaws = np.array([yaw_of(pose) for pose in track.world_from_object])
        turns = (yaws - yaws[0] + np.pi / 2) % np.pi - np.pi / 2
        if len(turns) >= 3:
            turns = np.median(np.stack([turns[:-2], turns[1:-1], turns[2:]]), axis=0)
        turn = float(np.rad2deg(np.abs(turns).max()))
    reasons = [f"centre moved {displacement:.2f} m away from its start"] * (displacement > limit)
    reasons += [f"centre travelled {path:.2f} m"] * (path > limit)
    reasons += [f"heading turned {turn:.0f} degrees"] * (turn > MOVING_TURN_DEG)
    still = f"static: displacement {displacement:.2f} m, path {path:.2f} m, turn {turn:.0f} degrees"
    return TrackVerdict(bool(reasons), "; ".join(reasons) or still)


def points_in_box(
    xyz_object: NDArray[np.floating], size_m: ArrayLike, growth_m: float, floor_margin_m: float
) -> NDArray[np.bool_]:
    """Which points ``[N, 3]`` (object frame, origin in the box centre) lie in the grown box above its floor margin;
    bool[N]."""
    half = np.asarray(size_m) / 2
    return (
        (np.abs(xyz_object[:, 0]) <= half[0] + growth_m)
        & (np.abs(xyz_object[:, 1]) <= half[1] + growth_m)
        & (xyz_object[:, 2] >= floor_margin_m - half[2])
        & (xyz_object[:, 2] <= half[2] + growth_m)
    )


def separate(
    sweep: SweepShots, dynamic: Sequence[Track], rules: FusionRules
) -> tuple[NDArray[np.int32], dict[int, NDArray[np.float32]]]:
    """Assign each point of a sweep to a dynamic object or to the static world: points inside a moving box, slightly
    grown and only above a margin over its floor, so that the road stays road. In overlapping boxes the smaller wins.

    Returns ``owner`` i32[N], index into ``dynamic`` or STATIC; and for each of them present the points it owns in its
    own frame, f32[n, 3], in the order of ``np.flatnonzero(owner == index)``.
    """
    xyz = sweep.points.xyz
    owner = np.full(len(xyz), STATIC, np.int32)
    owned: dict[int, NDArray[np.float32]] = {}
    if len(xyz) == 0:
        return owner, owned
    dt_s = sweep.points.dt_s if np.any(sweep.points.dt_s) else None
    reach_s = float(np.abs(dt_s).max()) if dt_s is not None else 0.0
    for index in sorted(range(len(dynamic)), key=lambda i: float(np.prod(dynamic[i].size_m))):
        track = dynamic[index]
        pose = track.pose_at(sweep.time_s)
        if pose is None:
            continue
        object_from_lidar = invert(pose) @ sweep.world_from_lidar
        velocity = _velocity_in_lidar(track, sweep) if dt_s is not None else np.zeros(3)
        radius = (
            float(np.linalg.norm(track.size_m / 2 + rules.box_growth_m)) + float(np.linalg.norm(velocity)) * reach_s
        )
        center = invert(object_from_lidar)[:3, 3].astype(np.float32)
        near = np.flatnonzero((np.abs(xyz[:, 0] - center[0]) <= radius) & (np.abs(xyz[:, 1] - center[1]) <= radius))
        near = near[owner[near] == STATIC]
        if len(near) == 0:
            continue
        candidates = xyz[near]
        if dt_s is not None:
            candidates = candidates - dt_s[near, None] * velocity.astype(np.float32)
        xyz_object = _apply(object_from_lidar, candidates)
        inside = points_in_box(xyz_object, track.size_m, rules.box_growth_m, rules.floor_margin_m)
        if inside.any():
            owner[near[inside]] = index
            owned[index] = xyz_object[inside]
    return owner, owned


def _velocity_in_lidar(track: Track, sweep: SweepShots, step_s: float = 0.05) -> Matrix:
    """Velocity of the box centre at the sweep's time in the LiDAR's axes, f64[3] m/s; zero where it cannot be told."""
    before, after = track.pose_at(sweep.time_s - step_s), track.pose_at(sweep.time_s + step_s)
    now = track.pose_at(sweep.time_s)
    if now is None or (before is None and after is None):
        return np.zeros(3)
    span = step_s * ((before is not None) + (after is not None))
    last, first = (after if after is not None else now), (before if before is not None else now)
    return sweep.world_from_lidar[:3, :3].T @ (last[:3, 3] - first[:3, 3]) / span


# --- colours --------------------------------------------------------------------------------------


def color_points(
    sweep: SweepShots,
    owner: NDArray[np.int32],
    owned: dict[int, NDArray[np.float32]],
    dynamic: Sequence[Track],
    rules: FusionRules,
    cameras: CameraColors = SAME_COLORS,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]]:
    """Common colours (and semantics) of a sweep's points from the images beside it.

    A point takes the pixel (nearest, no interpolation) of an image taken at about the sweep's time, the object's motion
    between sweep and image taken into account. If several cameras see it, the one whose optical axis points closest to
    it wins, and all vote for its class, weighted by the cosine to their axes.

    Returns seen bool[N]; hidden bool[N]: in an image, but behind a nearer surface in all of them; and where seen rgb
    u8[N, 3], semantics u8[N] and depth f32[N] to the camera that gave the colour.
    """
    count = len(owner)
    best = np.full(count, -1.0, np.float32)
    rgb = np.zeros((count, 3), np.uint8)
    depth_m = np.zeros(count, np.float32)
    in_image = np.zeros(count, bool)
    votes: list[tuple[NDArray[np.intp], NDArray[np.uint8], NDArray[np.float32]]] = []
    members = {index: np.flatnonzero(owner == index) for index in owned}
    stands = _standing(sweep, rules)
    for shot in sweep.shots:
        xyz_cam, known = _points_in_camera(sweep, shot.view, members, owned, dynamic)
        ids, column, row, z = _pixels(xyz_cam, known, shot.view)
        in_image[ids] = True
        visible = _unhidden(xyz_cam[ids], ids, stands, shot.view)
        ids, column, row, z = ids[visible], column[visible], row[visible], z[visible]
        cosine = z / np.linalg.norm(xyz_cam[ids], axis=1)
        better = cosine > best[ids]
        chosen = ids[better]
        best[chosen] = cosine[better]
        depth_m[chosen] = z[better]
        rgb[chosen] = cameras.bytes_to_common(shot.view.camera.name, shot.rgb[row[better], column[better]])
        if shot.semantics is not None:
            votes.append((ids, shot.semantics[row, column], cosine))
    seen = best > 0
    return seen, in_image & ~seen, rgb, _count_votes(votes, count), depth_m


def points_in_image(
    sweep: SweepShots, view: View, dynamic: Sequence[Track], rules: FusionRules
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Points of a sweep that an image shows: indices, column, row and depth f32[n]. Objects stand where they are at its
    time."""
    owner, owned = separate(sweep, dynamic, rules)
    members = {index: np.flatnonzero(owner == index) for index in owned}
    xyz_cam, known = _points_in_camera(sweep, view, members, owned, dynamic)
    ids, column, row, z = _pixels(xyz_cam, known, view)
    visible = _unhidden(xyz_cam[ids], ids, _standing(sweep, rules), view)
    return ids[visible], column[visible], row[visible], z[visible]


def _points_in_camera(
    sweep: SweepShots,
    view: View,
    members: dict[int, NDArray[np.intp]],
    owned: dict[int, NDArray[np.float32]],
    dynamic: Sequence[Track],
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """All points in camera coordinates at the image's time f32[N, 3]; dynamic objects whose pose then is not known are
    flagged."""
    xyz_cam = _apply(view.cam_from_world @ sweep.world_from_lidar, sweep.points.xyz)
    known = np.ones(len(xyz_cam), bool)
    for index, ids in members.items():
        pose = dynamic[index].pose_at(view.time_s)
        if pose is None:
            pose = dynamic[index].pose_at(sweep.time_s) if abs(view.time_s - sweep.time_s) < 0.02 else None
        if pose is None:
            known[ids] = False
        else:
            xyz_cam[ids] = _apply(view.cam_from_world @ pose, owned[index])
    return xyz_cam, known


def _pixels(
    xyz_cam: NDArray[np.float32], known: NDArray[np.bool_], view: View
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Points that fall into the image: indices, column, row (integers) and depth."""
    camera = view.camera
    ids = np.flatnonzero((xyz_cam[:, 2] > NEAR_M) & (xyz_cam[:, 2] < FAR_M) & known)
    x, y, z = xyz_cam[ids].T
    column, row = (np.floor(place) for place in pinhole(camera.intrinsics, x, y, z))
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return ids[inside], column[inside].astype(np.intp), row[inside].astype(np.intp), z[inside]


def _standing(sweep: SweepShots, rules: FusionRules) -> tuple[NDArray[np.bool_], float] | None:
    """Which points of a sweep stand, and the angle between its beams in degrees; None: nothing hides a point."""
    if not rules.occlusion_test:
        return None
    upright = sweep.points.xyz @ sweep.world_from_lidar[:3, :3].T.astype(np.float32)
    return standing_points(upright), measure_beam_gap(sweep.points.xyz)


def _unhidden(
    xyz_cam: NDArray[np.float32], ids: NDArray[np.intp], standing: tuple[NDArray[np.bool_], float] | None, view: View
) -> NDArray[np.bool_]:
    """Which points ``ids`` of a sweep, in the frame of a camera, nothing hides; bool[n]."""
    if standing is None or not len(ids):
        return np.ones(len(ids), bool)
    return ~hidden_points(xyz_cam, standing[0][ids], view, standing[1])


def standing_points(xyz: NDArray[np.floating], cell_m: float = 2.0, margin_m: float = 0.35) -> NDArray[np.bool_]:
    """Which points ``[N, 3]`` (z up) rise by more than ``margin_m`` above the lowest point of their cell; bool[N]."""
    if len(xyz) == 0:
        return np.zeros(0, bool)
    cell = np.floor(xyz[:, :2] / cell_m).astype(np.int64)
    cell -= cell.min(0)
    key = cell[:, 0] * (int(cell[:, 1].max()) + 1) + cell[:, 1]
    if int(key.max()) > 50_000_000:  # a stray point far away: number the cells instead of laying them out
        key = np.unique(key, return_inverse=True)[1]
    lowest = np.full(int(key.max()) + 1, np.inf, np.float32)
    np.minimum.at(lowest, key, xyz[:, 2].astype(np.float32))
    return xyz[:, 2] > lowest[key] + margin_m


def hidden_points(
    xyz_cam: NDArray[np.float32], stands: NDArray[np.bool_], view: View, gap_deg: float
) -> NDArray[np.bool_]:
    """Which points ``[N, 3]`` (camera frame, inside the image) lie behind a clearly nearer standing point
    (``standing_points``), each of which covers half the gap to the next beam; bool[N]. The ground hides nothing: seen
    at a grazing angle its rings overlap each other."""
    camera, rule = view.camera, RULES["colour"]
    nearest, index = draw_points(
        [PointLayer(np.ascontiguousarray(xyz_cam[stands]), np.eye(4))], View(camera, np.eye(4), 0.0), DrawLimits()
    )
    nearest[index < 0] = np.inf
    nearer = nearer_depth(nearest, rule, rule.reach(camera, gap_deg))
    column, row = (np.floor(place).astype(np.intp) for place in pinhole(camera.intrinsics, *xyz_cam.T))
    return rule.hides(nearer[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)], xyz_cam[:, 2])


def measure_beam_gap(xyz_lidar: NDArray[np.floating], default_deg: float = 0.4) -> float:
    """Vertical angle between neighbouring beams of a turning LiDAR, degrees: the median step of elevation in thin
    wedges.

    Steps below 0.08 degrees lie within a beam. Too few points to tell give ``default_deg``; the result is in 0.1..2.5.
    """
    azimuth = np.rad2deg(np.arctan2(xyz_lidar[:, 1], xyz_lidar[:, 0]))
    sector = np.floor(azimuth / 15)
    thin = np.flatnonzero(azimuth - 15 * sector < 0.4)
    xyz, sector = xyz_lidar[thin], sector[thin]
    elevation = np.rad2deg(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))
    order = np.lexsort((elevation, sector))
    steps = np.diff(elevation[order])[np.diff(sector[order]) == 0]
    steps = steps[steps > 0.08]
    return float(np.clip(np.median(steps), 0.1, 2.5)) if len(steps) >= 30 else default_deg


def _count_votes(
    votes: list[tuple[NDArray[np.intp], NDArray[np.uint8], NDArray[np.float32]]], count: int
) -> NDArray[np.uint8]:
    """Winner of the weighted votes per point u8[count]; 255 where nobody voted for a class."""
    if len(votes) < 2:
        winner = np.full(count, palette.UNLABELLED, np.uint8)
        for ids, labels, _ in votes:
            winner[ids] = labels
        return winner
    classes = len(palette.CLASSES)
    tally = np.zeros((count, classes), np.float32)
    for ids, labels, weight in votes:
        valid = labels < classes
        tally[ids[valid], labels[valid]] += weight[valid]
    winner = tally.argmax(1).astype(np.uint8)
    winner[tally.max(1, initial=0.0) <= 0] = palette.UNLABELLED
    return winner


def largest_beam_gap(xyz_lidar: NDArray[np.floating]) -> float:
    """Largest usual angle between neighbouring beams, degrees: beams are not evenly spread."""
    return GAP_SPREAD * measure_beam_gap(xyz_lidar)


def _apply(a_from_b: Matrix, xyz_b: NDArray[np.floating]) -> NDArray[np.float32]:
    """Rigid motion of points in float32; the matrix was composed in float64."""
    matrix = a_from_b.astype(np.float32)
    return xyz_b.astype(np.float32, copy=False) @ matrix[:3, :3].T + matrix[:3, 3]


# --- accumulation ---------------------------------------------------------------------------------


class CloudAccumulator:
    """Collects coloured points sweep by sweep.

    With ``voxel_m`` > 0 one point per voxel is kept: the one seen from the smallest depth, with the class that the
    voxel's samples agree on (pairwise cancellation vote). Memory then follows the number of voxels, not of points.
    """

    def __init__(self, voxel_m: float) -> None:
        self._voxel_m = voxel_m
        self._parts: list[
            tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32], NDArray[np.int32]]
        ] = []
        self._pending = 0
        self._kept = 0

    def add(
        self,
        xyz: NDArray[np.float32],
        rgb: NDArray[np.uint8],
        semantics: NDArray[np.uint8],
        depth_m: NDArray[np.float32],
    ) -> None:
        """Add points: f32[n, 3] metres, u8[n, 3], u8[n], f32[n]."""
        if len(xyz) == 0:
            return
        self._parts.append((xyz, rgb, semantics, depth_m, (semantics != palette.UNLABELLED).astype(np.int32)))
        self._pending += len(xyz)
        if self._voxel_m > 0 and self._pending > max(500_000, self._kept // 2):
            self._merge()

    def _merge(self) -> None:
        if not self._parts:
            return
        xyz, rgb, semantics, depth, weight = (np.concatenate(column) for column in zip(*self._parts, strict=True))
        if self._voxel_m > 0:
            key = voxel_keys(xyz, self._voxel_m)
            order = np.lexsort((depth, key))
            key = key[order]
            first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
            winner, margin = _majority(semantics[order], weight[order], first)
            chosen = order[first]
            xyz, rgb, depth, semantics, weight = xyz[chosen], rgb[chosen], depth[chosen], winner, margin
        self._parts = [(xyz, rgb, semantics, depth, weight)]
        self._kept, self._pending = len(xyz), 0

    def cloud(self, frame: Literal["world", "object"], with_semantics: bool) -> PointCloud:
        """All kept points as one cloud; the accumulator is empty afterwards."""
        self._merge()
        nothing = (np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.uint8))
        xyz, rgb, semantics = self._parts.pop()[:3] if self._parts else nothing
        return PointCloud(xyz, rgb, frame, semantics if with_semantics else None)


def voxel_keys(xyz: NDArray[np.floating], voxel_m: float) -> NDArray[np.int64]:
    """One integer per voxel of side ``voxel_m`` for points ``[N, 3]``; 21 bits per axis. InputError: a coordinate is
    more than a million voxels from the origin."""
    cells = np.floor(np.asarray(xyz, np.float64) / voxel_m).astype(np.int64)
    limit = 1 << 20
    if len(cells) and (np.abs(cells) >= limit).any():
        what, got = "points lie too far away for this voxel size", f"{float(np.abs(xyz).max()):g} m"
        remedy = "use larger voxels, or check the poses"
        raise InputError(what, where="voxel filter", expected=f"within {limit * voxel_m:g} m", got=got, remedy=remedy)
    cells += limit
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]


def _majority(
    labels: NDArray[np.uint8], weights: NDArray[np.int32], first: NDArray[np.intp]
) -> tuple[NDArray[np.uint8], NDArray[np.int32]]:
    """Most voted label of each group (groups start at ``first``) and its margin over all other votes, at least 1."""
    group = np.zeros(len(labels), np.int64)
    group[first[1:]] = 1
    group = np.cumsum(group)
    combined = group * 256 + labels
    order = np.argsort(combined, kind="stable")
    sorted_key = combined[order]
    starts = np.flatnonzero(np.r_[True, sorted_key[1:] != sorted_key[:-1]])
    tally = np.add.reduceat(weights[order], starts).astype(np.int64)
    tally_group, tally_label = sorted_key[starts] // 256, (sorted_key[starts] % 256).astype(np.uint8)
    tally[tally_label == palette.UNLABELLED] = 0
    ranked = np.lexsort((-tally, tally_group))
    winner_at = ranked[np.flatnonzero(np.r_[True, tally_group[ranked][1:] != tally_group[ranked][:-1]])]
    total = np.add.reduceat(weights, first).astype(np.int64)
    margin = np.maximum(2 * tally[winner_at] - total, 1)
    winner = np.where(tally[winner_at] > 0, tally_label[winner_at], palette.UNLABELLED).astype(np.uint8)
    return winner, np.where(winner == palette.UNLABELLED, 0, margin).astype(np.int32)


# --- the whole ------------------------------------------------------------------------------------


def fuse_sweeps(
    sweeps: Iterable[SweepShots],
    tracks: Sequence[Track],
    rules: FusionRules = FusionRules(),
    cameras: CameraColors = SAME_COLORS,
) -> tuple[FusedCloud, FusionReport]:
    """Fuse sweeps, in any order, with the images that may colour them; one is held in memory at a time. Which of all
    tracked boxes move is decided here. ``cameras``: maps of the images' colours to common ones.

    Returns the fused cloud (static: world frame; objects: box frame, by track id) and a report. ``semantics`` are None
    when neither points nor images carried labels. A log without points gives an empty static cloud. Moving objects with
    too few coloured points are left out, and so are their points: they would smear the static world.
    """
    report = FusionReport(verdicts={track.id: judge_track(track, rules) for track in tracks})
    dynamic = [track for track in tracks if report.verdicts[track.id].moving]
    static = CloudAccumulator(rules.voxel_m)
    objects = [CloudAccumulator(rules.voxel_m) for _ in dynamic]
    labelled = False
    for sweep in sweeps:
        labelled |= sweep.points.classes is not None or any(shot.semantics is not None for shot in sweep.shots)
        owner, owned = separate(sweep, dynamic, rules)
        seen, hidden, rgb, semantics, depth_m = color_points(sweep, owner, owned, dynamic, rules, cameras)
        given = sweep.points.classes
        if given is not None:  # images vote for points that people gave no class
            semantics = np.where(given == palette.UNLABELLED, semantics, given)
        keep = seen & (owner == STATIC)
        world = _apply(sweep.world_from_lidar, sweep.points.xyz[keep])
        static.add(world, rgb[keep], semantics[keep], depth_m[keep])
        for index, xyz_object in owned.items():
            ids = np.flatnonzero(owner == index)
            shown = seen[ids]
            ids = ids[shown]
            objects[index].add(xyz_object[shown], rgb[ids], semantics[ids], depth_m[ids])
        report.sweeps += 1
        report.points_in += len(owner)
        report.points_moving_in += int((owner != STATIC).sum())
        report.points_colored += int(seen.sum())
        report.points_hidden += int(hidden.sum())
    static_cloud = static.cloud("world", labelled)
    report.points_static = len(static_cloud)
    clouds: dict[str, PointCloud] = {}
    for track, accumulator in zip(dynamic, objects, strict=True):
        cloud = accumulator.cloud("object", labelled)
        report.object_points[track.id] = len(cloud)
        if len(cloud) < max(rules.min_object_points, 1):
            report.left_out[track.id] = f"{len(cloud)} coloured points, fewer than {rules.min_object_points}"
        else:
            clouds[track.id] = cloud
    return FusedCloud(static_cloud, clouds, cameras), report
