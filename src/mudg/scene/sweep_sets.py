"""Folders of simulated sweeps: what ``mudg render --lidar`` writes and ``mudg score`` reads.

sweeps.json          schema, trajectory, sensor, shift in metres; one record per sweep: id of the recorded sweep, if its
                     own beams are fired, times and world-from-sensor poses of start and end, file
000000.safetensors   xyz f32[N, 3], intensity f32[N], dt_s f32[N], classes u8[N] as a scene stores sweeps, in the frame
                     of the sweep's end; of every return ring u16[N], beam i64[N]; of all beams in firing order
                     directions f32[B, 3] in the frame of their moment, share f32[B], range_m f32[B] of the surface that
                     is met (NaN: none), facing f32[B]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import InputError
from mudg.base.records import understood

INDEX: Final = "sweeps.json"
SCHEMA: Final = 1
_BEAM_COLUMNS: Final = {"directions": (3,), "share": (), "range_m": (), "facing": ()}
_RETURN_COLUMNS: Final = {"xyz": (3,), "intensity": (), "dt_s": (), "beam": ()}


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedSweep:
    """A sweep of a set.

    Args:
        id: of the recorded sweep at whose time it is taken. own_beams: it fires that sweep's beams.
        start, end: world-from-sensor f64[4, 4]. start_s, end_s: on the scene's clock. file: name in the folder.
    """

    id: str
    own_beams: bool
    start: NDArray[np.float64]
    end: NDArray[np.float64]
    start_s: float
    end_s: float
    file: str


@dataclass(frozen=True, slots=True, eq=False)
class SweepSet:
    """Simulated sweeps of one trajectory."""

    folder: Path
    trajectory: str
    sensor: str
    shift_m: float
    sweeps: tuple[SimulatedSweep, ...]

    def arrays(self, sweep: SimulatedSweep) -> dict[str, NDArray[Any]]:
        """What the file of a sweep holds. InputError: arrays that are missing or do not fit each other."""
        path = self.folder / sweep.file
        arrays = store.read_safetensors(path)
        for columns, first in ((_BEAM_COLUMNS, "share"), (_RETURN_COLUMNS, "beam")):
            for name, inner in columns.items():
                expected = (len(arrays.get(first, ())), *inner)
                if name not in arrays or arrays[name].shape != expected:
                    got = "missing" if name not in arrays else str(arrays[name].shape)
                    what = "a simulated sweep does not fit together"
                    raise InputError(what, where=f"{path}: {name}", expected=str(expected), got=got)
        if len(arrays["beam"]) and not 0 <= arrays["beam"].min() <= arrays["beam"].max() < len(arrays["share"]):
            raise InputError("a return belongs to no beam", where=str(path), got=str(arrays["beam"].max()))
        return arrays


def write_index(sweeps: SweepSet) -> None:
    """Write ``sweeps.json``; without it the folder is not a finished set."""
    head = {"schema": SCHEMA, "trajectory": sweeps.trajectory, "sensor": sweeps.sensor, "shift_m": sweeps.shift_m}
    store.write_json(sweeps.folder / INDEX, {**head, "sweeps": list(map(asdict, sweeps.sweeps))})


def read_sweep_sets(folder: Path) -> dict[str, SweepSet]:
    """The sets below ``folder/lidar``, by trajectory; none where that folder is not there.

    Raises:
        InputError: a malformed index.
    """
    places = sorted((Path(folder) / "lidar").iterdir()) if (Path(folder) / "lidar").is_dir() else []
    return {place.name: _read_set(place) for place in places if (place / INDEX).is_file()}


def _read_set(folder: Path) -> SweepSet:
    with understood("simulated sweeps", str(folder / INDEX)):
        content = store.read_json(folder / INDEX)
        if content["schema"] != SCHEMA:
            what, got = "unknown schema of simulated sweeps", str(content["schema"])
            raise InputError(what, where=str(folder / INDEX), expected=str(SCHEMA), got=got)
        sweeps = tuple(_sweep(record, folder) for record in content["sweeps"])
        return SweepSet(folder, folder.name, str(content["sensor"]), float(content["shift_m"]), sweeps)


def _sweep(record: Mapping[str, Any], folder: Path) -> SimulatedSweep:
    start, end = (np.array(record[name], np.float64) for name in ("start", "end"))
    for pose in (start, end):
        if problem := geometry.rigid_problem(pose):
            raise InputError(f"a pose of a simulated sweep is not rigid: {problem}", where=str(folder / INDEX))
    name = str(record["file"])
    if "/" in name or not name.endswith(".safetensors") or name.startswith("."):
        raise InputError("a simulated sweep lies elsewhere", where=str(folder / INDEX), got=name[:80])
    times = float(record["start_s"]), float(record["end_s"])
    return SimulatedSweep(str(record["id"]), bool(record["own_beams"]), start, end, times[0], times[1], name)
