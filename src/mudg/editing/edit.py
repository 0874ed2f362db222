"""edit: a drive changed as a script says -> an edited fit, or an edited run that every other command takes like any
other; and the drive that ``synthesize --edits`` reads in place of the recorded one.

    of a fit: OUT/model.json ... (as ``fit`` writes)   of a ``mudg run``: OUT/scene  OUT/fuse  OUT/fit/<method>
    of both:  OUT/edits.yaml the script with all defaults   OUT/edit.json what was done, and warnings
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy import ndimage

from mudg.base import geometry, log, store
from mudg.base.palette import DYNAMIC_IDS, ID, UNLABELLED
from mudg.base.run_folder import RunDir
from mudg.base.types import Frame, FusedCloud, Observation, Photo, PointCloud, Scene, Sweep, SweepPoints, View
from mudg.core import lidar
from mudg.core.edit import Motion
from mudg.core.fusion import points_in_box
from mudg.core.pictures import to_bytes
from mudg.core.raster.rasterize import RasterConfig, drawing_device
from mudg.diffusion.condition import DriveInputs, Vacated, VacatedAt, ray_directions
from mudg.diffusion.model_files import is_published
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import JobInputs, recorded_images
from mudg.editing.apply import EditedDrive, carry_out, drawer, some_points, weather_of
from mudg.editing.model import FLOOR_M, GROUND_CLASSES, STRAY_M
from mudg.editing.plan import Actor, EditPlan
from mudg.editing.runs import RunParts
from mudg.editing.script import EditScript, conditions_of
from mudg.editing.settings import EditConfig
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import raster_of, render_planes, render_view
from mudg.gaussians.storage import load_model, model_of_scene, save_model
from mudg.scene.clouds import read_fused, write_fused
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_points, read_scene
from mudg.scene.write import SceneWriter

# -- LiDAR sweeps ----------------------------------------------------------------------------------
#
# Beams that met what is gone go on, and meet what is new. The beams of a sweep are those that came back in the
# recording, from the place of the sensor at the sweep's time. Directions from which nothing came back (the sky) are not
# known, so an object in front of the sky gets no returns there.
BOX_MARGIN_M: Final = 0.1
BEHIND_M: Final = 20.0
"""Ground is taken to go on behind a removed object this far; what stands farther behind it is not known."""
ON_GROUND_M: Final = 0.15
LEAST_GROUND: Final = 10
Rows = NDArray[np.bool_]


def edited_points(points: SweepPoints, sweep: Sweep, plan: EditPlan, cloud: FusedCloud) -> SweepPoints:
    """The points of a sweep as the sensor would see the edited drive. ``cloud``: edited fused clouds: they hold the
    surfaces of objects, in the frames of their boxes."""
    xyz = points.xyz.astype(np.float64)
    ranges = np.linalg.norm(xyz, axis=1)
    usable = ranges > 1e-3
    directions = xyz / np.maximum(ranges, 1e-3)[:, None]
    cleared = np.zeros(len(xyz), bool)
    own: dict[str, Rows] = {}
    for name in dict.fromkeys((*plan.changes, *plan.removed)):
        own[name] = _within(xyz, sweep, plan.before.actors[name])
        cleared |= own[name]
    met = np.where(cleared | ~usable, np.inf, ranges)
    intensity, classes = points.intensity.copy(), None if points.classes is None else points.classes.copy()
    on_ground = _beyond(directions, ranges, np.flatnonzero(cleared & usable), sweep, plan)
    met = np.where(np.isfinite(on_ground), on_ground, met)
    fallen = np.isfinite(on_ground)
    intensity[fallen] = _ground_intensity(points, ranges, met[fallen], sweep, plan)
    if classes is not None:
        classes[fallen] = ID["road"]
    taken = np.zeros(len(xyz), bool)
    for name in plan.touched():
        hit, ids = _on_object(directions, sweep, plan.after.actors[name], cloud.objects.get(name))
        nearer = (hit < met) & usable
        met, taken = np.where(nearer, hit, met), taken | nearer
        intensity[nearer] = _object_intensity(points, own, name, sweep, plan)
        if classes is not None:
            classes[nearer] = ids[nearer]
    back = np.isfinite(met) & np.isfinite(intensity)
    changed = back & (fallen | taken)
    made = points.xyz.copy()
    made[changed] = (directions[changed] * met[changed, None]).astype(np.float32)
    kept = back | ~(usable | cleared)
    return SweepPoints(made[kept], intensity[kept], points.dt_s[kept], None if classes is None else classes[kept])


def _pose(motion: Motion, sweep: Sweep) -> NDArray[np.float64] | None:
    """sensor_from_box at a sweep's time."""
    pose = motion.pose_at(sweep.time_s)
    return None if pose is None else geometry.invert(sweep.world_from_lidar) @ pose


