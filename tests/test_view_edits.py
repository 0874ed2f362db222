"""Edits on the viewer's page: what the server does and saves; the page shows ``mudg render --edits``, and weather."""

from __future__ import annotations

import base64
import io
import json
import shutil
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from browser import Browser
from PIL import Image
from refusals import refused
from toy_fitted import STREET, write_toy_run
from view_server import colors_in, question, seen_from, serving, whole_page

from mudg.base import seeds
from mudg.base.errors import UsageError
from mudg.base.palette import ID
from mudg.core.edit import HeightMap
from mudg.core.trajectory import at_shift
from mudg.core.weather import air as particles
from mudg.editing.apply import SEED, carry_out, in_weather, street_left, weather_of
from mudg.editing.model import motion_of
from mudg.editing.plan import EditPlan
from mudg.editing.script import conditions_of, parse_edits, read_edits
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import raster_of, render_view
from mudg.scene.read import read_scene
from mudg.viewer import view
from mudg.viewer.page import UNKNOWN, PageFacts
from mudg.viewer.settings import PageConfig
from mudg.viewer.view import MARK, EditDesk, EditRequest, FrameSource, desk_for, place_for

Toy = tuple[Path, Path, SceneModel]
SCRIPT = "- move: {id: car-1, along_m: 1.5, left_m: 1, yaw_deg: 20}\n"
PERSON = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Toy:
    root = tmp_path_factory.mktemp("edits")
    _, fit, _, model = write_toy_run(root)
    return root, fit, model


def desk_of(toy: Toy, out: Path, script: Path | None = None) -> EditDesk:
    scene = read_scene(toy[0] / "scene")
    return desk_for([toy[2]], scene, None, toy[1], script, out)


def said(desk: EditDesk, script: str, save: bool = False) -> dict:
    return json.loads(desk.answer(EditRequest(script=script, save=save))[0])


def test_the_server_says_the_paths_of_the_edited_fit(toy: Toy, tmp_path: Path) -> None:
    desk = desk_of(toy, tmp_path / "edits.yaml")
    found = said(desk, SCRIPT)
    (edited,) = desk.edited(SCRIPT)
    car = next(node for node in edited.nodes if node.name == "car-1")
    rows = np.array(found["paths"]["car-1"]["rows"])
    assert np.abs(rows[:, 1:4] - motion_of(car).poses[:, :3, 3]).max() < 1e-5
    assert (found["removed"], found["saved"]) == ([], None)
    assert said(desk, SCRIPT + "- remove: {class: car}\n")["removed"] == ["car-1"]
    assert not (tmp_path / "edits.yaml").exists()
    assert said(desk, "")["paths"] == {}


@pytest.mark.parametrize(
    ("script", "told"),
    [
        ("- move: {id: car-9}\n", "line 1: move.id"),
        ("- remove: {ids: [car-1]}\n- move: {id: car-1, sideways: 2}\n", "line 2: move"),
        ("- jump: {}\n", "verb"),
        ("- [\n", "YAML"),
        ("- sky: {image: /etc/hostname}\n", "no files"),
    ],
)
def test_a_wrong_script_is_told_with_its_line(toy: Toy, tmp_path: Path, script: str, told: str) -> None:
    desk = desk_of(toy, tmp_path / "edits.yaml")
    refused(f"(?i){told}", said, desk, script)


