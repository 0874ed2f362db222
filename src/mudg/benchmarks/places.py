"""The logs of benchmarks: lists of generated cities and recorded logs, their scenes, what of a log the methods do not
see, and the views of every row at the places of a table, with their scores. docs/bench_*.md list the folders."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from mudg.base import store
from mudg.base.devices import DeviceName
from mudg.base.errors import InputError, UsageError
from mudg.base.layout import SCENE_FILES
from mudg.base.run_folder import RunDir, refuse_overlap
from mudg.base.types import Frame, Scene, Trajectory
from mudg.benchmarks.chain import Chain, Film, run_step
from mudg.benchmarks.rows import FILL, RECORDED, SCENE_LISTS, PaperTable, Row, generator_of
from mudg.benchmarks.settings import BenchConfig
from mudg.city import logs as city_logs
from mudg.city.config import CityConfig
from mudg.city.logs import STANDARD
from mudg.city.world import CityWorld
from mudg.diffusion.settings import SynthesizeConfig
from mudg.editing import render
from mudg.editing.settings import RenderConfig, ScoreConfig
from mudg.formats import ingest
from mudg.formats.importers.common import holdout_split, parse_frame_range, parse_resolution
from mudg.formats.settings import IngestConfig
from mudg.gaussians.settings import METHODS
from mudg.labels import annotate
from mudg.labels.settings import AnnotateConfig
from mudg.scene.read import read_scene
from mudg.scene.write import write_part
from mudg.steps.engine import Output
from mudg.steps.ingest import Annotate, Ingest
from mudg.steps.render import DrawTruth, Score
from mudg.steps.settings import on_device

CITY: Final = "city:"
"""How the name of a list of generated cities begins."""
SHOWN_BETWEEN: Final = 3
"""Fewest shown moments before, between and after blocks of held-out ones, where a log is long enough for it."""
_NAME: Final = re.compile(r"[^A-Za-z0-9_.+-]+")


# ---- which logs ----


@dataclass(frozen=True)
class Log:
    """A log of a benchmark. ``name``: of its folder. ``source``: a dataset's log or a scene, or what a city is
    generated with. ``frames``: first and last frame (both included), or None for all. ``size``: of imported images
    (empty = as recorded). ``side``: of one-sided shifts. ``note``: what is to be said of it. ``identity``: where the
    name of a segment is looked for: the name of a recorded log's folder, and the id of a scene."""

    name: str
    source: Path | CityConfig
    frames: tuple[int, int] | None = None
    size: str = ""
    side: int = 1
    note: str = ""
    identity: str = ""


def logs_of(config: BenchConfig, sources: Sequence[Path], table: PaperTable) -> tuple[Log, ...]:
    """The logs that a table is filled with. ``sources``: ``city:NAME`` alone (see ``city/logs.py``), or folders of
    recorded logs. UsageError: no log, an unknown list, lists and folders together, or settings that make no sense for
    them."""
    names = [str(source) for source in sources]
    lists = [name.removeprefix(CITY) for name in names if name.startswith(CITY)]
    if not names or (lists and len(names) > 1):
        what = "a list of cities stands alone" if names else "no logs to fill the table with"
        expected = f"{CITY}reported, {CITY}development, or folders of logs"
        raise UsageError(what, where=f"mudg bench paper --table {table.name}", expected=expected, got=" ".join(names))
    if lists:
        return _cities(config, lists[0], table)
    if config.logs != BenchConfig().logs:
        what = "recorded logs are counted by naming them"
        raise UsageError(what, where="--logs", got=str(config.logs), remedy="leave it out")
    return tuple(_recorded(config, name, source, table) for name, source in names_of(sources).items())


