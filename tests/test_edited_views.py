"""What a diffusion model is shown of an edited drive, and views that it repairs."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from refusals import refused
from test_clips import RULES, image_of_wall, stripes, view_at, wall
from tiny_networks import small_mdm
from view_server import colors_in, question

from mudg.base import geometry, store
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import ID
from mudg.base.types import FusedCloud, Observation, Photo, PointCloud, RenderPlanes, View
from mudg.base.weather_settings import Conditions
from mudg.core.edit import Motion
from mudg.core.pictures import to_bytes
from mudg.core.weather.gbuffer import Surroundings
from mudg.core.weather.light import srgb_decode, srgb_encode
from mudg.diffusion import condition as clip_parts
from mudg.diffusion import model_files as files
from mudg.diffusion.condition import ConditionRules, DriveInputs, InWeather, build_conditions, image_tensor
from mudg.diffusion.model import MDM
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import JobInputs, view_maker
from mudg.editing.edit import boxes_mask, cleared_cloud, photos_of_edited, vacated_at
from mudg.editing.plan import Actor, EditPlan, EditWorld, plan_edits
from mudg.editing.render import REPAIR_STEPS, RenderMixer, off_path_m
from mudg.editing.script import parse_edits
from mudg.editing.settings import EditConfig, RenderConfig
from mudg.gaussians.rendering import raster_of, render_view
from mudg.gaussians.storage import load_model
from mudg.scene.observations import read_observations
from mudg.scene.read import read_scene
from mudg.sim.optics import Pinhole
from mudg.sim.session import CameraRequest, Instant, Session
from mudg.steps.edit import Edit
from mudg.steps.render import RenderViews
from mudg.steps.synthesize import Synthesize
from mudg.viewer.settings import ViewConfig
from mudg.viewer.view import FrameSource, server_of

CAR = (0.6, 1.0, 1.0)


def drive(text: str) -> EditPlan:
    """A small box 6 m ahead, at y = -2 at first and at y = 2 after a second; and a script on it."""
    poses = np.stack([geometry.yaw_matrix(0.0, (6.0, y, 0.0)) for y in (-2.0, 2.0)])
    world = EditWorld({"box": Actor("car", CAR, Motion.recorded([0.0, 1.0], poses))})
    return plan_edits(parse_edits(text, "edits.yaml"), world, lambda source: None)


def photo_with_box(time_s: float, y: float) -> Photo:
    """The striped wall 12 m ahead with a black box before it."""
    image = image_of_wall(view_at(), 12.0)
    columns = 24 - 40 * (y + np.array([0.5, -0.5])) / 5.7
    image[11:21, int(columns[0]) : int(columns[1]) + 1] = 0
    return Photo(view_at(time_s=time_s), image)


CLOUD = FusedCloud(wall(12.0, stripes), {})
REMOVED = "- remove: {ids: [box]}"


def test_the_condition_of_a_removed_object_is_that_of_a_log_that_never_had_it() -> None:
    """Two photographs with the box at different places, and two without any: the same condition, to the bit."""
    plan, target = drive(REMOVED), view_at(y=0.3, time_s=0.0)
    with_box = photos_of_edited([photo_with_box(0.0, -2.0), photo_with_box(1.0, 2.0)], plan)
    assert all(p.usable is not None and bool(p.usable[p.rgb.max(-1) > 0].any()) for p in with_box)
    assert not any(bool(p.usable[(p.rgb == 0).all(-1)].any()) for p in with_box)
    empty = [Photo(p.view, image_of_wall(view_at(), 12.0)) for p in with_box]
    given = build_conditions(DriveInputs(CLOUD, [], with_box, vacated_at=vacated_at(plan)), [target], RULES)[0]
    never = build_conditions(DriveInputs(CLOUD, [], empty), [target], RULES)[0]
    for name in ("color", "depth", "valid", "warped", "semantics"):
        assert torch.equal(getattr(given, name), getattr(never, name)), name
    seen = build_conditions(DriveInputs(CLOUD, [], [replace(p, usable=None) for p in with_box]), [target], RULES)[0]
    assert not torch.equal(seen.color, never.color)  # the box would be in the picture
    near, far = (float((one.backdrop - never.backdrop).abs().max()) for one in (given, seen))
    assert near < 0.2 < far


def test_what_nobody_saw_continues_its_surroundings_and_does_not_count_as_seen() -> None:
    plan = drive(REMOVED)
    photos = photos_of_edited([photo_with_box(0.0, -2.0)], plan)
    made = build_conditions(DriveInputs(CLOUD, [], photos, vacated_at=vacated_at(plan)), [view_at()], RULES)[0]
    hole = vacated_at(plan)(view_at()).mask
    assert 0 < float(hole.float().mean()) < 0.4
    assert not bool((made.warped[0, 0] | made.valid[0, 0])[hole].any())
    truth = image_tensor(image_of_wall(view_at(), 12.0))
    assert float((made.color[0] - truth).abs()[:, hole].max()) < 0.35  # smooth, not black
    assert torch.allclose(made.color[0][:, ~hole], truth[:, ~hole], atol=1e-5)


@pytest.mark.parametrize("usual", [0.9, 0.3])
def test_what_photographs_determined_behind_a_removed_object_is_kept(usual: float) -> None:
    """A red render that is as certain in the left half of what stood there as anywhere in the view, however certain
    that is, and hardly in the right half."""
    plan, full = drive(REMOVED), torch.tensor([1.0, 0, 0]).view(3, 1, 1)
    vacated = vacated_at(plan)(view_at())
    columns = torch.nonzero(vacated.stood.any(0))[:, 0]
    left = vacated.stood & (torch.arange(48) <= int(columns.float().mean()))
    right = vacated.stood & ~left
    assert bool(left.any()) and bool(right.any())

    def render(view: View) -> RenderPlanes:
        one = torch.ones(1, view.camera.height, view.camera.width)
        certainty = torch.where(right, 0.1 * usual, usual)[None]
        return RenderPlanes(full * one, 12 * one, one, certainty, (2 * one).to(torch.uint8))

    photos = photos_of_edited([photo_with_box(0.0, -2.0)], plan)
    made = build_conditions(
        DriveInputs(CLOUD, [], photos, render_at=render, vacated_at=vacated_at(plan)), [view_at()], RULES
    )[0]
    red = (made.color[0] == full).all(0)
    assert made.renders is not None and bool(red[left].all()) and bool(made.warped[0, 0][left].all())
    assert bool((made.renders.certainty[0, 0][left] == usual).all())
    unknown = vacated.mask & ~left
    assert not bool(red[unknown].any()) and not bool(made.warped[0, 0][unknown].any())
    assert bool((made.renders.certainty[0, 0][unknown] == 0).all())


def test_ground_that_a_removed_object_darkened_keeps_its_place_but_not_its_colour() -> None:
    """Road points half a metre below the box; those in its shadow were coloured black."""
    x, y = np.meshgrid(np.arange(3, 14, 0.03), np.arange(-8, 8, 0.03))
    xyz = np.stack([x.ravel(), y.ravel(), np.full(x.size, -0.5)], 1).astype(np.float32)
    plan = drive(REMOVED)
    dark = (np.abs(xyz[:, 0] - 6) < 0.8) & (np.abs(xyz[:, 1] + 2) < 1)
    rgb = np.where(dark[:, None], 0, 130).repeat(3, 1).astype(np.uint8)
    cloud = FusedCloud(PointCloud(xyz, rgb, "world", semantics=np.full(len(xyz), ID["road"], np.uint8)), {})
    made = build_conditions(DriveInputs(cloud, [], [], vacated_at=vacated_at(plan)), [view_at()], RULES)[0]
    plain = build_conditions(DriveInputs(cloud, [], []), [view_at()], RULES)[0]
    black = plain.valid[0, 0] & (plain.color[0].amax(0) < 0.1)
    assert int(black.sum()) > 10
    assert bool(made.valid[0, 0][black].all()) and torch.equal(made.depth[0, 0][black], plain.depth[0, 0][black])
    assert bool(((made.color[0][:, black] - 130 / 255).abs() < 0.05).all())


def test_the_published_reference_is_masked_too() -> None:
    photos = photos_of_edited([photo_with_box(0.0, -2.0)], drive(REMOVED))
    made = build_conditions(DriveInputs(CLOUD, [], photos), [view_at()], replace(RULES, published=True))[0]
    assert float(made.reference.amax(0).min()) > 0.2
    kept = torch.from_numpy(photos[0].usable)
    assert torch.equal(made.reference[:, kept], image_tensor(photos[0].rgb)[:, kept])


def test_photographs_count_where_an_object_is_on_its_recorded_place() -> None:
    """A stop after 0.5 s changes nothing before; a moved object masks its new place as well."""
    photos = [photo_with_box(0.0, -2.0), photo_with_box(1.0, 2.0)]
    early, late = photos_of_edited(photos, drive("- stop: {id: box, at_s: 0.5, brake_m_s2: 12}"))
    assert early.usable is None and late.usable is not None
    moved = photos_of_edited(photos, drive("- move: {id: box, left_m: 3, ground: false}"))[0]
    assert not moved.usable[16, 10 + 24] and not moved.usable[16, 17]


def test_a_box_beside_the_camera_does_not_cover_the_image() -> None:
    beside = (geometry.yaw_matrix(0.0, (0.0, -2.0, 0.0)), np.array([4.0, 1.8, 1.5]))
    mask = boxes_mask(view_at(), [beside])
    assert 0 < mask.mean() < 0.3 and not mask[:, :24].any()


def test_points_that_a_box_left_behind_are_cleared() -> None:
    cloud = FusedCloud(wall(6.2, stripes, (-3, 3), (-0.4, 0.4)), {})
    kept = cleared_cloud(cloud, drive(REMOVED)).static.xyz
    assert 0 < len(kept) < len(cloud.static.xyz)
    assert not ((np.abs(kept[:, 1] - 2.0) < 0.8) & (kept[:, 2] > -0.3)).any()
    assert len(cleared_cloud(cloud, drive("- move: {id: box, left_m: 1, ground: false}")).static) == len(kept)


def test_ground_continues_ground_and_what_is_above_continues_what_is_above() -> None:
    ids = torch.full((16, 16), ID["building"], dtype=torch.uint8)
    ids[8:] = ID["road"]
    color = torch.where((ids == ID["road"])[None], 0.2, 0.8).repeat(3, 1, 1)
    hole = torch.zeros(16, 16, dtype=torch.bool)
    hole[4:12, 5:11] = True
    ground = torch.full((16, 16), torch.nan)
    ground[8:] = 10.0
    spoilt = torch.where(hole, torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0)), color)
    vacated = clip_parts.Vacated(hole, ground, hole & False, hole)
    filled, classes = clip_parts.continued(spoilt, torch.where(hole, ID["car"], ids), vacated, hole)
    assert torch.allclose(filled, color, atol=1e-5) and torch.equal(classes, ids)


# -- through the commands --------------------------------------------------------------------------

FRAMES = 4
CAR_GONE = "- remove: {ids: [car]}"
FITTED = "fit/street_gaussians"
FIT = {"method": "street_gaussians", "start__gaussians": 900, "densify__max_gaussians": 1500}


@pytest.fixture(scope="module")
def run(street_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like that of ``mudg run``, and a tiny diffusion model."""
    root = tmp_path_factory.mktemp("run") / "run"
    shutil.copytree(street_run, root)
    torch.manual_seed(0)
    files.save(MDM(small_mdm(window=3, refine_widths=(16, 32), area_px=48 * 32, renders=True)), root / "model", "", {})
    return root


