"""``mudg bench real``: complete methods on real logs, against what the log recorded and the methods did not see.

A protocol (a row of ``real_protocols.PROTOCOLS``) says which frames, sweeps or cameras are hidden and what is scored. Per log and way of
hiding, the verbs of the chain are run with folders of their own. They are given scenes from which what is hidden was removed
(``data/scene/part.py``), so they cannot use it. Whatever is finished is verified and reused.

    OUT/<log>/scene                                         the whole log; read by truth and scores alone
    OUT/<log>/<split>/shown annotate scene asked            what the methods see; with labels; and places of held-out frames
    OUT/<log>/<split>/fuse adapt fit/<method> virtual/<sees>   what methods make of it; what the diffusion model sees
    OUT/<log>/<split>/nearest_fill generated/<sees> render/<method>   the views to score
    OUT/<log>/truth/<protocol>  OUT/<log>/score/<protocol>/<method>
    OUT/bench.json  OUT/bench.md  OUT/page.html
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

from mudg import native
from mudg.base import config as configuration
from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.processes import run_in_processes
from mudg.base.run_folder import RunDir, VerbOutput, is_temporary, refuse_overlap
from mudg.base.types import Scene
from mudg.bench import real_measure, real_page, real_tables, real_truth
from mudg.bench.chain import (
    LONGER,
    LONGER_TITLE,
    FitChain,
    at_once,
    chain_settings,
    generator_of,
    learns_virtual,
    made,
    method_fit,
    refuse_unfit,
    usual_fit,
)
from mudg.bench.real_protocols import (
    PROTOCOLS,
    SPLITS,
    HeldOut,
    Protocol,
    Split,
    first_camera,
    held_out,
    places_of,
)
from mudg.bench.shift import variant_of, write_fill
from mudg.data.scene import SCENE_FILES, read_scene
from mudg.data.scene.part import write_part
from mudg.methods import PUBLISHED
from mudg.models.mdm import files as mdm_files
from mudg.report.score_tables import title_of
from mudg.stages import adapt, annotate, fuse, ingest, render, score, synthesize
from mudg.stages.adapting.clips import why_not
from mudg.stages.config import (
    AdaptConfig,
    AnnotateConfig,
    BenchConfig,
    FitConfig,
    IngestConfig,
    PresetName,
    RenderConfig,
    on_device,
)

FILL, BASE, DIFFUSION, FULL = score.BASELINE, "street_gaussians", "mudg_r", "mudg_s"
_PAGES: Final = ("bench.json", "bench.md", "page.html")
_PART: Final = VerbOutput("part of a scene", 1, SCENE_FILES)
_NAME: Final = re.compile(r"[^A-Za-z0-9_.+-]+")


Sees = Literal["points", "renders", "adapted"]
"""How a method uses its diffusion model: with points and photographs alone, with renders of the first fit too, or this way and adapted
to the log."""
LESS: Final[dict[Sees, str]] = {"adapted": "", "renders": "-no-adapt", "points": "-no-renders"}
"""Ending of the names of methods, by what they use of the chain."""
_LESS_TITLES: Final[dict[Sees, str]] = {"adapted": "", "renders": ", model not adapted", "points": ", points alone"}


@dataclass(frozen=True)
class RealMethod:
    """A method to compare, as plain values.

    Args:
        name: in tables and folders. fit: method of ``mudg fit``; empty for methods without a fit. sees: how it uses the diffusion model,
            as far as model and log allow; empty for methods without one. settings: of its fit. varied: in place of those of all fits.
        longer: goes on with the first fit for as many iterations as fits under generated views do, without such views.
    """

    name: str
    fit: str = ""
    sees: Sees | Literal[""] = ""
    settings: FitConfig | None = None
    varied: bool = False
    longer: bool = False

    @property
    def title(self) -> str:
        """For tables."""
        if self.longer:
            return LONGER_TITLE
        if not self.sees or self.varied:
            return title_of(self.name)
        return title_of(self.name.removesuffix(LESS[self.sees])) + _LESS_TITLES[self.sees]


METHOD_ROWS: Final[tuple[RealMethod, ...]] = (
    RealMethod(FILL),
    RealMethod("gs3d", "gs3d"),
    RealMethod(BASE, BASE),
    RealMethod(LONGER, BASE, longer=True),
    *(RealMethod(name, name) for name in PUBLISHED),
    *(RealMethod(DIFFUSION + ending, sees=sees) for sees, ending in LESS.items()),
    *(RealMethod(FULL + ending, FULL, sees) for sees, ending in LESS.items()),
)
"""All methods; ``mudg_r`` and ``mudg_s`` are the chain of ``mudg run`` for recorded logs, the rows after each leave out parts of it."""
ABLATION: Final = (BASE, LONGER, *(row.name for row in METHOD_ROWS if row.sees))


@dataclass(frozen=True)
class SplitJob:
    """Everything of one log under one way of hiding, in terms that another process understands."""

    out: Path
    source: Path
    split: Split
    protocols: tuple[Protocol, ...]
    rows: tuple[RealMethod, ...]
    config: BenchConfig
    adapt: AdaptConfig
    overwrite: bool

    @property
    def folder(self) -> Path:
        """Of this way of hiding."""
        return self.out / self.split.name

    @property
    def scene(self) -> Path:
        """What the methods see, and the places of held-out frames."""
        return self.folder / "scene"

    @property
    def fused(self) -> Path:
        """The clouds."""
        return self.folder / "fuse"

    @property
    def fits(self) -> FitChain:
        """The fits."""
        return FitChain(self.folder, self.scene, self.fused, usual_fit(self.config), self.overwrite, self.config.continue_fit)


def run(
    config: BenchConfig, sources: Sequence[Path], out: Path, *, preset: PresetName = "default", overwrite: bool = False,
    adaptation: AdaptConfig | None = None,
) -> Path:  # fmt: skip
    """Compare methods on real logs; returns ``out`` with ``bench.json``, ``bench.md`` and ``page.html``.

    Args:
        config: see ``BenchConfig``; fields marked real, and model, precision and seed. preset: what it started from.
        sources: folders of dataset logs, or scenes made by ``mudg ingest``.
        out: what lies there of the same settings is reused; logs, protocols and methods may be added later.
        overwrite: replace what other settings left there.
        adaptation: how the diffusion model is adapted to a log; its model, cameras, precision and seed are those of ``config``.

    Raises:
        UsageError: no log, an unknown method or protocol, a setting that no row uses, two logs of one name, or ``out`` holds something
            else. Whatever a verb raises.
    """
    rows, protocols = rows_of(config, preset), protocols_of(config)
    logs = names_of(sources)
    refuse_overlap(
        out, {"model": mdm_files.folder_of(config.model), **{f"log {name}": path for name, path in logs.items()}}
    )
    _refuse_foreign(Path(out))
    generates = any(row.sees and not row.fit for row in rows)
    renders = mdm_files.uses_renders(config.model)
    fits = [row.settings for row in rows if row.settings is not None]
    refuse_unfit(config, preset, fits=fits, generators=[generator_of(config)] * generates, renders=renders)
    training = replace(adaptation or AdaptConfig(), model=config.model, processes=1, seed=config.seed)
    if renders:  # no other model is adapted
        training = replace(training, precision=config.precision)
    scenes = {name: _scene_of(config, path, Path(out) / name, overwrite) for name, path in logs.items()}
    splits = tuple(dict.fromkeys(protocol.split for protocol in protocols))
    jobs = [
        SplitJob(
            Path(out) / name, scene, SPLITS[split], tuple(p for p in protocols if p.split == split), rows, config,
            on_device(training, config.device), overwrite,
        )
        for name, scene in scenes.items() for split in splits
    ]  # fmt: skip
    found = _run_jobs(jobs, at_once(config))
    entries = [
        _entry_of(name, path, [f for j, f in zip(jobs, found) if j.out.name == name]) for name, path in scenes.items()
    ]
    document = real_tables.document(
        entries, [_row_values(row) for row in rows], protocols, {**settings_of(config), **chain_settings(config, preset)}
    )
    store.write_json(Path(out) / "bench.json", document)
    store.write_text(Path(out) / "bench.md", real_tables.markdown(document))
    store.write_text(Path(out) / "page.html", real_page.page(document, Path(out)))
    return Path(out)


# ---- what is compared, and on what ----


def rows_of(config: BenchConfig, preset: PresetName = "default") -> tuple[RealMethod, ...]:
    """The methods and variants of a configuration, in the order of the tables.

    Raises:
        UsageError: an unknown method, one that does not know a setting beyond the preset, or a malformed or repeated variant.
    """
    known = [row.name for row in METHOD_ROWS]
    unknown = sorted(set(config.methods) - set(known))
    if unknown or not config.methods:
        raise UsageError("unknown method", where="--methods", expected=", ".join(known), got=", ".join(unknown))
    wanted = {*config.methods, *(ABLATION if config.ablation else ())}
    if not config.continue_fit and LONGER not in config.methods:
        wanted -= {LONGER}
    usual = usual_fit(config)
    rows = [
        replace(row, settings=method_fit(usual, row.fit, preset) if row.fit else None) for row in METHOD_ROWS if row.name in wanted
    ]
    for text in config.variant:
        changed = variant_of(text, usual)
        learns = changed.fit is not None and learns_virtual(changed.fit)
        rows.append(RealMethod(changed.name, FULL, "adapted" if learns else "", changed.fit, varied=True))
    names = [row.name for row in rows]
    if len(set(names)) < len(names):
        raise UsageError("two rows have the same name", where="--variant", got=", ".join(names))
    return tuple(rows)


def protocols_of(config: BenchConfig) -> tuple[Protocol, ...]:
    """The protocols of a configuration, by name or family. UsageError if there is none of a name."""
    known = dict.fromkeys(name for protocol in PROTOCOLS for name in (protocol.family, protocol.name))
    unknown = sorted(set(config.protocols) - set(known))
    if unknown or not config.protocols:
        raise UsageError("unknown protocol", where="--protocols", expected=", ".join(known), got=", ".join(unknown))
    return tuple(protocol for protocol in PROTOCOLS if {protocol.family, protocol.name} & set(config.protocols))


def names_of(sources: Sequence[Path]) -> dict[str, Path]:
    """Name -> log: the last part of its path, in characters that every file system takes.

    Raises:
        UsageError: no log, or two of one name.
    """
    if not sources:
        raise UsageError("no log was given", expected="mudg bench real LOG... --out FOLDER")
    found: dict[str, Path] = {}
    for source in map(Path, sources):
        name = (
            _NAME.sub("_", source.resolve().stem if source.suffix == ".zip" else source.resolve().name).strip("._-")
            or "log"
        )
        if name in found or name in _PAGES:
            raise UsageError("two logs have the same name", where=str(source), got=name,
                             remedy="rename one, or prepare it with mudg ingest in a folder of another name")  # fmt: skip
        found[name] = source
    return found


def _scene_of(config: BenchConfig, source: Path, out: Path, overwrite: bool) -> Path:
    """A log as a scene: as it is, or imported with the settings of this configuration."""
    if ingest.is_scene(source):
        if config.resolution or config.frames:
            raise UsageError("a scene is taken as it is", where=str(source), got="--resolution or --frames",
                             remedy="leave them out, or give the dataset's own folder")  # fmt: skip
        return source
    settings = IngestConfig(resolution=config.resolution, frames=config.frames, test_every=0)
    try:
        return ingest.run(settings, source, out / "scene")
    except UsageError:
        if not overwrite:
            raise
        return ingest.run(settings, source, out / "scene", overwrite=True)


def _row_values(row: RealMethod) -> dict[str, Any]:
    changes = configuration.result_settings(row.settings) if row.varied else None
    return {"name": row.name, "title": row.title, "fit": row.fit, "sees": row.sees, "changes": changes}


def settings_of(config: BenchConfig) -> dict[str, Any]:
    """What was asked for, for JSON."""
    return {
        "protocols": list(config.protocols), "iterations": config.iterations, "seed": config.seed,
        "model": mdm_files.digest(config.model), "shown_cameras": list(config.shown), "resolution": config.resolution,
        "frames": config.frames, "virtual_shifts_m": list(config.synthesize.shifts_m),
    }  # fmt: skip


def _refuse_foreign(out: Path) -> None:
    """UsageError if the pages of something else lie where ours go, or ``out`` is a verb's folder."""
    if not out.exists():
        return
    names = [entry.name for entry in out.iterdir() if not is_temporary(entry.name)] if out.is_dir() else [out.name]
    foreign = [name for name in names if not (out / name).is_dir() and name not in _PAGES]
    if not foreign and _PAGES[0] in names:
        try:
            foreign = [] if store.read_json(out / _PAGES[0])["bench"] == "real" else [_PAGES[0]]
        except (InputError, KeyError, TypeError):
            foreign = [_PAGES[0]]
    if foreign:
        raise UsageError("the output folder holds files that do not belong to this run", where=str(out), got=", ".join(sorted(foreign)[:8]),
                         remedy="choose an empty --out")  # fmt: skip


