"""The fields of EmerNeRF (Yang et al. 2023): static (3-D grid -> density and a feature), dynamic (4-D, averaged along
the flow) and flow (4-D -> motion to the next and from the previous time step, metres). One colour network reads the
features, the direction and the camera's appearance; a shadow head lets what moves darken what stands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import records, seeds, weights
from mudg.baselines.omnire import waves
from mudg.core.grids import HashGrid, encode

# sampling -----------------------------------------------------------------------------------------


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
