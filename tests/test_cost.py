"""Forecasts of time, memory and bytes: monotone, honest about what was not measured, near what was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
import toy_views

from mudg import native, verbs
from mudg.base import store
from mudg.core.raster import probe
from mudg.stages import doctor
from mudg.stages.config import RunConfig, cost, run_preset

DEMO = cost.SceneSize(images=72, path_images=24, width=384, height=256, points=100_600)
"""What `mudg demo` makes."""
FAST = cost.SceneSize(images=12, path_images=12, width=240, height=160, points=100_600)
TWO_CAMERAS = cost.SceneSize(images=16, path_images=8, width=320, height=208, points=100_600)
SMALL = cost.SceneSize(images=6, path_images=6, width=120, height=80, points=100_600)


def settings(preset: cost.PresetName, iterations: int = 0, shifts_m: tuple[float, ...] = (), steps: int = 1) -> RunConfig:
    config = run_preset(preset)
    if iterations:  # of a run of its own
        config = replace(config, fit=replace(config.fit, iterations=iterations), synthesize=replace(config.synthesize, steps=steps))
    if shifts_m:
        made, shown = replace(config.synthesize, shifts_m=shifts_m), replace(config.render, shifts_m=(0.0, *shifts_m))
        config = replace(config, synthesize=made, render=shown)
    return config


class Measured(NamedTuple):
    """What one step of a run took; None: not noted then."""

    seconds: float | None
    processor_s: float | None = None
    memory_mb: float | None = None
    written_mb: float | None = None


class Run(NamedTuple):
    """A run that was measured. ``machine.speed`` is 1 on an undisturbed machine; of processor seconds it is that of the cores alone."""

    name: str
    config: RunConfig
    size: cost.SceneSize
    machine: cost.Machine
    steps: Mapping[str, Measured]


RUNS = (
    Run("demo --fast on one core", settings("fast"), FAST, cost.Machine(1, 1.0, 2), {
        "fuse": Measured(0.51, 0.49, 343, 2.55), "fit without diffusion": Measured(16.8, 16.56, 678, 15.79),
        "synthesize": Measured(46.9, 43.81, 2657, 32.3), "fit with diffusion": Measured(19.7, 19.39, 880, 16.59),
        "render without diffusion": Measured(4.9, 4.72, 837, 32.16), "render with diffusion": Measured(5.5, 5.26, 837, 31.91),
        "score": Measured(26.3, 25.7, 945, 65.58), "viewer": Measured(0.56, 0.53, 935, 3.14), "report": Measured(4.4, 4.31, 941, 3.08),
    }),
    Run("the same, interrupted and resumed, while others used the core: no seconds", settings("fast"), FAST, cost.Machine(1, 1.0, 2), {
        "fuse": Measured(None, 0.48, 367, 2.55), "fit without diffusion": Measured(None, 17.86, 692, 15.79),
        "synthesize": Measured(None, 44.8, 2437, 32.31), "fit with diffusion": Measured(None, 21.84, 899, 16.59),
        "render without diffusion": Measured(None, 5.44, 811, 32.16), "render with diffusion": Measured(None, 4.92, 811, 31.91),
        "score": Measured(None, 27.88, 549, 65.58), "viewer": Measured(None, 0.61, 556, 3.14), "report": Measured(None, 4.1, 607, 3.08),
    }),
    Run("6 frames of 120x80, 200 iterations, the same way", settings("default", 200, (2.0, -2.0)), SMALL, cost.Machine(1, 1.0, 2), {
        "fuse": Measured(None, 0.3, 352, 1.32), "fit without diffusion": Measured(None, 7.7, 538, 8.9),
        "synthesize": Measured(None, 12.7, 1565, 2.7), "fit with diffusion": Measured(None, 8.3, 630, 9.5),
        "render without diffusion": Measured(None, 0.6, 634, 1.8), "render with diffusion": Measured(None, 0.6, 634, 1.8),
        "score": Measured(None, 3.0, 669, 3.9), "viewer": Measured(None, 0.3, 654, 1.9), "report": Measured(None, 0.3, 675, 0.4),
    }),
    Run("8 frames of two cameras, 320x208, 120 iterations, two denoising steps", settings("default", 120, (3.0,), steps=2), TWO_CAMERAS,
        cost.Machine(1, 1.0, 2), {
        "fuse": Measured(None, 2.77, 367, 3.24), "fit without diffusion": Measured(None, 11.13, 653, 15.37),
        "synthesize": Measured(None, 7.7, 1209, 6.29), "fit with diffusion": Measured(None, 12.86, 1115, 15.44),
        "render without diffusion": Measured(None, 1.58, 1120, 10.23), "render with diffusion": Measured(None, 1.6, 1120, 10.19),
        "score": Measured(None, 8.5, 1223, 21.63), "viewer": Measured(None, 0.62, 1176, 3.01), "report": Measured(None, 1.57, 1243, 0.92),
    }),
    Run("synthesize of the demo's scene, two trajectories", settings("default", shifts_m=(2.0, -2.0)), DEMO, cost.Machine(1, 1.0, 2), {
        "synthesize": Measured(None, 59.55, 2738, 48.02),
    }),
    Run("demo --fast on two cores", settings("fast"), FAST, cost.Machine(2), {
        "fuse": Measured(0.64), "fit without diffusion": Measured(14.4), "synthesize": Measured(22.4),
        "fit with diffusion": Measured(14.3),
        "render without diffusion": Measured(4.8), "render with diffusion": Measured(5.0), "score": Measured(16.8), "viewer": Measured(0.5),
        "report": Measured(2.5),
    }),
    Run("demo on two cores", settings("default"), DEMO, cost.Machine(2), {
        "fuse": Measured(7.2, written_mb=12.6), "fit without diffusion": Measured(57.8, written_mb=17.1),
        "synthesize": Measured(84.2, written_mb=144.3), "fit with diffusion": Measured(79.3, written_mb=16.9),
        "render without diffusion": Measured(16.8, written_mb=158.5), "render with diffusion": Measured(15.6, written_mb=157.7),
        "score": Measured(65.8, written_mb=321.7), "viewer": Measured(1.5, written_mb=4.0), "report": Measured(13.4, written_mb=21.0),
    }),
    Run("demo on two cores, on another day", settings("default"), DEMO, cost.Machine(2), {
        "fuse": Measured(5.3), "fit without diffusion": Measured(45.5), "synthesize": Measured(66.0), "fit with diffusion": Measured(77.5),
        "render without diffusion": Measured(14.9), "render with diffusion": Measured(16.3), "score": Measured(59.7),
        "report": Measured(12.2),
    }),
)  # fmt: skip
"""From the records of runs. Rows without memory are of a version that noted seconds alone, their bytes those of the folders; where only
processor seconds stand, pages that child processes share with their parent were counted once."""
SLACK_S = 1.0
SLACK_MB = 0.5
"""Steps of less than this are all start and no work."""


def total(size: cost.SceneSize = DEMO, *, iterations: int = 1000, steps: int = 2, cores: int = 2) -> float:
    config = run_preset()
    config = replace(
        config, fit=replace(config.fit, iterations=iterations), synthesize=replace(config.synthesize, steps=steps)
    )
    found = cost.estimate(config, size, cost.Machine(cores)).total_s
    assert found is not None
    return found


def test_more_of_anything_takes_longer_and_more_cores_less() -> None:
    usual = total()
    assert total(replace(DEMO, images=144)) > usual
    assert total(replace(DEMO, path_images=48)) > usual
    assert total(replace(DEMO, width=768)) > usual
    assert total(iterations=2000) > usual
    assert total(steps=8) > usual
    assert total(cores=1) > usual > total(cores=4)


def test_a_faster_machine_takes_less_and_the_same_memory() -> None:
    slow, fast = (cost.estimate(run_preset(), DEMO, cost.Machine(2, speed)) for speed in (1.0, 2.0))
    assert slow.total_s is not None and slow.total_s == pytest.approx(2 * (fast.total_s or 0))
    assert slow.memory_bytes == fast.memory_bytes and slow.written_bytes == fast.written_bytes


def test_more_pixels_images_and_gaussians_take_more_memory() -> None:
    config = run_preset("quality")
    one = cost.Machine(1)

    def fitting(config: RunConfig, size: cost.SceneSize) -> int:
        return cost.estimate(config, size, one).steps["fit with diffusion"].memory_bytes

    usual = fitting(config, DEMO)
    assert fitting(config, replace(DEMO, width=3840)) > usual
    assert fitting(config, replace(DEMO, images=7200)) > usual
    wider = replace(config, fit=replace(config.fit, sh_degree=3))
    large = replace(DEMO, images=7200)
    assert fitting(wider, large) > fitting(config, large)
    smaller = replace(config, fit=replace(config.fit, width_px=192))
    assert fitting(smaller, large) < fitting(config, large)
    assert cost.estimate(config, replace(DEMO, width=768), one).memory_bytes > cost.estimate(config, DEMO, one).memory_bytes


@pytest.mark.parametrize("change", [{"images": 144}, {"path_images": 48}, {"width": 768}, {"points": 200_000}])
def test_more_of_anything_takes_more_of_the_disk(change: dict[str, int]) -> None:
    one = cost.Machine(1)
    usual, more = (cost.estimate(run_preset(), size, one).written_bytes for size in (DEMO, replace(DEMO, **change)))
    assert more > usual


def test_without_exact_truth_only_the_recorded_path_is_scored() -> None:
    city, log = (cost.estimate(run_preset(), replace(DEMO, exact=exact), cost.Machine(1)).steps["score"] for exact in (True, False))
    assert (log.processor_s or 0) < (city.processor_s or 0) and log.written_bytes < city.written_bytes


def test_views_count_as_a_fit_keeps_them() -> None:
    from mudg.stages.fitting import kept

    assert cost.VIEWS_BYTES == kept.IN_MEMORY_BYTES


@pytest.mark.parametrize("run", RUNS, ids=lambda run: run.name)
def test_measured_runs_are_forecast_within_the_stated_factor(run: Run) -> None:
    """Every step: seconds, processor seconds, memory and bytes."""
    found = cost.estimate(run.config, run.size, run.machine).steps
    assert set(run.steps) <= set(found)
    wrong = []
    for step, measured in run.steps.items():
        forecast = found[step]
        pairs = (
            ("seconds", forecast.seconds, measured.seconds, SLACK_S),
            ("processor seconds", forecast.processor_s, measured.processor_s, SLACK_S),
            ("memory", forecast.memory_bytes / 1e6, measured.memory_mb, 0.0),
            ("written", forecast.written_bytes / 1e6, measured.written_mb, SLACK_MB),
        )
        for what, said, was, slack in pairs:
            if was is not None and not 1 / cost.FACTOR < (said + slack) / (was + slack) < cost.FACTOR:
                wrong.append(f"{step}: {what} {said:.2f}, measured {was:.2f}")
    assert not wrong


def test_the_probe_measures_this_machine() -> None:
    speed = probe.speed(1, for_s=0.05)
    assert 0.01 < speed < 30


def test_the_probe_sees_a_machine_of_half_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = {"now": 0.0}

    def one_pass(*_given: object) -> None:
        clock["now"] += 2 * probe.REFERENCE_S

    monkeypatch.setattr(probe, "one_pass", one_pass)
    monkeypatch.setattr("time.perf_counter", lambda: clock["now"])
    assert probe.speed(1) == pytest.approx(0.5)
    assert probe.speed(2) == pytest.approx(0.5 * (1 - probe.SHARED / 2))


def test_a_step_of_the_benchmark_is_met() -> None:
    """82.4 ms at 75,000 Gaussians and 480x320 on one core (bench/README.md)."""
    assert 1e3 * (75_000 * cost.GAUSSIAN_STEP_S + 480 * 320 * cost.PIXEL_STEP_S) == pytest.approx(82.4, rel=0.1)


def test_what_was_not_measured_has_no_number() -> None:
    paper = cost.estimate(run_preset("paper"), DEMO, cost.Machine(2))
    assert paper.seconds["synthesize"] is None
    assert paper.total_s is None
    on_card = cost.estimate(run_preset(), DEMO, cost.Machine(2), "cuda")
    assert on_card.total_s is None
    assert on_card.memory_bytes > 0
    text = "\n".join(cost.in_words(cost.of_presets(DEMO, cost.Machine(2), "cuda"), 0, "cuda"))
    assert "time not measured" in text
    assert "fit into" not in text


def test_free_memory_decides_what_fits() -> None:
    found = cost.of_presets(DEMO, cost.Machine(1))
    needs = found["default"].memory_bytes
    text = cost.in_words(found, needs)
    assert "fits" in next(line for line in text if "default" in line)
    assert "does NOT fit" in next(line for line in cost.in_words(found, needs - 1) if "default" in line)


def test_doctor_says_what_every_preset_takes(tmp_path: Path) -> None:
    report = doctor.report_scene(toy_views.write_scene(tmp_path / "scene"))
    for name in ("fast", "default", "quality", "paper"):
        assert f"--preset {name}" in report["text"]
        preset = report["presets"]["cpu"][name]
        assert preset["memory_bytes"] == max(step["memory_bytes"] for step in preset["steps"].values()) > 0
        assert preset["written_bytes"] == sum(step["written_bytes"] for step in preset["steps"].values()) > 0
    for step in report["presets"]["cpu"]["default"]["steps"]:
        assert f"    {step} " in report["text"]
    broken = doctor.report_scene(tmp_path)
    assert broken["presets"] == {}
    assert "--preset" not in broken["text"]


@pytest.mark.slow
def test_a_real_run_is_forecast(tmp_path: Path) -> None:
    """Processor seconds, memory and bytes of every step; the clock of a shared machine says little."""
    verbs.run("city", tmp_path / "out", preset="fast")
    steps = store.read_json(tmp_path / "out" / "run.json")["steps"]
    cores = native.default_threads()
    found = cost.estimate(run_preset("fast"), FAST, cost.Machine(cores, probe.speed(cores)))
    for name, forecast in found.steps.items():
        measured = steps[name]
        assert forecast.written_bytes == pytest.approx(measured["written_bytes"], rel=0.5, abs=1e6), name
        assert 0.5 < forecast.memory_bytes / measured["peak_bytes"] < 2, name
    total_s = sum(step["processor_s"] for name, step in steps.items() if name != "ingest")
    forecast_s = sum(step.processor_s or 0 for step in found.steps.values())
    assert 0.5 < forecast_s / total_s < 2
