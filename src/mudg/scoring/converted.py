"""Converting weights of the networks of the scores: a published file -> a folder with ``weights.safetensors`` and its
origin."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from torch import Tensor

from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.weights import read_checkpoint
from mudg.networks import clip_image, dinov2, i3d, inception
from mudg.networks.featnets import LpipsFeatures, LpipsTrunk, lpips_shapes

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
