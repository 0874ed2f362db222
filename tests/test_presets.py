"""Presets of run and demo: what they hold, precedence, refusals, the same from Python."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
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
    run = partial(mudg.run, "city", out=out, preset="paper")
    refused("published-type diffusion model", run, raises=UsageError)
    refused("LPIPS needs a weight file", run, synthesize={"model": "embedded"}, raises=UsageError)
    fit = {"virtual": {"lpips_weights": str(tmp_path / "lpips.safetensors")}}
    refused("published-type models only", run, fit=fit, synthesize={"model": "embedded"}, raises=UsageError)
    refused("no diffusion model here", run, fit=fit, synthesize={"model": str(tmp_path / "none")})
    assert not out.exists()


def test_the_same_presets_from_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[RunConfig] = []
    monkeypatch.setattr(pipeline, "run_chain", lambda config, *_args, **_named: seen.append(config) or {})
    for given in ({"preset": "quality", "fit": {"iterations": 9}}, {"fast": True}, {"seed": 4}):
        mudg.run("city", out=tmp_path, **given)
    quality = run_preset("quality")
    changed = replace(quality, fit=replace(quality.fit, iterations=9))
    assert seen == [changed, run_preset("fast"), with_seed(run_preset(), 4)]
    named = {"preset": "paper", "fast": True}
    refused("another name of --preset fast", mudg.run, "city", out=tmp_path, **named, raises=UsageError)
