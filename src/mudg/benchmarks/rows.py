"""What benchmarks of complete methods compare: the tables of papers (``papers.yaml`` as checked records), and rows:
which methods, with what settings of their fits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

from mudg.base import config as configuration
from mudg.base import store
from mudg.base.errors import InputError, UsageError
from mudg.base.plain_yaml import parse_yaml
from mudg.base.records import StrictRecord, parse_record
from mudg.benchmarks.settings import BenchConfig, bench_preset
from mudg.diffusion import model_files, views
from mudg.diffusion.settings import SynthesizeConfig
from mudg.gaussians.recipes import recipe_of
from mudg.gaussians.settings import METHODS, PUBLISHED, UNFIT, WEIGHTS, FitConfig
from mudg.networks.inception import ResizeRule
from mudg.scoring import score
from mudg.scoring.tables import title_of
from mudg.steps.pipeline import WITHOUT_DIFFUSION, refuse_missing
from mudg.steps.settings import PresetName
from mudg.steps.step import flag_name

Facts = Mapping[str, Any]
"""What was measured, by name, as in JSON."""
FILE: Final = Path(__file__).with_name("papers.yaml")
RECORDED: Final = "0"
"""Name of the place that is the recorded path."""


class SceneRange(StrictRecord):
    """A segment of a dataset, by a part of its name, with its first and last frame (from 0, both included); ``side``:
    to which side one-sided shifts go (1 left, -1 right)."""

    segment: str
    first: int
    last: int
    side: int = 1


class PaperPlace(StrictRecord):
    """Where views are scored. ``name``: in result files. ``title``: in headings. ``shifts_m``: lateral shifts, metres,
    positive to the left (0 = the recorded path). ``paths``: further paths by name (``core.trajectory.named``); their
    scores are averaged."""

    name: str
    title: str
    shifts_m: list[float] = []
    paths: list[str] = []

    def endings(self, side: int = 1) -> tuple[str, ...]:
        """How the names of its trajectories end; ``side``: see `SceneRange`."""
        shifts = self.shifts_m if len(self.shifts_m) > 1 else [side * shift_m for shift_m in self.shifts_m]
        return (*("recorded" if not s else f"shift{s:+.1f}" for s in shifts), *self.paths)


class PaperColumn(StrictRecord):
    """A number of ``metrics.json``: its name there, heading, better side, digits, the setting of ``mudg score`` that it
    needs, and the entry of a result that holds its ``n`` (empty: the views that count)."""

    key: str
    title: str
    better: Literal["higher", "lower", "one"]
    digits: int
    needs: str = ""
    counts: Literal["", "distribution", "video"] = ""

    def values(self) -> dict[str, Any]:
        """For JSON."""
        return self.model_dump(exclude={"needs", "counts"})


class PaperRow(StrictRecord):
    """A row that is computed: a method of `METHODS`, with other settings of its fit (or of synthesize) where it is an
    ablation's."""

    name: str
    title: str
    method: str
    changes: dict[str, Any] = {}


class PublishedRow(StrictRecord):
    """What a paper prints for a method: place, column and number, and where it is printed."""

    title: str
    source: str
    values: list[tuple[str, str, float]]


class PaperTable(StrictRecord):
    """A table of a paper; the fields are explained in ``papers.yaml``. Without ``only`` every column stands at every
    place."""

    name: str
    title: str = ""
    data: str = ""
    scenes: str = ""
    places: list[PaperPlace]
    columns: list[PaperColumn]
    published: list[PublishedRow] = []
    only: dict[str, list[str]] = {}
    rows: list[PaperRow] = []
    front_only: bool = False
    all_cameras: bool = False
    held_out_every: int = 4
    size: str = ""
    resize: ResizeRule = "pytorch-fid"
    virtual_shifts_m: list[float] = []
    notes: list[str] = []

    def cells(self) -> tuple[tuple[PaperPlace, PaperColumn], ...]:
        """All places and columns, in the order of the table."""
        return tuple((p, c) for p in self.places for c in self.columns if c.key in self.only.get(p.name, (c.key,)))

    def values(self) -> dict[str, Any]:
        """For JSON, without published rows."""
        kept = {"name", "title", "data", "scenes", "notes", "places", "held_out_every", "front_only", "all_cameras"}
        cells = [[place.name, column.key] for place, column in self.cells()]
        return {**self.model_dump(include=kept), "cells": cells, "columns": [one.values() for one in self.columns]}


class Papers(StrictRecord):
    """All of ``papers.yaml``."""

    columns: dict[str, PaperColumn]
    further: dict[Literal["exact", "measured"], list[str]]
    scene_lists: dict[str, list[SceneRange]]
    tables: dict[str, PaperTable]


