"""The report page: self-contained, escaped, says what the numbers say, right pictures."""

from __future__ import annotations

import base64
import dataclasses
import html
import html.parser
import io
import json
import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import toy_views
from jinja2 import UndefinedError
from refusals import refused

from mudg import app
from mudg.base import html as report_html
from mudg.base import store
from mudg.base.types import Observation
from mudg.editing.script import read_edits
from mudg.editing.settings import ScoreConfig
from mudg.steps.render import Score
from mudg.viewer import report


def dark(share: float) -> Any:
    def change(_index: int, seen: Observation) -> Observation:
        return dataclasses.replace(seen, rgb=seen.rgb * share)

    return change


def grey(_index: int, seen: Observation) -> Observation:
    return dataclasses.replace(seen, rgb=torch.full_like(seen.rgb, 0.5), semantics=None)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the chain leaves behind, made from toy views; tests only read, or copy it."""
    out = tmp_path_factory.mktemp("run") / "run"
    scene = toy_views.write_scene(out / "scene")
    plain = toy_views.write_views(scene, out / "render" / "street_gaussians", "street_gaussians", (0.0, 2.0), dark(0.8))
    guided = toy_views.write_views(scene, out / "render" / "mudg_s", "mudg_s", (0.0, 2.0), dark(0.9))
    virtual = toy_views.write_views(scene, out / "synthesize", "mudg_r", (2.0,), grey)
    methods = {"street_gaussians": plain, "mudg_r": virtual, "mudg_s": guided}
    Score(scene=scene, views=methods, out=out / "score", settings=ScoreConfig(perceptual_views=1)).run()
    steps = {"ingest": {"state": "complete", "seconds": 1.5}, "score": {"state": "complete", "seconds": 3.0}}
    environment = {"mudg": "0", "packages": {"torch": "2"}}
    ledger = {"asked": {"source": "<toy> & co"}, "steps": steps, "environment": environment}
    store.write_json(out / "run.json", ledger)
    store.write_text(out / "run.yaml", "fit:\n  iterations: 3 # <script>alert(1)</script>\n")
    return out


def written(out: Path) -> Path:
    """The report of a finished run."""
    return report.write_page(out, report.film(out))


@pytest.fixture(scope="module")
def page(run: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    out = shutil.copytree(run, tmp_path_factory.mktemp("page") / "run")
    return written(out).read_text(encoding="utf-8")


class Outline(html.parser.HTMLParser):
    """Collects tags and checks that they nest."""

    VOID = frozenset(("meta", "input", "img", "br", "link", "line", "circle", "polyline"))

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> without a beginning"
        assert self.open.pop() == tag


def outline(page: str) -> Outline:
    parser = Outline()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


def test_the_page_is_well_formed_escapes_texts_and_loads_nothing(page: str) -> None:
    found = outline(page)
    for tag, attributes in found.tags:
        for name in ("src", "href", "poster", "srcset", "data", "action"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:", "#")), f"<{tag} {name}={value[:60]}>"
    assert not re.search(r"url\(\s*['\"]?(?!data:)", page)
    assert "@import" not in page
    assert "default-src 'none'" in page
    assert "<script>alert(1)" not in page
    assert "&lt;toy&gt; &amp; co" in page


def test_the_report_holds_commands_that_can_be_copied_and_work(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    out = Path(shutil.copytree(run, "my run"))
    nodes = [{"kind": "static", "name": "background"}, {"kind": "rigid", "name": "car 1", "label": "car"}]
    store.write_json(out / "fit" / "mudg_s" / "model.json", {"nodes": nodes})
    text = written(out).read_text(encoding="utf-8")
    blocks = [html.unescape(found) for found in re.findall(r'class="commands">.*?<pre>(.*?)</pre>', text, re.DOTALL)]
    lines = [line for block in blocks for line in block.splitlines()]
    verbs = [shlex.split(line)[1] for line in lines if line.startswith("mudg ")]
    assert {"view", "page", "edit", "render", "export", "asset", "run"} <= set(verbs)
    for line in lines:
        if line.startswith("mudg "):
            args, _ = app.parse(shlex.split(line)[1:])
            for given in (getattr(args, name, None) for name in ("source", "scene")):
                assert given is None or str(given) == "LOG" or Path(given).exists(), line
    assert subprocess.run(next(x for x in lines if x.startswith("printf")), shell=True, check=True).returncode == 0
    script = read_edits(Path("edits.yaml")) if Path("edits.yaml").exists() else None
    assert script is not None and [(e.verb, list(e.settings.ids)) for e in script.edits] == [("remove", ["car 1"])]
    assert len(blocks) == text.count('class="commands"') and "navigator.clipboard" in text


def test_every_control_has_a_label(page: str) -> None:
    found = outline(page)
    labelled = {a["for"] for tag, a in found.tags if tag == "label" and a.get("for")}
    for tag, attributes in found.tags:
        if tag == "select" or (tag == "input" and attributes.get("type") == "range"):
            assert attributes["id"] in labelled
        if tag in ("svg", "canvas", "video", "img"):
            assert attributes.get("aria-label") or attributes.get("alt")
    ids = [a["id"] for _, a in found.tags if a.get("id")]
    assert len(ids) == len(set(ids))


EVIL = '"><script>alert(1)</script>'


def test_names_from_a_scene_cannot_become_tags(run: Path) -> None:
    """Names of scenes, cameras, trajectories, methods, metrics and steps come from files of others."""
    scores = store.read_json(run / "score" / "metrics.json")
    method = scores["methods"][0]["name"]

    def renamed(value: Any) -> Any:
        if isinstance(value, dict):
            return {renamed(k): renamed(v) for k, v in value.items()}
        if isinstance(value, list):
            return [renamed(v) for v in value]
        return value.replace("front", EVIL).replace(method, EVIL) if isinstance(value, str) else value

    spoilt = renamed(scores)
    spoilt["scene"] |= {"id": EVIL, "dataset": EVIL, "licence": EVIL, "notes": [EVIL]}
    spoilt["methods"][0]["title"] = spoilt["metrics"][0]["title"] = spoilt["metrics"][0]["unit"] = EVIL
    content = ("data:video/mp4;base64,AA==", "data:image/jpeg;base64,AA==")
    video = report.TrajectoryVideo(EVIL, EVIL, 2.0, 8, 8, 1, {EVIL: ("rgb",)}, *content)
    page = report.page(spoilt, {"steps": {EVIL: {"seconds": 1.0}}}, EVIL, [video], [EVIL])
    outline(page)
    assert "<script>alert" not in page and page.count("alert(1)") > 10
    data = re.search(r'<script type="application/json" id="player-data">(.*?)</script>', page, re.S)
    assert data is not None and json.loads(data[1])["columns"] == [EVIL]
    assert all("alert" not in (a.get("style") or "") for _, a in outline(page).tags)


def test_videos_hold_all_panels_and_play(page: str) -> None:
    import av

    videos = re.findall(r'src="data:video/mp4;base64,([^"]+)"', page)
    assert len(videos) == 2
    for text in videos:
        with av.open(io.BytesIO(base64.b64decode(text))) as box:
            stream = box.streams.video[0]
            assert stream.codec_context.name == "h264"
            assert stream.codec_context.pix_fmt == "yuv420p"
            frames = [frame.to_ndarray(format="rgb24") for frame in box.decode(video=0)]
        assert len(frames) == toy_views.FRAMES
        # columns: truth (recorded path only), three methods; rows: colour, depth, classes, error
        assert frames[0].shape == (4 * toy_views.HEIGHT, 4 * toy_views.WIDTH, 3)


def test_panels_show_what_they_say(run: Path) -> None:
    scores = store.read_json(run / "score" / "metrics.json")
    folders = report._folders(run, scores)
    assert list(folders) == ["truth", "street_gaussians", "mudg_r", "mudg_s"]
    h, w = toy_views.HEIGHT, toy_views.WIDTH
    courses = {course["shift_m"]: report.Columns.of(course, folders) for course in scores["trajectories"]}
    recorded, shifted = courses[0], courses[2]
    panels, beside = ({c: columns.rows(c) for c in columns.sets} for columns in (recorded, shifted))
    assert recorded.has_truth
    assert panels["truth"] == ("rgb", "depth", "semantics")
    assert panels["mudg_s"] == ("rgb", "depth", "semantics", "error")
    assert "mudg_r" not in panels
    atlas = next(recorded.pictures(list(folders), (w, h)))
    assert np.array_equal(atlas[:h, :w], toy_views.colors(0))
    assert abs(atlas[:h, w : 2 * w].astype(int) - np.round(toy_views.colors(0) * 0.8)).max() <= 1
    assert (atlas[h : 2 * h, :w][np.isnan(toy_views.depths())] == 0).all()
    assert tuple(atlas[2 * h, 0]) == (70, 130, 180)  # sky in the usual colour
    assert (atlas[:h, 2 * w : 3 * w] == 24).all()  # not produced
    assert not shifted.has_truth  # the recorded path is shown beside it
    assert shifted.sets["truth"].trajectory == "front_recorded"
    assert list(shifted.indices["truth"]) == [0, 1, 2, 3]
    assert all("error" not in rows for rows in beside.values())
    atlas = next(shifted.pictures(list(folders), (w, h)))
    assert np.array_equal(atlas[:h, :w], toy_views.colors(0))


def run_of(psnr: dict[tuple[str, float], float | str], truth: str = "exact") -> dict[str, Any]:
    rows, missing = [], {"abs_rel": "no truth", "miou": "no truth"}
    for (method, distance_m), value in psnr.items():
        sides = "both" if distance_m else "recorded"
        rows.append({"method": method, "distance_m": distance_m, "sides": sides, "values": {"psnr": value, **missing}})
    return {"by_distance": rows, "truth": truth, "scene": {"id": "toy", "held_out": 1}}


def test_headline_says_what_the_numbers_say() -> None:
    def at(*pairs: tuple[float, float | str, float | str], truth: str = "exact") -> tuple[str, str]:
        """Of distances with the numbers without and with diffusion."""
        names = ("street_gaussians", "mudg_s")
        return report.headline(run_of({(n, d): v for d, *two in pairs for n, v in zip(names, two)}, truth))

    assert at((4.0, 15.0, 17.0), (2.0, 16.0, 16.0))[0] == "4 m off the recorded path, diffusion adds 2.0 dB"
    assert at((3.0, 15.0, 14.5))[0] == "3 m off the recorded path, diffusion costs 0.5 dB"
    assert "no difference" in at((3.0, 15.0, 15.01))[0]
    title, words = at((0.0, 20.0, 21.0), (2.0, "no truth", "no truth"), truth="recorded")
    assert title == "toy: views off the recorded path"
    assert "21.0 dB with diffusion and 20.0 dB without" in words


@pytest.mark.parametrize(
    ("low", "high"), [(9.5, 19.3), (0.03, 0.07), (1.0, 1.0), (0.0, 0.0), (12.1, 12.3), (-5.0, 3.0)]
)
def test_axis_ticks_enclose_the_values(low: float, high: float) -> None:
    ticks = report.axis_ticks(low, high)
    assert ticks[0] <= low + 1e-9
    assert ticks[-1] >= high - 1e-9
    assert 3 <= len(ticks) <= 7
    assert np.allclose(np.diff(ticks), ticks[1] - ticks[0])


def test_the_budget_makes_videos_smaller_and_without_an_encoder_pictures_stand_in(
    run: Path, page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = shutil.copytree(run, tmp_path / "run")
    monkeypatch.setattr(report, "BUDGET_BYTES", 1000)
    size = lambda text: len("".join(re.findall(r'src="data:video/mp4;base64,([^"]+)"', text)))
    assert 0 < size(written(out).read_text(encoding="utf-8")) < size(page)
    monkeypatch.setattr(report, "video_encoders", list)
    text = written(out).read_text(encoding="utf-8")
    outline(text)
    assert "<video" not in text and text.count("data:image/jpeg") == 2


def test_an_unscored_run_and_a_value_that_a_template_lacks_are_errors(tmp_path: Path) -> None:
    refused("file not found", written, tmp_path)
    refused("title", report_html.render, "labels.html.j2", raises=UndefinedError)


def test_curves_are_those_of_the_logs_of_both_fits(tmp_path: Path) -> None:
    assert report.fit_charts(tmp_path) == []
    logs = {"street_gaussians": [(10, 20.0), (20, 24.0)], "mudg_s": [(20, 25.0), (40, 30.0)]}
    for method, rows in logs.items():
        (tmp_path / "fit" / method).mkdir(parents=True)
        lines = [{"step": step, "psnr": psnr, "loss_color": 0.1} for step, psnr in rows]
        text = "".join(json.dumps(line) + "\n" for line in [*lines, {"step": 15, "boxes_moved_m": 0.1}])
        (tmp_path / "fit" / method / "log.jsonl").write_text(text)
    psnr, loss = report.fit_charts(tmp_path)
    assert [line["method"] for line in psnr["lines"]] == list(logs)
    assert loss["title"].startswith("Loss")
    scale = {tick["at"]: float(tick["text"]) for tick in psnr["y_ticks"]}
    (a, va), *_, (b, vb) = scale.items()
    steps = [(tick["at"], float(tick["text"])) for tick in psnr["x_ticks"]]
    for line in psnr["lines"]:
        for (x, y), (step, value) in zip(line["points"], logs[line["method"]], strict=True):
            assert va + (y - a) * (vb - va) / (b - a) == pytest.approx(value, abs=0.05)
            assert np.interp(x, *zip(*steps, strict=True)) == pytest.approx(step, abs=0.2)
