"""The viewer page: what is packed, what a browser draws of it, who may ask the server behind it."""

from __future__ import annotations

import base64
import gzip
import hashlib
import http.server
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import Browser, BrowserError
from refusals import refused
from toy_fitted import STREET, toy_fitted, write_toy_run
from view_server import allowed, ask, colors_in, question, serving, whole_page

from mudg import FittedScene
from mudg.base.errors import UsageError
from mudg.base.palette import ID
from mudg.base.types import Camera, View
from mudg.core.trajectory import at_shift
from mudg.editing.script import read_edits
from mudg.formats.paths import read_path
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import raster_of, render_view
from mudg.gaussians.storage import save_model
from mudg.scene.read import read_scene
from mudg.viewer import page as viewer_page
from mudg.viewer import view
from mudg.viewer.page import BLOCK, blob_of, coverage, level_of, opacity_of, pack_scene, packed_turns
from mudg.viewer.server import token_for
from mudg.viewer.settings import PageConfig
from mudg.viewer.view import GROUND

Toy = tuple[Path, Path, SceneModel]


# what is packed -----------------------------------------------------------------------------------


def rotations(codes: np.ndarray) -> np.ndarray:
    """Unit quaternions of ``packed_turns``, as the page unpacks them."""
    small = np.stack([(codes >> shift & 1023).astype(float) - 512 for shift in (0, 10, 20)], 1) / (511 * np.sqrt(2))
    absent = codes >> 30
    whole = np.empty((len(codes), 4))
    for index in range(4):
        here = absent == index
        whole[here] = np.insert(small[here], index, np.sqrt(np.maximum(0, 1 - np.square(small[here]).sum(1))), axis=1)
    return whole


def test_rotations_sections_and_json_of_a_page() -> None:
    quats = np.random.default_rng(0).normal(size=(2000, 4))
    quats[0] = (0, 0, 0, -3)
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    apart = 2 * np.arccos(np.clip(np.abs((rotations(packed_turns(quats)) * unit).sum(1)), 0, 1))
    assert np.degrees(apart).max() < 0.25
    blob, directory = blob_of({"a": np.arange(3, dtype=np.uint8), "b": np.arange(2, dtype=np.float32)})
    assert directory == {"a": [0, "u1", 3], "b": [4, "f4", 2]}
    assert np.frombuffer(blob, np.float32, 2, 4).tolist() == [0, 1]
    text = viewer_page.script_json({"name": "</script><script>alert(1)</script><!--"})
    assert "<" not in text and ">" not in text
    assert json.loads(text)["name"].startswith("</script>")


def test_places_and_sizes_are_kept_within_their_steps() -> None:
    model = toy_fitted(degree=3)
    packed = pack_scene(model, 0.0)
    s, _ = packed.chunk(0)
    opacity = torch.sigmoid(model.table["logits"].detach()).numpy()
    assert packed.kept == len(s["certainty"]) == (opacity >= 1 / 255).sum()
    levels = (s["position"][:3].astype(np.int64) | s["position"][3:].astype(np.int64) << 8).T
    starts = np.repeat(s["block"], s["block_of"][:, 1], axis=0)
    means = starts[:, :3] + levels * starts[:, 3:6]
    sizes = starts[:, 6:9] + s["scale"].T * starts[:, 9:]
    node = np.repeat(s["block_of"][:, 0], s["block_of"][:, 1])
    true = model.table["means"].detach().numpy()
    for row in range(0, packed.kept, 37):
        own = np.flatnonzero((model.table.labels["node"].numpy() == node[row]) & (opacity >= 1 / 255))
        nearest = own[np.abs(true[own] - means[row]).max(1).argmin()]
        assert np.abs(true[nearest] - means[row]).max() < 1e-3
        assert np.abs(model.table["log_scales"][nearest].detach().numpy() - sizes[row]).max() < 0.02
    assert s["block_of"][:, 1].max() <= BLOCK
    assert s["harmonics"].shape == (45, packed.kept)


