"""What the chain takes on a scene: seconds, processor seconds, memory and bytes of every step, forecast from a few measured constants.

Each step is a sum of a start and of what it does per image, pixel, Gaussian and point (`docs/presets.md` has the table). Constants are
core-seconds on a machine of 2 virtual cores with AVX-512 and AMX; `Machine.speed` says how fast another machine is, or how much of this
one is free: `core/raster/probe.py` measures it in a fraction of a second. On a CUDA card nothing was measured: there the memory is
counted and the time is unknown. So is the time of a published-type model, on any device.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mudg.base.palette import CLASSES
from mudg.stages.config.presets import PRESETS, PresetName, run_preset

if TYPE_CHECKING:
    from mudg.stages.config.run import RunConfig

FACTOR: Final = 1.5
"""Forecasts were within this factor of what was measured (tests/test_cost.py)."""

GAUSSIAN_STEP_S: Final = 0.40e-6
PIXEL_STEP_S: Final = 0.36e-6
"""A step of a fit, per Gaussian and per pixel: 82.4 ms at 75,000 and 480x320 (bench/fit.py --threads 1); 65 ms at 120,000 and 240x160."""
VIRTUAL_PIXEL_S: Final = 0.75e-6
"""What a virtual view beside the recorded one takes more than that, per pixel: features of both pictures, dense depth."""
HALVED_PX: Final = 96
"""Virtual views whose sides would be shorter are not used at half their size (stages/fitting/halved.py)."""
SHARED: Final = 0.79
"""Share of a step that is divided among the cores: 101 ms on one core became 61 on two (bench/fit.py)."""
CLIP_STEP_S: Final = 0.0225
CLIP_S: Final = 0.2
FULL_VIEW_S: Final = 8.3e-6
"""The small diffusion model with renders, per view: a denoising step (bench/mdm.py, bfloat16), all else at its own size, and per pixel of
the camera."""
PROCESS_S: Final = 4.0
LOAD_S: Final = 0.5
"""Each process that makes views starts and loads the model; the chain's own process only loads it."""
RENDER_S: Final = 1.6e-6
SCORED_VIEW_S: Final = 0.075
SCORE_S: Final = 1.45e-6
REPORT_S: Final = 0.5e-6
"""Per pixel of a view, and per view: `mudg demo --fast` and `mudg demo`."""
FUSE_S: Final = 0.012
FUSE_POINT_S: Final = 2.0e-7
MATCH_S: Final = 0.13
"""Per recorded image, and per point of its sweep; where there are several cameras, whose colours are compared, more per image."""
LABEL_S: Final = 0.4
LABEL_PIXEL_S: Final = 4.4e-6
"""Labels and dense depth of a recorded image, by the shipped labeller."""
LABELLER_S: Final = 3.0
"""Each of several processes that label starts and loads the network."""
LABEL_PROCESS_FRAMES: Final = 8
"""Fewer images than this are not worth a process (stages/annotate.py)."""
SHORT_GAUSSIANS: Final = 40_000
"""Gaussians of the short fits that lessons of a log are made with (stages/fitting/short.py)."""
LESSON_S: Final = 2.0
TRAINED_FRAME_S: Final = 0.25
"""Of adapt: a lesson's photographs carried and written, and a frame of a training step, forward and backward."""
VIEWER_S: Final = 0.4
START_S: Final = 0.3
FIT_START_S: Final = 1.5
"""Any step, before it computes; a fit also chooses its first Gaussians and reads its views."""

