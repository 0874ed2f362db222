"""Importer and checker of logs in the neutral layout (docs/custom_format.md), for recordings that no other importer reads."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import log, store
from mudg.base.errors import InputError, MudgError, UsageError
from mudg.base.types import EgoPath, Frame, Scene, Sweep, SweepPoints, View
from mudg.data.importers.clouds import Cloud, read_cloud
from mudg.data.importers.common import UNITS_PER_SECOND, deskew, has_pose, mended_path, nearest_index, pose_near
from mudg.data.importers.custom.schema import INDEX, CustomLog, LogItem, LogLidar, read_log
from mudg.data.importers.drive_log import SceneContent, SceneImage, SceneSweep, write_scene
from mudg.data.importers.images import fit_images, image_notes
from mudg.data.importers.layout import chosen_cameras, refuse_options
from mudg.data.importers.options import ImportOptions, holdout_split
from mudg.data.scene import Finding, decode_image
from mudg.data.scene import check as scene_check

MAX_ALIKE: Final = 5
"""Findings with the same text that are listed one by one."""
MAX_DELAY_S: Final = 1.0
Numbered = tuple[int, LogItem]
"""A record and its number, counted per sensor in time order."""


def looks_like_custom(source: Path) -> bool:
    """Whether ``source`` is a folder with the index of a log in the neutral layout."""
    index = source / INDEX
    if not index.is_file():
        return False
    with store.open_file(index) as handle:
        return b'"mudg-log"' in handle.read(4096)


def import_custom(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a log in the neutral layout into the scene directory ``out``.

    Raises:
        UsageError: an option that this format does not have, or a camera that the log does not have.
        InputError: something is missing, malformed or contradictory; nothing is left at ``out``.
    """
    refuse_options(options, "neutral-layout", "sequence", "poses", "boxes")
    read, notes = read_log(source), []
    read = replace(read, ego=mended_path(read.ego, options, notes))
    content = _chosen(read, options)
    fits = {name: fit_images(c.camera, options, c.lens) for name, c in content.cameras.items()}
    images, sweeps = _numbered(content.images), _numbered(content.sweeps)
    moments = _moments(content.images)
    as_scene(content, _raise)  # records without a pose are refused before anything is read

    def convert(item: Numbered) -> Iterator[SceneImage | SceneSweep]:
        number, record = item
        if record.kind == "image":
            path = _file(content, record)
            refuse_grey(path)
            pose = pose_of(content.ego, record)
            yield SceneImage(record.sensor, number, record.time_s, pose, path, moment=moments[record])
        else:
            points = read_sweep(content, record, options)
            yield SceneSweep(record.sensor, number, record.time_s, pose_of(content.ego, record), points)

    origin = replace(content.source, notes=(*content.source.notes, *notes, *image_notes(fits)))
    scene = SceneContent(
        content.name, origin, fits, [*images, *sweeps], convert, _id_of, content.ego, lambda: (content.tracks, ())
    )
    return write_scene(scene, out, options)


def _raise(problem: MudgError) -> None:
    raise problem


def _id_of(item: Numbered) -> str:
    return f"{item[1].sensor}/{item[0]:06d}"


def _moments(images: Sequence[LogItem]) -> dict[LogItem, int]:
    """Image -> number of the image of the first camera that is nearest in time."""
    if not images:
        return {}
    clock = np.array([image.time_s for image in images if image.sensor == images[0].sensor])
    numbers = nearest_index(clock, np.array([image.time_s for image in images]))
    return dict(zip(images, numbers.tolist(), strict=True))


def _chosen(content: CustomLog, options: ImportOptions) -> CustomLog:
    """The cameras, frames and files asked for. ``frames`` counts images of the first of them in the log's order; the rest goes by time."""
    there = {name: name for name in content.cameras}
    names = chosen_cameras(there, options, str(content.root / INDEX), tuple(there))
    images = [image for image in content.images if image.sensor in names]
    sweeps = list(content.sweeps)
    if options.frames is not None:
        clock = [image.time_s for image in images if image.sensor == names[0]]
        window = clock[options.frames[0] : options.frames[1]]
        if not window:
            expected, got = f"0:{len(clock)}", str(options.frames)
            raise UsageError("no frames in this range", where="--frames", expected=expected, got=got)
        slack = float(np.median(np.diff(clock))) / 2 if len(clock) > 1 else 0.0
        inside = (window[0] - slack - 1e-9, window[-1] + slack + 1e-9)
        images = [image for image in images if inside[0] <= image.time_s <= inside[1]]
        sweeps = [sweep for sweep in sweeps if inside[0] <= sweep.time_s <= inside[1]]
    if options.skip_missing:
        images, sweeps = _usable(content, images), _usable(content, sweeps)
    cameras = {name: content.cameras[name] for name in names}
    return replace(content, cameras=cameras, images=tuple(images), sweeps=tuple(sweeps))


