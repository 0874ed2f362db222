"""A script carried out on a fitted scene and the log that it belongs to, in memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mudg.base import log
from mudg.base.errors import InputError
from mudg.base.types import FusedCloud, Scene
from mudg.core.edit import Motion
from mudg.editing.apply import (
    EGO_FACT,
    StreetOf,
    edited_cloud,
    edited_model,
    edited_scene,
    ego_fact,
    ground_of,
    street_left,
)
from mudg.editing.assets import asset_from, read_asset
from mudg.editing.light import surface_light, take_light
from mudg.editing.model import GROUND_CLASSES, Asset, ground_points, lowest_points
from mudg.editing.plan import Background, EditPlan, EditSources, EditWorld, check, plan_edits, shown_anew
from mudg.editing.runs import RunParts, find_run
from mudg.editing.script import AssetSource, EditScript
from mudg.editing.weathered import conditions_of
from mudg.gaussians.model import SceneModel
from mudg.gaussians.storage import load_model
from mudg.scene.clouds import read_fused
from mudg.scene.read import read_scene

IMPORTED = "imported"
"""Method of a scene that was read from a file of another program."""
FACT = "edits"
"""Fact of an edited fitted scene: the script, its digest, and what its checks found."""


@dataclass(frozen=True, slots=True, eq=False)
class EditedDrive:
    """What a script made of a drive.

    Args:
        plan: what was done. scene, cloud: edited; None where they were not given.
        notes: what the reader should know (``checks.check``).
    """

    script: EditScript
    plan: EditPlan
    scene: Scene | None
    cloud: FusedCloud | None
    notes: list[dict[str, Any]]

    def model(self, model: SceneModel, keep_ego: bool = False, street_of: StreetOf = street_left) -> SceneModel:
        """A fitted scene of this drive, edited.

        Args:
            keep_ego: note the vehicle's new path in the scene's facts, for those who know the recorded path alone.
            street_of: makes the street that objects left (``apply.street_left``), or remembers it.
        """
        sky = None if self.plan.sky is None else self.script.path_of(self.plan.sky.image)
        made = edited_model(model, self.plan, sky, street_of)
        facts = {**made.facts, FACT: {"script": self.script.canonical(), "notes": self.notes}}
        if keep_ego and self.plan.moves_ego and self.plan.after.ego is not None:
            facts[EGO_FACT] = ego_fact(self.plan.after.ego)
        return replace(made, facts=facts)


def carry_out(
    script: EditScript, model: SceneModel, scene: Scene | None = None, cloud: FusedCloud | None = None
) -> EditedDrive:
    """Carry out a script on a drive, but for its fitted scenes (``EditedDrive.model``).

    Args:
        model: a fit of the drive: its objects are those that a script can name where there is no scene; its ground
            where there is no cloud.

    Raises:
        InputError: something in the script that cannot be done here.
    """
    if conditions_of(script.canonical()) is not None and not model.classes:
        raise InputError(
            "weather, light and season need the classes of surfaces, and this scene was fitted without",
            where="weather, light, season",
            remedy="fit a scene with labels (`mudg annotate` makes them), or take them out of the script",
        )
    ground = ground_of(cloud, model)
    world = EditWorld.of_model(model, ground) if scene is None else EditWorld.of_scene(scene, ground)
    background = lambda name: background_of(find_run(script.path_of(name)), name)  # noqa: E731
    closes = scene is not None and is_recording(scene)
    plan = plan_edits(script, world, EditSources(opener(script), background, close_street=closes))
    plan.views = () if scene is None else tuple(frame.view for frame in scene.frames)
    take_light(plan, model)
    if scene is None and plan.closed:
        plan.notes.append(
            {
                "kind": "street not closed",
                "ids": sorted(plan.closed),
                "text": (
                    f"the street behind {', '.join(sorted(plan.closed))} stays as it was fitted: what recorded views"
                    " show of it is not known (give --scene)"
                ),
            }
        )
    made = None if scene is None else edited_scene(scene, plan)
    views = (
        ([], []) if scene is None or made is None else tuple([frame.view for frame in s.frames] for s in (scene, made))
    )
    plan.sides &= shown_anew(plan, *views)
    notes = check(plan, *views)
    for note in notes:
        (log.info if note["kind"] == "lateral acceleration" else log.warn)(f"edit: {note['text']}")
    return EditedDrive(script, plan, made, None if cloud is None else edited_cloud(cloud, plan), notes)


def is_recording(scene: Scene) -> bool:
    """Whether a scene comes from sensors and not from the city generator, which has exact pictures of what an object
    hid."""
    return scene.source.recipe is None


def background_of(parts: RunParts, name: str) -> Background:
    """The street of a run; or of a file, which begins at its origin and leads along x.

    Raises:
        InputError: a fit by itself, of which the path of the vehicle is not known, or one without ground.
    """
    if parts.scene is None and (found := load_model(parts.model)).facts.get("method") == IMPORTED:
        known = ground_points(found)
        return Background(found, Motion.recorded([0.0], np.eye(4)[None]), known if len(known) else lowest_points(found))
    if parts.scene is None:
        raise InputError(
            "of a fit alone it is not known where its street lies",
            where="run",
            got=name,
            expected="a folder made by `mudg run` or by `mudg asset import --kind scene`",
        )
    scene, model = read_scene(parts.scene), load_model(parts.model)
    ground, cloud = ground_points(model), None if parts.fused is None else read_fused(parts.fused).static
    if cloud is not None and cloud.semantics is not None:
        ground = cloud.xyz[np.isin(cloud.semantics, GROUND_CLASSES)]
    if not len(ground):
        raise InputError("the other street has no ground: its fit knows no classes", where="run", got=name)
    light = surface_light(model, [frame.view for frame in scene.frames])
    return Background(model, Motion.recorded(scene.ego.times_s, scene.ego.world_from_ego), ground, cloud, light)


def opener(script: EditScript) -> Callable[[AssetSource], Asset]:
    """What reads the objects that a script names."""

    def opened(source: AssetSource) -> Asset:
        if source.file is not None:
            return read_asset(script.path_of(source.file))
        return asset_from(find_run(script.path_of(source.run or "")), source.id or "")

    return opened
