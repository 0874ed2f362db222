"""The report: one self-contained page of a finished run, without a network, by double click. Each trajectory becomes
one H.264 video that holds all panels (columns: truth and methods; rows: colour, depth, classes, colour error), so that
they never run apart; the page cuts them out of it."""

from __future__ import annotations

import base64
import json
import math
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg import native
from mudg.base import html, log, memory, store
from mudg.base.errors import InputError
from mudg.base.html import SENSES
from mudg.base.processes import computed_ahead
from mudg.base.records import understood
from mudg.base.types import Observation
from mudg.core.pictures import class_colors, depth_colors, error_image, resize_nearest, resize_rgb, to_bytes
from mudg.formats.exporters.video import jpeg_bytes, mp4_within, video_encoders
from mudg.scene.observations import ObservationSet, list_observation_sets, read_observations
from mudg.scoring.tables import (
    FLOOR,
    NOT_COMPUTED,
    SET_METRICS,
    WEIGHT_FLAGS,
    best_of,
    distance_title,
    floors_by_distance,
    number_text,
    title_of,
    values_by_distance,
)

# -- command lines: what to do with a run next ------------------------------------------------------

GUIDED: Final = "fit/mudg_s"


def next_commands(out: Path) -> list[tuple[str, tuple[str, ...]]]:
    """What a run can be used for, as (title, lines). Each block works by itself, in the folder from which the run was
    started."""
    run = str(out)
    try:  # an object that an edit script can name
        nodes = store.read_json(out / GUIDED / "model.json")["nodes"]
        movable = next((str(node["name"]) for node in nodes if "label" in node), "")
    except (InputError, KeyError, TypeError):
        movable = ""
    edit = f"- remove: {{ids: [{json.dumps(movable)}]}}" if movable else "- weather: {fog: {visibility_m: 60}}"
    changes = [
        [f"printf '%s\\n' {shlex.quote(edit)} > edits.yaml"],
        ["edit", run, "edits.yaml", "--out", f"{run}_edited"],
        ["view", run, "--edits", "edits.yaml"],
    ]
    files = [["export", kind, run, "--out", f"{run}.{kind}"] for kind in ("ply", "usdz")]
    if movable:
        files.append(["asset", "export", run, movable, "--out", f"{run}_object.safetensors"])
    views = ["render", run, "--shifts-m", "1.5", "--out", f"{run}_views"]
    blocks = [
        ("Fly through the scene in a browser; the second line compares both fits", [["view", run], ["view", run, run]]),
        ("One page to send to others", [["page", run, "--out", f"{run}.html"]]),
        ("Change the drive, and look at it", changes),
        ("Pictures, depth and classes of another path", [views]),
        ("Files for other programs (docs: export)", files),
        (
            "Labelled images beside the path, to train on",
            [["dataset", "coco", run, "--shifts-m", "0", "2", "--out", f"{run}_coco"]],
        ),
        ("The same on your own log", [["run", "LOG", "--out", "runs/mine"]]),
    ]
    line = lambda words: words[0] if len(words) == 1 else f"mudg {shlex.join(words)}"
    return [(title, tuple(map(line, lines))) for title, lines in blocks]


# -- the page: what ``templates/report.html.j2`` shows, worked out from plain values ---------------
GROUPS: Final = (
    ("Colour", ("psnr", "ssim", "perceptual")),
    ("Motion", ("psnr_movers", "flicker")),
    ("Depth", ("abs_rel", "rmse_m", "delta1")),
    ("Classes", ("miou", "accuracy")),
    ("At LiDAR points", ("lidar_abs_rel", "lidar_rmse_m", "lidar_delta1", "lidar_psnr", "agreement")),
    ("Vehicles and lanes", ("agent_iou", "lane_iou", "lane_correlation", "lane_psnr", "nta_iou", "ntl_iou")),
    ("Steadiness", ("warp_error", "temporal_flickering")),
)
OPTIONAL: Final = frozenset({"At LiDAR points", "Vehicles and lanes", "Steadiness"})
"""Groups that are left out, and distances of them, where no method has a number."""
CHARTED: Final = ("psnr", "abs_rel", "miou")
CURVES: Final = (("psnr", "PSNR, dB", SENSES["higher"]), ("loss_color", "Loss of colour", SENSES["lower"]))
"""Columns of the logs of fits that are drawn: title, and which way is better."""
FIRST_M: Final = 2.0
"""The page begins beside the recorded path, as near to here as there are views."""
NEAR_M: Final = 2.0
FAR_M: Final = 80.0
WITH: Final = "mudg_s"
WITHOUT: Final = "street_gaussians"
FPS: Final = 10
PANEL_ROWS: Final = (("rgb", "Colour"), ("depth", "Depth"), ("semantics", "Classes"), ("error", "Colour error"))
"""Rows of a video, and their titles."""


