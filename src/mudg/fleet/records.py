"""Where everything of a batch lies, what its records must be to be used, who drives it, and how far it is.

OUT/<scene>/<step>/<key>/           results
OUT/_batch/plan.json                steps, commands, settings, version
          list.<digest>.json        scenes of every list that was given
          owner*.json               the driver, or one of each shard
          done/<key>.json           a result is one from this record on; written last
          failed/<key>.json         why a step has no result
          logs/<key>.txt            the end of what a failed step said
          work/                     unfinished results
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import Field

from mudg.base import store
from mudg.base.config import differences
from mudg.base.errors import InputError, UsageError, plain
from mudg.base.memory import in_words
from mudg.base.processes import process_alive
from mudg.base.records import ForeignRecord, parse_record
from mudg.fleet.plan import BOOKKEEPING, BatchPlan, Entry
from mudg.scene.schema import NAME_PATTERN

Kind = TypeVar("Kind", bound=ForeignRecord)
Amount = Annotated[float, Field(ge=0, le=1e15, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=10**15)]
Name = Annotated[str, Field(pattern=f"^{NAME_PATTERN.pattern}$")]
"""Becomes a part of a path."""
KILLED: Final = 137
"""Code of a step that was killed, as the system does where memory runs out."""
ASKED_TO_STOP: Final = 143
REASONS: Final[Mapping[int, str]] = {
    **dict(enumerate("a mistake in the program,usage,bad input,damaged result,memory or disk,numbers".split(","), 1)),
    130: "interrupted",
    KILLED: "killed, most likely for want of memory",
    ASKED_TO_STOP: "asked to stop",
}
_OWNER: Final = re.compile(r"owner(-\d+-of-\d+)?\.json")


class Ended(ForeignRecord):
    """How a step of a scene ended: done or failed, which is put on record; or stopped, or lost by its engine. lost_s:
    processor seconds of attempts without a result."""

    scene: Name
    stage: Name
    key: Annotated[str, Field(pattern=r"^[A-Za-z0-9]+$")]
    source: str = ""
    place: str = ""
    digest: str = ""
    state: str = ""
    host: str = ""
    code: Annotated[int, Field(ge=-1000, le=1000)] = 0
    words: str = ""
    ended: Amount = 0.0
    seconds: Amount = 0.0
    processor_s: Amount = 0.0
    lost_s: Amount = 0.0
    written_bytes: Count = 0
    peak_bytes: Count | None = None


class Owner(ForeignRecord):
    """Who drives a batch, or one shard of it. job: number of the Slurm job that does."""

    host: str
    process: Annotated[int, Field(ge=0, lt=2**31)]
    since: Amount
    shard: Annotated[tuple[Count, Count], Field(strict=False)] = (0, 1)
    job: Annotated[str, Field(pattern=r"^\d*$")] = ""

    def is_alive(self) -> bool | None:
        """Whether it still works; None where that cannot be known from here."""
        if self.job:
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                return slurm_tasks_left(self.job) > 0
            return None
        if self.host != this_host():
            return None
        return self.process != os.getpid() and process_alive(self.process)

    def __str__(self) -> str:
        what = f"job {self.job}" if self.job else f"process {self.process}"
        since = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(self.since))
        return f"{what} on {self.host.split(' ')[0]} since {since}"


class _Named(ForeignRecord):
    name: Name


class _SceneRows(ForeignRecord):
    scenes: list[Annotated[tuple[Name, str, dict[str, str]], Field(strict=False)]]


class _PlanRecord(ForeignRecord):
    stages: Annotated[list[_Named], Field(min_length=1)]


def _checked(kind: type[Kind], value: object, where: str, remedy: str) -> Kind:
    """A record, if it is one of this kind; InputError names file and field."""
    try:
        return parse_record(kind, value, f"{where}: ")
    except InputError as error:
        fields = {**error.fields, "remedy": remedy}
        raise InputError(f"a record of the batch is damaged: {error.what}", **fields) from error


def this_host() -> str:
    """This machine, or this container of it: where process numbers mean the same."""
    space = ""
    with contextlib.suppress(OSError):
        space = os.readlink("/proc/self/ns/pid")
    return f"{socket.gethostname()} {space}".strip()


def slurm_tasks_left(job: str) -> int:
    """Tasks of a Slurm job that wait or run. OSError: there is no Slurm here, or it does not answer."""
    words = ["squeue", "--noheader", "--array", "--jobs", job, "--format", "%i"]
    answer = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    if answer.returncode and "Invalid job id" not in answer.stderr:
        raise OSError(answer.stderr.strip()[:300])
    return len(answer.stdout.split()) if not answer.returncode else 0


@dataclass(frozen=True)
class BatchFolder:
    """The output of a batch."""

    out: Path

    @property
    def own(self) -> Path:
        """Folder of the batch's own records."""
        return self.out / BOOKKEEPING

    def record(self, kind: Literal["done", "failed"], key: str) -> Path:
        """Record of a step that is done or has failed."""
        return self.own / kind / f"{key}.json"

    def log(self, key: str) -> Path:
        """The end of what a failed step said."""
        return self.own / "logs" / f"{key}.txt"

    def keys(self, kind: Literal["done", "failed"]) -> set[str]:
        """Keys on record, from one listing."""
        return {name.removesuffix(".json") for name in _names(self.own / kind)}

    def records(self, kind: Literal["done", "failed"]) -> Iterator[Ended]:
        """All records of a kind. InputError: one is damaged."""
        for path, content in _contents(self.own / kind, _names(self.own / kind)):
            yield _checked(Ended, store.parse_json(content, str(path)), str(path), "remove it: the step is done again")

    def end(self, kind: Literal["done", "failed"], ended: Ended) -> None:
        """Put the end of a step on record."""
        store.write_json(self.record(kind, ended.key), {"schema": 1, **ended.model_dump()})

    # plan and list --------------------------------------------------------------------------------

    def begin(self, plan: BatchPlan, entries: Sequence[Entry]) -> None:
        """Put plan and list on record, or check that they are the same. UsageError: the folder holds a batch of other
        steps or settings, or something else."""
        file, record = self.own / "plan.json", json.loads(store.json_text(plan.record()))
        names = _names(self.out)
        if names and BOOKKEEPING not in names:  # another shard may begin at the same moment
            what, remedy = "the output holds files of something else", "choose an empty --out"
            raise UsageError(what, where=str(self.out), remedy=remedy)
        if not store.create_once(file, (store.json_text(record) + "\n").encode()):
            before = store.read_json(file)
            if before != record:
                what = "the output holds a batch of other steps or settings"
                got = "; ".join(differences(before, record)[:8])
                raise UsageError(what, where=str(self.out), got=got, remedy="choose another --out")
        values = [[one.name, one.source, dict(one.settings)] for one in sorted(entries, key=lambda one: one.name)]
        content = json.dumps(values, ensure_ascii=False).encode()
        store.create_once(self.own / f"list.{hashlib.sha256(content).hexdigest()[:12]}.json", content)

    def stages(self) -> list[str]:
        """Names of the steps. InputError: no batch is here, or its record is damaged."""
        file = self.own / "plan.json"
        if not file.exists():
            raise InputError("no batch is here", where=str(self.out), expected="the --out of a mudg batch run")
        plan = _checked(_PlanRecord, store.read_json(file), str(file), "begin the batch again in another folder")
        return [stage.name for stage in plan.stages]

    def scenes(self) -> list[str]:
        """Names of the scenes of all lists that were ever given. InputError: a list is damaged."""
        scenes: set[str] = set()
        for file in (self.own / name for name in _names(self.own) if name.startswith("list.")):
            remedy = "remove it, and give the list again"
            listed = _checked(_SceneRows, {"scenes": store.read_json(file)}, str(file), remedy)
            scenes.update(row[0] for row in listed.scenes)
        return sorted(scenes)

    # drivers --------------------------------------------------------------------------------------

    def owners(self) -> dict[str, Owner]:
        """Drivers on record, by the names of their files. InputError: a record is damaged."""
        names, remedy = list(filter(_OWNER.fullmatch, _names(self.own))), "remove it, if no driver of this batch runs"
        contents = _contents(self.own, names)
        parsed = ((path, store.parse_json(content, str(path))) for path, content in contents)
        return {path.name: _checked(Owner, value, str(path), remedy) for path, value in parsed}

    @contextlib.contextmanager
    def owned(
        self, shard: tuple[int, int] = (0, 1), *, numbered: bool = False, take_over: bool = False
    ) -> Iterator[Path]:
        """Drive the batch, or one shard of it, alone. Yields the owner's record, which is removed at the end unless
        somebody changed it. numbered: a scheduler numbered this task, and runs every number once: what an earlier one
        left is taken over. take_over: from any other driver. UsageError: another driver works on it, or may do so on
        another machine."""
        index, count = shard
        name = "owner.json" if count == 1 else f"owner-{index}-of-{count}.json"
        mine, me = self.own / name, Owner(host=this_host(), process=os.getpid(), since=time.time(), shard=shard)
        content = me.model_dump_json().encode()
        for _ in range(2):  # once more: two may have begun at the same moment
            for other_name, other in self.owners().items():
                beside = other_name != name and count > 1 and other.shard[1] == count
                if beside or other == me:
                    continue
                alive = other.is_alive()
                if alive is False or take_over or (numbered and other_name == name):
                    store.remove(self.own / other_name)
                    continue
                if mine.exists() and store.read_bytes(mine) == content:
                    store.remove(mine)
                what = "another driver works on this batch" if alive else "another machine may still drive this batch"
                remedy = "wait for it, or stop it" if alive else "if it is gone, add --take-over"
                raise UsageError(what, where=str(self.own / other_name), got=str(other), remedy=remedy)
            if not store.create_once(mine, content) and store.read_bytes(mine) != content:
                what, remedy = "another driver works on this batch", "wait for it, or stop it"
                raise UsageError(what, where=str(mine), remedy=remedy)
        try:
            yield mine
        finally:
            with contextlib.suppress(InputError):
                if store.read_bytes(mine) == content:
                    store.remove(mine)