def _within(xyz: NDArray[np.float64], sweep: Sweep, actor: Actor) -> Rows:
    """Which points lie on an object: in its box, but not on the ground below it."""
    pose = _pose(actor.motion, sweep)
    if pose is None:
        return np.zeros(len(xyz), bool)
    local = geometry.transform_points(geometry.invert(pose), xyz)
    return points_in_box(local, actor.size_m, BOX_MARGIN_M, BOX_MARGIN_M)


def _beyond(
    directions: NDArray[np.float64], ranges: NDArray[np.float64], rows: NDArray[np.int64], sweep: Sweep, plan: EditPlan
) -> NDArray[np.float64]:
    """Range of the known ground behind what is gone, f64[N]; infinite where it is not known, or an object of the drive
    stands before it."""
    found = np.full(len(directions), np.inf)
    if plan.before.ground is None or not len(rows):
        return found
    free = lidar.met_ground(directions[rows], sweep.world_from_lidar, plan.before.ground, ranges[rows], BEHIND_M)
    for name, actor in plan.after.actors.items():
        pose = None if name in plan.touched() else _pose(actor.motion, sweep)
        if pose is not None:
            free = np.where(lidar.met_box(directions[rows], pose, actor.size_m) < free, np.inf, free)
    found[rows] = free
    return found


def _ground_intensity(
    points: SweepPoints, ranges: NDArray[np.float64], asked: NDArray[np.float64], sweep: Sweep, plan: EditPlan
) -> NDArray[np.float32]:
    """Median intensity of recorded ground at about the same range, f32; NaN where the sweep shows no ground."""
    if plan.before.ground is None or not len(asked):
        return np.zeros(0, np.float32)
    world = geometry.transform_points(sweep.world_from_lidar, points.xyz.astype(np.float64))
    with np.errstate(invalid="ignore"):
        low = np.abs(world[:, 2] - plan.before.ground.height(world[:, :2])) < ON_GROUND_M
    if not low.any():
        return np.full(len(asked), np.nan, np.float32)
    order = np.argsort(ranges[low], kind="stable")
    far, value = ranges[low][order], points.intensity[low][order]
    made = []
    for wanted in asked:
        first, last = np.searchsorted(far, (0.8 * wanted, 1.25 * wanted))
        made.append(np.median(value[first:last] if last - first >= LEAST_GROUND else value))
    return np.array(made, np.float32)


