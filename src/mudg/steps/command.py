"""Command lines: words to a `Step`, and the pages of help. Both follow from the step's declaration."""

from __future__ import annotations

import argparse
import dataclasses
import os
import re
import shutil
import textwrap
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin

from mudg.base import config as configuration
from mudg.base.errors import UsageError, nearest
from mudg.steps.step import Option, Step, flag_name, flag_of, is_many, options, present, usage


@dataclass(frozen=True, kw_only=True)
class Common:
    """Flags that every command has."""

    config: Path | None = None
    """Read settings from this YAML file; flags win over it. The run.yaml beside any result is such a file."""
    quiet: bool = False
    """Show warnings and the result only: no progress bars, no messages."""
    json: bool = False
    """Print the result as JSON."""
    scratch: Path | None = None
    """Where inputs and outputs that are addresses (s3://bucket/folder) lie while the command works on them (not given:
    the system's folder for temporary files)."""
    debug: bool = False
    """Show the full traceback of an error."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(message[:1].lower() + message[1:], remedy=f"see {self.prog} --help")


def parse(cls: type[Step], words: Sequence[str]) -> tuple[Step, Common]:
    """The words behind a verb as its step, and the flags that every command has. UsageError: an unknown flag (the
    nearest is named), a missing or wrong value. InputError: --config cannot be read."""
    listed = {option.name: option for option in options(cls)}
    listed |= {option.name: option for option in common_options() if option.name not in listed}
    parser = _Parser(prog=f"mudg {cls.verb()}", add_help=False, allow_abbrev=False)
    for option in listed.values():
        flag, about = flag_name(option.name), dict[str, Any](dest=option.name, default=argparse.SUPPRESS)
        if option.kind is bool:
            parser.add_argument(flag, action="store_true", **about)
            parser.add_argument(_negated(option.name), action="store_false", **about)
        else:
            parser.add_argument(flag, nargs="*" if is_many(option.kind) else None, **about)
    parser.add_argument("words", nargs="*")
    found, unknown = parser.parse_known_intermixed_args(_plain_flags(words))
    if unknown:
        flag, known = unknown[0].partition("=")[0], [flag_name(name) for name in listed]
        ends = (one for one in known if one.endswith(flag.removeprefix("--")) and len(flag) > 4)
        near = nearest(flag, known, 0.6) or next(ends, None)
        remedy = f"did you mean {near}?" if near else f"see mudg {cls.verb()} --help-all"
        raise UsageError(f"mudg {cls.verb()} has no flag {flag}", remedy=remedy)
    given: dict[str, Any] = {name: value for name, value in vars(found).items() if name in listed}
    own = {name: _value(listed[name].kind, given.pop(name)) for name in list(given) if listed[name].own}
    its_own = {field.name for field in dataclasses.fields(cls)}
    of_all = {f.name: own.pop(f.name) for f in dataclasses.fields(Common) if f.name in own and f.name not in its_own}
    of_all |= {name: Path(of_all[name]) for name in ("config", "scratch") if isinstance(of_all.get(name), str)}
    common = Common(**of_all)
    by_words = cls.from_words(found.words, own)
    for name in by_words.keys() & (own.keys() | given.keys()):
        twice = f"{by_words[name]!r} and {(own | given)[name]!r}"
        raise UsageError(f"{flag_name(name)} was given twice", got=twice, expected=usage(cls))
    given |= {name: by_words.pop(name) for name in by_words.keys() - its_own}
    settings = configuration.nested({name: _value(listed[name].kind, value) for name, value in given.items()})
    return cls.build({**by_words, **own}, settings, common.config), common


def common_options() -> list[Option]:
    """Flags that every command has."""
    return list(options(Common))


def _negated(name: str) -> str:
    """``render.video`` as ``--render.no-video``."""
    group, dot, last = name.rpartition(".")
    return flag_name(f"{group}{dot}no_{last}")


def _plain_flags(words: Iterable[str]) -> list[str]:
    """Underscores in flags as dashes."""
    plain = []
    for word in words:
        head, equals, value = word.partition("=")
        plain.append(head.replace("_", "-") + equals + value if word.startswith("--") else word)
    return plain


def _value(kind: Any, value: Any) -> Any:
    """The words of a flag as the plain value that its type is checked against."""
    if value in ("None", ["None"]) and type(None) in get_args(kind):
        return None
    kind = present(kind)
    if isinstance(value, list) and get_origin(kind) is tuple:
        return tuple(_value(get_args(kind)[0], word) for word in value)
    if isinstance(value, list):
        pairs = [word.partition("=") for word in value]
        for name, equals, folder in pairs:
            if not equals or not name or not folder:
                got = "=".join(filter(None, (name, folder)))
                raise UsageError("a value is not a name and a folder", expected="NAME=FOLDER", got=got)
        return {name: folder for name, _, folder in pairs}
    choices = get_args(kind) if get_origin(kind) is Literal else ()
    return next((choice for choice in choices if str(choice) == value), value)


def words_of(step: Step) -> list[str]:
    """The command line of a step behind ``mudg``, without its output and what has its default: `parse` makes the same
    step of it."""
    cls, words, flags = type(step), step.verb().split(" "), list[str]()
    own = {field.name: getattr(step, field.name) for field in dataclasses.fields(step) if field.name != "settings"}
    for field in dataclasses.fields(step):
        value = own.get(field.name)
        if field.name in ("out", "settings") or value == field.default:
            continue
        if flag_of(cls, field.name).position in ("first", "rest"):
            words += map(str, value) if isinstance(value, tuple) else [str(value)]
        else:
            flags += _flag_words(field.name, value)
    if cls.settings_type() is not None:
        usual = {one.name: one.default for one in options(cls, cls.settings_from(own, None, {})) if not one.own}
        values = {one.name: one.default for one in options(cls, vars(step)["settings"]) if not one.own}
        flags += [word for name, value in values.items() if value != usual[name] for word in _flag_words(name, value)]
    return [*words, *flags]


def _flag_words(name: str, value: Any) -> list[str]:
    if isinstance(value, bool):
        return [flag_name(name) if value else _negated(name)]
    if isinstance(value, Mapping):
        return [flag_name(name), *(f"{key}={inner}" for key, inner in value.items())]
    return [flag_name(name), *(map(str, value) if isinstance(value, tuple | list) else [str(value)])]


def chosen(cls: type[Step], words: Sequence[str]) -> str:
    """The value of the verb's ``choice`` in a command line that asks for help; "" if there is none."""
    plain = [part for word in _plain_flags(words) for part in word.split("=", 1)]
    kind = next((one.kind for one in options(cls) if cls.choice and one.name == cls.choice), None)
    after = [b for a, b in zip(plain, plain[1:]) if a == flag_name(cls.choice)]
    return after[-1] if after and after[-1] in get_args(kind) else ""


