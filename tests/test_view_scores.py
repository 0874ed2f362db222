"""Scores that need more than a true image: LiDAR points, detectors, vehicles, markings, motion; anchors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import toy_world
from refusals import refused

from mudg.base import store
from mudg.base.types import Camera, Observation, Scene, Track, View
from mudg.city.config import CityConfig
from mudg.city.logs import write_city
from mudg.city.world import CityWorld
from mudg.core import metrics, trajectory
from mudg.core.metrics import Pair, ViewFacts
from mudg.core.street_scores import nta_truths
from mudg.editing.settings import ScoreConfig
from mudg.scene.observations import ObservationWriter
from mudg.scene.read import read_scene
from mudg.scoring import detections
from mudg.scoring import tables as score_tables
from mudg.steps.render import DrawTruth, Score

HERE = "front_shift+2.0"
QUICK = ScoreConfig(perceptual_views=0, error_pictures=False)
Look = Callable[[View], Observation]


def written(scene: Scene, out: Path, look: Look, shifts_m: tuple[float, ...] = (2.0,)) -> Path:
    """Views of a scene as something sees them."""
    for shift_m in shifts_m:
        path = trajectory.shifted(scene, "front", shift_m) if shift_m else trajectory.recorded(scene, "front")
        with ObservationWriter(out / path.name, path.name, out.name) as writer:
            for view in path.views:
                writer.add(look(view))
    return out


def scored(scene: Path, views: dict[str, Path], out: Path, config: ScoreConfig = QUICK, **truth: Path) -> dict:
    return store.read_json(Score(scene=scene, views=views, **truth, out=out, settings=config).run() / "metrics.json")


def value(document: dict, method: str, trajectory: str, metric: str) -> object:
    (row,) = (r for r in document["results"] if (r["method"], r["trajectory"]) == (method, trajectory))
    return row["values"][metric]


def anchors(document: dict, trajectory: str, metric: str) -> dict:
    (found,) = (a for a in document["anchors"] if (a["trajectory"], a["metric"]) == (trajectory, metric))
    return found


def farther(seen: Observation) -> Observation:
    return dataclasses.replace(seen, depth=seen.depth * 1.1)


def gray(seen: Observation) -> Observation:
    return dataclasses.replace(seen, rgb=torch.full_like(seen.rgb, 0.4), semantics=torch.zeros_like(seen.semantics))


METHODS = {"right": lambda seen: seen, "far": farther, "gray": gray}


# ---- a log: no exact truth -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def log_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("log") / "scene"
    toy_world.write_scene(root, frames=4, width=192, height=128)
    return root


@pytest.fixture(scope="module")
def log_scores(log_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict:
    folder, scene = tmp_path_factory.mktemp("scores"), read_scene(log_scene)
    looks = {name: lambda view, change=change: change(toy_world.truth(view)) for name, change in METHODS.items()}
    methods = {name: written(scene, folder / name, look, (0.0, 2.0)) for name, look in looks.items()}
    return scored(log_scene, methods, folder / "score")


def test_lidar_points_measure_depth_and_color_beside_the_path_of_a_log(log_scores: dict) -> None:
    # measured 0.007: a point is not at its pixel's centre
    assert value(log_scores, "right", HERE, "lidar_abs_rel") < 0.02
    assert value(log_scores, "far", HERE, "lidar_abs_rel") == pytest.approx(0.1, abs=0.01)
    assert value(log_scores, "far", HERE, "lidar_delta1") > 0.95
    assert value(log_scores, "right", HERE, "lidar_psnr") > 18  # measured 21.6: edges
    assert value(log_scores, "gray", HERE, "lidar_psnr") < 16


def test_classes_and_lanes_of_a_log_are_carried_over_by_points_and_ground(log_scores: dict) -> None:
    for here in ("front_recorded", HERE):
        assert value(log_scores, "right", here, "agreement") > 0.8
        assert value(log_scores, "gray", here, "agreement") < 0.35
    assert "agreement" in {anchor["metric"] for anchor in log_scores["anchors"]}
    assert value(log_scores, "right", HERE, "lane_correlation") > 0.8
    assert value(log_scores, "right", HERE, "lane_psnr") > 20 > 15 > value(log_scores, "gray", HERE, "lane_psnr")
    for metric in ("psnr", "lane_iou", "agent_iou", "warp_error"):  # nobody marked the lanes
        assert value(log_scores, "right", HERE, metric) == score_tables.NO_TRUTH


def test_a_still_video_does_not_flicker_and_missing_files_name_their_flags(log_scores: dict) -> None:
    assert value(log_scores, "gray", HERE, "temporal_flickering") == 1.0
    assert 0.8 < value(log_scores, "right", HERE, "temporal_flickering") < 0.99
    text = score_tables.markdown(log_scores)
    for flag in "detections lanes lpips-vgg-weights".split():
        assert f"--{flag}" in text


@pytest.mark.parametrize(
    ("confidence", "category", "expected", "cars"), [(0.9, 2, 1.0, 1.0), (0.5, 2, 0.0, 0.0), (0.9, 7, 1.0, 0.0)]
)
def test_nta_iou_from_a_file_of_boxes(
    tmp_path: Path, log_scene: Path, confidence: float, category: int, expected: float, cars: float
) -> None:
    """What a perfect detector would say of a method's views and of the recorded images."""
    scene, boxes, records = read_scene(log_scene), tmp_path / "boxes.json", []
    views = written(scene, tmp_path / "right", toy_world.truth)
    shifted, recorded = trajectory.shifted(scene, "front", 2.0), trajectory.recorded(scene, "front")
    for prefix, path in ((f"right/{HERE}", shifted), ("recorded/front", recorded)):
        for number, view in enumerate(path.views):
            for _, box in nta_truths(view, scene.tracks):
                x, y, right, bottom = box.tolist()
                record = {"image_id": f"{prefix}/rgb/{number:06d}.png", "category_id": category, "score": confidence}
                records.append({**record, "bbox": [x, y, right - x, bottom - y]})
    store.write_json(boxes, records)
    config = dataclasses.replace(QUICK, detections=str(boxes))
    document = scored(log_scene, {"right": views, "other": views}, tmp_path / "score", config)
    (row,) = (r for r in document["results"] if r["method"] == "right")
    assert row["values"]["nta_iou"] == pytest.approx(expected)
    assert row["nta"]["car_and_bus"] == pytest.approx(cars)
    assert row["nta"]["truths"] >= 2
    assert value(document, "other", HERE, "nta_iou") == score_tables.NO_DETECTIONS
    assert anchors(document, HERE, "nta_iou")["recorded"] == pytest.approx(expected)
    made = document["detections"]["nta_iou"]
    assert made["fewest_points"] == 10 and made["file_sha256"] == store.sha256_file(boxes)
    assert any("cut at the near plane" in rule for rule in document["rules"])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"boxes": []}, "no list"),
        ([{"image_id": "a", "category_id": 2, "bbox": [1, 2, 3], "score": 1}], "record 0"),
        ([{"image_id": "a", "category_id": 2, "bbox": [1, 2, -3, 4], "score": 1}], "impossible"),
        ([{"image_id": "a", "category_id": 2, "bbox": [1, 2, 3, 4], "score": 7}], "impossible"),
        ("boxes", "no list"),
    ],
)
def test_malformed_boxes_are_refused(tmp_path: Path, content: object, said: str) -> None:
    store.write_json(tmp_path / "boxes.json", content)
    refused(said, detections.read_detections, tmp_path / "boxes.json")


