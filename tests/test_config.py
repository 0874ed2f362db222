"""Configuration: presets < YAML < flags; unknown keys are refused with the nearest name."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path

import pytest
from pydantic import ValidationError

from mudg.base import config
from mudg.base.errors import UsageError
from mudg.editing.settings import RenderConfig


@config.settings
class Inner:
    iterations: int = config.setting(default=10, ge=1)


@config.settings
class Outer:
    seed: int = 0
    inner: Inner = Inner()


def test_precedence_and_a_dump_loads_to_an_equal_configuration(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("seed: 2\ninner: {iterations: 20}\n")
    preset = Outer(seed=1, inner=Inner(iterations=15))
    assert config.load(Outer, preset) == preset
    assert config.load(Outer, preset, tmp_path / "c.yaml") == Outer(seed=2, inner=Inner(iterations=20))
    assert config.load(Outer, preset, tmp_path / "c.yaml", {"inner": {"iterations": 30}}).inner.iterations == 30
    original = Outer(seed=7, inner=Inner(iterations=3))
    (tmp_path / "c.yaml").write_text(config.dump_yaml(original))
    assert config.load(Outer, None, tmp_path / "c.yaml") == original


@pytest.mark.parametrize("number", [".nan", ".inf", "-.inf"])
def test_no_number_of_any_verb_may_be_nan_or_infinite(tmp_path: Path, number: str) -> None:
    (tmp_path / "c.yaml").write_text(f"shifts_m: [2, {number}]")
    with pytest.raises(UsageError, match=r"shifts_m[\s\S]*finite"):
        config.load(RenderConfig, None, tmp_path / "c.yaml")


@config.settings
class Wheels:
    kind: str = "steel"
    count: int = 4


def test_differences_tell_values_from_settings_of_another_version():
    old = {"steps": 3, "loss": {"ssim": 0.2}, "far_m": 1.0, "kind": "a", "wide": 1, "tall": 2}
    first, second = config.differences(old, {"steps": 4, "loss": {"ssim": 0.2}, "kind": {"name": "a"}})
    assert "far_m, kind, tall and 1 more" in first and second == "steps: 3 there, 4 asked"
    assert config.differences({"a": {"b": 1}}, {"a": {"b": 2}}) == ["a.b: 1 there, 2 asked"]
    assert config.differences(old, old) == []


def test_values_are_checked_where_a_configuration_is_made_of_them():
    with pytest.raises((AttributeError, TypeError)):
        Wheels().count = 3
    for wrong in ({"count": "many"}, {"colour": "red"}):
        with pytest.raises(ValidationError, match="1 validation error for Wheels"):
            Wheels(**wrong)
    assert dataclasses.replace(Wheels(count=2), kind="wood") == Wheels(kind="wood", count=2)
    with pytest.raises(ValidationError):
        dataclasses.replace(Wheels(), count=None)
    assert config.changed(Wheels(), {"count": 5}) == Wheels(count=5) != Wheels()
    assert pickle.loads(pickle.dumps(Wheels(count=3))) == Wheels(count=3)
