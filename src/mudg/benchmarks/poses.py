"""How much of the error of tracked boxes a fit takes out: generated logs whose boxes were disturbed by known amounts.

Three kinds of disturbance, in the frame of the box, all `NOISE_M` along each axis and `NOISE_RAD` of yaw: *noise*,
drawn anew at every key, as a detector makes it; *drift*, the same noise passed through a Gaussian of `DRIFT_S`, as a
tracking filter leaves it; an *offset*, drawn once per object, as a labeller makes it. Boxes stay disturbed for fusing
too.

What can be recovered. An object is its Gaussians in the box frame and the poses of that frame. Any one rigid motion may
be taken from the poses and given to the Gaussians without changing a single picture, at any time. So poses are compared
after the best such motion (shift and yaw, one per object) is taken out, before and after fitting alike:

    recovered = 1 - rms(after) / rms(before)

over the keys of frames in which the object shows at least `SEEN_PX` pixels, held-out frames included. Of an offset,
which is such a motion, nothing can be recovered from pictures; there, the test is that pictures do not suffer and boxes
do not drift.

Objects in generated cities move evenly, which flatters smoothing: of independent noise, the smooth path alone (poses
"smoothed": no picture consulted) takes out most. Drift is the case in which only the pictures can help.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mudg.base import geometry, log, seeds
from mudg.base.config import result_settings
from mudg.base.html import markdown_table
from mudg.base.run_folder import RunDir
from mudg.base.types import FusedCloud, Scene, Track
from mudg.benchmarks.loop import finished
from mudg.benchmarks.settings import BenchConfig
from mudg.city.config import CityConfig
from mudg.city.logs import write_city
from mudg.core import metrics
from mudg.core.fusion import fuse_sweeps
from mudg.core.raster.place import drawing_device
from mudg.gaussians import fit
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.rendering import raster_of
from mudg.gaussians.settings import DensifyConfig, FitConfig, PoseConfig, RecordedLossConfig, StartConfig
from mudg.scene.fuse import rules_of, scene_sweeps
from mudg.scene.labels import read_label
from mudg.scene.read import read_image, read_scene
from mudg.scene.settings import FuseConfig

LISTS: dict[str, tuple[int, ...]] = {
    "development": (2_000_000, 2_000_001, 2_000_002, 2_000_003),
    "reported": tuple(range(2_000_100, 2_000_106)),
}
"""Seeds of cities: for development, and to report on."""
NOISE_M, NOISE_RAD = 0.1, np.radians(1.0)
SEEN_PX, FEWEST_KEYS = 60, 4
FRAMES, WIDTH, HEIGHT = 16, 240, 160
DRIFT_S = 0.4
CASES = (("noise", "learnt"), ("noise", "smoothed"), ("noise", "fixed"), ("drift", "learnt"), ("offset", "learnt"))
"""Kind of boxes, and what is done about their poses."""


@dataclass(frozen=True)
class Errors:
    """Root mean square over an object's seen keys, metres and radians; ``keys`` how many."""

    position_m: float
    yaw_rad: float
    keys: int


