"""``mudg serve``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.step import FILE_YAML, RUN, Flag, Step

if TYPE_CHECKING:
    from mudg.sim.settings import ServeConfig


class Serve(Step):
    """Serve a fitted scene to driving simulators over gRPC, as a renderer of cameras and LiDAR."""

    section = "look at a drive"
    examples = ("mudg serve runs/kitti --port 50051", "mudg serve runs/kitti --edits cut_in.yaml --metrics-port 9100")
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
