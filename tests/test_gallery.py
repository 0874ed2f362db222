"""`mudg report`: one page over many finished runs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser
from refusals import refused

import mudg
from mudg import app
from mudg.base import store
from mudg.base.errors import UsageError
from mudg.viewer import gallery

METRICS = [
    {"name": "psnr", "title": "PSNR", "unit": "dB", "better": "higher"},
    {"name": "abs_rel", "title": "AbsRel", "unit": "", "better": "lower"},
]


def scores_of(scene: str, psnr: float) -> dict[str, Any]:
    def row(method: str, distance_m: float, **values: Any) -> dict[str, Any]:
        return {"method": method, "distance_m": distance_m, "trajectories": [], "values": values}

    rows = [row("mudg_s", d, psnr=psnr - d, abs_rel="no truth" if d else 0.1) for d in (0.0, 2.0)]
    titles = {"mudg_s": "Gaussians with diffusion", "mudg_r": "Diffusion output"}
    return {
        "scene": {"id": scene, "dataset": "toy", "frames": 12, "cameras": {"front": [48, 32]}},
        "by_distance": [*rows, row("mudg_r", 0.0, psnr="not produced")],
        "metrics": METRICS,
        "methods": [{"name": name, "title": title} for name, title in titles.items()],
    }


def run_of(folder: Path, scene: str = "city-1", psnr: float = 25.0, state: str = "complete") -> Path:
    steps = {"fit": {"seconds": 65.2}}
    store.write_json(folder / "run.json", {"asked": {"verb": "run"}, "state": state, "steps": steps})
    store.write_json(folder / "score" / "metrics.json", scores_of(scene, psnr))
    store.write_text(folder / "report.html", "the report")
    picture = folder / "render" / "mudg_s" / "front_recorded" / "rgb" / "000000.png"
    store.write_image(picture, np.full((32, 48, 3), 90, np.uint8))
    return folder


def test_a_page_has_a_card_and_the_scores_of_every_run(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    run_of(runs / "a b", psnr=25.0)
    run_of(runs / "c", scene="city-2", psnr=27.0)
    store.write_json(runs / "score" / "run.json", {"verb": "score", "state": "complete"})
    store.write_json(runs / "score" / "metrics.json", scores_of("kitti", 20.0))
    store.write_json(runs / "bench" / "bench.json", {"bench": "real"})
    store.write_text(runs / "bench" / "bench.md", "tables")
    store.write_text(runs / "c" / "viewer_page" / "index.html", "a large viewer page")
    found = gallery.run([runs, runs / "c"], tmp_path / "pages" / "all.html")
    assert found["shown"] == 4  # c once
    (tmp_path / "fleet" / "_batch").mkdir(parents=True)
    for name in ("c1", "c2"):
        run_of(tmp_path / "fleet" / name / "run" / "0123456789ab")
    assert gallery.run([tmp_path / "fleet"], tmp_path / "fleet.html")["shown"] == 2
    page = (tmp_path / "pages" / "all.html").read_text()
    assert 'href="../runs/a%20b/report.html"' in page and 'href="../runs/bench/bench.md"' in page
    assert "viewer.html" not in page  # there is none, but a folder
    assert 'href="../runs/c/viewer_page/index.html"' in page
    assert page.count("data:image/jpeg;base64,") == 2
    assert "1 min 05 s" in page and "12 frames of 1 cameras" in page
    rows = re.findall(r'<tr><th scope="row">(.*?)</th><td>(.*?)</td><td>(.*?)</td><td>(.*?)</td>', page)
    assert rows == [
        (run, scene, "Gaussians with diffusion", place)
        for run, scene in (("a b", "city-1"), ("c", "city-2"), ("score", "kitti"))
        for place in ("recorded path", "2 m aside")
    ]
    assert 'data-value="27.0">27.00<' in page and 'data-value="">' in page
    assert "default-src 'none'" in page


def test_what_cannot_be_read_is_listed_and_the_rest_goes_on(tmp_path: Path) -> None:
    good = run_of(tmp_path / "good")
    unfinished = run_of(tmp_path / "unfinished", state="running")
    damaged = run_of(tmp_path / "damaged")
    store.write_text(damaged / "score" / "metrics.json", "{")
    other = tmp_path / "other"
    store.write_json(other / "run.json", ["something else"])
    found = gallery.run([unfinished, good, damaged, other, tmp_path / "missing"], tmp_path / "all.html")
    assert found["shown"] == 1
    page = (tmp_path / "all.html").read_text()
    listed = page[page.index("Not shown") :]
    assert all(f"<dt>{folder}</dt>" in listed for folder in (unfinished, damaged, other, tmp_path / "missing"))
    assert "the run is not finished: running" in listed and "no such folder" in listed
    refused("no finished run", gallery.run, [unfinished], tmp_path / "none.html")
    assert not (tmp_path / "none.html").exists()


def test_hostile_names_are_shown_as_text(tmp_path: Path) -> None:
    run_of(tmp_path / "<img src=x onerror=alert(1)>", scene="</td><script>alert(2)</script>")
    gallery.run([tmp_path / "<img src=x onerror=alert(1)>"], tmp_path / "all.html")
    page = (tmp_path / "all.html").read_text()
    assert "<img src=x" not in page and "<script>alert" not in page
    assert "&lt;script&gt;alert(2)" in page


def test_a_page_is_replaced_on_demand_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_of(tmp_path / "run")
    out = tmp_path / "all.html"
    assert mudg.report([run], out=out) == out
    assert mudg.report([run], out=out) == out  # the same again: verified
    refused("exists", mudg.report, [run, run_of(tmp_path / "another")], out=out, raises=UsageError)
    refused("HTML", mudg.report, [run], out=tmp_path / "all.pdf", raises=UsageError)
    assert app.main(["report", str(run), "--out", str(out), "--overwrite"]) == 0
    assert "page: " in capsys.readouterr().out


@pytest.mark.slow
def test_the_table_sorts_and_filters_in_a_browser(tmp_path: Path) -> None:
    for name, psnr in (("x", 25.0), ("y", 27.5), ("z", 26.0)):
        run_of(tmp_path / name, scene=f"city-{name}", psnr=psnr)
    gallery.run([tmp_path / name for name in "xyz"], tmp_path / "all.html")
    with Browser(tmp_path / "profile", size=(390, 844)) as browser:
        ready = "document.readyState === 'complete' && !!document.getElementById('scores')"
        browser.open((tmp_path / "all.html").as_uri(), ready)
        rows = "[...document.querySelectorAll('#scores tbody tr')].filter(r => !r.hidden)"
        shown = f"{rows}.map(r => r.cells[0].innerText).join('')"

        def click(column: int) -> None:
            browser.run(f"document.querySelectorAll('#scores th button')[{column}].click()")

        click(4)
        assert browser.run(shown) == "xzxyzy"  # 23 and 24 aside, 25, 25.5 aside, 26, 27.5
        click(4)
        assert browser.run(shown) == "yzyxzx"
        click(5)
        assert browser.run(shown)[3:] == "yzx"  # rows without a number stay last
        enter = "const e = document.getElementById('{}'); e.value = '{}'; e.dispatchEvent(new Event('{}'))"
        enter = f"(() => {{{{ {enter} }}}})()"
        browser.run(enter.format("filter", "CITY-Z", "input"))
        assert browser.run(shown) == "zz"
        assert browser.run("[...document.querySelectorAll('.cards li')].filter(c => !c.hidden).length") == 1
        browser.run(enter.format("place", "2 m aside", "change"))
        assert browser.run(shown) == "z"
        # a phone scrolls the table, not the page
        assert browser.run("document.documentElement.scrollWidth <= innerWidth")
        assert not browser.errors and all(request.startswith("file:") for request in browser.requests)
