"""``mudg export``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mudg.steps.step import FILE_YAML, RUN, Flag, Step

if TYPE_CHECKING:
    from mudg.stages.config import ExportConfig


class Export(Step):
    """Write a fitted scene for other programs: PLY, SPZ, glTF, USD, SOG; cameras for nerfstudio and COLMAP."""

    section = "other programs"
    examples = (
        "mudg export ply runs/kitti --out kitti.ply --time-s 1.5", "mudg export usdz runs/kitti --out kitti.usdz",
        "mudg export glb runs/mudg_s --scene scenes/city --edits edits.yaml --out city.glb",
        "mudg export alpasim runs/kitti --out kitti_sim.usdz", "mudg export colmap scenes/city --out city_colmap",
        "mudg export ros2 scenes/city --out city_bag", "mudg export ncore scenes/city --out city_ncore",
    )  # fmt: skip
    result = "exported"
    format: Annotated[str, Flag("FORMAT", "first")]
    """Gaussians: ply, bundle, alpasim, spz, glb, usda, usdz, compressed-ply, sog, splat. Cameras: nerfstudio, colmap, colmap-text.
    The log over time: mcap, ros2, rerun, ncore."""
    source: Annotated[Path, RUN]
    """Gaussian scene written by fit, or folder of a finished mudg run; for cameras also a scene directory."""
    out: Annotated[Path, Flag("OUT")]
    """File to write, with the suffix of the format; for cameras, ros2 and ncore, folder to write."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a Gaussian scene was fitted to. A run has its own."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) to carry out before."""
    overwrite: bool = False
    """Replace the output if it exists."""
    settings: ExportConfig

    def run(self) -> Path:
        from mudg.stages.exporting import export

        return export.run(self.settings, self.format, self.source, self.out, scene=self.scene, edits=self.edits, overwrite=self.overwrite)
