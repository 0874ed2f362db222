"""What importers share: work over items in parallel, units of time, poses that must be rigid, the vehicle's path, and
finding the files of a log. The scene is the same for any number of workers."""

from __future__ import annotations

import lzma
import re
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg import native
from mudg.base import log
from mudg.base.errors import InputError, MudgError, ResourceError, UsageError
from mudg.base.geometry import (
    from_rotation_translation,
    invert,
    matrix_from_quaternion,
    pose_at,
    transform_points,
    yaw_matrix,
    yaw_of,
)
from mudg.base.types import Camera, EgoPath
from mudg.scene import motion
from mudg.scene.clouds import is_return, near_places
from mudg.scene.schema import ref_problem


def name_table(text: str) -> dict[str, str]:
    """``here: theirs, theirs; here: theirs`` -> their name -> the name here, in this order."""
    rows = (row.split(":") for row in text.split(";"))
    return {name.strip(): here.strip() for here, names in rows for name in names.split(",")}


# --- columns --------------------------------------------------------------------------------------
Columns = Mapping[str, NDArray[Any]]
_ROUNDING: Final = 1e-3


def require_columns(names: Iterable[str], there: Iterable[str], where: object) -> None:
    """Refuse a table that lacks one of ``names``."""
    there, names = set(there), list(names)
    if not there.issuperset(names):
        got, expected = ", ".join(sorted(there)[:40]) or "no columns", ", ".join(names)
        remedy = "is this a file of another data set, version or kind?"
        raise InputError("table lacks columns", where=str(where), got=got, expected=expected, remedy=remedy)


def _number_columns(columns: Columns, names: Sequence[str], where: object) -> NDArray[np.float64]:
    try:
        return np.stack([columns[name].astype(np.float64) for name in names], 1)
    except (TypeError, ValueError) as error:
        where = f"{where}: {', '.join(names)}"
        raise InputError("column does not hold numbers", where=where, got=str(error)[:120]) from error


def finite_columns(columns: Columns, names: Sequence[str], where: object) -> NDArray[np.float64]:
    """Columns as f64[n, k]. Raises InputError: no numbers, or not all finite."""
    table, where = _number_columns(columns, names, where), f"{where}: {', '.join(names)}"
    bad = ~np.isfinite(table).all(1)
    if bad.any():
        got = f"{int(bad.sum())} of {len(table)} rows, first {int(np.flatnonzero(bad)[0])}"
        raise InputError("column holds values that are not finite", where=where, got=got)
    return table


def unit_intensity(values: NDArray[Any], largest: float, where: object, remedy: str = "") -> NDArray[np.float32]:
    """Intensities from 0 to the ``largest`` of their format as f32 from 0 to 1. Raises InputError: others, beyond
    rounding."""
    scaled = values.astype(np.float64) / largest
    if not ((scaled > -_ROUNDING) & (scaled < 1 + _ROUNDING)).all():
        what, got = "intensity is out of range", f"{values.min():g} to {values.max():g}"
        remedy = remedy or "scale the values as the data set does"
        raise InputError(what, where=str(where), expected=f"0 to {largest:g}", got=got, remedy=remedy)
    return scaled.clip(0, 1).astype(np.float32)


def returns_of(columns: Columns, where: object, places: Iterable[NDArray[np.float64]] = ()) -> NDArray[np.bool_]:
    """Rows of a cloud's columns x, y, z that are returns of a beam, and not at one of the sensors' ``places``."""
    xyz = _number_columns(columns, ("x", "y", "z"), where)
    return is_return(xyz) & ~near_places(xyz, places)


@contextmanager
def arrow_files(path: Path) -> Iterator[None]:
    """Code that reads a Feather or Parquet file with pyarrow. ResourceError: it is not installed. InputError: the file
    is damaged or cut off."""
    try:
        import pyarrow
    except ImportError as error:
        what = "Feather and Parquet files need pyarrow, which is not installed"
        raise ResourceError(what, where=str(path), remedy="pip install 'mudg[data]'") from error
    try:
        yield
    except (pyarrow.ArrowException, OSError, MemoryError, StopIteration, UnicodeDecodeError) as error:
        what, remedy = "table cannot be read, or is cut off", "copy the file again"
        raise InputError(what, where=str(path), remedy=remedy, got=str(error)[:200] or "it ends early") from error


