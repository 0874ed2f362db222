"""Commands on addresses: ``mudg fuse s3://bucket/scene --out s3://bucket/fused``.

Every verb works on folders of this machine. Where a command names addresses, this is the one border: inputs are fetched
into a scratch folder, the verb runs there, what it made is uploaded, its manifest last, and the scratch folder is
removed. The folder's name follows from the command, so that the same command, stopped at any moment, goes on with what
it finds there.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Final

from mudg.base import log, store
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.location import PACKAGES, Location, checked_address, scheme_of
from mudg.base.run_folder import take_lock

_OUTPUTS: Final = ("out", "to")
"""Flags that name what a verb writes."""
_ADDRESS: Final = re.compile(r"(?:^|(?<=[=,\s]))[A-Za-z][A-Za-z0-9+.\-]+://\S*")
_IN_A_PATH: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.\-]+):[/\\]+")


def refuse_secrets(words: Sequence[str]) -> None:
    """UsageError for a word with an address that holds credentials, before anything shows it."""
    for word in words:
        for found in _ADDRESS.findall(word):
            if scheme_of(found) in PACKAGES:
                checked_address(found)
            elif "@" in found.partition("://")[2].partition("/")[0]:
                where = f"{scheme_of(found)}://..."
                raise UsageError("an address holds a user or a password", where=where, remedy="leave them out")


def run_staged(
    verb: str, args: Any, call: Callable[[Any], dict[str, Any]], scratch: Path | None = None
) -> dict[str, Any]:
    """Call a verb with its flags, a dataclass; those that are addresses are staged in ``scratch`` (None: the system's
    folder for temporary files). Returns what ``call`` says, with addresses for paths. UsageError: an address where none
    can be, or an output that touches an input. And what transfers and the verb raise."""
    plan = _Staging.of(verb, args, scratch)
    if not plan.inputs and not plan.outputs:
        return call(args)
    with plan.locked():
        for given, at in plan.inputs.items():
            log.info(f"fetching {given}")
            given.fetch(at, mirror=True)
        for given, at in plan.outputs.items():
            _fetch_earlier(given, at)
        result = call(plan.args)
        for given, at in plan.outputs.items():
            _upload(given, at)
    shutil.rmtree(plan.folder, ignore_errors=True)
    return {name: plan.shown(value) for name, value in result.items()}


# what is where ------------------------------------------------------------------------------------


@dataclass
class _Staging:
    """Which address lies where on this machine while the command runs."""

    args: Any
    folder: Path
    inputs: dict[Location, Path] = field(default_factory=dict)
    outputs: dict[Location, Path] = field(default_factory=dict)

    @classmethod
    def of(cls, verb: str, args: Any, scratch: Path | None) -> _Staging:
        flags = {item.name: getattr(args, item.name) for item in fields(args) if item.name != "settings"}
        found = sorted({str(one) for value in flags.values() for one in _addresses(value)})
        key = hashlib.sha256("\n".join([verb, *found]).encode()).hexdigest()[:12]
        if scratch is not None and _address(scratch) is not None:
            raise UsageError("the scratch folder lies on this machine", where="--scratch", got=str(scratch))
        root = Path(tempfile.gettempdir()) if scratch is None else scratch
        plan = cls(args, root.absolute() / f"mudg-{verb.replace(' ', '-')}-{key}")
        changes = {name: plan._placed(name, value) for name, value in flags.items()}
        if plan.inputs or plan.outputs:
            plan.args = replace(args, **changes)
            plan._check()
        _refuse_in_settings(getattr(args, "settings", None), "")
        return plan

    def _placed(self, name: str, value: Any) -> Any:
        """A flag's value with paths of this machine for addresses."""
        if isinstance(value, tuple):
            return tuple(self._placed(name, one) for one in value)
        if isinstance(value, Mapping):  # mudg score --views NAME=ADDRESS
            return {key: self._placed(name, one) for key, one in value.items()}
        location = _address(value) if isinstance(value, str | Path) else None
        if location is None:
            return value
        if name == "config":
            got = str(location)
            raise UsageError("--config is a file of this machine", where="--config", got=got, remedy="fetch it first")
        place = location.local
        if place is None:
            known, part = (self.outputs, "out") if name in _OUTPUTS else (self.inputs, "in")
            place = known.setdefault(location, self.folder / part / str(len(known)) / location.name)
        return place if isinstance(value, Path) else str(place)

    def _check(self) -> None:
        for out in self.outputs:
            if out.text.count("/") < 3:
                raise UsageError("an output is a folder or file in a bucket", where=str(out), expected=f"{out}/name")
            for given in self.inputs:
                if f"{out}/".startswith(f"{given}/") or f"{given}/".startswith(f"{out}/"):
                    where, remedy = f"output: {out}", "choose an output apart from everything that is read"
                    raise UsageError("the output touches an input", where=where, got=f"input: {given}", remedy=remedy)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """The scratch folder, for this process alone. After a failure it stays, for the same command to go on with."""
        _make_private(self.folder)
        lock = self.folder / "lock"
        take_lock(lock)
        try:
            yield
        except BaseException:
            store.remove(lock)
            again = "the same command goes on with it. Delete the folder to give it up"
            log.info(f"{self.folder} keeps what was fetched and made: {again}")
            raise

    def shown(self, value: Any) -> Any:
        """What a verb says, with addresses for the scratch folder's paths."""
        if isinstance(value, Mapping):
            return {name: self.shown(one) for name, one in value.items()}
        if isinstance(value, list | tuple):
            return [self.shown(one) for one in value]
        if not isinstance(value, str | Path):
            return value
        text = str(value)
        for given, at in (*self.outputs.items(), *self.inputs.items()):
            text = text.replace(str(at), str(given))
        return text


