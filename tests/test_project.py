"""The point z-buffer: agreement with the one projection, nearest wins, both back-ends give the same bits."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from refusals import refused

from mudg import native
from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.types import Camera, FusedCloud, PointCloud, View
from mudg.core import project
from mudg.core.project import ProjectConfig, ProjectedPoints, project_cloud

needs_native = pytest.mark.skipif(native.library() is None, reason=native.status())
CAMERA = Camera("front", 96, 64, 70.0, 71.0, 47.3, 31.1)
VIEW = View(CAMERA, geometry.invert(geometry.CAM_FROM_EGO_AXES), 0.0)


def _cloud(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    xyz = np.stack([rng.uniform(-5, 80, count), rng.uniform(-30, 30, count), rng.uniform(-3, 12, count)], 1)
    return xyz.astype(np.float32), rng.integers(0, 256, (count, 3), dtype=np.uint8)


def seen_of(xyz: np.ndarray, rgb: np.ndarray | None = None, **config: float) -> ProjectedPoints:
    """World points drawn into ``VIEW``."""
    rgb = np.zeros((len(xyz), 3), np.uint8) if rgb is None else rgb
    return project_cloud(FusedCloud(PointCloud(xyz, rgb, "world"), {}), {}, VIEW, ProjectConfig(**config))


def test_every_seen_point_lands_on_its_projected_pixel_and_nothing_nearer_was_lost() -> None:
    xyz, rgb = _cloud(20_000)
    got = seen_of(xyz, rgb, near_m=0.5, far_m=60.0)
    uv, z = geometry.project(VIEW, xyz)
    with np.errstate(invalid="ignore"):
        pixel = np.floor(uv)
    inside = (z >= 0.5) & (z <= 60) & (pixel[:, 0] >= 0) & (pixel[:, 1] >= 0) & (pixel[:, 0] < 96) & (pixel[:, 1] < 64)
    order = np.flatnonzero(inside)[np.argsort(-z[inside], kind="stable")]
    column, row = pixel[order].astype(int).T
    nearest, colors = np.full((64, 96), np.inf), np.zeros((64, 96, 3))
    nearest[row, column], colors[row, column] = z[order], rgb[order]
    valid = got.valid.numpy()
    # float32 may move a point that lies on a pixel's very edge: at most a few in 20,000
    assert (valid != np.isfinite(nearest)).mean() < 1e-3
    both = valid & np.isfinite(nearest)
    alike = np.abs(got.depth.numpy() - nearest)[both] < 1e-3
    assert alike.mean() > 0.999
    shown = (got.rgb.permute(1, 2, 0).numpy()[both] * 255).round()
    np.testing.assert_array_equal(shown[alike], colors[both][alike])
    assert not got.depth[~got.valid].any() and not got.rgb[:, ~got.valid].any()


@needs_native
@pytest.mark.parametrize("splat", [1.0, 2.5, 4.0])
@pytest.mark.parametrize("occluder", [0.0, 0.4])
def test_native_and_numpy_give_the_same_bits(monkeypatch: pytest.MonkeyPatch, splat: float, occluder: float) -> None:
    xyz, rgb = _cloud(5000, seed=1)
    xyz[:3] = [[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0]]
    cloud = FusedCloud(PointCloud(xyz, rgb, "world"), {"a": PointCloud(xyz[:500] * 0.1, rgb[:500], "object")})
    config = ProjectConfig(static_splat_px=splat, object_splat_px=splat + 1, occluder_m=occluder)
    pose = {"a": geometry.yaw_matrix(0.3, (12, 1, 0))}
    want = project_cloud(cloud, pose, VIEW, config)
    monkeypatch.setattr(project.native, "library", lambda: None)
    got = project_cloud(cloud, pose, VIEW, config)
    for name in ("rgb", "depth", "valid", "moving"):
        assert torch.equal(getattr(want, name), getattr(got, name)), name


def test_result_does_not_depend_on_the_thread_count(set_threads: Callable[[int], None]) -> None:
    xyz, rgb = _cloud(200_000, seed=2)
    set_threads(1)
    one = seen_of(xyz, rgb, static_splat_px=2.5)
    set_threads(4)
    four = seen_of(xyz, rgb, static_splat_px=2.5)
    assert torch.equal(one.rgb, four.rgb) and torch.equal(one.depth, four.depth)


def test_equal_depths_go_to_the_lower_index_and_splats_cover_their_squares() -> None:
    xyz = np.array([[10, 0, 0], [10, 0, 0]], np.float32)
    got = seen_of(xyz, np.array([[255, 0, 0], [0, 255, 0]], np.uint8))
    assert got.rgb[:, got.valid].tolist() == [[1.0], [0.0], [0.0]]
    xyz = np.array([[10, 0, 0]], np.float32)
    for side, pixels in ((1.0, 1), (2.0, 4), (3.0, 9)):
        assert int(seen_of(xyz, static_splat_px=side).valid.sum()) == pixels


def test_objects_are_composed_by_depth_not_painted_over() -> None:
    wall = np.stack(np.meshgrid([10.0], np.linspace(-5, 5, 400), np.linspace(-4, 4, 400)), -1).reshape(-1, 3)
    car = np.array([[0.0, y, 0] for y in np.linspace(-1, 1, 200)])
    red, blue = np.array([255, 0, 0], np.uint8), np.array([0, 0, 255], np.uint8)
    cloud = FusedCloud(
        PointCloud(wall.astype(np.float32), np.tile(red, (len(wall), 1)), "world"),
        {"car": PointCloud(car.astype(np.float32), np.tile(blue, (len(car), 1)), "object")},
    )
    behind = project_cloud(cloud, {"car": geometry.yaw_matrix(0, (15, 0, 0))}, VIEW)
    assert not (behind.rgb[2] > 0).any()
    before = project_cloud(cloud, {"car": geometry.yaw_matrix(0, (5, 0, 0))}, VIEW)
    assert (before.rgb[2] > 0).any() and not (project_cloud(cloud, {}, VIEW).rgb[2] > 0).any()


def test_occluder_removes_what_shines_through_gaps_and_keeps_the_road() -> None:
    rng = np.random.default_rng(3)
    near = np.stack([np.full(4000, 6.0), rng.uniform(-4, 4, 4000), rng.uniform(-3, 3, 4000)], 1)
    far = np.stack([np.full(60_000, 30.0), rng.uniform(-19, 19, 60_000), rng.uniform(-14, 14, 60_000)], 1)
    xyz = np.concatenate([near, far]).astype(np.float32)
    plain, filtered = seen_of(xyz), seen_of(xyz, occluder_m=0.4)
    central = (slice(8, 56), slice(8, 88))
    assert (plain.depth[central] > 20).float().mean() > 0.2
    assert (filtered.depth[central] > 20).float().mean() < 0.02
    assert torch.equal(filtered.depth[filtered.valid], plain.depth[filtered.valid])
    # a road seen at a grazing angle hides nothing of itself
    road = np.stack([rng.uniform(2, 60, 200_000), rng.uniform(-10, 10, 200_000), np.full(200_000, -1.6)], 1)
    road = road.astype(np.float32)
    assert seen_of(road, occluder_m=0.2).valid.sum() > 0.97 * seen_of(road).valid.sum()


def test_empty_and_bad_input() -> None:
    for xyz in (np.zeros((0, 3), np.float32), np.array([[-5, 0, 0]], np.float32)):
        assert not seen_of(xyz).valid.any()
    refused("near_m", ProjectConfig, near_m=5.0, far_m=1.0, raises=UsageError)
    refused("static_splat_px", ProjectConfig, static_splat_px=0.0, raises=UsageError)
