"""Videos of the exact frames by ``mudg view``: what they show, who may ask, how one is cancelled."""

from __future__ import annotations

import base64
import io
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from browser import Browser
from toy_fitted import STREET, write_toy_run
from view_server import ask, begin, serving

from mudg.base.errors import InputError, ResourceError
from mudg.base.types import View
from mudg.core.trajectory import at_shift
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import raster_of, render_view
from mudg.scene.read import read_scene
from mudg.viewer import live as frames
from mudg.viewer.live import FrameSource, VideoRequest

Toy = tuple[Path, Path, SceneModel]


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Toy:
    root = tmp_path_factory.mktemp("video")
    _, fit, _, model = write_toy_run(root)
    return root, fit, model


@pytest.fixture(scope="module")
def served(toy: Toy) -> Iterator[tuple[int, str]]:
    with serving(toy[1], toy[0] / "scene") as found:
        yield found


def question(times_s: tuple[float, ...] = (0.0, 0.2, 0.4), **changes: Any) -> dict[str, Any]:
    """A video of the front camera."""
    views = [STREET.view(t, 160, 96) for t in times_s]
    camera = views[0].camera
    lens = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    what = {"scene": 0, "layer": "color", "hidden": [], "edits": "", "camera": "front", "fps": 10}
    return {**what, **lens, "moments": [moment(v) for v in views], **changes}


def moment(view: View) -> dict[str, Any]:
    pose = view.world_from_cam
    return {"time_s": view.time_s, "eye": pose[:3, 3].tolist(), "axes": pose[:3, :3].T.tolist()}


def pictures(content: bytes) -> list[np.ndarray]:
    with av.open(io.BytesIO(content)) as container:
        assert container.streams.video[0].average_rate == 10
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def split(answer: bytes) -> tuple[list[dict[str, int]], bytes]:
    """Lines of an answer, and the file after them."""
    lines = []
    while not lines or "bytes" not in lines[-1]:
        line, answer = answer.split(b"\n", 1)
        lines.append(json.loads(line))
    return lines, answer


def allowed(port: int, token: str) -> dict[str, str]:
    return {"X_Mudg_Token": token, "Origin": f"http://127.0.0.1:{port}"}


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(np.square(a / 255.0 - b).mean()))


@contextmanager
def shown(port: int, address: str, folder: Path) -> Iterator[Browser]:
    """A browser with the page of a server, without errors to the end."""
    with Browser(folder / "profile", size=(700, 500)) as one:
        one.open(f"http://127.0.0.1:{port}/?token={address}")
        yield one
        assert one.errors == []


def test_a_video_shows_what_the_rasterizer_draws(served: tuple[int, str], toy: Toy) -> None:
    port, token = served
    status, answer = ask(port, "POST", "/video", question(), **allowed(port, token))
    assert status == 200
    lines, content = split(answer)
    assert lines == [{"frame": k, "frames": 3} for k in (1, 2, 3)] + [{"bytes": len(content)}]
    for seen, t in zip(pictures(content), (0.0, 0.2, 0.4), strict=True):
        true = render_view(toy[2], STREET.view(t, 160, 96), raster_of(toy[2])).rgb.permute(1, 2, 0).numpy()
        assert psnr(seen, true) > 32  # of 4:2:0
    assert {path.name for path in toy[0].iterdir()} == {"scene", "fit"}


def test_a_video_follows_edits_and_what_is_hidden(served: tuple[int, str], toy: Toy) -> None:
    port, token = served
    script = "- move: {id: car-1, left_m: 3}\n"

    def last(**changes: Any) -> np.ndarray:
        status, answer = ask(port, "POST", "/video", question((0.4,), layer="class", **changes), **allowed(port, token))
        assert status == 200
        return pictures(split(answer)[1])[-1].astype(int)

    plain, moved, hidden = last(), last(edits=script), last(hidden=["car-1"])
    assert np.abs(plain - moved).max() > 60
    assert np.abs(plain - hidden).max() > 60
    assert np.abs(hidden - moved).max() > 60


