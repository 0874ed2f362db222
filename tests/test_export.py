"""`mudg export` and `mudg asset import`: what comes back renders as the fit does; what a format cannot hold is said."""

from __future__ import annotations

import json
import struct
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import splat_readers as slow
import torch
import toy_splats
import yaml
from mcap.reader import make_reader
from refusals import refused
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_edit import SIZE, toy
from test_edit import view as toy_view
from toy_scene import ToyStreet

from mudg import app
from mudg.base import geometry
from mudg.base.errors import InputError, MudgError, ResourceError, UsageError
from mudg.base.types import PointCloud, Scene, View
from mudg.baselines.bezier import BezierNode
from mudg.baselines.pvg import VibrationNode, starting_columns
from mudg.core.metrics import psnr
from mudg.core.raster.rasterize import RasterConfig
from mudg.editing.apply import read_asset
from mudg.exporting import export
from mudg.exporting.settings import ExportConfig, ImportConfig
from mudg.formats.exporters import messages as ros2
from mudg.formats.exporters.cameras import colmap_files, nerfstudio_files, rig_frames, sensors_from_rig
from mudg.formats.exporters.messages import LogRecords, write_mcap
from mudg.formats.splats import formats
from mudg.formats.splats.cloud import SplatCloud
from mudg.gaussians.fit import render_view
from mudg.gaussians.model import SceneModel, compose
from mudg.gaussians.nodes import DeformableNode, RigidNode
from mudg.gaussians.storage import load_model, save_model
from mudg.scene.read import read_points
from mudg.steps.edit import AssetImport
from mudg.steps.export import Export

LEAST_DB = {"ply": 50, "glb": 50, "usda": 50, "spz": 38, "compressed-ply": 38, "sog": 38, "splat": 30}
T = 0.5


def turning(kind: type[RigidNode] = RigidNode) -> SceneModel:
    """The toy scene of the edits with a car that turns."""
    model = toy(kind)
    node = model.nodes[1]
    poses = zip(node.times_s, node.world_from_object, strict=True)
    keys = np.stack([pose @ geometry.yaw_matrix(0.5 * t) for t, pose in poses])
    turned = kind("car-1", "car", SIZE, node.times_s, keys, None if kind is BezierNode else node.offsets)
    return replace(model, nodes=(model.nodes[0], turned))


def picture(model: SceneModel, time_s: float = T) -> torch.Tensor:
    return render_view(model, toy_view(time_s), RasterConfig(backend="cpu")).rgb


def db(model: SceneModel, cloud: SplatCloud, time_s: float = T) -> float:
    again = replace(export.model_of_cloud(cloud, "x"), sky=model.sky)
    return float(psnr(picture(again, time_s), picture(model, time_s)))


def baked(model: SceneModel, name: str, time_s: float = T) -> SplatCloud:
    """The model at a time, through a file."""
    given = export.Exported(export.RunParts({}, None, None, False), model, None, {})
    request = export.requested(ExportConfig(time_s=time_s), name, given)
    content = formats.FORMATS[name].write(request)
    if name != "usda":
        return formats.read_cloud(content, f"x.{name}")[0]
    splats = slow.read_usd_splats(slow.parse_usda(content.decode())["World"]["scene"]["splats"])
    rows = [(s.place, s.turn, np.log(s.size), np.log(s.opacity / (1 - s.opacity)), s.sh) for s in splats]
    return SplatCloud(*(np.asarray(values, np.float32) for values in zip(*rows, strict=True)))


def with_columns(model: SceneModel, degree: int | None = None, **more: torch.Tensor) -> SceneModel:
    """The model with other columns, and harmonics of a degree."""
    columns = {key: value.detach() for key, value in model.table.columns.items()} | more
    table = type(model.table)(columns, model.table.labels)
    return replace(model, table=table, sh_degree=model.sh_degree if degree is None else degree)


@pytest.mark.parametrize("name", LEAST_DB)
def test_what_comes_back_renders_as_the_fit_does(name: str) -> None:
    assert db(turning(), baked(turning(), name)) >= LEAST_DB[name]