def _cities(config: BenchConfig, name: str, table: PaperTable) -> tuple[Log, ...]:
    if name not in city_logs.LISTS:
        known = ", ".join(CITY + one for one in city_logs.LISTS)
        raise UsageError("no such list of cities", expected=known, got=CITY + name)
    size, frames = parse_resolution(config.resolution), parse_frame_range(config.frames)
    if isinstance(size, int) or (frames is not None and frames[0] != 0):
        what, got = "a generated city takes a whole size and frames from 0 on", f"{config.resolution} {config.frames}"
        raise UsageError(what, expected="--resolution WIDTHxHEIGHT, --frames 0:END", got=got.strip())
    width, height = size or (STANDARD.width, STANDARD.height)
    cameras, count = ("front",) if table.front_only else STANDARD.cameras, frames[1] if frames else STANDARD.n_frames
    rules = replace(STANDARD, n_frames=count, width=width, height=height, cameras=cameras)
    return listed_cities(name, config.logs, rules)


def listed_cities(name: str, count: int, rules: CityConfig) -> tuple[Log, ...]:
    """The first cities of a list."""
    return tuple(Log(str(seed), city_logs.log_config(seed, rules)) for seed in city_logs.LISTS[name][:count])


def _recorded(config: BenchConfig, name: str, source: Path, table: PaperTable) -> Log:
    limits = parse_frame_range(config.frames)
    frames = (limits[0], limits[1] - 1) if limits else None
    segments, note, prepared = SCENE_LISTS.get(table.scenes, ()), "", ingest.is_scene(source)
    identity = f"{source.name} {read_scene(source).id if prepared else ''}"
    segment = next((one for one in segments if one.segment in identity), None)
    if segment is not None and frames is None:
        frames = (segment.first, segment.last)
    elif segments and segment is None:
        note = f"not in the table's list {table.scenes}"
    elif segment is not None and frames != (segment.first, segment.last):
        note = f"the table's frames are {segment.first} to {segment.last}"
    if config.resolution and prepared:
        remedy = "leave it out, or give the dataset's own folder"
        raise UsageError("a scene's images keep their size", where=str(source), got="--resolution", remedy=remedy)
    size = "" if prepared else config.resolution or table.size
    return Log(name, source, frames, size, 1 if segment is None else segment.side, note, identity)


def missing_scenes(table: PaperTable, logs: Sequence[Log]) -> list[str]:
    """Segments of the table's list that no recorded log belongs to; none where cities are scored."""
    identities = " ".join(log.identity for log in logs).strip()
    return [one.segment for one in SCENE_LISTS.get(table.scenes, ()) if identities and one.segment not in identities]


def names_of(sources: Sequence[Path]) -> dict[str, Path]:
    """Name -> log: the last part of its path, in characters that every file system takes. UsageError: no log, two of
    one name, or one that is the name of a page."""
    if not sources:
        raise UsageError("no log was given", expected="mudg bench real LOG... --out FOLDER")
    named: dict[str, Path] = {}
    for source in map(Path, sources):
        name = _NAME.sub("_", source.resolve().name).strip("._-") or "log"
        if name in named or name in ("bench.json", "bench.md", "page.html"):
            remedy = "rename one, or prepare it with mudg ingest in a folder of another name"
            raise UsageError("two logs have the same name", where=str(source), got=name, remedy=remedy)
        named[name] = source
    return named


# ---- scenes ----


def make_scene(log: Log, table: PaperTable, out: Path, device: DeviceName, overwrite: bool) -> Path:
    """The scene of a log under the rules of a table, made if need be. ``out``: folder of the log. ``device``: of the
    labeller's network. ``overwrite``: replace what other settings left there. InputError: the log has fewer frames than
    the table asks for. Whatever a verb raises."""
    if isinstance(log.source, CityConfig):
        settings = IngestConfig(test_every=table.held_out_every, city=log.source)
        return run_step(Ingest(log=ingest.CITY, out=out / "scene", overwrite=overwrite, settings=settings))
    refuse_overlap(out, {"log": log.source})
    whole, frames = log.source, log.frames
    if not ingest.is_scene(whole):
        text = "" if frames is None else f"{frames[0]}:{frames[1] + 1}"
        settings = IngestConfig(test_every=0, resolution=log.size, frames=text)
        step = Ingest(log=str(log.source), out=out / "imported", overwrite=overwrite, settings=settings)
        whole, frames = run_step(step), None
    shown = run_step(ShownFrames(scene=whole, frames=frames, table=table, out=out / "shown", overwrite=overwrite))
    return labelled(shown, out / "scene", device, overwrite)


