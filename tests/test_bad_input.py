"""Broken logs and scenes: a clear error with its exit code or a stated fallback, and nothing half-written."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bad_logs
import kitti_folders as made
import numpy as np
import pytest
from bad_logs import refused
from PIL import Image
from toy_scene import ToyStreet

from mudg.base import store
from mudg.base.errors import InputError, UsageError
from mudg.formats.settings import IngestConfig
from mudg.labels.settings import AnnotateConfig
from mudg.scene.check import check_scene
from mudg.scene.clouds import read_fused
from mudg.scene.read import read_points, read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps.ingest import Annotate, Fuse, Ingest
from mudg.steps.run import Run
from mudg.steps.settings import RunConfig

ingest = bad_logs.importer("kitti")
IMAGE = "image_02/data/0000000003.png"
SCAN = "velodyne_points/data/0000000003.bin"


def rewrite(path: Path, change: Callable[[str], str]) -> None:
    text = path.read_text()
    changed = change(text)
    assert changed != text, "the test did not break anything"
    path.write_text(changed)


def cut(path: Path, share: float = 0.6) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def nan_row(root: Path) -> None:
    rows = np.fromfile(root / SCAN, "<f4")
    rows[21] = np.nan
    rows.tofile(root / SCAN)


def third_line(name: str, change: Callable[[list[str]], list[str]]) -> Callable[[Path], None]:
    def spoil(root: Path) -> None:
        lines = (root / name).read_text().splitlines()
        lines[2] = " ".join(change(lines[2].split()))
        (root / name).write_text("\n".join(lines) + "\n")

    return spoil


def text(name: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    return lambda root: rewrite(root / name, change)


POSES, LABELS, CALIB = "derived/poses_velo.txt", "derived/label_02.txt", "calib.txt"
FIRST_P2, ONE, TWICE = made.numbers(made.projection(2)), made.numbers(np.eye(3)), made.numbers(2 * np.eye(3))
NO_FOCAL = "0 " + FIRST_P2.split(" ", 1)[1]


KITTI: dict[str, tuple[str, str, Callable[[Path], object]]] = {
    # what is broken: (words of the error, where it points, how it is broken); images: test_bad_images.py
    "missing image": ("do not pair up", "", lambda r: (r / IMAGE).unlink()),
    "missing scan": ("do not pair up", "", lambda r: (r / SCAN).unlink()),
    "scan called image": ("not a PNG or JPEG", IMAGE, lambda r: (r / IMAGE).write_bytes((r / SCAN).read_bytes())),
    "image of another size": ("camera's size", IMAGE, lambda r: Image.new("RGB", (50, 20)).save(r / IMAGE)),
    "truncated scan": ("cut off", SCAN, lambda r: (r / SCAN).write_bytes((r / SCAN).read_bytes()[:-7])),
    "NaN in scan": ("not finite", SCAN, nan_row),
    "poses cut off": ("wrong number of values", "poses_velo.txt", lambda r: cut(r / POSES, 0.57)),
    "pose lost": ("lacks frames", "poses_velo.txt", text(POSES, lambda t: t[: t.rindex("\n5 ") + 1])),
    "empty pose file": ("empty", "poses_velo.txt", lambda r: (r / POSES).write_text("")),
    "no pose file": ("no vehicle poses", "", lambda r: (r / POSES).unlink()),
    "NaN pose": ("not finite", "line 3", third_line(POSES, lambda w: [*w[:4], "nan", *w[5:]])),
    "text in pose": ("not a number", "line 3", third_line(POSES, lambda w: [*w[:4], "1,5", *w[5:]])),
    "binary pose file": ("not text", "poses_velo.txt", lambda r: (r / POSES).write_bytes(b"\xff\xfe\x00" * 9)),
    "no calibration": ("no calibration", "", lambda r: (r / "calib.txt").unlink()),
    "calibration cut off": ("lacks Tr_velo_to_cam", CALIB, text(CALIB, lambda t: t[: t.index("Tr_velo")])),
    "zero focal length": ("pinhole camera", "P2", text(CALIB, lambda t: t.replace(FIRST_P2, NO_FOCAL))),
    "calibration scaled": ("is scaled", "R0_rect", text(CALIB, lambda t: t.replace(ONE, TWICE))),
    "label columns": ("number of values", "label_02.txt: line 3", third_line(LABELS, lambda w: w[:-3])),
    "label text": ("not a number", "label_02.txt: line 3", third_line(LABELS, lambda w: [*w[:-1], "left"])),
    "label NaN": ("not finite", "label_02.txt: line 3", third_line(LABELS, lambda w: [*w[:-1], "nan"])),
    "flat box": ("makes no sense", "label_02.txt: line 3", third_line(LABELS, lambda w: [*w[:10], "0", *w[11:]])),
    "two boxes of one track": ("two boxes", "label_02.txt", text(LABELS, lambda t: t + t.splitlines()[1] + "\n")),
}


PACKET, TRACKLETS, STAMPS = "oxts/data/0000000002.txt", "tracklet_labels.xml", "image_02/timestamps.txt"
SCANNED, BAIT = "velodyne_points/timestamps.txt", '<!DOCTYPE b [<!ENTITY a "b">]>'
RAW: dict[str, tuple[str, str, Callable[[Path], object]]] = {
    "missing packet": ("packets are missing", "", lambda r: (r / PACKET).unlink()),
    "packet cut off": ("wrong number of values", "", lambda r: cut(r / PACKET, 0.5)),
    "packet empty": ("packets are missing", "", lambda r: (r / PACKET).write_text("")),
    "latitude": ("out of range", "", text(PACKET, lambda t: "149" + t[2:])),
    "timestamps cut off": ("do not cover", "", lambda r: cut(r / STAMPS, 0.5)),
    "timestamps unsorted": ("do not increase", "", text(SCANNED, lambda t: "\n".join(reversed(t.splitlines())))),
    "no such day": ("no date", "", text(STAMPS, lambda t: t.replace("09-26", "09-31", 1))),
    "tracklets cut off": ("not valid XML", "", lambda r: cut(r / TRACKLETS, 0.7)),
    "entities": ("entities", "", text(TRACKLETS, lambda t: t.replace("<!DOCTYPE boost_serialization>", BAIT))),
    "tracklet without place": ("'tx'", "", text(TRACKLETS, lambda t: re.sub("(</?)tx>", r"\1xx>", t, count=2))),
    "no IMU calibration": ("where the IMU is", "", lambda r: (r.parent / "calib_imu_to_velo.txt").unlink()),
}


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    return made.write_derived(tmp_path / "drive")


@pytest.mark.parametrize(("layout", "case"), [*(("derived", case) for case in KITTI), *(("raw", case) for case in RAW)])
def test_broken_kitti_log(layout: str, case: str, tmp_path: Path) -> None:
    words, where, spoil = (KITTI if layout == "derived" else RAW)[case]
    log = (made.write_derived if layout == "derived" else made.write_raw_drive)(tmp_path / "drive")
    spoil(log)
    with pytest.raises(InputError) as caught:
        ingest(log, tmp_path / "out")
    error = caught.value
    assert words in error.what and where in error.where and error.exit_code == 3
    assert str(tmp_path / "drive") in error.where or str(tmp_path / "drive") in error.got
    assert sorted(p.name for p in tmp_path.iterdir()) == ["drive"], "something half-written is left"


def test_incomplete_frames_can_be_left_out_on_request(drive: Path, tmp_path: Path) -> None:
    (drive / IMAGE).unlink()
    (drive / "velodyne_points/data/0000000005.bin").unlink()
    scene = ingest(drive, tmp_path / "out", skip_missing=True)
    assert len(scene.frames) == len(scene.sweeps) == 4
    assert [round(f.view.time_s, 3) for f in scene.frames] == [0.0, 0.1, 0.2, 0.4]


def test_unknown_camera_and_missing_files_named_by_flags(drive: Path, tmp_path: Path) -> None:
    caught = refused("no such camera", ingest, drive, tmp_path / "out", cameras=("rear",), raises=UsageError)
    assert "front" in caught.expected
    for option in ("poses", "boxes"):
        with pytest.raises(InputError, match=f"{option[:-1]} file does not exist|box file does not exist"):
            ingest(drive, tmp_path / "out", **{option: tmp_path / "none.txt"})


# --- odd but usable: the whole way to fused clouds ------------------------------------------------


def through(source: Path, tmp_path: Path) -> tuple[Any, Any]:
    scene_path = Ingest(log=source, out=tmp_path / "scene", settings=IngestConfig()).run()
    labelled = Annotate(scene=scene_path, out=tmp_path / "labelled", settings=AnnotateConfig()).run()
    settings = FuseConfig(min_object_points=1)
    return read_scene(labelled), read_fused(Fuse(scene=labelled, out=tmp_path / "fuse", settings=settings).run())


def test_a_log_without_tracks_and_with_a_scan_without_points_is_fused(drive: Path, tmp_path: Path) -> None:
    (drive / "derived/label_02.txt").unlink()
    (drive / SCAN).write_bytes(b"")
    scene, cloud = through(drive, tmp_path)
    assert scene.tracks == ()
    assert dict(cloud.objects) == {}
    assert any("no boxes found" in note for note in scene.source.notes)
    assert len(read_points(scene, scene.sweeps[3]).xyz) == 0
    assert len(cloud.static) > 0
    assert any("no points" in f.message for f in check_scene(scene.root))


def test_one_frame(tmp_path: Path) -> None:
    source = made.write_derived(tmp_path / "drive", made.Drive((0,)))
    (source / "derived/poses_velo.txt").unlink()
    scene, cloud = through(source, tmp_path)
    assert len(scene.frames) == 1
    assert len(cloud.static) > 0


def test_no_lidar(drive: Path, tmp_path: Path) -> None:
    shutil.rmtree(drive / "velodyne_points")
    scene = ingest(drive, tmp_path / "scene")
    assert scene.sweeps == ()
    assert Annotate(scene=tmp_path / "scene", out=tmp_path / "annotated", settings=AnnotateConfig()).run().is_dir()
    refused("no LiDAR sweeps", Fuse(scene=tmp_path / "annotated", out=tmp_path / "fused", settings=FuseConfig()).run)
    assert not (tmp_path / "fused").exists()
    refused("no LiDAR sweeps", Run(source=drive, out=tmp_path / "run", settings=RunConfig()).run)
    assert not (tmp_path / "run" / "annotate").exists()  # before minutes of work, not after
    assert any("no LiDAR" in f.message and f.level == "warning" for f in check_scene(scene.root))


# --- broken scenes reach every stage the same way -------------------------------------------------


@pytest.fixture(scope="module")
def good_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("good") / "scene"
    street = ToyStreet(car_start=(12, 0), car_velocity=(3, 0), times=(0.0, 0.1, 0.2))
    street.write(root, labels=False, width=80, height=40)
    (root / store.MANIFEST).unlink()
    return root


def bend_track(root: Path) -> None:
    data = json.loads((root / "tracks.json").read_text())
    data["tracks"][0]["world_from_object"][1][0] = 0.5
    (root / "tracks.json").write_text(json.dumps(data))


FRAME, SWEEP = "images/front/000002.png", "lidar/lidar/000002.safetensors"


def sweep(**tensors: np.ndarray) -> Callable[[Path], None]:
    return lambda root: store.write_safetensors(root / SWEEP, tensors)


TWO = np.zeros(2, np.float32)
SCENES: dict[str, tuple[str, Callable[[Path], object]]] = {
    "missing image": ("missing", lambda r: (r / FRAME).unlink()),
    "truncated image": ("cannot be decoded", lambda r: cut(r / FRAME)),
    "truncated sweep": ("safetensors", lambda r: cut(r / SWEEP)),
    "missing sweep": ("missing", lambda r: (r / SWEEP).unlink()),
    "NaN pose": ("JSON", text("scene.json", lambda t: t.replace('_from_cam": [0.0', '_from_cam": [NaN', 1))),
    "bent track": ("not a rigid motion", bend_track),
    "index cut off": ("JSON", lambda r: cut(r / "scene.json")),
    "sweep is an image": ("safetensors", lambda r: (r / SWEEP).write_bytes((r / FRAME).read_bytes())),
    "sweep without intensity": ("no tensor 'intensity'", sweep(xyz=np.zeros((2, 3), np.float32))),
    "sweep in double precision": ("wrong form", sweep(xyz=np.zeros((2, 3)), intensity=np.zeros(2), dt_s=np.zeros(2))),
    "sweep with NaN": ("not finite", sweep(xyz=np.full((2, 3), np.nan, np.float32), intensity=TWO, dt_s=TWO)),
}


@pytest.mark.parametrize("case", SCENES)
@pytest.mark.parametrize("verb", ["fuse", "annotate"])
def test_broken_scene(case: str, verb: str, good_scene: Path, tmp_path: Path) -> None:
    words, spoil = SCENES[case]
    root = tmp_path / "scene"
    shutil.copytree(good_scene, root)
    spoil(root)
    step, settings = {"fuse": (Fuse, FuseConfig()), "annotate": (Annotate, AnnotateConfig())}[verb]
    with pytest.raises(InputError) as caught:
        step(scene=root, out=tmp_path / "out", settings=settings).run()
    assert words in str(caught.value)
    assert str(root) in caught.value.where
    for finished in ("fuse.json", "scene.json", "manifest.json"):
        assert not (tmp_path / "out" / finished).exists()
    assert [f for f in check_scene(root) if f.level == "error"]