def unpacked(unpacker: Any, packed: bytes | memoryview, most: int, what: str, where: str) -> bytes:
    """What a decompressor of ``zlib`` or ``lzma`` makes of all bytes, ``most`` at most; ``what`` they are, for
    messages. Raises InputError: damaged, cut off, or more than that."""
    try:
        content = unpacker.decompress(packed, most + 1)
    except (zlib.error, lzma.LZMAError, EOFError) as error:
        raise InputError(f"{what} is damaged", where=where, got=str(error), remedy="copy the file again") from error
    if len(content) > most:
        got = f"{len(packed)} bytes"
        raise InputError(f"{what} unpacks to too much", where=where, got=got, expected=f"at most {most} bytes")
    if not unpacker.eof:
        got = f"{len(packed)} bytes, no end"
        raise InputError(f"{what} is cut off", where=where, got=got, remedy="copy the file again")
    return content


# --- options --------------------------------------------------------------------------------------
Resolution = int | tuple[int, int]
"""Longest side in pixels, or width and height."""


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """Options of an import. ``frames``: source frame numbers (first, end), end not included; None takes all.
    ``cameras``: the dataset's camera names; empty takes the importer's default. ``sequence``: which one of a folder
    that holds many. ``poses``, ``boxes``: files to use instead of those found. ``skip_missing``: leave out frames of
    which an image, scan or vehicle pose is missing, instead of refusing. ``untwist``: undo the distortion of scans by
    the vehicle's motion; auto decides by what the dataset documents. ``test_every``: hold out every n-th frame of all
    cameras (n, 2n, ...); 0 holds out none. ``resolution``: size of the scene's images; None keeps the recorded one.
    ``workers``: threads that convert frames; 0 = as many as there are processors to use. Results do not depend on
    it."""

    frames: tuple[int, int] | None = None
    cameras: tuple[str, ...] = ()
    sequence: str = ""
    poses: Path | None = None
    boxes: Path | None = None
    skip_missing: bool = False
    untwist: Literal["auto", "yes", "no"] = "auto"
    test_every: int = 4
    resolution: Resolution | None = None
    workers: int = 1


def parse_frame_range(text: str) -> tuple[int, int] | None:
    """``"10:26"`` -> (10, 26); an empty text -> None. Raises UsageError: not of this form, or an empty range."""
    if not text:
        return None
    match = re.fullmatch(r"(\d{1,9}):(\d{1,9})", text.strip())
    if match is None or int(match[1]) >= int(match[2]):
        what = "frame range makes no sense"
        raise UsageError(what, where="--frames", expected="FIRST:END with FIRST < END, e.g. 0:16", got=text)
    return int(match[1]), int(match[2])


def parse_resolution(text: str) -> Resolution | None:
    """``"960"`` -> 960 (longest side), ``"960x640"`` -> (960, 640); an empty text -> None. Raises UsageError: not of
    this form, or below 16 pixels."""
    if not text:
        return None
    match = re.fullmatch(r"(\d{2,5})(?:x(\d{2,5}))?", text.strip().lower())
    sides = [int(side) for side in match.groups() if side] if match is not None else []
    if not sides or min(sides) < 16:
        expected = "the longest side, e.g. 960, or WIDTHxHEIGHT, e.g. 960x640; at least 16 pixels"
        raise UsageError("image size makes no sense", where="--resolution", expected=expected, got=text)
    return sides[0] if len(sides) == 1 else (sides[0], sides[1])


def holdout_split(frame_ids_by_time: list[list[str]], test_every: int) -> dict[str, Literal["train", "test"]]:
    """Every ``test_every``-th moment (4, 8, 12, ... for 4; never the first; 0: none) is held out, all cameras together.
    ``frame_ids_by_time``: ids of the frames of each moment, in time order."""
    return {
        frame_id: "test" if test_every > 0 and index > 0 and index % test_every == 0 else "train"
        for index, frame_ids in enumerate(frame_ids_by_time)
        for frame_id in frame_ids
    }


# --- limits ---------------------------------------------------------------------------------------
Item = TypeVar("Item")
Matrix = NDArray[np.float64]
TimeUnit = Literal["ns", "us", "ms", "s"]

