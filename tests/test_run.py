"""The chain: order, reuse, interruption, refusal. The verbs are stand-ins; the real ones run in the slow test below."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from mudg import app
from mudg.base import config as configuration
from mudg.base import (
    log,
    store,
    usage,
)
from mudg.base.errors import InputError, IntegrityError, NumericsError, ResourceError, UsageError
from mudg.pages import run_report
from mudg.stages import adapt, annotate, fit, fuse, ingest, render, run, score, synthesize
from mudg.stages.config import RunConfig, run_preset, with_seed


@pytest.fixture
def verbs(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Stand-ins that note their calls and write a folder; ``trouble[verb]`` is raised once by that verb."""
    seen: dict[str, Any] = {"calls": [], "trouble": {}, "labelled": True, "teaches": (True, "")}

    def stand_in(name: str) -> Callable[..., Path]:
        def act(*arguments: Any, **named: Any) -> Path:
            trouble = seen["trouble"].pop(name, None)
            if trouble is not None:
                raise trouble
            out = next(a for a in reversed(arguments) if isinstance(a, Path))
            label = f"{name}:{out.name}" if name in ("fit", "render") else name
            seen["calls"].append(label)
            seen[label] = (arguments, named)
            out.mkdir(parents=True, exist_ok=True)
            (out / "scene.json").write_text("{}") if name in ("ingest", "annotate") else None
            (out / "manifest.json").write_text("{}")
            return out

        return act

    for module, name in (
        (ingest, "ingest"), (annotate, "annotate"), (fuse, "fuse"), (adapt, "adapt"), (synthesize, "synthesize"), (fit, "fit"),
        (render, "render"), (score, "score"),
    ):  # fmt: skip
        monkeypatch.setattr(module, "run", stand_in(name))
    monkeypatch.setattr(run, "_has_semantics", lambda _scene: seen["labelled"])
    monkeypatch.setattr(run, "_forecast", lambda _config, scene: f"forecast of {scene.name}")
    monkeypatch.setattr(run, "_teaches", lambda _config, _scene: seen["teaches"])
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

    monkeypatch.setattr(run, "_write_viewer", write_viewer)
    monkeypatch.setattr(run_report, "film", film)
    monkeypatch.setattr(run_report, "write_page", write_page)
    return seen


CHAIN = [
    "ingest", "fuse", "fit:street_gaussians", "synthesize", "fit:mudg_s", "render:street_gaussians", "render:mudg_s",
    "score", "viewer", "report",
]  # fmt: skip


def test_the_whole_chain_in_order(tmp_path: Path, verbs: dict[str, Any]) -> None:
    result = run.run_chain(RunConfig(), "city", tmp_path / "out")
    assert verbs["calls"] == CHAIN
    assert result["report"] == tmp_path / "out" / "report.html"
    assert list(result["seconds"])[-1] == "report"
    assert "table" in result["text"]
    assert str(result["report"].resolve()) in result["text"]
    plain, guided = verbs["fit:street_gaussians"], verbs["fit:mudg_s"]
    assert plain[0][0].method == "street_gaussians"
    assert "observations" not in plain[1] and "start" not in plain[1]
    assert guided[0][0].method == "mudg_s"
    assert guided[1]["observations"] == tmp_path / "out" / "synthesize"
    assert guided[1]["start"] == tmp_path / "out" / "fit" / "street_gaussians"
    assert guided[0][0].iterations == plain[0][0].iterations // 2
    ledger = store.read_json(tmp_path / "out" / "run.json")
    assert ledger["state"] == "complete"
    assert all(step["state"] == "complete" for step in ledger["steps"].values())
    files = [path for path in (tmp_path / "out").rglob("*") if path.is_file() and path.name not in ("run.json", "run.yaml")]
    assert sum(step["written_bytes"] for step in ledger["steps"].values()) == sum(path.stat().st_size for path in files) > 0


