"""What views are held against: the generated city drawn again, held-out recorded frames, or truth drawn by an earlier run.

A folder of truth (``write_truth``) holds one observation folder per trajectory and, beside the observations,
``moving.safetensors``: u8[T, H, W], 1 where a moving object is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry, log, store
from mudg.base.errors import InputError
from mudg.base.run_folder import RunDir, VerbOutput, below, refuse_overlap
from mudg.base.types import Frame, Observation, Scene, Trajectory, View
from mudg.core.pictures import resize_nearest, resize_rgb
from mudg.data.city import CityWorld
from mudg.data.city import logs as city_logs
from mudg.data.observations import OBSERVATION_FILES, ObservationWriter, list_observation_sets, read_observations
from mudg.data.scene import read_image, read_label, read_points, read_scene

MOVING_FILE: Final = "moving.safetensors"
SAME_SWEEP_S: Final = 0.05
SAME_TIME_S: Final = 1e-4
SAME_PLACE_M: Final = 1e-3
_OUTPUT: Final = VerbOutput("truth", 1, below("*", (*OBSERVATION_FILES, MOVING_FILE)))


@dataclass(frozen=True)
class TrueView:
    """The truth at a view; ``moving`` bool[1, H, W], true pixels of moving objects, or None where they are not known."""

    seen: Observation
    moving: Tensor | None = None


@dataclass(frozen=True)
class Truth:
    """Where truth comes from: ``at(view, frame, trajectory)`` is None where there is none.

    Args:
        exact: truth exists at every pixel of every view. stored: it lies on disk already and need not be written again.
    """

    exact: bool
    at: Callable[[View, Frame | None, str], TrueView | None]
    stored: bool = False


def truth_of(scene: Scene) -> Truth:
    """Exact truth for a generated city; else the recorded frame a view belongs to."""
    if scene.source.recipe is not None:
        world = CityWorld.from_source(scene.source)
        moving = np.array(city_logs.moving_instances(world), np.int32)
        return Truth(True, lambda view, _frame, _name: _city_view(world, moving, view))
    return Truth(False, lambda view, frame, _name: None if frame is None else TrueView(_recorded(scene, frame, view)))


def _city_view(world: CityWorld, moving: NDArray[np.int32], view: View) -> TrueView:
    truth = world.render(view)
    return TrueView(world.observation(view, truth), torch.from_numpy(np.isin(truth.instance, moving))[None])


def write_truth(scene: Path, trajectories: Sequence[Trajectory], out: Path, *, overwrite: bool = False) -> Path:
    """Draw the truth of a generated city on some trajectories once, for many scores (``score.run(truth=...)``).

    Raises:
        InputError: the scene was not generated.
    """
    refuse_overlap(out, {"scene": scene})
    views = [
        [v.time_s, *v.world_from_cam.ravel().tolist(), v.camera.width] for path in trajectories for v in path.views
    ]
    asked = {"trajectories": [path.name for path in trajectories], "views": views}
    folder = RunDir.open(out, _OUTPUT, asked, {"scene": store.digest(scene)}, overwrite)
    if folder.complete:
        return folder.reused()
    truth = truth_of(read_scene(scene))
    if not truth.exact:
        raise InputError("only a generated city has truth at any view", where=str(scene))
    with log.task("truth", sum(map(len, trajectories))) as bar:
        for path in trajectories:
            masks = []
            with ObservationWriter(folder.path / path.name, path.name, "truth", "recorded") as writer:
                for view in path.views:
                    true = truth.at(view, None, path.name)
                    if true is None or true.moving is None:
                        raise InputError("the city has no truth here", where=f"{path.name}, {view.time_s:g} s")
                    masks.append(true.moving[0].numpy().astype(np.uint8))
                    if len(masks) <= writer.done:
                        writer.skip(view)  # an interrupted run wrote it
                    else:
                        writer.add(true.seen)
                    bar.advance()
            store.write_safetensors(folder.path / path.name / MOVING_FILE, {"moving": np.stack(masks)})
    folder.finish({"trajectories": [path.name for path in trajectories]})
    return folder.path


def stored_truth(folder: Path) -> Truth:
    """Truth that ``write_truth`` left in a folder. A view that it lacks is an InputError."""
    sets = {name: read_observations(path) for name, path in list_observation_sets(folder).items()}
    masks = {name: store.read_safetensors(folder / name / MOVING_FILE)["moving"] for name in sets}

    def at(view: View, _frame: Frame | None, name: str) -> TrueView:
        of = sets.get(name)
        if of is None:
            raise InputError(
                "the folder of truth lacks a trajectory", where=str(folder), expected=name, got=", ".join(sets)
            )
        index = min(range(len(of)), key=lambda i: abs(of.views[i].time_s - view.time_s))
        there = of.views[index]
        apart_m = float(np.linalg.norm(there.center_world - view.center_world))
        same_size = (there.camera.width, there.camera.height) == (view.camera.width, view.camera.height)
        if abs(there.time_s - view.time_s) > SAME_TIME_S or apart_m > SAME_PLACE_M or not same_size:
            raise InputError(
                "the stored truth shows another view", where=f"{folder / name}, view {index}",
                expected=f"{view.time_s:.4f} s, {view.camera.width}x{view.camera.height}",
                got=f"{there.time_s:.4f} s, {there.camera.width}x{there.camera.height}, {apart_m:.3f} m apart",
            )  # fmt: skip
        return TrueView(of[index], torch.from_numpy(masks[name][index].astype(bool))[None])

    return Truth(True, at, stored=True)


def _recorded(scene: Scene, frame: Frame, view: View) -> Observation:
    """A recorded frame at the common size, with measured depth and the labels the log came with, never guessed ones."""
    height, width = view.camera.height, view.camera.width
    rgb = torch.from_numpy(read_image(scene, frame).copy()).permute(2, 0, 1).float() / 255
    semantics = None
    if "semantics" in frame.labels and "semantics_confidence" not in frame.labels:  # else a labeller made them
        labels = torch.from_numpy(read_label(scene, frame, "semantics").astype(np.int64))[None]
        semantics = resize_nearest(labels, height, width)[0]
    if "depth" in frame.labels and "depth_confidence" not in frame.labels:
        measured = torch.from_numpy(read_label(scene, frame, "depth").copy())[None]
        depth: Tensor | None = resize_nearest(measured, height, width)
    else:
        depth = _lidar_depth(scene, view)
    keep = torch.ones(1, height, width, dtype=torch.bool)
    if "ego" in frame.labels:
        ego = torch.from_numpy(read_label(scene, frame, "ego").astype(bool))[None]
        keep = ~resize_nearest(ego, height, width)
    return Observation(
        view=view, rgb=resize_rgb(rgb, height, width), depth=depth, semantics=semantics,
        confidence=torch.ones(1, height, width), mask=keep, kind="recorded", source="camera",
    )  # fmt: skip


def _lidar_depth(scene: Scene, view: View) -> Tensor | None:
    """Depth f32[1, H, W] of the sweep taken with this frame (NaN where no point fell), or None without such a sweep."""
    from mudg.stages.fitting.views import visible_lidar

    sweeps = [s for s in scene.sweeps if abs(s.time_s - view.time_s) <= SAME_SWEEP_S]
    if not sweeps:
        return None
    points = [geometry.transform_points(s.world_from_lidar, read_points(scene, s).xyz) for s in sweeps]
    seen = visible_lidar(view, np.concatenate(points).astype(np.float32))
    depth = torch.full((view.camera.height * view.camera.width,), torch.nan)
    depth[seen.pixel] = seen.depth_m
    return depth.reshape(1, view.camera.height, view.camera.width)
