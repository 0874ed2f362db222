"""Importer and checker of logs in the neutral layout (docs/custom_format.md), for recordings that no other importer reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import log, store
from mudg.base.errors import InputError, MudgError, UsageError
from mudg.base.types import EgoPath, Frame, Scene, Sweep, SweepPoints, View
from mudg.data.importers.clouds import Cloud, read_cloud
from mudg.data.importers.common import deskew, for_each, moments, pose_near
from mudg.data.importers.custom.schema import INDEX, CustomLog, LogImage, LogLidar, LogSweep, read_log
from mudg.data.importers.images import fit_images
from mudg.data.importers.layout import chosen_cameras, refuse_options
from mudg.data.importers.options import ImportOptions, holdout_split
from mudg.data.scene import Finding, SceneWriter, decode_image
from mudg.data.scene import check as scene_check

MAX_ALIKE = 5
"""Findings with the same words that are listed one by one."""
MAX_DELAY_S = 1.0
Timed = TypeVar("Timed", LogImage, LogSweep)


def looks_like_custom(source: Path) -> bool:
    """Whether ``source`` is a folder with the index of a log in the neutral layout."""
    index = source / INDEX
    if not index.is_file():
        return False
    with index.open("rb") as handle:
        return b'"mudg-log"' in handle.read(4096)


def import_custom(source: Path, out: Path, options: ImportOptions) -> Scene:
    """Import a log in the neutral layout into the scene directory ``out``.

    Raises:
        UsageError: an option that this format does not have, or a camera that the log does not have.
        InputError: something is missing, malformed or contradictory; nothing is left at ``out``.
    """
    refuse_options(options, "neutral-layout", "sequence", "poses", "boxes")
    content = _chosen(read_log(source), options)
    fits = {name: fit_images(c.camera, options, c.lens) for name, c in content.cameras.items()}
    images, sweeps = _numbered(content.images), _numbered(content.sweeps)
    notes = (*content.source.notes, *(fit.note for fit in fits.values() if fit.note))
    for note in notes:
        log.info(f"custom: {note}")

    as_scene(content, _raise)  # records without a pose are refused before anything is read

    def add_image(item: tuple[str, LogImage]) -> None:
        frame_id, image = item
        path = _file(content, image.file.path)
        view = View(fits[image.camera].camera, image_pose(content, image), image.time_s)
        refuse_grey(path)
        writer.add_frame(frame_id, view, fits[image.camera].image(path))

    def add_sweep(item: tuple[str, LogSweep]) -> None:
        sweep_id, sweep = item
        points = read_sweep(content, sweep, options)
        writer.add_sweep(sweep_id, sweep.lidar, sweep.time_s, sweep_pose(content, sweep), points)

    with SceneWriter(out, content.name, replace(content.source, notes=notes)) as writer:
        for fit in fits.values():
            writer.add_camera(fit.camera)
        for_each(images, add_image, workers=options.workers, title="importing images", name=lambda item: item[0])
        for_each(sweeps, add_sweep, workers=options.workers, title="importing sweeps", name=lambda item: item[0])
        for track in content.tracks:
            writer.add_track(track)
        writer.set_ego(content.ego)
        times = {name: [image.time_s for _, image in images if image.camera == name] for name in fits}
        writer.set_split(holdout_split(moments(times), options.test_every))
        return writer.finish()


def _raise(problem: MudgError) -> None:
    raise problem


def _chosen(content: CustomLog, options: ImportOptions) -> CustomLog:
    """The cameras, frames and files asked for. ``frames`` counts images of the first of them in the log's order; the rest goes by time."""
    there = {name: name for name in content.cameras}
    names = chosen_cameras(there, options, str(content.root / INDEX), tuple(there))
    images = [image for image in content.images if image.camera in names]
    sweeps = list(content.sweeps)
    if options.frames is not None:
        clock = [image.time_s for image in images if image.camera == names[0]]
        window = clock[options.frames[0] : options.frames[1]]
        if not window:
            raise UsageError(
                "no frames in this range", where="--frames", expected=f"0:{len(clock)}", got=str(options.frames)
            )
        slack = float(np.median(np.diff(clock))) / 2 if len(clock) > 1 else 0.0
        inside = (window[0] - slack - 1e-9, window[-1] + slack + 1e-9)
        images = [image for image in images if inside[0] <= image.time_s <= inside[1]]
        sweeps = [sweep for sweep in sweeps if inside[0] <= sweep.time_s <= inside[1]]
    if options.skip_missing:
        images, sweeps = _present(content, images, "image"), _present(content, sweeps, "cloud")
        images = [i for i in images if i.world_from_camera is not None or _covered(content.ego, i.time_s)]
        sweeps = [s for s in sweeps if _covered(content.ego, s.time_s)]
    return replace(
        content, cameras={name: content.cameras[name] for name in names}, images=tuple(images), sweeps=tuple(sweeps)
    )


