"""The fit end to end on a tiny exact street: it learns, it resumes bit for bit, it refuses what is not finite."""

from __future__ import annotations

import dataclasses
import importlib.util
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints

import numpy as np
import pytest
import torch
from fit_settings import fit_to, fitted_bytes, interrupted, log_lines, mean_psnr, written_street
from fit_settings import small_fit as settings
from refusals import refused
from toy_world import camera, car_pose, fused_cloud, truth, view_at, write_scene

from mudg import native
from mudg.base import geometry, store
from mudg.base.errors import InputError, NumericsError, UsageError
from mudg.base.palette import ID
from mudg.base.types import View
from mudg.core import metrics
from mudg.core.raster.rasterize import RasterConfig
from mudg.gaussians import fit
from mudg.gaussians import trust as fit_trust
from mudg.gaussians import views as fit_views
from mudg.gaussians.corrections import Appearance
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.schedule import FiniteCheck
from mudg.gaussians.settings import METHODS, FitConfig
from mudg.scene.clouds import read_fused, write_fused
from mudg.scene.observations import ObservationWriter
from mudg.scene.read import read_scene
from mudg.steps.settings import run_preset

SIZE = (60, 40)
FRAMES = 6


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Path]:
    """A scene, its fused cloud, and perfect virtual views 2 m to either side."""
    return written_street(tmp_path_factory.mktemp("world"), SIZE, FRAMES, (2.0, -2.0))


@pytest.fixture(scope="module")
def learnt(world, tmp_path_factory) -> Path:
    """What 150 steps give."""
    return fit_to(world, tmp_path_factory.mktemp("learnt") / "fit", settings("street_gaussians", iterations=150)).run()


def test_it_learns(world, learnt, tmp_path):
    """Some 150 steps from round grey blobs must clearly beat the start, in colour, depth and semantics."""
    start, end = (fit_to(world, tmp_path / "start", settings("street_gaussians", iterations=1)).run(), learnt)
    assert mean_psnr(end, SIZE) > mean_psnr(start, SIZE) + 5.0
    assert mean_psnr(end, SIZE) > 21.0
    view = view_at(0.3, camera(width=SIZE[0], height=SIZE[1]))
    seen, exact = fit.render_view(fit.load_model(end), view, RasterConfig()), truth(view)
    both = torch.isfinite(exact.depth) & torch.isfinite(seen.depth)
    assert metrics.depth_errors(seen.depth, exact.depth, both).abs_rel < 0.15
    iou = metrics.iou_of(metrics.confusion(seen.semantics, exact.semantics))
    assert iou["road"] > 0.9 and iou["sky"] > 0.9
    files = ("model.json", "gaussians.safetensors", "nodes.safetensors", "log.jsonl", "preview/000150.png", "run.yaml")
    assert all((end / name).is_file() for name in (*files, "manifest.json"))
    assert not (end / "steps").exists()
    for time_s in (0.0, 1.4):
        view = view_at(time_s, camera(width=SIZE[0], height=SIZE[1]))
        semantics = fit.render_view(fit.load_model(learnt), view, RasterConfig()).semantics
        uv, _ = geometry.project(view, car_pose(time_s)[None, :3, 3])
        assert semantics[int(uv[0, 1]), int(uv[0, 0])] == ID["car"]


def test_perfect_virtual_views_help_off_the_path(world, learnt, tmp_path):
    config = settings("mudg_s", iterations=150, virtual__probability=0.4)
    guided = fit_to(world, tmp_path / "guided", config, observations=(world["virtual"],)).run()
    assert mean_psnr(guided, SIZE, 2.0) > mean_psnr(learnt, SIZE, 2.0) + 0.3


def test_interrupted_and_resumed_equals_uninterrupted(world, tmp_path, monkeypatch):
    """Ctrl-C and SIGTERM before and after virtual views join, a densification and an opacity reset; learnt poses and
    all. Bit for bit."""
    config = settings("mudg_s", iterations=26, poses__learn=True)
    schedule = dataclasses.replace(fit.densify_schedule(config), reset_every=12)
    monkeypatch.setattr(fit, "densify_schedule", lambda *_given: schedule)
    due = [[step for step in range(1, 27) if due(step)] for due in (schedule.reset_due, schedule.due)]
    assert (due, config.virtual.start * config.iterations) == ([[12], [10]], pytest.approx(3.9))
    step = fit_to(world, tmp_path / "whole", config, observations=(world["virtual"],))
    whole, parts = step.run(), tmp_path / "parts"
    for stop in (4, 9, 10, 12):
        with interrupted(stop):
            replace(step, out=parts).run()
        assert (parts / "steps" / f"step_{stop:08d}").is_dir()
    assert fitted_bytes(replace(step, out=parts).run()) == fitted_bytes(whole)


