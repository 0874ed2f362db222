"""Where training clips come from when they are not in one folder of this machine: an object store, through a bounded
cache.

What is in the cache is a copy, or can be made again. Several processes may share it: files appear under their names
complete, and one that another process removed meanwhile is brought once more.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mudg.base import store
from mudg.base.errors import InputError, IntegrityError
from mudg.base.location import Location
from mudg.diffusion.clips import shards as clip_shards
from mudg.diffusion.clips.from_city import HELD_OUT
from mudg.diffusion.clips.shards import Result

_TRIES = 3


class ShardCache:
    """A folder of shards of at most `limit` bytes. Those used longest ago are removed first; the newest one always
    stays.

    The time of a file's last change says when it was last used.
    """

    def __init__(self, folder: Path, limit: int) -> None:
        self.folder, self.limit = folder, limit
        self.made = 0
        """How often this process brought a shard."""
        self._locks: dict[str, threading.Lock] = {}
        self._own = threading.Lock()

    def get(self, name: str, make: Callable[[Path], None]) -> Path:
        """The file `name` below the folder; `make` brings it if it is not there. Threads wait for each other's."""
        path = self.folder / name
        with self._own:
            lock = self._locks.setdefault(name, threading.Lock())
        with lock:
            if not path.is_file():
                make(path)
                with self._own:
                    self.made += 1
                    self._evict(path)
        with self._own:
            self._locks.pop(name, None)
        with contextlib.suppress(OSError):
            os.utime(path)
        return path

    def _evict(self, newest: Path) -> None:
        """Remove files until the rest is within the limit."""
        found: list[tuple[int, int, Path]] = []
        for path in self.folder.rglob("*.safetensors"):
            with contextlib.suppress(OSError):  # another process removed it
                facts = path.stat()
                found.append((facts.st_mtime_ns, facts.st_size, path))
        total = sum(size for _, size, _ in found)
        for _, size, path in sorted(found):
            if total <= self.limit:
                return
            if path != newest:
                store.remove(path)
                total -= size


@dataclass(frozen=True)
class FolderOfShards:
    """A folder of shards at an address, with the sums that its upload recorded (empty: they are not known)."""

    place: Location
    sums: dict[str, str]

    @classmethod
    def open(cls, place: Location) -> FolderOfShards:
        """The folder, or one inside a folder that was uploaded as a whole, such as the output of a training."""
        for above, prefix in ((place, ""), (_parent(place), f"{place.name}/")):
            found = above.uploaded() if above is not None else None
            if found is not None:
                return cls(
                    place,
                    {name[len(prefix) :]: one.sha256 for name, one in found.files.items() if name.startswith(prefix)},
                )
        return cls(place, {})

    @property
    def key(self) -> str:
        """A name for the folder in a cache, by its address and content."""
        said = store.json_text([self.place.text, sorted(self.sums.items())], indent=None)
        return hashlib.sha256(said.encode()).hexdigest()[:24]

    def numbers(self) -> tuple[int, ...]:
        """Numbers of all shards, sorted."""
        names = sorted(self.sums) or self.place.names()
        found = (n[5:-12] for n in names if n.startswith("city_") and n.endswith(".safetensors"))
        return tuple(sorted(int(n) for n in found if n.isdecimal()))

    def bring(self, number: int, path: Path) -> None:
        """Write a shard to `path`, verified.

        Raises:
            InputError: it is not there. IntegrityError: it is not what was uploaded, twice. ResourceError: no
                connection.
        """
        name = clip_shards.shard_path(Path(), number).name
        wanted = self.sums.get(name, "")
        for last in (False, True):
            content = (self.place / name).load()
            got = hashlib.sha256(content).hexdigest()
            if not wanted or got == wanted:
                store.atomic_write(path, content)
                return
            if last:
                raise IntegrityError(
                    "what came is not what was uploaded",
                    where=f"{self.place}/{name}",
                    expected=f"sha256 {wanted[:16]}...",
                    got=f"sha256 {got[:16]}...",
                    remedy="upload the clips again",
                )


def _parent(place: Location) -> Location | None:
    head = place.text.rpartition("/")[0]
    return Location.of(head) if head and not head.endswith("/") else None


class StreamedShards:
    """The clips of a training, at an address: fetched when they are needed.

    Args:
        clips: how many clips each shard to train on has. Draws are made from it before a shard is here.
    """

    def __init__(self, place: Location, cache: ShardCache, clips: int) -> None:
        self._folder, self._cache, self._clips = FolderOfShards.open(place), cache, clips

    def path(self, number: int) -> Path:
        """The shard, on this machine.

        Raises:
            InputError: it has another number of clips, or is not there. IntegrityError: it is damaged.
        """
        name = f"{self._folder.key}/{number:07d}.safetensors"
        return self._cache.get(name, lambda path: self._bring(number, path))

    def _bring(self, number: int, path: Path) -> None:
        self._folder.bring(number, path)
        found = clip_shards.clips_at(path)
        if number < HELD_OUT and found != self._clips:
            store.remove(path)
            raise InputError(
                "the training clips have another number of clips in each shard",
                where=str(self._folder.place),
                expected=str(self._clips),
                got=str(found),
                remedy=f"--data.clips-per-city {found}",
            )

    def clips_in(self, number: int) -> int:
        """Clips in a shard; of those to train on without fetching it."""
        return self._clips if number < HELD_OUT else self.reading(number, clip_shards.clips_at)

    def reading(self, number: int, read: Callable[[Path], Result]) -> Result:
        """What `read` makes of a shard's file, which another process may remove at any time."""
        return read_present(lambda: self.path(number), read)


def read_present(find: Callable[[], Path], read: Callable[[Path], Result]) -> Result:
    """What `read` makes of the file that `find` brings; again, if the file was removed in between."""
    for _ in range(_TRIES - 1):
        path = find()
        try:
            return read(path)
        except InputError:
            if path.is_file():
                raise
    return read(find())
