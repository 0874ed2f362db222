"""What a piece of work takes: seconds, processor seconds, and the most memory that the program and its child processes held together.

    meter = Meter()
    ...
    meter.stop()        Usage(seconds=12.3, processor_s=20.1, peak_bytes=812345678)

Memory is looked at every `PERIOD_S` by one thread for all meters, at the start and at the end: a peak that lasts less is missed. It is
known where the system has ``/proc``, else None.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mudg.base.memory import system_text

PERIOD_S: Final = 0.25
_RESIDENT: Final = 1
"""Column of ``statm``: resident pages."""


@dataclass(frozen=True, slots=True)
class Usage:
    """What was taken so far. processor_s: of all threads, and of child processes that have ended. peak_bytes: None = not known."""

    seconds: float = 0.0
    processor_s: float = 0.0
    peak_bytes: int | None = None

    def then(self, later: Usage) -> Usage:
        """Of this work and the one that continued it."""
        peaks = [one for one in (self.peak_bytes, later.peak_bytes) if one is not None]
        return Usage(self.seconds + later.seconds, self.processor_s + later.processor_s, max(peaks, default=None))

    def record(self) -> dict[str, Any]:
        """As JSON values."""
        return {"seconds": round(self.seconds, 3), "processor_s": round(self.processor_s, 3), "peak_bytes": self.peak_bytes}

    @classmethod
    def of_record(cls, values: Mapping[str, Any]) -> Usage:
        """Of what `record` wrote; what an older version did not note is 0 or unknown."""
        peak = values.get("peak_bytes")
        return cls(float(values.get("seconds", 0.0)), float(values.get("processor_s", 0.0)), None if peak is None else int(peak))


class Meter:
    """Measures from its making on."""

    def __init__(self) -> None:
        self._began_s, self._processor_s = time.monotonic(), _processor_seconds()
        self._peak = resident_bytes()
        self._last: Usage | None = None
        _SAMPLER.add(self)

    def seen(self, resident: int | None) -> None:
        """Take a sample of memory."""
        if resident is not None:
            self._peak = max(self._peak or 0, resident)

    def usage(self) -> Usage:
        """Up to now; after `stop`, up to then."""
        if self._last is not None:
            return self._last
        self.seen(resident_bytes())
        return Usage(time.monotonic() - self._began_s, _processor_seconds() - self._processor_s, self._peak)

    def stop(self) -> Usage:
        """Measure no further."""
        self._last = self.usage()
        _SAMPLER.drop(self)
        return self._last


class _Sampler:
    """Gives all meters samples of memory, in a thread that lives while there are any."""

    def __init__(self) -> None:
        self._meters: weakref.WeakSet[Meter] = weakref.WeakSet()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def add(self, meter: Meter) -> None:
        with self._lock:
            self._meters.add(meter)
            if self._thread is None or not self._thread.is_alive():
                self._thread = threading.Thread(target=self._sample, name="memory meter", daemon=True)
                with contextlib.suppress(RuntimeError):  # no thread to be had: the samples of start and end remain
                    self._thread.start()

    def drop(self, meter: Meter) -> None:
        with self._lock:
            self._meters.discard(meter)

    def _sample(self) -> None:
        while True:
            time.sleep(PERIOD_S)
            with self._lock:
                meters = list(self._meters)
                if not meters:
                    self._thread = None
                    return
            resident = resident_bytes()
            for meter in meters:
                meter.seen(resident)
            meters = []  # a meter that nobody else holds may go


_SAMPLER: Final = _Sampler()


def resident_bytes() -> int | None:
    """Memory that this process and its descendants hold now; pages that they share count for each. None where the system does not say."""
    total, waiting, page = 0, [os.getpid()], os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096
    while waiting:
        process = f"/proc/{waiting.pop()}"
        pages = system_text(f"{process}/statm").split()
        total += int(pages[_RESIDENT]) * page if len(pages) > _RESIDENT else 0
        with contextlib.suppress(OSError):  # it ended meanwhile
            for thread in os.listdir(f"{process}/task"):
                waiting += map(int, system_text(f"{process}/task/{thread}/children").split())
    return total or None


def folder_bytes(folder: Path) -> int:
    """Size of all files in a folder, or of one file."""
    with contextlib.suppress(OSError):
        if folder.is_file():
            return folder.stat().st_size
    total = 0
    for top, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):
                total += os.lstat(os.path.join(top, name)).st_size
    return total


def _processor_seconds() -> float:
    now = os.times()
    return now.user + now.system + now.children_user + now.children_system
