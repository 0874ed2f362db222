"""``mudg dataset``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from mudg.base.errors import UsageError
from mudg.steps.engine import Make, Output, script_of
from mudg.steps.step import FILE_YAML, RUN, Flag

if TYPE_CHECKING:
    from mudg.base.run_folder import VerbOutput
    from mudg.datasets.settings import DatasetConfig


class Dataset(Output):
    """Write labelled images of a reconstruction as a data set: kitti, coco or nuscenes."""

    section = "other programs"
    examples = (
        "mudg dataset kitti runs/kitti --shifts-m 0 2 -2 --out data/shifted",
        "mudg dataset coco mudg_demo --cameras front --every 2 --out data/coco",
    )
    smaller = "smaller images (--width-px)"
    result = "dataset"
    format: Annotated[str, Flag("FORMAT", "first")]
    """kitti: images, calibration and 3D boxes as in KITTI's object benchmark. coco: instances with masks, and panoptic
    segmentation. nuscenes: all tables and images of a release, every path a scene."""
    run_folder: Annotated[Path, RUN]
    """Folder of a finished mudg run, or of a fit (with --scene)."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a fit belongs to. A run has its own."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) to carry out before."""
    settings: DatasetConfig

    def output(self) -> VerbOutput:
        from mudg.base.run_folder import VerbOutput
        from mudg.datasets.write import FORMATS

        return VerbOutput(f"dataset {self.format}", 1, FORMATS[self.format].files)

    def checked(self) -> Self:
        from mudg.datasets.write import FORMATS

        if self.format not in FORMATS:
            raise UsageError("no such data set format", expected=", ".join(FORMATS), got=self.format)
        return self

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.datasets import write
        from mudg.sim.session import Session

        session = Session(self.run_folder, script_of(self.edits), self.scene, self.settings.device)
        provenance: dict[str, Any] = {"run": inputs["run_folder"], "edits": inputs.get("edits", "")}
        return partial(write.write_dataset, self.format, self.settings, session, provenance)
