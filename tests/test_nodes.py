"""Scene nodes: poses between keys, composing, the sky, saving; and the table they live in."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.palette import ID
from mudg.base.types import Camera, Track, View
from mudg.baselines.bezier import BezierNode
from mudg.core import harmonics, native_ops
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.core.table import Table
from mudg.gaussians import model as scene_model
from mudg.gaussians import nodes
from mudg.gaussians import start as initial
from mudg.gaussians.model import SceneModel, compose
from mudg.gaussians.nodes import NodeRows, RigidNode, SkyNode, StaticNode


def pose(x: float, y: float, z: float, yaw: float, pitch: float = 0.0) -> np.ndarray:
    tilt = np.array([[math.cos(pitch), 0, math.sin(pitch)], [0, 1, 0], [-math.sin(pitch), 0, math.cos(pitch)]])
    return geometry.yaw_matrix(yaw, (x, y, z)) @ geometry.from_rotation_translation(tilt, (0, 0, 0))


def track(name: str = "car", t0: float = 0.0) -> Track:
    keys = [pose(0, 0, 1, 0.1), pose(2, 0.5, 1, 0.6, 0.05), pose(5, 2, 1.2, 2.9), pose(6, 4, 1.2, -2.9)]
    return Track(name, "car", [4.0, 2.0, 1.5], t0 + np.array([0.0, 0.5, 1.0, 2.0]), np.stack(keys))


def columns(count: int, seed: int, degree: int = 0) -> dict[str, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logits": (), "sh_dc": (1, 3), "semantics": (3,)}
    if degree:
        shapes["sh_rest"] = ((degree + 1) ** 2 - 1, 3)
    made = {name: torch.randn(count, *shape, generator=g) for name, shape in shapes.items()}
    return made | {"log_scales": made["log_scales"] - 2}


def model(learn_poses: bool = False, degree: int = 0) -> SceneModel:
    parts = [columns(5, 1, degree=degree), columns(4, 2, degree=degree), columns(3, 3, degree=degree)]
    labels = {"node": torch.tensor([0] * 5 + [1] * 4 + [2] * 3, dtype=torch.int32)}
    table = Table({name: torch.cat([p[name] for p in parts]) for name in parts[0]}, labels)
    objects = (RigidNode.from_track(track("car"), learn_poses), RigidNode.from_track(track("van", 5.0), learn_poses))
    classes = (ID["road"], ID["sky"], ID["car"])
    return SceneModel(table, (StaticNode(), *objects), SkyNode.uniform(16), classes, degree, {"method": "test"})


# ---- poses ---------------------------------------------------------------------------------------


def pose_error(node: RigidNode, time_s: float, expected: np.ndarray) -> float:
    position, quat = (of.detach() for of in node.pose_at(time_s))
    found = np.column_stack([harmonics.rotation_matrix(quat).numpy(), position.numpy()])
    return np.abs(found - expected[:3]).max()


def test_pose_agrees_with_the_track_and_offsets_act_in_the_frame_of_the_box():
    """Torch and float64 numpy interpolate alike: at keys, between keys, across the -pi/pi seam of the last pair."""
    node = RigidNode.from_track(track())
    for time_s in (0.0, 0.2, 0.5, 0.77, 1.0, 1.5, 2.0):
        assert pose_error(node, time_s, track().pose_at(time_s)) < 1e-5, time_s
    assert [node.pose_at(outside) for outside in (-0.01, 2.01, 50.0)] == [None] * 3
    with torch.no_grad():
        node.offsets["shift"][1] = torch.tensor([1.0, 0.2, -0.1])
        node.offsets["yaw"][1] = 0.3
    expected = track().world_from_object[1] @ geometry.yaw_matrix(0.3, (1.0, 0.2, -0.1))
    assert pose_error(node, 0.5, expected) < 1e-5


def test_offsets_are_not_learnt_by_gradient_steps_and_moving_them_shows_at_once():
    scene = model(learn_poses=True)
    before = compose(scene, 0.3).means
    before.sum().backward()
    assert scene.nodes[1].offsets["shift"].grad is None
    assert list(scene.node_tables()) == ["sky"]
    scene.nodes[1].add_offsets(np.tile([0.5, 0.0, 0.0], (4, 1)), np.zeros(4))
    moved = (compose(scene, 0.3).means - before).detach()
    assert torch.allclose(moved[5:9].norm(dim=1), torch.full((4,), 0.5), atol=0.02)
    assert not moved[:5].any()


def test_slerp_gradient_is_finite_for_equal_rotations():
    """And is that of a weighted sum, to which the arc tends: 0.7 of what is at a right angle to the rotation."""
    q = torch.tensor([0.6, 0.0, 0.0, 0.8], requires_grad=True)
    mixed = harmonics.slerp(q, q.detach().clone(), 0.3)
    aside = torch.tensor([[0.8, 0.0, 0.0, -0.6], [0.0, 1.0, 0.0, 0.0]])
    for direction in aside:
        (gradient,) = torch.autograd.grad(mixed @ direction, q, retain_graph=True)
        assert torch.allclose(aside @ gradient, 0.7 * (aside @ direction), atol=1e-4)


# ---- composing -----------------------------------------------------------------------------------


def test_compose_places_objects_and_hides_absent_ones():
    scene = model()
    g, table = compose(scene, 0.3), scene.table
    assert torch.equal(g.means[:5], table["means"][:5])
    world = geometry.transform_points(track().pose_at(0.3), table["means"][5:9].detach().numpy())
    assert np.abs(g.means[5:9].detach().numpy() - world).max() < 1e-5
    assert torch.equal(g.opacity[:9], torch.sigmoid(table["logits"][:9]))
    turned = track().pose_at(0.3)[:3, :3] @ geometry.matrix_from_quaternion(table["quats"][6].detach().numpy())
    assert np.abs(geometry.matrix_from_quaternion(g.quats[6].detach().numpy()) - turned).max() < 1e-5
    assert (g.opacity[9:] == 0).all()  # the van's track begins at 5 s
    assert torch.equal(g.scales, torch.exp(table["log_scales"]))
    assert g.node.tolist() == [0] * 5 + [1] * 4 + [2] * 3
    later = compose(scene, 5.3).opacity
    assert (later[5:9] == 0).all() and (later[9:] > 0).all()


def test_gradients_reach_every_column_of_present_rows():
    scene = model(degree=1)
    g = compose(scene, 0.3)
    sum(x.square().sum() for x in (g.means, g.quats, g.scales, g.opacity, g.sh, g.sh_rest, g.extra)).backward()
    for name, gradient in scene.table.gradients().items():
        assert (gradient[:9].flatten(1).abs().sum(1) if gradient.ndim > 1 else gradient[:9].abs()).min() > 0, name
    assert set(scene.table.gradients()) == set(scene.table.columns)
    assert (scene.table["logits"].grad[9:] == 0).all()


def test_removing_a_track_equals_composing_without_it():
    scene = model()
    edited = scene.without_nodes(["car"])
    assert edited.node_names() == ("van",)
    full, cut = compose(scene, 5.4), compose(edited, 5.4)
    keep = scene.table.labels["node"] != 1
    assert torch.equal(cut.means, full.means[keep])
    assert cut.node.tolist() == [0] * 5 + [1] * 3
    assert len(scene.table) == 12
    refused("no dynamic object 'tram'", scene.without_nodes, ["tram"], raises=UsageError)


# ---- sky -----------------------------------------------------------------------------------------


def looking(yaw: float, width: int = 40, height: int = 30) -> View:
    cam = Camera("c", width, height, 30.0, 30.0, width / 2, height / 2)
    return View(cam, geometry.yaw_matrix(yaw, (100.0, -50.0, 2.0)) @ geometry.invert(geometry.CAM_FROM_EGO_AXES), 0.0)


def sky_picture(sky: SkyNode, view: View) -> torch.Tensor:
    """The sky [3, H, W] where nothing covers it."""
    nothing = torch.zeros(3, view.camera.height, view.camera.width)
    return native_ops.over(nothing, nothing[:1], sky.coarse_picture(view))


@pytest.mark.parametrize("yaw", [0.0, 1.5, math.pi, -2.0])
def test_sky_shows_the_colour_of_the_direction(yaw):
    """Paint each texel with its own direction; every pixel must then show its own ray, also across the seam at pi."""
    sky = SkyNode.uniform(90)
    rows, cols = 90, 180
    elevation = math.pi / 2 - (np.arange(rows) + 0.5) * math.pi / rows
    longitude = -math.pi + (np.arange(cols) + 0.5) * 2 * math.pi / cols
    level, up = np.cos(elevation)[:, None], np.repeat(np.sin(elevation)[:, None], cols, 1)
    painted = np.stack([level * np.cos(longitude), level * np.sin(longitude), up])
    sky.table.columns["panorama"].detach().copy_(torch.from_numpy(painted).float()[None])
    view = looking(yaw)
    shown = sky_picture(sky, view).detach().numpy()
    u, v = np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5)
    rays = np.stack([(u - 20) / 30, (v - 15) / 30, np.ones_like(u)], -1) @ view.world_from_cam[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    assert np.abs(shown.transpose(1, 2, 0) - rays).max() < 0.03


def test_sky_filled_from_measured_colours():
    sky = SkyNode.uniform(32)
    generator = np.random.Generator(np.random.PCG64(0))
    directions = generator.normal(size=(4000, 3))
    directions[:, 2] = np.abs(directions[:, 2])
    red = directions[:, 1] > 0
    sky.fill([(directions, np.where(red[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]).astype(np.float32))])
    left, right = sky_picture(sky, looking(math.pi / 2)), sky_picture(sky, looking(-math.pi / 2))
    assert left[0, 5, 20] > 0.95 and right[2, 5, 20] > 0.95


def test_semantics_of_uncovered_pixels_are_sky():
    scene = model()
    logits = torch.zeros(3, 2, 2)
    logits[0] = 3.0
    alpha = torch.tensor([[[1.0, 0.0], [0.9, 0.1]]])
    channel = scene_model.composite_semantics(scene, logits, alpha).argmax(0)
    assert [[scene.classes[c] for c in row] for row in channel.tolist()] == [[ID["road"], ID["sky"]]] * 2


# ---- state ---------------------------------------------------------------------------------------


def test_state_round_trip_keeps_everything():
    scene = model(learn_poses=True, degree=1)
    with torch.no_grad():
        scene.nodes[1].offsets["shift"].fill_(0.05)
        scene.table.moment1["means"].fill_(0.5)
    again = SceneModel.from_state(*scene.state())
    for time_s in (0.3, 5.7):
        before, after = compose(scene, time_s), compose(again, time_s)
        for name in ("means", "quats", "scales", "opacity", "sh", "extra", "node"):
            assert torch.equal(getattr(before, name), getattr(after, name)), name
    assert torch.equal(sky_picture(scene.sky, looking(0.2)), sky_picture(again.sky, looking(0.2)))
    assert torch.equal(again.table.moment1["means"], scene.table.moment1["means"])
    assert again.nodes[1].learn_pose and again.facts == {"method": "test"}


@pytest.mark.parametrize(
    ("values", "groups", "words"),
    [
        ({"nodes": [{"kind": "ghost"}]}, {}, "unknown kind"),
        ({"classes": [0, 40, 1]}, {}, "does not exist"),
        ({"nodes": [{"kind": "static", "name": "background"}]}, {}, "belongs to no node"),
        ({}, {"partial.sh_time": torch.zeros(7, 4, 3)}, "not a tensor of a parameter table"),
    ],
)
def test_damaged_and_older_states_are_refused(values, groups, words):
    whole, tensors = model(degree=2).state()
    tensors["gaussians"] |= groups
    refused(words, SceneModel.from_state, {**whole, **values}, tensors)


# ---- the table -----------------------------------------------------------------------------------


def tagged_table(count: int = 6) -> Table:
    """Every column, moment and label of row i holds the number i."""
    number = torch.arange(count, dtype=torch.float32)
    times = lambda factor: {"a": factor * number, "b": factor * number[:, None].repeat(1, 3)}
    table = Table(times(1), {"node": torch.arange(count, dtype=torch.int32)})
    table.moment1, table.moment2 = times(10), times(100)
    return table


def rows_agree(table: Table) -> bool:
    tag = table.labels["node"].float()
    return all(
        torch.equal(x, f * (tag if x.ndim == 1 else tag[:, None].expand_as(x)))
        for f, group in ((1, table.columns), (10, table.moment1), (100, table.moment2))
        for x in group.values()
    )


@settings(max_examples=40)
@given(st.lists(st.integers(0, 5), max_size=12))
def test_take_moves_everything_together(rows):
    table = tagged_table()
    table.take(torch.tensor(rows, dtype=torch.long))
    assert table.labels["node"].tolist() == rows
    assert rows_agree(table)
    assert all(value.is_leaf and value.requires_grad for value in table.columns.values())


def test_append_gives_zero_moments_and_wants_every_column():
    table = tagged_table(2)
    labels = {"node": torch.tensor([7], dtype=torch.int32)}
    table.append({"a": torch.tensor([7.0]), "b": torch.full((1, 3), 7.0)}, labels)
    assert table["a"].tolist() == [0, 1, 7]
    assert table.moment1["a"].tolist() == [0, 10, 0]
    assert table.labels["node"].tolist() == [0, 1, 7]
    refused("fill every column", table.append, {"a": torch.tensor([7.0])}, labels)


# ---- starting values -----------------------------------------------------------------------------


def test_starting_points_are_one_a_cell_as_large_as_their_distance_and_on_the_box():
    xyz = np.array([[0.01, 0, 0], [0.02, 0, 0], [0.2, 0, 0], [-0.01, 0, 0]], np.float32)
    assert initial.voxel_filter(xyz, 0.1).tolist() == [0, 2, 3]
    mixed = initial.voxel_filter(np.repeat(xyz, 2, 0) + np.array([0, 50.0, 0]), np.array([0.1, 2.0] * 4))
    assert 3 < len(mixed) <= 6
    axis = np.arange(6) * 0.25
    grid = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3).astype(np.float32)
    assert initial.neighbour_scale(grid) == pytest.approx(0.25, abs=1e-5)
    xyz, rgb = initial.box_grid((4.0, 2.0, 1.5), (10, 20, 30))
    assert (np.abs(xyz) <= 0.5 * np.array([4.0, 2.0, 1.5])).all()
    assert (rgb == [10, 20, 30]).all()


def test_starting_columns_show_the_points_colours():
    xyz = np.random.Generator(np.random.PCG64(0)).normal(size=(50, 3)).astype(np.float32)
    rgb = np.random.Generator(np.random.PCG64(1)).integers(0, 256, (50, 3)).astype(np.uint8)
    points = initial.StartPoints(xyz, rgb, np.full(50, ID["car"], np.uint8), initial.neighbour_scale(xyz))
    made = points.columns((ID["road"], ID["car"]), 1)
    shown = made["sh_dc"][:, 0] * initial.SH_C0 + 0.5
    assert np.abs(shown.numpy() * 255 - rgb).max() < 1e-3
    assert (made["semantics"].argmax(1) == 1).all()
    assert torch.allclose(torch.sigmoid(made["logits"]), torch.tensor(0.1))
    assert made["sh_rest"].shape == (50, 3, 3)


# ---- noise of tracks -----------------------------------------------------------------------------


def wavy_track(noise_m: float, noise_rad: float = 0.0, keys: int = 40) -> tuple[Track, Track]:
    """A car that speeds up and bends away, exact and with noise on every key."""
    times = 0.1 * np.arange(keys)
    exact = np.stack([pose(5 * t + 0.4 * t * t, 0.2 * t * t, 1, 0.08 * t) for t in times])
    g = np.random.Generator(np.random.PCG64(3))
    moves = np.stack([geometry.yaw_matrix(noise_rad * g.normal(), noise_m * g.normal(size=3)) for _ in times])
    return Track("car", "car", [4, 2, 1.5], times, exact), Track("car", "car", [4, 2, 1.5], times, exact @ moves)


def key_error(node: RigidNode, exact: Track) -> float:
    return float(np.sqrt(((node.corrected_keys()[:, :3, 3] - exact.world_from_object[:, :3, 3]) ** 2).sum(1).mean()))


def test_smoothing_keeps_straight_motion_and_means_and_sharp_turns():
    times = np.array([0.0, 0.1, 0.35, 0.4, 1.0, 1.1])
    straight = np.column_stack([4 - 7 * times, 2 * times])
    assert np.abs(nodes.smoothed(times, straight, 0.1, 2.0) - straight).max() < 1e-9
    bumpy = straight + np.array([0.1, -0.1, 0.05, 0.0, -0.1, 0.05])[:, None]
    found = nodes.smoothed(times, bumpy, 0.1, 2.0)
    assert np.abs(found.mean(0) - bumpy.mean(0)).max() < 1e-9
    assert np.abs(nodes.smoothed(times, bumpy, 0.0, 2.0) - bumpy).max() == 0
    even = 0.1 * np.arange(30)
    corner = np.maximum(0, 1.5 * (even - 1.5))[:, None]  # a turn that begins all at once
    assert np.abs(nodes.smoothed(even, corner, 0.02, 0.3) - corner).max() < 0.03


@pytest.mark.parametrize("noise_m", [0.02, 0.1])
def test_the_track_betrays_its_noise(noise_m):
    _, noisy = wavy_track(noise_m, keys=200)
    assert nodes.key_noise(noisy.times_s, noisy.world_from_object[:, :3, 3]) == pytest.approx([noise_m] * 3, rel=0.35)
    exact, _ = wavy_track(0.0)
    assert nodes.key_noise(exact.times_s, exact.world_from_object[:, :3, 3]).max() < 0.005
    assert (nodes.key_noise(np.arange(5.0), np.ones((5, 2))) == 0).all()


def test_settling_removes_noise_and_leaves_a_clean_track_alone():
    exact, noisy = wavy_track(0.1, math.radians(1.0))
    node = RigidNode.from_track(noisy, learn_pose=True)
    before = key_error(node, exact)
    node.settle()
    assert key_error(node, exact) < 0.5 * before
    headings = np.array([geometry.yaw_of(p) for p in node.corrected_keys()])
    assert np.sqrt(((headings - 0.08 * exact.times_s) ** 2).mean()) < 0.6 * math.radians(1.0)
    clean = RigidNode.from_track(exact, learn_pose=True)
    clean.settle()
    assert key_error(clean, exact) < 0.002


# ---- deformable ----------------------------------------------------------------------------------


def walker() -> nodes.DeformableNode:
    keys = np.stack([pose(0.1 * n, 0, 0.9, 0.0) for n in range(5)])
    node = nodes.object_node(Track("p", "pedestrian", [0.8, 0.6, 1.8], 0.1 * np.arange(5), keys), deformable=True)
    assert isinstance(node, nodes.DeformableNode)
    return node


def test_only_those_with_limbs_deform():
    keys = np.stack([pose(0, 0, 0, 0), pose(1, 0, 0, 0)])
    for label, may, kind in (("car", True, "rigid"), ("cyclist", True, "deformable"), ("cyclist", False, "rigid")):
        assert nodes.object_node(Track("x", label, [1, 1, 1], [0.0, 1.0], keys), deformable=may).kind == kind


def test_an_undeformed_node_is_a_rigid_one():
    node, local = walker(), columns(6, 0)
    rigid = RigidNode(node.name, node.label, node.size_m, node.times_s, node.world_from_object)
    rows = NodeRows(local["means"], local["quats"], torch.sigmoid(local["logits"]), local["sh_dc"])
    mine, theirs = node.at_time(rows, 0.17), rigid.at_time(rows, 0.17)
    assert torch.equal(mine.means, theirs.means) and torch.equal(mine.quats, theirs.quats)
    assert mine.opacity is rows.opacity and mine.sh_dc is rows.sh_dc
    assert node.at_time(rows, 3.0) is None


def test_displacement_interpolates_the_grid_in_space_and_time():
    """Control points displaced by a linear function of their place displace every row by that function."""
    node = walker()
    up, across, along = node.offsets["deform"].shape[2:]
    axes = [torch.linspace(-0.5, 0.5, n) * s for n, s in zip((up, across, along), (1.8, 0.6, 0.8))]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    with torch.no_grad():
        for key in range(5):
            node.offsets["deform"][key] = key * torch.stack([0.1 * x + 0.2 * z, 0.3 * y, 0.05 + 0.0 * z])
    means = torch.tensor([[0.3, -0.2, 0.7], [-0.1, 0.05, -0.6], [0.0, 0.0, 0.0]])
    expected = torch.stack([0.1 * means[:, 0] + 0.2 * means[:, 2], 0.3 * means[:, 1], torch.full((3,), 0.05)], 1)
    assert torch.allclose(node.displacement(means, 0.2), 2 * expected, atol=1e-6)
    assert torch.allclose(node.displacement(means, 0.25), 2.5 * expected, atol=1e-6)
    beyond = node.displacement(torch.tensor([[5.0, 0.0, 0.0]]), 0.1)
    assert torch.allclose(beyond, node.displacement(torch.tensor([[0.4, 0.0, 0.0]]), 0.1), atol=1e-6)


def test_displacement_gradient_by_finite_differences():
    node = walker()
    shape = node.offsets["deform"].shape
    deform = 0.1 * torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def moved(control, means):
        node.offsets.columns["deform"] = torch.cat([control, deform[2:]])
        return node.displacement(means, 0.04)

    means = torch.tensor([[0.21, -0.12, 0.33], [-0.17, 0.07, -0.61]], dtype=torch.float64)
    assert torch.autograd.gradcheck(moved, [deform[:2].clone().requires_grad_(), means.requires_grad_()])


def test_deformation_settles_between_its_neighbours_and_poses_stay():
    node = walker()
    with torch.no_grad():
        node.offsets["deform"][2].fill_(1.0)
    node.after_step(1.0)
    deform = node.offsets["deform"]
    assert 0.2 < deform[2].mean().item() < 0.3 < deform[1].mean().item() < 0.4
    assert node.learnt is node.offsets and not node.offsets["shift"].any()


def test_columns_that_no_node_changes_are_passed_on_without_a_copy():
    scene = model()
    assert compose(scene, 0.3).sh is scene.table["sh_dc"]
    still = scene.without_nodes(["car", "van"])
    assert compose(still, 0.3).means is still.table["means"]


# ---- colours that depend on the direction of view ------------------------------------------------


@pytest.mark.parametrize("backend", ["auto", "torch"])
@pytest.mark.parametrize("kind", [RigidNode, nodes.DeformableNode, BezierNode])
def test_an_object_and_a_camera_that_turn_together_show_the_same_picture(backend: str, kind: type[RigidNode]) -> None:
    made = columns(40, 7, degree=3)
    made["means"] *= 0.5
    made["sh_rest"] *= 0.3
    extra = {"curve": torch.zeros(40, 4, 3)} if kind is BezierNode else {}

    def picture(place: np.ndarray) -> torch.Tensor:
        still = kind("car", "car", (4, 2, 1.5), np.array([0.0, 1.0]), np.stack([place, place]))
        table = Table({**made, **extra}, {"node": torch.ones(40, dtype=torch.int32)})
        scene = SceneModel(table, (StaticNode(), still), None, (0, 10, 13), 3, {})
        camera = Camera("front", 32, 24, 30.0, 30.0, 16.0, 12.0)
        behind = geometry.from_rotation_translation(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (-6, 0, 0.5))
        view = View(camera, place @ behind, 0.4)
        return rasterize(compose(scene, 0.4), view, RasterConfig(backend=backend)).rgb.detach()

    here, there = np.eye(4), pose(3, -2, 1, 2.1, 0.3)
    assert (picture(here) - picture(there)).abs().max() < 2e-4
