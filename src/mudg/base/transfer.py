"""Folders from one place to another: verified, resumable, several files at a time, in bounded memory."""

from __future__ import annotations

import concurrent.futures
import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final, Protocol

from mudg.base import log, memory, store
from mudg.base.errors import InputError, IntegrityError, ResourceError
from mudg.base.remote import PIECE, Found

CONTENTS: Final = "_contents.json"
"""Beside an uploaded folder: size and sha256 of every file in it."""
WORKERS: Final = 8
"""Files under way at once."""
_SUFFIX: Final = ".fetch.part"
_LEFT_FREE: Final = 64 << 20


class Storage(Protocol):
    """What a transfer asks of either side."""

    def where(self, path: str) -> str: ...
    def exists(self, path: str) -> bool: ...
    def is_folder(self, path: str) -> bool: ...
    def size(self, path: str) -> int: ...
    def load(self, path: str) -> bytes: ...
    def piece(self, path: str, begin: int, end: int) -> bytes: ...
    def save(self, path: str, data: bytes) -> None: ...
    def remove(self, path: str) -> None: ...
    def tree(self, path: str) -> dict[str, Found]: ...
    def note(self, path: str, name: str) -> str: ...
    def put(self, path: str, file: Path, sha256: str) -> None: ...


@dataclass(frozen=True)
class Side:
    """A folder or file in a storage."""

    storage: Storage
    path: str

    def below(self, name: str) -> str:
        """The storage's path of a file in the folder."""
        return f"{self.path.rstrip('/')}/{name}" if name else self.path

    def where(self, name: str = "") -> str:
        """The same for messages."""
        return self.storage.where(self.below(name))


@dataclass(frozen=True)
class Expected:
    """What a file should be. sha256: empty if not known."""

    size: int
    sha256: str = ""


# what is in a folder --------------------------------------------------------------------------------------------------


def files_below(folder: Path) -> list[str]:
    """Relative POSIX names of all regular files, sorted, without temporary ones and locks."""
    names = []
    for top, _, files in os.walk(folder):
        for name in files:
            path = Path(top) / name
            relative = path.relative_to(folder).as_posix()
            if name == "lock" or any(".part" in part for part in relative.split("/")) or not path.is_file():
                continue
            names.append(relative)
    return sorted(names)


