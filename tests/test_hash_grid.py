"""The multi-resolution hash grid: native op against its twin, the twin against finite differences."""

from __future__ import annotations

import itertools

import pytest
import torch

from mudg import native
from mudg.base import seeds
from mudg.base.errors import InputError, UsageError
from mudg.core.grids import HashGrid, encode, torch_encode

GRIDS = [
    HashGrid(3, 3, 2, 2, 20, 8),
    HashGrid(4, 3, 4, 2, 9, 9),
    HashGrid(3, 2, 1, 3, 5, 12),
    HashGrid(4, 2, 8, 1, 6, 8),
]


def drawn(
    grid: HashGrid, count: int, dtype: torch.dtype = torch.float32
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = seeds.torch_generator(3, count, "hash grid")
    points = torch.rand(count, grid.dimensions, generator=generator, dtype=torch.float64)
    table = torch.randn(grid.table_shape, generator=generator, dtype=torch.float64)
    upstream = torch.randn(count, grid.width, generator=generator, dtype=torch.float64)
    return points.to(dtype).requires_grad_(), table.to(dtype).requires_grad_(), upstream.to(dtype)


def test_levels_hold_all_corners_until_they_are_too_many():
    grid = HashGrid(3, 4, 2, 2, 16, 8)
    assert grid.resolutions == (2, 4, 8, 16)
    assert grid.hashed == (False, False, True, True)
    assert grid.entries == (27, 125, 256, 256)
    assert grid.table_shape == (664, 2)
    with pytest.raises(UsageError):
        HashGrid(2, 4, 2, 2, 16, 8)


def test_a_linear_function_on_the_corners_is_met_exactly_between_them():
    grid = HashGrid(3, 1, 1, 4, 4, 10)
    corners = torch.tensor(list(itertools.product(range(5), repeat=3)), dtype=torch.float32).flip(
        1
    )  # the first axis fastest
    table = (corners @ torch.tensor([1.0, -2.0, 0.5]))[:, None]
    points, _, _ = drawn(grid, 50)
    wanted = 4 * points @ torch.tensor([1.0, -2.0, 0.5])
    for given in (encode, torch_encode):
        assert torch.allclose(given(points, table, grid)[:, 0], wanted, atol=1e-5)


def test_finite_differences_of_the_twin():
    for grid in (HashGrid(3, 2, 2, 1, 3, 4), HashGrid(4, 1, 1, 2, 2, 5)):
        points, table, _ = drawn(grid, 3, torch.float64)
        assert torch.autograd.gradcheck(
            lambda p, t, g=grid: torch_encode(p, t, g), (points, table), eps=1e-7, atol=1e-5
        )


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


@pytest.mark.skipif(native.library() is None, reason="no native library")
def test_the_number_of_threads_and_the_instruction_set_change_no_bit():
    grid, made = GRIDS[1], []
    threads, isa = native.threads(), native.isa()
    try:
        for count, name in ((1, ""), (2, ""), (5, ""), (2, "portable")):
            native.set_threads(count)
            native.set_isa(name)
            points, table, upstream = drawn(grid, 9000)
            out = encode(points, table, grid)
            (out * upstream).sum().backward()
            made.append((out.detach(), table.grad, points.grad))
    finally:
        native.set_threads(threads)
        native.set_isa(isa)
    for other in made[1:]:
        assert all(torch.equal(a, b) for a, b in zip(made[0], other))


def test_points_that_are_data_get_no_gradient():
    points, table, upstream = drawn(GRIDS[0], 10)
    (encode(points.detach(), table, GRIDS[0]) * upstream).sum().backward()
    assert table.grad is not None and points.grad is None


def test_wrong_shapes_are_refused():
    points, table, _ = drawn(GRIDS[0], 10)
    with pytest.raises(InputError, match="shapes"):
        encode(points, table[:-1], GRIDS[0])
    assert encode(points[:0], table, GRIDS[0]).shape == (0, 6)
