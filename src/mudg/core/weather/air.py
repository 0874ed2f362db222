"""Air: fog, falling rain and snow, in pictures and LiDAR sweeps, and the noise that patches of the ground follow.

Sources and assumptions: docs/reference/weather.md."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg.base import geometry, seeds
from mudg.base.palette import UNLABELLED
from mudg.base.types import SweepPoints, View
from mudg.base.weather_settings import FogSettings, RainSettings, SnowSettings, WeatherSettings

# noise --------------------------------------------------------------------------------------------
# Hashes and value noise of world places, the same for every camera and frame. Twins of ``hash_bits``, ``hash01`` and
# ``noise2`` in native/city_math.h, so that the generated city can show the same puddles and patches of snow.


Array = NDArray[np.float64]
Hashes = NDArray[np.uint32]
_QUANTILE_SIDE = 192
_QUANTILE_STEP = 0.73


def _u32(values: ArrayLike) -> Hashes:
    return np.asarray(values).astype(np.int64).astype(np.uint32)


def mix_bits(h: Hashes) -> Hashes:
    """A hash u32[...] whose every bit depends on all bits of ``h``."""
    h = h ^ (h >> np.uint32(16))
    h = h * np.uint32(0x7FEB352D)
    h = h ^ (h >> np.uint32(15))
    h = h * np.uint32(0x846CA68B)
    return h ^ (h >> np.uint32(16))


def hash_bits(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike | None = None) -> Hashes:
    """Hash u32[...] of three or four integers (arrays broadcast)."""
    with np.errstate(over="ignore"):
        h = mix_bits(
            (_u32(a) * np.uint32(0x9E3779B1))
            ^ (_u32(b) * np.uint32(0x85EBCA77) + np.uint32(0x165667B1))
            ^ (_u32(c) * np.uint32(0xC2B2AE3D))
        )
        return h if d is None else mix_bits(h + _u32(d) * np.uint32(0x27D4EB2F))


def unit(h: Hashes) -> NDArray[np.float64]:
    """Numbers f64[...] in [0, 1) of hashes."""
    return (h >> np.uint32(8)).astype(np.float64) * (1.0 / 16777216.0)


def noise_seed(seed: int, purpose: str) -> int:
    """A seed of value noise, 0 to a million, for a purpose."""
    return seeds.key(seed, 0, purpose) % 1_000_000


def noise2(x: NDArray[np.floating], y: NDArray[np.floating], seed: int) -> NDArray[np.float64]:
    """Smooth value noise f64[...] in [0, 1] of a plane; its grid is 1 wide."""
    ix, iy = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = x - ix, y - iy
    fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
    a, b = unit(hash_bits(ix, iy, seed)), unit(hash_bits(ix + 1, iy, seed))
    c, d = unit(hash_bits(ix, iy + 1, seed)), unit(hash_bits(ix + 1, iy + 1, seed))
    return a + (b - a) * fx + (c - a) * fy + (a - b - c + d) * fx * fy


def patches(x: NDArray[np.floating], y: NDArray[np.floating], size_m: float, seed: int) -> NDArray[np.float64]:
    """Two octaves of value noise f64[...] in [0, 1] over world x and y in metres; patches are about ``size_m`` wide."""
    return 0.7 * noise2(x / size_m, y / size_m, seed) + 0.3 * noise2(2.7 * x / size_m, 2.7 * y / size_m, seed + 1)


def patch_threshold(share: float, seed: int) -> float:
    """The level that ``patches`` exceeds on this share of a large area, 0 to 1. Measured on a fixed grid of places."""
    if share <= 0 or share >= 1:
        return 2.0 if share <= 0 else -1.0
    at = np.arange(_QUANTILE_SIDE) * _QUANTILE_STEP
    x, y = np.meshgrid(at, at)
    return float(np.quantile(patches(x, y, 1.0, seed), 1 - share))


def smoothstep(low: float, high: float, v: Any) -> Any:
    """0 below ``low``, 1 above ``high``, smooth between."""
    t = np.clip((v - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


# fog ----------------------------------------------------------------------------------------------
# Koschmieder's law in linear light, ``L = L0 t + A (1 - t)`` with transmittance t and airlight A. Distances are along
# the ray, not camera z.


LEAST_SHARE = 0.05
"""Haze is removed down to this transmittance: what is behind more of it cannot be recovered."""


def extinction(visibility_m: float) -> float:
    """Extinction per metre of a meteorological optical range in metres (5 % contrast: ln 20 = 3.0)."""
    return 3.0 / visibility_m


def way_below(range_m: Array, rise: Array, height_m: float, top_m: float) -> Array:
    """Length f64[...] of the part of rays that runs below ``top_m`` above the ground, metres, seen from ``height_m``.
    ``range_m``: distance along the ray, infinite in the sky; ``rise``: sine of its elevation."""
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = np.where(rise == 0, np.inf, (top_m - height_m) / rise)
        if height_m < top_m:
            return np.where(rise > 0, np.minimum(range_m, crossing), range_m)
        return np.where(rise < 0, np.maximum(range_m - crossing, 0), 0.0)


def transmittance(range_m: Array, rise: Array, height_m: float, fog: FogSettings) -> Array:
    """Share of the light of a surface that reaches the camera through fog, f64[...] in [0, 1]; arguments as of
    ``way_below``."""
    depth = extinction(fog.visibility_m) * way_below(range_m, rise, height_m, fog.top_m)
    return np.exp(-np.minimum(depth, 700.0))


def veiled(color: NDArray[np.floating], share: Array, airlight: Array) -> NDArray[np.float32]:
    """Linear light f32[..., 3] behind air that lets the share [...] through and adds airlight f64[3] for the rest."""
    t = share[..., None]
    return (color * t + airlight * (1 - t)).astype(np.float32)


def unveiled(color: NDArray[np.floating], share: Array, airlight: Array) -> NDArray[np.float32]:
    """Inverse of ``veiled``, not below black; a share under ``LEAST_SHARE`` counts as that."""
    t = np.maximum(share, LEAST_SHARE)[..., None]
    return np.maximum((color - airlight * (1 - t)) / t, 0).astype(np.float32)


# particles ----------------------------------------------------------------------------------------
# Every size falls with its own speed. Particles of one size stand still in a frame that falls with them; that frame is
# cut into cells, and a hash of the cell says how many particles it holds and where. So any camera at any time sees the
# same ones, without a simulation.


DROP_LIGHT = 0.94
RAIN_EDGES_MM = (1.0, 1.5, 2.0, 3.0, 5.0)
FLAKE_EDGES_MM = (0.7, 1.2, 2.0, 3.5)
FLAKE_GROWTH = 10.0 ** (1 / 3)
FLAKE_SPEED = 1.0
FLAKE_SWAY_M = 0.1
NEAREST_M = 0.25
SHUTTER_S = 0.01
"""Exposure time: length of the streaks."""
_STEP_PX = 0.7
_MOST_STEPS = 400


@dataclass(frozen=True, slots=True)
class ParticleSize:
    """Particles of about one size: how many in a cubic metre, the diameter whose square is the mean square, the speed
    towards the ground, and the amplitude of a horizontal swing."""

    density: float
    diameter_m: float
    fall_m_s: float
    sway_m: float = 0.0


def _exponential(intercept: float, slope: float, edges_mm: tuple[float, ...]) -> list[tuple[float, float]]:
    """Numbers per cubic metre and root mean square diameters in mm of an exponential distribution, per interval of
    diameters."""

    def tails(d: float) -> tuple[float, float]:  # integrals of N and N D^2 from d to infinity
        e = intercept * math.exp(-slope * d)
        return e / slope, e * (d * d / slope + 2 * d / slope**2 + 2 / slope**3)

    ends = [tails(d) for d in edges_mm]
    found = [(a[0] - b[0], a[1] - b[1]) for a, b in zip(ends[:-1], ends[1:], strict=True)]
    return [(number, math.sqrt(square / number)) for number, square in found if number > 0]


def rain_sizes(mm_h: float) -> list[ParticleSize]:
    """Drops of 1 to 5 mm at a rate in mm/h, above 0; smaller ones are part of the veil."""
    rows = _exponential(8000.0, 4.1 * mm_h**-0.21, RAIN_EDGES_MM)
    return [ParticleSize(n, d * 1e-3, 9.65 - 10.3 * math.exp(-0.6 * d)) for n, d in rows]


def snow_sizes(mm_h: float) -> list[ParticleSize]:
    """Flakes at a rate in mm/h of water, above 0: melted diameters of 0.7 to 3.5 mm."""
    rows = _exponential(3800.0 * mm_h**-0.87, 2.55 * mm_h**-0.48, FLAKE_EDGES_MM)
    return [ParticleSize(n, d * 1e-3 * FLAKE_GROWTH, FLAKE_SPEED, FLAKE_SWAY_M) for n, d in rows]


def rain_extinction(mm_h: float) -> float:
    """Extinction of rain per metre: 0.312 R^0.67 per km."""
    return 0.312e-3 * mm_h**0.67


def snow_extinction(mm_h: float) -> float:
    """Extinction of falling snow per metre: twice the area of all flakes in a cubic metre. mm_h: above 0."""
    n0, slope = 3800.0 * mm_h**-0.87, 2.55 * mm_h**-0.48
    return 2 * n0 * math.pi / 4 * FLAKE_GROWTH**2 * 2 / slope**3 * 1e-6


def _inside(view: View, xyz: Array, reach_m: float, margin_m: float) -> NDArray[np.bool_]:
    """Whether world places [N, 3] lie in the view's pyramid up to the reach, with a margin: bool[N]."""
    camera = view.camera
    local = (xyz - view.center_world) @ view.world_from_cam[:3, :3]
    x, y, z = local.T
    ok = (z > -margin_m) & (np.linalg.norm(local, axis=1) < reach_m + margin_m)
    edges = (
        (-1, 0, camera.cx / camera.fx),
        (1, 0, (camera.width - camera.cx) / camera.fx),
        (0, -1, camera.cy / camera.fy),
        (0, 1, (camera.height - camera.cy) / camera.fy),
    )
    for along_x, along_y, slope in edges:
        ok &= (along_x * x + along_y * y - slope * z) / math.hypot(1, slope) < margin_m
    return ok


