"""``mudg edit``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from mudg.base.layout import MODEL_FILES, SCENE_FILES, below
from mudg.steps.engine import Make
from mudg.steps.outputs import Output
from mudg.steps.step import RUN, Flag

if TYPE_CHECKING:
    from mudg.editing.runs import RunParts
    from mudg.editing.settings import EditConfig

_MODELS = (*MODEL_FILES, *below("fit/*", MODEL_FILES))
_CLOUDS = ("static.safetensors", "objects/*.safetensors", "fuse.json")


class Edit(Output):
    """Change a drive as an edit script says: remove, move, insert, change lanes, weather and light."""

    section = "change a drive"
    examples = (
        "mudg edit runs/kitti edits.yaml --out runs/edited",
        "mudg edit runs/mudg_s edits.yaml --scene scenes/city --fused runs/fused --out runs/edited",
    )
    result = "edited"
    version = 3
    files = (
        "edits.yaml",
        "edit.json",
        "lidar.json",
        *_MODELS,
        *below("scene", (*SCENE_FILES, "manifest.json")),
        *below("fuse", _CLOUDS),
    )
    short = ("device", "harmonize.on", "harmonize.model", "harmonize.steps")
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

        parts = self.run_parts()
        fits = {f"fit {name}".strip(): path for name, path in parts.fits.items()}
        return {"edits": read_edits(self.script).digest()} | self.digests(
            {**fits, "scene": parts.scene, "fused": parts.fused}
        )

    def places(self) -> dict[str, Path | None]:
        parts = self.run_parts()
        return {} if parts.whole else {"scene": parts.scene, "fused": parts.fused}

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.core.raster.place import drawing_device
        from mudg.editing.edit import PlannedEdit
        from mudg.editing.script import read_edits

        drawing_device(self.settings.device, "render", self.settings.raster)
        planned = PlannedEdit.of(self.settings, read_edits(self.script), self.run_parts())
        if planned.parts.whole and planned.drive.plan.weather_of_beams is not None:
            inputs["weather of beams"] = "fog, rain"  # another result than before sweeps showed them
        return partial(planned.write, self.settings)
