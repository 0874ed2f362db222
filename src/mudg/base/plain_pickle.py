"""Reading pickles without running them: an interpreter of the opcodes that knows only plain values and arrays.

Python's own reader runs whatever a pickle asks for. This one never imports, looks up or calls anything that the file
names: a name is compared with a literal table of makers, which build plain values from plain values; any other is an
error. The opcodes are cut apart by the standard library's disassembler, which executes nothing. Bytes and opcodes are
limited, an array may not be longer than the bytes that are there, and nothing recurses.
"""

from __future__ import annotations

import math
import pickletools
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.errors import InputError

MAX_BYTES: Final = 512 * 1024 * 1024
MAX_OPCODES: Final = 20_000_000
_MAX_DIMENSIONS: Final = 4
_DTYPE: Final = re.compile(r"b1|[iu][1248]|f[248]|O8?|[US]\d{1,4}")
_MARK: Final = object()
PERSISTENT: Final = "persistent"
"""Maker that allows a pickle to point to what lies beside it: the pointers become objects of this name."""
_MALFORMED: Final = (*(ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError), struct.error)
"""What a malformed pickle makes the disassembler or an opcode raise."""


@dataclass(frozen=True, slots=True)
class Name:
    """A global that a pickle names and that is allowed, as text only: ``numpy.ndarray``."""

    text: str


@dataclass(slots=True)
class PickledObject:
    """An object of an allowed class as plain values: its class' name, arguments, state, and items if it is a list."""

    name: str
    arguments: tuple[Any, ...] = ()
    state: Any = None
    items: list[Any] = field(default_factory=list)


class Dtype:
    """A numpy type, completed by its state (byte order)."""

    def __init__(self, text: Any, *_flags: Any) -> None:
        if not isinstance(text, str) or not _DTYPE.fullmatch(text):
            raise ValueError(f"array type {text!r}")
        self.value = np.dtype(text)

    def build(self, state: Any) -> None:
        """Take (version, byte order, no subtype, no names, no fields, ...)."""
        if state[1] not in ("<", ">", "|", "=") or any(part is not None for part in state[2:5]):
            raise ValueError(f"array type with state {state!r}")
        if state[1] in ("<", ">"):
            self.value = self.value.newbyteorder(state[1])


class Array:
    """A numpy array, filled by its state."""

    def __init__(self, value: NDArray[Any] | None = None) -> None:
        self.value: NDArray[Any] | None = value

    def build(self, state: Any) -> None:
        """Take (version, shape, type, in Fortran order, bytes or list of objects)."""
        _version, shape, dtype, fortran, content = state
        self.value = _filled(shape, dtype, "F" if fortran else "C", content)


def _filled(shape: Any, dtype: Any, order: str, content: Any) -> NDArray[Any]:
    if not isinstance(dtype, Dtype):
        raise ValueError("array without a type")
    sizes = list(shape)
    if any(type(side) is not int for side in sizes) or len(sizes) > _MAX_DIMENSIONS or min(sizes, default=0) < 0:
        raise ValueError(f"array of shape {tuple(sizes)}")
    count = math.prod(sizes)
    if dtype.value.hasobject:
        if not isinstance(content, list) or len(content) != count:
            raise ValueError(f"array of {count} objects holds {len(content)}")
        flat = np.empty(count, object)
        flat[:] = content
        order = "C"  # numpy lists objects row by row, whatever the flag says
    else:
        if not isinstance(content, bytes | bytearray) or len(content) != count * dtype.value.itemsize:
            raise ValueError(f"array of shape {tuple(sizes)} and type {dtype.value} holds {len(content)} bytes")
        flat = np.frombuffer(content, dtype.value)
    return flat.reshape(sizes, order="F" if order == "F" else "C")


def _new_array(kind: Any, _shape: Any, _code: Any) -> Array:
    if kind != Name("numpy.ndarray"):
        raise ValueError("a class other than numpy.ndarray")
    return Array()


