"""The ingest stage: recognising logs, copying scenes, the city; reused, refused, continued."""

from __future__ import annotations

import os
import shutil
import socket
from pathlib import Path
from typing import Any

import kitti_folders as made
import numpy as np
import pytest
from refusals import refused
from toy_scene import ToyStreet

from mudg import app, native
from mudg.base import store
from mudg.base.errors import InputError, MudgError, ResourceError, UsageError
from mudg.base.run_folder import RunDir
from mudg.city.config import CityConfig
from mudg.formats import ingest
from mudg.formats.importers import IMPORTERS, files_of
from mudg.formats.importers.common import ImportOptions
from mudg.formats.settings import IngestConfig
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_scene
from mudg.scene.schema import scene_to_json_text
from mudg.steps.ingest import Ingest

needs_native = pytest.mark.skipif(native.library() is None, reason="the city needs the native library")
TINY_CITY = CityConfig(
    seed=3, n_frames=6, width=48, height=32, cameras=("front",), lidar_beams=8, lidar_azimuth_step_deg=2
)


def run(log: Path | str, out: Path, overwrite: bool = False, **settings: Any) -> Path:
    return Ingest(log=log, out=out, overwrite=overwrite, settings=IngestConfig(**settings)).run()


def test_a_kitti_folder_is_recognised_and_equals_a_direct_import(tmp_path: Path) -> None:
    drive = made.write_raw_drive(tmp_path / "day")
    scene = read_scene(run(str(drive), tmp_path / "out"))
    direct = IMPORTERS["kitti"](drive, tmp_path / "direct", ImportOptions())
    assert scene_to_json_text(scene) == scene_to_json_text(direct)
    summary = store.read_json(tmp_path / "out" / "run.json")["summary"]
    assert summary.pop("alignment").keys() == {"front"}
    assert summary == {"frames": 6, "sweeps": 6, "tracks": 1, "held_out": 1}
    assert (tmp_path / "out" / "contact_sheet.jpg").read_bytes()[:2] == b"\xff\xd8"
    small = read_scene(run(drive, tmp_path / "small", resolution="31"))
    a, b = direct.cameras["front"], small.cameras["front"]
    assert max(b.width, b.height) == 31
    assert b == a.resized(b.width, b.height)
    assert read_image(small, small.frames[0]).shape == (b.height, b.width, 3)
    assert (small.frames[3].view.world_from_cam == direct.frames[3].view.world_from_cam).all()
    assert any("resized" in note for note in small.source.notes)


def test_the_number_of_workers_changes_nothing_and_is_no_other_configuration(tmp_path: Path) -> None:
    drive = made.write_raw_drive(tmp_path / "day")
    out = run(drive, tmp_path / "one", workers=1)
    one, three = (
        {n: f for n, f in store.read_json(folder / "manifest.json")["files"].items() if not n.startswith("run.")}
        for folder in (out, run(drive, tmp_path / "three", workers=3))
    )
    assert one == three
    made_ns = (out / "scene.json").stat().st_mtime_ns
    run(drive, out, workers=2)
    assert (out / "scene.json").stat().st_mtime_ns == made_ns


@pytest.mark.parametrize(
    ("words", "out", "expected"),
    [
        (["log", "o"], None, ("auto", "log", "o")),
        (["log"], "o", ("auto", "log", "o")),
        (["kitti", "log", "o"], None, ("kitti", "log", "o")),
        (["kitti", "log"], "o", ("kitti", "log", "o")),
        (["city", "o"], None, ("auto", "city", "o")),
    ],
)
def test_words_of_the_command_line(words: list[str], out: str | None, expected: tuple[str, str, str]) -> None:
    step, _ = app.parse(["ingest", *words, *(["--out", out] if out else [])])
    assert isinstance(step, Ingest) and (step.settings.format, step.log, str(step.out)) == expected


