"""Free camera paths from files: three formats that name the same poses, and words for what is none."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from toy_fitted import write_toy_run

import mudg
from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.formats.paths import read_path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    scene, fit, _, _ = write_toy_run(tmp_path_factory.mktemp("toy"))
    return scene, fit


def poses_of(run: tuple[Path, Path]) -> list[tuple[float, np.ndarray]]:
    """Two recorded poses, turned a little about an oblique axis and moved."""
    scene, made = mudg.read_scene(run[0]), []
    for index, frame in enumerate(scene.frames_of("front")[:2]):
        axis, angle = np.array([0.6, 0.0, 0.8]), 0.1 + 0.2 * index
        k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        turn = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k
        pose = frame.view.world_from_cam.copy()
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] += [0.1, 0.7, 0.2]
        made.append((frame.view.time_s, pose))
    return made


def tum(poses: list[tuple[float, np.ndarray]]) -> str:
    lines = ["# time x y z qx qy qz qw"]
    for time_s, pose in poses:
        w, x, y, z = geometry.quaternion_from_matrix(pose)
        lines.append(" ".join(map(repr, map(float, (time_s, *pose[:3, 3], x, y, z, w)))))
    return "\n".join(lines) + "\n\n"


def kitti(poses: list[tuple[float, np.ndarray]]) -> str:
    return "".join(" ".join(map(repr, map(float, pose[:3].ravel()))) + "\n" for _, pose in poses)


def nerfstudio(poses: list[tuple[float, np.ndarray]]) -> str:
    """Columns of a nerfstudio matrix: the camera's right, up and back in the world, and its place."""
    columns = lambda pose: np.column_stack([pose[:, 0], -pose[:, 1], -pose[:, 2], pose[:, 3]])
    frames = [{"time": time_s, "transform_matrix": columns(pose).tolist()} for time_s, pose in poses]
    return json.dumps({"camera_model": "OPENCV", "frames": frames})


@pytest.mark.parametrize(("name", "write"), [("a.txt", tum), ("b.txt", kitti), ("c.json", nerfstudio)])
def test_formats_name_the_same_poses(run: tuple[Path, Path], tmp_path: Path, name: str, write) -> None:
    wanted, scene = poses_of(run), mudg.read_scene(run[0])
    (tmp_path / name).write_text(write(wanted))
    path = read_path(tmp_path / name, scene, scene.cameras["front"])
    assert path.name == name[0] and len(path) == 2
    for view, (time_s, pose) in zip(path.views, wanted, strict=True):
        assert np.abs(view.world_from_cam - pose).max() < 1e-6
        assert write is kitti or view.time_s == pytest.approx(time_s)
    spans = [view.time_s for view in path.views]
    times = [frame.view.time_s for frame in scene.frames]
    assert write is not kitti or spans == [min(times), max(times)]


def test_a_path_is_rendered_with_another_field_of_view(run: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "drone.txt").write_text(tum(poses_of(run)))
    scene, fit = run
    out = mudg.render(
        scene, fit, out=tmp_path / "views", path=tmp_path / "drone.txt", fov_deg=90.0, width_px=80, video=False
    )
    views = mudg.read_observations(out / "drone")
    assert [path.name for path in out.iterdir() if path.is_dir()] == ["drone"]
    camera = views[0].view.camera
    assert (len(views), camera.width) == (2, 80)
    assert 2 * math.degrees(math.atan(camera.width / 2 / camera.fx)) == pytest.approx(90.0)
    picture = mudg.FittedScene.read(fit).render(camera, poses_of(run)[1][1], views[1].view.time_s)
    assert np.abs(views[1].rgb.permute(1, 2, 0).numpy() * 255 - picture.rgb).max() <= 1.01


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "no usable number"),
        ("0.1 1 2 3\n", "line 1"),
        ("# a\n0.1 0 0 0 0 0 0 1\n0.1 x 0 0 0 0 0 1\n", "line 3"),
        ("0.1 0 0 0 0 0 0 2\n", "unit quaternion"),
        ("0.1 nan 0 0 0 0 0 1\n", "finite"),
        ("99 0 0 0 0 0 0 1\n", "leaves the time"),
        ("0.4 0 0 0 0 0 0 1\n0.2 0 0 0 0 0 0 1\n", "do not increase"),
        ("1 0 0 0 0 2 0 0 0 0 1 0\n", "not rigid"),
        ("0.1 0 0 0 0 0 0 1\n1 0 0 0 0 1 0 0 0 0 1 0\n", "others have none"),
        *((json, "bad.json") for json in ("[]", '{"frames": 3}', '{"frames": [3]}')),
        ('{"frames": [{"transform_matrix": [[1]]}]}', "bad.json"),
    ],
)
def test_files_that_hold_no_path_are_refused_with_the_line(
    run: tuple[Path, Path], tmp_path: Path, text: str, told: str
) -> None:
    file, scene = tmp_path / ("bad.json" if told == "bad.json" else "bad.txt"), mudg.read_scene(run[0])
    file.write_text(text)
    refused(told, read_path, file, scene, scene.cameras["front"])


def test_a_far_path_is_drawn_with_a_warning_and_nothing_is_half_written(
    run: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, fit = run
    time_s, pose = poses_of(run)[0]
    far = pose.copy()
    far[:3, 3] += [0.0, 40.0, 0.0]
    (tmp_path / "far.txt").write_text(tum([(time_s, far)]))
    mudg.render(scene, fit, out=tmp_path / "far", path=tmp_path / "far.txt", width_px=40, video=False)
    assert "1 of 1 views are more than 5 m" in capsys.readouterr().err
    (tmp_path / "bad.txt").write_text("1 2 3\n")
    refused("wrong number of values", mudg.render, scene, fit, out=tmp_path / "bad", path=tmp_path / "bad.txt")
    assert not (tmp_path / "bad").exists()
    with pytest.raises(UsageError, match="drawn without sweeps"):
        mudg.render(scene, fit, out=tmp_path / "x", path=tmp_path / "far.txt", lidar="scene")
