"""What the chain takes on a scene: seconds and memory of a configuration, estimated from a few measured constants.

The constants were measured on a machine of 2 virtual cores with AVX-512 and AMX (bench/README.md, docs/results.md, docs/diffusion.md);
other processors differ. Nothing was measured on a CUDA card: there the memory is counted and the time is unknown. So is the time of a
published-type model, on any device. Labelling and adapting are not counted. An estimate is meant to be right within a factor of three.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from mudg.base.palette import CLASSES
from mudg.stages.config.presets import PRESETS, PresetName, run_preset

if TYPE_CHECKING:
    from mudg.stages.config.run import RunConfig

GAUSSIAN_STEP_S: Final = 0.39e-6
PIXEL_STEP_S: Final = 0.36e-6
"""A step of a fit on one core, per Gaussian and per pixel: 82.4 ms at 75,000 and 480x320 (bench/fit.py --threads 1), split by the slopes
of the rasteriser between 50,000 and 200,000 Gaussians and between 480x320 and 960x640 (bench/raster.py)."""
SHARED: Final = 0.79
"""Share of a step that is divided among the cores: 101 ms on one core became 61 on two (bench/fit.py)."""
CLIP_STEP_S: Final = 0.0225
CLIP_S: Final = 0.2
FULL_VIEW_S: Final = 8.3e-6
"""The small diffusion model with renders, per view on one core: a denoising step (bench/mdm.py, bfloat16), all else at its own size,
and per pixel of the camera: 72 views of 240x160 took 39 s of processor time (`mudg demo --fast`)."""
RENDER_S: Final = 1.6e-6
SCORE_S: Final = 1.2e-6
REPORT_S: Final = 0.42e-6
"""Core-seconds per pixel of a view: 168 views in 16 s; 480 in 34 s; the same 480 in 12 s, on two cores (docs/results.md)."""
FUSE_S: Final = 0.055
"""Core-seconds per recorded image: 72 in 2 s on two cores (docs/results.md)."""
START_S: Final = 2.0
"""Any step, before it computes."""

PIXELS_PER_GAUSSIAN: Final = 3
"""No more Gaussians than one per so many recorded pixels are counted: 12 images of 240x160 led to 120,000, the limit there
(`mudg demo --fast`)."""
PROGRAM_BYTES: Final = 600_000_000
"""Python, torch and the native library: resident after import and a first step."""
COPIES: Final = 4.85
"""Numbers held per parameter: itself, two moments of Adam, and 1.85 for gradient and rasteriser (bench/README.md)."""
RECORDED_BYTES: Final = 7
VIRTUAL_BYTES: Final = 10
"""Per pixel of a view that a fit keeps: colour, classes, masks, LiDAR; virtual ones have depth and confidence, too."""
VIEWS_BYTES: Final = 2**30
"""No more of them are held in memory: the others lie in a file (stages/fitting/kept.py)."""
STEP_PIXEL_BYTES: Final = 600
"""Per pixel of the view of a step: images, gradients and what losses keep."""
MODEL_BYTES: Final = 1_000_000_000
"""The small diffusion model while it samples, per process (docs/diffusion.md)."""
PUBLISHED_BYTES: Final = {"cpu": 19_000_000_000, "cuda": 9_000_000_000}
"""The published one at 576x1024: on the CPU in float32 with all work at once, on CUDA in bfloat16 with the work cut to 10 GB (counted, not
measured: docs/published.md)."""


@dataclass(frozen=True)
class SceneSize:
    """What an estimate depends on: images that are fitted, images of the camera that is shifted, and their size in pixels."""

    images: int
    path_images: int
    width: int
    height: int

    @property
    def pixels(self) -> int:
        """Pixels of an image."""
        return self.width * self.height


@dataclass(frozen=True)
class Estimate:
    """Seconds per step of the chain (None: not measured) and bytes at the worst moment, of the processor's or the card's memory."""

    seconds: Mapping[str, float | None]
    memory_bytes: int

    @property
    def total_s(self) -> float | None:
        """Seconds of all steps, None if one is unknown."""
        known = [value for value in self.seconds.values() if value is not None]
        return sum(known) if len(known) == len(self.seconds) else None


def estimate(config: RunConfig, size: SceneSize, cores: int, device: str = "cpu") -> Estimate:
    """Time and memory of ``mudg run SCENE`` with a configuration.

    Args:
        cores: that the steps may use. device: ``cpu`` or ``cuda``.
    """
    if device != "cpu":
        return Estimate({"all steps": None}, _memory(config, size, 1, "cuda"))
    per_core = 1 - SHARED + SHARED / cores
    fit, virtual = config.fit, config.fit.virtual
    classes = (1 + 1 / (3 * fit.loss.semantic_every)) / (1 + 1 / 9)
    step_s = GAUSSIAN_STEP_S * _gaussians(config, size) + PIXEL_STEP_S * _fit_pixels(config, size) * classes
    further = 0.5 * fit.iterations if config.continue_fit else fit.iterations
    share = virtual.continued_probability if config.continue_fit else virtual.probability
    lines = len(config.synthesize.shifts_m)
    made, rendered = size.path_images * lines, size.path_images * len(config.render.shifts_m)
    per_view = CLIP_STEP_S * config.synthesize.steps + CLIP_S + FULL_VIEW_S * size.pixels
    seconds: dict[str, float | None] = {
        "fuse": FUSE_S * size.images * per_core,
        "fit without diffusion": fit.iterations * step_s * per_core,
        "synthesize": None if _published(config) else made * config.synthesize.samples * per_view / cores,
        "fit with diffusion": further * step_s * (1 + share * virtual.beside) * per_core,
        "render": 2 * rendered * RENDER_S * size.pixels * per_core,
        "score": (2 * rendered + made) * SCORE_S * size.pixels * per_core,
        "report": (2 * rendered + made) * REPORT_S * size.pixels * per_core,
    }
    memory = _memory(config, size, cores, "cpu")
    return Estimate({name: None if s is None else s + START_S for name, s in seconds.items()}, memory)


def _published(config: RunConfig) -> bool:
    return config.synthesize.guidance is not None


def _gaussians(config: RunConfig, size: SceneSize) -> int:
    return min(config.fit.densify.max_gaussians, size.images * size.pixels // PIXELS_PER_GAUSSIAN)


def _fit_pixels(config: RunConfig, size: SceneSize) -> int:
    shrink = min(1.0, config.fit.width_px / size.width) if config.fit.width_px else 1.0
    return round(size.pixels * shrink * shrink)


def _memory(config: RunConfig, size: SceneSize, processes: int, device: str) -> int:
    columns = 11 + 3 * (config.fit.sh_degree + 1) ** 2 + len(CLASSES) * config.fit.semantics
    virtual = size.path_images * len(config.synthesize.shifts_m)
    fit_pixels = _fit_pixels(config, size)
    views = min((RECORDED_BYTES * size.images + VIRTUAL_BYTES * virtual) * fit_pixels, VIEWS_BYTES) if device == "cpu" else 0
    fitting = 4 * COPIES * columns * _gaussians(config, size) + views + STEP_PIXEL_BYTES * fit_pixels
    model = PUBLISHED_BYTES[device] if _published(config) else MODEL_BYTES * processes
    return round(PROGRAM_BYTES + max(fitting, model))


def of_presets(size: SceneSize, cores: int, device: str = "cpu") -> dict[PresetName, Estimate]:
    """The estimate of every preset."""
    return {name: estimate(run_preset(name), size, cores, device) for name in PRESETS}


def in_words(found: Mapping[PresetName, Estimate], free_bytes: int, device: str = "cpu") -> list[str]:
    """A line per preset: time, memory, and whether that fits into what is free (0: unknown)."""
    lines = [
        f"estimates for mudg run on this scene ({device}; right within a factor of three, without annotate and adapt)"
    ]
    for name, one in found.items():
        unknown = [step for step, value in one.seconds.items() if value is None]
        known_s = sum(value for value in one.seconds.values() if value is not None)
        time = f"about {_duration(known_s)}" if known_s else "time not measured"
        if known_s and unknown:
            time = f"{time} and {', '.join(unknown)} (not measured)"
        fits = "" if not free_bytes else "fits" if one.memory_bytes <= free_bytes else "does NOT fit"
        free = f", {fits} into the {free_bytes / 1e9:.1f} GB that are free" if fits else ""
        lines.append(f"  --preset {name:<8} {time}; about {one.memory_bytes / 1e9:.1f} GB{free}")
    return lines


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
