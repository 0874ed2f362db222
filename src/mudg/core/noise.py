"""Noise schedule, the algebra between noise, data and velocity, and the samplers. Pure functions of tensors.

    alpha_bar_t   share of signal power left at step t;  alpha_t = sqrt(alpha_bar_t),  sigma_t = sqrt(1 - alpha_bar_t)
    x_t           alpha_t x_0 + sigma_t eps
    v_t           alpha_t eps - sigma_t x_0             (Salimans and Ho, "Progressive distillation", appendix D)
    SNR_t         alpha_t^2 / sigma_t^2

A step index `t` runs from 0 (nearly clean) to `steps - 1` (pure noise).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from mudg.base.errors import UsageError

Prediction = Literal["x0", "v"]
"""What a network states: the clean data, or the velocity."""

RESCALE_STEPS = 400
"""Number of steps over which the dynamic rescale falls from 1 to its base value."""


@dataclass(frozen=True)
class ScheduleConfig:
    """What fixes a noise schedule: betas linear in their square roots; with ``zero_terminal_snr`` rescaled so that the
    last step carries no signal at all (Lin et al., "Common diffusion noise schedules and sample steps are flawed",
    algorithm 1)."""

    steps: int = 1000
    beta_start: float = 0.00085
    beta_end: float = 0.012
    zero_terminal_snr: bool = True
    base_scale: float | None = None
    """Dynamic rescale: factor on x_0, which falls from 1 to this over the first 400 steps; None switches it off."""


class Schedule:
    """Table of alpha, sigma and scale for every step, computed in float64.

    `alpha`, `sigma`, `scale` are float32 tensors [steps]; `alpha_bar` is float64 [steps].
    """

    def __init__(self, config: ScheduleConfig = ScheduleConfig()) -> None:
        if config.steps < 2:
            raise UsageError("a noise schedule needs at least two steps", expected=">= 2", got=str(config.steps))
        if not 0 < config.beta_start <= config.beta_end < 1:
            what, expected = "betas of the noise schedule are out of order", "0 < beta_start <= beta_end < 1"
            raise UsageError(what, expected=expected, got=f"{config.beta_start}, {config.beta_end}")
        self.config = config
        betas = np.linspace(math.sqrt(config.beta_start), math.sqrt(config.beta_end), config.steps) ** 2
        root = np.sqrt(np.cumprod(1.0 - betas))
        if config.zero_terminal_snr:
            root = (root - root[-1]) * root[0] / (root[0] - root[-1])
        alpha_bar = root**2
        scale = np.ones(config.steps)
        if config.base_scale is not None:
            fall = np.linspace(1.0, config.base_scale, RESCALE_STEPS)
            scale = np.concatenate([fall, np.full(config.steps, config.base_scale)])[: config.steps]
        self.alpha_bar = torch.from_numpy(alpha_bar)
        self.alpha = torch.from_numpy(root).float()
        self.sigma = torch.from_numpy(np.sqrt(np.maximum(1.0 - alpha_bar, 0.0))).float()
        self.scale = torch.from_numpy(scale).float()

    def __len__(self) -> int:
        return self.config.steps

    def alpha_sigma(self, t: Tensor, ndim: int) -> tuple[Tensor, Tensor]:
        """alpha and sigma of steps `t` i64[B], shaped [B,1,...] with `ndim` axes for broadcasting."""
        shape = (-1,) + (1,) * (ndim - 1)
        where = t.to(self.alpha.device)
        return self.alpha[where].view(shape).to(t.device), self.sigma[where].view(shape).to(t.device)

    def snr(self, t: Tensor) -> Tensor:
        """Signal to noise ratio f32[B] of steps `t` i64[B] (0 at the last step of a zero-terminal-SNR schedule)."""
        alpha_bar = self.alpha_bar[t.cpu()]
        return (alpha_bar / (1.0 - alpha_bar)).float().to(t.device)

    def add_noise(self, x0: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """x_t of `x0` [B,...] with `noise` of the same shape at steps `t` i64[B]; applies the dynamic rescale."""
        alpha, sigma = self.alpha_sigma(t, x0.ndim)
        scale = self.scale[t.cpu()].view(alpha.shape).to(x0.device)
        return alpha * scale * x0 + sigma * noise

    def velocity(self, x0: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """v-target of training at steps `t`; `x0` is multiplied by the dynamic rescale first."""
        alpha, sigma = self.alpha_sigma(t, x0.ndim)
        scale = self.scale[t.cpu()].view(alpha.shape).to(x0.device)
        return alpha * noise - sigma * scale * x0


def x0_and_eps(
    x: Tensor, output: Tensor, alpha: Tensor, sigma: Tensor, prediction: Prediction
) -> tuple[Tensor, Tensor]:
    """Clean data and noise implied by a network output at one noise level.

    `x`, `output` [B,...]; `alpha`, `sigma` broadcastable. With `prediction="x0"` the noise is (x - alpha x0) / sigma,
    with sigma floored at 1e-4.
    """
    if prediction == "v":
        return alpha * x - sigma * output, alpha * output + sigma * x
    if prediction == "x0":
        return output, (x - alpha * output) / sigma.clamp(min=1e-4)
    raise UsageError("unknown prediction type", expected="x0 or v", got=str(prediction))


def loss_weight(schedule: Schedule, t: Tensor, clip: float = 5.0, floor: float = 1.0) -> Tensor:
    """Weight f32[B] on the squared error of x0: the v-loss weight 1 + SNR, clipped to [floor, clip].

    The squared error of v equals (1 + SNR) times that of x0. Without the clip the nearly clean steps rule the loss;
    without a floor (as in min-SNR weighting) a zero-terminal-SNR model is never trained at its first sampling step.
    """
    return (1.0 + schedule.snr(t)).clamp(min=floor, max=clip)


def stratified_steps(count: int, steps: int, generator: torch.Generator) -> Tensor:
    """`count` step indices i64[count], one in each of `count` equal strata of [0, steps), in random order.

    A low-discrepancy draw: every batch covers the whole schedule, which lowers the variance of the loss.
    """
    u = (torch.arange(count, dtype=torch.float64) + torch.rand(count, generator=generator, dtype=torch.float64)) / count
    order = torch.randperm(count, generator=generator)
    return (u * steps).long().clamp(max=steps - 1)[order]


def trailing_steps(steps: int, count: int) -> list[int]:
    """`count` descending step indices that end in the noisiest one: steps-1, ... ("trailing" spacing of Lin et al.)."""
    if not 1 <= count <= steps:
        raise UsageError("number of sampling steps out of range", expected=f"1 .. {steps}", got=str(count))
    return [int(t) for t in np.round(np.arange(steps, 0, -steps / count)).astype(int)[:count] - 1]


def video_noise(shape: Sequence[int], generator: torch.Generator, shared: float = 0.0) -> Tensor:
    """Standard normal noise f32 [B,T,...] whose frames share the fraction `shared` of their variance.

    Noise that is partly common to all frames lowers flicker; 0 gives independent frames. The draw is made on the CPU.
    """
    own = torch.randn(*shape, generator=generator)
    if shared <= 0:
        return own
    common = torch.randn(shape[0], 1, *shape[2:], generator=generator)
    return math.sqrt(shared) * common + math.sqrt(1.0 - shared) * own


def guide(conditional: Tensor, unconditional: Tensor, scale: float, rescale: float = 0.0) -> Tensor:
    """Classifier-free guidance u + scale (c - u), with the standard deviation pulled back to that of `c`.

    `rescale` r mixes r (guided * std(c) / std(guided)) with (1 - r) guided; standard deviations are per sample over all
    other axes, unbiased (Lin et al., equations 15 and 16).
    """
    guided = unconditional + scale * (conditional - unconditional)
    if rescale <= 0:
        return guided
    axes = tuple(range(1, guided.ndim))
    ratio = conditional.std(axes, keepdim=True) / guided.std(axes, keepdim=True)
    return rescale * (guided * ratio) + (1.0 - rescale) * guided


Denoise = Callable[[Tensor, int], Tensor]
"""(x_t [B,...], step index) -> network output [B,...] in the meaning that `prediction` names."""


def ddim(
    denoise: Denoise,
    start: Tensor,
    schedule: Schedule,
    step_indices: Sequence[int],
    *,
    prediction: Prediction = "x0",
    eta: float = 1.0,
    draw: Callable[[], Tensor] | None = None,
    last: Literal["x0", "first_alpha"] = "x0",
) -> Tensor:
    """Denoising diffusion implicit sampling (Song et al., equation 12) over descending `step_indices`.

    start        x at noise level step_indices[0], [B,...]
    eta          0 deterministic, 1 ancestral; needs `draw`, a function giving fresh noise of start's shape
    last         what the final step returns: "x0" the clean estimate itself; "first_alpha" one more step to
                 alpha_bar[0], which the published sampler does

    With a dynamic rescale the estimate of x0 is multiplied by scale_previous / scale_t at each step, and the final
    result keeps the factor of the last step visited, as the published sampler does. Returns [B,...]. UsageError: eta >
    0 without `draw`.
    """
    if eta > 0 and draw is None:
        raise UsageError("stochastic sampling needs a source of noise", where="noise.ddim", got=f"eta = {eta}")
    x = start
    for number, t in enumerate(step_indices):
        final = number + 1 == len(step_indices)
        alpha, sigma = schedule.alpha[t], schedule.sigma[t]
        x0, eps = x0_and_eps(x, denoise(x, t), alpha, sigma, prediction)
        previous = 0 if final else step_indices[number + 1]
        scale_previous = schedule.scale[t if final else previous]
        x0 = x0 * (scale_previous / schedule.scale[t])
        if final and last == "x0":
            return x0
        a, a_previous = schedule.alpha_bar[t], schedule.alpha_bar[previous]
        variance = eta**2 * (1 - a_previous) / (1 - a) * (1 - a / a_previous)
        direction = (1 - a_previous - variance).clamp(min=0.0).sqrt().float()
        x = schedule.alpha[previous] * x0 + direction * eps
        if eta > 0 and draw is not None:
            x = x + variance.clamp(min=0.0).sqrt().float() * draw()
    return x
