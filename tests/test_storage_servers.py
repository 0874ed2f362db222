"""Locations on real S3 servers: `tools/storage_tests.sh` installs two of different makers, starts them and runs this.

`MUDG_TEST_S3` names them: ``moto=http://127.0.0.1:5901,rclone=http://127.0.0.1:5902``. Each has a bucket named ``bucket``.
"""

from __future__ import annotations

import concurrent.futures
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mudg import cli
from mudg.base import remote, store
from mudg.base.errors import InputError, ResourceError
from mudg.base.location import Location

pytestmark = [pytest.mark.cluster, pytest.mark.filterwarnings("ignore")]  # warnings of the servers' own packages

SERVERS = dict(one.split("=", 1) for one in os.environ.get("MUDG_TEST_S3", "").split(",") if one)
CONDITIONAL = {"moto": True, "rclone": False}


@pytest.fixture(params=["moto", "rclone"])
def server(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    if request.param not in SERVERS:
        pytest.skip(f"no {request.param} server: run tools/storage_tests.sh")
    use(SERVERS[request.param], monkeypatch)
    yield request.param
    remote._opened.cache_clear()


def use(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", address)
    remote._opened.cache_clear()
    remote._exclusive.clear()


@pytest.fixture
def root(server: str) -> Iterator[Location]:
    at = Location.of(f"s3://bucket/{hashlib.sha256(os.urandom(8)).hexdigest()[:12]}")
    yield at
    at.remove()


def folder_of(tmp_path: Path, *sizes: int) -> Path:
    folder = tmp_path / "made"
    for number, size in enumerate(sizes):
        (folder / f"part{number % 3}").mkdir(parents=True, exist_ok=True)
        (folder / f"part{number % 3}" / f"{number} ü&+%20.bin").write_bytes(os.urandom(size))
    store.write_manifest(folder)
    return folder


def content(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): store.sha256_file(path) for path in folder.rglob("*") if path.is_file()
    }


def test_single_objects(root: Location, server: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert root.names() == [] and not root.exists()
    assert (root / "b/one").save(b"1") and (root / "b/one").save(b"12") and (root / "a").save(b"")
    assert (root / "b/one").load() == b"12" and (root / "b/one").size() == 2 and (root / "a").load() == b""
    assert root.names() == ["a", "b"]
    claim = root / "claim"
    assert claim.save(b"first", only_if_absent=True) and not claim.save(b"second", only_if_absent=True)
    assert claim.load() == b"first" and claim.exclusive() == CONDITIONAL[server]
    assert ("no conditional writes" in capfd.readouterr().err) != CONDITIONAL[server]
    claim.remove()
    claim.remove()
    with pytest.raises(InputError, match="nothing is at"):
        claim.load()
    assert root.names() == ["a", "b"]


def test_of_eight_threads_one_makes_each_object(root: Location, server: str) -> None:
    if not CONDITIONAL[server]:
        pytest.skip("this server has no conditional writes")
    assert (root / "warm").exclusive()
    ready = threading.Barrier(8)

    def claim(me: int) -> list[int]:
        ready.wait()
        return [n for n in range(40) if (root / f"claims/{n}").save(str(me).encode(), only_if_absent=True)]

    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        won = list(pool.map(claim, range(8)))
    assert sorted(n for names in won for n in names) == list(range(40))
    assert all((root / f"claims/{n}").load() == str(me).encode() for me, names in enumerate(won) for n in names)


def test_folders_with_large_objects_and_odd_names(root: Location, tmp_path: Path) -> None:
    made = folder_of(tmp_path, 0, 1, 3 << 20, remote.PIECE, 2 * remote.PIECE, 2 * remote.PIECE + 1, 40 << 20)
    (root / "run").push(made)
    (root / "run").fetch(tmp_path / "back")
    assert content(tmp_path / "back") == content(made)
    before = (root / "run/_contents.json").load()
    (root / "run").push(made)
    assert (root / "run/_contents.json").load() == before


def test_more_objects_than_one_page_of_a_listing(root: Location) -> None:
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda n: (root / f"many/{n:04}").save(b""), range(1100)))
    assert (root / "many").names() == [f"{n:04}" for n in range(1100)]


PUSH = "import sys; from pathlib import Path; from mudg.base.location import Location; Location.of(sys.argv[1]).push(Path(sys.argv[2]))"


