"""A fitted radiance field on disk: ``model.json`` of kind radiance, and ``field.safetensors``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.records import understood
from mudg.models.radiance.field import RadianceField
from mudg.models.radiance.march import Budget
from mudg.stages.fitting.storage import RADIANCE, description_of, kind_of


def save_field(field: RadianceField, budget: Budget, folder: Path) -> None:
    """Field and sampling, without optimiser moments."""
    store.write_json(
        folder / "model.json", {"schema": 1, "kind": RADIANCE, **field.description(), "budget": asdict(budget)}
    )
    store.write_safetensors(
        folder / "field.safetensors", {name: value.cpu() for name, value in field.state_dict().items()}
    )


def load_field(folder: Path) -> tuple[RadianceField, Budget]:
    """Inverse of ``save_field``.

    Raises:
        InputError: not the folder of a finished fit of a radiance field. IntegrityError: a file was altered.
    """
    folder = Path(folder)
    if kind_of(folder) != RADIANCE:
        raise InputError(
            "this folder holds no radiance field", where=str(folder), expected="made by `mudg fit --method emernerf`"
        )
    if (folder / store.MANIFEST).is_file():
        store.verify_manifest(folder)
    values, tensors = description_of(folder), store.read_tensors(folder / "field.safetensors")
    with understood("a radiance field", str(folder)):
        budget = Budget(**{**values["budget"], "proposals": tuple(values["budget"]["proposals"])})
        return RadianceField.from_state(values, tensors), budget
