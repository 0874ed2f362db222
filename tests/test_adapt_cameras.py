"""Lessons that leave out a camera: who saw what, whose colours count, and what is learned where nobody looked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from fit_settings import fit_config

from mudg.base.camera_colors import SAME_COLORS, CameraColors, ColorMap
from mudg.base.errors import InputError
from mudg.base.palette import ID
from mudg.base.renders import RenderPlanes
from mudg.base.types import Camera, View
from mudg.data.city import CityConfig
from mudg.data.clips.condition import WarpSource
from mudg.data.clips.from_city import HELD_OUT
from mudg.data.cloudfile import read_fused
from mudg.data.scene import read_image, read_scene
from mudg.models.mdm import files
from mudg.models.mdm.extended import extended
from mudg.stages import adapt, fit, fuse, ingest
from mudg.stages.adapting import cameras as adapt_cameras
from mudg.stages.adapting import clips as adapt_clips
from mudg.stages.adapting import lessons as adapt_lessons
from mudg.stages.config import AdaptConfig, FuseConfig, IngestConfig
from mudg.stages.fitting.storage import load_model

CAMERA = Camera("front", 16, 12, 8.0, 8.0, 8.0, 6.0)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """A small drive of two cameras, its cloud, a fit to it, and a tiny model that uses renders."""
    root = tmp_path_factory.mktemp("cameras")
    city = CityConfig(seed=5, n_frames=8, width=96, height=64, cameras=("front", "front_left"), lidar_azimuth_step_deg=0.6)
    ingest.run(IngestConfig(city=city, test_every=0), ingest.CITY, root / "scene")
    fuse.run(FuseConfig(), root / "scene", root / "fuse")
    fit.run(fit_config(method="street_gaussians", iterations=30, start__gaussians=8000), root / "scene", root / "fuse", root / "fit")
    before = files.load("embedded-tiny")
    files.save(extended(before, replace(before.config, renders=True, area_px=96 * 64)), root / "tiny", "", {})
    return root


def settings(log, **changes):
    plain = AdaptConfig(
        model=str(log / "tiny"), shifts_m=(1.0,), block=2, held_out_every=3, fit_iterations=8, precision="float32", processes=1,
        cameras_left_out=("front",),
    )  # fmt: skip
    return replace(plain, **changes)


# who saw what ---------------------------------------------------------------------------------------------------------


def planes(depth_m: float, alpha: float = 1.0, name: str = "building") -> RenderPlanes:
    """A wall at one depth everywhere."""
    size = (1, CAMERA.height, CAMERA.width)
    full = lambda value: torch.full(size, value)  # noqa: E731
    return RenderPlanes(torch.zeros(3, *size[1:]), full(depth_m), full(alpha), full(1.0), torch.full(size, ID[name], dtype=torch.uint8))


def turned(degrees: float, time_s: float = 0.0) -> View:
    """The camera at the origin, turned about its vertical axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    return View(CAMERA, pose, time_s)


def seen_share(monkeypatch, here: RenderPlanes, other: View, surface_m: float, usable: bool = True) -> float:
    monkeypatch.setattr(adapt_cameras, "render_planes", lambda model, view: here)
    depth, same = torch.full((CAMERA.height, CAMERA.width), surface_m), torch.ones(CAMERA.height, CAMERA.width)
    source = WarpSource(other, same[None], depth, same < 0, same.to(torch.uint8), same.bool() & usable)
    witnesses = adapt_cameras.Witnesses(None, (source,))  # type: ignore[arg-type]
    return float(witnesses.see(turned(0)).float().mean())


def test_a_pixel_is_seen_where_another_photograph_shows_it_unhidden(monkeypatch):
    wall = planes(10.0)
    assert seen_share(monkeypatch, wall, turned(0), 10.0) == 1
    assert seen_share(monkeypatch, wall, turned(180), 10.0) == 0
    assert seen_share(monkeypatch, wall, turned(0), 5.0) == 0  # something stands before it
    assert seen_share(monkeypatch, wall, turned(0), 10.0, usable=False) == 0  # the vehicle itself
    assert 0.3 < seen_share(monkeypatch, wall, turned(45), 1000.0) < 0.7  # half of it looks there
    assert seen_share(monkeypatch, planes(1000.0, alpha=0.0), turned(0), 1000.0) == 0  # the sky


def test_what_may_move_is_seen_at_the_same_moment_only(monkeypatch):
    car = planes(10.0, name="car")
    assert seen_share(monkeypatch, car, turned(0, time_s=0.03), 10.0) == 1
    assert seen_share(monkeypatch, car, turned(0, time_s=0.5), 10.0) == 0
    assert seen_share(monkeypatch, planes(10.0), turned(0, time_s=0.5), 10.0) == 1


