"""NCore recordings: they mean the same to NVIDIA's functions, come back as they were, and damage is told."""

from __future__ import annotations

import contextlib
import functools
import json
import lzma
import os
import shutil
import struct
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import bad_logs
import numpy as np
import pytest
import roundtrip
from memory_limits import at_most
from refusals import refused
from roundtrip import needs_native

from mudg import app
from mudg.base import geometry
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.types import Camera, EgoPath, Frame, Scene
from mudg.formats.exporters.messages import LogRecords
from mudg.formats.exporters.ncore import PoseKeys, package, sensor_ids, write_ncore
from mudg.formats.importers import RECOGNISERS
from mudg.formats.importers import ncore as importer
from mudg.formats.importers.common import ImportOptions
from mudg.formats.importers.images import brown_conrady, equidistant, fit_images
from mudg.scene.labels import read_label
from mudg.scene.read import open_files, read_points

truth = bad_logs.truth
ingest = bad_logs.importer("ncore")

try:
    package()
    REASON = ""
except ResourceError as missing:
    REASON = str(missing)
Sides = tuple[tuple[int, int], tuple[int, int], Any]
"""Size, principal point and shutter of a camera."""
WITHOUT = (
    "sensors_are_apart goes_on_and_then_stands is_asked_for_in_words chunk_of_the_grid regular_files_alone".split()
)
"""What the names of tests that do without the package hold."""
pytestmark = [needs_native, pytest.mark.filterwarnings("ignore::DeprecationWarning")]


@pytest.fixture(autouse=True)
def package_where_needed(request: pytest.FixtureRequest) -> None:
    if REASON and not any(words in request.node.name for words in WITHOUT):
        pytest.skip("the package nvidia-ncore is not installed")


def records(scene: Scene, **changes: Any) -> LogRecords:
    return LogRecords(replace(scene, **changes))


@pytest.fixture(scope="module")
def recording(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    write_ncore(folder, records(truth))
    return folder


@pytest.fixture(scope="module")
def loaded(recording: Path) -> Any:
    v4 = package().v4
    return v4.SequenceLoaderV4(v4.SequenceComponentGroupsReader(sorted(recording.glob("*.json"))))


# --- what it means to the package -----------------------------------------------------------------


def test_points_fall_on_their_pixels_by_the_packages_own_projection(truth: Scene, loaded: Any) -> None:
    """Pixel centres, camera axes and the direction of every pose: the package projects as this program does."""
    import torch

    points = np.random.default_rng(0).uniform([8, -12, -1], [30, 12, 4], (200, 3))
    for index, frame in enumerate(truth.frames_of("front_left")):
        sensor = loaded.get_camera_sensor("front_left")
        parameters = sensor.model_parameters
        model = package().sensors.CameraModel.from_parameters(parameters, device="cpu", dtype=torch.float64)
        at = sensor.frames_timestamps_us[index].astype(np.uint64)
        assert at[0] == at[1] == round(frame.view.time_s * 1e6) - round(truth.ego.times_s[0] * 1e6) + 1_000_000
        pose = loaded.pose_graph.evaluate_poses("world", "front_left", at[1])
        world = geometry.transform_points(frame.view.world_from_cam, points[:, [1, 2, 0]] * [1, -1, 1])
        theirs = model.world_points_to_image_points_static_pose(world, pose, return_valid_indices=True)
        uv, _ = geometry.project(frame.view, world)
        seen = np.asarray(theirs.valid_indices)
        assert len(seen) > 20
        assert np.abs(np.asarray(theirs.image_points) - uv[seen]).max() < 1e-3
        assert np.asarray(model.pixels_to_image_points(np.zeros((1, 2), np.int32))).tolist() == [[0.5, 0.5]]


def test_sweeps_compensated_by_the_package_are_the_sweeps(truth: Scene, loaded: Any) -> None:
    lidar = loaded.get_lidar_sensor("lidar")
    for index, sweep in enumerate(truth.sweeps):
        cloud = lidar.get_frame_point_cloud(index, motion_compensation=True, with_start_points=False)
        end = lidar.frames_timestamps_us[index, 1]
        pose = loaded.pose_graph.evaluate_poses("lidar", "world", np.array(end))
        found = geometry.transform_points(pose, np.asarray(cloud.xyz_m_end, np.float64))
        given = read_points(truth, sweep)
        expected = geometry.transform_points(sweep.world_from_lidar, given.xyz.astype(np.float64))
        assert np.abs(found - expected).max() < 1e-3
        raw = lidar.get_frame_point_cloud(index, motion_compensation=False, with_start_points=False).xyz_m_end
        assert np.abs(raw - given.xyz).max() > 0.01  # as measured, not as compensated


def test_boxes_stand_where_the_package_puts_them(truth: Scene, loaded: Any) -> None:
    bbox_pose = package().transformations.bbox_pose
    found = list(loaded.get_cuboid_track_observations())
    assert {one.track_id for one in found} == {track.id for track in truth.tracks}
    zero = loaded.generic_meta_data["mudg"]["clock_zero_us"]
    for one in found:
        track = truth.track(one.track_id)
        expected = track.pose_at((one.timestamp_us - zero) / 1e6)
        assert one.class_id == track.label and one.bbox3.dim == tuple(track.size_m)
        placed = bbox_pose(np.array([*one.bbox3.centroid, *one.bbox3.dim, *one.bbox3.rot]))
        assert np.abs(placed - expected).max() < 1e-9
        assert one.source.name == "GT_SYNTHETIC"


# --- both ways ------------------------------------------------------------------------------------


def test_round_trip(truth: Scene, recording: Path, tmp_path: Path) -> None:
    """Images equal to the byte, poses to 1e-6, points to 0.1 mm, boxes to 1e-6, times to a nanosecond."""
    assert RECOGNISERS["ncore"](recording)
    scene = ingest(recording, tmp_path / "back")
    roundtrip.assert_same_log(scene, truth, time_s=1e-9, intrinsics_px=1e-5, dt_s=1e-6, intensity=1e-6, cloud_m=1e-4)
    for a, b in zip(truth.frames, scene.frames, strict=True):
        assert open_files(truth.root).read(a.image.path) == open_files(scene.root).read(b.image.path)
    assert scene.source.dataset == truth.source.dataset and scene.source.licence == truth.source.licence
    assert scene.id == truth.id


def test_the_same_log_gives_the_same_bytes(truth: Scene, recording: Path, tmp_path: Path) -> None:
    for path in write_ncore(tmp_path, records(truth)):
        assert path.read_bytes() == (recording / path.name).read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in recording.iterdir())


