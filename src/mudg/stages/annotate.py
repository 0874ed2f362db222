"""``mudg annotate``: a scene without labels -> the same scene with semantics and sky, each pixel with a confidence.

The result is a complete new scene; the given one is not touched. A scene whose frames all have semantics already is
copied as it is. What made the labels is written into the scene's notes, so that nobody takes them for truth.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import geometry, log, palette, store
from mudg.base.config import to_dict
from mudg.base.types import Frame, Scene, Sweep
from mudg.core.fusion import STATIC, FusionRules, SweepShots, judge_track, separate
from mudg.data.scenefile import SceneWriter, read_image, read_points, read_scene
from mudg.models.labellers import LABELLERS, LabelInput, Labels
from mudg.stages import batch
from mudg.stages.config import AnnotateConfig
from mudg.stages.ingest import add_frame_copy, add_rest

_VERSION = 1
NEIGHBOURS = 2
"""Sweeps before and after the image's own whose static points help."""
_PICTURES = 6


def run(config: AnnotateConfig, scene: Path, out: Path, *, overwrite: bool = False) -> Path:
    """Label a scene; ``out`` becomes a scene with labels, and ``pictures/`` shows some of them.

    Args:
        config: see ``AnnotateConfig``.
        scene: scene directory or stored zip.
        out: output folder; a finished result of the same configuration and scene is verified and reused.

    Raises:
        InputError: the scene is malformed. UsageError: ``out`` holds something else.
    """
    folder = store.RunDir.open(out, "annotate", to_dict(config), {"scene": store.digest(scene)}, _VERSION, overwrite)
    if folder.complete:
        return folder.reused()
    loaded = read_scene(scene)
    missing = [frame for frame in loaded.frames if "semantics" not in frame.labels]
    if not missing:
        log.info("annotate: labels present, nothing to do; the scene is passed through")
    if not (folder.path / "scene.json").is_file():
        note = f"semantics and sky of {len(missing)} frames: labeller '{config.labeller}', not truth"
        source = dataclasses.replace(loaded.source, notes=(*loaded.source.notes, *((note,) if missing else ())))
        with SceneWriter(folder.path, loaded.id, source) as writer:
            add_rest(writer, loaded)
            _label_frames(config, loaded, writer, folder.path)
            writer.finish()
    folder.finish({"labelled": len(missing), "labeller": config.labeller if missing else "labels present"})
    return folder.path


def run_many(
    config: AnnotateConfig, listed: Path, out: Path, shard: str = "", jobs: int = 0, overwrite: bool = False
) -> dict[str, Any]:
    """``run`` for every scene of a list; see ``stages/batch.py``."""
    entries = batch.shard(batch.read_list(listed), shard)
    work = functools.partial(_one_of_many, config)
    return batch.run_batch("annotate", entries, out, work, jobs=jobs, overwrite=overwrite, shard_text=shard)


def _one_of_many(config: AnnotateConfig, entry: batch.Entry, out: Path, overwrite: bool) -> Path:
    return run(config, Path(entry.source), out, overwrite=overwrite)


def _label_frames(config: AnnotateConfig, scene: Scene, writer: SceneWriter, out: Path) -> None:
    label = LABELLERS[config.labeller]
    returns = _NearbyReturns(scene)
    shown = {frame.id for frame in scene.frames[:: max(1, len(scene.frames) // _PICTURES)]}
    for frame in log.progress(scene.frames, len(scene.frames), "labelling frames"):
        if "semantics" in frame.labels:
            add_frame_copy(writer, scene, frame)
            continue
        rgb = read_image(scene, frame)
        path = scene.ego.world_from_ego[:, :3, 3]
        labels = label(LabelInput(frame.view, rgb, returns.of(frame), scene.tracks, path))
        add_frame_copy(writer, scene, frame, label_arrays(labels, config.depth))
        if frame.id in shown:
            with store.atomic_path(out / "pictures" / f"{frame.id.replace('/', '_')}.png") as temporary:
                picture(rgb, labels).save(temporary)


def label_arrays(labels: Labels, with_depth: bool) -> dict[str, NDArray[Any]]:
    """Labels as a scene stores them."""
    arrays: dict[str, NDArray[Any]] = {
        "semantics": labels.semantics, "sky": labels.sky, "semantics_confidence": labels.confidence,
    }  # fmt: skip
    if with_depth:
        arrays |= {"depth": labels.depth, "depth_confidence": labels.depth_confidence}
    return arrays


class _NearbyReturns:
    """LiDAR returns for an image: its own sweep with movers where they are then, and static points of neighbouring sweeps."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        rules = FusionRules()
        self._movers = [track for track in scene.tracks if judge_track(track, rules).moving]
        self._rules = rules
        self._times = np.array([sweep.time_s for sweep in scene.sweeps])
        self._kept: dict[str, tuple[NDArray[np.float32], NDArray[np.int32], dict[int, NDArray[np.float32]]]] = {}

    def of(self, frame: Frame) -> NDArray[np.float32]:
        """Points f32[N, 3] in the world."""
        if len(self._times) == 0:
            return np.zeros((0, 3), np.float32)
        own = int(np.abs(self._times - frame.view.time_s).argmin())
        chosen = self._scene.sweeps[max(0, own - NEIGHBOURS) : own + NEIGHBOURS + 1]
        parts = [np.zeros((0, 3), np.float32)]
        for sweep in chosen:
            world, owner, owned = self._separated(sweep, chosen)
            parts.append(world[owner == STATIC])
            if sweep is self._scene.sweeps[own]:
                parts += list(self._movers_at(frame.view.time_s, owned))
        return np.concatenate(parts)

    def _movers_at(self, time_s: float, owned: dict[int, NDArray[np.float32]]) -> Iterator[NDArray[np.float32]]:
        for index, xyz_object in owned.items():
            pose = self._movers[index].pose_at(time_s)
            if pose is not None:
                yield geometry.transform_points(pose, xyz_object).astype(np.float32)

    def _separated(
        self, sweep: Sweep, wanted: Sequence[Sweep]
    ) -> tuple[NDArray[np.float32], NDArray[np.int32], dict[int, NDArray[np.float32]]]:
        if sweep.id not in self._kept:
            ids = {other.id for other in wanted}
            self._kept = {key: value for key, value in self._kept.items() if key in ids}
            points = read_points(self._scene, sweep)
            owner, owned = separate(
                SweepShots(sweep.time_s, sweep.world_from_lidar, points, ()), self._movers, self._rules
            )
            world = geometry.transform_points(sweep.world_from_lidar, points.xyz).astype(np.float32)
            self._kept[sweep.id] = (world, owner, owned)
        return self._kept[sweep.id]


def picture(rgb: NDArray[np.uint8], labels: Labels) -> Image.Image:
    """Image over image with labels over confidence."""
    colours = palette.encode(labels.semantics, palette.DISPLAY_COLORS)
    mixed = (0.45 * rgb + 0.55 * colours).astype(np.uint8)
    grey = np.repeat((labels.confidence * 255).astype(np.uint8)[..., None], 3, 2)
    return Image.fromarray(np.concatenate([rgb, mixed, grey]))
