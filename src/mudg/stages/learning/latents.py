"""Latents of a fixed codec, kept on disk: each clip goes through the codec once.

OUT/latents/<codec>/<first two letters>/<clip>.safetensors    z, f32, of one clip in one modality

<codec> is a digest of the codec's weights and settings, <clip> one of the very pixels handed to it (and of the modality), so a
latent is never taken for another: a clip whose pixels change is encoded again. Worth it where encoding costs much more than
reading, as with the published KL autoencoder; the patch codec of the small model costs next to nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from mudg.base import store

ENCODERS = ("encode_rgb", "encode_depth", "encode_semantics")


def codec_digest(codec: nn.Module) -> str:
    """Hex digest of a codec's settings and weights."""
    total = hashlib.sha256(repr(getattr(codec, "config", "")).encode())
    for name, value in codec.state_dict().items():
        total.update(f"\0{name}\0{value.dtype}\0{tuple(value.shape)}\0".encode())
        total.update(value.detach().cpu().contiguous().numpy().tobytes())
    return total.hexdigest()


@contextlib.contextmanager
def cached_latents(codec: nn.Module, folder: Path) -> Iterator[None]:
    """Inside the block the codec's encoders answer from `folder` what they have encoded before.

    Only inputs with a clip axis, [B,T,..], are kept. The codec must not change, nor draw random numbers, meanwhile.
    """
    place = folder / codec_digest(codec)[:16]
    before: dict[str, Callable[[Tensor], Tensor]] = {name: getattr(codec, name) for name in ENCODERS}
    for name, encode in before.items():
        setattr(codec, name, _remembering(encode, name, place))
    try:
        yield
    finally:
        for name in before:
            delattr(codec, name)  # uncovers the class's own method


def _remembering(encode: Callable[[Tensor], Tensor], name: str, folder: Path) -> Callable[[Tensor], Tensor]:
    def remembering(x: Tensor) -> Tensor:
        if x.ndim < 4 + (name != "encode_semantics"):
            return encode(x)
        return torch.cat([_of_clip(encode, name, folder, clip) for clip in x.split(1)])

    return remembering


def _of_clip(encode: Callable[[Tensor], Tensor], name: str, folder: Path, clip: Tensor) -> Tensor:
    pixels = clip.detach().cpu().contiguous()
    key = hashlib.blake2b(f"{name}\0{tuple(pixels.shape)}\0{pixels.dtype}\0".encode(), digest_size=20)
    key.update(pixels.numpy().tobytes())
    path = folder / key.hexdigest()[:2] / f"{key.hexdigest()}.safetensors"
    if path.is_file():
        return torch.from_numpy(store.read_safetensors(path)["z"].copy()).to(clip.device)
    z = encode(clip)
    store.write_safetensors(path, {"z": z.float()})
    return z.float()
