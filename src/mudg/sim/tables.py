"""Beam tables by name, and from a JSON file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from mudg.base import store
from mudg.base.errors import UsageError
from mudg.base.records import Number, StrictRecord, parse_record
from mudg.sim.lidar import BeamTable


def forward(
    elevations_deg: NDArray[np.float64], field_deg: float, step_deg: float, range_m: tuple[float, float]
) -> BeamTable:
    """A LiDAR that sweeps a field ahead of it from left to right."""
    turn = BeamTable.spinning(elevations_deg, step_deg, range_m)
    inside = np.abs(np.degrees(np.arctan2(turn.directions[:, 1], turn.directions[:, 0]))) <= field_deg / 2
    if not inside.any():
        what, expected = "the field of view is narrower than a step", f"at least {step_deg:g} degrees"
        raise UsageError(what, where="field_deg", expected=expected, got=f"{field_deg:g}")
    share = turn.share[inside]
    share = (share - share.min()) / max(float(np.ptp(share)), 1e-9)
    return BeamTable(turn.directions[inside], turn.ring[inside], share, range_m)


HDL64: Final = np.concatenate([np.linspace(-24.33, -8.83, 32), np.linspace(-8.33, 2.0, 32)])
TABLES: Final[dict[str, Callable[[], BeamTable]]] = {
    "pandar128": lambda: BeamTable.spinning(np.linspace(-25.0, 15.0, 128), 0.2, (0.3, 200.0)),
    "at128": lambda: forward(np.linspace(-12.7, 12.7, 128), 120.0, 0.1, (0.5, 200.0)),
    "hdl64": lambda: BeamTable.spinning(HDL64, 0.17, (0.9, 120.0)),
    "vlp16": lambda: BeamTable.spinning(np.linspace(-15.0, 15.0, 16), 0.2, (0.5, 100.0)),
}
"""Name -> beams. Rows of pandar128 and at128 are evenly spread here."""


class TableFile(StrictRecord):
    """A turning sensor, or one that sweeps a field ahead of it."""

    elevations_deg: Annotated[list[Number], Field(min_length=1, max_length=512)]
    azimuth_step_deg: Number
    range_m: Annotated[list[Number], Field(min_length=2, max_length=2)] = [0.5, 120.0]
    field_deg: Annotated[Number, Field(gt=0)] = 360.0
    direction: Literal["clockwise", "anticlockwise"] = "clockwise"


def read_table(path: Path) -> BeamTable:
    """The table in a JSON file (docs/simulator.md). InputError: no such file, or fields that make no sense. UsageError:
    numbers that no sensor has."""
    found = parse_record(TableFile, store.read_json(path), str(path))
    elevations, limits = np.array(found.elevations_deg), (found.range_m[0], found.range_m[1])
    if found.field_deg < 360:
        return forward(elevations, found.field_deg, found.azimuth_step_deg, limits)
    return BeamTable.spinning(elevations, found.azimuth_step_deg, limits, found.direction == "clockwise")
