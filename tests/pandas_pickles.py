"""Pickled data frames without pandas: classes of pandas' names that pickle as pandas 1.0 and 2.2 do.

Files that pandas itself wrote lie in ``golden/pandas_*.pkl.gz``; these here make tables of any content.
"""

from __future__ import annotations

import copyreg
import gzip
import pickle
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np


class DataFrame:
    """A frame whose state holds a manager."""

    state: dict[str, Any]

    def __reduce__(self) -> tuple[Any, ...]:
        return copyreg.__newobj__, (DataFrame,), self.state


class BlockManager:
    """Pandas 1.0: state in a tuple. Pandas 2: blocks and axes as arguments."""

    state: Any
    blocks: Any

    def __reduce__(self) -> tuple[Any, ...]:
        if self.state is not None:
            return copyreg.__newobj__, (BlockManager,), self.state
        return BlockManager, self.blocks


class Index:
    """A plain index."""

    def __init__(self, data: np.ndarray) -> None:
        self.data = data

    def __reduce__(self) -> tuple[Any, ...]:
        return _new_Index, (Index, {"data": self.data, "name": None})


class RangeIndex:
    """Row numbers."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __reduce__(self) -> tuple[Any, ...]:
        return _new_Index, (RangeIndex, {"name": None, "start": 0, "stop": self.count, "step": 1})


class Block:
    """Several columns of one type."""

    def __init__(self, values: np.ndarray, places: slice) -> None:
        self.values, self.places = values, places

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickle_block, (self.values, self.places, 2)


def _new_Index(*_: Any) -> None: ...


def _unpickle_block(*_: Any) -> None: ...


_HOMES = {
    DataFrame: "pandas.core.frame",
    BlockManager: "pandas.core.internals.managers",
    Index: "pandas.core.indexes.base",
    RangeIndex: "pandas.core.indexes.range",
    _new_Index: "pandas.core.indexes.base",
    _unpickle_block: "pandas._libs.internals",
}


@contextmanager
def _pretended() -> Iterator[None]:
    """Let pickle find the classes under pandas' names."""
    own = {thing: thing.__module__ for thing in _HOMES}
    added = {}
    for thing, home in _HOMES.items():
        module = added.setdefault(home, ModuleType(home))
        setattr(module, thing.__name__, thing)
        thing.__module__ = home
    for name in [*added, *{part for home in added for part in (home.split(".")[0],)}]:
        sys.modules.setdefault(name, added.get(name, ModuleType(name)))
    try:
        yield
    finally:
        for thing, home in own.items():
            thing.__module__ = home
        for name in [name for name in sys.modules if name.split(".")[0] == "pandas"]:
            del sys.modules[name]


def frame_bytes(columns: Mapping[str, Any], *, new: bool = False) -> bytes:
    """A pickled frame, as pandas 1.0 (or 2.2 if ``new``) writes it: one block per type."""
    arrays = {name: _column(values) for name, values in columns.items()}
    names = sorted(arrays, key=lambda name: arrays[name].dtype.kind)
    rows = len(next(iter(arrays.values())))
    blocks, first = [], 0
    for kind in dict.fromkeys(arrays[name].dtype for name in names):
        mine = [name for name in names if arrays[name].dtype == kind]
        values = np.empty((len(mine), rows), kind)
        for row, name in enumerate(mine):
            values[row] = arrays[name]
        blocks.append(Block(values, slice(first, first + len(mine), 1)))
        first += len(mine)
    axes = [Index(np.array(names, object)), RangeIndex(rows)]
    manager, frame = BlockManager(), DataFrame()
    manager.state, manager.blocks = None, (tuple(blocks), axes)
    if not new:
        parts = [{"values": block.values, "mgr_locs": block.places} for block in blocks]
        manager.state = (axes, [b.values for b in blocks], axes[:1], {"0.14.1": {"axes": axes, "blocks": parts}})
    frame.state = {"_mgr" if new else "_data": manager, "_typ": "dataframe", "_metadata": []}
    with _pretended():
        return pickle.dumps(frame, protocol=5 if new else 4)


def _column(values: Any) -> np.ndarray:
    array = np.asarray(values)
    return array.astype(object) if array.dtype.kind == "U" else array


def write_frame(path: Path, columns: Mapping[str, Any], *, new: bool = False) -> None:
    """A ``.pkl.gz`` file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(frame_bytes(columns, new=new), compresslevel=1))
