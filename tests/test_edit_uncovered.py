"""Where an object is gone or shown from elsewhere: what nobody saw goes, hidden ground is closed, shadows are
brightened, flanks are closed, nothing else changes."""

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
from mudg.core.table import Table
from mudg.editing.apply import complete_asset, hidden_by
from mudg.editing.model import SHOWN, Hidden, continued, noted, shaded_cells, with_closed_sides, without_traces
from mudg.editing.plan import Actor, EditWorld, plan_edits, shown_sides
from mudg.editing.script import parse_edits
from mudg.gaussians.model import CERTAINTY, SceneModel
from mudg.gaussians.nodes import RigidNode, SkyNode, StaticNode
from mudg.gaussians.start import SH_C0

SIZE = (4.0, 2.0, 1.5)
CAMERA = Camera("front", 120, 80, 90.0, 90.0, 60.0, 40.0)
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
LIT, SHADED, CAR = 0.55, 0.3, 0.1
CLASSES = (ID["road"], ID["building"], ID["car"])


def lead(step_m: float = 1.5) -> tuple[Actor, list[View]]:
    """A car 8 m ahead of the camera; both drive ``step_m`` per second along x for a second."""
    times = np.arange(5) / 4
    poses = np.stack([geometry.yaw_matrix(0.0, (8 + step_m * t, 0, 0.75)) for t in times])
    views = [View(CAMERA, geometry.from_rotation_translation(FORWARD, (step_m * t, 0, 1.4)), float(t)) for t in times]
    return Actor("car", SIZE, Motion.recorded(times, poses)), views


def grid(*axes: tuple[float, float, float]) -> np.ndarray:
    """Places f64[M, D] on a regular grid: begin, end and step of each axis."""
    return np.stack(np.meshgrid(*(np.arange(*axis) for axis in axes), indexing="ij"), -1).reshape(-1, len(axes))


def level(xy: np.ndarray) -> np.ndarray:
    return np.column_stack([xy, np.zeros(len(xy))])


ROAD = level(grid((2, 30, 0.3), (-7, 7, 0.3)))
NONE = np.zeros((0, 3))
BEHIND = grid((14, 14.5, 0.3), (-0.6, 0.7, 0.3), (0.2, 1.0, 0.3))


def fitted(
    means: np.ndarray, colors: np.ndarray, kind: np.ndarray, owner: np.ndarray, node: RigidNode, size_m: np.ndarray
) -> SceneModel:
    """A street and an object of opaque Gaussians; ``kind``: indices of `CLASSES`, ``owner``: 1 for the object's."""
    classes = torch.full((len(means), 3), -5.0)
    classes[torch.arange(len(means)), torch.from_numpy(kind)] = 5.0
    columns = {
        "means": torch.from_numpy(means.astype(np.float32)),
        "quats": torch.tensor([1.0, 0, 0, 0]).repeat(len(means), 1),
        "log_scales": torch.from_numpy(np.log(size_m)).float().repeat(len(means), 1),
        "logits": torch.full((len(means),), 4.0),
        "sh_dc": torch.from_numpy((colors - 0.5) / SH_C0).float()[:, None],
        "semantics": classes,
    }
    labels = {"node": torch.from_numpy(owner.astype(np.int32)), CERTAINTY: torch.ones(len(means), dtype=torch.float16)}
    return SceneModel(Table(columns, labels), (StaticNode(), node), None, CLASSES, 0)


