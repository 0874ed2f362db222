"""How much memory the published-type model needs, and how to cut its work to fit.

Nothing is allocated: the networks are built on torch's meta device and run there, while every tensor's birth and death is
counted. What is counted is what an eager pass holds at its worst moment; attention counts as a fused kernel, which stores no scores,
except where its heads are too wide for one. Not counted: the device's own context and the workspace of convolutions, for
which `RESERVE_BYTES` stands.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree
from torch.utils._python_dispatch import TorchDispatchMode

from mudg.models.published.clip import TEXT_TOKENS
from mudg.models.published.model import PublishedConfig, PublishedMDM, WorkSplit

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
                self._known.add(tensor.untyped_storage()._cdata)  # weights and inputs: there before
        result = func(*args, **(kwargs or {}))
        for tensor in _pytree.tree_leaves(result):
            if isinstance(tensor, Tensor) and tensor.is_meta:
                self._add(tensor.untyped_storage())
        self.peak = max(self.peak, self.now)
        return result

    def _add(self, storage: torch.UntypedStorage) -> None:
        key = storage._cdata
        if key in self._known:
            return
        self._known.add(key)
        size = storage.nbytes()
        self.now += size
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
    """Activations of one pass of the denoising network over `batch` latent videos, with the keys and values of their contexts, which are
    kept from step to step."""
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
        z = torch.empty(
            frames, model.config.codec.latent_channels, height // codec.factor, width // codec.factor, dtype=dtype
        )
    return max(
        peak_activations(lambda: codec.moments(image)), peak_activations(lambda: codec.decoder(codec.from_latent(z)))
    )


def parameter_bytes(model: nn.Module) -> int:
    """Bytes of all weights; of the model: denoising network, autoencoder, image tower, resampler."""
    return sum(math.prod(p.shape) * p.element_size() for p in [*model.parameters(), *model.buffers()])


@dataclass(frozen=True)
class Needs:
    """What the parts of the work take at the model's own size, in bytes; the last two grow in proportion to their number."""

    parameters: int
    tower: int
    """Of these, the image tower."""
    one_video: int
    """Activations of the denoising network for one latent video."""
    one_frame: int
    """Activations of the autoencoder for one frame."""


def needs_of(config: PublishedConfig, bytes_per_value: int) -> Needs:
    """Count the needs of a model whose weights and activations take 2 (bfloat16) or 4 (float32) bytes a number."""
    model = meta_model(config, torch.bfloat16 if bytes_per_value == 2 else torch.float32)
    size = (config.height, config.width)
    return Needs(
        parameter_bytes(model), parameter_bytes(model.image), denoise_bytes(model, *size, 1), autoencoder_bytes(model, *size, 1)
    )


def choose(needs: Needs, budget_bytes: int, *, guidance: bool = True, offload: bool = False) -> tuple[WorkSplit, int]:
    """The fastest way to cut the work of one clip that fits the budget, or the thriftiest if none does, and its peak in bytes.

    The peak is what stays, the worst moment of all, and the reserve. Of each cut the image tower is offloaded if that makes it fit
    (moving it costs a fraction of a second per clip, smaller batches more), or in any case with `offload`.
    """
    for cut in CUTS:
        videos = needs.one_video * (MODALITIES if cut[0] else 1) * (2 if cut[1] and guidance else 1)
        for away in (True,) if offload else (False, True):
            stays = needs.parameters - away * needs.tower + RESERVE_BYTES
            room = budget_bytes - stays
            frames = next((n for n in FRAMES_AT_ONCE if needs.one_frame * n <= room), 1)
            peak = max(stays + max(videos, needs.one_frame * frames), needs.parameters + RESERVE_BYTES)
            if peak <= budget_bytes:
                return WorkSplit(*cut, frames, away), peak
    return WorkSplit(*cut, frames, away), peak
