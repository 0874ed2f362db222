"""Scene directories: what is written is what is read; nothing half-written, nothing outside, nothing silently wrong."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from refusals import refused
from toy_scene import ToyStreet

from mudg.base import store
from mudg.base.errors import InputError, IntegrityError
from mudg.base.geometry import yaw_matrix
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, Track, View
from mudg.scene.check import check_scene
from mudg.scene.labels import read_label, read_trusted_classes
from mudg.scene.read import read_image, read_points, read_scene
from mudg.scene.schema import ref_problem
from mudg.scene.write import SceneWriter

CAMERA = Camera("front", 32, 20, 30.0, 31.0, 16.0, 10.0, (0.1, -0.02), 0.005)


def view_at(time_s: float, camera: Camera = CAMERA) -> View:
    return View(camera, yaw_matrix(0.1 * time_s, (3 * time_s, 0.2, 1.5)), time_s)


def random_image(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (20, 32, 3)).astype(np.uint8)


def some_points(count: int = 7) -> SweepPoints:
    rng = np.random.default_rng(count)
    xyz, intensity, dt_s = rng.normal(size=(count, 3)), rng.random(count), rng.uniform(-0.05, 0.05, count)
    return SweepPoints(xyz.astype(np.float32) * 10, intensity.astype(np.float32), dt_s.astype(np.float32))


def fill(writer: SceneWriter, frames: int = 3) -> None:
    writer.add_camera(CAMERA)
    for n in range(frames):
        writer.add_frame(f"front/{n:06d}", view_at(0.1 * n), random_image(n))
        writer.add_sweep(f"top/{n:06d}", "top", 0.1 * n, yaw_matrix(0.2 * n), some_points(5 + n))
    writer.set_ego(EgoPath(np.array([0.0, 0.3]), np.stack([np.eye(4), yaw_matrix(0.1, (1, 2, 3))])))


STILL = EgoPath(np.zeros(1), np.eye(4)[None])


def open_writer(root: Path, recipe: dict[str, Any] | None = None, **options: Any) -> SceneWriter:
    return SceneWriter(root, "small", Source("test", "none", recipe), **options)


def small_scene(root: Path) -> Scene:
    with open_writer(root) as writer:
        fill(writer)
        return writer.finish()


# --- round trips ----------------------------------------------------------------------------------


def test_everything_comes_back_exactly(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    poses = np.stack([yaw_matrix(a, rng.normal(size=3) * 100) for a in rng.uniform(-3, 3, 4)])
    track = Track("a/b c", "car", [4.1, 1.8, 1.5], [0.0, 0.1, 0.25, 0.3], poses)
    source = Source("city", "CC0", {"seed": 3, "nested": {"x": [1, 2.5]}}, ("a note", "ünïcode"))
    depth = rng.uniform(1, 90, (20, 32)).astype(np.float32)
    depth[3, 4], depth[5, 6], depth[7, 8], depth[9, 1] = np.inf, np.nan, 0, -2
    labels = {
        "depth": depth,
        "semantics": rng.choice([*range(19), 255], (20, 32)).astype(np.uint8),
        "sky": rng.random((20, 32)) > 0.5,
        "dynamic": rng.random((20, 32)) > 0.5,
        "instance": rng.integers(0, 70000, (20, 32)).astype(np.int32),
        "semantics_confidence": rng.random((20, 32)).astype(np.float32),
    }
    with SceneWriter(tmp_path / "scene", "round trip", source) as writer:
        writer.add_camera(CAMERA)
        writer.add_frame("front/000007", view_at(0.123456789012345), random_image(1), labels)
        writer.add_sweep("top/000000", "top", 0.1, poses[0], some_points())
        writer.add_track(track)
        writer.set_ego(EgoPath(np.array([0.0, 1.0]), poses[:2]))
        writer.set_split({"front/000007": "test"})
        writer.finish()
    scene = read_scene(tmp_path / "scene")
    frame, sweep, read_track = scene.frames[0], scene.sweeps[0], scene.tracks[0]
    assert scene.cameras["front"] == CAMERA == frame.view.camera
    assert frame.view.time_s == 0.123456789012345
    assert (frame.view.world_from_cam == view_at(0.123456789012345).world_from_cam).all()
    assert (sweep.world_from_lidar == poses[0]).all()
    assert (read_track.world_from_object == poses).all()
    assert (read_track.id, read_track.label, read_track.size_m.tolist()) == ("a/b c", "car", [4.1, 1.8, 1.5])
    assert (scene.ego.world_from_ego == poses[:2]).all()
    assert dict(scene.split) == {"front/000007": "test"}
    assert (scene.source.dataset, scene.source.licence, scene.source.notes) == ("city", "CC0", ("a note", "ünïcode"))
    assert dict(scene.source.recipe or {}) == {"seed": 3, "nested": {"x": [1, 2.5]}}
    assert (read_image(scene, frame) == random_image(1)).all()
    points = read_points(scene, sweep)
    for name in ("xyz", "intensity", "dt_s"):
        assert (getattr(points, name) == getattr(some_points(), name)).all()
    for name, array in labels.items():
        found = read_label(scene, frame, name)
        if name == "depth":
            bad = ~(np.isfinite(array) & (array > 0))
            assert (np.isnan(found) == bad).all()
            assert bad.sum() == 4
            found, array = found[~bad], array[~bad]
        assert found.dtype == array.dtype
        assert (found == array).all(), name
    trusted = read_trusted_classes(scene, frame, 0.4)
    doubtful = read_label(scene, frame, "semantics_confidence") < 0.4
    assert (trusted[doubtful] == 255).all()
    assert (trusted[~doubtful] == labels["semantics"][~doubtful]).all()


def test_ready_made_image_bytes_are_kept(tmp_path: Path) -> None:
    smooth, file = np.broadcast_to(np.arange(32, dtype=np.uint8)[None, :, None] * 7, (20, 32, 3)), tmp_path / "a.jpg"
    Image.fromarray(smooth.copy()).save(file)
    with SceneWriter(tmp_path / "copy", "c", Source("t", "n")) as writer:
        writer.add_camera(CAMERA)
        writer.add_frame("front/000000", view_at(0), file)
        writer.add_frame("front/000001", view_at(1), file.read_bytes())
        writer.set_ego(STILL)
        copied = writer.finish()
    for frame in copied.frames:
        assert frame.image.path.endswith(".jpg")
        assert (Path(copied.root) / frame.image.path).read_bytes() == file.read_bytes()


def copied(scene: Scene, root: Path, labels: dict[str, np.ndarray] | None = None) -> Scene:
    with SceneWriter(root, scene.id, scene.source) as writer:
        writer.copy_all_but_frames(scene)
        for frame in scene.frames:
            writer.copy_frame(scene, frame, labels)
        return writer.finish()


def test_a_copy_is_the_same_to_the_byte_also_without_hashes(tmp_path: Path) -> None:
    first = ToyStreet(car_start=(12, 0), car_velocity=(3, 0)).write(tmp_path / "first")
    scene = copied(first, tmp_path / "scene")  # labels of a frame in the order of every copy
    files = {name: (tmp_path / "scene" / name).read_bytes() for name in store.list_files(tmp_path / "scene")}
    copied(scene, tmp_path / "folder")
    (tmp_path / "scene" / "manifest.json").unlink()
    copied(read_scene(tmp_path / "scene"), tmp_path / "checked")
    for copy in ("folder", "checked"):
        assert {name: (tmp_path / copy / name).read_bytes() for name in store.list_files(tmp_path / copy)} == files
    for name in set(files) - {"scene.json", "manifest.json"}:
        assert (tmp_path / "first" / name).read_bytes() == files[name]


def test_a_copy_refuses_what_is_damaged_with_hashes_and_without(tmp_path: Path) -> None:
    scene = small_scene(tmp_path / "scene")
    file = tmp_path / "scene" / scene.sweeps[1].points.path
    file.write_bytes(file.read_bytes()[:-3])
    refused("differs from what was written", copied, scene, tmp_path / "a", raises=IntegrityError)
    (tmp_path / "scene" / "manifest.json").unlink()
    refused("safetensors", copied, scene, tmp_path / "b")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene"]


def test_frames_come_in_time_order_whatever_the_order_of_writing(tmp_path: Path) -> None:
    side = replace(CAMERA, name="side")
    with open_writer(tmp_path / "s") as writer:
        writer.add_camera(CAMERA)
        writer.add_camera(side)
        for camera in (side, CAMERA):
            for n in (2, 0, 1):
                writer.add_frame(f"{camera.name}/{n:06d}", view_at(0.1 * n, camera), random_image(n))
        writer.set_ego(STILL)
        scene = writer.finish()
    assert [f.id for f in scene.frames] == [f"{c}/{n:06d}" for n in range(3) for c in ("front", "side")]
    assert set(scene.split.values()) == {"train"}


# --- completely or not at all ---------------------------------------------------------------------


def test_a_failure_while_writing_leaves_nothing(tmp_path: Path) -> None:
    def write(stop: bool) -> None:
        with open_writer(tmp_path / "out" / "scene") as writer:
            writer.add_camera(CAMERA)
            writer.add_frame("front/000000", view_at(0), random_image(0))
            if stop:
                raise RuntimeError("stop")
            writer.finish()

    for error, words, stop in ((RuntimeError, "stop", True), (InputError, "ego path", False)):
        refused(words, write, stop, raises=error)
        assert list((tmp_path / "out").iterdir()) == []


def test_what_a_killed_writer_left_is_cleared_and_a_live_one_is_not(tmp_path: Path) -> None:
    dead = tmp_path / ".scene.999999999-1.part"
    alive = tmp_path / f".scene.{os.getppid()}-1.part"
    for folder in (dead, alive):
        (folder / "images").mkdir(parents=True)
    small_scene(tmp_path / "scene")
    assert alive.exists() and not dead.exists()
    inside = tmp_path / "there" / ".scene.999999999-1.part"
    inside.mkdir(parents=True)
    small_scene(tmp_path / "there")
    names = "images lidar manifest.json scene.json tracks.json".split()
    assert sorted(p.name for p in (tmp_path / "there").iterdir()) == names


def test_the_current_folder_can_be_the_destination(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(small_scene(Path()).frames) == 3


def test_bookkeeping_in_the_destination_stays_and_a_scene_there_is_refused(tmp_path: Path) -> None:
    root = tmp_path / "scene"
    (root / "images").mkdir(parents=True)  # half a move of an earlier, killed finish
    (root / "run.json").write_text("{}")
    scene = small_scene(root)
    assert (root / "run.json").read_text() == "{}"
    assert len(read_scene(root).frames) == 3
    refused("scene here already", open_writer, root)
    assert (read_image(scene, scene.frames[0]) == random_image(0)).all()


def test_every_byte_is_covered_by_the_manifest(tmp_path: Path) -> None:
    root = tmp_path / "scene"
    scene = small_scene(root)
    store.verify_manifest(root)
    listed = set(store.read_json(root / "manifest.json")["files"])
    assert listed == {p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file()} - {"manifest.json"}
    file = root / scene.sweeps[1].points.path
    content = bytearray(file.read_bytes())
    content[-3] ^= 4  # one bit of one coordinate: still a perfectly readable file
    file.write_bytes(content)
    refused("differs from what was written", read_points, scene, scene.sweeps[1], raises=IntegrityError)
    (root / "manifest.json").unlink()
    assert len(read_points(read_scene(root), scene.sweeps[1]).xyz) == 6


# --- the writer refuses ---------------------------------------------------------------------------


def bad_frames() -> dict[str, tuple[str, Callable[[SceneWriter], None]]]:
    nan_pose = np.eye(4)
    nan_pose[0, 3] = np.nan
    image, side, changed = random_image(0), replace(CAMERA, name="side"), replace(CAMERA, fx=50.0)
    doubled = np.full((20, 32), 2.0)
    return {
        "unknown camera": ("not added", lambda w: w.add_frame("side/000000", view_at(0, side), image)),
        "changed camera": ("not added", lambda w: w.add_frame("front/000009", view_at(0, changed), image)),
        "id of another camera": ("does not fit", lambda w: w.add_frame("side/000001", view_at(0), image)),
        "id that climbs": ("does not fit", lambda w: w.add_frame("front/../../x", view_at(0), image)),
        "twice": ("added twice", lambda w: w.add_frame("front/000000", view_at(9), image)),
        "float image": ("wrong form", lambda w: w.add_frame("front/000009", view_at(9), image / 255)),
        "not an image": ("not a PNG or JPEG", lambda w: w.add_frame("front/000009", view_at(9), b"hello")),
        "label size": ("camera's size", lambda w: w.add_label("front/000000", "sky", np.zeros((3, 3)))),
        "label name": ("no such label", lambda w: w.add_label("front/000000", "skies", np.zeros((20, 32)))),
        "class 19": ("no train id", lambda w: w.add_label("front/000000", "semantics", np.full((20, 32), 19))),
        "confidence 2": ("outside 0..1", lambda w: w.add_label("front/000000", "depth_confidence", doubled)),
        "NaN sweep pose": ("rigid", lambda w: w.add_sweep("top/000009", "top", 9.0, nan_pose, some_points())),
        "NaN point": ("not finite", lambda w: w.add_sweep("top/000009", "top", 9.0, np.eye(4), nan_points())),
        "camera name": ("folder name", lambda w: w.add_camera(replace(CAMERA, name="../x"))),
        "focal length": ("focal length", lambda w: w.add_camera(replace(CAMERA, name="b", fx=1e-4))),
    }


def nan_points() -> SweepPoints:
    points = some_points()
    points.xyz[2, 1] = np.nan
    return points


@pytest.mark.parametrize("case", bad_frames())
def test_writer_refuses(case: str, tmp_path: Path) -> None:
    words, act = bad_frames()[case]
    with open_writer(tmp_path / "s") as writer:
        fill(writer)
        refused(words, act, writer)
        if case not in ("twice",):
            assert len(writer.finish().frames) == 3  # the refusal did not spoil what was there


def test_what_could_not_be_read_back_is_not_put_in_place(tmp_path: Path) -> None:
    with open_writer(tmp_path / "s", {"seed": 1}) as writer:
        fill(writer)
        writer.set_split({"front/000000": "val"})
        refused("'train' or 'test'", writer.finish)
    with open_writer(tmp_path / "t", {"when": object()}) as writer:
        fill(writer)
        refused("cannot hold", writer.finish)
    with open_writer(tmp_path / "u") as writer:
        fill(writer)
        writer.add_frame("front/000009", view_at(0.1), random_image(0))
        refused("do not increase", writer.finish)
    assert list(tmp_path.iterdir()) == []


# --- the reader refuses ---------------------------------------------------------------------------


def edited(root: Path, change: Callable[[dict[str, Any]], object], name: str = "scene.json") -> Path:
    """A scene whose index was edited by hand (and whose manifest was therefore removed)."""
    small_scene(root)
    (root / "manifest.json").unlink()
    data = json.loads((root / name).read_text())
    change(data)
    (root / name).write_text(json.dumps(data))
    return root


IDENTITY = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]
MIRRORED, SCALED = [-1.0, *IDENTITY[1:]], [1.1, *IDENTITY[1:]]
NOWHERE = "images/front/777.png"
EDITS: dict[str, tuple[str, str, Callable[[dict[str, Any]], object]]] = {
    "version": ("schema version", "schema_version", lambda d: d.update(schema_version=99)),
    "format": ("not a mudg-scene", "scene.json", lambda d: d.update(format="other")),
    "typo": ("unknown field", "frames[1]", lambda d: d["frames"][1].update(world_from_camera=IDENTITY)),
    "missing field": ("missing", "frames[0]", lambda d: d["frames"][0].pop("image")),
    "mirrored pose": ("rigid", "frames[0].world_from_cam", lambda d: d["frames"][0].update(world_from_cam=MIRRORED)),
    "short pose": ("3x4", "frames[2].world_from_cam", lambda d: d["frames"][2].update(world_from_cam=IDENTITY[:11])),
    "text in pose": ("not a number", "from_cam[3]", lambda d: d["frames"][2]["world_from_cam"].__setitem__(3, "x")),
    "huge number": ("beyond what a number can be", "", lambda d: d["frames"][2].update(time_s=10**400)),
    "true as number": ("not a number", "time_s", lambda d: d["frames"][2].update(time_s=True)),
    "zero focal length": ("focal length", "cameras.front.fx", lambda d: d["cameras"]["front"].update(fx=0)),
    "focal length in mm": ("focal length", "cameras.front.fy", lambda d: d["cameras"]["front"].update(fy=0.004)),
    "principal point": ("principal point", "cameras.front.cx", lambda d: d["cameras"]["front"].update(cx=9000)),
    "unknown camera": ("does not have", "frames[0].camera", lambda d: d["frames"][0].update(camera="rear")),
    "no frames": ("no frames", "frames", lambda d: d.update(frames=[], split={})),
    "no cameras": ("no cameras", "cameras", lambda d: d.update(cameras={}, frames=[])),
    "double id": ("twice", "frames", lambda d: d["frames"][1].update(id="front/000000")),
    "unsorted": ("do not increase", "frames of camera front", lambda d: d["frames"].reverse()),
    "split": ("does not have", "split", lambda d: d["split"].update({"front/000099": "test"})),
    "split word": ("'train' or 'test'", "split.front/000000", lambda d: d["split"].update({"front/000000": "val"})),
    "missing file": ("missing", "frame front/000001 image", lambda d: d["frames"][1].update(image=NOWHERE)),
    "shared file": ("same file", "front/000001", lambda d: d["frames"][1].update(image="images/front/000000.png")),
    "climbing ref": ("'..'", "frames[1].image", lambda d: d["frames"][1].update(image="../../etc/passwd")),
    "absolute ref": ("absolute", "frames[1].image", lambda d: d["frames"][1].update(image="/etc/passwd")),
    "control character": ("control", "frames[1].image", lambda d: d["frames"][1].update(image="images/a\u0000.png")),
    "ego": ("pair up", "ego", lambda d: d["ego"]["times_s"].pop()),
    "ego order": ("do not increase", "ego", lambda d: d["ego"]["times_s"].reverse()),
    "notes": ("not a text", "source.notes[0]", lambda d: d["source"].update(notes=[1])),
}


@pytest.mark.parametrize("case", EDITS)
def test_reader_refuses_in_words(case: str, tmp_path: Path) -> None:
    words, where, change = EDITS[case]
    root = edited(tmp_path / "scene", change)
    assert where in refused(re.escape(words), read_scene, root).where
    assert [f for f in check_scene(root) if f.level == "error" and where in f.where and words in f.message]


def test_a_scene_needs_no_manifest_sweeps_tracks_or_split(tmp_path: Path) -> None:
    root = edited(tmp_path / "scene", lambda d: [d.pop(key) for key in ("sweeps", "split", "conventions")])
    (root / "tracks.json").unlink()
    scene = read_scene(root)
    assert scene.sweeps == scene.tracks == ()
    assert set(scene.split.values()) == {"train"}


def test_poses_may_be_given_as_rows(tmp_path: Path) -> None:
    rows = yaw_matrix(0.3, (1, 2, 3)).tolist()
    root = edited(tmp_path / "scene", lambda d: d["frames"][0].update(world_from_cam=rows))
    assert (read_scene(root).frames[0].view.world_from_cam == np.array(rows)).all()


def test_json_must_be_strict(tmp_path: Path) -> None:
    root = edited(tmp_path / "scene", lambda d: None)
    good = (root / "scene.json").read_text()
    not_a_number, twice = good.replace("0.1", "NaN", 1), good.replace('"id"', '"id": "x", "id"', 1)
    texts = {"JSON": good[: len(good) // 2], "NaN": not_a_number, "not an object": "[]", "twice": twice}
    for words, text in (*texts.items(), ("JSON", "")):
        (root / "scene.json").write_text(text)
        refused(words, read_scene, root)


def test_a_link_out_of_the_scene_is_refused(tmp_path: Path) -> None:
    root = edited(tmp_path / "scene", lambda d: None)
    image = root / "images/front/000001.png"
    image.rename(tmp_path / "secret.png")
    image.symlink_to(tmp_path / "secret.png")
    refused("leads out", read_scene, root)
    image.unlink()
    image.symlink_to(root / "images/front/000002.png")  # inside is fine
    assert len(read_scene(root).frames) == 3


@given(st.text(max_size=30) | st.lists(st.sampled_from(["a", "..", ".", "", "b c", "C:", "x.png", "\\"])).map("/".join))
def test_accepted_references_stay_inside(text: str) -> None:
    if ref_problem(text) is None:
        assert not {"..", "/", "."} & set(PurePosixPath(text).parts)
        assert os.path.normpath(os.path.join("/root/scene", text)).startswith("/root/scene/")


def test_not_a_scene(tmp_path: Path) -> None:
    refused("does not exist", read_scene, tmp_path / "nowhere")
    refused("not a scene", read_scene, tmp_path)
    (tmp_path / "a.zip").write_bytes(b"PK nothing")
    refused("does not exist", read_scene, tmp_path / "a.zip")


# --- doctor ---------------------------------------------------------------------------------------


def test_check_finds_nothing_wrong_with_a_good_scene(tmp_path: Path) -> None:
    ToyStreet(car_start=(12, 0), car_velocity=(3, 0)).write(tmp_path / "scene")
    assert check_scene(tmp_path / "scene") == []


def test_check_lists_all_errors_at_once_worst_first(tmp_path: Path) -> None:
    def spoil(data: dict[str, Any]) -> None:
        data["frames"][0]["world_from_cam"][0] = 5
        data["frames"][2]["image"] = "images/front/none.png"
        data["sweeps"][1]["time_s"] = "noon"

    root = edited(tmp_path / "scene", spoil)
    (root / "lidar/top/000002.safetensors").write_bytes(b"short")
    findings = check_scene(root)
    errors = [f for f in findings if f.level == "error"]
    assert [f.level for f in findings] == sorted((f.level for f in findings), key=["error", "warning", "note"].index)
    for where in ("frames[0].world_from_cam", "front/000002", "sweeps[1].time_s", "top/000002"):
        assert any(where in f.where or where in f.message for f in errors), where


def test_check_names_what_is_odd(tmp_path: Path) -> None:
    with open_writer(tmp_path / "s") as writer:
        writer.add_camera(CAMERA)
        for n in range(3):
            # z forward of the camera is up: not a street
            tilted = View(CAMERA, yaw_matrix(0, (40.0 * n, 0, 0)), 0.1 * n)
            writer.add_frame(f"front/{n:06d}", tilted, np.full((20, 32, 3), 7, np.uint8))
        below, bright = np.tile(np.float32([[0, 0, -9]]), (4, 1)), np.full(4, 90, np.float32)
        behind = SweepPoints(below, bright, np.zeros(4, np.float32))
        writer.add_sweep("top/000000", "top", 0.0, np.eye(4), behind)
        writer.add_sweep("top/000001", "top", 0.1, np.eye(4), some_points(0))
        poses = np.stack([yaw_matrix(0, (0, 0, 0)), yaw_matrix(0, (900.0, 0, 0))])
        writer.add_track(Track("1", "car", [1.8, 4.5, 1.5], [0.0, 5.0], poses))
        writer.add_track(Track("2", "car", [4.5, 1.8, 1.5], [70.0, 71.0], np.stack([np.eye(4)] * 2)))
        writer.add_track(Track("3", "barrier", [0.6, 2.5, 1.0], [0.0, 0.1], np.stack([np.eye(4)] * 2)))
        writer.set_ego(EgoPath(np.array([0.0, 0.1]), np.stack([np.eye(4), yaw_matrix(0, (50, 0, 0))])))
        writer.finish()
    findings = check_scene(tmp_path / "s")
    assert not [f for f in findings if f.where.startswith("track 3")]  # a barrier may be wider than long
    assert not [f for f in findings if f.level == "error"]
    said = """moves at 400 m/s, down direction, moves at 500 m/s, width and length swapped, moves at 180 m/s,
        not seen for 5.0 s, lie outside the time, no points, intensity reaches 90, none of its points falls,
        one flat colour, no sweep within, no frame is held out"""
    for words in " ".join(said.split()).split(", "):
        assert any(words in f.message for f in findings), words