@pytest.mark.parametrize("kind", [RigidNode, DeformableNode, BezierNode])
def test_nodes_of_every_kind_stand_where_the_model_puts_them(kind: type[RigidNode]) -> None:
    model = turning(kind)
    if kind is DeformableNode:
        with torch.no_grad():
            node = model.nodes[1]
            node.offsets["deform"].normal_(0, 0.2, generator=torch.Generator().manual_seed(1))
    if kind is BezierNode:
        curve = torch.randn(len(model.table), 4, 3, generator=torch.Generator().manual_seed(1)) * 0.1
        model = with_columns(model, curve=curve)
    harmonics = torch.randn(len(model.table), 8, 3, generator=torch.Generator().manual_seed(2))
    model = with_columns(model, 2, sh_rest=harmonics)
    keys = model.nodes[1].times_s
    for time_s in (float(keys[3]), float((keys[3] + keys[4]) / 2)):
        scene = export.splat_scene(model, time_s)
        now = compose(model, time_s)
        apart = np.abs(scene.at(time_s).means - now.means.detach().numpy()).max()
        assert now.sh_rest is not None  # exact at the moment, in whichever frame the fit has them
        assert np.abs(scene.at(time_s).sh[:, 1:] - now.sh_rest.detach().numpy()).max() < 1e-5
        assert apart < (5e-3 if kind is BezierNode else 1e-5)  # curves are straight between keys in a file


def test_a_background_that_changes_with_time_is_taken_at_the_moment() -> None:
    model = toy().without_nodes(["car-1"])
    columns = starting_columns(len(model.table), torch.linspace(-0.1, 0.1, len(model.table)), 0.2)
    columns["velocity"] = torch.randn(len(model.table), 3, generator=torch.Generator().manual_seed(1)) * 5
    moving = replace(with_columns(model, **columns), nodes=(VibrationNode("background", 0.5, 0.1),))
    assert db(moving, baked(moving, "ply", 0.7), 0.7) > 50
    assert db(moving, baked(moving, "ply", 0.2), 0.7) < 40


def test_the_sky_as_gaussians_looks_as_the_sky() -> None:
    model = toy()
    rows = model.sky.rows
    ramp = torch.linspace(0.2, 0.9, 2 * rows).expand(rows, -1)
    down = torch.linspace(0, 1, rows)[:, None].expand(-1, 2 * rows)
    model.sky.table.columns["panorama"].detach().copy_(torch.stack([ramp, ramp.flip(1), down])[None])
    scene = export.with_sky_sphere(export.splat_scene(model, T))
    assert scene.sky is None and scene.nodes[-1].name == "sky"
    alone = export.model_of_cloud(scene.nodes[-1].cloud, "sky")
    empty = replace(model, table=alone.table, nodes=alone.nodes, classes=())
    columns = {k: v.detach()[:1] * 0 - 50 for k, v in alone.table.columns.items()}
    nothing = type(alone.table)(columns, {"node": torch.zeros(1, dtype=torch.int32)})
    camera = toy_view().camera
    for yaw in (0.0, 2.0, 4.0):
        up = geometry.yaw_matrix(yaw) @ geometry.invert(geometry.CAM_FROM_EGO_AXES)
        view = View(camera, up, T)
        truth = render_view(replace(empty, table=nothing), view, RasterConfig(backend="cpu")).rgb
        shown = render_view(replace(empty, sky=None), view, RasterConfig(backend="cpu")).rgb
        assert float(psnr(shown, truth)) > 28


# -- the verb --------------------------------------------------------------------------------------


@pytest.fixture
def fit(tmp_path: Path) -> Path:
    save_model(turning(), tmp_path / "fit")
    return tmp_path / "fit"


