"""Foreign tables and records: columns that must be there, numbers that must be finite, and the pyarrow package behind some files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError, ResourceError
from mudg.data.scene.returns import is_return, near_places

Columns = Mapping[str, NDArray[Any]]


def require_columns(names: Iterable[str], there: Iterable[str], where: object) -> None:
    """Refuse a table that lacks one of ``names``."""
    there, names = list(there), list(names)
    if not set(names) <= set(there):
        raise InputError("table lacks columns", where=str(where), got=", ".join(sorted(there)[:40]) or "no columns",
            expected=", ".join(names), remedy="is this a file of another data set, version or kind?")  # fmt: skip


def finite_columns(columns: Columns, names: Sequence[str], where: object) -> NDArray[np.float64]:
    """Columns as f64[n, k].

    Raises:
        InputError: no numbers, or not all finite.
    """
    where = f"{where}: {', '.join(names)}"
    try:
        table = np.stack([columns[name].astype(np.float64) for name in names], 1)
    except (TypeError, ValueError) as error:
        raise InputError("column does not hold numbers", where=where, got=str(error)[:120]) from error
    bad = ~np.isfinite(table).all(1)
    if bad.any():
        raise InputError("column holds values that are not finite", where=where,
            got=f"{int(bad.sum())} of {len(table)} rows, first {int(np.flatnonzero(bad)[0])}")  # fmt: skip
    return table


def returns_of(columns: Columns, where: object, places: Iterable[NDArray[np.float64]] = ()) -> NDArray[np.bool_]:
    """Rows of a cloud's columns x, y, z that are returns of a beam: by their numbers, and not at one of the sensors' ``places``."""
    try:
        xyz = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], 1)
    except (TypeError, ValueError) as error:
        raise InputError("column does not hold numbers", where=f"{where}: x, y, z", got=str(error)[:120]) from error
    return is_return(xyz) & ~near_places(xyz, places)


@contextmanager
def record_fields(what: str, where: object, expected: str) -> Iterator[None]:
    """Code that takes a foreign record apart: what is missing or of another type becomes an InputError ``what``."""
    try:
        yield
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise InputError(what, where=str(where), got=repr(error)[:120], expected=expected) from error


@contextmanager
def arrow_files(path: Path) -> Iterator[None]:
    """Code that reads a Feather or Parquet file with pyarrow.

    Raises:
        ResourceError: pyarrow is not installed.
        InputError: the file is damaged or cut off.
    """
    try:
        import pyarrow
    except ImportError as error:
        raise ResourceError("Feather and Parquet files need pyarrow, which is not installed", where=str(path),
            remedy="pip install 'mudg[data]'") from error  # fmt: skip
    try:
        yield
    except (pyarrow.ArrowException, OSError, MemoryError, StopIteration, UnicodeDecodeError) as error:
        raise InputError("table cannot be read, or is cut off", where=str(path), remedy="copy the file again",
            got=str(error)[:200] or "it ends early") from error  # fmt: skip
