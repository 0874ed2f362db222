"""Verbs of the diffusion model: ``mudg learn``, ``synthesize``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self, cast

from mudg.base.layout import OBSERVATION_FILES, below
from mudg.steps.engine import Make, Output, Watched, opened, script_of
from mudg.steps.step import FILE_YAML, SCENE, Flag

if TYPE_CHECKING:
    from mudg.diffusion.settings import LearnConfig, SynthesizeConfig


class Learn(Watched):
    """Train a diffusion model on generated cities, or fine-tune one on your own logs."""

    examples = (
        "mudg learn --out runs/mdm",
        "mudg learn --config recipe.yaml --out runs/mdm",
        "mudg learn --data.scenes runs/kitti --start embedded --optimizer.lr 1e-4 --steps 500 --out runs/tuned",
        "torchrun --nproc-per-node 8 -m mudg learn --config recipe.yaml --out runs/mdm",
    )
    smaller = "smaller clips (--data.width, --data.height), a smaller batch, fewer --compute.workers"
    result = "model"
    version, idle = 1, ("compute",)
    files = (
        *("clips/*.safetensors", "clips/log_clips.json", "codec/", "steps/", "cache/", "samples/*.png"),
        *("metrics.json", "model/*", "model.part/"),
    )
    short = (
        *("start", "steps", "seed", "precision", "data.scenes", "data.clips", "data.cities", "data.width"),
        *("data.height", "data.window", "optimizer.lr", "optimizer.batch_frames", "compute.device", "compute.workers"),
    )
    settings: LearnConfig

    def act(self) -> Path:
        from mudg.diffusion import learn

        return learn.train(self.settings, self.out, self.output(), lambda: opened(self)[0])

    def checked(self) -> Self:
        from mudg.diffusion import learn

        learn.check_clips(self.settings)
        return self

    def reads(self) -> dict[str, Path | str | None]:
        from mudg.diffusion import learn

        return learn.files_read(self.settings, self.out, self.overwrite)

    def inputs(self) -> dict[str, str]:
        from mudg.diffusion import learn

        return learn.inputs_of(self.settings)


class Synthesize(Output):
    """Generate dense RGB, depth and semantics on laterally shifted trajectories."""

    examples = ("mudg synthesize scenes/city --fused runs/fused --shifts-m 2 -2 --out runs/virtual",)
    smaller = "one process (--processes 1), smaller views (--width-px), fewer --cameras and --shifts-m"
    result = "views"
    from_run = ("fused",)
    version, files = 3, below("*", (*OBSERVATION_FILES, "overview.png", "depth_fits.json", "state/"))
    short = (
        *("model", "cameras", "shifts_m", "paths", "steps", "width_px", "condition", "align_depth", "precision"),
        *("seed", "device", "processes"),
    )
    scene: Annotated[Path, SCENE]
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    fused: Annotated[Path | None, Flag("FOLDER", "second", "fused")] = None
    """Point clouds written by fuse (not given: those of the run at SCENE)."""
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
        from mudg.diffusion.model_files import folder_of

        return super().reads() | {"model": folder_of(self.settings.model)}

    def inputs(self) -> dict[str, str]:
        from mudg.diffusion.model_files import digest

        first = self.digests({"scene": self.scene, "fused": self.fused})
        model = {"model": digest(self.settings.model)}
        return first | model | self.digests({"edits": self.edits, "fitted": self.fitted})

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.diffusion.views import JobInputs, write_views
        from mudg.editing.edit import edited_drive, edited_scene
        from mudg.gaussians.storage import model_of_scene
        from mudg.scene.read import read_scene

        scene, script = read_scene(self.scene), script_of(self.edits)
        if self.fitted is not None:
            model_of_scene(self.fitted, scene)  # refuses the fit of another scene
        job = JobInputs(self.scene, cast("Path", self.fused), self.fitted)
        if script is not None:
            scene = edited_scene(script, self.settings, job, scene)
            job = replace(job, edited=partial(edited_drive, script))
        return partial(write_views, self.settings, job, scene)
