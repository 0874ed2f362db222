"""nuPlan importer: one log (a ``.db`` file) with its sensor blobs, or one scene (up to 20 s) of it.

================================================ ===========================================================================
``<log>.db``                                     SQLite: poses at 100 Hz, calibration, images, clouds, tracked boxes
``sensor_blobs/<log>/CAM_F0`` ...                eight cameras, JPEG, 10 Hz, distorted (k1 k2 p1 p2 k3)
``sensor_blobs/<log>/MergedPointCloud/*.pcd``    points of five LiDARs in one cloud, 20 Hz
================================================ ===========================================================================

``sensor_blobs`` is looked for beside the database and up to four folders above it.

Frames. World: z up, origin and x axis at the vehicle of the first imported cloud (the log's own world lies thousands of
kilometres from its origin). Frame numbers (``--frames``) count the clouds of the log or scene. A moment is an image time of
the cameras; all clouds in between are taken.

Clouds are motion-compensated in the source; ``dt_s`` is 0. Image times are the start of a read-out of about 1/30 s; the
middle row, and with it the pose, belongs 1/60 s later. Boxes come from an offline tracker, at every cloud.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import yaw_matrix
from mudg.base.types import Camera, EgoPath, Scene, Source, SweepPoints, Track
from mudg.data.importers.box_tracks import BoxTracks
from mudg.data.importers.clouds import read_cloud
from mudg.data.importers.common import (
    has_pose,
    mended_path,
    nearest_index,
    origin_note,
    pose_near,
    seconds,
    world_from_first,
)
from mudg.data.importers.drive_log import SceneContent, SceneImage, SceneSweep, write_scene
from mudg.data.importers.images import ImageFit, brown_conrady, fit_images, image_notes
from mudg.data.importers.layout import LogFiles, chosen_cameras, folder_contents, refuse_options, the_only
from mudg.data.importers.nuplan.database import NuplanCamera, NuplanCloud, NuplanLog, open_log
from mudg.data.importers.options import ImportOptions
from mudg.data.scene.returns import near_places

Matrix = NDArray[np.float64]
LICENCE: Final = "CC BY-NC-SA 4.0 with the nuPlan dataset licence (Motional; attribution, non-commercial, share-alike)"
CAMERAS: Final = {
    "CAM_F0": "front", "CAM_L0": "front_left", "CAM_R0": "front_right", "CAM_L1": "side_left", "CAM_R1": "side_right",
    "CAM_L2": "back_left", "CAM_R2": "back_right", "CAM_B0": "back",
}  # fmt: skip
SENSOR: Final = "merged"
LABELS: Final = {
    "vehicle": "vehicle", "bicycle": "bicycle", "pedestrian": "pedestrian", "traffic_cone": "traffic_cone",
    "barrier": "barrier", "czone_sign": "sign", "generic_object": "generic_object",
}  # fmt: skip
IMAGE_DELAY_US: Final = 16_667
"""From an image's time stamp to the middle of its read-out. The data set's schema does not tell; reconstructions of it found this."""
_MARGIN_US: Final = 100_000
_REACH_US: Final = 60_000
_PERIOD_US: Final = 100_000
_SQLITE: Final = b"SQLite format 3\0"


def looks_like_nuplan(source: Path) -> bool:
    """Whether ``source`` is a log database, or a folder that holds some (also as ``splits/*`` or ``nuplan-v1.1/splits/*``)."""
    if source.is_file():
        return _is_database(source)
    return source.is_dir() and any(_is_database(path) for path in _databases(source)[:1])


def _is_database(path: Path) -> bool:
    if path.suffix != ".db":
        return False
    with store.open_file(path) as handle:
        return handle.read(len(_SQLITE)) == _SQLITE


def _databases(folder: Path) -> list[Path]:
    patterns = ("*.db", "splits/*/*.db", "nuplan-v1.1/splits/*/*.db")
    return sorted(path for pattern in patterns for path in folder.glob(pattern))


def import_nuplan(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import one nuPlan log, or one scene of it, into the scene directory ``out``; see the module text.

    Args:
        source: the log's ``.db`` file, or a folder of such files.
        out: destination.
        options: ``sequence`` is the log's name (where ``source`` is a folder), a scene's name, or ``LOG/SCENE``. ``cameras``
            default to all eight. ``poses``, ``boxes`` and ``untwist`` are refused; all others are used.

    Raises:
        UsageError: there are several logs and none was chosen, or an option does not apply.
        InputError: something is missing, malformed or contradictory; nothing is left at ``out``.
    """
    refuse_options(options, "nuPlan", "poses", "boxes", "untwist")
    path, scene = _find(source, options)
    with open_log(path) as opened:
        return write_scene(_content(opened, _plan(opened, scene, options), options), out, options)


def _find(source: Path, options: ImportOptions) -> tuple[Path, str]:
    """The database, and the name of a scene or an empty text."""
    if source.is_file():
        log_name, _, scene = options.sequence.rpartition("/")
        if log_name and log_name != source.stem:
            raise UsageError("the file is another log", where=str(source), expected=source.stem, got=log_name)
        return source, "" if scene == source.stem else scene
    if not source.is_dir():
        raise InputError("nuPlan log does not exist", where=str(source), expected="a .db file or a folder of them")
    databases = {path.stem: path for path in _databases(source)}
    if not databases:
        raise InputError("no nuPlan log found", where=str(source), expected="*.db here or in splits/*",
            got=folder_contents(source))  # fmt: skip
    log_name, _, scene = options.sequence.partition("/")
    if log_name in databases:
        return databases[log_name], scene
    if len(databases) == 1 and not scene:
        return next(iter(databases.values())), log_name
    return databases[the_only([] if log_name else list(databases), list(databases), options, source, "log")], scene


def files_of_nuplan(source: Path, options: ImportOptions) -> LogFiles:
    """The log's database, and which sensor blobs there are."""
    path, _ = _find(source, options)
    blobs = _sensor_blobs(path, path.stem)
    return LogFiles((path,), tuple(sorted((blobs / path.stem).iterdir())) if blobs is not None else ())


def _sensor_blobs(path: Path, name: str) -> Path | None:
    """The folder ``sensor_blobs`` that holds this log, beside the database or up to four folders above it."""
    found = (folder / "sensor_blobs" for folder in path.resolve().parents[:5])
    return next((folder for folder in found if (folder / name).is_dir()), None)


# --- what is imported -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Shot:
    """One image: camera's channel, file, time (us)."""

    channel: str
    file: Path
    time_us: int


@dataclass(frozen=True, slots=True, eq=False)
class _NuplanPlan:
    """Files, times and poses of an import, before anything large is read.

    Args:
        name: the scene's id.
        cameras: channel -> camera, the chosen ones.
        clouds: in order of time.
        moments: images of one moment, in order of time.
        ego_us, world_from_ego: the vehicle over the whole span, in the log's world.
        notes: for the scene's source.
    """

    name: str
    cameras: Mapping[str, NuplanCamera]
    clouds: Sequence[NuplanCloud]
    moments: Sequence[Sequence[_Shot]]
    ego_us: NDArray[np.int64]
    world_from_ego: Matrix
    notes: Sequence[str]


def _plan(opened: NuplanLog, scene: str, options: ImportOptions) -> _NuplanPlan:
    name, where = opened.name(), str(opened.path)
    blobs = _sensor_blobs(opened.path, name)
    if blobs is None:
        raise InputError("sensor blobs of the log were not found", where=where,
            expected=f"sensor_blobs/{name} beside the database or up to four folders above it",
            remedy="download the camera and LiDAR blobs of this log; the database alone holds no images")  # fmt: skip
    if scene and scene not in opened.scenes():
        raise UsageError("the log has no such scene", where=where, got=scene,
            expected=", ".join(opened.scenes()[:12]) or "no scenes")  # fmt: skip
    every = list(opened.clouds(scene))
    first, end = options.frames or (0, len(every))
    chosen = every[first:end]
    if not chosen:
        raise InputError("no clouds to import", where=where, expected=f"frames 0 to {len(every)}", got=f"{first}:{end}")
    seconds(np.array([time_us for _, time_us in chosen]), "us", f"{where}: lidar_pc.timestamp", chosen[0][1])
    notes = [f"clouds {first} to {first + len(chosen) - 1} of {scene or 'the log'}"]
    lidars = opened.lidars()
    placed = {token: opened.cloud(token, lidars, blobs) for token, _ in chosen}
    clouds = [cloud for cloud in placed.values() if cloud is not None]
    if len(clouds) < len(placed):
        without = [token.hex() for token, cloud in placed.items() if cloud is None]
        if not options.skip_missing:
            raise InputError("point cloud has no vehicle pose", where=f"{where}: lidar_pc {without[0]}.ego_pose_token",
                expected="a token of ego_pose", got=f"{len(without)} of {len(placed)} clouds have none",
                remedy="choose frames with --frames FIRST:END, or add --skip-missing")  # fmt: skip
        notes.append(f"{len(without)} clouds without a vehicle pose were left out")
    lacking = [cloud.file for cloud in clouds if not cloud.file.is_file()]
    if lacking:
        _refuse_missing("point cloud", lacking, len(clouds), options)
        clouds = [cloud for cloud in clouds if cloud.file.is_file()]
        notes.append(f"{len(lacking)} clouds whose files are missing were left out")
    by_token = opened.cameras()
    folders = {camera.channel for camera in by_token.values() if (blobs / name / camera.channel).is_dir()}
    available = {channel: ours for channel, ours in CAMERAS.items() if channel in folders}
    names = chosen_cameras(available, options, f"{where}: camera", tuple(CAMERAS))
    cameras = {camera.channel: camera for camera in by_token.values()}
    span = (chosen[0][1] - _REACH_US, chosen[-1][1] + _REACH_US)
    shots = [
        _Shot(by_token[token].channel, file, time_us)
        for token, file, time_us in opened.images(*span, blobs)
        if token in by_token and by_token[token].channel in names
    ]
    moments, moment_notes = _moments(shots, names, options, where)
    ego_us, poses = opened.ego_poses(span[0] - _MARGIN_US, span[1] + _MARGIN_US)
    return _NuplanPlan(
        f"{name}_{scene}" if scene else name, {channel: cameras[channel] for channel in names}, clouds, moments,
        ego_us, poses, (*notes, *moment_notes),
    )  # fmt: skip


def _refuse_missing(what: str, missing: Sequence[Path], total: int, options: ImportOptions) -> None:
    """Refuse a log of which files are missing, unless that is allowed."""
    if missing and not options.skip_missing:
        raise InputError(f"file of a {what} is missing", where=str(missing[0]),
            got=f"{len(missing)} of {total} are missing", remedy="download the log's sensor blobs, "
            "choose frames with --frames FIRST:END, or add --skip-missing")  # fmt: skip


def _moments(
    shots: Sequence[_Shot], names: Sequence[str], options: ImportOptions, where: str
) -> tuple[list[list[_Shot]], list[str]]:
    """The images of each moment at which all cameras fired, and notes; see ``_by_moment``."""
    groups = _by_moment(shots, names, where)
    missing = [shot.file for group in groups for shot in group if not shot.file.is_file()]
    _refuse_missing("camera image", missing, len(shots), options)
    complete = [{shot.channel for shot in group} == set(names) for group in groups]
    kept = [g for g, full in zip(groups, complete, strict=True) if full and all(s.file.is_file() for s in g)]
    inner = [group for group, full in zip(groups[1:-1], complete[1:-1], strict=True) if not full]
    if inner and not options.skip_missing:
        absent = sorted(set(names) - {shot.channel for shot in inner[0]})
        raise InputError("a moment lacks images of some cameras", where=f"{where}: image at {inner[0][0].time_us}",
            got=f"no {', '.join(absent)}; {len(inner)} such moments", expected="every chosen camera",
            remedy="choose cameras with --cameras, or add --skip-missing")  # fmt: skip
    if not kept:
        raise InputError("no moment has images of all cameras", where=where, got=f"{len(shots)} images",
            expected=", ".join(names), remedy="choose cameras with --cameras, or other frames with --frames")  # fmt: skip
    cut = len(groups) - len(kept)
    return kept, [f"{cut} moments without images of all cameras were left out"] if cut else []


def _by_moment(shots: Sequence[_Shot], names: Sequence[str], where: str) -> list[list[_Shot]]:
    """Images put together by time, in order of time.

    Cameras fire one after another, each at its own part of the period. So an image belongs to the nearest image of the camera
    that has most of them, after its own camera's median delay is taken off. What lies half a period from all is alone.
    """
    by_camera = {name: [shot for shot in shots if shot.channel == name] for name in names}
    for name, found in by_camera.items():
        for shot, following in itertools.pairwise(found):
            if shot.time_us == following.time_us:
                raise InputError("two images of one camera have the same time", where=f"{where}: image at {shot.time_us}",
                    expected="a row for every image", got=f"{name}: {shot.file.name} and {following.file.name}",
                    remedy="are rows of the table doubled? copy the file again")  # fmt: skip
    leading = max(by_camera.values(), key=len)
    if not leading:
        return []
    beats = np.array([shot.time_us for shot in leading])
    half_us = float(np.median(np.diff(beats))) / 2 if len(beats) > 1 else _PERIOD_US / 2
    groups: dict[int, list[_Shot]] = {index: [] for index in range(len(beats))}
    alone = []
    for found in by_camera.values():
        times = np.array([shot.time_us for shot in found], np.int64)
        late = times - beats[nearest_index(beats, times)]
        usual = float(np.median(late[np.abs(late) <= half_us])) if (np.abs(late) <= half_us).any() else 0.0
        for shot, index in zip(found, nearest_index(beats, times - usual), strict=True):
            taken = any(other.channel == shot.channel for other in groups[int(index)])
            if taken or abs(shot.time_us - usual - beats[index]) >= half_us:
                alone.append([shot])
            else:
                groups[int(index)].append(shot)
    return sorted([*groups.values(), *alone], key=lambda group: min(shot.time_us for shot in group))


# --- writing ----------------------------------------------------------------------------------------------------------


def _content(opened: NuplanLog, plan: _NuplanPlan, options: ImportOptions) -> SceneContent[Any]:
    start_us = plan.clouds[0].time_us if plan.clouds else plan.moments[0][0].time_us
    found: list[str] = []
    ego = mended_path(_ego_path(plan, start_us, str(opened.path)), options, found)
    first = ego.pose_at(0.0)
    if first is None:
        raise InputError("vehicle poses do not cover the log", where=f"{opened.path}: ego_pose",
            expected=f"a pose at {start_us} us", got=f"{len(plan.ego_us)} poses near it",
            remedy="are pose and cloud times both in microseconds?")  # fmt: skip
    world_from_source = world_from_first(first)
    ego = EgoPath(ego.times_s, world_from_source @ ego.world_from_ego)
    fits = {CAMERAS[channel]: _fit(camera, options) for channel, camera in plan.cameras.items()}
    tracks, track_notes = _read_tracks(opened, plan, start_us, world_from_source)
    notes = [*plan.notes, *found, *image_notes(fits), origin_note(first)]
    notes.append(f"image poses {IMAGE_DELAY_US / 1e6:.4f} s after the time stamps: the middle of the read-out")

    def taken_s(shot: _Shot) -> float:
        return (shot.time_us + IMAGE_DELAY_US - start_us) / 1e6

    def convert(item: tuple[int, NuplanCloud | Sequence[_Shot]]) -> Iterable[SceneImage | SceneSweep]:
        index, what = item
        if isinstance(what, NuplanCloud):
            time_s, path = (what.time_us - start_us) / 1e6, what.file
            yield SceneSweep(
                SENSOR, index, time_s, world_from_source @ what.world_from_lidar, _read_points(path, what.places), str(path)
            )
            return
        for shot in what:
            time_s = taken_s(shot)
            world_from_cam = pose_near(ego, time_s, where=str(shot.file)) @ plan.cameras[shot.channel].ego_from_cam
            yield SceneImage(CAMERAS[shot.channel], index, time_s, world_from_cam, shot.file, str(shot.file))

    moments = list(enumerate(plan.moments))
    if options.skip_missing:
        moments = [one for one in moments if all(has_pose(ego, taken_s(shot)) for shot in one[1])]
        if len(moments) < len(plan.moments):
            notes.append(f"{len(plan.moments) - len(moments)} moments without a vehicle pose were left out")
    items = [*enumerate(plan.clouds), *moments]
    source = Source("nuplan", LICENCE, None, (*notes, *track_notes))
    return SceneContent(plan.name, source, fits, items, convert, _item_name, ego, tracks=lambda: (tracks, ()))


def _item_name(item: tuple[int, NuplanCloud | Sequence[_Shot]]) -> str:
    return f"cloud {item[0]}" if isinstance(item[1], NuplanCloud) else f"moment {item[0]}"


def _read_tracks(
    opened: NuplanLog, plan: _NuplanPlan, start_us: int, world_from_source: Matrix
) -> tuple[list[Track], list[str]]:
    """Tracks in the scene's world and clock from the boxes of the plan's clouds, and notes."""
    tracks = BoxTracks(f"{opened.path}: lidar_box", LABELS)
    time_of = {cloud.token: (cloud.time_us - start_us) / 1e6 for cloud in plan.clouds}
    span = (plan.clouds[0].time_us, plan.clouds[-1].time_us) if plan.clouds else (0, -1)
    for token, track, label, (x, y, z, yaw, length, width, height) in opened.boxes(*span):
        if token in time_of:
            pose = world_from_source @ yaw_matrix(yaw, (x, y, z))
            tracks.add(track, tracks.label_of(label), time_of[token], (length, width, height), pose)
    return tracks.tracks()


def _ego_path(plan: _NuplanPlan, start_us: int, where: str) -> EgoPath:
    """The vehicle in the log's world and the scene's clock."""
    if not len(plan.ego_us):
        raise InputError("no vehicle poses at the time of the clouds", where=f"{where}: ego_pose.timestamp",
            expected="microseconds, as lidar_pc.timestamp", remedy="are the two in different units?")  # fmt: skip
    return EgoPath(seconds(plan.ego_us, "us", f"{where}: ego_pose.timestamp", start_us), plan.world_from_ego)


def _fit(camera: NuplanCamera, options: ImportOptions) -> ImageFit:
    fx, fy, cx, cy = camera.intrinsics
    lens = brown_conrady(*camera.distortion) if any(camera.distortion) else None
    # the calibration counts pixels from the centre of the top-left one, as OpenCV does
    recorded = Camera(CAMERAS[camera.channel], *camera.size, fx, fy, cx + 0.5, cy + 0.5, camera.distortion)
    return fit_images(recorded, options, lens)


def _read_points(path: Path, places: Sequence[Matrix]) -> SweepPoints:
    """A merged cloud; zeros of the LiDARs that were merged lie at their ``places``, f64[3] each."""
    cloud = read_cloud(path)
    intensity = cloud.fields.get("intensity", np.zeros(len(cloud.xyz)))
    returns = ~near_places(cloud.xyz, places)
    xyz, grey = cloud.xyz[returns].astype(np.float32), np.clip(intensity[returns].astype(np.float64) / 255, 0, 1)
    no_returns = cloud.missing + int((~returns).sum())
    return SweepPoints(xyz, grey.astype(np.float32), np.zeros(len(xyz), np.float32), no_returns=no_returns)
