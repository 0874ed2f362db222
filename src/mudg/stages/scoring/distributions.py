"""FID and KID of a method on a trajectory: its images as a set, against the recorded frames of the same camera.

The reference is the recorded video, as in published tables, so there is a number off the recorded path of a driving log, too, where no
other metric has a truth. Sets are small, and FID of small sets is mostly bias: every trajectory also gets a floor, what the truth itself
would score.

Features are kept in the folder of the scores, in a file whose name is the hash of weights, rule and pixels: an interrupted run does not
compute a set again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import seeds, store
from mudg.base.devices import choose_device
from mudg.base.errors import InputError
from mudg.base.types import Scene
from mudg.core import feature_distances
from mudg.core.pictures import resize_rgb, to_bytes
from mudg.data.scene import read_image
from mudg.data.weights import read_checkpoint
from mudg.models import inception
from mudg.pages import score_tables
from mudg.stages.config import ScoreConfig
from mudg.stages.scoring.converted import source_sha256

FEATURES_FOLDER: Final = "features"
FEWEST: Final = 2
BLOCK_FRAMES: Final = 8
"""Neighbouring frames that the error of KID takes as one draw."""
FEWEST_BLOCKS: Final = 4
FEWEST_TO_EXTRAPOLATE: Final = 1000
_BATCH: Final = 8


@dataclass(frozen=True)
class ImageSet:
    """Images u8[H, W, 3] that are read one at a time: ``image(number)`` for 0 to ``count`` - 1."""

    count: int
    image: Callable[[int], NDArray[np.uint8]]

    def resized(self, width: int, height: int) -> ImageSet:
        """The same images at one size, bilinear with antialiasing."""

        def image(number: int) -> NDArray[np.uint8]:
            found = self.image(number)
            if found.shape[:2] == (height, width):
                return found
            planes = torch.from_numpy(np.array(found)).permute(2, 0, 1).float() / 255
            return to_bytes(resize_rgb(planes, height, width))

        return ImageSet(self.count, image)


@dataclass(frozen=True)
class TrajectorySets:
    """What is compared on one trajectory.

    Args:
        name, camera: of the trajectory. width, height: common size, pixels.
        methods: the counted images of every method.
        truth: the true images of the same views where they are known and are not the recorded ones, else None.
    """

    name: str
    camera: str
    width: int
    height: int
    methods: Mapping[str, ImageSet]
    truth: ImageSet | None


@dataclass(frozen=True)
class SetDistances:
    """FID and KID of ``n`` images against ``n_reference``, and what stands beside them in metrics.json."""

    n: int
    n_reference: int
    fid: float
    kid: float
    kid_standard_error: float | None
    mind: float
    fid_at_infinity: float | None

    def record(self) -> dict[str, Any]:
        """As JSON values, rounded to 6 digits after the point."""
        values = {
            "kid_standard_error": self.kid_standard_error,
            "mind": self.mind,
            "fid_at_infinity": self.fid_at_infinity,
        }
        return {
            "n": self.n,
            "n_reference": self.n_reference,
            **{k: None if v is None else round(v, 6) for k, v in values.items()},
        }


@dataclass(frozen=True)
class EmbeddingFiles:
    """Embeddings of sets of images by a network, kept in a folder.

    Args:
        network: images ``[n, 3, h, w]`` -> ``[n, width]``. prepare: an image u8[H, W, 3] as the network wants it. width: of the embedding.
        key: weights and rules, by which kept files are found. folder: where they lie. device: of the network.
    """

    network: Callable[[Tensor], Tensor]
    prepare: Callable[[NDArray[np.uint8]], Tensor]
    width: int
    key: str
    folder: Path
    device: torch.device

    def of(self, images: ImageSet) -> NDArray[np.float32]:
        """Embeddings f32[n, width], read from the folder if these very pixels were seen before."""
        return self.named(images)[1]

    def named(self, images: ImageSet) -> tuple[str, NDArray[np.float32]]:
        """The name of the file that holds the embeddings ("" of an empty set), and the embeddings f32[n, width]."""
        if not images.count:
            return "", np.zeros((0, self.width), np.float32)
        return kept_features(self.folder, self.key, images, (images.count, self.width), lambda: self._computed(images))

    def _computed(self, images: ImageSet) -> NDArray[np.float32]:
        batches = []
        for start in range(0, images.count, _BATCH):
            batch = [self.prepare(images.image(n)) for n in range(start, min(start + _BATCH, images.count))]
            with torch.no_grad():
                batches.append(self.network(torch.stack(batch).to(self.device)).cpu().numpy())
        return np.concatenate(batches)


class FeatureFiles:
    """Features of sets of images by FID's network, kept in a folder.

    Args:
        weights: file with the network's weights. rule: how images get its size. folder: where features are kept. device: of the network.

    Raises:
        InputError: the file is missing, damaged, or holds another network.
    """

    def __init__(self, weights: Path, rule: inception.ResizeRule, folder: Path, device: torch.device) -> None:
        self.rule: inception.ResizeRule = rule
        state = read_checkpoint(weights)
        self.sha256, self.source_sha256 = store.sha256_file(weights), source_sha256(weights)
        network = inception.InceptionFeatures(state, str(weights)).to(device)
        self._files = EmbeddingFiles(
            lambda batch: network(batch)["2048"], lambda rgb: inception.prepared(rgb, rule), inception.WIDTH,
            f"Inception {self.sha256} {rule}", folder, device,
        )  # fmt: skip

    def of(self, images: ImageSet) -> NDArray[np.float32]:
        """Features f32[n, 2048] of a set."""
        return self._files.of(images)

    def named(self, images: ImageSet) -> tuple[str, NDArray[np.float32]]:
        """The name of the file that holds the features of a set, and the features."""
        return self._files.named(images)


def kept_features(
    folder: Path, key: str, images: ImageSet, shape: tuple[int, int], compute: Callable[[], NDArray[np.float32]]
) -> tuple[str, NDArray[np.float32]]:
    """The name of the file with the features of a set, and the features: from a folder if these very pixels went through the same network
    before, else computed and kept there.

    Args:
        folder: where files lie. key: weights and rules. images: what is described. shape: of the features. compute: makes them.
    """
    content = hashlib.sha256(f"{key} {images.count}".encode())
    for number in range(images.count):
        picture = images.image(number)
        content.update(str(picture.shape).encode() + np.ascontiguousarray(picture).tobytes())
    path = folder / f"{content.hexdigest()}.safetensors"
    if path.is_file():
        found = store.read_safetensors(path).get("features")
        if found is not None and found.shape == shape:
            return path.name, found
    features = compute()
    store.write_safetensors(path, {"features": features})
    return path.name, features


def recorded_images(scene: Scene, sets: TrajectorySets) -> ImageSet:
    """The recorded frames of a trajectory's camera at the common size, in order of time; none if the scene lacks the camera."""
    frames = scene.frames_of(sets.camera) if sets.camera in scene.cameras else ()
    return ImageSet(len(frames), lambda number: read_image(scene, frames[number])).resized(sets.width, sets.height)


