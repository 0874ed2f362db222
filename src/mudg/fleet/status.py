"""How far a batch is, from its records: steps by state, failures by reason, time and core-hours."""

from __future__ import annotations

import io
from collections import Counter
from dataclasses import asdict, dataclass
from typing import Any, Final

from mudg.base.errors import plain
from mudg.base.memory import in_words
from mudg.fleet.records import BatchFolder, Ended
from mudg.fleet.work import REASONS

_SHOWN: Final = 12
_HEADS: Final = "step,done,failed,left,seconds each,most memory,written,core-hours,still needed".split(",")


@dataclass(slots=True)
class StageFigures:
    """Figures of one step over all scenes. left: scenes that can still come to it: all but those that failed before.
    core_hours: those of attempts that failed as well; core_hours_left: if the rest takes as much as what is done."""

    done: int = 0
    failed: int = 0
    left: int = 0
    seconds: float = 0.0
    written_bytes: int = 0
    peak_bytes: int = 0
    core_hours: float = 0.0
    core_hours_left: float = 0.0


def read_status(folder: BatchFolder) -> dict[str, Any]:
    """The state of a batch as JSON values. InputError: no batch is there, or a record of it is damaged."""
    stages = {name: StageFigures() for name in folder.stages()}
    drivers, scenes = [str(owner) for owner in folder.owners().values()], len(folder.scenes())
    failures: list[Ended] = []
    for kind in ("done", "failed"):
        for ended in folder.records(kind):
            if (one := stages.get(ended.stage)) is None:
                continue
            one.core_hours += ended.lost_s / 3600
            if kind == "failed":
                one.failed += 1
                failures.append(ended)
                continue
            one.done += 1
            one.seconds += ended.seconds
            one.core_hours += ended.processor_s / 3600
            one.written_bytes += ended.written_bytes
            one.peak_bytes = max(one.peak_bytes, ended.peak_bytes or 0)
    failed = 0
    for one in stages.values():
        failed += one.failed
        one.left = max(0, scenes - failed - one.done)
        one.core_hours_left = one.core_hours / one.done * one.left if one.done else 0.0
    figures = {name: {key: round(value, 4) for key, value in asdict(one).items()} for name, one in stages.items()}
    left, finished = sum(one.left for one in stages.values()), next(reversed(stages.values())).done
    state = {"out": str(folder.out), "scenes": scenes, "finished": finished, "left": left, "stages": figures}
    return {**state, "reasons": _reasons(failures), "drivers": drivers}


def _reasons(failures: list[Ended]) -> list[dict[str, Any]]:
    """Reasons of failures with their number and an example, the most frequent first."""
    groups: Counter[str] = Counter()
    examples: dict[str, str] = {}
    for one in sorted(failures, key=lambda one: one.scene):
        ended = f"ended by signal {one.code - 128}" if one.code > 128 else f"exit code {one.code}"
        reason = f"{one.code} {REASONS.get(one.code, ended)}: {one.words.split(';')[0][:80]}"
        groups[reason] += 1
        examples.setdefault(reason, f"{one.scene} {one.stage}")
    return [{"reason": reason, "steps": count, "example": examples[reason]} for reason, count in groups.most_common()]


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
