"""Distances of videos in features that an extractor elsewhere made of their clips, such as V-JEPA (JEDi) or VideoMAE.

Extractors are not run here: a saved program (TorchScript, or an exported one) would be code from a file, and this package executes no data.
What they give is a table of numbers, and that is what is read: ``METHOD/TRAJECTORY.safetensors`` and ``recorded/CAMERA.safetensors``,
each with one tensor ``features`` [clips, values].
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.core.feature_distances import frechet_distance, polynomial_distance
from mudg.pages import score_tables
from mudg.stages.scoring.distributions import FEWEST

RECORDED: Final = "recorded"
TRUTH: Final = "truth"


class VideoFeatures:
    """Frechet and polynomial distances of every trajectory.

    Args:
        folder: of the tables.

    Raises:
        InputError: there is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise InputError("no such folder of features", where=str(folder),
                expected="METHOD/TRAJECTORY.safetensors and recorded/CAMERA.safetensors, each with a tensor features [clips, values]",
                remedy="run the extractor yourself and save what it gives; programs (TorchScript) are not read")  # fmt: skip
        self._folder = folder
        self._floors: list[dict[str, Any]] = []
        self._width: int | None = None

    def of(self, trajectory: str, camera: str, methods: Sequence[str]) -> dict[str, dict[str, Any] | str]:
        """By method ``values`` and numbers of clips, or why there are none; the floor of the trajectory is noted for ``record``."""
        reference = self._read(f"{RECORDED}/{camera}")
        if reference is None:
            return dict.fromkeys(methods, score_tables.NO_FEATURES)
        found: dict[str, dict[str, Any] | str] = {}
        for method in methods:
            made = self._read(f"{method}/{trajectory}")
            found[method] = score_tables.NO_FEATURES if made is None else _compared(made, reference)
        true = self._read(f"{TRUTH}/{trajectory}")
        if true is not None and not isinstance(floor := _compared(true, reference), str):
            sizes = {"n": floor["n"], "n_reference": floor["n_reference"]}
            self._floors.append({"trajectory": trajectory, "how": "true clips", **floor["values"], **sizes})
        return found

    def record(self) -> dict[str, Any]:
        """How the numbers were made, and the floors."""
        return {
            "features": "made elsewhere", "width": self._width, "folder_sha256": store.digest(self._folder), "covariance": "n - 1",
            "kernel": "(x.y / d)^2, biased, times 100", "reference": "clips of the recorded video of the same camera",
            "floors": self._floors,
        }  # fmt: skip

    def _read(self, name: str) -> NDArray[np.float64] | None:
        path = self._folder / f"{name}.safetensors"
        if not path.is_file():
            return None
        found = store.read_safetensors(path).get("features")
        if found is None or found.ndim != 2 or not np.issubdtype(found.dtype, np.floating):
            raise InputError("a table of video features is malformed", where=str(path), expected="one tensor features [clips, values]",
                got="no such tensor" if found is None else f"{found.dtype} {found.shape}")  # fmt: skip
        self._width = int(found.shape[1])
        return found.astype(np.float64)


def _compared(made: NDArray[np.float64], reference: NDArray[np.float64]) -> dict[str, Any] | str:
    if min(len(made), len(reference)) < FEWEST:
        return score_tables.TOO_FEW
    values = {"video_frechet": frechet_distance(made, reference), "video_mmd": polynomial_distance(made, reference)}
    return {"values": {k: round(v, 6) for k, v in values.items()}, "n": len(made), "n_reference": len(reference)}
