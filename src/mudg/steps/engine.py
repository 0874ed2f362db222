"""What is done for every verb that makes a folder or file: output and inputs apart, the key, reuse, resume, replacement."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

from mudg.steps.step import Step, flag_of, hint_of

if typing.TYPE_CHECKING:
    from mudg.base.run_folder import RunDir, VerbOutput
    from mudg.editing.script import EditScript


class Result(Step):
    """A step that makes a folder of its own, which is verified and reused, resumed, or replaced when the new one is finished.

    A subclass says what it writes (`version`, `files`), and how (`make`). What it reads follows from its fields; the methods below are
    overridden where it reads more, or less.
    """

    version: ClassVar[int]
    """Counts up when the rules of the verb change; older results are then made again."""
    files: ClassVar[tuple[str, ...]]
    """Patterns of what it writes (see `VerbOutput`)."""
    if typing.TYPE_CHECKING:
        out: Path
        overwrite: bool = False
        settings: Any = None

    def act(self) -> Any:
        return fill(self)

    def output(self) -> VerbOutput:
        """Verb, version and files, as the folder's record names them."""
        from mudg.base.run_folder import VerbOutput

        return VerbOutput(self.verb(), self.version, self.files)

    @property
    def is_file(self) -> bool:
        """Whether it writes one file, with a description beside it, and no folder."""
        return False

    def checked(self) -> Self:
        """This step as it is carried out, with all that follows from the machine filled in. Refuses what can be refused without reading."""
        return self

    def reads(self) -> dict[str, Path | str | None]:
        """Files and folders that it reads, by their names in messages. The output must lie apart from all of them."""
        found = paths_of(self)
        for name in [name for name in found if is_script(self, name) and found[name]]:
            found |= {f"{found[name]}: {file}": path for file, path in script_of(Path(str(found[name])))[0].files().items()}
        return found

    def inputs(self) -> dict[str, str]:
        """Digests of what the result depends on. They are part of the key, in this order."""
        return self.digests(paths_of(self))

    def digests(self, paths: Mapping[str, Path | str | None]) -> dict[str, str]:
        """Digests of files and folders by name, without those that are None or empty; of edit scripts by what they say."""
        from mudg.base import store

        return {
            name: script_of(Path(path))[1] if is_script(self, name) else store.digest(Path(path)) for name, path in paths.items() if path
        }

    def key_settings(self) -> dict[str, Any]:
        """Settings that the result depends on, the other part of the key."""
        from mudg.base.config import result_settings

        return result_settings(self.settings)

    def places(self) -> dict[str, Path | None]:
        """Inputs whose places the folder remembers for those who read it."""
        return {}

    def prepare(self, inputs: dict[str, str]) -> Any:
        """Read what is needed to refuse what cannot be done, before anything is written; `make` gets what it returns.

        Args:
            inputs: digests; those that only reading tells are added.
        """

    def make(self, work: Any, prepared: Any) -> dict[str, Any]:
        """Fill the folder, or go on with what an interrupted run left there. Returns the summary for its record.

        Args:
            work: the folder's `RunDir`; of a single file its `ResultFile`. prepared: what `prepare` returned.
        """
        raise NotImplementedError

    def resulting(self, folder: Path) -> Path:
        """What `run` returns of the finished folder."""
        return folder


def fill(step: Result) -> Path:
    """Make the result of a step, or reuse it."""
    from mudg.base.run_folder import ResultFile

    step = step.checked()
    if step.is_file:
        inputs, prepared = ready(step)
        with ResultFile.open(step.out, step.verb(), step.key_settings(), inputs, overwrite=step.overwrite) as file:
            return file.reused() if file.complete else file.finish({**step.make(file, prepared), "inputs": inputs})
    prepared, folder = opened(step)
    if not folder.complete:
        try:
            folder.finish(step.make(folder, prepared))
        except KeyboardInterrupt:
            folder.pause()
            raise
    return step.resulting(folder.path)


def ready(step: Result) -> tuple[dict[str, str], Any]:
    """Digests of what a step reads, and what it prepared: all that can be refused is, and nothing is written."""
    from mudg.base.run_folder import refuse_overlap

    refuse_overlap(step.out, step.reads())
    inputs = step.inputs()
    return inputs, step.prepare(inputs)


def opened(step: Result) -> tuple[Any, RunDir]:
    """What a step prepared, and its folder; that of a finished result is verified and said to be reused."""
    from mudg.base.run_folder import RunDir

    inputs, prepared = ready(step)
    folder = RunDir.open(step.out, step.output(), step.key_settings(), inputs, step.overwrite, step.places())
    if folder.complete:
        folder.reused()
    return prepared, folder


def paths_of(step: Step) -> dict[str, Path | str | None]:
    """Inputs of a step by name, as its fields declare them: further ones of a field are numbered, and an edit script names more."""
    found: dict[str, Path | str | None] = {}
    for field in dataclasses.fields(step):
        value = getattr(step, field.name)
        if field.name in ("out", "list") or not is_path(hint_of(type(step), field.name)):
            continue
        if isinstance(value, Mapping):
            found |= value
        elif isinstance(value, tuple):
            found |= {f"{field.name} {number}" if number else field.name: path for number, path in enumerate(value)}
        else:
            found[field.name] = value
    return found


def is_path(kind: Any) -> bool:
    """Whether values of a type are paths, alone or many."""
    inside = typing.get_args(kind)
    return kind is Path or (bool(inside) and any(is_path(one) for one in inside))


def is_script(step: Step, name: str) -> bool:
    """Whether a field names an edit script."""
    return name in {field.name for field in dataclasses.fields(step)} and flag_of(type(step), name).metavar.endswith(".yaml")


def script_of(path: Path) -> tuple[EditScript, str]:
    """An edit script, and the digest of what it says and of the files that it names."""
    from mudg.editing.carried import read_and_digest

    return read_and_digest(path)