# ---- one log under one way of hiding ----


def _run_jobs(jobs: Sequence[SplitJob], processes: int) -> list[dict[str, Any]]:
    """All jobs, several at a time with one thread each, in their order."""
    found: dict[int, dict[str, Any]] = {}
    with log.task("logs", len(jobs)) as bar, native.one_thread():
        for index, facts in run_in_processes(make_split, [(job,) for job in jobs], min(processes, len(jobs))):
            found[index] = facts
            bar.update(f"{jobs[index].out.name} {jobs[index].split.name}")
            bar.advance()
    return [found[index] for index in range(len(jobs))]


def make_split(job: SplitJob) -> dict[str, Any]:
    """Everything of one log under one way of hiding; returns values by protocol and method, facts, and why protocols were left out."""
    whole = read_scene(job.source)
    held = held_out(whole, job.split, job.config.shown)
    if held.reason:
        return {
            "split": job.split.name,
            "held_out": {},
            "diffusion": {},
            "protocols": {p.name: {"left_out": held.reason} for p in job.protocols},
        }
    write_seen(job, whole, held)
    cameras = _asked_cameras(job, whole, held)
    truths: dict[str, Path] = {}
    for protocol in job.protocols:
        folder = job.out / "truth" / protocol.name
        truths[protocol.name] = made(
            lambda o, p=protocol, f=folder: real_truth.write_targets(
                p, job.source, job.scene, held.frames, cameras, f, overwrite=o
            ),
            job.overwrite,
        )
    found: dict[str, Any] = {}
    wanted = [p for p in job.protocols if len(real_truth.read_targets(truths[p.name]))]
    for protocol in job.protocols:
        targets = real_truth.read_targets(truths[protocol.name])
        left_out = {} if protocol in wanted else {"left_out": targets.reason}
        found[protocol.name] = {"facts": targets.facts, "pictures": list(targets.pictures), "values": {}, **left_out}
    if wanted:
        made(lambda o: fuse.run(job.config.fuse, job.scene, job.fused, overwrite=o), job.overwrite)
    used: dict[str, dict[str, str]] = {}
    for row in job.rows if wanted else ():
        views, use = views_of(job, row, cameras)
        if use is not None:
            used[row.name] = {"sees": use.sees, "note": use.note}
        for protocol in wanted:
            scored = job.out / "score" / protocol.name / row.name
            made(
                lambda o, p=protocol, v=views, s=scored: real_measure.write_scores(
                    p, job.source, truths[p.name], v, s, overwrite=o, device=job.config.device
                ),
                job.overwrite,
            )
            found[protocol.name]["values"][row.name] = store.read_json(scored / "metrics.json")
    return {"split": job.split.name, "held_out": dict(held.facts), "diffusion": used, "protocols": found}


