"""The colours of a log's cameras: each camera has an exposure and a white balance of its own, the world has not.

`ColorMap` is an affine map per channel between the colours of two cameras. `CameraColors` holds, for every camera, the
map to the *common* colours, those of one camera of the log. Fused points and fitted scenes have common colours; images
on disk, recorded and generated, have those of their camera. The maps are found by `core/calibration.py` and travel with
the fused cloud.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ColorMap:
    """wanted = gain * given + offset for each channel of colours in [0, 1]; ``pairs``: of colours it was fitted to."""

    gain: Triple = (1.0, 1.0, 1.0)
    offset: Triple = (0.0, 0.0, 0.0)
    pairs: int = 0

    def inverse(self) -> ColorMap:
        """The map back."""
        back = tuple(1 / g for g in self.gain), tuple(-o / g for g, o in zip(self.gain, self.offset))
        return ColorMap(*back, self.pairs)  # type: ignore[arg-type]

    def then(self, other: ColorMap) -> ColorMap:
        """This map, and after it another one."""
        gain = tuple(a * b for a, b in zip(other.gain, self.gain))
        offset = tuple(a * o + p for a, o, p in zip(other.gain, self.offset, other.offset))
        return ColorMap(gain, offset, min(self.pairs, other.pairs))  # type: ignore[arg-type]

    def of_image(self, rgb: Tensor) -> Tensor:
        """An image [3, H, W] mapped, differentiable, not clamped."""
        gain, offset = (_per_channel(values, rgb.dtype, rgb.device) for values in (self.gain, self.offset))
        return rgb * gain + offset

    def of_bytes(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colours u8[..., 3] mapped, rounded and clamped."""
        levels = np.arange(256) / 255.0
        values = [np.rint((g * levels + o) * 255) for g, o in zip(self.gain, self.offset)]
        tables = np.clip(values, 0, 255).astype(np.uint8)
        return np.stack([table[rgb[..., channel]] for channel, table in enumerate(tables)], -1)


@dataclass(frozen=True, slots=True)
class CameraColors:
    """Which camera's colours are the common ones ("" = all cameras have the same), and for the others the maps to them.
    A camera that is not named has common colours."""

    reference: str = ""
    to_common: Mapping[str, ColorMap] = field(default_factory=dict)

    def image_to_common(self, camera: str, rgb: Tensor) -> Tensor:
        """An image [3, H, W] of a camera in common colours, not clamped."""
        found = self.to_common.get(camera)
        return rgb if found is None else found.of_image(rgb)

    def image_of(self, camera: str, rgb: Tensor) -> Tensor:
        """An image [3, H, W] in common colours as a camera shows it, not clamped."""
        found = self.to_common.get(camera)
        return rgb if found is None else found.inverse().of_image(rgb)

    def bytes_to_common(self, camera: str, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Colours u8[..., 3] of a camera as common ones."""
        found = self.to_common.get(camera)
        return rgb if found is None else found.of_bytes(rgb)

    def record(self) -> dict[str, Any]:
        """As JSON values; inverse of ``of_record``."""
        values = lambda m: {"gain": list(m.gain), "offset": list(m.offset), "pairs": m.pairs}
        return {"reference": self.reference, "to_common": {name: values(m) for name, m in self.to_common.items()}}

    @classmethod
    def of_record(cls, values: Mapping[str, Any]) -> CameraColors:
        """From JSON values. KeyError, TypeError or ValueError if they are malformed."""
        map_of = lambda m: ColorMap(_triple(m["gain"]), _triple(m["offset"]), int(m["pairs"]))
        maps = {str(name): map_of(m) for name, m in values["to_common"].items()}
        if any(min(m.gain) <= 0 for m in maps.values()):
            raise ValueError("a gain is not positive")
        return cls(str(values["reference"]), maps)


SAME_COLORS = CameraColors()
"""All cameras have the same colours."""


@functools.lru_cache(maxsize=256)
def _per_channel(values: Triple, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Three numbers as [3, 1, 1], sent to a device once."""
    import torch

    return torch.tensor(values, dtype=dtype).to(device).view(3, 1, 1)


def _triple(values: Any) -> Triple:
    red, green, blue = (float(value) for value in values)
    return red, green, blue
