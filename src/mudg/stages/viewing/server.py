"""A small web server for one page on this machine. It serves names from a table, never paths, and answers only to its own page."""

from __future__ import annotations

import hmac
import ipaddress
import os
import secrets
import webbrowser
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from mudg.base import log, store
from mudg.base.errors import InputError, MudgError, ResourceError, UsageError

MOST_BYTES: Final = 8 * 2**20
"""Of a request's body."""
COOKIE: Final = "mudg_token"
Answer = Callable[[Any], tuple[bytes, str]]
"""From a JSON value to content and its type."""
Stream = Callable[[Any, Callable[[bytes], None]], None]
"""From a JSON value to content that is sent piece by piece while it is made. Sending raises OSError when nobody listens any more."""
TYPES: Final = {"html": "text/html; charset=utf-8", "bin": "application/octet-stream"}


@dataclass(frozen=True)
class Site:
    """What is served.

    Args:
        files: name -> content; "" is the page. answers: name -> what answers a POST with JSON there: bytes and their type.
        streams: the same for answers that take long. token: secret that every request must bring, in the address, a cookie or a header.
    """

    files: Mapping[str, bytes]
    answers: Mapping[str, Answer]
    token: str
    streams: Mapping[str, Stream] = field(default_factory=dict)


def token_for(host: str, token: str) -> str:
    """The secret of a page: the given one, or on the loopback address a random one.

    Raises:
        UsageError: another address without a token, or a token that is too short.
    """
    if not is_loopback(host) and not token:
        raise UsageError("this address can be reached by other machines", where="--host", got=host, expected="127.0.0.1",
                         remedy="leave --host out and use an ssh tunnel, or add --token SECRET")  # fmt: skip
    if token and len(token) < 12:
        raise UsageError("the token is too short to be a secret", where="--token", expected="at least 12 characters")
    return token or secrets.token_urlsafe(16)


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def open_server(site: Site, host: str, port: int) -> ThreadingHTTPServer:
    """A server that listens; ``serve_forever`` is the caller's.

    Raises:
        ResourceError: the port is taken, or the address is none of this machine.
    """
    try:
        server = ThreadingHTTPServer((host, port), type("OwnSiteRequest", (SiteRequest,), {"site": site}))
    except OSError as error:
        raise ResourceError(
            "cannot listen", where=f"{host}:{port}", got=str(error), remedy="choose another --port"
        ) from error
    server.daemon_threads = True
    return server


def address_of(server: ThreadingHTTPServer, site: Site) -> str:
    """Address of the page."""
    host, port = server.server_address[:2]
    return f"http://{host!s}:{port}/?token={site.token}"


def show(address: str, port: int, wanted: bool) -> bool:
    """Open a browser, or say how to reach the page from another machine; whether one was opened."""
    graphical = (
        os.environ.get("DISPLAY")
        or os.environ.get("WAYLAND_DISPLAY")
        or os.name == "nt"
        or os.uname().sysname == "Darwin"
    )
    if wanted and graphical and webbrowser.open(address):
        return True
    log.info(f"no browser here. From your own machine: ssh -N -L {port}:127.0.0.1:{port} {os.uname().nodename}")
    return False


