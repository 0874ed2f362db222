"""``mudg export``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from mudg.steps.engine import Make, Result, script_of
from mudg.steps.step import FILE_YAML, RUN, Flag

if TYPE_CHECKING:
    from mudg.base.run_folder import VerbOutput
    from mudg.editing.runs import RunParts
    from mudg.exporting.settings import ExportConfig


class Export(Result):
    """Write a fitted scene for other programs: PLY, SPZ, glTF, USD, SOG; cameras for nerfstudio and COLMAP."""

    section = "other programs"
    examples = (
        *("mudg export ply runs/kitti --out kitti.ply --time-s 1.5", "mudg export usdz runs/kitti --out kitti.usdz"),
        *("mudg export glb runs/mudg_s --scene scenes/city --edits edits.yaml --out city.glb",),
        *("mudg export alpasim runs/kitti --out kitti_sim.usdz", "mudg export colmap scenes/city --out city_colmap"),
        *("mudg export ros2 scenes/city --out city_bag", "mudg export ncore scenes/city --out city_ncore"),
    )
    result = "exported"
    format: Annotated[str, Flag("FORMAT", "first")]
    """Gaussians: ply, bundle, alpasim, spz, glb, usda, usdz, compressed-ply, sog, splat. Cameras: nerfstudio, colmap,
    colmap-text. The log over time: mcap, ros2, rerun, ncore."""
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

    def output(self) -> VerbOutput:
        from mudg.base.run_folder import VerbOutput
        from mudg.exporting.export import FOLDERS

        return VerbOutput("export", *FOLDERS[self.format])

    @property
    def is_file(self) -> bool:
        from mudg.exporting.export import FOLDERS

        return self.format not in FOLDERS

    def run_parts(self) -> RunParts:
        """The fits, scene and clouds that are exported."""
        from mudg.exporting.export import parts_of

        return parts_of(self.format, self.source, self.scene)

    def checked(self) -> Self:
        from mudg.exporting import export

        export.check(self.settings, self.format, self.out)
        return self

    def reads(self) -> dict[str, Path | str | None]:
        return super().reads() | {"scene": self.run_parts().scene}

    def inputs(self) -> dict[str, str]:
        parts = self.run_parts()
        fit = {f"fit {name}".strip(): path for name, path in parts.fits.items() if path == parts.model}
        return self.digests({**fit, "scene": parts.scene, "fused": parts.fused, "edits": self.edits})

    def key_settings(self) -> dict[str, Any]:
        return super().key_settings() | {"format": self.format}

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.exporting import export

        exported = export.Exported.of(self.run_parts(), script_of(self.edits))
        if self.is_file:
            return partial(export.write_file, self.settings, self.format, exported)
        return partial(export.write_folder, self.format, exported, export.recorded_scene(exported))
