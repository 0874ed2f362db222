"""MP4 video (H.264, 4:2:0) through PyAV."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.error
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import store
from mudg.base.errors import InputError, ResourceError

_H264_ENCODERS = ("libx264", "h264_videotoolbox", "libopenh264")
_CODECS = ("libx264", "h264", "mpeg4")


def write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float = 10.0) -> Path:
    """Encode frames u8[H, W, 3] to ``path`` atomically; odd sizes are padded by one pixel of the edge. Raises
    InputError: no frames, or frames of different sizes. ResourceError: no usable encoder, or the disk is full."""
    with store.atomic_path(Path(path)) as temporary:
        _encode(str(temporary), frames, fps, crf=20)
    return Path(path)


def mp4_bytes(frames: Iterable[NDArray[np.uint8]], fps: float = 10.0, crf: int = 27, preset: str = "medium") -> bytes:
    """The same as bytes, for embedding in a page. ``preset``: x264's name for speed against size."""
    buffer = io.BytesIO()
    _encode(buffer, frames, fps, crf, preset)
    return buffer.getvalue()


def mp4_within(
    frames: Callable[[], Iterable[NDArray[np.uint8]]], fps: float, crf: tuple[int, int], budget_bytes: int
) -> bytes:
    """A video of at most ``budget_bytes``, if the worst quality allows; ``frames`` is called once per attempt. ``crf``:
    x264's value of the best and of the worst quality, lower is better."""
    quality, worst = crf
    while True:
        content = mp4_bytes(frames(), fps, quality, "veryfast")
        if len(content) <= budget_bytes or quality >= worst:
            return content
        # Six steps of the quality halve the size, about.
        quality = min(worst, quality + max(1, math.ceil(6 * math.log2(len(content) / budget_bytes))))


def jpeg_bytes(picture: NDArray[np.uint8], quality: int) -> bytes:
    """A picture u8[H, W, 3] as a JPEG file."""
    target = io.BytesIO()
    Image.fromarray(picture).save(target, "JPEG", quality=quality)
    return target.getvalue()


def _encode(target: Any, frames: Iterable[NDArray[np.uint8]], fps: float, crf: int, preset: str = "medium") -> None:
    container = stream = None
    size: tuple[int, ...] = ()
    try:
        for index, frame in enumerate(frames):
            if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
                what = "a video frame must be u8[H, W, 3]"
                raise InputError(what, where=f"frame {index}", got=f"{frame.dtype} {frame.shape}")
            if container is None:
                size = frame.shape
                # The index first, so that players start at once; only a file can be rewritten that way.
                options = {"movflags": "+faststart"} if isinstance(target, str) else {}
                container = av.open(target, "w", format="mp4", options=options)
                stream = _stream(container, frame.shape, fps, crf, preset)
            if frame.shape != size:
                what = "video frames differ in size"
                raise InputError(what, where=f"frame {index}", expected=str(size), got=str(frame.shape))
            for packet in stream.encode(av.VideoFrame.from_ndarray(_even(frame), format="rgb24")):
                container.mux(packet)
        if container is None or stream is None:
            raise InputError("a video needs at least one frame")
        for packet in stream.encode():
            container.mux(packet)
    except av.error.FFmpegError as error:
        raise ResourceError("the video could not be encoded", where=str(target), got=str(error)) from error
    finally:
        if container is not None:
            container.close()


def _stream(container: Any, shape: tuple[int, ...], fps: float, crf: int, preset: str) -> Any:
    codec = next((name for name in _CODECS if name in av.codecs_available), None)
    if codec is None:
        raise ResourceError("PyAV was built without an MP4 video encoder", expected=" or ".join(_CODECS))
    stream = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1000))
    stream.width, stream.height = shape[1] + shape[1] % 2, shape[0] + shape[0] % 2
    stream.pix_fmt = "yuv420p"
    stream.thread_count = 1  # the same bytes on every machine with this encoder
    # Without the tree of macroblocks: with B-frames x264's vector code for it reads memory that was never written, and
    # the bytes of a video then depend on what lay there before.
    stream.options = {"crf": str(crf), "preset": preset, "mbtree": "0"} if codec == "libx264" else {}
    return stream


def _even(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = frame.shape[:2]
    if height % 2 == 0 and width % 2 == 0:
        return np.ascontiguousarray(frame)
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def video_encoders() -> list[str]:
    """Names of the H.264 encoders (what browsers play) that PyAV offers here, best first."""
    found = []
    for name in _H264_ENCODERS:
        try:
            av.codec.Codec(name, "w")
        except av.codec.codec.UnknownCodecError:
            continue
        found.append(name)
    return found
