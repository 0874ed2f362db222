"""Waymo importer: damaged, contradictory and incomplete logs of both formats."""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import roundtrip
import waymo_logs
import write_waymo as made
from refusals import refused
from waymo_logs import ingest, write

from mudg.base.errors import ResourceError, UsageError
from mudg.formats.importers import RECOGNISERS
from mudg.formats.importers.waymo import logs as waymo_tfrecord
from mudg.formats.importers.waymo import records as waymo_log
from mudg.formats.importers.waymo.logs import ParquetTable
from mudg.scene.read import read_points

pytestmark = roundtrip.needs_native


@pytest.fixture
def bare(tmp_path_factory: pytest.TempPathFactory) -> made.Log:
    return waymo_logs.bare(tmp_path_factory)


def milliseconds(log: made.Log) -> None:
    for frame in log.frames:
        frame["timestamp_us"] //= 1000


def change(item: dict[str, Any], **values: Callable[[Any], Any]) -> None:
    item.update({name: value(item[name]) for name, value in values.items()})


def infinite(log: made.Log) -> None:
    log.frames[3]["lasers"][0]["returns"][0][0, 0, 0] = np.inf


def lacks_an_image(log: made.Log) -> None:
    log.frames[2]["images"].pop(1)


MIRROR, DOUBLE = np.diag([1, -1, 1, 1.0]), np.array([[2.0], [2], [2], [1]])
BOTH: dict[str, tuple[Callable[[made.Log], object], str]] = {
    "scale": (lambda log: change(log.cameras[0], extrinsic=lambda pose: pose * DOUBLE), "pose is scaled"),
    "hand": (lambda log: change(log.lasers[0], extrinsic=lambda pose: pose @ MIRROR), "left-handed"),
    "unit": (milliseconds, "not of one time"),
    "image clock": (lambda log: change(log.frames[2]["images"][1], pose_time=lambda t: t * 1e3), "not of one time"),
    "box": (lambda log: log.frames[1]["boxes"][0].update(size=(4.0, -2.0, 1.5)), "box makes no sense"),
    "rows": (lambda log: change(log.lasers[0], inclinations=lambda beams: beams[:-1]), "row for every beam"),
    "numbers": (infinite, "not finite"),
    "image": (lambda log: change(log.frames[1]["images"][0], image=lambda c: c[:300]), "cannot be decoded"),
    "camera": (lacks_an_image, "frame lacks images or scans"),
    "laser": (lambda log: log.frames[2]["lasers"].pop(0), "frame lacks images or scans"),
    "calibration": (lambda log: log.cameras.pop(1), "no calibration"),
    "laser calibration": (lambda log: log.lasers[0].update(number=9), "no calibration"),
    "pixel poses": (lambda log: change(log.frames[2]["lasers"][0], poses=lambda p: p[:, ::2]), "differ in size"),
    "exposure": (lambda log: log.frames[0]["images"][0].update(shutter=0.5), "exposure times contradict"),
    "intrinsics": (lambda log: log.cameras[0]["intrinsic"].__setitem__(2, np.nan), "intrinsics"),
    "two scans": (lambda log: change(log.frames[1], lasers=lambda lasers: lasers[:1] * 2), "two scans of one LiDAR"),
    "two images": (lambda log: log.frames[1]["images"][1].update(number=1), "two images of one camera"),
}


@pytest.mark.parametrize("form", ["v1", "v2"])
@pytest.mark.parametrize("case", BOTH)
def test_what_makes_no_sense_is_refused(case: str, form: str, bare: made.Log, tmp_path: Path) -> None:
    spoil, words = BOTH[case]
    spoil(bare)
    log = write(bare, form, tmp_path / "log")
    assert str(tmp_path) in refused(words, ingest, log, tmp_path / "scene").where
    assert list(tmp_path.iterdir()) == [tmp_path / "log"]


