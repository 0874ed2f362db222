"""nuPlan importer: a round trip through the published schema, choices, bait in calibration pickles, damage."""

from __future__ import annotations

import contextlib
import os
import pickle
import re
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import bad_logs
import numpy as np
import pytest
import roundtrip
import write_nuplan as made
from refusals import Asks, refused

from mudg.base.errors import InputError, UsageError
from mudg.base.types import Scene
from mudg.formats.importers import RECOGNISERS
from mudg.formats.importers.nuplan import open_log
from mudg.scene.read import read_image, read_points

truth = bad_logs.truth
pristine, source = bad_logs.fixtures(made.write_nuplan, "nuplan-v1.1")
ingest = bad_logs.importer("nuplan")

pytestmark = roundtrip.needs_native


def log(source: Path) -> Path:
    return source / "splits" / "mini" / f"{made.LOG}.db"


# --- what is read ---------------------------------------------------------------------------------


def test_round_trip(truth: Scene, pristine: Path, tmp_path: Path) -> None:
    before = log(pristine).read_bytes()
    scene = ingest(log(pristine), tmp_path / "out", workers=2)
    assert log(pristine).read_bytes() == before
    assert [path.name for path in log(pristine).parent.iterdir()] == [log(pristine).name]  # nothing is written beside
    roundtrip.assert_same_log(scene, truth, labels={"car": "vehicle"}, intensity=0.002)  # intensity has 8 bits
    assert np.abs(scene.ego.world_from_ego[0, :3, 3]).max() < 1e-9
    assert "nuPlan" in scene.source.licence
    assert sorted(name for name, part in scene.split.items() if part == "test") == ["front/000004", "front_left/000004"]
    for path in (log(pristine), pristine, pristine.parent):
        assert [name for name, looks_like in RECOGNISERS.items() if looks_like(path)] == ["nuplan"]


def test_scenes_frames_cameras_and_logs_are_chosen(truth: Scene, pristine: Path, tmp_path: Path) -> None:
    scene = ingest(log(pristine), tmp_path / "scene", sequence="scene-0001", cameras=("CAM_L0",))
    assert len(scene.sweeps) == len(scene.frames) == 2
    assert scene.id == f"{made.LOG}_scene-0001"
    assert (read_image(scene, scene.frames[0]) == read_image(truth, truth.frames_of("front_left")[3])).all()
    part = ingest(pristine, tmp_path / "part", sequence=f"{made.LOG}/scene-0000", frames=(1, 3))
    assert [sweep.time_s for sweep in part.sweeps] == pytest.approx([0.0, 0.1])
    assert len(part.frames) == 4
    for options, words in (
        ({"sequence": "scene-0009"}, "no such scene"),
        ({"cameras": ("CAM_B0",)}, "no such camera"),
        ({"untwist": "no"}, "no use for --untwist"),
    ):
        refused(words, ingest, log(pristine), tmp_path / "no", raises=UsageError, **options)
    refused("no frame lies", ingest, log(pristine), tmp_path / "no", frames=(70, 80), raises=UsageError)


def test_several_logs_need_a_name(source: Path, tmp_path: Path) -> None:
    shutil.copy(log(source), log(source).with_name("2021.06.01.db"))
    assert made.LOG in refused("several logs", ingest, source, tmp_path / "no", raises=UsageError).expected
    assert len(ingest(source, tmp_path / "yes", sequence=made.LOG, frames=(0, 1)).sweeps) == 1
    refused("no such log", ingest, source, tmp_path / "no", sequence="2022.db", raises=UsageError)


def test_distorted_images_are_rectified_and_jpeg_stays_jpeg(truth: Scene, tmp_path: Path) -> None:
    bend = (-0.35, 0.15, 0.001, -0.0005, -0.03)
    database = made.write_nuplan(truth, tmp_path / "bent", distortion=bend, jpeg=True)
    scene = ingest(database, tmp_path / "out", frames=(0, 1), cameras=("front",))
    camera = scene.cameras["front"]
    assert camera.distortion == bend
    assert camera.fx >= truth.cameras["front"].fx
    assert scene.frames[0].image.path.endswith(".jpg")
    assert any("rectified" in note for note in scene.source.notes)


def test_calibration_may_be_lists_arrays_or_the_data_sets_own_list_classes(source: Path, tmp_path: Path) -> None:
    matrix = np.array([[80.0, 0, 48], [0, 81, 32], [0, 0, 1]])
    home = "nuplan.database.common.data_types"
    as_class = f"\x80\x03c{home}\nCameraIntrinsic\n)\x81".encode("latin1") + pickle.dumps(matrix.tolist(), 3)[3:-1]
    as_class = as_class.replace(b"]q\x00", b"", 1)  # the list's items go to the object
    for blob in (pickle.dumps(matrix.tolist()), pickle.dumps(matrix), as_class + b"."):
        change(source, "UPDATE camera SET intrinsic = ?", blob)
        with open_log(log(source)) as opened:
            _, camera, _ = next(iter(opened.cameras().values()))
        assert camera.intrinsics == (80.0, 81.0, 48.5, 32.5)


