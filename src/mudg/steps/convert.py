"""``mudg convert``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mudg.steps.step import Flag, Step

if TYPE_CHECKING:
    from mudg.diffusion.settings.convert import ConvertConfig


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
    """Checkpoint file of MuDG, DynamiCrafter-512 or DynamiCrafter-1024 (.ckpt, .pt or .safetensors); or, for DepthLab, the folder
    that contains DepthLab's files, Marigold's folder and the image encoder's folder; or, with --network, weights of a
    network of the scores."""
    to: Annotated[Path, Flag()]
    """Model folder to write."""
    overwrite: bool = False
    """Replace the model that --to already holds. The old model stays until the new one is finished, so the disk must hold both.
    Files that do not belong to the model are kept."""
    settings: ConvertConfig

    def act(self) -> Path:
        from mudg.steps import conversion

        return conversion.run(self.settings, self.checkpoint, self.to, overwrite=self.overwrite)