def test_a_budget_keeps_what_the_path_sees_largest() -> None:
    model = toy_fitted(degree=0)
    packed = pack_scene(model, 0.0, np.array([[0.0, 0, 1.2]]), most=200)
    assert (packed.kept, packed.layout.given) == (200, len(model.table))
    worth = coverage(columns_of(model), model.table.labels["node"].numpy(), np.array([[0.0, 0, 1.2]]))
    drawn = opacity_of(columns_of(model)["logits"]) >= 1 / 255
    left_out = np.setdiff1d(np.flatnonzero(drawn), packed.layout.rows)
    assert worth[left_out].max() <= worth[packed.layout.rows].min()
    assert packed.layout.lost == pytest.approx(worth[left_out].sum() / worth[drawn].sum())
    assert packed.layout.visible == drawn.sum()


def columns_of(model: SceneModel) -> dict[str, np.ndarray]:
    return {name: value.detach().numpy() for name, value in model.table.columns.items()}


def test_every_gaussian_is_in_one_chunk_and_the_first_ones_matter_most() -> None:
    model, size = toy_fitted(degree=1), 64
    path = np.array([[0.0, 0, 1.2], [4.0, 0, 1.2]])
    packed = pack_scene(model, 0.0, path, chunk_rows=size)
    drawn = np.flatnonzero(opacity_of(columns_of(model)["logits"]) >= 1 / 255)
    chunks = [packed.layout.chunk(k) for k in range(len(packed.layout))]
    assert np.array_equal(np.sort(np.concatenate(chunks)), drawn)
    assert [len(c) for c in chunks[:-1]] == [size] * (len(chunks) - 1)
    assert 0 < len(chunks[-1]) <= size
    assert [level_of(k) for k in range(8)] == [0, 1, 1, 2, 2, 2, 2, 3]
    worth = coverage(columns_of(model), model.table.labels["node"].numpy(), path)
    of_level = lambda n: [c for k, c in enumerate(chunks) if level_of(k) == n]
    levels = [np.concatenate(of_level(n)) for n in range(level_of(len(chunks) - 1) + 1)]
    for one, following in zip(levels, levels[1:]):
        assert worth[one].min() >= worth[following].max()


def test_colours_and_displacements_are_kept_within_their_steps() -> None:
    model = toy_fitted(degree=0)
    packed = pack_scene(model, 0.0)
    (sections, _), rows = packed.chunk(0), packed.layout.chunk(0)
    red, green, blue, opacity = sections["color"]
    levels = np.stack([red + green, green, blue + green], 1) / 255.0  # of bytes: modulo 256
    span = packed.facts["color_high"] - packed.facts["color_low"]
    true = np.clip(columns_of(model)["sh_dc"][rows, 0] * 0.28209479177387814 + 0.5, 0, packed.facts["color_high"])
    assert np.abs(packed.facts["color_low"] + span * levels - true).max() <= span / 510 + 1e-6
    assert np.abs(opacity / 255.0 - opacity_of(columns_of(model)["logits"])[rows]).max() <= 1 / 510 + 1e-6
    (person,) = (node for node in model.nodes if node.kind == "deformable")
    grid = person.offsets["deform"].detach().numpy().reshape(-1)
    assert np.abs(packed.facts["deform_step"] * packed.sections["deform"] - grid).max() <= 0.51e-4


def test_more_than_a_page_holds_is_refused() -> None:
    refused("--budget", pack_scene, toy_fitted(degree=0), 0.0, chunk_rows=2, raises=UsageError)


# the page -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Toy:
    """Scene, fit and page folders of the toy."""
    root = tmp_path_factory.mktemp("viewer")
    scene, fit, _, model = write_toy_run(root)
    made = view.run_page(PageConfig(), fit, root / "page.html", scene=scene, compare=fit)
    assert made["bytes"] == (root / "page.html").stat().st_size
    return root, fit, model


def test_the_page_names_no_place_of_this_machine_and_is_not_replaced_without_being_asked(toy: Toy) -> None:
    text = (toy[0] / "page.html").read_text(encoding="utf-8")
    assert str(toy[0]) not in text
    assert "http://" not in text and "https://" not in text
    assert "<script>alert" not in text
    with pytest.raises(UsageError, match="exists"):
        view.run_page(PageConfig(), toy[1], toy[0] / "page.html", scene=toy[0] / "scene")
    with pytest.raises(UsageError, match="scene of this fit is not known"):
        view.run_page(PageConfig(), toy[1], toy[0] / "other.html")


