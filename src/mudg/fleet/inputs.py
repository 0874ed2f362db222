"""Inputs that lie in a store, on this machine: shared by all steps that read them, and removed when nobody needs them
any more.

    SCRATCH/mudg_inputs/<digest>/content/<name>     what was fetched
                                 complete           for which driver; written when it is whole
                        <digest>.lock               held together by steps that use it, alone by the one that fetches or
                                                    removes it

What lies there is compared with its address, file by file, once by every driver and again after a step said that it is
bad.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mudg.base import log, store
from mudg.base.errors import InputError, MudgError, ResourceError
from mudg.base.location import Location
from mudg.fleet.child import Stop, lock

FOLDER: Final = "mudg_inputs"


@dataclass(frozen=True)
class InputStore:
    """Inputs below a scratch folder. token: of the driver."""

    scratch: Path
    token: str

    def _place(self, source: Location, version: str) -> Path:
        return self.scratch / FOLDER / hashlib.sha256(f"{source} {version}".encode()).hexdigest()[:20]

    @contextlib.contextmanager
    def held(self, source: Location, version: str, stop: Stop, *, keep: bool = False) -> Iterator[Path]:
        """The file or folder at an address, on this machine, for as long as the block runs.

        Args:
            version: of what lies there, where the address alone does not tell. keep: leave it there, for others that
                come later.

        Raises:
            InputError: nothing is there. ResourceError: no connection, the disk is full, or work is to stop.
        """
        place = self._place(source, version)
        content, mark, file = place / "content" / source.name, place / "complete", place.with_suffix(".lock")
        store.create_once(file, b"")
        with store.open_file(file) as handle:
            while True:
                if not lock(handle, False, stop):
                    raise ResourceError("stopped while another process fetches an input", where=str(source))
                whole = mark.is_file()
                if whole and store.read_text(mark) == self.token:
                    break
                if not lock(handle, True, None if whole else stop):
                    if whole:  # another driver uses it, and has compared it
                        lock(handle, False, stop)
                        break
                    continue
                store.remove(mark)
                source.fetch(content, mirror=True)
                store.write_in_tree(mark, self.token.encode())
            try:
                yield content
            finally:
                if not keep and lock(handle, True, None):
                    shutil.rmtree(place, ignore_errors=True)

    def fetch_ahead(self, source: Location, version: str, stop: Stop) -> threading.Thread:
        """Begin to fetch what is needed next. A failure is told by the step that needs it."""

        def fetch() -> None:
            try:
                with self.held(source, version, stop, keep=True):
                    pass
            except (MudgError, OSError) as error:
                log.info(f"{source} could not be fetched ahead: {error}")

        thread = threading.Thread(target=fetch, name="inputs ahead", daemon=True)
        thread.start()
        return thread

    def doubt(self, source: Location, version: str) -> None:
        """Compare an input with its address before it is used again: a step said that it is bad."""
        store.remove(self._place(source, version) / "complete")

    def clear(self) -> None:
        """Remove all that is not in use."""
        for file in (self.scratch / FOLDER).glob("*.lock"):
            with contextlib.suppress(OSError, InputError), store.open_file(file) as handle:
                if lock(handle, True, None):
                    shutil.rmtree(file.with_suffix(""), ignore_errors=True)
