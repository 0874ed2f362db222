"""Edits of paths and of fitted scenes: exact where the answer is known."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pretend_device import pretend_device
from refusals import refused

from mudg import native
from mudg.base import geometry, store
from mudg.base.errors import UsageError
from mudg.base.palette import ID
from mudg.base.types import Camera, FusedCloud, PointCloud, Track, View
from mudg.baselines.bezier import BezierNode
from mudg.baselines.omnire import DeformedNode
from mudg.city.config import CityConfig
from mudg.city.world import CityWorld
from mudg.core import edit
from mudg.core.edit import Displacement, HeightMap, Motion
from mudg.core.raster.rasterize import RasterConfig
from mudg.core.table import Table
from mudg.editing import apply as assets
from mudg.editing import model as edited
from mudg.editing.apply import carry_out, edited_cloud, edited_model, surface_light, take_light
from mudg.editing.plan import Actor, EditPlan, EditWorld, collisions, plan_edits
from mudg.editing.script import parse_edits, read_edits
from mudg.gaussians.model import CERTAINTY, SceneModel, compose
from mudg.gaussians.nodes import DeformableNode, RigidNode, SkyNode, StaticNode
from mudg.gaussians.rendering import render_view
from mudg.gaussians.start import SH_C0
from mudg.steps.settings import DEMO_CITY

SIZE = (4.0, 2.0, 1.5)


def straight(
    speed: float = 10.0, seconds: float = 4.0, rate: float = 10.0, y: float = 0.0, start: float = 0.0
) -> Motion:
    """Along x, box centre 0.75 m above z = 0."""
    times = np.arange(round(seconds * rate) + 1) / rate
    return Motion.recorded(times, np.stack([geometry.yaw_matrix(0.0, (start + speed * t, y, 0.75)) for t in times]))


def slope(rise: float = 0.1) -> HeightMap:
    """Ground that rises to the left, z = rise * y."""
    x, y = np.meshgrid(np.arange(-10, 80, 0.25), np.arange(-12, 12, 0.25), indexing="ij")
    return HeightMap.from_points(np.stack([x, y, rise * y], -1).reshape(-1, 3))


# -- paths -----------------------------------------------------------------------------------------


def test_a_displacement_is_exact_and_comes_about_within_its_ramp() -> None:
    motion, by = straight(), Displacement(3.0, -1.0, 0.5, 0.3)
    made = edit.moved(motion, by)
    assert np.array_equal(made.poses, motion.poses @ geometry.yaw_matrix(0.3, (3.0, -1.0, 0.5)))
    assert made.times_s is motion.times_s
    made = edit.moved(straight(speed=0.0), Displacement(ahead_m=2.0, from_s=1.0, ramp_s=2.0))
    x = lambda t: made.pose_at(t)[0, 3]
    assert x(0.99) == pytest.approx(0.0, abs=1e-12)
    assert x(2.0) == pytest.approx(1.0)  # half of the way at half of the time
    assert x(3.0) == pytest.approx(2.0)
    assert x(4.0) == pytest.approx(2.0)


@given(st.floats(-4, 4).filter(lambda d: abs(d) > 0.1), st.floats(1.5, 3.0))
def test_a_lane_change_is_the_quintic_and_its_acceleration_the_known_one(left_m: float, duration_s: float) -> None:
    made = edit.lane_changed(straight(), left_m, 0.5, duration_s)
    s = np.clip((made.times_s - 0.5) / duration_s, 0, 1)
    assert np.allclose(made.poses[:, 1, 3], left_m * (10 * s**3 - 15 * s**4 + 6 * s**5), atol=1e-9)
    assert np.allclose(made.poses[:, 0, 3], 10 * made.times_s, atol=1e-9)
    heading = np.arctan2(made.poses[:, 1, 0], made.poses[:, 0, 0])
    rate = left_m / duration_s * 30 * s**2 * (1 - s) ** 2
    assert np.allclose(heading, np.arctan2(rate, 10.0), atol=1e-6)  # looks where it goes
    fine = np.linspace(0, 1, 20001)
    peak = np.abs(np.gradient(np.gradient(left_m * edit.quintic(fine), fine), fine))[5:-5].max() / duration_s**2
    assert peak == pytest.approx(edit.QUINTIC_PEAK * abs(left_m) / duration_s**2, rel=1e-3)


def test_a_lane_change_follows_the_ground() -> None:
    made = edit.lane_changed(straight(), 3.0, 0.5, 2.0, slope(0.1))
    assert made.poses[-1, 2, 3] == pytest.approx(0.75 + 0.3, abs=0.01)
    moved = edit.moved(straight(), Displacement(left_m=3.0), slope(0.1))
    assert np.allclose(moved.poses[:, 2, 3], 1.05, atol=0.01)
    assert np.allclose(moved.poses[:, :3, :3], np.eye(3), atol=1e-6)  # the slope is the same there
    for pose in made.poses:
        assert geometry.rigid_problem(pose) is None


def test_braking_takes_the_way_and_the_time_that_physics_says() -> None:
    made = edit.stopped(straight(speed=8.0), 1.0, 4.0)
    x = lambda t: made.pose_at(t)[0, 3]
    assert x(1.0) == pytest.approx(8.0)
    assert x(2.0) == pytest.approx(8.0 + 8.0 - 2.0, abs=0.01)
    assert x(3.0) == pytest.approx(8.0 + 8.0, abs=0.01)  # v^2 / 2a = 8 m, 2 s
    assert x(4.0) == x(3.0)
    assert np.all(np.diff(made.source_s) >= -1e-9)
    short = edit.stopped(straight(speed=8.0), 3.5, 4.0)
    assert np.all(short.poses[:, 0, 3] <= straight(speed=8.0).at(short.times_s).poses[:, 0, 3] + 1e-9)


@given(st.floats(0.2, 3.0), st.floats(0.0, 3.0))
def test_speed_scales_the_way(factor: float, from_s: float) -> None:
    made = edit.sped(straight(), factor, from_s)
    expected = np.where(made.times_s < from_s, 10 * made.times_s, 10 * (from_s + factor * (made.times_s - from_s)))
    assert np.allclose(made.poses[:, 0, 3], expected, atol=1e-6)  # past its end it goes on straight


def test_a_path_goes_through_its_points_and_looks_along() -> None:
    points = np.array([[0.0, 0, 0, np.nan], [1.0, 5, 0, np.nan], [2.0, 10, 3, np.nan]])
    made = edit.along_points(points, 0.75, slope(0.1))
    for t, x, y, _ in points:
        pose = made.pose_at(t)
        assert np.allclose(pose[:3, 3], [x, y, 0.75 + 0.1 * y], atol=0.02)
    assert geometry.yaw_of(made.poses[0]) == pytest.approx(0.0, abs=0.05)
    normal = np.array([0, -0.1, 1]) / math.hypot(0.1, 1)
    assert np.allclose(made.poses[3, :3, 2], normal, atol=0.01)  # upright on the slope


def test_the_ground_is_the_median_and_unknown_far_away() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 20, (40_000, 2))
    z = 0.05 * xy[:, 0] + np.where(rng.random(len(xy)) < 0.1, 1.5, 0.0)  # a tenth of the points lies on cars
    ground = HeightMap.from_points(np.column_stack([xy, z]))
    inside = rng.uniform(2, 18, (200, 2))
    assert np.abs(ground.height(inside) - 0.05 * inside[:, 0]).max() < 0.05
    assert np.isnan(ground.height(np.array([[40.0, 5.0]]))).all()
    refused("no ground", HeightMap.from_points, np.zeros((0, 3)))


@given(st.floats(-math.pi, math.pi), st.floats(-3, 3), st.floats(-3, 3))
def test_overlap_of_boxes_agrees_with_points(yaw: float, x: float, y: float) -> None:
    a, b = np.eye(4)[None], geometry.yaw_matrix(yaw, (x, y, 0.2))[None]
    grid = np.stack(np.meshgrid(*(np.linspace(-s / 2, s / 2, 25) for s in SIZE), indexing="ij"), -1).reshape(-1, 3)
    inside = (np.abs(geometry.transform_points(b[0], grid)) <= np.array(SIZE) / 2).all(1).any()
    depth = edit.overlap_m(a, SIZE, b, SIZE)[0]
    if inside:
        assert depth >= -1e-9
    elif depth > 0.5:
        raise AssertionError("no point of the grid lies in both, but the overlap is deep")


def test_angles_wrap_around() -> None:
    assert edit.angle_to_nearest(np.array([math.pi - 0.1]), np.array([-math.pi + 0.1]))[0] == pytest.approx(0.2)
    assert edit.angle_to_nearest(np.zeros(1), np.zeros(0))[0] == math.pi
    assert edit.azimuths(geometry.yaw_matrix(math.pi / 2)[None], np.array([[0.0, 5, 0]]))[0] == pytest.approx(0.0)


# -- fitted scenes ---------------------------------------------------------------------------------


def gaussians(
    count: int, seed: int, center: tuple[float, float, float], spread: float, train_id: int
) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    logits = torch.full((count, 3), -5.0)
    logits[:, (ID["road"], ID["sky"], ID["car"]).index(train_id)] = 5.0
    return {
        "means": torch.randn(count, 3, generator=g) * spread + torch.tensor(center),
        "quats": torch.randn(count, 4, generator=g),
        "log_scales": torch.randn(count, 3, generator=g) * 0.2 - 1.5,
        "logits": torch.full((count,), 2.0),
        "sh_dc": torch.randn(count, 1, 3, generator=g),
        "semantics": logits,
    }


def toy(kind: type[RigidNode] = RigidNode) -> SceneModel:
    """Ground, a parked car at (12, -4), a car that drives along x."""
    g = torch.Generator().manual_seed(9)
    ground = gaussians(600, 1, (10, 0, 0), 0.0, ID["road"])
    ground["means"] = torch.rand(600, 3, generator=g) * torch.tensor([40.0, 16.0, 0.0]) - torch.tensor([5.0, 8.0, 0.0])
    ground["sh_dc"][:] = (0.4 - 0.5) / SH_C0
    parts = [ground, gaussians(40, 2, (12, -4, 0.8), 0.3, ID["car"]), gaussians(50, 3, (0, 0, 0), 0.4, ID["car"])]
    owner = torch.tensor([0] * 640 + [1] * 50, dtype=torch.int32)
    table = Table(
        {name: torch.cat([p[name] for p in parts]) for name in parts[0]},
        {"node": owner, CERTAINTY: torch.full((690,), 0.5, dtype=torch.float16)},
    )
    motion = straight(5.0, 2.0, start=8.0)
    node = kind("car-1", "car", SIZE, motion.times_s, motion.poses)
    return SceneModel(
        table, (StaticNode(), node), SkyNode.uniform(16), (ID["road"], ID["sky"], ID["car"]), 0, {"method": "test"}
    )


def view(time_s: float = 0.5) -> View:
    mount = geometry.yaw_matrix(0.0, (0.0, 0.0, 1.5)) @ geometry.invert(geometry.CAM_FROM_EGO_AXES)
    return View(Camera("front", 64, 48, 50.0, 50.0, 32.0, 24.0), mount, time_s)


def picture(model: SceneModel, time_s: float = 0.5) -> torch.Tensor:
    return render_view(model, view(time_s), RasterConfig(backend="torch")).rgb


def parked() -> Track:
    times = np.array([0.0, 2.0])
    return Track("parked-1", "car", np.array(SIZE), times, np.stack([geometry.yaw_matrix(0.0, (12, -4, 0.75))] * 2))


def world_of(model: SceneModel) -> EditWorld:
    """The model's objects, the parked car and a vehicle that stands at the origin."""
    world = EditWorld.of_model(model, None)
    track = parked()
    other = Actor(track.label, SIZE, Motion.recorded(track.times_s, track.world_from_object))
    ego = Motion.recorded([0.0, 2.0], np.stack([np.eye(4)] * 2))
    return EditWorld({**world.actors, track.id: other}, ego, None)


