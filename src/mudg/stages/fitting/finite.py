"""Nothing that is not finite reaches the parameters: loss terms and gradients are checked before every step of the optimiser.

On the CPU each is looked at as soon as it is known. On another device looking means waiting for all that was sent there, so the numbers
of a whole step are gathered there and come back in one copy.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from mudg.base.errors import NumericsError
from mudg.core.table import Table
from mudg.models.scene.appearance import Appearance
from mudg.models.scene.model import SceneModel

Complaint = Callable[[float], None]
"""Raises for a number that is not finite; returns where it only overflowed."""


class FiniteCheck:
    """The numbers of one step that must be finite, in the order in which they were computed.

    Args:
        step: for messages.
        at_once: look at every number when it is added, not in ``refuse``.
    """

    def __init__(self, step: int, at_once: bool) -> None:
        self._step = step
        self._at_once = at_once
        self._added: list[tuple[Tensor, Complaint]] = []

    def terms(self, view: str, terms: Mapping[str, Tensor]) -> None:
        """Add the loss terms of a view."""
        self._add(
            [
                (value.detach(), functools.partial(_refuse_term, name, self._where(view)))
                for name, value in terms.items()
            ]
        )

    def gradients(self, view: str, model: SceneModel, appearance: Appearance) -> None:
        """Add the gradients after the backward pass of a view, by their sums: the cheapest pass over memory there is."""
        learnt = {"gaussians": (model.table, SCENE_REMEDY)}
        learnt |= {owner: (table, SCENE_REMEDY) for owner, table in model.node_tables().items()}
        learnt |= {f"appearance {group}": (table, VIEW_REMEDY) for group, table in appearance.tables.items()}
        self._add([
            (gradient.sum(), functools.partial(_refuse_gradient, table, gradient, f"{owner}.{name}, {self._where(view)}", remedy))
            for owner, (table, remedy) in learnt.items() for name, gradient in table.gradients().items()
        ])  # fmt: skip

    def refuse(self) -> None:
        """NumericsError naming the first of the numbers that is not finite, if there is one; no parameter has been touched."""
        added, self._added = self._added, []
        if added:
            numbers = torch.stack([number for number, _ in added]).tolist()
            for number, (_, complain) in zip(numbers, added):
                if not math.isfinite(number):
                    complain(number)

    def _where(self, view: str) -> str:
        return f"view {view}, step {self._step}"

    def _add(self, numbers: list[tuple[Tensor, Complaint]]) -> None:
        self._added += numbers
        if self._at_once:
            self.refuse()


SCENE_REMEDY = "the parameters are those of the step before; report the scene, or leave this view out"
VIEW_REMEDY = "the parameters are those of the step before; leave this view out"


def _refuse_term(name: str, where: str, number: float) -> None:
    raise NumericsError(f"the loss term {name!r} is not finite", where=where, got=str(number),
        remedy="check this view's image and labels; the parameters are those of the step before")  # fmt: skip


def _refuse_gradient(table: Table, gradient: Tensor, where: str, remedy: str, number: float) -> None:
    count = int((~torch.isfinite(gradient)).sum())
    if count:  # else the sum overflowed
        table.clear_gradients()
        raise NumericsError("a gradient is not finite", where=where, got=f"{count} values", remedy=remedy)
