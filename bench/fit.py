"""Times the fit of a street scene with the product's own loop, and says where the time goes.

    python bench/fit.py                               # 40 frames of 3 cameras, 480x320, 3000 iterations
    python bench/fit.py --steps 60 --threads 1        # a quick look: the first 60 of them
    python bench/fit.py --densify none --json fit.json

The scene is a generated city, made once and kept in --work. The loop is `gaussians/fit.py` as it is: its functions are
wrapped with a clock, nothing is left out. With one thread processor time is measured, else wall time. "rasteriser" is
what the library's own clock counts in its phases; "losses" contains torch's backward pass outside the rasteriser,
"Adam" the check of gradients before it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from mudg import native
from mudg.base import log
from mudg.city.config import CityConfig
from mudg.core.raster import cpu as raster_cpu
from mudg.formats.settings import IngestConfig
from mudg.gaussians import fit
from mudg.gaussians.densify import DensifyStats
from mudg.gaussians.schedule import FiniteCheck
from mudg.gaussians.settings import DensifyConfig, FitConfig
from mudg.gaussians.views import TrainView, ViewSet
from mudg.scene.settings import FuseConfig
from mudg.steps.fit import Fit
from mudg.steps.ingest import Fuse, Ingest

FORWARD = ("project", "sort", "bin", "blend")
BACKWARD = ("blend_backward", "project_backward")
FIRST_STEPS = 3
"""Not counted: they load code and ask for memory."""
PARTS = ("rasteriser forward", "rasteriser backward", "losses", "Adam", "compose", "densify", "view loading", "rest")


class EnoughSteps(Exception):
    """A quick look is over."""


class Clock:
    """Seconds per part, summed over all steps; a part inside another counts for the inner one only."""

    def __init__(self, now: Callable[[], float]) -> None:
        self.now = now
        self.seconds = dict.fromkeys(PARTS, 0.0)
        self.asking = 0.0
        self._inner = [0.0]

    def wrapped(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its time added to a part."""

        def timed(*arguments: Any, **named: Any) -> Any:
            self._inner.append(0.0)
            began = self.now()
            try:
                return function(*arguments, **named)
            finally:
                spent = self.now() - began
                self.seconds[part] += spent - self._inner.pop()
                self._inner[-1] += spent

        return timed

    def move_phases(self, source: str, target: str, names: tuple[str, ...]) -> None:
        """Book what the library counted in these phases of its last call under its own part; asking takes time
        itself."""
        began = self.now()
        found = raster_cpu.last_statistics()
        self.asking += self.now() - began
        counted = sum(found[name] for name in names)
        self.seconds[source] -= counted
        self.seconds[target] += counted


def instrument(clock: Clock) -> None:
    """Put the clock into the loop of `gaussians/fit.py`."""
    for part, names in {
        "compose": ("compose",),
        "Adam": ("adam_step",),
        "densify": ("densify_if_due", "shorten_needles"),
        "losses": ("recorded_terms", "virtual_terms", "regularisers"),
    }.items():
        for name in names:
            setattr(fit, name, clock.wrapped(part, getattr(fit, name)))
    FiniteCheck.terms = clock.wrapped("losses", FiniteCheck.terms)
    FiniteCheck.gradients = clock.wrapped("Adam", FiniteCheck.gradients)
    rasterize, backward = clock.wrapped("rest", fit.rasterize), clock.wrapped("losses", torch.Tensor.backward)

    def timed_rasterize(*arguments: Any, **named: Any) -> Any:
        drawn = rasterize(*arguments, **named)
        clock.move_phases("rest", "rasteriser forward", FORWARD)
        return drawn

    def timed_backward(*arguments: Any, **named: Any) -> None:
        backward(*arguments, **named)
        clock.move_phases("losses", "rasteriser backward", BACKWARD)

    fit.rasterize = timed_rasterize
    torch.Tensor.backward = timed_backward
    ViewSet.choose = clock.wrapped("view loading", ViewSet.choose)
    TrainView.of = clock.wrapped("view loading", TrainView.of)
    DensifyStats.observe = clock.wrapped("densify", DensifyStats.observe)


