"""The diffusion model that a synthesize configuration names, of whichever kind, ready to sample."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from mudg.base import log
from mudg.base.errors import ResourceError, UsageError
from mudg.models.diffusion import SampleRequest
from mudg.models.mdm import files as mdm_files
from mudg.models.mdm.model import MDM
from mudg.models.published import files as published_files
from mudg.models.published.model import PublishedMDM, WorkSplit
from mudg.stages.config import SynthesizeConfig
from mudg.stages.learning import memory_plan
from mudg.stages.learning.precision import choose_bf16

FEW_STEPS = 20
DiffusionModel = MDM | PublishedMDM


def check_config(config: SynthesizeConfig, fitted: bool) -> SynthesizeConfig:
    """The configuration with the number of processes that its model wants; without reading weights of a published-type model.

    Args:
        fitted: whether a fitted scene is given too.

    Raises:
        UsageError: a setting that does not apply to this kind of model. InputError: no such model.
    """
    published = published_files.is_published(config.model)
    (PublishedMDM if published else MDM).check_request(request_of(config))
    if published and fitted:
        raise UsageError("a published-type model does not use a fitted scene", where="--fitted", remedy="leave it out")
    if published:
        return replace(config, processes=config.processes or 1)  # one copy of a large model in memory
    if config.memory_budget_gb:
        raise UsageError(
            "a memory budget applies to published-type models only", where="--memory-budget-gb", remedy="leave it out"
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
        guidance_rescale=config.guidance_rescale, n_samples=config.samples, align=config.align_depth, bf16=bf16,
    )  # fmt: skip


def load_any(config: SynthesizeConfig) -> DiffusionModel:
    """The model of a configuration.

    A published-type model goes to the GPU if there is one, in bfloat16 where `precision` says so, with its work cut to fit
    `memory_budget_gb`.

    Raises:
        ResourceError: it does not fit however it is cut.
    """
    if not published_files.is_published(config.model):
        return mdm_files.load(config.model)
    if config.steps < FEW_STEPS:
        log.warn(
            f"synthesize: the published model was trained for 50 denoising steps, but --steps is {config.steps} (recommended: --steps 50)"
        )
    on_gpu = torch.cuda.is_available()
    bf16 = (config.precision != "float32") if on_gpu else choose_bf16(config.precision)
    device, dtype = ("cuda", torch.bfloat16 if bf16 else None) if on_gpu else ("cpu", None)
    model = published_files.load(Path(config.model), device, dtype)
    model.split = WorkSplit(frames_at_once=1)
    if config.memory_budget_gb:
        model.split = _choose_split(model, config.memory_budget_gb, 2 if bf16 else 4, guided=config.guidance != 1)
    return model


def _choose_split(model: PublishedMDM, budget_gb: float, bytes_per_value: int, guided: bool) -> WorkSplit:
    """How the model's work is cut to fit a memory budget in GB."""
    split, peak_bytes = memory_plan.choose(
        memory_plan.needs_of(model.config, bytes_per_value), int(budget_gb * 1e9), guidance=guided
    )
    if peak_bytes > budget_gb * 1e9:
        raise ResourceError(
            "the model does not fit into the memory budget, however its work is split", where="--memory-budget-gb",
            expected=f">= {peak_bytes / 1e9:.1f} GB", got=f"{budget_gb} GB", remedy="use the 320x512 model, or bfloat16",
        )  # fmt: skip
    log.info(
        f"synthesize: modalities {'together' if split.modalities_together else 'one by one'}, guidance "
        f"{'together' if split.guidance_together else 'in two passes'}, {split.frames_at_once} frames per decoding, "
        f"about {peak_bytes / 1e9:.1f} GB at most"
    )
    return split
