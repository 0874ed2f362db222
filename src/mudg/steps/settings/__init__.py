"""The frozen configuration of every verb, one file per verb or group; none imports torch, so that ``--help`` answers at once.

Defaults are a full run on a small machine. Every field is one flag; units are in the names. Names are looked up on first use, so that a
command reads the settings of its own verb only.
"""

from __future__ import annotations

import importlib

_HOMES = {
    "BatchConfig": "mudg.fleet.settings",
    "BenchConfig": "mudg.benchmarks.settings",
    "BenchOwn": "mudg.benchmarks.settings",
    "ConvertConfig": "mudg.diffusion.settings.convert",
    "EditConfig": "mudg.editing.settings",
    "ExportConfig": "mudg.exporting.settings",
    "FitConfig": "mudg.gaussians.settings",
    "HarmonizeConfig": "mudg.diffusion.settings.harmonize",
    "LearnConfig": "mudg.diffusion.settings.learn",
    "AdaptConfig": "mudg.diffusion.settings.adapt",
    "AnnotateConfig": "mudg.labels.settings",
    "FuseConfig": "mudg.scene.settings",
    "ImportConfig": "mudg.exporting.settings",
    "IngestConfig": "mudg.formats.settings",
    "DEMO_CITY": "mudg.steps.settings.presets",
    "PRESETS": "mudg.steps.settings.presets",
    "PresetName": "mudg.steps.settings.presets",
    "bench_preset": "mudg.benchmarks.settings",
    "chosen_preset": "mudg.steps.settings.presets",
    "RunConfig": "mudg.steps.settings.run",
    "run_preset": "mudg.steps.settings.presets",
    "on_device": "mudg.steps.settings.run",
    "with_device": "mudg.steps.settings.run",
    "with_lines": "mudg.steps.settings.run",
    "with_seed": "mudg.steps.settings.run",
    "SynthesizeConfig": "mudg.diffusion.settings.synthesize",
    "PageConfig": "mudg.viewer.settings",
    "ViewConfig": "mudg.viewer.settings",
    "RenderConfig": "mudg.editing.view_settings",
    "ScoreConfig": "mudg.editing.view_settings",
}

def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value
