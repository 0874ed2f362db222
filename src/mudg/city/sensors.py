"""The vehicle's sensors, and what real ones add to a recorded log. The look of a camera (exposure, white balance,
vignetting, contrast) is in recorded images and in their truth (`with_look`); faults (noise, blur, compression, errors
of poses, clocks and boxes) only in what is recorded. Random parts take a key from `base.seeds`."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from mudg.base import geometry, seeds
from mudg.base.types import Camera, SweepPoints, Track
from mudg.city.config import CityConfig
from mudg.core.weather.light import srgb_decode, srgb_encode

# three cameras and a spinning LiDAR on the roof ---------------------------------------------------


def cameras(config: CityConfig) -> dict[str, Camera]:
    """All three cameras, whether recorded or not."""
    rng = seeds.numpy_rng(config.seed, 0, "city rig")
    hfov = config.hfov_deg + config.rig_variation * rng.uniform(-12, 18)
    focal = config.width / 2 / math.tan(math.radians(min(hfov, 120.0)) / 2)
    names = ("front", "front_left", "front_right")
    return {n: Camera(n, config.width, config.height, focal, focal, config.width / 2, config.height / 2) for n in names}


def ego_from_camera(config: CityConfig) -> dict[str, NDArray[np.float64]]:
    """Mounting poses f64[4, 4]; the ego frame lies on the ground below the vehicle."""
    rng = seeds.numpy_rng(config.seed, 1, "city rig")
    height = 1.6 + config.rig_variation * rng.uniform(-0.25, 0.45)
    pitch = math.radians(0.5 + config.rig_variation * rng.uniform(-2.0, 3.0))
    # camera axes in a body frame that looks along x: right = -y, down = -z, forward = x
    body_from_camera = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    poses = {}
    for name, yaw_deg, x, y in (
        ("front", 0.0, 1.4, 0.0),
        ("front_left", 50.0, 1.25, 0.35),
        ("front_right", -50.0, 1.25, -0.35),
    ):
        pose = geometry.yaw_matrix(math.radians(yaw_deg), (x, y, height))
        pose[:3, :3] = pose[:3, :3] @ pitch_rotation(pitch) @ body_from_camera
        poses[name] = pose
    return poses


def pitch_rotation(angle_rad: float) -> NDArray[np.float64]:
    """Rotation f64[3, 3] about y; a positive angle looks down."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def ego_from_lidar() -> NDArray[np.float64]:
    """The LiDAR sits on the roof, its x axis forward."""
    return geometry.from_rotation_translation(np.eye(3), (0.9, 0.0, 1.95))


@dataclass(frozen=True, slots=True, eq=False)
class LidarScan:
    """How one sweep is taken, other than by the configuration's own LiDAR: mounting pose f64[4, 4], elevation of every
    beam. ``delay_s``: it is taken this much later than the frame's time; its points are given as if it were not.
    ``name``: tells the random numbers of several LiDARs apart."""

    ego_from_lidar: NDArray[np.float64]
    elevations_rad: NDArray[np.float64]
    delay_s: float = 0.0
    name: str = ""


def lidar_elevations(config: CityConfig) -> NDArray[np.float64]:
    """Elevation of every beam in radians, denser around the horizon as in common 64-beam sensors."""
    return beam_elevations(config.lidar_beams, config.lidar_lower_deg, config.lidar_upper_deg)


def beam_elevations(beams: int, lower_deg: float, upper_deg: float) -> NDArray[np.float64]:
    """Elevations f64[beams] in radians from the lowest to the highest beam, denser in the middle."""
    u = np.linspace(-1.0, 1.0, beams)
    middle = 0.5 * (lower_deg + upper_deg)
    half = 0.5 * (upper_deg - lower_deg)
    return np.deg2rad(middle + half * (0.75 * u + 0.25 * u**3))


def lidar_azimuths(config: CityConfig) -> NDArray[np.float64]:
    """Azimuth of every column in radians, in firing order: clockwise, backwards to backwards, forwards at half time."""
    columns = max(4, round(360.0 / config.lidar_azimuth_step_deg))
    return np.pi - (np.arange(columns) + 0.5) * (2 * np.pi / columns)


# looks and faults ---------------------------------------------------------------------------------

