"""What importers share: parallel work, units of time, poses, lenses, sizes."""

from __future__ import annotations

import io
import threading

import numpy as np
import pytest
from PIL import Image
from refusals import refused

from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import from_rotation_translation, matrix_from_quaternion, yaw_matrix
from mudg.base.types import Camera
from mudg.formats.importers import common, images
from mudg.formats.importers.common import ImportOptions, number_ranges, parse_resolution

CAMERA = Camera("front", 96, 64, 70.0, 72.0, 47.0, 33.0)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_every_item_is_done_once_and_a_generator_is_read_lazily(workers: int) -> None:
    done: list[int] = []
    lock = threading.Lock()
    ahead: list[int] = []

    def items() -> object:
        for n in range(20):
            with lock:
                ahead.append(n - len(done))
            yield n

    def work(n: int) -> None:
        with lock:
            done.append(n)

    common.for_each(items(), work, "t", 0, workers, str)
    assert sorted(done) == list(range(20))
    assert max(ahead) <= 2 * workers


@pytest.mark.parametrize("workers", [1, 2, 4])
def test_the_earliest_error_wins_and_names_its_item(workers: int) -> None:
    started: list[int] = []
    six_is_failing = threading.Event()

    def work(n: int) -> None:
        started.append(n)
        if n == 5 and workers > 1:
            assert six_is_failing.wait(10)  # the later one fails first
        if n == 6:
            six_is_failing.set()
        if n in (5, 6):
            raise InputError("broken", where="scan.bin", got=str(n))

    with pytest.raises(InputError) as caught:
        common.for_each(range(2000), work, "t", 0, workers, lambda n: f"frame {n}")
    assert caught.value.got == "5"
    assert caught.value.where == "frame 5: scan.bin"
    assert len(started) < 2000


def test_units_of_time_keep_their_digits_and_unsorted_times_are_refused() -> None:
    start = 1_532_402_927_647_951_001
    times = common.seconds([start, start + 100_000_001], "ns", "log", start)
    assert times.tolist() == [0.0, 0.100000001]
    assert "record 2" in refused("do not increase", common.seconds, [0.0, 0.1, 0.1, 0.3], "s", "sweeps").where


@pytest.mark.parametrize(("unit", "likely"), [("ns", "us"), ("s", "us")])
def test_a_confused_unit_is_named(unit: common.TimeUnit, likely: str) -> None:
    caught = refused("another unit", common.seconds, [10**15 + 100_000 * n for n in range(5)], unit, "camera front")
    assert likely in caught.remedy


def test_poses_are_cleaned_or_refused_in_words() -> None:
    pose = yaw_matrix(0.7, (1, 2, 3))
    rounded = np.round(pose, 5)
    assert np.abs(common.rigid_pose(rounded, "x") - pose).max() < 1e-5
    assert common.rigid_pose(rounded[:3], "x").shape == (4, 4)
    scaled, mirrored, sheared = pose.copy(), pose.copy(), pose.copy()
    scaled[:3, :3] *= 2.5
    mirrored[:3, 1] *= -1
    sheared[0, 1] += 0.2
    for wrong, words in ((scaled, "scale 2.5"), (mirrored, "reflection"), (sheared, "stretches")):
        with pytest.raises(InputError) as caught:
            common.rigid_pose(wrong, "x")
        assert words in caught.value.got
    assert "transposed" in refused("0 0 0 1", common.rigid_pose, pose.T, "x").remedy
    q = np.array([0.8, 0.0, 0.6, 0.0])
    expected = from_rotation_translation(matrix_from_quaternion(q), [1, 2, 3])
    assert (common.pose_from_quaternion(q, [1, 2, 3], "x") == expected).all()
    refused("length 1", common.pose_from_quaternion, q * 1.2, [1, 2, 3], "x")