def test_results_depend_neither_on_threads_nor_on_what_is_remembered(world, tmp_path, monkeypatch):
    """Row counts kept between densifications, and any number of threads: the same bytes."""
    config = settings("street_gaussians", iterations=22)
    first = fit_to(world, tmp_path / "a", config).run()

    def counted_again(model):
        return torch.bincount(model.table.labels["node"].long(), minlength=len(model.nodes)).tolist()

    monkeypatch.setattr(SceneModel, "counts", counted_again)
    before = native.threads()
    native.set_threads(3) if native.library() is not None else None
    torch.set_num_threads(2)
    try:
        second = fit_to(world, tmp_path / "b", config).run()
        assert torch.get_num_threads() == 2
    finally:
        native.set_threads(before) if native.library() is not None else None
    assert fitted_bytes(first) == fitted_bytes(second)


def test_the_opacity_weight_makes_gaussians_fainter_and_is_logged(world, tmp_path):
    means = {}
    for weight in (0.0, 0.5):
        chosen = settings("street_gaussians", iterations=12, densify__kind="none", loss__opacity_weight=weight)
        folder = fit_to(world, tmp_path / str(weight), chosen).run()
        means[weight] = torch.sigmoid(fit.load_model(folder).table["logits"]).mean().item()
        assert ("loss_opacity" in log_lines(folder)[0]) == (weight > 0)
    assert means[0.5] < means[0.0]


def test_tensorboard_shows_the_log_and_changes_nothing(world, tmp_path, monkeypatch):
    """What the package is told are the numbers of log.jsonl, and the result stays the same."""
    told: list[tuple[str, float, int]] = []

    class Writer:
        def __init__(self, folder: str) -> None:
            Path(folder).mkdir()
            (Path(folder) / f"events.out.tfevents.{len(told)}").write_bytes(b"")

        def add_scalar(self, *entry) -> None:
            told.append(entry)

        def flush(self) -> None: ...
        def close(self) -> None: ...

    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: name == "tensorboard" or find(name, *rest))
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", SimpleNamespace(SummaryWriter=Writer))
    plain = fit_to(world, tmp_path / "plain", settings("street_gaussians", iterations=12)).run()
    step = replace(fit_to(world, tmp_path / "watched", settings("street_gaussians", iterations=12)), tensorboard=True)
    watched = step.run()
    assert fitted_bytes(watched) == fitted_bytes(plain)
    assert store.read_json(watched / store.MANIFEST) == store.read_json(plain / store.MANIFEST)
    entries = [(k, v, line["step"]) for line in log_lines(watched) for k, v in line.items()]
    numbers = [(f"fit/{k}", *entry) for k, *entry in entries if k not in ("step", "view")]
    assert told == numbers and len(numbers) > 3
    (watched / "tensorboard" / "mine.txt").write_text("mine")
    assert replace(step, overwrite=True, settings=settings("street_gaussians", iterations=13)).run() == watched
    left = sorted(path.name for path in (watched / "tensorboard").iterdir())
    assert left == [f"events.out.tfevents.{len(numbers)}", "mine.txt"], "files of the run went, that of the user stays"


def test_virtual_views_do_not_feed_densification(world, monkeypatch, tmp_path):
    kinds, rasterize = [], fit.rasterize

    def spy(gaussians, view, config, absgrad=False, **rest):
        kinds.append((view.camera.width, absgrad))
        return rasterize(gaussians, view, config, absgrad=absgrad, **rest)

    monkeypatch.setattr(fit, "rasterize", spy)
    config = settings("mudg_s", virtual__probability=0.5, virtual__start=0.0, checkpoint_every=999)
    fit_to(world, tmp_path / "fit", config, observations=(world["virtual"],)).run()
    assert {absgrad for width, absgrad in kinds if width == 30} == {False}
    assert any(absgrad for width, absgrad in kinds if width == SIZE[0])


# ---- what must be refused ------------------------------------------------------------------------


