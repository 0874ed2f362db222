"""Fields that many steps share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar

from mudg.base.errors import UsageError
from mudg.steps.engine import Result
from mudg.steps.step import Flag, positions


class Output(Result):
    """A step that writes a folder."""

    out: Annotated[Path, Flag()]
    """Folder to write; it must not be one of the inputs. A finished result of the same settings and inputs is verified
    and reused."""
    overwrite: bool = False
    """Replace a result of other settings or inputs in --out instead of refusing. The old result stays until the new one
    is finished, so the disk must hold both. Files that do not belong to the old result are kept."""


class Listed(Output):
    """A step that also works on a list of sources."""

    list: Annotated[Path | None, Flag("FILE")] = None
    """Process many sources: a file with one source per line (SOURCE [name=NAME] ...), or a folder of sources. Each
    result goes to OUT/NAME. The exit code is 0, or 10 + the number of failures."""
    shard: Annotated[str, Flag("i/n")] = ""
    """With --list: process the i-th of n parts of the list; i counts from 0 to n-1. A scene's part depends on its name
    alone. Use it to split a list over machines."""
    jobs: int = 0
    """With --list: number of scenes processed at the same time (0 = one per processor)."""

    of_a_line: ClassVar[tuple[str, ...]] = ()
    """Settings that a line of the list may give."""

    def act(self) -> Any:
        source = getattr(self, positions(type(self))[0])
        if self.list is None and (self.shard or self.jobs):
            raise UsageError("--shard and --jobs need --list", remedy="leave them out, or give --list FILE")
        if self.list is None and not source:
            raise UsageError(f"no {self.verb()} input was given", expected=f"{self.examples[0]}, or --list FILE")
        if self.list is not None and source:
            raise UsageError("give a source or a list, not both", got=f"{source} and --list {self.list}")
        if self.list is None:
            return super().act()
        from mudg.fleet.listed import run_listed
        from mudg.fleet.plan import read_list
        from mudg.steps.command import words_of

        one = type(self).build({positions(type(self))[0]: "{source}", "out": self.out, "overwrite": self.overwrite})
        entries = read_list(self.list, self.of_a_line)
        settings = self.settings_in_list()
        return run_listed(
            words_of(one), settings, entries, self.out, jobs=self.jobs, shard_text=self.shard, listed=self.list
        )

    def settings_in_list(self) -> Any:
        """Settings of the steps over a list, several of which run at a time."""
        return vars(self)["settings"]