def street(actor: Actor, grey: np.ndarray | float = LIT, buildings=NONE, spots=NONE, road=ROAD) -> SceneModel:
    """Level road of given greys, white Gaussians of buildings, black ones of road users in the background, and the car:
    its rear, black."""
    rear = grid((-2.0, -1.95, 0.1), (-0.95, 1, 0.1), (-0.7, 0.8, 0.1))
    means = np.concatenate([road, buildings, spots, rear])
    owner = np.repeat([0, 0, 0, 1], [len(road), len(buildings), len(spots), len(rear)])
    kind = np.repeat([0, 1, 2, 2], [len(road), len(buildings), len(spots), len(rear)])
    greys = np.concatenate(
        [np.broadcast_to(grey, len(road)), np.ones(len(buildings)), np.zeros(len(spots)), np.full(len(rear), CAR)]
    )
    car = RigidNode("car", "car", list(SIZE), actor.motion.times_s, actor.motion.poses)
    return fitted(means, greys[:, None].repeat(3, 1), kind, owner, car, np.full(3, np.exp(-2.0)))


def cleared(model: SceneModel, actor: Actor, views: list[View]) -> SceneModel:
    """The street after the car was removed."""
    known = noted(model, views)
    return without_traces(known.without_nodes(["car"]), {"car": hidden_by(actor, views)}, views)


def grey_of(model: SceneModel) -> np.ndarray:
    return 0.5 + SH_C0 * model.table["sh_dc"].detach().numpy()[:, 0, 0].astype(np.float64)


def means_of(model: SceneModel, class_name: str) -> np.ndarray:
    rows = model.table["semantics"].detach().argmax(1).numpy() == CLASSES.index(ID[class_name])
    return model.table["means"].detach().numpy()[rows]


def made_up(model: SceneModel) -> np.ndarray:
    return model.table.labels[CERTAINTY].numpy() == 0


def same_places(found: np.ndarray, expected: np.ndarray) -> bool:
    return {tuple(np.round(m, 3)) for m in found} == {tuple(np.round(m, 3)) for m in expected.astype(np.float32)}


def test_what_no_view_saw_goes_and_hidden_ground_is_closed() -> None:
    actor, views = lead()
    unseen = np.abs(ROAD[:, 1]) < 0.12 * ROAD[:, 0] - 0.3
    dark = np.where(unseen & (ROAD[:, 0] > 9), 0.0, LIT)  # what a fit left behind the car
    beside = np.array([[20.0, 6.0, 2.0], [12.0, 4.0, 1.0]])
    in_path, around = np.array([[9.0, 0.2, 0.9]]), np.array([[10.0, 1.25, 0.6], [10.0, -3.0, 0.6]])
    model = street(actor, dark, np.concatenate([BEHIND, beside, in_path]), around)
    before = grey_of(model)
    made = cleared(model, actor, views)
    assert same_places(means_of(made, "building"), beside)
    assert same_places(means_of(made, "car"), around[1:])  # the first is a part of the car that the box leaves out
    new, means = made_up(made), made.table["means"].detach().numpy()
    assert new.sum() > 50 and np.allclose(means[new, 2], 0, atol=0.05)
    assert np.allclose(grey_of(made)[new], LIT, atol=0.02)
    assert ((means[new, 0] > 13) & (np.abs(means[new, 1]) < 0.5)).any()  # the middle of what was hidden
    assert np.allclose(grey_of(made)[~new & (np.abs(means[:, 1]) < 4) & (means[:, 2] < 0.1)], LIT, atol=1e-5)
    assert SHOWN not in made.table.labels and np.array_equal(grey_of(model), before)  # the original stays


def test_what_a_view_saw_stays() -> None:
    actor, views = lead()
    model = street(actor, LIT, BEHIND)
    aside = View(CAMERA, geometry.from_rotation_translation(FORWARD, (6.0, -4.0, 3.0)), 0.0)
    made = cleared(model, actor, [*views, aside])
    only = cleared(model, actor, views)
    assert same_places(means_of(made, "building"), BEHIND) and not len(means_of(only, "building"))
    assert made_up(made).sum() < made_up(only).sum()


