"""Addresses in an object store behind fsspec (S3, Google Cloud, Azure), as in
``(Location.of("s3://bucket/runs") / "kitti").fetch(Path("/scratch/kitti"))``.

An uploaded folder holds ``_contents.json``: size and SHA-256 of every file, and whether all have arrived. That record
alone says what a result is. Requests that fail are repeated by the store's own package. Credentials come from the
environment, where that package looks for them; an address that holds some is refused and never shown.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shutil
import ssl
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

from mudg.base import log, memory, store
from mudg.base.errors import InputError, IntegrityError, ResourceError, UsageError

PACKAGES: Final[Mapping[str, tuple[str, str]]] = {
    **dict.fromkeys(("s3", "s3a"), ("s3fs", "s3")),
    **dict.fromkeys(("gs", "gcs"), ("gcsfs", "gs")),
    **dict.fromkeys(("abfs", "abfss", "az"), ("adlfs", "abfs")),
    "memory": ("fsspec", "s3"),
}
"""Scheme of an address -> the package that reads it, and the extra of this program that installs it."""
CONTENTS: Final = "_contents.json"
_FILES_AT_ONCE, _GROUP, _CHUNK = 8, 32, 8 << 20
"""Files that are under way at once, files of one request to fsspec, and bytes of a part of a large upload."""
_LEFT_FREE: Final = 64 << 20
_FLATTENED = re.compile(rf"({'|'.join(PACKAGES)}):/(?!/)")


def scheme_of(text: str) -> str:
    """``s3`` of ``s3://bucket/x``; empty for a path on this machine."""
    match = re.match(r"([A-Za-z][A-Za-z0-9+.\-]+)://", text)
    return match[1].lower() if match else ""


def checked_address(text: str) -> str:
    """An address in its one spelling: no slash at the end, none doubled. UsageError: an unknown scheme, no bucket,
    credentials or a query in it (which are not shown), or ``..``."""
    scheme = scheme_of(text)
    rest = text[len(scheme) + 3 :]
    if scheme not in PACKAGES:
        known = ", ".join(f"{one}://" for one in PACKAGES)
        where, expected = f"{scheme}://", f"a path, or one of {known}"
        raise UsageError("no storage of this kind is known", where=where, expected=expected)
    head, _, tail = rest.partition("/")
    # Azure: container@account; a password may hold a slash
    if ("@" in head and PACKAGES[scheme][0] != "adlfs") or ":" in head:
        remedy = "leave them out and set the environment instead, e.g. AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        raise UsageError("an address holds a user or a password", where=f"{scheme}://...", remedy=remedy)
    if "?" in rest:
        what, where = "an address holds a query, which may be a secret", f"{scheme}://{head.partition('?')[0]}/..."
        raise UsageError(what, where=where, expected=f"{scheme}://bucket/folder", remedy="leave the part from ? on out")
    parts = [part for part in tail.split("/") if part]
    what = "an address is not plain" if {"..", "."} & {*parts} or "\0" in rest or "::" in head else ""
    if what or (not head and scheme != "memory"):
        where, expected = text[:200].replace("\0", "?"), f"{scheme}://bucket/folder"
        raise UsageError(what or "an address names no bucket", where=where, expected=expected)
    return f"{scheme}://" + "/".join(part for part in (head, *parts) if part)


@functools.cache
def _file_system(scheme: str, process: int) -> Any:
    """The file system of a scheme: one for each process, for a connection does not survive a fork."""
    package, extra = PACKAGES[scheme]
    options: dict[str, Any] = {} if scheme == "memory" else {"use_listings_cache": False, "skip_instance_cache": True}
    if package == "s3fs":
        limits = {"connect_timeout": 10, "read_timeout": 60, "retries": {"total_max_attempts": 6, "mode": "standard"}}
        options |= {"max_concurrency": 1, "config_kwargs": limits}
    try:
        import fsspec

        found = fsspec.filesystem(scheme, **options)
    except ImportError as error:
        what, got = f"a package for {scheme}:// is missing", str(error).split("\n")[0]
        raise ResourceError(what, expected=package, got=got, remedy=f"pip install 'mudg[{extra}]'") from error
    if package == "s3fs":
        found.retries = 2  # of what botocore has repeated already
    return found