@dataclass(frozen=True)
class TrajectoryVideo:
    """The video of one trajectory. ``name``, ``camera``, ``shift_m``: as in the scores. ``width``, ``height``: of one
    panel, pixels. ``frames``: number of pictures. ``panels``: column name -> rows it has. ``video``, ``poster``: data
    URIs (video may be empty: no encoder)."""

    name: str
    camera: str
    shift_m: float | None
    width: int
    height: int
    frames: int
    panels: Mapping[str, Sequence[str]]
    video: str
    poster: str

    @property
    def place(self) -> str:
        """Where the trajectory runs, for people."""
        if self.shift_m is None:
            return self.name
        side = "left" if self.shift_m > 0 else "right"
        return f"{abs(self.shift_m):g} m {side}" if self.shift_m else "recorded path"


def page(
    scores: Mapping[str, Any],
    ledger: Mapping[str, Any],
    settings: str,
    videos: Sequence[TrajectoryVideo],
    columns: Sequence[str],
    viewer: str = "",
    out: Path = Path(),
    curves: Sequence[Mapping[str, Any]] = (),
) -> str:
    """The text of the page. ``scores``: ``metrics.json``. ``ledger``: ``run.json`` of the chain. ``settings``:
    ``run.yaml``. ``videos``: one per trajectory. ``columns``: panel columns in the order in which they stand in the
    videos. ``viewer``: relative address of the page that shows the fitted scene, or empty. ``out``: folder of the run,
    for commands. ``curves``: as of ``fit_charts``."""
    scene = scores["scene"]
    heading, lead = headline(scores)
    return html.render(
        "report.html.j2",
        title=f"{scene['id']}: mudg report",
        kicker=f"mudg report, {scene['id']} ({scene['dataset']})",
        heading=heading,
        lead=lead,
        scene=scene,
        viewer=viewer,
        facts=_facts(scores, ledger),
        rules=scores["rules"],
        methods=scores["methods"],
        settings=settings,
        provenance=_provenance(scores, ledger),
        curves=curves,
        next_commands=next_commands(out),
        **_player_values(scores, videos, columns),
        **_score_values(scores),
        **_time_values(ledger),
    )


# ---- text at the top ----


def headline(scores: Mapping[str, Any]) -> tuple[str, str]:
    """Headline and one paragraph that say what the numbers say, also when diffusion did not help."""
    values = values_by_distance(scores)
    shifted = sorted({d for m, d in values if d > 0 and m == WITH and isinstance(values[m, d].get("psnr"), float)})
    recorded = [values.get((method, 0.0), {}).get("psnr") for method in (WITH, WITHOUT)]
    held_out = ""
    if all(isinstance(value, float) for value in recorded):
        held_out = f"held-out frames score {recorded[0]:.1f} dB with diffusion and {recorded[1]:.1f} dB without."
    if not shifted:
        text = "There is no ground truth off the recorded path: views there are shown below, not scored."
        text += f" On the path, {held_out}" if held_out else ""
        return f"{scores['scene']['id']}: views off the recorded path", text
    far = shifted[-1]
    with_, without = values[WITH, far], values.get((WITHOUT, far), {})
    if not isinstance(without.get("psnr"), float):
        return f"{far:g} m off the recorded path", ""
    gain = with_["psnr"] - without["psnr"]
    verdict = f"diffusion {'adds' if gain > 0 else 'costs'} {abs(gain):.1f} dB"
    if abs(gain) < 0.05:
        verdict = "diffusion makes no difference to colour"
    sentences = [
        f"{distance_title(scores, far)} of the recorded path, colour reaches {with_['psnr']:.1f} dB against exact"
        f" ground truth ({without['psnr']:.1f} dB without diffusion)."
    ]
    for metric, text in (("abs_rel", "relative depth error"), ("miou", "class overlap (mIoU)")):
        if isinstance(with_.get(metric), float) and isinstance(without.get(metric), float):
            sentences.append(f"The {text} is {with_[metric]:.3f}, against {without[metric]:.3f} without.")
    if held_out:
        sentences.append(f"On the recorded path itself, {held_out}")
    return f"{far:g} m off the recorded path, {verdict}", " ".join(sentences)


