"""A worker: claims steps of scenes, runs them, publishes the results and records them, until nothing is left that it can do.

    claim -> (is it on record already?) -> stage in -> run -> bounds -> second run, if sampled -> publish -> commit record -> release

A result counts from its commit record on. Everything before may happen twice, or be cut off at any point.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from mudg.base import failures, log, store
from mudg.base.errors import InputError, IntegrityError, MudgError, ResourceError, UsageError
from mudg.base.location import Location
from mudg.base.usage import folder_bytes
from mudg.stages.batches import claims, quality, retries, review, turns
from mudg.stages.batches.children import ChildProcess, Ending
from mudg.stages.batches.folders import BatchFolder, EventLog
from mudg.stages.batches.inputs import GB, InputStore
from mudg.stages.batches.lists import Entry, shard_of
from mudg.stages.batches.plan import REVISION, BatchPlan, Unit
from mudg.stages.batches.scratch import WorkFolder, default_scratch, work_folder

DONE, FAILED, REJECTED, BUSY, AGAIN, STOPPED, LOST = "done", "failed", "rejected", "busy", "again", "stopped", "lost"
ASKED_TO_STOP: Final = 143
_REFRESH_S: Final = 30.0
_PUBLISH_WAITS_S: Final = (1.0, 4.0, 16.0)
_POLL_S: Final = 1.0
_LONGEST_POLL_S: Final = 16.0
_LOOKED_AHEAD: Final = 100
"""Scenes among which the next one is looked for that is not done yet."""


@dataclass(frozen=True)
class WorkRules:
    """How a worker works.

    Args:
        lease_s: seconds after which a worker that gives no sign of life loses its claim. grace_s: seconds that a step has to stop.
        patience_s: how long a worker with nothing to do waits for steps that others hold. steal: whether it takes on scenes of other
            shards. bounds: on results. second_share: share of results that are made twice and compared. most_failures: share (with %)
            or number of failed steps at which all workers stop; empty: never. scratch: folder for what is being made, if not in the
            output, and for inputs from a store. scratch_gb: gigabytes of such inputs that stay there, beside those in use. threads: of each
            step. most_tries: no failure is tried more often than this.
    """

    lease_s: float = 600.0
    grace_s: float = 100.0
    patience_s: float = 600.0
    steal: bool = True
    bounds: tuple[quality.Bound, ...] = ()
    second_share: float = 0.0
    most_failures: str = ""
    scratch: Path | None = None
    scratch_gb: float = 20.0
    threads: int = 1
    most_tries: int = 1000


@dataclass(frozen=True)
class WorkRequest:
    """What a worker is to do. shard: (i, n) of the list; lane: (w, W) of the workers of that shard, which begin apart."""

    folder: BatchFolder
    plan: BatchPlan
    entries: Sequence[Entry]
    rules: WorkRules = field(default_factory=WorkRules)
    shard: tuple[int, int] = (0, 1)
    lane: tuple[int, int] = (0, 1)


Perform = Callable[[Unit, WorkFolder], Ending]
"""Makes a result in the work folder; the default starts the step's command."""