def test_a_non_finite_loss_is_named_and_changes_nothing(world, tmp_path, monkeypatch):
    sky_map, adam_step, stepped = fit.losses.sky_map, fit.adam_step, []
    poisoned = lambda alpha, sky: sky_map(alpha, sky) * (float("nan") if len(stepped) == 4 else 1.0)
    noted = lambda model, step, *rest: (stepped.append(step), adam_step(model, step, *rest))
    monkeypatch.setattr(fit, "adam_step", noted)
    monkeypatch.setattr(fit.losses, "sky_map", poisoned)
    with pytest.raises(NumericsError, match=r"'sky' is not finite[\s\S]*front/00000\d, step 5"):
        fit_to(world, tmp_path / "fit", settings("street_gaussians")).run()
    assert stepped == [1, 2, 3, 4]


def test_a_non_finite_gradient_is_named_and_never_reaches_the_parameters(world):
    scene = read_scene(world["scene"])
    config = settings("street_gaussians", start__gaussians=300)
    model = fit.start_state(config, scene, fused_cloud(FRAMES), *fit.recorded_views(config, scene)).model
    model.table["log_scales"].grad = torch.zeros_like(model.table["log_scales"])
    model.table["log_scales"].grad[3, 1] = float("inf")
    check = FiniteCheck(9)
    for view in ("front/000001", "front/000002"):
        check.gradients(view, model, Appearance({}))
    refused(r"gaussians.log_scales, view front/000001, step 9", check.refuse, raises=NumericsError)
    assert model.table["log_scales"].grad is None


def test_a_fit_without_views_or_a_camera_that_is_there_is_refused(world, tmp_path):
    (tmp_path / "empty").mkdir()
    for config, views, error, said in (
        (settings("mudg_s"), (), UsageError, "virtual observations"),
        (settings("mudg_s"), (tmp_path / "empty",), InputError, "no finished virtual views"),
        (settings("street_gaussians", cameras=("rear",)), (), UsageError, "no camera named 'rear'"),
    ):
        refused(said, fit_to(world, tmp_path / "fit", config, observations=views).run, raises=error)
    refused("no fitted scene", fit.load_model, tmp_path)


def test_views_of_several_folders_are_those_of_one_folder_with_all(world, tmp_path):
    names = sorted(path.name for path in world["virtual"].iterdir())
    for name in names:
        shutil.copytree(world["virtual"] / name, tmp_path / f"of {name}" / name)
    several = [tmp_path / f"of {name}" if number else world["virtual"] / name for number, name in enumerate(names)]
    config = settings("mudg_s", iterations=4, virtual__start=0.0)
    step = fit_to(world, tmp_path / "whole", config, observations=(world["virtual"],))
    together = replace(step, out=tmp_path / "together").run()
    apart = replace(step, out=tmp_path / "apart", observations=tuple(several)).run()
    assert fitted_bytes(apart) == fitted_bytes(together)
    with pytest.raises(InputError, match=r"same name[\s\S]*front_shift"):
        replace(step, out=tmp_path / "twice", observations=(world["virtual"], several[0])).run()
    assert len(names) > 1 and not (tmp_path / "twice").exists()


def test_a_generated_view_of_which_no_pixel_counts_is_no_number(world, tmp_path):
    """As frame 0 of the windows of published-type models."""
    view = view_at(0.9, camera(width=30, height=20), left_m=2.0)
    with ObservationWriter(tmp_path / "virtual" / "front_shift+2.0", "front_shift+2.0", "mudg_r") as writer:
        writer.add(replace(truth(view), kind="virtual", mask=torch.zeros(1, 20, 30, dtype=torch.bool)))
    always = {"virtual__probability": 1.0, "virtual__start": 0.0, "virtual__stop": 1.0}
    config = settings("mudg_s", iterations=2, **always, virtual__beside=False, virtual__gaussians=0)
    folder = fit_to(world, tmp_path / "fit", config, observations=(tmp_path / "virtual",)).run()
    last = log_lines(folder)[-1]
    assert last["view"].startswith("front_shift") and "psnr" not in last and "loss_virtual_color" in last


def test_recorded_observations_are_refused_as_virtual_views(world, tmp_path):
    """The truth that `mudg score` keeps shows held-out frames: nothing may be fitted to it."""
    sets = tmp_path / "sets"
    shutil.copytree(world["virtual"], sets)
    view = view_at(0.9, camera(width=30, height=20))
    with ObservationWriter(sets / "front_recorded", "front_recorded", "truth", "recorded") as writer:
        writer.add(replace(truth(view), kind="recorded"))
    with pytest.raises(InputError, match=r"recorded views[\s\S]*front_recorded[\s\S]*mudg synthesize"):
        fit_to(world, tmp_path / "fit", settings("mudg_s"), observations=(sets,)).run()
    assert not (tmp_path / "fit").exists()


