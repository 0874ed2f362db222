"""How much memory the published-type model needs, and how to cut its work to fit.

Nothing is allocated: the networks are built on torch's meta device and run there, while every tensor's birth and death
is counted. What is counted is what an eager pass holds at its worst moment; attention counts as a fused kernel, which
stores no scores, except where its heads are too wide for one. Not counted: the device's own context and the workspace
of convolutions, for which `RESERVE_BYTES` stands.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree
from torch.utils._python_dispatch import TorchDispatchMode

from mudg.base import log
from mudg.base.devices import SAME_CODE
from mudg.base.errors import UsageError
from mudg.base.types import Camera, Condition, View
from mudg.diffusion.published import PublishedConfig, PublishedMDM, WorkSplit
from mudg.diffusion.requests import SampleRequest
from mudg.networks.clip import TEXT_TOKENS

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
WIDEST_FUSED_HEAD = 256
MODALITIES = 3
CUTS = ((True, True), (True, False), (False, True), (False, False))
"""(modalities together, guidance together), fastest first."""
FRAMES_AT_ONCE = (16, 8, 4, 2, 1)


class _Live(TorchDispatchMode):
    """Counts the bytes of all storages born inside, and the most there ever were at a time."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.peak = 0
        self._known: set[int] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        for tensor in _pytree.tree_leaves((args, kwargs)):
            if isinstance(tensor, Tensor) and tensor.is_meta:
                self._add(tensor.untyped_storage(), born=False)  # weights and inputs: there before
        result = func(*args, **(kwargs or {}))
        for tensor in _pytree.tree_leaves(result):
            if isinstance(tensor, Tensor) and tensor.is_meta:
                self._add(tensor.untyped_storage(), born=True)
        self.peak = max(self.peak, self.now)
        return result

    def _add(self, storage: torch.UntypedStorage, *, born: bool) -> None:
        key = storage._cdata
        if key in self._known:
            return
        self._known.add(key)
        size = storage.nbytes() if born else 0
        self.now += size
        # An input may die too, and its address then belongs to another storage.
        weakref.finalize(storage, self._remove, key, size)

    def _remove(self, key: int, size: int) -> None:
        self._known.discard(key)
        self.now -= size


class _FusedAttention(TorchFunctionMode):
    """Puts what a fused kernel would store in place of attention."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is functional.scaled_dot_product_attention:
            query, key, value = args[:3]
            if query.shape[-1] > WIDEST_FUSED_HEAD:
                scores = query.new_empty(*query.shape[:-1], key.shape[-2])
                return scores.softmax(-1) @ value
            return query.new_empty(*query.shape[:-1], value.shape[-1])
        return func(*args, **(kwargs or {}))


def peak_activations(function: Callable[[], object]) -> int:
    """Most bytes alive at a time among the tensors that `function`, working on meta tensors, creates."""
    live = _Live()
    with torch.no_grad(), _FusedAttention(), live:
        function()
    return live.peak


def meta_model(config: PublishedConfig, dtype: torch.dtype) -> PublishedMDM:
    """The model without memory behind its weights."""
    with torch.device("meta"):
        return PublishedMDM(config).to(dtype).eval()


def denoise_bytes(model: PublishedMDM, height: int, width: int, batch: int) -> int:
    """Activations of one pass of the denoising network over `batch` latent videos, with the keys and values of their
    contexts, which are kept from step to step."""
    config, net = model.config, model.net
    dtype, factor = model.dtype, model.codec.factor
    with torch.device("meta"):
        x = torch.empty(batch, config.window, config.net.channels_in, height // factor, width // factor, dtype=dtype)
        t = torch.zeros(batch, dtype=torch.long)
        text = torch.empty(batch, TEXT_TOKENS, config.net.context_width, dtype=dtype)
        tokens = torch.empty(batch, config.window, config.image_tokens.tokens, config.net.context_width, dtype=dtype)
    return peak_activations(lambda: net(x, t, t, t, text, tokens, net.context_keys(text, tokens)))


def autoencoder_bytes(model: PublishedMDM, height: int, width: int, frames: int) -> int:
    """Activations of encoding or decoding `frames` images together, whichever is worse."""
    codec, dtype = model.codec, model.dtype
    with torch.device("meta"):
        image = torch.empty(frames, 3, height, width, dtype=dtype)
        cells = height // codec.factor, width // codec.factor
        z = torch.empty(frames, model.config.codec.latent_channels, *cells, dtype=dtype)
    encoding = peak_activations(lambda: codec.moments(image))
    return max(encoding, peak_activations(lambda: codec.decoder(codec.from_latent(z))))


def sampling_bytes(model: PublishedMDM, split: WorkSplit, *, guidance: bool = True) -> int:
    """What sampling one clip takes beside the weights, from its condition to its pixels, under a cut. Steps do not
    matter; the fit of depth is left out (it needs values, and a few megabytes)."""
    config, before = model.config, model.split
    frames, height, width = config.window, config.height, config.width
    camera = Camera("counted", width, height, 1.0, 1.0, 0.0, 0.0)
    views = tuple(View(camera, np.eye(4), float(n)) for n in range(frames))
    request = SampleRequest(1, guidance=None if guidance else 1.0, align=False)
    model.split = replace(split, offload=False)  # nothing can be moved off the meta device

    def whole() -> object:
        with torch.device("meta"):
            one = torch.empty(frames, 1, height, width)
            given = Condition(views, one.expand(-1, 3, -1, -1).clone(), one, one > 0, torch.empty(3, height, width))
        return model.sample(given, request)

    try:
        return peak_activations(whole)
    finally:
        model.split = before


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
    """Count the needs of a model whose weights and activations take 2 (bfloat16) or 4 (float32) bytes a number."""
    model = meta_model(config, torch.bfloat16 if bytes_per_value == 2 else torch.float32)
    size = (config.height, config.width)
    video, frame = denoise_bytes(model, *size, 1), autoencoder_bytes(model, *size, 1)
    at_once = min(FRAMES_AT_ONCE[0], config.window)  # most is held while the last images are decoded
    clip = sampling_bytes(model, WorkSplit(False, False, at_once), guidance=False) - max(video, frame * at_once)
    return Needs(parameter_bytes(model), parameter_bytes(model.image), video, frame, clip)


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
