"""Densification by screen gradient: add Gaussians where the image lacks detail, remove those without effect.

The published schedule (Kerbl 2023, with the thresholds of Street Gaussians): rows whose mean screen gradient exceeds a
threshold are cloned (small) or split in two (large); rows that are transparent, grown out of proportion, or have left
their box are removed; now and then opacities are pulled down so that what is not needed fades. The background is judged
by absolute gradients (AbsGS: contributions of single pixels do not cancel), objects by plain ones. Where the budget is
short, rows with the largest gradients go first. Only recorded views count.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mudg.base import seeds
from mudg.base.types import RasterTrace
from mudg.core.harmonics import rotate
from mudg.core.table import Table
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import RigidNode

SPLIT_SHRINK = 1.6
"""Both halves of a split Gaussian are this much smaller (published value)."""
LARGEST_M, BOX_MARGIN = 8.0, 1.25
"""Larger rows are removed, and object rows outside this many half-sizes of their box (plus 0.1 m)."""
RESET_OPACITY = 0.01
TIME_GRADIENT = 2e-3
"""Threshold on the mean gradient of ``tau``, for Gaussians that have one (``baselines/pvg.py``)."""


@dataclass(frozen=True)
class DensifySettings:
    """When and how to densify: after every step (from 1) from ``start`` to ``stop`` that is a multiple of ``every``.
    ``max_rows``: growth stops here. ``growth``: at most this share of the rows is added at a time. ``least_opacity``:
    rows below are removed. ``static_gradient``, ``object_gradient``: thresholds on the mean absolute screen gradient,
    in units of half the image (as published). ``split_above_m``: rows whose largest scale exceeds this are split,
    smaller ones cloned. ``reset_every``: steps between opacity resets (to ``RESET_OPACITY``), 0 = never. ``late``: step
    from which splits of Gaussians with a life span give three children with shorter lives, not two."""

    start: int
    stop: int
    every: int
    max_rows: int = 150_000
    growth: float = 0.3
    least_opacity: float = 0.005
    static_gradient: float = 6e-4
    object_gradient: float = 2e-4
    split_above_m: float = 0.2
    reset_every: int = 0
    late: int = 0

    def due(self, step: int) -> bool:
        """Whether rows change after step ``step``."""
        return self.start <= step <= self.stop and step % self.every == 0

    def reset_due(self, step: int) -> bool:
        """Whether to pull opacities down after step ``step``."""
        return self.reset_every > 0 and self.start <= step <= self.stop and step % self.reset_every == 0


@dataclass
class DensifyStats:
    """What was seen of each row since the last densification: ``gradient`` f32[N] (sum), ``seen`` f32[N] (views);
    ``time`` f32[N], the sum of the gradient of ``tau``, where Gaussians have one."""

    gradient: Tensor
    seen: Tensor
    time: Tensor | None = None

    @classmethod
    def zeros(cls, rows: int, device: torch.device | None = None) -> DensifyStats:
        """Nothing seen yet; ``device``: that of the rows (None: the CPU)."""
        return cls(torch.zeros(rows, device=device), torch.zeros(rows, device=device))

    def to(self, device: torch.device) -> DensifyStats:
        """The same statistics on a device."""
        return DensifyStats(**{name: value.to(device) for name, value in self.state().items()})

    def observe(
        self,
        trace: RasterTrace,
        width: int,
        height: int,
        plain_from: int | None = None,
        time_gradient: Tensor | None = None,
    ) -> None:
        """Add one backward pass (gradients in pixels; stored in units of half the image). ``trace``: of a render with
        absolute gradients, after backward. ``plain_from``: rows from here on (those of the objects) count with their
        plain gradient, where the contributions of single pixels cancel; None = all rows with the absolute one.
        ``time_gradient``: f32[N], that of ``tau``, or None."""
        if trace.abs_grad2d is None:
            raise ValueError("the render was made without absolute gradients")
        gradient = trace.abs_grad2d
        if plain_from is not None and plain_from < len(gradient) and trace.means2d.grad is not None:
            gradient = torch.cat([gradient[:plain_from], trace.means2d.grad[plain_from:]])
        visible, (across, down) = trace.visible, gradient.unbind(1)
        # far faster than a norm over rows of two
        length = torch.complex(across * (width / 2), down * (height / 2)).abs()
        self.gradient += length * visible
        self.seen += visible
        if time_gradient is not None:
            before = torch.zeros_like(self.gradient) if self.time is None else self.time
            self.time = before + time_gradient.abs() * visible

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @classmethod
    def from_state(cls, tensors: Mapping[str, Tensor]) -> DensifyStats:
        """Inverse of ``state``."""
        return cls(**{name: value.clone() for name, value in tensors.items()})


def densify(
    model: SceneModel, stats: DensifyStats, step: int, settings: DensifySettings, run_seed: int
) -> dict[str, Any]:
    """Clone, split and prune rows of the model's table in place; the caller starts new statistics. ``step``: finished
    steps; with ``run_seed`` it decides all random draws. Returns counts: ``cloned``, ``split``, ``pruned``, ``rows``
    (after)."""
    grow = _rows_to_grow(model, stats, settings)
    large = model.table["log_scales"].detach().amax(1).exp() > settings.split_above_m
    if stats.time is not None:
        world = model.nodes[0]
        hurried = stats.time / stats.seen.clamp_min(1) >= TIME_GRADIENT
        large |= hurried & (model.table["log_beta"].detach().exp() > world.short_life)
    split_rows = (grow & large).nonzero()[:, 0]
    clone_rows = (grow & ~large).nonzero()[:, 0]
    keep = torch.ones(len(model.table), dtype=torch.bool, device=model.device)
    keep[split_rows] = False
    for born in (copied_rows(model.table, clone_rows), *_halves(model, split_rows, step, run_seed, settings)):
        model.table.append(*born)
    keep = torch.cat([keep, keep.new_ones(len(model.table) - len(keep))])
    doomed = useless_rows(model, settings)
    pruned = int((doomed & keep).sum())
    model.table.take(keep & ~doomed)
    model.sort_rows()
    return {"cloned": len(clone_rows), "split": len(split_rows), "pruned": pruned, "rows": len(model.table)}


def reset_opacity(model: SceneModel) -> None:
    """Pull every opacity down to at most ``RESET_OPACITY`` and forget its moments."""
    ceiling = torch.logit(torch.tensor(RESET_OPACITY))
    model.table.columns["logits"].detach().clamp_(max=float(ceiling))
    model.table.reset_moments("logits")


def shorten_needles(table: Table, longest_to_middle: float) -> None:
    """Cut every Gaussian's longest axis down to ``longest_to_middle`` times its middle one, in place.

    Cameras that all move along one line cannot tell a long thin Gaussian along that line from the right one; from the
    side it sticks out. Discs (two long axes) stay.
    """
    scales = table.columns["log_scales"].detach()
    middle = scales.median(1, keepdim=True).values
    torch.minimum(scales, middle + torch.log(torch.tensor(longest_to_middle)), out=scales)


def _rows_to_grow(model: SceneModel, stats: DensifyStats, settings: DensifySettings) -> Tensor:
    """Bool[N]: rows over their threshold, the strongest first where the budget is short."""
    mean = stats.gradient / stats.seen.clamp_min(1)
    is_static = torch.tensor([not isinstance(node, RigidNode) for node in model.nodes]).to(model.device)
    static = is_static[model.table.labels["node"].long()]
    relative = mean / torch.where(static, settings.static_gradient, settings.object_gradient)
    if stats.time is not None:
        relative = torch.maximum(relative, stats.time / stats.seen.clamp_min(1) / TIME_GRADIENT)
    wanted = relative > 1
    budget = min(settings.max_rows - len(model.table), int(settings.growth * len(model.table)))
    if budget <= 0:
        return torch.zeros_like(wanted)
    if int(wanted.sum()) > budget:
        order = torch.sort(relative, descending=True, stable=True).indices[:budget]
        wanted = torch.zeros_like(wanted)
        wanted[order] = True
    return wanted


def copied_rows(table: Table, rows: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Columns and labels of the rows with the numbers i64[n], as ``Table.append`` takes them."""
    columns = {name: value.detach()[rows] for name, value in table.columns.items()}
    return columns, {name: value[rows] for name, value in table.labels.items()}


