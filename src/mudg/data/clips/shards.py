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

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from torch import Tensor

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.types import Clip

FAR_M = 1000.0
FLAG_VALID, FLAG_WARPED, FLAG_DEPTH_UNKNOWN = 1, 2, 4


@dataclass(frozen=True)
class Batch:
    """Clips stacked for training.

    rgb, color, backdrop f32[B,T,3,H,W] in [0,1]; depth, sparse_depth f32[B,T,1,H,W] metres; valid, warped bool[B,T,1,H,W];
    semantics i64[B,T,H,W]; reference f32[B,3,H,W]; ids, backdrop_ids u8[B,T,1,H,W] (255 = unknown); world_from_cam
    f64[B,T,4,4]; intrinsics f64[B,T,4]; shift_m: lateral shift of each clip; point_color f32[B,T,3,H,W] or None;
    depth_known bool[B,T,1,H,W]: where `depth` is true (all of it in generated cities).
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
    ids: Tensor
    backdrop_ids: Tensor
    world_from_cam: Tensor
    intrinsics: Tensor
    shift_m: tuple[float, ...]
    depth_known: Tensor
    point_color: Tensor | None = None

    def to(self, device: torch.device) -> Batch:
        """The same batch on a device."""
        moved = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return Batch(**{k: v.to(device) if isinstance(v, Tensor) else v for k, v in moved.items()})


def shard_path(folder: Path, city: int) -> Path:
    """Where the clips of one city lie."""
    return folder / f"city_{city:07d}.safetensors"


def pack_clips(
    clips: Sequence[Clip], shifts_m: Sequence[float], point_color: Sequence[Tensor] | None = None, *, gaps: bool = False
) -> dict[str, NDArray[np.generic]]:
    """Arrays of a shard from clips of one size; `point_color` f32[T,3,H,W] per clip is kept if given.

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

    def ids(clip: Clip, far: bool) -> NDArray[np.uint8]:
        c = clip.condition
        known = c.backdrop_semantics if far else c.semantics
        return (torch.full_like(c.valid, 255, dtype=torch.uint8) if known is None else known)[:, 0].numpy()

    def lens(clip: Clip) -> NDArray[np.float64]:
        cameras = [view.camera for view in clip.condition.views]
        return np.array([[c.fx, c.fy, c.cx, c.cy] for c in cameras], np.float64)

    extra = {} if point_color is None else {"point_color": np.stack([u8(c) for c in point_color])}
    return extra | {
        "rgb": np.stack([u8(c.rgb) for c in clips]),
        "depth": np.stack([f16(c.depth, c.depth_valid) for c in clips]),
        "semantics": np.stack([c.semantics.to(torch.uint8).numpy() for c in clips]),
        "color": np.stack([u8(c.condition.color) for c in clips]),
        "sparse_depth": np.stack([f16(c.condition.depth) * (c.condition.depth[:, 0] != 0).numpy() for c in clips]),
        "flags": np.stack([flags(c) for c in clips]),
        "backdrop": np.stack([u8(_backdrop(c)) for c in clips]),
        "reference": np.stack([u8(c.condition.reference) for c in clips]),
        "ids": np.stack([ids(c, False) for c in clips]),
        "backdrop_ids": np.stack([ids(c, True) for c in clips]),
        "world_from_cam": np.stack([np.stack([v.world_from_cam for v in c.condition.views]) for c in clips]),
        "intrinsics": np.stack([lens(c) for c in clips]),
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


_PER_FRAME = ("rgb", "depth", "semantics", "color", "sparse_depth", "flags", "backdrop", "ids", "backdrop_ids", "world_from_cam",
              "intrinsics")  # fmt: skip


def read_batch(folder: Path, picks: Sequence[tuple[int, int, Sequence[int]]]) -> Batch:
    """Read clips as a batch; `picks` holds (city, clip, frame indices), all with the same number of frames."""
    columns: dict[str, list[NDArray[np.generic]]] = {}
    shifts = []
    for city, clip, frames in picks:
        with _open(shard_path(folder, city)) as shard:
            for name in _PER_FRAME:
                columns.setdefault(name, []).append(shard.get_slice(name)[clip][np.asarray(frames)])
            if "point_color" in shard.keys():
                columns.setdefault("point_color", []).append(shard.get_slice("point_color")[clip][np.asarray(frames)])
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
        ids=stacked["ids"].unsqueeze(2),
        backdrop_ids=stacked["backdrop_ids"].unsqueeze(2),
        world_from_cam=stacked["world_from_cam"],
        intrinsics=stacked["intrinsics"],
        shift_m=tuple(shifts),
        depth_known=(flags & FLAG_DEPTH_UNKNOWN) == 0,
        point_color=stacked["point_color"].float() / 255 if len(columns.get("point_color", ())) == len(picks) else None,
    )


