"""A vehicle that drives in a scene: kinematics, roads, collisions and followers against independent computations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from toy_fitted import toy_fitted, write_toy_run

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.palette import ID
from mudg.base.types import Camera
from mudg.scene.motion import Road
from mudg.sim.drive import SURROUNDINGS, BicycleState, Box, Car, Cockpit, Controls, Drive, Following, RoadUser
from mudg.sim.pilots import DriverView, EdgePilot, PlanPilot, RoutePilot
from mudg.sim.session import Session

CAR = Car()


def arc(radius_m: float = 30.0, slope: float = 0.0) -> Road:
    """A left turn about (0, radius), on ground that rises with y."""
    tilt, lean, angles = math.atan(slope), np.eye(4), np.linspace(0, 1.5, 60)
    lean[:3, :3] = [[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]]
    places = np.stack([radius_m * np.sin(angles), radius_m * (1 - np.cos(angles)), 0 * angles], 1)
    return Road(np.stack([lean @ geometry.yaw_matrix(angle, place) for angle, place in zip(angles, places)]))


def straight(length_m: float = 60.0) -> Road:
    return Road(np.stack([geometry.yaw_matrix(0.0, (x, 0.0, 0.0)) for x in np.arange(0.0, length_m, 1.0)]))


def parked(x: float, y: float = 0.0) -> RoadUser:
    pose = geometry.yaw_matrix(0.0, (x, y, 0.8))
    return RoadUser(np.array([0.0, 20.0]), np.stack([pose, pose]), (4.0, 1.8, 1.6))


def driving(x: float, speed: float, until_s: float = 10.0) -> RoadUser:
    times = np.linspace(0, until_s, 50)
    poses = np.stack([geometry.yaw_matrix(0.0, (x + speed * t, 0.0, 0.8)) for t in times])
    return RoadUser(times, poses, (4.0, 1.8, 1.6))


# -- kinematics ------------------------------------------------------------------------------------


def test_a_step_of_the_bicycle_is_the_sum_of_many_small_ones() -> None:
    start = BicycleState(1.0, 2.0, 0.3, 7.0, 0.1)
    controls = Controls(1.5, 0.0)
    after = start.after(controls, 0.4, CAR)
    x, y, heading, speed, small = start.x_m, start.y_m, start.heading_rad, start.speed_mps, 1e-5
    for _ in range(40_000):
        x += speed * math.cos(heading) * small
        y += speed * math.sin(heading) * small
        heading += speed * math.tan(0.1) / CAR.wheelbase_m * small
        speed += 1.5 * small
    assert (after.x_m, after.y_m, after.heading_rad, after.speed_mps) == pytest.approx((x, y, heading, speed), abs=1e-4)


def test_brakes_stop_where_energy_says_and_never_reverse() -> None:
    motion, way = BicycleState(0.0, 0.0, 0.0, 9.0), 9.0**2 / (2 * 4)
    for _ in range(40):
        motion = motion.after(Controls(-4.0, 0.0), 0.1, CAR)
    assert motion.speed_mps == 0
    assert motion.x_m == pytest.approx(way, abs=1e-9)


# -- roads -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("station, shift", [(3.0, 0.0), (20.0, 2.5), (31.0, -4.0), (-5.0, 1.0), (60.0, -1.0)])
def test_a_place_beside_a_road_is_found_again(station: float, shift: float) -> None:
    road = arc()
    pose = road.recorded(station)
    x, y, _ = geometry.transform_points(pose, np.array([[0.0, shift, 0.0]]))[0]
    assert road.locate((x, y)) == pytest.approx((station, shift), abs=0.05 if 0 < station < road.length_m else 0.25)


def test_a_vehicle_beside_the_path_stands_on_the_slope() -> None:
    road = arc(slope=0.1)
    recorded = road.recorded(20.0)
    x, y, z = geometry.transform_points(recorded, np.array([[0.0, 3.0, 0.0]]))[0]
    pose = road.place(float(x), float(y), 0.9)
    assert geometry.rigid_problem(pose) is None
    assert pose[2, 3] == pytest.approx(0.1 * pose[1, 3] / math.hypot(1, 0.0), abs=0.02)
    assert pose[:3, 2] == pytest.approx(recorded[:3, 2])
    assert z == pytest.approx(pose[2, 3], abs=0.02)


def test_a_vehicle_that_never_moved_tells_no_road() -> None:
    refused("stands", Road, np.tile(np.eye(4), (5, 1, 1)))


# -- bodies ----------------------------------------------------------------------------------------


def test_bodies_meet_exactly_where_points_of_one_lie_in_the_other() -> None:
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 61)] * 2), -1).reshape(-1, 2)
    agreed = {True: 0, False: 0}
    for _ in range(200):
        sizes = [tuple(rng.uniform(1, 5, 2)) + (1.5,) for _ in range(2)]
        poses = [geometry.yaw_matrix(rng.uniform(-3, 3), (*rng.uniform(-3, 3, 2), 0.7)) for _ in range(2)]
        a, b = (Box(pose, size) for pose, size in zip(poses, sizes, strict=True))
        points = np.column_stack([grid * sizes[0][:2], np.zeros(len(grid))])
        inside = geometry.transform_points(geometry.invert(poses[1]) @ poses[0], points)[:, :2]
        depth = (np.array(sizes[1][:2]) / 2 - np.abs(inside)).min(1).max()
        if abs(depth) > 0.15:
            assert a.meets(b) == b.meets(a) == (depth > 0)
            agreed[bool(depth > 0)] += 1
    assert min(agreed.values()) > 30


def test_a_bridge_is_no_collision() -> None:
    road = CAR.box(np.eye(4))
    assert road.meets(Box(geometry.yaw_matrix(0.0, (1.0, 0.0, 1.0)), (4.0, 2.0, 1.0)))
    assert not road.meets(Box(geometry.yaw_matrix(0.0, (1.0, 0.0, 6.0)), (4.0, 2.0, 1.0)))


def test_solid_gaussians_stop_a_vehicle_and_those_of_the_road_do_not() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(11.9, 12.1, 900), rng.uniform(-3, 3, 900), rng.uniform(0, 2, 900)])
    ground = np.column_stack([rng.uniform(0, 40, 9000), rng.uniform(-3, 3, 9000), rng.normal(0, 0.05, 9000)])
    solid = np.concatenate([wall, ground]).astype("f4")
    drive = Drive(straight(), {}, BicycleState(0.0, 0.0, 0.0, 8.0), 0.0, solid=solid)
    hits = []
    for _ in range(15):
        drive.step(Controls(), 0.1)
        hits.append((drive.motion.x_m, drive.collision()))
    first = next(x for x, hit in hits if hit)
    bumper = CAR.length_m - CAR.overhang_m
    assert dict(hits)[first] == SURROUNDINGS
    assert 11.9 < first + bumper < 13.0


# -- road users ------------------------------------------------------------------------------------


def test_a_follower_stops_behind_a_vehicle_that_stops_where_a_recorded_one_drives_through_it() -> None:
    met = {}
    for traffic in ("log", "idm"):
        drive = Drive(straight(90.0), {"behind": driving(-25.0, 8.0)}, BicycleState(0.0, 0.0, 0.0, 0.0), 0.0, traffic)
        for _ in range(90):
            drive.step(Controls(), 0.1)
            met[traffic] = met.get(traffic) or drive.collision()
        rest = drive.boxes()["behind"].world_from_box[0, 3]
    assert met == {"log": "behind", "idm": ""}
    assert -8.0 < rest + 2.0 - (0.0 - CAR.overhang_m) < 0.0


def test_controls_that_are_no_numbers_are_refused() -> None:
    drive = Drive(straight(), {}, BicycleState(0.0, 0.0, 0.0, 1.0), 0.0)
    refused("not finite", drive.step, Controls(math.nan, 0.0), 0.1, raises=UsageError)


# -- pilots ----------------------------------------------------------------------------------------

CAMERA = Camera("front", 96, 64, 60.0, 60.0, 48.0, 32.0)
MOUNT = geometry.yaw_matrix(0.0, (1.4, 0.0, 1.5)) @ geometry.invert(geometry.CAM_FROM_EGO_AXES)


def sight_of(drive: Drive, obstacle_m: float = math.inf) -> DriverView:
    """Empty road; a wall of a car ahead of the camera at a depth."""
    depth, classes = np.full((64, 96), np.inf, np.float32), np.zeros((64, 96), np.uint8)
    if math.isfinite(obstacle_m):
        depth[20:40, 40:56], classes[20:40, 40:56] = obstacle_m, 13
    motion, pose = drive.motion, drive.pose
    now = (drive.time_s, 0.1, motion.speed_mps, motion.steer_rad, drive.road.route(pose, step_m=1.0), pose)
    return DriverView(*now, CAMERA, MOUNT, np.zeros((64, 96, 3), np.uint8), depth, classes)


@pytest.mark.parametrize("shift", [0.0, 2.0, -3.0])
def test_a_pilot_comes_to_its_line_on_a_bend_and_keeps_its_speed(shift: float) -> None:
    drive = Drive(arc(60.0), {}, BicycleState(0.0, 0.0, 0.0, 7.0), 0.0)
    pilot = RoutePilot(Following(7.0), shift)
    for _ in range(90):
        drive.step(pilot.drive(sight_of(drive)), 0.1)
    assert drive.road.locate((drive.motion.x_m, drive.motion.y_m))[1] == pytest.approx(shift, abs=0.25)
    assert drive.motion.speed_mps == pytest.approx(7.0, abs=0.2)


def test_a_pilot_sees_how_far_ahead_somebody_is_and_brakes() -> None:
    drive = Drive(straight(), {}, BicycleState(0.0, 0.0, 0.0, 10.0), 0.0)
    pilot = RoutePilot(Following(10.0))
    assert pilot.gap_m(sight_of(drive)) == math.inf
    gap = 12.0 + 1.4 - (CAR.length_m - CAR.overhang_m)
    assert pilot.gap_m(sight_of(drive, 12.0)) == pytest.approx(gap, abs=0.01)
    assert pilot.drive(sight_of(drive, 12.0)).acceleration_mps2 < -2


@pytest.mark.parametrize("bend_m", [math.inf, 60.0])
def test_a_pilot_that_pulls_over_finds_the_edge_and_keeps_clear_of_it(bend_m: float) -> None:
    """A flat road that reaches 3 m to the left and 4 m to the right of the route; beyond it, and far away, sidewalk."""
    road = straight() if math.isinf(bend_m) else arc(bend_m)

    def sight(drive: Drive) -> DriverView:
        rows, columns = np.mgrid[:64, :96]
        x, y = geometry.pinhole_ray(CAMERA.intrinsics, columns + 0.5, rows + 0.5)
        rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) @ MOUNT[:3, :3].T
        depth = np.where(rays[:, 2] < -1e-3, MOUNT[2, 3] / np.maximum(-rays[:, 2], 1e-3), np.inf)
        points = geometry.transform_points(drive.pose @ MOUNT, np.zeros((1, 3))) + depth.clip(max=200)[:, None] * (
            rays @ drive.pose[:3, :3].T
        )
        left = points[:, 1] if math.isinf(bend_m) else bend_m - np.hypot(points[:, 0], points[:, 1] - bend_m)
        classes = np.where((left < 3) & (left > -4), ID["road"], ID["sidewalk"]).astype(np.uint8).reshape(64, 96)
        seen = sight_of(drive)
        return replace(seen, depth=depth.reshape(64, 96).astype(np.float32), classes=classes)

    for side, edge in ((1, 3.0), (-1, 4.0)):
        drive = Drive(road, {}, BicycleState(0.0, 0.0, 0.0, 6.0), 0.0)
        pilot = EdgePilot(Following(6.0), 8.0 * side)
        assert pilot.edge_m(sight(drive), side) == pytest.approx(edge, abs=0.4)
        for _ in range(50):
            drive.step(pilot.drive(sight(drive)), 0.1)
        shift = road.locate((drive.motion.x_m, drive.motion.y_m))[1]
        assert edge - 1.9 < side * shift + CAR.width_m / 2 < edge


class Planned:
    """Plans to go on at a speed along a line to the left."""

    def plan(self, sight: DriverView) -> np.ndarray:
        times = np.arange(1, 41) * 0.1
        return np.column_stack([times, 6.0 * times, 0 * times, 0 * times])


def test_plans_are_driven_along() -> None:
    drive = Drive(straight(), {}, BicycleState(0.0, 0.0, 0.0, 3.0), 0.0)
    pilot = PlanPilot(Planned())
    for _ in range(60):
        drive.step(pilot.drive(sight_of(drive)), 0.1)
    assert drive.motion.speed_mps == pytest.approx(6.0, abs=0.1)
    assert abs(drive.motion.y_m) < 1e-6


# -- in a reconstruction ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    scene, fit, _, _ = write_toy_run(tmp_path_factory.mktemp("toy"))
    return Session(fit, scene=scene)


def test_the_vehicle_begins_where_it_was_recorded(session: Session) -> None:
    cockpit = Cockpit(session, width_px=80, layers=("rgb", "depth"))
    drive = cockpit.drive()
    ego = cockpit.ego.pose_at(drive.time_s)
    assert ego is not None
    assert drive.pose == pytest.approx(ego, abs=1e-6)
    (reply,) = cockpit.see(drive).values()
    view = cockpit.session.scene.frames[0].view
    assert reply.layers["rgb"].shape == (48, 80, 3)
    assert drive.pose @ cockpit.mounts[view.camera.name] == pytest.approx(view.world_from_cam, abs=1e-6)


def test_refusals_of_a_cockpit(session: Session) -> None:
    refused("needs the log", Cockpit, Session(toy_fitted()))
    refused("no such camera", Cockpit, session, "rear", raises=UsageError)
    refused("outside the log", Cockpit(session).drive, time_s=1e4, raises=UsageError)


def test_the_environment_keeps_gymnasiums_contract(session: Session) -> None:
    pytest.importorskip("gymnasium", reason="gymnasium is not installed (extra sim)")
    from gymnasium.utils.env_checker import check_env

    from mudg.sim.env import LIMITS, Env

    env = Env(session, width_px=48, layers=tuple(LIMITS), step_s=0.2)
    with pytest.warns(UserWarning, match="Box|spec"):  # without a registered name it cannot try other ways to render
        check_env(env)
    refused("two finite numbers", env.step, [math.nan, 0.0], raises=UsageError)
    refused("no such option", env.reset, options={"speed": 3}, raises=UsageError)
    refused("no such layer", Env, session, layers=("motion",), raises=UsageError)
    refused("positive time", Env, session, step_s=0.0, raises=UsageError)
    refused("no drive has begun", Env(session).step, [0.0, 0.0], raises=UsageError)


def test_equal_drives_are_equal_and_rewards_add_up_to_the_way(session: Session) -> None:
    pytest.importorskip("gymnasium", reason="gymnasium is not installed (extra sim)")
    from mudg.sim.env import Env

    drives = []
    for _ in range(2):
        env = Env(session, width_px=48, layers=("rgb",), step_s=0.1)
        _, info = env.reset(options={"shift_m": 0.5})
        begin, total, pictures, over = info["progress_m"], 0.0, [], False
        assert info["shift_m"] == pytest.approx(0.5, abs=1e-6)
        while not over:
            seen, reward, lost, over, info = env.step([0.0, 0.0])
            total += reward
            pictures.append(seen["front"]["rgb"].tobytes())
            over = over or lost
        assert total == pytest.approx(info["progress_m"] - begin)
        assert info["time_s"] <= env.cockpit.session.time_range_s[1] + 1e-6
        drives.append(pictures)
    assert len(drives[0]) > 3
    assert drives[0] == drives[1]
