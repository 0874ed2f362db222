"""``mudg synthesize``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from mudg.steps.outputs import Output
from mudg.steps.step import FILE_YAML, SCENE, Flag

if TYPE_CHECKING:
    from mudg.stages.config import SynthesizeConfig


class Synthesize(Output):
    """Generate dense RGB, depth and semantics on laterally shifted trajectories."""

    section = "single steps, in the order of use"
    examples = ("mudg synthesize scenes/city --fused runs/fused --shifts-m 2 -2 --out runs/virtual",)
    smaller = "one process (--processes 1), smaller views (--width-px), fewer --cameras and --shifts-m"
    result = "views"
    short = (
        "model",
        "cameras",
        "shifts_m",
        "paths",
        "steps",
        "width_px",
        "condition",
        "align_depth",
        "precision",
        "seed",
        "device",
        "processes",
    )
    scene: Annotated[Path, SCENE]
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    fused: Annotated[Path | None, Flag("FOLDER", "second", "fused")] = None
    """Point clouds written by fuse. The folder may also follow SCENE without the flag (not given: those of the run at SCENE)."""
    fitted: Annotated[Path | None, Flag("FOLDER", "", "fitted")] = None
    """Gaussian scene written by fit, without virtual views. Its renders become part of the diffusion model's input. For models that were
    trained with renders."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md): make views of the drive as it says."""
    settings: SynthesizeConfig

    def required(self) -> tuple[str, ...]:
        return ("fused",)

    def run(self) -> Path:
        from mudg.stages import synthesize

        return synthesize.run(
            self.settings, self.scene, cast("Path", self.fused), self.out,
            fitted=self.fitted, edits=self.edits, overwrite=self.overwrite,
        )  # fmt: skip
