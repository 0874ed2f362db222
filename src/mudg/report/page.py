"""The page of the report: plain templates over plain values; every text is escaped. No torch, no files but the assets."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from typing import Any, Final

import numpy as np

from mudg.base import palette
from mudg.data.exporters.video import depth_colors
from mudg.report.score_tables import best_of, distance_title, number_text, title_of

GROUPS: Final = (
    ("Colour", ("psnr", "ssim", "perceptual")),
    ("Movement", ("psnr_movers", "flicker")),
    ("Depth", ("abs_rel", "rmse_m", "delta1")),
    ("Classes", ("miou", "accuracy")),
)
CHARTED: Final = ("psnr", "abs_rel", "miou")
NEAR_M: Final = 2.0
FAR_M: Final = 80.0
WITH: Final = "mudg_s"
WITHOUT: Final = "street_gaussians"


@dataclass(frozen=True)
class Reel:
    """The video of one trajectory.

    Args:
        name, camera, shift_m: as in the scores. width, height: of one panel, pixels. frames: number of pictures.
        panels: column name -> rows it has. video, poster: data URIs (video may be empty: no encoder).
    """

    name: str
    camera: str
    shift_m: float | None
    width: int
    height: int
    frames: int
    panels: Mapping[str, Sequence[str]]
    video: str
    poster: str


def page(
    scores: Mapping[str, Any], ledger: Mapping[str, Any], settings: str, reels: Sequence[Reel], columns: Sequence[str]
) -> str:
    """The whole page.

    Args:
        scores: ``metrics.json``. ledger: ``run.json`` of the chain. settings: ``run.yaml``. reels: one per trajectory.
        columns: panel columns in the order in which they stand in the videos.
    """
    assets = resources.files("mudg") / "assets" / "report"
    body = "\n".join(
        (
            _opening(scores, ledger),
            "<main>",
            _player(scores, reels, columns),
            _tables(scores),
            _times(ledger),
            _made_of(scores, ledger, settings),
            "</main>",
        )
    )
    title = f"{scores['scene']['id']}: mudg report"
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; media-src data:; '
        "style-src 'unsafe-inline'; script-src 'unsafe-inline'\">\n"
        f"<title>{escape(title)}</title>\n<style>\n{(assets / 'page.css').read_text(encoding='utf-8')}</style>\n"
        f"</head>\n<body>\n{body}\n"
        "<footer>Made by mudg. This page is one file: it loads nothing and sends nothing.</footer>\n"
        f"<script>\n{(assets / 'page.js').read_text(encoding='utf-8')}</script>\n</body>\n</html>\n"
    )


# ---- words at the top ----


def _of(scores: Mapping[str, Any]) -> dict[tuple[str, float], Mapping[str, Any]]:
    return {(row["method"], float(row["distance_m"])): row["values"] for row in scores["by_distance"]}


def headline(scores: Mapping[str, Any]) -> tuple[str, str]:
    """Headline and one paragraph that say what the numbers say, also when diffusion did not help."""
    of = _of(scores)
    moved = sorted({d for m, d in of if d > 0 and m == WITH and isinstance(of[m, d].get("psnr"), float)})
    if not moved:
        return _headline_without_truth(scores, of)
    far = moved[-1]
    with_, without = of[WITH, far], of.get((WITHOUT, far), {})
    gain = _gain(with_, without, "psnr")
    if gain is None:
        return f"{far:g} m off the recorded path", ""
    if abs(gain) < 0.05:
        verdict = "diffusion makes no difference to colour"
    else:
        verdict = f"diffusion {'adds' if gain > 0 else 'costs'} {abs(gain):.1f} dB"
    place = distance_title(scores, far)
    words = [
        f"{place} of the driven line, colour reaches {with_['psnr']:.1f} dB against exact truth "
        f"({without['psnr']:.1f} dB without diffusion)."
    ]
    for metric, text in (("abs_rel", "relative depth error"), ("miou", "class overlap (mIoU)")):
        if isinstance(with_.get(metric), float) and isinstance(without.get(metric), float):
            words.append(f"The {text} is {with_[metric]:.3f}, against {without[metric]:.3f} without.")
    here, held = of.get((WITH, 0.0), {}).get("psnr"), of.get((WITHOUT, 0.0), {}).get("psnr")
    if isinstance(here, float) and isinstance(held, float):
        words.append(
            f"On the recorded path itself, held-out frames score {here:.1f} dB with and {held:.1f} dB without."
        )
    return f"{far:g} m off the recorded path, {verdict}", " ".join(words)


def _headline_without_truth(
    scores: Mapping[str, Any], of: Mapping[tuple[str, float], Mapping[str, Any]]
) -> tuple[str, str]:
    here, held = of.get((WITH, 0.0), {}).get("psnr"), of.get((WITHOUT, 0.0), {}).get("psnr")
    words = "Nobody drove the shifted lines, so there is no truth to score them against: they are shown below. "
    if isinstance(here, float) and isinstance(held, float):
        words += f"Held-out recorded frames score {here:.1f} dB with diffusion and {held:.1f} dB without."
    return f"{scores['scene']['id']}, seen from lines nobody drove", words


def _gain(with_: Mapping[str, Any], without: Mapping[str, Any], metric: str) -> float | None:
    a, b = with_.get(metric), without.get(metric)
    return a - b if isinstance(a, float) and isinstance(b, float) else None


def _opening(scores: Mapping[str, Any], ledger: Mapping[str, Any]) -> str:
    title, words = headline(scores)
    scene = scores["scene"]
    total = sum(step["seconds"] for step in ledger.get("steps", {}).values())
    facts = [
        (f"{scene['frames']}", "recorded frames"),
        (f"{len(scene['cameras'])}", "cameras" if len(scene["cameras"]) != 1 else "camera"),
        (f"{scene['tracks']}", "tracked objects"),
        (f"{sum(t['views'] for t in scores['trajectories'])}", "views rendered per method"),
        (_duration(total), "from log to this page"),
    ]
    items = "".join(f"<li><b>{escape(value)}</b><span>{escape(label)}</span></li>" for value, label in facts)
    notes = "".join(f"<p>{escape(note)}</p>" for note in scene["notes"])
    return (
        f'<header class="top">\n<p class="kicker">mudg report, {escape(scene["id"])} ({escape(scene["dataset"])})</p>\n'
        f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(words)}</p>\n<ul class="facts">{items}</ul>\n'
        + (f'<div class="note" style="margin-top:1rem">{notes}</div>\n' if notes else "")
        + "</header>"
    )


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


# ---- player ----


def shift_title(shift_m: float | None, name: str) -> str:
    """A trajectory's place in words."""
    if shift_m is None:
        return name
    if shift_m == 0:
        return "recorded path"
    return f"{abs(shift_m):g} m {'left' if shift_m > 0 else 'right'}"


