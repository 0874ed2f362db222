"""The ``mudg`` command: flags to frozen configurations, errors to exit codes. No logic of its own, and no torch.

Precedence: defaults < the preset behind ``--preset`` (``--fast``) and ``--seed`` < ``--config`` YAML < flags. Results go to stdout,
progress and messages to stderr.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from mudg.base import failures, log, memory
from mudg.base.errors import ResourceError, UsageError, nearest, plain, plain_lines
from mudg.base.versions import version

if TYPE_CHECKING:
    from mudg import flags as f

INTERRUPTED = 130
TERMINATED = 143


# what each verb calls ------------------------------------------------------------------------------------------------


def _ingest(args: f.Ingest) -> dict[str, Any]:
    from mudg.stages import ingest

    config, log, out = ingest.parse_arguments(args.words, args.out, args.settings, many=args.list is not None)
    if args.list is not None:
        return ingest.run_many(config, args.list, out, args.shard, args.jobs, args.overwrite)
    _only_with_list(args)
    return {"scene": ingest.run(config, log, out, overwrite=args.overwrite)}


def _annotate(args: f.Annotate) -> dict[str, Any]:
    from mudg.stages import annotate

    if args.list is not None:
        return annotate.run_many(args.settings, args.list, _root_of(args), args.shard, args.jobs, args.overwrite)
    _only_with_list(args)
    return {"scene": annotate.run(args.settings, _scene_of(args), args.out, overwrite=args.overwrite)}


def _fuse(args: f.Fuse) -> dict[str, Any]:
    from mudg.stages import fuse

    if args.list is not None:
        return fuse.run_many(args.settings, args.list, _root_of(args), args.shard, args.jobs, args.overwrite)
    _only_with_list(args)
    return {"fused": fuse.run(args.settings, _scene_of(args), args.out, overwrite=args.overwrite)}


def _only_with_list(args: f.Many) -> None:
    if args.shard or args.jobs:
        raise UsageError("--shard and --jobs need --list", remedy="leave them out, or give --list FILE")


def _scene_of(args: f.Annotate | f.Fuse) -> Path:
    if args.scene is None:
        raise UsageError("no scene was given", expected="a scene made by mudg ingest, or --list FILE")
    return args.scene


def _root_of(args: f.Annotate | f.Fuse) -> Path:
    if args.scene is not None:
        raise UsageError("give a scene or a list, not both", got=f"{args.scene} and --list {args.list}")
    return args.out


def _learn(args: f.Learn) -> dict[str, Any]:
    from mudg.stages import learn

    return {"model": learn.run(args.settings, args.out, overwrite=args.overwrite)}


def _convert(args: f.Convert) -> dict[str, Any]:
    from mudg.stages import convert

    return {"model": convert.run(args.settings, args.checkpoint, args.to, overwrite=args.overwrite)}


def _adapt(args: f.Adapt) -> dict[str, Any]:
    from mudg.stages import adapt

    fused, fitted = cast("Path", args.fused), cast("Path", args.fitted)
    return {"model": adapt.run(args.settings, args.scene, fused, fitted, args.out, overwrite=args.overwrite)}


def _synthesize(args: f.Synthesize) -> dict[str, Any]:
    from mudg.stages import synthesize

    made = synthesize.run(
        args.settings, args.scene, cast("Path", args.fused), args.out, fitted=args.fitted, edits=args.edits, overwrite=args.overwrite
    )
    return {"views": made}


def _fit(args: f.Fit) -> dict[str, Any]:
    from mudg.stages import fit
    from mudg.stages.editing.runs import views_at

    made = fit.run(
        args.settings, args.scene, args.fused, args.out,
        observations=tuple(map(views_at, args.observations)), start=args.start_from, overwrite=args.overwrite,
    )  # fmt: skip
    return {"model": made}


def _render(args: f.RenderFlags) -> dict[str, Any]:
    from mudg.stages import render

    made = render.run(
        args.settings, args.scene, cast("Path", args.model), args.out, edits=args.edits, fused=args.fused, overwrite=args.overwrite
    )
    return {"views": made}


def _edit(args: f.EditFlags) -> dict[str, Any]:
    from mudg.stages import edit

    made = edit.run(
        args.settings, args.run, args.edits, args.out, scene=args.scene, fused=args.fused, overwrite=args.overwrite
    )
    return {"edited": made}


def _asset(args: f.AssetFlags) -> dict[str, Any]:
    from mudg.stages.editing import assets
    from mudg.stages.exporting import imports

    if args.action == "export":
        imports.refuse_import_settings(args.settings, args.id)
        return {"asset": assets.run_export(args.run, args.id, args.out, args.scene, args.overwrite)}
    if args.id or args.scene is not None:
        raise UsageError("an import takes a file alone", got=args.id or f"--scene {args.scene}", remedy="leave it out")
    return {"asset": imports.run(args.settings, args.run, args.out, overwrite=args.overwrite)}


def _export(args: f.ExportFlags) -> dict[str, Any]:
    from mudg.stages.exporting import export

    made = export.run(
        args.settings, args.format, args.run, args.out, scene=args.scene, edits=args.edits, overwrite=args.overwrite
    )
    return {"exported": made}


def _page(args: f.PageFlags) -> dict[str, Any]:
    from mudg.stages.viewing import view

    return view.run_page(args.settings, args.run, args.out, scene=args.scene, compare=args.compare, overwrite=args.overwrite)


def _report(args: f.ReportFlags) -> dict[str, Any]:
    from mudg.stages.viewing import gallery

    return gallery.run(args.runs, args.out, overwrite=args.overwrite)


def _view(args: f.ViewFlags) -> dict[str, Any]:
    from mudg.stages.viewing import edits, view

    files = edits.EditFiles(args.edits, args.edits_out, args.overwrite)
    return view.run_view(args.settings, args.run, args.compare, scene=args.scene, files=files)


def _score(args: f.Score) -> dict[str, Any]:
    from mudg.stages import score

    methods = dict(_name_and_folder(item) for item in args.views)
    made = score.run(args.settings, args.scene, methods, args.out, fused=args.fused, overwrite=args.overwrite)
    return {"metrics": made / "metrics.json", "text": score.summary_table(made)}


def _name_and_folder(item: str) -> tuple[str, Path]:
    from mudg.stages.editing.runs import views_at

    name, separator, folder = item.partition("=")
    if not separator or not name or not folder:
        raise UsageError("an entry of --views is not a name and a folder", expected="NAME=FOLDER", got=item)
    return name, views_at(Path(folder), name)


def _bench(args: f.Bench) -> dict[str, Any]:
    from mudg.base import store
    from mudg.bench import run as bench

    made = bench.run(args.name, args.settings, args.out, sources=args.sources, preset=args.preset, overwrite=args.overwrite)
    return {"bench": made / "bench.json", "text": store.read_text(made / "bench.md")}


def _run(args: f.Run) -> dict[str, Any]:
    from mudg.stages import run

    return run.run_chain(args.settings, args.source, args.out, overwrite=args.overwrite)


def _demo(args: f.Demo) -> dict[str, Any]:
    from mudg.stages import run

    return run.run_chain(args.settings, "city", args.out, overwrite=args.overwrite)


def _batch(args: f.BatchFlags) -> dict[str, Any]:
    from mudg.stages import batch

    place = args.place or args.out
    if not place or (args.place and args.out):
        raise UsageError("give one output", expected="mudg batch run --list FILE --out OUT, or mudg batch status OUT", got=place)
    if args.action == "run":
        if not args.list:
            raise UsageError("no list was given", expected="--list FILE, with one source per line")
        settings = batch.settings_of(args.preset, args.config, args.set)
        asked = batch.BatchRequest(args.list, place, args.settings, settings, args.shard, args.wait, args.scratch, args.take_over)
        return batch.run(asked, args.dry_run)
    if args.action == "status":
        return batch.show_status(place, args.html, args.settings.price, args.watch_s)
    return batch.retry(place, args.reason)


def _doctor(args: f.Doctor) -> dict[str, Any]:
    from mudg.stages import doctor

    return doctor.report_scene(args.scene) if args.scene is not None else doctor.report_machine()


@dataclass(frozen=True)
class Verb:
    """One command: its one-line summary, example command lines, and the function behind it."""

    summary: str
    examples: tuple[str, ...]
    call: Callable[[Any], dict[str, Any]]
    smaller: str = ""
    """The settings that make its work need less memory."""


VERBS: dict[str, Verb] = {
    "demo": Verb(
        "Run all steps on the built-in city and write a report page.",
        ("mudg demo", "mudg demo --fast --out runs/first", "mudg demo --seed 7 --out city7"),
        _demo,
    ),
    "run": Verb(
        "Run all steps on your own driving log or scene and write a report page.",
        ("mudg run ~/kitti/2011_09_26_drive_0001_sync --out runs/kitti", "mudg run scenes/a --out runs/a --preset quality"),
        _run,
    ),
    "doctor": Verb(
        "Report what this machine offers, or check a scene or log for errors.",
        ("mudg doctor", "mudg doctor runs/kitti/scene", "mudg doctor --json"),
        _doctor,
    ),
    "ingest": Verb(
        "Convert a driving log, or the built-in city, to a scene directory.",
        ("mudg ingest city scenes/city", "mudg ingest ~/kitti/2011_09_26_drive_0001_sync scenes/kitti --resolution 960",
         "mudg ingest custom my_log scenes/mine --cameras front --frames 0:40",
         "mudg ingest kitti --list drives.txt --out scenes --shard 0/4 --jobs 2"),
        _ingest,
        "smaller images (--resolution; of a city --city.width), fewer --frames, one image at a time (--workers 1)",
    ),
    "annotate": Verb(
        "Add missing labels to a scene: semantics, sky and depth, with confidences.",
        ("mudg annotate scenes/kitti --out scenes/kitti_labelled", "mudg annotate --list scenes --out labelled"),
        _annotate,
        "one process (--processes 1), or smaller images (mudg ingest --resolution)",
    ),
    "fuse": Verb(
        "Fuse LiDAR and images: a static coloured point cloud, one more per dynamic object.",
        ("mudg fuse scenes/city --out runs/fused", "mudg fuse --list labelled --out fused --jobs 2"),
        _fuse,
        "larger voxels (--voxel-m), or a shorter log (mudg ingest --frames)",
    ),
    "learn": Verb(
        "Train a diffusion model on generated cities, or fine-tune one on your own logs.",
        ("mudg learn --out runs/mdm", "mudg learn --config recipe.yaml --out runs/mdm",
         "mudg learn --data.scenes runs/kitti --start embedded --optimizer.lr 1e-4 --steps 500 --out runs/tuned",
         "torchrun --nproc-per-node 8 -m mudg learn --compute.parallel fsdp --config recipe.yaml --out runs/mdm"),
        _learn,
        "smaller clips (--data.width, --data.height), a smaller batch, fewer --compute.workers",
    ),
    "convert": Verb(
        "Convert a published checkpoint to a folder for synthesize, annotate or score.",
        ("mudg convert 1024-mdm-checkpoint.ckpt --to models/mudg_1024",
         "mudg convert model.ckpt --to models/dc_512 --resolution 320x512 --dtype bfloat16",
         "mudg convert checkpoints --to weights/depthlab",
         "mudg convert i3d_torchscript.pt --to weights/i3d --network i3d"),
        _convert,
        "a larger --memory-gb, where the machine has it",
    ),
    "adapt": Verb(
        "Adapt the diffusion model to one recorded log, with the log's own photographs.",
        ("mudg adapt scenes/kitti --fused runs/fused --fitted runs/plain --out runs/adapted",
         "mudg synthesize scenes/kitti --fused runs/fused --fitted runs/plain --model runs/adapted/model --out runs/virtual"),
        _adapt,
        "one process (--processes 1), or smaller images (mudg ingest --resolution)",
    ),
    "synthesize": Verb(
        "Generate dense RGB, depth and semantics on laterally shifted trajectories.",
        ("mudg synthesize scenes/city --fused runs/fused --shifts-m 2 -2 --out runs/virtual",),
        _synthesize,
        "one process (--processes 1), smaller views (--width-px), fewer --cameras and --shifts-m",
    ),
    "fit": Verb(
        "Fit a dynamic 3D Gaussian scene to recorded (and virtual) views.",
        ("mudg fit scenes/city --fused runs/fused --method street_gaussians --out runs/plain",
         "mudg fit scenes/city --fused runs/fused --observations runs/virtual --out runs/mudg_s",
         "mudg fit scenes/city --fused runs/fused --observations runs/virtual --start-from runs/plain --iterations 1000 --out runs/mudg_s"),
        _fit,
        "smaller images (mudg ingest --resolution), fewer Gaussians (--start.gaussians, --densify.max-gaussians)",
    ),
    "render": Verb(
        "Render RGB, depth and semantics of a fitted scene on shifted trajectories.",
        ("mudg render scenes/city --model runs/mudg_s --shifts-m 0 3 -3 --out runs/render",),
        _render,
        "smaller views (--width-px), fewer --cameras",
    ),
    "edit": Verb(
        "Change a drive as an edit script says: remove, move, insert, change lanes, weather and light.",
        ("mudg edit runs/kitti edits.yaml --out runs/edited",
         "mudg edit runs/mudg_s edits.yaml --scene scenes/city --fused runs/fused --out runs/edited"),
        _edit,
    ),
    "asset": Verb(
        "Write an object of a fitted scene, or Gaussians of another program, to a file to be inserted into drives.",
        ("mudg asset export runs/kitti car-003 --out assets/van.safetensors",
         "mudg asset import van.ply --label van --length-m 5.2 --out assets/van.safetensors"),
        _asset,
    ),
    "export": Verb(
        "Write a fitted scene for other programs: PLY, SPZ, glTF, USD, SOG; cameras for nerfstudio and COLMAP.",
        ("mudg export ply runs/kitti --out kitti.ply --time-s 1.5", "mudg export usdz runs/kitti --out kitti.usdz",
         "mudg export glb runs/mudg_s --scene scenes/city --edits edits.yaml --out city.glb",
         "mudg export alpasim runs/kitti --out kitti_sim.usdz", "mudg export colmap scenes/city --out city_colmap",
         "mudg export ros2 scenes/city --out city_bag", "mudg export ncore scenes/city --out city_ncore"),
        _export,
    ),
    "page": Verb(
        "Write a fitted scene as one HTML page: fly through it, any layer, any time, without a network.",
        ("mudg page runs/kitti --out kitti.html", "mudg page runs/kitti --compare runs/kitti --out both.html",
         "mudg page runs/mudg_s --scene scenes/city --out city.html"),
        _page,
    ),
    "view": Verb(
        "Show a fitted scene in a browser, with exact frames from the rasterizer.",
        ("mudg view runs/kitti", "mudg view runs/a runs/b", "mudg view runs/mudg_s --scene scenes/city --port 8080"),
        _view,
    ),
    "report": Verb(
        "Write one page over many finished runs: pictures, links, and a table of all scores to sort and filter.",
        ("mudg report runs/kitti runs/city --out runs.html", "mudg report runs --out runs.html"),
        _report,
    ),
    "score": Verb(
        "Compare views with ground truth: metrics, tables, error images.",
        ("mudg score scenes/city --views mudg_s=runs/render mudg_r=runs/virtual --out runs/score",),
        _score,
        "smaller views (--width-px), fewer --views",
    ),
    "batch": Verb(
        "Process long lists of logs, on this machine, Ray, Slurm or any scheduler; show progress, failures and costs.",
        ("mudg batch run --list logs.txt --out runs --stages ingest annotate fuse --jobs 2",
         "mudg batch run --list logs.txt --out /shared/runs --engine slurm --jobs 500 --slurm-options time=4:00:00 --config recipe.yaml",
         "mudg batch run --list s3://data/logs.txt --out s3://data/runs --engine ray --ray-address auto --cpus 4 --gpus 1",
         "mudg batch status runs --html --price 0.04", "mudg batch retry runs --reason 5,137"),
        _batch,
        "fewer --jobs, or smaller images (--set ingest.resolution=960)",
    ),
    "bench": Verb(
        "Run a benchmark: mdm, poses, edit or shift against exact ground truth, real on real logs, paper for tables of papers.",
        ("mudg bench mdm --out runs/bench", "mudg bench poses --out runs/poses", "mudg bench edit --out runs/edits",
         "mudg bench edit runs/a runs/b --out runs/edited",
         "mudg bench shift --list development --logs 1 --variant strong=virtual.probability:0.4 --out runs/shift",
         "mudg bench real logs/pandaset_002 --frames 32:56 --resolution 960 --protocols gap camera --out runs/real",
         "mudg bench paper city:reported --table mudg1 --out runs/mudg1",
         "mudg bench paper logs/* --table mudg2 --preset paper --model models/mudg_1024 --out runs/mudg2"),
        _bench,
    ),
}  # fmt: skip

SECTIONS = (
    ("start here", ("demo", "run", "doctor")),
    ("single steps, in the order of use", ("ingest", "annotate", "fuse", "learn", "fit", "adapt", "synthesize", "render", "score")),
    ("look at a drive", ("view", "page", "report")),
    ("change a drive", ("edit", "asset")),
    ("other programs", ("export",)),
    ("many drives", ("batch",)),
    ("benchmarks", ("bench",)),
    ("published models", ("convert",)),
)


# the command line ----------------------------------------------------------------------------------------------------


def overview() -> str:
    """The text of ``mudg --help``."""
    lines = [
        f"mudg {version()}: turns a driving log into laterally shifted RGB, depth and semantic video",
        "and a dynamic 3D Gaussian scene that also renders well beside the recorded path.",
        "",
        "usage: mudg VERB [arguments]",
        "       mudg VERB --help     all settings of one verb, with their defaults",
        "       mudg --version",
    ]
    for title, names in SECTIONS:
        lines += ["", f"{title}:"]
        lines += [f"  {name:<12}{VERBS[name].summary}" for name in names]
    lines += [
        "",
        "Settings: flags override --config FILE.yaml, which overrides the defaults. Every result holds its settings in run.yaml.",
        "Repeat a command to resume it: finished results are verified and reused, interrupted ones are continued.",
        "Exit codes: 0 ok, 2 usage, 3 bad input, 4 damaged result, 5 missing resource, 6 numerical error, 130 interrupted;",
        "with --list, and of batch: 10 + number of failed scenes (99: 89 or more); 143 stopped by SIGTERM.",
    ]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command line; return its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    try:
        if not words or words[0] in ("-h", "--help", "help"):
            _say(overview())
            return 0 if words else UsageError.exit_code
        if words[0] in ("-V", "--version"):
            _say(f"mudg {version()}")
            return 0
        _require_current_folder()
        # Idle threads of OpenMP and of numpy's BLAS that spin would take the cores from others; must precede torch and numpy.
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        os.environ.setdefault("PYDANTIC_ERRORS_INCLUDE_URL", "0")  # a wrong flag is told in our words
        addresses = any("://" in word for word in words)
        if addresses:
            from mudg.base import staging

            staging.refuse_secrets(words)
        args = parse(words)
        log.set_quiet(args.quiet)
        if words[0] not in ("doctor", "fuse"):  # they do without torch
            memory.require_address_space(f"mudg {words[0]}")
        if os.environ.get("MUDG_LIFE_LINE"):
            from mudg.base import processes

            processes.hold_life_line()
        with _sigterm_interrupts():
            call = functools.partial(_called, words[0])
            staged = addresses and words[0] != "batch"  # whose workers stage in and out for every step
            result = staging.run_staged(words[0], _with_named_output(args), call) if staged else call(args)
        code = int(result.pop("exit_code", 0))
        _show(result, as_json=args.json)
        return code
    except KeyboardInterrupt as interrupt:
        _complain(plain(f"stopped. Repeat the same command to resume: mudg {shlex.join(words)}"))
        return TERMINATED if isinstance(interrupt, Terminated) else INTERRUPTED
    except BrokenPipeError:
        failures.silence(1)
        return 0
    except Exception as error:
        told = failures.in_words(error, VERBS[words[0]].smaller if words[0] in VERBS else "")
        if told is None or debug:
            raise
        _complain(f"error: {told}")
        return told.exit_code


def _require_current_folder() -> None:
    """Relative paths count from it, and libraries end the process without it."""
    try:
        os.getcwd()
    except OSError as error:
        remedy = "change to a folder that exists"
        raise ResourceError("the current folder is gone, or cannot be entered", got=str(error), remedy=remedy) from error


def parse(words: Sequence[str]) -> Any:
    """Turn ``VERB flags...`` into the verb's flags object (see ``mudg.flags``); an unknown verb is a UsageError."""
    name = words[0]
    if name not in VERBS:
        near = nearest(name, VERBS, 0.5)
        raise UsageError(
            f"there is no verb {name!r}", expected="one of " + ", ".join(VERBS),
            remedy=f"did you mean `mudg {near}`?" if near else "see mudg --help",
        )  # fmt: skip
    from mudg import flags

    examples = "examples:\n" + "\n".join(f"  {line}" for line in VERBS[name].examples)
    return flags.parse(name, words[1:], f"{VERBS[name].summary}\n\n{examples}")


