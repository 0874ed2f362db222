"""What the chain takes on a scene: time of every step, memory and bytes, from counts of views, pixels, Gaussians and
points.

Unit costs are processor seconds on the machine where they were measured (2 virtual cores with AVX-512 and AMX).
`core/raster/rasterize.py` says how fast another machine is beside it, by one short step of a fit. On a CUDA card
nothing was measured: there the memory is counted and the time is unknown. So is the time of a published-type model, on
any device.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mudg.base import memory
from mudg.base.palette import CLASSES
from mudg.steps.settings import PRESETS, PresetName, run_preset

if TYPE_CHECKING:
    from mudg.steps.settings import RunConfig

FACTOR: Final = 1.5
"""The time of a whole run is within this factor of its forecast (tests/test_cost.py)."""
FIT_S: Final = 0.38e-6
"""A step of a fit, per Gaussian and per pixel of its view. A virtual view beside the recorded one costs VIRTUAL such
steps more."""
VIRTUAL: Final = 1.5
NETWORK_VIEW_S, NETWORK_PIXEL_S = 0.25, 5.5e-6
"""A view that a network makes or labels, and each of its pixels; every denoising step adds a tenth of the first."""
SHOWN_VIEW_S, SHOWN_PIXEL_S = 0.05, 1.5e-6
"""A view that is scored or reported; a pixel that is rendered or scored."""
POINT_S: Final = 6e-7
"""A point of a sweep, for every image that it may be seen in."""
START_S, PROCESS_S = 0.5, 4.0
"""Any step, and any process of synthesize, before it computes."""
SHARED: Final = 0.79
"""Share of a step in one process that is divided among the cores."""
SHORT_FIT: Final = 1000
"""Fits of no more iterations end with at most three Gaussians per point of a sweep, longer ones with one per three
recorded pixels."""
PROGRAM_BYTES, NETWORK_BYTES, NETWORK_PIXEL_BYTES = 600_000_000, 680_000_000, 1_600
"""The program after a fit; each process in which a network runs, and a pixel of its view."""
PUBLISHED_BYTES: Final = {"cpu": 19_000_000_000, "cuda": 9_000_000_000}
"""A published-type model (counted, not measured: docs/research/published.md)."""
PARAMETER_BYTES, GAUSSIAN_BYTES = 20, 300
"""A number of a Gaussian in memory, with moments and gradient; a Gaussian on disk, in both fits and the viewer."""
VIEW_PIXEL_BYTES, VIEWS_BYTES = 10, 2**30
"""A pixel of a view in memory, where all of them take at most VIEWS_BYTES."""
WRITTEN_PIXEL_BYTES, SCORED_PIXEL_BYTES = 6, 10
"""A pixel of a view as written, compressed; one that is labelled or scored."""


@dataclass(frozen=True)
class SceneSize:
    """What a forecast depends on.

    Args:
        images: that are fitted. path_images: of the camera that is shifted, one per frame. width, height: of an image,
            pixels.
        points: LiDAR points of a sweep (0 = not counted). exact: the truth of shifted views is known (generated
            cities).
        labelled: semantic labels are there.
    """

    images: int
    path_images: int
    width: int
    height: int
    points: int = 0
    exact: bool = True
    labelled: bool = True


@dataclass(frozen=True)
class Estimate:
    """Seconds by the clock and of all processors, per step (None: not measured), most memory and size of all results,
    in bytes."""

    seconds: Mapping[str, float | None]
    processor_s: Mapping[str, float | None]
    memory_bytes: int
    written_bytes: int

    @property
    def total_s(self) -> float | None:
        """Seconds of all steps, None if one is unknown."""
        known = [value for value in self.seconds.values() if value is not None]
        return sum(known) if len(known) == len(self.seconds) else None

    def fits(self, free_bytes: int, free_disk_bytes: int) -> bool:
        """Whether memory and disk that are free suffice; 0 = not known, and then not asked."""
        enough = self.memory_bytes <= (free_bytes or self.memory_bytes)
        return enough and self.written_bytes <= (free_disk_bytes or self.written_bytes)


def estimate(config: RunConfig, size: SceneSize, cores: int, speed: float = 1.0, device: str = "cpu") -> Estimate:
    """Forecast ``mudg run SCENE``. ``cores``: that the steps may use. ``speed``: 1 = the machine of the unit costs.
    ``device``: ``cpu`` or ``cuda``."""
    fit, pixels, published = config.fit, size.width * size.height, config.synthesize.guidance is not None
    lines = len(config.synthesize.shifts_m)
    made, rendered = size.path_images * lines, size.path_images * len(config.render.shifts_m)
    scored = 2 * rendered + made if size.exact else rendered
    processes = 1 if published or device != "cpu" else max(1, min(config.synthesize.processes or cores, lines))
    fit_pixels = pixels * min(1.0, (fit.width_px or size.width) / size.width) ** 2
    recorded = size.images * pixels
    most = recorded / 3 if fit.iterations > SHORT_FIT else 3 * size.points or recorded
    gaussians = min(fit.densify.max_gaussians, recorded, most)
    step_s = FIT_S * (gaussians + fit_pixels)
    guided_s = step_s * (1 + VIRTUAL * fit.virtual.probability * fit.virtual.beside)
    view_s = NETWORK_VIEW_S * (1 + config.synthesize.steps / 10) + NETWORK_PIXEL_S * pixels
    work = {  # core-seconds, and processes among which they are divided (0: threads)
        "annotate": (size.images * (NETWORK_VIEW_S + NETWORK_PIXEL_S * pixels), cores),
        "fuse": (size.images * size.points * POINT_S, 0),
        "fit without diffusion": (fit.iterations * step_s, 0),
        "synthesize": (PROCESS_S * processes + made * view_s, processes),
        "fit with diffusion": (config.guided_share * fit.iterations * guided_s, 0),
        "render without diffusion": (rendered * SHOWN_PIXEL_S * pixels, 0),
        "render with diffusion": (rendered * SHOWN_PIXEL_S * pixels, 0),
        "score": (scored * (SHOWN_VIEW_S + SHOWN_PIXEL_S * pixels), 0),
        "viewer": (START_S, 0),
        "report": ((2 * rendered + made) * SHOWN_VIEW_S * min(1.0, pixels / 100_000), 0),
    }
    seconds, processor_s = dict[str, float | None](), dict[str, float | None]()
    for name, (core_s, among) in work.items():
        if name == "annotate" and size.labelled:
            continue
        known = device == "cpu" and not (name == "synthesize" and published)
        spread = 1 / min(among, cores) if among else 1 - SHARED + SHARED / cores
        times = ((core_s * held + START_S) / speed if known else None for held in (spread, 1.0))
        seconds[name], processor_s[name] = times
    columns = 11 + 3 * (fit.sh_degree + 1) ** 2 + len(CLASSES) * fit.semantics
    views = min(VIEW_PIXEL_BYTES * (size.images + made) * fit_pixels, VIEWS_BYTES) if device == "cpu" else 0
    networks = processes * (NETWORK_BYTES + NETWORK_PIXEL_BYTES * pixels)
    held = PUBLISHED_BYTES[device] if published else networks
    memory_bytes = max(PARAMETER_BYTES * columns * gaussians + views, held)
    judged = (rendered if size.exact else size.path_images) + (0 if size.labelled else size.images)
    shown = WRITTEN_PIXEL_BYTES * (made + 2 * rendered) + SCORED_PIXEL_BYTES * judged
    written = pixels * shown + GAUSSIAN_BYTES * gaussians
    return Estimate(seconds, processor_s, round(PROGRAM_BYTES + memory_bytes), round(written))


def of_presets(size: SceneSize, cores: int, speed: float = 1.0, device: str = "cpu") -> dict[PresetName, Estimate]:
    """The forecast of every preset."""
    return {name: estimate(run_preset(name), size, cores, speed, device) for name in PRESETS}


def in_words(
    found: Mapping[PresetName, Estimate], free_bytes: int, device: str = "cpu", free_disk_bytes: int = 0
) -> list[str]:
    """A line per preset: time, memory, disk; then which presets fit into what is free (0: unknown), and the time of
    every step."""
    lines = [f"forecasts for mudg run on this scene ({device}):"]
    for name, one in found.items():
        fits = "" if not free_bytes else "fits" if one.memory_bytes <= free_bytes else "does NOT fit"
        free = f", {fits} into the {memory.in_words(free_bytes)} that are free" if fits else ""
        disk = " (NOT free here)" if free_disk_bytes and one.written_bytes > free_disk_bytes else ""
        space = f"about {memory.in_words(one.memory_bytes)}{free}; {memory.in_words(one.written_bytes)} on disk{disk}"
        lines.append(f"  --preset {name:<8} {_time(one)}; {space}")
    if free_bytes:
        able = [name for name, one in found.items() if one.fits(free_bytes, free_disk_bytes)]
        names = ", ".join(able) or "none (smaller images, fewer frames)"
        lines.append(f"  memory and disk of this machine suffice for: {names}")
    lines.append(f"  {'time per step':<30}" + "".join(f"{name:>12}" for name in found))
    for step in max((one.seconds for one in found.values()), key=len):
        cells = ["not taken" if step not in one.seconds else duration(one.seconds[step]) for one in found.values()]
        lines.append(f"    {step:<28}" + "".join(f"{cell:>12}" for cell in cells))
    return lines


def in_a_line(idle: Estimate, now: Estimate) -> str:
    """What a run is about to take, on this machine undisturbed and as busy as it is now."""
    total_s, now_s = (sum(value or 0.0 for value in one.seconds.values()) for one in (idle, now))
    longest = sorted(idle.seconds, key=lambda name: -(idle.seconds[name] or 0.0))[:3]
    busy = f", about {duration(now_s)} if it stays as busy as it is now" if now_s > FACTOR * total_s else ""
    parts = f" ({', '.join(f'{name} {duration(idle.seconds[name])}' for name in longest)})" if total_s else ""
    space = f"{memory.in_words(idle.memory_bytes)} of memory, {memory.in_words(idle.written_bytes)} on disk"
    return f"forecast: {_time(idle)} on this machine{busy}{parts}; {space}"


def _time(one: Estimate) -> str:
    unknown = [step for step, value in one.seconds.items() if value is None]
    if len(unknown) == len(one.seconds):
        return "time not measured"
    more = f" and {', '.join(unknown)} (not measured)" if unknown else ""
    return f"about {duration(sum(value or 0.0 for value in one.seconds.values()))}{more}"


def duration(seconds: float | None) -> str:
    """Seconds, minutes or hours in words."""
    if seconds is None:
        return "-"
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