def _present(content: CustomLog, records: list[Timed], what: str) -> list[Timed]:
    found = [record for record in records if (content.root / record.file.path).is_file()]
    if len(found) < len(records):
        log.warn(f"custom: left out {len(records) - len(found)} records whose {what} is missing")
    return found


def _covered(ego: EgoPath, time_s: float) -> bool:
    try:
        pose_near(ego, time_s)
    except InputError:
        return False
    return True


def _numbered(records: Sequence[Timed]) -> list[tuple[str, Timed]]:
    """Records with their ids: sensor and number in time order."""
    counts: Counter[str] = Counter()
    numbered = []
    for record in records:
        sensor = record.camera if isinstance(record, LogImage) else record.lidar
        numbered.append((f"{sensor}/{counts[sensor]:06d}", record))
        counts[sensor] += 1
    return numbered


# --- one record -------------------------------------------------------------------------------------------------------


def _file(content: CustomLog, ref: str) -> Path:
    path = content.root / ref
    if not path.resolve().is_relative_to(content.root.resolve()):
        raise InputError("a link leads out of the log", where=str(path), expected="a file inside the log")
    return path


def image_pose(content: CustomLog, image: LogImage) -> NDArray[np.float64]:
    """World-from-camera f64[4, 4]: the image's own, else by the vehicle's path."""
    if image.world_from_camera is not None:
        return image.world_from_camera
    return pose_near(content.ego, image.time_s) @ content.cameras[image.camera].ego_from_camera


def sweep_pose(content: CustomLog, sweep: LogSweep) -> NDArray[np.float64]:
    """World-from-LiDAR f64[4, 4] at the sweep's time."""
    return pose_near(content.ego, sweep.time_s) @ content.lidars[sweep.lidar].ego_from_lidar


def refuse_grey(path: Path) -> None:
    """Refuse grey images, which ``decode_image`` would take: in a log of colour cameras they are a mistake."""
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            mode = image.mode
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return  # decode_image says better what is wrong
    if mode in ("1", "L", "LA"):
        raise InputError(
            "image is grey", where=str(path), expected="8-bit RGB", got=f"mode {mode}",
            remedy="repeat the channel three times, if grey is meant",
        )  # fmt: skip


