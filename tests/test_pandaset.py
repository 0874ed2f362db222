"""PandaSet importer: a round trip through the published layout, siblings and times of boxes, bait and damage."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import bad_logs
import numpy as np
import pytest
import roundtrip
from refusals import refused
from write_pandaset import EPOCH_S, cuboids, write_frame, write_pandaset

from mudg.base.errors import UsageError
from mudg.base.geometry import invert, transform_points
from mudg.base.palette import CLASSES, ID, UNLABELLED
from mudg.base.types import Photo, Scene, Track
from mudg.core.fusion import SweepShots, fuse_sweeps
from mudg.core.project import DrawLimits, PointLayer, draw_points
from mudg.formats.importers import RECOGNISERS
from mudg.formats.importers.pandaset import CLASS_OF, read_frame
from mudg.scene.read import read_image, read_points, read_scene

truth = bad_logs.truth
pristine, source = bad_logs.fixtures(write_pandaset, "001")
ingest = bad_logs.importer("pandaset")

pytestmark = roundtrip.needs_native


def world_points(scene: Scene, sensor: str, index: int) -> np.ndarray:
    sweep = next(s for s in scene.sweeps if s.id == f"{sensor}/{index:06d}")
    return transform_points(sweep.world_from_lidar, read_points(scene, sweep).xyz.astype(np.float64))


# --- what is read ---------------------------------------------------------------------------------


@pytest.mark.parametrize("new", [False, True])
def test_round_trip(truth: Scene, tmp_path: Path, new: bool) -> None:
    source = write_pandaset(truth, tmp_path / "042", new=new)
    scene = ingest(source, tmp_path / "out", workers=2)
    roundtrip.assert_same_log(scene, truth, sweeps=False)  # the LiDAR's place is not in the format; points follow
    first, true = (log.frames_of("front")[0].view.world_from_cam for log in (scene, truth))
    world_from_truth = first @ invert(true)
    for index, sweep in enumerate(truth.sweeps):
        points = read_points(truth, sweep)
        expected = transform_points(world_from_truth @ sweep.world_from_lidar, points.xyz.astype(np.float64))
        solid = np.arange(len(expected)) % 5 == 0
        for sensor, mine in (("pandar64", ~solid), ("pandar_gt", solid)):
            assert np.abs(world_points(scene, sensor, index) - expected[mine]).max() < 2e-5
            got = next(s for s in scene.sweeps if s.id == f"{sensor}/{index:06d}")
            assert got.time_s == pytest.approx(sweep.time_s, abs=1e-6)
            assert np.abs(read_points(scene, got).intensity - points.intensity[mine]).max() < 1e-6
    camera = scene.frames_of("front")[0].view.center_world
    place = transform_points(invert(scene.sweeps[0].world_from_lidar), camera[None])[0]
    assert np.linalg.norm(place) < 0.07  # the turning LiDAR sits just above and behind the front camera
    assert scene.id == "042"
    assert "CC BY 4.0" in scene.source.licence
    assert [name for name, looks_like in RECOGNISERS.items() if looks_like(source)] == ["pandaset"]


def test_cameras_frames_and_sequences_are_chosen(truth: Scene, pristine: Path, tmp_path: Path) -> None:
    part = ingest(pristine, tmp_path / "part", frames=(1, 4), cameras=("front_left_camera",))
    assert [frame.id for frame in part.frames] == [f"front_left/{n:06d}" for n in range(3)]
    assert part.frames[0].view.time_s == pytest.approx(0.0, abs=1e-6)
    shutil.copytree(pristine, tmp_path / "all" / "002")
    shutil.copytree(pristine, tmp_path / "all" / "016")
    assert RECOGNISERS["pandaset"](tmp_path / "all")
    caught = refused("several sequences", ingest, tmp_path / "all", tmp_path / "no", raises=UsageError)
    assert "002, 016" in caught.expected
    assert ingest(tmp_path / "all", tmp_path / "yes", sequence="016", frames=(0, 1)).id == "016"
    refused("no such sequence", ingest, tmp_path / "all", tmp_path / "no", sequence="../001", raises=UsageError)
    refused("no use for --boxes", ingest, pristine, tmp_path / "no", boxes=Path("x"), raises=UsageError)


def test_point_times_stay_and_boxes_come_from_the_time_they_were_measured(truth: Scene, tmp_path: Path) -> None:
    """Boxes drawn around their points, each at its own moment of the turn, are found at the frame's moment again."""
    source = write_pandaset(truth, tmp_path / "001", point_times=True)
    paths = {track.id: track for track in read_scene(truth.root).tracks}  # at any time, not at the sweeps' only
    shift_m = 0.0
    for index, sweep in enumerate(truth.sweeps):
        points = read_points(truth, sweep)
        turning = np.arange(len(points.xyz)) % 5 != 0
        world = transform_points(sweep.world_from_lidar, points.xyz[turning].astype(np.float64))
        places = {}
        for track in truth.tracks:
            late_s = 0.0
            for _ in range(6):
                pose = paths[track.id].pose_at(sweep.time_s + late_s)
                inside = (np.abs(transform_points(invert(pose), world)) < track.size_m / 2).all(1)
                late_s = float(np.median(points.dt_s[turning][inside])) if inside.sum() >= 5 else 0.0
            if late_s:
                places[track.id] = pose
                shift_m = max(shift_m, float(np.linalg.norm((pose - track.world_from_object[index])[:3, 3])))
        write_frame(source / "annotations" / "cuboids" / f"{index:02d}.pkl.gz", cuboids(truth, sweep.time_s, places))
    scene = ingest(source, tmp_path / "out")
    sweep = next(s for s in scene.sweeps if s.id == "pandar64/000002")
    late = read_points(truth, truth.sweeps[2]).dt_s
    assert np.abs(np.sort(read_points(scene, sweep).dt_s) - np.sort(late[np.arange(len(late)) % 5 != 0])).max() < 1e-6
    measured = 0
    world_from_truth = scene.frames[0].view.world_from_cam @ invert(truth.frames[0].view.world_from_cam)
    for track in scene.tracks:
        given = next(t for t in truth.tracks if t.id == track.id)
        true = transform_points(world_from_truth, given.world_from_object[:, :3, 3])
        off = track.world_from_object[:, :3, 3] - true[[0, -1] if len(track.times_s) == 2 else slice(None)]
        inside = _points_inside(truth, given)
        if inside >= 5:
            assert np.abs(off).max() < 0.03
            measured += 1
        if np.ptp(given.world_from_object[:, 0, 3]) == 0:
            assert (track.world_from_object[0] == track.world_from_object[-1]).all()
    assert measured >= 4
    assert shift_m > 0.25  # what is undone is not small


