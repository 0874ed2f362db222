"""Scores of images through one embedding each: FD-DINOv2 and consistency with DINOv2, CMMD, CLIP-F and CLIP-V with CLIP.

Distances of sets compare the counted views of a trajectory with the recorded frames of the same camera, as FID does. CLIP-F and consistency
follow the video, so all views count.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import store
from mudg.base.devices import choose_device
from mudg.base.types import Scene, View
from mudg.core.feature_distances import cmmd_distance, frechet_distance
from mudg.data.weights import read_checkpoint
from mudg.models import clip_image, dinov2
from mudg.pages import score_tables
from mudg.stages.config import ScoreConfig
from mudg.stages.score_truth import SAME_TIME_S
from mudg.stages.scoring.distributions import (
    FEATURES_FOLDER,
    FEWEST,
    EmbeddingFiles,
    ImageSet,
    TrajectorySets,
    recorded_images,
)

Rows = NDArray[np.float32]


class SetDistance:
    """A distance of counted views from the recorded frames, with its floors.

    Args:
        scene: whose recorded frames are the reference. files: makes embeddings. name: of the metric. distance: of two sets.
    """

    def __init__(self, scene: Scene, files: EmbeddingFiles, name: str, distance: Callable[[Rows, Rows], float]) -> None:
        self.scene, self.files, self._name, self._distance = scene, files, name, distance
        self.floors: list[dict[str, Any]] = []

    def recorded(self, sets: TrajectorySets) -> Rows:
        """Embeddings of the recorded frames of a trajectory's camera."""
        return self.files.of(recorded_images(self.scene, sets))

    def note_floor(self, sets: TrajectorySets, reference: Rows, counted: Sequence[int]) -> None:
        """Note what the truth itself scores."""
        if sets.truth is not None:
            how, made, against = (
                "true images of the same views",
                self.files.of(_sized(sets.truth, sets))[list(counted)],
                reference,
            )
        elif len(reference) >= 2 * FEWEST:
            how, made, against = "every second recorded frame against the others", reference[::2], reference[1::2]
        else:
            return
        floor = {self._name: round(self._distance(made, against), 6), "n": len(made), "n_reference": len(against)}
        self.floors.append({"trajectory": sets.name, "how": how, **floor})

    def value(self, made: Rows, reference: Rows) -> dict[str, Any]:
        """The distance and the sizes of both sets; or why there is none."""
        if not len(reference):
            return {"values": {self._name: score_tables.NO_TRUTH}}
        if min(len(made), len(reference)) < FEWEST:
            return {"values": {self._name: score_tables.TOO_FEW}}
        found = {self._name: round(self._distance(made, reference), 6)}
        return {"values": found, "n": len(made), "n_reference": len(reference)}


def _sized(images: ImageSet, sets: TrajectorySets) -> ImageSet:
    return images.resized(sets.width, sets.height)


class DinoScores:
    """FD-DINOv2 and the consistency of the video, of every trajectory of a scene."""

    def __init__(self, scene: Scene, files: EmbeddingFiles, made: dict[str, Any]) -> None:
        self._sets, self._made = SetDistance(scene, files, "fd_dinov2", frechet_distance), made

    def of(
        self, sets: TrajectorySets, counted: Sequence[int], _views: Sequence[View]
    ) -> dict[str, dict[str, Any] | str]:
        """By method ``values`` and sizes; ``sets`` holds all views, of which those ``counted`` enter the distance."""
        reference, found = self._sets.recorded(sets), {}
        for method, images in sets.methods.items():
            rows = self._sets.files.of(_sized(images, sets))
            of = self._sets.value(rows[list(counted)], reference)
            steady = subject_consistency(rows)
            of["values"]["subject_consistency"] = score_tables.TOO_FEW if steady is None else round(steady, 6)
            found[method] = of
        self._sets.note_floor(sets, reference, counted)
        return found

    def record(self) -> dict[str, Any]:
        """How the numbers were made, and the floors."""
        return {**self._made, "floors": self._sets.floors}


