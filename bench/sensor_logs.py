"""Times the importers of nuScenes and Argoverse 2 on made-up logs of real sizes; each in a process of its own.

    python bench/sensor_logs.py nuscenes --seconds 4 --rows 500000 --workers 1
    python bench/sensor_logs.py argoverse2 --seconds 4

Cameras, rates, image sizes and points per sweep are those of the data sets; all images are copies of one textured JPEG.
``--rows`` pads the large nuScenes tables with records of other scenes (the full release has 2,600,000).
"""

from __future__ import annotations

import argparse
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from mudg.base.geometry import CAM_FROM_EGO_AXES, invert, quaternion_from_matrix, yaw_matrix

SPEED_M_S = 10.0
START_US = 1_532_402_927_000_000


def say(line: str) -> None:
    """One line of the result, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def jpeg(width: int, height: int) -> bytes:
    """A picture with texture on every scale, about as large as a photograph of that size."""
    rng = np.random.default_rng(1)
    pixels = np.zeros((height, width, 3))
    for cells in (8, 32, 128, 512):
        small = rng.uniform(-1, 1, (cells, cells, 3))
        rows, columns = np.arange(height) * cells // height, np.arange(width) * cells // width
        pixels += small[rows[:, None], columns] * 40 / np.sqrt(cells / 8)
    buffer = io.BytesIO()
    Image.fromarray((pixels + 128).clip(0, 255).astype(np.uint8)).save(buffer, "JPEG", quality=85)
    return buffer.getvalue()


def street(count: int) -> np.ndarray:
    """Points f32[count, 3] around the vehicle, 5 to 80 m away."""
    rng = np.random.default_rng(2)
    azimuth, reach = rng.uniform(-np.pi, np.pi, count), 5 + 75 * rng.random(count) ** 2
    return np.stack([reach * np.cos(azimuth), reach * np.sin(azimuth), rng.uniform(-1.8, 3, count)], 1).astype("f4")


def map_from_ego(time_s: float) -> np.ndarray:
    """The vehicle drives straight on."""
    return yaw_matrix(0.3, (500 + SPEED_M_S * time_s * np.cos(0.3), 900 + SPEED_M_S * time_s * np.sin(0.3), 0.0))


def mount(yaw: float) -> np.ndarray:
    """Ego-from-camera of a camera that looks to ``yaw``."""
    return yaw_matrix(yaw, (1.0, 0.0, 1.5)) @ invert(CAM_FROM_EGO_AXES)


def link(first: Path, path: Path) -> None:
    """One more name for a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    os.link(first, path)


def pose_row(pose: np.ndarray) -> dict[str, list[float]]:
    """Rotation and translation of a nuScenes record."""
    return {"rotation": quaternion_from_matrix(pose).tolist(), "translation": pose[:3, 3].tolist()}


