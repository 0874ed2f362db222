"""Labelled data out of a reconstruction: boxes, masks and files, against the formats' own formulas and exact truth."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from refusals import refused
from roundtrip import needs_native
from safetensors.numpy import load_file
from scipy.spatial import KDTree
from toy_fitted import write_toy_run

import mudg
from mudg.base import geometry
from mudg.base.errors import ResourceError, UsageError
from mudg.base.types import Camera, Scene, View
from mudg.core import trajectory
from mudg.datasets import coco, kitti, write
from mudg.datasets.samples import LabelledView, Labeller, ObjectBox, around, outside
from mudg.datasets.settings import DatasetConfig
from mudg.datasets.tensors import as_dataset, collate
from mudg.sim.returns import learn_returns
from mudg.sim.session import Session, Trust
from mudg.steps.export import Dataset

CAMERA = Camera("front", 160, 96, 120.0, 118.0, 79.0, 47.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    scene, fit, _, _ = write_toy_run(tmp_path_factory.mktemp("toy"))
    return scene, fit


def write_set(run: tuple[Path, Path], name: str, out: Path, path: Path | None = None, **settings: object) -> Path:
    scene, fit = run
    chosen = DatasetConfig(**settings)
    return Dataset(format=name, runs=(fit,), scene=scene, path=path, out=out, settings=chosen).run()


def provenance(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "provenance.jsonl").read_text().splitlines()]


@functools.cache
def labeller_of(run: tuple[Path, Path], lidar: str = "") -> Labeller:
    return Labeller(Session(run[1], scene=run[0]), lidar)


@pytest.fixture(scope="module", autouse=True)
def _learnt_once() -> Iterator[None]:
    """What the sweeps of a log tell is learnt once for all tests, because it takes seconds."""
    kept: dict[str, Any] = {}

    def learn(scene: Scene, *more: Any) -> Any:
        if scene.root not in kept:
            kept[scene.root] = learn_returns(scene, *more)
        return kept[scene.root]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mudg.sim.session.learn_returns", learn)
        yield


@pytest.fixture(scope="module")
def lidar(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A small LiDAR, as a file of beams."""
    file = tmp_path_factory.mktemp("beams") / "small.json"
    file.write_text(json.dumps({"elevations_deg": list(range(-15, 1)), "azimuth_step_deg": 1.0}))
    return str(file)


# -- formats ---------------------------------------------------------------------------------------


@given(arrays(bool, st.tuples(st.integers(1, 7), st.integers(1, 7))))
def test_run_lengths_give_back_the_mask(mask: np.ndarray) -> None:
    counts, flat, value = coco.run_lengths(mask), [], False
    for count in counts:
        flat += [value] * count
        value = not value
    assert np.array_equal(np.array(flat).reshape(mask.T.shape).T, mask)


def box_at(x: float, y: float, yaw: float) -> ObjectBox:
    pose = geometry.yaw_matrix(yaw, (x, y, 0.8))
    return ObjectBox("car-1", "car", 1, pose, (4.2, 1.8, 1.6), (0, 0, 10, 10), (0, 0, 10, 10), 100, 0.3, 0.0, 5.0)


@pytest.mark.parametrize(("x", "y", "yaw"), [(10.0, 0.0, 0.0), (14.0, 3.0, 0.9), (9.0, -2.0, -2.4), (20.0, 1.0, 3.1)])
def test_a_label_of_kitti_is_the_box_by_its_own_formula(x: float, y: float, yaw: float) -> None:
    """The development kit's corners, turned about the camera's y axis, fall on the projected corners of our box."""
    world_from_cam = geometry.yaw_matrix(0.0, (1.0, 0.2, 1.5)) @ geometry.invert(geometry.CAM_FROM_EGO_AXES)
    view, box = View(CAMERA, world_from_cam, 0.0), box_at(x, y, yaw)
    labelled = LabelledView("x", view, {}, (box,), Trust(1.0, 0.0, 0.0))
    line = kitti.label_line(box, labelled, "0.00")
    kind, *words = line.split()
    truncated, hidden, alpha, _, _, _, _, h, w, length, cx, cy, cz, turn = map(float, words)
    c, s = math.cos(turn), math.sin(turn)
    corners = [(dx * length / 2, dy, dz * w / 2) for dx in (-1, 1) for dy in (0, -h) for dz in (-1, 1)]
    theirs = np.array([(c * a + s * b + cx, up + cy, -s * a + c * b + cz) for a, up, b in corners])
    calib = {line.split(":")[0]: line.split(":")[1] for line in kitti.calibration(labelled, {}).splitlines()}
    p2 = np.array(calib["P2"].split(), float).reshape(3, 4)
    uvw = np.column_stack([theirs, np.ones(8)]) @ p2.T
    ours, _ = geometry.project(view, geometry.transform_points(box.world_from_box, geometry.box_corners(box.size_m)))
    found = uvw[:, :2] / uvw[:, 2:] + 0.5
    apart = np.linalg.norm(found[:, None] - ours[None], axis=2)
    assert apart.min(1).max() < 0.1 and apart.min(0).max() < 0.1
    assert (kind, truncated, hidden) == ("Car", 0.0, 1.0)
    assert math.cos(alpha - (turn - math.atan2(cx, cz))) == pytest.approx(1.0, abs=1e-3)


