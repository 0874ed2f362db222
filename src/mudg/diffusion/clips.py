"""Training clips on disk, one file per generated city or window of a log; and which of them a training step draws.

A shard is a safetensors file with the arrays of `_ARRAYS` for K clips of T frames: truth (rgb, depth, semantics) and
condition (the others).

    depth            metres; codes beyond 1000 m and sky as 1000. depth_confidence (of 255): of labelled logs alone
    flags            1 = a point was seen, 2 = colour warped, 4 = depth is not true, it only fills a gap (logs)
    ids              classes that came with color, backdrop_ids with backdrop; 255 = unknown
    measured         what points measured (`Condition.measured`), 0 = nothing: the published system's conditions
    render ...       what a fitted scene shows; alpha, certainty of 255; rendered: false = this clip has none
    fine_NAME        all of these once more, of patches at a higher resolution; fine_place: row, column, scale
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from torch import Tensor

from mudg.base import seeds, store
from mudg.base.errors import InputError, ResourceError
from mudg.base.palette import CLASSES, UNLABELLED
from mudg.base.types import Camera, Clip, Condition, FinePatch, RenderPlanes, SparseDepth, View
from mudg.diffusion.settings import LearnConfig

Result = TypeVar("Result")
FAR_M = 1000.0
FINE = "fine_"
"""What the names of a patch's arrays begin with."""
FLAG_VALID, FLAG_WARPED, FLAG_DEPTH_UNKNOWN = 1, 2, 4


def shard_path(folder: Path, city: int) -> Path:
    """Where the clips of one city lie."""
    return folder / f"city_{city:07d}.safetensors"


_OPTIONAL = ("measured", "depth_confidence")
_RENDERS = ("render", "render_depth", "alpha", "certainty", "render_ids")
_IDS = ("semantics", "ids", "backdrop_ids", "render_ids")
_ARRAYS = {
    **dict.fromkeys(("rgb", "color", "backdrop", "render"), ("U8", "KT3HW")),
    **dict.fromkeys(("depth", "sparse_depth", "measured", "render_depth"), ("F16", "KTHW")),
    **dict.fromkeys((*_IDS, "flags", "alpha", "certainty", "depth_confidence"), ("U8", "KTHW")),
    "world_from_cam": ("F64", "KT44"),
    "intrinsics": ("F64", "KT4"),
    "reference": ("U8", "K3HW"),
    "shift_m": ("F32", "K"),
    "rendered": ("BOOL", "K"),
    "place": ("I32", "K3"),
}
"""Types and axes of a shard's arrays: clips, frames, rows, columns, and sizes that are always the same."""
_PER_FRAME = [n for n, (_, axes) in _ARRAYS.items() if axes[:2] == "KT" and n not in (*_OPTIONAL, *_RENDERS)]


def pack_clips(clips: Sequence[Clip], *, gaps: bool = False) -> dict[str, NDArray[np.generic]]:
    """Arrays of a shard from clips of one size. Depth that is not valid is stored as far away, as is right for a
    generated sky. With `gaps` it is stored as it is, and marked as unknown. A condition's depth of 0 (nothing seen;
    points alone) stays 0."""
    rendered = any(clip.condition.renders is not None for clip in clips)
    weighed = any(clip.depth_confidence is not None for clip in clips)
    rows = [_packed(clip, gaps, rendered, weighed) for clip in clips]
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0] if all(name in row for row in rows)}
    patches = [clip.fine for clip in clips if clip.fine is not None]
    if patches and len(patches) == len(clips):
        fine = pack_clips([patch.clip for patch in patches], gaps=gaps)
        arrays |= {f"{FINE}{name}": values for name, values in fine.items()}
        arrays[f"{FINE}place"] = np.array([[p.row, p.column, p.scale] for p in patches], np.int32)
    return arrays


