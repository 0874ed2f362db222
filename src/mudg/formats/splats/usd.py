"""OpenUSD with ParticleField3DGaussianSplat (26.03 and later): text (.usda), or a package with the sky (.usdz).

The stage is z up in metres, a time code is a millisecond. Every object is an Xform with translation, rotation and
visibility over time; what deforms has positions over time. Quaternions are written w, x, y, z; scales in metres;
opacities 0 to 1; harmonics Gaussian by Gaussian, the constant band first.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import uuid
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from mudg.base import geometry, store
from mudg.base.errors import InputError
from mudg.base.palette import CLASSES
from mudg.base.types import Camera, Scene, View
from mudg.core.edit import HeightMap
from mudg.formats.exporters.opendrive import opendrive
from mudg.formats.ncore import MICRO, PoseKeys, shutter_type
from mudg.formats.splats import binary, ply
from mudg.formats.splats.cloud import Floats, SplatCloud, SplatNode, SplatScene, each_once
from mudg.scene.road import Road

CODES_PER_S: Final = 1000
FOCAL: Final = 24.0
SKY_FILE: Final = "sky.png"
DOME: Final = "(0.5, 0.5, 0.5, 0.5)"
"""A dome looks along its z axis at the middle of its picture, y up, x (left) at a quarter: turned to x, z and y of the
world."""
_MOST_PACKAGE: Final = (1 << 32) - 1


def to_text(scene: SplatScene, time_s: float | None = None, sky: bool = False, log: Scene | None = None) -> bytes:
    """A scene as USD text: as it is at a time, or (None) with all its motion. ``sky``: refer to the picture `SKY_FILE`
    beside it. ``log``: whose cameras are put in, with their recorded poses."""
    static = time_s is not None
    nodes = (SplatNode("scene", scene.at(time_s)),) if time_s is not None else scene.nodes
    first, last = scene.span_s
    lines = ["#usda 1.0", "(", '    defaultPrim = "World"', '    upAxis = "Z"', "    metersPerUnit = 1"]
    lines.append(f"    timeCodesPerSecond = {CODES_PER_S}")
    if not static:
        lines += [f"    startTimeCode = {first * CODES_PER_S:.9g}", f"    endTimeCode = {last * CODES_PER_S:.9g}"]
    facts = quoted(json.dumps(dict(scene.facts), allow_nan=False))
    lines += [f"    customLayerData = {{ string mudg = {facts} }}", ")", ""]
    lines += ['def Xform "World"', "{"]
    names = prim_names([node.name for node in nodes])
    for name, node in zip(names, nodes):
        lines += _indented(_node(name, node, scene.file_from_world if not static else np.eye(4)))
    names = [] if log is None else prim_names([f"camera_{name}" for name in log.cameras])
    for name, camera in zip(names, () if log is None else log.cameras.values()):
        views = [] if log is None else [frame.view for frame in log.frames_of(camera.name)]
        lines += _indented(_camera(name, camera, views, scene.file_from_world))
    if sky:
        lines += [
            '    def DomeLight "Sky"',
            "    {",
            f"        asset inputs:texture:file = @{SKY_FILE}@",
            '        token inputs:texture:format = "latlong"',
            f"        quatf xformOp:orient = {DOME}",
            '        uniform token[] xformOpOrder = ["xformOp:orient"]',
            "    }",
        ]
    return "\n".join([*lines, "}", ""]).encode()


def to_package(
    scene: SplatScene, time_s: float | None = None, log: Scene | None = None, more: Mapping[str, bytes] | None = None
) -> bytes:
    """A scene as a USDZ package: the text, the sky as a picture (zenith on top, as one looks at it), and ``more`` files
    after these. Raises InputError: more than 4 GiB, which a package cannot hold."""
    files = {"scene.usda": to_text(scene, time_s, scene.sky is not None, log)}
    if scene.sky is not None:
        files[SKY_FILE] = png(scene.sky[:, ::-1])
    files |= dict(more or {})
    size = sum(map(len, files.values()))
    if size > _MOST_PACKAGE - (1 << 20):
        what, expected = "the scene is too large for a USDZ package", "below 4 GiB"
        raise InputError(what, expected=expected, got=f"{size} bytes", remedy="choose some --nodes, or export usda")
    return binary.stored_zip(files, align=64)


def png(picture: NDArray[np.uint8]) -> bytes:
    """A picture u8[H, W, 3] as PNG."""
    target = io.BytesIO()
    Image.fromarray(picture).save(target, "PNG", optimize=False)
    return target.getvalue()


# -- prims -----------------------------------------------------------------------------------------


def _node(name: str, node: SplatNode, file_from_world: NDArray[np.float64]) -> list[str]:
    lines = [f"def Xform {quoted(name)}", "{"]
    poses = file_from_world @ node.world_from_node if node.moves else file_from_world[None]
    if node.moves or not np.array_equal(file_from_world, np.eye(4)):
        codes = node.times_s * CODES_PER_S
        lines += _indented(_poses_over_time(codes, poses))
    if node.moves:
        first, last = float(codes[0]), float(codes[-1])
        shown = {first - 1: "invisible", first: "inherited", last + 1: "invisible"}
        words = [quoted(word) for word in shown.values()]
        lines += _indented(_over_time("token visibility", np.array(list(shown)), words))
        lines.append(f"    custom string mudg:track = {quoted(node.name)}")
        lines.append(f"    custom string mudg:label = {quoted(node.label)}")
        lines.append(f"    custom float3 mudg:size = {tuples(np.array([node.size_m]))[0]}")
    lines += _indented(_splats(node))
    return [*lines, "}"]


def _camera(name: str, camera: Camera, views: Sequence[View], file_from_world: NDArray[np.float64]) -> list[str]:
    """A camera that looks along -z with y up; focal length and apertures share a unit, in which the focal length is
    `FOCAL`."""
    wide, high = camera.width / camera.fx * FOCAL, camera.height / camera.fy * FOCAL
    right, up = (camera.width / 2 - camera.cx) / camera.fx * FOCAL, (camera.cy - camera.height / 2) / camera.fy * FOCAL
    lines = [
        f"def Camera {quoted(name)}",
        "{",
        f"    float focalLength = {FOCAL:g}",
        f"    float horizontalAperture = {wide:.9g}",
        f"    float verticalAperture = {high:.9g}",
        f"    float horizontalApertureOffset = {right:.9g}",
        f"    float verticalApertureOffset = {up:.9g}",
        "    float2 clippingRange = (0.1, 10000)",
    ]
    if views:
        poses = file_from_world @ np.stack([view.world_from_cam for view in views]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        lines += _indented(_poses_over_time(np.array([view.time_s for view in views]) * CODES_PER_S, poses))
    return [*lines, f"    custom string mudg:camera = {quoted(camera.name)}", "}"]


def _splats(node: SplatNode) -> list[str]:
    cloud = node.cloud
    coefficients = cloud.sh.shape[1]
    lines = ['def ParticleField3DGaussianSplat "splats"', "{"]
    if node.displacement is None:
        lines += [f"    point3f[] positions = {array(cloud.means)}", f"    float3[] extent = {array(extent(cloud))}"]
    else:
        places = [cloud.means + moved for moved in node.displacement]
        codes = node.times_s * CODES_PER_S
        lines += _indented(_over_time("point3f[] positions", codes, [array(place) for place in places]))
        bounds = np.stack([extent(cloud, place) for place in places])
        lines.append(f"    float3[] extent = {array(np.stack([bounds[:, 0].min(0), bounds[:, 1].max(0)]))}")
    lines += [
        f"    quatf[] orientations = {array(cloud.quats)}",
        f"    float3[] scales = {array(np.exp(cloud.log_scales.astype(np.float64)))}",
        f"    float[] opacities = {array(cloud.opacity)}",
        f"    uniform int radiance:sphericalHarmonicsDegree = {cloud.degree}",
        f"    float3[] radiance:sphericalHarmonicsCoefficients = {array(cloud.sh.reshape(-1, 3))} (",
        f"        elementSize = {coefficients}",
        "    )",
        '    uniform token projectionModeHint = "perspective"',
        '    uniform token sortingModeHint = "cameraDistance"',
    ]
    if cloud.class_ids is not None:
        lines += [
            f"    int[] primvars:mudg:class = [{', '.join(map(str, cloud.class_ids.tolist()))}]",
            f"    custom token[] mudg:classes = [{', '.join(map(quoted, CLASSES))}]",
        ]
    return [*lines, "}"]


def extent(cloud: SplatCloud, means: Floats | None = None) -> Floats:
    """Lower and upper corner f32[2, 3] of what Gaussians cover, three standard deviations wide."""
    place = cloud.means if means is None else means
    if not len(cloud):
        return np.zeros((2, 3), np.float32)
    reach = 3 * np.exp(cloud.log_scales.max(1, keepdims=True).astype(np.float64))
    return np.stack([(place - reach).min(0), (place + reach).max(0)]).astype(np.float32)


# -- text ------------------------------------------------------------------------------------------


def _over_time(name: str, codes: NDArray[np.float64], values: Sequence[str]) -> list[str]:
    """An attribute with one value, or with samples over time."""
    if len(values) == 1 and len(codes) < 2:
        return [f"{name} = {values[0]}"]
    samples = (f"    {code:.9g}: {value}," for code, value in zip(codes.tolist(), values))
    return [f"{name}.timeSamples = {{", *samples, "}"]


def _poses_over_time(codes: NDArray[np.float64], poses: NDArray[np.float64]) -> list[str]:
    """The transform of a prim: translation and rotation."""
    quats = np.stack([geometry.quaternion_from_matrix(pose) for pose in poses])
    return [
        *_over_time("double3 xformOp:translate", codes, tuples(poses[:, :3, 3], 12)),
        *_over_time("quatf xformOp:orient", codes, tuples(quats)),
        'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]',
    ]


def _indented(lines: Iterable[str]) -> list[str]:
    return ["    " + line for line in lines]


def quoted(text: str) -> str:
    """A text as USD writes it, on one line."""
    return '"' + re.sub(r"[\x00-\x1f]", " ", text).replace("\\", "\\\\").replace('"', '\\"') + '"'


def array(values: NDArray[np.floating]) -> str:
    """Numbers [n] or [n, c] as an array of numbers or of tuples, 7 digits each."""
    if values.ndim == 1:
        return "[" + ", ".join(("%.7g " * len(values) % tuple(values.tolist())).split()) + "]"
    one = "(" + ", ".join(["%.7g"] * values.shape[1]) + ")"
    return "[" + ", ".join([one] * len(values)) % tuple(np.asarray(values).reshape(-1).tolist()) + "]"


def tuples(values: NDArray[np.floating], digits: int = 9) -> list[str]:
    """Rows of numbers [n, c] as tuples."""
    return ["(" + ", ".join(f"{value:.{digits}g}" for value in row) + ")" for row in values.tolist()]


def prim_names(names: Sequence[str]) -> list[str]:
    """Names that USD accepts for prims, each once."""
    plain = (re.sub(r"[^A-Za-z0-9_]", "_", name) or "node" for name in names)
    return each_once(f"_{name}" if name[0].isdigit() else name for name in plain)


# alpasim -------------------------------------------------------------------------------------------
#
# A scene as NVIDIA's AlpaSim reads it: a USDZ package (see above) with five more files, found by their names.
#
#     metadata.yaml          names, sensors, first and last microsecond
#     rig_trajectories.json  path of the vehicle, calibration of the cameras, begin and end of every image
#     sequence_tracks.json   paths, classes and sizes of the objects
#     mesh_ground.ply        the ground as triangles, facing up
#
# Times are microseconds, the first record at 1 s. World, and what NuRec calls its own frame, are the world of the file:
# z up, metres. The rig is the vehicle, x forward, y left, z up. Source: the layouts of AlpaSim's reader, of NuRec's
# writer, and of Autoware's 3dgs_io.


START_US: Final = MICRO
CONTROLLABLE: Final = "CONTROLLABLE"
STANDING: Final = "NONE"
MOVES_M: Final = 1.0
"""Objects that go no farther stand."""
NVIDIA_CLASSES: Final[Mapping[str, str]] = {
    "car": "automobile",
    "van": "automobile",
    "vehicle": "other_vehicle",
    "truck": "heavy_truck",
    "tram": "train_or_tram_car",
    "train": "train_or_tram_car",
    "pedestrian": "person",
    "cyclist": "rider",
}
"""Classes of objects as NVIDIA's recordings call them; others keep their names."""
_NO_DATE: Final = "1970-01-01"
"""The hour of writing is not noted: the same scene gives the same bytes."""


