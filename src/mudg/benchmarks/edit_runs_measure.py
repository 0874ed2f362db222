"""One edit of a recorded drive, measured against the unedited fit (see ``benchmarks/edit_runs.py`` for what the numbers are)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.types import Frame, FusedCloud, Observation, Scene, View
from mudg.benchmarks.edit import drawn_pixels
from mudg.core import edit_scores, flicker, metrics, points_seen
from mudg.core.edit import Motion
from mudg.core.fusion import STATIC
from mudg.core.points_seen import DEPTH_LIMIT_M, OwnedPoints
from mudg.data.edits import EditScript
from mudg.data.scene import read_image
from mudg.models.scene.model import SceneModel
from mudg.stages.editing.carried import EditedDrive, carry_out
from mudg.stages.editing.plan import EditPlan, EditWorld
from mudg.stages.editing.vacated import boxes_mask, ground_mask, outlines, touched_boxes
from mudg.stages.editing.weathered import Drawer, conditions_of, in_weather, weather_of
from mudg.stages.fitting.rendering import raster_of, render_view
from mudg.stages.scoring.log_points import LogPoints

AROUND_SWEEPS: Final = 12
"""Sweeps of each LiDAR whose static points tell what stands behind a vehicle."""
COLOR_FRAMES: Final = 4
"""So many recorded frames, evenly spread, tell the colours of those points."""
UNKNOWN_M: Final = 1000.0
"""Depth of pixels without any, for the motion between frames."""
Shown = Callable[[int, Observation, Observation], None]


@dataclass(frozen=True, slots=True, eq=False)
class RunCase:
    """A recorded drive to edit.

    Args:
        frames: the recorded frames of its front camera, in order. lead: id of the vehicle that is edited.
    """

    name: str
    scene: Scene
    cloud: FusedCloud
    model: SceneModel
    frames: tuple[Frame, ...]
    lead: str
    points: LogPoints


@dataclass(slots=True, eq=False)
class Video:
    """One of the two videos, frame by frame: the fit, what draws it, and sums over what was seen of it.

    Args:
        actor: id of the vehicle whose path is followed, or empty. motion: its path. size_m: of its box.
    """

    model: SceneModel
    draw: Drawer
    actor: str = ""
    motion: Motion | None = None
    size_m: tuple[float, float, float] = (1.0, 1.0, 1.0)
    before: tuple[Observation, flicker.TrueFrame, NDArray[np.bool_]] | None = None
    change: float = 0.0
    carried: int = 0
    common: int = 0
    either: int = 0

    def add(self, view: View) -> tuple[Observation, NDArray[np.bool_]]:
        """The next frame, and the pixels bool[H, W] that show the vehicle."""
        seen, pose = self.draw(view), None if self.motion is None else self.motion.pose_at(view.time_s)
        mine = np.zeros(seen.rgb.shape[1:], bool) if pose is None else drawn_pixels(self.model, self.actor, view)
        if pose is not None:
            shown = outlines(view, [(pose, np.asarray(self.size_m, np.float64))])
            common, either = edit_scores.mask_counts(mine, shown)
            self.common, self.either = self.common + common, self.either + either
        now = (seen, _carrier(seen), mine)
        if self.before is not None:
            where = self._motion(self.before, now)
            self.change += flicker.change(self.before[0].rgb, seen.rgb, where)
            self.carried += int(where.same.sum())
        self.before = now
        return seen, mine

    def _motion(self, before: Any, now: Any) -> flicker.PixelMotion:
        """Where surfaces are in the next frame; vehicles other than the followed one do not count."""
        moved = {}
        if self.motion is not None:
            first, last = (self.motion.pose_at(frame[0].view.time_s) for frame in (before, now))
            if first is not None and last is not None:
                moved[1] = torch.from_numpy(last @ geometry.invert(first))
        return flicker.pixel_motion(before[1], now[1], moved, torch.from_numpy(before[2].astype(np.int64)))

    @property
    def warp(self) -> float | None:
        """Mean absolute change of a surface between neighbouring frames."""
        return self.change / self.carried if self.carried else None

    @property
    def overlap(self) -> float | None:
        """Intersection over union of the vehicle's pixels and the outline of its box, pooled."""
        return self.common / self.either if self.either else None


