"""Previews of rain and snow on the viewer's page: the drops and flakes of the program, at the same places."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser
from scipy.ndimage import uniform_filter
from toy_fitted import STREET, write_toy_run

from mudg.base import seeds
from mudg.base.types import View
from mudg.core.weather import air as particles
from mudg.editing.apply import SEED
from mudg.editing.script import read_edits
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import raster_of, render_view
from mudg.viewer import view
from mudg.viewer.settings import PageConfig

pytestmark = pytest.mark.slow
RAIN, SNOW = 25, 2


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Browser, SceneModel]]:
    root = tmp_path_factory.mktemp("weather")
    scene, fit, _, model = write_toy_run(root)
    view.run_page(PageConfig(images=0), fit, root / "page.html", scene=scene)
    with Browser(tmp_path_factory.mktemp("profile"), size=(700, 500)) as one:
        one.open(f"file://{root / 'page.html'}#m=recorded&c=front&t=0.4")
        yield one, model


def seen_by(one: View) -> str:
    """A view as the page's modules take it."""
    camera, pose = one.camera, one.world_from_cam
    named = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return json.dumps(named | {"eye": pose[:3, 3].tolist(), "axes": pose[:3, :3].T.tolist()})


@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_drops_and_flakes_are_those_of_the_program(opened: tuple[Browser, SceneModel], kind: str) -> None:
    page, _ = opened
    rate, purpose = (RAIN, "rain") if kind == "rain" else (SNOW, "flakes")
    sizes = particles.rain_sizes(rate) if kind == "rain" else particles.snow_sizes(rate)
    wanted = STREET.view(0.4, 64, 48)
    for index, size in enumerate(sizes):
        velocity = np.array([0.5, -0.2, -size.fall_m_s])
        true = particles.places(size, velocity, wanted, 5.0, seeds.key(SEED, index, purpose))
        shown = page.run(
            f"import('mudg/particles').then((p) => [...p.places(p.{kind}Sizes({rate})[{index}], {velocity.tolist()},"
            f" {seen_by(wanted)}, 0.4, 5, mudg.facts.particle_keys.{kind}[{index}])])"
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


def test_streaks_stand_where_the_program_draws_them(opened: tuple[Browser, SceneModel]) -> None:
    page, model = opened
    weather(page, {})
    dry = brightness(page)
    weather(page, {"snow": {"mm_h": 4, "cover": 0.0}})
    snowy = brightness(page)
    wanted = STREET.view(0.4, 160, 96)
    depth = render_view(model, wanted, raster_of(model)).depth[0].nan_to_num(np.inf).numpy()
    fall = particles.Falling(particles.snow_sizes(4), (0.5, 0.0), 8.0, 0.01, "flakes")
    velocity = page.run("mudg.drive.velocity(0.4)")
    covered = 1 - np.exp(-particles.falling(wanted, depth, fall, tuple(velocity), SEED))
    preview = "w.preview(mudg.renderer.conditions, mudg.loaded[0].scene.sky)"
    air = np.mean(page.run(f"import('mudg/weather').then((w) => {preview})")["fog"][:3])
    ground = np.s_[55:]  # dark, so that flakes show; their edges, because the veil changes everything a little
    shown, true = ((part - uniform_filter(part, 9))[ground] for part in (snowy - dry, covered * (air - dry)))
    assert np.corrcoef(shown.ravel(), true.ravel())[0, 1] > 0.7
    assert shown.std() == pytest.approx(true.std(), rel=0.5)
    weather(page, {})
    assert np.array_equal(brightness(page), dry)


def test_snow_lies_on_the_ground_alone(opened: tuple[Browser, SceneModel]) -> None:
    page, model = opened
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


def test_the_sliders_write_what_the_program_reads(opened: tuple[Browser, SceneModel], tmp_path: Path) -> None:
    page, _ = opened

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
