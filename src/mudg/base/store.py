"""Everything that writes to disk goes through here: temporary name, fsync, rename; sha256 when read back.

A reader sees an old complete file or a new complete file. The output folder of a verb is ``base/run_folder.py``.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import shutil
import stat
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError, IntegrityError, MudgError, ResourceError, similar_path

if TYPE_CHECKING:
    from PIL import Image
    from torch import Tensor

MANIFEST = "manifest.json"
RUN_STATE, RUN_LOG, RUN_SCHEMA = "run.json", "log.jsonl", 2
"""Record and log of the run that made a folder, and the record's schema."""
_MAX_JSON_BYTES = 512 * 1024 * 1024

# single files -------------------------------------------------------------------------------------


def fsync_directory(path: Path) -> None:
    """Wait until the names in a folder are on the disk, where the file system can do that."""
    with contextlib.suppress(OSError):  # some file systems refuse to sync a directory; the rename is still atomic
        fd = os.open(path, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


@contextlib.contextmanager
def disk_errors(
    what: str, where: Path, remedy: str = "choose another --out", kind: type[MudgError] = ResourceError
) -> Iterator[None]:
    """Turn an OSError of this block into an error that says what could not be done, where, and what to do."""
    try:
        yield
    except OSError as error:
        raise kind(what, where=str(where), got=str(error), remedy=remedy) from error


def _writing(path: Path) -> contextlib.AbstractContextManager[None]:
    return disk_errors("writing failed", path, "free disk space or choose another --out")


def _reading(path: Path) -> contextlib.AbstractContextManager[None]:
    return disk_errors("file cannot be read", path, "", InputError)


_umask_lock = threading.Lock()


@contextlib.contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """A new file beside ``path`` (same suffix). It goes at the end, unless it has got another name."""
    fd, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=f".part{path.suffix}", dir=path.parent)
    os.close(fd)
    try:
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)


def _complete(temporary: Path) -> None:
    """Wait until a temporary file is on the disk; it gets the rights of any new file."""
    with temporary.open("rb+") as handle:
        os.fsync(handle.fileno())
    with _umask_lock:  # reading the mask means setting it, which two threads must not do at once
        os.umask(mask := os.umask(0))
    temporary.chmod(0o666 & ~mask)


