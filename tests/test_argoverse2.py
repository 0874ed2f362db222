"""Argoverse 2 importer: a log written from a known one, broken logs, and two real sweeps with scene-flow truth."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import bad_logs
import numpy as np
import pytest
import roundtrip
import write_av2 as made
from bad_logs import refused
from PIL import Image

from mudg.base.errors import UsageError
from mudg.base.geometry import invert, transform_points
from mudg.base.types import Scene, Track
from mudg.formats.importers import RECOGNISERS
from mudg.scene.read import read_points

pytestmark = roundtrip.needs_native
truth = bad_logs.truth
pristine, copy = bad_logs.fixtures(made.write_av2, "7fab2350")
ingest = bad_logs.importer("argoverse2", cameras=("front", "front_left"))

pytest.importorskip("pyarrow")
Columns = dict[str, Any]


# --- round trips ----------------------------------------------------------------------------------


def test_round_trip(truth: Scene, pristine: Path, tmp_path: Path) -> None:
    assert RECOGNISERS["argoverse2"](pristine)
    scene = ingest(pristine, tmp_path / "plain", untwist="no")
    roundtrip.assert_same_log(scene, truth, labels=made.READ_BACK)
    assert scene.cameras["front"].distortion == (-0.24, -0.2, 0.0, 0.0, 0.3)
    assert scene.id == "7fab2350"
    timed = ingest(pristine.parent, tmp_path / "timed", sequence="7fab")
    still = tuple(track for track in truth.tracks if np.ptp(track.world_from_object[:, :3, 3], axis=0).max() < 1e-9)
    both = (replace_tracks(scene, still) for scene in (timed, truth))
    roundtrip.assert_same_log(*both, labels=made.READ_BACK, dt_s=1e-6)


def replace_tracks(scene: Scene, keep: tuple[Track, ...]) -> Scene:
    """The scene with the tracks of ``keep`` only, by number or by the writer's name."""
    names = {track.id for track in keep} | {f"uuid-{track.id}" for track in keep}
    return replace(scene, tracks=tuple(track for track in scene.tracks if track.id in names))


def test_frames_and_logs_are_chosen(pristine: Path, tmp_path: Path) -> None:
    scene = ingest(pristine, tmp_path / "out", cameras=("ring_front_center",), frames=(3, 9))
    assert list(scene.cameras) == ["front"]
    assert len(scene.frames) == len(scene.sweeps) == 2
    logs = tmp_path / "logs"
    for name in ("aaa-1", "aaa-2"):
        shutil.copytree(pristine, logs / name)
    for sequence, words in (("", "several logs"), ("aaa", "several logs"), ("b", "no such log")):
        caught = refused(words, ingest, logs, tmp_path / "other", sequence=sequence, raises=UsageError)
        assert "aaa-1, aaa-2" in caught.expected
    assert ingest(logs, tmp_path / "other", sequence="aaa-2").id == "aaa-2"


# --- what is wrong is said ------------------------------------------------------------------------


def scaled(names: tuple[str, ...], factor: float) -> Callable[[Columns], object]:
    return lambda c: c.update({name: (c[name] * factor).astype(c[name].dtype) for name in names})