# failures in words --------------------------------------------------------------------------------

_AGAIN: Final = "then repeat the command to resume"
_WORDS: Final[Mapping[str, tuple[str, str]]] = {
    "connection": ("cannot be reached", f"check the network and the server's address (S3: AWS_ENDPOINT_URL), {_AGAIN}"),
    "busy": ("does not answer as it should", "repeat the command later to resume"),
    "refused": ("refused access", "check which account the environment names and what it may do there"),
    "request": ("cannot do what was asked", "check the address: the bucket's name, its region, the server's kind"),
    "credentials": (
        "no credentials for a storage server",
        "set them in the environment (S3: AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE)",
    ),
    "certificate": ("a storage server's certificate is not trusted", "check the address, or set AWS_CA_BUNDLE"),
}
_CREDENTIALS: Final = re.compile(r"Credential|TokenRetrieval|UnauthorizedSSO|ProfileNotFound|ClientAuthentication")
_CONNECTION: Final = re.compile(r"Connect|Timeout|ClientPayload|ClientOSError|HTTPClientError|IncompleteRead|ServiceRe")


def kind_of(error: BaseException) -> str:
    """A key of the table of words above; empty for an error that does not speak of a store."""
    chain, status = [error], 0
    while (cause := chain[-1].__cause__ or chain[-1].__context__) is not None:
        chain.append(cause)
    for one in chain:
        answer = getattr(one, "response", None)
        codes = [answer.get("ResponseMetadata", {}).get("HTTPStatusCode")] if isinstance(answer, Mapping) else []
        codes += [getattr(one, name, None) for name in ("status", "status_code", "code")]
        status = status or next((code for code in codes if isinstance(code, int) and 400 <= code < 600), 0)
    if any(isinstance(one, ssl.SSLCertVerificationError) for one in chain):
        return "certificate"
    if any(_CREDENTIALS.search(type(one).__name__) for one in chain):
        return "credentials"
    if status in (401, 403) or isinstance(error, PermissionError):
        return "refused"
    if status:
        return "busy" if status in (408, 409, 425, 429) or status >= 500 else "request"
    if any(isinstance(one, ConnectionError | TimeoutError) or _CONNECTION.search(type(one).__name__) for one in chain):
        return "connection"
    return ""


def without_secrets(text: str) -> str:
    """A message without the values of the environment's secrets."""
    for name, value in os.environ.items():
        if len(value) >= 6 and re.search(r"SECRET|TOKEN|PASSWORD|ACCESS_KEY|ACCOUNT_KEY|CONNECTION_STRING|SAS", name):
            text = text.replace(value, "***")
    return re.sub(r"//[^/\s@]+:[^/\s@]+@", "//***@", text)


@contextlib.contextmanager
def _in_words(doing: str, where: str, missing: str = "") -> Iterator[None]:
    """Failures of a store's package as ResourceError. missing: what is wrong where nothing is there."""
    try:
        yield
    except FileNotFoundError as error:
        if missing:
            raise InputError(missing, where=where, got=without_secrets(str(error))[:200]) from error
        raise
    except (FileExistsError, IsADirectoryError):
        raise
    except Exception as error:
        kind = kind_of(error)
        if not kind:
            raise
        what, remedy = _WORDS[kind]
        what = what if "storage server" in what else f"a storage server {what}"
        text = without_secrets(" ".join(str(error).split()))[:300] or type(error).__name__
        raise ResourceError(what, where=where, got=f"{doing}: {text}", remedy=remedy) from error


_NO_BUCKET: Final = "there is no such bucket, or it is not reachable for this account"

# records of uploads -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Expected:
    """What a file should be. sha256: empty if not known."""

    size: int
    sha256: str = ""

    def is_at(self, path: Path) -> bool:
        """Whether a file is known to be this one."""
        known = bool(self.sha256) and path.is_file() and path.stat().st_size == self.size
        return known and store.sha256_file(path) == self.sha256


