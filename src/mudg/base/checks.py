"""What the constructors of ``base/types.py`` check. Each refusal is an InputError whose place is ``OWNER: FIELD``."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import InputError

Matrix = NDArray[np.float64]


def rigid(value: Any, where: str) -> Matrix:
    """A read-only copy f64[4, 4] of a rigid motion."""
    matrix = np.array(value, np.float64)
    problem = geometry.rigid_problem(matrix)
    if problem:
        raise InputError("pose is not a rigid motion", where=where, got=problem,
            expected="f64[4, 4]: a right-handed rotation (orthonormal within 1e-4) and a translation in metres",
            remedy="remove scale or mirroring from the matrix; check row against column order")  # fmt: skip
    matrix.setflags(write=False)
    return matrix


MAX_NAME_BYTES: Final = 200


def foreign_name(value: str, where: str) -> str:
    """An id, name or class from a file of others, at most 200 bytes long."""
    size = len(value) if len(value) > MAX_NAME_BYTES else len(value.encode("utf-8", "surrogatepass"))
    if size > MAX_NAME_BYTES:
        raise InputError("name is too long", where=where, expected=f"at most {MAX_NAME_BYTES} bytes",
            got=f"{size} bytes, beginning {value[:40]!r}", remedy="is the file damaged, or of another format?")  # fmt: skip
    return value


def finite(value: float, where: str) -> float:
    """A finite number as a float."""
    number = float(value)
    if not np.isfinite(number):
        raise InputError("a number is not finite", where=where, got=str(value))
    return number


def increasing_problem(times_s: NDArray[np.float64]) -> str | None:
    """Say where times f64[T] in seconds stop increasing, or return None."""
    stops = np.flatnonzero(~(np.diff(times_s) > 0))
    if len(stops) == 0:
        return None
    index = int(stops[0])
    return f"entry {index + 1} ({times_s[index + 1]:.6f} s) does not come after entry {index} ({times_s[index]:.6f} s)"


def pose_keys(times_s: Any, poses: Any, owner: str, name: str) -> tuple[NDArray[np.float64], Matrix]:
    """Check and freeze interpolation keys: increasing finite times f64[T], rigid poses f64[T, 4, 4] of the field ``name``."""
    times = np.array(times_s, np.float64).reshape(-1)
    matrices = np.array(poses, np.float64)
    if matrices.shape != (len(times), 4, 4):
        expected, got = f"({len(times)}, 4, 4) for {len(times)} times", str(matrices.shape)
        raise InputError("times and poses do not pair up", where=f"{owner}: {name}", expected=expected, got=got)
    problem = increasing_problem(times) if np.isfinite(times).all() else shortened(times)
    if problem is not None:
        raise InputError("times do not increase", where=f"{owner}: times_s",
            expected="finite seconds, strictly increasing", got=problem,
            remedy="sort the poses by time and drop duplicates")  # fmt: skip
    if not geometry.all_rigid(matrices):
        for index, matrix in enumerate(matrices):
            rigid(matrix, f"{owner}: {name}[{index}]")
    times.setflags(write=False)
    matrices.setflags(write=False)
    return times, matrices


def shortened(values: NDArray[Any]) -> str:
    """Numbers as text, at most about 200 characters."""
    text = np.array2string(np.asarray(values), threshold=6, edgeitems=3, precision=6)
    return text if len(text) < 200 else text[:200] + "..."


def _fits(shape: Any, expected: tuple[int | None, ...]) -> bool:
    return len(shape) == len(expected) and all(e in (None, s) for s, e in zip(shape, expected, strict=True))


def check_array(value: Any, where: str, shape: tuple[int | None, ...], dtype: type[np.generic]) -> None:
    """Refuse what is no array of this shape and type; None stands for any size."""
    got = getattr(value, "shape", None)
    if got is None or not _fits(got, shape) or not np.issubdtype(value.dtype, dtype):
        expected = f"{np.dtype(dtype).name} {shape}".replace("None", "N")
        found = f"{getattr(value, 'dtype', type(value).__name__)} {got}"
        raise InputError("an array has the wrong shape or type", where=where, expected=expected, got=found)


def check_tensors(record: Any, **shapes: tuple[int | None, ...]) -> None:
    """Compare the shapes of tensor fields with the expected ones; None stands for any size."""
    for name, shape in shapes.items():
        got = tuple(getattr(getattr(record, name), "shape", ()))
        if not _fits(got, shape):
            where, expected = f"{type(record).__name__.lower()}.{name}", str(shape).replace("None", "N")
            raise InputError("a tensor has the wrong shape", where=where, expected=expected, got=str(got))


def check_given_tensors(record: Any, **shapes: tuple[int | None, ...]) -> None:
    """As ``check_tensors``, for fields that may be None."""
    check_tensors(record, **{name: shape for name, shape in shapes.items() if getattr(record, name) is not None})
