"""Which number format the networks run in, and saying so."""

from __future__ import annotations

from typing import Literal

import torch

from mudg.base import log
from mudg.base.devices import SAME_CODE
from mudg.base.errors import UsageError

Precision = Literal["auto", "float32", "bfloat16", "float16"]
CPU = torch.device("cpu")


def half_format(precision: Precision, device: torch.device = CPU, *, float16: bool = False) -> torch.dtype | None:
    """The half precision that convolutions and matrix products run in, None for float32. The choice is announced once.

    "auto" gives bfloat16 on CPUs that multiply in it: with AMX, or with AVX-512 (measured on Zen 4: a training step takes 0.55 of
    the time of float32, a sample 0.7); and on CUDA devices that have it (compute capability 8 and above). On other CUDA devices it
    gives float16 where `float16` says that the network bears its range, else float32; on MPS float32. An explicit choice is obeyed.

    Raises:
        UsageError: float16 on another device than CUDA, or for a network that does not bear its range.
    """
    if precision == "float16" and not (float16 and SAME_CODE.get(device.type, device.type) == "cuda"):
        raise UsageError("float16 is for published-type models on CUDA devices", where="--precision",
            got=f"{'a published-type' if float16 else 'another'} model on {device}", remedy="bfloat16, or auto")  # fmt: skip
    if precision != "auto":
        chosen, reason = {"bfloat16": torch.bfloat16, "float16": torch.float16}.get(precision), f"asked for {precision}"
    elif device.type == "cpu":
        capabilities = getattr(torch.cpu, "get_capabilities", dict)()
        able = [title for name, title in (("amx_bf16", "AMX"), ("avx512_bf16", "AVX-512 BF16")) if capabilities.get(name, False)]
        chosen = torch.bfloat16 if able else None
        reason = f"the CPU has {able[0]}" if able else "the CPU has no bfloat16"
    elif device.type == "cuda":
        has = torch.cuda.get_device_capability(device)[0] >= 8  # what torch would otherwise emulate
        chosen = torch.bfloat16 if has else torch.float16 if float16 else None
        reason = f"{device} has {'' if has else 'no '}bfloat16"
    else:
        chosen, reason = None, f"on {device}"
    name = "float32" if chosen is None else str(chosen).removeprefix("torch.")
    log.info_once(f"diffusion model: {name} ({reason})")
    return chosen


def choose_bf16(precision: Precision, device: torch.device = CPU) -> bool:
    """Whether to run convolutions and matrix products in bfloat16 rather than float32 (see `half_format`)."""
    return half_format(precision, device) is not None
