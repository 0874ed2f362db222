"""Memory and time of the views of a large fit: bytes per view, peak of resident memory, loading, share of a step.

    python bench/fit_memory.py                               # 200 views, 1600x1066, a few steps
    python bench/fit_memory.py --views 1000 --virtual 200    # the size of a log of five cameras
    python bench/fit_memory.py --views 100 --in-memory       # the same with all views decoded in memory

The scene is a generated city of 8 frames at the wanted size, made once and kept in --work; its frames (and exact
virtual views of them) are named as often as views are wanted, so that all are read and decoded but the disk holds few.
The fit is the product's own: `load_recorded`, `load_virtual`, the starting model and the loop. The peak is that of
anonymous memory: pages of the files that the system keeps are its own to drop.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mudg import native
from mudg.base import log
from mudg.base.run_folder import RunDir
from mudg.base.types import Scene
from mudg.city.config import CityConfig
from mudg.city.world import CityWorld
from mudg.core import trajectory
from mudg.formats.settings import IngestConfig
from mudg.gaussians import fit, views
from mudg.gaussians import views as kept
from mudg.gaussians.settings import FitConfig, VirtualConfig
from mudg.gaussians.views import TrainView, ViewSet
from mudg.scene.clouds import read_fused
from mudg.scene.observations import ObservationSet, ObservationWriter, read_observations
from mudg.scene.read import read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps.ingest import Fuse, Ingest

GIB = 1 << 30
FRAMES, CAMERAS = 4, ("front", "front_left")


class EnoughSteps(Exception):
    """A look at a few steps is over."""


class PeakMemory:
    """Largest anonymous resident memory of this process, looked at 20 times a second."""

    def __init__(self) -> None:
        self.peak = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> PeakMemory:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._over.wait(0.05):
            lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
            self.peak = max(
                self.peak, 1024 * next(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))
            )


def city_of(folder: Path, size: str) -> tuple[Scene, Path, ObservationSet]:
    """A scene of 8 frames, its fused cloud, and exact virtual views 2 m to the left of the front camera; made when
    missing."""
    width, height = (int(side) for side in size.split("x"))
    config = CityConfig(seed=3, n_frames=FRAMES, width=width, height=height, cameras=CAMERAS)
    root = folder / f"memory_{size}"
    scene = Ingest(log="city", out=root / "scene", settings=IngestConfig(city=config, test_every=0)).run()
    fused = Fuse(scene=scene, out=root / "fuse", settings=FuseConfig()).run()
    if not (root / "virtual" / "observations.json").is_file():
        world = CityWorld(config)
        with ObservationWriter(root / "virtual", "shifted", "truth") as writer:
            for view in trajectory.shifted(read_scene(scene), "front", 2.0).views:
                writer.add(world.observation(view))
    return read_scene(scene), fused, read_observations(root / "virtual")


def repeated(scene: Scene, count: int) -> Scene:
    """The scene with as many frames, each of its own name."""
    frames = [replace(scene.frames[n % len(scene.frames)], id=f"{n:06d}") for n in range(count)]
    return replace(scene, frames=tuple(sorted(frames, key=lambda frame: (frame.view.time_s, frame.id))))


def timed(
    function: Callable[..., Any], seconds: list[float], now: Callable[[], float] = time.perf_counter
) -> Callable[..., Any]:
    """The function, the time of every call noted."""

    def call(*arguments: Any, **named: Any) -> Any:
        began = now()
        try:
            return function(*arguments, **named)
        finally:
            seconds.append(now() - began)

    return call


def loaded(
    options: argparse.Namespace, city: tuple[Scene, Path, ObservationSet], out: Path
) -> tuple[fit.FitState, FitConfig, dict[str, Any]]:
    """The state that the fit starts from, and what loading its views took."""
    scene, fused, observations = repeated(city[0], options.views), *city[1:]
    sets = {f"set{n:04d}": observations for n in range(-(-options.virtual // len(observations)))}
    config = FitConfig(
        method="mudg_s" if sets else "street_gaussians",
        iterations=30_000,
        checkpoint_every=10**6,
        preview_every=10**6,
        virtual=VirtualConfig(start=0.0, gaussians=options.unseen),
    )
    virtual = sum(map(len, sets.values()))
    kept.IN_MEMORY_BYTES = 1 << 62 if options.in_memory else 0
    began = time.perf_counter(), time.process_time()
    found, classes = fit.recorded_views(config, scene, sets, None, out)
    cloud = read_fused(fused)
    measured = views.fused_lidar(cloud, scene.tracks)
    found = replace(found, virtual=kept.keep(views.load_virtual(sets, classes, measured), virtual, out))
    numbers = {
        "views": options.views,
        "virtual": virtual,
        "size": options.size,
        "in_memory": options.in_memory,
        "loading_s": time.perf_counter() - began[0],
        "loading_cpu_s": time.process_time() - began[1],
    }
    began = time.perf_counter(), time.process_time()
    state = fit.start_state(config, scene, cloud, found, classes)
    return state, config, {**numbers, "start_s": time.perf_counter() - began[0], "gaussians": len(state.model.table)}


@contextlib.contextmanager
def step_times(first: int, last: int) -> Iterator[dict[str, list[float]]]:
    """Clocks in the loop: choosing views and making tensors of them (processor time of the thread), whole steps."""
    found: dict[str, list[float]] = {"choosing": [], "tensors": [], "step": []}
    due, choose, tensors = fit.densify_if_due, ViewSet.choose, TrainView.of
    began = [time.perf_counter()]

    def count(*given: Any) -> dict[str, Any]:
        found["step"].append(time.perf_counter() - began[0])
        began[0] = time.perf_counter()
        if given[3] >= last:
            raise EnoughSteps
        return due(*given)

    fit.densify_if_due = count
    ViewSet.choose = timed(choose, found["choosing"], time.thread_time)
    TrainView.of = timed(tensors, found["tensors"], time.thread_time)
    try:
        yield found
    finally:
        fit.densify_if_due = due
        ViewSet.choose, TrainView.of = choose, tensors
    for name in found:
        found[name] = found[name][first:]


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Load, do some steps; returns the numbers."""
    native.set_threads(options.threads)
    city = city_of(Path(options.work), options.size)
    with tempfile.TemporaryDirectory(dir=options.work) as out, PeakMemory() as memory:
        folder = RunDir.open(Path(out) / "fit", fit.OUTPUT, {}, {})
        state, config, numbers = loaded(options, city, folder.path)
        numbers["peak_loading_gib"] = memory.peak / GIB
        with step_times(3, options.steps) as found, contextlib.suppress(EnoughSteps):
            fit.optimise(state, config, folder)
    medians = {f"{name}_ms": 1e3 * statistics.median(values) for name, values in found.items()}
    return {
        **numbers,
        **medians,
        "peak_gib": memory.peak / GIB,
        "steps": len(found["step"]),
        "threads": options.threads,
    }


