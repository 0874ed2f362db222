"""A tiny log in every format, written once for all tests of bad input, and ways to damage one record of it for a
moment.

Every format is given the same three moments of the small city (KITTI: its own made-up drive). ``damaged`` hands out a
source with one image or cloud changed and the words by which an error must name it; afterwards the log is whole again.
"""

from __future__ import annotations

import copy
import functools
import io
import re
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import kitti_folders
import numpy as np
import pytest
import roundtrip
import write_av2
import write_custom
import write_kitti360
import write_nuplan
import write_nuscenes
import write_pandaset
import write_waymo
from PIL import Image
from refusals import refused  # noqa: F401 (tests of formats take it from here)

from mudg.base.errors import InputError
from mudg.base.types import Scene
from mudg.city import sensors
from mudg.formats.importers import IMPORTERS
from mudg.formats.importers.common import ImportOptions
from mudg.scene.read import read_scene

Change = Callable[[bytes], bytes]
TWO = {"cameras": ("front", "front_left")}
NUSCENES = {**TWO, "sequence": "scene-0007"}
FORMATS = ("kitti", "kitti360", "waymo v1", "waymo v2", "nuscenes", "argoverse2", "pandaset", "nuplan", "custom")
NEEDS_PYARROW = ("waymo v2", "argoverse2")


@dataclass(frozen=True)
class Files:
    """A log of separate files: what is imported and how, its second image of the first camera and its second cloud."""

    source: Path
    image: Path
    cloud: Path
    options: Mapping[str, Any] = field(default_factory=dict)


def shared(factory: pytest.TempPathFactory) -> Path:
    """The folder of the logs, the same for all test modules."""
    folder = factory.getbasetemp() / "bad logs"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """The small city, the same for all test modules."""
    return whole_city(shared(tmp_path_factory) / "city")


