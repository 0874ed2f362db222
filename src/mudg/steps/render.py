"""``mudg render``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from mudg.steps.outputs import Output
from mudg.steps.step import FILE_YAML, Flag

if TYPE_CHECKING:
    from mudg.stages.config import RenderConfig


class RenderViews(Output):
    """Render RGB, depth and semantics of a fitted scene on shifted trajectories."""

    section = "single steps, in the order of use"
    examples = (
        "mudg render scenes/city --model runs/mudg_s --shifts-m 0 3 -3 --out runs/render",
        "mudg render runs/kitti --shifts-m 2 --out x",
    )
    smaller = "smaller views (--width-px), fewer --cameras"
    result = "views"
    short = ("cameras", "shifts_m", "paths", "width_px", "video", "remove_tracks", "device", "harmonize.on", "harmonize.model")
    scene: Annotated[Path, Flag("SCENE", "first", "scene")]
    """Scene directory that the Gaussian scene was fitted to, or folder of mudg run."""
    model: Annotated[Path | None, Flag("FOLDER", "second", "model")] = None
    """Gaussian scene written by fit, or edit. It may also follow SCENE without the flag (not given: that of the run at SCENE)."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) to carry out before rendering."""
    fused: Annotated[Path | None, Flag("FOLDER", "", "fused")] = None
    """Point clouds written by fuse; for --harmonize.on."""
    settings: RenderConfig

    @classmethod
    def verb(cls) -> str:
        return "render"

    def required(self) -> tuple[str, ...]:
        return ("model",)

    def run(self) -> Path:
        from mudg.stages import render

        return render.run(
            self.settings, self.scene, cast("Path", self.model), self.out, edits=self.edits, fused=self.fused, overwrite=self.overwrite
        )
