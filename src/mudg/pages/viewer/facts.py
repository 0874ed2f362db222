"""What the viewer page knows about a log besides Gaussians: cameras, frames with small images, boxes, the vehicle's path, LiDAR points.

Times on the page are seconds since the first frame. Sections of the log's blob (see ``packed.py``): ``keys`` f32[k, 8] and ``lidar``
u16[3, m], places in the world as ``lidar_low + value * lidar_step``, ``ground`` u16[x, y] (see ``with_ground``).
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import palette, seeds
from mudg.base.camera_colors import CameraColors
from mudg.base.types import Camera, Frame, Scene
from mudg.core.ground import HeightMap
from mudg.core.pictures import depth_colors, resize_area
from mudg.core.weather.particles import FLAKE_EDGES_MM, RAIN_EDGES_MM
from mudg.data.scene import read_image, read_points
from mudg.pages.page import FAR_M, NEAR_M
from mudg.pages.viewer.packed import Sections, key_rows

WEBP_QUALITY: Final = 50
REACH_M: Final = 80.0
MOST_CELLS: Final = 4_000_000
MOST_POINTS: Final = 20_000
"""LiDAR points on a page, taken evenly from all sweeps."""
LEAST_STEP_M: Final = 5e-4
"""Of heights of the ground; ten times that of LiDAR points."""
UNKNOWN: Final = 65535
"""Level of the ground where its height is not known."""


@dataclass(frozen=True, slots=True)
class PageFacts:
    """The log for the page.

    Args:
        facts: JSON values. sections: see the module's docstring. images: all WebP files behind one another.
    """

    facts: dict[str, Any]
    sections: Sections
    images: bytes


def begin_of(scene: Scene) -> float:
    """Time of the first frame, seconds; 0 on the page."""
    return min(frame.view.time_s for frame in scene.frames)


def log_facts(scene: Scene, colors: CameraColors, image_width: int, most_images: int) -> PageFacts:
    """Everything but the Gaussians.

    Args:
        scene: the log. colors: of the fit. image_width: of recorded images on the page, pixels.
        most_images: how many images the page may hold; taken evenly.
    """
    begin = begin_of(scene)
    frames = sorted(scene.frames, key=lambda frame: (frame.view.camera.name, frame.view.time_s))
    keys, tracks = [key_rows(scene.ego.times_s - begin, scene.ego.world_from_ego)], []
    for track in scene.tracks:
        first = sum(map(len, keys))
        tracks.append(
            {"id": track.id, "label": track.label, "size_m": track.size_m.tolist(), "keys": [first, len(track.times_s)]}
        )
        keys.append(key_rows(track.times_s - begin, track.world_from_object))
    places, images = _images(scene, frames, image_width, most_images)
    sweeps, points = _lidar(scene, begin)
    facts = {
        "title": scene.id, "end_s": max(frame.view.time_s for frame in frames) - begin, "begin_s": begin,
        "cameras": {name: _camera(camera, colors) for name, camera in scene.cameras.items()},
        "frames": [
            {"id": frame.id, "camera": frame.view.camera.name, "t": round(frame.view.time_s - begin, 6), "image": place,
             "split": scene.split.get(frame.id, "train"), "pose": np.round(frame.view.world_from_cam[:3], 7).ravel().tolist()}
            for frame, place in zip(frames, places)
        ],
        "ego_keys": [0, len(scene.ego.times_s)], "tracks": tracks, **sweeps, "images": {"count": sum(p is not None for p in places)},
        "class_names": list(palette.CLASSES), "class_colors": palette.DISPLAY_COLORS.tolist(), "depth_range_m": [NEAR_M, FAR_M],
        "depth_colors": depth_colors(np.geomspace(NEAR_M, FAR_M, 256).astype(np.float32)[None], NEAR_M, FAR_M)[0].tolist(),
    }  # fmt: skip
    return PageFacts(facts, {"keys": np.concatenate(keys), "lidar": points}, images)


def with_ground(page: PageFacts, ground: HeightMap | None) -> PageFacts:
    """The page with heights of the ground, for objects that are moved on it; without them where they are not known or too many.

    Section ``ground``: world z as ``low + value * step``, steps of `LEAST_STEP_M`, larger where heights span more than 33 m; `UNKNOWN`
    where it is not known.
    """
    if ground is None or ground.heights.size > MOST_CELLS or not np.isfinite(ground.heights).any() or min(ground.heights.shape) < 2:
        return replace(page, facts=page.facts | {"ground": None})
    low, high = float(np.nanmin(ground.heights)), float(np.nanmax(ground.heights))
    step = max((high - low) / (UNKNOWN - 1), LEAST_STEP_M)
    levels = np.where(np.isfinite(ground.heights), np.rint((ground.heights - low) / step), UNKNOWN).astype(np.uint16)
    record = {"origin": ground.origin.tolist(), "cell_m": ground.cell_m, "shape": list(levels.shape), "low": low, "step": step}
    return replace(page, facts=page.facts | {"ground": record}, sections=page.sections | {"ground": levels})


def with_particles(page: PageFacts, seed: int) -> PageFacts:
    """The page with the keys of random drops and flakes, so that it draws those of a render with this seed."""
    keys = {
        name: [seeds.key(seed, index, purpose) & 0x7FFFFFFF for index in range(len(edges) - 1)]
        for name, purpose, edges in (("rain", "rain", RAIN_EDGES_MM), ("snow", "flakes", FLAKE_EDGES_MM))
    }
    return replace(page, facts=page.facts | {"particle_keys": keys})


def _camera(camera: Camera, colors: CameraColors) -> dict[str, Any]:
    known = colors.to_common.get(camera.name)
    shown = None if known is None else known.inverse()
    return {
        "width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "gain": [1, 1, 1] if shown is None else list(shown.gain),
        "offset": [0, 0, 0] if shown is None else list(shown.offset),
    }  # fmt: skip


def _images(scene: Scene, frames: Sequence[Frame], width: int, most: int) -> tuple[list[list[int] | None], bytes]:
    """Place [offset, length] of every frame's image, None where it has none, and the files."""
    if most <= 0:
        return [None] * len(frames), b""
    chosen = set(np.linspace(0, len(frames) - 1, min(most, len(frames))).round().astype(int).tolist())
    places, parts, at = [], [], 0
    for index, frame in enumerate(frames):
        if index not in chosen:
            places.append(None)
            continue
        rgb = read_image(scene, frame)
        wide = min(width, rgb.shape[1])
        content = io.BytesIO()
        small = resize_area(rgb, wide, max(1, round(rgb.shape[0] * wide / rgb.shape[1])))
        Image.fromarray(small).save(content, "WEBP", quality=WEBP_QUALITY, method=4)
        parts.append(content.getvalue())
        places.append([at, len(parts[-1])])
        at += len(parts[-1])
    return places, b"".join(parts)


def _lidar(scene: Scene, begin: float) -> tuple[dict[str, Any], NDArray[np.uint16]]:
    """Records of the sweeps, and their points in the world, evenly thinned."""
    clouds, records, first = [np.zeros((0, 3))], [], 0
    share = max(1, MOST_POINTS // max(1, len(scene.sweeps)))
    for sweep in scene.sweeps:
        xyz = read_points(scene, sweep).xyz
        xyz = xyz[np.square(xyz).sum(1) < REACH_M**2]
        xyz = xyz[:: max(1, -(-len(xyz) // share))].astype(np.float64)
        clouds.append(xyz @ sweep.world_from_lidar[:3, :3].T + sweep.world_from_lidar[:3, 3])
        records.append({"t": round(sweep.time_s - begin, 6), "first": first, "count": len(xyz)})
        first += len(xyz)
    points = np.concatenate(clouds)
    low = points.min(0) if len(points) else np.zeros(3)
    step = np.maximum((points.max(0) - low if len(points) else np.ones(3)) / 65535, 10 * LEAST_STEP_M)
    levels = np.ascontiguousarray(np.rint((points - low) / step).astype(np.uint16).T)
    return {"lidar": records, "lidar_low": low.tolist(), "lidar_step": step.tolist()}, levels
