"""Processor seconds per frame and peak memory of importing a Waymo log of the real size, and the speed of its checksum.

    python bench/waymo.py [--frames 10] [--workers 1]

A made-up log is written to a temporary folder in both formats: five JPEG images (3 of 1920x1280, 2 of 1920x886) with
lenses, 64x2650 range images with two returns and pixel poses, four smaller LiDARs. Each import is a process of its own;
seconds per frame are the difference between a long and a short import, so that what happens once does not count.
"""

from __future__ import annotations

import argparse
import io
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from mudg.base.geometry import yaw_matrix
from mudg.formats.importers.waymo_logs import crc32c, masked_crc32c

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
import write_waymo

SIZES = {1: (1920, 1280), 2: (1920, 1280), 3: (1920, 1280), 4: (1920, 886), 5: (1920, 886)}
SHORT = 2
IMPORT = """
import sys
from pathlib import Path
from mudg.formats.importers.common import ImportOptions
from mudg.formats.importers.waymo import import_waymo
source, out, frames, workers = sys.argv[1:]
import_waymo(Path(source), Path(out), ImportOptions(frames=(0, int(frames)), workers=int(workers)))
"""


def jpeg(width: int, height: int, rng: np.random.Generator) -> bytes:
    """A JPEG of some 450 kB: patches, and fine noise."""
    patches = Image.fromarray(rng.integers(0, 255, (height // 40, width // 40, 3), dtype=np.uint8))
    pixels = np.asarray(patches.resize((width, height), Image.Resampling.BICUBIC)).astype(int)
    buffer = io.BytesIO()
    Image.fromarray((pixels + rng.integers(-9, 9, pixels.shape)).clip(0, 255).astype(np.uint8)).save(
        buffer, "JPEG", quality=80
    )
    return buffer.getvalue()


def full_size_log(frames: int) -> write_waymo.Log:
    """A made-up log; the vehicle drives 10 m/s."""
    rng = np.random.default_rng(1)
    log = write_waymo.Log()
    for number, (width, height) in SIZES.items():
        yaw = {1: 0.0, 2: 0.8, 3: -0.8, 4: 1.6, 5: -1.6}[number]
        lens = [2050.0, 2050.0, 960.0, height / 2, 0.04, -0.33, 0.001, -0.001, 0.0]
        log.cameras.append(
            {
                "number": number,
                "width": width,
                "height": height,
                "intrinsic": lens,
                "extrinsic": yaw_matrix(yaw, (1.5, 0, 2.1)),
            }
        )
    for number in range(1, 6):
        beams = np.linspace(-0.31, 0.045, 64) if number == 1 else ()
        log.lasers.append(
            {
                "number": number,
                "inclinations": beams,
                "min": -1.57,
                "max": 0.52,
                "extrinsic": yaw_matrix(2.5, (1.4, 0, 2.2)),
            }
        )
    images = {number: jpeg(*size, rng) for number, size in SIZES.items()}
    for index in range(frames):
        pose = yaw_matrix(0.7, (-25211.0 + index, 42391.0, -160.0))
        frame = {"timestamp_us": write_waymo.EPOCH_US + index * 100_000, "pose": pose, "lasers": [], "boxes": []}
        time_s = frame["timestamp_us"] / 1e6 + 0.05
        frame["images"] = [
            {
                "number": number,
                "image": image,
                "pose": pose,
                "velocity": np.zeros(6),
                "pose_time": time_s + 0.0125 * number,
                "shutter": 0.002,
                "trigger": time_s - 0.02,
                "done": time_s + 0.02,
                "panoptic": None,
            }
            for number, image in images.items()
        ]
        for number in range(1, 6):
            rows, columns = (64, 2650) if number == 1 else (200, 600)
            returns = []
            for share in (0.9 if number == 1 else 0.3, 0.04):
                image = np.full((rows, columns, 4), -1, np.float32)
                seen = rng.random((rows, columns)) < share
                image[seen, 0], image[seen, 1] = rng.uniform(2, 75, seen.sum()), rng.gamma(0.5, 0.4, seen.sum())
                returns.append(image)
            poses = np.zeros((rows, columns, 6), np.float32) if number == 1 else None
            if poses is not None:
                poses[..., 2], poses[..., 3:] = 0.7, pose[:3, 3]
                poses[..., 3] += np.linspace(-0.5, 0.5, columns, dtype=np.float32)
            frame["lasers"].append({"number": number, "returns": returns, "poses": poses})
        frame["boxes"] = [
            {"id": f"object{n}", "type": 1, "centre": (10.0 + n, 5.0, 1.0), "size": (4.5, 2.0, 1.6), "heading": 0.1}
            for n in range(60)
        ]
        log.frames.append(frame)
    return log


def write_logs(folder: Path, frames: int) -> None:
    """The log in both formats. In a process of its own: the peak memory of a child counts from that of its parent."""
    log = full_size_log(frames)
    write_waymo.masked = masked_crc32c  # the writer's own goes through every byte by itself
    path = write_waymo.write_tfrecord(log, folder / "one" / "log.tfrecord")
    write_waymo.write_parquet(log, folder / "two")
    sys.stdout.write(f"{path.stat().st_size / frames / 1e6:.1f} MB a record, {frames} frames\n")
    sys.stdout.flush()


def one_import(source: Path, frames: int, workers: int) -> tuple[float, float]:
    """Processor seconds and peak memory in MB of an import in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = [sys.executable, "-c", IMPORT, str(source), f"{folder}/scene", str(frames), str(workers)]
        process = subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        if status:
            raise SystemExit(f"importing {source} failed")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / (1024 if sys.platform != "darwin" else 1 << 20)


def main() -> None:
    """Write the log, import it both ways, print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    data = os.urandom(8_000_000)
    start = time.process_time()
    for _ in range(10):
        crc32c(data)
    sys.stdout.write(f"checksum {80 / (time.process_time() - start):.0f} MB/s\n")
    sys.stdout.flush()
    with tempfile.TemporaryDirectory() as folder:
        writer = multiprocessing.get_context("spawn").Process(target=write_logs, args=(Path(folder), options.frames))
        writer.start()
        writer.join()
        for name in ("one", "two"):
            short, _ = one_import(Path(folder, name), SHORT, options.workers)
            long, peak = one_import(Path(folder, name), options.frames, options.workers)
            per_frame = (long - short) / (options.frames - SHORT)
            sys.stdout.write(
                f"format {name}: {per_frame:.2f} processor s per frame, peak {peak:.0f} MB, {options.workers} workers\n"
            )
            sys.stdout.flush()


if __name__ == "__main__":
    main()
