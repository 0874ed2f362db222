"""Forecasts of time, memory and bytes: monotone, honest about what was not measured, near what was."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import toy_views

from mudg import native
from mudg.base import store
from mudg.base.memory import in_words
from mudg.core.raster import rasterize as probe
from mudg.gaussians import views as kept
from mudg.steps import cost
from mudg.steps import doctor as diagnosis
from mudg.steps.run import Demo, Run
from mudg.steps.settings import RunConfig, run_preset
from mudg.steps.step import texts_of

DEMO = cost.SceneSize(images=72, path_images=24, width=384, height=256, points=100_600)
"""What `mudg demo` makes."""
FAST = cost.SceneSize(images=12, path_images=12, width=240, height=160, points=100_600)
UNLABELLED = {"points": 31_336, "exact": False, "labelled": False}
LOG = cost.SceneSize(images=16, path_images=16, width=480, height=145, **UNLABELLED)
SLOWER = 0.46
"""Speed of two cores without AVX-512, as the probe found it between the runs."""


def settings(
    preset: cost.PresetName, iterations: int = 0, shifts_m: tuple[float, ...] = (), steps: int = 1
) -> RunConfig:
    config = run_preset(preset)
    if iterations:  # of a run of its own
        fit, synthesize = replace(config.fit, iterations=iterations), replace(config.synthesize, steps=steps)
        config = replace(config, fit=fit, synthesize=synthesize)
    if shifts_m:
        made, shown = replace(config.synthesize, shifts_m=shifts_m), replace(config.render, shifts_m=(0.0, *shifts_m))
        config = replace(config, synthesize=made, render=shown)
    return config


def city(images: int, path_images: int, width: int, height: int) -> cost.SceneSize:
    return cost.SceneSize(images, path_images, width, height, 100_600)


def drive(frames: int, width: int, height: int) -> cost.SceneSize:
    return cost.SceneSize(frames, frames, width, height, **UNLABELLED)


IDLE, BUSY = 1.9, 1.45
"""Speed of the machine that these runs were made on, alone and beside other programs, as the probe found it."""
MEASURED = {
    # run: settings, scene, cores, speed; seconds by the clock, processor seconds, most memory in MB, results in MB,
    # from its run.json
    "demo on two cores": (settings("default"), DEMO, 2, IDLE, 193.2, 321.4, 2190, 582.0),
    "demo --fast": (settings("fast"), FAST, 2, BUSY, None, 61.2, 1563, 104.5),
    "run --fast on a KITTI drive": (settings("fast"), LOG, 2, BUSY, None, 84.7, 1809, 134.0),
    "10 frames of it": (settings("default", 100, (2.0, -2.0), 2), drive(10, 480, 145), 2, BUSY, None, 44.5, 1757, 87.4),
    "6 frames of it": (settings("default", 60, (2.0,)), drive(6, 320, 97), 2, BUSY, None, 12.8, None, 34.8),
    "two cameras": (settings("default", 100, (2.0, -2.0), 2), city(16, 8, 320, 208), 2, BUSY, None, 45.8, 1872, 110.1),
    "ten frames": (settings("default", 150, (3.0,)), city(10, 10, 192, 128), 2, BUSY, None, 28.1, None, 68.9),
    "small": (settings("default", 200, (2.0, -2.0)), city(6, 6, 120, 80), 2, BUSY, None, 28.9, 1424, None),
}


@pytest.mark.parametrize("run", MEASURED)
def test_measured_runs_are_forecast_within_the_stated_factor(run: str) -> None:
    config, size, cores, speed, *measured = MEASURED[run]
    found = cost.estimate(config, size, cores, speed)
    processor_s = sum(value or 0.0 for value in found.processor_s.values())
    forecast = (found.total_s, processor_s, found.memory_bytes / 1e6, found.written_bytes / 1e6)
    pairs = [(said or 0.0, was) for said, was in zip(forecast, measured, strict=True) if was]
    assert not [(said, was) for said, was in pairs if not 1 / cost.FACTOR < said / was < cost.FACTOR]


def total(size: cost.SceneSize = DEMO, *, iterations: int = 1000, steps: int = 2, cores: int = 2) -> float:
    found = cost.estimate(settings("default", iterations, (), steps), size, cores).total_s
    return found


def test_more_of_anything_takes_longer_and_a_faster_machine_less() -> None:
    usual = total()
    assert total(replace(DEMO, images=144)) > usual
    assert total(replace(DEMO, path_images=48)) > usual
    assert total(replace(DEMO, width=768)) > usual
    assert total(iterations=2000) > usual
    assert total(steps=8) > usual
    assert total(cores=1) > usual > total(cores=4)
    slow, fast = (cost.estimate(run_preset(), DEMO, 2, speed) for speed in (1.0, 2.0))
    assert slow.total_s is not None and slow.total_s == pytest.approx(2 * (fast.total_s or 0))
    assert slow.memory_bytes == fast.memory_bytes and slow.written_bytes == fast.written_bytes


@pytest.mark.parametrize("change", [{"path_images": 48}, {"width": 768}, {"exact": True}, {"labelled": False}])
def test_more_of_anything_takes_more_of_the_disk(change: dict[str, int | bool]) -> None:
    log = replace(DEMO, exact=False)
    usual, more = (cost.estimate(run_preset(), size, 1).written_bytes for size in (log, replace(log, **change)))
    assert more > usual


def test_a_long_fit_of_many_gaussians_takes_more_memory() -> None:
    large, config = replace(DEMO, images=7200), run_preset("quality")
    wider = replace(config, fit=replace(config.fit, sh_degree=3))
    assert cost.estimate(wider, large, 1).memory_bytes > cost.estimate(config, large, 1).memory_bytes
    assert cost.VIEWS_BYTES == kept.IN_MEMORY_BYTES


def test_a_log_without_labels_is_annotated() -> None:
    """A step that a generated city does not need is counted where it is taken, in the order in which it comes."""
    found = cost.estimate(run_preset(), LOG, 2)
    assert list(found.seconds)[:3] == ["annotate", "fuse", "fit without diffusion"]
    assert all(found.seconds.values())
    assert "annotate" not in cost.estimate(run_preset(), DEMO, 2).seconds


def test_what_the_flags_promise_of_fast_is_what_is_forecast() -> None:
    """`--fast`: one to two minutes on two cores, of the reference machine and of one of half its speed."""
    for size in (LOG, FAST):
        fast, slow = (cost.estimate(run_preset("fast"), size, 2, speed).total_s for speed in (1.0, SLOWER))
        assert fast is not None and slow is not None and 60 / cost.FACTOR < fast < slow < 120 * cost.FACTOR
    for kind in (Run, Demo):
        assert "one to two minutes on 2 cores" in texts_of(kind)["fast"].lower()
    assert "`--fast` takes one to two minutes" in (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def test_a_line_says_what_a_run_will_take_here() -> None:
    idle, now, half = (cost.estimate(run_preset("fast"), LOG, 2, speed) for speed in (1.0, 0.9, 0.25))
    seconds = int(cost.in_a_line(idle, now).partition("about ")[2].split()[0])
    assert seconds == pytest.approx(idle.total_s, abs=1)
    assert "busy" not in cost.in_a_line(idle, now) and "if it stays as busy as it is now" in cost.in_a_line(idle, half)
    paper = cost.estimate(run_preset("paper"), LOG, 2)
    assert "and synthesize (not measured)" in cost.in_a_line(paper, paper)
    assert "time not measured" in cost.in_a_line(*[cost.estimate(run_preset("fast"), LOG, 2, 1.0, "cuda")] * 2)


def test_what_was_not_measured_has_no_number() -> None:
    paper = cost.estimate(run_preset("paper"), DEMO, 2)
    assert paper.seconds["synthesize"] is None and paper.total_s is None
    on_card = cost.estimate(run_preset(), DEMO, 2, 1.0, "cuda")
    assert on_card.total_s is None and on_card.memory_bytes > 0
    text = "\n".join(cost.in_words(cost.of_presets(DEMO, 2, 1.0, "cuda"), 0, "cuda"))
    assert "time not measured" in text
    assert "fit into" not in text and "suffice" not in text


def test_memory_and_disk_decide_which_presets_fit_this_machine() -> None:
    found = cost.of_presets(DEMO, 1)
    needs, disk = found["default"].memory_bytes, found["default"].written_bytes
    enough = cost.in_words(found, needs, "cpu", disk)
    assert f"fits into the {in_words(needs)} that are free" in next(line for line in enough if "default" in line)
    last = [line for line in enough if "suffice for" in line]
    assert len(last) == 1 and "default" in last[0] and "quality" not in last[0] and "paper" not in last[0]
    assert "does NOT fit" in next(line for line in cost.in_words(found, needs - 1) if "default" in line)
    text = "\n".join(cost.in_words(found, needs, "cpu", 10))
    assert "suffice for: none" in text and "NOT free here" in text


def test_the_probe_measures_this_machine_and_one_of_half_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    speed = probe.speed(2)
    assert 0.001 < speed.now <= speed.idle < 30
    clock = {"processor": 0.0}

    def one_pass(*_given: object) -> None:
        clock["processor"] += 2 * probe.REFERENCE_S

    monkeypatch.setattr(probe, "one_pass", one_pass)
    monkeypatch.setattr("time.process_time", lambda: clock["processor"])
    monkeypatch.setattr("time.perf_counter", lambda: 2 * clock["processor"])
    assert probe.speed() == pytest.approx((0.25, 0.5))


def test_doctor_says_what_every_preset_takes(tmp_path: Path) -> None:
    report = diagnosis.report_scene(toy_views.write_scene(tmp_path / "scene", lidar=True))
    for name in ("fast", "default", "quality", "paper"):
        assert f"--preset {name}" in report["text"]
        preset = report["presets"]["cpu"][name]
        assert preset["memory_bytes"] > 0 and preset["written_bytes"] > 0
    for step in report["presets"]["cpu"]["default"]["seconds"]:
        assert f"    {step} " in report["text"]
    (tmp_path / "empty").mkdir()
    broken = diagnosis.report_scene(tmp_path / "empty")
    assert broken["presets"] == {}
    assert "--preset" not in broken["text"]


@pytest.mark.slow
def test_a_real_run_is_forecast(tmp_path: Path) -> None:
    """Processor seconds, memory and bytes of the whole; the clock of a shared machine says little."""
    command = [sys.executable, "-m", "mudg", *"run city --preset fast --quiet --out".split(), str(tmp_path / "out")]
    # a process of its own: what earlier tests took would count
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    steps = store.read_json(tmp_path / "out" / "run.json")["steps"]
    found = cost.estimate(run_preset("fast"), FAST, native.default_threads(), probe.speed().idle)
    taken = [steps[name] for name in found.seconds]
    processor_s = sum(value or 0.0 for value in found.processor_s.values())
    assert 0.5 < processor_s / sum(step["processor_s"] for step in taken) < 2
    assert 0.5 < found.written_bytes / sum(step["written_bytes"] for step in taken) < 2
    assert 0.5 < found.memory_bytes / max(step["peak_bytes"] for step in taken) < 2
