"""Distances of whole sets of views: FID, KID, FVD, FD-DINOv2, CMMD and CLIP scores; and the detectors and anchors that
stand beside them.

The reference is the recorded video of the same camera, as in published tables, so there is a number off the recorded
path of a driving log, too, where no other metric has a truth. Sets are small, and FID of small sets is mostly bias:
every trajectory also gets a floor, what the truth itself would score.

Features are kept in the folder of the scores, in a file whose name is the hash of weights, rule and pixels: an
interrupted run does not compute a set again.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import log, seeds, store
from mudg.base.devices import choose_device
from mudg.base.errors import InputError
from mudg.base.types import Frame, Scene, View
from mudg.base.weights import read_checkpoint
from mudg.core import feature_distances
from mudg.core.feature_distances import cmmd_distance, frechet_distance
from mudg.core.pictures import resize_rgb, to_bytes
from mudg.editing.settings import ScoreConfig
from mudg.networks import clip_image, dinov2, i3d, inception
from mudg.networks.featnets import LpipsFeatures, LpipsTrunk, lpips_shapes
from mudg.scene.observations import ObservationSet, read_observations
from mudg.scene.read import read_image
from mudg.scoring import detections
from mudg.scoring import tables as score_tables
from mudg.scoring.detections import BoxDetections, LaneDetections, ViewImages
from mudg.scoring.facts import Reference, ScoredTrajectory
from mudg.scoring.tables import SET_SIZES
from mudg.scoring.truth import SAME_TIME_S

# -- weights ---------------------------------------------------------------------------------------
#
# Of the networks of the scores: a published file -> a folder with ``weights.safetensors`` and its origin.

WEIGHTS_FILE: Final = "weights.safetensors"
DESCRIPTION_FILE: Final = "model.json"
KIND: Final = "score network"
_LISTED: Final = 8


@dataclass(frozen=True)
class ScoreNetwork:
    """A network of the scores: what its files are called when they are used, and how its tensors are found in a
    published file. ``flag``: of ``mudg score``. ``check``: tensors -> nothing, or an InputError. ``named``: tensors of
    a file -> those of the network under the names that are written. ``published``: SHA-256 of published files -> their
    names."""

    flag: str
    check: Callable[[Mapping[str, Tensor], str], object]
    named: Callable[[Mapping[str, Tensor]], dict[str, Tensor]]
    published: Mapping[str, str]


def _lpips(trunk: LpipsTrunk, flag: str) -> ScoreNetwork:
    named = lambda found: {name: found[name] for name in lpips_shapes(trunk) if name in found}
    return ScoreNetwork(flag, lambda state, where: LpipsFeatures(state, where, trunk), named, {})


_without_counts = lambda state: {name: own for name, own in state.items() if not name.endswith("num_batches_tracked")}
_I3D_SHA256: Final = "bec6519f66ea534e953026b4ae2c65553c17bf105611c746d904657e5860a5e2"
_FID_FILES: Final = {inception.KNOWN_SHA256: "pt_inception-2015-12-05-6726825d.pth"}

NETWORKS: Final[Mapping[str, ScoreNetwork]] = {
    "inception": ScoreNetwork("--fid-weights", inception.InceptionFeatures, _without_counts, _FID_FILES),
    "i3d": ScoreNetwork("--fvd-weights", i3d.I3DFeatures, i3d.with_known_names, {_I3D_SHA256: "i3d_torchscript.pt"}),
    "dinov2": ScoreNetwork("--dino-weights", dinov2.DinoFeatures, dict, {}),
    "clip": ScoreNetwork("--clip-weights", clip_image.ClipImageFeatures, clip_image.with_openai_names, {}),
    "lpips": _lpips("alex", "--lpips-weights"),
    "lpips-vgg": _lpips("vgg", "--lpips-vgg-weights"),
}
"""Networks by the name that ``mudg convert --network`` takes."""


def convert_weights(network: str, checkpoint: Path, to: Path) -> None:
    """Write the folder ``to``: ``weights.safetensors`` in float32, and ``model.json`` with its origin. InputError: the
    file is missing, damaged, or holds another network; nothing is written."""
    kind, found = NETWORKS[network], read_checkpoint(checkpoint)
    tensors = kind.named(found)
    kind.check(tensors, str(checkpoint))
    sha256 = store.sha256_file(checkpoint)
    known = kind.published.get(sha256)
    with store.atomic_directory(to) as partial:
        written = {name: value.detach().float() for name, value in tensors.items()}
        store.write_safetensors(partial / WEIGHTS_FILE, written)
        files = {WEIGHTS_FILE: store.sha256_file(partial / WEIGHTS_FILE)}
        source = {"file": checkpoint.name, "bytes": checkpoint.stat().st_size, "sha256": sha256, "published_as": known}
        description = {"schema": 1, "kind": KIND, "network": network, "files": files, "source": source}
        store.write_json(partial / DESCRIPTION_FILE, description)
        store.sync_tree(partial)
    # names that changed, where one tensor became one
    places = {value.data_ptr(): name for name, value in found.items()}
    pairs = ((places.get(value.data_ptr(), ours), ours) for ours, value in tensors.items())
    renamed = [(theirs, ours) for theirs, ours in pairs if theirs != ours]
    for theirs, ours in renamed[:_LISTED]:
        log.info(f"convert: {theirs} -> {ours}")
    more = f" ({len(renamed) - _LISTED} more names changed)" if len(renamed) > _LISTED else ""
    other = "not a file whose hash is known" if kind.published else "no hash is on record"
    origin = f"the published {known}" if known else other
    log.info(f"convert: {len(tensors)} tensors{more}; SHA-256 of {checkpoint.name}: {sha256} ({origin})")
    log.info(f"convert: use it with mudg score {kind.flag} {to / WEIGHTS_FILE}")


def source_sha256(weights: Path) -> str:
    """SHA-256 of the published file that weights were converted from, if their folder says so; else that of the file
    itself."""
    own, description = store.sha256_file(weights), weights.parent / DESCRIPTION_FILE
    if weights.name != WEIGHTS_FILE or not description.is_file():
        return own
    content = store.read_json(description)
    if not isinstance(content, Mapping) or content.get("kind") != KIND:
        return own
    try:
        fits, source = content["files"][WEIGHTS_FILE] == own, str(content["source"]["sha256"])
    except (KeyError, TypeError) as error:
        what, got = "the description of converted weights is malformed", repr(error)
        raise InputError(what, where=str(description), got=got) from error
    return source if fits else own


# -- images ----------------------------------------------------------------------------------------
#
# FID and KID of a method on a trajectory: its images as a set, against the recorded frames of the same camera.

FEATURES_FOLDER: Final = "features"
FEWEST: Final = 2
BLOCK_FRAMES: Final = 8
"""Neighbouring frames that the error of KID takes as one draw."""
FEWEST_BLOCKS: Final = 4
_BATCH: Final = 8


Rows = NDArray[np.float32]
Entry = dict[str, Any]
"""``values`` by metric, and what stands beside them in metrics.json: sizes of the sets."""


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
    """What is compared on one trajectory. ``name``, ``camera``: of the trajectory. ``width``, ``height``: common size,
    pixels. ``methods``: the counted images of every method. ``truth``: the true images of the same views where they are
    known and are not the recorded ones, else None."""

    name: str
    camera: str
    width: int
    height: int
    methods: Mapping[str, ImageSet]
    truth: ImageSet | None


@dataclass
class EmbeddingFiles:
    """Features of sets of images by a network, kept in a folder: what went through the same network before is read.
    ``network``: images ``[n, 3, h, w]`` -> ``[n, width]``. ``prepare``: an image u8[H, W, 3] as the network wants it.
    ``width``: of the features. ``key``: weights and rules, by which kept files are found. ``folder``: where they lie.
    ``device``: of the network."""

    network: Callable[[Tensor], Tensor]
    prepare: Callable[[NDArray[np.uint8]], Tensor]
    width: int
    key: str
    folder: Path
    device: torch.device

    def of(self, images: ImageSet) -> NDArray[np.float32]:
        """Features f32[n, width], read from the folder if these very pixels were seen before."""
        return self.named(images)[1]

    def named(self, images: ImageSet) -> tuple[str, NDArray[np.float32]]:
        """The name of the file that holds the features ("" where there are none), and the features f32[n, width]."""
        shape = self.rows(images.count), self.width
        if not shape[0]:
            return "", np.zeros(shape, np.float32)
        content = hashlib.sha256(f"{self.key} {images.count}".encode())
        for number in range(images.count):
            picture = images.image(number)
            content.update(str(picture.shape).encode() + np.ascontiguousarray(picture).tobytes())
        path = self.folder / f"{content.hexdigest()}.safetensors"
        if path.is_file():
            kept = store.read_safetensors(path).get("features")
            if kept is not None and kept.shape == shape:
                return path.name, kept
        with torch.no_grad():
            batches = [self.network(batch.to(self.device)).cpu().numpy() for batch in self.batches(images)]
        features = np.concatenate(batches)
        store.write_safetensors(path, {"features": features})
        return path.name, features

    def rows(self, images: int) -> int:
        """How many features so many images have."""
        return images

    def batches(self, images: ImageSet) -> Iterator[Tensor]:
        """What goes through the network, a part at a time."""
        for start in range(0, images.count, _BATCH):
            numbers = range(start, min(start + _BATCH, images.count))
            yield torch.stack([self.prepare(images.image(n)) for n in numbers])


class FeatureFiles(EmbeddingFiles):
    """Features f32[n, 2048] of sets of images by FID's network, kept in a folder. ``weights``: file with the network's
    weights. ``rule``: how images get its size. ``folder``: where features are kept. ``device``: of the network.
    InputError: the file is missing, damaged, or holds another network."""

    def __init__(self, weights: Path, rule: inception.ResizeRule, folder: Path, device: torch.device) -> None:
        state, sha256 = read_checkpoint(weights), store.sha256_file(weights)
        network = inception.InceptionFeatures(state, str(weights)).to(device)
        prepare = functools.partial(inception.prepared, rule=rule)
        key = f"Inception {sha256} {rule}"
        super().__init__(network, prepare, inception.WIDTH, key, folder, device)
        self.rule: inception.ResizeRule = rule
        self.sha256, self.source_sha256 = sha256, source_sha256(weights)


EVERY_SECOND: Final = (lambda rows: (rows[::2], rows[1::2]), "every second recorded frame against the others")
Further = Callable[[Rows, Rows, Sequence[tuple[int, int]]], Mapping[str, float | str]]
"""From features of all views of a video and of the recorded frames, and pairs of both at the same time, to numbers by
metric, or why there is none."""


def set_entry(generated: Rows, reference: Rows, **distances: Callable[[Rows, Rows], float]) -> Entry:
    """Distances of two sets of features ``[n, d]`` by metric, and their sizes."""
    values = {name: round(distance(generated, reference), 6) for name, distance in distances.items()}
    return {"values": values, "n": len(generated), "n_reference": len(reference)}


class SetComparison:
    """A distance of sets of images for every trajectory of a scene, whose recorded frames are the reference. ``files``:
    how images become features. ``compare``: two sets of features to their numbers. ``facts``: how these are made.
    ``halves``: two parts of the reference, whose distance is the floor where no truth is known, and what they are.
    ``further``: what else the features tell of a video, if anything."""

    def __init__(
        self,
        scene: Scene,
        files: EmbeddingFiles,
        compare: Callable[[Rows, Rows], Entry],
        facts: Mapping[str, Any],
        halves: tuple[Callable[[Rows], tuple[Rows, Rows]], str] = EVERY_SECOND,
        further: tuple[str, Further] | None = None,
    ) -> None:
        self._scene, self._files, self._compare, self._facts = scene, files, compare, facts
        self._halves, self._further = halves, further
        self._recorded: dict[tuple[str, int, int], tuple[str, Rows]] = {}
        self._floors, self._sets = list[dict[str, Any]](), list[dict[str, str]]()

    def of(
        self, sets: TrajectorySets, counted: Sequence[int] | None = None, views: Sequence[View] = ()
    ) -> dict[str, Entry | str]:
        """Numbers by method, or why there are none; the floor of the trajectory is noted for ``record``. ``counted``:
        which of the images, of all ``views``, enter the distance (None: all). InputError: methods have different
        numbers of images."""
        counts = {method: images.count for method, images in sets.methods.items()}
        if len(set(counts.values())) > 1:
            what, expected = "FID of sets of different size cannot be compared", "the same views for all methods"
            got = ", ".join(f"{method}: {count}" for method, count in counts.items())
            raise InputError(what, where=sets.name, expected=expected, got=got)
        frames = self._scene.frames_of(sets.camera) if sets.camera in self._scene.cameras else ()
        recorded = ImageSet(len(frames), lambda number: read_image(self._scene, frames[number]))
        recorded = recorded.resized(sets.width, sets.height)
        sizes = [self._files.rows(count) if counted is None else len(counted) for count in counts.values()]
        few = min((*sizes, self._files.rows(recorded.count))) < FEWEST
        missing = score_tables.NO_TRUTH if not recorded.count else score_tables.TOO_FEW if few else ""
        if missing and self._further is None:
            return dict.fromkeys(counts, missing)
        key = (sets.camera, sets.width, sets.height)
        if key not in self._recorded:
            self._recorded[key] = self._files.named(recorded)
        (name, reference), found = self._recorded[key], dict[str, Entry | str]()
        chosen = lambda rows: rows if counted is None else rows[list(counted)]
        for method, images in sets.methods.items():
            own, rows = self._files.named(images.resized(sets.width, sets.height))
            if self._further is None:
                # which files were compared, so that sets of several logs can be pooled
                self._sets.append({"trajectory": sets.name, "method": method, "made": own, "reference": name})
                found[method] = self._compare(rows, reference)
                continue
            metric, further = self._further
            entry = {"values": {metric: missing}} if missing else self._compare(chosen(rows), reference)
            values = further(rows, reference, _same_times(counted or (), views, frames))
            entry["values"] |= {k: v if isinstance(v, str) else round(v, 6) for k, v in values.items()}
            found[method] = entry
        split, how = self._halves
        pair = split(reference)
        if sets.truth is not None:
            pair = chosen(self._files.of(sets.truth.resized(sets.width, sets.height))), reference
            how = "true images of the same views"
        if min(map(len, pair)) >= FEWEST:
            entry = self._compare(*pair)
            self._floors.append({"trajectory": sets.name, "how": how, **entry.pop("values"), **entry})
        return found

    def record(self) -> dict[str, Any]:
        """How the numbers were made, and the floors, for metrics.json."""
        return {**self._facts, "floors": self._floors, **({} if self._further else {"sets": self._sets})}


def _same_times(counted: Sequence[int], views: Sequence[View], frames: Sequence[Frame]) -> list[tuple[int, int]]:
    """Pairs of counted views and recorded frames at the same time."""
    times, pairs = np.array([frame.view.time_s for frame in frames]), []
    for place in counted if len(times) else ():
        nearest = int(np.argmin(np.abs(times - views[place].time_s)))
        if abs(times[nearest] - views[place].time_s) <= SAME_TIME_S:
            pairs.append((place, nearest))
    return pairs


def distributions_of(config: ScoreConfig, scene: Scene, out: Path) -> SetComparison:
    """What computes FID and KID."""
    device, folder = choose_device(config.device, "networks of the scores"), out / FEATURES_FOLDER
    return distributions(scene, FeatureFiles(Path(config.fid_weights), config.fid_resize, folder, device))


def distributions(scene: Scene, files: FeatureFiles) -> SetComparison:
    """What computes FID and KID."""
    facts = {
        "network": "Inception-v3 of 2015, global average, 2048 values",
        "weights_sha256": files.sha256,
        "published_weights": files.source_sha256 == inception.KNOWN_SHA256,
        "resize": files.rule,
        "reference": "recorded frames of the same camera",
        "covariance": "n - 1",
    }

    def entry(generated: Rows, reference: Rows) -> Entry:
        of = distances(generated, reference).items()
        rounded = {name: None if value is None else round(value, 6) for name, value in of}
        return {"values": {name: rounded.pop(name) for name in ("fid", "kid")}, **rounded}

    return SetComparison(scene, files, entry, facts)


def distances(generated: Rows, reference: Rows) -> dict[str, float | None]:
    """FID and KID of two sets of features ``[n, d]``, at least two rows each, rows in order of time; ``n`` and
    ``n_reference`` rows, and from enough of them on the standard error of KID."""
    blocks = tuple(np.arange(len(rows)) // BLOCK_FRAMES for rows in (generated, reference))
    error = None
    if all(len(set(numbers.tolist())) >= FEWEST_BLOCKS for numbers in blocks):
        rng = seeds.numpy_rng(0, 0, "blocks of KID")
        error = feature_distances.kernel_distance_error(generated, reference, blocks, rng)
    fid = feature_distances.frechet_distance(generated, reference)
    kid = feature_distances.kernel_distance(generated, reference)
    counts = {"n": len(generated), "n_reference": len(reference)}
    return {**counts, "fid": fid, "kid": kid, "kid_standard_error": error}


# -- videos ----------------------------------------------------------------------------------------
#
# FVD of a method on a trajectory: its clips as a set, against the clips of the recorded video of the same camera. All
# views count, in order: held-out frames alone are no video. Clips have 16 frames and begin at every eighth, so that a
# drive of 40 frames gives four.

CLIP_FRAMES: Final = 16
HOP_FRAMES: Final = 8


class ClipFiles(EmbeddingFiles):
    """Features f32[clips, 400] of the clips of a video by FVD's network, kept in a folder. ``weights``: file with the
    network's weights. ``rule``: how frames get its size. ``folder``: where features are kept. ``device``: of the
    network. InputError: the file is missing, damaged, or holds another network."""

    def __init__(self, weights: Path, rule: i3d.VideoRule, folder: Path, device: torch.device) -> None:
        state, self.sha256 = read_checkpoint(weights), store.sha256_file(weights)
        self.rule: i3d.VideoRule = rule
        network = i3d.I3DFeatures(state, str(weights)).to(device)
        key = f"I3D {self.sha256} {rule} {CLIP_FRAMES} {HOP_FRAMES}"
        prepare = functools.partial(i3d.prepared_frame, rule=rule)
        super().__init__(network, prepare, i3d.WIDTH, key, folder, device)

    def rows(self, images: int) -> int:
        """See ``EmbeddingFiles``: one per clip."""
        return clip_count(images)

    def batches(self, images: ImageSet) -> Iterator[Tensor]:
        """Clips f32[1, 3, 16, 224, 224] in order of time."""
        window: list[Tensor] = []
        for number in range(images.count):
            window = [*window[-CLIP_FRAMES + 1 :], self.prepare(images.image(number))]
            begin = number + 1 - CLIP_FRAMES
            if begin >= 0 and begin % HOP_FRAMES == 0:
                yield torch.stack(window, 1)[None]


def clip_count(frames: int) -> int:
    """How many clips a video has."""
    return 0 if frames < CLIP_FRAMES else (frames - CLIP_FRAMES) // HOP_FRAMES + 1


def video_entry(generated: Rows, reference: Rows) -> Entry:
    """FVD of two sets of features ``[n, d]``."""
    return set_entry(generated, reference, fvd=frechet_distance)


def videos_of(config: ScoreConfig, scene: Scene, out: Path) -> SetComparison:
    """What computes FVD; a trajectory's sets hold all views of every method, in order of time."""
    device = choose_device(config.device, "networks of the scores")
    files = ClipFiles(Path(config.fvd_weights), config.fvd_resize, out / FEATURES_FOLDER, device)
    made = {
        "network": "I3D, Kinetics-400, scores before the softmax, 400 values",
        "weights_sha256": files.sha256,
        "norm_epsilon": i3d.NORM_EPSILON,
        "resize": files.rule,
        "clip_frames": CLIP_FRAMES,
        "hop_frames": HOP_FRAMES,
        "reference": "recorded video of the same camera",
        "covariance": "n - 1",
    }
    halves = lambda rows: (rows[: len(rows) // 2], rows[len(rows) // 2 :])
    how = "first half of the recorded video against the second"
    return SetComparison(scene, files, video_entry, made, (halves, how))


# -- embeddings ------------------------------------------------------------------------------------
#
# Scores of images through one embedding each: FD-DINOv2 and consistency with DINOv2, CMMD, CLIP-F and CLIP-V with CLIP.
# Distances of sets compare the counted views of a trajectory with the recorded frames of the same camera, as FID does.
# CLIP-F and consistency follow the video, so all views count.


def _units(rows: Rows) -> NDArray[np.float64]:
    values = rows.astype(np.float64)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)


def subject_consistency(rows: NDArray[np.floating]) -> float | None:
    """Mean over frames from the second on of (max(0, cosine with the one before) + max(0, cosine with the first)) / 2,
    as VBench's subject consistency does it; None with fewer than two frames ``[n, d]``."""
    if len(rows) < 2:
        return None
    units = _units(np.asarray(rows, np.float32))
    before, first = (units[1:] * units[:-1]).sum(1), units[1:] @ units[0]
    return float(((np.maximum(before, 0) + np.maximum(first, 0)) / 2).mean())


def _clip_values(rows: Rows, reference: Rows, pairs: Sequence[tuple[int, int]]) -> dict[str, float | str]:
    """CLIP-F and CLIP-V."""
    units, sources = _units(rows), _units(reference)
    steps, same = (units[1:] * units[:-1]).sum(1), [float(units[a] @ sources[b]) for a, b in pairs]
    return {
        "clip_f": float(steps.mean()) if len(steps) else score_tables.TOO_FEW,
        "clip_v": sum(same) / len(same) if same else score_tables.NO_TRUTH,
    }


def dino_of(config: ScoreConfig, scene: Scene, out: Path) -> SetComparison:
    """What computes FD-DINOv2 and the consistency of the video."""
    path, device = Path(config.dino_weights), choose_device(config.device, "networks of the scores")
    network = dinov2.DinoFeatures(read_checkpoint(path), str(path)).to(device)
    sha256 = store.sha256_file(path)
    files = EmbeddingFiles(network, dinov2.prepared, network.width, f"DINOv2 {sha256}", out / FEATURES_FOLDER, device)
    made = {
        "network": f"DINOv2 {network.name}, class token, {network.width} values",
        "weights_sha256": sha256,
        "resize": "dgm-eval: Pillow's bicubic on 8 bits to 224x224",
        "positions": "bicubic by the factor (16 + 0.1) / 37",
        "reference": "recorded frames of the same camera",
        "covariance": "n - 1",
    }

    def further(rows: Rows, _reference: Rows, _pairs: Sequence[tuple[int, int]]) -> dict[str, float | str]:
        steady = subject_consistency(rows)
        return {"subject_consistency": score_tables.TOO_FEW if steady is None else steady}

    compare = functools.partial(set_entry, fd_dinov2=frechet_distance)
    return SetComparison(scene, files, compare, made, further=("fd_dinov2", further))


def clip_of(config: ScoreConfig, scene: Scene, out: Path) -> SetComparison:
    """What computes CMMD, CLIP-F and CLIP-V."""
    path, device = Path(config.clip_weights), choose_device(config.device, "networks of the scores")
    network = clip_image.ClipImageFeatures(read_checkpoint(path), str(path)).to(device)
    sha256 = store.sha256_file(path)
    prepare = functools.partial(clip_image.prepared, side=network.side)
    files = EmbeddingFiles(network, prepare, network.out, f"CLIP {sha256}", out / FEATURES_FOLDER, device)
    made = {
        "network": f"CLIP {network.name}, projected, {network.out} values",
        "weights_sha256": sha256,
        "resize": "bicubic without antialiasing, squashed",
        "kernel": "Gaussian, sigma 10, biased, times 1000",
        "reference": "recorded frames of the same camera",
    }
    compare = functools.partial(set_entry, cmmd=cmmd_distance)
    return SetComparison(scene, files, compare, made, further=("cmmd", _clip_values))


# -- all that is computed of whole sets ------------------------------------------------------------

BASELINE: Final = "nearest_fill"
Scored = Sequence[dict[str, Any]]
ENTRIES: Final = {"distributions": "distribution", "videos": "video"}
"""Entry of metrics.json that says how numbers were made -> that of a result with their sizes, where it differs."""


@dataclass(frozen=True)
class SetScores:
    """What is computed of whole sets, as far as its weights or files were given. ``comparisons``: entry of metrics.json
    -> what compares images or clips. ``detected``: metric -> entry of a result, and what holds detections against the
    truth."""

    comparisons: Mapping[str, SetComparison]
    detected: Mapping[str, tuple[str, BoxDetections | LaneDetections]]

    def add_to(
        self, results: Scored, trajectories: Sequence[ScoredTrajectory], reference: Reference, out: Path
    ) -> None:
        """Add to the results what compares whole sets of views."""
        if not self.records():
            return
        with log.task("features", len(results)) as bar:
            for trajectory in trajectories:
                rows = [row for row in results if row["trajectory"] == trajectory.name]
                bar.update(trajectory.name)
                self._add(trajectory, rows, reference, out)
                bar.advance(len(rows))

    def _add(self, trajectory: ScoredTrajectory, rows: Scored, reference: Reference, out: Path) -> None:
        counted, every = trajectory.counted(reference.held_out), range(len(trajectory.views))
        for name, comparison in self.comparisons.items():
            images = _sets_of(trajectory, reference, out, counted if name == "distributions" else every)
            of_video = () if name in ENTRIES else (counted, trajectory.views)
            _add_named(rows, ENTRIES.get(name, name), comparison.of(images, *of_video))
        for metric, (entry, source) in self.detected.items():
            _add_detected(rows, metric, entry, source, trajectory, counted, reference)

    def records(self) -> dict[str, Any]:
        """How the numbers were made, by entry of metrics.json."""
        found = {name: comparison.record() for name, comparison in self.comparisons.items()}
        if self.detected:
            found["detections"] = {metric: source.record() for metric, (_, source) in self.detected.items()}
        return found


def set_scores_of(config: ScoreConfig, scene: Scene, out: Path) -> SetScores:
    """What the given weights and files allow to compute. InputError: a file is missing, damaged, or holds another
    network, or the log has no lane lines."""
    makers = {
        "distributions": (config.fid_weights, distributions_of),
        "videos": (config.fvd_weights, videos_of),
        "dinov2": (config.dino_weights, dino_of),
        "clip": (config.clip_weights, clip_of),
    }
    comparisons = {name: make(config, scene, out) for name, (weights, make) in makers.items() if weights}
    detected: dict[str, tuple[str, BoxDetections | LaneDetections]] = {}
    if config.detections:
        detected["nta_iou"] = ("nta", BoxDetections(scene, Path(config.detections), config.as_published))
    if config.lanes:
        detected["ntl_iou"] = ("ntl", LaneDetections(scene, Path(config.lanes)))
    return SetScores(comparisons, detected)


def anchors_of(results: Scored, trajectories: Sequence[ScoredTrajectory]) -> list[dict[str, Any]]:
    """What stands beside a metric's values on a trajectory: the same of the true images (``truth``), of the recorded
    images at their own views (``recorded``), and of ``nearest_fill``. Taken out of the results."""
    found = []
    for trajectory in trajectories:
        rows = [row for row in results if row["trajectory"] == trajectory.name]
        anchors: dict[str, dict[str, float]] = {}
        for row in rows:
            for name, value in row.pop("truth", {}).items():
                anchors.setdefault(name, {})["truth"] = value
            for name, own in row.pop("anchors", {}).items():
                anchors.setdefault(name, {}).update(own)
        for row in rows:
            if row["method"] == BASELINE:
                for name, own in anchors.items():
                    if not isinstance(row["values"].get(name), str):
                        own[BASELINE] = row["values"][name]
        found += [{"trajectory": trajectory.name, "metric": name, **own} for name, own in sorted(anchors.items())]
    return found


def _sets_of(trajectory: ScoredTrajectory, reference: Reference, out: Path, counted: Sequence[int]) -> TrajectorySets:
    """The images at the counted views of a trajectory whose views have been scored and written."""

    def chosen(views: ObservationSet, indices: Sequence[int]) -> ImageSet:
        return ImageSet(len(counted), lambda number: views.rgb_u8(indices[counted[number]]))

    def true_image(number: int) -> NDArray[np.uint8]:
        place = counted[number]
        true = reference.truth.at_view(trajectory.views[place], trajectory.frames[place], trajectory.name)
        if true is None:
            raise InputError("a view has no ground truth", where=f"{trajectory.name}, view {place}")
        return to_bytes(true.seen.rgb)

    methods = {name: chosen(found, trajectory.indices[name]) for name, found in trajectory.sets.items()}
    every = range(len(trajectory.views))
    if reference.baseline is not None:
        methods = {BASELINE: chosen(read_observations(out / BASELINE / trajectory.name), every), **methods}
    truth = None
    if reference.truth.exact and trajectory.shift_m != 0.0:
        if reference.truth.stored:
            truth = ImageSet(len(counted), true_image)
        else:
            truth = chosen(read_observations(out / "truth" / trajectory.name), every)
    camera = trajectory.views[0].camera
    return TrajectorySets(trajectory.name, trajectory.camera, camera.width, camera.height, methods, truth)


def _add_named(rows: Scored, entry: str, found: Mapping[str, dict[str, Any] | str]) -> None:
    """Values of several metrics by method, and what stands beside them, into the results of one trajectory."""
    for row in rows:
        of = found[row["method"]]
        row["values"] |= dict(of["values"]) if not isinstance(of, str) else dict.fromkeys(SET_SIZES[entry], of)
        if not isinstance(of, str) and "n" in of:
            row[entry] = {name: value for name, value in of.items() if name != "values"}


def _add_detected(
    rows: Scored,
    metric: str,
    entry: str,
    source: BoxDetections | LaneDetections,
    trajectory: ScoredTrajectory,
    counted: Sequence[int],
    reference: Reference,
) -> None:
    """NTA-IoU or NTL-IoU into the results of one trajectory, with its anchors."""
    views = tuple(trajectory.views[n] for n in counted)
    frames = reference.facts.frames_of(trajectory.camera)
    recorded = f"{detections.RECORDED}/{trajectory.camera}"
    there = {
        "truth": ViewImages(f"{detections.TRUTH}/{trajectory.name}", tuple(counted), views),
        "recorded": ViewImages(recorded, tuple(range(len(frames))), tuple(frame.view for frame in frames)),
    }
    beside = {name: value["value"] for name, images in there.items() if not isinstance(value := source.of(images), str)}
    for row in rows:
        indices = trajectory.indices.get(row["method"], tuple(range(len(trajectory.views))))
        images = ViewImages(f"{row['method']}/{trajectory.name}", tuple(indices[n] for n in counted), views)
        value = source.of(images)
        row["values"][metric] = value if isinstance(value, str) else value["value"]
        row.setdefault("anchors", {})[metric] = beside
        if isinstance(value, str):
            continue
        row[entry] = {k: v for k, v in value.items() if k != "value"}
        if isinstance(source, LaneDetections):
            row[entry]["against_detector"] = source.against(images, there["truth"])
