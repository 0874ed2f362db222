"""A driving log as records over time: what every format of messages is made of, and MCAP files of such messages.

Times count from the first record. Pictures and sweeps are read when they are written, one at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import ResourceError
from mudg.base.palette import CLASSES, DISPLAY_COLORS, ID
from mudg.base.types import Frame, PointCloud, Scene, Sweep, SweepPoints, Track
from mudg.base.versions import version

NANO: Final = 1_000_000_000
CHUNK_BYTES: Final = 4 << 20
"""Bytes of messages that an MCAP file holds together, and that are in memory at once."""
BOX_LIFE_S: Final = 0.15
"""Boxes vanish if no message follows for this long."""
MOUNT_M: Final = 1e-4
"""Metres (and entries of rotations) by which the place of a fixed sensor on the vehicle may vary."""

Matrix = NDArray[np.float64]


class LogRecords:
    """The records of a log.

    Args:
        picture: bytes of a frame's image. points: of a sweep. fused: a cloud that is sent once, or None.
    """

    def __init__(
        self,
        scene: Scene,
        picture: Callable[[Frame], bytes],
        points: Callable[[Sweep], SweepPoints],
        fused: PointCloud | None = None,
    ) -> None:
        self.scene, self.picture, self.points = scene, picture, points
        self.fused = fused if fused is not None and len(fused) else None
        times = [f.view.time_s for f in scene.frames] + [s.time_s for s in scene.sweeps] + scene.ego.times_s.tolist()
        self.start_s = min(times, default=0.0)

    def nanoseconds(self, time_s: float) -> int:
        """Since the first record."""
        return max(0, round((time_s - self.start_s) * NANO))

    def moments(self) -> list[float]:
        """Seconds of all pictures and sweeps, each once, in order."""
        return sorted({f.view.time_s for f in self.scene.frames} | {s.time_s for s in self.scene.sweeps})

    def boxes(self, time_s: float) -> list[tuple[Track, Matrix]]:
        """The objects that are there at a time, and their poses."""
        found = [(track, track.pose_at(time_s)) for track in self.scene.tracks]
        return [(track, pose) for track, pose in found if pose is not None]

    def mounts(self, tolerance_m: float = MOUNT_M) -> dict[str, Matrix]:
        """Ego-from-sensor f64[4, 4] of the sensors that do not move on the vehicle: ``camera/NAME``, ``lidar/NAME``.

        A sensor whose recorded poses the vehicle's path does not explain to ``tolerance_m`` is left out.
        """
        first: dict[str, Matrix] = {}
        moving: set[str] = set()
        for name, time_s, pose in self.sensor_poses():
            ego = self.scene.ego.pose_at(time_s)
            mount = None if ego is None else geometry.invert(ego) @ pose
            if mount is None or np.abs(first.setdefault(name, mount) - mount).max() > tolerance_m:
                moving.add(name)
        return {name: mount for name, mount in first.items() if name not in moving}

    def sensor_poses(self) -> list[tuple[str, float, Matrix]]:
        """``camera/NAME`` or ``lidar/NAME``, seconds, and world-from-sensor of every picture and sweep."""
        return [
            *((f"camera/{f.view.camera.name}", f.view.time_s, f.view.world_from_cam) for f in self.scene.frames),
            *((f"lidar/{s.sensor}", s.time_s, s.world_from_lidar) for s in self.scene.sweeps),
        ]


def picture_format(frame: Frame) -> str:
    """``jpeg``, ``png``, ..., by the name of the file."""
    ending = PurePosixPath(frame.image.path).suffix.lower().lstrip(".")
    return {"jpg": "jpeg"}.get(ending, ending)


def box_color(label: str) -> tuple[float, float, float]:
    """Red, green, blue in [0, 1] of a class name."""
    name = {"pedestrian": "person", "cyclist": "rider", "van": "car"}.get(label.lower(), label.lower())
    red, green, blue = DISPLAY_COLORS[ID[name]].tolist() if name in CLASSES else (160, 160, 160)
    return red / 255, green / 255, blue / 255


def above(pose: Matrix, track: Track) -> Matrix:
    """Where the name of an object stands: 0.4 m over its box."""
    return pose @ geometry.yaw_matrix(0.0, (0, 0, float(track.size_m[2]) / 2 + 0.4))


# MCAP files ---------------------------------------------------------------------------------------


class LogMessage(NamedTuple):
    """One message: its topic, the name of its schema, seconds on the log's clock, and what makes its value when it is
    written."""

    topic: str
    schema: str
    time_s: float
    value: Callable[[], Any]


class LogMessages:
    """The messages of a log in order of time, and how they stand in an MCAP file (names of its specification)."""

    profile: ClassVar[str] = ""
    schema_encoding: ClassVar[str]
    message_encoding: ClassVar[str]

    def __init__(self, records: LogRecords) -> None:
        self._log, self._scene = records, records.scene

    def __iter__(self) -> Iterator[LogMessage]:
        raise NotImplementedError

    def nanoseconds(self, time_s: float) -> int:
        """The stamp of a message."""
        return self._log.nanoseconds(time_s)

    def schema(self, name: str) -> str:
        """The text of a schema."""
        raise NotImplementedError

    def content(self, message: LogMessage) -> bytes:
        """The bytes of a message."""
        raise NotImplementedError

    def channel_metadata(self, topic: str) -> dict[str, str]:
        """What the channel of a topic carries."""
        return {}


def mcap_writer() -> Any:
    """The module ``mcap.writer``; ResourceError if the packages of messages are not installed."""
    try:
        import mcap.writer
        import rosbags.typesys  # noqa: F401
    except ImportError as error:
        what = "MCAP files and bags are written with the packages mcap and rosbags, which are not installed"
        raise ResourceError(what, got=str(error), remedy="pip install 'mudg[ros]'") from error
    return mcap.writer


class McapStream(list[bytes]):
    """What a writer wrote and nobody took yet; ``tell`` counts all of it."""

    size = 0

    def write(self, content: bytes) -> None:
        """Keep a block."""
        self.append(bytes(content))
        self.size += len(content)

    def tell(self) -> int:
        """Bytes written so far."""
        return self.size


def write_mcap(path: Path, messages: LogMessages) -> tuple[dict[str, tuple[str, int]], tuple[int, int]]:
    """Write an MCAP file, completely or not at all; no more than one chunk is in memory.

    Returns:
        Schema and number of messages of every topic, and the nanoseconds of the first and the last message.
    """
    package, schemas, channels, stream = mcap_writer(), dict[str, int](), dict[str, int](), McapStream()
    topics, stamps = dict[str, tuple[str, int]](), [0]
    writer = package.Writer(stream, CHUNK_BYTES, package.CompressionType.NONE)

    def blocks() -> Iterator[bytes]:
        writer.start(messages.profile, f"mudg {version()}")
        for message in messages:
            topic, name, stamp = message.topic, message.schema, messages.nanoseconds(message.time_s)
            if name not in schemas:
                text = messages.schema(name).encode()
                schemas[name] = writer.register_schema(name, messages.schema_encoding, text)
            if topic not in channels:
                about = messages.channel_metadata(topic)
                channels[topic] = writer.register_channel(topic, messages.message_encoding, schemas[name], about)
            number = topics.get(topic, (name, 0))[1]
            writer.add_message(channels[topic], stamp, messages.content(message), stamp, number)
            stamps[:] = [stamps[0] if topics else stamp, stamp]
            topics[topic] = (name, number + 1)
            yield from stream
            stream.clear()
        writer.finish()
        yield from stream

    store.write_blocks(path, blocks())
    return topics, (stamps[0], stamps[-1])
