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

from mudg.base import html
from mudg.base.errors import UsageError
from mudg.diffusion.published import model as published_files
from mudg.diffusion.published.model import PublishedMDM, WorkSplit
from mudg.diffusion.settings.learn import LearnConfig
from mudg.diffusion.training import score as learn_score


def starting_model(config: LearnConfig) -> PublishedMDM:
    """The model of `config.start` in float32, to be trained at the configured size; nothing of it is drawn anew.

    Raises:
        UsageError: clips of another length than the image tokens are made for, or of a size that does not fit the
            strides; a setting that does not apply to this model.
    """
    model = published_files.load(Path(config.start), dtype=torch.float32)
    frames = model.config.window
    if config.data.window != frames or config.optimizer.full_window_share < 1:
        raise UsageError(
            "a published-type model needs clips of exactly the length of its image tokens",
            where="--data.window, --optimizer.full-window-share",
            expected=f"{frames} frames in all steps",
            got=f"{config.data.window} frames in {config.optimizer.full_window_share:.0%} of the steps",
            remedy=f"--data.window {frames} --optimizer.full-window-share 1",
        )
    model.check_size(config.data.height, config.data.width)
    with torch.no_grad():  # out of the mapped files: training writes in place
        for value in (*model.parameters(), *model.buffers()):
            value.data = value.data.clone()
    model.config = replace(model.config, width=config.data.width, height=config.data.height)
    model.split = WorkSplit(frames_at_once=1)
    return model


def rebuilt(model: PublishedMDM, weights: Mapping[str, Tensor]) -> PublishedMDM:
    """The model where it was trained, ready for use, with these weights in its trained part. Shares memory with what it
    is made of: it is large, and scoring it on a CPU would take longer than training it on a GPU."""
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
    return html.render_text(
        "published_card.md.j2",
        data=data,
        window=model.config.window,
        config=config,
        clips=config.data,
        rules=config.optimizer,
        scores=scores,
        table=learn_score.table(scores),
    )
