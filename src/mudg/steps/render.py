"""``mudg render``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self, cast

from mudg.base.errors import UsageError
from mudg.base.layout import OBSERVATION_FILES, below
from mudg.steps.engine import Make, script_of
from mudg.steps.outputs import Output
from mudg.steps.step import FILE_YAML, Flag

if TYPE_CHECKING:
    from mudg.editing.settings import RenderConfig


class RenderViews(Output):
    """Render RGB, depth and semantics of a fitted scene on shifted trajectories."""

    verb_name = "render"
    section = "single steps, in the order of use"
    examples = (
        "mudg render scenes/city --model runs/mudg_s --shifts-m 0 3 -3 --out runs/render",
        "mudg render runs/kitti --shifts-m 2 --out x",
    )
    smaller = "smaller views (--width-px), fewer --cameras"
    result = "views"
    from_run = ("model",)
    version, files = 2, ("*.mp4", *below("*", OBSERVATION_FILES))
    short = (
        "cameras",
        "shifts_m",
        "paths",
        "width_px",
        "video",
        "remove_tracks",
        "device",
        "harmonize.on",
        "harmonize.model",
    )
    scene: Annotated[Path, Flag("SCENE", "first", "scene")]
    """Scene directory that the Gaussian scene was fitted to, or folder of mudg run."""
    model: Annotated[Path | None, Flag("FOLDER", "second", "model")] = None
    """Gaussian scene written by fit, or edit. It may also follow SCENE without the flag (not given: that of the run at
    SCENE)."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) to carry out before rendering."""
    fused: Annotated[Path | None, Flag("FOLDER", "", "fused")] = None
    """Point clouds written by fuse; for --harmonize.on."""
    settings: RenderConfig

    def checked(self) -> Self:
        if self.settings.harmonize.on and (self.edits is None or self.fused is None):
            raise UsageError(
                "harmonising repairs what an edit script touched, from the fused clouds",
                where="--harmonize.on",
                got=f"no --{'edits' if self.edits is None else 'fused'}",
                remedy="give --edits and --fused, or leave it out",
            )
        return self

    def inputs(self) -> dict[str, str]:
        read = self.digests({"scene": self.scene, "model": self.model, "edits": self.edits})
        if not self.settings.harmonize.on:
            return read
        from mudg.diffusion.files import digest

        return read | self.digests({"fused": self.fused}) | {"diffusion": digest(self.settings.harmonize.model)}

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.editing import render

        model, script = cast("Path", self.model), script_of(self.edits)
        edited = render.prepare(self.settings, self.scene, model, script, self.fused)
        return partial(render.write_views, self.settings, self.scene, model, edited)
