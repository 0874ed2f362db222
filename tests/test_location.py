"""Addresses in an object store: nothing half there, no secret shown."""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from refusals import refused

from mudg.base import location, store
from mudg.base.errors import InputError, IntegrityError, ResourceError, UsageError
from mudg.base.location import Location

fsspec = pytest.importorskip("fsspec", reason="the store in memory is fsspec's")


@pytest.fixture(autouse=True)
def _empty_memory() -> Iterator[None]:
    files = fsspec.filesystem("memory")
    files.store.clear()
    files.pseudo_dirs[:] = [""]
    yield
    files.store.clear()


@pytest.fixture
def root() -> Location:
    return Location.of("memory://bucket/store")


class Faulty:
    """fsspec's store in memory, with a say before every call."""

    def __init__(self, before: Callable[[str, tuple[Any, ...], dict[str, Any]], None]) -> None:
        self._files, self._before = fsspec.filesystem("memory"), before

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._files, name)
        if not callable(found):
            return found

        def call(*args: Any, **options: Any) -> Any:
            self._before(name, args, options)
            return found(*args, **options)

        return call


@pytest.fixture
def before(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[..., None]], None]:
    """Install what is called before every request."""

    def install(say: Callable[..., None]) -> None:
        monkeypatch.setattr(location, "_file_system", lambda scheme, process: Faulty(say))

    return install


def folder_of(tmp_path: Path, name: str = "made", **more: bytes) -> Path:
    """A small result: files at two depths, an empty one, a manifest and a record."""
    folder = tmp_path / name
    files = {"a/b/deep.bin": bytes(range(256)) * 3, "plain.txt": b"plain", "empty": b""}
    files |= {"run.json": b'{"state": 1}', **more}
    for relative, content in files.items():
        (folder / relative).parent.mkdir(parents=True, exist_ok=True)
        (folder / relative).write_bytes(content)
    store.write_manifest(folder)
    return folder


def content(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ---- addresses -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("s3://bucket/a//b/", "s3://bucket/a/b"),
        (Path("s3://bucket/a"), "s3://bucket/a"),
        ("S3://bucket", "s3://bucket"),
        ("abfs://box@account.dfs.core.windows.net/x", "abfs://box@account.dfs.core.windows.net/x"),
        ("runs//a/", "runs/a"),
        ("C:/runs", "C:/runs"),
        ("gs://bucket/a:b", "gs://bucket/a:b"),
    ],
)
def test_an_address_has_one_spelling(given: str | Path, text: str) -> None:
    assert str(Location.of(given)) == text and Location.of(Location.of(given)) == Location.of(given)


@pytest.mark.parametrize(
    "given",
    [
        *"s3://key:hunter2@bucket/x s3://key:hun/hunter2@bucket/x s3://hunter2@bucket/x gs://:hunter2@bucket".split(),
        *"s3://bucket/x?X-Amz-Signature=hunter2 abfs://box:hunter2@account/x".split(),
        Path("s3://key:hunter2@bucket/x"),
    ],
)
def test_an_address_with_a_secret_is_refused_and_not_shown(given: str | Path) -> None:
    with pytest.raises(UsageError) as caught:
        Location.of(given)
    assert "hunter2" not in str(caught.value) and "leave" in caught.value.remedy


@pytest.mark.parametrize(
    "given", ["ftp://host/x", "s3://", "s3:///x", "s3://bucket/../other", "", "file:///x", "s3://b::s3://c/x"]
)
def test_what_is_no_address_is_refused(given: str) -> None:
    with pytest.raises(UsageError):
        Location.of(given)


@pytest.mark.parametrize("name", ["", "..", "a/../b", "/a", "a//b", ".", "a\0b"])
def test_a_name_stays_below(name: str, root: Location) -> None:
    with pytest.raises(UsageError):
        _ = root / name


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: Any, **__: Any) -> None:
        raise ImportError("Install s3fs to access S3")

    location._file_system.cache_clear()
    monkeypatch.setattr(fsspec, "filesystem", missing)
    refused(r"s3fs[\s\S]*pip install 'mudg\[s3\]'", Location.of("s3://bucket/x").load, raises=ResourceError)
    refused(r"gcsfs[\s\S]*mudg\[gs\]", Location.of("gs://bucket/x").exists, raises=ResourceError)
    location._file_system.cache_clear()


# ---- single files --------------------------------------------------------------------------------


def save_read_list_and_remove(root: Location) -> None:
    assert not root.exists() and root.names() == []
    for name, content in (("b/one", b"1"), ("a", b""), ("b/one", b"123")):
        (root / name).save(content)
    assert root.names() == ["a", "b"] and (root / "b").names() == ["one"]
    assert (root / "b" / "one").load() == b"123" and root.tree() == {"a": 0, "b/one": 3}
    assert root.exists() and (root / "b").exists() and (root / "a").exists() and (root / "a").load() == b""
    for name in ("b", "b", "a"):
        (root / name).remove()
    assert root.names() == [] and not (root / "b").exists()
    refused("nothing is at", (root / "a").load)