def _usable(content: CustomLog, records: list[LogItem]) -> list[LogItem]:
    """Records whose file is there and whose pose is known."""
    found = [record for record in records if (content.root / record.file.path).is_file()]
    if len(found) < len(records):
        log.warn(f"custom: left out {len(records) - len(found)} records whose {records[0].kind} is missing")
    placed = [r for r in found if r.world_from_sensor is not None or has_pose(content.ego, r.time_s)]
    if len(placed) < len(found):
        times = [r.time_s for r in found if r not in placed]
        log.warn(
            f"custom: left out {len(times)} records of kind {records[0].kind} without a vehicle pose, from {min(times):.3f} to "
            f"{max(times):.3f} s"
        )
    return placed


def _numbered(records: Sequence[LogItem]) -> list[Numbered]:
    counts: Counter[str] = Counter()
    numbered = []
    for record in records:
        numbered.append((counts[record.sensor], record))
        counts[record.sensor] += 1
    return numbered


# --- one record -------------------------------------------------------------------------------------------------------


def _file(content: CustomLog, record: LogItem) -> Path:
    path = content.root / record.file.path
    if not path.resolve().is_relative_to(content.root.resolve()):
        raise InputError("a link leads out of the log", where=str(path), expected="a file inside the log")
    return path


def pose_of(ego: EgoPath, record: LogItem) -> NDArray[np.float64]:
    """World-from-sensor f64[4, 4] of an image or cloud: its own, else by the vehicle's path."""
    if record.world_from_sensor is not None:
        return record.world_from_sensor
    return pose_near(ego, record.time_s) @ record.ego_from_sensor


def refuse_grey(path: Path) -> None:
    """Refuse grey images, which ``decode_image`` would take: in a log of colour cameras they are a mistake."""
    try:
        with Image.open(io.BytesIO(store.read_bytes(path)), formats=("PNG", "JPEG")) as image:
            mode = image.mode
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return  # decode_image says better what is wrong
    if mode in ("1", "L", "LA"):
        got, remedy = f"mode {mode}", "repeat the channel three times, if grey is meant"
        raise InputError("image is grey", where=str(path), expected="8-bit RGB", got=got, remedy=remedy)


def read_sweep(content: CustomLog, sweep: LogItem, options: ImportOptions) -> SweepPoints:
    """The points of a sweep, motion-compensated to its time.

    Raises:
        InputError: no points, a field that was declared is not there, intensities above the declared largest one, points
            that need their times and have none.
    """
    lidar, path = content.lidars[sweep.sensor], _file(content, sweep)
    cloud = read_cloud(path, known=(lidar.intensity_field, lidar.time_field))
    if len(cloud.xyz) == 0:
        remedy = "export it again, or take the sweep out of log.json"
        raise InputError("cloud has no points", where=str(path), expected="at least one return", remedy=remedy)
    dt_s = _delays(cloud, sweep, content, path)
    intensity = _intensity(cloud, lidar, sweep.sensor, path)
    points = SweepPoints(cloud.xyz.astype(np.float32), intensity, dt_s, no_returns=cloud.missing)
    if options.untwist == "no" or (options.untwist == "auto" and lidar.motion_compensated):
        return points
    if not lidar.time_field:
        raise InputError(
            "sweeps are not motion-compensated, and their points have no times",
            where=f"{content.root / INDEX}: lidars.{sweep.sensor}", expected="time_field and time_unit",
            remedy="name the field with the time of each point, or add --untwist no",
        )  # fmt: skip

    def world_from_lidar(time_s: float) -> NDArray[np.float64]:
        return pose_near(content.ego, time_s) @ sweep.ego_from_sensor

    return replace(points, xyz=deskew(points.xyz, points.dt_s, world_from_lidar, sweep.time_s))


def _field(cloud: Cloud, name: str, what: str, path: Path, remedy: str = "") -> NDArray[Any]:
    """A declared field of a cloud, else InputError."""
    values = cloud.fields.get(name)
    if values is None:
        got = ", ".join(cloud.fields) or "coordinates only"
        raise InputError(f"cloud has no {what}", where=str(path), expected=f"a field {name!r}", got=got, remedy=remedy)
    return values


def _intensity(cloud: Cloud, lidar: LogLidar, name: str, path: Path) -> NDArray[np.float32]:
    if not lidar.intensity_field:
        return np.zeros(len(cloud.xyz), np.float32)
    remedy = f"name the field in log.json: lidars.{name}.intensity_field; an empty text if there is none"
    values = _field(cloud, lidar.intensity_field, "intensity", path, remedy)
    scaled = np.nan_to_num(values.astype(np.float64) / lidar.intensity_max, nan=0.0)
    if scaled.min() < 0 or scaled.max() > 1 + 1e-6:
        expected, got = f"0 to {lidar.intensity_max:g}", f"{values[np.abs(scaled - 0.5).argmax()]:g}"
        remedy = f"give the largest possible value in log.json: lidars.{name}.intensity_max (often 255)"
        raise InputError("intensity is out of range", where=str(path), expected=expected, got=got, remedy=remedy)
    return scaled.clip(0, 1).astype(np.float32)


