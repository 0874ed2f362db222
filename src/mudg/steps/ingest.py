"""``mudg ingest``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.base.errors import UsageError
from mudg.steps.outputs import Listed
from mudg.steps.step import Flag, usage

if TYPE_CHECKING:
    from mudg.stages.config import IngestConfig

FORMATS = ("kitti360", "waymo", "nuscenes", "argoverse2", "pandaset", "nuplan", "dgp", "ncore", "custom", "kitti")
OF_A_LOG = ("format", "frames", "cameras", "sequence", "poses", "boxes", "resolution", "skip_missing", "untwist")
"""Settings that a generated city does not have."""


class Ingest(Listed):
    """Convert a driving log, or the built-in city, to a scene directory."""

    section = "single steps, in the order of use"
    examples = (
        "mudg ingest city scenes/city", "mudg ingest ~/kitti/2011_09_26_drive_0001_sync scenes/kitti --resolution 960",
        "mudg ingest custom my_log scenes/mine --cameras front --frames 0:40",
        "mudg ingest kitti --list drives.txt --out scenes --shard 0/4 --jobs 2",
    )  # fmt: skip
    smaller = "smaller images (--resolution; of a city --city.width), fewer --frames, one image at a time (--workers 1)"
    result = "scene"
    short = ("resolution", "frames", "cameras", "sequence", "test_every", "city.seed", "city.n_frames", "city.width", "city.height")
    parts = {"city": "Generate a city: a scene with exact truth."} | {
        name: f"Convert a log in the format {name} to a scene directory." for name in FORMATS
    }
    log: Annotated[str, Flag("[FORMAT] LOG [OUT]", "first")] = ""
    """LOG: folder of a dataset log, a scene directory, or the word city. FORMAT: its format, only needed if it is not recognised. OUT: the
    folder to write, in place of --out."""
    settings: IngestConfig

    @classmethod
    def from_words(cls, words: Sequence[str], given: Mapping[str, Any]) -> dict[str, Any]:
        """``[FORMAT] LOG [OUT]``, with ``--list`` ``[FORMAT] [OUT]``; the format is a setting."""
        left, values, many, named = list(words), dict[str, Any](), "list" in given, "out" in given
        if left and left[0] in ("auto", *FORMATS) and (len(left) > (not many) + (not named) or not Path(left[0]).exists()):
            values["format"] = left.pop(0)
        if not many and not left:
            raise UsageError("no log was given", expected=usage(cls))
        if not many:
            values["log"] = left.pop(0)
        if left and not named:
            values["out"] = left.pop(0)
        if left and not many and values["log"] != "city" and not Path(values["log"]).exists():
            raise UsageError("no such format and no such log", expected=", ".join(("auto", *FORMATS)), got=values["log"])
        if left:
            raise UsageError("too many words", expected=usage(cls), got=" ".join(words))
        return values

    @classmethod
    def applies(cls, part: str, name: str, text: str) -> bool:
        return name not in OF_A_LOG if part == "city" else not name.startswith("city.") and name != "format"

    def run(self) -> Any:
        from mudg.stages import ingest

        self.refuse_wrong_list(self.log)
        if self.list is not None:
            return self.run_list(ingest.run_many)
        return ingest.run(self.settings, self.log, self.out, overwrite=self.overwrite)