def test_a_video_is_made_for_the_page_alone(served: tuple[int, str]) -> None:
    port, token = served
    own = f"http://127.0.0.1:{port}"
    assert ask(port, "POST", "/video", question(), Origin=own)[0] == 403
    assert ask(port, "POST", "/video", question(), X_Mudg_Token="wrong", Origin=own)[0] == 403
    assert ask(port, "POST", "/video", question(), X_Mudg_Token=token)[0] == 403
    assert ask(port, "POST", "/video", question(), X_Mudg_Token=token, Origin="https://evil.example")[0] == 403
    assert ask(port, "GET", f"/video?token={token}")[0] == 404


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"moments": []}, "moments"),
        ({"moments": question()["moments"] * 1001}, "moments"),
        ({"moments": [{"time_s": 0.0, "eye": [0, 0], "axes": []}]}, "eye"),
        ({"fps": 0}, "fps"),
        ({"layer": "normal"}, "layer"),
        ({"out": "/tmp/x.mp4"}, "out"),
        ({"edits": "- jump: {}\n"}, "verb"),
        ({"width": 8192, "height": 8192, "moments": question()["moments"] * 500}, "too large"),
    ],
)
def test_a_wrong_question_is_told(toy: Toy, changes: dict[str, Any], told: str) -> None:
    with serving(toy[1], toy[0] / "scene", width_px=8192) as (port, token):
        status, text = ask(port, "POST", "/video", question(**changes), **allowed(port, token))
    assert status == 400
    assert told in text.decode()


def test_one_video_is_made_at_a_time(toy: Toy) -> None:
    source = FrameSource(lambda _: [toy[2]], read_scene(toy[0] / "scene"), 1600, torch.device("cpu"))
    begun, go_on, told = threading.Event(), threading.Event(), list[bytes]()

    def slow(content: bytes) -> None:
        told.append(content)
        begun.set()
        assert go_on.wait(30)

    asked = VideoRequest(**question())
    first = threading.Thread(target=source.film, args=(asked, slow))
    first.start()
    assert begun.wait(30)
    with pytest.raises(ResourceError, match="another video"):
        source.film(asked, lambda _: None)
    go_on.set()
    first.join(30)
    assert len(pictures(told[-1])) == 3
    source.film(asked, lambda _: None)  # the next one may begin


