"""``mudg bench paper``: a table of a paper, filled with our numbers, on generated cities or recorded logs.

A table (a row of ``paper_tables.TABLES``) says which frames, places and columns. Every log is prepared once; every method is fitted,
rendered and scored on its own, by the ordinary verbs, so that whatever is finished is reused and an interrupted table goes on. In
every table stand the truth (what it scores itself) and the fused points with holes filled.

    OUT/<log>/scene fuse virtual truth nearest_fill generated/<row> fit/<row> start/<row> render/<row> score/<row> film
    OUT/bench.json   every number   OUT/bench.md bench.csv bench.tex   the table   OUT/page.html   table and pictures
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from mudg.base import config as configuration
from mudg.base import store
from mudg.base.errors import UsageError
from mudg.base.run_folder import refuse_overlap
from mudg.base.types import Trajectory
from mudg.bench import paper_numbers, paper_page, paper_sets, paper_text, shift_page
from mudg.bench.chain import (
    LONGER,
    LONGER_TITLE,
    REPAIRED,
    FitChain,
    at_once,
    chain_settings,
    each_log,
    generator_of,
    learns_virtual,
    made,
    method_fit,
    refuse_foreign,
    refuse_unfit,
    seconds_of,
    usual_fit,
)
from mudg.bench.paper_logs import ListedCity, PaperLog, facts_of, logs_of, make_scene, missing_scenes, scored_cameras
from mudg.bench.paper_tables import RECORDED, TABLES, PaperRow, PaperTable, further_columns
from mudg.bench.shift import PERCEPTUAL_VIEWS, write_fill
from mudg.data.scene import read_scene
from mudg.methods import METHODS
from mudg.models.mdm import files as mdm_files
from mudg.models.published.files import is_published
from mudg.stages import fuse, render, score, score_truth, synthesize
from mudg.stages.config import (
    BenchConfig,
    FitConfig,
    PresetName,
    RenderConfig,
    ScoreConfig,
    SynthesizeConfig,
    on_device,
)
from mudg.stages.run import WITHOUT_DIFFUSION

FILL, TRUTH = score.BASELINE, "truth"
PAGES: Final = ("bench.json", "bench.md", "bench.csv", "bench.tex", "page.html")
ALL_VIEWS: Final = 1_000_000
SAMPLING: Final = (
    "steps", "sampler", "eta", "overlap", "align_depth", "full_size", "guidance", "guidance_rescale", "memory_budget_gb", "offload",
    "compiled",
)  # fmt: skip
"""Settings of generated views that published-type and small models do not share."""
PER_LOG: Final = ("detections", "lanes", "video_features")
"""Settings of a score that name what was made of the views of one log."""


@dataclass(frozen=True)
class PaperJob:
    """One log under a table, in terms that another process understands; ``renders``: whether the diffusion model uses those of a fit."""

    log: PaperLog
    out: Path
    table: PaperTable
    rows: tuple[PaperRow, ...]
    config: BenchConfig
    preset: PresetName
    score: ScoreConfig
    renders: bool
    overwrite: bool

    @property
    def fused(self) -> Path:
        """The clouds."""
        return self.out / "fuse"

    def fits(self, scene: Path) -> FitChain:
        """The fits."""
        return FitChain(self.out, scene, self.fused, usual_fit(self.config), self.overwrite, self.config.continue_fit)


@dataclass(frozen=True)
class Asked:
    """Which views of a log are asked for: cameras; trajectories of the table's places; and settings that name those off the path."""

    cameras: tuple[str, ...]
    paths: tuple[Trajectory, ...]
    off_path: SynthesizeConfig
    drawn: RenderConfig


