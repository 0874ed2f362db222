"""Densification by screen gradient: add Gaussians where the image lacks detail, remove those without effect.

The published schedule (Kerbl 2023, with the thresholds of Street Gaussians): every ``every`` steps rows whose mean
screen gradient exceeds a threshold are cloned (small) or split in two (large); rows that are transparent, grown out of
proportion, or have left their box are removed; now and then opacities are pulled down so that what is not needed fades.
The background is judged by absolute gradients (AbsGS: contributions of single pixels do not cancel), objects by plain
ones. Growth is bounded by ``max_rows``: the rows with the largest gradients go first.

State is explicit: statistics belong to rows of the table, the schedule is a function of the step. The caller chooses
the views that count (``gaussians/fit.py``: recorded views only, see ``Observation.kind``). ``gaussians/densify.py`` is
the alternative.
"""

from __future__ import annotations

import functools
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


@dataclass(frozen=True)
class Rounds:
    """When rows change, and what is never kept. Steps count from 1.

    Args:
        start, stop, every: rows change after step s when start <= s <= stop and s is a multiple of ``every``.
        max_rows: growth stops here. growth: at most this share of the present rows is added at a time.
        least_opacity: rows below are removed (mcmc: relocated). prune_scale_m: so are larger rows.
        box_margin: and object rows outside this many half-sizes of their box.
    """

    start: int
    stop: int
    every: int
    max_rows: int = 150_000
    growth: float = 0.3
    least_opacity: float = 0.005
    prune_scale_m: float = 8.0
    box_margin: float = 1.25

    def due(self, step: int) -> bool:
        """Whether rows change after step ``step`` (from 1)."""
        return self.start <= step <= self.stop and step % self.every == 0


@dataclass(frozen=True)
class DensifySettings(Rounds):
    """When and how to densify.

    Args:
        static_gradient, object_gradient: thresholds on the mean absolute screen gradient, in units of half the image
            (published: 6e-4 for the background, 2e-4 for objects).
        split_above_m: rows whose largest scale exceeds this are split, smaller ones cloned.
        reset_every: steps between opacity resets, 0 = never. reset_opacity: the value opacities are pulled down to.
        time_gradient: threshold on the mean gradient of ``tau``, for Gaussians that have one (``baselines/pvg.py``).
        late: step from which their splits give three children with shorter lives, not two.
    """

    static_gradient: float = 6e-4
    object_gradient: float = 2e-4
    split_above_m: float = 0.2
    reset_every: int = 0
    reset_opacity: float = 0.01
    time_gradient: float = 2e-3
    late: int = 0

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
        return DensifyStats(
            self.gradient.to(device), self.seen.to(device), None if self.time is None else self.time.to(device)
        )

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
        half_size = _half_size(width, height, gradient.device)
        visible = trace.visible
        length = torch.view_as_complex(gradient * half_size).abs()  # far faster than a norm over rows of two
        self.gradient += length * visible
        self.seen += visible
        if time_gradient is not None:
            before = torch.zeros_like(self.gradient) if self.time is None else self.time
            self.time = before + time_gradient.abs() * visible

    def state(self) -> dict[str, Tensor]:
        """For a checkpoint."""
        return {"gradient": self.gradient, "seen": self.seen, **({} if self.time is None else {"time": self.time})}

    @classmethod
    def from_state(cls, tensors: Mapping[str, Tensor]) -> DensifyStats:
        """Inverse of ``state``."""
        return cls(
            tensors["gradient"].clone(), tensors["seen"].clone(), tensors["time"].clone() if "time" in tensors else None
        )


@functools.lru_cache(maxsize=64)
def _half_size(width: int, height: int, device: torch.device) -> Tensor:
    """Half an image's width and height, sent to a device once."""
    return torch.tensor([width / 2, height / 2]).to(device)


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
        hurried = stats.time / stats.seen.clamp_min(1) >= settings.time_gradient
        large |= hurried & (model.table["log_beta"].detach().exp() > world.short_life)
    split_rows = (grow & large).nonzero()[:, 0]
    clone_rows = (grow & ~large).nonzero()[:, 0]
    keep = torch.ones(len(model.table), dtype=torch.bool, device=model.device)
    keep[split_rows] = False
    for columns, labels in (
        copied_rows(model.table, clone_rows),
        *_halves(model, split_rows, step, run_seed, settings),
    ):
        model.table.append(columns, labels)
    keep = torch.cat([keep, keep.new_ones(len(model.table) - len(keep))])
    doomed = useless_rows(model, settings)
    pruned = int((doomed & keep).sum())
    model.table.take(keep & ~doomed)
    model.sort_rows()
    return {"cloned": len(clone_rows), "split": len(split_rows), "pruned": pruned, "rows": len(model.table)}


