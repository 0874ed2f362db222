"""How far a batch is: steps by state, failures by reason, throughput, and a forecast of the rest.

What is done or failed is told by the names of their records, in one listing each; details come from the workers' events. A record whose
event was lost with its worker is read by itself.
"""

from __future__ import annotations

import io
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from mudg.base.errors import plain
from mudg.base.memory import in_words
from mudg.stages.batches import claims, quality, retries, review
from mudg.stages.batches.folders import BatchFolder

_WINDOW_S: Final = 3600.0
_MOST_READ: Final = 2000
_SHOWN: Final = 12


@dataclass(frozen=True, slots=True)
class StepFailure:
    """A step that has failed: its scene, step, exit code, and why in a line."""

    scene: str
    stage: str
    code: int
    words: str
    state: str = "failed"


@dataclass(slots=True)
class StageFigures:
    """Figures of one step over all scenes."""

    done: int = 0
    failed: int = 0
    rejected: int = 0
    running: int = 0
    waiting: int = 0
    seconds: float = 0.0
    processor_s: float = 0.0
    known: int = 0
    written_bytes: int = 0
    peak_bytes: int = 0
    wasted_s: float = 0.0
    slowest: tuple[float, str] = (0.0, "")


@dataclass
class CorpusFacts:
    """Sums over the logs of a batch."""

    scenes: int = 0
    images: int = 0
    seconds: float = 0.0
    metres: float = 0.0
    cameras: Counter[int] = field(default_factory=Counter)
    datasets: Counter[str] = field(default_factory=Counter)
    objects: Counter[str] = field(default_factory=Counter)


@dataclass
class BatchStatus:
    """The state of a batch at one moment."""

    out: str
    scenes: int
    stages: dict[str, StageFigures]
    failures: dict[str, StepFailure]
    corpus: CorpusFacts
    finished_scenes: int
    ends: list[float]
    """Times at which scenes were finished, newest last."""
    now: float
    events: Counter[str]
    workers: int = 0
    for_review: int = 0
    """Results that wait for somebody to look at them."""

    @property
    def total(self) -> int:
        """Steps of all scenes."""
        return self.scenes * len(self.stages)

    def rate(self) -> float:
        """Steps that ended per second over the last hour of work, or the whole time if that is shorter."""
        if len(self.ends) < 2:
            return 0.0
        recent = [time for time in self.ends if time > self.ends[-1] - _WINDOW_S]
        span = recent[-1] - recent[0]
        return (len(recent) - 1) / span if span > 0 else 0.0

    def left(self) -> int:
        """Steps that have no end yet and can have one."""
        return sum(max(0, self.entering(name) - one.done - one.failed - one.rejected) for name, one in self.stages.items())

    def entering(self, name: str) -> int:
        """Scenes that come or can still come to a step: all but those that failed before."""
        before = 0
        for other, figures in self.stages.items():
            if other == name:
                break
            before += figures.failed + figures.rejected
        return self.scenes - before

    def forecast_s(self) -> float | None:
        """Seconds until the rest is done at the present rate; None if nothing is known."""
        left, rate = self.left(), self.rate()
        return 0.0 if left == 0 else left / rate if rate > 0 else None

    def reasons(self) -> list[tuple[str, int, str]]:
        """Reasons of failures with their number and an example, the most frequent first."""
        groups: Counter[tuple[int, str]] = Counter()
        example: dict[tuple[int, str], StepFailure] = {}
        for failure in sorted(self.failures.values(), key=lambda one: one.scene):
            group = (failure.code, failure.words.split(";")[0].split(quality.FOUND)[0][:80])
            groups[group] += 1
            example.setdefault(group, failure)
        rows = []
        for (code, words), count in groups.most_common():
            one = example[code, words]
            name = retries.rule_of(code).reason
            rows.append((f"{code if code >= 0 else ''} {name}: {words}".strip(), count, f"{one.scene} {one.stage}"))
        return rows

    def record(self) -> dict[str, Any]:
        """As JSON values."""
        stages = {
            name: {
                "done": one.done, "failed": one.failed, "rejected": one.rejected, "running": one.running, "waiting": one.waiting,
                "seconds": round(one.seconds, 1), "processor_s": round(one.processor_s, 1), "written_bytes": one.written_bytes,
                "slowest": one.slowest[1], "wasted_s": round(one.wasted_s, 1),
            }
            for name, one in self.stages.items()
        }  # fmt: skip
        corpus = {
            "scenes": self.corpus.scenes, "images": self.corpus.images, "hours": round(self.corpus.seconds / 3600, 4),
            "kilometres": round(self.corpus.metres / 1000, 4),
            "cameras": {str(count): scenes for count, scenes in sorted(self.corpus.cameras.items())},
            "datasets": dict(self.corpus.datasets.most_common()), "objects": dict(self.corpus.objects.most_common()),
        }  # fmt: skip
        return {
            "out": self.out, "scenes": self.scenes, "finished": self.finished_scenes, "left": self.left(), "stages": stages,
            "reasons": [{"reason": words, "steps": count, "example": example} for words, count, example in self.reasons()],
            "steps_per_hour": round(self.rate() * 3600, 2), "forecast_s": self.forecast_s(), "corpus": corpus,
            "for_review": self.for_review, "second_runs": self.events["second"], "second_runs_different": self.events["different"],
        }  # fmt: skip


