"""Verbs for other programs: ``mudg export``, ``dataset``, ``convert``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from mudg.base.errors import InputError, UsageError
from mudg.steps.engine import Make, Output, Result, script_of
from mudg.steps.step import FILE_YAML, RUN, Flag, Step

if TYPE_CHECKING:
    from mudg.base.run_folder import VerbOutput
    from mudg.datasets.settings import DatasetConfig
    from mudg.datasets.write import LabelledDrive
    from mudg.diffusion.settings import ConvertConfig
    from mudg.editing.runs import RunParts
    from mudg.exporting.settings import ExportConfig


class Export(Result):
    """Write a fitted scene for other programs: PLY, SPZ, glTF, USD, SOG; cameras for nerfstudio and COLMAP."""

    examples = (
        *("mudg export ply runs/kitti --out kitti.ply --time-s 1.5", "mudg export usdz runs/kitti --out kitti.usdz"),
        *("mudg export glb runs/mudg_s --scene scenes/city --edits edits.yaml --out city.glb",),
        *("mudg export alpasim runs/kitti --out kitti_sim.usdz", "mudg export colmap scenes/city --out city_colmap"),
        *("mudg export ros2 scenes/city --out city_bag", "mudg export ncore scenes/city --out city_ncore"),
    )
    result = "exported"
    format: Annotated[str, Flag("FORMAT", "first")]
    """Gaussians: ply, alpasim, spz, glb, usda, usdz, compressed-ply, sog, splat. Cameras: nerfstudio, colmap. The
    log over time: mcap, ros2, ncore."""
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


class Dataset(Output):
    """Write labelled images of reconstructions as a data set: kitti, kitti-tracking, coco, nuscenes or py123d."""

    examples = (
        "mudg dataset kitti runs/kitti --shifts-m 0 2 -2 --out data/shifted",
        "mudg dataset coco runs/a runs/b --val runs/c --cameras front --every 2 --out data/coco",
    )
    smaller = "smaller images (--width-px)"
    result = "dataset"
    format: Annotated[str, Flag("FORMAT", "first")]
    """kitti: images, calibration and 3D boxes as in KITTI's object benchmark. kitti-tracking: the same by sequence,
    with track ids and poses. coco: instances with masks, and panoptic segmentation. nuscenes: all tables and images of
    a release, every path a scene. py123d: Arrow logs of 123D."""
    runs: Annotated[tuple[Path, ...], Flag("RUN ...", "rest")]
    """Folders of finished mudg runs, or of a fit (with --scene). They form the split train."""
    val: Annotated[tuple[Path, ...], Flag("RUN ...")] = ()
    """More of them, which form the split val."""
    scene: Annotated[Path | None, Flag("FOLDER", "", "scene")] = None
    """Scene directory that a fit belongs to. A run has its own."""
    edits: Annotated[Path | None, FILE_YAML] = None
    """Edit script (docs/edit.md) to carry out before; with one RUN."""
    path: Annotated[Path | None, Flag("FILE")] = None
    """Camera path that stands for the shifts, as of mudg render --path; with one RUN."""
    settings: DatasetConfig

    def output(self) -> VerbOutput:
        from mudg.base.run_folder import VerbOutput
        from mudg.datasets.write import FORMATS

        return VerbOutput(f"dataset {self.format}", 2, FORMATS[self.format].files)

    def checked(self) -> Self:
        from mudg.datasets.write import FORMATS

        if self.format not in FORMATS:
            raise UsageError("no such data set format", expected=", ".join(FORMATS), got=self.format)
        for flag in ("scene", "edits", "path"):
            if getattr(self, flag) is not None and len(self.runs) + len(self.val) > 1:
                raise UsageError("this belongs to one drive", where=f"--{flag}", got=f"{len(self.runs)} RUN")
        FORMATS[self.format].check()
        return self

    def prepare(self, inputs: dict[str, str]) -> Make:
        from mudg.datasets import write

        return partial(write.write_dataset, self.format, self.settings, self._drives(inputs))

    def _drives(self, inputs: dict[str, str]) -> list[LabelledDrive]:
        """Drives by split. Of folders of one name the later ones are numbered."""
        from mudg.datasets.write import LabelledDrive

        made: dict[str, LabelledDrive] = {}
        for split, runs in (("train", self.runs), ("val", self.val)):
            for number, run in enumerate(runs):
                same = sum(one.run.name == run.name for one in made.values())
                name = f"{run.name}-{same}" if same else run.name
                key = "runs" if split == "train" else "val"
                provenance = {"run": inputs[f"{key} {number}" if number else key], "edits": inputs.get("edits", "")}
                made[name] = LabelledDrive(name, run, self.scene, self.edits, split, self.path, provenance)
        return list(made.values())


class Convert(Step):
    """Convert a published checkpoint to a folder for synthesize, annotate or score."""

    examples = (
        "mudg convert 1024-mdm-checkpoint.ckpt --to models/mudg_1024",
        "mudg convert model.ckpt --to models/dc_512 --resolution 320x512 --dtype bfloat16",
        "mudg convert checkpoints --to weights/depthlab",
        "mudg convert i3d_torchscript.pt --to weights/i3d --network i3d",
    )
    smaller = "a larger --memory-gb, where the machine has it"
    result = "model"
    checkpoint: Annotated[Path, Flag("CKPT", "first")]
    """Checkpoint file of MuDG, DynamiCrafter-512 or DynamiCrafter-1024 (.ckpt, .pt or .safetensors); or, for DepthLab,
    the folder that contains DepthLab's files, Marigold's folder and the image encoder's folder; or, with --network,
    weights of a network of the scores."""
    to: Annotated[Path, Flag()]
    """Model folder to write."""
    overwrite: bool = False
    """Replace the model that --to already holds. The old model stays until the new one is finished, so the disk must
    hold both. Files that do not belong to the model are kept."""
    settings: ConvertConfig

    def act(self) -> Path:
        from mudg.diffusion import convert

        return convert.run(self.settings, self.checkpoint, self.to, self._conversion, overwrite=self.overwrite)

    def _conversion(self, to: Path) -> tuple[Callable[[], None], int]:
        """What converts this checkpoint to a folder, and the address space that it may take."""
        from mudg.diffusion import convert
        from mudg.diffusion.model_files import SHARD_BYTES
        from mudg.labels import depthlab
        from mudg.scoring.sets import convert_weights

        config, source = self.settings, self.checkpoint
        if config.network != "diffusion":
            if config.resolution != "auto" or config.dtype != "keep":
                what = "--resolution and --dtype apply to diffusion models only"
                raise UsageError(what, where=f"--network {config.network}")
            if not source.is_file():
                raise InputError("no such checkpoint", where=str(source))
            # read, and converted to float32
            limit = convert.memory_limit(config, source, source)
            return partial(convert_weights, config.network, source, to), limit
        if not source.is_dir():
            return convert.of_diffusion(config, source, to)
        if config.resolution != "auto":
            what, remedy = "--resolution does not apply to a DepthLab folder", "leave it out, or give a checkpoint file"
            raise UsageError(what, where=str(source), remedy=remedy)
        files = depthlab.source_files(source)
        work = partial(depthlab.convert_folder, source, to, convert.DTYPES[config.dtype], SHARD_BYTES)
        return work, convert.memory_limit(config, *files)