def run(
    config: BenchConfig, sources: Sequence[Path], out: Path, *, preset: PresetName = "default", overwrite: bool = False
) -> Path:
    """Fill a table; returns ``out`` with ``bench.json``, the table as Markdown, CSV and LaTeX, and ``page.html``.

    Args:
        config: see ``BenchConfig``; fields marked paper, and model, precision, iterations and seed. preset: what it started from.
        sources: ``city:reported`` (or another list of cities), or folders of recorded logs.
        out: what lies there of the same settings is reused; logs and methods may be added later.
        overwrite: replace what other settings left there.

    Raises:
        UsageError: an unknown method or list, a setting that no row of the table uses, or ``out`` holds something else. InputError:
            methods have different numbers of views. Whatever a verb raises.
    """
    table, out = TABLES[config.table], Path(out)
    rows = rows_of(config, table)
    logs = logs_of(config, sources, table)
    read = {f"log {log.name}": log.source for log in logs if not isinstance(log, ListedCity)}
    models = {"model": mdm_files.folder_of(config.model), "freevs-model": config.freevs_model}
    refuse_overlap(out, {**models, **read, **weights_of(config.score)})
    digests = {name: store.digest(Path(path)) for name, path in weights_of(config.score).items()}  # told before any work: it may be missing
    digests |= {"freevs_model": mdm_files.digest(config.freevs_model)} if config.freevs_model else {}
    refuse_foreign(
        out, PAGES, lambda document: document["bench"] == "paper" and document["table"]["name"] == table.name
    )
    measured = on_device(score_settings(config.score, table), config.device)
    renders = mdm_files.uses_renders(config.model)
    counted = [row for row in rows if row.changes.get("model") != ""]
    fits = [fit_of(config, preset, row) for row in counted if METHODS[row.method].made_by == "render"]
    generators = [
        replace(generator_of(config), **row.changes) for row in counted if METHODS[row.method].made_by == "synthesize"
    ]
    refuse_unfit(config, preset, fits=fits, generators=generators, renders=renders)
    jobs = [PaperJob(log, out / log.name, table, rows, config, preset, of_log(measured, log.name), renders, overwrite) for log in logs]
    found = each_log(make_log, jobs, [log.name for log in logs], at_once(config))
    settings = {
        "list": str(sources[0]) if isinstance(logs[0], ListedCity) else "", "missing_scenes": list(missing_scenes(table, logs)),
        "iterations": config.iterations, "seed": config.seed, "model": mdm_files.digest(config.model), "renders": renders,
        "videos": config.videos, "score": configuration.result_settings(measured), "digests": digests, **chain_settings(config, preset),
    }  # fmt: skip
    together = paper_sets.pooled(found, out)
    document = paper_numbers.document(table, found, [_values_of(row) for row in rows], settings, together)
    store.write_json(out / "bench.json", document)
    for name, text in (("md", paper_text.markdown), ("csv", paper_text.csv_text), ("tex", paper_text.latex)):
        store.write_text(out / f"bench.{name}", text(document))
    store.write_text(out / "page.html", paper_page.page(document))
    return out


def rows_of(config: BenchConfig, table: PaperTable) -> tuple[PaperRow, ...]:
    """The rows to compute: those of a table of settings, else the methods asked for (all of them, where none is named).

    Raises:
        UsageError: an unknown method, or methods for a table that has rows of its own.
    """
    usual = BenchConfig().methods
    if table.rows:
        if config.methods != usual:
            raise UsageError(
                "this table has rows of its own", where="--methods", expected="not given", got=", ".join(config.methods)
            )
        if config.freevs_model:
            raise UsageError("this table has no row freevs", where="--freevs-model", got=f"--table {table.name}", remedy="leave it out")
        return table.rows
    known = with_control(tuple(METHODS))
    asked = tuple(name for name in config.methods if name != FILL)
    if config.methods == usual:
        asked = known if config.continue_fit else tuple(name for name in known if name != LONGER)
    unknown = sorted(set(asked) - set(known))
    if unknown:
        raise UsageError("unknown method", where="--methods", expected=", ".join(known), got=", ".join(unknown))
    if config.freevs_model and "freevs" not in asked:
        raise UsageError("no row freevs was asked for", where="--freevs-model", got=f"--methods {' '.join(config.methods)}",
                         remedy="leave it out, or add freevs to --methods")  # fmt: skip
    own: dict[str, dict[str, Any]] = {"freevs": {"condition": "freevs", "model": config.freevs_model}}
    if config.freevs_model and is_published(config.model):  # the row's own model is a small one, which samples in its own way
        own["freevs"] |= {name: getattr(SynthesizeConfig(), name) for name in SAMPLING}
    if not mdm_files.uses_renders(config.model):
        own[REPAIRED] = {"model": ""}
    control = PaperRow(LONGER, f"{LONGER_TITLE} ({LONGER})", WITHOUT_DIFFUSION)
    rows = {row.name: row for row in table.rows_of(tuple(name for name in asked if name != LONGER))} | {LONGER: control}
    return tuple(replace(rows[name], changes=own.get(rows[name].method, rows[name].changes)) for name in asked)


