"""``mudg report``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from mudg.steps.step import Flag, Step


class Report(Step):
    """Write one page over many finished runs: pictures, links, and a table of all scores to sort and filter."""

    section = "look at a drive"
    result = "page"
    examples = ("mudg report runs/kitti runs/city --out runs.html", "mudg report runs --out runs.html")
    runs: Annotated[tuple[Path, ...], Flag("RUN ...", "rest")]
    """Folders of mudg run, score or bench; of any other folder, the folders in it."""
    out: Annotated[Path, Flag("FILE.html")]
    """Page to write."""
    overwrite: bool = False
    """Replace the page if it exists."""

    def act(self) -> dict[str, Any]:
        from mudg.viewer import gallery

        return gallery.run(self.runs, self.out, overwrite=self.overwrite)
