"""A verb is a `Step`: one frozen dataclass of what it reads, writes and can be told. Command line, Python function,
help and checks of its inputs follow from the declaration. Imports neither torch nor pydantic before a step is built."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import importlib
import inspect
import sys
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, Self, dataclass_transform, get_args, get_origin

from mudg.base.errors import UsageError, nearest

if typing.TYPE_CHECKING:
    from pydantic import ValidationError


@dataclass(frozen=True, slots=True)
class Flag:
    """What the command line knows of a field beyond its name, type, default and text. metavar: what stands for the
    value in the help; FILE.yaml: an edit script. position: "first": a word without a flag; "rest": all further words;
    "second": a flag; in Python, the second argument, which needs no name. part: the part of a run that the field reads
    ("scene", "fused", "model", "fitted", "start_from", "views"): the folder of a run is taken for it. hidden: only
    other steps set it; the command line and the function do not have it."""

    metavar: str = "FOLDER"
    position: Literal["", "first", "second", "rest"] = ""
    part: str = ""
    hidden: bool = False


SCENE = Flag("SCENE", "first", "scene")
RUN = Flag("RUN", "first")
FILE_YAML = Flag("FILE.yaml")


@dataclass_transform(frozen_default=True, kw_only_default=True)
class Step:
    """Base of all verbs. A subclass is a frozen dataclass by being one; the first line of its docstring is its summary.

    Fields are what it reads (with a `Flag`), `out`, `overwrite`, and `settings`: a frozen configuration whose fields
    are flags, too. The text below a field is its help.
    """

    verb_name: ClassVar[str] = ""
    """Its name on the command line, where that is not the class's."""
    examples: ClassVar[tuple[str, ...]] = ()
    smaller: ClassVar[str] = ""
    """The settings that make its work need less memory."""
    result: ClassVar[str] = "out"
    """What the command calls the path that `run` returns."""
    short: ClassVar[tuple[str, ...]] = ()
    """Settings that `--help` lists; `--help-all` lists all. Empty: all."""
    from_run: ClassVar[tuple[str, ...]] = ()
    """Inputs that come from the run at `scene` where they are not given."""
    parts: ClassVar[Mapping[str, str]] = {}
    """First words that choose what the verb does, each with a page of help of its own, and what each does."""
    choice: ClassVar[str] = ""
    """The setting whose value says which other settings apply (`suits`)."""
    if typing.TYPE_CHECKING:
        __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True, kw_only=True)(cls)

    def run(self) -> Any:
        """Do it. Returns the path of the result, or what the command shows by name. Where it takes a part of a run, the
        folder of a run will do."""
        names = [field.name for field in fields(self) if flag_of(type(self), field.name).part]
        return (self.with_parts(names) if names else self).act()

    def with_parts(self, names: Sequence[str]) -> Self:
        """This step with the parts of runs that these fields mean."""
        from mudg.editing import runs

        given = {name: getattr(self, name) for name in names}
        parts = {name: path for name, path in given.items() if flag_of(type(self), name).part != "views"}
        found = runs.parts_of(parts, self.required())
        for name in given.keys() - found.keys():
            views = given[name]
            if isinstance(views, Mapping):
                found[name] = {key: runs.views_at(path, key) for key, path in views.items()}
            else:
                found[name] = tuple(map(runs.views_at, views))
        return replace(self, **found)

    def act(self) -> Any:
        """What `run` does when all parts of runs are found."""
        raise NotImplementedError

    def answer(self, outcome: Any) -> dict[str, Any]:
        """What the command shows: names and values; `text` stands for all others where people read it."""
        return outcome if isinstance(outcome, dict) else {self.result: outcome}

    def required(self) -> tuple[str, ...]:
        """Inputs that come from the run at `scene` where they are not given."""
        return self.from_run

    @classmethod
    def from_words(cls, words: Sequence[str], given: Mapping[str, Any]) -> dict[str, Any]:
        """Values of fields, and of settings, by the words without a flag. given: values of fields by flags. UsageError:
        a word is missing or too many."""
        left, values = list(words), dict[str, Any]()
        for field in fields(cls):
            flag = flag_of(cls, field.name)
            if flag.position not in ("first", "rest"):
                continue
            if not left and field.default is MISSING:
                raise UsageError(f"no {flag.metavar.strip('[]')} was given", expected=usage(cls))
            if left and flag.position == "rest" and is_many(hint_of(cls, field.name)):
                values[field.name], left = left, []
            elif left:
                values[field.name] = left.pop(0)
        if left:
            got, remedy = " ".join(map(repr, left)), "a value needs its flag before it"
            raise UsageError("too many words", expected=usage(cls), got=got, remedy=remedy)
        return values

    @classmethod
    def settings_from(cls, inputs: Mapping[str, Any], file: Path | None, given: Mapping[str, Any]) -> Any:
        """The settings: defaults, then a YAML file, then nested values; those behind later ones win."""
        from mudg.base import config as configuration

        return configuration.load(cls.settings_type(), None, file, given)

    @classmethod
    def settings_type(cls) -> Any:
        """Class of the settings, or None."""
        return hints(cls).get("settings")

    @classmethod
    def applies(cls, part: str, name: str, text: str) -> bool:
        """Whether a part of the verb takes a field or setting, by its dotted name and its text."""
        return True

    @classmethod
    def suits(cls, choice: str, name: str) -> bool:
        """Whether a setting, by its dotted name, applies where `choice` has this value."""
        return True

    @classmethod
    def build(
        cls, values: Mapping[str, Any], settings: Mapping[str, Any] | None = None, file: Path | None = None
    ) -> Self:
        """The step of plain values, as they come from a command line or a caller, nested settings, and a YAML file of
        those. UsageError: a value is missing, unknown or not valid. InputError: the file cannot be read."""
        from pydantic import TypeAdapter, ValidationError

        known = {field.name: field for field in fields(cls) if field.name != "settings"}
        checked: dict[str, Any] = {}
        for name, value in values.items():
            if name not in known:
                raise UsageError(f"{cls.verb()} has no {name!r}", expected=", ".join(known))
            kind = hint_of(cls, name)
            if kind == tuple[Path, ...] and isinstance(value, str | Path):
                value = (value,)
            try:
                checked[name] = TypeAdapter(kind).validate_python(value)
            except ValidationError as error:
                raise refused(cls, name, error) from error
        missing = [name for name, field in known.items() if name not in checked and field.default is MISSING]
        if missing:
            what, remedy = f"no {shown_name(cls, missing[0])} was given", f"see mudg {cls.verb()} --help"
            raise UsageError(what, expected=usage(cls), remedy=remedy)
        if cls.settings_type() is not None:
            defaults = {name: field.default for name, field in known.items()} | checked
            checked["settings"] = cls.settings_from(defaults, file, settings or {})
        return cls(**checked)

    @classmethod
    def verb(cls) -> str:
        """Its name on the command line."""
        return cls.verb_name or cls.__name__.lower()

    @classmethod
    def summary(cls) -> str:
        """What it does, in a line."""
        return (cls.__doc__ or "").strip().splitlines()[0]


