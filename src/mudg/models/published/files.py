"""Folders that hold a published-type diffusion model (see `models/mdm/files.py` for what is in such a folder)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mudg.base import records, shards, store
from mudg.base.errors import InputError
from mudg.models.mdm.files import MODEL_FILE, folder_of, read_description
from mudg.models.published.model import PublishedConfig, PublishedMDM

KIND = "published"


def is_published(path: Path | str) -> bool:
    """Whether a folder holds a published-type model (by its description; a missing one is no)."""
    where = folder_of(path) / MODEL_FILE
    content = store.read_json(where) if where.is_file() else None
    return isinstance(content, dict) and content.get("kind") == KIND


def window_of(path: Path | str) -> int:
    """Frames of a clip of the model in a folder, from its description alone.

    Raises:
        InputError: not such a folder.
    """
    content, where = read_description(Path(path)), str(Path(path) / MODEL_FILE)
    return records.parse_dataclass(PublishedConfig, content.get("config"), f"{where}: config").window


def save(
    folder: Path,
    config: PublishedConfig,
    tensors: Mapping[str, Tensor],
    facts: Mapping[str, Any],
    card: str,
    *,
    dtype: torch.dtype | None = None,
    shard_bytes: int = 1 << 30,
) -> None:
    """Write a model folder under a temporary name and rename it when it is complete.

    Args:
        tensors: everything `PublishedMDM(config).state_dict()` names.
        dtype: number format of the weights (None: as given); the table `scale` stays float32.
    """
    with store.atomic_directory(folder) as partial:
        small = {"scale": tensors["scale"].float()}
        files = shards.write_shards(partial, {n: t for n, t in tensors.items() if n != "scale"}, shard_bytes, dtype)
        store.write_safetensors(partial / "scale.safetensors", small)
        files["scale.safetensors"] = store.sha256_file(partial / "scale.safetensors")
        store.write_text(partial / "MODEL_CARD.md", card)
        description = {"schema": 1, "kind": KIND, "config": dataclasses.asdict(config), "files": files, "facts": dict(facts)}
        store.write_json(partial / MODEL_FILE, description)
        store.sync_tree(partial)


def load(folder: Path, device: torch.device | str = "cpu", dtype: torch.dtype | None = None) -> PublishedMDM:
    """Read a model folder; weights are mapped from the files and converted to `dtype` (None: as stored).

    Raises:
        InputError: not such a folder, or its weights do not fit its configuration. IntegrityError: a file was altered.
    """
    content, where = read_description(folder), str(Path(folder) / MODEL_FILE)
    if content.get("kind") != KIND:
        raise InputError("not a published-type model of this version", where=where, expected=f"schema 1, kind {KIND}")
    with torch.device("meta"), records.understood("a published-type model", where):
        model = PublishedMDM(records.parse_dataclass(PublishedConfig, content.get("config"), f"{where}: config"))
    state = shards.read_shards(Path(folder), content["files"], remedy="convert the checkpoint again")
    shards.check_fit(state, model.state_dict(), Path(folder))
    model.load_state_dict(state, assign=True)
    model.adopt_scale()
    table = model.scale
    model = model.to(device=device, dtype=dtype).eval()
    model.scale = table.to(device)  # exact in any number format: it is part of the schedule
    return model
