"""The ``.splat`` of web viewers: no header, 32 bytes a Gaussian, no harmonics beyond degree 0.

f32 x y z  f32 scale x y z (metres)  u8 r g b (colour of degree 0), opacity
u8 rotation w x y z = round((q + 1) / 2 * 255)
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mudg.base.errors import InputError
from mudg.core.harmonics import C0
from mudg.formats.splats import binary
from mudg.formats.splats.cloud import LEAST_LOG, SplatCloud, SplatFile, checked, logit, spacing_m

ROW: Final = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def to_bytes(cloud: SplatCloud) -> bytes:
    """A cloud as a .splat file, large and opaque Gaussians first: viewers show them while they load."""
    order = np.argsort(-(np.exp(cloud.log_scales.sum(1).astype(np.float64)) * cloud.opacity), kind="stable")
    cloud = cloud.take(order)
    rows = np.zeros(len(cloud), ROW)
    rows["means"], rows["scales"] = cloud.means, np.exp(cloud.log_scales.astype(np.float64))
    color = np.concatenate([cloud.sh[:, 0] * C0 + 0.5, cloud.opacity[:, None]], 1)
    rows["rgba"] = np.round(color * 255).clip(0, 255)
    rows["quats"] = np.round((cloud.quats + 1) / 2 * 255).clip(0, 255)
    return rows.tobytes()


def from_bytes(content: bytes, where: str) -> SplatFile:
    """The Gaussians of a .splat file.

    Raises:
        InputError: no such file, or a damaged one.
    """
    if len(content) % ROW.itemsize:
        what, got = "the length of a .splat file is a multiple of 32 bytes", f"{len(content)} bytes"
        raise InputError(what, where=where, got=got, remedy="it was cut off, or is another kind of file")
    binary.refuse_count(len(content) // ROW.itemsize, where)
    rows = np.frombuffer(content, ROW)
    scales = rows["scales"].astype(np.float64)
    if (scales < 0).any():
        what = "the size of a Gaussian is negative"
        remedy = "a .splat file holds sizes in metres, not their logarithms: write exp(scale)"
        raise InputError(what, where=f"{where}: Gaussian {int((scales < 0).any(1).argmax())}", remedy=remedy)
    with np.errstate(divide="ignore"):
        logs = np.maximum(np.log(scales), LEAST_LOG)
    rgba = rows["rgba"] / 255
    sh = ((rgba[:, None, :3] - 0.5) / C0).astype(np.float32)
    quats = (rows["quats"] / 255 * 2 - 1).astype(np.float32)
    cloud = checked(
        SplatCloud(rows["means"].astype(np.float64), quats, logs.astype(np.float32), logit(rgba[:, 3]), sh), where
    )
    return SplatFile(cloud, step_m=spacing_m(rows["means"]))
