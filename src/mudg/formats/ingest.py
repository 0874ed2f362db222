"""``mudg ingest``: a dataset log, or the built-in procedural city -> a scene directory."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mudg import native
from mudg.base import log, store
from mudg.base.errors import InputError, UsageError
from mudg.base.run_folder import RunDir, run_state
from mudg.base.types import Scene
from mudg.formats.importers import RECOGNISERS, files_of, import_log, known_formats
from mudg.formats.importers.common import ImportOptions, parse_frame_range, parse_resolution
from mudg.formats.settings import IngestConfig
from mudg.scene import check, contact_sheet
from mudg.scene.read import read_scene
from mudg.scene.write import SceneWriter

CITY = "city"


def files_read(config: IngestConfig, source: Path, kind: str) -> dict[str, Path]:
    """Files of the log that an import of this kind reads, by names for messages."""
    if kind in (CITY, _SCENE):
        return {}
    files = files_of(kind, source, import_options(config))
    return {f"file {n} of the log": path for n, path in enumerate((*files.files, *files.entries))}


def is_abandoned(out: Path) -> bool:
    """Whether an import that is not finished made no scene at ``out`` yet."""
    state = run_state(out)
    return state.get("verb") == "ingest" and state["state"] != "complete" and not (out / "scene.json").is_file()


def write_scene(config: IngestConfig, source: Path, kind: str, work: RunDir) -> dict[str, Any]:
    """Make the scene in its folder and draw its contact sheet; returns a summary. An import that fails in a new or
    empty folder leaves nothing. Raises InputError: the log is malformed or contradictory."""
    if kind not in (CITY, _SCENE, config.format):
        log.info(f"ingest: {source} recognised as {kind}")
    try:
        return _fill(work, kind, config, source)
    except BaseException:
        if work.fresh and not (work.path / "scene.json").is_file():
            work.discard()  # nothing was made: the next try may ask for something else
        raise


def _fill(folder: RunDir, kind: str, config: IngestConfig, source: Path) -> dict[str, Any]:
    if (folder.path / "scene.json").is_file():
        scene = read_scene(folder.path)  # finished by a run that was stopped before it could say so
    else:
        if kind == CITY:
            scene = _city(config, folder.path)
        elif kind == _SCENE:
            scene = _copy_scene(config, source, folder.path)
        else:
            scene = import_log(kind, source, folder.path, import_options(config))
            warnings = [finding for finding in check.check_records(scene) if finding.level == "warning"]
            for line in check.folded(warnings, f"mudg doctor {folder.out}"):
                log.warn(f"ingest: {line}")
    held_out = sum(split == "test" for split in scene.split.values())
    log.info(
        f"ingest: {len(scene.frames)} images of {len(scene.cameras)} cameras, {len(scene.sweeps)} sweeps,"
        f" {len(scene.tracks)} tracked boxes; {held_out} images held out"
    )
    counts = {"frames": scene.frames, "sweeps": scene.sweeps, "tracks": scene.tracks}
    summary = {**{name: len(records) for name, records in counts.items()}, "held_out": held_out}
    if config.contact_sheet:
        store.write_image(folder.path / contact_sheet.NAME, contact_sheet.contact_sheet(scene), quality=88)
        log.info(f"ingest: check {folder.out / contact_sheet.NAME}")
    if kind == CITY:
        return summary
    alignment = check.camera_alignment(scene)
    for name, one in alignment.items():
        (log.warn if one.verdict == "doubtful" else log.info)(f"ingest: {check.describe(name, one)}")
    return {**summary, "alignment": {name: check.to_json(one) for name, one in alignment.items()}}


_SCENE = "scene"


def kind_of(config: IngestConfig, source: Path) -> str:
    """Which format ``source`` has: one of a log, ``city`` or ``scene``. Raises UsageError: there is no such format.
    InputError: the log has none that is known."""
    if str(source) == CITY:
        return CITY
    if config.format != "auto":
        if config.format not in known_formats():
            expected = ", ".join(("auto", *known_formats()))
            raise UsageError("there is no such format", where="--format", expected=expected, got=config.format)
        return config.format
    if is_scene(source):
        return _SCENE
    for name, looks_like in RECOGNISERS.items():
        if looks_like(source):
            return name
    entries = sorted(entry.name for entry in source.iterdir()) if source.is_dir() else ["a file"]
    what, expected = "the log's format was not recognised", f"a scene, or a log of one of: {', '.join(known_formats())}"
    remedy = "give the folder of one drive or sequence, or name the format with --format"
    raise InputError(
        what, where=str(source), expected=expected, got=", ".join(entries[:10]) or "nothing", remedy=remedy
    )


def is_scene(source: Path) -> bool:
    """Whether ``source`` is a scene directory."""
    return (source / "scene.json").is_file()


def import_options(config: IngestConfig) -> ImportOptions:
    """The importer's options that a configuration asks for."""
    return ImportOptions(
        frames=parse_frame_range(config.frames),
        cameras=config.cameras,
        sequence=config.sequence,
        poses=Path(config.poses) if config.poses else None,
        boxes=Path(config.boxes) if config.boxes else None,
        skip_missing=config.skip_missing,
        untwist=config.untwist,
        test_every=config.test_every,
        resolution=parse_resolution(config.resolution),
        workers=config.workers or native.default_threads(),
    )


