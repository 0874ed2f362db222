"""Finding the files of a log: numbered files, frames that are whole, cameras that were asked for, options that do not
apply."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from mudg.base import log
from mudg.base.errors import InputError, UsageError
from mudg.formats.importers.common import ImportOptions
from mudg.scene.schema import ref_problem

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class LogFiles:
    """What identifies the log that was chosen from a folder of many.

    Args:
        files: files, and folders that count with everything in them.
        entries: folders too large for that, of which only their own times count: these change when a file comes or
            goes.
    """

    files: tuple[Path, ...]
    entries: tuple[Path, ...] = ()


def numbered_files(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Files called by a frame number, in order: ``0000000012.png`` with suffix ``.png``, ``07.pkl.gz`` with
    ``.pkl.gz``.

    A folder that does not exist holds none.
    """
    if not folder.is_dir():
        return {}
    found = {}
    for path in folder.iterdir():
        stem, dot, rest = path.name.partition(".")
        if stem.isascii() and stem.isdigit() and dot + rest.lower() in suffixes:
            found[int(stem)] = path
    return dict(sorted(found.items()))


def complete_frames(
    streams: Mapping[str, Iterable[int]], options: ImportOptions, where: str, title: str, optional: Iterable[int] = ()
) -> list[int]:
    """Frame numbers to import: those that every stream has, within ``options.frames``.

    Args:
        streams: name of a camera or LiDAR -> its frame numbers.
        options: ``frames`` and ``skip_missing`` are used.
        where: the log, for messages.
        title: the format's name, for messages.
        optional: frames that may be missing from every stream without a warning (documented gaps).

    Raises:
        InputError: a stream lacks frames that others have (unless ``skip_missing``), or nothing is left.
    """
    numbers = {name: set(found) for name, found in streams.items()}
    everything = set().union(*numbers.values()) - set(optional)
    if options.frames is not None:
        everything = {n for n in everything if options.frames[0] <= n < options.frames[1]}
    missing = {name: sorted(everything - found) for name, found in numbers.items() if everything - found}
    gaps = "; ".join(f"{name} lacks {number_ranges(lacks)}" for name, lacks in missing.items())
    if missing and not options.skip_missing:
        what = "images and sweeps do not pair up"
        remedy = "copy the missing files, choose frames with --frames FIRST:END, or add --skip-missing"
        raise InputError(what, where=where, expected="every camera and LiDAR for every frame", got=gaps, remedy=remedy)
    if missing:
        log.warn(f"{title}: left out incomplete frames: {gaps}")
    for lacks in missing.values():
        everything -= set(lacks)
    if not everything:
        expected = "numbered images" + (f" in {options.frames[0]}:{options.frames[1]}" if options.frames else "")
        got = ", ".join(f"{name}: {number_ranges(sorted(found))}" for name, found in numbers.items()) or "nothing"
        raise InputError("no frames to import", where=where, expected=expected, got=got)
    return sorted(everything)


def number_ranges(numbers: Sequence[int]) -> str:
    """Increasing frame numbers as text: three or more in a row as first and last, a long list cut short."""
    if not numbers:
        return "none"
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    ranges = [f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs]
    return ", ".join(ranges[:8]) + (f", ... ({len(numbers)} in all)" if len(ranges) > 8 else "")


def first_file(*candidates: Path) -> Path | None:
    """The first of some paths that is a file."""
    return next((path for path in candidates if path.is_file()), None)


def folder_contents(folder: Path) -> str:
    """The first names in a folder, for messages."""
    return ", ".join(sorted(path.name for path in folder.iterdir())[:12]) or "an empty folder"