def folder_page(
    toy: Toy, root: Path, monkeypatch: pytest.MonkeyPatch, config: PageConfig | None = None
) -> tuple[Path, dict[str, Any]]:
    """A page in a folder with chunks of 64 Gaussians, and its facts."""
    monkeypatch.setattr(view, "ONE_FILE_BYTES", 1000)
    monkeypatch.setattr(view, "CHUNK", 64)
    settings = config or PageConfig(images=3)
    made = view.run_page(settings, toy[1], root / "page.html", scene=toy[0] / "scene", overwrite=True)
    assert made["page"] == root / "page_page" / "index.html"
    text = made["page"].read_text(encoding="utf-8")
    found = re.search(r'<script type="application/json" id="facts">(.*?)</script>', text, re.DOTALL)
    return made["page"].parent, json.loads(found[1])


def test_a_large_page_becomes_a_folder_whose_files_it_knows(
    toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "page.html").write_text("an older page")
    folder, facts = folder_page(toy, tmp_path, monkeypatch)
    (scene,) = facts["scenes"]
    assert len(scene["chunks"]) > 10
    assert sum(chunk["rows"] for chunk in scene["chunks"]) == scene["rows"]
    records = [one["file"] for one in (facts["log"], facts["images"], scene, *scene["chunks"])]
    for record in records:
        content = (folder / record["url"]).read_bytes()
        assert record["bytes"] == len(content)
        assert base64.b64decode(record["sha256"]) == hashlib.sha256(content).digest()
    assert {path.name for path in folder.iterdir()} == {"index.html", *(record["url"] for record in records)}
    assert not (tmp_path / "page.html").exists()
    contents = lambda: {path.name: path.read_bytes() for path in folder.iterdir()}
    before = contents()
    folder_page(toy, tmp_path, monkeypatch)
    assert contents() == before
    (tmp_path / "again").mkdir()
    out = tmp_path / "again" / "page.html"
    view.run_page(PageConfig(images=0), toy[1], out, scene=toy[0] / "scene", report="report.html")
    index = (tmp_path / "again" / "page_page" / "index.html").read_text(encoding="utf-8")
    assert 'href="../report.html"' in index  # which lies beside the folder


def test_a_folder_of_something_else_is_not_replaced(toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "page_page").mkdir()
    (tmp_path / "page_page" / "notes.txt").write_text("mine")
    refused("not a page", folder_page, toy, tmp_path, monkeypatch, raises=UsageError)