def to_alpasim(
    scene: SplatScene, log: Scene | None, ground: HeightMap | None, surface: NDArray[np.floating] | None = None
) -> bytes:
    """A scene with its motion, the drive and the ground.

    Args:
        log: the recorded drive. ground, surface: its height, and points f[N, 3] of the road, in our axes.

    Raises:
        InputError: no drive or no ground is known, or a camera has no place on the vehicle.
    """
    if log is None or not len(log.ego.times_s):
        what = "AlpaSim replays a drive, and none is known here"
        raise InputError(what, where=scene.name, remedy="give --scene SCENE, or a folder made by `mudg run`")
    if ground is None:
        what = "AlpaSim needs the ground, and none is known here"
        raise InputError(what, where=scene.name, remedy="export a folder made by `mudg run`, whose points have classes")
    clock = _PackageClock(log, scene)
    rig = store.json_text(_rig(log, scene, clock)).encode()
    files = {
        "metadata.yaml": yaml.safe_dump(_metadata(log, scene, clock, rig), sort_keys=False).encode(),
        "rig_trajectories.json": rig,
        "sequence_tracks.json": store.json_text(_tracks(scene, clock)).encode(),
        "mesh_ground.ply": ground_mesh(ground, scene.file_from_world),
    }
    if np.ptp(log.ego.world_from_ego[:, :2, 3], axis=0).max() > 2:  # a vehicle that stands tells no road
        files["map.xodr"] = _map(log, scene, surface)
    return to_package(scene, None, log, files)