def read_papers(text: str, where: str) -> Papers:
    """The tables of a text in the form of ``papers.yaml``; names of columns and places stand for their records, and
    lines of text for published rows. InputError: it is not YAML, or not such tables."""
    raw = parse_yaml(text, where)
    try:
        columns = {key: {"key": key, **column} for key, column in raw["columns"].items()}
        tables = {
            name: {
                **table,
                "name": name,
                "columns": [columns[key] for key in table["columns"]],
                "places": [raw["places"][place] for place in table["places"]],
                "published": [row for group in table.get("published", ()) for row in _printed(**group)],
            }
            for name, table in raw["tables"].items()
        }
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        got = f"{type(error).__name__}: {error}"
        raise InputError("these are no tables of papers", where=where, got=got) from error
    records = {**{k: v for k, v in raw.items() if k != "places"}, "columns": columns, "tables": tables}
    return parse_record(Papers, records, f"{where}: ")


def _printed(source: str, cells: str, rows: str) -> list[dict[str, Any]]:
    """Published rows from ``title | numbers`` in the order of ``cells``, each ``place:column``; ``-``: not printed."""
    keys = [tuple(cell.split(":")) for cell in cells.split()]
    records = []
    for line in rows.strip().splitlines():
        title, _, numbers = line.partition("|")
        values = [(*key, float(word)) for key, word in zip(keys, numbers.split(), strict=True) if word != "-"]
        records.append({"title": title.strip(), "source": source, "values": values})
    return records


PAPERS: Final = read_papers(store.read_text(FILE), FILE.name)
TABLES: Final[Mapping[str, PaperTable]] = PAPERS.tables
SCENE_LISTS: Final[Mapping[str, Sequence[SceneRange]]] = PAPERS.scene_lists


FILL, BASE, DIFFUSION, FULL = score.BASELINE, WITHOUT_DIFFUSION, "mudg_r", "mudg_s"
LONGER: Final = f"{BASE}-longer"
"""The control of ``mudg_s``: goes on with the first fit until it has as many iterations, without generated views."""
LONGER_TITLE: Final = title_of(BASE) + ", as many iterations"
MIXED: Final = "mudg_f"
"""Renders of ``mudg_s``, each mixed with what the diffusion model makes of it (``mudg render --repair``)."""
REPAIRED: Final = "difix"
OTHER_METHODS: Final = {FILL: "", LONGER: BASE, MIXED: FULL}
"""Method of the rows that are not named by it."""
PLACES: Final = ("cameras", "shifts_m", "paths", "condition", "processes")
"""Settings of generated views that are the benchmark's matter, not the user's."""
SCENES: Final = (FILL, "gs3d", BASE, LONGER, *PUBLISHED, DIFFUSION, FULL, MIXED)
"""Methods that every benchmark of complete methods knows, in the order of the tables."""


@dataclass(frozen=True)
class Row:
    """A row that is computed. ``method``: of `METHODS`; empty = fused points, holes filled. ``fit``: settings of its
    fit (those of the first fit where it is ``LONGER``); None = no fit. ``changes``: other settings of its fit or of
    synthesize; ``model: ""`` = there is no model, so the row has no numbers."""

    name: str
    title: str
    method: str = ""
    fit: FitConfig | None = None
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def left_out(self) -> bool:
        """Whether it has no model, and so no numbers."""
        return self.changes.get("model") == ""

    @property
    def learns_virtual(self) -> bool:
        """Whether its fit uses generated views."""
        return self.fit is not None and "virtual" in METHODS[self.fit.method].supervision


# ---- settings ----


def generator_of(config: BenchConfig) -> SynthesizeConfig:
    """How views are generated, by the benchmark's model, number format, seed and device; one trajectory at a time."""
    own = {name: getattr(config, name) for name in ("model", "precision", "seed", "device")}
    return replace(config.synthesize, **own, processes=1)


def usual_fit(config: BenchConfig) -> FitConfig:
    """The settings of fits, as ``mudg run`` takes them for the whole chain."""
    return replace(config.fit, method=FULL, iterations=config.iterations, seed=config.seed, device=config.device)


def method_fit(usual: FitConfig, method: str, preset: PresetName) -> FitConfig:
    """The usual settings with a method. What a preset sets and a method for comparison does not know has its default
    there. UsageError: a setting beyond the preset that the method does not know."""
    named, plain = bench_preset(preset).fit, FitConfig()
    settings = configuration.load(FitConfig, usual, overrides={"method": method})
    for name in (*UNFIT.get(method, ()), *WEIGHTS.get(method, ())):
        group, _, setting = name.partition(".")
        own, set_by_preset = getattr(settings, group), getattr(getattr(named, group), setting)
        if getattr(own, setting) == set_by_preset:
            settings = replace(settings, **{group: replace(own, **{setting: getattr(getattr(plain, group), setting)})})
    recipe_of(method).check(settings, False)
    return settings


def settings_of(config: BenchConfig, preset: PresetName, which: Facts, how: Facts) -> dict[str, Any]:
    """What a benchmark runs with, for ``bench.json``: its own ``which`` logs and ``how``, and that of the chain."""
    generator = configuration.result_settings(generator_of(config))
    return {
        **which,
        "iterations": config.iterations,
        "seed": config.seed,
        "model": model_files.digest(config.model),
        **how,
        "preset": preset,
        "guided_share": config.guided_share,
        "fuse": configuration.result_settings(config.fuse),
        "fit": configuration.result_settings(usual_fit(config)),
        "synthesize": {name: value for name, value in generator.items() if name not in PLACES},
    }