# ---- odd scenes ----------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["gs3d", "street_gaussians"])
def test_scenes_without_tracks_or_labels_or_with_one_frame_work(tmp_path, method):
    write_scene(tmp_path / "scene", frames=1, width=SIZE[0], height=SIZE[1], labels=False, tracks=False)
    cloud = fused_cloud(1, semantics=False)
    write_fused(tmp_path / "fuse", type(cloud)(cloud.static, {}), {})
    paths = {name: tmp_path / name for name in ("scene", "fuse")}
    folder = fit_to(paths, tmp_path / "fit", settings(method, iterations=60)).run()
    model, view = fit.load_model(folder), view_at(0.0, camera(width=SIZE[0], height=SIZE[1]))
    seen, exact = fit.render_view(model, view, RasterConfig()), truth(view)
    assert seen.semantics is None
    ground = (exact.semantics != ID["sky"])[None]  # gs3d has no sky
    plain = exact.rgb[:, ground[0]].mean(1)[:, None, None].expand_as(exact.rgb)
    # measured: 1.0 to 1.3, by processor, and 8.7 dB more
    assert metrics.psnr(seen.rgb, exact.rgb, ground) > metrics.psnr(plain, exact.rgb, ground) + 0.7


def test_view_order_is_a_function_of_seed_and_step_and_fair_and_virtual_views_take_nothing_from_it():
    views = fit_views.ViewSet("abcd", "xy")  # anything in order
    recorded, again = ([views.choose(7, step, 0.0)[0] for step in range(400)] for _ in range(2))
    assert recorded == again
    assert all(sorted(recorded[i : i + 4]) == list("abcd") for i in range(0, 400, 4))
    alone, beside = ([views.choose(7, step, 0.3, both) for step in range(400)] for both in (False, True))
    assert {len(step) for step in alone} == {1} and {len(step) for step in beside} == {1, 2}
    assert 0.2 < sum(v in "xy" for (v,) in alone) / 400 < 0.4
    assert [step[0] for step in beside] == recorded and [step[-1] for step in beside] == [v for (v,) in alone]


def test_fused_points_give_depth_beside_the_path(world):
    """Drawn at a shifted view, the static points and those of the moving car lie on the exact surfaces."""
    scene = read_scene(world["scene"])
    view = view_at(scene.frames_of("front")[3].view.time_s, camera(width=SIZE[0], height=SIZE[1]), left_m=0.6)
    lidar = fit_views.fused_lidar(read_fused(world["fuse"]), scene.tracks)(view)
    exact = truth(view)
    relative = ((lidar.depth_m - exact.depth.reshape(-1)[lidar.pixel]).abs() / lidar.depth_m).nan_to_num(1.0)
    assert len(lidar.pixel) > 200 and relative.median() < 0.03
    car = exact.semantics.reshape(-1)[lidar.pixel] == ID["car"]
    assert car.sum() > 5 and relative[car].median() < 0.05


def test_virtual_views_of_the_published_fit_have_the_published_terms_alone(world, tmp_path, monkeypatch):
    """Perception, dense depth and classes; the sky has a term on recorded views, and none on virtual ones."""
    seen: dict[bool, set[str]] = {True: set(), False: set()}
    monkeypatch.setattr(FiniteCheck, "terms", lambda _, view, terms: seen["virtual_depth" in terms].update(terms))
    paper = run_preset("paper").fit
    virtual = replace(paper.virtual, perception="filters", start=0.0, probability=0.5)
    config = replace(settings("mudg_s", iterations=12), loss=paper.loss, virtual=virtual)
    fit_to(world, tmp_path / "fit", config, observations=(world["virtual"],)).run()
    assert seen[True] == {"virtual_perceptual", "virtual_depth", "virtual_semantics"}
    assert {"color", "lidar", "sky"} <= seen[False] and "semantics" not in seen[False]


def test_lidar_pixels_agree_with_exact_depth_and_leave_out_what_lies_behind(world):
    scene = read_scene(world["scene"])
    frame = scene.frames_of("front")[2]
    lidar = fit_views._SweepCache(scene).pixels_of(frame.view)
    exact = truth(frame.view).depth.reshape(-1)[lidar.pixel]
    relative = ((lidar.depth_m - exact).abs() / exact).nan_to_num(1.0)
    assert len(torch.unique(lidar.pixel)) == len(lidar.pixel) > 200
    assert relative.median() < 0.03 and (relative < 0.2).float().mean() > 0.85
    view = View(camera(width=SIZE[0], height=SIZE[1]), geometry.invert(geometry.CAM_FROM_EGO_AXES), 0.0)
    points = np.array([[5.0, 0.0, 0.0], [20.0, 0.02, 0.0], [20.0, -6.0, 0.0]], np.float32)
    assert sorted(fit_views.lidar_pixels(view, points, 0.6).depth_m.tolist()) == [5.0, 20.0]
    assert len(fit_views.lidar_pixels(view, points[:0], 0.6).pixel) == 0


