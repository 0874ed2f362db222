"""The street where an object is gone: hidden ground is closed, shadows are brightened, nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import Camera, View
from mudg.core.edit import Motion
from mudg.core.table import Table
from mudg.data.edits import parse_edits
from mudg.models.scene.initial import SH_C0
from mudg.models.scene.model import CERTAINTY, SceneModel
from mudg.models.scene.nodes import StaticNode
from mudg.models.scene.uncovered import without_traces
from mudg.stages.editing.apply import hidden_by
from mudg.stages.editing.plan import Actor, EditSources, EditWorld, plan_edits

SIZE = (4.0, 2.0, 1.5)
CAMERA = Camera("front", 120, 80, 90.0, 90.0, 60.0, 40.0)
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
LIT, SHADED = 0.55, 0.4


def lead() -> tuple[Actor, list[View]]:
    """A car that drives 8 m ahead of the camera, 1.5 m per second along x."""
    times = np.arange(5) / 4
    poses = np.stack([geometry.yaw_matrix(0.0, (8 + 1.5 * t, 0, 0.75)) for t in times])
    views = [View(CAMERA, geometry.from_rotation_translation(FORWARD, (1.5 * t, 0, 1.4)), float(t)) for t in times]
    return Actor("car", SIZE, Motion.recorded(times, poses)), views


def street(xy: np.ndarray, extra: np.ndarray) -> SceneModel:
    """Level road, dark beside the car's path; ``extra`` f64[M, 3] are black Gaussians of a building."""
    beside = (np.abs(xy[:, 1]) < 1.5) & (xy[:, 0] > 5.5) & (xy[:, 0] < 12)
    grey = np.concatenate([np.where(beside, SHADED, LIT), np.zeros(len(extra))])
    means = np.concatenate([np.column_stack([xy, np.zeros(len(xy))]), extra])
    classes = torch.full((len(means), 2), -5.0)
    classes[: len(xy), 0] = 5.0
    classes[len(xy) :, 1] = 5.0
    columns = {
        "means": torch.from_numpy(means.astype(np.float32)), "quats": torch.tensor([1.0, 0, 0, 0]).repeat(len(means), 1),
        "log_scales": torch.full((len(means), 3), -2.0), "logits": torch.full((len(means),), 3.0),
        "sh_dc": torch.from_numpy((grey - 0.5) / SH_C0).float()[:, None, None].repeat(1, 1, 3), "semantics": classes,
    }  # fmt: skip
    labels = {"node": torch.zeros(len(means), dtype=torch.int32), CERTAINTY: torch.ones(len(means), dtype=torch.float16)}
    return SceneModel(Table(columns, labels), (StaticNode(),), None, (ID["road"], ID["building"]), 0)


def grey_of(model: SceneModel) -> np.ndarray:
    return 0.5 + SH_C0 * model.table["sh_dc"].detach().numpy()[:, 0, 0].astype(np.float64)


def test_hidden_ground_is_closed() -> None:
    xy = np.stack(np.meshgrid(np.arange(2, 30, 0.3), np.arange(-7, 7, 0.3), indexing="ij"), -1).reshape(-1, 2)
    seen = (np.abs(xy[:, 1]) > 2.4) | (xy[:, 0] < 9)  # nobody saw the road ahead of the car
    floaters = np.array([[9.0, 0.2, 0.9], [8.2, -0.4, 0.6]])
    wall = np.array([[20.0, 5.0, 2.0], [8.0, 3.0, 1.0]])
    model = street(xy[seen], np.concatenate([floaters, wall]))
    actor, views = lead()
    made = without_traces(model, [hidden_by(actor, views)])
    means, grey = made.table["means"].detach().numpy(), grey_of(made)
    buildings = made.table["semantics"].detach().argmax(1).numpy() == 1
    assert {tuple(np.round(m, 3)) for m in means[buildings]} == {tuple(np.round(w, 3)) for w in wall.astype(np.float32)}
    new = made.table.labels[CERTAINTY].numpy() == 0
    assert new.sum() > 50 and np.allclose(means[new, 2], 0, atol=1e-6)
    inside = means[new, :2]
    assert inside[:, 0].min() > 7 and np.abs(inside[:, 1]).max() < 6
    assert ((inside[:, 0] > 13) & (np.abs(inside[:, 1]) < 0.5)).any()  # the middle of what was hidden
    far = ~new & ~buildings & (np.abs(means[:, 1]) > 2.5)
    assert np.allclose(grey[far], LIT, atol=1e-6)
    assert np.array_equal(grey_of(model), grey_of(street(xy[seen], np.concatenate([floaters, wall]))))  # the original stays


def test_the_shadow_of_what_stands_becomes_as_bright_as_what_lies_around() -> None:
    xy = np.stack(np.meshgrid(np.arange(2, 30, 0.3), np.arange(-7, 7, 0.3), indexing="ij"), -1).reshape(-1, 2)
    model, (actor, views) = street(xy, np.zeros((0, 3))), lead()
    hidden = hidden_by(actor, views)
    for moves in (False, True):
        made = without_traces(model, [replace(hidden, moves=moves)])
        means, kept = made.table["means"].detach().numpy(), made.table.labels[CERTAINTY].numpy() > 0
        near = kept & (np.abs(means[:, 1]) < 1.4) & (means[:, 0] > 6) & (means[:, 0] < 7.2)
        assert near.sum() > 10 and np.median(grey_of(made)[near]) == pytest.approx(SHADED if moves else LIT, abs=0.01)


def test_lit_ground_is_never_darkened_and_what_is_seen_is_not_replaced() -> None:
    xy = np.stack(np.meshgrid(np.arange(2, 30, 0.3), np.arange(-7, 7, 0.3), indexing="ij"), -1).reshape(-1, 2)
    model = street(xy, np.zeros((0, 3)))
    bright = model.table["sh_dc"].detach().clone()
    bright[model.table["means"].detach()[:, 1].abs() < 1.5] = (0.9 - 0.5) / SH_C0
    table = Table({**{k: v.detach() for k, v in model.table.columns.items()}, "sh_dc": bright}, dict(model.table.labels))
    model = SceneModel(table, model.nodes, None, model.classes, 0)
    actor, views = lead()
    aside = [View(CAMERA, geometry.from_rotation_translation(FORWARD, (v.center_world[0], 6.0, 4.0)), v.time_s) for v in views]
    made = without_traces(model, [hidden_by(actor, views + aside)])
    assert np.all(grey_of(made)[made.table.labels[CERTAINTY].numpy() > 0] >= LIT - 1e-6)
    only = without_traces(model, [hidden_by(actor, views)])
    count = [int((m.table.labels[CERTAINTY] == 0).sum()) for m in (made, only)]
    assert count[0] < count[1]  # a camera that looks over the car leaves less to guess


def test_a_script_says_whose_traces_go() -> None:
    actor, _ = lead()
    for verb, text in (("remove", "ids: [a]"), ("move", "id: a, along_m: 9")):
        for asked in (True, False):
            script = parse_edits(f"- {verb}: {{{text}, close_street: {str(asked).lower()}}}", "e")
            plan = plan_edits(script, EditWorld({"a": actor}), EditSources(lambda s: None, lambda n: None))  # type: ignore[arg-type,return-value]
            assert plan.closed == ({"a"} if asked else set())


def test_a_scene_without_ground_or_views_stays() -> None:
    model = street(np.zeros((4, 2)), np.zeros((0, 3)))
    actor, views = lead()
    assert without_traces(model, [hidden_by(actor, views)]) is model
    assert without_traces(model, [hidden_by(actor, [])]) is model
