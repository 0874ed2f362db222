"""Fields of other programs that this program does not know: named once per kind of file and import, short and plain;
official ones never.

Official fields that no writer of these tests writes are listed here from the data sets' documentation, not taken from
the readers' tables.
"""

from __future__ import annotations

import json
import shutil
import sqlite3
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bad_logs
import numpy as np
import pytest
import write_av2
import write_nuscenes
import write_pandaset
import write_waymo
from refusals import refused
from roundtrip import needs_native

from mudg.formats import unknown_fields
from mudg.formats.importers import IMPORTERS
from mudg.formats.importers.clouds import read_cloud
from mudg.formats.importers.common import ImportOptions

Adder = Callable[[Path, Sequence[str]], object]
pytestmark = needs_native


def passed_over(names: str, kind: str) -> str:
    return f"passed over: {names} in {kind}, which this program does not know"


def said(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Lines on stderr about what was passed over."""
    return [line for line in capsys.readouterr().err.splitlines() if "passed over" in line]


def to_calibration(root: Path, names: Sequence[str]) -> None:
    with (root / "calib.txt").open("a") as file:
        file.writelines(f"{name}: 1 2 3\n" for name in names)


def to_objects(root: Path, names: Sequence[str]) -> None:
    (path,) = root.rglob("data_3d_bboxes/train/*.xml")
    extra = "".join(f"<{name}>1</{name}>" for name in names)
    path.write_text(path.read_text().replace("<index>", f"{extra}<index>"))


def to_frames(root: Path, names: Sequence[str]) -> None:
    """Empty messages with these numbers, behind every frame's own fields."""
    (path,) = root.glob("*.tfrecord")
    content, place, records = path.read_bytes(), 0, []
    while place < len(content):
        (size,) = struct.unpack_from("<Q", content, place)
        payload = content[place + 12 : place + 12 + size]
        more = b"".join(write_waymo.text(int(name.split()[-1]), b"") for name in names)
        records.append(write_waymo.record(payload + more))
        place += 16 + size
    path.write_bytes(b"".join(records))


def to_boxes_of_waymo(root: Path, names: Sequence[str]) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    (path,) = root.glob("lidar_box/*.parquet")
    table = parquet.read_table(path)
    for name in names:
        table = table.append_column(name, pa.array(np.zeros(len(table))))
    parquet.write_table(table, path)


def to_rows(root: Path, names: Sequence[str], table: str = "sample_annotation") -> None:
    def add(rows: list[dict[str, Any]]) -> None:
        for row in rows:
            row |= {name: 1 for name in names if name not in row}

    write_nuscenes.edit(root, table, add)


def to_sweeps(root: Path, names: Sequence[str]) -> None:
    for path in root.glob("sensors/lidar/*.feather"):
        write_av2.edit(path, lambda columns: columns.update({name: np.zeros(len(columns["x"])) for name in names}))


def to_poses(root: Path, names: Sequence[str]) -> None:
    for path in root.rglob("poses.json"):
        entries = json.loads(path.read_text())
        write_pandaset._dump(path, [{**entry, **dict.fromkeys(names, 0)} for entry in entries])


def to_database(root: Path, names: Sequence[str]) -> None:
    (path,) = root.rglob("*.db")
    with sqlite3.connect(path) as connection:
        for name in names:
            connection.execute(f"ALTER TABLE ego_pose ADD COLUMN {name} FLOAT")
    connection.close()


def to_clouds(root: Path, names: Sequence[str]) -> None:
    for path in root.rglob("lidar/**/*.npz"):
        arrays: dict[str, Any] = dict(np.load(path))
        np.savez(path, **{**arrays, **dict.fromkeys(names, np.zeros(len(arrays["xyz"])))})


OBJECT_FIELDS = ("category", "semanticId_orig", "dynamicSeq", "dynamicIdx", "level_min", "level_max", "color")
BOX_COLUMNS = ("num_lidar_points_in_box", "speed.x", "difficulty_level.detection")
BOX_COLUMNS = (*(f"[LiDARBoxComponent].{name}" for name in BOX_COLUMNS), "index")
CASES: dict[str, tuple[Adder, Sequence[str], str, str]] = {
    "kitti": (to_calibration, ("calib_time",), "foo", "calib.txt"),
    "kitti360": (to_objects, OBJECT_FIELDS, "foo", "2013_05_28_drive_0003_sync.xml"),
    "waymo v1": (to_frames, ("7", "8", "9", "10", "11"), "field 1000", "Frame messages"),
    "waymo v2": (to_boxes_of_waymo, BOX_COLUMNS, "[LiDARBoxComponent].foo", "lidar_box/*.parquet"),
    "nuscenes": (to_rows, ("visibility_token", "num_radar_pts", "next", "prev"), "foo", "sample_annotation.json"),
    "argoverse2": (to_sweeps, ("laser_number",), "foo", "sensors/lidar/*.feather"),
    "pandaset": (to_poses, (), "foo", "poses.json"),
    "nuplan": (to_database, ("acceleration_x", "angular_rate_z"), "foo", "the table ego_pose"),
    "custom": (to_clouds, ("ring", "near_ir"), "foo", "*.npz"),
}
"""Format -> how fields come into a file of it; official ones; one that is none; what the file is called."""


@pytest.fixture(params=CASES)
def kind(request: pytest.FixtureRequest) -> str:
    if request.param in bad_logs.NEEDS_PYARROW:
        pytest.importorskip("pyarrow")
    return request.param


@pytest.fixture
def copied(kind: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ImportOptions]:
    """A log of our own to change: its folder, and how it is imported."""
    files = bad_logs.written(kind, bad_logs.shared(tmp_path_factory))
    options = bad_logs.options_of(files)
    if not isinstance(files, bad_logs.Files):
        bad_logs.write_waymo_log(files, kind, tmp_path / "log")
        return tmp_path / "log", options
    folders = (files.source, *files.source.parents)
    folder = next(p for p in folders if (p / "sensor_blobs" if kind == "nuplan" else p).is_dir())
    return Path(shutil.copytree(folder, tmp_path / "log")), options


def source_of(kind: str, root: Path) -> Path:
    pattern = {"nuplan": "**/*.db", "waymo v1": "*.tfrecord"}.get(kind)
    return next(root.glob(pattern)) if pattern else root


def test_an_official_log_is_imported_without_a_word_and_an_unknown_field_is_named_once(
    kind: str, copied: tuple[Path, ImportOptions], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (root, options), (add, official, unknown, called) = copied, CASES[kind]
    add(root, official)
    bad_logs.ingest(kind, source_of(kind, root), tmp_path / "official", options)
    assert said(capsys) == []
    add(root, [unknown])
    for name in ("once", "again"):  # each import of a process says it
        bad_logs.ingest(kind, source_of(kind, root), tmp_path / name, options)
        assert said(capsys) == [passed_over(f"'{unknown}'", called)]


@pytest.mark.parametrize("kind", ["nuscenes"], indirect=True)
def test_each_kind_of_file_has_its_line_also_where_the_import_fails(
    copied: tuple[Path, ImportOptions], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, options = copied
    to_rows(root, ["foo"], "sample_data")
    to_rows(root, ["translatoin"], "ego_pose")
    write_nuscenes.edit(root, "ego_pose", lambda rows: rows[0].pop("translation"))
    refused("'translation' is missing", bad_logs.ingest, "nuscenes", root, tmp_path / "out", options)
    assert said(capsys) == [passed_over("'foo'", "sample_data.json"), passed_over("'translatoin'", "ego_pose.json")]


@pytest.mark.parametrize("kind", ["nuscenes"], indirect=True)
def test_hostile_names_are_short_plain_and_few(
    copied: tuple[Path, ImportOptions], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root, options = copied
    many = (f"field{number}" for number in range(5000))
    to_rows(root, ["\x1b]0;title\x07\nwarning: forged\u202e", "a" * 100_000, *many])
    bad_logs.ingest("nuscenes", root, tmp_path / "out", options)
    (line,) = said(capsys)
    assert line.startswith(r"passed over: '\x1b]0;title\x07\nwarning: forged\u202e', 'aaaa")
    # of the 1000 that are collected
    assert line.endswith(" and 992 more in sample_annotation.json, which this program does not know")
    assert len(line) < 8 * 64 + 100 and line.isprintable() and line.count("', '") == 7


def test_fields_that_a_custom_log_names_are_known_whatever_they_are_called(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "a.npz", xyz=np.ones((2, 3)), Ring=np.ones(2), helligkeit=np.ones(2), foo=np.ones(2))
    with unknown_fields.named_once():
        read_cloud(tmp_path / "a.npz", known=("helligkeit", ""))
    assert said(capsys) == ["passed over: 'foo' in *.npz, which this program does not know"]


REAL = {
    "kitti": ("kitti_2011_09_26", {"frames": (0, 2)}),
    "pandaset": ("pandaset_002", {"frames": (33, 35), "cameras": ("front",)}),
}


@pytest.mark.parametrize("name", REAL)
def test_real_logs_hold_no_unknown_field(
    name: str, shared_data: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, options = REAL[name]
    IMPORTERS[name](shared_data(folder), tmp_path / "out", ImportOptions(resolution=160, **options))
    assert said(capsys) == []
