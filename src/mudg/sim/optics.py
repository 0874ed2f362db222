"""Lenses of simulated cameras: the ray of every pixel, and pinhole faces from which any of them is resampled. Axes are
those of a camera (x right, y down, z forward); the centre of the top-left pixel is (0.5, 0.5). Rays have length 1; NaN
where the lens sees nothing."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import UsageError
from mudg.base.types import Camera, View

Floats = NDArray[np.float64]
MOST_PIXELS: Final = 8192 * 8192
MOST_FACE_PX: Final = 2048
NEWTON_STEPS: Final = 30
CONVERGED: Final = 1e-9
SAME_SURFACE: Final = 0.03
"""Relative difference of depth within which neighbouring pixels show one surface."""
FACES: Final = (
    np.eye(3),
    np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]]),
)
"""Rotations camera-from-face of a cube's sides (front, right, left, down, up, back): each looks along the z axis of its
own frame."""


@dataclass(frozen=True, slots=True)
class _FocalLens:
    """A lens with focal lengths. ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy``: pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, ...] = ()

    def plane(self) -> tuple[Floats, Floats]:
        """Pixel centres in focal lengths from the principal point, to the right and down, each f64[H, W]."""
        x, y = (np.arange(self.width) + 0.5 - self.cx) / self.fx, (np.arange(self.height) + 0.5 - self.cy) / self.fy
        right, down = np.broadcast_arrays(x[None, :], y[:, None])
        return right, down


@dataclass(frozen=True, slots=True)
class Pinhole(_FocalLens):
    """A pinhole camera with the lens distortion of OpenCV. ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy``:
    pixels. ``radial``: k1 to k6 of the rational model, missing ones 0. ``tangential``: p1, p2. ``thin_prism``: s1 to
    s4."""

    tangential: tuple[float, ...] = ()
    thin_prism: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_optics(self, (self.fx, self.fy), (*self.radial, *self.tangential, *self.thin_prism, self.cx, self.cy))
        for name, most in (("radial", 6), ("tangential", 2), ("thin_prism", 4)):
            if len(getattr(self, name)) > most:
                raise UsageError(f"a pinhole lens has at most {most} {name} coefficients", got=str(getattr(self, name)))

    @classmethod
    def of(cls, camera: Camera) -> Pinhole:
        """The lens of a rectified camera."""
        return cls(camera.width, camera.height, *camera.intrinsics)

    @property
    def camera(self) -> Camera | None:
        """The same as a rectified camera; None if the lens distorts."""
        if any((*self.radial, *self.tangential, *self.thin_prism)):
            return None
        return Camera("sim", self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def rays(self) -> Floats:
        """f64[H, W, 3]."""
        distorted = np.stack(self.plane(), -1)
        plain, step = distorted.copy(), np.full(distorted.shape[:2], np.inf)
        if self.camera is None:
            for _ in range(NEWTON_STEPS):  # fixed point of x = (distorted - tangential(x)) / radial(x)
                shrink, shift = self._distortion(plain)
                with np.errstate(all="ignore"):
                    better = (distorted - shift) / shrink[..., None]
                step = np.abs(better - plain).max(-1)
                plain = better
            shrink, _ = self._distortion(plain)
            plain[~(step < 1e-6) | (shrink <= 0)] = np.nan  # beyond where the model can be inverted
        return unit(np.concatenate([plain, np.ones_like(plain[..., :1])], -1))

    def _distortion(self, xy: Floats) -> tuple[Floats, Floats]:
        """Radial factor f64[H, W], and what tangential and thin-prism terms add f64[H, W, 2]."""
        k = (*self.radial, *[0.0] * (6 - len(self.radial)))
        p, s = (*self.tangential, 0.0, 0.0)[:2], (*self.thin_prism, 0.0, 0.0, 0.0, 0.0)[:4]
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))) / (1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5])))
        dx = 2 * p[0] * x * y + p[1] * (r2 + 2 * x * x) + r2 * (s[0] + s[1] * r2)
        dy = p[0] * (r2 + 2 * y * y) + 2 * p[1] * x * y + r2 * (s[2] + s[3] * r2)
        return radial, np.stack([dx, dy], -1)