UNITS_PER_SECOND: Final[dict[str, int]] = {"ns": 10**9, "us": 10**6, "ms": 10**3, "s": 1}
PLAUSIBLE_PERIOD_S: Final = (2e-3, 20.0)
"""Typical time between two records of one sensor; outside of it the unit is taken to be wrong."""
POSE_TOLERANCE: Final = 1e-3
QUATERNION_TOLERANCE: Final = 1e-2
MAX_EXTRAPOLATION_S: Final = 0.15
_DESKEW_STEPS: Final = 32
MAX_SPEED_M_S: Final = 100.0
_SPEED_OVER_S: Final = 0.05
_LEAST_UPRIGHT: Final = 0.5
_DRIVES_M_S: Final = 1.0
_LEAST_ALONG: Final = 0.8
_COURSE_WITHIN_S: Final = 1.0
_EPOCH_S: Final = (1e8, 4.1e9)
"""Seconds since 1970 that a recording may carry: 1973 to 2099."""
_MAX_LOG_S: Final = 4 * 3600.0


# --- work over frames -----------------------------------------------------------------------------


def for_each(
    items: Iterable[Item],
    work: Callable[[Item], None],
    title: str,
    total: int,
    workers: int,
    name: Callable[[Item], str],
) -> None:
    """Do ``work`` on every item with a progress bar, in ``workers`` threads (0 = as many as there are processors to
    use); at most two items per worker are in memory. ``items``: read lazily, by the calling thread. ``total``: their
    number; 0 = unknown. ``name``: what an item is called, put before the place of an error. Raises the error of the
    earliest failed item. No item is started after one failed; those under way are waited for."""
    workers = workers or native.default_threads()
    pending: deque[Future[None]] = deque()
    with log.task(title, total) as bar, ThreadPoolExecutor(workers, thread_name_prefix="importer") as pool:

        def finish(left: int) -> None:
            while len(pending) > left:
                pending.popleft().result()
                bar.advance()

        try:
            for item in items:
                pending.append(pool.submit(_named, work, item, name))
                if any(future.done() and future.exception() for future in pending):
                    break
                finish(2 * workers - 1)
            finish(0)
        finally:
            for future in pending:
                future.cancel()


def foreign_numbers() -> np.errstate:
    """Code that reads numbers of others: values that overflow or are none stay silent, because what comes out is
    checked. Holds in the thread that enters it."""
    return np.errstate(over="ignore", invalid="ignore")


def _named(work: Callable[[Item], None], item: Item, name: Callable[[Item], str]) -> None:
    try:
        with foreign_numbers():
            work(item)
    except MudgError as error:
        if (called := name(item)) in error.where:
            raise
        raise error.located(f"{called}: {error.where}" if error.where else called) from error


# --- time -----------------------------------------------------------------------------------------


def seconds(times: Sequence[int] | Sequence[float] | NDArray, unit: TimeUnit, where: str, start: float = 0) -> Matrix:
    """Times of one sensor's records as seconds f64[N] since ``start`` (same unit); nanoseconds of the epoch keep their
    digits. Raises InputError: not increasing, not finite, or so close or far apart that the unit is wrong."""
    numbers = np.asarray(times)
    if numbers.dtype.kind not in "iuf" or numbers.ndim != 1 or not np.isfinite(numbers.astype(np.float64)).all():
        raise InputError("timestamps are not a list of finite numbers", where=where, got=str(numbers)[:80])
    if numbers.dtype.kind == "u":
        numbers = numbers.astype(np.int64)
    origin = int(start) if numbers.dtype.kind == "i" else start
    since_start = (numbers - origin).astype(np.float64) / UNITS_PER_SECOND[unit]
    steps = np.diff(since_start)
    if (steps <= 0).any():
        at = int(np.flatnonzero(steps <= 0)[0])
        what, where = "timestamps do not increase", f"{where}: record {at + 1}"
        expected, remedy = f"later than {numbers[at]} {unit}", "sort the records by time, and remove doubled ones"
        raise InputError(what, where=where, expected=expected, got=str(numbers[at + 1]), remedy=remedy)
    low, high = PLAUSIBLE_PERIOD_S
    if len(steps) and not low <= (period := float(np.median(steps))) <= high:
        raw = period * UNITS_PER_SECOND[unit]
        fitting = [u for u, scale in UNITS_PER_SECOND.items() if low <= raw / scale <= high]
        what, expected = "timestamps are in another unit than expected", f"{unit}; records {low:g} to {high:g} s apart"
        remedy = f"they look like {' or '.join(fitting)}" if fitting else "check the clock of the recording"
        raise InputError(what, where=where, expected=expected, got=f"records {period:.3g} s apart", remedy=remedy)
    return since_start


