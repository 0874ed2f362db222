"""``mudg bench``: measurements of complete methods that print a table, each from one command.

They compare rows (``benchmarks/rows.py``) on logs (``benchmarks/places.py``), worked on in one loop
(``benchmarks/chain.py``), in folders of their steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from mudg.base.errors import UsageError
from mudg.benchmarks import loop, paper, real, shift
from mudg.benchmarks.rows import changed_settings, generator_of
from mudg.benchmarks.settings import BenchConfig, bench_preset
from mudg.gaussians.settings import FitConfig
from mudg.steps.pipeline import refuse_missing
from mudg.steps.settings import PresetName
from mudg.steps.step import flag_name

SHIFT, REAL, PAPER, LOOP = "shift", "real", "paper", "loop"
BENCHES: Final = (SHIFT, REAL, PAPER, LOOP)
USED: Final[Mapping[str, tuple[str, ...]]] = {
    setting: tuple(users)
    for users, names in (
        (BENCHES, "model precision seed device methods iterations guided_share processes fuse synthesize fit"),
        ((SHIFT, LOOP), "list"),
        ((SHIFT, PAPER, LOOP), "logs"),
        ((SHIFT, PAPER), "videos"),
        ((REAL,), "protocols shown"),
        ((REAL, PAPER), "resolution frames"),
        ((PAPER,), "table score"),
    )
    for setting in names.split()
}
"""Setting or group of settings -> the benchmarks that use it; the others refuse it."""
OWN: Final[Mapping[str, str]] = {
    **{f"synthesize.{name}": f"give --{name}" for name in ("model", "precision", "seed", "device", "processes")},
    **{f"fit.{name}": f"give --{name}" for name in ("iterations", "seed", "device")},
    "fit.method": "give --methods",
    **dict.fromkeys((f"synthesize.{name}" for name in ("cameras", "shifts_m", "paths", "condition")), "leave it out"),
    **dict.fromkeys((f"score.{name}" for name in ("baseline", "error_pictures", "perceptual_views")), "leave it out"),
}
"""Settings of steps that a benchmark chooses itself, and what to do instead."""


def run(
    name: str,
    config: BenchConfig,
    out: Path,
    *,
    sources: Sequence[Path] = (),
    preset: PresetName = "default",
    overwrite: bool = False,
) -> Path:
    """Run a benchmark; returns the folder with `bench.json` and `bench.md`. ``sources``: logs, for real; logs or a list
    of cities, for paper. ``preset``: what the configuration started from. UsageError: no such benchmark, a setting that
    it does not use, or logs for one that makes its own."""
    if name not in BENCHES:
        raise UsageError("no such benchmark", expected=", ".join(BENCHES), got=name)
    refuse_unused(name, config, preset)
    if name in (REAL, PAPER):
        return (real if name == REAL else paper).run(config, sources, out, preset=preset, overwrite=overwrite)
    if sources:
        got = ", ".join(map(str, sources))
        raise UsageError("this benchmark makes its own logs", where=f"mudg bench {name}", got=got)
    return (shift if name == SHIFT else loop).run(config, out, preset=preset, overwrite=overwrite)


def refuse_unused(name: str, config: BenchConfig, preset: PresetName) -> None:
    """UsageError for a setting beyond the preset of which a benchmark makes no use, and where weights are missing."""
    for setting in changed_settings(config, bench_preset(preset)):
        users = USED[setting.split(".")[0]]
        if name not in users:
            what, expected = (
                f"mudg bench {name} does not use this setting",
                " or ".join(f"mudg bench {u}" for u in users),
            )
            raise UsageError(what, where=flag_name(setting), expected=expected, remedy="leave it out")
        if setting in OWN and (setting, name) != ("synthesize.shifts_m", REAL):
            raise UsageError("the benchmark chooses this itself", where=flag_name(setting), remedy=OWN[setting])
    refuse_missing(generator_of(config), FitConfig(), "--model")