def planned(text: str, world: EditWorld, opened=lambda source: None) -> EditPlan:
    return plan_edits(parse_edits(text, "edits.yaml"), world, opened)


def carried(model: SceneModel, text: str, opened=lambda source: None) -> SceneModel:
    return edited_model(model, planned(text, world_of(model), opened))


@pytest.mark.parametrize(
    "text",
    [
        "- move: {id: car-1, along_m: 2, left_m: 1, yaw_deg: 20, ground: false}",
        "- lane_change: {id: car-1, left_m: 2, start_s: 0.2, duration_s: 1.8, ground: false}",
        "- stop: {id: car-1, at_s: 0.3}",
        "- speed: {id: car-1, factor: 0.5}",
    ],
)
def test_an_edited_object_renders_as_one_fitted_to_the_edited_track(text: str) -> None:
    model = toy()
    plan = planned(text, world_of(model))
    actor = plan.after.actors["car-1"]
    track = Track("car-1", "car", np.array(SIZE), actor.motion.times_s, actor.motion.poses)
    refitted = SceneModel(model.table, (StaticNode(), RigidNode.from_track(track)), model.sky, model.classes, 0, {})
    made = edited_model(model, plan)
    assert torch.equal(picture(made), picture(refitted))
    assert not torch.equal(picture(made), picture(model))
    assert torch.equal(picture(model), picture(toy()))  # the original stays


