"""Settings of ``mudg convert``."""

from __future__ import annotations

from typing import Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base.config import STRICT


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ConvertConfig:
    """Turn a published checkpoint into a model folder."""

    resolution: Literal["auto", "320x512", "576x1024"] = "auto"
    """Height and width that the checkpoint was trained at (auto = 512 or 1024 in the file's name)."""
    dtype: Literal["keep", "float32", "float16", "bfloat16"] = "keep"
    """Number format of the weights that are written."""
    towers: str = ""
    """OpenCLIP ViT-H/14 weights for a checkpoint that lacks them (empty = the checkpoint has its own)."""
    shard_mb: int = Field(default=1024, ge=1)
    """Weight files are at most about this large."""
    memory_gb: float = Field(default=0.0, ge=0)
    """Address space that reading the checkpoint may take beyond the program's own (0 = from the file's size)."""
