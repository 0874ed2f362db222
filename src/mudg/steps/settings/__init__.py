"""Settings that belong to no single room: presets, those of whole runs, and what runs cost. Beside: where those of each
verb are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

HOMES: Final[Mapping[str, str]] = {
    "AdaptConfig": "mudg.diffusion.settings.adapt:AdaptConfig",
    "AnnotateConfig": "mudg.labels.settings:AnnotateConfig",
    "BatchConfig": "mudg.fleet.settings:BatchConfig",
    "BenchConfig": "mudg.benchmarks.settings:BenchConfig",
    "BenchOwn": "mudg.benchmarks.settings:BenchOwn",
    "ConvertConfig": "mudg.diffusion.settings.convert:ConvertConfig",
    "EditConfig": "mudg.editing.settings:EditConfig",
    "ExportConfig": "mudg.exporting.settings:ExportConfig",
    "FitConfig": "mudg.gaussians.settings:FitConfig",
    "FuseConfig": "mudg.scene.settings:FuseConfig",
    "HarmonizeConfig": "mudg.diffusion.settings.harmonize:HarmonizeConfig",
    "ImportConfig": "mudg.exporting.settings:ImportConfig",
    "IngestConfig": "mudg.formats.settings:IngestConfig",
    "LearnConfig": "mudg.diffusion.settings.learn:LearnConfig",
    "PageConfig": "mudg.viewer.settings:PageConfig",
    "PresetName": "mudg.steps.settings.presets:PresetName",
    "RenderConfig": "mudg.editing.settings:RenderConfig",
    "RunConfig": "mudg.steps.settings.run:RunConfig",
    "ScoreConfig": "mudg.editing.settings:ScoreConfig",
    "SynthesizeConfig": "mudg.diffusion.settings.synthesize:SynthesizeConfig",
    "ViewConfig": "mudg.viewer.settings:ViewConfig",
}
"""Names that annotations of steps use: each is imported when its verb is."""
