"""``mudg fuse``: scene -> one static coloured cloud and one per moving object, by the rules of ``core/fusion.py``.
Images of held-out frames give no colours, so that nothing of what is scored later leaks into the clouds."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import config as configuration
from mudg.base import log, store
from mudg.base.errors import InputError
from mudg.base.geometry import transform_points
from mudg.base.run_folder import RunDir
from mudg.base.types import SAME_COLORS, CameraColors, Frame, FusedCloud, Photo, Scene
from mudg.core.calibration import match_cameras
from mudg.core.fusion import (
    STATIC,
    FusionReport,
    FusionRules,
    SweepShots,
    fuse_sweeps,
    judge_track,
    points_in_image,
    separate,
)
from mudg.scene.check import check_distance
from mudg.scene.clouds import write_fused
from mudg.scene.contact_sheet import draw_top_view
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_points
from mudg.scene.settings import FuseConfig

_TOP_VIEW_PX = (1400, 1000)
MOST_NAMED = 3
"""Objects that are left out are named up to here, then counted."""
MOST_IMAGE_GAP_S = 0.06
"""A sweep's points are coloured only from images within this time."""
MATCHED_SWEEPS, MATCHED_IMAGES, MATCHED_WITHIN_S = 8, 5, 1.0
"""To match the cameras' colours: sweeps, images of each camera per sweep, and how far in time they may be."""


def write_fusion(config: FuseConfig, scene: Scene, work: RunDir) -> dict[str, Any]:
    """Fuse a scene; writes ``static.safetensors``, ``objects/*.safetensors``, ``fuse.json`` and ``top.png``. Returns
    counts."""
    for finding in check_distance(scene):
        log.warn(f"fuse: {finding.message}")
    cloud, report = fuse_scene(scene, config)
    if report.sweeps and not len(cloud.static):
        log.warn("fuse: no static point projects into any image; check calibration and clocks with `mudg doctor`")
    for words in describe(report, cloud.colors):
        log.info(f"fuse: {words}")
    write_fused(work.path, cloud, report_record(report, rules_of(config)))
    store.write_image(work.path / "top.png", top_view(scene, cloud, report))
    return {"points_static": report.points_static, "objects": len(cloud.objects), "points_in": report.points_in}


def refuse_without_lidar(scene: Scene) -> None:
    """InputError for a scene without LiDAR sweeps: there is nothing to fuse, and no method starts without a fused
    cloud."""
    if not scene.sweeps:
        what = "the log has no LiDAR sweeps, which a fused cloud, and what starts from it, need"
        got = f"{len(scene.frames)} images only"
        remedy = "give a log with LiDAR; ingest, annotate, export, and fit with emernerf work without"
        raise InputError(what, where=scene.root, expected="sweeps of at least one LiDAR", got=got, remedy=remedy)


def fuse_scene(scene: Scene, config: FuseConfig) -> tuple[FusedCloud, FusionReport]:
    """The clouds of a scene, and what happened."""
    rules = rules_of(config)
    cameras = camera_colors(scene, rules) if config.match_colors else SAME_COLORS
    return fuse_sweeps(scene_sweeps(scene), scene.tracks, rules, cameras)


def fused_without_boxes(scene: Scene, folder: Path) -> FusedCloud:
    """The cloud of a scene as if it had no tracks, with the settings of the clouds in ``folder``. Clouds of an edited
    run have none of their own; then the usual ones."""
    settings = folder / "run.yaml"
    config = configuration.load(FuseConfig, None, settings if settings.is_file() else None)
    log.info("fusing again, without tracked boxes")
    return fuse_scene(dataclasses.replace(scene, tracks=()), config)[0]


def rules_of(config: FuseConfig) -> FusionRules:
    """The fusion rules that a configuration asks for."""
    names = {field.name for field in dataclasses.fields(FusionRules)}
    return FusionRules(**{name: value for name, value in configuration.to_dict(config).items() if name in names})


def _seen_by(scene: Scene) -> dict[str, list[Frame]]:
    """Frames that may give colours, by the cameras that have some."""
    frames = scene.frames_in("train")
    return {name: own for name in scene.cameras if (own := [f for f in frames if f.view.camera.name == name])}


def scene_sweeps(scene: Scene) -> Iterator[SweepShots]:
    """The sweeps of a scene, one at a time, each with the images that may colour it."""
    by_camera = _seen_by(scene)
    for sweep in log.progress(scene.sweeps, len(scene.sweeps), "fusing sweeps"):
        gap = lambda frame, time_s=sweep.time_s: abs(frame.view.time_s - time_s)
        chosen = [frame for own in by_camera.values() if gap(frame := min(own, key=gap)) <= MOST_IMAGE_GAP_S]
        labels = [read_label(scene, f, "semantics") if "semantics" in f.labels else None for f in chosen]
        shots = [Photo(f.view, read_image(scene, f), ids) for f, ids in zip(chosen, labels, strict=True)]
        yield SweepShots(sweep.time_s, sweep.world_from_lidar, read_points(scene, sweep), shots)