@pytest.mark.parametrize(("step_m", "gone"), [(1.5, True), (0.0, True), (6.0, False)])
def test_the_shadow_of_what_hardly_moves_becomes_as_bright_as_what_lies_around(step_m: float, gone: bool) -> None:
    actor, views = lead(step_m)
    shadow = (np.abs(ROAD[:, 1]) < 1.1) & (ROAD[:, 0] > 4.4) & (ROAD[:, 0] < 10 + step_m)
    other = (ROAD[:, 1] > 4) & (ROAD[:, 0] < 12)  # of something else
    model = street(actor, np.where(shadow | other, SHADED, LIT))
    made = cleared(model, actor, views)
    means, kept = made.table["means"].detach().numpy(), ~made_up(made)
    near = kept & (np.abs(means[:, 1]) < 0.9) & (means[:, 0] > 4.6) & (means[:, 0] < 5.8) & (means[:, 2] < 0.1)
    assert near.sum() > 10
    assert np.median(grey_of(made)[near]) == pytest.approx(LIT if gone else SHADED, abs=0.02)
    far = kept & (means[:, 1] > 4.3) & (means[:, 0] < 11)
    assert far.sum() > 10 and np.allclose(grey_of(made)[far], SHADED, atol=1e-5)


def test_a_shadow_may_reach_ground_that_no_view_shows() -> None:
    actor, views = lead()
    shadow = (np.abs(ROAD[:, 1]) < 1.1) & (ROAD[:, 0] < 12)  # the camera sees the road from 3.2 m on
    made = cleared(street(actor, np.where(shadow, SHADED, LIT)), actor, views)
    means, grey = made.table["means"].detach().numpy(), grey_of(made)
    assert np.isfinite(grey).all()
    near = ~made_up(made) & (np.abs(means[:, 1]) < 0.9) & (means[:, 0] < 6)
    assert np.allclose(grey[near & (means[:, 0] > 3.5)], LIT, atol=0.05) and (grey[near] >= SHADED - 1e-6).all()


def test_a_shadow_lies_behind_what_throws_it() -> None:
    light = np.full((60, 60), 0.3)
    below = np.zeros((60, 60), bool)
    below[26:34, 28:32] = True
    shadow = np.zeros((60, 60), bool)
    shadow[20:34, 28:32] = True
    light[shadow] = 0.05
    light[20:50, 38:44] = 0.05  # a dark strip beside: of something else
    light[below & (np.indices(below.shape)[0] > 31)] = np.nan  # not known
    found = shaded_cells(light, below, 3.0)
    assert np.array_equal(found, shadow & np.isfinite(light))
    assert not shaded_cells(np.full((60, 60), 0.3), below, 3.0).any()


def test_colours_continue_without_markings() -> None:
    places = grid((-6, 6.1, 0.2), (-6, 6.1, 0.2))
    places = places[np.abs(places).max(1) > 1.5]
    colors = np.repeat(0.4 + 0.01 * places[:, :1], 3, 1)
    marking = np.abs(places[:, 1] - 2) < 0.3
    colors[marking] = 0.95
    found, near = continued(np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0]]), places, colors, np.ones(len(places)))
    assert found[0] == pytest.approx(0.4, abs=0.005) and found[2, 0] < found[0, 0] < found[1, 0]
    assert np.abs(places[near[0]]).max() == pytest.approx(1.6)


