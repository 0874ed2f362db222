"""Rolling shutters that are followed in one pass, against rows that are searched one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_fitted import write_toy_run

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.types import Camera, EgoPath, Frame, Scene, View
from mudg.core.raster.rasterize import RasterConfig
from mudg.core.table import Table
from mudg.core.trajectory import Readout, as_read, moved_by, points_as_read, readout_of
from mudg.editing.render import trajectories
from mudg.editing.settings import RenderConfig
from mudg.gaussians.model import SceneModel, compose, compose_as_read
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.rendering import render_view
from mudg.scene.schema import camera_to_json, parse_camera

SHUTTERS = ("top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left")
READOUT_S = 0.04


def pose_at(time_s):
    """A camera that drives 12 m/s ahead and turns left by 0.3 rad/s, and a little up."""
    turn = geometry.yaw_matrix(0.3 * time_s, (12 * time_s, 1.5 * time_s**2, 0.4 * time_s))
    return turn @ geometry.invert(geometry.CAM_FROM_EGO_AXES)


def rolling_view(shutter):
    return View(Camera("front", 192, 128, 120.0, 118.0, 90.0, 70.0, (), READOUT_S, shutter), pose_at(1.0), 1.0)


def readout(view):
    half = READOUT_S / 2
    return Readout(np.stack([pose_at(1.0 - half), pose_at(1.0 + half)]), 1.0 - half, 1.0 + half)


def seen_by_rows(view, points_at, count=201):
    """Pixels of moving points: where the row that is read at a moment is the one that shows them, by trying moments."""
    camera = replace(view.camera, readout_s=0.0, shutter="global")
    across = view.camera.shutter in ("left_to_right", "right_to_left")
    length, axis = (camera.width, 0) if across else (camera.height, 1)
    shares, pixels = np.linspace(0, 1, count), []
    for share in shares:
        time_s = 1.0 + READOUT_S * (share - 0.5)
        pixels.append(geometry.project(View(camera, pose_at(time_s), time_s), points_at(time_s))[0])
    read = (1 - shares if view.camera.shutter in SHUTTERS[1::2] else shares) * length
    missed, pixels = np.array(pixels)[..., axis] - read[:, None], np.array(pixels)
    found = []
    for point in range(missed.shape[1]):
        before = int(np.flatnonzero(np.diff(np.sign(missed[:, point])))[0])
        first, second = np.abs(missed[before : before + 2, point])
        found.append((pixels[before, point] * second + pixels[before + 1, point] * first) / (first + second))
    return np.array(found)


@pytest.mark.parametrize("shutter", SHUTTERS)
def test_points_lie_where_the_rows_that_show_them_saw_them(shutter):
    """Also those of an object that drives; without the shutter they would lie several pixels away."""
    view, rng = rolling_view(shutter), np.random.default_rng(3)
    u, v, depth = rng.uniform(30, 160, 12), rng.uniform(25, 100, 12), rng.uniform(4, 25, 12)
    world = geometry.unproject(view, np.stack([u, v], 1), depth)
    plain = View(replace(view.camera, readout_s=0.0, shutter="global"), view.world_from_cam, view.time_s)
    read, far = readout(view), 0.0
    for drives_m_s in (np.zeros(3), np.array([-9.0, 2.0, 0.0])):
        ends = [np.eye(4), np.eye(4)]
        for end, share in zip(ends, (-0.5, 0.5)):
            end[:3, 3] = drives_m_s * share * READOUT_S
        motions = moved_by(torch.from_numpy(world), torch.from_numpy(read.motion(view, *ends)))
        found, _ = geometry.project(plain, as_read(torch.from_numpy(world), motions, view).numpy())
        true = seen_by_rows(view, lambda time_s, drives=drives_m_s: world + drives * (time_s - 1.0))
        still, _ = geometry.project(plain, world)
        far = max(far, np.abs(still - true).max())
        assert np.abs(found - true).max() < 0.05
    assert far > 1.5


def test_what_lies_behind_and_the_middle_row_stay():
    view = rolling_view("top_to_bottom")
    middle = geometry.unproject(view, np.array([[20.0, 64.0], [150.0, 64.0]]), np.array([5.0, 9.0]))
    behind = view.center_world - 3 * view.world_from_cam[:3, 2]
    points = torch.from_numpy(np.concatenate([middle, behind[None]]))
    moved = as_read(points, moved_by(points, torch.from_numpy(readout(view).motion(view))), view)
    assert (moved - points).abs()[:2].max() < 0.02 and torch.equal(moved[2], points[2])


def test_gradients_are_those_of_a_fixed_row():
    """Finite differences of the displacement at the shares that the points have."""
    view, g = rolling_view("top_to_bottom"), torch.Generator().manual_seed(0)
    world = geometry.unproject(view, np.array([[60.0, 20.0], [120.0, 110.0], [90.0, 80.0]]), np.array([6.0, 8.0, 15.0]))
    motion = torch.from_numpy(readout(view).motion(view))
    points = torch.from_numpy(world).requires_grad_()
    weight = torch.randn(3, 3, generator=g, dtype=torch.float64)
    moved = as_read(points, moved_by(points, motion), view)
    (moved * weight).sum().backward()
    with torch.no_grad():
        steps = moved_by(points, motion)
        share = ((moved - points) * steps).sum(1) / steps.square().sum(1)
        for row, axis in np.ndindex(3, 3):
            other = points.clone()
            other[row, axis] += 1e-4
            there = other + share[:, None] * moved_by(other, motion)
            change = float(((there - moved) * weight).sum() / 1e-4)
            assert change == pytest.approx(float(points.grad[row, axis]), abs=1e-7)


# ---- logs and scenes -----------------------------------------------------------------------------


def rolling_scene(toy: Scene, **change) -> Scene:
    """The toy drive, fast and taken with rolling shutters."""
    rolls = {"readout_s": 0.04, "shutter": "bottom_to_top", **change}
    cameras = {name: replace(camera, **rolls) for name, camera in toy.cameras.items()}
    fast = np.stack([geometry.yaw_matrix(0.1 * t, (10 * t, 0.3, 0.0)) for t in toy.ego.times_s])
    frames = []
    for frame in toy.frames:
        mount = geometry.invert(toy.ego.pose_at(frame.view.time_s)) @ frame.view.world_from_cam
        ego = EgoPath(toy.ego.times_s, fast).pose_at(frame.view.time_s)
        frames.append(replace(frame, view=View(cameras[frame.view.camera.name], ego @ mount, frame.view.time_s)))
    return replace(toy, cameras=cameras, frames=tuple(frames), ego=EgoPath(toy.ego.times_s, fast))


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    _, _, scene, model = write_toy_run(tmp_path_factory.mktemp("toy"))
    return scene, model


def small(model: SceneModel) -> SceneModel:
    """The same with Gaussians that cover few rows each."""
    columns = {name: column.detach().clone() for name, column in model.table.columns.items()}
    columns["log_scales"] -= 1.8
    return replace(model, table=Table(columns, model.table.labels))


def middle(scene: Scene) -> Frame:
    return scene.frames[len(scene.frames) // 2]


def test_a_shutter_is_kept_by_a_scene_and_followed_only_if_its_direction_is_known(toy):
    scene = rolling_scene(toy[0])
    view = middle(scene).view
    found = readout_of(scene, view)
    assert found is not None and (found.begin_s, found.end_s) == (view.time_s - 0.02, view.time_s + 0.02)
    points = np.array([[8.0, 1.0, 0.5], [np.nan, 0, 0]], np.float32)
    assert np.abs(points_as_read(scene, view, points)[0] - points[0]).max() > 0.01
    for change in ({"shutter": "global"}, {"readout_s": 0.0}):
        other = rolling_scene(toy[0], **change)
        assert readout_of(other, middle(other).view) is None
        assert points_as_read(other, middle(other).view, points) is points
    told = camera_to_json(view.camera)
    assert parse_camera(view.camera.name, told, "cameras") == view.camera
    assert "shutter" not in camera_to_json(replace(view.camera, shutter="global"))
    with pytest.raises(InputError, match="shutter"):
        parse_camera(view.camera.name, {**told, "shutter": "sideways"}, "cameras")


def test_gaussians_of_objects_move_with_their_object_and_the_street_with_the_camera(toy):
    """Against poses of the track when the row of a Gaussian is read."""
    scene, model = rolling_scene(toy[0]), toy[1]
    view, times = middle(scene).view, np.linspace(-0.02, 0.02, 81)
    plain = replace(view, camera=replace(view.camera, readout_s=0.0, shutter="global"))
    now = compose(model, view.time_s).means.detach().double().numpy()
    read = compose_as_read(model, view, readout_of(scene, view)).means.detach().double().numpy()
    mount = geometry.invert(scene.ego.pose_at(view.time_s)) @ view.world_from_cam
    for index, node in enumerate(model.nodes[:2]):
        rows = (model.table.labels["node"] == index).numpy()
        uv, depth = geometry.project(plain, read)
        inside = (uv > 8).all(1) & (uv < (view.camera.width - 8, view.camera.height - 8)).all(1)
        shown = rows & (depth > 2) & inside
        row = uv[shown, 1]
        best = np.full((shown.sum(), 3), np.inf)
        for late in times:
            world = now[shown]
            if isinstance(node, RigidNode):
                there = node.pose_matrix(view.time_s + late) @ geometry.invert(node.pose_matrix(view.time_s))
                world = geometry.transform_points(there, world)
            pose = scene.ego.pose_at(view.time_s + late) @ mount
            seen, _ = geometry.project(replace(plain, world_from_cam=pose), world)
            reads = (0.5 - late / 0.04) * view.camera.height  # upwards
            miss = np.abs(seen[:, 1] - reads)
            nearer = miss < best[:, 0]
            best[nearer] = np.column_stack([miss, seen])[nearer]
        assert (
            shown.sum() > 20 and np.abs(best[:, 2] - row).max() < 1.2 and np.abs(best[:, 1] - uv[shown, 0]).max() < 0.6
        )
    assert compose_as_read(model, view, None).means is not None
    assert np.array_equal(compose_as_read(model, view, None).means.detach().numpy(), now.astype(np.float32))


def test_renders_of_the_recorded_path_are_read_as_the_photographs_and_others_at_once(toy):
    scene, model = rolling_scene(toy[0]), small(toy[1])
    name = middle(scene).view.camera.name
    recorded, beside = trajectories(scene, RenderConfig(cameras=(name,), shifts_m=(0.0, 2.0)))
    assert [readout_of(scene, view) is None for view in (recorded.views[0], beside.views[0])] == [False, True]
    view = recorded.views[len(recorded.views) // 2]
    read = render_view(model, view, RasterConfig(), readout=readout_of(scene, view)).rgb
    once = render_view(model, view, RasterConfig()).rgb
    strips = torch.zeros_like(once)
    for row in range(view.camera.height):
        late = 0.04 * (0.5 - (row + 0.5) / view.camera.height)  # upwards
        mount = geometry.invert(scene.ego.pose_at(view.time_s)) @ view.world_from_cam
        then = View(view.camera, scene.ego.pose_at(view.time_s + late) @ mount, view.time_s + late)
        strips[:, row] = render_view(model, then, RasterConfig()).rgb[:, row]
    assert (read - strips).abs().mean() < 0.25 * (once - strips).abs().mean()
