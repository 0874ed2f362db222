"""nuScenes importer: a release of a known log, broken ones, the reader of large tables, the real key frame."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_logs
import numpy as np
import pytest
import roundtrip
import write_nuscenes as made
from refusals import refused

from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import invert, transform_points, yaw_matrix
from mudg.base.types import Scene
from mudg.formats.importers import RECOGNISERS
from mudg.formats.importers.nuscenes import find_records, point_times, read_scan, read_table
from mudg.scene.read import read_points

pytestmark = roundtrip.needs_native
truth = bad_logs.truth
pristine, copy = bad_logs.fixtures(made.write_nuscenes, "release")
ingest = bad_logs.importer("nuscenes", sequence="scene-0007", cameras=("front", "front_left"))

Rows = list[dict[str, Any]]


# --- round trips ----------------------------------------------------------------------------------


def test_round_trip(truth: Scene, pristine: Path, tmp_path: Path) -> None:
    assert RECOGNISERS["nuscenes"](pristine)
    scene = ingest(pristine, tmp_path / "out", untwist="no")
    roundtrip.assert_same_log(scene, truth, labels=made.READ_BACK, dt_s=None)
    assert scene.id == "scene-0007"
    assert "CC BY-NC-SA" in scene.source.licence
    assert np.allclose(scene.ego.world_from_ego[0], np.eye(4), atol=1e-9)


def test_sweeps_between_key_frames_are_read_and_boxes_are_interpolated(truth: Scene, tmp_path: Path) -> None:
    release = made.write_nuscenes(truth, tmp_path / "release", key_every=2)
    assert list((release / "sweeps" / "LIDAR_TOP").iterdir())
    scene = ingest(release / "v1.0-mini", tmp_path / "out", untwist="no")  # the table folder serves, too
    assert [len(track.times_s) for track in scene.tracks] == [3] * len(truth.tracks)
    roundtrip.assert_same_log(scene, truth, labels=made.READ_BACK, box_pose=0.05)  # cars brake between keys


def test_frames_and_cameras_are_chosen(truth: Scene, pristine: Path, tmp_path: Path) -> None:
    scene = ingest(pristine, tmp_path / "out", cameras=("CAM_FRONT_LEFT",), frames=(1, 3), untwist="no")
    assert list(scene.cameras) == ["front_left"]
    assert len(scene.frames) == len(scene.sweeps) == 2
    seen = truth.frames_of("front_left")
    expected = invert(seen[1].view.world_from_cam) @ seen[2].view.world_from_cam
    found = invert(scene.frames[0].view.world_from_cam) @ scene.frames[1].view.world_from_cam
    assert np.abs(found - expected).max() < 1e-6


def test_point_times_bring_boxes_to_the_sweeps_time(truth: Scene, pristine: Path, tmp_path: Path) -> None:
    scene, plain = ingest(pristine, tmp_path / "out"), ingest(pristine, tmp_path / "plain", untwist="no")
    dt_s = np.concatenate([read_points(scene, sweep).dt_s for sweep in scene.sweeps])
    assert -0.05 <= dt_s.min() < -0.04 < -0.01 < dt_s.max() <= 0
    assert not any(read_points(plain, sweep).dt_s.any() for sweep in plain.sweeps)
    pairs = zip(scene.tracks, plain.tracks, strict=True)
    ahead = [(one.world_from_object[:, :3, 3] - other.world_from_object[:, :3, 3], one) for one, other in pairs]
    moved = [(step, track) for step, track in ahead if np.abs(step).max() > 0.05]
    assert moved  # boxes are drawn where the beam met the car, up to 0.05 s before the stamp: they come forward
    for step, track in moved:
        travel = track.world_from_object[-1, :3, 3] - track.world_from_object[0, :3, 3]
        assert (step @ travel > 0).all()
        assert np.abs(step).max() <= 0.055 * np.linalg.norm(travel) / (track.times_s[-1] - track.times_s[0])


def test_riders_follow_from_attributes_and_a_release_without_boxes_has_no_tracks(copy: Path, tmp_path: Path) -> None:
    made.edit(copy, "category", lambda rows: rows[0].update(name="vehicle.bicycle"))
    made.edit(copy, "sample_annotation", lambda rows: [r.update(attribute_tokens=[made.token("ridden")]) for r in rows])
    scene = ingest(copy, tmp_path / "out")
    assert "cyclist" in {track.label for track in scene.tracks}
    (copy / "v1.0-mini" / "sample_annotation.json").unlink()
    bare = ingest(copy, tmp_path / "bare")
    assert bare.tracks == ()
    assert any("no annotations" in note for note in bare.source.notes)


def test_scene_must_be_chosen_and_releases_side_by_side_are_told_apart(copy: Path, tmp_path: Path) -> None:
    several = refused("several scenes", ingest, copy, tmp_path / "out", sequence="", raises=UsageError)
    assert "scene-0001, scene-0007" in several.expected
    refused("no such scene", ingest, copy, tmp_path / "out", sequence="scene-0008", raises=UsageError)
    shutil.copytree(copy / "v1.0-mini", copy / "v1.0-trainval")
    assert ingest(copy, tmp_path / "out").id == "scene-0007"
    refused("no such scene", ingest, copy, tmp_path / "other", sequence="v1.0-test/scene-0007", raises=UsageError)
    scene = ingest(copy, tmp_path / "other", sequence="v1.0-trainval/scene-0007")
    assert any("v1.0-trainval" in note for note in scene.source.notes)


# --- what is wrong is said ------------------------------------------------------------------------


def first(rows: Rows, **values: object) -> dict[str, Any]:
    return next(row for row in rows if all(row.get(key) == value for key, value in values.items()))


def updating(**values: object) -> Callable[[Rows], object]:
    """A change of the first LiDAR record of the scene."""
    return lambda rows: of_scene(rows).update(values)


def of_scene(rows: Rows) -> dict[str, Any]:
    return next(r for r in rows if "LIDAR_TOP" in r["filename"] and r["ego_pose_token"] == r["token"])


def all_stamps(factor: float) -> Callable[[Rows], None]:
    return lambda rows: [row.update(timestamp=int(row["timestamp"] * factor)) for row in rows]


def shear(rows: Rows) -> None:
    for row in rows:
        if row["camera_intrinsic"]:
            row["camera_intrinsic"][0][1] = 5.0


def of_each(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Rows], object]:
    return lambda rows: [row.update(change(row)) for row in rows]


DATA, BOXES, NOWHERE = "sample_data", "sample_annotation", "f" * 32
BROKEN: dict[str, tuple[str, Callable[[Rows], object], str]] = {
    "dangling ego pose": (DATA, updating(ego_pose_token=NOWHERE), "points nowhere"),
    "dangling calibration": (DATA, updating(calibrated_sensor_token=NOWHERE), "points nowhere"),
    "dangling sample": ("sample", lambda r: first(r, prev="").update(next=NOWHERE), "points nowhere"),
    "dangling instance": (BOXES, lambda r: r[0].update(instance_token=NOWHERE), "points nowhere"),
    "chain in a circle": ("sample", lambda r: r[0].update(next=r[0]["prev"] or r[0]["token"]), "circle"),
    "milliseconds": ("sample", all_stamps(1e-3), "another unit"),
    "nanoseconds": (DATA, all_stamps(1e3), "another unit"),
    "chain backwards": ("sample", lambda r: r[1].update(timestamp=r[1]["timestamp"] + 10**6), "do not increase"),
    "a sweep of another day": (DATA, updating(timestamp=made.START_US + 86_400 * 10**6), "hours|outside"),
    "width and length swapped": (BOXES, of_each(lambda x: {"size": [x["size"][i] for i in (1, 0, 2)]}), "swapped"),
    "size of zero": (BOXES, lambda r: r[0].update(size=[0.0, 4.0, 1.5]), "makes no sense"),
    "scaled rotation": ("ego_pose", lambda r: r[0].update(rotation=[2 * v for v in r[0]["rotation"]]), "length 1"),
    "quaternions x y z w": (
        "ego_pose",
        lambda rows: [r["rotation"].append(r["rotation"].pop(0)) for r in rows],
        "upright",
    ),
    "three rotation values": ("ego_pose", lambda r: r[0].update(rotation=[1, 0, 0]), "missing or malformed"),
    "translation is a text": ("ego_pose", lambda r: r[0].update(translation=["1", 2, 3]), "missing or malformed"),
    "intrinsics sheared": ("calibrated_sensor", shear, "not of a pinhole camera"),
    "file outside the release": (DATA, updating(filename="../../etc/passwd"), "file name contains"),
    "missing timestamp": (DATA, lambda r: of_scene(r).pop("timestamp"), "missing or malformed"),
    "two records with one token": (DATA, lambda r: r.append(of_scene(r)), "two records"),
    "other image size": (DATA, of_each(lambda x: {"width": x["width"] and x["width"] + 1}), "camera's size"),
    "no camera": ("sensor", of_each(lambda x: {"channel": "X"} if "CAM" in x["channel"] else {}), "no such camera"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_tables_are_refused_in_words(name: str, copy: Path, tmp_path: Path) -> None:
    table, change, words = BROKEN[name]
    made.edit(copy, table, change)
    with pytest.raises((InputError, UsageError), match=words) as caught:
        ingest(copy, tmp_path / "out")
    assert caught.value.where
    assert not (tmp_path / "out").exists()


def test_broken_files_are_refused_in_words(copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = sorted((copy / "samples" / "LIDAR_TOP").iterdir())[2]
    content = scan.read_bytes()
    numbers, rings = np.array([1, np.nan, 2, 0, 0], "<f4"), np.full((4, 5), 40, "<f4")
    cases = (("cut off", content[:-3]), ("not finite", numbers.tobytes()), ("no ring", rings.tobytes()))
    for words, wrong in cases:
        scan.write_bytes(wrong)
        assert scan.name in refused(words, ingest, copy, tmp_path / "out").where
    scan.write_bytes(b"")  # no points is odd, not wrong
    scene = ingest(copy, tmp_path / "out")
    assert len(read_points(scene, scene.sweeps[2]).xyz) == 0
    assert "has no points" in capsys.readouterr().err
    table = copy / "v1.0-mini" / "sample_data.json"
    table.write_bytes(table.read_bytes()[:-200])
    refused("cut off", ingest, copy, tmp_path / "out2")
    refused("no nuScenes scene found", ingest, copy / "samples", tmp_path / "out2")


def test_default_cameras_must_all_be_there(pristine: Path, tmp_path: Path) -> None:
    caught = refused("cameras are missing", ingest, pristine, tmp_path / "out", cameras=())
    assert "--cameras front front_left" in caught.remedy
    refused("already compensated", ingest, pristine, tmp_path / "out", untwist="yes", raises=UsageError)
    assert len(ingest(pristine, tmp_path / "out", cameras=(), skip_missing=True).cameras) == 2


# --- the reader of tables -------------------------------------------------------------------------

TEXTS = ("plain", '"group": "g1"', '\\" ] [', "\u00e9\u4e2d", "", "x", "y")
ODD = [
    {"token": f"t{n}", "group": f"g{n % 3}", "text": text, "list": [n, [1.5, -2e-3]], "null": None}
    for n, text in enumerate(TEXTS)
]


@pytest.mark.parametrize("buffer_bytes", [1, 7, 64, 1000, 1 << 20])
@pytest.mark.parametrize("indent", [None, 0, 2])
def test_large_tables_give_the_same_records_whatever_the_buffer(
    tmp_path: Path, buffer_bytes: int, indent: int | None
) -> None:
    path = tmp_path / "table.json"
    path.write_text(json.dumps(ODD, indent=indent))
    assert read_table(path) == ODD
    for group in ("g0", "g1", "g2"):
        wanted = [row for row in ODD if row["group"] == group]
        assert list(find_records(path, "group", {group}, buffer_bytes=buffer_bytes)) == wanted
    assert list(find_records(path, "token", {"t3", "t5", "x"}, buffer_bytes=buffer_bytes)) == [ODD[3], ODD[5]]
    path.write_text("[ \n ] ")
    assert list(find_records(path, "token", {"t"}, buffer_bytes=buffer_bytes)) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[{"token": "t0"}, {"token": "t1"', "cut off"),
        ('[{"token": "t0"}', "cut off"),
        ('{"token": "t0"}', "start as a JSON array"),
        ("", "start as a JSON array"),
        ('[{"token": "t0", "x": NaN}]', "not valid JSON"),
        ('[{"token": "t0" "x": 1}]', "not valid JSON"),
    ],
)
def test_malformed_tables_are_refused(tmp_path: Path, text: str, words: str) -> None:
    read = lambda path: list(find_records(path, "token", {"t0"}))
    path = tmp_path / "table.json"
    path.write_text(text)
    assert str(path) in refused(words, read, path).where
    assert str(path) in refused("not valid JSON|not an array", read_table, path).where
    path.unlink()
    refused("table is missing", read, path)


# --- sweeps and cameras ---------------------------------------------------------------------------


def test_point_times_follow_columns_or_azimuth(tmp_path: Path) -> None:
    columns = 400
    azimuth = np.deg2rad(-177) - 2 * np.pi * (np.arange(columns) + 0.5) / columns
    rows = np.zeros((columns, 32, 5), "<f4")
    rows[..., 0], rows[..., 1] = 20 * np.cos(azimuth)[:, None], 20 * np.sin(azimuth)[:, None]
    rows[..., 3], rows[..., 4] = 51, np.arange(32)
    flat = rows.reshape(-1, 5)
    by_column = point_times(flat[:, :3], flat[:, 4])
    assert by_column[0] == pytest.approx(-0.05 * 399 / 400)
    assert by_column[-1] == 0
    by_azimuth = point_times(flat[:-1, :3], flat[:-1, 4])
    assert np.abs(by_azimuth - by_column[:-1]).max() < 0.05 / 400
    flat[5, :3] = (0.2, 0.4, -0.1)  # the roof
    path = tmp_path / "scan.bin"
    path.write_bytes(flat.tobytes())
    points = read_scan(path)
    assert len(points.xyz) == len(flat) - 1
    assert np.allclose(points.intensity, 0.2)


# --- real data ------------------------------------------------------------------------------------


def test_real_boxes_hold_the_points_that_were_counted_in_them(shared_data: Callable[[str], Path]) -> None:
    source = shared_data("nuscenes_one_sample")
    points = read_scan(next(source.glob("*.pcd.bin"))).xyz
    assert 26_000 < len(points) < 26_400  # of 34,688 rows: the rest is the car itself
    assert np.linalg.norm(points[:, :2], axis=1).min() > 1.0
    sample = json.loads((source / "info.json").read_bytes())["data_list"][0]
    boxes = [item for item in sample["instances"] if item["bbox_label_3d"] >= 0]
    inside = []
    for x, y, z, length, width, height, yaw in (item["bbox_3d"] for item in boxes):
        local = transform_points(invert(yaw_matrix(yaw, (x, y, z))), points.astype(np.float64))
        inside.append(int((np.abs(local) <= np.array([length, width, height]) / 2).all(1).sum()))
    declared = [item["num_lidar_pts"] for item in boxes]
    off = sorted(abs(a - b) for a, b in zip(inside, declared, strict=True))
    assert len(boxes) == 68 and (inside[declared.index(495)], off[-1], off[-2]) == (479, 16, 5)
    assert np.percentile(off, 95) <= 2
