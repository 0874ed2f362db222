"""A fitted scene on disk: the model and what was learnt about cameras and colours."""

from __future__ import annotations

from pathlib import Path

from mudg.base import store
from mudg.base.errors import InputError
from mudg.base.types import Scene
from mudg.models.scene.appearance import Appearance
from mudg.models.scene.model import SceneModel

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
    return str(store.read_json(Path(folder) / "model.json").get("kind", GAUSSIANS))


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
    values = store.read_json(folder / "model.json")
    if values.get("schema") != 1:
        raise InputError(
            "unknown schema of a fitted scene",
            where=str(folder / "model.json"),
            expected="1",
            got=str(values.get("schema")),
        )
    groups = {name: store.read_tensors(folder / f"{name}.safetensors") for name in ("gaussians", "nodes")}
    return SceneModel.from_state(values, groups)
