"""``mudg edit``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mudg.steps.outputs import Output
from mudg.steps.step import RUN, Flag

if TYPE_CHECKING:
    from mudg.stages.config import EditConfig


class Edit(Output):
    """Change a drive as an edit script says: remove, move, insert, change lanes, weather and light."""

    section = "change a drive"
    examples = (
        "mudg edit runs/kitti edits.yaml --out runs/edited",
        "mudg edit runs/mudg_s edits.yaml --scene scenes/city --fused runs/fused --out runs/edited",
    )
    result = "edited"
    short = ("device", "harmonize.on", "harmonize.model", "harmonize.steps")
    source: Annotated[Path, RUN]
    """Gaussian scene written by fit, or folder of a finished mudg run."""
    script: Annotated[Path, Flag("EDITS.yaml", "first")]
    """Edit script (docs/edit.md)."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to. With it, the vehicle's path and parked objects can be edited. A run has its
    own."""
    fused: Annotated[Path | None, Flag("FOLDER", "", "fused")] = None
    """Point clouds written by fuse, for the height of the ground (not given: the Gaussians give it). A run has its own."""
    settings: EditConfig

    def run(self) -> Path:
        from mudg.stages import edit

        return edit.run(self.settings, self.source, self.script, self.out, scene=self.scene, fused=self.fused, overwrite=self.overwrite)