# --- bait and damage ------------------------------------------------------------------------------


def test_a_calibration_that_asks_for_a_command_runs_nothing(source: Path, tmp_path: Path) -> None:
    bait = tmp_path / "ran"
    change(source, "UPDATE camera SET rotation = ?", pickle.dumps([Asks(os.system, f"touch {bait}")]))
    assert "rotation" in refused(r"asks for '(posix|nt)\.system'", ingest, source, tmp_path / "out").where
    assert not bait.exists()


def change(source: Path, words: str, *values: object) -> None:
    connection = sqlite3.connect(log(source))
    connection.execute(words, values)
    connection.commit()
    connection.close()


def sql(words: str, *values: object) -> Callable[[Path], None]:
    return lambda source: change(source, words, *values)


def blob(kind: str, index: int = 1) -> Callable[[Path], Path]:
    return lambda source: sorted((source / "sensor_blobs" / made.LOG / kind).iterdir())[index]


def rewritten(edit: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    """A cloud with other bytes."""
    return lambda s: (path := blob("MergedPointCloud")(s)).write_bytes(edit(path.read_bytes()))


CAR_BOX = made.token("box", "car-001", 1)


def cut(source: Path, size: int) -> None:
    log(source).write_bytes(log(source).read_bytes()[:size])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda s: log(s).write_bytes(b"SQLite format 3\0" + b"x" * 5000), "not a readable SQLite|damaged"),
        (lambda s: log(s).write_text("a text"), "not a readable SQLite|damaged"),
        (lambda s: cut(s, 6000), "damaged|not a readable|no table"),
        (sql("ALTER TABLE lidar_box RENAME TO boxes"), "no table 'lidar_box'"),
        (sql("ALTER TABLE ego_pose RENAME COLUMN qw TO w"), "table lacks columns"),
        (lambda s: shutil.rmtree(s / "sensor_blobs"), "sensor blobs of the log were not found"),
        (lambda s: blob("CAM_F0")(s).unlink(), "files that the log names are missing"),
        (lambda s: blob("MergedPointCloud")(s).unlink(), "files that the log names are missing"),
        (sql("UPDATE ego_pose SET timestamp = timestamp / 1000"), "no vehicle poses at the time"),
        (sql("UPDATE lidar_pc SET timestamp = timestamp / 1000"), "another unit"),
        (sql("UPDATE image SET timestamp = timestamp / 1000"), "a camera has no images"),
        (sql("UPDATE lidar_pc SET timestamp = 'soon' WHERE token = ?", made.token("cloud", 1)), "no whole number"),
        (sql("UPDATE ego_pose SET qw = qw * 1.5, qx = qx * 1.5, qy = qy * 1.5, qz = qz * 1.5"), "length 1"),
        (sql("UPDATE ego_pose SET x = NULL"), "not a finite number"),
        (sql("UPDATE lidar_pc SET ego_pose_token = x'00'"), "point cloud has no vehicle pose"),
        (sql("UPDATE lidar_pc SET lidar_token = x'00'"), "LiDAR that is not there"),
        (sql("UPDATE lidar_box SET track_token = x'00' WHERE token = ?", CAR_BOX), "names a track"),
        (sql("DELETE FROM category"), "names a track or class that is not there"),
        (sql("UPDATE lidar_box SET length = 0"), "size makes no sense"),
        (sql("UPDATE lidar_box SET yaw = 'north'"), "not a finite number"),
        (sql("UPDATE image SET filename_jpg = '../../../etc/passwd'"), "file name contains the component"),
        (sql("UPDATE lidar_pc SET filename = '/etc/passwd'"), "file name is absolute"),
        (sql("UPDATE camera SET rotation = ?", pickle.dumps([0.0, 0, 0, 0])), "length 1"),
        (sql("UPDATE camera SET intrinsic = ?", pickle.dumps([[1.0, 2], [3, 4]])), "wrong number of values"),
        (sql("UPDATE camera SET distortion = ?", pickle.dumps([0.1] * 9)), "wrong number of values"),
        (sql("UPDATE camera SET intrinsic = ?", pickle.dumps([[0.0, 0, 0]] * 3)), "not of a pinhole camera"),
        (sql("UPDATE camera SET intrinsic = ?", pickle.dumps([["a"] * 3] * 3)), "not a finite number"),
        (sql("UPDATE camera SET intrinsic = ?", b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7f."), "malformed"),
        (sql("UPDATE camera SET intrinsic = 'text'"), "no pickled list"),
        (sql("UPDATE camera SET width = 40"), "size"),
        (rewritten(lambda c: c[:700]), "cut off|bytes"),
        (rewritten(lambda c: re.sub(rb"(WIDTH|POINTS) \d+", rb"\1 99999999999", c)), "POINTS"),
        (rewritten(lambda c: c.replace(b"FIELDS x y z", b"FIELDS a y z")), "no coordinates"),
    ],
)
def test_spoilt_logs_are_refused_in_words(
    source: Path, tmp_path: Path, spoil: Callable[[Path], object], words: str
) -> None:
    spoil(source)
    roundtrip.assert_refused(ingest, log(source), tmp_path / "out", words)


