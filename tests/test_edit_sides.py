"""Vehicles that are turned or moved aside have flanks where the recording showed none; what it did show stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import Camera, View
from mudg.core.edit import Motion
from mudg.core.raster.rasterize import RasterConfig
from mudg.core.table import Table
from mudg.editing.apply import complete_asset
from mudg.editing.model import with_closed_sides
from mudg.editing.plan import Actor, EditSources, EditWorld, plan_edits, shown_anew
from mudg.editing.script import parse_edits
from mudg.gaussians.model import CERTAINTY, SceneModel
from mudg.gaussians.nodes import RigidNode, StaticNode
from mudg.gaussians.start import SH_C0

SIZE = (4.0, 1.8, 1.5)
CAMERA = Camera("front", 120, 80, 90.0, 90.0, 60.0, 40.0)
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
RASTER = RasterConfig(near_m=0.2)
TIMES = np.arange(4) / 3
POSES = np.stack([geometry.yaw_matrix(0.0, (8 + t, 0, 0.75)) for t in TIMES])
ACTOR = Actor("car", SIZE, Motion.recorded(TIMES, POSES))
VIEWS = [View(CAMERA, geometry.from_rotation_translation(FORWARD, (t, 0, 1.2)), float(t)) for t in TIMES]


def behind(label: str = "car", flank: float | None = None) -> SceneModel:
    """The rear of a vehicle, red below and blue above; with its left flank (y = ``flank``) where that is given."""
    axis = lambda a, b: np.arange(a, b, 0.08)
    y, z = (part.ravel() for part in np.meshgrid(axis(-0.88, 0.9), axis(-0.7, 0.75)))
    places = [np.column_stack([np.full(len(y), -1.95), y, z])]
    if flank is not None:
        x, z = (part.ravel() for part in np.meshgrid(axis(-1.95, 2), axis(-0.7, 0.75)))
        places.append(np.column_stack([x, np.full(len(x), flank), z]))
    means = np.concatenate(places)
    colors = np.where(means[:, 2:] < 0, [0.8, 0.1, 0.1], [0.1, 0.1, 0.8])
    count = len(means)
    columns = {
        "means": torch.from_numpy(means.astype(np.float32)),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(count, 1),
        "log_scales": torch.log(torch.tensor([0.02, 0.05, 0.05])).repeat(count, 1),
        "logits": torch.full((count,), 5.0),
        "sh_dc": torch.from_numpy((colors - 0.5) / SH_C0).float()[:, None],
        "semantics": torch.tensor([[-5.0, 5.0]]).repeat(count, 1),
    }
    labels = {"node": torch.ones(count, dtype=torch.int32), CERTAINTY: torch.ones(count, dtype=torch.float16)}
    node = RigidNode("car", label, list(SIZE), ACTOR.motion.times_s, ACTOR.motion.poses)
    return SceneModel(Table(columns, labels), (StaticNode(), node), None, (ID["road"], ID["car"]), 0)


def made(before: SceneModel, after: SceneModel) -> tuple[np.ndarray, np.ndarray]:
    """Places and colours of the new rows, which are those of certainty 0."""
    assert after.certainty is not None
    new = (after.certainty == 0).numpy()
    assert new.sum() == len(after.table) - len(before.table)
    for name, value in before.table.columns.items():
        assert torch.equal(after.table[name][~torch.from_numpy(new)], value)
    return after.table["means"].detach().numpy()[new], 0.5 + SH_C0 * after.table["sh_dc"].detach().numpy()[new, 0]


def test_flanks_continue_the_colours_of_the_rear() -> None:
    model = behind()
    places, colors = made(model, with_closed_sides(model, ["car"], VIEWS, RASTER))
    assert set(np.sign(places[:, 1])) == {-1.0, 1.0} and np.abs(places[:, 1]).max() <= SIZE[1] / 2
    assert places[:, 0].min() < -1.6 and places[:, 0].max() > 1.8
    low, high = places[:, 2] < -0.2, places[:, 2] > 0.2
    assert low.any() and high.any()
    for part, color in ((low, [0.8, 0.1, 0.1]), (high, [0.1, 0.1, 0.8])):
        assert np.allclose(colors[part], color, atol=1e-3)
    assert np.abs(places[high, 0]).max() < places[low, 0].max()  # a car is shorter above


def test_only_gaps_of_vehicles_are_closed() -> None:
    model = behind(flank=0.84)
    places, _ = made(model, with_closed_sides(model, ["car"], VIEWS, RASTER))
    assert len(places) and (places[:, 1] < 0).all()  # the left flank is there
    person = behind("pedestrian")
    assert with_closed_sides(person, ["car"], VIEWS, RASTER) is person


def test_what_views_show_is_not_made_up() -> None:
    turn, model = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), behind()
    poses = [geometry.from_rotation_translation(turn, (8 + t, -5, 0.8)) for t in TIMES]
    beside = [View(CAMERA, pose, float(t)) for pose, t in zip(poses, TIMES, strict=True)]

    def right(views: Sequence[View]) -> int:
        return int((made(model, with_closed_sides(model, ["car"], views, RASTER))[0][:, 1] < 0).sum())

    assert right([*VIEWS, *beside]) < 0.2 * right(VIEWS)  # the right flank was seen to be empty; measured: 0


AWAY = [View(CAMERA, geometry.yaw_matrix(0.0, (0, 2.0, 0)) @ view.world_from_cam, view.time_s) for view in VIEWS]


@pytest.mark.parametrize(
    ("text", "views", "closed"),
    [
        *(("- move: {id: car, left_m: 2}", VIEWS, True), ("- move: {id: car, yaw_deg: 10}", VIEWS, True)),
        ("- move: {id: car, along_m: 3}", VIEWS, False),
        ("- move: {id: car, left_m: 2, close_sides: false}", VIEWS, False),
        *(("- move: {id: ego, left_m: 2}", AWAY, True), ("- move: {id: ego, left_m: 2}", VIEWS, False)),
        ("- move: {id: ego, left_m: 2, close_sides: false}", AWAY, False),
        ("- move: {id: ego, left_m: 2}\n- remove: {ids: [car]}", AWAY, False),
        ("- remove: {ids: [car]}", AWAY, False),
    ],
)
def test_only_what_is_seen_from_another_side_is_closed(text: str, views: list[View], closed: bool) -> None:
    """Of a vehicle that moves, and of one that another path shows."""
    ego = Motion.recorded(np.array(TIMES, float), np.stack([geometry.yaw_matrix(0.0)] * len(TIMES)))
    sources = EditSources(lambda s: None, lambda n: None)
    plan = plan_edits(parse_edits(text, "sides"), EditWorld({"car": ACTOR}, ego), sources)
    assert plan.sides & shown_anew(plan, VIEWS, views) == ({"car"} if closed else set())


def test_an_asset_has_all_its_sides() -> None:
    model = behind()
    asset = complete_asset(model, "car", VIEWS)
    assert len(asset) > len(model.table) and asset.certainty is not None and (asset.certainty == 0).any()
    assert len(asset.seen_rad) == len(VIEWS)
    bare = complete_asset(replace(model, table=model.table), "car", [])
    assert len(bare) >= len(asset) and bare.seen_rad == ()
