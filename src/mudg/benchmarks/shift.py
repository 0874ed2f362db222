"""``mudg bench shift``: whole methods beside the recorded path, on lists of generated logs, against exact truth.
Methods are fitted, rendered and scored by the ordinary verbs, so that whatever is finished is reused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from mudg.base import config as configuration
from mudg.base.html import markdown_table
from mudg.benchmarks.chain import compare, mean, refuse, seconds_of, standard_error, virtual_fits_of
from mudg.benchmarks.places import Views, listed_cities, score_settings
from mudg.benchmarks.rows import (
    BASE,
    DIFFUSION,
    FILL,
    FULL,
    RECORDED,
    Facts,
    PaperPlace,
    PaperTable,
    method_rows,
    settings_of,
)
from mudg.benchmarks.settings import BenchConfig
from mudg.city import logs as city_logs
from mudg.city.config import CityConfig
from mudg.city.logs import STANDARD
from mudg.steps.settings import PresetName

SHIFTED: Final = "shifted"
"""The mean over the lateral distances."""
COLUMNS: Final[dict[str, tuple[str, int]]] = {
    "psnr": ("PSNR dB", 2),
    "ssim": ("SSIM", 3),
    "perceptual": ("perceptual", 4),
    "abs_rel": ("AbsRel", 4),
    "rmse_m": ("RMSE m", 2),
    "delta1": ("delta1", 4),
    "miou": ("mIoU", 3),
    "flicker": ("flicker", 3),
    "psnr_movers": ("PSNR of dynamic objects", 2),
}
"""Metric -> heading, digits."""
RATIOS: Final = ("perceptual", "abs_rel", "rmse_m", "flicker")
"""Metrics whose comparison is a ratio (a / b); of the others it is a difference (a - b)."""
COMPARISONS: Final = (
    (FULL, BASE, SHIFTED, "psnr ssim perceptual abs_rel rmse_m delta1 miou flicker psnr_movers"),
    (FULL, DIFFUSION, SHIFTED, "psnr perceptual abs_rel miou flicker"),
    (FULL, BASE, RECORDED, "psnr ssim perceptual abs_rel miou"),
    (BASE, "gs3d", RECORDED, "psnr psnr_movers"),
    (BASE, "gs3d", SHIFTED, "psnr psnr_movers"),
    (FULL, FILL, SHIFTED, "psnr perceptual abs_rel miou"),
    (DIFFUSION, FILL, SHIFTED, "psnr perceptual abs_rel miou"),
)
"""A method, that against which it is held, a place, and metrics."""
SHOWN: Final = (FILL, "gs3d", BASE, DIFFUSION, FULL)
"""Methods in the videos."""


class ShiftLog(Views):
    """One log of the list."""

    def measure(self) -> dict[str, Any]:
        """Facts of the log, scores of each method by distance, and seconds of each step."""
        views, values = self.of_rows(), {}
        for name, folders in views.items():
            (metrics,) = self.scores(name, folders).values()
            values[name] = {f"{entry['distance_m']:g}": entry["values"] for entry in metrics["by_distance"]}
        self.film({name: folders for name, folders in views.items() if name in SHOWN})
        facts = {"log": int(self.log.name), **city_logs.facts(self.city)}
        return {**facts, "values": values, "seconds": seconds_of(self.out)}


def run(
    config: BenchConfig,
    out: Path,
    *,
    preset: PresetName = "default",
    overwrite: bool = False,
    rules: CityConfig = STANDARD,
    distances_m: Sequence[float] = (2.0, 3.0, 4.0),
) -> Path:
    """Compare methods on the logs of a list; returns ``out`` with ``bench.json``, ``bench.md`` and ``page.html``; what
    lies there of the same settings is reused, and methods may be added later. ``preset``: what ``config``
    started from. ``overwrite``: replace what other settings left in ``out``. ``rules``: frames, size and cameras of the
    logs. ``distances_m``: lateral distances, each to both sides. UsageError: an unknown method, a setting
    that no row uses, or ``out`` holds logs of other settings. Whatever a verb raises."""
    rows, out = method_rows(config, preset), Path(out)
    refuse("shift", config, preset, rows, out)
    shifts = {RECORDED: [0.0], **{f"{d:g}": [d, -d] for d in distances_m}}
    places = [PaperPlace(name=name, title="", shifts_m=shifts_m) for name, shifts_m in shifts.items()]
    table = PaperTable(name="shift", places=places, columns=[])
    last = (config, score_settings(config, table), overwrite, "synthesize")
    logs = listed_cities(config.list, config.logs, rules)
    jobs = {log.name: ShiftLog(log, out / log.name, table, rows, *last, on_path=False).measure for log in logs}
    how = {"frames": rules.n_frames, "size_px": [rules.width, rules.height], "cameras": list(rules.cameras)}
    how |= {"held_out_every": table.held_out_every}
    settings = settings_of(config, preset, {"list": config.list}, how)
    fits = [None if row.fit is None else configuration.result_settings(row.fit) for row in rows]
    values = [{"name": row.name, "title": row.title, "fit": of} for row, of in zip(rows, fits, strict=True)]
    filled = lambda logs: document(logs, values, list(distances_m), settings)
    return compare(out, jobs, config, filled, markdown)


# ---- numbers ----


def document(
    logs: Sequence[Facts], rows: Sequence[Facts], distances_m: Sequence[float], settings: Facts
) -> dict[str, Any]:
    """Everything ``bench.json`` holds. ``logs``: per log its facts, ``values[method][distance][metric]`` (a number, or
    why there is none) and seconds. ``rows``: name, title and fit of each method. ``distances_m``: lateral shifts off
    the recorded path. ``settings``: of the bench."""
    shifted = [f"{d:g}" for d in sorted(distances_m)]
    full = [{**entry, "values": {m: with_mean(of, shifted) for m, of in entry["values"].items()}} for entry in logs]
    names = [row["name"] for row in rows]
    every = (RECORDED, *shifted, SHIFTED)
    of = lambda entry, name, p, m: entry["values"][name].get(p, {}).get(m, "not produced")
    at = lambda name, p: {m: _pooled([of(entry, name, p, m) for entry in full]) for m in COLUMNS}
    pooled = {name: {p: at(name, p) for p in every} for name in names}
    comparisons = [one for a, b, *of in COMPARISONS if {a, b} <= {*names} for one in against(full, a, b, *of)]
    head = {"schema": 1, "bench": "shift", "settings": dict(settings), "distances_m": list(distances_m)}
    head |= {"methods": [dict(r) for r in rows], "metrics": list(COLUMNS)}
    return {**head, "logs": full, "pooled": pooled, "comparisons": comparisons}


def with_mean(of: Mapping[str, Facts], shifted: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The values of one method and log by distance, with the mean over the distances off the recorded path."""
    means: dict[str, Any] = {}
    for metric in COLUMNS:
        values = [of.get(place, {}).get(metric, "not produced") for place in shifted] or ["not produced"]
        reasons = [value for value in values if isinstance(value, str)]
        means[metric] = reasons[0] if reasons else mean(values)
    return {**{place: dict(values) for place, values in of.items()}, SHIFTED: means}


