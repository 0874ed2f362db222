"""The columns of ``mudg bench real``, and a method's values under a protocol.

A column adds up arrays of numbers over the views of a place (a camera, or a distance beside the path); its value is
read from the sum. A method's value on a log is the mean over its places; or, under a protocol that pools, the value of
the sum over all places.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import log, store
from mudg.base.devices import choose_device
from mudg.base.errors import InputError
from mudg.base.run_folder import RunDir
from mudg.base.types import Observation, Scene, View
from mudg.benchmarks.places import Protocol
from mudg.benchmarks.truth import Target, Targets, read_targets
from mudg.core import metrics
from mudg.core.lidar import DEPTH_LIMIT_M
from mudg.core.pictures import class_colors, depth_colors, error_image, resize_nearest, resize_rgb, to_bytes
from mudg.diffusion import model_files
from mudg.formats.exporters.video import jpeg_bytes
from mudg.networks.featnets import CodecFeatures, PerceptualDistance
from mudg.scene.observations import list_observation_sets, read_observations
from mudg.scene.read import read_scene
from mudg.scoring.score import evenly
from mudg.scoring.truth import SAME_PLACE_M, SAME_TIME_S, apart_m
from mudg.steps.outputs import Output

PERCEPTUAL_VIEWS: Final = 12
"""Views of each place at which the perceptual distance is computed, evenly spread."""
NONE: Final = "none"
"""In place of a number that there is not."""
_MOST_DB: Final = 100.0

Sum = NDArray[np.float64]
Sums = Mapping[str, Sum]


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A method's view beside its truth: colour f32[3, H, W] as the target's camera would record it, depth f32[1, H, W]
    metres (80 m where there is none), classes i64[H, W] or None; the photograph f32[3, H, W] or None; ``distance``:
    perceptual, or None at a view where it is not computed."""

    target: Target
    rgb: Tensor
    depth: Tensor | None
    semantics: Tensor | None
    photo: Tensor | None
    distance: Callable[[metrics.Pair], float | None] | None

    def mask(self, name: str) -> Tensor | None:
        """A mask bool[1, H, W] by the name of its map; ``upper``: the upper third of the image. None where the truth
        has no such map."""
        if name == "upper":
            height, width = self.rgb.shape[-2:]
            return (torch.arange(height) < height // 3)[None, :, None].expand(1, height, width)
        values = self.target.maps.get(name)
        return None if values is None else torch.from_numpy(values > 0)[None]

    def part(self, known: Tensor, name: str) -> Tensor:
        """The known pixels bool[1, H, W] of a part: all, or those that are dynamic, static or seen."""
        if not name:
            return known
        mask = self.mask("dynamic" if name == "static" else name)
        return torch.zeros_like(known) if mask is None else known & (~mask if name == "static" else mask)


Measure = Callable[[Sight], Sum | None]


@dataclass(frozen=True)
class Column:
    """A column: its heading, digits, and whether it is compared as a ratio, since lower is better.

    Args:
        of: what a view adds, or None where it has nothing to say. close: the value from the sum over views.
    """

    title: str
    digits: int
    of: Measure
    close: Callable[[Sum], float | None]
    ratio: bool = False

    def text(self, value: float | str) -> str:
        """A value as text."""
        return value if isinstance(value, str) else f"{value:.{self.digits}f}"

    def compared(self, value: Any, against: Any) -> float | None:
        """A value against another, as a ratio or a difference; None where either is no number."""
        if isinstance(value, str) or isinstance(against, str) or value is None or against is None:
            return None
        if self.ratio:
            return value / against if against else None
        return value - against

    def compared_text(self, value: Any, against: Any) -> str:
        """The comparison as text: ``x0.91`` or ``+0.72``; empty where there is none."""
        found = self.compared(value, against)
        return "" if found is None else f"x{found:.3f}" if self.ratio else f"{found:+.{self.digits}f}"


def _mean(total: Sum) -> float | None:
    return float(total[0] / total[1]) if total[1] else None


def _root(total: Sum) -> float | None:
    return float(math.sqrt(total[0] / total[1])) if total[1] else None


def _decibels(total: Sum) -> float | None:
    return min(_MOST_DB, -10.0 * math.log10(max(total[0] / total[1], 1e-12))) if total[1] else None


def _mean_iou(total: Sum) -> float | None:
    iou = metrics.iou_of(torch.from_numpy(total))
    return sum(iou.values()) / len(iou) if iou else None


def _accuracy(total: Sum) -> float | None:
    return float(np.trace(total[:, : metrics.CLASS_COUNT]) / total.sum()) if total.sum() else None


def _photo(compare: Callable[[Tensor, Tensor, Tensor | None], float], name: str = "") -> Measure:
    """A number per view from colours, on all pixels or those of a mask that covers at least a thousandth of the
    image."""

    def of(sight: Sight) -> Sum | None:
        mask = sight.mask(name) if name else None
        if sight.photo is None or (name and (mask is None or float(mask.float().mean()) < metrics.SMALLEST_SHARE)):
            return None
        return np.array([min(compare(sight.rgb, sight.photo, mask), _MOST_DB), 1.0])

    return of


def _perceptual(name: str = "") -> Measure:
    """The perceptual distance of a view; of the part under a mask, with the number of its pixels as weight."""

    def of(sight: Sight) -> Sum | None:
        mask = sight.mask(name) if name else None
        if sight.distance is None or sight.photo is None or (mask is not None and not bool(mask.any())):
            return None
        distance = sight.distance(metrics.Pair(sight.rgb, None, None, sight.photo, None, None, None, mask))
        weight = 1.0 if mask is None else float(mask.sum())
        return None if distance is None else np.array([distance * weight, weight])

    return of


def _summed(errors: Tensor) -> Sum:
    return np.array([float(errors.sum()), float(errors.numel())])


def _seen_color(sight: Sight) -> Sum | None:
    """The squared error of colour summed over the channels of the seen pixels."""
    mask = sight.mask("seen")
    if sight.photo is None or mask is None:
        return None
    return _summed((sight.rgb - sight.photo)[:, mask[0]].double().square())


def _depth(error: Callable[[Tensor, Tensor], Tensor], part: str = "") -> Measure:
    """An error summed over the pixels of a part that show a LiDAR point."""

    def of(sight: Sight) -> Sum | None:
        if sight.depth is None:
            return None
        true = torch.from_numpy(sight.target.maps["depth"])[None]
        chosen = sight.part(true > 0, part)
        return _summed(error(sight.depth[chosen].double(), true[chosen].double()))

    return of


def _point_color(error: Callable[[Tensor], Tensor], part: str) -> Measure:
    """An error of colour summed over channels and pixels of a part that show a point with a recorded colour."""

    def of(sight: Sight) -> Sum | None:
        colored = sight.mask("colored")
        if colored is None:
            return None
        true = torch.from_numpy(sight.target.maps["color"]).permute(2, 0, 1).float() / 255
        return _summed(error((sight.rgb.clamp(0, 1) - true)[:, sight.part(colored, part)[0]].double()))

    return of


def _confusion(sight: Sight) -> Sum | None:
    if sight.semantics is None or "classes" not in sight.target.maps:
        return None
    true = torch.from_numpy(sight.target.maps["classes"].astype(np.int64))
    return metrics.confusion(sight.semantics, true).double().numpy()


def _relative(made: Tensor, true: Tensor) -> Tensor:
    return (made - true).abs() / true


def _squared(made: Tensor, true: Tensor) -> Tensor:
    return (made - true) ** 2


def _within(made: Tensor, true: Tensor) -> Tensor:
    return (torch.maximum(made.clamp_min(1e-6) / true, true / made.clamp_min(1e-6)) < 1.25).double()


def _depth_columns(part: str) -> dict[str, Column]:
    return {
        f"abs_rel_{part}": Column(f"AbsRel, {part}", 4, _depth(_relative, part), _mean, ratio=True),
        f"rmse_{part}": Column(f"RMSE m, {part}", 2, _depth(_squared, part), _root, ratio=True),
        f"delta1_{part}": Column(f"delta1, {part}", 4, _depth(_within, part), _mean),
    }


def _point_columns(part: str) -> dict[str, Column]:
    return {
        f"point_psnr_{part}": Column(f"PSNR at points, {part}", 2, _point_color(torch.square, part), _decibels),
        f"point_abs_{part}": Column(
            f"colour error at points, {part}", 4, _point_color(torch.abs, part), _mean, ratio=True
        ),
    }


COLUMNS: Final[dict[str, Column]] = {
    "psnr": Column("PSNR dB", 2, _photo(metrics.psnr), _mean),
    "ssim": Column("SSIM", 3, _photo(metrics.ssim), _mean),
    "perceptual": Column("perceptual", 4, _perceptual(), _mean, ratio=True),
    "psnr_dynamic": Column("PSNR of dynamic objects", 2, _photo(metrics.psnr, "dynamic"), _mean),
    "psnr_upper": Column("PSNR, upper third", 2, _photo(metrics.psnr, "upper"), _mean),
    "psnr_seen": Column("PSNR dB, seen", 2, _seen_color, _decibels),
    "perceptual_seen": Column("perceptual, seen", 4, _perceptual("seen"), _mean, ratio=True),
    "abs_rel": Column("AbsRel", 4, _depth(_relative), _mean, ratio=True),
    **{name: column for part in ("seen", "static", "dynamic") for name, column in _depth_columns(part).items()},
    **{name: column for part in ("static", "dynamic") for name, column in _point_columns(part).items()},
    "miou": Column("mIoU", 3, _confusion, _mean_iou),
    "accuracy": Column("accuracy", 3, _confusion, _accuracy),
}
"""All columns by name; a protocol lists its own."""


# ---- a method's values ----


@functools.cache
def shipped_features(device: torch.device | None = None) -> CodecFeatures:
    """The network behind perceptual distances, the shipped codec, loaded once per process and device."""
    return CodecFeatures(model_files.load("embedded").codec).to(device or torch.device("cpu"))


class ScoreTargets(Output):
    """Score a method's views (folders of observations) of a log; writes its values and its pictures for the page."""

    verb_name = "bench real score"
    version, files = 2, ("metrics.json", "pictures/*.jpg")
    log: Path
    truth: Path
    views: Path
    protocol: Protocol
    device: str = "cpu"
    """Of the network behind the perceptual distance."""

    def key_settings(self) -> dict[str, Any]:
        return {
            "protocol": self.protocol.name,
            "columns": list(self.protocol.columns),
            "perceptual_views": PERCEPTUAL_VIEWS,
        }

    def make(self, work: RunDir) -> dict[str, Any]:
        scene, targets, finder, protocol = (
            read_scene(self.log),
            read_targets(self.truth),
            ViewFinder(self.views),
            self.protocol,
        )
        sampled = (
            _perceptual_views(targets) if any(name.startswith("perceptual") for name in protocol.columns) else set()
        )
        features = None
        if sampled:
            network = choose_device(self.device, "networks of the scores")
            features = PerceptualDistance(shipped_features(network), device=network)
        sums: dict[str, dict[str, Sum]] = {}
        with log.task(f"score {protocol.name}", len(targets)) as bar:
            for number in range(len(targets)):
                target = targets.load(number, scene)
                sight = sight_of(
                    target, finder.at(target.view), scene, protocol, features if number in sampled else None
                )
                _add(sums.setdefault(target.place, {}), {name: COLUMNS[name].of(sight) for name in protocol.columns})
                if number in targets.pictures:
                    picture = jpeg_bytes(_picture_of(sight, protocol), quality=80)
                    store.atomic_write(work.path / "pictures" / f"{number:06d}.jpg", picture)
                bar.advance()
        store.write_json(work.path / "metrics.json", values_of(protocol, sums))
        return {"views": len(targets)}


def _add(total: dict[str, Sum], part: Mapping[str, Sum | None]) -> None:
    for name, value in part.items():
        if value is not None:
            total[name] = total[name] + value if name in total else value


def _perceptual_views(targets: Targets) -> set[int]:
    """Numbers of the views at which the perceptual distance is computed."""
    by_place: dict[str, list[int]] = {}
    for number, record in enumerate(targets.records):
        by_place.setdefault(record["place"], []).append(number)
    return {number for own in by_place.values() for number in evenly(own, PERCEPTUAL_VIEWS)}


def values_of(protocol: Protocol, sums: Mapping[str, Sums]) -> dict[str, Any]:
    """Values by place, and their mean or that of all together, from the sums; a column without a number says so."""

    def closed(found: Sums) -> dict[str, float | str]:
        values = {name: COLUMNS[name].close(found[name]) if name in found else None for name in protocol.columns}
        return {name: NONE if value is None or math.isnan(value) else round(value, 6) for name, value in values.items()}

    places = {place: closed(found) for place, found in sums.items()}
    if not protocol.pooled:
        return {"mean": mean_values(list(places.values()), protocol.columns), "places": places}
    total: dict[str, Sum] = {}
    for part in sums.values():
        _add(total, part)
    return {"mean": closed(total), "places": places}


def mean_values(rows: list[dict[str, float | str]], columns: tuple[str, ...]) -> dict[str, float | str]:
    """Means by column over the rows that have a number."""
    numbers = {name: [value for row in rows if not isinstance(value := row[name], str)] for name in columns}
    return {name: round(sum(values) / len(values), 6) if values else NONE for name, values in numbers.items()}


def sight_of(
    target: Target,
    seen: Observation,
    scene: Scene,
    protocol: Protocol,
    distance: Callable[[metrics.Pair], float | None] | None,
) -> Sight:
    """A method's view brought to the size and the colours of its target."""
    height, width = target.view.camera.height, target.view.camera.width
    rgb = resize_rgb(seen.rgb, height, width)
    if target.color_map.pairs:
        gain, offset = (
            torch.tensor(values).view(3, 1, 1) for values in (target.color_map.gain, target.color_map.offset)
        )
        rgb = (rgb * gain + offset).clamp(0, 1)
    depth = None
    if seen.depth is not None:
        depth = resize_nearest(seen.depth, height, width)
        given = torch.isfinite(depth) & (depth > 0)
        depth = torch.where(given, depth, DEPTH_LIMIT_M).clamp(max=DEPTH_LIMIT_M)
    semantics = None if seen.semantics is None else resize_nearest(seen.semantics, height, width)
    return Sight(target, rgb, depth, semantics, target.photo(scene) if "photo" in protocol.maps else None, distance)


class ViewFinder:
    """Finds the view of a method by camera, time and position."""

    def __init__(self, views: Path) -> None:
        self._folder = views
        self._sets = [read_observations(path) for path in list_observation_sets(views).values()]

    def at(self, view: View) -> Observation:
        """What the method shows there. InputError if there is no such view."""
        for views in self._sets:
            for index, own in enumerate(views.views):
                same = own.camera.name == view.camera.name and abs(own.time_s - view.time_s) <= SAME_TIME_S
                if same and apart_m(own, view) <= SAME_PLACE_M:
                    return views[index]
        raise InputError(
            "a method lacks a view that is scored",
            where=str(self._folder),
            expected=f"camera {view.camera.name} at {view.time_s:.3f} s",
        )


def _picture_of(sight: Sight, protocol: Protocol) -> NDArray[np.uint8]:
    """What the page shows of a method: colour above its error or, without a photograph, above its depth; or classes."""
    blank = np.full((*sight.rgb.shape[-2:], 3), 24, np.uint8)
    if "classes" in protocol.maps:
        return blank if sight.semantics is None else class_colors(sight.semantics.numpy().astype(np.uint8))
    if sight.photo is not None:
        return np.vstack([to_bytes(sight.rgb), error_image(sight.rgb, sight.photo)])
    return np.vstack([to_bytes(sight.rgb), blank if sight.depth is None else depth_colors(sight.depth[0].numpy())])