def source_digest(source: Path, kind: str, config: IngestConfig) -> str:
    """What identifies a log without reading all of it: names, sizes and modification times of the files that belong to
    the chosen one; a scene's own digest. Raises UsageError: several logs and none was chosen. InputError: none is
    there. ``kind``: format, or ``scene``. ``config``: chooses the log, where a folder holds many; files it names count,
    too."""
    if kind == _SCENE:
        return store.digest(source)
    options = import_options(config)
    files = files_of(kind, source, options)
    named = [path for path in (options.poses, options.boxes) if path is not None and path.exists()]
    total = hashlib.sha256()
    base = source if source.is_dir() else source.parent
    for path in (*files.files, *named):
        for name in _walk(path):
            state = name.stat() if name.exists() else name.lstat()  # a link may lead nowhere
            place = Path(os.path.relpath(name, base)).as_posix()
            total.update(f"{place}\0{state.st_size}\0{state.st_mtime_ns}\n".encode())
    for path in files.entries:
        total.update(f"{path.name}\0{path.stat().st_mtime_ns}\n".encode())
    return total.hexdigest()


def _walk(path: Path) -> Iterator[Path]:
    """A file, or all files below a folder in the order of their names."""
    if path.is_file():
        yield path
    for folder, names, files in os.walk(path):
        names.sort()
        yield from (Path(folder) / name for name in sorted(files))


def _city(config: IngestConfig, out: Path) -> Scene:
    from mudg.city.config import CityConfig
    from mudg.city.logs import write_city

    what = "the generated city has settings of its own"
    _refuse_log_settings(config, what, "use --city.n-frames, --city.cameras, --city.width, ...")
    return write_city(CityConfig(**vars(config.city)), out, test_every=config.test_every)


def _refuse_log_settings(config: IngestConfig, what: str, remedy: str) -> None:
    names = ("frames", "cameras", "sequence", "poses", "boxes", "resolution")
    if flags := [f"--{name}" for name in names if getattr(config, name)]:
        raise UsageError(what, where=", ".join(flags), remedy=remedy)


def _copy_scene(config: IngestConfig, source: Path, out: Path) -> Scene:
    """Copy a scene, every file checked; held-out frames are kept as the scene has them."""
    _refuse_log_settings(config, "this setting does not apply to a scene, which is copied unchanged", "leave it out")
    scene = read_scene(source)
    with SceneWriter(out, scene.id, scene.source) as writer:
        writer.copy_all_but_frames(scene)
        for frame in log.progress(scene.frames, len(scene.frames), "copying frames"):
            writer.copy_frame(scene, frame)
        return writer.finish()
