"""The check that every network of a score makes of its weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from mudg.base.errors import InputError


def checked_state(
    state: Mapping[str, Tensor],
    wanted: Mapping[str, tuple[int, ...]],
    where: str,
    network: str,
    ignored: Callable[[str], bool],
) -> dict[str, Tensor]:
    """The wanted tensors of a file as float32.

    Args:
        wanted: name -> shape of all that the network needs. where: file name for errors. network: its name. ignored: names that may be
            there and are not read; all other names are refused.

    Raises:
        InputError: a tensor is missing, has another shape, holds values that are not finite, or is unknown.
    """
    for name, shape in wanted.items():
        found = state.get(name)
        if found is None or tuple(found.shape) != shape or not found.is_floating_point():
            got = "missing" if found is None else f"{found.dtype} {tuple(found.shape)}"
            raise InputError(
                f"{network} weights are incomplete or of another network",
                where=f"{where}: {name}",
                expected=str(shape),
                got=got,
            )
        if not bool(torch.isfinite(found).all()):
            raise InputError(f"{network} weights hold values that are not finite", where=f"{where}: {name}")
    for name in state:
        if name not in wanted and not ignored(name):
            raise InputError(f"{network} weights hold a tensor that the network has not", where=f"{where}: {name}",
                expected=f"{len(wanted)} tensors")  # fmt: skip
    return {name: state[name].detach().float() for name in wanted}
