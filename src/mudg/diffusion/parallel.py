"""Training on several processes: who they are, what they agree on, and the training's checkpoints.

Started by `torchrun`, every process runs the same program with a whole copy of the network; gradients are averaged.
Rank 0 leads: it alone makes clips, writes and scores. What processes tell each other is numbers and JSON text.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import inspect
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint as recomputed

from mudg.base import checkpoint, log
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import IntegrityError, MudgError, NumericsError, UsageError
from mudg.base.processes import error_from_record, error_record

PATIENCE = datetime.timedelta(hours=6)
"""How long processes wait for each other: as long as the leader may need to make clips or to score."""
SAME_SIGNAL_S = 2.0
"""The terminal sends Ctrl-C to all processes, and launchers pass it on: within this time a second one is the same
one."""
PARTING_S = 0.5
"""Rest after the last message. Threads of gloo let go of its tensors a moment later, and need the interpreter for that;
one that comes when the interpreter is already shutting down aborts the process, after all the work is done and
saved."""


@dataclass(frozen=True)
class Ranks:
    """This process among those of the run: number `rank` of `size`, computing on `device`."""

    rank: int
    size: int
    device: torch.device

    @property
    def leads(self) -> bool:
        """Whether this is the process that writes."""
        return self.rank == 0

    def total(self, values: Sequence[float]) -> list[float]:
        """Sums over all processes, in float64 and in the same order for all."""
        if self.size == 1:
            return list(values)
        kept = torch.tensor(values, dtype=torch.float64, device=self.device)
        dist.all_reduce(kept)
        return kept.tolist()

    def broadcast(self, value: Any) -> Any:
        """The leader's `value` (anything JSON can say), in every process."""
        if self.size == 1:
            return value
        text = json.dumps(value).encode() if self.leads else b""
        length = torch.tensor([len(text)], device=self.device)
        dist.broadcast(length, 0)
        letters = torch.zeros(int(length), dtype=torch.uint8, device=self.device)
        if self.leads:
            letters.copy_(torch.frombuffer(bytearray(text), dtype=torch.uint8))
        dist.broadcast(letters, 0)
        return json.loads(bytes(letters.cpu().tolist()))

    def leader_does(self, work: Callable[[], Any]) -> Any:
        """Run `work` in the leader alone; all get its JSON result, or raise its error. An error that is not one of
        ours, or an interruption, ends the leader at once; the launcher then ends the others."""
        if self.size == 1:
            return work()
        answer: dict[str, Any] = {}
        if self.leads:
            try:
                answer = {"value": work()}
            except MudgError as error:
                self.broadcast({"failed": error_record(error)})
                raise
        answer = self.broadcast(answer)
        if "failed" in answer:
            raise error_from_record(answer["failed"])
        return answer["value"]

    def share(self, clips: int, parts: int) -> list[slice]:
        """Which clips of a batch of `clips` this process takes, in `parts` portions one after another. UsageError: the
        clips cannot be divided evenly. Portions of different sizes would change the mean."""
        size, rest = divmod(clips, self.size * parts)
        if rest or not size:
            raise UsageError(
                "a step's clips cannot be divided evenly",
                where="--optimizer.batch-frames, --compute.accumulate",
                expected=f"a multiple of {self.size} processes x {parts} portions",
                got=f"{clips} clips",
                remedy="make --optimizer.batch-frames a multiple of window x processes x accumulate",
            )
        first = self.rank * parts * size
        return [slice(first + n * size, first + (n + 1) * size) for n in range(parts)]


@contextlib.contextmanager
def join_processes(wanted: str) -> Iterator[Ranks]:
    """This process's place among those that `torchrun` started; alone if it was not started by it. A process group that
    exists already is used and left open. Only the leader's messages are shown. wanted: a `DeviceName`. Several
    processes compute on the CPU, or on one CUDA device each. ResourceError: there is no such device. UsageError: it has
    no implementation, or is one for several processes; the launcher's variables are not numbers."""
    if dist.is_available() and dist.is_initialized():
        yield _ranks_on_device(dist.get_rank(), dist.get_world_size(), wanted)
        return
    try:
        size, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    except ValueError as error:
        raise UsageError(
            "the launcher's variables are not numbers", where="WORLD_SIZE, RANK", got=str(error)
        ) from error
    if size == 1:
        yield _ranks_on_device(0, 1, wanted)
        return
    place = _ranks_on_device(rank, size, wanted)
    dist.init_process_group("nccl" if place.device.type == "cuda" else "gloo", timeout=PATIENCE)
    was_quiet = log.is_quiet()
    log.set_quiet(was_quiet or rank > 0)
    try:
        yield place
    finally:
        log.set_quiet(was_quiet)
        dist.destroy_process_group()
        time.sleep(PARTING_S)


def _ranks_on_device(rank: int, size: int, wanted: str) -> Ranks:
    purpose = "training"
    if size == 1:
        chosen = choose_device(wanted, purpose, NETWORK_KINDS)
    else:
        if ":" in wanted:
            what = "several processes cannot share a device"
            raise UsageError(what, where="--compute.device", expected="auto, cpu or cuda: one for each", got=wanted)
        chosen = choose_device(wanted, purpose)
        if chosen.type != "cpu":
            chosen = choose_device(f"{chosen.type}:{os.environ.get('LOCAL_RANK', '0')}", purpose)
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    return Ranks(rank, size, chosen)


# the network over the processes -------------------------------------------------------------------


