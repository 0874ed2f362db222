"""Small KITTI folders with known answers, written from a made-up drive.

The vehicle turns while it drives; ``world_from_imu(t)`` is its exact pose. Posts stand in the world, one car drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base.geometry import invert, yaw_matrix

Matrix = NDArray[np.float64]
WIDTH, HEIGHT, FOCAL = 96, 40, 70.0
EARTH_RADIUS_M = 6378137.0
LATITUDE_DEG = 49.0
RECT0_FROM_VELO = np.array([[0.0, -1, 0, 0.05], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
VELO_FROM_IMU = yaw_matrix(0.01, (-0.8, 0.3, -0.8))
CAR_SIZE_M = (4.0, 1.8, 1.5)


def world_from_imu(time_s: float) -> Matrix:
    """Exact pose of the IMU: 8 m/s along an arc of 40 m radius, world = first pose."""
    angle = 8.0 * time_s / 40.0
    return yaw_matrix(angle, (40.0 * np.sin(angle), 40.0 * (1 - np.cos(angle)), 0.02 * time_s))


def world_from_velo(time_s: float) -> Matrix:
    """Exact pose of the velodyne."""
    return world_from_imu(time_s) @ invert(VELO_FROM_IMU)


def world_from_car(time_s: float) -> Matrix:
    """Exact pose of the box centre of a car that drives ahead."""
    return yaw_matrix(0.2, (14.0 + 6.0 * time_s, 1.0 + 1.2 * time_s, -0.9))


def projection(number: int) -> Matrix:
    """P of camera ``number``: camera 2 sits 6 cm to the left of camera 0."""
    k = np.array([[FOCAL, 0, 47.0], [0, FOCAL, 19.0], [0, 0, 1.0]])
    shift = {0: 0.0, 1: -0.54, 2: 0.06, 3: -0.48}[number]
    return np.c_[k, k @ [shift, 0.0, 0.003]]


@dataclass(frozen=True)
class Drive:
    """Which frames a folder has, and the world they show."""

    frames: Sequence[int] = (0, 1, 2, 3, 4, 5)
    posts: Matrix = field(default_factory=lambda: _posts())

    def times(self) -> list[float]:
        """Seconds of the frames."""
        return [0.1 * n for n in self.frames]


def _posts() -> Matrix:
    rng = np.random.default_rng(3)
    angle, reach = rng.uniform(-np.pi, np.pi, 150), rng.uniform(12, 30, 150)
    return np.c_[10 + reach * np.cos(angle), reach * np.sin(angle), rng.uniform(-1.5, 2.0, 150)]


def image(number: int) -> NDArray[np.uint8]:
    """A picture that is different in every frame."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([rows * 6, columns * 2, np.full_like(rows, number * 20)], 2).astype(np.uint8)


def write_images(folder: Path, frames: Sequence[int], digits: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number in frames:
        Image.fromarray(image(number)).save(folder / f"{number:0{digits}d}.png")


def still_scan(drive: Drive, time_s: float) -> Matrix:
    """The posts seen at one moment, f64[N, 3] in the velodyne frame."""
    pose = invert(world_from_velo(time_s))
    return drive.posts @ pose[:3, :3].T + pose[:3, 3]


def twisted_scan(drive: Drive, time_s: float) -> Matrix:
    """The posts as a turning sensor measures them: each at the moment the beam points to it (found by iteration)."""
    points = still_scan(drive, time_s)
    for _ in range(4):  # each leaves a hundredth of the error
        late = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) * 0.1
        poses = np.linalg.inv([world_from_velo(time_s + dt) for dt in late])
        points = np.einsum("nij,nj->ni", poses[:, :3, :3], drive.posts) + poses[:, :3, 3]
    return points


def write_scans(folder: Path, scans: dict[int, Matrix], digits: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, points in scans.items():
        np.c_[points, np.full(len(points), 0.5)].astype("<f4").tofile(folder / f"{number:0{digits}d}.bin")


def numbers(values: NDArray[np.floating]) -> str:
    return " ".join(f"{value:.12e}" for value in np.asarray(values).ravel())


def write_calibration_text(path: Path, odometry: bool = False) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"P{n}: {numbers(projection(n))}" for n in range(4)]
    if odometry:
        lines.append(f"Tr: {numbers(RECT0_FROM_VELO[:3])}")
    else:
        lines += [f"R0_rect: {numbers(np.eye(3))}", f"Tr_velo_to_cam: {numbers(RECT0_FROM_VELO[:3])}"]
        lines.append(f"Tr_imu_to_velo: {numbers(VELO_FROM_IMU[:3])}")
    path.write_text("\n".join(lines) + "\n")