def test_removing_an_object_leaves_the_picture_without_it() -> None:
    model = toy()
    made = carried(model, "- remove: {ids: [car-1]}")
    rows = model.table.labels["node"] == 0
    labels = {k: v[rows] for k, v in model.table.labels.items()}
    bare = Table({k: v.detach()[rows] for k, v in model.table.columns.items()}, labels)
    alone = SceneModel(bare, (StaticNode(),), model.sky, model.classes, 0, {})
    assert torch.equal(picture(made), picture(alone))
    assert made.node_names() == ()


def test_parts_of_the_street_are_erased_and_objects_stay() -> None:
    """Counted by plain arithmetic: balls take what lies in them, a box turned by 90 degrees what lies outside of it."""
    model = toy()
    means, street = model.table["means"].detach().double().numpy(), model.table.labels["node"].numpy() == 0
    near = [np.linalg.norm(means - place, axis=1) <= radius for place, radius in (((12, -4, 0.8), 1.0), ((3, 0, 0), 2))]
    made = carried(model, "- erase: {balls: [[12, -4, 0.8, 1.0], [3, 0, 0, 2]]}")
    assert len(made.table) == len(model.table) - int((street & (near[0] | near[1])).sum()) < len(model.table) - 40
    assert int((made.table.labels["node"] == 1).sum()) == 50, "the moving car is no part of the street"
    box = "- erase: {keep: {center: [5, 2, 0], size_m: [6, 20, 4], yaw_deg: 90}}"
    inside = (np.abs(means[:, 0] - 5) <= 10) & (np.abs(means[:, 1] - 2) <= 3) & (np.abs(means[:, 2]) <= 2)
    made = carried(model, box)
    assert len(made.table) == int((~street | inside).sum()) < len(model.table)
    xyz = means[street].astype(np.float32)
    cloud = FusedCloud(PointCloud(xyz, np.zeros((len(xyz), 3), np.uint8), "world"), {}, "images")
    left = edited_cloud(cloud, planned(box, world_of(model))).static
    assert np.array_equal(left.xyz, xyz[inside[street]])