def script(folder: Path, text: str) -> Path:
    store.write_text(folder / "edits.yaml", text)
    return folder / "edits.yaml"


def synthesized(run: Path, out: Path, settings: SynthesizeConfig, **parts: Any) -> Path:
    return Synthesize(scene=run / "scene", fused=run / "fuse", **parts, out=out, settings=settings).run()


def views_of(folder: Path, name: str = "front_recorded") -> list[Observation]:
    seen = read_observations(folder / name)
    return [seen[i] for i in range(len(seen))]


def test_a_repaired_view_is_the_mean_of_render_and_generated_view(run: Path, tmp_path: Path) -> None:
    """Against what render writes and what the model makes of each view, mixed here in numpy: half the confidence on the
    recorded path, 1.5 times at 1.5 m; the same after an interruption."""
    shifts = {"shifts_m": (0.0, 1.5), "video": False, "device": "cpu"}
    model = str(run / "model")
    parts = {"scene": run / "scene", "model": run / FITTED}
    plain = RenderViews(**parts, out=tmp_path / "plain", settings=RenderConfig(**shifts)).run()
    step = RenderViews(
        **parts,
        fused=run / "fuse",
        out=tmp_path / "repaired",
        settings=RenderConfig(**shifts, repair=True, repair_model=model),
    )
    again = SynthesizeConfig(model=model, steps=REPAIR_STEPS, processes=1, device="cpu")
    inputs, loaded = JobInputs(run / "scene", run / "fuse", run / FITTED), files.load(model)
    result = step.run()
    for name, factor in (("front_recorded", 0.5), ("front_shift+1.5", 1.5)):
        pairs = list(zip(views_of(plain, name), views_of(result, name), strict=True))
        maker = view_maker(again, inputs, [pairs[0][0].view], loaded, None)
        for render, one in pairs:
            view = maker.make([render.view], 0, None)[2][0]
            weight = factor * view.confidence
            share = (weight / (1 + weight)).numpy()
            wanted = (1 - share) * render.rgb.numpy() + share * view.rgb.numpy()
            assert np.abs(one.rgb.numpy() - wanted).max() < 2 / 255  # each was rounded to 8 bits
            assert np.abs(one.rgb.numpy() - render.rgb.numpy()).max() > 0.05
            a, b, depth = (np.nan_to_num(seen.depth.numpy(), nan=-1.0) for seen in (render, view, one))
            both = (a > 0) & (b > 0)
            assert np.allclose(depth[both], ((1 - share) * a + share * b)[both], rtol=2e-3)
            assert np.array_equal(depth[~both], np.where(a > 0, a, b)[~both])
            assert torch.equal(one.semantics, render.semantics)
    folder = tmp_path / "repaired"
    whole = {path.name: path.read_bytes() for path in (folder / name / "rgb").iterdir()}
    for path in ("manifest.json", f"{name}/observations.json", f"{name}/data/000003.npz", f"{name}/rgb/000003.png"):
        (folder / path).unlink()  # as if stopped in the last window
    state = store.read_json(folder / "run.json") | {"state": "interrupted"}
    store.write_json(folder / "run.json", state)
    step.run()
    assert {path.name: path.read_bytes() for path in (folder / name / "rgb").iterdir()} == whole


