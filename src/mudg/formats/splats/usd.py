"""OpenUSD with ParticleField3DGaussianSplat (26.03 and later): text (.usda), or a package with the sky (.usdz). z up in
metres; a time code is a millisecond. Objects are Xforms that move over time; what deforms has positions over time.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.palette import CLASSES
from mudg.base.types import Camera, Scene, View
from mudg.formats.splats import binary
from mudg.formats.splats.cloud import Floats, SplatCloud, SplatNode, SplatScene, each_once

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
        picture = io.BytesIO()
        Image.fromarray(scene.sky[:, ::-1]).save(picture, "PNG", optimize=False)
        files[SKY_FILE] = picture.getvalue()
    files |= dict(more or {})
    size = sum(map(len, files.values()))
    if size > _MOST_PACKAGE - (1 << 20):
        what, expected = "the scene is too large for a USDZ package", "below 4 GiB"
        raise InputError(what, expected=expected, got=f"{size} bytes", remedy="choose some --nodes, or export usda")
    return binary.stored_zip(files, align=64)


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