def test_the_verb_writes_a_file_and_what_it_is(fit: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.spz"
    assert app.main(["export", "spz", str(fit), "--out", str(out), "--time-s", "0.5"]) == 0
    said = capsys.readouterr().err
    assert "spz does not hold motion (car-1 as at 0.5 s)" in said and "classes" in said and "sky" in said
    about = json.loads((tmp_path / "a.spz.json").read_text())
    assert about["gaussians"] == 690 and about["time_s"] == 0.5 and about["file_from_world"][0] == [0, -1, 0, 0]
    assert len(about["not_in_the_file"]) == 3 and about["bytes"] == out.stat().st_size
    assert app.main(["export", "spz", str(fit), "--out", str(out)]) == 2  # it exists
    before = out.read_bytes()
    assert app.main(["export", "spz", str(fit), "--out", str(out), "--time-s", "0.5", "--overwrite"]) == 0
    assert out.read_bytes() == before


def test_nodes_edits_and_motion(fit: Path, tmp_path: Path) -> None:
    Export(format="usda", source=fit, out=tmp_path / "car.usda", settings=ExportConfig(nodes=("car-1",))).run()
    stage = slow.parse_usda((tmp_path / "car.usda").read_text())["World"]
    assert list(stage) == ["type", "car_1"] and len(stage["car_1"]["xformOp:translate"]) == 21
    script = tmp_path / "edits.yaml"
    script.write_text("- move: {id: car-1, left_m: 2, ground: false}\n")
    Export(format="ply", source=fit, edits=script, out=tmp_path / "moved.ply", settings=ExportConfig(time_s=T)).run()
    Export(format="ply", source=fit, out=tmp_path / "plain.ply", settings=ExportConfig(time_s=T)).run()
    moved, plain = (
        formats.read_cloud((tmp_path / f"{n}.ply").read_bytes(), "x.ply")[0].means for n in ("moved", "plain")
    )
    apart = np.linalg.norm(moved - plain, axis=1)
    assert not apart[:640].any() and np.abs(apart[640:] - 2).max() < 1e-4
    Export(format="glb", source=fit, out=tmp_path / "a.glb", settings=ExportConfig(sky="sphere")).run()
    document, _ = slow.open_glb((tmp_path / "a.glb").read_bytes())
    assert [node["name"] for node in document["nodes"]] == ["background", "car-1", "sky"]
    Export(format="usdz", source=fit, out=tmp_path / "a.usdz", settings=ExportConfig()).run()
    assert "sky.png" in zipfile.ZipFile(tmp_path / "a.usdz").namelist()


@pytest.mark.parametrize(
    ("settings", "name", "out", "said"),
    [
        ({}, "obj", "a.obj", "no export format 'obj'"),
        ({}, "ply", "a.spz", "does not fit its format"),
        ({"time_s": 1.0}, "alpasim", "a.usdz", "holds all moments"),
        ({"time_s": 1.0}, "colmap", "folder", "does not have this setting"),
        ({"nodes": ("car-7",)}, "ply", "a.ply", "no node 'car-7'"),
        ({"nodes": ("car-1",), "time_s": 99.0}, "sog", "a.sog", "nothing to export"),
        ({}, "colmap", "folder", "cameras belong to a scene"),
    ],
)
def test_what_cannot_be_exported_is_refused(
    fit: Path, tmp_path: Path, settings: dict, name: str, out: str, said: str
) -> None:
    step = Export(format=name, source=fit, out=tmp_path / out, settings=ExportConfig(**settings))
    refused(said, step.run, raises=MudgError)
    assert not (tmp_path / out).exists()
    refused("lies in", replace(step, format="ply", out=fit / "a.ply", settings=ExportConfig()).run, raises=UsageError)


# -- imports ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["ply", "spz", "splat", "sog", "glb", "compressed-ply"])
def test_a_file_becomes_an_object_that_scripts_insert(name: str, fit: Path, tmp_path: Path) -> None:
    car, axes = toy_splats.cloud(60, 0, 3, spread=1.0), formats.file_from_world(name, "viewer")
    file = tmp_path / f"van{formats.FORMATS[name].suffixes[0]}"
    file.write_bytes(toy_splats.written(name, car.moved(geometry.yaw_matrix(0.0, (30, 0, 5))), axes))
    flags = ["--label", "van", "--length-m", "5", "--yaw-deg", "90", "--out", str(tmp_path / "a.safetensors")]
    assert app.main(["asset", "import", str(file), *flags]) == 0
    asset = read_asset(tmp_path / "a.safetensors")
    assert asset.label == "van" and abs(asset.size_m[0] - 5) < 1e-3 and set(asset.class_ids.tolist()) == {13}
    means = asset.columns["means"].numpy()
    assert np.abs(means.mean(0)).max() < 1.0  # centred
    scale = 5 / np.ptp(np.percentile(car.means[car.opacity > 0.3][:, 1], [0.5, 99.5]))
    assert abs(np.ptp(means[:, 0]) / np.ptp(car.means[:, 1]) - scale) < 0.02 * scale  # what lay along y lies along x
    script = tmp_path / "edits.yaml"
    script.write_text("- insert: {asset: {file: a.safetensors}, id: van-9, path: [[0, 9, 2, 0]]}\n")
    chosen, out = ExportConfig(time_s=T, nodes=("van-9",)), tmp_path / "inserted.ply"
    Export(format="ply", source=fit, edits=script, out=out, settings=chosen).run()
    assert out.is_file()


def imported(file: Path, out: Path, **settings: object) -> Path:
    return AssetImport(file=file, out=out, settings=ImportConfig(**settings)).run()


def test_a_file_becomes_a_scene(tmp_path: Path) -> None:
    cloud = toy_splats.cloud(40, 2, classes=True)
    (tmp_path / "a.ply").write_bytes(formats.ply.to_bytes(cloud, classes=True))
    imported(tmp_path / "a.ply", tmp_path / "fit", kind="scene", axes="world")
    model = load_model(tmp_path / "fit")
    assert len(model.table) == 40 and model.sh_degree == 2 and model.nodes[0].kind == "static"
    again = export.splat_scene(model, 0.0).nodes[0].cloud
    assert np.array_equal(again.sh, cloud.sh) and np.array_equal(again.class_ids, cloud.class_ids)
    more = {"kind": "scene", "label": "car", "raises": UsageError}
    refused("settings of objects", imported, tmp_path / "a.ply", tmp_path / "fit2", **more)


def test_what_cannot_be_imported_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(b"v 0 0 0")
    faint = replace(toy_splats.cloud(5), logits=np.full(5, -9, np.float32))
    (tmp_path / "b.ply").write_bytes(formats.ply.to_bytes(faint))
    for file, out, error, said in (
        ("no.ply", "a.safetensors", InputError, "no such file"),
        ("a.obj", "a.safetensors", InputError, "no file of Gaussians"),
        ("b.ply", "a.safetensors", InputError, "no solid Gaussians"),
        ("b.ply", "a.ply", UsageError, "ends in .safetensors"),
    ):
        refused(said, imported, tmp_path / file, tmp_path / out, raises=error)
    for words in (["import", str(tmp_path / "b.ply"), "car-1"], ["export", str(tmp_path)]):
        assert app.main(["asset", *words, "--out", str(tmp_path / "a.safetensors")]) == 2
    assert not (tmp_path / "a.safetensors").exists()


# -- cameras ---------------------------------------------------------------------------------------


def test_nerfstudio_cameras_look_where_ours_do_and_points_start_where_ours_are(tmp_path: Path) -> None:
    scene = ToyStreet(times=[0.0, 0.1]).write(tmp_path / "scene", width=24, height=12)
    step = Export(format="nerfstudio", source=tmp_path / "scene", out=tmp_path / "out", settings=ExportConfig())
    step.run()
    told = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert len(told["frames"]) == 2
    for frame, ours in zip(told["frames"], scene.frames, strict=True):
        picture = (tmp_path / "scene" / ours.image.path).read_bytes()
        assert (tmp_path / "out" / frame["file_path"]).read_bytes() == picture
        pose = np.array(frame["transform_matrix"])
        point = ours.view.world_from_cam @ [0.4, 0.3, 5.0, 1.0]
        x, y, z, _ = np.linalg.inv(pose) @ point  # x right, y up, z back
        uv = frame["fl_x"] * x / -z + frame["cx"], frame["fl_y"] * -y / -z + frame["cy"]
        assert np.allclose(uv, geometry.project(ours.view, point[None, :3])[0][0])
    assert step.run() == tmp_path / "out"  # verified and reused
    xyz, rgb = np.array([[1, 2, 3], [4, 5, 6]], np.float32), np.array([[9, 8, 7], [6, 5, 4]], np.uint8)
    points = PointCloud(xyz, rgb, "world")  # to start from
    content = colmap_files(scene, points)["sparse/0/points3D.bin"]
    assert struct.unpack_from("<QQ3d3BdQ", content) == (2, 1, 1.0, 2.0, 3.0, 9, 8, 7, 0.0, 0)
    assert len(content) == 8 + 2 * 51
    assert nerfstudio_files(scene, points)["points.ply"].endswith(struct.pack("<3f3B", 4, 5, 6, 6, 5, 4))


def test_colmap_binaries_hold_the_poses_and_one_rig(tmp_path: Path) -> None:
    scene = ToyStreet(times=[0.0, 0.1, 0.2]).write(tmp_path / "scene", width=24, height=12)
    aside = geometry.yaw_matrix(0.4, (0.3, 0.5, 0.0))  # a second camera on the rig, 10 ms late at the last frame
    frames = list(scene.frames)
    for index, frame in enumerate(scene.frames):
        late = 0.01 if index == 2 else 0.0
        pose = scene.ego.pose_at(frame.view.time_s)
        cam = pose @ aside @ geometry.invert(pose) @ frame.view.world_from_cam
        view = View(replace(frame.view.camera, name="left"), cam, frame.view.time_s + late)
        frames.append(replace(frame, id=frame.id.replace("front", "left"), view=view))
    both = replace(scene, frames=tuple(frames), cameras={**scene.cameras, "left": frames[-1].view.camera})
    files = colmap_files(both)
    sensors = sensors_from_rig(both)
    assert np.allclose(sensors["front"], np.eye(4))
    rigs = [len(frames) for _, frames in rig_frames(both, sensors)]
    assert rigs == [2, 2, 1, 1]

    def pose_of(seven: tuple[float, ...]) -> np.ndarray:
        return geometry.from_rotation_translation(geometry.matrix_from_quaternion(seven[:4]), seven[4:])

    content, place = files["sparse/0/images.bin"], 8
    found = {}
    assert struct.unpack_from("<Q", content)[0] == 6
    for _ in range(6):
        values = struct.unpack_from("<I7dI", content, place)
        end = content.index(b"\0", place + 64)
        assert struct.unpack_from("<Q", content, end + 1) == (0,)
        found[values[0]] = (pose_of(values[1:8]), values[8], content[place + 64 : end].decode())
        place = end + 9
    assert place == len(content)
    for number, frame in enumerate(both.frames, 1):
        assert np.abs(found[number][0] - frame.view.cam_from_world).max() < 1e-12
        assert found[number][2].startswith(frame.id)
    content = files["sparse/0/frames.bin"]
    place, explained = 8, {}
    for _ in range(struct.unpack_from("<Q", content)[0]):
        values = struct.unpack_from("<II7dI", content, place)
        place += 68
        for _ in range(values[9]):
            kind, sensor, image = struct.unpack_from("<iIQ", content, place)
            place += 16
            name = ("front", "left")[sensor - 1]
            explained[image] = sensors[name] @ pose_of(values[2:9])
            assert kind == 0
    assert place == len(content)
    for image, pose in explained.items():  # what COLMAP makes of rigs and frames are the poses of the images
        assert np.abs(pose - found[image][0]).max() < 2e-6
    rig = files["sparse/0/rigs.bin"]
    assert struct.unpack_from("<QIIiI", rig) == (1, 1, 2, 0, 1)
    assert struct.unpack_from("<iIB", rig, 24) == (0, 2, 1) and len(rig) == 24 + 9 + 56
    camera = struct.unpack_from("<IiQQ4d", files["sparse/0/cameras.bin"], 8)
    assert camera == (1, 1, 24, 12, *both.cameras["front"].intrinsics)


# --- logs as messages of ROS 2: read by other readers, and put back together --------------------------------------


def read_bag(folder: Path) -> tuple[dict[str, list[tuple[int, Any]]], dict[str, Any]]:
    """Topic -> times and values of its messages, by the definitions in the file; and what metadata.yaml says."""
    messages: dict[str, list[tuple[int, Any]]] = {}
    with Reader(folder) as reader:
        types = get_typestore(Stores.EMPTY)
        for connection in reader.connections:
            types.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        for connection, stamp, content in reader.messages():
            value = types.deserialize_cdr(content, connection.msgtype)
            messages.setdefault(connection.topic, []).append((stamp, value))
    return messages, yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]


