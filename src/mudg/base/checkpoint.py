"""Checkpoints: a directory per step with safetensors, JSON and a sha256 manifest. Never pickle.

Written to a temporary name, fsynced, renamed; at least two verified ones are kept. A checkpoint that does not verify is
named and skipped in favour of an older one.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mudg.base import log, store
from mudg.base.errors import InputError, IntegrityError

if TYPE_CHECKING:
    import torch
    from torch import Tensor


# weights of a network as `weights_NN.safetensors` files beside a description that holds their sha256 ------------------


def write_shards(
    folder: Path, tensors: Mapping[str, Tensor], shard_bytes: int, dtype: torch.dtype | None = None
) -> dict[str, str]:
    """Write tensors as `weights_NN.safetensors` of about `shard_bytes` each to a tree under a temporary name; returns
    file name -> sha256. dtype: of floating-point tensors (None: as they are). Memory: one shard twice over."""
    from safetensors.torch import save as safetensors_bytes

    files: dict[str, str] = {}
    shard: dict[str, Tensor] = {}
    size = 0

    def flush() -> None:
        nonlocal shard, size
        if shard:
            name = f"weights_{len(files):02d}.safetensors"
            store.write_in_tree(folder / name, safetensors_bytes(shard))
            files[name] = store.sha256_file(folder / name)
        shard, size = {}, 0

    for name, value in tensors.items():
        wide = 0 if dtype is None or not value.is_floating_point() else dtype.itemsize
        nbytes = value.numel() * (wide or value.element_size())
        if size + nbytes > shard_bytes:
            flush()
        # a copy of its own: safetensors refuses tensors that share memory, and a mapped file must not be written
        # through
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
    """The tensors of files written by `write_shards`. files: what a description says: names -> sha256; if it does not,
    InputError. IntegrityError: a file is missing or altered; `remedy` says what to do."""
    tensors: dict[str, Tensor] = {}
    if not isinstance(files, Mapping) or not all(isinstance(digest, str) for digest in files.values()):
        what = "the description of a model does not name its weight files"
        raise InputError(what, where=str(folder), expected="files: {NAME: SHA256}", got=str(files), remedy=remedy)
    for name, digest in files.items():
        path = folder / Path(name).name
        if not path.is_file() or store.sha256_file(path) != digest:
            what = "a weight file is missing or altered"
            raise IntegrityError(what, where=str(path), expected=f"sha256 {digest[:16]}...", remedy=remedy)
        tensors |= read_tensors(path)
    return tensors


# checkpoint ---------------------------------------------------------------------------------------

_PREFIX = "step_"


@dataclass(frozen=True)
class Checkpoint:
    """A verified checkpoint on disk: the step it was taken after, its folder, and the JSON state."""

    step: int
    path: Path
    state: Mapping[str, Any]

    def tensors(self, name: str) -> dict[str, Tensor]:
        """Load one named group of tensors (writable copies)."""
        return store.read_tensors(self.path / f"{name}.safetensors")


def save(
    folder: Path, step: int, tensors: Mapping[str, Mapping[str, Tensor]], state: Mapping[str, Any], keep: int = 2
) -> Path:
    """Write checkpoint ``step`` (finished steps) under ``folder`` and remove the oldest beyond ``keep`` (never fewer
    than two). tensors: group -> name -> tensor, one file per group. state: JSON-serialisable facts."""
    final = _path(folder, step)
    with store.atomic_directory(final) as partial:
        for name, group in tensors.items():
            store.write_safetensors(partial / f"{name}.safetensors", dict(group))
        store.write_json(partial / "state.json", {"step": step, "state": dict(state)})
        store.write_manifest(partial)
    older = sorted(p for p in folder.glob(f"{_PREFIX}*") if p.is_dir() and p != final and not p.name.endswith(".part"))
    for stale in older[: max(0, len(older) + 1 - max(2, keep))]:
        shutil.rmtree(stale)
    return final


class Pace:
    """Keeps large checkpoints to a small share of the time: one is due again when ``SHARE`` of the time since the last
    makes up for what that took. Those of under ``FREE_S`` seconds are always due."""

    SHARE, FREE_S = 0.05, 1.0

    def __init__(self) -> None:
        self._took_s = 0.0
        self._ended_s = time.monotonic()

    def due(self) -> bool:
        """Whether enough time has passed since the last one."""
        return self._took_s <= self.FREE_S or self.SHARE * (time.monotonic() - self._ended_s) >= self._took_s

    @contextlib.contextmanager
    def saving(self) -> Iterator[None]:
        """The block that saves one."""
        began = time.monotonic()
        yield
        self._ended_s = time.monotonic()
        self._took_s = self._ended_s - began


def _path(folder: Path, step: int) -> Path:
    return folder / f"{_PREFIX}{step:08d}"


def latest(folder: Path) -> Checkpoint | None:
    """The newest checkpoint that verifies; None if there is none. IntegrityError: there are some but not one
    verifies."""
    steps = (path for path in folder.glob(f"{_PREFIX}*") if path.is_dir())
    candidates = sorted((path for path in steps if path.name[len(_PREFIX) :].isdigit()), reverse=True)
    problems = []
    for path in candidates:
        try:
            store.verify_manifest(path)
            content = store.read_json(path / "state.json")
            return Checkpoint(int(content["step"]), path, dict(content["state"]))
        except (IntegrityError, InputError, KeyError, TypeError, ValueError) as error:
            problems.append(str(error))
            log.warn(f"checkpoint {path} does not verify and is skipped:", *str(error).splitlines())
    if problems:
        remedy = "restore the folder from a copy, or delete it to start again"
        raise IntegrityError("no checkpoint verifies", where=str(folder), got=f"{len(problems)} damaged", remedy=remedy)
    return None
