"""When a fit does what: learning rates, densification and rounds of box corrections as functions of the step.

Steps count from 1 to the length of the run; a fit that goes on with a finished one begins in the middle (``fitting/continued.py``).
"""

from __future__ import annotations

import math

import numpy as np

from mudg.models.scene.densify import DensifySettings
from mudg.models.scene.mcmc import McmcSettings
from mudg.stages.config import FitConfig

PUBLISHED_STEPS = 30_000
FIELD_STEPS = 55_000
"""Published steps of the field of ``s3gaussian``, whose rates a shorter run raises more than in proportion, within bounds: the field
starts from nothing and has as far to go, and every time is seen by few of the steps."""
LAST_DENSIFIED = 0.6
"""Share of the run after which Gaussians are no longer added."""
LAST_POSE_ROUND = 0.85


def learning_rates(step: int, iterations: int) -> dict[str, float]:
    """Learning rate of every column at a step (from 1).

    Published rates belong to 30,000 steps. A shorter run takes larger steps, by the square root of the ratio and at most
    4 times; positions decay to a hundredth over the run, scales and colours to a fifth.
    """
    boost = min(4.0, math.sqrt(max(1.0, PUBLISHED_STEPS / iterations)))
    along = step / max(1, iterations)
    decay, gentle = 0.01**along, 0.2**along
    field = max(1.0, FIELD_STEPS / iterations) ** 1.5
    return {
        "means": 1.6e-4 * 10.0 * boost * decay,
        "quats": 1e-3 * boost,
        "log_scales": 5e-3 * boost * gentle,
        "logits": 5e-2 * math.sqrt(boost),
        "sh_dc": 2.5e-3 * boost * gentle,
        "sh_rest": 1.25e-4 * boost * gentle,
        "semantics": 1e-2 * boost,
        "panorama": 1e-2 * gentle,
        "deform": 1e-3 * boost * gentle,
        "network": 1e-3 * gentle,
        "embeddings": 1e-3 * gentle,
        "planes": min(0.03, 1.6e-4 * field) * 0.1**along,
        "plane_network": min(0.003, 1.6e-5 * field) * 0.1**along,
        "curve": 1.6e-3 * 10.0 * boost * decay,
        "trajectory": 1.6e-5 * 10.0 * boost * decay,
        "tau": 8e-4 * boost * decay,
        "log_beta": 2e-3 * boost,
        "velocity": 1e-3 * 10.0 * boost,
    }


def appearance_rates(step: int, iterations: int) -> dict[str, float]:
    """Learning rates of the corrections of appearance at a step (from 1)."""
    gentle = 0.2 ** (step / max(1, iterations))
    return {"affine": 2e-3 * gentle, "shift": 1e-3 * gentle, "turn": 1e-4 * gentle}


def densify_schedule(config: FitConfig, last: float = LAST_DENSIFIED) -> DensifySettings | McmcSettings | None:
    """The published schedules, scaled to the iterations; None without densification.

    gradient: from 500, every 100, until ``last`` of the run, opacity reset every 3000. mcmc: the same rounds until 0.8.
    """
    total = config.iterations
    every = max(10, min(100, total // 20))
    start = max(every, min(500, total // 10))
    if config.densify.kind == "mcmc":
        return McmcSettings(start, int(0.8 * total), every, max_rows=config.densify.max_gaussians)
    if config.densify.kind == "none":
        return None
    return DensifySettings(
        start,
        stop := int(last * total),
        every,
        max_rows=config.densify.max_gaussians,
        reset_every=3000 if total >= 10_000 else 0,
        late=stop // 2,
    )


def pose_round_due(config: FitConfig, step: int) -> bool:
    """Whether boxes are corrected after a step."""
    poses = config.poses
    if not poses.learn or not poses.rounds:
        return False
    shares = np.linspace(poses.start, max(poses.start, LAST_POSE_ROUND), poses.rounds)
    return step in {max(1, round(float(share) * config.iterations)) for share in shares}
