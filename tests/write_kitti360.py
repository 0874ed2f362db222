"""A log as a KITTI-360 drive, written after the data set's published description; independent of the importer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from roundtrip import mounts
from scipy.spatial.transform import Rotation

from mudg.base.geometry import invert, yaw_matrix
from mudg.base.types import Scene
from mudg.scene.read import read_image, read_points

Matrix = NDArray[np.float64]
DRIVE = "2013_05_28_drive_0003_sync"
FIRST = 1
"""The data set's frame number of the log's first frame."""
SOURCE_FROM_WORLD = yaw_matrix(0.8, (1200.0, -3400.0, 110.0))
EGO_FROM_IMU = np.diag([1.0, -1.0, -1.0, 1.0])
CAMERA_OF = {"front": "image_00", "front_left": "image_01"}
RECT_FROM_CAMERA = {
    name: np.block([[Rotation.from_rotvec(turn).as_matrix(), np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
    for name, turn in (("image_00", (0.01, -0.02, 0.004)), ("image_01", (-0.006, 0.01, 0.02)))
}


def numbers(matrix: NDArray[np.floating]) -> str:
    """Digits enough for a round trip."""
    return " ".join(repr(float(value)) for value in np.asarray(matrix).ravel())


def stamp(time_s: float) -> str:
    """A line of a timestamps file."""
    total_ns = round((17.25 + time_s) * 1e9)
    return f"2013-05-28 08:46:{total_ns // 10**9:02d}.{total_ns % 10**9:09d}"


def write_kitti360(truth: Scene, root: Path) -> Path:
    """``root`` as the data set's folder with one drive. Returns ``root``."""
    placed = mounts(truth)
    imu_from_velo = EGO_FROM_IMU @ placed[truth.sweeps[0].sensor]
    imu_from_rect = {theirs: EGO_FROM_IMU @ placed[name] for name, theirs in CAMERA_OF.items()}
    _calibration(truth, root / "calibration", imu_from_rect, imu_from_velo)
    for name, theirs in CAMERA_OF.items():
        here = root / "data_2d_raw" / DRIVE / theirs / "data_rect"
        here.mkdir(parents=True)
        for index, frame in enumerate(truth.frames_of(name)):
            Image.fromarray(read_image(truth, frame)).save(here / f"{index + FIRST:010d}.png")
    raw = root / "data_3d_raw" / DRIVE / "velodyne_points"
    (raw / "data").mkdir(parents=True)
    for index, sweep in enumerate(truth.sweeps):
        points = read_points(truth, sweep)
        np.c_[points.xyz, points.intensity].astype("<f4").tofile(raw / "data" / f"{index + FIRST:010d}.bin")
    period = truth.sweeps[1].time_s - truth.sweeps[0].time_s
    lines = [stamp(period * (n - FIRST)) for n in range(FIRST + len(truth.sweeps) + 2)]
    (raw / "timestamps.txt").write_text("\n".join(lines) + "\n")
    paths = (SOURCE_FROM_WORLD @ truth.ego.pose_at(sweep.time_s) @ EGO_FROM_IMU for sweep in truth.sweeps)
    rows = [f"{index} {numbers(pose[:3])}" for index, pose in enumerate(paths, FIRST)]
    poses = root / "data_poses" / DRIVE / "poses.txt"
    poses.parent.mkdir(parents=True)
    poses.write_text("\n".join(rows) + "\n")
    write_boxes(truth, root / "data_3d_bboxes" / "train" / f"{DRIVE}.xml")
    return root