def _names(folder: Path) -> list[str]:
    """Names in a folder, sorted, without those that are being written; none where it is not there."""
    return sorted(name for name in os.listdir(folder) if not name.startswith(".")) if folder.is_dir() else []


def _contents(folder: Path, names: Sequence[str]) -> Iterator[tuple[Path, bytes]]:
    for name in names:
        with contextlib.suppress(InputError):  # removed meanwhile
            yield folder / name, store.read_bytes(folder / name)


# how far a batch is --------------------------------------------------------------------------------

_SHOWN: Final = 12
_NOTHING: Final[Mapping[str, Any]] = dict.fromkeys("done failed left seconds written_bytes peak_bytes".split(), 0) | {
    "seconds": 0.0,
    "core_hours": 0.0,
    "core_hours_left": 0.0,
}
"""Figures of a step over all scenes."""
_HEADS: Final = "step,done,failed,left,seconds each,most memory,written,core-hours,still needed".split(",")


def read_status(folder: BatchFolder) -> dict[str, Any]:
    """The state of a batch as JSON values. Of each step: left: scenes that can still come to it: all but those that
    failed before. core_hours: those of attempts that failed as well; core_hours_left: if the rest takes as much as what
    is done. reasons: of failures, with their number and an example, the most frequent first. InputError: no batch is
    there, or a record of it is damaged."""
    stages: dict[str, dict[str, Any]] = {name: dict(_NOTHING) for name in folder.stages()}
    drivers, scenes = [str(owner) for owner in folder.owners().values()], len(folder.scenes())
    for done in folder.records("done"):
        if (one := stages.get(done.stage)) is not None:
            one["done"] += 1
            one["seconds"] += done.seconds
            one["written_bytes"] += done.written_bytes
            one["peak_bytes"] = max(one["peak_bytes"], done.peak_bytes or 0)
            one["core_hours"] += (done.processor_s + done.lost_s) / 3600
    reasons: dict[str, list[str]] = {}
    for failed in sorted(folder.records("failed"), key=lambda one: one.scene):
        if (one := stages.get(failed.stage)) is not None:
            one["failed"] += 1
            one["core_hours"] += failed.lost_s / 3600
            ended = f"ended by signal {failed.code - 128}" if failed.code > 128 else f"exit code {failed.code}"
            reason = f"{failed.code} {REASONS.get(failed.code, ended)}: {failed.words.split(';')[0][:80]}"
            reasons.setdefault(reason, []).append(f"{failed.scene} {failed.stage}")
    all_failed = 0
    for one in stages.values():
        all_failed += one["failed"]
        one["left"] = max(0, scenes - all_failed - one["done"])
        one["core_hours_left"] = one["core_hours"] / one["done"] * one["left"] if one["done"] else 0.0
        one |= {name: round(value, 4) for name, value in one.items()}
    left, finished = sum(one["left"] for one in stages.values()), next(reversed(stages.values()))["done"]
    state = {"out": str(folder.out), "scenes": scenes, "finished": finished, "left": left, "stages": stages}
    listed = [{"reason": reason, "steps": len(of), "example": of[0]} for reason, of in reasons.items()]
    return {**state, "reasons": sorted(listed, key=lambda one: -one["steps"]), "drivers": drivers}


