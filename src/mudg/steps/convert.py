"""``mudg convert``."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mudg.base.errors import InputError, UsageError
from mudg.steps.step import Flag, Step

if TYPE_CHECKING:
    from mudg.diffusion.settings import ConvertConfig


class Convert(Step):
    """Convert a published checkpoint to a folder for synthesize, annotate or score."""

    section = "published models"
    examples = (
        "mudg convert 1024-mdm-checkpoint.ckpt --to models/mudg_1024",
        "mudg convert model.ckpt --to models/dc_512 --resolution 320x512 --dtype bfloat16",
        "mudg convert checkpoints --to weights/depthlab",
        "mudg convert i3d_torchscript.pt --to weights/i3d --network i3d",
    )
    smaller = "a larger --memory-gb, where the machine has it"
    result = "model"
    checkpoint: Annotated[Path, Flag("CKPT", "first")]
    """Checkpoint file of MuDG, DynamiCrafter-512 or DynamiCrafter-1024 (.ckpt, .pt or .safetensors); or, for DepthLab,
    the folder that contains DepthLab's files, Marigold's folder and the image encoder's folder; or, with --network,
    weights of a network of the scores."""
    to: Annotated[Path, Flag()]
    """Model folder to write."""
    overwrite: bool = False
    """Replace the model that --to already holds. The old model stays until the new one is finished, so the disk must
    hold both. Files that do not belong to the model are kept."""
    settings: ConvertConfig

    def act(self) -> Path:
        from mudg.diffusion import convert

        return convert.run(self.settings, self.checkpoint, self.to, self._conversion, overwrite=self.overwrite)

    def _conversion(self, to: Path) -> tuple[Callable[[], None], int]:
        """What converts this checkpoint to a folder, and the address space that it may take."""
        from mudg.diffusion import convert
        from mudg.labels.depth import depthlab
        from mudg.scoring.converted import convert_weights

        config, source = self.settings, self.checkpoint
        if config.network != "diffusion":
            if config.resolution != "auto" or config.towers or config.dtype != "keep":
                what = "--resolution, --towers and --dtype apply to diffusion models only"
                raise UsageError(what, where=f"--network {config.network}")
            if not source.is_file():
                raise InputError("no such checkpoint", where=str(source))
            # read, and converted to float32
            limit = convert.memory_limit(config, source, source)
            return functools.partial(convert_weights, config.network, source, to), limit
        if not source.is_dir():
            return convert.of_diffusion(config, source, to)
        if config.resolution != "auto" or config.towers:
            what, remedy = "--resolution and --towers do not apply to a DepthLab folder", "give a checkpoint file"
            raise UsageError(what, where=str(source), remedy=f"leave them out, or {remedy}")
        files = depthlab.find(source).files()
        work = functools.partial(depthlab.convert_folder, source, to, convert.DTYPES[config.dtype], convert.SHARD_BYTES)
        return work, convert.memory_limit(config, *files)