def the_only(matching: Sequence[Item], names: Sequence[str], options: ImportOptions, where: Path, kind: str) -> Item:
    """The one log that ``options.sequence`` means.

    Args:
        matching: logs that fit it; all of them where none was chosen.
        names: of all logs that are there, for the message.
        options: ``sequence`` is used.
        where: folder that holds them.
        kind: what one is called: log, scene, drive, sequence.

    Raises:
        UsageError: none fits, or several do.
    """
    if len(matching) == 1:
        return matching[0]
    listed = ", ".join(names[:12]) + (f", ... ({len(names)} in all)" if len(names) > 12 else "")
    what = f"the folder holds several {kind}s" if matching else f"there is no such {kind}"
    expected = f"--sequence with one of {listed}"
    raise UsageError(what, where=str(where), expected=expected, got=options.sequence or "none chosen")


def chosen_cameras(available: Mapping[str, str], options: ImportOptions, where: str, usual: Sequence[str]) -> list[str]:
    """The data set's names of the cameras to import, in the order of ``available``.

    Args:
        available: the data set's name -> the name in the scene; either may be asked for.
        options: ``cameras`` is used.
        where: the log, for messages.
        usual: the data set's names taken when none is asked for; those that are not there are left out.

    Raises:
        UsageError: no such camera. InputError: none of the usual ones is there.
    """
    by_scene_name = {ours: theirs for theirs, ours in available.items()}
    listed = ", ".join(o if o == t else f"{o} ({t})" for t, o in available.items()) or "no cameras"
    if not options.cameras:
        chosen = [name for name in available if name in usual]
        if not chosen:
            what = "the log has no camera that can be imported"
            raise InputError(what, where=where, expected=", ".join(usual), got=listed)
        return chosen
    unknown = [name for name in options.cameras if name not in available and name not in by_scene_name]
    if unknown:
        raise UsageError("the log has no such camera", where=where, expected=listed, got=", ".join(unknown))
    wanted = {by_scene_name.get(name, name) for name in options.cameras}
    return [name for name in available if name in wanted]


def refuse_missing_cameras(there: Iterable[str], usual: Iterable[str], options: ImportOptions, where: object) -> None:
    """Refuse a log that lacks cameras of its data set, unless cameras were chosen or ``skip_missing`` says otherwise.

    Args:
        there, usual: the cameras' names in the scene.
        options: ``cameras`` and ``skip_missing`` are used.
        where: the log, for messages.
    """
    there, usual = list(there), list(usual)
    absent = [name for name in usual if name not in there]
    if absent and not options.cameras and not options.skip_missing:
        what, got = "cameras are missing in the log", f"no images of {', '.join(absent)}"
        remedy = f"choose those that are there with --cameras {' '.join(there)}, or add --skip-missing"
        raise InputError(what, where=str(where), got=got, expected=f"{len(usual)} cameras", remedy=remedy)


def refuse_options(options: ImportOptions, title: str, *names: str) -> None:
    """Refuse options of other formats that were set here: better than to do something else than asked.

    Raises:
        UsageError: one of ``names`` differs from its default.
    """
    default = ImportOptions()
    for name in names:
        if getattr(options, name) != getattr(default, name):
            flag = "--" + name.replace("_", "-")
            raise UsageError(f"{title} logs have no use for {flag}", where=flag, remedy="leave it out")


def refuse_untwist(options: ImportOptions, dataset: str, where: str) -> None:
    """Refuse ``--untwist yes``, ``--poses`` and ``--boxes`` for a data set that brings its own and compensates its
    sweeps."""
    if options.untwist == "yes":
        what = f"sweeps of {dataset} are already compensated for the vehicle's motion"
        raise UsageError(what, where=where, got="--untwist yes", remedy="leave --untwist out")
    refuse_options(options, dataset, "poses", "boxes")


def path_inside(root: Path, name: Any, where: str) -> Path:
    """A file below ``root`` from a name in a foreign table; absolute names and ``..`` are refused."""
    problem = ref_problem(name)
    if problem is not None:
        what = f"file name {problem}"
        raise InputError(what, where=where, got=repr(name)[:120], expected="a relative path inside the log")
    return root / name
