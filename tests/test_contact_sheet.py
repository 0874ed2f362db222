"""The contact sheet: points where they belong, boxes cut at the camera, and something for scenes that lack things."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toy_scene import CAR_SIZE_M, ToyStreet

from mudg.base.geometry import CAM_FROM_EGO_AXES, box_corners, invert, project, transform_points, yaw_matrix
from mudg.base.types import Camera, View
from mudg.core.pictures import depth_colors
from mudg.scene import contact_sheet as sheets

VIEW = View(Camera("front", 96, 64, 70.0, 70.0, 48.0, 32.0), invert(CAM_FROM_EGO_AXES), 0.0)


def box_of(size_m: np.ndarray, world_from_box: np.ndarray) -> np.ndarray:
    return transform_points(world_from_box, box_corners(size_m))


def test_points_are_drawn_where_they_project_and_near_ones_win() -> None:
    pixels = np.zeros((64, 96, 3), np.uint8)
    far, near, behind = [20.0, 2.0, 1.0], [10.0, 1.0, 0.5], [-5.0, 0.0, 0.0]
    sheets.draw_points(pixels, VIEW, np.array([far, near, behind]))
    uv, _ = project(VIEW, np.array([near]))
    column, row = uv[0].astype(int)
    assert (pixels[row, column] == depth_colors(np.array([10.0]), 3.0, 80.0)[0]).all()
    assert int((pixels.sum(2) > 0).sum()) == 1


def test_edges_of_a_box_in_front_are_its_projected_corners() -> None:
    corners = box_of(CAR_SIZE_M, yaw_matrix(0.4, (12.0, 0.5, 0.0)))
    uv, z = project(VIEW, corners)
    edges = dict(sheets.visible_edges(VIEW, corners))
    assert len(edges) == 12 and (z > 0).all()
    for number, (a, b) in enumerate(sheets._EDGES):
        assert np.allclose(edges[number], uv[[a, b]], atol=1e-9)
    lengths = [np.linalg.norm(corners[a] - corners[b]) for a, b in sheets._EDGES]
    assert np.allclose(np.sort(lengths), np.repeat(np.sort(CAR_SIZE_M), 4))


def test_a_box_around_the_camera_is_cut_and_one_behind_is_not_drawn() -> None:
    size = np.array([10.0, 3.0, 2.0])
    around = sheets.visible_edges(VIEW, box_of(size, yaw_matrix(0.0)))
    assert 0 < len(around) < 12
    for _, uv in around:
        assert np.isfinite(uv).all()
    assert sheets.visible_edges(VIEW, box_of(size, yaw_matrix(0.0, (-20.0, 0, 0)))) == []
    ends = sheets.cut_near(np.array([[0.0, 0, -1], [0, 0, 2]]))
    assert ends is not None and np.allclose(ends, [[0, 0, sheets.NEAR_M], [0, 0, 2]])
    assert sheets.cut_near(np.array([[0.0, 0, -1], [0, 0, -2]])) is None


def test_a_sheet_has_a_row_per_camera_and_a_view_from_above(tmp_path: Path) -> None:
    scene = ToyStreet(car_start=(12, 0), car_velocity=(3, 0)).write(tmp_path / "scene", width=120, height=60)
    image = sheets.contact_sheet(scene)
    assert image.size == (3 * sheets.TILE_WIDTH_PX, sheets.TILE_WIDTH_PX // 2 + sheets.TOP_HEIGHT_PX)
    top = np.array(image)[sheets.TILE_WIDTH_PX // 2 + 20 :]
    assert (np.abs(top.astype(int) - sheets.VEHICLE_COLOR).max(2) < 60).any()
    assert (np.abs(top.astype(int) - sheets.PATH_COLOR).max(2) < 60).any()


@pytest.mark.parametrize("lacking", ["sweeps", "tracks", "one frame"])
def test_scenes_that_lack_things_get_a_sheet_too(tmp_path: Path, lacking: str) -> None:
    street = ToyStreet(car_start=(12, 0), times=[0.0] if lacking == "one frame" else [0.0, 0.1])
    scene = street.write(tmp_path / "scene", labels=False, width=60, height=30)
    if lacking != "one frame":
        assert sheets.contact_sheet(replace(scene, **{lacking: ()})).height > sheets.TOP_HEIGHT_PX
        return
    assert sheets.contact_sheet(scene).size == (sheets.WIDTH_PX, sheets.TILE_WIDTH_PX // 2 + sheets.TOP_HEIGHT_PX)
    cameras = {name: replace(scene.cameras["front"], name=name) for name in "abcd"}  # single images share rows
    pose = scene.frames[0].view.world_from_cam
    frames = tuple(replace(scene.frames[0], view=View(camera, pose, 0.0)) for camera in cameras.values())
    many = replace(scene, cameras=cameras, frames=frames, split={})
    assert sheets.contact_sheet(many).size == (sheets.WIDTH_PX, 2 * sheets.TILE_WIDTH_PX // 2 + sheets.TOP_HEIGHT_PX)
