"""Numbers of ``mudg bench shift``: pooled over logs, compared with standard errors, as JSON values and as Markdown. No torch."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from mudg.report.score_tables import markdown_table

RECORDED: Final = "0"
SHIFTED: Final = "shifted"
"""The mean over the lateral distances."""
COLUMNS: Final[tuple[tuple[str, str, int], ...]] = (
    ("psnr", "PSNR dB", 2), ("ssim", "SSIM", 3), ("perceptual", "perceptual", 4), ("abs_rel", "AbsRel", 4), ("rmse_m", "RMSE m", 2),
    ("delta1", "delta1", 4), ("miou", "mIoU", 3), ("flicker", "flicker", 3), ("psnr_movers", "PSNR of dynamic objects", 2),
)  # fmt: skip
"""Metric, heading, digits."""


RATIOS: Final = ("perceptual", "abs_rel", "rmse_m", "flicker")
"""Metrics whose comparison is a ratio; of the others it is a difference."""


@dataclass(frozen=True)
class Comparison:
    """A line of the table of comparisons: ``a`` against ``b`` in one metric, as a difference (a - b) or a ratio (a / b)."""

    title: str
    a: str
    b: str
    place: str
    metric: str
    kind: Literal["difference", "ratio"]


def _against(a: str, b: str, place: str, metrics: str) -> tuple[Comparison, ...]:
    where = "recorded path" if place == RECORDED else "off the recorded path"
    titles = {name: heading for name, heading, _ in COLUMNS}
    return tuple(
        Comparison(f"{a} against {b}, {where}: {titles[m]}", a, b, place, m, "ratio" if m in RATIOS else "difference")
        for m in metrics.split()
    )


COMPARISONS: Final[tuple[Comparison, ...]] = (
    *_against("mudg_s", "street_gaussians", SHIFTED, "psnr ssim perceptual abs_rel rmse_m delta1 miou"),
    *_against("mudg_s", "street_gaussians", SHIFTED, "flicker psnr_movers"),
    *_against("mudg_s", "mudg_r", SHIFTED, "psnr perceptual abs_rel miou flicker"),
    *_against("mudg_s", "street_gaussians", RECORDED, "psnr ssim perceptual abs_rel miou"),
    *_against("street_gaussians", "gs3d", RECORDED, "psnr psnr_movers"),
    *_against("street_gaussians", "gs3d", SHIFTED, "psnr psnr_movers"),
    *_against("mudg_s", "nearest_fill", SHIFTED, "psnr perceptual abs_rel miou"),
    *_against("mudg_r", "nearest_fill", SHIFTED, "psnr perceptual abs_rel miou"),
)  # fmt: skip
ABLATION_ROWS: Final = (
    ("street_gaussians", "none"), ("only_I", "+ I"), ("only_I_D", "+ I + D"), ("only_I_S", "+ I + S"), ("mudg_s", "+ I + D + S"),
    ("exact", "exact views"),
)  # fmt: skip


def document(
    logs: Sequence[Mapping[str, Any]],
    rows: Sequence[Mapping[str, Any]],
    distances_m: Sequence[float],
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """Everything ``bench.json`` holds.

    Args:
        logs: per log its facts, ``values[method][distance][metric]`` (a number, or why there is none) and seconds.
        rows: name, title and fit of each method. distances_m: lateral shifts off the recorded path. settings: of the bench.
    """
    places = [RECORDED, *(f"{d:g}" for d in sorted(distances_m))]
    full = [{**entry, "values": {m: _with_mean(of, places[1:]) for m, of in entry["values"].items()}} for entry in logs]
    everywhere = [*places, SHIFTED]
    pooled = {
        r["name"]: {p: {m: _pooled(full, r["name"], p, m) for m, _, _ in COLUMNS} for p in everywhere} for r in rows
    }
    names = {r["name"] for r in rows}
    return {
        "schema": 1, "settings": dict(settings), "distances_m": list(distances_m), "methods": [dict(r) for r in rows],
        "metrics": [name for name, _, _ in COLUMNS], "logs": full, "pooled": pooled,
        "comparisons": [compare(full, c) for c in COMPARISONS if {c.a, c.b} <= names],
        "variants": [
            {"name": r["name"], "against_mudg_s": [
                compare(full, c) for place in (SHIFTED, RECORDED)
                for c in _against(r["name"], "mudg_s", place, "psnr perceptual abs_rel miou")
            ]}
            for r in rows if "mudg_s" in names and r["fit"] is not None and r["name"] not in ("gs3d", "street_gaussians", "mudg_s")
        ],
    }  # fmt: skip


def _with_mean(of: Mapping[str, Mapping[str, Any]], shifted: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The values of one method and log with the mean over the distances off the recorded path."""
    mean: dict[str, Any] = {}
    for metric, _, _ in COLUMNS:
        values = [of.get(place, {}).get(metric, "not produced") for place in shifted]
        numbers = [v for v in values if not isinstance(v, str)]
        mean[metric] = sum(numbers) / len(numbers) if numbers and len(numbers) == len(values) else next(
            (v for v in values if isinstance(v, str)), "not produced")  # fmt: skip
    return {**{place: dict(values) for place, values in of.items()}, SHIFTED: mean}


