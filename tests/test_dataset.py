"""Labelled data out of a reconstruction: boxes, masks and files, against the formats' own formulas and exact truth."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from roundtrip import needs_native
from toy_fitted import write_toy_run

import mudg
from mudg.base import geometry
from mudg.base.errors import ResourceError, UsageError
from mudg.base.types import Camera, View
from mudg.datasets import coco, kitti, write
from mudg.datasets.samples import LabelledView, Labeller, ObjectBox, around, outside
from mudg.datasets.settings import DatasetConfig
from mudg.datasets.tensors import as_dataset, collate
from mudg.sim.session import Session, Trust
from mudg.steps.dataset import Dataset

CAMERA = Camera("front", 160, 96, 120.0, 118.0, 79.0, 47.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    scene, fit, _, _ = write_toy_run(tmp_path_factory.mktemp("toy"))
    return scene, fit


def write_set(run: tuple[Path, Path], name: str, out: Path, **settings: object) -> Path:
    scene, fit = run
    return Dataset(format=name, run_folder=fit, scene=scene, out=out, settings=DatasetConfig(**settings)).run()


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
    line = kitti.label_line(box, LabelledView("x", view, {}, (box,), Trust(1.0, 0.0, 0.0)))
    kind, *words = line.split()
    truncated, hidden, alpha, _, _, _, _, h, w, length, cx, cy, cz, turn = map(float, words)
    c, s = math.cos(turn), math.sin(turn)
    corners = [(dx * length / 2, dy, dz * w / 2) for dx in (-1, 1) for dy in (0, -h) for dz in (-1, 1)]
    theirs = np.array([(c * a + s * b + cx, up + cy, -s * a + c * b + cz) for a, up, b in corners])
    calib = {line.split(":")[0]: line.split(":")[1] for line in kitti.calibration(CAMERA).splitlines()}
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
    lines = [json.loads(line) for line in (out / "provenance.jsonl").read_text().splitlines()]
    assert [line["view"].split("/")[0] for line in lines[:: len(lines) - 1]] == ["front_recorded", "front_shift+0.5"]
    number = next(index for index, line in enumerate(lines) if "car" in line["labels"])
    mudg.ingest(str(out), out=tmp_path / "back", sequence=f"{number:06d}", test_every=0)
    back = mudg.read_scene(tmp_path / "back")
    (frame,) = back.frames
    labelled = Labeller(Session(run[1], scene=run[0])).label("x", labelled_view(run, lines[number]), ("rgb",))
    written = np.asarray(Image.open(out / "image_2" / f"{number:06d}.png"))
    assert np.array_equal(labelled.layers["rgb"], written)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "back" / frame.image.path)), written)
    for box in (one for one in labelled.boxes if one.label == "car"):
        (track,) = (track for track in back.tracks if track.label.lower() == "car")
        mine = view_from_box(labelled.view, box.world_from_box)
        theirs = view_from_box(frame.view, track.world_from_object[0])
        assert np.abs(mine[:3, 3] - theirs[:3, 3]).max() < 1e-3
        assert np.abs(np.sort(track.size_m) - np.sort(box.size_m)).max() < 1e-3


def labelled_view(run: tuple[Path, Path], line: dict) -> View:
    scene = mudg.read_scene(run[0])
    return View(scene.cameras["front"], np.array(line["world_from_camera"]), line["time_s"])


def view_from_box(view: View, world_from_box: np.ndarray) -> np.ndarray:
    return view.cam_from_world @ world_from_box


def test_coco_agrees_with_its_panoptic_images(run: tuple[Path, Path], tmp_path: Path) -> None:
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


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
def test_pycocotools_reads_the_masks(run: tuple[Path, Path], tmp_path: Path) -> None:
    tools = pytest.importorskip("pycocotools.coco", reason="pycocotools is not installed")
    out = write_set(run, "coco", tmp_path / "coco", cameras=("front",), least_pixels=1)
    read = tools.COCO(str(out / "annotations/instances.json"))
    for one in read.anns.values():
        assert read.annToMask(one).sum() == one["area"]


def test_an_interrupted_data_set_equals_an_uninterrupted_one(
    run: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = write_set(run, "coco", tmp_path / "whole", cameras=("front",))
    label, calls = Labeller.label, []

    def interrupted(self: Labeller, *args: object) -> LabelledView:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return label(self, *args)

    monkeypatch.setattr(Labeller, "label", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_set(run, "coco", tmp_path / "resumed", cameras=("front",))
    resumed = write_set(run, "coco", tmp_path / "resumed", cameras=("front",))
    frames = len(json.loads((whole / "annotations/instances.json").read_text())["images"])
    assert len(calls) == frames + 1
    files = lambda folder: {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    apart = {Path("run.json"), Path("lock")}
    a, b = files(whole), files(resumed)
    assert {name for name in a.keys() | b.keys() if a.get(name) != b.get(name)} <= apart | {Path("manifest.json")}


def test_a_full_disk_is_said_before_anything_is_drawn(
    run: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr(write.shutil, "disk_usage", lambda folder: usage)
    with pytest.raises(ResourceError, match="too small"):
        write_set(run, "kitti", tmp_path / "out", cameras=("front",))


def test_objects_seen_from_unknown_sides_and_tiny_ones_are_left_out(run: tuple[Path, Path]) -> None:
    labeller = Labeller(Session(run[1], scene=run[0]))
    recorded = labeller.scene.frames_of("front")[1].view
    here = labeller.label("x", recorded, ("rgb",))
    (car,) = (box for box in here.boxes if box.label == "car")
    assert car.seen_from_deg < 0.1
    beside = recorded.world_from_cam.copy()
    beside[:3, 3] += [0.0, 6.0, 0.0]
    other = labeller.label("x", View(recorded.camera, beside, recorded.time_s), ("rgb",))
    moved = next((box for box in other.boxes if box.label == "car"), None)
    assert moved is None or moved.seen_from_deg > 10
    assert not write.wanted(here, DatasetConfig(least_pixels=100_000)).boxes
    strict = replace(here, boxes=(replace(car, seen_from_deg=80.0),))
    assert not write.wanted(strict, DatasetConfig(farthest_seen_deg=60.0, least_pixels=0)).boxes


def test_words_for_what_cannot_be(run: tuple[Path, Path], tmp_path: Path) -> None:
    scene, fit = run
    with pytest.raises(UsageError, match="no such data set format"):
        Dataset(format="voc", run_folder=fit, scene=scene, out=tmp_path / "a", settings=DatasetConfig()).run()
    with pytest.raises(UsageError, match="need the log"):
        Dataset(format="coco", run_folder=fit, out=tmp_path / "a", settings=DatasetConfig()).run()
    with pytest.raises(UsageError, match="camera"):
        write_set(run, "coco", tmp_path / "a", cameras=("rear",))
    assert not (tmp_path / "a").exists() or not any((tmp_path / "a").rglob("*.png"))


# -- tensors ---------------------------------------------------------------------------------------


def test_a_loader_with_workers_gives_what_indexing_gives(run: tuple[Path, Path]) -> None:
    scene, fit = run
    views = as_dataset(fit, scene, cameras="front", shifts_m=(0.0, 0.5), width_px=80, least_pixels=1)
    loader = torch.utils.data.DataLoader(views, batch_size=2, num_workers=2, collate_fn=collate)
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
    with pytest.raises(UsageError, match="camras"):
        as_dataset(fit, scene, camras="front")


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
    for path in labeller.paths(("front",), (2.0, -2.0)):
        for view in path.views[::6]:
            labelled, truth = labeller.label("x", view, ("instances",)), world.render(view)
            for box in labelled.boxes:
                exact = truth.instance == world.instance_of(box.track_id)
                if (
                    box.track_id not in labeller.session.sizes_m()
                    or exact.sum() < 200
                    or box.label not in ("car", "bus")
                ):
                    continue
                drawn = labelled.layers["instances"] == box.number
                masks.append((exact & drawn).sum() / (exact | drawn).sum())
                assert box.visible_px is not None
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
    run: tuple[Path, Path], tmp_path: Path
) -> None:
    out = write_set(run, "nuscenes", tmp_path / "nuscenes", cameras=("front",), shifts_m=(0.0, 0.5), least_pixels=1)
    tables = {path.stem: json.loads(path.read_text()) for path in (out / "v1.0-mini").glob("*.json")}
    known = {name: {row["token"]: row for row in rows} for name, rows in tables.items()}
    assert all(len(known[name]) == len(rows) for name, rows in tables.items())
    assert [scene["name"] for scene in tables["scene"]] == ["scene-recorded", "scene-shift+0.5"]
    for name, rows in tables.items():
        for row in rows:
            for key, value in row.items():
                target = key.removesuffix("_token")
                if key.endswith("_token") and target in known:
                    assert value in known[target], f"{name}.{key}"
                if key in ("prev", "next") and value:
                    assert known[name][value][{"prev": "next", "next": "prev"}[key]] == row["token"]
    lines = {line["view"]: line for line in map(json.loads, (out / "provenance.jsonl").read_text().splitlines())}
    matrix = lambda row: geometry.from_rotation_translation(
        geometry.matrix_from_quaternion(row["rotation"]), row["translation"]
    )
    for row in tables["sample_data"]:
        ego, mount = (
            known["ego_pose"][row["ego_pose_token"]],
            known["calibrated_sensor"][row["calibrated_sensor_token"]],
        )
        ending, _, index = row["filename"].removesuffix(".png").split("__")[1:]
        line = lines[f"front_{ending}/{index}"]
        assert np.abs(matrix(ego) @ matrix(mount) - np.array(line["world_from_camera"])).max() < 1e-9
        assert (out / row["filename"]).is_file()
        boxes = [one for one in tables["sample_annotation"] if one["sample_token"] == row["sample_token"]]
        places = sorted(tuple(np.round(one["translation"], 6)) for one in boxes)
        assert places == sorted(tuple(np.round(one["position_world_m"], 6)) for one in line["objects"])