@pytest.mark.parametrize("usual", [False, True])
def test_a_script_says_whose_traces_go(usual: bool) -> None:
    actor, _ = lead()
    world = EditWorld({"a": actor, "b": actor}, ego=actor.motion)
    closed = lambda text: plan_edits(parse_edits(text, "e"), world, lambda source: None, usual).closed

    verbs = {
        "remove": "ids: [a]",
        "move": "id: a, along_m: 9",
        "stop": "id: a, at_s: 0.5",
        "speed": "id: a, factor: 0.5",
        "lane_change": "id: a, left_m: 1, start_s: 0, duration_s: 1, most_lateral_m_s2: 9",
        "path": "id: a, points: [[0, 0, 0], [1, 9, 0]]",
    }
    for verb, text in verbs.items():
        for asked in (True, False):
            assert closed(f"- {verb}: {{{text}, close_street: {str(asked).lower()}}}") == ({"a"} if asked else set())
        assert closed(f"- {verb}: {{{text}}}") == ({"a"} if usual else set())
    assert closed("- move: {id: a, along_m: 9, close_street: true}\n- stop: {id: a, at_s: 0.5}") == {"a"}
    assert closed("- move: {id: a, along_m: 9}\n- stop: {id: a, at_s: 0.5, close_street: false}") == set()
    assert closed("- move: {id: ego, left_m: 1}") == set()
    assert closed("- move: {id: a, left_m: 0, close_street: true}") == set()  # nobody has left


def test_sky_that_the_car_always_hid_continues_the_sky_that_was_seen() -> None:
    actor, views = lead()
    low = (geometry.from_rotation_translation(FORWARD, (v.center_world[0], 0, 0.5)) for v in views)
    views = [View(CAMERA, pose, v.time_s) for pose, v in zip(low, views, strict=True)]
    model = replace(street(actor), sky=SkyNode.uniform(64, (0.5, 0.6, 0.9)))
    with torch.no_grad():
        model.sky.table["panorama"][:, :, 30:32, 62:66] = 0.0  # ahead, up to 6 degrees above the horizon
        model.sky.table["panorama"][:, :, :20] = 0.2
    made = cleared(model, actor, views)
    assert not made.sky.table.labels
    found, before = made.sky.table["panorama"].detach(), model.sky.table["panorama"].detach()
    assert torch.allclose(found[0, :, 30:32, 62:66], torch.tensor([0.5, 0.6, 0.9])[:, None, None].expand(3, 2, 4))
    assert torch.equal(found[:, :, :29], before[:, :, :29])


def test_a_scene_without_ground_or_views_stays() -> None:
    actor, views = lead()
    for road, seen in ((np.zeros((4, 3)), views), (ROAD, [])):
        hidden = {"car": hidden_by(actor, seen)}
        model = noted(street(actor, road=road), seen)
        made = without_traces(model, hidden, seen)
        assert len(made.table) == len(model.table) and torch.equal(made.table["sh_dc"], model.table["sh_dc"])
    assert isinstance(hidden_by(actor, []), Hidden)


# -- flanks -----------------------------------------------------------------------------------------

NARROW = (4.0, 1.8, 1.5)
TIMES = np.arange(4) / 3
POSES = np.stack([geometry.yaw_matrix(0.0, (8 + t, 0, 0.75)) for t in TIMES])
ACTOR = Actor("car", NARROW, Motion.recorded(TIMES, POSES))
VIEWS = [View(CAMERA, geometry.from_rotation_translation(FORWARD, (t, 0, 1.2)), float(t)) for t in TIMES]


def behind(label: str = "car", flank: float | None = None) -> SceneModel:
    """The rear of a vehicle, red below and blue above; with its left flank (y = ``flank``) where that is given."""
    means = grid((-1.95, -1.94, 0.08), (-0.88, 0.9, 0.08), (-0.7, 0.75, 0.08))
    if flank is not None:
        means = np.concatenate([means, grid((-1.95, 2, 0.08), (flank, flank + 0.01, 0.08), (-0.7, 0.75, 0.08))])
    colors = np.where(means[:, 2:] < 0, [0.8, 0.1, 0.1], [0.1, 0.1, 0.8])
    every = np.ones(len(means), int)
    node = RigidNode("car", label, list(NARROW), ACTOR.motion.times_s, ACTOR.motion.poses)
    return fitted(means, colors, 2 * every, every, node, np.array([0.02, 0.05, 0.05]))


