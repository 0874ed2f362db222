"""Every option of the scene's nodes and appearance at once: resume to the bit, odd scenes, poisoned inputs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_settings import fit_to, fitted_bytes, interrupted, small_fit, written_clouds_and_views
from refusals import refused
from toy_world import CAR_SIZE, camera, car_pose, fused_cloud, truth, view_at, write_scene

from mudg.base.types import FusedCloud, PointCloud, Scene, Track
from mudg.core import metrics
from mudg.core.raster.rasterize import RasterConfig
from mudg.gaussians import fit
from mudg.gaussians.model import compose
from mudg.gaussians.nodes import DeformableNode
from mudg.gaussians.settings import FitConfig
from mudg.gaussians.start import mirrored_points
from mudg.scene.clouds import write_fused
from mudg.scene.observations import ObservationWriter
from mudg.scene.read import read_scene
from mudg.scene.write import SceneWriter

SIZE, FRAMES = (60, 40), 6
EVERYTHING = {
    "poses__learn": True,
    "poses__start": 0.3,
    "objects__deformable": True,
    "objects__mirror_start": True,
    "appearance__exposure": "image",
    "appearance__cameras": True,
    "loss__object_weight": 0.1,
}


def walker_track(times) -> Track:
    keys = np.stack([car_pose(float(t)) for t in times])
    keys[:, 1, 3] += 3.0
    keys[:, 2, 3] = 0.9
    return Track("walker", "pedestrian", [0.8, 0.6, 1.8], np.asarray(times, float), keys)


def walker_cloud() -> PointCloud:
    xyz = (np.random.Generator(np.random.PCG64(0)).uniform(-0.5, 0.5, (200, 3)) * [0.7, 0.5, 1.7]).astype(np.float32)
    return PointCloud(xyz, np.full((200, 3), 90, np.uint8), "object", np.full(200, 11, np.uint8))


def with_tracks(scene: Scene, tracks: tuple[Track, ...], out: Path) -> Scene:
    with SceneWriter(out, scene.id, scene.source) as writer:
        writer.copy_all_but_frames(replace(scene, tracks=tracks))
        for frame in scene.frames:
            writer.copy_frame(scene, frame)
        return writer.finish()


def written_world(root: Path, size: tuple[int, int], frames: int) -> dict[str, Path]:
    """A scene with a car and a walker, its fused cloud, perfect virtual views 2 m to the left."""
    plain = write_scene(root / "plain", frames=frames, width=size[0], height=size[1])
    scene = with_tracks(plain, (*plain.tracks, walker_track(plain.tracks[0].times_s)), root / "scene")
    cloud = fused_cloud(frames)
    both = FusedCloud(cloud.static, {**cloud.objects, "walker": walker_cloud()})
    return written_clouds_and_views(root, scene, both)


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> dict[str, Path]:
    return written_world(tmp_path_factory.mktemp("world"), SIZE, FRAMES)


def settings(method: str = "mudg_s", **changes) -> FitConfig:
    few = {"iterations": 20, "start__gaussians": 700, "densify__max_gaussians": 1200, "virtual__probability": 0.4}
    return small_fit(method, **{**few, **EVERYTHING, **changes})


def test_interrupted_and_resumed_equals_uninterrupted_with_everything_on(world, tmp_path):
    config = settings()
    step = fit_to(world, tmp_path / "whole", config, observations=(world["virtual"],))
    whole = step.run()
    with interrupted(13):
        replace(step, out=tmp_path / "parts").run()
    parts = replace(step, out=tmp_path / "parts").run()
    assert fitted_bytes(parts) == fitted_bytes(whole)
    tensors = {f"{name}.safetensors" for name in ("gaussians", "nodes", "appearance")}
    assert set(fitted_bytes(whole)) == tensors | {"model.json"}
    model = fit.load_model(whole)
    walker = next(node for node in model.nodes if node.name == "walker")
    assert isinstance(walker, DeformableNode)
    assert walker.offsets["deform"].detach().abs().max().item() > 0
    assert model.nodes[1].offsets["shift"].detach().abs().max().item() > 0


def test_everything_on_without_tracks_and_with_one_frame(tmp_path):
    write_scene(tmp_path / "scene", frames=1, width=SIZE[0], height=SIZE[1], labels=False, tracks=False)
    write_fused(tmp_path / "fuse", FusedCloud(fused_cloud(1, semantics=False).static, {}), {})
    world = {"scene": tmp_path / "scene", "fuse": tmp_path / "fuse"}
    folder = fit_to(world, tmp_path / "fit", settings("street_gaussians", iterations=4)).run()
    view = view_at(0.0, camera(width=48, height=32))
    seen, exact = fit.render_view(fit.load_model(folder), view, RasterConfig()).rgb, truth(view).rgb
    plain = exact.mean((1, 2), keepdim=True).expand_as(exact)
    assert metrics.psnr(seen, exact) > metrics.psnr(plain, exact) + 1.0  # better than one colour; measured: 1.6 dB


@pytest.mark.parametrize("label", ["car", "pedestrian"])
def test_an_object_seen_once_whose_track_has_one_key(world, tmp_path, label):
    """It exists at that moment only, deforms or not, and nothing divides by its span of zero."""
    plain = read_scene(world["scene"])
    once = Track("car", label, CAR_SIZE, np.array([0.3]), car_pose(0.3)[None])
    with_tracks(plain, (once,), tmp_path / "scene")
    points = fused_cloud(2).objects["car"]
    few = PointCloud(points.xyz[:3], points.rgb[:3], "object", None)
    write_fused(tmp_path / "fuse", FusedCloud(fused_cloud(2).static, {"car": few}), {})
    world = {"scene": tmp_path / "scene", "fuse": tmp_path / "fuse"}
    folder = fit_to(world, tmp_path / "fit", settings("street_gaussians", iterations=8)).run()
    model = fit.load_model(folder)
    moving = model.table.labels["node"] > 0
    assert (compose(model, 0.3).opacity[moving] > 0).any()
    assert not (compose(model, 0.6).opacity[moving] > 0).any()
    assert all(torch.isfinite(value).all() for value in model.table.columns.values())


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_no_sky_at_all_and_nothing_but_sky(world, share):
    scene = read_scene(world["scene"])
    config = settings("street_gaussians", iterations=4)
    views, classes = fit.recorded_views(config, scene)
    recorded = tuple(replace(view, sky=np.full(view.rgb.shape[:2], share > 0)) for view in views.recorded)
    state = fit.start_state(config, scene, fused_cloud(FRAMES), replace(views, recorded=recorded), classes)
    assert torch.isfinite(state.model.sky.table["panorama"]).all()
    seen = fit.render_view(state.model, recorded[0].view, RasterConfig())
    assert torch.isfinite(seen.rgb).all()
    view = recorded[0].view
    behind = state.model.sky.coarse_picture(view).detach()
    exact = truth(view).rgb
    plain = exact.mean((1, 2), keepdim=True).expand_as(exact)
    if share:
        assert metrics.psnr(behind, exact) > metrics.psnr(plain, exact) + 4.0
    else:
        assert float(behind.std((1, 2)).max()) < 1e-6


def test_a_virtual_picture_that_is_not_finite_is_refused_when_written(tmp_path):
    seen = truth(view_at(0.0, camera(width=12, height=8)))
    seen.rgb[1, 2, 3] = float("nan")
    with ObservationWriter(tmp_path / "v", "v", "test") as writer:
        refused(r"not finite[\s\S]*000000", writer.add, seen)


def test_mirrored_points_appear_where_nothing_was_measured():
    side = np.array([[x, 0.9, z] for x in (-1.0, 0.0, 1.0) for z in (0.0, 0.5)], np.float32)
    roof = np.array([[0.0, 0.05, 0.7]], np.float32)
    other, source = mirrored_points(np.concatenate([side, roof]))
    assert source.tolist() == list(range(6))
    assert np.allclose(other, side * [1, -1, 1])
    assert len(mirrored_points(np.concatenate([side, other]))[0]) == 0
    assert len(mirrored_points(side[:0])[0]) == 0
