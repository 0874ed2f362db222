"""Replacing a folder by one that was made beside it, so that nothing is lost on the way.

    .NAME.new.part   the new content while it is made; the old content stays as it is
    .NAME.old.part   the old content, from the moment the new one has its name until it is removed

Of the old content only the files of the old result are removed. Files of somebody else move to the new folder.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mudg.base import log, store
from mudg.base.errors import ResourceError, UsageError

OwnNames = Callable[[Path], Sequence[str]]
"""Folder -> relative names of the files in it that belong to the result, in the order in which they may be removed: those last that
the function itself reads. All other files belong to somebody else."""


@dataclass(frozen=True)
class Replacement:
    """A folder whose content is to be replaced as a whole (links are resolved: see ``Replacement.at``)."""

    folder: Path

    @classmethod
    def at(cls, path: Path) -> Replacement:
        """For the folder that ``path`` names or links to; it need not exist."""
        return cls(Path(os.path.realpath(path)))

    @property
    def staging(self) -> Path:
        """Where the new content is made."""
        return store.staging_path(self.folder)

    @property
    def retired(self) -> Path:
        """Where the old content waits for its removal."""
        return store.retired_path(self.folder)

    def begin(self) -> Path:
        """Make the staging folder, or take up the one that is there; returns it.

        Raises:
            ResourceError: the folder is a mount point, or its parent cannot be written.
        """
        if os.path.ismount(self.folder):
            raise ResourceError("a mount point cannot be replaced", where=str(self.folder),
                remedy="choose an --out inside it")  # fmt: skip
        with store.disk_errors("the new result cannot be made beside the old one", self.folder.parent):
            self.staging.mkdir(exist_ok=True)
        return self.staging

    def swap(self, own_names: OwnNames) -> None:
        """Put the finished staging folder in the place of the folder, and remove the old result.

        Raises:
            ResourceError: a folder cannot be renamed; old and new content are both still there.
        """
        try:
            if self.folder.exists():
                self.folder.rename(self.retired)
            self.staging.rename(self.folder)
        except OSError as error:
            if self.retired.exists() and not self.folder.exists():
                self.retired.rename(self.folder)
            raise ResourceError("the new result cannot take the place of the old one", where=str(self.folder),
                got=str(error),
                remedy=f"it is finished and lies in {self.staging}; repeat the command, or move it") from error  # fmt: skip
        store.fsync_directory(self.folder.parent)
        self._remove_retired(own_names)

    def recover(self, is_finished: Callable[[Path], bool], own_names: OwnNames) -> None:
        """Complete, or undo, a ``swap`` that was cut off by a crash; without one nothing happens.

        Args:
            is_finished: whether a folder holds a finished, unaltered result.

        Raises:
            UsageError: old and new content lie side by side in a way that no crash leaves.
        """
        if not self.retired.is_dir():
            return
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()
        if not self.folder.exists():
            if not is_finished(self.staging):
                self.retired.rename(self.folder)
                log.warn(f"{self.folder}: the old result is back; replacing it was cut off")
                return
            self.staging.rename(self.folder)
            store.fsync_directory(self.folder.parent)
        elif self.staging.exists() or not is_finished(self.folder):
            raise UsageError("a cut-off replacement and another folder are in each other's way", where=str(self.folder),
                got=f"the replaced result in {self.retired}", remedy="move one of them elsewhere")  # fmt: skip
        log.warn(f"{self.folder}: finished replacing the old result, which had been cut off")
        self._remove_retired(own_names)

    def _remove_retired(self, own_names: OwnNames) -> None:
        if not self.retired.is_dir():
            return
        own = own_names(self.retired)
        remedy = f"the new one is in place; move what you need from here to {self.folder}"
        with store.disk_errors("the old result cannot be removed", self.retired, remedy):
            kept = [self._hand_over(name) for name in sorted(set(all_names(self.retired)) - set(own))]
            remove_files(self.retired, own)
            self.retired.rmdir()
        if kept:
            more = f" and {len(kept) - 8} more" if len(kept) > 8 else ""
            log.warn(f"{self.folder}: kept files that are not of the old result: {', '.join(kept[:8])}{more}")

    def _hand_over(self, name: str) -> str:
        """Move somebody else's file from the old folder to the new one; returns its name there."""
        target, number = name, 0
        while os.path.lexists(self.folder / target):
            number += 1
            target = f"{name}.kept{number}"
        (self.folder / target).parent.mkdir(parents=True, exist_ok=True)
        (self.retired / name).rename(self.folder / target)
        return target


def all_names(folder: Path) -> list[str]:
    """Relative POSIX names of all files and links below a folder, sorted; links are not followed."""
    names = []
    for place, folders, files in os.walk(folder):
        links = [name for name in folders if (Path(place) / name).is_symlink()]
        names += [(Path(place) / name).relative_to(folder).as_posix() for name in (*files, *links)]
    return sorted(names)


def remove_files(folder: Path, names: Sequence[str]) -> None:
    """Remove files of a folder in this order, and then the sub-folders that are empty."""
    for name in names:
        (folder / name).unlink(missing_ok=True)
    for place, _, _ in os.walk(folder, topdown=False):
        if Path(place) != folder:
            with contextlib.suppress(OSError):  # not empty: somebody else's
                Path(place).rmdir()
