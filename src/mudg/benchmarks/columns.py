"""The columns of ``mudg bench real``: the truth (targets.json, and maps per view: depth, seen, dynamic, color,
colored), made once per log and protocol, and a method's values. A column adds up numbers over the views of a place (a
camera, or a distance beside the path); its value is read from the sum. A log's value is the mean over its places, or
pooled."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
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
from mudg.base.types import ColorMap, Frame, Observation, Scene, View
from mudg.benchmarks.places import Protocol
from mudg.core import calibration, lidar, metrics, trajectory
from mudg.core.fusion import STATIC
from mudg.core.lidar import DEPTH_LIMIT_M, OwnedPoints, ShownFrame
from mudg.core.pictures import resize_nearest, resize_rgb
from mudg.diffusion import model_files
from mudg.labels.inputs import box_outline
from mudg.networks.featnets import CodecFeatures, PerceptualDistance
from mudg.scene.observations import list_observation_sets, read_observations
from mudg.scene.read import read_image, read_scene
from mudg.scoring import truth
from mudg.scoring.score import evenly
from mudg.scoring.truth import SAME_PLACE_M, SAME_TIME_S, LogPoints, apart_m
from mudg.steps.engine import Output

LEAST_SEEN: Final = 0.05
"""Cameras of whose pixels the shown cameras saw less than this share are left out."""
LEAST_POINTS: Final = 10
"""A dynamic object counts in a view that shows at least this many of its LiDAR points."""


@dataclass(frozen=True)
class Targets:
    """All views of a log under a protocol; ``reason`` says why there are none."""

    folder: Path
    records: tuple[Mapping[str, Any], ...]
    color_maps: Mapping[str, ColorMap]
    facts: Mapping[str, Any]
    reason: str

    def sight(
        self, number: int, scene: Scene, views: ViewFinder, protocol: Protocol, distance: Distance | None
    ) -> Sight:
        """A method's view brought to the size and the colours of its target."""
        record = self.records[number]
        frame = next(frame for frame in scene.frames if frame.id == record["frame"])
        view = _view_of(scene, frame, float(record["shift_m"]))
        colors = self.color_maps.get(record["place"], ColorMap())
        seen, height, width = views.at(view), view.camera.height, view.camera.width
        rgb, depth, photo = resize_rgb(seen.rgb, height, width), None, None
        if colors.pairs:
            gain, offset = (torch.tensor(part).view(3, 1, 1) for part in (colors.gain, colors.offset))
            rgb = (rgb * gain + offset).clamp(0, 1)
        if seen.depth is not None:
            depth = resize_nearest(seen.depth, height, width)
            given = torch.isfinite(depth) & (depth > 0)
            depth = torch.where(given, depth, DEPTH_LIMIT_M).clamp(max=DEPTH_LIMIT_M)
        if "photo" in protocol.maps:
            photo = torch.from_numpy(read_image(scene, frame).copy()).permute(2, 0, 1).float() / 255
        maps = store.read_safetensors(self.folder / "maps" / f"{number:06d}.safetensors")
        return Sight(maps, rgb, depth, photo, distance)


class MakeTargets(Output):
    """Write the truth of a log under a protocol."""

    verb_name = "bench real truth"
    version, files = 3, ("targets.json", "maps/*.safetensors")
    log: Path
    """The whole log."""
    shown: Path
    """What the methods saw of it, with labels (for what the shown cameras saw)."""
    protocol: Protocol
    held: tuple[str, ...]
    """Held-out frames, which are scored; empty = every frame of `cameras`."""
    cameras: tuple[str, ...]

    def key_settings(self) -> dict[str, Any]:
        return {"protocol": asdict(self.protocol), "held_out": list(self.held), "cameras": list(self.cameras)}

    def make(self, work: RunDir) -> dict[str, Any]:
        scene, hidden, protocol = read_scene(self.log), set(self.held), self.protocol
        maker = _Maker(protocol, scene, self.shown)
        frames = [f for f in scene.frames if (f.id in hidden if hidden else f.view.camera.name in self.cameras)]
        records, left_out, color_maps = [], {}, {}
        with log.task(f"truth of {protocol.name}", len(frames)) as bar:
            for name in scene.cameras:
                own = [frame for frame in frames if frame.view.camera.name == name]
                reason = maker.unsuitable(own) if own else ""
                if reason:
                    left_out[name] = reason
                elif own and "seen" in protocol.maps:
                    color_maps[name] = asdict(maker.color_map(own[:: protocol.every]))
                for number, frame in enumerate(own):
                    bar.advance()
                    if reason or (protocol.every > 1 and number % protocol.every == 0):
                        continue
                    for shift_m in protocol.shifts_m:
                        maps = maker.maps(frame, shift_m)
                        if maps is None:
                            continue
                        place = f"{abs(shift_m):g} m" if shift_m else name
                        record = {"place": place, "frame": frame.id, "shift_m": shift_m}
                        if "seen" in maps:
                            seen, share = int(maps["seen"].sum()), round(float(maps["seen"].mean()), 4)
                            record |= {"seen_px": seen, "seen_share": share}
                        store.write_safetensors(work.path / "maps" / f"{len(records):06d}.safetensors", maps)
                        records.append(record)
        reason = "" if records else next(iter(left_out.values()), "no frame to score")
        document = {"views": records, "color_maps": color_maps, "left_out": left_out, "reason": reason}
        store.write_json(work.path / "targets.json", document)
        return {"views": len(records)}


