"""Where a result is made before it is published.

    WORK/<key>.<attempt>/      inputs/<step>   source   weights   settings.yaml   result
    WORK/<key>.left/           what an attempt left that failed or was stopped; the next one goes on with it

Commands run in this folder and name what is in it by relative names, so that a result does not depend on where it was made. An attempt
that takes over renames the folder of the one before: a worker that was only slow finds its folder gone, and fails.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import yaml

from mudg.base import log, store, transfer
from mudg.base.errors import InputError, IntegrityError, MudgError, ResourceError
from mudg.base.location import Location
from mudg.base.remote import PACKAGES
from mudg.stages.batches.folders import BatchFolder
from mudg.stages.batches.inputs import InputStore
from mudg.stages.batches.lists import CITY
from mudg.stages.batches.plan import REVISION, Unit, command_of

RESULT: Final = "result"
SETTINGS: Final = "settings.yaml"
_ADDRESS: Final = re.compile(rf"({'|'.join(PACKAGES)}):/+")
"""The beginning of an address, also as a path writes it."""


class WorkFolder:
    """The folder of one attempt at one step of a scene."""

    def __init__(self, folder: BatchFolder, unit: Unit, attempt: int, scratch: Path | None, inputs: InputStore) -> None:
        self._folder, self._unit, self._attempt = folder, unit, attempt
        self._given_scratch, self._inputs = scratch, inputs
        self._held = contextlib.ExitStack()
        """Inputs in use."""
        self.cancelled: Callable[[], bool] = lambda: False
        self.in_output = folder.out.local is not None and scratch is None
        root = folder.work.local if self.in_output and folder.work.local is not None else (scratch or default_scratch()) / "mudg_batch"
        self._root = root.absolute()
        self.path = self._root / f"{unit.key}.{attempt}"
        self.cwd: Path | None = self.path
        """Where the command runs; None: where this program runs."""

    @property
    def result(self) -> Path:
        """The folder that the step's command writes."""
        return self.path / RESULT

    @property
    def _left(self) -> Path:
        return self._root / f"{self._unit.key}.left"

    @property
    def _published(self) -> Location:
        return self._folder.out / self._unit.place

    def adopted(self) -> Path | None:
        """The published result, if it is there without a commit record: its worker was cut off, or it was rejected and is tried again."""
        place = self._published.local
        if not self.in_output or place is None:
            return self._fetched()
        if not place.exists():
            return None
        if (place / store.MANIFEST).is_file():
            try:
                store.verify_manifest(place)
                store.verify_record(place)
            except (IntegrityError, InputError):
                log.warn(f"{place} is damaged and is made again")
                place.rename(self._root / f"{self._unit.key}.damaged")
                return None
        return place

    def _fetched(self) -> Path | None:
        """The same where results are uploaded."""
        try:
            upload = transfer.uploaded(self._published.side)
            if upload is None or not upload.complete:
                return None
            self._published.fetch(self.result)
        except MudgError as error:
            log.warn(f"{self._published} cannot be used and is made again: {error.what}")
            shutil.rmtree(self.path, ignore_errors=True)
            return None
        return self.result

    def prepare(self) -> None:
        """Make the folder, with what earlier attempts left, and stage in what the command reads."""
        self._take_over()
        store.make_folder(self.path)
        for name, key in self._unit.needs.items():
            self._stage_in(self._folder.out / f"{self._unit.entry.name}/{name}/{key[:12]}", self.path / "inputs" / name)
        self._stage_in_source()
        self._write_settings()

    def _write_settings(self) -> None:
        if self._unit.stage.settings:
            text = yaml.safe_dump(self._with_fetched(self._unit.stage.settings), sort_keys=False)
            store.write_in_tree(self.path / SETTINGS, text.encode())

    def _with_fetched(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Settings with names below the work folder for addresses: weights are fetched once for all steps on this machine."""
        values: dict[str, Any] = {}
        for name, value in settings.items():
            if isinstance(value, Mapping):
                values[name] = self._with_fetched(value)
            elif isinstance(value, str) and (found := _ADDRESS.match(value)):
                source = Location.of(f"{found[1]}://{value[found.end() :]}")
                link = f"weights/{hashlib.sha256(str(source).encode()).hexdigest()[:8]}/{source.name}"
                self._link(source, self.path / link, fixed=True)
                values[name] = link
            else:
                values[name] = value
        return values

    def _take_over(self) -> None:
        earlier = [self._left, *(self._root / f"{self._unit.key}.{number}" for number in range(self._attempt - 1, 0, -1))]
        for one in earlier:
            if one.is_dir() and not self.path.exists():
                with contextlib.suppress(FileNotFoundError):
                    one.rename(self.path)
                    for lock in self.path.rglob("lock"):  # of a run whose folder this was
                        lock.unlink(missing_ok=True)
        partial = self._folder.partial(self._unit.key)
        if not self.in_output and not self.path.exists() and partial.exists():
            try:
                partial.fetch(self.result)
            except MudgError as error:
                log.warn(f"{self._unit.title}: what an earlier attempt made cannot be used: {error.what}")
                shutil.rmtree(self.path, ignore_errors=True)

    def _stage_in(self, source: Location, to: Path) -> None:
        local = source.local
        if local is None:
            try:
                self._link(source, to, fixed=True)
            except InputError as error:  # it is on record, so it is whole, but where a second worker uploads the same once more
                words = "the result of an earlier step cannot be fetched"
                raise ResourceError(words, where=str(source), got=error.what) from error
            return
        if to.is_symlink() or to.exists():
            return
        store.make_folder(to.parent)
        with contextlib.suppress(FileExistsError):
            to.symlink_to(os.path.abspath(local))

    def _stage_in_source(self) -> None:
        source = self._unit.entry.source
        if "{source}" in " ".join(self._unit.stage.words) and "://" in source:
            place = Location.of(source)
            self._link(place, self.path / "source" / place.name, self._unit.entry.settings.get(REVISION, ""))

    def _link(self, source: Location, to: Path, version: str = "", fixed: bool = False) -> None:
        """A link to an input, which stays on this machine until the work folder is left or removed."""
        there = self._held.enter_context(self._inputs.held(source, version, fixed, self.cancelled))
        if to.is_symlink():  # of an earlier attempt
            to.unlink()
        store.make_folder(to.parent)
        to.symlink_to(there)

    def command(self) -> list[str]:
        """The step's command line, to be run in ``path``."""
        source = self._unit.entry.source
        if source != CITY:
            source = f"source/{Location.of(source).name}" if "://" in source else os.path.abspath(source)
        places = {"source": source, **{name: f"inputs/{name}" for name in self._unit.needs}}
        return command_of(self._unit, places, RESULT, SETTINGS if self._unit.stage.settings else "")

    def replacing(self) -> list[str] | None:
        """The command that replaces what an earlier failure left of another state of the source; None where nothing such is."""
        return None

    def publish(self, read_later: bool = False) -> None:
        """Bring the result to its place in the output. Somebody else's result of the same key is as good.

        Args:
            read_later: a later step reads it: a copy stays on this machine, if the output is none of its folders.
        """
        place = self._published
        if not self.in_output or place.local is None:
            place.push(self.result)
            if read_later and place.local is None and self.result.is_dir():
                self._inputs.keep(place, self.result)
            return
        store.make_folder(place.local.parent)
        try:
            self.result.rename(place.local)
        except OSError as error:
            if not place.local.exists():
                raise ResourceError("the result cannot be moved to its place", where=str(place), got=str(error)) from error
        store.fsync_directory(place.local.parent)

    def leave(self, stopped: bool) -> None:
        """Keep an unfinished result for the next attempt: here, and where others can have it if this worker was asked to stop."""
        self._held.close()
        if not self.path.is_dir():
            return
        if stopped and not self.in_output and self.result.is_dir():
            self._folder.partial(self._unit.key).push(self.result)
        if self.in_output or (stopped is False and (self.result / store.RUN_STATE).is_file()):
            shutil.rmtree(self._left, ignore_errors=True)
            self.path.rename(self._left)
        else:
            shutil.rmtree(self.path, ignore_errors=True)

    def second(self) -> WorkFolder:
        """A folder for a second run from nothing."""
        unit = replace(self._unit, key=f"{self._unit.key}.second")
        made = WorkFolder(self._folder, unit, self._attempt, self._given_scratch, self._inputs)
        made.remove()
        return made

    def remove(self) -> None:
        """Remove the folder, and what was put elsewhere for other workers."""
        self._held.close()
        shutil.rmtree(self.path, ignore_errors=True)
        if not self.in_output:
            with contextlib.suppress(MudgError):
                partial: Any = self._folder.partial(self._unit.key)
                if partial.exists():
                    partial.remove()


class DirectFolder(WorkFolder):
    """The folder of a step that makes its result right where it belongs. The verb itself resumes, verifies and replaces there."""

    def __init__(self, folder: BatchFolder, unit: Unit, attempt: int, inputs: InputStore) -> None:
        super().__init__(folder, unit, attempt, None, inputs)
        self.cwd = None
        local = (folder.out / unit.place).local
        self._result = local if local is not None else self.path

    @property
    def result(self) -> Path:
        """The folder right below the output."""
        return self._result

    def adopted(self) -> Path | None:
        """Nothing: the verb itself reuses what is finished."""
        return None

    def prepare(self) -> None:
        """Write the settings."""
        store.make_folder(self.path)
        self._write_settings()

    def command(self) -> list[str]:
        """The command line, to be run where this program runs."""
        source = self._unit.entry.source
        return command_of(self._unit, {"source": source}, str(self.result), str(self.path / SETTINGS))

    def replacing(self) -> list[str] | None:
        """The same with --overwrite, where an unfinished result lies."""
        words = self.command()
        try:
            unfinished = store.read_json(self.result / store.RUN_STATE)["state"] in ("running", "interrupted")
        except (InputError, KeyError, TypeError):
            unfinished = False
        return [*words, "--overwrite"] if unfinished and "--overwrite" not in words else None

    def publish(self, read_later: bool = False) -> None:
        """Nothing: it is there already."""

    def leave(self, stopped: bool) -> None:
        """The verb resumes in its own folder."""
        self.remove()


def work_folder(folder: BatchFolder, unit: Unit, attempt: int, scratch: Path | None, inputs: InputStore) -> WorkFolder:
    """The folder of an attempt."""
    if unit.stage.direct:
        return DirectFolder(folder, unit, attempt, inputs)
    return WorkFolder(folder, unit, attempt, scratch, inputs)


def default_scratch() -> Path:
    """Folder for temporary files of this machine."""
    import tempfile

    return Path(os.environ.get("SLURM_TMPDIR") or os.environ.get("TMPDIR") or tempfile.gettempdir())
