"""Which number format the networks run in, and saying so."""

from __future__ import annotations

from typing import Literal

import torch

from mudg.base import log

Precision = Literal["auto", "float32", "bfloat16"]


def choose_bf16(precision: Precision) -> bool:
    """Whether to run convolutions and matrix products in bfloat16.

    "auto" says yes only on CPUs with tile matrix units (AMX); vector-only bfloat16 was measured slower than float32 at the
    sizes used here. An explicit choice is obeyed. The choice is announced once.
    """
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()
    has_tiles = bool(capabilities.get("amx_bf16", False))
    bf16 = has_tiles if precision == "auto" else precision == "bfloat16"
    reason = (
        f"asked for {precision}" if precision != "auto" else ("the CPU has" if has_tiles else "the CPU lacks") + " AMX"
    )
    log.info_once(f"diffusion model: {'bfloat16' if bf16 else 'float32'} ({reason})")
    return bf16
