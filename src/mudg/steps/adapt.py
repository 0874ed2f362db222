"""``mudg adapt``."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, cast

from mudg.steps.engine import Make
from mudg.steps.fit import Fit
from mudg.steps.fuse import Fuse
from mudg.steps.learn import Learn
from mudg.steps.outputs import Output
from mudg.steps.step import SCENE, Flag

if TYPE_CHECKING:
    from mudg.base.run_folder import RunDir
    from mudg.diffusion.adapt import PlannedAdaptation
    from mudg.diffusion.settings import AdaptConfig
    from mudg.gaussians.settings import FitConfig


class Adapt(Output):
    """Adapt the diffusion model to one recorded log, with the log's own photographs."""

    section = "single steps, in the order of use"
    examples = (
        "mudg adapt scenes/kitti --fused runs/fused --fitted runs/plain --out runs/adapted",
        (
            "mudg synthesize scenes/kitti --fused runs/fused --fitted runs/plain --model runs/adapted/model --out"
            " runs/virtual"
        ),
    )
    smaller = "one process (--processes 1), or smaller images (mudg ingest --resolution)"
    result = "model"
    from_run = ("fused", "fitted")
    version, files = 2, ("model/*", "model.part/", "adapt.json", "before.png", "after.png", "work/")
    idle = ("processes",)
    short = (
        "model",
        "cameras",
        "shifts_m",
        "steps",
        "lr",
        "fit_iterations",
        "precision",
        "device",
        "processes",
        "seed",
    )
    scene: Annotated[Path, SCENE]
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    fused: Annotated[Path | None, Flag("FOLDER", "second", "fused")] = None
    """Point clouds written by fuse. The folder may also follow SCENE without the flag (not given: those of the run at
    SCENE)."""
    fitted: Annotated[Path | None, Flag("FOLDER", "", "fitted")] = None
    """Gaussian scene written by fit, without virtual views (not given: that of the run at SCENE)."""
    settings: AdaptConfig

    def checked(self) -> Self:
        from mudg.base.devices import NETWORK_KINDS, choose_device

        device = choose_device(self.settings.device, "diffusion model", NETWORK_KINDS)
        return replace(self, settings=replace(self.settings, device=str(device)))

    def reads(self) -> dict[str, Path | str | None]:
        from mudg.diffusion.model_files import folder_of

        return super().reads() | {"model": folder_of(self.settings.model)}

    def inputs(self) -> dict[str, str]:
        from mudg.diffusion.model_files import digest

        return super().inputs() | {"model": digest(self.settings.model)}

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.diffusion.adapt import PlannedAdaptation

        return partial(
            adapt_model,
            PlannedAdaptation.of(self.settings, self.scene, cast("Path", self.fused), cast("Path", self.fitted)),
        )

    def resulting(self, folder: Path) -> Path:
        return folder / "model"


def adapt_model(plan: PlannedAdaptation, work: RunDir) -> dict[str, Any]:
    """Fits and clips of all lessons, some steps of training, and the better of both models."""
    folder = work.path / "work"
    plan.make_clips(fit_scene, folder)
    model = Learn(out=folder / "learn", settings=plan.training(folder)).run()
    summary = plan.write_model(model, folder, work.path)
    shutil.rmtree(folder, ignore_errors=True)
    return summary


def fit_scene(settings: FitConfig, scene: Path, fused: Path | None, out: Path) -> None:
    """Fuse a scene, unless it has clouds, and fit it."""
    from mudg.scene.settings import FuseConfig

    fused = fused or Fuse(scene=scene, out=out / "fuse", settings=FuseConfig()).run()
    Fit(scene=scene, fused=fused, out=out / "fit", settings=settings).run()
