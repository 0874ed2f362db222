"""``mudg fuse``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mudg.steps.outputs import Listed
from mudg.steps.step import Flag

if TYPE_CHECKING:
    from mudg.stages.config import FuseConfig


class Fuse(Listed):
    """Fuse LiDAR and images: a static coloured point cloud, one more per dynamic object."""

    section = "single steps, in the order of use"
    examples = ("mudg fuse scenes/city --out runs/fused", "mudg fuse --list labelled --out fused --jobs 2")
    smaller = "larger voxels (--voxel-m), or a shorter log (mudg ingest --frames)"
    result = "fused"
    scene: Annotated[Path | None, Flag("[SCENE]", "first", "scene")] = None
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    settings: FuseConfig

    def run(self) -> Any:
        from mudg.stages import fuse

        self.refuse_wrong_list(self.scene)
        if self.scene is None:
            return self.run_list(fuse.run_many)
        return fuse.run(self.settings, self.scene, self.out, overwrite=self.overwrite)