@pytest.mark.parametrize(
    "instead", ["VIEW category AS SELECT * FROM real_category", "VIRTUAL TABLE category USING rtree(token, name, last)"]
)
def test_a_table_that_is_a_view_or_virtual_is_no_table(source: Path, tmp_path: Path, instead: str) -> None:
    change(source, "ALTER TABLE category RENAME TO real_category")
    change(source, f"CREATE {instead}")
    refused("no table 'category'", ingest, source, tmp_path / "out")


def test_missing_files_can_be_skipped(source: Path, tmp_path: Path) -> None:
    blob("CAM_F0")(source).unlink()
    blob("MergedPointCloud")(source).unlink()
    change(source, "DELETE FROM image WHERE token = ?", made.token("image", "CAM_L0", 2))
    scene = ingest(source, tmp_path / "out", skip_missing=True)
    assert len(scene.sweeps) == len(scene.frames_of("front")) == len(scene.frames_of("front_left")) == 4


def test_cameras_may_fire_one_after_another(source: Path, tmp_path: Path) -> None:
    """A camera 45 ms behind the other is of the same moment."""
    change(source, "UPDATE image SET timestamp = timestamp + 45000 WHERE camera_token = ?", made.token("CAM_L0"))
    scene = ingest(source, tmp_path / "out")
    front, left = (np.array([frame.view.time_s for frame in scene.frames_of(name)]) for name in ("front", "front_left"))
    assert left - front == pytest.approx(np.full(5, 0.045))
    assert {name for name, part in scene.split.items() if part == "test"} == {"front/000004", "front_left/000004"}


def test_a_cloud_without_points_is_a_cloud(source: Path, tmp_path: Path) -> None:
    blob("MergedPointCloud", 0)(source).write_bytes(made.pcd(np.zeros((0, 3)), np.zeros(0)))
    scene = ingest(source, tmp_path / "out")
    assert sorted(len(read_points(scene, sweep).xyz) for sweep in scene.sweeps)[0] == 0
    assert len(scene.sweeps) == 5


# --- values of other types ------------------------------------------------------------------------

COLUMNS = tuple(
    (
        "log.logfile ego_pose.token ego_pose.timestamp ego_pose.x ego_pose.qw camera.token camera.channel "
        "camera.translation camera.intrinsic camera.distortion camera.width image.camera_token "
        "image.filename_jpg image.timestamp lidar.token lidar.channel lidar.rotation lidar_pc.token "
        "lidar_pc.lidar_token lidar_pc.ego_pose_token lidar_pc.filename lidar_pc.timestamp "
        "lidar_box.track_token lidar_box.yaw lidar_box.width track.token track.category_token category.name "
        "scene.name"
    ).split()
)
VALUES = (
    "CAST(x'ff80' AS TEXT); 6000000000; -1; 1.5; NULL; 'text'; ''; x'00ff'; zeroblob(3000000); zeroblob(500000); 9e999"
).split("; ")


def without_types(database: Path, table: str) -> sqlite3.Connection:
    """The database with a table whose columns take values of any type."""
    connection = sqlite3.connect(database)
    drop, rename = f"DROP TABLE {table}", f"ALTER TABLE other RENAME TO {table}"
    connection.executescript(f"CREATE TABLE other AS SELECT * FROM {table}; {drop}; {rename}")
    return connection


@pytest.mark.parametrize("column", COLUMNS)
def test_values_of_other_types_are_refused_in_words(column: str, source: Path, tmp_path: Path) -> None:
    import resource

    table, _, name = column.partition(".")
    connection = without_types(log(source), table)
    row, kept = connection.execute(f"SELECT rowid, {name} FROM {table} LIMIT 1").fetchone()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number, value in enumerate(VALUES):
        connection.execute(f"UPDATE {table} SET {name} = {value} WHERE rowid = ?", (row,))
        connection.commit()
        with contextlib.suppress(InputError, UsageError):  # nothing else may be raised
            sequence = "scene-0000" if column == "scene.name" else ""
            ingest(log(source), tmp_path / f"out {number}", sequence=sequence, cameras=("front",), frames=(0, 1))
    connection.execute(f"UPDATE {table} SET {name} = ? WHERE rowid = ?", (kept, row))
    connection.close()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB


def test_doubled_rows_and_long_names_are_refused(source: Path, tmp_path: Path) -> None:
    shutil.copy(log(source), tmp_path / "whole.db")
    connection = without_types(log(source), "image")
    connection.execute("INSERT INTO image SELECT * FROM image WHERE rowid = 2")
    connection.commit()
    connection.close()
    refused("two records of one sensor have the same time", ingest, log(source), tmp_path / "out")
    for table, column in (("category", "name"), ("camera", "channel"), ("log", "logfile")):
        shutil.copy(tmp_path / "whole.db", log(source))
        change(source, f"UPDATE {table} SET {column} = ? WHERE rowid = 1", "n" * 201)
        assert table in refused("name is too long", ingest, log(source), tmp_path / "out").where
