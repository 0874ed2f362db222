"""Cameras of different exposure: the maps that are found, and that clouds, conditions and fits use them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fit_settings import fit_config

from mudg.base.types import SAME_COLORS, CameraColors, ColorMap, Photo
from mudg.city.config import CityConfig
from mudg.core.calibration import match_cameras
from mudg.core.raster.rasterize import RasterConfig
from mudg.diffusion.condition import ConditionRules, DriveInputs, build_conditions
from mudg.formats.settings import IngestConfig
from mudg.gaussians import fit
from mudg.gaussians.rendering import render_view
from mudg.scene.clouds import read_fused
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_scene
from mudg.scene.settings import FuseConfig
from mudg.scene.write import SceneWriter
from mudg.steps.fit import Fit
from mudg.steps.ingest import Fuse, Ingest

DARK = ColorMap((1.4, 1.3, 1.2), (0.02, 0.0, -0.01), 1000)
"""To the common colours from those of a camera that takes darker images."""


def _seen_of(colors, numbers, of_camera: ColorMap, rng, noise=2.0):
    """What a camera sees of points with common colours: numbers, u8 colours."""
    shown = (colors[numbers] - np.array(of_camera.offset)) / np.array(of_camera.gain)
    return numbers, np.clip(np.rint(shown * 255 + rng.normal(0, noise, shown.shape)), 0, 255).astype(np.uint8)


def test_maps_are_found_along_a_chain_of_cameras():
    """The third camera shares no point with the first; its map leads through the second."""
    rng = np.random.default_rng(0)
    colors = rng.uniform(0.1, 0.6, (6000, 3))
    darker = ColorMap((1.7, 1.7, 1.7), (0.0, 0.0, 0.0))
    seen = [
        {
            "front": _seen_of(colors, np.arange(0, 3000), ColorMap(), rng),
            "left": _seen_of(colors, np.arange(2000, 5000), DARK, rng),
            "back": _seen_of(colors, np.arange(4000, 6000), darker, rng),
            "far": _seen_of(colors, np.arange(5990, 6000), darker, rng),
        }
    ]
    found = match_cameras(("front", "left", "back", "far"), seen)
    assert found.reference == "front" and set(found.to_common) == {"left", "back"}
    for name, wanted in (("left", DARK), ("back", darker)):
        assert found.to_common[name].gain == pytest.approx(wanted.gain, rel=0.04)
        assert found.to_common[name].offset == pytest.approx(wanted.offset, abs=0.015)


def test_equal_cameras_and_noise_alone_give_no_maps():
    rng = np.random.default_rng(1)
    colors = rng.uniform(0.1, 0.8, (4000, 3))
    same = [{name: _seen_of(colors, np.arange(4000), ColorMap(), rng, 12.0) for name in ("front", "left")}]
    assert match_cameras(("front", "left"), same) == SAME_COLORS
    unrelated = [
        {name: (np.arange(4000), rng.integers(0, 256, (4000, 3)).astype(np.uint8)) for name in ("front", "left")}
    ]
    assert match_cameras(("front", "left"), unrelated) == SAME_COLORS
    assert match_cameras((), []) == match_cameras(("front",), [{}]) == SAME_COLORS


def test_maps_there_and_back_are_the_identity():
    colors = CameraColors("front", {"left": DARK})
    image = torch.linspace(0.1, 0.6, 105).view(3, 5, 7)
    assert torch.allclose(colors.image_of("left", colors.image_to_common("left", image)), image, atol=1e-6)
    assert colors.image_of("front", image) is image
    values = (image.permute(1, 2, 0).numpy() * 255).astype(np.uint8)
    assert np.abs(DARK.inverse().of_bytes(colors.bytes_to_common("left", values)).astype(int) - values).max() <= 1
    assert CameraColors.of_record(colors.record()) == colors
    assert DARK.then(DARK.inverse()).gain == pytest.approx((1, 1, 1))
    for bad in (
        {},
        {"reference": "a", "to_common": {"b": {"gain": [1, 2], "offset": [0, 0, 0], "pairs": 1}}},
        {"reference": "a", "to_common": {"b": {"gain": [1, 0, 1], "offset": [0, 0, 0], "pairs": 1}}},
    ):
        with pytest.raises((KeyError, ValueError)):
            CameraColors.of_record(bad)


# ---- through the verbs, on a generated city of which one camera takes darker images --------------


CITY = CityConfig(
    n_frames=5, width=120, height=78, cameras=("front", "front_left"), supersample=1, lidar_azimuth_step_deg=0.4
)


@pytest.fixture(scope="module")
def city(tmp_path_factory) -> tuple[Path, Path]:
    """A scene whose cameras are equal, and the same with a darker second camera; the first frame of each is held
    out."""
    root = tmp_path_factory.mktemp("city")
    settings = IngestConfig(city=CITY, contact_sheet=False)
    Ingest(log="city", out=root / "equal", settings=settings).run()
    scene = read_scene(root / "equal")
    with SceneWriter(root / "dark", scene.id, scene.source) as writer:
        writer.copy_all_but_frames(scene)
        for frame in scene.frames:
            if frame.view.camera.name == "front":
                writer.copy_frame(scene, frame)
                continue
            labels = {name: read_label(scene, frame, name) for name in frame.labels}
            writer.add_frame(frame.id, frame.view, DARK.inverse().of_bytes(read_image(scene, frame)), labels)
        writer.finish()
    for name in ("equal", "dark"):
        Fuse(scene=root / name, out=root / f"{name}_fuse", settings=FuseConfig()).run()
    Fuse(scene=root / "dark", out=root / "dark_unmatched", settings=FuseConfig(match_colors=False)).run()
    return root / "equal", root / "dark"


def fused_of(scene: Path, kind: str = "fuse"):
    return read_fused(scene.parent / f"{scene.name}_{kind}")


def test_fuse_finds_a_darker_camera_and_colors_the_points_alike(city):
    equal, dark, unmatched = fused_of(city[0]), fused_of(city[1]), fused_of(city[1], "unmatched")
    assert equal.colors == unmatched.colors == SAME_COLORS
    assert set(dark.colors.to_common) == {"front_left"} and dark.colors.reference == "front"
    assert dark.colors.to_common["front_left"].gain == pytest.approx(DARK.gain, rel=0.1)
    off = [float(np.abs(cloud.static.rgb.astype(int) - equal.static.rgb).mean()) for cloud in (dark, unmatched)]
    assert off[0] < 0.25 * off[1]


def test_images_warped_from_another_camera_take_the_colors_of_the_view(city):
    """The front camera's view, conditioned on images of the darker camera alone."""
    scenes = [read_scene(path) for path in city]
    view = scenes[0].frames_of("front")[4].view
    shown = []
    for scene, cloud in (
        (scenes[0], fused_of(city[0])),
        (scenes[1], fused_of(city[1])),
        (scenes[1], fused_of(city[1], "unmatched")),
    ):
        photos = [Photo(f.view, read_image(scene, f)) for f in scene.frames_of("front_left")]
        condition, _ = build_conditions(DriveInputs(cloud, scene.tracks, photos), [view], ConditionRules(80, 48))
        assert condition.warped.float().mean() > 0.05
        shown.append(condition)
    off = [float((c.color - shown[0].color)[0][:, shown[0].warped[0, 0]].abs().mean()) for c in shown[1:]]
    assert off[0] < 0.4 * off[1]
    assert float((shown[1].backdrop - shown[0].backdrop).abs().mean()) < 0.5 * float(
        (shown[2].backdrop - shown[0].backdrop).abs().mean()
    )


def test_a_scene_has_common_colors_and_every_camera_shows_its_own(city, tmp_path):
    """Renders of the darker camera are as dark as its images, before any training step has brought them there."""
    scene = read_scene(city[1])
    config = fit_config(method="street_gaussians", iterations=1, densify__kind="none")
    model = fit.load_model(
        Fit(scene=city[1], fused=city[1].parent / "dark_fuse", out=tmp_path / "fit", settings=config).run()
    )
    assert model.colors == fused_of(city[1]).colors
    frame = scene.frames_of("front_left")[3]
    own = render_view(model, frame.view, RasterConfig(near_m=0.2)).rgb
    plain = render_view(replace(model, colors=SAME_COLORS), frame.view, RasterConfig(near_m=0.2)).rgb
    photo = torch.from_numpy(read_image(scene, frame).copy()).permute(2, 0, 1) / 255
    assert (own - photo).abs().mean() < 0.7 * (plain - photo).abs().mean()
    front = scene.frames_of("front")[3].view
    assert torch.equal(
        render_view(model, front, RasterConfig(near_m=0.2)).rgb,
        render_view(replace(model, colors=SAME_COLORS), front, RasterConfig(near_m=0.2)).rgb,
    )