START_GAUSSIANS: Final = 0.6
START_POINTS: Final = 0.4
NEW_POINTS: Final = 0.4
GROWN: Final = 1.96
GROWTH_STEPS: Final = 120
LONG_FIT: Final = 200
PIXELS_PER_GAUSSIAN: Final = 3
"""Gaussians at the start, per recorded pixel, and at most per point of a sweep, times a power of the frames, since later
sweeps measure much the same (6 frames of a KITTI drive started 26,000, 16 started 37,000); how many times as many a short
fit ends with, those of objects included (6 images of 120x80 led to 71,000), after how many iterations; and a fit of more iterations than
LONG_FIT ends with one per so many recorded pixels, if that is more. Never more than the limits of the settings."""
PROGRAM_BYTES: Final = 360_000_000
"""Python, torch and the native library: resident after ingest."""
KEPT_BYTES: Final = 180_000_000
"""What the chain's process does not give back after the first fit."""
KEPT_MODEL_BYTES: Final = 150_000_000
KEPT_PIXEL_BYTES: Final = 3_400
"""Likewise, where the chain's process made the views itself: after that, and per pixel of the camera."""
COPIES: Final = 4.85
"""Numbers held per parameter: itself, two moments of Adam, and 1.85 for gradient and rasteriser (bench/README.md)."""
RECORDED_BYTES: Final = 7
VIRTUAL_BYTES: Final = 10
"""Per pixel of a view that a fit keeps: colour, classes, masks, LiDAR; virtual ones have depth and confidence, too."""
VIEWS_BYTES: Final = 2**30
"""No more of them are held in memory: the others lie in a file (stages/fitting/kept.py)."""
STEP_PIXEL_BYTES: Final = 600
"""Per pixel of the view of a step: images, gradients and what losses keep."""
RENDER_PIXEL_BYTES: Final = 2000
"""Per pixel of a view, while pictures are rendered or scored."""
LABEL_BYTES: Final = 60_000_000
LABEL_PROCESS_BYTES: Final = 290_000_000
LABEL_PIXEL_BYTES: Final = 400
"""The labeller, per process and per pixel of an image; where there are several processes, each is a program of its own, too."""
TRAINING_BYTES: Final = 1_000_000_000
KEPT_TRAINING_BYTES: Final = 600_000_000
"""Adapt: the small diffusion model while it is trained, and what the chain's process does not give back after that."""
POINT_BYTES: Final = 60
"""Per LiDAR point, while points are fused."""
OWN_PROCESS_BYTES: Final = 300_000_000
"""Of that, what the chain's own process has already."""
MODEL_BYTES: Final = 450_000_000
CLIP_PIXEL_BYTES: Final = 5_600
"""The small diffusion model while it samples: per process, and for each pixel of the camera, to whose size the finisher brings a window."""
PUBLISHED_BYTES: Final = {"cpu": 19_000_000_000, "cuda": 9_000_000_000}
"""The published one at 576x1024: on the CPU in float32 with all work at once, on CUDA in bfloat16 with the work cut to 10 GB (counted, not
measured: docs/published.md)."""

COLORED_POINT_FILE: Final = 8.5
"""Bytes of the fused clouds, per recorded image and point of a sweep that it sees."""
GAUSSIAN_FILE: Final = 132
"""Per Gaussian of a fit, with its semantics; harmonics of degree 0."""
FIT_FILE: Final = 500_000
VIEW_FILE: Final = 9.7
"""Per pixel of a written view: colour losslessly, depth, classes, confidence."""
LABEL_FILE: Final = 16
SWEEP_FILE: Final = 22
"""Per pixel of a labelled image, and per point of a sweep: a labelled scene holds images and sweeps again."""
ADAPTED_FILE: Final = 29_000_000
"""The adapted model."""
LINE_FILE: Final = 850_000
"""Per generated trajectory: the overview picture."""
SCORE_FILE: Final = 19.7
LOG_SCORE_FILE: Final = 30
"""Per pixel of a scored view: its truth, and the nearest fill; of recorded logs, whose images are those of a camera, per recorded one."""
VIEWER_GAUSSIAN_FILE: Final = 26
REPORT_FILE: Final = 1.0
REPORT_ADAPTED_FILE: Final = 1_000_000
REPORT_LARGEST: Final = 6_600_000
PANEL_PX: Final = 320
"""Of the page: per pixel of a view, at most so many pixels wide; where a log was adapted to; and videos, which share what there is."""


@dataclass(frozen=True)
class SceneSize:
    """What a forecast depends on.

    Args:
        images: that are fitted. path_images: of the camera that is shifted, one per frame. width, height: of an image, pixels.
        points: LiDAR points of a sweep (0 = not counted). exact: the truth of shifted views is known (generated cities).
        seen: share of a sweep's points that lie in an image. labelled: semantic labels are there.
        adapts: the diffusion model can be adapted to the log.
    """

    images: int
    path_images: int
    width: int
    height: int
    points: int = 0
    exact: bool = True
    seen: float = 1 / 6
    labelled: bool = True
    adapts: bool = False

    @property
    def pixels(self) -> int:
        """Pixels of an image."""
        return self.width * self.height