Maker = Callable[..., Any]
_OF_NUMPY: Final[Mapping[str, Maker]] = {
    "multiarray._reconstruct": _new_array,
    "multiarray.scalar": lambda dtype, content: _filled((), dtype, "C", content).item(),
    "numeric._frombuffer": lambda content, dtype, shape, order: Array(_filled(shape, dtype, str(order), content)),
}
NUMPY_MAKERS: Final[Mapping[str, Maker | None]] = {
    "numpy.ndarray": None,
    "numpy.dtype": Dtype,
    **{f"numpy.{core}.{name}": maker for core in ("core", "_core") for name, maker in _OF_NUMPY.items()},
}
"""Names by which numpy pickles arrays -> what is made of them here (None = a name that is only passed on)."""


def read_pickle(content: bytes, where: str, makers: Mapping[str, Maker | None]) -> Any:
    """Plain values from a pickle, protocol 0 to 5: numbers, texts, bytes, lists, tuples, dicts, ``Array``,
    ``PickledObject``. makers: name in the file (``module.name``) -> function from plain values to a plain value; None =
    a class or name that may only be mentioned: objects of it become a ``PickledObject``. InputError: cut off,
    malformed, too large, or it names something that is not in ``makers``."""
    if len(content) > MAX_BYTES:
        got = f"{len(content)} bytes"
        raise InputError("pickle is too large", where=where, expected=f"<= {MAX_BYTES} bytes", got=got)
    machine = _Machine(where, makers)
    try:
        for count, (opcode, argument, _place) in enumerate(pickletools.genops(content)):
            if count > MAX_OPCODES:
                raise ValueError(f"more than {MAX_OPCODES} opcodes")
            if opcode.name == "STOP":
                return machine.result()
            machine.step(opcode.name, argument)
    except _MALFORMED as error:
        what, remedy = "pickle is malformed or cut off", "copy the file again"
        raise InputError(what, where=where, got=f"{type(error).__name__}: {error}"[:200], remedy=remedy) from error
    raise InputError("pickle is cut off", where=where, expected="an end mark", remedy="copy the file again")


def as_list(value: Any, where: str) -> list[Any]:
    """The items of a pickled list, tuple, array, or object of an allowed list class."""
    if isinstance(value, PickledObject):
        return value.items
    if isinstance(value, Array) and value.value is not None:
        return value.value.tolist()
    if isinstance(value, list | tuple):
        return list(value)
    raise InputError("pickle holds no list", where=where, got=type(value).__name__, expected="a list of numbers")


_CONSTANTS: Final = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_VALUES: Final = frozenset(
    "INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT UNICODE SHORT_BINUNICODE BINUNICODE BINUNICODE8 "
    "SHORT_BINBYTES BINBYTES BINBYTES8 BYTEARRAY8 STRING BINSTRING SHORT_BINSTRING".split()
)