def fit_of(config: BenchConfig, preset: PresetName, row: PaperRow) -> FitConfig:
    """The settings of a row's fit."""
    return configuration.load(FitConfig, method_fit(usual_fit(config), row.method, preset), overrides=dict(row.changes))


def with_control(methods: tuple[str, ...]) -> tuple[str, ...]:
    """All methods, and after the one without diffusion the control that has as many iterations as those with it."""
    after = methods.index(WITHOUT_DIFFUSION) + 1
    return (*methods[:after], LONGER, *methods[after:])


def score_settings(config: ScoreConfig, table: PaperTable) -> ScoreConfig:
    """How every row of a table is scored: the table's resize rule unless another was asked for; LPIPS, if computed,
    at all views."""
    resize = table.resize if config.fid_resize == ScoreConfig().fid_resize else config.fid_resize
    views = ALL_VIEWS if config.lpips_weights else PERCEPTUAL_VIEWS
    return replace(config, baseline=False, error_pictures=False, fid_resize=resize, perceptual_views=views)


def of_log(config: ScoreConfig, log: str) -> ScoreConfig:
    """How the rows of one log are scored: where a folder of detections, lanes or features has an entry of the log's name (or such a
    ``.json``), that one is taken."""
    own: dict[str, Any] = {}
    for name in PER_LOG:
        given = getattr(config, name, "")
        found = [path for ending in ("", ".json") if given and (path := Path(given) / f"{log}{ending}").exists()]
        own |= {name: str(found[0])} if found else {}
    return replace(config, **own)


def weights_of(config: ScoreConfig) -> dict[str, str]:
    """Files and folders that a score reads: setting -> path."""
    found = {name: value for name, value in configuration.to_dict(config).items() if isinstance(value, str) and value}
    return {name: value for name, value in found.items() if name.endswith("weights") or Path(value).exists()}


def _values_of(row: PaperRow) -> dict[str, Any]:
    return {"name": row.name, "title": row.title, "method": row.method, "changes": dict(row.changes)}


# ---- one log ----


def make_log(job: PaperJob) -> dict[str, Any]:
    """Everything of one log; returns its facts, per row and place the values with their numbers of views, and seconds."""
    scene = make_scene(job.log, job.table, job.out, job.config.device, job.overwrite)
    made(lambda o: fuse.run(job.config.fuse, scene, job.fused, overwrite=o), job.overwrite)
    asked = asked_of(job, scene)
    truth: Path | None = None
    if isinstance(job.log, ListedCity):
        truth = made(lambda o: score_truth.write_truth(scene, asked.paths, job.out / TRUTH, overwrite=o), job.overwrite)
    fill = made(lambda o: write_fill(scene, job.fused, asked.paths, job.out / FILL, overwrite=o), job.overwrite)
    left_out = [row.name for row in job.rows if row.changes.get("model") == ""]
    views = {
        FILL: (fill,),
        **{row.name: views_of(job, row, scene, asked) for row in job.rows if row.name not in left_out},
    }
    scored = {name: scores_of(job, name, folders, scene, truth) for name, folders in views.items()}
    if truth is not None:
        scored[TRUTH] = scores_of(job, TRUTH, (truth,), scene, truth)
    names = {place.name: names_at(place.endings(job.log.side), asked.cameras) for place in job.table.places}
    columns = tuple(dict.fromkeys((*job.table.columns, *further_columns(truth is not None))))
    values = {
        name: {place: paper_numbers.at_place(tuple(documents.values()), at, columns) for place, at in names.items()}
        for name, documents in scored.items()
    }  # fmt: skip
    places = {
        name: {place: paper_sets.files_at(documents, at, job.out.parent) for place, at in names.items()}
        for name, documents in scored.items()
    }
    if truth is None:
        places[TRUTH] = {place: paper_sets.halves(files) for place, files in places[FILL].items()}
    for name in left_out:
        why = "the model uses no renders" if name == REPAIRED else "no model: --freevs-model"
        values[name] = dict.fromkeys(names, {column.key: {"value": why} for column in columns})
    if truth is None:
        values[TRUTH] = {place: paper_numbers.floors_at(tuple(scored[FILL].values()), at, columns) for place, at in names.items()}
    shown = {**({} if truth is None else {TRUTH: truth}), **views}
    # With another method the old pictures are out of date, whatever was asked.
    made(
        lambda o: shift_page.film(shown, asked.paths, job.out / "film", videos=job.config.videos, overwrite=o), overwrite=True
    )
    return {
        **facts_of(job.log, read_scene(scene)), "exact": truth is not None, "values": values, "features": places,
        "made": paper_numbers.made_of(tuple(scored[FILL].values())),
        "films": [path.name for path in asked.paths], "columns": list(shown), "seconds": seconds_of(job.out),
    }  # fmt: skip