def _facts(scores: Mapping[str, Any], ledger: Mapping[str, Any]) -> list[tuple[str, str]]:
    scene = scores["scene"]
    cameras = len(scene["cameras"])
    return [
        (f"{scene['frames']}", "recorded frames"),
        (f"{cameras}", "camera" if cameras == 1 else "cameras"),
        (f"{scene['tracks']}", "tracked objects"),
        (f"{sum(t['views'] for t in scores['trajectories'])}", "views rendered per method"),
        (duration(sum(step["seconds"] for step in ledger.get("steps", {}).values())), "from log to this page"),
    ]


def duration(seconds: float) -> str:
    """Minutes and seconds in words."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


# ---- player ----


def _player_values(
    scores: Mapping[str, Any], videos: Sequence[TrajectoryVideo], columns: Sequence[str]
) -> dict[str, Any]:
    """What ``player.html.j2`` shows; ``player`` goes to ``player.js``."""
    exact = scores["truth"] == "exact"
    ordered = sorted(videos, key=lambda v: (v.camera, -(v.shift_m if v.shift_m is not None else -1e9)))
    beside = [v for v in videos if v.shift_m]
    first = min(beside, key=lambda v: abs((v.shift_m or 0.0) - FIRST_M), default=next(iter(videos), None))
    steps = np.geomspace(NEAR_M, FAR_M, 8).astype(np.float32)[None]
    stops = ", ".join("#{:02x}{:02x}{:02x}".format(*c) for c in depth_colors(steps, NEAR_M, FAR_M)[0])
    choice = lambda v: {"camera": v.camera, "name": v.name, "title": v.place, "checked": v is first}
    trajectories = []
    for index, v in enumerate(videos):
        if v.video:
            size = {"width": v.width, "height": v.height, "frames": v.frames}
            where = {"index": index, "name": v.name, "camera": v.camera, "title": v.place}
            trajectories.append({**where, **size, "panels": {c: list(p) for c, p in v.panels.items()}})
    return {
        "exact": exact,
        "videos": [{"label": f"{v.camera}, {v.place}", "source": v.video, "poster": v.poster} for v in videos],
        "cameras": list(dict.fromkeys(v.camera for v in videos)),
        "shift_choices": list(map(choice, ordered)),
        "depth_scale": {"near": f"{NEAR_M:g}", "far": f"{FAR_M:g}", "stops": stops},
        "class_legend": html.class_legend(),
        "player": {
            "fps": FPS,
            "columns": list(columns),
            "rows": [{"name": name, "title": title} for name, title in PANEL_ROWS],
            "titles": {c: title_of(c) if exact or c != "truth" else "Recorded path" for c in columns},
            "trajectories": trajectories,
        },
    }


# ---- numbers ----


def _score_values(scores: Mapping[str, Any]) -> dict[str, Any]:
    """What ``scores.html.j2`` shows."""
    values = values_by_distance(scores)
    distances = sorted({d for m, d in values if any(isinstance(v, float) for v in values[m, d].values())})
    metrics = {m["name"]: m for m in scores["metrics"]}
    absent = [m for m in metrics.values() if all(r["values"].get(m["name"]) == NOT_COMPUTED for r in scores["results"])]
    flag = lambda m: f": mudg score {WEIGHT_FLAGS[m['name']]} FILE" if m["name"] in WEIGHT_FLAGS else ""
    remedy = lambda m: f"{m['needs'][-1]}{flag(m)}"
    main = [n for title, names in GROUPS if title not in OPTIONAL for n in names]
    sets = [name for name, entry in SET_METRICS.items() if entry in scores]
    distances = [d for d in distances if _shown(values, [*main, *sets], d)]
    groups = []
    for title, names in GROUPS:
        there = distances
        if title in OPTIONAL:
            names = [n for n in names if any(isinstance(of.get(n), float) for of in values.values())]
            there = [d for d in sorted({d for _, d in values}) if _shown(values, names, d)]
        if there:
            groups.append(_score_group(scores, title, [metrics[n] for n in names if n in metrics], there))
    made_of_sets = [metrics[name] for name, entry in SET_METRICS.items() if entry in scores]
    if made_of_sets:
        group, floors = _score_group(scores, "Distribution", made_of_sets, distances), floors_by_distance(scores)
        true = [(m["name"], floors.get(distance, {}).get(m["name"])) for distance in distances for m in made_of_sets]
        cells = [{"text": number_text(name, value), "classes": ""} for name, value in true]
        group["rows"].append({"method": "truth", "title": FLOOR, "cells": cells})  # what the truth itself scores
        groups.append(group)
    has_number = lambda name: any(isinstance(r["values"].get(name), float) for r in scores["results"])
    numeric = [metric for metric in metrics.values() if has_number(metric["name"])]
    results = []
    for trajectory in scores["trajectories"]:
        for r in (r for r in scores["results"] if r["trajectory"] == trajectory["name"]):
            texts = [number_text(metric["name"], r["values"].get(metric["name"])) for metric in numeric]
            results.append([r["trajectory"], title_of(r["method"]), r["views"], *texts])
    return {
        "score_groups": groups if distances or any(group["title"] in OPTIONAL for group in groups) else [],
        "not_computed": ", ".join(f"{m['title']} ({remedy(m)})" for m in absent),
        "charts": [c for c in (_chart(scores, metrics[n]) for n in CHARTED if n in metrics) if c],
        "result_metrics": numeric,
        "results": results,
    }


def _shown(values: Mapping[tuple[str, float], Mapping[str, Any]], names: Sequence[str], distance: float) -> bool:
    """Whether some method has a number in one of these metrics at a distance."""
    return any(isinstance(of.get(name), float) for (_, d), of in values.items() if d == distance for name in names)


def _score_group(
    scores: Mapping[str, Any], title: str, metrics: Sequence[Mapping[str, Any]], distances: Sequence[float]
) -> dict[str, Any]:
    """One table: the metrics of a group at every distance."""
    values, methods = values_by_distance(scores), [m["name"] for m in scores["methods"]]

    def cells(method: str) -> Iterator[dict[str, str]]:
        for distance in distances:
            for number, metric in enumerate(metrics):
                across = {m: values.get((m, distance), {}).get(metric["name"]) for m in methods}
                is_best = method in best_of(metric["better"], across, metric["name"])
                absent = isinstance(across[method], str)
                classes = ["edge"] * (number == 0) + ["best"] * is_best + ["absent"] * absent
                yield {"text": number_text(metric["name"], across[method]), "classes": " ".join(classes)}

    rows = [{"method": m["name"], "title": m["title"], "cells": list(cells(m["name"]))} for m in scores["methods"]]
    titles = [distance_title(scores, distance) for distance in distances]
    return {"title": title, "distances": titles, "metrics": metrics, "rows": rows}


def chart_points(scores: Mapping[str, Any], metric: str) -> dict[str, list[tuple[float, float]]]:
    """Method -> (shift in metres, mean value over cameras), left of the road first."""
    shifts = {t["name"]: t["shift_m"] for t in scores["trajectories"] if t["shift_m"] is not None}
    points: dict[str, list[tuple[float, float]]] = {}
    for method in scores["methods"]:
        found: dict[float, list[float]] = {}
        for r in scores["results"]:
            value = r["values"].get(metric)
            if r["method"] == method["name"] and r["trajectory"] in shifts and isinstance(value, float):
                found.setdefault(float(shifts[r["trajectory"]]), []).append(value)
        if found:
            points[method["name"]] = [(s, sum(v) / len(v)) for s, v in sorted(found.items(), reverse=True)]
    return points


def axis_ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers that enclose all values, at even distances."""
    span = (high - low) or abs(high) or 1.0
    power = 10.0 ** math.floor(math.log10(span / 3))
    step = next(power * k for k in (1, 2, 2.5, 5, 10) if span / (power * k) <= 4)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [i * step for i in range(first, max(last, first + 2) + 1)]


