"""Configuration: presets < YAML < flags; unknown keys are refused with the nearest name."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import pytest
from pydantic import Field
from pydantic.dataclasses import dataclass

from mudg.base import config
from mudg.base.errors import InputError, UsageError
from mudg.stages.config import BenchConfig, FuseConfig, RenderConfig, SynthesizeConfig


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


@pytest.mark.parametrize("number", [".nan", ".inf", "-.inf"])
def test_no_number_of_any_verb_may_be_nan_or_infinite(tmp_path: Path, number: str) -> None:
    (tmp_path / "c.yaml").write_text(f"shifts_m: [2, {number}]")
    with pytest.raises(UsageError, match=r"shifts_m[\s\S]*finite"):
        config.load(RenderConfig, None, tmp_path / "c.yaml")


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


@dataclass(frozen=True, kw_only=True, config=config.STRICT)
class Wheels:
    kind: str = "steel"
    count: int = 4


@dataclass(frozen=True, kw_only=True, config=config.STRICT)
class Cart:
    MOVED: ClassVar = {"wheel_count": "wheels.count", "wheels": "wheels.kind", "horn": None}
    wheels: Wheels = Field(default_factory=Wheels)


@dataclass(frozen=True, kw_only=True, config=config.STRICT)
class Fleet:
    cart: Cart = Field(default_factory=Cart)


def test_keys_that_moved_are_refused_with_their_new_name(tmp_path):
    for text, said in (
        ("wheel_count: 3", "wheel_count is now called wheels.count"), ("wheels: wood", "wheels is now called wheels.kind"),
        ("horn: true", "horn was removed"),
    ):  # fmt: skip
        (tmp_path / "old.yaml").write_text(text + "\n")
        with pytest.raises(UsageError, match=said):
            config.load(Cart, yaml_path=tmp_path / "old.yaml")
    with pytest.raises(UsageError, match=r"cart\.wheel_count is now called cart\.wheels\.count"):
        config.load(Fleet, overrides={"cart": {"wheel_count": 3}})
    with pytest.raises(UsageError, match="3 configuration keys") as several:
        config.load(Fleet, overrides={"cart": {"horn": True, "wheels": "wood", "wheel_count": 3}})
    listed = ("cart.wheels -> cart.wheels.kind", "cart.wheel_count -> cart.wheels.count", "leave out:", "cart.horn")
    assert [line.strip() for line in several.value.remedy.splitlines()[1:]] == list(listed)
    assert config.load(Cart, overrides={"wheels": {"count": 3}}) == Cart(wheels=Wheels(count=3))
    assert "MOVED" not in config.dump_yaml(Cart())


def test_settings_of_older_versions_are_refused_by_every_command_that_had_them():
    for kind, old in (
        (SynthesizeConfig, "strength"),
        (BenchConfig, "ablation_steps"),
        (FuseConfig, "colour_from_held_out"),
    ):
        with pytest.raises(UsageError, match=f"configuration key {old} (was removed|is now called)"):
            config.load(kind, overrides={old: 1})


def test_differences_tell_values_from_settings_of_another_version():
    old = {"steps": 3, "loss": {"ssim": 0.2}, "far_m": 1.0, "kind": "a", "wide": 1, "tall": 2}
    first, second = config.differences(old, {"steps": 4, "loss": {"ssim": 0.2}, "kind": {"name": "a"}})
    assert "far_m, kind, tall and 1 more" in first and second == "steps: 3 there, 4 asked"
    assert config.differences({"a": {"b": 1}}, {"a": {"b": 2}}) == ["a.b: 1 there, 2 asked"]
    assert config.differences(old, old) == []