@pytest.mark.parametrize(
    ("words", "out", "expected"),
    [
        ([], None, "no log"),
        (["log"], None, "no --out"),
        (["kitti", "log"], None, "no --out"),
        (["waymoo", "log", "o"], None, "no such format"),
        ([".", "o", "p"], None, "too many words"),
        ([".", "o"], "p", "too many words"),
    ],
)
def test_words_that_make_no_sense(words: list[str], out: str | None, expected: str) -> None:
    refused(expected, app.parse, ["ingest", *words, *(["--out", out] if out else [])], raises=UsageError)
    with pytest.raises(UsageError, match="--format was given twice"):
        app.parse(["ingest", "custom", "log", "o", "--format", "kitti"])
    with pytest.raises(UsageError, match="no such format") as caught:
        Ingest(log=".", out=Path("o"), settings=IngestConfig(format="rosbag")).run()
    assert "kitti" in caught.value.expected


def test_unknown_folders_and_missing_ones_are_named(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"x")
    with pytest.raises(InputError, match="not recognised") as caught:
        run(str(tmp_path / "photos"), tmp_path / "out")
    assert "a.jpg" in caught.value.got
    refused("does not exist", run, str(tmp_path / "nowhere"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "photos" / "image_02").mkdir()
    with pytest.raises(InputError, match="no KITTI images"):
        run(str(tmp_path / "photos"), tmp_path / "out", format="kitti")


def test_of_a_folder_with_many_logs_only_the_chosen_one_counts(tmp_path: Path) -> None:
    root = made.write_tracking(tmp_path / "training")
    for part in ("image_02", "velodyne"):
        shutil.copytree(root / part / "0003", root / part / "0004")
    config = IngestConfig(sequence="0003", contact_sheet=False)
    out = Ingest(log=root, out=tmp_path / "out", settings=config).run()
    (root / "image_02" / "0004" / "000001.png").write_bytes(b"another log")
    assert Ingest(log=root, out=out, settings=config).run() == out
    labels = root / "label_02" / "0003.txt"
    labels.write_text(labels.read_text() + "\n")
    caught = refused("another configuration", Ingest(log=root, out=out, settings=config).run, raises=UsageError)
    assert "input 'source' changed" in caught.got
    listed = files_of("kitti", root, ImportOptions(sequence="0003")).files
    names = {"image_02/0003", "velodyne/0003", "label_02/0003.txt", "calib/0003.txt", "oxts/0003.txt"}
    assert {path.relative_to(root).as_posix() for path in listed} == names


def test_of_large_releases_the_tables_and_the_names_of_files_count(tmp_path: Path) -> None:
    tables = ("v1.0-mini/scene.json", "v1.0-mini/sample_data.json")
    for name in (*tables, "samples/CAM_FRONT/a.jpg", "sweeps/LIDAR_TOP/b.bin"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("[]")
    found = files_of("nuscenes", tmp_path, ImportOptions())
    assert [path.name for path in found.files] == ["sample_data.json", "scene.json"]
    assert [path.name for path in found.entries] == ["CAM_FRONT", "LIDAR_TOP"]
    before = ingest.source_digest(tmp_path, "nuscenes", IngestConfig())
    assert ingest.source_digest(tmp_path, "nuscenes", IngestConfig()) == before
    (tmp_path / "samples/CAM_FRONT/c.jpg").write_text("one more")
    assert ingest.source_digest(tmp_path, "nuscenes", IngestConfig()) != before


def test_what_is_odd_about_a_scene_is_said_when_it_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = made.write_derived(tmp_path / "drive")
    labels = drive / "derived" / "label_02.txt"
    rows = [line.split() for line in labels.read_text().splitlines()]
    for row in rows:
        row[-1] = str(float(row[-1]) + np.pi / 2)
    labels.write_text("\n".join(" ".join(row) for row in rows) + "\n")
    run(drive, tmp_path / "out", contact_sheet=False)
    assert "track 7 (car): it moves sideways" in capsys.readouterr().err


def test_a_failed_import_leaves_nothing_and_a_repeat_finishes(tmp_path: Path) -> None:
    drive = made.write_raw_drive(tmp_path / "day")
    scan = drive / "velodyne_points" / "data" / "0000000004.bin"
    content = scan.read_bytes()
    scan.write_bytes(content[:-5])
    for config, words in ((IngestConfig(), "cut off"), (IngestConfig(cameras=("frnt",)), "no such camera")):
        with pytest.raises(MudgError, match=words):
            Ingest(log=drive, out=tmp_path / "out", settings=config).run()
        assert [path.name for path in tmp_path.iterdir()] == ["day"]
    (tmp_path / "out").mkdir()
    refused("cut off", run, drive, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []
    scan.write_bytes(content)
    assert len(read_scene(run(drive, tmp_path / "out")).frames) == 6


def test_what_a_killed_import_left_is_replaced_and_a_live_one_is_not(tmp_path: Path) -> None:
    drive = made.write_raw_drive(tmp_path / "day")
    config, out = IngestConfig(contact_sheet=False), tmp_path / "out"
    RunDir.open(out, Ingest(log="city", out=out, settings=config).output(), {"frames": "0:2"}, {"source": "another"})
    partial = out / ".scene.999999999-1.part"
    partial.mkdir()
    store.write_json(out / "lock", {"pid": os.getppid(), "host": socket.gethostname()})
    refused("another process", Ingest(log=drive, out=out, settings=config).run, raises=ResourceError)
    assert partial.is_dir()
    store.write_json(out / "lock", {"pid": 999_999_999, "host": socket.gethostname()})
    assert len(read_scene(Ingest(log=drive, out=out, settings=config).run()).frames) == 6
    assert not partial.exists()


def test_a_run_stopped_after_the_scene_was_made_is_finished_without_making_it_again(tmp_path: Path) -> None:
    drive = made.write_raw_drive(tmp_path / "day")
    out = run(drive, tmp_path / "out")
    state = store.read_json(out / "run.json")
    store.write_json(out / "run.json", {**state, "state": "running"})
    made_ns = (out / "scene.json").stat().st_mtime_ns
    run(drive, out)
    assert store.read_json(out / "run.json")["state"] == "complete"
    assert (out / "scene.json").stat().st_mtime_ns == made_ns


def test_a_scene_is_checked_and_copied(tmp_path: Path) -> None:
    scene = ToyStreet(car_start=(12, 0), car_velocity=(3, 0)).write(tmp_path / "scene")
    source = tmp_path / "scene"
    copy = read_scene(run(source, tmp_path / "out"))
    assert scene_to_json_text(copy) == scene_to_json_text(scene)
    assert (copy.tracks[0].world_from_object == scene.tracks[0].world_from_object).all()
    for frame in scene.frames:
        assert (read_image(copy, frame) == read_image(scene, frame)).all()
        for name in frame.labels:
            one, other = read_label(copy, frame, name), read_label(scene, frame, name)
            assert np.array_equal(one, other, equal_nan=name == "depth")
    for change in ({"frames": "0:2"}, {"cameras": ("front",)}, {"resolution": "60"}):
        with pytest.raises(UsageError, match="does not apply to a scene"):
            run(source, tmp_path / "refused", **change)
        with pytest.raises(UsageError, match="settings of its own"):
            run("city", tmp_path / "city", **change)


@needs_native
def test_the_city_is_made_with_the_split_asked_for_and_always_the_same(tmp_path: Path) -> None:
    config = IngestConfig(city=TINY_CITY, test_every=2)
    one = read_scene(Ingest(log="city", out=tmp_path / "one", settings=config).run())
    two = read_scene(Ingest(log="city", out=tmp_path / "two", settings=config).run())
    assert len(one.frames) == 6
    assert [i for i, s in one.split.items() if s == "test"] == ["front/000002", "front/000004"]
    assert set(one.frames[0].labels) >= {"depth", "semantics", "sky"}
    listed = [store.read_json(Path(s.root) / "manifest.json")["files"] for s in (one, two)]
    assert all(listed[1][name] == file for name, file in listed[0].items() if not name.startswith("run."))
