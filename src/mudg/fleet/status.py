"""How far a batch is, from its records: steps by state, failures by reason, time and core-hours."""

from __future__ import annotations

import io
from collections import Counter
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from mudg.base.errors import plain
from mudg.base.memory import in_words
from mudg.fleet.records import BatchFolder, Ended
from mudg.fleet.work import REASONS

_WINDOW_S: Final = 3600.0
_SHOWN: Final = 12


@dataclass(slots=True)
class StageFigures:
    """Figures of one step over all scenes. left: scenes that can still come to it: all but those that failed before.
    lost_s: processor seconds of attempts without a result."""

    done: int = 0
    failed: int = 0
    left: int = 0
    seconds: float = 0.0
    processor_s: float = 0.0
    lost_s: float = 0.0
    written_bytes: int = 0
    peak_bytes: int = 0

    @property
    def core_hours(self) -> float:
        """Core-hours so far, those of attempts that failed as well."""
        return (self.processor_s + self.lost_s) / 3600

    @property
    def core_hours_left(self) -> float:
        """Core-hours of the rest, if it takes as much as what is done; 0 where nothing is."""
        return self.core_hours / self.done * self.left if self.done else 0.0


@dataclass
class BatchStatus:
    """The state of a batch at one moment. ends: times at which steps ended."""

    out: str
    scenes: int
    stages: dict[str, StageFigures]
    drivers: list[str]
    failures: list[Ended] = field(default_factory=list)
    ends: list[float] = field(default_factory=list)

    @property
    def finished(self) -> int:
        """Scenes whose last step is done."""
        return next(reversed(self.stages.values())).done

    def steps_left(self) -> int:
        """Steps that have no end yet and can have one."""
        return sum(one.left for one in self.stages.values())

    def rate(self) -> float:
        """Steps that ended per second over the last hour of work, or the whole time if that is shorter."""
        last = max(self.ends, default=0.0)
        recent = [end for end in self.ends if end > last - _WINDOW_S]
        span = last - min(recent, default=last)
        return (len(recent) - 1) / span if span > 0 else 0.0

    def forecast_s(self) -> float | None:
        """Seconds until the rest is done at the present rate; None if nothing is known."""
        left, rate = self.steps_left(), self.rate()
        return 0.0 if left == 0 else left / rate if rate > 0 else None

    def reasons(self) -> list[tuple[str, int, str]]:
        """Reasons of failures with their number and an example, the most frequent first."""
        groups: Counter[str] = Counter()
        examples: dict[str, str] = {}
        for one in sorted(self.failures, key=lambda one: one.scene):
            ended = f"ended by signal {one.code - 128}" if one.code > 128 else f"exit code {one.code}"
            reason = f"{one.code} {REASONS.get(one.code, ended)}: {one.words.split(';')[0][:80]}"
            groups[reason] += 1
            examples.setdefault(reason, f"{one.scene} {one.stage}")
        return [(reason, count, examples[reason]) for reason, count in groups.most_common()]

    def record(self) -> dict[str, Any]:
        """As JSON values."""
        hours = ("core_hours", "core_hours_left")
        stages = {
            name: {key: round(value, 1) for key, value in asdict(one).items()}
            | {key: round(getattr(one, key), 4) for key in hours}
            for name, one in self.stages.items()
        }
        reasons = [{"reason": words, "steps": count, "example": example} for words, count, example in self.reasons()]
        record = {"out": self.out, "scenes": self.scenes, "finished": self.finished, "left": self.steps_left()}
        record |= {"stages": stages, "reasons": reasons, "steps_per_hour": round(self.rate() * 3600, 2)}
        return {**record, "forecast_s": self.forecast_s(), "drivers": self.drivers}


def read_status(folder: BatchFolder) -> BatchStatus:
    """Read the state of a batch. InputError: no batch is there, or a record of it is damaged."""
    stages = {name: StageFigures() for name in folder.stages()}
    drivers = [str(owner) for owner in folder.owners().values()]
    state = BatchStatus(str(folder.out), len(folder.scenes()), stages, drivers)
    for kind in ("done", "failed"):
        for ended in folder.records(kind):
            if (one := stages.get(ended.stage)) is None:
                continue
            state.ends.append(ended.ended)
            one.lost_s += ended.lost_s
            if kind == "failed":
                one.failed += 1
                state.failures.append(ended)
                continue
            one.done += 1
            one.seconds += ended.seconds
            one.processor_s += ended.processor_s
            one.written_bytes += ended.written_bytes
            one.peak_bytes = max(one.peak_bytes, ended.peak_bytes or 0)
    failed = 0
    for one in stages.values():
        failed += one.failed
        one.left = max(0, state.scenes - failed - one.done)
    return state


def duration_text(seconds: float | None) -> str:
    """A duration for people."""
    if seconds is None:
        return "unknown"
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


_HEADS: Final = "step,done,failed,left,seconds each,most memory,written,core-hours,lost,still needed".split(",")


def text_of(state: BatchStatus) -> str:
    """The status as tables for a terminal."""
    from rich.console import Console
    from rich.table import Table

    grid = Table(title=f"{state.out}: {state.scenes} scenes", title_justify="left")
    for column in _HEADS:
        grid.add_column(column, justify="left" if column == "step" else "right")
    for name, one in state.stages.items():
        each = f"{one.seconds / one.done:.1f}" if one.done else ""
        sizes = (in_words(size) if size else "" for size in (one.peak_bytes, one.written_bytes))
        hours = (f"{value:.3f}" for value in (one.core_hours, one.lost_s / 3600, one.core_hours_left))
        grid.add_row(name, str(one.done), str(one.failed), str(one.left), each, *sizes, *hours)
    out = io.StringIO()
    Console(file=out, width=120, markup=False, highlight=False).print(grid)
    for words, count, example in state.reasons()[:_SHOWN]:
        out.write(f"{count:7d} x {plain(words)}  (e.g. {plain(example)})\n")
    out.writelines(f"driven by {driver}\n" for driver in map(plain, state.drivers))
    return (
        f"{out.getvalue()}{state.finished} of {state.scenes} scenes are finished, {state.steps_left()} steps are left;"
        f" {state.rate() * 3600:.1f} steps an hour, forecast for the rest: {duration_text(state.forecast_s())}"
    )