def test_objects_are_chosen_by_kind() -> None:
    model = toy()
    assert carried(model, "- remove: {class: car, moving: true}").node_names() == ()
    near = planned("- remove: {within_m: 11}", world_of(model))
    assert near.removed == ["car-1"]  # its first place is 8 m away, the parked car 12.6 m
    problem = refused("no object is of this kind", carried, model, "- remove: {class: tram}")
    assert "line 1: remove" in problem.where


def test_a_parked_car_is_cut_out_of_the_background() -> None:
    model = toy()
    cut = edited.cut_out(model, parked())
    assert cut.node_names() == ("car-1", "parked-1")
    assert cut.counts() == [600, 50, 40]
    assert (picture(cut) - picture(model)).abs().max() < 1e-4  # cutting changes nothing
    gone = carried(model, "- remove: {ids: [parked-1]}")
    assert len(gone.table) == 650
    moved = carried(model, "- move: {id: parked-1, along_m: 3, ground: false}")
    rows = moved.table.labels["node"] == 2
    assert moved.dynamic_object("parked-1").pose_matrix(0.5)[0, 3] == pytest.approx(15.0)
    assert int(rows.sum()) > 40  # with its contact shadow
    world = world_of(model)
    others = {"far": Actor("car", SIZE, straight(0.0, 2.0, start=90.0)), "way": Actor("car", SIZE, straight(9.0))}
    hidden = EditWorld({**world.actors, **others}, world.ego)
    for name in ("far", "way"):  # the fit shows neither of them
        plan = planned(f"- remove: {{ids: [{name}]}}", hidden)
        assert torch.equal(picture(edited_model(model, plan)), picture(model))
        plan = planned(f"- move: {{id: {name}, along_m: 1, ground: false}}", hidden)
        refused(name, edited_model, model, plan, raises=UsageError)
    empty = replace(parked(), world_from_object=parked().world_from_object @ geometry.yaw_matrix(0, (0, 0, 50)))
    refused("nothing of the fitted background", edited.cut_out, model, empty, raises=UsageError)