# -- what a declaration says -----------------------------------------------------------------------

HOMES: Final[Mapping[str, str]] = {
    "AnnotateConfig": "mudg.labels.settings",
    "BatchConfig": "mudg.fleet.settings",
    "BenchConfig": "mudg.benchmarks.settings",
    "ConvertConfig": "mudg.diffusion.settings",
    "DatasetConfig": "mudg.datasets.settings",
    "FuseConfig": "mudg.scene.settings",
    "IngestConfig": "mudg.formats.settings",
    "LearnConfig": "mudg.diffusion.settings",
    "FitConfig": "mudg.gaussians.settings",
    "ServeConfig": "mudg.sim.settings",
    "SynthesizeConfig": "mudg.diffusion.settings",
    **dict.fromkeys(("EditConfig", "RenderConfig", "ScoreConfig"), "mudg.editing.settings"),
    **dict.fromkeys(("ExportConfig", "ImportConfig"), "mudg.exporting.settings"),
    **dict.fromkeys(("PageConfig", "ViewConfig"), "mudg.viewer.settings"),
    **dict.fromkeys(("PresetName", "RunConfig"), "mudg.steps.settings"),
}
"""Names that annotations of steps use, and their modules: each is imported when its verb is."""


class _Settings(dict[str, Any]):
    """Names that annotations of steps use and that only type checkers import: classes of settings, looked up when
    needed."""

    def __missing__(self, name: str) -> Any:
        return getattr(importlib.import_module(HOMES[name]), name)


@functools.cache
def hints(cls: type[Any]) -> dict[str, Any]:
    """Types of the fields of a step or of settings, with their `Flag` where they have one."""
    return typing.get_type_hints(cls, localns=_Settings(), include_extras=True)


def hint_of(cls: type[Any], name: str) -> Any:
    """Type of a field, without its `Flag`."""
    kind = hints(cls)[name]
    return get_args(kind)[0] if any(isinstance(item, Flag) for item in _notes(kind)) else kind


