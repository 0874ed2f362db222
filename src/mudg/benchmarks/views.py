"""One log of ``mudg bench shift`` or ``paper``: the views of every row at the places of a table, their scores, and
pictures of them.

OUT/<log>/scene fuse truth nearest_fill generated/<row> fit/<row> start/<row> render/<row> score/<row> film
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from mudg.base import store
from mudg.base.types import Scene, Trajectory
from mudg.benchmarks import page
from mudg.benchmarks.chain import Chain, ExactViews
from mudg.benchmarks.loop import run_step
from mudg.benchmarks.papers import RECORDED, PaperTable
from mudg.benchmarks.places import ListedCity, Log, first_camera, make_scene
from mudg.benchmarks.rows import EXACT, FILL, Row, generator_of
from mudg.benchmarks.settings import BenchConfig
from mudg.diffusion.settings import SynthesizeConfig
from mudg.editing import render
from mudg.editing.view_settings import RenderConfig, ScoreConfig
from mudg.gaussians.methods import METHODS
from mudg.scene.read import read_scene
from mudg.steps.score import DrawTruth, Score
from mudg.steps.settings.run import on_device

TRUTH: Final = "truth"
ALL_VIEWS: Final = 1_000_000
PERCEPTUAL_VIEWS: Final = 12
PER_LOG: Final = ("detections", "lanes", "video_features")
"""Settings of a score that name what was made of the views of one log."""


@dataclass(frozen=True)
class Views:
    """The views of one log at the places of a table.

    Args:
        out: folder of the log. rows: those that are scored, in order. renders: whether the diffusion model uses those
            of a fit.
        score: how every row is scored. overwrite: replace what other settings left there.
        virtual: folder of the views that fits learn from. on_path: the diffusion model's own rows have views of the
            recorded path, too.
    """

    log: Log
    out: Path
    table: PaperTable
    rows: tuple[Row, ...]
    config: BenchConfig
    score: ScoreConfig
    renders: bool
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
        return RenderConfig(
            cameras=cameras, shifts_m=tuple(dict.fromkeys(sides)), paths=paths, video=False, device=self.config.device
        )

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
    def truth(self) -> Path | None:
        """Exact truth of a generated log."""
        if not isinstance(self.log, ListedCity):
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
        renders = self.renders and row.changes.get("condition", "full") == "full"
        if METHODS[row.method].made_by == "synthesize":
            folders = []
            if any(path.origin != "recorded" for path in self.paths):
                folder = self.out / "generated" / row.name if row.changes else self.out / self.virtual
                folders.append(self.chain.generated(replace(self.off_path, **row.changes), folder, renders=renders))
            if self.on_path and any(path.origin == "recorded" for path in self.paths):
                on_path = replace(self.off_path, shifts_m=(0.0,), paths=(), **row.changes)
                folders.append(
                    self.chain.generated(on_path, self.out / "generated" / f"{row.name}-{RECORDED}", renders=renders)
                )
            return tuple(folders)
        virtual: tuple[Path, ...] = ()
        if row.name == EXACT:
            virtual = (self.chain.run(ExactViews(truth=self.truth, paths=self.paths, out=self.out / EXACT)),)
        elif row.learns_virtual:
            virtual = (self.chain.generated(self.off_path, self.out / self.virtual, renders=self.renders),)
        return (self.chain.rendered(row, virtual, self.drawn),)

    def scores(self, name: str, folders: Sequence[Path]) -> dict[Path, Mapping[str, Any]]:
        """What the scorer says of every folder of a row's views, by its own folder; the truth needs no networks that
        compare view with view."""
        settings, documents = (
            (replace(self.score, perceptual_views=0, lpips_weights="") if name == TRUTH else self.score),
            {},
        )
        for number, folder in enumerate(folders):
            scored = self.out / "score" / (f"{name}-{number}" if number else name)
            self.chain.run(
                Score(scene=self.scene, views={name: folder}, truth=self.truth, out=scored, settings=settings)
            )
            documents[scored] = store.read_json(scored / "metrics.json")
        return documents

    def film(self, shown: Mapping[str, Path | Sequence[Path]]) -> list[str]:
        """Make a picture (or video) of every trajectory; returns their names. With another method the old ones are out
        of date, whatever was asked."""
        views = {
            name: (folder,) if isinstance(folder, Path) else tuple(folder)
            for name, folder in shown.items()
            if folder is not None
        }
        run_step(
            page.Film(views=views, paths=self.paths, videos=self.config.videos, out=self.out / "film", overwrite=True)
        )
        return [path.name for path in self.paths]


def score_settings(config: BenchConfig, table: PaperTable) -> ScoreConfig:
    """How every row of a table is scored: the table's resize rule unless another was asked for; LPIPS, if computed, at
    all views."""
    settings = config.score
    resize = table.resize if settings.fid_resize == ScoreConfig().fid_resize else settings.fid_resize
    views = ALL_VIEWS if settings.lpips_weights else PERCEPTUAL_VIEWS
    return on_device(
        replace(settings, baseline=False, error_pictures=False, fid_resize=resize, perceptual_views=views),
        config.device,
    )


def of_log(config: ScoreConfig, log: str) -> ScoreConfig:
    """How the rows of one log are scored: where a folder of detections, lanes or features has an entry of the log's
    name (or such a ``.json``), that one is taken."""
    own: dict[str, Any] = {}
    for name in PER_LOG:
        folder = getattr(config, name, "")
        entries = [path for ending in ("", ".json") if folder and (path := Path(folder) / f"{log}{ending}").exists()]
        own |= {name: str(entries[0])} if entries else {}
    return replace(config, **own)