def test_a_page_says_what_was_left_out(toy: Toy) -> None:
    scene = read_scene(toy[0] / "scene")
    page = view.page_of(PageConfig(images=0, budget=500), view.Shown(scene, (("fit", toy[2]),)))
    assert "500 Gaussians of 900 (" in page.about
    assert f"{page.scenes[0][1].layout.visible - 500} left out for the budget" in page.about


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Of colours 0..1, or of bytes against these."""
    a, b = (x / 255.0 if x.dtype == np.uint8 else x for x in (a, b))
    return float(-10 * np.log10(np.square(a - b).mean()))


@pytest.fixture(scope="module")
def opened(toy: Toy, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile"), size=(360, 300)) as one:
        one.open(f"file://{toy[0] / 'page.html'}#m=recorded&c=front&t=0.4")
        yield one


@pytest.mark.slow
def test_a_browser_draws_what_the_rasterizer_draws(opened: Browser, toy: Toy) -> None:
    scene, model = read_scene(toy[0] / "scene"), toy[2]
    for time_s, shift_m in ((0.0, 0.0), (0.4, 0.0), (0.4, 2.0), (0.6, -2.0), (0.8, 0.5)):
        wanted = next(v for v in at_shift(scene, "front", shift_m).views if abs(v.time_s - time_s) < 1e-6)
        true = render_view(model, wanted, raster_of(model))
        seen = opened.measure(["color", "depth", "class", "confidence"], camera="front", t=time_s, shift=shift_m)
        assert psnr(seen["color"][..., :3], true.rgb.permute(1, 2, 0).numpy()) >= 38
        total, weight = seen["depth"][..., 0], seen["depth"][..., 3]
        depth = np.where(weight >= 0.5, total / np.maximum(weight, 1e-6), np.nan)
        both = np.isfinite(depth) & np.isfinite(true.depth[0].numpy())
        assert np.median(np.abs(depth[both] / true.depth[0].numpy()[both] - 1)) <= 0.01
        assert (seen["class"] == true.semantics.numpy()).mean() >= 0.97
        assert seen["confidence"][..., 0].max() <= 1.001
    assert opened.errors == []


VIEWS = {
    "recorded": ({"mode": "recorded", "t": 0.4, "shift": 0}, None),
    "aside": ({"mode": "recorded", "t": 0.4, "shift": 2}, None),
    "behind": ({"mode": "chase", "t": 0.0, "shift": 0, "behind": 30}, "fair poor"),
    "above": ({"mode": "top", "t": 0.0, "shift": 0}, "fair poor"),
    "back": ({"mode": "fly", "eye": [0, 0, 1.5], "yaw": 3.14, "pitch": -0.1}, "poor"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", VIEWS)
def test_the_sign_tells_how_much_of_a_view_is_determined_and_how_much_is_empty(
    name: str, opened: Browser, toy: Toy
) -> None:
    """Against pictures of the program's own rasterizer, and what the page drew, counted here."""
    state, words = VIEWS[name]
    opened.run(f"mudg.settled({json.dumps(state)}).then(() => {{ mudg.onRest(); return 1; }})")
    sign = opened.run("[document.getElementById('seen-word').className, document.getElementById('seen').textContent]")
    found = opened.run("mudg.seenShare(mudg.last.view)")
    small = opened.run(
        "import('mudg/app').then((m) => m.scaled(mudg.last.view, Math.min(1, 96 / mudg.last.view.width)))"
    )
    sums = opened.run(
        f"Array.from(mudg.renderer.read(mudg.used().left, {json.dumps(small)}, mudg.state.t, 'confidence', new Set()))"
    )
    certainty, alpha = np.array(sums).reshape(small["height"], small["width"], 4)[..., [0, 3]].transpose(2, 0, 1)
    camera = Camera("seen", *(small[key] for key in ("width", "height", "fx", "fy", "cx", "cy")))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.array(small["axes"]).T, small["eye"]
    drawn = FittedScene(toy[2]).render(camera, pose, opened.run("mudg.state.t"))
    covered = np.isfinite(drawn.depth_m)
    assert (covered == (alpha >= 0.5)).mean() > 0.95
    x, y = np.meshgrid(np.arange(small["width"]) + 0.5, np.arange(small["height"]) + 0.5)
    ahead = np.stack([(x - small["cx"]) / small["fx"], (y - small["cy"]) / small["fy"], np.ones_like(x)], -1)
    rays = ahead @ pose[:3, :3].T
    below = rays[..., 2] / np.linalg.norm(rays, axis=-1) < -0.03  # 1.7 degrees below the horizon
    ground = covered | below
    assert found["empty"] == pytest.approx((~covered & below).sum() / ground.sum(), abs=0.04)
    assert found["sure"] == pytest.approx(((certainty > 0.2) & (alpha >= 0.5)).sum() / ground.sum(), abs=0.03)
    usual = "good" if found["sure"] >= 0.6 else "fair" if found["sure"] >= 0.35 else "poor"
    assert sign[0] == usual if words is None else sign[0] in words.split()
    assert ("% is empty" in sign[1]) == (found["empty"] >= 0.05)
    assert ("No recorded camera looked this way" in sign[1]) == (name in ("above", "back"))
    opened.run("mudg.change(), 1")
    assert "old" in opened.run("document.getElementById('seen-word').className"), "until the camera rests"


@pytest.mark.slow
def test_a_link_shows_the_same(opened: Browser) -> None:
    opened.run("location.hash = '#m=recorded&c=front&t=0.6&l=depth&s=1.5&v=difference-scene&o=boxes'; 1")
    opened.wait("window.mudg.state.layer === 'depth' && window.mudg.sharp")
    state = opened.run("JSON.stringify(window.mudg.state)")
    assert {"t": 0.6, "shift": 1.5, "compare": "difference-scene", "boxes": True}.items() <= json.loads(state).items()
    assert opened.run("location.hash").count("l=depth") == 1
    # the same fit twice differs nowhere
    middle = (
        "const c = document.createElement('canvas'); c.width = c.height = 64; const x = c.getContext('2d');"
        "x.drawImage(document.getElementById('canvas'), 0, 0, 64, 64); const p = x.getImageData(24, 24, 16, 16).data;"
    )
    shown = opened.run(f"(() => {{ {middle} return Math.max(...p.filter((_, i) => i % 4 < 3)); }})()")
    assert shown == 0