@dataclass(frozen=True)
class FeatureSets:
    """Which files of features were compared, so that sets of several logs can be pooled: one record per method and trajectory."""

    records: list[dict[str, str]] = field(default_factory=list)

    def note(self, trajectory: str, method: str, made: str, reference: str) -> None:
        """Note the names of two files in the folder of features."""
        self.records.append({"trajectory": trajectory, "method": method, "made": made, "reference": reference})


class Distributions:
    """FID and KID of every trajectory of a scene.

    Args:
        scene: whose recorded frames are the reference. features: how images become features.
    """

    def __init__(self, scene: Scene, features: FeatureFiles) -> None:
        self._scene, self._features = scene, features
        self._recorded: dict[tuple[str, int, int], tuple[str, NDArray[np.float32]]] = {}
        self._floors: list[dict[str, Any]] = []
        self._sets = FeatureSets()

    def of(self, sets: TrajectorySets) -> dict[str, SetDistances | str]:
        """Distances by method, or why there are none; the floor of the trajectory is noted for ``record``.

        Raises:
            InputError: methods have different numbers of images.
        """
        counts = {method: images.count for method, images in sets.methods.items()}
        if len(set(counts.values())) > 1:
            raise InputError("FID of sets of different size cannot be compared", where=sets.name, expected="the same views for all methods",
                got=", ".join(f"{method}: {count}" for method, count in counts.items()))  # fmt: skip
        name, reference = self._reference(sets)
        if not len(reference):
            return dict.fromkeys(counts, score_tables.NO_TRUTH)
        if min(*counts.values(), len(reference)) < FEWEST:
            return dict.fromkeys(counts, score_tables.TOO_FEW)
        found: dict[str, SetDistances | str] = {}
        for method, images in sets.methods.items():
            own, made = self._features.named(images.resized(sets.width, sets.height))
            self._sets.note(sets.name, method, own, name)
            found[method] = distances(made, reference)
        self._note_floor(sets, reference)
        return found

    def record(self) -> dict[str, Any]:
        """How the numbers were made, and the floors, for metrics.json."""
        return {
            "network": "Inception-v3 of 2015, global average, 2048 values", "weights_sha256": self._features.sha256,
            "published_weights": self._features.source_sha256 == inception.KNOWN_SHA256, "resize": self._features.rule,
            "reference": "recorded frames of the same camera", "covariance": "n - 1", "floors": self._floors, "sets": self._sets.records,
        }  # fmt: skip

    def _reference(self, sets: TrajectorySets) -> tuple[str, NDArray[np.float32]]:
        key = (sets.camera, sets.width, sets.height)
        if key not in self._recorded:
            self._recorded[key] = self._features.named(recorded_images(self._scene, sets))
        return self._recorded[key]

    def _note_floor(self, sets: TrajectorySets, reference: NDArray[np.float32]) -> None:
        if sets.truth is not None:
            how = "true images of the same views"
            found = distances(self._features.of(sets.truth.resized(sets.width, sets.height)), reference)
        elif len(reference) >= 2 * FEWEST:
            how, found = "every second recorded frame against the others", distances(reference[::2], reference[1::2])
        else:
            return
        values = {"fid": round(found.fid, 6), "kid": round(found.kid, 6), **found.record()}
        self._floors.append({"trajectory": sets.name, "how": how, **values})


