"""``mudg bench``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.engine import Output
from mudg.steps.step import Flag

if TYPE_CHECKING:
    from mudg.benchmarks.settings import BenchConfig
    from mudg.steps.settings import PresetName


class Bench(Output):
    """Run a benchmark: shift or loop against exact truth, real on real logs, paper for tables of papers."""

    examples = (
        "mudg bench shift --list development --logs 1 --fit.virtual.probability 0.4 --out runs/shift",
        "mudg bench loop --list reported --out runs/loop",
        "mudg bench real logs/pandaset_002 --frames 32:56 --resolution 960 --protocols gap camera --out runs/real",
        "mudg bench paper city:reported --table mudg1 --out runs/mudg1",
        "mudg bench paper logs/* --table mudg2 --preset paper --model models/mudg_1024 --out runs/mudg2",
    )
    short = ("model", "seed", "device")
    parts = {
        "shift": "Measure complete methods off the recorded path, against exact truth.",
        "real": "Measure complete methods on real logs.",
        "loop": "Drive in fitted scenes, against the exact city.",
        "paper": "Fill a table of a paper.",
    }
    name: Annotated[str, Flag("BENCHMARK", "first")]
    """Benchmark to run: shift (complete methods off the recorded path), loop (drives in fitted scenes), real (complete
    methods on real logs) or paper (a table of a paper)."""
    sources: Annotated[tuple[Path, ...], Flag("[LOG ...]", "rest")] = ()
    """real, paper: folders of dataset logs, or scenes made by ingest. paper also takes city:reported or
    city:development, a list of generated cities."""
    preset: PresetName = "default"
    """Settings of clouds, generated views and fits to start from, as for mudg run
    (docs/presets.md). paper: the published set-up, with a published-type model."""
    settings: BenchConfig

    @classmethod
    def settings_from(cls, inputs: Mapping[str, Any], file: Path | None, given: Mapping[str, Any]) -> BenchConfig:
        """Preset, then the file, then single settings."""
        from mudg.base import config as configuration
        from mudg.benchmarks.settings import BenchConfig, bench_preset

        return configuration.load(BenchConfig, bench_preset(inputs["preset"]), file, given)

    @classmethod
    def applies(cls, part: str, name: str, text: str) -> bool:
        """Texts of flags that not all benchmarks take begin with those that do."""
        if name == "name":
            return False
        if "." in name:
            return part == "paper" or not name.startswith("score.")
        tags = [re.findall(r"[a-z0-9]+", tag) for tag in re.findall(r"(?:^|\. )([a-z0-9,; ]+): ", text)]
        named = {word for tag in tags for word in tag if word in cls.parts}
        return not named or part in named

    def act(self) -> Path:
        from mudg.benchmarks import run as bench

        return bench.run(
            self.name, self.settings, self.out, sources=self.sources, preset=self.preset, overwrite=self.overwrite
        )

    def answer(self, outcome: Any) -> dict[str, Any]:
        from mudg.base import store

        return {"bench": outcome / "bench.json", "text": store.read_text(outcome / "bench.md")}
