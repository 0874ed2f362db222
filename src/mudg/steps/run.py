"""``mudg run`` and ``mudg demo``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.engine import Output
from mudg.steps.step import Flag

if TYPE_CHECKING:
    from mudg.steps.settings import PresetName, RunConfig


class Run(Output):
    """Run all steps on your own driving log or scene and write a report page."""

    examples = (
        "mudg run ~/kitti/2011_09_26_drive_0001_sync --out runs/kitti",
        "mudg run scenes/a --out runs/a --preset quality",
    )
    short = ("device", "guided_share")
    source: Annotated[str, Flag("SOURCE", "first")]
    """Folder of a dataset log (its format is recognised), a scene directory, or the word city."""
    preset: PresetName | None = None
    """Settings to start from. fast: smaller images, fewer frames and iterations. default: minutes on two cores.
    quality: 30,000 iterations, millions of Gaussians, for a GPU. paper: the published set-up, with a published-type
    model (docs/presets.md)."""
    fast: bool = False
    """The same as --preset fast: images of a log 480 pixels wide, 3 m to each side. One to two minutes on 2 cores for
    16 frames of one camera."""
    seed: Annotated[int | None, Flag("INT")] = None
    """Seed of all random numbers in all steps (not given: city 3 and seed 0, or the values in --config)."""
    cameras: tuple[str, ...] = ()
    """Cameras for which shifted trajectories are made (not given: the first camera)."""
    shifts_m: tuple[float, ...] = ()
    """Lateral shifts in metres, positive to the left (not given: 2, 3 and 4 m to both sides; --fast: 3 m). They apply
    to synthesize, render and score."""
    settings: RunConfig

    @classmethod
    def settings_from(cls, inputs: Mapping[str, Any], file: Path | None, given: Mapping[str, Any]) -> RunConfig:
        """Preset, then the file, then seed, cameras and shifts, then settings of single steps."""
        from mudg.base import config as configuration
        from mudg.steps.settings import RunConfig, chosen_preset, run_preset, with_lines, with_seed

        config = configuration.load(RunConfig, run_preset(chosen_preset(inputs["preset"], inputs["fast"])), file)
        config = config if inputs["seed"] is None else with_seed(config, inputs["seed"])
        config = with_lines(config, cameras=inputs.get("cameras") or None, shifts_m=inputs["shifts_m"] or None)
        return configuration.load(RunConfig, config, None, given)

    def act(self) -> dict[str, Any]:
        from mudg.steps import pipeline

        return pipeline.run_chain(self.settings, self.source, self.out, overwrite=self.overwrite)


class Demo(Run):
    """Run all steps on the built-in city and write a report page."""

    examples = ("mudg demo", "mudg demo --fast --out runs/first", "mudg demo --seed 7 --out city7")
    source: Annotated[str, Flag(hidden=True)] = "city"
    cameras: Annotated[tuple[str, ...], Flag(hidden=True)] = ()
    out: Annotated[Path, Flag()] = Path("mudg_demo")
    """Folder to write. Repeat the same command to resume an interrupted demo."""
    preset: PresetName | None = None
    """Settings to start from. fast: smaller images, fewer frames and iterations. default: minutes on two cores.
    quality: 30,000 iterations, millions of Gaussians, for a GPU. paper: the published set-up, with a published-type
    model (docs/presets.md)."""
    fast: bool = False
    """The same as --preset fast, 3 m to each side: one to two minutes on 2 cores."""
    seed: Annotated[int | None, Flag("INT")] = None
    """Seed of the city and of all random numbers in all steps (not given: city 3 and seed 0, or the values in
    --config)."""
