"""Reading edit scripts: a list of verbs, each with its settings. What is wrong is told with file, line, verb and
field."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Self

import yaml
from pydantic import Field, ValidationError, model_validator

from mudg.base import store
from mudg.base.errors import InputError, nearest, short
from mudg.base.plain_yaml import Lines, parse_yaml
from mudg.base.records import Number, StrictRecord, after, checked_by, first_problem, place
from mudg.base.weather_settings import Conditions, LightSettings, WeatherSettings

EGO: Final = "ego"
"""The id of the recording vehicle in edit scripts."""

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


def _named(value: str) -> str:
    if not value.strip():
        raise InputError("an id is empty", expected="the id of a track", got=repr(value))
    return value


Name = Annotated[str, after(_named)]


def _of_actor(value: str) -> str:
    if _named(value) == EGO:
        what, remedy = "the recording vehicle cannot be edited so", "ego takes lane_change, speed, stop, move and path"
        raise InputError(what, expected="the id of a track", got=EGO, remedy=remedy)
    return value


ActorName = Annotated[str, after(_of_actor)]


class AssetSource(StrictRecord):
    """Where an object comes from: a fitted scene (``run`` and ``id``) or an asset ``file``. Paths are relative to the
    script."""

    run: Name | None = None
    id: Name | None = None
    file: Name | None = None

    @model_validator(mode="after")
    @checked_by
    def _one_source(self) -> Self:
        if (self.file is None) == (self.run is None) or (self.run is None) != (self.id is None):
            got = " and ".join(name for name in ("run", "id", "file") if getattr(self, name) is not None)
            what = "it is not clear where the object comes from"
            raise InputError(what, expected="run and id, or file alone", got=got or "none of them")
        return self


class RemoveEdit(StrictRecord):
    """Take objects away: those of ``ids``, or those of a ``class``, all or only ``moving`` ones, all or near the
    vehicle's path."""

    ids: Annotated[list[ActorName], Field(min_length=1)] | None = None
    class_: Name | None = Field(default=None, alias="class")
    moving: bool | None = None
    within_m: Positive | None = None
    close_street: bool | None = None

    @model_validator(mode="after")
    @checked_by
    def _either(self) -> Self:
        by_kind = self.class_ is not None or self.moving is not None or self.within_m is not None
        if (self.ids is None) != by_kind:
            expected, got = "ids, or any of class, moving, within_m", "both" if by_kind else "nothing"
            raise InputError("objects are chosen by ids or by kind", expected=expected, got=got)
        return self


class DisplacingEdit(StrictRecord):
    """What edits say after which somebody is not where they were recorded."""

    id: Name
    close_street: bool | None = None


class MoveEdit(DisplacingEdit):
    """Displace an object in its own frame, for good or from a moment on."""

    along_m: Number = 0.0
    left_m: Number = 0.0
    up_m: Number = 0.0
    yaw_deg: Number = 0.0
    from_s: Number | None = None
    ramp_s: NotNegative = 1.0
    ground: bool = True


class StopEdit(DisplacingEdit):
    """Brake evenly, and stand from then on."""

    at_s: Number
    brake_m_s2: Annotated[float, Field(gt=0, le=12)] = 4.0


class SpeedEdit(DisplacingEdit):
    """Drive the same path faster or slower."""

    factor: Annotated[float, Field(gt=0, le=5)]
    from_s: Number | None = None


class LaneChangeEdit(DisplacingEdit):
    """Change lanes, smoothly."""

    left_m: Number
    start_s: Number
    duration_s: Positive
    most_lateral_m_s2: Positive = 4.0
    ground: bool = True


def _path_points(points: list[list[float]]) -> list[list[float]]:
    for index, point in enumerate(points):
        if len(point) not in (3, 4):
            what, expected = "a point of a path has the wrong length", "[t, x, y] or [t, x, y, yaw_deg]"
            raise InputError(what, where=f"[{index}]", expected=expected, got=str(point)[:80])
        if index and point[0] <= points[index - 1][0]:
            what, expected = "the times of a path do not increase", f"more than {points[index - 1][0]} s"
            raise InputError(what, where=f"[{index}]", expected=expected, got=f"{point[0]} s")
    if len({len(point) for point in points}) > 1:
        raise InputError("some points of a path have a yaw and others have none", expected="all or none")
    return points


