"""Small clouds and scenes of Gaussians for tests of file formats."""

from __future__ import annotations

import numpy as np

from mudg.base import geometry
from mudg.formats.splats import formats
from mudg.formats.splats.cloud import SplatCloud, SplatNode, SplatScene


def cloud(count: int = 3, degree: int = 0, seed: int = 0, classes: bool = False, spread: float = 10.0) -> SplatCloud:
    """Random Gaussians; the first one is large, solid and unrotated."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    quats[0] = (1, 0, 0, 0)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    sh = (rng.normal(size=(count, (degree + 1) ** 2, 3)) * 0.3).clip(-0.9, 0.9)  # SPZ holds -1 to 1
    means, logs = rng.uniform(-spread, spread, (count, 3)), rng.uniform(-5, 0, (count, 3))
    columns = (means, quats, logs, rng.uniform(-4, 4, count), sh)
    ids = rng.integers(0, 19, count).astype(np.uint8) if classes else None
    return SplatCloud(*(values.astype(np.float32) for values in columns), ids)


def still(given: SplatCloud, axes: np.ndarray | None = None, **facts: object) -> SplatScene:
    """A scene of one cloud; ``axes``: file-from-world."""
    turned = {} if axes is None else {"file_from_world": axes}
    return SplatScene("toy", (SplatNode("background", given),), facts=facts, **turned)


def written(name: str, given: SplatCloud, axes: np.ndarray | None = None, **facts: object) -> bytes:
    """A cloud as a file of a format; not turned, unless ``axes`` say so."""
    return formats.FORMATS[name].write(formats.WriteRequest(still(given, axes, **facts), 0.0))


def scene(degree: int = 0, count: int = 5) -> SplatScene:
    """What stands; a car that turns while it drives from -0.5 s to 1 s; a person who bends, from 0 s on; a sky."""
    times = np.array([-0.5, 0.25, 1.0])
    car = np.stack([geometry.yaw_matrix(yaw, (4 * t, 1.0, 0.8)) for yaw, t in zip((0.0, 0.6, 1.5), times, strict=True)])
    walk = np.array([0.0, 0.5])
    person = np.stack([geometry.yaw_matrix(-0.4, (2 + t, -3.0, 0.9)) for t in walk])
    bend = np.random.default_rng(5).normal(size=(2, count, 3)).astype(np.float32) * 0.1
    sky = np.random.default_rng(6).integers(0, 255, (4, 8, 3)).astype(np.uint8)
    nodes = (
        SplatNode("background", cloud(2 * count, degree, 1, True)),
        SplatNode("car-1", cloud(count, degree, 2, True, 1.5), "car", (4.0, 1.8, 1.5), times, car),
        SplatNode("1 person", cloud(count, degree, 3, True, 0.5), "pedestrian", (0.6, 0.6, 1.8), walk, person, bend),
    )
    return SplatScene("toy", nodes, sky=sky, facts={"method": "test"})