def test_files_are_saved_read_listed_and_removed(root: Location, tmp_path: Path) -> None:
    save_read_list_and_remove(root)
    (root / "a").save(b"1")
    refused("whole bucket", Location.of("memory://bucket").remove, raises=UsageError)
    (tmp_path / "here").write_bytes(b"here")
    assert Location.of(tmp_path).names() == ["here"] and Location.of(tmp_path / "here").load() == b"here"
    refused("an address", Location.of(tmp_path).push, tmp_path, raises=UsageError)


def test_one_makes_a_file_also_on_a_disk_without_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(95, "Operation not supported")

    for claim in (tmp_path / "linked/claim", tmp_path / "copied/claim"):
        assert store.create_once(claim, b"first") and not store.create_once(claim, b"second")
        assert claim.read_bytes() == b"first" and os.listdir(claim.parent) == ["claim"]
        monkeypatch.setattr(os, "link", refuse)


# ---- failures ------------------------------------------------------------------------------------


class Answer(OSError):
    """What a store's package raises for an HTTP status."""

    def __init__(self, status: int) -> None:
        super().__init__(5, f"status {status} with wJalrXUtnFEMI")
        self.response = {"ResponseMetadata": {"HTTPStatusCode": status}}


class NoCredentialsError(Exception):
    pass


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (ConnectionRefusedError("no"), "cannot be reached"),
        (TimeoutError(), "cannot be reached"),
        (Answer(503), "does not answer"),
        (Answer(429), "does not answer"),
        (Answer(403), "refused access"),
        (Answer(400), "cannot do"),
        (NoCredentialsError("none"), "no credentials"),
        (ZeroDivisionError(), ""),
    ],
)
def test_failures_are_told(
    error: Exception, words: str, before: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(name: str, args: tuple[Any, ...], options: dict[str, Any]) -> None:
        raise error

    before(fail)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wJalrXUtnFEMI")
    at = Location.of("memory://bucket/x")
    for call in (at.load, lambda: at.save(b"1"), at.names, at.exists, at.tree):
        with pytest.raises(ResourceError if words else ZeroDivisionError, match=words or None) as caught:
            call()
        if not words:  # a mistake of the program is not hidden
            continue
        assert caught.value.where == "memory://bucket/x" and caught.value.remedy
        assert "wJalrXUtnFEMI" not in str(caught.value)


# ---- folders -------------------------------------------------------------------------------------


def test_a_folder_goes_there_and_back(root: Location, tmp_path: Path) -> None:
    made = folder_of(tmp_path)
    (made / "lock").write_text("{}")
    (made / ".x.abcdefgh.part").write_text("half")
    (root / "run").push(made)
    assert (root / "run").names() == ["_contents.json", "a", "empty", "manifest.json", "plain.txt", "run.json"]
    (tmp_path / "back/a").mkdir(parents=True)
    (tmp_path / "back/a/old").write_text("of an earlier version")
    (root / "run").fetch(tmp_path / "back")
    assert (tmp_path / "back/a/old").exists()
    (root / "run").fetch(tmp_path / "back", mirror=True)
    (made / "lock").unlink()
    (made / ".x.abcdefgh.part").unlink()
    assert content(tmp_path / "back") == content(made)
    (root / "run/plain.txt").fetch(tmp_path / "one")
    assert (tmp_path / "one").read_bytes() == b"plain"
    refused("nothing is at", (root / "nowhere").fetch, tmp_path / "nothing")
    refused("no folder", (root / "run").push, tmp_path / "missing")


@pytest.mark.parametrize("by_other_tools", [False, True])
@pytest.mark.parametrize("damage", ["altered", "short", "missing"])
def test_what_is_damaged_in_the_store_is_not_taken(
    damage: str, by_other_tools: bool, root: Location, tmp_path: Path
) -> None:
    made, file = folder_of(tmp_path), root / "run/a/b/deep.bin"
    for name, data in content(made).items() if by_other_tools else ():
        (root / "run" / name).save(data)
    if not by_other_tools:
        (root / "run").push(made)
    (root / "run").fetch(tmp_path / "whole")
    assert content(tmp_path / "whole") == content(made)
    if damage == "missing":
        file.remove()
    else:
        file.save(file.load()[1:] + (b"x" if damage == "altered" else b""))
    with pytest.raises(IntegrityError, match=r"deep\.bin"):
        (root / "run").fetch(tmp_path / "back")
    assert not (tmp_path / "back" / "manifest.json").exists()


def test_a_record_with_a_name_that_leads_out_is_refused(root: Location, tmp_path: Path) -> None:
    entry = {"bytes": 1, "sha256": "0" * 64}
    for name in ("../out", "/etc/x", "a/../../x", "a\\b"):
        record = {"schema": 1, "state": "complete", "files": {name: entry}, "names": []}
        (root / "run/_contents.json").save(json.dumps(record).encode())
        with pytest.raises(IntegrityError, match="leads out"):
            (root / "run").fetch(tmp_path / "back")


def test_stopped_at_any_moment_an_upload_is_no_result_or_a_whole_one(
    before: Callable[..., None], tmp_path: Path
) -> None:
    """Every request that changes something is once the one at which the program ends."""
    old, new = folder_of(tmp_path, "old", gone=b"old alone"), folder_of(tmp_path, "new", **{"plain.txt": b"changed"})
    changes, stop_at = 0, 0

    def count(name: str, args: tuple[Any, ...], options: dict[str, Any]) -> None:
        nonlocal changes
        if name == "put":  # of several files, one arrives before the program ends
            changes += 1
            if changes == stop_at:
                fsspec.filesystem("memory").put(args[0][:1], args[1][:1])
                raise KeyboardInterrupt
        elif name in ("pipe_file", "rm"):
            changes += 1
            if changes == stop_at:
                raise KeyboardInterrupt

    before(count)
    for moment in itertools.count(1):
        run, stop_at = Location.of(f"memory://bucket/run{moment}"), 0
        run.push(old)
        (run / "theirs").save(b"somebody else's")
        changes, stop_at = 0, moment
        try:
            run.push(new)
            break
        except KeyboardInterrupt:
            stop_at = 0
        if (run / "manifest.json").exists():
            run.fetch(tmp_path / f"old{moment}")
            assert content(tmp_path / f"old{moment}") == content(old)
        else:
            with pytest.raises(InputError, match="not finished"):
                run.fetch(tmp_path / f"half{moment}")
        run.push(new)
        run.fetch(tmp_path / f"new{moment}")
        assert content(tmp_path / f"new{moment}") == content(new)
        assert (run / "theirs").load() == b"somebody else's" and not (run / "gone").exists()
    assert moment > 6


def test_files_of_others_are_not_overwritten(root: Location, tmp_path: Path) -> None:
    (root / "run/plain.txt").save(b"somebody else's")
    with pytest.raises(UsageError, match=r"something else[\s\S]*plain\.txt"):
        (root / "run").push(folder_of(tmp_path))
    assert (root / "run").names() == ["plain.txt"] and (root / "run/plain.txt").load() == b"somebody else's"


def test_an_unchanged_folder_is_not_sent_again(before: Callable[..., None], tmp_path: Path) -> None:
    run, made, asked = Location.of("memory://bucket/run"), folder_of(tmp_path), []
    before(lambda name, args, options: asked.append((name, args)))
    run.push(made)
    (put,) = (args for name, args in asked if name == "put")
    assert sorted(path.rpartition("/run/")[2] for path in put[1]) == ["a/b/deep.bin", "empty", "plain.txt", "run.json"]
    asked.clear()
    run.push(made)
    assert not {"put", "pipe_file", "rm"} & {name for name, _ in asked}
    (made / "plain.txt").write_bytes(b"other")
    store.write_manifest(made)
    run.push(made)
    (put,) = (args for name, args in asked if name == "put")
    assert [path.rpartition("/run/")[2] for path in put[1]] == ["plain.txt"]


def test_a_damaged_upload_is_noticed(before: Callable[..., None], tmp_path: Path) -> None:
    files = fsspec.filesystem("memory")

    def damage(name: str, args: tuple[Any, ...], options: dict[str, Any]) -> None:
        if name == "find" and files.exists("bucket/run/plain.txt"):
            files.pipe_file("bucket/run/plain.txt", b"PLA")

    before(damage)
    with pytest.raises(IntegrityError, match=r"did not arrive[\s\S]*plain\.txt"):
        Location.of("memory://bucket/run").push(folder_of(tmp_path))
    assert not Location.of("memory://bucket/run/manifest.json").exists()


def test_a_fetch_goes_on_with_the_files_that_are_here(
    before: Callable[..., None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, made, asked = Location.of("memory://bucket/run"), folder_of(tmp_path), []
    run.push(made)

    def stop(name: str, args: tuple[Any, ...], options: dict[str, Any]) -> None:
        if name == "get":
            asked.append(args[0][0].rpartition("/run/")[2])
            if len(asked) == 3:
                raise KeyboardInterrupt

    before(stop)
    monkeypatch.setattr(location, "_GROUP", 1)
    with pytest.raises(KeyboardInterrupt):
        run.fetch(tmp_path / "back")
    assert not (tmp_path / "back/manifest.json").exists()
    run.fetch(tmp_path / "back")
    assert asked == ["a/b/deep.bin", "empty", "plain.txt", "plain.txt", "manifest.json", "run.json"]
    assert content(tmp_path / "back") == content(made)
    run.fetch(tmp_path / "back")
    assert len(asked) == 6, "what is here is not fetched again"


def test_a_full_disk_is_told_before_anything_is_fetched(
    root: Location, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (root / "run").push(folder_of(tmp_path))
    monkeypatch.setattr(location.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(100, 100, 1000))
    with pytest.raises(ResourceError, match=r"not enough space[\s\S]*--scratch"):
        (root / "run").fetch(tmp_path / "back")
    assert not (tmp_path / "back").exists()
