"""What the records of a batch must be to be used: other workers wrote them, and a crash, a full disk or a hand may have damaged them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mudg.base.errors import InputError
from mudg.base.records import first_problem
from mudg.data.scene.schema import NAME_PATTERN

Amount = Annotated[float, Field(ge=0, le=1e15, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, le=10**15)]
Name = Annotated[str, Field(pattern=f"^{NAME_PATTERN.pattern}$")]
"""Becomes a part of a path."""


class _Record(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")


class FactsTold(_Record):
    """Facts about the log of a step."""

    dataset: str = ""
    cameras: Count = 0
    images: Count = 0
    seconds: Amount = 0.0
    metres: Amount = 0.0
    objects: dict[str, Count] = {}


class StepTold(_Record):
    """The end of a step, or an event of it."""

    event: str = ""
    worker: str = ""
    key: str = ""
    scene: Name | None = None
    stage: Name | None = None
    at: Amount = 0.0
    ended: Amount = 0.0
    seconds: Amount = 0.0
    processor_s: Amount = 0.0
    written_bytes: Count | None = None
    peak_bytes: Count | None = None
    code: Annotated[int, Field(ge=-1000, le=1000)] = 1
    words: str = ""
    state: str = ""
    same: bool = False
    facts: FactsTold | None = None


class Ended(StepTold):
    """The record of a step that is done or has failed."""

    scene: Name
    stage: Name


class ClaimTold(_Record):
    """A claim."""

    state: str
    until: Amount
    host: str = ""
    process: Annotated[int, Field(ge=0, lt=2**31)] = 0
    counts: dict[Annotated[str, Field(pattern=r"^-?[0-9]{1,4}$")], Annotated[int, Field(ge=0, le=100)]] = {}


class _Stage(_Record):
    name: Name


class PlanTold(_Record):
    """The plan."""

    stages: Annotated[list[_Stage], Field(min_length=1)]


class ReviewTold(_Record):
    """A result that waits for somebody to look at it."""

    scene: Name
    stage: Name
    key: Annotated[str, Field(pattern=r"^[A-Za-z0-9]+$")]
    problems: list[str]
    place: str
    pictures: list[str]
    report: str = ""


_REMEDY: Final = "remove it"


def checked(kind: type[_Record], value: object, where: str, remedy: str = _REMEDY) -> Mapping[str, Any]:
    """A record, if it is one of this kind.

    Raises:
        InputError: names file and field.
    """
    try:
        kind.model_validate(value)
    except ValidationError as error:
        problem = first_problem(error, f"{where}: ")
        raise InputError(f"a record of the batch is damaged: {problem.what}", where=problem.where, expected=problem.expected,
            got=problem.got, remedy=remedy) from error  # fmt: skip
    return value  # type: ignore[return-value]  # an object: the model says so
