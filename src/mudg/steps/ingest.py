"""``mudg ingest``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.base.errors import UsageError
from mudg.steps.outputs import Listed
from mudg.steps.step import Flag

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
    out: Annotated[Path, Flag()] = Path()
    """Folder to write, if it is not given after LOG. A finished result of the same settings and inputs is reused."""
    settings: IngestConfig

    @classmethod
    def from_words(cls, words: Sequence[str]) -> dict[str, Any]:
        """``[FORMAT] LOG [OUT]``: what the words are is known only with the flags; see `build`."""
        return {"log": "\0".join(words)} if words else {}

    @classmethod
    def build(cls, values: Any, settings: Any = None, file: Path | None = None) -> Ingest:
        """The step; of words of a command line ``[FORMAT] LOG [OUT]`` beside ``--out``, with a list ``[FORMAT] [OUT]``."""
        words, many = str(values.get("log", "")).split("\0"), values.get("list") is not None
        left, out, chosen = [word for word in words if word], values.get("out"), ""
        logs = 0 if many else 1
        if left and left[0] in ("auto", *FORMATS) and (len(left) > logs + (out is None) or not Path(left[0]).exists()):
            chosen = left.pop(0)
        usage = "mudg ingest [FORMAT] LOG OUT, or mudg ingest [FORMAT] --list FILE --out ROOT"
        source = "" if many or not left else left.pop(0)
        if not many and not source:
            raise UsageError("no log was given", expected=usage)
        if left and out is None:
            out = left.pop(0)
        if left:
            if not many and not Path(source).exists() and source != "city":
                raise UsageError("no such format and no such log", expected=", ".join(("auto", *FORMATS)), got=source)
            raise UsageError("too many arguments", expected=usage, got=" ".join([source, *left]))
        if out is None:
            raise UsageError("no folder to write was given", expected=usage)
        step = super().build({**values, "log": source, "out": out}, settings, file)
        if chosen and step.settings.format not in ("auto", chosen):
            raise UsageError("two formats were given", got=f"{chosen} and --format {step.settings.format}")
        return replace(step, settings=replace(step.settings, format=chosen)) if chosen else step

    @classmethod
    def applies(cls, part: str, name: str, text: str) -> bool:
        return name not in OF_A_LOG if part == "city" else not name.startswith("city.") and name != "format"

    def run(self) -> Any:
        from mudg.stages import ingest

        self.refuse_wrong_list(self.log)
        if self.list is not None:
            return self.run_list(ingest.run_many)
        return ingest.run(self.settings, self.log, Path(self.out), overwrite=self.overwrite)