def test_rectangles_and_truncation() -> None:
    mask = np.zeros((10, 12), bool)
    mask[3:6, 2:9] = True
    assert around(mask) == (2.0, 3.0, 9.0, 6.0)
    assert outside((-10.0, 0.0, 10.0, 10.0), CAMERA) == pytest.approx(0.5)
    assert outside((10.0, 10.0, 20.0, 20.0), CAMERA) == 0.0


# -- data sets -------------------------------------------------------------------------------------


def test_kitti_is_read_again_with_the_same_pixels_and_boxes(run: tuple[Path, Path], tmp_path: Path) -> None:
    out = write_set(run, "kitti", tmp_path / "kitti", cameras=("front",), shifts_m=(0.0, 0.5), least_pixels=1)
    lines = provenance(out)
    assert [line["view"].split("/")[0] for line in lines[:: len(lines) - 1]] == ["front_recorded", "front_shift+0.5"]
    number = next(index for index, line in enumerate(lines) if "car" in line["labels"])
    mudg.ingest(str(out), out=tmp_path / "back", sequence=f"{number:06d}", test_every=0)
    back = mudg.read_scene(tmp_path / "back")
    (frame,) = back.frames
    labelled = labeller_of(run).label("x", labelled_view(run, lines[number]), ("rgb",))
    written = np.asarray(Image.open(out / "image_2" / f"{number:06d}.png"))
    assert np.array_equal(labelled.layers["rgb"], written)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "back" / frame.image.path)), written)
    for box in (one for one in labelled.boxes if one.label == "car"):
        (track,) = (track for track in back.tracks if track.label.lower() == "car")
        mine = labelled.view.cam_from_world @ box.world_from_box
        theirs = frame.view.cam_from_world @ track.world_from_object[0]
        assert np.abs(mine[:3, 3] - theirs[:3, 3]).max() < 1e-3
        assert np.abs(np.sort(track.size_m) - np.sort(box.size_m)).max() < 1e-3


def labelled_view(run: tuple[Path, Path], line: dict) -> View:
    scene = mudg.read_scene(run[0])
    return View(scene.cameras["front"], np.array(line["world_from_camera"]), line["time_s"])


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
def test_coco_agrees_with_its_panoptic_images_and_pycocotools_reads_its_masks(
    run: tuple[Path, Path], tmp_path: Path
) -> None:
    out = write_set(run, "coco", tmp_path / "coco", cameras=("front",), least_pixels=1)
    instances = json.loads((out / "annotations/instances.json").read_text())
    panoptic = json.loads((out / "annotations/panoptic.json").read_text())
    names = {one["id"]: one["name"] for one in instances["categories"]}
    assert len(names) == 19 and {names[one["category_id"]] for one in instances["annotations"]} >= {"car"}
    assert len({one["id"] for one in instances["annotations"]}) == len(instances["annotations"])
    for image in panoptic["annotations"]:
        rgb = np.asarray(Image.open(out / "panoptic" / image["file_name"])).astype(int)
        ids = rgb[..., 0] + 256 * rgb[..., 1] + 65536 * rgb[..., 2]
        assert set(np.unique(ids)) - {0} == {one["id"] for one in image["segments_info"]}
        for segment in image["segments_info"]:
            ys, xs = np.nonzero(ids == segment["id"])
            assert segment["area"] == len(xs)
            assert segment["bbox"] == [xs.min(), ys.min(), np.ptp(xs) + 1, np.ptp(ys) + 1]
    tools = pytest.importorskip("pycocotools.coco", reason="pycocotools is not installed")
    read = tools.COCO(str(out / "annotations/instances.json"))
    assert all(read.annToMask(one).sum() == one["area"] for one in read.anns.values())


