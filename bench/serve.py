"""The simulator: milliseconds per picture and sweep, latency through gRPC under load, and a soak.

python bench/serve.py RUN [--scene SCENE] [--gaussians 120000 1000000] [--clients 1 4 16] [--seconds 10]
python bench/serve.py RUN [--scene SCENE] --soak-minutes 30

RUN: a fit, or the folder of a run. The soak prints a line a minute; its exit code is 1 if a reply was lost or memory
grew by more than 5 % after the first minute.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch

from mudg import native
from mudg.sim import BeamTable, CameraRequest, Instant, LidarRequest, Pinhole, Session, wire
from mudg.sim.server import serving
from mudg.sim.session import LAYERS
from mudg.sim.settings import ServeConfig

SIZES = ((480, 320), (960, 640))
LAYER_SETS = {"rgb": ("rgb",), "rgb depth classes": ("rgb", "depth", "classes"), "all but motion": LAYERS[:-1]}
GROWTH = 1.05


def parser() -> argparse.Namespace:
    """The command line."""
    own = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    own.add_argument("run", type=Path)
    own.add_argument("--scene", type=Path)
    own.add_argument("--gaussians", type=int, nargs="*", default=[])
    own.add_argument("--clients", type=int, nargs="*", default=[1, 4, 16])
    own.add_argument("--seconds", type=float, default=10.0)
    own.add_argument("--soak-minutes", type=float, default=0.0)
    return own.parse_args()


def with_gaussians(session: Session, count: int) -> None:
    """Give the session's scene so many Gaussians: each repeated, moved by a few centimetres."""
    table, model = session.model.table, session.model
    rows = len(table.labels["node"])
    generator = torch.Generator().manual_seed(0)
    chosen = torch.arange(count) % rows
    table.take(chosen)
    table.columns["means"] = table.columns["means"] + 0.05 * torch.randn(count, 3, generator=generator)
    model.sort_rows()


def poses(session: Session) -> list[tuple[float, np.ndarray]]:
    """Times and poses along the log, moved 1 m to the left."""
    found = []
    for frame in session.scene.frames_of(next(iter(session.cameras))) if session.scene else ():
        pose = frame.view.world_from_cam.copy()
        pose[:3, 3] -= pose[:3, 0]
        found.append((frame.view.time_s, pose))
    return found


def milliseconds(work: Any, repeats: int = 7) -> float:
    """Median of a few calls after one to warm up."""
    taken = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        work()
        taken.append(1000 * (time.perf_counter() - start))
    return float(np.median(taken[1:]))


def lens(width: int, height: int) -> Pinhole:
    """A camera with a field of view of 60 degrees."""
    focal = width / 2 / np.tan(np.radians(30))
    return Pinhole(width, height, focal, focal, width / 2, height / 2)


def in_session(session: Session) -> None:
    """Milliseconds of pictures by layers, size and threads, and of a sweep."""
    places = poses(session)
    turn, beams = iter(range(10**9)), BeamTable.spinning(np.linspace(-25, 15, 64), 0.2)

    def moment() -> Instant:
        time_s, pose = places[next(turn) % len(places)]
        return Instant(time_s, pose)

    for threads, limit in ((1, native.one_thread), (2, contextlib.nullcontext)):
        for name, layers in LAYER_SETS.items():
            for width, height in SIZES:
                request = lambda w=width, h=height, on=layers: CameraRequest(
                    optics=lens(w, h), start=moment(), layers=on
                )
                with limit():
                    taken = milliseconds(lambda make=request: session.render([make()]))
                print(f"  {threads} threads  {width}x{height}  {name:18} {taken:7.1f} ms")  # noqa: T201
        with limit():
            taken = milliseconds(lambda: session.render([LidarRequest(beams=beams, start=moment())]), 3)
        print(f"  {threads} threads  64 beams, 0.2 degrees       {taken:7.1f} ms")  # noqa: T201


def footprints(session: Session) -> None:
    """How large Gaussians are on the picture. A level of detail could merge those below half a pixel."""
    table, optics = session.model.table, lens(960, 640)
    means, scales = (table.columns[name].detach().numpy() for name in ("means", "log_scales"))
    sizes = []
    for _, pose in poses(session):
        seen = (means - pose[:3, 3]) @ pose[:3, :3]
        wide = optics.width / 2 / optics.fx * seen[:, 2] * 1.1
        inside = (seen[:, 2] > 0.5) & (np.abs(seen[:, 0]) < wide)
        sizes.append(optics.fx * np.exp(scales[inside].max(1)) / seen[inside, 2])
    pixels = np.concatenate(sizes)
    print(  # noqa: T201
        f"  standard deviation at 960x640: median {np.median(pixels):.1f} px; {np.mean(pixels < 0.5):.2%} below 0.5 px,"
        f" {np.mean(pixels < 1):.2%} below 1 px; {len(pixels) / len(means) / len(sizes):.0%} before the camera"
    )


