"""Settings of ``mudg batch``: what runs, and where."""

from __future__ import annotations

from typing import Literal

from mudg.base.config import setting, settings


@settings
class BatchConfig:
    """What runs for every scene of a list, and where."""

    stages: tuple[str, ...] = ("run",)
    """Steps of every scene, in order: run (the whole chain), or some of ingest, annotate, fuse, fit, synthesize,
    render, score."""
    command: tuple[str, ...] = ()
    """A program of your own as the last step, e.g. --command ./label.sh {ingest} {out}. {source}, {out}, {name} and the
    names of other steps are replaced. With it, --stages may be left out."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where scenes run. local: on this machine. ray: as tasks of a Ray cluster. slurm: as tasks of an array job."""
    jobs: int = setting(default=0, ge=0)
    """local: scenes at the same time (0 = one per processor). slurm: tasks of the array job (0 = one)."""
    cpus: float = setting(default=1.0, gt=0)
    """ray, slurm: processors, and threads, of a scene."""
    gpus: float = setting(default=0.0, ge=0)
    """ray, slurm: GPUs of a scene."""
    memory_gb: float = setting(default=0.0, ge=0)
    """ray, slurm: gigabytes of memory of a scene (0 = not requested)."""
    ray_address: str = ""
    """Address of the Ray cluster (empty = as Ray finds it, or one on this machine)."""
    slurm_options: tuple[str, ...] = ()
    """Further options of sbatch, without the dashes, as time=4:00:00 partition=gpu. Slurm needs the time."""
    grace_s: float = setting(default=100.0, ge=0)
    """Seconds that a step has to write its checkpoint when it is asked to stop."""
