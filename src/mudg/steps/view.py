"""Verbs that show a drive: ``mudg view``, ``page``, ``report``, ``serve``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.step import FILE_YAML, RUN, Flag, Step

if TYPE_CHECKING:
    from mudg.sim.settings import ServeConfig
    from mudg.viewer.settings import PageConfig, ViewConfig


class ViewScene(Step):
    """Show a fitted scene in a browser, with exact frames from the rasterizer."""

    verb_name = "view"
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
    settings: ViewConfig

    def act(self) -> dict[str, Any]:
        from mudg.viewer import view

        places = {"scene": self.scene, "edits": self.edits, "edits_out": self.edits_out}
        return view.run_view(self.settings, self.source, self.compare, **places)


class Page(Step):
    """Write a fitted scene as one HTML page: fly through it, any layer, any time, without a network."""

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


class Report(Step):
    """Write one page over many finished runs: pictures, links, and a table of all scores to sort and filter."""

    result = "page"
    examples = ("mudg report runs/kitti runs/city --out runs.html", "mudg report runs --out runs.html")
    runs: Annotated[tuple[Path, ...], Flag("RUN ...", "rest")]
    """Folders of mudg run, score, bench or batch; of any other folder, the folders in it."""
    out: Annotated[Path, Flag("FILE.html")]
    """Page to write."""
    overwrite: bool = False
    """Replace the page if it exists."""

    def act(self) -> dict[str, Any]:
        from mudg.viewer import gallery

        return gallery.run(self.runs, self.out, overwrite=self.overwrite)


class Serve(Step):
    """Serve a fitted scene to driving simulators over gRPC, as a renderer of cameras and LiDAR."""

    examples = ("mudg serve runs/kitti --port 50051", "mudg serve runs/kitti --edits cut_in.yaml")
    source: Annotated[Path, RUN]
    """Folder of a finished mudg run, or Gaussian scene written by fit."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to. A run has its own."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) to carry out before."""
    settings: ServeConfig

    def act(self) -> dict[str, Any]:
        from mudg.sim import server

        return server.serve(self.settings, self.source, self.edits, self.scene)