def _addresses(value: Any) -> Iterator[Location]:
    several = value.values() if isinstance(value, Mapping) else value if isinstance(value, tuple) else (value,)
    for one in several:
        found = _address(one)
        if found is not None:
            yield found


def _address(value: Any) -> Location | None:
    """The location behind a flag's value; None for a path that is none, and anything else."""
    if isinstance(value, str) and scheme_of(value):
        return Location.of(value)
    if isinstance(value, Path) and not value.exists():
        found = _IN_A_PATH.match(value.as_posix())
        if found:
            return Location.of(f"{found[1]}://{value.as_posix()[found.end() :]}")
    return None


def _refuse_in_settings(settings: Any, where: str) -> None:
    """UsageError for an address in a setting: settings are part of what a result is made of, and name paths."""
    if is_dataclass(settings):
        for item in fields(settings):
            _refuse_in_settings(getattr(settings, item.name), f"{where}.{item.name}" if where else item.name)
    elif isinstance(settings, list | tuple):
        for one in settings:
            _refuse_in_settings(one, where)
    elif isinstance(settings, str | Path):
        found = re.match(r"([a-z0-9]+):/", str(settings))
        if found and found[1] in PACKAGES:
            what, remedy = "a setting names a path of this machine", "fetch what is there, and give its folder"
            raise UsageError(what, where=f"--{where.replace('_', '-')}", got=str(settings)[:200], remedy=remedy)


def _make_private(folder: Path) -> None:
    """A folder of this user alone: its name can be guessed, and the system's temporary folder is everybody's."""
    store.make_folder(folder.parent)
    with store.disk_errors("cannot create a folder", folder, "choose another --scratch"):
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        found = folder.lstat()
        if folder.is_symlink() or not folder.is_dir() or (hasattr(os, "getuid") and found.st_uid != os.getuid()):
            what, remedy = "the scratch folder belongs to somebody else", "choose another --scratch"
            raise ResourceError(what, where=str(folder), remedy=remedy)


# there and back -----------------------------------------------------------------------------------


def _fetch_earlier(location: Location, at: Path) -> None:
    """What the output holds already: the verb reuses or refuses it. What an interrupted command left goes first."""
    store.make_folder(at.parent)
    if at.exists() or not location.exists():
        return
    record = location.uploaded()
    if record is not None and not record.complete:
        return  # an upload that was stopped; this one takes its place
    if record is None and store.MANIFEST not in (names := location.names()) and names:
        remedy = "choose an address at which nothing is"
        raise UsageError("the output address holds files of something else", where=str(location), remedy=remedy)
    log.info(f"fetching what {location} holds")
    partial = at.parent / f".{at.name}.earliers.part"
    location.fetch(partial, mirror=True)
    store.take_place(partial, at)


def _upload(location: Location, at: Path) -> None:
    """Everything that the verb made, also what lies beside the file that it was to write."""
    made = [path for path in sorted(at.parent.iterdir()) if ".part" not in path.name]
    if at not in made:
        raise InputError("the command made nothing", where=str(location))
    above = str(location).rpartition("/")[0]
    for path in sorted(made, key=lambda one: one == at):
        target = Location.of(f"{above}/{path.name}")
        log.info(f"uploading {target}")
        if path.is_dir():
            target.push(path)
        else:
            target.put_file(path)
