"""The shipped segmentation network: evidence on a made-up street, what it settles, files, training that resumes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refused
from test_annotate import STREET, given_at, overlap

from mudg.base import geometry
from mudg.base.errors import IntegrityError, ResourceError
from mudg.base.palette import CLASSES, ID
from mudg.core.depth import ray_elevation
from mudg.labels import street_net
from mudg.labels.annotate import LABELLERS
from mudg.labels.evidence import BOX_GROUPS, PLANE_COUNT, PLANES, Evidence, encode, gather
from mudg.labels.inputs import TRAIN_ID_OF
from mudg.labels.street_net import StreetNet, StreetNetConfig, at_size, reduced, settled
from mudg.networks.folders import CPU

TINY = StreetNetConfig(widths=(8, 8, 8, 8, 8), blocks=(1, 1, 1, 1, 1))


def made_up(height: int = 4, width: int = 6, **given: np.ndarray) -> Evidence:
    """Evidence of a road 10 m away, seen by every ray, without boxes."""
    zero = np.zeros((height, width), np.float32)
    no, nothing = zero > 1, np.zeros(0, np.int64)
    depth = (zero, zero + 10, zero, zero + 1, zero, zero == 0, zero == 0, zero, zero - 0.2, no, zero)
    plain = Evidence(*depth, zero.astype(np.uint8), no, nothing)
    return replace(plain, **given)


# --- evidence -------------------------------------------------------------------------------------


def test_evidence_of_a_street_is_what_was_built_and_tells_ground_beyond_a_kerb() -> None:
    given, truth = given_at(STREET)
    found = gather(given)
    _, _, depth = STREET.image(given.view)
    near = found.away_deg < 0.3
    road = (truth == ID["road"]) & near & (depth < 25)
    assert np.abs(found.height_m[road]).max() < 0.4 and np.median(np.abs(found.height_m[road])) < 0.03
    assert np.median(found.upwards[road]) > 0.97
    wall = (truth == ID["building"]) & near
    assert np.median(found.upwards[wall]) < 0.1 and np.median(found.height_m[wall]) > 0.5
    assert (found.elevation_rad == ray_elevation(given.view)).all()
    assert ((found.away_deg == 0) == np.isfinite(given.measured())).all()
    car = truth == ID["car"]
    inside = (found.box == 1) & found.in_box
    assert found.box_labels.tolist() == [ID["car"]] and (inside & car).sum() / (inside | car).sum() > 0.75
    near &= found.depth_m < 20
    road, wall = (truth == ID["road"]) & near, (truth == ID["building"]) & near & (found.height_m > 1)
    assert found.reachable[road].mean() > 0.95 and not found.reachable[wall].any() and (found.raised_m[wall] == 0).all()


def test_returns_and_nearer_surfaces_decide_what_boxes_show() -> None:
    found = gather(given_at(STREET, lidar=False)[0])
    assert np.isnan(found.depth_m).all() and (found.away_deg == 90).all() and not found.in_box.any()
    assert (found.box == 1).any()
    planes = dict(zip(PLANES, encode(found), strict=False))
    assert not planes["measured at all"].any() and (planes["distance to a return"] == 1).all()
    given, truth = given_at(replace(STREET, car_start=(40.0, 0.0)))
    assert not (truth == ID["car"]).any() and not (gather(given).box > 0).any()


def test_the_outline_of_a_nearer_box_does_not_take_what_lies_in_a_farther_one() -> None:
    given, truth = given_at(STREET)
    (car,) = given.tracks
    toward = np.eye(4)
    toward[:3, 3] = -0.4 * (car.world_from_object[0, :3, 3] - given.view.center_world) * [1, 1, 0]
    nearer = replace(car, id="nearer", label="truck", world_from_object=toward @ car.world_from_object)
    nearer = replace(nearer, size_m=car.size_m * [0.1, 1, 1])
    pose = nearer.pose_at(given.view.time_s)
    rng = np.random.default_rng(0)
    half = nearer.size_m / 2
    # of its back only this is seen
    strip = rng.uniform([-half[0], -half[1], -0.4], [-half[0], -half[1] + 0.5, 0.4], (800, 3))
    xyz = np.concatenate([given.xyz_world, geometry.transform_points(pose, strip)]).astype(np.float32)
    found = gather(replace(given, tracks=[car, nearer], xyz_world=xyz))
    assert found.box_labels.tolist() == [ID["car"], ID["truck"]]
    surely = gather(given).in_box & found.in_box & (found.depth_m > (given.view.cam_from_world @ pose)[2, 3] + 1)
    assert surely.sum() > 200 and (found.box[surely] == 1).all()


def test_encoding_is_finite_and_of_unit_size() -> None:
    for lidar in (True, False):
        planes = encode(gather(given_at(STREET, lidar=lidar)[0]))
        assert planes.shape[0] == PLANE_COUNT and planes.dtype == np.float32 and np.abs(planes).max() < 3
    box = np.zeros((4, 6), np.uint8)
    box[1, :3], box[2] = 1, 2
    labels = np.array([ID["bus"], ID["person"]])
    groups = encode(made_up(box=box, in_box=box == 2, box_labels=labels))[len(PLANES) :]
    bus, person = (next(n for n, g in enumerate(BOX_GROUPS) if name in g) for name in ("bus", "person"))
    assert (groups[bus] == np.float32(0.4) * (box == 1)).all() and (groups[person] == (box == 2)).all()
    assert groups.sum() == pytest.approx(0.4 * 3 + 6)
    assert {TRAIN_ID_OF[label] for label in TRAIN_ID_OF} <= {ID[name] for group in BOX_GROUPS for name in group}


# --- what evidence settles ------------------------------------------------------------------------


EVEN = np.full((len(CLASSES), 4, 6), 1 / len(CLASSES), np.float32)


def test_sky_is_neither_at_returns_nor_below_the_horizon() -> None:
    elevation, away = np.full((4, 6), 0.3, np.float32), np.full((4, 6), 5, np.float32)
    elevation[2:], away[:, :2] = -0.3, 0
    found = settled(EVEN, made_up(elevation_rad=elevation, away_deg=away, height_m=away * 0, direct=away > 99))
    free = (elevation > 0) & (away > 0)
    assert (found[ID["sky"], ~free] < 1e-3).all() and found[:, free] == pytest.approx(1 / len(CLASSES))
    assert found.sum(0) == pytest.approx(1)


def test_roads_are_low_and_boxes_hold_their_own_classes() -> None:
    height, box, inside = (np.zeros((4, 6), kind) for kind in (np.float32, np.uint8, bool))
    height[0], box[2:, 3:], inside[2, 3:] = 3, 1, True
    found = settled(EVEN, made_up(height_m=height, box=box, in_box=inside, box_labels=np.array([ID["rider"]])))
    assert (found[ID["road"], 0] < 1e-3).all() and (found[ID["road"], 1] > 0.04).all()
    classes = [ID[name] for name in ("rider", "motorcycle", "bicycle")]
    assert found[classes][:, 2, 3:].sum(0) == pytest.approx(1)
    assert (found[classes][:, 3, 3:].sum(0) < 0.01).all()  # in the outline, but not in the box
    # no sky; driven ground: no sidewalk, no terrain
    assert found[classes][:, 3, :3].sum(0) == pytest.approx(3 / 16, abs=1e-3)


def test_no_people_beside_or_behind_what_fills_their_box() -> None:
    box = np.zeros((4, 6), np.uint8)
    box[2:] = 1
    given = made_up(box=box, box_labels=np.array([ID["person"]]))
    found = settled(EVEN, given)[ID["person"]]
    assert (found[2:] < 1e-3).all() and (found[:2] > 0.04).all()
    far = settled(EVEN, replace(given, away_deg=np.full((4, 6), 9, np.float32)))
    assert (far[ID["person"]] > 0.04).all()


def test_outside_boxes_there_is_hardly_anything_that_boxes_are_drawn_around() -> None:
    box = np.zeros((4, 6), np.uint8)
    box[:, :2] = 1
    given = made_up(box=box, in_box=box > 0, box_labels=np.array([ID["car"]]))
    free, found = settled(EVEN, given), settled(EVEN, given, boxes_known=True)
    assert found[:, :, :2] == pytest.approx(free[:, :, :2])
    for name in ("car", "person", "bus"):
        assert (found[ID[name], :, 2:] < 0.2 * free[ID[name], :, 2:]).all()
    assert (found[ID["pole"], :, 2:] > free[ID["pole"], :, 2:]).all()


def test_a_picture_is_looked_at_with_the_focal_length_of_training() -> None:
    given, _ = given_at(STREET)
    camera = given.view.camera
    small = reduced(given, camera.fx / 2)
    assert small.rgb.shape[:2] == (small.view.camera.height, small.view.camera.width)
    assert small.rgb.shape[1] == round(camera.width / 2)
    assert small.view.camera.fx == pytest.approx(camera.fx / 2, rel=0.01) and reduced(given, camera.fx + 1) is given
    ids, confidence = at_size(np.eye(len(CLASSES), dtype=np.float32)[:, [[3, 3], [7, 7]]], 40, 20)
    assert ids.shape == confidence.shape == (40, 20) and (ids[:10] == 3).all() and (ids[30:] == 7).all()


# --- the network ----------------------------------------------------------------------------------


def test_every_pixel_gets_scores_at_any_size() -> None:
    net = StreetNet(TINY).eval()
    rng = np.random.default_rng(0)
    for height, width in ((20, 33), (64, 32)):
        rgb = rng.integers(0, 256, (height, width, 3), np.uint8)
        found = net.probabilities(rgb, rng.normal(0, 1, (PLANE_COUNT, height, width)).astype(np.float32))
        assert found.shape == (len(CLASSES), height, width) and found.sum(0) == pytest.approx(1, abs=1e-5)


def test_the_shipped_network_knows_a_street_it_never_saw_also_without_lidar() -> None:
    given, truth = given_at(STREET)
    label = LABELLERS["embedded"]("", CPU)
    labels = label(given)
    assert overlap(labels.semantics, truth, "road") > 0.9 and overlap(labels.semantics, truth, "car") > 0.75
    assert overlap(labels.semantics, truth, "sky") > 0.8 and labels.confidence.dtype == np.float32
    assert ((labels.confidence > 0) & (labels.confidence <= 1)).all() and (labels.depth[labels.sky] == 100).all()
    given, truth = given_at(STREET, lidar=False, boxes=False)
    labels = label(given)
    assert overlap(labels.semantics, truth, "sky") > 0.9 and np.isnan(labels.depth[~labels.sky]).all()


def test_the_shipped_files_are_small_and_explained() -> None:
    folder = street_net.EMBEDDED
    assert sum(path.stat().st_size for path in folder.iterdir()) < 8 * 2**20
    card = (folder / "MODEL_CARD.md").read_text()
    assert "Apache-2.0" in card and "generated cities" in card


# --- files ----------------------------------------------------------------------------------------


def test_a_network_is_read_as_it_was_written(tmp_path: Path) -> None:
    net = StreetNet(replace(TINY, temperature=1.25)).half().float().eval()
    street_net.save(net, tmp_path, "card", {"seed": 1})
    again = street_net.load(tmp_path)
    assert again.config == net.config
    for name, value in net.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])


def test_damaged_folders_end_in_words(tmp_path: Path) -> None:
    street_net.save(StreetNet(TINY), tmp_path / "good", "card", {})
    refused("weights are missing", street_net.load, tmp_path, raises=ResourceError)
    for field, value, words in (
        ("widths", [8, 8, 8, 8, 9], r"widths\[4\]\n.*multiple of 8"),
        ("widths", "8", r"widths\n.*array"),
        ("blocks", [1] * 4, "the field 4 is missing"),
        ("blocks", [1, 1, 1, 1, 10**9], r"blocks\[4\]\n.*65536"),
        ("temperature", 0, r"temperature\n.*greater than 0"),
        ("focal_px", "x", "value is not a number"),
        ("depth", 3, "unknown field"),
        ("widths", [8, 8, 8, 8, 16], "not the network it should be"),
    ):
        shutil.rmtree(tmp_path / "bad", ignore_errors=True)
        shutil.copytree(tmp_path / "good", tmp_path / "bad")
        content = json.loads((tmp_path / "bad/model.json").read_text())
        content["config"][field] = value
        (tmp_path / "bad/model.json").write_text(json.dumps(content))
        refused(words, street_net.load, tmp_path / "bad")
    weights = tmp_path / "good" / street_net.WEIGHTS_FILE
    *others, last = weights.read_bytes()
    weights.write_bytes(bytes([*others, last ^ 1]))
    refused(".", street_net.load, tmp_path / "good", raises=IntegrityError)