def _halves(
    model: SceneModel, rows: Tensor, step: int, run_seed: int, settings: DensifySettings
) -> list[tuple[dict[str, Tensor], dict[str, Tensor]]]:
    """Two smaller Gaussians drawn from each split one (centres sampled from its own density, times of those that have a
    life span too; of these three, late)."""
    halves, timed, world = [], "tau" in model.table.columns, model.nodes[0]
    late = timed and 0 < settings.late <= step
    for half in range(3 if late else 2):
        columns, labels = copied_rows(model.table, rows)
        generator = seeds.torch_generator(run_seed, step, f"split half {half}")
        # drawn on the CPU: the same on every device
        noise = torch.randn(len(rows), 3, generator=generator).to(rows.device)
        local = torch.exp(columns["log_scales"]) * noise
        columns["means"] = columns["means"] + rotate(columns["quats"], local)
        columns["log_scales"] = columns["log_scales"] - torch.log(torch.tensor(SPLIT_SHRINK))
        if timed:
            drawn = torch.randn(len(rows), generator=seeds.torch_generator(run_seed, step, f"split time {half}"))
            columns = world.born_later(columns, drawn.to(rows.device), late)
        halves.append((columns, labels))
    return halves


def useless_rows(model: SceneModel, settings: DensifySettings) -> Tensor:
    """Bool[N]: transparent, oversized, not finite, or outside the box that it belongs to."""
    table = model.table
    means = table["means"].detach()
    doomed = torch.sigmoid(table["logits"].detach()) < settings.least_opacity
    doomed |= table["log_scales"].detach().amax(1).exp() > LARGEST_M
    doomed |= ~torch.isfinite(means).all(1)
    half_size = torch.full((len(model.nodes), 3), torch.inf)
    for index, node in enumerate(model.nodes):
        if isinstance(node, RigidNode):
            half_size[index] = torch.tensor(node.size_m) / 2 * BOX_MARGIN + 0.1
    return doomed | (means.abs() > half_size.to(model.device)[table.labels["node"].long()]).any(1)


def densify_if_due(
    model: SceneModel, stats: DensifyStats, schedule: DensifySettings | None, step: int, run_seed: int
) -> dict[str, Any]:
    """What the schedule has for a step, after the optimiser's; a report if rows changed: new statistics begin then."""
    report: dict[str, Any] = {}
    if schedule is None:
        return report
    if schedule.due(step):
        report = densify(model, stats, step, schedule, run_seed)
    if schedule.reset_due(step):
        reset_opacity(model)
    return report
