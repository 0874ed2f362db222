"""Metrics of views as small accumulators over a trajectory. A metric says what it measures of one view (``source``, a
pure function that threads may call), adds that, and its ``value()`` is read once at the end. What a method did not
produce stays None, and nothing is ever reported as zero for want of data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry, palette
from mudg.base.errors import InputError
from mudg.base.palette import CLASSES
from mudg.base.types import Track, View
from mudg.core import native_ops, street_scores
from mudg.core.lidar import PointTruth
from mudg.core.losses import ssim_map
from mudg.core.street_scores import VisibleAgent

# what is known of a view beside its true image: worked out once, and read by the metrics of every method --------------


@dataclass(frozen=True, slots=True, eq=False)
class LaneFacts:
    """Road markings of a view: where they are looked for, where they are, and the ``band`` around them; colours
    ``reference`` f32[3, H, W] in [0, 1] of the true image, or of the recorded one carried over by the ground plane.
    ``exact``: ``marking`` is the truth, not what a rule found in the reference."""

    road: NDArray[np.bool_]
    marking: NDArray[np.bool_]
    band: NDArray[np.bool_]
    reference: NDArray[np.float32]
    exact: bool


@dataclass(frozen=True, slots=True, eq=False)
class ViewFacts:
    """What LiDAR points say of a view, vehicles that count, markings, and the number ``instance`` i32[H, W] of the
    object that each pixel shows (0 = none); each None where it is not known."""

    points: PointTruth | None = None
    agents: tuple[VisibleAgent, ...] | None = None
    lanes: LaneFacts | None = None
    instance: NDArray[np.int32] | None = None


# flicker ------------------------------------------------------------------------------------------
# How restless a video is: what static surfaces change from frame to frame, against what they change in the truth.


WHOLE_PIXELS: Final = 2_500_000
"""Images of up to this many pixels are carried in one piece, larger ones in bands of rows."""
BAND_PIXELS: Final = 600_000
MOVABLE = tuple(palette.ID[n] for n in ("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle"))


def flicker(generated: Tensor, truth: Tensor, frames: Sequence[TrueFrame]) -> float:
    """Change of static surfaces from one frame to the next in `generated`, over that in `truth` (1 = as steady as the
    truth), both f32[T,3,H,W].

    Every pixel of a class that cannot move is carried by its true depth into the next frame and compared with what is
    there (bilinear), if the same surface is seen there (depths within 3 %). NaN for one frame or without such pixels.
    """
    motions = list(map(pixel_motion, frames[:-1], frames[1:]))
    made, true = (
        sum(change(rgb[t], rgb[t + 1], where) for t, where in enumerate(motions)) for rgb in (generated, truth)
    )
    return made / true if true > 0 else math.nan


@dataclass(frozen=True)
class TrueFrame:
    """Truth of one frame: its view, depth f32[1,H,W] metres, and ids i64[H,W]."""

    view: View
    depth: Tensor
    ids: Tensor


@dataclass(frozen=True)
class PixelMotion:
    """Where each pixel of a frame lies in the next one: ``there`` f32[1,H,W,2] in [-1, 1] as `grid_sample` takes it;
    ``same`` bool[H,W]: static, and the same surface is seen there."""

    there: Tensor
    same: Tensor


def pixel_motion(
    frame: TrueFrame, following: TrueFrame, moved: Mapping[int, Tensor] | None = None, instance: Tensor | None = None
) -> PixelMotion:
    """Carry every pixel of a frame by its depth into the following one. ``moved``: how rigid objects move in the world
    between the two, f64[4, 4] by their number in ``instance`` i64[H, W] of the first frame; their pixels are carried
    with them and count as static ones do."""
    height, width = frame.ids.shape
    found = [_motion_of_rows(frame, following, moved, instance, rows) for rows in _bands(height, width)]
    if len(found) == 1:
        return found[0]
    return PixelMotion(torch.cat([part.there for part in found], 1), torch.cat([part.same for part in found]))


def _bands(height: int, width: int) -> list[range]:
    """Rows of an image in pieces that are worked on one after the other."""
    count = height if height * width <= WHOLE_PIXELS else max(1, BAND_PIXELS // width)
    return [range(first, min(height, first + count)) for first in range(0, height, count)]


def _motion_of_rows(
    whole: TrueFrame, following: TrueFrame, moved: Mapping[int, Tensor] | None, instance: Tensor | None, chosen: range
) -> PixelMotion:
    """``pixel_motion`` of some rows of the frame."""
    (height, width), rows_of = whole.ids.shape, slice(chosen.start, chosen.stop)
    z, ids = whole.depth[0, rows_of], whole.ids[rows_of]
    rows, columns = torch.meshgrid(
        torch.arange(chosen.start, chosen.stop) + 0.5, torch.arange(width) + 0.5, indexing="ij"
    )
    near = z < 90.0
    static = ~torch.isin(ids, torch.tensor(MOVABLE)) & near
    ray_x, ray_y = geometry.pinhole_ray(whole.view.camera.intrinsics, columns, rows)
    points = torch.stack([ray_x * z, ray_y * z, z, torch.ones_like(z)])
    there_from_world, world_from_here = (
        torch.from_numpy(pose.copy()) for pose in (following.view.cam_from_world, whole.view.world_from_cam)
    )
    carried = torch.einsum("ij,jhw->ihw", (there_from_world @ world_from_here).float(), points)
    if moved and instance is not None:
        instance = instance[rows_of]
        for number in instance.unique().tolist():
            if number in moved:
                own = instance == number
                carried[:, own] = (there_from_world @ moved[number] @ world_from_here).float() @ points[:, own]
                static = static | (own & near)
    x, y, ahead, _ = carried
    u, v = geometry.pinhole(following.view.camera.intrinsics, x, y, ahead)
    there = torch.stack([u * (2 / width) - 1, v * (2 / height) - 1], -1)[None]
    within = (there.abs() < 1).all(-1)[0] & (ahead > 0.5)
    depth_there = _sample_at(following.depth, there, "nearest")[0]
    return PixelMotion(there, within & static & ((depth_there / ahead - 1).abs() < 0.03))


def change(frame: Tensor, following: Tensor, where: PixelMotion) -> float:
    """Summed absolute change of colours f32[3,H,W] from a frame to the following one, over the pixels in
    ``where.same``."""
    total = 0.0
    for band in _bands(*where.same.shape):
        rows = slice(band.start, band.stop)
        apart = (_sample_at(following, where.there[:, rows], "bilinear") - frame[:, rows]).abs().mean(0)
        total += float(apart[where.same[rows]].double().sum())
    return total


def _sample_at(image: Tensor, there: Tensor, mode: str) -> Tensor:
    return torch.nn.functional.grid_sample(image[None], there, mode=mode, align_corners=False)[0]


# metrics ------------------------------------------------------------------------------------------


CLASS_COUNT: Final = len(CLASSES)
PIECE_VALUES: Final = 2_500_000
SMALLEST_SHARE: Final = 1e-3
"""Masks of dynamic objects that cover less of an image than this do not count: a handful of pixels has no PSNR to speak
of."""


def pieces_of(values: Tensor, channels: int = 1) -> Iterator[Tensor]:
    """All values of a tensor, flat: whole for images of up to 2.5 million pixels, else in pieces. What is worked out in
    double precision would fill the memory at large sizes. ``channels``: values per pixel."""
    if values.numel() <= PIECE_VALUES * channels:
        yield values.reshape(-1)
        return
    count = max(1, PIECE_VALUES // values[0].numel())
    for part in values.split(count):
        yield from pieces_of(part[0] if len(part) == 1 else part)


def psnr(prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of images ``[C, H, W]`` in [0, 1], the prediction clamped to it: from the mean
    squared error over all values in ``mask`` (bool ``[1, H, W]``). Infinity for equal images, NaN when nothing
    counts."""
    if mask is not None and not bool(mask.all()):
        chosen = mask.expand_as(truth)
        prediction, truth = prediction[chosen], truth[chosen]
    pieces = zip(pieces_of(prediction, 3), pieces_of(truth, 3), strict=True)
    squared = sum(float(((made.clamp(0, 1) - true).double() ** 2).sum()) for made, true in pieces)
    if truth.numel() == 0:
        return math.nan
    return math.inf if squared == 0 else -10.0 * math.log10(squared / truth.numel())


