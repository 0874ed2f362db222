"""The steps of a scene that benchmarks of complete methods share, each in a folder that is verified and reused: what
``mudg run`` does, a folder per method.

OUT/fuse  OUT/fit/<row>   every fit       OUT/start/<row>   what a variant with other settings of the first fit goes on
          with
OUT/render/<row>  OUT/nearest_fill  OUT/exact
views to score; those of the diffusion model lie where the benchmark puts them
OUT/repair/<step>  repaired renders on the way to the places of generated views (difix); OUT/start/difix-<step>
the fit that has seen them
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from mudg.base import log
from mudg.base.layout import OBSERVATION_FILES, below
from mudg.base.run_folder import RunDir
from mudg.base.types import Trajectory
from mudg.benchmarks.loop import run_step
from mudg.benchmarks.rows import EXACT, FILL, LONGER, REPAIRED, Row, usual_fit
from mudg.benchmarks.settings import BenchConfig
from mudg.diffusion.settings import SynthesizeConfig
from mudg.editing.view_settings import RenderConfig
from mudg.gaussians.settings import FitConfig
from mudg.scene.clouds import read_fused
from mudg.scene.observations import ObservationWriter, list_observation_sets, read_observations
from mudg.scene.read import read_scene
from mudg.scoring import score
from mudg.steps.fit import Fit
from mudg.steps.fuse import Fuse
from mudg.steps.outputs import Output
from mudg.steps.pipeline import WITHOUT_DIFFUSION, fits_of
from mudg.steps.render import RenderViews
from mudg.steps.synthesize import Synthesize

REPAIR_STEPS: Final = 3
"""Steps in which repaired views move from the recorded path to the places of generated views."""


@dataclass(frozen=True)
class Chain:
    """The steps of one scene.

    Args:
        out: folder of all. scene: what methods see. config: its settings of steps, as ``mudg run`` takes them.
            overwrite: replace what other settings left there.
        generator: settings of generated views that fits learn from, whose places are those of repaired ones.
    """

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

    def generated(self, settings: SynthesizeConfig, out: Path, *, renders: bool) -> Path:
        """Views of the diffusion model; ``renders``: on top of those of the first fit."""
        fitted = self.first() if renders else None
        return self.run(Synthesize(scene=self.scene, fused=self.fused, fitted=fitted, out=out, settings=settings))

    def filled(self, paths: Sequence[Trajectory]) -> Path:
        """The fused points, holes filled, as views."""
        return self.run(FillViews(scene=self.scene, fused=self.fused, paths=tuple(paths), out=self.out / FILL))

    def rendered(self, row: Row, virtual: Sequence[Path], drawn: RenderConfig, scene: Path | None = None) -> Path:
        """Views of a row's fit.

        Args:
            virtual: views that it learns from, if its method learns from such. drawn: which views. scene: with their
                places, if other.
        """
        model, out = self.fitted(row, virtual), self.out / "render" / row.name
        return self.run(RenderViews(scene=scene or self.scene, model=model, out=out, settings=drawn))

    # ---- fits ----

    def first(self) -> Path:
        """The fit on recorded views with the usual settings."""
        return self._fit(fits_of(usual_fit(self.config))[0], self.out / "fit" / WITHOUT_DIFFUSION)

    def fitted(self, row: Row, virtual: Sequence[Path] = ()) -> Path:
        """The fit of a row. Where its method learns from ``virtual`` views, it goes on with a fit on recorded views of
        the same settings: the first one, if these are the usual ones but for virtual views."""
        out, settings, usual = self.out / "fit" / row.name, row.fit or usual_fit(self.config), usual_fit(self.config)
        if row.name == LONGER:
            plain, guided = fits_of(usual)
            return self._fit(replace(plain, iterations=guided.iterations), out, begun=self.first())
        if settings.method == REPAIRED:
            return self._repaired(row.name, settings)
        if not row.learns_virtual:
            return self._fit(settings, out)
        plain, guided = fits_of(settings, self.config.continue_fit)
        if not self.config.continue_fit:
            return self._fit(guided, out, virtual)
        plain = replace(plain, virtual=usual.virtual)
        begun = self.first() if plain == fits_of(usual)[0] else self._fit(plain, self.out / "start" / row.name)
        return self._fit(guided, out, virtual, begun)

    def _repaired(self, name: str, settings: FitConfig) -> Path:
        """Step by step towards the places of generated views: render there, repair, and fit under all that was repaired
        so far. Every fit goes on with the first one. Where steps pass the same place (2 m is the end of the way to 2 m,
        and two thirds of that to 3 m), the newest views count."""
        model, seen = self.first(), {}
        settings = replace(fits_of(settings)[1], method=settings.method)
        for number in range(1, REPAIR_STEPS + 1):
            views, last = self.out / "repair" / str(number), number == REPAIR_STEPS
            repaired = repair_settings(self.generator, number / REPAIR_STEPS)
            self.run(Synthesize(scene=self.scene, fused=self.fused, fitted=model, out=views, settings=repaired))
            seen |= list_observation_sets(views)
            out = self.out / "fit" / name if last else self.out / "start" / f"{name}-{number}"
            model = self._fit(settings, out, tuple(seen.values()), self.first())
        return model

    def _fit(self, settings: FitConfig, out: Path, virtual: Sequence[Path] = (), begun: Path | None = None) -> Path:
        return self.run(
            Fit(
                scene=self.scene,
                fused=self.fused,
                observations=tuple(virtual),
                start_from=begun,
                out=out,
                settings=settings,
            )
        )


def repair_settings(generator: SynthesizeConfig, share: float) -> SynthesizeConfig:
    """How renders are repaired, in one pass from nothing that was measured, after a share of the way to the places of
    generated views. Paths with a name begin at the end of the way."""
    shifts = tuple(round(share * shift, 4) for shift in generator.shifts_m if shift)
    return replace(
        generator,
        condition="repair",
        steps=1,
        shifts_m=shifts,
        paths=generator.paths if share == 1 or not shifts else (),
    )


class FillViews(Output):
    """The scorer's baseline on some trajectories as folders of views, so that it is a method like the others."""

    verb_name = FILL
    version, files = 1, below("*", OBSERVATION_FILES)
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


class ExactViews(Output):
    """The truth of the shifted trajectories as if the diffusion model had painted it; nothing of the recorded path."""

    verb_name = EXACT
    version, files = 1, below("*", OBSERVATION_FILES)
    truth: Path
    paths: tuple[Trajectory, ...]

    def key_settings(self) -> dict[str, Any]:
        return {"trajectories": [path.name for path in self.paths if path.origin == "shifted"]}

    def make(self, work: RunDir) -> dict[str, Any]:
        for name in self.key_settings()["trajectories"]:
            views = read_observations(self.truth / name)
            with ObservationWriter(work.path / name, name, EXACT) as writer:
                for index in range(len(views)):
                    seen = views[index]
                    (
                        writer.skip(seen.view)
                        if index < writer.done
                        else writer.add(replace(seen, kind="virtual", source=EXACT))
                    )
        return self.key_settings()