def request_of(session: Session, number: int, size: tuple[int, int]) -> bytes:
    """A request on the wire."""
    types, (width, height) = wire.messages(), size
    time_s, pose = poses(session)[number % len(poses(session))]
    optics, made = (
        lens(width, height),
        types.RGBRenderRequest(scene_id="bench", resolution_h=height, resolution_w=width),
    )
    made.frame_start_us = made.frame_end_us = max(0, round(time_s * 1e6))
    made.image_format, made.image_quality = wire.JPEG, 95
    pinhole = made.camera_intrinsics.opencv_pinhole_param
    pinhole.focal_length_x, pinhole.focal_length_y = optics.fx, optics.fy
    pinhole.principal_point_x, pinhole.principal_point_y = optics.cx, optics.cy
    made.camera_intrinsics.resolution_w, made.camera_intrinsics.resolution_h = width, height
    for end in (made.sensor_pose.start_pose, made.sensor_pose.end_pose):
        end.CopyFrom(wire.pose_of(pose))
    return made.SerializeToString()


def ask(address: str, requests: Sequence[bytes], until: float, taken: list[float], lost: list[str]) -> None:
    """A client that asks until a time, one request after the other."""
    grpc = wire.package()
    with grpc.insecure_channel(address, options=[("grpc.max_receive_message_length", 2**26)]) as channel:
        method = channel.unary_unary(f"/{wire.SERVICES[0]}/render_rgb")
        number = 0
        while time.monotonic() < until:
            start = time.perf_counter()
            try:
                reply = method(requests[number % len(requests)], timeout=300)
                if not reply:
                    lost.append("empty")
            except grpc.RpcError as error:
                lost.append(str(error.code()))
            taken.append(1000 * (time.perf_counter() - start))
            number += 1


def load(address: str, requests: Sequence[bytes], clients: int, seconds: float) -> tuple[list[float], list[str]]:
    """Latencies in milliseconds, and lost replies, of some clients at once."""
    taken, lost, until = list[float](), list[str](), time.monotonic() + seconds
    with ThreadPoolExecutor(clients) as pool:
        for one in [pool.submit(ask, address, requests, until, taken, lost) for _ in range(clients)]:
            one.result()
    return taken, lost


def main() -> int:
    """Print the tables, or soak."""
    given = parser()
    session = Session(given.run, scene=given.scene)
    print(f"{len(session.model.table.labels['node'])} Gaussians")  # noqa: T201
    if given.soak_minutes:
        return soak(session, given.soak_minutes)
    footprints(session)
    in_session(session)
    for count in given.gaussians:
        with_gaussians(session, count)
        session._last = None
        print(f"{count} Gaussians")  # noqa: T201
        in_session(session)
    requests = [request_of(session, number, (960, 640)) for number in range(8)]
    with serving(session, "bench", ServeConfig()) as (address, _):
        for clients in given.clients:
            taken, lost = load(address, requests, clients, given.seconds)
            p50, p95, p99 = np.quantile(taken, (0.5, 0.95, 0.99))
            rate = len(taken) / given.seconds
            print(  # noqa: T201
                f"  {clients} clients, 960x640 JPEG: {rate:.1f}/s, {p50:.0f} / {p95:.0f} / {p99:.0f} ms"
                f" (50, 95, 99 %), lost {len(lost)}"
            )
    return 0


def soak(session: Session, minutes: float) -> int:
    """Full load by four clients; a line a minute."""
    own, first, total = psutil.Process(), 0, 0
    requests = [request_of(session, number, (480, 320)) for number in range(16)]
    threads = threading.active_count()
    with serving(session, "bench", ServeConfig()) as (address, _):
        for minute in range(max(2, round(minutes))):
            taken, lost = load(address, requests, 4, 60.0)
            memory, total = own.memory_info().rss, total + len(taken)
            first = first or memory
            print(  # noqa: T201
                f"minute {minute + 1}: {len(taken)} replies, lost {len(lost)}, 99 %: {np.quantile(taken, 0.99):.0f} ms,"
                f" memory {memory / 2**20:.0f} MiB ({memory / first:.3f} of the first minute)",
                flush=True,
            )
            if lost or memory > GROWTH * first:
                return 1
    time.sleep(1)
    left = threading.active_count() - threads
    print(f"{total} replies, none lost; stopped, {left} threads left")  # noqa: T201
    return int(left > 0)


if __name__ == "__main__":
    sys.exit(main())
