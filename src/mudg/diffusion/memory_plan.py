"""The number format in which diffusion models compute; how much memory the published-type model needs, and how to cut
its work to fit.

The needs were counted once, on torch's meta device: what an eager pass of the published network holds at its worst
moment, with fused attention, which stores no scores. All of it grows linearly with the image. Not counted: the device's
own context and the workspace of convolutions, for which `RESERVE_BYTES` stands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from mudg.base import log
from mudg.base.devices import SAME_CODE
from mudg.base.errors import UsageError
from mudg.diffusion.published import PublishedConfig, PublishedMDM, WorkSplit

# which number format the networks run in, and saying so -------------------------------------------


Precision = Literal["auto", "float32", "bfloat16", "float16"]
CPU = torch.device("cpu")


def half_format(precision: Precision, device: torch.device = CPU, *, float16: bool = False) -> torch.dtype | None:
    """The half precision that convolutions and matrix products run in, None for float32. The choice is announced once.

    "auto" gives bfloat16 on CPUs that multiply in it: with AMX, or with AVX-512 (measured on Zen 4: a training step
    takes 0.55 of the time of float32, a sample 0.7); and on CUDA devices that have it (compute capability 8 and above).
    On other CUDA devices it gives float16 where `float16` says that the network bears its range, else float32; on MPS
    float32. An explicit choice is obeyed.

    Raises:
        UsageError: float16 on another device than CUDA, or for a network that does not bear its range.
    """
    if precision == "float16" and not (float16 and SAME_CODE.get(device.type, device.type) == "cuda"):
        raise UsageError(
            "float16 is for published-type models on CUDA devices",
            where="--precision",
            got=f"{'a published-type' if float16 else 'another'} model on {device}",
            remedy="bfloat16, or auto",
        )
    if precision != "auto":
        chosen, reason = {"bfloat16": torch.bfloat16, "float16": torch.float16}.get(precision), f"asked for {precision}"
    elif device.type == "cpu":
        capabilities = getattr(torch.cpu, "get_capabilities", dict)()
        names = {"amx_bf16": "AMX", "avx512_bf16": "AVX-512 BF16"}
        able = [title for name, title in names.items() if capabilities.get(name, False)]
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


# memory plan --------------------------------------------------------------------------------------


RESERVE_BYTES = 1_000_000_000
MODALITIES = 3
CUTS = ((True, True), (True, False), (False, True), (False, False))
"""(modalities together, guidance together), fastest first."""
FRAMES_AT_ONCE = (16, 8, 4, 2, 1)


def meta_model(config: PublishedConfig, dtype: torch.dtype) -> PublishedMDM:
    """The model without memory behind its weights."""
    with torch.device("meta"):
        return PublishedMDM(config).to(dtype).eval()


def parameter_bytes(model: nn.Module) -> int:
    """Bytes of all weights."""
    return sum(math.prod(p.shape) * p.element_size() for p in [*model.parameters(), *model.buffers()])


@dataclass(frozen=True)
class Needs:
    """What the parts of the work take at the model's own size, in bytes; videos and frames take in proportion to their
    number."""

    parameters: int
    tower: int
    """Of these, the image tower."""
    one_video: int
    """Activations of the denoising network for one latent video."""
    one_frame: int
    """Activations of the autoencoder for one frame."""
    clip: int
    """What is held beside them: condition, latents, decoded images."""


def needs_of(config: PublishedConfig, bytes_per_value: int) -> Needs:
    """The needs of a model whose weights and activations take 2 (bfloat16) or 4 (float32) bytes a number. Activations
    are those of the published network and its 16 frames."""
    model = meta_model(config, torch.bfloat16 if bytes_per_value == 2 else torch.float32)
    pixels = config.height * config.width
    return Needs(
        parameter_bytes(model),
        parameter_bytes(model.image),
        one_video=bytes_per_value * (2512 * pixels + 8_332_160),  # its second part: keys and values of the contexts
        one_frame=bytes_per_value * 12289 * pixels // 16,
        clip=(692 + bytes_per_value) * pixels + bytes_per_value * 1_182_208,
    )


def choose(
    needs: Needs, budget_bytes: int, *, guidance: bool = True, offload: tuple[bool, ...] = (False, True)
) -> tuple[WorkSplit, int]:
    """The fastest way to cut the work of one clip that fits the budget, or the thriftiest if none does, and its peak in
    bytes.

    The peak is what stays, the worst moment of all, and the reserve.

    Args:
        offload: whether the image tower is on the CPU, in the order in which it is tried with each cut. Moving it costs
            a fraction of a second per clip, smaller batches cost more.
    """
    ways = []
    for cut in CUTS:
        for away in offload:
            videos = needs.one_video * (MODALITIES if cut[0] else 1) * (2 if cut[1] and guidance else 1)
            stays = needs.parameters + needs.clip - away * needs.tower + RESERVE_BYTES
            frames = next((n for n in FRAMES_AT_ONCE if needs.one_frame * n <= budget_bytes - stays), 1)
            peak = max(stays + max(videos, needs.one_frame * frames), stays + away * needs.tower)
            ways.append((WorkSplit(cut[0], cut[1], frames, away), peak))
    return next((way for way in ways if way[1] <= budget_bytes), ways[-1])