def _packed(clip: Clip, gaps: bool, rendered: bool, weighed: bool) -> dict[str, NDArray[Any]]:
    """The arrays of one clip, those of `renders` and depth confidence if they are wanted."""
    c = clip.condition
    nothing, unlabelled = torch.zeros_like(c.valid), torch.full_like(c.valid, UNLABELLED, dtype=torch.uint8)

    def u8(image: Tensor) -> NDArray[np.uint8]:
        return (image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()

    def f16(depth: Tensor, known: Tensor | None = None) -> NDArray[np.float16]:
        near = torch.isfinite(depth) & (depth > 0) if known is None else torch.isfinite(depth) & (depth > 0) & known
        return torch.where(near, depth, FAR_M).clamp(max=FAR_M)[:, 0].numpy().astype(np.float16)

    def ids(given: Tensor | None) -> NDArray[np.uint8]:
        return (unlabelled if given is None else given)[:, 0].numpy()

    flags = c.valid * FLAG_VALID + (nothing if c.warped is None else c.warped) * FLAG_WARPED
    flags = flags + (~clip.depth_valid if gaps else nothing) * FLAG_DEPTH_UNKNOWN
    arrays: dict[str, Any] = {
        "rgb": u8(clip.rgb),
        "depth": f16(clip.depth, None if gaps else clip.depth_valid),
        "semantics": clip.semantics.to(torch.uint8).numpy(),
        "color": u8(c.color),
        "sparse_depth": f16(c.depth) * (c.depth[:, 0] != 0).numpy(),
        "flags": flags[:, 0].to(torch.uint8).numpy(),
        "backdrop": u8(c.color if c.backdrop is None else c.backdrop),
        "reference": u8(c.reference),
        "ids": ids(c.semantics),
        "backdrop_ids": ids(c.backdrop_semantics),
        "world_from_cam": np.stack([v.world_from_cam for v in c.views]),
        "intrinsics": np.array([[v.camera.fx, v.camera.fy, v.camera.cx, v.camera.cy] for v in c.views], np.float64),
        "shift_m": np.float32(clip.shift_m),
    }
    if c.measured is not None:
        arrays["measured"] = f16(c.measured.depth) * c.measured.valid[:, 0].numpy()
    if weighed:
        arrays["depth_confidence"] = u8(clip.depth_weight)[:, 0]
    if rendered:
        none = torch.zeros_like(c.depth)
        r = RenderPlanes(c.color, none, none, none, unlabelled) if c.renders is None else c.renders
        arrays |= {"render": u8(r.color), "render_depth": f16(r.depth), "alpha": u8(r.alpha)[:, 0]}
        arrays |= {"certainty": u8(r.certainty)[:, 0], "render_ids": ids(r.semantics)}
        arrays["rendered"] = np.bool_(c.renders is not None)
    return arrays


def write_shard(folder: Path, city: int, clips: Sequence[Clip], *, gaps: bool = False) -> None:
    """Write one city's clips (see `pack_clips`), completely or not at all."""
    store.write_safetensors(shard_path(folder, city), pack_clips(clips, gaps=gaps))


def counts_at(path: Path) -> tuple[int, int]:
    """Clips in the shard at `path`, and frames of each; InputError if its arrays are not those of a shard."""
    with _open(path) as shard:
        _check_arrays(shard, path)
        clips, frames = shard.get_slice("rgb").get_shape()[:2]
        return clips, frames


def _open(path: Path) -> safe_open:
    try:
        return safe_open(str(store.regular(path)), "numpy")
    except (SafetensorError, OSError) as error:
        what = "a shard of training clips is missing or damaged"
        raise InputError(what, where=str(path), got=str(error), remedy="delete it; it is made again") from error


def _check_arrays(shard: Any, path: Path) -> None:
    """InputError where an array is missing, or of another type or size than the others say; only the header is read."""
    names = set(shard.keys())
    for prefix in ("", FINE) if f"{FINE}place" in names else ("",):
        rendered = _RENDERS if f"{prefix}rendered" in names else ()
        required = {prefix + name for name in (*_PER_FRAME, "reference", "shift_m", *rendered)}
        if required - names:
            raise _damaged(path, "every array of a shard", f"no {', '.join(sorted(required - names))}")
        shape = shard.get_slice(f"{prefix}rgb").get_shape()
        sizes = {"3": 3, "4": 4, **dict(zip("KT3HW", shape, strict=False))}
        for name, (kind, axes) in _ARRAYS.items():
            if prefix + name in names:
                part = shard.get_slice(prefix + name)
                wanted = [sizes.get(axis, 0) for axis in axes]
                if part.get_dtype() != kind or part.get_shape() != wanted or 0 in wanted or sizes["3"] != 3:
                    got = f"{prefix}{name}: {part.get_dtype()} {part.get_shape()}"
                    raise _damaged(path, f"{kind} {wanted}", got)


def _check_values(planes: Mapping[str, Tensor], path: Path) -> None:
    """InputError for numbers that are not finite, and for classes that do not exist."""
    for name, value in planes.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            raise _damaged(path, "finite numbers", name)
        if name in _IDS and bool(((value >= len(CLASSES)) & (value != UNLABELLED)).any()):
            worst = int(value[value != UNLABELLED].max())
            raise _damaged(path, f"classes below {len(CLASSES)}, or {UNLABELLED}", f"{name}: {worst}")


def _damaged(path: Path, expected: str, got: str) -> InputError:
    return InputError(
        "a shard of training clips is damaged",
        where=str(path),
        expected=expected,
        got=got,
        remedy="delete it; it is made again",
    )


def clip_at(path: Path, clip: int, frames: Sequence[int]) -> Clip:
    """Some frames of one clip of the shard at `path`. Shards hold no times: frame numbers stand for seconds."""
    with _open(path) as shard:
        _check_arrays(shard, path)
        clips, most = shard.get_slice("rgb").get_shape()[:2]
        if not (0 <= clip < clips and 0 <= min(frames) and max(frames) < most):
            raise InputError(
                "a shard has fewer clips or frames",
                where=str(path),
                got=f"{clips} clips of {most} frames",
                expected=f"clip {clip}, frame {max(frames)}",
                remedy="choose another --data.clips, or a smaller --data.window",
            )
        made = _read_part(shard, "", clip, frames, path)
        if f"{FINE}place" not in shard.keys():
            return made
        row, column, scale = shard.get_slice(f"{FINE}place")[clip].tolist()
        return replace(made, fine=FinePatch(_read_part(shard, FINE, clip, frames, path), row, column, scale))


def _read_part(shard: Any, prefix: str, clip: int, frames: Sequence[int], path: Path) -> Clip:
    """A clip, or its patch, from the arrays whose names begin with `prefix`."""
    names = {name.removeprefix(prefix) for name in shard.keys() if name.startswith(prefix)}
    rendered = "rendered" in names and bool(shard.get_slice(f"{prefix}rendered")[clip])
    chosen = [*_PER_FRAME, *(n for n in _OPTIONAL if n in names), *(_RENDERS if rendered else ())]
    x = {name: torch.from_numpy(shard.get_slice(prefix + name)[clip][np.asarray(frames)]) for name in chosen}
    shift_m = float(shard.get_tensor(f"{prefix}shift_m")[clip])
    _check_values({**x, "shift_m": torch.tensor(shift_m)}, path)
    image = lambda name: x[name].float() / 255
    plane = lambda name: x[name].float().unsqueeze(1)
    ids = lambda name: x[name].unsqueeze(1)
    height, width = x["rgb"].shape[-2:]
    views = tuple(
        View(Camera("clip", width, height, *lens.tolist()), pose.numpy(), float(frame))
        for frame, lens, pose in zip(frames, x["intrinsics"], x["world_from_cam"])
    )
    renders, measured = None, plane("measured") if "measured" in x else None
    if rendered:
        alpha, certainty = (plane(name) / 255 for name in ("alpha", "certainty"))
        renders = RenderPlanes(image("render"), plane("render_depth"), alpha, certainty, ids("render_ids"))
    condition = Condition(
        views,
        image("color"),
        plane("sparse_depth"),
        (ids("flags") & FLAG_VALID) > 0,
        torch.from_numpy(shard.get_slice(f"{prefix}reference")[clip]).float() / 255,
        warped=(ids("flags") & FLAG_WARPED) > 0,
        backdrop=image("backdrop"),
        semantics=ids("ids"),
        backdrop_semantics=ids("backdrop_ids"),
        renders=renders,
        measured=None if measured is None else SparseDepth(measured, measured > 0),
    )
    return Clip(
        condition,
        image("rgb"),
        plane("depth"),
        (ids("flags") & FLAG_DEPTH_UNKNOWN) == 0,
        x["semantics"].long(),
        shift_m,
        depth_confidence=plane("depth_confidence") / 255 if "depth_confidence" in x else None,
    )


def vary(clip: Clip, rng: np.random.Generator) -> Clip:
    """Random mirror image, one random colour curve for truth and condition alike, and worse or no given classes.
    Curves: gain 0.7-1.4, gamma 0.75-1.35, contrast 0.75-1.35 about the clip's mean, saturation 0.5-1.4, white balance
    +-8 %; the condition gets a further exposure error of +-3 %. Given classes: see `class_mistakes`. A mirrored clip
    keeps its poses and intrinsics: they then describe the mirror image of the place. clip: as read from a shard, with
    warped colours, backdrop and classes. Its patch is varied in the same way."""
    gain = rng.uniform(0.7, 1.4) * (1 + rng.uniform(-0.08, 0.08, 3))
    gamma, contrast, saturation = rng.uniform(0.75, 1.35), rng.uniform(0.75, 1.35), rng.uniform(0.5, 1.4)
    middle = float(clip.rgb.numpy().mean(dtype=np.float64))  # the same by any number of threads
    error = rng.uniform(0.97, 1.03)

    def curve(x: Tensor, extra: float) -> Tensor:
        x = x * torch.as_tensor(gain * extra, dtype=x.dtype).view(3, 1, 1)
        x = x.clamp(1e-4, 1) ** gamma
        grey = x.mean(-3, keepdim=True)
        x = grey + saturation * (x - grey)
        return (middle + contrast * (x - middle)).clamp(0, 1)

    mistaken = class_mistakes(rng)
    mirrored = rng.random() < 0.5
    without_renders = rng.random() < NO_RENDERS

    def varied(one: Clip) -> Clip:
        given = one.condition
        colors = {n: curve(getattr(given, n), error) for n in ("color", "backdrop", "reference")}
        ids = {n: mistaken(getattr(given, n)) for n in ("semantics", "backdrop_semantics")}
        renders = None
        if given.renders is not None and not without_renders:
            shown = given.renders
            renders = replace(shown, color=curve(shown.color, error), semantics=mistaken(shown.semantics))
        condition = replace(given, **colors, **ids, renders=renders)
        made = replace(one, rgb=curve(one.rgb, 1.0), condition=condition, fine=None)
        return replace(made.map(lambda x: x.flip(-1)), shift_m=-one.shift_m) if mirrored else made

    made = varied(clip)
    if clip.fine is None:
        return made
    column = clip.fine.column
    if mirrored:
        column = clip.rgb.shape[-1] - column - clip.fine.clip.rgb.shape[-1] // clip.fine.scale
    return replace(made, fine=replace(clip.fine, clip=varied(clip.fine.clip), column=column))


NO_IDS, WORSE_IDS = 0.35, 0.25
"""Shares of the training clips that get no classes, and classes with mistakes."""
NO_RENDERS = 0.1
"""Share of the training clips with renders that are used without."""


def class_mistakes(rng: np.random.Generator) -> Callable[[Tensor], Tensor]:
    """What makes of true classes u8[T,1,H,W] those that a labeller might have given: exact ones, none at all, or with
    mistakes. Mistakes: a class is unknown (15 %) or taken for another one (8 %) throughout, and blocks of 8x8 pixels
    are unknown."""
    draw, table, share, seed = rng.random(), np.arange(256), 0.0, 0
    if draw < NO_IDS:
        return lambda ids: torch.full_like(ids, UNLABELLED)
    if draw < NO_IDS + WORSE_IDS:
        for number in range(len(CLASSES)):
            chance = rng.random()
            other = int(rng.integers(len(CLASSES))) if 0.15 <= chance < 0.23 else number
            table[number] = UNLABELLED if chance < 0.15 else other
        share, seed = float(rng.uniform(0, 0.25)), int(rng.integers(2**31))

    def given(ids: Tensor) -> Tensor:
        worse = torch.from_numpy(table.astype(np.uint8))[ids.long()]
        if not share:
            return worse
        height, width = ids.shape[-2:]
        blocks = seeds.numpy_rng(seed, 0, "holes").random((1, 1, -(-height // 8), -(-width // 8))) < share
        holes = torch.from_numpy(blocks).repeat_interleave(8, -2).repeat_interleave(8, -1)[..., :height, :width]
        return torch.where(holes, torch.full_like(worse, UNLABELLED), worse)

    return given


# where shards are ---------------------------------------------------------------------------------


class Shards:
    """Shards of training clips by number."""

    def path(self, number: int) -> Path:
        """A shard's file, on this machine."""
        raise NotImplementedError

    def has(self, number: int) -> bool:
        """Whether reading a shard waits for nobody who is still making it."""
        del number
        return True

    def reading(self, number: int, read: Callable[[Path], Result]) -> Result:
        """What `read` makes of a shard's file."""
        return read(self.path(number))

    def clips_in(self, number: int) -> int:
        """Clips in a shard."""
        return self.reading(number, counts_at)[0]

    def clip(self, number: int, clip: int, frames: Sequence[int]) -> Clip:
        """Some frames of one clip of a shard."""
        return self.reading(number, lambda path: clip_at(path, clip, frames))


class ShardFolder(Shards):
    """Shards in a folder, where other processes may still be making them; `patience_s`: how long one is waited for."""

    def __init__(self, folder: Path, patience_s: float = 900.0) -> None:
        self.folder, self._patience_s = folder, patience_s

    def has(self, number: int) -> bool:
        """Whether a shard is there."""
        return shard_path(self.folder, number).is_file()

    def path(self, number: int) -> Path:
        """A shard's file, once it is there; ResourceError: nobody makes it."""
        started = time.monotonic()
        while not self.has(number):
            if time.monotonic() - started > self._patience_s:
                what, remedy = "no training clips arrived", "see the errors of the generating processes above"
                expected = f"within {self._patience_s:.0f} s"
                raise ResourceError(what, where=str(shard_path(self.folder, number)), expected=expected, remedy=remedy)
            time.sleep(0.5)
        return shard_path(self.folder, number)


# the clips of a training --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TrainingClips:
    """The clips that a training draws from, in numbered shards. What is drawn for a clip depends on (seed, step,
    purpose) and the clip's place in the batch of a step: not on which part of that batch is drawn here.

    config: of the training. shards: where the clips are. size: width and height, as the settings come to. sizes: of the
    clips: shard number n has the n-th, counted round. All clips of a step have that of its first. numbers: of the
    shards to train on, of which `begin` are in use from the first step. The others join at steps that are the same in
    every run, so that clips can still be in the making while training runs. scored: shards for scoring only. about: the
    data in a sentence for the model card; empty = generated cities."""

    config: LearnConfig
    shards: Shards
    size: tuple[int, int]
    sizes: Sequence[tuple[int, int]]
    numbers: range
    begin: int
    scored: Sequence[int]
    about: str = ""

    def in_use(self, step: int) -> range:
        """Shards that training may draw from at `step`: `begin`, then linearly up to all at `all_cities_at`."""
        share = min(1.0, step / max(1.0, self.config.data.all_cities_at * self.config.steps))
        return self.numbers[: self.begin + int((len(self.numbers) - self.begin) * share)]

    def draw(self, step: int, count: int, frames: int, purpose: str, part: slice | None = None) -> list[Clip]:
        """The clips of a `part` of a step's batch of `count`: random shards, clips and runs of consecutive frames,
        varied (see `vary`)."""
        read, drawn = self.reader(step, count, frames, purpose), []
        for place in range(count)[part or slice(None)]:
            clip = read(place)
            if self.config.data.augment:
                clip = vary(clip, seeds.numpy_rng(self.config.seed, step, f"{purpose}, clip {place}"))
            drawn.append(clip)
        return drawn

    def reader(self, step: int, count: int, frames: int, purpose: str) -> Callable[[int], Clip]:
        """What reads the clip of a place in the batch."""
        picks = self._picks(step, count, frames, purpose)
        return lambda place: self.read(*picks[place], self.sizes[picks[place][0] % len(self.sizes)])

    def read(self, shard: int, number: int, frames: range, size: tuple[int, int]) -> Clip:
        """Some frames of a clip; InputError if it has another size."""
        clip = self.shards.clip(shard, number, frames)
        if clip.rgb.shape[-2:] != size[::-1]:
            raise InputError(
                "the training clips have another size",
                where=f"{self.config.data.clips or 'clips'}, shard {shard}",
                expected=f"{size[0]}x{size[1]}",
                got=f"{clip.rgb.shape[-1]}x{clip.rgb.shape[-2]}",
                remedy="choose another --data.clips",
            )
        return clip

    def _picks(self, step: int, count: int, frames: int, purpose: str) -> list[tuple[int, int, range]]:
        """Shard, clip and frames for every place of a batch."""
        rng, picks = seeds.numpy_rng(self.config.seed, step, purpose), list[tuple[int, int, range]]()
        shards = self.in_use(step)
        for _ in range(count):
            shard = shards[int(rng.integers(len(shards)))]
            shard = self.of_same_size(shard, picks[0][0], shards) if picks else shard
            number = int(rng.integers(self.shards.clips_in(shard)))
            start = int(rng.integers(self.config.data.window - frames + 1))
            picks.append((shard, number, range(start, start + frames)))
        return picks

    def of_same_size(self, shard: int, first: int, shards: range) -> int:
        """The one of `shards` next to `shard` whose clips have the size of those of `first`."""
        near = shard - shard % len(self.sizes) + first % len(self.sizes)
        return next((n for n in (near, near - len(self.sizes), near + len(self.sizes)) if n in shards), first)

    def ready(self, step: int) -> bool:
        """Whether `draw` at a step waits for no city that is still being made."""
        return all(map(self.shards.has, self.in_use(step)))

    def have_patches(self) -> bool:
        """Whether the clips have patches at a higher resolution; seen in the first one."""
        return self.shards.clip(self.numbers[0], 0, range(1)).fine is not None

    def weighed(self) -> Sequence[int]:
        """Shards over which classes are counted."""
        return self.in_use(0)[:20]

    def to_score(self) -> Sequence[int]:
        """Shards to score; InputError where none can be used."""
        return self.scored


def class_weights(shards: Shards, numbers: Iterable[int], balance: float) -> Tensor:
    """Weights f32[19] of the classes in the semantic loss: share^-balance, counted over some shards. Scaled so that the
    mean over labelled pixels is 1; a class that never occurs weighs as much as the rarest that does."""
    counts = torch.zeros(256, dtype=torch.float64)
    for number in numbers:
        counts += torch.bincount(shards.clip(number, 0, range(1)).semantics.flatten(), minlength=256)
    counts = counts[: len(CLASSES)]
    if not bool(counts.any()):  # logs without labels
        return torch.ones(len(CLASSES))
    share = counts / counts.sum().clamp(min=1)
    weight = share.clamp(min=max(float(share[share > 0].min()), 1e-3)) ** -balance
    return (weight / (weight * share).sum().clamp(min=1e-9)).float()
