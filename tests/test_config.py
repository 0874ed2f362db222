"""Configuration: presets < YAML < flags; unknown keys are refused with the nearest name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import ClassVar

import pytest
import yaml

from mudg.base import config
from mudg.base.errors import InputError, UsageError
from mudg.editing.view_settings import RenderConfig


@config.settings
class Inner:
    iterations: int = config.setting(default=10, ge=1)


@config.settings
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


@config.settings
class Wheels:
    kind: str = "steel"
    count: int = 4


@config.settings
class Cart:
    RETIRED: ClassVar = {"horn": ("wheels", False), "bells": ("", [1, 2])}
    wheels: Wheels = config.setting(default_factory=Wheels)
    seats: int = 2


@config.settings
class Fleet:
    cart: Cart = config.setting(default_factory=Cart)


def test_settings_that_were_taken_out_stay_in_keys_and_files_with_their_one_value(tmp_path):
    before = {"cart": {"horn": False, "wheels": {"kind": "steel", "count": 4}, "seats": 2, "bells": [1, 2]}}
    assert json.dumps(config.to_dict(Fleet())) == json.dumps(before), "a result's key depends on the order, too"
    (tmp_path / "old.yaml").write_text(yaml.safe_dump(before))
    assert config.load(Fleet, yaml_path=tmp_path / "old.yaml") == config.build(Fleet, before, "record") == Fleet()
    assert config.load(Fleet, overrides={"cart": {"horn": False, "seats": 3}}) == Fleet(cart=Cart(seats=3))
    (tmp_path / "old.yaml").write_text("cart: {horn: true}")
    for refused in (
        lambda: config.load(Fleet, yaml_path=tmp_path / "old.yaml"),
        lambda: config.load(Fleet, overrides={"cart": {"bells": []}}),
        lambda: config.build(Fleet, {"cart": {"horn": 1}}, "record"),
    ):
        with pytest.raises(UsageError, match=r"the setting cart\.(horn|bells) was removed"):
            refused()


def test_differences_tell_values_from_settings_of_another_version():
    old = {"steps": 3, "loss": {"ssim": 0.2}, "far_m": 1.0, "kind": "a", "wide": 1, "tall": 2}
    first, second = config.differences(old, {"steps": 4, "loss": {"ssim": 0.2}, "kind": {"name": "a"}})
    assert "far_m, kind, tall and 1 more" in first and second == "steps: 3 there, 4 asked"
    assert config.differences({"a": {"b": 1}}, {"a": {"b": 2}}) == ["a.b: 1 there, 2 asked"]
    assert config.differences(old, old) == []
