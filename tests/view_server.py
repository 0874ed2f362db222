"""The server of ``mudg view`` for tests: running in a thread, and asked over HTTP; what it shows as numbers."""

from __future__ import annotations

import http.client
import io
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

from mudg.base.types import View
from mudg.viewer import view
from mudg.viewer.page import ViewerPage
from mudg.viewer.settings import ViewConfig


def seen_from(view: View) -> dict[str, object]:
    """A view as the page and its server name it: size, lens, place and axes."""
    camera, pose = view.camera, view.world_from_cam
    lens = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return {**lens, "eye": pose[:3, 3].tolist(), "axes": pose[:3, :3].T.tolist()}


def question(view: View, **changes: object) -> dict[str, object]:
    """What the page asks where it wants a frame in colour from a view."""
    asked = {"scene": 0, "layer": "color", "hidden": [], "time_s": view.time_s, "camera": view.camera.name}
    return {**asked, **seen_from(view), **changes}


def colors_in(content: bytes) -> np.ndarray:
    """Colours of a picture file, 0 to 1, f64[H, W, 3]."""
    return np.asarray(Image.open(io.BytesIO(content))) / 255.0


def whole_page(page: ViewerPage) -> bytes:
    """A page of one file."""
    facts: dict[str, object] = {}
    files = list(page.files(facts))
    return page.one_file(files, facts)


def allowed(port: int, token: str, host: str = "127.0.0.1") -> dict[str, str]:
    """Headers of a request that the server answers."""
    return {"X_Mudg_Token": token, "Origin": f"http://{host}:{port}", "Host": f"{host}:{port}"}


@contextmanager
def serving(
    fit: Path, scene: Path, compare: Path | None = None, edits: tuple[Path, Path] | tuple[()] = (), **settings: object
) -> Iterator[tuple[int, str]]:
    """Port and token of a server of a fit. ``edits``: script that the page begins with, and where edits are saved."""
    config = ViewConfig(**{"images": 0, "browser": False, "device": "cpu", **settings})
    server = view.server_of(config, fit, compare, scene, *edits)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield server.server_address[1], server.token
    finally:
        server.shutdown()
        server.server_close()


def ask(port: int, method: str, path: str, body: object = None, **headers: str) -> tuple[int, bytes]:
    """Status and content of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    named = {"Content-Type": "application/json", **{name.replace("_", "-"): value for name, value in headers.items()}}
    try:
        connection.request(method, path, None if body is None else json.dumps(body), named)
        with connection.getresponse() as answer:
            return answer.status, answer.read()
    finally:
        connection.close()
