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
    from torch import Tensor

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
    """Write checkpoint ``step`` under ``folder`` and remove the oldest beyond ``keep`` (never fewer than two).

    Args:
        folder: holds one directory per step.
        step: number of finished steps.
        tensors: group name -> (tensor name -> tensor); one safetensors file per group.
        state: JSON-serialisable facts.
    """
    with writing(folder, step, state, keep) as partial:
        for name, group in tensors.items():
            store.write_safetensors(partial / f"{name}.safetensors", dict(group))
    return _path(folder, step)


class Pace:
    """Keeps large checkpoints to a small share of the time: one is due again when ``SHARE`` of the time since the last makes up for
    what that took. Those of under ``FREE_S`` seconds are always due."""

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


@contextlib.contextmanager
def writing(folder: Path, step: int, state: Mapping[str, Any], keep: int = 2) -> Iterator[Path]:
    """Yield the temporary folder of checkpoint ``step``; on success it gets state and manifest and its name, and the
    oldest ones go. Other processes may write into it too (``partial_path``)."""
    final = _path(folder, step)
    with store.atomic_directory(final) as partial:
        yield partial
        store.write_json(partial / "state.json", {"step": step, "state": dict(state)})
        store.write_manifest(partial)
    older = sorted(p for p in folder.glob(f"{_PREFIX}*") if p.is_dir() and p != final and not p.name.endswith(".part"))
    for stale in older[: max(0, len(older) + 1 - max(2, keep))]:
        shutil.rmtree(stale)


def partial_path(folder: Path, step: int) -> Path:
    """The temporary folder that ``writing`` yields."""
    final = _path(folder, step)
    return final.with_name(final.name + ".part")


def _path(folder: Path, step: int) -> Path:
    return folder / f"{_PREFIX}{step:08d}"


def latest(folder: Path) -> Checkpoint | None:
    """The newest checkpoint that verifies; None if there is none at all.

    Raises:
        IntegrityError: checkpoints exist but not one verifies (nothing is deleted).
    """
    candidates = sorted(
        (p for p in folder.glob(f"{_PREFIX}*") if p.is_dir() and p.name[len(_PREFIX) :].isdigit()), reverse=True
    )
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
        raise IntegrityError("no checkpoint verifies", where=str(folder), got=f"{len(problems)} damaged",
            remedy="restore the folder from a copy, or delete it to start again")  # fmt: skip
    return None