def _on_object(
    directions: NDArray[np.float64], sweep: Sweep, actor: Actor, surface: PointCloud | None
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Range at which beams meet an object, f64[N] (infinite: they miss it), and the class there u8[N]. Without points:
    those of its box."""
    hit = np.full(len(directions), np.inf)
    kind = ID.get(actor.label, UNLABELLED)
    ids = np.full(len(directions), kind, np.uint8)
    pose = _pose(actor.motion, sweep)
    if pose is None:
        return hit, ids
    around = lidar.met_box(directions, pose, np.array(actor.size_m) + 2 * lidar.LARGEST_M)
    rows = np.flatnonzero(np.isfinite(around))
    if surface is None or not len(surface.xyz):
        hit[rows] = lidar.met_box(directions[rows], pose, actor.size_m)
        return hit, ids
    own = surface.xyz.astype(np.float64)
    hit[rows], first = lidar.met_points(directions[rows], geometry.transform_points(pose, own), lidar.ball_sizes(own))
    if surface.semantics is not None:
        ids[rows] = np.where(first >= 0, surface.semantics[first], kind)
    return hit, ids


def _object_intensity(points: SweepPoints, own: Mapping[str, Rows], name: str, sweep: Sweep, plan: EditPlan) -> float:
    """Median intensity of an object's recorded returns; of a new one: of what else lies in boxes of this sweep, else of
    all of it."""
    mine = own.get(name)
    if mine is not None and mine.any():
        return float(np.median(points.intensity[mine]))
    xyz = points.xyz.astype(np.float64)
    boxes = [_within(xyz, sweep, actor) for actor in plan.before.actors.values()]
    all_boxes = np.any(boxes, axis=0) if boxes else np.zeros(len(xyz), bool)
    chosen = points.intensity[all_boxes] if all_boxes.any() else points.intensity
    return float(np.median(chosen)) if len(chosen) else float("nan")


# -- what photographs do not show ------------------------------------------------------------------
#
# The boxes of what was removed, moved or put in, and the ground about them, which holds their shadow. The direction of
# the sun is not known on a recorded log, so as much as the box is high counts on every side: other photographs show
# that ground without it.
Box = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Pose world_from_box f64[4, 4] and size f64[3] in metres."""
Boxes = Sequence[Box]
SHADOW_REACH: Final = 1.0
"""Shadows are looked for this far about a box, as a share of its height."""
SLAB_M: Final = 0.1
"""Thickness of the ground about a box that is drawn."""
BOX_GROWTH_M: Final = 0.2
SAME_M: Final = 1e-3
FARTHEST_GROUND_M: Final = 80.0
"""Nothing is known of how the ground goes on farther away."""


def photos_of_edited(photos: Iterable[Photo], plan: EditPlan) -> list[Photo]:
    """Recorded photographs with the pixels marked that do not show the edited drive."""
    made = []
    for photo in photos:
        height, width = photo.rgb.shape[:2]
        view = photo.view if photo.view.camera.width == width else photo.view.resized(width, height)
        touched = [box for when in ("before", "after") for box in touched_boxes(plan, photo.view.time_s, when)]
        usable = ~_hidden_by(view, touched, plan) & (True if photo.usable is None else photo.usable)
        made.append(replace(photo, usable=None if usable.all() else usable))
    return made


def _hidden_by(view: View, boxes: Boxes, plan: EditPlan) -> NDArray[np.bool_]:
    """Bool[H, W]: inside the outlines of boxes or on the ground about them, but not where another moving object stands
    in front, nor on that ground where one stands anywhere."""
    if not boxes:
        return np.zeros((view.camera.height, view.camera.width), bool)
    ahead = lambda box: float((view.cam_from_world @ box[0])[2, 3])
    rest, nearest = others(plan, view.time_s), min(map(ahead, boxes))
    covered = boxes_mask(view, boxes) | (ground_mask(view, boxes) & ~boxes_mask(view, rest))
    return covered & ~boxes_mask(view, [box for box in rest if ahead(box) < nearest])


def touched_boxes(plan: EditPlan, time_s: float, when: str) -> list[Box]:
    """Poses world_from_box f64[4, 4] and sizes f64[3] of what a plan removes, moves or puts in, where it is not the
    same at this time `before` and `after` the edits. An object on its recorded place is left out."""
    found = []
    for name in dict.fromkeys((*plan.removed, *plan.changes, *plan.inserted)):
        old, new = plan.before.pose_of(name, time_s), plan.after.pose_of(name, time_s)
        kept = name in plan.changes and name not in plan.inserted
        if kept and old is not None and new is not None and np.abs(old - new).max() < SAME_M:
            continue
        actor, pose = (plan.before.actors.get(name), old) if when == "before" else (plan.after.actors.get(name), new)
        if actor is not None and pose is not None:
            found.append((pose, np.asarray(actor.size_m, np.float64)))
    return found


def vacated_at(plan: EditPlan) -> VacatedAt:
    """Where, in a view of the edited drive, something stood in the recording and stands no more, its shadow
    included."""

    def found(view: View) -> Vacated:
        before, after = (touched_boxes(plan, view.time_s, when) for when in ("before", "after"))
        shown = boxes_mask(view, after)
        mask = _hidden_by(view, before, plan) & ~shown
        ground = np.full(mask.shape, np.nan, np.float32)
        rays = np.stack([axis.numpy() for axis in ray_directions(view)], -1).astype(np.float64)
        for pose, size in before:
            box = [(pose, size)]
            # depth of the plane below the box, where the ray meets it within `FARTHEST_GROUND_M`
            normal, foot = pose[:3, 2], pose[:3, 3] - pose[:3, 2] * size[2] / 2
            falls = rays @ normal
            depth = np.where(falls < -1e-4, (foot - view.center_world) @ normal / np.minimum(falls, -1e-4), np.nan)
            met = (depth > 0) & (depth < FARTHEST_GROUND_M) & (boxes_mask(view, box) | ground_mask(view, box))
            ground = np.where(met, np.fmin(ground, depth), ground).astype(np.float32)
        stood = mask & boxes_mask(view, before)
        return Vacated(*(torch.from_numpy(plane) for plane in (mask, ground, shown, stood)))

    return found


def cleared_cloud(cloud: FusedCloud, plan: EditPlan) -> FusedCloud:
    """Edited clouds without what boxes that were too small left behind of removed and moved objects along their
    recorded paths: static points in the grown boxes that are not ground."""
    static = cloud.static
    stray = np.zeros(len(static), bool)
    low_of = np.zeros(len(static), bool) if static.semantics is None else np.isin(static.semantics, GROUND_CLASSES)
    for name in dict.fromkeys((*plan.removed, *plan.changes)):
        actor = plan.before.actors[name]
        for pose in actor.motion.poses if actor.moves else ():
            local = geometry.transform_points(geometry.invert(pose), static.xyz.astype(np.float64))
            stray |= points_in_box(local, actor.size_m, STRAY_M, FLOOR_M)
    return replace(cloud, static=some_points(static, ~(stray & ~low_of)))


def others(plan: EditPlan, time_s: float) -> list[Box]:
    """Poses and sizes of the moving objects that a plan leaves alone."""
    touched = {*plan.removed, *plan.changes, *plan.inserted}
    moving = [actor for name, actor in plan.after.actors.items() if name not in touched and actor.moves]
    poses = ((actor.motion.pose_at(time_s), actor.size_m) for actor in moving)
    return [(pose, np.asarray(size_m, np.float64)) for pose, size_m in poses if pose is not None]


def boxes_mask(view: View, boxes: Boxes) -> NDArray[np.bool_]:
    """Bool[H, W]: inside the outline of a box, grown a little."""
    return outlines(view, [(pose, size + BOX_GROWTH_M) for pose, size in boxes])


def ground_mask(view: View, boxes: Boxes) -> NDArray[np.bool_]:
    """Bool[H, W]: ground below and about a box, as far as `SHADOW_REACH` times its height, where its shadow may
    lie; what stands there is not told apart."""
    slabs = []
    for pose, size in boxes:
        about_m = 2 * SHADOW_REACH * size[2]
        flat = pose @ geometry.yaw_matrix(0.0, (0.0, 0.0, -size[2] / 2))
        slabs.append((flat, np.array([size[0] + about_m, size[1] + about_m, SLAB_M])))
    return outlines(view, slabs)


def outlines(view: View, boxes: Boxes) -> NDArray[np.bool_]:
    """Bool[H, W]: inside the outline of a box."""
    covered = np.zeros((view.camera.height, view.camera.width), bool)
    for pose, size in boxes:
        # of what lies ahead: a box beside the camera does not cover the whole image
        hull = geometry.box_hull(view, pose, size)
        if hull is not None:
            canvas = Image.new("1", (view.camera.width, view.camera.height))
            outline = [(float(x), float(y)) for x, y in hull.points[hull.vertices] - 0.5]
            ImageDraw.Draw(canvas).polygon(outline, fill=1, outline=1)
            covered |= np.array(canvas, bool)
    return covered


# -- written ---------------------------------------------------------------------------------------
NOTE: Final = "edited: parts of the images are renders of a fitted scene"
CHANGED_ABOVE: Final = 4 / 255
"""Pixels whose renders with and without the edits differ by less than this, 0 to 1, stay as recorded or rendered."""
GROWN_PX: Final = 2
"""The rest is grown by this much: a render fades out beyond what differs clearly."""
KEPT_LABELS: Final = ("semantics", "depth", "sky", "dynamic")
"""Labels that a changed image keeps; others speak of the recording."""
RENDERED: Final = "rendered"


Models = tuple[SceneModel, SceneModel]
"""A fitted scene without and with the edits."""


def prepared(config: EditConfig, script: EditScript, parts: RunParts) -> Callable[[RunDir], dict[str, Any]]:
    """Carry out a script on the parts of a run. Nothing is written yet: what is returned writes the edited fit or run,
    and returns a summary. InputError: the script asks for what cannot be done."""
    scene = None if parts.scene is None else read_scene(parts.scene)
    model = load_model(parts.model) if scene is None else model_of_scene(parts.model, scene)
    drive = carry_out(script, model, scene, None if parts.fused is None else read_fused(parts.fused))
    if parts.whole and conditions_of(script.canonical()) is not None:
        log.info("edit: `mudg render` shows weather and light; images and sweeps of the edited scene stay as recorded")
    return functools.partial(_write, config, parts, scene, (model, drive.model(model, keep_ego=not parts.whole)), drive)


def _write(
    config: EditConfig, parts: RunParts, scene: Scene | None, models: Models, drive: EditedDrive, work: RunDir
) -> dict[str, Any]:
    plan, device = drive.plan, drawing_device(config.device, "render", config.raster)
    if parts.whole and scene is not None and drive.cloud is not None:
        if not (work.path / "fuse" / "fuse.json").is_file():
            write_fused(work.path / "fuse", drive.cloud, {})
        if not (work.path / "scene" / "scene.json").is_file():
            there = (models[0].to(device), models[1].to(device))
            write_edited_scene(scene, drive, there, raster_of(there[0], config.raster), work.path / "scene")
        for name, path in parts.fits.items():
            if not (work.path / "fit" / name / "model.json").is_file():
                made = models[1] if path == parts.model else drive.model(load_model(path))
                save_model(made, work.path / "fit" / name)
    else:
        save_model(models[1], work.path)
    store.write_text(work.path / "edits.yaml", drive.script.text())
    changed = {"changed": list(plan.changes), "removed": plan.removed, "inserted": list(plan.inserted)}
    document = {"schema": 1, "digest": work.inputs["edits"], **changed, "ego": plan.moves_ego, "notes": drive.notes}
    store.write_json(work.path / "edit.json", document)
    return {**changed, "notes": len(drive.notes)}


def write_edited_scene(scene: Scene, drive: EditedDrive, models: Models, raster: RasterConfig, root: Path) -> None:
    """Write a scene whose files show the edits, so that every step takes it like a recorded one.

    Images keep their recorded pixels where ``models`` render the same; the rest comes from the render of the edited
    one. Where the vehicle drives another path all pixels do. ``scene``: as recorded. ``drive``: with its scene and its
    cloud."""
    edited, cloud = drive.scene, drive.cloud
    if edited is None or cloud is None:
        raise ValueError("a drive without its scene or its cloud")
    source = replace(scene.source, recipe=None, notes=(*scene.source.notes, NOTE))
    with SceneWriter(root, scene.id, source) as writer:
        for camera in scene.cameras.values():
            writer.add_camera(camera)
        for sweep in scene.sweeps:
            points = edited_points(read_points(scene, sweep), sweep, drive.plan, cloud)
            writer.add_sweep(sweep.id, sweep.sensor, sweep.time_s, sweep.world_from_lidar, points)
        for track in edited.tracks:
            writer.add_track(track)
        writer.set_ego(edited.ego)
        writer.set_split(scene.split)
        pairs = list(zip(scene.frames, edited.frames, strict=True))
        for old, new in log.progress(pairs, len(pairs), "editing images"):
            made, recorded = render_view(models[1], new.view, raster), read_image(scene, old)
            changed = np.ones(recorded.shape[:2], bool)
            if not drive.plan.moves_ego:
                changed = changed_pixels(made, render_view(models[0], new.view, raster))
            if changed.any():
                image = np.where(changed[..., None], to_bytes(made.rgb), recorded)
                writer.add_frame(new.id, new.view, image, _labels(scene, old, changed, made))
            else:
                writer.copy_frame(scene, old)
        writer.finish()


def changed_pixels(made: Observation, usual: Observation) -> Rows:
    """Pixels bool[H, W] in which the renders with and without the edits differ, grown by `GROWN_PX`."""
    changed = ((made.rgb - usual.rgb).abs().amax(0) > CHANGED_ABOVE).numpy()
    return np.asarray(ndimage.binary_dilation(changed, iterations=GROWN_PX), bool) if changed.any() else changed


def _labels(scene: Scene, frame: Frame, changed: NDArray[np.bool_], generated: Observation) -> dict[str, NDArray[Any]]:
    """Labels of a changed image: those of the render where it is rendered."""
    found = {name: read_label(scene, frame, name) for name in KEPT_LABELS if name in frame.labels}
    ours = {RENDERED: changed | read_label(scene, frame, RENDERED) if RENDERED in frame.labels else changed}
    if generated.semantics is None or generated.depth is None:
        return ours
    ids = generated.semantics.numpy().astype(np.uint8)
    rendered = {"semantics": ids, "sky": ids == ID["sky"], "dynamic": np.isin(ids, DYNAMIC_IDS)}
    rendered["depth"] = np.nan_to_num(generated.depth[0].numpy(), nan=np.inf)
    return ours | {name: np.where(changed, rendered[name].astype(old.dtype), old) for name, old in found.items()}


# -- for ``synthesize`` ---


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
    """The drive as the script leaves it: clouds, fit, recorded images without what they show wrongly, and weather."""
    scene, cloud = read_scene(inputs.scene), read_fused(inputs.fused)
    fit = None if inputs.fitted is None else load_model(inputs.fitted)
    drive = carry_out(script, fit, scene, cloud)
    edited, fit = drive.scene or scene, None if fit is None else drive.model(fit)
    conditions, weather = conditions_of(script.canonical()), None
    if conditions is not None and fit is not None and shows_weather(config, script, True):
        weather = weather_of(drawer(fit), conditions, edited)
    recorded, cloud = photos_of_edited(recorded_images(scene, config), drive.plan), drive.cloud or cloud
    shown, cloud = None if fit is None else functools.partial(render_planes, fit), cleared_cloud(cloud, drive.plan)
    return DriveInputs(cloud, edited.tracks, recorded, shown, vacated_at(drive.plan), weather)


def shows_weather(config: SynthesizeConfig, script: EditScript, fitted: bool) -> bool:
    """Whether views are generated in the weather and light of a script: by a published-type model, from points and a
    reference in that weather, whose distances a fit tells."""
    conditions = conditions_of(script.canonical())
    wanted = conditions is not None and conditions.changes_air_ground_or_light and fitted and config.condition == "full"
    return wanted and is_published(config.model)