def make_nuscenes(root: Path, seconds: float, rows: int) -> int:
    """Six cameras of 1600x900 at 12 Hz, 34,720 points at 20 Hz; returns the moments of the reference camera."""
    from mudg.formats.importers.nuscenes import CAMERAS

    (root / "image.jpg").write_bytes(jpeg(1600, 900))
    xyz = street(34_720)
    scan = np.c_[xyz, np.full(len(xyz), 30), np.tile(np.arange(32), len(xyz) // 32)].astype("<f4")
    (root / "scan.bin").write_bytes(scan.tobytes())
    channels = {raw: mount(1.05 * index) for index, raw in enumerate(CAMERAS)} | {"LIDAR_TOP": yaw_matrix(-1.57)}
    k = [[1266.0, 0.0, 800.0], [0.0, 1266.0, 450.0], [0.0, 0.0, 1.0]]
    tables: dict[str, list[dict]] = {"category": [], "instance": [], "sample_annotation": [], "sample_data": []}
    tables |= {"ego_pose": [], "sensor": [{"token": c, "channel": c} for c in channels]}
    tables["calibrated_sensor"] = [
        {"token": c, "sensor_token": c, **pose_row(pose), "camera_intrinsic": [] if c == "LIDAR_TOP" else k}
        for c, pose in channels.items()
    ]
    keys = [f"s{n}" for n in range(int(seconds * 2) + 1)]
    tables["scene"] = [{"token": "scene", "name": "scene-0001", "first_sample_token": keys[0]}]
    tables["sample"] = [
        {"token": key, "timestamp": START_US + 500_000 * n, "scene_token": "scene", "next": (*keys, "")[n + 1]}
        for n, key in enumerate(keys)
    ]
    for channel in channels:
        rate = 20 if channel == "LIDAR_TOP" else 12
        for number in range(int(seconds * rate)):
            name = f"sweeps/{channel}/{number}"
            link(root / ("scan.bin" if rate == 20 else "image.jpg"), root / name)
            row = {
                "token": name.replace("/", "-"),
                "ego_pose_token": name.replace("/", "-"),
                "sample_token": keys[int(2 * number / rate)],
            }
            row |= {
                "calibrated_sensor_token": channel,
                "timestamp": START_US + number * 10**6 // rate,
                "filename": name,
            }
            tables["sample_data"].append(
                row | {"width": 1600, "height": 900, "is_key_frame": False, "prev": "", "next": ""}
            )
            tables["ego_pose"].append({"token": row["token"], **pose_row(map_from_ego(number / rate))})
    for table, entries in tables.items():
        path = root / "v1.0-mini" / f"{table}.json"
        path.parent.mkdir(exist_ok=True)
        with path.open("w") as file:
            file.write("[\n")
            for number in range(rows if table in ("sample_data", "ego_pose") else 0):
                other = entries[number % len(entries)] | {"token": f"{number:032x}"}
                other |= {"sample_token": f"{number:032x}"} if "sample_token" in other else {}
                file.write(json.dumps(other, indent=0) + ",\n")
            file.write(",\n".join(json.dumps(entry, indent=0) for entry in entries) + "\n]")
    return int(seconds * 12)


def make_argoverse2(root: Path, seconds: float) -> int:
    """Seven cameras of 2048x1550 at 20 Hz, 99,000 points at 10 Hz."""
    import pyarrow
    from pyarrow import feather

    from mudg.formats.importers.argoverse2 import RING_CAMERAS

    def table(path: Path, columns: dict) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        feather.write_feather(
            pyarrow.table({name: pyarrow.array(values) for name, values in columns.items()}), str(path)
        )

    def poses(matrices: list[np.ndarray]) -> dict:
        rows = np.array([[*quaternion_from_matrix(pose), *pose[:3, 3]] for pose in matrices])
        return dict(zip(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), rows.T, strict=True))

    (root / "image.jpg").write_bytes(jpeg(2048, 1550))
    xyz = street(99_000).astype("f2")
    scan = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "intensity": np.full(len(xyz), 9, "u1")}
    scan |= {"laser_number": np.zeros(len(xyz), "u1"), "offset_ns": np.linspace(0, 10**8, len(xyz)).astype("i4")}
    table(root / "scan.feather", scan)
    stamps = [START_US * 1000 + n * 10**9 // 20 for n in range(int(seconds * 20))]
    for number, stamp in enumerate(stamps):
        for camera in RING_CAMERAS:
            link(root / "image.jpg", root / "sensors" / "cameras" / camera / f"{stamp}.jpg")
        if number % 2 == 0:
            link(root / "scan.feather", root / "sensors" / "lidar" / f"{stamp}.feather")
    ego = {"timestamp_ns": stamps} | poses([map_from_ego(n / 20) for n in range(len(stamps))])
    table(root / "city_SE3_egovehicle.feather", ego)
    mounts = {name: mount(0.9 * index) for index, name in enumerate(RING_CAMERAS)} | {"up_lidar": np.eye(4)}
    table(
        root / "calibration" / "egovehicle_SE3_sensor.feather",
        {"sensor_name": list(mounts)} | poses(list(mounts.values())),
    )
    lens = {"fx_px": 1688.0, "fy_px": 1688.0, "cx_px": 1024.0, "cy_px": 775.0, "k1": 0.0, "k2": 0.0, "k3": 0.0}
    lens |= {"width_px": 2048, "height_px": 1550}
    lenses = {name: [value] * len(RING_CAMERAS) for name, value in lens.items()}
    table(root / "calibration" / "intrinsics.feather", {"sensor_name": list(RING_CAMERAS)} | lenses)
    boxes = [(stamp, track) for stamp in stamps[::2] for track in range(80)]
    box = {"timestamp_ns": [stamp for stamp, _ in boxes], "track_uuid": [str(track) for _, track in boxes]}
    box |= {"category": ["REGULAR_VEHICLE"] * len(boxes), "length_m": [4.6] * len(boxes), "width_m": [2.0] * len(boxes)}
    box |= {"height_m": [1.7] * len(boxes)} | poses([yaw_matrix(0.1, (10.0 + t, 3.0 * (t % 9), 0.5)) for _, t in boxes])
    table(root / "annotations.feather", box)
    return len(stamps)


def peak_mb() -> float:
    """Largest resident size of this process so far (Linux); a child does not inherit it, as it does ``ru_maxrss``."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1e3 for line in lines if line.startswith("VmHWM"))


def measure(name: str, source: Path, out: Path, workers: int) -> None:
    """Import, and print one JSON line; run in a process of its own."""
    from mudg.base import log
    from mudg.formats.importers import IMPORTERS
    from mudg.formats.importers.common import ImportOptions

    log.set_quiet(True)
    before_mb = peak_mb()
    started, worked = time.perf_counter(), time.process_time()
    scene = IMPORTERS[name](source, out, ImportOptions(workers=workers))
    result = {"wall_s": time.perf_counter() - started, "cpu_s": time.process_time() - worked}
    result |= {
        "images": len(scene.frames),
        "sweeps": len(scene.sweeps),
        "tracks": len(scene.tracks),
        "before_mb": before_mb,
    }
    say(json.dumps(result | {"peak_mb": peak_mb()}))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("format", choices=("nuscenes", "argoverse2"))
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--rows", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure is not None:
        measure(options.format, options.measure / "log", options.measure / "scene", options.workers)
        return
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "log"
        root.mkdir()
        nuscenes = options.format == "nuscenes"
        seconds = options.seconds
        moments = make_nuscenes(root, seconds, options.rows) if nuscenes else make_argoverse2(root, seconds)
        if options.rows:
            size = (root / "v1.0-mini" / "sample_data.json").stat().st_size / 1e6
            say(f"sample_data.json holds {options.rows} other records, {size:.0f} MB")
        command = [sys.executable, __file__, options.format, "--measure", folder, "--workers", str(options.workers)]
        text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        result = json.loads(text.splitlines()[-1])
        say(
            f"{options.format}: {moments} frames, {result['images']} images, {result['sweeps']} sweeps,"
            f" {result['tracks']} tracks; {result['cpu_s'] / moments:.3f} s of processor a frame ({result['cpu_s']:.2f}"
            f" s), {result['wall_s']:.2f} s; peak {result['peak_mb']:.0f} MB, of which {result['before_mb']:.0f} MB"
            " before"
        )


if __name__ == "__main__":
    main()
