"""``mudg bench``: measurements that print a table, each from one command.

``mdm`` and ``edit`` are one folder, with OUT/clips/ (or cities, fits, ...), OUT/bench.json, OUT/bench.md and pictures.
``shift``, ``real``, ``paper`` and ``loop`` compare rows (``benchmarks/rows.py``) on logs
(``benchmarks/places.py``), worked on in one loop (``benchmarks/chain.py``), in folders of their steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch

from mudg.base import store
from mudg.base.config import result_settings
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import UsageError
from mudg.base.run_folder import RunDir, VerbOutput, refuse_overlap
from mudg.benchmarks import cities, loop, paper, real, shift
from mudg.benchmarks.rows import changed_settings, generator_of
from mudg.benchmarks.settings import BenchConfig, bench_preset
from mudg.diffusion import model_files
from mudg.diffusion.model_files import is_published
from mudg.gaussians.settings import FitConfig
from mudg.steps.pipeline import refuse_missing
from mudg.steps.settings import PresetName
from mudg.steps.step import flag_name

_FILES = ("bench.json", "bench.md", "*.png", "clips/*", "cities/", "edited/", "fits/", "rows/*.json")
EDIT, SHIFT, REAL, PAPER, LOOP = "edit", "shift", "real", "paper", "loop"
CHAINS = (SHIFT, REAL, PAPER, LOOP)
"""Benchmarks of complete methods: they take the chain of `mudg run`, with its presets."""
USED: Final[Mapping[str, tuple[str, ...]]] = {
    setting: tuple(users)
    for users, names in (
        (("mdm",), "steps eta"),
        (("mdm", EDIT), "cities count threads"),
        (("mdm", *CHAINS), "model precision"),
        ((EDIT,), "edit_iterations"),
        (("mdm", EDIT, *CHAINS), "seed device"),
        (CHAINS, "methods iterations guided_share processes fuse synthesize fit"),
        ((SHIFT, LOOP), "list"),
        ((SHIFT, PAPER, LOOP), "logs"),
        ((SHIFT, PAPER), "videos"),
        ((SHIFT, REAL), "variant"),
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
"""Settings of steps that a benchmark of complete methods chooses itself, and what to do instead."""


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
    of cities, for paper. ``preset``: what the configuration started from, for shift, real and
    paper. UsageError: no such benchmark, a setting that it does not use, or logs for one that makes its own."""
    if name not in (*BENCHES, *CHAINS):
        raise UsageError("no such benchmark", expected=", ".join((*BENCHES, *CHAINS)), got=name)
    refuse_unused(name, config, preset)
    if name == PAPER:
        return paper.run(config, sources, out, preset=preset, overwrite=overwrite)
    if name == REAL:
        return real.run(config, sources, out, preset=preset, overwrite=overwrite)
    if sources:
        got = ", ".join(map(str, sources))
        raise UsageError("this benchmark makes its own logs", where=f"mudg bench {name}", got=got)
    if name in (SHIFT, LOOP):
        return (shift if name == SHIFT else loop).run(config, out, preset=preset, overwrite=overwrite)
    inputs = {"model": model_files.digest(config.model)} if name == "mdm" else {}  # edit reads no diffusion model
    refuse_overlap(out, {"model": model_files.folder_of(config.model) if inputs else ""})
    choose_device(config.device, "benchmark", NETWORK_KINDS)  # refused before anything is written
    directory = RunDir.open(out, VerbOutput(f"bench {name}", 1, _FILES), result_settings(config), inputs, overwrite)
    if directory.complete:
        return directory.reused()
    torch.set_num_threads(config.threads)
    result, text = BENCHES[name](config, directory.path)
    store.write_json(directory.path / "bench.json", result)
    store.write_text(directory.path / "bench.md", text)
    directory.finish({"measurement": name})
    return directory.path


def refuse_unused(name: str, config: BenchConfig, preset: PresetName) -> None:
    """UsageError for a preset, or a setting that differs from it, of which a benchmark makes no use, and where weights
    are missing."""
    if name not in CHAINS and preset != "default":
        what = "only benchmarks of complete methods have presets"
        raise UsageError(what, where="--preset", expected=", ".join(CHAINS), got=name, remedy="leave it out")
    for setting in changed_settings(config, bench_preset(preset)):
        users, group = USED[setting.split(".")[0]], f"synthesize.{setting}"
        if name not in users:
            elsewhere = name in CHAINS and setting in ("steps", "eta")
            what, expected = (
                f"mudg bench {name} does not use this setting",
                " or ".join(map("mudg bench {}".format, users)),
            )
            remedy = f"give {flag_name(group)}" if elsewhere else "leave it out"
            raise UsageError(what, where=flag_name(setting), expected=expected, remedy=remedy)
        if setting in OWN and (setting, name) != ("synthesize.shifts_m", REAL):
            raise UsageError("the benchmark chooses this itself", where=flag_name(setting), remedy=OWN[setting])
    if name in CHAINS:
        refuse_missing(generator_of(config), FitConfig(), "--model")
    if name == "mdm" and is_published(config.model):
        what = "mudg bench mdm measures small models"
        remedy = "mudg bench paper --table mudg2 measures published-type ones"
        raise UsageError(what, where="--model", got=config.model, remedy=remedy)


BENCHES: dict[str, Callable[[BenchConfig, Path], tuple[dict[str, Any], str]]] = {
    "mdm": cities.measure_mdm,
    EDIT: cities.measure_edits,
}
"""Every measurement that is one folder, by name."""
