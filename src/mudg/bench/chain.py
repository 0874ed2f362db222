"""What benchmarks of complete methods share: logs that are worked on side by side, folders that are reused, and the fits, made as
``mudg run`` makes them: one on recorded views, and those under virtual views go on with it.

OUT/fit/<method>   every fit      OUT/start/<method>   what a variant with other settings of the first fit goes on with
OUT/repair/<step>  repaired renders on the way to the places of generated views (difix); OUT/start/difix-<step>   the fit that has seen them
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from mudg import native
from mudg.base import config as configuration
from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.processes import run_in_processes
from mudg.base.run_folder import is_temporary
from mudg.core.raster.place import drawing_device
from mudg.data.observations import list_observation_sets
from mudg.methods import METHODS
from mudg.report.score_tables import title_of
from mudg.stages import fit, synthesize
from mudg.stages.config import BenchConfig, FitConfig, PresetName, SynthesizeConfig, bench_preset
from mudg.stages.fitting.recipes import recipe_of
from mudg.stages.learning import loading
from mudg.stages.run import CONTINUED_SHARE, WITHOUT_DIFFUSION, fits_of, refuse_missing

_NO_DEPTH: Final = {"depth_weight": 0.0, "lidar_weight": 0.0}
_NO_CLASSES: Final = {"semantic_weight": 0.0}
VIRTUAL_TERMS: Final[dict[str, tuple[str, str, Mapping[str, float]]]] = {
    "only_I": ("+ I", "virtual colour", {**_NO_DEPTH, **_NO_CLASSES}),
    "only_I_D": ("+ I + D", "virtual colour and depth", _NO_CLASSES),
    "only_I_S": ("+ I + S", "virtual colour and classes", _NO_DEPTH),
}
"""Ablation of supervision by virtual views, as in table 3 of the paper: row -> (title there, what is learned from, settings ``virtual``
of the fit). Beside them stand street_gaussians (no virtual views) and mudg_s (all terms)."""


LONGER: Final = f"{WITHOUT_DIFFUSION}-longer"
"""The control of ``mudg_s``: goes on with the first fit for as many iterations, without generated views."""
LONGER_TITLE: Final = title_of(WITHOUT_DIFFUSION) + ", as many iterations"
REPAIRED: Final = "difix"
REPAIR_STEPS: Final = 3
"""Steps in which repaired views move from the recorded path to the places of generated views."""


PLACES: Final = ("cameras", "shifts_m", "paths", "condition", "processes")
"""Settings of generated views that are the benchmark's matter, not the user's."""


# ---- settings ----


def generator_of(config: BenchConfig) -> SynthesizeConfig:
    """How views are generated, by the benchmark's model, number format, seed and device; one trajectory at a time."""
    return replace(
        config.synthesize, model=config.model, precision=config.precision, seed=config.seed, device=config.device, processes=1
    )


def usual_fit(config: BenchConfig) -> FitConfig:
    """The settings of fits, as ``mudg run`` takes them for the whole chain."""
    return replace(config.fit, method="mudg_s", iterations=config.iterations, seed=config.seed, device=config.device)


def method_fit(usual: FitConfig, method: str, preset: PresetName) -> FitConfig:
    """The usual settings with a method. What a preset sets and a method for comparison does not know has its default there.

    Raises:
        UsageError: a setting beyond the preset that the method does not know.
    """
    recipe, named, plain = recipe_of(method), bench_preset(preset).fit, FitConfig()
    settings = configuration.load(FitConfig, usual, overrides={"method": method})
    for name in (*recipe.unfit, *(f"loss.{weight}" for weight in recipe.own_weights)):
        group, _, field = name.partition(".")
        own, set_by_preset = getattr(settings, group), getattr(getattr(named, group), field)
        if getattr(own, field) == set_by_preset:
            settings = replace(settings, **{group: replace(own, **{field: getattr(getattr(plain, group), field)})})
    recipe.check(settings, False)
    return settings


def chain_settings(config: BenchConfig, preset: PresetName) -> dict[str, Any]:
    """What the chain of a benchmark runs with, for ``bench.json``; ``continued_share`` is None where fits under virtual views begin from
    nothing."""
    generator = configuration.result_settings(generator_of(config))
    return {
        "preset": preset, "continued_share": CONTINUED_SHARE if config.continue_fit else None,
        "fuse": configuration.result_settings(config.fuse), "fit": configuration.result_settings(usual_fit(config)),
        "synthesize": {name: value for name, value in generator.items() if name not in PLACES},
    }  # fmt: skip


