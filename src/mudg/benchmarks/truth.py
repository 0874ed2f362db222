"""The truth of ``mudg bench real``: one folder per log and protocol, made once and read by every method's score.

    targets.json             the views, what each belongs to, and the colour maps of cameras
    maps/000000.safetensors  per view: depth f32[H, W] metres of LiDAR points (0 = none), and as the protocol needs them
                             seen u8, dynamic u8, color u8[H, W, 3] and colored u8, classes u8 (255 = none)
    pictures/000000.jpg      the truth of the views that the page shows

Photographs are not copied: they are read from the log.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import log, palette, store
from mudg.base.camera_colors import ColorMap
from mudg.base.run_folder import RunDir
from mudg.base.types import Frame, Scene, View
from mudg.benchmarks.places import Protocol
from mudg.core import calibration, lidar, trajectory
from mudg.core.fusion import STATIC
from mudg.core.lidar import OwnedPoints, ShownFrame
from mudg.core.pictures import class_colors, depth_colors
from mudg.formats.exporters.video import jpeg_bytes
from mudg.labels.inputs import box_outline
from mudg.scene.read import read_image, read_scene
from mudg.scoring import truth
from mudg.scoring.truth import LogPoints
from mudg.steps.outputs import Output

LEAST_SEEN: Final = 0.05
"""Cameras of whose pixels the shown cameras saw less than this share are left out."""
LEAST_POINTS: Final = 10
"""A dynamic object counts in a view that shows at least this many of its LiDAR points."""
PICTURES: Final = 4
SPLAT_SHARE: Final = 0.006


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A view to score: where its values are pooled (``place``), the recorded frame (of its moment), and its maps by
    name."""

    place: str
    frame: Frame
    view: View
    maps: Mapping[str, NDArray[Any]]
    color_map: ColorMap

    def photo(self, scene: Scene) -> Tensor:
        """The photograph f32[3, H, W] in 0..1."""
        return torch.from_numpy(read_image(scene, self.frame).copy()).permute(2, 0, 1).float() / 255


@dataclass(frozen=True)
class Targets:
    """All views of a log under a protocol; ``reason`` says why there are none."""

    folder: Path
    records: tuple[Mapping[str, Any], ...]
    color_maps: Mapping[str, ColorMap]
    pictures: tuple[int, ...]
    facts: Mapping[str, Any]
    reason: str

    def __len__(self) -> int:
        return len(self.records)

    def load(self, index: int, scene: Scene) -> Target:
        """One view."""
        record = self.records[index]
        frame = next(frame for frame in scene.frames if frame.id == record["frame"])
        maps = store.read_safetensors(self.folder / "maps" / f"{index:06d}.safetensors")
        view = _view_of(scene, frame, float(record["shift_m"]))
        return Target(record["place"], frame, view, maps, self.color_maps.get(record["place"], ColorMap()))


class MakeTargets(Output):
    """Write the truth of a log under a protocol."""

    verb_name = "bench real truth"
    version, files = 2, ("targets.json", "maps/*.safetensors", "pictures/*.jpg")
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
        scene, hidden = read_scene(self.log), set(self.held)
        maker = _Maker(self.protocol, scene, self.shown)
        frames = [f for f in scene.frames if (f.id in hidden if hidden else f.view.camera.name in self.cameras)]
        by_camera = {name: [f for f in frames if f.view.camera.name == name] for name in scene.cameras}
        records, left_out, color_maps = _written(maker, by_camera, work.path)
        pictures = _write_pictures(maker, records, work.path)
        document = {
            "views": records,
            "color_maps": {name: asdict(found) for name, found in color_maps.items()},
            "pictures": pictures,
            "left_out": left_out,
            "reason": "" if records else (next(iter(left_out.values()), "no frame to score")),
        }
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
    facts = {
        "views": {place: len(own) for place, own in by_place.items()},
        "left_out": found["left_out"],
        "color_maps": found["color_maps"],
        "seen_share": {
            place: round(float(np.mean([r["seen_share"] for r in own])), 4)
            for place, own in by_place.items()
            if seen[place]
        },
        "weight": {place: round(sum(counts) / all_seen, 4) for place, counts in seen.items() if counts and all_seen},
    }
    return Targets(folder, tuple(found["views"]), maps, tuple(found["pictures"]), facts, found["reason"])


def _view_of(scene: Scene, frame: Frame, shift_m: float) -> View:
    if not shift_m:
        return frame.view
    name = frame.view.camera.name
    index = [f.id for f in scene.frames_of(name)].index(frame.id)
    return trajectory.shifted(scene, name, shift_m).views[index]