def camera_colors(scene: Scene, rules: FusionRules) -> CameraColors:
    """How the colours of the scene's cameras differ, from static points of some sweeps in images of about the same
    time."""
    by_camera = _seen_by(scene)
    if len(by_camera) < 2 or not scene.sweeps:
        return SAME_COLORS
    dynamic = [track for track in scene.tracks if judge_track(track, rules).moving]
    chosen = np.unique(np.linspace(0, len(scene.sweeps) - 1, MATCHED_SWEEPS).round().astype(int))
    found: list[dict[str, tuple[NDArray[np.intp], NDArray[np.uint8]]]] = []
    for sweep in log.progress([scene.sweeps[i] for i in chosen], len(chosen), "matching colours"):
        points = read_points(scene, sweep)
        shots = SweepShots(sweep.time_s, sweep.world_from_lidar, points, ())
        still = separate(shots, dynamic, rules)[0] == STATIC
        seen: dict[str, tuple[NDArray[np.intp], NDArray[np.uint8]]] = {}
        for name, images in by_camera.items():
            near = sorted(images, key=lambda frame: abs(frame.view.time_s - sweep.time_s))[:MATCHED_IMAGES]
            ids, colors = np.zeros(0, np.intp), np.zeros((0, 3), np.uint8)
            for frame in near:
                if abs(frame.view.time_s - sweep.time_s) > MATCHED_WITHIN_S:
                    continue
                rows, column, row, _ = points_in_image(shots, frame.view, dynamic, rules)
                new = still[rows] & ~np.isin(rows, ids)
                ids = np.concatenate([ids, rows[new]])
                colors = np.concatenate([colors, mean_around(read_image(scene, frame), row[new], column[new])])
            seen[name] = ids, colors
        found.append(seen)
    return match_cameras(by_camera, found)


def mean_around(rgb: NDArray[np.uint8], row: NDArray[np.intp], column: NDArray[np.intp]) -> NDArray[np.uint8]:
    """Mean colours u8[n, 3] of the 5x5 pixels around places of an image: a point that is a pixel off has about its
    colour."""
    height, width = rgb.shape[:2]
    total = np.zeros((len(row), 3), np.uint32)
    for down in range(-2, 3):
        for right in range(-2, 3):
            total += rgb[(row + down).clip(0, height - 1), (column + right).clip(0, width - 1)]
    return ((total + 12) // 25).astype(np.uint8)


def report_record(report: FusionReport, rules: FusionRules) -> dict[str, Any]:
    """The report as JSON values for ``fuse.json``."""
    values = dataclasses.asdict(report)
    verdicts, points, left_out = (values.pop(name) for name in ("verdicts", "object_points", "left_out"))
    more = {name: {"points": points.get(name), "left_out": left_out.get(name)} for name in verdicts}
    tracks = {name: {**verdict, **more[name]} for name, verdict in verdicts.items()}
    return {"counts": values, "rules": dataclasses.asdict(rules), "tracks": tracks}


def describe(report: FusionReport, cameras: CameraColors) -> list[str]:
    """What happened, in sentences."""
    dynamic = [track_id for track_id, verdict in report.verdicts.items() if verdict.moving]
    total = max(report.points_in, 1)
    colored, hidden, unseen = (n / total for n in (report.points_colored, report.points_hidden, report.points_unseen))
    shares = f"{colored:.0%} coloured, {hidden:.1%} occluded, {unseen:.0%} in no image"
    boxes = f"{len(dynamic)} of {len(report.verdicts)} tracked boxes are dynamic"
    lines = [f"{report.sweeps} sweeps, {report.points_in} points: {shares}"]
    lines.append(f"{boxes}; {report.points_static} points in the static cloud")
    shown = list(report.left_out.items())[:MOST_NAMED]
    lines += [f"dynamic object {track_id} left out: {words}" for track_id, words in shown]
    if len(report.left_out) > len(shown):
        lines.append(f"{len(report.left_out) - len(shown)} more dynamic objects left out: fuse.json says why")
    gains = {name: " ".join(f"{gain:.2f}" for gain in found.gain) for name, found in cameras.to_common.items()}
    to = f"brought to those of {cameras.reference}"
    return lines + [f"colours of {name} {to}: gain {gain}" for name, gain in gains.items()]


def top_view(scene: Scene, cloud: FusedCloud, report: FusionReport) -> Image.Image:
    """The clouds from above, dynamic objects at the middle of their tracks."""
    middles = {track.id: track.world_from_object[len(track.times_s) // 2] for track in scene.tracks}
    boxes = {track_id: pose for track_id, pose in middles.items() if report.verdicts[track_id].moving}
    placed = (transform_points(middles[name], one.xyz.astype(np.float64)) for name, one in cloud.objects.items())
    xyz = np.concatenate([cloud.static.xyz.astype(np.float64), *placed])
    rgb = np.concatenate([cloud.static.rgb, *(one.rgb for one in cloud.objects.values())])
    caption = f"{scene.id}: {len(xyz)} points, {len(boxes)} dynamic objects"
    dot_px = 2 if len(xyz) < 400_000 else 1
    return draw_top_view(scene, _TOP_VIEW_PX, xyz, rgb, boxes, caption, dot_px=dot_px, outer_percent=1.0)
