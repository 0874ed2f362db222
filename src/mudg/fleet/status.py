"""How far a batch is, from its records: steps by state, failures by reason, time, costs, and facts about the logs."""

from __future__ import annotations

import io
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

from mudg.base.errors import plain
from mudg.base.memory import in_words
from mudg.fleet.records import BatchFolder, CorpusFacts, Ended
from mudg.fleet.work import REASONS

_WINDOW_S: Final = 3600.0
_SHOWN: Final = 12


@dataclass(slots=True)
class StageFigures:
    """Figures of one step over all scenes. lost_s: processor seconds of attempts without a result."""

    done: int = 0
    failed: int = 0
    seconds: float = 0.0
    processor_s: float = 0.0
    lost_s: float = 0.0
    written_bytes: int = 0
    peak_bytes: int = 0
    slowest: tuple[float, str] = (0.0, "")

    def add(self, ended: Ended, is_done: bool) -> None:
        """Count the end of a step."""
        self.lost_s += ended.lost_s
        if not is_done:
            self.failed += 1
            return
        self.done += 1
        self.seconds += ended.seconds
        self.processor_s += ended.processor_s
        self.written_bytes += ended.written_bytes
        self.peak_bytes = max(self.peak_bytes, ended.peak_bytes or 0)
        self.slowest = max(self.slowest, (ended.seconds, ended.scene))


@dataclass
class BatchStatus:
    """The state of a batch at one moment. ends: times at which steps ended. price: of a core-hour."""

    out: str
    scenes: int
    stages: dict[str, StageFigures]
    price: float = 0.0
    drivers: list[str] = field(default_factory=list)
    failures: list[Ended] = field(default_factory=list)
    logs: list[CorpusFacts] = field(default_factory=list)
    ends: list[float] = field(default_factory=list)

    @property
    def finished(self) -> int:
        """Scenes whose last step is done."""
        return next(reversed(self.stages.values())).done

    def left(self, name: str) -> int:
        """Scenes that can still come to a step: all but those that failed before it."""
        before = 0
        for other, figures in self.stages.items():
            if other == name:
                break
            before += figures.failed
        return max(0, self.scenes - before - self.stages[name].done - self.stages[name].failed)

    def steps_left(self) -> int:
        """Steps that have no end yet and can have one."""
        return sum(map(self.left, self.stages))

    def rate(self) -> float:
        """Steps that ended per second over the last hour of work, or the whole time if that is shorter."""
        last = max(self.ends, default=0.0)
        recent = [end for end in self.ends if end > last - _WINDOW_S]
        span = max(recent) - min(recent) if recent else 0.0
        return (len(recent) - 1) / span if span > 0 else 0.0

    def forecast_s(self) -> float | None:
        """Seconds until the rest is done at the present rate; None if nothing is known."""
        left, rate = self.steps_left(), self.rate()
        return 0.0 if left == 0 else left / rate if rate > 0 else None

    def reasons(self) -> list[tuple[str, int, str]]:
        """Reasons of failures with their number and an example, the most frequent first."""
        groups: Counter[tuple[int, str]] = Counter()
        examples: dict[tuple[int, str], str] = {}
        for one in sorted(self.failures, key=lambda one: one.scene):
            group = (one.code, one.words.split(";")[0][:80])
            groups[group] += 1
            examples.setdefault(group, f"{one.scene} {one.stage}")
        return [
            (f"{code} {reason_of(code)}: {words}", count, examples[code, words])
            for (code, words), count in groups.most_common()
        ]

    def costs(self) -> dict[str, dict[str, float]]:
        """Core-hours and money so far, and of the rest, by step and in total."""
        rows: dict[str, dict[str, float]] = {}
        for name, one in self.stages.items():
            hours = (one.processor_s + one.lost_s) / 3600
            rest = hours / one.done * self.left(name) if one.done else 0.0
            rows[name] = {"core_hours": hours, "lost_hours": one.lost_s / 3600, "core_hours_left": rest}
            rows[name] |= {"money": hours * self.price, "money_left": rest * self.price}
        rows["total"] = {key: sum(row[key] for row in rows.values()) for key in next(iter(rows.values()))}
        return {name: {key: round(value, 4) for key, value in row.items()} for name, row in rows.items()}

    def corpus(self) -> dict[str, Any]:
        """Sums over the logs."""
        cameras, objects = sorted(Counter(log.cameras for log in self.logs).items()), Counter[str]()
        for log in self.logs:
            objects.update(log.objects)
        hours, kilometres = sum(log.seconds for log in self.logs) / 3600, sum(log.metres for log in self.logs) / 1000
        sums = {"scenes": len(self.logs), "images": sum(log.images for log in self.logs), "hours": round(hours, 4)}
        sums |= {"kilometres": round(kilometres, 4), "cameras": {str(count): scenes for count, scenes in cameras}}
        datasets = Counter(log.dataset for log in self.logs)
        return {**sums, "datasets": dict(datasets.most_common()), "objects": dict(objects.most_common())}

    def record(self) -> dict[str, Any]:
        """As JSON values."""
        stages = {}
        for name, one in self.stages.items():
            stages[name] = {"done": one.done, "failed": one.failed, "left": self.left(name)}
            stages[name] |= {key: round(getattr(one, key), 1) for key in ("seconds", "processor_s", "lost_s")}
            stages[name] |= {"written_bytes": one.written_bytes, "peak_bytes": one.peak_bytes}
            stages[name] |= {"slowest": one.slowest[1]}
        reasons = [{"reason": words, "steps": count, "example": example} for words, count, example in self.reasons()]
        record = {"out": self.out, "scenes": self.scenes, "finished": self.finished, "left": self.steps_left()}
        record |= {"stages": stages, "reasons": reasons, "steps_per_hour": round(self.rate() * 3600, 2)}
        record |= {"forecast_s": self.forecast_s(), "costs": self.costs(), "price": self.price}
        return {**record, "corpus": self.corpus(), "drivers": self.drivers}


