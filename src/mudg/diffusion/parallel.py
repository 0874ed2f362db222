"""Training on several processes: who they are, what they agree on, how the network is spread, and its checkpoints.

Started by `torchrun`, every process runs the same program. They meet in a process group (gloo on CPUs, nccl on CUDA
devices) and differ only in their number, the rank. Rank 0 leads: it alone makes clips, writes logs and pictures, and
scores.

Three layouts give the same losses up to rounding: one process; `ddp`, a whole copy of the network per process; `fsdp`,
parameters, moments and average cut into pieces along their first axis (`torch.distributed.fsdp.fully_shard`).

What processes tell each other is numbers and JSON text. Nothing is pickled.
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
from typing import Any, Literal

import numpy as np
import torch
import torch.distributed as dist
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint as recomputed

from mudg.base import checkpoint, log, store
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import InputError, IntegrityError, MudgError, NumericsError, ResourceError, UsageError
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
Layout = Literal["ddp", "fsdp"]


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

    def wait(self) -> None:
        """Until all are here."""
        self.total([0.0])

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
        """Run `work` in the leader alone; all get its JSON result, or raise its error.

        An error that is not one of ours, or an interruption, ends the leader at once; the launcher then ends the
        others.
        """
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

    def all_do(self, work: Callable[[], None]) -> None:
        """Run `work` in every process; if one fails, all raise.

        Raises:
            ResourceError: another process failed (its own error is shown by that process).
        """
        failure: MudgError | None = None
        try:
            work()
        except MudgError as error:
            failure = error
        failed = self.total([float(failure is not None)])[0]
        if failure is not None:
            raise failure
        if failed:
            raise ResourceError(
                "another process of this training failed",
                got=f"{failed:.0f} of {self.size}",
                remedy="see its message above or in the launcher's logs",
            )

    def share(self, clips: int, parts: int) -> list[slice]:
        """Which clips of a batch of `clips` this process takes, in `parts` portions one after another.

        Raises:
            UsageError: the clips cannot be divided evenly. Portions of different sizes would change the mean.
        """
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
    """This process's place among those that `torchrun` started; alone if it was not started by it.

    A process group that exists already is used and left open. Only the leader's messages are shown.

    Args:
        wanted: a `DeviceName`. Several processes compute on the CPU, or on one CUDA device each.

    Raises:
        ResourceError: there is no such device. UsageError: it has no implementation, or is one for several processes;
            the launcher's variables are not numbers.
    """
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
    restarts = os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0") != "0"
    if place.leads and restarts and os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True":
        log.warn(
            "learn: restarted processes may find each other's old addresses in the launcher's store and fail; "
            "start torchrun with TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1"
        )
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
            raise UsageError(
                "several processes cannot share a device",
                where="--compute.device",
                expected="auto, cpu or cuda: one for each",
                got=wanted,
            )
        chosen = choose_device(wanted, purpose)
        if chosen.type != "cpu":
            chosen = choose_device(f"{chosen.type}:{os.environ.get('LOCAL_RANK', '0')}", purpose)
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    return Ranks(rank, size, chosen)


# the network over the processes -------------------------------------------------------------------


class Spread:
    """A model in one of the layouts: call `network` as the model itself, in `portion` for each portion of a step."""

    def __init__(self, model: nn.Module, trained: nn.ModuleDict, ranks: Ranks, layout: Layout) -> None:
        self.network = model
        self._sharded: list[nn.Module] = []
        if ranks.size == 1:
            return
        if layout == "ddp":
            known = inspect.signature(nn.parallel.DistributedDataParallel).parameters
            # since torch 2.13
            buffers = "forward_sync_buffers" if "forward_sync_buffers" in known else "broadcast_buffers"
            self.network = nn.parallel.DistributedDataParallel(model, **{buffers: False})
            return
        from torch.distributed.device_mesh import init_device_mesh
        from torch.distributed.fsdp import fully_shard

        mesh = init_device_mesh(ranks.device.type, (ranks.size,))
        for part in trained.values():
            with torch.no_grad():  # channels-last weights to row-major, which sharding asks for
                for value in part.parameters():
                    value.data = value.data.contiguous()
            for block in blocks(part):
                fully_shard(block, mesh=mesh)
            fully_shard(part, mesh=mesh)
            self._sharded.append(part)

    @contextlib.contextmanager
    def portion(self, last: bool) -> Iterator[None]:
        """Around loss and backward of one portion: gradients are exchanged after the last one only."""
        for part in self._sharded:
            part.set_requires_gradient_sync(last)
        holds = isinstance(self.network, nn.parallel.DistributedDataParallel) and not last
        with self.network.no_sync() if holds else contextlib.nullcontext():
            yield


def blocks(part: nn.Module) -> list[nn.Module]:
    """The repeated blocks of a network: the modules in its outermost lists, lists of lists taken apart, plain layers
    left out.

    These are what is sharded, and recomputed, as a unit.
    """

    def members(modules: nn.ModuleList) -> list[nn.Module]:
        return [inner for m in modules for inner in (members(m) if isinstance(m, nn.ModuleList) else [m])]

    units: list[nn.Module] = []
    for child in part.children():
        if isinstance(child, nn.ModuleList):
            units += [m for m in members(child) if any(True for _ in m.children())]
        else:
            units += blocks(child)
    return units


def recompute(part: nn.Module) -> int:
    """Keep no activations inside the blocks of `part`: the backward pass computes them again. Returns how many there
    are."""
    found = blocks(part)
    for block in found:
        block.forward = functools.partial(recomputed, block.forward, use_reentrant=False)
    return len(found)


def is_sharded(value: Tensor) -> bool:
    """Whether this process holds a piece of the tensor only."""
    if not dist.is_available() or not dist.is_initialized():
        return False
    from torch.distributed.tensor import DTensor

    return isinstance(value, DTensor)


def local(value: Tensor) -> Tensor:
    """This process's piece of a sharded tensor; any other tensor as it is. Shares memory."""
    return value.to_local() if is_sharded(value) else value