Array = NDArray[np.float64]
Rgb = NDArray[np.float32]
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class CameraLook:
    """Exposure, white balance, vignetting (on linear light) and contrast of one camera. The default changes nothing.
    ``gain``, ``white``: factors of all channels, and of red, green and blue. ``drift_stops``, ``drift_white``:
    amplitudes of slow changes of exposure, in powers of two, and of the red/blue balance, a share. ``vignette``: share
    of the light lost in the corners. ``contrast``: slope of display values about the middle."""

    gain: float = 1.0
    white: Triple = (1.0, 1.0, 1.0)
    drift_stops: float = 0.0
    drift_white: float = 0.0
    drift_period_s: float = 4.0
    drift_phase_rad: float = 0.0
    vignette: float = 0.0
    contrast: float = 1.0

    def gains(self, time_s: float) -> Array:
        """Factors f64[3] of red, green and blue at a time."""
        wave = math.sin(2 * math.pi * time_s / self.drift_period_s + self.drift_phase_rad)
        slow = math.cos(math.pi * time_s / self.drift_period_s + self.drift_phase_rad)
        balance = np.array([1 + self.drift_white * slow, 1.0, 1 - self.drift_white * slow])
        return self.gain * 2.0 ** (self.drift_stops * wave) * np.array(self.white) * balance


@dataclass(frozen=True)
class CameraFaults:
    """What a recorded image has beyond its look. Sizes are pixels of that image; the default changes nothing.
    ``noise``: standard deviation in the dark, display values; ``grain_px``: how far it hangs together (sigma).
    ``defocus_px``: blur of the lens (sigma). ``motion_px``, ``motion_rad``: length and direction of that from motion.
    ``bloom``, ``bloom_px``: share of the light of very bright areas that spreads, and how far (sigma). ``veil``: share
    of the mean light that lies over everything. ``jpeg_quality``: 1 to 95; 0 = not compressed. ``readout_s``: time from
    the first to the last row; the middle row is taken at the image's time."""

    noise: float = 0.0
    grain_px: float = 0.0
    defocus_px: float = 0.0
    motion_px: float = 0.0
    motion_rad: float = 0.0
    bloom: float = 0.0
    bloom_px: float = 8.0
    veil: float = 0.0
    jpeg_quality: int = 0
    readout_s: float = 0.0


@dataclass(frozen=True)
class LidarFaults:
    """Errors of a LiDAR against the cameras, and what it does not return. The default changes nothing. ``turn_deg``,
    ``shift_m``: between the assumed and the true mounting, in x, y and z of the sensor. ``delay_s``: the sweep was
    taken this much later than its time says. ``cut_deg``: only azimuths within this angle of straight ahead are
    returned. ``hole_share``: share of the azimuths lost in each sweep, in one piece. ``dropout``: of the points, at
    random."""

    turn_deg: Triple = (0.0, 0.0, 0.0)
    shift_m: Triple = (0.0, 0.0, 0.0)
    delay_s: float = 0.0
    cut_deg: float = 180.0
    hole_share: float = 0.0
    dropout: float = 0.0

    def mounting_error(self) -> Array:
        """assumed_from_true f64[4, 4] in the sensor's frame: where the log puts a point that was measured."""
        return _small_motion(np.array(self.turn_deg), np.array(self.shift_m))


@dataclass(frozen=True)
class PoseFaults:
    """Errors of the recorded poses of the vehicle: independent from frame to frame (jitter) and growing to the stated
    amount over a log (drift). Standard deviations per axis, metres and degrees."""

    jitter_m: float = 0.0
    jitter_deg: float = 0.0
    drift_m: float = 0.0
    drift_deg: float = 0.0

    def errors(self, count: int, key: int) -> Array:
        """Errors f64[count, 4, 4] of the vehicle's pose at each frame, in its own frame: recorded pose = true pose @
        error. The drift starts at none and grows evenly to the stated amount at the last frame."""
        rng = seeds.numpy_rng(key, 0, "pose errors")
        jitter, drift = rng.standard_normal((count, 6)), rng.standard_normal(6)
        grown = np.linspace(0, 1, count)[:, None]
        meters = self.jitter_m * jitter[:, :3] + self.drift_m * drift[:3] * grown
        degrees = self.jitter_deg * jitter[:, 3:] + self.drift_deg * drift[3:] * grown
        return np.stack([_small_motion(turn, shift) for turn, shift in zip(degrees, meters, strict=True)])


@dataclass(frozen=True)
class BoxFaults:
    """Errors of annotated boxes, standard deviations: one offset per box, half as much again from frame to frame.
    ``position_m``: along and across the box; a third of it vertically. ``size_share``: of length, width and height."""

    position_m: float = 0.0
    yaw_deg: float = 0.0
    size_share: float = 0.0


@dataclass(frozen=True)
class SensorFaults:
    """Everything that a log's sensors get wrong. The default changes nothing."""

    looks: dict[str, CameraLook] = field(default_factory=dict)
    cameras: dict[str, CameraFaults] = field(default_factory=dict)
    lidar: LidarFaults = field(default_factory=LidarFaults)
    poses: PoseFaults = field(default_factory=PoseFaults)
    boxes: BoxFaults = field(default_factory=BoxFaults)
    second_lidar: LidarScan | None = None


# --- images ---------------------------------------------------------------------------------------