def _chart(scores: Mapping[str, Any], metric: Mapping[str, Any]) -> dict[str, Any] | None:
    """Values of the macro ``chart``: one line per method over the lateral shift, left of the road on the left; None
    with fewer than two shifts."""
    points = chart_points(scores, metric["name"])
    shifts = {s for line in points.values() for s, _ in line}
    if len(shifts) < 2:
        return None
    lines = {method: [(-shift, value) for shift, value in line] for method, line in points.items()}
    better = SENSES[metric["better"]]
    figure = _figure(lines, sorted(-shift for shift in shifts), lambda value: number_text(metric["name"], value))
    return {
        **figure,
        "title": metric["title"] + (f", {metric['unit']}" if metric["unit"] else ""),
        "better": better,
        "label": f"{metric['title']} over the lateral shift, {better}",
        "begin": "left" if max(shifts) > 0 else "",
        "end": "right, m" if min(shifts) < 0 else "m",
    }


def fit_charts(out: Path) -> list[dict[str, Any]]:
    """Values of the macro ``chart``: what the fits of a run logged of recorded views, over their steps; empty where
    there is no log."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for method in (WITHOUT, WITH):
        path = out / "fit" / method / "log.jsonl"
        if path.is_file():
            found = (store.parse_json(line, str(path)) for line in store.read_text(path).splitlines())
            rows[method] = [row for row in found if "step" in row]
    made = []
    for key, title, better in CURVES:
        lines = {method: [(row["step"], row[key]) for row in own if key in row] for method, own in rows.items()}
        lines = {method: line for method, line in lines.items() if len(line) > 1}
        if lines:
            steps = axis_ticks(0, max(x for line in lines.values() for x, _ in line))
            figure = _figure(lines, steps, "{:g}".format)
            words = {"title": title, "better": better, "label": f"{title} over the steps of the fits, {better}"}
            made.append({**figure, **words, "begin": "", "end": "steps"})
    return made


def _figure(
    lines: Mapping[str, Sequence[tuple[float, float]]], marks: Sequence[float], text: Callable[[float], str]
) -> dict[str, Any]:
    """Places of lines and axes in a chart; ``marks``: of the axis below, increasing."""
    numbers = [value for line in lines.values() for _, value in line]
    ticks = axis_ticks(min(numbers), max(numbers))
    left, right, top, bottom = 40.0, 330.0, 8.0, 150.0
    x = lambda value: round(left + (value - marks[0]) / (marks[-1] - marks[0]) * (right - left), 1)
    y = lambda value: round(bottom - (value - ticks[0]) / (ticks[-1] - ticks[0]) * (bottom - top), 1)
    return {
        "left": left,
        "right": right,
        "bottom": bottom,
        "y_ticks": [{"at": y(value), "text": text(value)} for value in ticks],
        "x_ticks": [{"at": x(value), "text": f"{abs(value):g}"} for value in marks],
        "lines": [{"method": m, "points": [(x(a), y(b)) for a, b in line]} for m, line in lines.items()],
    }


# ---- times, settings ----


def _time_values(ledger: Mapping[str, Any]) -> dict[str, Any]:
    seconds = {name: step["seconds"] for name, step in ledger.get("steps", {}).items()}
    total, longest = sum(seconds.values()) or 1.0, max(seconds.values(), default=1.0) or 1.0
    size = lambda step, name: memory.in_words(step[name]) if step.get(name) else ""
    steps = [
        {
            "name": name,
            "seconds": step["seconds"],
            "processor_s": step.get("processor_s"),
            "memory": size(step, "peak_bytes"),
            "written": size(step, "written_bytes"),
            "share": step["seconds"] / total,
            "of_longest": step["seconds"] / longest,
        }
        for name, step in ledger.get("steps", {}).items()
    ]
    return {"steps": steps, "total_time": duration(total)}


def _provenance(scores: Mapping[str, Any], ledger: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What was run, on what and by what: rows that have a value."""
    environment, asked, scene = ledger.get("environment", {}), ledger.get("asked", {}), scores["scene"]
    sizes = ", ".join(f"{name} {w} x {h}" for name, (w, h) in scene["cameras"].items())
    seeds = {str(asked[verb]["seed"]) for verb in ("synthesize", "fit") if "seed" in asked.get(verb, {})}
    machine = [environment.get(key, "") for key in ("system", "machine", "cpu_count")]
    rows = [
        ("Input", str(asked.get("source", ""))),
        ("Scene", f"{scene['id']}: {scene['frames']} frames, {scene['held_out']} held out; cameras {sizes}"),
        ("Seed", ", ".join(sorted(seeds))),
        ("Diffusion model", str(asked.get("synthesize", {}).get("model", "")).replace("embedded", "shipped with mudg")),
        ("Licence of the data", scene["licence"]),
        ("Ground truth", "exact at any view" if scores["truth"] == "exact" else "recorded held-out frames only"),
        ("Program", f"mudg {environment.get('mudg', '')}, Python {environment.get('python', '')}"),
        ("Machine", f"{machine[0]} {machine[1]}, {machine[2]} processors"),
        ("Packages", ", ".join(f"{name} {version}" for name, version in environment.get("packages", {}).items())),
        ("Hashes (SHA-256)", ", ".join(f"{name} {digest[:16]}" for name, digest in ledger.get("digests", {}).items())),
    ]
    return [(name, value) for name, value in rows if value]