def _points_inside(truth: Scene, track: Track) -> int:
    """Fewest points of the turning LiDAR in a track's box, over the sweeps."""
    counts = []
    for sweep, pose in zip(truth.sweeps, track.world_from_object, strict=True):
        points = read_points(truth, sweep).xyz[np.arange(len(read_points(truth, sweep).xyz)) % 5 != 0]
        in_box = transform_points(invert(pose) @ sweep.world_from_lidar, points.astype(np.float64))
        counts.append(int((np.abs(in_box) < track.size_m / 2).all(1).sum()))
    return min(counts)


def test_siblings_are_one_object(truth: Scene, source: Path, tmp_path: Path) -> None:
    """An object with a box per LiDAR is one track; the turning LiDAR's box wins, and either alone will do."""
    for index, sweep in enumerate(truth.sweeps):
        table = {name: list(column) for name, column in cuboids(truth, sweep.time_s).items()}
        row = table["uuid"].index("car-001")
        table["cuboids.sibling_id"][row], table["cuboids.sensor_id"][row] = "other", 0
        for column in table.values():
            column.append(column[row])
        table["uuid"][-1], table["cuboids.sibling_id"][-1], table["cuboids.sensor_id"][-1] = "other", "car-001", 1
        table["position.z"][-1] += 5.0
        if index == 4:  # only the solid-state LiDAR sees it
            table = {name: column[:row] + column[row + 1 :] for name, column in table.items()}
            table["position.z"][-1] -= 5.0
        write_frame(source / "annotations" / "cuboids" / f"{index:02d}.pkl.gz", table)
    scene = ingest(source, tmp_path / "out")
    roundtrip.assert_same_log(scene, truth, sweeps=False)
    assert "other" not in {track.id for track in scene.tracks}
    assert any("4 boxes are second boxes" in note for note in scene.source.notes)