def reset_opacity(model: SceneModel, settings: DensifySettings) -> None:
    """Pull every opacity down to at most ``settings.reset_opacity`` and forget its moments."""
    ceiling = torch.logit(torch.tensor(settings.reset_opacity))
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
    static = torch.tensor([not isinstance(node, RigidNode) for node in model.nodes]).to(model.device)[
        model.table.labels["node"].long()
    ]
    relative = mean / torch.where(static, settings.static_gradient, settings.object_gradient)
    if stats.time is not None:
        relative = torch.maximum(relative, stats.time / stats.seen.clamp_min(1) / settings.time_gradient)
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


def useless_rows(model: SceneModel, settings: Rounds) -> Tensor:
    """Bool[N]: transparent, oversized, not finite, or outside ``box_margin`` times the box it belongs to (plus 0.1
    m)."""
    table = model.table
    means = table["means"].detach()
    doomed = torch.sigmoid(table["logits"].detach()) < settings.least_opacity
    doomed |= table["log_scales"].detach().amax(1).exp() > settings.prune_scale_m
    doomed |= ~torch.isfinite(means).all(1)
    half_size = torch.full((len(model.nodes), 3), torch.inf)
    for index, node in enumerate(model.nodes):
        if isinstance(node, RigidNode):
            half_size[index] = torch.tensor(node.size_m) / 2 * settings.box_margin + 0.1
    return doomed | (means.abs() > half_size.to(model.device)[table.labels["node"].long()]).any(1)


# mcmc ---------------------------------------------------------------------------------------------
#
# Densification as sampling: Gaussians without effect move to where others are, and their number stays below a cap.
#
# 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024). Every ``every`` steps
#
# * *relocation*: dead rows (transparent, oversized, outside their box) become copies of live rows of the **same node**,
#   drawn in proportion to opacity;
# * *growth*: a few per cent more copies, until the cap is reached.
#
# Where a Gaussian becomes N, opacity and scale of all N are corrected so that the stack looks as the one did
# (``stack_of``). At every step the centres of nearly transparent Gaussians take a random step along their own axes
# (``drift``): dead ones look for a better place. Two regularisers of the fit (``opacity_weight``, ``scale_weight``) let
# the unneeded fade.
#
# Three choices differ from the published form. Copies are drawn systematically (one random number per round, rows in
# the order of their place), not independently: the same expectation, less scatter, and independent of the order of the
# rows. A stack never gets so many members that they would be dead at once. The random step is bounded by the Gaussian's
# own size.

LARGEST_STACK = 51
"""Most Gaussians that one may become in a round (published value)."""
SURE_OPACITY = 1 - 1e-6
"""Opacities count as at most this: a stack of finitely many cannot be wholly opaque."""


@dataclass(frozen=True)
class McmcSettings(Rounds):
    """When and how: dead rows are relocated, and the table grows to ``max_rows``.

    Args:
        step_per_m2: size of the random step: a Gaussian of scale s moves by ``rate * step_per_m2 * s^2`` along that
            axis, where ``rate`` is the learning rate of the centres in metres; never by more than s. The published 5e5
            belongs to scenes scaled to unit size; the learning rates here belong to scenes of 10 m.
        gate_sharpness, gate_opacity: the step fades with ``sigmoid(sharpness * (gate_opacity - opacity))``.
    """

    growth: float = 0.05
    step_per_m2: float = 5e3
    gate_sharpness: float = 100.0
    gate_opacity: float = 0.005


