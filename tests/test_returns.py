"""Beams without a return: zeros, NaN and points at the sensor are left out of every format, and counted."""

from __future__ import annotations

import copy
import pickle
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import bad_logs
import numpy as np
import pytest
import roundtrip
import write_av2
import write_custom
import write_nuplan
from write_pandaset import write_frame

from mudg.base.geometry import invert
from mudg.base.types import EgoPath, Scene, Sweep, SweepPoints
from mudg.formats.importers.pandaset import read_frame
from mudg.scene.check import check_points, check_scene
from mudg.scene.clouds import at_sensor
from mudg.scene.read import read_points

pytestmark = roundtrip.needs_native
MARKS = 64
"""Rows without a return that are added; a multiple of 32, so that a nuScenes sweep keeps whole columns."""


def float_rows(columns: int, mark: float) -> Callable[[Path], None]:
    """Appends rows of marks to a file of float32 rows."""

    def change(path: Path) -> None:
        rows = np.full((MARKS, columns), 0, "<f4")
        rows[:, :3] = mark
        if columns == 5:
            rows[:, 4] = np.arange(MARKS) % 32
        path.write_bytes(path.read_bytes() + rows.tobytes())

    return change


def npz(name: str, mark: float) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with np.load(path) as archive:
            arrays = dict(archive)
        for key, values in arrays.items():
            more = np.zeros((MARKS, *values.shape[1:]), values.dtype)
            if key == name:
                more[:, :3] = mark
            arrays[key] = np.concatenate([more, values])
        np.savez(path, **arrays)

    return change


def pcd(place: Any) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        body = path.read_bytes().partition(b"DATA binary\n")[2]
        layout = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("ring", "u1"), ("lidar_info", "<i4")]
        rows = np.frombuffer(body[:-32], layout)
        xyz = np.stack([rows[axis] for axis in "xyz"], 1)
        xyz = np.concatenate([np.tile(np.asarray(place, np.float32), (MARKS, 1)), xyz])
        path.write_bytes(write_nuplan.pcd(xyz, np.r_[np.zeros(MARKS), rows["intensity"] / 255]))

    return change


def feather(place: Callable[[Path], Any]) -> Callable[[Path], None]:
    """Appends rows at a place of the vehicle's frame."""

    def change(path: Path) -> None:
        def add(columns: dict[str, Any]) -> None:
            for axis, value in zip("xyz", place(path.parents[2]), strict=True):
                columns[axis] = np.r_[columns[axis], np.full(MARKS, value, columns[axis].dtype)]
            for name in set(columns) - {*"xyz"}:
                columns[name] = np.r_[columns[name], np.zeros(MARKS, columns[name].dtype)]

        write_av2.edit(path, add)

    return change


def mount_of_upper(log: Path) -> list[float]:
    from pyarrow import feather as files

    table = files.read_table(str(log / "calibration/egovehicle_SE3_sensor.feather"))
    row = table.column("sensor_name").to_pylist().index("up_lidar")
    return [table.column(f"t{axis}_m").to_pylist()[row] for axis in "xyz"]


def pandas_rows(path: Path) -> None:
    table = read_frame(path)
    more = {name: np.full(MARKS, values[0] if name == "t" else 0, values.dtype) for name, values in table.items()}
    write_frame(path, {name: np.r_[more[name], values] for name, values in table.items()})


CASES: dict[str, tuple[str, Callable[[Path], None]]] = {
    "kitti zeros": ("kitti", float_rows(4, 0.0)),
    "kitti NaN": ("kitti", float_rows(4, np.nan)),
    "kitti360 zeros": ("kitti360", float_rows(4, 0.0)),
    "kitti360 NaN": ("kitti360", float_rows(4, np.nan)),
    "nuscenes zeros": ("nuscenes", float_rows(5, 0.0)),
    "nuscenes NaN": ("nuscenes", float_rows(5, np.nan)),
    "custom zeros": ("custom", npz("xyz", 0.0)),
    "custom infinity": ("custom", npz("xyz", np.inf)),
    "nuplan zeros": ("nuplan", pcd((0, 0, 0))),
    "argoverse2 zeros of the vehicle": ("argoverse2", feather(lambda _log: (0, 0, 0))),
    "argoverse2 zeros of the LiDAR": ("argoverse2", feather(mount_of_upper)),
    "argoverse2 NaN": ("argoverse2", feather(lambda _log: (np.nan,) * 3)),
    "pandaset zeros": ("pandaset", pandas_rows),
}


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Scene]:
    """The scene of an unchanged log, imported once per format."""
    made: dict[str, Scene] = {}

    def scene(kind: str) -> Scene:
        if kind not in made:
            log = bad_logs.written(kind, bad_logs.shared(tmp_path_factory))
            out = tmp_path_factory.mktemp("clean") / "scene"
            made[kind] = bad_logs.ingest(kind, log.source, out, bad_logs.options_of(log))
        return made[kind]

    return scene