class PathEdit(DisplacingEdit):
    """Drive another path: points [t, x, y, yaw_deg] or [t, x, y] in the world."""

    points: Annotated[list[list[Number]], Field(min_length=2), after(_path_points)]
    ground: bool = True


class ReplaceEdit(StrictRecord):
    """Put another object in the place of one."""

    id: ActorName
    by: AssetSource
    match_light: bool = True


class PlaceNear(StrictRecord):
    """A place relative to the vehicle or to an object: where that is at ``at_s``, or with it all the time."""

    id: Name = EGO
    at_s: Number | None = None
    ahead_m: Number = 0.0
    left_m: Number = 0.0
    yaw_deg: Number = 0.0


class InsertEdit(StrictRecord):
    """Add an object, on a ``path`` or ``near`` something."""

    asset: AssetSource
    id: ActorName | None = None
    class_: Name | None = Field(default=None, alias="class")
    path: Annotated[list[list[Number]], Field(min_length=1), after(_path_points)] | None = None
    near: PlaceNear | None = None
    ground: bool = True
    shadow: Share = 0.6
    match_light: bool = True

    @model_validator(mode="after")
    @checked_by
    def _placed(self) -> Self:
        if (self.path is None) == (self.near is None):
            got = "both" if self.path else "neither"
            raise InputError("an object to insert needs one place", expected="path or near", got=got)
        return self


class SkyEdit(StrictRecord):
    """Another sky: a panorama of all directions (longitude across, zenith at the top), turned to the left by
    ``yaw_deg``."""

    image: Name
    yaw_deg: Number = 0.0


def _balls(balls: list[list[float]]) -> list[list[float]]:
    for index, ball in enumerate(balls):
        if len(ball) != 4 or not ball[3] > 0:
            what, expected = "a ball is not described", "[x, y, z, radius] in metres, the radius above 0"
            raise InputError(what, where=f"[{index}]", expected=expected, got=str(ball)[:80])
    return balls


class KeptBox(StrictRecord):
    """A box in the world: middle and size in metres, length along the heading ``yaw_deg``."""

    center: Annotated[list[Number], Field(min_length=3, max_length=3)]
    size_m: Annotated[list[Positive], Field(min_length=3, max_length=3)]
    yaw_deg: Number = 0.0


class EraseEdit(StrictRecord):
    """Take parts of the street away, objects apart: what lies in ``balls``, and what lies outside the box ``keep``."""

    balls: Annotated[list[list[Number]], Field(min_length=1), after(_balls)] | None = None
    keep: KeptBox | None = None

    @model_validator(mode="after")
    @checked_by
    def _something(self) -> Self:
        if self.balls is None and self.keep is None:
            raise InputError("nothing says what to erase", expected="balls, keep, or both", got="neither")
        return self


VERBS: Final[dict[str, type[StrictRecord]]] = {
    "remove": RemoveEdit,
    "move": MoveEdit,
    "stop": StopEdit,
    "speed": SpeedEdit,
    "lane_change": LaneChangeEdit,
    "path": PathEdit,
    "replace": ReplaceEdit,
    "insert": InsertEdit,
    "sky": SkyEdit,
    "erase": EraseEdit,
    "weather": WeatherSettings,
    "light": LightSettings,
}
CONDITIONS: Final = ("weather", "light")
"""Verbs that change no geometry."""


@dataclass(frozen=True, slots=True)
class ScriptEdit:
    """One entry of a script: its verb, its settings (the record of `VERBS`), and where it stands."""

    verb: str
    settings: Any
    where: str

    @classmethod
    def parsed(cls, index: int, value: Any, lines: Lines, where: str) -> Self:
        """An entry of the list as YAML gives it."""
        at = f"{where}, line {lines[(index,)]}"
        if not isinstance(value, dict) or len(value) != 1:
            expected = "e.g. `- remove: {ids: [car-003]}`"
            raise InputError("an edit is one verb with its settings", where=at, expected=expected, got=short(value, 80))
        ((verb, settings),) = value.items()
        if verb not in VERBS:
            near = nearest(verb, VERBS)
            remedy, expected = f"did you mean {near!r}?" if near else "see docs/edit.md", f"one of {', '.join(VERBS)}"
            raise InputError(f"there is no verb {verb!r}", where=at, expected=expected, remedy=remedy)
        try:
            return cls(verb, VERBS[verb].model_validate({} if settings is None else settings), at)
        except ValidationError as error:
            told = first_problem(error, place(verb))
            steps = [int(step) if step.isdigit() else step for step in re.findall(r"[^.\[\]]+", told.where)]
            path = (index, *steps)
            while path not in lines:  # what is missing has no line: that of what should hold it
                path = path[:-1]
            inside = {inner: line for inner, line in lines.items() if inner[:-1] == path}
            unknown = (line for inner, line in inside.items() if f"unknown field {inner[-1]!r}" in told.what)
            raise told.located(f"{where}, line {next(unknown, lines[path])}: {told.where}") from error

    def files(self) -> list[str]:
        """Paths that it names, as written."""
        source = getattr(self.settings, "asset", None) or getattr(self.settings, "by", None)
        image = getattr(self.settings, "image", None)
        return [name for name in (source and (source.run or source.file), image) if name is not None]


