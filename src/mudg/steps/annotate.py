"""``mudg annotate``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self, cast

from mudg.base.layout import SCENE_FILES
from mudg.steps.engine import Make
from mudg.steps.outputs import Listed
from mudg.steps.step import Flag

if TYPE_CHECKING:
    from mudg.labels.settings import AnnotateConfig


class Annotate(Listed):
    """Add missing labels to a scene: semantics, sky and depth, with confidences."""

    section = "single steps, in the order of use"
    examples = ("mudg annotate scenes/kitti --out scenes/kitti_labelled", "mudg annotate --list scenes --out labelled")
    smaller = "one process (--processes 1), or smaller images (mudg ingest --resolution)"
    result = "scene"
    version, files = 4, (*SCENE_FILES, "labels.html", "pictures/*.jpg", "labelled/")
    idle = ("processes",)
    short = ("labeller", "weights", "depth_network", "device", "sweeps", "ego", "processes")
    scene: Annotated[Path | None, Flag("[SCENE]", "first", "scene")] = None
    """Scene directory written by ingest, or folder of mudg run."""
    settings: AnnotateConfig

    def settings_in_list(self) -> AnnotateConfig:
        return replace(self.settings, processes=1)

    def checked(self) -> Self:
        from mudg.labels import annotate as depth

        return replace(self, settings=depth.placed(self.settings))

    def reads(self) -> dict[str, Path | str | None]:
        from mudg.labels import annotate as depth

        return super().reads() | depth.folders(self.settings)

    def inputs(self) -> dict[str, str]:
        from mudg.labels import annotate as depth

        return super().inputs() | depth.digests(self.settings)

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.labels import annotate

        return partial(annotate.write_labelled, self.settings, cast("Path", self.scene))