def street(folder: Path) -> Scene:
    toy_street = ToyStreet(times=[0.5, 0.6, 0.7], car_start=(8.0, 1.0), car_velocity=(3.0, 0.0))
    return toy_street.write(folder, width=24, height=12)


def matrix(transform: Any) -> np.ndarray:
    turn, shift = transform.rotation, transform.translation
    rotation = geometry.matrix_from_quaternion([turn.w, turn.x, turn.y, turn.z])
    return geometry.from_rotation_translation(rotation, [shift.x, shift.y, shift.z])


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, Path]:
    folder = tmp_path_factory.mktemp("bag")
    scene = street(folder / "scene")
    assert app.main(["export", "ros2", str(folder / "scene"), "--out", str(folder / "out")]) == 0
    return scene, folder


def test_a_bag_holds_the_log(exported: tuple[Scene, Path]) -> None:
    scene, folder = exported
    bag, about = read_bag(folder / "out")
    listed = {t["topic_metadata"]["name"]: t["message_count"] for t in about["topics_with_message_count"]}
    assert listed == {topic: len(messages) for topic, messages in bag.items()}
    assert about["message_count"] == sum(listed.values()) and about["duration"] == {"nanoseconds": 200_000_000}
    assert about["starting_time"] == {"nanoseconds_since_epoch": 10**9} and about["version"] == 5
    for frame, (moment, image) in zip(scene.frames, bag["/camera/front/image/compressed"], strict=True):
        assert image.data.tobytes() == (folder / "scene" / frame.image.path).read_bytes() and image.format == "png"
        stamp = image.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == moment == 10**9 + round((frame.view.time_s - 0.5) * 1e9)
    for sweep, (_, cloud) in zip(scene.sweeps, bag["/lidar/lidar/points"], strict=True):
        points = cloud.data.view("<f4").reshape(cloud.width, 4)
        truth = read_points(scene, sweep)
        assert np.array_equal(points[:, :3], truth.xyz) and np.array_equal(points[:, 3], truth.intensity)
        assert [(f.name, f.offset) for f in cloud.fields] == [("x", 0), ("y", 4), ("z", 8), ("intensity", 12)]
    (_, path), *more = bag["/ego/path"]
    assert not more and len(path.poses) == len(scene.ego.times_s)
    box = bag["/objects/detections"][1][1].detections[0]
    (result,), size = box.results, box.bbox.size
    assert (box.id, result.hypothesis.class_id, result.hypothesis.score) == ("car-1", "car", 1.0)
    assert (size.x, size.y, size.z) == (4.0, 2.0, 1.6) and box.bbox.center.position.x == pytest.approx(9.8)
    cube, name = bag["/objects/markers"][1][1].markers
    assert (cube.type, name.type, name.text) == (1, 9, "car-1 (car)") and cube.scale.x == 4.0