def text_of(state: dict[str, Any]) -> str:
    """What ``read_status`` found as a table for a terminal."""
    from rich.console import Console
    from rich.table import Table

    grid = Table(title=f"{state['out']}: {state['scenes']} scenes", title_justify="left")
    for column in _HEADS:
        grid.add_column(column, justify="left" if column == "step" else "right")
    for name, one in state["stages"].items():
        counts = (str(one[key]) for key in ("done", "failed", "left"))
        each = f"{one['seconds'] / one['done']:.1f}" if one["done"] else ""
        sizes = (in_words(one[key]) if one[key] else "" for key in ("peak_bytes", "written_bytes"))
        hours = (f"{one[key]:.3f}" for key in ("core_hours", "core_hours_left"))
        grid.add_row(name, *counts, each, *sizes, *hours)
    out = io.StringIO()
    Console(file=out, width=120, markup=False, highlight=False).print(grid)
    for one in state["reasons"][:_SHOWN]:
        out.write(f"{one['steps']:7d} x {plain(one['reason'])}  (e.g. {plain(one['example'])})\n")
    out.writelines(f"driven by {driver}\n" for driver in map(plain, state["drivers"]))
    out.write(f"{state['finished']} of {state['scenes']} scenes are finished, {state['left']} steps are left")
    return out.getvalue()