def read_sweep(content: CustomLog, sweep: LogSweep, options: ImportOptions) -> SweepPoints:
    """The points of a sweep, motion-compensated to its time.

    Raises:
        InputError: no points, a field that was declared is not there, intensities above the declared largest one, points
            that need their times and have none.
    """
    lidar = content.lidars[sweep.lidar]
    path = _file(content, sweep.file.path)
    cloud = read_cloud(path)
    if len(cloud.xyz) == 0:
        raise InputError(
            "cloud has no points", where=str(path), expected="at least one return",
            remedy="export it again, or take the sweep out of log.json",
        )  # fmt: skip
    dt_s = _delays(cloud, sweep, content, path)
    points = SweepPoints(cloud.xyz.astype(np.float32), _intensity(cloud, lidar, path), dt_s)
    if options.untwist == "no" or (options.untwist == "auto" and lidar.compensated):
        return points
    if not lidar.time_field:
        raise InputError(
            "sweeps are not motion-compensated, and their points have no times", where=f"{content.root / INDEX}: lidars.{lidar.name}",
            expected="time_field and time_unit", remedy="name the field with the time of each point, or add --untwist no",
        )  # fmt: skip

    def world_from_lidar(time_s: float) -> NDArray[np.float64]:
        return pose_near(content.ego, time_s) @ lidar.ego_from_lidar

    return SweepPoints(deskew(points.xyz, points.dt_s, world_from_lidar, sweep.time_s), points.intensity, points.dt_s)


def _intensity(cloud: Cloud, lidar: LogLidar, path: Path) -> NDArray[np.float32]:
    if not lidar.intensity_field:
        return np.zeros(len(cloud.xyz), np.float32)
    values = cloud.fields.get(lidar.intensity_field)
    if values is None:
        raise InputError(
            "cloud has no intensity", where=str(path), expected=f"a field {lidar.intensity_field!r}",
            got=", ".join(cloud.fields) or "coordinates only",
            remedy=f"name the field in log.json: lidars.{lidar.name}.intensity_field; an empty text if there is none",
        )  # fmt: skip
    scaled = np.nan_to_num(values.astype(np.float64) / lidar.intensity_max, nan=0.0)
    if scaled.min() < 0 or scaled.max() > 1 + 1e-6:
        worst = values[np.abs(scaled - 0.5).argmax()]
        raise InputError(
            "intensity is out of range", where=str(path), expected=f"0 to {lidar.intensity_max:g}", got=f"{worst:g}",
            remedy=f"give the largest possible value in log.json: lidars.{lidar.name}.intensity_max (often 255)",
        )  # fmt: skip
    return scaled.clip(0, 1).astype(np.float32)


def _delays(cloud: Cloud, sweep: LogSweep, content: CustomLog, path: Path) -> NDArray[np.float32]:
    """Seconds of each point relative to the sweep's time; 0 where clouds have no times."""
    lidar = content.lidars[sweep.lidar]
    if not lidar.time_field:
        return np.zeros(len(cloud.xyz), np.float32)
    values = cloud.fields.get(lidar.time_field)
    if values is None:
        raise InputError(
            "cloud has no times",
            where=str(path),
            expected=f"a field {lidar.time_field!r}",
            got=", ".join(cloud.fields) or "nothing",
        )
    if (
        lidar.absolute
    ):  # whole numbers are subtracted before they are scaled: nanoseconds of the epoch keep their digits
        values = values.astype(np.int64) if values.dtype.kind == "u" else values
        start = content.start * lidar.times_per_s
        start = start // content.units_per_s if isinstance(start, int) else start / content.units_per_s
        dt_s = (values - np.asarray(start, values.dtype)).astype(np.float64) / lidar.times_per_s - sweep.time_s
    else:
        dt_s = values.astype(np.float64) / lidar.times_per_s
    if not np.isfinite(dt_s).all() or np.abs(dt_s).max() > MAX_DELAY_S:
        raise InputError(
            "times of points are far from their sweep's", where=str(path), expected=f"within {MAX_DELAY_S:g} s",
            got=f"up to {np.abs(dt_s).max():.3g} s", remedy="check time_unit and time_from of the LiDAR in log.json",
        )  # fmt: skip
    return dt_s.astype(np.float32)


# --- checking -----------------------------------------------------------------------------------------------------------


