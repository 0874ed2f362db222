"""A pretend accelerator: tensors that say they live on another device, hold their values in memory, and refuse to mix.

With it, code that is meant for a GPU runs on a machine without one, with real numbers, and every slip that a GPU would
punish is an error here too: operands on two devices, `.numpy()` without `.cpu()`, a pointer handed to native code, a
generator of the wrong device. What it cannot tell: kernels that exist only there, speed, memory, race conditions.
"""

from __future__ import annotations

import os
import traceback
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import torch
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

from mudg.base import devices

NAME = "pretend"
PACKAGE = f"{Path(devices.__file__).parents[1]}{os.sep}"


_LIBRARIES: list[torch.library.Library] = []


_BACKEND = SimpleNamespace(
    is_available=lambda: True,
    is_initialized=lambda: True,
    _lazy_init=lambda: None,
    device_count=lambda: 1,
    current_device=lambda: 0,
    synchronize=lambda device=None: None,
    manual_seed_all=lambda seed: None,
    get_rng_state=lambda device=None: torch.zeros(0, dtype=torch.uint8),
    set_rng_state=lambda state, device=None: None,
    _is_in_bad_fork=lambda: False,
    get_amp_supported_dtype=lambda: [torch.bfloat16, torch.float16],
)
"""What `torch.pretend` is asked for."""


def _register() -> None:
    """Make torch know the device by name, without any C++."""
    from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

    if torch._C._get_privateuse1_backend_name() != NAME:
        _setup_privateuseone_for_python_backend(NAME, backend_module=_BACKEND)
        _LIBRARIES.append(torch.library.Library("_", "IMPL", "AutocastPrivateUse1"))
        _LIBRARIES[-1].fallback(torch.library.fallthrough_kernel)


_register()
DEVICE = torch.device(NAME, 0)


