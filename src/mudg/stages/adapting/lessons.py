"""What a log can teach about views that were not driven: its photographs as truth, seen without them.

A lesson is a drive that shows some photographs and not others:

* **gap**: blocks of consecutive frames are left out, every other block in the first lesson, the rest in the second. The truth are the
  photographs left out.
* **shifted**: every photograph is carried to a pose some metres to the side, with the depth of the scene fitted to the log; what it does
  not show there is rendered. These pictures are taken for a recorded drive, and the real photographs, now beside its path, are the
  truth. The way there goes by the depth of the first fit, the way back by that of another, which is fitted to the carried pictures alone,
  so holes, splinters and wrong parallax are those of a lateral shift.

A short fit to what a lesson shows gives the renders of its conditions, as `synthesize` would have them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mudg.base import palette
from mudg.base.types import Frame, Photo, Scene, Trajectory, View
from mudg.core import trajectory
from mudg.core.pictures import resize_area, resize_nearest
from mudg.data.clips.condition import ConditionRules, WarpSource, image_tensor, warp
from mudg.data.scene import photographs, read_image, read_points, read_scene, read_trusted_classes
from mudg.data.scene.photos import write_photos
from mudg.models.scene.model import SceneModel
from mudg.stages.config import AdaptConfig, FitConfig
from mudg.stages.fitting.planes import render_planes
from mudg.stages.fitting.short import short_fit
from mudg.stages.fitting.storage import load_model


@dataclass(frozen=True)
class Lesson:
    """A drive to learn from.

    Args:
        name: of its folder.
        shift_m: how far the shown pictures were carried to the left; 0 = they are photographs.
        shown: ids of the frames that are shown. truth: blocks of ids of the frames to be generated, one camera and at most
            `AdaptConfig.block` frames each, with the number of the block along the log.
    """

    name: str
    shift_m: float
    shown: tuple[str, ...]
    truth: tuple[tuple[int, tuple[str, ...]], ...]


@dataclass(frozen=True)
class LearntLog:
    """The log that is learned: folders of its scene, its fused cloud and the fit to it; width and height of the clips, and how many times
    finer their patches are."""

    scene: Path
    fused: Path
    fitted: Path
    width_px: int
    height_px: int
    scale: int


def cameras_of(scene: Scene, config: AdaptConfig) -> tuple[str, ...]:
    """The cameras that are learned."""
    return config.cameras or tuple(scene.cameras)[:1]


def blocks_of(scene: Scene, config: AdaptConfig) -> list[list[Frame]]:
    """The photographs that may be used, in blocks of `config.block` consecutive moments; all cameras of a moment lie in one block."""
    names = set(cameras_of(scene, config))
    frames = sorted((f for f in photographs(scene) if f.view.camera.name in names), key=lambda f: f.view.time_s)
    moment, last_s, blocks = -1, -np.inf, []
    for frame in frames:
        if frame.view.time_s - last_s > ConditionRules(1, 1).same_time_s:
            moment, last_s = moment + 1, frame.view.time_s
        if moment // config.block == len(blocks):
            blocks.append([])
        blocks[-1].append(frame)
    return blocks


def lessons_of(scene: Scene, config: AdaptConfig) -> list[Lesson]:
    """All lessons of a log."""
    blocks = blocks_of(scene, config)
    everything = tuple(f.id for block in blocks for f in block)
    clips = [(n, ids) for n, block in enumerate(blocks) for ids in _by_camera(block)]
    lessons = [Lesson(f"shift{shift:+g}", shift, everything, tuple(clips)) for shift in config.shifts_m]
    if config.gaps and len(blocks) >= 3:
        for odd in (0, 1):
            shown = tuple(f.id for n, block in enumerate(blocks) for f in block if n % 2 != odd)
            lessons.append(Lesson(f"gap{odd}", 0.0, shown, tuple((n, ids) for n, ids in clips if n % 2 == odd)))
    return lessons


def _by_camera(block: Sequence[Frame]) -> list[tuple[str, ...]]:
    names = dict.fromkeys(f.view.camera.name for f in block)
    return [tuple(f.id for f in block if f.view.camera.name == name) for name in names]


# what a lesson shows --------------------------------------------------------------------------------------------------


def shown_photos(scene: Scene, lesson: Lesson, config: AdaptConfig, model: SceneModel, width_px: int) -> list[Photo]:
    """The pictures of a lesson: photographs, or photographs carried to the side by a fitted scene (at most `width_px` wide)."""
    photos = []
    for frame in (f for f in scene.frames if f.id in set(lesson.shown)):
        photo = Photo(frame.view, read_image(scene, frame), read_trusted_classes(scene, frame))
        if lesson.shift_m:
            photo = carried(photo, moved_view(scene, frame.view, lesson.shift_m), model, width_px)
        photos.append(photo)
    return photos


def moved_view(scene: Scene, view: View, shift_m: float) -> View:
    """The view of a vehicle that is `shift_m` to the left."""
    path: Trajectory = trajectory.shifted(scene, view.camera.name, shift_m)
    return min(path.views, key=lambda v: abs(v.time_s - view.time_s))


def carried(photo: Photo, target: View, model: SceneModel, width_px: int) -> Photo:
    """A photograph as it would look from another pose: carried by the depth of a fitted scene, which is rendered where the photograph
    shows nothing."""
    camera = photo.view.camera
    width = min(width_px, camera.width)
    size = width, max(8, round(camera.height * width / camera.width))
    own, view = photo.view.resized(*size), target.resized(*size)
    here, there = render_planes(model, own), render_planes(model, view)
    unknown = np.full(size[::-1], palette.UNLABELLED, np.uint8)
    ids = torch.from_numpy(unknown if photo.semantics is None else resize_nearest(photo.semantics, *size[::-1]))
    still = torch.zeros(size[::-1], dtype=torch.bool)
    source = WarpSource(own, image_tensor(resize_area(photo.rgb, *size)), here.depth[0], still, ids)
    rgb, classes, found = warp(view, there.depth[0], source, here.depth[0], ConditionRules(1, 1).hidden_share)
    rgb = torch.where(found, rgb, there.color).clamp(0, 1)
    classes = torch.where(found, classes, there.semantics[0])
    pixels = (rgb * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    return Photo(view, pixels, None if photo.semantics is None else classes.numpy())


# the fit of a lesson --------------------------------------------------------------------------------------------------


FitScene = Callable[[FitConfig, Path, Path | None, Path], None]
"""Fits a scene with these settings and fused clouds into a folder (`folder`/fit); without clouds it makes its own (`folder`/fuse)."""


def fit_lesson(config: AdaptConfig, log: LearntLog, lesson: Lesson, folder: Path, fit_scene: FitScene) -> Path:
    """Write what a lesson shows as a scene (`folder`/scene), fuse it where photographs are missing (`folder`/fuse), and fit it
    (`folder`/fit); returns `folder`. What is there already is used again."""
    scene = read_scene(log.scene)
    if not (folder / "scene" / "scene.json").is_file():
        photos = shown_photos(scene, lesson, config, load_model(log.fitted), log.width_px * log.scale)
        sweeps = ((s.sensor, s.time_s, s.world_from_lidar, read_points(scene, s)) for s in scene.sweeps)
        write_photos(folder / "scene", scene.source, scene.ego, scene.tracks, photos, sweeps)
    camera = next(iter(scene.cameras.values()))
    device = "auto" if config.device.startswith("cuda") else "cpu"  # a GPU that lacks gsplat cannot draw
    settings = short_fit(config.fit_iterations, log.width_px, camera.width, config.seed, device)
    fit_scene(settings, folder / "scene", log.fused if lesson.shift_m else None, folder)
    return folder