def gathered(value: Tensor) -> Tensor:
    """The whole of a tensor, sharded or not, on the CPU of every process. All processes must call this together."""
    return (value.full_tensor() if is_sharded(value) else value).detach().cpu()


def first_row(value: Tensor) -> int:
    """Which row of the whole tensor `local(value)` begins with."""
    if not is_sharded(value):
        return 0
    from torch.distributed.tensor.placement_types import Shard

    if tuple(value.placements) != (Shard(0),):
        raise ResourceError(
            "a tensor is sharded in a way that checkpoints do not support",
            expected="Shard(0)",
            got=str(value.placements),
        )
    per_rank = -(-value.shape[0] // value.device_mesh.size())
    return min(value.shape[0], per_rank * value.device_mesh.get_local_rank())


# a step's end -------------------------------------------------------------------------------------


def agreed_terms(
    ranks: Ranks, terms: Mapping[str, float], portions: int, step: int, what: str, *, stop: bool = False
) -> tuple[dict[str, float], bool]:
    """Mean of the loss terms over processes and portions, and whether any process is to stop.

    Raises:
        NumericsError: in every process, if a term is not finite in any; names the terms, the step and the processes.
    """
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
#
# Every process writes the rows of each tensor that it holds to a safetensors file of its own, with a JSON index beside
# it (name -> shape of the whole tensor, first row):
#
#     steps/step_00000100/
#         net.0000.safetensors  net.0000.json     weights: rank 0's rows
#         net.0001.safetensors  net.0001.json     rank 1's, if parameters were sharded
#         average.*  exp_avg.*  exp_avg_sq.*      moving average and AdamW's moments, in the same way
#         state.json  manifest.json               step, seed, layout; SHA-256 of every file
#
# A reader takes the rows it needs from whatever files hold them. `torch.distributed.checkpoint` does this too, but its
# index is a pickle, and nothing that is read back here may execute data.


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
        whole = {}
        for name, value in (self.average or self.trained.state_dict()).items():
            tensor = gathered(value)
            if ranks.leads:
                whole[name] = tensor
        return whole

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

        def write_own() -> None:
            if ranks.leads or sharded:
                for name, tensors in groups.items():
                    write_rows(partial, name, ranks.rank, tensors)

        record = {**facts, "processes": ranks.size, "sharded": sharded}
        with checkpoint.writing(folder, self.step, record, keep) if ranks.leads else contextlib.nullcontext():
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
    """Fill this process's rows of named tensors in place; the inverse of `write_rows` under any layout.

    Raises:
        IntegrityError: a file is damaged, there is no such tensor, it has another shape, or rows are missing.
    """
    where, index, shapes = f"{folder}: {group}", dict[str, list[tuple[int, Path]]](), dict[str, tuple[int, ...]]()
    try:
        for path in sorted(folder.glob(f"{group}.[0-9][0-9][0-9][0-9].json")):
            for name, entry in store.read_json(path).items():
                shapes[name] = tuple(int(n) for n in entry["shape"])
                index.setdefault(name, []).append((int(entry["start"]), path.with_suffix(".safetensors")))
    except (InputError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise IntegrityError("the index of a checkpoint is damaged", where=where, got=str(error)) from error

    @functools.cache
    def opened(path: Path) -> Any:
        try:
            return safe_open(str(store.regular(path)), "pt")
        except (SafetensorError, InputError, OSError) as error:
            raise IntegrityError("a file of a checkpoint is damaged", where=str(path), got=str(error)) from error

    def rows_of(name: str, value: Tensor) -> Tensor:
        """The rows of tensor `name` that this process holds of `value`."""
        piece, shape, start = local(value), tuple(value.shape), first_row(value)
        if shapes.get(name) != shape:
            raise IntegrityError(
                "a checkpoint does not fit the model",
                where=f"{where}.{name}",
                expected=str(shape),
                got=str(shapes.get(name, "no such tensor")),
            )
        if not shape:
            return opened(index[name][0][1]).get_tensor(name)
        stop, rows = start + len(piece), []
        for first, path in sorted(index[name]):
            part = opened(path).get_slice(name)
            a, b = max(start, first), min(stop, first + part.get_shape()[0])
            if a < b:
                rows.append((a, part[a - first : b - first]))
        if sum(len(r) for _, r in rows) != len(piece):
            raise IntegrityError(
                "rows of a tensor are missing from a checkpoint",
                where=f"{where}.{name}",
                expected=f"{start} to {stop}",
                got=str([(a, len(r)) for a, r in rows]),
            )
        return torch.cat([r for _, r in rows]) if rows else torch.empty_like(piece)

    with torch.no_grad():
        for name, value in tensors.items():
            local(value).copy_(rows_of(name, value))


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
