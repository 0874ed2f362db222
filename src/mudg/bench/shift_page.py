"""The page of ``mudg bench shift``: tables, and per log and line one video that holds all methods side by side.

The videos are files beside the page (``<log>/film/<trajectory>.mp4``); the page itself loads nothing else.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.run_folder import RunDir, VerbOutput, refuse_overlap
from mudg.base.types import Observation, Trajectory
from mudg.bench import shift_tables as tables
from mudg.core.pictures import error_image, resize_nearest, resize_rgb, to_bytes
from mudg.data.exporters.video import depth_colors, mp4_bytes, video_encoders
from mudg.data.observations import ObservationSet, list_observation_sets, read_observations
from mudg.report.page import FAR_M, NEAR_M

SHOWN: Final = ("nearest_fill", "gs3d", "street_gaussians", "mudg_r", "mudg_s")
PANEL_WIDTH: Final = 320
FPS: Final = 10
FIRST_CRF, LAST_CRF = 29, 41
VIDEO_BYTES: Final = 900 * 1024
"""A video larger than this is made anew in lower quality: eight logs of seven lines stay under 60 MB."""
ROWS: Final = ("colour", "colour error", "depth")
_OUTPUT: Final = VerbOutput("film", 1, ("*.mp4", "*.jpg"))


# ---- videos ----


def film(views: Mapping[str, Path], paths: Sequence[Trajectory], out: Path, *, overwrite: bool = False) -> Path:
    """Write one video and one picture per trajectory: columns truth and methods, rows as ``ROWS``.

    Args:
        views: column -> folder of observation folders; "truth" is needed, and has every trajectory.
    """
    refuse_overlap(out, views)
    inputs = {name: store.digest(folder) for name, folder in views.items()}
    asked = {"columns": list(views), "trajectories": [path.name for path in paths], "panel_width_px": PANEL_WIDTH}
    folder = RunDir.open(out, _OUTPUT, asked, inputs, overwrite)
    if folder.complete:
        return folder.reused()
    found = {name: list_observation_sets(path) for name, path in views.items()}
    playable = bool(video_encoders())
    for path in paths:
        sets = {name: read_observations(of[path.name]) for name, of in found.items() if path.name in of}
        if "truth" not in sets:
            raise InputError("no truth to show", where=f"{views.get('truth')}: {path.name}")
        pictures = list(_atlases(sets, list(views), len(path)))
        if playable:
            store.atomic_write(folder.path / f"{path.name}.mp4", _video(pictures))
        poster = io.BytesIO()
        middle = Image.fromarray(pictures[len(pictures) // 2])
        middle.resize((middle.width // 2, middle.height // 2), Image.Resampling.BOX).save(poster, "JPEG", quality=75)
        store.atomic_write(folder.path / f"{path.name}.jpg", poster.getvalue())
    folder.finish({"columns": list(views), "videos": playable})
    return folder.path


def _video(pictures: Sequence[NDArray[np.uint8]]) -> bytes:
    """The pictures as a video of at most ``VIDEO_BYTES``, if the lowest quality allows."""
    crf = FIRST_CRF
    while len(content := mp4_bytes(pictures, FPS, crf, "veryfast")) > VIDEO_BYTES and crf < LAST_CRF:
        crf = min(
            LAST_CRF, crf + max(1, math.ceil(6 * math.log2(len(content) / VIDEO_BYTES)))
        )  # 6 steps halve the size, about
    return content


def _atlases(sets: Mapping[str, ObservationSet], order: Sequence[str], frames: int) -> Iterator[NDArray[np.uint8]]:
    camera = sets["truth"].views[0].camera
    width = min(PANEL_WIDTH, camera.width) // 2 * 2
    height = max(2, round(camera.height * width / camera.width) // 2 * 2)
    for frame in range(frames):
        atlas = np.full((height * len(ROWS), width * len(order), 3), 24, np.uint8)
        true = resize_rgb(sets["truth"][frame].rgb, height, width)
        for x, column in enumerate(order):
            if column not in sets:
                continue  # stays grey: not produced
            seen = sets[column][frame]
            rgb = resize_rgb(seen.rgb, height, width)
            shown = [to_bytes(rgb), error_image(rgb, true.clamp(0, 1)), _depth(seen, height, width)]
            if column == "truth":
                shown[1] = np.full_like(shown[0], 24)
            for y, panel in enumerate(shown):
                atlas[y * height : (y + 1) * height, x * width : (x + 1) * width] = panel
        yield atlas


def _depth(seen: Observation, height: int, width: int) -> NDArray[np.uint8]:
    if seen.depth is None:
        return np.full((height, width, 3), 24, np.uint8)
    return depth_colors(resize_nearest(seen.depth, height, width)[0].numpy(), NEAR_M, FAR_M)


# ---- the page ----


_STYLE: Final = """
.film{margin:1rem 0}.film .heads{display:grid;grid-auto-flow:column;grid-auto-columns:1fr;font-size:.8rem;text-align:center}
.film video,.film img{width:100%;display:block}.hidden{display:none}.choices{display:flex;gap:2rem;flex-wrap:wrap;margin:1rem 0}
.choices select{font:inherit}td.words{text-align:left;white-space:normal}main{max-width:none}
"""
_SCRIPT: Final = """
const log=document.getElementById('log'),line=document.getElementById('line'),films=[...document.querySelectorAll('.film')];
function show(){for(const f of films){const on=f.dataset.log===log.value&&f.dataset.line===line.value;
f.classList.toggle('hidden',!on);const v=f.querySelector('video');if(v){if(on){v.play().catch(()=>{})}else{v.pause()}}}}
if(log){document.getElementById('choices').classList.remove('hidden');log.onchange=line.onchange=show;show()}
"""


def page(doc: Mapping[str, Any]) -> str:
    """The whole page from what ``bench.json`` holds."""
    css = (resources.files("mudg") / "assets" / "report" / "page.css").read_text(encoding="utf-8")
    settings = doc["settings"]
    title = f"Beside the recorded path: {tables.logs_text(doc)}, {settings['list']} list"
    lead = (
        f"Generated logs of {settings['frames']} frames with exact truth at every view; {settings['iterations']} iterations per fit. "
        "Means over logs and both sides of the path."
    )
    places = [tables.SHIFTED, tables.RECORDED, *(f"{d:g}" for d in sorted(doc["distances_m"]))]
    body = "\n".join(
        [
            f'<header class="top"><p class="kicker">mudg bench shift</p><h1>{escape(title)}</h1>',
            f'<p class="lead">{escape(lead)}</p></header>',
            "<main>", _films(doc),
            "<section><h2>Compared</h2>", _compared(doc), "</section>",
            "<section><h2>Scores</h2>", *(_scores(doc, place) for place in places), "</section>",
            "<section><h2>Logs</h2>", _logs(doc), "</section>", "</main>",
        ]
    )  # fmt: skip
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{css}{_STYLE}</style>\n</head>\n<body>\n{body}\n"
        f"<footer>Made by mudg. The videos lie beside this page.</footer>\n<script>{_SCRIPT}</script>\n</body>\n</html>\n"
    )


def _films(doc: Mapping[str, Any]) -> str:
    shown = [(entry["log"], name) for entry in doc["logs"] for name in entry["films"]]
    if not shown:
        return ""
    columns = ["truth", *(r["name"] for r in doc["methods"] if r["name"] in SHOWN)]
    lines = list(dict.fromkeys(name for _, name in shown))
    farthest = max(lines, key=_shift_of)
    logs = "".join(f"<option>{entry['log']}</option>" for entry in doc["logs"] if entry["films"])
    options = "".join(
        f'<option value="{escape(n)}"{" selected" if n == farthest else ""}>{escape(_line_title(n))}</option>'
        for n in sorted(lines, key=_shift_of)
    )
    heads = "".join(f"<span>{escape(c)}</span>" for c in columns)
    blocks = [
        f'<div class="film" data-log="{log}" data-line="{escape(name)}"><p class="small soft">Log {log}, {escape(_line_title(name))}. '
        f'Rows: {", ".join(ROWS)}. Grey: not produced.</p><div class="heads">{heads}</div><video controls muted loop playsinline '
        f'preload="none" poster="{log}/film/{escape(name)}.jpg" src="{log}/film/{escape(name)}.mp4"></video></div>'
        for log, name in shown
    ]  # fmt: skip
    return (
        '<section><h2>The same moments</h2><div class="choices hidden" id="choices">'
        f'<label>Log <select id="log">{logs}</select></label><label>Line <select id="line">{options}</select></label></div>'
        + "\n".join(blocks) + "</section>"
    )  # fmt: skip


def _shift_of(name: str) -> float:
    _, _, shift = name.partition("_shift")
    return float(shift) if shift else 0.0


def _line_title(name: str) -> str:
    shift_m = _shift_of(name)
    return "recorded path" if shift_m == 0 else f"{abs(shift_m):g} m to the {'left' if shift_m > 0 else 'right'}"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    top = "".join(f'<th scope="col">{escape(h)}</th>' for h in heads)
    body = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>' + "".join(f"<td>{escape(cell)}</td>" for cell in row[1:]) + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _compared(doc: Mapping[str, Any]) -> str:
    rows = [[c["title"], *tables.compared_text(c), c["kind"], str(c["logs"])] for c in doc["comparisons"]]
    return _table(("", "value", "standard error", "as", "logs"), rows)


def _scores(doc: Mapping[str, Any], place: str) -> str:
    rows = []
    for row in doc["methods"]:
        of = doc["pooled"][row["name"]][place]
        rows.append([row["name"], *(tables.number(of[m], digits, with_error=True) for m, _, digits in tables.COLUMNS)])
    return f"<h3>{escape(tables.place_title(doc, place))}</h3>" + _table(
        ("method", *(h for _, h, _ in tables.COLUMNS)), rows
    )


def _logs(doc: Mapping[str, Any]) -> str:
    return _table(tables.FACTS, [tables.facts_of(entry) for entry in doc["logs"]])
