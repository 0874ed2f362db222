"""Labelled views of a reconstruction: layers, and the boxes of everything that the log tracked.

An object with Gaussians of its own is masked by what is drawn of it within the outline of its box. One without (parked
vehicles belong to the background) is masked by the pixels within its outline that have a class of road users and a
depth that fits its box.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.palette import DYNAMIC_IDS
from mudg.base.types import Camera, Track, View
from mudg.datasets.settings import DatasetConfig
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.rendering import outline_mask
from mudg.sim.lidar import LidarReply, LidarRequest, mounted
from mudg.sim.optics import Pinhole
from mudg.sim.session import CameraReply, CameraRequest, Instant, Layer, Session, Trust

SLACK_M: Final = (0.5, 1.5)
"""How far before and behind its box a surface may be that belongs to a parked object (windows let depth through)."""
HIDES_M: Final = 0.3
"""What is nearer than an object by more than this hides it."""
ALONE: Final = 0.8
"""Alpha of an object drawn alone from which on a pixel is part of it."""
NEAR_M: Final = 0.3
Rectangle = tuple[float, float, float, float]
"""Left, top, right, bottom in pixels."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjectBox:
    """An object in a view. ``track_id``, ``label``: of the log. ``number``: value of its pixels in
    ``LabelledView.instances``. ``world_from_box``: f64[4, 4] of its centre (x forward, z up). ``size_m``: length,
    width, height in metres. ``amodal_px``: of the whole box, unclipped by the image and by what hides it.
    ``visible_px``: of its visible pixels; None where there are none. ``pixels``: how many of it are visible.
    ``occlusion``: share of its pixels in the image that something hides, [0, 1]; NaN for parked objects, which cannot
    be drawn alone. ``truncation``: share of ``amodal_px`` outside the image. ``seen_from_deg``: angle between this view
    of it and the nearest from which it was recorded: a side that no camera saw is guesswork. ``returns``: how many
    returns of the view's sweep lie in the box; 0 without one."""

    track_id: str
    label: str
    number: int
    world_from_box: NDArray[np.float64]
    size_m: tuple[float, ...]
    amodal_px: Rectangle
    visible_px: Rectangle | None
    pixels: int
    occlusion: float
    truncation: float
    seen_from_deg: float
    returns: int = 0

    def record(self) -> dict[str, Any]:
        """As JSON values."""
        place, yaw = self.world_from_box[:3, 3].tolist(), geometry.yaw_of(self.world_from_box)
        found = {"id": self.track_id, "label": self.label, "position_world_m": place, "yaw_world_rad": yaw}
        occlusion = None if np.isnan(self.occlusion) else round(self.occlusion, 4)
        seen = {"occlusion": occlusion, "truncation": round(self.truncation, 4)}
        seen |= {"seen_from_deg": round(self.seen_from_deg, 2), "returns": self.returns}
        return {**found, "size_m": list(self.size_m), "pixels": self.pixels, **seen}


@dataclass(frozen=True, slots=True, eq=False)
class ViewSweep:
    """What a LiDAR on the vehicle measures at the moment of a view, all beams at once: returns in the sensor's frame,
    vehicle-from-lidar and world-from-lidar f64[4, 4], and its name."""

    reply: LidarReply
    vehicle_from_lidar: NDArray[np.float64]
    world_from_lidar: NDArray[np.float64]
    name: str

    @property
    def points(self) -> NDArray[np.float32]:
        """x, y, z in metres in the sensor's frame and intensity of every return, f32[N, 4]."""
        return np.column_stack([self.reply.xyz, self.reply.intensity]).astype("<f4")

    def inside(self, world_from_box: NDArray[np.float64], size_m: Sequence[float]) -> int:
        """How many returns lie in a box."""
        box_from_lidar = geometry.invert(world_from_box) @ self.world_from_lidar
        local = geometry.transform_points(box_from_lidar, self.reply.xyz.astype(np.float64))
        return int((np.abs(local) <= np.asarray(size_m) / 2).all(1).sum())


@dataclass(frozen=True, slots=True, eq=False)
class LabelledView:
    """A view with its labels. ``name``: of its trajectory and number, such as ``front_shift+2.0/000003``. ``layers``:
    as in ``CameraReply``; ``instances`` u16[H, W] also marks parked objects. ``boxes``: of all objects with at least
    part of their box in the image. ``mount``: vehicle-from-camera f64[4, 4]; None: the log does not tell. ``sweep``: of
    the LiDAR that was asked for. In a data set: ``number`` among all views, ``drive``, number of its path
    (``sequence``, counted over all drives), and ``frame``, its number within the path, without gaps."""

    name: str
    view: View
    layers: Mapping[str, NDArray[Any]]
    boxes: tuple[ObjectBox, ...]
    trust: Trust
    mount: NDArray[np.float64] | None = None
    sweep: ViewSweep | None = None
    number: int = 0
    drive: str = ""
    sequence: int = 0
    frame: int = 0

    def wanted(self, config: DatasetConfig) -> LabelledView:
        """The view with the objects that the settings do not leave out."""
        seen = (box for box in self.boxes if box.pixels >= max(config.least_pixels, 1))
        return replace(self, boxes=tuple(box for box in seen if box.seen_from_deg <= config.farthest_seen_deg))