def _calibration(truth: Scene, folder: Path, imu_from_rect: dict[str, Matrix], imu_from_velo: Matrix) -> None:
    folder.mkdir(parents=True)
    lines = ["calib_time: 28-May-2013 12:00:00", "corner_dist: 1.000000e-01"]
    for name, theirs in CAMERA_OF.items():
        camera, number = truth.cameras[name], theirs[-2:]
        k = np.array([[camera.fx, 0, camera.cx - 0.5, 0], [0, camera.fy, camera.cy - 0.5, 0], [0, 0, 1, 0]])
        k[0, 3] = -99.0 if number == "01" else 0.0  # the stereo baseline: the vehicle's calibration has it already
        lines += [f"S_rect_{number}: {camera.width} {camera.height}", f"P_rect_{number}: {numbers(k)}"]
        lines.append(f"R_rect_{number}: {numbers(RECT_FROM_CAMERA[theirs][:3, :3])}")
    (folder / "perspective.txt").write_text("\n".join(lines) + "\n")
    imu_from_camera = {name: pose @ RECT_FROM_CAMERA[name] for name, pose in imu_from_rect.items()}
    side = np.array([[1.0, 0, 0, 0.4], [0, 0, -1, -0.9], [0, 1, 0, -1.1], [0, 0, 0, 1]])  # looks to the left
    imu_from_camera |= {"image_02": side, "image_03": side @ np.diag([-1.0, 1, -1, 1])}
    (folder / "calib_cam_to_pose.txt").write_text(
        "".join(f"{name}: {numbers(pose[:3])}\n" for name, pose in imu_from_camera.items())
    )
    velo_from_camera = invert(imu_from_velo) @ imu_from_camera["image_00"]
    (folder / "calib_cam_to_velo.txt").write_text(numbers(velo_from_camera[:3]) + "\n")


def matrix_xml(name: str, matrix: NDArray[np.floating]) -> str:
    """An OpenCV-style matrix."""
    rows, columns = matrix.shape
    data = "\n      ".join(numbers(row) for row in matrix)
    return (
        f'<{name} type_id="opencv-matrix"><rows>{rows}</rows><cols>{columns}</cols><dt>f</dt><data>\n     '
        f" {data}</data></{name}>"
    )


CUBE = np.array([[x, y, z] for x in (0.5, -0.5) for y in (0.5, -0.5) for z in (-0.5, 0.5)])


def box_xml(
    number: int,
    pose: Matrix,
    size_m: NDArray[np.floating],
    *,
    semantic: int = 13,
    instance: int = 1,
    timestamp: int = -1,
    window: tuple[int, int] = (0, 9),
) -> str:
    """One object."""
    transform = SOURCE_FROM_WORLD @ pose @ np.diag([*size_m, 1.0])
    return (
        f"<object{number}><index>{number}</index><label>car</label><semanticId>{semantic}</semanticId>"
        f"<instanceId>{instance}</instanceId><timestamp>{timestamp}</timestamp><dynamic>{int(timestamp >= 0)}</dynamic>"
        f"<start_frame>{window[0]}</start_frame><end_frame>{window[1]}</end_frame>"
        f"{matrix_xml('transform', transform)}{matrix_xml('vertices', CUBE)}"
        f"{matrix_xml('faces', np.zeros((2, 3)))}</object{number}>\n"
    )


def write_boxes(truth: Scene, path: Path) -> None:
    """Moving cars per frame, standing ones once, and a building."""
    path.parent.mkdir(parents=True, exist_ok=True)
    objects = [box_xml(0, yaw_matrix(0.3, (20, 20, 4)), np.array([14.0, 9, 8]), semantic=11)]
    for instance, track in enumerate(truth.tracks, start=1):
        if np.ptp(track.world_from_object[:, 0, 3]) == 0:
            window = (FIRST, FIRST + len(track.times_s) - 1)
            objects.append(
                box_xml(len(objects), track.world_from_object[0], track.size_m, instance=instance, window=window)
            )
            continue
        for index, pose in enumerate(track.world_from_object):
            frame = FIRST + index
            objects.append(
                box_xml(len(objects), pose, track.size_m, instance=instance, timestamp=frame, window=(frame, frame))
            )
    path.write_text('<?xml version="1.0"?>\n<opencv_storage>\n' + "".join(objects) + "</opencv_storage>\n")
