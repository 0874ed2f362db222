"""The frozen configuration of every verb, one file per verb or group; none imports torch, so that ``--help`` answers at once.

Defaults are a full run on a small machine. Every field is one flag; units are in the names. Names are looked up on first use, so that a
command reads the settings of its own verb only.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mudg.stages.config.adapt import AdaptConfig
    from mudg.stages.config.annotate import AnnotateConfig
    from mudg.stages.config.batch import BatchConfig
    from mudg.stages.config.bench import BenchConfig, BenchOwn, bench_preset
    from mudg.stages.config.convert import ConvertConfig
    from mudg.stages.config.edit import EditConfig
    from mudg.stages.config.export import ExportConfig, ImportConfig
    from mudg.stages.config.fit import FitConfig
    from mudg.stages.config.fuse import FuseConfig
    from mudg.stages.config.harmonize import HarmonizeConfig
    from mudg.stages.config.ingest import IngestConfig
    from mudg.stages.config.learn import LearnConfig
    from mudg.stages.config.presets import DEMO_CITY, PRESETS, PresetName, chosen_preset, run_preset
    from mudg.stages.config.run import RunConfig, on_device, with_device, with_lines, with_seed
    from mudg.stages.config.synthesize import SynthesizeConfig
    from mudg.stages.config.view import PageConfig, ViewConfig
    from mudg.stages.config.views import RenderConfig, ScoreConfig

_HOMES = {
    "BatchConfig": "mudg.stages.config.batch",
    "BenchConfig": "mudg.stages.config.bench",
    "BenchOwn": "mudg.stages.config.bench",
    "ConvertConfig": "mudg.stages.config.convert",
    "EditConfig": "mudg.stages.config.edit",
    "ExportConfig": "mudg.stages.config.export",
    "FitConfig": "mudg.stages.config.fit",
    "HarmonizeConfig": "mudg.stages.config.harmonize",
    "LearnConfig": "mudg.stages.config.learn",
    "AdaptConfig": "mudg.stages.config.adapt",
    "AnnotateConfig": "mudg.stages.config.annotate",
    "FuseConfig": "mudg.stages.config.fuse",
    "ImportConfig": "mudg.stages.config.export",
    "IngestConfig": "mudg.stages.config.ingest",
    "DEMO_CITY": "mudg.stages.config.presets",
    "PRESETS": "mudg.stages.config.presets",
    "PresetName": "mudg.stages.config.presets",
    "bench_preset": "mudg.stages.config.bench",
    "chosen_preset": "mudg.stages.config.presets",
    "RunConfig": "mudg.stages.config.run",
    "run_preset": "mudg.stages.config.presets",
    "on_device": "mudg.stages.config.run",
    "with_device": "mudg.stages.config.run",
    "with_lines": "mudg.stages.config.run",
    "with_seed": "mudg.stages.config.run",
    "SynthesizeConfig": "mudg.stages.config.synthesize",
    "PageConfig": "mudg.stages.config.view",
    "ViewConfig": "mudg.stages.config.view",
    "RenderConfig": "mudg.stages.config.views",
    "ScoreConfig": "mudg.stages.config.views",
}

__all__ = [
    "DEMO_CITY",
    "PRESETS",
    "AdaptConfig",
    "AnnotateConfig",
    "BatchConfig",
    "BenchConfig",
    "BenchOwn",
    "ConvertConfig",
    "EditConfig",
    "ExportConfig",
    "FitConfig",
    "FuseConfig",
    "HarmonizeConfig",
    "ImportConfig",
    "IngestConfig",
    "LearnConfig",
    "PageConfig",
    "PresetName",
    "RenderConfig",
    "RunConfig",
    "ScoreConfig",
    "SynthesizeConfig",
    "ViewConfig",
    "bench_preset",
    "chosen_preset",
    "on_device",
    "run_preset",
    "with_device",
    "with_lines",
    "with_seed",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
