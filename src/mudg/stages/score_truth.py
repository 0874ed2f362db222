"""What views are held against: the generated city drawn again, held-out recorded frames, or truth drawn by an earlier run.

A folder of truth (``write_truth``) holds one observation folder per trajectory and, beside the observations,
``moving.safetensors``: ``moving`` u8[T, H, W], 1 where a dynamic object is seen, ``instance`` i32[T, H, W], and ``marking`` u8[T, H, W], 1
where there is paint on the road.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry, log, store
from mudg.base.errors import InputError
from mudg.base.types import Frame, Observation, Scene, Trajectory, View
from mudg.core.fusion import largest_beam_gap
from mudg.core.pictures import resize_nearest, resize_rgb
from mudg.core.visible import RULES as HIDING_RULES
from mudg.core.visible import visible_depth
from mudg.data.city import CityWorld
from mudg.data.city import logs as city_logs
from mudg.data.observations import ObservationWriter, list_observation_sets, read_observations
from mudg.data.scene import read_image, read_label, read_points, read_scene

MOVING_FILE: Final = "moving.safetensors"
SAME_SWEEP_S: Final = 0.05
MAX_LIDAR_M: Final = 100.0
SAME_TIME_S: Final = 1e-4
SAME_PLACE_M: Final = 1e-3


@dataclass(frozen=True)
class ViewTruth:
    """The truth at a view, with what is known only of generated cities: ``moving`` bool[1, H, W], true pixels of dynamic objects;
    ``instance`` i32[H, W], number of the object that is seen; ``marking`` bool[H, W], paint on the road."""

    seen: Observation
    moving: Tensor | None = None
    instance: NDArray[np.int32] | None = None
    marking: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Truth:
    """Where truth comes from: ``at_view(view, frame, trajectory)`` is None where there is none.

    Args:
        exact: truth exists at every pixel of every view. stored: it lies on disk already and need not be written again.
    """

    exact: bool
    at_view: Callable[[View, Frame | None, str], ViewTruth | None]
    stored: bool = False


def apart_m(a: View, b: View) -> float:
    """Distance of two cameras, metres."""
    return float(np.linalg.norm(a.center_world - b.center_world))


def truth_of(scene: Scene) -> Truth:
    """Exact truth for a generated city; else the recorded frame a view belongs to."""
    if scene.source.recipe is not None:
        world = CityWorld.from_source(scene.source)
        for frame in scene.frames:
            there, stated = world.ego_path().pose_at(frame.view.time_s), scene.ego.pose_at(frame.view.time_s)
            if there is None or stated is None or not np.allclose(there, stated, atol=1e-3):
                raise InputError("the scene is not the generated city that its recipe names, so its truth would be another street's",
                    where=f"{scene.root}: source.recipe, frame {frame.id}", expected="the path of the vehicle that the recipe makes",
                    remedy="generate the city again; in scenes of other origin, leave the recipe out")  # fmt: skip
        moving = np.array(city_logs.moving_instances(world), np.int32)
        return Truth(True, lambda view, _frame, _name: _city_view(world, moving, view))
    return Truth(False, lambda view, frame, _name: None if frame is None else ViewTruth(_recorded(scene, frame, view)))


def _city_view(world: CityWorld, moving: NDArray[np.int32], view: View) -> ViewTruth:
    truth = world.render(view)
    dynamic = torch.from_numpy(np.isin(truth.instance, moving))[None]
    return ViewTruth(world.observation(view, truth), dynamic, truth.instance, world.markings(view, truth))


def write_truth(scene: Path, trajectories: Sequence[Trajectory], out: Path) -> None:
    """Draw the truth of a generated city on some trajectories once, for many scores.

    Raises:
        InputError: the scene was not generated.
    """
    truth = truth_of(read_scene(scene))
    if not truth.exact:
        raise InputError("only a generated city has ground truth at every view", where=str(scene))
    with log.task("truth", sum(map(len, trajectories))) as bar:
        for path in trajectories:
            maps: dict[str, list[NDArray[Any]]] = {"moving": [], "instance": [], "marking": []}
            with ObservationWriter(out / path.name, path.name, "truth", "recorded") as writer:
                for view in path.views:
                    true = truth.at_view(view, None, path.name)
                    if true is None or true.moving is None or true.instance is None or true.marking is None:
                        raise InputError("the city has no ground truth at this view", where=f"{path.name}, {view.time_s:g} s")
                    own = (true.moving[0].numpy().astype(np.uint8), true.instance, true.marking.astype(np.uint8))
                    for found, value in zip(maps.values(), own, strict=True):
                        found.append(value)
                    if len(maps["moving"]) <= writer.done:
                        writer.skip(view)  # an interrupted run wrote it
                    else:
                        writer.add(true.seen)
                    bar.advance()
            store.write_safetensors(out / path.name / MOVING_FILE, {k: np.stack(v) for k, v in maps.items()})


def stored_truth(folder: Path) -> Truth:
    """Truth that ``write_truth`` left in a folder. A view that it lacks is an InputError."""
    sets = {name: read_observations(path) for name, path in list_observation_sets(folder).items()}
    maps = {name: store.read_safetensors(folder / name / MOVING_FILE) for name in sets}

    def find(view: View, _frame: Frame | None, name: str) -> ViewTruth:
        stored = sets.get(name)
        if stored is None:
            raise InputError(
                "the folder of ground truth lacks a trajectory", where=str(folder), expected=name, got=", ".join(sets)
            )
        index = min(range(len(stored)), key=lambda i: abs(stored.views[i].time_s - view.time_s))
        there = stored.views[index]
        distance_m = apart_m(there, view)
        same_size = (there.camera.width, there.camera.height) == (view.camera.width, view.camera.height)
        if abs(there.time_s - view.time_s) > SAME_TIME_S or distance_m > SAME_PLACE_M or not same_size:
            raise InputError(
                "the stored ground truth shows another view", where=f"{folder / name}, view {index}",
                expected=f"{view.time_s:.4f} s, {view.camera.width}x{view.camera.height}",
                got=f"{there.time_s:.4f} s, {there.camera.width}x{there.camera.height}, {distance_m:.3f} m apart",
            )  # fmt: skip
        own = maps[name]
        moving = torch.from_numpy(own["moving"][index].astype(bool))[None]
        return ViewTruth(stored[index], moving, own["instance"][index], own["marking"][index].astype(bool))

    return Truth(True, find, stored=True)


def _recorded(scene: Scene, frame: Frame, view: View) -> Observation:
    """A recorded frame at the common size, with measured depth and the labels the log came with, never guessed ones."""
    height, width = view.camera.height, view.camera.width

    def label(name: str) -> NDArray[Any] | None:
        if (
            name not in frame.labels or f"{name}_confidence" in frame.labels
        ):  # a label with a confidence is a labeller's
            return None
        return resize_nearest(read_label(scene, frame, name), height, width)

    semantics, depth, ego = label("semantics"), label("depth"), label("ego")
    return Observation(
        view=view,
        rgb=resize_rgb(torch.from_numpy(read_image(scene, frame).copy()).permute(2, 0, 1).float() / 255, height, width),
        depth=_lidar_depth(scene, view) if depth is None else torch.from_numpy(depth.copy())[None],
        semantics=None if semantics is None else torch.from_numpy(semantics.astype(np.int64)),
        confidence=torch.ones(1, height, width),
        mask=torch.ones(1, height, width, dtype=torch.bool) if ego is None else torch.from_numpy(ego == 0)[None],
        kind="recorded", source="camera",
    )  # fmt: skip


def _lidar_depth(scene: Scene, view: View) -> Tensor | None:
    """Depth f32[1, H, W] of the sweep taken with this frame (NaN where no point fell), or None without such a sweep."""
    sweeps = [s for s in scene.sweeps if abs(s.time_s - view.time_s) <= SAME_SWEEP_S]
    if not sweeps:
        return None
    clouds = [(sweep, read_points(scene, sweep).xyz) for sweep in sweeps]
    world = np.concatenate([geometry.transform_points(sweep.world_from_lidar, xyz) for sweep, xyz in clouds]).astype(np.float32)
    gap_deg = max(largest_beam_gap(xyz) for _, xyz in clouds)
    return torch.from_numpy(visible_depth(view, world, HIDING_RULES["sweep"], gap_deg=gap_deg, far_m=MAX_LIDAR_M))[None]
