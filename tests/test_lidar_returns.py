"""A simulated LiDAR on a log: surfaces, intensity and lost beams against planes by hand and the generated city."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refused
from test_edit import gaussians

from mudg.base import geometry, store
from mudg.base.errors import UsageError
from mudg.base.types import Scene
from mudg.city.config import CityConfig
from mudg.city.logs import write_city
from mudg.city.sensors import lidar_elevations
from mudg.city.world import CityWorld
from mudg.core.returns import Met, first_surface, peaks
from mudg.core.table import Table
from mudg.editing.settings import RenderConfig
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import StaticNode
from mudg.scene.beams import beams_of, held_out, moving_tracks, training_sweeps, with_silent
from mudg.scene.observations import read_sweep_sets
from mudg.scoring import sweeps as scores
from mudg.sim.lidar import TABLES, LidarRequest, own_table, read_table, wanted_sweeps, write_sweeps
from mudg.sim.returns import places_gone
from mudg.sim.session import Instant, Session

LIDAR = {"lidar_beams": 32, "lidar_azimuth_step_deg": 0.5, "lidar_noise_m": 0.02}
CITY = CityConfig(seed=3, n_frames=6, width=48, height=32, cameras=("front",), **LIDAR)


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Six sweeps of 32 rows; that of frame 4 is held out."""
    return write_city(CITY, tmp_path_factory.mktemp("city") / "scene")


@pytest.fixture(scope="module")
def world() -> CityWorld:
    return CityWorld(CITY)


def nothing() -> SceneModel:
    """A scene whose few Gaussians lie far below the ground."""
    rows = gaussians(4, 1, (0, 0, -900), 0.01, 0)
    return SceneModel(Table(rows, {"node": torch.zeros(4, dtype=torch.int32)}), (StaticNode(),), None, (0,), 0, {})


@pytest.fixture(scope="module")
def session(city: Scene) -> Session:
    """One that learns from the log once."""
    return Session(nothing(), scene=city)


@pytest.fixture(scope="module")
def other(city: Scene) -> Session:
    """Another one, whose log lacks the held-out sweeps."""
    return Session(nothing(), scene=replace(city, sweeps=training_sweeps(city), split={}))


def ground(noise_m: float = 0.0) -> np.ndarray:
    """Points of the plane z = -1.9 at random places, 16 per square metre, as many sweeps leave them."""
    g = np.random.default_rng(1)
    xy = g.uniform((4, -8), (40, 8), (36 * 16 * 16, 2))
    return np.column_stack([xy, -1.9 + noise_m * g.standard_normal(len(xy))])


def down(angles_deg: np.ndarray) -> np.ndarray:
    tilt = np.radians(angles_deg)
    return np.stack([np.cos(tilt), 0.01 + 0 * tilt, -np.sin(tilt)], 1) / np.hypot(1, 0.01 + 0 * tilt)[:, None]


# -- surfaces --------------------------------------------------------------------------------------


def meet(beams: np.ndarray, xyz: np.ndarray, lost: np.ndarray | None = None) -> Met:
    """What beams meet among returns that count alike. ``lost``: where beams were lost."""
    light = np.full(len(xyz), 0.5)
    if lost is not None:
        xyz, light = np.concatenate([xyz, lost]), np.concatenate([light, np.full(len(lost), np.nan)])
    return first_surface(beams, xyz, light, np.ones(len(xyz)))


def test_beams_that_graze_the_ground_meet_its_plane() -> None:
    beams = down(np.linspace(3.2, 11, 60))
    met = meet(beams, ground())
    exact = 1.9 / -beams[:, 2]
    np.testing.assert_allclose(met.range_m, exact, rtol=1e-3)
    np.testing.assert_allclose(met.facing, -beams[:, 2], atol=0.01)
    noisy = meet(beams, ground(noise_m=0.02))
    error = (noisy.range_m - exact) * -beams[:, 2]  # along the normal
    assert np.abs(np.median(error)) < 0.006 and np.abs(error).mean() < 0.016  # no surface in front of the surface


