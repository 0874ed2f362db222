"""Packages for AlpaSim, read as its reader does: by names in a zip, matrices from rig to world, microseconds, a mesh of
triangles."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy_splats
import yaml
from toy_fitted import toy_fitted

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Camera, EgoPath, Frame, Ref, Scene, Source, View
from mudg.core.edit import HeightMap
from mudg.exporting.settings import ExportConfig
from mudg.formats.splats import usd
from mudg.formats.splats.cloud import SplatScene
from mudg.gaussians.storage import save_model
from mudg.steps.export import Export

TIMES = np.array([0.0, 0.2, 0.4])


def drive(readout_s: float = 0.0) -> Scene:
    """A vehicle that turns while it drives, with two cameras that fire one after the other."""
    ego = EgoPath(TIMES, np.stack([geometry.yaw_matrix(0.3 * n, (2.0 * n, 0.1 * n, 0.0)) for n in range(3)]))
    cameras, frames = {}, []
    for number, name in enumerate(("front", "left")):
        cameras[name] = Camera(name, 64, 48, 50.0, 51.0, 31.0, 25.0, readout_s=readout_s)
        mount = geometry.yaw_matrix(0.8 * number, (1.5, 0.4 * number, 1.6)) @ geometry.invert(
            geometry.CAM_FROM_EGO_AXES
        )
        for index, time_s in enumerate((0.05 + 0.03 * number, 0.25)):
            pose = ego.pose_at(time_s)
            assert pose is not None
            frames.append(Frame(f"{name}/{index:06d}", View(cameras[name], pose @ mount, time_s), Ref("images/a.png")))
    return Scene("drive-1", ".", cameras, tuple(frames), (), (), ego, {}, Source("test", "none"))


def ground() -> HeightMap:
    x, y = np.meshgrid(np.arange(-20, 40, 0.25), np.arange(-10, 10, 0.25), indexing="ij")
    return HeightMap.from_points(np.column_stack([x.ravel(), y.ravel(), 0.02 * x.ravel()]))


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

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        content = self.archive.read("mesh_ground.ply")
        head, _, body = content.partition(b"end_header\n")
        counts = [int(line.split()[2]) for line in head.decode().splitlines() if line.startswith("element")]
        assert b"property list uchar int vertex_indices" in head
        vertices = np.frombuffer(body, "<f4", 3 * counts[0]).reshape(-1, 3)
        rows = list(struct.iter_unpack("<B3i", body[12 * counts[0] :]))
        assert len(rows) == counts[1] and {row[0] for row in rows} == {3}
        return vertices.astype(np.float64), np.array([row[1:] for row in rows])


@pytest.fixture(scope="module")
def package() -> Package:
    return Package(usd.to_alpasim(toy_splats.scene(1), drive(), ground()))


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
    vertices, faces = package.mesh()
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
    mesh = usd.ground_mesh(HeightMap(np.array([1.0, 2.0]), 0.5, heights), turn)
    package = object.__new__(Package)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as written:
        written.writestr("mesh_ground.ply", mesh)
    package.archive = zipfile.ZipFile(archive)
    vertices, faces = package.mesh()
    assert len(vertices) == 11 and len(faces) == 2 * 2  # of six cells four touch the unknown corner
    assert np.allclose(vertices[0], [10.0 - 2.0, 1.0, 1.0], atol=1e-6)


def test_shutters_and_the_same_bytes(package: Package) -> None:
    rolling = Package(usd.to_alpasim(toy_splats.scene(1), drive(0.02), ground()))
    front, _ = rolling.trajectory["cameras_frame_timestamps_us"].values()
    assert [end - begin for begin, end in front] == [20_000, 20_000]
    told = next(iter(rolling.rig["camera_calibrations"].values()))["camera_model"]["parameters"]
    assert told["shutter_type"] == "ROLLING_TOP_TO_BOTTOM"
    camera = Camera("a", 64, 48, 50.0, 51.0, 31.0, 25.0, (), 0.02, "left_to_right")
    assert usd.intrinsics(camera)["shutter_type"] == "ROLLING_LEFT_TO_RIGHT"
    assert usd.to_alpasim(toy_splats.scene(1), drive(), ground()) == package.content
    other = toy_splats.scene(1)
    moved = replace(other, nodes=(replace(other.nodes[0], cloud=toy_splats.cloud(4)), *other.nodes[1:]))
    assert Package(usd.to_alpasim(moved, drive(), ground())).metadata["uuid"] != package.metadata["uuid"]


def test_intrinsics_are_those_of_the_vendors_package() -> None:
    data = pytest.importorskip("ncore.data")
    camera = Camera("a", 64, 48, 50.0, 51.0, 31.0, 25.0, readout_s=0.01)
    found = data.OpenCVPinholeCameraModelParameters.from_dict(usd.intrinsics(camera))
    assert found.to_dict() == usd.intrinsics(camera)


def test_the_command_needs_a_drive(tmp_path: Path) -> None:
    scene = SplatScene("toy", toy_splats.scene().nodes)
    with pytest.raises(InputError, match="none is known"):
        usd.to_alpasim(scene, None, ground())
    parked = EgoPath(np.zeros(0), np.zeros((0, 4, 4)))
    with pytest.raises(InputError, match="none is known"):
        usd.to_alpasim(scene, replace(drive(), ego=parked), ground())
    with pytest.raises(InputError, match="ground"):
        usd.to_alpasim(scene, drive(), None)
    save_model(toy_fitted(0), tmp_path / "fit")
    with pytest.raises(InputError, match="--scene"):
        Export(format="alpasim", source=tmp_path / "fit", out=tmp_path / "a.usdz", settings=ExportConfig()).run()
    with pytest.raises(UsageError, match="holds all moments"):
        Export(
            format="alpasim", source=tmp_path / "fit", out=tmp_path / "a.usdz", settings=ExportConfig(time_s=0.2)
        ).run()
    assert not (tmp_path / "a.usdz").exists()


# -- the map ---------------------------------------------------------------------------------------
