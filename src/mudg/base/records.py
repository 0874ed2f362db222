"""Records from JSON and YAML files, checked by pydantic; what is wrong with one becomes an error that names its place.

A record is a subclass of ``StrictRecord``: no unknown fields, no conversion of types. ``parse_record`` makes one.
Checks of single fields are plain functions that raise ``InputError`` and are attached with ``checked_by``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Annotated, Any, Final, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from mudg.base import failures
from mudg.base.errors import InputError, MudgError, nearest, short

Number = Annotated[float, Field(allow_inf_nan=False)]
"""A finite number; whole numbers are accepted, texts and booleans are not."""

Value = TypeVar("Value")
RecordType = TypeVar("RecordType", bound="StrictRecord")
ErrorType = TypeVar("ErrorType", bound=MudgError)

_LARGEST_SIZE: Final = 65_536
_MEANINGS: Final = {
    "float_type": ("value is not a number", "a number"),
    "finite_number": ("value is not finite", "a finite number"),
    "int_type": ("value is not a whole number", "an integer"),
    "string_type": ("value is not a text", "a text"),
    "bool_type": ("value is neither true nor false", "true or false"),
    "list_type": ("value is not a list", "[...]"),
    "dict_type": ("value is not an object", "{...}"),
    "model_type": ("record is not an object", "{...}"),
    "unexpected_keyword_argument": ("unknown field", "a field that this version knows"),
}
"""Pydantic's name of a problem -> what is wrong, what was expected."""


class StrictRecord(BaseModel):
    """A JSON object with known fields: no types are converted; others are refused, the nearest name suggested."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_fields(cls, value: Any) -> Any:
        strict = cls.model_config.get("extra") == "forbid"
        if strict and isinstance(value, dict) and not value.keys() <= _field_names(cls).keys():
            checked_by(functools.partial(refuse_unknown, known=_field_names(cls)))(value)
        return value


class ForeignRecord(StrictRecord):
    """A JSON object of somebody else's format: no types are converted; fields that it does not know are passed over."""

    model_config = ConfigDict(extra="allow")

    def unknown(self, prefix: str = "") -> list[str]:
        """Names of the fields that were passed over, those of records within as ``record.field``."""
        own = [prefix + name for name in self.model_extra or ()]
        inner = {name: getattr(self, name) for name in type(self).model_fields}
        records = {name: one for name, one in inner.items() if isinstance(one, ForeignRecord)}
        return own + [field for name, one in records.items() for field in one.unknown(f"{prefix}{name}.")]


@functools.cache
def _field_names(record: type[BaseModel]) -> dict[str, None]:
    return {field.alias or name: None for name, field in record.model_fields.items()}


def refuse_unknown(names: Iterable[str], known: Collection[str]) -> None:
    """InputError for the first of ``names`` that is not ``known``, with the nearest known one."""
    for name in names:
        if name not in known:
            near = nearest(name, known)
            remedy = f"did you mean {near!r}?" if near else "remove it"
            raise InputError(f"unknown field {short(repr(name))}", expected=f"one of {', '.join(known)}", remedy=remedy)


class _FieldProblem(ValueError):
    """Carries an error of our own through pydantic, which adds the place of the field."""

    def __init__(self, problem: MudgError) -> None:
        super().__init__(problem.what)
        self.problem = problem


def checked_by(check: Callable[..., Value]) -> Callable[..., Value]:
    """``check`` as the function of a pydantic validator: an ``InputError`` it raises gets the place of the field."""

    @functools.wraps(check)  # pydantic reads the signature
    def validate(*values: Any) -> Value:
        try:
            return check(*values)
        except MudgError as problem:
            raise _FieldProblem(problem) from problem

    return validate


def after(check: Callable[[Any], Any]) -> AfterValidator:
    """``check`` as a validator of values that have the annotated type already."""
    return AfterValidator(checked_by(check))


def parse_record(record: type[RecordType], value: object, where: str) -> RecordType:
    """Check a JSON value. where: its place, e.g. ``scene.json: frames[3]``; of a file's top-level object, its path and
    ``": "``. InputError: it is no such record; the first problem is described, further ones are counted."""
    try:
        return record.model_validate(value)
    except ValidationError as error:
        raise first_problem(error, where) from error