def street(folder: Path, frames: int, size: str, cameras: int) -> tuple[Path, Path]:
    """Scene and fused cloud of a generated city, made when missing."""
    width, height = (int(side) for side in size.split("x"))
    names = ("front", "front_left", "front_right")[:cameras]
    city = CityConfig(seed=3, n_frames=frames, width=width, height=height, cameras=names)
    root = folder / f"{frames}x{cameras}_{size}"
    scene = Ingest(log="city", out=root / "scene", settings=IngestConfig(city=city)).run()
    return scene, Fuse(scene=scene, out=root / "fuse", settings=FuseConfig()).run()


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Run the fit; returns the numbers."""
    native.set_threads(options.threads)
    scene, fused = street(Path(options.work), options.frames, options.size, options.cameras)
    config = FitConfig(
        method="street_gaussians",
        iterations=options.iterations,
        densify=DensifyConfig(kind=options.densify),
        checkpoint_every=1_000_000,
        preview_every=1_000_000,
    )
    clock = Clock(time.process_time if options.threads == 1 else time.perf_counter)
    instrument(clock)
    optimise, last_of_step, taken = fit.optimise, fit.densify_if_due, {}

    def count_steps(*given: Any) -> dict[str, Any]:
        step = given[3]
        if step == FIRST_STEPS + 1:
            clock.seconds, clock.asking = dict.fromkeys(PARTS, 0.0), 0.0
            taken["began"] = clock.now()
        if step > FIRST_STEPS + options.steps > FIRST_STEPS:
            raise EnoughSteps
        taken["steps"] = step - FIRST_STEPS
        return last_of_step(*given)

    def timed_optimise(state: fit.FitState, settings: FitConfig, folder: Any) -> None:
        with contextlib.suppress(EnoughSteps):
            optimise(state, settings, folder)
        taken.update(seconds=clock.now() - taken.pop("began") - clock.asking, gaussians=len(state.model.table))

    fit.optimise, fit.densify_if_due = timed_optimise, count_steps
    with tempfile.TemporaryDirectory() as folder:
        Fit(scene=scene, fused=fused, out=Path(folder) / "fit", settings=config).run()
    clock.seconds["rest"] += taken["seconds"] - sum(clock.seconds.values())
    return {
        **taken,
        "iterations": config.iterations,
        "densify": config.densify.kind,
        "frames": options.frames,
        "cameras": options.cameras,
        "size": options.size,
        "threads": options.threads,
        "clock": "processor" if options.threads == 1 else "wall",
        "isa": native.isa(),
        "it_per_s": taken["steps"] / taken["seconds"],
        "ms": {part: 1e3 * value / taken["steps"] for part, value in clock.seconds.items()},
    }


def table(found: dict[str, Any]) -> str:
    """The numbers for people."""
    step_ms = sum(found["ms"].values())
    lines = [
        native.status(),
        (
            f"{found['frames']} frames x {found['cameras']} cameras, {found['size']}, densify {found['densify']}, "
            f"{found['gaussians']} Gaussians at the end; {found['steps']} steps, {found['clock']} time"
        ),
        f"{found['it_per_s']:.1f} it/s, {step_ms:.1f} ms per step",
        *(f"  {part:<21}{value:7.2f} ms {value / step_ms:5.0%}" for part, value in found["ms"].items()),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--iterations", type=int, default=3000, help="length that schedules and learning rates belong to"
    )
    parser.add_argument("--steps", type=int, default=0, help="stop after so many steps (0 = all iterations)")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--cameras", type=int, default=3, choices=(1, 2, 3))
    parser.add_argument("--size", default="480x320")
    parser.add_argument("--densify", default="gradient", choices=("gradient", "none"))
    parser.add_argument(
        "--work", default=str(Path(tempfile.gettempdir()) / "mudg_bench_fit"), help="where the generated scene is kept"
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