class _Machine:
    """Stack and memo of one pickle."""

    def __init__(self, where: str, makers: Mapping[str, Maker | None]) -> None:
        self._where, self._makers = where, makers
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def result(self) -> Any:
        """What the pickle holds."""
        (value,) = self._stack
        return value

    def step(self, opcode: str, argument: Any) -> None:
        """Carry out one opcode."""
        stack = self._stack
        if opcode in _VALUES:
            stack.append(argument)
        elif opcode in _CONSTANTS:
            stack.append(_CONSTANTS[opcode])
        elif opcode in ("PROTO", "FRAME"):
            return
        elif opcode == "MARK":
            stack.append(_MARK)
        elif opcode in ("GLOBAL", "STACK_GLOBAL"):
            self._global(opcode, argument)
        elif opcode in ("MEMOIZE", "PUT", "BINPUT", "LONG_BINPUT"):
            self._memo[len(self._memo) if opcode == "MEMOIZE" else int(argument)] = stack[-1]
        elif opcode in ("GET", "BINGET", "LONG_BINGET"):
            stack.append(self._memo[int(argument)])
        elif opcode in _CONTAINERS:
            self._container(opcode)
        elif opcode in ("REDUCE", "NEWOBJ", "NEWOBJ_EX", "BUILD"):
            self._object(opcode)
        elif opcode in ("POP", "POP_MARK"):
            self._since_mark() if opcode == "POP_MARK" else stack.pop()
        elif opcode == "BINPERSID" and PERSISTENT in self._makers:
            stack.append(PickledObject(PERSISTENT, (stack.pop(),)))
        elif opcode == "DUP":
            stack.append(stack[-1])
        else:
            what = "pickle uses an operation that plain data does not need"
            remedy = "the file is not what the data set ships; do not open it with Python's pickle"
            raise InputError(what, where=self._where, got=opcode, remedy=remedy)

    def _since_mark(self) -> list[Any]:
        for index in range(len(self._stack) - 1, -1, -1):
            if self._stack[index] is _MARK:
                items = self._stack[index + 1 :]
                del self._stack[index:]
                return items
        raise ValueError("no mark")

    def _global(self, opcode: str, argument: Any) -> None:
        if opcode == "GLOBAL":
            module, _, name = str(argument).partition(" ")
        else:
            name, module = self._stack.pop(), self._stack.pop()
        text = f"{module}.{name}"
        if text not in self._makers:
            what, where, got = f"pickle asks for {text!r}, which is not plain data", self._where, text[:120]
            remedy = "nothing was run. If the file comes from the data set itself, convert it to a plain format"
            raise InputError(what, where=where, expected="numbers, texts, lists and arrays", got=got, remedy=remedy)
        self._stack.append(Name(text))

    def _container(self, opcode: str) -> None:
        stack = self._stack
        if opcode in ("EMPTY_LIST", "EMPTY_DICT", "EMPTY_TUPLE"):
            stack.append({"EMPTY_LIST": [], "EMPTY_DICT": {}, "EMPTY_TUPLE": ()}[opcode])
        elif opcode in ("TUPLE1", "TUPLE2", "TUPLE3"):
            items = [stack.pop() for _ in range(int(opcode[-1]))]
            stack.append(tuple(items[::-1]))
        elif opcode in ("TUPLE", "LIST"):
            items = self._since_mark()
            stack.append(tuple(items) if opcode == "TUPLE" else items)
        elif opcode in ("APPEND", "APPENDS"):
            items = [stack.pop()] if opcode == "APPEND" else self._since_mark()
            target = stack[-1].items if isinstance(stack[-1], PickledObject) else stack[-1]
            if not isinstance(target, list):
                raise TypeError("items for something that is no list")
            target.extend(items)
        else:
            items = [stack.pop(-2), stack.pop()] if opcode == "SETITEM" else self._since_mark()
            target = {} if opcode == "DICT" else stack[-1]
            if not isinstance(target, dict) or len(items) % 2:
                raise TypeError("entries for something that is no dict")
            if not all(isinstance(key, str | int | float | bytes | None) for key in items[::2]):
                raise TypeError("a key that is no plain value")  # hashing a deep tuple would exhaust the C stack
            target.update(zip(items[::2], items[1::2], strict=True))
            if opcode == "DICT":
                stack.append(target)

    def _object(self, opcode: str) -> None:
        stack = self._stack
        if opcode == "BUILD":
            state = stack.pop()
            target = stack[-1]
            if isinstance(target, PickledObject):
                target.state = state
            elif isinstance(target, Dtype | Array):
                target.build(state)
            else:
                raise TypeError(f"state for a {type(target).__name__}")
            return
        if opcode == "NEWOBJ_EX" and stack.pop():
            raise ValueError("named arguments")
        arguments, kind = stack.pop(), stack.pop()
        if not isinstance(arguments, tuple):
            raise TypeError("arguments are no tuple")
        if isinstance(kind, PickledObject):  # a call of an object is kept: whoever knows its class may read it
            stack.append(PickledObject(kind.name, (kind, *arguments)))
        elif not isinstance(kind, Name):
            raise TypeError(f"a call of a {type(kind).__name__}")
        else:
            maker = self._makers[kind.text] if opcode == "REDUCE" else None
            stack.append(PickledObject(kind.text, arguments) if maker is None else maker(*arguments))


_CONTAINERS: Final = frozenset(
    "EMPTY_LIST EMPTY_DICT EMPTY_TUPLE TUPLE1 TUPLE2 TUPLE3 TUPLE LIST APPEND APPENDS DICT SETITEM SETITEMS".split()
)
