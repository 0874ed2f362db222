"""What a training run must remember between steps, and its checkpoints: readable under another number of processes.

Every process writes the rows of each tensor that it holds to a safetensors file of its own, with a JSON index beside
it:

    steps/step_00000100/
        net.0000.safetensors  net.0000.json     weights: rank 0's rows; name -> shape of the whole tensor, first row
        net.0001.safetensors  net.0001.json     rank 1's, only if parameters were sharded; of several replicas the first
                              one's
        average.*  exp_avg.*  exp_avg_sq.*      moving average and AdamW's moments, in the same way
        state.json  manifest.json               step, seed, layout; SHA-256 of every file

A reader takes the rows it needs from whatever files hold them. `torch.distributed.checkpoint` does this too, but the
index it writes is a pickle, its files are `torch.save` archives with a pickle inside, and with its safetensors writer
the plans that processes exchange are pickled still. Nothing that is read back here may execute data.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from mudg.base import checkpoint, store
from mudg.base.errors import InputError, IntegrityError
from mudg.diffusion.training.parallel import Ranks, first_row, gathered, is_copy, is_sharded, local

MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass
class TrainingState:
    """The trained part of a model, its optimiser, and the moving average of its weights (None = off).

    `average` is by the names of the trained part's `state_dict`, and sharded as that is.
    """

    trained: nn.ModuleDict
    optimizer: torch.optim.AdamW
    average: dict[str, Tensor] | None
    step: int = 0

    def blend(self, decay: float) -> None:
        """Move the average towards the weights as they are after `self.step` steps; young averages move faster."""
        if self.average is None:
            return
        keep = min(decay, self.step / (self.step + 9))
        current = self.trained.state_dict()
        with torch.no_grad():
            torch._foreach_lerp_(
                [local(a) for a in self.average.values()], [local(current[k]) for k in self.average], 1.0 - keep
            )

    def export_weights(self, ranks: Ranks) -> dict[str, Tensor]:
        """The weights to use: the average, or the weights themselves; whole, on the CPU, in the leader (others get
        none).

        All processes must call this together.
        """
        found = {}
        for name, value in (self.average or self.trained.state_dict()).items():
            tensor = gathered(value)
            if ranks.leads:
                found[name] = tensor
        return found

    def _moments(self) -> dict[str, dict[str, Tensor]]:
        names = {id(p): name for name, p in self.trained.named_parameters()}
        state = {names[id(p)]: held for p, held in self.optimizer.state.items()}
        return {kind: {name: held[kind] for name, held in state.items()} for kind in MOMENTS}

    def save(self, folder: Path, ranks: Ranks, facts: Mapping[str, Any], keep: int = 2) -> float:
        """Write a checkpoint of the present step; all processes take part, on a file system that all see. Returns the
        seconds it took."""
        began = time.monotonic()
        weights = self.trained.state_dict()
        groups = {"net": weights, **self._moments()}
        if self.average is not None:
            groups["average"] = self.average
        partial = checkpoint.partial_path(folder, self.step)
        sharded = any(map(is_sharded, weights.values()))
        writes = ranks.leads or (sharded and not any(map(is_copy, weights.values())))

        def write_own() -> None:
            if writes:
                for name, tensors in groups.items():
                    write_rows(partial, name, ranks.rank, tensors)

        if not ranks.leads:
            ranks.wait()
            ranks.all_do(write_own)
            ranks.wait()
            return time.monotonic() - began
        with checkpoint.writing(folder, self.step, {**facts, "processes": ranks.size, "sharded": sharded}, keep):
            ranks.wait()
            ranks.all_do(write_own)
        ranks.wait()
        return time.monotonic() - began

    def resume(self, folder: Path, ranks: Ranks) -> bool:
        """Take up the newest checkpoint in `folder` that verifies; whether there is one. All processes must call this
        together."""
        saved = newest_checkpoint(folder, ranks)
        if saved is None:
            return False
        ranks.all_do(lambda: self.load(saved.path))
        self.step = saved.step
        return True

    def load(self, saved: Path) -> None:
        """Take weights, moments and average from a checkpoint written by `save` under any layout. Does not set `step`.

        Raises:
            IntegrityError: tensors or rows are missing, or of another shape.
        """
        read_rows(saved, "net", self.trained.state_dict())
        if self.average is not None:
            read_rows(saved, "average", self.average)
        taken = float(store.read_json(saved / "state.json")["step"])
        moving = {name: p for name, p in self.trained.named_parameters() if p.requires_grad}
        for kind in MOMENTS:
            for parameter in moving.values():
                held = self.optimizer.state[parameter]
                held[kind] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
                held["step"] = torch.tensor(taken, device=parameter.device)
            read_rows(saved, kind, {name: self.optimizer.state[p][kind] for name, p in moving.items()})


def write_rows(folder: Path, group: str, rank: int, tensors: Mapping[str, Tensor]) -> None:
    """Write this process's rows of named tensors as GROUP.RANK.safetensors with an index GROUP.RANK.json."""
    from safetensors.torch import save

    held = {name: local(value).detach().cpu().contiguous() for name, value in tensors.items()}
    index = {name: {"shape": list(value.shape), "start": first_row(value)} for name, value in tensors.items()}
    store.atomic_write(folder / f"{group}.{rank:04d}.safetensors", save(held))
    store.write_json(folder / f"{group}.{rank:04d}.json", index)


