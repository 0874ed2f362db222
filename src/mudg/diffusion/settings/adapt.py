"""Settings of ``mudg adapt``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from mudg.base.config import setting, settings
from mudg.base.devices import DeviceName


@settings
class AdaptConfig:
    """Adapt the diffusion model to a recorded log: train it for a few steps on the log's own photographs, seen from
    where other photographs of the log were taken or might have been taken."""

    RETIRED: ClassVar[Mapping[str, tuple[str, Any]]] = {
        "cameras_left_out": ("block", []),
        "augment": ("precision", True),
        "label_confidence": ("precision", 0.5),
    }

    model: str = "embedded"
    """Diffusion model to start from: "embedded", shipped with the package, or a model folder written by learn. It must
    use renders."""
    cameras: tuple[str, ...] = ("front",)
    """Cameras whose photographs are learned (empty = the first camera)."""
    shifts_m: tuple[float, ...] = (2.5, -2.5)
    """Lateral shifts in metres of the made-up drives beside the recorded path, from which the model learns to generate
    the photographs."""
    gaps: bool = True
    """Also learn to generate photographs from those of other times: half of the log is left out of a fit, then the
    other half."""
    block: int = setting(default=4, ge=1)
    """Frames per training clip, and consecutive frames left out together."""
    held_out_every: int = setting(default=4, ge=2)
    """Every n-th block of frames is kept for comparing the adapted model with the one it started from."""
    fit_iterations: int = setting(default=150, ge=1)
    """Optimisation steps of each of the fits that the clips are made with."""
    steps: int = setting(default=40, ge=1)
    """Training steps."""
    batch_frames: int = setting(default=16, ge=1)
    """Frames per training step."""
    lr: float = setting(default=1e-4, gt=0)
    """Largest learning rate."""
    trained: Literal["all", "refiner"] = "all"
    """Parts that are trained. refiner: refiner and finisher only."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Number format of the diffusion model. auto: bfloat16 on CUDA devices and CPUs that compute in it, float32
    elsewhere."""
    device: DeviceName = "auto"
    """Device of the diffusion model: auto (CUDA if there is one), cpu, cuda, cuda:N, mps."""
    processes: int = setting(default=0, ge=0)
    """Number of fits made at the same time, with one thread each (0 = one per core; at most four where the diffusion
    model is not on the CPU). The result does not depend on it."""
    threads: int = setting(default=0, ge=0)
    """Threads of the training (0 = one per core). Results are repeatable for the same number of threads."""
    seed: int = 0
    """Seed of all random numbers; the same seed gives the same result."""
