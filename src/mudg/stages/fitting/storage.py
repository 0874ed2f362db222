"""A fitted scene on disk: the model and what was learnt about cameras and colours."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from mudg.base import store
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.records import understood
from mudg.base.types import Camera, Scene, View
from mudg.models.folders import read_settings
from mudg.models.scene.appearance import Appearance
from mudg.models.scene.model import SceneModel
from mudg.models.scene.nodes import RigidNode
from mudg.stages.config.fit import DrawingConfig
from mudg.stages.fitting.rendering import DRAWING, raster_of, render_view

GAUSSIANS, RADIANCE = "gaussians", "radiance"


def save_model(model: SceneModel, folder: Path) -> None:
    """The fitted scene without optimiser moments."""
    values, groups = model.state()
    store.write_json(folder / "model.json", {"schema": 1, **values})
    for name, tensors in groups.items():
        kept = {key: value for key, value in tensors.items() if "moment" not in key}
        store.write_safetensors(folder / f"{name}.safetensors", kept)


def save_appearance(appearance: Appearance, folder: Path) -> None:
    """What was learnt about cameras, images and virtual sets, for those who want to know; renders do not use it."""
    if appearance:
        names, tensors = appearance.state()
        store.write_json(folder / "appearance.json", {"schema": 1, "names": names})
        store.write_safetensors(
            folder / "appearance.safetensors", {k: v for k, v in tensors.items() if "moment" not in k}
        )


def load_appearance(folder: Path) -> Appearance:
    """What ``save_appearance`` wrote; nothing corrected where there is none."""
    if not (folder / "appearance.json").is_file():
        return Appearance({})
    with understood("what a fit learnt about cameras", str(folder / "appearance.json")):
        names = store.read_json(folder / "appearance.json")["names"]
        return Appearance.from_state(names, store.read_tensors(folder / "appearance.safetensors"))


def model_of_scene(folder: Path, scene: Scene) -> SceneModel:
    """Read a scene fitted to `scene`.

    Raises:
        InputError: it was fitted to another one. As `load_model`.
    """
    model = load_model(folder)
    if model.facts.get("scene", scene.id) != scene.id:
        raise InputError("this scene was fitted to another log", where=str(folder), expected=scene.id, got=str(model.facts["scene"]),
                         remedy="give the fit of this scene")  # fmt: skip
    return model


def kind_of(folder: Path) -> str:
    """What a fit has written to this folder: ``gaussians`` or ``radiance``.

    Raises:
        InputError: not the folder of a finished fit.
    """
    if not (Path(folder) / "model.json").is_file():
        raise InputError("this folder holds no fitted scene", where=str(folder), expected="a folder made by `mudg fit`")
    return str(description_of(folder).get("kind", GAUSSIANS))


def description_of(folder: Path) -> dict[str, Any]:
    """The JSON object in a fit's ``model.json``. InputError: there is none."""
    return read_settings(Path(folder) / "model.json")


def load_model(folder: Path) -> SceneModel:
    """Read a fitted scene of Gaussians.

    Raises:
        InputError: not the folder of a finished fit, a radiance field, or of another schema. IntegrityError: a file was altered.
    """
    folder = Path(folder)
    if kind_of(folder) != GAUSSIANS:
        raise InputError("this fit is a radiance field, which has no Gaussians and no objects", where=str(folder),
                         expected="a scene fitted by a method with Gaussians",
                         remedy="`mudg render` shows it; for everything else fit with --method street_gaussians")  # fmt: skip
    if (folder / store.MANIFEST).is_file():
        store.verify_manifest(folder)
    values = description_of(folder)
    if values.get("schema") != 1:
        raise InputError(
            "unknown schema of a fitted scene",
            where=str(folder / "model.json"),
            expected="1",
            got=str(values.get("schema")),
        )
    groups = {name: store.read_tensors(folder / f"{name}.safetensors") for name in ("gaussians", "nodes")}
    with understood("a fitted scene", str(folder)):
        model = SceneModel.from_state(values, groups)
        if not (folder / store.MANIFEST).is_file():
            _try_out(model)
        return model


def _try_out(model: SceneModel) -> None:
    """Fail where the parts of a scene that no manifest vouches for do not fit together: draw a small picture while each object is there."""
    TypeAdapter(DrawingConfig).validate_python(model.facts.get(DRAWING, {}))
    camera = Camera("trial", 16, 12, 16.0, 16.0, 8.0, 6.0)
    for time_s in {0.0, *(float(node.times_s.mean()) for node in model.nodes if isinstance(node, RigidNode))}:
        with contextlib.suppress(UsageError, ResourceError):  # drawn in a way that this machine lacks
            render_view(model, View(camera, np.eye(4), time_s), raster_of(model))
