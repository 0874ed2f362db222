"""``mudg bench loop``: pilots drive in the reconstruction of a generated log, off its recorded path, and in the exact
city. Their pictures are scored against the exact city at the poses that they drove to; so is how far the two drives
part, what they hit, and whether they leave the road. Road users move as recorded in both."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mudg.base import geometry, store
from mudg.base.errors import UsageError
from mudg.base.html import markdown_table
from mudg.base.types import Camera, View
from mudg.benchmarks.chain import compare, mean, refuse, standard_error
from mudg.benchmarks.places import Views, listed_cities, score_settings
from mudg.benchmarks.rows import BASE, FULL, MIXED, Facts, PaperPlace, PaperTable, method_rows, settings_of
from mudg.benchmarks.settings import BenchConfig
from mudg.city.config import CityConfig
from mudg.city.logs import STANDARD
from mudg.city.world import CityWorld
from mudg.core import metrics
from mudg.scene.motion import Road
from mudg.sim.drive import Cockpit, Drive, Following, RoadUser, beginning
from mudg.sim.lidar import LidarRequest, MountedLidar, mounted
from mudg.sim.pilots import DriverView, EdgePilot, RoutePilot
from mudg.sim.session import Instant, Session
from mudg.steps.settings import PresetName

EXACT: Final = "exact city"
"""The row of the drive in the city itself."""
PILOTS: Final[Mapping[str, tuple[type[RoutePilot], float]]] = {
    "left": (RoutePilot, 3.0),
    "right": (RoutePilot, -3.0),
    "left edge": (EdgePilot, 8.0),
    "right edge": (EdgePilot, -8.0),
}
"""Pilot -> its class, and where it aims, metres to the left of the recorded path, from the first step on."""
SEEN: Final = ("rgb", "depth", "classes")
FAR_M: Final = 80.0
"""Depth counts up to here."""
SWEPT: Final = 5
"""Every so many steps the LiDAR is judged, too."""
COLUMNS: Final[Mapping[str, tuple[str, int]]] = {
    "psnr": ("PSNR dB", 2),
    "abs_rel": ("AbsRel", 4),
    "miou": ("mIoU", 3),
    "range_m": ("LiDAR, m", 3),
    "beams_f1": ("beams F1", 3),
    "shift_m": ("largest shift, m", 2),
    "parting_m": ("apart, mean, m", 3),
    "parted_m": ("apart at the end, m", 3),
    "speed_off_mps": ("speed off, m/s", 3),
    "collisions": ("collisions", 2),
    "departures": ("off the road", 2),
}


class LoopLog(Views):
    """One log of the list."""

    def measure(self) -> dict[str, Any]:
        """What every row measured with every pilot."""
        self.chain.fuse()
        course, drives = Course.of(self.city), self.out / "drives"

        def finished(row: str, pilot: str, *judged: Any) -> dict[str, Any]:
            """What an interrupted benchmark wrote, else measured now."""
            path = drives / f"{row}-{pilot.replace(' ', '_')}.json"
            if not path.is_file():
                picture = path.with_suffix(".jpg") if judged else None
                store.write_json(path, measure_drive(course, pilot, *judged, picture=picture))
            return store.read_json(path)

        exact = {pilot: finished("exact", pilot) for pilot in PILOTS}
        lidar = mounted(self.loaded, self.loaded.sweeps[0].sensor)
        values = {EXACT: {pilot: parting(of["path"], of["path"]) for pilot, of in exact.items()}}
        for row in self.rows:
            session = Session(self.chain.fitted(row, self.learned(row)), scene=self.scene)
            cockpit = Cockpit(session, (), 0, SEEN)
            eyes = lambda drive, cockpit=cockpit: next(iter(cockpit.see(drive).values())).layers
            sweep, values[row.name] = partial(sweep_errors, course, session, lidar), {}
            for pilot in PILOTS:
                drive = finished(row.name, pilot, eyes, sweep)
                scores = {key: value for key, value in drive.items() if key != "path"}
                values[row.name][pilot] = {**scores, **parting(drive["path"], exact[pilot]["path"])}
        return {"log": int(self.log.name), "values": values}


# ---- drives ----

Eyes = Callable[[Drive], Mapping[str, NDArray[Any]]]
"""Layers rgb, depth and classes of the first camera at a moment of a drive."""


@dataclass(frozen=True)
class Course:
    """What a drive is taken in: the exact city, its first camera and how that is mounted."""

    world: CityWorld
    camera: Camera
    mount: NDArray[np.float64]

    @classmethod
    def of(cls, world: CityWorld) -> Course:
        """The course of a generated log."""
        name = world.config.cameras[0]
        view = world.frame_views(name)[0]
        return cls(world, view.camera, geometry.invert(world.frame_pose(view.time_s)) @ view.world_from_cam)

    def begin(self) -> Drive:
        """The vehicle at the first frame, among all vehicles and people of the city."""
        world, first = self.world, self.world.frame_time(0)
        actors = {t.id: RoadUser(t.times_s, t.world_from_object, tuple(t.size_m.tolist())) for t in world.tracks()}
        ego = world.ego_path()
        speed = RoadUser(ego.times_s, ego.world_from_ego, ()).speed_at(first)
        return Drive(Road(ego.world_from_ego), actors, beginning(world.frame_pose(first), speed), first)

    def exact(self, drive: Drive) -> dict[str, NDArray[Any]]:
        """What the camera would see in the exact city."""
        truth = self.world.render(View(self.camera, drive.pose @ self.mount, drive.time_s))
        return {"rgb": truth.rgb_u8, "depth": truth.depth, "classes": truth.semantics}

    def go(self, pilot: str, eyes: Eyes) -> Iterator[tuple[Drive, Mapping[str, NDArray[Any]]]]:
        """Drive to the end of the log; at every step the drive, before it moves on, and what the pilot saw."""
        drive, step_s = self.begin(), 1 / self.world.config.rate_hz
        kind, aim_m = PILOTS[pilot]
        driver = kind(Following(drive.motion.speed_mps), aim_m)
        for _ in range(self.world.config.n_frames - 1):
            seen = eyes(drive)
            yield drive, seen
            motion, pose = drive.motion, drive.pose
            now = (drive.time_s, step_s, motion.speed_mps, motion.steer_rad, drive.road.route(pose), pose)
            drive.step(driver.drive(DriverView(*now, self.camera, self.mount, **seen)), step_s)

    def judge(self, drive: Drive) -> dict[str, Any]:
        """Where the vehicle is, what it hits, and whether a corner of it is beyond a kerb."""
        motion = drive.motion
        station, shift = drive.road.locate((motion.x_m, motion.y_m))
        beyond_m = self.world.beyond_kerb_m(drive.car.box(drive.pose).footprint())
        place = {"xy": [motion.x_m, motion.y_m], "speed_mps": motion.speed_mps, "station_m": station, "shift_m": shift}
        return {**place, "hit": drive.collision(), "off_road": bool((beyond_m > 0).any())}


def measure_drive(
    course: Course,
    pilot: str,
    eyes: Eyes | None = None,
    sweep: Callable[[Drive], dict[str, float]] | None = None,
    *,
    picture: Path | None = None,
) -> dict[str, Any]:
    """One drive: where it led, and how right its pictures were. ``eyes``: None: the exact city, whose pictures need no
    score. ``picture``: where one of them is written beside the exact one. ``sweep``: judges the LiDAR at a moment."""
    path, errors, shown, swept = [], [], [], []
    counts = torch.zeros((), dtype=torch.int64)
    for drive, seen in course.go(pilot, eyes or course.exact):
        path.append(course.judge(drive))
        if eyes is None:
            continue
        if sweep is not None and len(path) % SWEPT == 1:
            swept.append(sweep(drive))
        truth = course.exact(drive)
        shown.append((truth["rgb"], seen["rgb"]))
        both = np.isfinite(truth["depth"]) & np.isfinite(seen["depth"]) & (truth["depth"] < FAR_M)
        off = np.abs(seen["depth"][both] - truth["depth"][both]) / truth["depth"][both]
        error = (seen["rgb"].astype(np.float64) - truth["rgb"]) / 255
        errors.append({"psnr": -10 * math.log10(max(float((error**2).mean()), 1e-10)), "abs_rel": float(off.mean())})
        counts = counts + metrics.confusion(*(torch.from_numpy(of["classes"].astype(np.int64)) for of in (seen, truth)))
    if picture is not None and shown:
        store.write_image(picture, np.concatenate(shown[3 * len(shown) // 4], 1), quality=90)
    mean_of = lambda rows: {name: float(np.mean([one[name] for one in rows])) for name in (rows[0] if rows else {})}
    means = mean_of(errors) | mean_of(swept)
    if errors:
        means["miou"] = float(np.mean(list(metrics.iou_of(counts).values())))
    return {"path": path, **means}


def sweep_errors(course: Course, session: Session, lidar: MountedLidar, drive: Drive) -> dict[str, float]:
    """A sweep of the log's LiDAR where the vehicle is, against the exact city's: median error of the range in metres of
    beams that return in both, and F1 of whether beams return."""
    wanted, beams, mount = lidar
    pose = drive.pose @ mount
    (reply,) = session.render([LidarRequest(beams=beams, start=Instant(drive.time_s, pose), like=wanted.sensor)])
    count = len(beams.share)
    found = np.full(count, np.nan)
    found[reply.beam] = reply.range_m
    places, directions = np.tile(pose[:3, 3], (count, 1)), beams.directions @ pose[:3, :3].T
    true, _ = course.world.ranges(places, directions, np.full(count, drive.time_s))
    both = np.isfinite(found) & np.isfinite(true)
    either = int(np.isfinite(found).sum() + np.isfinite(true).sum())
    off = float(np.median(np.abs(found[both] - true[both]))) if both.any() else float("nan")
    return {"range_m": off, "beams_f1": 2 * int(both.sum()) / max(either, 1)}


def parting(path: Sequence[Facts], exact: Sequence[Facts]) -> dict[str, float]:
    """How far a drive is from that in the exact city, time by time, and what befell it."""
    apart = [math.dist(a["xy"], b["xy"]) for a, b in zip(path, exact, strict=True)]
    speeds = [abs(a["speed_mps"] - b["speed_mps"]) for a, b in zip(path, exact, strict=True)]
    away = {"shift_m": max(abs(at["shift_m"]) for at in path), "parting_m": float(np.mean(apart))}
    speed_off, befell = float(np.mean(speeds)), {"collisions": "hit", "departures": "off_road"}
    any_of = {name: float(any(at[key] for at in path)) for name, key in befell.items()}
    return {**away, "parted_m": apart[-1], "speed_off_mps": speed_off, **any_of}


# ---- numbers ----


def run(
    config: BenchConfig,
    out: Path,
    *,
    preset: PresetName = "default",
    overwrite: bool = False,
    rules: CityConfig = STANDARD,
) -> Path:
    """Drive in the logs of a list; returns ``out`` with ``bench.json`` and ``bench.md``. Arguments and errors as of
    ``shift.run``."""
    if config.methods == BenchConfig().methods:
        config = replace(config, methods=(BASE, FULL))
    rows, out = method_rows(config, preset), Path(out)
    without = [row.name for row in rows if row.fit is None or row.name == MIXED]
    if without:
        raise UsageError("nobody can drive in this row: it is no scene", where="--methods", got=", ".join(without))
    refuse("loop", config, preset, rows, out)
    shifts_m = [d * side for d in (2.0, 3.0, 4.0) for side in (1, -1)]
    table = PaperTable(name="loop", places=[PaperPlace(name="off", title="", shifts_m=shifts_m)], columns=[])
    last = (config, score_settings(config, table), overwrite, "synthesize")
    logs = listed_cities(config.list, config.logs, rules)
    jobs = {log.name: LoopLog(log, out / log.name, table, rows, *last).measure for log in logs}
    how = {"frames": rules.n_frames, "size_px": [rules.width, rules.height]}
    how |= {"aims_m": {name: aim_m for name, (_, aim_m) in PILOTS.items()}}
    settings = settings_of(config, preset, {"list": config.list}, how)
    names = [EXACT, *(row.name for row in rows)]
    filled = lambda logs: {"schema": 1, "bench": "loop", "settings": settings, "rows": names, **pooled(names, logs)}
    return compare(out, jobs, config, filled, markdown)


def pooled(names: Sequence[str], logs: Sequence[Facts]) -> dict[str, Any]:
    """The logs, and for every row and column the mean over logs and pilots with the standard error over logs."""
    means: dict[str, Any] = {}
    for name in names:
        per_log = [list(entry["values"][name].values()) for entry in logs]
        means[name] = {}
        for column in COLUMNS:
            values = [float(np.mean([drive[column] for drive in drives])) for drives in per_log if column in drives[0]]
            if values:
                means[name][column] = {"mean": float(np.mean(values)), "standard_error": standard_error(mean, values)}
    return {"logs": list(logs), "pooled": means}


def markdown(doc: Facts) -> str:
    """The tables for people."""
    settings, names = doc["settings"], doc["rows"]
    heads = ["row", *(title for title, _ in COLUMNS.values())]
    rows = [[name, *_cells({c: of["mean"] for c, of in doc["pooled"][name].items()})] for name in names]
    drives = [(log["log"], name, *one) for log in doc["logs"] for name in names for one in log["values"][name].items()]
    each = [[str(log), name, pilot, *_cells(drive)] for log, name, pilot, drive in drives]
    title = f"# Closed loop: {len(doc['logs'])} logs of the {settings['list']} list"
    about = (
        f"{settings['frames']} frames at 10 Hz; two pilots aim 3 m to the left and right of the recorded path, two pull"
        " over to the edges of the road that they see; all keep their distance to whoever they see. Pictures are scored"
        " at the poses driven to; apart: from the drive of the same pilot in the exact city."
    )
    all_drives = markdown_table(["log", "row", "pilot", *heads[1:]], each)
    return "\n".join([title, "", about, "", *markdown_table(heads, rows), "", "## Each drive", "", *all_drives, ""])


def _cells(values: Facts) -> list[str]:
    return [f"{values[c]:.{digits}f}" if c in values else "" for c, (_, digits) in COLUMNS.items()]
