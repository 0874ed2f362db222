"""Folders of models whose files are damaged and that no manifest vouches for: an error in words, or a scene that can be
drawn."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_radiance import tiny_field
from toy_fitted import toy_fitted
from toy_published import write_tiny
from toy_scene import EGO_FROM_CAM

from mudg.base import store
from mudg.base.errors import MudgError
from mudg.base.types import Camera
from mudg.baselines.emernerf import Budget, load_field, save_field
from mudg.core.table import Table
from mudg.diffusion import model_files
from mudg.gaussians.corrections import COLOR, Appearance
from mudg.gaussians.storage import StartFit, all_classes, kind_of, load_appearance, save_appearance, save_model
from mudg.labels import street_net
from mudg.steps.fitted import FittedScene

CAMERA = Camera("front", 24, 16, 20.0, 20.0, 12.0, 8.0)
VALUES: list[Any] = [None, "x", -1, 10**30, 1e300, True, [], [1], [[1, "x"]], {}, {"x": 1}]


def altered(value: Any) -> Iterator[Any]:
    """A JSON value with each part of it, at every depth, missing or something else."""
    yield from VALUES
    if isinstance(value, dict):
        for name, part in value.items():
            yield {key: kept for key, kept in value.items() if key != name}
            yield from ({**value, name: other} for other in altered(part))
    elif isinstance(value, list):
        for place, part in enumerate(value[:2]):
            before, after = value[:place], value[place + 1 :]
            yield before + after
            yield from ([*before, other, *after] for other in altered(part))


def altered_tensors(tensors: dict[str, np.ndarray]) -> Iterator[dict[str, np.ndarray]]:
    """Tensors with each of them missing, of another shape, type or content."""
    for name, value in tensors.items():
        yield {key: kept for key, kept in tensors.items() if key != name}
        others = [value[:0], value[:-1], np.concatenate([value, value]), value[..., None], value.reshape(-1)]
        wrong = np.full_like(value, np.nan if value.dtype.kind == "f" else 100)
        for other in (*others, np.zeros((), value.dtype), value.astype(np.int64), wrong):
            yield {**tensors, name: np.ascontiguousarray(other)}
    yield {"x": np.zeros(1)}
    yield {**tensors, "gone.x": np.zeros(1), "7/offsets.column.shift": np.zeros(1)}


def ends_in_words(call: Callable[[], object]) -> bool:
    try:
        call()
    except MudgError:
        return True
    return False


def render(folder: Path) -> None:
    scene = FittedScene.read(folder, "cpu")
    for time_s in (0.0, 0.4):
        scene.render(CAMERA, EGO_FROM_CAM, time_s)


@pytest.fixture
def fit(tmp_path: Path) -> Path:
    save_model(toy_fitted(1), tmp_path / "fit")
    render(tmp_path / "fit")
    return tmp_path / "fit"


every_nth = pytest.mark.parametrize("nth", [11, pytest.param(1, marks=pytest.mark.slow)])


@every_nth
def test_a_damaged_description_of_a_fitted_scene_ends_in_words(nth: int, fit: Path) -> None:
    whole, refused = store.read_json(fit / "model.json"), 0
    for value in itertools.islice(altered(whole), 0, None, nth):
        (fit / "model.json").write_text(json.dumps(value))
        refused += ends_in_words(lambda: render(fit))
        ends_in_words(lambda: kind_of(fit))
        ends_in_words(lambda: all_classes(StartFit(fit, ""), (1,)))
    assert nth * refused > 100


@every_nth
@pytest.mark.parametrize("name", ["gaussians", "nodes"])
def test_damaged_tensors_of_a_fitted_scene_end_in_words(name: str, nth: int, fit: Path) -> None:
    file = fit / f"{name}.safetensors"
    whole, refused = store.read_safetensors(file), 0
    for tensors in itertools.islice(altered_tensors(whole), 0, None, nth):
        store.write_safetensors(file, tensors)
        refused += ends_in_words(lambda: render(fit))
    assert nth * refused > 20


def saved_appearance(folder: Path) -> Path:
    made = Appearance({COLOR: ("front", "left")}, {COLOR: Table({"gain": torch.zeros(2, 3)})})
    save_appearance(made, folder)
    load_appearance(folder)
    return folder / "appearance.json"


def saved_field(folder: Path) -> Path:
    save_field(tiny_field(), Budget((16, 12), 8, 0.1, 1000.0), folder)
    load_field(folder)
    return folder / "model.json"


def copied(source: Path, folder: Path) -> Path:
    shutil.copytree(source, folder, dirs_exist_ok=True)
    return folder / "model.json"


def read_all_of(folder: Path) -> None:
    for read in (model_files.facts, model_files.uses_renders, model_files.is_published):
        ends_in_words(lambda read=read: read(folder))


READERS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], object]]] = {
    "appearance": (saved_appearance, load_appearance),
    "radiance field": (saved_field, load_field),
    "diffusion model": (lambda folder: copied(model_files.EMBEDDED["embedded-tiny"], folder), model_files.load),
    "diffusion model's facts": (lambda folder: copied(model_files.EMBEDDED["embedded-tiny"], folder), read_all_of),
    "published model": (lambda folder: copied(write_tiny(folder), folder), model_files.load_published),
    "segmenter": (lambda folder: copied(street_net.EMBEDDED, folder), street_net.load),
}


@pytest.mark.parametrize("most", [16, pytest.param(80, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", READERS)
def test_damaged_descriptions_of_models_end_in_words(kind: str, most: int, tmp_path: Path) -> None:
    save, load = READERS[kind]
    file = save(tmp_path)
    whole = json.loads(file.read_text())
    known = {name: value for name, value in whole.items() if name != "facts"}
    cases = [*({**whole, "facts": value} for value in VALUES), *altered(known)]
    for value in cases[:: max(1, len(cases) // most)]:
        file.write_text(json.dumps(value))
        ends_in_words(lambda: load(tmp_path))
    for content in (b"", b"\xff", b"[" * 100_000, b'{"schema": 1, "schema": 1}', b"NaN"):
        file.write_bytes(content)
        assert ends_in_words(lambda: load(tmp_path)) or kind == "diffusion model's facts"