def refuse_unfit(
    config: BenchConfig, preset: PresetName, *, fits: Sequence[FitConfig], generators: Sequence[SynthesizeConfig], renders: bool
) -> None:
    """Refuse, before anything is written, what the rows of a benchmark cannot follow or do not use.

    Args:
        preset: what the configuration started from. fits: of all rows that fit a scene. generators: settings behind all views that are
            generated for a row itself. renders: whether the diffusion model sees renders of the first fit.

    Raises:
        UsageError: a setting that no row uses, weights that are asked for and not given, or a method that the model cannot serve.
        InputError: there is no such model.
    """
    virtual = [settings for settings in fits if {"virtual", "repaired"} & set(METHODS[settings.method].supervision)]
    if any(settings.method == REPAIRED for settings in fits) and not renders:
        raise UsageError(f"{REPAIRED} repairs renders, and this diffusion model uses none", where="--methods", got=config.model,
                         remedy=f"leave {REPAIRED} out, or choose another --model")  # fmt: skip
    if fits and not config.continue_fit and LONGER in config.methods:
        raise UsageError("with --no-continue-fit every fit has the same iterations, so this row is that of "
                         f"{WITHOUT_DIFFUSION}", where="--methods", got=LONGER, remedy="leave it out")  # fmt: skip
    idle = {
        "no row of this table generates views": () if generators or virtual else ("synthesize",),
        "no row of this table fits a scene": () if fits or (renders and generators) else ("fit", "iterations", "continue_fit"),
        "no row of this table learns from virtual views": () if virtual else ("fit.virtual", "continue_fit"),
    }
    for name in changed_settings(config, bench_preset(preset)):
        for reason, unused in idle.items():
            if any(name == one or name.startswith(f"{one}.") for one in unused):
                raise UsageError("this setting would change nothing", where=flag_of(name), got=reason, remedy="leave it out")
    if generators or virtual:
        refuse_missing(generator_of(config), virtual[0] if virtual else FitConfig(), "--model")
    for generator in dict.fromkeys((*generators, *((generator_of(config),) if virtual else ()))):
        loading.check_config(generator, fitted=False)


def changed_settings(config: BenchConfig, usual: BenchConfig) -> list[str]:
    """Dotted names of the settings in which a configuration differs from another."""
    lines = configuration.differences(configuration.to_dict(usual), configuration.to_dict(config))
    return [line.partition(":")[0] for line in lines]


def flag_of(name: str) -> str:
    """The flag of a setting."""
    return f"--{name.replace('_', '-')}"


# ---- logs ----


def each_log(make: Callable[[Any], Any], jobs: Sequence[Any], names: Sequence[str], processes: int) -> list[Any]:
    """What ``make`` returns for every job, several at a time with one thread each, in their order."""
    found: dict[int, Any] = {}
    with log.task("logs", len(jobs)) as bar, native.one_thread():
        for index, facts in run_in_processes(make, [(job,) for job in jobs], min(processes, len(jobs))):
            found[index] = facts
            bar.update(names[index])
            bar.advance()
    return [found[index] for index in range(len(jobs))]


def refuse_foreign(
    out: Path, pages: Sequence[str], is_own: Callable[[Any], bool], may_be: Callable[[Path], bool] = Path.is_dir
) -> None:
    """UsageError if a folder holds anything that a benchmark does not write.

    Args:
        out: it need not exist. pages: names of its files at the top; the first is its result, in JSON.
        is_own: whether that result is this benchmark's. may_be: whether an entry may belong to it, if it is no page.
    """
    if not out.exists():
        return
    entries = [entry for entry in out.iterdir() if not is_temporary(entry.name)] if out.is_dir() else [out]
    names = [entry.name for entry in entries]
    foreign = [entry.name for entry in entries if entry.name not in pages and not may_be(entry)]
    if not foreign and any(name in pages for name in names):
        try:
            foreign = [] if is_own(store.read_json(out / pages[0])) else [pages[0]]
        except (InputError, KeyError, TypeError):
            foreign = [name for name in names if name in pages]
    if foreign:
        raise UsageError("the output folder holds files that do not belong to this run", where=str(out), got=", ".join(sorted(foreign)[:8]),
                         remedy="choose an empty --out")  # fmt: skip


def made(make: Callable[[bool], Path], overwrite: bool) -> Path:
    """Make or reuse a folder; what other settings left there is replaced only if that was asked for.

    Args:
        make: called with whether to replace.
    """
    try:
        return make(False)
    except UsageError:
        if not overwrite:
            raise
        return make(True)


