"""Distances of whole sets of views from the recorded video of the same camera (FID, KID, FVD); and the detectors and
anchors that stand beside them. Sets are small, and FID of small sets is mostly bias: every trajectory also gets a
floor, what the truth itself would score."""

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
from torch import Tensor, nn

from mudg.base import log, seeds, store
from mudg.base.devices import choose_device
from mudg.base.errors import InputError
from mudg.base.types import Scene
from mudg.base.weights import read_checkpoint
from mudg.core import feature_distances
from mudg.core.feature_distances import frechet_distance
from mudg.core.pictures import resize_rgb, to_bytes
from mudg.editing.settings import ScoreConfig
from mudg.networks import folders, i3d, inception
from mudg.networks.featnets import LpipsFeatures, LpipsTrunk, lpips_shapes
from mudg.scene.observations import ObservationSet, read_observations
from mudg.scene.read import read_image
from mudg.scoring import detections
from mudg.scoring import tables as score_tables
from mudg.scoring.detections import BoxDetections, LaneDetections, ViewImages
from mudg.scoring.tables import SET_SIZES
from mudg.scoring.truth import Reference, ScoredTrajectory

# -- weights ---------------------------------------------------------------------------------------
#
# A published file -> a folder with ``weights.safetensors`` and its origin.

WEIGHTS_FILE: Final = "weights.safetensors"
DESCRIPTION_FILE: Final = "model.json"
KIND: Final = "score network"

Tensors = Mapping[str, Tensor]
Network = tuple[str, Callable[[Tensors, str], object], Callable[[Tensors], dict[str, Tensor]]]


def _lpips(trunk: LpipsTrunk, flag: str) -> Network:
    named = lambda found: {name: found[name] for name in lpips_shapes(trunk) if name in found}
    return flag, lambda state, where: LpipsFeatures(state, where, trunk), named


_without_counts = lambda state: {name: own for name, own in state.items() if not name.endswith("num_batches_tracked")}

NETWORKS: Final[Mapping[str, Network]] = {
    "inception": ("--fid-weights", inception.InceptionFeatures, _without_counts),
    "i3d": ("--fvd-weights", i3d.I3DFeatures, i3d.with_known_names),
    "lpips": _lpips("alex", "--lpips-weights"),
    "lpips-vgg": _lpips("vgg", "--lpips-vgg-weights"),
}
"""By the name that ``mudg convert --network`` takes: the flag of ``mudg score``; what checks tensors (InputError); and
what finds them in a published file, under the names that are written."""
PUBLISHED: Final[Mapping[str, str]] = {
    inception.KNOWN_SHA256: "pt_inception-2015-12-05-6726825d.pth",
    "bec6519f66ea534e953026b4ae2c65553c17bf105611c746d904657e5860a5e2": "i3d_torchscript.pt",
}
"""SHA-256 of published files -> their names."""


def convert_weights(network: str, checkpoint: Path, to: Path) -> None:
    """Write the folder ``to``: ``weights.safetensors`` in float32, and ``model.json`` with its origin. InputError: the
    file is missing, damaged, or holds another network; nothing is written."""
    flag, check, named = NETWORKS[network]
    tensors = named(read_checkpoint(checkpoint))
    check(tensors, str(checkpoint))
    sha256 = store.sha256_file(checkpoint)
    known = PUBLISHED.get(sha256)
    with store.atomic_directory(to) as partial:
        written = {name: value.detach().float() for name, value in tensors.items()}
        store.write_safetensors(partial / WEIGHTS_FILE, written)
        files = {WEIGHTS_FILE: store.sha256_file(partial / WEIGHTS_FILE)}
        source = {"file": checkpoint.name, "bytes": checkpoint.stat().st_size, "sha256": sha256, "published_as": known}
        description = {"schema": 1, "kind": KIND, "network": network, "files": files, "source": source}
        store.write_json(partial / DESCRIPTION_FILE, description)
        store.sync_tree(partial)
    origin = f"the published {known}" if known else "not a file whose hash is known"
    log.info(f"convert: {len(tensors)} tensors; SHA-256 of {checkpoint.name}: {sha256} ({origin})")
    log.info(f"convert: use it with mudg score {flag} {to / WEIGHTS_FILE}")


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

    @classmethod
    def of(
        cls, trajectory: ScoredTrajectory, reference: Reference, out: Path, counted: Sequence[int]
    ) -> TrajectorySets:
        """The images at the counted views of a trajectory whose views have been scored and written."""

        def chosen(views: ObservationSet, indices: Sequence[int]) -> ImageSet:
            return ImageSet(len(counted), lambda number: views.rgb_u8(indices[counted[number]]))

        def true_image(number: int) -> NDArray[np.uint8]:
            view, frame = trajectory.views[counted[number]], trajectory.frames[counted[number]]
            return to_bytes(reference.truth.at_view(view, frame, trajectory.name).seen.rgb)

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
        return cls(trajectory.name, trajectory.camera, camera.width, camera.height, methods, truth)