def test_a_sequence_of_kitti_is_read_again_with_its_poses_tracks_and_scans(
    run: tuple[Path, Path], lidar: str, tmp_path: Path
) -> None:
    chosen = {"cameras": ("front",), "shifts_m": (0.0, 0.5), "every": 4, "least_pixels": 1, "lidar": lidar}
    out = write_set(run, "kitti-tracking", tmp_path / "kitti", **chosen)
    assert (out / "ImageSets/train.txt").read_text().split() == ["0000", "0001"]
    mudg.ingest(str(out), out=tmp_path / "back", sequence="0001", test_every=0)
    back = mudg.read_scene(tmp_path / "back")
    lines = provenance(out)
    lines = [line for line in lines if line["view"].startswith("front_shift")]
    theirs = [frame.view.world_from_cam for frame in back.frames_of(next(iter(back.cameras)))]
    mine = [np.array(line["world_from_camera"]) for line in lines]
    assert len(theirs) == len(mine) == len(back.sweeps)
    for a, b in zip(theirs, mine, strict=True):
        assert np.abs(geometry.invert(theirs[0]) @ a - geometry.invert(mine[0]) @ b).max() < 1e-3
    ids = {track.label.lower(): track for track in back.tracks}
    for index, line in enumerate(lines):
        for box in (one for one in line["objects"] if one["label"] == "car"):
            pose = ids["car"].pose_at(back.frames[index].view.time_s)
            there = geometry.invert(mine[index])[:3] @ np.array([*box["position_world_m"], 1.0])
            assert np.abs(there - (geometry.invert(theirs[index]) @ pose)[:3, 3]).max() < 1e-3
    again = labeller_of(run, lidar).label("x", labelled_view(run, lines[0]), ("rgb",)).sweep
    points = mudg.read_points(back, back.sweeps[0])
    assert again is not None and len(points.xyz) == len(again.reply.xyz) > 50
    ours = geometry.invert(mine[0]) @ again.world_from_lidar
    read = geometry.invert(theirs[0]) @ back.sweeps[0].world_from_lidar
    assert np.abs(ours - read).max() < 1e-3
    assert np.abs(points.xyz - again.reply.xyz).max() < 1e-3


def test_returns_lie_on_what_the_log_measured_and_are_counted_by_box(run: tuple[Path, Path]) -> None:
    labeller = labeller_of(run, "hdl64")
    scene, view = labeller.scene, labeller.scene.frames_of("front")[2].view
    labelled = labeller.label("x", view, ("rgb",))
    world = geometry.transform_points(labelled.sweep.world_from_lidar, labelled.sweep.reply.xyz.astype(float))
    (recorded,) = (sweep for sweep in scene.sweeps if abs(sweep.time_s - view.time_s) < 1e-6)
    measured = geometry.transform_points(recorded.world_from_lidar, mudg.read_points(scene, recorded).xyz.astype(float))
    apart, _ = KDTree(world).query(measured)
    assert np.median(apart) < 0.15
    for box in labelled.boxes:
        local = geometry.transform_points(geometry.invert(box.world_from_box), world)
        assert abs(box.returns - (np.abs(local) <= np.array(box.size_m) / 2).all(1).sum()) <= 1
    assert max(box.returns for box in labelled.boxes) > 10


