"""Object stores behind fsspec: S3, Google Cloud, Azure, and one in memory for tests.

Every request is repeated where the failure may pass (no connection, a busy server) and told in words where it does not. Credentials
come from the environment, where the store's own package looks for them; an address that holds some is refused and never shown.
"""

from __future__ import annotations

import base64
import contextlib
import errno
import functools
import hashlib
import os
import re
import ssl
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from mudg.base import log
from mudg.base.errors import InputError, MudgError, ResourceError, UsageError

Result = TypeVar("Result")

PACKAGES: Final[Mapping[str, tuple[str, str]]] = {
    "s3": ("s3fs", "s3"), "s3a": ("s3fs", "s3"), "gs": ("gcsfs", "gs"), "gcs": ("gcsfs", "gs"), "abfs": ("adlfs", "abfs"),
    "abfss": ("adlfs", "abfs"), "az": ("adlfs", "abfs"), "memory": ("fsspec", "s3"),
}  # fmt: skip
"""Scheme of an address -> the package that reads it, and the extra of this program that installs it."""
TRIES: Final = 6
FIRST_WAIT_S, LONGEST_WAIT_S = 0.2, 8.0
PIECE: Final = 8 << 20
"""Bytes of one request; what a transfer holds in memory for each file that is under way."""
_PARTS: Final = 9000
"""An object may be put together of 10,000 parts."""
PROBE: Final = ".mudg-probe-"
"""What the names of objects begin with that try out a store."""
_WITH_ACCOUNT: Final = frozenset({"abfs", "abfss", "az"})
"""Schemes in which a name before ``@`` is the container."""


# addresses ------------------------------------------------------------------------------------------------------------


def scheme_of(text: str) -> str:
    """``s3`` of ``s3://bucket/x``; empty for a path on this machine."""
    found = re.match(r"([A-Za-z][A-Za-z0-9+.\-]+)://", text)
    return found[1].lower() if found else ""


def checked_address(text: str) -> str:
    """An address in its one spelling: no slash at the end, none doubled.

    Raises:
        UsageError: an unknown scheme, no bucket, credentials or a query in it (which are not shown), or ``..``.
    """
    scheme = scheme_of(text)
    rest = text[len(scheme) + 3 :]
    if scheme not in PACKAGES:
        raise UsageError("no storage of this kind is known", where=f"{scheme}://", expected=f"a path, or one of {_listed()}")
    head, _, tail = rest.partition("/")
    at = "@" in head
    if (at and scheme not in _WITH_ACCOUNT) or ":" in head:  # a password may hold a slash
        raise UsageError("an address holds a user or a password", where=f"{scheme}://...", remedy="leave them out and set "
            "the environment instead, e.g. AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY")  # fmt: skip
    if "?" in rest:
        raise UsageError("an address holds a query, which may be a secret", where=f"{scheme}://{head.partition('?')[0]}/...",
            expected=f"{scheme}://bucket/folder", remedy="leave the part from ? on out")  # fmt: skip
    parts = [part for part in tail.split("/") if part]
    if ".." in parts or "." in parts or "\0" in rest or "::" in head:
        raise UsageError("an address is not plain", where=text[:200].replace("\0", "?"), expected=f"{scheme}://bucket/folder")
    if not head and scheme != "memory":
        raise UsageError("an address names no bucket", where=text[:200], expected=f"{scheme}://bucket/folder")
    return f"{scheme}://" + "/".join(part for part in (head, *parts) if part)


def _listed() -> str:
    return ", ".join(f"{scheme}://" for scheme in PACKAGES)


@functools.cache
def _opened(scheme: str, process: int) -> Any:
    """The file system of a scheme: one for each process, for a connection does not survive a fork."""
    package, extra = PACKAGES[scheme]
    try:
        import fsspec

        options: dict[str, Any] = {"use_listings_cache": False, "skip_instance_cache": True}
        if package == "s3fs":
            quick = {"retries": {"total_max_attempts": 1}, "connect_timeout": 10, "read_timeout": 60}  # what is repeated is counted here
            options |= {"max_concurrency": 1, "config_kwargs": quick}
        found = fsspec.filesystem(scheme, **({} if scheme == "memory" else options))
    except ImportError as error:
        raise ResourceError(f"a package for {scheme}:// is missing", expected=package, got=str(error).split("\n")[0],
            remedy=f"pip install 'mudg[{extra}]'") from error  # fmt: skip
    if package == "s3fs":
        found.retries = 1
    return found