@dataclass(frozen=True)
class Machine:
    """Where a run is to take place.

    Args:
        cores: that the steps may use. speed: 1 = the machine on which the constants were measured, undisturbed.
        processors: of the whole machine (0 = as many as cores); views are made by as many processes.
    """

    cores: int
    speed: float = 1.0
    processors: int = 0


@dataclass(frozen=True)
class StepCost:
    """One step: seconds and processor seconds (None: not measured), most memory, and size of the results, in bytes."""

    seconds: float | None
    processor_s: float | None
    memory_bytes: int
    written_bytes: int


@dataclass(frozen=True)
class Estimate:
    """What every step of the chain takes."""

    steps: Mapping[str, StepCost]

    @property
    def seconds(self) -> dict[str, float | None]:
        """Seconds per step."""
        return {name: step.seconds for name, step in self.steps.items()}

    @property
    def memory_bytes(self) -> int:
        """At the worst moment, of the processor's or the card's memory."""
        return max(step.memory_bytes for step in self.steps.values())

    @property
    def written_bytes(self) -> int:
        """Size of all results."""
        return sum(step.written_bytes for step in self.steps.values())

    @property
    def total_s(self) -> float | None:
        """Seconds of all steps, None if one is unknown."""
        known = [value for value in self.seconds.values() if value is not None]
        return sum(known) if len(known) == len(self.steps) else None


def estimate(config: RunConfig, size: SceneSize, machine: Machine, device: str = "cpu") -> Estimate:
    """Forecast ``mudg run SCENE`` with a configuration; ``device``: ``cpu`` or ``cuda``."""
    processes = _processes(config, machine) if device == "cpu" else 1
    labellers = _labelling(config, size, machine)
    written, memory = _written(config, size), _memory(config, size, (processes, labellers), device)
    work = _work(config, size, (processes, labellers))
    if device != "cpu":
        return Estimate({name: StepCost(None, None, memory[name], written[name]) for name in work})
    used = {"synthesize": processes, "annotate": labellers, "adapt": min(machine.cores, _lessons(config))}
    per_core = 1 - SHARED + SHARED / machine.cores
    steps = {}
    for name, core_s in work.items():
        share = 1 / min(used[name], machine.cores) if name in used else per_core
        processor_s = None if core_s is None else (core_s + START_S) / machine.speed
        seconds = None if core_s is None else (core_s * share + START_S) / machine.speed
        steps[name] = StepCost(seconds, processor_s, memory[name], written[name])
    return Estimate(steps)


def _work(config: RunConfig, size: SceneSize, workers: tuple[int, int]) -> dict[str, float | None]:
    """Core-seconds per step, on the machine where the constants were measured; None: not measured. workers: processes of synthesize and
    of annotate."""
    processes, labellers = workers
    labelling = LABELLER_S * labellers if labellers > 1 else 0.0
    fit, virtual, pixels = config.fit, config.fit.virtual, size.pixels
    gaussians, fit_pixels = _gaussians(config, size), _fit_pixels(config, size)
    classes = (1 + 1 / (3 * fit.loss.semantic_every)) / (1 + 1 / 9)
    step_s = GAUSSIAN_STEP_S * gaussians + PIXEL_STEP_S * fit_pixels * classes
    further = 0.5 * fit.iterations if config.continue_fit else fit.iterations
    share = virtual.continued_probability if config.continue_fit else virtual.probability
    halved = 1 - 0.75 * _halved_share(config, size)
    virtual_step_s = GAUSSIAN_STEP_S * gaussians + PIXEL_STEP_S * fit_pixels * classes * halved
    beside = share * virtual.beside * virtual_step_s + share * VIRTUAL_PIXEL_S * fit_pixels * halved
    made, rendered = _views(config, size)
    per_view = CLIP_STEP_S * config.synthesize.steps + CLIP_S + FULL_VIEW_S * pixels
    synthesized = (PROCESS_S * processes if processes > 1 else LOAD_S) + made * config.synthesize.samples * per_view
    render_s = rendered * RENDER_S * pixels
    scored = _scored(config, size)
    return {
        **({} if size.labelled else {"annotate": labelling + size.images * (LABEL_S + LABEL_PIXEL_S * pixels)}),
        "fuse": size.images * (FUSE_S + FUSE_POINT_S * size.points + (MATCH_S if size.images > size.path_images else 0)),
        "fit without diffusion": FIT_START_S + fit.iterations * step_s,
        **({"adapt": _adapting(config, size)} if _adapts(config, size) else {}),
        "synthesize": None if _published(config) else synthesized,
        "fit with diffusion": FIT_START_S + further * (step_s + beside),
        "render without diffusion": render_s,
        "render with diffusion": render_s,
        "score": scored * (SCORED_VIEW_S + SCORE_S * pixels),
        "viewer": VIEWER_S + 2e-6 * gaussians,
        "report": (2 * rendered + made) * REPORT_S * pixels,
    }