def test_what_stands_before_another_surface_is_met_and_its_gap_is_not() -> None:
    y, z = (axis.reshape(-1) for axis in np.meshgrid(np.arange(-8, 8, 0.05), np.arange(-1, 2, 0.05)))
    near = np.stack([np.full(len(y), 8.0), y / 2, z], 1)
    near = near[np.abs(near[:, 1]) > 1.0]  # a gap of 2 m
    far = np.stack([np.full(len(y), 20.0), y, z], 1)
    side = np.linspace(-2.5, 2.5, 41)
    beams = np.stack([np.full(41, 8.0), side, 0.2 + 0 * side], 1)
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    met = meet(beams, np.concatenate([near, far]))
    depth = met.range_m * beams[:, 0]
    clear = np.abs(np.abs(side) - 1) > 0.06
    np.testing.assert_allclose(depth[clear], np.where(np.abs(side) > 1, 8, 20)[clear], rtol=5e-3)
    assert (np.minimum(np.abs(depth - 8), np.abs(depth - 20)) < 0.3).all()  # nothing hangs between the two


def test_beams_beside_a_surface_have_it_on_one_side() -> None:
    wall = np.stack(np.meshgrid([10.0], np.arange(-2, 2, 0.05), np.arange(-2, 2, 0.05)), -1).reshape(-1, 3)
    beams = np.array([[10, 0.0, 0.0], [10, 2.05, 0.0], [10, 5.0, 0.0], [-10, 0.0, 0.0]])
    met = meet(beams / np.linalg.norm(beams, axis=1, keepdims=True), wall)
    assert met.one_sided[0] < 0.35 and met.one_sided[1] > 0.8 and met.nearest_rad[1] > 0.5 * met.spacing_rad[1]
    assert np.isnan(met.range_m[2:]).all() and (met.heard[2:] == 0).all()


def test_lost_beams_count_where_they_were_lost_and_not_behind_a_surface() -> None:
    y, z = (axis.reshape(-1) for axis in np.meshgrid(np.arange(-3, 3, 0.05), np.arange(-1, 1, 0.05)))
    wall = np.stack([np.full(len(y), 10.0), y, z], 1)
    beams = np.array([[10.0, -1.5, 0.0], [10.0, 1.5, 0.0]])
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    left = wall[y > 0]
    beside = meet(beams, wall[y < 0], left)
    assert beside.heard[0] > 1 and beside.lost[0] == 0.0
    assert beside.lost[1] > 1 and np.isnan(beside.range_m[1])
    half = meet(beams, wall, left)  # as many lost as heard on the left
    assert half.lost[1] == pytest.approx(half.heard[1], rel=0.3) and half.lost[0] == 0.0
    assert meet(beams, wall, 2 * left).lost[1] == 0.0  # lost behind the wall: the wall knows nothing of it


# -- recorded beams --------------------------------------------------------------------------------


def test_beams_are_those_that_the_city_fired(city: Scene, world: CityWorld) -> None:
    """Directions lie on the sensor's rows although the vehicle drove; silent ones fill the grid."""
    beams = beams_of(city, city.sweeps[3])
    elevation = np.arcsin(beams.directions[:, 2])
    rows = lidar_elevations(CITY)
    assert np.quantile(np.abs(elevation[:, None] - rows).min(1), 0.99) < np.radians(0.05)
    np.testing.assert_allclose(np.radians(peaks(np.degrees(elevation))), rows, atol=np.radians(0.03))
    full = with_silent(beams)
    assert 0.95 < len(full) / (32 * 720) <= 1.0 and not full.returned[len(beams) :].any()
    np.testing.assert_array_equal(full.range_m[: len(beams)], beams.range_m)


def test_exact_ranges_of_single_beams_are_those_of_sweeps(city: Scene, world: CityWorld) -> None:
    """Another code path: one beam at a time, without candidates shared by neighbours."""
    quiet = CityWorld(replace(CITY, lidar_noise_m=0.0, lidar_dropout=0.0))
    sweep = quiet.lidar_sweep(2)
    points = sweep.points
    mount = geometry.invert(quiet.frame_pose(sweep.time_s)) @ sweep.world_from_lidar
    ends = geometry.transform_points(sweep.world_from_lidar, points.xyz.astype(np.float64))
    times = sweep.time_s + points.dt_s.astype(np.float64)
    origins = np.stack([(quiet.frame_pose(t) @ mount)[:3, 3] for t in times[::50]])
    away = np.linalg.norm(ends[::50] - origins, axis=1)
    found, light = quiet.ranges(origins, (ends[::50] - origins) / away[:, None], times[::50])
    both = np.isfinite(found)
    assert both.mean() > 0.9 and np.quantile(np.abs(found - away)[both], 0.97) < 0.02
    np.testing.assert_allclose(light[both], points.intensity[::50][both], atol=0.25)


