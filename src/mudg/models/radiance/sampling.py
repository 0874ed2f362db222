"""Where rays are sampled and what samples weigh: spacing, contraction of space, volume rendering weights, resampling, and the loss that
teaches proposal networks."""

from __future__ import annotations

import torch
from torch import Tensor


def contract(xyz: Tensor, center: Tensor, half: Tensor) -> Tensor:
    """World places ``[..., 3]`` into the unit cube: a box fills its inner half evenly, everything outside the rest.

    With ``p = (xyz - center) / half`` and n the largest ``|p|``: p within the box, ``(2 - 1/n) p/n`` outside; [-2, 2] becomes [0, 1].

    Args:
        center, half: f32[3], middle and half size of the box in metres.
    """
    inner = (xyz - center) / half
    norm = inner.abs().amax(-1, keepdim=True).clamp_min(1.0)
    return inner * ((2 - 1 / norm) / norm) / 4 + 0.5


def distances(along: Tensor, near_m: float, middle_m: float, far_m: float) -> Tensor:
    """Distance in metres of a normalised place on a ray in [0, 1]: its first half is linear in distance up to ``middle_m``, its second in
    one over distance up to ``far_m``."""
    linear = near_m + (middle_m - near_m) * 2 * along
    share = (2 * along - 1).clamp(0, 1)
    inverse = 1 / ((1 - share) / middle_m + share / far_m)
    return torch.where(along < 0.5, linear, inverse)


def even_edges(rays: int, count: int, jitter: Tensor) -> Tensor:
    """Edges ``[rays, count + 1]`` of even intervals of [0, 1], moved by ``jitter`` f32[rays, 1] in [0, 1] of an interval (0.5: not)."""
    steps = torch.linspace(0, 1, count + 1, device=jitter.device).expand(rays, -1)
    moved = (steps + (jitter - 0.5) / count).clamp(0, 1)
    return torch.cat([steps[:, :1], moved[:, 1:-1], steps[:, -1:]], 1)


def rendering_weights(density: Tensor, edges_m: Tensor) -> Tensor:
    """Share of the light of a ray that comes from each interval: ``T_i (1 - exp(-sigma_i delta_i))``.

    Args:
        density: ``[R, n]`` per metre.
        edges_m: ``[R, n + 1]``, growing.
    """
    thickness = density * (edges_m[:, 1:] - edges_m[:, :-1])
    before = torch.cumsum(thickness, 1) - thickness
    return torch.exp(-before) * -torch.expm1(-thickness)


def resampled_edges(edges: Tensor, weights: Tensor, count: int, jitter: Tensor, floor: float = 1e-3) -> Tensor:
    """Edges ``[R, count + 1]`` of intervals with equal shares of the weights (data; no gradient).

    Args:
        edges: ``[R, n + 1]``. weights: ``[R, n]``.
        jitter: f32[R, 1] in [0, 1].
        floor: added to every weight, so that empty rays are sampled evenly.
    """
    mass = weights.detach() + floor
    cdf = torch.cumsum(mass / mass.sum(1, keepdim=True), 1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf], 1).clamp(max=1.0)
    wanted = (torch.arange(count + 1, device=edges.device) + jitter) / (count + 1)
    above = torch.searchsorted(cdf, wanted.contiguous(), right=True).clamp(1, edges.shape[1] - 1)
    low, high = cdf.gather(1, above - 1), cdf.gather(1, above)
    share = ((wanted - low) / (high - low).clamp_min(1e-9)).clamp(0, 1)
    first, last = edges.gather(1, above - 1), edges.gather(1, above)
    return first + (last - first) * share


def blurred_mass(edges: Tensor, weights: Tensor, wanted: Tensor, radius: float) -> Tensor:
    """Mass of a histogram, blurred by a box of half width ``radius``, in the intervals of other edges (zip-NeRF, section 4).

    The blurred histogram is linear between the edges moved by +- radius; its integral is read off at the wanted edges.

    Args:
        edges: ``[R, n + 1]``. weights: ``[R, n]``. wanted: ``[R, m + 1]``.

    Returns:
        f64[R, m].
    """
    edges, weights, wanted = edges.double(), weights.double(), wanted.double()
    height = weights / (edges[:, 1:] - edges[:, :-1]).clamp_min(1e-9)
    radius = max(radius, 1e-6)
    zero = torch.zeros_like(height[:, :1])
    change = (torch.cat([height, zero], 1) - torch.cat([zero, height], 1)) / (2 * radius)
    knots, order = torch.cat([edges - radius, edges + radius], 1).sort(1)
    slope = torch.cat([change, -change], 1).gather(1, order).cumsum(1)
    gap = knots[:, 1:] - knots[:, :-1]
    value = torch.cat([zero, (slope[:, :-1] * gap).cumsum(1)], 1)
    total = torch.cat([zero, ((value[:, 1:] + value[:, :-1]) / 2 * gap).cumsum(1)], 1)
    at = (torch.searchsorted(knots, wanted.contiguous(), right=True) - 1).clamp(0, knots.shape[1] - 1)
    past = (wanted - knots.gather(1, at)).clamp_min(0)
    before = (wanted > knots[:, :1]).double()
    integral = before * (total.gather(1, at) + past * (value.gather(1, at) + past * slope.gather(1, at) / 2))
    return (integral[:, 1:] - integral[:, :-1]).clamp_min(0)


def interlevel_loss(edges: Tensor, weights: Tensor, proposed: Tensor, proposal: Tensor, radius: float) -> Tensor:
    """How far a proposal falls short of the (blurred) histogram that it should cover: sum of ``max(0, target - w)^2 / w``, mean of rays.

    Args:
        edges, weights: of the final samples, ``[R, n + 1]`` and ``[R, n]``; data.
        proposed, proposal: edges (data) and weights of the proposal, ``[R, m + 1]`` and ``[R, m]``.
        radius: half width of the blur, in normalised distance.
    """
    target = blurred_mass(edges.detach(), weights.detach(), proposed.detach(), radius).to(proposal.dtype)
    return ((target - proposal).clamp_min(0).square() / (proposal + 1e-5)).sum(1).mean()
