"""Frozen configuration: presets < YAML file < flags, unknown keys refused with the nearest name."""

from __future__ import annotations

import copy
import dataclasses
import functools
import typing
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar, dataclass_transform

from mudg.base.errors import InputError, UsageError, nearest

if TYPE_CHECKING:
    from pydantic import ConfigDict, GetCoreSchemaHandler, TypeAdapter
    from pydantic_core import CoreSchema

Config = TypeVar("Config")

STRICT: Final[ConfigDict] = {"extra": "forbid", "allow_inf_nan": False}
"""For pydantic: unknown names are refused, and numbers that are NaN or infinite."""


def setting(*, default: Any = dataclasses.MISSING, default_factory: Any = dataclasses.MISSING, **limits: Any) -> Any:
    """A field of ``settings`` with a default and limits, as ``ge=0``."""
    return dataclasses.field(default=default, default_factory=default_factory, metadata=limits)


class Limits:
    """Limits inside of the type of a setting: ``tuple[Annotated[int, Limits(ge=1)], ...]``."""

    def __init__(self, **limits: Any) -> None:
        self.limits = limits

    def __repr__(self) -> str:
        return f"Limits({', '.join(f'{name}={value!r}' for name, value in self.limits.items())})"

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return {**handler(source), **self.limits}  # type: ignore[return-value]


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(setting,))
def settings(cls: type[Config]) -> type[Config]:
    """Make a class a frozen dataclass whose values pydantic checks, all but those of ``Class()`` and of ``changed``.
    pydantic is imported at the first check. A default that is itself a configuration is a ``default_factory``."""
    config_type: Any = dataclasses.dataclass(frozen=True, kw_only=True)(cls)
    with_defaults: Callable[[Any], None] = config_type.__init__

    @functools.wraps(with_defaults)
    def checked(self: Any, *args: Any, **values: Any) -> None:
        if not args and not values:
            with_defaults(self)
            return
        from pydantic_core import ArgsKwargs

        _adapter(type(self)).validator.validate_python(ArgsKwargs(args, values), self_instance=self)

    config_type.__init__, config_type.__pydantic_config__ = checked, STRICT
    return config_type


@functools.cache
def _adapter(config_type: type[Config]) -> TypeAdapter[Config]:
    from pydantic import TypeAdapter

    return TypeAdapter(config_type)


def changed(config: Config, values: Mapping[str, Any]) -> Config:
    """A configuration with other values, which are those of this program and are not checked."""
    other = copy.copy(config)
    vars(other).update(values)
    return other


def to_dict(config: Any) -> dict[str, Any]:
    """A configuration as plain JSON values, in the order of its settings."""
    return {field.name: _plain(getattr(config, field.name)) for field in dataclasses.fields(config)}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def result_settings(config: Any) -> dict[str, Any]:
    """What a result depends on: ``to_dict`` without every ``device``: on another device it is reused or resumed."""
    return without_devices(to_dict(config))


