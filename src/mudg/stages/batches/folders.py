"""Where everything of a batch lies, and what is on record there.

    OUT/<scene>/<step>/<key>/           results
    OUT/_batch/plan.json                steps, commands, settings, version
              list.<digest>.json        scenes
              claims/                   who works on what (claims.py)
              done/<key>.json           the commit record of a result, written last
              failed/<key>.json         why a step has no result
              events/<worker>*.jsonl    what happened, by worker
              logs/<key>.txt            the end of what a failed step said
              work/ partial/            unfinished results
    OUT/_review/                        results for people to look at (review.py)
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError

from mudg.base import store
from mudg.base.config import differences
from mudg.base.errors import InputError, UsageError
from mudg.base.location import Location
from mudg.base.records import first_problem
from mudg.stages.batches.lists import BOOKKEEPING, Entry
from mudg.stages.batches.plan import BatchPlan
from mudg.stages.batches.told import Ended, Name, PlanTold, StepTold, checked

_LISTED: Final = TypeAdapter(list[tuple[Name, str, dict[str, str]]])
_FLUSH_S: Final = 30.0
_BEGAN_FLUSH_S: Final = 5.0
"""What has begun is seen by others earlier than what has ended, which other records tell."""
_SEGMENT: Final = 500
"""Events per file where files cannot be appended to."""


@dataclass(frozen=True)
class BatchFolder:
    """The output of a batch."""

    out: Location

    @property
    def own(self) -> Location:
        """Folder of the batch's own records."""
        return self.out / BOOKKEEPING

    @property
    def claims(self) -> Location:
        """Folder of the claims."""
        return self.own / "claims"

    @property
    def work(self) -> Location:
        """Folder of what is being made."""
        return self.own / "work"

    def done(self, key: str) -> Location:
        """Commit record of a result."""
        return self.own / "done" / f"{key}.json"

    def failed(self, key: str) -> Location:
        """Record of a step that has failed."""
        return self.own / "failed" / f"{key}.json"

    def log(self, key: str) -> Location:
        """The end of what a failed step said."""
        return self.own / "logs" / f"{key}.txt"

    def partial(self, key: str) -> Location:
        """An unfinished result, put here by a worker that was asked to stop."""
        return self.own / "partial" / key

    def keys(self, kind: str) -> set[str]:
        """Keys in ``done`` or ``failed``, from one listing."""
        return {name.removesuffix(".json") for name in (self.own / kind).names()}

    # plan and list -----------------------------------------------------------------------------------------------------

    def begin(self, plan: BatchPlan, entries: Sequence[Entry]) -> None:
        """Put plan and list on record, or check that they are the same.

        Raises:
            UsageError: the folder holds a batch of other steps or settings, or something else.
        """
        file, record = self.own / "plan.json", plan.record()
        record = json.loads(store.json_text(record))
        names = [name for name in self.out.names() if not name.startswith(".")] if self.out.local is not None else []
        if names and BOOKKEEPING not in names:  # another worker may begin at the same moment
            raise UsageError("the output holds files of something else", where=str(self.out), remedy="choose an empty --out")
        if not file.save((store.json_text(record) + "\n").encode(), only_if_absent=True):
            before = store.parse_json(file.load(), str(file))
            if before != record:
                raise UsageError("the output holds a batch of other steps or settings", where=str(self.out),
                    got="; ".join(differences(before, record)[:8]), remedy="choose another --out")  # fmt: skip
        values = [[one.name, one.source, dict(one.settings)] for one in sorted(entries, key=lambda one: one.name)]
        content = json.dumps(values, ensure_ascii=False).encode()
        digest = hashlib.sha256(content).hexdigest()[:12]
        listed = self.own / f"list.{digest}.json"
        if not listed.exists():
            listed.save(content, only_if_absent=True)

    def plan(self) -> dict[str, Any]:
        """The plan's record. InputError: no batch is here, or the record is damaged."""
        file = self.own / "plan.json"
        if not file.exists():
            raise InputError("no batch is here", where=str(self.out), expected="the --out of a mudg batch run")
        return dict(checked(PlanTold, store.parse_json(file.load(), str(file)), str(file), "begin the batch again in another folder"))

    def ended(self, file: Location) -> Mapping[str, Any]:
        """The record of a step that is done or has failed. InputError: it is damaged."""
        return checked(Ended, store.parse_json(file.load(), str(file)), str(file), "remove it: the step is done again")

    def entries(self) -> list[Entry]:
        """The scenes of all lists that were ever given, by name."""
        found: dict[str, Entry] = {}
        for name in self.own.names():
            if name.startswith("list."):
                where = str(self.own / name)
                try:
                    listed = _LISTED.validate_python(store.parse_json((self.own / name).load(), where))
                except ValidationError as error:
                    raise first_problem(error, f"{where}: ") from error
                found |= {scene: Entry(scene, source, settings) for scene, source, settings in listed}
        return [found[name] for name in sorted(found)]

    # events ------------------------------------------------------------------------------------------------------------

    def events(self) -> Iterator[Mapping[str, Any]]:
        """All events of all workers; a line that a crash cut off, or that is no event, is left out."""
        folder = self.own / "events"
        for name in folder.names():
            for line in (folder / name).load().splitlines():
                with contextlib.suppress(InputError):
                    yield checked(StepTold, store.parse_json(line, name), name)


@dataclass
class EventLog:
    """What a worker writes down: lines of its own file; where files cannot be appended to, files of up to 500 lines.

    Events of the last half minute can be lost with a worker in such a store. What is done is told by other records.
    """

    folder: BatchFolder
    worker: str
    _lines: list[str] = field(default_factory=list)
    _number: int = 0
    _flushed_s: float = field(default_factory=time.monotonic)
    clock: Callable[[], float] = time.time

    def add(self, event: str, **values: Any) -> None:
        """Write down one event, with the time."""
        line = json.dumps({"at": round(self.clock(), 3), "event": event, "worker": self.worker, **values}, ensure_ascii=False)
        local = (self.folder.own / "events").local
        if local is not None:
            store.append_line(local / f"{self.worker}.jsonl", line)
            return
        self._lines.append(line)
        due_s = _BEGAN_FLUSH_S if event == "began" else _FLUSH_S
        if len(self._lines) >= _SEGMENT or time.monotonic() - self._flushed_s > due_s:
            self.flush()

    def flush(self) -> None:
        """Make sure that all events are in the store."""
        if self._lines:
            file = self.folder.own / "events" / f"{self.worker}.{self._number:06d}.jsonl"
            file.save(("\n".join(self._lines) + "\n").encode())
        if len(self._lines) >= _SEGMENT:
            self._lines, self._number = [], self._number + 1
        self._flushed_s = time.monotonic()
