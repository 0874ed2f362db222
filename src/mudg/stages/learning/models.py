"""The models that `learn` can train, and what is particular to each.

The loop (draws, layouts, checkpoints, averages) uses three methods that both models have: `loss(clips, part, settings)`,
also as `forward`; `trained_part()`, the modules that change; `temporal_parameters(which)`, those that a later stage may freeze.
All else is a row of `KINDS`. A new kind of model is a class with these methods and a row here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from mudg.base.errors import UsageError
from mudg.models.mdm import files as mdm_files
from mudg.models.mdm.model import MDM
from mudg.models.published.model import PublishedMDM
from mudg.stages.config import LearnConfig
from mudg.stages.learning import published as learn_published
from mudg.stages.learning import score as learn_score

Model = MDM | PublishedMDM


@dataclass(frozen=True)
class ModelKind:
    """How one class of models is saved, and what its clips are.

    save    (model, folder, card, facts)
    card    (model, settings, scores, sentence on the training data) -> text of the model card
    rebuilt (model, weights of its trained part) -> a model with these, ready for use
    drops_reference  the model's own loss leaves references out: clips come with theirs
    points_alone     the condition is the published system's: points, and 0 where nothing was seen
    """

    save: Callable[[Any, Path, str, Mapping[str, Any]], None]
    card: Callable[[Any, LearnConfig, Mapping[str, Any], str], str]
    rebuilt: Callable[[Any, Mapping[str, Tensor]], Any]
    drops_reference: bool = False
    points_alone: bool = False


def mdm_rebuilt(model: MDM, weights: Mapping[str, Tensor]) -> MDM:
    """A copy of a model on the CPU, ready for use, whose trained part has these weights."""
    made = MDM(model.config)
    frozen = {name: value for name, value in model.state_dict().items() if name not in weights}
    made.load_state_dict({**frozen, **weights})
    return made.eval()


KINDS: dict[type[nn.Module], ModelKind] = {
    MDM: ModelKind(mdm_files.save, learn_score.model_card, mdm_rebuilt),
    PublishedMDM: ModelKind(
        learn_published.save, learn_published.card, learn_published.rebuilt, drops_reference=True, points_alone=True
    ),
}


def kind_of(model: nn.Module) -> ModelKind:
    """The row of a model; UsageError if it cannot be trained."""
    if type(model) not in KINDS:
        raise UsageError("this kind of model cannot be trained here", got=type(model).__name__,
                         expected=", ".join(kind.__name__ for kind in KINDS))  # fmt: skip
    return KINDS[type(model)]