def value_at(entry: Mapping[str, Any], method: str, place: str, metric: str) -> float | None:
    """One number of one log, or None."""
    found = entry["values"].get(method, {}).get(place, {}).get(metric)
    return None if found is None or isinstance(found, str) else float(found)


def _pooled(logs: Sequence[Mapping[str, Any]], method: str, place: str, metric: str) -> dict[str, Any] | str:
    """Mean over logs with its standard error, or why there is none."""
    numbers = [v for v in (value_at(entry, method, place, metric) for entry in logs) if v is not None]
    if not numbers:
        reasons = [entry["values"].get(method, {}).get(place, {}).get(metric, "not produced") for entry in logs]
        return str(reasons[0])
    return {"mean": _mean(numbers), "standard_error": standard_error(_mean, numbers), "logs": len(numbers)}


def compare(logs: Sequence[Mapping[str, Any]], what: Comparison) -> dict[str, Any]:
    """A comparison over the logs that have both numbers.

    The difference of the means over logs, or their ratio; the standard error is the jackknife's over logs (for a difference:
    the spread of the differences of single logs over the root of their number). None with fewer than two logs.
    """
    pairs = [(value_at(e, what.a, what.place, what.metric), value_at(e, what.b, what.place, what.metric)) for e in logs]
    both = [(a, b) for a, b in pairs if a is not None and b is not None]
    of = _ratio_of_means if what.kind == "ratio" else _difference_of_means
    per_log = [None if a is None or b is None else of([(a, b)]) for a, b in pairs]
    return {
        "title": what.title, "a": what.a, "b": what.b, "place": what.place, "metric": what.metric, "kind": what.kind,
        "value": of(both) if both else None, "standard_error": standard_error(of, both), "logs": len(both),
        "per_log": [None if v is None else round(v, 5) for v in per_log],
    }  # fmt: skip


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _difference_of_means(pairs: Sequence[tuple[float, float]]) -> float:
    return _mean([a for a, _ in pairs]) - _mean([b for _, b in pairs])


def _ratio_of_means(pairs: Sequence[tuple[float, float]]) -> float | None:
    below = _mean([b for _, b in pairs])
    return _mean([a for a, _ in pairs]) / below if below else None


def standard_error(of: Callable[[Sequence[Any]], float | None], items: Sequence[Any]) -> float | None:
    """Standard error of a statistic of independent items by leaving out each in turn; None for fewer than two items."""
    count = len(items)
    if count < 2:
        return None
    left = [of([*items[:i], *items[i + 1 :]]) for i in range(count)]
    known = [v for v in left if v is not None]
    if len(known) < count:
        return None
    center = _mean(known)
    return math.sqrt((count - 1) / count * sum((v - center) ** 2 for v in known))


# ---- text ----


def virtual_fits_of(settings: Mapping[str, Any]) -> str:
    """How many iterations fits under virtual views have, as part of a sentence."""
    share = settings["continued_share"]
    more = "under virtual views {:g} times as many more after the fit on recorded views"
    return more.format(share) if share else "those under virtual views too, from nothing"


def further_of(settings: Mapping[str, Any]) -> str:
    """What fits under virtual views do, as part of a sentence."""
    seen = " with renders of the fit on recorded views" if settings["renders"] else " without renders"
    return f"{virtual_fits_of(settings)}; generated{seen}"


def markdown(doc: Mapping[str, Any]) -> str:
    """The tables for people."""
    settings = doc["settings"]
    width, height = settings["size_px"]
    lines = [
        f"# Off the recorded path: {logs_text(doc)} of the {settings['list']} list", "",
        f"{settings['frames']} frames at 10 Hz, {width}x{height}, {len(settings['cameras'])} cameras, every {settings['held_out_every']}th "
        f"frame held out; {settings['iterations']} iterations per fit, {further_of(settings)}; seed {settings['seed']}. Means over both "
        "sides and all logs, +- the standard error over logs. Flicker: 1 = as steady as the truth. Perceptual: features of the shipped "
        "codec, not LPIPS.", "",
        *markdown_table(FACTS, [facts_of(entry) for entry in doc["logs"]]), "",
    ]  # fmt: skip
    headings = [heading for _, heading, _ in COLUMNS]
    for place in places_of(doc):
        rows = [[row["name"], *score_cells(doc, row["name"], place)] for row in doc["methods"]]
        lines += [f"## {place_title(doc, place)}", "", *markdown_table(["method", *headings], rows), ""]
    lines += ["## Comparisons", "", *_comparison_table(doc["comparisons"]), ""]
    if any(r["name"] == "only_I" for r in doc["methods"]):
        lines += ["## Which virtual term does what", "", *_ablation_table(doc), ""]
    for variant in doc["variants"]:
        lines += [f"## {variant['name']} against mudg_s", "", *_comparison_table(variant["against_mudg_s"]), ""]
    lines += [
        "## Each log, mean off the recorded path",
        "",
        *_log_table(doc),
        "",
        "## Seconds per log",
        "",
        *_seconds_table(doc),
        "",
    ]
    return "\n".join(lines)


