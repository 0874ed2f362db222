"""The fields of EmerNeRF (Yang et al. 2023): what is at a place and a time, and how it moves.

    static    3-D grid -> density and a feature
    dynamic   4-D grid -> the same, averaged over where the place comes from and goes to (flow aggregation)
    flow      4-D grid -> motion to the next and from the previous time step, metres

One colour network reads the features of both, the direction and the camera's appearance; a shadow head lets what moves darken what stands;
the sky is a network of the direction. Two proposal networks say where samples are worth taking.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import seeds
from mudg.base.errors import InputError
from mudg.core.hash_grid import HashGrid, encode
from mudg.models.radiance.sampling import contract

OCTAVES = 5
DIRECTION_WIDTH = 3 + 6 * OCTAVES
TABLE_START = 1e-4
LARGEST_LOG_DENSITY = 12.0


@dataclass(frozen=True)
class FieldSizes:
    """Sizes of all networks; a grid is (levels, features per level, coarsest, finest, log2 of the entries of a level)."""

    static: tuple[int, int, int, int, int]
    dynamic: tuple[int, int, int, int, int]
    flow: tuple[int, int, int, int, int]
    proposals: tuple[tuple[int, int, int, int, int], ...]
    width: int
    proposal_width: int
    appearance: int


@dataclass(frozen=True)
class Extent:
    """Where and when the log is: a box (center, half size, metres), the first time, the time span, and one time step (all seconds)."""

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


@dataclass(frozen=True, eq=False)
class FieldValues:
    """What the fields say at N samples: features ``[N, width]``, densities ``[N]`` per metre, flow ``[N, 6]`` (forward, backward) in metres
    per time step."""

    static: Tensor
    dynamic: Tensor
    static_density: Tensor
    dynamic_density: Tensor
    flow: Tensor


class RadianceField(nn.Module):
    """All fields with their parameters.

    Args:
        cameras: names; each has an appearance of its own.
        facts: method, scene and so on, kept on disk.
    """

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

    def values(self, xyz: Tensor, time: Tensor, share: Tensor | float = 1.0) -> FieldValues:
        """Everything at places ``[N, 3]`` and normalised times ``[N, 1]``.

        Args:
            share: of the flow that aggregation follows, ``[N, 1]`` in [0, 1]: random while training, 1 else.
        """
        static, flow = self.static(self.unit(xyz)), self.flow_at(xyz, time)
        dynamic = aggregated(self.dynamic_feature, xyz, time, flow, share, self.extent.step)
        return FieldValues(static, dynamic, _density(static[:, 0]), _density(dynamic[:, 0]), flow)

    def dynamic_feature(self, xyz: Tensor, time: Tensor) -> Tensor:
        """The dynamic field's feature ``[N, width]``, not aggregated."""
        return self.dynamic(torch.cat([self.unit(xyz), time.clamp(0, 1)], 1))

    def context(self, directions: Tensor, camera: Tensor) -> Tensor:
        """What colour depends on besides the place: coded direction and appearance, ``[R, ...]``."""
        return torch.cat([encoded_direction(directions), self.appearance[camera]], 1)

    def cycle_loss(self, xyz: Tensor, time: Tensor, flow: Tensor) -> Tensor:
        """How far the flow there and back misses its start: half the mean of both squares. What it is compared with is data."""
        forward, backward, step = flow[:, :3], flow[:, 3:], self.extent.step
        with torch.no_grad():
            back = self.flow_at(xyz + forward, (time + step).clamp(0, 1))[:, 3:]
            forth = self.flow_at(xyz + backward, (time - step).clamp(0, 1))[:, :3]
        return 0.5 * ((forward + back).square() + (backward + forth).square()).mean()

    # -- state ------------------------------------------------------------------------------------------------------

    def description(self) -> dict[str, Any]:
        """Everything but the parameters, as JSON values."""
        return {
            "sizes": asdict(self.sizes),
            "extent": asdict(self.extent),
            "cameras": list(self.cameras),
            "facts": self.facts,
        }

    @classmethod
    def from_state(cls, values: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> RadianceField:
        """Inverse of ``description`` and ``state_dict``.

        Raises:
            InputError: tensors are missing, left over or of another shape.
        """
        sizes = {
            k: v if isinstance(v, int) else tuple(tuple(r) if isinstance(r, list) else r for r in v)
            for k, v in values["sizes"].items()
        }
        extent = {k: tuple(v) if isinstance(v, list) else v for k, v in values["extent"].items()}
        field = cls(FieldSizes(**sizes), Extent(**extent), values["cameras"], values["facts"])
        wanted = {name: tuple(tensor.shape) for name, tensor in field.state_dict().items()}
        given = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
        if wanted != given:
            odd = sorted(name for name in wanted.keys() | given.keys() if wanted.get(name) != given.get(name))
            raise InputError(
                "the parameters do not fit the radiance field",
                got=", ".join(odd[:4]),
                expected=f"{len(wanted)} tensors",
            )
        field.load_state_dict(dict(tensors))
        return field


def aggregated(feature: Any, xyz: Tensor, time: Tensor, flow: Tensor, share: Tensor | float, step: float) -> Tensor:
    """A feature averaged along the flow: ``(f(x, t) + f(x + n v_f, t + n D) / 2 + f(x + n v_b, t - n D) / 2) / 2``.

    Args:
        feature: (places [N, 3], times [N, 1]) -> [N, C].
        share: n, ``[N, 1]`` or a number. step: D, in normalised time.
    """
    here, count = feature(xyz, time), len(xyz)
    places = torch.cat([xyz + share * flow[:, :3], xyz + share * flow[:, 3:]])
    there = feature(places, torch.cat([time + share * step, time - share * step]))
    return 0.5 * here + 0.25 * (there[:count] + there[count:])


def encoded_direction(directions: Tensor) -> Tensor:
    """Directions ``[R, 3]`` with the sines and cosines of 2^k times them, k = 0..4: ``[R, 33]``."""
    scaled = torch.cat([directions * 2.0**k for k in range(OCTAVES)], 1)
    return torch.cat([directions, scaled.sin(), scaled.cos()], 1)


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

    def __init__(
        self, dimensions: int, grid: tuple[int, int, int, int, int], layers: Sequence[int], draw: torch.Generator
    ) -> None:
        super().__init__()
        self.grid = HashGrid(dimensions, *grid)
        self.table = nn.Parameter(TABLE_START * (2 * torch.rand(self.grid.table_shape, generator=draw) - 1))
        self.net = _Mlp((self.grid.width, *layers), draw)

    def forward(self, points: Tensor) -> Tensor:
        return self.net(encode(points, self.table, self.grid))


class _ColorNet(nn.Module):
    """Colour of features seen from a direction: three layers, the input read again by the second.

    What belongs to a ray is multiplied once per ray, not once per sample.
    """

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