def read_targets(folder: Path) -> Targets:
    """What ``MakeTargets`` wrote."""
    found = store.read_json(folder / "targets.json")
    maps = {name: ColorMap(tuple(m["gain"]), tuple(m["offset"]), m["pairs"]) for name, m in found["color_maps"].items()}
    places = dict.fromkeys(record["place"] for record in found["views"])
    by_place = {place: [r for r in found["views"] if r["place"] == place] for place in places}
    seen = {place: [r["seen_px"] for r in own if "seen_px" in r] for place, own in by_place.items()}
    all_seen = sum(map(sum, seen.values()))
    shares = {place: np.mean([r["seen_share"] for r in own]) for place, own in by_place.items() if seen[place]}
    weight = {place: round(sum(counts) / all_seen, 4) for place, counts in seen.items() if counts and all_seen}
    facts = {"views": {place: len(own) for place, own in by_place.items()}}
    facts |= {name: found[name] for name in ("left_out", "color_maps")}
    facts |= {"seen_share": {place: round(float(share), 4) for place, share in shares.items()}, "weight": weight}
    return Targets(folder, tuple(found["views"]), maps, facts, found["reason"])


def _view_of(scene: Scene, frame: Frame, shift_m: float) -> View:
    if not shift_m:
        return frame.view
    name = frame.view.camera.name
    index = [f.id for f in scene.frames_of(name)].index(frame.id)
    return trajectory.shifted(scene, name, shift_m).views[index]


