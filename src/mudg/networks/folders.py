"""Pretrained networks in folders, as transformers and diffusers (extras) write them, completely or not at all. Nothing
is downloaded; our tables name the class that reads a folder, code in it never runs, and weights come from safetensors.
A weight that the folder lacks is an error, where the packages would leave it random."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import store, weights
from mudg.base.errors import InputError, ResourceError

NORM: Final = ("weight", "bias", "running_mean", "running_var")
"""Tensors of a norm."""
NORM_EPSILON: Final = 1e-3


class ScoreNetwork(nn.Module):
    """A fixed network of a score, always in evaluation mode, with the wanted tensors (name -> shape) as float32.
    ``where``: file name for errors. ``network``: what to call it. ``ignored``: names that may be there and are not
    read. InputError: a tensor is missing, unknown, has another shape, or holds impossible values."""

    def __init__(
        self,
        state: Mapping[str, Tensor],
        wanted: Mapping[str, tuple[int, ...]],
        where: str,
        network: str,
        ignored: Callable[[str], bool] = lambda name: name.endswith(".bn.num_batches_tracked"),
    ) -> None:
        super().__init__()
        found = {name: value for name, value in state.items() if name in wanted or not ignored(name)}
        weights.match_exactly(found, wanted, where, network)
        weights.refuse_bad_values(found, where)
        for name, value in found.items():
            if name.endswith("running_var") and bool((value < 0).any()):
                raise InputError("a variance lies below 0", where=f"{where}: {name}")
        for name in wanted:
            self.register_buffer(name.replace(".", "/"), found[name].detach().float())

    def tensor(self, name: str) -> Tensor:
        """A tensor by its published name."""
        return self.get_buffer(name.replace(".", "/"))

    def normed(self, x: Tensor, name: str) -> Tensor:
        """The norm of a convolution, and ReLU."""
        weight, bias, mean, variance = (self.tensor(f"{name}.bn.{leaf}") for leaf in NORM)
        return functional.relu(functional.batch_norm(x, mean, variance, weight, bias, eps=NORM_EPSILON))


# folders ------------------------------------------------------------------------------------------

_REMEDY: Final = "pip install 'mudg[models]'"
CPU: Final = torch.device("cpu")
MEAN: Final = (0.485, 0.456, 0.406)
DEVIATION: Final = (0.229, 0.224, 0.225)
"""Statistics of colours in 0..1 (ImageNet) where a folder names none."""


def normalized(rgb: NDArray[np.uint8], mean: Sequence[float], deviation: Sequence[float]) -> Tensor:
    """Image u8[H, W, 3] as f32[1, 3, H, W] with the mean and deviation of its colours in 0..1 taken out."""
    image = torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255
    offset, scale = (torch.tensor(numbers)[None, :, None, None] for numbers in (mean, deviation))
    return (image - offset) / scale


def package(name: Literal["transformers", "diffusers"]) -> ModuleType:
    """A package that reads folders, with its progress bars off; ResourceError names the extra if it is missing."""
    try:
        found = {  # literal names: no text becomes an import
            "transformers": lambda: importlib.import_module("transformers"),
            "diffusers": lambda: importlib.import_module("diffusers"),
        }[name]()
    except ImportError as error:
        where = "pretrained network"
        raise ResourceError(f"the {name} package is missing", where=where, got=str(error), remedy=_REMEDY) from error
    switch = getattr(getattr(getattr(found, "utils", None), "logging", None), "disable_progress_bar", None)
    if switch is not None:  # its bars would run through ours
        switch()
    return found


def member(owner: ModuleType, class_name: str) -> Any:
    """A class of a package; ResourceError where the installed version is too old to have it."""
    found = getattr(owner, class_name, None)
    if found is None:
        what = f"the installed {owner.__name__} package has no {class_name}"
        got, remedy = str(getattr(owner, "__version__", "")), f"pip install --upgrade {owner.__name__}"
        raise ResourceError(what, where="pretrained network", expected="a newer version", got=got, remedy=remedy)
    return found


def read_settings(file: Path) -> dict[str, Any]:
    """A JSON object of a folder; InputError where there is none."""
    content = store.read_json(file)
    if not isinstance(content, dict):
        raise InputError("the description of a network is no JSON object", where=str(file), got=type(content).__name__)
    return content


def load_network(network_class: Any, folder: Path, device: torch.device = CPU, subfolder: str = "") -> nn.Module:
    """A network with all its weights, in float32 on its device, ready for use; its parameters have no gradient.
    network_class: class of transformers or diffusers. folder: as ``save_pretrained`` writes it, or the folder around
    ``subfolder``. InputError: the folder does not hold this network, or not all of it."""
    where = str(folder / subfolder)
    options: dict[str, Any] = {"local_files_only": True, "use_safetensors": True, "output_loading_info": True}
    if subfolder:
        options["subfolder"] = subfolder
    if network_class.__module__.split(".")[0] == "diffusers":
        options["low_cpu_mem_usage"] = False  # what saves memory there needs one more package
    try:
        network, report = network_class.from_pretrained(str(folder), **options)
    except (OSError, ValueError, TypeError, KeyError, RuntimeError) as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        what = f"the folder cannot be read as {network_class.__name__}"
        expected = "the configuration and the safetensors file that save_pretrained writes"
        raise InputError(what, where=where, got=lines[0][:300], expected=expected) from error
    lacking = sorted(str(name) for key in ("missing_keys", "mismatched_keys") for name in report.get(key) or ())
    if lacking:
        what = f"weights of the {network_class.__name__} are missing, or have another shape"
        got = ", ".join(lacking[:4]) + (" ..." if len(lacking) > 4 else "")
        remedy = "take the folder of the whole network, with its task's head"
        raise InputError(what, where=where, expected="a value for every parameter", got=got, remedy=remedy)
    if any(value.dtype != torch.float32 for value in network.parameters()):
        network = network.float()
    return network.to(device).eval().requires_grad_(False)
