"""Training clips on disk: one file per generated city, read back clip by clip.

A shard is a safetensors file with, for K clips of T frames,

    rgb u8[K,T,3,H,W]  depth f16[K,T,H,W] metres (codes beyond 1000 m and sky as 1000)  semantics u8[K,T,H,W]
    color u8[K,T,3,H,W]  sparse_depth f16[K,T,H,W]  flags u8[K,T,H,W] (1 = a point was seen, 2 = colour warped)
    backdrop u8[K,T,3,H,W]  reference u8[K,3,H,W]  shift_m f32[K]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from torch import Tensor

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.types import Clip

FAR_M = 1000.0
FLAG_VALID, FLAG_WARPED = 1, 2


@dataclass(frozen=True)
class Batch:
    """Clips stacked for training.

    rgb, color, backdrop f32[B,T,3,H,W] in [0,1]; depth, sparse_depth f32[B,T,1,H,W] metres; valid, warped bool[B,T,1,H,W];
    semantics i64[B,T,H,W]; reference f32[B,3,H,W]; shift_m: lateral shift of each clip.
    """

    rgb: Tensor
    depth: Tensor
    semantics: Tensor
    color: Tensor
    sparse_depth: Tensor
    valid: Tensor
    warped: Tensor
    backdrop: Tensor
    reference: Tensor
    shift_m: tuple[float, ...]


def shard_path(folder: Path, city: int) -> Path:
    """Where the clips of one city lie."""
    return folder / f"city_{city:07d}.safetensors"


def pack_clips(clips: Sequence[Clip], shifts_m: Sequence[float]) -> dict[str, NDArray[np.generic]]:
    """Arrays of a shard from clips of one size."""

    def u8(image: Tensor) -> NDArray[np.uint8]:
        return (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()

    def f16(depth: Tensor, known: Tensor | None = None) -> NDArray[np.float16]:
        far = torch.where(torch.isfinite(depth) & (depth > 0), depth, torch.full_like(depth, FAR_M))
        far = far if known is None else torch.where(known, far, torch.full_like(far, FAR_M))
        return far.clamp(max=FAR_M)[:, 0].numpy().astype(np.float16)

    def flags(clip: Clip) -> NDArray[np.uint8]:
        c = clip.condition
        warped = torch.zeros_like(c.valid) if c.warped is None else c.warped
        return (c.valid * FLAG_VALID + warped * FLAG_WARPED)[:, 0].to(torch.uint8).numpy()

    return {
        "rgb": np.stack([u8(c.rgb) for c in clips]),
        "depth": np.stack([f16(c.depth, c.depth_valid) for c in clips]),
        "semantics": np.stack([c.semantics.to(torch.uint8).numpy() for c in clips]),
        "color": np.stack([u8(c.condition.color) for c in clips]),
        "sparse_depth": np.stack([f16(c.condition.depth) for c in clips]),
        "flags": np.stack([flags(c) for c in clips]),
        "backdrop": np.stack([u8(_backdrop(c)) for c in clips]),
        "reference": np.stack([u8(c.condition.reference) for c in clips]),
        "shift_m": np.asarray(shifts_m, np.float32),
    }


def _backdrop(clip: Clip) -> Tensor:
    c = clip.condition
    return c.color if c.backdrop is None else c.backdrop


def write_shard(folder: Path, city: int, arrays: Mapping[str, NDArray[np.generic]]) -> None:
    """Write one city's clips, completely or not at all."""
    store.write_safetensors(shard_path(folder, city), dict(arrays))


def clips_in(folder: Path, city: int) -> int:
    """Number of clips in a shard."""
    with _open(shard_path(folder, city)) as shard:
        return int(shard.get_slice("shift_m").get_shape()[0])


def _open(path: Path) -> safe_open:  # type: ignore[valid-type]
    try:
        return safe_open(str(path), "numpy")
    except (SafetensorError, OSError) as error:
        raise InputError("a shard of training clips is missing or damaged", where=str(path), got=str(error),
                         remedy="delete it; it is made again") from error  # fmt: skip


def read_batch(folder: Path, picks: Sequence[tuple[int, int, Sequence[int]]]) -> Batch:
    """Read clips as a batch; `picks` holds (city, clip, frame indices), all with the same number of frames."""
    columns: dict[str, list[NDArray[np.generic]]] = {}
    shifts = []
    for city, clip, frames in picks:
        with _open(shard_path(folder, city)) as shard:
            for name in ("rgb", "depth", "semantics", "color", "sparse_depth", "flags", "backdrop"):
                columns.setdefault(name, []).append(shard.get_slice(name)[clip][np.asarray(frames)])
            columns.setdefault("reference", []).append(shard.get_slice("reference")[clip])
            shifts.append(float(shard.get_tensor("shift_m")[clip]))
    stacked = {name: torch.from_numpy(np.stack(parts)) for name, parts in columns.items()}
    flags = stacked["flags"].unsqueeze(2)
    return Batch(
        rgb=stacked["rgb"].float() / 255,
        depth=stacked["depth"].float().unsqueeze(2),
        semantics=stacked["semantics"].long(),
        color=stacked["color"].float() / 255,
        sparse_depth=stacked["sparse_depth"].float().unsqueeze(2),
        valid=(flags & FLAG_VALID) > 0,
        warped=(flags & FLAG_WARPED) > 0,
        backdrop=stacked["backdrop"].float() / 255,
        reference=stacked["reference"].float() / 255,
        shift_m=tuple(shifts),
    )


def vary(batch: Batch, rng: np.random.Generator) -> Batch:
    """Random mirror image, and one random colour curve per clip for truth and condition alike.

    Curves: gain 0.7-1.4, gamma 0.75-1.35, contrast 0.75-1.35 about the clip's mean, saturation 0.5-1.4, white balance
    +-8 %; the condition gets a further exposure error of +-3 %.
    """
    rgb, color, reference = batch.rgb, batch.color, batch.reference
    new_rgb, new_color, new_backdrop, new_reference = [], [], [], []
    for index in range(len(rgb)):
        gain = rng.uniform(0.7, 1.4) * (1 + rng.uniform(-0.08, 0.08, 3))
        gamma, contrast, saturation = rng.uniform(0.75, 1.35), rng.uniform(0.75, 1.35), rng.uniform(0.5, 1.4)
        middle = float(rgb[index].mean())
        error = rng.uniform(0.97, 1.03)

        def curve(x: Tensor, extra: float, gain=gain, gamma=gamma, contrast=contrast, saturation=saturation,
                  middle=middle) -> Tensor:  # fmt: skip
            x = x * torch.as_tensor(gain * extra, dtype=x.dtype).view(3, 1, 1)
            x = x.clamp(1e-4, 1) ** gamma
            grey = x.mean(-3, keepdim=True)
            x = grey + saturation * (x - grey)
            return (middle + contrast * (x - middle)).clamp(0, 1)

        new_rgb.append(curve(rgb[index], 1.0))
        new_color.append(curve(color[index], error))
        new_backdrop.append(curve(batch.backdrop[index], error))
        new_reference.append(curve(reference[index], error))
    flip = rng.random() < 0.5
    turn = (lambda x: x.flip(-1)) if flip else (lambda x: x)
    return Batch(
        turn(torch.stack(new_rgb)),
        turn(batch.depth),
        turn(batch.semantics),
        turn(torch.stack(new_color)),
        turn(batch.sparse_depth),
        turn(batch.valid),
        turn(batch.warped),
        turn(torch.stack(new_backdrop)),
        turn(torch.stack(new_reference)),
        tuple(-s if flip else s for s in batch.shift_m),
    )