def test_published_poses_of_a_sequence_give_a_vehicle_that_drives_forward(source: Path, tmp_path: Path) -> None:
    """Two poses of sequence 002: x of the vehicle is its motion, its front camera looks ahead, 1.8 m up."""
    lidar = """0 0 0 0.9227878803693977 0.004463029824737836 0.017858463809403605 -0.3848683989086472
        13.445349134518345 13.366435600237008 -0.01126648 0.923331091922337 0.0043070355 0.0159992193 -0.383647193545"""
    camera = """0.6558286953029124 0.555863909647736 1.8011768068489773
            0.6548767857613946 -0.6514903276121121 0.27678883380008457 -0.26473513174921903
        14.293106553533605 14.122942595987043 1.7937735 0.65556671 -0.6515317593 0.2746473378642303 -0.26515560256"""
    for path, poses in ((source / "lidar", lidar), (source / "camera" / "front_camera", camera)):
        entries = []
        for *place, w, x, y, z in np.array(poses.split(), float).reshape(2, 7).tolist():
            entries.append({"position": dict(zip("xyz", place)), "heading": {"w": w, "x": x, "y": y, "z": z}})
        (path / "poses.json").write_text(json.dumps(entries))
        (path / "timestamps.json").write_text(json.dumps([EPOCH_S, EPOCH_S + 2.0]))
    shutil.rmtree(source / "annotations")
    write_frame(source / "lidar" / "01.pkl.gz", {"t": np.array([EPOCH_S + 2.0]), **{n: np.zeros(1) for n in "xyzid"}})
    scene = ingest(source, tmp_path / "out", cameras=("front",), frames=(0, 2))
    assert scene.tracks == () and any("no boxes" in note for note in scene.source.notes)
    moved = scene.ego.world_from_ego[-1, :3, 3]
    assert np.linalg.norm(moved) == pytest.approx(18.96, abs=0.01)
    assert abs(np.arctan2(moved[1], moved[0])) < np.deg2rad(1.0)  # along x of the scene's world
    ego = scene.ego.pose_at(scene.frames[0].view.time_s)
    in_ego = invert(ego) @ scene.frames[0].view.world_from_cam
    assert in_ego[:3, 2] == pytest.approx([1, 0, 0], abs=0.03)  # looks forward
    assert in_ego[:3, 0] == pytest.approx([0, -1, 0], abs=0.03)  # its right is the vehicle's
    assert in_ego[:3, 3] == pytest.approx([0.85, 0.0, 1.8], abs=0.1)


def write_classes(source: Path, names: dict[str, str]) -> list[np.ndarray]:
    """Classes for every point, in turns, as the data set stores them; returns the numbers frame by frame."""
    folder = source / "annotations" / "semseg"
    folder.mkdir()
    (folder / "classes.json").write_text(json.dumps(names))
    numbers = []
    for path in sorted((source / "lidar").glob("*.pkl.gz")):
        count = len(read_frame(path)["x"])
        numbers.append(np.array(sorted(int(key) for key in names))[np.arange(count) % len(names)])
        write_frame(folder / path.name, {"class": numbers[-1]})
    return numbers


def test_classes_of_points_become_train_ids(source: Path, tmp_path: Path) -> None:
    names = {"5": "Vegetation", "7": "Road", "14": "Pickup Truck", "42": "Other Static Object", "43": "Hover Board"}
    numbers = write_classes(source, names)
    scene = ingest(source, tmp_path / "out", workers=2)
    ids = {5: ID["vegetation"], 7: ID["road"], 14: ID["truck"], 42: UNLABELLED, 43: UNLABELLED}
    for sweep in scene.sweeps:
        index, solid = int(sweep.id[-6:]), sweep.sensor == "pandar_gt"
        mine = (read_frame(source / "lidar" / f"{index:02d}.pkl.gz")["d"] == 1) == solid
        expected = [ids[number] for number in numbers[index][mine].tolist()]
        assert read_points(scene, sweep).classes.tolist() == expected
    assert any("not known here are unlabelled: Hover Board" in note for note in scene.source.notes)
    assert set(CLASS_OF.values()) <= {"", *CLASSES}


def test_boxes_and_path_reach_the_images_taken_before_the_end_of_the_first_turn(truth: Scene, tmp_path: Path) -> None:
    source = write_pandaset(truth, tmp_path / "001")
    for path in (source / "camera").glob("*/timestamps.json"):
        path.write_text(json.dumps([time_s - 0.06 for time_s in json.loads(path.read_text())]))
    scene = ingest(source, tmp_path / "out")
    first = scene.frames[0].view.time_s
    assert first == pytest.approx(-0.06, abs=1e-3)
    assert scene.ego.pose_at(first) is not None
    assert scene.tracks
    assert all(track.pose_at(first) is not None for track in scene.tracks)


