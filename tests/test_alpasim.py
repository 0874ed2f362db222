"""Packages for AlpaSim, read as its reader does: by names in a zip, matrices from rig to world, microseconds, a mesh of
triangles."""

from __future__ import annotations

import io
import json
import struct
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy_splats
import yaml
from refusals import refused
from toy_fitted import toy_fitted

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.types import Camera, EgoPath, Frame, Ref, Scene, Source, View
from mudg.core.edit import HeightMap
from mudg.exporting.settings import ExportConfig
from mudg.formats.exporters import alpasim
from mudg.formats.exporters.alpasim import LANE_M, lanes_beside, opendrive, to_alpasim
from mudg.formats.exporters.ncore import intrinsics_of
from mudg.formats.splats.cloud import SplatScene
from mudg.gaussians.storage import save_model
from mudg.scene.motion import Road
from mudg.steps.export import Export

TIMES = np.array([0.0, 0.2, 0.4])


def drive(readout_s: float = 0.0) -> Scene:
    """A vehicle that turns while it drives, with two cameras that fire one after the other."""
    ego = EgoPath(TIMES, np.stack([geometry.yaw_matrix(0.3 * n, (2.0 * n, 0.1 * n, 0.0)) for n in range(3)]))
    cameras, frames = {}, []
    for number, name in enumerate(("front", "left")):
        cameras[name] = Camera(name, 64, 48, 50.0, 51.0, 31.0, 25.0, readout_s=readout_s)
        turned = geometry.yaw_matrix(0.8 * number, (1.5, 0.4 * number, 1.6))
        mount = turned @ geometry.invert(geometry.CAM_FROM_EGO_AXES)
        for index, time_s in enumerate((0.05 + 0.03 * number, 0.25)):
            pose = ego.pose_at(time_s)
            assert pose is not None
            frames.append(Frame(f"{name}/{index:06d}", View(cameras[name], pose @ mount, time_s), Ref("images/a.png")))
    return Scene("drive-1", ".", cameras, tuple(frames), (), (), ego, {}, Source("test", "none"))


def ground() -> HeightMap:
    x, y = np.meshgrid(np.arange(-20, 40, 0.25), np.arange(-10, 10, 0.25), indexing="ij")
    return HeightMap.from_points(np.column_stack([x.ravel(), y.ravel(), 0.02 * x.ravel()]))