def spread(model: nn.Module, ranks: Ranks) -> nn.Module:
    """What to call in place of the model: gradients of several processes are averaged behind it."""
    if ranks.size == 1:
        return model
    known = inspect.signature(nn.parallel.DistributedDataParallel).parameters
    # since torch 2.13
    buffers = "forward_sync_buffers" if "forward_sync_buffers" in known else "broadcast_buffers"
    return nn.parallel.DistributedDataParallel(model, **{buffers: False})


def portion(network: nn.Module, *, last: bool) -> contextlib.AbstractContextManager[None]:
    """Around loss and backward of one portion of a step: gradients are exchanged after the last one only."""
    spread_out = isinstance(network, nn.parallel.DistributedDataParallel)
    return network.no_sync() if spread_out and not last else contextlib.nullcontext()


def recompute(part: nn.Module) -> int:
    """Keep no activations inside the repeated blocks of `part`, the modules in its outermost lists (plain layers left
    out): the backward pass computes them again. Returns how many there are."""

    def members(modules: nn.ModuleList) -> list[nn.Module]:
        return [inner for m in modules for inner in (members(m) if isinstance(m, nn.ModuleList) else [m])]

    count = 0
    for child in part.children():
        if not isinstance(child, nn.ModuleList):
            count += recompute(child)
            continue
        for block in members(child):
            if any(True for _ in block.children()):
                block.forward = functools.partial(recomputed, block.forward, use_reentrant=False)
                count += 1
    return count


# a step's end -------------------------------------------------------------------------------------


def agreed_terms(
    ranks: Ranks, terms: Mapping[str, float], portions: int, step: int, what: str, *, stop: bool = False
) -> tuple[dict[str, float], bool]:
    """Mean of the loss terms over processes and portions, and whether any process is to stop. NumericsError: in every
    process, if a term is not finite in any; names the terms, the step and the processes."""
    own = float(not all(map(math.isfinite, terms.values())))
    bad = [own if rank == ranks.rank else 0.0 for rank in range(ranks.size)]
    sums = ranks.total([*terms.values(), float(stop), *bad])
    mean = {name: value / (ranks.size * portions) for name, value in zip(terms, sums)}
    flags = sums[len(terms) + 1 :]
    if any(flags) or not all(map(math.isfinite, mean.values())):
        names = [name for name, value in mean.items() if not math.isfinite(value)] or list(terms)
        where = f"learn, step {step}"
        if ranks.size > 1:
            where += f", process {', '.join(str(n) for n, flag in enumerate(flags) if flag)} of {ranks.size}"
        raise NumericsError(
            f"the {', '.join(names)} term of the {what} is not finite",
            where=where,
            got=", ".join(str(mean[n]) for n in names),
            remedy="continue from the last checkpoint with a lower learning rate",
        )
    return mean, sums[len(terms)] > 0


# checkpoints --------------------------------------------------------------------------------------


MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass
class TrainingState:
    """The trained part of a model, its optimiser, and the moving average of its weights (None = off), by the names of
    the trained part's `state_dict`."""

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
            torch._foreach_lerp_(list(self.average.values()), [current[k] for k in self.average], 1.0 - keep)

    def weights(self) -> dict[str, Tensor]:
        """The weights to use, on the CPU: the average, or the weights themselves."""
        return {name: value.detach().cpu() for name, value in (self.average or self.trained.state_dict()).items()}

    def save(self, folder: Path, ranks: Ranks, facts: Mapping[str, Any]) -> float:
        """Write a checkpoint of the present step, in the leader; returns the seconds it took."""
        began = time.monotonic()
        names = {id(p): name for name, p in self.trained.named_parameters()}
        groups = {"net": self.trained.state_dict()}
        for kind in MOMENTS:
            groups[kind] = {names[id(p)]: held[kind] for p, held in self.optimizer.state.items()}
        if self.average is not None:
            groups["average"] = self.average
        state = {**facts, "processes": ranks.size}
        ranks.leader_does(lambda: str(checkpoint.save(folder, self.step, groups, state)))
        return time.monotonic() - began

    def resume(self, folder: Path, ranks: Ranks) -> bool:
        """Take up the newest checkpoint in `folder` that verifies; whether there is one. All processes must call this
        together."""
        saved = newest_checkpoint(folder, ranks)
        if saved is not None:
            self.load(saved)
        return saved is not None

    def load(self, saved: checkpoint.Checkpoint) -> None:
        """Take step, weights, moments and average from a checkpoint; IntegrityError where they are another model's."""
        moving = {name: p for name, p in self.trained.named_parameters() if p.requires_grad}
        read_group(saved, "net", self.trained.state_dict())
        if self.average is not None:
            read_group(saved, "average", self.average)
        for parameter in moving.values():
            held = self.optimizer.state[parameter]
            held["step"] = torch.tensor(float(saved.step), device=parameter.device)
            for kind in MOMENTS:
                held[kind] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        for kind in MOMENTS:
            read_group(saved, kind, {name: self.optimizer.state[p][kind] for name, p in moving.items()})
        self.step = saved.step


def read_group(saved: checkpoint.Checkpoint, group: str, tensors: Mapping[str, Tensor]) -> None:
    """Fill named tensors in place from a group of a checkpoint; IntegrityError: it lacks one, or one of that shape."""
    found = saved.tensors(group)
    with torch.no_grad():
        for name, value in tensors.items():
            if name not in found or found[name].shape != value.shape:
                what, expected = "a checkpoint does not fit the model", str(tuple(value.shape))
                got = str(tuple(found[name].shape)) if name in found else "no such tensor"
                raise IntegrityError(what, where=f"{saved.path}: {group}.{name}", expected=expected, got=got)
            value.copy_(found[name])


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
