"""The simulator in gymnasium's shape (``pip install 'mudg[sim]'``): a vehicle, its cameras, the road users of a log.

env = Env("mudg_demo", cameras="front", layers=("rgb", "depth"))
observation, info = env.reset(seed=0)
observation, reward, terminated, truncated, info = env.step([1.0, 0.0])
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg.base.errors import UsageError
from mudg.base.palette import UNLABELLED
from mudg.base.types import Scene
from mudg.sim.drive import Cockpit, Controls, Drive, Traffic
from mudg.sim.session import CameraReply, Layer, Session

LEAST: Final = (-8.0, -0.8)
MOST: Final = (4.0, 0.8)
"""Limits of an action: acceleration in m/s^2, steering rate in rad/s."""
LIMITS: Final = {
    "rgb": (0, 255, np.uint8, (3,)),
    "depth": (0, np.inf, np.float32, ()),
    "distance": (0, np.inf, np.float32, ()),
    "classes": (0, UNLABELLED, np.uint8, ()),
    "instances": (0, 65535, np.uint16, ()),
    "normals": (-1, 1, np.float32, (3,)),
    "confidence": (0, 1, np.float32, ()),
}
"""Least and largest value, type and last axes of every layer."""
Observation = dict[str, Any]


class Env(gym.Env[Observation, NDArray[np.float32]]):
    """Drive the recorded vehicle in a reconstruction.

    An action is f32[2]: acceleration in m/s^2 (negative: brakes) and steering rate in rad/s (positive: to the left).
    An observation holds ``motion`` f32[2], speed in m/s and steering angle in rad, and for every camera a dict of
    layers as in ``CameraReply``; where a pixel has no surface, depth is infinite and a normal is 0. The reward is the
    way along the recorded road in metres. An episode is terminated by a collision, or ``largest_shift_m`` away from the
    recorded path; it is truncated where the log ends. ``info``: ``time_s``, ``pose`` f64[4, 4] of the vehicle in the
    world, ``progress_m``, ``shift_m`` to the left of the path, ``collision`` (name of an object, "surroundings" or
    empty), ``trust`` by camera, and ``boxes`` of the road users: pose f64[4, 4] and size.

    ``run``, ``scene``: as for ``Session``, or an open one. ``cameras``: names (empty: the first one). ``width_px``: of
    the pictures (0 = as recorded). ``layers``: of the pictures; motion is not among them. ``step_s``: seconds per step.
    ``traffic``: ``log``: road users as recorded; ``idm``: they follow whoever is ahead. Raises what ``Session`` and
    ``Cockpit`` raise. UsageError: an unknown layer, or a step that is no positive time."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        run: str | Path | Session,
        scene: Scene | str | Path | None = None,
        *,
        cameras: str | Sequence[str] = (),
        width_px: int = 0,
        layers: Sequence[Layer] = ("rgb",),
        step_s: float = 0.1,
        traffic: Traffic = "log",
        largest_shift_m: float = 6.0,
        render_mode: str | None = "rgb_array",
    ) -> None:
        if unknown := [layer for layer in layers if layer not in LIMITS]:
            raise UsageError("no such layer", where="layers", expected=", ".join(LIMITS), got=", ".join(unknown))
        if not (math.isfinite(step_s) and step_s > 0):
            raise UsageError("a step takes a positive time", where="step_s", got=str(step_s))
        session = run if isinstance(run, Session) else Session(run, scene=scene)
        self.cockpit = Cockpit(session, cameras, width_px, layers)
        self.step_s, self.largest_shift_m, self.render_mode = step_s, largest_shift_m, render_mode
        self.traffic: Traffic = traffic
        self.metadata = {**self.metadata, "render_fps": round(1 / step_s)}
        self.action_space = gym.spaces.Box(np.array(LEAST, np.float32), np.array(MOST, np.float32))
        layer_space = lambda camera, low, high, kind, last: gym.spaces.Box(
            low, high, (camera.height, camera.width, *last), kind
        )
        spaces: dict[str, gym.Space[Any]] = {
            name: gym.spaces.Dict({layer: layer_space(camera, *LIMITS[layer]) for layer in layers})
            for name, camera in self.cockpit.cameras.items()
        }
        spaces["motion"] = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.observation_space = gym.spaces.Dict(spaces)
        self.drive: Drive | None = None
        self._seen: dict[str, CameraReply] = {}

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin a drive. ``options``: ``time_s`` where in the log it begins, ``shift_m`` how far to the left of the
        path. Nothing is drawn at random. UsageError: an unknown option, or a time outside the log."""
        super().reset(seed=seed)
        if unknown := sorted(set(options or {}) - {"time_s", "shift_m"}):
            raise UsageError("no such option", where="options", expected="time_s, shift_m", got=", ".join(unknown))
        self.drive = self.cockpit.drive(**dict(options or {}), traffic=self.traffic)
        return self._look(self.drive)

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Drive for a step. Actions beyond the limits are cut to them. UsageError: no drive has begun, or the action is
        not two finite numbers."""
        drive = self._driving()
        asked = np.asarray(action, np.float64)
        if asked.shape != (2,) or not np.isfinite(asked).all():
            expected = "acceleration in m/s^2, steering rate in rad/s"
            raise UsageError("an action is two finite numbers", where="action", expected=expected, got=str(action)[:80])
        before = drive.progress_m
        acceleration, rate = np.clip(asked, LEAST, MOST)
        drive.step(Controls(float(acceleration), float(rate)), self.step_s)
        observation, info = self._look(drive)
        lost = bool(info["collision"]) or abs(info["shift_m"]) > self.largest_shift_m
        over = drive.time_s + self.step_s > self.cockpit.session.time_range_s[1] + 1e-6
        return observation, drive.progress_m - before, lost, over, info

    def render(self) -> NDArray[np.uint8]:
        """The pictures of all cameras side by side, u8[H, W, 3]."""
        self._driving()
        pictures = [reply.layers["rgb"] for reply in self._seen.values() if "rgb" in reply.layers]
        if not pictures:
            raise UsageError("there is no colour to show", where="layers", expected="rgb among them")
        height = max(len(picture) for picture in pictures)
        padded = [np.pad(p, ((0, height - len(p)), (0, 0), (0, 0))) for p in pictures]
        return np.concatenate(padded, 1)

    def _driving(self) -> Drive:
        if self.drive is None:
            raise UsageError("no drive has begun", where="Env", remedy="call reset() first")
        return self.drive

    def _look(self, drive: Drive) -> tuple[Observation, dict[str, Any]]:
        self._seen = self.cockpit.see(drive)
        observation: Observation = {name: reply.finite() for name, reply in self._seen.items()}
        observation["motion"] = np.array([drive.motion.speed_mps, drive.motion.steer_rad], np.float32)
        station, shift = drive.road.locate((drive.motion.x_m, drive.motion.y_m))
        info = {"time_s": drive.time_s, "pose": drive.pose, "progress_m": station, "shift_m": shift}
        info |= {"collision": drive.collision(), "trust": {name: reply.trust for name, reply in self._seen.items()}}
        info["boxes"] = {n: (box.world_from_box.copy(), np.array(box.size_m)) for n, box in drive.boxes().items()}
        return observation, info