def mesh_of(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a PLY file."""
    head, _, body = content.partition(b"end_header\n")
    counts = [int(line.split()[2]) for line in head.decode().splitlines() if line.startswith("element")]
    assert b"property list uchar int vertex_indices" in head
    vertices = np.frombuffer(body, "<f4", 3 * counts[0]).reshape(-1, 3)
    rows = list(struct.iter_unpack("<B3i", body[12 * counts[0] :]))
    assert len(rows) == counts[1] and {row[0] for row in rows} == {3}
    return vertices.astype(np.float64), np.array([row[1:] for row in rows])


class Package:
    """What a simulator reads of a package."""

    def __init__(self, content: bytes) -> None:
        self.archive = zipfile.ZipFile(io.BytesIO(content))
        self.content = content
        self.metadata = yaml.safe_load(self.archive.read("metadata.yaml"))
        self.rig: dict[str, Any] = json.loads(self.archive.read("rig_trajectories.json"))
        self.tracks: dict[str, Any] = json.loads(self.archive.read("sequence_tracks.json"))
        (self.trajectory,) = self.rig["rig_trajectories"]

    def rig_at(self, time_us: float) -> np.ndarray:
        times = np.array(self.trajectory["T_rig_world_timestamps_us"], np.float64)
        pose = geometry.pose_at(times, np.array(self.trajectory["T_rig_worlds"]), time_us, 0.5)
        assert pose is not None
        return pose


@pytest.fixture(scope="module")
def package() -> Package:
    return Package(to_alpasim(toy_splats.scene(1), drive(), ground()))


def test_the_package_is_a_usd_package_with_files_by_name(package: Package) -> None:
    infos = package.archive.infolist()
    assert infos[0].filename == "scene.usda" and b"ParticleField3DGaussianSplat" in package.archive.read("scene.usda")
    assert {info.compress_type for info in infos} == {zipfile.ZIP_STORED}
    assert {"metadata.yaml", "rig_trajectories.json", "sequence_tracks.json", "mesh_ground.ply", "sky.png"} < set(
        package.archive.namelist()
    )
    for info in infos:
        name, extra = (int.from_bytes(package.content[info.header_offset + at :][:2], "little") for at in (26, 28))
        assert (info.header_offset + 30 + name + extra) % 64 == 0
    facts = package.metadata
    names = "scene_id version_string training_date dataset_hash uuid is_resumable sensors logger time_range"
    assert set(facts) == {*names.split(), "training_step_outputs"}
    assert facts["sensors"] == {"camera_ids": ["front", "left"], "lidar_ids": []}
    assert set(facts["logger"]) == {"name", "run_id", "run_url"}
    times = package.trajectory["T_rig_world_timestamps_us"]
    assert facts["time_range"] == {"start": times[0], "end": times[-1]} and all(
        isinstance(at, int) and at >= 0 for at in times
    )


def test_points_fall_on_their_pixels_through_rig_mount_and_intrinsics(package: Package) -> None:
    log, rng = drive(), np.random.default_rng(0)
    for unique, spans in package.trajectory["cameras_frame_timestamps_us"].items():
        told = package.rig["camera_calibrations"][unique]
        frames = log.frames_of(told["logical_sensor_name"])
        assert len(spans) == len(frames) and unique == f"{told['logical_sensor_name']}@drive-1"
        model, mount = told["camera_model"], np.array(told["T_sensor_rig"])
        assert model["type"] == "opencv-pinhole"
        for (begin, end), frame in zip(spans, frames, strict=True):
            assert end == begin + 1
            world = geometry.transform_points(frame.view.world_from_cam, rng.uniform([-2, -2, 5], [2, 2, 30], (20, 3)))
            cam = geometry.transform_points(geometry.invert(package.rig_at(end) @ mount), world)
            found = (
                cam[:, :2] / cam[:, 2:] * model["parameters"]["focal_length"] + model["parameters"]["principal_point"]
            )
            assert np.abs(found - geometry.project(frame.view, world)[0]).max() < 1e-6


def test_objects_have_their_paths_sizes_and_flags(package: Package) -> None:
    scene = toy_splats.scene(1)
    ((name, told),) = package.tracks.items()
    assert name == "toy" and set(told) == {"tracks_data", "cuboidtracks_data"}
    data = told["tracks_data"]
    assert data["tracks_id"] == ["car-1", "1 person"] and data["tracks_label_class"] == ["automobile", "person"]
    assert data["tracks_flags"] == ["CONTROLLABLE", "NONE"]  # the person walks half a metre
    assert told["cuboidtracks_data"]["cuboids_dims"] == [[4.0, 1.8, 1.5], [0.6, 0.6, 1.8]]
    for node, times, poses in zip(scene.nodes[1:], data["tracks_timestamps_us"], data["tracks_poses"], strict=True):
        assert np.allclose(np.diff(times), np.diff(node.times_s) * 1e6)
        for pose, wanted in zip(poses, node.world_from_node, strict=True):
            x, y, z, w = pose[3:]
            assert np.allclose(pose[:3], wanted[:3, 3])
            assert np.allclose(geometry.matrix_from_quaternion([w, x, y, z]), wanted[:3, :3])
    first_us = data["tracks_timestamps_us"][0][0]
    assert first_us == 1_000_000  # the car is there before the first image, and is the first record
    assert package.trajectory["T_rig_world_timestamps_us"][0] == 1_500_000


def test_the_ground_lies_where_it_is_and_faces_up(package: Package) -> None:
    vertices, faces = mesh_of(package.archive.read("mesh_ground.ply"))
    assert faces.min() == 0 and faces.max() == len(vertices) - 1
    inside = (np.abs(vertices[:, 1]) < 8) & (vertices[:, 0] > -18) & (vertices[:, 0] < 38)
    assert np.abs(vertices[inside, 2] - 0.02 * vertices[inside, 0]).max() < 0.02
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    assert (normals[:, 2] > 0).all() and np.allclose(np.abs(normals[:, 2]), 0.25)


def test_unknown_ground_is_a_hole_and_the_mesh_turns_with_the_file() -> None:
    heights = np.zeros((3, 4))
    heights[1, 1] = np.nan
    turn = geometry.yaw_matrix(np.pi / 2, (10.0, 0.0, 1.0))
    vertices, faces = mesh_of(alpasim.ground_mesh(HeightMap(np.array([1.0, 2.0]), 0.5, heights), turn))
    assert len(vertices) == 11 and len(faces) == 2 * 2  # of six cells four touch the unknown corner
    assert np.allclose(vertices[0], [10.0 - 2.0, 1.0, 1.0], atol=1e-6)


def test_shutters_and_the_same_bytes(package: Package) -> None:
    rolling = Package(to_alpasim(toy_splats.scene(1), drive(0.02), ground()))
    front, _ = rolling.trajectory["cameras_frame_timestamps_us"].values()
    assert [end - begin for begin, end in front] == [20_000, 20_000]
    told = next(iter(rolling.rig["camera_calibrations"].values()))["camera_model"]["parameters"]
    assert told["shutter_type"] == "ROLLING_TOP_TO_BOTTOM"
    camera = Camera("a", 64, 48, 50.0, 51.0, 31.0, 25.0, (), 0.02, "left_to_right")
    assert intrinsics_of(camera)["shutter_type"] == "ROLLING_LEFT_TO_RIGHT"
    assert to_alpasim(toy_splats.scene(1), drive(), ground()) == package.content
    other = toy_splats.scene(1)
    moved = replace(other, nodes=(replace(other.nodes[0], cloud=toy_splats.cloud(4)), *other.nodes[1:]))
    assert Package(to_alpasim(moved, drive(), ground())).metadata["uuid"] != package.metadata["uuid"]


def test_intrinsics_are_those_of_the_vendors_package() -> None:
    data = pytest.importorskip("ncore.data")
    camera = Camera("a", 64, 48, 50.0, 51.0, 31.0, 25.0, readout_s=0.01)
    found = data.OpenCVPinholeCameraModelParameters.from_dict(intrinsics_of(camera))
    assert found.to_dict() == intrinsics_of(camera)


def test_the_command_needs_a_drive(tmp_path: Path) -> None:
    scene = SplatScene("toy", toy_splats.scene().nodes)
    refused("none is known", to_alpasim, scene, None, ground())
    parked = EgoPath(np.zeros(0), np.zeros((0, 4, 4)))
    refused("none is known", to_alpasim, scene, replace(drive(), ego=parked), ground())
    refused("ground", to_alpasim, scene, drive(), None)
    save_model(toy_fitted(0), tmp_path / "fit")
    step = Export(format="alpasim", source=tmp_path / "fit", out=tmp_path / "a.usdz", settings=ExportConfig())
    refused("--scene", step.run)
    refused("holds all moments", replace(step, settings=ExportConfig(time_s=0.2)).run, raises=UsageError)
    assert not (tmp_path / "a.usdz").exists()


# -- the map ---------------------------------------------------------------------------------------


def bend(slope: float = 0.03) -> Road:
    """A path that turns left by 40 degrees and climbs."""
    poses = []
    for angle in np.linspace(0, 0.7, 90):
        pose = geometry.yaw_matrix(angle, (60 * np.sin(angle), 60 * (1 - np.cos(angle)), slope * 60 * angle))
        pitch = -np.arctan(slope)
        pose[:3, :3] = pose[:3, :3] @ [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
        poses.append(pose)
    return Road(np.stack(poses))


def evaluated(xml: ET.Element) -> Iterator[tuple[float, float, float, float]]:
    """Station, x, y and z along the reference line, as the standard says how to compute them."""
    heights = [{k: float(v) for k, v in one.attrib.items()} for one in xml.iter("elevation")]
    for piece, height in zip(xml.iter("geometry"), heights, strict=True):
        at = {k: float(v) for k, v in piece.attrib.items()}
        poly = {k: float(v) for k, v in piece[0].attrib.items() if k != "pRange"}
        for p in np.linspace(0, 1, 9):
            u, v = (sum(poly[f"{c}{axis}"] * p**n for n, c in enumerate("abcd")) for axis in "UV")
            c, s, ds = np.cos(at["hdg"]), np.sin(at["hdg"]), p * at["length"]
            z = sum(height[name] * ds**n for n, name in enumerate("abcd"))
            yield at["s"] + ds, at["x"] + c * u - s * v, at["y"] + s * u + c * v, z


def test_the_maps_line_is_the_path_driven() -> None:
    road = bend()
    xml = ET.fromstring(opendrive(road, np.zeros((0, 3)), "bend"))
    points = np.array(list(evaluated(xml)))
    assert np.abs(np.linalg.norm(points[:, 1:3] - [0, 60], axis=1) - 60).max() < 0.01
    assert np.abs(points[:, 3] - 0.03 * points[:, 0]).max() < 0.02
    assert (np.diff(points[:, 0]) > -1e-6).all()
    assert points[-1, 0] == pytest.approx(float(xml.find("road").get("length")), abs=1e-6)
    assert points[-1, 0] == pytest.approx(60 * 0.7, abs=0.05)


@pytest.mark.parametrize(
    "left, right, lanes", [(1.8, 1.8, (0, 0)), (8.9, 1.9, (2, 0)), (5.3, 5.2, (1, 1)), (1.9, 8.7, (0, 2))]
)
def test_lanes_are_as_many_as_the_road_is_wide(left: float, right: float, lanes: tuple[int, int]) -> None:
    road, rng = bend(0.0), np.random.default_rng(0)
    stations, sides = rng.uniform(0, road.length_m, 2000), rng.uniform(-right, left, 2000)
    surface = np.stack([(road.recorded(s) @ [0.0, d, 0.0, 1.0])[:3] for s, d in zip(stations, sides)])
    assert lanes_beside(road, surface) == lanes
    assert lanes_beside(road, surface[rng.permutation(len(surface))]) == lanes
    xml = ET.fromstring(opendrive(road, surface, "x"))
    ids = [int(lane.get("id")) for lane in xml.iter("lane")]
    assert ids == sorted(ids, reverse=True) == list(range(lanes[0], -lanes[1] - 2, -1))
    # the driven lane is centred on the path: it begins half a lane to the left of it
    assert float(xml.find("road/lanes/laneOffset").get("a")) == LANE_M / 2


def test_the_package_holds_the_map_of_a_drive(package: Package) -> None:
    xml = ET.fromstring(package.archive.read("map.xodr"))
    points = np.array(list(evaluated(xml)))
    assert np.linalg.norm(points[-1, 1:3] - drive().ego.world_from_ego[-1, :2, 3]) < 0.01
    standing = replace(drive(), ego=EgoPath(TIMES, np.stack([np.eye(4)] * 3)))
    assert "map.xodr" not in Package(to_alpasim(toy_splats.scene(1), standing, ground())).archive.namelist()