def test_shutters_masks_and_sensors_that_move(truth: Scene, tmp_path: Path) -> None:
    """What the city lacks: a rolling shutter, a camera that shakes on the vehicle, the bonnet."""
    rng = np.random.default_rng(2)
    cameras = {**truth.cameras, "front": replace(truth.cameras["front"], readout_s=0.03, shutter="bottom_to_top")}
    bonnet = np.zeros((64, 96), bool)
    bonnet[50:, 20:70] = True

    def changed(frame: Frame) -> Frame:
        camera: Camera = cameras[frame.view.camera.name]
        pose = frame.view.world_from_cam.copy()
        if camera.name == "front_left":
            pose[:3, 3] += rng.normal(0, 0.02, 3)
        return replace(frame, view=replace(frame.view, camera=camera, world_from_cam=pose))

    shaken = replace(truth, cameras=cameras, frames=tuple(map(changed, truth.frames)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mudg.formats.exporters.ncore.read_label", lambda *_: bonnet)
        labelled = tuple(replace(frame, labels={"ego": frame.image}) for frame in shaken.frames)
        write_ncore(tmp_path, records(shaken, frames=labelled))
    scene = ingest(tmp_path, tmp_path / "back")
    assert scene.cameras["front"].shutter == "bottom_to_top"
    assert scene.cameras["front"].readout_s == 0.03 and scene.cameras["front_left"].readout_s == 0.0
    assert any("rolling bottom to top shutter" in note for note in scene.source.notes)
    shift = scene.frames[0].view.time_s - shaken.frames[0].view.time_s
    world = scene.frames[0].view.world_from_cam @ geometry.invert(shaken.frames[0].view.world_from_cam)
    for a, b in zip(shaken.frames, scene.frames, strict=True):
        assert np.abs(b.view.world_from_cam - world @ a.view.world_from_cam).max() < 1e-6
        assert b.view.time_s - a.view.time_s == pytest.approx(shift, abs=1e-9)
        assert (read_label(scene, b, "ego") == bonnet).all()


def test_other_peoples_recordings(truth: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As NVIDIA's converters write: a store per sensor, float32 poses, boxes in a sensor's frame, two returns."""
    v4, data = package().v4, package().data
    interval = package().transformations.HalfClosedInterval(1_000_000, 1_400_001)
    writer = v4.SequenceComponentGroupsWriter(tmp_path, "clip", "clip-7", interval, {}, store_type="directory")
    poses = writer.register_component_writer(v4.PosesComponent.Writer, "mine")
    keys = np.array([1_000_000, 1_200_000, 1_400_000], np.uint64)
    path = np.stack([geometry.yaw_matrix(0.1 * n, (float(n), 0, 0)) for n in range(3)]).astype(np.float32)
    poses.store_dynamic_pose("rig", "world", path, keys)
    mount = geometry.from_rotation_translation(geometry.CAM_FROM_EGO_AXES[:3, :3].T, (1.5, 0.0, 1.4)).astype(np.float32)
    poses.store_static_pose("camera:front wide", "rig", mount)
    poses.store_static_pose("top", "rig", geometry.from_rotation_translation(np.eye(3), (0, 0, 2.0)).astype(np.float32))
    intrinsics = writer.register_component_writer(v4.IntrinsicsComponent.Writer, "mine")
    sides = (96, 64), (48, 32), data.ShutterType.ROLLING_LEFT_TO_RIGHT
    lens = model_of(
        "OpenCVPinhole", sides, focal_length=(80, 80), radial_coeffs=(-0.2, 0.02, 0, 0, 0, 0), tangential_coeffs=(0, 0)
    )
    intrinsics.store_camera_intrinsics("camera:front wide", lens)
    camera = writer.register_component_writer(v4.CameraSensorComponent.Writer, "camera:front wide", "front")
    image = open_files(truth.root).read(truth.frames[0].image.path)
    for end in (1_100_000, 1_300_000):
        camera.store_frame(image, "png", np.array([end - 20_000, end], np.uint64), {}, {"gain": 2})
    lidar = writer.register_component_writer(v4.LidarSensorComponent.Writer, "top", "top")
    rays = np.array([[1, 0, 0], [0, 1, 0], [0, 0, -1]], np.float32)
    distance = np.array([[10, 20, np.nan], [12, np.nan, np.nan]], np.float32)
    times, span = np.array([1_200_000, 1_250_000, 1_300_000], np.uint64), np.array([1_200_000, 1_300_000], np.uint64)
    lidar.store_frame(
        rays, times, None, distance, (0 * distance + 0.5).astype(np.float32), span, {"velocity": times}, {}
    )
    box = data.BBox3((8.0, 1.0, -1.0), (4.5, 1.9, 1.6), (0.0, 0.0, 0.3))
    made = partial(data.CuboidTrackObservation, "a", "automobile")
    seen = [made(at, "top", at, box, data.LabelSource.AUTOLABEL) for at in (1_100_000, 1_300_000)]
    writer.register_component_writer(v4.CuboidsComponent.Writer, "mine").store_observations(seen)
    writer.finalize()

    scene = ingest(tmp_path, tmp_path / "back", test_every=0)
    assert [line for line in capsys.readouterr().err.splitlines() if "passed over" in line] == [
        "passed over: 'gain' in the camera frames of the recording, which this program does not know",
        "passed over: 'velocity' in the LiDAR frames of the recording, which this program does not know",
    ]
    name = "camera_front_wide"
    assert list(scene.cameras) == [name] and scene.cameras[name].readout_s == pytest.approx(0.02)
    assert scene.cameras[name].shutter == "left_to_right"
    assert all(word in "\n".join(scene.source.notes) for word in ("rectified", "left to right"))
    assert scene.source.licence.startswith("not stated")
    tree = package().transformations.PoseGraphInterpolator
    roof = geometry.from_rotation_translation(np.eye(3), (0, 0, 2.0))
    graph = tree([tree.Edge("rig", "world", path.astype(np.float64), keys), tree.Edge("top", "rig", roof, None)])
    turned = [graph.evaluate_poses("top", "world", np.array(at)) for at in (1_200_000, 1_250_000, 1_100_000, 1_300_000)]
    world = geometry.invert(_origin(scene, path, keys))
    returns = ((turned[0], (10, 0, 0, 1)), (turned[1], (0, 20, 0, 1)), (turned[0], (12, 0, 0, 1)))
    expected = np.stack([(pose @ place)[:3] for pose, place in returns])
    sweep = scene.sweeps[0]
    found = geometry.transform_points(sweep.world_from_lidar, read_points(scene, sweep).xyz.astype(np.float64))
    assert np.abs(found - geometry.transform_points(world, expected)).max() < 1e-5
    (track,) = scene.tracks
    assert track.label == "car"
    for at, pose in zip((1_100_000, 1_300_000), turned[2:], strict=True):
        stands = track.pose_at((at - 1_090_000) / 1e6)  # the first image is taken at 1.09 s
        placed = world @ pose @ geometry.yaw_matrix(0.3, (8.0, 1.0, -1.0))
        assert stands is not None and np.abs(stands - placed).max() < 1e-5


def model_of(kind: str, sides: Sides, **more: Sequence[float] | float) -> Any:
    """A camera model of the package, f32 throughout."""
    size, point, shutter = sides
    common = {"resolution": np.array(size, np.uint64), "shutter_type": shutter, "external_distortion_parameters": None}
    values = {name: value if name == "max_angle" else np.array(value, np.float32) for name, value in more.items()}
    made = getattr(package().data, f"{kind}CameraModelParameters")
    if kind == "FTheta":
        values["reference_poly"] = made.PolynomialType.ANGLE_TO_PIXELDIST
    if kind == "OpenCVPinhole":
        values["thin_prism_coeffs"] = np.zeros(4, np.float32)
    return made(**common, principal_point=np.array(point, np.float32), **values)


BENT, ASKEW, FISH = (-0.1, 0.01, 0, 0, 0, 0), (1e-3, -2e-3), (0.02, -0.003, 0, 0)
POLYNOMIALS = {"angle_to_pixeldist_poly": (0, 442, 0, 0, 0, 0), "pixeldist_to_angle_poly": (0, 1 / 442, 0, 0, 0, 0)}
FOCAL = {"focal_length": (440, 442)}
LENSES: dict[str, tuple[dict[str, Any], Any]] = {
    "OpenCVPinhole": ({**FOCAL, "radial_coeffs": BENT, "tangential_coeffs": ASKEW}, brown_conrady(*BENT[:2], *ASKEW)),
    "OpenCVFisheye": ({**FOCAL, "radial_coeffs": FISH, "max_angle": 1.3}, equidistant(*FISH)),
    "FTheta": ({**POLYNOMIALS, "max_angle": 1.2}, equidistant()),
}


@pytest.mark.parametrize("kind", LENSES)
def test_lenses_are_the_packages_own_and_fit_a_pinhole_camera(kind: str) -> None:
    """Projections against this program's own formulas; a lens of 120 degrees loses its rim, not its scale."""
    more, wanted = LENSES[kind]
    model = model_of(kind, ((960, 604), (470, 310), package().data.ShutterType.GLOBAL), **more)
    like = model.paraxial_pinhole_geometry()
    camera = Camera("front", 960, 604, *like.focal_length.tolist(), *like.principal_point.tolist())
    lens = importer._lens(model, camera)
    xy = np.random.default_rng(5).uniform(-0.8, 0.8, (100, 2))
    assert np.abs(lens(xy) - wanted(xy)).max() < 1e-5
    fit = fit_images(camera, ImportOptions(), lens)
    assert 1.0 <= fit.camera.fx / camera.fx < 1.2 and (fit.camera.cx, fit.camera.cy) == (camera.cx, camera.cy)
    if kind == "FTheta":  # centres of pixels count from 0 there
        assert (camera.cx, camera.cy) == (470.5, 310.5)


def _origin(scene: Scene, path: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Of the scene's world, in the recording's: the vehicle's first key, level and along its heading."""
    first = path[0].astype(np.float64)
    assert np.abs(scene.ego.world_from_ego[0] - np.eye(4)).max() < 1e-6 and len(keys) == len(scene.ego.times_s)
    return geometry.yaw_matrix(geometry.yaw_of(first), first[:3, 3])


def test_names_of_sensors_are_apart() -> None:
    ids = {"camera/front": "front", "camera/rig": "camera_rig", "lidar/front": "lidar_front", "lidar/top": "top"}
    assert sensor_ids(["front", "rig"], ["front", "world", "top"]) == ids | {"lidar/world": "lidar_world"}


def test_a_path_that_is_too_short_goes_on_and_then_stands() -> None:
    keys = PoseKeys(np.array([100, 200]), np.stack([geometry.yaw_matrix(0.0), geometry.yaw_matrix(0.2, (1.0, 0, 0))]))
    longer = keys.covering(50, 700)
    assert longer.times_us.tolist() == [50, 100, 200, 700]
    assert np.allclose(longer.poses[0], geometry.yaw_matrix(-0.1, (-0.5, 0, 0)))
    assert np.allclose(longer.poses[-1], geometry.yaw_matrix(0.4, (2.0, 0, 0)))
    assert np.allclose(longer.at(np.array([150]))[0], geometry.yaw_matrix(0.1, (0.5, 0, 0)))
    assert np.allclose(longer.at(np.array([100, 200])), keys.poses)


# --- choices and refusals -------------------------------------------------------------------------


def test_the_package_is_asked_for_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ncore.data.v4", None)
    (tmp_path / "a.ncore4.zarr.itar").write_bytes(b"")
    refused(r"mudg\[ncore\]", ingest, tmp_path, tmp_path / "out", raises=ResourceError)
    assert app.main(["export", "ncore", str(tmp_path), "--out", str(tmp_path / "out")]) != 0
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_written_is_refused(truth: Scene, tmp_path: Path) -> None:
    nowhere = EgoPath(np.zeros(0), np.zeros((0, 4, 4)))
    refused("vehicle's path", write_ncore, tmp_path, records(truth, ego=nowhere))
    twice = replace(truth.frames[0], id="front/000099")
    refused("front/000099", write_ncore, tmp_path, records(truth, frames=(*truth.frames, twice)))
    early = records(truth, sweeps=truth.sweeps[:1])
    points = early.points
    early.points = lambda sweep: replace(points(sweep), dt_s=points(sweep).dt_s - 3)
    refused("more than a second", write_ncore, tmp_path, early)
    assert not list(tmp_path.iterdir())


def test_one_vehicle_pose_and_no_sweep_are_enough(truth: Scene, tmp_path: Path) -> None:
    still = EgoPath(truth.ego.times_s[:1], truth.ego.world_from_ego[:1])
    alone = replace(truth, ego=still, sweeps=(), tracks=())
    write_ncore(tmp_path, records(alone))
    scene = ingest(tmp_path, tmp_path / "back")
    roundtrip.assert_same_log(scene, alone, time_s=1e-9, intrinsics_px=1e-5)
    assert "no LiDAR sweeps in the recording" in scene.source.notes


def test_one_of_several_recordings(recording: Path, tmp_path: Path) -> None:
    (store,) = recording.glob("*.itar")
    for name in ("a", "b"):
        shutil.copy(store, tmp_path / f"{name}.ncore4.zarr.itar")
    refused("--sequence", ingest, tmp_path, tmp_path / "out", raises=UsageError)
    assert len(ingest(tmp_path, tmp_path / "out", sequence="b", cameras=("front",)).cameras) == 1
    assert len(ingest(tmp_path / "a.ncore4.zarr.itar", tmp_path / "one").frames) == 10
    listed = json.loads(next(recording.glob("*.json")).read_text())
    listed["component_stores"][0]["path"] = "../a.ncore4.zarr.itar"
    (tmp_path / "x.json").write_text(json.dumps(listed))
    refused("file name", ingest, tmp_path / "x.json", tmp_path / "two")


def test_the_commands(truth: Scene, tmp_path: Path) -> None:
    assert app.main(["export", "ncore", truth.root, "--out", str(tmp_path / "out")]) == 0
    assert app.main(["ingest", str(tmp_path / "out"), str(tmp_path / "back"), "--no-contact-sheet"]) == 0


# --- damage ---------------------------------------------------------------------------------------


def _itar(members: dict[str, bytes], metadata: dict[str, Any], index: dict[str, Any] | None = None) -> bytes:
    """A store made by hand."""
    import cbor2

    packed = lzma.compress(cbor2.dumps({"zarr_consolidated_format": 1, "metadata": metadata}), preset=0)
    members = {**members, ".zmetadata.cbor.xz": packed}
    content, places = b"", []
    for name, body in members.items():
        places.append((name, len(content) + 512, len(body)))
        content += b"\0" * 512 + body + b"\0" * (-len(body) % 512)
    names, offsets, sizes = zip(*places, strict=True)
    table = index or {"items": list(names), "offset_datas": list(offsets), "sizes": list(sizes)}
    packed = lzma.compress(cbor2.dumps(table))
    end = struct.pack("<4sIQI", b"itar", 1, len(content), len(packed)).ljust(512, b"\0")
    return content + packed + b"\0" * (-len(packed) % 512) + end


ABOUT = {"version": "v4", "sequence_id": "a", "generic_meta_data": {}, "component_group_name": ""}
ROOT = {".zgroup": {"zarr_format": 2}, ".zattrs": ABOUT | {"sequence_timestamp_interval_us": {"start": 0, "stop": 9}}}
ARRAY = {"zarr_format": 2, "shape": [4], "chunks": [4], "dtype": "<f4", "order": "C", "fill_value": 0}
ARRAY |= {"compressor": None, "filters": None}


UNPACKS, PACKED, NOTHING = "unpacks to too much", "packed in a way", "cannot be read|no poses"
BLOSC = {"id": "blosc", "cname": "lz4", "clevel": 5, "shuffle": 2, "blocksize": 0}
FALSE_CHUNK = struct.pack("<4B3I", 2, 1, 0x21, 4, 1 << 31, 1 << 20, 64).ljust(64, b"\0")
PICKLED = {"dtype": "|O", "filters": [{"id": "pickle", "protocol": 5}]}
DEEP = functools.reduce(lambda inner, _: [inner], range(400), [])


def index_bomb() -> bytes:
    bomb = lzma.compress(bytes(200 << 20), preset=0)
    whole = (bytes(512) + bomb).ljust(-(-(512 + len(bomb)) // 512) * 512, b"\0")
    return whole + struct.pack("<4sIQI", b"itar", 1, 512, len(bomb)).ljust(512, b"\0")


def array(about: Any, chunk: bytes | None = bytes(16)) -> Callable[[], bytes]:
    """A store of one array with other attributes, or with something in their place; and its chunk."""
    about = {**ARRAY, **about} if isinstance(about, dict) else about
    return lambda: _itar({} if chunk is None else {"x/0": chunk}, {**ROOT, "x/.zarray": about})


def indexed(items: Any, offset: int, *sizes: int) -> Callable[[], bytes]:
    return lambda: _itar({}, ROOT, {"items": items, "offset_datas": [offset], "sizes": list(sizes)})


HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    # what is wrong: (the store; what is said)
    "index bomb": (index_bomb, UNPACKS),
    "metadata bomb": (lambda: _itar({"x/0": bytes(16)}, {**ROOT, "y/.zattrs": {"a": "0" * (150 << 20)}}), UNPACKS),
    "a million lists": (lambda: _itar({}, {**ROOT, "x/.zattrs": [[] for _ in range(900_000)]}), NOTHING),
    "member outside": (indexed(["a"], 1 << 50, 10), "outside of the file"),
    "index of another kind": (indexed(7, 1), "index"),
    "huge array": (array({"shape": [1 << 40], "chunks": [1 << 40]}), "larger than its file"),
    "array without chunks": (array({"shape": [1 << 33], "chunks": [1]}, None), "chunk of an array is missing"),
    "pickled array": (array(PICKLED), PACKED),
    "another codec": (array({"compressor": {"id": "zlib", "level": 9}}), PACKED),
    "false chunk": (array({"compressor": BLOSC}, FALSE_CHUNK), "larger than its file|another size|damaged"),
    "deep metadata": (array(DEEP), "are damaged"),
    "nothing in it": (array({}), NOTHING),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_stores_are_refused_before_they_cost_memory(kind: str, tmp_path: Path) -> None:
    store, said = HOSTILE[kind]
    (tmp_path / "a.ncore4.zarr.itar").write_bytes(store())
    with at_most(150):
        error = roundtrip.assert_refused(ingest, tmp_path, tmp_path / "out", said)
    assert "a.ncore4" in error.where or said == NOTHING


def test_metadata_that_would_fill_the_memory_are_refused_before_they_are_taken_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mudg.base.memory.free_bytes", lambda: 50 << 20)
    lists = b"\x9a\x00\x0d\xbb\xa0" + b"\x80" * 900_000
    refused(r"needs more memory(?s:.*)68.7 MiB", importer._cbor, lists, "a store", raises=ResourceError)


def as_folder(recording: Path, folder: Path) -> Path:
    """The store of a recording as a folder, as zarr keeps it without a tar file."""
    (path,) = recording.glob("*.itar")
    store = folder / path.name.removesuffix(".itar")
    for name, member in importer._members_of_tar(path).items():
        (store / name).parent.mkdir(parents=True, exist_ok=True)
        (store / name).write_bytes(member.read())
    return store


@pytest.mark.parametrize("lost", ["distance_m/0.0", "direction/0.0", "timestamp_us/0", "image/0"])
def test_a_lost_chunk_is_named_and_never_filled(recording: Path, tmp_path: Path, lost: str) -> None:
    store = as_folder(recording, tmp_path)
    assert len(ingest(tmp_path, tmp_path / "whole").frames) == 10
    chunk = sorted(store.rglob(f"*{lost}"))[1]
    chunk.unlink()
    error = roundtrip.assert_refused(ingest, tmp_path, tmp_path / "out", "chunk of an array is missing")
    assert error.where.endswith(f"{store.name}: {chunk.relative_to(store).as_posix()}")


@pytest.mark.parametrize(
    ("shape", "chunks", "there", "lost"),
    [
        ([5], [2], ["0", "1", "2"], ""),
        ([5], [2], ["0", "1"], "2"),
        ([5], [2], ["0", "1", "3"], "2"),  # as many as needed, but not those
        ([4, 5], [2, 3], ["0.0", "0.1", "1.1"], "1.0"),
        ([], [], [], "0"),
        ([], [], ["0"], ""),
        ([0, 3], [1, 3], [], ""),
    ],
)
def test_every_chunk_of_the_grid_must_be_there(
    tmp_path: Path, shape: list[int], chunks: list[int], there: list[str], lost: str
) -> None:
    about = {**ARRAY, "shape": shape, "chunks": chunks}
    (tmp_path / "chunk").write_bytes(bytes(4 * int(np.prod(chunks))))
    stored = importer._StoredMember(tmp_path / "chunk", 0, 4 * int(np.prod(chunks)))
    with pytest.raises(InputError, match=f"missing(?s:.*)x/{lost}") if lost else contextlib.nullcontext():
        importer._check_array(about, dict.fromkeys(there, stored), "x")


def altered(recording: Path, folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A recording whose metadata say something else."""
    import cbor2

    (path,) = recording.glob("*.itar")
    found = importer._members_of_tar(path)
    members = {name: member.read() for name, member in found.items() if name != importer.METADATA}
    metadata = cbor2.loads(lzma.decompress(found[importer.METADATA].read()))["metadata"]
    change(metadata)
    (folder / path.name).write_bytes(_itar(members, metadata))
    return folder


FRONT = "intrinsics/default/cameras/front/.zattrs"
RIG_POSES, BOXES = "poses/default/dynamic_poses/.zattrs", "cuboids/default/cuboids/.zattrs"


def test_components_and_fields_of_others_are_named_once(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def add(metadata: dict[str, Any]) -> None:
        metadata.update({f"thermal/{n}/.zgroup": {"zarr_format": 2} for n in "ab"})
        metadata[FRONT]["foo"] = metadata[FRONT]["camera_model_parameters"]["skew"] = 1
        for name in ("masks/default/cameras/front", "cameras/front/frames", "lidars/lidar/frames"):
            metadata[f"{name}/.zattrs"]["foo"] = 1
        for name in metadata:
            if name.endswith("image/.zattrs"):
                metadata[name]["quality"] = 90
        for box in metadata[BOXES]["cuboid_track_observations"]:
            box["speed"] = box["bbox3"]["score"] = 1

    ingest(next(recording.glob("*.json")), tmp_path / "official")
    assert "passed over" not in capsys.readouterr().err
    (tmp_path / "log").mkdir()
    folder = altered(recording, tmp_path / "log", add)
    listed = json.loads(next(recording.glob("*.json")).read_text())
    listed["component_stores"][0]["sha256"] = ""
    (folder / "a.json").write_text(json.dumps(listed))
    ingest(folder / "a.json", tmp_path / "out")
    said = [line for line in capsys.readouterr().err.splitlines() if "passed over" in line]
    assert sorted(said) == sorted(
        f"passed over: {names}, which this program does not know"
        for names in (
            "'component_stores.sha256' in a.json",
            "'thermal' in the stores of the recording",
            "'foo' in the LiDAR components of the recording",
            "'foo' in the camera components of the recording",
            "'foo' in the masks of the recording",
            "'foo', 'camera_model_parameters.skew' in the camera models of the recording",
            "'cuboid_track_observations.speed', 'cuboid_track_observations.bbox3.score' in the boxes of the recording",
            "'quality' in the images of the recording",
        )
    )


def each_pose(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[dict[str, Any]], object]:
    def spoil(metadata: dict[str, Any]) -> None:
        path = metadata[RIG_POSES]["('rig', 'world')"]
        path["poses"] = [change(np.array(pose)).tolist() for pose in path["poses"]]

    return spoil


def each_box(change: Callable[[dict[str, Any]], object]) -> Callable[[dict[str, Any]], object]:
    return lambda metadata: [change(one) for one in metadata[BOXES]["cuboid_track_observations"]]


def slower(metadata: dict[str, Any]) -> None:
    """Times in nanoseconds."""
    frames = metadata["cameras/front/frames/.zattrs"]["frames_timestamps_us"]
    for span in frames:
        span[:] = [1000 * at for at in span]


BAD = {
    "poses scaled": (each_pose(lambda pose: pose @ np.diag([2, 2, 2, 1])), "pose is scaled"),
    "poses left-handed": (each_pose(lambda pose: pose @ np.diag([1, -1, 1, 1])), "left-handed"),
    "poses not finite": (each_pose(lambda pose: pose * [[1, 1, 1, np.nan]]), "not finite"),
    "sides swapped": (each_box(lambda box: box["bbox3"].update(dim=[1.8, 4.5, 1.5])), "swapped"),
    "box of no size": (each_box(lambda box: box["bbox3"].update(dim=[4.5, 0.0, 1.5])), "size makes no sense"),
    "box not finite": (each_box(lambda box: box["bbox3"].update(centroid=[0.0, np.nan, 0.0])), "not finite"),
    "frame of a box unknown": (each_box(lambda box: box.update(reference_frame_id="radar")), "radar"),
    "times in another unit": (slower, "another unit"),
    "no intrinsics": (lambda metadata: metadata.pop(FRONT), "cannot be read"),
    "a lens of another kind": (lambda m: m[FRONT].update(camera_model_type="x"), "Unknown camera model"),
    "no camera": (lambda m: [m.pop(name) for name in list(m) if name.startswith("cameras/")], "no camera"),
}


@pytest.mark.parametrize("case", BAD)
def test_recordings_that_contradict_themselves_are_refused(case: str, recording: Path, tmp_path: Path) -> None:
    change, said = BAD[case]
    (tmp_path / "log").mkdir()
    roundtrip.assert_refused(ingest, altered(recording, tmp_path / "log", change), tmp_path / "out", said)


def test_rays_of_distance_0_are_no_points_and_are_counted(recording: Path, tmp_path: Path) -> None:
    import zarr

    whole = ingest(recording, tmp_path / "whole")
    store = as_folder(recording, tmp_path)
    name = "lidars/lidar/frames/" + sorted(path.parts[-3] for path in store.rglob("ray_bundle_returns/distance_m"))[0]
    distance = zarr.open(zarr.DirectoryStore(str(store)), "r+")[f"{name}/ray_bundle_returns/distance_m"]
    values = distance[:]
    values[:, :100] = 0.0
    distance[:] = values
    scene = ingest(tmp_path, tmp_path / "out")
    left, all_points = (sum(len(read_points(one, sweep).xyz) for sweep in one.sweeps) for one in (scene, whole))
    assert left == all_points - 100
    assert any("100 " in note and "return" in note for note in scene.source.notes), scene.source.notes


def test_every_cut_and_flipped_bytes_end_in_words(recording: Path, tmp_path: Path) -> None:
    """An error in words; or a scene, where pixels and points, which have no checksum, were flipped."""
    (store,) = recording.glob("*.itar")
    content, rng = store.read_bytes(), np.random.default_rng(3)
    target = tmp_path / "log" / store.name
    target.parent.mkdir()
    for length in [0, 1, 511, 512, len(content) - 512, len(content) - 1, *rng.integers(513, len(content), 8).tolist()]:
        target.write_bytes(content[:length])
        roundtrip.assert_refused(ingest, target.parent, tmp_path / "cut", ".")
    places = (rng.integers(0, len(content), 12), rng.integers(len(content) - 6000, len(content) - 400, 12))
    for number, at in enumerate(np.concatenate(places).tolist()):
        flipped = bytearray(content)
        flipped[at] ^= 1 << int(rng.integers(8))
        target.write_bytes(bytes(flipped))
        with contextlib.suppress(InputError), at_most(600):
            ingest(target.parent, tmp_path / f"flipped{number}")
            continue
        assert not (tmp_path / f"flipped{number}").exists()


@pytest.mark.parametrize("kind", ["pipe", "link to a device", "link to nothing"])
def test_a_folder_store_holds_regular_files_alone(kind: str, tmp_path: Path) -> None:
    """A chunk that is a pipe would be waited for, by the package."""
    store = tmp_path / "a.ncore4.zarr"
    (store / "x").mkdir(parents=True)
    (store / importer.METADATA).write_bytes(b"")
    chunk = store / "x" / "0"
    os.mkfifo(chunk) if kind == "pipe" else chunk.symlink_to("/dev/zero" if kind == "link to a device" else "/nowhere")
    assert str(chunk) in refused(".", importer.check_store, store).where