def _carrier(seen: Observation) -> flicker.TrueFrame:
    depth = torch.full((1, *seen.rgb.shape[1:]), UNKNOWN_M) if seen.depth is None else seen.depth
    ids = torch.zeros(seen.rgb.shape[1:], dtype=torch.int64) if seen.semantics is None else seen.semantics.long()
    return flicker.TrueFrame.of(seen.view, torch.where(torch.isfinite(depth) & (depth > 0), depth, UNKNOWN_M), ids)


@dataclass(slots=True)
class Sums:
    """What is pooled over frames: pixels away from the edit and those of them that changed; correlations; errors of colours of uncovered
    points; depth errors by name."""

    away: int = 0
    changed: int = 0
    structure: list[float] = field(default_factory=list)
    colors: list[NDArray[np.float32]] = field(default_factory=list)
    depth: dict[str, metrics.DepthError] = field(default_factory=dict)

    def add_depth(self, name: str, seen: Observation, truth: NDArray[np.float32], where: NDArray[np.bool_]) -> None:
        """Relative error of rendered depth at LiDAR points; where there is no depth, it counts as the farthest that is compared."""
        if seen.depth is None:
            return
        made = torch.nan_to_num(seen.depth, DEPTH_LIMIT_M, DEPTH_LIMIT_M, DEPTH_LIMIT_M)
        errors = metrics.depth_errors(made, torch.from_numpy(truth)[None], torch.from_numpy(where)[None])
        self.depth.setdefault(name, metrics.DepthError("abs_rel")).add(errors if errors.pixels else None)

    @property
    def uncovered_psnr(self) -> float | None:
        """PSNR of the colours of uncovered points."""
        errors = np.concatenate([np.zeros(0, np.float32), *self.colors])
        return metrics.psnr_of_errors(torch.from_numpy(errors)) if len(errors) else None

    def depth_of(self, name: str) -> float | None:
        """The pooled error."""
        return self.depth[name].value() if name in self.depth else None


def measured(case: RunCase, script: EditScript, shown: Shown | None = None) -> dict[str, Any]:
    """The numbers of one edit.

    Args:
        shown: gets the number of each frame, and its renders without and with the edit.

    Raises:
        InputError: the script cannot be carried out on this drive.
    """
    drive = carry_out(script, case.model, case.scene, case.cloud)
    usual, edited, weather = _videos(case, drive)
    sums = Sums()
    for number, frame in enumerate(case.frames):
        (old, stood), (new, stands) = usual.add(frame.view), edited.add(frame.view)
        touched, freed = _regions(drive.plan, frame.view, stood, stands)
        if weather:
            sums.structure += [value for value in [edit_scores.gradient_correlation(new.rgb, old.rgb)] if value is not None]
        else:
            sums.away += int((~touched).sum())
            sums.changed += int((edit_scores.changed_pixels(new.rgb, old.rgb) & ~touched).sum())
        _add_points(case, drive.plan, frame, (old, new), (touched, freed), sums)
        if shown is not None:
            shown(number, old, new)
    kinds = [note["kind"] for note in drive.notes]
    return {
        "warp": edited.warp, "warp_before": usual.warp, "outside": sums.changed / sums.away if sums.away else None,
        "structure": float(np.mean(sums.structure)) if sums.structure else None,
        "lidar": sums.depth_of("after"), "lidar_before": sums.depth_of("before"), "uncovered": sums.depth_of("uncovered"),
        "uncovered_psnr": sums.uncovered_psnr,
        "overlap": edited.overlap, "overlap_before": usual.overlap,
        "collisions": kinds.count("collision"), "warnings": len(kinds), "notes": [note["text"] for note in drive.notes],
    }  # fmt: skip


