"""A place where data lies: a path on this machine, or an address in an object store. The same calls for both.

    runs = Location.of("s3://bucket/runs")
    runs.names()                                                ['kitti', 'city']
    (runs / "_claims" / "kitti.json").save(b"...", only_if_absent=True)
    (runs / "kitti").fetch(Path("/scratch/kitti"))              staged in, verified
    (runs / "kitti").push(Path("/scratch/kitti"))               uploaded, its manifest last

Reads see an old complete file or a new complete one. A folder is a result when its manifest is there; ``push`` writes that last.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from mudg.base import store, transfer
from mudg.base.errors import InputError, UsageError
from mudg.base.local import LocalStore
from mudg.base.remote import PACKAGES, PROBE, RemoteStore, checked_address, scheme_of
from mudg.base.run_folder import is_temporary

_FLATTENED = re.compile(rf"({'|'.join(PACKAGES)}|file):/(?!/)")


@dataclass(frozen=True)
class Location:
    """A file or folder on this machine, or in an object store (``s3://bucket/folder``). Made by ``Location.of``."""

    text: str
    """The path, or the address in its one spelling. It never holds credentials."""

    @classmethod
    def of(cls, given: str | Path | Location) -> Location:
        """A location from what a user gave.

        Raises:
            UsageError: an address of an unknown kind, or one with credentials in it.
        """
        if isinstance(given, Location):
            return given
        text = given.as_posix() if isinstance(given, Path) else str(given)
        if isinstance(given, Path) and _FLATTENED.match(text):  # what Path makes of s3://bucket
            text = text.replace(":/", ":///" if text.startswith("file:") else "://", 1)
        scheme = scheme_of(text)
        if not text:
            raise UsageError("no path or address was given")
        if scheme == "file":
            from urllib.parse import unquote

            host, _, path = text[len("file://") :].partition("/")
            if host not in ("", "localhost"):
                raise UsageError("a file address names another machine", where=text[:200], expected="file:///folder")
            text, scheme = unquote(f"/{path}"), ""
        if not scheme:
            return cls(os.path.normpath(text))
        return cls(checked_address(text))

    def __truediv__(self, name: str) -> Location:
        """What lies below, by a relative name."""
        parts = name.split("/")
        if not name or any(part in ("", ".", "..") for part in parts) or "\0" in name:
            raise UsageError("not a name below a folder", where=self.text, got=repr(name)[:200])
        return Location(f"{self.text.rstrip('/') if self.local is not None else self.text}/{name}")

    def __str__(self) -> str:
        return self.text

    @property
    def local(self) -> Path | None:
        """The path on this machine; None for an address."""
        return None if scheme_of(self.text) else Path(self.text)

    @property
    def name(self) -> str:
        """The last part."""
        return self.text.rstrip("/").rpartition("/")[2]

    @property
    def _store(self) -> LocalStore | RemoteStore:
        return RemoteStore(scheme_of(self.text)) if self.local is None else LocalStore()

    @property
    def _path(self) -> str:
        return self.text if self.local is not None else self.text.partition("://")[2]

    @property
    def side(self) -> transfer.Side:
        """For transfers."""
        return transfer.Side(self._store, self._path)

    def exists(self) -> bool:
        """Whether a file, or a folder with something in it, is there."""
        return self._store.exists(self._path)

    def size(self) -> int:
        """Bytes of a file. InputError: none is there."""
        try:
            return self._store.size(self._path)
        except FileNotFoundError as error:
            raise self._missing() from error

    def load(self) -> bytes:
        """The content of a file. InputError: none is there."""
        try:
            return self._store.load(self._path)
        except (FileNotFoundError, IsADirectoryError) as error:
            raise self._missing() from error

    def _missing(self) -> InputError:
        return InputError("nothing is at this address", where=self.text, remedy="check it, and whether its upload was finished")

    def save(self, data: bytes, *, only_if_absent: bool = False) -> bool:
        """Write a file completely or not at all.

        Args:
            only_if_absent: write only where nothing is. Of several that do so at once one gets True, if ``exclusive()``.

        Returns:
            False if ``only_if_absent`` and somebody else made the file.
        """
        if only_if_absent:
            return self._store.create(self._path, data)
        self._store.save(self._path, data)
        return True

    def exclusive(self) -> bool:
        """Whether ``only_if_absent`` holds here against others at the same moment. A store is tried out once, and said aloud if not."""
        return self._store.exclusive(self._path)

    def remove(self) -> None:
        """Remove a file, or a folder with all below it, its manifest first. Nothing there is no error."""
        at = self._store
        if not at.is_folder(self._path) or os.path.islink(self._path):
            at.remove(self._path)
            return
        if "/" not in self._path.strip("/"):
            raise UsageError("a whole bucket or disk is not removed", where=self.text)
        at.remove(f"{self._path}/{store.MANIFEST}")
        at.remove_tree(self._path)

    def names(self) -> list[str]:
        """Names of what lies right below, sorted, without temporary files; empty where nothing is."""
        found = self._store.names(self._path)
        return sorted(name for name in found if not is_temporary(name) and not name.startswith(PROBE))

    def fetch(self, to: Path) -> None:
        """Stage a file or folder in. What an earlier, interrupted fetch left at ``to`` is used again.

        Raises:
            InputError: nothing is there, or its upload was not finished. IntegrityError: what came is not what was uploaded.
            ResourceError: no connection, or the disk is full.
        """
        if not self.exists():
            raise self._missing()
        transfer.fetch(self.side, Path(to))

    def push(self, frm: Path) -> None:
        """Upload a folder: all files, several at a time, its manifest last. Files that are there already are not sent again.

        Until the manifest is there, what is at this place is no result. Files of an earlier push that are no longer part of the folder
        are removed; files of others stay.

        Raises:
            InputError: no folder. ResourceError: no connection. IntegrityError: what arrived is not what was sent.
        """
        if not Path(frm).is_dir():
            raise InputError("no folder to upload", where=str(frm))
        transfer.push(Path(frm), self.side)
