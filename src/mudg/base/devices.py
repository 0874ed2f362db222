"""Which device computes: chosen once per verb from its `--device`, checked, and said aloud.

    auto      the first CUDA device if there is one, else the CPU
    cpu       the CPU
    cuda, cuda:N   the first CUDA device, or number N; refused if it is not there
    mps       Apple's GPU, for networks only; refused for what has no kernels there

Numpy arrays stay on the CPU. A stage moves tensors to the device in one place, and results back in one place.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Annotated, Final

from mudg.base import log
from mudg.base.config import Limits
from mudg.base.errors import ResourceError, UsageError

if TYPE_CHECKING:
    import torch

DevicePattern: Final = r"^(auto|[a-z]+(:\d+)?)$"
DeviceName = Annotated[str, Limits(pattern=DevicePattern)]
"""A setting's type: `auto`, or a kind of device with or without its number."""
REMEDY: Final = "--device cpu works everywhere; `mudg doctor` lists the devices of this machine"


def _cuda_problem(index: int) -> str:
    import torch

    if not torch.cuda.is_available():
        return "this torch is a build for the CPU" if torch.version.cuda is None else "torch finds no CUDA device"
    count = torch.cuda.device_count()
    return "" if index < count else f"there are {count}: cuda:0 to cuda:{count - 1}"


def _mps_problem(index: int) -> str:
    import torch

    return "" if torch.backends.mps.is_available() and index == 0 else "torch finds no MPS device"


PROBLEMS: Final[dict[str, Callable[[int], str]]] = {"cpu": lambda _: "", "cuda": _cuda_problem, "mps": _mps_problem}
"""Kind of device -> why the one of this number cannot be used, or ""."""
NETWORK_KINDS: Final = ("cpu", "cuda", "mps")
"""Kinds of devices for networks that are plain torch."""
SAME_CODE: Final[dict[str, str]] = {}
"""Kinds that other packages add to torch -> the kind above whose code runs on them."""


def choose_device(wanted: str, purpose: str, kinds: tuple[str, ...] = ("cpu", "cuda")) -> torch.device:
    """The device that a verb computes on. Says which, once per purpose (as "fit"). kinds: for which the purpose has an
    implementation; another kind is a UsageError. ResourceError: the device is not on this machine."""
    import torch

    name = usual_device(kinds) if wanted == "auto" else wanted
    kind, _, number = name.partition(":")
    if kind not in PROBLEMS or not re.match(DevicePattern, wanted):
        where = "--device"
        raise UsageError("unknown device", where=where, expected=f"auto, {', '.join(PROBLEMS)} or cuda:N", got=wanted)
    if SAME_CODE.get(kind, kind) not in kinds:
        what = f"{purpose}: not implemented on this device"
        raise UsageError(what, where="--device", expected=f"auto, {', '.join(kinds)}", got=wanted, remedy=REMEDY)
    problem = PROBLEMS[kind](int(number or 0))
    if problem:
        what = f"{purpose}: this device cannot be used"
        raise ResourceError(what, where="--device", expected=wanted, got=problem, remedy=REMEDY)
    chosen = torch.device("cpu") if kind == "cpu" else torch.device(kind, int(number or 0))
    log.info_once(f"{purpose}: {described(chosen)}")
    return chosen


def usual_device(kinds: tuple[str, ...] = ("cpu", "cuda")) -> str:
    """What `auto` stands for on this machine, of these kinds."""
    return "cuda" if "cuda" in kinds and not _cuda_problem(0) else "cpu"


def described(device: torch.device) -> str:
    """The device in words: a CUDA card with its name and free memory."""
    import torch

    if device.type != "cuda":
        return {"cpu": "on the CPU"}.get(device.type, f"on {device}")
    free, total = torch.cuda.mem_get_info(device)
    return f"on {device} ({torch.cuda.get_device_name(device)}, {free / 2**30:.1f} of {total / 2**30:.1f} GiB free)"


@contextlib.contextmanager
def memory_of(device: torch.device, purpose: str) -> Iterator[None]:
    """Within: memory of the device that runs out is a ResourceError with a remedy."""
    import torch

    try:
        yield
    except torch.OutOfMemoryError as error:
        got = str(error).split(". ")[0]
        remedy = "smaller images (--width-px), fewer Gaussians (--densify.max-gaussians), or --device cpu"
        raise ResourceError(f"{purpose}: the memory of {device} ran out", got=got, remedy=remedy) from error