def flag_of(cls: type[Any], name: str) -> Flag:
    """What the command line knows of a field."""
    return next((item for item in _notes(hints(cls)[name]) if isinstance(item, Flag)), Flag(""))


def _notes(kind: Any) -> tuple[Any, ...]:
    return get_args(kind)[1:] if get_origin(kind) is Annotated else ()


def is_many(kind: Any) -> bool:
    """Whether a flag takes several words."""
    kind = present(kind)
    return get_origin(kind) is tuple or (isinstance(get_origin(kind), type) and issubclass(get_origin(kind), Mapping))


def present(kind: Any) -> Any:
    """A type without None."""
    inside = [one for one in get_args(kind) if one is not type(None)]
    return inside[0] if type(None) in get_args(kind) and len(inside) == 1 else kind


def flag_name(name: str) -> str:
    """``loss.ssim_weight`` as ``--loss.ssim-weight``."""
    return f"--{name.replace('_', '-')}"


def shown_name(cls: type[Any], name: str) -> str:
    """A field as people write it: its word, or its flag."""
    flag = flag_of(cls, name)
    return flag.metavar.strip("[]") if flag.position in ("first", "rest") else flag_name(name)


def usage(cls: type[Step]) -> str:
    """The command line of a step in short."""
    words = [f"mudg {cls.verb()}"]
    for field in in_reading_order(cls):
        flag, needed = flag_of(cls, field.name), field.default is MISSING
        if flag.position in ("first", "rest"):
            words.append(flag.metavar if needed or "[" in flag.metavar else f"[{flag.metavar}]")
        elif needed and f"[{field.name.upper()}]" not in " ".join(words):
            words.append(f"{flag_name(field.name)} {flag.metavar}")
    return " ".join([*words, "[flags]"])


def in_reading_order(cls: type[Any]) -> list[dataclasses.Field[Any]]:
    """Fields but the settings: words without a flag, what has to be given, then the rest."""
    own = [field for field in fields(cls) if field.name != "settings" and not flag_of(cls, field.name).hidden]

    def rank(field: dataclasses.Field[Any]) -> int:
        position = flag_of(cls, field.name).position
        if position in ("first", "rest"):
            return 0
        return 1 + (position != "second") + (field.default is not MISSING or field.name == "overwrite")

    return sorted(own, key=rank)


def refused(cls: type[Step], name: str, error: ValidationError) -> UsageError:
    """The first wrong value of a field in words."""
    first, remedy = error.errors(include_url=False)[0], f"see mudg {cls.verb()} --help"
    where, got = shown_name(cls, name), repr(first.get("input"))[:120]
    return UsageError("a value is not valid", where=where, expected=first["msg"], got=got, remedy=remedy)


@dataclass(frozen=True, slots=True)
class Option:
    """A field of a step, or one of its settings (not ``own``). name: dotted, without the word settings. default:
    `MISSING` where it has none. text: its help."""

    name: str
    kind: Any
    default: Any
    text: str
    own: bool


def options(cls: type[Any], base: Any = None) -> Iterator[Option]:
    """Every flag of a step, or of another dataclass of flags, its own before its settings. base: settings whose values
    are the defaults (None: those of their class)."""
    texts = texts_of(cls)
    for field in in_reading_order(cls):
        yield Option(field.name, hint_of(cls, field.name), field.default, texts.get(field.name, ""), True)
    kind = hints(cls).get("settings")
    if kind is not None:
        yield from _setting_options(kind, kind() if base is None else base, "")


def _setting_options(group: Any, values: Any, path: str) -> Iterator[Option]:
    texts, types = texts_of(group), hints(group)
    for field in fields(group):
        value, name = getattr(values, field.name), f"{path}{field.name}"
        if is_dataclass(value):
            yield from _setting_options(type(value), value, f"{name}.")
        else:
            kind = types[field.name]
            # constraints do not matter to the command line
            kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
            yield Option(name, kind, value, texts.get(field.name, ""), False)