def _called(verb: str, args: Any) -> dict[str, Any]:
    """Call a verb; where it takes a part of a run, its folder will do."""
    if verb in ("annotate", "fuse", "adapt", "synthesize", "fit", "render", "edit", "export", "asset", "page", "view", "score"):
        from mudg.stages.editing import runs

        given = {item.name: getattr(args, item.name) for item in fields(args) if item.name in runs.PARTS}
        if verb == "score":
            args = replace(args, views=tuple("=".join(map(str, _name_and_folder(item))) for item in args.views))
        required = {"adapt": ("fused", "fitted"), "synthesize": ("fused",), "render": ("model",)}.get(verb, ())
        if verb == "fit" and args.fused is None and args.settings.method != "emernerf" and not (args.scene / "scene.json").exists():
            required = ("fused",)
        args = replace(args, **runs.parts_of(given, required))
    return VERBS[verb].call(args)


def _with_named_output(args: Any) -> Any:
    """``mudg ingest LOG OUT`` as ``mudg ingest LOG --out OUT``."""
    words = getattr(args, "words", ())
    return replace(args, words=words[:-1], out=Path(words[-1])) if len(words) > 1 and args.out is None else args


def _say(text: str) -> None:
    try:
        sys.stdout.write(plain_lines(text.split("\n")) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except (OSError, ValueError, AttributeError) as error:
        failures.silence(1)
        raise ResourceError("the answer cannot be written to standard output", got=str(error),
            remedy="what was made is complete; repeat the command to see the answer") from error  # fmt: skip


def _complain(text: str) -> None:
    """A message that cannot be written changes no exit code."""
    try:
        sys.stderr.write(text + "\n")
        sys.stderr.flush()
    except (OSError, ValueError, AttributeError):  # on a full disk; closed; never opened
        failures.silence(2)


def _show(result: dict[str, Any], *, as_json: bool) -> None:
    """Print a verb's result: its text, else one ``name: path`` a line; or all but the text as JSON."""
    text = result.pop("text", None)
    if as_json:
        _say(json.dumps(result, indent=1, default=str, allow_nan=False))
    else:
        _say(text if text is not None else plain_lines(f"{name}: {value}" for name, value in result.items()))


class Terminated(KeyboardInterrupt):
    """SIGTERM: stops as Ctrl-C does, with its own exit code."""


@contextlib.contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    def stop(_number: int, _frame: object) -> None:
        raise Terminated

    try:
        before = signal.signal(signal.SIGTERM, stop)
    except ValueError:  # not the main thread
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
