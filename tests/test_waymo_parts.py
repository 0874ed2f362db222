"""Waymo importer, part by part: checksums, messages, range images, turns, exposures and boxes against slow twins."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import write_waymo as made
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.geometry import from_rotation_translation, invert, matrix_from_quaternion, yaw_matrix
from mudg.formats.importers.waymo import importer as sensors
from mudg.formats.importers.waymo import logs as tfrecord
from mudg.formats.importers.waymo import records as messages
from mudg.formats.importers.waymo import records as waymo_tracks
from mudg.formats.importers.waymo.records import CameraShot, LaserCalibration, LaserScan, WaymoBox


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def random_pose(generator: np.random.Generator, reach_m: float = 3.0) -> np.ndarray:
    return from_rotation_translation(
        matrix_from_quaternion(generator.normal(size=4)), generator.uniform(-reach_m, reach_m, 3)
    )


@pytest.mark.parametrize(
    "data, crc", [(b"123456789", 0xE3069283), (bytes(32), 0x8A9136AA), (b"\xff" * 32, 0x62A8AB43), (b"", 0)]
)
def test_crc32c_has_the_published_values(data: bytes, crc: int) -> None:
    assert tfrecord.crc32c(data) == crc


@pytest.mark.parametrize("length", [1, 63, 64, 65, 2319, 2320, 2321, 2328, 3571, 45479, 45480, 45488, 80064, 123457])
def test_crc32c_folded_equals_byte_by_byte(length: int) -> None:
    data = rng(length).bytes(length)
    assert tfrecord.crc32c(data) == made.crc32c_bitwise(data)


@pytest.mark.parametrize("degree, lower", tfrecord.SPARSE_MULTIPLES)
def test_sparse_multiples_are_multiples_of_the_polynomial(degree: int, lower: tuple[int, ...]) -> None:
    value = 1 << degree
    for exponent in lower:
        value ^= 1 << exponent
    polynomial = 0x11EDC6F41
    for shift in range(degree - 32, -1, -1):
        if value >> (shift + 32) & 1:
            value ^= polynomial << shift
    assert value == 0


def test_varints_at_once_equal_varints_one_by_one() -> None:
    values = np.concatenate([rng().integers(-(2**40), 2**40, 200), [0, -1, 127, 128, 2**62, -(2**63)], np.arange(300)])
    data = b"".join(made.varint(int(value)) for value in values)
    assert (messages.unpack_varints(data, "x") == values).all()
    refused("cut off", messages.unpack_varints, data + b"\x80", "x")
    refused("ten bytes", messages.unpack_varints, b"\x80" * 10 + b"\x01", "x")


INNER = messages.Message("Inner", {1: messages.Field("values", "doubles"), 3: messages.Field("counts", "ints")})
OUTER = messages.Message(
    "Outer",
    {
        1: messages.Field("name", "text"),
        2: messages.Field("number", "int"),
        4: messages.Field("inner", "messages", INNER),
    },
)


def test_messages_keep_wanted_fields_skip_others_and_take_both_forms_of_lists() -> None:
    packed = made.text(1, struct.pack("<2d", 1.5, -2)) + made.text(3, made.varint(7) + made.varint(-7))
    plain = made.doubles(1, [1.5, -2]) + made.number(3, 7) + made.number(3, -7)
    skipped = made.double(9, 1.0) + made.single(10, 1.0) + made.number(11, 300) + made.text(12, b"?")
    data = made.text(1, "Straße".encode()) + skipped + made.number(2, -5) + made.text(4, packed) + made.text(4, plain)
    found = messages.parse_message(data, OUTER, "x")
    assert (found["name"], found["number"], len(found["inner"])) == ("Straße", -5, 2)
    for inner in found["inner"]:
        assert inner["values"].tolist() == [1.5, -2]
        assert inner["counts"].tolist() == [7, -7]


@pytest.mark.parametrize(
    "data, word",
    [
        (b"\x0a\x05ab", "5 bytes where 2 are left"),
        (b"\x0a", "inside a number"),
        (b"\x0a\xff\xff\xff\xff\xff\xff\xff\x7f", "are left"),
        (b"\x80" * 11, "ten bytes"),
        (b"\x0b", "wire type 3"),
        (b"\x00\x00", "field number 0"),
        (b"\x10\x80", "inside a number"),
        (b"\x08\x01", "wire type 0, not 2"),
        (b"\x0a\x01\xff", "no text"),
        (b"\x22\x03\x0a\x01\x00", "no multiple of 8"),
    ],
)
def test_broken_messages_are_named(data: bytes, word: str) -> None:
    caught = refused("message cannot be decoded", messages.parse_message, data, OUTER, "file: record 3")
    assert word in caught.got
    assert "record 3" in caught.where


@given(st.binary(max_size=200))
def test_no_bytes_raise_anything_but_an_input_error(data: bytes) -> None:
    for message in (messages.FRAME, messages.CONTEXT, messages.MATRIX_INT):
        try:
            messages.parse_message(data, message, "x")
        except InputError:
            continue


@pytest.mark.parametrize("uneven", [True, False])
@pytest.mark.parametrize("posed", [True, False])
def test_points_equal_the_conversion_pixel_by_pixel(uneven: bool, posed: bool) -> None:
    generator = rng(4)
    rows, columns = 5, 12
    beams = np.sort(generator.uniform(-0.4, 0.1, rows)) if uneven else ()
    laser = LaserCalibration("top", tuple(beams), -0.4, 0.1, random_pose(generator))
    image = generator.uniform(-2, 60, (rows, columns, 4)).astype(np.float32)
    poses = generator.uniform(-1, 1, (rows, columns, 6)).astype(np.float32) if posed else None
    frame_pose = random_pose(generator)
    points = sensors.points_of_scan(LaserScan([image], poses), laser, frame_pose, "x")
    expected = []
    heading = np.arctan2(laser.vehicle_from_lidar[1, 0], laser.vehicle_from_lidar[0, 0])
    for row in range(rows):
        for column in range(columns):
            reach = float(image[row, column, 0])
            if reach <= 0:
                continue
            pitch = beams[rows - 1 - row] if uneven else -0.4 + (rows - 1 - row + 0.5) / rows * 0.5
            azimuth = np.pi * (1 - 2 * (column + 0.5) / columns) - heading
            local = reach * np.array([np.cos(azimuth) * np.cos(pitch), np.sin(azimuth) * np.cos(pitch), np.sin(pitch)])
            vehicle = laser.vehicle_from_lidar @ np.r_[local, 1]
            if poses is not None:
                roll, tilt, yaw, *place = (float(v) for v in poses[row, column])
                about_x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
                about_y = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
                rotation = yaw_matrix(yaw)[:3, :3] @ about_y @ about_x
                vehicle = invert(frame_pose) @ from_rotation_translation(rotation, place) @ vehicle
            expected.append((invert(laser.vehicle_from_lidar) @ vehicle)[:3])
    assert np.abs(points.xyz - np.array(expected)).max() < 1e-9
    assert points.without_pose == 0


def test_points_without_a_pose_are_left_out_and_counted() -> None:
    image = np.ones((2, 8, 4), np.float32)
    poses = np.full((2, 8, 6), 0.1, np.float32)
    poses[1, 3:] = 0
    laser = LaserCalibration("top", (), -0.2, 0.1, np.eye(4))
    points = sensors.points_of_scan(LaserScan([image, image], poses), laser, np.eye(4), "x")
    assert (points.without_pose, len(points.xyz)) == (10, 22)


@pytest.mark.parametrize("start, duration", [(0.0, 0.1), (-0.004, 0.098), (0.1, -0.1)])
def test_the_turn_is_measured_from_pixel_poses(start: float, duration: float) -> None:
    def place(time: np.ndarray) -> np.ndarray:
        return np.stack([100 + 12 * time, 0.3 * time, np.full_like(time, 4.0)], -1)

    poses = np.zeros((4, 100, 6), np.float32)
    poses[..., 3:] = place(start + (np.arange(100) + 0.5) / 100 * duration)
    poses[2:, 40:] = 0
    times = np.arange(-0.1, 0.25, 0.0125)
    found = sensors.measure_turn(poses, 5.0, times + 5.0, place(times))
    assert found is not None
    assert np.abs(np.array(found) - [start, duration]).max() < 1e-5
    assert sensors.measure_turn(poses, 5.0, times + 5.0, place(times * 1e-3)) is None
    nominal = sensors.TurnClock()
    assert (sensors.median_clock([found]) == nominal) == (start == 0.0)


def test_a_view_is_that_of_the_middle_of_the_exposure() -> None:
    pose = yaw_matrix(0.4, (5.0, 6.0, 1.0))
    velocity = np.array([10.0, -2.0, 0.5, 0, 0, 0.8])
    shot = CameraShot(pose, 100.0, velocity, 0.002, 99.985, 100.027)
    moved, time = sensors.middle_of_exposure(shot)
    late = time - 100.0
    assert late == pytest.approx(0.006, abs=1e-9)
    assert np.abs(moved - yaw_matrix(0.4 + 0.8 * late, pose[:3, 3] + velocity[:3] * late)).max() < 1e-12
    assert sensors.readout_s(shot) == pytest.approx(0.04)
    unknown = CameraShot(pose, 100.0, None, 0.002, 99.985, 100.027)
    assert sensors.middle_of_exposure(unknown) == (pose, 100.0)


def timed(times: np.ndarray, late: np.ndarray, velocity: np.ndarray, **changes: Any) -> list[waymo_tracks.TimedBoxes]:
    """An object that drives straight, boxed where it is when it is seen."""
    frames = []
    for time, delay in zip(times, late, strict=True):
        vehicle = yaw_matrix(0.1 * time, (3.0 * time, 0, 0))
        world = yaw_matrix(0.5, velocity * (time + delay) + [20, 5, 1])
        local = invert(vehicle) @ world
        values = {"id": "-a_b", "label": "vehicle", "size_m": (4.0, 2.0, 1.5)} | changes
        box = WaymoBox(centre=tuple(local[:3, 3]), heading=geometry.yaw_of(local), **values)
        frames.append(waymo_tracks.TimedBoxes(float(time), vehicle, [box], np.array([delay]), f"frame at {time}"))
    return frames


@pytest.mark.parametrize("late", [np.full(6, 0.03), np.array([0.049, 0.0495, -0.0495, -0.049, -0.04, -0.03])])
def test_boxes_are_carried_to_the_moment_of_the_points(late: np.ndarray) -> None:
    times, velocity = np.arange(6) * 0.1, np.array([12.0, -3.0, 0.0])
    (track,), notes = waymo_tracks.build_tracks(timed(times, late, velocity))
    assert np.abs(track.world_from_object[:, :3, 3] - (times[:, None] * velocity + [20, 5, 1])).max() < 1e-9
    assert (track.id, track.label, track.size_m.tolist(), notes) == ("t-a_b", "vehicle", [4.0, 2.0, 1.5], [])


def test_tracks_cover_the_images_of_their_frames() -> None:
    times, velocity = np.arange(4) * 0.1, np.array([12.0, -3.0, 0.0])
    frames = [
        replace(frame, images_s=(frame.time_s - 0.03, frame.time_s + 0.02))
        for frame in timed(times, np.zeros(4), velocity)
    ]
    (track,), _ = waymo_tracks.build_tracks(frames)
    assert track.times_s == pytest.approx([-0.03, 0, 0.1, 0.2, 0.3, 0.32])
    assert np.abs(track.world_from_object[:, :3, 3] - (track.times_s[:, None] * velocity + [20, 5, 1])).max() < 1e-9
    (alone,), _ = waymo_tracks.build_tracks(frames[:1])
    assert alone.times_s == pytest.approx([-0.03, 0, 0.02])
    assert np.ptp(alone.world_from_object, axis=0).max() == 0


def test_tracks_are_split_at_gaps_and_odd_ones_named() -> None:
    times = np.array([0, 0.1, 0.2, 1.0, 1.1])
    tracks, notes = waymo_tracks.build_tracks(timed(times, np.zeros(5), np.zeros(3), label="unknown", id="a"))
    assert [(track.id, len(track.times_s)) for track in tracks] == [("a", 3), ("a.1", 2)]
    assert "split" in notes[0]
    assert "2 boxes have a class that is not known" in notes[1]
    frames = timed(times, np.zeros(5), np.zeros(3))
    doubled = waymo_tracks.TimedBoxes(0.0, np.eye(4), [frames[0].boxes[0]] * 2, np.zeros(2), "frame 7")
    refused("two boxes of one object", waymo_tracks.build_tracks, [doubled])