def read_status(folder: BatchFolder) -> BatchStatus:
    """Read the state of a batch.

    Raises:
        InputError: no batch is there, or a record of it is damaged.
    """
    plan = folder.plan()
    names = [str(one["name"]) for one in plan["stages"]]
    stages = {name: StageFigures() for name in names}
    state = BatchStatus(str(folder.out), len(folder.entries()), stages, {}, CorpusFacts(), 0, [], time.time(), Counter())
    done, failed = folder.keys("done"), folder.keys("failed")
    told: set[str] = set()
    stage_of: dict[str, str] = {}
    workers: dict[str, float] = {}
    for event in folder.events():
        workers[str(event.get("worker"))] = float(event.get("at", 0.0))
        _fold(state, event, done, failed, told, stage_of)
    for number, key in enumerate(sorted((done | failed) - told)):
        if number < _MOST_READ:
            _fold_record(state, folder, key, key in done, told)
    _count_claims(state, folder, stage_of)
    last = names[-1]
    state.finished_scenes = state.stages[last].done
    state.ends.sort()
    state.workers = len(workers)
    state.for_review = review.count(folder)
    return state


def _fold(
    state: BatchStatus, event: Mapping[str, Any], done: set[str], failed: set[str], told: set[str], stage_of: dict[str, str]
) -> None:
    kind, key = event.get("event"), str(event.get("key", ""))
    if kind == "began":
        stage_of.setdefault(key, str(event.get("stage", "")))
    elif kind in ("again", "lost", "twice"):
        figures = state.stages.get(stage_of.get(key, ""))
        if figures is not None:
            figures.wasted_s += float(event.get("processor_s", 0.0))
    elif kind == "second":
        state.events["second"] += 1
        state.events["different"] += not event.get("same")
    elif kind == "done" and key in done and key not in told:
        told.add(key)
        stage_of.pop(key, None)
        _add_done(state, event)
    elif kind in ("failed", "rejected") and key in failed and key not in done:
        if key not in told:
            told.add(key)
            _count_failure(state, event, kind)
        stage_of.pop(key, None)
        _note_failure(state, key, event, kind)


def _add_done(state: BatchStatus, record: Mapping[str, Any]) -> None:
    figures = state.stages.get(str(record.get("stage")))
    if figures is None:
        return
    figures.done += 1
    _add_spent(figures, record)
    state.ends.append(float(record.get("ended") or record.get("at") or 0.0))
    facts = record.get("facts")
    if isinstance(facts, Mapping) and facts and str(record.get("stage")) in ("run", "ingest"):
        corpus = state.corpus
        corpus.scenes += 1
        corpus.images += int(facts.get("images", 0))
        corpus.seconds += float(facts.get("seconds", 0.0))
        corpus.metres += float(facts.get("metres", 0.0))
        corpus.cameras[int(facts.get("cameras", 0))] += 1
        corpus.datasets[str(facts.get("dataset", ""))] += 1
        corpus.objects.update({str(name): int(count) for name, count in facts.get("objects", {}).items()})


def _add_spent(figures: StageFigures, record: Mapping[str, Any]) -> None:
    seconds = float(record.get("seconds", 0.0))
    figures.known += 1
    figures.seconds += seconds
    figures.processor_s += float(record.get("processor_s", 0.0))
    figures.written_bytes += int(record.get("written_bytes") or 0)
    figures.peak_bytes = max(figures.peak_bytes, int(record.get("peak_bytes") or 0))
    figures.slowest = max(figures.slowest, (seconds, str(record.get("scene", ""))))


def _count_failure(state: BatchStatus, record: Mapping[str, Any], kind: str) -> None:
    figures = state.stages.get(str(record.get("stage")))
    if figures is None:
        return
    if kind == "rejected":
        figures.rejected += 1
    else:
        figures.failed += 1
    figures.wasted_s += float(record.get("processor_s", 0.0))
    state.ends.append(float(record.get("at") or record.get("ended") or 0.0))


def _note_failure(state: BatchStatus, key: str, record: Mapping[str, Any], kind: str) -> None:
    state.failures[key] = StepFailure(
        str(record.get("scene")), str(record.get("stage")), int(record.get("code", 1)), str(record.get("words", ""))[:300], kind
    )


