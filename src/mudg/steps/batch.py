"""``mudg batch run``, ``mudg batch status`` and ``mudg batch retry``."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.run import Preset
from mudg.steps.step import Flag, Step

if TYPE_CHECKING:
    from mudg.stages.config import BatchConfig

OUT = Flag("OUT", "first")


class BatchRun(Step):
    """Process a list of logs on this machine, Slurm or Ray, or go on with it."""

    section = "many drives"
    examples = (
        "mudg batch run --list logs.txt --out runs --stages ingest annotate fuse --jobs 2",
        "mudg batch run --list s3://data/logs.txt --out s3://data/runs --engine slurm --shards 500 --config recipe.yaml",
    )
    smaller = "fewer --jobs, or smaller images (--set ingest.resolution=960)"
    short = ("stages", "command", "engine", "shards", "jobs", "max_failures")
    list: Annotated[str, Flag("FILE|URL")]
    """File with one source per line (SOURCE [name=NAME] ...), or a folder of sources. Sources may be addresses."""
    out: Annotated[str, Flag("FOLDER|URL")]
    """Folder, or address in an object store (s3://bucket/runs), for results and records."""
    config: Annotated[Path | None, Flag("FILE.yaml")] = None
    """Settings of the steps: a file of mudg run."""
    preset: Preset = "default"
    """Settings of the steps to start from, as for mudg run."""
    set: Annotated[tuple[str, ...], Flag("STEP.NAME=VALUE ...")] = ()
    """Settings of the steps, over those of --config, as fit.iterations=500 device=cpu."""
    scratch: Path | None = None
    """Folder for unfinished results and fetched inputs (not given: in --out if that is a folder, else the system's)."""
    dry_run: bool = False
    """Only say what there is to do."""
    wait: bool = False
    """With --engine slurm, wait for the end of the job."""
    settings: BatchConfig

    @classmethod
    def verb(cls) -> str:
        return "batch run"

    @classmethod
    def settings_from(cls, inputs: Mapping[str, Any], file: Path | None, given: Mapping[str, Any]) -> BatchConfig:
        """The settings of the batch itself; a file holds those of its steps."""
        return super().settings_from(inputs, None, given)

    def run(self) -> dict[str, Any]:
        from mudg.stages import batch

        settings = batch.settings_of(self.preset, self.config, self.set)
        request = batch.BatchRequest(self.list, self.out, self.settings, settings, tuple(sys.argv[1:]), self.wait, self.scratch)
        return batch.run(request, self.dry_run)


class BatchProgress(Step):
    """Show how far a batch is."""

    section = "many drives"
    examples = ("mudg batch status runs --html",)
    out: Annotated[str, OUT]
    """Folder or address of a batch."""
    html: bool = False
    """Also write OUT/status.html, with figures of the logs."""
    watch_s: float = 0.0
    """Show it again every so many seconds, until nothing is left (0 = once)."""

    @classmethod
    def verb(cls) -> str:
        return "batch status"

    def run(self) -> dict[str, Any]:
        from mudg.stages import batch

        return batch.watch_status(self.out, self.html, self.watch_s)


class BatchRetry(Step):
    """Forget failures of a batch, so that the next run tries them again."""

    section = "many drives"
    examples = ("mudg batch retry runs --reason 5,137",)
    out: Annotated[str, OUT]
    """Folder or address of a batch."""
    reason: str = ""
    """Only these exit codes or reasons, with commas, e.g. 5,137 (empty = all)."""

    @classmethod
    def verb(cls) -> str:
        return "batch retry"

    def run(self) -> dict[str, Any]:
        from mudg.stages import batch

        return batch.retry(self.out, self.reason)