def _pooled(values: Sequence[Any]) -> Any:
    """The mean over the logs that have a number, or the reason of the first log."""
    numbers = [float(value) for value in values if not isinstance(value, str)]
    if not numbers:
        return str(values[0])
    return {"mean": mean(numbers), "standard_error": standard_error(mean, numbers), "logs": len(numbers)}


def against(logs: Sequence[Facts], a: str, b: str, place: str, metrics: str) -> list[dict[str, Any]]:
    """Comparisons of two methods over the logs that have both numbers, one per metric: the difference of the means over
    logs, or their ratio; the standard error is the jackknife's over logs (for a difference: the spread of the
    differences of single logs over the root of their number), None with fewer than two logs."""
    comparisons = []
    for metric in metrics.split():
        pairs = [tuple(entry["values"].get(m, {}).get(place, {}).get(metric, "") for m in (a, b)) for entry in logs]
        known = [None if any(isinstance(value, str) for value in pair) else tuple(map(float, pair)) for pair in pairs]
        both = [pair for pair in known if pair is not None]

        def of(pairs: Sequence[tuple[float, float]], ratio: bool = metric in RATIOS) -> float | None:
            first, second = (mean(side) for side in zip(*pairs, strict=True))
            if not ratio:
                return first - second
            return first / second if second else None

        per_log = [None if pair is None else of([pair]) for pair in known]
        where = "recorded path" if place == RECORDED else "off the recorded path"
        kind, title = "ratio" if metric in RATIOS else "difference", f"{a} against {b}, {where}: {COLUMNS[metric][0]}"
        what = {"title": title, "a": a, "b": b, "place": place, "metric": metric, "kind": kind}
        value = {"value": of(both) if both else None, "standard_error": standard_error(of, both), "logs": len(both)}
        each = [None if value is None else round(value, 5) for value in per_log]
        comparisons.append({**what, **value, "per_log": each})
    return comparisons


