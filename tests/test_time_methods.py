"""Methods whose Gaussians depend on time: their equations, and their fits end to end on a tiny exact street."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_settings import SMALL_RADIANCE, fit_to, fitted_bytes, interrupted, small_fit, written_street
from pretend_device import pretend_device
from refusals import refused
from toy_world import CAR_SIZE, camera, car_pose, truth, view_at, write_scene

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.palette import ID
from mudg.base.types import Track
from mudg.baselines import pvg
from mudg.baselines.bezier import BezierNode, bernstein, distance_change, fit_path
from mudg.baselines.omnire import DeformationField, DeformedNode, FlatNetwork, waves
from mudg.baselines.pvg import VibrationNode, starting_columns
from mudg.baselines.s3gaussian import HexPlaneNode, plane_smoothness
from mudg.core import losses, metrics
from mudg.core.grids import PlaneSizes
from mudg.core.raster.rasterize import RasterConfig
from mudg.core.table import Table
from mudg.gaussians import densify, fit, nodes
from mudg.gaussians.model import SceneModel, compose
from mudg.gaussians.nodes import NodeRows, RigidNode, StaticNode
from mudg.gaussians.recipes import RECIPES
from mudg.gaussians.settings import METHODS, PUBLISHED, WEIGHTS
from mudg.gaussians.start import StartPoints
from mudg.scene import fuse
from mudg.scene.clouds import read_fused
from mudg.scene.read import read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps import command
from mudg.steps.fit import Fit
from mudg.steps.ingest import Fuse

SIZE, FRAMES = (60, 40), 6
OWN = {
    "bezier": {"curve", "trajectory"},
    "omnire": {"network", "embeddings"},
    "pvg": {"tau", "log_beta", "velocity"},
    "s3gaussian": {"planes", "plane_network"},
}
BOX_FREE = [name for name in RECIPES if not METHODS[name].boxes]
MOVING = [name for name in RECIPES if name != "gs3d"]
FITTED_ALONE = [name for name, row in METHODS.items() if row.made_by == "render" and not row.learns_virtual]
"""Methods that are fitted to recorded views and nothing else."""
FITTED = {"gaussians", "nodes", "model", "field"}


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Path]:
    """A scene with a moving car, and what fusing gives."""
    return written_street(tmp_path_factory.mktemp("world"), SIZE, FRAMES, ())


@pytest.fixture(autouse=True)
def cars_that_walk(monkeypatch):
    """The one object of the toy street may deform, too."""
    monkeypatch.setattr(nodes, "LIMBED_LABELS", nodes.LIMBED_LABELS | {"car"})


def black_points(xyz: np.ndarray) -> dict[str, torch.Tensor]:
    black = np.zeros((len(xyz), 3), np.uint8)
    return StartPoints(xyz, black, black[:, 0], np.full(len(xyz), 0.1, np.float32)).columns((), 0)


def scene_of(columns: dict[str, torch.Tensor], *nodes: StaticNode | RigidNode, owner: int = 0) -> SceneModel:
    """A scene whose Gaussians all belong to one node."""
    labels = {"node": torch.full((len(columns["means"]),), owner, dtype=torch.int32)}
    return SceneModel(Table(columns, labels), nodes, None, (), 0)


# ---- vibration -----------------------------------------------------------------------------------


def vibrating(count: int = 5) -> NodeRows:
    g = torch.Generator().manual_seed(3)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    own = {"tau": 0.03 * drawn(count), "log_beta": -2.5 + 0.5 * drawn(count), "velocity": 20 * drawn(count, 3)}
    return NodeRows(drawn(count, 3), drawn(count, 4), torch.sigmoid(drawn(count)), drawn(count, 1, 3), own)


def test_vibration_agrees_with_a_plain_loop_and_its_slopes_with_differences():
    rows, node = vibrating(), VibrationNode("background", 1.0, 0.1).with_values(early=0.013)
    seen = node.at_time(rows, 1.2)
    for i in range(len(rows.means)):
        beta, since = math.exp(rows.own["log_beta"][i]), 0.04 - 0.013 - float(rows.own["tau"][i])
        factor = math.exp(-(since**2) / (2 * beta**2))
        shown = float(rows.opacity[i]) * (factor if factor > 0.05 else 0.0)
        assert float(seen.opacity[i]) == pytest.approx(shown, rel=1e-12)
        for axis in range(3):
            v = float(rows.own["velocity"][i, axis])
            moved = v * math.sin(2 * math.pi * since / 0.2) * 0.2 / (2 * math.pi) + v * math.exp(-beta / 0.4) * 0.013
            assert float(seen.means[i, axis]) == pytest.approx(float(rows.means[i, axis]) + moved, rel=1e-12)
    held = [rows.means, rows.opacity, *(rows.own[name] for name in ("tau", "log_beta", "velocity"))]

    def at(means, opacity, tau, log_beta, velocity):
        own = {"tau": tau, "log_beta": log_beta, "velocity": velocity}
        now = node.at_time(replace(rows, means=means, opacity=opacity, own=own), 1.2)
        return now.means, now.opacity

    assert torch.autograd.gradcheck(at, [value.clone().requires_grad_() for value in held])


@pytest.mark.parametrize(("step", "late", "rows"), [(10, 20, 5), (20, 20, 6)])
def test_what_changes_in_time_is_split_in_time(step, late, rows):
    """Of three Gaussians with small image gradients, one has a gradient of tau and a long life: it becomes two, late in
    the run three."""
    columns = black_points(np.zeros((4, 3), np.float32))
    columns |= starting_columns(4, torch.zeros(4), 0.2) | {"log_beta": torch.tensor([0.1, 0.1, 0.1, 0.005]).log()}
    model = scene_of(columns, VibrationNode("b", 0.0, 0.1))
    stats = densify.DensifyStats(torch.zeros(4), torch.ones(4), torch.tensor([0.0, 1.0, 0.0, 0.0]))
    report = densify.densify(model, stats, step, densify.DensifySettings(1, 99, 10, growth=9.0, late=late), 0)
    assert (report["split"], report["cloned"], report["rows"]) == (1, 0, rows)
    assert len(set(model.table["tau"].tolist())) == rows - 2
    stats = densify.DensifyStats(*(torch.ones(rows) for _ in range(3)))
    copied = densify.densify(model, stats, step, densify.DensifySettings(1, 99, 10, static_gradient=9.0, growth=9.0), 0)
    assert copied["cloned"] == 1


def test_the_losses_of_pvg_by_hand():
    alpha, depth = torch.tensor([[[0.5, 1.0]]]), torch.tensor([[[10.0, 20.0]]])
    inverse = losses.inverse_depth(depth, alpha, 1000.0)
    assert inverse.flatten().tolist() == pytest.approx([0.05 + 0.0005, 0.05])
    assert losses.sparse_inverse_depth(inverse, torch.tensor([1]), torch.tensor([10.0])).item() == pytest.approx(0.05)
    rgb, values = torch.tensor([[[0.0, 1.0]]] * 3).expand(3, 2, 2), torch.tensor([[[1.0, 3.0], [1.0, 3.0]]])
    assert losses.edge_aware(values, rgb).item() == pytest.approx(2 * math.exp(-1))
    assert losses.opacity_entropy(alpha).item() == pytest.approx(-0.25 * math.log(0.5))
    assert losses.empty_sky(alpha, torch.tensor([[[True, False]]])).item() == pytest.approx(-0.5 * math.log(0.5))


def test_half_of_the_steps_draw_the_state_of_another_time():
    model = scene_of({"means": torch.zeros(1, 3)}, VibrationNode("b", 0, 0.1))
    drawn = (pvg.VibrationRecipe().drawn_model(model, None, step, small_fit("pvg")) for step in range(400))
    moved = [one.nodes[0].early for one in drawn if one.nodes[0].early]
    assert 160 < len(moved) < 240
    assert max(map(abs, moved)) <= 0.03
    assert max(moved) > 0.02 and min(moved) < -0.02
    assert model.nodes[0].early == 0.0


# ---- deformed objects ----------------------------------------------------------------------------


def person() -> tuple[DeformationField, DeformedNode]:
    poses = np.stack([geometry.yaw_matrix(0.3, (0, 0, 0))] * 2)
    track = Track("walker", "pedestrian", [0.8, 0.6, 1.8], [0.0, 1.0], poses)
    return DeformationField.fresh((0.0, 2.0), 2, 8, 3, 5), DeformedNode.of_rigid(RigidNode.from_track(track), 2)


def test_a_flat_network_is_the_network_it_stands_for():
    network, g = FlatNetwork((5, 4, 3), leading=True), torch.Generator().manual_seed(1)
    flat = torch.randn(1, network.numbers, generator=g, dtype=torch.float64)
    x = torch.randn(6, 5, generator=g, dtype=torch.float64)
    weights, values = flat[0].numpy(), np.maximum(x.numpy(), 0)
    hidden = np.maximum(values @ weights[:20].reshape(4, 5).T + weights[20:24], 0)
    assert np.allclose(network(flat, x).numpy(), hidden @ weights[24:36].reshape(3, 4).T + weights[36:39], rtol=1e-12)
    start = network.start(g)
    assert start.shape == flat.shape and bool((start[0, 24:] == 0).all()) and bool((start[0, :20] != 0).all())
    assert torch.autograd.gradcheck(network, [flat.requires_grad_(), x.requires_grad_()], fast_mode=True)
    assert waves(torch.tensor([[0.25]]), 2).tolist()[0] == pytest.approx([0.25, 0.5**0.5, 1, 0.5**0.5, 0], 1e-6, 1e-6)


def test_a_deformed_object_stays_one_through_everything_a_scene_does():
    """At first it is rigid; then it moves as the field says, otherwise for other times and objects, saved and alone."""
    field, node = person()
    columns = black_points(np.random.default_rng(1).random((4, 3), np.float32) - 0.5)
    scene = scene_of(columns, StaticNode(), node, field, owner=1)
    rigid = RigidNode.from_track(Track("w", "car", node.size_m, node.times_s, node.world_from_object))
    rows = NodeRows(columns["means"], columns["quats"], columns["logits"], columns["sh_dc"])
    assert torch.equal(compose(scene, 0.5).means, rigid.at_time(rows, 0.5).means)
    with torch.no_grad():
        field.learnt["network"].normal_(generator=torch.Generator().manual_seed(2))
    moved = compose(scene, 0.5).means
    place = 2 * columns["means"] / torch.tensor(node.size_m)
    expected = rigid.at_time(replace(rows, means=rows.means + field.displacement(place, 0.5, 2)), 0.5)
    assert torch.equal(moved, expected.means)
    assert not torch.equal(field.displacement(place, 0.5, 2), field.displacement(place, 0.5, 1))
    assert not torch.equal(moved, compose(scene, 0.7).means)
    assert torch.equal(compose(SceneModel.from_state(*scene.state()), 0.5).means, moved)
    assert torch.equal(compose(scene.with_object_moved("walker", np.eye(4)), 0.5).means, moved)
    assert [one.node_names() for one in (scene, scene.without_nodes(["walker"]))] == [("walker",), ()]
    resting = scene.with_nodes((scene.nodes[0], scene.nodes[1].with_values(rests=True), field))
    assert torch.equal(compose(resting, 0.5).means, rigid.at_time(rows, 0.5).means)


# ---- hexplane ------------------------------------------------------------------------------------


def field_in_float64() -> HexPlaneNode:
    """A small field with numbers everywhere."""
    node = HexPlaneNode.fresh([-2, -3, 0, 1], [2, 3, 1, 2], PlaneSizes(2, 2, 3, 4, 5), 1)
    g = torch.Generator().manual_seed(4)
    drawn = {name: torch.rand(value.shape, generator=g).double() for name, value in node.learnt.columns.items()}
    node.learnt = Table({name: value - 0.4 for name, value in drawn.items()})
    return node


def test_planes_agree_with_a_plain_loop():
    node, g = field_in_float64(), torch.Generator().manual_seed(5)
    places = torch.rand(7, 4, generator=g).double() * 2.4 - 1.2
    planes = [(axes, plane.detach().permute(2, 0, 1).numpy()) for axes, plane in node.planes()]
    assert [plane.shape for _, plane in planes] == [(2, 3, 3)] * 3 + [(2, 4, 3)] * 3 + [(2, 6, 6)] * 3 + [(2, 4, 6)] * 3
    expected = np.ones((7, 4))
    for index, (axes, plane) in enumerate(planes):
        for row, place in enumerate(places.numpy()):
            x, y = ((np.clip(place[axis], -1, 1) + 1) / 2 * (plane.shape[2 - n] - 1) for n, axis in enumerate(axes))
            i, j = min(int(x), plane.shape[2] - 2), min(int(y), plane.shape[1] - 2)
            u, v = x - i, y - j
            for feature in range(2):
                p = plane[feature]
                low, high = p[j, i] * (1 - u) + p[j, i + 1] * u, p[j + 1, i] * (1 - u) + p[j + 1, i + 1] * u
                expected[row, 2 * (index // 6) + feature] *= low * (1 - v) + high * v
    assert np.allclose(node.features(places).detach().numpy(), expected, rtol=1e-10)


def test_the_field_moves_and_recolors_what_lies_in_its_box():
    node, g = field_in_float64(), torch.Generator().manual_seed(6)
    means = torch.cat([torch.rand(4, 3, generator=g).double(), torch.tensor([[9.0, 0, 0]]).double()])
    rows = NodeRows(means, torch.ones(5, 4).double(), torch.ones(5).double(), torch.zeros(5, 1, 3).double())
    now, later = node.at_time(rows, 1.2), node.at_time(rows, 1.9)
    assert bool((now.means[:4] != means[:4]).all()) and torch.equal(now.means[4], means[4])
    assert bool((now.sh_dc[:4] != 0).all()) and bool((now.sh_dc[4] == 0).all())
    assert not torch.equal(now.means, later.means)
    assert node.with_values(rests=True).at_time(rows, 1.2) is rows
    fresh = HexPlaneNode.fresh([-2, -3, 0, 1], [2, 3, 1, 2], PlaneSizes(2, 2, 3, 4, 5), 1)
    single = NodeRows(means.float(), torch.ones(5, 4), torch.ones(5), torch.zeros(5, 1, 3))
    assert torch.equal(fresh.at_time(single, 1.2).means, means.float())
    columns = [value.detach() for value in node.learnt.columns.values()]

    def at(planes, network, places):
        node.learnt.columns = {"planes": planes, "plane_network": network}
        found = node.at_time(replace(rows, means=places), 1.37)
        return found.means, found.sh_dc

    assert torch.autograd.gradcheck(at, [value.clone().requires_grad_() for value in (*columns, means)], fast_mode=True)
    seen = node.with_values(view=view_at(0.6, camera())).asked(torch.tensor([[1.0, 1, 0.5], [-2, 2, 0.5]]).double())
    assert set(seen.tolist()) <= {0, 1}


def test_the_losses_of_s3gaussian_by_hand():
    depth, pixel = torch.tensor([[[10.0, 20.0]]]), torch.tensor([0, 1])
    assert losses.sparse_squared_depth(depth, pixel, torch.tensor([18.0, 90.0]), 80.0).item() == pytest.approx(0.01)
    node = HexPlaneNode.fresh([0, 0, 0, 0], [1, 1, 1, 1], PlaneSizes(1, 1, 3, 3, 2), 1)
    with torch.no_grad():
        for axes, plane in node.planes():
            bent = torch.tensor([0.0, 1.0, 0.0]).view(3, 1, 1).expand(3, 3, 1)
            plane.copy_(bent if axes in ((0, 1), (0, 3)) else torch.ones(3, 3, 1))
    space, time, flat = plane_smoothness(node)
    assert (space.item(), time.item(), flat.item()) == pytest.approx((4.0, 4.0, 2 / 3))
    straight = HexPlaneNode.fresh([0, 0, 0, 0], [1, 1, 1, 1], PlaneSizes(1, 1, 2, 2, 2), 1)
    assert [term.item() for term in plane_smoothness(straight)] == [0.0, 0.0, 0.0]


# ---- Bezier curves -------------------------------------------------------------------------------


def test_bernstein_polynomials():
    assert bernstein(np.array([0.0, 0.5, 1.0])).tolist() == [[1, 0, 0, 0], [0.125, 0.375, 0.375, 0.125], [0, 0, 0, 1]]
    assert bernstein(np.linspace(-0.2, 1.2, 9)).sum(1) == pytest.approx(np.ones(9))


def test_a_cubic_track_is_fitted_exactly_and_others_well():
    times = np.linspace(3.0, 5.0, 12)
    control = np.array([[0.0, 0, 1], [8, 1, 1], [14, 6, 1.2], [15, 12, 1]])
    path = fit_path(times, bernstein((times - 3) / 2) @ control)
    assert np.abs(path.control - control).max() < 1e-9
    assert np.abs(path.at(4.237) - bernstein(np.array(1.237 / 2)) @ control).max() < 1e-9
    turning = np.stack([10 * np.sin(times - 3), 10 - 10 * np.cos(times - 3), 0 * times], 1)
    assert fit_path(times, turning).error_m < 0.02
    braking = np.stack([20 * (1 - np.exp(-(times - 3))), 0 * times, 0 * times], 1)
    assert fit_path(times, braking).error_m < 0.04


@pytest.mark.parametrize("keys", [1, 2, 3])
def test_short_and_standing_tracks_have_a_path(keys):
    times = np.arange(keys) * 0.1
    positions = np.stack([2 * times, -times, 1 + 0 * times], 1)
    path = fit_path(times, positions)
    assert np.abs(path.at(times) - positions).max() < 1e-6
    if keys > 1:
        assert path.at(0.05) == pytest.approx([0.1, -0.05, 1], abs=1e-6)
    still = fit_path(times, np.ones((keys, 3)))
    assert np.abs(still.at(times) - 1).max() < 1e-9


def test_an_object_on_curves_starts_where_its_box_is_and_moves_with_its_columns():
    times = np.linspace(0, 1, 6)
    keys = np.stack([geometry.yaw_matrix(0.4 * t, (5 * t, t**2, 0.5)) for t in times])
    track = Track("car", "car", [4.0, 2.0, 1.5], times, keys)
    node, rigid, g = BezierNode.from_track(track), RigidNode.from_track(track), torch.Generator().manual_seed(2)
    means, quats = torch.randn(5, 3, generator=g), torch.randn(5, 4, generator=g)
    rows = NodeRows(means, quats, torch.ones(5), torch.zeros(5, 1, 3), {"curve": torch.zeros(5, 4, 3)})
    for time_s in (0.0, 0.4, 1.0):
        ours, boxes = node.at_time(rows, time_s), rigid.at_time(rows, time_s)
        assert (ours.means - boxes.means).abs().max() < 2e-3
        assert torch.equal(ours.quats, boxes.quats)
    assert node.at_time(rows, 1.2) is None
    assert distance_change(node, rows, (0.0, 0.8)).item() < 1e-2
    shaken = replace(rows, own={"curve": torch.randn(5, 4, 3, generator=g)})
    weights = torch.from_numpy(bernstein(node.path.tau_at(0.33))).float()
    expected = node.at_time(rows, 0.33).means + (weights[:, None] * shaken.own["curve"]).sum(1)
    assert (node.at_time(shaken, 0.33).means - expected).abs().max() < 1e-5
    with torch.no_grad():
        node.learnt["trajectory"][0, 3] = torch.tensor([0.0, 0, 1])
    assert (node.at_time(shaken, 1.0).means - expected.new_tensor([0, 0, 1])).isfinite().all()
    assert (node.at_time(rows, 1.0).means[:, 2] - rigid.at_time(rows, 1.0).means[:, 2] - 1).abs().max() < 2e-3
    again = BezierNode.from_state(*node.state())
    assert torch.equal(again.at_time(shaken, 0.5).means, node.at_time(shaken, 0.5).means)
    assert torch.allclose(node.moved(np.eye(4)).at_time(shaken, 0.5).means, node.at_time(shaken, 0.5).means, atol=1e-5)
    assert distance_change(node, shaken, (0.0, 0.8)).item() > 0.5

    def at(curve, trajectory):
        made = BezierNode.from_track(track)
        made.learnt.columns = {"trajectory": trajectory}
        made._curves = {key: tuple(part.double() for part in value) for key, value in node._curves.items()}
        given = replace(rows, means=rows.means.double(), quats=rows.quats, own={"curve": curve})
        return made.at_time(given, 0.5).means

    inputs = [shaken.own["curve"].double().requires_grad_(), torch.zeros(1, 4, 3).double().requires_grad_()]
    assert torch.autograd.gradcheck(at, inputs, fast_mode=True)


# ---- fits ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", MOVING)
def test_a_fit_learns_reaches_every_column_and_is_read_back(world, tmp_path, monkeypatch, method):
    reached: set[str] = set()
    adam_step = fit.adam_step

    def spy(model, *rest):
        for table in (model.table, *model.node_tables().values()):
            reached.update(name for name, value in table.gradients().items() if bool((value != 0).any()))
        adam_step(model, *rest)

    monkeypatch.setattr(fit, "adam_step", spy)
    folder = fit_to(world, tmp_path / "fit", small_fit(method, iterations=60)).run()
    assert OWN[method] <= reached
    model = fit.load_model(folder)
    view = view_at(0.6, camera(width=SIZE[0], height=SIZE[1]))
    seen = fit.render_view(model, view, RasterConfig())
    exact = truth(view)
    assert metrics.psnr(seen.rgb, exact.rgb, (exact.semantics != ID["sky"])[None]) > 17.0
    again = SceneModel.from_state(*model.state())
    assert torch.equal(fit.render_view(again, view, RasterConfig()).rgb, seen.rgb)
    assert not torch.equal(compose(again, 0.0).means, compose(again, 0.45).means)


@pytest.mark.parametrize("method", RECIPES)
def test_interrupted_and_resumed_equals_uninterrupted(world, tmp_path, method):
    config = small_fit(method, iterations=14)
    whole = fit_to(world, tmp_path / "whole", config).run()
    with interrupted(11):
        fit_to(world, tmp_path / "parts", config).run()
    assert fitted_bytes(fit_to(world, tmp_path / "parts", config).run()) == fitted_bytes(whole)


@pytest.fixture(scope="module")
def tracked_or_not(tmp_path_factory) -> dict[str, Path]:
    """Scenes of two cameras, one darker, that differ in their tracks alone, and three other clouds made of them."""
    root = tmp_path_factory.mktemp("tracks")
    for name, changes in {"tracked": {}, "untracked": {"tracks": False}, "garbled": {"garbled": True}}.items():
        cameras = {"cameras": ("front", "left"), "dark": ("left",), "width": SIZE[0], "height": SIZE[1]}
        write_scene(root / name, frames=4, **cameras, **changes)
        Fuse(scene=root / name, out=root / f"{name}-fuse", settings=FuseConfig(min_object_points=5, voxel_m=0.05)).run()
    clouds = [read_fused(root / f"{name}-fuse") for name in ("tracked", "untracked", "garbled")]
    assert len({len(cloud.static) for cloud in clouds}) == 3 and [len(cloud.objects) for cloud in clouds] == [1, 0, 1]
    assert clouds[1].colors.to_common["left"].gain != clouds[2].colors.to_common["left"].gain
    return {path.name: path for path in root.iterdir()}


def fitted_to(worlds: dict[str, Path], name: str, out: Path, method: str, iterations: int = 4) -> Path:
    settings = small_fit(method, iterations=iterations, **(SMALL_RADIANCE if method == "emernerf" else {}))
    return Fit(scene=worlds[name], fused=worlds[f"{name}-fuse"], out=out / name, settings=settings).run()


def test_the_page_says_which_methods_know_boxes():
    page = (Path(__file__).parent.parent / "docs" / "baselines.md").read_text()
    listed = dict(re.findall(r"^\| `(\w+)` \| (yes|no) \| [^|]+ \|$", page, re.MULTILINE))
    assert listed == {name: "yes" if row.boxes else "no" for name, row in METHODS.items() if name in listed}
    assert {"gs3d", "street_gaussians", *PUBLISHED} == set(listed)


@pytest.mark.parametrize("method", FITTED_ALONE)
def test_boxes_change_a_method_if_and_only_if_it_knows_them(tracked_or_not, tmp_path, method):
    """Without boxes: no byte of the start and of the fit depends on the tracks of the scene, nor on the clouds that
    they cleaned."""
    folders = [fitted_to(tracked_or_not, name, tmp_path, method, 3) for name in ("tracked", "untracked", "garbled")]
    of = lambda folder: {f.name: f.read_bytes() for f in folder.glob("*.*") if f.stem in FITTED}
    tracked, untracked, garbled = map(of, folders)
    assert len(tracked) >= 2
    assert (tracked == untracked == garbled) is not METHODS[method].boxes
    assert (tracked != untracked != garbled) is METHODS[method].boxes


def test_a_static_scene_starts_with_what_moved(tracked_or_not, tmp_path):
    """Points lie on the car wherever a sweep met it, and nowhere above the road it has not reached."""
    model = fit.load_model(fitted_to(tracked_or_not, "tracked", tmp_path, "gs3d", 1))
    means = model.table["means"].detach().double().numpy()

    def on_car(time_s: float) -> int:
        local = geometry.transform_points(geometry.invert(car_pose(time_s)), means)
        return int(((np.abs(local) < CAR_SIZE / 2 + 0.05) & (local[:, 2:] > -0.5)).all(1).sum())

    assert min(on_car(time_s) for time_s in (0.0, 0.3, 0.6)) > 5
    assert on_car(2.4) == 0


def test_a_cloud_without_boxes_has_the_settings_of_the_one_with_them(tracked_or_not, tmp_path):
    settings = FuseConfig(voxel_m=0.8, match_colors=False)
    Fuse(scene=tracked_or_not["tracked"], out=tmp_path / "coarse", settings=settings).run()
    scene = read_scene(tracked_or_not["tracked"])
    folders = (tracked_or_not["tracked-fuse"], tmp_path / "coarse")
    fine, coarse = (fuse.fused_without_boxes(scene, folder) for folder in folders)
    assert len(coarse.static) < len(fine.static) / 2
    assert (fine.colors.to_common.keys(), coarse.colors.to_common.keys()) == ({"left"}, set())


@pytest.mark.parametrize("method", RECIPES)
def test_what_a_method_cannot_follow_is_refused(world, tmp_path, method):
    fit_to_world = partial(Fit, scene=world["scene"], fused=world["fuse"], out=tmp_path / "fit")
    about_boxes = {"poses__learn": True, "objects__deformable": False, "loss__object_weight": 0.1}
    foreign = [("published weights of its own", {name.replace(".", "__"): 0.33}) for name in WEIGHTS.get(method, ())]
    foreign += [("knows nothing of it", dict([one])) for one in about_boxes.items() if method in BOX_FREE]
    for said, changes in foreign:
        refused(said, fit_to_world(settings=small_fit(method, **changes)).run, raises=UsageError)
    assert not (tmp_path / "fit").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "model.json").write_text("{}")
    step = fit_to_world(start_from=tmp_path / "other", settings=small_fit(method))
    refused("cannot go on", step.run, raises=UsageError)


FOREIGN = {
    "pvg": "--virtual.start",
    "gs3d": "--poses.rounds",
    "omnire": "--loss.lidar-weight",
    "emernerf": "--sh-degree",
    "difix": "--virtual.depth-weight",
    "street_gaussians": "--radiance.size",
}


@pytest.mark.parametrize("method, flag", FOREIGN.items())
def test_help_shows_the_settings_of_a_method_and_others_are_refused(method, flag):
    page = command.help_page(Fit, everything=True, choice=method)
    assert flag not in page.split() and "--iterations" in page
    assert flag in command.help_page(Fit, everything=True).split()
    assert command.chosen(Fit, ["--out", "x", f"--method={method}"]) == method
    assert command.chosen(Fit, ["--method", method]) == method
    value = {"--radiance.size": "tiny"}.get(flag, "1")
    words = ["scene", "--out", "x", "--method", method, flag, value]
    assert flag in str(refused(f"does not apply to --method {method}", command.parse, Fit, words, raises=UsageError))


@pytest.mark.slow
@pytest.mark.parametrize("method", MOVING)
def test_a_fit_on_another_device_gives_the_same_numbers(world, tmp_path, method):
    small = {"iterations": 5, "start__gaussians": 120, "densify__max_gaussians": 400, "raster": "torch"}
    here = fit_to(world, tmp_path / "here", small_fit(method, device="cpu", **small)).run()
    with pretend_device():
        there = fit_to(world, tmp_path / "there", small_fit(method, device="pretend", **small)).run()
    view = view_at(0.6, camera(width=SIZE[0], height=SIZE[1]))
    pictures = [fit.render_view(fit.load_model(folder), view, RasterConfig()).rgb for folder in (here, there)]
    assert metrics.psnr(*pictures) > 45.0