def test_drives_of_one_split_share_no_list_with_those_of_the_other(run: tuple[Path, Path], tmp_path: Path) -> None:
    scene, fit = run
    drives = [write.LabelledDrive(name, fit, scene, split=split) for name, split in (("a", "train"), ("b", "val"))]
    for name in ("kitti", "coco", "nuscenes"):
        folder, chosen = tmp_path / name, DatasetConfig(cameras=("front",), every=2)
        folder.mkdir()
        assert write.write_dataset(name, chosen, drives, SimpleNamespace(path=folder))["images"] == 6
    lists = {split: (tmp_path / f"kitti/ImageSets/{split}.txt").read_text().split() for split in ("train", "val")}
    assert (lists["train"], lists["val"]) == ([f"{n:06d}" for n in range(3)], [f"{n:06d}" for n in range(3, 6)])
    for number, split in enumerate(("train", "val")):
        images = json.loads((tmp_path / f"coco/annotations/instances_{split}.json").read_text())["images"]
        assert [image["id"] for image in images] == list(range(3 * number, 3 * number + 3))
    splits = json.loads((tmp_path / "nuscenes/splits.json").read_text())
    assert splits == {"train": ["scene-a-recorded"], "val": ["scene-b-recorded"]}


def test_a_path_of_your_own_stands_for_the_shifts(run: tuple[Path, Path], lidar: str, tmp_path: Path) -> None:
    scene = mudg.read_scene(run[0])
    poses = [frame.view.world_from_cam.copy() for frame in scene.frames_of("front")[1:3]]
    for pose in poses:
        pose[:3, 3] += [0.0, 0.7, 0.4]
    file = tmp_path / "drone.txt"
    file.write_text("".join(" ".join(map(repr, pose[:3].ravel().tolist())) + "\n" for pose in poses))
    out = write_set(run, "coco", tmp_path / "coco", file, cameras=("front",), fov_deg=70.0)
    lines = provenance(out)
    assert [line["view"] for line in lines] == ["drone/000000", "drone/000001"]
    assert np.abs(np.array([line["world_from_camera"] for line in lines]) - poses).max() < 1e-9
    views = as_dataset(run[1], run[0], path=file, cameras="front", fov_deg=70.0, lidar=lidar)
    first, second = views[0], views[1]
    focal = second["intrinsics"][0, 0].item()
    assert 2 * math.degrees(math.atan(second["rgb"].shape[2] / 2 / focal)) == pytest.approx(70.0, abs=1e-3)
    batch = collate([first, second])
    assert [len(points) for points in batch["points"]] == [len(one["points"]) for one in (first, second)]
    assert batch["points"][0].shape[1] == 4 and batch["world_from_lidar"].shape == (2, 4, 4)


def test_its_own_reader_loads_123d(run: tuple[Path, Path], tmp_path: Path) -> None:
    pytest.importorskip("py123d", reason="py123d is not installed")
    from py123d.api.scene.arrow.arrow_scene_builder import ArrowSceneBuilder
    from py123d.api.scene.scene_filter import SceneFilter
    from py123d.common.execution.sequential_executor import SequentialExecutor
    from py123d.datatypes.sensors import CameraID, LidarID

    out = write_set(run, "py123d", tmp_path / "d", cameras=("front",), shifts_m=(0.5,), least_pixels=1, lidar="vlp16")
    assert {path.name for path in out.iterdir()} >= {"logs", "provenance.jsonl"} and not (out / "samples").exists()
    builder = ArrowSceneBuilder(out / "logs", tmp_path)
    (scene,) = builder.get_scenes(SceneFilter(iteration_threshold=100), SequentialExecutor())
    lines = provenance(out)
    labeller = labeller_of(run, "vlp16")
    assert scene.number_of_iterations == len(lines)
    for index, line in enumerate(lines):
        labelled = labeller.label("x", labelled_view(run, line), ("rgb",))
        camera = scene.get_camera_at_iteration(index, CameraID.PCAM_F0)
        assert np.array_equal(camera.image, labelled.layers["rgb"])
        assert np.abs(camera.camera_to_global_se3.transformation_matrix - labelled.view.world_from_cam).max() < 1e-6
        boxes = {box.attributes.track_token: box for box in scene.get_box_detections_se3_at_iteration(index)}
        assert boxes.keys() == {one["id"] for one in line["objects"]}
        for one in line["objects"]:
            center = boxes[one["id"]].bounding_box_se3.center_se3
            assert np.abs(np.array([center.x, center.y, center.z]) - one["position_world_m"]).max() < 1e-6
        lidar = scene.get_lidar_at_iteration(index, LidarID.LIDAR_TOP)
        vehicle = labelled.view.world_from_cam @ geometry.invert(labelled.mount)
        ours = geometry.transform_points(labelled.sweep.world_from_lidar, labelled.sweep.reply.xyz.astype(float))
        assert np.abs(geometry.transform_points(vehicle, lidar.xyz.astype(float)) - ours).max() < 1e-3


