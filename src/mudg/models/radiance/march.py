"""Rays through the radiance field: samples, light, distance, and the loss terms of a batch of rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mudg.models.radiance.field import FieldValues, RadianceField
from mudg.models.radiance.sampling import (
    distances,
    even_edges,
    interlevel_loss,
    rendering_weights,
    resampled_edges,
)

MIDDLE_RANGE_M = 200.0
PULSE_RADII = (0.03, 0.003)
LARGEST_RANGE_M = 80.0
TINY = 1e-6


@dataclass(frozen=True, eq=False)
class Rays:
    """R rays: origins and unit directions ``[R, 3]`` in the world, times ``[R, 1]`` in [0, 1], camera numbers i64[R]."""

    origins: Tensor
    directions: Tensor
    times: Tensor
    cameras: Tensor

    def __len__(self) -> int:
        return len(self.origins)

    def to(self, device: torch.device) -> Rays:
        """The same rays on a device."""
        return Rays(
            *(t.to(device, non_blocking=True) for t in (self.origins, self.directions, self.times, self.cameras))
        )

    def part(self, begin: int, end: int) -> Rays:
        """Some of them."""
        return Rays(*(t[begin:end] for t in (self.origins, self.directions, self.times, self.cameras)))


@dataclass(frozen=True)
class Budget:
    """How finely rays are sampled: intervals of each proposal round and of the fields, nearest and farthest sample in metres."""

    proposals: tuple[int, ...]
    samples: int
    near_m: float
    far_m: float


@dataclass(frozen=True, eq=False)
class RayDraws:
    """Random numbers of a training batch, uniform in [0, 1): per ray and round ``[R, rounds + 1]``; of the flow, per sample ``[R * n, 1]``;
    samples of the cycle loss i64[K]."""

    jitter: Tensor
    share: Tensor
    cycle: Tensor

    @classmethod
    def of(cls, rays: int, budget: Budget, generator: torch.Generator, device: torch.device) -> RayDraws:
        """Drawn on the CPU, so that every device gets the same."""
        count = rays * budget.samples
        jitter = torch.rand(rays, len(budget.proposals) + 1, generator=generator)
        share = torch.rand(count, 1, generator=generator)
        cycle = torch.randint(0, count, (max(1, count // 8),), generator=generator)
        return cls(*(t.to(device, non_blocking=True) for t in (jitter, share, cycle)))


@dataclass(frozen=True, eq=False)
class Marched:
    """Rays after marching, n samples each.

    Args:
        along: normalised edges ``[R, n + 1]``; edges_m: the same as distances; middles_m: distances ``[R, n]``; weights ``[R, n]``.
        xyz, times: of all samples, ``[R * n, 3]`` and ``[R * n, 1]``.
        values: of the fields there.
        proposals: edges and weights of every proposal round.
    """

    along: Tensor
    edges_m: Tensor
    middles_m: Tensor
    weights: Tensor
    xyz: Tensor
    times: Tensor
    values: FieldValues
    proposals: tuple[tuple[Tensor, Tensor], ...]

    @property
    def opacity(self) -> Tensor:
        """``[R]`` in [0, 1]."""
        return self.weights.sum(1)

    @property
    def range_m(self) -> Tensor:
        """Expected distance ``[R]`` of what is there."""
        return (self.weights * self.middles_m).sum(1) / self.opacity.clamp_min(TINY)

    @property
    def median_m(self) -> Tensor:
        """Distance ``[R]`` before which half of what is there lies; within an interval it lies evenly."""
        upto = self.weights.cumsum(1)
        half = 0.5 * upto[:, -1:]
        hit = (upto < half).sum(1, keepdim=True).clamp(max=upto.shape[1] - 1)
        own = self.weights.gather(1, hit)
        share = ((half - upto.gather(1, hit) + own) / own.clamp_min(TINY)).clamp(0, 1)
        near, far = self.edges_m.gather(1, hit), self.edges_m.gather(1, hit + 1)
        return (near + share * (far - near))[:, 0]

    def dynamic_weights(self) -> Tensor:
        """Share of the weights that belongs to what moves, ``[R, n]``."""
        moving, still = self.values.dynamic_density, self.values.static_density
        return self.weights * (moving / (moving + still).clamp_min(TINY)).view_as(self.weights)


def march(
    field: RadianceField, rays: Rays, budget: Budget, draws: RayDraws | None = None, learn_proposals: bool = False
) -> Marched:
    """Samples along rays, first where the proposal networks point, and the fields there.

    Args:
        draws: of a training batch; None: samples in the middle, the whole flow.
        learn_proposals: keep the gradients of the proposal networks.
    """
    half = rays.times.new_full((len(rays), 1), 0.5)

    def jitter(turn: int) -> Tensor:
        return half if draws is None else draws.jitter[:, turn : turn + 1]

    rounds, edges = [], even_edges(len(rays), budget.proposals[0], jitter(0))
    for level, count in enumerate((*budget.proposals[1:], budget.samples)):
        edges_m = distances(edges, budget.near_m, MIDDLE_RANGE_M, budget.far_m)
        with torch.set_grad_enabled(learn_proposals and torch.is_grad_enabled()):
            density = field.proposed_density(level, _places(rays, (edges_m[:, 1:] + edges_m[:, :-1]) / 2))
            weights = rendering_weights(density.view(len(rays), -1), edges_m)
        rounds.append((edges, weights))
        edges = resampled_edges(edges, weights, count, jitter(level + 1))
    edges_m = distances(edges, budget.near_m, MIDDLE_RANGE_M, budget.far_m)
    middles_m = (edges_m[:, 1:] + edges_m[:, :-1]) / 2
    xyz, times = _places(rays, middles_m), rays.times.expand(-1, budget.samples).reshape(-1, 1)
    values = field.values(xyz, times, 1.0 if draws is None else draws.share)
    density = (values.static_density + values.dynamic_density).view_as(middles_m)
    return Marched(edges, edges_m, middles_m, rendering_weights(density, edges_m), xyz, times, values, tuple(rounds))


def _places(rays: Rays, middles_m: Tensor) -> Tensor:
    return (rays.origins[:, None] + rays.directions[:, None] * middles_m[..., None]).reshape(-1, 3)


def colors(field: RadianceField, rays: Rays, marched: Marched) -> tuple[Tensor, Tensor]:
    """Colours ``[R, 3]`` over the sky, and the shadow ``[R * n, 1]`` that what moves casts on what stands, 0 (none) to 1."""
    context, size = field.context(rays.directions, rays.cameras), (*marched.weights.shape, -1)
    values, moving = marched.values, marched.dynamic_weights()
    shadow = field.shadow(values.dynamic).sigmoid()
    standing = (marched.weights - moving) * (1 - shadow).view_as(moving)
    rgb = (standing[..., None] * field.color(values.static.view(size), context)).sum(1)
    rgb = rgb + (moving[..., None] * field.color(values.dynamic.view(size), context)).sum(1)
    return rgb + (1 - marched.opacity)[:, None] * field.sky(context).sigmoid(), shadow


# ---- losses ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Weights:
    """Weights of the loss terms, as published."""

    sky: float
    lidar: float
    sight: float
    dynamic: float
    shadow: float
    cycle: float


def pixel_terms(
    field: RadianceField,
    rays: Rays,
    marched: Marched,
    draws: RayDraws,
    truth: tuple[Tensor, Tensor, Tensor | None],
    weights: Weights,
) -> tuple[dict[str, Tensor], Tensor]:
    """Weighted loss terms of a batch of pixels, and the colour error of every ray ``[R]``.

    Args:
        truth: colours ``[R, 3]``, whether they count ``[R]`` (0 or 1), and whether they show sky (None: unknown).
    """
    wanted, counts, sky = truth
    rgb, shadow = colors(field, rays, marched)
    error = (rgb - wanted).square().mean(1) * counts
    terms = {
        "color": error.mean(),
        "shadow": weights.shadow * shadow.square().mean(),
        **_of_motion(field, marched, draws, weights),
    }
    if sky is not None and weights.sky:
        opacity = marched.opacity.clamp(1e-4, 1 - 1e-4)
        entropy = -torch.where(sky, torch.log1p(-opacity), opacity.log())
        terms["sky"] = weights.sky * (entropy * counts).mean()
    return terms, error.detach()


def lidar_terms(
    field: RadianceField, marched: Marched, draws: RayDraws, range_m: Tensor, weights: Weights, sight_m: float
) -> dict[str, Tensor]:
    """Weighted loss terms of a batch of LiDAR rays that end at ``range_m`` f32[R].

    Args:
        sight_m: half width of the surface in the line-of-sight term; 0: without this term.
    """
    near = (range_m < LARGEST_RANGE_M).float()
    missed = ((marched.range_m - range_m) / LARGEST_RANGE_M).square()
    terms = {"lidar": weights.lidar * (missed * near).mean(), **_of_motion(field, marched, draws, weights)}
    if sight_m > 0 and weights.sight:
        terms["sight"] = weights.sight * line_of_sight(marched.weights, marched.edges_m, range_m, sight_m)
    return terms


def line_of_sight(weights: Tensor, edges_m: Tensor, range_m: Tensor, sight_m: float) -> Tensor:
    """How far weights are from a narrow bell at the measured range, and from 0 before it: sums along rays, mean of rays.

    The weight of an interval is compared with the mass of the bell N(z, sight_m / 3) in it, by the square of the difference; what begins
    more than ``sight_m`` behind the range is free.

    Args:
        weights: ``[R, n]``. edges_m: ``[R, n + 1]``. range_m: ``[R]``.
    """
    off = edges_m - range_m[:, None]
    upto = 0.5 * (1 + torch.erf(off * (3 / (sight_m * 2**0.5))))
    missed = (weights - (upto[:, 1:] - upto[:, :-1])).square()
    return torch.where(off[:, :-1] < sight_m, missed, 0.0).sum(1).mean()


def _of_motion(field: RadianceField, marched: Marched, draws: RayDraws, weights: Weights) -> dict[str, Tensor]:
    """What every batch has: little may move, and flow there and back ends where it began."""
    values, chosen = marched.values, draws.cycle
    terms: dict[str, Any] = {"dynamic": weights.dynamic * values.dynamic_density.mean()}
    if weights.cycle:
        terms["cycle"] = weights.cycle * field.cycle_loss(
            marched.xyz[chosen], marched.times[chosen], values.flow[chosen]
        )
    return terms


def proposal_loss(marched: Marched) -> Tensor:
    """What the proposal networks learn from."""
    losses = [
        interlevel_loss(marched.along, marched.weights, edges, weights, radius)
        for (edges, weights), radius in zip(marched.proposals, PULSE_RADII)
    ]
    return torch.stack(losses).sum()
