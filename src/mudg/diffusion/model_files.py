"""Folders that hold a diffusion model, of either kind.

model.json                kind (of published-type models), configuration, sha256 of the weight files, facts (recipe,
                          scores, licence)
weights_NN.safetensors    weights, fp16 of small models
MODEL_CARD.md             for people
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mudg.base import checkpoint, records, store, weights
from mudg.base.errors import InputError
from mudg.base.types import Condition
from mudg.diffusion.model import MDM
from mudg.diffusion.network import MDMConfig
from mudg.diffusion.published import PublishedConfig, PublishedMDM
from mudg.diffusion.requests import CPU, GeneratedClip, SampleRequest
from mudg.networks.codec import SHIPPED

Model = MDM | PublishedMDM
MODEL_FILE = "model.json"
EMBEDDED: dict[str, Path] = {"embedded": SHIPPED, "embedded-tiny": SHIPPED.with_name("mdm_tiny")}
"""Models that come with the package, by the names that stand for their folders."""
SMALL_SHARD_BYTES, SHARD_BYTES = 15 * 1024 * 1024, 2**30
"""Largest size of one weight file, of small and of published-type models."""
PUBLISHED = "published"
"""What published-type models call their kind."""


# descriptions -------------------------------------------------------------------------------------


def folder_of(path: Path | str) -> Path:
    """The folder that a name of `EMBEDDED` stands for; any other text is a folder itself."""
    return EMBEDDED.get(str(path), Path(path))


def read_description(path: Path | str) -> dict[str, Any]:
    """The content of a diffusion model's `model.json`, of whichever kind. InputError: no model there, or not a
    description of this version."""
    where = folder_of(path) / MODEL_FILE
    if not where.is_file():
        inside = (where.parent / "model" / MODEL_FILE).is_file()
        what, remedy = "no diffusion model here", f"give {where.parent / 'model'}" if inside else ""
        raise InputError(what, where=str(where.parent), expected=f"a file {MODEL_FILE}", remedy=remedy)
    content = store.read_json(where)
    known = isinstance(content, dict) and content.get("schema") == 1
    if not known or not isinstance(content.get("files"), dict) or not isinstance(content.get("facts", {}), dict):
        raise InputError("not a model description of this version", where=str(where))
    return content


def facts(path: Path | str) -> dict[str, Any]:
    """The facts (recipe, scores) that a model was saved with."""
    return dict(read_description(path).get("facts", {}))


def digest(path: Path | str) -> str:
    """Digest of a model's description, which holds the hashes of its weights."""
    return store.digest(folder_of(path) / MODEL_FILE)


def uses_renders(path: Path | str) -> bool:
    """Whether a model's condition may hold renders of a fitted scene; published-type models' cannot."""
    config = read_description(path).get("config")
    return isinstance(config, Mapping) and bool(config.get("renders"))


def is_published(path: Path | str) -> bool:
    """Whether a folder holds a published-type model (by its description; a missing one is no)."""
    where = folder_of(path) / MODEL_FILE
    content = store.read_json(where) if where.is_file() else None
    return isinstance(content, dict) and content.get("kind") == PUBLISHED


def generated(model: Model, condition: Condition, request: SampleRequest) -> GeneratedClip:
    """A clip generated on the model's device; condition and clip are on the CPU."""
    return model.sample(condition.to(model.device), request).to(CPU)


# models -------------------------------------------------------------------------------------------


def save(model: MDM, folder: Path, card: str, facts: Mapping[str, Any]) -> None:
    """Write a small model, its weights in half precision."""
    tensors = model.state_dict()
    _write(folder, {"config": asdict(model.config)}, tensors, facts, card, torch.float16, SMALL_SHARD_BYTES)


def save_published(
    folder: Path,
    config: PublishedConfig,
    tensors: Mapping[str, Tensor],
    facts: Mapping[str, Any],
    card: str,
    dtype: torch.dtype | None = None,
) -> None:
    """Write a published-type model. tensors: everything `PublishedMDM(config).state_dict()` names. dtype: number format
    of the weights (None: as given); the table `scale` stays float32."""
    _write(folder, {"kind": PUBLISHED, "config": asdict(config)}, tensors, facts, card, dtype, SHARD_BYTES)


def _write(
    folder: Path,
    described: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    facts: Mapping[str, Any],
    card: str,
    dtype: torch.dtype | None,
    shard_bytes: int,
) -> None:
    exact = {name: value.float() for name, value in tensors.items() if name == "scale"}
    with store.atomic_directory(folder) as partial:
        others = {name: value for name, value in tensors.items() if name not in exact}
        files = checkpoint.write_shards(partial, others, shard_bytes, dtype)
        if exact:
            store.write_safetensors(partial / "scale.safetensors", exact)
            files["scale.safetensors"] = store.sha256_file(partial / "scale.safetensors")
        store.write_text(partial / "MODEL_CARD.md", card)
        store.write_json(partial / MODEL_FILE, {"schema": 1, **described, "files": files, "facts": dict(facts)})
        store.sync_tree(partial)


def load(path: Path | str = "embedded") -> MDM:
    """Read a small model; the names of `EMBEDDED` stand for those shipped with the package. InputError: no model there,
    other fields or other weights than the configuration implies. IntegrityError: a weight file does not match its
    recorded hash."""
    folder, content = folder_of(path), read_description(path)
    where = str(folder / MODEL_FILE)
    config = records.parse_dataclass(MDMConfig, content.get("config"), f"{where}: ")
    state = checkpoint.read_shards(folder, content["files"])
    with records.understood("a diffusion model", where):
        with torch.device("meta"):  # takes no memory: its size may be anything
            weights.match_exactly(state, weights.shapes_of(MDM(config)), str(folder), "its configuration")
        model = MDM(config)
    model.load_state_dict(state)  # the numbers are converted as they are copied: no second set of them is in memory
    return model.eval()


def load_published(
    path: Path | str, device: torch.device | str = "cpu", dtype: torch.dtype | None = None
) -> PublishedMDM:
    """Read a published-type model; weights are mapped from the files and converted to `dtype` (None: as stored).
    InputError: not such a folder, or its weights do not fit its configuration. IntegrityError: a file was altered."""
    folder, content = Path(path), read_description(path)
    where = str(folder / MODEL_FILE)
    if content.get("kind") != PUBLISHED:
        raise InputError(
            "not a published-type model of this version", where=where, expected=f"schema 1, kind {PUBLISHED}"
        )
    with torch.device("meta"), records.understood("a published-type model", where):
        model = PublishedMDM(records.parse_dataclass(PublishedConfig, content.get("config"), f"{where}: config"))
    state = checkpoint.read_shards(folder, content["files"], remedy="convert the checkpoint again")
    weights.match_exactly(state, weights.shapes_of(model), str(folder), "its configuration")
    model.load_state_dict(state, assign=True)
    model.adopt_scale()
    table = model.scale
    model = model.to(device=device, dtype=dtype).eval()
    model.scale = table.to(device)  # exact in any number format: it is part of the schedule
    return model
