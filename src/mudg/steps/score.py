"""``mudg score``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.base.errors import UsageError
from mudg.steps.outputs import Output
from mudg.steps.step import SCENE, Flag

if TYPE_CHECKING:
    from mudg.stages.config import ScoreConfig


class Score(Output):
    """Compare views with ground truth: metrics, tables, error images."""

    section = "single steps, in the order of use"
    examples = ("mudg score scenes/city --views mudg_s=runs/render mudg_r=runs/virtual --out runs/score",)
    smaller = "smaller views (--width-px), fewer --views"
    short = ("baseline", "lpips_weights", "fid_weights", "fvd_weights", "perceptual_views", "device")
    scene: Annotated[Path, SCENE]
    """Scene directory that the views belong to, or folder of mudg run."""
    views: Annotated[Mapping[str, Path], Flag("NAME=FOLDER ...", "second", "views")]
    """Methods to compare: a name and the folder that render or synthesize wrote, e.g. mudg_s=runs/render. They may also stand after SCENE
    without the flag."""
    fused: Annotated[Path | None, Flag("FOLDER", "", "fused")] = None
    """Point clouds written by fuse. They are needed for the baseline without learning (not given: no baseline)."""
    settings: ScoreConfig

    def run(self) -> Path:
        from mudg.stages import score

        if not self.views:
            raise UsageError("no views were given", where="--views", expected="NAME=FOLDER ...")
        return score.run(self.settings, self.scene, self.views, self.out, fused=self.fused, overwrite=self.overwrite)

    def answer(self, outcome: Any) -> dict[str, Any]:
        from mudg.stages import score

        return {"metrics": outcome / "metrics.json", "text": score.summary_table(outcome)}
