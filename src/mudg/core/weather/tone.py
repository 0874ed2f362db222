"""Camera response: linear light to display values and back, as an explicit object that every caller chooses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mudg.base.weather_settings import ResponseSettings

Image = NDArray[np.float32]
LUMA = np.array([0.299, 0.587, 0.114])
"""Brightness of display values."""
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Brightness of linear light."""


@dataclass(frozen=True, slots=True)
class ToneCurve:
    """A response and its inverse.

    Args:
        name: for messages.
        encode: linear light f[..., 3] >= 0 to display values in [0, 1].
        decode: display values to linear light. Values that the sensor clipped come back as the light at which it clips.
    """

    name: str
    encode: Callable[[NDArray[np.floating]], Image]
    decode: Callable[[NDArray[np.floating]], Image]


def srgb_encode(light: NDArray[np.floating]) -> Image:
    """Display values in [0, 1] of linear light, IEC 61966-2-1, clipped."""
    x = np.clip(light, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055).astype(np.float32)


def srgb_decode(display: NDArray[np.floating]) -> Image:
    """Linear light of sRGB display values in [0, 1]."""
    x = np.clip(display, 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def gamma_curve(exponent: float = 2.2) -> ToneCurve:
    """``display = light ** (1 / exponent)``."""
    return ToneCurve(
        f"gamma {exponent:g}",
        lambda light: (np.clip(light, 0, 1) ** (1 / exponent)).astype(np.float32),
        lambda display: (np.clip(display, 0, 1) ** exponent).astype(np.float32),
    )


SRGB = ToneCurve("srgb", srgb_encode, srgb_decode)
LINEAR = ToneCurve(
    "linear",
    lambda light: np.clip(light, 0, 1).astype(np.float32),
    lambda shown: np.clip(shown, 0, 1).astype(np.float32),
)


def curve_of(settings: ResponseSettings) -> ToneCurve:
    """The curve that settings name."""
    return {"srgb": SRGB, "linear": LINEAR, "gamma": gamma_curve(settings.gamma)}[settings.tone]


@dataclass(frozen=True, slots=True, eq=False)
class FilmicResponse:
    """A camera with exposure, white balance, vignetting, a filmic shoulder, saturation and contrast (the generated city's camera).

    Args:
        exposure: factor on linear light.
        white: factors of red, green and blue, f64[3].
        saturation: colour about its own grey, 1 = unchanged.
        contrast: slope of display values about 0.5.
        vignette: share of the light lost in the corners.
    """

    exposure: float = 1.0
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)
    saturation: float = 1.0
    contrast: float = 1.0
    vignette: float = 0.0

    def curve(self) -> ToneCurve:
        """Response and inverse for images f[H, W, 3]. The inverse is exact where nothing was clipped."""
        return ToneCurve("filmic", self._encode, self._decode)

    def _gains(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        height, width = shape[:2]
        y, x = np.mgrid[0:height, 0:width] + 0.5
        r2 = ((2 * x - width) ** 2 + (2 * y - height) ** 2) / (width**2 + height**2)
        return self.exposure * (1 - self.vignette * r2)[..., None] * np.array(self.white)

    def _encode(self, light: NDArray[np.floating]) -> Image:
        v = np.maximum(light * self._gains(light.shape), 0)
        shown = np.clip(v * (2.51 * v + 0.03) / (v * (2.43 * v + 0.59) + 0.14), 0, 1)
        luma = (shown @ LUMA)[..., None]
        mixed = luma + (shown - luma) * self.saturation
        encoded = srgb_encode(mixed).astype(np.float64)
        return np.clip(0.5 + (encoded - 0.5) * self.contrast, 0, 1).astype(np.float32)

    def _decode(self, display: NDArray[np.floating]) -> Image:
        encoded = 0.5 + (np.asarray(display, np.float64) - 0.5) / self.contrast
        mixed = srgb_decode(encoded).astype(np.float64)
        luma = (mixed @ LUMA)[..., None]
        y = np.clip(luma + (mixed - luma) / self.saturation, 0, 1)
        # the root of y (2.43 v^2 + 0.59 v + 0.14) = 2.51 v^2 + 0.03 v that grows with y
        a, b, c = 2.51 - 2.43 * y, 0.03 - 0.59 * y, -0.14 * y
        v = (-b + np.sqrt(b * b - 4 * a * c)) / (2 * a)
        return (v / self._gains(display.shape)).astype(np.float32)