def ssim(prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Structural similarity (Wang 2004: 11x11 Gaussian window, sigma 1.5, C1 = 0.01^2, C2 = 0.03^2), zero padding.

    ``[C, H, W]`` in [0, 1]; mean over channels and over the pixels in ``mask`` (bool ``[1, H, W]``). NaN if none.
    """
    if prediction.numel() == 0:
        return math.nan
    if mask is None or bool(mask.all()):
        return 1.0 - float(native_ops.photometric(prediction.clamp(0, 1), truth, 1.0))
    values = ssim_map(prediction.clamp(0, 1), truth)
    values = values[mask.expand_as(values)]
    return float(values.double().mean()) if values.numel() else math.nan


@dataclass(frozen=True)
class DepthErrors:
    """Depth errors over the pixels that count: mean |d-t|/t, root mean square error in metres, share within 1.25x."""

    abs_rel: float
    rmse_m: float
    delta1: float
    pixels: int


def depth_errors(prediction_m: Tensor, truth_m: Tensor, mask: Tensor) -> DepthErrors:
    """Compare depth maps ``[1, H, W]`` (camera z, metres) where ``mask`` is set and the truth is positive and finite.
    InputError: a counted prediction is not finite."""
    counted = mask & torch.isfinite(truth_m) & (truth_m > 0)
    predicted_m, true_m = prediction_m[counted], truth_m[counted]
    pixels = predicted_m.numel()
    if pixels == 0:
        return DepthErrors(math.nan, math.nan, math.nan, 0)
    if not torch.isfinite(predicted_m).all():
        raise InputError("a predicted depth is not finite where truth exists", expected="finite metres")
    relative, squared, within = 0.0, 0.0, 0
    for made, given in zip(pieces_of(predicted_m), pieces_of(true_m), strict=True):
        predicted, true = made.double(), given.double()
        error = (predicted - true).abs()
        ratio = torch.maximum(predicted.clamp_min(1e-6) / true, true / predicted.clamp_min(1e-6))
        relative, squared = relative + float((error / true).sum()), squared + float((error**2).sum())
        within += int((ratio < 1.25).sum())
    return DepthErrors(relative / pixels, math.sqrt(squared / pixels), within / pixels, pixels)


def confusion(prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Confusion counts i64[19, 20] (row = truth, column = prediction) of class ids ``[H, W]`` where ``mask`` is set;
    truth 255 is not counted. The last column counts predictions outside the 19 classes, which are wrong."""
    allowed = torch.ones_like(truth, dtype=torch.bool) if mask is None else mask.reshape(truth.shape)
    counts = torch.zeros(CLASS_COUNT * (CLASS_COUNT + 1), dtype=torch.int64)
    for given, made, chosen in zip(pieces_of(truth), pieces_of(prediction), pieces_of(allowed), strict=True):
        true, predicted = given.long(), made.long()
        counted = chosen & (true >= 0) & (true < CLASS_COUNT)
        predicted = torch.where((predicted >= 0) & (predicted < CLASS_COUNT), predicted, CLASS_COUNT)
        index = true[counted] * (CLASS_COUNT + 1) + predicted[counted]
        counts += torch.bincount(index, minlength=len(counts))
    return counts.reshape(CLASS_COUNT, CLASS_COUNT + 1)


def iou_of(counts: Tensor) -> dict[str, float]:
    """Intersection over union per class that occurs in the truth, from pooled confusion counts i64[19, 20]."""
    hit = counts[:, :CLASS_COUNT].diagonal().double()
    true, predicted = counts.sum(1).double(), counts[:, :CLASS_COUNT].sum(0).double()
    union = true + predicted - hit
    return {CLASSES[i]: float(hit[i] / union[i]) for i in range(CLASS_COUNT) if true[i] > 0}


# ---- accumulators over a trajectory --------------------------------------------------------------


@dataclass(frozen=True)
class Pair:
    """One predicted view with its truth. Absent modalities are None.

    rgb ``[3, H, W]`` in [0, 1]; depth ``[1, H, W]`` m; semantics i64 ``[H, W]``; truth_depth_valid bool ``[1, H, W]``;
    mask bool ``[1, H, W]``: pixels that count at all (outside the ego vehicle); moving bool ``[1, H, W]``: true pixels
    of dynamic objects, where they are known; view: camera and pose of both; facts: what is known beside the true image.
    """

    rgb: Tensor | None
    depth: Tensor | None
    semantics: Tensor | None
    truth_rgb: Tensor | None
    truth_depth: Tensor | None
    truth_depth_valid: Tensor | None
    truth_semantics: Tensor | None
    mask: Tensor | None = None
    moving: Tensor | None = None
    view: View | None = None
    facts: ViewFacts = ViewFacts()


class Metric(Protocol):
    """Accumulates over the pairs of one trajectory."""

    @property
    def source(self) -> Callable[[Pair], Any]:
        """What it measures of a view: a pure function."""
        ...

    def add(self, measured: Any) -> None:
        """Add one view, as ``source`` measured it. Views come in order."""
        ...

    def value(self) -> float | None:
        """The metric over all views so far, or None if no view had what it needs."""
        ...


def measure(pair: Pair, metrics: Mapping[str, Metric]) -> dict[str, Any]:
    """What the named metrics measure of one view, ready for ``Metric.add``; each source is asked once."""
    found: dict[Callable[[Pair], Any], Any] = {}
    for metric in metrics.values():
        if metric.source not in found:
            found[metric.source] = metric.source(pair)
    return {name: found[metric.source] for name, metric in metrics.items()}


class Pooled:
    """A number over all views: the sum of what they add, over what they count for. ``source``: what is measured of a
    view; ``share``: sum and count that a measurement adds (None: it is both); ``finish``: the number from their
    ratio."""

    def __init__(
        self,
        source: Callable[[Pair], Any],
        share: Callable[[Any], tuple[float, float]] | None = None,
        finish: Callable[[float], float] = float,
    ) -> None:
        self.source, self._share, self._finish = source, share, finish
        self._sum, self._count = 0.0, 0.0

    def add(self, measured: Any) -> None:
        """Add one view; None does not count."""
        if measured is not None:
            total, count = measured if self._share is None else self._share(measured)
            self._sum += total
            self._count += count

    def value(self) -> float | None:
        """The number, or None where nothing counted."""
        return self._finish(self._sum / self._count) if self._count > 0 else None


def frame_mean(source: Callable[[Pair], float | None]) -> Pooled:
    """Mean over views of a number of each; None and NaN (nothing to compare) do not count. Equal images give infinite
    dB, taken as 100: that keeps the mean readable."""
    return Pooled(source, lambda number: (0.0, 0) if math.isnan(number) else (min(number, 100.0), 1))


def _depths(pair: Pair) -> DepthErrors | None:
    if pair.depth is None or pair.truth_depth is None:
        return None
    mask = torch.ones_like(pair.truth_depth, dtype=torch.bool) if pair.mask is None else pair.mask
    if pair.truth_depth_valid is not None:
        mask = mask & pair.truth_depth_valid
    return depth_errors(pair.depth, pair.truth_depth, mask)


def _classes(pair: Pair) -> Tensor | None:
    if pair.semantics is None or pair.truth_semantics is None:
        return None
    return confusion(pair.semantics, pair.truth_semantics, pair.mask)


def depth_error(
    field: Literal["abs_rel", "rmse_m", "delta1"], source: Callable[[Pair], DepthErrors | None] = _depths
) -> Pooled:
    """A depth error pooled over all pixels of the trajectory."""

    def share(errors: DepthErrors) -> tuple[float, float]:
        number = errors.rmse_m**2 if field == "rmse_m" else getattr(errors, field)
        return (number * errors.pixels, errors.pixels) if errors.pixels else (0.0, 0)

    return Pooled(source, share, math.sqrt if field == "rmse_m" else float)


class Neighbours(Pooled):
    """A number over all pairs of neighbouring views. Wants every view of a trajectory in order; ``share`` takes two."""

    def __init__(self, source: Callable[[Pair], Any], share: Callable[[Any], tuple[float, float]]) -> None:
        super().__init__(source, share)
        self._before: Any = None

    def add(self, measured: Any) -> None:
        """Add the next view."""
        before, self._before = self._before, measured
        super().add(None if before is None or measured is None else (before, measured))


class Segmentation:
    """Mean IoU over the classes present in the truth, or pixel accuracy, from one pooled confusion matrix."""

    def __init__(self, field: Literal["miou", "accuracy"], source: Callable[[Pair], Tensor | None] = _classes) -> None:
        self._field, self.source = field, source
        self.counts = torch.zeros(CLASS_COUNT, CLASS_COUNT + 1, dtype=torch.int64)

    def add(self, measured: Tensor | None) -> None:
        """Add the confusion counts of one view; None does not count."""
        if measured is not None:
            self.counts += measured

    def value(self) -> float | None:
        """Pooled value in [0, 1], or None."""
        total = int(self.counts.sum())
        if not total:
            return None
        if self._field == "accuracy":
            return float(self.counts[:, :CLASS_COUNT].diagonal().sum()) / total
        iou = iou_of(self.counts)
        return sum(iou.values()) / len(iou)


class ExactMotion:
    """Where surfaces of one view are in the next: by true depth and poses, vehicles by their boxes. The last answer is
    kept: method after method is held against the same two views. ``tracks``: number in the instance map and track of
    every vehicle that is followed; others do not count."""

    def __init__(self, tracks: Sequence[tuple[int, Track]] = ()) -> None:
        self._tracks = tracks
        self._of: tuple[Tensor | None, Tensor | None] = (None, None)
        self._motion: PixelMotion | None = None
        self._true_change: float | None = None

    def between(self, before: Pair, pair: Pair) -> PixelMotion | None:
        """For two neighbouring views with exact depth and classes; else None."""
        if self._of[0] is not before.truth_depth or self._of[1] is not pair.truth_depth:
            self._of, self._true_change = (before.truth_depth, pair.truth_depth), None
            self._motion = self._found(before, pair)
        return self._motion

    def true_change(self, before: Pair, pair: Pair) -> float | None:
        """Summed absolute change of these surfaces in the truth; None where it is not known."""
        motion, first, last = self.between(before, pair), before.truth_rgb, pair.truth_rgb
        if motion is None or first is None or last is None:
            return None
        if self._true_change is None:
            self._true_change = change(first, last, motion)
        return self._true_change

    def _found(self, before: Pair, pair: Pair) -> PixelMotion | None:
        frames = []
        for one in (before, pair):
            if one.view is None or one.truth_depth is None or one.truth_semantics is None:
                return None
            known = torch.isfinite(one.truth_depth) & (one.truth_depth > 0)
            frames.append(TrueFrame(one.view, torch.where(known, one.truth_depth, 1000.0), one.truth_semantics))
        instance = before.facts.instance
        if instance is None:
            return pixel_motion(frames[0], frames[1])
        moved: dict[int, Tensor] = {}
        for number, track in self._tracks:
            first, last = (track.pose_at(frame.view.time_s) for frame in frames)
            if first is not None and last is not None:
                moved[number] = torch.from_numpy(last @ geometry.invert(first))
        return pixel_motion(frames[0], frames[1], moved, torch.from_numpy(instance.astype(np.int64)))


def change_of(motion: ExactMotion, per: Callable[[Pair, Pair, PixelMotion], float | None]) -> Neighbours:
    """Summed absolute change of surfaces from each view to the next, over ``per``, pooled over the trajectory."""

    def share(pairs: tuple[Pair, Pair]) -> tuple[float, float]:
        before, pair = pairs
        where = motion.between(before, pair)
        if before.rgb is None or pair.rgb is None or where is None or (count := per(before, pair, where)) is None:
            return 0.0, 0
        return change(before.rgb.clamp(0, 1), pair.rgb.clamp(0, 1), where), count

    return Neighbours(neighbour_of, share)


def flicker_over_truth(motion: ExactMotion | None = None) -> Neighbours:
    """Change of static surfaces over that in the truth: 1 = as steady as the truth. motion: shared by the metrics of
    several methods on the same trajectory."""
    known = motion or ExactMotion()
    return change_of(known, lambda before, pair, _: known.true_change(before, pair))


def neighbour_of(pair: Pair) -> Pair:
    """What is kept of a view until the next one comes, to follow surfaces from one to the other: made and true colours,
    true depth and classes, and the instances. The rest would fill the memory at large sizes."""
    facts = ViewFacts(instance=pair.facts.instance)
    return replace(pair, depth=None, semantics=None, truth_depth_valid=None, mask=None, moving=None, facts=facts)


# ---- LiDAR points, vehicles and markings ---------------------------------------------------------


def decibels(source: Callable[[Pair], tuple[float, int] | None]) -> Pooled:
    """PSNR, at most 100 dB, from squared errors pooled over all views: ``source`` gives their sum and number."""
    return Pooled(source, finish=lambda mean: min(100.0, -10 * math.log10(max(mean, 1e-12))))


def _squares(apart: Tensor) -> tuple[float, int]:
    return float(apart.double().square().sum()), apart.numel()


def _point_depths(pair: Pair) -> DepthErrors | None:
    points = pair.facts.points
    if points is None or pair.depth is None:
        return None
    true = torch.from_numpy(points.depth)[None]
    return depth_errors(pair.depth, true, true > 0 if pair.mask is None else (true > 0) & pair.mask)


def _point_colors(pair: Pair) -> tuple[float, int] | None:
    points = pair.facts.points
    if points is None or pair.rgb is None or not points.colored.any():
        return None
    chosen = torch.from_numpy((points.depth > 0) & points.colored)
    chosen = chosen if pair.mask is None else chosen & pair.mask[0]
    true = torch.from_numpy(points.color[chosen.numpy()].T).float() / 255
    return _squares(pair.rgb[:, chosen].clamp(0, 1) - true)


def _point_classes(pair: Pair) -> Tensor | None:
    points = pair.facts.points
    if points is None or pair.semantics is None:
        return None
    true = torch.from_numpy(np.where(points.depth > 0, points.classes, 255).astype(np.int64))
    return confusion(pair.semantics, true, pair.mask)


def _agents(pair: Pair) -> tuple[float, int] | None:
    """Sum of ``street_scores.agent_ious`` and number of vehicles."""
    agents = pair.facts.agents
    if agents is None or pair.semantics is None:
        return None
    ious = street_scores.agent_ious(agents, pair.semantics.numpy())
    return sum(ious), len(ious)


def _markings(pair: Pair) -> tuple[float, float] | None:
    """Tolerant hits and union, in pixels, of the markings that a fixed rule finds with the exact ones."""
    lanes = pair.facts.lanes
    if lanes is None or pair.rgb is None or not lanes.exact:
        return None
    return street_scores.tolerant_iou(street_scores.bright_stripes(pair.rgb.numpy(), lanes.road), lanes.marking)


def _lane_edges(pair: Pair) -> float | None:
    lanes = pair.facts.lanes
    if lanes is None or pair.rgb is None or not lanes.band.any():
        return None
    rows = street_scores.rows_of(lanes.band, 1)
    made, true = (
        street_scores.edges_of(street_scores.gray_of(rgb[:, rows])) for rgb in (pair.rgb.numpy(), lanes.reference)
    )
    return street_scores.edge_correlation(made, true, lanes.band[rows])


def _lane_colors(pair: Pair) -> tuple[float, int] | None:
    lanes = pair.facts.lanes
    if lanes is None or pair.rgb is None or not lanes.band.any():
        return None
    band = torch.from_numpy(lanes.band)
    return _squares(pair.rgb[:, band].clamp(0, 1) - torch.from_numpy(lanes.reference)[:, band])


# ---- neighbouring views --------------------------------------------------------------------------


def temporal_flickering() -> Neighbours:
    """(255 - mean |frame - next frame|) / 255 on 8 bits, mean over neighbouring frames: VBench's measure, meant for
    videos that stand still. A moving camera lowers it, also that of the truth; a blurred video has a high one."""

    def in_bytes(pair: Pair) -> Tensor | None:
        return None if pair.rgb is None else torch.stack([(c.clamp(0, 1) * 255).round().byte() for c in pair.rgb])

    def steadiness(frames: tuple[Tensor, Tensor]) -> tuple[float, int]:
        before, frame = frames
        if before.shape != frame.shape:
            return 0.0, 0
        total = sum(int((a.short() - b).abs().sum()) for a, b in zip(before, frame, strict=True))
        return (255.0 - total / frame.numel()) / 255.0, 1

    return Neighbours(in_bytes, steadiness)


def warp_error(motion: ExactMotion) -> Neighbours:
    """Mean absolute difference of colour, of 1, between a surface in one frame and the same surface in the next,
    pooled; surfaces that are hidden in either frame do not count. motion: shared by the methods on a trajectory."""
    return change_of(motion, lambda _before, _pair, where: int(where.same.sum()))


# ---- the table -----------------------------------------------------------------------------------


def _of_colors(compare: Callable[[Tensor, Tensor, Tensor | None], float]) -> Pooled:
    def source(pair: Pair) -> float | None:
        return None if pair.rgb is None or pair.truth_rgb is None else compare(pair.rgb, pair.truth_rgb, pair.mask)

    return frame_mean(source)


def _psnr_of_dynamic(pair: Pair) -> float | None:
    if pair.rgb is None or pair.truth_rgb is None or pair.moving is None:
        return None
    counted = pair.moving if pair.mask is None else pair.moving & pair.mask
    return psnr(pair.rgb, pair.truth_rgb, counted) if float(counted.float().mean()) >= SMALLEST_SHARE else None


@dataclass(frozen=True)
class MetricRow:
    """One row of the table: what it needs, which way is better (one: nearest to 1), how to build it (None: a caller
    does, with a motion, weights or detections)."""

    title: str
    unit: str
    needs: tuple[str, ...]
    better: Literal["higher", "lower", "one"]
    build: Callable[[], Metric] | None


METRICS: Final[dict[str, MetricRow]] = {
    "psnr": MetricRow("PSNR", "dB", ("rgb",), "higher", lambda: _of_colors(psnr)),
    "ssim": MetricRow("SSIM", "", ("rgb",), "higher", lambda: _of_colors(ssim)),
    "psnr_movers": MetricRow(
        "PSNR of dynamic objects", "dB", ("dynamic objects", "rgb"), "higher", lambda: frame_mean(_psnr_of_dynamic)
    ),
    "perceptual": MetricRow("perceptual", "", ("rgb", "features of the shipped codec"), "lower", None),
    "flicker": MetricRow("flicker", "", ("every frame", "rgb"), "one", flicker_over_truth),
    "warp_error": MetricRow("warp error", "", ("every frame", "rgb"), "lower", None),
    "temporal_flickering": MetricRow("temporal flickering", "", ("views",), "higher", temporal_flickering),
    "lpips": MetricRow("LPIPS", "", ("rgb", "LPIPS weights"), "lower", None),
    "lpips_vgg": MetricRow("LPIPS (VGG)", "", ("rgb", "LPIPS weights"), "lower", None),
    "fid": MetricRow("FID", "", ("rgb", "Inception weights"), "lower", None),
    "kid": MetricRow("KID", "", ("rgb", "Inception weights"), "lower", None),
    "fvd": MetricRow("FVD", "", ("rgb", "I3D weights"), "lower", None),
    "abs_rel": MetricRow("AbsRel", "", ("depth",), "lower", lambda: depth_error("abs_rel")),
    "rmse_m": MetricRow("RMSE", "m", ("depth",), "lower", lambda: depth_error("rmse_m")),
    "delta1": MetricRow("delta < 1.25", "", ("depth",), "higher", lambda: depth_error("delta1")),
    "lidar_abs_rel": MetricRow(
        "AbsRel at points", "", ("LiDAR points",), "lower", lambda: depth_error("abs_rel", _point_depths)
    ),
    "lidar_rmse_m": MetricRow(
        "RMSE at points", "m", ("LiDAR points",), "lower", lambda: depth_error("rmse_m", _point_depths)
    ),
    "lidar_delta1": MetricRow(
        "delta < 1.25 at points", "", ("LiDAR points",), "higher", lambda: depth_error("delta1", _point_depths)
    ),
    "lidar_psnr": MetricRow("PSNR at points", "dB", ("LiDAR points",), "higher", lambda: decibels(_point_colors)),
    "miou": MetricRow("mIoU", "", ("semantics",), "higher", lambda: Segmentation("miou")),
    "accuracy": MetricRow("pixel accuracy", "", ("semantics",), "higher", lambda: Segmentation("accuracy")),
    "agreement": MetricRow(
        "agreement of classes", "", ("classes of points",), "higher", lambda: Segmentation("miou", _point_classes)
    ),
    "agent_iou": MetricRow("agent IoU", "", ("exact vehicles",), "higher", lambda: Pooled(_agents)),
    "lane_iou": MetricRow("lane IoU", "", ("exact markings",), "higher", lambda: Pooled(_markings)),
    "lane_correlation": MetricRow("lane gradients", "", ("markings",), "higher", lambda: frame_mean(_lane_edges)),
    "lane_psnr": MetricRow("PSNR of lanes", "dB", ("markings",), "higher", lambda: decibels(_lane_colors)),
    "nta_iou": MetricRow("NTA-IoU", "", ("boxes", "detected boxes"), "higher", None),
    "ntl_iou": MetricRow("NTL-IoU", "", ("lane lines", "detected lanes"), "higher", None),
}


EVERY_VIEW: Final = ("flicker", "temporal_flickering", "warp_error")
"""Metrics that want all views of a trajectory, in order."""
FACTS: Final = (
    *("lidar_abs_rel", "lidar_rmse_m", "lidar_delta1", "lidar_psnr", "agreement", "agent_iou"),
    *("lane_iou", "lane_correlation", "lane_psnr", "temporal_flickering"),
)
"""Metrics that are computed from ``ViewFacts`` or from neighbouring views, for true images, too; the warp error needs a
motion besides."""


def build_facts(motion: ExactMotion) -> dict[str, Metric]:
    """A fresh accumulator for every metric of ``FACTS``, and for the warp error."""
    built = {name: build() for name in FACTS if (build := METRICS[name].build) is not None}
    return {**built, "warp_error": warp_error(motion)}


def build_all(
    distances: Mapping[str, Callable[[Pair], float | None]] | None = None,
    motion: ExactMotion | None = None,
    more: Mapping[str, Metric] | None = None,
) -> dict[str, Metric]:
    """A fresh accumulator for every metric that can be computed. ``distances``: what computes a row that needs weights;
    ``motion``: shared by several methods on one trajectory; ``more``: further accumulators, such as ``build_facts``."""
    own = {name: row.build() for name, row in METRICS.items() if row.build is not None and name not in FACTS}
    compared = {name: frame_mean(of) for name, of in (distances or {}).items()}
    return {**own, "flicker": flicker_over_truth(motion), **(more or {}), **compared}


def results(metrics: Mapping[str, Metric]) -> dict[str, float | str]:
    """Values of all rows of ``METRICS``: a number, "not produced" (input absent) or "not computed" (weights absent)."""
    values = {name: metrics[name].value() if name in metrics else "not computed" for name in METRICS}
    return {name: "not produced" if value is None else value for name, value in values.items()}
