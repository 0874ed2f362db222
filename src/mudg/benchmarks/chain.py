"""How benchmarks of complete methods run: one loop over logs, side by side; the steps of a scene that they share, each
in a folder that is verified and reused; and videos of all methods side by side."""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg import native
from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.layout import OBSERVATION_FILES, below
from mudg.base.processes import run_in_processes
from mudg.base.run_folder import RunDir, is_temporary, refuse_overlap
from mudg.base.types import Trajectory
from mudg.benchmarks.rows import FILL, FULL, LONGER, MIXED, REPAIRED, Facts, Row, refuse_unfit, usual_fit
from mudg.benchmarks.settings import BenchConfig
from mudg.core.pictures import resize_area
from mudg.core.raster.rasterize import drawing_device
from mudg.diffusion import model_files
from mudg.diffusion.settings import SynthesizeConfig
from mudg.editing.settings import RenderConfig
from mudg.formats.exporters.video import jpeg_bytes, mp4_within, video_encoders
from mudg.gaussians.settings import FitConfig
from mudg.scene.clouds import read_fused
from mudg.scene.observations import ObservationSet, ObservationWriter, list_observation_sets, read_observations
from mudg.scene.read import read_scene
from mudg.scoring import score
from mudg.steps.engine import Output, Result
from mudg.steps.fit import Fit
from mudg.steps.ingest import Fuse
from mudg.steps.pipeline import WITHOUT_DIFFUSION, fits_of
from mudg.steps.render import RenderViews
from mudg.steps.settings import PresetName
from mudg.steps.synthesize import Synthesize
from mudg.viewer.report import FPS, PANEL_WIDTH, panel_grid, panel_size

PAGES: Final = ("bench.json", "bench.md")


def compare(
    out: Path,
    jobs: Mapping[str, Callable[[], dict[str, Any]]],
    config: BenchConfig,
    document: Callable[[list[dict[str, Any]]], dict[str, Any]],
    markdown: Callable[[Facts], str],
) -> Path:
    """Do all jobs (title -> what another process can measure), several at a time with one thread each; write
    ``bench.json`` and ``bench.md``. Results do not depend on how many run at a time; finished steps of an interrupted
    benchmark are reused. ``document``: what ``bench.json`` holds, from what the jobs measured, in their order."""
    measured, titles = {}, list(jobs)
    with log.task("logs", len(jobs)) as bar, native.one_thread():
        work = [(measure,) for measure in jobs.values()]
        for index, facts in run_in_processes(operator.call, work, min(at_once(config), len(jobs))):
            measured[index] = facts
            bar.update(titles[index])
            bar.advance()
    content = document([measured[index] for index in range(len(jobs))])
    store.write_json(out / "bench.json", content)
    store.write_text(out / "bench.md", markdown(content))
    return out


def at_once(config: BenchConfig) -> int:
    """Logs that are measured at the same time: as many as asked for, else one per core, or one where they would share a
    GPU."""
    on_cpu = drawing_device(config.device, "benchmark").type == "cpu"
    return config.processes or (os.cpu_count() if on_cpu else None) or 1


def run_step(step: Result) -> Path:
    """Run a step, or reuse its result; what other settings left in its folder is replaced only with ``overwrite``."""
    try:
        return replace(step, overwrite=False).run()
    except UsageError:
        if not step.overwrite:
            raise
        return step.run()


def refuse(
    bench: str,
    config: BenchConfig,
    preset: PresetName,
    rows: Sequence[Row],
    out: Path,
    *,
    read: Mapping[str, Path | str] = MappingProxyType({}),
    table: str = "",
) -> None:
    """Refuse, before anything is written, what a benchmark (under a table of a paper) cannot do. UsageError: ``out``,
    which need not exist, touches what is ``read`` or holds anything that it does not write, or as `rows.refuse_unfit`.
    InputError: there is no such model."""
    refuse_overlap(out, {"model": model_files.folder_of(config.model), **read})
    refuse_unfit(config, preset, rows)
    if not out.exists():
        return
    entries = [entry for entry in out.iterdir() if not is_temporary(entry.name)] if out.is_dir() else [out]
    may_be = (lambda entry: entry.name.isdigit()) if bench in ("shift", "loop") else Path.is_dir
    foreign = [entry.name for entry in entries if entry.name not in PAGES and not may_be(entry)]
    pages = [entry.name for entry in entries if entry.name in PAGES]
    if pages and not foreign:
        try:
            doc = store.read_json(out / PAGES[0])
            own = doc["bench"] == bench and doc.get("table", {}).get("name", "") == table
        except (InputError, KeyError, TypeError, AttributeError):
            own = False
        foreign = [] if own else pages
    if foreign:
        what = "the output folder holds files that do not belong to this run"
        raise UsageError(what, where=str(out), got=", ".join(sorted(foreign)[:8]), remedy="choose an empty --out")


