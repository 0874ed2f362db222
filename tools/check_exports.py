"""Compare files of `mudg export` with the programs of others, those that are installed.

    python tools/check_exports.py RUN --out FOLDER [--node-modules FOLDER]

RUN: a fit, or the folder of a finished `mudg run`. FOLDER gets the files. Programs, each checked only where it is
found:

    npm install @playcanvas/splat-transform@2.7.1 gltf-validator@2.0.0-dev.3.10    reads and writes SPZ, SOG, ...; rules
                                                                                   of glTF
    pip install usd-core mcap rosbags                   rules of USD; messages, bags
    pip install pycolmap nvidia-ncore zstandard         cameras; recordings of NCore; SPZ of version 4

The log's formats are checked where RUN is the folder of a run.

Prints one line per file and program; the exit code is the number of failures.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from mudg.base import geometry
from mudg.base.geometry import matrix_from_quaternion
from mudg.base.types import Scene
from mudg.exporting.export import CAMERAS, SUFFIXES
from mudg.exporting.settings import ExportConfig
from mudg.formats.exporters.cameras import picture_names
from mudg.formats.exporters.ncore import package
from mudg.formats.splats.cloud import SplatCloud
from mudg.formats.splats.formats import FORMATS, read_cloud
from mudg.scene.read import read_points, read_scene
from mudg.steps.export import Export

SINGLE = ("ply", "spz", "compressed-ply", "sog", "splat")
FOREIGN = re.compile(r"'(metadata\.yaml|\w+\.json|mesh_ground\.ply|map\.xodr)' in package .* unsupported extension")
"""What USD says of the files for AlpaSim in a package, which the standard does not allow there."""
AHEAD = np.random.default_rng(0).uniform([-3, -2, 8], [3, 2, 40], (50, 3))
"""Points that every camera sees, in its axes, metres."""
STEP_M = {"spz": 0.001, "ply": 1e-4, "compressed-ply": 0.02, "sog": 0.02, "splat": 1e-4}
VALIDATE = """
const v = require(process.argv[1]); const fs = require('fs');
v.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])), {maxIssues: 0})
  .then(r => console.log(JSON.stringify(r.issues.messages)));
"""


def main() -> int:
    """Write and check; returns the number of failures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--node-modules", type=Path, default=Path("node_modules"))
    given = parser.parse_args()
    failures = 0
    files = written(given.run, given.out)
    tool = given.node_modules / ".bin" / "splat-transform"
    for name in (*SINGLE, "spz 4"):
        there = tool.exists() and name in files
        failures += report(
            f"{name} read by splat-transform", against_splat_transform(tool, name, files[name]) if there else None
        )
    validator = given.node_modules / "gltf-validator"
    failures += report("glb by glTF-Validator", of_gltf(validator, files["glb"]) if validator.exists() else None)
    for name in ("usda", "usdz", "alpasim"):
        failures += report(f"{name} by usd-core", of_usd(files[name]) if name in files and installed("pxr") else None)
    scene = read_scene(given.run / "scene") if (given.run / "scene").is_dir() else None
    for name, (module, check) in OF_LOGS.items():
        there = scene is not None and name in files and installed(module)
        failures += report(f"{name} by {module}", check(files[name], scene) if there and scene is not None else None)
    return failures


def installed(module: str) -> bool:
    """Whether a package is there."""
    return importlib.util.find_spec(module) is not None


def report(title: str, problem: str | None) -> int:
    """Print one line; 1 for a failure. ``None``: not checked; empty: fine."""
    print(f"{title}: {'not installed' if problem is None else problem or 'ok'}", flush=True)
    return int(bool(problem))


def written(run: Path, out: Path) -> dict[str, Path]:
    """All files of a run, one moment for formats without motion."""
    found = {}
    for name in (*SINGLE, "glb", "usda", "usdz", "alpasim", *CAMERAS, *SUFFIXES):
        suffix = FORMATS[name].suffixes[0] if name in FORMATS else SUFFIXES.get(name, "")
        of_log = name in ("alpasim", "mcap", "ros2", "ncore", *CAMERAS)
        if (of_log and not (run / "scene").is_dir()) or (name == "ncore" and not installed(name)):
            continue
        found[name] = out / f"{name}{suffix}"
        Export(format=name, source=run, out=found[name], overwrite=True, settings=ExportConfig()).run()
    return found