@pytest.mark.slow
def test_a_camera_path_is_played_and_saved_for_render(opened: Browser, toy: Toy, tmp_path: Path) -> None:
    scene, begin = read_scene(toy[0] / "scene"), 0.1
    opened.run("mudg.change({keys: [], mode: 'recorded', camera: 'front', shift: 0, up: 0}), 1")
    assert opened.run("[...document.querySelectorAll('#key-play, #key-save')].every((button) => button.disabled)")
    axes = lambda: np.array(opened.run("mudg.last.view.axes"))
    places = {begin: [0, 0.5, 2.0], 0.3: [1.0, 1.5, 2.5], 0.65: [3.0, 0.0, 1.5]}
    turns = {}
    for index, (time_s, eye) in enumerate(places.items()):
        state = {"mode": "fly", "t": time_s, "eye": eye, "yaw": 0.2 * index, "pitch": -0.1 * index}
        opened.run(f"mudg.settled({json.dumps(state)}).then(() => document.getElementById('key-add').click())")
        turns[time_s] = axes()
    keys = opened.run("JSON.stringify(mudg.state.keys)")
    opened.run("mudg.draw(1, true), 1")
    linked = opened.run(
        "import('mudg/state').then((m) => m.fromHash(location.hash, m.initialState(mudg.facts), mudg.facts).keys)"
    )
    for key, known in zip(linked, json.loads(keys), strict=True):
        assert [key["t"], *key["eye"], *key["turn"]] == pytest.approx(
            [known["t"], *known["eye"], *known["turn"]], abs=1e-3
        )
    text = opened.run("import('mudg/path').then((m) => m.pathText(mudg.state.keys, mudg.facts.begin_s))")
    (tmp_path / "path.json").write_text(text, encoding="utf-8")
    read = read_path(tmp_path / "path.json", scene, scene.cameras["front"])
    start = opened.run("mudg.facts.begin_s")
    assert [v.time_s - start for v in read.views] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.65])
    for index, time_s in ((0, begin), (2, 0.3), (6, 0.65)):
        assert read.views[index].center_world == pytest.approx(places[time_s], abs=1e-6)
        assert read.views[index].world_from_cam[:3, :3].T == pytest.approx(turns[time_s], abs=1e-6)
    for view_ in read.views:  # the page shows what is saved
        opened.run(f"mudg.settled({{mode: 'path', t: {view_.time_s - start}}}).then(() => 1)")
        assert opened.run("mudg.last.view.eye") == pytest.approx(view_.center_world, abs=1e-6)
        assert axes() == pytest.approx(view_.world_from_cam[:3, :3].T, abs=1e-6)
    near = opened.run(
        "import('mudg/path').then((m) => [0.299, 0.3, 0.301].map((t) => m.along(mudg.state.keys, t).eye))"
    )
    before, after = np.diff(near, axis=0)
    assert before == pytest.approx(after, abs=1e-3), "no corner at the key in the middle"
    assert np.abs(before).max() > 3e-3
    opened.run("document.getElementById('key-play').click(), 1")
    assert opened.run("[mudg.state.mode, mudg.state.playing, mudg.state.t >= 0.1 && mudg.state.t < 0.65]") == [
        "path",
        True,
        True,
    ]
    opened.run("document.getElementById('key-clear').click(), mudg.change({playing: false}), 1")
    assert opened.run("[mudg.state.mode, mudg.state.keys.length]") == ["recorded", 0]
    assert opened.errors == []


