"""Forecasts of time, memory and bytes: monotone, honest about what was not measured, near what was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest

from mudg.base import store
from mudg.stages.config import RunConfig, cost, run_preset
from mudg.steps.run import Demo, Run
from mudg.steps.step import texts_of

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


class Ledger(NamedTuple):
    """A run that was measured: `tests/ledgers/*.json`, from the ``run.json`` of each. Per step what was noted: ``seconds`` on an
    undisturbed machine, ``processor_s``, ``memory_mb``, ``written_mb``."""

    about: str
    config: RunConfig
    size: cost.SceneSize
    machine: cost.Machine
    steps: Mapping[str, Mapping[str, float]]


def read_ledger(path: Path) -> Ledger:
    found = store.read_json(path)
    config = settings(found["preset"], found["iterations"], tuple(found["shifts_m"]), found["denoising_steps"])
    virtual = replace(config.fit.virtual, half_size=found.get("half_size", 0.0))  # older runs knew no other
    config = replace(config, fit=replace(config.fit, virtual=virtual))
    machine = cost.Machine(found["cores"], 1.0, found["processors"])
    return Ledger(found["about"], config, cost.SceneSize(**found["size"]), machine, found["steps"])


LEDGERS = sorted((Path(__file__).parent / "ledgers").glob("*.json"))
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


def test_views_count_as_a_fit_keeps_and_halves_them() -> None:
    from mudg.stages.fitting import halved, kept

    assert cost.VIEWS_BYTES == kept.IN_MEMORY_BYTES
    assert cost.HALVED_PX == halved.LEAST_PX


def test_virtual_views_of_half_the_size_take_less_time() -> None:
    """A fit of 1,000 steps that went on at 384x256 took 156 s of processor time, and 120 s with all virtual views at half their size."""

    def forecast(half_size: float, size: cost.SceneSize = DEMO) -> float:
        config = run_preset()
        config = replace(config, fit=replace(config.fit, virtual=replace(config.fit.virtual, half_size=half_size)))
        found = cost.estimate(config, size, cost.Machine(1)).steps["fit with diffusion"].processor_s
        assert found is not None
        return found

    assert forecast(0.9) / forecast(0.0) == pytest.approx(120 / 156, rel=0.15)
    assert forecast(0.9) < forecast(0.8) < forecast(0.5) == forecast(0.0)
    assert forecast(0.9, FAST) == forecast(0.0, FAST), "these views are too small"


@pytest.mark.parametrize("path", LEDGERS, ids=lambda path: path.stem)
def test_measured_runs_are_forecast_within_the_stated_factor(path: Path) -> None:
    """Every step: seconds, processor seconds, memory and bytes."""
    run = read_ledger(path)
    found = cost.estimate(run.config, run.size, run.machine).steps
    assert run.steps and set(run.steps) <= set(found)
    wrong = []
    for step, measured in run.steps.items():
        forecast = found[step]
        pairs = (
            ("seconds", forecast.seconds, SLACK_S),
            ("processor_s", forecast.processor_s, SLACK_S),
            ("memory_mb", forecast.memory_bytes / 1e6, 0.0),
            ("written_mb", forecast.written_bytes / 1e6, SLACK_MB),
        )
        for what, said, slack in pairs:
            was = measured.get(what)
            if was is not None and not 1 / cost.FACTOR < ((said or 0) + slack) / (was + slack) < cost.FACTOR:
                wrong.append(f"{step}: {what} {said:.2f}, measured {was:.2f}")
    assert not wrong


def test_what_the_flags_promise_of_fast_is_what_is_forecast_and_was_measured() -> None:
    """`mudg run --fast`: one to two minutes on two cores for 16 frames; of the demo: about a minute."""
    path = Path(__file__).parent / "ledgers" / "kitti_fast.json"
    run, measured_s = read_ledger(path), store.read_json(path)["all_steps_processor_s"]
    found = cost.estimate(run.config, run.size, run.machine)
    assert found.total_s is not None and 60 / cost.FACTOR < found.total_s < 120 * cost.FACTOR
    assert 1 / cost.FACTOR < sum(step.processor_s or 0 for step in found.steps.values()) / measured_s < cost.FACTOR
    demo = cost.estimate(run_preset("fast"), FAST, cost.Machine(2)).total_s
    assert demo is not None and 60 / cost.FACTOR < demo < 60 * cost.FACTOR
    assert "One to two minutes on 2 cores" in texts_of(Run)["fast"] and "about a minute on 2 cores" in texts_of(Demo)["fast"]
