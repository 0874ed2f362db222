"""Training the published-type model with `learn`: where it starts, and the folder it is written to.

Everything else (clips, layouts, checkpoints, averages) is as for the small model. What differs is listed in its row of
`models.KINDS`: clips show points alone, as the published network was trained, and the reference image is left out by
the model's own loss.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mudg.base.errors import UsageError
from mudg.models.published import files as published_files
from mudg.models.published.model import PublishedMDM, WorkSplit
from mudg.stages.config import LearnConfig
from mudg.stages.learning import score as learn_score


def starting(config: LearnConfig) -> PublishedMDM:
    """The model of `config.start` in float32, to be trained at the configured size; nothing of it is drawn anew.

    Raises:
        UsageError: clips of another length than the image tokens are made for, or of a size that does not fit the strides; a
            setting that does not apply to this model.
    """
    model = published_files.load(Path(config.start), dtype=torch.float32)
    frames = model.config.window
    if config.window != frames or config.full_window_share < 1:
        raise UsageError(
            "a published-type model is trained on clips of exactly the length that its image tokens are made for",
            where="--window, --full-window-share", expected=f"{frames} frames in all steps",
            got=f"{config.window} frames in {config.full_window_share:.0%} of the steps",
            remedy=f"--window {frames} --full-window-share 1",
        )  # fmt: skip
    model.check_size(config.height, config.width)
    if config.cache_latents and model.config.codec.posterior == "sample":
        raise UsageError("latents of this model are drawn anew at every step, so they cannot be kept",
                         where="--cache-latents", remedy="leave the flag out")  # fmt: skip
    with torch.no_grad():  # out of the mapped files: training writes in place
        for value in (*model.parameters(), *model.buffers()):
            value.data = value.data.clone()
    model.config = replace(model.config, width=config.width, height=config.height)
    model.split = WorkSplit(frames_at_once=1)
    return model


def rebuilt(model: PublishedMDM, weights: Mapping[str, Tensor]) -> PublishedMDM:
    """The model where it was trained, ready for use, with these weights in its trained part. Shares memory with what it is
    made of: it is large, and scoring it on a CPU would take longer than training it on a GPU."""
    with torch.device("meta"):
        made = PublishedMDM(model.config)
    fixed = {name: value for name, value in model.state_dict().items() if name not in weights}
    trained = {name: value.to(model.device) for name, value in weights.items()}
    made.load_state_dict({**fixed, **trained}, assign=True)
    made.requires_grad_(False)
    made.adopt_scale()
    made.split = model.split
    return made.eval()


def save(model: PublishedMDM, folder: Path, text: str, facts: Mapping[str, Any]) -> None:
    """Write the folder that `synthesize --model` and a further `learn --start` read; weights in float32.

    The terms of the model that was continued from are handed on.
    """
    before = facts.get("continued_from", {})
    handed_on = {name: before[name] for name in ("licence", "caption", "base_scale") if name in before}
    licence = f"\n## Licence\n\n{handed_on['licence']}\n" if "licence" in handed_on else ""
    tensors = {name: value.cpu() for name, value in model.state_dict().items()}
    published_files.save(folder, model.config, tensors, {**facts, **handed_on}, text + licence)


def card(model: PublishedMDM, config: LearnConfig, scores: Mapping[str, Any], data: str = "") -> str:
    """Text of the model card; `data` says what it was trained on (empty = generated cities)."""
    data = data or (
        f"generated cities (numbers 0 to {config.cities - 1} of run seed {config.seed}), {config.clips_per_city} clips of\n"
        f"{config.window} frames each, most of them beside the recorded path."
    )
    frozen = "all layers" if config.frozen == "nothing" else f"all layers but the {config.frozen.replace('_', ' ')}"
    return f"""# Published-type multi-modal diffusion model, trained further

Continued from {config.start}, which has training data of its own. {model.config.window} frames at
{config.width}x{config.height} pixels.

**Training data**: {data}

**Recipe**: `mudg learn` with the configuration stored in `model.json` under `facts.recipe`: {config.steps} steps of
{config.batch_frames // config.window} clips, {frozen} of the denoising network and the image-token resampler, AdamW, rate
{config.lr:g}, moving average {config.average_decay}, v prediction, reference left out in {config.reference_dropout:.0%} of the clips.

**Held-out score** ({scores["clips"]} clips, {scores["steps"]} denoising steps):

```
{learn_score.table(scores)}
```
"""