@dataclass(frozen=True)
class Upload:
    """What ``_contents.json`` says. files: of one under way: those that are there, or may be."""

    complete: bool
    files: Mapping[str, Expected] = field(default_factory=dict)

    def content(self) -> bytes:
        """The record as it is stored."""
        files = {name: {"bytes": one.size, "sha256": one.sha256} for name, one in sorted(self.files.items())}
        record = {"schema": 1, "state": "complete" if self.complete else "uploading", "files": files}
        return store.json_text(record, indent=None).encode()


def _plain(name: str, where: str) -> str:
    """A name that stays below its folder, or IntegrityError: what lies in a store may be anybody's."""
    parts, foreign = PurePosixPath(name).parts, ("\\", "\0", *(":" if os.name == "nt" else ""))
    if not parts or name.startswith("/") or ".." in parts or any(one in name for one in foreign):
        raise IntegrityError("a name leads out of its folder", where=where, got=repr(name)[:200])
    return name


# locations ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Location:
    """A file or folder in an object store; or a path on this machine, which can be read here and has no other calls.
    ResourceError, everywhere: the store or the disk fails."""

    text: str
    """The path, or the address in its one spelling. It never holds credentials."""

    @classmethod
    def of(cls, given: str | Path | Location) -> Location:
        """A location from what a user gave. UsageError: an address of an unknown kind, or with credentials in it."""
        if isinstance(given, Location):
            return given
        text = given.as_posix() if isinstance(given, Path) else str(given)
        if isinstance(given, Path) and _FLATTENED.match(text):  # what Path makes of s3://bucket
            text = text.replace(":/", "://", 1)
        if not text:
            raise UsageError("no path or address was given")
        return cls(checked_address(text) if scheme_of(text) else os.path.normpath(text))

    def __truediv__(self, name: str) -> Location:
        """What lies below, by a relative name."""
        if not name or any(part in ("", ".", "..") for part in name.split("/")) or "\0" in name:
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
    def _files(self) -> Any:
        if self.local is not None:
            raise UsageError("an address in an object store is needed", where=self.text)
        return _file_system(scheme_of(self.text), os.getpid())

    @property
    def _path(self) -> str:
        return self.text.partition("://")[2]

    # single files ---------------------------------------------------------------------------------

    def _facts(self) -> tuple[str, int]:
        """``file`` and its size in bytes, or ``directory``; an empty text where nothing is."""
        with contextlib.suppress(FileNotFoundError), _in_words("looking it up", self.text):
            facts = self._files.info(self._path)
            return str(facts["type"]), int(facts.get("size") or 0)
        return "", 0

    def exists(self) -> bool:
        """Whether a file, or a folder with something in it, is there."""
        return self._facts()[0] != ""

    def load(self) -> bytes:
        """The content of a file. InputError: none is there."""
        if self.local is not None:
            return store.read_bytes(self.local)
        missing = "nothing is at this address; check it, and whether its upload was finished"
        try:
            with _in_words("reading", self.text, missing):
                return bytes(self._files.cat_file(self._path))
        except IsADirectoryError as error:
            raise InputError("a folder is where a file should be", where=self.text) from error

    def save(self, data: bytes) -> None:
        """Write a file completely or not at all."""
        with _in_words("writing", self.text, _NO_BUCKET):
            self._files.pipe_file(self._path, data)

    def remove(self) -> None:
        """Remove a file, or a folder with all below it, its manifest first. Nothing there is no error."""
        if self._facts()[0] == "directory":
            if "/" not in self._path.strip("/"):
                raise UsageError("a whole bucket is not removed", where=self.text)
            (self / store.MANIFEST).remove()
        with contextlib.suppress(FileNotFoundError), _in_words("removing", self.text):
            self._files.rm(self._path, recursive=True)

    def names(self) -> list[str]:
        """Names of what lies right below, sorted; empty where nothing is."""
        if self.local is not None:
            return sorted(os.listdir(self.local)) if self.local.is_dir() else []
        with contextlib.suppress(FileNotFoundError), _in_words("listing", self.text):
            paths = (str(path).strip("/") for path in self._files.ls(self._path, detail=False))
            return sorted(path.rpartition("/")[2] for path in paths if path != self._path)
        return []

    def tree(self) -> dict[str, int]:
        """Sizes of all files below in bytes, by relative name."""
        with contextlib.suppress(FileNotFoundError), _in_words("listing", self.text):
            found = {str(path).strip("/"): facts for path, facts in self._files.find(self._path, detail=True).items()}
            head = f"{self._path}/"
            below = {path[len(head) :]: facts for path, facts in sorted(found.items()) if path.startswith(head)}
            return {name: int(one.get("size") or 0) for name, one in below.items() if name not in ("", CONTENTS)}
        return {}

    # folders --------------------------------------------------------------------------------------

    def uploaded(self) -> Upload | None:
        """The record of an upload to this folder; None where there is none. IntegrityError: it is damaged."""
        record = self / CONTENTS
        if not record.exists():
            return None
        try:
            values = store.parse_json(record.load(), str(record))
            entries = values["files"].items()
            files = {str(name): Expected(int(one["bytes"]), str(one["sha256"])) for name, one in entries}
            complete = values["state"] == "complete"
        except (InputError, KeyError, TypeError, AttributeError, ValueError) as error:
            what, remedy = "the record of an upload is damaged", "upload the folder again, to another address"
            raise IntegrityError(what, where=str(record), got=str(error).split("\n")[0], remedy=remedy) from error
        return Upload(complete, {_plain(name, str(record)): one for name, one in files.items()})

    def fetch(self, to: Path, *, mirror: bool = False) -> None:
        """Stage a file or folder in. Files that an earlier, interrupted fetch brought are used again. mirror: remove
        files below ``to`` that are not part of the folder. InputError: nothing is there, or its upload was not
        finished. IntegrityError: what came is not what was uploaded."""
        to, (kind, bytes_there) = Path(to), self._facts()
        if not kind:
            remedy = "check it, and whether its upload was finished"
            raise InputError("nothing is at this address", where=self.text, remedy=remedy)
        wanted = self._wanted() if kind == "directory" else {"": Expected(bytes_there)}
        missing = [name for name, one in wanted.items() if not one.is_at(to / name if name else to)]
        missing.sort(key=lambda name: (PurePosixPath(name).name in (store.MANIFEST, store.RUN_STATE), name))
        size = sum(wanted[name].size for name in missing)
        free = shutil.disk_usage(next(one for one in (to.absolute(), *to.absolute().parents) if one.exists())).free
        if size + _LEFT_FREE > free:
            what, got = "not enough space to fetch data", f"{memory.in_words(free)} free"
            remedy = "free disk space, or choose a folder on a larger disk (--scratch)"
            expected = f"{memory.in_words(size)} for {self}"
            raise ResourceError(what, where=str(to), expected=expected, got=got, remedy=remedy)
        store.make_folder(to if kind == "directory" else to.parent)
        with log.task(f"fetching {self}", len(missing)) as bar:
            for first in range(0, len(missing), _GROUP):
                places = {name: to / name if name else to for name in missing[first : first + _GROUP]}
                parts = {name: at.with_name(f".{at.name}.fetching.part") for name, at in places.items()}
                for part in parts.values():
                    store.make_folder(part.parent)
                sources = [f"{self._path}/{name}" if name else self._path for name in parts]
                with _in_words("fetching", self.text, "a file was removed while it was fetched"):
                    self._files.get(sources, [str(part) for part in parts.values()], batch_size=_FILES_AT_ONCE)
                for name, part in parts.items():
                    size, sha256 = part.stat().st_size, store.sha256_file(part) if wanted[name].sha256 else ""
                    if wanted[name] != Expected(size, sha256):
                        store.remove(part)
                        what, where = "what came is not what was uploaded", f"{self}/{name}" if name else self.text
                        expected = f"{wanted[name].size} bytes, sha256 {wanted[name].sha256[:16]}..."
                        got = f"{size} bytes, sha256 {sha256[:16]}..."
                        remedy = "repeat the command; if it fails again, upload the data again"
                        raise IntegrityError(what, where=where, expected=expected, got=got, remedy=remedy)
                    store.take_place(part, places[name])
                    bar.advance()
        if mirror and kind == "directory":
            for path in [path for path in to.rglob("*") if not path.is_dir()]:
                if path.relative_to(to).as_posix() not in wanted:
                    store.remove(path)

    def _wanted(self) -> dict[str, Expected]:
        record, sizes = self.uploaded(), self.tree()
        if record is not None:
            if not record.complete or (store.MANIFEST in record.files and store.MANIFEST not in sizes):
                remedy = "repeat the command that makes it: it resumes"
                raise InputError("an upload was not finished", where=self.text, remedy=remedy)
            absent = sorted(set(record.files) - set(sizes))
            if absent:
                raise IntegrityError("a file is missing", where=f"{self}/{absent[0]}")
            return dict(record.files)
        wanted = {_plain(name, self.text): Expected(size) for name, size in sizes.items()}
        for manifest in [name for name in wanted if PurePosixPath(name).name == store.MANIFEST]:
            record_there = store.parse_json((self / manifest).load(), f"{self}/{manifest}")
            files = record_there.get("files") if isinstance(record_there, dict) else None
            for name, entry in (files if isinstance(files, dict) else {}).items():
                full = str(PurePosixPath(manifest).parent / str(name))
                if isinstance(entry, dict) and "sha256" in entry:
                    if full not in sizes:
                        raise IntegrityError("a file is missing", where=f"{self}/{full}")
                    wanted[full] = Expected(sizes[full], str(entry["sha256"]))
        return wanted

    def push(self, frm: Path) -> None:
        """Upload a folder: all files, several at a time, the manifest last; until it is there, what is at this place is
        no result. Files that are there are not sent again; those of an earlier push that are gone are removed; others'
        stay. InputError: no folder. UsageError: files of others have the same names. IntegrityError: a file did not
        arrive."""
        frm = Path(frm)
        if not frm.is_dir():
            raise InputError("no folder to upload", where=str(frm))
        names = (one for one in store.all_names(frm) if ".part" not in one and (frm / one).is_file())
        paths = {one: frm / one for one in names if PurePosixPath(one).name not in ("lock", CONTENTS)}
        files = {name: Expected(path.stat().st_size, store.sha256_file(path)) for name, path in paths.items()}
        sizes, earlier = self.tree(), self.uploaded()
        before = earlier.files if earlier is not None else {}
        there = {name for name, one in files.items() if before.get(name) == one and sizes.get(name) == one.size}
        if earlier is not None and earlier.complete and there == set(before) == set(files):
            return
        foreign = sorted(set(files) & set(sizes)) if earlier is None else []
        if foreign:
            what, got = "the output address holds files of something else", ", ".join(foreign[:8])
            raise UsageError(what, where=self.text, got=got, remedy="choose an address at which nothing is")
        manifest = {store.MANIFEST} & set(files)
        (self / store.MANIFEST).remove()  # from now on it is no result
        record = self / CONTENTS
        if earlier is not None:
            record.save(Upload(False, before).content())
        # after this, a file of the right size is one of those that are now sent
        for name in sorted(set(before) - there):
            (self / name).remove()
        record.save(Upload(False, files).content())
        with log.task(f"uploading {self}", len(files)) as bar:
            sent = sorted(set(files) - there - manifest)
            for names in (sent[first : first + _GROUP] for first in range(0, len(sent), _GROUP)):
                # S3 takes 10,000 parts of a file
                part = {"chunksize": max(_CHUNK, *(files[name].size // 9000 for name in names))}
                options = part if PACKAGES[scheme_of(self.text)][0] == "s3fs" else {}
                sources, targets = zip(*((str(frm / name), f"{self._path}/{name}") for name in names))
                with _in_words("uploading", self.text, _NO_BUCKET):
                    self._files.put(list(sources), list(targets), batch_size=_FILES_AT_ONCE, **options)
                bar.advance(len(names))
        sizes = self.tree()
        for name in sorted(set(files) - manifest):
            if sizes.get(name) != files[name].size:
                what, where = "a file did not arrive as it was sent", f"{self}/{name}"
                got, remedy = f"{sizes.get(name, 'no')} bytes", "repeat the command to upload it again"
                raise IntegrityError(what, where=where, expected=f"{files[name].size} bytes", got=got, remedy=remedy)
        record.save(Upload(True, files).content())
        if manifest:
            (self / store.MANIFEST).save(store.read_bytes(frm / store.MANIFEST))

    def put_file(self, file: Path) -> None:
        """Upload one file to this place."""
        with _in_words("uploading", self.text, _NO_BUCKET):
            self._files.put_file(str(file), self._path)