def _adapts(config: RunConfig, size: SceneSize) -> bool:
    return size.adapts and config.adaptation != "off" and not _published(config)


def _halved_share(config: RunConfig, size: SceneSize) -> float:
    """Share of the virtual views' steps that see them at half their size."""
    virtual = config.fit.virtual
    begin = 0.5 if config.continue_fit else virtual.start
    if min(size.width, size.height) // 2 < HALVED_PX or virtual.stop <= begin:
        return 0.0
    return min(1.0, max(0.0, (virtual.half_size - begin) / (virtual.stop - begin)))


def _lessons(config: RunConfig) -> int:
    """Short fits that adapt makes: two with gaps, one per lateral shift and per camera left out."""
    return 2 * config.adapt.gaps + len(config.adapt.shifts_m)


def _adapting(config: RunConfig, size: SceneSize) -> float:
    """Core-seconds of adapt: every lesson is fitted, its clips are made, the model is trained, and scored before and after."""
    adapt = config.adapt
    fitted = FIT_START_S + LESSON_S + PROCESS_S + adapt.fit_iterations * GAUSSIAN_STEP_S * SHORT_GAUSSIANS
    clips = size.path_images * (1 * adapt.gaps + len(adapt.shifts_m))
    made = clips * (CLIP_STEP_S + CLIP_S + FULL_VIEW_S * size.pixels)
    return _lessons(config) * fitted + made + adapt.steps * adapt.batch_frames * TRAINED_FRAME_S