def test_a_forecast_is_said_before_the_first_long_step(
    tmp_path: Path, verbs: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    log.set_quiet(False)
    run.run_chain(run_preset("fast"), "city", tmp_path / "out")
    said = capsys.readouterr().err
    assert said.index("== ingest") < said.index("forecast of scene") < said.index("== fuse")
    assert verbs["ingest"][0][0].resolution == "", "a city has a size of its own"
    run.run_chain(run_preset("fast"), "city", tmp_path / "out")
    assert "forecast" not in capsys.readouterr().err
    (tmp_path / "log").mkdir()
    run.run_chain(run_preset("fast"), tmp_path / "log", tmp_path / "other")
    assert verbs["ingest"][0][0].resolution == "480"


def test_two_runs_in_one_folder_at_a_time(tmp_path: Path, verbs: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    run.run_chain(RunConfig(), "city", out)
    record, sleeper = (out / "run.json").read_bytes(), subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        store.write_json(out / "lock", {"pid": sleeper.pid, "host": socket.gethostname()})
        with pytest.raises(ResourceError, match="another process is working in this folder"):
            run.run_chain(run_preset("fast"), "city", out, overwrite=True)
        assert (out / "run.json").read_bytes() == record
    finally:
        sleeper.communicate(b"\n")
    run.run_chain(RunConfig(), "city", out)
    assert not (out / "lock").exists()


def test_a_recorded_log_is_adapted_to(tmp_path: Path, verbs: dict[str, Any]) -> None:
    verbs["teaches"] = (False, "")
    run.run_chain(RunConfig(), "city", tmp_path / "out")
    assert verbs["calls"] == [*CHAIN[:3], "adapt", *CHAIN[3:]]
    settings, *paths = verbs["adapt"][0]
    fitted = tmp_path / "out" / "fit" / "street_gaussians"
    assert settings.model == "embedded" and settings.cameras == RunConfig().synthesize.cameras and fitted in paths
    assert verbs["synthesize"][0][0].model == str(tmp_path / "out" / "adapt" / "model")
    assert verbs["synthesize"][1]["fitted"] == fitted


@pytest.mark.parametrize(("when", "teaches", "model", "renders"), [
    ("off", (False, ""), "embedded", True), ("auto", (True, ""), "embedded", True), ("auto", (False, "too short"), "embedded", True),
    ("auto", (False, ""), "embedded-tiny", False),
])  # fmt: skip
def test_no_adaptation_where_it_is_not_wanted_or_not_possible(
    tmp_path: Path, verbs: dict[str, Any], when: Any, teaches: tuple[bool, str], model: str, renders: bool
) -> None:
    verbs["teaches"] = teaches
    plain = RunConfig(adaptation=when)
    run.run_chain(replace(plain, synthesize=replace(plain.synthesize, model=model)), "city", tmp_path / "out")
    assert verbs["calls"] == CHAIN
    assert verbs["synthesize"][0][0].model == model
    assert (verbs["synthesize"][1]["fitted"] is not None) == renders


def test_adaptation_that_is_asked_for_but_not_possible_is_refused(tmp_path: Path, verbs: dict[str, Any]) -> None:
    verbs["teaches"] = (False, "too short")
    with pytest.raises(UsageError, match="adapted"):
        run.run_chain(RunConfig(adaptation="on"), "city", tmp_path / "out")


def test_a_repeat_makes_no_second_report_unless_it_was_touched(tmp_path: Path, verbs: dict[str, Any]) -> None:
    run.run_chain(RunConfig(), "city", tmp_path / "out")
    before = run.run_chain(RunConfig(), "city", tmp_path / "out")["seconds"]
    assert verbs["calls"] == [*CHAIN, *CHAIN[:-2]]
    assert "report" in before
    store.write_text(tmp_path / "out" / "report.html", "scribble")
    run.run_chain(RunConfig(), "city", tmp_path / "out")
    assert verbs["calls"][-1] == "report"
    assert (tmp_path / "out" / "report.html").read_text() == "page"


def test_run_yaml_repeats_the_run(tmp_path: Path, verbs: dict[str, Any]) -> None:
    config = with_seed(run_preset("fast"), 5)
    run.run_chain(config, "city", tmp_path / "out")
    assert configuration.load(RunConfig, None, tmp_path / "out" / "run.yaml") == config


def test_a_scene_without_labels_is_annotated_and_then_used(tmp_path: Path, verbs: dict[str, Any]) -> None:
    verbs["labelled"] = False
    run.run_chain(RunConfig(), "city", tmp_path / "out")
    assert verbs["calls"] == [CHAIN[0], "annotate", *CHAIN[1:]]
    for label in ("fuse", "synthesize", "fit:mudg_s", "render:mudg_s", "score"):
        assert tmp_path / "out" / "annotate" in verbs[label][0]


def test_a_scene_needs_no_ingest(tmp_path: Path, verbs: dict[str, Any]) -> None:
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "scene.json").write_text("{}")
    run.run_chain(RunConfig(), scene, tmp_path / "out")
    assert verbs["calls"] == CHAIN[1:]
    assert scene in verbs["fuse"][0]


def test_an_interruption_is_recorded_and_the_repeat_continues(tmp_path: Path, verbs: dict[str, Any]) -> None:
    verbs["trouble"]["synthesize"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        run.run_chain(RunConfig(), "city", tmp_path / "out")
    ledger = store.read_json(tmp_path / "out" / "run.json")
    assert ledger["state"] == "interrupted"
    assert ledger["steps"]["synthesize"]["state"] == "interrupted"
    assert "score" not in ledger["steps"]
    run.run_chain(RunConfig(), "city", tmp_path / "out")
    assert store.read_json(tmp_path / "out" / "run.json")["state"] == "complete"


def test_seconds_add_up_over_continuations_and_reuse_adds_none(
    tmp_path: Path, verbs: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = {"now": 0.0}
    costs = {"ingest": [10.0, 1.0, 1.0], "fuse": [2.0, 0.5], "synthesize": [30.0, 12.0, 0.25]}
    monkeypatch.setattr(usage.time, "monotonic", lambda: clock["now"])
    plain = {name: module.run for name, module in (("ingest", ingest), ("fuse", fuse), ("synthesize", synthesize))}

    def costing(name: str) -> Callable[..., Path]:
        def act(*arguments: Any, **named: Any) -> Path:
            clock["now"] += costs[name].pop(0)
            return plain[name](*arguments, **named)

        return act

    for name, module in (("ingest", ingest), ("fuse", fuse), ("synthesize", synthesize)):
        monkeypatch.setattr(module, "run", costing(name))
    verbs["trouble"]["synthesize"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        run.run_chain(RunConfig(), "city", tmp_path / "out")
    seconds = run.run_chain(RunConfig(), "city", tmp_path / "out")["seconds"]
    assert (seconds["ingest"], seconds["fuse"], seconds["synthesize"]) == (10.0, 2.0, 42.0)


def test_other_settings_are_refused_at_once_and_named(tmp_path: Path, verbs: dict[str, Any]) -> None:
    run.run_chain(RunConfig(), "city", tmp_path / "out")
    verbs["calls"].clear()
    with pytest.raises(UsageError) as refused:
        run.run_chain(with_seed(RunConfig(), 3), "city", tmp_path / "out")
    assert "fit.seed: 0 there, 3 asked" in str(refused.value)
    assert verbs["calls"] == []
    run.run_chain(with_seed(RunConfig(), 3), "city", tmp_path / "out", overwrite=True)
    assert verbs["calls"] == CHAIN
    assert all(verbs[label][1]["overwrite"] for label in CHAIN[:-2])


def test_an_altered_record_of_a_run_is_not_taken(tmp_path: Path, verbs: dict[str, Any]) -> None:
    run.run_chain(RunConfig(), "city", tmp_path / "out")
    record = store.read_json(tmp_path / "out" / "run.json")
    record["steps"]["fuse"]["seconds"] = 0.125
    store.write_json(tmp_path / "out" / "run.json", record)
    with pytest.raises(IntegrityError, match="altered"):
        run.run_chain(RunConfig(), "city", tmp_path / "out")


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path, verbs: dict[str, Any]) -> None:
    (tmp_path / "holiday.jpg").write_text("x")
    with pytest.raises(UsageError, match="do not belong to this run"):
        run.run_chain(RunConfig(), "city", tmp_path)
    assert verbs["calls"] == []
    assert sorted(p.name for p in tmp_path.iterdir()) == ["holiday.jpg"]


def test_no_such_log(tmp_path: Path, verbs: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="no such driving log"):
        run.run_chain(RunConfig(), tmp_path / "nothing", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_error_in_a_step_keeps_what_was_done(tmp_path: Path, verbs: dict[str, Any]) -> None:
    verbs["trouble"]["fit"] = NumericsError("a loss is not finite")
    with pytest.raises(NumericsError):
        run.run_chain(RunConfig(), "city", tmp_path / "out")
    ledger = store.read_json(tmp_path / "out" / "run.json")
    assert ledger["state"] == "failed"
    assert ledger["steps"]["fuse"]["state"] == "complete"
    run.run_chain(RunConfig(), "city", tmp_path / "out")


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


def test_a_fit_from_nothing_is_given_no_start(tmp_path: Path, verbs: dict[str, Any]) -> None:
    run.run_chain(RunConfig(continue_fit=False), "city", tmp_path / "out")
    guided = verbs["fit:mudg_s"]
    assert guided[1]["start"] is None
    assert guided[0][0].iterations == verbs["fit:street_gaussians"][0][0].iterations