def smooth_picture(camera: Camera, lens: images.Lens | None = None) -> np.ndarray:
    """A picture of a smooth function of the ray; with a lens, as that lens sees it."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    seen = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], -1).reshape(-1, 2)
    xy = seen.copy()
    for _ in range(60 if lens is not None else 0):
        xy += seen - lens(xy)
    values = [np.sin(3 * xy[:, 0]), np.cos(4 * xy[:, 1]), xy[:, 0] * xy[:, 1]]
    shades = np.rint(127 + 100 * np.stack(values, -1).clip(-1, 1)).astype(np.uint8)
    return shades.reshape(camera.height, camera.width, 3)


@pytest.mark.parametrize(
    "lens",
    [images.brown_conrady(-0.3, 0.1, 0.002, -0.001), images.brown_conrady(0.1, 0.02), images.equidistant(-0.02, 0.003)],
    ids=["barrel", "pincushion", "fisheye"],
)
def test_a_distorted_picture_is_rectified_to_what_the_pinhole_camera_sees(lens: images.Lens) -> None:
    camera = Camera("front", 240, 160, 180.0, 180.0, 118.0, 81.0, (1.0,))
    fit = images.fit_images(camera, ImportOptions(), lens)
    assert fit.camera.distortion == (1.0,)
    assert 1.0 <= fit.camera.fx / camera.fx <= images.MAX_FOCAL_GAIN
    got = fit.pixels(smooth_picture(camera, lens)).astype(int)
    assert np.abs(got - smooth_picture(fit.camera)).max() <= 2


def test_lens_directions_are_those_of_the_usual_model() -> None:
    lens = images.brown_conrady(-0.1, 0.01, 0.002, 0.003)
    x, y, r2 = 0.3, -0.2, 0.13
    radial = 1 - 0.1 * r2 + 0.01 * r2**2
    expected = [
        x * radial + 2 * 0.002 * x * y + 0.003 * (r2 + 2 * x * x),
        y * radial + 0.002 * (r2 + 2 * y * y) + 2 * 0.003 * x * y,
    ]
    assert np.allclose(lens(np.array([[x, y]]))[0], expected, atol=1e-15)
    assert np.allclose(images.equidistant()(np.array([[1.0, 0.0]])), [[np.pi / 4, 0]])


@pytest.mark.parametrize(
    "lens", [images.brown_conrady(-1.5), images.brown_conrady(5.0)], ids=["turns back", "too wide"]
)
def test_a_lens_that_no_pinhole_fits_is_refused(lens: images.Lens) -> None:
    with pytest.raises(InputError, match="cannot be rectified"):
        images.fit_images(Camera("f", 96, 64, 50.0, 50.0, 48.0, 32.0), ImportOptions(), lens)


def test_resizing_averages_exact_areas_and_images_that_fit_are_kept() -> None:
    fit = images.fit_images(CAMERA, ImportOptions())
    assert fit.camera is CAMERA and fit.note == ""
    content = b"not even decoded"
    assert fit.image(content) is content
    rgb = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    fit = images.fit_images(CAMERA, ImportOptions(resolution=36))
    assert (fit.camera.width, fit.camera.height) == (36, 24)
    assert fit.camera.fx == CAMERA.fx * 36 / 96 and fit.camera.cy == CAMERA.cy * 24 / 64
    fine = rgb.repeat(3, 0).repeat(3, 1).astype(np.float64)  # 192 x 288: blocks of 8 x 8
    expected = fine.reshape(24, 8, 36, 8, 3).mean((1, 3))
    assert np.abs(fit.pixels(rgb) - expected).max() <= 0.5 + 1e-3
    whole = np.full((64, 96, 3), 255, np.uint8)
    assert (fit.pixels(whole) == 255).all()


def test_a_file_stays_of_its_kind_and_labels_are_never_mixed() -> None:
    rgb = smooth_picture(CAMERA)
    fit = images.fit_images(CAMERA, ImportOptions(resolution=(48, 32)))
    for kind, magic in (("PNG", b"\x89PNG"), ("JPEG", b"\xff\xd8\xff")):
        buffer = io.BytesIO()
        Image.fromarray(rgb).save(buffer, kind)
        out = fit.image(buffer.getvalue(), "x")
        assert isinstance(out, bytes) and out.startswith(magic)
        assert Image.open(io.BytesIO(out)).size == (48, 32)
    ids = np.random.default_rng(1).choice(np.array([0, 7, 255], np.uint8), (64, 96))
    assert (fit.ids(ids) == ids[1::2, 1::2]).all()
    refused("camera's size", fit.ids, ids[:10])


def test_sizes_and_frame_numbers_in_words() -> None:
    assert parse_resolution("") is None
    assert parse_resolution("960") == 960
    assert parse_resolution("960x640") == (960, 640)
    assert images.resized(1920, 1280, 960) == (960, 640)
    assert images.resized(640, 480, 960) == (640, 480)
    refused("never enlarged", images.resized, 640, 480, (960, 640), raises=UsageError)
    for text in ("8", "x640", "960x", "-5", "wide"):
        refused("image size", parse_resolution, text, raises=UsageError)
    said = {"none": [], "3": [3], "1, 5": [1, 5], "0 to 15": range(16), "1, 2, 4 to 6": [1, 2, 4, 5, 6]}
    assert all(number_ranges(list(numbers)) == words for words, numbers in said.items())
    assert number_ranges(list(range(0, 40, 2))) == "0, 2, 4, 6, 8, 10, 12, 14, ... (20 in all)"