def test_a_killed_upload_is_no_result_and_goes_on(root: Location, tmp_path: Path, server: str) -> None:
    made = folder_of(tmp_path, *[1 << 20] * 60)
    child = subprocess.Popen([sys.executable, "-c", PUSH, str(root / "run"), str(made)], stderr=subprocess.DEVNULL)
    end = time.monotonic() + 60
    while len((root / "run/part0").names()) < 3 and time.monotonic() < end:
        time.sleep(0.02)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert not (root / "run/manifest.json").exists(), "it was killed too late to show anything"
    with pytest.raises(InputError, match="not finished"):
        (root / "run").fetch(tmp_path / "half")
    there = set((root / "run/part0").names())
    assert there
    sent: list[str] = []
    put = remote.RemoteStore.put
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(remote.RemoteStore, "put", lambda self, path, *more: sent.append(path) or put(self, path, *more))
        (root / "run").push(made)
    if server == "moto":  # keeps the sha256 that was sent with an object
        assert len(sent) <= 60 - len(there)
    (root / "run").fetch(tmp_path / "back")
    assert content(tmp_path / "back") == content(made)


def test_uploads_that_fail_now_and_then_arrive(root: Location, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every seventh request of the client is answered with a failure that passes."""
    monkeypatch.setattr(remote, "FIRST_WAIT_S", 0.01)
    files = type(root.side.storage.files)
    found, lock, count = files._call_s3, threading.Lock(), [0]

    async def failing(self, *args, **options):  # type: ignore[no-untyped-def]
        with lock:
            count[0] += 1
            number = count[0]
        if number % 7 == 0:
            raise ConnectionResetError("injected")
        return await found(self, *args, **options)

    monkeypatch.setattr(files, "_call_s3", failing)
    made = folder_of(tmp_path, *[1000] * 20, 20 << 20)
    (root / "run").push(made)
    (root / "run").fetch(tmp_path / "back")
    assert content(tmp_path / "back") == content(made) and count[0] > 60


def test_failures_in_words(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="no such bucket"):
        Location.of("s3://missing-bucket/x").save(b"1")
    monkeypatch.setattr(remote, "FIRST_WAIT_S", 0.0)
    use("http://127.0.0.1:9", monkeypatch)
    with pytest.raises(ResourceError, match=r"cannot be reached[\s\S]*tried 6 times"):
        Location.of("s3://bucket/x").load()
    if server == "rclone":  # moto takes any key
        use(SERVERS[server], monkeypatch)
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong-secret-key")
        with pytest.raises(ResourceError, match="refused access") as caught:
            Location.of("s3://bucket/x").load()
        assert "wrong-secret-key" not in str(caught.value)
    use(SERVERS[server], monkeypatch)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    with pytest.raises(ResourceError, match="no credentials"):
        Location.of("s3://bucket/x").load()


def test_commands_from_store_to_store(root: Location, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    city = (
        "--city.n-frames",
        "2",
        "--city.width",
        "48",
        "--city.height",
        "32",
        "--city.cameras",
        "front",
        "--no-contact-sheet",
    )
    scratch = ("--scratch", str(tmp_path / "scratch"), "--quiet")
    assert cli.main(["ingest", "city", str(root / "city"), *city, *scratch]) == 0
    fuse = ["fuse", str(root / "city"), "--out", str(root / "fused"), *scratch]
    assert cli.main([*fuse, "--json"]) == 0
    assert json.loads(capfd.readouterr().out.partition("\n")[2]) == {"fused": str(root / "fused")}
    assert cli.main(["ingest", "city", str(tmp_path / "city"), *city, "--quiet"]) == 0
    assert cli.main(["fuse", str(tmp_path / "city"), "--out", str(tmp_path / "fused"), "--quiet"]) == 0
    (root / "fused").fetch(tmp_path / "back")
    assert store.digest(tmp_path / "back") == store.digest(tmp_path / "fused")
    assert not any((tmp_path / "scratch").iterdir())


MEMORY = """
import re, sys
from pathlib import Path
from mudg.base.location import Location

def peak():  # of this program alone: what getrusage says begins with the parent's
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])

at = Location.of(sys.argv[1])
at.exists()
before = peak()
at.push(Path(sys.argv[2]))
at.fetch(Path(sys.argv[3]))
print((peak() - before) / 1024)
"""


def test_memory_does_not_grow_with_the_folder(root: Location, tmp_path: Path) -> None:
    made = folder_of(tmp_path, 200 << 20, 100 << 20, *[8 << 20] * 20)
    words = [sys.executable, "-c", MEMORY, str(root / "run"), str(made), str(tmp_path / "back")]
    grown = float(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
    print(f"memory grew by {grown:.0f} MiB for 460 MiB")
    assert 0 < grown < 300