def _player(scores: Mapping[str, Any], reels: Sequence[Reel], columns: Sequence[str]) -> str:
    if not reels:
        return "<section><h2>Views</h2><p>No views were rendered.</p></section>"
    rows = [{"name": "rgb", "title": "Colour"}, {"name": "depth", "title": "Depth"},
            {"name": "semantics", "title": "Classes"}, {"name": "error", "title": "Colour error"}]  # fmt: skip
    recorded = scores["truth"] != "exact"
    titles = {c: ("Recorded, driven line" if recorded and c == "truth" else title_of(c)) for c in columns}
    data = {
        "fps": 10, "columns": list(columns), "titles": titles, "rows": rows,
        "trajectories": [
            {"index": i, "name": r.name, "camera": r.camera, "title": shift_title(r.shift_m, r.name), "width": r.width,
             "height": r.height, "frames": r.frames, "panels": {c: list(p) for c, p in r.panels.items()}}
            for i, r in enumerate(reels) if r.video
        ],
    }  # fmt: skip
    text = json.dumps(data, ensure_ascii=True).replace("<", "\\u003c")
    intro = (
        "Every panel shows the same instant. Left of the road is left on the selector."
        if not recorded
        else "Every panel shows the same instant. The first column is the picture taken from the driven line."
    )
    return f"""<section aria-labelledby="views-title">
<h2 id="views-title">The same moments, from another line</h2>
<p class="soft">{escape(intro)}</p>
<div class="player">
<div class="controls">
{_camera_choice(reels)}{_shift_choice(reels)}
</div>
<div class="controls">
<button type="button" id="play" aria-pressed="true">Pause</button>
<div class="scrub"><label class="label" for="scrub">Time <span id="clock" class="soft"></span></label>
<input type="range" id="scrub" min="0" max="1000" value="0"></div>
<div><label class="label" for="speed">Speed</label><select id="speed"><option value="0.25">quarter</option>
<option value="0.5" selected>half</option><option value="1">real time</option></select></div>
</div>
<div class="wall" id="wall"></div>
{_legend()}
<div class="compare-block">
<h3>Side against side</h3>
<div class="controls">
<div><label class="label" for="compare-left">Left</label><select id="compare-left"></select></div>
<div><label class="label" for="compare-right">Right</label><select id="compare-right"></select></div>
<div><label class="label" for="compare-modality">Show</label><select id="compare-modality"><option value="0">colour</option>
<option value="1">depth</option><option value="2">classes</option><option value="3">colour error</option></select></div>
<div class="scrub"><label class="label" for="wipe">Divider</label>
<input type="range" id="wipe" min="0" max="100" value="50"></div>
</div>
<div class="compare"><canvas id="compare-canvas" role="img" aria-label="Two methods with a movable divider"></canvas>
<div class="bar" id="compare-bar"></div><span class="tag left" id="tag-left"></span><span class="tag right" id="tag-right"></span></div>
</div>
</div>
<div class="reel">
{_reels(reels, columns, titles)}
</div>
<script type="application/json" id="player-data">{text}</script>
</section>"""


