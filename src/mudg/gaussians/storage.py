"""A fitted scene on disk: the model and what was learnt about cameras and colours."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import TypeAdapter

from mudg.base import palette, store
from mudg.base.errors import InputError, ResourceError, UsageError
from mudg.base.records import understood
from mudg.base.run_folder import run_state
from mudg.base.types import Camera, Scene, View
from mudg.core.table import Table
from mudg.gaussians.corrections import Appearance
from mudg.gaussians.model import CERTAINTY, SceneModel
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.rendering import DRAWING, drawing_facts, raster_of, render_view
from mudg.gaussians.settings import DrawingConfig, FitConfig
from mudg.networks.folders import read_settings

GAUSSIANS, RADIANCE = "gaussians", "radiance"


def _write(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    """Without optimiser moments."""
    store.write_safetensors(path, {key: value for key, value in tensors.items() if "moment" not in key})


def save_model(model: SceneModel, folder: Path) -> None:
    """The fitted scene without optimiser moments."""
    values, groups = model.state()
    store.write_json(folder / "model.json", {"schema": 1, **values})
    for name, tensors in groups.items():
        _write(folder / f"{name}.safetensors", tensors)


def save_appearance(appearance: Appearance, folder: Path) -> None:
    """What was learnt about cameras and images, for those who want to know; renders do not use it."""
    if appearance:
        names, tensors = appearance.state()
        store.write_json(folder / "appearance.json", {"schema": 1, "names": names})
        _write(folder / "appearance.safetensors", tensors)


def load_appearance(folder: Path) -> Appearance:
    """What ``save_appearance`` wrote; nothing corrected where there is none."""
    if not (folder / "appearance.json").is_file():
        return Appearance({})
    with understood("what a fit learnt about cameras", str(folder / "appearance.json")):
        names = store.read_json(folder / "appearance.json")["names"]
        return Appearance.from_state(names, store.read_tensors(folder / "appearance.safetensors"))


def model_of_scene(folder: Path, scene: Scene) -> SceneModel:
    """Read a scene fitted to `scene`. InputError: it was fitted to another one. As `load_model`."""
    model = load_model(folder)
    if model.facts.get("scene", scene.id) != scene.id:
        what, got = "this scene was fitted to another log", str(model.facts["scene"])
        raise InputError(what, where=str(folder), expected=scene.id, got=got, remedy="give the fit of this scene")
    return model


def kind_of(folder: Path) -> str:
    """What a fit has written to this folder: ``gaussians`` or ``radiance``. InputError: not the folder of a finished
    fit."""
    if not (Path(folder) / "model.json").is_file():
        raise InputError("this folder holds no fitted scene", where=str(folder), expected="a folder made by `mudg fit`")
    return str(description_of(folder).get("kind", GAUSSIANS))


def description_of(folder: Path) -> dict[str, Any]:
    """The JSON object in a fit's ``model.json``. InputError: there is none."""
    return read_settings(Path(folder) / "model.json")


def load_model(folder: Path) -> SceneModel:
    """Read a fitted scene of Gaussians. InputError: not the folder of a finished fit, a radiance field, or of another
    schema. IntegrityError: a file was altered."""
    folder = Path(folder)
    if kind_of(folder) != GAUSSIANS:
        what = "this fit is a radiance field, which has no Gaussians and no objects"
        remedy = "`mudg render` shows it; for everything else fit with --method street_gaussians"
        raise InputError(what, where=str(folder), expected="a scene fitted by a method with Gaussians", remedy=remedy)
    if (folder / store.MANIFEST).is_file():
        store.verify_manifest(folder)
    values = description_of(folder)
    if values.get("schema") != 1:
        what = "unknown schema of a fitted scene"
        raise InputError(what, where=str(folder / "model.json"), expected="1", got=str(values.get("schema")))
    groups = {name: store.read_tensors(folder / f"{name}.safetensors") for name in ("gaussians", "nodes")}
    with understood("a fitted scene", str(folder)):
        model = SceneModel.from_state(values, groups)
        if not (folder / store.MANIFEST).is_file():  # do the parts fit together? draw each object, small
            TypeAdapter(DrawingConfig).validate_python(model.facts.get(DRAWING, {}))
            camera = Camera("trial", 16, 12, 16.0, 16.0, 8.0, 6.0)
            for time_s in {0.0, *(float(node.times_s.mean()) for node in model.nodes if isinstance(node, RigidNode))}:
                with contextlib.suppress(UsageError, ResourceError):  # drawn in a way that this machine lacks
                    render_view(model, View(camera, np.eye(4), time_s), raster_of(model))
        return model


# continued ----------------------------------------------------------------------------------------
#
# Gaussians, sky and corrections of a finished fit are the start of another one, whose steps are the second half of a
# run of twice as many: 500 more steps are the steps 501 to 1000 of a run of 1000. (Going on where a run of all steps
# together would be was measured to learn less from virtual views: the steps are too short by then.)

START_METHOD = "street_gaussians"
NEW_CLASS_LOGIT = -6.0
"""Logit of a class that the finished fit did not know: as unlikely as classes are that a Gaussian has learnt not to
show."""


