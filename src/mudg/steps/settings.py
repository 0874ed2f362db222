"""Settings of ``mudg run`` and ``mudg demo``, those of every verb, and their presets, which benchmarks take too: rows
of plain values over the defaults of every verb.

Precedence: defaults < preset < ``--config`` < flags. Every preset is a configuration of the same code and runs on a CPU
too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, Final, Literal, get_args

from mudg.base.config import changed, nested, setting, settings
from mudg.base.devices import DeviceName
from mudg.base.errors import UsageError
from mudg.diffusion.settings import SynthesizeConfig
from mudg.editing.settings import RenderConfig, ScoreConfig
from mudg.formats.settings import IngestConfig
from mudg.gaussians.settings import FitConfig
from mudg.labels.settings import AnnotateConfig
from mudg.scene.settings import FuseConfig


@settings
class RunConfig:
    """Settings of all steps, in one group per step."""

    device: DeviceName = "auto"
    """Device of all steps: auto (CUDA if there is one), cpu, cuda, cuda:N. A step whose own device is set, as by
    --fit.device, keeps that one."""
    guided_share: float = setting(default=1.5, gt=0)
    """Iterations of the fit with virtual views, as a multiple of those of the fit without. Both begin from nothing."""
    ingest: IngestConfig = setting(default_factory=IngestConfig)
    annotate: AnnotateConfig = setting(default_factory=AnnotateConfig)
    fuse: FuseConfig = setting(default_factory=FuseConfig)
    synthesize: SynthesizeConfig = setting(default_factory=SynthesizeConfig)
    fit: FitConfig = setting(default_factory=FitConfig)
    render: RenderConfig = setting(default_factory=RenderConfig)
    score: ScoreConfig = setting(default_factory=ScoreConfig)


def with_seed(config: RunConfig, seed: int) -> RunConfig:
    """The same settings with ``seed`` in every verb that draws random numbers."""
    parts: dict[str, Any] = {f.name: part for f in fields(config) if is_dataclass(part := getattr(config, f.name))}
    seeded = {n: replace(p, seed=seed) for n, p in parts.items() if any(f.name == "seed" for f in fields(p))}
    seeded["ingest"] = replace(config.ingest, city=replace(config.ingest.city, seed=seed))
    return replace(config, **seeded)


def with_device(config: RunConfig) -> RunConfig:
    """The same settings with the run's device in every step that leaves its own at auto."""
    return replace(config, **{f.name: on_device(getattr(config, f.name), config.device) for f in fields(config)})


def on_device(settings: Any, device: str) -> Any:
    """The settings of a step on a device, unless they name one themselves or the step has none."""
    return replace(settings, device=device) if getattr(settings, "device", "") == "auto" else settings


def with_lines(
    config: RunConfig, *, cameras: tuple[str, ...] | None = None, shifts_m: tuple[float, ...] | None = None
) -> RunConfig:
    """The same settings with these cameras (empty = the first) and lateral shifts in synthesize and render, which
    always adds the recorded path."""
    if cameras is None and shifts_m is None:
        return config
    synthesize, render = config.synthesize, config.render
    if cameras is not None:
        synthesize, render = replace(synthesize, cameras=cameras), replace(render, cameras=cameras)
    if shifts_m is not None:
        moved = tuple(shift for shift in dict.fromkeys(shifts_m) if shift != 0)
        synthesize, render = replace(synthesize, shifts_m=moved), replace(render, shifts_m=(0.0, *moved))
    return replace(config, synthesize=synthesize, render=render)


PresetName = Literal["fast", "default", "quality", "paper"]

DEMO_CITY = 3
"""Seed of the city that `mudg demo` shows: a crossing by day, much traffic, a cyclist, a car that turns."""
NO_MODEL: Final = "published"
"""Stands where a published-type model's folder must be given."""

Value = bool | int | float | str | tuple[str, ...] | tuple[float, ...]


def _of(group: str, **values: Value) -> dict[str, Value]:
    """Settings of a group by their dotted names."""
    return {f"{group}.{name}": value for name, value in values.items()}


