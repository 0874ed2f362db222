"""Folders of this machine, asked in the same way as an object store (``base/remote.py``)."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from mudg.base import store
from mudg.base.remote import Found


def files_below(folder: Path) -> list[str]:
    """Relative POSIX names of all regular files, sorted, without temporary ones and locks."""
    names = []
    for top, _, files in os.walk(folder):
        inside = Path(top).relative_to(folder)
        for name in files:
            relative = (inside / name).as_posix()
            if name != "lock" and not any(".part" in part for part in relative.split("/")) and (folder / relative).is_file():
                names.append(relative)
    return sorted(names)


class LocalStore:
    """Reads and writes files; paths are those of the system."""

    def where(self, path: str) -> str:
        """The path, for messages."""
        return path

    def exists(self, path: str) -> bool:
        """Whether a file or folder is there."""
        return os.path.exists(path)

    def is_folder(self, path: str) -> bool:
        """Whether a folder is there."""
        return os.path.isdir(path)

    def size(self, path: str) -> int:
        """Bytes of a file."""
        return os.stat(path).st_size

    def load(self, path: str) -> bytes:
        """The content of a file."""
        return store.read_bytes(Path(path))

    def piece(self, path: str, begin: int, end: int) -> bytes:
        """Bytes ``begin`` to ``end`` (exclusive) of a file."""
        if not os.path.lexists(path):
            raise FileNotFoundError(path)
        with store.open_file(Path(path)) as handle:
            handle.seek(begin)
            return handle.read(end - begin)

    def save(self, path: str, data: bytes) -> None:
        """Write a file, over one that is there."""
        store.atomic_write(Path(path), data)

    def create(self, path: str, data: bytes) -> bool:
        """Write a file where none is; False if one is there."""
        return store.create_once(Path(path), data)

    def exclusive(self, path: str) -> bool:
        """Of several that create the same name at once, one succeeds."""
        return True

    def remove(self, path: str) -> None:
        """Remove a file; none there is no error."""
        store.remove(Path(path))

    def remove_tree(self, path: str) -> None:
        """Remove a folder with all below it."""
        with store.disk_errors("cannot remove a folder", Path(path), "check who may write there"):
            shutil.rmtree(path)

    def names(self, path: str) -> list[str]:
        """Names right below."""
        return os.listdir(path) if os.path.isdir(path) else []

    def tree(self, path: str) -> dict[str, Found]:
        """Every file below, by its name relative to ``path``."""
        return {name: Found((Path(path) / name).stat().st_size) for name in files_below(Path(path))}

    def note(self, path: str, name: str) -> str:
        """A text kept with a file: its ``sha256`` alone, which is counted."""
        return store.sha256_file(Path(path)) if name == "sha256" else ""

    def put(self, path: str, file: Path, sha256: str) -> None:
        """Copy a file there; ``settle`` must follow."""
        store.copy_in_tree(file, Path(path))

    def settle(self, path: str) -> None:
        """Wait until what was written is on the disk."""
        store.sync_tree(Path(path))
