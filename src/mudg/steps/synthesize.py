"""``mudg synthesize``."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, cast

from mudg.base.layout import OBSERVATION_FILES, below
from mudg.steps.engine import script_of
from mudg.steps.outputs import Output
from mudg.steps.step import FILE_YAML, SCENE, Flag

if TYPE_CHECKING:
    from mudg.base.run_folder import RunDir
    from mudg.diffusion.settings.synthesize import SynthesizeConfig


class Synthesize(Output):
    """Generate dense RGB, depth and semantics on laterally shifted trajectories."""

    section = "single steps, in the order of use"
    examples = ("mudg synthesize scenes/city --fused runs/fused --shifts-m 2 -2 --out runs/virtual",)
    smaller = "one process (--processes 1), smaller views (--width-px), fewer --cameras and --shifts-m"
    result = "views"
    version, files = 2, below("*", (*OBSERVATION_FILES, "overview.png", "depth_fits.json", "state/"))
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

    def checked(self) -> Self:
        from mudg.diffusion.views import check_config
        from mudg.editing.generated import shows_weather

        renders = self.fitted is not None
        weather = self.edits is not None and shows_weather(self.settings, script_of(self.edits)[0], renders)
        return replace(self, settings=check_config(self.settings, renders, weather=weather))

    def reads(self) -> dict[str, Path | str | None]:
        from mudg.diffusion.files import folder_of

        return super().reads() | {"model": folder_of(self.settings.model)}

    def inputs(self) -> dict[str, str]:
        from mudg.diffusion.files import digest

        first = self.digests({"scene": self.scene, "fused": self.fused})
        return first | {"model": digest(self.settings.model)} | self.digests({"edits": self.edits, "fitted": self.fitted})

    def key_settings(self) -> dict[str, Any]:
        """Without those that say how is computed, not what: a result may be resumed and reused under others."""
        return {name: value for name, value in super().key_settings().items() if name not in ("offload", "compiled")}

    def prepare(self, inputs: dict[str, str]) -> Any:
        from mudg.diffusion.synthesize import JobInputs
        from mudg.editing.generated import edited_drive, edited_scene
        from mudg.gaussians.storage import model_of_scene
        from mudg.scene.read import read_scene

        scene = read_scene(self.scene)
        if self.fitted is not None:
            model_of_scene(self.fitted, scene)  # refuses the fit of another scene
        given = JobInputs(self.scene, cast("Path", self.fused), self.fitted)
        if self.edits is None:
            return given, scene
        script = script_of(self.edits)[0]
        return replace(given, edited=functools.partial(edited_drive, script)), edited_scene(script, self.settings, given, scene)

    def make(self, work: RunDir, prepared: Any) -> dict[str, Any]:
        from mudg.diffusion.synthesize import write_views

        return write_views(self.settings, *prepared, work.path)