def test_what_deforms_shows_the_moments_of_its_path_and_as_an_asset_its_middle() -> None:
    model = toy(DeformableNode)
    node = model.dynamic_object("car-1")
    with torch.no_grad():
        node.offsets["deform"].copy_(torch.arange(21.0).view(21, 1, 1, 1, 1).expand_as(node.offsets["deform"]) * 0.01)
    made = carried(model, "- speed: {id: car-1, factor: 0.5}").dynamic_object("car-1")
    at = torch.zeros(1, 3)
    assert torch.allclose(made.displacement(at, 1.0), node.displacement(at, 0.5), atol=1e-6)
    still = carried(model, "- stop: {id: car-1, at_s: 0.3, brake_m_s2: 10}").dynamic_object("car-1")
    assert torch.equal(still.displacement(at, 1.5), still.displacement(at, 2.0))
    rows = model.table["means"].detach()[640:]
    asset = edited.asset_of(model, "car-1")
    middle = float(node.times_s[10])
    assert torch.allclose(asset.columns["means"], rows + node.displacement(rows, middle), atol=1e-5)
    again = edited.with_asset(model.without_nodes(["car-1"]), asset, "car-1", edited.motion_of(node))
    assert (picture(again, middle) - picture(model, middle)).abs().max() < 1e-4


def test_objects_of_other_methods_are_edited_or_refused() -> None:
    curved = toy(BezierNode)
    columns = {name: value.detach() for name, value in curved.table.columns.items()}
    curved = replace(curved, table=Table({**columns, "curve": torch.zeros(690, 4, 3)}, curved.table.labels))
    refused("curves", carried, curved, "- stop: {id: car-1, at_s: 0.5}")
    assert carried(curved, "- remove: {ids: [car-1]}").node_names() == ()
    asset = edited.asset_of(curved, "car-1")
    assert len(carried(curved, "- replace: {id: car-1, by: {file: a}}", lambda source: asset).table) == 690
    deformed = toy(DeformedNode)
    deformed.dynamic_object("car-1").instance = 3
    assert carried(deformed, "- stop: {id: car-1, at_s: 0.5}").dynamic_object("car-1").instance == 3