def made_sides(before: SceneModel, after: SceneModel) -> tuple[np.ndarray, np.ndarray]:
    """Places and colours of the new rows, which are those of certainty 0."""
    new = (after.certainty == 0).numpy()
    assert new.sum() == len(after.table) - len(before.table)
    for name, value in before.table.columns.items():
        assert torch.equal(after.table[name][~torch.from_numpy(new)], value)
    return after.table["means"].detach().numpy()[new], 0.5 + SH_C0 * after.table["sh_dc"].detach().numpy()[new, 0]


def test_flanks_continue_the_colours_of_the_rear() -> None:
    model = behind()
    places, colors = made_sides(model, with_closed_sides(model, ["car"], VIEWS))
    assert set(np.sign(places[:, 1])) == {-1.0, 1.0} and np.abs(places[:, 1]).max() <= NARROW[1] / 2
    assert places[:, 0].min() < -1.6 and places[:, 0].max() > 1.8
    low, high = places[:, 2] < -0.2, places[:, 2] > 0.2
    assert low.any() and high.any()
    for part, color in ((low, [0.8, 0.1, 0.1]), (high, [0.1, 0.1, 0.8])):
        assert np.allclose(colors[part], color, atol=1e-3)
    assert np.abs(places[high, 0]).max() < places[low, 0].max()  # a car is shorter above


def test_only_gaps_of_vehicles_are_closed() -> None:
    model = behind(flank=0.84)
    places, _ = made_sides(model, with_closed_sides(model, ["car"], VIEWS))
    assert len(places) and (places[:, 1] < 0).all()  # the left flank is there
    person = behind("pedestrian")
    assert with_closed_sides(person, ["car"], VIEWS) is person


def test_what_views_show_is_not_made_up() -> None:
    turn, model = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), behind()
    poses = [geometry.from_rotation_translation(turn, (8 + t, -5, 0.8)) for t in TIMES]
    beside = [View(CAMERA, pose, float(t)) for pose, t in zip(poses, TIMES, strict=True)]

    def right(views: Sequence[View]) -> int:
        return int((made_sides(model, with_closed_sides(model, ["car"], views))[0][:, 1] < 0).sum())

    assert right([*VIEWS, *beside]) < 0.2 * right(VIEWS)  # the right flank was seen to be empty; measured: 0


AWAY = [View(CAMERA, geometry.yaw_matrix(0.0, (0, 2.0, 0)) @ view.world_from_cam, view.time_s) for view in VIEWS]


@pytest.mark.parametrize(
    ("text", "views", "closed"),
    [
        *(("- move: {id: car, left_m: 2}", VIEWS, True), ("- move: {id: car, yaw_deg: 10}", VIEWS, True)),
        ("- move: {id: car, along_m: 3}", VIEWS, False),
        *(("- move: {id: ego, left_m: 2}", AWAY, True), ("- move: {id: ego, left_m: 2}", VIEWS, False)),
        ("- move: {id: ego, left_m: 2}\n- remove: {ids: [car]}", AWAY, False),
        ("- remove: {ids: [car]}", AWAY, False),
    ],
)
def test_only_what_is_seen_from_another_side_is_closed(text: str, views: list[View], closed: bool) -> None:
    """Of a vehicle that moves, and of one that another path shows."""
    ego = Motion.recorded(np.array(TIMES, float), np.stack([geometry.yaw_matrix(0.0)] * len(TIMES)))
    plan = plan_edits(parse_edits(text, "sides"), EditWorld({"car": ACTOR}, ego), lambda source: None)
    assert shown_sides(plan, VIEWS, views)[1] == ({"car"} if closed else set())


def test_an_asset_has_all_its_sides() -> None:
    model = behind()
    asset = complete_asset(model, "car", VIEWS)
    assert len(asset) > len(model.table) and asset.certainty is not None and (asset.certainty == 0).any()
    assert len(asset.seen_rad) == len(VIEWS)
    bare = complete_asset(replace(model, table=model.table), "car", [])
    assert len(bare) >= len(asset) and bare.seen_rad == ()
