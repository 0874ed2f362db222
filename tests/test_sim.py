"""The sensor simulator: lenses against their forward formulas, pictures and sweeps against known answers."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from refusals import refused
from test_edit import SIZE, gaussians, toy

from mudg.base import geometry
from mudg.base.errors import InputError, MudgError, UsageError
from mudg.base.palette import ID
from mudg.base.types import Camera, View
from mudg.core.raster.rasterize import RasterConfig
from mudg.core.table import Table
from mudg.gaussians.model import CERTAINTY, SceneModel
from mudg.gaussians.nodes import StaticNode
from mudg.gaussians.rendering import render_view
from mudg.sim.lidar import BeamTable, LidarRequest, read_table
from mudg.sim.optics import Fisheye, FTheta, Pinhole, faces_of
from mudg.sim.session import LAYERS, CameraReply, CameraRequest, Instant, Session

LOOK = geometry.invert(geometry.CAM_FROM_EGO_AXES)
PLAIN = Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)
HERE = Instant(0.0, np.eye(4))


def placed(x: float = 0.0, y: float = 0.0, z: float = 1.5, yaw: float = 0.0) -> np.ndarray:
    return geometry.yaw_matrix(yaw, (x, y, z)) @ LOOK


def wall() -> SceneModel:
    """A vertical wall at x = 10 of flat opaque Gaussians, y and z from -15 to 15; colours grow along y and z."""
    y, z = (v.reshape(-1) for v in torch.meshgrid(*[torch.arange(-15, 15, 0.1)] * 2, indexing="ij"))
    rows = gaussians(len(y), 1, (0, 0, 0), 0.0, ID["car"])
    rows["means"] = torch.stack([torch.full_like(y, 10.0), y, z], 1)
    rows["quats"] = torch.tensor([1.0, 0, 0, 0]).repeat(len(y), 1)
    rows["log_scales"] = torch.log(torch.tensor([0.005, 0.07, 0.07])).repeat(len(y), 1)
    rows["logits"] = torch.full((len(y),), 8.0)
    rows["sh_dc"] = torch.stack([y / 15, z / 15, torch.zeros_like(y)], 1)[:, None]
    labels = {"node": torch.zeros(len(y), dtype=torch.int32), CERTAINTY: torch.ones(len(y), dtype=torch.float16)}
    return SceneModel(Table(rows, labels), (StaticNode(),), None, (ID["road"], ID["sky"], ID["car"]), 0, {})


def ask(session: Session, start: Instant, *layers: str, **more: Any) -> CameraReply:
    """What a plain camera sees, unless another lens is given."""
    chosen = {"optics": PLAIN, "layers": layers or ("rgb",), **more}
    return session.render([CameraRequest(start=start, **chosen)])[0]


# -- lenses ----------------------------------------------------------------------------------------


def pixels_by_hand(optics: Pinhole | Fisheye | FTheta, ray: np.ndarray) -> tuple[float, float]:
    """Where a lens maps a ray: the forward formulas of OpenCV and of f-theta, written out."""
    x, y, z = ray
    angle, around = math.atan2(math.hypot(x, y), z), math.atan2(y, x)
    if isinstance(optics, Fisheye):
        k = optics.radial
        r = angle * (1 + k[0] * angle**2 + k[1] * angle**4)
        return optics.cx + optics.fx * r * math.cos(around), optics.cy + optics.fy * r * math.sin(around)
    if isinstance(optics, FTheta):
        r = sum(a * angle**n for n, a in enumerate(optics.angle_to_pixels))
        c, d, e = optics.linear
        u, v = r * math.cos(around), r * math.sin(around)
        return optics.cx + c * u + d * v, optics.cy + e * u + v
    k1, k2, p1, p2 = *optics.radial, *optics.tangential
    a, b = x / z, y / z
    r2 = a * a + b * b
    s = 1 + k1 * r2 + k2 * r2 * r2
    u = a * s + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    v = b * s + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    return optics.cx + optics.fx * u, optics.cy + optics.fy * v


@pytest.mark.parametrize(
    "optics",
    [
        Pinhole(80, 60, 60.0, 62.0, 41.0, 29.0, (-0.2, 0.05), (0.003, -0.002)),
        Fisheye(90, 90, 30.0, 31.0, 44.0, 46.0, (0.02, -0.003), 1.4),
        FTheta(90, 80, 44.0, 41.0, (), (0.0, 30.0, 1.5, -0.4), "angle_to_pixels", 1.3, (1.01, 0.002, -0.003)),
    ],
    ids=["pinhole", "fisheye", "f-theta"],
)
def test_the_ray_of_a_pixel_falls_on_that_pixel(optics: Pinhole | Fisheye | FTheta) -> None:
    rays = optics.rays()
    assert rays.shape == (optics.height, optics.width, 3)
    seen = np.isfinite(rays).all(-1)
    assert seen.mean() > 0.6
    for row, column in np.argwhere(seen)[::37]:
        assert pixels_by_hand(optics, rays[row, column]) == pytest.approx((column + 0.5, row + 0.5), abs=1e-5)
    assert np.linalg.norm(rays[seen], axis=-1) == pytest.approx(1.0)


def test_both_polynomials_of_an_f_theta_lens_agree() -> None:
    forward = FTheta(60, 60, 30.0, 30.0, (), (0.0, 20.0), "angle_to_pixels", 1.2)
    backward = FTheta(60, 60, 30.0, 30.0, (0.0, 1 / 20), (), "pixels_to_angle", 1.2)
    np.testing.assert_allclose(forward.rays(), backward.rays(), atol=1e-9)


def test_faces_show_every_ray_where_a_pinhole_camera_would() -> None:
    g = np.random.default_rng(3)
    rays = g.normal(size=(500, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    faces = faces_of(rays, 100.0)
    assert len(faces) == 6 and sorted(np.concatenate([face.pixels for face in faces])) == list(range(500))
    for face in faces:
        x, y, z = (rays[face.pixels] @ face.cam_from_face).T
        fx, fy, cx, cy = face.camera.intrinsics
        np.testing.assert_allclose(np.stack([fx * x / z + cx, fy * y / z + cy], 1), face.uv, atol=1e-9)
        assert (face.uv >= 0).all() and (face.uv <= [face.camera.width, face.camera.height]).all()


# -- pictures --------------------------------------------------------------------------------------


def test_a_plain_camera_sees_what_render_view_draws() -> None:
    model, pose = toy(), placed()
    layers = ask(Session(model), Instant(0.5, pose), "rgb", "depth", "classes").layers
    seen = render_view(model, View(Camera("sim", 64, 48, 50.0, 50.0, 32.0, 24.0), pose, 0.5), RasterConfig(near_m=0.2))
    assert np.array_equal(layers["rgb"], (seen.rgb * 255).round().byte().permute(1, 2, 0).numpy())
    np.testing.assert_allclose(layers["depth"], seen.depth[0].numpy(), rtol=1e-6)
    assert np.array_equal(layers["classes"], seen.semantics.numpy())


def test_a_wide_lens_sees_the_wall_where_it_is() -> None:
    """Distance along every ray to the plane x = 10, and the colours that grow along it."""
    optics = Fisheye(80, 80, 40.0, 40.0, 40.0, 40.0, (0.01,), 1.2)
    pose = placed(z=0.5, yaw=0.2)
    layers = ask(Session(wall()), Instant(0.0, pose), "rgb", "distance", "normals", optics=optics).layers
    rays = optics.rays() @ pose[:3, :3].T
    with np.errstate(invalid="ignore"):
        exact = 10 / rays[..., 0]
        hit = pose[:3, 3] + exact[..., None] * rays
        inside = (np.abs(hit[..., 1:]) < 13).all(-1) & (rays[..., 0] > 0)
    assert inside.mean() > 0.4
    assert np.median(np.abs(layers["distance"] / exact - 1)[inside]) < 0.008
    assert np.quantile(np.abs(layers["distance"] / exact - 1)[inside], 0.98) < 0.05
    color = np.clip(0.5 + 0.28209479 * hit[..., 1] / 15, 0, 1)
    assert np.abs(layers["rgb"][..., 0] / 255 - color)[inside].mean() < 0.01
    facing = (layers["normals"] @ (pose[:3, :3].T @ np.array([-1.0, 0, 0])))[inside]
    assert np.nanmedian(facing) > 0.97


def test_an_object_stands_where_the_caller_puts_it_and_goes_when_it_is_not_listed() -> None:
    model = toy()
    session = Session(model)
    recorded = session.objects(0.5)["car-1"]
    aside = recorded @ geometry.yaw_matrix(0.3, (1.0, 2.0, 0.0))

    def draw(objects: dict[str, np.ndarray] | None, shown: Session = session) -> np.ndarray:
        return ask(shown, Instant(0.5, placed(), objects)).layers["rgb"].astype(int)

    moved = Session(model.with_object_moved("car-1", geometry.yaw_matrix(0.3, (1.0, 2.0, 0.0))))
    np.testing.assert_allclose(draw({"car-1": aside}), draw(None, moved), atol=1)
    assert np.array_equal(draw({}), draw(None, Session(model.without_nodes(["car-1"]))))
    assert np.array_equal(draw(None), draw({"car-1": recorded}))
    late = ask(session, Instant(99.0, placed(), {"car-1": recorded}), "instances")  # long after its track ended
    assert (late.layers["instances"] == 1).sum() > 20
    refused(r"no such object(.|\n)*car-1(.|\n)*bus-7", draw, {"bus-7": recorded}, raises=UsageError)


def test_instances_are_the_pixels_that_change_when_an_object_goes() -> None:
    session = Session(toy())
    full, empty = (ask(session, Instant(0.5, placed(), there), "rgb", "instances") for there in (None, {}))
    changed = np.abs(full.layers["rgb"].astype(int) - empty.layers["rgb"].astype(int)).max(-1) > 20
    own = full.layers["instances"] == 1 + full.objects.index("car-1")
    assert own.any() and (own & changed).sum() > 0.9 * own.sum() and (changed & ~own).sum() < own.sum()


def test_motion_is_where_the_surface_goes() -> None:
    """The camera drives 1 m towards the wall: a point at pixel offset p from the axis moves by p (10 / 9 - 1)."""
    later = Instant(0.1, placed(x=1.0, z=0))
    flow = ask(Session(wall()), Instant(0.0, placed(z=0)), "motion", motion_to=later).layers["motion"]
    u, v = np.meshgrid(np.arange(64) + 0.5 - 32, np.arange(48) + 0.5 - 24)
    np.testing.assert_allclose(flow[..., 0], u / 9, atol=0.05)
    np.testing.assert_allclose(flow[..., 1], v / 9, atol=0.05)


def test_motion_of_an_object_is_that_of_its_box() -> None:
    session, pose = Session(toy()), placed()
    here = session.objects(0.5)["car-1"]
    there = here @ geometry.yaw_matrix(0.0, (0.0, 1.0, 0.0))
    start, later = Instant(0.5, pose, {"car-1": here}), Instant(0.6, pose, {"car-1": there})
    layers = ask(session, start, "motion", "instances", "depth", motion_to=later).layers
    own = layers["instances"] == 1
    np.testing.assert_allclose(layers["motion"][own][:, 0], -50.0 / layers["depth"][own], rtol=1e-3)  # 1 m to the left
    still = ~own & np.isfinite(layers["depth"])
    assert np.abs(layers["motion"][still]).max() < 1e-3


@pytest.mark.parametrize("shutter", ["top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"])
def test_a_rolling_shutter_reads_every_strip_at_its_own_pose(shutter: str) -> None:
    session, start, end = Session(wall()), Instant(0.0, placed(z=0)), Instant(0.1, placed(y=2.0, z=0))
    rolled = ask(session, start, end=end, shutter=shutter).layers["rgb"]
    length = 64 if shutter.endswith(("right", "left")) else 48
    for strip in range(8):
        first, last = strip * length // 8, (strip + 1) * length // 8
        share = (first + last) / 2 / length
        share = 1 - share if shutter in ("bottom_to_top", "right_to_left") else share
        still = ask(session, Instant(0.1 * share, placed(y=2.0 * share, z=0)))
        part = np.s_[:, first:last] if length == 64 else np.s_[first:last]
        assert np.abs(rolled[part].astype(int) - still.layers["rgb"][part].astype(int)).max() <= 1


def test_equal_requests_get_equal_bytes() -> None:
    layers = tuple(layer for layer in LAYERS if layer != "motion")
    request = CameraRequest(optics=PLAIN, start=Instant(0.5, placed()), layers=layers)
    one, other = (Session(toy()).render([request, request]) for _ in range(2))
    for reply in (one[1], *other):
        assert all(one[0].layers[name].tobytes() == reply.layers[name].tobytes() for name in layers)


def test_trust_counts_what_shows_no_surface_below_the_horizon() -> None:
    """Every pixel towards the wall is determined; away from it the lower half shows nothing, the upper half is sky."""
    session = Session(wall())
    assert ask(session, Instant(0.0, placed(z=0))).trust.determined == 1.0
    back = ask(session, Instant(0.0, placed(z=0, yaw=math.pi))).trust
    assert back.determined == 0.0 and math.isnan(back.distance_m)


@pytest.mark.parametrize(
    ("make", "kind", "words"),
    [
        (lambda: Instant(math.nan, np.eye(4)), UsageError, "not finite"),
        (lambda: Instant(0.0, np.full((4, 4), math.nan)), InputError, "not rigid"),
        (lambda: Instant(0.0, geometry.yaw_matrix(0, (1e9, 0, 0))), InputError, "farther than"),
        (lambda: Instant(0.0, np.eye(4), {"a": np.eye(3)}), InputError, "not rigid"),
        (lambda: CameraRequest(optics=PLAIN, start=HERE, layers=("heat",)), UsageError, "no such layer"),
        (lambda: CameraRequest(optics=PLAIN, start=HERE, layers=("motion",)), UsageError, "later moment"),
        (lambda: CameraRequest(optics=PLAIN, start=HERE, shutter="up"), UsageError, "no such shutter"),
        (lambda: Pinhole(10**6, 10**6, 1, 1, 1, 1), UsageError, "image size"),
        (lambda: Pinhole(8, 8, 0.0, 1, 1, 1), UsageError, "positive"),
        (lambda: Pinhole(8, 8, 1.0, 1, 1, 1, (math.inf,)), UsageError, "not finite"),
        (lambda: FTheta(8, 8, 4, 4), UsageError, "reference"),
        (lambda: BeamTable.spinning([], 1.0), UsageError, "no beams"),
        (lambda: BeamTable.spinning([0.0], 1e-9), UsageError, "no such step"),
        (lambda: BeamTable.spinning([0.0], 1.0, (5.0, 5.0)), UsageError, "nearest range"),
    ],
)
def test_what_is_no_request_is_refused_in_words(make: Any, kind: type[MudgError], words: str) -> None:
    refused(words, make, raises=kind)


# -- LiDAR -----------------------------------------------------------------------------------------


def test_beams_measure_the_wall_while_the_vehicle_drives() -> None:
    """A turning sensor at 10 m/s: every beam measures from where the sensor is at its time, and the points, carried to
    the end of the sweep, lie on the wall."""
    beams = BeamTable.spinning(np.linspace(-20, 20, 16), 1.0, (0.5, 30.0))
    pose = lambda x: geometry.yaw_matrix(0.0, (x, 0.0, 0.0))
    request = LidarRequest(beams=beams, start=Instant(0.0, pose(0.0)), end=Instant(0.1, pose(1.0)))
    (reply,) = Session(wall()).render([request])
    away = beams.directions[reply.beam]
    exact = (10 - beams.share[reply.beam]) / away[:, 0]
    central = (np.abs(exact[:, None] * away[:, 1:]) < 13).all(1)
    error = np.abs(reply.range_m - exact)
    assert central.sum() > 1200 and np.median(error[central]) < 0.08 and np.quantile(error[central], 0.95) < 0.8
    assert np.median(np.abs(reply.xyz[central, 0] - 9.0)) < 0.08  # one metre nearer at the end
    assert np.allclose(reply.dt_s, (beams.share[reply.beam] - 1) * 0.1, atol=1e-6)
    behind = beams.directions[:, 0] < -0.05
    assert not behind[reply.beam].any() and (reply.classes[central] == ID["car"]).mean() > 0.99
    straight = np.abs(away[:, 0]) > 0.98
    assert reply.intensity[straight].mean() == pytest.approx(0.49, abs=0.02)  # squarely met


def test_a_car_that_the_caller_places_is_met_by_beams() -> None:
    beams = BeamTable.spinning(np.linspace(-15, 5, 24), 0.5, (0.5, 60.0))
    at = geometry.yaw_matrix(0.0, (0.0, 0.0, 1.5))
    car = geometry.yaw_matrix(0.0, (12.0, 3.0, 0.75))
    (reply,) = Session(toy()).render([LidarRequest(beams=beams, start=Instant(0.5, at, {"car-1": car}))])
    own = reply.instances == 1 + reply.objects.index("car-1")
    inside = geometry.transform_points(geometry.invert(car) @ at, reply.xyz[own].astype(float))
    assert own.sum() > 10 and (np.median(np.abs(inside), 0) <= np.array(SIZE) / 2).all()


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"field_deg": -90}, "field_deg"),
        ({"field_deg": 0.001}, "narrower than a step"),
        ({"azimuth_step_deg": 0.01, "elevations_deg": list(range(-60, 60))}, "too many beams"),
    ],
)
def test_beam_tables_that_no_sensor_has_are_refused_before_they_are_made(
    tmp_path: Path, changed: dict, words: str
) -> None:
    table = {"elevations_deg": [-10, 0], "azimuth_step_deg": 1, "range_m": [1, 50], "field_deg": 90, **changed}
    (tmp_path / "beams.json").write_text(json.dumps(table))
    refused(words, read_table, tmp_path / "beams.json", raises=MudgError)
