"""edit: a drive changed as a script says -> an edited fit, or an edited run that every other command takes like any other.

of a fit:              OUT/model.json ... (as ``fit`` writes)
of a ``mudg run``:     OUT/scene  OUT/fuse  OUT/fit/<method>  OUT/lidar.json what became of LiDAR returns
of both:               OUT/edits.yaml the script with all defaults   OUT/edit.json what was done, collisions, seldom-seen sides
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mudg.base import log, store
from mudg.base.config import result_settings
from mudg.base.errors import UsageError
from mudg.base.records import understood
from mudg.base.run_folder import RunDir, VerbOutput, below, refuse_overlap
from mudg.base.types import FusedCloud, Scene
from mudg.core.raster.place import drawing_device
from mudg.data.cloudfile import read_fused, write_fused
from mudg.data.scene import SCENE_FILES, read_scene
from mudg.stages.config import EditConfig
from mudg.stages.editing.carried import EditedDrive, carry_out, read_and_digest
from mudg.stages.editing.harmonised import check_paths, repairing
from mudg.stages.editing.runs import RunParts, find_run
from mudg.stages.editing.weathered import conditions_of
from mudg.stages.editing.written import DriveChange, EditedImages, write_edited_scene
from mudg.stages.fitting.storage import load_model, model_of_scene, save_model

_MODEL = ("model.json", "gaussians.safetensors", "nodes.safetensors")
_OUTPUT = VerbOutput("edit", 3, (
    "edits.yaml", "edit.json", "lidar.json", *_MODEL, *below("fit/*", _MODEL), *below("scene", (*SCENE_FILES, store.MANIFEST)),
    *below("fuse", ("static.safetensors", "objects/*.safetensors", "fuse.json")),
))  # fmt: skip


def run(
    config: EditConfig, source: Path, script: Path, out: Path, *,
    scene: Path | None = None, fused: Path | None = None, overwrite: bool = False,
) -> Path:  # fmt: skip
    """Carry out an edit script; returns ``out``.

    Args:
        source: folder of a fit, or of a finished ``mudg run``.
        script: YAML file (``docs/edit.md``).
        scene, fused: of a fit: the scene that it was fitted to and its clouds. With a scene, the vehicle and parked objects can be
            edited too; clouds give the height of the ground. A run has its own.

    Raises:
        InputError: the script is not valid, or asks for what cannot be done; nothing is written then.
    """
    parsed, digest = read_and_digest(Path(script))
    parts = find_run(Path(source))
    place, clouds = scene or parts.scene, fused or parts.fused
    named = {f"{script}: {name}": path for name, path in parsed.files().items()}
    refuse_overlap(out, {"run": source, "script": script, "scene": place, "fused": clouds, **named})
    inputs = {"edits": digest} | {f"fit {name}".strip(): store.digest(path) for name, path in parts.fits.items()}
    inputs |= {name: store.digest(path) for name, path in (("scene", place), ("fused", clouds)) if path is not None}
    device = drawing_device(config.device, "render", config.raster)
    loaded = None if place is None else read_scene(place)
    model = load_model(parts.model) if loaded is None else model_of_scene(parts.model, loaded)
    cloud = None if clouds is None else read_fused(clouds)
    drive = carry_out(parsed, model, loaded, cloud)
    if parts.whole and conditions_of(parsed.canonical()) is not None:
        beams = "its LiDAR sweeps are in fog and rain" if drive.plan.weather_of_beams else "so do its LiDAR sweeps"
        log.info(f"edit: `mudg render` shows weather and light; images of the edited scene stay as recorded, {beams}")
    if parts.whole and drive.plan.weather_of_beams is not None:
        inputs["weather of beams"] = "fog, rain"  # another result than before sweeps showed them
    if parts.whole and drive.plan.background is not None:
        log.info("edit: all pixels of the edited images are renders; its scene has no LiDAR sweeps, for nobody measured that street")
    if config.harmonize.on and not parts.whole:
        raise UsageError("a fit by itself has no images to repair", where="--harmonize.on",
            remedy="edit a whole run, or render the fit with `mudg render --edits ... --harmonize.on`")  # fmt: skip
    if config.harmonize.on and loaded is not None:
        check_paths(config.harmonize, {name: len(loaded.frames_of(name)) for name in loaded.cameras if loaded.frames_of(name)})
    made = drive.model(model, keep_ego=not parts.whole)
    folder = RunDir.open(out, _OUTPUT, result_settings(config), inputs, overwrite, {} if parts.whole else {"scene": place, "fused": clouds})
    if folder.complete:
        return folder.reused()
    changed: dict[str, Any] = {
        "changed": list(drive.plan.changes), "removed": drive.plan.removed, "inserted": list(drive.plan.inserted)
    }  # fmt: skip
    try:
        if parts.whole and loaded is not None and cloud is not None:
            everywhere = drive.plan.moves_ego or drive.plan.background is not None
            images = EditedImages(model.to(device), made.to(device), config, everywhere)
            images = repairing(images, drive, loaded) if config.harmonize.on else images
            changed["lidar"] = _write_run(drive, parts, loaded, images, folder.path)
        else:
            save_model(made, folder.path)
    except KeyboardInterrupt:
        folder.pause()
        raise
    store.write_text(folder.path / "edits.yaml", parsed.text())
    conditions = {verb: settings.model_dump(mode="json") for verb, settings in drive.plan.conditions.items()}
    store.write_json(folder.path / "edit.json", {
        "schema": 1, "digest": digest, **changed, "ego": drive.plan.moves_ego, "conditions": conditions, "notes": drive.notes,
    })  # fmt: skip
    folder.finish({**changed, "notes": len(drive.notes)})
    return folder.path


def _write_run(drive: EditedDrive, parts: RunParts, scene: Scene, images: EditedImages, out: Path) -> dict[str, int]:
    """Scene, clouds and fits of an edited run; what an interrupted one finished is kept. Returns what became of LiDAR returns."""
    edited, cloud = drive.scene, drive.cloud
    if edited is None or cloud is None:  # both were given
        return {}
    if not (out / "fuse" / "fuse.json").is_file():
        write_fused(out / "fuse", cloud, _report_of(parts, cloud))
    if not (out / "scene" / "scene.json").is_file():
        counts = write_edited_scene(scene, DriveChange(drive.plan, edited, cloud), images, out / "scene").record()
        store.write_json(out / "lidar.json", {"schema": 1, **counts})
    for name, path in parts.fits.items():
        if not (out / "fit" / name / "model.json").is_file():
            save_model(images.after if path == parts.model else drive.model(load_model(path)), out / "fit" / name)
    with understood("counts of LiDAR returns", str(out / "lidar.json")):
        return {name: int(value) for name, value in store.read_json(out / "lidar.json").items() if name != "schema"}


def _report_of(parts: RunParts, cloud: FusedCloud) -> dict[str, object]:
    """What the fused clouds' report says of objects that are still there."""
    if parts.fused is None:
        return {}
    report = store.read_json(parts.fused / "fuse.json")
    own = ("format", "schema_version", "static", "objects", "camera_colors")
    with understood("a report of fused clouds", str(parts.fused / "fuse.json")):
        kept = {key: value for key, value in report.items() if key not in own}
        return {**kept, "tracks": {key: value for key, value in kept.get("tracks", {}).items() if key in cloud.objects}}
