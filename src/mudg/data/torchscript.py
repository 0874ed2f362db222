"""The tensors of a TorchScript archive, without its program.

``torch.jit.load`` would take in code from the file. What the networks of the scores need are the tensors alone: the archive is a zip, its
``data.pkl`` a pickle that names classes of the program and places in ``data/``. It is read by the interpreter of
``data/plain_pickle.py``, which runs nothing; classes become plain objects, and the tensors get the names of the attributes that
lead to them.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from mudg.base.errors import InputError
from mudg.data.plain_pickle import PERSISTENT, Maker, Name, PickledObject, read_pickle

_STORAGES: Final = {
    "torch.FloatStorage": (torch.float32, 4), "torch.HalfStorage": (torch.float16, 2), "torch.BFloat16Storage": (torch.bfloat16, 2),
    "torch.DoubleStorage": (torch.float64, 8), "torch.LongStorage": (torch.int64, 8), "torch.IntStorage": (torch.int32, 4),
    "torch.ShortStorage": (torch.int16, 2), "torch.CharStorage": (torch.int8, 1), "torch.ByteStorage": (torch.uint8, 1),
    "torch.BoolStorage": (torch.bool, 1),
}  # fmt: skip
_PROGRAM: Final = "__torch__."
_BUILDERS: Final = "torch.jit._pickle."
_DEEPEST: Final = 64


class _Names(Mapping[str, Maker | None]):
    """Names that an archive may mention: classes of its program, storages, and what puts tensors and lists together."""

    def __init__(self) -> None:
        self._known: dict[str, Maker | None] = {
            "torch._utils._rebuild_tensor_v2": _tensor, "collections.OrderedDict": dict, **dict.fromkeys((PERSISTENT, *_STORAGES)),
            **{f"{_BUILDERS}build_{kind}list": lambda items: items for kind in ("int", "double", "bool", "tensor")},
            f"{_BUILDERS}restore_type_tag": lambda value, _kind: value,
        }  # fmt: skip

    def __contains__(self, name: object) -> bool:
        return name in self._known or str(name).startswith(_PROGRAM)

    def __getitem__(self, name: str) -> Maker | None:
        return None if name.startswith(_PROGRAM) else self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._known)

    def __len__(self) -> int:
        return len(self._known)


def _tensor(storage: Any, offset: Any, size: Any, stride: Any, *_more: Any) -> PickledObject:
    """A tensor as the archive describes it; its numbers are read later."""
    if not isinstance(storage, PickledObject) or storage.name != PERSISTENT:
        raise ValueError("a tensor without a storage")
    return PickledObject("tensor", (storage, offset, tuple(size), tuple(stride)))


def is_torchscript(path: Path) -> bool:
    """Whether a file is a TorchScript archive."""
    if not path.is_file() or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    return any(name.endswith("/constants.pkl") for name in names) and any("/code/" in name for name in names)


def read_torchscript(path: Path) -> dict[str, Tensor]:
    """All tensors of an archive by the attributes that lead to them, such as ``mixed_3b.branch_0.conv3d.weight``.

    Raises:
        InputError: the archive is malformed, or names what no network needs.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            (index,) = (name for name in archive.namelist() if name.endswith("/data.pkl") and name.count("/") == 1)
            content = read_pickle(archive.read(index), f"{path}: {index}", _Names())
            folder = index.removesuffix("data.pkl") + "data/"
            return {name: _read(archive, folder, found, f"{path}: {name}") for name, found in _leaves(content, "", 0)}
    except (zipfile.BadZipFile, KeyError, ValueError, NotImplementedError) as error:
        raise InputError("not a readable TorchScript archive", where=str(path), got=f"{type(error).__name__}: {error}"[:200],
            remedy="fetch the file again and compare its size") from error  # fmt: skip


def _leaves(value: Any, name: str, depth: int) -> Iterator[tuple[str, PickledObject]]:
    """Tensors below an object, with their names."""
    if depth > _DEEPEST:
        raise ValueError("objects lie too deep")
    if isinstance(value, PickledObject) and value.name == "tensor":
        yield name, value
        return
    inner = value.state if isinstance(value, PickledObject) else value
    items = inner.items() if isinstance(inner, Mapping) else enumerate(inner) if isinstance(inner, list | tuple) else ()
    for key, entry in items:
        yield from _leaves(entry, f"{name}.{key}" if name else str(key), depth + 1)


def _read(archive: zipfile.ZipFile, folder: str, found: PickledObject, where: str) -> Tensor:
    storage, offset, size, stride = found.arguments
    ((mark, kind, key, _place, count),) = storage.arguments
    if mark != "storage" or not isinstance(kind, Name) or kind.text not in _STORAGES or not isinstance(key, str) or not key.isalnum():
        raise InputError("a tensor has an unknown storage", where=where, got=repr(storage.arguments)[:120])
    dtype, width = _STORAGES[kind.text]
    whole = [offset, count, *size, *stride]
    if not all(isinstance(number, int) and number >= 0 for number in whole) or len(size) != len(stride):
        raise InputError("a tensor has an impossible shape", where=where, got=f"{size}, strides {stride}")
    reach = offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True)) + 1 if math.prod(size) else 0
    content = archive.read(folder + key)
    if len(content) != count * width or reach > count:
        raise InputError("a tensor does not fit its storage", where=where, expected=f"{count} values", got=f"{len(content)} bytes")
    flat = torch.from_numpy(np.frombuffer(content, np.uint8).copy()).view(dtype) if count else torch.zeros(0, dtype=dtype)
    return flat.as_strided(size, stride, offset).clone()