def _contents(side: Side) -> dict[str, Expected] | None:
    """What the record of an upload says; None where there is none."""
    path = side.below(CONTENTS)
    if not side.storage.exists(path):
        return None
    try:
        files = store.parse_json(side.storage.load(path), side.where(CONTENTS))["files"]
        found = {str(name): Expected(int(entry["bytes"]), str(entry["sha256"])) for name, entry in files.items()}
    except (InputError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise IntegrityError("the record of an upload is damaged", where=side.where(CONTENTS), got=str(error).split("\n")[0],
            remedy="upload it again") from error  # fmt: skip
    for name in found:
        plain_name(name, side.where(CONTENTS))
    return found


def plain_name(name: str, where: str) -> str:
    """A name that stays below its folder, or IntegrityError: what lies in a store may be anybody's."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\\" in name or "\0" in name or (os.name == "nt" and ":" in name):
        raise IntegrityError("a name leads out of its folder", where=where, got=repr(name)[:200])
    return name


# fetch ----------------------------------------------------------------------------------------------------------------


def fetch(source: Side, to: Path) -> None:
    """Copy a file or folder to ``to`` on this machine; see ``Location.fetch``."""
    if not source.storage.is_folder(source.path):
        wanted = {"": Expected(source.storage.size(source.path))}
    else:
        wanted = _wanted(source)
    _require_space(to, sum(one.size for one in wanted.values()), source)
    last = [name for name in wanted if name == store.MANIFEST]
    store.make_folder(to.parent if "" in wanted else to)
    for names in ([name for name in wanted if name not in last], last):
        _all((_fetching(source, name, wanted[name], to) for name in names), f"fetching {source.where()}", len(names))


def _wanted(source: Side) -> dict[str, Expected]:
    found = _contents(source)
    if found is not None:
        if store.MANIFEST in found and not source.storage.exists(source.below(store.MANIFEST)):
            raise InputError("an upload was not finished", where=source.where(), expected=store.MANIFEST,
                remedy="repeat the command that makes it: it resumes")  # fmt: skip
        return found
    found = {plain_name(name, source.where()): Expected(facts.size) for name, facts in source.storage.tree(source.path).items()}
    if store.MANIFEST in found:
        where = source.where(store.MANIFEST)
        listed = store.parse_json(source.storage.load(source.below(store.MANIFEST)), where)
        files: Mapping[str, Any] = listed.get("files", {}) if isinstance(listed, dict) else {}
        for name, entry in files.items():
            if name not in found:
                raise IntegrityError("a file is missing", where=source.where(name))
            if isinstance(entry, dict) and "sha256" in entry:
                found[name] = Expected(found[name].size, str(entry["sha256"]))
    return found


def _require_space(to: Path, count: int, source: Side) -> None:
    at = next(one for one in (to, *to.absolute().parents) if one.exists())
    free = shutil.disk_usage(at).free
    if count + _LEFT_FREE > free:
        raise ResourceError("not enough space to stage data in", where=str(to), expected=f"{memory.in_words(count)} for {source.where()}",
            got=f"{memory.in_words(free)} free", remedy="free disk space, or choose a larger --scratch")  # fmt: skip


def _fetching(source: Side, name: str, expected: Expected, to: Path) -> Callable[[], None]:
    return lambda: _fetch_file(source, name, expected, to / name if name else to)


def _fetch_file(source: Side, name: str, expected: Expected, to: Path) -> None:
    if to.is_file() and to.stat().st_size == expected.size and expected.sha256 and store.sha256_file(to) == expected.sha256:
        return
    part = to.with_name(f".{to.name}{_SUFFIX}")
    digest, begin = hashlib.sha256(), 0
    if part.is_file() and expected.sha256 and part.stat().st_size <= expected.size:
        begin = part.stat().st_size
        for block in store.blocks_of(part):
            digest.update(block)
    store.append_blocks(part, _pieces(source, name, expected, begin, digest), begin)
    if expected.sha256 and digest.hexdigest() != expected.sha256:
        part.unlink(missing_ok=True)
        raise IntegrityError("what came is not what was uploaded", where=source.where(name), expected=f"sha256 {expected.sha256[:16]}...",
            got=f"sha256 {digest.hexdigest()[:16]}...", remedy="repeat the command; if it fails again, upload the data again")  # fmt: skip
    store.take_place(part, to)


def _pieces(source: Side, name: str, expected: Expected, begin: int, digest: Any) -> Iterator[bytes]:
    while begin < expected.size:
        end = min(begin + PIECE, expected.size)
        try:
            block = source.storage.piece(source.below(name), begin, end)
        except FileNotFoundError as error:
            raise IntegrityError("a file is missing", where=source.where(name)) from error
        if len(block) != end - begin:
            raise IntegrityError("a file ended early", where=source.where(name), expected=f"{end} bytes", got=f"{begin + len(block)} bytes")
        digest.update(block)
        yield block
        begin = end


# push -----------------------------------------------------------------------------------------------------------------


def push(folder: Path, target: Side) -> None:
    """Upload a folder; see ``Location.push``."""
    names = [name for name in files_below(folder) if name != CONTENTS]
    there = target.storage.tree(target.path)
    earlier = _contents(target) if CONTENTS in there else {}
    for name in (store.MANIFEST, CONTENTS):  # from now on it is no result
        if name in there and not (name == store.MANIFEST and _same_manifest(folder, target)):
            target.storage.remove(target.below(name))
    record: dict[str, dict[str, Any]] = {}
    md5s: dict[str, str] = {}

    def send(name: str) -> None:
        file = folder / name
        sha256, md5, size = _digests(file)
        record[name], md5s[name] = {"bytes": size, "sha256": sha256}, md5
        found, path = there.get(name), target.below(name)
        if name != store.MANIFEST and found is not None and found.size == size and target.storage.note(path, "sha256") == sha256:
            return
        target.storage.put(path, file, sha256)

    ordinary = [name for name in names if name != store.MANIFEST]
    _all((lambda name=name: send(name) for name in ordinary), f"uploading to {target.where()}", len(ordinary))
    stale = set(earlier or {}) - set(names)
    _all((lambda name=name: target.storage.remove(target.below(name)) for name in stale), "removing", len(stale))
    _verify(folder, target, record, md5s)
    if store.MANIFEST in names:
        sha256, _, size = _digests(folder / store.MANIFEST)
        record[store.MANIFEST] = {"bytes": size, "sha256": sha256}
    text = store.json_text({"schema": 1, "files": dict(sorted(record.items()))}, indent=None)
    target.storage.save(target.below(CONTENTS), text.encode())
    if store.MANIFEST in names:
        target.storage.put(target.below(store.MANIFEST), folder / store.MANIFEST, record[store.MANIFEST]["sha256"])


def _same_manifest(folder: Path, target: Side) -> bool:
    return False


def _digests(file: Path) -> tuple[str, str, int]:
    sha256, md5, size = hashlib.sha256(), hashlib.md5(usedforsecurity=False), 0
    for block in store.blocks_of(file):
        sha256.update(block)
        md5.update(block)
        size += len(block)
    return sha256.hexdigest(), md5.hexdigest(), size


def _verify(folder: Path, target: Side, record: Mapping[str, Mapping[str, Any]], md5s: Mapping[str, str]) -> None:
    """Compare what the storage lists with what was sent; where its checksum is another one, read it back."""
    there = target.storage.tree(target.path)
    for name, entry in record.items():
        found = there.get(name)
        if found is None or found.size != entry["bytes"]:
            raise IntegrityError("a file did not arrive as it was sent", where=target.where(name), expected=f"{entry['bytes']} bytes",
                got="nothing" if found is None else f"{found.size} bytes", remedy="repeat the command to upload it again")  # fmt: skip
        if found.md5 and found.md5 != md5s[name]:
            digest = hashlib.sha256()
            for _ in _pieces(target, name, Expected(found.size), 0, digest):
                pass
            if digest.hexdigest() != entry["sha256"]:
                target.storage.remove(target.below(name))
                raise IntegrityError("a file did not arrive as it was sent", where=target.where(name),
                    expected=f"sha256 {entry['sha256'][:16]}...", remedy="repeat the command to upload it again")  # fmt: skip


def _all(calls: Iterable[Callable[[], None]], description: str, count: int) -> None:
    """All of these, several at a time; the first failure ends what has not begun."""
    with concurrent.futures.ThreadPoolExecutor(WORKERS) as pool, log.task(description, count) as bar:
        waiting: set[concurrent.futures.Future[None]] = set()
        try:
            for call in calls:
                waiting.add(pool.submit(call))
                if len(waiting) >= 4 * WORKERS:
                    waiting = _finished(waiting, bar)
            while waiting:
                waiting = _finished(waiting, bar)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _finished(waiting: set[concurrent.futures.Future[None]], bar: log.ProgressTask) -> set[concurrent.futures.Future[None]]:
    done, rest = concurrent.futures.wait(waiting, return_when=concurrent.futures.FIRST_COMPLETED)
    for one in done:
        one.result()
        bar.advance()
    return rest
