"""``mudg annotate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.outputs import Listed
from mudg.steps.step import Flag

if TYPE_CHECKING:
    from mudg.stages.config import AnnotateConfig


class Annotate(Listed):
    """Add missing labels to a scene: semantics, sky and depth, with confidences."""

    section = "single steps, in the order of use"
    examples = ("mudg annotate scenes/kitti --out scenes/kitti_labelled", "mudg annotate --list scenes --out labelled")
    smaller = "one process (--processes 1), or smaller images (mudg ingest --resolution)"
    result = "scene"
    short = ("labeller", "weights", "depth_network", "device", "sweeps", "ego", "processes")
    scene: Annotated[Path | None, Flag("[SCENE]", "first", "scene")] = None
    """Scene directory written by ingest, or folder of mudg run."""
    settings: AnnotateConfig

    def run(self) -> Any:
        from mudg.stages import annotate

        self.refuse_wrong_list(self.scene)
        if self.scene is None:
            return self.run_list(annotate.run_many)
        return annotate.run(self.settings, self.scene, self.out, overwrite=self.overwrite)
