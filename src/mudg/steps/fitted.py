"""A fitted scene in memory: look at its objects, edit them, render any camera at any pose and time to numpy arrays."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mudg.base.errors import InputError, UsageError
from mudg.base.geometry import rigid_problem
from mudg.base.types import Camera, Gaussians, Scene, Trajectory, View

if TYPE_CHECKING:
    from mudg.gaussians.model import SceneModel


@dataclass(frozen=True, eq=False)
class Picture:
    """One rendered view as numpy arrays.

    Args:
        rgb: u8[H, W, 3].
        depth_m: f32[H, W], camera z in metres, NaN in the sky and where the scene is empty.
        classes: u8[H, W] Cityscapes train ids (255 = none), or None if the scene was fitted without classes.
        coverage: f32[H, W] in 0..1, how much of the pixel Gaussians cover.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    classes: NDArray[np.uint8] | None
    coverage: NDArray[np.float32]


def read_scene(folder: str | Path) -> Scene:
    """Read a scene written by ingest or annotate, the one of a run, or the one that a fit belongs to. InputError:
    nothing is there, or something else. IntegrityError: a file was altered."""
    from mudg.editing.runs import scene_at
    from mudg.scene.read import read_scene

    return read_scene(scene_at(Path(folder)))


def camera_path(
    scene: Scene, camera: str | Camera = "", *, shift_m: float = 0.0, name: str = "", file: str | Path | None = None
) -> Trajectory:
    """A path of views through a log: the recorded one, one beside it, or that of a file.

    Args:
        camera: of the log (empty: its first), or a camera of your own, which then takes the place of its first one.
        shift_m: to the left of the direction of travel, metres. name: of a named path, as ``up+1.0`` or ``lane+0.1``.
        file: TUM or KITTI poses (.txt) or nerfstudio's transforms.json, as of ``mudg render --path``.

    Raises:
        UsageError: no such camera or path. InputError: the file holds no path.
    """
    from mudg.core import trajectory
    from mudg.formats.paths import read_path

    recorded = camera if isinstance(camera, str) and camera else next(iter(scene.cameras))
    if file is not None:
        optics = camera if isinstance(camera, Camera) else scene.frames_of(recorded)[0].view.camera
        return read_path(Path(file), scene, optics)
    path = trajectory.named(scene, recorded, name) if name else trajectory.at_shift(scene, recorded, shift_m)
    if not isinstance(camera, Camera):
        return path
    return replace(path, views=tuple(replace(view, camera=camera) for view in path.views))