def labelled(scene: Path, out: Path, device: DeviceName, overwrite: bool) -> Path:
    """A scene as it is, or a copy with the labels that it lacks in its training frames."""
    settings = on_device(AnnotateConfig(processes=1), device)
    if all(annotate.wanted_labels(settings) <= set(frame.labels) for frame in read_scene(scene).frames):
        return scene
    return run_step(Annotate(scene=scene, out=out, overwrite=overwrite, settings=settings))


def imported(config: BenchConfig, source: Path, out: Path, overwrite: bool) -> Path:
    """A log as a scene: as it is, or imported with the settings of this configuration."""
    if not ingest.is_scene(source):
        settings = IngestConfig(resolution=config.resolution, frames=config.frames, test_every=0)
        return run_step(Ingest(log=str(source), out=out, overwrite=overwrite, settings=settings))
    if config.resolution or config.frames:
        got, remedy = "--resolution or --frames", "leave them out, or give the dataset's own folder"
        raise UsageError("a scene is taken as it is", where=str(source), got=got, remedy=remedy)
    return source


class ShownFrames(Output):
    """The table's frames of a scene, with its rule of what is held out."""

    verb_name = "frames of a table"
    version, files = 1, SCENE_FILES
    scene: Path
    frames: tuple[int, int] | None
    table: PaperTable

    def key_settings(self) -> dict[str, Any]:
        return {"frames": self.frames, "held_out_every": self.table.held_out_every, "front_only": self.table.front_only}

    def make(self, work: RunDir) -> dict[str, Any]:
        scene = read_scene(self.scene)
        camera = first_camera(scene, ())
        times = np.array(sorted(frame.view.time_s for frame in scene.frames_of(camera)))
        first, last = self.frames or (0, len(times) - 1)
        if self.frames is not None and len(times) == last - first + 1:
            first, last = 0, len(times) - 1  # imported with these very frames
        if last >= len(times):
            what, got = "the log has fewer frames than the table asks for", f"{len(times)} frames of camera {camera}"
            remedy = "give the whole log, or choose --frames"
            raise InputError(what, where=str(self.scene), expected=f"frames {first} to {last}", got=got, remedy=remedy)
        moment = lambda time_s: int(np.argmin(np.abs(times - time_s)))
        chosen = [frame for frame in scene.frames if first <= moment(frame.view.time_s) <= last]
        if self.table.front_only:
            chosen = [frame for frame in chosen if frame.view.camera.name == camera]
        sweeps = [sweep.id for sweep in scene.sweeps if first <= moment(sweep.time_s) <= last]
        groups = [[f.id for f in chosen if moment(f.view.time_s) == number] for number in range(first, last + 1)]
        held = [name for name, part in holdout_split(groups, self.table.held_out_every).items() if part == "test"]
        write_part(scene, work.path, {frame.id for frame in chosen}, sweeps, held_out=held)
        return {"frames": len(chosen), "held_out": len(held)}


# ---- what is hidden of a real log, and scored ----

MapName = Literal["photo", "depth", "seen", "dynamic", "color"]


@dataclass(frozen=True)
class Split:
    """What of a log the methods see. ``name``: also of its folder. ``block``: length of the blocks of held-out moments
    (0 = none). ``by_camera``: only the chosen cameras are shown. ``all_cameras``: views of all cameras are asked for
    that have held-out frames; else of the first. ``shifts_m``: of the views that are asked for, positive to the
    left."""

    name: str
    block: int = 0
    by_camera: bool = False
    all_cameras: bool = True
    shifts_m: tuple[float, ...] = (0.0,)


@dataclass(frozen=True)
class Protocol:
    """Which views are scored, against what, in which columns. ``family``: as asked for with ``--protocols``.
    ``split``: name of a ``Split``. ``maps``: what the truth of a view holds. ``columns``: names in
    ``columns.COLUMNS``, in the order of the table. ``shifts_m``: of the scored views. ``every``: every n-th view of a
    camera counts, beginning with the second where n > 1. ``pooled``: a log's value is that of all its places together,
    so that a place weighs what it adds to the sums; else their mean."""

    name: str
    family: str
    title: str
    split: str
    maps: tuple[MapName, ...]
    columns: tuple[str, ...]
    shifts_m: tuple[float, ...] = (0.0,)
    every: int = 1
    pooled: bool = False


