"""``mudg annotate``: a scene -> the same scene with dense depth, classes, sky and dynamic objects, each pixel with a confidence.

The result is a complete new scene; the given one is not touched. A label that a frame has already is kept, one that it lacks
is made; a scene whose frames lack nothing is copied as it is. What made the labels is written into the scene's notes, so that
nobody takes them for truth.

Frames are labelled in separate processes, and each is staged when it is done: repeat the command to resume where it was
stopped.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mudg import native
from mudg.base import log, store
from mudg.base.processes import one_torch_thread, run_in_processes
from mudg.base.run_folder import RunDir
from mudg.base.types import Frame, Scene
from mudg.data.scene import SceneWriter, read_image, read_scene
from mudg.models.folders import CPU
from mudg.models.labels.ground import driven_path
from mudg.models.labels.inputs import LabelInput, Labels
from mudg.models.labels.labellers import labeller
from mudg.pages.annotate_page import write_page
from mudg.stages.config import AnnotateConfig
from mudg.stages.labelling import depth as annotate_depth
from mudg.stages.labelling.ego import find_ego
from mudg.stages.labelling.points import NearbyReturns

_STAGING = "labelled"
_SHARING = 4
"""Processes that share a device with the shipped network: each holds a context of some hundred megabytes there."""
_FRAMES_PER_PROCESS = 8
"""Fewer frames than this are not worth the start of a process."""


def write_labelled(config: AnnotateConfig, scene: Path, work: RunDir) -> dict[str, Any]:
    """Label a scene; the work folder becomes a scene with labels, and ``labels.html`` shows some of them. Returns a summary."""
    loaded, out = read_scene(scene), work.path
    wanted = wanted_labels(config)
    missing = [frame for frame in loaded.frames if not wanted <= set(frame.labels)]
    if not missing:
        log.info("annotate: the scene already has all labels; nothing to add")
    if not (out / "scene.json").is_file():
        staging = out / _STAGING
        _label_frames(config, scene, loaded, missing, staging)
        source = dataclasses.replace(
            loaded.source, notes=(*loaded.source.notes, *_notes(config, missing, work.inputs, staging))
        )
        with SceneWriter(out, loaded.id, source) as writer:
            writer.copy_all_but_frames(loaded)
            _add_frames(config, loaded, missing, staging, writer)
            writer.finish()
    write_page(read_scene(out), {frame.id for frame in missing}, out)
    shutil.rmtree(out / _STAGING, ignore_errors=True)
    return {"labelled": len(missing), "labeller": config.labeller if missing else "labels present"}


def wanted_labels(config: AnnotateConfig) -> set[str]:
    """Names of the labels that every frame shall have; a confidence comes only with a label that was made."""
    return {"semantics", "sky"} | ({"depth"} if config.depth else set()) | ({"dynamic"} if config.dynamic else set()) | (
        {"ego"} if config.ego else set()
    )  # fmt: skip


def _notes(config: AnnotateConfig, missing: Sequence[Frame], inputs: Mapping[str, str], staging: Path) -> Iterator[str]:
    """A sentence for each label that was made: for how many frames, and from what."""
    made_by = f"labeller '{config.labeller}'"
    if "weights" in inputs:
        made_by += annotate_depth.describe_folder(config.weights, inputs["weights"])
    depth = annotate_depth.origin(config, inputs, [frame.id for frame in missing if "depth" not in frame.labels], staging)
    origins = {"semantics": made_by, "sky": made_by, "depth": depth, "dynamic": "tracked boxes that move and dense depth",
               "ego": "pixels that stay the same while the vehicle moves"}  # fmt: skip
    for name, origin in origins.items():
        count = sum(name in wanted_labels(config) and name not in frame.labels for frame in missing)
        if count:
            yield f"{name} of {count} frames: {origin}, not truth"


# --- one frame after the other ----------------------------------------------------------------------------------------


def _label_frames(config: AnnotateConfig, path: Path, scene: Scene, missing: Sequence[Frame], staging: Path) -> None:
    """Put the labels of every frame that has none yet into ``staging``."""
    todo = [frame.id for frame in missing if not staged_labels(staging, frame.id).is_file()]
    if len(todo) < len(missing):
        log.info(f"annotate: {len(missing) - len(todo)} frames are labelled already")
    most = config.processes or _usual_processes(config)
    processes = min(most, len(todo) // _FRAMES_PER_PROCESS)
    with log.task("labelling frames", len(missing), len(missing) - len(todo)) as bar:
        if processes <= 1:
            for _ in label_into_staging(config, scene, todo, staging):
                bar.advance()
            return
        work = [
            (config, path, list(part), staging)
            for part in np.array_split(np.array(todo, dtype=object), 4 * processes)
            if len(part)
        ]
        for _, labelled in run_in_processes(_label_in_process, work, processes):
            bar.advance(labelled)


def _usual_processes(config: AnnotateConfig) -> int:
    """One per core; fewer where networks share a device: one with a pretrained network, which fills it, and a few with the shipped one,
    whose evidence is gathered on the CPU meanwhile."""
    cores = native.default_threads()
    if config.device == "cpu" or (config.labeller == "geometry" and not config.depth_network):
        return cores
    return 1 if config.labeller == "network" or config.depth_network else min(cores, _SHARING)


def _label_in_process(config: AnnotateConfig, path: Path, ids: list[str], staging: Path) -> int:
    return sum(1 for _ in label_into_staging(config, read_scene(path), ids, staging))


def label_into_staging(config: AnnotateConfig, scene: Scene, ids: Sequence[str], staging: Path) -> Iterator[str]:
    """Label these frames one after the other, write each to ``staging``, and name it when it is there."""
    if not ids:
        return
    label = labeller(config.labeller, config.weights, annotate_depth.place(config) if config.labeller != "geometry" else CPU)
    network = annotate_depth.load(config)
    returns = NearbyReturns(scene, config.sweeps)
    path = driven_path(scene.ego.world_from_ego)
    frames = {frame.id: frame for frame in scene.frames}
    for frame_id in ids:
        frame = frames[frame_id]
        near = returns.of(frame)
        given = LabelInput(frame.view, read_image(scene, frame), near.xyz_world, scene.tracks, path, near.beam_gap_deg,
                           near.highest_rad, returns.moving)  # fmt: skip
        with one_torch_thread():
            labels = label(given)
            if network is not None and "depth" not in frame.labels:
                labels = annotate_depth.with_network(network, given, labels, frame_id, staging)
        store.write_safetensors(staged_labels(staging, frame_id), label_arrays(config, labels))
        yield frame_id


def staged_labels(staging: Path, frame_id: str) -> Path:
    """Where the labels of a frame lie until the scene is written."""
    return staging / f"{frame_id}.safetensors"


def label_arrays(config: AnnotateConfig, labels: Labels) -> dict[str, NDArray[Any]]:
    """Labels under the names that a scene has for them; what was not asked for is left out."""
    arrays: dict[str, NDArray[Any]] = {
        "semantics": labels.semantics, "sky": labels.sky, "semantics_confidence": labels.confidence,
    }  # fmt: skip
    if config.depth:
        arrays |= {"depth": labels.depth, "depth_confidence": labels.depth_confidence}
    if config.dynamic:
        arrays["dynamic"] = labels.dynamic
    return arrays


def _add_frames(
    config: AnnotateConfig, scene: Scene, missing: Sequence[Frame], staging: Path, writer: SceneWriter
) -> None:
    ego = {name: find_ego(scene, name) for name in scene.cameras} if config.ego else {}
    lacking = {frame.id for frame in missing}
    for frame in scene.frames:
        if frame.id not in lacking:
            writer.copy_frame(scene, frame)
            continue
        arrays = store.read_safetensors(staged_labels(staging, frame.id))
        for name in ("semantics", "depth"):  # a confidence tells that a label was made: none beside one that was given
            if name in frame.labels:
                arrays.pop(f"{name}_confidence", None)
        if config.ego:
            arrays["ego"] = ego[frame.view.camera.name]
        writer.copy_frame(scene, frame, arrays)
