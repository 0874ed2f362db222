"""Folders from one place to another: verified, resumable, several files at a time, in bounded memory.

An uploaded folder holds ``_contents.json`` beside its files: size and sha256 of each. It is written before anything else, in the state
``uploading``, and once more when every file has arrived; the folder's ``manifest.json`` follows as the last file.
"""

from __future__ import annotations

import concurrent.futures
import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

from mudg.base import log, memory, store
from mudg.base.errors import InputError, IntegrityError, ResourceError, UsageError
from mudg.base.local import LocalStore, files_below
from mudg.base.remote import PIECE, Found, RemoteStore, part_bytes

CONTENTS: Final = "_contents.json"
WORKERS: Final = 8
"""Files under way at once."""
_LEFT_FREE: Final = 64 << 20
_LAST: Final = (store.MANIFEST, store.RUN_STATE)
"""What says that a folder is finished is written after what it speaks of."""


@dataclass(frozen=True)
class Side:
    """A folder or file in a store."""

    storage: LocalStore | RemoteStore
    path: str

    def below(self, name: str) -> str:
        """The store's path of a file in the folder."""
        return f"{self.path.rstrip('/')}/{name}" if name else self.path

    def where(self, name: str = "") -> str:
        """The same for messages."""
        return self.storage.where(self.below(name))


@dataclass(frozen=True)
class Expected:
    """What a file should be. sha256: empty if not known."""

    size: int
    sha256: str = ""


@dataclass(frozen=True)
class Upload:
    """What ``_contents.json`` says. names: of one under way: all that it or an earlier one may have written."""

    complete: bool
    files: Mapping[str, Expected] = field(default_factory=dict)
    names: frozenset[str] = frozenset()

    def content(self) -> bytes:
        """The record as it is stored."""
        files = {name: {"bytes": one.size, "sha256": one.sha256} for name, one in sorted(self.files.items())}
        state = "complete" if self.complete else "uploading"
        return store.json_text({"schema": 1, "state": state, "files": files, "names": sorted(self.names)}, indent=None).encode()