def places(size: ParticleSize, velocity: Array, view: View, reach_m: float, key: int) -> Array:
    """World places f64[N, 3] at ``view.time_s`` of the particles that stand in the view's pyramid within the reach, and
    a few beside it. ``velocity``: f64[3] m/s, the same for all; ``key``: of the random numbers."""
    time_s = view.time_s
    cell = min(max((2.0 / size.density) ** (1 / 3), 0.25), 2.0)
    margin = cell + size.sway_m
    u, v = np.array([0, 1, 0, 1]) * view.camera.width, np.array([0, 0, 1, 1]) * view.camera.height
    rays = np.stack([*geometry.pinhole_ray(view.camera.intrinsics, u, v), np.ones(4)], 1)
    ends = np.concatenate([np.zeros((1, 3)), rays * reach_m, [[0, 0, reach_m]]])
    corners = view.center_world + ends @ view.world_from_cam[:3, :3].T - velocity * time_s
    low, high = np.floor((corners.min(0) - margin) / cell), np.floor((corners.max(0) + margin) / cell)
    axes = [np.arange(int(a), int(b) + 1) for a, b in zip(low, high, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    centers = (cells + 0.5) * cell + velocity * time_s
    cells = cells[_inside(view, centers, reach_m, 0.87 * cell + size.sway_m)]
    name = key & 0x7FFFFFFF
    hashes = hash_bits(cells[:, 0], cells[:, 1], cells[:, 2], name)
    mean = size.density * cell**3
    most = int(mean + 7 * math.sqrt(mean) + 8)
    k = np.arange(most)
    chances = np.exp(-mean + k * math.log(mean) - np.array([math.lgamma(i + 1) for i in k]))
    counts = np.searchsorted(np.cumsum(chances), unit(hashes), side="right")
    owner = np.repeat(np.arange(len(cells)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    inside = np.stack([unit(hash_bits(hashes[owner], number, axis, name)) for axis in range(3)], 1)
    found = (cells[owner] + inside) * cell + velocity * time_s
    if size.sway_m:
        phase = 2 * math.pi * unit(hash_bits(hashes[owner], number, 3, name))
        pace = 2 + 3 * unit(hash_bits(hashes[owner], number, 4, name))
        found[:, 0] += size.sway_m * np.sin(pace * time_s + phase)
        found[:, 1] += size.sway_m * np.cos(pace * time_s + phase)
    return found


def covered(view: View, depth: NDArray[np.floating], xyz: Array, velocity: Array, diameter_m: float) -> Array:
    """Optical depth f64[H, W] of particles before the surfaces.

    A ball of w pixels that moves during the exposure covers, summed over pixels, pi/4 w^2 of one pixel on the axis,
    however long its streak is; off the axis its image is longer, by range over depth. That sum is spread evenly over
    the streak; large balls have soft edges. ``depth``: camera z of the surfaces f[H, W], metres; ``xyz``: world places
    f64[N, 3] at the middle of the exposure; ``velocity``: f64[3] against the camera, m/s.
    """
    camera = view.camera
    turn = view.world_from_cam[:3, :3]
    middle = (xyz - view.center_world) @ turn
    half = (velocity * SHUTTER_S / 2) @ turn
    ends = [middle - half, middle + half]
    kept = (ends[0][:, 2] > NEAREST_M) & (ends[1][:, 2] > NEAREST_M)
    start, end = ends[0][kept], ends[1][kept]
    a, b = (np.stack(geometry.pinhole(camera.intrinsics, *p.T), 1) for p in (start, end))
    width = camera.fx * diameter_m / middle[kept, 2]
    lengths = np.linalg.norm(b - a, axis=1)
    along = np.minimum(np.ceil(lengths / _STEP_PX).astype(np.int64) + 1, _MOST_STEPS)
    across = np.ceil(width / _STEP_PX).astype(np.int64)
    counts = along * across * across
    owner = np.repeat(np.arange(len(a)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    n_across, n_along = across[owner], along[owner]
    u = (number // (n_across * n_across) + 0.5) / n_along
    rest = number % (n_across * n_across)
    offset = np.stack([rest % n_across, rest // n_across], 1) + 0.5
    at = a[owner] + u[:, None] * (b - a)[owner] + (offset / n_across[:, None] - 0.5) * width[owner][:, None]
    z = start[owner, 2] + u * (end - start)[owner, 2]
    stretch = np.linalg.norm(middle[kept], axis=1) / middle[kept, 2]
    mass = (math.pi / 4 * width**2 * stretch / counts)[owner]
    return _splat(at, mass, z, depth)


def _splat(at: Array, mass: Array, z: Array, depth: NDArray[np.floating]) -> Array:
    """Bilinear sums f64[H, W] of masses [N] at pixels [N, 2] that are nearer than the surfaces there."""
    height, width = depth.shape
    column, row = np.floor(at[:, 0]).astype(np.int64), np.floor(at[:, 1]).astype(np.int64)
    inside = (column >= -1) & (column <= width) & (row >= -1) & (row <= height)
    at, mass, z, column, row = at[inside], mass[inside], z[inside], column[inside], row[inside]
    seen = z < depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    at, mass = at[seen] - 0.5, mass[seen]
    c0, r0 = np.floor(at[:, 0]).astype(np.int64), np.floor(at[:, 1]).astype(np.int64)
    fx, fy = at[:, 0] - c0, at[:, 1] - r0
    total = np.zeros(height * width)
    for dr, dc, weight in ((0, 0, (1 - fx) * (1 - fy)), (0, 1, fx * (1 - fy)), (1, 0, (1 - fx) * fy), (1, 1, fx * fy)):
        r, c = r0 + dr, c0 + dc
        ok = (r >= 0) & (r < height) & (c >= 0) & (c < width)
        total += np.bincount((r * width + c)[ok], (mass * weight)[ok], minlength=height * width)
    return total.reshape(height, width)


def falling(
    view: View,
    depth: NDArray[np.floating],
    sizes: list[ParticleSize],
    fall: RainSettings | SnowSettings,
    camera_velocity: tuple[float, float, float],
    seed: int,
    purpose: str,
) -> Array:
    """Optical depth f64[H, W] of all particles of these sizes within the reach of ``fall``, carried by its wind, at
    ``view.time_s``. ``purpose``: a name for their random numbers."""
    total = np.zeros(depth.shape)
    for index, size in enumerate(sizes):
        velocity = np.array([*fall.wind_m_s, -size.fall_m_s])
        xyz = places(size, velocity, view, fall.reach_m, seeds.key(seed, index, purpose))
        xyz = xyz[np.linalg.norm(xyz - view.center_world, axis=1) < fall.reach_m]
        total += covered(view, depth, xyz, velocity - np.asarray(camera_velocity), size.diameter_m)
    return total


# LiDAR --------------------------------------------------------------------------------------------
# Fog (Hahner et al. 2021): the hard return of a surface falls by ``exp(-2 alpha r)``; droplets near the sensor return a
# soft pulse; the stronger of the two is recorded. Rain (Goodin et al. 2019): power ``rho / r^2 exp(-0.02 R^0.6 r)`` and
# range noise. Powers are relative: only ratios count, and the sensor's threshold is set by the range at which it still
# sees a surface of 10 % reflectance in clear air.


BACKSCATTER = 0.046
"""Backscattered share per metre of fog, times the visibility in metres."""
PULSE_M = 3.0
"""Half-power pulse length as a distance: 20 ns of light, there and back."""
SOFT_JITTER_M = 0.3
CROSS_FROM_M, CROSS_TO_M = 0.9, 1.0
"""The receiver sees nothing of the beam before the first distance, and all of it after the second."""
THRESHOLD = 0.1 / math.pi / 90.0**2
"""Least power that is detected, in units of ``reflectance / pi / r^2``: 10 % reflectance in clear air at 90 m."""
LOST, HARD, SOFT = 0, 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class BeamReturns:
    """A sweep in bad weather, for the same N beams: ranges f64[N], of soft returns the place in the fog, where nothing
    returned the range that was given; ``intensity`` f64[N], received power against a white surface in clear air, times
    r^2 (attenuated reflectance); ``kind`` u8[N]: 0 lost, 1 the surface, 2 fog."""

    range_m: Array
    intensity: Array
    kind: NDArray[np.uint8]


def soft_response(visibility_m: float) -> tuple[Array, Array]:
    """Distances f64[M] in metres, and the power f64[M] of the fog alone recorded there, in the units of ``THRESHOLD``.

    ``beta_b`` times the integral over r' of ``exp(-2 alpha r') / r'^2`` x crossover x pulse, by the midpoint rule; the
    pulse is centred on the recorded distance and scaled so that a surface at r returns ``reflectance / pi / r^2``.
    """
    alpha, reach_m, step_m = math.log(20.0) / visibility_m, 60.0, 0.02
    r = (np.arange(int(reach_m / step_m), dtype=np.float64) + 0.5) * step_m
    density = np.exp(-2 * alpha * r) / r**2 * np.clip((r - CROSS_FROM_M) / (CROSS_TO_M - CROSS_FROM_M), 0, 1)
    behind = (np.arange(int(2 * PULSE_M / step_m), dtype=np.float64) + 0.5) * step_m  # the front of the pulse
    shape = np.where(behind <= 2 * PULSE_M, np.sin(math.pi * behind / (2 * PULSE_M)) ** 2, 0.0)
    power = np.convolve(density, shape, mode="same") * step_m
    return r, BACKSCATTER / visibility_m * power


def in_fog(range_m: Array, reflectance: Array, visibility_m: float, seed: int) -> BeamReturns:
    """A sweep in fog, from ranges f64[N] to surfaces, metres, and their reflectance times the cosine of incidence
    f64[N], 0 to 1. Only beams that hit a surface are known: beams into the sky stay without return."""
    range_m, reflectance = np.asarray(range_m, np.float64), np.asarray(reflectance, np.float64)
    alpha = math.log(20.0) / visibility_m
    hard = reflectance / math.pi / range_m**2 * np.exp(-2 * alpha * range_m)
    distances, powers = soft_response(visibility_m)
    best = np.maximum.accumulate(powers)  # the strongest fog nearer than the surface
    place = np.maximum.accumulate(np.where(powers >= best, np.arange(len(powers)), 0))
    index = np.clip(np.searchsorted(distances, range_m) - 1, 0, len(distances) - 1)
    soft = best[index]
    kind = np.where(np.maximum(hard, soft) < THRESHOLD, LOST, np.where(soft > hard, SOFT, HARD)).astype(np.uint8)
    jitter = seeds.numpy_rng(seed, len(range_m), "soft returns").normal(0, SOFT_JITTER_M, len(range_m))
    near = np.clip(distances[place[index]] + jitter, np.minimum(CROSS_FROM_M, range_m), range_m)
    shown = np.where(kind == SOFT, near, range_m)
    power = np.where(kind == SOFT, soft, hard)
    return BeamReturns(shown, np.where(kind == LOST, 0.0, power * math.pi * range_m**2), kind)


def in_rain(range_m: Array, reflectance: Array, mm_h: float, seed: int) -> BeamReturns:
    """A sweep in rain of a rate in mm/h: weaker and lost returns, and noise of the range. Arguments as of
    ``in_fog``."""
    range_m, reflectance = np.asarray(range_m, np.float64), np.asarray(reflectance, np.float64)
    share = np.exp(-0.02 * mm_h**0.6 * range_m) if mm_h > 0 else np.ones_like(range_m)
    kept = reflectance / math.pi / range_m**2 * share >= THRESHOLD
    sigma = 0.02 * range_m * (1 - math.exp(-mm_h)) ** 2
    noise = seeds.numpy_rng(seed, len(range_m), "rain range").normal(0, 1, len(range_m)) * sigma
    return BeamReturns(
        np.where(kept, np.maximum(range_m + noise, 0.1), range_m),
        np.where(kept, reflectance * share, 0.0),
        np.where(kept, HARD, LOST).astype(np.uint8),
    )


def sweep_in_weather(points: SweepPoints, weather: WeatherSettings, seed: int) -> tuple[SweepPoints, NDArray[np.uint8]]:
    """A sweep, recorded in clear air, as it would have been in fog and rain: the points that return, moved along their
    beams, and for each 1 = surface, 2 = fog, u8[N]. ``seed``: another for every sweep.

    The recorded intensity is taken as reflectance times the cosine of incidence, 0 to 1: sensors whose intensity means
    something else need it converted first. Snow in the air is not modelled.
    """
    xyz = points.xyz.astype(np.float64)
    distance = np.maximum(np.linalg.norm(xyz, axis=1), 1e-3)
    beams = xyz / distance[:, None]
    shown, intensity = distance, points.intensity.astype(np.float64)
    kind = np.full(len(xyz), HARD, np.uint8)
    if weather.fog is not None:
        fog = in_fog(shown, intensity, weather.fog.visibility_m, seed)
        shown, intensity, kind = fog.range_m, fog.intensity, fog.kind
    if weather.rain is not None:
        # fog that returned stands near the sensor and is recorded as it is
        rain = in_rain(shown, intensity, weather.rain.mm_h, seed)
        hard = kind == HARD
        shown, intensity = np.where(hard, rain.range_m, shown), np.where(hard, rain.intensity, intensity)
        kind = np.where(hard, rain.kind, kind).astype(np.uint8)
    kept = kind != LOST
    classes = points.classes
    if classes is not None:
        classes = np.where(kind == SOFT, UNLABELLED, classes).astype(np.uint8)[kept]
    moved = (beams * shown[:, None]).astype(np.float32)[kept]
    result = SweepPoints(moved, np.clip(intensity, 0, 1).astype(np.float32)[kept], points.dt_s[kept], classes)
    return result, kind[kept]