def test_distances_from_a_path_are_those_of_its_densest_places() -> None:
    rng = np.random.default_rng(0)
    path = np.cumsum(rng.uniform(-1, 1, (6, 3)), axis=0)
    dense = np.concatenate([np.linspace(a, b, 4001) for a, b in zip(path, path[1:], strict=False)])
    for place in rng.uniform(-3, 3, (20, 3)):
        assert off_path_m(place, path) == pytest.approx(np.linalg.norm(dense - place, axis=1).min(), abs=1e-4)
    assert off_path_m(path[2] + 1e-9, path) < 1e-8
    assert off_path_m(path[0] + [0, 3, 4], path[:1]) == pytest.approx(5)


def test_sessions_and_exact_frames_are_repaired_like_renders(run: Path) -> None:
    """Pictures of a session and frames of the viewer against one view of ``RenderMixer``, with the shipped model."""
    scene, model = read_scene(run / "scene"), load_model(run / FITTED)
    raster = raster_of(model)
    frame = scene.frames_of("front")[1].view
    pose = frame.world_from_cam @ geometry.from_rotation_translation(np.eye(3), [-0.5, 0.0, 0.0])
    view, camera = replace(frame, world_from_cam=pose), frame.camera
    mixer = RenderMixer(JobInputs(run / "scene", run / "fuse", run / FITTED), device="cpu")
    render = render_view(model, view, raster)
    wanted = to_bytes(mixer(view, render).rgb)
    assert np.abs(wanted.astype(int) - to_bytes(render.rgb)).max() > 5
    session = Session(run, device="cpu", repair=True)
    start = Instant(view.time_s, pose)
    asked = CameraRequest(
        optics=Pinhole(camera.width, camera.height, *camera.intrinsics), start=start, layers=("rgb",), colors_of="front"
    )
    assert np.abs(session.render([asked])[0].layers["rgb"].astype(int) - wanted).max() <= 1
    for other in (
        replace(asked, start=replace(start, objects={})),
        replace(asked, end=Instant(view.time_s + 0.1, pose)),
    ):
        refused("cannot be repaired", session.render, [other], raises=UsageError)
    refused("repaired here", Session, run / FITTED, scene=run / "scene", repair=True, raises=UsageError)
    source = FrameSource(lambda _: [model], scene, 1600, torch.device("cpu"), [mixer])
    shown = lambda **more: np.rint(255 * colors_in(source.png(question(view, **more))[0]))
    assert np.abs(shown() - wanted).max() <= 1
    plain = render_view(model.without_nodes(["car"]), view, raster)
    assert np.abs(shown(hidden=["car"]) - to_bytes(plain.rgb)).max() <= 1


