"""``mudg view``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.step import FILE_YAML, RUN, Flag, Step

if TYPE_CHECKING:
    from mudg.viewer.settings import ViewConfig


class ViewScene(Step):
    """Show a fitted scene in a browser, with exact frames from the rasterizer."""

    verb_name = "view"
    section = "look at a drive"
    examples = (
        "mudg view runs/kitti",
        "mudg view runs/a runs/b",
        "mudg view runs/mudg_s --scene scenes/city --port 8080",
    )
    source: Annotated[Path, RUN]
    """Folder of a finished mudg run, or Gaussian scene written by fit."""
    compare: Annotated[Path | None, Flag("[RUN2]", "first")] = None
    """A second run or fit of the same log, to compare with. The same run: its two fits."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to. A run has its own."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) that the page begins with."""
    edits_out: Annotated[Path | None, FILE_YAML] = None
    """Where edits made on the page are saved (without it: edits.yaml beside RUN, or in the current folder)."""
    overwrite: bool = False
    """Save edits over a file that mudg view did not write."""
    settings: ViewConfig

    def act(self) -> dict[str, Any]:
        from mudg.viewer import live as edits
        from mudg.viewer import view

        files = edits.EditFiles(self.edits, self.edits_out, self.overwrite)
        return view.run_view(self.settings, self.source, self.compare, scene=self.scene, files=files)
