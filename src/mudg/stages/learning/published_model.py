"""Folders that hold a published-type diffusion model: writing, reading, and choosing how `synthesize` runs it.

model.json                kind, configuration, sha256 of the weight files, facts (source, licence, what was adapted)
weights_NN.safetensors    tensors under our names
MODEL_CARD.md
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mudg.base import log, store
from mudg.base.errors import InputError, ResourceError
from mudg.base.types import View
from mudg.data import weights
from mudg.data.clips.condition import Recorded
from mudg.models.mdm import model as mdm
from mudg.models.mdm.model import MDM, Sample
from mudg.models.published import model as published
from mudg.models.published.model import PublishedConfig, PublishedMDM, Sampling
from mudg.stages.config import SynthesizeConfig
from mudg.stages.learning import memory_plan
from mudg.stages.learning.precision import choose_bf16

KIND = "published"
FEW_STEPS = 20


def write(
    folder: Path,
    config: PublishedConfig,
    tensors: Mapping[str, Tensor],
    facts: Mapping[str, Any],
    card: str,
    *,
    dtype: torch.dtype | None = None,
    shard_bytes: int = 1 << 30,
) -> None:
    """Write a model folder under a temporary name and rename it when it is whole.

    tensors   everything `PublishedMDM(config).state_dict()` names
    dtype     number format of the weights (None: as given); the table `scale` stays float32
    """
    with store.atomic_directory(folder) as partial:
        small = {"scale": tensors["scale"].float()}
        files = weights.write_shards(partial, {n: t for n, t in tensors.items() if n != "scale"}, shard_bytes, dtype)
        store.write_safetensors(partial / "scale.safetensors", small)
        files["scale.safetensors"] = store.sha256_file(partial / "scale.safetensors")
        store.write_text(partial / "MODEL_CARD.md", card)
        description = {
            "schema": 1, "kind": KIND, "config": published.config_to_dict(config), "files": files, "facts": dict(facts)
        }  # fmt: skip
        store.write_json(partial / mdm.MODEL_FILE, description)
        store.sync_tree(partial)


def is_published(path: Path | str) -> bool:
    """Whether a folder holds a published-type model (by its description; a missing one is no)."""
    where = mdm.folder_of(path) / mdm.MODEL_FILE
    if not where.is_file():
        return False
    content = store.read_json(where)
    return isinstance(content, dict) and content.get("kind") == KIND


def read(folder: Path, device: str = "cpu", dtype: torch.dtype | None = None, *, verify: bool = True) -> PublishedMDM:
    """Read a model folder; weights are mapped from the files and converted to `dtype` (None: as stored).

    Raises:
        InputError: not such a folder, or its weights do not fit its configuration. IntegrityError: a file was altered.
    """
    where = Path(folder) / mdm.MODEL_FILE
    content = store.read_json(where)
    if not isinstance(content, dict) or content.get("schema") != 1 or content.get("kind") != KIND:
        raise InputError(
            "not a published-type model of this version", where=str(where), expected=f"schema 1, kind {KIND}"
        )
    if not isinstance(content.get("files"), dict):
        raise InputError("the model's description names no files", where=str(where))
    with torch.device("meta"):
        model = PublishedMDM(published.config_from_dict(content.get("config"), str(where)))
    state = weights.read_shards(Path(folder), content["files"], verify=verify)
    wanted = model.state_dict()
    wrong = sorted(set(wanted) ^ set(state)) or [n for n in wanted if wanted[n].shape != state[n].shape]
    if wrong:
        raise InputError("weights do not fit the configuration", where=str(folder), got=", ".join(wrong[:6]))
    model.load_state_dict(state, assign=True)
    model.adopt_scale()
    table = model.scale
    model = model.to(device=device, dtype=dtype).eval()
    model.scale = table.to(device)  # exact in any number format: it is part of the schedule
    return model


def load_any(config: SynthesizeConfig) -> MDM | PublishedMDM:
    """The model that a synthesize configuration names, of whichever kind it is, ready to sample.

    A published-type model goes to the GPU if there is one, in bfloat16 where `precision` says so, with its work cut to fit
    `memory_budget_gb`.
    """
    if not is_published(config.model):
        return mdm.load(config.model)
    if config.steps < FEW_STEPS:
        log.warn(
            f"synthesize: the published model was made for 50 denoising steps, asked for {config.steps} (--steps 50)"
        )
    on_gpu = torch.cuda.is_available()
    bf16 = (config.precision != "float32") if on_gpu else choose_bf16(config.precision)
    model = read(Path(config.model), "cuda" if on_gpu else "cpu", torch.bfloat16 if on_gpu and bf16 else None)
    model.sampling = replace(Sampling(), guidance=config.guidance, rescale=config.guidance_rescale, frames_at_once=1)
    if config.memory_budget_gb:
        model.sampling = fitted(model, config.memory_budget_gb, 2 if bf16 else 4)
    return model


def fitted(model: PublishedMDM, budget_gb: float, bytes_per_value: int) -> Sampling:
    """The model's way of sampling with the work cut to fit a memory budget in GB.

    Raises:
        ResourceError: it does not fit however it is cut.
    """
    needs = memory_plan.needs_of(model.config, bytes_per_value)
    plan = memory_plan.choose(needs, int(budget_gb * 1e9), guidance=model.sampling.guidance != 1)
    if plan.peak_bytes > budget_gb * 1e9:
        raise ResourceError(
            "the model does not fit into the memory budget however its work is cut", where="--memory-budget-gb",
            expected=f">= {plan.peak_bytes / 1e9:.1f} GB", got=f"{budget_gb} GB", remedy="use the 320x512 model, or bfloat16",
        )  # fmt: skip
    log.info(
        f"synthesize: modalities {'together' if plan.modalities_together else 'one by one'}, guidance "
        f"{'together' if plan.guidance_together else 'in two passes'}, {plan.frames_at_once} frames per decoding, "
        f"about {plan.peak_bytes / 1e9:.1f} GB at most"
    )
    return replace(
        model.sampling, modalities_together=plan.modalities_together, guidance_together=plan.guidance_together,
        frames_at_once=plan.frames_at_once,
    )  # fmt: skip


def model_size(config: PublishedConfig, width_px: int) -> tuple[int, int]:
    """Width and height the model works at: its own, or about `width_px` wide in the same aspect."""
    if not width_px:
        return config.width, config.height
    multiple = config.pixel_multiple
    width = max(multiple, round(width_px / multiple) * multiple)
    return width, max(multiple, round(width * config.height / config.width / multiple) * multiple)


def reference_fits(view: View, recorded: Sequence[Recorded]) -> bool:
    """Whether a recorded image was taken where `view` is (to 5 cm and 10 mrad).

    The published model puts the reference, as it was recorded, into frame 0 of a window. On a shifted trajectory that frame is a
    picture from another place, and must not be used as if it were one from there.
    """
    for image in recorded:
        moved = image.view.cam_from_world @ view.world_from_cam
        if np.linalg.norm(moved[:3, 3]) < 0.05 and np.abs(moved[:3, :3] - np.eye(3)).max() < 0.01:
            return True
    return False


def at_camera_size(sample: Sample, depth: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colour (bicubic), depth and classes (nearest) and confidence (bilinear) of a sample at the size of `view`."""
    if sample.rgb is None or sample.semantics is None:
        raise InputError(
            "a sample without colour or classes cannot be enlarged", where="published_model.at_camera_size"
        )
    size = (view.camera.height, view.camera.width)
    rgb = functional.interpolate(sample.rgb, size=size, mode="bicubic", align_corners=False).clamp(0, 1)
    depth = functional.interpolate(depth, size=size, mode="nearest-exact")
    ids = functional.interpolate(sample.semantics.unsqueeze(1).float(), size=size, mode="nearest-exact")[:, 0].long()
    trust = functional.interpolate(sample.confidence, size=size, mode="bilinear", align_corners=False)
    return rgb, depth, ids, trust