def write_calibration_day(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["calib_time: 09-Jan-2012 13:57:47", f"R_rect_00: {numbers(np.eye(3))}"]
    lines += [f"P_rect_0{n}: {numbers(projection(n))}" for n in range(4)]
    (folder / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    for name, pose in (("velo_to_cam", RECT0_FROM_VELO), ("imu_to_velo", VELO_FROM_IMU)):
        text = f"calib_time: 15-Mar-2012 11:37:16\nR: {numbers(pose[:3, :3])}\nT: {numbers(pose[:3, 3])}\n"
        (folder / f"calib_{name}.txt").write_text(text)


def oxts_line(time_s: float) -> str:
    """GPS/IMU packet of the exact pose: Mercator inverted by hand, yaw counted from east."""
    pose = world_from_imu(time_s)
    scale = np.cos(np.deg2rad(LATITUDE_DEG))
    north0 = scale * EARTH_RADIUS_M * np.log(np.tan(np.pi / 4 + np.deg2rad(LATITUDE_DEG) / 2))
    heading = 0.7  # the recording does not start towards east
    rotated = yaw_matrix(heading) @ pose
    longitude = np.rad2deg(rotated[0, 3] / (scale * EARTH_RADIUS_M)) + 8.4
    latitude = np.rad2deg(2 * np.arctan(np.exp((north0 + rotated[1, 3]) / (scale * EARTH_RADIUS_M))) - np.pi / 2)
    yaw = np.arctan2(rotated[1, 0], rotated[0, 0])
    return " ".join(f"{v:.12f}" for v in [latitude, longitude, 110 + rotated[2, 3], 0.0, 0.0, yaw, *[0.0] * 24])


def clock_line(time_s: float) -> str:
    """A raw-data timestamp 25.9 s past the minute."""
    total_ns = round((25.9 + time_s) * 1e9)
    return f"2011-09-26 13:{2 + total_ns // 60_000_000_000:02d}:{total_ns % 60_000_000_000 / 1e9:012.9f}"


def tracklet_xml(drive: Drive, twisted: bool) -> str:
    """One car in raw-data tracklets; drawn into twisted scans it stands where it was when the beam met it."""
    poses = []
    for time_s in drive.times():
        late = 0.0
        for _ in range(8 if twisted else 1):
            box = invert(world_from_velo(time_s + late)) @ world_from_car(time_s + late)
            late = np.arctan2(box[1, 3], box[0, 3]) / (2 * np.pi) * 0.1 if twisted else 0.0
        yaw = np.arctan2(box[1, 0], box[0, 0])
        place = {"tx": box[0, 3], "ty": box[1, 3], "tz": box[2, 3] - CAR_SIZE_M[2] / 2, "rx": 0.0, "ry": 0.0, "rz": yaw}
        poses.append("<item>" + "".join(f"<{name}>{value:.9f}</{name}>" for name, value in place.items()) + "</item>")
    size = "".join(f"<{name}>{value}</{name}>" for name, value in zip("lwh", CAR_SIZE_M, strict=True))
    item = f"<objectType>Car</objectType>{size}<first_frame>{drive.frames[0]}</first_frame>"
    item += f"<poses><count>{len(poses)}</count>{''.join(poses)}</poses>"
    head = '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
    return (
        f"{head}<boost_serialization><tracklets><count>1</count><item>{item}</item></tracklets></boost_serialization>\n"
    )


def label_line(time_s: float, prefix: str, track: Matrix | None = None) -> str:
    """A label row of the car at ``time_s``: ``prefix`` is ``frame track `` for tracking, empty for object labels."""
    box = RECT0_FROM_VELO @ invert(world_from_velo(time_s)) @ (world_from_car(time_s) if track is None else track)
    x, y, z = box[:3, 3] + [0, CAR_SIZE_M[2] / 2, 0]
    turn = -np.arctan2(box[2, 0], box[0, 0])
    length, width, height = CAR_SIZE_M
    return f"{prefix}Car 0 0 -1.5 10 10 30 30 {height} {width} {length} {x:.9f} {y:.9f} {z:.9f} {turn:.9f}"


def write_raw_drive(day: Path, drive: Drive | None = None, twisted: bool = True) -> Path:
    """A raw-data day folder with one drive; returns the drive's folder."""
    drive = drive or Drive()
    folder = day / "2011_09_26_drive_0001_sync"
    write_calibration_day(day)
    write_images(folder / "image_02" / "data", drive.frames, 10)
    scan = twisted_scan if twisted else still_scan
    write_scans(folder / "velodyne_points" / "data", {n: scan(drive, 0.1 * n) for n in drive.frames}, 10)
    (folder / "oxts" / "data").mkdir(parents=True)
    for number in drive.frames:
        (folder / "oxts" / "data" / f"{number:010d}.txt").write_text(oxts_line(0.1 * number) + "\n")
    clock = "\n".join(clock_line(0.1 * n) for n in range(max(drive.frames) + 1)) + "\n"
    for stream in ("image_02", "velodyne_points", "oxts"):
        (folder / stream / "timestamps.txt").write_text(clock)
    (folder / "tracklet_labels.xml").write_text(tracklet_xml(drive, twisted))
    return folder


def write_odometry(root: Path, drive: Drive | None = None) -> Path:
    """``sequences/07`` and ``poses/07.txt`` (rectified camera 0 of the first frame from that of each)."""
    drive = drive or Drive()
    folder = root / "sequences" / "07"
    write_calibration_text(folder / "calib.txt", odometry=True)
    write_images(folder / "image_2", drive.frames, 6)
    write_scans(folder / "velodyne", {n: still_scan(drive, 0.1 * n) for n in drive.frames}, 6)
    (folder / "times.txt").write_text("\n".join(f"{t:.6e}" for t in drive.times()) + "\n")
    (root / "poses").mkdir(parents=True)
    cam0 = [world_from_velo(t) @ invert(RECT0_FROM_VELO) for t in drive.times()]
    (root / "poses" / "07.txt").write_text("\n".join(numbers((invert(cam0[0]) @ pose)[:3]) for pose in cam0) + "\n")
    return folder


def write_derived(root: Path, drive: Drive | None = None) -> Path:
    """Raw folders with ``calib.txt`` and a ``derived`` folder of velodyne poses and tracking labels."""
    drive = drive or Drive()
    write_calibration_text(root / "calib.txt")
    write_images(root / "image_02" / "data", drive.frames, 10)
    write_scans(root / "velodyne_points" / "data", {n: still_scan(drive, 0.1 * n) for n in drive.frames}, 10)
    (root / "derived").mkdir()
    first = invert(world_from_velo(drive.times()[0]))
    rows = [f"{n} {numbers((first @ world_from_velo(0.1 * n))[:3])}" for n in drive.frames]
    (root / "derived" / "poses_velo.txt").write_text("\n".join(rows) + "\n")
    rows = [label_line(0.1 * n, f"{n} 7 ") for n in drive.frames]
    (root / "derived" / "label_02.txt").write_text("\n".join(rows) + "\n")
    return root


def write_object(root: Path, frames: Sequence[int] = (8,)) -> Path:
    """The single-frame object layout."""
    drive = Drive(frames)
    write_images(root / "image_2", frames, 6)
    write_scans(root / "velodyne", {n: still_scan(drive, 0.1 * n) for n in frames}, 6)
    (root / "label_2").mkdir(parents=True)
    for number in frames:
        write_calibration_text(root / "calib" / f"{number:06d}.txt")
        dont_care = "DontCare -1 -1 -10 5 5 9 9 -1 -1 -1 -1000 -1000 -1000 -10"
        (root / "label_2" / f"{number:06d}.txt").write_text(label_line(0.1 * number, "") + "\n" + dont_care + "\n")
    return root


def write_tracking(root: Path, sequence: str = "0003", drive: Drive | None = None) -> Path:
    """The tracking layout: ``image_02/<sequence>`` and so on, one file of GPS/IMU packets per sequence."""
    drive = drive or Drive()
    write_images(root / "image_02" / sequence, drive.frames, 6)
    write_scans(root / "velodyne" / sequence, {n: still_scan(drive, 0.1 * n) for n in drive.frames}, 6)
    write_calibration_text(root / "calib" / f"{sequence}.txt")
    labels, packets = [label_line(0.1 * n, f"{n} 7 ") for n in drive.frames], [oxts_line(t) for t in drive.times()]
    for name, rows in (("label_02", labels), ("oxts", packets)):
        (root / name).mkdir(parents=True)
        (root / name / f"{sequence}.txt").write_text("\n".join(rows) + "\n")
    return root
