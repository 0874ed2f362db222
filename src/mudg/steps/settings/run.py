"""Settings of ``mudg run`` and ``mudg demo``: those of every verb (their presets: ``presets.py``)."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any, Literal

from mudg.base.config import setting, settings
from mudg.base.devices import DeviceName
from mudg.diffusion.settings.adapt import AdaptConfig
from mudg.diffusion.settings.synthesize import SynthesizeConfig
from mudg.editing.settings import RenderConfig, ScoreConfig
from mudg.formats.settings import IngestConfig
from mudg.gaussians.settings import FitConfig
from mudg.labels.settings import AnnotateConfig
from mudg.scene.settings import FuseConfig


@settings
class RunConfig:
    """Settings of all steps, in one group per step."""

    adaptation: Literal["auto", "on", "off"] = "auto"
    """Adapt the diffusion model to the log before it generates views. auto: for recorded logs that are long enough, not
    for generated cities."""
    device: DeviceName = "auto"
    """Device of all steps: auto (CUDA if there is one), cpu, cuda, cuda:N. A step whose own device is set, as by
    --fit.device, keeps that one."""
    continue_fit: bool = True
    """Make the fit with virtual views from the one without, with half as many steps. Off: from nothing with all steps,
    as published."""
    ingest: IngestConfig = setting(default_factory=IngestConfig)
    annotate: AnnotateConfig = setting(default_factory=AnnotateConfig)
    fuse: FuseConfig = setting(default_factory=FuseConfig)
    adapt: AdaptConfig = setting(default_factory=AdaptConfig)
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
    """The same settings with these cameras (empty = the first) and lateral shifts in synthesize and render.

    Render always adds the recorded path, synthesize leaves it out.
    """
    if cameras is None and shifts_m is None:
        return config
    synthesize, render = config.synthesize, config.render
    if cameras is not None:
        synthesize, render = replace(synthesize, cameras=cameras), replace(render, cameras=cameras)
    if shifts_m is not None:
        moved = tuple(shift for shift in dict.fromkeys(shifts_m) if shift != 0)
        synthesize, render = replace(synthesize, shifts_m=moved), replace(render, shifts_m=(0.0, *moved))
    return replace(config, synthesize=synthesize, render=render)