def changed_settings(config: BenchConfig, usual: BenchConfig) -> list[str]:
    """Dotted names of the settings in which a configuration differs from another."""
    lines = configuration.differences(configuration.to_dict(usual), configuration.to_dict(config))
    return [line.partition(":")[0] for line in lines]


def refuse_unfit(config: BenchConfig, preset: PresetName, rows: Sequence[Row]) -> None:
    """Refuse, before anything is written, what the rows of a benchmark cannot follow or do not use. UsageError: a
    setting that no row uses (beyond the preset), weights that are asked for and not given, or a method that the model
    cannot serve. InputError: there is no such model."""
    fits = [row.fit for row in rows if row.fit is not None]
    virtual = [fit for fit in fits if METHODS[fit.method].learns_virtual]
    generated = [row.changes for row in rows if row.method and METHODS[row.method].made_by == "synthesize"]
    generators = [replace(generator_of(config), **changes) for changes in generated]
    repairs = next((row.name for row in rows if row.fit and (row.name == MIXED or row.fit.method == REPAIRED)), "")
    if repairs and not model_files.uses_renders(config.model):
        what, remedy = "repairs renders, and this diffusion model uses none", f"leave {repairs} out, or choose"
        raise UsageError(f"{repairs} {what}", where="--methods", got=config.model, remedy=f"{remedy} another --model")
    if fits and config.guided_share <= 1 and LONGER in config.methods:
        what = f"no fit has more iterations than {BASE}, so this row is the same"
        raise UsageError(what, where="--methods", got=LONGER, remedy="leave it out")
    idle = {
        "no row of this table generates views": () if generators or virtual else ("synthesize",),
        "no row of this table fits a scene": () if fits else ("fit", "iterations", "guided_share"),
        "no row of this table learns from virtual views": () if virtual else ("fit.virtual", "guided_share"),
    }
    for name in changed_settings(config, bench_preset(preset)):
        for reason, unused in idle.items():
            if any(name == one or name.startswith(f"{one}.") for one in unused):
                what = "this setting would change nothing"
                raise UsageError(what, where=flag_name(name), got=reason, remedy="leave it out")
    if generators or virtual:
        refuse_missing(generator_of(config), virtual[0] if virtual else FitConfig(), "--model")
    for generator in dict.fromkeys((*generators, *((generator_of(config),) if virtual else ()))):
        views.check_config(generator, fitted=False)


# ---- rows ----


def method_rows(config: BenchConfig, preset: PresetName = "default") -> tuple[Row, ...]:
    """Rows of the methods that are asked for, in the order of ``SCENES``. UsageError: an unknown method, or one that
    does not know a setting beyond the preset."""
    _refuse_unknown(config.methods, SCENES)
    usual, rows = usual_fit(config), list[Row]()
    for name in (name for name in SCENES if name in config.methods):
        title, method = LONGER_TITLE if name == LONGER else title_of(name), OTHER_METHODS.get(name, name)
        fit = None if name in (FILL, DIFFUSION) else method_fit(usual, method, preset)
        rows.append(Row(name, title, method, fit))
    return tuple(rows)


def paper_rows(config: BenchConfig, table: PaperTable, preset: PresetName = "default") -> tuple[Row, ...]:
    """The rows of a paper's table: its own where it has such, else the methods asked for (all of them, where none is
    named). UsageError: an unknown method, one that does not know a setting beyond the preset, or methods for a table
    that has rows of its own."""
    usual_methods = BenchConfig().methods
    if table.rows:
        if config.methods != usual_methods:
            got, what = ", ".join(config.methods), "this table has rows of its own"
            raise UsageError(what, where="--methods", expected="not given", got=got)
        rows = [Row(row.name, row.title, row.method, changes=row.changes) for row in table.rows]
    else:
        known = [name for method in METHODS for name in ((method, LONGER) if method == BASE else (method,))]
        methods = [name for name in config.methods if name != FILL]
        if config.methods == usual_methods:
            methods = [name for name in known if config.guided_share > 1 or name != LONGER]
        _refuse_unknown(methods, known, some=False)
        changes = {} if model_files.uses_renders(config.model) else {REPAIRED: {"model": ""}}
        titles = {LONGER: LONGER_TITLE, **{name: method.title for name, method in METHODS.items()}}
        named = [(name, OTHER_METHODS.get(name, name)) for name in methods]
        rows = [Row(name, f"{titles[name]} ({name})", of, changes=changes.get(name, {})) for name, of in named]
    complete = []
    for row in rows:
        if METHODS[row.method].made_by == "render" and not row.left_out:
            fit = method_fit(usual_fit(config), row.method, preset)
            row = replace(row, fit=configuration.load(FitConfig, fit, overrides=dict(row.changes)))
        complete.append(row)
    return tuple(complete)


def _refuse_unknown(names: Sequence[str], known: Sequence[str], some: bool = True) -> None:
    unknown = sorted(set(names) - set(known))
    if unknown or (some and not names):
        raise UsageError("unknown method", where="--methods", expected=", ".join(known), got=", ".join(unknown))
