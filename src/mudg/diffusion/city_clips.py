"""Training clips from generated cities: pure functions of (seed, city number).

One city is a short log of the front camera and, sometimes, the two beside it. Its sweeps are fused as `fuse` does, the
condition is built as `synthesize` does, and the truth comes from the generator at exactly the views of the clip. Most
clips lie beside the recorded path; one per city follows it, with only some of its recorded images given.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from mudg import native
from mudg.base import geometry, seeds
from mudg.base.config import result_settings
from mudg.base.run_folder import RunDir
from mudg.base.types import Clip, Condition, FinePatch, FusedCloud, Photo, Track, View
from mudg.city.config import CityConfig
from mudg.city.sensors import (
    BoxFaults,
    CameraFaults,
    CameraLook,
    LidarFaults,
    LidarScan,
    PoseFaults,
    SensorFaults,
    beam_elevations,
    ego_from_lidar,
    lidar_elevations,
    noisy_tracks,
    recorded,
    thinned,
    with_look,
)
from mudg.city.world import CityTruth, CityWorld
from mudg.core.fusion import FusionRules, SweepShots, fuse_sweeps
from mudg.core.trajectory import ego_left_world
from mudg.diffusion.clips import FAR_M, write_shard
from mudg.diffusion.condition import ConditionRules, DriveInputs, RenderAt, WarpSource, build_conditions
from mudg.diffusion.settings import Realism
from mudg.gaussians import fit
from mudg.gaussians.rendering import render_planes
from mudg.gaussians.schedule import short_fit
from mudg.scene.clouds import write_fused
from mudg.scene.write import PlacedSweep, write_photos

# varied cities ------------------------------------------------------------------------------------
#
# The training distribution that resembles recorded logs: the generator's configuration and the faults of the sensors.
# Most LiDARs see nothing of the upper third of the image.


ASPECTS: Final = (1.5, 4 / 3, 16 / 9, 2.4, 3.4)
"""Width over height of the images; city number n has the n-th, counted round."""
LIDARS: Final = (
    (64, -24.8, 2.0),
    (64, -17.6, 2.4),
    (64, -25.0, 15.0),
    (32, -30.0, 10.0),
    (40, -25.0, 7.0),
    (16, -15.0, 15.0),
    (128, -25.0, 15.0),
    (32, -16.0, 8.0),
)
"""Beams and elevation range, degrees."""
LIDAR_SHARES: Final = (0.3, 0.18, 0.12, 0.12, 0.08, 0.06, 0.06, 0.08)
SIDE_CAMERAS: Final = 0.35
"""Share of the cities with two cameras beside the front one."""
MARGIN_M: Final = 4.2
"""Largest lateral shift of a clip, metres. Nearly half of the cities have less, so that lorries may stand right beside
the camera; their clips are shifted by as much less."""


def sized(width: int, height: int, city: int, multiple: int = 16) -> tuple[int, int]:
    """Size of a city's images: the area of width x height at the city's aspect, in multiples of a number of pixels."""
    aspect = ASPECTS[city % len(ASPECTS)]
    rows = max(1, round(math.sqrt(width * height / aspect) / multiple))
    columns = max(1, round(rows * aspect))
    return columns * multiple, rows * multiple


def draw_city(
    seed: int, city: int, plain: CityConfig, textures: str = "", side_cameras: float = SIDE_CAMERAS
) -> CityConfig:
    """Configuration of a training city: `plain` fixes seed, length and image size; the rest is drawn from (seed, city).
    Four fifths of the cities use `textures`, a folder of photographs."""
    rng = seeds.numpy_rng(seed, city, "varied city")
    beams, lower, upper = LIDARS[int(rng.choice(len(LIDARS), p=LIDAR_SHARES))]
    beside = rng.random() < side_cameras
    return replace(
        plain,
        rate_hz=float(rng.choice([10.0, 10.0, 10.0, 6.0, 12.0])),
        cameras=("front", "front_left", "front_right") if beside else ("front",),
        hfov_deg=float(rng.choice([rng.uniform(42, 55), rng.uniform(50, 85), rng.uniform(80, 108)], p=[0.2, 0.5, 0.3])),
        rig_variation=1.0,
        lidar_beams=beams,
        lidar_lower_deg=float(lower + rng.uniform(-1, 2)),
        lidar_upper_deg=float(upper + rng.uniform(-1.5, 1)),
        lidar_azimuth_step_deg=float(rng.choice([0.18, 0.2, 0.35]) if beams < 128 else 0.35),
        lidar_range_m=float(rng.choice([60.0, 80.0, 120.0])),
        lidar_noise_m=float(rng.uniform(0.01, 0.04)),
        lidar_dropout=float(rng.uniform(0.02, 0.2)),
        traffic=float(rng.uniform(0.3, 1.8)),
        shift_margin_m=MARGIN_M if rng.random() < 0.55 else float(rng.uniform(1.2, 3.2)),
        overhead=float(rng.choice([0.0, rng.uniform(0.25, 1.0)], p=[0.12, 0.88])),
        skies="varied" if rng.random() < 0.85 else "plain",
        textures=textures if rng.random() < 0.8 else "",
    )


def draw_sensors(seed: int, city: int, config: CityConfig) -> SensorFaults:
    """Looks and faults of the sensors of a training city."""
    rng = seeds.numpy_rng(seed, city, "varied sensors")
    common = 2.0 ** rng.uniform(-0.6, 0.9)
    vignette = float(rng.random() < 0.5) * rng.uniform(0.05, 0.5)
    contrast = float(rng.choice([1.0, rng.uniform(0.85, 1.1), rng.uniform(1.1, 1.7)], p=[0.3, 0.25, 0.45]))
    looks, cameras = {}, {}
    faults = _camera_faults(rng, config.width / 384)
    for name in config.cameras:
        white = np.exp(rng.normal(0, 0.06, 3))
        red, green, blue = (float(v) for v in white / white.mean())
        drifts = rng.random() < 0.6
        looks[name] = CameraLook(
            gain=float(common * 2.0 ** rng.normal(0, 0.18)),
            white=(red, green, blue),
            drift_stops=float(drifts * rng.uniform(0, 0.3)),
            drift_white=float(drifts * rng.uniform(0, 0.05)),
            drift_period_s=float(rng.uniform(1.0, 5.0)),
            drift_phase_rad=float(rng.uniform(0, 6.28)),
            vignette=float(vignette),
            contrast=contrast,
        )
        cameras[name] = faults
    second = None
    if rng.random() < 0.2:
        place = (float(rng.uniform(0.5, 2.0)), float(rng.uniform(-0.9, 0.9)), float(rng.uniform(0.8, 2.0)))
        beams = beam_elevations(int(rng.choice([16, 32])), -20.0, float(rng.choice([2.0, 15.0])))
        second = LidarScan(geometry.from_rotation_translation(np.eye(3), place), beams, name=" second")
    lidar, upto = _lidar_faults(rng), lambda most: float(rng.uniform(0, most))
    has = [float(rng.random() < 0.6) for _ in range(2)]
    poses = PoseFaults(has[0] * upto(0.03), has[0] * upto(0.08), has[1] * upto(0.05), has[1] * upto(0.15))
    boxes = BoxFaults() if rng.random() < 0.25 else BoxFaults(upto(0.15), upto(2.0), upto(0.07))
    return SensorFaults(looks, cameras, lidar, poses, boxes, second)


def _camera_faults(rng: np.random.Generator, scale: float) -> CameraFaults:
    """``scale``: blur in pixels grows with the size of the image."""
    chance = lambda share, value: float(value) if rng.random() < share else 0.0
    return CameraFaults(
        noise=float(rng.choice([rng.uniform(0.002, 0.01), rng.uniform(0.01, 0.035)], p=[0.65, 0.35])),
        grain_px=float(rng.uniform(0, 0.9)),
        defocus_px=chance(0.6, rng.uniform(0.2, 1.3) * scale),
        motion_px=chance(0.25, rng.uniform(0.5, 3.0) * scale),
        motion_rad=float(rng.normal(0, 0.3)),
        bloom=chance(0.5, rng.uniform(0.02, 0.25)),
        bloom_px=float(rng.uniform(2, 10) * scale),
        veil=chance(0.25, rng.uniform(0.02, 0.2)),
        jpeg_quality=int(chance(0.6, rng.integers(40, 96))),
        readout_s=chance(0.35, rng.uniform(0.005, 0.035)),
    )


def _lidar_faults(rng: np.random.Generator) -> LidarFaults:
    axis, turn = rng.standard_normal(3), float(rng.random() < 0.65) * rng.uniform(0, 0.5)
    along, shift = rng.standard_normal(3), float(rng.random() < 0.65) * rng.uniform(0, 0.03)
    turns, shifts = axis / np.linalg.norm(axis) * turn, along / np.linalg.norm(along) * shift
    return LidarFaults(
        (float(turns[0]), float(turns[1]), float(turns[2])),
        (float(shifts[0]), float(shifts[1]), float(shifts[2])),
        delay_s=float((rng.random() < 0.4) * rng.uniform(-0.025, 0.025)),
        cut_deg=float(rng.uniform(30, 100)) if rng.random() < 0.2 else 180.0,
        hole_share=float((rng.random() < 0.15) * rng.uniform(0.02, 0.15)),
        dropout=float((rng.random() < 0.3) * rng.uniform(0.05, 0.5)),
    )


# city log -----------------------------------------------------------------------------------------
#
# With faults, the cameras are the reference: the view of a clip is where the camera truly was (moved sideways), and its
# truth is exact. What the condition knows may be wrong. Its views carry the recorded poses, which have errors; an image
# recorded at the time of a view has the same error and so still fits it; points and images of other times, and points
# of a LiDAR that is not where the calibration says, do not. The truth has the look of the camera at that time
# (exposure, white balance, vignetting, contrast) but none of its noise and blur.


@dataclass(frozen=True)
class CityLog:
    """A generated log as its training clips need it: world, fused cloud, recorded images of all frames and cameras.
    ``sweeps``: what was fused. ``boxes``: the annotated tracks (None = the exact ones); ``errors`` f64[frames, 4, 4]:
    recorded pose = true pose @ error."""

    world: CityWorld
    cloud: FusedCloud
    recorded: tuple[Photo, ...]
    sweeps: tuple[SweepShots, ...] = ()
    sensors: SensorFaults = field(default_factory=SensorFaults)
    boxes: tuple[Track, ...] | None = None
    errors: NDArray[np.float64] | None = None

    def tracks(self) -> tuple[Track, ...]:
        """The boxes as annotated."""
        return self.world.tracks() if self.boxes is None else self.boxes

    def truth(self, view: View) -> CityTruth:
        """The truth at a true view, with the look of its camera."""
        found = self.world.render(view)
        look = self.sensors.looks.get(view.camera.name)
        return found if look is None else replace(found, rgb=with_look(found.rgb, look, view.time_s))


def claimed_view(world: CityWorld, errors: NDArray[np.float64] | None, view: View) -> View:
    """A true view of a frame's time with the pose that a log's poses, which have errors, make of it."""
    if errors is None:
        return view
    ego = world.frame_pose(view.time_s)
    error = errors[min(max(round(view.time_s * world.config.rate_hz), 0), len(errors) - 1)]
    return View(view.camera, ego @ error @ geometry.invert(ego) @ view.world_from_cam, view.time_s)


def record_with_faults(config: CityConfig, sensors: SensorFaults, used: Sequence[int], key: int) -> CityLog:
    """Record and fuse a city with faulty sensors; ``used``: the frames that have a sweep. Everything follows from
    ``key``."""
    world = CityWorld(config)
    errors = sensors.poses.errors(config.n_frames, key)
    photos: dict[str, list[Photo]] = {}
    for name in config.cameras:
        faults, look = sensors.cameras.get(name, CameraFaults()), sensors.looks.get(name, CameraLook())
        for index, view in enumerate(world.frame_views(name)):
            truth = world.render_rolling(view, faults.readout_s) if faults.readout_s else world.render(view)
            image = recorded(with_look(truth.rgb, look, view.time_s), faults, seeds.key(key, index, f"image {name}"))
            photo = Photo(claimed_view(world, errors, view), image, truth.semantics)
            photos.setdefault(name, []).append(photo)
    boxes = noisy_tracks(world.tracks(), sensors.boxes, key)
    delay_s, mounting = sensors.lidar.delay_s, sensors.lidar.mounting_error()
    scans = [LidarScan(ego_from_lidar(), lidar_elevations(config), delay_s)]
    if sensors.second_lidar is not None:
        scans.append(replace(sensors.second_lidar, delay_s=delay_s))
    sweeps = []
    for index in used:
        shots = [photos[name][index] for name in config.cameras]
        ego = world.frame_pose(world.frame_time(index))
        wrong = ego @ errors[index] @ geometry.invert(ego)
        for scan in scans:
            sweep = world.lidar_sweep(index, scan)
            points = thinned(sweep.points, sensors.lidar, seeds.key(key, index, f"points{scan.name}"))
            sweeps.append(SweepShots(sweep.time_s, wrong @ sweep.world_from_lidar @ mounting, points, shots))
    sweeps = [s for s in sweeps if len(s.points.xyz)]
    cloud, _ = fuse_sweeps(sweeps, boxes, FusionRules(min_object_points=40))
    images = tuple(p for name in config.cameras for p in photos[name])
    return CityLog(world, cloud, images, tuple(sweeps), sensors, boxes, errors)


# from city ----------------------------------------------------------------------------------------


HELD_OUT = 1_000_000
"""Numbers of cities, and of clips of logs, from here on are for scoring, never for training. Such cities have the
standard rig, all cameras, and shifts of exactly 2, 3 and 4 m, whatever the seed."""
DEVELOPMENT = tuple(range(HELD_OUT, HELD_OUT + 6))
"""Cities for choosing between variants; also what `learn` watches."""
REPORTED = tuple(range(HELD_OUT + 100, HELD_OUT + 106))
"""Cities whose scores are reported and on which nothing is chosen."""
LISTS: dict[str, tuple[int, ...]] = {"development": DEVELOPMENT, "reported": REPORTED}

FRAMES = 12
SIZES = len(ASPECTS)
"""Varied cities n and n + SIZES have clips of one size."""
PATCH_PX = 96
"""Side of the patches at a higher resolution."""
FIRST = 2
"""Clips start at this frame of the log, so that it reaches a little beyond them at both ends."""


@dataclass(frozen=True)
class CityClipRules:
    """Size and number of clips per city; `seed` fixes everything together with the city's number."""

    width: int = 192
    height: int = 128
    window: int = 8
    seed: int = 0
    clips: int = 4
    fine: int = 2
    """Recorded images are this many times larger than the clips; their colours are gathered at that size."""
    published: bool = False
    """The published system's condition: points alone, 0 where nothing was seen; the reference is the image recorded at
    the time of the first view, from where it was recorded."""
    realism: Realism = "plain"
    """varied: training cities and their sensors are drawn from `draw_city`; clips then have the size of
    `size_of`. mixed: so are half of them; the others are plain, of these sizes."""
    log_frames: int = FRAMES
    """Length of the logs at least. In longer ones than `FRAMES` each clip begins at a frame of its own."""
    side_cameras: float | None = None
    """Share of the training cities with two cameras beside the front one (None: 0.4 of plain cities, 0.35 of varied
    ones)."""
    fit_steps: tuple[int, int] = (100, 300)
    """Fewest and most steps of the fit to a training city; cities for scoring have the middle of them."""
    fitted: bool = False
    """Clips have renders of a scene fitted to the recorded images (which the maker of the clips supplies), and a patch
    at a higher resolution; recorded images are 2 to 4 times larger than the clips."""
    textures: str = ""
    """Varied cities: folder of photographic textures and skies, used by most cities (empty = none)."""

    @property
    def frames(self) -> int:
        """Length of the log."""
        return max(FRAMES, self.log_frames, FIRST + self.window)