def distributions_of(config: ScoreConfig, scene: Scene, out: Path) -> Distributions | None:
    """What computes FID and KID, or None where no weights are given.

    Raises:
        InputError: the file of weights is missing, damaged, or holds another network.
    """
    if not config.fid_weights:
        return None
    device = choose_device(config.device, "networks of the scores")
    return Distributions(
        scene, FeatureFiles(Path(config.fid_weights), config.fid_resize, out / FEATURES_FOLDER, device)
    )


def distances(made: NDArray[np.float32], reference: NDArray[np.float32]) -> SetDistances:
    """All distances of two sets of features ``[n, d]``, at least two rows each; rows in order of time."""
    blocks = tuple(np.arange(len(rows)) // BLOCK_FRAMES for rows in (made, reference))
    error = None
    if all(len(set(numbers.tolist())) >= FEWEST_BLOCKS for numbers in blocks):
        error = feature_distances.kernel_distance_error(made, reference, blocks, seeds.numpy_rng(0, 0, "blocks of KID"))
    many = min(len(made), len(reference)) >= FEWEST_TO_EXTRAPOLATE
    return SetDistances(
        n=len(made), n_reference=len(reference), fid=feature_distances.frechet_distance(made, reference),
        kid=feature_distances.kernel_distance(made, reference), kid_standard_error=error,
        mind=feature_distances.mind_distance(made, reference, seeds.numpy_rng(0, 0, "directions of MIND")),
        fid_at_infinity=feature_distances.frechet_at_infinity(made, reference, seeds.numpy_rng(0, 0, "sizes of FID")) if many else None,
    )  # fmt: skip