def test_the_truth_has_the_colours_of_the_cameras_that_are_shown():
    rgb = torch.tensor([0.2, 0.4, 0.6]).view(3, 1, 1).expand(3, 4, 5)
    same = adapt_cameras.recolored(rgb, "front", "left", SAME_COLORS, SAME_COLORS)
    assert torch.equal(same, rgb)
    darker = CameraColors("front", {"left": ColorMap((1.25,) * 3, (0.0,) * 3)})  # left takes 0.8 of front's light
    assert torch.allclose(adapt_cameras.recolored(rgb, "front", "left", darker, SAME_COLORS), 0.8 * rgb)
    other = CameraColors("right", {"left": ColorMap((0.5,) * 3, (0.1,) * 3)})
    assert torch.allclose(adapt_cameras.recolored(rgb, "front", "left", darker, other), 0.4 * rgb + 0.1)


# lessons and clips ----------------------------------------------------------------------------------------------------


def test_a_lesson_shows_all_cameras_but_one_and_scores_nothing(log):
    learnt, lessons = adapt._open_log(settings(log), files.load(str(log / "tiny")), log / "scene", log / "fuse", log / "fit")
    plain = adapt_lessons.lessons_of(read_scene(log / "scene"), settings(log))
    assert lessons[:-1] == plain
    lesson, frames = lessons[-1], {f.id: f.view.camera.name for f in read_scene(log / "scene").frames}
    assert (lesson.name, lesson.left_out, lesson.shift_m) == ("without_front", "front", 0.0)
    assert {frames[name] for name in lesson.shown} == {"front_left"}
    asked = [name for _, ids in lesson.truth for name in ids]
    assert asked and {frames[name] for name in asked} == {"front"} and len(set(asked)) == len(asked)
    plan = adapt_clips.plan_clips(lessons, settings(log))
    scored = {name for number, _, ids in plan if number >= HELD_OUT for name in ids}
    learned = {name for number, one, ids in plan if one.left_out for name in ids if number < HELD_OUT}
    assert learned and scored and not learned & scored
    assert not any(one.left_out for number, one, _ in plan if number >= HELD_OUT)


def test_what_no_other_camera_saw_is_the_models_own(log, tmp_path, monkeypatch):
    config, model = settings(log), files.load(str(log / "tiny"))
    learnt, lessons = adapt._open_log(config, model, log / "scene", log / "fuse", log / "fit")
    lesson = lessons[-1]
    folder = adapt_lessons.fit_lesson(config, learnt, lesson, tmp_path / lesson.name)
    assert {f.view.camera.name for f in read_scene(folder / "scene").frames} == {"front_left"}
    made = []
    generate = adapt_clips.generated
    monkeypatch.setattr(adapt_clips, "generated", lambda *given: made.append(generate(*given)) or made[-1])
    ids = lesson.truth[0][1]
    clip = adapt_clips.ClipMaker(config, learnt, lesson, model, folder).make(ids, 0)
    scene = read_scene(log / "scene")
    witnesses = adapt_cameras.Witnesses.of(scene, adapt_cameras.others_of(scene, "front"), load_model(log / "fit"))
    seen = witnesses.see(clip.condition.views[0])
    assert 0.05 < float(seen.float().mean()) < 0.95
    assert torch.equal(clip.rgb[0][:, ~seen], made[0].rgb[0][:, ~seen])
    photo = adapt_clips.resize_area(read_image(scene, next(f for f in scene.frames if f.id == ids[0])), *seen.shape[::-1])
    whole, own = (read_fused(folder / "fuse").colors for folder in (log, folder))
    expected = adapt_cameras.recolored(adapt_clips.image_tensor(photo), "front", "front_left", whole, own)
    assert torch.allclose(clip.rgb[0][:, seen], expected[:, seen])


def test_a_camera_that_no_other_one_looks_at_gives_no_lesson(log, monkeypatch, capsys):
    monkeypatch.setattr(adapt_cameras, "LEAST_SEEN", 1.01)
    lessons = adapt_cameras.camera_lessons(read_scene(log / "scene"), settings(log), load_model(log / "fit"))
    assert lessons == [] and "no lesson leaves this camera out" in capsys.readouterr().err


def test_an_unknown_camera_is_refused(log):
    with pytest.raises(InputError, match="no such camera"):
        adapt._open_log(settings(log, cameras_left_out=("roof",)), files.load(str(log / "tiny")), log / "scene", log / "fuse", log / "fit")
