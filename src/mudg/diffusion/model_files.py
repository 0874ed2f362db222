"""Folders that hold a small diffusion model, and what every diffusion model's folder has in common.

model.json                configuration, sha256 of the weight files, facts (recipe, scores); of published-type models
                          also their kind
weights_NN.safetensors    weights in fp16
MODEL_CARD.md             for people
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from mudg.base import checkpoint, records, store, weights
from mudg.base.errors import InputError
from mudg.diffusion.model import MDM, MDMConfig
from mudg.networks.codec import SHIPPED

MODEL_FILE = "model.json"
EMBEDDED: dict[str, Path] = {"embedded": SHIPPED, "embedded-tiny": SHIPPED.with_name("mdm_tiny")}
"""Models that come with the package, by the names that stand for their folders."""
SHARD_BYTES = 15 * 1024 * 1024


def folder_of(path: Path | str) -> Path:
    """The folder that a name of `EMBEDDED` stands for; any other text is a folder itself."""
    return EMBEDDED.get(str(path), Path(path))


def read_description(path: Path | str) -> dict[str, Any]:
    """The content of a diffusion model's `model.json`, of whichever kind.

    Raises:
        InputError: no model there, or not a description of this version.
    """
    where = folder_of(path) / MODEL_FILE
    if not where.is_file():
        inside = (where.parent / "model" / MODEL_FILE).is_file()
        raise InputError(
            "no diffusion model here",
            where=str(where.parent),
            expected=f"a file {MODEL_FILE}",
            remedy=f"give {where.parent / 'model'}" if inside else "",
        )
    content = store.read_json(where)
    known = isinstance(content, dict) and content.get("schema") == 1
    if not known or not isinstance(content.get("files"), dict) or not isinstance(content.get("facts", {}), dict):
        raise InputError("not a model description of this version", where=str(where))
    return content


def facts(path: Path | str) -> dict[str, Any]:
    """The facts (recipe, scores) that `save` was given for a model folder or "embedded"."""
    return dict(read_description(path).get("facts", {}))


def digest(path: Path | str) -> str:
    """Digest of a model's description, which holds the hashes of its weights."""
    return store.digest(folder_of(path) / MODEL_FILE)


def uses_renders(path: Path | str) -> bool:
    """Whether a model's condition may hold renders of a fitted scene; published-type models' cannot."""
    config = read_description(path).get("config")
    return isinstance(config, Mapping) and bool(config.get("renders"))


def config_from_dict(values: Any, where: str = "model configuration") -> MDMConfig:
    """Inverse of `dataclasses.asdict`.

    Raises:
        InputError: names unknown or missing fields, and a value of a wrong type.
    """
    return records.parse_dataclass(MDMConfig, values, f"{where}: ")


def save(model: MDM, folder: Path, card: str, facts: Mapping[str, Any]) -> None:
    """Write a model as fp16 safetensors in parts, `model.json` (configuration, sha256 of the parts, facts) and
    MODEL_CARD.md."""
    with store.atomic_directory(folder) as partial:
        files = checkpoint.write_shards(partial, model.state_dict(), SHARD_BYTES, torch.float16)
        store.write_text(partial / "MODEL_CARD.md", card)
        description = {"schema": 1, "config": dataclasses.asdict(model.config), "files": files, "facts": dict(facts)}
        store.write_json(partial / MODEL_FILE, description)
        store.sync_tree(partial)


def load(path: Path | str = "embedded") -> MDM:
    """Read a model folder written by `save`; the names of `EMBEDDED` stand for those shipped with the package.

    Raises:
        InputError: no model there, other fields or other weights than the configuration implies.
        IntegrityError: a weight file does not match its recorded hash.
    """
    folder = folder_of(path)
    content = read_description(folder)
    config, state = (
        config_from_dict(content.get("config"), str(folder / MODEL_FILE)),
        checkpoint.read_shards(folder, content["files"]),
    )
    with records.understood("a diffusion model", str(folder / MODEL_FILE)):
        with torch.device("meta"):  # takes no memory: its size may be anything
            weights.match_exactly(state, weights.shapes_of(MDM(config)), str(folder), "its configuration")
        model = MDM(config)
    model.load_state_dict(state)  # the numbers are converted as they are copied: no second set of them is in memory
    return model.eval()