def check_epoch(stamps: NDArray[Any], per_second: int, where: str) -> None:
    """Refuse time stamps that are not since 1970 in the unit ``per_second`` (10**6 = microseconds)."""
    unit = {1: "seconds", 10**6: "microseconds", 10**9: "nanoseconds"}[per_second]
    outside = (stamps < _EPOCH_S[0] * per_second) | (stamps > _EPOCH_S[1] * per_second)
    if outside.any():
        what, expected, got = "time stamp is in another unit", f"{unit} since 1970", f"{int(stamps[outside][0])}"
        raise InputError(what, where=where, expected=expected, got=got, remedy=f"convert the stamps to {unit}")
    if len(stamps) and int(stamps.max()) - int(stamps.min()) > _MAX_LOG_S * per_second:
        what, got = "time stamps of one log span more than hours", f"{int(stamps.min())} to {int(stamps.max())}"
        remedy = "are records of another log, or of another unit, mixed in?"
        raise InputError(what, where=where, got=got, expected=f"{unit}, all of one recording", remedy=remedy)


def nearest_index(sorted_times_s: NDArray[Any], times_s: NDArray[Any]) -> NDArray[np.intp]:
    """Index of the nearest of increasing times f64[n] for each of ``times_s`` f64[m]; halfway goes to the earlier."""
    return np.searchsorted((sorted_times_s[1:] + sorted_times_s[:-1]) / 2, times_s)


# --- cameras and poses ----------------------------------------------------------------------------


def pinhole_camera(
    name: str, size: tuple[int, int], intrinsics: Any, where: str, lens: tuple[float, ...] = ()
) -> Camera:
    """A camera of ``size`` (width, height) from 3x3 intrinsics whose pixels are counted from the centre of the top-left
    one, as OpenCV does: half a pixel is added here. Raises InputError: numbers that no pinhole camera has."""
    try:
        k = np.array(intrinsics, np.float64)
    except (TypeError, ValueError):
        k = np.zeros((0, 0))
    off = k[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0, 0, 0, 0, 1] if k.shape == (3, 3) else np.array([np.nan])
    if not np.isfinite(k).all() or not (np.abs(off) < 1e-6).all() or min(k[0, 0], k[1, 1]) <= 0:
        what, expected = "intrinsics are not of a pinhole camera", "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
        remedy = "check the calibration"
        raise InputError(what, where=where, expected=expected, got=str(intrinsics), remedy=remedy)
    (fx, fy), (cx, cy) = np.diag(k)[:2].tolist(), k[:2, 2].tolist()
    return Camera(name, *size, fx, fy, cx + 0.5, cy + 0.5, lens)


def rigid_pose(matrix: ArrayLike, where: str) -> Matrix:
    """A pose from a file, [3, 4] or [4, 4], as f64[4, 4]; rounding up to 1e-3 in the rotation is cleaned. Raises
    InputError: scaled, left-handed, not a rotation, or not finite."""
    numbers = np.asarray(matrix, np.float64)
    if numbers.shape not in ((3, 4), (4, 4)):
        raise InputError("pose has the wrong shape", where=where, expected="3x4 or 4x4 numbers", got=str(numbers.shape))
    if not np.isfinite(numbers).all():
        raise InputError("pose holds values that are not finite", where=where)
    if len(numbers) == 4 and np.abs(numbers[3] - [0, 0, 0, 1]).max() > POSE_TOLERANCE:
        transposed, what = np.abs(numbers[:3, 3]).max() < POSE_TOLERANCE, "pose does not end in the row 0 0 0 1"
        remedy = "it looks transposed: write it row by row" if transposed else "write it row by row"
        raise InputError(what, where=where, got=str(numbers[3].tolist()), remedy=remedy)
    return from_rotation_translation(rigid_rotation(numbers[:3, :3], where), numbers[:3, 3])


