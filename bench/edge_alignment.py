"""How often the comparison of LiDAR and image edges is right: generated cities as they are, and with cameras turned by
a degree.

python bench/edge_alignment.py [--seeds 8]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from mudg.base import log
from mudg.base.geometry import from_rotation_translation
from mudg.base.types import Frame, Scene, View
from mudg.city.config import CityConfig
from mudg.city.logs import write_city
from mudg.scene.check import camera_alignment

TURNS_DEG = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
"""About the camera's y axis, about its x axis."""


def turned(scene: Scene, about_y_deg: float, about_x_deg: float) -> Scene:
    """The scene with every camera turned."""
    a, b = np.deg2rad(about_y_deg), np.deg2rad(about_x_deg)
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    turn = from_rotation_translation(about_y @ about_x, np.zeros(3))

    def frame(one: Frame) -> Frame:
        return replace(one, view=View(one.view.camera, one.view.world_from_cam @ turn, one.view.time_s))

    return replace(scene, frames=tuple(frame(one) for one in scene.frames))


def main() -> None:
    """Count verdicts over seeds, cameras and turns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=8)
    seeds = range(1, parser.parse_args().seeds + 1)
    log.set_quiet(True)
    right, wrong = [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            config = CityConfig(seed=seed, n_frames=3, rate_hz=5, width=320, height=214, supersample=1)
            scene = write_city(config, Path(folder) / str(seed))
            right += [found.verdict for found in camera_alignment(scene).values()]
            for turn in TURNS_DEG:
                wrong += [found.verdict for found in camera_alignment(turned(scene, *turn)).values()]
    for title, found in (("as it is", right), ("turned by a degree", wrong)):
        counts = ", ".join(f"{found.count(word)} {word}" for word in ("right", "doubtful", "unknown"))
        sys.stdout.write(f"{title}: {counts} of {len(found)}\n")


if __name__ == "__main__":
    main()