@pytest.mark.slow
def test_views_have_a_field_of_view_ground_and_a_vehicle(opened: Browser) -> None:
    angle = "(view) => 360 / Math.PI * Math.atan(view.width / 2 / view.fx)"
    change = lambda **state: opened.run(f"mudg.settled({json.dumps(state)}).then(() => (mudg.draw(1, true), 1))")
    recorded = opened.run("mudg.facts.cameras.front")
    change(mode="recorded", camera="front", t=0.4, shift=0, up=0, fov=0, boxes=False, layer="color", compare="none")
    assert opened.run("mudg.last.view.fx / mudg.last.view.width") == pytest.approx(recorded["fx"] / recorded["width"])
    for mode in ("recorded", "chase"):
        change(mode=mode, fov=100)
        assert opened.run(f"({angle})(mudg.last.view)") == pytest.approx(100)
    assert "w=100" in opened.run("location.hash")
    assert opened.run("document.getElementById('fov-text').textContent") == "100\u00b0"
    opened.run("document.getElementById('center').click(), 1")
    assert opened.run("[mudg.state.mode, mudg.state.fov]") == ["recorded", 0]
    # grey ground below the horizon of a free view, sky above it
    change(mode="fly", eye=[0, 0, 30], yaw=3.14, pitch=0)
    picture = "const p = mudg.pictureOf('left', mudg.used().left, mudg.last.view), b = mudg.renderer.bytes(p);"
    at = "(y) => Array.from(b.slice(4 * (p.width * y + 10), 4 * (p.width * y + 10) + 3))"
    rows = "[0.1, 0.2, 0.8, 0.9].map((share) => Math.floor(share * p.height))"
    seen = np.array(opened.run(f"(() => {{ {picture} return {rows}.map({at}); }})()")) / 255
    assert np.abs(seen[2:] - GROUND).max() < 0.01
    assert np.abs(seen[:2] - GROUND).max(-1).min() > 0.03
    # the recording vehicle has a box where it is seen from outside, and no name covers another
    change(mode="chase", t=0.4, boxes=True, fov=0)
    names = opened.run("mudg.overlayDrawer.labels.map((label) => label.text)")
    assert any(name.startswith("recording vehicle") for name in names)
    opened.run(
        "mudg.overlayDrawer.labels.push({...mudg.overlayDrawer.labels[0], far: 1e3}), mudg.overlayDrawer.names(), 1"
    )
    assert opened.run("mudg.overlayDrawer.named <= mudg.overlayDrawer.labels.length - 1")
    change(mode="recorded", boxes=True)
    assert not any("recording" in name for name in opened.run("mudg.overlayDrawer.labels.map((label) => label.text)"))
    change(boxes=False)
    assert opened.errors == []


@pytest.mark.slow
def test_hidden_objects_are_gone_are_an_edit_script_and_nothing_is_loaded(
    opened: Browser, toy: Toy, tmp_path: Path
) -> None:
    with_car = opened.measure(["class"], camera="front", t=0.4)["class"]
    without = opened.measure(["class"], camera="front", t=0.4, hidden=["car-1"])["class"]
    assert (with_car == ID["car"]).sum() > 20
    assert (without == ID["car"]).sum() == 0
    module = "import('mudg/share').then((share) => share.editScript({hidden: new Set(['car-1', 'a \"b\"'])}))"
    (tmp_path / "edits.yaml").write_text(opened.run(module), encoding="utf-8")
    (edit,) = read_edits(tmp_path / "edits.yaml").edits
    assert (edit.verb, list(edit.settings.ids)) == ("remove", ['a "b"', "car-1"])
    assert all(address.startswith(("file://", "blob:", "data:")) for address in opened.requests)


@pytest.mark.slow
def test_names_from_a_log_do_not_run(opened: Browser, toy: Toy, tmp_path: Path) -> None:
    name = "</script><script>document.documentElement.dataset.foreign=1</script><img src=x onerror='document.title=1'>"
    scene = read_scene(toy[0] / "scene")
    hostile = replace(scene, id=name, tracks=(replace(scene.tracks[0], id=name, label=name),))
    page = view.page_of(PageConfig(images=0), view.Shown(hostile, (("fit", toy[2]),)))
    (tmp_path / "page.html").write_bytes(whole_page(page))
    opened.open(f"file://{tmp_path / 'page.html'}")
    assert name in opened.run("document.querySelector('#objects .name').textContent")
    assert opened.run("document.querySelector('h1').textContent") == opened.run("document.title") == name
    assert opened.run("document.documentElement.dataset.foreign === undefined && !document.querySelector('img[src=x]')")
    assert opened.errors == []


# a page in chunks ---------------------------------------------------------------------------------


