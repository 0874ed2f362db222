"""Fusion: movers, separation, colours and occlusion against exact streets; the real sequence against its protocol."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused
from toy_scene import CAR, CAR_SIZE_M, COLORS, GROUND, PANEL, TRAIN_IDS, WALL_HIGH, WALL_LOW, ToyStreet

from mudg.base import geometry, store
from mudg.base.errors import IntegrityError
from mudg.base.geometry import invert, yaw_matrix
from mudg.base.types import FusedCloud, Photo, PointCloud, SweepPoints, Track, View
from mudg.core import fusion
from mudg.core.fusion import STATIC, CloudAccumulator, FusionRules, SweepShots, fuse_sweeps, judge_track, separate
from mudg.core.project import ProjectConfig, project_cloud
from mudg.formats.importers import IMPORTERS
from mudg.formats.importers.common import ImportOptions
from mudg.scene import fuse
from mudg.scene.clouds import read_fused, write_fused
from mudg.scene.read import read_image, read_points
from mudg.scene.settings import FuseConfig
from mudg.steps.ingest import Fuse

RULES = FusionRules(min_object_points=1)


def shots_of(
    street: ToyStreet, times: Any = None, image_delay_s: float = 0.0, labels: bool = True
) -> Iterator[SweepShots]:
    for time_s in street.times if times is None else times:
        pose, points, _ = street.sweep(time_s)
        view = street.view(time_s + image_delay_s)
        rgb, ids, _ = street.image(view)
        yield SweepShots(time_s, pose, points, [Photo(view, rgb, ids if labels else None)])


def color_share(cloud: PointCloud, chosen: np.ndarray, kind: int) -> float:
    """Share of the chosen points that have exactly the colour of a thing."""
    return float((cloud.rgb[chosen] == COLORS[kind]).all(1).mean())


# --- movers ---------------------------------------------------------------------------------------


def track_through(centers: Any, yaws: Any = None, size: Any = (4.5, 1.8, 1.5)) -> Track:
    centers = np.asarray(centers, float)
    yaws = np.zeros(len(centers)) if yaws is None else yaws
    poses = np.stack([yaw_matrix(float(a), c) for a, c in zip(yaws, centers, strict=True)])
    return Track("t", "car", np.array(size), np.arange(len(centers)) * 0.1, poses)


def wave(metres: float, n: int = 60) -> np.ndarray:
    return np.c_[metres * np.sin(np.linspace(0, 2 * np.pi, n)), np.zeros(n), np.zeros(n)]


MOVING = {
    "drives away": track_through(np.c_[np.linspace(0, 5, 20), np.zeros((20, 2))]),
    "out and back to the start": track_through(wave(3.0)),
    "sways by 35 cm for long": track_through(np.concatenate([wave(0.35)] * 3), size=(0.8, 0.7, 1.8)),
    "turns on the spot": track_through(np.zeros((20, 3)), np.linspace(0, 0.6, 20)),
    "slow": track_through(np.c_[np.linspace(0, 0.7, 200), np.zeros((200, 2))]),
}
RNG = np.random.default_rng(1)
STILL = {
    "parked": track_through(np.zeros((20, 3))),
    "parked, jittery for 40 s": track_through(RNG.normal(0, 0.04, (400, 3)), RNG.normal(0, 0.02, 400)),
    "parked, annotator flips it": track_through(np.zeros((20, 3)), np.where(np.arange(20) % 7 < 3, 0, np.pi)),
    "one wild box": track_through(np.zeros((20, 3)), np.where(np.arange(20) == 9, 0.8, 0.0)),
    "standing person looks around": track_through(np.zeros((20, 3)), np.linspace(0, 2, 20), size=(0.6, 0.6, 1.8)),
    "single box": track_through([[3, 2, 1]]),
}


@pytest.mark.parametrize("case", [*MOVING, *STILL])
def test_what_moves_and_what_stands(case: str) -> None:
    verdict = judge_track({**MOVING, **STILL}[case], RULES)
    assert verdict.moving == (case in MOVING), verdict.words


def test_box_is_grown_but_not_below_its_floor_margin() -> None:
    size = np.array([4.0, 2.0, 1.6])
    heights = (0.85, 0.95, -0.65, -0.75, -0.85)
    points = np.array([[2.05, 0, 0], [2.15, 0, 0], [0, -1.05, 0], *([0, 0, z] for z in heights)])
    assert fusion.points_in_box(points, size, 0.1, 0.1).tolist() == [True, False, True, True, False, True, False, False]


# --- separation -----------------------------------------------------------------------------------


def test_separation_finds_the_cars_points_and_leaves_the_road() -> None:
    street = ToyStreet(car_start=(12, 0.5), car_velocity=(6, 0))
    for time_s in street.times:
        pose, points, kind = street.sweep(time_s)
        owner, owned = separate(SweepShots(time_s, pose, points, ()), [street.track()], RULES)
        world = geometry.transform_points(pose, points.xyz)
        assert not (owner[kind != CAR] != STATIC).any()
        assert (owner[(kind == CAR) & (world[:, 2] > 0.11)] == 0).all()
        expected = geometry.transform_points(invert(street.world_from_car(time_s)), world)[owner == 0]
        assert np.abs(owned[0] - expected).max() < 1e-4
    owner, owned = separate(SweepShots(0.4, pose, points, ()), [street.track([0.0, 0.1, 0.2])], RULES)
    assert (owner == STATIC).all() and owned == {}  # outside its time


def test_point_times_bring_a_fast_car_together() -> None:
    """A car at 20 m/s whose two ends are measured 0.1 s apart: with dt_s the points fit the box, without they smear."""
    track = track_through(np.c_[20 * np.arange(-1, 3) * 0.1 + 15, np.zeros(4), np.full(4, 0.8)])
    track = replace(track, times_s=np.arange(-1, 3) * 0.1)
    along = np.linspace(-2.2, 2.2, 45)
    dt = np.linspace(-0.05, 0.05, 45).astype(np.float32)
    xyz = np.c_[15 + along + 20 * dt, np.zeros(45), np.full(45, 0.8)].astype(np.float32)
    sweep = SweepShots(0.0, np.eye(4), SweepPoints(xyz, np.zeros(45, np.float32), dt), ())
    owner, owned = separate(sweep, [track], RULES)
    assert (owner == 0).all()
    assert np.abs(owned[0][:, 0] - along).max() < 1e-4
    smeared, _ = separate(replace(sweep, points=replace(sweep.points, dt_s=np.zeros_like(dt))), [track], RULES)
    assert (smeared == STATIC).sum() >= 10


def test_in_overlapping_boxes_the_smaller_wins() -> None:
    centers = np.c_[np.linspace(8, 12, 5), np.zeros((5, 2))]
    truck, bicycle = (track_through(centers, size=size) for size in ((8, 3, 3), (1.5, 0.6, 1.5)))
    bicycle = replace(bicycle, id="b")
    xyz = np.array([[10.0, 0, 0], [12.5, 0, 0]], np.float32)
    sweep = SweepShots(0.2, np.eye(4), SweepPoints(xyz, np.zeros(2, np.float32), np.zeros(2, np.float32)), ())
    assert separate(sweep, [truck, bicycle], RULES)[0].tolist() == [1, 0]


# --- colours and occlusion ------------------------------------------------------------------------


def test_without_the_test_the_wall_behind_a_panel_takes_its_colour_and_with_it_does_not() -> None:
    street = ToyStreet(panel_x=9.0, times=(0.0,))
    blind, _ = fuse_sweeps(shots_of(street), (), replace(RULES, occlusion_test=False))
    tested, report = fuse_sweeps(shots_of(street), (), RULES)

    def wrong(cloud: FusedCloud) -> float:
        behind = (np.abs(cloud.static.xyz[:, 1]) < 2) & (cloud.static.xyz[:, 0] > 12)
        return color_share(cloud.static, behind, PANEL)

    assert wrong(blind) > 0.15
    assert wrong(tested) < 0.02 * wrong(blind) + 0.004
    assert report.points_hidden > 100
    # what is truly visible keeps its colour: nearly nothing is lost
    visible = (blind.static.rgb != COLORS[PANEL]).any(1) | (blind.static.xyz[:, 0] < 9.5)
    assert len(tested.static) > 0.985 * visible.sum()


def test_a_slanted_road_does_not_hide_itself() -> None:
    cloud, report = fuse_sweeps(shots_of(ToyStreet(wall_x=70.0, times=(0.0,))), (), RULES)
    assert report.points_hidden < 0.003 * report.points_colored
    assert color_share(cloud.static, cloud.static.xyz[:, 2] < 0.02, GROUND) > 0.99


def test_colours_and_classes_are_exact_away_from_edges() -> None:
    cloud, _ = fuse_sweeps(shots_of(ToyStreet()), (), RULES)
    xyz, ids = cloud.static.xyz, cloud.static.semantics
    wall = np.abs(xyz[:, 0] - 25) < 0.01
    flat = xyz[:, 2] < 0.01
    for chosen, kind in (
        (wall & (xyz[:, 2] > 2.2) & (xyz[:, 2] < 3.8), WALL_HIGH),
        (wall & (xyz[:, 2] > 0.2) & (xyz[:, 2] < 1.8), WALL_LOW),
        (flat & (xyz[:, 0] < 24), GROUND),
    ):
        assert chosen.sum() > 100
        assert color_share(cloud.static, chosen, kind) == 1
        assert (ids[chosen] == TRAIN_IDS[kind]).all()


def test_the_camera_that_looks_straighter_gives_the_colour() -> None:
    street = ToyStreet()
    pose, points, _ = street.sweep(0.0)
    middle = street.view(0.0)
    turned = View(middle.camera, yaw_matrix(0.35) @ middle.world_from_cam, 0.0)
    shape = (middle.camera.height, middle.camera.width, 3)
    red, blue = (np.full(shape, color, np.uint8) for color in ((255, 0, 0), (0, 0, 255)))
    for order in (1, -1):
        sweep = SweepShots(0.0, pose, points, [Photo(middle, red), Photo(turned, blue)][::order])
        cloud, _ = fuse_sweeps([sweep], (), replace(RULES, occlusion_test=False))
        cosines = []
        for view in (middle, turned):
            local = geometry.transform_points(view.cam_from_world, cloud.static.xyz.astype(np.float64))
            cosines.append(local[:, 2] / np.linalg.norm(local, axis=1))
        is_blue = cloud.static.rgb[:, 2] == 255
        in_both = np.logical_and.reduce([_inside(view, cloud.static.xyz) for view in (middle, turned)])
        assert in_both.sum() > 200
        decided = in_both & (np.abs(cosines[0] - cosines[1]) > 1e-5)
        assert (is_blue[decided] == (cosines[1] > cosines[0])[decided]).all()


def _inside(view: View, xyz: np.ndarray) -> np.ndarray:
    uv, z = geometry.project(view, xyz.astype(np.float64))
    with np.errstate(invalid="ignore"):
        return (z > 0.6) & (uv > 0.01).all(1) & (uv < [view.camera.width - 0.01, view.camera.height - 0.01]).all(1)


def test_a_movers_motion_until_the_image_is_undone() -> None:
    """The image comes 60 ms after the sweep; at 12 m/s to the side the car has moved on by 0.72 m by then."""
    street = ToyStreet(car_start=(12, -1.5), car_velocity=(0, 12), speed_m_s=0, times=(0.0, 0.06, 0.1, 0.16))
    times = (0.0, 0.1)
    cloud, _ = fuse_sweeps(shots_of(street, times, image_delay_s=0.06), [street.track()], RULES)
    car = cloud.objects["car-1"]
    assert color_share(car, np.ones(len(car), bool), CAR) > 0.97
    uncompensated, _ = fuse_sweeps(shots_of(street, times, image_delay_s=0.06), (), RULES)
    body = (uncompensated.static.xyz[:, 2] > 0.2) & (uncompensated.static.xyz[:, 0] < 15)
    assert color_share(uncompensated.static, body, CAR) < 0.9


def test_object_points_of_all_sweeps_lie_on_one_box() -> None:
    street = ToyStreet(car_start=(12, 0.5), car_velocity=(6, 0))
    cloud, report = fuse_sweeps(shots_of(street), [street.track()], RULES)
    car = cloud.objects["car-1"]
    assert car.frame == "object"
    to_faces = np.abs(np.abs(car.xyz) - CAR_SIZE_M / 2).min(1)
    assert to_faces.max() < 1e-3
    assert report.object_points["car-1"] == len(car) > 500
    assert color_share(car, np.ones(len(car), bool), CAR) > 0.97
    few, left = fuse_sweeps(shots_of(street), [street.track()], replace(RULES, min_object_points=10**6))
    assert dict(few.objects) == {} and "fewer than" in left.left_out["car-1"]
    for static in (cloud.static, few.static):  # no trace of the car in the static world
        assert not ((static.xyz[:, 2] > 0.15) & (static.xyz[:, 0] < 20)).any()


def test_a_parked_car_stays_in_the_static_world() -> None:
    street = ToyStreet(car_start=(12, 0.5))
    cloud, report = fuse_sweeps(shots_of(street), [street.track()], RULES)
    assert dict(cloud.objects) == {}
    assert not report.verdicts["car-1"].moving
    assert ((cloud.static.rgb == COLORS[CAR]).all(1)).sum() > 500


@pytest.mark.parametrize(("points", "shots"), [(0, 1), (5, 0), (0, 0)])
def test_nothing_to_fuse_is_an_empty_cloud(points: int, shots: int) -> None:
    street, zeros = ToyStreet(), np.zeros(points, np.float32)
    empty = SweepPoints(np.ones((points, 3), np.float32), zeros, zeros)
    view = street.view(0.0)
    given_shots = [Photo(view, street.image(view)[0])] * shots
    cloud, report = fuse_sweeps([SweepShots(0.0, np.eye(4), empty, given_shots)], (), RULES)
    assert (len(cloud.static), cloud.static.semantics, report.points_unseen) == (0, None, points)
    cloud, report = fuse_sweeps([], (), RULES)
    assert (len(cloud.static), report.sweeps) == (0, 0)


def test_counts_add_up_and_the_beam_gap_is_measured() -> None:
    street = ToyStreet(panel_x=9.0, car_start=(15, 3), car_velocity=(3, 0))
    _, report = fuse_sweeps(shots_of(street), [street.track()], RULES)
    assert report.points_in == report.points_colored + report.points_hidden + report.points_unseen
    assert report.points_colored == report.points_static + report.object_points["car-1"]
    _, points, _ = ToyStreet(panel_x=9.0).sweep(0.0)
    assert fusion.measure_beam_gap(points.xyz) == pytest.approx(0.4, abs=0.02)
    assert fusion.measure_beam_gap(points.xyz[:3]) == 0.4
    assert fusion.measure_beam_gap(np.zeros((0, 3), np.float32), 0.7) == 0.7


# --- voxels and memory ----------------------------------------------------------------------------


def test_voxel_filter_keeps_the_sample_seen_from_nearest_and_the_majority_class() -> None:
    accumulator = CloudAccumulator(0.5)
    xyz = np.array([[0.1, 0.1, 0.1], [0.2, 0.2, 0.2], [0.3, 0.1, 0.4], [-0.1, 0.1, 0.1]], np.float32)
    rgb = np.arange(12, dtype=np.uint8).reshape(4, 3)
    accumulator.add(xyz, rgb, np.array([7, 3, 3, 255], np.uint8), np.array([5, 9, 8, 1], np.float32))
    cloud = accumulator.cloud("world", True)
    order = np.argsort(cloud.xyz[:, 0])
    assert np.array_equal(cloud.xyz[order], xyz[[3, 0]])
    assert np.array_equal(cloud.rgb[order], rgb[[3, 0]])
    assert cloud.semantics[order].tolist() == [255, 3]


def test_voxel_result_does_not_depend_on_how_the_points_arrive() -> None:
    rng = np.random.default_rng(0)
    n = 4000
    xyz = rng.uniform(-3, 3, (n, 3)).astype(np.float32)
    rgb, ids = rng.integers(0, 256, (n, 3)).astype(np.uint8), np.full(n, 5, np.uint8)
    depth = rng.permutation(n).astype(np.float32)
    results = []
    for parts in (1, 7):
        accumulator = CloudAccumulator(0.4)
        for piece in np.array_split(np.arange(n), parts):
            accumulator.add(xyz[piece], rgb[piece], ids[piece], depth[piece])
            if parts > 1:
                accumulator._merge()
        cloud = accumulator.cloud("world", True)
        key = np.argsort(fusion.voxel_keys(cloud.xyz, 0.4))
        results.append(np.concatenate([cloud.xyz[key], cloud.rgb[key]], 1))
    assert np.array_equal(*results) and len(results[0]) == len(np.unique(fusion.voxel_keys(xyz, 0.4)))


def test_voxels_far_out_are_refused_not_folded_over() -> None:
    refused("too far away", fusion.voxel_keys, np.array([[2e6, 0, 0]]), 1.0)
    keys = fusion.voxel_keys(np.array([[-1e5, 1e5, 3.0], [1e5, -1e5, 3.0], [-1e5, 1e5, 2.0]]), 1.0)
    assert len(set(keys.tolist())) == 3


def test_memory_follows_voxels_not_points() -> None:
    rng, n = np.random.default_rng(0), 100_000
    accumulator = CloudAccumulator(1.0)  # 8000 voxels
    tracemalloc.start()
    for _ in range(40):
        xyz = rng.uniform(0, 20, (n, 3)).astype(np.float32)
        accumulator.add(xyz, np.zeros((n, 3), np.uint8), np.zeros(n, np.uint8), np.ones(n, np.float32))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(accumulator.cloud("world", False)) == 8000
    assert peak < 120e6  # all points at once would be four times the pending half million


# --- the stage ------------------------------------------------------------------------------------


def test_what_is_written(tmp_path: Path) -> None:
    street = ToyStreet(car_start=(12, 0.5), car_velocity=(6, 0))
    street.write(tmp_path / "scene")
    config = FuseConfig(min_object_points=10)
    out = Fuse(scene=tmp_path / "scene", out=tmp_path / "fuse", settings=config).run()
    cloud = read_fused(out)
    shots = (s for i, s in enumerate(shots_of(street)) if i != 4)
    direct, _ = fuse_sweeps(shots, [street.track()], fuse.rules_of(config))
    assert np.array_equal(cloud.static.xyz, direct.static.xyz)  # sweep 4 is held out: its image gives no colours
    assert np.array_equal(cloud.static.rgb, direct.static.rgb)
    assert np.array_equal(cloud.objects["car-1"].xyz, direct.objects["car-1"].xyz)
    assert set(cloud.objects) == {"car-1"}
    record = store.read_json(out / "fuse.json")
    assert record["tracks"]["car-1"]["moving"] is True and record["rules"]["min_object_points"] == 10
    assert (out / "top.png").stat().st_size > 1000


def test_a_changed_cloud_is_noticed(tmp_path: Path) -> None:
    none = np.zeros((3, 3))
    cloud = PointCloud(none.astype(np.float32), none.astype(np.uint8), "world")
    write_fused(tmp_path, FusedCloud(cloud, {"7": replace(cloud, frame="object")}), {})
    assert read_fused(tmp_path).objects["7"].frame == "object"
    path = tmp_path / "objects" / "000.safetensors"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    refused("altered", read_fused, tmp_path, raises=IntegrityError)
    index = store.read_json(tmp_path / "fuse.json")
    index["static"]["file"] = "../../etc/passwd"
    store.write_json(tmp_path / "fuse.json", index)
    refused("not a cloud", read_fused, tmp_path)


# --- the real sequence ----------------------------------------------------------------------------

PROTOCOL_DB = {"no poses": 12.87, "ego poses": 14.10, "ego poses + boxes": 16.63}


class KittiCheck:
    """Frame 8 seen through the coloured points of the other 15 frames: nearest point wins, one pixel a point,
    floored."""

    def __init__(self, source: Path, out: Path) -> None:
        self.scene = IMPORTERS["kitti"](source, out, ImportOptions())
        self.images = [read_image(self.scene, f) for f in self.scene.frames]
        camera = self.scene.frames[0].view.camera
        # the protocol floors KITTI's own pixel numbers
        self.camera = replace(camera, cx=camera.cx - 0.5, cy=camera.cy - 0.5)
        self.lidar_from_cam = invert(self.scene.sweeps[0].world_from_lidar) @ self.scene.frames[0].view.world_from_cam

    def predict(self, mode: str, rules: FusionRules) -> tuple[np.ndarray, np.ndarray]:
        """Predicted picture u8[H, W, 3] and covered bool[H, W]."""

        def pose(n: int) -> np.ndarray:
            return np.eye(4) if mode == "no poses" else self.scene.sweeps[n].world_from_lidar

        def view(n: int) -> View:
            return View(self.camera, pose(n) @ self.lidar_from_cam, self.scene.frames[n].view.time_s)

        sweeps = (
            SweepShots(sweep.time_s, pose(n), read_points(self.scene, sweep), [Photo(view(n), self.images[n])])
            for n, sweep in enumerate(self.scene.sweeps)
            if n != 8
        )
        cloud, _ = fuse_sweeps(sweeps, self.scene.tracks if mode.endswith("boxes") else (), rules)
        target = view(8)
        self.last = (cloud, target)
        xyz, rgb = [cloud.static.xyz.astype(np.float64)], [cloud.static.rgb]
        for track_id, points in cloud.objects.items():
            placed = self.scene.track(track_id).pose_at(target.time_s)
            xyz.append(geometry.transform_points(placed, points.xyz.astype(np.float64)))
            rgb.append(points.rgb)
        return self.draw(target, np.concatenate(xyz), np.concatenate(rgb))

    def project(self, config: ProjectConfig) -> tuple[np.ndarray, np.ndarray]:
        """The last prediction drawn by the package's own projection."""
        cloud, target = self.last
        poses = {track_id: self.scene.track(track_id).pose_at(target.time_s) for track_id in cloud.objects}
        seen = project_cloud(cloud, poses, target, config)
        picture = (seen.rgb.permute(1, 2, 0).numpy() * 255 + 0.5).astype(np.uint8)
        return picture, seen.valid.numpy()

    def draw(self, view: View, xyz: np.ndarray, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        uv, z = geometry.project(view, xyz)
        with np.errstate(invalid="ignore"):
            inside = (z > 0.1) & (uv >= 0).all(1) & (uv[:, 0] < self.camera.width) & (uv[:, 1] < self.camera.height)
        column, row = np.floor(uv[inside]).astype(int).T
        order = np.argsort(-z[inside], kind="stable")
        picture = np.zeros((self.camera.height, self.camera.width, 3), np.uint8)
        covered = np.zeros(picture.shape[:2], bool)
        picture[row[order], column[order]] = rgb[inside][order]
        covered[row, column] = True
        return picture, covered

    def psnr(self, picture: np.ndarray, covered: np.ndarray) -> float:
        difference = picture[covered].astype(float) - self.images[8][covered]
        return float(10 * np.log10(255**2 / (difference**2).mean()))


def test_real_sequence_reproduces_its_protocol_and_the_occlusion_test_helps(
    shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    check = KittiCheck(shared_data("kitti_2011_09_26"), tmp_path / "scene")
    protocol = FusionRules(occlusion_test=False, min_object_points=1)
    found = {mode: check.predict(mode, protocol) for mode in PROTOCOL_DB}
    for mode, expected in PROTOCOL_DB.items():
        assert check.psnr(*found[mode]) == pytest.approx(expected, abs=0.3), mode
    share = [covered.mean() for _, covered in found.values()]
    assert np.abs(np.array(share) - [0.204, 0.278, 0.276]).max() < 0.003
    picture, covered = found["ego poses + boxes"]
    tested, tested_covered = check.predict("ego poses + boxes", replace(protocol, occlusion_test=True))
    assert check.psnr(tested, tested_covered) > check.psnr(picture, covered) + 0.05
    both = covered & tested_covered
    assert both.sum() > 0.97 * covered.sum()
    assert check.psnr(tested, both) > check.psnr(picture, both)  # where both say something, not only by saying less
    changed = both & (tested != picture).any(2)
    assert check.psnr(tested, changed) > check.psnr(picture, changed) + 0.5
    own, own_covered = check.project(ProjectConfig())
    assert (own_covered == tested_covered).mean() > 0.9999
    assert check.psnr(own, own_covered) == pytest.approx(check.psnr(tested, tested_covered), abs=0.02)
    # far points no longer shine through near surfaces
    clean, clean_covered = check.project(ProjectConfig(occluder_m=0.2))
    assert check.psnr(clean, clean_covered) > check.psnr(own, own_covered) + 0.5
    assert {t.id for t in check.scene.tracks if judge_track(t, RULES).moving} == {"0", "1", "2"}  # as its readme says
