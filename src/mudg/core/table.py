"""A row-aligned table of parameters: columns (raw leaf tensors), their Adam moments and all counters share one row
order, and row operations move them together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mudg.base.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class AdamColumn:
    """One column of a step of Adam: four tensors of one shape [N, ...] (all but ``gradient`` are updated) and the
    learning rate."""

    parameter: Tensor
    gradient: Tensor
    moment1: Tensor
    moment2: Tensor
    rate: float


AdamKernel = Callable[[Sequence[AdamColumn], int, Tensor | None], None]
"""(columns with the same rows, step from 1, rows bool[N] to update or None = all): update in place."""

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


class Table:
    """Parameters ``[N, ...]`` with Adam moments, plus integer or float counters ``[N, ...]`` that are not optimised.

    Args:
        columns: name -> raw parameter, float, all with the same first dimension N. They become leaves with gradients.
        labels: name -> per-row facts (e.g. the node index), any dtype, carried along, never optimised.
    """

    def __init__(self, columns: Mapping[str, Tensor], labels: Mapping[str, Tensor] | None = None) -> None:
        self.columns = {name: _leaf(value) for name, value in columns.items()}
        self.moment1 = {name: torch.zeros_like(value) for name, value in self.columns.items()}
        self.moment2 = {name: torch.zeros_like(value) for name, value in self.columns.items()}
        self.labels = {name: value.detach().clone() for name, value in (labels or {}).items()}
        self._check()

    def __len__(self) -> int:
        return int(next(iter(self.columns.values())).shape[0])

    def __getitem__(self, name: str) -> Tensor:
        return self.columns[name]

    def _check(self) -> None:
        if not self.columns:
            raise InputError("a table needs at least one column")
        rows = len(self)
        for name, value in {**self.columns, **self.labels}.items():
            if value.shape[:1] != (rows,):
                what = "columns of a table differ in length"
                raise InputError(what, where=name, expected=f"{rows} rows", got=str(tuple(value.shape)))

    # -- device ------------------------------------------------------------------------------------

    @property
    def device(self) -> torch.device:
        """Where the columns, their moments and the labels are."""
        return next(iter(self.columns.values())).device

    def to(self, device: torch.device) -> Table:
        """The same table, moments included, on a device; itself if it is there already. Gradients do not move."""
        if self.device == device:
            return self
        there = Table(
            {name: value.detach().to(device) for name, value in self.columns.items()},
            {name: value.to(device) for name, value in self.labels.items()},
        )
        there.moment1 = {name: value.to(device) for name, value in self.moment1.items()}
        there.moment2 = {name: value.to(device) for name, value in self.moment2.items()}
        return there

    # -- row operations ----------------------------------------------------------------------------

    def take(self, rows: Tensor) -> None:
        """Keep ``rows`` (i64 indices in the wanted order, or a bool mask [N]); everything moves together."""
        index = rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows
        self.columns = {name: _leaf(value.detach()[index]) for name, value in self.columns.items()}
        for moments in (self.moment1, self.moment2):
            for name in moments:
                moments[name] = moments[name][index]
        self.labels = {name: value[index] for name, value in self.labels.items()}

    def append(self, columns: Mapping[str, Tensor], labels: Mapping[str, Tensor]) -> None:
        """Add rows with zero moments. Every column and label of the table must be given."""
        if set(columns) != set(self.columns) or set(labels) != set(self.labels):
            what, expected = "appended rows must fill every column", str(sorted(set(self.columns) | set(self.labels)))
            raise InputError(what, expected=expected, got=str(sorted(set(columns) | set(labels))))
        fresh = {name: value.detach() for name, value in columns.items()}
        self.columns = {name: _leaf(torch.cat([value.detach(), fresh[name]])) for name, value in self.columns.items()}
        for moments in (self.moment1, self.moment2):
            for name in fresh:
                moments[name] = torch.cat([moments[name], torch.zeros_like(fresh[name])])
        self.labels = {name: torch.cat([value, labels[name]]) for name, value in self.labels.items()}
        self._check()

    def reset_moments(self, name: str, rows: Tensor | None = None) -> None:
        """Forget the moments of one column (of some rows)."""
        for moments in (self.moment1, self.moment2):
            if rows is None:
                moments[name].zero_()
            else:
                moments[name][rows] = 0.0

    # -- optimisation ------------------------------------------------------------------------------

    def gradients(self) -> dict[str, Tensor]:
        """Gradients of the last backward, by column; columns without one are left out."""
        return {name: value.grad for name, value in self.columns.items() if value.grad is not None}

    def clear_gradients(self) -> None:
        """Drop all gradients."""
        for value in self.columns.values():
            value.grad = None

    def adam_step(self, step: int, rates: Mapping[str, float], kernel: AdamKernel, rows: Tensor | None = None) -> None:
        """One Adam step on every column that has a gradient and a rate above 0.

        Args:
            step: number of this step, from 1 (bias correction).
            rates: learning rate per column; a column that is not named stays as it is.
            kernel: ``torch_adam_columns`` or ``native_ops.adam_columns``.
            rows: bool[N]: update these rows only, parameters and moments (the others wait); None = all.
        """
        kernel(
            [
                AdamColumn(value.detach(), value.grad, self.moment1[name], self.moment2[name], rates[name])
                for name, value in self.columns.items()
                if value.grad is not None and rates.get(name, 0.0) > 0
            ],
            step,
            rows,
        )

    # -- state -------------------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """All tensors under flat names, ready for a checkpoint."""
        flat = {f"column.{name}": value.detach() for name, value in self.columns.items()}
        flat |= {f"moment1.{name}": value for name, value in self.moment1.items()}
        flat |= {f"moment2.{name}": value for name, value in self.moment2.items()}
        return flat | {f"label.{name}": value for name, value in self.labels.items()}

    @classmethod
    def from_state(cls, flat: Mapping[str, Tensor]) -> Table:
        """Inverse of ``state``. Moments may be absent (a finished model): they start at zero."""
        groups: dict[str, dict[str, Tensor]] = {"column": {}, "moment1": {}, "moment2": {}, "label": {}}
        for key, value in flat.items():
            group, _, name = key.partition(".")
            if group not in groups or not name:
                raise InputError("not a tensor of a parameter table", where=key)
            groups[group][name] = value
        table = cls(groups["column"], groups["label"])
        for moments, stored in ((table.moment1, groups["moment1"]), (table.moment2, groups["moment2"])):
            for name, value in stored.items():
                if name not in moments or moments[name].shape != value.shape:
                    raise InputError("a moment does not fit its column", where=name)
                moments[name] = value.clone()
        return table


def torch_adam_columns(columns: Sequence[AdamColumn], step: int, rows: Tensor | None = None) -> None:
    """Adam (Kingma & Ba 2015), betas 0.9 and 0.999, epsilon 1e-15, in place: the plain-torch kernel of
    ``Table.adam_step``."""
    for one in columns:
        whole = (one.parameter, one.moment1, one.moment2)
        parameter, moment1, moment2 = whole if rows is None else (values.clone() for values in whole)
        gradient = one.gradient
        moment1.mul_(BETA1).add_(gradient, alpha=1 - BETA1)
        moment2.mul_(BETA2).addcmul_(gradient, gradient, value=1 - BETA2)
        denominator = (moment2 / (1 - BETA2**step)).sqrt_().add_(EPSILON)
        parameter.addcdiv_(moment1, denominator, value=-one.rate / (1 - BETA1**step))
        if rows is not None:
            # chosen by a mask: counting rows would wait for the device
            chosen = rows.view(-1, *[1] * (gradient.ndim - 1))
            for values, updated in zip(whole, (parameter, moment1, moment2)):
                values.copy_(torch.where(chosen, updated, values))


def _leaf(value: Tensor) -> Tensor:
    return value.detach().clone().contiguous().requires_grad_()