def fixtures(write: Callable[[Scene, Path], object], name: str) -> tuple[Any, Any]:
    """Fixtures of a test module: the whole city as a log, which all of its tests share, and a copy to spoil, called
    ``name``."""

    @pytest.fixture(scope="module")
    def pristine(truth: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
        folder = tmp_path_factory.mktemp("logs") / name
        write(truth, folder)
        return folder

    @pytest.fixture
    def source(pristine: Path, tmp_path: Path) -> Path:
        return shutil.copytree(pristine, tmp_path / name)

    return pristine, source


@functools.cache
def whole_city(folder: Path) -> Scene:
    """All moments of the small city."""
    return roundtrip.small_log(folder)


def importer(kind: str, **usual: Any) -> Callable[..., Scene]:
    """``ingest(source, out, **options)`` of a format, with its ``usual`` options."""
    return lambda source, out, **options: IMPORTERS[kind](source, out, ImportOptions(**{**usual, **options}))


@functools.cache
def city(folder: Path) -> Scene:
    """Three moments of the small city."""
    return roundtrip.small_log(folder, n_frames=3)


@functools.cache
def written(kind: str, folder: Path) -> Files | write_waymo.Log:
    """The log of a format below ``folder``, which all tests share."""
    if kind in NEEDS_PYARROW:
        pytest.importorskip("pyarrow")
    if kind == "kitti":
        root = kitti_folders.write_derived(folder / "kitti")
        return Files(root, root / "image_02/data/0000000003.png", root / "velodyne_points/data/0000000003.bin")
    truth = city(folder / "truth")
    root = folder / kind
    match kind:
        case "waymo v1" | "waymo v2":
            return waymo(folder)
        case "kitti360":
            write_kitti360.write_kitti360(truth, root)
            number = f"{write_kitti360.FIRST + 1:010d}"
            images = root / "data_2d_raw" / write_kitti360.DRIVE / "image_00" / "data_rect"
            scans = root / "data_3d_raw" / write_kitti360.DRIVE / "velodyne_points" / "data"
            return Files(root, images / f"{number}.png", scans / f"{number}.bin", {"untwist": "no"})
        case "nuscenes":
            write_nuscenes.write_nuscenes(truth, root)
            return Files(root, second(root / "samples/CAM_FRONT"), second(root / "samples/LIDAR_TOP"), NUSCENES)
        case "argoverse2":
            write_av2.write_av2(truth, root)
            return Files(root, second(root / "sensors/cameras/ring_front_center"), second(root / "sensors/lidar"), TWO)
        case "pandaset":
            root = write_pandaset.write_pandaset(truth, root / "001")
            return Files(root, root / "camera/front_camera/01.png", root / "lidar/01.pkl.gz")
        case "nuplan":
            database = write_nuplan.write_nuplan(truth, root)
            blobs = root / "sensor_blobs" / write_nuplan.LOG
            image = f"{write_nuplan.token('CAM_F0', 1).hex()}.jpg"
            cloud = f"{write_nuplan.token('cloud', 1).hex()}.pcd"
            return Files(database, blobs / "CAM_F0" / image, blobs / "MergedPointCloud" / cloud)
        case "custom":
            write_custom.write_log(truth, root)
            return Files(root, root / "images/front/000001.png", root / "lidar/lidar/000001.npz")
    raise KeyError(kind)


@functools.cache
def waymo(folder: Path) -> write_waymo.Log:
    """The city as a Waymo log."""
    truth = city(folder / "truth")
    beams = sensors.lidar_elevations(roundtrip.SMALL)
    return write_waymo.log_of(truth, read_scene(folder / "truth").tracks, beams=beams, columns=240)


def write_waymo_log(log: write_waymo.Log, kind: str, folder: Path) -> Path:
    """A Waymo log as the form ``kind`` names."""
    if kind == "waymo v1":
        return write_waymo.write_tfrecord(log, folder / "segment.tfrecord")
    return write_waymo.write_parquet(log, folder)


def second(folder: Path) -> Path:
    """The second file in the order of names."""
    return sorted(folder.iterdir())[1]


@contextmanager
def damaged(
    log: Files | write_waymo.Log, kind: str, what: str, change: Change, tmp_path: Path
) -> Iterator[tuple[Path, str]]:
    """The source with its second ``image`` or ``cloud`` changed, and a pattern of how an error must name the place."""
    if isinstance(log, Files):
        path = log.image if what == "image" else log.cloud
        content = path.read_bytes()
        path.write_bytes(change(content))
        try:
            yield log.source, re.escape(path.name)
        finally:
            path.write_bytes(content)
        return
    spoilt = copy.deepcopy(log)
    image = spoilt.frames[1]["images"][0]
    image["image"] = change(image["image"])
    yield write_waymo_log(spoilt, kind, tmp_path / "log"), "record 1 at byte|frame 1.*front|front.*frame 1"


def options_of(log: Files | write_waymo.Log) -> ImportOptions:
    """How the log is imported."""
    return ImportOptions(**(log.options if isinstance(log, Files) else {}))


def ingest(kind: str, source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a log of ``FORMATS``."""
    return IMPORTERS[kind.split()[0]](source, out, options)


def assert_refused(
    kind: str, source: Path, tmp_path: Path, options: ImportOptions, words: str, where: str = ""
) -> InputError:
    """The import fails with an ``InputError`` that has these words and names this place (patterns), and leaves
    nothing."""
    error = roundtrip.assert_refused(lambda log, out: ingest(kind, log, out, options), source, tmp_path / "out", words)
    assert re.search(where, error.where, re.DOTALL), error.where
    return error


# --- images ---------------------------------------------------------------------------------------


def png(image: Image.Image, **save: Any) -> bytes:
    """Bytes of a PNG."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG", **save)
    return buffer.getvalue()


def opened(content: bytes) -> Image.Image:
    """The image in some bytes."""
    return Image.open(io.BytesIO(content))


def sixteen_bits(content: bytes) -> bytes:
    """16-bit grey of the same size."""
    width, height = opened(content).size
    return png(Image.fromarray(np.full((height, width), 40_000, np.uint16)))


def turned(content: bytes) -> bytes:
    """The same image with a note that it is to be shown turned."""
    exif = Image.Exif()
    exif[0x0112] = 6
    return png(opened(content), exif=exif)


def declaring(width: int, height: int) -> Change:
    """The PNG with another size in its header, whose checksum fits."""

    def change(content: bytes) -> bytes:
        header = b"IHDR" + struct.pack(">II", width, height) + content[24:29]
        return content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:]

    return change


def other_checksum(content: bytes) -> bytes:
    """The PNG with one bit of its first data checksum flipped."""
    at = content.index(b"IDAT")
    end = at + 4 + struct.unpack(">I", content[at - 4 : at])[0]
    return content[:end] + bytes([content[end] ^ 1]) + content[end + 1 :]
