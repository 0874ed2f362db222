"""``mudg page``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.step import RUN, Flag, Step

if TYPE_CHECKING:
    from mudg.viewer.settings import PageConfig


class Page(Step):
    """Write a fitted scene as one HTML page: fly through it, any layer, any time, without a network."""

    section = "look at a drive"
    result = "page"
    examples = (
        "mudg page runs/kitti --out kitti.html",
        "mudg page runs/kitti --compare runs/kitti --out both.html",
        "mudg page runs/mudg_s --scene scenes/city --out city.html",
    )
    source: Annotated[Path, RUN]
    """Folder of a finished mudg run, or Gaussian scene written by fit."""
    out: Annotated[Path, Flag("FILE.html")]
    """Page to write: one file. Above 32 MB, a folder FILE_page beside it, for a web server."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to. A run has its own."""
    compare: Annotated[Path | None, Flag("RUN2")] = None
    """A second run or fit of the same log, to compare with. The same run: its two fits."""
    overwrite: bool = False
    """Replace the page if it exists."""
    settings: PageConfig

    def act(self) -> dict[str, Any]:
        from mudg.viewer import view

        return view.run_page(
            self.settings, self.source, self.out, scene=self.scene, compare=self.compare, overwrite=self.overwrite
        )