# ---- text ----


def markdown(doc: Facts) -> str:
    """The tables for people."""
    settings, logs, names = doc["settings"], doc["logs"], [row["name"] for row in doc["methods"]]
    size = "{}x{}".format(*settings["size_px"]) + f", {len(settings['cameras'])} cameras"
    facts = [
        [str(e["log"]), f"{e['turn_deg']:.1f}", f"{e['length_m']:.0f}", str(e["movers"]), f"{e['mover_share']:.1%}"]
        + [e["words"]]
        for e in logs
    ]
    lines = [
        f"# Off the recorded path: {len(logs)} log{'s' if len(logs) != 1 else ''} of the {settings['list']} list",
        "",
        f"{settings['frames']} frames at 10 Hz, {size}, every {settings['held_out_every']}th frame held out;"
        f" {settings['iterations']} iterations per fit, {virtual_fits_of(settings)}; seed {settings['seed']}. Means"
        " over both sides and all logs, +- the standard error over logs. Flicker: 1 = as steady as the truth."
        " Perceptual: features of the shipped codec, not LPIPS.",
        "",
        *markdown_table(
            ["log", "turn, degrees", "length, m", "dynamic vehicles in view", "their share of the image", "city"], facts
        ),
        "",
    ]
    headings, shifted = [heading for heading, _ in COLUMNS.values()], [f"{d:g}" for d in sorted(doc["distances_m"])]
    titles = {RECORDED: "Recorded path, held-out frames", **{d: f"{d} m to either side" for d in shifted}}
    for place, title in {**titles, SHIFTED: f"Mean over {', '.join(shifted)} m"}.items():
        rows = [[name, *_cells(doc["pooled"][name][place])] for name in names]
        lines += [f"## {title}", "", *markdown_table(["method", *headings], rows), ""]
    heads = ["", "value", "standard error", "as", "logs", "each log"]
    lines += ["## Comparisons", "", *markdown_table(heads, map(_compared, doc["comparisons"])), ""]
    rows = [[str(entry["log"]), name, *_cells(entry["values"][name][SHIFTED])] for entry in logs for name in names]
    each = markdown_table(["log", "method", *headings], rows)
    return "\n".join([*lines, "## Each log, mean off the recorded path", "", *each, ""])


def _cells(values: Facts) -> list[str]:
    """Values by metric as text, of one log or pooled, with the standard error where it is known; or the reason for
    none."""
    cells = []
    for metric, (_, digits) in COLUMNS.items():
        value = values[metric]
        if isinstance(value, Mapping):
            error = value["standard_error"]
            cells.append(f"{value['mean']:.{digits}f}" + ("" if error is None else f" +- {error:.{digits}f}"))
        else:
            cells.append(value if isinstance(value, str) else f"{value:.{digits}f}")
    return cells


def _compared(row: Facts) -> list[str]:
    """A comparison's line."""
    is_difference, error, value = row["kind"] == "difference", row["standard_error"], row["value"]
    digits, sign = (COLUMNS[row["metric"]][1], "+") if is_difference else (3, "")
    texts = ["no number", ""]
    if value is not None:
        texts = [f"{value:{sign}.{digits}f}", "-" if error is None else f"{error:.{digits}f}"]
    each = " ".join("-" if one is None else f"{one:.3g}" for one in row["per_log"])
    return [row["title"], *texts, row["kind"], str(row["logs"]), each]
