"""A driving log, and a fitted scene over it, as a recording of rerun (.rrd), written with its package.

    /world/ego  /world/ego_path  /world/camera/NAME (pinhole, pictures)  /world/lidar/NAME  /world/objects/ID
    /world/points
    /world/gaussians/NAME (centres, colours, sizes)

The time line ``time`` counts from the first record. rerun shows the latest value and draws no lines between keys, so
poses of objects are written at every moment of the log. The content is the same for the same input; the package puts
fresh ids and the hour into every file.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import ResourceError
from mudg.base.types import Frame
from mudg.core.harmonics import C0
from mudg.formats.exporters.messages import NANO, LogRecords, box_color, picture_format
from mudg.formats.splats.cloud import SplatCloud, SplatNode, SplatScene

TIMELINE: Final = "time"
POINT_M: Final = 0.02
"""Radius of LiDAR points."""
_ALWAYS: Final[Sequence[float]] = ()

Matrix = NDArray[np.float64]


def package() -> Any:
    """The module ``rerun``. Raises ResourceError: it is not installed."""
    try:
        return importlib.import_module("rerun")
    except ImportError as error:
        what = "rerun files are written with the package rerun-sdk, which is not installed"
        raise ResourceError(what, remedy="pip install 'mudg[rerun]'") from error


class RerunWriter:
    """Writes one recording.

    Args:
        name: of the recording. start_s: seconds of the log's clock that are time 0.
    """

    def __init__(self, name: str, start_s: float) -> None:
        self._rr, self._start_s = package(), start_s
        self._recording = self._rr.RecordingStream("mudg", recording_id=name, send_properties=False)

    def write(self, out: Path, log: LogRecords | None, splats: SplatScene | None) -> None:
        """Write everything to a file, completely or not at all; no more than one picture or sweep is held here."""
        with store.atomic_path(out) as temporary:
            self._recording.save(str(temporary))
            self._put("/world", self._rr.ViewCoordinates.columns(xyz=[self._rr.ViewCoordinates.RIGHT_HAND_Z_UP]))
            if log is not None:
                self._log(log)
            if splats is not None:
                self._gaussians(splats, log)
            self._recording.flush()
            self._recording.disconnect()

    def _path(self, *parts: str) -> str:
        return self._rr.new_entity_path(["world", *parts])

    def _put(self, path: str, columns: Iterable[Any], times_s: Sequence[float] | Matrix = _ALWAYS) -> None:
        """Rows of one archetype at times; no times: one row that always holds."""
        nanoseconds = [max(0, round((float(t) - self._start_s) * NANO)) for t in times_s]
        index = (
            [self._rr.TimeColumn(TIMELINE, duration=np.array(nanoseconds, "timedelta64[ns]"))] if nanoseconds else []
        )
        self._rr.send_columns(path, indexes=index, columns=columns, recording=self._recording, strict=True)

    def _poses(self, path: str, times_s: Sequence[float], poses: Sequence[Matrix]) -> None:
        if len(times_s):
            quats = np.stack([geometry.quaternion_from_matrix(pose) for pose in poses])[:, [1, 2, 3, 0]]
            places = np.stack([pose[:3, 3] for pose in poses])
            self._put(path, self._rr.Transform3D.columns(translation=places, quaternion=quats), times_s)

    def _gone(self, path: str, times_s: Sequence[float], moments: Sequence[float]) -> None:
        """Say that what was there at some moments is not there at the next."""
        after = [moment for moment in moments if moment > times_s[-1]]
        if after:
            self._put(path, self._rr.Clear.columns(is_recursive=[False]), after[:1])

    # -- the log

    def _log(self, log: LogRecords) -> None:
        scene, ego = log.scene, log.scene.ego
        self._poses(self._path("ego"), ego.times_s.tolist(), list(ego.world_from_ego))
        strip = ego.world_from_ego[:, :3, 3]
        self._put(
            self._path("ego_path"), self._rr.LineStrips3D.columns(strips=[strip], colors=[0xFF8800FF]).partition([1])
        )
        for name in scene.cameras:
            self._camera(name, log)
        for sweep in scene.sweeps:
            path, points = self._path("lidar", sweep.sensor), log.points(sweep)
            self._poses(path, [sweep.time_s], [sweep.world_from_lidar])
            grey = np.round(points.intensity.clip(0, 1) * 255).astype(np.uint8)
            self._points(path, points.xyz, np.stack([grey] * 3, 1), np.full(len(grey), POINT_M), (sweep.time_s,))
        if log.fused is not None:
            self._points(self._path("points"), log.fused.xyz, log.fused.rgb, np.full(len(log.fused), POINT_M))
        self._objects(log)

    def _camera(self, name: str, log: LogRecords) -> None:
        path, camera, frames = self._path("camera", name), log.scene.cameras[name], log.scene.frames_of(name)
        by_column, size = camera.matrix.T.reshape(-1), [camera.width, camera.height]
        axes = self._rr.ViewCoordinates.RDF
        self._put(path, self._rr.Pinhole.columns(image_from_camera=[by_column], resolution=[size], camera_xyz=[axes]))
        self._poses(path, [f.view.time_s for f in frames], [f.view.world_from_cam for f in frames])
        for frame in frames:
            self._picture(path, frame, log)

    def _picture(self, path: str, frame: Frame, log: LogRecords) -> None:
        kind = f"image/{picture_format(frame)}"
        columns = self._rr.EncodedImage.columns(blob=[log.picture(frame)], media_type=[kind])
        self._put(path, columns, (frame.view.time_s,))

    def _objects(self, log: LogRecords) -> None:
        moments = log.moments()
        for track in log.scene.tracks:
            there = [(moment, pose) for moment in moments if (pose := track.pose_at(moment)) is not None]
            if not there:
                continue
            path, times = self._path("objects", track.id), [moment for moment, _ in there]
            self._poses(path, times, [pose for _, pose in there])
            color = np.round(np.array([*box_color(track.label), 1.0]) * 255).astype(np.uint8)
            boxes = self._rr.Boxes3D.columns(
                half_sizes=[track.size_m / 2], colors=[color], labels=[f"{track.id} ({track.label})"]
            )
            self._put(path, boxes, times[:1])
            self._gone(path, times, moments)

    # -- Gaussians

    def _gaussians(self, splats: SplatScene, log: LogRecords | None) -> None:
        keys = sorted({float(t) for node in splats.nodes for t in node.times_s})
        moments = keys if log is None else log.moments()
        for node in splats.nodes:
            if not node.moves:
                self._cloud(self._path("gaussians", node.name), node.cloud)
            else:
                self._moving(node, [t for t in moments if node.times_s[0] <= t <= node.times_s[-1]], moments)

    def _moving(self, node: SplatNode, times_s: Sequence[float], moments: Sequence[float]) -> None:
        path = self._path("gaussians", node.name)
        if not len(times_s):
            return
        if node.displacement is None:
            poses = [geometry.pose_at(node.times_s, node.world_from_node, t) for t in times_s]
            self._poses(path, times_s, [pose for pose in poses if pose is not None])
            self._cloud(path, node.cloud, times_s[:1])
        else:  # what deforms stands in the world
            for moment in times_s:
                cloud = node.at(moment)
                if cloud is not None:
                    self._cloud(path, cloud, (moment,))
        self._gone(path, times_s, moments)

    def _cloud(self, path: str, cloud: SplatCloud, times_s: Sequence[float] = _ALWAYS) -> None:
        """Centres; as radius the geometric mean of the three standard deviations."""
        color = np.column_stack([(cloud.sh[:, 0] * C0 + 0.5).clip(0, 1), cloud.opacity])
        self._points(
            path, cloud.means, np.round(color * 255).astype(np.uint8), np.exp(cloud.log_scales.mean(1)), times_s
        )

    def _points(
        self,
        path: str,
        xyz: NDArray[np.float32],
        colors: NDArray[np.uint8],
        radii: NDArray[np.floating],
        times_s: Sequence[float] = _ALWAYS,
    ) -> None:
        columns = self._rr.Points3D.columns(positions=xyz, colors=colors, radii=radii)
        self._put(path, columns.partition([len(xyz)]), times_s)


def write_rerun(out: Path, log: LogRecords | None, splats: SplatScene | None, name: str) -> None:
    """Write a log, Gaussians, or both as a recording. Raises ResourceError: the package rerun-sdk is not installed."""
    start_s = log.start_s if log is not None else 0.0 if splats is None else splats.span_s[0]
    RerunWriter(name, start_s).write(out, log, splats)
