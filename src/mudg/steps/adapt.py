"""``mudg adapt``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from mudg.steps.outputs import Output
from mudg.steps.step import SCENE, Flag

if TYPE_CHECKING:
    from mudg.stages.config import AdaptConfig


class Adapt(Output):
    """Adapt the diffusion model to one recorded log, with the log's own photographs."""

    section = "single steps, in the order of use"
    examples = (
        "mudg adapt scenes/kitti --fused runs/fused --fitted runs/plain --out runs/adapted",
        "mudg synthesize scenes/kitti --fused runs/fused --fitted runs/plain --model runs/adapted/model --out runs/virtual",
    )
    smaller = "one process (--processes 1), or smaller images (mudg ingest --resolution)"
    result = "model"
    short = ("model", "cameras", "shifts_m", "steps", "lr", "fit_iterations", "precision", "device", "processes", "seed")
    scene: Annotated[Path, SCENE]
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    fused: Annotated[Path | None, Flag("FOLDER", "second", "fused")] = None
    """Point clouds written by fuse. The folder may also follow SCENE without the flag (not given: those of the run at SCENE)."""
    fitted: Annotated[Path | None, Flag("FOLDER", "", "fitted")] = None
    """Gaussian scene written by fit, without virtual views (not given: that of the run at SCENE)."""
    settings: AdaptConfig

    def required(self) -> tuple[str, ...]:
        return ("fused", "fitted")

    def run(self) -> Path:
        from mudg.stages import adapt

        fused, fitted = cast("Path", self.fused), cast("Path", self.fitted)
        return adapt.run(self.settings, self.scene, fused, fitted, self.out, overwrite=self.overwrite)
