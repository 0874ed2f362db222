"""``mudg asset export`` and ``mudg asset import``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.step import RUN, Flag, Step

if TYPE_CHECKING:
    from mudg.stages.config import ImportConfig


class AssetExport(Step):
    """Write one object of a fitted scene to a file that edit scripts can insert."""

    section = "change a drive"
    examples = ("mudg asset export runs/kitti car-003 --out assets/van.safetensors",)
    result = "asset"
    source: Annotated[Path, RUN]
    """Gaussian scene written by fit, or folder of a finished mudg run."""
    track_id: Annotated[str, Flag("ID", "first")]
    """Track id of a dynamic object."""
    out: Annotated[Path, Flag("FILE.safetensors")]
    """File to write."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to; it tells from which sides the object was seen. A run has its own."""
    overwrite: bool = False
    """Replace the output if it exists."""

    @classmethod
    def verb(cls) -> str:
        return "asset export"

    def run(self) -> Any:
        from mudg.stages.editing import assets

        return assets.run_export(self.source, self.track_id, self.out, self.scene, self.overwrite)


class AssetImport(Step):
    """Make an object, or a scene, of a file of Gaussians from another program."""

    section = "change a drive"
    examples = ("mudg asset import van.ply --label van --length-m 5.2 --out assets/van.safetensors",)
    result = "asset"
    file: Annotated[Path, Flag("FILE", "first")]
    """File of Gaussians (.ply, .spz, .splat, .sog, .glb)."""
    out: Annotated[Path, Flag("FILE.safetensors")]
    """File to write; with --kind scene, folder to write."""
    overwrite: bool = False
    """Replace the output if it exists."""
    settings: ImportConfig

    @classmethod
    def verb(cls) -> str:
        return "asset import"

    def run(self) -> Any:
        from mudg.stages.exporting import imports

        return imports.run(self.settings, self.file, self.out, overwrite=self.overwrite)
