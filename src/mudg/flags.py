"""The command-line flags of every verb: one frozen dataclass each, parsed by tyro. Imports no torch."""

from __future__ import annotations

import argparse
import ast
import contextlib
import io
import re
import sys
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, make_dataclass
from dataclasses import field as dataclass_field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, cast, get_args, get_type_hints

import tyro
from pydantic import ValidationError
from tyro.conf import FlagCreatePairsOff, arg

from mudg.base import config as configuration
from mudg.base import failures
from mudg.base.errors import UsageError
from mudg.stages import config as stage_config


@dataclass(frozen=True, kw_only=True)
class Common:
    """Flags that every command has."""

    config: Annotated[Path | None, arg(metavar="FILE.yaml")] = None
    """Read settings from this YAML file; flags on the command line win. The run.yaml beside any result is such a file."""
    quiet: FlagCreatePairsOff[bool] = False
    """Show warnings and the result only: no progress bars, no messages."""
    json: FlagCreatePairsOff[bool] = False
    """Print the result as JSON on stdout."""
    scratch: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Where inputs and outputs that are addresses (s3://bucket/folder) lie while the command works on them (not given: the system's folder
    for temporary files)."""
    debug: FlagCreatePairsOff[bool] = False
    """Show the full traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class Output(Common):
    """Flags of commands that write a folder."""

    out: Annotated[Path, arg(metavar="FOLDER")]
    """Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and
    reused."""
    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is
    finished, so the disk must hold both. Files that do not belong to the old result are kept."""


@dataclass(frozen=True, kw_only=True)
class Many(Common):
    """Flags of commands that can also process a list of scenes."""

    overwrite: FlagCreatePairsOff[bool] = False
    """Replace a result of other settings or inputs in the output folder instead of refusing. The old result stays until the new
    one is finished, so the disk must hold both. Files that do not belong to the old result are kept."""
    list: Annotated[Path | None, arg(metavar="FILE")] = None
    """Process many sources: a file with one source per line (SOURCE [name=NAME] ...), or a folder of sources. Each result goes to
    OUT/NAME. The exit code is 0, or 10 + the number of failures."""
    shard: Annotated[str, arg(metavar="i/n")] = ""
    """With --list: process the i-th of n parts of the list; i counts from 0 to n-1. A scene's part depends on its name alone. Use it
    to split a list over machines."""
    jobs: Annotated[int, arg(metavar="INT")] = 0
    """With --list: number of scenes processed at the same time (0 = one per processor)."""


@dataclass(frozen=True, kw_only=True)
class Ingest(Many):
    """Flags of ``mudg ingest``."""

    words: Annotated[tuple[str, ...], tyro.conf.Positional, arg(metavar="[FORMAT] LOG [OUT]")] = ()
    """LOG: folder of a dataset log, a scene directory, or the word city. FORMAT: its format, only needed if it is not recognised.
    OUT: the folder to write."""
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Folder to write, if it is not given after LOG. A finished result of the same settings and inputs is reused."""
    settings: Annotated[stage_config.IngestConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Annotate(Many):
    """Flags of ``mudg annotate``."""

    scene: Annotated[Path | None, tyro.conf.Positional, arg(metavar="[SCENE]")] = None
    """Scene directory written by ingest."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """Folder to write. A finished result of the same settings and inputs is verified and reused."""
    settings: Annotated[stage_config.AnnotateConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Fuse(Many):
    """Flags of ``mudg fuse``."""

    scene: Annotated[Path | None, tyro.conf.Positional, arg(metavar="[SCENE]")] = None
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    out: Annotated[Path, arg(metavar="FOLDER")]
    """Folder to write. A finished result of the same settings and inputs is verified and reused."""
    settings: Annotated[stage_config.FuseConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Learn(Output):
    """Flags of ``mudg learn``."""

    settings: Annotated[stage_config.LearnConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Convert(Common):
    """Flags of ``mudg convert``."""

    checkpoint: Annotated[Path, tyro.conf.Positional, arg(metavar="CKPT")]
    """Checkpoint file of MuDG, DynamiCrafter-512 or DynamiCrafter-1024 (.ckpt, .pt or .safetensors); or, for DepthLab, the folder
    that contains DepthLab's files, Marigold's folder and the image encoder's folder; or, with --network, weights of a
    network of the scores."""
    to: Annotated[Path, arg(metavar="FOLDER")]
    """Model folder to write."""
    overwrite: FlagCreatePairsOff[bool] = False
    """Replace the model that --to already holds. The old model stays until the new one is finished, so the disk must hold both.
    Files that do not belong to the model are kept."""
    settings: Annotated[stage_config.ConvertConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Adapt(Output):
    """Flags of ``mudg adapt``."""

    scene: Annotated[Path, tyro.conf.Positional, arg(metavar="SCENE")]
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    fused: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Point clouds written by fuse. The folder may also follow SCENE without the flag (not given: those of the run at SCENE)."""
    fitted: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Gaussian scene written by fit, without virtual views (not given: that of the run at SCENE)."""
    settings: Annotated[stage_config.AdaptConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Synthesize(Output):
    """Flags of ``mudg synthesize``."""

    scene: Annotated[Path, tyro.conf.Positional, arg(metavar="SCENE")]
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    fused: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Point clouds written by fuse. The folder may also follow SCENE without the flag (not given: those of the run at SCENE)."""
    fitted: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Gaussian scene written by fit, without virtual views. Its renders become part of the diffusion model's input. For models that were
    trained with renders."""
    edits: Annotated[Path | None, arg(metavar="FILE.yaml")] = None
    """Edit script (docs/edit.md): make views of the drive as it says."""
    settings: Annotated[stage_config.SynthesizeConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Fit(Output):
    """Flags of ``mudg fit``."""

    scene: Annotated[Path, tyro.conf.Positional, arg(metavar="SCENE")]
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    fused: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Point clouds written by fuse; required by every method but emernerf. The folder may also stand after SCENE without the flag."""
    observations: Annotated[tuple[Path, ...], arg(metavar="FOLDER")] = ()
    """Virtual views written by synthesize, in one folder or several; required by method mudg_s."""
    start_from: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Finished fit of method street_gaussians to the same scene, to continue for `iterations` more steps. Virtual views are used
    from the first of them on."""
    settings: Annotated[stage_config.FitConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class RenderFlags(Output):
    """Flags of ``mudg render``."""

    scene: Annotated[Path, tyro.conf.Positional, arg(metavar="SCENE")]
    """Scene directory that the Gaussian scene was fitted to, or folder of mudg run."""
    model: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Gaussian scene written by fit, or edit. It may also follow SCENE without the flag (not given: that of the run at SCENE)."""
    edits: Annotated[Path | None, arg(metavar="FILE.yaml")] = None
    """Edit script (docs/edit.md) to carry out before rendering."""
    fused: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Point clouds written by fuse; for --harmonize.on."""
    settings: Annotated[stage_config.RenderConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class EditFlags(Output):
    """Flags of ``mudg edit``."""

    run: Annotated[Path, tyro.conf.Positional, arg(metavar="RUN")]
    """Gaussian scene written by fit, or folder of a finished mudg run."""
    edits: Annotated[Path, tyro.conf.Positional, arg(metavar="EDITS.yaml")]
    """Edit script (docs/edit.md)."""
    scene: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Scene directory that a Gaussian scene was fitted to. With it, the vehicle's path and parked objects can be edited. A run has its
    own."""
    fused: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Point clouds written by fuse, for the height of the ground (not given: the Gaussians give it). A run has its own."""
    settings: Annotated[stage_config.EditConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class ExportFlags(Common):
    """Flags of ``mudg export``."""

    format: Annotated[str, tyro.conf.Positional, arg(metavar="FORMAT")]
    """Gaussians: ply, bundle, alpasim, spz, glb, usda, usdz, compressed-ply, sog, splat. Cameras: nerfstudio, colmap, colmap-text.
    The log over time: mcap, ros2, rerun, ncore."""
    run: Annotated[Path, tyro.conf.Positional, arg(metavar="RUN")]
    """Gaussian scene written by fit, or folder of a finished mudg run; for cameras also a scene directory."""
    out: Annotated[Path, arg(metavar="OUT")]
    """File to write, with the suffix of the format; for cameras, ros2 and ncore, folder to write."""
    scene: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Scene directory that a Gaussian scene was fitted to. A run has its own."""
    edits: Annotated[Path | None, arg(metavar="FILE.yaml")] = None
    """Edit script (docs/edit.md) to carry out before."""
    overwrite: FlagCreatePairsOff[bool] = False
    """Replace the output if it exists."""
    settings: Annotated[stage_config.ExportConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class AssetFlags(Common):
    """Flags of ``mudg asset``."""

    action: Annotated[Literal["export", "import"], tyro.conf.Positional, arg(metavar="export|import")]
    """What to do. export: write one object of a fitted scene to a file. import: make such a file of Gaussians from another program."""
    run: Annotated[Path, tyro.conf.Positional, arg(metavar="RUN|FILE")]
    """export: Gaussian scene written by fit, or folder of a finished mudg run. import: file of Gaussians (.ply, .spz, .splat,
    .sog, .glb)."""
    id: Annotated[str, tyro.conf.Positional, arg(metavar="[ID]")] = ""
    """export: track id of a dynamic object."""
    out: Annotated[Path, arg(metavar="FILE.safetensors")]
    """File to write; with --kind scene, folder to write."""
    scene: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """export: scene directory that a Gaussian scene was fitted to; it tells from which sides the object was seen. A run has its own."""
    overwrite: FlagCreatePairsOff[bool] = False
    """Replace the output if it exists."""
    settings: Annotated[stage_config.ImportConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class PageFlags(Common):
    """Flags of ``mudg page``."""

    run: Annotated[Path, tyro.conf.Positional, arg(metavar="RUN")]
    """Folder of a finished mudg run, or Gaussian scene written by fit."""
    out: Annotated[Path, arg(metavar="FILE.html")]
    """Page to write: one file. Above 32 MB, a folder FILE_page beside it, for a web server."""
    scene: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Scene directory that a Gaussian scene was fitted to. A run has its own."""
    compare: Annotated[Path | None, arg(metavar="RUN2")] = None
    """A second run or fit of the same log, to compare with. The same run: its two fits."""
    overwrite: FlagCreatePairsOff[bool] = False
    """Replace the page if it exists."""
    settings: Annotated[stage_config.PageConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class ReportFlags(Common):
    """Flags of ``mudg report``."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, arg(metavar="RUN [RUN ...]")]
    """Folders of mudg run, score or bench; of any other folder, the folders in it."""
    out: Annotated[Path, arg(metavar="FILE.html")]
    """Page to write."""
    overwrite: FlagCreatePairsOff[bool] = False
    """Replace the page if it exists."""


@dataclass(frozen=True, kw_only=True)
class ViewFlags(Common):
    """Flags of ``mudg view``."""

    run: Annotated[Path, tyro.conf.Positional, arg(metavar="RUN")]
    """Folder of a finished mudg run, or Gaussian scene written by fit."""
    compare: Annotated[Path | None, tyro.conf.Positional, arg(metavar="[RUN2]")] = None
    """A second run or fit of the same log, to compare with. The same run: its two fits."""
    scene: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Scene directory that a Gaussian scene was fitted to. A run has its own."""
    edits: Annotated[Path | None, arg(metavar="FILE.yaml")] = None
    """Edit script (docs/edit.md) that the page begins with."""
    edits_out: Annotated[Path | None, arg(metavar="FILE.yaml")] = None
    """Where edits made on the page are saved (without it: edits.yaml beside RUN, or in the current folder)."""
    overwrite: FlagCreatePairsOff[bool] = False
    """Save edits over a file that mudg view did not write."""
    settings: Annotated[stage_config.ViewConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Score(Output):
    """Flags of ``mudg score``."""

    scene: Annotated[Path, tyro.conf.Positional, arg(metavar="SCENE")]
    """Scene directory that the views belong to, or folder of mudg run."""
    views: Annotated[tuple[str, ...], arg(metavar="NAME=FOLDER")]
    """Methods to compare: a name and the folder that render or synthesize wrote, e.g. mudg_s=runs/render. They may also stand after SCENE
    without the flag."""
    fused: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Point clouds written by fuse. They are needed for the baseline without learning (not given: no baseline)."""
    settings: Annotated[stage_config.ScoreConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class RunOwn(Output):
    """Flags of ``mudg run`` without the settings of the steps."""

    source: Annotated[str, tyro.conf.Positional, arg(metavar="SOURCE")]
    """Folder of a dataset log (its format is recognised), a scene directory, or the word city."""
    preset: stage_config.PresetName = "default"
    """Settings to start from. fast: smaller images, fewer frames and iterations. default: minutes on two cores. quality: 30,000
    iterations, millions of Gaussians, for a GPU. paper: the published set-up, with a published-type model (docs/presets.md)."""
    fast: FlagCreatePairsOff[bool] = False
    """The same as --preset fast: images of a log 480 pixels wide, 3 m to each side, no adaptation. One to two minutes on 2 cores for
    16 frames of one camera; a line at the start forecasts what it takes here."""
    seed: Annotated[int | None, arg(metavar="INT")] = None
    """Seed of all random numbers in all steps (not given: city 3 and seed 0, or the values in --config)."""
    cameras: tuple[str, ...] = ()
    """Cameras for which shifted trajectories are made (not given: the first camera)."""
    shifts_m: tuple[float, ...] = ()
    """Lateral shifts in metres, positive to the left (not given: 2, 3 and 4 m to both sides; --fast: 3 m). They apply to synthesize,
    render and score."""


@dataclass(frozen=True, kw_only=True)
class Run(RunOwn):
    """Flags of ``mudg run``."""

    settings: Annotated[stage_config.RunConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class DemoOwn(Output):
    """Flags of ``mudg demo`` without the settings of the steps."""

    out: Annotated[Path, arg(metavar="FOLDER")] = Path("mudg_demo")
    """Folder to write. Repeat the same command to resume an interrupted demo."""
    preset: stage_config.PresetName = "default"
    """Settings to start from. fast: smaller images, fewer frames and iterations. default: about 6 minutes on 2 cores. quality: 30,000
    iterations, millions of Gaussians, for a GPU. paper: the published set-up, with a published-type model (docs/presets.md)."""
    fast: FlagCreatePairsOff[bool] = False
    """The same as --preset fast, 3 m to each side: about a minute on 2 cores."""
    seed: Annotated[int | None, arg(metavar="INT")] = None
    """Seed of the city and of all random numbers in all steps (not given: city 3 and seed 0, or the values in --config)."""
    shifts_m: tuple[float, ...] = ()
    """Lateral shifts in metres, positive to the left (not given: 2, 3 and 4 m to both sides; --fast: 3 m). They apply to synthesize,
    render and score."""


@dataclass(frozen=True, kw_only=True)
class Demo(DemoOwn):
    """Flags of ``mudg demo``."""

    settings: Annotated[stage_config.RunConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class BenchInputs(Output):
    """Flags of ``mudg bench`` without the settings."""

    name: Annotated[str, tyro.conf.Positional, arg(metavar="BENCHMARK")]
    """Benchmark to run: mdm (diffusion model), poses (correction of box tracks), edit (edits of fitted scenes), shift (complete methods off
    the recorded path), real (complete methods on real logs) or paper (a table of a paper)."""
    sources: Annotated[tuple[Path, ...], tyro.conf.Positional, arg(metavar="[LOG ...]")] = ()
    """real, paper: folders of dataset logs, or scenes made by ingest. paper also takes city:reported or city:development, a list of
    generated cities. edit: folders of finished runs, whose drives are edited in place of generated cities."""
    preset: stage_config.PresetName = "default"
    """shift, real, paper: settings of clouds, generated views and fits to start from, as for mudg run (docs/presets.md). paper: the
    published set-up, with a published-type model."""


@dataclass(frozen=True, kw_only=True)
class Bench(BenchInputs):
    """Flags of ``mudg bench``."""

    settings: Annotated[stage_config.BenchConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class BenchListed(BenchInputs):
    """What ``mudg bench --help`` lists: all but the settings of steps."""

    settings: Annotated[stage_config.BenchOwn, arg(name="")] = stage_config.BenchOwn()


@dataclass(frozen=True, kw_only=True)
class BatchFlags(Common):
    """Flags of ``mudg batch``."""

    action: Annotated[Literal["run", "status", "retry"], tyro.conf.Positional, arg(metavar="ACTION")]
    """run: process a list, or go on with it. status: how far it is, what failed, what it took. retry: forget failures, so that run tries
    again."""
    place: Annotated[str, tyro.conf.Positional, arg(metavar="[OUT]")] = ""
    """All but run: folder or address of a batch."""
    out: Annotated[str, arg(metavar="FOLDER|URL")] = ""
    """run: folder, or address in an object store (s3://bucket/runs), for results and records."""
    list: Annotated[str, arg(metavar="FILE|URL")] = ""
    """run: file with one source per line (SOURCE [name=NAME] ...), or a folder of sources. Sources may be addresses."""
    preset: stage_config.PresetName = "default"
    """run: settings of the steps to start from, as for mudg run. --config is a file of mudg run, too."""
    set: Annotated[tuple[str, ...], arg(metavar="STEP.NAME=VALUE")] = ()
    """run: settings of the steps, over those of --config, as fit.iterations=500 device=cpu."""
    dry_run: FlagCreatePairsOff[bool] = False
    """run: only say what there is to do."""
    shard: Annotated[str, arg(metavar="I/N")] = ""
    """run: only the I-th of N parts of the list, from 0. env, env/N: the I-th as the scheduler numbers this task (SLURM_ARRAY_TASK_ID,
    JOB_COMPLETION_INDEX, SKYPILOT_NODE_RANK or AWS_BATCH_JOB_ARRAY_INDEX)."""
    wait: FlagCreatePairsOff[bool] = False
    """run: with --engine slurm, wait for the end of the job."""
    take_over: FlagCreatePairsOff[bool] = False
    """run: go on although a driver on another machine may still work on the batch."""
    reason: str = ""
    """retry: only these exit codes, with commas, e.g. 5,137 (empty = all)."""
    html: FlagCreatePairsOff[bool] = False
    """status: also write OUT/status.html, with figures of the logs."""
    watch_s: float = 0.0
    """status: show it again every so many seconds, until nothing is left (0 = once)."""
    settings: Annotated[stage_config.BatchConfig, arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Doctor(Common):
    """Flags of ``mudg doctor``."""

    scene: Annotated[Path | None, tyro.conf.Positional, arg(metavar="[SCENE]")] = None
    """Scene directory, folder of mudg run, or log in the custom format, to check (not given: report on this machine)."""


FLAGS: dict[str, type[Common]] = {
    "demo": Demo, "run": Run, "doctor": Doctor, "ingest": Ingest, "annotate": Annotate, "fuse": Fuse, "learn": Learn,
    "convert": Convert, "adapt": Adapt, "synthesize": Synthesize, "fit": Fit, "render": RenderFlags, "score": Score, "bench": Bench,
    "edit": EditFlags, "asset": AssetFlags, "export": ExportFlags, "page": PageFlags, "view": ViewFlags, "report": ReportFlags,
    "batch": BatchFlags,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RunListed(RunOwn):
    """What ``mudg run --help`` lists: its own flags, and the setting that all steps share."""

    device: str = "auto"
    """Device of all steps: auto (CUDA if there is one), cpu, cuda, cuda:N."""


@dataclass(frozen=True, kw_only=True)
class DemoListed(DemoOwn):
    """What ``mudg demo --help`` lists: its own flags, and the setting that all steps share."""

    device: str = "auto"
    """Device of all steps: auto (CUDA if there is one), cpu, cuda, cuda:N."""


OF_A_LOG = ("format", "frames", "cameras", "sequence", "poses", "boxes", "resolution", "skip_missing", "untwist")
"""Settings of ingest that the generated city does not have."""
OWNERS = {"batch": "run", "asset": "import"}
"""Part of a verb that its settings belong to, where their texts name no other."""
PARTS: dict[str, dict[str, str]] = {
    "batch": {
        "run": "Process a list of logs, or go on with it.", "status": "Show how far a batch is, what failed and what it took.",
        "retry": "Forget failures, so that run tries again.",
    },
    "asset": {
        "export": "Write one object of a fitted scene to a file that edit scripts can insert.",
        "import": "Make an object, or a scene, of a file of Gaussians from another program.",
    },
    "bench": {
        "mdm": "Measure the diffusion model against exact truth.", "poses": "Measure the correction of box tracks.",
        "edit": "Measure edits of fitted scenes.", "shift": "Measure complete methods off the recorded path, against exact truth.",
        "real": "Measure complete methods on real logs.", "paper": "Fill a table of a paper.",
    },
    "ingest": {"city": "Generate a city: a scene with exact truth."} | {
        name: f"Convert a log in the format {name} to a scene directory."
        for name in ("kitti", "kitti360", "waymo", "nuscenes", "argoverse2", "pandaset", "nuplan", "dgp", "ncore", "custom")
    },
}  # fmt: skip
"""Parts of verbs that have a page of help of their own, and what each does."""
SECOND_INPUTS: dict[str, str] = {"render": "--model", "fit": "--fused", "synthesize": "--fused", "adapt": "--fused", "score": "--views"}
"""Commands whose second input may also stand right after the scene, without its flag."""
CHAINS: dict[str, type[Common]] = {"demo": DemoListed, "run": RunListed, "bench": BenchListed}
"""Commands that run several steps, with the flags that --help lists. --help-all adds some 200 settings of the steps."""


def parse(verb: str, words: Sequence[str], description: str) -> Common:
    """Turn the words after ``mudg VERB`` into that verb's flags.

    Raises:
        UsageError: unknown or invalid setting. InputError: --config cannot be read.
        SystemExit: --help (0), or an unknown or malformed flag (2); the message has been printed.
    """
    part, short = next((word for word in words if not word.startswith("-")), ""), {"-h", "--help"} & set(words)
    if part in PARTS.get(verb, {}) and (short or "--help-all" in words):
        return _part_help(verb, part, description, CHAINS.get(verb, FLAGS[verb]) if short else FLAGS[verb])
    if verb in CHAINS and short:
        return _own_help(verb, description)
    words = ["--help" if word == "--help-all" else word for word in words]
    words = _second_input_named(verb, words)
    flags = FLAGS[verb]
    kind = get_type_hints(flags).get("settings")
    default = tyro.MISSING_NONPROP if kind is None else _with_settings(flags, _settings(kind, words))
    _explain(flags, {})
    held = _HeldText(sys.stderr)  # the parser's messages, until it is known whether one of our own takes their place
    try:
        with contextlib.redirect_stderr(held):
            return tyro.cli(flags, args=list(words), default=default, prog=f"mudg {verb}", description=description)
    except OSError:
        if {"-h", "--help"} & set(words):
            raise
        failures.silence(2)
        raise SystemExit(UsageError.exit_code) from None  # what is wrong could not be written, but stays wrong
    except ValidationError as error:
        raise _refused(verb, error, "") from error
    except SystemExit as leaving:
        _refuse_nested(verb, leaving)
        try:
            sys.stderr.write(held.getvalue())
            sys.stderr.flush()
        except (OSError, ValueError, AttributeError):  # on a full disk; closed; never opened
            failures.silence(2)
        raise


class _HeldText(io.StringIO):
    """What is written to standard error, kept; it looks like the terminal that it may go to."""

    def __init__(self, real: Any) -> None:
        super().__init__()
        self._real = real

    def isatty(self) -> bool:
        return bool(self._real is not None and self._real.isatty())


def _refuse_nested(verb: str, leaving: SystemExit) -> None:
    """UsageError where tyro leaves because the values of a group of settings (``--loss.ssim-weight``) are not valid.

    tyro takes pydantic's error for one of its own, since it is a ValueError, and would print it as it is; that error is what the
    exit came from.
    """
    caught, group = leaving.__context__, ""
    while caught is not None and not isinstance(caught, ValidationError):
        arg = getattr(caught, "arg", None)
        group = arg if isinstance(arg, str) else group
        caught = caught.__context__
    if caught is not None:
        raise _refused(verb, caught, group.removeprefix("settings").removeprefix(".")) from caught


def _refused(verb: str, error: ValidationError, group: str) -> UsageError:
    """The first wrong value of a group of settings (empty: the verb's own), with the flag that gives it."""
    first = error.errors(include_url=False)[0]
    flag = ".".join(part for part in (group, *map(str, first["loc"])) if part).replace("_", "-")
    return UsageError(
        "a flag's value is not valid", where=f"--{flag}" if flag else f"mudg {verb}", expected=first["msg"],
        got=repr(first.get("input"))[:120], remedy=f"see mudg {verb} --help",
    )  # fmt: skip


def _second_input_named(verb: str, words: Sequence[str]) -> Sequence[str]:
    """The second of two words before all flags is the verb's second input: ``render SCENE FIT`` as ``render SCENE --model FIT``."""
    flag = SECOND_INPUTS.get(verb)
    given = flag is not None and any(word == flag or word.startswith(f"{flag}=") for word in words)
    if flag is None or given or len(words) < 2 or any(word.startswith("-") for word in words[:2]):
        return words
    return [words[0], flag, *words[1:]]


def _part_help(verb: str, part: str, description: str, flags: type[Common]) -> Common:
    """Print those of ``flags`` that a part of a verb has, such as ``batch status``: those whose text names no other part."""
    _explain(flags, {})

    def kept(kind: type[Any], usual: Any) -> type[Any]:
        """A dataclass with the fields that apply; usual: an instance with their defaults, None for the verb's own flags."""
        rows: list[Any] = []
        hints = get_type_hints(kind, include_extras=True)
        for field in fields(kind):
            text, shown = field.metadata.get("help", ""), hints[field.name]
            about: dict[str, Any] = {"metadata": {"help": text}}
            own = usual is None and field.name in ("action", "name")
            if own or not _applies(verb, part, field.name, text, usual is not None):
                continue
            if verb == "ingest" and field.name == "words":
                shown = Annotated[tuple[str, ...], tyro.conf.Positional, arg(metavar="[OUT]" if part == "city" else "LOG [OUT]")]
            value = field.default if usual is None else getattr(usual, field.name)
            group = get_type_hints(kind)[field.name]
            if is_dataclass(group):
                group = cast("type[Any]", group)
                smaller = kept(group, group() if value is MISSING else value)
                shown = Annotated[smaller, arg(name="")] if field.name == "settings" else smaller
                rows += [(field.name, shown, dataclass_field(default_factory=smaller, **about))] if fields(smaller) else []
            else:
                rows.append((field.name, shown, dataclass_field(**about, **({} if value is MISSING else {"default": value}))))
        return make_dataclass(kind.__name__, rows, kw_only=True)

    examples = [line for line in description.splitlines() if line.startswith(f"  mudg {verb} {part} ")]
    about = PARTS[verb][part] + ("\n\nexamples:\n" + "\n".join(examples) if examples else "")
    return tyro.cli(kept(flags, None), args=["--help"], prog=f"mudg {verb} {part}", description=about)


def _applies(verb: str, part: str, name: str, text: str, inside: bool) -> bool:
    """Whether a flag is one of a part of a verb."""
    if verb == "ingest":
        return name not in OF_A_LOG if part == "city" else name not in ("city", "format")
    tags = [re.findall(r"[a-z0-9]+", tag) for tag in re.findall(r"(?:^|\. )((?:All but )?[a-z0-9,; ]+): ", text)]
    named = {word for tag in tags for word in tag if word in PARTS[verb]}
    if not named:
        return not inside or part == OWNERS.get(verb, part)
    return (part in named) != text.startswith("All but ")


def _own_help(verb: str, description: str) -> Common:
    """Print the flags of a chain itself, and where those of its steps are listed."""
    note = (
        f"Every setting of a step is also a flag here, prefixed with the step's name: --fit.sh-degree 1, --synthesize.steps 4.\n"
        f"mudg {verb} --help-all lists them all; mudg fit --help and so on list those of one step, without the prefix."
    )
    _explain(CHAINS[verb], {})
    return tyro.cli(CHAINS[verb], args=["--help"], prog=f"mudg {verb}", description=f"{description}\n\n{note}")


def _settings(kind: type[Any], words: Sequence[str]) -> Any:
    """The settings before their own flags: preset (--preset, --fast), then --config, then the flags that stand for several settings."""
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--config", type=Path)
    early.add_argument("--preset", choices=tuple(get_args(stage_config.PresetName)))
    early.add_argument("--fast", action="store_true")
    early.add_argument("--seed", type=int)
    early.add_argument("--cameras", nargs="*")
    early.add_argument("--shifts-m", nargs="*", type=float)
    with contextlib.redirect_stderr(io.StringIO()):
        try:
            known, _ = early.parse_known_args(list(words))
        except SystemExit:  # malformed: the real parser has the better message
            return kind()
    whole_chain = kind is stage_config.RunConfig
    config: Any = kind()
    if whole_chain:
        config = stage_config.run_preset(stage_config.chosen_preset(known.preset, known.fast))
    elif kind is stage_config.BenchConfig:
        config = stage_config.bench_preset(known.preset or "default")
    if known.config is not None and kind is not stage_config.BatchConfig:  # there, the file is one of mudg run
        config = configuration.load(kind, config, known.config)
    if whole_chain:
        config = config if known.seed is None else stage_config.with_seed(config, known.seed)
        config = stage_config.with_lines(config, cameras=tuple(known.cameras or ()) or None, shifts_m=tuple(known.shifts_m or ()) or None)
    return config


def _with_settings(flags: type[Any], settings: Any) -> Any:
    """An instance of ``flags`` whose required fields are still missing, for tyro to fill."""
    values = {f.name: tyro.MISSING for f in fields(flags) if f.default is f.default_factory}
    return flags(**{**values, "settings": settings})


def _explain(kind: type[Any], read: dict[str, dict[str, dict[str, str]]]) -> None:
    """Give the fields of a dataclass, and of those inside it, the text written below each in the source.

    tyro would find the same texts by parsing a class's whole module once or twice for every class, and its lines once more in
    Python: half of the time of ``mudg run --help``. Where a source file is missing, that is left to tyro.

    Args:
        kind: a dataclass. read: texts by module, class and field of the modules read so far; modules are added.
    """
    inside = {name: inner for name, inner in get_type_hints(kind).items() if is_dataclass(inner)}
    for field in fields(kind):
        owner = next(base for base in kind.__mro__ if field.name in base.__dict__.get("__annotations__", {}))
        if owner.__module__ not in read:
            read[owner.__module__] = _texts_below_fields(getattr(sys.modules[owner.__module__], "__file__", None))
        texts = read[owner.__module__].get(owner.__qualname__)
        if texts is None:
            continue
        text = texts.get(field.name, "")
        if field.name in inside:
            _explain(inside[field.name], read)
            text = text or " ".join((inside[field.name].__doc__ or "").split())
        field.metadata = MappingProxyType({**field.metadata, "help": text})


def _texts_below_fields(source: str | None) -> dict[str, dict[str, str]]:
    """By class and field: the string that stands below the field in a source file, as one line. Empty without a file."""
    if source is None or not Path(source).is_file():
        return {}
    texts: dict[str, dict[str, str]] = {}
    for node in ast.parse(Path(source).read_bytes()).body:
        if not isinstance(node, ast.ClassDef):
            continue
        by_field = texts.setdefault(node.name, {})
        for field, below in zip(node.body, node.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(below, ast.Expr):
                value = below.value
                if isinstance(value, ast.Constant) and isinstance(value.value, str):
                    by_field[field.target.id] = " ".join(value.value.split())
    return texts
