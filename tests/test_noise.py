"""Noise schedule, prediction algebra and samplers against golden numbers and closed forms."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import refused

from mudg.base.errors import UsageError
from mudg.base.store import read_safetensors
from mudg.core import noise
from mudg.core.noise import Schedule, ScheduleConfig

GOLDEN = Path(__file__).parent / "golden" / "mdm_ddim.safetensors"
CASES = {
    "y_s50": (50, None, 1.0, 0.0),
    "y_s50_rescale": (50, 0.7, 1.0, 0.0),
    "y_s20": (20, 0.7, 2.0, 0.0),
    "y_s50_cfg": (50, 0.7, 7.5, 0.7),
    "y_s5_cfg": (5, 0.3, 7.5, 0.7),
}


@pytest.fixture(scope="module")
def golden():
    return {name: torch.from_numpy(array.copy()) for name, array in read_safetensors(GOLDEN).items()}


def test_schedule_equals_the_reference_and_known_values(golden):
    assert torch.equal(Schedule().alpha_bar.float(), golden["alphas_cumprod"])
    alpha_bar = Schedule().alpha_bar
    for t, value in ((0, 0.99915), (19, 0.98101), (99, 0.88809), (499, 0.24236), (899, 0.003033)):
        assert float(alpha_bar[t]) == pytest.approx(value, rel=2e-4)
    assert float(alpha_bar[999]) == 0.0
    assert float(Schedule(ScheduleConfig(zero_terminal_snr=False)).alpha_bar[999]) == pytest.approx(0.00466, rel=2e-3)


@pytest.mark.parametrize("case", CASES)
def test_ddim_equals_the_reference(golden, case):
    steps, base, scale, rescale = CASES[case]

    def velocity(x, t, condition):
        return 0.3 * torch.tanh(x) * math.cos(t / 1000) + 0.1 * condition - 0.2 * x

    def denoise(x, t):
        return noise.guide(velocity(x, t, golden["cond"]), velocity(x, t, golden["uncond"]), scale, rescale)

    schedule = Schedule(ScheduleConfig(base_scale=base))
    made = noise.ddim(
        denoise, golden["x_T"], schedule, noise.trailing_steps(1000, steps), prediction="v", eta=0.0, last="first_alpha"
    )
    assert float((made - golden[case]).norm() / golden[case].norm()) < 1e-4


def test_trailing_steps():
    assert noise.trailing_steps(1000, 50)[:3] == [999, 979, 959]
    assert noise.trailing_steps(1000, 50)[-1] == 19 and noise.trailing_steps(1000, 1) == [999]
    assert noise.trailing_steps(1000, 1000) == list(range(999, -1, -1))
    for bad in (0, 1001):
        refused(".", noise.trailing_steps, 1000, bad, raises=UsageError)


@pytest.mark.parametrize("prediction", ["x0", "v"])
def test_predictions_invert_the_forward_process(prediction):
    schedule = Schedule()
    x0, eps = torch.randn(2, 5, 3, 4, 4, generator=torch.Generator().manual_seed(1)).unbind(0)
    for t in (0, 300, 900):
        index = torch.full((5,), t)
        x = schedule.add_noise(x0, eps, index)
        output = {"x0": x0, "v": schedule.velocity(x0, eps, index)}[prediction]
        alpha, sigma = schedule.alpha_sigma(index, x.ndim)
        back_x0, back_eps = noise.x0_and_eps(x, output, alpha, sigma, prediction)
        assert torch.allclose(back_x0, x0, atol=2e-3) and torch.allclose(back_eps, eps, atol=2e-3)


def test_what_cannot_be_is_refused():
    with pytest.raises(UsageError, match="prediction"):
        noise.x0_and_eps(torch.zeros(1), torch.zeros(1), torch.zeros(1), torch.ones(1), "eps")
    refused(".", noise.ddim, lambda x, t: x, torch.zeros(1), Schedule(), [999, 499], eta=1.0, raises=UsageError)
    for config in (ScheduleConfig(steps=1), ScheduleConfig(beta_start=0.2, beta_end=0.1)):
        refused(".", Schedule, config, raises=UsageError)


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_sampler_keeps_a_gaussian(eta):
    """The exact denoiser of data N(0, s^2) must give samples of that variance, deterministic or ancestral."""
    schedule, spread, generator = Schedule(), 0.5, torch.Generator().manual_seed(3)

    def denoise(x, t):
        a, s = float(schedule.alpha[t]), float(schedule.sigma[t])
        return a * spread**2 / (a**2 * spread**2 + s**2) * x

    draw = lambda: torch.randn(20000, generator=generator)
    steps = noise.trailing_steps(1000, 200)
    made = noise.ddim(denoise, draw(), schedule, steps, prediction="x0", eta=eta, draw=draw)
    assert float(made.std()) == pytest.approx(spread, abs=0.02)


def test_stratified_steps_cover_the_schedule():
    drawn = noise.stratified_steps(10, 1000, torch.Generator().manual_seed(0))
    assert sorted((drawn // 100).tolist()) == list(range(10))
    again = noise.stratified_steps(10, 1000, torch.Generator().manual_seed(0))
    assert torch.equal(drawn, again) and not torch.equal(drawn, drawn.sort().values)


def test_shared_noise_has_the_stated_correlation():
    made = noise.video_noise((4, 6, 8, 32, 32), torch.Generator().manual_seed(0), shared=0.3)
    assert float(made.std()) == pytest.approx(1.0, abs=0.01)
    correlation = np.corrcoef(made[:, 0].flatten().numpy(), made[:, 3].flatten().numpy())[0, 1]
    assert correlation == pytest.approx(0.3, abs=0.02)


def test_guidance_rescale_restores_the_spread():
    generator = torch.Generator().manual_seed(0)
    c, u = torch.randn(2, 3, 4, 16, 16, generator=generator).unbind(0)
    full = noise.guide(c, u, 7.5, 1.0)
    assert torch.allclose(full.std((1, 2, 3)), c.std((1, 2, 3)), rtol=1e-5)
    assert torch.equal(noise.guide(c, u, 1.0), u + (c - u))