def joined(batches: Sequence[Batch]) -> Batch:
    """Several batches of the same size and number of frames as one."""
    columns: dict[str, Any] = {}
    for field in dataclasses.fields(Batch):
        parts = [getattr(b, field.name) for b in batches]
        if field.name == "shift_m":
            columns[field.name] = tuple(s for part in parts for s in part)
        else:
            columns[field.name] = None if any(p is None for p in parts) else torch.cat(parts)
    return Batch(**columns)


def vary(batch: Batch, rng: np.random.Generator) -> Batch:
    """Random mirror image, one random colour curve per clip for truth and condition alike, and worse or no given classes.

    Curves: gain 0.7-1.4, gamma 0.75-1.35, contrast 0.75-1.35 about the clip's mean, saturation 0.5-1.4, white balance
    +-8 %; the condition gets a further exposure error of +-3 %. Given classes: see `_worse_ids`. A mirrored clip keeps its
    poses and intrinsics: they then describe the mirror image of the place.
    """
    columns: dict[str, list[Tensor]] = {
        name: [] for name in ("rgb", "color", "backdrop", "reference", "ids", "backdrop_ids")
    }
    for index in range(len(batch.rgb)):
        gain = rng.uniform(0.7, 1.4) * (1 + rng.uniform(-0.08, 0.08, 3))
        gamma, contrast, saturation = rng.uniform(0.75, 1.35), rng.uniform(0.75, 1.35), rng.uniform(0.5, 1.4)
        middle = float(batch.rgb[index].mean())
        error = rng.uniform(0.97, 1.03)

        def curve(x: Tensor, extra: float, gain=gain, gamma=gamma, contrast=contrast, saturation=saturation,
                  middle=middle) -> Tensor:  # fmt: skip
            x = x * torch.as_tensor(gain * extra, dtype=x.dtype).view(3, 1, 1)
            x = x.clamp(1e-4, 1) ** gamma
            grey = x.mean(-3, keepdim=True)
            x = grey + saturation * (x - grey)
            return (middle + contrast * (x - middle)).clamp(0, 1)

        columns["rgb"].append(curve(batch.rgb[index], 1.0))
        for name in ("color", "backdrop", "reference"):
            columns[name].append(curve(getattr(batch, name)[index], error))
        ids, far_ids = _worse_ids(batch.ids[index], batch.backdrop_ids[index], rng)
        columns["ids"].append(ids)
        columns["backdrop_ids"].append(far_ids)
    turned = {name: torch.stack(parts) for name, parts in columns.items()}
    for name in ("depth", "semantics", "sparse_depth", "valid", "warped", "depth_known"):
        turned[name] = getattr(batch, name)
    if rng.random() >= 0.5:
        return dataclasses.replace(batch, **turned)  # type: ignore[arg-type]
    mirrored: dict[str, Any] = {name: x.flip(-1) for name, x in turned.items()}
    return dataclasses.replace(batch, **mirrored, shift_m=tuple(-s for s in batch.shift_m))


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
