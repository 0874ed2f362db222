"""The frozen configuration of every verb, one file per verb or group; none imports torch, so that ``--help`` answers at once.

Defaults are a full run on a small machine. Every field is one flag; units are in the names.
"""

from __future__ import annotations

from mudg.stages.config.bench import BenchConfig
from mudg.stages.config.convert import ConvertConfig
from mudg.stages.config.fit import (
    AppearanceConfig,
    DensifyConfig,
    FitConfig,
    ObjectConfig,
    PoseConfig,
    RecordedLossConfig,
    StartConfig,
    VirtualConfig,
)
from mudg.stages.config.learn import LearnConfig
from mudg.stages.config.prepare import AnnotateConfig, FuseConfig, IngestConfig
from mudg.stages.config.run import DEMO_CITY, RunConfig, run_preset, with_lines, with_seed
from mudg.stages.config.synthesize import SynthesizeConfig
from mudg.stages.config.views import RenderConfig, ScoreConfig

__all__ = [
    "AnnotateConfig",
    "AppearanceConfig",
    "BenchConfig",
    "ConvertConfig",
    "DEMO_CITY",
    "DensifyConfig",
    "FitConfig",
    "FuseConfig",
    "IngestConfig",
    "LearnConfig",
    "ObjectConfig",
    "PoseConfig",
    "RecordedLossConfig",
    "RenderConfig",
    "RunConfig",
    "ScoreConfig",
    "StartConfig",
    "SynthesizeConfig",
    "VirtualConfig",
    "run_preset",
    "with_lines",
    "with_seed",
]