class Labeller:
    """Makes labelled views of a session of a run, with its log. ``lidar``: as the setting of ``mudg dataset``; empty:
    none. UsageError: a fit without its log, or one that tells nothing of such a LiDAR."""

    def __init__(self, session: Session, lidar: str = "") -> None:
        if session.scene is None:
            what, remedy = "labels need the log that a fit belongs to", "give the folder of a run, or scene="
            raise UsageError(what, remedy=remedy)
        self.session, self.scene = session, session.scene
        self.names = tuple(sorted({track.id for track in session.scene.tracks} | set(session.sizes_m())))
        """Objects by number, from 1."""
        if len(self.names) > np.iinfo(np.uint16).max:
            raise UsageError("more objects than instance ids", expected="at most 65535", got=str(len(self.names)))
        labels = {track.id: track.label for track in session.scene.tracks}
        nodes = {node.name: node.label for node in session.model.nodes if isinstance(node, RigidNode)}
        self.labels = {name: labels.get(name) or nodes.get(name, "") for name in self.names}
        self._tracks = {track.id: track for track in session.scene.tracks}
        self._directions: dict[str, NDArray[np.float64]] = {}
        self._lidar = mounted(self.scene, lidar) if lidar else None

    def label(
        self, name: str, view: View, layers: Sequence[Layer], *, swept: bool = True, motion_to: Instant | None = None
    ) -> LabelledView:
        """A view with its layers and boxes; ``swept``: and with its sweep, if there is a LiDAR. ``motion_to``: as in
        ``CameraRequest``, of the layer ``motion``."""
        now, camera = Instant(view.time_s, view.world_from_cam), view.camera
        needed: tuple[Layer, ...] = tuple(dict.fromkeys((*layers, "depth", "classes", "instances")))
        later = motion_to if "motion" in layers else None
        request = CameraRequest(
            optics=Pinhole.of(camera), start=now, layers=needed, colors_of=camera.name, motion_to=later
        )
        (reply,) = self.session.render([request])
        drawn = {**reply.layers, "instances": self._instances(view, reply)}
        mount = self.mount(camera.name)
        sweep = self._sweep(view, mount) if swept else None
        boxes = tuple(self._boxes(view, now, drawn, sweep))
        return LabelledView(name, view, {layer: drawn[layer] for layer in layers}, boxes, reply.trust, mount, sweep)

    def _sweep(self, view: View, mount: NDArray[np.float64] | None) -> ViewSweep | None:
        if self._lidar is None:
            return None
        if mount is None:
            what = "a LiDAR needs the poses of the vehicle at the camera's frames"
            raise UsageError(what, where="--lidar", got=f"none for {view.camera.name}", remedy="leave --lidar out")
        wanted, beams, vehicle_from_lidar = self._lidar
        pose = view.world_from_cam @ geometry.invert(mount) @ vehicle_from_lidar
        request = LidarRequest(beams=beams, start=Instant(view.time_s, pose), like=wanted.sensor)
        return ViewSweep(self.session.render([request])[0], vehicle_from_lidar, pose, wanted.name)

    def mount(self, camera: str) -> NDArray[np.float64] | None:
        """Vehicle-from-camera f64[4, 4] of a camera of the log, at its first frame with a vehicle pose."""
        for frame in self.scene.frames_of(camera) if camera in self.scene.cameras else ():
            ego = self.scene.ego.pose_at(frame.view.time_s)
            if ego is not None:
                return geometry.invert(ego) @ frame.view.world_from_cam
        return None

    def _instances(self, view: View, reply: CameraReply) -> NDArray[np.uint16]:
        """Numbers of all objects, u16[H, W]: those drawn, and parked ones by their boxes."""
        drawn, depth = reply.layers["instances"], reply.layers["depth"]
        instances, nearest = np.zeros(depth.shape, np.uint16), np.full(depth.shape, np.inf)
        moving = {name: index + 1 for index, name in enumerate(reply.objects)}
        free = (drawn == 0) & np.isin(reply.layers["classes"], DYNAMIC_IDS)
        poses = self.session.objects(view.time_s)
        for index, name in enumerate(self.names):
            pose, size = self._placed(name, poses if name in moving else None, view.time_s)
            within = None if pose is None or size is None else outline_mask(view, pose, size)
            if pose is None or size is None or within is None:
                continue
            if name in moving:
                instances[within & (drawn == moving[name])] = index + 1
                continue
            z = geometry.transform_points(view.cam_from_world @ pose, geometry.box_corners(size))[:, 2]
            with np.errstate(invalid="ignore"):
                fits = ~(depth < z.min() - SLACK_M[0]) & ~(depth > z.max() + SLACK_M[1])
            own = within & free & fits & (z.mean() < nearest)
            instances[own], nearest[own] = index + 1, z.mean()
        return instances

    def _placed(
        self, name: str, drawn: Mapping[str, NDArray[np.float64]] | None, time_s: float
    ) -> tuple[NDArray[np.float64] | None, tuple[float, ...] | None]:
        """Pose and size of an object, by what is ``drawn`` or, if it is not, by its track; None where unknown."""
        track, size = self._tracks.get(name), self.session.sizes_m().get(name)
        if drawn is not None:
            return drawn.get(name), size
        return (None, size) if track is None else (track.pose_at(time_s), size or tuple(track.size_m.tolist()))

    def _boxes(
        self, view: View, now: Instant, drawn: Mapping[str, NDArray[Any]], sweep: ViewSweep | None
    ) -> Iterator[ObjectBox]:
        poses, sizes, instances = self.session.poses(now), self.session.sizes_m(), drawn["instances"]
        for index, name in enumerate(self.names):
            pose, size = self._placed(name, poses if name in sizes else None, view.time_s)
            amodal = None if pose is None or size is None else outline(view, pose, size)
            if pose is None or size is None or amodal is None:
                continue
            mask = instances == index + 1
            pixels = int(mask.sum())
            occlusion = float("nan")
            if name in sizes:
                alpha, own_m = self.session.alone(view, now, name)
                with np.errstate(invalid="ignore"):
                    hidden = (alpha > ALONE) & ~mask & (drawn["depth"] < own_m - HIDES_M)
                within = outline_mask(view, pose, size)
                hidden &= within if within is not None else False
                occlusion = float(hidden.sum() / (hidden.sum() + pixels)) if pixels else 1.0
            visible, truncation = around(mask) if pixels else None, outside(amodal, view.camera)
            seen_from_deg = self._seen_from_deg(name, self._tracks.get(name), pose, view)
            shown = (amodal, visible, pixels, occlusion, truncation, seen_from_deg)
            returns = 0 if sweep is None else sweep.inside(pose, size)
            yield ObjectBox(name, self.labels[name], index + 1, pose, size, *shown, returns)

    def _seen_from_deg(self, name: str, track: Track | None, pose: NDArray[np.float64], view: View) -> float:
        """Angle to the nearest direction, in the frame of the object, from which a camera recorded it."""
        if track is None:
            return 180.0
        if name not in self._directions:
            found = []
            for frame in self.scene.frames:
                then = track.pose_at(frame.view.time_s)
                if then is not None and geometry.box_hull(frame.view, then, track.size_m) is not None:
                    found.append(_direction(then, frame.view))
            self._directions[name] = np.array(found).reshape(-1, 3)
        known = self._directions[name]
        if not len(known):
            return 180.0
        return float(np.degrees(np.arccos(np.clip(known @ _direction(pose, view), -1, 1).max())))


