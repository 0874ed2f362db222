"""Locations on real S3 servers: `tools/storage_tests.sh` installs two of different makers, starts them and runs this.

`MUDG_TEST_S3` names them: ``moto=http://127.0.0.1:5901,rclone=http://127.0.0.1:5902``. Each has a bucket named
``bucket``.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import hashlib
import http.client
import http.server
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
from refusals import refused
from test_location import content, save_read_list_and_remove

from mudg import app
from mudg.base import location, store
from mudg.base.errors import InputError, ResourceError
from mudg.base.location import Location

pytestmark = [pytest.mark.cluster, pytest.mark.filterwarnings("ignore")]  # warnings of the servers' own packages

SERVERS = dict(one.split("=", 1) for one in os.environ.get("MUDG_TEST_S3", "").split(",") if one)
CITY = "--city.n-frames 2 --city.width 48 --city.height 32 --city.cameras front --no-contact-sheet".split()


@pytest.fixture(params=["moto", "rclone"])
def server(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    if request.param not in SERVERS:
        pytest.skip(f"no {request.param} server: run tools/storage_tests.sh")
    use(SERVERS[request.param], monkeypatch)
    yield request.param
    location._file_system.cache_clear()


def use(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", address)
    location._file_system.cache_clear()


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


def test_single_objects(root: Location) -> None:
    save_read_list_and_remove(root)


def test_folders_with_large_objects_and_odd_names(root: Location, tmp_path: Path) -> None:
    made = folder_of(tmp_path, 0, 1, 3 << 20, 8 << 20, (16 << 20) + 1, 40 << 20)
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


PUSH = (
    "import sys; from pathlib import Path; from mudg.base.location import Location;"
    " Location.of(sys.argv[1]).push(Path(sys.argv[2]))"
)


def test_a_killed_upload_is_no_result_and_goes_on(root: Location, tmp_path: Path) -> None:
    made = folder_of(tmp_path, *[1 << 20] * 60)
    child = subprocess.Popen([sys.executable, "-c", PUSH, str(root / "run"), str(made)], stderr=subprocess.DEVNULL)
    end = time.monotonic() + 60
    while len((root / "run/part0").names()) < 3 and time.monotonic() < end:
        time.sleep(0.02)
    child.send_signal(signal.SIGKILL)
    child.wait()
    assert not (root / "run/manifest.json").exists(), "it was killed too late to show anything"
    refused("not finished", (root / "run").fetch, tmp_path / "half")
    there = set((root / "run/part0").names())
    assert there
    sent: list[str] = []
    files, put = (root / "run")._files, (root / "run")._files.put
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "put", lambda frm, to, **more: sent.extend(frm) or put(frm, to, **more))
        (root / "run").push(made)
    assert len(sent) <= 60 - len(there)
    (root / "run").fetch(tmp_path / "back")
    assert content(tmp_path / "back") == content(made)


def test_a_store_that_fails_now_and_then(
    root: Location, server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every seventh request refused, every eleventh answer lost: what the store's own package repeats is enough."""
    made = folder_of(tmp_path, *[1000] * 20, 20 << 20)
    with unreliable(SERVERS[server]) as (address, handler):
        use(address, monkeypatch)
        (root / "run").push(made)
        (root / "run").fetch(tmp_path / "back")
        print(f"{server}: {handler.count} requests, {handler.count // 7} refused, {handler.count // 11} answers lost")
        assert content(tmp_path / "back") == content(made) and handler.count > 60
        use(SERVERS[server], monkeypatch)


def test_failures_in_words(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="no such bucket"):
        Location.of("s3://missing-bucket/x").save(b"1")
    use("http://127.0.0.1:9", monkeypatch)
    began = time.monotonic()
    with pytest.raises(ResourceError, match="cannot be reached"):
        Location.of("s3://bucket/x").load()
    print(f"no server: told after {time.monotonic() - began:.0f} s")
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
    scratch = ("--scratch", str(tmp_path / "scratch"), "--quiet")
    assert app.main(["ingest", "city", str(root / "city"), *CITY, *scratch]) == 0
    fuse = ["fuse", str(root / "city"), "--out", str(root / "fused"), *scratch]
    assert app.main([*fuse, "--json"]) == 0
    assert json.loads(capfd.readouterr().out.partition("\n")[2]) == {"fused": str(root / "fused")}
    assert app.main(["ingest", "city", str(tmp_path / "city"), *CITY, "--quiet"]) == 0
    assert app.main(["fuse", str(tmp_path / "city"), "--out", str(tmp_path / "fused"), "--quiet"]) == 0
    (root / "fused").fetch(tmp_path / "back")
    assert store.digest(tmp_path / "back") == store.digest(tmp_path / "fused")
    assert not any((tmp_path / "scratch").iterdir())


class _Unreliable(http.server.BaseHTTPRequestHandler):
    """Passes requests on to a server; every seventh is answered with a failure, every eleventh answer never arrives."""

    protocol_version = "HTTP/1.1"
    target = ""
    count = 0
    lock = threading.Lock()

    def log_message(self, *_: object) -> None:
        """Nothing."""

    def _pass_on(self) -> None:
        with self.lock:
            type(self).count += 1
            number = self.count
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if number % 7 == 0:
            self._answer(503, {}, b"")
            return
        there = http.client.HTTPConnection(self.target, timeout=60)
        there.request(self.command, self.path, body, dict(self.headers.items()))
        found = there.getresponse()
        data = found.read()
        there.close()
        if number % 11 == 0:
            self.close_connection = True
            return
        own = ("connection", "transfer-encoding", "keep-alive")
        kept = {name: value for name, value in found.getheaders() if name.lower() not in own}
        self._answer(found.status, kept, data)

    do_GET = do_PUT = do_HEAD = do_POST = do_DELETE = _pass_on

    def _answer(self, status: int, headers: dict[str, str], data: bytes) -> None:
        self.send_response(status)
        for name, value in headers.items():
            if name.lower() != "content-length" or self.command == "HEAD":
                self.send_header(name, value)
        if self.command != "HEAD" or "content-length" not in map(str.lower, headers):
            self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)


@contextlib.contextmanager
def unreliable(address: str) -> Iterator[tuple[str, type[_Unreliable]]]:
    """Address of a server that fails now and then, in front of another."""
    handler = type("Handler", (_Unreliable,), {"target": address.partition("://")[2]})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as here:
        here.daemon_threads = True
        threading.Thread(target=here.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{here.server_address[1]}", handler
        finally:
            here.shutdown()