def against_splat_transform(tool: Path, name: str, file: Path) -> str:
    """Our reading of a file against our reading of the PLY that their program makes of it; and that it reads back what
    we wrote."""
    made = file.with_name(f"theirs_{file.stem}_{name.split()[0]}.ply")
    done = subprocess.run(
        [str(tool), "-w", "-g", "cpu", str(file), str(made)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        return f"failed: {(done.stderr or done.stdout).strip()[-200:]}"
    ours, theirs = (read_cloud(path.read_bytes(), path.name)[0] for path in (file, made))
    return difference(ours, theirs, STEP_M[name.split()[0]])


def difference(ours: SplatCloud, theirs: SplatCloud, step_m: float) -> str:
    """Where two clouds differ, or nothing."""
    if len(ours) != len(theirs):
        return f"{len(theirs)} Gaussians instead of {len(ours)}"
    apart, rows = cKDTree(theirs.means).query(ours.means, workers=1)
    matched = theirs.take(np.asarray(rows))
    found = {
        "m": float(apart.max()),
        "log size": float(np.median(np.abs(ours.log_scales - matched.log_scales))),
        "opacity": float(np.median(np.abs(ours.opacity - matched.opacity))),
        "color": float(np.median(np.abs(ours.sh[:, 0] - matched.sh[:, 0]))),
        "covariance": float(
            np.median(
                np.linalg.norm(covariances(ours) - covariances(matched), axis=(1, 2))
                / np.linalg.norm(covariances(ours), axis=(1, 2))
            )
        ),
    }
    if ours.degree:
        found["harmonics"] = float(np.median(np.abs(ours.sh[:, 1:] - matched.sh[:, 1:])))
    limits = {"harmonics": 0.05, "m": step_m, "log size": 0.01, "opacity": 0.01, "color": 0.02, "covariance": 0.05}
    return ", ".join(
        f"{key} {value:.3g} (limit {limits[key]:g})" for key, value in found.items() if value > limits[key]
    )


def covariances(cloud: SplatCloud) -> np.ndarray:
    """Of every Gaussian, f64[n, 3, 3]: equal where rotations differ by half a turn about an axis of the ellipsoid."""
    rotations = np.stack([matrix_from_quaternion(quat) for quat in cloud.quats])
    return np.einsum("nij,nj,nkj->nik", rotations, np.exp(2 * cloud.log_scales.astype(np.float64)), rotations)


def of_gltf(validator: Path, file: Path) -> str:
    """Issues but those of the extension, which the validator does not know."""
    done = subprocess.run(
        ["node", "-e", VALIDATE, str(validator.resolve()), str(file)], capture_output=True, text=True, check=True
    )
    issues = [
        issue
        for issue in json.loads(done.stdout)
        if not (issue["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and "KHR_gaussian_splatting:" in issue["pointer"])
        and issue["code"] != "UNSUPPORTED_EXTENSION"
    ]
    return "; ".join(f"{issue['code']} {issue['pointer']}" for issue in issues[:5])


def of_usd(file: Path) -> str:
    """Errors of all validators, and whether the fields of particles are what we say."""
    from pxr import Usd, UsdValidation

    stage = Usd.Stage.Open(str(file))
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    told = [error.GetMessage() for error in context.Validate(stage) if not error.HasNoError()]
    errors = [text for text in told if not (file.stem == "alpasim" and FOREIGN.search(text))]
    fields = [prim for prim in stage.Traverse() if prim.GetTypeName() == "ParticleField3DGaussianSplat"]
    if not fields or errors:
        return "; ".join(errors[:5]) or "no particle fields"
    for prim in fields:
        count = len(prim.GetAttribute("orientations").Get())
        places = prim.GetAttribute("positions")
        samples = places.GetTimeSamples()
        if len(places.Get(samples[0]) if samples else places.Get()) != count:
            return f"{prim.GetPath()}: lengths differ"
    return ""


def of_mcap(file: Path, _scene: Scene) -> str:
    """Whether every message is read, in order."""
    from mcap.reader import make_reader

    with file.open("rb") as handle:
        reader = make_reader(handle, validate_crcs=True)
        summary = reader.get_summary()
        times = [message.log_time for _, _, message in reader.iter_messages()]
    if summary is None or summary.statistics.message_count != len(times) or times != sorted(times):
        return "the messages are not those of the summary"
    return ""


def of_bag(folder: Path, _scene: Scene) -> str:
    """Whether every message is read with the types of two releases, and written again to the same bytes."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    for release in (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY):
        types, count = get_typestore(release), 0
        with Reader(folder) as reader:
            for connection, _, raw in reader.messages():
                if connection.msgtype not in types.fielddefs:  # vision_msgs: by the definition in the file
                    types.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
                value = types.deserialize_cdr(raw, connection.msgtype)
                if bytes(types.serialize_cdr(value, connection.msgtype)) != bytes(raw):
                    return f"{release.name}: {connection.topic} reads differently"
                count += 1
            if count != reader.message_count:
                return f"{release.name}: {count} messages of {reader.message_count}"
    return ""


def of_colmap(folder: Path, scene: Scene) -> str:
    """Whether every image has its pose and its pixels, and cameras are one rig."""
    import pycolmap

    found = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    if len(found.images) != len(scene.frames) or len(found.rigs) != 1:
        return f"{len(found.images)} images, {len(found.rigs)} rigs"
    views = {name: frame.view for name, frame in zip(picture_names(scene).values(), scene.frames, strict=True)}
    for image in found.images.values():
        view = views[f"images/{image.name}"]
        apart = np.abs(image.cam_from_world().matrix() - view.cam_from_world[:3]).max()
        points = geometry.transform_points(view.world_from_cam, AHEAD)
        pixels = np.array([image.project_point(point) for point in points])
        off = np.abs(pixels - geometry.project(view, points)[0]).max()
        if apart > 1e-6 or off > 1e-3:
            return f"{image.name}: pose differs by {apart:.3g}, pixels by {off:.3g}"
    return ""


def of_ncore(folder: Path, scene: Scene) -> str:
    """Whether the vendor's own projection, compensation for motion and boxes give what the scene has."""
    import torch

    parts = package()
    loader = parts.v4.SequenceLoaderV4(parts.v4.SequenceComponentGroupsReader(sorted(folder.glob("*.ncore4.json"))))
    for name, camera in scene.cameras.items():
        sensor, frames = loader.get_camera_sensor(name), scene.frames_of(name)
        model = parts.sensors.CameraModel.from_parameters(sensor.model_parameters, device="cpu", dtype=torch.float64)
        for index, frame in enumerate(frames):
            if sensor.get_frame_handle(index).get_data().get_decoded_image().size != (camera.width, camera.height):
                return f"{frame.id}: the picture has another size"
            pose = loader.pose_graph.evaluate_poses(
                "world", name, sensor.frames_timestamps_us[index].sum() // np.uint64(2)
            )
            points = geometry.transform_points(frame.view.world_from_cam, AHEAD)
            pixels = model.world_points_to_image_points_static_pose(
                points, pose, return_all_projections=True
            ).image_points
            off = np.abs(np.asarray(pixels) - geometry.project(frame.view, points)[0]).max()
            if off > 0.01:
                return f"{frame.id}: pixels differ by {off:.3g}"
    for name in sorted({sweep.sensor for sweep in scene.sweeps}):
        lidar = loader.get_lidar_sensor(name)
        for index, sweep in enumerate(one for one in scene.sweeps if one.sensor == name):
            cloud = lidar.get_frame_point_cloud(index, motion_compensation=True, with_start_points=False)
            pose = loader.pose_graph.evaluate_poses(name, "world", lidar.frames_timestamps_us[index, 1])
            found = geometry.transform_points(np.asarray(pose, np.float64), np.asarray(cloud.xyz_m_end, np.float64))
            wanted = geometry.transform_points(sweep.world_from_lidar, read_points(scene, sweep).xyz.astype(np.float64))
            if np.abs(found - wanted).max() > 1e-3:
                return f"{sweep.id}: points differ by {np.abs(found - wanted).max():.3g} m"
    boxes = {one.track_id for one in loader.get_cuboid_track_observations()}
    return "" if boxes <= {track.id for track in scene.tracks} and bool(boxes) == bool(scene.tracks) else "other boxes"


OF_LOGS = {
    "mcap": ("mcap", of_mcap),
    "ros2": ("rosbags", of_bag),
    "colmap": ("pycolmap", of_colmap),
    "ncore": ("ncore", of_ncore),
}
"""Formats of a log: the package that reads them, and how."""


if __name__ == "__main__":
    sys.exit(main())