def read_rows(folder: Path, group: str, tensors: Mapping[str, Tensor]) -> None:
    """Fill this process's rows of named tensors in place; the inverse of `write_rows` under any layout."""
    files = RowFiles(folder, group)
    with torch.no_grad():
        for name, value in tensors.items():
            local(value).copy_(files.read(name, value))


class RowFiles:
    """The files of one group of tensors in a checkpoint, read row by row."""

    def __init__(self, folder: Path, group: str) -> None:
        self._where = f"{folder}: {group}"
        self._files: dict[Path, Any] = {}
        self._index: dict[str, list[tuple[int, Path]]] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        try:
            for path in sorted(folder.glob(f"{group}.[0-9][0-9][0-9][0-9].json")):
                for name, entry in store.read_json(path).items():
                    self._shapes[name] = tuple(int(n) for n in entry["shape"])
                    self._index.setdefault(name, []).append((int(entry["start"]), path.with_suffix(".safetensors")))
        except (InputError, KeyError, TypeError, AttributeError, ValueError) as error:
            raise IntegrityError("the index of a checkpoint is damaged", where=self._where, got=str(error)) from error

    def read(self, name: str, value: Tensor) -> Tensor:
        """The rows of tensor `name` that this process holds of `value`.

        Raises:
            IntegrityError: there is no such tensor, it has another shape, or rows are missing.
        """
        piece, shape, start = local(value), tuple(value.shape), first_row(value)
        if self._shapes.get(name) != shape:
            raise IntegrityError(
                "a checkpoint does not fit the model",
                where=f"{self._where}.{name}",
                expected=str(shape),
                got=str(self._shapes.get(name, "no such tensor")),
            )
        if not shape:
            return self._open(self._index[name][0][1]).get_tensor(name)
        stop = start + len(piece)
        rows = []
        for first, path in sorted(self._index[name]):
            part = self._open(path).get_slice(name)
            a, b = max(start, first), min(stop, first + part.get_shape()[0])
            if a < b:
                rows.append((a, part[a - first : b - first]))
        if sum(len(r) for _, r in rows) != len(piece):
            raise IntegrityError(
                "rows of a tensor are missing from a checkpoint",
                where=f"{self._where}.{name}",
                expected=f"{start} to {stop}",
                got=str([(a, len(r)) for a, r in rows]),
            )
        return torch.cat([r for _, r in rows]) if rows else torch.empty_like(piece)

    def _open(self, path: Path) -> Any:
        if path not in self._files:
            try:
                self._files[path] = safe_open(str(store.regular(path)), "pt")
            except (SafetensorError, InputError, OSError) as error:
                raise IntegrityError("a file of a checkpoint is damaged", where=str(path), got=str(error)) from error
        return self._files[path]


def newest_checkpoint(folder: Path, ranks: Ranks) -> checkpoint.Checkpoint | None:
    """The newest checkpoint that verifies, the same for all; only the leader hashes the files."""

    def find() -> dict[str, Any] | None:
        found = checkpoint.latest(folder)
        return None if found is None else {"step": found.step, "path": str(found.path), "state": dict(found.state)}

    found = ranks.leader_does(find)
    return None if found is None else checkpoint.Checkpoint(int(found["step"]), Path(found["path"]), found["state"])


def mean_of(rows: list[dict[str, float]]) -> dict[str, float]:
    """Mean of each value over those of several steps that have it, to nine digits."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: float(f"{np.mean([row[name] for row in rows if name in row]):.9g}") for name in names}
