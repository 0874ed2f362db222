"""Logs that a table of a paper is filled with: a named list of generated cities, or recorded logs, cut to the table's frames.

OUT/<log>/imported   a dataset's log as a scene      OUT/<log>/shown   the table's frames, cameras and held-out rule
OUT/<log>/scene      the same with the labels that it lacks; of a city, the generated log itself
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from mudg.base import store
from mudg.base.devices import DeviceName
from mudg.base.errors import InputError, UsageError
from mudg.base.run_folder import RunDir, VerbOutput, refuse_overlap
from mudg.base.types import Scene
from mudg.bench.chain import made
from mudg.bench.paper_tables import SCENE_LISTS, PaperTable, SceneRange
from mudg.bench.real import names_of
from mudg.bench.real_protocols import first_camera
from mudg.data.city import logs as city_logs
from mudg.data.city.logs import STANDARD, LogRules
from mudg.data.importers.options import holdout_split, parse_frame_range, parse_resolution
from mudg.data.scene import SCENE_FILES, read_scene
from mudg.data.scene.part import write_part
from mudg.stages import annotate, ingest
from mudg.stages.config import AnnotateConfig, BenchConfig, IngestConfig, on_device

CITY: Final = "city:"
"""How the name of a list of generated cities begins."""
_SHOWN: Final = VerbOutput("frames of a table", 1, SCENE_FILES)


@dataclass(frozen=True)
class ListedCity:
    """A generated log: its seed and what it is recorded with."""

    name: str
    seed: int
    rules: LogRules
    side: int = 1


@dataclass(frozen=True)
class RecordedLog:
    """A recorded log.

    Args:
        name: of its folder. source: a dataset's log or a scene. frames: first and last frame (both included), or None for all. size: of
            imported images (empty = as recorded). side: of one-sided shifts. note: what is to be said of it.
    """

    name: str
    source: Path
    frames: tuple[int, int] | None
    size: str
    side: int
    note: str


PaperLog = ListedCity | RecordedLog


def logs_of(config: BenchConfig, sources: Sequence[Path], table: PaperTable) -> tuple[PaperLog, ...]:
    """The logs that a table is filled with.

    Args:
        sources: ``city:NAME`` alone (see ``data/city/logs.py``), or folders of recorded logs.

    Raises:
        UsageError: no log, an unknown list, lists and folders together, or settings that make no sense for them.
    """
    names = [str(source) for source in sources]
    lists = [name.removeprefix(CITY) for name in names if name.startswith(CITY)]
    if not names or (lists and len(names) > 1):
        raise UsageError(
            "a list of cities stands alone" if names else "no logs to fill the table with", where=f"mudg bench paper --table {table.name}",
            expected=f"{CITY}reported, {CITY}development, or folders of logs", got=" ".join(names),
        )  # fmt: skip
    if lists:
        return _cities(config, lists[0], table)
    if config.logs != BenchConfig().logs:
        raise UsageError("recorded logs are counted by naming them", where="--logs", got=str(config.logs), remedy="leave it out")
    found = names_of(sources)
    return tuple(_recorded(config, name, source, table) for name, source in found.items())


def _cities(config: BenchConfig, name: str, table: PaperTable) -> tuple[PaperLog, ...]:
    if name not in city_logs.LISTS:
        raise UsageError(
            "no such list of cities", expected=", ".join(CITY + known for known in city_logs.LISTS), got=CITY + name
        )
    size, frames = parse_resolution(config.resolution), parse_frame_range(config.frames)
    if isinstance(size, int) or (frames is not None and frames[0] != 0):
        raise UsageError("a generated city takes a whole size and frames from 0 on", expected="--resolution WIDTHxHEIGHT, --frames 0:END",
                         got=f"{config.resolution} {config.frames}".strip())  # fmt: skip
    width, height = size or (STANDARD.width, STANDARD.height)
    cameras = ("front",) if table.front_only else STANDARD.cameras
    rules = LogRules(frames[1] if frames else STANDARD.frames, width, height, cameras)
    return tuple(ListedCity(str(seed), seed, rules) for seed in city_logs.LISTS[name][: config.logs])


def _recorded(config: BenchConfig, name: str, source: Path, table: PaperTable) -> RecordedLog:
    asked = parse_frame_range(config.frames)
    frames = (asked[0], asked[1] - 1) if asked else None
    listed = SCENE_LISTS.get(table.scenes, ())
    found = next((one for one in listed if one.segment in _identity(source)), None)
    note = ""
    if found is not None and frames is None:
        frames = (found.first, found.last)
    elif listed and found is None:
        note = f"not in the table's list {table.scenes}"
    elif found is not None and frames != (found.first, found.last):
        note = f"the table's frames are {found.first} to {found.last}"
    size = "" if ingest.is_scene(source) else config.resolution or table.size
    if config.resolution and ingest.is_scene(source):
        raise UsageError("a scene's images keep their size", where=str(source), got="--resolution",
                         remedy="leave it out, or give the dataset's own folder")  # fmt: skip
    return RecordedLog(name, source, frames, size, _side(found), note)


def _side(found: SceneRange | None) -> int:
    return 1 if found is None else found.side


def _identity(source: Path) -> str:
    """Text in which a segment's name is looked for: the path's name, and a scene's id."""
    return f"{source.name} {read_scene(source).id if ingest.is_scene(source) else ''}"


