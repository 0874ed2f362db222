"""Training clips on disk: one file per generated city, read back clip by clip.

A shard is a safetensors file with, for K clips of T frames,

    rgb u8[K,T,3,H,W]  depth f16[K,T,H,W] metres (codes beyond 1000 m and sky as 1000)  semantics u8[K,T,H,W]
    color u8[K,T,3,H,W]  sparse_depth f16[K,T,H,W]  flags u8[K,T,H,W] (1 = a point was seen, 2 = colour warped, 4 = depth
        is not true, it only fills a gap; clips of recorded logs)
    backdrop u8[K,T,3,H,W]  reference u8[K,3,H,W]  shift_m f32[K]
    ids, backdrop_ids u8[K,T,H,W]: classes that came with color and backdrop, 255 = unknown
    world_from_cam f64[K,T,4,4]  intrinsics f64[K,T,4] (fx, fy, cx, cy)
    point_color u8[K,T,3,H,W], cities for scoring only: colour of the nearest point, no image warped in
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from torch import Tensor

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.types import Camera, Clip, Condition, View

FAR_M = 1000.0
FLAG_VALID, FLAG_WARPED, FLAG_DEPTH_UNKNOWN = 1, 2, 4


def shard_path(folder: Path, city: int) -> Path:
    """Where the clips of one city lie."""
    return folder / f"city_{city:07d}.safetensors"


def pack_clips(clips: Sequence[Clip], *, gaps: bool = False) -> dict[str, NDArray[np.generic]]:
    """Arrays of a shard from clips of one size.

    Depth that is not valid is stored as far away, as is right for a generated sky. With `gaps` it is stored as it is, and
    marked as unknown. A condition's depth of 0 (nothing seen; points alone) stays 0.
    """

    def u8(image: Tensor) -> NDArray[np.uint8]:
        return (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()

    def f16(depth: Tensor, known: Tensor | None = None) -> NDArray[np.float16]:
        far = torch.where(torch.isfinite(depth) & (depth > 0), depth, torch.full_like(depth, FAR_M))
        far = far if known is None or gaps else torch.where(known, far, torch.full_like(far, FAR_M))
        return far.clamp(max=FAR_M)[:, 0].numpy().astype(np.float16)

    def flags(clip: Clip) -> NDArray[np.uint8]:
        c = clip.condition
        warped = torch.zeros_like(c.valid) if c.warped is None else c.warped
        unknown = ~clip.depth_valid if gaps else torch.zeros_like(c.valid)
        marks = c.valid * FLAG_VALID + warped * FLAG_WARPED + unknown * FLAG_DEPTH_UNKNOWN
        return marks[:, 0].to(torch.uint8).numpy()

    def ids(c: Condition, known: Tensor | None) -> NDArray[np.uint8]:
        return (torch.full_like(c.valid, 255, dtype=torch.uint8) if known is None else known)[:, 0].numpy()

    def intrinsics(c: Condition) -> NDArray[np.float64]:
        return np.array([[v.camera.fx, v.camera.fy, v.camera.cx, v.camera.cy] for v in c.views], np.float64)

    conditions = [clip.condition for clip in clips]
    points = [u8(c.point_color) for c in clips if c.point_color is not None]
    return ({"point_color": np.stack(points)} if points else {}) | {
        "rgb": np.stack([u8(c.rgb) for c in clips]),
        "depth": np.stack([f16(c.depth, c.depth_valid) for c in clips]),
        "semantics": np.stack([c.semantics.to(torch.uint8).numpy() for c in clips]),
        "color": np.stack([u8(c.color) for c in conditions]),
        "sparse_depth": np.stack([f16(c.depth) * (c.depth[:, 0] != 0).numpy() for c in conditions]),
        "flags": np.stack([flags(c) for c in clips]),
        "backdrop": np.stack([u8(c.color if c.backdrop is None else c.backdrop) for c in conditions]),
        "reference": np.stack([u8(c.reference) for c in conditions]),
        "ids": np.stack([ids(c, c.semantics) for c in conditions]),
        "backdrop_ids": np.stack([ids(c, c.backdrop_semantics) for c in conditions]),
        "world_from_cam": np.stack([np.stack([v.world_from_cam for v in c.views]) for c in conditions]),
        "intrinsics": np.stack([intrinsics(c) for c in conditions]),
        "shift_m": np.asarray([c.shift_m for c in clips], np.float32),
    }


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


_PER_FRAME = ("rgb", "depth", "semantics", "color", "sparse_depth", "flags", "backdrop", "ids", "backdrop_ids", "world_from_cam",
              "intrinsics")  # fmt: skip


def read_clip(folder: Path, city: int, clip: int, frames: Sequence[int]) -> Clip:
    """Some frames of one clip of a shard, as a `Clip`. Shards hold no times: frame numbers stand for seconds."""
    with _open(shard_path(folder, city)) as shard:
        names = [*_PER_FRAME, *(("point_color",) if "point_color" in shard.keys() else ())]
        found = {name: torch.from_numpy(shard.get_slice(name)[clip][np.asarray(frames)]) for name in names}
        reference = torch.from_numpy(shard.get_slice("reference")[clip])
        shift_m = float(shard.get_tensor("shift_m")[clip])
    image = lambda x: x.float() / 255  # noqa: E731
    flags, (height, width) = found["flags"].unsqueeze(1), found["rgb"].shape[-2:]
    views = tuple(
        View(Camera("clip", width, height, *lens.tolist()), pose.numpy(), float(frame))
        for frame, lens, pose in zip(frames, found["intrinsics"], found["world_from_cam"])
    )
    condition = Condition(
        views, image(found["color"]), found["sparse_depth"].float().unsqueeze(1), (flags & FLAG_VALID) > 0, image(reference),
        warped=(flags & FLAG_WARPED) > 0, backdrop=image(found["backdrop"]), semantics=found["ids"].unsqueeze(1),
        backdrop_semantics=found["backdrop_ids"].unsqueeze(1),
    )  # fmt: skip
    return Clip(
        condition, image(found["rgb"]), found["depth"].float().unsqueeze(1), (flags & FLAG_DEPTH_UNKNOWN) == 0,
        found["semantics"].long(), shift_m, image(found["point_color"]) if "point_color" in found else None,
    )  # fmt: skip


def vary(clip: Clip, rng: np.random.Generator) -> Clip:
    """Random mirror image, one random colour curve for truth and condition alike, and worse or no given classes.

    Curves: gain 0.7-1.4, gamma 0.75-1.35, contrast 0.75-1.35 about the clip's mean, saturation 0.5-1.4, white balance
    +-8 %; the condition gets a further exposure error of +-3 %. Given classes: see `_worse_ids`. A mirrored clip keeps its
    poses and intrinsics: they then describe the mirror image of the place.

    Args:
        clip: as read from a shard, with warped colours, backdrop and classes.
    """
    given = clip.condition
    gain = rng.uniform(0.7, 1.4) * (1 + rng.uniform(-0.08, 0.08, 3))
    gamma, contrast, saturation = rng.uniform(0.75, 1.35), rng.uniform(0.75, 1.35), rng.uniform(0.5, 1.4)
    middle = float(clip.rgb.mean())
    error = rng.uniform(0.97, 1.03)

    def curve(x: Tensor, extra: float) -> Tensor:
        x = x * torch.as_tensor(gain * extra, dtype=x.dtype).view(3, 1, 1)
        x = x.clamp(1e-4, 1) ** gamma
        grey = x.mean(-3, keepdim=True)
        x = grey + saturation * (x - grey)
        return (middle + contrast * (x - middle)).clamp(0, 1)

    rgb = curve(clip.rgb, 1.0)
    varied: dict[str, Tensor] = {n: curve(getattr(given, n), error) for n in ("color", "backdrop", "reference")}
    varied["semantics"], varied["backdrop_semantics"] = _worse_ids(given.semantics, given.backdrop_semantics, rng)
    if rng.random() >= 0.5:
        return replace(clip, rgb=rgb, condition=replace(given, **varied))
    varied |= {name: getattr(given, name) for name in ("depth", "valid", "warped")}
    turned = replace(given, **{name: x.flip(-1) for name, x in varied.items()})
    flipped = {name: getattr(clip, name).flip(-1) for name in ("depth", "depth_valid", "semantics")}
    return replace(clip, condition=turned, rgb=rgb.flip(-1), **flipped, shift_m=-clip.shift_m)


NO_IDS, WORSE_IDS = 0.35, 0.25
"""Shares of the training clips that get no classes, and classes with mistakes."""


def _worse_ids(ids: Tensor, far_ids: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Given classes u8[T,1,H,W] as a labeller might have made them: exact, none at all, or with mistakes.

    Mistakes: a class is unknown (15 %) or taken for another one (8 %) throughout, and blocks of 8x8 pixels are unknown.
    """
    draw = rng.random()
    if draw < NO_IDS:
        return torch.full_like(ids, 255), torch.full_like(far_ids, 255)
    if draw >= NO_IDS + WORSE_IDS:
        return ids, far_ids
    table = np.arange(256)
    for number in range(19):
        chance = rng.random()
        table[number] = 255 if chance < 0.15 else int(rng.integers(19)) if chance < 0.23 else number
    height, width = ids.shape[-2:]
    holes = torch.from_numpy(rng.random((1, 1, -(-height // 8), -(-width // 8))) < rng.uniform(0, 0.25))
    holes = holes.repeat_interleave(8, -2).repeat_interleave(8, -1)[..., :height, :width]
    lookup = torch.from_numpy(table.astype(np.uint8))
    worse = lambda x: torch.where(holes, torch.full_like(x, 255), lookup[x.long()])  # noqa: E731
    return worse(ids), worse(far_ids)
