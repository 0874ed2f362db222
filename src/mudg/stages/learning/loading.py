"""The diffusion model that a synthesize configuration names, of whichever kind, ready to sample."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from mudg.base import log
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import ResourceError, UsageError
from mudg.models.diffusion import SampleRequest
from mudg.models.mdm import files as mdm_files
from mudg.models.mdm.model import MDM
from mudg.models.published import files as published_files
from mudg.models.published.model import PublishedMDM, WorkSplit
from mudg.stages.config import SynthesizeConfig
from mudg.stages.learning import memory_plan
from mudg.stages.learning.precision import half_format

FEW_STEPS = 20
DiffusionModel = MDM | PublishedMDM


def check_config(config: SynthesizeConfig, fitted: bool, *, weather: bool = False) -> SynthesizeConfig:
    """The configuration with its device chosen, and the number of processes that its model wants; without reading weights of a
    published-type model.

    Args:
        fitted: whether a fitted scene is given too. weather: and tells the distances by which views are brought into other weather.

    Raises:
        UsageError: a setting that does not apply to this kind of model, or to the device. InputError: no such model.
        ResourceError: no such device.
    """
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    if device.type != "cpu" and config.processes > 1:
        raise UsageError(f"on {device} one process makes all trajectories", where="--processes", expected="0 or 1",
                         got=str(config.processes), remedy="leave it out, or give --device cpu")  # fmt: skip
    config = replace(config, device=str(device))
    half_of(config)
    published = published_files.is_published(config.model)
    (PublishedMDM if published else MDM).check_request(request_of(config))
    if published and fitted and not weather:
        raise UsageError("a published-type model uses a fitted scene for weather and light of --edits only", where="--fitted",
                         remedy="leave it out")  # fmt: skip
    repairs = config.condition == "repair"
    if repairs and not (fitted or published):
        raise UsageError("this condition is made of renders of a fitted scene", where="--condition", got="repair",
                         remedy="give the folder of a finished fit as --fitted")  # fmt: skip
    if published and config.condition in ("freevs", "repair"):
        raise UsageError(
            "a published-type model does not know this condition", where="--condition", expected="full, reference, points, concat",
            got=config.condition, remedy="leave it out, or choose another --model",
        )  # fmt: skip
    if config.condition != "full" and fitted and not repairs:
        raise UsageError("parts of the condition cannot be switched off here", where="--condition", expected="full",
                         got="--fitted: renders are left out of such a condition", remedy="leave out --condition or --fitted")  # fmt: skip
    if published and config.offload and device.type == "cpu":
        raise UsageError("the image tower is on the CPU already", where="--offload", got="--device cpu", remedy="leave one of them out")
    if published:
        return replace(config, processes=config.processes or 1)  # one copy of a large model in memory
    for flag, given in (("memory-budget-gb", config.memory_budget_gb), ("offload", config.offload), ("compiled", config.compiled)):
        if given:
            raise UsageError(
                "this setting applies to published-type models only", where=f"--{flag}", remedy="leave it out"
            )
    model = mdm_files.load(config.model)  # fails now rather than in every process
    if fitted and not model.config.renders:
        raise UsageError("this model was not trained with renders of a fitted scene", where="--fitted", got=config.model,
                         remedy="leave it out, or choose another --model")  # fmt: skip
    return config


def request_of(config: SynthesizeConfig, bf16: bool = False) -> SampleRequest:
    """What a configuration asks of the model for every window; the window's own number and known frames are to be put in."""
    return SampleRequest(
        config.steps, config.seed, sampler=config.sampler, eta=config.eta, guidance=config.guidance,
        guidance_rescale=config.guidance_rescale, align=config.align_depth, bf16=bf16,
    )  # fmt: skip


def half_of(config: SynthesizeConfig) -> torch.dtype | None:
    """The half precision that a configuration's model computes in, None for float32. Published-type models bear float16."""
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    return half_format(config.precision, device, float16=published_files.is_published(config.model))


def load_any(config: SynthesizeConfig) -> DiffusionModel:
    """The model of a configuration.

    On another device than the CPU a published-type model has its weights in the number format that `precision` says. Its work is cut to
    fit `memory_budget_gb`, or, without one, what is free on a CUDA device.

    Raises:
        ResourceError: it does not fit however it is cut, or no such device.
    """
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    if not published_files.is_published(config.model):
        return mdm_files.load(config.model).to(device)
    if config.steps < FEW_STEPS:
        log.warn(
            f"synthesize: the published model was trained for 50 denoising steps, but --steps is {config.steps} (recommended: --steps 50)"
        )
    half = half_of(config)
    dtype = None if device.type == "cpu" else half or torch.float32
    model = published_files.load(Path(config.model), dtype=dtype)
    model.split = WorkSplit(frames_at_once=1, offload=config.offload)
    budget_gb = config.memory_budget_gb or _free_gb(device)
    if budget_gb:
        model.split = _choose_split(model, config, budget_gb, 4 if half is None else 2)
    tower = model.image
    if model.split.offload:
        model.image = torch.nn.Identity()  # type: ignore[assignment]
    model.to(device).image = tower
    if config.compiled:
        model.net.compile()
    return model


def _free_gb(device: torch.device) -> float:
    """Free memory of a CUDA device in GB, 0 of others (unknown)."""
    return torch.cuda.mem_get_info(device)[0] / 1e9 if device.type == "cuda" else 0.0


def _choose_split(model: PublishedMDM, config: SynthesizeConfig, budget_gb: float, bytes_per_value: int) -> WorkSplit:
    """How the model's work is cut to fit a memory budget in GB."""
    split, peak_bytes = memory_plan.choose(
        memory_plan.needs_of(model.config, bytes_per_value), int(budget_gb * 1e9), guidance=config.guidance != 1,
        offload=(False,) if config.device == "cpu" else (True,) if config.offload else (False, True),
    )  # fmt: skip
    if peak_bytes > budget_gb * 1e9:
        raise ResourceError(
            "the model does not fit into the memory budget, however its work is split",
            where="--memory-budget-gb" if config.memory_budget_gb else f"free memory of --device {config.device}",
            expected=f">= {peak_bytes / 1e9:.1f} GB", got=f"{budget_gb:.4g} GB", remedy="use the 320x512 model, or bfloat16",
        )  # fmt: skip
    log.info(
        f"synthesize: modalities {'together' if split.modalities_together else 'one by one'}, guidance "
        f"{'together' if split.guidance_together else 'in two passes'}, {split.frames_at_once} frames per decoding, "
        f"image tower {'on the CPU' if split.offload else 'kept'}, "
        f"about {peak_bytes / 1e9:.1f} GB at most"
    )
    return split