def missing_scenes(table: PaperTable, logs: Sequence[PaperLog]) -> tuple[str, ...]:
    """Segments of the table's list that no recorded log belongs to; none where cities are scored."""
    given = " ".join(_identity(log.source) for log in logs if isinstance(log, RecordedLog))
    return tuple(one.segment for one in SCENE_LISTS.get(table.scenes, ()) if given and one.segment not in given)


def scored_cameras(scene: Scene, table: PaperTable) -> tuple[str, ...]:
    """The cameras that a table scores."""
    return tuple(scene.cameras) if table.all_cameras else (first_camera(scene, ()),)


def facts_of(log: PaperLog, scene: Scene) -> dict[str, Any]:
    """A log as JSON values."""
    sizes = dict.fromkeys(f"{camera.width}x{camera.height}" for camera in scene.cameras.values())
    return {
        "log": log.name, "dataset": scene.source.dataset, "cameras": list(scene.cameras),
        "frames": len(scene.frames_of(first_camera(scene, ()))), "size": ", ".join(sizes),
        "held_out": len(scene.frames_in("test")), "tracks": len(scene.tracks),
        "note": log.note if isinstance(log, RecordedLog) else "",
    }  # fmt: skip


# ---- scenes ----


def make_scene(log: PaperLog, table: PaperTable, out: Path, device: DeviceName, overwrite: bool) -> Path:
    """The scene of a log under the rules of a table, made if need be.

    Args:
        out: folder of the log. device: of the labeller's network. overwrite: replace what other settings left there.

    Raises:
        InputError: the log has fewer frames than the table asks for. Whatever a verb raises.
    """
    if isinstance(log, ListedCity):
        settings = IngestConfig(test_every=table.held_out_every, city=city_logs.log_config(log.seed, log.rules))
        return made(lambda o: ingest.run(settings, ingest.CITY, out / "scene", overwrite=o), overwrite)
    refuse_overlap(out, {"log": log.source})
    whole, frames = log.source, log.frames
    if not ingest.is_scene(whole):
        text = "" if frames is None else f"{frames[0]}:{frames[1] + 1}"
        settings = IngestConfig(test_every=0, resolution=log.size, frames=text)
        whole, frames = made(lambda o: ingest.run(settings, log.source, out / "imported", overwrite=o), overwrite), None
    shown = made(lambda o: _write_shown(whole, frames, table, out / "shown", o), overwrite)
    labels = on_device(AnnotateConfig(processes=1), device)
    if all(annotate.wanted_labels(labels) <= set(frame.labels) for frame in read_scene(shown).frames):
        return shown
    return made(lambda o: annotate.run(labels, shown, out / "scene", overwrite=o), overwrite)


def _write_shown(whole: Path, frames: tuple[int, int] | None, table: PaperTable, out: Path, overwrite: bool) -> Path:
    """The table's frames of a scene, with its rule of what is held out."""
    asked = {"frames": frames, "held_out_every": table.held_out_every, "front_only": table.front_only}
    folder = RunDir.open(out, _SHOWN, asked, {"scene": store.digest(whole)}, overwrite)
    if folder.complete:
        return folder.reused()
    scene = read_scene(whole)
    camera = first_camera(scene, ())
    times = np.array(sorted(frame.view.time_s for frame in scene.frames_of(camera)))
    first, last = frames or (0, len(times) - 1)
    if frames is not None and len(times) == last - first + 1:
        first, last = 0, len(times) - 1  # imported with these very frames
    if last >= len(times):
        raise InputError("the log has fewer frames than the table asks for", where=str(whole), expected=f"frames {first} to {last}",
                         got=f"{len(times)} frames of camera {camera}", remedy="give the whole log, or choose --frames")  # fmt: skip
    moment = lambda time_s: int(np.argmin(np.abs(times - time_s)))  # noqa: E731
    kept = [
        frame for frame in scene.frames
        if first <= moment(frame.view.time_s) <= last and (not table.front_only or frame.view.camera.name == camera)
    ]  # fmt: skip
    sweeps = [sweep.id for sweep in scene.sweeps if first <= moment(sweep.time_s) <= last]
    groups = [[f.id for f in kept if moment(f.view.time_s) == number] for number in range(first, last + 1)]
    split = holdout_split(groups, table.held_out_every)
    held = [name for name, part in split.items() if part == "test"]
    write_part(scene, folder.path, {frame.id for frame in kept}, sweeps, held_out=held)
    folder.finish({"frames": len(kept), "held_out": len(held)})
    return folder.path
