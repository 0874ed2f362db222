"""edit: a drive changed as a script says -> an edited fit, or an edited run that every other command takes like any
other; and the drive that ``synthesize --edits`` reads in place of the recorded one.

    of a fit:              OUT/model.json ... (as ``fit`` writes)
    of a ``mudg run``:     OUT/scene  OUT/fuse  OUT/fit/<method>  OUT/lidar.json what became of LiDAR returns
    of both:               OUT/edits.yaml the script with all defaults   OUT/edit.json what was done, collisions,
                           seldom-seen sides"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mudg.base import log, store
from mudg.base.errors import UsageError
from mudg.base.records import understood
from mudg.base.run_folder import RunDir
from mudg.base.types import FusedCloud, Scene
from mudg.core.raster.rasterize import drawing_device
from mudg.diffusion.published import is_published
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.synthesize import DriveInputs, JobInputs
from mudg.diffusion.views import recorded_images
from mudg.editing.apply import EditedDrive, carry_out, drawer, weather_of
from mudg.editing.harmonised import check_paths, repairing
from mudg.editing.recorded import EditedImages, cleared_cloud, photos_of_edited, vacated_at, write_edited_scene
from mudg.editing.runs import RunParts
from mudg.editing.script import EditScript, conditions_of
from mudg.editing.settings import EditConfig
from mudg.gaussians.model import SceneModel
from mudg.gaussians.storage import load_model, model_of_scene, save_model
from mudg.scene.clouds import read_fused, write_fused
from mudg.scene.read import read_scene


@dataclass(frozen=True, eq=False)
class PlannedEdit:
    """A script carried out in memory, and what it was carried out on. edited: the edited fit."""

    script: EditScript
    parts: RunParts
    scene: Scene | None
    model: SceneModel
    drive: EditedDrive
    edited: SceneModel

    @classmethod
    def of(cls, config: EditConfig, script: EditScript, parts: RunParts) -> PlannedEdit:
        """Carry out a script on the parts of a run; nothing is written. InputError: the script asks for what cannot be
        done. UsageError: repairs of images that there are not."""
        loaded = None if parts.scene is None else read_scene(parts.scene)
        model = load_model(parts.model) if loaded is None else model_of_scene(parts.model, loaded)
        drive = carry_out(script, model, loaded, None if parts.fused is None else read_fused(parts.fused))
        if parts.whole and conditions_of(script.canonical()) is not None:
            beams = "its LiDAR sweeps are in fog and rain" if drive.plan.weather_of_beams else "so do its LiDAR sweeps"
            stay = f"images of the edited scene stay as recorded, {beams}"
            log.info(f"edit: `mudg render` shows weather and light; {stay}")
        if parts.whole and drive.plan.background is not None:
            sweeps = "its scene has no LiDAR sweeps, for nobody measured that street"
            log.info(f"edit: all pixels of the edited images are renders; {sweeps}")
        if config.harmonize.on and not parts.whole:
            remedy = "edit a whole run, or render the fit with `mudg render --edits ... --harmonize.on`"
            raise UsageError("a fit by itself has no images to repair", where="--harmonize.on", remedy=remedy)
        if config.harmonize.on and loaded is not None:
            frames = {name: len(loaded.frames_of(name)) for name in loaded.cameras}
            check_paths(config.harmonize, {name: count for name, count in frames.items() if count})
        return cls(script, parts, loaded, model, drive, drive.model(model, keep_ego=not parts.whole))

    def write(self, config: EditConfig, work: RunDir) -> dict[str, Any]:
        """Write the edited fit or run, and what was done; returns a summary."""
        out, plan, device = work.path, self.drive.plan, drawing_device(config.device, "render", config.raster)
        changed: dict[str, Any] = {"changed": list(plan.changes), "removed": plan.removed}
        changed["inserted"] = list(plan.inserted)
        if self.parts.whole and self.scene is not None:
            whole = plan.moves_ego or plan.background is not None
            images = EditedImages(self.model.to(device), self.edited.to(device), config, whole)
            images = repairing(images, self.drive, self.scene) if config.harmonize.on else images
            changed["lidar"] = _write_run(self.drive, self.parts, self.scene, images, out)
        else:
            save_model(self.edited, out)
        store.write_text(out / "edits.yaml", self.script.text())
        conditions = {verb: settings.model_dump(mode="json") for verb, settings in plan.conditions.items()}
        last = {"ego": plan.moves_ego, "conditions": conditions, "notes": self.drive.notes}
        document = {"schema": 1, "digest": work.inputs["edits"], **changed, **last}
        store.write_json(out / "edit.json", document)
        return {**changed, "notes": len(self.drive.notes)}


def _write_run(drive: EditedDrive, parts: RunParts, scene: Scene, images: EditedImages, out: Path) -> dict[str, int]:
    """Scene, clouds and fits of an edited run; what an interrupted one finished is kept. Returns what became of LiDAR
    returns."""
    edited, cloud = drive.scene, drive.cloud
    if edited is None or cloud is None:  # both were given
        return {}
    if not (out / "fuse" / "fuse.json").is_file():
        write_fused(out / "fuse", cloud, _report_of(parts, cloud))
    if not (out / "scene" / "scene.json").is_file():
        counts = write_edited_scene(scene, drive, images, out / "scene")
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


def edited_scene(script: EditScript, config: SynthesizeConfig, inputs: JobInputs, scene: Scene) -> Scene:
    """The scene as the script leaves it. What cannot be done is told here, before anything is written. UsageError: an
    edit that the drive does not allow."""
    if conditions_of(script.canonical()) is not None and not shows_weather(config, script, inputs.fitted is not None):
        takes = "that takes --fitted and a published-type model"
        log.info(f"generated views show no weather and light ({takes}); `mudg render` does")
    fit = None if inputs.fitted is None else load_model(inputs.fitted)
    drive = carry_out(script, fit, scene, read_fused(inputs.fused))
    if fit is not None:
        drive.model(fit)
    return drive.scene or scene


def edited_drive(script: EditScript, config: SynthesizeConfig, inputs: JobInputs) -> DriveInputs:
    """The drive as the script leaves it: its scene, clouds and fit, recorded images without what they show wrongly, and
    its weather."""
    scene, cloud = read_scene(inputs.scene), read_fused(inputs.fused)
    fit = None if inputs.fitted is None else load_model(inputs.fitted)
    drive = carry_out(script, fit, scene, cloud)
    edited, fit = drive.scene or scene, None if fit is None else drive.model(fit)
    conditions, weather = conditions_of(script.canonical()), None
    if conditions is not None and fit is not None and shows_weather(config, script, True):
        weather = weather_of(drawer(fit), conditions, edited)
    recorded, cloud = photos_of_edited(recorded_images(scene, config), drive.plan), drive.cloud or cloud
    return DriveInputs(edited, cleared_cloud(cloud, drive.plan), recorded, fit, vacated_at(drive.plan), weather)


def shows_weather(config: SynthesizeConfig, script: EditScript, fitted: bool) -> bool:
    """Whether views are generated in the weather and light of a script: by a published-type model, from points and a
    reference in that weather, whose distances a fit tells."""
    conditions = conditions_of(script.canonical())
    wanted = conditions is not None and conditions.changes_air_ground_or_light and fitted and config.condition == "full"
    return wanted and is_published(config.model)
