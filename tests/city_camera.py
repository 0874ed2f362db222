"""The generated city's camera, light and exact surfaces, for tests and measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mudg.base.types import View
from mudg.city.config import CityConfig
from mudg.city.light import light_numbers
from mudg.city.world import CityWorld, library
from mudg.core.weather.gbuffer import Surroundings
from mudg.core.weather.light import srgb_decode, srgb_encode

LUMA = np.array([0.299, 0.587, 0.114])
"""Brightness of display values."""


@dataclass(frozen=True, slots=True, eq=False)
class FilmicResponse:
    """A camera with exposure (a factor on linear light), white balance, vignetting (share of the light lost in the
    corners), a filmic shoulder, saturation (about its own grey) and contrast (slope of display values about 0.5)."""

    exposure: float = 1.0
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)
    saturation: float = 1.0
    contrast: float = 1.0
    vignette: float = 0.0

    def _gains(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        height, width = shape[:2]
        y, x = np.mgrid[0:height, 0:width] + 0.5
        r2 = ((2 * x - width) ** 2 + (2 * y - height) ** 2) / (width**2 + height**2)
        return self.exposure * (1 - self.vignette * r2)[..., None] * np.array(self.white)

    def encode(self, light: NDArray[np.floating]) -> NDArray[np.float32]:
        """Display values f32[H, W, 3] of linear light."""
        v = np.maximum(light * self._gains(light.shape), 0)
        shown = np.clip(v * (2.51 * v + 0.03) / (v * (2.43 * v + 0.59) + 0.14), 0, 1)
        luma = (shown @ LUMA)[..., None]
        mixed = luma + (shown - luma) * self.saturation
        encoded = srgb_encode(mixed).astype(np.float64)
        return np.clip(0.5 + (encoded - 0.5) * self.contrast, 0, 1).astype(np.float32)

    def decode(self, display: NDArray[np.floating]) -> NDArray[np.float32]:
        """Linear light of display values; exact where nothing was clipped."""
        encoded = 0.5 + (np.asarray(display, np.float64) - 0.5) / self.contrast
        mixed = srgb_decode(encoded).astype(np.float64)
        luma = (mixed @ LUMA)[..., None]
        y = np.clip(luma + (mixed - luma) / self.saturation, 0, 1)
        # the root of y (2.43 v^2 + 0.59 v + 0.14) = 2.51 v^2 + 0.03 v that grows with y
        a, b, c = 2.51 - 2.43 * y, 0.03 - 0.59 * y, -0.14 * y
        v = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
        return (v / self._gains(display.shape)).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class CityLight:
    """Exact light and camera of a generated city: what an edit of its images could know at best. ``visibility_m``: in
    its haze."""

    surroundings: Surroundings
    response: FilmicResponse
    visibility_m: float


def city_light(config: CityConfig) -> CityLight:
    """The light of a city with a plain sky and no photographs; its road lies at height 0."""
    _, n = light_numbers(config)
    direction, sun, zenith, horizon, ambient, _cloud, white = n[:21].reshape(7, 3)
    haze_m, _night, exposure, contrast, saturation, _noise, vignette = n[22:29]
    around = Surroundings(horizon, zenith, ambient, sun, direction, 0.875 * horizon + 0.075 * ambient)
    r, g, b = (float(w) for w in white)
    response = FilmicResponse(float(exposure), (r, g, b), float(saturation), float(contrast), float(vignette))
    return CityLight(around, response, 3.0 * float(haze_m))


@dataclass(frozen=True, slots=True, eq=False)
class CitySurfaces:
    """Exact surfaces behind pixel centres, 0 in the sky: unit normals f32[H, W, 3] in the world and albedo f32[H, W,
    3]; and f32[H, W] in [0, 1]: share of the sky that is seen, whether the sun shines on it, snow cover, standing
    water."""

    normal: NDArray[np.float32]
    albedo: NDArray[np.float32]
    openness: NDArray[np.float32]
    sunlit: NDArray[np.float32]
    snow: NDArray[np.float32]
    water: NDArray[np.float32]


def surfaces(world: CityWorld, view: View) -> CitySurfaces:
    """Exact surfaces behind the pixel centres of a view, as ``CityWorld.render`` sees them."""
    camera, handle = view.camera, world._handle._handle
    planes = np.empty((camera.height, camera.width, 10), np.float32)
    frame = (np.array(camera.intrinsics), camera.width, camera.height, np.ascontiguousarray(view.world_from_cam))
    assert library().mudg_city_planes(handle, *world._objects_at(view.time_s), *frame, planes) == 0
    return CitySurfaces(planes[..., :3], planes[..., 3:6], *(planes[..., i] for i in range(6, 10)))
