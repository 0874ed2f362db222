"""The neutral layout: round trips in every cloud form, the template converter, and each trap refused in words."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import bad_logs
import numpy as np
import pytest
import roundtrip
import write_custom
from bad_logs import refused

from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import invert
from mudg.base.types import Scene, SweepPoints, Track
from mudg.formats.importers import IMPORTERS, RECOGNISERS, common, custom
from mudg.formats.importers.common import ImportOptions
from mudg.formats.importers.custom import read_log
from mudg.scene.read import read_points

truth = bad_logs.truth
pristine, log = bad_logs.fixtures(write_custom.write_log, "log")

pytestmark = roundtrip.needs_native
ingest = bad_logs.importer("custom")
LIDAR = "lidar"


def edit(log: Path, change: Any) -> None:
    content = json.loads((log / "log.json").read_text())
    change(content)
    (log / "log.json").write_text(json.dumps(content))


def words_of(log: Path, level: str = "error") -> str:
    return "\n".join(f"{f.where}: {f.message}" for f in custom.check_log(log) if f.level == level)


# ---- round trips ----


@pytest.mark.parametrize("suffix", list(write_custom.CLOUDS))
def test_what_was_written_is_read_back(truth: Scene, tmp_path: Path, suffix: str) -> None:
    log = write_custom.write_log(truth, tmp_path / "log", suffix)
    assert [name for name, looks_like in RECOGNISERS.items() if looks_like(log)] == ["custom"]
    scene = ingest(log, tmp_path / "scene", workers=2)
    roundtrip.assert_same_log(scene, truth, time_s=2e-9)
    assert scene.sweeps[0].sensor == LIDAR
    assert [i for i, s in scene.split.items() if s == "test"] == ["front/000004", "front_left/000004"]


def test_the_template_converter_makes_a_log_that_is_the_recording(
    truth: Scene, tmp_path: Path, repository: Path
) -> None:
    recording = write_custom.write_recording(truth, tmp_path / "recording")
    script = repository / "docs" / "examples" / "convert_my_log.py"
    assert len(script.read_text().splitlines()) < 100
    (tmp_path / "log").mkdir()
    subprocess.run([sys.executable, str(script), str(recording), str(tmp_path / "log")], check=True)
    assert words_of(tmp_path / "log") == ""
    scene = ingest(tmp_path / "log", tmp_path / "scene")
    roundtrip.assert_same_log(scene, truth, time_s=2e-9, dt_s=1e-7)


def test_frames_and_cameras_are_chosen_by_the_first_cameras_clock(pristine: Path, truth: Scene, tmp_path: Path) -> None:
    options = ImportOptions(frames=(1, 4), cameras=("front_left",), resolution=(48, 32))
    scene = IMPORTERS["custom"](pristine, tmp_path / "scene", options)
    assert [f.id for f in scene.frames] == [f"front_left/{n:06d}" for n in range(3)]
    assert len(scene.sweeps) == 3
    camera, original = scene.cameras["front_left"], truth.cameras["front_left"]
    assert (camera.width, camera.height, camera.fx, camera.cy) == (48, 32, original.fx / 2, original.cy / 2)
    for wrong in ({"cameras": ("rear",)}, {"frames": (7, 9)}, {"sequence": "1"}):
        with pytest.raises(UsageError):
            ingest(pristine, tmp_path / "other", **wrong)


def test_twisted_sweeps_are_straightened_with_the_times_of_their_points(truth: Scene, tmp_path: Path) -> None:
    """Points are twisted as a moving sensor would measure them; the import must undo it."""

    def lidar_at(time_s: float) -> np.ndarray:
        return common.pose_near(truth.ego, time_s) @ mounted

    mounted = roundtrip.mounts(truth)[LIDAR]

    def twist(log: dict[str, Any]) -> None:
        for record, sweep in zip(log["sweeps"], truth.sweeps, strict=True):
            points = read_points(truth, sweep)
            twisted = points.xyz.copy()
            for dt_s in np.unique(points.dt_s):
                chosen = points.dt_s == dt_s
                own_from_sweep = invert(lidar_at(sweep.time_s + float(dt_s))) @ lidar_at(sweep.time_s)
                twisted[chosen] = points.xyz[chosen] @ own_from_sweep[:3, :3].T + own_from_sweep[:3, 3]
            content = write_custom.npz(SweepPoints(twisted, points.intensity, points.dt_s))
            (tmp_path / "log" / record["file"]).write_bytes(content)
        log["lidars"][LIDAR] |= {"motion_compensated": False, "time_field": "t", "time_unit": "s"}

    log = write_custom.write_log(truth, tmp_path / "log", edit=twist)
    scene = ingest(log, tmp_path / "scene")
    roundtrip.assert_same_log(scene, truth, time_s=2e-9, dt_s=1e-7, cloud_m=2e-3)
    raw = ingest(log, tmp_path / "raw", untwist="no")
    with pytest.raises(AssertionError, match="of points lie within"):
        roundtrip.assert_same_log(raw, truth, time_s=2e-9, cloud_m=2e-2)


def test_point_times_of_the_epoch_keep_their_nanoseconds(truth: Scene, tmp_path: Path) -> None:
    def absolute(log: dict[str, Any]) -> None:
        for record, sweep in zip(log["sweeps"], truth.sweeps, strict=True):
            points = read_points(truth, sweep)
            times = record["time"] + np.round(points.dt_s.astype(np.float64) * 1e9).astype(np.int64)
            np.savez(tmp_path / "log" / record["file"], xyz=points.xyz, stamp=times.astype(np.uint64))
        log["lidars"][LIDAR] |= {"time_field": "stamp", "time_unit": "ns", "time_from": "log", "intensity_field": ""}

    log = write_custom.write_log(truth, tmp_path / "log", edit=absolute)
    scene = ingest(log, tmp_path / "scene")
    roundtrip.assert_same_log(scene, truth, time_s=2e-9, dt_s=1e-8, intensity=None)
    edit(log, lambda content: content["lidars"][LIDAR].update(time_from="sweep"))
    assert "far from their sweep's" in words_of(log)


# ---- traps ----


def scale(pose: list[list[float]], factor: float) -> None:
    for row in pose[:3]:
        row[:3] = [value * factor for value in row[:3]]


def divide_times(log: dict[str, Any], by: int) -> None:
    for record in [*log["ego"], *log["images"], *log["sweeps"], *(b for t in log["tracks"] for b in t["boxes"])]:
        record["time"] //= by


def one_camera(log: dict[str, Any]) -> None:
    log["images"] = [image for image in log["images"] if image["camera"] == "front"]


def front(log: dict[str, Any]) -> dict[str, Any]:
    return log["cameras"]["front"]


TRAPS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "images unsorted": (lambda l: l["images"].reverse(), ("timestamps do not increase", "images of front")),
    "microseconds called ns": (lambda l: divide_times(l, 1000), ("another unit", "us")),
    "scaled pose": (lambda l: scale(l["ego"][2]["world_from_ego"], 1000), ("pose is scaled", "ego[2]")),
    "Windows path": (lambda l: l["images"][3].update(file="images\\a.png"), ("backslash", "images[3].file")),
    "path out": (lambda l: l["sweeps"][0].update(file="../../etc/passwd"), ("component '..'", "sweeps[0].file")),
    "unknown camera": (lambda l: l["images"][0].update(camera="frnt"), ("does not have", "frnt", "images[0].camera")),
    "camera without images": (one_camera, ("front_left has no images",)),
    "LiDAR without sweeps": (lambda l: l.update(sweeps=[]), ("lidar has no sweeps",)),
    "box without width": (lambda l: l["tracks"][0].update(size_m=[4.0, 0.0, 1.5]), ("box size makes no sense",)),
    "two tracks of one id": (lambda l: l["tracks"][1].update(id=l["tracks"][0]["id"]), ("two tracks have one id",)),
    "millimetre lens": (lambda l: front(l).update(fx=0.0042), ("focal length makes no sense",)),
    "misspelt field": (lambda l: front(l).update(distortions=[1]), ("unknown field", "did you mean 'distortion'")),
    "other clock": (
        lambda l: [i.update(time=i["time"] + 9 * 10**9) for i in l["images"]],
        ("do not cover", "are the clocks the same"),
    ),
}


@pytest.mark.parametrize("trap", TRAPS)
def test_traps_are_refused_in_words_by_doctor_and_ingest_alike(log: Path, tmp_path: Path, trap: str) -> None:
    change, expected = TRAPS[trap]
    edit(log, change)
    found = words_of(log)
    for words in expected:
        assert words in found
    with pytest.raises(InputError):
        ingest(log, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_bad_clouds_are_named(log: Path, tmp_path: Path) -> None:
    cloud = log / "lidar" / LIDAR / "000001.npz"
    np.savez(cloud, xyz=np.zeros((0, 3), np.float32), intensity=np.zeros(0, np.float32))
    np.savez(cloud.with_name("000002.npz"), xyz=np.ones((3, 3), np.float32), intensity=np.array([0, 17, 255]))
    np.savez(cloud.with_name("000003.npz"), xyz=np.ones((3, 3), np.float32))
    found = words_of(log)
    for words in ("no points", "intensity is out of range", "intensity_max", "cloud has no intensity"):
        assert words in found
    assert "000001" in refused("no points", ingest, log, tmp_path / "scene").where


def test_a_missing_file_can_be_left_out_and_a_missing_sweep_is_warned_about(log: Path, tmp_path: Path) -> None:
    assert [f for f in custom.check_log(log) if f.level != "note"] == []
    (log / "images" / "front" / "000002.png").unlink()
    (log / "lidar" / LIDAR / "000000.npz").unlink()
    scene = ingest(log, tmp_path / "scene", skip_missing=True)
    assert (len(scene.frames_of("front")), len(scene.frames_of("front_left")), len(scene.sweeps)) == (4, 5, 4)
    edit(log, lambda content: content["sweeps"].pop(2))
    assert "about 1 records are missing" in words_of(log, "warning")


def test_all_problems_are_listed_at_once(log: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        scale(content["cameras"]["front"]["ego_from_camera"], 2)
        content["tracks"][0]["size_m"] = [-1, 2, 3]
        content["sweeps"][1]["file"] = "lidar/none.npz"

    edit(log, change)
    found = words_of(log)
    for words in ("pose is scaled", "box size makes no sense", "file not found"):
        assert words in found


def test_boxes_that_move_sideways_are_warned_about(log: Path, truth: Scene) -> None:
    def moved_m(track: Track) -> float:
        return float(np.linalg.norm(track.world_from_object[-1, :3, 3] - track.world_from_object[0, :3, 3]))

    mover = max(truth.tracks, key=moved_m)
    assert moved_m(mover) > 3
    quarter = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])

    def turn(content: dict[str, Any]) -> None:
        track = next(t for t in content["tracks"] if t["id"] == mover.id)
        length, width, height = track["size_m"]
        track["size_m"] = [width, length, height]
        for box in track["boxes"]:
            box["world_from_object"] = (np.array(box["world_from_object"]) @ quarter).tolist()

    edit(log, turn)
    found = words_of(log, "warning")
    assert "moves sideways" in found and "they are swapped" in found and mover.id in found


def test_the_example_of_the_documentation_is_a_log(repository: Path, tmp_path: Path) -> None:
    text = (repository / "docs" / "custom_format.md").read_text(encoding="utf-8")
    (tmp_path / "log.json").write_text(text.split("```json\n")[1].split("```")[0])
    log = read_log(tmp_path)
    assert (len(log.images), len(log.sweeps), len(log.tracks)) == (2, 1, 1)
    assert log.images[1].time_s == 0.1 and log.sweeps[0].time_s == 0.05
    assert np.allclose(log.tracks[0].world_from_object[1, :3, 3], [16.2, 3.5, 0.8])
    assert log.cameras["front"].recorded.cx == 962.6 and log.cameras["front"].lens is not None
