"""What `learn` asks of a model, and the table of the models it can train.

The loop itself (draws, layouts, checkpoints, averages) knows nothing of a model but this: `loss` gives the loss of some
clips of a batch, `trained_part` names the modules that change, `temporal_parameters` those that a later stage may freeze.
A new kind of model is a class with these methods and a row in `KINDS`. The published-type one is in `learn_published`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import seeds
from mudg.base.errors import UsageError
from mudg.models.mdm import files as mdm_files
from mudg.models.mdm.codec import semantic_shares
from mudg.models.mdm.model import MDM, Losses
from mudg.models.published.model import PublishedMDM
from mudg.stages.config import LearnConfig
from mudg.stages.learning import published as learn_published
from mudg.stages.learning import score as learn_score
from mudg.stages.learning.published import Objective, Part

Model = MDM | PublishedMDM


class Trainable(Protocol):
    """The methods of a model that the training loop uses; `MDM` and `PublishedMDM` have them."""

    def trained_part(self) -> nn.ModuleDict:
        """The modules that training changes, by the names of the attributes that hold them."""
        ...

    def temporal_parameters(self, which: Literal["transformers", "all"]) -> set[str]:
        """Names in `trained_part` of the parameters that mix frames."""
        ...

    def loss(self, truth: Any, encoded: Any, generator: torch.Generator, *, first: int, whole: int) -> Losses:
        """Loss of clips `first` and following of a batch of `whole` clips.

        The generator is in the same state for every part of the batch. Draws are made for the whole batch, or for each clip
        from a seed of its own, and the loss is a mean over clips: then it does not matter how the batch is divided. The
        terms have the same names for every part.
        """
        ...


@dataclass(frozen=True)
class Kind:
    """How one class of models is trained and saved.

    loss    (objective, model, settings, part, class weights f32[19]) -> losses; encodes the clips and calls `objective`, which
            stands for `model.loss`
    save    (model, folder, card, facts)
    card    (model, settings, scores, words on the training data) -> text of the model card
    rebuilt (model, weights of its trained part) -> a model with these, ready for use
    drops_reference  the model's own loss leaves references out: clips come with theirs
    points_alone     the condition is the published system's: points, and 0 where nothing was seen
    """

    loss: Callable[[Objective, Any, LearnConfig, Part, Tensor], Losses]
    save: Callable[[Any, Path, str, Mapping[str, Any]], None]
    card: Callable[[Any, LearnConfig, Mapping[str, Any], str], str]
    rebuilt: Callable[[Any, Mapping[str, Tensor]], Any]
    drops_reference: bool = False
    points_alone: bool = False


def mdm_loss(objective: Objective, model: MDM, config: LearnConfig, part: Part, weights: Tensor) -> Losses:
    """Loss of the small model: denoiser on whole frames, refiner on a rectangle of them."""
    batch, known = part.batch, part.batch.depth_known
    with torch.no_grad():
        truth = model.encode_truth(batch.rgb, batch.depth, batch.semantics)
        encoded = model.encode_planes(batch.color, batch.sparse_depth, batch.valid, batch.warped, batch.backdrop,
                                      batch.reference, batch.ids, batch.backdrop_ids)  # fmt: skip
        cells = functional.avg_pool2d(known.float().flatten(0, 1), model.codec.factor).unflatten(0, known.shape[:2])
        pixels = model.pixel_truth(batch.rgb, batch.depth, batch.semantics, known)
        shares = semantic_shares(batch.semantics)
    return objective(
        truth, encoded, seeds.torch_generator(config.seed, part.step, "noise"), shares=shares, class_weights=weights,
        depth_known=cells, pixels=pixels, window=refined_window(config, model, part.step), first=part.first,
        whole=part.count,
    )  # fmt: skip


def refined_window(config: LearnConfig, model: MDM, step: int) -> tuple[slice, slice]:
    """Rectangle of latent cells on which the refiner is trained at `step`: a share of each side, anywhere."""
    rng = seeds.numpy_rng(config.seed, step, "refined window")
    spans = []
    for side in (config.height, config.width):
        cells = side // model.codec.factor
        size = min(cells, max(8, round(cells * config.refined_share / 8) * 8))
        start = 2 * int(rng.integers((cells - size) // 2 + 1))
        spans.append(slice(start, start + size))
    return spans[0], spans[1]


def mdm_rebuilt(model: MDM, weights: Mapping[str, Tensor]) -> MDM:
    """A copy of a model on the CPU, ready for use, whose trained part has these weights."""
    made = MDM(model.config)
    frozen = {name: value for name, value in model.state_dict().items() if name not in weights}
    made.load_state_dict({**frozen, **weights})
    return made.eval()


KINDS: dict[type[nn.Module], Kind] = {
    MDM: Kind(mdm_loss, mdm_files.save, learn_score.model_card, mdm_rebuilt),
    PublishedMDM: Kind(
        learn_published.loss, learn_published.save, learn_published.card, learn_published.rebuilt, drops_reference=True,
        points_alone=True,
    ),
}  # fmt: skip


def kind_of(model: nn.Module) -> Kind:
    """The row of a model; UsageError if it cannot be trained."""
    if type(model) not in KINDS:
        raise UsageError("this kind of model cannot be trained here", got=type(model).__name__,
                         expected=", ".join(kind.__name__ for kind in KINDS))  # fmt: skip
    return KINDS[type(model)]
