"""Settings of ``mudg bench``."""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BenchConfig:
    """Measure on generated cities, against exact truth: the diffusion model on ones it never saw, or scenes, also off the path."""

    model: str = "embedded"
    """"embedded" or "embedded-tiny", shipped with the package, or the folder of a model made by learn."""
    cities: Literal["reported", "development"] = "reported"
    """reported: the list on which nothing is chosen. development: the list to look at while choosing."""
    count: int = Field(default=6, ge=1, le=6)
    """How many cities of the list; four clips each (2, 3, 4 m and the recorded path)."""
    steps: tuple[int, ...] = (1, 2, 8)
    """Denoising steps to compare."""
    sampler: Literal["ddim", "dpm_solver"] = "ddim"
    """How the denoising steps are taken."""
    eta: float | None = Field(default=None, ge=0, le=1)
    """ddim: noise added between steps, 0 = deterministic, 1 = as much as the reverse process has (not given: 1)."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """auto: bfloat16 on CPUs with AMX, float32 elsewhere."""
    threads: int = Field(default=1, ge=1)
    """mdm, poses: threads of torch."""
    seed: int = 0
    """Fixes every random draw."""
    list: Literal["development", "reported"] = "development"
    """shift: list of logs; nothing is chosen on the reported one."""
    logs: int = Field(default=8, ge=1, le=8)
    """shift: how many logs of the list (the development list has 4)."""
    methods: tuple[str, ...] = ("nearest_fill", "gs3d", "street_gaussians", "mudg_r", "mudg_s")
    """shift: methods to compare, of these five."""
    iterations: int = Field(default=1000, ge=1)
    """shift: steps of every fit."""
    ablation: bool = False
    """shift: also mudg_s with only some of its virtual terms: colour; colour and depth; colour and classes."""
    variant: tuple[str, ...] = ()
    """shift: also mudg_s with other settings of fit, each NAME=FIELD:VALUE,FIELD:VALUE (virtual.start is a field)."""
    processes: int = Field(default=0, ge=0)
    """shift: logs worked on at the same time, one thread each (0 = one per core)."""
    videos: bool = True
    """shift: also make the videos of the page."""
    pose_iterations: int = Field(default=300, ge=1)
    """poses: steps of each fit."""
