"""``mudg fuse``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from mudg.steps.outputs import Listed
from mudg.steps.step import Flag

if TYPE_CHECKING:
    from mudg.base.run_folder import RunDir
    from mudg.base.types import Scene
    from mudg.scene.settings import FuseConfig


class Fuse(Listed):
    """Fuse LiDAR and images: a static coloured point cloud, one more per dynamic object."""

    section = "single steps, in the order of use"
    examples = ("mudg fuse scenes/city --out runs/fused", "mudg fuse --list labelled --out fused --jobs 2")
    smaller = "larger voxels (--voxel-m), or a shorter log (mudg ingest --frames)"
    result = "fused"
    version, files = 2, ("static.safetensors", "objects/*.safetensors", "fuse.json", "top.png")
    scene: Annotated[Path | None, Flag("[SCENE]", "first", "scene")] = None
    """Scene directory written by ingest or annotate, or folder of mudg run."""
    settings: FuseConfig

    def prepare(self, inputs: dict[str, str]) -> Scene:
        from mudg.scene import fuse
        from mudg.scene.read import read_scene

        scene = read_scene(cast("Path", self.scene))
        fuse.refuse_without_lidar(scene)
        return scene

    def make(self, work: RunDir, prepared: Scene) -> dict[str, Any]:
        from mudg.scene import fuse

        return fuse.write_fusion(prepared, self.settings, work.path)