def without_devices(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as JSON values without every ``device``, at any depth."""
    rest = {name: value for name, value in values.items() if name != "device"}
    return {name: without_devices(value) if isinstance(value, Mapping) else value for name, value in rest.items()}


def dump_yaml(config: Any) -> str:
    """A configuration as YAML text that ``load`` reads back to an equal configuration."""
    import yaml

    return yaml.safe_dump(to_dict(config), sort_keys=False)


def load(
    config_type: type[Config],
    preset: Config | None = None,
    yaml_path: Path | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Config:
    """A configuration from a preset (or the type's defaults), then a YAML file, then nested overrides. UsageError:
    unknown key (the nearest is suggested), wrong type or range. InputError: the file is missing or malformed."""
    usual = config_type() if preset is None else preset
    if yaml_path is None and not overrides:
        return usual
    values = to_dict(usual)
    if yaml_path is not None:
        from mudg.base import store  # late, with its numpy: --help needs neither
        from mudg.base.plain_yaml import parse_yaml

        where = str(yaml_path)
        content = {} if (found := parse_yaml(store.read_bytes(yaml_path), where)) is None else found
        if not isinstance(content, dict):
            raise InputError("a configuration file holds keys and values", where=where, got=type(content).__name__)
        content.pop("verb", None)
        values = _merge(values, content, where, config_type)
    if overrides:
        values = _merge(values, overrides, "flags", config_type)
    from pydantic import ValidationError

    from mudg.base.records import first_problem

    try:
        return _adapter(config_type).validate_python(values)
    except ValidationError as error:
        path = ".".join(str(part) for part in error.errors(include_url=False)[0]["loc"])
        problem = first_problem(error, f"{yaml_path or 'configuration'}: ", UsageError)
        if any(f"{name}.".startswith(f"{path}.") or path.startswith(f"{name}.") for name in dotted(overrides or {})):
            problem = problem.located(f"--{path.replace('_', '-')}")
        raise problem from error


def dotted(values: Mapping[str, Any], path: str = "") -> Iterator[str]:
    """Names of nested values, as ``virtual.start``."""
    for name, value in values.items():
        yield from dotted(value, f"{path}{name}.") if isinstance(value, Mapping) else (f"{path}{name}",)


def nested(dotted: Mapping[str, Any]) -> dict[str, Any]:
    """Keys such as ``virtual.start`` as mappings in mappings; UsageError if a name is both a value and a group."""
    tree: dict[str, Any] = {}
    for key, value in dotted.items():
        *groups, name = key.split(".")
        place = tree
        for group in groups:
            place = place.setdefault(group, {})
            if not isinstance(place, dict):
                raise UsageError("a configuration key is both a value and a group", where=key)
        place[name] = value
    return tree


def build(config_type: type[Config], values: Mapping[str, Any], where: str) -> Config:
    """Validate plain values as a ``config_type``; UsageError names the first wrong field."""
    from pydantic import ValidationError

    from mudg.base.records import first_problem

    try:
        return _adapter(config_type).validate_python(values)
    except ValidationError as error:
        raise first_problem(error, f"{where}: ", UsageError) from error


def _merge(base: dict[str, Any], new: Mapping[str, Any], where: str, kind: Any, path: str = "") -> dict[str, Any]:
    hints = typing.get_type_hints(kind) if dataclasses.is_dataclass(kind) else {}
    known = {field.name: hints[field.name] for field in dataclasses.fields(kind)} if hints else {}
    merged = dict(base)
    for name, value in new.items():
        group = known.get(name)
        is_group, is_mapping = dataclasses.is_dataclass(group), isinstance(value, Mapping)
        if known and name not in known:
            near = nearest(name, known, 0.5)
            what, expected = f"unknown configuration key {path}{name}", "one of " + ", ".join(known)
            remedy = f"did you mean {path}{near}?" if near else "remove it"
            if str(name).split(".")[0] in known and "." in str(name):
                group_text = str(name).replace(".", ": {") + ": ..." + "}" * str(name).count(".")
                remedy = f"write each part before a dot as a group: {group_text}"
            raise UsageError(what, where=where, expected=expected, remedy=remedy)
        if is_group and is_mapping and isinstance(base.get(name), Mapping):
            merged[name] = _merge(base[name], value, where, group, f"{path}{name}.")
        else:
            merged[name] = value
    return merged


def differences(old: Any, new: Any) -> list[str]:
    """What two nested configurations differ in, one ``a.b: x there, y asked`` per value; settings that only one of them
    has (another version named them differently) are counted in one line, which comes first."""
    values, lonely = list[str](), list[str]()

    def collect(old: Any, new: Any, path: str) -> None:
        if isinstance(old, dict) and isinstance(new, dict):
            for name in sorted(old.keys() | new.keys(), key=str):
                inside = f"{path}.{name}".lstrip(".")
                if name not in old or name not in new or isinstance(old[name], dict) != isinstance(new[name], dict):
                    lonely.append(inside)
                else:
                    collect(old[name], new[name], inside)
        elif old != new:
            values.append(f"{path}: {old!r} there, {new!r} asked")

    collect(old, new, "")
    if not lonely:
        return values
    named = ", ".join(lonely[:3]) + (f" and {len(lonely) - 3} more" if len(lonely) > 3 else "")
    return [f"settings that only one of the two has, as after a change of version: {named}", *values]
