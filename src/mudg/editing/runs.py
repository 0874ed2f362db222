"""The parts of a run: a fitted scene by itself, or a folder of ``mudg run`` with its scene, clouds and fits. Wherever a
command takes one of them, it also takes the folder of the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mudg.base import store
from mudg.base.errors import InputError, UsageError, similar_path
from mudg.base.run_folder import known_input

BEST_FIRST: Final = ("mudg_s", "street_gaussians")
"""Fits that ``mudg run`` makes; where one has to speak for all, the first that is there."""
NO_FIT: Final = "this folder holds no fitted scene"


@dataclass(frozen=True, slots=True)
class RunParts:
    """Where the parts of a run lie. ``fits``: folders of fitted scenes by method, the best one first. ``scene``,
    ``fused``: None where they are not known. ``whole``: a folder of ``mudg run``, not a fit by itself."""

    fits: dict[str, Path]
    scene: Path | None
    fused: Path | None
    whole: bool

    @property
    def model(self) -> Path:
        """The best fit."""
        return next(iter(self.fits.values()))


def find_run(folder: Path, scene: Path | None = None, fused: Path | None = None) -> RunParts:
    """What a folder holds. ``scene``, ``fused``: count in place of its own. InputError: neither a fit nor a folder of
    ``mudg run``, or one that is not finished."""
    folder = Path(folder)
    if (folder / "model.json").is_file():
        return RunParts({"": folder}, scene or known_input(folder, "scene"), fused, False)
    fits = {name: folder / "fit" / name for name in BEST_FIRST if (folder / "fit" / name / "model.json").is_file()}
    own_scene, own_fused = scene_of_run(folder), folder / "fuse"
    there = {"fit": bool(fits), "scene": own_scene is not None, "fuse": (own_fused / "fuse.json").is_file()}
    if not all(there.values()):
        missing = [name for name, found in there.items() if not found]
        expected = "a folder made by `mudg fit`, or by a finished `mudg run` or `mudg demo`"
        got = f"no {', no '.join(missing)}" if folder.is_dir() else "no such folder"
        raise InputError(NO_FIT, where=str(folder), expected=expected, got=got, remedy=similar_path(folder))
    return RunParts(fits, scene or own_scene, fused or own_fused, True)


def scene_of_run(folder: Path) -> Path | None:
    """The scene that a run worked on: labelled by it, made by it, or given to it; or the one that a fit belongs to."""
    if (folder / "model.json").is_file():
        return known_input(folder, "scene")
    for name in ("annotate", "scene"):
        if (folder / name / "scene.json").is_file():
            return folder / name
    try:
        source = Path(store.read_json(folder / "run.json")["asked"]["source"])
    except (InputError, KeyError, TypeError):
        return None
    return source if (source / "scene.json").is_file() else None


# where a part is asked for, and a run given -------------------------------------------------------


def scene_at(path: Path) -> Path:
    """The scene at a path: itself, or that of a run. InputError: nothing is there, or something else."""
    if (path / "scene.json").is_file() or path.is_file():
        return path
    found = scene_of_run(path)
    if found is None:
        what = "folder is not a scene: it has no scene.json" if path.is_dir() else "no such file or folder"
        expected = "a scene made by `mudg ingest` or `mudg annotate`, or a folder made by `mudg run`"
        raise InputError(what, where=str(path), expected=expected, remedy=similar_path(path))
    return found


def fused_at(path: Path) -> Path:
    """The fused clouds at a path: itself, or those of a run or a fit; InputError otherwise."""
    for folder in (path, path / "fuse", known_input(path, "fused") or path):
        if (folder / "fuse.json").is_file():
            return folder
    where, expected = str(path / "fuse.json"), "a folder made by `mudg fuse`, or by `mudg run`"
    raise InputError("file not found", where=where, expected=expected, remedy=similar_path(path))


def fit_at(path: Path, order: Sequence[str] = BEST_FIRST) -> Path:
    """The fitted scene at a path: itself, or the first of ``order`` that a run has; InputError otherwise."""
    for folder in (path, *(path / "fit" / name for name in order)):
        if (folder / "model.json").is_file():
            return folder
    expected, got = "a folder made by `mudg fit`, or by `mudg run`", "" if path.is_dir() else "no such folder"
    raise InputError(NO_FIT, where=str(path), expected=expected, got=got, remedy=similar_path(path))


def plain_fit_at(path: Path) -> Path:
    """``fit_at``, of a run the fit without virtual views."""
    return fit_at(path, BEST_FIRST[::-1])


def views_at(path: Path, name: str = "") -> Path:
    """The views at a path: itself, or of a run those that it rendered with a method, or without one those that it
    generated."""
    folders = (path / "render" / name, path / "synthesize") if name else (path / "synthesize",)
    is_run = (path / "synthesize").is_dir() and scene_of_run(path) is not None
    return next((folder for folder in folders if is_run and folder.is_dir()), path)


PARTS: Final = {
    "scene": scene_at,
    "fused": fused_at,
    "model": fit_at,
    **dict.fromkeys(("fitted", "start_from"), plain_fit_at),
}
"""Inputs of commands, and how each is found at a path."""


def parts_of(given: Mapping[str, Any], required: Sequence[str] = ()) -> dict[str, Any]:
    """The inputs of a command, each as the part that it stands for; before anything heavy is loaded. ``given``: name ->
    path, or None; names that are not in ``PARTS`` are left as they are. ``required``: those that a run at ``scene``
    gives where they are None. UsageError: one is missing. InputError: one is not there, or something else."""
    scene = given.get("scene")
    is_run = scene is not None and not (Path(scene) / "scene.json").is_file() and scene_of_run(Path(scene)) is not None
    found = dict(given)
    for name, path in given.items():
        if path is None and name in required:
            if not is_run:
                made = "point clouds made by `mudg fuse`" if name == "fused" else "a folder made by `mudg fit`"
                expected = f"{made}, or the folder of a run in the place of SCENE"
                raise UsageError(f"no --{name} was given", expected=expected)
            path = scene
        if path is not None and name in PARTS:
            found[name] = PARTS[name](Path(path))
    return found
