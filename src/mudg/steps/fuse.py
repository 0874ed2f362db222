"""``mudg fuse``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from mudg.steps.engine import Make
from mudg.steps.outputs import Listed
from mudg.steps.step import Flag

if TYPE_CHECKING:
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

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.scene import fuse
        from mudg.scene.read import read_scene

        scene = read_scene(cast("Path", self.scene))
        fuse.refuse_without_lidar(scene)
        return partial(fuse.write_fusion, self.settings, scene)