@contextlib.contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` (same suffix) for writers that want a file name; on success it is fsynced
    and renamed to ``path``. ResourceError: the folder cannot be written, or the disk is full."""
    path = Path(path)
    make_folder(path.parent)
    with disk_errors("cannot write here", path):
        if path.exists() and not path.is_file():  # a device would be replaced by a file
            got, remedy = "not a regular file", "choose another --out"
            raise ResourceError("cannot write here", where=str(path), got=got, remedy=remedy)
        with _temporary(path) as temporary, _writing(path):
            yield temporary
            _complete(temporary)
            temporary.replace(path)
            fsync_directory(path.parent)


def atomic_write(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path`` completely or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_blocks(path: Path, blocks: Iterable[bytes]) -> None:
    """Write a file block by block, completely or not at all, for what does not fit into memory."""
    with atomic_path(path) as temporary, temporary.open("wb") as handle:
        for block in blocks:
            handle.write(block)


def write_image(path: Path, picture: NDArray[np.uint8] | Image.Image, **options: Any) -> None:
    """Write a picture, u8[H, W, 3] or Pillow's, completely or not at all; the suffix names the format."""
    from PIL import Image

    with atomic_path(path) as temporary:
        (Image.fromarray(picture) if isinstance(picture, np.ndarray) else picture).save(temporary, **options)


def write_in_tree(path: Path, content: bytes) -> None:
    """Write a file of a tree under a temporary name; one ``sync_tree`` for all follows before the tree is renamed."""
    make_folder(path.parent)
    with _writing(path):
        Path(path).write_bytes(content)


def sync_tree(folder: Path) -> None:
    """Wait until every file below ``folder`` is on the disk: one flush of everything where the system offers that,
    which is 30 times faster for many small files, else file by file."""
    if hasattr(os, "sync"):
        os.sync()
        return
    with _writing(folder):
        for path in Path(folder).rglob("*"):
            if path.is_file():
                with path.open("rb+") as handle:
                    os.fsync(handle.fileno())


def create_once(path: Path, content: bytes) -> bool:
    """Write a file that does not exist yet, completely; False if it does. Of several that try, one succeeds."""
    path = Path(path)
    make_folder(path.parent)
    with disk_errors("cannot write here", path):
        if os.path.lexists(path):
            return False
        with _temporary(path) as temporary:
            temporary.write_bytes(content)
            _complete(temporary)
            try:
                os.link(temporary, path)
            except FileExistsError:
                return temporary.stat().st_nlink == 2  # a network drive can lose the answer to a link that it made
            except OSError:  # no links here: the name is taken first and filled then
                try:
                    with path.open("xb") as handle:
                        handle.write(content)
                except FileExistsError:
                    return False
        fsync_directory(path.parent)
        return True


def make_folder(path: Path) -> None:
    """Make a folder and those above it. ResourceError if that is refused."""
    with disk_errors("cannot create a folder", path):
        Path(path).mkdir(parents=True, exist_ok=True)


def take_place(temporary: Path, path: Path) -> None:
    """Give a file that is complete its name."""
    with _writing(path):
        temporary.replace(path)
        fsync_directory(path.parent)


def remove(path: Path) -> None:
    """Remove a file; none there is no error."""
    with disk_errors("cannot remove a file", path, "check who may write there"):
        Path(path).unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text to ``path`` completely or not at all."""
    atomic_write(path, text.encode())


def _strict(value: Any, where: str) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError("JSON cannot hold NaN or infinity", where=where, got=str(value))
    if isinstance(value, Mapping):
        return {str(k): _strict(v, f"{where}.{k}") for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(v, f"{where}[{i}]") for i, v in enumerate(value)]
    if isinstance(value, np.ndarray):
        return _strict(value.tolist(), where)
    if isinstance(value, np.generic):
        return _strict(value.item(), where)
    if isinstance(value, Path):
        return value.as_posix()
    return value


def json_text(value: Any, indent: int | None = 1) -> str:
    """Strict JSON: no NaN or infinity; numpy scalars and arrays and paths are converted."""
    return json.dumps(_strict(value, "value"), indent=indent, ensure_ascii=False, allow_nan=False)


def write_json(path: Path, value: Any) -> None:
    """Write strict JSON atomically."""
    write_text(path, json_text(value) + "\n")


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for name, value in pairs:
        if name in result:
            raise ValueError(f"the key {name!r} occurs twice")
        result[name] = value
    return result


def _finite(number: str) -> None:
    if not math.isfinite(float(number)):
        raise ValueError(f"{number[:40]} is beyond what a number can be")


_HALVES = re.compile(r"\\u[dD][89a-fA-F]|[\ud800-\udfff]")
_BEYOND = re.compile(r"[eE]\+?[0-9]{3}|[0-9]{200}")
"""What may be half a letter (a surrogate without its pair), and a number beyond floats."""


def parse_json(text: str | bytes, where: str) -> Any:
    """Parse strict JSON (no NaN, no numbers beyond floats, no duplicate keys, no halves of letters, bounded size and
    nesting); InputError names ``where``."""
    if len(text) > _MAX_JSON_BYTES:
        expected = f"<= {_MAX_JSON_BYTES} bytes"
        raise InputError("JSON file is too large", where=where, expected=expected, got=f"{len(text)}")
    try:
        if isinstance(text, bytes):
            text = text.decode(json.detect_encoding(text))
        value = json.loads(text, object_pairs_hook=_no_duplicates, parse_constant=_finite)
        if _HALVES.search(text):
            json.dumps(value, ensure_ascii=False).encode()
        if _BEYOND.search(text):
            json.loads(text, parse_int=_finite, parse_float=_finite)
        return value
    except (ValueError, RecursionError) as error:
        raise InputError("not valid JSON", where=where, got=str(error) or type(error).__name__) from error


def read_json(path: Path) -> Any:
    """Read strict JSON; a missing or malformed file is an InputError that names it."""
    return parse_json(read_bytes(path), str(path))


def json_object(path: Path) -> dict[str, Any]:
    """What a JSON file says; empty where it is missing, malformed or no object."""
    with contextlib.suppress(InputError):
        return found if isinstance(found := read_json(path), dict) else {}
    return {}


_KINDS = ((stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a named pipe"), (stat.S_ISSOCK, "a socket"))
_KINDS += ((stat.S_ISCHR, "a device"), (stat.S_ISBLK, "a device"))


def regular(path: Path) -> Path:
    """``path``, if a regular file is there: others would be waited for, or never end. For libraries that open files
    themselves. InputError: it is missing, unreadable, a folder, a named pipe, a socket or a device."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError as error:
        raise InputError("file not found", where=str(path), remedy=similar_path(path)) from error
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise InputError("file cannot be read", where=str(path), got=str(error)) from error
    if not stat.S_ISREG(mode):
        got = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
        raise InputError("not a regular file", where=str(path), got=got, expected="a file on a disk")
    return path


def open_file(path: Path) -> BufferedReader:
    """Open a regular file for reading; InputError as in ``regular``."""
    regular(path)  # a pipe or device is not even opened; the second look is for one that took its place meanwhile
    with _reading(path):
        handle = os.fdopen(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)), "rb")
    if not stat.S_ISREG(os.fstat(handle.fileno()).st_mode):
        handle.close()
        raise InputError("not a regular file", where=str(path), expected="a file on a disk")
    return handle


def read_bytes(path: Path) -> bytes:
    """Read a file; one that is missing, unreadable or no regular file is an InputError that names it."""
    with open_file(path) as handle, _reading(path):
        return handle.read()


def read_text(path: Path) -> str:
    """Read a UTF-8 text file; InputError as in ``read_bytes``, or if it is not text."""
    try:
        return read_bytes(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError("file is not text", where=str(path), got=str(error)) from error


def append_line(path: Path, text: str) -> None:
    """Append a line to a log. A crash or a full disk (ResourceError) can lose the last line, never an earlier one or
    half of one."""
    make_folder(path.parent)
    with _writing(path), Path(path).open("ab+", buffering=0) as handle:
        end = _end_of_lines(handle)
        left = memoryview((text.rstrip("\n") + "\n").encode())
        try:
            while left:
                left = left[handle.write(left) :]
        except OSError:
            handle.truncate(end)
            raise


def _end_of_lines(handle: BinaryIO) -> int:
    """Where the last whole line ends; half a line behind it, left by a crash, is cut off."""
    end = size = handle.seek(0, os.SEEK_END)
    while end:
        start = max(0, end - 4096)
        handle.seek(start)
        block = handle.read(end - start)
        end = start + block.rfind(b"\n") + 1
        if b"\n" in block:
            break
    if end < size:
        handle.truncate(end)
    return end


def sha256_file(path: Path) -> str:
    """Hex sha256 of a file's bytes."""
    with open_file(path) as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def write_safetensors(
    path: Path, tensors: Mapping[str, NDArray[Any] | Tensor], metadata: Mapping[str, str] | None = None
) -> None:
    """Write named arrays (numpy or torch, any device) as one safetensors file, atomically and without a copy in
    memory."""
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    arrays: dict[str, NDArray[Any]] = {}
    for name, value in tensors.items():
        if not isinstance(value, np.ndarray):
            value = value.detach().cpu().numpy()
        arrays[name] = np.ascontiguousarray(value)
    path = Path(path)
    with (
        atomic_path(path) as temporary,
        tempfile.TemporaryDirectory(prefix=f".{path.stem}.", suffix=".part", dir=path.parent) as own,
    ):  # the library writes beside its target, under a name of its own
        try:
            save_file(arrays, Path(own) / path.name, **({} if metadata is None else {"metadata": dict(metadata)}))
        except SafetensorError as error:  # what it makes of a full disk
            raise OSError(str(error)) from error
        (Path(own) / path.name).replace(temporary)


def read_safetensors(path: Path) -> dict[str, NDArray[Any]]:
    """Read all arrays of a safetensors file; InputError if it is missing, truncated or malformed."""
    return parse_safetensors(read_bytes(path), str(path))


def read_tensors(path: Path) -> dict[str, Tensor]:
    """``read_safetensors`` as torch tensors that may be written to."""
    import torch

    return {name: torch.from_numpy(array.copy()) for name, array in read_safetensors(path).items()}


def parse_safetensors(content: bytes, where: str) -> dict[str, NDArray[Any]]:
    """Parse safetensors bytes; InputError names ``where``."""
    from safetensors import SafetensorError
    from safetensors.numpy import load as load_numpy

    try:
        return dict(sorted(load_numpy(content).items()))  # the library hands them out in any order
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise InputError("not a valid safetensors file", where=where, got=str(error)) from error


def safetensors_metadata(content: bytes, where: str) -> dict[str, str]:
    """The texts in the header of safetensors bytes; InputError names ``where``."""
    size = int.from_bytes(content[:8], "little")
    if not 2 <= size <= len(content) - 8:
        raise InputError("not a valid safetensors file", where=where, got=f"{len(content)} bytes")
    header = parse_json(content[8 : 8 + size], where)
    found = header.get("__metadata__") if isinstance(header, dict) else None
    return {str(key): str(value) for key, value in found.items()} if isinstance(found, dict) else {}


# directories --------------------------------------------------------------------------------------


@contextlib.contextmanager
def atomic_directory(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling directory that becomes ``path`` on success (replacing an older one)."""
    path = Path(path)
    partial = path.with_name(path.name + ".part")
    shutil.rmtree(partial, ignore_errors=True)
    with disk_errors("cannot create a folder", partial):
        partial.mkdir(parents=True)
    try:
        yield partial
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    old = path.with_name(path.name + ".old.part")
    if path.exists():
        shutil.rmtree(old, ignore_errors=True)
        path.rename(old)
    partial.rename(path)
    shutil.rmtree(old, ignore_errors=True)
    fsync_directory(path.parent)


def staging_path(folder: Path) -> Path:
    """Where the new content of a folder is made while the old one still stands."""
    return folder.parent / f".{folder.name}.new.part"


def retired_path(folder: Path) -> Path:
    """Where the old content of a folder lies from the moment the new one takes its place until it is removed."""
    return folder.parent / f".{folder.name}.old.part"


def all_names(folder: Path) -> list[str]:
    """Relative POSIX names of all files and links below a folder, sorted; links are not followed."""
    names = []
    for top, folders, files in os.walk(folder):
        links = [name for name in folders if (Path(top) / name).is_symlink()]
        names += [(Path(top) / name).relative_to(folder).as_posix() for name in (*files, *links)]
    return sorted(names)


def list_files(folder: Path) -> list[str]:
    """Relative POSIX paths of the files below ``folder``, sorted, without temporary and bookkeeping files."""
    names = (name for name in all_names(folder) if name not in (MANIFEST, "lock") and ".part" not in name)
    return [name for name in names if (folder / name).is_file()]


def write_manifest(folder: Path, names: Sequence[str] | None = None) -> str:
    """Record size and sha256 of files below ``folder`` (None: of all); return the digest of the record itself."""
    files = {}
    for name in list_files(folder) if names is None else names:
        files[name] = {"bytes": (folder / name).stat().st_size, "sha256": sha256_file(folder / name)}
    write_json(folder / MANIFEST, {"schema": 1, "files": files})
    return sha256_file(folder / MANIFEST)


def verify_manifest(folder: Path) -> str:
    """Check every file in the manifest; return the manifest's digest. IntegrityError: it or a file is missing or
    altered."""
    path = folder / MANIFEST
    try:
        files = read_json(path)["files"]
        items = [(str(name), str(entry["sha256"]), int(entry["bytes"])) for name, entry in files.items()]
    except (InputError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise IntegrityError("the manifest is missing or damaged", where=str(path), got=str(error)) from error
    for name, expected, size in items:
        file = folder / name
        if not file.is_file():
            raise IntegrityError("a file is missing", where=str(file))
        if file.stat().st_size != size or sha256_file(file) != expected:
            raise _altered(file, expected)
    return sha256_file(path)


def _altered(file: Path, sha256: str) -> IntegrityError:
    expected = f"sha256 {sha256[:16]}..."
    return IntegrityError("a file was altered after it was written", where=str(file), expected=expected)


def sealed(values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The record of a finished run with the digests of manifest, log and record, which prove them unaltered."""
    log = folder / RUN_LOG
    digests = {"manifest": sha256_file(folder / MANIFEST), "log": sha256_file(log) if log.is_file() else None}
    return with_check({**values, "sealed": digests})


def with_check(record: Mapping[str, Any]) -> dict[str, Any]:
    """A record with its own digest as the last entry, ``check``."""
    return {**record, "check": _check(record)}


def check_holds(record: Mapping[str, Any]) -> bool:
    """Whether a record is as ``with_check`` made it."""
    return record.get("check") == _check({name: value for name, value in record.items() if name != "check"})


def _check(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json_text(record, indent=None).encode()).hexdigest()


def verify_record(folder: Path) -> None:
    """Check the bookkeeping of a run folder, if it has a record: its log and manifest are as the run wrote them.
    InputError: the run is not finished. IntegrityError: something was altered or is missing."""
    path = folder / RUN_STATE
    if not path.is_file():
        return
    try:
        record = read_json(path)
        if "asked" in record:
            return  # a chain of runs, whose record tells what was done, and is no result
        state = record["state"]
        check, digests = (record.pop("check"), record["sealed"]) if state == "complete" else ("", {})
        intact = check == (_check(record) if digests else "")
    except (InputError, KeyError, TypeError, AttributeError) as error:
        got, remedy = str(error).split("\n")[0], "make the result again in another folder"
        raise IntegrityError("the record of a run is damaged", where=str(path), got=got, remedy=remedy) from error
    if not intact:
        raise IntegrityError("the record of a run was altered after it was written", where=str(path))
    if state != "complete":
        where, remedy = str(folder), "repeat the command that makes it: it resumes"
        raise InputError("this folder holds an unfinished result", where=where, got=f"state {state!r}", remedy=remedy)
    for name, expected in {MANIFEST: digests.get("manifest", ""), RUN_LOG: digests.get("log")}.items():
        file = folder / name
        if expected is not None and not file.is_file():
            raise IntegrityError("a file of a finished result is missing", where=str(file))
        if expected and sha256_file(file) != expected:
            raise _altered(file, expected)


def verify_result(folder: Path) -> None:
    """Check a finished result and its bookkeeping; errors as in ``verify_manifest`` and ``verify_record``."""
    verify_manifest(folder)
    verify_record(folder)


def require(path: Path) -> None:
    """InputError where nothing is at a path that is to be read."""
    if not path.exists():
        stopped = "repeat the command that wrote it: it was stopped while it replaced it"
        remedy = stopped if retired_path(path).exists() else similar_path(path)
        raise InputError("no such file or folder", where=str(path), remedy=remedy)


def digest(path: Path) -> str:
    """Digest of an artefact: of its verified manifest, or of all its bytes where there is no manifest. InputError:
    nothing is there, or an unfinished result. IntegrityError: a finished result or its bookkeeping was altered."""
    path = Path(path)
    require(path)
    if path.is_file():
        return sha256_file(path)
    verify_record(path)
    if (path / MANIFEST).is_file():
        return verify_manifest(path)
    return digest_of_files(path, list_files(path))


def digest_of_files(folder: Path, names: Sequence[str]) -> str:
    """One digest of the names and contents of these files (an empty name: of the folder, which is a file)."""
    lines = (f"{name}\0{sha256_file(folder / name if name else folder)}\n" for name in names)
    return hashlib.sha256("".join(lines).encode()).hexdigest()
