"""A small fitted scene made by hand, of everything that the viewer page draws: a static street, a car, a person that
deforms, a sky."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from toy_scene import CAR_SIZE_M, ToyStreet

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import Scene
from mudg.core.table import Table
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import DEFORM_CELLS, DeformableNode, RigidNode, SkyNode, StaticNode
from mudg.gaussians.storage import save_model

CLASSES = (ID["road"], ID["building"], ID["vegetation"], ID["sky"], ID["person"], ID["car"])
PERSON_M = (0.8, 0.8, 1.8)
STREET = ToyStreet(car_start=(9.0, 1.5), car_velocity=(4.0, 0.0), times=[0.2 * n for n in range(5)])


def toy_fitted(degree: int = 3, seed: int = 0) -> SceneModel:
    """About 900 Gaussians with random shapes and, above degree 0, colours that depend on the direction of view."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(2, 25, 420), rng.uniform(-8, 8, 420), rng.normal(0, 0.02, 420)])
    wall = np.column_stack([rng.normal(25, 0.05, 300), rng.uniform(-10, 10, 300), rng.uniform(0, 4, 300)])
    car = rng.uniform(-0.5, 0.5, (120, 3)) * CAR_SIZE_M
    person = rng.uniform(-0.5, 0.5, (60, 3)) * PERSON_M
    groups = (ground, wall, car, person)
    counts, classes = [len(g) for g in groups], (0, 1, 5, 4)
    n = sum(counts)
    sizes = np.repeat([0.45, 0.5, 0.2, 0.12], counts)[:, None] * rng.uniform(0.4, 1.6, (n, 3))
    sizes[: counts[0], 2] *= 0.1
    base = np.repeat([[0.35, 0.35, 0.38], [0.6, 0.4, 0.3], [0.8, 0.7, 0.15], [0.2, 0.3, 0.7]], counts, 0)
    logits = rng.normal(-4, 1, (n, len(CLASSES)))
    logits[np.arange(n), np.repeat(classes, counts)] += 7
    columns = {
        "means": np.concatenate(groups),
        "quats": rng.normal(size=(n, 4)),
        "log_scales": np.log(sizes),
        "logits": rng.normal(1.5, 1.5, n),
        "sh_dc": ((base + rng.normal(0, 0.15, (n, 3)) - 0.5) / 0.28209479)[:, None],
        "semantics": logits,
    }
    if degree:
        columns["sh_rest"] = rng.normal(0, 0.08, (n, (degree + 1) ** 2 - 1, 3))
    labels = {
        "node": torch.from_numpy(np.repeat([0, 0, 1, 2], counts).astype(np.int32)),
        "certainty": torch.from_numpy(rng.uniform(0, 1, n).astype(np.float16)),
    }
    table = Table({name: torch.from_numpy(np.asarray(value, np.float32)) for name, value in columns.items()}, labels)
    sky = SkyNode.uniform(8)
    fade, tint = torch.linspace(0.9, 0.3, 8)[:, None], torch.tensor([0.6, 0.8, 1.0])[:, None, None]
    sky.table.columns["panorama"] = (tint * fade * torch.ones(8, 16))[None]
    facts = {"method": "street_gaussians", "scene": "toy-street", "classes": [], "drawing": {"antialias": True}}
    nodes = (StaticNode(), RigidNode.from_track(STREET.track()), _person(rng))
    return SceneModel(table, nodes, sky, CLASSES, degree, facts)


def _person(rng: np.random.Generator) -> DeformableNode:
    """Walks across the street, turning, from the second time on; its limbs move by up to 20 cm."""
    times = np.array(STREET.times[1:])
    poses = np.stack([geometry.yaw_matrix(2 * t, (7.0, -2.0 + 2 * t, 0.9)) for t in times])
    node = DeformableNode("<script>alert(1)</script>", "pedestrian", PERSON_M, times, poses)
    along, across, up = (cells + 1 for cells in DEFORM_CELLS)
    deform = rng.uniform(-0.2, 0.2, (len(times), 3, up, across, along)).astype(np.float32)
    node.offsets.columns["deform"] = torch.from_numpy(deform)
    return node


def write_toy_run(
    root: Path, degree: int = 3, width: int = 160, height: int = 96
) -> tuple[Path, Path, Scene, SceneModel]:
    """The scene folder and the fit folder of the toy, with what is in them."""
    scene = STREET.write(root / "scene", width=width, height=height)
    model = toy_fitted(degree)
    save_model(model, root / "fit")
    return root / "scene", root / "fit", scene, model
