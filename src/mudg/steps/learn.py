"""``mudg learn``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from mudg.steps.outputs import Output

if TYPE_CHECKING:
    from mudg.stages.config import LearnConfig


class Learn(Output):
    """Train a diffusion model on generated cities, or fine-tune one on your own logs."""

    section = "single steps, in the order of use"
    examples = (
        "mudg learn --out runs/mdm", "mudg learn --config recipe.yaml --out runs/mdm",
        "mudg learn --data.scenes runs/kitti --start embedded --optimizer.lr 1e-4 --steps 500 --out runs/tuned",
        "torchrun --nproc-per-node 8 -m mudg learn --compute.parallel fsdp --config recipe.yaml --out runs/mdm",
    )  # fmt: skip
    smaller = "smaller clips (--data.width, --data.height), a smaller batch, fewer --compute.workers"
    result = "model"
    short = (
        "start", "steps", "seed", "precision", "data.scenes", "data.clips", "data.cities", "data.width", "data.height",
        "data.window", "optimizer.lr", "optimizer.batch_frames", "compute.device", "compute.workers",
    )  # fmt: skip
    settings: LearnConfig

    def run(self) -> Path:
        from mudg.stages import learn

        return learn.run(self.settings, self.out, overwrite=self.overwrite)