@dataclass(frozen=True, slots=True)
class EditScript:
    """A checked script. ``edits``: in the order in which they apply. ``folder``: what relative paths in it are relative
    to."""

    edits: tuple[ScriptEdit, ...]
    folder: Path

    def path_of(self, name: str) -> Path:
        """A file or folder that the script names."""
        return self.folder / name

    def files(self) -> dict[str, Path]:
        """Every file or folder that the script reads, by the name it has there."""
        return {name: self.path_of(name) for edit in self.edits for name in edit.files()}

    def canonical(self) -> list[dict[str, Any]]:
        """The script as JSON values with all defaults: two scripts that say the same are equal here."""
        return [{edit.verb: edit.settings.model_dump(mode="json", by_alias=True)} for edit in self.edits]

    def digest(self) -> str:
        """Hash of what the script says and of what it reads; part of the key of everything made with it. InputError: a
        file or folder that it names does not exist. IntegrityError: one was altered."""
        contents = {}
        for edit in self.edits:
            for name in edit.files():
                try:
                    contents[name] = store.digest(self.path_of(name))
                except InputError as problem:
                    what, where = "the script names a file that is not there", f"{edit.where}: {edit.verb}"
                    got, remedy = str(self.path_of(name)), "paths are relative to the script's folder"
                    raise InputError(what, where=where, got=got, remedy=remedy) from problem
        text = store.json_text(_with_contents(self.canonical(), contents), indent=None)
        return hashlib.sha256(text.encode()).hexdigest()

    def text(self) -> str:
        """The script as YAML with all defaults and with absolute paths."""
        named = {name: str(path.resolve()) for name, path in self.files().items()}
        return yaml.safe_dump(_with_contents(self.canonical(), named), sort_keys=False)


def conditions_of(script: Sequence[Mapping[str, Any]]) -> Conditions | None:
    """Weather and light that a script (``EditScript.canonical``) asks for, each as its last verb says; None: it asks
    for none."""
    asked = {verb: settings for edit in script for verb, settings in edit.items() if verb in CONDITIONS}
    return Conditions.model_validate(asked) if asked else None


def _with_contents(value: Any, names: Mapping[str, str]) -> Any:
    """The values of ``file``, ``run`` and ``image`` replaced."""
    if isinstance(value, list):
        return [_with_contents(inner, names) for inner in value]
    if not isinstance(value, dict):
        return value
    paths = ("file", "run", "image")
    return {k: names[v] if k in paths and isinstance(v, str) else _with_contents(v, names) for k, v in value.items()}


def read_edits(path: Path | str) -> EditScript:
    """Read a script. InputError: it is missing, no YAML, or says something that no verb understands."""
    path = Path(path)
    return parse_edits(store.read_bytes(path), str(path), path.parent)


def parse_edits(text: str | bytes, where: str, folder: Path = Path()) -> EditScript:
    """Check a script. ``where``: name of the file for messages. ``folder``: what its paths are relative to."""
    lines: Lines = {}
    entries = parse_yaml(text, where, lines=lines)
    if not isinstance(entries, list) or not entries:
        got = "nothing" if entries in (None, []) else type(entries).__name__
        expected = "lines such as `- remove: {ids: [car-003]}`"
        raise InputError("an edit script is a list of edits", where=where, expected=expected, got=got)
    edits = tuple(ScriptEdit.parsed(index, value, lines, where) for index, value in enumerate(entries))
    return EditScript(edits, Path(folder))