def _map(log: Scene, scene: SplatScene, surface: NDArray[np.floating] | None) -> bytes:
    """The driven corridor, in the axes of the file."""
    road = Road(scene.file_from_world @ log.ego.world_from_ego)
    points = np.zeros((0, 3)) if surface is None else geometry.transform_points(scene.file_from_world, surface)
    return opendrive(road, points, log.id)


class _PackageClock:
    """Whole microseconds from the first record on, which is at ``START_US``."""

    def __init__(self, log: Scene, scene: SplatScene) -> None:
        times = [frame.view.time_s for frame in log.frames] + log.ego.times_s.tolist()
        times += [float(node.times_s[0]) for node in scene.nodes if node.moves]
        self._zero_us = START_US - round(min(times) * MICRO)

    def us(self, time_s: float) -> int:
        return round(float(time_s) * MICRO) + self._zero_us


def _spans(log: Scene, camera: Camera, clock: _PackageClock) -> list[list[int]]:
    """Begin and end of every image of a camera, in order of time; the end is later by a microsecond at least."""
    half = round(camera.readout_s * MICRO / 2)
    middles = sorted(clock.us(frame.view.time_s) for frame in log.frames_of(camera.name))
    return [[at - max(half, 1), at + half] for at in middles]


def _metadata(log: Scene, scene: SplatScene, clock: _PackageClock, rig: bytes) -> dict[str, Any]:
    digest = hashlib.sha256(rig).hexdigest()
    content = hashlib.sha256(rig)
    for node in scene.nodes:
        content.update(node.cloud.means.tobytes() + node.cloud.sh.tobytes() + node.world_from_node.tobytes())
    path = _path(log, scene, clock)
    return {
        "scene_id": log.id,
        "version_string": str(scene.facts.get("generator", "mudg")),
        "training_date": _NO_DATE,
        "dataset_hash": digest,
        "uuid": str(uuid.uuid5(uuid.NAMESPACE_URL, f"mudg:{content.hexdigest()}")),
        "is_resumable": False,
        "sensors": {"camera_ids": list(log.cameras), "lidar_ids": sorted({sweep.sensor for sweep in log.sweeps})},
        "logger": {"name": "mudg", "run_id": None, "run_url": None},
        "time_range": {"start": int(path.times_us[0]), "end": int(path.times_us[-1])},
        "training_step_outputs": {},
    }