# failures in words ----------------------------------------------------------------------------------------------------


def _status(error: BaseException) -> int:
    """The HTTP status behind an error; 0 where it has none."""
    at: BaseException | None = error
    while at is not None:
        answer = getattr(at, "response", None)
        if isinstance(answer, Mapping):
            return int(answer.get("ResponseMetadata", {}).get("HTTPStatusCode", 0))
        for name in ("status", "status_code", "code"):
            value = getattr(at, name, None)
            if isinstance(value, int) and 400 <= value < 600:
                return value
        at = at.__cause__ or at.__context__
    return 0


_CREDENTIALS: Final = re.compile(r"Credential|TokenRetrieval|UnauthorizedSSO|ProfileNotFound|ClientAuthentication")
_CONNECTION: Final = re.compile(
    r"Connection|Timeout|Disconnect|ClientPayload|ClientOSError|HTTPClientError|IncompleteRead|ResponseParser|ServiceRequest|ServiceResponse"
)
_BUSY: Final = frozenset({408, 409, 425, 429})
_PASSING: Final = frozenset(
    {errno.EBUSY, errno.EAGAIN, errno.ECONNRESET, errno.ECONNREFUSED, errno.ECONNABORTED, errno.ETIMEDOUT, errno.EPIPE,
     errno.ENETUNREACH, errno.EHOSTUNREACH}
)  # fmt: skip


def kind_of(error: BaseException) -> str:
    """``connection`` or ``busy`` (may pass), ``refused``, ``credentials``, ``certificate``, ``request``; empty for something else."""
    status, name = _status(error), type(error).__name__
    if any(isinstance(one, ssl.SSLCertVerificationError) for one in _line(error)):
        return "certificate"
    if any(_CREDENTIALS.search(type(one).__name__) for one in _line(error)):
        return "credentials"
    if isinstance(error, PermissionError) or status in (401, 403):
        return "refused"
    if status in _BUSY or (status >= 500 and status != 501):
        return "busy"
    if status:
        return "request"
    if isinstance(error, ConnectionError | TimeoutError) or _CONNECTION.search(name):
        return "connection"
    if isinstance(error, OSError) and error.errno in _PASSING:
        return "connection"
    return ""


def _line(error: BaseException) -> Iterator[BaseException]:
    at: BaseException | None = error
    while at is not None:
        yield at
        at = at.__cause__ or at.__context__


_WORDS: Final[Mapping[str, tuple[str, str]]] = {
    "connection": ("a storage server cannot be reached",
        "check the network and the server's address (S3: AWS_ENDPOINT_URL), then repeat the command to resume"),
    "busy": ("a storage server does not answer as it should", "repeat the command later to resume"),
    "refused": ("a storage server refused access", "check which account the environment names and what it may do there"),
    "credentials": ("no credentials for a storage server",
        "set them in the environment (S3: AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_PROFILE)"),
    "certificate": ("a storage server's certificate is not trusted", "check the address, or set AWS_CA_BUNDLE"),
    "request": ("a storage server cannot do what was asked", "check the address: the bucket's name, its region, the server's kind"),
}  # fmt: skip


def without_secrets(text: str) -> str:
    """A message without the values of the environment's secrets."""
    for name, value in os.environ.items():
        if len(value) >= 6 and re.search(r"SECRET|TOKEN|PASSWORD|ACCESS_KEY|ACCOUNT_KEY|CONNECTION_STRING|SAS", name):
            text = text.replace(value, "***")
    return re.sub(r"//[^/\s@]+:[^/\s@]+@", "//***@", text)


def _told(error: BaseException, kind: str, doing: str, where: str, tries: int) -> MudgError:
    what, remedy = _WORDS[kind]
    often = f"tried {tries} times; " if tries > 1 else ""
    said = without_secrets(" ".join(str(error).split()))[:300] or type(error).__name__
    return ResourceError(what, where=where, got=f"{often}{doing}: {said}", remedy=remedy)


