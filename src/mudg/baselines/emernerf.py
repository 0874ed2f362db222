"""EmerNeRF (Yang et al. 2023; method emernerf). Its fields: static (3-D grid -> density and a feature), dynamic (4-D,
averaged along the flow) and flow (4-D -> motion to the next and from the previous time step, metres). Its fit: two
batches of rays per step, one of pixels and one of LiDAR. OUT holds model.json and field.safetensors."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import checkpoint, geometry, log, records, seeds, store, weights
from mudg.base.devices import memory_of
from mudg.base.errors import InputError
from mudg.base.processes import one_torch_thread
from mudg.base.run_folder import RunDir
from mudg.base.types import Observation, Scene, View
from mudg.baselines.omnire import waves
from mudg.core.grids import HashGrid, encode
from mudg.core.pictures import panels_of, resize_area
from mudg.gaussians.rendering import COVERED
from mudg.gaussians.schedule import FiniteCheck, Progress, run_steps
from mudg.gaussians.settings import FitConfig
from mudg.gaussians.storage import RADIANCE, description_of, kind_of
from mudg.gaussians.views import StoredView, load_recorded, training_frames
from mudg.scene.read import read_points, read_scene


def contract(xyz: Tensor, center: Tensor, half: Tensor) -> Tensor:
    """World places ``[..., 3]`` into the unit cube. With ``p = (xyz - center) / half`` of a box (f32[3], metres) and n
    the largest ``|p|``: p within the box, ``(2 - 1/n) p/n`` outside; [-2, 2] becomes [0, 1]."""
    inner = (xyz - center) / half
    norm = inner.abs().amax(-1, keepdim=True).clamp_min(1.0)
    return inner * ((2 - 1 / norm) / norm) / 4 + 0.5


def distances(along: Tensor, near_m: float, middle_m: float, far_m: float) -> Tensor:
    """Distance in metres of a normalised place on a ray in [0, 1]: its first half is linear in distance up to
    ``middle_m``, its second in one over distance up to ``far_m``."""
    linear = near_m + (middle_m - near_m) * 2 * along
    share = (2 * along - 1).clamp(0, 1)
    inverse = 1 / ((1 - share) / middle_m + share / far_m)
    return torch.where(along < 0.5, linear, inverse)


def even_edges(rays: int, count: int, jitter: Tensor) -> Tensor:
    """Edges ``[rays, count + 1]`` of even intervals of [0, 1], moved by ``jitter`` f32[rays, 1] in [0, 1] of an
    interval (0.5: not)."""
    steps = torch.linspace(0, 1, count + 1, device=jitter.device).expand(rays, -1)
    moved = (steps + (jitter - 0.5) / count).clamp(0, 1)
    return torch.cat([steps[:, :1], moved[:, 1:-1], steps[:, -1:]], 1)


def rendering_weights(density: Tensor, edges_m: Tensor) -> Tensor:
    """Share of the light of a ray that comes from each interval: ``T_i (1 - exp(-sigma_i delta_i))``. ``density``:
    ``[R, n]`` per metre. ``edges_m``: ``[R, n + 1]``, growing."""
    thickness = density * (edges_m[:, 1:] - edges_m[:, :-1])
    before = torch.cumsum(thickness, 1) - thickness
    return torch.exp(-before) * -torch.expm1(-thickness)


def resampled_edges(edges: Tensor, weights: Tensor, count: int, jitter: Tensor, floor: float = 1e-3) -> Tensor:
    """Edges ``[R, count + 1]`` of intervals with equal shares of the ``weights`` [R, n] between ``edges`` [R, n + 1]
    (no gradient). ``jitter``: f32[R, 1] in [0, 1]. ``floor``: added to every weight: empty rays are sampled evenly."""
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
    """Mass f64[R, m] of a histogram (``edges`` [R, n + 1], ``weights`` [R, n]), blurred by a box of half width
    ``radius``, between other edges ``wanted`` [R, m + 1] (zip-NeRF, section 4): it is linear between the edges moved by
    +- radius, and its integral is read off."""
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
    """How far a proposal (edges ``proposed`` [R, m + 1], weights [R, m]) falls short of the histogram of the final
    samples, blurred by ``radius``: sum of ``max(0, target - w)^2 / w``, mean of rays. Only ``proposal`` gets
    gradients."""
    target = blurred_mass(edges.detach(), weights.detach(), proposed.detach(), radius).to(proposal.dtype)
    return ((target - proposal).clamp_min(0).square() / (proposal + 1e-5)).sum(1).mean()


# field --------------------------------------------------------------------------------------------

OCTAVES = 5
DIRECTION_WIDTH = 3 + 6 * OCTAVES
TABLE_START = 1e-4
LARGEST_LOG_DENSITY = 12.0


Grid = tuple[int, int, int, int, int]
"""Levels, features per level, coarsest, finest, log2 of the entries of a level."""


@dataclass(frozen=True)
class FieldSizes:
    """Sizes of all networks."""

    static: Grid
    dynamic: Grid
    flow: Grid
    proposals: tuple[Grid, ...]
    width: int
    proposal_width: int
    appearance: int = 16


SIZES: Final[Mapping[str, FieldSizes]] = {
    "small": FieldSizes(
        *((8, 2, 16, 1024, 17), (8, 2, 8, 256, 17), (8, 2, 8, 128, 15)),
        *(((5, 1, 16, 128, 16), (5, 1, 16, 512, 16)), 32, 16),
    ),
    "published": FieldSizes(
        *((10, 4, 16, 8192, 20), (10, 4, 32, 8192, 18), (10, 4, 16, 4096, 18)),
        *(((8, 1, 16, 512, 20), (8, 1, 16, 2048, 20)), 64, 64),
    ),
    "tiny": FieldSizes(
        *((3, 2, 4, 16, 10), (3, 2, 4, 16, 10), (2, 2, 4, 8, 9)), *(((2, 1, 4, 8, 9), (2, 1, 4, 16, 9)), 8, 8)
    ),
}
"""By setting; tiny tries out the code. Grids of space and time with more places than entries share them."""


@dataclass(frozen=True)
class Extent:
    """Where and when the log is: a box (center, half size, metres), the first time, the time span, and one time step
    (all seconds)."""

    center: tuple[float, float, float]
    half: tuple[float, float, float]
    start_s: float
    span_s: float
    step_s: float

    @property
    def step(self) -> float:
        """A time step in normalised time."""
        return self.step_s / self.span_s

    def normalised(self, time_s: float) -> float:
        """A time in [0, 1]; times outside the log are those of its ends."""
        return min(1.0, max(0.0, (time_s - self.start_s) / self.span_s))


class RadianceField(nn.Module):
    """All fields with their parameters. ``cameras``: names; each has an appearance of its own. ``facts``: method, scene
    and so on, kept on disk."""

    def __init__(
        self, sizes: FieldSizes, extent: Extent, cameras: Sequence[str], facts: Mapping[str, Any], seed: int = 0
    ) -> None:
        super().__init__()
        self.sizes, self.extent, self.cameras, self.facts = sizes, extent, tuple(cameras), dict(facts)
        draw, width = seeds.torch_generator(seed, 0, "radiance field"), sizes.width
        self.static = _GridNet(3, sizes.static, (width, width), draw)
        self.dynamic = _GridNet(4, sizes.dynamic, (width, width), draw)
        self.flow = _GridNet(4, sizes.flow, (width, width, 6), draw)
        self.proposals = nn.ModuleList(_GridNet(3, grid, (sizes.proposal_width, 1), draw) for grid in sizes.proposals)
        context = DIRECTION_WIDTH + sizes.appearance
        self.color = _ColorNet(width, context, draw)
        self.shadow = _Mlp((width, width, 1), draw)
        self.sky = _Mlp((context, width, width, 3), draw)
        self.appearance = nn.Parameter(0.01 * torch.randn(len(self.cameras), sizes.appearance, generator=draw))
        self.register_buffer("box_center", torch.tensor(extent.center), persistent=False)
        self.register_buffer("box_half", torch.tensor(extent.half), persistent=False)

    @property
    def device(self) -> torch.device:
        """Where the parameters are."""
        return self.appearance.device

    def unit(self, xyz: Tensor) -> Tensor:
        """World places ``[N, 3]`` in the unit cube."""
        return contract(xyz, self.box_center, self.box_half)  # type: ignore[arg-type]

    def proposed_density(self, level: int, xyz: Tensor) -> Tensor:
        """Density ``[N]`` that a proposal network states. Each level asks its own network."""
        return _density(self.proposals[level](self.unit(xyz))[:, 0])

    def flow_at(self, xyz: Tensor, time: Tensor) -> Tensor:
        """Flow ``[N, 6]`` at places ``[N, 3]`` and times ``[N, 1]``."""
        return self.flow(torch.cat([self.unit(xyz), time], 1))

    def values(self, xyz: Tensor, time: Tensor, share: Tensor | float) -> dict[str, Tensor]:
        """What the fields say at places ``[N, 3]`` and normalised times ``[N, 1]``, as ``Marched`` names it. ``share``:
        of the flow that aggregation follows, ``[N, 1]`` in [0, 1]: random while training, 1 else."""
        static, flow = self.static(self.unit(xyz)), self.flow_at(xyz, time)
        dynamic = aggregated(self.dynamic_feature, xyz, time, flow, share, self.extent.step)
        densities = {"static_density": _density(static[:, 0]), "dynamic_density": _density(dynamic[:, 0])}
        return {"static": static, "dynamic": dynamic, "flow": flow, **densities}

    def dynamic_feature(self, xyz: Tensor, time: Tensor) -> Tensor:
        """The dynamic field's feature ``[N, width]``, not aggregated."""
        return self.dynamic(torch.cat([self.unit(xyz), time.clamp(0, 1)], 1))

    def context(self, directions: Tensor, camera: Tensor) -> Tensor:
        """What colour depends on besides the place: coded direction and appearance, ``[R, ...]``."""
        return torch.cat([waves(directions, OCTAVES, 1.0), self.appearance[camera]], 1)

    def cycle_loss(self, xyz: Tensor, time: Tensor, flow: Tensor) -> Tensor:
        """How far the flow there and back misses its start: half the mean of both squares. What it is compared with is
        data."""
        forward, backward, step = flow[:, :3], flow[:, 3:], self.extent.step
        with torch.no_grad():
            back = self.flow_at(xyz + forward, (time + step).clamp(0, 1))[:, 3:]
            forth = self.flow_at(xyz + backward, (time - step).clamp(0, 1))[:, :3]
        return 0.5 * ((forward + back).square() + (backward + forth).square()).mean()

    def description(self) -> dict[str, Any]:
        """Everything but the parameters, as JSON values."""
        sizes, extent = asdict(self.sizes), asdict(self.extent)
        return {"sizes": sizes, "extent": extent, "cameras": list(self.cameras), "facts": self.facts}

    @classmethod
    def from_state(cls, values: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> RadianceField:
        """Inverse of ``description`` and ``state_dict``. InputError: tensors are missing, left over or of another
        shape."""
        sizes = records.parse_dataclass(FieldSizes, values["sizes"], "sizes: ")
        extent = records.parse_dataclass(Extent, values["extent"], "extent: ")
        field = cls(sizes, extent, values["cameras"], values["facts"])
        weights.match_exactly(tensors, weights.shapes_of(field), "field.safetensors", "the radiance field")
        field.load_state_dict(dict(tensors))
        return field


def aggregated(feature: Any, xyz: Tensor, time: Tensor, flow: Tensor, share: Tensor | float, step: float) -> Tensor:
    """A feature averaged along the flow: ``(f(x, t) + f(x + n v_f, t + n D) / 2 + f(x + n v_b, t - n D) / 2) / 2``.
    ``feature``: (places [N, 3], times [N, 1]) -> [N, C]. ``share``: n, ``[N, 1]`` or a number. ``step``: D, in
    normalised time."""
    here, count = feature(xyz, time), len(xyz)
    places = torch.cat([xyz + share * flow[:, :3], xyz + share * flow[:, 3:]])
    there = feature(places, torch.cat([time + share * step, time - share * step]))
    return 0.5 * here + 0.25 * (there[:count] + there[count:])


def _density(raw: Tensor) -> Tensor:
    return torch.exp((raw - 1).clamp(max=LARGEST_LOG_DENSITY))


class _Mlp(nn.Module):
    """Linear layers with ReLU between them; without biases at the start."""

    def __init__(self, sizes: Sequence[int], draw: torch.Generator) -> None:
        super().__init__()
        pairs = list(zip(sizes[:-1], sizes[1:]))
        self.weights = nn.ParameterList(_drawn(inner, outer, draw) for inner, outer in pairs)
        self.biases = nn.ParameterList(torch.zeros(outer) for _, outer in pairs)

    def forward(self, x: Tensor) -> Tensor:
        last = len(self.weights) - 1
        for index, (weight, bias) in enumerate(zip(self.weights, self.biases)):
            x = functional.linear(x, weight, bias)
            x = x if index == last else x.relu_()
        return x


class _GridNet(nn.Module):
    """A hash grid and the network that reads it."""

    def __init__(self, dimensions: int, grid: Grid, layers: Sequence[int], draw: torch.Generator) -> None:
        super().__init__()
        self.grid = HashGrid(dimensions, *grid)
        self.table = nn.Parameter(TABLE_START * (2 * torch.rand(self.grid.table_shape, generator=draw) - 1))
        self.net = _Mlp((self.grid.width, *layers), draw)

    def forward(self, points: Tensor) -> Tensor:
        return self.net(encode(points, self.table, self.grid))


class _ColorNet(nn.Module):
    """Colour of features seen from a direction: three layers, the input read again by the second. What belongs to a ray
    is multiplied once per ray, not once per sample."""

    def __init__(self, width: int, context: int, draw: torch.Generator) -> None:
        super().__init__()
        self.of_feature = _drawn(width + context, width, draw, width)
        self.of_context = _drawn(width + context, width, draw, context)
        self.again_feature = _drawn(2 * width + context, width, draw, width)
        self.again_context = _drawn(2 * width + context, width, draw, context)
        self.hidden = _drawn(2 * width + context, width, draw, width)
        self.out = _drawn(width, 3, draw)
        self.bias = nn.ParameterList([torch.zeros(width), torch.zeros(width), torch.zeros(3)])

    def forward(self, features: Tensor, context: Tensor) -> Tensor:
        """Features ``[R, n, width]`` and contexts ``[R, ...]`` -> colours ``[R, n, 3]`` in [0, 1]."""
        per_ray = functional.linear(context, self.of_context, self.bias[0])[:, None]
        again = functional.linear(context, self.again_context, self.bias[1])[:, None]
        first = (functional.linear(features, self.of_feature) + per_ray).relu_()
        both = functional.linear(torch.cat([first, features], 2), torch.cat([self.hidden, self.again_feature], 1))
        return functional.linear((both + again).relu_(), self.out, self.bias[2]).sigmoid()


def _drawn(inner: int, outer: int, draw: torch.Generator, columns: int = 0) -> nn.Parameter:
    """Weights ``[outer, columns or inner]``, uniform with the variance 2 / inner."""
    limit = math.sqrt(6 / inner)
    return nn.Parameter(limit * (2 * torch.rand(outer, columns or inner, generator=draw) - 1))


# rays through the field ---------------------------------------------------------------------------

MIDDLE_RANGE_M = 200.0
PULSE_RADII = (0.03, 0.003)
LARGEST_RANGE_M = 80.0
TINY = 1e-6


@dataclass(frozen=True, eq=False)
class Rays:
    """R rays: origins and unit directions ``[R, 3]`` in the world, times ``[R, 1]`` in [0, 1], camera numbers
    i64[R]."""

    origins: Tensor
    directions: Tensor
    times: Tensor
    cameras: Tensor

    def __len__(self) -> int:
        return len(self.origins)

    def to(self, device: torch.device) -> Rays:
        """The same rays on a device."""
        return Rays(*(t.to(device, non_blocking=True) for t in vars(self).values()))

    def __getitem__(self, chosen: slice | Tensor) -> Rays:
        return Rays(*(t[chosen] for t in vars(self).values()))


@dataclass(frozen=True)
class Budget:
    """How finely rays are sampled: intervals of each proposal round and of the fields, nearest and farthest sample in
    metres."""

    proposals: tuple[int, ...]
    samples: int
    near_m: float
    far_m: float


@dataclass(frozen=True, eq=False)
class RayDraws:
    """Random numbers of a training batch, uniform in [0, 1): per ray and round ``[R, rounds + 1]``; of the flow, per
    sample ``[R * n, 1]``; samples of the cycle loss i64[K]."""

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
    """Rays after marching, n samples each: edges ``[R, n + 1]``, normalised and as distances; middles and weights ``[R,
    n]``; places ``[R * n, 3]`` and times ``[R * n, 1]``; edges and weights of every proposal round; and what the fields
    say at the N = R n samples: features ``[N, width]``, densities ``[N]`` per metre, flow ``[N, 6]`` (forward,
    backward) in metres per time step."""

    along: Tensor
    edges_m: Tensor
    middles_m: Tensor
    weights: Tensor
    xyz: Tensor
    times: Tensor
    proposals: tuple[tuple[Tensor, Tensor], ...]
    static: Tensor
    dynamic: Tensor
    static_density: Tensor
    dynamic_density: Tensor
    flow: Tensor

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
        moving, still = self.dynamic_density, self.static_density
        return self.weights * (moving / (moving + still).clamp_min(TINY)).view_as(self.weights)


def march(
    field: RadianceField, rays: Rays, budget: Budget, draws: RayDraws | None = None, learn_proposals: bool = False
) -> Marched:
    """Samples along rays, first where the proposal networks point, and the fields there. ``draws``: of a training
    batch; None: samples in the middle, the whole flow. ``learn_proposals``: keep the gradients of the proposal
    networks."""
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
    density = (values["static_density"] + values["dynamic_density"]).view_as(middles_m)
    weights = rendering_weights(density, edges_m)
    return Marched(edges, edges_m, middles_m, weights, xyz, times, tuple(rounds), **values)


def _places(rays: Rays, middles_m: Tensor) -> Tensor:
    return (rays.origins[:, None] + rays.directions[:, None] * middles_m[..., None]).reshape(-1, 3)


def colors(field: RadianceField, rays: Rays, marched: Marched) -> tuple[Tensor, Tensor]:
    """Colours ``[R, 3]`` over the sky, and the shadow ``[R * n, 1]`` that what moves casts on what stands, 0 (none) to
    1."""
    context, size = field.context(rays.directions, rays.cameras), (*marched.weights.shape, -1)
    moving, shadow = marched.dynamic_weights(), field.shadow(marched.dynamic).sigmoid()
    standing = (marched.weights - moving) * (1 - shadow).view_as(moving)
    rgb = (standing[..., None] * field.color(marched.static.view(size), context)).sum(1)
    rgb = rgb + (moving[..., None] * field.color(marched.dynamic.view(size), context)).sum(1)
    return rgb + (1 - marched.opacity)[:, None] * field.sky(context).sigmoid(), shadow


# losses -------------------------------------------------------------------------------------------

SKY_WEIGHT, LIDAR_WEIGHT, SIGHT_WEIGHT, SHADOW_WEIGHT, CYCLE_WEIGHT = 0.001, 1.0, 0.1, 0.01, 0.01
"""As published."""


def pixel_terms(
    field: RadianceField,
    rays: Rays,
    marched: Marched,
    draws: RayDraws,
    truth: tuple[Tensor, Tensor, Tensor | None],
    dynamic: float,
) -> tuple[dict[str, Tensor], Tensor]:
    """Weighted loss terms of a batch of pixels, and the colour error of every ray ``[R]``. ``truth``: colours
    ``[R, 3]``, whether they count ``[R]`` (0 or 1), and whether they show sky (None: unknown). ``dynamic``: weight of
    the dynamic density."""
    wanted, counts, sky = truth
    rgb, shadow = colors(field, rays, marched)
    error = (rgb - wanted).square().mean(1) * counts
    terms = {"color": error.mean(), "shadow": SHADOW_WEIGHT * shadow.square().mean()}
    terms |= _of_motion(field, marched, draws, dynamic)
    if sky is not None:
        opacity = marched.opacity.clamp(1e-4, 1 - 1e-4)
        entropy = -torch.where(sky, torch.log1p(-opacity), opacity.log())
        terms["sky"] = SKY_WEIGHT * (entropy * counts).mean()
    return terms, error.detach()


def lidar_terms(
    field: RadianceField, marched: Marched, draws: RayDraws, range_m: Tensor, dynamic: float, sight_m: float
) -> dict[str, Tensor]:
    """Weighted loss terms of a batch of LiDAR rays that end at ``range_m`` f32[R]. ``sight_m``: half width of the
    surface in the line-of-sight term; 0: without this term."""
    near = (range_m < LARGEST_RANGE_M).float()
    missed = ((marched.range_m - range_m) / LARGEST_RANGE_M).square()
    terms = {"lidar": LIDAR_WEIGHT * (missed * near).mean(), **_of_motion(field, marched, draws, dynamic)}
    if sight_m > 0:
        terms["sight"] = SIGHT_WEIGHT * line_of_sight(marched.weights, marched.edges_m, range_m, sight_m)
    return terms


def line_of_sight(weights: Tensor, edges_m: Tensor, range_m: Tensor, sight_m: float) -> Tensor:
    """How far ``weights`` [R, n] between ``edges_m`` [R, n + 1] are from the masses of the bell N(range, sight_m / 3)
    at the measured ``range_m`` [R]: squares, summed along rays, mean of rays. What begins more than ``sight_m`` behind
    the range is free."""
    off = edges_m - range_m[:, None]
    upto = 0.5 * (1 + torch.erf(off * (3 / (sight_m * 2**0.5))))
    missed = (weights - (upto[:, 1:] - upto[:, :-1])).square()
    return torch.where(off[:, :-1] < sight_m, missed, 0.0).sum(1).mean()


def _of_motion(field: RadianceField, marched: Marched, draws: RayDraws, dynamic: float) -> dict[str, Tensor]:
    """What every batch has: little may move, and flow there and back ends where it began."""
    missed = field.cycle_loss(*(of[draws.cycle] for of in (marched.xyz, marched.times, marched.flow)))
    return {"dynamic": dynamic * marched.dynamic_density.mean(), "cycle": CYCLE_WEIGHT * missed}


def proposal_loss(marched: Marched) -> Tensor:
    """What the proposal networks learn from."""
    pairs = zip(marched.proposals, PULSE_RADII)
    return torch.stack([interlevel_loss(marched.along, marched.weights, *own, radius) for own, radius in pairs]).sum()


# rays ---------------------------------------------------------------------------------------------

MOST_LIDAR_RAYS = 8_000_000
NEAREST_RETURN_M = 0.5
AROUND_CAMERAS_M = 60.0
ERROR_CELL_PX = 8
ERROR_KEPT = 0.7
BOX_PERCENTILES = (2.0, 98.0)


LidarRays = tuple[Rays, Tensor]
"""LiDAR measurements: rays with times in seconds f64[M, 1], and their ranges f32[M] in metres."""


def lidar_rays(scene: Scene) -> LidarRays | None:
    """All returns of all sweeps; None where there are none. Each has its own time and, along the vehicle's path, its
    own origin."""
    share = 1.0
    parts: list[tuple[np.ndarray, ...]] = []
    along_path = lambda t: [np.interp(t, scene.ego.times_s, axis) for axis in scene.ego.world_from_ego[:, :3, 3].T]
    for sweep in log.progress(scene.sweeps, len(scene.sweeps), "reading LiDAR rays"):
        points = read_points(scene, sweep)
        share = min(share, MOST_LIDAR_RAYS / max(1, len(points.xyz) * len(scene.sweeps)))
        kept = slice(None, None, max(1, round(1 / share)))
        world = geometry.transform_points(sweep.world_from_lidar, points.xyz[kept]).astype(np.float64)
        time_s = sweep.time_s + points.dt_s[kept].astype(np.float64)
        moved = [now - then for now, then in zip(along_path(time_s), along_path(sweep.time_s))]
        origins = sweep.world_from_lidar[:3, 3] + np.stack(moved, -1)
        along = world - origins
        far = np.linalg.norm(along, axis=1)
        good = far > NEAREST_RETURN_M
        parts.append((origins[good], along[good] / far[good, None], far[good], time_s[good]))
    if not sum(len(part[0]) for part in parts):
        return None
    origins, directions, range_m, time_s = (torch.from_numpy(np.concatenate(column)) for column in zip(*parts))
    cameras = torch.zeros(len(range_m), dtype=torch.int64)
    return Rays(origins.float(), directions.float(), time_s[:, None], cameras), range_m.float()


def extent_of(scene: Scene, lidar: LidarRays | None) -> Extent:
    """The box of the LiDAR points (without the outermost 2 % along every axis), and the time of the log."""
    if lidar is None:
        places = np.stack([frame.view.center_world for frame in scene.frames])
        low, high = places.min(0) - AROUND_CAMERAS_M, places.max(0) + AROUND_CAMERAS_M
        reach = f"the inner box reaches {AROUND_CAMERAS_M:.0f} m around the cameras"
        log.warn(f"no LiDAR: {reach}, and nothing measures distance")
    else:
        rays, range_m = lidar
        points = (rays.origins + range_m[:, None] * rays.directions).numpy()
        low, high = np.percentile(points, BOX_PERCENTILES, axis=0)
    center, half = (low + high) / 2, np.maximum((high - low) / 2, 1.0)
    times = np.array(sorted({frame.view.time_s for frame in scene.frames}))
    own = np.array([frame.view.time_s for frame in scene.frames_of(scene.frames[0].view.camera.name)])
    gaps = np.diff(np.sort(own))
    start, end = times.min(), times.max()
    step = float(np.median(gaps)) if len(gaps) else 0.1
    return Extent(tuple(center.tolist()), tuple(half.tolist()), float(start), float(max(end - start, step)), step)


def view_rays(view: View, extent: Extent, camera: int) -> tuple[Rays, Tensor]:
    """A ray for every pixel, row by row, and the camera depth of each ray's unit length ``[R]``."""
    x, y = (torch.from_numpy(values.astype(np.float32)) for values in geometry.pixel_rays(view.camera))
    shape = len(y), len(x)
    plane = torch.stack([x.expand(shape), y[:, None].expand(shape), torch.ones(shape)], -1).reshape(-1, 3)
    poses = torch.tensor(view.world_from_cam, dtype=torch.float32).expand(len(plane), 4, 4)
    times = torch.full((len(plane), 1), extent.normalised(view.time_s))
    cameras = torch.full((len(plane),), camera, dtype=torch.int64)
    return _rays(plane, poses, times, cameras), 1 / plane.norm(dim=1)


def _rays(plane: Tensor, poses: Tensor, times: Tensor, cameras: Tensor) -> Rays:
    along = (poses[:, :3, :3] * plane[:, None, :]).sum(2)
    return Rays(poses[:, :3, 3], along / along.norm(dim=1, keepdim=True), times, cameras)


class Pixels:
    """All pixels of recorded views, and how badly they are met so far. ``cameras``: names; a ray carries the number of
    its camera."""

    def __init__(self, views: Sequence[StoredView], cameras: Sequence[str], extent: Extent) -> None:
        sizes = [view.rgb.shape[:2] for view in views]
        self._starts = torch.tensor([0, *np.cumsum([h * w for h, w in sizes])])
        self._sizes = torch.tensor(sizes)
        self._cells = (self._sizes + ERROR_CELL_PX - 1) // ERROR_CELL_PX
        self._cell_starts = torch.cat([torch.zeros(1, dtype=torch.int64), self._cells.prod(1).cumsum(0)])
        self.errors = torch.ones(int(self._cell_starts[-1]))
        self._rgb = torch.from_numpy(np.concatenate([view.rgb.reshape(-1, 3) for view in views]))
        masks = [np.ones(s, bool) if view.mask is None else view.mask for view, s in zip(views, sizes)]
        self._counts = torch.from_numpy(np.concatenate([mask.reshape(-1) for mask in masks]))
        skies = [np.asarray(view.sky, bool).reshape(-1) for view in views if view.sky is not None]
        self.sky = torch.from_numpy(np.concatenate(skies)) if len(skies) == len(views) else None  # known in all views
        self._poses = torch.from_numpy(np.stack([view.view.world_from_cam for view in views])).float()
        self._lenses = torch.tensor([view.view.camera.intrinsics for view in views], dtype=torch.float32)
        self._times = torch.tensor([[extent.normalised(view.view.time_s)] for view in views])
        self._cameras = torch.tensor([cameras.index(view.view.camera.name) for view in views])

    def batch(
        self, count: int, error_share: float, generator: torch.Generator
    ) -> tuple[Rays, tuple[Tensor, Tensor, Tensor | None], Tensor]:
        """``count`` pixels, a share of them drawn where the error was large: rays; colours f32[R, 3], whether they
        count f32[R] and sky bool[R] or None; and cells of the error map i64[R]."""
        guided = round(count * error_share)
        draws = torch.rand(count, 3, generator=generator, dtype=torch.float64)
        even = (draws[guided:, 0] * float(self._starts[-1])).long()
        view = torch.searchsorted(self._starts, even, right=True) - 1
        inside = even - self._starts[view]
        width = self._sizes[view, 1]
        row, column = inside // width, inside % width
        if guided:
            found = self._badly_met(draws[:guided])
            view, row, column = (torch.cat(pair) for pair in zip(found, (view, row, column)))
        pixel = self._starts[view] + row * self._sizes[view, 1] + column
        cell = self._cell_starts[view] + (row // ERROR_CELL_PX) * self._cells[view, 1] + column // ERROR_CELL_PX
        fx, fy, cx, cy = self._lenses[view].unbind(1)
        plane = torch.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, torch.ones_like(fx)], 1)
        rays = _rays(plane, self._poses[view], self._times[view], self._cameras[view])
        sky = None if self.sky is None else self.sky[pixel]
        return rays, (self._rgb[pixel].float() / 255, self._counts[pixel].float(), sky), cell

    def _badly_met(self, draws: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """View, row and column of pixels in cells drawn by their error."""
        upto = self.errors.double().cumsum(0)
        cell = torch.searchsorted(upto, draws[:, 0] * upto[-1], right=True).clamp(max=len(upto) - 1)
        view = torch.searchsorted(self._cell_starts, cell, right=True) - 1
        inside, across = cell - self._cell_starts[view], self._cells[view, 1]
        size = self._sizes[view]
        row = (inside // across * ERROR_CELL_PX + (draws[:, 1] * ERROR_CELL_PX).long()).minimum(size[:, 0] - 1)
        column = (inside % across * ERROR_CELL_PX + (draws[:, 2] * ERROR_CELL_PX).long()).minimum(size[:, 1] - 1)
        return view, row, column

    def note(self, cells: Tensor, error: Tensor) -> None:
        """Take the errors of a batch into the map (a moving average; of several pixels in a cell, the last)."""
        self.errors[cells] = ERROR_KEPT * self.errors[cells] + (1 - ERROR_KEPT) * error.cpu().sqrt()


# views of a field ---------------------------------------------------------------------------------

RAYS_AT_ONCE = 2048
PREVIEW_RAYS = 6000


@torch.no_grad()
def observe(field: RadianceField, view: View, budget: Budget, source: str = "") -> Observation:
    """One view as an observation of kind "virtual", on the CPU, without classes; depth is that of the median. Where
    opacity is below ``COVERED`` there is no depth."""
    camera, parts = view.camera, []
    rays, z_per_m = view_rays(
        view, field.extent, field.cameras.index(camera.name) if camera.name in field.cameras else 0
    )
    for begin in range(0, len(rays), RAYS_AT_ONCE):
        part = rays[begin : begin + RAYS_AT_ONCE].to(field.device)
        marched = march(field, part, budget)
        rest = torch.stack([marched.median_m, marched.opacity], 1)
        parts.append(torch.cat([colors(field, part, marched)[0], rest], 1).cpu())
    seen = torch.cat(parts).view(camera.height, camera.width, 5).permute(2, 0, 1)
    depth, opacity = seen[3:4] * z_per_m.view(1, camera.height, camera.width), seen[4:5]
    covered, opacity = opacity >= COVERED, opacity.clamp(0, 1)
    depth, sure = torch.where(covered, depth, torch.nan), torch.where(covered, opacity, 1 - opacity)
    return Observation(view, seen[:3].clamp(0, 1), depth, None, sure, torch.ones_like(covered), "virtual", source)


def write_preview(field: RadianceField, stored: StoredView, budget: Budget, path: Path) -> None:
    """A picture of three panels, coarser than the view: truth, colour, depth."""
    camera = stored.view.camera
    share = min(1.0, (PREVIEW_RAYS / (camera.width * camera.height)) ** 0.5)
    view = stored.view.resized(*(max(1, round(size * share)) for size in (camera.width, camera.height)))
    truth = resize_area(stored.rgb, view.camera.width, view.camera.height)
    store.write_image(path, np.concatenate([truth, *panels_of(observe(field, view, budget))], 1))


# on disk ------------------------------------------------------------------------------------------


def save_field(field: RadianceField, budget: Budget, folder: Path) -> None:
    """Field and sampling, without optimiser moments."""
    description = {"schema": 1, "kind": RADIANCE, **field.description(), "budget": asdict(budget)}
    store.write_json(folder / "model.json", description)
    store.write_safetensors(folder / "field.safetensors", {k: value.cpu() for k, value in field.state_dict().items()})


def load_field(folder: Path) -> tuple[RadianceField, Budget]:
    """Inverse of ``save_field``. InputError: not the folder of a finished fit of a radiance field. IntegrityError: a
    file was altered."""
    folder = Path(folder)
    if kind_of(folder) != RADIANCE:
        expected = "made by `mudg fit --method emernerf`"
        raise InputError("this folder holds no radiance field", where=str(folder), expected=expected)
    if (folder / store.MANIFEST).is_file():
        store.verify_manifest(folder)
    values, tensors = description_of(folder), store.read_tensors(folder / "field.safetensors")
    with records.understood("a radiance field", str(folder)):
        budget = records.parse_dataclass(Budget, values["budget"], "budget: ")
        return RadianceField.from_state(values, tensors), budget


# fit ----------------------------------------------------------------------------------------------

WARM_UP = 0.1
FALLS_AT, FALL = (0.25, 0.5, 0.75, 0.9), 0.33
RATE, BETAS, EPSILON, WEIGHT_DECAY = 0.01, (0.9, 0.99), 1e-15, 1e-5
"""Of Adam. The rate rises over the first WARM_UP of the run and falls at the shares FALLS_AT; the decay is added to the
gradient."""
PROPOSALS_EVERY = 5
"""After the warm-up the proposal networks learn at every n-th step only."""
ERROR_SHARE = 0.25
"""Share of the pixels that are drawn where the colour error was large."""
NEAR_M, FAR_M = 0.1, 1000.0
BUDGETS: Final[Mapping[str, Budget]] = {
    "small": Budget((64, 32), 32, NEAR_M, FAR_M),
    "published": Budget((128, 64), 64, NEAR_M, FAR_M),
    "tiny": Budget((16, 12), 8, NEAR_M, FAR_M),
}
"""Samples of a ray, by setting."""
BATCHES: Final[Mapping[str, tuple[int, int]]] = {"small": (512, 256), "published": (8192, 8192), "tiny": (48, 24)}
"""Pixels, and LiDAR rays, of a step, by setting."""
DYNAMIC_WEIGHT = 0.002
"""Of the dynamic density (published: 0.01, at once)."""
SIGHT_START, SIGHT_M, SIGHT_LEAST_M, SIGHT_HALVES = 0.08, 6.0, 0.6, 0.2
"""Share of the run before the line of sight counts; half width of its surface then, and at the end (published: 2.5 m);
share of the run in which it halves."""
DYNAMIC_RISE = (0.1, 0.5)
"""Shares of the run between which the weight of the dynamic density grows. From the first step on it would empty that
field."""


@dataclass
class RadianceState(Progress):
    """Everything that changes while fitting, and what it is fitted to."""

    field: RadianceField
    optimisers: tuple[torch.optim.Adam, torch.optim.Adam]  # of the fields, and of the proposal networks
    pixels: Pixels
    lidar: LidarRays | None
    shown: StoredView

    def summary(self) -> dict[str, Any]:
        """For run.json."""
        count = sum(value.numel() for value in self.field.parameters())
        return {"parameters": count, "steps": self.step, "seconds": round(self.seconds, 2), **(self.last or {})}


def fit_radiance(config: FitConfig, scene: Path, device: torch.device, folder: RunDir) -> dict[str, Any]:
    """Fit a field to a scene and write it to the folder; an interrupted fit goes on from its newest checkpoint. Returns
    a summary."""
    with one_torch_thread(), memory_of(device, "fit"):
        state = prepare(config, read_scene(scene), folder, device)
        optimise(state, config, folder)
    save_field(state.field, BUDGETS[config.radiance.size], folder.path)
    shutil.rmtree(folder.path / "steps", ignore_errors=True)
    return state.summary()


def prepare(config: FitConfig, scene: Scene, folder: RunDir, device: torch.device) -> RadianceState:
    """Read what is fitted to, and start from the newest checkpoint or from nothing."""
    frames = training_frames(scene, config.cameras)
    cameras = tuple(dict.fromkeys(frame.view.camera.name for frame in frames))
    lidar = lidar_rays(scene)
    extent = extent_of(scene, lidar)
    places = dict(load_recorded(scene, frames, (), config.width_px, False))
    views = [places[index] for index in range(len(frames))]
    pixels = Pixels(views, cameras, extent)
    if pixels.sky is None:
        log.info("the sky of this scene is not labelled: fitted without the sky term")
    facts = {"method": config.method, "scene": scene.id}
    field = RadianceField(SIZES[config.radiance.size], extent, cameras, facts, config.seed).to(device)
    proposals = list(field.proposals.parameters())
    own = {id(value) for value in proposals}
    fused = device.type in ("cpu", "cuda")
    of_fields, of_proposals = (
        torch.optim.Adam(given, RATE, BETAS, EPSILON, WEIGHT_DECAY, fused=fused, foreach=None if fused else False)
        for given in ([value for value in field.parameters() if id(value) not in own], proposals)
    )
    state = RadianceState(field, (of_fields, of_proposals), pixels, lidar, views[len(views) // 2])
    found = checkpoint.latest(folder.path / "steps")
    if found is not None:
        log.info(f"resuming at step {found.step} of {config.iterations}")
        _restore(state, found)
    return state


# ---- a step --------------------------------------------------------------------------------------


def optimise(state: RadianceState, config: FitConfig, folder: RunDir) -> None:
    """Fit up to step ``config.iterations``. Same inputs, same result, also across an interruption."""

    def take(step: int) -> tuple[dict[str, Any], partial[dict[str, float]]]:
        return {}, partial(_numbers, take_step(state, config, step))

    draw = lambda path: write_preview(state.field, state.shown, BUDGETS[config.radiance.size], path)
    run_steps(state, config, folder, take, lambda: save_checkpoint(state, folder), draw)


def take_step(state: RadianceState, config: FitConfig, step: int) -> dict[str, Tensor]:
    """A gradient step from pixels and one from LiDAR rays; the weighted loss terms of both."""
    field, device = state.field, state.field.device
    budget, (pixels, returns) = BUDGETS[config.radiance.size], BATCHES[config.radiance.size]
    dynamic = DYNAMIC_WEIGHT * dynamic_share(step, config.iterations)
    learns = step <= WARM_UP * config.iterations or step % PROPOSALS_EVERY == 0
    for optimiser in state.optimisers:
        for group in optimiser.param_groups:
            group["lr"] = RATE * rate_share(step, config.iterations)

    generator = seeds.torch_generator(config.seed, step, "radiance pixels")
    given, (rgb, counts, sky), cells = state.pixels.batch(pixels, ERROR_SHARE, generator)
    marched, draws, rays = _marched(field, given, budget, generator, learns)
    truth = rgb.to(device), counts.to(device), None if sky is None else sky.to(device)
    terms, error = pixel_terms(field, rays, marched, draws, truth, dynamic)
    _learn(state, terms, marched, learns, step, "of pixels")
    state.pixels.note(cells, error)
    if state.lidar is None:
        return terms

    generator = seeds.torch_generator(config.seed, step, "radiance lidar")
    every, ranges = state.lidar
    chosen = torch.randint(0, len(every), (returns,), generator=generator)
    given, range_m = every[chosen], ranges[chosen]
    times = ((given.times - field.extent.start_s) / field.extent.span_s).clamp(0, 1)
    given = replace(given, times=times.float())
    marched, draws, _ = _marched(field, given, budget, generator, learns)
    sight_m = sight_width(step, config.iterations)
    measured = lidar_terms(field, marched, draws, range_m.to(device), dynamic, sight_m)
    _learn(state, measured, marched, learns, step, "of LiDAR")
    return terms | {name if name not in terms else f"{name}_lidar": value for name, value in measured.items()}


def _marched(
    field: RadianceField, rays: Rays, budget: Budget, generator: torch.Generator, learns: bool
) -> tuple[Marched, RayDraws, Rays]:
    """A training batch on the device: marched, with what was drawn for it. The one way there."""
    there = rays.to(field.device)
    draws = RayDraws.of(len(rays), budget, generator, field.device)
    return march(field, there, budget, draws, learns), draws, there


def _learn(
    state: RadianceState, terms: Mapping[str, Tensor], marched: Marched, learns: bool, step: int, view: str
) -> None:
    """One step of the optimisers down the sum of the terms; NumericsError before that if something is not finite."""
    check, clear = FiniteCheck(step), state.field.zero_grad
    remedy = "the parameters are those of the step before; another --seed draws other rays"
    every = {**terms, **({"proposals": proposal_loss(marched)} if learns else {})}
    check.terms(view, every)
    clear()
    torch.stack(list(every.values())).sum().backward()
    named = {name: value.grad for name, value in state.field.named_parameters() if value.grad is not None}
    check.sums(view, named, remedy, clear)
    check.refuse()
    for optimiser in state.optimisers[: 2 if learns else 1]:
        optimiser.step()


def rate_share(step: int, iterations: int) -> float:
    """Learning rate of a step (from 1) as a share of the full one."""
    rising = min(1.0, step / max(1.0, WARM_UP * iterations))
    return rising * FALL ** sum(step > share * iterations for share in FALLS_AT)


def dynamic_share(step: int, iterations: int) -> float:
    """Weight of the dynamic density at a step as a share of the full one."""
    first, last = DYNAMIC_RISE
    return min(1.0, max(0.0, (step / iterations - first) / max(last - first, 1e-9)))


def sight_width(step: int, iterations: int) -> float:
    """Half width of the surface in the line-of-sight term at a step, metres; 0 before it begins."""
    since = step / iterations - SIGHT_START
    return 0.0 if since <= 0 else max(SIGHT_LEAST_M, SIGHT_M * 0.5 ** math.floor(since / SIGHT_HALVES))


def _numbers(terms: Mapping[str, Tensor]) -> dict[str, float]:
    values = torch.stack([value.detach() for value in terms.values()]).tolist()
    named = {f"loss_{name}": round(value, 7) for name, value in zip(terms, values)}
    return {"psnr": round(-10 * math.log10(max(named["loss_color"], 1e-10)), 3), **named}


def save_checkpoint(state: RadianceState, folder: RunDir) -> None:
    """All that changes: parameters, moments, the error map, the step."""
    field = {name: value.cpu() for name, value in state.field.state_dict().items()}
    moments = {
        f"{kind}.{name}": moment.detach().cpu()
        for name, value in state.field.named_parameters()
        for optimiser in state.optimisers
        for kind, moment in optimiser.state.get(value, {}).items()
    }
    groups = {"field": field, "moments": moments, "errors": {"errors": state.pixels.errors}}
    checkpoint.save(folder.path / "steps", state.step, groups, state.facts())


def _restore(state: RadianceState, found: checkpoint.Checkpoint) -> None:
    state.field.load_state_dict(found.tensors("field"))
    moments = found.tensors("moments")
    for name, value in state.field.named_parameters():
        own = {kind: moments.get(f"{kind}.{name}") for kind in ("step", "exp_avg", "exp_avg_sq")}
        for optimiser in state.optimisers:
            if own["step"] is not None and any(value is one for one in optimiser.param_groups[0]["params"]):
                optimiser.state[value] = {kind: tensor.to(value.device) for kind, tensor in own.items()}
    state.pixels.errors = found.tensors("errors")["errors"]
    state.resume(found)