class EmbeddingFiles:
    """Features of sets of images by a network, kept in a folder: what went through the same network before is read, by
    the hash of weights, rule and pixels. ``network``: of tensors and the name of their file. ``weights``: that file.
    ``prepare``: an image u8[H, W, 3] as the network wants it, by a rule. InputError: the file is missing, damaged, or
    holds another network."""

    def __init__(
        self,
        network: Callable[[Tensors, str], nn.Module],
        weights: Path,
        prepare: Callable[..., Tensor],
        rule: str,
        width: int,
        name: str,
        folder: Path,
        device: torch.device,
    ) -> None:
        self.weights, self.rule, self.width, self.folder, self.device = weights, rule, width, folder, device
        self.network = network(read_checkpoint(weights), str(weights)).to(device)
        self.prepare, self.sha256 = functools.partial(prepare, rule=rule), store.sha256_file(weights)
        self.key = name.format(f"{self.sha256} {rule}")

    def of(self, images: ImageSet) -> tuple[str, NDArray[np.float32]]:
        """The name of the file that holds the features ("" where there are none), and the features f32[n, width]: read
        from the folder if these very pixels were seen before."""
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
    """Features f32[n, 2048] of sets of images by FID's network. ``rule``: how images get its size."""

    def __init__(self, weights: Path, rule: inception.ResizeRule, folder: Path, device: torch.device) -> None:
        how = inception.prepared, rule, inception.WIDTH, "Inception {}"
        super().__init__(inception.InceptionFeatures, weights, *how, folder, device)


EVERY_SECOND: Final = (lambda rows: (rows[::2], rows[1::2]), "every second recorded frame against the others")


class SetComparison:
    """A distance of sets of images for every trajectory of a scene, whose recorded frames are the reference. ``files``:
    how images become features. ``compare``: two sets of features to their numbers. ``facts``: how these are made.
    ``halves``: two parts of the reference, whose distance is the floor where no truth is known, and what they are."""

    def __init__(
        self,
        scene: Scene,
        files: EmbeddingFiles,
        compare: Callable[[Rows, Rows], Entry],
        facts: Mapping[str, Any],
        halves: tuple[Callable[[Rows], tuple[Rows, Rows]], str] = EVERY_SECOND,
    ) -> None:
        self._scene, self._files, self._compare, self._facts, self._halves = scene, files, compare, facts, halves
        self._recorded: dict[tuple[str, int, int], tuple[str, Rows]] = {}
        self._floors, self._sets = list[dict[str, Any]](), list[dict[str, str]]()

    def of(self, sets: TrajectorySets) -> dict[str, Entry | str]:
        """Numbers by method, or why there are none; the floor of the trajectory is noted for ``record``. InputError:
        methods have different numbers of images."""
        counts = {method: images.count for method, images in sets.methods.items()}
        if len(set(counts.values())) > 1:
            what, expected = "FID of sets of different size cannot be compared", "the same views for all methods"
            got = ", ".join(f"{method}: {count}" for method, count in counts.items())
            raise InputError(what, where=sets.name, expected=expected, got=got)
        frames = self._scene.frames_of(sets.camera) if sets.camera in self._scene.cameras else ()
        recorded = ImageSet(len(frames), lambda number: read_image(self._scene, frames[number]))
        recorded = recorded.resized(sets.width, sets.height)
        if not recorded.count:
            return dict.fromkeys(counts, score_tables.NO_TRUTH)
        if min(self._files.rows(count) for count in (*counts.values(), recorded.count)) < FEWEST:
            return dict.fromkeys(counts, score_tables.TOO_FEW)
        key = (sets.camera, sets.width, sets.height)
        if key not in self._recorded:
            self._recorded[key] = self._files.of(recorded)
        (name, reference), found = self._recorded[key], dict[str, Entry | str]()
        for method, images in sets.methods.items():
            own, rows = self._files.of(images.resized(sets.width, sets.height))
            # which files were compared, so that sets of several logs can be pooled
            self._sets.append({"trajectory": sets.name, "method": method, "made": own, "reference": name})
            found[method] = self._compare(rows, reference)
        split, how = self._halves
        pair = split(reference)
        if sets.truth is not None:
            how = "true images of the same views"
            pair = self._files.of(sets.truth.resized(sets.width, sets.height))[1], reference
        if min(map(len, pair)) >= FEWEST:
            entry = self._compare(*pair)
            self._floors.append({"trajectory": sets.name, "how": how, **entry.pop("values"), **entry})
        return found

    def record(self) -> dict[str, Any]:
        """How the numbers were made, and the floors, for metrics.json."""
        return {**self._facts, "floors": self._floors, "sets": self._sets}