@dataclass(frozen=True, slots=True)
class Fisheye(_FocalLens):
    """The equidistant lens of OpenCV: a ray at angle a from the axis falls r = a (1 + k1 a^2 + k2 a^4 + ...) from the
    centre. ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy``: pixels. ``radial``: k1 to k4. ``max_angle``: radians;
    beyond it nothing is seen."""

    max_angle: float = math.pi / 2

    def __post_init__(self) -> None:
        check_optics(self, (self.fx, self.fy, self.max_angle), (*self.radial, self.cx, self.cy))

    def rays(self) -> Floats:
        """f64[H, W, 3]."""
        x, y = self.plane()
        coefficients = [0.0, 1.0]
        for k in self.radial:
            coefficients += [0.0, k]
        return around_axis(x, y, inverse(coefficients, np.hypot(x, y), self.max_angle), self.max_angle)


@dataclass(frozen=True, slots=True)
class FTheta:
    """NVIDIA's f-theta lens: polynomials between the distance from the principal point in pixels and the angle from the
    axis in radians. ``width``, ``height``, ``cx``, ``cy``: pixels. ``pixels_to_angle``, ``angle_to_pixels``:
    coefficients by rising power; the second may be empty. ``reference``: which of the two is exact; the other one
    approximates its inverse. ``max_angle``: radians. ``linear``: c, d, e of the matrix [[c, d], [e, 1]] that shears and
    stretches the image."""

    width: int
    height: int
    cx: float
    cy: float
    pixels_to_angle: tuple[float, ...] = ()
    angle_to_pixels: tuple[float, ...] = ()
    reference: str = "pixels_to_angle"
    max_angle: float = math.pi / 2
    linear: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        numbers = (*self.pixels_to_angle, *self.angle_to_pixels, *self.linear, self.cx, self.cy)
        check_optics(self, (self.max_angle,), numbers)
        if self.reference not in ("pixels_to_angle", "angle_to_pixels") or not getattr(self, self.reference):
            what = "an f-theta lens needs the coefficients of its reference polynomial"
            expected = "pixels_to_angle or angle_to_pixels, with coefficients"
            raise UsageError(what, where=self.reference, expected=expected)

    def rays(self) -> Floats:
        """f64[H, W, 3]."""
        c, d, e = self.linear
        across, down = np.arange(self.width) + 0.5 - self.cx, np.arange(self.height) + 0.5 - self.cy
        offsets = np.stack(np.meshgrid(across, down), -1)
        x, y = np.moveaxis(offsets @ np.linalg.inv(np.array([[c, d], [e, 1.0]])).T, -1, 0)
        distance = np.hypot(x, y)
        if self.reference == "pixels_to_angle":
            angle = polyval(distance, self.pixels_to_angle)
        else:
            angle = inverse(self.angle_to_pixels, distance, self.max_angle)
        return around_axis(x, y, angle, self.max_angle)


Optics = Pinhole | Fisheye | FTheta


def check_optics(optics: Optics, positive: Sequence[float], numbers: Sequence[float]) -> None:
    """Refuse what is no camera. UsageError: sizes or numbers that no camera has."""
    where = type(optics).__name__
    if not (optics.width > 0 and optics.height > 0 and optics.width * optics.height <= MOST_PIXELS):
        expected = f"1x1 to {MOST_PIXELS} pixels"
        raise UsageError("no such image size", where=where, expected=expected, got=f"{optics.width}x{optics.height}")
    if not all(math.isfinite(value) and value > 0 for value in positive):
        raise UsageError("focal lengths and angles must be positive", where=where, got=str(list(positive)))
    if not all(math.isfinite(value) for value in numbers):
        raise UsageError("a lens coefficient is not finite", where=where, got=str(list(numbers)))