class FittedScene:
    """A scene made by ``mudg fit``. Edits return a changed copy."""

    def __init__(self, model: SceneModel) -> None:
        self._model = model

    @classmethod
    def read(cls, folder: str | Path, device: str = "auto") -> FittedScene:
        """Read the folder of a finished fit, or the best fit of a run. device: where it is rendered: ``auto`` (CUDA if
        there is one), ``cpu``, ``cuda``, ``cuda:N``; none such: ResourceError. InputError: not such a folder, or of
        another version. IntegrityError: a file was altered."""
        from mudg.core.raster.rasterize import drawing_device
        from mudg.editing.runs import fit_at
        from mudg.gaussians.fit import load_model

        return cls(load_model(fit_at(Path(folder))).to(drawing_device(device, "render")))

    @property
    def method(self) -> str:
        """The method it was fitted with, e.g. ``mudg_s``."""
        return str(self._model.facts.get("method", ""))

    @property
    def object_ids(self) -> tuple[str, ...]:
        """Track ids of the dynamic objects that have Gaussians of their own."""
        return self._model.node_names()

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self._model.table)

    def __repr__(self) -> str:
        return f"FittedScene({self.method!r}, {len(self)} Gaussians, {len(self.object_ids)} objects)"

    def object_pose(self, track_id: str, time_s: float) -> NDArray[np.float64] | None:
        """World pose f64[4, 4] of an object's box at a time; None where it is not there. UsageError: no such object."""
        return self._model.dynamic_object(track_id).pose_matrix(time_s)

    def without(self, *track_ids: str) -> FittedScene:
        """The scene without these objects. UsageError: one that it does not have (it may be parked, and so
        background)."""
        return FittedScene(self._model.without_nodes(track_ids))

    def moved(self, track_id: str, object_from_new: ArrayLike) -> FittedScene:
        """The scene with one object displaced in its own frame (x forward, y left, z up, metres) at all times: its new
        pose is ``object_pose @ object_from_new`` (rigid 4x4). UsageError: no such object. InputError: the displacement
        is not rigid."""
        matrix = np.asarray(object_from_new, np.float64)
        problem = rigid_problem(matrix)
        if problem:
            raise InputError(f"the displacement is not rigid: {problem}", where="object_from_new")
        return FittedScene(self._model.with_object_moved(track_id, matrix))

    def edited(self, script: str | Path, scene: Scene | None = None) -> FittedScene:
        """The scene with an edit script (``docs/edit.md``, a YAML file) carried out. scene: the log that it was fitted
        to; with it, parked objects and the vehicle can be edited. InputError: the script is not valid, or cannot be
        done here."""
        from mudg.editing.apply import carry_out
        from mudg.editing.script import read_edits

        drive = carry_out(read_edits(script), self._model, scene)
        return FittedScene(drive.model(self._model, keep_ego=True))

    def export_asset(self, track_id: str, out: str | Path, scene: Scene | None = None) -> Path:
        """Write one object to a file (``.safetensors``, replaced if it exists) that edit scripts can insert. scene: the
        log, for the sides from which it was seen."""
        from mudg.base.run_folder import ResultFile
        from mudg.editing.apply import complete_asset, write_asset
        from mudg.editing.model import asset_of

        model, views = self._model, () if scene is None else tuple(frame.view for frame in scene.frames)
        asset = complete_asset(model, track_id, views) if views else asset_of(model, track_id)
        with ResultFile.open(Path(out), "asset export", {"id": track_id}, {}, overwrite=True) as file:
            write_asset(file.staged(), asset)
            return file.finish({"id": track_id})

    def gaussians(self, time_s: float) -> Gaussians:
        """All Gaussians in the world at a time, activated, on the CPU (see ``mudg.Gaussians``). Objects that are not
        there then have opacity 0; the sky is not among them."""
        import torch

        from mudg.gaussians.model import compose

        with torch.no_grad():
            return compose(self._model.to(torch.device("cpu")), time_s)

    def save(self, folder: str | Path) -> Path:
        """Write the scene, with its edits, as a folder that every command takes for a fit. UsageError: something is
        there."""
        from mudg.base import store
        from mudg.gaussians.storage import save_model

        folder = Path(folder)
        if folder.exists():
            raise UsageError("something is there already", where=str(folder), expected="a new folder")
        part = store.staging_path(folder)
        shutil.rmtree(part, ignore_errors=True)
        save_model(self._model, part)
        store.write_manifest(part)
        part.rename(folder)
        return folder

    def export(self, format: str, out: str | Path, **settings: Any) -> Path:
        """Write the scene, with its edits, for another program, as ``mudg.export`` does. format: ``ply``, ``spz``,
        ``glb``, ``usdz``, ``sog`` and so on. settings: such as ``time_s=1.5``. UsageError: no such format, or not its
        setting."""
        from mudg.steps import functions

        with tempfile.TemporaryDirectory() as scratch:
            return functions.export(format, self.save(Path(scratch) / "fit"), out=Path(out), **settings)

    def render_path(self, path: Trajectory | Iterable[View]) -> Iterator[Picture]:
        """Pictures along a path (``mudg.camera_path``), drawn as they are asked for. Errors as in ``render``."""
        for view in path.views if isinstance(path, Trajectory) else path:
            yield self.render(view.camera, view.world_from_cam, view.time_s)

    def film(self, path: Trajectory | Iterable[View], out: str | Path, fps: float = 10.0) -> Path:
        """Write an MP4 video of the colours along a path. A file that is there is replaced when the new one is whole.
        InputError: no views. ResourceError: no usable encoder, or the disk is full."""
        from mudg.formats.exporters.video import write_mp4

        return write_mp4(Path(out), (picture.rgb for picture in self.render_path(path)), fps)

    def render(self, camera: Camera, world_from_cam: ArrayLike, time_s: float, *, backend: str = "auto") -> Picture:
        """Render a camera at a pose and time.

        Args:
            camera: size and intrinsics in pixels.
            world_from_cam: rigid 4x4 pose; camera axes x right, y down, z forward.
            time_s: seconds on the scene's clock. Objects stand where they were then; outside their tracks they are
                absent.
            backend: ``auto``, ``cpu``, ``torch`` or ``gsplat``.

        Raises:
            UsageError: not a camera. InputError: the pose is not rigid. ResourceError: the backend is not available.
        """
        import torch

        from mudg.core.pictures import to_bytes
        from mudg.gaussians.rendering import raster_of, render_view

        if not isinstance(camera, Camera):
            expected = 'e.g. scene.frames_of("front")[0].view.camera'
            raise UsageError("the camera is not a mudg.Camera", expected=expected, got=repr(camera))
        view = View(camera, np.asarray(world_from_cam, np.float64), float(time_s))
        with torch.no_grad():
            seen = render_view(self._model, view, raster_of(self._model, backend))  # type: ignore[arg-type]
        rgb = to_bytes(seen.rgb)
        classes = None if seen.semantics is None else seen.semantics.numpy().astype(np.uint8)
        depth = np.full(rgb.shape[:2], np.nan, np.float32) if seen.depth is None else seen.depth[0].numpy()
        return Picture(rgb, depth, classes, seen.confidence[0].numpy())