def _labelling(config: RunConfig, size: SceneSize, machine: Machine) -> int:
    """Processes that label images."""
    most = config.annotate.processes or machine.processors or machine.cores
    return max(1, min(most, size.images // LABEL_PROCESS_FRAMES))


def _memory(config: RunConfig, size: SceneSize, workers: tuple[int, int], device: str) -> dict[str, int]:
    """Bytes per step at the worst moment. A step on a card is counted with what lies there alone."""
    processes, labellers = workers
    columns = _columns(config)
    gaussians, fit_pixels = _gaussians(config, size), _fit_pixels(config, size)
    kept = {}
    for name, virtual in (("fit without diffusion", 0), ("fit with diffusion", _views(config, size)[0])):
        views = min((RECORDED_BYTES * size.images + VIRTUAL_BYTES * virtual) * fit_pixels, VIEWS_BYTES) if device == "cpu" else 0
        kept[name] = 4 * COPIES * columns * gaussians + views + STEP_PIXEL_BYTES * fit_pixels
    trained = KEPT_TRAINING_BYTES if _adapts(config, size) and device == "cpu" else 0
    later = 2 * KEPT_BYTES + trained + (KEPT_MODEL_BYTES + KEPT_PIXEL_BYTES * size.pixels if processes == 1 and device == "cpu" else 0)
    scene = 8 * columns * gaussians + RENDER_PIXEL_BYTES * size.pixels
    model = PUBLISHED_BYTES[device] if _published(config) else processes * (MODEL_BYTES + CLIP_PIXEL_BYTES * size.pixels)
    model -= OWN_PROCESS_BYTES if processes == 1 and device == "cpu" and not _published(config) else 0
    own = LABEL_PROCESS_BYTES if labellers > 1 else 0
    labelling = labellers * (LABEL_BYTES + own + LABEL_PIXEL_BYTES * size.pixels)
    adapting = processes * MODEL_BYTES + TRAINING_BYTES
    steps = {
        **({} if size.labelled else {"annotate": labelling}),
        **({"adapt": adapting + KEPT_BYTES} if _adapts(config, size) else {}),
        "fuse": POINT_BYTES * size.points * max(1, size.path_images), "fit without diffusion": kept["fit without diffusion"] + KEPT_BYTES,
        "synthesize": model + KEPT_BYTES + trained, "fit with diffusion": kept["fit with diffusion"] + later,
        "render without diffusion": scene + later, "render with diffusion": scene + later,
        **dict.fromkeys(("score", "viewer", "report"), scene + later - KEPT_BYTES / 2),
    }  # fmt: skip
    return {name: round(PROGRAM_BYTES + value) for name, value in steps.items()}


def _written(config: RunConfig, size: SceneSize) -> dict[str, int]:
    """Bytes of the results per step."""
    gaussians, pixels = _gaussians(config, size), size.pixels
    made, rendered = _views(config, size)
    fit = FIT_FILE + gaussians * (GAUSSIAN_FILE + 4 * 3 * ((config.fit.sh_degree + 1) ** 2 - 1))
    render = VIEW_FILE * rendered * pixels
    scored = rendered if size.exact else size.path_images
    score = (SCORE_FILE if size.exact else LOG_SCORE_FILE) * scored * pixels
    panel = pixels * min(1.0, PANEL_PX / size.width) ** 2
    report = min(REPORT_LARGEST, REPORT_FILE * rendered * panel) + REPORT_ADAPTED_FILE * _adapts(config, size)
    steps = {
        **({} if size.labelled else {"annotate": LABEL_FILE * size.images * pixels + SWEEP_FILE * size.points * size.path_images}),
        **({"adapt": ADAPTED_FILE} if _adapts(config, size) else {}),
        "fuse": 250_000 + COLORED_POINT_FILE * size.seen * size.points * size.images, "fit without diffusion": fit,
        "synthesize": LINE_FILE * len(config.synthesize.shifts_m) + VIEW_FILE * made * pixels, "fit with diffusion": fit,
        "render without diffusion": render, "render with diffusion": render, "score": score,
        "viewer": VIEWER_GAUSSIAN_FILE * gaussians, "report": report,
    }  # fmt: skip
    return {name: round(value) for name, value in steps.items()}


def _published(config: RunConfig) -> bool:
    return config.synthesize.guidance is not None


def _processes(config: RunConfig, machine: Machine) -> int:
    """Processes that make views: one per trajectory at most, one of a published-type model."""
    usual = 1 if _published(config) else machine.processors or machine.cores
    return max(1, min(config.synthesize.processes or usual, len(config.synthesize.shifts_m)))


def _views(config: RunConfig, size: SceneSize) -> tuple[int, int]:
    """Views that the diffusion model makes, and that each fit renders."""
    return size.path_images * len(config.synthesize.shifts_m), size.path_images * len(config.render.shifts_m)


def _scored(config: RunConfig, size: SceneSize) -> int:
    """Views of all methods that are compared with a truth; without exact truth, those of the recorded path."""
    made, rendered = _views(config, size)
    return 2 * rendered + made if size.exact else 2 * size.path_images


def _columns(config: RunConfig) -> int:
    return 11 + 3 * (config.fit.sh_degree + 1) ** 2 + len(CLASSES) * config.fit.semantics


def _gaussians(config: RunConfig, size: SceneSize) -> int:
    recorded = size.images * size.pixels
    measured = START_POINTS * size.points * size.path_images**NEW_POINTS or math.inf
    start = min(config.fit.start.gaussians, START_GAUSSIANS * recorded, measured)
    grown = start * (1 + (GROWN - 1) * min(1.0, config.fit.iterations / GROWTH_STEPS))
    long = recorded / PIXELS_PER_GAUSSIAN if config.fit.iterations > LONG_FIT else 0
    return min(config.fit.densify.max_gaussians, round(max(grown, long)))


def _fit_pixels(config: RunConfig, size: SceneSize) -> int:
    shrink = min(1.0, config.fit.width_px / size.width) if config.fit.width_px else 1.0
    return round(size.pixels * shrink * shrink)


def of_presets(size: SceneSize, machine: Machine, device: str = "cpu") -> dict[PresetName, Estimate]:
    """The forecast of every preset."""
    return {name: estimate(run_preset(name), size, machine, device) for name in PRESETS}


def in_words(
    found: Mapping[PresetName, Estimate], free_bytes: int, device: str = "cpu", free_disk_bytes: int = 0
) -> list[str]:
    """A line per preset: time, memory, disk; then which presets fit into what is free (0: unknown), and a table of the steps."""
    lines = [f"forecasts for mudg run on this scene ({device}):"]
    for name, one in found.items():
        unknown = [step for step, value in one.seconds.items() if value is None]
        known_s = sum(value for value in one.seconds.values() if value is not None)
        time = f"about {_duration(known_s)}" if known_s else "time not measured"
        if known_s and unknown:
            time = f"{time} and {', '.join(unknown)} (not measured)"
        fits = "" if not free_bytes else "fits" if one.memory_bytes <= free_bytes else "does NOT fit"
        free = f", {fits} into the {free_bytes / 1e9:.1f} GB that are free" if fits else ""
        disk = " (NOT free here)" if free_disk_bytes and one.written_bytes > free_disk_bytes else ""
        lines.append(f"  --preset {name:<8} {time}; about {one.memory_bytes / 1e9:.1f} GB{free}; {_size(one.written_bytes)} on disk{disk}")
    if free_bytes:
        able = [name for name, one in found.items() if fits_machine(one, free_bytes, free_disk_bytes)]
        lines.append(f"  memory and disk of this machine suffice for: {', '.join(able) or 'none (smaller images, fewer frames)'}")
    lines.append(f"  {'per step: time, memory, disk':<30}" + "".join(f"{name:>26}" for name in found))
    longest = max((one.steps for one in found.values()), key=len)
    for step in longest:
        cells = [_cell(one.steps.get(step)) for one in found.values()]
        lines.append(f"    {step:<28}" + "".join(f"{cell:>26}" for cell in cells))
    return lines


def in_a_line(idle: Estimate, now: Estimate) -> str:
    """What a run is about to take, on this machine undisturbed and as busy as it is now."""
    times = {name: seconds for name, seconds in idle.seconds.items() if seconds is not None}
    unknown = [name for name, seconds in idle.seconds.items() if seconds is None]
    if not times:
        return "forecast: time not measured on this device"
    total_s, now_s = sum(times.values()), sum(seconds or 0.0 for seconds in now.seconds.values())
    longest = sorted(times, key=lambda name: -times[name])[:3]
    busy = f", about {_duration(now_s)} if it stays as busy as it is now" if now_s > FACTOR * total_s else ""
    more = f" and {', '.join(unknown)} (not measured)" if unknown else ""
    parts = ", ".join(f"{name} {_duration(times[name])}" for name in longest)
    return (
        f"forecast: about {_duration(total_s)}{more} on this machine{busy} ({parts}); "
        f"{idle.memory_bytes / 1e9:.1f} GB of memory, {_size(idle.written_bytes)} on disk"
    )


def _cell(cost: StepCost | None) -> str:
    """A step in the table; a preset may leave one out."""
    if cost is None:
        return "not taken"
    time = "-" if cost.seconds is None else _duration(cost.seconds)
    return f"{time}, {cost.memory_bytes / 1e9:.1f} GB, {_size(cost.written_bytes)}"


def fits_machine(one: Estimate, free_bytes: int, free_disk_bytes: int) -> bool:
    """Whether memory and disk that are free suffice; 0 = not known, and then not asked."""
    memory = not free_bytes or one.memory_bytes <= free_bytes
    return memory and (not free_disk_bytes or one.written_bytes <= free_disk_bytes)


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