def test_an_exact_frame_is_the_render_of_the_edited_fit(toy: Toy, tmp_path: Path) -> None:
    desk, model = desk_of(toy, tmp_path / "edits.yaml"), toy[2]
    wanted = STREET.view(0.4, 80, 48)
    scene = read_scene(toy[0] / "scene")
    source = FrameSource(desk.edited, scene, 1600, torch.device("cpu"))
    drawn = lambda script: colors_in(source.png(question(wanted, edits=script))[0])
    seen, edited = drawn(SCRIPT), carry_out(parse_edits(SCRIPT, "edits.yaml"), model, scene).model(model)
    true = render_view(edited, wanted, raster_of(model)).rgb.permute(1, 2, 0).numpy()
    plain = render_view(model, wanted, raster_of(model)).rgb.permute(1, 2, 0).numpy()
    assert np.abs(seen - true).max() < 0.003
    assert np.abs(seen - plain).max() > 0.1
    script = SCRIPT + "- weather: {rain: {mm_h: 30}, wet: 0.8}\n- light: {time: dusk}\n"
    conditions = conditions_of(parse_edits(script, "edits.yaml").canonical())
    dry = lambda one: render_view(edited, one, raster_of(model))
    wet = in_weather(dry, weather_of(dry, conditions, scene))(wanted).rgb.permute(1, 2, 0).numpy()
    rainy = drawn(script)
    assert np.abs(rainy - wet).max() < 0.003 and np.abs(rainy - seen).max() > 0.1
    assert np.abs(drawn(SCRIPT) - seen).max() == 0


