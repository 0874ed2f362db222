"""Corrections of single images: exposure and colour, and small errors of camera poses, which vary although the scene
does not.

Two corrections, each optional, each the identity at the start, none of them used when a fitted scene is rendered:

    exposure   3x4 affine colour map per camera or per recorded image. The mean over all of them is held at the
               identity, so that the scene keeps the average colour of the log instead of drifting against the maps.
    cameras    6 numbers per recorded image: shift [m] and turn [rad] of the camera in its own frame.

The affine map is that of Street Gaussians (Yan et al. 2024): ``A rgb + b``, an L1 penalty on the distance from the
identity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import torch
from torch import Tensor

from mudg.base.errors import InputError
from mudg.base.types import View
from mudg.core import losses
from mudg.core.table import AdamKernel, Table
from mudg.gaussians.settings import AppearanceConfig

COLOR: Final = "exposure"
POSE: Final = "cameras"


class Appearance:
    """The corrections of a fit. A group that is off is absent from ``tables``. ``names``: per group, what has a
    correction of its own: cameras or images. ``tables``: per group, one row per name: ``affine`` [n, 3, 4] (difference
    from the identity), or ``shift`` [n, 3] metres and ``turn`` [n, 3] radians; None = identity. InputError: a table
    does not fit its names."""

    def __init__(self, names: Mapping[str, Sequence[str]], tables: Mapping[str, Table] | None = None) -> None:
        self.names = {group: tuple(members) for group, members in names.items() if len(members)}
        self._row = {group: {name: row for row, name in enumerate(members)} for group, members in self.names.items()}
        if tables is None:
            tables = {group: _identity(group, len(members)) for group, members in self.names.items()}
        self.tables = dict(tables)
        for group, members in self.names.items():
            if group not in self.tables or len(self.tables[group]) != len(members):
                what, expected = "corrections of appearance do not fit their names", f"{len(members)} rows"
                raise InputError(what, where=group, expected=expected)

    @classmethod
    def of_views(cls, recorded: Sequence[str], config: AppearanceConfig) -> Appearance:
        """Corrections for recorded views named ``camera/number``, all the identity."""
        images = tuple(dict.fromkeys(recorded))
        colored = {"none": (), "camera": tuple(dict.fromkeys(map(owner, recorded))), "image": images}[config.exposure]
        return cls({COLOR: colored, POSE: images if config.cameras else ()})

    def __bool__(self) -> bool:
        return bool(self.tables)

    def to(self, device: torch.device) -> Appearance:
        """The same corrections, with their moments, on a device."""
        return Appearance(self.names, {group: table.to(device) for group, table in self.tables.items()})

    # -- use ---------------------------------------------------------------------------------------

    def colored(self, rgb: Tensor, name: str, kind: str) -> Tensor:
        """A rendered picture ``[3, H, W]`` as the camera of view ``name`` would show it, differentiable."""
        affine = self._affine(name, kind)
        if affine is None:
            return rgb
        return rgb + torch.addmm(affine[:, 3:], affine[:, :3], rgb.flatten(1)).view_as(rgb)

    def penalty(self, name: str, kind: str) -> Tensor | None:
        """Mean distance of the view's colour map from the identity (scalar), or None where it has none."""
        affine = self._affine(name, kind)
        return None if affine is None else losses.identity_distance(affine)

    def world_from_cam(self, view: View, name: str) -> Tensor | None:
        """Corrected pose f32[4, 4] of a recorded view, differentiable; None where poses are not corrected."""
        row = self._row.get(POSE, {}).get(name)
        if row is None:
            return None
        shift, turn = (self.tables[POSE][column][row] for column in ("shift", "turn"))
        given = torch.from_numpy(view.world_from_cam.copy()).to(shift.dtype)
        return given.to(shift.device, non_blocking=True) @ rigid_motion(shift, turn)

    def _affine(self, name: str, kind: str) -> Tensor | None:
        """Difference ``[3, 4]`` of the view's colour map from the identity."""
        rows = self._row.get(COLOR)
        if rows is None or kind != "recorded":
            return None
        row = rows.get(name, rows.get(owner(name)))
        if row is None:
            raise InputError("a view has no colour map", where=name, expected=", ".join(list(rows)[:8]))
        affine = self.tables[COLOR]["affine"]
        return affine[row] - affine.mean(0)

    # -- learning ----------------------------------------------------------------------------------

    def adam_step(self, step: int, rates: Mapping[str, float], kernel: AdamKernel) -> None:
        """One Adam step on the rows that have a gradient (the others rest), then gradients are dropped."""
        for table in self.tables.values():
            gradients = [gradient.flatten(1).abs().sum(1) for gradient in table.gradients().values()]
            if gradients:
                table.adam_step(step, rates, kernel, torch.stack(gradients).sum(0) > 0)
            table.clear_gradients()

    # -- state -------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """JSON values and tensors that rebuild it with its moments."""
        tensors = {
            f"{group}/{key}": value for group, table in self.tables.items() for key, value in table.state().items()
        }
        return {group: list(members) for group, members in self.names.items()}, tensors

    @classmethod
    def from_state(cls, values: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Appearance:
        """Inverse of ``state``."""
        tables = {}
        for group in values:
            own = {key.partition("/")[2]: value for key, value in tensors.items() if key.startswith(f"{group}/")}
            tables[group] = Table.from_state(own)
        return cls({group: tuple(map(str, members)) for group, members in values.items()}, tables)


def owner(name: str) -> str:
    """Camera of a recorded view: what stands before the last slash of its name."""
    return name.rpartition("/")[0]


def rigid_motion(shift_m: Tensor, turn_rad: Tensor) -> Tensor:
    """Rigid ``[4, 4]`` with translation ``shift_m`` [3] and the rotation about ``turn_rad`` [3] by its length;
    differentiable, also at zero."""
    x, y, z = turn_rad.unbind()
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    top = torch.cat([torch.matrix_exp(skew), shift_m[:, None]], 1)
    return torch.cat([top, torch.eye(4, dtype=top.dtype, device=top.device)[3:]])


def _identity(group: str, rows: int) -> Table:
    if group == POSE:
        return Table({"shift": torch.zeros(rows, 3), "turn": torch.zeros(rows, 3)})
    return Table({"affine": torch.zeros(rows, 3, 4)})