def repeated(call: Callable[[], Result], doing: str, where: str) -> Result:
    """The result of a call, repeated with growing pauses while it fails in ways that may pass.

    Raises:
        ResourceError: it failed too often, or in a way that does not pass. FileNotFoundError, FileExistsError: as the store says.
    """
    tries = 0
    while True:
        tries += 1
        try:
            return call()
        except (FileNotFoundError, FileExistsError, IsADirectoryError, MudgError):
            raise
        except Exception as error:
            kind = kind_of(error)
            if not kind:
                raise
            if kind not in ("connection", "busy") or tries >= TRIES:
                raise _told(error, kind, doing, where, tries) from error
            if tries == 2:
                log.info_once(f"{'/'.join(where.split('/')[:3])}: {_WORDS[kind][0]}; {doing} is tried again")
        time.sleep(_pause_s(tries))


def _pause_s(tries: int) -> float:
    """Twice as long each time, and not the same for all processes: they would come back together."""
    share = hashlib.sha256(f"{os.getpid()} {threading.get_ident()} {tries} {time.monotonic_ns()}".encode()).digest()[0] / 255
    return min(LONGEST_WAIT_S, FIRST_WAIT_S * 2 ** (tries - 1)) * (0.5 + 0.5 * share)


# a store --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Found:
    """A file in a store. tag: its md5, or that of its parts as S3 writes it (``...-3``), where the listing has it; else empty."""

    size: int
    tag: str = ""


