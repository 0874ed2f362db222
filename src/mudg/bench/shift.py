"""``mudg bench shift``: whole methods beside the recorded path, on lists of generated logs, against exact truth.

Every log is ingested, fused and synthesized once; every method is fitted, rendered and scored on its own, by the ordinary
verbs, so that whatever is finished is reused and another variant costs only itself. Fits under virtual views go on with the one on
recorded views, as in ``mudg run`` (``bench/chain.py``). Results do not depend on how many logs are worked on at a time: each has
one thread.

    OUT/<log>/scene  fuse  synthesize  truth  nearest_fill  fit/<method>  start/<method>  render/<method>  score/<method>  film
    OUT/bench.json   every number        OUT/bench.md   the tables        OUT/page.html   tables and videos
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from mudg.base import config as configuration
from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.plain_yaml import parse_yaml
from mudg.base.run_folder import RunDir, VerbOutput, below, refuse_overlap
from mudg.base.types import Trajectory
from mudg.bench import shift_page, shift_tables
from mudg.bench.chain import (
    LONGER,
    LONGER_TITLE,
    VIRTUAL_TERMS,
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
from mudg.data.city import logs as city_logs
from mudg.data.city.logs import STANDARD, LogRules
from mudg.data.cloudfile import read_fused
from mudg.data.observations import OBSERVATION_FILES, ObservationWriter, read_observations
from mudg.data.scene import read_scene
from mudg.methods import PUBLISHED
from mudg.models.mdm import files as mdm_files
from mudg.report.score_tables import title_of
from mudg.stages import fuse, ingest, render, score, score_truth, synthesize
from mudg.stages.config import (
    BenchConfig,
    FitConfig,
    IngestConfig,
    PresetName,
    RenderConfig,
    ScoreConfig,
    SynthesizeConfig,
)

TEST_EVERY: Final = 4
PERCEPTUAL_VIEWS: Final = 12
WITHOUT, WITH, DIFFUSION, FILL = "street_gaussians", "mudg_s", "mudg_r", score.BASELINE
GENERATED: Final = (FILL, DIFFUSION)
"""Methods without a fit."""
ABLATION: Final[dict[str, tuple[str, Mapping[str, float]]]] = {
    **{name: (description, weights) for name, (_, description, weights) in VIRTUAL_TERMS.items()},
    "exact": ("the truth in place of generated views", {}),
}
"""Rows beside street_gaussians (no virtual views) and mudg_s (all terms): three as in table 3 of the paper, and the most that
virtual views can bring at this number of steps."""
EXACT: Final = "exact"
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]*")
_PAGES: Final = ("bench.json", "bench.md", "page.html")
_FILL_OUTPUT: Final = VerbOutput(FILL, 1, below("*", OBSERVATION_FILES))
_EXACT_OUTPUT: Final = VerbOutput(EXACT, 1, below("*", OBSERVATION_FILES))


@dataclass(frozen=True)
class Row:
    """A method to compare: its name in tables and folders, its title, and the settings of its fit (None = no fit; those of the first fit
    where it is ``LONGER``)."""

    name: str
    title: str
    fit: FitConfig | None


@dataclass(frozen=True)
class LogJob:
    """One log of the list, in terms that another process understands; ``renders``: whether the diffusion model uses those of a fit."""

    seed: int
    out: Path
    rules: LogRules
    shifts_m: tuple[float, ...]
    rows: tuple[Row, ...]
    config: BenchConfig
    synthesize: SynthesizeConfig
    renders: bool
    overwrite: bool

    @property
    def fits(self) -> FitChain:
        """The fits."""
        config, out = self.config, self.out
        return FitChain(
            out, out / "scene", out / "fuse", usual_fit(config), self.overwrite, config.continue_fit, self.synthesize
        )


def run(
    config: BenchConfig, out: Path, *, preset: PresetName = "default", overwrite: bool = False, rules: LogRules = STANDARD,
    distances_m: Sequence[float] = (2.0, 3.0, 4.0),
) -> Path:  # fmt: skip
    """Compare methods on the logs of a list; returns ``out`` with ``bench.json``, ``bench.md`` and ``page.html``.

    Args:
        config: see ``BenchConfig``; fields marked shift, and model, precision and seed. preset: what it started from.
        out: what lies there of the same settings is reused; other methods and variants may be added later.
        overwrite: replace what other settings left there.
        rules: frames, size and cameras of the logs. distances_m: lateral distances, each to both sides.

    Raises:
        UsageError: an unknown method, a malformed variant, a setting that no row uses, or ``out`` holds logs of other settings. Whatever
            a verb raises.
    """
    rows = rows_of(config, preset)
    refuse_overlap(out, {"model": mdm_files.folder_of(config.model)})
    refuse_foreign(Path(out), _PAGES, _is_own, lambda entry: entry.name.isdigit())
    seeds = city_logs.LISTS[config.list][: config.logs]
    shifts = tuple(sign * d for d in distances_m for sign in (1.0, -1.0))
    painted = replace(generator_of(config), cameras=("front",), shifts_m=shifts)
    renders = mdm_files.uses_renders(config.model)
    generates = any(row.name == DIFFUSION for row in rows)
    fits = [row.fit for row in rows if row.fit is not None]
    refuse_unfit(config, preset, fits=fits, generators=[painted] * generates, renders=renders)
    jobs = [
        LogJob(seed, Path(out) / str(seed), rules, (0.0, *shifts), rows, config, painted, renders, overwrite) for seed in seeds
    ]
    logs = each_log(make_log, jobs, [str(seed) for seed in seeds], at_once(config))
    document = shift_tables.document(
        logs, rows_as_values(rows), list(distances_m), {**settings_of(config, rules), **chain_settings(config, preset)}
    )
    store.write_json(Path(out) / "bench.json", document)
    store.write_text(Path(out) / "bench.md", shift_tables.markdown(document))
    store.write_text(Path(out) / "page.html", shift_page.page(document))
    return Path(out)


def _is_own(document: Mapping[str, Any]) -> bool:
    return document["schema"] == 1 and "bench" not in document and "methods" in document


# ---- what is compared ----


def rows_of(config: BenchConfig, preset: PresetName = "default") -> tuple[Row, ...]:
    """The methods, ablation rows and variants of a configuration, in the order of the tables.

    Raises:
        UsageError: an unknown method, one that does not know a setting beyond the preset, or a malformed or repeated variant.
    """
    known = (FILL, "gs3d", WITHOUT, LONGER, *PUBLISHED, DIFFUSION, WITH)
    wanted = set(config.methods) | ({WITHOUT, WITH} if config.ablation else set())
    if not wanted or wanted - set(known):
        raise UsageError("unknown method", where="--methods", expected=", ".join(known),
            got=", ".join(sorted(wanted - set(known))))  # fmt: skip
    plain = usual_fit(config)
    titles, methods = {LONGER: LONGER_TITLE}, {LONGER: WITHOUT}
    rows = [
        Row(
            name, titles.get(name, title_of(name)),
            None if name in GENERATED else method_fit(plain, methods.get(name, name), preset),
        )
        for name in known
        if name in wanted
    ]  # fmt: skip
    if config.ablation:
        for name, (description, weights) in ABLATION.items():
            rows.append(Row(name, f"with {description}", configuration.load(FitConfig, plain, overrides={"virtual": weights})))
    for text in config.variant:
        rows.append(variant_of(text, plain))
    names = [row.name for row in rows]
    if len(set(names)) < len(names):
        raise UsageError("two rows have the same name", where="--variant", got=", ".join(names))
    return tuple(rows)


def variant_of(text: str, plain: FitConfig) -> Row:
    """A row from ``NAME=FIELD:VALUE,FIELD:VALUE``; values as in YAML, a dot between a group and its field. UsageError if malformed or
    no field of ``FitConfig``."""
    name, separator, rest = text.partition("=")
    fields: dict[str, Any] = {}
    for part in rest.split(","):
        field, colon, value = part.partition(":")
        if not (separator and colon and field and _NAME.fullmatch(name)):
            raise UsageError("malformed variant", where="--variant", expected="NAME=FIELD:VALUE,FIELD:VALUE", got=text)
        try:
            fields[field.strip()] = parse_yaml(value, field)
        except InputError as error:
            raise UsageError("malformed value", where=f"--variant {name}: {field}", got=value) from error
    changed = configuration.load(FitConfig, plain, overrides=configuration.nested(fields))
    return Row(name, f"{name}: {rest}", changed)


def rows_as_values(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The rows for JSON."""
    return [
        {"name": r.name, "title": r.title, "fit": None if r.fit is None else configuration.result_settings(r.fit)} for r in rows
    ]