def write_seen(job: SplitJob, whole: Scene, held: HeldOut) -> None:
    """Write what the methods see: the shown frames and sweeps; these with the labels that they lack; the same with the places of
    held-out frames; and these places alone (``asked``), for rendering."""
    hidden, silent = set(held.frames), set(held.sweeps)
    frames = {f.id for f in whole.frames} - hidden
    sweeps = {s.id for s in whole.sweeps} - silent
    places = places_of(whole, held)
    inputs = {"log": store.digest(job.source)}
    shown = job.folder / "shown"
    _write(job, shown, inputs, lambda root: write_part(whole, root, frames, sweeps))
    settings = on_device(AnnotateConfig(processes=1), job.config.device)
    labels = shown
    if not all(annotate.wanted_labels(settings) <= set(f.labels) for f in whole.frames if f.id in frames):
        labels = job.folder / "annotate"
        made(lambda o: annotate.run(settings, shown, labels, overwrite=o), job.overwrite)
    labelled = read_scene(labels)
    inputs = {"shown": store.digest(labels), **inputs}
    _write(job, job.scene, inputs, lambda root: write_part(labelled, root, frames, sweeps, places))
    if places:
        _write(job, job.folder / "asked", inputs, lambda root: write_part(whole, root, (), (), places))


def _write(job: SplitJob, out: Path, inputs: dict[str, str], write: Callable[[Path], Scene]) -> None:
    """Write a part of a scene as a folder that is verified and reused."""

    def make(overwrite: bool) -> Path:
        folder = RunDir.open(out, _PART, {"split": job.split.name, "shown": list(job.config.shown)}, inputs, overwrite)
        if folder.complete:
            return folder.reused()
        scene = write(folder.path)
        folder.finish({"frames": len(scene.frames), "sweeps": len(scene.sweeps)})
        return folder.path

    made(make, job.overwrite)


