"""Presets of run and demo: what they hold, precedence, refusals, the same from Python."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest
from refusals import refused

import mudg
from mudg import app
from mudg.base import config as configuration
from mudg.base.errors import UsageError
from mudg.steps import pipeline
from mudg.steps.run import Run
from mudg.steps.settings import DEMO_CITY, PRESETS, PresetName, RunConfig, run_preset, with_seed

NAMES = get_args(PresetName)


def value_of(config: Any, key: str) -> Any:
    for part in key.split("."):
        config = getattr(config, part)
    return config


def words(*more: str) -> Any:
    return app.parse(["run", "city", "--out", "x", *more])[0].settings


@pytest.mark.parametrize("name", NAMES)
def test_a_preset_is_its_row_over_the_defaults(name: PresetName) -> None:
    config = run_preset(name)
    for key, value in PRESETS[name].items():
        assert value_of(config, key) == value, key
    back = configuration.load(RunConfig, None, None, configuration.to_dict(config))  # every value passes its check
    assert back == config
    assert config.ingest.city.seed == DEMO_CITY
    assert config.synthesize.cameras == config.render.cameras == ()
    assert words("--preset", name) == config


def test_fast_is_a_name_for_a_preset_and_default_is_the_default() -> None:
    assert words("--fast") == words("--preset", "fast") == words("--fast", "--preset", "fast") == run_preset("fast")
    assert words() == words("--preset", "default") == run_preset()
    assert app.parse(["demo", "--preset", "quality"])[0].settings == run_preset("quality")
    for other in set(NAMES) - {"fast"}:
        refused("another name of --preset fast", words, "--fast", "--preset", other, raises=UsageError)
    refused("no such preset", run_preset, "best", raises=UsageError)


def test_defaults_then_preset_then_file_then_flags(tmp_path: Path) -> None:
    file = tmp_path / "settings.yaml"
    file.write_text("fit:\n  iterations: 77\n  sh_degree: 2\n")
    made = words("--preset", "paper", "--config", str(file), "--fit.sh-degree", "1")
    assert (made.fit.iterations, made.fit.sh_degree, made.synthesize.steps) == (77, 1, 50)
    assert made.fit.checkpoint_every != RunConfig().fit.checkpoint_every


@pytest.mark.parametrize("name", NAMES)
def test_the_run_yaml_of_a_preset_gives_it_back_under_any_preset(name: PresetName, tmp_path: Path) -> None:
    before = words("--preset", name, "--seed", "5")
    file = tmp_path / "run.yaml"
    file.write_text(configuration.dump_yaml(before))
    assert words("--config", str(file)) == words("--preset", "paper", "--config", str(file)) == before


def test_paper_needs_a_published_model_and_lpips_before_anything_is_written(tmp_path: Path) -> None:
    out, paper = tmp_path / "out", run_preset("paper")
    refused("published-type diffusion model", Run(source="city", out=out, settings=paper).run, raises=UsageError)
    refused("published-type diffusion model", mudg.run, "city", out=out, preset="paper", raises=UsageError)
    weights = replace(paper.fit, virtual=replace(paper.fit.virtual, lpips_weights=str(tmp_path / "lpips.safetensors")))
    other = replace(paper, fit=weights, synthesize=replace(paper.synthesize, model="embedded"))
    refused("published-type models only", Run(source="city", out=out, settings=other).run, raises=UsageError)
    without = replace(paper, fit=weights, synthesize=replace(paper.synthesize, model=str(tmp_path / "none")))
    refused("no diffusion model here", Run(source="city", out=out, settings=without).run)
    with pytest.raises(UsageError, match="LPIPS needs a weight file"):
        mudg.run("city", out=out, preset="paper", synthesize={"model": "embedded"})
    assert not out.exists()


def test_the_same_presets_from_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[RunConfig] = []
    monkeypatch.setattr(pipeline, "run_chain", lambda config, *_args, **_named: seen.append(config) or {})
    mudg.run("city", out=tmp_path, preset="quality", fit={"iterations": 9})
    mudg.run("city", out=tmp_path, fast=True)
    mudg.run("city", out=tmp_path, seed=4)
    assert seen[0] == replace(run_preset("quality"), fit=replace(run_preset("quality").fit, iterations=9))
    assert seen[1] == run_preset("fast")
    assert seen[2] == with_seed(run_preset(), 4)
    with pytest.raises(UsageError, match="another name of --preset fast"):
        mudg.run("city", out=tmp_path, preset="paper", fast=True)
