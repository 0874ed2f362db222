"""Generated depth of published-type models against what points measured: an exact generator is left alone, a distorted
one is found out.

Exact depth is the ray-traced city's, or LiDAR points projected in float64.
"""

import numpy as np
import pytest
import torch
from scipy import ndimage
from toy_published import tiny_model

from mudg.base.types import Photo
from mudg.city.config import CityConfig
from mudg.city.world import CityWorld
from mudg.core.fusion import FusionRules, SweepShots, fuse_sweeps
from mudg.diffusion.condition import ConditionRules, DriveInputs, build_conditions
from mudg.diffusion.published import PublishedLatents
from mudg.diffusion.requests import SampleRequest
from mudg.formats.settings import IngestConfig
from mudg.networks.codec import MODALITIES, Decoded
from mudg.scene.clouds import read_fused
from mudg.scene.read import read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps.ingest import Fuse, Ingest

FRAMES = 4
DISTORTIONS = ((0.5, 0.0), (0.8, 0.0), (1.25, 0.0), (2.0, 0.0), (1.0, 3.0), (1.0, -1.0))


def standing_in(monkeypatch, depth):
    """A published-type model without networks: its generated depth is `depth` f32[T,1,H,W], all else is empty."""
    model = tiny_model()
    frames, _, height, width = depth.shape
    factor = model.codec.factor
    cells = torch.zeros(1, frames, 1, height // factor, width // factor)
    latents = PublishedLatents(cells, cells, cells, cells + 1)
    nothing = Decoded(torch.zeros(frames, 3, height, width), depth, torch.zeros(frames, height, width).long())
    monkeypatch.setattr(model, "encode_condition", lambda *_: latents)
    monkeypatch.setattr(model, "image_tokens", torch.nn.Identity())
    model.image_tokens.queries = torch.zeros(1)
    monkeypatch.setattr(model, "_denoise", lambda *_: (dict.fromkeys(MODALITIES, cells[0]), cells[0]))
    monkeypatch.setattr(model.codec, "decode", lambda *_: nothing)
    return model


def city_of(width, height):
    """A recorded city, its fused cloud and its photographs."""
    world = CityWorld(CityConfig(seed=3, n_frames=FRAMES, width=width, height=height, cameras=("front",)))
    views = world.frame_views("front")
    photos = [Photo(view, world.render(view).rgb_u8, None) for view in views]
    sweeps = [world.lidar_sweep(n) for n in range(FRAMES)]
    shots = [SweepShots(s.time_s, s.world_from_lidar, s.points, [photo]) for s, photo in zip(sweeps, photos)]
    return world, fuse_sweeps(shots, world.tracks(), FusionRules(min_object_points=40))[0], photos


LARGE = [
    pytest.param(sizes, marks=pytest.mark.slow) for sizes in (((1242, 375), (1024, 576)), ((640, 193), (512, 320)))
]


@pytest.fixture(scope="module", params=[*LARGE, ((384, 256), (256, 144))], ids=str)
def exact(request):
    """Condition of a city recorded at one size for a network of another, and the exact depth there."""
    recorded, (width, height) = request.param
    world, cloud, photos = city_of(*recorded)
    views = world.frame_views("front")
    rules = ConditionRules(width, height, *recorded, published=True)
    condition = build_conditions(DriveInputs(cloud, world.tracks(), photos), views, rules)[0]
    depth = np.stack([world.render(view.resized(width, height)).depth for view in views])[:, None]
    return condition, torch.from_numpy(np.nan_to_num(depth, nan=100.0, posinf=100.0)).float().clamp(max=100)


def test_exact_depth_is_left_alone_and_agrees_with_what_was_measured(exact, monkeypatch):
    condition, depth = exact
    clip = standing_in(monkeypatch, depth).sample(condition, SampleRequest(1))
    lower = slice(int(0.4 * depth.shape[-2]), None)
    for fit in clip.depth_fits:
        assert fit.scale == pytest.approx(1, abs=1e-3)
        assert fit.shift_m == pytest.approx(0, abs=0.02)
    assert float(clip.confidence.mean()) >= 0.98  # of which coverage and steadiness are 1
    assert float(clip.confidence[..., lower, :].mean()) >= 0.98


@pytest.mark.parametrize(("scale", "shift_m"), DISTORTIONS)
def test_distorted_depth_is_brought_back(exact, monkeypatch, scale, shift_m):
    condition, depth = exact
    clip = standing_in(monkeypatch, scale * depth + shift_m).sample(condition, SampleRequest(1))
    for fit in clip.depth_fits:
        assert fit.used
        assert fit.scale == pytest.approx(1 / scale, rel=0.02)
        assert fit.shift_m == pytest.approx(-shift_m / scale, abs=0.06)
    near = depth < 60
    assert float((clip.depth / depth - 1)[near].abs().max()) < 0.02


def test_a_surface_painted_at_a_wrong_distance_is_not_trusted(exact, monkeypatch):
    condition, depth = exact
    edge = depth.shape[-1] * 3 // 4
    made = depth.clone()
    made[..., edge:] *= 0.67
    clip = standing_in(monkeypatch, made).sample(condition, SampleRequest(1))
    columns = torch.arange(depth.shape[-1]).expand_as(depth)
    near = condition.measured.valid & (depth < 60)
    assert float(clip.confidence[near & (columns > edge + 4)].mean()) < 0.3
    assert float(clip.confidence[near & (columns < edge - 4)].mean()) > 0.98


@pytest.fixture(scope="module")
def kitti(shared_data, tmp_path_factory):
    """A recorded drive and its fused cloud."""
    root = tmp_path_factory.mktemp("kitti")
    Ingest(log=shared_data("kitti_2011_09_26"), out=root / "scene", settings=IngestConfig(contact_sheet=False)).run()
    Fuse(scene=root / "scene", out=root / "fuse", settings=FuseConfig()).run()
    return read_scene(root / "scene"), read_fused(root / "fuse")


def points_at(cloud, view):
    """Depth f64[H,W] of the nearest static point of every pixel, in float64, gaps taking the nearest pixel's."""
    camera = view.camera
    points = np.c_[cloud.static.xyz.astype(np.float64), np.ones(len(cloud.static))]
    x, y, z = (np.linalg.inv(view.world_from_cam) @ points.T)[:3]
    ahead = z > 1
    x, y, z = x[ahead], y[ahead], z[ahead]
    column = np.floor(camera.fx * x / z + camera.cx).astype(int)
    row = np.floor(camera.fy * y / z + camera.cy).astype(int)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height) & (z < 100)
    depth = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(depth, (row[inside], column[inside]), z[inside])
    nearest = ndimage.distance_transform_edt(np.isinf(depth), return_distances=False, return_indices=True)
    return depth[tuple(nearest)]


@pytest.mark.parametrize("recorded", [(1242, 375), (640, 193)], ids=str)
def test_points_of_a_recorded_drive_agree_with_themselves(kitti, monkeypatch, recorded):
    scene, cloud = kitti
    views = [frame.view for frame in scene.frames_of(next(iter(scene.cameras)))][:FRAMES]
    size = (1024, 576)
    condition = build_conditions(DriveInputs(cloud, (), ()), views, ConditionRules(*size, *recorded, published=True))[0]
    depth = torch.from_numpy(np.stack([points_at(cloud, view.resized(*size)) for view in views])[:, None]).float()
    for scale, shift_m in ((1.0, 0.0), *DISTORTIONS):
        clip = standing_in(monkeypatch, scale * depth + shift_m).sample(condition, SampleRequest(1))
        exact = scale == 1 and shift_m == 0
        for fit in clip.depth_fits:
            assert fit.scale == pytest.approx(1 / scale, rel=1e-3 if exact else 0.02)
            assert fit.shift_m == pytest.approx(-shift_m / scale, abs=0.06)
        assert float(clip.confidence.mean()) >= 0.98