def standard_error(of: Callable[[Sequence[Any]], float | None], items: Sequence[Any]) -> float | None:
    """Standard error of a statistic of independent items by leaving out each in turn; None for fewer than two items."""
    count = len(items)
    values = [of([*items[:i], *items[i + 1 :]]) for i in range(count)] if count > 1 else [None]
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return None
    center = mean(known)
    return math.sqrt((count - 1) / count * sum((value - center) ** 2 for value in known))


def mean(values: Sequence[float]) -> float:
    """The sum over the number."""
    return sum(values) / len(values)


def virtual_fits_of(settings: Facts) -> str:
    """How many iterations fits under virtual views have, as part of a sentence."""
    return f"{settings['guided_share']:g} times as many under virtual views"


def seconds_of(out: Path) -> dict[str, float]:
    """Seconds of each finished step, by folder."""
    steps = sorted(path.relative_to(out) for path in out.glob("**/run.json"))
    return {
        path.parent.as_posix(): float(store.read_json(out / path).get("seconds", math.nan))
        for path in steps
        if len(path.parts) <= 3 and ".part" not in str(path)
    }


REPAIR_STEPS: Final = 3
"""Steps in which repaired views move from the recorded path to the places of generated views."""
REPAIR_SHARE: Final = 0.5
"""Iterations of a fit that goes on under repaired views, as a share of those of the first one."""


@dataclass(frozen=True)
class Chain:
    """The steps of one scene. ``out``: folder of all. ``scene``: what methods see. ``config``: its settings of steps,
    as ``mudg run`` takes them. ``overwrite``: replace what other settings left there. ``generator``: settings of
    generated views that fits learn from, whose places are those of repaired ones."""

    out: Path
    scene: Path
    config: BenchConfig
    overwrite: bool
    generator: SynthesizeConfig

    @property
    def fused(self) -> Path:
        """The clouds."""
        return self.out / "fuse"

    def run(self, step: Output) -> Path:
        """Run a step, or reuse its result."""
        return run_step(replace(step, overwrite=self.overwrite))

    def fuse(self) -> Path:
        """Make the clouds."""
        return self.run(Fuse(scene=self.scene, out=self.fused, settings=self.config.fuse))

    def generated(self, settings: SynthesizeConfig, out: Path) -> Path:
        """Views of the diffusion model."""
        return self.run(Synthesize(scene=self.scene, fused=self.fused, out=out, settings=settings))

    def filled(self, paths: Sequence[Trajectory]) -> Path:
        """The fused points, holes filled, as views."""
        return self.run(FillViews(scene=self.scene, fused=self.fused, paths=tuple(paths), out=self.out / FILL))

    def rendered(self, row: Row, virtual: Sequence[Path], drawn: RenderConfig, scene: Path | None = None) -> Path:
        """Views of a row's fit. ``virtual``: views that it learns from, if its method learns from such. ``drawn``:
        which views. ``scene``: with their places, if other."""
        model, out = self.fitted(row, virtual), self.out / "render" / row.name
        if row.name != MIXED:
            return self.run(RenderViews(scene=scene or self.scene, model=model, out=out, settings=drawn))
        drawn = replace(drawn, repair=True, repair_model=self.config.model)
        return self.run(RenderViews(scene=self.scene, model=model, fused=self.fused, out=out, settings=drawn))

    # ---- fits ----

    def first(self) -> Path:
        """The fit on recorded views with the usual settings."""
        plain = replace(usual_fit(self.config), method=WITHOUT_DIFFUSION)
        return self._fit(plain, self.out / "fit" / WITHOUT_DIFFUSION)

    def fitted(self, row: Row, virtual: Sequence[Path] = ()) -> Path:
        """The fit of a row; ``virtual``: views that it learns from, if its method learns from such."""
        out, settings = self.out / "fit" / (FULL if row.name == MIXED else row.name), row.fit or usual_fit(self.config)
        if row.name == LONGER:
            further = max(1, round((self.config.guided_share - 1) * settings.iterations))
            return self._fit(replace(settings, iterations=further), out, begun=self.first())
        if settings.method == REPAIRED:
            return self._repaired(row.name, settings)
        if not row.learns_virtual:
            return self._fit(settings, out)
        return self._fit(fits_of(settings, self.config.guided_share)[1], out, virtual)

    def _repaired(self, name: str, settings: FitConfig) -> Path:
        """Step by step towards the places of generated views: render there, repair, and fit under all that was repaired
        so far. Every fit goes on with the first one. Where steps pass the same place (2 m is the end of the way to 2 m,
        and two thirds of that to 3 m), the newest views count."""
        model, seen = self.first(), {}
        settings = replace(settings, iterations=max(1, round(REPAIR_SHARE * settings.iterations)))
        for number in range(1, REPAIR_STEPS + 1):
            views, last = self.out / "repair" / str(number), number == REPAIR_STEPS
            repaired = repair_settings(self.generator, number / REPAIR_STEPS)
            self.run(Synthesize(scene=self.scene, fused=self.fused, fitted=model, out=views, settings=repaired))
            seen |= list_observation_sets(views)
            out = self.out / "fit" / name if last else self.out / "start" / f"{name}-{number}"
            model = self._fit(settings, out, tuple(seen.values()), self.first())
        return model

    def _fit(self, settings: FitConfig, out: Path, virtual: Sequence[Path] = (), begun: Path | None = None) -> Path:
        read = {"scene": self.scene, "fused": self.fused, "observations": tuple(virtual), "start_from": begun}
        return self.run(Fit(**read, out=out, settings=settings))


