"""Frozen configuration: presets < YAML file < flags, unknown keys refused with the nearest name.

A configuration class may say what became of keys that older files use: the class variable ``MOVED`` maps an old key to its new
dotted one, or to None if it was removed. Such keys are refused with that name; a group's own name may stand there too, for files in
which it was still a plain value.
"""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from mudg.base.errors import InputError, UsageError
from mudg.base.records import first_problem

Config = TypeVar("Config")

STRICT = ConfigDict(extra="forbid", defer_build=True)
"""Pass as ``@pydantic.dataclasses.dataclass(frozen=True, kw_only=True, config=STRICT)``.

Validators are built at their first use: a command builds only those of its own verb. A default that is itself a
configuration is therefore a ``default_factory``."""


def to_dict(config: Any) -> dict[str, Any]:
    """A configuration as plain JSON values."""
    return TypeAdapter(type(config)).dump_python(config, mode="json")


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
    """Build a configuration from a preset (default: the type's defaults), then a YAML file, then nested overrides.

    Raises:
        UsageError: unknown key (the nearest name is suggested), wrong type or value out of range.
        InputError: the YAML file is missing or malformed.
    """
    values = to_dict(preset if preset is not None else config_type())
    if yaml_path is not None:
        content = _read_yaml(yaml_path)
        content.pop("verb", None)
        values = _merge(values, content, str(yaml_path), config_type)
    if overrides:
        values = _merge(values, dict(overrides), "flags", config_type)
    return build(config_type, values, str(yaml_path or "configuration"))


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
    try:
        return TypeAdapter(config_type).validate_python(dict(values))
    except ValidationError as error:
        raise first_problem(error, f"{where}: ", UsageError) from error


def _read_yaml(path: Path) -> dict[str, Any]:
    import yaml  # late, as is the store with its numpy: --help needs neither

    from mudg.base import store

    try:
        content = yaml.safe_load(store.read_bytes(path))
    except yaml.YAMLError as error:
        raise InputError("not valid YAML", where=str(path), got=str(error).replace("\n", " ")) from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError("a configuration file holds keys and values", where=str(path), got=type(content).__name__)
    return content


def _merge(
    base: dict[str, Any], new: Mapping[str, Any], where: str, config_type: Any, path: str = ""
) -> dict[str, Any]:
    known = {f.name: f for f in dataclasses.fields(config_type)} if dataclasses.is_dataclass(config_type) else {}
    types = typing.get_type_hints(config_type) if known else {}
    moved: Mapping[str, str | None] = getattr(config_type, "MOVED", {})
    merged = dict(base)
    for name, value in new.items():
        group = types.get(name)
        is_group, is_mapping = dataclasses.is_dataclass(group), isinstance(value, Mapping)
        if name in moved and (name not in known or (is_group and not is_mapping)):
            raise _moved_error(f"{path}{name}", moved[name], where, path)
        if known and name not in known:
            near = difflib.get_close_matches(str(name), list(known), n=1, cutoff=0.5)
            what, expected = f"unknown configuration key {path}{name}", "one of " + ", ".join(known)
            remedy = f"did you mean {path}{near[0]}?" if near else "remove it"
            raise UsageError(what, where=where, expected=expected, remedy=remedy)
        if is_group and is_mapping and isinstance(base.get(name), Mapping):
            merged[name] = _merge(base[name], value, where, group, f"{path}{name}.")
        else:
            merged[name] = value
    return merged


def _moved_error(old: str, new: str | None, where: str, path: str) -> UsageError:
    """What to say about a key that a class lists in ``MOVED``."""
    if new is None:
        return UsageError(f"the configuration key {old} was removed", where=where, remedy="leave it out")
    return UsageError(f"the configuration key {old} is now called {path}{new}", where=where,
        remedy="rename it (a dot is one level of YAML)")  # fmt: skip


def differences(old: Any, new: Any, path: str = "") -> list[str]:
    """What two nested configurations differ in, one ``a.b: x there, y asked`` per value."""
    if isinstance(old, dict) and isinstance(new, dict):
        found = []
        for name in sorted(set(old) | set(new), key=str):
            found += differences(old.get(name), new.get(name), f"{path}.{name}".lstrip("."))
        return found
    return [] if old == new else [f"{path}: {old!r} there, {new!r} asked"]