def settings_of(config: BenchConfig, rules: LogRules) -> dict[str, Any]:
    """What was asked for, for JSON."""
    return {
        "list": config.list, "iterations": config.iterations, "seed": config.seed, "model": mdm_files.digest(config.model),
        "renders": mdm_files.uses_renders(config.model),
        "frames": rules.frames, "size_px": [rules.width, rules.height], "cameras": list(rules.cameras),
        "held_out_every": TEST_EVERY, "ablation": config.ablation,
    }  # fmt: skip


# ---- the logs ----


def make_log(job: LogJob) -> dict[str, Any]:
    """Everything of one log; returns its facts, the scores of each method by distance, and the seconds of each step."""
    out = job.out
    city = city_logs.log_config(job.seed, job.rules)
    scene = out / "scene"
    made(lambda o: ingest.run(IngestConfig(test_every=TEST_EVERY, city=city), ingest.CITY, scene, overwrite=o), job.overwrite)
    fused, painted = out / "fuse", out / "synthesize"
    made(lambda o: fuse.run(job.config.fuse, scene, fused, overwrite=o), job.overwrite)
    if any(row.name == DIFFUSION or (row.fit is not None and learns_virtual(row.fit)) for row in job.rows):
        first = job.fits.first() if job.renders else None
        made(lambda o: synthesize.run(job.synthesize, scene, fused, painted, fitted=first, overwrite=o), job.overwrite)
    drawn = RenderConfig(cameras=("front",), shifts_m=job.shifts_m, video=False, device=job.config.device)
    paths = render.trajectories(read_scene(scene), drawn)
    truth = out / "truth"
    made(lambda o: score_truth.write_truth(scene, paths, truth, overwrite=o), job.overwrite)
    found: dict[str, Any] = {}
    views: dict[str, Path] = {}
    for row in job.rows:
        views[row.name] = _views_of(job, row, drawn, paths)
        found[row.name] = _scores_of(job, row, views[row.name])
    films: list[str] = []
    if job.config.videos:
        shown = {"truth": truth, **{row.name: views[row.name] for row in job.rows if row.name in shift_page.SHOWN}}
        # With another method the old films are out of date, whatever was asked.
        made(lambda o: shift_page.film(shown, paths, out / "film", overwrite=o), overwrite=True)
        films = [path.name for path in paths]
    facts = city_logs.facts(job.seed, job.rules)
    return {
        "log": job.seed, "turn_deg": round(facts.turn_deg, 2), "length_m": round(facts.length_m, 1), "movers": facts.moving,
        "mover_share": round(facts.moving_share, 4), "words": facts.description, "films": films, "values": found,
        "seconds": seconds_of(out),
    }  # fmt: skip