def table(found: dict[str, Any]) -> str:
    """The numbers for people."""
    count = found["views"] + found["virtual"]
    step, tensors = found["step_ms"], found["tensors_ms"]
    return (
        "\n".join(
            [
                (
                    f"{found['views']} recorded and {found['virtual']} virtual views of {found['size']},"
                    f" {'in memory' if found['in_memory'] else 'in files'}"
                ),
                (
                    f"loading {found['loading_s']:.0f} s, {1e3 * found['loading_cpu_s'] / count:.0f} ms of processor"
                    " time per view"
                ),
                f"starting model {found['start_s']:.1f} s, {found['gaussians']} Gaussians",
                (
                    f"peak of anonymous memory: {found['peak_loading_gib']:.2f} GiB while loading,"
                    f" {found['peak_gib']:.2f} GiB in all"
                ),
                (
                    f"{found['steps']} steps, {found['threads']} threads, medians: step {step:.0f} ms; tensors of"
                    f" a view {tensors:.1f} ms"
                ),
            ]
        )
        + "\n"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=200, help="recorded views")
    parser.add_argument("--virtual", type=int, default=0, help="virtual views with dense depth")
    parser.add_argument("--size", default="1600x1066")
    parser.add_argument("--steps", type=int, default=15)
    parser.add_argument(
        "--unseen", type=int, default=0, help="Gaussians at surfaces that only virtual views show (0 = not looked for)"
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--in-memory", action="store_true", help="keep all views in memory, whatever they take")
    parser.add_argument(
        "--work", default=str(Path(tempfile.gettempdir()) / "mudg_bench_fit"), help="where scene and files lie"
    )
    parser.add_argument("--json", default="", help="also write the numbers here")
    options = parser.parse_args()
    native.require("this benchmark")
    torch.set_num_threads(1)
    log.set_quiet(True)
    found = measure(options)
    sys.stdout.write(table(found))
    if options.json:
        Path(options.json).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
