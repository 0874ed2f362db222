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
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Final

from mudg.base import log, store
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.location import PACKAGES, Location, checked_address, scheme_of
from mudg.base.run_folder import locked

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
    if scratch is not None and _address(scratch) is not None:
        raise UsageError("the scratch folder lies on this machine", where="--scratch", got=str(scratch))
    _refuse_in_settings(getattr(args, "settings", None), "")
    flags = {item.name: getattr(args, item.name) for item in fields(args) if item.name != "settings"}
    inputs, outputs = dict[Location, str](), dict[Location, str]()
    for name, value in flags.items():
        several = value.values() if isinstance(value, Mapping) else value if isinstance(value, tuple) else (value,)
        for given in filter(None, map(_address, several)):
            if name == "config":
                what, remedy = "--config is a file of this machine", "fetch it first"
                raise UsageError(what, where="--config", got=str(given), remedy=remedy)
            known, part = (outputs, "out") if name in _OUTPUTS else (inputs, "in")
            known.setdefault(given, f"{part}/{len(known)}/{given.name}")
    if not inputs and not outputs:
        return call(args)
    for out in outputs:
        if out.text.count("/") < 3:
            raise UsageError("an output is a folder or file in a bucket", where=str(out), expected=f"{out}/name")
        for given in inputs:
            if f"{out}/".startswith(f"{given}/") or f"{given}/".startswith(f"{out}/"):
                where, remedy = f"output: {out}", "choose an output apart from everything that is read"
                raise UsageError("the output touches an input", where=where, got=f"input: {given}", remedy=remedy)
    key = hashlib.sha256("\n".join([verb, *sorted(map(str, {*inputs, *outputs}))]).encode()).hexdigest()[:12]
    root = Path(tempfile.gettempdir()) if scratch is None else scratch
    folder = root.absolute() / f"mudg-{verb.replace(' ', '-')}-{key}"
    places = {given: folder / name for given, name in {**inputs, **outputs}.items()}

    def placed(value: Any) -> Any:
        """A flag's value with paths of this machine for addresses."""
        if isinstance(value, tuple):
            return tuple(map(placed, value))
        if isinstance(value, Mapping):  # mudg score --views NAME=ADDRESS
            return {name: placed(one) for name, one in value.items()}
        given = _address(value)
        return value if given is None else type(value)(places[given])

    with _alone_in(folder):
        for given in inputs:
            log.info(f"fetching {given}")
            given.fetch(places[given], mirror=True)
        for given in outputs:
            _fetch_earlier(given, places[given])
        result = call(replace(args, **{name: placed(value) for name, value in flags.items()}))
        for given in outputs:
            _upload(given, places[given])
    shutil.rmtree(folder, ignore_errors=True)
    return {name: _shown(value, places) for name, value in result.items()}


def _shown(value: Any, places: Mapping[Location, Path]) -> Any:
    """What a verb says, with addresses for the scratch folder's paths."""
    if isinstance(value, Mapping):
        return {name: _shown(one, places) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_shown(one, places) for one in value]
    if not isinstance(value, str | Path):
        return value
    text = str(value)
    for given, at in places.items():
        text = text.replace(str(at), str(given))
    return text


# what is where ------------------------------------------------------------------------------------


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """The scratch folder, for this process and user alone: its name can be guessed, and the system's temporary folder
    is everybody's. After a failure it stays, for the same command to go on with."""
    store.make_folder(folder.parent)
    with store.disk_errors("cannot create a folder", folder, "choose another --scratch"):
        with contextlib.suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        found = folder.lstat()
        if folder.is_symlink() or not folder.is_dir() or (hasattr(os, "getuid") and found.st_uid != os.getuid()):
            what, remedy = "the scratch folder belongs to somebody else", "choose another --scratch"
            raise ResourceError(what, where=str(folder), remedy=remedy)
    with locked(folder / "lock"):
        try:
            yield
        except BaseException:
            again = "the same command goes on with it. Delete the folder to give it up"
            log.info(f"{folder} keeps what was fetched and made: {again}")
            raise


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
