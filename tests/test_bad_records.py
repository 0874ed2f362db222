"""Clouds, boxes, poses, times, classes and file names that contradict a data set's rules, format by format.

Cases that a format's own test has are not repeated; docs/reference/damaged_logs.md lists them all. What is refused
leaves nothing behind.
"""

from __future__ import annotations

import gzip
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_logs
import numpy as np
import pytest
import write_av2
import write_nuscenes
from bad_logs import Change
from roundtrip import needs_native
from write_pandaset import frame_bytes, write_frame

from mudg.formats.importers.common import ImportOptions
from mudg.formats.importers.pandaset import gunzip, parse_frame, read_frame

pytestmark = needs_native


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return bad_logs.shared(tmp_path_factory)


# --- clouds ---------------------------------------------------------------------------------------


def flipped(content: bytes) -> bytes:
    """One bit changed in the middle."""
    place = len(content) // 2
    return content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :]


def test_a_cloud_that_does_not_fit_its_checksum_is_refused_by_name(folder: Path, tmp_path: Path) -> None:
    log = bad_logs.written("custom", folder)
    with bad_logs.damaged(log, "custom", "cloud", flipped, tmp_path) as (source, where):
        bad_logs.assert_refused("custom", source, tmp_path, bad_logs.options_of(log), "not a readable NPZ", where)


def brighter(columns: int) -> Change:
    """Rows of float32 whose fourth value is of another scale."""
    scale = np.array([1, 1, 1, 300, 1][:columns])
    return lambda content: (np.frombuffer(content, "<f4").reshape(-1, columns) * scale).astype("<f4").tobytes()


def brighter_frame(content: bytes) -> bytes:
    columns = parse_frame(gunzip(content, "i"), "i")
    return gzip.compress(frame_bytes({**columns, "i": columns["i"] * 300}))


@pytest.mark.parametrize(
    ("kind", "change"),
    [("kitti", brighter(4)), ("kitti360", brighter(4)), ("nuscenes", brighter(5)), ("pandaset", brighter_frame)],
)
def test_intensities_of_another_scale_are_refused_not_clipped(
    kind: str, change: Change, folder: Path, tmp_path: Path
) -> None:
    log = bad_logs.written(kind, folder)
    with bad_logs.damaged(log, kind, "cloud", change, tmp_path) as (source, where):
        words, options = "intensity is out of range", bad_logs.options_of(log)
        error = bad_logs.assert_refused(kind, source, tmp_path, options, words, where)
    assert error.remedy


# --- records ---------------------------------------------------------------------------------------