def places_of(doc: Mapping[str, Any]) -> list[str]:
    """The recorded path, the distances from it, and their mean."""
    return [RECORDED, *(f"{d:g}" for d in sorted(doc["distances_m"])), SHIFTED]


def logs_text(doc: Mapping[str, Any]) -> str:
    """How many logs, as text."""
    count = len(doc["logs"])
    return f"{count} log{'s' if count != 1 else ''}"


def place_title(doc: Mapping[str, Any], place: str) -> str:
    """Heading of a distance."""
    if place == RECORDED:
        return "Recorded path, held-out frames"
    if place == SHIFTED:
        return "Mean over " + ", ".join(f"{d:g}" for d in sorted(doc["distances_m"])) + " m"
    return f"{place} m to either side"


def number(found: Any, digits: int, with_error: bool = False) -> str:
    """A pooled value as text: the mean, with its standard error where that is wanted and known, or the reason for none."""
    if isinstance(found, str):
        return found
    error = found["standard_error"]
    return f"{found['mean']:.{digits}f}" + (f" +- {error:.{digits}f}" if with_error and error is not None else "")


def score_cells(doc: Mapping[str, Any], method: str, place: str, with_error: bool = False) -> list[str]:
    """A method's pooled values at a distance, one per row of ``COLUMNS``."""
    return [number(doc["pooled"][method][place][m], digits, with_error) for m, _, digits in COLUMNS]


FACTS: Final = ("log", "turn, degrees", "length, m", "dynamic vehicles in view", "their share of the image", "city")


def facts_of(entry: Mapping[str, Any]) -> list[str]:
    """Cells of a log's row under ``FACTS``."""
    return [
        str(entry["log"]), f"{entry['turn_deg']:.1f}", f"{entry['length_m']:.0f}", str(entry["movers"]),
        f"{entry['mover_share']:.1%}", entry["words"],
    ]  # fmt: skip


def compared_text(found: Mapping[str, Any]) -> tuple[str, str]:
    """A comparison's value and standard error as text."""
    digits = {name: digits for name, _, digits in COLUMNS}[found["metric"]] if found["kind"] == "difference" else 3
    error = found["standard_error"]
    if found["value"] is None:
        return "no number", ""
    sign = "+" if found["kind"] == "difference" else ""
    return f"{found['value']:{sign}.{digits}f}", "-" if error is None else f"{error:.{digits}f}"


def _comparison_table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    cells = []
    for found in rows:
        each = " ".join("-" if v is None else f"{v:.3g}" for v in found["per_log"])
        cells.append([found["title"], *compared_text(found), found["kind"], str(found["logs"]), each])
    return markdown_table(["", "value", "standard error", "as", "logs", "each log"], cells)


def _ablation_table(doc: Mapping[str, Any]) -> list[str]:
    metrics = ("psnr", "ssim", "perceptual", "abs_rel", "delta1", "miou")
    chosen = [column for column in COLUMNS if column[0] in metrics]
    rows = [
        [title, *(number(doc["pooled"][name][SHIFTED][m], digits, with_error=True) for m, _, digits in chosen)]
        for name, title in ABLATION_ROWS
    ]
    return markdown_table(["virtual terms", *(heading for _, heading, _ in chosen)], rows)


def _log_table(doc: Mapping[str, Any]) -> list[str]:
    rows = []
    for entry in doc["logs"]:
        for row in doc["methods"]:
            values = entry["values"][row["name"]][SHIFTED]
            cells = (v if isinstance(v := values[m], str) else f"{v:.{digits}f}" for m, _, digits in COLUMNS)
            rows.append([str(entry["log"]), row["name"], *cells])
    return markdown_table(["log", "method", *(heading for _, heading, _ in COLUMNS)], rows)


def _seconds_table(doc: Mapping[str, Any]) -> list[str]:
    steps = dict.fromkeys(step for entry in doc["logs"] for step in entry["seconds"])
    rows = [[step, *(f"{entry['seconds'].get(step, math.nan):.0f}" for entry in doc["logs"])] for step in steps]
    return markdown_table(["step", *(str(entry["log"]) for entry in doc["logs"])], rows)