def test_one_file_holds_the_messages_of_the_bag(
    exported: tuple[Scene, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, folder = exported
    assert app.main(["export", "mcap", str(folder / "scene"), "--out", str(tmp_path / "a.mcap")]) == 0
    assert (tmp_path / "a.mcap").read_bytes() == (folder / "out" / "log_0.mcap").read_bytes()
    monkeypatch.setattr(ros2, "CHUNK_BYTES", 20_000)
    write_mcap(tmp_path / "b.mcap", ros2.Ros2Messages(LogRecords(scene)))
    with (tmp_path / "b.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        times = [message.log_time for _, _, message in reader.iter_messages(log_time_order=False)]
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None and len(summary.chunk_indexes) > 2
    assert summary.statistics.message_count == len(times) and times == sorted(times)


def test_points_of_the_world_fall_on_their_pixels_through_frames_and_calibration(exported: tuple[Scene, Path]) -> None:
    """As ROS computes it: map <- base_link <- camera by /tf and /tf_static, then OpenCV's pixels, whose centres are
    whole numbers."""
    scene, folder = exported
    bag, _ = read_bag(folder / "out")
    fixed = {t.child_frame_id: t for t in bag["/tf_static"][0][1].transforms}
    assert {t.header.frame_id for t in fixed.values()} == {"base_link"}
    for frame, (moment, info) in zip(scene.frames, bag["/camera/front/camera_info"], strict=True):
        (now,) = [m.transforms[0] for t, m in bag["/tf"] if t == moment]
        assert (now.header.frame_id, now.child_frame_id) == ("map", "base_link")
        camera = matrix(now.transform) @ matrix(fixed[info.header.frame_id].transform)
        point = frame.view.world_from_cam @ [0.4, 0.3, 5.0, 1.0]
        u, v, w = np.reshape(info.k, (3, 3)) @ (np.linalg.inv(camera) @ point)[:3]
        assert np.allclose([u / w + 0.5, v / w + 0.5], geometry.project(frame.view, point[None, :3])[0][0])
        assert info.distortion_model == "plumb_bob" and (info.width, info.height) == (24, 12)


def test_transforms_come_first_and_sensors_that_move_hang_on_the_map(tmp_path: Path) -> None:
    scene = street(tmp_path / "scene")
    late = replace(scene.frames[2].view, world_from_cam=scene.frames[2].view.world_from_cam @ geometry.yaw_matrix(0.1))
    moved = replace(scene, frames=(*scene.frames[:2], replace(scene.frames[2], view=late)))
    fused = PointCloud(np.ones((1, 3), np.float32), np.array([[1, 2, 3]], np.uint8), "world")
    messages = list(ros2.Ros2Messages(LogRecords(moved, fused)))
    order = [(m.time_s, not m.topic.startswith("/tf")) for m in messages]
    assert order == sorted(order)
    static = next(m.value() for m in messages if m.topic == "/tf_static")
    assert [t.child_frame_id for t in static.transforms] == ["lidar_lidar"]
    transforms = [t for m in messages if m.topic == "/tf" for t in m.value().transforms]
    free = [t for t in transforms if "camera" in t.child_frame_id]
    assert len(free) == 3 and np.allclose(matrix(free[2].transform), late.world_from_cam)
    points = next(m for m in messages if m.topic == "/points")
    assert points.value().data.view("<u4")[3] == 0x010203


def test_names_are_those_that_ros_accepts(exported: tuple[Scene, Path]) -> None:
    names = ros2.ros_names(["front", "CAM__front-left", "cam front left", "02", "", "ä"])
    assert list(names.values()) == ["front", "CAM_front_left", "cam_front_left", "n02", "sensor", "sensor_2"]
    scene = replace(exported[0], tracks=(replace(exported[0].tracks[0], label="a\0b"),))
    refused("zero byte", ros2.Ros2Messages, LogRecords(scene))


def test_the_same_log_gives_the_same_bag_in_bounded_memory(exported: tuple[Scene, Path], tmp_path: Path) -> None:
    scene, folder = exported
    first, read, log = (folder / "out" / "log_0.mcap").read_bytes(), [], LogRecords(scene)
    picture = log.picture
    log.picture = lambda frame: read.append(frame.id) or picture(frame)
    messages = ros2.Ros2Messages(log)
    assert list(messages) and not read  # a picture is read when its message is written
    write_mcap(tmp_path / "a.mcap", messages)
    assert (tmp_path / "a.mcap").read_bytes() == first and len(read) == 3
    assert app.main(["export", "ros2", str(folder / "scene"), "--out", str(folder / "out")]) == 0  # verified and reused
    assert (folder / "out" / "log_0.mcap").read_bytes() == first


@pytest.mark.parametrize(("name", "out", "package"), [("mcap", "a.mcap", "mcap"), ("ros2", "bag", "rosbags")])
def test_a_missing_package_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, out: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    for module in [key for key in sys.modules if key.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, module)
    street(tmp_path / "scene")
    step = Export(format=name, source=tmp_path / "scene", out=tmp_path / out, settings=ExportConfig())
    refused(r"mudg\[ros\]", step.run, raises=ResourceError)
    assert not (tmp_path / out).exists()
    assert app.main(["export", name, str(tmp_path / "scene"), "--out", str(tmp_path / "a.txt")]) != 0


def test_what_has_no_log_or_is_damaged_is_refused(tmp_path: Path) -> None:
    save_model(toy(), tmp_path / "fit")
    for name, out in (("ros2", "bag"), ("mcap", "a.mcap")):
        step = Export(format=name, source=tmp_path / "fit", out=tmp_path / out, settings=ExportConfig())
        refused("none is known here", step.run)
        assert not (tmp_path / out).exists()
    scene = street(tmp_path / "scene")
    (tmp_path / "scene" / scene.frames[1].image.path).unlink()
    step = Export(format="ros2", source=tmp_path / "scene", out=tmp_path / "bag", settings=ExportConfig())
    refused("missing", step.run, raises=MudgError)
    assert not (tmp_path / "bag" / "metadata.yaml").exists() and not (tmp_path / "bag" / "log_0.mcap").exists()