def rigid_rotation(matrix: NDArray[np.float64], where: str) -> Matrix:
    """The rotation nearest to f64[3, 3] numbers that were rounded; see ``rigid_pose``."""
    u, stretch, vt = np.linalg.svd(matrix)
    if stretch[0] - stretch[2] <= POSE_TOLERANCE * stretch[0] and abs(stretch[1] - 1) > POSE_TOLERANCE:
        expected = "a rotation (scale 1)"
        remedy = "divide the rotation part by its scale; are the translations in metres?"
        raise InputError("pose is scaled", where=where, expected=expected, got=f"scale {stretch[1]:.6g}", remedy=remedy)
    if np.abs(stretch - 1).max() > POSE_TOLERANCE:
        what, got = "pose is not a rigid motion", f"stretches {', '.join(f'{s:.4g}' for s in stretch)}"
        remedy = "is it row-major, without shear or scale?"
        raise InputError(what, where=where, expected="an orthonormal rotation part", got=got, remedy=remedy)
    if np.linalg.det(u @ vt) < 0:
        got = "a reflection (determinant -1)"
        remedy = "one axis is mirrored: x forward, y left, z up for vehicles; x right, y down, z forward for cameras"
        raise InputError("pose is left-handed", where=where, expected="determinant +1", got=got, remedy=remedy)
    return u @ vt


def pose_from_quaternion(wxyz: ArrayLike, xyz_m: ArrayLike, where: str) -> Matrix:
    """Pose f64[4, 4] from a unit quaternion (w, x, y, z) and metres. Raises InputError: not finite, wrong count, or a
    quaternion whose length is not 1 within 1 %."""
    q, t = np.asarray(wxyz, np.float64).reshape(-1), np.asarray(xyz_m, np.float64).reshape(-1)
    if q.shape != (4,) or t.shape != (3,) or not np.isfinite(q).all() or not np.isfinite(t).all():
        what = "pose is not a quaternion and a translation"
        raise InputError(what, where=where, expected="4 and 3 finite numbers", got=f"{q.tolist()} and {t.tolist()}")
    length = float(np.linalg.norm(q))
    if abs(length - 1) > QUATERNION_TOLERANCE:
        what = "quaternion does not have length 1"
        raise InputError(what, where=where, expected="w, x, y, z of a rotation", got=f"length {length:.6g}")
    return from_rotation_translation(matrix_from_quaternion(q), t)


def pose_near(
    ego: EgoPath, time_s: float, max_beyond_s: float = MAX_EXTRAPOLATION_S, where: str = "ego path"
) -> Matrix:
    """Ego pose at a time; a little outside the path it goes on as it did between its two nearest keys. Raises
    InputError: more than ``max_beyond_s`` outside, or in a gap of the path (``motion.gap_at``)."""
    inside = pose_at(ego.times_s, ego.world_from_ego, time_s)
    if inside is not None:
        gap = motion.gap_at(ego, time_s)
        if gap is not None:
            raise gap_problem(gap, time_s, where)
        return inside
    first = time_s < ego.times_s[0]
    beyond = float(ego.times_s[0] - time_s if first else time_s - ego.times_s[-1])
    if beyond > max_beyond_s:
        what, expected = "vehicle poses do not cover the images and scans", "poses from the first to the last frame"
        remedy = "are the clocks the same? is the file cut off, or of another log?"
        remedy += " --skip-missing leaves such records out"
        raise InputError(what, where=where, got=f"{beyond:.2f} s outside", expected=expected, remedy=remedy)
    if len(ego.times_s) == 1:
        return ego.world_from_ego[0]
    near, far = (0, 1) if first else (-1, -2)
    if beyond > abs(ego.times_s[far] - ego.times_s[near]):
        return ego.world_from_ego[near]
    # mirror the motion of the neighbouring interval: the pose at "beyond" before the end, turned around
    back = pose_at(ego.times_s, ego.world_from_ego, float(ego.times_s[near]) + (beyond if first else -beyond))
    end = ego.world_from_ego[near]
    return end if back is None else end @ invert(back) @ end


def gap_problem(gap: motion.Gap, time_s: float, where: str) -> InputError:
    """The error about an image or scan in a gap of the vehicle's path."""
    what, got = "vehicle poses have a gap here", f"at {time_s:.3f} s: {gap}"
    remedy = "leave such frames out with --skip-missing"
    return InputError(what, where=where, got=got, expected="poses around every image and scan", remedy=remedy)


def has_pose(ego: EgoPath, time_s: float, max_beyond_s: float = MAX_EXTRAPOLATION_S) -> bool:
    """Whether ``pose_near`` has a pose at a time."""
    try:
        pose_near(ego, time_s, max_beyond_s)
    except InputError:
        return False
    return True


