"""The multi-resolution hash grid, and planes of place and time: native ops against their twins, these against finite
differences."""

from __future__ import annotations

import itertools

import pytest
import torch
from refusals import refused

from mudg import native
from mudg.base import seeds
from mudg.base.errors import UsageError
from mudg.core.grids import NATIVE_FEATURES, HashGrid, PlaneSizes, encode, look_up, torch_encode, torch_look_up

Drawn = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
GRIDS = [
    HashGrid(3, 3, 2, 2, 20, 8),
    HashGrid(4, 3, 4, 2, 9, 9),
    HashGrid(3, 2, 1, 3, 5, 12),
    HashGrid(4, 2, 8, 1, 6, 8),
]


def drawn(grid: HashGrid, count: int, dtype: torch.dtype = torch.float32) -> Drawn:
    generator = seeds.torch_generator(3, count, "hash grid")
    points = torch.rand(count, grid.dimensions, generator=generator, dtype=torch.float64)
    table = torch.randn(grid.table_shape, generator=generator, dtype=torch.float64)
    upstream = torch.randn(count, grid.width, generator=generator, dtype=torch.float64)
    return points.to(dtype).requires_grad_(), table.to(dtype).requires_grad_(), upstream.to(dtype)


def test_levels_hold_all_corners_until_they_are_too_many():
    grid = HashGrid(3, 4, 2, 2, 16, 8)
    assert grid.resolutions == (2, 4, 8, 16) and grid.hashed == (False, False, True, True)
    assert grid.entries == (27, 125, 256, 256) and grid.table_shape == (664, 2)
    refused(".", HashGrid, 2, 4, 2, 2, 16, 8, raises=UsageError)


def test_a_linear_function_on_the_corners_is_met_exactly_between_them():
    grid = HashGrid(3, 1, 1, 4, 4, 10)
    corners = torch.tensor(list(itertools.product(range(5), repeat=3)), dtype=torch.float32)
    corners = corners.flip(1)  # the first axis fastest
    table = (corners @ torch.tensor([1.0, -2.0, 0.5]))[:, None]
    points, _, _ = drawn(grid, 50)
    wanted = 4 * points @ torch.tensor([1.0, -2.0, 0.5])
    for given in (encode, torch_encode):
        assert torch.allclose(given(points, table, grid)[:, 0], wanted, atol=1e-5)


def test_finite_differences_of_the_twin():
    for grid in (HashGrid(3, 2, 2, 1, 3, 4), HashGrid(4, 1, 1, 2, 2, 5)):
        points, table, _ = drawn(grid, 3, torch.float64)
        op = lambda p, t, g=grid: torch_encode(p, t, g)
        assert torch.autograd.gradcheck(op, (points, table), eps=1e-7, atol=1e-5)


@pytest.mark.skipif(native.library() is None, reason="no native library")
@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_native_equals_the_twin(grid):
    results = []
    for op in (encode, torch_encode):
        points, table, upstream = drawn(grid, 3000)
        with torch.no_grad():
            points[0], points[1], points[2] = 0.0, 1.0, 1.5
        out = op(points, table, grid)
        (out * upstream).sum().backward()
        results.append((out.detach(), table.grad, points.grad))
    for mine, twin in zip(*results):
        assert float((mine - twin).abs().max() / twin.abs().max()) < 1e-5
    assert not results[0][2][2].any()  # beyond the border nothing changes


@pytest.mark.parametrize("kind", ["grid", "planes"])
def test_the_number_of_threads_and_the_instruction_set_change_no_bit(set_threads, kind):
    made, sizes = [], GRIDS[1] if kind == "grid" else PlaneSizes(8, 2, 5, 4, 1)
    for count, name in ((1, "portable"), (1, ""), (2, ""), (5, "")):
        set_threads(count)
        native.set_isa(name)
        places, numbers, upstream = (drawn if kind == "grid" else drawn_planes)(sizes, 9000)
        out = (encode if kind == "grid" else look_up)(places, numbers, sizes)
        (out * upstream).sum().backward()
        made.append((out.detach(), numbers.grad, places.grad))
    for other in made[1:]:
        assert all(torch.equal(a, b) for a, b in zip(made[0], other))


