"""A headless Chromium for tests, spoken to over a pair of pipes (DevTools protocol), with the standard library only."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
NO_BROWSER = "no Chromium is installed"
FLAGS = (
    *("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--ignore-gpu-blocklist", "--remote-debugging-pipe", "--disable-dev-shm-usage", "--no-first-run"),
    *("--disable-extensions", "--disable-background-networking", "--hide-scrollbars", "--mute-audio"),
)


class BrowserError(Exception):
    """What the page threw, or an answer that did not come."""


class Browser:
    """One page of one browser, in a ``with``; a test is skipped where there is none. ``errors`` collects what it writes
    to its console as errors, and what it throws."""

    def __init__(
        self, profile: Path, size: tuple[int, int] = (960, 640), scale: float = 1.0, dark: bool = False
    ) -> None:
        if CHROMIUM is None:
            pytest.skip(NO_BROWSER)
        ours, theirs = os.pipe(), os.pipe()  # what it reads, what it writes
        address = [f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}", "about:blank"]
        plumbing = f'exec "$@" 3<&{ours[0]} 4>&{theirs[1]}'  # the protocol's pipes have fixed numbers
        self.process = subprocess.Popen(
            ["bash", "-c", plumbing, "bash", str(CHROMIUM), *FLAGS, *address],
            pass_fds=(ours[0], theirs[1]),
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        os.close(ours[0])
        os.close(theirs[1])
        self._out, self._in, self._buffer, self._id = ours[1], theirs[0], b"", 0
        self.errors: list[str] = []
        self.session: str | None = None
        self.requests: list[str] = []
        os.set_blocking(self._in, False)
        target = next(t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page")
        self.session = self.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=size[0],
            height=size[1],
            deviceScaleFactor=scale,
            mobile=size[0] < 600,
        )
        if dark:
            self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])

    def call(self, method: str, timeout_s: float = 120.0, **parameters: Any) -> dict[str, Any]:
        """One command of the protocol; its result."""
        self._id += 1
        message = {"id": self._id, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            answer = self._next()
            if answer is None:
                time.sleep(0.005)
            elif answer.get("id") == self._id:
                if "error" in answer:
                    raise BrowserError(f"{method}: {answer['error']['message']}")
                return answer["result"]
            else:
                self._note(answer)
        raise BrowserError(f"{method}: no answer within {timeout_s:g} s")

    def _next(self) -> dict[str, Any] | None:
        while b"\0" not in self._buffer:
            try:
                part = os.read(self._in, 1 << 20)
            except BlockingIOError:
                return None
            if not part:
                raise BrowserError("the browser has ended")
            self._buffer += part
        text, self._buffer = self._buffer.split(b"\0", 1)
        return json.loads(text)

    def _note(self, event: dict[str, Any]) -> None:
        what, given = event.get("method"), event.get("params", {})
        if what == "Runtime.exceptionThrown":
            details = given["exceptionDetails"]
            self.errors.append(details.get("exception", {}).get("description", details["text"]))
        elif what == "Runtime.consoleAPICalled" and given["type"] in ("error", "assert"):
            self.errors.append(" ".join(str(a.get("value", a.get("description"))) for a in given["args"]))
        elif what == "Log.entryAdded" and given["entry"]["level"] == "error":
            self.errors.append(f"{given['entry']['text']} {given['entry'].get('url', '')[:80]}")
        elif what == "Network.requestWillBeSent" and not given["request"]["url"].startswith("data:"):
            self.requests.append(given["request"]["url"])

    def open(
        self, address: str, ready: str = "document.documentElement?.dataset.ready === 'yes'", timeout_s: float = 60
    ) -> None:
        """Go to an address and wait until an expression is true there."""
        self.call("Page.navigate", url=address)
        self.wait(ready, timeout_s)

    def wait(self, expression: str, timeout_s: float = 60) -> None:
        """Wait until an expression is true on the page."""
        end = time.monotonic() + timeout_s
        while time.monotonic() < end:
            if self.run(expression):
                return
            problem = self.run("document.documentElement?.dataset?.problem ?? ''")
            if problem:
                raise BrowserError(problem)
            time.sleep(0.05)
        raise BrowserError(f"not true within {timeout_s:g} s: {expression}; {self.errors}")

    def run(self, expression: str, timeout_s: float = 180) -> Any:
        """The value of an expression on the page; promises are awaited."""
        answer = self.call("Runtime.evaluate", timeout_s, expression=expression, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            details = answer["exceptionDetails"]
            raise BrowserError(details.get("exception", {}).get("description", details["text"]))
        return answer["result"].get("value")

    def picture(self, path: Path) -> None:
        """A screenshot as PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def measure(self, layers: Sequence[str], **where: Any) -> dict[str, NDArray[Any]]:
        """``App.measure``: colours u8[H, W, 4], class ids u8[H, W], sums of other layers f32[H, W, 4]."""
        found = self.run(f"window.mudg.measure({json.dumps({**where, 'layers': list(layers)})})")
        size = found["height"], found["width"], 4
        made = {}
        for name, text in found["values"].items():
            kind = np.uint8 if name in ("color", "class") else np.float32
            values = np.frombuffer(base64.b64decode(text), kind).reshape(size)
            made[name] = values[..., 0] if name == "class" else values
        return made

    def __enter__(self) -> Browser:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the browser and wait for it."""
        for fd in (self._out, self._in):
            os.close(fd)
        self.process.terminate()
        self.process.wait(20)