EGO, MOUNTS = "city_SE3_egovehicle.feather", "calibration/egovehicle_SE3_sensor.feather"
LENSES, BOXES = "calibration/intrinsics.feather", "annotations.feather"
BROKEN: dict[str, tuple[str, Callable[[Columns], object], str]] = {
    "pose times in microseconds": (EGO, lambda c: c.update(timestamp_ns=c["timestamp_ns"] // 1000), "another unit"),
    "box times in microseconds": (BOXES, lambda c: c.update(timestamp_ns=c["timestamp_ns"] // 1000), "another unit"),
    "pose times in seconds": (EGO, lambda c: c.update(timestamp_ns=c["timestamp_ns"] / 1e9), "not whole numbers"),
    "poses of a later hour": (EGO, lambda c: c.update(timestamp_ns=c["timestamp_ns"] + 3600 * 10**9), "do not cover"),
    "poses in millimetres": (EGO, scaled(("tx_m", "ty_m", "tz_m"), 1000.0), "impossibly fast"),
    "scaled rotations": (EGO, scaled(("qw", "qx", "qy", "qz"), 1.1), "length 1"),
    "order of quaternions": (EGO, lambda c: c.update(qw=c["qx"], qx=c["qy"], qy=c["qz"], qz=c["qw"]), "upright|looks"),
    "pose not finite": (EGO, lambda c: c["tx_m"].__setitem__(1, np.nan), "not finite"),
    "no mount": (MOUNTS, lambda c: c["sensor_name"].__setitem__(0, "ring_rear_left"), "lacks a sensor"),
    "no lens": (LENSES, lambda c: c["sensor_name"].__setitem__(0, "ring_rear_left"), "lacks a sensor"),
    "other image size": (LENSES, lambda c: c["width_px"].__setitem__(0, 97), "camera's size"),
    "length and width swapped": (BOXES, lambda c: c.update(length_m=c["width_m"], width_m=c["length_m"]), "swapped"),
    "size below zero": (BOXES, lambda c: c["height_m"].__setitem__(0, -1.5), "makes no sense"),
    "doubled box": (BOXES, lambda c: c.update({k: np.append(v, v[:1]) for k, v in c.items()}), "two boxes"),
    "no column": (BOXES, lambda c: c.pop("category"), "lacks columns"),
    "texts for numbers": (BOXES, lambda c: c.update(qw=c["category"]), "does not hold numbers"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_tables_are_refused_in_words(name: str, copy: Path, tmp_path: Path) -> None:
    table, change, words = BROKEN[name]
    made.edit(copy / table, change)
    roundtrip.assert_refused(ingest, copy, tmp_path / "out", words)


def test_broken_files_are_refused_in_words(copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = sorted((copy / "sensors" / "lidar").iterdir())[1]
    content = scan.read_bytes()
    for wrong in (content[: len(content) // 2], content[:10], b""):
        scan.write_bytes(wrong)
        assert scan.name in refused("cut off", ingest, copy, tmp_path / "out").where
    changes: dict[str, Callable[[Columns], object]] = {
        "point times": lambda c: c.update(offset_ns=c["offset_ns"].astype(np.int64) * 1000 + 10**9),
        "intensity": lambda c: c.update(intensity=c["intensity"] + 300),
        "not finite": lambda c: c["x"].__setitem__(3, np.inf),
    }
    for words, change in changes.items():
        scan.write_bytes(content)
        made.edit(scan, change)
        refused(words, ingest, copy, tmp_path / "out")
    scan.write_bytes(content)
    made.edit(scan, lambda c: c.update({name: values[:0] for name, values in c.items()}))
    scene = ingest(copy, tmp_path / "out")
    assert len(read_points(scene, scene.sweeps[1]).xyz) == 0
    assert "has no points" in capsys.readouterr().err
    image = next((copy / "sensors" / "cameras" / "ring_front_left").iterdir())
    image.rename(image.with_name(f"{int(image.stem) // 1000}.png"))
    refused("another unit", ingest, copy, tmp_path / "other")
    shutil.rmtree(copy / "sensors" / "cameras")
    refused("no images", ingest, copy, tmp_path / "other")
    refused("no Argoverse 2 log", ingest, copy / "sensors", tmp_path / "other")


def test_optional_parts(copy: Path, tmp_path: Path) -> None:
    refused("cameras are missing", ingest, copy, tmp_path / "out", cameras=())
    assert ingest(copy, tmp_path / "out", cameras=(), skip_missing=True).tracks
    (copy / BOXES).unlink()
    shutil.rmtree(copy / "sensors" / "lidar")
    bare = ingest(copy, tmp_path / "bare")
    assert (len(bare.sweeps), bare.tracks) == (0, ())
    assert len(bare.source.notes) == 3


# --- real data ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(shared_data: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The real log, which has no images, with two grey ones."""
    source = shared_data("av2_two_sweeps") / "7fab2350"
    folder = tmp_path_factory.mktemp("real") / "7fab2350"
    folder.mkdir()
    for name in (EGO, BOXES, "calibration"):
        (folder / name).symlink_to(source / name)
    images = folder / "sensors" / "cameras" / "ring_front_center"
    images.mkdir(parents=True)
    (folder / "sensors" / "lidar").symlink_to(source / "sensors" / "lidar")
    for stamp in sorted(path.stem for path in (source / "sensors" / "lidar").iterdir()):
        Image.new("RGB", (1550, 2048), (90, 90, 90)).save(images / f"{stamp}.jpg")
    return folder


def flow_truth(source: Path) -> tuple[np.ndarray, np.ndarray]:
    """Flow f64[N, 3] in the vehicle's frame, and which points are dynamic."""
    from pyarrow import feather

    table = feather.read_table(str(source / "flow_labels.feather"))
    flow = np.stack([table.column(f"flow_t{axis}_m").to_numpy() for axis in "xyz"], 1)
    return flow.astype(np.float64), table.column("dynamic").to_numpy()


def test_real_flow_follows_from_poses_and_boxes(shared_data: Callable[[str], Path], real: Path, tmp_path: Path) -> None:
    scene = ingest(real, tmp_path / "out", cameras=("front",), untwist="no")
    flow, dynamic = flow_truth(shared_data("av2_two_sweeps") / "7fab2350")
    one, two = scene.sweeps
    first, second = scene.ego.pose_at(one.time_s), scene.ego.pose_at(two.time_s)
    assert np.abs((invert(second) @ first)[:3, 3] - [-0.066, 0.003, 0.002]).max() < 1e-3
    world = transform_points(one.world_from_lidar, read_points(scene, one).xyz.astype(np.float64))
    assert len(world) == len(flow) == 99_229
    ego = transform_points(invert(first), world)
    still = transform_points(invert(second), world) - ego
    off = np.linalg.norm(still - flow, axis=1)
    assert off[~dynamic].mean() == pytest.approx(1.22e-3, abs=0.05e-3)
    assert off[dynamic].mean() == pytest.approx(0.664, abs=0.005)
    assert dynamic.mean() == pytest.approx(0.0205, abs=1e-4)
    assert len(scene.tracks) == 81
    moved = np.full_like(still, np.nan)
    for track in scene.tracks:
        before, after = track.pose_at(one.time_s), track.pose_at(two.time_s)
        if before is not None and after is not None:
            inside = (np.abs(transform_points(invert(before), world)) <= track.size_m / 2 + 0.1).all(1)
            own = transform_points(invert(before), world[inside])
            moved[inside] = transform_points(invert(second) @ after, own) - ego[inside]
    with_boxes = np.linalg.norm(moved - flow, axis=1)[dynamic]
    assert np.isfinite(with_boxes).all()  # every dynamic point lies in a box
    assert with_boxes.max() < 1e-4  # the flow labels were made of these boxes (and rounded to float32)