def seconds_of(out: Path) -> dict[str, float]:
    """Seconds of each finished step, by folder."""
    steps = sorted(path.relative_to(out) for path in out.glob("**/run.json"))
    return {
        path.parent.as_posix(): float(store.read_json(out / path).get("seconds", math.nan))
        for path in steps
        if len(path.parts) <= 3 and ".part" not in str(path)
    }


def at_once(config: BenchConfig) -> int:
    """Logs that are processed at the same time: as many as asked for, else one per core, or one where they would share a GPU."""
    if config.processes:
        return config.processes
    return os.cpu_count() or 1 if drawing_device(config.device, "benchmark").type == "cpu" else 1


def learns_virtual(settings: FitConfig) -> bool:
    """Whether a fit of these settings uses generated views."""
    return "virtual" in METHODS[settings.method].supervision


@dataclass(frozen=True)
class FitChain:
    """The fits of one scene.

    Args:
        out: folder of all. scene, fused: what is fitted.
        usual: settings of the whole chain, as ``mudg run`` takes them; the first fit has them.
        overwrite: replace what other settings left there.
        continued: fits under virtual views go on with one without; else they begin from nothing, with all iterations.
        generator: settings of generated views, whose places are those of repaired ones.
    """

    out: Path
    scene: Path
    fused: Path
    usual: FitConfig
    overwrite: bool
    continued: bool = True
    generator: SynthesizeConfig | None = None

    def first(self) -> Path:
        """The fit on recorded views with the usual settings, made if need be."""
        return self._made(fits_of(self.usual)[0], self.out / "fit" / WITHOUT_DIFFUSION)

    def fitted(self, name: str, settings: FitConfig, virtual: Sequence[Path]) -> Path:
        """The fit of a method, made if need be.

        Args:
            settings: as ``mudg run`` takes them. Where the method learns from ``virtual`` views, it goes on with a fit on recorded views
                of the same settings: the first one, if these are the usual ones but for virtual views.
        """
        out = self.out / "fit" / name
        if name == LONGER:
            return self.longer(name)
        if settings.method == REPAIRED:
            return self._repaired(name, settings)
        if not learns_virtual(settings):
            return self._made(settings, out)
        plain, guided = fits_of(settings, self.continued)
        if not self.continued:
            return self._made(guided, out, virtual)
        plain = replace(plain, virtual=self.usual.virtual)
        begun = self.first() if plain == fits_of(self.usual)[0] else self._made(plain, self.out / "start" / name)
        return self._made(guided, out, virtual, begun)

    def longer(self, name: str) -> Path:
        """The first fit and as many more iterations as fits under generated views have, without such views; made if need be."""
        plain, guided = fits_of(self.usual)
        return self._made(replace(plain, iterations=guided.iterations), self.out / "fit" / name, begun=self.first())

    def _repaired(self, name: str, settings: FitConfig) -> Path:
        """Step by step towards the places of generated views: render there, repair, and fit under all that was repaired so far. Every
        fit goes on with the first one. Where steps pass the same place (2 m is the end of the way to 2 m, and two thirds of that to
        3 m), the newest views count."""
        if self.generator is None:
            raise UsageError("repaired views need settings of generated ones", got=name)
        model, seen = self.first(), {}
        settings = replace(fits_of(settings)[1], method=settings.method)
        for step in range(1, REPAIR_STEPS + 1):
            views, last = self.out / "repair" / str(step), step == REPAIR_STEPS
            asked = repair_settings(self.generator, step / REPAIR_STEPS)
            made(lambda o, m=model, v=views, a=asked: synthesize.run(a, self.scene, self.fused, v, fitted=m, overwrite=o), self.overwrite)
            seen |= list_observation_sets(views)
            out = self.out / "fit" / name if last else self.out / "start" / f"{name}-{step}"
            model = self._made(settings, out, tuple(seen.values()), self.first())
        return model

    def _made(self, settings: FitConfig, out: Path, virtual: Sequence[Path] = (), begun: Path | None = None) -> Path:
        def make(overwrite: bool) -> Path:
            return fit.run(
                settings, self.scene, self.fused, out, observations=virtual, start=begun, overwrite=overwrite
            )

        return made(make, self.overwrite)


def repair_settings(generator: SynthesizeConfig, share: float) -> SynthesizeConfig:
    """How renders are repaired, in one pass from nothing that was measured, after a share of the way to the places of generated views.
    Paths with a name begin at the end of the way."""
    shifts = tuple(round(share * shift, 4) for shift in generator.shifts_m if shift)
    return replace(
        generator, condition="repair", steps=1, samples=1, shifts_m=shifts,
        paths=generator.paths if share == 1 or not shifts else (),
    )  # fmt: skip
