"""A small web server for one page on this machine. It serves names from a table, never paths, and answers only to its
own page. What cannot be read is answered with 400 or not at all, who says nothing is cut off, and there are never more
than `MOST_CONNECTIONS`."""

from __future__ import annotations

import contextlib
import errno
import hmac
import ipaddress
import math
import os
import re
import secrets
import socket
import socketserver
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from mudg.base import failures, log, store
from mudg.base.errors import InputError, ResourceError, UsageError

MOST_BYTES: Final = 8 * 2**20
"""Of a request's body."""
COOKIE: Final = "mudg_token"
MOST_CONNECTIONS: Final = 64
HEADERS_S: Final = 30.0
"""Until a connection has sent the head of its next request."""
BODY_S: Final = 120.0
SILENT_S: Final = 30.0
"""Until a connection takes or sends anything at all."""
PAUSE_S: Final = 0.2
"""Before connections are accepted again that the system has refused."""
_PIECE: Final = 2**16
_NO_ROOM: Final = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_LENGTH: Final = re.compile(r"[0-9]{1,9}")
Answer = Callable[[Any], tuple[bytes, str]]
"""From a JSON value to content and its type."""


def token_for(host: str, token: str) -> str:
    """The secret of a page: the given one, or on the loopback address a random one. UsageError: another address without
    a token, or a token that is too short."""
    if not is_loopback(host) and not token:
        what, expected = "this address can be reached by other machines", "127.0.0.1"
        remedy = "leave --host out and use an ssh tunnel, or add --token SECRET"
        raise UsageError(what, where="--host", got=host, expected=expected, remedy=remedy)
    if token and len(token) < 12:
        raise UsageError("the token is too short to be a secret", where="--token", expected="at least 12 characters")
    return token or secrets.token_urlsafe(16)


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class SiteServer(ThreadingHTTPServer):
    """Answers each connection in a thread. Those that only wait are cut off when they are late, or when others need
    their room. It listens at once; ``serve_forever`` is the caller's. ``files``: name -> content; "" is the page.
    ``answers``: name -> what answers a POST with JSON there. ``token``: secret that every request must bring, in the
    address, a cookie or a header. ResourceError: the port is taken, or the address is none of this machine."""

    request_queue_size = MOST_CONNECTIONS
    daemon_threads = True

    def __init__(
        self, files: Mapping[str, bytes], answers: Mapping[str, Answer], token: str, host: str, port: int
    ) -> None:
        self.files, self.answers, self.token = files, answers, token
        self._lock = threading.Lock()
        self._until: dict[socket.socket, float] = {}
        """Connections -> when their patience ends; infinity while they are answered."""
        try:
            super().__init__((host, port), SiteRequest)
        except (OSError, OverflowError, UnicodeError) as error:  # a port, a name that cannot be
            remedy = "choose another --port"
            raise ResourceError("cannot listen", where=f"{host}:{port}", got=str(error), remedy=remedy) from error

    def server_bind(self) -> None:
        """Without the look-up of the machine's name that http.server makes, which may ask the network."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = self.server_address[:2]

    def wait_for(self, connection: socket.socket, seconds: float) -> None:
        """Let a connection be cut off after so long."""
        with self._lock:
            self._until[connection] = time.monotonic() + seconds

    def get_request(self) -> tuple[socket.socket, Any]:
        """The next connection; where the system has no room for it, half of those that wait make room, and nothing
        spins."""
        try:
            return super().get_request()
        except OSError as error:
            if error.errno in _NO_ROOM:
                self._make_room(len(self._until) // 2 + 1)
                time.sleep(PAUSE_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        """Begin to answer a connection, or close it where all others are being answered."""
        full = len(self._until) >= MOST_CONNECTIONS
        if full and not self._make_room(1):
            self.shutdown_request(request)
            return
        self.wait_for(request, HEADERS_S)
        super().process_request(request, client_address)

    def _make_room(self, count: int) -> bool:
        """Cut off so many of the connections that wait, those first whose patience ends first; whether any was."""
        with self._lock:
            waiting = [one for one, until in self._until.items() if until < math.inf]
            self._cut_off(sorted(waiting, key=self._until.__getitem__)[:count])
            return bool(waiting)

    def service_actions(self) -> None:
        """Twice a second: cut off who is late."""
        with self._lock:
            self._cut_off([one for one, until in self._until.items() if until < time.monotonic()])

    def _cut_off(self, connections: Sequence[socket.socket]) -> None:
        for connection in connections:
            del self._until[connection]
            with contextlib.suppress(OSError):  # it has ended already
                connection.shutdown(socket.SHUT_RDWR)

    def close_request(self, request: Any) -> None:
        """Forget a connection."""
        with self._lock:
            self._until.pop(request, None)
        super().close_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """What went wrong, in words; nothing about connections that ended."""
        error = sys.exception()
        if not isinstance(error, ConnectionError | TimeoutError):
            log.warn(f"viewer: a request could not be answered: {type(error).__name__}: {error}")


def show(address: str, port: int, wanted: bool) -> bool:
    """Open a browser, or say how to reach the page from another machine; whether one was opened."""
    graphical = any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY"))) or os.name == "nt"
    graphical = graphical or os.uname().sysname == "Darwin"
    if wanted and graphical and webbrowser.open(address):
        return True
    log.info(f"no browser here. From your own machine: ssh -N -L {port}:127.0.0.1:{port} {os.uname().nodename}")
    return False


class SiteRequest(BaseHTTPRequestHandler):
    """Answers one request."""

    protocol_version = "HTTP/1.1"
    server_version = "mudg"
    sys_version = ""
    timeout = SILENT_S
    server: SiteServer

    def handle_one_request(self) -> None:
        """Read one request in the time that it has, and answer it."""
        self.server.wait_for(self.connection, HEADERS_S)
        super().handle_one_request()

    def do_GET(self) -> None:
        """A file of the site."""
        name = self._name()
        if name is None:
            return
        if name not in self.server.files:
            self._answer(HTTPStatus.NOT_FOUND, b"no such file")
        else:
            kind = "text/html; charset=utf-8" if name in ("", "report.html") else "application/octet-stream"
            self._answer(HTTPStatus.OK, self.server.files[name], kind, cookie=name == "")

    def do_POST(self) -> None:
        """JSON to one of the site's answers."""
        name = self._name()
        if name is None:
            return
        answer, host = self.server.answers.get(name), self.headers.get("Host")
        if self.headers.get("Origin") not in (f"http://{host}", f"https://{host}"):
            self._answer(HTTPStatus.FORBIDDEN, b"a request from another page")
        elif answer is None:
            self._answer(HTTPStatus.NOT_FOUND, b"no such question")
        elif self.headers.get_content_type() != "application/json":
            self._answer(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, b"expected JSON")
        else:
            self._answer_json(answer)

    def _answer_json(self, answer: Answer) -> None:
        lengths = self.headers.get_all("Content-Length", [])
        if len(lengths) != 1 or not _LENGTH.fullmatch(lengths[0]) or "Transfer-Encoding" in self.headers:
            self._answer(HTTPStatus.BAD_REQUEST, b"the request does not say how long it is")
            return
        length = int(lengths[0])
        if length > MOST_BYTES:
            self._answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, b"the request is too large")
            return
        self.server.wait_for(self.connection, BODY_S)
        body = self.rfile.read(length)
        if len(body) < length:  # cut off
            self.close_connection = True
            return
        self.server.wait_for(self.connection, math.inf)
        try:
            self._answer(HTTPStatus.OK, *answer(store.parse_json(body, "request")))
        except (ConnectionError, TimeoutError):  # the page was closed, or wants it no more
            self.close_connection = True
        except Exception as error:
            told = failures.in_words(error)
            if told is None:
                raise
            known = {InputError: HTTPStatus.BAD_REQUEST, ResourceError: HTTPStatus.SERVICE_UNAVAILABLE}
            self._answer(known.get(type(told), HTTPStatus.INTERNAL_SERVER_ERROR), str(told).encode())

    def _name(self) -> str | None:
        """What is asked for; None if the request was refused: it cannot be read, or must not be answered."""
        self.server.wait_for(self.connection, math.inf)
        if self.command != "POST" and ("Content-Length" in self.headers or "Transfer-Encoding" in self.headers):
            self.close_connection = True  # what follows is left unread
        try:
            parts = urlsplit(self.path)
        except ValueError:
            self._answer(HTTPStatus.BAD_REQUEST, b"no address")
            return None
        # a page elsewhere may have pointed its own name here
        host, port = self.server.server_address[:2]
        names = {f"{host}:{port}"} | ({f"localhost:{port}", f"127.0.0.1:{port}"} if is_loopback(str(host)) else set())
        anywhere = str(host) in ("0.0.0.0", "::")  # noqa: S104
        cookies = (part.strip().partition("=") for part in self.headers.get("Cookie", "").split(";"))
        brought = [*parse_qs(parts.query).get("token", []), self.headers.get("X-Mudg-Token", "")]
        brought += [value for name, _, value in cookies if name == COOKIE]
        if self.headers.get("Host", "") not in names and not anywhere:
            self._answer(HTTPStatus.FORBIDDEN, b"this server has another name")
        elif not any(hmac.compare_digest(one.encode(), self.server.token.encode()) for one in brought):
            self._answer(HTTPStatus.FORBIDDEN, b"open the address that mudg view printed: it carries a token")
        else:
            return parts.path.removeprefix("/")
        return None

    def _answer(
        self, status: HTTPStatus, content: bytes, kind: str = "text/plain; charset=utf-8", cookie: bool = False
    ) -> None:
        named = {"Content-Type": kind, "Content-Length": str(len(content))}
        if cookie:
            named["Set-Cookie"] = f"{COOKIE}={self.server.token}; HttpOnly; SameSite=Strict; Path=/"
        if status != HTTPStatus.OK:
            self.close_connection = True  # a body may be left unread
            named["Connection"] = "close"
        self.send_response(status)
        for name, value in {
            **named,
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "X-Frame-Options": "DENY",
        }.items():
            self.send_header(name, value)
        self.end_headers()
        for begin in range(0, len(content), _PIECE):  # each piece has its time
            self.wfile.write(content[begin : begin + _PIECE])

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: a line per request would hide what matters."""
