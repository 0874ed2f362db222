"""Tables that pandas pickled, read as columns of numpy arrays without pandas and without running the pickle.

The forms of pandas 0.2x, 1.x and 2.x are understood: a data frame is a manager of blocks, each block an array of several
columns and the places of these columns. Extension types (categories, text arrays of pandas 3) are refused by name.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import store
from mudg.base.errors import InputError
from mudg.data.plain_pickle import MAX_BYTES, NUMPY_MAKERS, Array, Maker, Name, PickledObject, read_pickle

_MANAGERS: Final = ("pandas.core.internals.managers.BlockManager", "pandas.core.internals.BlockManager")
MAX_COLUMNS: Final = 1000
_NEW_BLOCK: Final = "pandas.core.internals.blocks.new_block"


def _new_index(kind: Any, entries: Any) -> NDArray[Any] | range:
    if not isinstance(kind, Name) or not isinstance(entries, dict):
        raise ValueError("an index of unknown form")
    if kind.text.endswith("RangeIndex"):
        return range(entries["start"], entries["stop"], entries["step"])
    return _array(entries["data"])


def _slice(start: Any, stop: Any, step: Any) -> slice:
    if not all(part is None or isinstance(part, int) for part in (start, stop, step)):
        raise ValueError("a slice that is not of whole numbers")
    return slice(start, stop, step)


def _block(values: Any, places: Any, _dimensions: Any) -> tuple[Any, Any]:
    return values, places


_MAKERS: Final[Mapping[str, Maker | None]] = {
    **NUMPY_MAKERS,
    "pandas.core.frame.DataFrame": None,
    **dict.fromkeys(_MANAGERS),
    "pandas.core.indexes.base._new_Index": _new_index,
    "pandas.core.indexes.base.Index": None,
    **dict.fromkeys(f"pandas.core.indexes.numeric.{kind}Index" for kind in ("Int64", "UInt64", "Float64")),
    "pandas.core.indexes.range.RangeIndex": None,
    "pandas._libs.internals._unpickle_block": _block,
    _NEW_BLOCK: None,
    "functools.partial": None,
    "builtins.slice": _slice,
}


def read_frame(path: Path) -> dict[str, NDArray[Any]]:
    """Columns of a pickled, gzipped data frame (``.pkl.gz``; plain ``.pkl`` too), by their names.

    Raises:
        InputError: missing, cut off, not a data frame, or it asks for something that is not plain data.
    """
    content = store.read_bytes(path)
    if content[:2] == b"\x1f\x8b":
        content = gunzip(content, str(path))
    return parse_frame(content, str(path))


def gunzip(content: bytes, where: str) -> bytes:
    """Unpack gzip, not beyond ``MAX_BYTES``.

    Raises:
        InputError: cut off, damaged, or larger than that.
    """
    unpacker = zlib.decompressobj(wbits=31)
    try:
        unpacked = unpacker.decompress(content, MAX_BYTES + 1)
    except zlib.error as error:
        raise InputError("gzip file is damaged", where=where, got=str(error), remedy="copy the file again") from error
    if len(unpacked) > MAX_BYTES:
        raise InputError("gzip file unpacks to too much", where=where, expected=f"<= {MAX_BYTES} bytes")
    if not unpacker.eof:
        raise InputError("gzip file is cut off", where=where, got=f"{len(content)} bytes, no end",
            remedy="copy the file again")  # fmt: skip
    return unpacked


def parse_frame(content: bytes, where: str) -> dict[str, NDArray[Any]]:
    """Columns of a pickled data frame; see ``read_frame``."""
    value = read_pickle(content, where, _MAKERS)
    try:
        return _columns(value)
    except (ValueError, IndexError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError("pickle is not a plain data frame", where=where,
            expected="a table of numbers and texts as pandas 0.2x to 2.x writes it",
            got=f"{type(error).__name__}: {error}"[:200],
            remedy="read it with pandas yourself and write it again with DataFrame.to_pickle of pandas 1 or 2") from error  # fmt: skip


def _columns(frame: Any) -> dict[str, NDArray[Any]]:
    if not isinstance(frame, PickledObject) or frame.name != "pandas.core.frame.DataFrame":
        raise ValueError(f"holds a {getattr(frame, 'name', type(frame).__name__)}")
    manager = frame.state["_mgr"] if "_mgr" in frame.state else frame.state["_data"]
    if manager.name not in _MANAGERS:
        raise ValueError(f"holds a {manager.name}")
    if manager.arguments:
        blocks, axes = manager.arguments
        parts = [_block_parts(block) for block in blocks]
    else:
        extra = manager.state[3]["0.14.1"]
        axes = extra["axes"]
        parts = [(block["values"], block["mgr_locs"]) for block in extra["blocks"]]
    if len(axes[0]) > MAX_COLUMNS:
        raise ValueError(f"a table of {len(axes[0])} columns")
    names = [str(name) for name in axes[0]]
    rows = len(axes[1])
    columns: dict[str, NDArray[Any]] = {}
    for values, places in parts:
        array = _array(values)
        chosen = np.arange(len(names))[places if isinstance(places, slice) else _array(places)]
        if array.shape != (len(chosen), rows):
            raise ValueError(f"a block of shape {array.shape} for {len(chosen)} columns and {rows} rows")
        for place, column in zip(chosen, array, strict=True):
            columns[names[place]] = column
    if len(columns) != len(names):
        raise ValueError(f"{len(columns)} of {len(names)} columns are there")
    return {name: columns[name] for name in names}


def _block_parts(block: Any) -> tuple[Any, Any]:
    """Values and places of a block in the forms of pandas 1.3 (a partial call) and later (a tuple)."""
    if isinstance(block, PickledObject):
        if block.name != "functools.partial":
            raise ValueError(f"a block is a {block.name}")
        partial, values, places = block.arguments
        if partial.arguments != (Name(_NEW_BLOCK),):
            raise ValueError("a block of unknown form")
        return values, places
    values, places = block
    return values, places


def _array(value: Any) -> NDArray[Any]:
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, Array) or value.value is None:
        raise ValueError(f"a column is a {getattr(value, 'name', type(value).__name__)}, not a plain array")
    return value.value