def stack_of(opacity: Tensor, members: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale factor of each of N equal Gaussians that together look like one.

    Behind each other, N Gaussians of opacity ``o'`` let ``(1 - o' g)^N`` through, ``g`` their fall-off. ``o'`` makes
    that ``1 - o`` at the centre. The scale factor keeps the integral of the covered share along a line through the
    centre: ``o / sum_k binomial(N, k) (-1)^(k - 1) o'^k / sqrt(k)`` (Kheradmand et al. 2024, eq. 9, with the inner sum
    carried out). ``opacity``: f64[M] of the one Gaussian, in (0, 1). ``members``: i64[M], N >= 1, at most
    ``LARGEST_STACK``. Returns opacity f64[M] of each member, and what its scales are multiplied with, f64[M]."""
    opacity = opacity.double().clamp(max=SURE_OPACITY)
    count = members.double()
    each = -torch.expm1(torch.log1p(-opacity) / count)
    most = int(members.max()) if len(members) else 1
    term, total = torch.ones_like(each), torch.zeros_like(each)
    for k in range(1, most + 1):  # term = binomial(N, k) (-1)^(k - 1) o'^k, zero beyond k = N
        term = term * each * (count - (k - 1)) / k * (1.0 if k == 1 else -1.0)
        total = total + term * k**-0.5
    return each, torch.where(members > 1, opacity / total, torch.ones_like(total))


def systematic_counts(weights: Tensor, total: int, offset: float) -> Tensor:
    """How often each row is drawn: ``total`` draws in proportion to ``weights``, each row within 1 of its expectation.
    ``weights``: f64[N], none below 0, not all 0 if ``total`` > 0. ``total``: number of draws. ``offset``: in [0, 1),
    the one random number. Returns i64[N] with sum ``total``."""
    if total == 0:
        return torch.zeros(len(weights), dtype=torch.int64, device=weights.device)
    ends = torch.cumsum(weights.double(), 0)
    reached = torch.floor(ends / ends[-1] * total + offset).long().clamp(max=total)
    return torch.diff(reached, prepend=reached.new_zeros(1))


def order_of_place(means: Tensor) -> Tensor:
    """Row numbers i64[N] sorted by x, then y, then z: an order that belongs to the Gaussians, not to the table."""
    order = torch.argsort(means[:, 2], stable=True)
    for axis in (1, 0):
        order = order[torch.argsort(means[order, axis], stable=True)]
    return order


def relocate_and_grow(model: SceneModel, step: int, settings: McmcSettings, run_seed: int) -> dict[str, Any]:
    """One round: relocate dead rows within their nodes and grow, on the model's table in place.

    Parameters, moments and labels move together; the moments of every Gaussian that became several start at zero. A
    node whose rows are all dead keeps them. ``step``: finished steps; with ``run_seed`` it decides all random draws.
    Returns counts: ``relocated``, ``added``, ``dropped`` (dead rows that found no place), ``rows`` (after)."""
    table, rows = model.table, len(model.table)
    owner = table.labels["node"].long()
    opacity = torch.sigmoid(table["logits"].detach().double())
    dead = useless_rows(model, settings)
    alive_in = torch.bincount(owner[~dead], minlength=len(model.nodes))
    dead &= alive_in[owner] > 0
    weights = torch.where(dead, 0.0, opacity)
    copies = _draw_copies(model, weights, dead, step, settings, run_seed)
    dead_transmittance = torch.log1p(torch.tensor(-settings.least_opacity).double())
    room = torch.floor(torch.log1p(-opacity.clamp(max=SURE_OPACITY)) / dead_transmittance)
    copies = torch.minimum(copies, (room.long() - 1).clamp(0, LARGEST_STACK - 1))
    sources = copies.nonzero()[:, 0]
    _correct(model, sources, copies[sources] + 1, opacity[sources])
    repeated = sources.repeat_interleave(copies[sources])
    columns, labels = copied_rows(table, repeated)
    table.take(~dead)
    if len(repeated):
        table.append(columns, labels)
    model.sort_rows()
    change = len(table) - rows
    relocated = min(int(dead.sum()), len(repeated))
    return {"relocated": relocated, "added": max(0, change), "dropped": max(0, -change), "rows": len(table)}


def _draw_copies(
    model: SceneModel, weights: Tensor, dead: Tensor, step: int, settings: McmcSettings, run_seed: int
) -> Tensor:
    """I64[N]: how many copies of each row are wanted, as many as there are dead rows in its node plus its share of
    growth."""
    table = model.table
    owner = table.labels["node"].long()
    order = order_of_place(table["means"].detach())
    order = order[torch.argsort(owner[order], stable=True)]
    offsets = seeds.numpy_rng(run_seed, step, "relocation").random(len(model.nodes) + 1)
    copies = torch.zeros(len(table), dtype=torch.int64, device=model.device)
    dead_in = torch.bincount(owner[dead], minlength=len(model.nodes)).tolist()
    for index, (block, wanted) in enumerate(zip(order.split(model.counts()), dead_in)):
        if wanted:
            copies[block] += systematic_counts(weights[block], wanted, float(offsets[index]))
    added = max(0, min(settings.max_rows - len(table), int(settings.growth * len(table))))
    if added and float(weights.sum()) > 0:
        copies[order] += systematic_counts(weights[order], added, float(offsets[-1]))
    return copies


def _correct(model: SceneModel, sources: Tensor, members: Tensor, opacity: Tensor) -> None:
    """Give the sources the opacity and scale of one of ``members`` and forget their moments."""
    each, factor = stack_of(opacity, members)
    table = model.table
    logits, log_scales = table.columns["logits"].detach(), table.columns["log_scales"].detach()
    logits[sources] = torch.logit(each).float()
    log_scales[sources] = (log_scales[sources].double() + torch.log(factor)[:, None]).float()
    for name in table.columns:
        table.reset_moments(name, sources)


def drift(model: SceneModel, step: int, rate: float, settings: McmcSettings, run_seed: int) -> None:
    """The random step of the centres after optimisation step ``step``, in place. Opaque Gaussians stay where they are.
    ``rate``: present learning rate of the centres, metres."""
    table = model.table
    opacity = torch.sigmoid(table.columns["logits"].detach())
    reach = settings.gate_opacity + 7.0 / settings.gate_sharpness  # beyond it the gate is below a thousandth
    rows = (opacity < reach).nonzero()[:, 0]
    if len(rows) == 0:
        return
    # Drawn on the CPU: the same on every device. It is as long as the list of rows that are nearly transparent by now.
    noise = torch.randn(len(rows), 3, generator=seeds.torch_generator(run_seed, step, "drift")).to(
        rows.device, non_blocking=True
    )
    means = table.columns["means"].detach()
    scales = table.columns["log_scales"].detach()[rows].exp()
    means[rows] += random_step(scales, table.columns["quats"].detach()[rows], opacity[rows], noise, rate, settings)


def random_step(
    scales_m: Tensor, quats: Tensor, opacity: Tensor, noise: Tensor, rate: float, settings: McmcSettings
) -> Tensor:
    """Displacements ``[n, 3]`` m: noise shaped by the covariance, faded by the opacity (published eq. 8), bounded by
    the size. ``scales_m``: ``[n, 3]``. ``quats``: ``[n, 4]`` (w, x, y, z), any length. ``opacity``: ``[n]`` in (0, 1).
    ``noise``: ``[n, 3]``, standard normal, along the Gaussian's own axes. ``rate``: metres."""
    gate = torch.sigmoid(settings.gate_sharpness * (settings.gate_opacity - opacity))[:, None]
    spread = torch.minimum(rate * settings.step_per_m2 * scales_m**2, scales_m)
    return rotate(quats, gate * spread * noise)


def densify_if_due(
    model: SceneModel, stats: DensifyStats, schedule: Rounds | None, step: int, rate_m: float, run_seed: int
) -> dict[str, Any]:
    """What the schedule has for a step, after the optimiser's; a report if rows changed, as new statistics begin then.
    ``rate_m``: present learning rate of the centres."""
    report: dict[str, Any] = {}
    if isinstance(schedule, McmcSettings):
        if schedule.due(step):
            report = relocate_and_grow(model, step, schedule, run_seed)
        drift(model, step, rate_m, schedule, run_seed)
    elif isinstance(schedule, DensifySettings):
        if schedule.due(step):
            report = densify(model, stats, step, schedule, run_seed)
        if schedule.reset_due(step):
            reset_opacity(model, schedule)
    return report