class Worker:
    """One worker. It runs one step at a time."""

    def __init__(
        self, request: WorkRequest, report: Callable[[Mapping[str, Any]], None] | None = None, perform: Perform | None = None
    ) -> None:
        self._request, self._rules, self._folder = request, request.rules, request.folder
        index, count = request.shard
        self.name = f"{socket.gethostname()}-{os.getpid()}-{index}.{request.lane[0]}-{time.time_ns():x}"
        self._owner = claims.Owner(self.name)
        self._child = ChildProcess(request.rules.grace_s)
        self._perform = perform or self._run_command
        self._report = report or (lambda _: None)
        self._events = EventLog(self._folder, self.name)
        self._ended: dict[str, str] = {}
        self._wait_s: dict[str, float] = {}
        self._listed_s = -_REFRESH_S
        self._stopping = False
        self._too_many = False
        self._claim: claims.Claim | None = None
        self._inputs = InputStore((request.rules.scratch or default_scratch()).absolute(), request.rules.scratch_gb * GB)
        self._coming: Sequence[Entry] = ()
        self.counts: dict[str, int] = {}

    # the loop ----------------------------------------------------------------------------------------------------------

    def run(self) -> dict[str, int]:
        """Work until nothing is left to do here; returns how many steps ended how. SIGTERM and SIGUSR1 stop it with a checkpoint."""
        with self._signals():
            try:
                self._refresh()
                for entry in self._in_order(self._own()):
                    self._scene(entry)
                    if self._over:
                        break
                self._rest()
            finally:
                self._events.flush()
                self._inputs.evict(0.0)
        return self.counts

    @property
    def stopped(self) -> bool:
        """Whether it was asked to stop before it was finished."""
        return self._stopping

    @property
    def gave_up(self) -> bool:
        """Whether it stopped for the number of failures."""
        return self._too_many

    @property
    def _over(self) -> bool:
        return self._stopping or self._too_many

    def stop(self) -> None:
        """Stop as soon as the step that runs has written its checkpoint."""
        self._stopping = True
        self._child.stop()

    @contextlib.contextmanager
    def _signals(self) -> Iterator[None]:
        numbers = [signal.SIGTERM, *([signal.SIGUSR1] if hasattr(signal, "SIGUSR1") else [])]
        try:
            before = {number: signal.signal(number, lambda *_: self.stop()) for number in numbers}
        except ValueError:  # not the main thread
            yield
            return
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _own(self) -> list[Entry]:
        """Scenes of the own lane of the own shard; a lane of a shard is a shard of a finer division."""
        (index, count), (lane, lanes) = self._request.shard, self._request.lane
        return [one for one in self._request.entries if shard_of(one.name, count * lanes) == index + count * lane]

    def _rest(self) -> None:
        """What is left of the own shard, then of others, in an order of this worker's own; and what others hold, while patience lasts."""
        index, count = self._request.shard
        left = [one for one in self._request.entries if self._rules.steal or shard_of(one.name, count) == index]
        left.sort(key=lambda one: (shard_of(one.name, count) != index, hashlib.sha256(f"{self.name} {one.name}".encode()).digest()))
        idle_since, poll_s = time.monotonic(), _POLL_S
        self._listed_s = -_REFRESH_S
        while not self._over:
            self._refresh()
            left = [one for one in left if self._is_open(one)]
            self._wait_s.clear()
            for entry in self._in_order(left):
                if self._over:
                    return
                if self._scene(entry):
                    idle_since, poll_s = time.monotonic(), _POLL_S
            patience = self._rules.patience_s - (time.monotonic() - idle_since)
            if not self._wait_s or patience <= 0 or min(self._wait_s.values()) > patience:
                return
            self._sleep(min(poll_s, max(0.05, min(self._wait_s.values()))))
            poll_s = min(2 * poll_s, _LONGEST_POLL_S)

    def _in_order(self, entries: Sequence[Entry]) -> Iterator[Entry]:
        """Scenes one after another; what comes next is known meanwhile."""
        for number, entry in enumerate(entries):
            self._coming = entries[number + 1 : number + 1 + _LOOKED_AHEAD]
            yield entry

    def _fetch_ahead(self) -> None:
        """While a step runs, fetch the log of the next scene that is not done yet."""
        if "{source}" not in " ".join(self._request.plan.stages[0].words):
            return
        for entry in self._coming:
            if self._is_open(entry):
                if "://" in entry.source:
                    self._inputs.ahead(Location.of(entry.source), entry.settings.get(REVISION, ""))
                return

    def _sleep(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while not self._stopping and (left := end - time.monotonic()) > 0:
            time.sleep(min(0.2, left))

    def _is_open(self, entry: Entry) -> bool:
        for unit in self._request.plan.units(entry):
            state = self._ended.get(unit.key)
            if state != DONE:
                return state is None
        return False

    def _refresh(self) -> None:
        """What others have ended meanwhile; and whether too much has failed."""
        if time.monotonic() - self._listed_s < _REFRESH_S:
            return
        failed = self._folder.keys("failed")
        self._ended = {**dict.fromkeys(failed, FAILED), **dict.fromkeys(self._folder.keys("done"), DONE)}
        self._listed_s = time.monotonic()
        total = len(self._request.entries) * len(self._request.plan.stages)
        if self._rules.most_failures and len(failed) > limit_of(self._rules.most_failures, total):
            self._too_many = True

    # one scene ---------------------------------------------------------------------------------------------------------

    def _scene(self, entry: Entry) -> bool:
        """Do the steps of a scene, as far as possible; returns whether anything was done."""
        worked = False
        for unit in self._request.plan.units(entry):
            known = self._ended.get(unit.key)
            state = known or self._unit(unit)
            worked = worked or (known is None and state != BUSY)
            if state in (DONE, FAILED):
                self._ended[unit.key] = state
            if state != DONE:
                break
        self._refresh()
        return worked

    def _unit(self, unit: Unit) -> str:
        if self._over:
            return STOPPED
        found = claims.take(self._folder.claims, unit.key, self._owner, self._rules.lease_s)
        if isinstance(found, claims.Busy):
            self._wait_s[unit.key] = found.until_s
            return BUSY
        for state, record in ((DONE, self._folder.done(unit.key)), (FAILED, self._folder.failed(unit.key))):
            if record.exists():
                found.close()
                return state
        if found.counts.get(retries.LOST, 0) >= retries.rule_of(retries.LOST).tries:
            return self._fail(unit, found, Ending(retries.LOST, "its workers vanished again and again"), FAILED)
        return self._claimed(unit, found)

    def _claimed(self, unit: Unit, claim: claims.Claim) -> str:
        began, self._claim = time.time(), claim
        self._events.add("began", key=unit.key, scene=unit.entry.name, stage=unit.stage.name, attempt=claim.attempt)
        work = work_folder(self._folder, unit, claim.attempt, self._rules.scratch, self._inputs)
        work.cancelled = self._is_cancelled
        with claims.Heartbeat(claim, self._child.stop):
            ending, record = self._made(unit, work)
            if claim.lost.is_set() or not self._still_mine(claim):
                self._events.add("lost", key=unit.key, attempt=claim.attempt)
                work.remove()
                return BUSY
            if record is not None:
                return self._commit(unit, claim, work, {**record, "began": round(began, 3), "ended": round(time.time(), 3)})
        if self._stopping and ending.code in (ASKED_TO_STOP, retries.KILLED, ResourceError.exit_code, 130, 1):
            ending = Ending(ASKED_TO_STOP, "asked to stop", ending.said, ending.seconds, ending.processor_s)
        return self._after_failure(unit, claim, work, ending)

    def _still_mine(self, claim: claims.Claim) -> bool:
        try:
            return claim.is_kept()
        except MudgError:
            return True

    def _made(self, unit: Unit, work: WorkFolder) -> tuple[Ending, dict[str, Any] | None]:
        """Make a result and publish it: how that ended, and the commit record if it was successful."""
        ending = Ending(0)
        try:
            adopted = work.adopted()
            if adopted is None:
                work.prepare()
                self._fetch_ahead()
                ending = self._perform(unit, work)
                if ending.code:
                    return ending, None
            result = adopted or work.result
            wrong = quality.problems(self._rules.bounds, result)
            if adopted is None and not wrong and quality.is_sampled(unit.key, self._rules.second_share):
                different = self._second(unit, work)
                if different is not None:
                    return different, None
            record = self._record(unit, result, ending, wrong)
            if wrong:
                review.put(self._folder, record, result, work.path / "inputs")
            if adopted is None and (work.in_output or self._claim is None or self._still_mine(self._claim)):
                self._publish(work, any(unit.stage.name in stage.needs for stage in self._request.plan.stages))
            return ending, record
        except (MudgError, OSError, MemoryError) as error:
            told = failures.in_words(error)
            if told is None:
                raise
            words = "; ".join(part for part in (told.what, told.where, told.got) if part)
            return Ending(told.exit_code, words, "", ending.seconds, ending.processor_s), None

    def _publish(self, work: WorkFolder, read_later: bool) -> None:
        """Publish, and try again a few times: storage that fails for a moment is no reason to make the result again."""
        for wait_s in (*_PUBLISH_WAITS_S, None):
            try:
                work.publish(read_later)
                return
            except ResourceError as error:
                if wait_s is None or self._is_cancelled():
                    raise
                log.warn(f"publishing failed, once more in {wait_s:.0f} s: {error.what}")
                self._sleep(wait_s)

    def _second(self, unit: Unit, work: WorkFolder) -> Ending | None:
        """Make the result once more, from nothing; how that ended if it is not the same."""
        second = work.second()
        try:
            second.prepare()
            ending = self._perform(unit, second)
            if ending.code:
                return ending
            first, other = quality.digest_of(work.result), quality.digest_of(second.result)
            self._events.add("second", key=unit.key, same=first == other)
            return None if first == other else Ending(retries.DIFFERENT, f"a second run gave other bytes: {first[:12]} and {other[:12]}")
        finally:
            second.remove()

    def _record(self, unit: Unit, result: Path, ending: Ending, wrong: Sequence[str]) -> dict[str, Any]:
        return {
            "schema": 1, "scene": unit.entry.name, "stage": unit.stage.name, "key": unit.key, "source": unit.entry.source,
            "place": unit.place, "digest": quality.digest_of(result), "host": socket.gethostname(),
            "seconds": round(ending.seconds, 3), "processor_s": round(ending.processor_s, 3), **quality.spent_of(result),
            "written_bytes": folder_bytes(result), "facts": quality.facts_of(result), "problems": list(wrong),
        }  # fmt: skip

    # ends --------------------------------------------------------------------------------------------------------------

    def _commit(self, unit: Unit, claim: claims.Claim, work: WorkFolder, record: dict[str, Any]) -> str:
        """Put a result on record; one that fails a bound is on record as rejected."""
        if record["problems"]:
            words = "; ".join(record["problems"])
            work.remove()
            return self._fail(unit, claim, Ending(retries.REJECTED, words, "", record["seconds"], record["processor_s"]), REJECTED, record)
        record["attempt"] = claim.attempt
        content = store.json_text(record, indent=None).encode()
        made = self._folder.done(unit.key).save(content, only_if_absent=True)
        told = {name: value for name, value in record.items() if name not in ("schema", "source", "place", "host", "problems")}
        self._events.add(DONE if made else "twice", **told)
        claim.close()
        work.remove()
        self._tell(unit, DONE, record["seconds"], "")
        return DONE

    def _fail(
        self, unit: Unit, claim: claims.Claim, ending: Ending, state: str, record: Mapping[str, Any] | None = None
    ) -> str:
        rule = retries.rule_of(ending.code)
        values = {
            **(record or {}), "schema": 1, "scene": unit.entry.name, "stage": unit.stage.name, "key": unit.key, "source": unit.entry.source,
            "state": state, "code": ending.code, "reason": rule.reason, "words": ending.words[:2000], "attempt": claim.attempt,
            "host": socket.gethostname(), "seconds": round(ending.seconds, 3), "processor_s": round(ending.processor_s, 3),
        }  # fmt: skip
        with contextlib.suppress(MudgError):
            if ending.said:
                self._folder.log(unit.key).save(ending.said.encode())
        self._folder.failed(unit.key).save(store.json_text(values, indent=None).encode(), only_if_absent=True)
        self._events.add(state, **{name: value for name, value in values.items() if name not in ("schema", "source")})
        claim.close()
        self._listed_s = -_REFRESH_S
        self._tell(unit, state, ending.seconds, ending.words, ending.code)
        return FAILED

    def _after_failure(self, unit: Unit, claim: claims.Claim, work: WorkFolder, ending: Ending) -> str:
        rule = retries.rule_of(ending.code)
        times = claim.counts.get(ending.code, 0) + 1
        if ending.code in (InputError.exit_code, IntegrityError.exit_code) and "://" in unit.entry.source:
            self._inputs.doubt(Location.of(unit.entry.source), unit.entry.settings.get(REVISION, ""))
        useless = rule.fresh or rule.tries == 1  # of a log that is going to be repaired, or of settings that nobody wants
        if useless or (rule.elsewhere and not work.in_output):  # a scratch disk that is full must not stay so
            work.remove()
        else:
            with contextlib.suppress(MudgError, OSError):
                work.leave(stopped=self._stopping)
        if times >= (rule.tries if self._stopping else min(rule.tries, self._rules.most_tries)):
            return self._fail(unit, claim, ending, FAILED)
        wait_s = 0.0 if self._stopping else retries.backoff(ending.code, times, False)
        self._events.add(
            AGAIN, key=unit.key, attempt=claim.attempt, code=ending.code, words=ending.words[:500], seconds=round(ending.seconds, 3),
            processor_s=round(ending.processor_s, 3),
        )  # fmt: skip
        claim.give_back(ending.code, time.time() + wait_s if wait_s else 0.0)
        self._wait_s[unit.key] = wait_s
        return STOPPED if self._stopping else AGAIN

    def _tell(self, unit: Unit, state: str, seconds: float, words: str, code: int = 0) -> None:
        self.counts[state] = self.counts.get(state, 0) + 1
        if state != DONE:
            log.warn(f"{unit.title} {state}: {words}")
        self._report({"scene": unit.entry.name, "stage": unit.stage.name, "state": state, "seconds": seconds, "words": words, "code": code})

    def _is_cancelled(self) -> bool:
        return self._stopping or (self._claim is not None and self._claim.lost.is_set())

    def _run_command(self, unit: Unit, work: WorkFolder) -> Ending:
        killed_before = self._claim is not None and retries.KILLED in self._claim.counts
        if killed_before:
            log.warn(f"{unit.title}: killed before, most likely for want of memory: now alone on this machine, with one thread and process")
        with turns.turn(killed_before, self._is_cancelled) as mine:
            ending = self._started(unit, work, 1 if killed_before else self._rules.threads) if mine else Ending(ASKED_TO_STOP)
        if killed_before and ending.code == retries.KILLED:
            return replace(ending, words="its process was killed by signal 9, also alone on its machine with one thread: out of memory?")
        return ending

    def _started(self, unit: Unit, work: WorkFolder, threads: int) -> Ending:
        environment = {"OMP_NUM_THREADS": str(threads), "OMP_WAIT_POLICY": "PASSIVE", "MUDG_THREADS": str(threads), turns.HELD: "1"}
        ending = self._child.run(work.command(), work.cwd, environment, self._is_cancelled)
        if ending.code == UsageError.exit_code and (again := work.replacing()) is not None:
            ending = self._child.run(again, work.cwd, environment, self._is_cancelled)
        if ending.code == 0 and not work.result.exists():
            return Ending(1, "it ended well but wrote nothing", ending.said, ending.seconds, ending.processor_s)
        return ending


def limit_of(text: str, total: int) -> float:
    """Most failures of so many steps, from a number or a share with a percent sign."""
    return float(text[:-1]) / 100 * total if text.endswith("%") else float(text)