SPLITS: Final[dict[str, Split]] = {
    **{f"gap-{block}": Split(f"gap-{block}", block) for block in (1, 3, 5)},
    "camera": Split("camera", by_camera=True),
    "all": Split("all", all_cameras=False, shifts_m=(2.0, -2.0, 3.0, -3.0)),
}
_GAP: Final = ("psnr", "ssim", "perceptual", "psnr_dynamic", "psnr_upper", "abs_rel")
_CAMERA: Final = ("psnr_seen", "perceptual_seen", "abs_rel_seen", "rmse_seen", "delta1_seen")
_LIDAR: Final = (
    *("abs_rel_static", "rmse_static", "delta1_static", "abs_rel_dynamic", "rmse_dynamic", "delta1_dynamic"),
    *("point_psnr_static", "point_abs_static", "point_psnr_dynamic", "point_abs_dynamic"),
)
_ALL: Final = ("photo", "depth", "dynamic")
_SEEN: Final = ("photo", "depth", "seen")
_POINTS: Final = ("depth", "dynamic", "color")
PROTOCOLS: Final[tuple[Protocol, ...]] = (
    Protocol("gap-1", "gap", "Single held-out frames", "gap-1", _ALL, _GAP),
    Protocol("gap-3", "gap", "Blocks of 3 held-out frames", "gap-3", _ALL, _GAP),
    Protocol("gap-5", "gap", "Blocks of 5 held-out frames", "gap-5", _ALL, _GAP),
    Protocol("camera", "camera", "Cameras that the methods never saw", "camera", _SEEN, _CAMERA, every=2, pooled=True),
    Protocol("lidar", "lidar", "LiDAR beside the recorded path", "all", _POINTS, _LIDAR, (2.0, -2.0, 3.0, -3.0)),
)


def protocols_of(names: Sequence[str]) -> tuple[Protocol, ...]:
    """Protocols by name or family. UsageError if there is none of a name."""
    known = dict.fromkeys(name for protocol in PROTOCOLS for name in (protocol.family, protocol.name))
    unknown = sorted(set(names) - set(known))
    if unknown or not names:
        raise UsageError("unknown protocol", where="--protocols", expected=", ".join(known), got=", ".join(unknown))
    return tuple(protocol for protocol in PROTOCOLS if {protocol.family, protocol.name} & set(names))


@dataclass(frozen=True)
class HeldOut:
    """What a split hides of a log: ids of frames and sweeps, and facts for people. ``reason``: why the log cannot be
    split so."""

    frames: tuple[str, ...] = ()
    sweeps: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)
    reason: str = ""

    def places(self, scene: Scene) -> tuple[Frame, ...]:
        """The held-out frames of a scene."""
        hidden = set(self.frames)
        return tuple(frame for frame in scene.frames if frame.id in hidden)


