"""Settings of ``mudg bench``."""

from __future__ import annotations

from typing import Literal

from mudg.base.config import changed, setting, settings
from mudg.base.devices import DeviceName
from mudg.diffusion.settings import SynthesizeConfig
from mudg.editing.settings import ScoreConfig
from mudg.gaussians.settings import FitConfig
from mudg.scene.settings import FuseConfig
from mudg.steps.settings import PresetName, run_preset

_Mudg = Literal["mudg1", "mudg2", "mudg3"]
_Others = Literal["recam", "spvc", "panda", "dist"]


@settings
class BenchConfig:
    """Measure complete methods: off the recorded path of generated cities against exact ground truth, in drives through
    them, on real logs, or in a table of a paper."""

    model: str = "embedded"
    """Diffusion model: "embedded" or "embedded-tiny", both shipped with the package, or a model folder written by learn
    or convert."""
    precision: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """Number format of the diffusion model. auto: bfloat16 on CUDA devices and CPUs that compute in it, float32
    elsewhere. float16: published-type models on CUDA devices."""
    seed: int = 0
    """Seed of all random numbers; the same seed gives the same result."""
    list: Literal["development", "reported"] = "development"
    """shift, loop: list of logs. Choose settings on development; report results on reported, on which nothing was
    chosen."""
    logs: int = setting(default=8, ge=1, le=8)
    """shift, loop; paper with a list of cities: number of logs taken from the list, 1 to 8 (the development list has
    4)."""
    methods: tuple[str, ...] = ("nearest_fill", "gs3d", "street_gaussians", "mudg_r", "mudg_s")
    """Methods to compare: those of the default (loop: street_gaussians and mudg_s); pvg, s3gaussian,
    bezier, omnire, emernerf and difix; and street_gaussians-longer, which goes on until it has as many steps as mudg_s,
    without generated views. Also mudg_f, renders of mudg_s that the diffusion model repairs. paper: any of these but
    mudg_f; with the default, all of them."""
    iterations: int = setting(default=1000, ge=1)
    """Optimisation steps of every fit without virtual views."""
    guided_share: float = setting(default=1.5, gt=0)
    """Steps of fits under virtual views, as a multiple of the others'."""
    processes: int = setting(default=0, ge=0)
    """Number of logs (real: also ways of hiding frames) processed at the same time, with one thread each (0 = one per
    core). Results do not depend on it."""
    videos: bool = True
    """shift, paper: also write videos of all methods side by side."""
    table: Literal[_Mudg, "recondreamer", "drivedreamer4d", "streetcrafter", "freesim", _Others] = "mudg1"
    """paper: the table to fill (docs/paper_tables.md)."""
    protocols: tuple[str, ...] = ("gap", "camera", "lidar")
    """real: protocols, out of the three of the default. Instead of gap also gap-1, gap-3 and gap-5 alone."""
    shown: tuple[str, ...] = ()
    """real: cameras that the methods see in protocol camera; the first one gives the views beside the recorded path
    (empty = front, or the first camera)."""
    resolution: str = ""
    """real, paper: image size of logs that are imported, as for ingest (empty = as recorded; paper: as the table says).
    paper with a list of cities: WIDTHxHEIGHT (empty = 384x256)."""
    frames: str = ""
    """real, paper: frames of logs that are imported, FIRST:END without END itself, as for ingest (empty = all; paper:
    as the table says). paper with a list of cities: 0:END (empty = 0:24)."""
    device: DeviceName = "auto"
    """Device of all steps: auto (CUDA if there is one), cpu, cuda, cuda:N."""
    fuse: FuseConfig = setting(default_factory=FuseConfig)
    """How the clouds of every log are made."""
    synthesize: SynthesizeConfig = setting(default_factory=SynthesizeConfig)
    """How views are generated. Model, number format, seed and device are the benchmark's own flags;
    where views are generated is the benchmark's matter (real: `--synthesize.shifts-m` for the views that fits learn
    from)."""
    fit: FitConfig = setting(default_factory=FitConfig)
    """How scenes are fitted. Method, steps, seed and device are the benchmark's own flags."""
    score: ScoreConfig = setting(default_factory=ScoreConfig)
    """paper: how every row is scored; files of weights are given here."""


def bench_preset(name: PresetName = "default") -> BenchConfig:
    """The settings of ``mudg bench`` before any file or flag: those of a preset that say
    how clouds, views and fits are made. Which logs, and their size, is the benchmark's matter. UsageError: no such
    preset."""
    run = run_preset(name)
    usual = SynthesizeConfig()
    return changed(
        BenchConfig(),
        {
            "model": run.synthesize.model,
            "iterations": run.fit.iterations,
            "guided_share": run.guided_share,
            "fuse": run.fuse,
            "synthesize": changed(run.synthesize, {"model": usual.model, "cameras": usual.cameras}),
            "fit": changed(run.fit, {"iterations": FitConfig().iterations}),
        },
    )