def _written(
    maker: _Maker, by_camera: Mapping[str, Sequence[Frame]], out: Path
) -> tuple[list[dict[str, Any]], dict[str, str], dict[str, ColorMap]]:
    """Write the maps of all views; returns their records, the cameras left out with the reason, and the colour maps of
    cameras."""
    protocol, records, left_out, color_maps = maker.protocol, [], {}, {}
    with log.task(f"truth of {protocol.name}", sum(map(len, by_camera.values()))) as bar:
        for name, frames in by_camera.items():
            reason = maker.unsuitable(frames) if frames else ""
            if reason:
                left_out[name] = reason
            elif frames and "seen" in protocol.maps:
                color_maps[name] = maker.color_map(frames[:: protocol.every])
            for number, frame in enumerate(frames):
                bar.advance()
                if reason or (protocol.every > 1 and number % protocol.every == 0):
                    continue
                for shift_m in protocol.shifts_m:
                    maps = maker.maps(frame, shift_m)
                    if maps is None:
                        continue
                    record = {
                        "place": f"{abs(shift_m):g} m" if shift_m else name,
                        "frame": frame.id,
                        "shift_m": shift_m,
                    }
                    if "seen" in maps:
                        record |= {
                            "seen_px": int(maps["seen"].sum()),
                            "seen_share": round(float(maps["seen"].mean()), 4),
                        }
                    store.write_safetensors(out / "maps" / f"{len(records):06d}.safetensors", maps)
                    records.append(record)
    return records, left_out, color_maps


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
        if "classes" in self.protocol.maps and not any(self._classes(frame) for frame in frames):
            return "the log has no classes of LiDAR points"
        if "photo" not in self.protocol.maps and all(self.points.of_moment(f.view.time_s) is None for f in frames):
            return "the log has no LiDAR sweep taken with an image"
        if "seen" in self.protocol.maps:
            probed = frames[:: max(1, len(frames) // 4)]
            share = float(np.mean([self._seen(frame)[0].mean() for frame in probed]))
            if share < LEAST_SEEN:
                return f"the shown cameras saw {share:.1%} of its pixels"
        return ""

    def _classes(self, frame: Frame) -> bool:
        points = self.points.of_moment(frame.view.time_s)
        return points is not None and bool((points.ids != palette.UNLABELLED).any())

    def maps(self, frame: Frame, shift_m: float) -> dict[str, NDArray[Any]] | None:
        """The maps of a view that the protocol needs; None if it needs points and there are none."""
        view, wanted = _view_of(self.scene, frame, shift_m), self.protocol.maps
        points = self.points.of_moment(view.time_s)
        if points is None:
            if "photo" not in wanted:
                return None
            points = OwnedPoints(np.zeros((0, 3), np.float32), np.zeros(0, np.int32), np.zeros(0, np.uint8), 0.4)
        world = self.points.placed(points, view.time_s)
        depth, index = lidar.visible(view, world, points.gap_deg)
        found: dict[str, NDArray[Any]] = {"depth": depth}
        owner = np.append(points.owner, STATIC)[index]
        if "dynamic" in wanted:
            moving = self._boxes(view, owner) if "photo" in wanted else owner != STATIC
            found["dynamic"] = moving.astype(np.uint8)
        if "classes" in wanted:
            found["classes"] = np.append(points.ids, np.uint8(palette.UNLABELLED))[index]
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


# ---- pictures ------------------------------------------------------------------------------------


def _write_pictures(maker: _Maker, records: Sequence[Mapping[str, Any]], out: Path) -> list[int]:
    """Write the truth of the middle view of up to ``PICTURES`` places; returns the views' numbers."""
    chosen: list[int] = []
    for place in dict.fromkeys(record["place"] for record in records):
        own = [number for number, record in enumerate(records) if record["place"] == place]
        chosen.append(own[len(own) // 2])
    chosen = chosen[:PICTURES]
    frames = {frame.id: frame for frame in maker.scene.frames}
    for number in chosen:
        maps = store.read_safetensors(out / "maps" / f"{number:06d}.safetensors")
        picture = truth_picture(maker.scene, frames[records[number]["frame"]], maps, maker.protocol)
        store.atomic_write(out / "pictures" / f"{number:06d}.jpg", jpeg_bytes(picture, quality=80))
    return chosen


def truth_picture(
    scene: Scene, frame: Frame, maps: Mapping[str, NDArray[Any]], protocol: Protocol
) -> NDArray[np.uint8]:
    """What the page shows as truth, two pictures above each other: the photograph, and its part that counts or the
    LiDAR depth; without a photograph the points, in the colours or classes that they have."""
    camera = frame.view.camera
    width = max(1, round(SPLAT_SHARE * camera.width))
    depth = np.where(maps["depth"] > 0, maps["depth"], np.float32(np.nan))
    points = splatted(depth_colors(depth), maps["depth"] > 0, width)
    if "photo" in protocol.maps:
        photo = read_image(scene, frame)
        below = np.where(maps["seen"][..., None] > 0, photo, photo // 4) if "seen" in maps else points
        return np.vstack([photo, below])
    if "classes" in maps:
        return splatted(class_colors(maps["classes"]), maps["classes"] != palette.UNLABELLED, width)
    return np.vstack([splatted(maps["color"], maps["colored"] > 0, width), points])


def splatted(rgb: NDArray[np.uint8], known: NDArray[np.bool_], width: int) -> NDArray[np.uint8]:
    """Pixels of an image u8[H, W, 3] as squares on grey, so that single points are seen."""
    picture = np.full_like(rgb, 24)
    for row in range(-width // 2, width // 2 + 1):
        for column in range(-width // 2, width // 2 + 1):
            moved = np.roll(known, (row, column), (0, 1))
            picture[moved] = np.roll(rgb, (row, column), (0, 1))[moved]
    return picture
