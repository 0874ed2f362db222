"""Many steps: ``mudg run``, ``demo``, ``batch run``, ``batch status``, ``batch retry``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.engine import Output
from mudg.steps.fit import Fit
from mudg.steps.ingest import Annotate, Fuse, Ingest
from mudg.steps.render import RenderViews, Score
from mudg.steps.step import Flag, Step
from mudg.steps.synthesize import Synthesize

if TYPE_CHECKING:
    from mudg.fleet.settings import BatchConfig
    from mudg.steps.settings import PresetName, RunConfig


class Run(Output):
    """Run all steps on your own driving log or scene and write a report page."""

    examples = (
        "mudg run ~/kitti/2011_09_26_drive_0001_sync --out runs/kitti",
        "mudg run scenes/a --out runs/a --preset quality",
    )
    short = ("device", "guided_share")
    source: Annotated[str, Flag("SOURCE", "first")]
    """Folder of a dataset log (its format is recognised), a scene directory, or the word city."""
    preset: PresetName | None = None
    """Settings to start from. fast: smaller images, fewer frames and iterations. default: minutes on two cores.
    quality: 30,000 iterations, millions of Gaussians, for a GPU. paper: the published set-up, with a published-type
    model (docs/presets.md)."""
    fast: bool = False
    """The same as --preset fast: images of a log 480 pixels wide, 3 m to each side. One to two minutes on 2 cores for
    the city, or 16 frames of one camera."""
    seed: Annotated[int | None, Flag("INT")] = None
    """Seed of all random numbers in all steps (not given: city 3 and seed 0, or the values in --config)."""
    cameras: tuple[str, ...] = ()
    """Cameras for which shifted trajectories are made (not given: the first camera)."""
    shifts_m: tuple[float, ...] = ()
    """Lateral shifts in metres, positive to the left (not given: 2, 3 and 4 m to both sides; --fast: 3 m). They apply
    to synthesize, render and score."""
    settings: RunConfig

    @classmethod
    def settings_from(cls, inputs: Mapping[str, Any], file: Path | None, given: Mapping[str, Any]) -> RunConfig:
        """Preset, then the file, then seed, cameras and shifts, then settings of single steps."""
        from mudg.base import config as configuration
        from mudg.steps.settings import RunConfig, chosen_preset, run_preset, with_lines, with_seed

        config = configuration.load(RunConfig, run_preset(chosen_preset(inputs["preset"], inputs["fast"])), file)
        config = config if inputs["seed"] is None else with_seed(config, inputs["seed"])
        config = with_lines(config, cameras=inputs.get("cameras") or None, shifts_m=inputs["shifts_m"] or None)
        return configuration.load(RunConfig, config, None, given)

    def act(self) -> dict[str, Any]:
        from mudg.steps import pipeline

        return pipeline.run_chain(self.settings, self.source, self.out, overwrite=self.overwrite)


class Demo(Run):
    """Run all steps on the built-in city and write a report page."""

    examples = ("mudg demo", "mudg demo --fast --out runs/first", "mudg demo --seed 7 --out city7")
    source: Annotated[str, Flag(hidden=True)] = "city"
    cameras: Annotated[tuple[str, ...], Flag(hidden=True)] = ()
    out: Annotated[Path, Flag()] = Path("mudg_demo")
    """Folder to write. Repeat the same command to resume an interrupted demo."""


OUT = Flag("OUT", "first")


class BatchRun(Step):
    """Process a long list of logs, on this machine, Ray, Slurm or any scheduler, or go on with it."""

    verb_name = "batch run"
    examples = (
        "mudg batch run --list logs.txt --out runs --stages ingest annotate fuse --jobs 2",
        (
            "mudg batch run --list logs.txt --out /shared/runs --engine slurm --jobs 500 --slurm-options time=4:00:00"
            " --config recipe.yaml"
        ),
        "mudg batch run --list logs.txt --out /shared/runs --engine ray --ray-address auto --cpus 4 --gpus 1",
    )
    smaller = "fewer --jobs, or smaller images (--set ingest.resolution=960)"
    short = ("stages", "command", "engine", "jobs", "cpus", "gpus")
    list: Annotated[str, Flag("FILE")]
    """File with one source per line (SOURCE [name=NAME] ...), or a folder of sources."""
    out: Annotated[str, Flag()]
    """Folder for results and records; all machines that work on the batch must see it."""
    config: Annotated[Path | None, Flag("FILE.yaml")] = None
    """Settings of the steps: a file of mudg run."""
    preset: PresetName = "default"
    """Settings of the steps to start from, as for mudg run."""
    set: Annotated[tuple[str, ...], Flag("STEP.NAME=VALUE ...")] = ()
    """Settings of the steps, over those of --config, as fit.iterations=500 device=cpu."""
    dry_run: bool = False
    """Only say what there is to do."""
    shard: Annotated[str, Flag("I/N")] = ""
    """Only the I-th of N parts of the list, from 0. env, env/N: the I-th as the scheduler numbers this task
    (SLURM_ARRAY_TASK_ID, JOB_COMPLETION_INDEX, SKYPILOT_NODE_RANK or AWS_BATCH_JOB_ARRAY_INDEX)."""
    wait: bool = False
    """With --engine slurm, wait for the end of the job."""
    take_over: bool = False
    """Go on although a driver on another machine may still work on the batch."""
    settings: BatchConfig

    @classmethod
    def settings_from(cls, inputs: Mapping[str, Any], file: Path | None, given: Mapping[str, Any]) -> BatchConfig:
        """The settings of the batch itself; a file holds those of its steps."""
        return super().settings_from(inputs, None, given)

    def act(self) -> dict[str, Any]:
        from mudg.steps import batching

        settings = batching.settings_of(self.preset, self.config, self.set)
        how: dict[str, Any] = {"shard_text": self.shard, "wait": self.wait, "take_over": self.take_over}
        return batching.run(self.list, self.out, self.settings, settings, stage_lines(), **how, dry=self.dry_run)


def stage_lines() -> dict[str, tuple[str, ...]]:
    """Command lines of the steps that a batch can do for each of its scenes, with names of other steps for their
    results."""
    from mudg.steps.command import words_of

    scene = {"scene": "{scene}", "fused": "{fuse}"}
    steps = (
        Run.build({"source": "{source}", "out": "{out}"}),
        Ingest.build({"log": "{source}", "out": "{out}"}),
        Annotate.build({"scene": "{scene}", "out": "{out}"}),
        Fuse.build({"scene": "{scene}", "out": "{out}"}),
        Fit.build({**scene, "out": "{out}"}, {"method": "street_gaussians"}),
        Synthesize.build({**scene, "fitted": "{fit}", "out": "{out}"}),
        RenderViews.build({"scene": "{scene}", "model": "{fit}", "out": "{out}"}),
        Score.build({**scene, "views": {"fit": "{render}"}, "out": "{out}"}),
    )
    return {step.verb(): tuple(words_of(step)) for step in steps}


class BatchProgress(Step):
    """Show how far a batch is, what failed and what it took."""

    verb_name = "batch status"
    examples = ("mudg batch status runs",)
    out: Annotated[str, OUT]
    """Folder of a batch."""

    def act(self) -> dict[str, Any]:
        from mudg.fleet.records import BatchFolder, read_status, text_of

        state = read_status(BatchFolder(Path(self.out)))
        return {**state, "text": text_of(state)}


class BatchRetry(Step):
    """Forget failures of a batch, so that the next run tries them again."""

    verb_name = "batch retry"
    examples = ("mudg batch retry runs --reason 5,137",)
    out: Annotated[str, OUT]
    """Folder of a batch."""
    reason: str = ""
    """Only these exit codes or reasons, with commas, e.g. 5,137 (empty = all)."""

    def act(self) -> dict[str, Any]:
        from mudg.steps import batching

        return batching.retry(self.out, self.reason)