PRESETS: Final[Mapping[PresetName, Mapping[str, Value]]] = {
    "fast": {
        **_of("ingest.city", n_frames=12, width=240, height=160, cameras=("front",)),
        **_of("ingest", resolution="480"),
        **_of("fit", iterations=250),
        **_of("synthesize", steps=1, shifts_m=(3.0, -3.0)),
        **_of("render", shifts_m=(0.0, 3.0, -3.0)),
    },
    "default": {
        **_of("ingest.city", n_frames=24, width=384, height=256),
        **_of("fit", iterations=1000),
        **_of("synthesize", steps=2),
    },
    "quality": {
        **_of("ingest.city", n_frames=60, width=960, height=640),
        **_of("fit", iterations=30_000, checkpoint_every=2500, preview_every=2500),
        **_of("fit.start", gaussians=1_000_000, voxel_m=0.08),
        **_of("fit.densify", max_gaussians=3_000_000),
        **_of("fit.loss", semantic_every=1),
        **_of("fit.virtual", gaussians=200_000, half_size=0.0),
        **_of("synthesize", steps=2),  # of the shipped model; more lowered its scores (docs/diffusion.md)
    },
    "paper": {
        "guided_share": 1.0,
        **_of("ingest.city", n_frames=60, width=960, height=640),
        **_of("fuse", match_colors=False, occlusion_test=False, box_growth_m=0.0, floor_margin_m=0.25),
        **_of("fuse", moving_distance_m=0.5, min_object_points=100),
        **_of("synthesize", model=NO_MODEL, steps=50, eta=1.0, guidance=7.5, guidance_rescale=0.7),
        **_of("synthesize", overlap=8, align_depth=False, full_size=False),
        **_of("fit", iterations=30_000, checkpoint_every=2500, preview_every=2500, sh_degree=3),
        **_of("fit.start", gaussians=10_000_000, voxel_m=0.15),
        # no such limits are published
        **_of("fit.densify", kind="gradient", max_gaussians=10_000_000, longest_to_middle=1e6),
        **_of("fit.objects", deformable=False),
        **_of("fit.poses", learn=True, start=0.1),
        **_of("fit.loss", ssim_weight=0.2, lidar_weight=0.1, sky_weight=0.05, semantic_weight=0.0, object_weight=0.1),
        **_of("fit.virtual", probability=0.2, beside=False, start=0.1, stop=1.0, gaussians=0, confidence_power=0.0),
        **_of("fit.virtual", color_weight=0.0, perceptual_weight=0.1, perception="lpips", depth_weight=0.1),
        **_of("fit.virtual", lidar_weight=0.0, sky_weight=0.0, semantic_weight=0.1, half_size=0.0),
    },
}
"""Preset -> setting -> value; settings that are not named have their defaults."""


def run_preset(name: PresetName = "default") -> RunConfig:
    """The chain's settings before any file or flag; the first camera of whatever scene it is. UsageError: no such
    preset."""
    if name not in PRESETS:
        raise UsageError("no such preset", where="--preset", expected=", ".join(get_args(PresetName)), got=repr(name))
    own = {"ingest.city.seed": DEMO_CITY, "synthesize.cameras": (), "render.cameras": ()}
    return _with(RunConfig(), nested({**own, **PRESETS[name]}))


def chosen_preset(name: PresetName | None, fast: bool) -> PresetName:
    """The preset that ``--preset`` and ``--fast`` ask for; UsageError where they contradict each other."""
    if fast and name not in (None, "fast"):
        what = "--fast is another name of --preset fast"
        raise UsageError(what, where="--preset", got=str(name), remedy="leave one of them out")
    return "fast" if fast else name or "default"


def _with(config: Any, values: Mapping[str, Any]) -> Any:
    """A configuration with other values, in groups."""
    inner = {name: value for name, value in values.items() if isinstance(value, Mapping)}
    return changed(config, {**values, **{name: _with(getattr(config, name), value) for name, value in inner.items()}})