@functools.lru_cache(maxsize=8)
def rays_of(optics: Optics) -> Floats:
    """The rays of a lens f64[H, W, 3], computed once and read-only: a simulator asks for the same cameras again."""
    rays = optics.rays()
    rays.setflags(write=False)
    return rays


def unit(vectors: Floats) -> Floats:
    """Vectors f64[..., 3] of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def inverse(coefficients: Sequence[float], values: Floats, largest: float) -> Floats:
    """Arguments in [0, largest] at which a polynomial (coefficients by rising power) has the values, by Newton's method
    within the part in which it grows; NaN where there is none."""
    slope = polyder(coefficients)
    steps = np.linspace(0, largest, 1025)
    falls = polyval(steps, slope) <= 0
    end = steps[falls.argmax()] if falls.any() else largest
    known = polyval(steps, coefficients)
    argument = np.interp(values, known[steps <= end], steps[steps <= end])
    for _ in range(NEWTON_STEPS):
        with np.errstate(all="ignore"):
            step = (polyval(argument, coefficients) - values) / polyval(argument, slope)
        argument = np.clip(argument - step, 0, end)
        if np.abs(step).max(initial=0) < CONVERGED:
            break
    off = np.abs(polyval(argument, coefficients) - values)
    return np.where(off <= 1e-6 * max(1.0, float(known.max())), argument, np.nan)


def around_axis(x: Floats, y: Floats, angle: Floats, max_angle: float) -> Floats:
    """Rays f64[H, W, 3] at an angle from the axis, in the direction (x, y) of the image."""
    distance = np.hypot(x, y)
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.where(distance > 0, np.sin(angle) / distance, 1.0)
        rays = np.stack([x * away, y * away, np.cos(angle)], -1)
        rays[~((angle >= 0) & (angle <= max_angle))] = np.nan
    return unit(rays)


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """A pinhole view that some rays fall into. ``camera``: its size and intrinsics. ``cam_from_face``: rotation
    f64[3, 3]. ``pixels``: i64[n], which rays it shows, flat. ``uv``: f64[n, 2], where, in its pixels."""

    camera: Camera
    cam_from_face: Floats
    pixels: NDArray[np.int64]
    uv: Floats

    def view(self, world_from_camera: Floats, time_s: float) -> View:
        """The view of a camera that stands there."""
        turned = geometry.from_rotation_translation(self.cam_from_face, (0.0, 0.0, 0.0))
        return View(self.camera, world_from_camera @ turned, time_s)

    def surface(self, depth: NDArray[np.float32]) -> tuple[Floats, NDArray[np.float32]]:
        """Distance along every ray f64[n] to the surface of a depth f32[H, W], and how squarely that faces it."""
        z, facing = surface(depth, self.uv, self.camera)
        x, y = geometry.pinhole_ray(self.camera.intrinsics, *self.uv.T)
        return z * np.sqrt(x * x + y * y + 1), facing


def faces_of(rays: Floats, focal_px: float, name: str = "sim") -> list[Face]:
    """Pinhole views that together show all rays f64[..., 3], each cropped to what it must show. ``focal_px``: focal
    length of the faces, pixels per radian on their axes; at most what keeps a face below ``MOST_FACE_PX``. ``name``: of
    their cameras."""
    flat = rays.reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        along = np.stack([flat @ turn[:, 2] for turn in FACES])
    seen = np.isfinite(flat).all(1)
    side = np.where(seen, along.argmax(0), -1)
    focal = min(focal_px, MOST_FACE_PX / 2)
    found = []
    for index, turn in enumerate(FACES):
        pixels = np.flatnonzero(side == index)
        if not len(pixels):
            continue
        x, y, z = (flat[pixels] @ turn).T
        plane = np.stack([x / z, y / z], 1) * focal
        low, high = np.floor(plane.min(0)) - 1, np.ceil(plane.max(0)) + 1
        width, height = (int(v) for v in high - low)
        camera = Camera(name, width, height, focal, focal, -float(low[0]), -float(low[1]))
        found.append(Face(camera, turn, pixels, plane - low))
    return found


def rays_per_radian(rays: Floats) -> float:
    """How densely the rays of an image f64[H, W, 3] lie, pixels per radian: the median over its rows and columns."""
    gaps = [np.linalg.norm(np.diff(rays, axis=axis), axis=-1) for axis in (0, 1) if rays.shape[axis] > 1]
    steps = np.concatenate([gap[np.isfinite(gap)] for gap in gaps]) if gaps else np.zeros(0)
    return 1.0 / float(np.median(steps)) if len(steps) else 100.0


def _corners(uv: Floats, height: int, width: int) -> tuple[tuple[NDArray[np.int64], ...], Floats, Floats]:
    """Rows and columns (top, below, left, right) of the four pixels around places f64[n, 2], and how far right and down
    of the first each lies; what is beyond the border counts as the border."""
    x, y = np.clip(uv[:, 0] - 0.5, 0, width - 1), np.clip(uv[:, 1] - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(np.int64), max(width - 2, 0)), np.minimum(y.astype(np.int64), max(height - 2, 0))
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    return (top, below, left, right), x - left, y - top


def bilinear(image: NDArray[np.float32], uv: Floats) -> NDArray[np.float32]:
    """Values of an image f32[C, H, W] at pixels f64[n, 2], f32[C, n]; pixels beyond its border count as the border."""
    (top, below, left, right), u, v = _corners(uv, *image.shape[-2:])
    u, v = u.astype(np.float32), v.astype(np.float32)
    upper = image[:, top, left] * (1 - u) + image[:, top, right] * u
    lower = image[:, below, left] * (1 - u) + image[:, below, right] * u
    return upper * (1 - v) + lower * v


def nearest(image: NDArray, uv: Floats) -> NDArray:
    """Values of an image [..., H, W] at the pixels that f64[n, 2] lie in, [..., n]."""
    height, width = image.shape[-2:]
    column, row = (np.clip(uv[:, k].astype(np.int64), 0, size - 1) for k, size in ((0, width), (1, height)))
    return image[..., row, column]


def surface(depth: NDArray[np.float32], uv: Floats, camera: Camera) -> tuple[Floats, NDArray[np.float32]]:
    """Depth f64[n] at places between the pixels of f32[H, W], and how squarely the surface there faces the camera, the
    cosine f32[n]. Where the four pixels around a place show one surface, its inverse depth is interpolated, which is
    exact on planes; at edges the nearest pixel counts, so that no beam hangs between two surfaces."""
    (top, below, left, right), u, v = _corners(uv, *depth.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = [depth[top, left], depth[top, right], depth[below, left], depth[below, right]]
        corners = 1 / np.stack(at).astype(float)
        weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
        inverse = (weights * corners).sum(0)
        one = corners.max(0) - corners.min(0) <= SAME_SURFACE * corners.max(0)
        z = np.where(one, 1 / inverse, nearest(depth, uv).astype(np.float64))
        # the plane through the corners: inverse depth grows by a and b per pixel
        a, b = corners[1] - corners[0], corners[2] - corners[0]
        px, py = uv[:, 0] - camera.cx, uv[:, 1] - camera.cy
        normal = np.stack([a * camera.fx, b * camera.fy, inverse - a * px - b * py], -1)
        ray = np.stack([px / camera.fx, py / camera.fy, np.ones(len(px))], -1)
        facing = np.abs((unit(normal) * unit(ray)).sum(-1))
    return z, np.where(one & np.isfinite(facing), facing, 0.5).astype(np.float32)