def wall_seen_from(view: View, depth_m: float) -> fit_views.StoredView:
    shape = (view.camera.height, view.camera.width)
    depth = np.full(shape, depth_m, np.float32)
    return fit_views.StoredView("v", view, "virtual", np.zeros((*shape, 3), np.uint8), depth=depth)


def test_what_only_virtual_views_see():
    """A wall 6 m ahead with a box before it: from the side, what the box hid is unseen, the rest of the wall is
    seen."""
    cam = camera(width=SIZE[0], height=SIZE[1])
    ahead = View(cam, geometry.invert(geometry.CAM_FROM_EGO_AXES), 0.0)
    side = View(cam, geometry.yaw_matrix(0.0, (0.0, 1.5, 0.0)) @ geometry.invert(geometry.CAM_FROM_EGO_AXES), 0.0)
    hidden_y = 0.45 * 2  # the box spans |y| < 0.45 at x = 3, so it hides |y| < 0.9 of the wall at x = 6
    column = np.arange(cam.width) + 0.5
    witness = np.where(np.abs((column - cam.cx) / cam.fx * 3) < 0.45, 3.0, 6.0).astype(np.float32)
    recorded = (ahead, np.repeat(witness[None], cam.height, 0))
    unseen = fit_trust._unseen(wall_seen_from(side, 6.0), [recorded], [])[cam.height // 2]
    wall_y = 1.5 - (column - cam.cx) / cam.fx * 6
    in_image = np.abs(wall_y) < 0.95 * cam.cx / cam.fx * 6
    assert unseen[np.abs(wall_y) < hidden_y - 0.25].all()
    assert not unseen[(np.abs(wall_y) > hidden_y + 0.25) & in_image].any()
    assert unseen[wall_y > 1.2 * cam.cx / cam.fx * 6].all()  # beside the recorded image


def test_what_a_moving_object_shows_is_asked_where_the_object_was():
    """A point on the car, seen in another frame from elsewhere: the witness must look at the car's place then."""
    cam = camera(width=SIZE[0], height=SIZE[1])
    poses = [geometry.yaw_matrix(0.0, (6.0, 0.0, 0.0)), geometry.yaw_matrix(0.0, (6.0, 40.0, 0.0))]
    node = RigidNode("car", "car", (2.0, 2.0, 2.0), [0.0, 1.0], poses)
    late = View(cam, geometry.yaw_matrix(0.0, (0.0, 40.0, 0.0)) @ geometry.invert(geometry.CAM_FROM_EGO_AXES), 1.0)
    now = View(cam, geometry.invert(geometry.CAM_FROM_EGO_AXES), 0.0)
    shown = wall_seen_from(now, 5.2)
    witness = (late, shown.depth)
    middle = (cam.height // 2, cam.width // 2)
    assert not fit_trust._unseen(shown, [witness], [(node.size_m, node.pose_matrix)])[middle]
    assert fit_trust._unseen(shown, [witness], [])[middle]  # without the box the point stays 40 m to the side


def test_learning_rates_follow_the_length_of_the_run():
    long, short, end = (fit.learning_rates(*at)["means"] for at in ((1, 30_000), (1, 2_000), (2_000, 2_000)))
    assert (short, end) == pytest.approx((long * 15**0.5, 0.01 * short), rel=0.01)


def test_the_methods_that_can_be_fitted_are_those_of_the_configuration():
    fitted = {name: row for name, row in METHODS.items() if row.made_by == "render"}
    assert set(fitted) == set(get_args(get_type_hints(FitConfig)["method"]))
    for row in fitted.values():
        assert row.supervision[0] == "color"
        if row.scene == "gaussians":
            assert row.nodes[0] == "static" and ("sky" in row.nodes) == ("sky" in row.supervision)


@pytest.mark.parametrize("size", [1, 2, 3, 8, 374, 375])
def test_blocks_cover_images_of_any_size(size: int) -> None:
    centres = fit_trust.block_centres(size)
    spread = np.repeat(centres, fit_trust.STRIDE_PX)[:size]
    assert len(spread) == size
    assert np.abs(spread - np.arange(size)).max() <= fit_trust.STRIDE_PX // 2