def test_detected_lanes_of_a_log_are_refused(tmp_path: Path, log_scene: Path) -> None:
    views = written(read_scene(log_scene), tmp_path / "right", toy_world.truth)
    (tmp_path / "lanes").mkdir()
    config = dataclasses.replace(QUICK, lanes=str(tmp_path / "lanes"))
    refused("no lane lines", scored, log_scene, {"right": views}, tmp_path / "score", config)


def test_boxes_with_few_points_do_not_count(tmp_path: Path, log_scene: Path) -> None:
    scene = read_scene(log_scene)
    store.write_json(tmp_path / "boxes.json", [])
    counting = detections.BoxDetections(scene, tmp_path / "boxes.json")
    view = scene.frames_of("front")[0].view
    assert [track.id for track in counting._tracks_at(view)] == ["car"]
    counting._counts[scene.sweeps[0].id]["car"] = 9
    assert counting._tracks_at(view) == []


# ---- a generated city: exact truth ---------------------------------------------------------------


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("city") / "scene"
    write_city(CityConfig(seed=2100101, n_frames=4, width=240, height=160, cameras=("front",)), root, test_every=0)
    return root


@pytest.fixture(scope="module")
def city_run(city: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder, scene = tmp_path_factory.mktemp("scores"), read_scene(city)
    world = CityWorld.from_source(scene.source)
    looks = {"right": world.observation, "gray": lambda view: gray(world.observation(view))}
    methods = {name: written(scene, folder / name, look) for name, look in looks.items()}
    path = trajectory.shifted(scene, "front", 2.0)
    for name, masks in (("right", True), ("gray", False), ("truth", True)):
        for number, view in enumerate(path.views):
            lanes = detections.street_scores.lane_truth(view, world.lane_lines())
            target = folder / "lanes" / name / path.name / f"{number:06d}.png"
            store.write_image(target, (lanes & masks).astype(np.uint8) * 255)
    truth = DrawTruth(scene=city, trajectories=(path,), out=folder / "drawn").run()
    config = dataclasses.replace(QUICK, lanes=str(folder / "lanes"))
    stored = scored(city, methods, folder / "score", config, truth=truth)
    again = scored(city, {"right": methods["right"]}, folder / "score_drawn")
    for name in ("agent_iou", "lane_iou", "lane_correlation", "warp_error", "lidar_abs_rel", "temporal_flickering"):
        close = pytest.approx(value(again, "right", path.name, name), abs=2e-2)  # stored truth has 8 bits
        assert value(stored, "right", path.name, name) == close, name
    return folder / "score", stored


def test_vehicles_and_lanes_of_a_city_have_ceilings(city_run: tuple[Path, dict]) -> None:
    out, document = city_run
    for metric, least in (("agent_iou", 0.5), ("lane_iou", 0.6)):
        beside = anchors(document, HERE, metric)
        assert value(document, "right", HERE, metric) == pytest.approx(beside["truth"], abs=0.02)
        assert beside["truth"] > least
        assert value(document, "gray", HERE, metric) < 0.05
    assert value(document, "right", HERE, "lane_correlation") > 0.99
    text = (out / "metrics.md").read_text()
    assert "agent IoU: true images" in text and "NTA-IoU" not in text.split("## ")[1]  # never under the published name


def test_ntl_iou_from_masks(city_run: tuple[Path, dict]) -> None:
    _, document = city_run
    assert value(document, "right", HERE, "ntl_iou") == 100
    assert 45 < value(document, "gray", HERE, "ntl_iou") < 50
    (row,) = (r for r in document["results"] if r["method"] == "gray")
    assert row["ntl"]["lanes"] == 0
    assert anchors(document, HERE, "ntl_iou") == {"trajectory": HERE, "metric": "ntl_iou", "truth": 100.0}


def test_a_missing_mask_is_named(city: Path, city_run: tuple[Path, dict]) -> None:
    scene = read_scene(city)
    lanes = detections.LaneDetections(scene, city_run[0].parent / "lanes")
    views = trajectory.shifted(scene, "front", 2.0).views
    images = detections.ViewImages("right/front_shift+2.0", (0, 9), views[:2])
    refused("000009", lanes.of, images)
    assert lanes.of(dataclasses.replace(images, key="nobody")) == score_tables.NO_DETECTIONS


# ---- neighbouring views --------------------------------------------------------------------------

CAMERA = Camera("front", 24, 16, 20.0, 20.0, 12.0, 8.0)


def wall_pair(number: int, rgb: torch.Tensor, object_at: float | None = None) -> Pair:
    """A wall 10 m ahead of a camera that stands still; ``object_at``: left column of a vehicle before it."""
    depth, ids = torch.full((1, 16, 24), 10.0), torch.zeros(16, 24, dtype=torch.int64)
    instance = np.zeros((16, 24), np.int32)
    if object_at is not None:
        columns = slice(int(object_at), int(object_at) + 4)
        depth[..., columns], ids[:, columns], instance[:, columns] = 9.0, 13, 5
    view = View(CAMERA, np.eye(4), 0.1 * number)
    return Pair(rgb, None, None, rgb, depth, None, ids, view=view, facts=ViewFacts(instance=instance))


def test_warp_error_follows_vehicles_by_their_boxes() -> None:
    """A vehicle of random colours moves by two columns: nothing changes where it is followed."""
    noise = torch.rand(3, 16, 24, generator=torch.Generator().manual_seed(0))
    car = torch.rand(3, 16, 4, generator=torch.Generator().manual_seed(1))

    def frame(left: int) -> torch.Tensor:
        made = noise.clone()
        made[..., left : left + 4] = car
        return made

    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, 0, 3] = 2 / 20 * 9.0
    track = Track("car-005", "car", np.ones(3), np.array([0.0, 0.1]), poses)
    metric = metrics.warp_error(metrics.ExactMotion([(5, track)]))
    first, second = wall_pair(0, frame(8), 8), wall_pair(1, frame(10), 10)
    metric.add(metric.source(first))
    metric.add(metric.source(second))
    assert metric.value() == pytest.approx(0.0, abs=1e-5)
    motion = metrics.ExactMotion([(5, track)]).between(first, second)
    # Kept: all of the vehicle, and the wall but for what the vehicle hid in either frame.
    assert motion.same[:, 8:12].all() and not motion.same[:, 12:14].any()
    assert int(motion.same.sum()) == 16 * (24 - 2)
    darker = metrics.warp_error(metrics.ExactMotion([(5, track)]))
    darker.add(wall_pair(0, frame(8) * 0.5 + 0.1, 8))
    darker.add(wall_pair(1, frame(10) * 0.5 + 0.2, 10))
    assert darker.value() == pytest.approx(0.1, abs=1e-5)


def test_vehicles_without_boxes_do_not_count_and_flickering_by_hand() -> None:
    pairs = [wall_pair(n, torch.zeros(3, 16, 24), 8) for n in (0, 1)]
    frames = [metrics.TrueFrame(p.view, p.truth_depth, p.truth_semantics) for p in pairs]
    assert not metrics.pixel_motion(*frames).same[:, 8:12].any()
    metric = metrics.temporal_flickering()
    assert metric.value() is None
    for tone in (0, 51, 0):
        metric.add(metric.source(Pair(torch.full((3, 4, 4), tone / 255), *[None] * 6)))
    assert metric.value() == pytest.approx((255 - 51) / 255)