def test_frames_out_of_order_are_refused_in_one_file_and_sorted_in_tables(bare: made.Log, tmp_path: Path) -> None:
    bare.frames[1], bare.frames[2] = bare.frames[2], bare.frames[1]
    refused("timestamps do not increase", ingest, write(bare, "v1", tmp_path / "one"), tmp_path / "a")
    scene = ingest(write(bare, "v2", tmp_path / "two"), tmp_path / "b")
    assert [sweep.time_s for sweep in scene.sweeps] == pytest.approx(0.05 + np.arange(5) * 0.1, abs=1e-6)
    bare.frames[3]["timestamp_us"] = bare.frames[2]["timestamp_us"]
    refused("a frame twice", ingest, write(bare, "v2", tmp_path / "three"), tmp_path / "c")


@pytest.mark.parametrize("form", ["v1", "v2"])
def test_incomplete_frames_are_left_out_when_asked(form: str, bare: made.Log, tmp_path: Path) -> None:
    lacks_an_image(bare)
    bare.frames[4]["lasers"] = []
    scene = ingest(write(bare, form, tmp_path / "log"), tmp_path / "scene", skip_missing=True)
    assert len(scene.sweeps) == 3
    assert any("frames 2, 4 lack" in note for note in scene.source.notes)
    only = ingest(write(bare, form, tmp_path / "log"), tmp_path / "other", cameras=("front",), frames=(0, 4))
    assert len(only.frames) == 4  # the missing image is of a camera that was not asked for


@pytest.mark.parametrize("form", ["v1", "v2"])
def test_empty_scans_unknown_sensors_and_classes_are_taken_as_they_are(
    form: str, bare: made.Log, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for image in bare.frames[1]["lasers"][0]["returns"]:
        image[..., 0] = -1
    bare.frames[0]["boxes"][0]["id"] = "_odd"
    bare.frames[0]["boxes"][0]["type"] = 9
    odd = dict(bare.frames[0]["images"][0], number=7)
    bare.frames[0]["images"].append(odd)
    bare.frames[0]["lasers"].append({"number": 8, "returns": bare.frames[0]["lasers"][0]["returns"], "poses": None})
    scene = ingest(write(bare, form, tmp_path / "log"), tmp_path / "scene")
    assert len(read_points(scene, scene.sweeps[1]).xyz) == 0
    assert "has no points" in capsys.readouterr().err
    assert scene.track("t_odd").label == "unknown"
    assert len(scene.frames) == 10
    assert len(scene.sweeps) == 5


def test_damaged_files_are_named_with_record_and_byte(bare: made.Log, tmp_path: Path) -> None:
    path = write(bare, "v1", tmp_path / "log")
    content = path.read_bytes()
    third = list(waymo_tfrecord.record_places(path))[2].offset

    def flipped(at: int) -> bytes:
        return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]

    huge = struct.pack("<Q", 1 << 50)
    cases = (
        (content[: third + 500], "cut off"),
        (content[: third + 5], "cut off"),
        (flipped(third + 100), "do not fit their checksum"),
        (flipped(third), "header is damaged"),
        (content[:third] + huge + struct.pack("<I", made.masked(huge)) + content[third + 12 :], "no frame has"),
    )
    for spoilt, word in cases:
        path.write_bytes(spoilt)
        assert f"record 2 at byte {third}" in refused(word, ingest, path, tmp_path / "scene").where
    path.write_bytes(cases[2][0])
    assert len(ingest(path, tmp_path / "scene", frames=(0, 2)).sweeps) == 2  # what is not asked for need not be whole