def test_held_out_sweeps_are_those_of_held_out_frames(city: Scene) -> None:
    assert held_out(city) == {"lidar/000004"}
    assert {sweep.id for sweep in training_sweeps(city)} == {f"lidar/{k:06d}" for k in (0, 1, 2, 3, 5)}


def test_learning_does_not_read_held_out_sweeps(city: Scene, session: Session, other: Session) -> None:
    one, without = session.log_returns(), other.log_returns()
    assert not held_out(city) & {sweep.id for sweep in one.sweeps}
    assert one.weights.tobytes() == without.weights.tobytes()
    beams = beams_of(city, city.sweeps[4])
    asked = beams.directions[::50], beams.start, beams.start_s, one.poses(beams.start_s)
    for name in ("range_m", "lost", "intensity"):
        assert getattr(one.meet(*asked), name).tobytes() == getattr(without.meet(*asked), name).tobytes()


# -- sweeps ----------------------------------------------------------------------------------------


def test_held_out_and_shifted_sweeps_are_near_the_truth_and_nearer_than_moved_ones(
    city: Scene, session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only sweeps of held-out frames are scored, so no others are simulated."""
    monkeypatch.setattr("mudg.sim.lidar.read_scene", lambda _: replace(city, sweeps=city.sweeps[4:5]))
    write_sweeps(RenderConfig(lidar="lidar", shifts_m=(0.0, 3.0)), Path(city.root), session, tmp_path)
    assert set(read_sweep_sets(tmp_path)) == {"lidar_recorded", "lidar_shift+3.0"}
    rows = {(row["method"], row["shift_m"]): row["values"] for row in scores.sweep_scores(city, {"m": tmp_path})}
    for shift_m, most in ((0.0, 0.05), (3.0, 0.05)):
        made, moved = (rows[name, shift_m] for name in ("m", "nearest"))
        assert made["median_range_m"] < most and made["f1"] > 0.9
        assert made["median_range_m"] < 0.5 * moved["median_range_m"] and made["chamfer_m"] < moved["chamfer_m"]


def test_equal_requests_on_a_log_get_equal_bytes_and_objects_move_with_the_caller(
    city: Scene, session: Session, other: Session
) -> None:
    sweep = city.sweeps[5]
    own = beams_of(city, sweep)
    request = LidarRequest(beams=own_table(own), start=Instant(own.start_s, own.start), end=Instant(own.end_s, own.end))
    one, again = (of.render([request])[0] for of in (session, other))
    for name in ("xyz", "intensity", "beam", "surface_m", "classes"):
        assert getattr(one, name).tobytes() == getattr(again, name).tobytes()
    empty = replace(request, start=Instant(own.start_s, own.start, {}), end=Instant(own.end_s, own.end, {}))
    bare = session.render([empty])[0]
    boxes = [(t.pose_at(sweep.time_s), t.size_m) for t in moving_tracks(city)]
    places = lambda reply, pose: geometry.transform_points(geometry.invert(pose) @ own.end, reply.xyz.astype(float))
    inside = lambda reply: sum(
        int((np.abs(places(reply, pose)) < size / 2 - 0.1).all(1).sum()) for pose, size in boxes if pose is not None
    )
    assert inside(one) > 50 and inside(bare) < 0.1 * inside(one)  # not listed, so absent


def test_a_surface_that_the_log_looked_through_is_no_answer(city: Scene, session: Session) -> None:
    found = session.log_returns()
    station, time_s = city.sweeps[2].world_from_lidar, city.sweeps[2].time_s
    beams = beams_of(city, city.sweeps[2])
    far = np.flatnonzero(beams.range_m > 15)[::40]
    at = lambda share: geometry.transform_points(station, beams.directions[far] * (share * beams.range_m[far])[:, None])
    poses = found.poses(time_s)
    assert found.contradicts(at(0.5), station, time_s, poses).mean() > 0.95  # seen through
    assert found.contradicts(at(1.5), station, time_s, poses).mean() < 0.1  # hidden: nobody knows
    above = geometry.transform_points(station, np.array([[1.0, 0.0, 30.0]]))
    assert not found.contradicts(above, station, time_s, poses).any()  # out of its field


def test_returns_of_what_an_edit_took_away_go_with_it() -> None:
    before = np.array([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]])
    gone = places_gone(before, before[[0, 2]])
    assert gone is not None and places_gone(before, before) is None
    places = np.array([[0.1, 0, 0], [0.9, 0, 0], [1.2, 0, 0], [1.9, 0, 0], [5.1, 0, 0]])
    assert gone(places).tolist() == [False, True, True, False, False]


# -- scores and files ------------------------------------------------------------------------------


def test_scores_of_known_sweeps() -> None:
    g = np.random.default_rng(0)
    beams = g.normal(size=(400, 3))
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    true = scores.Measured(np.full(400, 10.0), np.full(400, 0.5))
    made = scores.Measured(true.range_m + 0.1, true.intensity - 0.2)
    made.range_m[:200] = np.nan
    found = scores.SweepScores()
    found.add(beams, made, true)
    values = found.values()
    assert values["median_range_m"] == pytest.approx(0.1) and values["intensity"] == pytest.approx(0.2)
    assert values["f1"] == pytest.approx(2 / 3) and values["chamfer_m"] > 0.1
    perfect = scores.SweepScores()
    perfect.add(beams, true, true)
    assert perfect.values() == {"median_range_m": 0.0, "chamfer_m": 0.0, "f1": 1.0, "intensity": 0.0}
    assert scores.SweepScores().values()["f1"] is None


def test_tables_come_by_name_and_from_files(tmp_path: Path) -> None:
    assert len(TABLES["vlp16"]().share) == 16 * 1800 and TABLES["hdl64"]().ring.max() == 63
    file = tmp_path / "own.json"
    file.write_text(json.dumps({"elevations_deg": [-5, 0, 5], "azimuth_step_deg": 1.0, "field_deg": 90}))
    table = read_table(file)
    azimuth = np.degrees(np.arctan2(table.directions[:, 1], table.directions[:, 0]))
    assert len(table.share) == 3 * 90 and np.abs(azimuth).max() <= 45
    file.write_text(json.dumps({"elevations_deg": [0], "azimuth_step": 1.0}))
    refused("azimuth_step", read_table, file)


def test_an_unknown_lidar_is_refused_in_words(city: Scene) -> None:
    refused(r"no such LiDAR(.|\n)*lidar(.|\n)*vlp16(.|\n)*velodine", wanted_sweeps, "velodine", city, raises=UsageError)
    refused("no LiDAR sweeps", wanted_sweeps, "lidar", replace(city, sweeps=()), raises=UsageError)
    assert wanted_sweeps("vlp16", city).sensor == "lidar"


@pytest.mark.parametrize("damage", ["schema", "file", "pose", "beam"])
def test_damaged_sets_are_refused(damage: str, tmp_path: Path) -> None:
    folder = tmp_path / "lidar" / "a_recorded"
    pose = np.eye(4).tolist()
    record = {"id": "a/000000", "own_beams": True, "start_s": 0.0, "end_s": 0.0, "start": pose, "end": pose}
    record["file"] = "../x.safetensors" if damage == "file" else "000000.safetensors"
    if damage == "pose":
        record["end"] = (2 * np.eye(4)).tolist()
    head = {"schema": 9 if damage == "schema" else 1, "trajectory": "a", "sensor": "a", "shift_m": 0.0}
    store.write_json(folder / "sweeps.json", {**head, "sweeps": [record]})
    beams = {"directions": np.zeros((2, 3), np.float32), "share": np.zeros(2, np.float32)}
    beams |= {"range_m": np.zeros(2, np.float32), "facing": np.zeros(2, np.float32)}
    returns = {"xyz": np.zeros((1, 3), np.float32), "intensity": np.zeros(1, np.float32)}
    returns |= {"dt_s": np.zeros(1, np.float32), "beam": np.full(1, 5, np.int64)}
    store.write_safetensors(folder / "000000.safetensors", {**beams, **returns})

    def read() -> None:
        found = read_sweep_sets(tmp_path)["a_recorded"]
        found.arrays(found.sweeps[0])

    refused(".", read)
