"""Reading edit scripts: a list of verbs, each with its settings. What is wrong is told with file, line, verb and field."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from mudg.base import store
from mudg.base.errors import InputError, nearest, short
from mudg.base.plain_yaml import Lines, parse_with_lines
from mudg.base.records import first_problem, place
from mudg.data.edits.records import CONDITIONS, VERBS, files_of


@dataclass(frozen=True, slots=True)
class ScriptEdit:
    """One entry of a script: its verb, its settings (the record of `VERBS`), and where it stands."""

    verb: str
    settings: Any
    where: str


@dataclass(frozen=True, slots=True)
class EditScript:
    """A checked script.

    Args:
        edits: in the order in which they apply.
        folder: what relative paths in it are relative to.
    """

    edits: tuple[ScriptEdit, ...]
    folder: Path

    def path_of(self, name: str) -> Path:
        """A file or folder that the script names."""
        return self.folder / name

    def files(self) -> dict[str, Path]:
        """Every file or folder that the script reads, by the name it has there."""
        return {name: self.path_of(name) for edit in self.edits for name in files_of(edit.settings)}

    def canonical(self) -> list[dict[str, Any]]:
        """The script as JSON values with all defaults: two scripts that say the same are equal here."""
        return [{edit.verb: edit.settings.model_dump(mode="json", by_alias=True)} for edit in self.edits]

    def digest(self) -> str:
        """Hash of what the script says and of what it reads; part of the key of everything made with it.

        Raises:
            InputError: a file or folder that it names does not exist. IntegrityError: one was altered.
        """
        contents = {}
        for edit in self.edits:
            for name in files_of(edit.settings):
                try:
                    contents[name] = store.digest(self.path_of(name))
                except InputError as problem:
                    raise InputError("the script names a file that is not there", where=f"{edit.where}: {edit.verb}",
                        got=str(self.path_of(name)), remedy="paths are relative to the script's folder") from problem  # fmt: skip
        text = store.json_text(_with_contents(self.canonical(), contents), indent=None)
        return hashlib.sha256(text.encode()).hexdigest()

    def conditions(self) -> dict[str, Any]:
        """The last settings of weather, light and season: records by verb. They change pictures, not geometry."""
        return {edit.verb: edit.settings for edit in self.edits if edit.verb in CONDITIONS}

    def text(self) -> str:
        """The script as YAML with all defaults and with absolute paths."""
        named = {name: str(path.resolve()) for name, path in self.files().items()}
        return yaml.safe_dump(_with_contents(self.canonical(), named), sort_keys=False)


def _with_contents(value: Any, names: Mapping[str, str]) -> Any:
    """The values of ``file``, ``run`` and ``image`` replaced."""
    if isinstance(value, list):
        return [_with_contents(inner, names) for inner in value]
    if not isinstance(value, dict):
        return value
    paths = ("file", "run", "image")
    return {k: names[v] if k in paths and isinstance(v, str) else _with_contents(v, names) for k, v in value.items()}


def read_edits(path: Path | str) -> EditScript:
    """Read a script.

    Raises:
        InputError: it is missing, no YAML, or says something that no verb understands.
    """
    path = Path(path)
    return parse_edits(store.read_bytes(path), str(path), path.parent)


def parse_edits(text: str | bytes, where: str, folder: Path = Path()) -> EditScript:
    """Check a script.

    Args:
        where: name of the file for messages. folder: what its paths are relative to.
    """
    entries, lines = parse_with_lines(text, where)
    if not isinstance(entries, list) or not entries:
        raise InputError("an edit script is a list of edits", where=where, expected="lines such as `- remove: {ids: [car-003]}`",
            got="nothing" if entries in (None, []) else type(entries).__name__)  # fmt: skip
    return EditScript(tuple(_one(index, value, lines, where) for index, value in enumerate(entries)), Path(folder))


def _one(index: int, value: Any, lines: Lines, where: str) -> ScriptEdit:
    at = f"{where}, line {lines[(index,)]}"
    if not isinstance(value, dict) or len(value) != 1:
        raise InputError("an edit is one verb with its settings", where=at, expected="e.g. `- remove: {ids: [car-003]}`",
            got=short(value, 80))  # fmt: skip
    ((verb, settings),) = value.items()
    if verb not in VERBS:
        near = nearest(verb, VERBS)
        raise InputError(f"there is no verb {verb!r}", where=at, expected=f"one of {', '.join(VERBS)}",
            remedy=f"did you mean {near!r}?" if near else "see docs/edit.md")  # fmt: skip
    try:
        return ScriptEdit(verb, VERBS[verb].model_validate({} if settings is None else settings), at)
    except ValidationError as error:
        told = first_problem(error, place(verb))
        steps = [int(step) if step.isdigit() else step for step in re.findall(r"[^.\[\]]+", told.where)]
        line = _line_at((index, *steps), lines, told.what)
        raise told.located(f"{where}, line {line}: {told.where}") from error


def _line_at(path: tuple[str | int, ...], lines: Lines, said: str) -> int:
    """The line of a field, of an unknown one that a message names, or of what should hold it."""
    while path not in lines:
        path = path[:-1]
    unknown = (line for inner, line in lines.items() if inner[:-1] == path and f"unknown field {inner[-1]!r}" in said)
    return next(unknown, lines[path])
