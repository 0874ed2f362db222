"""Fields that many steps share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from mudg.base.errors import UsageError
from mudg.steps.step import Flag, Step


class Output(Step):
    """A step that writes a folder."""

    out: Annotated[Path, Flag()]
    """Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified and
    reused."""
    overwrite: bool = False
    """Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one is
    finished, so the disk must hold both. Files that do not belong to the old result are kept."""


class Listed(Output):
    """A step that also works on a list of sources."""

    list: Annotated[Path | None, Flag("FILE")] = None
    """Process many sources: a file with one source per line (SOURCE [name=NAME] ...), or a folder of sources. Each result goes to
    OUT/NAME. The exit code is 0, or 10 + the number of failures."""
    shard: Annotated[str, Flag("i/n")] = ""
    """With --list: process the i-th of n parts of the list; i counts from 0 to n-1. A scene's part depends on its name alone. Use it
    to split a list over machines."""
    jobs: int = 0
    """With --list: number of scenes processed at the same time (0 = one per processor)."""

    def refuse_wrong_list(self, source: object) -> None:
        """UsageError unless there is either a source or a list, and --shard and --jobs only with a list."""
        if self.list is None and (self.shard or self.jobs):
            raise UsageError("--shard and --jobs need --list", remedy="leave them out, or give --list FILE")
        if self.list is None and not source:
            raise UsageError(f"no {self.verb()} input was given", expected=f"{self.examples[0]}, or --list FILE")
        if self.list is not None and source:
            raise UsageError("give a source or a list, not both", got=f"{source} and --list {self.list}")

    def run_list(self, run_many: Any) -> dict[str, Any]:
        """Call a stage's function for lists."""
        return run_many(self.settings, self.list, self.out, self.shard, self.jobs, self.overwrite)  # type: ignore[attr-defined]
