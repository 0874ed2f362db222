"""The pipeline behind ``mudg demo`` and ``mudg run``: steps in order, each skipped when its result verifies.

OUT/scene  OUT/fuse  OUT/synthesize/<trajectory>  OUT/fit/<method>  OUT/render/<method>/<trajectory>
OUT/score
OUT/report.html  OUT/viewer.html  OUT/run.yaml (settings)  OUT/run.json (state, seconds per step over all continuations)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from mudg.base import config as configuration
from mudg.base import log, store
from mudg.base.errors import InputError, IntegrityError, MudgError, UsageError, similar_path
from mudg.base.memory import Meter, Usage, folder_bytes, in_words
from mudg.base.records import ForeignRecord, Number, parse_record
from mudg.base.run_folder import is_temporary, locked, refuse_overlap
from mudg.base.versions import environment
from mudg.diffusion.settings import SynthesizeConfig
from mudg.gaussians.settings import FitConfig
from mudg.steps.engine import Output
from mudg.steps.fit import Fit
from mudg.steps.ingest import Annotate, Fuse, Ingest
from mudg.steps.render import RenderViews, Score
from mudg.steps.settings import NO_MODEL, PRESETS, RunConfig, with_device
from mudg.steps.synthesize import Synthesize

CITY = "city"
WITHOUT_DIFFUSION = "street_gaussians"
DIFFUSION = "mudg_r"
WITH_DIFFUSION = "mudg_s"
CONVERTED = "a folder written by mudg convert"
PERCENT_OF_A_RUN = {
    "fuse": 1,
    "fit without diffusion": 18,
    "synthesize": 21,
    "fit with diffusion": 36,
    "render without diffusion": 3.5,
    "render with diffusion": 3.5,
    "score": 13,
    "viewer": 1,
    "report": 3,
}
"""Means of processor time in ``mudg demo`` and in a run on 16 frames of KITTI. After the first fit, a forecast is 16 %
too short for the one and 19 % too long for the other; after ``synthesize`` 3 and 9 %."""
FORECAST_FROM = 0.1
"""Share of the work that is done before a run says what is left: fusing alone tells nothing of the fits."""


def fits_of(config: FitConfig, guided_share: float) -> tuple[FitConfig, FitConfig]:
    """Settings of the chain's two fits, both from nothing: the one on recorded views, and the one under virtual views,
    with ``guided_share`` times as many iterations."""
    guided = max(1, round(guided_share * config.iterations))
    return replace(config, method=WITHOUT_DIFFUSION), replace(config, method=WITH_DIFFUSION, iterations=guided)


def run_chain(config: RunConfig, source: str | Path, out: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """Run the whole chain on a generated city (``"city"``), a dataset log or a scene, and write ``OUT/report.html``. A
    finished step of the same settings and inputs is verified and reused; an interrupted one continues. A scene at
    ``OUT/scene`` may be the source: nothing is written there then. overwrite: replace what other settings have left in
    ``out``, each step's result when the new one is finished.

    Returns paths of the report and the metrics, the seconds per step, and ``text``: the tables for people. InputError:
    no such log. UsageError: ``out`` holds something else, or touches what is read. Whatever a verb raises.
    """
    import torch

    from mudg import native
    from mudg.viewer import report as run_report

    out = Path(out)
    if str(source) != CITY and not Path(source).exists():
        where, expected = str(source), f"a folder, or the word {CITY}"
        raise InputError("no such driving log", where=where, expected=expected, remedy=similar_path(source))
    _refuse_overlap(config, source, out)
    refuse_missing(config.synthesize, config.fit)
    torch.set_num_threads(native.default_threads())
    _Ledger.refuse_foreign(out, str(source))
    with locked(out / "lock"):
        ledger, page = _Ledger.open(out, config, str(source), overwrite), out / "report.html"
        config = with_device(config)
        try:
            scene = _prepare_scene(config, source, out, ledger, overwrite)
            for name, step in steps_of(config, scene, out, overwrite).items():
                ledger.timed(name, step.out, step.run)
            names = sorted(path.parent.relative_to(out).as_posix() for path in out.rglob(store.MANIFEST))
            digests = {name: store.sha256_file(out / name / store.MANIFEST) for name in names if ".part" not in name}
            reels = None
            if digests != ledger.digests or not page.is_file():
                store.remove(page)
                ledger.digests = digests
                ledger.timed("viewer", out / "viewer.html", lambda: _write_viewer(out))
                reels = ledger.timed("report", page, lambda: run_report.film(out))
        except (KeyboardInterrupt, MudgError) as error:
            ledger.save("interrupted" if isinstance(error, KeyboardInterrupt) else "failed")
            raise
        ledger.save("complete")
        if reels is not None:  # written last, when the seconds of all steps are known
            run_report.write_page(out, reels)
            ledger.steps["report"]["written_bytes"] = folder_bytes(page)
            ledger.save("complete")
        text = _closing_text(out, page, ledger)
        return {"report": page, "metrics": out / "score" / "metrics.json", "seconds": ledger.seconds(), "text": text}


def _write_viewer(out: Path) -> Path:
    """Write the page that shows the fitted scene. Its record is OUT/run.json: it has no description beside it."""
    from mudg.base.run_folder import description_path
    from mudg.viewer import view
    from mudg.viewer.report import VIEWER
    from mudg.viewer.settings import PageConfig

    page = view.page_of(PageConfig(), view.find_sources(PageConfig(), out, None, None).read(), report="report.html")
    store.remove(description_path(out / VIEWER))
    return view.write_page(page, out / VIEWER, (out / VIEWER).with_name(f"{Path(VIEWER).stem}_page"))["page"]


def refuse_missing(generator: SynthesizeConfig, fit: FitConfig, flag: str = "--synthesize.model") -> None:
    """UsageError where weights that are not shipped are asked for and not given; InputError where there is no diffusion
    model. Before anything is written: the first of these is needed only after a fit. ``flag``: what names the diffusion
    model on this command line."""
    from mudg.diffusion.model_files import is_published, read_description

    if generator.model == NO_MODEL:
        what = "the preset paper needs a published-type diffusion model, which mudg does not ship"
        remedy = "convert a checkpoint that you have (docs/published.md)"
        raise UsageError(what, where=flag, expected=CONVERTED, remedy=remedy)
    if fit.virtual.perception == "lpips" and not fit.virtual.lpips_weights:
        what, where = "LPIPS needs a weight file, which mudg does not ship", "--fit.virtual.lpips-weights"
        remedy = "give one, or --fit.virtual.perception filters"
        raise UsageError(what, where=where, expected="a safetensors file", remedy=remedy)
    read_description(generator.model)
    if generator.guidance is not None and not is_published(generator.model):
        what = "guidance applies to published-type models only"
        raise UsageError(what, where=flag, got=generator.model, expected=CONVERTED)


def _refuse_overlap(config: RunConfig, source: str | Path, out: Path) -> None:
    """UsageError where the chain would write into, over or around what it reads. Its own scene is no such case: with a
    scene as source it writes none."""
    from mudg.diffusion.model_files import folder_of

    score = {f"score.{name}-weights": getattr(config.score, f"{name}_weights") for name in ("lpips", "fid", "fvd")}
    read = {
        "log": None if str(source) == CITY or _is_own_scene(source, out) else source,
        "ingest.poses": config.ingest.poses,
        "ingest.boxes": config.ingest.boxes,
        "annotate.weights": config.annotate.weights,
        "annotate.depth-network": config.annotate.depth_network,
        "synthesize.model": folder_of(config.synthesize.model),
        "fit.virtual.lpips-weights": config.fit.virtual.lpips_weights,
    }
    refuse_overlap(out, read | score)


def _is_scene(source: str | Path) -> bool:
    return (Path(source) / "scene.json").is_file()


def _is_own_scene(source: str | Path, out: Path) -> bool:
    return _is_scene(source) and (out / "scene").exists() and (out / "scene").samefile(source)


def _prepare_scene(config: RunConfig, source: str | Path, out: Path, ledger: _Ledger, overwrite: bool) -> Path:
    """Ingest (unless ``source`` is a scene already) and, where semantic labels are absent, annotate. InputError without
    LiDAR."""
    if str(source) != CITY and _is_scene(source):
        scene = Path(source)
    else:
        # which is for logs: a city has a size of its own
        of_preset = config.ingest.resolution == PRESETS["fast"]["ingest.resolution"]
        settings = replace(config.ingest, resolution="") if str(source) == CITY and of_preset else config.ingest
        ingest = Ingest(log=str(source), out=out / "scene", overwrite=overwrite, settings=settings)
        scene = ledger.timed("ingest", ingest.out, ingest.run)
    if not _has_semantics(scene):
        step = Annotate(scene=scene, out=out / "annotate", overwrite=overwrite, settings=config.annotate)
        return ledger.timed("annotate", step.out, step.run)
    return scene


def _has_semantics(scene: Path) -> bool:
    """Whether every frame has semantic labels. InputError without LiDAR: the chain could not go on after annotate."""
    from mudg.scene import fuse
    from mudg.scene.read import read_scene

    loaded = read_scene(scene)
    fuse.refuse_without_lidar(loaded)
    return all("semantics" in frame.labels for frame in loaded.frames)


def steps_of(config: RunConfig, scene: Path, out: Path, overwrite: bool) -> dict[str, Output]:
    """The pipeline on a labelled scene, by the names that tables give its steps, in order."""
    plain, guided = fits_of(config.fit, config.guided_share)
    first, last = out / "fit" / WITHOUT_DIFFUSION, out / "fit" / WITH_DIFFUSION
    fused, virtual = out / "fuse", out / "synthesize"
    render = {method: out / "render" / method for method in (WITHOUT_DIFFUSION, WITH_DIFFUSION)}
    views = {WITHOUT_DIFFUSION: render[WITHOUT_DIFFUSION], DIFFUSION: virtual, WITH_DIFFUSION: render[WITH_DIFFUSION]}
    drawn = {"scene": scene, "settings": config.render}
    steps: dict[str, Output] = {
        "fuse": Fuse(scene=scene, out=fused, settings=config.fuse),
        "fit without diffusion": Fit(scene=scene, fused=fused, out=first, settings=plain),
        "synthesize": Synthesize(scene=scene, fused=fused, out=virtual, settings=config.synthesize),
        "fit with diffusion": Fit(scene=scene, fused=fused, observations=(virtual,), out=last, settings=guided),
        "render without diffusion": RenderViews(model=first, out=render[WITHOUT_DIFFUSION], **drawn),
        "render with diffusion": RenderViews(model=last, out=render[WITH_DIFFUSION], **drawn),
        "score": Score(scene=scene, views=views, fused=fused, out=out / "score", settings=config.score),
    }
    return {name: replace(step, overwrite=overwrite) for name, step in steps.items()}


def _closing_text(out: Path, report: Path, ledger: _Ledger) -> str:
    """Scores, what the steps took, where the pages lie, and what to do next."""
    from mudg.scoring import score
    from mudg.viewer.report import next_commands

    rows = []
    for name, entry in ledger.steps.items():
        of, size = Usage.of_record(entry), int(entry.get("written_bytes", 0))
        peak = in_words(of.peak_bytes) if of.peak_bytes else ""
        rows.append(f"  {name:<26}{of.seconds:8.1f} s{of.processor_s:11.1f} s{peak:>12}{in_words(size):>12}")
    head = f"  {'step':<26}{'time':>10}{'processor':>13}{'memory':>12}{'written':>12}"
    total = f"  {'total':<26}{sum(ledger.seconds().values()):8.1f} s"
    viewer = out / "viewer.html"
    pages = [f"report: {report.resolve()}", *([f"viewer: {viewer.resolve()}"] if viewer.is_file() else [])]
    wanted = {"view": "fly through it", "export": "take it elsewhere", "dataset": "train on it", "run": "your own log"}
    lines = [line for _, block in next_commands(out) for line in block]
    first = {verb: next(line for line in lines if line.startswith(f"mudg {verb} ")) for verb in wanted}
    after = ["next:", *(f"  {first[verb]:<58}  {what}" for verb, what in wanted.items())]
    return "\n".join([score.summary_table(out / "score"), "", head, *rows, total, "", *pages, "", *after])


class _StepRecord(ForeignRecord):
    state: str
    seconds: Number
    processor_s: Number = 0.0
    peak_bytes: int | None = None
    written_bytes: int = 0


class _LedgerRecord(ForeignRecord):
    """What is read of ``OUT/run.json``."""

    asked: dict[str, Any]
    steps: dict[str, _StepRecord] = {}
    digests: dict[str, str] = {}


class _Ledger:
    """OUT/run.json: what was asked, and how long each step took over all continuations."""

    def __init__(self, out: Path, asked: Mapping[str, Any], before: Mapping[str, Any]) -> None:
        self._out, self._asked = out, dict(asked)
        self.steps: dict[str, dict[str, Any]] = dict(before.get("steps", {}))
        same_program = before.get("environment") == environment()
        self.digests: dict[str, str] = dict(before.get("digests", {})) if same_program else {}
        """Of the results that the report was made of."""

    @classmethod
    def open(cls, out: Path, config: RunConfig, source: str, overwrite: bool) -> _Ledger:
        """Open or begin the ledger of ``out``; UsageError if it belongs to other settings or something else."""
        asked, path = {"verb": "run", "source": source, **configuration.result_settings(config)}, out / "run.json"
        before: dict[str, Any] = {}
        if path.is_file():
            before = store.json_object(path)
            try:
                own = parse_record(_LedgerRecord, before, str(path)).asked.get("verb") == "run"
            except InputError:
                own = False
            if not own:  # as the run.json of a single verb
                raise cls._foreign(out)
            if not store.check_holds(before):
                what, remedy = "the record of the run was altered after it was written", "restore the file"
                raise IntegrityError(what, where=str(path), remedy=f"choose another --out, or {remedy}")
            same = configuration.without_devices(before["asked"]) == asked
            if not same and not overwrite:
                differences = configuration.differences(before["asked"], asked)[:8]
                what, remedy = "the output folder holds a run with other settings", "add --overwrite to replace it"
                got = "; ".join(differences) or "another program version"
                raise UsageError(what, where=str(out), got=got, remedy=f"choose another --out, or {remedy}")
            before = before if same else {}
        ledger = cls(out, asked, before)
        ledger.save("running")
        store.write_text(out / "run.yaml", configuration.dump_yaml(config))
        return ledger

    @classmethod
    def refuse_foreign(cls, out: Path, source: str) -> None:
        """UsageError if a folder without a ledger holds files of something else."""
        own = {"lock", "scene"} if _is_own_scene(source, out) else {"lock"}
        if (out / "run.json").is_file() or not out.exists():
            return
        if not out.is_dir() or any(entry.name not in own and not is_temporary(entry.name) for entry in out.iterdir()):
            raise cls._foreign(out)

    @staticmethod
    def _foreign(out: Path) -> UsageError:
        what = "the output folder holds files that do not belong to this run"
        return UsageError(what, where=str(out), remedy="choose an empty --out")

    def _standing(self, name: str) -> str:
        """A step on a labelled scene, which of how many it is, and about how long the rest takes, by what the finished
        ones took."""
        if name not in PERCENT_OF_A_RUN:
            return name
        standing = f"{name}, step {list(PERCENT_OF_A_RUN).index(name) + 1} of {len(PERCENT_OF_A_RUN)}"
        done = [step for step in PERCENT_OF_A_RUN if self.steps.get(step, {}).get("state") == "complete"]
        share, spent = sum(PERCENT_OF_A_RUN[step] for step in done) / 100, self.seconds()
        left_min = sum(spent[step] for step in done) * (1 / max(share, FORECAST_FROM) - 1) / 60
        return f"{standing}, about {left_min:.0f} min left" if share >= FORECAST_FROM and left_min >= 1 else standing

    def timed(self, name: str, result: Path, run: Callable[[], Any]) -> Any:
        """Do one step, which makes a folder or file, and note what it took; of a folder, what its own record says. The
        next step begins with the memory that this one took given back."""
        from mudg.core.raster.cpu import release_memory

        log.info(f"== {self._standing(name)}")
        meter, self.steps[name] = Meter(), {"state": "interrupted"}
        try:
            made = run()
            release_memory()
            self.steps[name] = {"state": "complete"}
            return made
        finally:
            done = self.steps[name]["state"] == "complete"
            taken = store.json_object(result / store.RUN_STATE) if done else {}
            spent = Usage.of_record({**meter.stop().record(), **taken})
            self.steps[name] |= {**spent.record(), "written_bytes": folder_bytes(result)}
            self.save("running")

    def seconds(self) -> dict[str, float]:
        """Seconds per step, in order."""
        return {name: float(entry["seconds"]) for name, entry in self.steps.items()}

    def save(self, state: str) -> None:
        """Write OUT/run.json."""
        record = {"schema": 1, "state": state, "asked": self._asked, "steps": self.steps, "digests": self.digests}
        store.write_json(self._out / "run.json", store.with_check({**record, "environment": environment()}))