def _path(log: Scene, scene: SplatScene, clock: _PackageClock) -> PoseKeys:
    """The vehicle in the axes of the file, over the time of all images."""
    times = np.array([clock.us(time_s) for time_s in log.ego.times_s], np.int64)
    kept = np.r_[True, np.diff(times) > 0]
    spans = [span for camera in log.cameras.values() for span in _spans(log, camera, clock)]
    poses = PoseKeys(times[kept], scene.file_from_world @ log.ego.world_from_ego[kept])
    return poses.covering(min(begin for begin, _ in spans), max(end for _, end in spans)) if spans else poses


def _rig(log: Scene, scene: SplatScene, clock: _PackageClock) -> dict[str, Any]:
    path = _path(log, scene, clock)
    cameras = {f"{name}@{log.id}": camera for name, camera in log.cameras.items()}
    trajectory = {
        "sequence_id": log.id,
        "rig_bbox": None,
        "T_rig_world_timestamps_us": path.times_us.tolist(),
        "T_rig_worlds": path.poses.tolist(),
        "cameras_frame_timestamps_us": {unique: _spans(log, camera, clock) for unique, camera in cameras.items()},
        "lidars_frame_timestamps_us": {},
    }
    calibrations = {
        unique: {
            "sequence_id": log.id,
            "logical_sensor_name": camera.name,
            "unique_sensor_idx": index,
            "T_sensor_rig": _mount(log, camera).tolist(),
            "camera_model": {"type": "opencv-pinhole", "parameters": intrinsics(camera)},
        }
        for index, (unique, camera) in enumerate(cameras.items())
    }
    return {
        "world_to_nre": {"matrix": np.eye(4).tolist()},
        "T_world_base": np.eye(4).tolist(),
        "rig_trajectories": [trajectory],
        "camera_calibrations": calibrations,
        "lidar_calibrations": {},
    }