def _camera_choice(reels: Sequence[Reel]) -> str:
    cameras = list(dict.fromkeys(r.camera for r in reels))
    if len(cameras) < 2:
        return ""
    items = "".join(
        f'<label><input type="radio" name="camera" value="{escape(c)}"{" checked" if i == 0 else ""}><span>{escape(c)}</span></label>'
        for i, c in enumerate(cameras)
    )
    return f'<fieldset><legend>Camera</legend><div class="segments">{items}</div></fieldset>\n'


def _shift_choice(reels: Sequence[Reel]) -> str:
    ordered = sorted(reels, key=lambda r: (r.camera, -(r.shift_m if r.shift_m is not None else -1e9)))
    first = max((r for r in reels if r.shift_m), key=lambda r: r.shift_m or 0.0, default=reels[0])
    items = "".join(
        f'<label data-camera="{escape(r.camera)}"><input type="radio" name="shift" value="{escape(r.name)}"'
        f"{' checked' if r is first else ''}><span>{escape(shift_title(r.shift_m, r.name))}</span></label>"
        for r in ordered
    )
    return f'<fieldset><legend>Line</legend><div class="segments" id="shifts">{items}</div></fieldset>'


def _reels(reels: Sequence[Reel], columns: Sequence[str], titles: Mapping[str, str]) -> str:
    names = ", ".join(titles[c] for c in columns)
    parts = []
    for index, reel in enumerate(reels):
        label = f"{reel.camera}, {shift_title(reel.shift_m, reel.name)}"
        parts.append(f"<h3>{escape(label)}</h3><p class='small soft'>From left to right: {escape(names)}.</p>")
        if reel.video:
            parts.append(
                f'<video id="video-{index}" controls muted loop playsinline preload="none" poster="{reel.poster}" '
                f'src="{reel.video}" aria-label="{escape(label)}"></video>'
            )
        else:
            parts.append(f'<img src="{reel.poster}" alt="{escape(label)}" style="width:100%">')
    return "\n".join(parts)


def _legend() -> str:
    steps = np.geomspace(NEAR_M, FAR_M, 8).astype(np.float32)[None]
    stops = ", ".join("#{:02x}{:02x}{:02x}".format(*c) for c in depth_colors(steps, NEAR_M, FAR_M)[0])
    shown = ("road", "sidewalk", "building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation",
             "terrain", "sky", "person", "rider", "car", "truck", "bus", "bicycle")  # fmt: skip
    classes = "".join(
        '<li><i style="background:rgb({},{},{})"></i>{}</li>'.format(
            *palette.DISPLAY_COLORS[palette.ID[name]], escape(name)
        )
        for name in shown
    )
    return (
        f'<ul class="legend"><li>Depth: {NEAR_M:g} m <span class="ramp" style="background:linear-gradient(90deg,{stops})"></span>'
        f" {FAR_M:g} m, logarithmic; black is no depth</li><li>Colour error: black is equal, white a third of the range or more"
        f'</li></ul>\n<ul class="legend">{classes}</ul>'
    )