# -- panels of a video: several methods' views of one moment side by side, one row per modality ----
PANEL_WIDTH: Final = 320
BLANK: Final = 24
"""Grey value of a panel that a method does not produce."""


def panel_size(camera_width: int, camera_height: int) -> tuple[int, int]:
    """Width and height of a panel, both even: at most `PANEL_WIDTH`, in the camera's proportions."""
    width = min(PANEL_WIDTH, camera_width) // 2 * 2
    return width, max(2, round(camera_height * width / camera_width) // 2 * 2)


def panel_grid(
    views: Mapping[str, Observation | None], rows: Sequence[str], size: tuple[int, int], truth: Observation | None
) -> NDArray[np.uint8]:
    """One picture u8[rows * height, columns * width, 3] of one moment; what a method lacks stays grey. ``views``:
    column -> what it shows. ``rows``: of ``rgb``, ``depth``, ``semantics``, ``error``. ``size``: width and height of a
    panel, pixels. ``truth``: what colour errors are measured against; its own column has none."""
    width, height = size
    grid = np.full((height * len(rows), width * len(views), 3), BLANK, np.uint8)
    true_rgb = None if truth is None else resize_rgb(truth.rgb, height, width).clamp(0, 1)
    for x, seen in enumerate(views.values()):
        if seen is None:
            continue
        rgb = resize_rgb(seen.rgb, height, width)
        pictures: dict[str, NDArray[np.uint8]] = {"rgb": to_bytes(rgb)}
        if seen.depth is not None:
            pictures["depth"] = depth_colors(resize_nearest(seen.depth, height, width)[0].numpy(), NEAR_M, FAR_M)
        if seen.semantics is not None:
            pictures["semantics"] = class_colors(resize_nearest(seen.semantics, height, width).numpy())
        if true_rgb is not None and seen is not truth:
            pictures["error"] = error_image(rgb, true_rgb)
        for y, row in enumerate(rows):
            if row in pictures:
                grid[y * height : (y + 1) * height, x * width : (x + 1) * width] = pictures[row]
    return grid


# -- the report of a run ---------------------------------------------------------------------------
BUDGET_BYTES: Final = 9 * 2**19
"""For all videos together, before base64; with the posters the page stays under 8 MB."""
VIEWER: Final = "viewer.html"
VIEWER_FOLDER: Final = "viewer_page/index.html"
SAME_TIME_S: Final = 1e-4
ROWS: Final = tuple(name for name, _ in PANEL_ROWS)
QUALITY: Final = (33, 45)


@dataclass(frozen=True)
class Columns:
    """The observation sets of one trajectory, by column name, and which view of each stands at each frame. Truth and
    baseline have just the scored views; of the methods' views the scorer's indices pick the same. ``has_truth``: the
    column "truth" shows this very trajectory; else (a shifted view of a recorded log) the recorded path at the same
    moments."""

    sets: Mapping[str, ObservationSet]
    indices: Mapping[str, Sequence[int]]
    frames: int
    has_truth: bool

    @classmethod
    def of(cls, trajectory: Mapping[str, Any], folders: Mapping[str, Mapping[str, Path]]) -> Columns:
        """Those of a trajectory of the scores."""
        name, frames, picked = trajectory["name"], int(trajectory["views"]), trajectory["indices"]
        sets = {column: read_observations(found[name]) for column, found in folders.items() if name in found}
        indices: dict[str, Sequence[int]] = {c: picked[c] if c in picked else range(frames) for c in sets}
        has_truth = "truth" in sets
        recorded_folder = folders.get("truth", {}).get(f"{trajectory['camera']}_recorded")
        if not has_truth and recorded_folder is not None:
            recorded = read_observations(recorded_folder)
            column = next(iter(sets))
            wanted = np.array([sets[column].views[i].time_s for i in indices[column]])
            apart = np.abs(np.array([view.time_s for view in recorded.views])[None] - wanted[:, None])
            if apart.min(1).max() < SAME_TIME_S:
                sets = {"truth": recorded, **sets}
                indices["truth"] = apart.argmin(1).tolist()
        return cls(sets, indices, frames, has_truth)

    def rows(self, column: str) -> tuple[str, ...]:
        """The rows that a column has, as its first view says."""
        first = self.sets[column][self.indices[column][0]]
        has = {"rgb": True, "depth": first.depth is not None, "semantics": first.semantics is not None}
        has["error"] = self.has_truth and column != "truth"
        return tuple(row for row in ROWS if has[row])

    def pictures(self, order: Sequence[str], size: tuple[int, int], first: int = 0) -> Iterator[NDArray[np.uint8]]:
        """One picture per frame: columns in page order, rows of ``ROWS``; what a method does not produce stays grey."""
        for frame in range(first, self.frames):
            views = {c: self.sets[c][self.indices[c][frame]] if c in self.sets else None for c in order}
            yield panel_grid(views, ROWS, size, views["truth"] if self.has_truth else None)


def film(out: Path) -> list[TrajectoryVideo]:
    """The costly half of ``OUT/report.html``: one video per trajectory, from what the chain left in ``out`` (see
    ``steps.pipeline``). InputError: the run is not scored yet, or a folder of views is damaged."""
    out = Path(out)
    with understood("a scored run", str(out)):
        scores = store.read_json(out / "score" / "metrics.json")
        folders = _folders(out, scores)
        trajectories = [t for t in scores["trajectories"] if any(t["name"] in found for found in folders.values())]
    playable = bool(video_encoders())
    if not playable:
        log.warn("PyAV has no H.264 encoder here: the report shows one picture per trajectory instead of a video")
    budget = BUDGET_BYTES // max(1, len(trajectories)) if playable else 0
    threads = native.default_threads()
    videos = computed_ahead(lambda n: _video(trajectories[n], folders, budget), len(trajectories), threads)
    return list(log.progress(videos, len(trajectories), "report"))


def write_page(out: Path, videos: Sequence[TrajectoryVideo]) -> Path:
    """The cheap half: scores, times and settings around the videos, and a link to the viewer page if there is one."""
    out = Path(out)
    settings = out / "run.yaml"
    text = store.read_text(settings) if settings.is_file() else ""
    with understood("a scored run", str(out)):
        scores, ledger = store.read_json(out / "score" / "metrics.json"), store.read_json(out / "run.json")
        columns = list(_folders(out, scores))
        content = page(scores, ledger, text, videos, columns, viewer_address(out), out, fit_charts(out))
    store.write_text(out / "report.html", content)
    return out / "report.html"


def viewer_address(out: Path) -> str:
    """The viewer page of a run, relative to its folder: one file, or the first page of a folder; empty if there is
    none."""
    return next((name for name in (VIEWER, VIEWER_FOLDER) if (out / name).is_file()), "")


def _folders(out: Path, scores: Mapping[str, Any]) -> dict[str, dict[str, Path]]:
    """Column name -> trajectory -> folder, in the order of the page."""
    places = {"truth": out / "score" / "truth"}
    for method in scores["methods"]:
        name = method["name"]
        candidates = (out / "render" / name, out / "score" / name, out / "synthesize")
        places[name] = next(path for path in candidates if path.is_dir() or path.name == "synthesize")
    found = {name: list_observation_sets(path) for name, path in places.items()}
    return {name: sets for name, sets in found.items() if sets}


# ---- one trajectory as one video ----


def _video(trajectory: Mapping[str, Any], folders: Mapping[str, Mapping[str, Path]], budget: int) -> TrajectoryVideo:
    """All panels of a trajectory as one video of at most ``budget`` bytes; 0 = only the picture of its middle frame."""
    columns, order = Columns.of(trajectory, folders), list(folders)
    size = panel_size(int(trajectory["width"]), int(trajectory["height"]))
    video = mp4_within(lambda: columns.pictures(order, size), FPS, QUALITY, budget) if budget else b""
    poster = jpeg_bytes(next(columns.pictures(order, size, first=columns.frames // 2)), quality=60)
    return TrajectoryVideo(
        name=trajectory["name"],
        camera=str(trajectory["camera"]),
        shift_m=trajectory["shift_m"],
        width=size[0],
        height=size[1],
        frames=columns.frames,
        panels={column: columns.rows(column) for column in columns.sets},
        video=data_uri("video/mp4", video) if video else "",
        poster=data_uri("image/jpeg", poster),
    )


def data_uri(kind: str, content: bytes) -> str:
    """A file as an address that holds it."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
