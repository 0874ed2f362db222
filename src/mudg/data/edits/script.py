"""Reading edit scripts: a list of verbs, each with its settings. What is wrong is told with file, line, verb and field."""

from __future__ import annotations

import difflib
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.plain_yaml import parse_yaml
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
    entries = parse_yaml(text, where)
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    if not isinstance(root, yaml.SequenceNode) or not entries:
        raise InputError("an edit script is a list of edits", where=where, expected="lines such as `- remove: {ids: [car-003]}`",
            got="nothing" if entries in (None, []) else type(entries).__name__)  # fmt: skip
    return EditScript(tuple(_one(node, value, where) for node, value in zip(root.value, entries, strict=True)), Path(folder))


def _one(node: yaml.Node, value: Any, where: str) -> ScriptEdit:
    at = f"{where}, line {_line(node)}"
    if not isinstance(value, dict) or len(value) != 1 or not isinstance(node, yaml.MappingNode):
        raise InputError("an edit is one verb with its settings", where=at, expected="e.g. `- remove: {ids: [car-003]}`",
            got=repr(value)[:80])  # fmt: skip
    ((verb, settings),) = value.items()
    if verb not in VERBS:
        near = difflib.get_close_matches(str(verb), VERBS, 1)
        raise InputError(f"there is no verb {verb!r}", where=at, expected=f"one of {', '.join(VERBS)}",
            remedy=f"did you mean {near[0]!r}?" if near else "see docs/edit.md")  # fmt: skip
    _refuse_doubles(node, where)
    try:
        return ScriptEdit(verb, VERBS[verb].model_validate({} if settings is None else settings), at)
    except ValidationError as error:
        told = first_problem(error, place(verb))
        steps = [int(step) if step.isdigit() else step for step in re.findall(r"[^.\[\]]+", told.where)[1:]]
        line = _line_at(node.value[0][1], steps, told.what) or _line(node)
        raise told.located(f"{where}, line {line}: {told.where}") from error


def _line(node: yaml.Node) -> int:
    return node.start_mark.line + 1


def _line_at(node: yaml.Node, loc: Sequence[str | int], said: str) -> int | None:
    """The line of a field, of an unknown one that a message names, or of what should hold it."""
    for step in loc:
        inner = None
        if isinstance(node, yaml.MappingNode):
            inner = next((value for key, value in node.value if key.value == step), None)
        elif isinstance(node, yaml.SequenceNode) and isinstance(step, int) and step < len(node.value):
            inner = node.value[step]
        if inner is None:
            break
        node = inner
    keys = [key for key, _ in node.value] if isinstance(node, yaml.MappingNode) else []
    return next((_line(key) for key in keys if f"unknown field {key.value!r}" in said), _line(node))


def _refuse_doubles(node: yaml.Node, where: str) -> None:
    """YAML keeps the last of two equal keys without a word."""
    for mapping in _mappings(node):
        seen: set[str] = set()
        for key, _ in mapping.value:
            if key.value in seen:
                raise InputError(f"{key.value!r} is given twice", where=f"{where}, line {_line(key)}", remedy="keep one of them")
            seen.add(key.value)


def _mappings(node: yaml.Node) -> Iterator[yaml.MappingNode]:
    if isinstance(node, yaml.MappingNode):
        yield node
        for _, value in node.value:
            yield from _mappings(value)
    elif isinstance(node, yaml.SequenceNode):
        for value in node.value:
            yield from _mappings(value)