# --- bait and damage ------------------------------------------------------------------------------


def points_table(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def spoil(source: Path) -> None:
        count = 40
        table = {"x": np.arange(count) * 1.0, "y": np.ones(count), "z": np.ones(count), "i": np.full(count, 9.0)}
        table |= {"t": np.full(count, EPOCH_S + 0.2), "d": np.zeros(count, np.int64)}
        change(table)
        write_frame(source / "lidar" / "02.pkl.gz", table)

    return spoil


def box_table(truth_column: str, value: object) -> Callable[[Path], None]:
    def spoil(source: Path) -> None:
        table = {"uuid": ["a"], "label": ["Car"], "yaw": np.zeros(1), "stationary": np.array([False])}
        table |= {f"{kind}.{axis}": np.ones(1) for kind in ("position", "dimensions") for axis in "xyz"}
        table[truth_column] = np.array([value])
        write_frame(source / "annotations" / "cuboids" / "02.pkl.gz", table)

    return spoil


def json_entry(name: str, change: Callable[[list], object]) -> Callable[[Path], None]:
    def spoil(source: Path) -> None:
        values = json.loads((source / name).read_text())
        change(values)
        (source / name).write_text(json.dumps(values))

    return spoil


def classes_of_points(change: Callable[[Path], object]) -> Callable[[Path], None]:
    def spoil(source: Path) -> None:
        write_classes(source, {"7": "Road"})
        change(source / "annotations" / "semseg")

    return spoil


FRONT_TIMES = "camera/front_camera/timestamps.json"


def times_scaled(factor: float) -> Callable[[Path], None]:
    return json_entry("lidar/timestamps.json", lambda v: v.__setitem__(slice(None), [x * factor for x in v]))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda s: (s / "camera/front_camera/03.png").unlink(), "front_camera lacks 3"),
        (lambda s: (s / "lidar/01.pkl.gz").unlink(), "lidar lacks 1"),
        (lambda s: (s / "annotations/cuboids/01.pkl.gz").unlink(), "a frame has no boxes"),
        (lambda s: (s / "lidar/02.pkl.gz").write_bytes((s / "lidar/02.pkl.gz").read_bytes()[:5000]), "cut off|damaged"),
        (lambda s: shutil.copy(s / "annotations/cuboids/02.pkl.gz", s / "lidar/02.pkl.gz"), "table lacks columns"),
        (lambda s: shutil.copy(s / "lidar/01.pkl.gz", s / "lidar/04.pkl.gz"), "do not belong to their frame"),
        (points_table(lambda t: t.update(t=t["t"] * 1000)), "do not belong to their frame"),
        (points_table(lambda t: t.update(d=t["d"] + 2)), "LiDAR that does not exist"),
        (points_table(lambda t: t["z"].__setitem__(3, np.nan)), "not finite"),
        (points_table(lambda t: t.update(x=["a"] * 40)), "does not hold numbers"),
        (box_table("dimensions.y", 0.0), "size makes no sense"),
        (box_table("yaw", np.inf), "not finite"),
        (times_scaled(1000), "another unit"),
        (json_entry("lidar/timestamps.json", lambda v: v.pop()), "does not cover"),
        (json_entry("lidar/timestamps.json", lambda v: v.__setitem__(2, v[1])), "do not increase"),
        (json_entry("lidar/timestamps.json", lambda v: v.__setitem__(2, "soon")), "not numbers"),
        (json_entry(FRONT_TIMES, lambda v: v.__setitem__(slice(None), [x + 50 for x in v])), "share a clock"),
        (json_entry("lidar/poses.json", lambda v: v[2]["heading"].update(w=3.0)), "length 1"),
        (json_entry("lidar/poses.json", lambda v: v[2]["position"].pop("x")), "read as a pose"),
        (json_entry("camera/front_camera/intrinsics.json", lambda v: v.pop("fy")), "read as intrinsics"),
        (lambda s: (s / "camera/front_camera/poses.json").write_text("[{"), "not valid JSON"),
        (lambda s: (s / "camera/front_camera/poses.json").unlink(), "file not found"),
        (classes_of_points(lambda s: (s / "classes.json").unlink()), "class names is missing"),
        (classes_of_points(lambda s: (s / "classes.json").write_text("[1]")), "malformed"),
        (classes_of_points(lambda s: (s / "02.pkl.gz").unlink()), "no classes of points"),
        (classes_of_points(lambda s: write_frame(s / "02.pkl.gz", {"class": np.full(9, 7)})), "do not fit the points"),
        (classes_of_points(lambda s: write_frame(s / "02.pkl.gz", {"kind": np.full(9, 7)})), "lacks columns"),
    ],
)
def test_spoilt_logs_are_refused_in_words(
    source: Path, tmp_path: Path, spoil: Callable[[Path], object], words: str
) -> None:
    spoil(source)
    roundtrip.assert_refused(ingest, source, tmp_path / "out", words)


