"""The protocols of ``mudg bench real`` as rows of plain values: what is hidden from the methods, and what is scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from mudg.base.types import Frame, Scene

SHOWN_BETWEEN: Final = 3
"""Fewest shown moments before, between and after blocks of held-out ones, where a log is long enough for it."""
MapName = Literal["photo", "depth", "seen", "dynamic", "color", "classes"]


@dataclass(frozen=True)
class Split:
    """What of a log the methods see.

    Args:
        name: also of its folder. block: length of the blocks of held-out moments (0 = none). by_camera: only the chosen cameras are
            shown. all_cameras: views of all cameras are asked for that have held-out frames; else of the first camera.
        shifts_m: lateral shifts of the views that are asked for, metres, positive to the left.
    """

    name: str
    block: int = 0
    by_camera: bool = False
    all_cameras: bool = True
    shifts_m: tuple[float, ...] = (0.0,)


@dataclass(frozen=True)
class Protocol:
    """One row: which views are scored, against what, in which columns.

    Args:
        name: in tables. family: as asked for with ``--protocols``. title: heading. split: name of a ``Split``.
        shifts_m: lateral shifts of the scored views. every: every n-th view of a camera counts, beginning with the second where n > 1.
        maps: what the truth of a view holds. columns: names in ``real_measure.COLUMNS``, in the order of the table.
        pooled: a log's value is that of all its places together, so that a place weighs what it adds to the sums; else their mean.
    """

    name: str
    family: str
    title: str
    split: str
    maps: tuple[MapName, ...]
    columns: tuple[str, ...]
    shifts_m: tuple[float, ...] = (0.0,)
    every: int = 1
    pooled: bool = False


SPLITS: Final[dict[str, Split]] = {
    "gap-1": Split("gap-1", block=1),
    "gap-3": Split("gap-3", block=3),
    "gap-5": Split("gap-5", block=5),
    "camera": Split("camera", by_camera=True),
    "all": Split("all", all_cameras=False, shifts_m=(0.0, 2.0, -2.0, 3.0, -3.0)),
}
_GAP: Final = ("psnr", "ssim", "perceptual", "psnr_dynamic", "psnr_upper", "abs_rel")
_CAMERA: Final = ("psnr_seen", "perceptual_seen", "abs_rel_seen", "rmse_seen", "delta1_seen")
_LIDAR: Final = (
    "abs_rel_static", "rmse_static", "delta1_static", "abs_rel_dynamic", "rmse_dynamic", "delta1_dynamic", "point_psnr_static",
    "point_abs_static", "point_psnr_dynamic", "point_abs_dynamic",
)  # fmt: skip
PROTOCOLS: Final[tuple[Protocol, ...]] = (
    Protocol("gap-1", "gap", "Single held-out frames", "gap-1", ("photo", "depth", "dynamic"), _GAP),
    Protocol("gap-3", "gap", "Blocks of 3 held-out frames", "gap-3", ("photo", "depth", "dynamic"), _GAP),
    Protocol("gap-5", "gap", "Blocks of 5 held-out frames", "gap-5", ("photo", "depth", "dynamic"), _GAP),
    Protocol("camera", "camera", "Cameras that the methods never saw", "camera", ("photo", "depth", "seen"), _CAMERA, every=2, pooled=True),
    Protocol("lidar", "lidar", "LiDAR beside the recorded path", "all", ("depth", "dynamic", "color"), _LIDAR, (2.0, -2.0, 3.0, -3.0)),
    Protocol("classes", "classes", "Classes of LiDAR points", "all", ("classes",), ("miou", "accuracy")),
)  # fmt: skip


@dataclass(frozen=True)
class HeldOut:
    """What a split hides of a log: ids of frames and sweeps, and facts for people. ``reason``: why the log cannot be split so."""

    frames: tuple[str, ...] = ()
    sweeps: tuple[str, ...] = ()
    facts: tuple[tuple[str, Any], ...] = ()
    reason: str = ""


def blocks_of(moments: int, length: int) -> tuple[range, ...]:
    """Blocks of ``length`` held-out moments, spread evenly among ``moments``; the first and the last one are shown.

    As many as leave ``SHOWN_BETWEEN`` shown moments before, between and after them, but at least one; none where it does not fit.
    """
    if moments < length + 2:
        return ()
    count = max(1, (moments - SHOWN_BETWEEN) // (length + SHOWN_BETWEEN))
    shown = moments - count * length
    starts = [round((i + 1) * shown / (count + 1)) + i * length for i in range(count)]
    return tuple(range(start, start + length) for start in starts)


def shown_cameras(scene: Scene, wanted: Sequence[str]) -> tuple[str, ...]:
    """The cameras that are shown by the split by cameras: those asked for, else ``front``, else the first."""
    return tuple(wanted) or (("front",) if "front" in scene.cameras else tuple(scene.cameras)[:1])


def first_camera(scene: Scene, wanted: Sequence[str]) -> str:
    """The camera of the views beside the recorded path."""
    return shown_cameras(scene, wanted)[0]


def held_out(scene: Scene, split: Split, wanted: Sequence[str]) -> HeldOut:
    """What a split hides of a scene; ``wanted`` are the cameras to show by the split by cameras (empty = the default)."""
    if split.by_camera:
        return _hidden_cameras(scene, shown_cameras(scene, wanted))
    if split.block:
        return _hidden_blocks(scene, split.block)
    return HeldOut()


def _hidden_cameras(scene: Scene, shown: Sequence[str]) -> HeldOut:
    hidden = [name for name in scene.cameras if name not in shown]
    frames = tuple(frame.id for frame in scene.frames if frame.view.camera.name in hidden)
    facts = (("shown_cameras", list(shown)), ("hidden_cameras", hidden), ("held_out_frames", len(frames)))
    return HeldOut(frames, (), facts, "" if frames else "the log has no camera besides those that are shown")


def _hidden_blocks(scene: Scene, length: int) -> HeldOut:
    """Moments are the times of the camera with the fewest frames; every frame and sweep belongs to the nearest one."""
    name = min((n for n in scene.cameras if scene.frames_of(n)), key=lambda n: len(scene.frames_of(n)))
    times = np.array([frame.view.time_s for frame in scene.frames_of(name)])
    blocks = blocks_of(len(times), length)
    if not blocks:
        return HeldOut(reason=f"its {len(times)} frames are too few for a block of {length} between shown ones")
    hidden = {moment for block in blocks for moment in block}
    is_hidden = lambda time_s: int(np.argmin(np.abs(times - time_s))) in hidden  # noqa: E731
    frames = tuple(frame.id for frame in scene.frames if is_hidden(frame.view.time_s))
    sweeps = tuple(sweep.id for sweep in scene.sweeps if is_hidden(sweep.time_s))
    facts = (
        ("moments", len(times)), ("blocks", [[block.start, block.stop - 1] for block in blocks]),
        ("held_out_frames", len(frames)), ("held_out_sweeps", len(sweeps)),
    )  # fmt: skip
    return HeldOut(frames, sweeps, facts)


def places_of(scene: Scene, held: HeldOut) -> tuple[Frame, ...]:
    """The held-out frames of a scene."""
    hidden = set(held.frames)
    return tuple(frame for frame in scene.frames if frame.id in hidden)
