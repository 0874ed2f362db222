"""Settings of ``mudg batch``: how workers share out a list."""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class BatchConfig:
    """How the steps of many scenes are shared out."""

    stages: tuple[str, ...] = ("run",)
    """Steps of every scene, in order: run (the whole chain), or some of ingest, annotate, fuse, fit, synthesize, render, score."""
    command: tuple[str, ...] = ()
    """A program of your own as the last step, e.g. --command ./label.sh {ingest} {out}. {source}, {out}, {name} and the names of
    other steps are replaced. With it, --stages may be left out."""
    engine: Literal["local", "env", "slurm", "ray"] = "local"
    """Where workers run. local: on this machine. env: on this machine, as one of many tasks that a scheduler numbers by
    SLURM_ARRAY_TASK_ID, JOB_COMPLETION_INDEX, SKYPILOT_NODE_RANK or AWS_BATCH_JOB_ARRAY_INDEX. slurm: submit an array job. ray: on
    a Ray cluster."""
    shards: int = Field(default=1, ge=1, le=100_000)
    """Number of parts of the list: tasks of an array job, of a Ray cluster or of another scheduler. A worker that has finished its
    part goes on with the others'."""
    jobs: int = Field(default=0, ge=0)
    """Scenes processed at the same time by one task (0 = local: one per processor; else one)."""
    lease_s: float = Field(default=600.0, gt=0)
    """A worker that gives no sign of life for so many seconds loses its scene to another."""
    grace_s: float = Field(default=100.0, ge=0)
    """Seconds that a step has to write its checkpoint when it is asked to stop."""
    patience_s: float = Field(default=600.0, ge=0)
    """Seconds that a worker with nothing to do waits for scenes that others hold."""
    steal: bool = True
    """Take on scenes of other shards when the own one is done."""
    max_failures: str = ""
    """Stop when more steps than this have failed: a number, or a share such as 5% (empty = never)."""
    bounds: tuple[str, ...] = ()
    """Bounds on results, as mudg_s.psnr@0>=20 (method, score, metres beside the path) or fuse.json:points_static>=1000. A scene
    outside them is rejected, with its number."""
    verify_share: float = Field(default=0.0, ge=0, le=1)
    """Share of the results that are made a second time and must have the same bytes."""
    slurm_options: tuple[str, ...] = ()
    """Further options of sbatch, without the dashes, as partition=gpu gres=gpu:1 time=4:00:00."""
    slurm_at_once: int = Field(default=0, ge=0)
    """Most tasks of the array job that run at the same time (0 = all)."""
    ray_address: str = ""
    """Address of the Ray cluster (empty = as Ray finds it, or one on this machine)."""
    ray_gpus: float = Field(default=0.0, ge=0)
    """GPUs of each Ray task."""
    scratch_gb: float = Field(default=20.0, ge=0)
    """Gigabytes of inputs from a store that stay in --scratch for later steps, beside those in use."""
    scenes: tuple[str, ...] = ()
    """accept, reject: names of scenes that wait for review; '*' stands for any letters."""
    price: float = Field(default=0.0, ge=0)
    """cost: price of one core-hour."""
    storage_price: float = Field(default=0.0, ge=0)
    """cost: price of one gigabyte of results for a month."""
