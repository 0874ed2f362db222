"""MP4 writing and the pictures that go into it."""

from __future__ import annotations

import io

import av
import numpy as np
import pytest
from refusals import refused

from mudg.core.pictures import side_by_side
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


def test_round_trip_keeps_number_size_and_look(tmp_path):
    frames = clip()
    path = video.write_mp4(tmp_path / "a.mp4", iter(frames), fps=7)
    back = pictures_of(path)
    assert back.shape == (5, 32, 48, 3)
    error = np.abs(back.astype(float) - np.stack(frames)).mean()
    assert error < 8
    with av.open(str(path)) as container:
        assert float(container.streams.video[0].average_rate) == pytest.approx(7)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mp4"]


def test_odd_sizes_are_padded(tmp_path):
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
    sheet = side_by_side(panels)
    assert sheet.shape == (20, 94, 3)
    assert sheet[0, [0, 29, 30, 31, 32, 64, 93], 0].tolist() == [10, 10, 255, 255, 20, 30, 30]
    refused("one size", side_by_side, [panels[0], panels[1][:10]])
    refused("one size", side_by_side, [])
