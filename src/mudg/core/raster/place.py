"""Which device Gaussians are drawn on, and so where everything that is learnt about them lives."""

from __future__ import annotations

from typing import Final

import torch

from mudg.base import log
from mudg.base.devices import choose_device
from mudg.base.errors import UsageError
from mudg.core.raster.rasterize import Backend, available

DRAWN_ON: Final[dict[str, tuple[str, ...]]] = {
    "auto": ("cpu", "cuda"),
    "cpu": ("cpu",),
    "torch": ("cpu", "cuda"),
    "gsplat": ("cuda",),
}
"""Kinds of devices that each backend draws on."""


def drawing_device(wanted: str, purpose: str, backend: Backend = "auto") -> torch.device:
    """The device for a purpose that draws Gaussians. Says which, once per purpose.

    ``auto`` takes a CUDA device only if the backend can draw there: with backend ``auto``, if gsplat can be used.

    Args:
        wanted: a ``DeviceName``.

    Raises:
        UsageError: the backend does not draw on the device. See ``choose_device``.
    """
    kinds = DRAWN_ON[backend]
    if wanted == "auto":
        problem = available("gsplat") if backend == "auto" and torch.cuda.is_available() else ""
        if problem:
            log.info_once(f"{purpose}: CUDA is not used, drawing there needs gsplat ({problem})")
        wanted = kinds[0] if len(kinds) == 1 else "cpu" if problem else "auto"
    chosen = choose_device(wanted, purpose)
    if chosen.type in ("cpu", "cuda") and chosen.type not in kinds:
        raise UsageError(
            f"raster backend {backend!r} does not draw on this device",
            where="--raster",
            expected=f"--device {kinds[0]}",
            got=f"--device {wanted}",
            remedy="leave --raster at auto",
        )
    return chosen