def blocks_of(moments: int, length: int) -> tuple[range, ...]:
    """Blocks of ``length`` held-out moments, spread evenly among ``moments``; the first and the last one are shown. As
    many as leave ``SHOWN_BETWEEN`` shown moments before, between and after them, but at least one, where it fits."""
    if moments < length + 2:
        return ()
    count = max(1, (moments - SHOWN_BETWEEN) // (length + SHOWN_BETWEEN))
    shown = moments - count * length
    starts = [round((i + 1) * shown / (count + 1)) + i * length for i in range(count)]
    return tuple(range(start, start + length) for start in starts)


def first_camera(scene: Scene, wanted: Sequence[str]) -> str:
    """The camera of the views beside the recorded path: the first of those asked for, else ``front``, else the first of
    all."""
    return next(iter(wanted), "front" if "front" in scene.cameras else next(iter(scene.cameras)))


def held_out(scene: Scene, split: Split, wanted: Sequence[str]) -> HeldOut:
    """What a split hides of a scene; ``wanted`` are the cameras to show by the split by cameras (empty = the
    default)."""
    if split.by_camera:
        shown = tuple(wanted) or (first_camera(scene, ()),)
        hidden = [name for name in scene.cameras if name not in shown]
        frames = tuple(frame.id for frame in scene.frames if frame.view.camera.name in hidden)
        facts = {"shown_cameras": list(shown), "hidden_cameras": hidden, "held_out_frames": len(frames)}
        return HeldOut(frames, (), facts, "" if frames else "the log has no camera besides those that are shown")
    if not split.block:
        return HeldOut()
    # moments are the times of the camera with the fewest frames; every frame and sweep belongs to the nearest one
    name = min((n for n in scene.cameras if scene.frames_of(n)), key=lambda n: len(scene.frames_of(n)))
    times = np.array([frame.view.time_s for frame in scene.frames_of(name)])
    blocks = blocks_of(len(times), split.block)
    if not blocks:
        return HeldOut(reason=f"its {len(times)} frames are too few for a block of {split.block} between shown ones")
    hidden = {moment for block in blocks for moment in block}
    is_hidden = lambda time_s: int(np.argmin(np.abs(times - time_s))) in hidden
    frames = tuple(frame.id for frame in scene.frames if is_hidden(frame.view.time_s))
    sweeps = tuple(sweep.id for sweep in scene.sweeps if is_hidden(sweep.time_s))
    facts = {"moments": len(times), "blocks": [[block.start, block.stop - 1] for block in blocks]}
    return HeldOut(frames, sweeps, {**facts, "held_out_frames": len(frames), "held_out_sweeps": len(sweeps)})


TRUTH: Final = "truth"
ALL_VIEWS: Final = 1_000_000
PERCEPTUAL_VIEWS: Final = 12
PER_LOG: Final = ("detections", "lanes")
"""Settings of a score that name what was made of the views of one log."""


@dataclass(frozen=True)
class Views:
    """The views of one log, in the folder ``out``, at the places of a table. ``rows``: those that are scored, in order.
    ``score``: how every row is scored. ``virtual``: folder of the views that fits learn from. ``on_path``: the
    diffusion model's own rows have views of the recorded path, too."""

    log: Log
    out: Path
    table: PaperTable
    rows: tuple[Row, ...]
    config: BenchConfig
    score: ScoreConfig
    overwrite: bool
    virtual: str = "virtual"
    on_path: bool = True

    @cached_property
    def scene(self) -> Path:
        """The scene, made if need be."""
        return make_scene(self.log, self.table, self.out, self.config.device, self.overwrite)

    @cached_property
    def loaded(self) -> Scene:
        """The scene, read."""
        return read_scene(self.scene)

    @cached_property
    def drawn(self) -> RenderConfig:
        """The views that the table asks for; one-sided shifts go to the side of the log."""
        cameras = tuple(self.loaded.cameras) if self.table.all_cameras else (first_camera(self.loaded, ()),)
        sides = [s if len(p.shifts_m) > 1 else self.log.side * s for p in self.table.places for s in p.shifts_m]
        paths = tuple(dict.fromkeys(name for place in self.table.places for name in place.paths))
        shifts, device = tuple(dict.fromkeys(sides)), self.config.device
        return RenderConfig(cameras=cameras, shifts_m=shifts, paths=paths, video=False, device=device)

    @cached_property
    def paths(self) -> tuple[Trajectory, ...]:
        """Their trajectories."""
        return render.trajectories(self.loaded, self.drawn)

    @cached_property
    def off_path(self) -> SynthesizeConfig:
        """How views off the recorded path are generated."""
        shifts = tuple(s for s in self.drawn.shifts_m if s) or tuple(self.table.virtual_shifts_m)
        return replace(generator_of(self.config), cameras=self.drawn.cameras, shifts_m=shifts, paths=self.drawn.paths)

    @cached_property
    def chain(self) -> Chain:
        """The steps."""
        return Chain(self.out, self.scene, self.config, self.overwrite, self.off_path)

    @cached_property
    def city(self) -> CityWorld:
        """The world of a generated log."""
        return CityWorld.from_source(self.loaded.source)

    @cached_property
    def truth(self) -> Path | None:
        """Exact truth of a generated log."""
        if not isinstance(self.log.source, CityConfig):
            return None
        return self.chain.run(DrawTruth(scene=self.scene, trajectories=self.paths, out=self.out / TRUTH))

    def trajectories(self, endings: Sequence[str]) -> tuple[str, ...]:
        """Names of the trajectories of a place."""
        return tuple(f"{camera}_{ending}" for camera in self.drawn.cameras for ending in endings)

    def of_rows(self) -> dict[str, tuple[Path, ...]]:
        """The folders with the views of every row, made if need be."""
        self.chain.fuse()
        return {row.name: self._of(row) for row in self.rows if not row.left_out}

    def _of(self, row: Row) -> tuple[Path, ...]:
        if row.name == FILL:
            return (self.chain.filled(self.paths),)
        if METHODS[row.method].made_by == "synthesize":
            folders, recorded = [], [path.origin == "recorded" for path in self.paths]
            if not all(recorded):
                folder = self.out / "generated" / row.name if row.changes else self.out / self.virtual
                folders.append(self.chain.generated(replace(self.off_path, **row.changes), folder))
            if self.on_path and any(recorded):
                on_path = replace(self.off_path, shifts_m=(0.0,), paths=(), **row.changes)
                folder = self.out / "generated" / f"{row.name}-{RECORDED}"
                folders.append(self.chain.generated(on_path, folder))
            return tuple(folders)
        return (self.chain.rendered(row, self.learned(row), self.drawn),)

    def learned(self, row: Row) -> tuple[Path, ...]:
        """The generated views that a row's fit learns from, made if need be."""
        return (self.chain.generated(self.off_path, self.out / self.virtual),) if row.learns_virtual else ()

    def scores(self, name: str, folders: Sequence[Path]) -> dict[Path, Mapping[str, Any]]:
        """What the scorer says of every folder of a row's views, by its own folder; the truth needs no networks that
        compare view with view."""
        settings, documents = self.score, {}
        if name == TRUTH:
            settings = replace(settings, perceptual_views=0, lpips_weights="")
        for number, folder in enumerate(folders):
            scored, views = self.out / "score" / (f"{name}-{number}" if number else name), {name: folder}
            self.chain.run(Score(scene=self.scene, views=views, truth=self.truth, out=scored, settings=settings))
            documents[scored] = store.read_json(scored / "metrics.json")
        return documents

    def film(self, shown: Mapping[str, tuple[Path, ...]]) -> None:
        """Make a video of every trajectory, if asked to; the truth, where it is known, stands first. With another
        method the old ones are out of date, whatever was asked."""
        if self.config.videos:
            views = {**({} if self.truth is None else {TRUTH: (self.truth,)}), **shown}
            run_step(Film(views=views, paths=self.paths, out=self.out / "film", overwrite=True))


def score_settings(config: BenchConfig, table: PaperTable) -> ScoreConfig:
    """How every row of a table is scored: the table's resize rule unless another was asked for; LPIPS, if computed, at
    all views."""
    settings = config.score
    resize = table.resize if settings.fid_resize == ScoreConfig().fid_resize else settings.fid_resize
    views = ALL_VIEWS if settings.lpips_weights else PERCEPTUAL_VIEWS
    settings = replace(settings, baseline=False, error_pictures=False, fid_resize=resize, perceptual_views=views)
    return on_device(settings, config.device)


def of_log(config: ScoreConfig, log: str) -> ScoreConfig:
    """How the rows of one log are scored: where a folder of detections or lanes has an entry of the log's
    name (or such a ``.json``), that one is taken."""
    own: dict[str, Any] = {}
    for name, ending in product(PER_LOG, (".json", "")):
        folder = getattr(config, name)
        if folder and (path := Path(folder) / f"{log}{ending}").exists():
            own[name] = str(path)
    return replace(config, **own)