def repair_settings(generator: SynthesizeConfig, share: float) -> SynthesizeConfig:
    """How renders are repaired, in one pass from nothing that was measured, after a share of the way to the places of
    generated views. Paths with a name begin at the end of the way."""
    shifts = tuple(round(share * shift, 4) for shift in generator.shifts_m if shift)
    paths = generator.paths if share == 1 or not shifts else ()
    return replace(generator, condition="repair", steps=1, shifts_m=shifts, paths=paths)


class FillViews(Output):
    """The scorer's baseline on some trajectories as folders of views, so that it is a method like the others."""

    verb_name = FILL
    version, files = 2, below("*", OBSERVATION_FILES)
    scene: Path
    fused: Path
    paths: tuple[Trajectory, ...]

    def key_settings(self) -> dict[str, Any]:
        return {"trajectories": [path.name for path in self.paths]}

    def make(self, work: RunDir) -> dict[str, Any]:
        fill = score.baseline_of(read_scene(self.scene), read_fused(self.fused))
        with log.task(FILL, sum(map(len, self.paths))) as bar:
            for path in self.paths:
                with ObservationWriter(work.path / path.name, path.name, FILL) as writer:
                    for index, view in enumerate(path.views):
                        writer.skip(view) if index < writer.done else writer.add(fill(view))
                        bar.advance()
        return self.key_settings()


QUALITY: Final = (29, 41)
VIDEO_BYTES: Final = 900 * 1024
"""A video larger than this is made anew in lower quality: eight logs of seven trajectories stay under 60 MB."""
ROWS: Final = ("rgb", "error", "depth")


class Film(Output):
    """Write one video and one picture per trajectory: columns truth and methods, rows as ``ROWS``."""

    version, files = 1, ("*.mp4", "*.jpg")
    views: Mapping[str, tuple[Path, ...]]
    """Column -> folders of observation folders. Where "truth" is among them, it has every trajectory; else there is no
    row of errors."""
    paths: tuple[Trajectory, ...]

    def key_settings(self) -> dict[str, Any]:
        names = [path.name for path in self.paths]
        return {"columns": list(self.views), "trajectories": names, "panel_width_px": PANEL_WIDTH}

    def make(self, work: RunDir) -> dict[str, Any]:
        sets_of = lambda folders: {k: v for one in folders for k, v in list_observation_sets(one).items()}
        listed = {name: sets_of(folders) for name, folders in self.views.items()}
        playable = bool(video_encoders())
        for path in self.paths:
            sets = {name: read_observations(sets[path.name]) for name, sets in listed.items() if path.name in sets}
            if "truth" in self.views and "truth" not in sets:
                raise InputError("no ground truth to show", where=f"{self.views['truth'][0]}: {path.name}")
            if not sets:
                continue
            pictures = list(_frames(sets, list(self.views), range(len(path)) if playable else [len(path) // 2]))
            if playable:
                video = mp4_within(lambda frames=pictures: frames, FPS, QUALITY, VIDEO_BYTES)
                store.atomic_write(work.path / f"{path.name}.mp4", video)
            middle = pictures[len(pictures) // 2]
            poster = resize_area(middle, middle.shape[1] // 2, middle.shape[0] // 2)
            store.atomic_write(work.path / f"{path.name}.jpg", jpeg_bytes(poster, quality=75))
        return {"columns": list(self.views), "videos": playable}


def _frames(
    sets: Mapping[str, ObservationSet], order: Sequence[str], frames: Sequence[int]
) -> Iterator[NDArray[np.uint8]]:
    camera = next(iter(sets.values())).views[0].camera
    size = panel_size(camera.width, camera.height)
    rows = [row for row in ROWS if row != "error" or "truth" in sets]
    for frame in frames:
        seen = {column: sets[column][frame] if column in sets else None for column in order}
        yield panel_grid(seen, rows, size, seen.get("truth"))