class Pretend(torch.Tensor):
    """A tensor on the pretend device; `inner` holds its values."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> Pretend:
        options = {"dtype": inner.dtype, "layout": inner.layout, "device": DEVICE, "requires_grad": False}
        options |= {"strides": inner.stride(), "storage_offset": inner.storage_offset()}
        return torch.Tensor._make_wrapper_subclass(cls, inner.size(), **options)

    def __init__(self, inner: torch.Tensor) -> None:
        self.inner = inner

    def __repr__(self, **_) -> str:
        return f"pretend({self.inner!r})"

    def numpy(self, *args, **kwargs):
        raise TypeError("can't convert a tensor of another device to numpy; use .cpu() first")

    def tolist(self):
        return self.cpu().tolist()

    def new_tensor(self, data, *, dtype=None, device=None, requires_grad=False):
        made = torch.tensor(data, dtype=dtype or self.dtype).to(device or DEVICE)
        return made.requires_grad_(requires_grad)

    def data_ptr(self):
        raise TypeError("the memory of another device cannot be pointed to from here; use .cpu() first")

    def __array__(self, *args, **kwargs):
        raise TypeError("can't convert a tensor of another device to numpy; use .cpu() first")

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func, types_, args=(), kwargs=None):
        return run(func, args, kwargs or {})


@dataclass(frozen=True)
class Transfer:
    """One copy between the devices: "there" or "back", number of values, and the function of the package that asked for
    it. Or a "wait": a result whose size the CPU must know before it can go on, as that of ``nonzero`` and of a choice
    by a mask."""

    way: str
    values: int
    where: str


TRANSFERS: list[list[Transfer]] = []
"""Lists that take every copy, see ``transfers``."""
NUMBER_BACK = "aten::_local_scalar_dense"
WAITS = {"aten::nonzero", "aten::masked_select", "aten::_unique2", "aten::repeat_interleave"}


@contextmanager
def transfers():
    """Within: a list that fills with what goes from one device to the other, single numbers that are read included."""
    TRANSFERS.append([])
    try:
        yield TRANSFERS[-1]
    finally:
        TRANSFERS.pop()


def _note_transfer(way: str, values: int) -> None:
    if TRANSFERS:
        frames = [f for f in traceback.extract_stack() if f.filename.startswith(PACKAGE)]
        where = f"{frames[-1].filename.removeprefix(PACKAGE)}:{frames[-1].name}" if frames else ""
        for taken in TRANSFERS:
            taken.append(Transfer(way, values, where))


COPIES = {"aten::_to_copy", "aten::copy_", "aten::to", "aten::_copy_from"}


def run(func, args, kwargs):
    """Run an operation on the values, after looking at where its operands say they are."""
    name = func._schema.name
    wanted = kwargs.get("device")
    leaves = [x for x in pytree.tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    there = [x for x in leaves if isinstance(x, Pretend)]
    if name not in COPIES:
        here = [x for x in leaves if not isinstance(x, Pretend) and x.dim() > 0]
        index_ok = name.startswith(("aten::index", "aten::_index_put", "aten::_unsafe_index"))
        if there and here and not index_ok:
            raise RuntimeError(f"{name}: expected all tensors to be on the same device, but found {DEVICE} and cpu")
        if index_ok and here and isinstance(args[0], torch.Tensor) and not isinstance(args[0], Pretend) and there:
            raise RuntimeError(f"{name}: indices should be on the cpu, as the indexed tensor is")
    to_there = any(x is not None for x in there)
    if wanted is not None:
        to_there = torch.device(wanted).type == NAME
        kwargs = {**kwargs, "device": torch.device("cpu")}
    if name == "aten::copy_":
        to_there = isinstance(args[0], Pretend)
        if to_there != isinstance(args[1], Pretend):
            _note_transfer("there" if to_there else "back", args[1].numel())
    elif name in COPIES and to_there != isinstance(args[0], Pretend):
        _note_transfer("there" if to_there else "back", args[0].numel())
    elif name == NUMBER_BACK:
        _note_transfer("back", 1)
    elif there and (name in WAITS or (name == "aten::index" and any(x.dtype == torch.bool for x in leaves[1:]))):
        _note_transfer("wait", 0)
    generator = kwargs.get("generator")
    if to_there and generator is not None and generator.device.type == "cpu":
        raise RuntimeError(f"{name}: expected a generator of {DEVICE}, found one of cpu")
    if kwargs.get("pin_memory"):
        kwargs = {**kwargs, "pin_memory": False}
    open_ = lambda x: x.inner if isinstance(x, Pretend) else x
    out = func(*pytree.tree_map(open_, args), **pytree.tree_map(open_, kwargs))
    mutated = {id(a.inner): a for a in there}

    def close(x):
        if not isinstance(x, torch.Tensor) or not to_there:
            return x
        known = mutated.get(id(x))
        return Pretend(x) if known is None else known

    for wrapper in there:  # in-place changes of shape
        if wrapper.size() != wrapper.inner.size():
            raise RuntimeError(f"{name}: resizing in place is not pretended")
    return pytree.tree_map(close, out)


class Factories(TorchDispatchMode):
    """Sends creation on the pretend device, and moves to it, to `run`."""

    def __torch_dispatch__(self, func, types_, args=(), kwargs=None):
        kwargs = kwargs or {}
        wanted = kwargs.get("device")
        if wanted is not None and torch.device(wanted).type == NAME:
            return run(func, args, kwargs)
        if any(isinstance(x, Pretend) for x in pytree.tree_leaves((args, kwargs))):
            return run(func, args, kwargs)
        return func(*args, **kwargs)


@contextmanager
def pretend_device():
    """Within: `torch.device("pretend")` works, and `--device pretend` names it wherever CUDA is implemented."""
    devices.PROBLEMS[NAME], devices.SAME_CODE[NAME] = lambda _: "", "cuda"
    before = torch._C._only_lift_cpu_tensors()
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(..., device=...) is built here, then sent there
    try:
        with Factories():
            yield DEVICE
    finally:
        torch._C._set_only_lift_cpu_tensors(before)
        del devices.PROBLEMS[NAME], devices.SAME_CODE[NAME]