def test_what_cannot_be_repaired_is_refused(run: Path, tmp_path: Path) -> None:
    parts = {"scene": run / "scene", "model": run / FITTED, "out": tmp_path / "out"}
    settings, edits = RenderConfig(shifts_m=(0.0,), video=False, repair=True), script(tmp_path, CAR_GONE)
    alone = {"source": run / FITTED, "script": edits, "scene": run / "scene", "out": tmp_path / "changed"}
    changed = {"model": Edit(**alone, settings=EditConfig()).run(), "fused": run / "fuse"}
    for more, message in (
        ({}, "no --fused"),
        ({"fused": run / "fuse", "edits": edits}, "--edits or --layers"),
        (changed, "as it was recorded"),
    ):
        refused(message, RenderViews(**parts | more, settings=settings).run, raises=UsageError)
    assert not (tmp_path / "out").exists()
    whole = Edit(source=run, script=edits, out=tmp_path / "whole", settings=EditConfig()).run()
    refused("as it was recorded", Session, whole, device="cpu", repair=True, raises=UsageError)
    with pytest.raises(UsageError, match="as it was recorded"):
        server_of(ViewConfig(repair=True, images=0, port=0, device="cpu"), whole, None, None)


def test_synthesize_shows_the_edited_drive(run: Path, tmp_path: Path) -> None:
    settings = {"shifts_m": (0.0,), "steps": 1, "full_size": False, "processes": 1, "precision": "float32"}
    config, edits = SynthesizeConfig(model=str(run / "model"), **settings), script(tmp_path, CAR_GONE)
    plain = synthesized(run, tmp_path / "plain", config)
    made = synthesized(run, tmp_path / "made", config, edits=edits)
    fitted = synthesized(run, tmp_path / "fitted", config, edits=edits, fitted=run / FITTED)
    pictures = [[v.rgb for v in views_of(folder)] for folder in (plain, made, fitted)]
    assert not any(torch.equal(a, b) for a, b in zip(pictures[0], pictures[1], strict=True))
    assert not any(torch.equal(a, b) for a, b in zip(pictures[1], pictures[2], strict=True))
    with pytest.raises(InputError, match="no object of this id"):
        synthesized(run, tmp_path / "bad", config, edits=script(tmp_path, "- remove: {ids: [cat]}"))
    assert not (tmp_path / "bad").exists()