def test_clouds_and_tables_without_rows_are_empty_not_errors(source: Path, tmp_path: Path) -> None:
    none = np.zeros(0)
    write_frame(source / "lidar" / "02.pkl.gz", dict.fromkeys("xyzitd", none))
    columns = [f"{kind}.{axis}" for kind in ("position", "dimensions") for axis in "xyz"]
    columns += ["uuid", "label", "yaw", "stationary"]
    write_frame(source / "annotations" / "cuboids" / "02.pkl.gz", dict.fromkeys(columns, none), new=True)
    scene = ingest(source, tmp_path / "out")
    assert len(read_points(scene, next(s for s in scene.sweeps if s.id == "pandar64/000002")).xyz) == 0
    assert sum(sweep.sensor == "pandar_gt" for sweep in scene.sweeps) == 4
    assert scene.tracks


# --- real data ------------------------------------------------------------------------------------


def test_real_points_lie_in_the_boxes_of_their_frame(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    source = shared_data("pandaset_002")
    scene = ingest(source, tmp_path / "out", frames=(32, 35), cameras=("front",), resolution=320)
    assert len(scene.frames) == 3
    assert {sweep.sensor for sweep in scene.sweeps} == {"pandar64", "pandar_gt"}
    world = world_points(scene, "pandar64", 1)
    within = beside = 0
    for track in scene.tracks:
        pose = track.pose_at(scene.frames[1].view.time_s)
        if pose is not None and track.label in ("car", "truck", "bus"):
            local = np.abs(transform_points(invert(pose), world))
            within += int((local <= track.size_m / 2).all(1).sum())
            beside += int((local <= track.size_m / 2 + 0.3).all(1).sum())
    assert len(scene.tracks) == 94
    assert within > 20_000
    assert within > 0.9 * beside  # a shell of 0.3 m around the boxes holds few points more


@pytest.mark.slow
def test_real_points_coloured_by_one_camera_look_right_in_others(
    shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    """Standing points as single pixels, colours of the front camera, at 480x270: PSNR where there are points."""
    source = shared_data("pandaset_002")
    scene = ingest(source, tmp_path / "out", frames=(32, 56), resolution=480, test_every=0)

    def score(camera: str, index: int, held_out: bool = False) -> tuple[float, float]:
        frame = scene.frames_of(camera)[index]
        front = [f for f in scene.frames_of("front") if not held_out or f.id != frame.id]
        shots = []
        for sweep in scene.sweeps:
            near = min(front, key=lambda f: abs(f.view.time_s - sweep.time_s))
            if abs(near.view.time_s - sweep.time_s) < 0.06:
                photo = Photo(near.view, read_image(scene, near), None)
                shots.append(SweepShots(sweep.time_s, sweep.world_from_lidar, read_points(scene, sweep), [photo]))
        cloud = fuse_sweeps(shots, scene.tracks)[0].static
        _, number = draw_points([PointLayer(cloud.xyz, np.eye(4))], frame.view, DrawLimits())
        seen = number >= 0
        off = cloud.rgb[number[seen]].astype(float) - read_image(scene, frame)[seen]
        return float(10 * np.log10(255**2 / (off**2).mean())), float(seen.mean())

    for camera, index, least_db, share in (
        ("front", 12, 22.0, 0.7),
        ("front_right", 16, 21.9, 0.2),
        ("front_left", 23, 21.0, 0.2),
    ):
        psnr_db, seen = score(camera, index, held_out=camera == "front")
        assert psnr_db > least_db, camera
        assert seen > share, camera