def test_an_asset_goes_through_its_file_and_renders_as_the_object_did(tmp_path: Path) -> None:
    model = toy()
    asset = edited.asset_of(model, "car-1", [0.5, 3.0])
    assets.write_asset(tmp_path / "car.safetensors", asset)
    read = assets.read_asset(tmp_path / "car.safetensors")
    assert (read.label, read.size_m, len(read), read.origin) == ("car", SIZE, 50, "a scene: car-1")
    assert read.seen_rad == pytest.approx((0.5, 3.0), abs=1e-3)
    assert np.allclose(read.certainty, 0.5)
    bare = model.without_nodes(["car-1"])
    again = edited.with_asset(bare, read, "car-1", edited.motion_of(model.dynamic_object("car-1")))
    assert (picture(again) - picture(model)).abs().max() < 1e-6
    refused("already", edited.with_asset, model, read, "car-1", straight(), raises=UsageError)


def test_what_is_no_asset_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "x.safetensors"
    store.write_safetensors(file, {"means": np.zeros((3, 3), np.float32)})
    refused("no asset", assets.read_asset, file)
    assets.write_asset(file, edited.asset_of(toy(), "car-1"))
    tensors = store.read_safetensors(file)
    store.atomic_write(file, store.read_bytes(file)[:-8])
    refused("safetensors", assets.read_asset, file)
    store.write_safetensors(file, tensors, {assets.HEADER: '{"schema": 7}'})
    refused("schema", assets.read_asset, file)


def test_the_light_of_surfaces_is_that_of_the_pixels_that_show_them() -> None:
    """Ground of two greys under a white sky, which must not count."""
    model = toy()
    with torch.no_grad():
        model.sky.table["panorama"].fill_(1.0)
        model.table["sh_dc"].fill_((0.2 - 0.5) / SH_C0)
    seen = surface_light(model, [view(t) for t in (0.2, 0.9)])
    observed = render_view(model, view(0.2), RasterConfig(backend="torch"))
    assert 0.1 < (observed.depth > 0).float().mean() < 0.9
    surface = edited.linear_of(np.array(0.2))
    assert surface * 0.98 < seen.min() and seen.max() < surface + 0.5 * (1 - surface)  # edges blend with the sky
    assert surface_light(model, []) is None


def test_objects_take_the_light_of_another_street() -> None:
    """Gaussians and fused points alike; what asks to stay stays."""
    model, dim = toy(), toy()
    with torch.no_grad():
        dim.table["sh_dc"][dim.table.labels["node"] == 0] = (0.2 - 0.5) / SH_C0
    here, there = (surface_light(scene, [view()]) for scene in (model, dim))
    gain = edited.light_gain(here, there)
    assert gain.max() < 0.9
    asset = edited.asset_of(model, "car-1", light_rgb=here)
    empty = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), "world")
    place = "id: new, asset: {file: x.safetensors}, path: [[0, 20, 3, 0]], shadow: 0"

    def light_of(more: str) -> list[float]:
        plan = planned(f"- insert: {{{place}{more}}}", world_of(dim), lambda source: asset)
        plan.views = (view(),)
        take_light(plan, dim)
        assert not plan.notes
        made, points = edited_model(dim, plan), edited_cloud(FusedCloud(empty, {}), plan).objects["new"].rgb / 255
        rows = made.table.labels["node"] == made.nodes.index(made.dynamic_object("new"))
        colors = 0.5 + SH_C0 * made.table["sh_dc"].detach()[rows].double().numpy()
        return [float(edited.linear_of(shown.clip(0)).mean()) for shown in (colors, points)]

    plain, full = light_of(", match_light: false"), light_of("")
    assert full[0] / plain[0] == pytest.approx(gain[0], rel=0.02)
    assert full[1] / plain[1] == pytest.approx(gain[0], rel=0.05)
    blind = planned(f"- insert: {{{place}}}", world_of(model), lambda source: asset)
    take_light(blind, model)
    assert [note["ids"] for note in blind.notes] == [["new"]]
    assert torch.allclose(blind.inserted["new"].asset.columns["sh_dc"], asset.columns["sh_dc"], atol=1e-5)