class SiteRequest(BaseHTTPRequestHandler):
    """Answers one request. ``site`` is set by ``open_server``."""

    site: Site
    protocol_version = "HTTP/1.1"
    server_version = "mudg"
    sys_version = ""

    def do_GET(self) -> None:
        """A file of the site."""
        parts = urlsplit(self.path)
        name = parts.path.removeprefix("/")
        if self._refused(parse_qs(parts.query)):
            return
        content = self.site.files.get(name)
        if content is None:
            self._answer(HTTPStatus.NOT_FOUND, b"no such file")
            return
        self._answer(HTTPStatus.OK, content, TYPES["html" if name in ("", "report.html") else "bin"], cookie=name == "")

    def do_POST(self) -> None:
        """JSON to one of the site's answers."""
        parts = urlsplit(self.path)
        name = parts.path.removeprefix("/")
        answer, stream = self.site.answers.get(name), self.site.streams.get(name)
        origin = self.headers.get("Origin")
        if self._refused(parse_qs(parts.query)):
            return
        if origin is None or urlsplit(origin).netloc != self.headers.get("Host"):
            self._answer(HTTPStatus.FORBIDDEN, b"a request from another page")
        elif answer is None and stream is None:
            self._answer(HTTPStatus.NOT_FOUND, b"no such question")
        elif self.headers.get_content_type() != "application/json":
            self._answer(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, b"expected JSON")
        else:
            self._answer_json(answer, stream)

    def _answer_json(self, answer: Answer | None, stream: Stream | None) -> None:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MOST_BYTES:
            self._answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, b"the request is too large")
            return
        sent: list[int] = []
        try:
            asked = store.parse_json(self.rfile.read(int(length)), "request")
            if answer is not None:
                self._answer(HTTPStatus.OK, *answer(asked))
            elif stream is not None:
                stream(asked, lambda content: self._send(content, sent))
        except ConnectionError:  # the page was closed, or wants it no more
            self.close_connection = True
        except MudgError as error:
            self._tell(error, begun=bool(sent))

    def _tell(self, error: MudgError, begun: bool) -> None:
        """Answer with a problem; after the first piece of a stream, as a line of it."""
        if begun:
            self.wfile.write(store.json_text({"problem": str(error)}, indent=None).encode() + b"\n")
            return
        known = {InputError: HTTPStatus.BAD_REQUEST, ResourceError: HTTPStatus.SERVICE_UNAVAILABLE}
        self._answer(known.get(type(error), HTTPStatus.INTERNAL_SERVER_ERROR), str(error).encode())

    def _send(self, content: bytes, sent: list[int]) -> None:
        """A piece of a stream; the first one begins the answer, which ends with the connection."""
        if not sent:
            self.close_connection = True
            self._head(HTTPStatus.OK, {"Content-Type": TYPES["bin"], "Connection": "close"})
        sent.append(len(content))
        self.wfile.write(content)

    def _refused(self, query: Mapping[str, list[str]]) -> bool:
        """Whether the request was refused: another name for this server (a page elsewhere whose name was pointed here), or no token."""
        host, port = self.server.server_address[:2]  # type: ignore[misc]
        names = {f"{host}:{port}"} | ({f"localhost:{port}", f"127.0.0.1:{port}"} if is_loopback(str(host)) else set())
        given = self.headers.get("Host", "")
        if given not in names and (is_loopback(str(host)) or str(host) not in ("0.0.0.0", "::")):  # noqa: S104
            self._answer(HTTPStatus.FORBIDDEN, b"this server has another name")
            return True
        brought = [
            *query.get("token", []),
            self.headers.get("X-Mudg-Token", ""),
            *_cookies(self.headers.get("Cookie", "")),
        ]
        if not any(hmac.compare_digest(one.encode(), self.site.token.encode()) for one in brought):
            self._answer(HTTPStatus.FORBIDDEN, b"open the address that mudg view printed: it carries a token")
            return True
        return False

    def _answer(
        self, status: HTTPStatus, content: bytes, kind: str = "text/plain; charset=utf-8", cookie: bool = False
    ) -> None:
        named = {"Content-Type": kind, "Content-Length": str(len(content))}
        if cookie:
            named["Set-Cookie"] = f"{COOKIE}={self.site.token}; HttpOnly; SameSite=Strict; Path=/"
        if status != HTTPStatus.OK:
            self.close_connection = True  # a body may be left unread
            named["Connection"] = "close"
        self._head(status, named)
        self.wfile.write(content)

    def _head(self, status: HTTPStatus, named: Mapping[str, str]) -> None:
        self.send_response(status)
        for name, value in {
            **named, "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin", "X-Frame-Options": "DENY",
        }.items():  # fmt: skip
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: a line per request would hide what matters."""


def _cookies(text: str) -> list[str]:
    pairs = (part.strip().partition("=") for part in text.split(";"))
    return [value for name, _, value in pairs if name == COOKIE]