def _asked_cameras(job: SplitJob, whole: Scene, held: HeldOut) -> tuple[str, ...]:
    """The cameras whose views are asked for."""
    if not job.split.all_cameras:
        return (first_camera(whole, job.config.shown),)
    hidden = {frame.view.camera.name for frame in places_of(whole, held)}
    return tuple(name for name in whole.cameras if name in hidden)


# ---- methods ----


def views_of(job: SplitJob, row: RealMethod, cameras: tuple[str, ...]) -> tuple[Path, DiffusionUse | None]:
    """The folder with a method's views at all places that are asked for, made if need be; and how it used the diffusion model."""
    places = job.folder / "asked" if (job.folder / "asked").is_dir() else job.scene
    drawn = RenderConfig(cameras=cameras, shifts_m=job.split.shifts_m, video=False, device=job.config.device)
    if row.name == FILL:
        paths = render.trajectories(read_scene(places), drawn)
        fill = job.folder / FILL
        return made(lambda o: write_fill(job.scene, job.fused, paths, fill, overwrite=o), job.overwrite), None
    use = diffusion_use(job, row.sees) if row.sees else None
    if use is not None and not row.fit:
        return generated(job, use, cameras, job.split.shifts_m, job.folder / "generated" / use.sees), use
    model, views = fitted(job, row, use, cameras), job.folder / "render" / row.name
    return made(lambda o: render.run(drawn, places, model, views, overwrite=o), job.overwrite), use


