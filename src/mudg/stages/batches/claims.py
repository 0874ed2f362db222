"""Who works on what: claims with a lease, made by exclusive creation.

    CLAIMS/<key>.<attempt>.json        {owner, host, process, expires, state, counts}

Attempt n belongs to the one who created its file, and only that one writes it. It renews the lease; when that has run out, or the
attempt was given back, whoever creates the file of attempt n + 1 goes on. Files of a key are removed when its end is on record, which is
why an attempt that was just created must look for such a record once more.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from mudg.base import log, store
from mudg.base.errors import InputError, MudgError
from mudg.base.location import Location
from mudg.base.processes import process_alive
from mudg.stages.batches import retries
from mudg.stages.batches.told import ClaimTold, checked

WORKING: Final = "working"
WAITING: Final = "waiting"
_SETTLED_S: Final = 1.0
"""Where a store cannot exclude others: after so long the claim of the last one to write it stands."""


def this_host() -> str:
    """This machine, or this container of it: where process numbers mean the same."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return f"{socket.gethostname()} {space}".strip()


@dataclass(frozen=True)
class Owner:
    """A worker, by name, with its machine and process."""

    name: str
    host: str = field(default_factory=this_host)
    process: int = field(default_factory=os.getpid)


@dataclass(frozen=True)
class Busy:
    """Somebody else works on it, or it has to wait. until_s: seconds from now until that may change."""

    until_s: float


@dataclass
class Claim:
    """An attempt of one's own. counts: exit code -> how often that ended an earlier attempt."""

    folder: Location
    key: str
    attempt: int
    owner: Owner
    lease_s: float
    counts: dict[int, int]
    lost: threading.Event = field(default_factory=threading.Event)

    def file(self, attempt: int) -> Location:
        """The file of an attempt at the key."""
        return self.folder / f"{self.key}.{attempt}.json"

    def content(self, state: str, until: float) -> bytes:
        """The file's content. until: when the lease ends, or the wait; seconds since 1970."""
        record = {
            "owner": self.owner.name, "host": self.owner.host, "process": self.owner.process, "state": state, "until": round(until, 3),
            "counts": {str(code): count for code, count in self.counts.items()},
        }  # fmt: skip
        return json.dumps(record).encode()

    def is_kept(self) -> bool:
        """Whether nobody else has taken over, or even finished, which removes all files of the key."""
        return self.file(self.attempt).exists() and not self.file(self.attempt + 1).exists()

    def renew(self) -> bool:
        """Prolong the lease; False, and ``lost`` set, when somebody else has taken over."""
        if self.lost.is_set() or not self.is_kept():
            self.lost.set()
            return False
        self.file(self.attempt).save(self.content(WORKING, time.time() + self.lease_s))
        return True

    def give_back(self, code: int, until: float) -> None:
        """End the attempt with a failure that is to be tried again, not before ``until``."""
        self.counts[code] = self.counts.get(code, 0) + 1
        if self.is_kept():
            self.file(self.attempt).save(self.content(WAITING, until))

    def close(self) -> None:
        """Remove all files of the key: its end is on record."""
        for attempt in range(1, self.attempt + 1):
            self.file(attempt).remove()


def take(folder: Location, key: str, owner: Owner, lease_s: float) -> Claim | Busy:
    """Claim a key, if nobody works on it. The caller then looks whether the key's end is on record already.

    Args:
        lease_s: seconds after which others may take over unless it is renewed.
    """
    attempt, last = latest(folder, key)
    counts: dict[int, int] = {}
    if last is not None:
        counts = {int(code): int(count) for code, count in last.get("counts", {}).items()}
        remaining = float(last.get("until", 0.0)) - time.time()
        if last.get("state") == WAITING:
            if last.get("host") == owner.host:
                remaining += _longer_here(counts)
        elif _vanished(last, owner):
            remaining = 0.0
        if remaining > 0:
            return Busy(remaining)
        if last.get("state") != WAITING:
            counts[retries.LOST] = counts.get(retries.LOST, 0) + 1
    claim = Claim(folder, key, attempt + 1, owner, lease_s, counts)
    made = _created(claim.file(attempt + 1), claim.content(WORKING, time.time() + lease_s), owner)
    return claim if made else Busy(lease_s)


def _created(file: Location, content: bytes, owner: Owner) -> bool:
    """Create a claim; False if somebody else did. It need not survive a crash of the machine, as its owner does not: no flush."""
    if file.local is None:
        return file.save(content, only_if_absent=True) and (file.exclusive() or _stands(file, content))
    temporary = file.local.with_name(f".{file.name}.{socket.gethostname()}.{owner.process}.part")
    store.write_in_tree(temporary, content)
    try:
        os.link(temporary, file.local)
    except FileExistsError:
        return False
    except OSError:  # no links here
        return file.save(content, only_if_absent=True)
    finally:
        temporary.unlink(missing_ok=True)
    return True


def _stands(file: Location, content: bytes) -> bool:
    """Whether a claim, made where others may have made it at the same moment, is still one's own once all of them have written."""
    time.sleep(_SETTLED_S)
    try:
        return file.load() == content
    except InputError:
        return False


def _longer_here(counts: Mapping[int, int]) -> float:
    """How much longer the machine waits that failed itself."""
    return max((retries.backoff(code, times, True) - retries.backoff(code, times, False) for code, times in counts.items()), default=0.0)


def latest(folder: Location, key: str) -> tuple[int, Mapping[str, Any] | None]:
    """Number and content of a key's last attempt; (0, None) if there is none."""
    attempt = 0
    while (folder / f"{key}.{attempt + 1}.json").exists():
        attempt += 1
    return (attempt, read(folder / f"{key}.{attempt}.json")) if attempt else (0, None)


def read(file: Location) -> Mapping[str, Any] | None:
    """What a claim says; None if it was removed meanwhile. One that was left empty by a crash, or is damaged, has run out."""
    try:
        content = file.load()
    except InputError:
        return None
    try:
        return checked(ClaimTold, store.parse_json(content, str(file)), str(file))
    except InputError:
        return {}


def _vanished(record: Mapping[str, Any], owner: Owner) -> bool:
    """Whether the claim is of a process of this machine that runs no longer."""
    process = record.get("process")
    return record.get("host") == owner.host and isinstance(process, int) and process != owner.process and not process_alive(process)


class Heartbeat:
    """Renews a claim three times per lease while its block runs, and calls ``lost`` once somebody else has taken over."""

    def __init__(self, claim: Claim, lost: Callable[[], None]) -> None:
        self._claim, self._lost = claim, lost
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def __enter__(self) -> Heartbeat:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _beat(self) -> None:
        renewed = time.monotonic()
        while not self._ended.wait(self._claim.lease_s / 3):
            try:
                kept = self._claim.renew()
                renewed = time.monotonic()
            except MudgError as error:  # the storage does not answer; the lease may still hold when it does again
                kept = time.monotonic() - renewed < self._claim.lease_s
                log.warn(f"the lease could not be renewed: {error.what}")
            if not kept:
                self._claim.lost.set()
                self._lost()
                return