def test_a_contact_shadow_darkens_the_ground_by_its_strength() -> None:
    """A sheet of ground seen from above through the shadow of a box that is not drawn itself."""
    model = toy()
    with torch.no_grad():
        model.table["logits"][600:] = -20.0  # the cars themselves do not show
        model.table["log_scales"][:600] = math.log(1.0)
    shaded = edited.with_shadow(model, "car-1", 0.6)
    down = np.array([[0.0, -1, 0, 10.5], [-1, 0, 0, 0], [0, 0, -1, 12.0], [0, 0, 0, 1]])
    above = View(Camera("top", 41, 41, 40.0, 40.0, 20.5, 20.5), down, 0.5)
    drawn = [render_view(m, above, RasterConfig(backend="torch")).rgb for m in (model, shaded)]
    ratio = (drawn[1] / drawn[0]).mean(0)
    assert ratio[20, 20] == pytest.approx(0.4 ** (1 / 2.2), abs=0.06)
    assert ratio[0, 0] == pytest.approx(1.0, abs=0.01)
    assert ratio.max() <= 1.01


def test_inserting_replacing_and_colliding() -> None:
    model = toy()
    asset = edited.asset_of(model, "car-1", [math.pi])
    text = """
- insert: {asset: {file: a}, id: new, near: {id: ego, ahead_m: 14, left_m: 3}, shadow: 0}
- replace: {id: car-1, by: {file: a}}
- insert: {asset: {file: a}, near: {id: car-1, ahead_m: 3}}
- move: {id: new, along_m: 1}
"""
    plan = planned(text, world_of(model), lambda source: asset)
    made = edited_model(model, plan)
    assert set(made.node_names()) == {"new", "car-1", "car-new1"}
    pose = made.dynamic_object("new").pose_matrix(1.0)
    assert np.allclose(pose[:3, 3], [15, 3, 0.75], atol=1e-6)  # wheels on the ground below the vehicle
    follower = made.dynamic_object("car-new1").pose_matrix(1.0)
    assert follower[0, 3] == pytest.approx(made.dynamic_object("car-1").pose_matrix(1.0)[0, 3] + 3, abs=0.01)
    (found,) = [c for c in collisions(plan) if set(c["ids"]) == {"car-1", "car-new1"}]
    assert found["overlap_m"] == pytest.approx(1.0, abs=0.02)  # 4 m long, 3 m apart
    assert torch.equal(made.table.labels["node"], made.table.labels["node"].sort().values)


def test_edits_on_another_device_are_the_same() -> None:
    text = """
- move: {id: parked-1, along_m: 3, ground: false}
- lane_change: {id: car-1, left_m: 1, start_s: 0.2, duration_s: 1.5, ground: false}
- insert: {asset: {file: a}, id: new, near: {id: ego, ahead_m: 14, left_m: 3}}
"""
    asset = edited.asset_of(toy(DeformableNode), "car-1")
    here = carried(toy(DeformableNode), text, lambda source: asset)
    with pretend_device() as there:
        model = toy(DeformableNode).to(there)
        made = carried(model, text, lambda source: asset)
        assert made.device == there
        back = made.to(torch.device("cpu"))
        other = edited.asset_of(model, "car-1")
    assert all(torch.equal(other.columns[name], value) for name, value in asset.columns.items())
    for name, value in here.table.columns.items():
        assert torch.equal(back.table[name], value), name
    assert torch.equal(picture(back), picture(here))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("- move: {id: car-2, along_m: 1}", "did you mean 'car-1'"),
        ("- lane_change: {id: car-1, left_m: 3.5, start_s: 0.1, duration_s: 1}", "too sharp"),
        ("- lane_change: {id: parked-1, left_m: 1, start_s: 0.5, duration_s: 2}", "only what drives"),
        ("- lane_change: {id: car-1, left_m: 1, start_s: 9, duration_s: 2}", "outside the path"),
        ("- stop: {id: car-1, at_s: 9}", "outside its path"),
        ("- remove: {ids: [car-1]}\n- stop: {id: car-1, at_s: 1}", "line 2: stop.id"),
        ("- erase: {}", "nothing says what to erase"),
        ("- erase: {balls: [[1, 2, 3]]}", "a ball is not described"),
        ("- erase: {balls: [[1, 2, 3, 0]]}", "a ball is not described"),
        ("- erase: {keep: {center: [0, 0], size_m: [1, 1, 1]}}", "center"),
    ],
)
def test_what_cannot_be_done_is_told_with_line_and_verb(text: str, said: str) -> None:
    problem = refused(re.escape(said), carried, toy(), text)
    assert problem.where.startswith("edits.yaml, line ")


