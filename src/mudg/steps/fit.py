"""``mudg fit``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mudg.steps.outputs import Output
from mudg.steps.step import SCENE, Flag

if TYPE_CHECKING:
    from mudg.stages.config import FitConfig


class Fit(Output):
    """Fit a dynamic 3D Gaussian scene to recorded (and virtual) views."""

    section = "single steps, in the order of use"
    examples = (
        "mudg fit scenes/city --fused runs/fused --method street_gaussians --out runs/plain",
        "mudg fit scenes/city --fused runs/fused --observations runs/virtual --out runs/mudg_s",
        "mudg fit scenes/city --fused runs/fused --observations runs/virtual --start-from runs/plain --iterations 1000 --out runs/mudg_s",
    )
    smaller = "smaller images (mudg ingest --resolution), fewer Gaussians (--start.gaussians, --densify.max-gaussians)"
    result = "model"
    short = ("method", "iterations", "cameras", "width_px", "sh_degree", "seed", "device", "densify.max_gaussians")
    scene: Annotated[Path, SCENE]
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    fused: Annotated[Path | None, Flag("FOLDER", "second", "fused")] = None
    """Point clouds written by fuse; required by every method but emernerf. The folder may also stand after SCENE without the flag."""
    observations: Annotated[tuple[Path, ...], Flag("FOLDER ...")] = ()
    """Virtual views written by synthesize, in one folder or several; required by method mudg_s."""
    start_from: Annotated[Path | None, Flag("FOLDER", "", "start_from")] = None
    """Finished fit of method street_gaussians to the same scene, to continue for `iterations` more steps. Virtual views are used
    from the first of them on."""
    settings: FitConfig

    def required(self) -> tuple[str, ...]:
        alone = self.settings.method == "emernerf" or (self.scene / "scene.json").exists()
        return () if alone else ("fused",)

    def run(self) -> Path:
        from mudg.stages import fit
        from mudg.stages.editing.runs import views_at

        return fit.run(
            self.settings, self.scene, self.fused, self.out,
            observations=tuple(map(views_at, self.observations)), start=self.start_from, overwrite=self.overwrite,
        )  # fmt: skip
