"""Verbs that change a drive: ``mudg edit``, ``asset export``, ``asset import``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from mudg.base.errors import UsageError
from mudg.base.layout import MODEL_FILES, SCENE_FILES, below
from mudg.steps.engine import Make, Output, Result
from mudg.steps.step import RUN, Flag

if TYPE_CHECKING:
    from mudg.base.run_folder import VerbOutput
    from mudg.editing.runs import RunParts
    from mudg.editing.settings import EditConfig
    from mudg.exporting.settings import ImportConfig


class Edit(Output):
    """Change a drive as an edit script says: remove, move, insert, change lanes, weather and light."""

    examples = (
        "mudg edit runs/kitti edits.yaml --out runs/edited",
        "mudg edit runs/mudg_s edits.yaml --scene scenes/city --fused runs/fused --out runs/edited",
    )
    result = "edited"
    version = 4
    files = (
        *("edits.yaml", "edit.json", *MODEL_FILES, *below("fit/*", MODEL_FILES)),
        *below("scene", (*SCENE_FILES, "manifest.json")),
        *below("fuse", ("static.safetensors", "objects/*.safetensors", "fuse.json")),
    )
    short = ("device",)
    source: Annotated[Path, RUN]
    """Gaussian scene written by fit, or folder of a finished mudg run."""
    script: Annotated[Path, Flag("EDITS.yaml", "first")]
    """Edit script (docs/edit.md)."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to. With it, the vehicle's path and parked objects can be
    edited. A run has its own."""
    fused: Annotated[Path | None, Flag("FOLDER", "", "fused")] = None
    """Point clouds written by fuse, for the height of the ground (not given: the Gaussians give it). A run has its
    own."""
    settings: EditConfig

    def run_parts(self) -> RunParts:
        """The fits, scene and clouds that are edited."""
        from mudg.editing.runs import find_run

        return find_run(self.source, self.scene, self.fused)

    def reads(self) -> dict[str, Path | str | None]:
        parts = self.run_parts()
        return super().reads() | {"scene": parts.scene, "fused": parts.fused}

    def inputs(self) -> dict[str, str]:
        from mudg.editing.script import read_edits

        parts, script = self.run_parts(), read_edits(self.script)
        fits = {f"fit {name}".strip(): path for name, path in parts.fits.items()}
        return {"edits": script.digest()} | self.digests({**fits, "scene": parts.scene, "fused": parts.fused})

    def places(self) -> dict[str, Path | None]:
        parts = self.run_parts()
        return {} if parts.whole else {"scene": parts.scene, "fused": parts.fused}

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.core.raster.rasterize import drawing_device
        from mudg.editing.edit import prepared
        from mudg.editing.script import read_edits

        drawing_device(self.settings.device, "render", self.settings.raster)
        return prepared(self.settings, read_edits(self.script), self.run_parts())


class AssetExport(Result):
    """Write one object of a fitted scene to a file that edit scripts can insert."""

    verb_name = "asset export"
    examples = ("mudg asset export runs/kitti car-003 --out assets/van.safetensors",)
    result = "asset"
    source: Annotated[Path, RUN]
    """Gaussian scene written by fit, or folder of a finished mudg run."""
    track_id: Annotated[str, Flag("ID", "first")]
    """Track id of a dynamic object."""
    out: Annotated[Path, Flag("FILE.safetensors")]
    """File to write."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to; it tells from which sides the object was seen. A run has its
    own."""
    overwrite: bool = False
    """Replace the output if it exists."""

    @property
    def is_file(self) -> bool:
        return True

    def checked(self) -> Self:
        refuse_other_name(self.out)
        return self

    def inputs(self) -> dict[str, str]:
        from mudg.editing.runs import find_run

        parts = find_run(self.source, self.scene)
        return self.digests({"fit": parts.model, "scene": parts.scene})

    def key_settings(self) -> dict[str, Any]:
        return {"id": self.track_id}

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.editing import apply, runs

        return partial(apply.write_asset_from, runs.find_run(self.source, self.scene), self.track_id)


def refuse_other_name(out: Path) -> None:
    """UsageError for a file with another suffix than assets have."""
    if out.suffix != ".safetensors":
        what, expected = "an asset is a safetensors file", "a name that ends in .safetensors"
        raise UsageError(what, where="--out", expected=expected, got=str(out))


class AssetImport(Result):
    """Make an object, or a scene, of a file of Gaussians from another program."""

    verb_name = "asset import"
    examples = ("mudg asset import van.ply --label van --length-m 5.2 --out assets/van.safetensors",)
    result = "asset"
    file: Annotated[Path, Flag("FILE", "first")]
    """File of Gaussians (.ply, .spz, .splat, .sog, .glb)."""
    out: Annotated[Path, Flag("FILE.safetensors")]
    """File to write; with --kind scene, folder to write."""
    overwrite: bool = False
    """Replace the output if it exists."""
    settings: ImportConfig

    @property
    def is_file(self) -> bool:
        return self.settings.kind != "scene"

    def output(self) -> VerbOutput:
        from mudg.base.run_folder import VerbOutput

        return VerbOutput("asset", 1, MODEL_FILES)

    def checked(self) -> Self:
        from mudg.exporting import export as imports

        imports.refuse_other_settings(self.settings)
        if self.is_file:
            refuse_other_name(self.out)
            imports.bounded(self.file)
        return self

    def key_settings(self) -> dict[str, Any]:
        return super().key_settings() | ({"name": self.file.name} if self.is_file else {})

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.exporting import export as imports

        if self.is_file:
            return partial(imports.write_object, self.settings, self.file)
        return partial(imports.write_scene, self.settings, self.file, *imports.read_file(self.file, self.settings))
