"""Configuration: presets < YAML < flags; unknown keys are refused with the nearest name."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base import config
from mudg.base.errors import InputError, UsageError


@dataclass(frozen=True, kw_only=True, config=config.STRICT)
class Inner:
    iterations: int = Field(default=10, ge=1)


@dataclass(frozen=True, kw_only=True, config=config.STRICT)
class Outer:
    seed: int = 0
    inner: Inner = Inner()


def test_precedence(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("seed: 2\ninner: {iterations: 20}\n")
    preset = Outer(seed=1, inner=Inner(iterations=15))
    assert config.load(Outer, preset) == preset
    assert config.load(Outer, preset, tmp_path / "c.yaml") == Outer(seed=2, inner=Inner(iterations=20))
    assert config.load(Outer, preset, tmp_path / "c.yaml", {"inner": {"iterations": 30}}).inner.iterations == 30


def test_dumped_yaml_loads_to_an_equal_configuration(tmp_path: Path) -> None:
    original = Outer(seed=7, inner=Inner(iterations=3))
    (tmp_path / "c.yaml").write_text(config.dump_yaml(original))
    assert config.load(Outer, None, tmp_path / "c.yaml") == original


def test_unknown_key_suggests_the_nearest_name(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("inner: {itertions: 20}\n")
    with pytest.raises(UsageError, match=r"inner\.iterations"):
        config.load(Outer, None, tmp_path / "c.yaml")


@pytest.mark.parametrize("text", ["inner: {iterations: 0}", "inner: {iterations: many}", "seed: [1]"])
def test_wrong_values_name_the_field(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(UsageError, match="iterations|seed"):
        config.load(Outer, None, tmp_path / "c.yaml")


@pytest.mark.parametrize("text", ["a: [", "- 1", "!!python/object/apply:os.system ['true']"])
def test_malformed_or_hostile_yaml_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(InputError):
        config.load(Outer, None, tmp_path / "c.yaml")


def test_configurations_are_frozen() -> None:
    with pytest.raises((AttributeError, TypeError)):
        Outer().seed = 3  # type: ignore[misc]
