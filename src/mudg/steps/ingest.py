"""``mudg ingest``."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from mudg.base.errors import InputError, UsageError, similar_path
from mudg.base.layout import SCENE_FILES
from mudg.base.plugins import plugins
from mudg.steps.engine import Make
from mudg.steps.outputs import Listed
from mudg.steps.step import Flag, usage

if TYPE_CHECKING:
    from mudg.formats.settings import IngestConfig

FORMATS = ("kitti360", "waymo", "nuscenes", "argoverse2", "pandaset", "nuplan", "dgp", "ncore", "custom", "kitti")


def _is_format(word: str) -> bool:
    return word in ("auto", *FORMATS) or word in plugins("importer")


OF_A_LOG = ("format", "frames", "cameras", "sequence", "poses", "boxes", "resolution", "skip_missing", "untwist")
"""Settings that a generated city does not have."""


class Ingest(Listed):
    """Convert a driving log, or the built-in city, to a scene directory."""

    section = "single steps, in the order of use"
    examples = (
        "mudg ingest city scenes/city",
        "mudg ingest ~/kitti/2011_09_26_drive_0001_sync scenes/kitti --resolution 960",
        "mudg ingest custom my_log scenes/mine --cameras front --frames 0:40",
        "mudg ingest kitti --list drives.txt --out scenes --shard 0/4 --jobs 2",
    )
    smaller = "smaller images (--resolution; of a city --city.width), fewer --frames, one image at a time (--workers 1)"
    result = "scene"
    version, files = 1, (*SCENE_FILES, "contact_sheet.jpg")
    idle = ("workers",)
    short = (
        "resolution",
        "frames",
        "cameras",
        "sequence",
        "test_every",
        "city.seed",
        "city.n_frames",
        "city.width",
        "city.height",
    )
    parts = {"city": "Generate a city: a scene with exact truth."} | {
        name: f"Convert a log in the format {name} to a scene directory." for name in FORMATS
    }
    log: Annotated[str, Flag("[FORMAT] LOG [OUT]", "first")] = ""
    """LOG: folder of a dataset log, a scene directory, or the word city. FORMAT: its format, only needed if it is not
    recognised. OUT: the folder to write, in place of --out."""
    settings: IngestConfig
    of_a_line = ("format", "frames", "cameras", "sequence", "poses", "boxes", "seed")

    @classmethod
    def from_words(cls, words: Sequence[str], given: Mapping[str, Any]) -> dict[str, Any]:
        """``[FORMAT] LOG [OUT]``, with ``--list`` ``[FORMAT] [OUT]``; the format is a setting."""
        left, values, many, named = list(words), dict[str, Any](), "list" in given, "out" in given
        many_words = len(left) > (not many) + (not named)
        if left and _is_format(left[0]) and (many_words or not Path(left[0]).exists()):
            values["format"] = left.pop(0)
        if not many and not left:
            raise UsageError("no log was given", expected=usage(cls))
        if not many:
            values["log"] = left.pop(0)
        if left and not named:
            values["out"] = left.pop(0)
        if left and not many and values["log"] != "city" and not Path(values["log"]).exists():
            expected = ", ".join(("auto", *FORMATS, *plugins("importer")))
            raise UsageError("no such format and no such log", expected=expected, got=values["log"])
        if left:
            raise UsageError("too many words", expected=usage(cls), got=" ".join(words))
        return values

    @classmethod
    def applies(cls, part: str, name: str, text: str) -> bool:
        return name not in OF_A_LOG if part == "city" else not name.startswith("city.") and name != "format"

    @functools.cached_property
    def kind(self) -> str:
        """What the log is: a format, ``city`` or ``scene``."""
        from mudg.formats import ingest

        return ingest.kind_of(self.settings, Path(self.log))

    def checked(self) -> Self:
        from mudg.formats import ingest

        return replace(self, overwrite=self.overwrite or ingest.is_abandoned(self.out))

    def reads(self) -> dict[str, Path | str | None]:
        if self.log != "city" and not Path(self.log).exists():
            raise InputError(
                "driving log does not exist",
                where=str(self.log),
                expected="a folder, a scene zip, or the word city",
                remedy=similar_path(self.log),
            )
        from mudg.formats import ingest

        log = "" if self.log == "city" else self.log
        read = ingest.files_read(self.settings, Path(self.log), self.kind)
        return {"log": log, "poses": self.settings.poses, "boxes": self.settings.boxes, **read}

    def inputs(self) -> dict[str, str]:
        from mudg.formats import ingest

        return {} if self.kind == "city" else {"source": ingest.source_digest(Path(self.log), self.kind, self.settings)}

    def key_settings(self) -> dict[str, Any]:
        return {name: value for name, value in super().key_settings().items() if name != "city" or self.kind == "city"}

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.formats import ingest

        return functools.partial(ingest.write_scene, self.settings, Path(self.log), self.kind)