def names_at(endings: Sequence[str], cameras: Sequence[str]) -> tuple[str, ...]:
    """Names of the trajectories of a place."""
    return tuple(f"{camera}_{ending}" for camera in cameras for ending in endings)


def asked_of(job: PaperJob, scene: Path) -> Asked:
    """Which views of a log a table asks for."""
    loaded, table, side = read_scene(scene), job.table, job.log.side
    cameras = scored_cameras(loaded, table)
    shifts = tuple(dict.fromkeys(s if len(p.shifts_m) > 1 else side * s for p in table.places for s in p.shifts_m))
    further = tuple(dict.fromkeys(name for place in table.places for name in place.paths))
    drawn = RenderConfig(cameras=cameras, shifts_m=shifts, paths=further, video=False, device=job.config.device)
    off = tuple(s for s in shifts if s) or table.virtual_shifts_m
    return Asked(
        cameras,
        render.trajectories(loaded, drawn),
        replace(generator_of(job.config), cameras=cameras, shifts_m=off, paths=further),
        drawn,
    )


def views_of(job: PaperJob, row: PaperRow, scene: Path, asked: Asked) -> tuple[Path, ...]:
    """The folders with a row's views at all places, made if need be."""
    fits = replace(job.fits(scene), generator=asked.off_path)
    whole_condition = row.changes.get("condition", "full") == "full"
    if METHODS[row.method].made_by == "synthesize":
        first = fits.first() if job.renders and whole_condition else None
        found = []
        if any(path.origin != "recorded" for path in asked.paths):
            folder = job.out / "generated" / row.name if row.changes else job.out / "virtual"
            found.append(_generated(job, replace(asked.off_path, **row.changes), scene, first, folder))
        if any(path.origin == "recorded" for path in asked.paths):
            on_path = replace(asked.off_path, shifts_m=(0.0,), paths=(), **row.changes)
            found.append(_generated(job, on_path, scene, first, job.out / "generated" / f"{row.name}-{RECORDED}"))
        return tuple(found)
    settings = fit_of(job.config, job.preset, row)
    virtual: tuple[Path, ...] = ()
    if learns_virtual(settings):
        first = fits.first() if job.renders else None
        virtual = (_generated(job, asked.off_path, scene, first, job.out / "virtual"),)
    model, views = fits.fitted(row.name, settings, virtual), job.out / "render" / row.name
    return (made(lambda o: render.run(asked.drawn, scene, model, views, overwrite=o), job.overwrite),)


def _generated(job: PaperJob, settings: SynthesizeConfig, scene: Path, fitted: Path | None, out: Path) -> Path:
    return made(lambda o: synthesize.run(settings, scene, job.fused, out, fitted=fitted, overwrite=o), job.overwrite)


def scores_of(
    job: PaperJob, name: str, folders: Sequence[Path], scene: Path, truth: Path | None
) -> dict[Path, Mapping[str, Any]]:
    """What the scorer says of every folder of a row's views, by its own folder; the truth needs no networks that compare view with view."""
    settings = replace(job.score, perceptual_views=0, lpips_weights="") if name == TRUTH else job.score
    found = {}
    for number, folder in enumerate(folders):
        scored = job.out / "score" / (f"{name}-{number}" if number else name)
        made(
            lambda o, f=folder, s=scored: score.run(settings, scene, {name: f}, s, truth=truth, overwrite=o),
            job.overwrite,
        )
        found[scored] = store.read_json(scored / "metrics.json")
    return found
