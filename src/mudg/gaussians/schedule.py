"""The loop of a fit, and when it does what: learning rates, densification and rounds of box corrections as functions of
the step. Steps count from 1; a fit that goes on with a finished one begins in the middle (``gaussians/storage.py``)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mudg.base import checkpoint, log
from mudg.base.errors import NumericsError
from mudg.base.processes import Interruption
from mudg.base.run_folder import RunDir
from mudg.gaussians.corrections import Appearance
from mudg.gaussians.densify import DensifySettings
from mudg.gaussians.model import SceneModel
from mudg.gaussians.settings import DensifyConfig, FitConfig, StartConfig

# the loop -----------------------------------------------------------------------------------------

LOG_EVERY = 20


@dataclass(kw_only=True)
class Progress:
    """How far a fit is: finished steps, their seconds, and the numbers of the last one that was logged."""

    step: int = 0
    seconds: float = 0.0
    last: Mapping[str, float] | None = None

    def facts(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"seconds": self.seconds, "last": dict(self.last or {})}

    def resume(self, found: checkpoint.Checkpoint) -> None:
        """Inverse of ``facts``."""
        self.step, self.seconds, self.last = found.step, float(found.state["seconds"]), found.state["last"]

    def summary(self) -> dict[str, Any]:
        """For run.json; the first entry is the size of what is fitted."""
        raise NotImplementedError


def run_steps(
    state: Progress,
    config: FitConfig,
    folder: RunDir,
    take: Callable[[int], tuple[dict[str, Any], Callable[[], dict[str, float]]]],
    save: Callable[[], None],
    draw: Callable[[Path], None],
) -> None:
    """Take steps up to ``config.iterations``, with log, checkpoints and pictures. Ctrl-C (or SIGTERM) is taken at the
    end of a step: checkpoint, then KeyboardInterrupt. ``take``: does a step and returns facts for the log and what
    makes its numbers; ``rows`` among the facts, after densification, are always logged."""
    pace = checkpoint.Pace()
    with log.task(f"fit {config.method}", config.iterations, state.step) as bar, Interruption() as interruption:
        while state.step < config.iterations:
            began, step = time.perf_counter(), state.step + 1
            facts, numbers = take(step)
            state.step, state.seconds = step, state.seconds + time.perf_counter() - began
            if step % LOG_EVERY == 0 or step == config.iterations or "rows" in facts:
                state.last = numbers()
                folder.log(step=step, seconds=round(state.seconds, 3), **facts, **state.last)
                shown = f"psnr {state.last['psnr']:.1f}, " if "psnr" in state.last else ""
                what, size = next(iter(state.summary().items()))
                bar.update(f"{shown}{size} {what}")
            if step % config.preview_every == 0 or step == config.iterations:
                draw(folder.path / "preview" / f"{step:06d}.png")
            if interruption.requested or (step % config.checkpoint_every == 0 and pace.due()):
                with pace.saving():
                    save()
            bar.advance()
            if interruption.requested:
                folder.pause(state.summary())
                interruption.stop_now()


# finite -------------------------------------------------------------------------------------------
#
# Nothing that is not finite reaches the parameters: loss terms and gradients are checked before every step of the
# optimiser. To look at a number on another device means waiting for all that was sent there, so those of a whole step
# are gathered and come back in one copy.

SCENE_REMEDY = "the parameters are those of the step before; report the scene, or leave this view out"
VIEW_REMEDY = "the parameters are those of the step before; leave this view out"
TERM_REMEDY = "check this view's image and labels; the parameters are those of the step before"


class FiniteCheck:
    """The numbers of one step that must be finite, in the order in which they were computed. ``step``: for messages."""

    def __init__(self, step: int) -> None:
        self._step = step
        self._facts: list[tuple[Tensor, str, str, str, Tensor, Callable[[], None]]] = []
        """Of each number: itself, what it is, where, the remedy, what it is the sum of, and what drops that."""

    def _add(self, what: str, where: str, remedy: str, values: Tensor, drop: Callable[[], None]) -> None:
        number, where = values.detach().sum(), f"{where}, step {self._step}"
        self._facts.append((number, what, where, remedy, values.detach(), drop))

    def terms(self, view: str, terms: Mapping[str, Tensor]) -> None:
        """Add the loss terms of a view."""
        for name, value in terms.items():
            self._add(f"the loss term {name!r}", f"view {view}", TERM_REMEDY, value, lambda: None)

    def sums(self, view: str, gradients: Mapping[str, Tensor], remedy: str, drop: Callable[[], None]) -> None:
        """Add gradients after the backward pass of a view, by their sums: the cheapest pass over memory there is."""
        for name, gradient in gradients.items():
            self._add("a gradient", f"{name}, view {view}", remedy, gradient, drop)

    def gradients(self, view: str, model: SceneModel, appearance: Appearance) -> None:
        """Add those of everything that a fit learns."""
        learnt = {"gaussians": model.table, **model.node_tables()}
        learnt |= {f"appearance {group}": table for group, table in appearance.tables.items()}
        for owner, table in learnt.items():
            named = {f"{owner}.{name}": gradient for name, gradient in table.gradients().items()}
            remedy = VIEW_REMEDY if owner.startswith("appearance ") else SCENE_REMEDY
            self.sums(view, named, remedy, table.clear_gradients)

    def refuse(self) -> None:
        """NumericsError naming the first of the numbers that is not finite, if there is one; no parameter has been
        touched."""
        facts, self._facts = self._facts, []
        numbers = torch.stack([fact[0] for fact in facts]).tolist() if facts else []
        for number, (_, what, where, remedy, values, drop) in zip(numbers, facts):
            count = 0 if math.isfinite(number) else int((~torch.isfinite(values)).sum())
            if count:  # else at most the sum overflowed
                drop()
                got = f"{count} values" if values.ndim else str(number)
                raise NumericsError(f"{what} is not finite", where=where, got=got, remedy=remedy)


# short fits: good enough to learn from what a fit gets wrong, in a few seconds --------------------

MOST_GAUSSIANS, VOXEL_M = 40_000, 0.25
"""Gaussians at most, and the cubes of which each starts one, metres."""
WIDTHS = 2
"""Photographs are fitted at this many times the width of the clips that the renders are for."""


def short_fit(iterations: int, clip_width_px: int, camera_width_px: int, seed: int, device: str = "cpu") -> FitConfig:
    """A fit to recorded views alone, for renders in the conditions of clips `clip_width_px` wide."""
    width_px = min(WIDTHS * clip_width_px, camera_width_px)
    own = {"iterations": iterations, "width_px": width_px, "seed": seed, "device": device, "preview_every": 1_000_000}
    few = {
        "densify": DensifyConfig(max_gaussians=MOST_GAUSSIANS),
        "start": StartConfig(gaussians=MOST_GAUSSIANS, voxel_m=VOXEL_M),
    }
    return FitConfig(method="street_gaussians", **own, **few)


# schedule -----------------------------------------------------------------------------------------

PUBLISHED_STEPS = 30_000
FIELD_STEPS = 55_000
"""Published steps of the field of ``s3gaussian``, whose rates a shorter run raises more than in proportion, within
bounds: the field starts from nothing and has as far to go, and every time is seen by few of the steps."""
LAST_DENSIFIED = 0.6
"""Share of the run after which Gaussians are no longer added."""
LAST_POSE_ROUND = 0.85


def learning_rates(step: int, iterations: int) -> dict[str, float]:
    """Learning rate of every column at a step (from 1).

    Published rates belong to 30,000 steps. A shorter run takes larger steps, by the square root of the ratio and at
    most 4 times; positions decay to a hundredth over the run, scales and colours to a fifth.
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


def densify_schedule(config: FitConfig, last: float = LAST_DENSIFIED) -> DensifySettings | None:
    """The published schedule, scaled to the iterations: from 500, every 100, until ``last`` of the run, opacity reset
    every 3000; None without densification."""
    total, most = config.iterations, config.densify.max_gaussians
    every = max(10, min(100, total // 20))
    start = max(every, min(500, total // 10))
    if config.densify.kind == "none":
        return None
    stop, reset_every = int(last * total), 3000 if total >= 10_000 else 0
    return DensifySettings(start, stop, every, most, reset_every=reset_every, late=stop // 2)


def pose_round_due(config: FitConfig, step: int) -> bool:
    """Whether boxes are corrected after a step."""
    poses = config.poses
    if not poses.learn or not poses.rounds:
        return False
    shares = np.linspace(poses.start, max(poses.start, LAST_POSE_ROUND), poses.rounds)
    return step in {max(1, round(float(share) * config.iterations)) for share in shares}
