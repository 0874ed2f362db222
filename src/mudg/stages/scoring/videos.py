"""FVD of a method on a trajectory: its clips as a set, against the clips of the recorded video of the same camera.

All views count, in order: held-out frames alone are no video. Clips have 16 frames and begin at every eighth, so that a drive of 40
frames gives four.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import store
from mudg.base.devices import choose_device
from mudg.base.types import Scene
from mudg.core.feature_distances import frechet_distance
from mudg.data.weights import read_checkpoint
from mudg.models import i3d
from mudg.pages import score_tables
from mudg.stages.config import ScoreConfig
from mudg.stages.scoring.distributions import (
    FEATURES_FOLDER,
    FEWEST,
    FeatureSets,
    ImageSet,
    TrajectorySets,
    kept_features,
    recorded_images,
)

CLIP_FRAMES: Final = 16
HOP_FRAMES: Final = 8


class ClipFiles:
    """Features of the clips of a video by FVD's network, kept in a folder.

    Args:
        weights: file with the network's weights. rule: how frames get its size. folder: where features are kept. device: of the network.

    Raises:
        InputError: the file is missing, damaged, or holds another network.
    """

    def __init__(self, weights: Path, rule: i3d.VideoRule, folder: Path, device: torch.device) -> None:
        self.rule: i3d.VideoRule = rule
        state = read_checkpoint(weights)
        self.sha256 = store.sha256_file(weights)
        self._folder, self._device = folder, device
        self._network = i3d.I3DFeatures(state, str(weights)).to(device)

    def of(self, images: ImageSet) -> NDArray[np.float32]:
        """Features f32[clips, 400]; no row if the video is shorter than a clip."""
        return self.named(images)[1]

    def named(self, images: ImageSet) -> tuple[str, NDArray[np.float32]]:
        """The name of the file that holds the features ("" if there is no clip), and the features."""
        count = clip_count(images.count)
        if not count:
            return "", np.zeros((0, i3d.WIDTH), np.float32)
        key = f"I3D {self.sha256} {self.rule} {CLIP_FRAMES} {HOP_FRAMES}"
        return kept_features(self._folder, key, images, (count, i3d.WIDTH), lambda: self._computed(images))

    def _computed(self, images: ImageSet) -> NDArray[np.float32]:
        rows = []
        for clip in self._clips(images):
            with torch.no_grad():
                rows.append(self._network(clip[None].to(self._device)).cpu().numpy())
        return np.concatenate(rows)

    def _clips(self, images: ImageSet) -> Iterator[Tensor]:
        """Clips f32[3, 16, 224, 224] in order of time."""
        window: list[Tensor] = []
        for number in range(images.count):
            window = [*window[-CLIP_FRAMES + 1 :], i3d.prepared_frame(images.image(number), self.rule)]
            begin = number + 1 - CLIP_FRAMES
            if begin >= 0 and begin % HOP_FRAMES == 0:
                yield torch.stack(window, 1)


def clip_count(frames: int) -> int:
    """How many clips a video has."""
    return 0 if frames < CLIP_FRAMES else (frames - CLIP_FRAMES) // HOP_FRAMES + 1


class VideoDistances:
    """FVD of every trajectory of a scene.

    Args:
        scene: whose recorded video is the reference. clips: how videos become features.
    """

    def __init__(self, scene: Scene, clips: ClipFiles) -> None:
        self._scene, self._clips = scene, clips
        self._floors: list[dict[str, Any]] = []
        self._sets = FeatureSets()

    def of(self, sets: TrajectorySets) -> dict[str, dict[str, Any] | str]:
        """By method ``{"fvd", "n", "n_reference"}``, or why there is none; the floor of the trajectory is noted for ``record``.

        Args:
            sets: with all views of every method, in order of time.
        """
        recorded = recorded_images(self._scene, sets)
        if not recorded.count:
            return dict.fromkeys(sets.methods, score_tables.NO_TRUTH)
        if min(clip_count(v.count) for v in (*sets.methods.values(), recorded)) < FEWEST:
            return dict.fromkeys(sets.methods, score_tables.TOO_FEW)
        name, reference = self._clips.named(recorded)
        found: dict[str, dict[str, Any] | str] = {}
        for method, images in sets.methods.items():
            own, made = self._clips.named(images.resized(sets.width, sets.height))
            self._sets.note(sets.name, method, own, name)
            found[method] = compared(made, reference)
        half = len(reference) // 2
        if sets.truth is not None:
            floor = compared(self._clips.of(sets.truth.resized(sets.width, sets.height)), reference)
            self._floors.append({"trajectory": sets.name, "how": "true images of the same views", **floor})
        elif half >= FEWEST:
            floor = compared(reference[:half], reference[half:])
            self._floors.append(
                {"trajectory": sets.name, "how": "first half of the recorded video against the second", **floor}
            )
        return found

    def record(self) -> dict[str, Any]:
        """How the numbers were made, and the floors, for metrics.json."""
        return {
            "network": "I3D, Kinetics-400, scores before the softmax, 400 values", "weights_sha256": self._clips.sha256,
            "norm_epsilon": i3d.NORM_EPSILON, "resize": self._clips.rule, "clip_frames": CLIP_FRAMES, "hop_frames": HOP_FRAMES,
            "reference": "recorded video of the same camera", "covariance": "n - 1", "floors": self._floors,
            "sets": self._sets.records,
        }  # fmt: skip


def compared(made: NDArray[np.float32], reference: NDArray[np.float32]) -> dict[str, Any]:
    """FVD of two sets of features ``[n, d]`` with their sizes."""
    return {"fvd": round(frechet_distance(made, reference), 6), "n": len(made), "n_reference": len(reference)}


def videos_of(config: ScoreConfig, scene: Scene, out: Path) -> VideoDistances | None:
    """What computes FVD, or None where no weights are given.

    Raises:
        InputError: the file of weights is missing, damaged, or holds another network.
    """
    if not config.fvd_weights:
        return None
    device = choose_device(config.device, "networks of the scores")
    return VideoDistances(scene, ClipFiles(Path(config.fvd_weights), config.fvd_resize, out / FEATURES_FOLDER, device))