def test_a_street_is_closed_once_and_only_for_frames(toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def counted(model: SceneModel, plan: EditPlan, *, close: bool = True) -> SceneModel:
        calls.append(close)
        return street_left(model, plan, close=close)

    monkeypatch.setattr(view, "street_left", counted)
    scene = read_scene(toy[0] / "scene")
    scene = replace(scene, frames=scene.frames[1:3])
    desk = desk_for([toy[2]], scene, None, toy[1], out=tmp_path / "edits.yaml")
    scripts = [f"- move: {{id: car-1, left_m: {x}, close_street: true}}\n" for x in (1, 2)]
    notes = [said(desk, script)["notes"] for script in scripts]
    assert all(any("close the street" in note for note in of) for of in notes) and True not in calls
    made = [desk.edited(script)[0] for script in scripts][-1]
    plain = carry_out(parse_edits(scripts[-1], "edits.yaml"), toy[2], scene).model(toy[2])
    assert all(torch.equal(made.table[name], plain.table[name]) for name in ("means", "sh_dc"))
    assert np.array_equal(*(motion_of(model.dynamic_object("car-1")).poses for model in (made, plain)))
    assert calls.count(True) == 1
    desk.edited("- remove: {ids: [car-1], close_street: true}\n")
    assert calls.count(True) == 2


def test_a_page_may_insert_objects_of_its_own_run_and_of_no_other(toy: Toy, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(toy[0] / "scene", run / "scene")
    shutil.copytree(toy[1], run / "fit" / "street_gaussians")
    (run / "fuse").mkdir()
    (run / "fuse" / "fuse.json").write_text("{}")
    desk = desk_for([toy[2]], read_scene(run / "scene"), None, run, out=tmp_path / "edits.yaml")
    near = "near: {id: ego, at_s: 0.2, ahead_m: 12}, ground: false"
    script = f'- insert: {{asset: {{run: "{desk.run}", id: car-1}}, {near}}}\n'
    told = said(desk, script)
    (edited,) = desk.edited(script)
    (name,) = told["inserted"]
    assert name in edited.node_names() and name not in toy[2].node_names()
    refused("no files", said, desk, script.replace(desk.run, str(tmp_path / "another")))
    refused("no files", said, desk_of(toy, tmp_path / "edits.yaml"), script)  # a fit alone is no run


def test_edits_are_saved_as_a_script_and_replace_only_their_own_file(toy: Toy, tmp_path: Path) -> None:
    place = tmp_path / "edits.yaml"
    desk = desk_of(toy, place)
    assert said(desk, SCRIPT, save=True)["saved"] == str(place)
    assert place.read_text().startswith(MARK)
    said(desk, SCRIPT + SCRIPT, save=True)
    assert [edit.verb for edit in read_edits(place).edits] == ["move", "move"]
    place.write_text("- remove: {ids: [car-1]}\n")
    refused("not written by mudg view", said, desk, SCRIPT, save=True)
    assert "remove" in place.read_text()
    refused("no edits", said, desk, "", save=True)


def test_edits_are_never_saved_into_a_result(toy: Toy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert place_for(toy[1], None) == toy[1].resolve().parent / "edits.yaml"
    (tmp_path / "run" / "fit" / "a").mkdir(parents=True)
    (tmp_path / "run" / "run.json").write_text("{}")
    assert place_for(tmp_path / "run" / "fit" / "a", None) == Path("edits.yaml")
    assert place_for(tmp_path / "run", None) == tmp_path / "edits.yaml"
    refused("edits-out", place_for, toy[1], tmp_path / "run" / "fit" / "mine.yaml", raises=UsageError)


def test_a_page_begins_with_a_script(toy: Toy, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("# a note\n- move: {id: car-1, left_m: 2}\n- stop: {id: car-1, at_s: 0.3}\n")
    desk = desk_of(toy, tmp_path / "edits.yaml", tmp_path / "mine.yaml")
    assert desk.entries() == [{"move": {"id": "car-1", "left_m": 2.0}}, {"stop": {"id": "car-1", "at_s": 0.3}}]
    (tmp_path / "mine.yaml").write_text("- move: {id: nobody}\n")
    refused("nobody", desk_of, toy, tmp_path / "edits.yaml", tmp_path / "mine.yaml")


def test_heights_of_the_ground_are_kept_within_a_millimetre() -> None:
    heights = np.array([[0.0, 0.5], [np.nan, 12.0]])
    page = PageFacts({}, {}, b"").with_ground(HeightMap(np.zeros(2), 0.5, heights))
    facts, levels = page.facts["ground"], page.sections["ground"]
    assert levels[1, 0] == UNKNOWN
    known = np.isfinite(heights)
    assert np.abs(facts["low"] + facts["step"] * levels[known] - heights[known]).max() < 1e-3
    assert page.with_ground(None).facts["ground"] is None


# in a browser -------------------------------------------------------------------------------------


def hilly() -> HeightMap:
    """Ground with slopes, and with a part that is not known."""
    x, y = np.meshgrid(np.arange(-20, 60, 0.5), np.arange(-20, 20, 0.5), indexing="ij")
    heights = 0.3 * np.sin(x / 4) + 0.02 * y**2
    heights[y < -6] = np.nan
    return HeightMap(np.array([-20.0, -20.0]), 0.5, heights)


@pytest.fixture(scope="module")
def opened(toy: Toy, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    root = tmp_path_factory.mktemp("page")
    made = view.page_of(PageConfig(images=0), view.Shown(read_scene(toy[0] / "scene"), (("fit", toy[2]),)))
    (root / "page.html").write_bytes(whole_page(replace(made, log=made.log.with_ground(hilly()))))
    with Browser(tmp_path_factory.mktemp("profile"), size=(900, 600)) as one:
        one.open(f"file://{root / 'page.html'}#m=recorded&c=front&t=0.4")
        yield one


SCRIPTS = (
    SCRIPT,
    "- move: {id: car-1, along_m: -2, left_m: 1.2, up_m: 0.1, yaw_deg: -70, ground: false}\n",
    "- move: {id: car-1, left_m: 3, from_s: 0.2, ramp_s: 0.3}\n- stop: {id: car-1, at_s: 0.3, brake_m_s2: 6}\n",
    "- stop: {id: car-1, at_s: 0.2}\n- move: {id: car-1, left_m: -9}\n",
    f"- move: {{id: '{PERSON}', along_m: 0.5, yaw_deg: 45}}\n- stop: {{id: '{PERSON}', at_s: 0.5}}\n",
)


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_the_page_moves_objects_as_the_program_does(
    opened: Browser, toy: Toy, script: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, scene = toy[2], read_scene(toy[0] / "scene")
    monkeypatch.setattr("mudg.editing.apply.ground_of", lambda cloud, model: hilly())
    drive = carry_out(parse_edits(script, "edits.yaml"), model)
    edited = drive.model(model)
    as_given = {"mode": "json", "by_alias": True, "exclude_unset": True}
    entries = [{e.verb: e.settings.model_dump(**as_given)} for e in drive.script.edits]
    opened.run(f"window.mudg.editor.set({json.dumps(entries)}); 1")
    for name in ("car-1", PERSON):
        motion = motion_of(next(node for node in edited.nodes if node.name == name))
        for t in np.linspace(motion.times_s[0], motion.times_s[-1], 23):
            shown = opened.run(
                f"(() => {{ const p = window.mudg.loaded[0].scene.nodes.find((n) => n.name === {json.dumps(name)})"
                f".pose.at({float(t) - scene.frames[0].view.time_s}); return [...p.position, ...p.rotation]; }})()"
            )
            true = motion.pose_at(float(t))
            assert np.abs(np.array(shown[:3]) - true[:3, 3]).max() < 2e-3, (name, t)
            assert np.abs(np.array(shown[3:]).reshape(3, 3) - true[:3, :3]).max() < 2e-3, (name, t)
    wanted = next(v for v in at_shift(scene, "front", 0.0).views if abs(v.time_s - 0.6) < 1e-6)
    true = render_view(edited, wanted, raster_of(model)).rgb.permute(1, 2, 0).numpy()
    seen = opened.measure(["color"], camera="front", t=0.6)["color"][..., :3] / 255.0
    assert -10 * np.log10(np.square(seen - true).mean()) >= 38
    opened.run("window.mudg.editor.undo(); 1")
    assert opened.run("window.mudg.state.edits.length") == 0
    assert opened.errors == []


PRESS = """(type, x, y, id = 1) => document.getElementById('stage').dispatchEvent(
  new PointerEvent(type, {clientX: x, clientY: y, pointerId: id, bubbles: true}))"""
HANDLES = """(() => { const app = window.mudg, {view, area, ratio} = app.last;
  const box = app.stage.getBoundingClientRect(), found = {};
  for (const [name, [x, y]] of Object.entries(app.gizmo.handles(view, app.gizmo.frame())))
    found[name] = [box.left + (x + area[0]) / ratio, box.top + (y + area[1]) / ratio];
  return found; })()"""


@pytest.mark.slow
def test_an_object_is_picked_moved_and_turned_with_its_handles(opened: Browser, tmp_path: Path) -> None:
    def press(*events: tuple[str, float, float]) -> None:
        for kind, x, y in events:
            opened.run(f"(({PRESS})('{kind}', {x}, {y}), 1)")

    opened.run("document.getElementById('stage').setPointerCapture = () => {}; 1")
    opened.run("window.mudg.change({mode: 'top', height: 30, t: 0.4}); 1")
    opened.wait("window.mudg.sharp")
    middle = opened.run(
        "(() => { const app = window.mudg, track = app.tracks.find((one) => one.id === 'car-1'); app.state.selected ="
        f" 'car-1';const found = {HANDLES}; app.state.selected = null; return found.free; }})()"
    )
    press(("pointerdown", *middle), ("pointerup", *middle))
    assert opened.run("window.mudg.state.selected") == "car-1"
    places = opened.run(HANDLES)
    (x0, y0), (x1, y1) = places["free"], places["along"]
    press(("pointerdown", x1, y1), ("pointermove", x1 + (x1 - x0), y1 + (y1 - y0)), ("pointerup", x1, y1))
    ((verb, given),) = opened.run("window.mudg.state.edits")[0].items()
    size = opened.run("window.mudg.tracks.find((one) => one.id === 'car-1').size_m[0]")
    assert verb == "move" and set(given) == {"id", "along_m"}
    assert abs(given["along_m"] - (size / 2 + 0.9)) < 0.15  # the picture has perspective
    opened.wait("window.mudg.sharp")
    x, y = opened.run(HANDLES)["yaw"]
    press(("pointerdown", x, y), ("pointermove", x - 30, y), ("pointerup", x, y))
    edits = opened.run("window.mudg.state.edits")
    assert len(edits) == 1 and abs(edits[0]["move"]["yaw_deg"]) > 3
    key = "(key, more = {}) => document.body.dispatchEvent(new KeyboardEvent('keydown', {key, bubbles: true, ...more}))"
    opened.run(f"(({key})('ArrowLeft', {{shiftKey: true}}), ({key})('<', {{shiftKey: true}}), 1)")
    assert opened.run("window.mudg.state.edits[0].move.yaw_deg") == pytest.approx(edits[0]["move"]["yaw_deg"] + 1)
    text = opened.run("import('mudg/share').then((share) => share.editScript(window.mudg.state))")
    assert parse_edits(text, "edits.yaml").edits[0].settings.id == "car-1"
    for _ in range(4):
        opened.run(f"(({key})('z', {{ctrlKey: true}}), 1)")
    assert opened.run("window.mudg.state.edits") == []
    opened.run(f"(({key})('y', {{ctrlKey: true}}), ({key})('Delete'), 1)")
    assert [list(edit) for edit in opened.run("window.mudg.state.edits")] == [["move"], ["remove"]]
    without = opened.measure(["class"], camera="front", t=0.4)["class"]
    assert (without == ID["car"]).sum() == 0
    opened.run("window.mudg.editor.set([]); 1")
    assert opened.errors == []


@pytest.mark.slow
def test_the_brush_and_the_crop_box_take_parts_of_the_street_as_the_program_does(opened: Browser, toy: Toy) -> None:
    """A stroke marks surfaces under the pointer, and the page then shows what the program renders of the script."""
    model, scene = toy[2], read_scene(toy[0] / "scene")
    wanted = next(v for v in at_shift(scene, "front", 0.0).views if abs(v.time_s - 0.6) < 1e-6)

    def compare() -> tuple[float, float]:
        """PSNR of the page to the render of its script, and to the render without edits."""
        text = opened.run("import('mudg/edits').then((edits) => edits.scriptText(mudg.state.edits))")
        edited = carry_out(parse_edits(text, "edits.yaml"), model).model(model)
        seen = opened.measure(["color"], camera="front", t=0.6)["color"][..., :3] / 255.0
        true, plain = (render_view(m, wanted, raster_of(m)).rgb.permute(1, 2, 0).numpy() for m in (edited, model))
        return tuple(float(-10 * np.log10(np.square(seen - of).mean())) for of in (true, plain))

    opened.run("document.getElementById('stage').setPointerCapture = () => {}; mudg.editor.set([]); 1")
    opened.run("mudg.change({mode: 'recorded', camera: 'front', t: 0.6, shift: 0}); 1")
    opened.wait("mudg.sharp")
    change = "(() => {{ const e = document.getElementById('{}'); e.value = {}; e.onchange({{target: e}}); }})(); 1"
    opened.run(change.format("brush-radius", 1.25))
    opened.run("document.getElementById('brush').click(); 1")
    assert opened.run("document.getElementById('brush').getAttribute('aria-pressed')") == "true"
    box = opened.run(
        "(() => { const b = mudg.stage.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]; })()"
    )
    places = [(box[0] + box[2] * u, box[1] + box[3] * 0.8) for u in (0.35, 0.5, 0.65)]
    for kind, (x, y) in zip(("pointerdown", "pointermove", "pointermove"), places, strict=True):
        opened.run(f"(({PRESS})('{kind}', {x}, {y}), 1)")
    opened.run(f"(({PRESS})('pointerup', {places[-1][0]}, {places[-1][1]}), 1)")
    (entry,) = opened.run("mudg.state.edits")
    balls = np.array(entry["erase"]["balls"])
    assert balls.shape[1] == 4 and len(balls) >= 2 and (balls[:, 3] == 1.25).all()
    apart = np.linalg.norm(model.table["means"].detach().numpy()[:, None] - balls[None, :, :3], axis=2)
    assert (apart.min(0) < 1).all(), "each mark lies at a surface"
    same, other = compare()
    assert same >= 38 and other < same - 5
    opened.run("document.getElementById('brush').click(); mudg.editor.undo(); 1")
    assert opened.run("mudg.state.edits.length") == 0
    opened.run("document.getElementById('crop').click(); 1")
    for field, value in (("box-length", 14), ("box-width", 5), ("box-yaw", 20)):
        opened.run(change.format(field, value))
    (entry,) = opened.run("mudg.state.edits")
    assert entry["erase"]["keep"]["size_m"][:2] == [14, 5] and entry["erase"]["keep"]["yaw_deg"] == 20
    same, other = compare()
    assert same >= 38 and other < same - 5
    opened.run("document.getElementById('crop').click(); 1")
    assert opened.run("mudg.state.edits.length") == 0
    assert opened.errors == []


@pytest.mark.slow
def test_a_page_with_a_server_checks_and_saves(toy: Toy, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("- speed: {id: car-1, factor: 0.5}\n")
    files = (tmp_path / "mine.yaml", tmp_path / "edits.yaml")
    with serving(toy[1], toy[0] / "scene", edits=files) as (port, token):
        with Browser(tmp_path / "profile", size=(700, 500)) as one:
            one.open(f"http://127.0.0.1:{port}/?token={token}#m=recorded&c=front&t=0.6")
            one.wait("window.mudg.editor.told !== null")
            drive = carry_out(read_edits(tmp_path / "mine.yaml"), toy[2], read_scene(toy[0] / "scene"))
            true = motion_of(next(n for n in drive.model(toy[2]).nodes if n.name == "car-1")).pose_at(0.6)
            shown = one.run("window.mudg.loaded[0].scene.nodes.find((n) => n.name === 'car-1').pose.at(0.6).position")
            assert np.abs(np.array(shown) - true[:3, 3]).max() < 1e-3
            one.run("window.mudg.editor.set([...window.mudg.state.edits, {move: {id: 'nobody', left_m: 1}}]); 1")
            one.wait("!document.getElementById('edit-problem').hidden")
            assert "line 2: move.id" in one.run("document.getElementById('edit-problem').textContent")
            one.run("window.mudg.editor.undo(); 1")
            one.run("document.getElementById('edits').click(); 1")
            one.wait("document.getElementById('note').textContent.startsWith('Saved')")
            assert (tmp_path / "edits.yaml").read_text() == view.MARK + '- speed: {id: "car-1", factor: 0.5}\n'
            one.wait("!document.getElementById('exact').hidden")


@pytest.mark.slow
def test_fog_and_light_are_previewed_and_saved(opened: Browser, toy: Toy, tmp_path: Path) -> None:
    picture = (
        "(async () => { await mudg.settled({});"
        " const p = mudg.renderer.bytes(mudg.pictureOf('measured', mudg.loaded[0], mudg.last.view, 'color'));"
        " return p.reduce((sum, v, i) => sum + (i % 4 < 3 ? v : 0), 0) / p.length / 0.75; })()"
    )
    opened.run("mudg.editor.set([]); 1")
    plain = opened.run(picture)
    set_to = (
        "(() => {{ const e = document.getElementById('{0}'); e.value = '{1}'; e.dispatchEvent(new Event('change'));"
        " }})()"
    )
    opened.run(set_to.format("fog", 7))
    foggy = opened.run(picture)
    opened.run(set_to.format("light", "night"))
    night = opened.run(picture)
    assert abs(foggy - plain) > 3
    assert night < 0.5 * foggy
    script = opened.run("import('mudg/edits').then((edits) => edits.scriptText(mudg.state.edits))")
    (tmp_path / "edits.yaml").write_text(script, encoding="utf-8")
    weather, light = read_edits(tmp_path / "edits.yaml").edits
    assert (weather.settings.fog.visibility_m, light.settings.time) == (30, "night")
    opened.run(set_to.format("light", "as_recorded"))
    opened.run(set_to.format("fog", 0))
    assert opened.run("mudg.state.edits.length") == 0
    assert opened.run(picture) == pytest.approx(plain, abs=0.01)


@pytest.mark.slow
def test_boxes_beside_the_camera_are_cut_and_not_left_out(opened: Browser) -> None:
    camera = {"eye": [0, 0, 0], "axes": [[0, -1, 0], [0, 0, -1], [1, 0, 0]], "fx": 100, "fy": 100, "cx": 50, "cy": 40}

    def ahead(p: list[float], q: list[float]) -> list[list[float]] | None:
        return opened.run(f"import('mudg/overlay').then((o) => o.ahead({json.dumps(camera)}, {p}, {q}))")

    assert ahead([-2, 0, 0], [-1, 1, 0]) is None
    assert np.allclose(ahead([1, 1, 0], [2, 1, 0]), [[-50, 40, 1], [0, 40, 2]])
    assert np.allclose(ahead([-2, 1, 0], [2, 1, 0]), [[-350, 40, 0.25], [0, 40, 2]])
    assert np.allclose(ahead([2, 1, 0], [-2, 1, 0]), [[0, 40, 2], [-350, 40, 0.25]])
    opened.run("mudg.change({mode: 'fly', eye: [0, 0, 1.5], yaw: 0, pitch: 0, boxes: true, t: 0.4}); 1")
    opened.wait("mudg.sharp")
    count = (
        "(() => { const o = mudg.overlay, p = o.getContext('2d').getImageData(0, 0, o.width, o.height).data; let n = 0;"
        "for (let i = 3; i < p.length; i += 4) if (p[i]) n++; return n; })()"
    )
    center = opened.run("mudg.tracks.find((one) => one.id === 'car-1').pose.at(0.4).position")
    # beside its middle, half of it is behind
    opened.run(f"mudg.change({{eye: [{center[0]}, {center[1] + 2}, {center[2]}]}}); 1")
    opened.wait("mudg.sharp")
    assert opened.run(count) > 500
    opened.run("mudg.change({mode: 'recorded', boxes: false}); 1")


@pytest.mark.slow
def test_a_drive_is_saved_as_frames(opened: Browser, tmp_path: Path) -> None:
    opened.run("mudg.editor.set([]); URL.createObjectURL = () => 'data:,'; 1")
    text = opened.run(
        "(async () => { const { saveFrames } = await import('mudg/share'); const zip = await saveFrames(mudg, () =>"
        " {});const bytes = new Uint8Array(await zip.arrayBuffer()); let text = '';for (const b of bytes) text +="
        " String.fromCharCode(b); return btoa(text); })()"
    )
    with zipfile.ZipFile(io.BytesIO(base64.b64decode(text))) as archive:
        assert archive.testzip() is None
        names = archive.namelist()
        pictures = [np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGB")) for name in names]
    assert names == [f"{k:05d}.png" for k in range(9)]  # 0.8 s
    moved = [np.abs(a.astype(int) - b).max() for a, b in zip(pictures, pictures[1:])]
    assert min(moved) > 10  # the car drives in all of them


# previews of rain and snow: the drops and flakes of the program, at the same places ---------------

RAIN, SNOW = 25, 2


@pytest.fixture(scope="module")
def rainy(toy: Toy, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Browser, SceneModel]]:
    page = tmp_path_factory.mktemp("weather") / "page.html"
    view.run_page(PageConfig(images=0), toy[1], page, scene=toy[0] / "scene")
    with Browser(tmp_path_factory.mktemp("profile"), size=(700, 500)) as one:
        one.open(f"file://{page}#m=recorded&c=front&t=0.4")
        yield one, toy[2]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_drops_and_flakes_are_those_of_the_program(rainy: tuple[Browser, SceneModel], kind: str) -> None:
    page, _ = rainy
    rate, purpose = (RAIN, "rain") if kind == "rain" else (SNOW, "flakes")
    sizes = particles.rain_sizes(rate) if kind == "rain" else particles.snow_sizes(rate)
    wanted = STREET.view(0.4, 64, 48)
    for index, size in enumerate(sizes):
        velocity = np.array([0.5, -0.2, -size.fall_m_s])
        true = particles.places(size, velocity, wanted, 5.0, seeds.key(SEED, index, purpose))
        shown = page.run(
            f"import('mudg/particles').then((p) => [...p.places(p.{kind}Sizes({rate})[{index}], {velocity.tolist()},"
            f" {json.dumps(seen_from(wanted))}, 0.4, 5, mudg.facts.particle_keys.{kind}[{index}])])"
        )
        places = np.array(shown).reshape(-1, 3)
        assert len(places) == len(true) > 5
        assert np.abs(places - true).max() < 1e-9
    for extinction in ("rain", "snow"):
        shown = page.run(f"import('mudg/particles').then((p) => p.{extinction}Extinction(3))")
        assert shown == pytest.approx(getattr(particles, f"{extinction}_extinction")(3), rel=1e-12)


def brightness(page: Browser) -> np.ndarray:
    """The recorded view in colour, mean of the channels f64[H, W]."""
    return page.measure(["color"], camera="front", t=0.4)["color"][..., :3].mean(-1) / 255.0


def weather(page: Browser, settings: dict[str, Any]) -> None:
    page.run(f"mudg.editor.set({json.dumps([{'weather': settings}] if settings else [])}); 1")


@pytest.mark.slow
def test_snow_lies_on_the_ground_alone(rainy: tuple[Browser, SceneModel]) -> None:
    page, model = rainy
    weather(page, {})
    dry = page.measure(["color", "class"], camera="front", t=0.4)
    weather(page, {"snow": {"mm_h": 0, "cover": 1.0}})
    white = brightness(page)
    change = np.abs(white - dry["color"][..., :3].mean(-1) / 255.0)
    road = dry["class"] == 0
    assert road.any() and (~road).any()
    assert change[road].mean() > 10 * change[~road].mean()
    assert white[road].std() < 0.12
    weather(page, {})


@pytest.mark.slow
def test_the_sliders_write_what_the_program_reads(rainy: tuple[Browser, SceneModel], tmp_path: Path) -> None:
    page, _ = rainy

    def slide(name: str, position: int) -> None:
        event = f"e.value = '{position}'; e.dispatchEvent(new Event('change'));"
        page.run(f"(() => {{ const e = document.getElementById('{name}'); {event} }})()")

    for name, position in (("rain", 4), ("snow", 3), ("cover", 2), ("fog", 2)):
        slide(name, position)
    script = page.run("import('mudg/edits').then((e) => e.scriptText(mudg.state.edits))")
    (tmp_path / "edits.yaml").write_text(script, encoding="utf-8")
    (edit,) = read_edits(tmp_path / "edits.yaml").edits
    made = edit.settings
    assert (made.rain.mm_h, made.snow.mm_h, made.snow.cover, made.fog.visibility_m) == (25, 2, 0.5, 500)
    text = "document.getElementById('{}-text').textContent"
    texts = [page.run(text.format(name)) for name in ("rain", "snow", "cover", "fog")]
    assert texts == ["25 mm/h", "2 mm/h of water", "50 % white", "visibility 500 m"]
    for name in ("snow", "fog", "rain"):
        slide(name, 0)
    assert page.run("mudg.state.edits") == [{"weather": {"snow": {"mm_h": 0, "cover": 0.5}}}]
    slide("cover", 0)
    assert page.run("mudg.state.edits") == []
    assert page.errors == []
