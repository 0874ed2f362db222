"""The bytes of a scene, from a directory or from a stored zip, behind one interface.

Nothing outside the scene can be reached: references are checked as text, and on disk as real paths. What this package
wrote carries a manifest of sha256 sums, and every file read is compared with it: a flipped bit is an error, not a point
somewhere else.
"""

from __future__ import annotations

import functools
import hashlib
import os
import stat
import zipfile
import zlib
from pathlib import Path
from typing import Final, NamedTuple, Protocol

from mudg.base import store
from mudg.base.errors import InputError, IntegrityError
from mudg.scene.schema import parse_object, ref_problem

MAX_FILE_BYTES: Final = 4 * 1024**3
READABLE: Final = "a readable file inside the scene"


class SceneFiles(Protocol):
    """Read access to the files of one scene."""

    root: str

    def read(self, ref: str) -> bytes:
        """All bytes of the file ``ref``, checked against the manifest where there is one."""
        ...

    def is_hashed(self, ref: str) -> bool:
        """Whether the manifest holds a hash of ``ref``, so that what ``read`` returns is known to be as it was
        written."""
        ...

    def problem(self, ref: str) -> str | None:
        """Say why ``ref`` cannot be read (missing, outside the scene), or None. Cheap: nothing is opened."""
        ...


def open_files(path: Path | str) -> SceneFiles:
    """Open a scene directory or a stored zip; the index is kept until the file changes.

    Raises:
        InputError: no such path, not a scene, or a zip that is damaged or not stored.
    """
    path = Path(path)
    index = path / "scene.json" if path.is_dir() else path
    try:
        state = index.stat()
    except FileNotFoundError as error:
        if path.is_dir():
            remedy = "make one with `mudg ingest`; an interrupted ingest leaves no scene.json"
            what = "folder is not a scene: it has no scene.json"
            raise InputError(what, where=str(path), expected="a scene directory", remedy=remedy) from error
        expected = "a scene directory or a stored zip of one"
        raise InputError("scene does not exist", where=str(path), expected=expected) from error
    except OSError as error:
        raise InputError("scene cannot be read", where=str(path), got=str(error)) from error
    manifest = path / store.MANIFEST
    manifest_state = manifest.stat().st_mtime_ns if path.is_dir() and manifest.is_file() else 0
    return _open_cached(str(path.absolute()), state.st_mtime_ns, state.st_size, manifest_state)


@functools.lru_cache(maxsize=16)
def _open_cached(path: str, _mtime_ns: int, _size: int, _manifest_ns: int) -> SceneFiles:
    return FolderFiles(path) if os.path.isdir(path) else ZipFiles(path)


class _Manifest:
    """The sha256 sums that were written with a scene; empty for a scene without any."""

    def __init__(self, content: bytes | None, root: str) -> None:
        self.root = root
        self.hashes: dict[str, str] = {}
        where = f"{root}: {store.MANIFEST}"
        try:
            if content is not None:
                files = parse_object(content, where)["files"]
                self.hashes = {str(name): str(entry["sha256"]) for name, entry in files.items()}
        except (InputError, KeyError, TypeError, AttributeError) as error:
            remedy = "ingest again, or delete the manifest if you edited the scene on purpose"
            raise IntegrityError("the manifest is damaged", where=where, got=str(error), remedy=remedy) from error

    def checked(self, content: bytes, ref: str) -> bytes:
        """The content of ``ref``; IntegrityError if it differs from what was written."""
        expected = self.hashes.get(ref)
        if expected is not None and hashlib.sha256(content).hexdigest() != expected:
            what, where = "a file differs from what was written", f"{self.root}: {ref}"
            remedy = "restore the file or ingest again; delete manifest.json if you edited the scene on purpose"
            raise IntegrityError(what, where=where, expected=f"sha256 {expected[:16]}...", remedy=remedy)
        return content


class FolderFiles:
    """A scene in a directory."""

    def __init__(self, root: str) -> None:
        self.root = root
        self._real_root = os.path.realpath(root)
        manifest = Path(root) / store.MANIFEST
        self._manifest = _Manifest(store.read_bytes(manifest) if manifest.is_file() else None, root)

    def read(self, ref: str) -> bytes:
        problem = self.problem(ref)
        if problem is not None:
            remedy = "restore the file or ingest the log again"
            raise InputError(problem, where=f"{self.root}: {ref}", expected=READABLE, remedy=remedy)
        return self._manifest.checked(store.read_bytes(Path(self.root) / ref), ref)

    def is_hashed(self, ref: str) -> bool:
        return ref in self._manifest.hashes

    def problem(self, ref: str) -> str | None:
        text_problem = ref_problem(ref)
        if text_problem is not None:
            return f"file reference {text_problem}"
        real = os.path.realpath(os.path.join(self._real_root, *ref.split("/")))
        if os.path.commonpath([real, self._real_root]) != self._real_root:
            return "a link leads out of the scene"
        try:
            state = os.stat(real)
        except OSError:
            return "a file is missing"
        if not stat.S_ISREG(state.st_mode):
            return "a reference names something that is not a plain file"
        if state.st_size > MAX_FILE_BYTES:
            return f"a file is larger than {MAX_FILE_BYTES} bytes"
        return None


