"""DGP importer: a scene written from a known log, broken scenes, and a real scene."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_logs
import numpy as np
import pytest
import roundtrip
import write_dgp as made
from bad_logs import refused

from mudg.base.errors import UsageError
from mudg.base.geometry import invert, project, transform_points
from mudg.base.types import Scene
from mudg.formats.importers import RECOGNISERS
from mudg.scene.read import read_points

pytestmark = roundtrip.needs_native
truth = bad_logs.truth
ingest = bad_logs.importer("dgp")

CAMERAS = {"front": "front", "front_left": "front_left"}


@pytest.fixture(scope="module")
def folder(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made.write_dgp(truth, tmp_path_factory.mktemp("scenes") / "scene_01")


def test_round_trip(truth: Scene, folder: Path, tmp_path: Path) -> None:
    assert RECOGNISERS["dgp"](folder)
    scene = ingest(folder, tmp_path / "out")
    roundtrip.assert_same_log(scene, truth, labels=made.READ_BACK)
    again = ingest(folder.parent, tmp_path / "again", sequence="scene_01", cameras=("FRONT_LEFT",), frames=(0, 2))
    assert list(again.cameras) == ["front_left"]
    assert (len(again.frames), len(again.sweeps)) == (2, 2)
    scene = ingest(made.write_dgp(truth, tmp_path / "scene", slowed=10), tmp_path / "slowed")
    roundtrip.assert_same_log(scene, truth, labels=made.READ_BACK)
    assert any("tenths of a microsecond" in note for note in scene.source.notes)


SCENE, CALIBRATION = "scene_abc.json", "calibration/c0ffee.json"
FIRST_BOXES, ONTOLOGY = "bounding_box_3d/LIDAR/0.json", "ontology/0n7.json"


def cloud(record: dict[str, Any]) -> dict[str, Any]:
    return record["data"][0]["datum"]["point_cloud"]


def box(record: dict[str, Any]) -> dict[str, Any]:
    return record["annotations"][0]["box"]


BROKEN: dict[str, tuple[str, Callable[[dict[str, Any]], object], str]] = {
    "dangling datum": (SCENE, lambda r: r["samples"][0]["datum_keys"].append("x"), "points nowhere"),
    "dangling calibration": (SCENE, lambda r: r["samples"][0].update(calibration_key="x"), "not found"),
    "calibration outside": (SCENE, lambda r: r["samples"][0].update(calibration_key="../../x"), "file name contains"),
    "cloud outside": (SCENE, lambda r: cloud(r).update(filename="/etc/passwd"), "file name is absolute"),
    "no pose": (SCENE, lambda r: cloud(r).pop("pose"), "incomplete"),
    "scaled rotation": (SCENE, lambda r: cloud(r)["pose"]["rotation"].update(qw=3.0), "length 1"),
    "no date": (SCENE, lambda r: r["data"][0]["id"].update(timestamp="yesterday"), "no date"),
    "two sweeps at one time": (SCENE, lambda r: r["data"][0].update(id=r["data"][3]["id"]), "same time|two boxes"),
    "a camera twice": (SCENE, lambda r: r["data"][1]["datum"]["image"].update(width=50), "differ in size"),
    "lists of other lengths": (CALIBRATION, lambda r: r["names"].pop(), "differ in length"),
    "mount missing": (CALIBRATION, lambda r: r["names"].__setitem__(0, "OTHER"), "lacks a sensor"),
    "skewed": (CALIBRATION, lambda r: r["intrinsics"][1].update(skew=4.0), "skew"),
    "class unknown": (FIRST_BOXES, lambda r: r["annotations"][0].update(class_id=77), "ontology lacks"),
    "size of zero": (FIRST_BOXES, lambda r: box(r).update(height=0), "makes no sense"),
    "columns of another count": (SCENE, lambda r: cloud(r).update(point_format=["X", "Y", "Z"]), "its columns"),
    "no z": (SCENE, lambda r: cloud(r).update(point_format=["X", "Y", "W", "INTENSITY"]), "its columns"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_records_are_refused_in_words(name: str, folder: Path, tmp_path: Path) -> None:
    file, change, words = BROKEN[name]
    copy = shutil.copytree(folder, tmp_path / "scene")
    made.edit(copy / file, change)
    roundtrip.assert_refused(ingest, copy, tmp_path / "out", words)


def test_swapped_sides_and_broken_files_are_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = shutil.copytree(folder, tmp_path / "scene")
    path = copy / "point_cloud" / "LIDAR" / "2.npz"
    content = path.read_bytes()
    for wrong in (content[: len(content) // 2], b"", b"PK"):
        path.write_bytes(wrong)
        assert "2.npz" in refused("cut off", ingest, copy, tmp_path / "out").where
    np.savez(path, data=np.array([[1.0, np.nan, 2.0, 0.5]]))
    refused("not finite", ingest, copy, tmp_path / "out")
    np.savez(path, data=np.array([{"pickled": 1}], object))
    refused("npz", ingest, copy, tmp_path / "out")
    np.savez(path, data=np.zeros((0, 4)))
    scene = ingest(copy, tmp_path / "empty")
    assert len(read_points(scene, scene.sweeps[2]).xyz) == 0
    assert "has no points" in capsys.readouterr().err
    for number in range(5):

        def swap(record: dict[str, Any]) -> None:
            for item in record["annotations"]:
                one = item["box"]
                one["length"], one["width"] = one["width"], one["length"]

        made.edit(copy / "bounding_box_3d" / "LIDAR" / f"{number}.json", swap)
    refused("swapped", ingest, copy, tmp_path / "out")


def test_scenes_are_chosen_by_folder(folder: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        shutil.copytree(folder, tmp_path / "all" / name)
    refused("several scenes", ingest, tmp_path / "all", tmp_path / "out", raises=UsageError)
    assert ingest(tmp_path / "all", tmp_path / "out", sequence="two").id == "two"
    refused("no DGP scene", ingest, folder / "rgb", tmp_path / "other")


def test_real_scene(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    source = shared_data("dgp_scene_02")
    scene = ingest(source, tmp_path / "out")  # the folder above the scene serves, too
    assert (len(scene.cameras), len(scene.frames), len(scene.sweeps), len(scene.tracks)) == (6, 18, 3, 13)
    assert [len(read_points(scene, sweep).xyz) for sweep in scene.sweeps] == [47_230, 49_469, 48_620]
    steps = np.linalg.norm(np.diff(scene.ego.world_from_ego[:, :3, 3], axis=0), axis=1)
    assert np.abs(steps - [1.257, 1.277]).max() < 2e-3
    assert np.abs(np.diff(scene.ego.times_s) - 0.1).max() < 2e-3
    standing = [t for t in scene.tracks if np.ptp(t.world_from_object[:, :3, 3], axis=0).max() < 0.01]
    assert len(standing) == 7  # parked cars stay put in the world although the vehicle drives
    middle = scene.sweeps[1]
    world = transform_points(middle.world_from_lidar, read_points(scene, middle).xyz.astype(np.float64))
    counts = {}
    for frame in scene.frames:
        if frame.id.endswith("000001"):
            uv, z = project(frame.view, world)
            size = (frame.view.camera.width, frame.view.camera.height)
            counts[frame.view.camera.name] = int(((z > 0.5) & (uv >= 0).all(1) & (uv < size).all(1)).sum())
    numbers = {1: 5562, 5: 12691, 6: 12210, 7: 11174, 8: 10431, 9: 9770}
    assert counts == {f"camera_{number:02d}": count for number, count in numbers.items()}
    nearest = min(scene.tracks, key=lambda t: float(np.linalg.norm(invert(t.world_from_object[1])[:3, 3])))
    assert nearest.label in ("car", "truck")
