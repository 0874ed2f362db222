"""Names of the files in folders that several verbs write, as patterns (see `VerbOutput`). Imports nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

SCENE_FILES: Final = ("scene.json", "tracks.json", "images/*/*", "lidar/*/*.safetensors", "labels/*/*/*")
OBSERVATION_FILES: Final = ("observations.json", "rgb/*.png", "data/*.npz")
SWEEP_FILES: Final = ("sweeps.json", "*.safetensors")
LAYER_FILES: Final = ("layers.json", "*.safetensors", "*.png")
MODEL_FILES: Final = ("model.json", "gaussians.safetensors", "nodes.safetensors")


def below(folder: str, patterns: Sequence[str]) -> tuple[str, ...]:
    """The patterns for a sub-folder (itself a pattern)."""
    return tuple(f"{folder}/{pattern}" for pattern in patterns)
