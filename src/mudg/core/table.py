"""A row-aligned table of parameters: columns (raw leaf tensors), their Adam moments and all counters share one row
order, and row operations move them together."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mudg.base.errors import InputError
from mudg.core.native_ops import AdamColumn, adam_columns


class Table:
    """Parameters ``[N, ...]`` by name with Adam moments, leaves with gradients, plus facts ``labels [N, ...]`` of the
    rows of any type (e.g. the node index), carried along, never optimised."""

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

    def adam_step(self, step: int, rates: Mapping[str, float], rows: Tensor | None = None) -> None:
        """Adam step number ``step`` (from 1, for the bias correction) on every column that has a gradient and a rate
        above 0 in ``rates``. ``rows`` bool[N]: update these only, parameters and moments (the others wait)."""
        columns = [
            AdamColumn(value.detach(), value.grad, self.moment1[name], self.moment2[name], rates[name])
            for name, value in self.columns.items()
            if value.grad is not None and rates.get(name, 0.0) > 0
        ]
        adam_columns(columns, step, rows)

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


def _leaf(value: Tensor) -> Tensor:
    return value.detach().clone().contiguous().requires_grad_()