class _Maker:
    """Makes the maps of views."""

    def __init__(self, protocol: Protocol, scene: Scene, seen: Path) -> None:
        self.protocol, self.scene, self.points = protocol, scene, LogPoints(scene)
        self.shown: list[ShownFrame] = []
        if "seen" in protocol.maps:
            labelled = read_scene(seen)
            found = (truth.shown_frame(labelled, f, read_image(labelled, f)) for f in labelled.frames_in("train"))
            self.shown = [frame for frame in found if frame is not None]

    def unsuitable(self, frames: Sequence[Frame]) -> str:
        """Why a camera cannot be scored, or nothing."""
        if "photo" not in self.protocol.maps and all(self.points.of_moment(f.view.time_s) is None for f in frames):
            return "the log has no LiDAR sweep taken with an image"
        if "seen" in self.protocol.maps:
            probed = frames[:: max(1, len(frames) // 4)]
            share = float(np.mean([self._seen(frame)[0].mean() for frame in probed]))
            if share < LEAST_SEEN:
                return f"the shown cameras saw {share:.1%} of its pixels"
        return ""

    def maps(self, frame: Frame, shift_m: float) -> dict[str, NDArray[Any]] | None:
        """The maps of a view that the protocol needs; None if it needs points and there are none."""
        view, wanted = _view_of(self.scene, frame, shift_m), self.protocol.maps
        points = self.points.of_moment(view.time_s)
        if points is None and "photo" not in wanted:
            return None
        if points is None:
            points = OwnedPoints(np.zeros((0, 3), np.float32), np.zeros(0, np.int32), np.zeros(0, np.uint8), 0.4)
        world = self.points.placed(points, view.time_s)
        depth, index = lidar.visible(view, world, points.gap_deg)
        found: dict[str, NDArray[Any]] = {"depth": depth}
        owner = np.append(points.owner, STATIC)[index]
        if "dynamic" in wanted:
            moving = self._boxes(view, owner) if "photo" in wanted else owner != STATIC
            found["dynamic"] = moving.astype(np.uint8)
        if "color" in wanted:
            color, colored = self.points.colors(frame, points, world)
            found["color"], found["colored"] = color[index], colored[index].astype(np.uint8)
        if "seen" in wanted:
            found["seen"] = self._seen(frame)[0].astype(np.uint8)
        return found if "photo" in wanted or depth.any() else None

    def _boxes(self, view: View, owner: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Outlines bool[H, W] of the boxes of dynamic objects of which the view shows enough LiDAR points."""
        mask = np.zeros(owner.shape, bool)
        for number, count in zip(*np.unique(owner[owner != STATIC], return_counts=True), strict=True):
            track = self.points.dynamic[number]
            pose = track.pose_at(view.time_s)
            outline = None if pose is None or count < LEAST_POINTS else box_outline(view, pose, track.size_m)
            mask = mask if outline is None else mask | outline
        return mask

    def _seen(self, frame: Frame) -> tuple[NDArray[np.bool_], NDArray[np.uint8], NDArray[np.uint8]]:
        """Pixels bool[H, W] that the shown cameras saw, and the colours u8[N, 3] of the same points there and in this
        image."""
        view = frame.view
        shape, nothing = (view.camera.height, view.camera.width), np.zeros((0, 3), np.uint8)
        points = self.points.around(view.time_s)
        if points is None:
            return np.zeros(shape, bool), nothing, nothing
        _, index = lidar.visible(view, self.points.placed(points, view.time_s), points.gap_deg)
        rows, columns = np.nonzero(index >= 0)
        seen, there = lidar.seen_by(self.points.placed, points.taken(index[rows, columns]), self.shown, view.time_s)
        here = lidar.blurred(read_image(self.scene, frame))[rows, columns]
        return lidar.spread(seen, rows, columns, shape), there[seen], here[seen]

    def color_map(self, frames: Sequence[Frame]) -> ColorMap:
        """The colour map of a camera, from the points that its training frames share with the shown cameras."""
        pairs = [self._seen(frame)[1:] for frame in frames]
        return calibration.color_map(*(np.concatenate([pair[side] for pair in pairs]) for side in (0, 1)))


PERCEPTUAL_VIEWS: Final = 12
"""Views of each place at which the perceptual distance is computed, evenly spread."""
NONE: Final = "none"
"""In place of a number that there is not."""
_MOST_DB: Final = 100.0

Sum = NDArray[np.float64]
Sums = Mapping[str, Sum]
Distance = Callable[[metrics.Pair], float | None]


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A method's view beside its truth: the target's maps by name; colour f32[3, H, W] as the target's camera would
    record it, depth f32[1, H, W] metres (80 m where there is none); the photograph f32[3, H, W] or None; ``distance``:
    perceptual, or None at a view where it is not computed."""

    maps: Mapping[str, NDArray[Any]]
    rgb: Tensor
    depth: Tensor | None
    photo: Tensor | None
    distance: Distance | None

    def mask(self, name: str) -> Tensor | None:
        """A mask bool[1, H, W] by the name of its map, None where the truth has none; ``upper``: the upper third."""
        if name == "upper":
            height, width = self.rgb.shape[-2:]
            return (torch.arange(height) < height // 3)[None, :, None].expand(1, height, width)
        values = self.maps.get(name)
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
    """A column: its heading, digits, and whether it is compared as a ratio, since lower is better. ``of``: what a view
    adds, or None where it has nothing to say. ``close``: the value from the sum over views."""

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


def _of_mean(of: Callable[[float], float]) -> Callable[[Sum], float | None]:
    return lambda total: of(total[0] / total[1]) if total[1] else None


_mean, _root = _of_mean(float), _of_mean(math.sqrt)
_decibels = _of_mean(lambda mean: min(_MOST_DB, -10.0 * math.log10(max(mean, 1e-12))))


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
        true = torch.from_numpy(sight.maps["depth"])[None]
        chosen = sight.part(true > 0, part)
        return _summed(error(sight.depth[chosen].double(), true[chosen].double()))

    return of


def _point_color(error: Callable[[Tensor], Tensor], part: str) -> Measure:
    """An error of colour summed over channels and pixels of a part that show a point with a recorded colour."""

    def of(sight: Sight) -> Sum | None:
        colored = sight.mask("colored")
        if colored is None:
            return None
        true = torch.from_numpy(sight.maps["color"]).permute(2, 0, 1).float() / 255
        return _summed(error((sight.rgb.clamp(0, 1) - true)[:, sight.part(colored, part)[0]].double()))

    return of


def _relative(generated: Tensor, true: Tensor) -> Tensor:
    return (generated - true).abs() / true


def _squared(generated: Tensor, true: Tensor) -> Tensor:
    return (generated - true) ** 2


def _within(generated: Tensor, true: Tensor) -> Tensor:
    return (torch.maximum(generated.clamp_min(1e-6) / true, true / generated.clamp_min(1e-6)) < 1.25).double()


_PARTS: Final = ("seen", "static", "dynamic")
COLUMNS: Final[dict[str, Column]] = {
    "psnr": Column("PSNR dB", 2, _photo(metrics.psnr), _mean),
    "ssim": Column("SSIM", 3, _photo(metrics.ssim), _mean),
    "perceptual": Column("perceptual", 4, _perceptual(), _mean, ratio=True),
    "psnr_dynamic": Column("PSNR of dynamic objects", 2, _photo(metrics.psnr, "dynamic"), _mean),
    "psnr_upper": Column("PSNR, upper third", 2, _photo(metrics.psnr, "upper"), _mean),
    "psnr_seen": Column("PSNR dB, seen", 2, _seen_color, _decibels),
    "perceptual_seen": Column("perceptual, seen", 4, _perceptual("seen"), _mean, ratio=True),
    "abs_rel": Column("AbsRel", 4, _depth(_relative), _mean, ratio=True),
    **{f"abs_rel_{of}": Column(f"AbsRel, {of}", 4, _depth(_relative, of), _mean, ratio=True) for of in _PARTS},
    **{f"rmse_{of}": Column(f"RMSE m, {of}", 2, _depth(_squared, of), _root, ratio=True) for of in _PARTS},
    **{f"delta1_{of}": Column(f"delta1, {of}", 4, _depth(_within, of), _mean) for of in _PARTS},
    **{
        f"point_psnr_{of}": Column(f"PSNR at points, {of}", 2, _point_color(torch.square, of), _decibels)
        for of in _PARTS[1:]
    },
    **{
        f"point_abs_{of}": Column(f"colour error at points, {of}", 4, _point_color(torch.abs, of), _mean, ratio=True)
        for of in _PARTS[1:]
    },
}
"""All columns by name; a protocol lists its own."""


# ---- a method's values ----


@functools.cache
def shipped_features(device: torch.device | None = None) -> CodecFeatures:
    """The network behind perceptual distances, the shipped codec, loaded once per process and device."""
    return CodecFeatures(model_files.load("embedded").codec).to(device or torch.device("cpu"))


class ScoreTargets(Output):
    """Score a method's views (folders of observations) of a log; writes its values."""

    verb_name = "bench real score"
    version, files = 3, ("metrics.json",)
    log: Path
    truth: Path
    views: Path
    protocol: Protocol
    device: str = "cpu"
    """Of the network behind the perceptual distance."""

    def key_settings(self) -> dict[str, Any]:
        columns = list(self.protocol.columns)
        return {"protocol": self.protocol.name, "columns": columns, "perceptual_views": PERCEPTUAL_VIEWS}

    def make(self, work: RunDir) -> dict[str, Any]:
        scene, targets, finder = read_scene(self.log), read_targets(self.truth), ViewFinder(self.views)
        protocol, sampled, features = self.protocol, set(), None
        places = [record["place"] for record in targets.records]
        if any(name.startswith("perceptual") for name in protocol.columns):
            own = [[n for n, place in enumerate(places) if place == one] for one in dict.fromkeys(places)]
            sampled = {number for numbers in own for number in evenly(numbers, PERCEPTUAL_VIEWS)}
        if sampled:
            network = choose_device(self.device, "networks of the scores")
            features = PerceptualDistance(shipped_features(network), device=network)
        sums: dict[str, dict[str, Sum]] = {}
        with log.task(f"score {protocol.name}", len(places)) as bar:
            for number, place in enumerate(places):
                sight = targets.sight(number, scene, finder, protocol, features if number in sampled else None)
                _add(sums.setdefault(place, {}), {name: COLUMNS[name].of(sight) for name in protocol.columns})
                bar.advance()
        store.write_json(work.path / "metrics.json", values_of(protocol, sums))
        return {"views": len(places)}


def _add(total: dict[str, Sum], part: Mapping[str, Sum | None]) -> None:
    for name, value in part.items():
        if value is not None:
            total[name] = total[name] + value if name in total else value


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
        expected = f"camera {view.camera.name} at {view.time_s:.3f} s"
        raise InputError("a method lacks a view that is scored", where=str(self._folder), expected=expected)