@pytest.fixture
def web(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """An ordinary web server: its folder and its address."""
    root = tmp_path / "web"
    root.mkdir()

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(root)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield root, f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[Browser]:
    with Browser(tmp_path / "profile", size=(360, 300)) as one:
        yield one


AT = {"camera": "front", "t": 0.4, "shift": 1.0}


@pytest.mark.slow
def test_a_page_in_chunks_shows_what_one_chunk_shows(
    toy: Toy, web: tuple[Path, str], fresh: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder_page(toy, web[0], monkeypatch)
    fresh.open(f"{web[1]}/page_page/#m=recorded&c=front&t=0.4")
    fresh.wait("document.documentElement.dataset.arrival === 'whole'")
    chunked = fresh.measure(["color", "depth", "class"], **AT)
    assert fresh.run("document.getElementById('arrival').hidden")
    asked = [address for address in fresh.requests if "scene-0-0" in address]
    assert len(asked) == fresh.run("mudg.arrival.all.length") > 10
    assert fresh.errors == []

    # one file whose chunks are the same holds the same picture to the bit
    def open_one_file() -> None:
        config = PageConfig(images=3)
        page = view.page_of(config, view.find_sources(config, toy[1], toy[0] / "scene", None).read())
        (web[0] / "one.html").write_bytes(whole_page(page))
        fresh.open(f"file://{web[0] / 'one.html'}")

    open_one_file()
    one = fresh.measure(["color", "depth", "class"], **AT)
    for layer, values in chunked.items():
        assert np.array_equal(values, one[layer]), layer
    # one chunk of everything has other blocks: the same within rounding
    monkeypatch.setattr(view, "CHUNK", 65_536)
    open_one_file()
    assert psnr(fresh.measure(["color"], **AT)["color"], chunked["color"]) > 45


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "told"),
    [("missing", "404"), ("truncated", "of"), ("foreign", "its content is not what this page was made with")],
)
def test_a_chunk_that_fails_is_told_and_can_be_tried_again(
    toy: Toy, web: tuple[Path, str], fresh: Browser, monkeypatch: pytest.MonkeyPatch, damage: str, told: str
) -> None:
    folder, facts = folder_page(toy, web[0], monkeypatch)
    record = facts["scenes"][0]["chunks"][4]["file"]
    path = folder / record["url"]
    whole = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "truncated":
        path.write_bytes(whole[:-20])
    else:
        path.write_bytes(gzip.compress(bytes(len(gzip.decompress(whole)))).ljust(len(whole), b"\0")[: len(whole)])
    fresh.open(f"{web[1]}/page_page/")
    fresh.wait("document.documentElement.dataset.arrival === 'failed'")
    text = fresh.run("document.getElementById('arrival-text').textContent")
    assert record["url"] in text and told in text and "1 of" in text and "not complete" in text
    assert fresh.run("mudg.loaded[0].present") == facts["scenes"][0]["rows"] - 64
    fresh.wait(f"mudg.used().left.drawn > 0 && mudg.used().left.drawn <= {facts['scenes'][0]['rows'] - 64}")
    path.write_bytes(whole)
    fresh.run("document.getElementById('arrival-again').click()")
    fresh.wait("document.documentElement.dataset.arrival === 'whole'")
    assert fresh.run("document.getElementById('arrival').hidden")
    assert fresh.run("mudg.loaded[0].present") == facts["scenes"][0]["rows"]
    assert fresh.errors and all("scene-0-004" in e or "integrity" in e for e in fresh.errors), fresh.errors


