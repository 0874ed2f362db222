"""Verbs that prepare a log: ``mudg ingest``, ``annotate``, ``fuse``."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from mudg.base.errors import InputError, UsageError, similar_path
from mudg.base.layout import SCENE_FILES
from mudg.base.versions import plugins
from mudg.steps.engine import Make, Output
from mudg.steps.step import SCENE, Flag, usage

if TYPE_CHECKING:
    from mudg.formats.settings import IngestConfig
    from mudg.labels.settings import AnnotateConfig
    from mudg.scene.settings import FuseConfig

FORMATS = ("kitti360", "waymo", "nuscenes", "argoverse2", "pandaset", "nuplan", "ncore", "custom", "kitti")


OF_A_LOG = ("format", "frames", "cameras", "sequence", "poses", "boxes", "resolution", "skip_missing", "untwist")
"""Settings that a generated city does not have."""


class Ingest(Output):
    """Convert a driving log, or the built-in city, to a scene directory."""

    examples = (
        "mudg ingest city scenes/city",
        "mudg ingest ~/kitti/2011_09_26_drive_0001_sync scenes/kitti --resolution 960",
        "mudg ingest custom my_log scenes/mine --cameras front --frames 0:40",
    )
    smaller = "smaller images (--resolution; of a city --city.width), fewer --frames, one image at a time (--workers 1)"
    result = "scene"
    version, files = 1, (*SCENE_FILES, "contact_sheet.jpg")
    idle = ("workers",)
    short = (
        *("resolution", "frames", "cameras", "sequence", "test_every"),
        *("city.seed", "city.n_frames", "city.width", "city.height"),
    )
    parts = {"city": "Generate a city: a scene with exact truth."} | {
        name: f"Convert a log in the format {name} to a scene directory." for name in FORMATS
    }
    log: Annotated[str, Flag("[FORMAT] LOG [OUT]", "first")]
    """LOG: folder of a dataset log, a scene directory, or the word city. FORMAT: its format, only needed if it is not
    recognised. OUT: the folder to write, in place of --out."""
    settings: IngestConfig

    @classmethod
    def from_words(cls, words: Sequence[str], given: Mapping[str, Any]) -> dict[str, Any]:
        """``[FORMAT] LOG [OUT]``; the format is a setting."""
        left, values, named = list(words), dict[str, Any](), "out" in given
        of_a_log = 1 + (not named)
        is_format = left and (left[0] in ("auto", *FORMATS) or left[0] in plugins())
        if is_format and (len(left) > of_a_log or not Path(left[0]).exists()):
            values["format"] = left.pop(0)
        if not left:
            raise UsageError("no log was given", expected=usage(cls))
        values["log"] = left.pop(0)
        if left and not named:
            values["out"] = left.pop(0)
        if left and values["log"] != "city" and not Path(values["log"]).exists():
            formats = ", ".join(("auto", *FORMATS, *plugins()))
            raise UsageError("no such format and no such log", expected=formats, got=values["log"])
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
            where, expected = str(self.log), "a folder, or the word city"
            remedy = similar_path(self.log)
            raise InputError("driving log does not exist", where=where, expected=expected, remedy=remedy)
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


class Annotate(Output):
    """Add missing labels to a scene: semantics, sky and depth, with confidences."""

    examples = ("mudg annotate scenes/kitti --out scenes/kitti_labelled",)
    smaller = "one process (--processes 1), or smaller images (mudg ingest --resolution)"
    result = "scene"
    version, files = 4, (*SCENE_FILES, "labels.html", "pictures/*.jpg", "labelled/")
    idle = ("processes",)
    short = ("labeller", "weights", "depth_network", "device", "sweeps", "ego", "processes")
    scene: Annotated[Path, SCENE]
    """Scene directory written by ingest, or folder of mudg run."""
    settings: AnnotateConfig

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

        return partial(annotate.write_labelled, self.settings, self.scene)


class Fuse(Output):
    """Fuse LiDAR and images: a static coloured point cloud, one more per dynamic object."""

    examples = ("mudg fuse scenes/city --out runs/fused",)
    smaller = "larger voxels (--voxel-m), or a shorter log (mudg ingest --frames)"
    result = "fused"
    version, files = 2, ("static.safetensors", "objects/*.safetensors", "fuse.json", "top.png")
    scene: Annotated[Path, SCENE]
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    settings: FuseConfig

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.scene import fuse
        from mudg.scene.read import read_scene

        scene = read_scene(self.scene)
        fuse.refuse_without_lidar(scene)
        return partial(fuse.write_fusion, self.settings, scene)
