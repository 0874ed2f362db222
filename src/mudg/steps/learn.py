"""``mudg learn``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

from mudg.steps.engine import opened
from mudg.steps.outputs import Output

if TYPE_CHECKING:
    from mudg.diffusion.settings import LearnConfig


class Learn(Output):
    """Train a diffusion model on generated cities, or fine-tune one on your own logs."""

    section = "single steps, in the order of use"
    examples = (
        "mudg learn --out runs/mdm",
        "mudg learn --config recipe.yaml --out runs/mdm",
        "mudg learn --data.scenes runs/kitti --start embedded --optimizer.lr 1e-4 --steps 500 --out runs/tuned",
        "torchrun --nproc-per-node 8 -m mudg learn --compute.parallel fsdp --config recipe.yaml --out runs/mdm",
    )
    smaller = "smaller clips (--data.width, --data.height), a smaller batch, fewer --compute.workers"
    result = "model"
    version, idle = 1, ("compute",)
    files = (
        "clips/*.safetensors",
        "clips/log_clips.json",
        "codec/",
        "steps/",
        "cache/",
        "samples/*.png",
        "tensorboard/",
        "loss.png",
        "metrics.json",
        "model/*",
        "model.part/",
    )
    short = (
        "start",
        "steps",
        "seed",
        "precision",
        "data.scenes",
        "data.clips",
        "data.cities",
        "data.width",
        "data.height",
        "data.window",
        "optimizer.lr",
        "optimizer.batch_frames",
        "compute.device",
        "compute.workers",
    )
    settings: LearnConfig

    def act(self) -> Path:
        from mudg.diffusion import learn

        learn.train(learn.check(self.settings), self.out, self.output(), lambda: opened(self)[1])
        return self.out / "model"

    def checked(self) -> Self:
        from mudg.diffusion import learn

        return replace(self, settings=learn.check(self.settings))

    def reads(self) -> dict[str, Path | str | None]:
        from mudg.diffusion import learn

        return learn.files_read(self.settings, self.out, self.overwrite)

    def inputs(self) -> dict[str, str]:
        from mudg.diffusion import learn

        return learn.inputs_of(self.settings)