@pytest.mark.slow
def test_a_folder_opened_from_the_disk_says_what_to_do(
    toy: Toy, tmp_path: Path, fresh: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, _ = folder_page(toy, tmp_path, monkeypatch)
    refused("python -m http.server", fresh.open, f"file://{folder / 'index.html'}", raises=BrowserError)
    assert "mudg view RUN" in fresh.run("document.getElementById('problem').textContent")


# the server ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def served(toy: Toy) -> Iterator[tuple[int, str]]:
    with serving(toy[1], toy[0] / "scene") as found:
        yield found


def test_the_server_answers_only_to_its_own_page(served: tuple[int, str]) -> None:
    port, token = served
    assert ask(port, "GET", f"/?token={token}")[0] == 200
    assert ask(port, "GET", "/")[0] == 403
    assert ask(port, "GET", "/?token=wrong")[0] == 403
    assert ask(port, "GET", f"/?token={token}", Host="evil.example")[0] == 403
    page = ask(port, "GET", "/", Cookie=f"mudg_token={token}")[1].decode()
    chunk = re.findall(r'"url":"(scene-0-000-[0-9a-f]{8}\.bin)"', page.replace(": ", ":"))
    assert len(chunk) == 1
    assert ask(port, "GET", f"/{chunk[0]}", Cookie=f"mudg_token={token}")[0] == 200
    assert ask(port, "GET", f"/{chunk[0]}")[0] == 403
    for path in ("/../fit/model.json", "/%2e%2e/model.json", "//etc/passwd", "/model.json"):
        assert ask(port, "GET", path, Cookie=f"mudg_token={token}")[0] == 404
    own = f"http://127.0.0.1:{port}"
    assert ask(port, "POST", "/frame", {}, Origin=own)[0] == 403
    assert ask(port, "POST", "/frame", {}, X_Mudg_Token="wrong", Origin=own)[0] == 403
    assert ask(port, "POST", "/frame", {}, X_Mudg_Token=token)[0] == 403
    assert ask(port, "POST", "/frame", {}, X_Mudg_Token=token, Origin="https://evil.example")[0] == 403
    assert ask(port, "GET", f"/frame?token={token}")[0] == 404
    status, text = ask(port, "POST", "/frame", {"layer": "color"}, X_Mudg_Token=token, Origin=own)
    assert status == 400 and b"request" in text


def test_the_server_draws_exact_frames(served: tuple[int, str], toy: Toy) -> None:
    port, token = served
    wanted = STREET.view(0.4, 160, 96)
    status, content = ask(port, "POST", "/frame", question(wanted), **allowed(port, token, "localhost"))
    assert status == 200
    true = render_view(toy[2], wanted, raster_of(toy[2])).rgb.permute(1, 2, 0).numpy()
    assert np.abs(colors_in(content) - true).max() < 0.003


def test_a_free_exact_frame_shows_ground_below_the_horizon(served: tuple[int, str], toy: Toy) -> None:
    port, token = served
    seen = View(Camera("front", 64, 48, 40, 40, 32, 24), np.eye(4), 0.4)
    at = {"eye": [-60, 0, 20], "axes": [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]}
    bodies = (question(seen, camera=name, **at) for name in ("", "front"))
    answers = [ask(port, "POST", "/frame", body, **allowed(port, token, "localhost")) for body in bodies]
    free, recorded = (colors_in(content) for _, content in answers)
    # rows of the small panorama blend within 11 degrees of the horizon
    assert np.abs(free[36:] - GROUND).max() < 0.01
    assert np.abs(recorded[36:] - GROUND).max() > 0.03
    assert np.abs(free[:11] - recorded[:11]).max() < 0.01


def test_other_machines_need_a_token() -> None:
    refused("token", token_for, "0.0.0.0", "", raises=UsageError)
    refused("short", token_for, "0.0.0.0", "abc", raises=UsageError)
    assert token_for("192.168.1.2", "long enough a secret") == "long enough a secret"
    assert len(token_for("127.0.0.1", "")) >= 16


def test_fits_of_different_logs_are_not_compared(toy: Toy, tmp_path: Path) -> None:
    save_model(replace(toy[2], facts={**toy[2].facts, "scene": "another"}), tmp_path / "fit")
    refused("another", view.find_sources(PageConfig(), toy[1], toy[0] / "scene", tmp_path / "fit").read)


# exact frames in a browser ------------------------------------------------------------------------


@contextmanager
def shown(port: int, address: str, folder: Path) -> Iterator[Browser]:
    """A browser with the page of a server, without errors to the end."""
    with Browser(folder / "profile", size=(700, 500)) as one:
        one.open(f"http://127.0.0.1:{port}/?token={address}")
        yield one
        assert one.errors == []


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"eye": [0, 0]}, "eye"),
        ({"width": 0}, "width"),
        ({"layer": "normal"}, "layer"),
        ({"out": "/tmp/x.png"}, "out"),
        ({"edits": "- jump: {}\n"}, "verb"),
    ],
)
def test_a_wrong_question_is_told(served: tuple[int, str], changes: dict[str, Any], told: str) -> None:
    port, token = served
    body = question(STREET.view(0.4, 160, 96), **changes)
    status, text = ask(port, "POST", "/frame", body, **allowed(port, token))
    assert status == 400
    assert told in text.decode()


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