def _videos(case: RunCase, drive: EditedDrive) -> tuple[Video, Video, bool]:
    """The unedited and the edited video, and whether weather or light changes."""
    conditions = conditions_of(drive.script.canonical())
    made = drive.model(case.model)
    plain, draw = drawer(case.model), drawer(made)
    if conditions is not None:
        draw = in_weather(draw, weather_of(draw, conditions, case.scene))
    new = next(iter(drive.plan.inserted), case.lead)
    usual, edited = Video(case.model, plain), Video(made, draw)
    for video, world, name in ((usual, drive.plan.before, case.lead), (edited, drive.plan.after, new)):
        _follow(video, world, name)
    return usual, edited, conditions is not None


def _follow(video: Video, world: EditWorld, name: str) -> None:
    actor = world.actors.get(name)
    if actor is not None:
        video.actor, video.motion, video.size_m = name, actor.motion, actor.size_m


def drawer(model: SceneModel) -> Drawer:
    """What draws views of a fitted scene."""
    raster = raster_of(model)
    return lambda view: render_view(model, view, raster)


def _regions(
    plan: EditPlan, view: View, stood: NDArray[np.bool_], stands: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Bool[H, W] each: pixels near the edit (the boxes' old and new places and the ground about them, where shadows lie), and those that
    showed the vehicle and do not any more."""
    before, after = (touched_boxes(plan, view.time_s, when) for when in ("before", "after"))
    touched = boxes_mask(view, before) | boxes_mask(view, after) | ground_mask(view, [*before, *after])
    return touched, stood & ~stands & ~boxes_mask(view, after) if before else np.zeros_like(stood)


def _add_points(
    case: RunCase, plan: EditPlan, frame: Frame, pair: tuple[Observation, Observation],
    regions: tuple[NDArray[np.bool_], NDArray[np.bool_]], sums: Sums,
) -> None:  # fmt: skip
    """Add the errors of depth and of uncovered colours at LiDAR points."""
    (old, new), (touched, freed) = pair, regions
    truth = case.points.truth_at(frame.view, None)
    if truth is not None:
        where = (truth.depth > 0) & ~touched
        sums.add_depth("before", old, truth.depth, where)
        sums.add_depth("after", new, truth.depth, where)
    around = case.points.around(frame.view.time_s, AROUND_SWEEPS) if freed.any() else None
    if around is not None:
        rows = np.flatnonzero(around.owner == STATIC)
        still = around.taken(rows)
        depth, index = points_seen.visible(frame.view, still.xyz, still.gap_deg)
        sums.add_depth("uncovered", new, depth, (depth > 0) & freed)
        color, known = _recorded_colors(case, plan, around)
        asked = freed & (index >= 0)
        number = rows[index[asked]]
        made = new.rgb.permute(1, 2, 0).numpy()[asked]
        sums.colors.append((made - color[number].astype(np.float32) / 255)[known[number]].ravel())


def _recorded_colors(case: RunCase, plan: EditPlan, points: OwnedPoints) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colours u8[N, 3] that recorded frames show at points, and which of them some frame shows, bool[N]: of ``COLOR_FRAMES`` frames, the
    middle one first. What lies in the boxes of the edit's objects or on the ground about them, where their shadow lies, is not known."""
    middle = (len(case.frames) - 1) / 2
    spread = np.unique(np.linspace(0, len(case.frames) - 1, COLOR_FRAMES).round().astype(int))
    color, known = np.zeros((len(points.xyz), 3), np.uint8), np.zeros(len(points.xyz), bool)
    for number in sorted(spread.tolist(), key=lambda n: abs(n - middle)):
        frame = case.frames[number]
        boxes = touched_boxes(plan, frame.view.time_s, "before")
        spoilt = boxes_mask(frame.view, boxes) | ground_mask(frame.view, boxes)
        image = np.dstack([read_image(case.scene, frame), spoilt.astype(np.uint8)])
        placed = case.points.placed(points, frame.view.time_s)
        found, there = points_seen.carried(frame.view, image, placed, points.gap_deg)
        fresh = there[:-1] & ~known & (found[:-1, 3] == 0)
        color[fresh], known = found[:-1][fresh, :3], known | fresh
    return color, known