def mended_path(ego: EgoPath, notes: list[str]) -> EgoPath:
    """The vehicle's path with headings that flip by 180 degrees turned back, which is added to ``notes``."""
    poses, turned = motion.unflipped(ego.times_s, ego.world_from_ego, motion.MOST_TURN_RAD_S)
    if len(turned):
        ego, count = EgoPath(ego.times_s, poses), f"{len(turned)} of {len(poses)} poses were turned back"
        notes.append(f"the vehicle's heading flips by 180 degrees at {ego.times_s[turned[0]]:.3f} s: {count}")
    return ego


def origin_note(map_from_ego: Matrix) -> str:
    """A note that says where the scene's world lies in the data set's."""
    place, turn = ", ".join(f"{value:.3f}" for value in map_from_ego[:3, 3]), f"{yaw_of(map_from_ego):.6f} rad"
    return f"the world's origin is ({place}) m in the data set's world, its x axis turned by {turn}"


def world_from_first(map_from_ego: Matrix) -> Matrix:
    """The world whose origin is the first vehicle pose, its x axis along the first heading, its z axis the map's."""
    return yaw_matrix(-yaw_of(map_from_ego)) @ from_rotation_translation(np.eye(3), -map_from_ego[:3, 3])


def ego_path(stamps_s: Sequence[float], poses: Sequence[Matrix]) -> EgoPath:
    """Vehicle path in time order; of poses at one time (within a microsecond) the first is kept."""
    times = np.asarray(stamps_s, np.float64)
    order = np.argsort(times, kind="stable")
    kept = order[np.r_[True, np.diff(times[order]) > 1e-6]]
    return EgoPath(times[kept], np.stack([poses[i] for i in kept]))


def check_motion(ego: EgoPath, where: str) -> None:
    """Refuse a vehicle that drives impossibly fast, lies on its side or slides: units or orders of values are wrong."""
    upright = float(np.median(ego.world_from_ego[:, 2, 2]))
    if upright < _LEAST_UPRIGHT:
        what, got = "the vehicle does not stand upright", f"its z axis rises by {upright:.2f} per metre"
        remedy = "check the order of quaternions (w, x, y, z) and the axes"
        raise InputError(what, where=where, expected="vehicle and map with z up", got=got, remedy=remedy)
    if len(ego.times_s) < 2:
        return
    # over a twentieth of a second at least: pose noise over less is no speed
    later = np.minimum(np.searchsorted(ego.times_s, ego.times_s + _SPEED_OVER_S), len(ego.times_s) - 1)
    pairs = np.flatnonzero(ego.times_s[later] - ego.times_s >= _SPEED_OVER_S)
    first, last = (pairs, later[pairs]) if len(pairs) else (np.array([0]), np.array([len(ego.times_s) - 1]))
    steps = ego.world_from_ego[last, :3, 3] - ego.world_from_ego[first, :3, 3]
    speed = np.linalg.norm(steps, axis=1) / (ego.times_s[last] - ego.times_s[first])
    at = int(speed.argmax())
    if speed[at] > MAX_SPEED_M_S:
        what = "the vehicle moves impossibly fast"
        got = f"{speed[at]:.0f} m/s, {ego.times_s[first[at]] - ego.times_s[0]:.3f} s after its first pose"
        remedy = "check the units of times and translations, and that all poses are of one log"
        raise InputError(what, where=where, got=got, expected=f"under {MAX_SPEED_M_S:.0f} m/s", remedy=remedy)
    # over a gap it may turn
    drives = (speed > _DRIVES_M_S) & (ego.times_s[last] - ego.times_s[first] <= _COURSE_WITHIN_S)
    if drives.any():
        forward = np.einsum("ni,ni->n", ego.world_from_ego[first[drives], :3, 0], steps[drives])
        along = float(np.median(np.abs(forward) / np.linalg.norm(steps[drives], axis=1)))  # reversing is driving, too
        if along < _LEAST_ALONG:
            what = "the vehicle does not drive where it looks"
            got = f"it moves {np.rad2deg(np.arccos(along)):.0f} degrees off its x axis"
            remedy = "check the order of quaternions (w, x, y, z) and the axes"
            raise InputError(what, where=where, expected="vehicle axes x forward, y left, z up", got=got, remedy=remedy)