class _ZipEntry(NamedTuple):
    header_offset: int
    size: int
    crc: int


class ZipFiles:
    """A scene in a stored (not deflated) zip, read by offset: opening a frame costs one seek."""

    def __init__(self, root: str) -> None:
        self.root = root
        self._entries = self._index(root)
        self._manifest = _Manifest(self._raw(store.MANIFEST) if store.MANIFEST in self._entries else None, root)

    @staticmethod
    def _index(root: str) -> dict[str, _ZipEntry]:
        try:
            with zipfile.ZipFile(store.regular(Path(root))) as archive:
                infos = archive.infolist()
        except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError, EOFError) as error:
            what, expected = "file is neither a scene directory nor a readable zip", "a stored zip of a scene directory"
            remedy = "is it cut off? copy it again"
            raise InputError(what, where=root, got=str(error), expected=expected, remedy=remedy) from error
        entries: dict[str, _ZipEntry] = {}
        for info in infos:
            if info.is_dir():
                continue
            name = info.orig_filename
            _check_entry(info, root)
            if name in entries:
                raise InputError("zip holds the same name twice", where=root, got=name, expected="each file once")
            entries[name] = _ZipEntry(info.header_offset, info.file_size, info.CRC)
        if "scene.json" in entries:
            return entries
        folders = {name.split("/", 1)[0] for name in entries if "/" in name}
        if len(folders) == 1 and f"{next(iter(folders))}/scene.json" in entries:
            prefix = f"{next(iter(folders))}/"
            return {name.removeprefix(prefix): entry for name, entry in entries.items() if name.startswith(prefix)}
        expected = "scene.json at the top of the zip"
        raise InputError("zip is not a scene: it has no scene.json", where=root, expected=expected)

    def _raw(self, ref: str) -> bytes:
        entry, where = self._entries[ref], f"{self.root}: {ref}"
        try:
            with store.open_file(Path(self.root)) as handle:
                handle.seek(entry.header_offset)
                header = handle.read(30)
                if len(header) != 30 or header[:4] != b"PK\x03\x04":
                    raise InputError("zip is damaged", where=where, got="no local header where the index says")
                name_length, extra_length = (int.from_bytes(header[n : n + 2], "little") for n in (26, 28))
                handle.seek(name_length + extra_length, os.SEEK_CUR)
                content = handle.read(entry.size)
        except OSError as error:
            raise InputError("zip cannot be read", where=where, got=str(error)) from error
        if len(content) != entry.size or zlib.crc32(content) != entry.crc:
            expected = f"{entry.size} bytes with CRC {entry.crc:08x}"
            got = f"{len(content)} bytes with CRC {zlib.crc32(content):08x}"
            raise InputError("zip is damaged", where=where, expected=expected, got=got, remedy="copy the zip again")
        return content

    def read(self, ref: str) -> bytes:
        problem = self.problem(ref)
        if problem is not None:
            raise InputError(problem, where=f"{self.root}: {ref}", expected="a file inside the zip")
        return self._manifest.checked(self._raw(ref), ref)

    def is_hashed(self, ref: str) -> bool:
        return ref in self._manifest.hashes

    def problem(self, ref: str) -> str | None:
        return None if ref in self._entries else "a file is missing"


def _check_entry(info: zipfile.ZipInfo, root: str) -> None:
    """Refuse what a stored zip of a scene does not hold: names that lead out, compression, encryption, links."""
    name = info.orig_filename
    where, problem = f"{root}: {name}", ref_problem(name)
    if problem is not None:
        expected = "relative paths inside the scene"
        raise InputError(f"zip entry {problem}", where=root, got=repr(name)[:120], expected=expected)
    if info.flag_bits & 0x1:
        raise InputError("zip entry is encrypted", where=where)
    if info.compress_type != zipfile.ZIP_STORED:
        expected, remedy = "a stored zip (no compression)", "unpack it, or write it with `zip -0`"
        raise InputError("zip entry is compressed", where=where, expected=expected, remedy=remedy)
    if info.file_size != info.compress_size or info.file_size > MAX_FILE_BYTES:
        raise InputError("zip entry declares a size that cannot be", where=where, got=f"{info.file_size} bytes")
    if stat.S_ISLNK(info.external_attr >> 16):
        raise InputError("zip entry is a link", where=where, expected="plain files")