@dataclass(frozen=True)
class StartFit:
    """A finished fit to go on with: its folder and the digest of its files."""

    folder: Path
    digest: str

    @classmethod
    def of_folder(cls, folder: Path, inputs: Mapping[str, str]) -> StartFit:
        """The finished fit in a folder. ``inputs``: digests of what the new fit reads; scene and fused cloud must be
        those of the finished one. InputError: no finished fit of street_gaussians, or one of another scene or cloud."""
        folder = Path(folder)
        state = _state_of_edited(folder) or _state_of(folder)
        remedy = "give the folder of a finished `mudg fit --method street_gaussians` as --start-from"
        if state.get("verb") != "fit" or state.get("state") != "complete":
            what, got = "this folder holds no finished fit to go on with", "no run of mudg"
            got = f"{state['verb']}, {state['state']}" if state else got
            raise InputError(what, where=str(folder), got=got, remedy=remedy)
        for name, expected in inputs.items():
            found, kind = state.get("inputs", {}).get(name), {"fused": "fused cloud"}.get(name, name)
            if found != expected:
                what, where = f"the finished fit belongs to another {kind}", f"{folder / 'run.json'}, inputs.{name}"
                first = f"fit street_gaussians to this {kind} first"
                raise InputError(what, where=where, expected=expected, got=str(found), remedy=first)
        facts = description_of(folder).get("facts")
        method = facts.get("method") if isinstance(facts, dict) else None
        if method != START_METHOD:
            what, where = "a fit can only go on with one on recorded views", f"{folder / 'model.json'}, facts.method"
            raise InputError(what, where=where, expected=START_METHOD, got=str(method), remedy=remedy)
        return cls(folder, store.digest(folder))


def _state_of(folder: Path) -> dict[str, Any]:
    try:
        return dict(run_state(folder))
    except UsageError:
        return {}


def _state_of_edited(folder: Path) -> dict[str, Any]:
    """The state of a fit that belongs to a finished edited run, RUN/fit/METHOD: its inputs are the run's own scene and
    clouds."""
    run = folder.resolve().parent.parent
    if folder.resolve().parent.name != "fit" or not (run / "scene").is_dir() or not (run / "fuse").is_dir():
        return {}
    state = _state_of(run)
    if state.get("verb") != "edit":
        return {}
    inputs = {"scene": store.digest(run / "scene"), "fused": store.digest(run / "fuse")}
    return {"verb": "fit", "state": state.get("state"), "inputs": inputs}


def begun_at(iterations: int) -> int:
    """Steps of a whole run of ``iterations`` that count as done when a fit goes on with a finished one."""
    return iterations // 2


def whole_run(config: FitConfig) -> FitConfig:
    """Settings of the run whose second half ``config.iterations`` steps are, with virtual views as often as they then
    are used."""
    virtual = replace(config.virtual, probability=config.virtual.continued_probability)
    return replace(config, iterations=2 * config.iterations, virtual=virtual)


def continued_model(start: StartFit, classes: Sequence[int], config: FitConfig) -> SceneModel:
    """The model of a finished fit, on the CPU, with channels for all of ``classes`` (train ids) and no moments.
    UsageError: it was fitted with other degrees of spherical harmonics, or drawn with other settings."""
    model = load_model(start.folder)
    model.table.labels.pop(CERTAINTY, None)
    if model.sh_degree != config.sh_degree:
        what, where = "the finished fit has another degree of spherical harmonics", str(start.folder)
        remedy = f"add --sh-degree {model.sh_degree}"
        raise UsageError(what, where=where, expected=str(config.sh_degree), got=str(model.sh_degree), remedy=remedy)
    drawn, wanted = model.facts.get(DRAWING, {}), drawing_facts(config.drawing).get(DRAWING, {})
    if drawn != wanted:
        what, got = "the finished fit was drawn with other settings", str(wanted or "the usual ones")
        remedy = "give the finished fit's --drawing settings"
        raise UsageError(what, where=str(start.folder), expected=str(drawn or "the usual ones"), got=got, remedy=remedy)
    for node in model.nodes:
        if isinstance(node, RigidNode) and config.poses.learn and not node.learn_pose:
            node.learn_pose = True
            node.settle()
    return with_classes(model, classes)


def with_classes(model: SceneModel, classes: Sequence[int]) -> SceneModel:
    """The model with a channel for each of these train ids, in their order; new ones are unlikely everywhere."""
    if tuple(classes) == model.classes:
        return model
    table, known = model.table, {train_id: channel for channel, train_id in enumerate(model.classes)}
    old = table["semantics"].detach()
    logits = torch.full((len(table), len(classes)), NEW_CLASS_LOGIT if known else 0.0)
    for channel, train_id in enumerate(classes):
        if train_id in known:
            logits[:, channel] = old[:, known[train_id]]
    columns = {name: value.detach() for name, value in table.columns.items()} | {"semantics": logits}
    return replace(model, table=Table(columns, table.labels), classes=tuple(classes), facts=dict(model.facts))


def all_classes(start: StartFit, classes: Sequence[int]) -> tuple[int, ...]:
    """Train ids of the finished fit's classes and of ``classes``, sorted."""
    with understood("a fitted scene", str(start.folder / "model.json")):
        known = list(map(int, description_of(start.folder)["classes"]))
    return tuple(sorted({*classes, *(i for i in known if i < len(palette.CLASSES))}))


def continued_appearance(start: StartFit, fresh: Appearance) -> Appearance:
    """The corrections that a new fit starts from, with those that the finished one learnt about the same images and
    cameras."""
    learnt = load_appearance(start.folder)
    kept = {group: learnt.tables[group] for group, names in fresh.names.items() if learnt.names.get(group) == names}
    return Appearance(fresh.names, {**fresh.tables, **kept})