# -- published-type models -------------------------------------------------------------------------


def test_points_and_reference_of_the_published_condition_are_in_fog_at_their_own_distances() -> None:
    """Koschmieder's law: a black wall 12 m ahead has 1 - exp(-3 r / visibility) of the light of what is far away. So
    have its points, although their depth at the network's size is mixed with gaps, and its photograph, whose distance a
    render knows."""
    views = [view_at()]
    photo = Photo(views[0], np.zeros((32, 48, 3), np.uint8))
    ids = torch.full((1, 32, 48), ID["building"], dtype=torch.uint8)
    cloud = FusedCloud(wall(12.0, lambda y: np.zeros((y.size, 3))), {})

    def render(view: View) -> RenderPlanes:
        one = torch.ones(1, view.camera.height, view.camera.width)
        return RenderPlanes(0.5 * one.repeat(3, 1, 1), 12 * one, one, one, ids)

    light = Surroundings(*(np.full(3, 0.5) for _ in range(3)), np.zeros(3), np.array([0.0, 0.0, 1.0]), np.full(3, 0.5))
    fog = Conditions.model_validate({"weather": {"fog": {"visibility_m": 30}}})
    how = InWeather(fog, light, 0, lambda _: (0.0, 0.0, 0.0))
    rules = ConditionRules(12, 8, 48, 32, published=True)
    drive = DriveInputs(cloud, [], [photo], render, weather=how)
    clear = build_conditions(replace(drive, weather=None), views, rules)[0]
    made = build_conditions(drive, views, rules)[0]
    assert torch.equal(made.depth, clear.depth)
    assert float(clear.color.max()) == 0 == float(clear.reference.max())
    colored = made.color[0].amax(0) > 0
    assert 0.2 < float(colored.float().mean()) <= float(made.valid.float().mean())
    far = how.image(views[0], torch.zeros(3, 32, 48), torch.full((1, 32, 48), 2000.0), ids)
    across, down = np.meshgrid((np.arange(48) + 0.5 - 24) / 40, (np.arange(32) + 0.5 - 16) / 40)
    share = 1 - np.exp(-3 * 12 * np.sqrt(1 + across**2 + down**2) / 30)
    expected = torch.from_numpy(srgb_encode(srgb_decode(far.numpy()) * share)).float()
    small = torch.nn.functional.interpolate(expected[None], size=(8, 12), mode="bilinear")[0]
    assert torch.allclose(made.reference, small, atol=0.015)
    assert torch.allclose(made.color[0][:, colored], expected[:, ::4, ::4][:, colored], atol=0.015)