def test_an_interrupted_data_set_equals_an_uninterrupted_one(
    run: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = {"cameras": ("front",), "every": 2}
    whole = write_set(run, "coco", tmp_path / "whole", **chosen)
    label, calls = Labeller.label, []

    def interrupted(self: Labeller, *args: object, **more: object) -> LabelledView:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return label(self, *args, **more)

    monkeypatch.setattr(Labeller, "label", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_set(run, "coco", tmp_path / "resumed", **chosen)
    resumed = write_set(run, "coco", tmp_path / "resumed", **chosen)
    frames = len(json.loads((whole / "annotations/instances.json").read_text())["images"])
    assert len(calls) == frames + 1
    a, b = (
        {p.relative_to(out).as_posix(): p.read_bytes() for p in out.rglob("*") if p.is_file()}
        for out in (whole, resumed)
    )
    apart = {name for name in a.keys() | b.keys() if a.get(name) != b.get(name)}
    assert apart <= {"run.json", "lock", "manifest.json"}


def test_a_full_disk_is_said_before_anything_is_drawn(
    run: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr(write.shutil, "disk_usage", lambda folder: usage)
    refused("too small", write_set, run, "kitti", tmp_path / "out", cameras=("front",), raises=ResourceError)


def test_objects_seen_from_unknown_sides_and_tiny_ones_are_left_out(run: tuple[Path, Path]) -> None:
    labeller = labeller_of(run)
    recorded = labeller.scene.frames_of("front")[1].view
    here = labeller.label("x", recorded, ("rgb",))
    (car,) = (box for box in here.boxes if box.label == "car")
    assert car.seen_from_deg < 0.1
    beside = recorded.world_from_cam.copy()
    beside[:3, 3] += [0.0, 6.0, 0.0]
    other = labeller.label("x", View(recorded.camera, beside, recorded.time_s), ("rgb",))
    moved = next((box for box in other.boxes if box.label == "car"), None)
    assert moved is None or moved.seen_from_deg > 10
    assert not here.wanted(DatasetConfig(least_pixels=100_000)).boxes
    strict = replace(here, boxes=(replace(car, seen_from_deg=80.0),))
    assert not strict.wanted(DatasetConfig(farthest_seen_deg=60.0, least_pixels=0)).boxes


def test_words_for_what_cannot_be(run: tuple[Path, Path], tmp_path: Path) -> None:
    scene, fit = run
    usual = {"format": "coco", "runs": (fit,), "scene": scene, "settings": DatasetConfig()}
    for changes, said in (
        ({"format": "voc"}, "no such data set format"),
        ({"scene": None}, "need the log"),
        ({"runs": (fit, fit)}, "belongs to one drive"),
        ({"settings": DatasetConfig(lidar="hdl65")}, "no such LiDAR"),
        ({"settings": DatasetConfig(cameras=("rear",))}, "camera"),
    ):
        refused(said, Dataset(**{**usual, **changes}, out=tmp_path / "a").run, raises=UsageError)
    assert not (tmp_path / "a").exists() or not any((tmp_path / "a").rglob("*.png"))


# -- tensors ---------------------------------------------------------------------------------------


def test_a_loader_with_workers_gives_what_indexing_gives(run: tuple[Path, Path]) -> None:
    scene, fit = run
    views = as_dataset(fit, scene, cameras="front", shifts_m=(0.0, 0.5), width_px=80, least_pixels=1)
    loader = torch.utils.data.DataLoader(views, batch_size=2, num_workers=1, collate_fn=collate)
    index = 0
    for batch in loader:
        for row in range(len(batch["name"])):
            alone = views[index]
            assert batch["name"][row] == alone["name"]
            for name in ("rgb", "depth", "classes", "instances", "confidence", "world_from_cam"):
                assert torch.equal(batch[name][row], alone[name])
            assert torch.equal(batch["boxes_2d"][row], alone["boxes_2d"])
            for number, box in zip(alone["numbers"], alone["boxes_2d"], strict=True):
                ys, xs = torch.nonzero(alone["instances"] == number, as_tuple=True)
                assert box.tolist() == [xs.min(), ys.min(), xs.max() + 1, ys.max() + 1]
            index += 1
    assert index == len(views)
    with pytest.raises(IndexError):
        views[len(views)]
    refused("camras", as_dataset, fit, scene, camras="front", raises=UsageError)


# -- exact truth -----------------------------------------------------------------------------------


@pytest.mark.slow
@needs_native
def test_masks_and_boxes_beside_the_path_are_those_of_the_city(tmp_path: Path) -> None:
    """2 m beside the path, against exact instance images: vehicles with Gaussians of their own and 200 pixels."""
    from mudg.city.world import CityWorld

    city = {"seed": 5, "n_frames": 20, "width": 384, "height": 256}
    mudg.ingest("city", out=tmp_path / "scene", city=city)
    mudg.fuse(tmp_path / "scene", out=tmp_path / "fused")
    mudg.fit(tmp_path / "scene", tmp_path / "fused", out=tmp_path / "fit", method="street_gaussians", iterations=300)
    labeller = Labeller(Session(tmp_path / "fit", scene=tmp_path / "scene"))
    world = CityWorld.from_source(labeller.scene.source)
    masks, boxes, hidden = [], [], []
    for path in (trajectory.shifted(labeller.scene, "front", shift) for shift in (2.0, -2.0)):
        for view in path.views[::6]:
            labelled, truth = labeller.label("x", view, ("instances",)), world.render(view)
            for box in labelled.boxes:
                exact = truth.instance == world.instance_of(box.track_id)
                own = box.track_id in labeller.session.sizes_m()
                if not own or exact.sum() < 200 or box.label not in ("car", "bus"):
                    continue
                drawn = labelled.layers["instances"] == box.number
                masks.append((exact & drawn).sum() / (exact | drawn).sum())
                boxes.append(overlap(box.visible_px, around(exact)))
                others = {track.id: None for track in world.tracks() if track.id != box.track_id}
                alone = world.rearranged(others).render(view).instance == world.instance_of(box.track_id)
                hidden.append(abs(box.occlusion - (1 - exact.sum() / alone.sum())))
    assert len(masks) >= 8
    assert np.mean(masks) > 0.8
    assert np.mean(np.array(boxes) >= 0.7) >= 0.95
    assert np.mean(hidden) < 0.1


def overlap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    both = max(width, 0) * max(height, 0)
    return both / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - both)


def test_nuscenes_tables_refer_to_each_other_and_boxes_lie_where_they_are(
    run: tuple[Path, Path], lidar: str, tmp_path: Path
) -> None:
    chosen = {"cameras": ("front",), "shifts_m": (0.0, 0.5), "every": 4, "least_pixels": 1, "lidar": lidar}
    out = write_set(run, "nuscenes", tmp_path / "nuscenes", **chosen)
    tables = {path.stem: json.loads(path.read_text()) for path in (out / "v1.0-mini").glob("*.json")}
    known = {name: {row["token"]: row for row in rows} for name, rows in tables.items()}
    assert all(len(known[name]) == len(rows) for name, rows in tables.items())
    drive = run[1].name
    scenes = [f"scene-{drive}-recorded", f"scene-{drive}-shift+0.5"]
    assert [scene["name"] for scene in tables["scene"]] == scenes
    assert json.loads((out / "splits.json").read_text()) == {"train": scenes}
    for name, rows in tables.items():
        for row in rows:
            for key, value in row.items():
                target = key.removesuffix("_token")
                if key.endswith("_token") and target in known:
                    assert value in known[target], f"{name}.{key}"
                if key in ("prev", "next") and value:
                    assert known[name][value][{"prev": "next", "next": "prev"}[key]] == row["token"]
    lines = {line["view"]: line for line in provenance(out)}
    matrix = lambda row: geometry.from_rotation_translation(
        geometry.matrix_from_quaternion(row["rotation"]), row["translation"]
    )
    for row in tables["sample_data"]:
        ego = known["ego_pose"][row["ego_pose_token"]]
        mount = known["calibrated_sensor"][row["calibrated_sensor_token"]]
        cloud = row["fileformat"] == "pcd"
        assert (out / row["filename"]).is_file() and cloud == ("LIDAR_TOP" in row["filename"])
        if cloud:
            rows = np.fromfile(out / row["filename"], "<f4").reshape(-1, 5)
            assert len(rows) > 50 and 0 <= rows[:, 3].min() <= rows[:, 3].max() <= 255
            continue
        ending, _, index = row["filename"].removesuffix(".png").split("__")[1:]
        line = lines[f"front_{ending.removeprefix(drive + '-')}/{index}"]
        assert np.abs(matrix(ego) @ matrix(mount) - np.array(line["world_from_camera"])).max() < 1e-9
        boxes = [one for one in tables["sample_annotation"] if one["sample_token"] == row["sample_token"]]
        places = sorted(tuple(np.round(one["translation"], 6)) for one in boxes)
        assert places == sorted(tuple(np.round(one["position_world_m"], 6)) for one in line["objects"])


# -- layers and paths ------------------------------------------------------------------------------


def test_layers_of_render_are_those_of_the_views_and_say_how_far_to_trust_them(
    run: tuple[Path, Path], tmp_path: Path
) -> None:
    scene, fit = run
    names = ("instances", "normals", "motion", "distance", "confidence")
    out = mudg.render(scene, fit, out=tmp_path / "r", shifts_m=(0.0, 0.5), layers=names, video=False)
    labeller = labeller_of(run)
    for folder in ("front_recorded", "front_shift+0.5"):
        index = json.loads((out / "layers" / folder / "layers.json").read_text())
        assert list(index["objects"].values()) == list(labeller.names)
        depths = mudg.read_observations(out / folder)
        for number, view in enumerate(index["views"]):
            arrays = load_file(out / "layers" / folder / view["file"])
            assert set(arrays) == set(names) - ({"motion"} if number == len(depths) - 1 else set())
            picture = np.asarray(Image.open(out / "layers" / folder / f"{number:06d}_instances.png"))
            assert picture.dtype == np.uint16 and np.array_equal(picture, arrays["instances"])
            length = np.linalg.norm(arrays["normals"], axis=2)
            assert np.nanmax(np.abs(length - 1)) < 1e-4
            pixels = {box["number"]: box["pixels"] for box in view["boxes"]}
            assert all((arrays["instances"] == number).sum() == count for number, count in pixels.items())
            depth = depths[number].depth[0].numpy()
            seen = np.isfinite(depth) & np.isfinite(arrays["distance"])
            assert (arrays["distance"][seen] >= depth[seen] - 1e-3).all()
            assert 0 <= view["trust"]["determined"] <= 1


def test_a_scene_in_memory_is_filmed_saved_and_exported_with_its_edits(run: tuple[Path, Path], tmp_path: Path) -> None:
    scene, fitted = mudg.read_scene(run[0]), mudg.FittedScene.read(run[1])
    path = mudg.camera_path(scene, mudg.Camera.from_fov("mine", 64, 48, 80.0), shift_m=0.5)
    pictures = list(fitted.render_path(path))
    assert [picture.rgb.shape for picture in pictures] == [(48, 64, 3)] * len(path)
    assert fitted.film(path, tmp_path / "film.mp4").stat().st_size > 1000
    (car,) = (name for name in fitted.object_ids if name.startswith("car"))
    empty = fitted.without(car)
    now = path.views[1]
    assert len(empty.gaussians(now.time_s).means) < len(fitted.gaussians(now.time_s).means) == len(fitted)
    saved = mudg.FittedScene.read(empty.save(tmp_path / "saved"))
    again, before = (one.render(now.camera, now.world_from_cam, now.time_s) for one in (saved, empty))
    assert np.array_equal(again.rgb, before.rgb) and car not in saved.object_ids
    refused("there already", empty.save, tmp_path / "saved", raises=UsageError)
    files = [one.export("ply", tmp_path / f"{len(one)}.ply", time_s=now.time_s) for one in (fitted, empty)]
    assert files[0].stat().st_size > files[1].stat().st_size
    refused("no export format", fitted.export, "obj", tmp_path / "x.obj", raises=UsageError)
    above = mudg.camera_path(scene, name="up+1.0").views[0].center_world[2]
    assert above == pytest.approx(scene.frames_of("front")[0].view.center_world[2] + 1.0)