def uploaded(side: Side) -> Upload | None:
    """The record of an upload to this folder; None where there is none.

    Raises:
        IntegrityError: it is damaged.
    """
    path, where = side.below(CONTENTS), side.where(CONTENTS)
    if not side.storage.exists(path):
        return None
    try:
        record = store.parse_json(side.storage.load(path), where)
        files = {str(name): Expected(int(entry["bytes"]), str(entry["sha256"])) for name, entry in record["files"].items()}
        found = Upload(record["state"] == "complete", files, frozenset(map(str, record["names"])))
    except (InputError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise IntegrityError("the record of an upload is damaged", where=where, got=str(error).split("\n")[0],
            remedy="upload the folder again, to another address") from error  # fmt: skip
    for name in (*found.files, *found.names):
        _plain(name, where)
    return found


def _plain(name: str, where: str) -> str:
    """A name that stays below its folder, or IntegrityError: what lies in a store may be anybody's."""
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\\" in name or "\0" in name or (os.name == "nt" and ":" in name):
        raise IntegrityError("a name leads out of its folder", where=where, got=repr(name)[:200])
    return name


# fetch ----------------------------------------------------------------------------------------------------------------


def fetch(source: Side, to: Path) -> frozenset[str]:
    """Copy a file or folder to ``to`` on this machine (see ``Location.fetch``); return the names of its files."""
    if not source.storage.is_folder(source.path):
        wanted = {"": Expected(source.storage.size(source.path))}
    else:
        wanted = _wanted(source)
    _require_space(to, wanted, source)
    store.make_folder(to.parent if "" in wanted else to)
    for last in (False, True):
        names = [name for name in wanted if (PurePosixPath(name).name in _LAST) == last]
        _all((_Fetching(source, name, wanted[name], to) for name in names), f"fetching {source.where()}", len(names))
    return frozenset(wanted)


def _wanted(source: Side) -> dict[str, Expected]:
    record = uploaded(source)
    if record is not None:
        if not record.complete or (store.MANIFEST in record.files and not source.storage.exists(source.below(store.MANIFEST))):
            raise InputError("an upload was not finished", where=source.where(),
                remedy="repeat the command that makes it: it resumes")  # fmt: skip
        return dict(record.files)
    there = source.storage.tree(source.path)
    found = {_plain(name, source.where()): Expected(facts.size) for name, facts in there.items()}
    for manifest in [name for name in found if PurePosixPath(name).name == store.MANIFEST]:
        found.update(_listed(source, manifest, found))
    return found


def _listed(source: Side, manifest: str, found: Mapping[str, Expected]) -> dict[str, Expected]:
    """What a manifest in a folder that was put there by other means says of files beside it."""
    record = store.parse_json(source.storage.load(source.below(manifest)), source.where(manifest))
    files = record.get("files") if isinstance(record, dict) else None
    listed: dict[str, Expected] = {}
    for name, entry in (files if isinstance(files, dict) else {}).items():
        full = str(PurePosixPath(manifest).parent / str(name))
        if not isinstance(entry, dict) or "sha256" not in entry:
            continue
        if full not in found:
            raise IntegrityError("a file is missing", where=source.where(full))
        listed[full] = Expected(found[full].size, str(entry["sha256"]))
    return listed


def _require_space(to: Path, wanted: Mapping[str, Expected], source: Side) -> None:
    """ResourceError if the disk cannot hold what is not yet there."""
    missing = 0
    for name, one in wanted.items():
        there = next((at for at in (to / name, _part(to / name)) if at.is_file()), None)
        missing += max(0, one.size - (there.stat().st_size if there else 0))
    at = next(one for one in (to.absolute(), *to.absolute().parents) if one.exists())
    free = shutil.disk_usage(at).free
    if missing + _LEFT_FREE > free:
        raise ResourceError("not enough space to fetch data", where=str(to), expected=f"{memory.in_words(missing)} for {source.where()}",
            got=f"{memory.in_words(free)} free", remedy="free disk space, or choose a folder on a larger disk (--scratch)")  # fmt: skip


def _part(path: Path) -> Path:
    return path.with_name(f".{path.name}.fetching.part")


@dataclass(frozen=True)
class _Fetching:
    """One file on its way here."""

    source: Side
    name: str
    expected: Expected
    to: Path

    def __call__(self) -> None:
        path, wanted = (self.to / self.name if self.name else self.to), self.expected
        if path.is_file() and path.stat().st_size == wanted.size and wanted.sha256 and store.sha256_file(path) == wanted.sha256:
            return
        part, digest, begin = _part(path), hashlib.sha256(), 0
        if part.is_file() and wanted.sha256 and part.stat().st_size <= wanted.size:
            begin = part.stat().st_size
            for block in store.blocks_of(part):
                digest.update(block)
        store.append_blocks(part, _pieces(self.source, self.name, wanted.size, begin, digest), begin)
        if wanted.sha256 and digest.hexdigest() != wanted.sha256:
            store.remove(part)
            if begin:  # the beginning, from an earlier try, may be of another version
                return self()
            raise IntegrityError("what came is not what was uploaded", where=self.source.where(self.name),
                expected=f"sha256 {wanted.sha256[:16]}...", got=f"sha256 {digest.hexdigest()[:16]}...",
                remedy="repeat the command; if it fails again, upload the data again")  # fmt: skip
        store.take_place(part, path)


def _pieces(source: Side, name: str, size: int, begin: int, digest: Any) -> Iterator[bytes]:
    while begin < size:
        end = min(begin + PIECE, size)
        try:
            block = source.storage.piece(source.below(name), begin, end)
        except FileNotFoundError as error:
            raise IntegrityError("a file is missing", where=source.where(name)) from error
        if len(block) != end - begin:
            raise IntegrityError("a file has another size than it should", where=source.where(name), expected=f"{size} bytes",
                got=f"{begin + len(block)} bytes")  # fmt: skip
        digest.update(block)
        yield block
        begin = end


# push -----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Digests:
    """Of one file here. tag: what a store calls it if it arrives unchanged."""

    expected: Expected
    tag: str


def push(folder: Path, target: Side) -> None:
    """Upload a folder; see ``Location.push``."""
    names = [name for name in files_below(folder) if name != CONTENTS]
    there, earlier = target.storage.tree(target.path), uploaded(target)
    if earlier is not None and earlier.complete and _is_there(folder, names, earlier, there):
        return
    foreign = sorted(set(names) & set(there)) if earlier is None else []
    if foreign:
        raise UsageError("the output address holds files of something else", where=target.where(), got=", ".join(foreign[:8]),
            remedy="choose an address at which nothing is")  # fmt: skip
    target.storage.remove(target.below(store.MANIFEST))  # from now on it is no result
    own = frozenset((*earlier.files, *earlier.names) if earlier is not None else ())
    target.storage.save(target.below(CONTENTS), Upload(False, names=own | frozenset(names)).content())
    sent: dict[str, _Digests] = {}
    for last in (False, True):
        some = [name for name in names if name != store.MANIFEST and (PurePosixPath(name).name in _LAST) == last]
        _all((_Sending(folder, name, target, there.get(name), sent) for name in some), f"uploading to {target.where()}", len(some))
    stale = sorted(own - set(names))
    _all((_Removing(target, name) for name in stale), "removing files of an earlier upload", len(stale))
    _verify(target, sent)
    target.storage.settle(target.path)
    files = {name: one.expected for name, one in sent.items()}
    if store.MANIFEST not in names:
        target.storage.save(target.below(CONTENTS), Upload(True, files).content())
        return
    manifest = _digests(folder / store.MANIFEST).expected
    target.storage.save(target.below(CONTENTS), Upload(True, {**files, store.MANIFEST: manifest}).content())
    target.storage.save(target.below(store.MANIFEST), store.read_bytes(folder / store.MANIFEST))


def _is_there(folder: Path, names: list[str], earlier: Upload, there: Mapping[str, Found]) -> bool:
    """Whether an earlier upload brought just this."""
    if set(names) != set(earlier.files) or any(name not in there or there[name].size != earlier.files[name].size for name in names):
        return False
    return all(
        (folder / name).stat().st_size == one.size and store.sha256_file(folder / name) == one.sha256
        for name, one in earlier.files.items()
    )


@dataclass(frozen=True)
class _Sending:
    """One file on its way there; ``sent`` receives what it was."""

    folder: Path
    name: str
    target: Side
    there: Found | None
    sent: dict[str, _Digests]

    def __call__(self) -> None:
        file, path = self.folder / self.name, self.target.below(self.name)
        digests = self.sent[self.name] = _digests(file)
        wanted = digests.expected
        same_size = self.there is not None and self.there.size == wanted.size
        if not same_size or self.target.storage.note(path, "sha256") != wanted.sha256:
            self.target.storage.put(path, file, wanted.sha256)


@dataclass(frozen=True)
class _Removing:
    """One file that is no longer part of the folder."""

    target: Side
    name: str

    def __call__(self) -> None:
        self.target.storage.remove(self.target.below(self.name))


def _digests(file: Path) -> _Digests:
    size = file.stat().st_size
    part = part_bytes(size)
    sha256, parts = hashlib.sha256(), [hashlib.md5(usedforsecurity=False)]
    count = 0
    for block in store.blocks_of(file):
        sha256.update(block)
        while block:
            if size >= 2 * part and count == part:
                parts.append(hashlib.md5(usedforsecurity=False))
                count = 0
            taken = block[: part - count] if size >= 2 * part else block
            parts[-1].update(taken)
            block, count = block[len(taken) :], count + len(taken)
    tag = parts[0].hexdigest()
    if size >= 2 * part:
        tag = f"{hashlib.md5(b''.join(one.digest() for one in parts), usedforsecurity=False).hexdigest()}-{len(parts)}"
    return _Digests(Expected(size, sha256.hexdigest()), tag)


def _verify(target: Side, sent: Mapping[str, _Digests]) -> None:
    """Compare what the store lists with what was sent; where its checksum is of another kind, or none, read the file back."""
    there = target.storage.tree(target.path)
    again = []
    for name, digests in sent.items():
        found, size = there.get(name), digests.expected.size
        if found is None or found.size != size:
            raise IntegrityError("a file did not arrive as it was sent", where=target.where(name), expected=f"{size} bytes",
                got="nothing" if found is None else f"{found.size} bytes", remedy="repeat the command to upload it again")  # fmt: skip
        if found.tag != digests.tag:
            again.append(_ReadingBack(target, name, digests.expected))
    _all(again, f"reading back from {target.where()}", len(again))


@dataclass(frozen=True)
class _ReadingBack:
    """One file whose arrival is not known from the listing."""

    target: Side
    name: str
    expected: Expected

    def __call__(self) -> None:
        digest = hashlib.sha256()
        for _ in _pieces(self.target, self.name, self.expected.size, 0, digest):
            pass
        if digest.hexdigest() != self.expected.sha256:
            self.target.storage.remove(self.target.below(self.name))
            raise IntegrityError("a file did not arrive as it was sent", where=self.target.where(self.name),
                expected=f"sha256 {self.expected.sha256[:16]}...", got=f"sha256 {digest.hexdigest()[:16]}...",
                remedy="repeat the command to upload it again")  # fmt: skip


# several at a time ----------------------------------------------------------------------------------------------------


def _all(calls: Iterable[Callable[[], None]], description: str, count: int) -> None:
    """All of these, several at a time; the first failure ends what has not begun."""
    if not count:
        return
    with concurrent.futures.ThreadPoolExecutor(min(WORKERS, count)) as pool, log.task(description, count) as bar:
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
