"""Settings of ``mudg convert``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from mudg.base.config import setting, settings


@settings
class ConvertConfig:
    """Convert a published checkpoint to a model folder."""

    RETIRED: ClassVar[Mapping[str, tuple[str, Any]]] = {"shard_mb": ("memory_gb", 1024)}

    network: Literal["diffusion", "inception", "i3d", "dinov2", "clip", "lpips", "lpips-vgg", "lpips-squeeze"] = (
        "diffusion"
    )
    """What the checkpoint holds: a diffusion model, or a network of the scores (docs/scores.md). The other settings
    apply to diffusion models only."""
    resolution: Literal["auto", "320x512", "576x1024"] = "auto"
    """Image height x width that the checkpoint was trained at. auto: from 512 or 1024 in the file's name."""
    dtype: Literal["keep", "float32", "float16", "bfloat16"] = "keep"
    """Number format of the written weights. keep: as in the checkpoint. bfloat16 halves the size of float32 weights."""
    towers: str = ""
    """OpenCLIP ViT-H/14 weights, for a checkpoint that lacks them (empty = the checkpoint has its own)."""
    memory_gb: float = setting(default=0.0, ge=0)
    """Limit, in GB, of the address space of the process that reads the checkpoint, beyond the program's own (0 =
    derived from the file's size). Raise it if the conversion runs out of memory."""
