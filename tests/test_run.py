"""The chain: order, reuse, interruption, refusal. The verbs are stand-ins; the real ones run in the slow test below."""

from __future__ import annotations

import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from refusals import refused

from mudg import app
from mudg.base import store
from mudg.base.errors import IntegrityError, NumericsError, ResourceError, UsageError
from mudg.scoring import score
from mudg.steps import pipeline
from mudg.steps.run import Demo, Run
from mudg.steps.settings import RunConfig, run_preset, with_seed
from mudg.steps.step import Step
from mudg.viewer import report


@pytest.fixture
def verbs(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Stand-ins that note their calls and write a folder; ``trouble[verb]`` is raised once by that verb."""
    seen: dict[str, Any] = {"calls": [], "trouble": {}, "labelled": True}

    def stand_in(step: Step) -> Any:
        if isinstance(step, Run | Demo):
            return step.act()
        verb = step.verb()
        trouble = seen["trouble"].pop(verb, None)
        if trouble is not None:
            raise trouble
        label = f"{verb}:{step.out.name}" if verb in ("fit", "render") else verb
        seen["calls"].append(label)
        seen[label] = step
        step.out.mkdir(parents=True, exist_ok=True)
        (step.out / "scene.json").write_text("{}") if verb in ("ingest", "annotate") else None
        (step.out / "manifest.json").write_text("{}")
        return step.out

    monkeypatch.setattr(Step, "run", stand_in)
    monkeypatch.setattr(pipeline, "_has_semantics", lambda _scene: seen["labelled"])
    monkeypatch.setattr(score, "summary_table", lambda _out: "table")

    def film(_out: Path) -> list[Any]:
        seen["calls"].append("report")
        return []

    def write_page(out: Path, _reels: list[Any]) -> Path:
        store.write_text(out / "report.html", "page")
        return out / "report.html"

    def write_viewer(out: Path) -> Path:
        seen["calls"].append("viewer")
        return out / "viewer.html"

    monkeypatch.setattr(pipeline, "_write_viewer", write_viewer)
    monkeypatch.setattr(report, "film", film)
    monkeypatch.setattr(report, "write_page", write_page)
    return seen


CHAIN = [
    *("ingest", "fuse", "fit:street_gaussians", "synthesize", "fit:mudg_s", "render:street_gaussians"),
    *("render:mudg_s", "score", "viewer", "report"),
]


USUAL = RunConfig()


def chain(folder: Path, settings: RunConfig = USUAL, **more: Any) -> dict[str, Any]:
    return Run(source="city", out=folder / "out", settings=settings, **more).run()


def test_the_whole_chain_in_order(tmp_path: Path, verbs: dict[str, Any]) -> None:
    result = chain(tmp_path)
    assert verbs["calls"] == CHAIN
    assert result["report"] == tmp_path / "out" / "report.html"
    assert list(result["seconds"])[-1] == "report"
    assert "table" in result["text"]
    assert str(result["report"].resolve()) in result["text"]
    plain, guided = verbs["fit:street_gaussians"], verbs["fit:mudg_s"]
    assert plain.settings.method == "street_gaussians"
    assert plain.observations == () and plain.start_from is None
    assert guided.settings.method == "mudg_s"
    assert guided.observations == (tmp_path / "out" / "synthesize",)
    assert guided.start_from is None and verbs["synthesize"].fitted is None
    assert guided.settings.iterations == 1.5 * plain.settings.iterations
    ledger = store.read_json(tmp_path / "out" / "run.json")
    assert ledger["state"] == "complete"
    assert all(step["state"] == "complete" for step in ledger["steps"].values())
    sizes = {path: path.stat().st_size for path in (tmp_path / "out").rglob("*") if path.is_file()}
    steps = sum(size for path, size in sizes.items() if path.name not in ("run.json", "run.yaml"))
    assert sum(step["written_bytes"] for step in ledger["steps"].values()) == steps > 0


def test_two_runs_in_one_folder_at_a_time(
    tmp_path: Path, verbs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    Run(source="city", out=out, settings=RunConfig()).run()
    record = (out / "run.json").read_bytes()
    sleeper = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        store.write_json(out / "lock", {"pid": sleeper.pid, "host": socket.gethostname()})
        step = Run(source="city", out=out, overwrite=True, settings=run_preset("fast"))
        refused("another process is working in this folder", step.run, raises=ResourceError)
        assert (out / "run.json").read_bytes() == record
    finally:
        sleeper.communicate(b"\n")
    Run(source="city", out=out, settings=RunConfig()).run()
    assert not (out / "lock").exists()


def test_a_repeat_makes_no_second_report_unless_it_is_gone(tmp_path: Path, verbs: dict[str, Any]) -> None:
    chain(tmp_path)
    assert "report" in chain(tmp_path)["seconds"] and verbs["calls"] == [*CHAIN, *CHAIN[:-2]]
    (tmp_path / "out" / "report.html").unlink()
    chain(tmp_path)
    assert verbs["calls"][-1] == "report"
    assert (tmp_path / "out" / "report.html").read_text() == "page"


def test_a_scene_without_labels_is_annotated_and_one_with_labels_is_used(tmp_path: Path, verbs: dict[str, Any]) -> None:
    verbs["labelled"] = False
    chain(tmp_path)
    assert verbs["calls"] == [CHAIN[0], "annotate", *CHAIN[1:]]
    for label in ("fuse", "synthesize", "fit:mudg_s", "render:mudg_s", "score"):
        assert verbs[label].scene == tmp_path / "out" / "annotate"
    verbs["labelled"] = True
    verbs["calls"].clear()
    store.write_json(tmp_path / "scene" / "scene.json", {})
    Run(source=tmp_path / "scene", out=tmp_path / "other", settings=USUAL).run()
    assert verbs["calls"] == CHAIN[1:] and verbs["fuse"].scene == tmp_path / "scene"


@pytest.mark.parametrize(
    ("trouble", "state"), [(KeyboardInterrupt(), "interrupted"), (NumericsError("a loss is not finite"), "failed")]
)
def test_what_stopped_a_run_is_recorded_and_the_repeat_continues(
    tmp_path: Path, verbs: dict[str, Any], trouble: BaseException, state: str
) -> None:
    verbs["trouble"]["synthesize"] = trouble
    with pytest.raises(type(trouble)):
        chain(tmp_path)
    ledger = store.read_json(tmp_path / "out" / "run.json")
    assert ledger["state"] == state and ledger["steps"]["synthesize"]["state"] == "interrupted"
    assert ledger["steps"]["fuse"]["state"] == "complete" and "score" not in ledger["steps"]
    chain(tmp_path)
    assert store.read_json(tmp_path / "out" / "run.json")["state"] == "complete"


def test_a_run_says_which_step_it_is_at_and_what_is_left(
    tmp_path: Path, verbs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the first fit the finished steps were 19 % of the work, so 38 minutes of them leave 162."""
    steps = pipeline.steps_of(RunConfig(), tmp_path / "scene", tmp_path, overwrite=False)
    assert list(pipeline.PERCENT_OF_A_RUN) == [*steps, "viewer", "report"]
    said = list[str]()
    monkeypatch.setattr(pipeline.log, "info", said.append)
    monkeypatch.setattr(pipeline.store, "json_object", lambda _: {"seconds": 19 * 60.0})  # the record of each step
    chain(tmp_path)
    assert "== fit without diffusion, step 2 of 9" in said
    assert "== synthesize, step 3 of 9, about 162 min left" in said


def test_other_settings_are_refused_at_once_and_named(tmp_path: Path, verbs: dict[str, Any]) -> None:
    chain(tmp_path)
    verbs["calls"].clear()
    refused("fit.seed: 0 there, 3 asked", chain, tmp_path, with_seed(RunConfig(), 3), raises=UsageError)
    assert verbs["calls"] == []
    chain(tmp_path, with_seed(RunConfig(), 3), overwrite=True)
    assert verbs["calls"] == CHAIN
    assert all(verbs[label].overwrite for label in CHAIN[:-2])


def test_an_altered_record_of_a_run_is_not_taken(tmp_path: Path, verbs: dict[str, Any]) -> None:
    chain(tmp_path)
    record = store.read_json(tmp_path / "out" / "run.json")
    record["steps"]["fuse"]["seconds"] = 0.125
    store.write_json(tmp_path / "out" / "run.json", record)
    refused("altered", chain, tmp_path, raises=IntegrityError)


def test_a_log_that_is_none_and_a_folder_of_something_else_are_refused(tmp_path: Path, verbs: dict[str, Any]) -> None:
    step = Run(source=tmp_path / "nothing", out=tmp_path / "out", settings=USUAL)
    refused("no such driving log", step.run)
    (tmp_path / "holiday.jpg").write_text("x")
    refused("do not belong to this run", Run(source="city", out=tmp_path, settings=USUAL).run, raises=UsageError)
    assert verbs["calls"] == [] and sorted(p.name for p in tmp_path.iterdir()) == ["holiday.jpg"]


def test_ctrl_c_prints_how_to_continue(
    tmp_path: Path, verbs: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    verbs["trouble"]["fuse"] = KeyboardInterrupt()
    words = ["demo", "--fast", "--out", str(tmp_path / "my out")]
    assert app.main(words) == 130
    assert f"mudg demo --fast --out '{tmp_path / 'my out'}'" in capsys.readouterr().err


@pytest.mark.slow
def test_the_real_chain_ends_with_a_report_and_continues_after_a_kill(tmp_path: Path) -> None:
    """``mudg demo --fast`` in miniature, killed once on the way; the repeat gives what an undisturbed run gives."""
    small = ["--fast", "--fit.iterations", "12", "--synthesize.steps", "1", "--out"]
    command = [sys.executable, "-m", "mudg", "demo", "--quiet", *small]
    first = subprocess.Popen([*command, str(tmp_path / "killed")])
    try:
        first.wait(timeout=20)
    except subprocess.TimeoutExpired:
        first.kill()
        first.wait()
    subprocess.run([*command, str(tmp_path / "killed")], check=True, timeout=900)
    subprocess.run([*command, str(tmp_path / "whole")], check=True, timeout=900)
    page = (tmp_path / "killed" / "report.html").read_text()
    assert len(page) < 25e6
    scores = [(tmp_path / name / "score" / "metrics.json").read_bytes() for name in ("killed", "whole")]
    assert scores[0] == scores[1]