def _delays(cloud: Cloud, sweep: LogItem, content: CustomLog, path: Path) -> NDArray[np.float32]:
    """Seconds of each point relative to the sweep's time; 0 where clouds have no times."""
    lidar, clock = content.lidars[sweep.sensor], content.clock
    if not lidar.time_field or lidar.time_unit is None:
        return np.zeros(len(cloud.xyz), np.float32)
    values, per_second = _field(cloud, lidar.time_field, "times", path), UNITS_PER_SECOND[lidar.time_unit]
    if lidar.time_from == "log":
        # whole numbers are subtracted before they are scaled: nanoseconds of the epoch keep their digits
        values = values.astype(np.int64) if values.dtype.kind == "u" else values
        start = clock.start * per_second
        start = start // clock.units_per_s if isinstance(start, int) else start / clock.units_per_s
        dt_s = (values - np.asarray(start, values.dtype)).astype(np.float64) / per_second - sweep.time_s
    else:
        dt_s = values.astype(np.float64) / per_second
    if not np.isfinite(dt_s).all() or np.abs(dt_s).max() > MAX_DELAY_S:
        expected, got = f"within {MAX_DELAY_S:g} s", f"up to {np.abs(dt_s).max():.3g} s"
        what, remedy = (
            "times of points are far from their sweep's",
            "check time_unit and time_from of the LiDAR in log.json",
        )
        raise InputError(what, where=str(path), expected=expected, got=got, remedy=remedy)
    return dt_s.astype(np.float32)


# --- checking -----------------------------------------------------------------------------------------------------------


def check_log(source: Path) -> list[Finding]:
    """Everything that is wrong or odd about a log in the neutral layout, worst first; every file is read.

    Problems with the same text are listed five times, the rest counted.
    """
    findings: list[Finding] = []

    def complain(problem: MudgError) -> None:
        findings.append(scene_check.finding_of(problem, str(source)))

    try:
        content = read_log(source, complain)
    except MudgError as problem:
        complain(problem)
        return scene_check.worst_first(findings)
    scene, images, sweeps = as_scene(content, complain)
    findings.extend(scene_check.check_records(scene))

    def check_image(frame: Frame, image: LogItem) -> Iterator[Finding]:
        path = _file(content, image)
        refuse_grey(path)
        pixels = decode_image(store.read_bytes(path), str(path), frame.view.camera)
        yield from scene_check.check_image(frame, pixels)

    def check_sweep(sweep: Sweep, cloud: LogItem) -> Iterator[Finding]:
        points = read_sweep(content, cloud, ImportOptions())
        if points.no_returns:
            rows = points.no_returns + len(points.xyz)
            yield Finding(
                "note", f"sweep {sweep.id}", f"{points.no_returns} of {rows} points mark beams without a return; ingest leaves them out"
            )
        yield from scene_check.check_points(scene, sweep, points)

    with log.task("checking images and sweeps", len(images) + len(sweeps)) as bar:
        checks = [
            *map(check_image, scene.frames, images),
            *map(check_sweep, scene.sweeps, sweeps),
        ]  # nothing is read yet
        for check in checks:
            findings.extend(scene_check.collected(check, str(source)))
            bar.advance()
    return scene_check.worst_first(_collapsed(findings))


def as_scene(content: CustomLog, complain: Callable[[MudgError], None]) -> tuple[Scene, list[LogItem], list[LogItem]]:
    """The log as a scene whose references are files of the log: nothing is copied; and the records of its frames and sweeps.

    Records without a pose are complained about and left out. Cameras are as recorded.
    """
    frames: dict[LogItem, Frame] = {}
    sweeps: dict[LogItem, Sweep] = {}
    for item in (*_numbered(content.images), *_numbered(content.sweeps)):
        record, name = item[1], _id_of(item)
        try:
            pose = pose_of(content.ego, record)
            if record.kind == "image":
                view = View(content.cameras[record.sensor].camera, pose, record.time_s)
                frames[record] = Frame(name, view, record.file)
            else:
                sweeps[record] = Sweep(name, record.sensor, record.time_s, pose, record.file)
        except InputError as problem:
            complain(problem.located(f"{record.kind} {record.file.path}"))
    groups: dict[int, list[str]] = {}
    for record, moment in _moments(list(frames)).items():
        groups.setdefault(moment, []).append(frames[record].id)
    split = holdout_split([groups[moment] for moment in sorted(groups)], ImportOptions().test_every)
    cameras = {name: camera.camera for name, camera in content.cameras.items()}
    scene = Scene(
        content.name, str(content.root), cameras, tuple(frames.values()), tuple(sweeps.values()), content.tracks,
        content.ego, split, content.source,
    )  # fmt: skip
    return scene, list(frames), list(sweeps)


def _collapsed(findings: Iterable[Finding]) -> list[Finding]:
    """At most ``MAX_ALIKE`` findings of one kind (the same text before the first ``;``), and how many more there are."""
    counts: Counter[tuple[scene_check.Level, str]] = Counter()
    kept = []
    for finding in findings:
        kind = (finding.level, finding.message.split(";")[0])
        counts[kind] += 1
        if counts[kind] <= MAX_ALIKE:
            kept.append(finding)
    more = [
        Finding(level, "and others", f"{message}: {count - MAX_ALIKE} more")
        for (level, message), count in counts.items()
        if count > MAX_ALIKE
    ]
    return kept + more
