"""Pictures: their sizes, their colours, and the MP4 files that hold them, also on a full disk."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from PIL import Image
from refusals import refused

from mudg.base import palette
from mudg.core import pictures
from mudg.formats.exporters import video


def clip(count: int = 5, height: int = 32, width: int = 48) -> list[np.ndarray]:
    """A bright square that moves to the right over a gradient."""
    frames = []
    for index in range(count):
        frame = np.zeros((height, width, 3), np.uint8)
        frame[..., 0] = np.linspace(20, 120, width)
        frame[8:20, 4 + 6 * index : 14 + 6 * index] = (240, 230, 40)
        frames.append(frame)
    return frames


def pictures_of(path):
    """All frames of a video, u8[T, H, W, 3]."""
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_round_trip_keeps_number_size_and_look_and_pads_odd_sizes(tmp_path):
    frames = clip()
    path = video.write_mp4(tmp_path / "a.mp4", iter(frames), fps=7)
    back = pictures_of(path)
    assert back.shape == (5, 32, 48, 3)
    error = np.abs(back.astype(float) - np.stack(frames)).mean()
    assert error < 8
    with av.open(str(path)) as container:
        assert float(container.streams.video[0].average_rate) == pytest.approx(7)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mp4"]
    frames = [frame[:31, :47] for frame in clip()]
    assert pictures_of(video.write_mp4(tmp_path / "a.mp4", frames)).shape == (5, 32, 48, 3)


def test_same_frames_same_bytes(tmp_path):
    wanted = video.mp4_bytes(clip())
    rng = np.random.default_rng(0)
    for _ in range(20):  # whatever lay in the memory that the encoder gets
        littered = [rng.integers(0, 255, int(size), dtype=np.uint8) for size in rng.integers(1000, 3_000_000, 4)]
        del littered
        assert video.mp4_bytes(clip()) == wanted
    with av.open(io.BytesIO(video.mp4_bytes(clip()))) as container:
        assert len(list(container.decode(video=0))) == 5


def test_refusals_leave_no_file(tmp_path):
    for frames, words in (
        ([], "at least one frame"),
        ([*clip(2), clip(1, 16)[0]], "differ in size"),
        ([np.zeros((4, 4), np.uint8)], "must be u8"),
    ):
        refused(words, video.write_mp4, tmp_path / "a.mp4", frames)
    assert list(tmp_path.iterdir()) == []


def test_side_by_side_places_panels_in_a_row():
    panels = [np.full((20, 30, 3), value, np.uint8) for value in (10, 20, 30)]
    sheet = pictures.side_by_side(panels)
    assert sheet.shape == (20, 94, 3)
    assert sheet[0, [0, 29, 30, 31, 32, 64, 93], 0].tolist() == [10, 10, 255, 255, 20, 30, 30]
    refused("one size", pictures.side_by_side, [panels[0], panels[1][:10]])
    refused("one size", pictures.side_by_side, [])


def image(seed: int, height: int, width: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_area_and_bicubic_are_pillows_filters() -> None:
    rgb = image(0, 31, 47)
    for resize, rule in (
        (pictures.resize_area, Image.Resampling.BOX),
        (pictures.resize_bicubic, Image.Resampling.BICUBIC),
    ):
        assert np.array_equal(resize(rgb, 20, 17), np.asarray(Image.fromarray(rgb).resize((20, 17), rule)))
        assert np.array_equal(resize(rgb, 47, 31), rgb)
    assert pictures.resize_bicubic(rgb, 47, 31) is not rgb


@pytest.mark.parametrize("size", [(4, 4), (2, 2), (3, 5), (1, 7)])
def test_nearest_takes_the_pixel_under_the_centre_from_arrays_and_tensors(size: tuple[int, int]) -> None:
    ids = np.arange(20).reshape(4, 5)
    height, width = size
    rows, columns = ([int((n + 0.5) * old / new) for n in range(new)] for old, new in ((4, height), (5, width)))
    expected = ids[np.ix_(rows, columns)].tolist()
    found = pictures.resize_nearest(ids, height, width)
    assert found.tolist() == expected and found.flags.c_contiguous
    assert pictures.resize_nearest(torch.from_numpy(ids)[None], height, width).tolist() == [expected]


def test_exact_shrinking_is_the_mean_over_areas() -> None:
    rgb = image(1, 6, 8)
    halves = rgb.reshape(3, 2, 4, 2, 3).astype(float).mean((1, 3))
    assert np.abs(pictures.shrink_exact(rgb, 3, 4) - halves).max() <= 0.5
    # Rows of 3 out of 4: each new row is one old row and a third of its neighbour.
    wide = np.repeat(np.array([0, 30, 60, 90], np.uint8), 2 * 3).reshape(4, 2, 3)
    assert pictures.shrink_exact(wide, 3, 2)[:, 0, 0].tolist() == [8, 45, 82]
    refused("never enlarged", pictures.shrink_exact, rgb, 7, 8)


def test_depth_runs_from_warm_to_cold_and_missing_is_black() -> None:
    depth = np.array([[1.0, 2.0, 15.0, 100.0, 500.0, np.nan, 0.0, -3.0]])
    colors = pictures.depth_colors(depth)[0].astype(int)
    assert (colors[0] == colors[1]).all() and (colors[3] == colors[4]).all()
    assert colors[0, 0] > colors[0, 2] and colors[3, 2] > colors[3, 0]
    assert len(np.unique(colors[1:4], axis=0)) == 3
    assert (colors[5:] == 0).all() and (colors[:5].max(1) > 100).all()


def test_classes_confidences_and_errors_as_pictures() -> None:
    ids = np.array([[palette.ID["road"], palette.UNLABELLED]], np.uint8)
    assert pictures.class_colors(ids)[0].tolist() == [[128, 64, 128], [0, 0, 0]]
    assert pictures.gray(np.array([[0.0, 0.5, 2.0]]))[0].tolist() == [[0] * 3, [127] * 3, [255] * 3]
    rgb = torch.zeros(3, 1, 2)
    rgb[:, 0, 1] = 0.6
    error = pictures.error_image(rgb, torch.zeros(3, 1, 2))
    assert error[0].tolist() == [[0, 0, 0], [255, 255, 255]]
    assert pictures.to_bytes(rgb)[0].tolist() == [[0] * 3, [153] * 3]


WRITES = """
import resource, sys
import numpy as np
from pathlib import Path
from mudg import app
from mudg.base import failures
from mudg.base.errors import ResourceError
from mudg.formats.exporters.video import write_mp4
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
rng = np.random.default_rng(0)
try:
    write_mp4(Path(sys.argv[1]), (rng.integers(0, 255, (96, 160, 3), np.uint8) for _ in range(60)), 10.0)
except Exception as error:
    told = failures.in_words(error)
    assert isinstance(told, ResourceError), repr(error)
    print("in words", told.what)
else:
    print("written")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="needs a limit of file size")
@pytest.mark.parametrize(
    "limit", [1000, 10_000_000, *(pytest.param(limit, marks=pytest.mark.slow) for limit in (1, 30_000))]
)
def test_a_video_that_does_not_fit_on_the_disk_ends_in_words(limit: int, tmp_path: Path) -> None:
    command = [sys.executable, "-c", WRITES.format(limit=limit), str(tmp_path / "film.mp4")]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("written" if limit == 10_000_000 else "in words")
    assert [path.name for path in tmp_path.iterdir()] == (["film.mp4"] if limit == 10_000_000 else [])