def test_a_page_of_a_waymo_table_that_does_not_fit_its_checksum_is_refused(folder: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    log = bad_logs.written("waymo v2", folder)
    source = bad_logs.write_waymo_log(log, "waymo v2", tmp_path / "log")
    table = next((source / "camera_image").iterdir())
    plain = {"compression": "none", "use_dictionary": False, "write_page_checksum": True}
    parquet.write_table(parquet.read_table(table), table, **plain)
    content = table.read_bytes()
    at = content.index(b"IDAT") + 20
    table.write_bytes(content[:at] + bytes([content[at] ^ 8]) + content[at + 1 :])
    bad_logs.assert_refused("waymo v2", source, tmp_path, ImportOptions(), "cannot be read", table.name)


def label(change: Callable[[list[str]], None]) -> Callable[[Path], None]:
    """Change the words of every KITTI label."""

    def spoil(root: Path) -> None:
        path = root / "derived" / "label_02.txt"
        rows = [line.split() for line in path.read_text().splitlines()]
        for row in rows:
            change(row)
        path.write_text("\n".join(" ".join(row) for row in rows) + "\n")

    return spoil


def times(factor: float) -> Callable[[Path], None]:
    text = "\n".join(str(0.1 * n * factor) for n in range(6)) + "\n"
    return lambda root: (root / "times.txt").write_text(text) and None


def nuplan(question: str) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        connection = sqlite3.connect(next(root.rglob("*.db")))
        connection.execute(question)
        connection.commit()
        connection.close()

    return spoil


def nuscenes(table: str, change: Callable[[list[dict[str, Any]]], None]) -> Callable[[Path], None]:
    return lambda root: write_nuscenes.edit(root, table, change)


def backslashes(rows: list[dict[str, Any]]) -> None:
    for row in rows:
        row["filename"] = row["filename"].replace("/", "\\")


LONG = "n" * 201


def long_column(name: str) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        change = lambda c: c.update({name: np.full(len(c["category"]), LONG, object)})
        write_av2.edit(root / "annotations.feather", change)

    return spoil


def text(pattern: str, old: str, new: str) -> Callable[[Path], None]:
    """Replaces a text in the one file that fits the pattern."""

    def spoil(root: Path) -> None:
        (path,) = root.glob(pattern)
        content = path.read_text()
        assert old in content
        path.write_text(content.replace(old, new))

    return spoil


def lost(folder: str) -> Callable[[Path], None]:
    return lambda root: bad_logs.second(root / folder).unlink()


def long_labels(root: Path) -> None:
    for path in root.glob("001/annotations/cuboids/*.pkl.gz"):
        columns = read_frame(path)
        write_frame(path, {**columns, "label": np.full(len(columns["label"]), LONG, object)})


TOO_LONG = "name is too long"
SWAP = "UPDATE lidar_box SET width = length, length = width"
BACKSLASH = "UPDATE image SET filename_jpg = replace(filename_jpg, '/', '\\')"
LONG_NUMBER = text("data_3d_bboxes/train/*.xml", "<instanceId>1<", f"<instanceId>{'1' * 300}<")
RECORDS: dict[tuple[str, str], tuple[Callable[[Path], None], str, str]] = {
    # format and what is wrong: (how the log is damaged, words of the error, the place it names)
    ("kitti", "times in milliseconds"): (times(1000), "another unit", "drive|kitti"),
    ("kitti", "times in microseconds"): (times(1e6), "another unit", "kitti"),
    ("kitti", "width and length swapped"): (label(lambda row: row.insert(11, row.pop(12))), "swapped", "label_02.txt"),
    ("nuscenes", "Windows path"): (nuscenes("sample_data", backslashes), "backslash", "sample_data.json: record"),
    ("nuplan", "Windows path"): (nuplan(BACKSLASH), "backslash", "image at"),
    ("nuplan", "width and length swapped"): (nuplan(SWAP), "swapped", "lidar_box"),
    ("kitti", "class of 201 letters"): (text("derived/label_02.txt", "Car", LONG), TOO_LONG, "label_02.txt"),
    ("kitti360", "number of an object of 300 digits"): (LONG_NUMBER, TOO_LONG, "id of an object"),
    ("nuscenes", "class of 201 letters"): (
        nuscenes("category", lambda rows: rows[0].update(name=LONG)),
        TOO_LONG,
        "sample_annotation.json",
    ),
    ("argoverse2", "class of 201 letters"): (long_column("category"), TOO_LONG, "annotations.feather"),
    ("argoverse2", "id of 201 letters"): (long_column("track_uuid"), TOO_LONG, "annotations.feather"),
    ("pandaset", "class of 201 letters"): (long_labels, TOO_LONG, "cuboids"),
    ("custom", "class of 201 letters"): (text("log.json", '"class": "car"', f'"class": "{LONG}"'), TOO_LONG, "tracks"),
    ("nuscenes", "missing cloud"): (lost("samples/LIDAR_TOP"), "missing", "LIDAR_TOP"),
    ("nuscenes", "missing image"): (lost("samples/CAM_FRONT"), "missing", "CAM_FRONT"),
}


@pytest.mark.parametrize(("kind", "case"), RECORDS)
def test_a_bad_record_is_refused_by_name(kind: str, case: str, folder: Path, tmp_path: Path) -> None:
    log = bad_logs.written(kind, folder)
    spoil, words, where = RECORDS[kind, case]
    root = shutil.copytree(folder / kind, tmp_path / kind)
    spoil(root)
    source = root / log.source.relative_to(folder / kind)
    bad_logs.assert_refused(kind, source, tmp_path, bad_logs.options_of(log), words, where)


# --- taken, and said ------------------------------------------------------------------------------


def test_rows_in_any_order_give_the_same_scene(folder: Path, tmp_path: Path) -> None:
    """Tables and lists whose order means nothing: poses and boxes of Argoverse 2, images and sweeps of nuScenes."""
    pytest.importorskip("pyarrow")
    for kind, spoil in (
        ("argoverse2", reversed_tables),
        ("nuscenes", nuscenes("sample_data", lambda rows: rows.reverse())),
    ):
        log = bad_logs.written(kind, folder)
        options = bad_logs.options_of(log)
        plain = bad_logs.ingest(kind, log.source, tmp_path / f"{kind} plain", options)
        root = shutil.copytree(log.source, tmp_path / kind)
        spoil(root)
        other = bad_logs.ingest(kind, root, tmp_path / f"{kind} other", options)
        assert [frame.id for frame in other.frames] == [frame.id for frame in plain.frames]
        for one, two in zip(plain.frames, other.frames, strict=True):
            assert np.array_equal(one.view.world_from_cam, two.view.world_from_cam)
        one, two = ({t.id: t.world_from_object[:, :3, 3].round(9).tolist() for t in s.tracks} for s in (plain, other))
        assert one == two


def reversed_tables(root: Path) -> None:
    for name in ("city_SE3_egovehicle.feather", "annotations.feather"):
        write_av2.edit(root / name, lambda c: c.update({key: values[::-1] for key, values in c.items()}))
