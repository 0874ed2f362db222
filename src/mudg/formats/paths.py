"""Camera paths from files, metres in the scene's world. ``.txt`` with 8 numbers a row (TUM): time, position, quaternion
x y z w; with 12 (KITTI): world-from-camera 3x4; camera axes x right, y down, z forward. ``.json``: nerfstudio's
``transforms.json``, axes x right, y up, z back. Where no time is given, views are spread evenly over the log.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, log, store
from mudg.base.errors import InputError
from mudg.base.types import Camera, Scene, Trajectory, View
from mudg.formats.importers.kitti import line_numbers

FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
FAR_M = 5.0
"""Views farther than this from every recorded camera are warned of."""
MOST_VIEWS = 100_000
Rows = list[tuple[float | None, NDArray[np.float64], str]]
"""Time or None, world-from-camera f64[4, 4], and where it stands in the file."""


def read_path(file: Path, scene: Scene, camera: Camera) -> Trajectory:
    """The path in a file, in the clock and world of the scene, seen by a camera. InputError: not such a file, a pose
    that is not rigid, or times that do not increase or lie outside the log."""
    rows = _of_json(file) if file.suffix == ".json" else _of_text(file)
    if not 0 < len(rows) <= MOST_VIEWS:
        expected = f"1 to {MOST_VIEWS}"
        raise InputError("no usable number of poses", where=str(file), expected=expected, got=str(len(rows)))
    recorded = [frame.view for frame in scene.frames]
    first, last = min(view.time_s for view in recorded), max(view.time_s for view in recorded)
    timed = [time for time, _, _ in rows if time is not None]
    if timed and len(timed) < len(rows):
        raise InputError("some poses have a time and others have none", where=str(file))
    times = np.array(timed) if timed else np.linspace(first, last, len(rows))
    for (_, pose, where), time_s in zip(rows, times.tolist(), strict=True):
        if problem := geometry.rigid_problem(pose):
            what, expected = "a pose of the path is not rigid", "a rotation and metres"
            raise InputError(what, where=where, expected=expected, got=problem)
        if not first - 1e-6 <= time_s <= last + 1e-6:
            what, remedy = "the path leaves the time of the log", "times are those of the scene's clock"
            expected = f"{first:.3f} to {last:.3f} s"
            raise InputError(what, where=where, expected=expected, got=f"{time_s} s", remedy=remedy)
    if (np.diff(times) < 0).any():
        raise InputError("times of the path do not increase", where=rows[int(np.argmax(np.diff(times) < 0)) + 1][2])
    places = np.stack([view.center_world for view in recorded])
    away = np.array([np.linalg.norm(places - pose[:3, 3], axis=1).min() for _, pose, _ in rows])
    if away.max() > FAR_M:
        count = int((away > FAR_M).sum())
        far = f"more than {FAR_M:g} m from every recorded camera (up to {away.max():.1f} m)"
        log.warn(f"{file.name}: {count} of {len(rows)} views are {far}: do not trust them")
    views = tuple(View(camera, pose, time_s) for (_, pose, _), time_s in zip(rows, times.tolist(), strict=True))
    return Trajectory(file.stem, views, "shifted")


def _of_text(file: Path) -> Rows:
    rows: Rows = []
    for number, line in enumerate(store.read_text(file).splitlines(), 1):
        if not line.partition("#")[0].split():
            continue
        where = f"{file}, line {number}"
        values = line_numbers(line.partition("#")[0], (8, 12), where, "pose (8 numbers: TUM, 12: KITTI)")
        if len(values) == 12:
            rows.append((None, np.vstack([values.reshape(3, 4), [0, 0, 0, 1]]), where))
            continue
        length = float(np.linalg.norm(values[4:]))
        if not 0.99 < length < 1.01:
            raise InputError("not a unit quaternion", where=where, expected="length 1", got=f"{length:.4f}")
        turn = geometry.matrix_from_quaternion(values[[7, 4, 5, 6]] / length)
        rows.append((float(values[0]), geometry.from_rotation_translation(turn, values[1:4]), where))
    return rows


def _of_json(file: Path) -> Rows:
    content = store.read_json(file)
    frames: Any = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list):
        raise InputError("no list of frames", where=str(file), expected="transforms.json of nerfstudio")
    rows: Rows = []
    for number, frame in enumerate(frames):
        where = f"{file}, frames[{number}]"
        matrix = frame.get("transform_matrix") if isinstance(frame, dict) else None
        what, here, expected = "not a matrix", f"{where}.transform_matrix", "4x4 numbers"
        try:
            pose = np.array(matrix, np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(what, where=here, expected=expected) from error
        if pose.shape != (4, 4):
            raise InputError(what, where=here, expected=expected, got=str(pose.shape))
        time_s = frame.get("time")
        if time_s is not None and (isinstance(time_s, bool) or not isinstance(time_s, int | float)):
            raise InputError("not a time", where=f"{where}.time", expected="seconds", got=repr(time_s)[:40])
        rows.append((time_s, pose @ FROM_OPENGL, where))
    return rows