def _direction(world_from_box: NDArray[np.float64], view: View) -> NDArray[np.float64]:
    """Unit vector from a box to a camera, in the frame of the box."""
    away = geometry.transform_points(geometry.invert(world_from_box), view.world_from_cam[None, :3, 3])[0]
    return away / np.linalg.norm(away)


def outline(view: View, world_from_box: NDArray[np.float64], size_m: Sequence[float]) -> Rectangle | None:
    """Rectangle around a projected box, not clipped by the image; None where it lies outside of it or behind."""
    hull = geometry.box_hull(view, world_from_box, np.asarray(size_m), NEAR_M)
    if hull is None:
        return None
    low, high = hull.points.min(0), hull.points.max(0)
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def around(mask: NDArray[np.bool_]) -> Rectangle:
    """Rectangle around the pixels of a mask that has some."""
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    return (float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1))


def clipped(box: Rectangle, camera: Camera) -> Rectangle:
    """The part of a rectangle within the image."""
    left, top, right, bottom = box
    return (max(left, 0.0), max(top, 0.0), min(right, float(camera.width)), min(bottom, float(camera.height)))


def outside(box: Rectangle, camera: Camera) -> float:
    """Share of a rectangle outside the image."""
    area = lambda b: max(b[2] - b[0], 0.0) * max(b[3] - b[1], 0.0)
    return 1 - area(clipped(box, camera)) / max(area(box), 1e-9)
