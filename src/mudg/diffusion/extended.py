"""Models that go on from an earlier, plainer one."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mudg.base.errors import UsageError
from mudg.diffusion.model import MDM
from mudg.diffusion.network import MDMConfig


def same_denoiser(one: MDMConfig, other: MDMConfig) -> bool:
    """Whether two networks differ at most in what follows the denoiser, in the use of renders, and in the size trained
    at."""
    plain = {
        "refine_widths": (),
        "refine_blocks": (),
        "finish_widths": (),
        "finish_blocks": (),
        "renders": False,
        "area_px": 0,
    }
    without = lambda config: replace(config, **plain)  # noqa: E731
    return without(one) == without(other)


def extended(before: MDM, config: MDMConfig) -> MDM:
    """A model of `config` with the weights of `before`; a refiner is taken over if `before` has one of the same shape.
    For continuing the training of an earlier, plainer model. What new inputs weigh is 0, so they change nothing at
    first.

    Raises:
        UsageError: the two differ in more than the refiner, the use of renders and the size trained at.
    """
    if not same_denoiser(before.config, config) or (before.config.renders and not config.renders):
        raise UsageError(
            "the model to continue from is of another kind",
            expected=str(config),
            got=str(before.config),
            remedy="give its widths, blocks, attention, patch, window and renders",
        )
    model = MDM(config)
    state = model.state_dict()
    for name, old in before.state_dict().items():
        if name in state and state[name].shape == old.shape:
            state[name] = old
        elif name in state and name.removesuffix(".weight").removesuffix(".bias") in _WIDENED:
            state[name] = _widened(old, state[name], zero=name.startswith(_WIDENED[:2]))
    model.load_state_dict(state)
    return model


_WIDENED = ("net.enter", "refiner.enter", "net.leave", "refiner.leave")
"""Layers that have further inputs or outputs, behind the others, in a model that uses renders."""


def _widened(old: Tensor, new: Tensor, zero: bool) -> Tensor:
    """A larger tensor with `old` in its first places, and in the others those of `new`, or 0."""
    made = torch.zeros_like(new) if zero else new.clone()
    made[tuple(slice(size) for size in old.shape)] = old
    return made
