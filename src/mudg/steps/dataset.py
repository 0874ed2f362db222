"""``mudg dataset``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from mudg.base.errors import UsageError
from mudg.steps.engine import Make, Output
from mudg.steps.step import FILE_YAML, Flag

if TYPE_CHECKING:
    from mudg.base.run_folder import VerbOutput
    from mudg.datasets.settings import DatasetConfig
    from mudg.datasets.write import LabelledDrive


class Dataset(Output):
    """Write labelled images of reconstructions as a data set: kitti, kitti-tracking, coco, nuscenes or py123d."""

    section = "other programs"
    examples = (
        "mudg dataset kitti runs/kitti --shifts-m 0 2 -2 --out data/shifted",
        "mudg dataset coco runs/a runs/b --val runs/c --cameras front --every 2 --out data/coco",
    )
    smaller = "smaller images (--width-px)"
    result = "dataset"
    format: Annotated[str, Flag("FORMAT", "first")]
    """kitti: images, calibration and 3D boxes as in KITTI's object benchmark. kitti-tracking: the same by sequence,
    with track ids and poses. coco: instances with masks, and panoptic segmentation. nuscenes: all tables and images of
    a release, every path a scene. py123d: Arrow logs of 123D."""
    runs: Annotated[tuple[Path, ...], Flag("RUN ...", "rest")]
    """Folders of finished mudg runs, or of a fit (with --scene). They form the split train."""
    val: Annotated[tuple[Path, ...], Flag("RUN ...")] = ()
    """More of them, which form the split val."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a fit belongs to. A run has its own."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) to carry out before; with one RUN."""
    path: Annotated[Path | None, Flag("FILE")] = None
    """Camera path that stands for the shifts, as of mudg render --path; with one RUN."""
    settings: DatasetConfig

    def output(self) -> VerbOutput:
        from mudg.base.run_folder import VerbOutput
        from mudg.datasets.write import FORMATS

        return VerbOutput(f"dataset {self.format}", 2, FORMATS[self.format].files)

    def checked(self) -> Self:
        from mudg.datasets.write import FORMATS

        if self.format not in FORMATS:
            raise UsageError("no such data set format", expected=", ".join(FORMATS), got=self.format)
        for flag in ("scene", "edits", "path"):
            if getattr(self, flag) is not None and len(self.runs) + len(self.val) > 1:
                raise UsageError("this belongs to one drive", where=f"--{flag}", got=f"{len(self.runs)} RUN")
        FORMATS[self.format].check()
        return self

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.datasets import write

        return partial(write.write_dataset, self.format, self.settings, self._drives(inputs))

    def _drives(self, inputs: dict[str, str]) -> list[LabelledDrive]:
        """Drives by split. Of folders of one name the later ones are numbered."""
        from mudg.datasets.write import LabelledDrive

        made: dict[str, LabelledDrive] = {}
        for split, runs in (("train", self.runs), ("val", self.val)):
            for number, run in enumerate(runs):
                same = sum(one.run.name == run.name for one in made.values())
                name = f"{run.name}-{same}" if same else run.name
                key = "runs" if split == "train" else "val"
                provenance = {"run": inputs[f"{key} {number}" if number else key], "edits": inputs.get("edits", "")}
                made[name] = LabelledDrive(name, run, self.scene, self.edits, split, self.path, provenance)
        return list(made.values())
