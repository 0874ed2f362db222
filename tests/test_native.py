"""The native library: loading it, its thread pool, and the fused training kernels against their plain twins."""

from __future__ import annotations

import ctypes
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import refused
from torch import Tensor

from mudg import native
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.core import native_ops
from mudg.core.native_ops import AdamColumn

needs_native = pytest.mark.skipif(native.library() is None, reason=native.status())


# ---- loading -------------------------------------------------------------------------------------


@needs_native
def test_status_names_what_is_in_use_and_nothing_unknown_is_taken() -> None:
    words = native.status()
    assert native.isa() in words and f"{native.threads()} threads" in words
    before = native.isa()
    refused("instruction set", native.set_isa, "mmx", raises=UsageError)
    assert native.isa() == before
    refused("at least 1", native.set_threads, 0, raises=UsageError)


@pytest.fixture
def unloaded(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """As before anything was loaded."""
    monkeypatch.setattr(native, "_loaded", None)
    monkeypatch.setattr(native, "_problem", "")
    return monkeypatch


def test_a_missing_library_is_named_with_its_remedy(unloaded: pytest.MonkeyPatch, tmp_path: Path) -> None:
    unloaded.setattr(native, "LIBRARY_PATH", tmp_path / "nothing.so")
    unloaded.setattr(native, "FOLDER", tmp_path)
    (tmp_path / "build_info.json").write_text('{"native": false, "reason": "no C++ compiler was found"}')
    assert native.library() is None and "no C++ compiler was found" in native.status() and "ziglang" in native.status()
    assert native.threads() == 1
    refused("drawing a picture needs the native library", native.require, "drawing a picture", raises=ResourceError)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("LIBRARY_PATH", Path(__file__), "does not load"),
        pytest.param("ABI_VERSION", 999, "build it again", marks=needs_native),
        ("MUDG_NATIVE", "off", "MUDG_NATIVE=off"),
    ],
)
def test_a_library_that_is_not_taken_is_named(unloaded: pytest.MonkeyPatch, name: str, value: Any, said: str) -> None:
    unloaded.setenv(name, value) if name == "MUDG_NATIVE" else unloaded.setattr(native, name, value)
    assert native.library() is None and said in native.status()


def test_the_thread_count_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUDG_THREADS", "3")
    assert native.default_threads() == 3
    for text in ("0", "-1", "many", "1.5"):
        monkeypatch.setenv("MUDG_THREADS", text)
        refused("MUDG_THREADS", native.default_threads, raises=UsageError)
    monkeypatch.delenv("MUDG_THREADS")
    assert native.default_threads() >= 1


# ---- the pool ------------------------------------------------------------------------------------


@pytest.mark.parametrize("threads", [1, 2, 7])
def test_every_index_is_visited_exactly_once(set_threads: Callable[[int], None], threads: int) -> None:
    set_threads(threads)
    summed = native.require("the test").mudg_parallel_sum
    summed.argtypes, summed.restype = [ctypes.c_int64, ctypes.c_int64], ctypes.c_int64
    for count, grain in ((0, 1), (1, 1), (5, 100), (1000, 1), (100_003, 64), (64, 0)):
        assert summed(count, grain) == count * (count - 1) // 2