class ClipScores:
    """CMMD, CLIP-F and CLIP-V of every trajectory of a scene."""

    def __init__(self, scene: Scene, files: EmbeddingFiles, made: dict[str, Any]) -> None:
        self._scene, self._made = scene, made
        self._sets = SetDistance(scene, files, "cmmd", cmmd_distance)

    def of(
        self, sets: TrajectorySets, counted: Sequence[int], views: Sequence[View]
    ) -> dict[str, dict[str, Any] | str]:
        """By method ``values`` and sizes; ``sets`` holds all views, of which those ``counted`` enter the distance and CLIP-V."""
        reference, found = self._sets.recorded(sets), {}
        frames = self._scene.frames_of(sets.camera) if sets.camera in self._scene.cameras else ()
        times = np.array([frame.view.time_s for frame in frames])
        pairs = []
        for place in counted if len(times) else ():
            nearest = int(np.argmin(np.abs(times - views[place].time_s)))
            if abs(times[nearest] - views[place].time_s) <= SAME_TIME_S:
                pairs.append((place, nearest))
        for method, images in sets.methods.items():
            rows = self._sets.files.of(_sized(images, sets))
            of = self._sets.value(rows[list(counted)], reference)
            units = _units(rows)
            steps = (units[1:] * units[:-1]).sum(1)
            of["values"]["clip_f"] = round(float(steps.mean()), 6) if len(steps) else score_tables.TOO_FEW
            sources = _units(reference)
            same = [float(units[a] @ sources[b]) for a, b in pairs]
            of["values"]["clip_v"] = round(sum(same) / len(same), 6) if same else score_tables.NO_TRUTH
            found[method] = of
        self._sets.note_floor(sets, reference, counted)
        return found

    def record(self) -> dict[str, Any]:
        """How the numbers were made, and the floors."""
        return {**self._made, "floors": self._sets.floors}


def _units(rows: Rows) -> NDArray[np.float64]:
    values = rows.astype(np.float64)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)


def subject_consistency(rows: NDArray[np.floating]) -> float | None:
    """Mean over frames from the second on of (max(0, cosine with the one before) + max(0, cosine with the first)) / 2, as VBench's subject
    consistency does it; None with fewer than two frames ``[n, d]``."""
    if len(rows) < 2:
        return None
    units = _units(np.asarray(rows, np.float32))
    before, first = (units[1:] * units[:-1]).sum(1), units[1:] @ units[0]
    return float(((np.maximum(before, 0) + np.maximum(first, 0)) / 2).mean())


def dino_of(config: ScoreConfig, scene: Scene, out: Path) -> DinoScores | None:
    """What computes FD-DINOv2, or None where no weights are given.

    Raises:
        InputError: the file of weights is missing, damaged, or holds another network.
    """
    if not config.dino_weights:
        return None
    path, device = Path(config.dino_weights), choose_device(config.device, "networks of the scores")
    network = dinov2.DinoFeatures(read_checkpoint(path), str(path)).to(device)
    sha256 = store.sha256_file(path)
    files = EmbeddingFiles(network, dinov2.prepared, network.width, f"DINOv2 {sha256}", out / FEATURES_FOLDER, device)
    made = {
        "network": f"DINOv2 {network.name}, class token, {network.width} values", "weights_sha256": sha256,
        "resize": "dgm-eval: Pillow's bicubic on 8 bits to 224x224", "positions": "bicubic by the factor (16 + 0.1) / 37",
        "reference": "recorded frames of the same camera", "covariance": "n - 1",
    }  # fmt: skip
    return DinoScores(scene, files, made)


def clip_of(config: ScoreConfig, scene: Scene, out: Path) -> ClipScores | None:
    """What computes CMMD, or None where no weights are given.

    Raises:
        InputError: the file of weights is missing, damaged, or holds another network.
    """
    if not config.clip_weights:
        return None
    path, device = Path(config.clip_weights), choose_device(config.device, "networks of the scores")
    network = clip_image.ClipImageFeatures(read_checkpoint(path), str(path)).to(device)
    sha256 = store.sha256_file(path)

    def prepare(rgb: NDArray[np.uint8]) -> Tensor:
        return clip_image.prepared(rgb, network.side)

    files = EmbeddingFiles(network, prepare, network.out, f"CLIP {sha256}", out / FEATURES_FOLDER, device)
    made = {
        "network": f"CLIP {network.name}, projected, {network.out} values", "weights_sha256": sha256,
        "resize": "bicubic without antialiasing, squashed", "kernel": "Gaussian, sigma 10, biased, times 1000",
        "reference": "recorded frames of the same camera",
    }  # fmt: skip
    return ClipScores(scene, files, made)
