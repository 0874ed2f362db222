"""The parts of what can be edited: a fitted scene by itself, or a folder of ``mudg run`` with its scene, clouds and fits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from mudg.base import store
from mudg.base.errors import InputError

BEST_FIRST: Final = ("mudg_s", "street_gaussians")
"""Fits that ``mudg run`` makes; where one has to speak for all, the first that is there."""


@dataclass(frozen=True, slots=True)
class RunParts:
    """Where the parts of a run lie.

    Args:
        fits: folders of fitted scenes by method, the best one first. scene, fused: None where they are not known.
        whole: a folder of ``mudg run``, not a fit by itself.
    """

    fits: dict[str, Path]
    scene: Path | None
    fused: Path | None
    whole: bool

    @property
    def model(self) -> Path:
        """The best fit."""
        return next(iter(self.fits.values()))


def find_run(folder: Path) -> RunParts:
    """What a folder holds.

    Raises:
        InputError: neither a fit nor a folder of ``mudg run``, or one that is not finished.
    """
    folder = Path(folder)
    if (folder / "model.json").is_file():
        return RunParts({"": folder}, None, None, False)
    fits = {name: folder / "fit" / name for name in BEST_FIRST if (folder / "fit" / name / "model.json").is_file()}
    scene, fused = _scene_of(folder), folder / "fuse"
    if not fits or scene is None or not (fused / "fuse.json").is_file():
        there = {"fit": bool(fits), "scene": scene is not None, "fuse": (fused / "fuse.json").is_file()}
        missing = [name for name, found in there.items() if not found]
        raise InputError("this folder holds no fitted scene", where=str(folder),
            expected="a folder made by `mudg fit`, or by a finished `mudg run` or `mudg demo`",
            got=f"no {', no '.join(missing)}" if folder.is_dir() else "no such folder")  # fmt: skip
    return RunParts(fits, scene, fused, True)


def _scene_of(folder: Path) -> Path | None:
    """The scene that a run worked on: labelled by it, made by it, or given to it."""
    for name in ("annotate", "scene"):
        if (folder / name / "scene.json").is_file():
            return folder / name
    try:
        source = Path(store.read_json(folder / "run.json")["asked"]["source"])
    except (InputError, KeyError, TypeError):
        return None
    return source if (source / "scene.json").is_file() or source.suffix == ".zip" else None