def test_a_video_that_nobody_waits_for_is_given_up(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, real = list[float](), frames.render_view

    def noted(*given: Any) -> Any:
        drawn.append(time.monotonic())
        time.sleep(0.02)
        return real(*given)

    monkeypatch.setattr(frames, "render_view", noted)
    with serving(toy[1], toy[0] / "scene") as (port, token):
        long = question(tuple(0.001 * k for k in range(700)))
        connection, answer = begin(port, "POST", "/video", long, **allowed(port, token))
        assert json.loads(answer.readline()) == {"frame": 1, "frames": 700}
        answer.close()
        assert connection.sock is None or connection.sock.shutdown(socket.SHUT_RDWR) is None
        connection.close()
        end = time.monotonic() + 60
        while time.monotonic() < end:  # it is refused until the first one has noticed
            status, text = ask(port, "POST", "/video", question(), **allowed(port, token))
            if status == 200:
                break
            assert status == 503 and b"another video" in text
            time.sleep(0.1)
    assert len(pictures(split(text)[1])) == 3
    assert len(drawn) < 500


def test_a_problem_on_the_way_is_told_in_the_answer(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    real = frames.render_view

    def breaking(model: SceneModel, view: Any, raster: Any) -> Any:
        if view.time_s > 0.3:
            raise InputError("this moment cannot be drawn")
        return real(model, view, raster)

    monkeypatch.setattr(frames, "render_view", breaking)
    with serving(toy[1], toy[0] / "scene") as (port, token):
        status, answer = ask(port, "POST", "/video", question(), **allowed(port, token))
    lines = [json.loads(line) for line in answer.splitlines()]
    assert status == 200
    assert [set(line) for line in lines] == [{"frame", "frames"}, {"frame", "frames"}, {"problem"}]
    assert "cannot be drawn" in lines[-1]["problem"]


KEEP = """window.saved = []; const real = URL.createObjectURL;
URL.createObjectURL = (blob) => { if (blob.type === 'video/mp4') window.saved.push(blob); return real(blob); }; 1"""
SAVED = """saved[0].arrayBuffer().then((b) => { let text = '';
  for (const v of new Uint8Array(b)) text += String.fromCharCode(v); return btoa(text); })"""
CLICK = "document.getElementById('mp4').click()"


@pytest.mark.slow
def test_the_page_saves_a_video_and_cancels_one(toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(toy[1], toy[0] / "scene") as (port, token):
        with shown(port, f"{token}#m=recorded&c=front&t=0.2&s=1.5", tmp_path) as one:
            one.run(KEEP)
            one.run(f"{CLICK}; 1")
            one.wait("window.saved.length === 1")
            content = base64.b64decode(one.run(SAVED))
            assert one.run("document.getElementById('note').textContent").startswith("Saved toy-street_color_0.20s.mp4")
            seen = pictures(content)
            assert len(seen) == 9  # 0.8 s, 10 per second
            views = {round(v.time_s, 3): v for v in at_shift(read_scene(toy[0] / "scene"), "front", 1.5).views}
            for k in (0, 2, 8):
                true = render_view(toy[2], views[round(0.1 * k, 3)], raster_of(toy[2])).rgb.permute(1, 2, 0).numpy()
                assert psnr(seen[k], true) > 32
            begun, go_on, real = list[int](), threading.Event(), frames.render_view

            def held(*given: Any) -> Any:
                begun.append(1)
                assert len(begun) < 3 or go_on.wait(60)
                return real(*given)

            monkeypatch.setattr(frames, "render_view", held)
            one.run(f"{CLICK}; 1")
            # exact frames count, too
            one.wait("/^Cancel \\([0-2] of 9 frames\\)$/.test(document.getElementById('mp4').textContent)")
            one.run(f"{CLICK}; 1")
            one.wait("document.getElementById('note').textContent === 'The video was cancelled.'")
            go_on.set()
            assert one.run("[saved.length, document.getElementById('mp4').textContent]") == [1, "Exact video (MP4)"]
            one.run("mudg.change({layer: 'normal'}); 1")
            assert one.run("document.getElementById('mp4').disabled")


PIXELS = """(() => { const {area} = mudg.last;
  const c = document.createElement('canvas'), x = c.getContext('2d'); c.width = 64; c.height = 32;
  x.drawImage(SOURCE, 0, 0, 64, 32); return [...x.getImageData(0, 0, 64, 32).data].filter((_, k) => k % 4 < 3); })()"""


def drawn(page: Browser, source: str) -> np.ndarray:
    """A picture of the page, small, f64[32, 64, 3]."""
    return np.array(page.run(PIXELS.replace("SOURCE", source)), float).reshape(32, 64, 3)


@pytest.mark.slow
def test_exact_frames_are_compared_with_what_they_are_compared_with(toy: Toy, tmp_path: Path) -> None:
    canvas = "document.getElementById('canvas'), ...mudg.last.area"
    with serving(toy[1], toy[0] / "scene", compare=toy[1], images=5) as (port, token):
        with shown(port, f"{token}#m=recorded&c=front&t=0.4&v=divider-recorded&d=0", tmp_path) as one:
            one.wait("!document.getElementById('exact').hidden")
            photograph = drawn(one, "mudg.image(mudg.drive.nearestFrame('front', 0.4))")
            assert np.abs(drawn(one, canvas)[:, 4:] - photograph[:, 4:]).mean() < 6
            one.run("mudg.change({divider: 1}); 1")
            one.wait("!document.getElementById('exact').hidden")
            assert np.abs(drawn(one, canvas) - photograph).mean() > 12
            one.run("mudg.change({compare: 'difference-scene'}); 1")  # the same fit twice
            one.wait("!document.getElementById('exact').hidden")
            assert one.run("mudg.exact.images.length") == 2
            assert drawn(one, canvas).max() == 0
