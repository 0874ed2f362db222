"""Settings of ``mudg bench``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BenchConfig:
    """Measure on generated cities against exact ground truth: the diffusion model, the correction of box tracks, or complete
    methods off the recorded path."""

    MOVED: ClassVar[Mapping[str, str | None]] = {"ablation_steps": None, "ablation_cities": None}

    model: str = "embedded"
    """Diffusion model: "embedded" or "embedded-tiny", both shipped with the package, or a model folder written by learn."""
    cities: Literal["reported", "development"] = "reported"
    """mdm: list of cities. Choose settings on development; report results on reported, on which nothing was chosen."""
    count: int = Field(default=6, ge=1, le=6)
    """mdm: number of cities taken from the list, 1 to 6. Each gives four clips: shifted by 2, 3 and 4 m, and on the recorded
    path."""
    steps: tuple[int, ...] = (1, 2, 8)
    """mdm: numbers of denoising steps to compare; each is measured on its own."""
    sampler: Literal["ddim", "dpm_solver"] = "ddim"
    """mdm: sampler of the diffusion model. ddim: first order, with fresh noise between steps. dpm_solver: second order and
    deterministic, for many steps. Both cost one network pass per step."""
    eta: float | None = Field(default=None, ge=0, le=1)
    """mdm: sampler ddim: noise added between steps, from 0 (deterministic) to 1 (as much as the reverse process has) (not given:
    1)."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Number format of the diffusion model. auto: bfloat16 on CPUs with AMX, float32 elsewhere."""
    threads: int = Field(default=1, ge=1)
    """mdm, poses: number of torch threads."""
    seed: int = 0
    """Seed of all random numbers; the same seed gives the same result."""
    list: Literal["development", "reported"] = "development"
    """shift: list of logs. Choose settings on development; report results on reported, on which nothing was chosen."""
    logs: int = Field(default=8, ge=1, le=8)
    """shift: number of logs taken from the list, 1 to 8 (the development list has 4)."""
    methods: tuple[str, ...] = ("nearest_fill", "gs3d", "street_gaussians", "mudg_r", "mudg_s")
    """shift: methods to compare, out of the five of the default."""
    iterations: int = Field(default=1000, ge=1)
    """shift: optimisation steps of every fit."""
    ablation: bool = False
    """shift: add rows for mudg_s with only some virtual loss terms (colour; colour and depth; colour and classes), and with exact
    views instead of generated ones."""
    variant: tuple[str, ...] = ()
    """shift: add rows for mudg_s with other settings of fit, each as NAME=FIELD:VALUE,FIELD:VALUE, where FIELD is a setting such
    as virtual.start."""
    processes: int = Field(default=0, ge=0)
    """shift: number of logs processed at the same time, with one thread each (0 = one per core). Results do not depend on it."""
    videos: bool = True
    """shift: also write videos of all methods side by side."""
    pose_iterations: int = Field(default=300, ge=1)
    """poses: optimisation steps of every fit."""