# -- help ------------------------------------------------------------------------------------------
_FLAG_COLUMNS = 26


def help_page(cls: type[Step], *, everything: bool, part: str = "", choice: str = "") -> str:
    """A verb's page of help. ``everything``: all settings with their whole texts; else those that most people need,
    with the first sentence of each. ``part``: only what this part of the verb takes. ``choice``: only settings that
    apply to this value of the verb's ``choice``."""
    head = f"mudg {cls.verb()}{f' {part}' if part else ''}"
    examples = [line for line in cls.examples if line.startswith(f"{head} ") or not part]
    shown = examples if everything or part else examples[:3]
    lines = [cls.parts[part] if part else cls.summary(), ""]
    lines.append(f"usage: {usage(cls) if not part else f'{head} [words] [flags]'}")
    if shown:
        lines += ["", "examples:", *(f"  {line}" for line in shown)]
    if cls.parts and not part:
        lines += ["", f"mudg {cls.verb()} WORD --help, for each of: " + ", ".join(cls.parts)]
    defaults = {field.name: field.default for field in dataclasses.fields(cls) if field.name != "settings"}
    rows = list(options(cls, None if cls.settings_type() is None else cls.settings_from(defaults, None, {})))
    own, settings = [one for one in rows if one.own], [one for one in rows if not one.own]
    if part:
        own, settings = ([one for one in rows if cls.applies(part, one.name, one.text)] for rows in (own, settings))
    if choice:
        settings = [one for one in settings if cls.suits(choice, one.name)]
    hidden = 0
    if not everything and cls.short and not part:
        chosen = [one for one in settings if one.name in cls.short]
        hidden, settings = len(settings) - len(chosen), chosen
    names = {one.name for one in own}
    common = [one for one in common_options() if one.name not in names]
    title = f"settings of {flag_name(cls.choice)} {choice}:" if choice else "settings:"
    tables = {"inputs and outputs:": own, title: settings, "every command:": common if everything else []}
    for title, rows in tables.items():
        if rows:
            lines += ["", title, *(line for one in rows for line in _row(cls, one, everything))]
    if not everything:
        short = " ".join(flag_name(one.name) + (" PATH" if one.kind is not bool else "") for one in common)
        lines += ["", f"every command: {short}"]
        words = f" {flag_name(cls.choice)} {choice}" if choice else ""
        lines += [f"{hidden} more settings, and longer texts: mudg {cls.verb()}{words} --help-all"] * bool(hidden)
    return "\n".join(lines)


