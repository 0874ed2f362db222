"""The steps of a scene that benchmarks of complete methods share, each in a folder that is verified and reused: what ``mudg run`` does, a
folder per method.

OUT/fuse  OUT/fit/<row>   every fit       OUT/start/<row>   what a variant with other settings of the first fit goes on with
OUT/render/<row>  OUT/nearest_fill  OUT/exact   views to score; those of the diffusion model lie where the benchmark puts them
OUT/repair/<step>  repaired renders on the way to the places of generated views (difix); OUT/start/difix-<step>   the fit that has seen them
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from mudg.base import log, store
from mudg.base.run_folder import RunDir, VerbOutput, below, refuse_overlap
from mudg.base.types import Trajectory
from mudg.benchmarks.loop import step
from mudg.benchmarks.rows import EXACT, FILL, LONGER, REPAIRED, Row, usual_fit
from mudg.data.cloudfile import read_fused
from mudg.data.observations import OBSERVATION_FILES, ObservationWriter, list_observation_sets, read_observations
from mudg.data.scene import read_scene
from mudg.stages import fit, fuse, render, score, synthesize
from mudg.stages.config import BenchConfig, FitConfig, RenderConfig, SynthesizeConfig
from mudg.stages.run import WITHOUT_DIFFUSION, fits_of

REPAIR_STEPS: Final = 3
"""Steps in which repaired views move from the recorded path to the places of generated views."""
_FILL_OUTPUT: Final = VerbOutput(FILL, 1, below("*", OBSERVATION_FILES))
_EXACT_OUTPUT: Final = VerbOutput(EXACT, 1, below("*", OBSERVATION_FILES))


@dataclass(frozen=True)
class Chain:
    """The steps of one scene.

    Args:
        out: folder of all. scene: what methods see. config: its settings of steps, as ``mudg run`` takes them. overwrite: replace what
            other settings left there.
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

    def step(self, verb: Callable[..., Path], *inputs: Any, **settings: Any) -> Path:
        """Run a verb, or reuse its result."""
        return step(verb, *inputs, **settings, overwrite=self.overwrite)

    def fuse(self) -> Path:
        """Make the clouds."""
        return self.step(fuse.run, self.config.fuse, self.scene, self.fused)

    def generated(self, settings: SynthesizeConfig, out: Path, *, renders: bool) -> Path:
        """Views of the diffusion model; ``renders``: on top of those of the first fit."""
        return self.step(synthesize.run, settings, self.scene, self.fused, out, fitted=self.first() if renders else None)

    def filled(self, paths: Sequence[Trajectory]) -> Path:
        """The fused points, holes filled, as views."""
        return self.step(write_fill, self.scene, self.fused, paths, self.out / FILL)

    def rendered(self, row: Row, virtual: Sequence[Path], drawn: RenderConfig, scene: Path | None = None) -> Path:
        """Views of a row's fit.

        Args:
            virtual: views that it learns from, if its method learns from such. drawn: which views. scene: with their places, if other.
        """
        return self.step(render.run, drawn, scene or self.scene, self.fitted(row, virtual), self.out / "render" / row.name)

    # ---- fits ----

    def first(self) -> Path:
        """The fit on recorded views with the usual settings."""
        return self._fit(fits_of(usual_fit(self.config))[0], self.out / "fit" / WITHOUT_DIFFUSION)

    def fitted(self, row: Row, virtual: Sequence[Path] = ()) -> Path:
        """The fit of a row. Where its method learns from ``virtual`` views, it goes on with a fit on recorded views of the same settings:
        the first one, if these are the usual ones but for virtual views."""
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
        """Step by step towards the places of generated views: render there, repair, and fit under all that was repaired so far. Every
        fit goes on with the first one. Where steps pass the same place (2 m is the end of the way to 2 m, and two thirds of that to
        3 m), the newest views count."""
        model, seen = self.first(), {}
        settings = replace(fits_of(settings)[1], method=settings.method)
        for number in range(1, REPAIR_STEPS + 1):
            views, last = self.out / "repair" / str(number), number == REPAIR_STEPS
            repaired = repair_settings(self.generator, number / REPAIR_STEPS)
            self.step(synthesize.run, repaired, self.scene, self.fused, views, fitted=model)
            seen |= list_observation_sets(views)
            out = self.out / "fit" / name if last else self.out / "start" / f"{name}-{number}"
            model = self._fit(settings, out, tuple(seen.values()), self.first())
        return model

    def _fit(self, settings: FitConfig, out: Path, virtual: Sequence[Path] = (), begun: Path | None = None) -> Path:
        return self.step(fit.run, settings, self.scene, self.fused, out, observations=virtual, start=begun)


def repair_settings(generator: SynthesizeConfig, share: float) -> SynthesizeConfig:
    """How renders are repaired, in one pass from nothing that was measured, after a share of the way to the places of generated views.
    Paths with a name begin at the end of the way."""
    shifts = tuple(round(share * shift, 4) for shift in generator.shifts_m if shift)
    return replace(
        generator, condition="repair", steps=1, shifts_m=shifts, paths=generator.paths if share == 1 or not shifts else (),
    )  # fmt: skip


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