# ---- numbers ----


def _tables(scores: Mapping[str, Any]) -> str:
    of = _of(scores)
    distances = sorted({d for m, d in of if any(isinstance(v, float) for v in of[m, d].values())})
    rules = "".join(f"<li>{escape(rule)}</li>" for rule in scores["rules"])
    if not distances:
        return f'<section><h2>Scores</h2><p>Nothing could be scored.</p><ul class="small">{rules}</ul></section>'
    blocks = "\n".join(_group_table(scores, of, title, names, distances) for title, names in GROUPS)
    absent = [
        m for m in scores["metrics"] if all(r["values"].get(m["name"]) == "not computed" for r in scores["results"])
    ]
    absent_words = ""
    if absent:
        blocks += "\n" + _absent_table(scores, absent)
        listed = ", ".join(f"{m['title']} ({m['needs'][-1]})" for m in absent)
        absent_words = (
            f'<p class="small soft">Not computed, because this build has no weights for them: {escape(listed)}.</p>'
        )
    return f"""<section aria-labelledby="scores-title">
<h2 id="scores-title">Scores</h2>
<p class="soft">Best value of each column marked. Where both sides of the road were rendered, they are averaged.</p>
{_charts(scores)}
{blocks}
{absent_words}
<details><summary>How these numbers are made</summary><ul class="small">{rules}</ul></details>
{_all_results(scores)}
</section>"""


