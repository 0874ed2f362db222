"""Lessons that leave out a camera: its photographs are the truth, and all other cameras are shown.

What no other camera saw could only be guessed. So a pixel counts if a photograph of another camera, of any time, shows the place: by
the depth of the scene fitted to the whole log it lies inside that photograph and nothing hides it there. Surfaces that may move count only
in photographs of the same moment, the sky never. Elsewhere the truth is what the unadapted model generates, as for depth and classes.
A clip of which others saw less than `LEAST_SEEN` is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mudg.base import log
from mudg.base.camera_colors import CameraColors
from mudg.base.palette import DYNAMIC_IDS
from mudg.base.types import Frame, Scene, View
from mudg.core.pictures import resize_nearest
from mudg.data.clips.condition import ConditionRules, WarpSource, warp
from mudg.data.scene import photographs, read_label
from mudg.models.scene.model import SceneModel
from mudg.stages.adapting.lessons import Lesson, blocks_of
from mudg.stages.config import AdaptConfig
from mudg.stages.fitting.planes import render_planes

LEAST_SEEN = 0.05
"""Least share of a clip's pixels that other cameras saw."""
WITNESS_WIDTH_PX = 128
"""Width at which the depth of other photographs is rendered."""
_RULES = ConditionRules(1, 1)


@dataclass(frozen=True, eq=False)
class Witnesses:
    """Photographs that are asked whether they show something, and the fitted scene that tells how far away it is."""

    model: SceneModel
    shown: tuple[WarpSource, ...]
    """Without colours; not usable where the ego vehicle stands before the camera."""

    @classmethod
    def of(cls, scene: Scene, frames: Sequence[Frame], model: SceneModel) -> Witnesses:
        """Some photographs of a scene, by the depth of a fitted model."""
        return cls(model, tuple(_witness(scene, frame, model) for frame in frames))

    def see(self, view: View) -> Tensor:
        """Which pixels of a view show what one of them shows, bool[H,W]."""
        here = render_planes(self.model, view)
        moving, seen = torch.isin(here.semantics[0].long(), torch.tensor(DYNAMIC_IDS)), torch.zeros_like(here.alpha[0]) > 0
        for other in self.shown:
            found = warp(view, here.depth[0], other, other.depth, _RULES.hidden_share)[2]
            seen |= found if abs(other.view.time_s - view.time_s) <= _RULES.same_time_s else found & ~moving
        return seen & (here.alpha[0] >= _RULES.solid_alpha)


def _witness(scene: Scene, frame: Frame, model: SceneModel) -> WarpSource:
    view = _small(frame.view)
    depth = render_planes(model, view).depth[0]
    usable = None
    if "ego" in frame.labels:
        usable = torch.from_numpy(~resize_nearest(read_label(scene, frame, "ego"), *depth.shape).astype(bool))
    nothing = torch.zeros_like(depth, dtype=torch.uint8)
    return WarpSource(view, torch.zeros(1, *depth.shape), depth, nothing > 0, nothing, usable)


def _small(view: View) -> View:
    camera = view.camera
    width = min(WITNESS_WIDTH_PX, camera.width)
    return view.resized(width, max(1, round(camera.height * width / camera.width)))


def others_of(scene: Scene, camera: str) -> list[Frame]:
    """The photographs of all cameras but one."""
    return [frame for frame in photographs(scene) if frame.view.camera.name != camera]


def camera_lessons(scene: Scene, config: AdaptConfig, model: SceneModel) -> list[Lesson]:
    """The lessons of the cameras that are to be left out, as far as others saw what these show; `model`: fitted to the whole log."""
    blocks = [[frame.view.time_s for frame in block] for block in blocks_of(scene, config)]
    lessons = []
    for camera in dict.fromkeys(config.cameras_left_out):
        rows: dict[int, list[Frame]] = {}
        for frame in sorted((f for f in photographs(scene) if f.view.camera.name == camera), key=lambda f: f.view.time_s):
            apart = [min(abs(frame.view.time_s - time_s) for time_s in block) for block in blocks]
            rows.setdefault(apart.index(min(apart)), []).append(frame)
        others = others_of(scene, camera)
        witnesses = Witnesses.of(scene, others, model)
        shares = {n: _seen_share(witnesses, frames) for n, frames in rows.items()}
        truth = tuple((n, tuple(f.id for f in rows[n][: config.block])) for n, share in shares.items() if share >= LEAST_SEEN)
        said = f"{len(truth)} of {len(rows)} blocks of {camera}, of which other cameras saw {max(shares.values(), default=0):.0%} at most"
        log.info(f"adapt: {said}") if truth else log.warn(f"{said}: no lesson leaves this camera out")
        if truth:
            lessons.append(Lesson(f"without_{camera}", 0.0, tuple(f.id for f in others), truth, camera))
    return lessons


def _seen_share(witnesses: Witnesses, frames: Sequence[Frame]) -> float:
    """Share of the pixels of some frames that witnesses see."""
    return float(torch.stack([witnesses.see(_small(f.view)).float().mean() for f in frames]).mean())


def recolored(rgb: Tensor, camera: str, shown: str, whole: CameraColors, lesson: CameraColors) -> Tensor:
    """A photograph f32[3,H,W] of the camera that a lesson leaves out, in the common colours of the cameras that it shows.

    Args:
        shown: a camera of both the log and the lesson. whole, lesson: the colours of their cameras.
    """
    there = whole.image_of(shown, whole.image_to_common(camera, rgb))
    return lesson.image_to_common(shown, there).clamp(0, 1)
