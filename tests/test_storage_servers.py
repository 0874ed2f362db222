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

from mudg import app
from mudg.base import location, store
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.location import Location
from mudg.fleet.records import BatchFolder

pytestmark = [pytest.mark.cluster, pytest.mark.filterwarnings("ignore")]  # warnings of the servers' own packages

SERVERS = dict(one.split("=", 1) for one in os.environ.get("MUDG_TEST_S3", "").split(",") if one)
CITY = "--city.n-frames 2 --city.width 48 --city.height 32 --city.cameras front --no-contact-sheet".split()
CONDITIONAL = {"moto": True, "rclone": False}


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


def content(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): store.sha256_file(path) for path in files}


def test_single_objects(root: Location, server: str) -> None:
    assert root.names() == [] and not root.exists()
    assert (root / "b/one").save(b"1") and (root / "b/one").save(b"12") and (root / "a").save(b"")
    assert (root / "b/one").load() == b"12" and (root / "a").load() == b""
    assert root.names() == ["a", "b"] and root.tree() == {"a": 0, "b/one": 2}
    assert root.load_below(["a", "gone"]) == {"a": b""}
    claim = root / "claim"
    assert claim.save(b"first", only_if_absent=True)
    if CONDITIONAL[server]:
        assert not claim.save(b"second", only_if_absent=True) and claim.load() == b"first"
    claim.remove()
    claim.remove()
    refused("nothing is at", claim.load)
    assert root.names() == ["a", "b"]


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
    put = Location._put
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Location, "_put", lambda self, frm, names: sent.extend(names) or put(self, frm, names))
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


# batches ------------------------------------------------------------------------------------------

STEP = """
# step.sh SOURCE OUT NAME TALLY: copies a text, and writes a line per run
echo run >> "$4/$3"
sleep ${STEP_S:-0}
[ -f "$1/log.txt" ] || { echo "error: the log holds no text" >&2; exit 3; }
mkdir -p "$2" && cat "$1/log.txt" > "$2/result.txt"
"""


class BatchInAStore:
    """Logs, list and results at an address; a step that copies; and how often each scene was begun."""

    def __init__(self, root: Location, folder: Path, scenes: int) -> None:
        self.root, self.folder, self.scenes = root, folder, scenes
        self.out = root / "runs"
        self.tally = folder / "tally"
        self.tally.mkdir(parents=True)
        (folder / "step.sh").write_text(STEP)
        for name in self.names:
            self.put_log(name, f"text of {name}\n")
        (root / "list.txt").save("".join(f"logs/{name}\n" for name in self.names).encode())

    @property
    def names(self) -> list[str]:
        return [f"s{number:02d}" for number in range(self.scenes)]

    def put_log(self, name: str, text: str) -> None:
        log = self.folder / "logs" / name
        log.mkdir(parents=True, exist_ok=True)
        (log / "other.txt").write_text(name)
        if text:
            (log / "log.txt").write_text(text)
        (self.root / "logs" / name).push(log)

    def words(self, machine: str, *more: str) -> list[str]:
        step = ["--command", "sh", str(self.folder / "step.sh"), "{source}", "{out}", "{name}", str(self.tally)]
        first = f"batch run --list {self.root}/list.txt --out {self.out} --quiet --jobs 1".split()
        return [*first, "--scratch", str(self.folder / machine), *more, *step]

    def start(
        self, machine: str, *more: str, before: tuple[str, ...] = (), **environment: str
    ) -> subprocess.Popen[bytes]:
        words = [*before, sys.executable, "-m", "mudg", *self.words(machine, *more)]
        return subprocess.Popen(words, env={**os.environ, **environment})

    def runs(self) -> dict[str, int]:
        return {path.name: len(path.read_text().splitlines()) for path in self.tally.iterdir()}

    def results(self) -> dict[str, str]:
        """Scene -> text of its result, of all that are on record."""
        found = {}
        for name in (self.out / "_batch/done").names():
            record = json.loads((self.out / "_batch/done" / name).load())
            assert record["scene"] not in found
            found[record["scene"]] = (self.out / record["place"] / "result.txt").load().decode()
        return found


def wait_until(condition, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.1)


ELSEWHERE = ("unshare", "--pid", "--fork", "--mount-proc", "--kill-child")
"""Starts a program where process numbers mean something else, as on another machine."""


def test_a_batch_whose_list_logs_and_results_lie_in_a_store(
    root: Location, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    if subprocess.run([*ELSEWHERE, "true"], check=False, capture_output=True).returncode:
        pytest.skip("no process spaces of its own for this user (unshare --pid)")
    made = BatchInAStore(root, tmp_path, 6)
    (made.root / "logs/s03").remove()
    (tmp_path / "logs/s03/log.txt").unlink()
    made.put_log("s03", "")
    first = made.start("one", before=ELSEWHERE, STEP_S="2")
    wait_until(lambda: sum(made.runs().values()) >= 2, 60)
    first.kill()
    first.wait()
    begun = made.runs()
    assert made.start("two").wait(120) == 2, "the other machine may still be at it"
    assert made.start("two", "--take-over").wait(120) == 11
    capfd.readouterr()
    assert app.main(["batch", "status", str(made.out), "--json"]) == 0
    record = json.loads(capfd.readouterr().out)
    assert (record["finished"], record["left"], record["stages"]["command"]["failed"]) == (5, 0, 1)
    assert record["reasons"][0]["reason"].endswith("the log holds no text")
    made.put_log("s03", "text of s03\n")
    assert app.main(["batch", "retry", str(made.out), "--reason", "3"]) == 0 and made.start("three").wait(120) == 0
    assert made.results() == {name: f"text of {name}\n" for name in made.names}
    once = {name for name, count in made.runs().items() if count == 1}
    assert set(made.names) - once <= {"s03", *begun} and sum(made.runs().values()) <= made.scenes + 2
    names = (made.out / "_batch").names()
    assert [name for name in names if not name.startswith("list.")] == ["done", "logs", "plan.json"] and len(names) == 4
    for machine in ("two", "three"):
        assert not list((tmp_path / machine / "mudg_batch").iterdir())
        assert not [path for path in (tmp_path / machine / "mudg_inputs").rglob("*") if path.suffix != ".lock"]


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


def test_of_six_drivers_one_works_on_a_batch(root: Location, server: str) -> None:
    ready, driving, most = threading.Barrier(6), [0], [0]

    def race(me: int) -> str:
        ready.wait()
        try:
            with BatchFolder(root / "runs").owned():
                driving[0] += 1
                most[0] = max(most[0], driving[0])
                time.sleep(3.0)
                driving[0] -= 1
                return "mine"
        except UsageError:
            return "refused"

    # threads of one process take each other for dead; as other machines do, they must not
    with pytest.MonkeyPatch.context() as patch, concurrent.futures.ThreadPoolExecutor(6) as pool:
        patch.setattr("mudg.fleet.records.this_host", lambda: f"host {threading.get_ident()}")
        answers = list(pool.map(race, range(6)))
    if CONDITIONAL[server]:
        assert answers.count("mine") <= 1 and most[0] <= 1