def parse_dataclass(kind: type[Value], values: object, where: str) -> Value:
    """Check the JSON values of a dataclass and of those nested in it: lists become tuples, no other types are
    converted, and every field must be stated, and no other. InputError: the first wrong field (``where`` as in
    ``parse_record``); sizes end at 65,536, since what they shape is built before it is compared with the weights."""
    _refuse_sizes(values, where)
    try:
        made = TypeAdapter(kind).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        raise first_problem(error, where) from error
    _compare_fields(values, dataclasses.asdict(made), where)  # type: ignore[call-overload]
    return made


def _refuse_sizes(values: object, where: str) -> None:
    parts = values.items() if isinstance(values, Mapping) else enumerate(values) if isinstance(values, list) else ()
    for name, value in parts:
        if isinstance(value, int) and abs(value) > _LARGEST_SIZE:
            what = "a size is too large"
            raise InputError(what, where=place(where, name), expected=f"at most {_LARGEST_SIZE}", got=str(value))
        _refuse_sizes(value, place(where, name))


def _compare_fields(stated: Any, complete: Mapping[str, Any], where: str) -> None:
    try:
        refuse_unknown(stated, complete)
    except InputError as problem:
        raise problem.located(place(where)) from problem
    for name, value in complete.items():
        if name not in stated:
            what = f"the field {name!r} is missing"
            raise InputError(what, where=place(where), got=", ".join(stated) or "an empty object")
        if isinstance(value, Mapping):
            _compare_fields(stated[name], value, place(where, name))


def first_problem(error: ValidationError, where: str, error_type: type[ErrorType] = InputError) -> ErrorType:
    """The first problem that pydantic found, as an error of our own; ``where`` as in ``parse_record``."""
    first, count = error.errors(include_url=False)[0], error.error_count()
    kind, loc, value = first["type"], first["loc"], first["input"]
    if kind == "missing":
        got = ", ".join(value) if isinstance(value, dict) else ""
        what, where = f"the field {loc[-1]!r} is missing", place(where, *loc[:-1])
        return error_type(what, where=where, got=got or "an empty object")
    where = place(where, *loc)
    own = first.get("ctx", {}).get("error")
    if isinstance(own, _FieldProblem):
        problem = own.problem
        where = place(where, problem.where) if problem.where else where
        return error_type(problem.what, **{**problem.fields, "where": where})
    kind = "finite_number" if kind == "float_type" and type(value) is int else kind  # a whole number beyond 1e308
    what, expected = _MEANINGS.get(kind, ("value is not valid", first["msg"].removeprefix("Input should be ")))
    got = short(repr(value), 80) + (f" (and {count - 1} more problems)" if count > 1 else "")
    return error_type(what, where=where, expected=expected, got=got)


def place(where: str, *steps: str | int) -> str:
    """``place("scene.json: ", "frames", 3, "image")`` is ``scene.json: frames[3].image``."""
    for step in steps:
        if isinstance(step, int):
            where += f"[{step}]"
        else:
            where += step if not where or where.endswith(": ") or step.startswith("[") else f".{step}"
    return where.removesuffix(": ")


@contextlib.contextmanager
def understood(what: str, where: str) -> Iterator[None]:
    """InputError where a block that takes the content of files apart misses parts, or where they are of other types or
    do not fit. what: what the files should hold, as in "a fitted scene"."""
    try:
        yield
    except (LookupError, AttributeError, TypeError, ValueError, ArithmeticError, RuntimeError) as error:
        if failures.in_words(error) is not None:  # want of memory
            raise
        got, remedy = f"{type(error).__name__}: {error}", "make it again, or take an undamaged copy"
        problem = f"this cannot be read as {what}: parts are missing, or do not fit"
        raise InputError(problem, where=where, got=got, remedy=remedy) from error


@contextlib.contextmanager
def named_by(where: str) -> Iterator[None]:
    """Replace the owner that a type of ``base/types.py`` names by the record it was read from: ``view of 'front':
    world_from_cam`` becomes ``WHERE.world_from_cam``."""
    try:
        yield
    except InputError as problem:
        raise problem.located(place(where, problem.where.rpartition(": ")[2])) from problem