def test_the_least_duration_of_a_lane_change_is_told_and_enough() -> None:
    sharp = "- lane_change: {id: car-1, left_m: 1.5, start_s: 0.1, duration_s: %s}"
    told = refused("too sharp", carried, toy(), sharp % 1).remedy
    carried(toy(), sharp % told.split("duration_s of ")[1].split()[0])


@pytest.mark.skipif(native.library() is None, reason="the city needs the native library")
def test_the_ready_scripts_fit_the_demo(repository: Path) -> None:
    """All that they name is in the city of ``mudg demo``, and possible there; the vehicle hits nothing."""
    scripts = sorted((repository / "docs" / "examples" / "edits").glob("*.yaml"))
    assert len(scripts) == 3
    city = CityWorld(CityConfig(seed=DEMO_CITY, n_frames=24))
    world = EditWorld.of_scene(SimpleNamespace(tracks=city.tracks(), ego=city.ego_path()), None)
    asset = edited.asset_of(toy(), "car-1")
    for path in scripts:
        plan = plan_edits(read_edits(path), world, lambda source: asset)
        assert plan.removed or plan.changes
        assert not [found for found in collisions(plan) if "ego" in found["ids"]]


def test_the_city_is_drawn_again_with_an_object_elsewhere() -> None:
    size = {"n_frames": 4, "width": 64, "height": 40}
    city = CityWorld(CityConfig(seed=DEMO_CITY, **size))
    frame = city.frame_views("front")[1]
    truth = city.render(frame)
    number = int(np.bincount(truth.instance.ravel())[1:].argmax()) + 1
    track = city.tracks()[number - 1]
    assert city.instance_of(track.id) == number
    assert not (city.rearranged({track.id: None}).render(frame).instance == number).any()
    poses = Motion.recorded(track.times_s, track.world_from_object).poses
    yaws = np.unwrap([geometry.yaw_of(pose) for pose in poses])
    keys = np.column_stack([poses[:, :2, 3], poses[:, 2, 3] - track.size_m[2] / 2, yaws])
    assert np.array_equal(city.rearranged({track.id: keys}).render(frame).rgb, truth.rgb)
    away = city.rearranged({track.id: keys + np.array([0, 0.5, 0, 0])}).render(frame)
    assert 0 < ((away.instance == number) ^ (truth.instance == number)).sum()
    assert np.array_equal(city.render(frame).rgb, truth.rgb)  # the city itself stays
    refused("no such object", city.rearranged, {"car-999": None}, raises=UsageError)


def test_scripts_run_on_a_fitted_scene_alone(tmp_path: Path) -> None:
    script = parse_edits("- stop: {id: car-1, at_s: 0.5}\n- weather: {wet: 0.5}", "e", tmp_path)
    drive = carry_out(script, toy())
    made = drive.model(toy())
    assert made.facts["edits"]["script"] == script.canonical()
    assert len(compose(made, 1.0)) == len(toy().table)
    refused("path of the vehicle is not known", carry_out, parse_edits("- stop: {id: ego, at_s: 0.5}", "e"), toy())
    columns = {name: value for name, value in toy().table.columns.items() if name != "semantics"}
    bare = replace(toy(), classes=(), table=Table(columns, toy().table.labels))
    refused("classes", carry_out, parse_edits("- weather: {wet: 0.5}", "e"), bare)
