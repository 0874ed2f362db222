"""What is done for every verb that makes a folder or file: output and inputs apart, the key, reuse, resume,
replacement; and the fields that many of them share."""

from __future__ import annotations

import dataclasses
import importlib.util
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from mudg.base.errors import ResourceError
from mudg.steps.step import Flag, Step, flag_of, hint_of, hints

if typing.TYPE_CHECKING:
    from mudg.base.run_folder import RunDir, VerbOutput
    from mudg.editing.script import EditScript

Make = Callable[[Any], dict[str, Any]]


class Result(Step):
    """A step that makes a folder of its own, which is verified and reused, resumed, or replaced when the new one is
    finished. A subclass says what it writes (`version`, `files`), and how (`prepare`, or `make`); the methods below are
    overridden where it reads more, or less, than its fields say."""

    version: ClassVar[int]
    """Counts up when the rules of the verb change; older results are then made again."""
    files: ClassVar[tuple[str, ...]]
    """Patterns of what it writes (see `VerbOutput`)."""
    idle: ClassVar[tuple[str, ...]] = ()
    """Settings that no result depends on."""
    if typing.TYPE_CHECKING:
        out: Path
        overwrite: bool = False

    def act(self) -> Path:
        """Make the result, or reuse it. A path that leads nowhere is refused before anything heavy is loaded."""
        from mudg.base import store
        from mudg.base.run_folder import ResultFile

        for path in paths_of(self).values():
            if path is not None:
                store.require(Path(path))
        if self.is_file:
            step, inputs, make = ready(self)
            with ResultFile.open(step.out, step.verb(), step.key_settings(), inputs, overwrite=step.overwrite) as file:
                return file.reused() if file.complete else file.finish({**make(file), "inputs": inputs})
        folder, make = opened(self)
        if not folder.complete:
            try:
                folder.finish(make(folder))
            except KeyboardInterrupt:
                folder.pause()
                raise
        return folder.path

    def output(self) -> VerbOutput:
        """Verb, version and files, as the folder's record names them."""
        from mudg.base.run_folder import VerbOutput

        return VerbOutput(self.verb(), self.version, self.files)

    @property
    def is_file(self) -> bool:
        """Whether it writes one file, with a description beside it, and no folder."""
        return False

    def checked(self) -> Self:
        """This step as it is carried out, with all that follows from the machine filled in. Refuses what can be refused
        without reading."""
        return self

    def reads(self) -> dict[str, Path | str | None]:
        """Files and folders that it reads, by their names in messages. The output must lie apart from all of them."""
        from mudg.editing.script import read_edits

        paths = paths_of(self)
        for path in [path for name, path in paths.items() if path and is_script(self, name)]:
            paths |= {f"{path}: {name}": file for name, file in read_edits(Path(path)).files().items()}
        return paths

    def inputs(self) -> dict[str, str]:
        """Digests of what the result depends on. They are part of the key, in this order."""
        return self.digests(paths_of(self))

    def digests(self, paths: Mapping[str, Path | str | None]) -> dict[str, str]:
        """Digests of files and folders by name, without those that are None or empty; of edit scripts by what they
        say."""
        from mudg.base import store
        from mudg.editing.script import read_edits

        return {
            name: read_edits(Path(path)).digest() if is_script(self, name) else store.digest(Path(path))
            for name, path in paths.items()
            if path
        }

    def key_settings(self) -> dict[str, Any]:
        """Settings that the result depends on, the other part of the key."""
        from mudg.base.config import result_settings

        return {name: value for name, value in result_settings(vars(self)["settings"]).items() if name not in self.idle}

    def places(self) -> dict[str, Path | None]:
        """Inputs whose places the folder remembers for those who read it."""
        return {}

    def prepare(self, inputs: dict[str, str]) -> Make:
        """What makes the result. All that can be refused is refused here, before anything is written. inputs: digests;
        those that only reading tells are added."""
        return self.make

    def make(self, work: Any) -> dict[str, Any]:
        """Fill the work folder (`RunDir`; of a single file its `ResultFile`), or go on with what an interrupted run
        left there. Returns the summary for its record."""
        raise NotImplementedError


def ready(step: Result) -> tuple[Result, dict[str, str], Make]:
    """A step as it is carried out, digests of what it reads, and what makes it: all that can be refused is, and nothing
    is written."""
    from mudg.base.run_folder import refuse_overlap

    refuse_overlap(step.out, step.reads())
    if isinstance(step, Watched) and step.tensorboard and importlib.util.find_spec("tensorboard") is None:
        what, remedy = "TensorBoard is not installed", "pip install 'mudg[track]', or leave the flag out"
        raise ResourceError(what, where="--tensorboard", remedy=f"{remedy}: log.jsonl holds the same")
    step = step.checked()
    inputs = step.inputs()
    return step, inputs, step.prepare(inputs)


def opened(step: Result) -> tuple[RunDir, Make]:
    """The folder of a step, and what fills it; a finished result is verified and said to be reused."""
    from mudg.base.run_folder import RunDir

    step, inputs, make = ready(step)
    folder = RunDir.open(step.out, step.output(), step.key_settings(), inputs, step.overwrite, step.places())
    if folder.complete:
        folder.reused()
    elif isinstance(step, Watched) and step.tensorboard:
        folder.watch()
    return folder, make


def paths_of(step: Step) -> dict[str, Path | str | None]:
    """Inputs of a step by name, as its fields declare them; further ones of a name are numbered."""
    paths: dict[str, Path | str | None] = {}
    for field in dataclasses.fields(step):
        value = getattr(step, field.name)
        if field.name in ("out", "list") or not is_path(hint_of(type(step), field.name)):
            continue
        for name, inner in value.items() if isinstance(value, Mapping) else [(field.name, value)]:
            of_name = enumerate(inner if isinstance(inner, tuple) else (inner,))
            paths |= {f"{name} {number}" if number else name: path for number, path in of_name}
    return paths


def is_path(kind: Any) -> bool:
    """Whether values of a type are paths, alone or many."""
    inside = typing.get_args(kind)
    return kind is Path or (bool(inside) and any(is_path(one) for one in inside))


def is_script(step: Step, name: str) -> bool:
    """Whether a field names an edit script."""
    return name in hints(type(step)) and flag_of(type(step), name).metavar.endswith(".yaml")


def script_of(path: Path | None) -> EditScript | None:
    """The edit script at a path, if there is one."""
    from mudg.editing.script import read_edits

    return None if path is None else read_edits(path)


class Output(Result):
    """A step that writes a folder."""

    out: Annotated[Path, Flag()]
    """Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified
    and reused."""
    overwrite: bool = False
    """Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one
    is finished, so the disk must hold both. Files that do not belong to the old result are kept."""


class Watched(Output):
    """A step that trains, and whose numbers can be watched."""

    tensorboard: bool = False
    """Also write the numbers of log.jsonl to OUT/tensorboard, for TensorBoard (needs `pip install 'mudg[track]'`)."""