def _row(cls: type[Step], option: Option, whole: bool) -> list[str]:
    """The lines of one flag."""
    position, metavar = "", ""
    if option.own and option.name in {field.name for field in dataclasses.fields(cls)}:
        about = flag_of(cls, option.name)
        position, metavar = about.position, about.metavar
    head = flag_name(option.name)
    if position in ("first", "rest"):
        head = metavar
    elif option.kind is bool:
        group, dot, last = option.name.rpartition(".")
        head = flag_name(f"{group}{dot}[no-]{last}") if option.default is True else head
    else:
        head = f"{head} {metavar or metavar_of(option.kind)}"
    text = option.text if whole else re.split(r"\. (?=[A-Z])", option.text, maxsplit=1)[0].rstrip(".")
    switch = "default: on" if option.default is True else ""
    default = switch if option.kind is bool else "" if position in ("first", "rest") else default_words(option.default)
    text = f"{text} ({default})" if default and "(not given:" not in text else text
    width = max(60, min(140, int(os.environ.get("COLUMNS") or 0) or shutil.get_terminal_size((120, 24)).columns))
    body = textwrap.wrap(text, width - _FLAG_COLUMNS - 2, break_long_words=False, break_on_hyphens=False) or [""]
    first = [f"  {head}"] if len(head) > _FLAG_COLUMNS - 2 else [f"  {head:<{_FLAG_COLUMNS - 2}}  {body.pop(0)}"]
    return [*first, *(" " * (_FLAG_COLUMNS + 2) + line for line in body)]


def metavar_of(kind: Any) -> str:
    """What stands for a value of a type."""
    kind = present(kind)
    if is_many(kind):
        if get_origin(kind) is not tuple:
            return "NAME=FOLDER ..."
        return " ".join([metavar_of(get_args(kind)[0]), "..."])
    if get_origin(kind) is typing.Annotated:
        return metavar_of(get_args(kind)[0])
    if get_origin(kind) is Literal:
        return "{" + ",".join(map(str, get_args(kind))) + "}"
    inside = [one for one in get_args(kind) if one is not type(None)]
    if inside:
        return metavar_of(inside[0])
    return {int: "INT", float: "FLOAT", Path: "PATH"}.get(kind, "TEXT")


def default_words(value: Any) -> str:
    """``default: 3`` of a value; empty for none."""
    if value is MISSING:
        return "required"
    if value is None or value == () or value == "":
        return ""
    return "default: " + (" ".join(map(str, value)) if isinstance(value, tuple) else str(value))
