"""Densification as sampling: Gaussians without effect move to where others are, and their number stays below a cap.

3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024). Every ``every`` steps

* *relocation*: dead rows (transparent, oversized, outside their box) become copies of live rows of the **same node**, drawn in
  proportion to opacity;
* *growth*: a few per cent more copies, until the cap is reached.

Where a Gaussian becomes N, opacity and scale of all N are corrected so that the stack looks as the one did (``stack_of``).
At every step the centres of nearly transparent Gaussians take a random step along their own axes (``drift``): dead ones look
for a better place. Two regularisers of the fit (``opacity_weight``, ``scale_weight``) let the unneeded fade.

Three choices differ from the published form. Copies are drawn systematically (one random number per round, rows in the
order of their place), not independently: the same expectation, less scatter, and independent of the order of the rows. A stack
never gets so many members that they would be dead at once. The random step is bounded by the Gaussian's own size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mudg.base import seeds
from mudg.core.quaternions import rotate
from mudg.models.scene.densify import copied_rows, useless_rows
from mudg.models.scene.model import SceneModel

LARGEST_STACK = 51
"""Most Gaussians that one may become in a round (published value)."""
SURE_OPACITY = 1 - 1e-6
"""Opacities count as at most this: a stack of finitely many cannot be wholly opaque."""


@dataclass(frozen=True)
class McmcSettings:
    """When and how. Steps count from 1.

    Args:
        start, stop, every: relocate and grow after step s when start <= s <= stop and s is a multiple of ``every``.
        max_rows: growth stops here; the table never has more rows.
        growth: share of the present rows that is added at a time.
        dead_opacity: rows below are relocated.
        prune_scale_m: rows larger are relocated. box_margin: object rows outside this many half-sizes of their box, too.
        step_per_m2: size of the random step: a Gaussian of scale s moves by ``rate * step_per_m2 * s^2`` along that axis,
            where ``rate`` is the learning rate of the centres in metres; never by more than s. The published 5e5 belongs to
            scenes scaled to unit size; the learning rates here belong to scenes of 10 m.
        gate_sharpness, gate_opacity: the step fades with ``sigmoid(sharpness * (gate_opacity - opacity))``.
    """

    start: int
    stop: int
    every: int
    max_rows: int = 150_000
    growth: float = 0.05
    dead_opacity: float = 0.005
    prune_scale_m: float = 8.0
    box_margin: float = 1.25
    step_per_m2: float = 5e3
    gate_sharpness: float = 100.0
    gate_opacity: float = 0.005

    def due(self, step: int) -> bool:
        """Whether to relocate and grow after step ``step`` (from 1)."""
        return self.start <= step <= self.stop and step % self.every == 0


def stack_of(opacity: Tensor, members: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale factor of each of N equal Gaussians that together look like one.

    Behind each other, N Gaussians of opacity ``o'`` let ``(1 - o' g)^N`` through, ``g`` their fall-off. ``o'`` makes
    that ``1 - o`` at the centre. The scale factor keeps the integral of the covered share along a line through the centre:
    ``o / sum_k binomial(N, k) (-1)^(k - 1) o'^k / sqrt(k)`` (Kheradmand et al. 2024, eq. 9, with the inner sum carried out).

    Args:
        opacity: f64[M] of the one Gaussian, in (0, 1).
        members: i64[M], N >= 1, at most ``LARGEST_STACK``.

    Returns:
        Opacity f64[M] of each member, and what its scales are multiplied with, f64[M].
    """
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

    Args:
        weights: f64[N], none below 0, not all 0 if ``total`` > 0.
        total: number of draws.
        offset: in [0, 1), the one random number.

    Returns:
        i64[N] with sum ``total``.
    """
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

    Parameters, moments and labels move together; the moments of every Gaussian that became several start at zero. A node whose
    rows are all dead keeps them.

    Args:
        step: finished steps; with ``run_seed`` it decides all random draws.

    Returns:
        Counts: ``relocated``, ``added``, ``dropped`` (dead rows that found no place), ``rows`` (after).
    """
    table, rows = model.table, len(model.table)
    owner = table.labels["node"].long()
    opacity = torch.sigmoid(table["logits"].detach().double())
    dead = useless_rows(model, settings.dead_opacity, settings.prune_scale_m, settings.box_margin)
    alive_in = torch.bincount(owner[~dead], minlength=len(model.nodes))
    dead &= alive_in[owner] > 0
    weights = torch.where(dead, 0.0, opacity)
    copies = _draw_copies(model, weights, dead, step, settings, run_seed)
    dead_transmittance = torch.log1p(torch.tensor(-settings.dead_opacity).double())
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
    """I64[N]: how many copies of each row are wanted, as many as there are dead rows in its node plus its share of growth."""
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

    Args:
        rate: present learning rate of the centres, metres.
    """
    table = model.table
    opacity = torch.sigmoid(table.columns["logits"].detach())
    reach = settings.gate_opacity + 7.0 / settings.gate_sharpness  # beyond it the gate is below a thousandth
    rows = (opacity < reach).nonzero()[:, 0]
    if len(rows) == 0:
        return
    # Drawn on the CPU: the same on every device. It is as long as the list of rows that are nearly transparent by now.
    noise = torch.randn(len(rows), 3, generator=seeds.torch_generator(run_seed, step, "drift")).to(rows.device, non_blocking=True)
    means = table.columns["means"].detach()
    scales = table.columns["log_scales"].detach()[rows].exp()
    means[rows] += random_step(scales, table.columns["quats"].detach()[rows], opacity[rows], noise, rate, settings)


def random_step(
    scales_m: Tensor, quats: Tensor, opacity: Tensor, noise: Tensor, rate: float, settings: McmcSettings
) -> Tensor:
    """Displacements ``[n, 3]`` m: noise shaped by the covariance, faded by the opacity (published eq. 8), bounded by the size.

    Args:
        scales_m: ``[n, 3]``. quats: ``[n, 4]`` (w, x, y, z), any length. opacity: ``[n]`` in (0, 1).
        noise: ``[n, 3]``, standard normal, along the Gaussian's own axes. rate: metres.
    """
    gate = torch.sigmoid(settings.gate_sharpness * (settings.gate_opacity - opacity))[:, None]
    spread = torch.minimum(rate * settings.step_per_m2 * scales_m**2, scales_m)
    return rotate(quats, gate * spread * noise)