def measure(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    """Fit every city with boxes as they are, with noise and with offsets, poses fixed and learnt; numbers and a table.
    Rows that an interrupted run wrote are taken as they are."""
    cities, rows = LISTS[config.cities][: config.count], []
    with log.task("fitting", len(cities) * len(CASES)) as bar:
        for city in cities:
            scene = city_scene(city, out / "cities" / str(city))
            for kind in dict.fromkeys(kind for kind, _ in CASES):
                case = cache(partial(_case, scene, kind, config.seed + city))  # the same for all ways to fit it
                for poses in (poses for other, poses in CASES if other == kind):
                    path = out / "rows" / f"{city}_{kind}_{poses}.json"
                    row = {"city": city, "boxes": kind, "poses": poses}
                    rows.append(finished(path, partial(_measured, config, scene, case, row, out / "fits" / path.stem)))
                    bar.advance()
    result = {"cities": list(cities), "iterations": config.pose_iterations, "rows": rows, "summary": summary(rows)}
    return result, table(result)


def _case(scene: Scene, kind: str, seed: int) -> tuple[Scene, FusedCloud]:
    """A city with disturbed boxes, and its clouds."""
    disturbed_scene = replace(scene, tracks=disturbed(scene.tracks, kind, seed))
    return disturbed_scene, cloud_of(disturbed_scene)


def _measured(
    config: BenchConfig, truth: Scene, case: Callable[[], tuple[Scene, FusedCloud]], row: Mapping[str, Any], out: Path
) -> dict[str, Any]:
    """A row with the errors of its fit."""
    scene, cloud = case()
    return {**row, **row_of(truth, scene, fitted(scene, cloud, fit_settings(config, row["poses"]), out).model)}


def cloud_of(scene: Scene) -> FusedCloud:
    """The clouds of a scene, as fuse makes them by default."""
    return fuse_sweeps(scene_sweeps(scene, FuseConfig()), scene.tracks, rules_of(FuseConfig()))[0]


def fit_settings(config: BenchConfig, poses: str) -> FitConfig:
    """A small, quick fit with poses "fixed", "learnt", or only "smoothed"."""
    return FitConfig(
        method="street_gaussians",
        iterations=config.pose_iterations,
        seed=config.seed,
        device=config.device,
        preview_every=10**6,
        checkpoint_every=10**6,
        start=StartConfig(gaussians=8000),
        densify=DensifyConfig(kind="none"),
        loss=RecordedLossConfig(semantic_every=1000),
        poses=PoseConfig(learn=poses != "fixed", rounds=0 if poses == "smoothed" else PoseConfig().rounds),
    )


def city_scene(seed: int, folder: Path, **changes: Any) -> Scene:
    """A small generated log, made when missing."""
    if not (folder / "scene.json").is_file():
        config = CityConfig(
            seed=seed, n_frames=FRAMES, width=WIDTH, height=HEIGHT, cameras=("front",), lidar_azimuth_step_deg=0.8
        )
        write_city(replace(config, **changes), folder)
    return read_scene(folder)


def disturbed(tracks: tuple[Track, ...], kind: str, seed: int) -> tuple[Track, ...]:
    """The tracks with every key displaced in its own frame: "noise", "drift" or "offset" (see the module's text)."""
    made = []
    for index, track in enumerate(tracks):
        draws = seeds.numpy_rng(seed, index, f"track {kind}").normal(size=(len(track.times_s), 4))
        if kind == "offset":
            draws = np.broadcast_to(draws[:1], draws.shape)
        if kind == "drift":
            kernel = np.exp(-0.5 * ((track.times_s[:, None] - track.times_s) / DRIFT_S) ** 2)
            draws = kernel / np.linalg.norm(kernel, axis=1, keepdims=True) @ draws
        moves = np.stack([geometry.yaw_matrix(NOISE_RAD * row[3], NOISE_M * row[:3]) for row in draws])
        made.append(Track(track.id, track.label, track.size_m, track.times_s, track.world_from_object @ moves))
    return tuple(made)


def fitted(scene: Scene, cloud: FusedCloud, config: FitConfig, folder: Path) -> fit.FitState:
    """Fit in memory; ``folder`` takes the log and the pictures."""
    device = drawing_device(config.device, "fit", config.raster)
    return optimised(
        fit.start_state(config, scene, cloud, *fit.recorded_views(config, scene)).to(device), config, folder
    )


def optimised(state: fit.FitState, config: FitConfig, folder: Path) -> fit.FitState:
    """The state after all steps; as ``fitted``."""
    run = RunDir.open(folder, fit.OUTPUT, result_settings(config), {})
    if not run.fresh:  # the fit starts again, and so does its log
        run.discard()
        run = RunDir.open(folder, fit.OUTPUT, result_settings(config), {})
    fit.optimise(state, config, run)
    return state


def seen_keys(scene: Scene) -> dict[str, NDArray[np.intp]]:
    """Per track of a generated log: numbers of the keys at frames where it shows enough pixels."""
    times: dict[int, list[float]] = {}
    for frame in scene.frames:
        pixels = np.bincount(read_label(scene, frame, "instance").ravel())
        for instance in np.flatnonzero(pixels >= SEEN_PX):
            times.setdefault(int(instance), []).append(frame.view.time_s)
    found = {}
    for track in scene.tracks:
        seen = times.get(int(track.id.rsplit("-", 1)[1]), [])
        found[track.id] = np.unique([int(np.abs(track.times_s - time_s).argmin()) for time_s in seen]).astype(np.intp)
    return found


def pose_errors(truth: NDArray[np.float64], keys: NDArray[np.float64], free: bool = True) -> Errors:
    """Errors of poses f64[K, 4, 4] against the truth; ``free``: after the best constant motion in the box frame is
    taken out."""
    local = np.einsum("kji,kj->ki", keys[:, :3, :3], truth[:, :3, 3] - keys[:, :3, 3])
    turn = np.array([geometry.yaw_of(geometry.invert(b) @ a) for a, b in zip(truth, keys)])
    if free:
        local, turn = local - local.mean(0), turn - turn.mean()
    return Errors(float(np.sqrt((local**2).sum(1).mean())), float(np.sqrt((turn**2).mean())), len(keys))


def row_of(truth: Scene, given: Scene, model: SceneModel) -> dict[str, Any]:
    """Errors of every object that was seen at four keys or more, and PSNR on dynamic objects in held-out frames."""
    objects, keys_seen = [], seen_keys(truth)
    for node in model.nodes:
        if not isinstance(node, RigidNode) or len(keys_seen[node.name]) < FEWEST_KEYS:
            continue
        seen = keys_seen[node.name]
        exact, before, after = (
            t[seen]
            for t in (
                truth.track(node.name).world_from_object,
                given.track(node.name).world_from_object,
                node.corrected_keys(),
            )
        )
        found = {"object": node.name, "keys": len(seen)}
        for name, keys in (("before", before), ("after", after)):
            for free in (True, False):
                errors = pose_errors(exact, keys, free)
                place = name if free else f"{name}_absolute"
                found |= {f"{place}_m": errors.position_m, f"{place}_rad": errors.yaw_rad}
        objects.append(found)
    return {"objects": objects, "psnr_moving": moving_psnr(truth, model)}


def moving_psnr(scene: Scene, model: SceneModel) -> float:
    """PSNR over all pixels of dynamic objects in the held-out frames together; NaN where there are none."""
    errors = []
    for frame in scene.frames_in("test"):
        moving = torch.from_numpy(read_label(scene, frame, "dynamic").astype(bool))
        truth = torch.from_numpy(read_image(scene, frame)).permute(2, 0, 1).float() / 255
        errors.append((fit.render_view(model, frame.view, raster_of(model)).rgb - truth)[:, moving].flatten())
    return metrics.psnr_of_errors(torch.cat(errors) if errors else torch.zeros(0))


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per kind of box and way of fitting: errors pooled over keys, shares recovered, mean PSNR on dynamic objects."""
    made = []
    for kind, poses in dict.fromkeys((row["boxes"], row["poses"]) for row in rows):
        mine = [row for row in rows if (row["boxes"], row["poses"]) == (kind, poses)]
        objects = [found for row in mine for found in row["objects"]]
        keys = np.array([found["keys"] for found in objects], float)
        pooled = {}
        for name in (
            f"{when}{how}_{unit}" for when in ("before", "after") for how in ("", "_absolute") for unit in ("m", "rad")
        ):
            pooled[name] = float(np.sqrt((np.array([found[name] for found in objects]) ** 2 * keys).sum() / keys.sum()))
        shares = {
            f"recovered_{unit}": 1 - pooled[f"after_{unit}"] / max(pooled[f"before_{unit}"], 1e-9)
            for unit in ("m", "rad")
        }
        psnr = float(np.nanmean([row["psnr_moving"] for row in mine]))
        made.append(
            {
                "boxes": kind,
                "poses": poses,
                "objects": len(objects),
                "keys": int(keys.sum()),
                **pooled,
                **shares,
                "psnr_moving": psnr,
            }
        )
    return made


def table(result: dict[str, Any]) -> str:
    """The summary as text."""
    heads = [
        "boxes",
        "poses",
        "objects",
        "position [m]",
        "after",
        "recovered",
        "yaw [deg]",
        "after",
        "recovered",
        "absolute [m]",
        "PSNR moving [dB]",
    ]
    cells = []
    for row in result["summary"]:
        recoverable = row["boxes"] in ("noise", "drift") and row["poses"] != "fixed"
        shares = [f"{row[f'recovered_{unit}']:.0%}" if recoverable else "-" for unit in ("m", "rad")]
        degrees = [f"{np.degrees(row[f'{when}_rad']):.2f}" for when in ("before", "after")]
        cells.append(
            [
                row["boxes"],
                row["poses"],
                str(row["objects"]),
                f"{row['before_m']:.3f}",
                f"{row['after_m']:.3f}",
                shares[0],
                *degrees,
                shares[1],
                f"{row['after_absolute_m']:.3f}",
                f"{row['psnr_moving']:.2f}",
            ]
        )
    return (
        "\n".join(
            [
                (
                    f"# Boxes of {len(result['cities'])} generated logs ({FRAMES} frames, {WIDTH}x{HEIGHT},"
                    f" {result['iterations']} steps)"
                ),
                "",
                (
                    f"noise: {NOISE_M} m along each axis and 1 degree, anew per key; drift: the same, correlated over"
                    f" {DRIFT_S} s; offset: once per"
                ),
                "object. A constant motion per object is taken out of all errors but the absolute one.",
                "",
                *markdown_table(heads, cells),
            ]
        )
        + "\n"
    )