def test_points_that_are_data_get_no_gradient_and_wrong_shapes_are_refused():
    points, table, upstream = drawn(GRIDS[0], 10)
    (encode(points.detach(), table, GRIDS[0]) * upstream).sum().backward()
    assert table.grad is not None and points.grad is None
    points, table, _ = drawn(GRIDS[0], 10)
    refused("wrong shape", encode, points, table[:-1], GRIDS[0])
    assert encode(points[:0], table, GRIDS[0]).shape == (0, 6)


# -- planes -----------------------------------------------------------------------------------------


def drawn_planes(sizes: PlaneSizes, count: int, dtype: torch.dtype = torch.float32) -> Drawn:
    generator = seeds.torch_generator(3, count, "planes")
    places = torch.rand(count, 4, generator=generator, dtype=torch.float64) * 2 - 1
    numbers = torch.rand(sizes.numbers, generator=generator, dtype=torch.float64) + 0.3
    upstream = torch.randn(count, sizes.features * sizes.levels, generator=generator, dtype=torch.float64)
    return places.to(dtype).requires_grad_(), numbers.to(dtype).requires_grad_(), upstream.to(dtype)


def test_planes_of_coordinates_give_their_product_everywhere():
    """Each plane holds a linear function of its axes, so that the bilinear value is that function."""
    sizes = PlaneSizes(1, 2, 3, 4, 1)
    numbers = torch.zeros(sizes.numbers)
    slopes = ((1.0, 2.0), (0.5, -1.0), (0.2, 0.3), (-1.0, 1.5), (0.7, 0.1), (0.4, -0.6))
    for index, (_, plane) in enumerate(sizes.planes(numbers)):
        along, across = torch.linspace(-1, 1, plane.shape[1]), torch.linspace(-1, 1, plane.shape[0])
        a, b = slopes[index % 6]
        plane.copy_((3 + a * along[None, :] + b * across[:, None])[..., None])
    places, _, _ = drawn_planes(sizes, 40)
    x, y, z, t = places.detach().unbind(1)
    wanted = torch.ones(40)
    for (a, b), (one, other) in zip(slopes, ((x, y), (x, z), (y, z), (x, t), (y, t), (z, t))):
        wanted = wanted * (3 + a * one + b * other)
    for op in (look_up, torch_look_up):
        assert torch.allclose(op(places, numbers, sizes), wanted[:, None].expand(-1, 2), rtol=1e-5)


def test_finite_differences_of_the_twin_of_planes():
    sizes = PlaneSizes(2, 2, 2, 3, 1)
    places, numbers, _ = drawn_planes(sizes, 3, torch.float64)
    assert torch.autograd.gradcheck(lambda p, n: torch_look_up(p, n, sizes), (places, numbers), eps=1e-7, atol=1e-5)


@pytest.mark.skipif(native.library() is None, reason="no native library")
@pytest.mark.parametrize("features", NATIVE_FEATURES)
def test_native_planes_equal_the_twin_in_float64(features):
    sizes, results = PlaneSizes(features, 2, 3, 4, 1), []
    for op, dtype in ((look_up, torch.float32), (torch_look_up, torch.float64)):
        places, numbers, upstream = drawn_planes(sizes, 700)
        places, numbers = (value.detach().to(dtype).requires_grad_() for value in (places, numbers))
        with torch.no_grad():
            places[0], places[1], places[2] = -1.0, 1.0, torch.tensor([1.5, -1.5, 0.1, 2.0])
        out = op(places, numbers, sizes)
        (out * upstream).sum().backward()
        results.append((out.detach(), numbers.grad, places.grad))
    for mine, twin in zip(*results):
        assert float((mine - twin).abs().max() / twin.abs().max()) < 1e-5
    assert not results[0][2][:2].any()  # at and beyond the border nothing changes
    assert results[0][2][2].bool().tolist() == [False, False, True, False]


def test_what_the_native_op_does_not_know_goes_to_the_twin():
    for sizes in (PlaneSizes(3, 1, 3, 2, 1), PlaneSizes(2, 1, 3, 1, 1)):
        places, numbers, _ = drawn_planes(sizes, 5)
        assert torch.equal(look_up(places, numbers, sizes), torch_look_up(places, numbers, sizes))
    assert look_up(places[:0], numbers, sizes).shape == (0, 2)
    refused("wrong shape", look_up, places, numbers[:-1], sizes)