def _views_of(job: LogJob, row: Row, drawn: RenderConfig, paths: Sequence[Trajectory]) -> Path:
    """The folder with a method's views, made if need be."""
    scene, fused, painted = job.out / "scene", job.out / "fuse", job.out / "synthesize"
    if row.name == DIFFUSION:
        return painted
    if row.name == FILL:
        return made(lambda o: write_fill(scene, fused, paths, job.out / FILL, overwrite=o), job.overwrite)
    settings = row.fit
    if settings is None:
        raise UsageError("a method without views", got=row.name)
    if row.name == EXACT:
        painted = made(lambda o: write_exact(job.out / "truth", paths, job.out / EXACT, overwrite=o), job.overwrite)
    model, views = job.fits.fitted(row.name, settings, (painted,)), job.out / "render" / row.name
    return made(lambda o: render.run(drawn, scene, model, views, overwrite=o), job.overwrite)


def _scores_of(job: LogJob, row: Row, views: Path) -> dict[str, Any]:
    """A method's values by distance, from a score of its own against the common truth."""
    settings = ScoreConfig(baseline=False, error_pictures=False, perceptual_views=PERCEPTUAL_VIEWS, device=job.config.device)
    scene, truth, scored = job.out / "scene", job.out / "truth", job.out / "score" / row.name
    made(lambda o: score.run(settings, scene, {row.name: views}, scored, truth=truth, overwrite=o), job.overwrite)
    return {
        f"{entry['distance_m']:g}": entry["values"] for entry in store.read_json(scored / "metrics.json")["by_distance"]
    }


def write_fill(scene: Path, fused: Path, paths: Sequence[Trajectory], out: Path, *, overwrite: bool = False) -> Path:
    """The scorer's baseline on some trajectories as folders of views, so that it is a method like the others."""
    refuse_overlap(out, {"scene": scene, "fused": fused})
    inputs = {"scene": store.digest(scene), "fused": store.digest(fused)}
    folder = RunDir.open(out, _FILL_OUTPUT, {"trajectories": [path.name for path in paths]}, inputs, overwrite)
    if folder.complete:
        return folder.reused()
    fill = score.baseline_of(read_scene(scene), read_fused(fused))
    with log.task(FILL, sum(map(len, paths))) as bar:
        for path in paths:
            with ObservationWriter(folder.path / path.name, path.name, FILL) as writer:
                for index, view in enumerate(path.views):
                    writer.skip(view) if index < writer.done else writer.add(fill(view))
                    bar.advance()
    folder.finish({"trajectories": [path.name for path in paths]})
    return folder.path


def write_exact(truth: Path, paths: Sequence[Trajectory], out: Path, *, overwrite: bool = False) -> Path:
    """The truth of the shifted trajectories as if the diffusion model had painted it; nothing of the recorded path."""
    refuse_overlap(out, {"truth": truth})
    shifted = [path.name for path in paths if path.origin == "shifted"]
    folder = RunDir.open(out, _EXACT_OUTPUT, {"trajectories": shifted}, {"truth": store.digest(truth)}, overwrite)
    if folder.complete:
        return folder.reused()
    for name in shifted:
        views = read_observations(truth / name)
        with ObservationWriter(folder.path / name, name, EXACT) as writer:
            for index in range(len(views)):
                seen = views[index]
                writer.skip(seen.view) if index < writer.done else writer.add(replace(seen, kind="virtual", source=EXACT))
    folder.finish({"trajectories": shifted})
    return folder.path
