"""Inputs that lie in a store, on this machine: fetched once for all steps that read them, a scene ahead, and removed by size.

    SCRATCH/mudg_inputs/<digest>/content/<name>     what was fetched
                                 complete           its size; written when it is whole
                        <digest>.lock               held together by steps that use it, alone by the one that fetches or removes it

A log or a folder of weights is compared with its address once by every worker, and again after a step said that it is bad. Results of
earlier steps are named by their content and are taken as they are; those made on this machine are kept without being fetched.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from mudg.base import log, store, transfer
from mudg.base.errors import InputError, MudgError, ResourceError
from mudg.base.location import Location
from mudg.base.usage import folder_bytes
from mudg.stages.batches.turns import lock

FOLDER: Final = "mudg_inputs"
GB: Final = 1e9
_COMPLETE: Final = "complete"


@dataclass(frozen=True)
class InputStore:
    """Inputs below a scratch folder, which all workers of this machine share.

    Args:
        root: the scratch folder. most_bytes: what is used least recently is removed above this size; what is in use stays.
    """

    root: Path
    most_bytes: float
    _current: set[str] = field(default_factory=set)
    """What this worker has compared with its address."""
    _ahead: list[threading.Thread] = field(default_factory=list)

    @property
    def _folder(self) -> Path:
        return self.root / FOLDER

    def _place(self, source: Location, version: str) -> Path:
        return self._folder / hashlib.sha256(f"{source} {version}".encode()).hexdigest()[:20]

    @contextlib.contextmanager
    def held(
        self, source: Location, version: str = "", fixed: bool = False, cancelled: Callable[[], bool] = lambda: False
    ) -> Iterator[Path]:
        """The file or folder at an address, on this machine, for as long as the block runs.

        Args:
            version: of what lies there, where the address alone does not tell. fixed: it never changes. cancelled: stop waiting for
                another worker that fetches the same.

        Raises:
            InputError: nothing is there. ResourceError: no connection, or the disk is full.
        """
        place = self._place(source, version)
        store.make_folder(self._folder)
        file = place.with_suffix(".lock")
        store.create_once(file, b"")
        with store.open_file(file) as handle:
            while True:
                whole = (place / _COMPLETE).is_file()
                if not lock(handle, False, cancelled):
                    raise ResourceError("stopped while another worker fetches an input", where=str(source))
                if self._is_current(place, fixed):
                    break
                if lock(handle, True, (lambda: True) if whole else cancelled):
                    self._fetch(source, place)
                self._current.add(place.name)  # what another worker uses now, it has compared
            os.utime(file)
            yield place / "content" / source.name

    def _is_current(self, place: Path, fixed: bool) -> bool:
        return (place / _COMPLETE).is_file() and (fixed or place.name in self._current)

    def _fetch(self, source: Location, place: Path) -> None:
        self.evict(self.most_bytes)
        store.remove(place / _COMPLETE)
        content = place / "content" / source.name
        if not source.exists():
            source.fetch(content)  # says what is missing
        names = transfer.fetch(source.side, content)
        if content.is_dir():  # of another version of a log
            for path in [
                one
                for one in content.rglob("*")
                if not one.is_dir() and one.relative_to(content).as_posix() not in names
            ]:
                store.remove(path)
        self._finish(place)

    def _finish(self, place: Path) -> None:
        store.write_in_tree(place / _COMPLETE, str(folder_bytes(place)).encode())

    def keep(self, source: Location, made: Path) -> None:
        """Take over a folder that was just uploaded, for the steps that read it."""
        place = self._place(source, "")
        file = place.with_suffix(".lock")
        store.make_folder(self._folder)
        store.create_once(file, b"")
        with store.open_file(file) as handle:
            if not lock(handle, True, lambda: True) or (place / _COMPLETE).exists():
                return
            shutil.rmtree(place, ignore_errors=True)
            store.make_folder(place / "content")
            made.rename(place / "content" / source.name)
            self._finish(place)
        self.evict(self.most_bytes)

    def doubt(self, source: Location, version: str = "") -> None:
        """Compare an input with its address before it is used again: a step said that it is bad."""
        self._current.discard(self._place(source, version).name)

    def ahead(self, source: Location, version: str = "") -> None:
        """Begin to fetch what is needed next, one at a time. A failure is told by the step that needs it."""
        if any(one.is_alive() for one in self._ahead) or self._is_current(self._place(source, version), False):
            return
        self._ahead[:] = [
            threading.Thread(target=self._fetched_ahead, args=(source, version), name="inputs ahead", daemon=True)
        ]
        self._ahead[0].start()

    def _fetched_ahead(self, source: Location, version: str) -> None:
        try:
            with self.held(source, version):
                pass
        except (MudgError, OSError) as error:
            log.info(f"{source} could not be fetched ahead: {error}")

    def evict(self, most_bytes: float) -> None:
        """Remove what was used least recently and is not in use, until the rest is no larger than this."""
        sizes: list[tuple[float, Path, float]] = []
        for file in self._folder.glob("*.lock"):
            place = file.with_suffix("")
            with contextlib.suppress(OSError, InputError, ValueError):  # others remove at the same time
                size = (
                    float(store.read_text(place / _COMPLETE))
                    if (place / _COMPLETE).exists()
                    else float(folder_bytes(place))
                )
                sizes.append((file.stat().st_mtime, place, size))
        total = sum(size for _, _, size in sizes)
        for _, place, size in sorted(sizes):
            if total <= most_bytes:
                return
            if self._removed(place):
                total -= size

    def _removed(self, place: Path) -> bool:
        with contextlib.suppress(OSError, InputError), store.open_file(place.with_suffix(".lock")) as handle:
            if lock(handle, True, lambda: True):
                store.remove(place / _COMPLETE)
                shutil.rmtree(place, ignore_errors=True)
                return True
        return False
