"""``mudg adapt``."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, cast

from mudg.steps.fit import Fit
from mudg.steps.fuse import Fuse
from mudg.steps.learn import Learn
from mudg.steps.outputs import Output
from mudg.steps.step import SCENE, Flag

if TYPE_CHECKING:
    from mudg.base.run_folder import RunDir
    from mudg.diffusion.adapt import PlannedAdaptation
    from mudg.diffusion.settings.adapt import AdaptConfig
    from mudg.gaussians.settings import FitConfig


class Adapt(Output):
    """Adapt the diffusion model to one recorded log, with the log's own photographs."""

    section = "single steps, in the order of use"
    examples = (
        "mudg adapt scenes/kitti --fused runs/fused --fitted runs/plain --out runs/adapted",
        "mudg synthesize scenes/kitti --fused runs/fused --fitted runs/plain --model runs/adapted/model --out runs/virtual",
    )
    smaller = "one process (--processes 1), or smaller images (mudg ingest --resolution)"
    result = "model"
    version, files = 2, ("model/*", "model.part/", "adapt.json", "before.png", "after.png", "work/")
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

    def checked(self) -> Self:
        from mudg.base.devices import NETWORK_KINDS, choose_device

        device = choose_device(self.settings.device, "diffusion model", NETWORK_KINDS)
        return replace(self, settings=replace(self.settings, device=str(device)))

    def reads(self) -> dict[str, Path | str | None]:
        from mudg.diffusion.files import folder_of

        return super().reads() | {"model": folder_of(self.settings.model)}

    def inputs(self) -> dict[str, str]:
        from mudg.diffusion.files import digest

        return super().inputs() | {"model": digest(self.settings.model)}

    def key_settings(self) -> dict[str, Any]:
        return {name: value for name, value in super().key_settings().items() if name != "processes"}

    def prepare(self, inputs: dict[str, str]) -> PlannedAdaptation:
        from mudg.diffusion.adapt import PlannedAdaptation

        return PlannedAdaptation.of(self.settings, self.scene, cast("Path", self.fused), cast("Path", self.fitted))

    def make(self, work: RunDir, prepared: PlannedAdaptation) -> dict[str, Any]:
        folder = work.path / "work"
        prepared.make_clips(fit_scene, folder)
        adapted = Learn(out=folder / "learn", settings=prepared.training(folder)).run()
        summary = prepared.write_model(adapted, folder, work.path)
        shutil.rmtree(folder, ignore_errors=True)
        return summary

    def resulting(self, folder: Path) -> Path:
        return folder / "model"


def fit_scene(settings: FitConfig, scene: Path, fused: Path | None, out: Path) -> None:
    """Fuse a scene, unless it has clouds, and fit it."""
    from mudg.scene.settings import FuseConfig

    fused = fused or Fuse(scene=scene, out=out / "fuse", settings=FuseConfig()).run()
    Fit(scene=scene, fused=fused, out=out / "fit", settings=settings).run()