@needs_native
@pytest.mark.skipif(not hasattr(__import__("os"), "fork"), reason="no fork on this system")
def test_a_forked_child_gets_a_pool_of_its_own() -> None:
    script = """
import ctypes, os, warnings
warnings.simplefilter("ignore")
from mudg import native
library = native.require()
native.set_threads(3)
expected = 100000 * 99999 // 2
library.mudg_parallel_sum.argtypes = [ctypes.c_int64, ctypes.c_int64]
library.mudg_parallel_sum.restype = ctypes.c_int64
assert library.mudg_parallel_sum(100000, 100) == expected
child = os.fork()
if child == 0:
    os._exit(0 if library.mudg_parallel_sum(100000, 100) == expected else 1)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
assert library.mudg_parallel_sum(100000, 100) == expected
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


# ---- photometric loss ----------------------------------------------------------------------------


def _images(shape: tuple[int, int, int], seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(shape, generator=generator)
    return (target + 0.1 * torch.randn(shape, generator=generator)).clamp(0, 1), target


def _gradients(value: Tensor, *inputs: Tensor) -> list[Tensor]:
    value.backward()
    return [t.grad.double() for t in inputs]


@pytest.mark.parametrize("shape", [(3, 1, 1), (3, 5, 7), (1, 40, 33), (3, 37, 64), (2, 70, 16), (3, 33, 129)])
@pytest.mark.parametrize(("ssim", "weighted"), [(0.0, False), (0.2, False), (1.0, False), (0.4, True)])
def test_photometric_equals_its_float64_twin(
    isa: str, shape: tuple[int, int, int], ssim: float, weighted: bool
) -> None:
    prediction, target = _images(shape)
    weight = torch.rand(shape[1:], generator=torch.Generator().manual_seed(2)) * (torch.arange(shape[2]) % 5 > 0)
    of = lambda dtype: (weight.to(dtype),) if weighted else ()
    mine, exact = prediction.clone().requires_grad_(), prediction.double().requires_grad_()
    got = native_ops.photometric(mine, target, ssim, *of(torch.float32))
    want = native_ops.photometric(exact, target.double(), ssim, *of(torch.float64))
    assert got.item() == pytest.approx(want.item(), rel=1e-6, abs=1e-7)
    (found,), (true,) = _gradients(3 * got, mine), _gradients(3 * want, exact)
    assert (found - true).norm() <= 2e-6 * true.norm() + 1e-12


# ---- means over boxes ----------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1, 1), (3, 2, 9), (1, 4, 40, 33), (2, 5, 129)])
@pytest.mark.parametrize("size", [1, 5, 7])
def test_box_mean_equals_its_float64_twin(isa: str, shape: tuple[int, ...], size: int) -> None:
    generator = torch.Generator().manual_seed(4)
    values, upstream = (torch.randn(shape, generator=generator) for _ in range(2))
    mine, exact = values.clone().requires_grad_(), values.double().requires_grad_()
    got, want = native_ops.box_mean(mine, size), native_ops.box_mean(exact, size)
    assert got.shape == values.shape and (got.double() - want).abs().max() < 1e-6
    got.backward(upstream)
    want.backward(upstream.double())
    assert mine.grad is not None and exact.grad is not None and (mine.grad.double() - exact.grad).abs().max() < 2e-6


def adam(*tensors: Any) -> None:
    """A step on one column: parameter, gradient, both moments, rate; then step and chosen rows."""
    native_ops.adam_columns([AdamColumn(*tensors[:5])], *tensors[5:])


def test_without_the_library_plain_torch_does_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    (prediction, target), cover = _images((3, 20, 20)), _images((1, 20, 20))[0]
    labels = torch.arange(400).view(20, 20) % 4

    def all_of_them() -> list[Tensor]:
        moved = torch.ones(4, 3)
        adam(moved, torch.full((4, 3), 0.5), torch.zeros(4, 3), torch.zeros(4, 3), 0.1, 1)
        boxes, sky = native_ops.box_mean(prediction, 3), native_ops.over(prediction, cover, target[:, ::2])
        named = native_ops.class_loss(prediction, labels, cover[0], 2.0)
        return [native_ops.photometric(prediction, target), boxes, sky, named, moved]

    with_library = all_of_them()
    monkeypatch.setattr(native, "_loaded", None)
    monkeypatch.setattr(native, "_problem", "not built: test")
    for mine, expected in zip(all_of_them(), with_library, strict=True):
        torch.testing.assert_close(mine, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(mine, torch.full((4, 3), 0.9))


# ---- cross entropy of classes, pictures over the sky ---------------------------------------------


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 3, 5), (5, 16, 16), (17, 33, 41), (19, 70, 61)])
@pytest.mark.parametrize("lifted", [False, True])
def test_class_loss_equals_its_float64_twin(isa: str, shape: tuple[int, int, int], lifted: bool) -> None:
    generator = torch.Generator().manual_seed(1)
    values = 20 * torch.randn(shape, generator=generator)
    target = torch.randint(0, shape[0], shape[1:], generator=generator)
    target[torch.rand(shape[1:], generator=generator) < 0.2] = 255
    weight, lift = torch.rand(shape[1:], generator=generator), 9 * torch.rand(shape[1:], generator=generator)
    mine, exact = values.clone().requires_grad_(), values.double().requires_grad_()
    channel = shape[0] - 1
    got = native_ops.class_loss(mine, target, weight, 7.0, (channel, lift) if lifted else None)
    want = native_ops.class_loss(exact, target, weight.double(), 7.0, (channel, lift.double()) if lifted else None)
    assert got.item() == pytest.approx(want.item(), rel=2e-6, abs=1e-6)
    (found,), (true,) = _gradients(3 * got, mine), _gradients(3 * want, exact)
    assert (found - true).norm() <= 3e-6 * true.norm() + 1e-9 and found[:, target == 255].abs().sum() == 0


@needs_native
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_class_loss_shows_a_logit_that_is_not_finite(isa: str, bad: float) -> None:
    logits = torch.zeros(6, 20, 20)
    logits[4, 7, 3] = bad
    target, weight = torch.zeros(20, 20, dtype=torch.int64), torch.ones(20, 20)
    assert not math.isfinite(native_ops.class_loss(logits, target, weight, 400.0).item())


@pytest.mark.parametrize(
    "sizes",
    [((3, 1, 1), (1, 1)), ((3, 7, 9), (3, 2)), ((1, 32, 64), (8, 16))]
    + [((3, 33, 50), (5, 13)), ((2, 9, 12), (9, 12)), ((3, 6, 5), (9, 11))],
)
def test_picture_over_the_sky_equals_its_float64_twin(
    isa: str, sizes: tuple[tuple[int, int, int], tuple[int, int]]
) -> None:
    generator = torch.Generator().manual_seed(2)
    (channels, height, width), small = sizes
    shapes = ((channels, height, width), (1, height, width), (channels, *small))
    inputs = [torch.rand(shape, generator=generator) for shape in shapes]
    upstream = torch.randn(channels, height, width, generator=generator)
    mine, exact = [t.clone().requires_grad_() for t in inputs], [t.double().requires_grad_() for t in inputs]
    got, want = native_ops.over(*mine), native_ops.over(*exact)
    torch.testing.assert_close(got.double(), want, rtol=1e-6, atol=2e-6)
    for found, true in zip(
        _gradients((got * upstream).sum(), *mine), _gradients((want * upstream).sum(), *exact), strict=True
    ):
        torch.testing.assert_close(found, true, rtol=2e-5, atol=2e-5)


def test_losses_and_sky_do_not_depend_on_the_number_of_threads(set_threads: Callable[[int], None]) -> None:
    generator = torch.Generator().manual_seed(3)
    logits, coarse, rgb = (torch.randn(shape, generator=generator) for shape in ((9, 90, 70), (3, 20, 15), (3, 90, 70)))
    target, weight = torch.randint(0, 9, (90, 70), generator=generator), torch.rand(90, 70, generator=generator)
    results = []
    for threads in (1, 3):
        set_threads(threads)
        leaves = [t.clone().requires_grad_() for t in (logits, coarse, rgb, weight)]
        sky = native_ops.over(leaves[2], leaves[3][None], leaves[1])
        value = native_ops.class_loss(leaves[0], target, weight, 10.0) + sky.square().sum()
        value = value + native_ops.photometric(leaves[2], _images((3, 90, 70))[1])
        results.append([value.detach(), *_gradients(value, *leaves)])
    assert all(torch.equal(one, other) for one, other in zip(*results, strict=True))


# ---- Adam ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1,), (1000,), (257, 3), (40, 16, 3), (0, 4)])
@pytest.mark.parametrize("sparse", [False, True])
def test_adam_equals_its_float64_twin(isa: str, shape: tuple[int, ...], sparse: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    parameter = torch.randn(shape, generator=generator)
    visible = torch.rand(shape[:1], generator=generator) > 0.4 if sparse else None
    mine = [parameter.clone(), torch.zeros(shape), torch.zeros(shape)]
    exact = [t.double() for t in mine]
    for step in range(1, 6):
        gradient = torch.randn(shape, generator=generator)
        adam(mine[0], gradient, mine[1], mine[2], 1e-2, step, visible)
        adam(exact[0], gradient.double(), exact[1], exact[2], 1e-2, step, visible)
    for got, want in zip(mine, exact):
        torch.testing.assert_close(got.double(), want, rtol=2e-6, atol=2e-6)
    if visible is not None:
        assert torch.equal(mine[0][~visible], parameter[~visible]) and mine[1][~visible].abs().sum() == 0


@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 1.0])
def test_adam_on_all_columns_in_one_pass_is_adam_on_each(isa: str, share: float) -> None:
    """Bit for bit; narrow and wide columns; invisible rows are not looked at."""
    generator = torch.Generator().manual_seed(2)
    rows, visible = 1037, torch.rand(1037, generator=generator) < share
    shapes = [(rows,), (rows, 3), (rows, 4), (rows, 15, 3), (rows, 16), (rows, 17)]
    together = [[torch.rand(shape, generator=generator) for _ in range(4)] for shape in shapes]
    for values in together:
        values[1][~visible] = float("nan")
    alone = [[t[visible].clone() for t in values] for values in together]
    before = [[t.clone() for t in values] for values in together]
    native_ops.adam_columns([AdamColumn(*values, rate=0.1 * i) for i, values in enumerate(together, 1)], 3, visible)
    for i, values in enumerate(alone, 1):
        adam(values[0], values[1], values[2], values[3], 0.1 * i, 3)
    for values, expected, old in zip(together, alone, before):
        for k in (0, 2, 3):
            assert torch.equal(values[k][visible], expected[k]) and torch.equal(values[k][~visible], old[k][~visible])


@needs_native
def test_adam_tells_autograd_that_values_have_changed() -> None:
    weight = torch.ones(5, requires_grad=True)
    loss = (weight * weight).sum()
    adam(weight.detach(), torch.ones(5), torch.zeros(5), torch.zeros(5), 0.1, 1)
    refused("inplace", loss.backward, raises=RuntimeError)


# ---- what does not fit ---------------------------------------------------------------------------

FLAT, IMAGE, LABELS, PAIRS = torch.zeros(4, 4), torch.zeros(3, 4, 4), torch.zeros(4, 4).long(), torch.zeros(4, 2)


@pytest.mark.parametrize(
    ("words", "call", "inputs"),
    [
        ("wrong shape", native_ops.photometric, (IMAGE, torch.zeros(3, 4, 5))),
        ("wrong shape", native_ops.photometric, (IMAGE, IMAGE, 0.2, FLAT[None])),
        ("SSIM", native_ops.photometric, (IMAGE, IMAGE, 1.5)),
        ("odd", native_ops.box_mean, (FLAT[None], 4)),
        ("class loss", native_ops.class_loss, (IMAGE, LABELS[:3], FLAT, 1.0)),
        ("lift", native_ops.class_loss, (IMAGE, LABELS, FLAT, 1.0, (3, FLAT))),
        ("over", native_ops.over, (IMAGE, torch.zeros(1, 4, 5), torch.zeros(3, 2, 2))),
        ("wrong shape", adam, (PAIRS, torch.zeros(4, 3), PAIRS, PAIRS, 0.1, 1)),
        ("chosen rows", adam, (PAIRS, PAIRS, PAIRS, PAIRS, 0.1, 1, torch.ones(3, dtype=torch.bool))),
        ("from 1", adam, (PAIRS, PAIRS, PAIRS, PAIRS, 0.1, 0)),
    ],
)
def test_what_does_not_fit_is_refused(words: str, call: Callable[..., object], inputs: tuple[Any, ...]) -> None:
    refused(words, call, *inputs, raises=UsageError if words in ("SSIM", "odd", "from 1") else InputError)