def _mount(log: Scene, camera: Camera) -> NDArray[np.float64]:
    """Rig-from-camera f64[4, 4], as at the camera's middle image."""
    frames = log.frames_of(camera.name)
    for frame in sorted(frames, key=lambda one: abs(one.view.time_s - frames[len(frames) // 2].view.time_s)):
        ego = log.ego.pose_at(frame.view.time_s)
        if ego is not None:
            return geometry.invert(ego) @ frame.view.world_from_cam
    raise InputError("the vehicle's path covers no image of a camera", where=f"{log.id}: camera {camera.name}")


def intrinsics(camera: Camera) -> dict[str, Any]:
    """A pinhole camera as NCore tells it: principal point from the corner of the image."""
    return {
        "resolution": [camera.width, camera.height],
        "shutter_type": shutter_type(camera),
        "external_distortion_parameters": None,
        "principal_point": [camera.cx, camera.cy],
        "focal_length": [camera.fx, camera.fy],
        "radial_coeffs": [0.0] * 6,
        "tangential_coeffs": [0.0] * 2,
        "thin_prism_coeffs": [0.0] * 4,
    }


def _tracks(scene: SplatScene, clock: _PackageClock) -> dict[str, Any]:
    """Paths of the objects; one with a single key is there for no time, and is left out."""
    tracks = [node for node in scene.nodes if node.moves and len(node.times_s) > 1]
    poses = [scene.file_from_world @ node.world_from_node for node in tracks]
    moved_m = [np.linalg.norm(np.ptp(node.world_from_node[:, :3, 3], axis=0)) for node in tracks]
    turns = [[geometry.quaternion_from_matrix(pose)[[1, 2, 3, 0]].tolist() for pose in keys] for keys in poses]
    data = {
        "tracks_id": [node.name for node in tracks],
        "tracks_label_class": [NVIDIA_CLASSES.get(node.label, node.label) for node in tracks],
        "tracks_flags": [CONTROLLABLE if metres > MOVES_M else STANDING for metres in moved_m],
        "tracks_timestamps_us": [[clock.us(time_s) for time_s in node.times_s] for node in tracks],
        "tracks_poses": [
            [[*pose[:3, 3].tolist(), *turn] for pose, turn in zip(keys, quats)] for keys, quats in zip(poses, turns)
        ],
    }
    sizes = {"cuboids_dims": [list(map(float, node.size_m)) for node in tracks]}
    return {scene.name: {"tracks_data": data, "cuboidtracks_data": sizes}}


def ground_mesh(ground: HeightMap, file_from_world: NDArray[np.float64]) -> bytes:
    """The cells of a height map as triangles of a PLY file, facing up; unknown cells are holes."""
    known = np.isfinite(ground.heights)
    rows, columns = np.nonzero(known)
    xyz = np.column_stack([ground.origin + np.column_stack([rows, columns]) * ground.cell_m, ground.heights[known]])
    number = np.full(known.shape, -1, np.int64)
    number[known] = np.arange(len(xyz))
    corners = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], -1).reshape(-1, 4)
    corners = corners[(corners >= 0).all(1)]
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    table = np.empty(len(faces), [("count", "u1"), ("corner", "<i4", 3)])
    table["count"], table["corner"] = 3, faces
    corners_of = ("face", len(faces), [("list uchar int", "vertex_indices")])
    head = ply.header([("vertex", len(xyz), [("float", axis) for axis in "xyz"]), corners_of])
    return head + geometry.transform_points(file_from_world, xyz).astype("<f4").tobytes() + table.tobytes()
