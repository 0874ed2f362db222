"""What a batch took and is going to take: core-hours and bytes by step, times prices."""

from __future__ import annotations

from typing import Any

from mudg.base.memory import in_words
from mudg.stages.batches.status import BatchStatus

_GB = 1e9


def costs_of(state: BatchStatus, price: float, storage_price: float) -> dict[str, Any]:
    """Cost by step.

    Args:
        price: of a core-hour. storage_price: of a gigabyte for a month.

    Returns:
        ``stages`` -> core-hours, lost core-hours (attempts that were tried again), bytes, money and the forecast of each; and ``total``.
    """
    stages: dict[str, dict[str, float]] = {}
    for name, one in state.stages.items():
        hours, lost = one.processor_s / 3600, one.wasted_s / 3600
        size = one.written_bytes / _GB
        done = max(one.known, 1)
        per_scene = (hours + lost) / done if one.known else 0.0
        left = max(0, state.entering(name) - one.done - one.failed - one.rejected)
        money = (hours + lost) * price + size * storage_price
        stages[name] = {
            "scenes": one.known, "core_hours": round(hours, 4), "lost_hours": round(lost, 4), "gigabytes": round(size, 4),
            "money": round(money, 4), "core_hours_per_scene": round(per_scene, 6), "left": left,
            "core_hours_left": round(per_scene * left, 4),
            "money_left": round((per_scene * price + size / done * storage_price) * left, 4),
        }  # fmt: skip
    total = {
        name: round(sum(one[name] for one in stages.values()), 4)
        for name in ("core_hours", "lost_hours", "gigabytes", "money", "core_hours_left", "money_left")
    }
    return {"stages": stages, "total": total, "price": price, "storage_price": storage_price}


def text_of(found: dict[str, Any]) -> str:
    """The costs as a table."""
    heads = f"{'scenes':>8}{'core-hours':>12}{'lost':>9}{'written':>12}{'cost':>11}{'left':>8}"
    lines = [f"  {'step':<12}{heads}{'core-hours left':>17}{'cost left':>12}"]
    for name, one in {**found["stages"], "total": {"scenes": "", "left": "", **found["total"]}}.items():
        size = in_words(int(one["gigabytes"] * _GB))
        lines.append(
            f"  {name:<12}{one['scenes']:>8}{one['core_hours']:12.3f}{one['lost_hours']:9.3f}{size:>12}"
            f"{one['money']:11.2f}{one['left']:>8}{one['core_hours_left']:17.3f}{one['money_left']:12.2f}"
        )
    if not found["price"]:
        lines.append("give --price per core-hour, and --storage-price per gigabyte and month, for costs in money")
    return "\n".join(lines)