def texts_of(kind: type[Any]) -> dict[str, str]:
    """By field: the string that stands below it in the source, as one line; of inherited fields, too. Empty without a
    source file."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if base.__dict__.get("__annotations__"):
            source = getattr(sys.modules[base.__module__], "__file__", None) or ""
            texts |= _texts_of_module(source).get(base.__qualname__, {})
    return texts


@functools.cache
def _texts_of_module(source: str) -> dict[str, dict[str, str]]:
    """Texts by class and field of one source file."""
    texts: dict[str, dict[str, str]] = {}
    with contextlib.suppress(OSError):
        for node in ast.parse(Path(source).read_bytes()).body:
            if isinstance(node, ast.ClassDef):
                for pair in zip(node.body, node.body[1:], strict=False):
                    match pair:
                        case ast.AnnAssign(target=ast.Name(name)), ast.Expr(value=ast.Constant(str(text))):
                            texts.setdefault(node.name, {})[name] = " ".join(text.split())
    return texts


# -- the function of a verb ------------------------------------------------------------------------
def python_function(cls: type[Step], name: str) -> Callable[..., Any]:
    """``mudg.fit(...)`` of a step: its inputs and settings as arguments, its result returned. A setting has the name
    and default that the command shows, without the dashes; a group is a dictionary, or its configuration. ``config``
    names a YAML file that is read before."""

    def call(*args: Any, config: str | Path | None = None, **given: Any) -> Any:
        parameters = inspect.signature(call).parameters.values()
        names = [one.name for one in parameters if one.kind != inspect.Parameter.KEYWORD_ONLY]
        if len(args) > len(names):
            what = f"mudg.{name} takes {len(names)} arguments without a name"
            raise UsageError(what, expected=", ".join(names), got=f"{len(args)} of them")
        values = dict(zip(names, args, strict=False))
        twice = sorted(values.keys() & given.keys())
        if twice:
            raise UsageError(f"mudg.{name} was given {twice[0]} twice")
        own = {field.name for field in in_reading_order(cls)}
        values |= {key: value for key, value in given.items() if key in own}
        settings = {key: _plain(value) for key, value in given.items() if key not in own}
        if settings and cls.settings_type() is None:
            wrong = next(iter(settings))
            near = nearest(wrong, own, 0.5)
            what, remedy = f"mudg.{name} has no argument {wrong!r}", f"did you mean {near}?" if near else ""
            raise UsageError(what, expected=", ".join(sorted(own)), remedy=remedy)
        outcome = cls.build(values, settings, None if config is None else Path(config)).run()
        return outcome[cls.result] if isinstance(outcome, dict) and cls.result in outcome else outcome

    call.__name__ = call.__qualname__ = name
    call.__module__ = "mudg"
    call.__signature__ = signature(cls)  # type: ignore[attr-defined]
    call.__doc__ = documentation(cls)
    return call


def _plain(value: Any) -> Any:
    """Settings hold plain values: paths as text, groups as mappings."""
    if is_dataclass(value) and not isinstance(value, type):
        from mudg.base import config as configuration

        return configuration.to_dict(value)
    if isinstance(value, Mapping):
        return {name: _plain(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return str(value) if isinstance(value, Path) else value


def signature(cls: type[Step]) -> inspect.Signature:
    """Arguments of the function: inputs in order, then by name alone the output, other inputs, the YAML file and every
    setting."""
    kinds, first, later = inspect.Parameter, [], []
    for field in fields(cls):
        if field.name == "settings" or flag_of(cls, field.name).hidden:
            continue
        at = kinds.POSITIONAL_OR_KEYWORD if flag_of(cls, field.name).position else kinds.KEYWORD_ONLY
        default = kinds.empty if field.default is MISSING else field.default
        parameter = kinds(field.name, at, default=default, annotation=hint_of(cls, field.name))
        (first if at == kinds.POSITIONAL_OR_KEYWORD else later).append(parameter)
    kind = cls.settings_type()
    if kind is not None:
        if "config" not in {one.name for one in (*first, *later)}:
            later.append(kinds("config", kinds.KEYWORD_ONLY, default=None, annotation=Path | None))
        types, values = hints(kind), kind()
        for name in (field.name for field in dataclasses.fields(kind)):
            later.append(kinds(name, kinds.KEYWORD_ONLY, default=getattr(values, name), annotation=types[name]))
    for parameters in (first, later):
        parameters.sort(key=lambda one: one.default is not kinds.empty)
    return inspect.Signature([*first, *later])


def documentation(cls: type[Step]) -> str:
    """The docstring of the function: the step's own, then a line per argument."""
    lines = [inspect.cleandoc(cls.__doc__ or ""), "", "Args:"]
    texts = texts_of(cls) | (texts_of(cls.settings_type()) if cls.settings_type() is not None else {})
    for name in signature(cls).parameters:
        text = texts.get(name) or ("YAML file of settings, read before those given here." if name == "config" else "")
        lines.append(f"    {name}: {text}".rstrip())
    return "\n".join(lines)