def fitted(job: SplitJob, row: RealMethod, use: DiffusionUse | None, cameras: tuple[str, ...]) -> Path:
    """The fit of a method, made if need be, with the generated views that it learns from: beside the recorded path, and where views
    of hidden frames are asked for."""
    if row.longer:
        return job.fits.longer(row.name)
    settings = row.settings or usual_fit(job.config)
    virtual: list[Path] = []
    if use is not None:
        camera = first_camera(read_scene(job.scene), job.config.shown)
        virtual.append(generated(job, use, (camera,), job.config.synthesize.shifts_m, job.folder / "virtual" / use.sees))
        if job.split.by_camera or job.split.block:
            virtual.append(generated(job, use, cameras, job.split.shifts_m, job.folder / "generated" / use.sees))
    beside = replace(generator_of(job.config), cameras=(first_camera(read_scene(job.scene), job.config.shown),))
    return replace(job.fits, generator=beside).fitted(row.name, settings, virtual)


@dataclass(frozen=True)
class DiffusionUse:
    """How a method uses the diffusion model on a log: what is left of what it asks for, the model, and a sentence about it."""

    sees: Sees
    model: str
    note: str = ""


def diffusion_use(job: SplitJob, asked: Sees) -> DiffusionUse:
    """How the diffusion model is used where a method asks for ``asked``; adapted to what the method sees of the log if need be.

    What the model or the log does not allow is left out, and the note says so.
    """
    given = job.config.model
    if asked == "points":
        return DiffusionUse("points", given)
    if not mdm_files.uses_renders(given):
        return DiffusionUse("points", given, "the model does not use renders, so it sees points alone")
    if asked == "renders":
        return DiffusionUse("renders", given)
    scene = read_scene(job.scene)
    settings = replace(job.adapt, cameras=(first_camera(scene, job.config.shown),))
    reason, folder = why_not(scene, settings), job.folder / "adapt"
    if not reason:
        first = job.fits.first()
        try:
            made(lambda o: adapt.run(settings, job.scene, job.fused, first, folder, overwrite=o), job.overwrite)
        except InputError as error:
            reason = f"{error.what}, {error.got}" if error.got else error.what
    if reason:
        return DiffusionUse("renders", given, f"the model was not adapted to the log: {reason}")
    record = store.read_json(folder / "adapt.json")
    numbers = f"{record['before']['psnr']:.2f} dB before, {record['after']['psnr']:.2f} dB after"
    if not record["adapted"]:
        return DiffusionUse("renders", given, f"adapting did not help ({numbers}), so the model was taken as it is")
    return DiffusionUse("adapted", str(folder / "model"), f"the model was adapted ({numbers})")


