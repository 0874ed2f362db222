"""Weather, light and season of an edit script on the views of a fitted scene."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mudg.base.errors import InputError
from mudg.base.types import EgoPath, Observation, Scene, View
from mudg.base.weather_settings import Conditions
from mudg.core import trajectory
from mudg.core.weather import ShownView, drive_facts, edited_view
from mudg.core.weather.light import curve_of
from mudg.diffusion.inputs import InWeather

WITNESSES: Final = 8
"""Recorded views by which the light of a drive is estimated, spread over cameras and time."""
SEED: Final = 0
"""Drops and flakes are functions of place, time and this seed: the same in every render of a drive."""
Drawer = Callable[[View], Observation]


def conditions_of(script: Sequence[Mapping[str, Any]]) -> Conditions | None:
    """Weather, light and season that a script (``EditScript.canonical``) asks for, each as its last verb says; None: it
    asks for none."""
    asked = {
        verb: settings for edit in script for verb, settings in edit.items() if verb in ("weather", "light", "season")
    }
    return Conditions.model_validate(asked) if asked else None


def weather_of(draw: Drawer, conditions: Conditions, scene: Scene) -> InWeather:
    """Weather for all views of a drive, with its light and ground.

    Args:
        draw: the views as they are, with depth and classes.
        scene: its recorded views tell the light of the drive, its path where wheels went and how fast the cameras are.

    Raises:
        InputError: views without depth or classes.
    """
    frames = sorted(scene.frames, key=lambda frame: (frame.view.time_s, frame.view.camera.name))
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(WITNESSES, len(frames))).round().astype(int))
    witnesses = [_shown(draw(frames[int(index)].view)) for index in chosen]
    drive = drive_facts(witnesses, curve_of(conditions.response), _driven(scene.ego))
    return InWeather(conditions, drive, SEED, functools.partial(trajectory.velocity, scene.ego))


def in_weather(draw: Drawer, how: InWeather) -> Drawer:
    """What draws a view with the colours of other weather or light; depth, classes and confidence stay as they are.

    Args:
        draw: the views as they are, with depth and classes.
    """

    def drawn(view: View) -> Observation:
        seen = draw(view)
        rgb, _ = edited_view(_shown(seen), how.settings, how.seed, how.drive, how.velocity_at(view.time_s))
        return replace(seen, rgb=torch.from_numpy(np.ascontiguousarray(rgb.transpose(2, 0, 1), np.float32)).clamp(0, 1))

    return drawn


def _shown(seen: Observation) -> ShownView:
    if seen.depth is None or seen.semantics is None:
        raise InputError(
            "weather and light need depth and classes of every view",
            where=seen.source,
            got="views without them",
            remedy="fit a scene with labels, or take weather and light out of the script",
        )
    depth = seen.depth[0].nan_to_num(0.0).numpy().astype(np.float32)
    return ShownView(seen.view, seen.rgb.permute(1, 2, 0).numpy(), depth, seen.semantics.numpy().astype(np.uint8))


def _driven(path: EgoPath) -> NDArray[np.float64]:
    """x, y and yaw of the vehicle, f64[N, 3]."""
    poses = path.world_from_ego
    return np.column_stack([poses[:, 0, 3], poses[:, 1, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0])])