def is_varied(rules: CityClipRules, city: int) -> bool:
    """Whether a city is drawn from the varied distribution; cities for scoring never are. Of mixed ones, `SIZES`
    neighbours are (one of each size) and the next are not."""
    return city < HELD_OUT and (rules.realism == "varied" or (rules.realism == "mixed" and city // SIZES % 2 == 0))


def size_of(rules: CityClipRules, city: int) -> tuple[int, int]:
    """Width and height of a city's clips. Varied and mixed cities differ in aspect, except for the published system's
    fixed size."""
    if rules.realism != "plain" and city < HELD_OUT and not rules.published:
        return sized(rules.width, rules.height, city)
    return rules.width, rules.height


def fine_of(rules: CityClipRules, city: int) -> int:
    """How many times larger than the clips the recorded images of a city are."""
    if not rules.fitted or city >= HELD_OUT:
        return rules.fine
    return int(seeds.numpy_rng(rules.seed, city, "image size").choice([2, 3, 4], p=[0.55, 0.3, 0.15]))


def sensors_of(rules: CityClipRules, city: int) -> SensorFaults:
    """What the sensors of a city get wrong."""
    return draw_sensors(rules.seed, city, city_config(rules, city)) if is_varied(rules, city) else SensorFaults()


def city_config(rules: CityClipRules, city: int) -> CityConfig:
    """The city's configuration."""
    seed = seeds.key(0 if city >= HELD_OUT else rules.seed, city, "city") & 0x7FFFFFFF
    fine, (width, height) = fine_of(rules, city), size_of(rules, city)
    plain = CityConfig(seed=seed, n_frames=FRAMES, width=width * fine, height=height * fine, light="auto")
    if city >= HELD_OUT:
        return plain
    if is_varied(rules, city):
        share = SIDE_CAMERAS if rules.side_cameras is None else rules.side_cameras
        return draw_city(rules.seed, city, plain, rules.textures, share)
    rng = seeds.numpy_rng(rules.seed, city, "city configuration")
    side_cameras = rng.random() < (0.4 if rules.side_cameras is None else rules.side_cameras)
    return replace(
        plain,
        rate_hz=float(rng.choice([10.0, 10.0, 6.0])),
        cameras=("front", "front_left", "front_right") if side_cameras else ("front",),
        hfov_deg=float(rng.uniform(46, 76)),
        rig_variation=1.0,
        lidar_beams=int(rng.choice([64, 64, 64, 40])),
        lidar_azimuth_step_deg=float(rng.choice([0.2, 0.2, 0.35])),
        lidar_lower_deg=float(rng.uniform(-25, -17)),
        lidar_upper_deg=float(rng.choice([15.0, rng.uniform(2, 15)])),
        lidar_dropout=float(rng.uniform(0.02, 0.12)),
        traffic=float(rng.uniform(0.4, 1.8)),
        shift_margin_m=4.2,
    )


def shifts_of(rules: CityClipRules, city: int) -> tuple[float, ...]:
    """Lateral shift of each clip of a city, metres; 0 = the recorded path. Held-out cities: 2, 3, 4 m, sides
    alternating."""
    if city >= HELD_OUT:
        side = 1.0 if city % 2 == 0 else -1.0
        return (2.0 * side, -3.0 * side, 4.0 * side, 0.0)[: rules.clips]
    rng = seeds.numpy_rng(rules.seed, city, "shifts")
    sides = [1.0, -1.0, *rng.choice([-1.0, 1.0], max(0, rules.clips - 3))]
    shifted = [float(side * rng.uniform(0.5, 4.2)) for side in sides]
    if is_varied(rules, city):  # less where there is less room
        shifted = [shift * city_config(rules, city).shift_margin_m / MARGIN_M for shift in shifted]
    return tuple([*shifted, 0.0][-rules.clips :]) if rules.clips > 1 else (shifted[0],)


def start_of(rules: CityClipRules, city: int, number: int) -> int:
    """First frame of clip `number` of a city: where the log reaches `FIRST` frames beyond the clip at both ends, if it
    is so long."""
    last = rules.frames - FIRST - rules.window
    rng = seeds.numpy_rng(rules.seed, city * 64 + number, "start")
    return FIRST if last <= FIRST else int(rng.integers(FIRST, last + 1))


def make_log(rules: CityClipRules, city: int, frames: int = FRAMES) -> CityLog:
    """Generate, record and fuse one city; `frames` long."""
    config = replace(city_config(rules, city), n_frames=frames)
    rng = seeds.numpy_rng(rules.seed, city, "log")
    if is_varied(rules, city):
        used = range(frames)
        if rng.random() >= 0.6:
            used = np.flatnonzero(rng.random(frames) < rng.uniform(0.3, 0.9)).tolist()
        key = seeds.key(rules.seed, city, "log with faults")
        return record_with_faults(config, sensors_of(rules, city), used or [frames // 2], key)
    world = CityWorld(config)
    photos: dict[str, list[Photo]] = {}
    for name in config.cameras:
        truths = [(view, world.render(view, sensor_noise=True)) for view in world.frame_views(name)]
        photos[name] = [Photo(view, truth.rgb_u8, truth.semantics) for view, truth in truths]
    used: Sequence[int] = range(frames)
    jitter_m, jitter_rad = 0.0, 0.0
    if city < HELD_OUT:
        if rng.random() < 0.35:
            used = sorted(rng.choice(frames, int(rng.integers(4, frames)), replace=False).tolist())
        if rng.random() < 0.4:
            jitter_m, jitter_rad = float(rng.uniform(0, 0.05)), float(np.deg2rad(rng.uniform(0, 0.15)))
    sweeps = []
    for index in used:
        sweep = world.lidar_sweep(index)
        error = geometry.yaw_matrix(float(rng.normal(0, jitter_rad)), rng.normal(0, jitter_m, 3))
        shots = [photos[name][index] for name in config.cameras]
        sweeps.append(SweepShots(sweep.time_s, sweep.world_from_lidar @ error, sweep.points, shots))
    cloud, _ = fuse_sweeps(sweeps, world.tracks(), FusionRules(min_object_points=40))
    return CityLog(world, cloud, tuple(photo for name in config.cameras for photo in photos[name]), tuple(sweeps))


def given_images(
    rules: CityClipRules, city: int, log: CityLog, rng: np.random.Generator | None = None
) -> tuple[Photo, ...]:
    """The recorded images that the clips of a city may know: all, or as in a log whose every fourth moment is held
    out."""
    rng = rng or seeds.numpy_rng(rules.seed, city, "clips")
    if city >= HELD_OUT and rules.fitted:
        times = sorted({photo.view.time_s for photo in log.recorded})
        return tuple(photo for photo in log.recorded if photo.view.time_s not in times[4::4])
    return _split_moments(log.recorded, 4, rng)[1] if city < HELD_OUT and rng.random() < 0.5 else log.recorded


def make_clips(
    rules: CityClipRules, city: int, log: CityLog | None = None, render_at: RenderAt | None = None
) -> list[Clip]:
    """All clips of one city. log: the city's own from `make_log`; made here if not given. render_at: renders of a scene
    that was fitted to `given_images`; with `rules.fitted`."""
    log = log or make_log(rules, city, rules.frames)
    rng = seeds.numpy_rng(rules.seed, city, "clips")
    size, scale = size_of(rules, city), fine_of(rules, city)
    front_views = log.world.frame_views("front")
    conditions = ConditionRules(*size, size[0] * scale, size[1] * scale, published=rules.published)
    tracks = log.tracks()
    clips = []
    sources: dict[int, WarpSource] = {}
    known = given_images(rules, city, log, rng)
    for number, shift_m in enumerate(shifts_of(rules, city)):
        start = start_of(rules, city, number)
        views = [shifted_view(log.world, view, shift_m) for view in front_views[start : start + rules.window]]
        given, cache = known, sources
        if shift_m == 0.0 and not rules.fitted:
            given, cache = _split_moments(log.recorded, int(rng.integers(2, 5)), rng)[0], {}
        given = log.recorded if rules.published else given  # for the reference only
        claimed = [claimed_view(log.world, log.errors, view) for view in views]
        drive = DriveInputs(log.cloud, tracks, given, render_at)
        condition, fine = build_conditions(drive, claimed, conditions, cache)
        truths = [log.truth(view.resized(*size)) for view in views]
        clip = replace(clip_from_truth(condition, truths), shift_m=shift_m)
        if rules.fitted:
            place = seeds.numpy_rng(rules.seed, city * 16 + number, "patch")
            full = clip_from_truth(fine, [log.truth(view) for view in views])
            clip = replace(clip, fine=cut_patch(full, scale, patch_side(size), place))
        clips.append(clip)
    return clips


def _split_moments(
    recorded: Sequence[Photo], gap: int, rng: np.random.Generator
) -> tuple[tuple[Photo, ...], tuple[Photo, ...]]:
    """The images of every ``gap``-th moment, from a random one on, and all others."""
    times = sorted({photo.view.time_s for photo in recorded})
    chosen = set(times[int(rng.integers(gap)) :: gap])
    kept = tuple(photo for photo in recorded if photo.view.time_s in chosen)
    return kept, tuple(photo for photo in recorded if photo.view.time_s not in chosen)


def patch_side(size: tuple[int, int]) -> int:
    """Side of the patches of clips of a size, in pixels of the patch: the same at all scales, so that a step can mix
    them."""
    return min(PATCH_PX, 2 * min(size)) // 12 * 12


def cut_patch(full: Clip, scale: int, side_px: int, rng: np.random.Generator) -> FinePatch:
    """A square of a clip that is `scale` times finer than the one it belongs to, anywhere in it. side_px: its side in
    fine pixels; a multiple of `scale`."""
    height, width = (size // scale for size in full.rgb.shape[-2:])
    side = min(side_px // scale, height, width)
    row, column = int(rng.integers(height - side + 1)), int(rng.integers(width - side + 1))
    rows, columns = (slice(start * scale, (start + side) * scale) for start in (row, column))
    cut = replace(full, fine=None).map(lambda x: x[..., rows, columns].contiguous())
    return FinePatch(replace(cut, condition=full.condition.cropped(rows, columns)), row, column, scale)


def shifted_view(world: CityWorld, view: View, shift_m: float) -> View:
    """The view moved sideways, positive to the left, as `core.trajectory.shifted` does."""
    pose = world.ego_path().pose_at(view.time_s)
    moved = view.world_from_cam.copy()
    if pose is not None:
        moved[:3, 3] += shift_m * ego_left_world(pose)
    return View(view.camera, moved, view.time_s)


def clip_from_truth(condition: Condition, truths: Sequence[CityTruth]) -> Clip:
    """A clip from a condition and the generator's truth at its views; the sky is known to be far away."""
    rgb = torch.stack([torch.from_numpy(np.ascontiguousarray(t.rgb)).permute(2, 0, 1) for t in truths])
    depth = torch.stack([torch.from_numpy(np.ascontiguousarray(t.depth))[None] for t in truths])
    ids = torch.stack([torch.from_numpy(t.semantics.astype(np.int64)) for t in truths])
    sky = ~torch.isfinite(depth)
    return Clip(condition, rgb.float(), torch.where(sky, FAR_M, depth), torch.ones_like(sky), ids)


def write_city(rules: CityClipRules, city: int, folder: Path) -> int:
    """Make one city's clips and write its shard; returns the number of clips. Runs in a process of its own."""
    torch.set_num_threads(1)
    native.set_threads(1)
    log = make_log(rules, city, rules.frames)
    clips = make_clips(rules, city, log, fit_city(rules, city, log) if rules.fitted else None)
    write_shard(folder, city, clips)
    return len(clips)


# fits to cities -----------------------------------------------------------------------------------


def fit_city(rules: CityClipRules, city: int, log: CityLog) -> RenderAt:
    """Fit a scene to the images that the clips of a city may know; returns what it shows at a view."""
    steps = steps_of(rules, city)
    width = size_of(rules, city)[0]
    images = given_images(rules, city, log)
    config = short_fit(steps, width, images[0].view.camera.width, seed=city)
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        world, sweeps = log.world, placed_sweeps(log)
        write_photos(folder / "scene", world.source(), world.ego_path(), log.tracks(), images, sweeps)
        write_fused(folder / "fused", log.cloud, {})
        work = RunDir.open(folder / "fit", fit.OUTPUT, result_settings(config), {})
        fit.write_fit(config, folder / "scene", folder / "fused", work)
        model = fit.load_model(work.path)

    return partial(render_planes, model)


def steps_of(rules: CityClipRules, city: int) -> int:
    """Steps of a city's fit, drawn from `rules.fit_steps`, because renders of logs are of different quality, too."""
    fewest, most = rules.fit_steps
    if city >= HELD_OUT or fewest == most:
        return (fewest + most) // 2
    return int(seeds.numpy_rng(rules.seed, city, "fit").integers(fewest, most))


def placed_sweeps(log: CityLog) -> Iterator[PlacedSweep]:
    """The sweeps of a generated log; a second one at the same time comes from a second sensor."""
    last_s = -math.inf
    for sweep in log.sweeps:
        yield "lidar_second" if sweep.time_s == last_s else "lidar", sweep.time_s, sweep.world_from_lidar, sweep.points
        last_s = sweep.time_s