def _group_table(
    scores: Mapping[str, Any], of: Mapping[tuple[str, float], Mapping[str, Any]], title: str, names: Sequence[str],
    distances: Sequence[float],
) -> str:  # fmt: skip
    metrics = [m for n in names for m in scores["metrics"] if m["name"] == n]
    top = "".join(
        f'<th class="group" colspan="{len(metrics)}" scope="colgroup">{escape(distance_title(scores, d))}</th>'
        for d in distances
    )
    arrows = {"higher": "higher is better", "lower": "lower is better"}
    heads = "".join(
        f'<th{" class=edge" if i == 0 else ""} scope="col" title="{arrows[m["better"]]}">{escape(m["title"])}'
        f"<small>{escape(m['unit']) or '&nbsp;'} {'&uarr;' if m['better'] == 'higher' else '&darr;'}</small></th>"
        for _ in distances
        for i, m in enumerate(metrics)
    )
    rows = []
    for method in scores["methods"]:
        cells = []
        for d in distances:
            for i, m in enumerate(metrics):
                across = {x["name"]: of.get((x["name"], d), {}).get(m["name"]) for x in scores["methods"]}
                value = across[method["name"]]
                classes = ["edge"] * (i == 0) + ["best"] * (method["name"] in best_of(m["better"], across, m["name"]))
                classes += ["absent"] * isinstance(value, str)
                cells.append(f'<td class="{" ".join(classes)}">{escape(number_text(m["name"], value))}</td>')
        rows.append(f'<tr><th scope="row">{_tone(method)}{escape(method["title"])}</th>{"".join(cells)}</tr>')
    return (
        f'<h3>{escape(title)}</h3><div class="scroll"><table><thead><tr><th></th>{top}</tr><tr><th scope="col">Method</th>{heads}'
        f"</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _absent_table(scores: Mapping[str, Any], absent: Sequence[Mapping[str, Any]]) -> str:
    """The place of the metrics that this build cannot compute."""
    heads = "".join(f'<th scope="col">{escape(m["title"])}<small>&nbsp; &darr;</small></th>' for m in absent)
    cells = '<td class="absent">not computed</td>' * len(absent)
    rows = "".join(f'<tr><th scope="row">{_tone(m)}{escape(m["title"])}</th>{cells}</tr>' for m in scores["methods"])
    return (
        '<h3>Perceptual</h3><div class="scroll"><table><thead><tr><th scope="col">Method</th>'
        f"{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _tone(method: Mapping[str, Any]) -> str:
    return f'<span class="dot" style="--tone:var(--{escape(method["name"])})"></span>'


def _all_results(scores: Mapping[str, Any]) -> str:
    names = [
        m for m in scores["metrics"] if any(isinstance(r["values"].get(m["name"]), float) for r in scores["results"])
    ]
    heads = "".join(
        f'<th scope="col">{escape(m["title"])}<small>{escape(m["unit"]) or "&nbsp;"}</small></th>' for m in names
    )
    rows = []
    for course in scores["trajectories"]:
        for r in scores["results"]:
            if r["trajectory"] != course["name"]:
                continue
            cells = "".join(f"<td>{escape(number_text(m['name'], r['values'].get(m['name'])))}</td>" for m in names)
            rows.append(
                f"<tr><td>{escape(course['name'])}</td><td style='text-align:left'>{escape(title_of(r['method']))}</td>"
                f"<td>{r['views']}</td>{cells}</tr>"
            )
    return (
        "<details><summary>Every trajectory</summary><div class='scroll'><table><thead><tr><th scope='col'>Trajectory</th>"
        f"<th scope='col' style='text-align:left'>Method</th><th scope='col'>Views</th>{heads}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></div></details>"
    )


def _charts(scores: Mapping[str, Any]) -> str:
    """Small line charts over the signed shift, one per main metric."""
    figures = [c for c in (_chart(scores, m) for n in CHARTED for m in scores["metrics"] if m["name"] == n) if c]
    if not figures:
        return ""
    key = "".join(
        f'<li><span class="dot" style="--tone:var(--{escape(m["name"])})"></span>{escape(m["title"])}</li>'
        for m in scores["methods"]
    )
    return f'<ul class="key">{key}</ul><div class="charts">{"".join(figures)}</div>'


def chart_points(scores: Mapping[str, Any], metric: str) -> dict[str, list[tuple[float, float]]]:
    """Method -> (shift in metres, mean value over cameras), left of the road first."""
    places = {c["name"]: c["shift_m"] for c in scores["trajectories"] if c["shift_m"] is not None}
    points: dict[str, list[tuple[float, float]]] = {}
    for method in scores["methods"]:
        of: dict[float, list[float]] = {}
        for r in scores["results"]:
            value = r["values"].get(metric)
            if r["method"] == method["name"] and r["trajectory"] in places and isinstance(value, float):
                of.setdefault(float(places[r["trajectory"]]), []).append(value)
        if of:
            points[method["name"]] = [(s, sum(v) / len(v)) for s, v in sorted(of.items(), reverse=True)]
    return points


def axis_ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers that enclose all values, at even distances."""
    span = (high - low) or abs(high) or 1.0
    power = 10.0 ** math.floor(math.log10(span / 3))
    step = next(power * k for k in (1, 2, 2.5, 5, 10) if span / (power * k) <= 4)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [i * step for i in range(first, max(last, first + 2) + 1)]


def _chart(scores: Mapping[str, Any], metric: Mapping[str, Any]) -> str:
    points = chart_points(scores, metric["name"])
    shifts = sorted({s for p in points.values() for s, _ in p})
    if len(shifts) < 2:
        return ""
    values = [v for p in points.values() for _, v in p]
    ticks = axis_ticks(min(values), max(values))
    low, high = ticks[0], ticks[-1]
    left, right, top, bottom = 40.0, 330.0, 8.0, 150.0

    def x(shift: float) -> float:  # left of the road is left on the chart
        return left + (shifts[-1] - shift) / (shifts[-1] - shifts[0]) * (right - left)

    def y(value: float) -> float:
        return bottom - (value - low) / (high - low) * (bottom - top)

    parts = []
    for value in ticks:
        parts.append(f'<line class="grid" x1="{left}" x2="{right}" y1="{y(value):.1f}" y2="{y(value):.1f}"/>')
        parts.append(
            f'<text x="{left - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{number_text(metric["name"], value)}</text>'
        )
    for shift in shifts:
        parts.append(f'<text x="{x(shift):.1f}" y="{bottom + 16}" text-anchor="middle">{abs(shift):g}</text>')
    parts.append(
        f'<text x="{left}" y="{bottom + 31}">left</text><text x="{right}" y="{bottom + 31}" text-anchor="end">right, m</text>'
    )
    for method, line in points.items():
        path = " ".join(f"{x(s):.1f},{y(v):.1f}" for s, v in line)
        tone = f"var(--{escape(method)})"
        parts.append(
            f'<polyline points="{path}" fill="none" stroke="{tone}" stroke-width="2" stroke-linejoin="round"/>'
        )
        parts += [f'<circle cx="{x(s):.1f}" cy="{y(v):.1f}" r="3" fill="{tone}"/>' for s, v in line]
    better = "higher is better" if metric["better"] == "higher" else "lower is better"
    unit = f", {metric['unit']}" if metric["unit"] else ""
    label = f"{metric['title']} over the lateral shift, {better}"
    return (
        f"<figure><figcaption>{escape(metric['title'] + unit)} <small>{better}</small></figcaption>"
        f'<svg viewBox="0 0 340 186" role="img" aria-label="{escape(label)}">{"".join(parts)}</svg></figure>'
    )


# ---- times, settings ----


def _times(ledger: Mapping[str, Any]) -> str:
    steps = ledger.get("steps", {})
    total = sum(s["seconds"] for s in steps.values()) or 1.0
    longest = max((s["seconds"] for s in steps.values()), default=1.0) or 1.0
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{s["seconds"]:.1f} s</td><td>{100 * s["seconds"] / total:.0f} %</td>'
        f'<td><span class="meter" style="width:{100 * s["seconds"] / longest:.1f}%"></span></td></tr>'
        for name, s in steps.items()
    )
    return (
        '<section aria-labelledby="times-title"><h2 id="times-title">Time</h2>'
        '<p class="soft">Seconds of each step, summed over continuations; reused results cost nothing.</p>'
        '<div class="scroll"><table class="times"><thead><tr><th scope="col">Step</th><th scope="col">Time</th>'
        f'<th scope="col">Share</th><th></th></tr></thead><tbody>{rows}<tr><th scope="row">total</th>'
        f"<td>{escape(_duration(total))}</td><td></td><td></td></tr></tbody></table></div></section>"
    )


def _made_of(scores: Mapping[str, Any], ledger: Mapping[str, Any], settings: str) -> str:
    environment = ledger.get("environment", {})
    packages = ", ".join(f"{n} {v}" for n, v in environment.get("packages", {}).items())
    scene = scores["scene"]
    sizes = ", ".join(f"{name} {w} x {h}" for name, (w, h) in scene["cameras"].items())
    asked = ledger.get("asked", {})
    seeds = {str(asked[verb]["seed"]) for verb in ("synthesize", "fit") if "seed" in asked.get(verb, {})}
    rows = [
        ("Input", str(ledger.get("asked", {}).get("source", ""))),
        ("Scene", f"{scene['id']}: {scene['frames']} frames, {scene['held_out']} held out; cameras {sizes}"),
        ("Seed", ", ".join(sorted(seeds))),
        ("Diffusion model", str(asked.get("synthesize", {}).get("model", "")).replace("embedded", "shipped with mudg")),
        ("Licence of the data", scene["licence"]),
        ("Truth", "exact at any view" if scores["truth"] == "exact" else "recorded held-out frames only"),
        ("Program", f"mudg {environment.get('mudg', '')}, Python {environment.get('python', '')}"),
        (
            "Machine",
            f"{environment.get('system', '')} {environment.get('machine', '')}, {environment.get('cpu_count', '')} processors",
        ),
        ("Packages", packages),
    ]
    hashes = ", ".join(f"{name} {digest[:16]}" for name, digest in ledger.get("digests", {}).items())
    rows.append(("Hashes (SHA-256)", hashes))
    items = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows if v)
    return (
        f'<section aria-labelledby="made-title"><h2 id="made-title">What was run</h2><dl>{items}</dl>'
        f"<details><summary>All settings (run.yaml)</summary><pre>{escape(settings)}</pre></details></section>"
    )
