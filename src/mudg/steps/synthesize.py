"""``mudg synthesize``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self, cast

from mudg.base.layout import OBSERVATION_FILES, below
from mudg.steps.engine import Make, script_of
from mudg.steps.outputs import Output
from mudg.steps.step import FILE_YAML, SCENE, Flag

if TYPE_CHECKING:
    from mudg.diffusion.settings.synthesize import SynthesizeConfig


class Synthesize(Output):
    """Generate dense RGB, depth and semantics on laterally shifted trajectories."""

    section = "single steps, in the order of use"
    examples = ("mudg synthesize scenes/city --fused runs/fused --shifts-m 2 -2 --out runs/virtual",)
    smaller = "one process (--processes 1), smaller views (--width-px), fewer --cameras and --shifts-m"
    result = "views"
    from_run = ("fused",)
    version, files = 2, below("*", (*OBSERVATION_FILES, "overview.png", "depth_fits.json", "state/"))
    idle = ("offload", "compiled")
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
    """Point clouds written by fuse. The folder may also follow SCENE without the flag (not given: those of the run at
    SCENE)."""
    fitted: Annotated[Path | None, Flag("FOLDER", "", "fitted")] = None
    """Gaussian scene written by fit, without virtual views. Its renders become part of the diffusion model's input. For
    models that were trained with renders."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md): make views of the drive as it says."""
    settings: SynthesizeConfig

    def checked(self) -> Self:
        from mudg.diffusion.views import check_config
        from mudg.editing.edit import shows_weather

        script, renders = script_of(self.edits), self.fitted is not None
        weather = script is not None and shows_weather(self.settings, script, renders)
        return replace(self, settings=check_config(self.settings, renders, weather=weather))

    def reads(self) -> dict[str, Path | str | None]:
        from mudg.diffusion.files import folder_of

        return super().reads() | {"model": folder_of(self.settings.model)}

    def inputs(self) -> dict[str, str]:
        from mudg.diffusion.files import digest

        first = self.digests({"scene": self.scene, "fused": self.fused})
        return (
            first | {"model": digest(self.settings.model)} | self.digests({"edits": self.edits, "fitted": self.fitted})
        )

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.diffusion.synthesize import JobInputs, write_views
        from mudg.editing.edit import edited_drive, edited_scene
        from mudg.gaussians.storage import model_of_scene
        from mudg.scene.read import read_scene

        scene, script = read_scene(self.scene), script_of(self.edits)
        if self.fitted is not None:
            model_of_scene(self.fitted, scene)  # refuses the fit of another scene
        job = JobInputs(self.scene, cast("Path", self.fused), self.fitted)
        if script is not None:
            scene, job = (
                edited_scene(script, self.settings, job, scene),
                replace(job, edited=partial(edited_drive, script)),
            )
        return partial(write_views, self.settings, job, scene)