def distributions(scene: Scene, files: FeatureFiles) -> SetComparison:
    """What computes FID and KID."""
    facts = {
        "network": "Inception-v3 of 2015, global average, 2048 values",
        "weights_sha256": files.sha256,
        "published_weights": source_sha256(files.weights) == inception.KNOWN_SHA256,
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
    """Features f32[clips, 400] of the clips of a video by FVD's network. ``rule``: how frames get its size."""

    def __init__(self, weights: Path, rule: i3d.VideoRule, folder: Path, device: torch.device) -> None:
        how = i3d.prepared_frame, rule, i3d.WIDTH, f"I3D {{}} {CLIP_FRAMES} {HOP_FRAMES}"
        super().__init__(i3d.I3DFeatures, weights, *how, folder, device)

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
    """FVD of two sets of features ``[n, d]``, and their sizes."""
    fvd = round(frechet_distance(generated, reference), 6)
    return {"values": {"fvd": fvd}, "n": len(generated), "n_reference": len(reference)}


def videos(scene: Scene, files: ClipFiles) -> SetComparison:
    """What computes FVD; a trajectory's sets hold all views of every method, in order of time."""
    made = {
        "network": "I3D, Kinetics-400, scores before the softmax, 400 values",
        "weights_sha256": files.sha256,
        "norm_epsilon": folders.NORM_EPSILON,
        "resize": files.rule,
        "clip_frames": CLIP_FRAMES,
        "hop_frames": HOP_FRAMES,
        "reference": "recorded video of the same camera",
        "covariance": "n - 1",
    }
    halves = lambda rows: (rows[: len(rows) // 2], rows[len(rows) // 2 :])
    how = "first half of the recorded video against the second"
    return SetComparison(scene, files, video_entry, made, (halves, how))


# -- all that is computed of whole sets ------------------------------------------------------------

BASELINE: Final = "nearest_fill"
Scored = Sequence[dict[str, Any]]


class SetScores:
    """What is computed of whole sets, as far as its weights or files were given. ``comparisons``: entry of metrics.json
    -> what compares images or clips. ``detected``: metric -> entry of a result, and what holds detections against the
    truth. InputError: a file is missing, damaged, or holds another network, or the log has no lane lines."""

    def __init__(self, config: ScoreConfig, scene: Scene, out: Path) -> None:
        self.comparisons, folder = dict[str, SetComparison](), out / FEATURES_FOLDER
        fid, fvd = config.fid_weights, config.fvd_weights
        device = choose_device(config.device, "networks of the scores") if fid or fvd else torch.device("cpu")
        if fid:
            files = FeatureFiles(Path(fid), config.fid_resize, folder, device)
            self.comparisons["distributions"] = distributions(scene, files)
        if fvd:
            self.comparisons["videos"] = videos(scene, ClipFiles(Path(fvd), config.fvd_resize, folder, device))
        self.detected: dict[str, tuple[str, BoxDetections | LaneDetections]] = {}
        if config.detections:
            self.detected["nta_iou"] = ("nta", BoxDetections(scene, Path(config.detections)))
        if config.lanes:
            self.detected["ntl_iou"] = ("ntl", LaneDetections(scene, Path(config.lanes)))

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
        counted, every = reference.counted(trajectory), range(len(trajectory.views))
        for name, comparison in self.comparisons.items():
            images = TrajectorySets.of(trajectory, reference, out, counted if name == "distributions" else every)
            entry, found = name.removesuffix("s"), comparison.of(images)
            for row in rows:
                of = found[row["method"]]
                if isinstance(of, str):
                    row["values"] |= dict.fromkeys(SET_SIZES[entry], of)
                else:
                    row["values"] |= of["values"]
                    row[entry] = {name: value for name, value in of.items() if name != "values"}
        if self.detected:
            self._add_detected(trajectory, rows, reference, counted)

    def _add_detected(
        self, trajectory: ScoredTrajectory, rows: Scored, reference: Reference, counted: Sequence[int]
    ) -> None:
        """NTA-IoU and NTL-IoU, with their anchors."""
        views, frames = tuple(trajectory.views[n] for n in counted), reference.facts.frames_of(trajectory.camera)
        recorded = f"{detections.RECORDED}/{trajectory.camera}"
        there = {
            "truth": ViewImages(f"{detections.TRUTH}/{trajectory.name}", tuple(counted), views),
            "recorded": ViewImages(recorded, tuple(range(len(frames))), tuple(frame.view for frame in frames)),
        }
        for metric, (entry, source) in self.detected.items():
            found = ((name, source.of(images)) for name, images in there.items())
            beside = {name: of["value"] for name, of in found if not isinstance(of, str)}
            for row in rows:
                indices = trajectory.indices.get(row["method"], tuple(range(len(trajectory.views))))
                images = ViewImages(f"{row['method']}/{trajectory.name}", tuple(indices[n] for n in counted), views)
                row.setdefault("anchors", {})[metric] = beside
                row["values"][metric] = value = source.of(images)
                if not isinstance(value, str):
                    row["values"][metric] = value.pop("value")
                    row[entry] = value

    def records(self) -> dict[str, Any]:
        """How the numbers were made, by entry of metrics.json."""
        found = {name: comparison.record() for name, comparison in self.comparisons.items()}
        if self.detected:
            found["detections"] = {metric: source.record() for metric, (_, source) in self.detected.items()}
        return found


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