def reason_of(code: int) -> str:
    """What an exit code of a step means."""
    return REASONS.get(code, f"ended by signal {code - 128}" if code > 128 else f"exit code {code}")


def read_status(folder: BatchFolder, price: float = 0.0) -> BatchStatus:
    """Read the state of a batch. price: of a core-hour.

    Raises:
        InputError: no batch is there, or a record of it is damaged.
    """
    state = BatchStatus(str(folder.out), 0, {name: StageFigures() for name in folder.stages()}, price)
    state.scenes = len(folder.scenes())
    state.drivers = [str(owner) for owner in folder.owners().values()]
    for is_done in (True, False):
        for ended in folder.records("done" if is_done else "failed"):
            if ended.stage in state.stages:
                state.stages[ended.stage].add(ended, is_done)
                state.ends.append(ended.ended)
                if not is_done:
                    state.failures.append(ended)
                elif ended.facts is not None and ended.stage in ("run", "ingest"):
                    state.logs.append(ended.facts)
    return state


def duration_text(seconds: float | None) -> str:
    """A duration for people."""
    if seconds is None:
        return "unknown"
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


HEADS: Final = tuple("step,done,failed,left,seconds each,most memory,written,core-hours,lost,still needed".split(","))


def stage_rows(state: BatchStatus) -> list[tuple[str, ...]]:
    """One row per step, and a total of the costs where a price is known."""
    rows, costs = [], state.costs()
    for name, one in state.stages.items():
        each = f"{one.seconds / one.done:.1f}" if one.done else ""
        sizes = (in_words(size) if size else "" for size in (one.peak_bytes, one.written_bytes))
        hours = (f"{costs[name][key]:.3f}" for key in ("core_hours", "lost_hours", "core_hours_left"))
        rows.append((name, str(one.done), str(one.failed), str(state.left(name)), each, *sizes, *hours))
    if state.price:
        total = costs["total"]
        rows.append((f"cost at {state.price:g}", *[""] * 6, f"{total['money']:.2f}", "", f"{total['money_left']:.2f}"))
    return rows


def text_of(state: BatchStatus) -> str:
    """The status as tables for a terminal."""
    from rich.console import Console
    from rich.table import Table

    grid = Table(title=f"{state.out}: {state.scenes} scenes", title_justify="left")
    for column in HEADS:
        grid.add_column(column, justify="left" if column == "step" else "right")
    for row in stage_rows(state):
        grid.add_row(*row)
    out = io.StringIO()
    Console(file=out, width=120, markup=False, highlight=False).print(grid)
    for words, count, example in state.reasons()[:_SHOWN]:
        out.write(f"{count:7d} x {plain(words)}  (e.g. {plain(example)})\n")
    out.writelines(f"driven by {driver}\n" for driver in map(plain, state.drivers))
    return out.getvalue() + _lead(state)


def _lead(state: BatchStatus) -> str:
    return (
        f"{state.finished} of {state.scenes} scenes are finished, {state.steps_left()} steps are left;"
        f" {state.rate() * 3600:.1f} steps an hour, forecast for the rest: {duration_text(state.forecast_s())}"
    )


def page_of(state: BatchStatus) -> str:
    """The status as a page, with figures of the logs."""
    from mudg.base import html

    corpus, stages = state.corpus(), state.stages.items()
    values: dict[str, Any] = {"title": "Batch", "kicker": "mudg batch", "heading": state.out, "heads": HEADS}
    values |= {"lead": f"{_lead(state)}.", "drivers": state.drivers, "rows": stage_rows(state)}
    values |= {"reasons": state.reasons(), "failures": state.failures[:500], "failed": len(state.failures)}
    values["funnel"] = [(name, one.done, one.failed, state.scenes) for name, one in stages]
    values["slowest"] = [(name, one.slowest[1], f"{one.slowest[0]:.1f} s") for name, one in stages if one.done]
    figures = {"Logs": str(corpus["scenes"]), "Hours driven": f"{corpus['hours']:.2f}"}
    figures |= {"Kilometres driven": f"{corpus['kilometres']:.2f}", "Images": str(corpus["images"])}
    values["figures"] = [*figures.items(), ("Tracked objects", str(sum(corpus["objects"].values())))]
    for name, most in (("cameras", None), ("datasets", 30), ("objects", 40)):
        values[name] = [(one, str(count)) for one, count in list(corpus[name].items())[:most]]
    values["at"] = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    return html.render("batch.html.j2", **values)