def part_bytes(size: int) -> int:
    """Bytes of each part in which an object of ``size`` bytes is uploaded; all in one below twice that."""
    return max(PIECE, -(-size // _PARTS))


_exclusive: dict[tuple[str, str], bool] = {}
_probing = threading.Lock()


@dataclass(frozen=True)
class RemoteStore:
    """What is asked of an object store; paths are ``bucket/folder/name``."""

    scheme: str

    @property
    def files(self) -> Any:
        """The file system of fsspec."""
        return _opened(self.scheme, os.getpid())

    def where(self, path: str) -> str:
        """The address, for messages."""
        return f"{self.scheme}://{path}"

    def _ask(self, doing: str, path: str, call: Callable[..., Result], *args: Any, **options: Any) -> Result:
        return repeated(lambda: call(*args, **options), doing, self.where(path))

    def exists(self, path: str) -> bool:
        """Whether an object or a folder of objects is there."""
        try:
            self._ask("looking it up", path, self.files.info, path)
        except FileNotFoundError:
            return False
        return True

    def is_folder(self, path: str) -> bool:
        """Whether objects lie below this name, and none at it."""
        try:
            return self._ask("looking it up", path, self.files.info, path)["type"] == "directory"
        except FileNotFoundError:
            return False

    def size(self, path: str) -> int:
        """Bytes of an object."""
        return int(self._ask("looking it up", path, self.files.info, path)["size"] or 0)

    def load(self, path: str) -> bytes:
        """The content of an object."""
        return bytes(self._ask("reading", path, self.files.cat_file, path))

    def piece(self, path: str, begin: int, end: int) -> bytes:
        """Bytes ``begin`` to ``end`` (exclusive) of an object."""
        return bytes(self._ask("reading", path, self.files.cat_file, path, start=begin, end=end))

    def save(self, path: str, data: bytes) -> None:
        """Put an object, over one that is there."""
        self._put(path, self.files.pipe_file, path, data)

    def create(self, path: str, data: bytes) -> bool:
        """Put an object where none is; False if one is there. Two that do so at once: one succeeds, if ``exclusive`` holds."""
        if not self.exclusive(path):
            if self.exists(path):
                return False
            self.save(path, data)
            return True
        return self._created(path, data)

    def _created(self, path: str, data: bytes) -> bool:
        token = hashlib.sha256(os.urandom(16)).hexdigest()[:16]
        options: dict[str, Any] = {"Metadata": {"mudg-writer": token}} if self._keeps_notes else {}
        lock = _probing if self.scheme == "memory" else contextlib.nullcontext()  # fsspec's own looks first and writes then
        try:
            with lock:
                self._ask("writing", path, self.files.pipe_file, path, data, mode="create", **options)
        except FileExistsError:  # after a lost answer, whoever repeated the request, it is this one that is there
            return self.note(path, "mudg-writer") == token
        except FileNotFoundError as error:
            raise _no_bucket(self.where(path), error) from error
        return True

    @property
    def _keeps_notes(self) -> bool:
        return PACKAGES[self.scheme][0] == "s3fs"

    def note(self, path: str, name: str) -> str:
        """A text kept with an object; empty where the store keeps none."""
        if not self._keeps_notes:
            return ""
        try:
            found = self._ask("looking it up", path, self.files.metadata, path)
        except FileNotFoundError:
            return ""
        return str(found.get(name) or found.get(name.replace("-", "_")) or "")

    def exclusive(self, path: str) -> bool:
        """Whether this store refuses to create what exists. It is tried out once for each bucket, beside ``path``."""
        bucket = path.partition("/")[0]
        if (self.scheme, bucket) not in _exclusive:
            with _probing:
                if (self.scheme, bucket) not in _exclusive:
                    _exclusive[self.scheme, bucket] = self._probe(path)
        return _exclusive[self.scheme, bucket]

    def _probe(self, path: str) -> bool:
        probe = f"{path.rpartition('/')[0]}/{PROBE}{hashlib.sha256(os.urandom(16)).hexdigest()[:16]}"
        held = False
        try:
            for _ in range(2):
                self._ask("trying out conditional writes", probe, self.files.pipe_file, probe, b"probe", mode="create")
        except FileExistsError:
            held = True
        except FileNotFoundError as error:
            raise _no_bucket(self.where(path), error) from error
        except (TypeError, ValueError, NotImplementedError):
            held = False  # its package knows no conditional writes
        finally:
            with contextlib.suppress(FileNotFoundError):
                self._ask("removing", probe, self.files.rm_file, probe)
        if not held:
            log.warn(f"{self.scheme}://{path.partition('/')[0]} has no conditional writes: of two processes that create "
                "the same name at once, both may succeed. Work can be done twice; results stay right.")  # fmt: skip
        return held

    def remove(self, path: str) -> None:
        """Remove an object; none there is no error."""
        with contextlib.suppress(FileNotFoundError):
            self._ask("removing", path, self.files.rm_file, path)
        if self.scheme == "memory":
            self._prune(path)

    def _prune(self, path: str) -> None:
        """An emptied folder is none, as in real stores; fsspec's memory keeps it."""
        at, folders = f"/{path}".rpartition("/")[0], self.files.pseudo_dirs
        while at in folders and not self.files.ls(at):
            folders.remove(at)
            at = at.rpartition("/")[0]

    def remove_tree(self, path: str) -> None:
        """Remove every object below."""
        for name in self.tree(path):
            self.remove(f"{path}/{name}")

    def names(self, path: str) -> list[str]:
        """Names right below."""
        try:
            found = self._ask("listing", path, self.files.ls, path, detail=False)
        except FileNotFoundError:
            return []
        head = path.strip("/") + "/" if path.strip("/") else ""
        below = (str(name).strip("/") for name in found)
        return sorted({name[len(head) :] for name in below if name.startswith(head) and len(name) > len(head)} - {""})

    def tree(self, path: str) -> dict[str, Found]:
        """Every object below, by its name relative to ``path``."""
        try:
            found = self._ask("listing", path, self.files.find, path, detail=True)
        except FileNotFoundError:
            return {}
        head = path.strip("/") + "/"
        below = {str(name).strip("/"): facts for name, facts in found.items()}
        return {
            name[len(head) :]: Found(int(facts.get("size") or 0), _tag_of(facts))
            for name, facts in sorted(below.items())
            if name.startswith(head) and len(name) > len(head)
        }

    def put(self, path: str, file: Path, sha256: str) -> None:
        """Upload a file, in parts where it is large. ResourceError if that fails."""
        options: dict[str, Any] = {}
        if self._keeps_notes:
            options = {"Metadata": {"sha256": sha256}, "chunksize": part_bytes(file.stat().st_size)}
        self._put(path, self.files.put_file, str(file), path, **options)

    def _put(self, path: str, call: Callable[..., Any], *args: Any, **options: Any) -> None:
        try:
            self._ask("writing", path, call, *args, **options)
        except FileNotFoundError as error:
            raise _no_bucket(self.where(path), error) from error

    def settle(self, path: str) -> None:
        """Wait until what was written is kept. A store answers only then."""


def _tag_of(facts: Mapping[str, Any]) -> str:
    if isinstance(facts.get("md5Hash"), str):  # Google Cloud
        return base64.b64decode(facts["md5Hash"]).hex()
    tag = str(facts.get("ETag") or "").strip('"')
    return tag if re.fullmatch(r"[0-9a-f]{32}(-\d+)?", tag) else ""


def _no_bucket(where: str, error: BaseException) -> InputError:
    return InputError("there is no such bucket, or it is not reachable for this account", where=where,
        got=without_secrets(str(error))[:200], remedy="make the bucket first; no bucket is made here")  # fmt: skip