def check_log(source: Path) -> list[Finding]:
    """Everything that is wrong or odd about a log in the neutral layout, worst first; every file is read.

    Problems with the same words are listed five times, the rest counted.
    """
    findings: list[Finding] = []

    def complain(problem: MudgError) -> None:
        findings.append(scene_check.finding_of(problem, str(source)))

    def say(level: scene_check.Level, where: str, words: str) -> None:
        findings.append(Finding(level, where, words))

    try:
        content = read_log(source, complain)
    except MudgError as problem:
        complain(problem)
        return scene_check.worst_first(findings)
    scene, images, sweeps = as_scene(content, complain)
    scene_check.check_records(scene, say)

    def check_image(item: tuple[Frame, LogImage]) -> None:
        frame, image = item
        try:
            path = _file(content, image.file.path)
            refuse_grey(path)
            pixels = decode_image(store.read_bytes(path), str(path), content.cameras[image.camera].camera)
            scene_check.check_image(frame, pixels, say)
        except MudgError as problem:
            complain(problem)

    def check_sweep(item: tuple[Sweep, LogSweep]) -> None:
        try:
            points = read_sweep(content, item[1], ImportOptions())
            scene_check.check_points(scene, item[0], points, say)
        except MudgError as problem:
            complain(problem)

    for_each(list(zip(scene.frames, images, strict=True)), check_image, title="checking images")
    for_each(list(zip(scene.sweeps, sweeps, strict=True)), check_sweep, title="checking sweeps")
    return scene_check.worst_first(_collapsed(findings))


def as_scene(content: CustomLog, complain: Callable[[MudgError], None]) -> tuple[Scene, list[LogImage], list[LogSweep]]:
    """The log as a scene whose references are files of the log: nothing is copied; and the records of its frames and sweeps.

    Records without a pose are complained about and left out. Cameras are as recorded.
    """
    frames: list[tuple[Frame, LogImage]] = []
    for frame_id, image in _numbered(content.images):
        camera = content.cameras[image.camera].camera
        try:
            frames.append((Frame(frame_id, View(camera, image_pose(content, image), image.time_s), image.file), image))
        except InputError as problem:
            complain(_placed(problem, f"image {image.file.path}"))
    sweeps: list[tuple[Sweep, LogSweep]] = []
    for sweep_id, sweep in _numbered(content.sweeps):
        try:
            sweeps.append((Sweep(sweep_id, sweep.lidar, sweep.time_s, sweep_pose(content, sweep), sweep.file), sweep))
        except InputError as problem:
            complain(_placed(problem, f"cloud {sweep.file.path}"))
    times = {name: [f.view.time_s for f, i in frames if i.camera == name] for name in content.cameras}
    split = holdout_split(moments({n: t for n, t in times.items() if t}), ImportOptions().test_every) if frames else {}
    known = {frame.id for frame, _ in frames}
    scene = Scene(
        content.name, str(content.root), {name: c.camera for name, c in content.cameras.items()},
        tuple(frame for frame, _ in frames), tuple(sweep for sweep, _ in sweeps), content.tracks, content.ego,
        {frame_id: part for frame_id, part in split.items() if frame_id in known}, content.source,
    )  # fmt: skip
    return scene, [image for _, image in frames], [sweep for _, sweep in sweeps]


def _placed(problem: InputError, where: str) -> InputError:
    return InputError(
        problem.what, where=where, expected=problem.expected, got=problem.got,
        remedy="are the clocks the same? --skip-missing leaves such records out",
    )  # fmt: skip


def _collapsed(findings: Iterable[Finding]) -> list[Finding]:
    """At most ``MAX_ALIKE`` findings of one kind (the words before the first ``;``), and how many more there are."""
    counts: Counter[tuple[str, str]] = Counter()
    kept = []
    for finding in findings:
        kind = (finding.level, finding.words.split(";")[0])
        counts[kind] += 1
        if counts[kind] <= MAX_ALIKE:
            kept.append(finding)
    more = [
        Finding(level, "and others", f"{words}: {count - MAX_ALIKE} more")  # type: ignore[arg-type]
        for (level, words), count in counts.items()
        if count > MAX_ALIKE
    ]
    return kept + more
