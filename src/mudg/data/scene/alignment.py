"""How well the LiDAR fits each camera of a scene, by edges; see ``core/edge_alignment.py``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mudg.base import log
from mudg.base.types import Frame, Scene, Sweep, View
from mudg.core.edge_alignment import MIN_CONTRAST, MIN_JUMPS, TURNS_DEG, EdgeAlignment, edge_alignment
from mudg.data.scene.read import read_image, read_points

IMAGES_PER_CAMERA = 6
MAX_GAP_S = 0.06


def sweeps_beside(scene: Scene, frame: Frame, max_gap_s: float) -> list[Sweep]:
    """The nearest sweep of each LiDAR within ``max_gap_s`` seconds of the image, in the order of their distance in time."""
    nearest: dict[str, Sweep] = {}
    for sweep in scene.sweeps:
        best = nearest.get(sweep.sensor)
        gap = abs(sweep.time_s - frame.view.time_s)
        if gap <= max_gap_s and (best is None or gap < abs(best.time_s - frame.view.time_s)):
            nearest[sweep.sensor] = sweep
    return sorted(nearest.values(), key=lambda sweep: abs(sweep.time_s - frame.view.time_s))


def camera_alignment(scene: Scene) -> dict[str, EdgeAlignment]:
    """Camera name -> how its images fit the sweeps of the same time, from up to six images; empty without sweeps."""
    if not scene.sweeps:
        return {}
    with log.task("comparing LiDAR and image edges", len(scene.cameras)) as bar:
        found = {}
        for name in scene.cameras:
            found[name] = edge_alignment(_shots(scene, name))
            bar.advance()
    return found


def _shots(scene: Scene, name: str) -> Iterator[tuple[View, Any, Any, Any]]:
    frames = scene.frames_of(name)
    for index in np.unique(np.linspace(0, len(frames) - 1, IMAGES_PER_CAMERA).astype(int)) if frames else ():
        frame = frames[index]
        for sweep in sweeps_beside(scene, frame, MAX_GAP_S):
            yield frame.view, read_image(scene, frame), sweep.world_from_lidar, read_points(scene, sweep).xyz


def describe(name: str, found: EdgeAlignment) -> str:
    """One sentence about a camera."""
    if found.verdict == "unknown":
        if found.jumps < MIN_JUMPS:
            return f"camera {name}: too few depth edges to compare with its images ({found.jumps})"
        why = "other turns fit about as well"
        if found.contrast < MIN_CONTRAST:
            why = f"no turn of up to {TURNS_DEG[-1]:g} degrees stands out"
        elif max(abs(angle) for angle in found.best_turn_deg) == TURNS_DEG[-1]:
            why = "the best turn is at the end of the range tried"
        return f"camera {name}: {found.jumps} depth edges do not tell whether LiDAR and images agree ({why}); look at the contact sheet"
    score = f"score {found.score:.2f}, {found.jumps} depth edges"
    if found.verdict == "right":
        return f"camera {name}: LiDAR and image edges agree ({score})"
    right, up = found.best_turn_deg
    return (
        f"camera {name}: LiDAR edges fit the image better when moved by {right:+.1f} degrees to the right and {up:+.1f} up "
        f"({score}); check calibration, poses and clocks"
    )


def to_json(found: EdgeAlignment) -> dict[str, Any]:
    """Plain values for JSON."""
    return {
        "verdict": found.verdict, "score": round(found.score, 3), "best_turn_deg": list(found.best_turn_deg),
        "contrast": round(found.contrast, 3), "sigmas": round(found.sigmas, 2), "depth_edges": found.jumps,
    }  # fmt: skip