def with_look(rgb: Rgb, look: CameraLook, time_s: float) -> Rgb:
    """Display values f32[H, W, 3] in [0, 1] as a camera with this look shows them."""
    factors = np.broadcast_to(look.gains(time_s).astype(np.float32), rgb.shape)
    if look.vignette:
        height, width = rgb.shape[:2]
        y, x = np.mgrid[0:height, 0:width].astype(np.float32) + 0.5
        r2 = ((2 * x / width - 1) ** 2 * width**2 + (2 * y / height - 1) ** 2 * height**2) / (width**2 + height**2)
        factors = factors * (1 - look.vignette * r2)[..., None].astype(np.float32)
    shown = srgb_encode(srgb_decode(rgb) * factors)
    return shown if look.contrast == 1 else np.clip(0.5 + (shown - 0.5) * look.contrast, 0, 1).astype(np.float32)


def recorded(rgb: Rgb, faults: CameraFaults, key: int) -> NDArray[np.uint8]:
    """A recorded image u8[H, W, 3]: bloom and blur in linear light, then noise and compression of display values."""
    light = srgb_decode(rgb)
    blurred = lambda values, sigma: ndimage.gaussian_filter(values, (sigma, sigma, 0))
    if faults.bloom or faults.veil:
        bright = np.clip(light.max(-1, keepdims=True) - 0.75, 0, None) * 4 * light
        light = (
            light + faults.bloom * blurred(bright, faults.bloom_px) + faults.veil * (light.mean((0, 1)) - 0.5 * light)
        )
    if faults.defocus_px > 0.05:
        light = blurred(light, faults.defocus_px)
    if faults.motion_px > 0.3:
        steps = max(2, math.ceil(faults.motion_px) + 1)
        along = np.linspace(-0.5, 0.5, steps) * faults.motion_px
        moves = [(a * math.sin(faults.motion_rad), a * math.cos(faults.motion_rad), 0) for a in along]
        light = np.mean([ndimage.shift(light, move, order=1, mode="nearest") for move in moves], 0)
    out = srgb_encode(light)
    if faults.noise:
        rng = seeds.numpy_rng(key, 0, "image noise")
        grain = rng.standard_normal(out.shape).astype(np.float32)
        if faults.grain_px > 0.2:
            grain = blurred(grain, faults.grain_px)
            grain /= max(float(grain.std()), 1e-6)
        out = out + faults.noise * (0.6 + 0.8 * np.sqrt(np.clip(out, 0, 1))) * grain
    image = (np.clip(out, 0, 1) * 255 + 0.5).astype(np.uint8)
    if faults.jpeg_quality:
        stream = io.BytesIO()
        Image.fromarray(image).save(stream, "JPEG", quality=faults.jpeg_quality)
        image = np.asarray(Image.open(io.BytesIO(stream.getvalue())).convert("RGB"))
    return image


# --- LiDAR, poses, boxes --------------------------------------------------------------------------


def thinned(points: SweepPoints, faults: LidarFaults, key: int) -> SweepPoints:
    """The points of a sweep that come back; in the frame of the sensor, x forward."""
    rng = seeds.numpy_rng(key, 0, "lost points")
    azimuth = np.degrees(np.arctan2(points.xyz[:, 1], points.xyz[:, 0]))
    keep = np.abs(azimuth) <= faults.cut_deg
    if faults.hole_share:
        start, span = rng.uniform(-180, 180), 360 * faults.hole_share
        keep &= (azimuth - start) % 360 >= span
    if faults.dropout:
        keep &= rng.random(len(azimuth)) >= faults.dropout
    return SweepPoints(points.xyz[keep], points.intensity[keep], points.dt_s[keep])


def noisy_tracks(tracks: Sequence[Track], faults: BoxFaults, key: int) -> tuple[Track, ...]:
    """Boxes as annotated. A box has its own offset whatever the other boxes are."""
    found = []
    for track in tracks:
        rng = seeds.numpy_rng(key, 0, f"box {track.id}")
        own, each = rng.standard_normal(4), rng.standard_normal((len(track.times_s), 4))
        error = own + 0.5 * ndimage.uniform_filter1d(each, 3, axis=0, mode="nearest")  # annotators interpolate
        poses = track.world_from_object.copy()
        for pose, (along, across, up, turn) in zip(
            poses, error * [*[faults.position_m] * 3, faults.yaw_deg], strict=True
        ):
            pose[:] = pose @ geometry.yaw_matrix(math.radians(float(turn)), (along, across, up / 3))
        size = track.size_m * np.exp(faults.size_share * rng.standard_normal(3))
        found.append(replace(track, size_m=size, world_from_object=poses))
    return tuple(found)


def _small_motion(turn_deg: Array, shift_m: Array) -> Array:
    return geometry.from_rotation_translation(Rotation.from_rotvec(np.radians(turn_deg)).as_matrix(), shift_m)
