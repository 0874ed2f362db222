"""Weights of a network as `weights_NN.safetensors` files beside a description that holds their sha256."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from mudg.base import store
from mudg.base.errors import InputError, IntegrityError

if TYPE_CHECKING:
    import torch
    from torch import Tensor


def write_shards(
    folder: Path, tensors: Mapping[str, Tensor], shard_bytes: int, dtype: torch.dtype | None = None, stem: str = "weights"
) -> dict[str, str]:
    """Write tensors, on any device, as `<stem>_NN.safetensors` of at most about `shard_bytes` each; returns file name -> sha256.

    Args:
        folder: a tree under a temporary name (`store.atomic_directory`).
        dtype: number format of floating-point tensors (None: as they are).

    Memory: one shard twice over.
    """
    from safetensors.torch import save as safetensors_bytes

    files: dict[str, str] = {}
    shard: dict[str, Tensor] = {}
    size = 0

    def flush() -> None:
        nonlocal shard, size
        if shard:
            name = f"{stem}_{len(files):02d}.safetensors"
            store.write_in_tree(folder / name, safetensors_bytes(shard))
            files[name] = store.sha256_file(folder / name)
        shard, size = {}, 0

    for name, value in tensors.items():
        wide = 0 if dtype is None or not value.is_floating_point() else dtype.itemsize
        nbytes = value.numel() * (wide or value.element_size())
        if size + nbytes > shard_bytes:
            flush()
        # a copy of its own: safetensors refuses tensors that share memory, and a mapped file must not be written through
        shard[name] = value.detach().to("cpu", dtype if wide else value.dtype, copy=True).contiguous()
        size += nbytes
    flush()
    return files


def read_tensors(path: Path) -> dict[str, Tensor]:
    """All tensors of a safetensors file, mapped from it; InputError where it is not one."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(store.regular(path), framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError) as error:
        raise InputError("not a valid safetensors file", where=str(path), got=str(error)) from error


def read_shards(folder: Path, files: object, *, remedy: str = "make the model again") -> dict[str, Tensor]:
    """The tensors of files written by `write_shards`, checked against their sha256.

    Args:
        files: what a description says: names of files -> sha256.

    Raises:
        InputError: `files` are no such names. IntegrityError: a file is missing or altered; `remedy` says what to do then.
    """
    tensors: dict[str, Tensor] = {}
    if not isinstance(files, Mapping) or not all(isinstance(digest, str) for digest in files.values()):
        raise InputError("the description of a model does not name its weight files", where=str(folder), expected="files: {NAME: SHA256}",
            got=str(files), remedy=remedy)  # fmt: skip
    for name, digest in files.items():
        path = folder / Path(name).name
        if not path.is_file() or store.sha256_file(path) != digest:
            raise IntegrityError("a weight file is missing or altered", where=str(path), expected=f"sha256 {digest[:16]}...",
                                 remedy=remedy)  # fmt: skip
        tensors |= read_tensors(path)
    return tensors


def check_fit(tensors: Mapping[str, Tensor], wanted: Mapping[str, Tensor], where: Path) -> None:
    """InputError unless the tensors have the names and shapes of `wanted`, the state of the network they are for."""
    wrong = sorted(set(wanted) ^ set(tensors)) or [n for n in wanted if wanted[n].shape != tensors[n].shape]
    if wrong:
        raise InputError("weights do not fit the configuration", where=str(where), got=", ".join(wrong[:6]))