@pytest.mark.parametrize("case", CASES)
def test_marks_are_left_out_and_counted(
    case: str, clean: Callable[[str], Scene], tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    kind, change = CASES[case]
    if kind in bad_logs.NEEDS_PYARROW:
        pytest.importorskip("pyarrow")
    log = bad_logs.written(kind, bad_logs.shared(tmp_path_factory))
    before, content = clean(kind), log.cloud.read_bytes()
    change(log.cloud)
    try:
        scene = bad_logs.ingest(kind, log.source, tmp_path / "scene", bad_logs.options_of(log))
    finally:
        log.cloud.write_bytes(content)
    for one, other in zip(scene.sweeps, before.sweeps, strict=True):
        assert np.array_equal(read_points(scene, one).xyz, read_points(before, other).xyz)
    notes = [note for note in scene.source.notes if "without a return" in note]
    assert sum(int(note.split(": ")[1].split(" of ")[0]) for note in notes) >= MARKS
    assert not any("within 0.05 m" in finding.message for finding in check_scene(scene.root))


@pytest.mark.parametrize("form", ["waymo v1", "waymo v2"])
def test_pixels_of_a_range_image_without_a_return_are_no_points(
    form: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The data set marks them by -1; 0 and NaN are no ranges either."""
    if form in bad_logs.NEEDS_PYARROW:
        pytest.importorskip("pyarrow")
    log = bad_logs.written(form, bad_logs.shared(tmp_path_factory))
    assert isinstance(log, bad_logs.write_waymo.Log)
    spoilt = copy.deepcopy(log)
    image = spoilt.frames[0]["lasers"][0]["returns"][0]
    rows, columns = (part[: 3 * MARKS] for part in np.nonzero(image[..., 0] > 0))
    image[rows, columns, 0] = np.tile([0.0, -1.0, np.nan], MARKS)

    def points(one: bad_logs.write_waymo.Log, name: str) -> int:
        source = bad_logs.write_waymo_log(one, form, tmp_path / f"{name} log")
        scene = bad_logs.ingest(form, source, tmp_path / name, bad_logs.options_of(one))
        return sum(len(read_points(scene, sweep).xyz) for sweep in scene.sweeps)

    assert points(spoilt, "spoilt") == points(log, "whole") - 3 * MARKS


@pytest.mark.parametrize("suffix", list(write_custom.CLOUDS))
def test_zeros_in_every_form_of_cloud(suffix: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    truth = bad_logs.city(bad_logs.shared(tmp_path_factory) / "truth")
    log = write_custom.write_log(truth, tmp_path / "log", suffix)
    points = read_points(truth, truth.sweeps[0])
    xyz = np.stack([points.xyz, np.zeros_like(points.xyz)], 1).reshape(-1, 3)
    with_zeros = SweepPoints(xyz, np.repeat(points.intensity, 2), np.repeat(points.dt_s, 2))
    (log / "lidar" / f"{truth.sweeps[0].id}{suffix}").write_bytes(write_custom.CLOUDS[suffix](with_zeros))
    scene = bad_logs.ingest("custom", log, tmp_path / "scene", bad_logs.ImportOptions())
    assert np.allclose(read_points(scene, scene.sweeps[0]).xyz, points.xyz, atol=1e-5)


def test_zeros_that_a_format_moved_lie_at_the_sensor_when_they_were_measured(tmp_path: Path) -> None:
    """A sensor 2 m ahead of a vehicle at 20 m/s: a beam at dt was 20 dt away from the sweep's origin."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 20.0
    ego, pose = EgoPath(np.array([0.0, 1.0]), poses), np.eye(4)
    pose[0, 3] = 2.0 + 20.0 * 0.5
    dt_s = np.array([-0.05, 0.0, 0.05, 0.05, -0.05], np.float32)
    xyz = np.zeros((5, 3), np.float32)
    xyz[:, 0] = [-1.0, 0.0, 1.0, -1.0, 8.0]  # the fourth is a real return: at its time the sensor was 2 m further on
    points = SweepPoints(xyz, np.zeros(5, np.float32), dt_s)
    assert at_sensor(points, 0.5, pose, ego).tolist() == [True, True, True, False, False]


def test_doctor_finds_points_at_the_sensor_and_at_one_largest_range(tmp_path: Path) -> None:
    scene = roundtrip.small_log(tmp_path / "scene")
    sweep: Sweep = scene.sweeps[0]
    points = read_points(scene, sweep)
    assert not list(check_points(scene, sweep, points))
    zeros = points.xyz.copy()
    zeros[:40] = 0
    (found,) = check_points(scene, sweep, replace(points, xyz=zeros))
    assert found.level == "warning" and f"40 of {len(zeros)} points lie within 0.05 m" in found.message
    shell = points.xyz * (120.0 / np.linalg.norm(points.xyz, axis=1, keepdims=True))
    far = np.where(np.arange(len(shell))[:, None] % 10 == 0, shell, points.xyz).astype(np.float32)
    (found,) = check_points(scene, sweep, replace(points, xyz=far))
    assert "same largest range, 120.00 m" in found.message


def test_zeros_of_merged_lidars_lie_at_their_mounts(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    truth = bad_logs.city(bad_logs.shared(tmp_path_factory) / "truth")
    database = write_nuplan.write_nuplan(truth, tmp_path / "log")
    ego = truth.ego.pose_at(truth.sweeps[0].time_s)
    mount = invert(ego) @ truth.sweeps[0].world_from_lidar
    side = mount[:3, 3] + [0.5, 0.8, -1.0]
    with sqlite3.connect(database) as connection:
        values = b"side", "side", pickle.dumps(side.tolist()), pickle.dumps([1.0, 0.0, 0.0, 0.0])
        connection.execute("INSERT INTO lidar (token, channel, translation, rotation) VALUES (?, ?, ?, ?)", values)
    connection.close()
    cloud = bad_logs.second(tmp_path / "log" / "sensor_blobs" / write_nuplan.LOG / "MergedPointCloud")
    pcd(mount[:3, :3].T @ (side - mount[:3, 3]))(cloud)
    scene = bad_logs.ingest("nuplan", database, tmp_path / "scene", bad_logs.ImportOptions())
    assert f"merged: {MARKS} of " in "\n".join(scene.source.notes)
