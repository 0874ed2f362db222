"""Skeleton of a file of Gaussians: a line of text for each, `x y z r g b opacity` (docs/extend/exporter.md)."""

import io

import numpy as np

from mudg.core.harmonics import C0
from mudg.formats.splats.formats import SplatFormat, WriteRequest


def to_bytes(request: WriteRequest) -> bytes:
    """Gaussians at the moment of the request, metres in the axes named below; colours and opacity in [0, 1]."""
    cloud = request.cloud
    colors = (cloud.sh[:, 0] * C0 + 0.5).clip(0, 1)
    text = io.StringIO()
    np.savetxt(text, np.column_stack([cloud.means, colors, cloud.opacity]), "%.4f")
    return text.getvalue().encode()


# Suffix, axes (x forward, y left, z up), writer, no reader; nothing is carried: `mudg export` says what is lost.
FORMAT = SplatFormat((".xyz",), "FLU", to_bytes, None, frozenset())