def deskew(
    xyz: NDArray[np.float32], dt_s: NDArray[np.float32], world_from_lidar: Callable[[float], Matrix], time_s: float
) -> NDArray[np.float32]:
    """Bring points that were measured while the sensor moved to one moment, ``time_s``: ``xyz`` f32[N, 3] metres, each
    in the sensor's frame at its own time, ``dt_s`` f32[N] later. ``world_from_lidar``: the sensor's pose f64[4, 4] at a
    time; asked at 33 moments, between which points are blended."""
    if len(xyz) == 0 or not dt_s.any():
        return xyz
    low, high = float(dt_s.min()), float(dt_s.max())
    moments = np.linspace(low, max(high, low + 1e-9), _DESKEW_STEPS + 1)
    lidar_from_world = invert(world_from_lidar(time_s))
    corrections = [lidar_from_world @ world_from_lidar(time_s + float(moment)) for moment in moments]
    place = (dt_s.astype(np.float64) - low) / (moments[-1] - low) * _DESKEW_STEPS
    return blend_motion(xyz.astype(np.float64), corrections, place).astype(xyz.dtype)


def blend_motion(
    points: NDArray[np.floating], corrections: Sequence[Matrix], place: NDArray[np.floating]
) -> NDArray[Any]:
    """Move each of the points [N, 3] by what lies between two of many ``corrections`` f64[4, 4], blended linearly, in
    the points' type. ``place``: [N] number of the correction; 2.5 is halfway between the third and the fourth."""
    step = np.clip(place.astype(int), 0, len(corrections) - 2)
    out = np.empty_like(points)
    for index in range(len(corrections) - 1):
        chosen = step == index
        if chosen.any():
            share = (place[chosen] - index)[:, None]
            before, after = (transform_points(corrections[n], points[chosen]) for n in (index, index + 1))
            out[chosen] = before + share * (after - before)
    return out


# --- finding the files of a log -------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class LogFiles:
    """What identifies the log that was chosen from a folder of many: ``files``, and folders that count with everything
    in them; ``entries``: folders too large for that, which count by their own times."""

    files: tuple[Path, ...]
    entries: tuple[Path, ...] = ()