def test_files_of_another_kind_are_refused(bare: made.Log, tmp_path: Path) -> None:
    path = tmp_path / "a.tfrecord"
    for content, word in (
        (b"<html>not here</html>", "not a TFRecord"),
        (b"\x1f\x8b" + bytes(40), "compressed"),
        (b"", "no frames"),
        (made.record(b"\x0a\x05ab"), "cannot be decoded"),
        (made.record(b""), "transform is incomplete"),
    ):
        path.write_bytes(content)
        refused(word, ingest, path, tmp_path / "scene")
    path.write_bytes(b"".join(made.record(made.frame_message(bare, bare.frames[n])) for n in (0, 1)))
    bare.name = "another"
    path.write_bytes(path.read_bytes() + made.record(made.frame_message(bare, bare.frames[2])))
    refused("mixes two logs", ingest, path, tmp_path / "scene")
    refused("no frames", ingest, path, tmp_path / "scene", frames=(7, 9))


def test_range_images_are_unpacked_within_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    float_image = waymo_log.float_image
    whole = made.matrix_float(np.ones((2, 3, 4), np.float32))
    assert float_image(whole, 4, "x").shape == (2, 3, 4)
    refused("wrong shape", float_image, whole, 6, "x")
    refused("cut off", float_image, whole[:-6], 4, "x")
    refused("cannot be unpacked", float_image, b"nonsense", 4, "x")
    monkeypatch.setattr(waymo_log, "MAX_UNPACKED_BYTES", 1 << 20)
    bomb = zlib.compress(bytes(2 << 20), 1)
    refused("unpacks to more", float_image, bomb, 4, "x")
    lying = made.text(1, bytes(16)) + made.text(2, b"".join(made.number(1, n) for n in (1 << 20, 1 << 20, 4)))
    refused("wrong shape", float_image, zlib.compress(lying), 4, "x")


def test_tables_that_are_missing_or_damaged(bare: made.Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = write(bare, "v2", tmp_path / "log")
    table = root / "lidar" / f"{bare.name}.parquet"
    whole = table.read_bytes()
    table.write_bytes(whole[: len(whole) // 2])
    refused("table cannot be read", ingest, root, tmp_path / "scene")
    (root / "lidar_box" / f"{bare.name}.parquet").rename(table)
    refused("lacks columns", ingest, root, tmp_path / "scene")
    table.write_bytes(whole)
    pose = root / "lidar_pose" / f"{bare.name}.parquet"
    pose.rename(root / "away")
    refused("pixel poses are missing", ingest, root, tmp_path / "scene")
    (root / "away").rename(pose)
    (root / "camera_calibration" / f"{bare.name}.parquet").unlink()
    refused("a component of the log is missing", ingest, root, tmp_path / "scene")
    pyarrow = pytest.importorskip("pyarrow")
    holes = pyarrow.table({"a": [1, None, 3]})
    pytest.importorskip("pyarrow.parquet").write_table(holes, tmp_path / "holes.parquet")
    assert refused("empty value", ParquetTable(tmp_path / "holes.parquet").columns, ("a",)).where.endswith("row 1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert "mudg[data]" in refused("pyarrow", ParquetTable, pose, raises=ResourceError).remedy


def test_one_log_of_a_folder_is_chosen_by_name(bare: made.Log, tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    names = [f"segment-{n}_with_camera_labels" for n in ("111_2", "222_3")]
    for name in names:
        made.write_tfrecord(bare, folder / f"{name}.tfrecord")
    caught = refused("several logs", ingest, folder, tmp_path / "scene", raises=UsageError)
    assert all(name in caught.expected for name in names)
    refused("there is no such log", ingest, folder, tmp_path / "scene", sequence="333", raises=UsageError)
    assert len(ingest(folder, tmp_path / "scene", sequence="222", frames=(0, 1)).frames) == 2
    assert RECOGNISERS["waymo"](folder)
    assert RECOGNISERS["waymo"](folder / f"{names[0]}.tfrecord")
    assert not RECOGNISERS["waymo"](tmp_path)
    for options in ({"poses": tmp_path}, {"boxes": tmp_path}, {"untwist": "no"}):
        with pytest.raises(UsageError):
            ingest(folder, tmp_path / "other", **options)
    refused("no Waymo log found", ingest, tmp_path / "scene", tmp_path / "other")