def _fold_record(state: BatchStatus, folder: BatchFolder, key: str, is_done: bool, told: set[str]) -> None:
    file = folder.done(key) if is_done else folder.failed(key)
    if not file.exists():  # tried again meanwhile
        return
    record = folder.ended(file)
    told.add(key)
    if is_done:
        _add_done(state, record)
    else:
        kind = str(record.get("state", "failed"))
        _count_failure(state, record, kind)
        _note_failure(state, key, record, kind)


def _count_claims(state: BatchStatus, folder: BatchFolder, stage_of: Mapping[str, str]) -> None:
    """Steps that are being done or wait for another try: the last attempt of every key that has claims."""
    last: dict[str, int] = {}
    for name in folder.claims.names():
        key, _, number = name.removesuffix(".json").rpartition(".")
        if number.isdecimal():
            last[key] = max(last.get(key, 0), int(number))
    for key, number in list(last.items())[:_MOST_READ]:
        record = claims.read(folder.claims / f"{key}.{number}.json")
        figures = state.stages.get(stage_of.get(key, ""))
        if not record or figures is None:
            continue
        if record.get("state") == claims.WORKING and float(record.get("until", 0.0)) > state.now:
            figures.running += 1
        else:
            figures.waiting += 1


def duration_text(seconds: float | None) -> str:
    """A duration for people."""
    if seconds is None:
        return "unknown"
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


def text_of(state: BatchStatus) -> str:
    """The status as tables for a terminal."""
    from rich.console import Console
    from rich.table import Table

    grid = Table(title=f"{state.out}: {state.scenes} scenes", title_justify="left")
    for column in ("step", "done", "running", "waiting", "failed", "rejected", "seconds each", "most memory", "written"):
        grid.add_column(column, justify="left" if column == "step" else "right")
    for row in stage_rows(state):
        grid.add_row(*row)
    out = io.StringIO()
    console = Console(file=out, width=120, markup=False, highlight=False)
    console.print(grid)
    for words, count, example in state.reasons()[:_SHOWN]:
        out.write(f"{count:7d} x {plain(words)}  (e.g. {plain(example)})\n")
    if state.for_review:
        out.write(f"{state.for_review} results wait for review: mudg batch review {state.out}\n")
    out.write(
        f"{state.finished_scenes} of {state.scenes} scenes are finished, {state.left()} steps are left; "
        f"{state.rate() * 3600:.1f} steps an hour, forecast for the rest: {duration_text(state.forecast_s())}"
    )
    return out.getvalue()


def stage_rows(state: BatchStatus) -> list[tuple[str, ...]]:
    """The funnel: one row per step."""
    return [
        (
            name, str(one.done), str(one.running), str(one.waiting), str(one.failed), str(one.rejected),
            f"{one.seconds / one.known:.1f}" if one.known else "", in_words(one.peak_bytes) if one.peak_bytes else "",
            in_words(one.written_bytes) if one.written_bytes else "",
        )
        for name, one in state.stages.items()
    ]  # fmt: skip


def page_of(state: BatchStatus) -> str:
    """The status as a page, with figures of the corpus."""
    from mudg.report import html

    corpus = state.corpus
    return html.render(
        "batch.html.j2", title="Batch", kicker="mudg batch", heading=state.out,
        lead=f"{state.finished_scenes} of {state.scenes} scenes are finished, {state.left()} steps are left. Forecast for the rest: "
        f"{duration_text(state.forecast_s())} at {state.rate() * 3600:.1f} steps an hour.",
        funnel=[(name, one.done, one.running, one.waiting, one.failed, one.rejected, state.scenes) for name, one in state.stages.items()],
        rows=stage_rows(state),
        slowest=[(name, one.slowest[1], f"{one.slowest[0]:.1f} s") for name, one in state.stages.items() if one.known],
        for_review=state.for_review, reasons=state.reasons(), failures=list(state.failures.values())[:500], failed=len(state.failures),
        figures=[
            ("Logs", str(corpus.scenes)), ("Hours driven", f"{corpus.seconds / 3600:.2f}"),
            ("Kilometres driven", f"{corpus.metres / 1000:.2f}"), ("Images", str(corpus.images)),
            ("Tracked objects", str(corpus.objects.total())),
            ("Second runs", f"{state.events['second']}, {state.events['different']} different"),
        ],
        cameras=[(f"{count}", str(scenes)) for count, scenes in sorted(corpus.cameras.items())],
        datasets=[(name, str(scenes)) for name, scenes in corpus.datasets.most_common(30)],
        objects=[(name, str(count)) for name, count in corpus.objects.most_common(40)],
        at=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(state.now)),
    )  # fmt: skip