def numbered_files(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Files called by a frame number, in order: ``0000000012.png`` with suffix ``.png``, ``07.pkl.gz`` with
    ``.pkl.gz``; none where there is no folder."""
    files = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        stem, dot, rest = path.name.partition(".")
        if stem.isascii() and stem.isdigit() and dot + rest.lower() in suffixes:
            files[int(stem)] = path
    return dict(sorted(files.items()))


def complete_frames(streams: Mapping[str, Iterable[int]], options: ImportOptions, where: str, title: str) -> list[int]:
    """Frame numbers within ``options.frames`` that every stream (camera or LiDAR -> its numbers) has. Raises
    InputError: a stream lacks frames that others have (unless ``skip_missing``), or nothing is left."""
    numbers = {name: set(found) for name, found in streams.items()}
    everything = set().union(*numbers.values())
    if options.frames is not None:
        everything = {n for n in everything if options.frames[0] <= n < options.frames[1]}
    missing = {name: sorted(everything - found) for name, found in numbers.items() if everything - found}
    gaps = "; ".join(f"{name} lacks {number_ranges(lacks)}" for name, lacks in missing.items())
    if missing and not options.skip_missing:
        what = "images and sweeps do not pair up"
        remedy = "copy the missing files, choose frames with --frames FIRST:END, or add --skip-missing"
        raise InputError(what, where=where, expected="every camera and LiDAR for every frame", got=gaps, remedy=remedy)
    if missing:
        log.warn(f"{title}: left out incomplete frames: {gaps}")
    everything = everything.difference(*missing.values())
    if not everything:
        expected = "numbered images" + (f" in {options.frames[0]}:{options.frames[1]}" if options.frames else "")
        got = ", ".join(f"{name}: {number_ranges(sorted(found))}" for name, found in numbers.items()) or "nothing"
        raise InputError("no frames to import", where=where, expected=expected, got=got)
    return sorted(everything)


def number_ranges(numbers: Sequence[int]) -> str:
    """Increasing frame numbers as text: three or more in a row as first and last, a long list cut short."""
    if not numbers:
        return "none"
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    ranges = [f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs]
    return ", ".join(ranges[:8]) + (f", ... ({len(numbers)} in all)" if len(ranges) > 8 else "")


def first_file(*candidates: Path) -> Path | None:
    """The first of some paths that is a file."""
    return next((path for path in candidates if path.is_file()), None)


def folder_contents(folder: Path) -> str:
    """The first names in a folder, for messages."""
    if not folder.is_dir():
        return "no such folder"
    return ", ".join(sorted(path.name for path in folder.iterdir())[:12]) or "an empty folder"


def the_only(
    found: Mapping[str, Item],
    options: ImportOptions,
    folder: Path,
    kind: str,
    expected: str,
    fits: Callable[[str], bool] | None = None,
) -> Item:
    """The one of ``found`` (name -> log, in the order in which messages list them) that ``options.sequence`` means.
    ``kind``: data set, and what one of its logs is called, as in "PandaSet sequence". ``expected``: what ``folder``
    should hold. ``fits``: whether a name is meant; None = if it is the same. Raises InputError: nothing is found.
    UsageError: several logs, or none fits."""
    if not found:
        raise InputError(f"no {kind} found", where=str(folder), expected=expected, got=folder_contents(folder))
    wanted, names = options.sequence, list(found)
    matching = [name for name in names if not wanted or (fits(name) if fits else name == wanted)]
    if len(matching) == 1:
        return found[matching[0]]
    listed = ", ".join(names[:12]) + (f", ... ({len(names)} in all)" if len(names) > 12 else "")
    kind = kind.rpartition(" ")[2]
    what = f"the folder holds several {kind}s" if matching else f"there is no such {kind}"
    raise UsageError(what, where=str(folder), expected=f"--sequence with one of {listed}", got=wanted or "none chosen")


def chosen_cameras(available: Mapping[str, str], options: ImportOptions, where: str, usual: Sequence[str]) -> list[str]:
    """The data set's names of the cameras to import, in the order of ``available``: the data set's name -> the name in
    the scene, either of which may be asked for. ``usual``: those taken when none is asked for. Raises UsageError: no
    such camera. InputError: none of the usual ones is there."""
    by_scene_name = {ours: theirs for theirs, ours in available.items()}
    listed = ", ".join(o if o == t else f"{o} ({t})" for t, o in available.items()) or "no cameras"
    if not options.cameras:
        chosen = [name for name in available if name in usual]
        if not chosen:
            what = "the log has no camera that can be imported"
            raise InputError(what, where=where, expected=", ".join(usual), got=listed)
        return chosen
    unknown = [name for name in options.cameras if name not in available and name not in by_scene_name]
    if unknown:
        raise UsageError("the log has no such camera", where=where, expected=listed, got=", ".join(unknown))
    wanted = {by_scene_name.get(name, name) for name in options.cameras}
    return [name for name in available if name in wanted]


def refuse_missing_cameras(there: Iterable[str], usual: Iterable[str], options: ImportOptions, where: object) -> None:
    """Refuse a log whose cameras ``there`` lack some of the ``usual`` ones (names in the scene), unless cameras were
    chosen or ``skip_missing`` says otherwise."""
    there, usual = list(there), list(usual)
    absent = [name for name in usual if name not in there]
    if absent and not options.cameras and not options.skip_missing:
        what, got = "cameras are missing in the log", f"no images of {', '.join(absent)}"
        remedy = f"choose those that are there with --cameras {' '.join(there)}, or add --skip-missing"
        raise InputError(what, where=str(where), got=got, expected=f"{len(usual)} cameras", remedy=remedy)


def refuse_options(options: ImportOptions, title: str, *names: str) -> None:
    """Refuse options of other formats: one of ``names`` that differs from its default is a UsageError."""
    default = ImportOptions()
    for name in names:
        if getattr(options, name) != getattr(default, name):
            flag = "--" + name.replace("_", "-")
            raise UsageError(f"{title} logs have no use for {flag}", where=flag, remedy="leave it out")


def refuse_untwist(options: ImportOptions, dataset: str, where: str) -> None:
    """Refuse ``--untwist yes``, ``--poses``, ``--boxes`` for a data set with poses, boxes and compensated sweeps."""
    if options.untwist == "yes":
        what = f"sweeps of {dataset} are already compensated for the vehicle's motion"
        raise UsageError(what, where=where, got="--untwist yes", remedy="leave --untwist out")
    refuse_options(options, dataset, "poses", "boxes")


def path_inside(root: Path, name: Any, where: str) -> Path:
    """A file below ``root`` from a name in a foreign table; absolute names and ``..`` are refused."""
    if (problem := ref_problem(name)) is not None:
        expected = "a relative path inside the log"
        raise InputError(f"file name {problem}", where=where, got=repr(name)[:120], expected=expected)
    return root / name
