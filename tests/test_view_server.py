"""The server of ``mudg view`` under requests that no browser sends, with and without the token."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from mudg.base.errors import ResourceError
from mudg.viewer import server as served
from mudg.viewer.server import SiteServer

TOKEN = "a-secret-of-the-test"
PAGE = b"<html>" + b"x" * 5_000_000


def _broken(_asked: object) -> tuple[bytes, str]:
    raise ZeroDivisionError("a mistake\x1b[31m")


def _no_memory(_asked: object) -> tuple[bytes, str]:
    raise MemoryError


def opened(host: str = "127.0.0.1", port: int = 0) -> SiteServer:
    echo = lambda asked: (json.dumps(asked).encode(), "application/json")
    answers = {"echo": echo, "broken": _broken, "no_memory": _no_memory}
    return SiteServer({"": PAGE, "small": b"small"}, answers, TOKEN, host, port)


@pytest.fixture
def running() -> Iterator[SiteServer]:
    server = opened()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    yield server
    server.shutdown()
    server.server_close()
    thread.join()


def connected(server: SiteServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.server_address[1]), timeout=10)


def answered(server: SiteServer, request: bytes) -> bytes:
    """The first line of what comes back before the server closes the connection or stops to send; empty for nothing."""
    with connected(server) as connection:
        came = b""
        try:
            connection.sendall(request)
            connection.shutdown(socket.SHUT_WR)
            while piece := connection.recv(65536):
                came += piece
        except OSError:  # reset: not all of the request was read
            pass
    return came.partition(b"\r\n")[0]


def is_served(port: int) -> bool:
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=10)) as connection:
        connection.request("GET", f"/small?token={TOKEN}")
        return connection.getresponse().read() == b"small"


PORT = b"PORT"  # becomes the server's
HOST = b"Host: 127.0.0.1:PORT\r\nX-Mudg-Token: a-secret-of-the-test\r\n"
OWN = b"Origin: http://127.0.0.1:PORT\r\n"
JSON_HEAD = HOST + OWN + b"Content-Type: application/json\r\n"
BODY = b"Content-Length: 1\r\n\r\n1"
POST = b"POST /echo HTTP/1.1\r\n" + JSON_HEAD
NO_TEXT = b"Host: 127.0.0.1:PORT\r\nX-Mudg-Token: \xff\xfe\r\nCookie: mudg_token=\xff;;\r\n\r\n"
BEHIND = b"Content-Length: 26\r\n\r\nGET /secret HTTP/1.1\r\n\r\n\r\n\r\n"
REQUESTS = {
    "an address that is none": (b"GET http://[/ HTTP/1.1\r\nHost: x\r\n\r\n", b"400"),
    "an address that is none, with the token": (b"GET http://[/ HTTP/1.1\r\n" + HOST + b"\r\n", b"400"),
    "a POST to an address that is none": (b"POST //[x HTTP/1.1\r\n" + HOST + b"Content-Length: 1\r\n\r\n1", b"400|403"),
    "an address of other letters": (b"GET http://\xe2\x84\x80/ HTTP/1.1\r\nHost: x\r\n\r\n", b"400|403"),
    "an origin that is none": (POST.replace(OWN, b"Origin: http://[\r\n") + BODY, b"403"),
    "no origin": (POST.replace(OWN, b"") + BODY, b"403"),
    "a length of 5000 digits": (POST + b"Content-Length: " + b"9" * 5000 + b"\r\n\r\n1", b"400"),
    "a negative length": (POST + b"Content-Length: -1\r\n\r\n1", b"400"),
    "a length with a sign": (POST + b"Content-Length: +1\r\n\r\n1", b"400"),
    "a length in other digits": (POST + "Content-Length: \u00b2".encode("latin-1") + b"\r\n\r\n1", b"400"),
    "two lengths": (POST + b"Content-Length: 1\r\nContent-Length: 2\r\n\r\n12", b"400"),
    "two equal lengths": (POST + b"Content-Length: 1\r\nContent-Length: 1\r\n\r\n1", b"400"),
    "no length": (POST + b"\r\n", b"400"),
    "length and pieces": (POST + b"Content-Length: 1\r\nTransfer-Encoding: chunked\r\n\r\n1", b"400"),
    "a length that is too large": (POST + b"Content-Length: 99999999\r\n\r\n1", b"413"),
    "less than its length": (POST + b"Content-Length: 10\r\n\r\n1", b""),
    "half a letter": (POST + b'Content-Length: 8\r\n\r\n"\\ud800"', b"400"),
    "no JSON": (POST + b"Content-Length: 1\r\n\r\n{", b"400"),
    "deep JSON": (POST + b"Content-Length: 100000\r\n\r\n" + b"[" * 100_000, b"400"),
    "half a request": (b"GET / HT", b"400|"),
    "half a head": (b"GET / HTTP/1.1\r\nHost: 127", b"400|403"),
    "nothing": (b"", b""),
    "zeros": (b"\0" * 1000, b"400|"),
    "TLS": (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\r\n" + b"\xff" * 200, b"400|"),
    "a version of many digits": (b"GET / HTTP/1." + b"1" * 5000 + b"\r\n\r\n", b"400"),
    "a long line": (b"GET /" + b"x" * 70_000 + b" HTTP/1.1\r\n\r\n", b"414|"),
    "a long header": (b"GET / HTTP/1.1\r\nA: " + b"x" * 70_000 + b"\r\n\r\n", b"431|"),
    "many headers": (b"GET / HTTP/1.1\r\n" + b"".join(b"A%d: 1\r\n" % n for n in range(1000)) + b"\r\n", b"431|"),
    "headers without a colon": (b"GET / HTTP/1.1\r\nnonsense\r\n: x\r\n\r\n", b"403"),
    "a token that is no text": (b"GET /?token=%ff%ed%a0%80 HTTP/1.1\r\n" + NO_TEXT, b"403"),
    "an unknown method": (b"BREW / HTTP/1.1\r\n" + HOST + b"\r\n", b"501"),
    "a mistake of ours": (POST.replace(b"/echo", b"/broken") + b"Content-Length: 1\r\n\r\n1", b""),
    "no memory": (POST.replace(b"/echo", b"/no_memory") + b"Content-Length: 1\r\n\r\n1", b"503"),
    "a body behind a GET": (b"GET /small HTTP/1.1\r\n" + HOST + BEHIND, b"200"),
}


@pytest.mark.parametrize("name", REQUESTS)
def test_a_request_that_no_browser_sends_is_answered_or_dropped(
    name: str, running: SiteServer, capfd: pytest.CaptureFixture[str]
) -> None:
    request, statuses = REQUESTS[name]
    line = answered(running, request.replace(PORT, str(running.server_address[1]).encode()))
    assert any((status in line) if status else not line for status in statuses.split(b"|")), line
    assert is_served(running.server_address[1])
    said = capfd.readouterr().err
    assert "Traceback" not in said and "\x1b" not in said
    assert ("a request could not be answered: ZeroDivisionError" in said) == (name == "a mistake of ours")
    assert said.count("\n") == (name == "a mistake of ours")


@pytest.mark.parametrize("moment", ["half a request", "half a body", "loading"])
def test_a_connection_that_is_reset_is_nothing_to_talk_about(
    moment: str, running: SiteServer, capfd: pytest.CaptureFixture[str]
) -> None:
    port = str(running.server_address[1]).encode()
    requests = {
        "half a request": b"GET / HTTP/1.1\r\nHost",
        "half a body": POST + b"Content-Length: 5\r\n\r\n1",
        "loading": b"GET / HTTP/1.1\r\n" + HOST + b"\r\n",
    }
    for _ in range(5):
        with connected(running) as connection:
            connection.sendall(requests[moment].replace(PORT, port))
            if moment == "loading":
                assert connection.recv(1000)
            time.sleep(0.05)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, not an end
    time.sleep(0.3)
    assert is_served(running.server_address[1])
    assert capfd.readouterr().err == ""


def test_who_says_nothing_or_little_is_cut_off(running: SiteServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(served, "HEADERS_S", 0.5)
    monkeypatch.setattr(served, "BODY_S", 0.5)
    port = str(running.server_address[1]).encode()
    begins = [b"", b"GET / HTTP/1.1\r\n", (POST + b"Content-Length: 1000\r\n\r\n1").replace(PORT, port)]
    for begin in begins:
        with connected(running) as connection:
            begun = time.monotonic()
            connection.sendall(begin)
            with contextlib.suppress(ConnectionError):
                while time.monotonic() - begun < 8:  # a letter now and then is not enough
                    connection.sendall(b"1")
                    time.sleep(0.1)
            assert time.monotonic() - begun < 8
    assert is_served(running.server_address[1])


def test_idle_connections_are_bounded_and_others_served(running: SiteServer) -> None:
    before = threading.active_count()
    idle = [connected(running) for _ in range(3 * served.MOST_CONNECTIONS)]
    try:
        assert is_served(running.server_address[1])
        time.sleep(0.5)
        assert threading.active_count() - before <= served.MOST_CONNECTIONS + 2
        assert is_served(running.server_address[1])
    finally:
        for connection in idle:
            connection.close()


FEW_FILES = """
import resource, sys, threading, time
sys.path.insert(0, {tests!r})
import test_view_server
resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
made = test_view_server.opened()
print(made.server_address[1], flush=True)
threading.Thread(target=lambda: (sys.stdin.readline(), made.shutdown())).start()
begun = time.process_time(), time.monotonic()
made.serve_forever()
print((time.process_time() - begun[0]) / (time.monotonic() - begun[1]), flush=True)
"""


def test_a_server_with_few_files_serves_others_and_does_not_spin() -> None:
    """It takes a twentieth of a processor; a loop that accepts again at once takes all of it."""
    script = FEW_FILES.format(tests=str(Path(__file__).parent))
    pipes = {**dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE), "text": True}
    with subprocess.Popen([sys.executable, "-c", script], **pipes) as child:
        port = int(child.stdout.readline())
        idle = []
        try:
            for _ in range(100):
                idle.append(socket.create_connection(("127.0.0.1", port), timeout=10))
            time.sleep(1)
            assert is_served(port)
            child.stdin.write("\n")
            child.stdin.flush()
            assert float(child.stdout.readline()) < 0.5
        finally:
            for one in idle:
                one.close()
        assert child.wait() == 0
        assert "Traceback" not in child.stderr.read()


@pytest.mark.parametrize(
    ("host", "port"), [("127.0.0.1", 70_000), ("127.0.0.1", -1), ("a" * 300, 0), ("", -7), ("999.1.1.1", 0)]
)
def test_an_address_that_cannot_be_is_refused_in_words(host: str, port: int) -> None:
    with pytest.raises(ResourceError, match="cannot listen"):
        opened(host, port)