def generated(
    job: SplitJob, use: DiffusionUse, cameras: tuple[str, ...], shifts_m: tuple[float, ...], out: Path
) -> Path:
    """Views of the diffusion model, made if need be; on top of renders of the first fit unless it sees points alone."""
    settings = replace(generator_of(job.config), cameras=cameras, shifts_m=shifts_m, model=use.model)
    first = None if use.sees == "points" else job.fits.first()
    return made(
        lambda o: synthesize.run(settings, job.scene, job.fused, out, fitted=first, overwrite=o), job.overwrite
    )


# ---- the document ----


def _entry_of(name: str, scene: Path, splits: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A log with its facts and all its values."""
    loaded = read_scene(scene)
    cameras = {
        n: {"size_px": [c.width, c.height], "frames": len(loaded.frames_of(n))} for n, c in loaded.cameras.items()
    }
    return {
        "log": name, "id": loaded.id, "dataset": loaded.source.dataset, "digest": store.digest(scene), "cameras": cameras,
        "sweeps": len(loaded.sweeps), "tracks": len(loaded.tracks), "held_out": {s["split"]: s["held_out"] for s in splits},
        "diffusion": {s["split"]: s["diffusion"] for s in splits},
        "protocols": {protocol: found for s in splits for protocol, found in s["protocols"].items()},
    }  # fmt: skip
