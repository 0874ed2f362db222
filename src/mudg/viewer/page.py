"""The viewer page as files: one HTML file that works without a network, or the page and its data in a folder for a web
server."""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any, Final

import numpy as np
import torch
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial import KDTree

from mudg.base import geometry, html, palette, seeds, store
from mudg.base.errors import UsageError
from mudg.base.types import Camera, CameraColors, Frame, Scene
from mudg.baselines.bezier import BezierNode
from mudg.baselines.omnire import DeformedNode
from mudg.baselines.pvg import VibrationNode
from mudg.baselines.s3gaussian import HexPlaneNode
from mudg.core.edit import HeightMap
from mudg.core.pictures import depth_colors, resize_area
from mudg.core.weather.air import FLAKE_EDGES_MM, RAIN_EDGES_MM
from mudg.editing.apply import SEED, spread
from mudg.formats.splats import binary
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import DeformableNode, RigidNode
from mudg.gaussians.start import SH_C0
from mudg.scene.read import read_image, read_points
from mudg.viewer.report import FAR_M, NEAR_M

# -- chunks ----------------------------------------------------------------------------------------
#
# Which Gaussians a page keeps, and how they are cut into chunks, so that the first one alone is a coarse picture of the
# whole scene. The Gaussians are ranked by what they cover in the recorded views. Chunk 0 holds the first `CHUNK` of
# them, from everywhere in the scene, the two chunks after it the next 2 `CHUNK`, then 4, 8, ...: one level of detail
# after another, each as large as all before it and one chunk more. Within a level the rows are ordered by node, within
# a node along a Morton curve, and cut into chunks: each is a region, and a page fetches those near its camera first.
# Every chunk is full except for the last. A scene of at most `SMALL` chunks is cut into halves of chunks, because its
# first picture, of one chunk, comes sooner that way.
CHUNK: Final = 65_536
"""Gaussians per chunk."""
SMALL: Final = 2
"""Chunks of a scene whose chunks are half as large."""
MOST_CHUNKS: Final = 256
"""A chunk is a layer of a texture array; WebGL2 promises this many."""
ALPHA_MIN: Final = 1 / 255
"""The rasterizer draws no Gaussian below it."""
MOVING_M: Final = 10.0
"""What moves counts as this far from the cameras."""
_SLICE: Final = 1 << 18
"""Rows that are worked on at once; bounds what is held beside the scene."""


@dataclass(frozen=True, slots=True)
class Layout:
    """The rows of a page. ``rows``: of the scene, in the order of the page, intp[n]. ``size``: rows per chunk.
    ``given``: rows of the scene. ``visible``: of these, rows that can be drawn. ``lost``: what was left out for the
    budget covers this share of what all of them cover, 0 to 1."""

    rows: NDArray[np.intp]
    size: int
    given: int
    visible: int
    lost: float

    def __len__(self) -> int:
        return -(-len(self.rows) // self.size)

    def chunk(self, index: int) -> NDArray[np.intp]:
        """Rows of a chunk."""
        return self.rows[index * self.size : (index + 1) * self.size]


def level_of(chunk: int) -> int:
    """Level of detail of a chunk: 0, 1, 1, 2, 2, 2, 2, 3, ..."""
    return (chunk + 1).bit_length() - 1


def lay_out(
    columns: Mapping[str, NDArray[Any]],
    node: NDArray[np.integer],
    path: NDArray[np.floating] | None,
    most: int = 0,
    size: int = CHUNK,
) -> Layout:
    """Choose and order rows. ``columns``: of the scene's table. ``node``: of each row. ``path``: positions of the
    cameras f64[m, 3]. ``most``: rows to keep (0 = all that can be drawn). ``size``: rows per chunk of a scene that is
    not small. UsageError: more rows than a page can hold."""
    rows = np.flatnonzero(opacity_of(columns["logits"]) >= ALPHA_MIN)
    visible, lost = len(rows), 0.0
    worth = coverage(columns, node, path)[rows]
    ranks = np.argsort(-worth, kind="stable")
    if most and visible > most:
        lost = float(worth[ranks[most:]].sum() / max(worth.sum(), 1e-300))
        ranks = ranks[:most]
    if len(ranks) > MOST_CHUNKS * size:
        what, expected = "more Gaussians than a page can hold", f"at most {MOST_CHUNKS * size:,}"
        remedy = "set --budget to keep those that cover most"
        raise UsageError(what, where="--budget", got=f"{len(ranks):,}", expected=expected, remedy=remedy)
    rows = rows[ranks]
    size = max(1, size // 2) if len(rows) <= SMALL * size else size
    level = np.repeat([np.int8(level_of(k)) for k in range(-(-len(rows) // size))], size)[: len(rows)]
    order = np.lexsort((morton_codes(columns["means"], node, rows), node[rows], level))
    return Layout(rows[order], size, len(node), visible, lost)


def opacity_of(logits: NDArray[np.floating]) -> NDArray[np.float64]:
    """Opacities between 0 and 1."""
    return 1 / (1 + np.exp(-logits.astype(np.float64)))


def _slices(count: int) -> Iterator[slice]:
    for start in range(0, count, _SLICE):
        yield slice(start, min(count, start + _SLICE))


def coverage(
    columns: Mapping[str, NDArray[Any]], node: NDArray[np.integer], path: NDArray[np.floating] | None
) -> NDArray[np.float64]:
    """Opacity times the area that each Gaussian covers in an image taken where the path is nearest: f64[n], square
    radians."""
    tree = KDTree(path) if path is not None and len(path) else None
    found = np.empty(len(node))
    for part in _slices(len(node)):
        two = np.sort(columns["log_scales"][part], 1)[:, 1:].sum(1).astype(np.float64)
        distance2 = np.full(len(two), MOVING_M**2)
        still = node[part] == 0
        if tree is not None and still.any():
            distance2[still] = tree.query(columns["means"][part][still])[0] ** 2
        found[part] = opacity_of(columns["logits"][part]) * np.exp(two) / np.maximum(distance2, 1.0)
    return found


def morton_codes(
    means: NDArray[np.floating], node: NDArray[np.integer], rows: NDArray[np.integer]
) -> NDArray[np.uint64]:
    """Places of rows along a space-filling curve through each node's own box: u64[rows], 16 bits per axis."""
    codes = np.zeros(len(rows), np.uint64)
    for one in np.unique(node[rows]):
        own = np.flatnonzero(node[rows] == one)
        low, high = means[rows[own]].min(0), means[rows[own]].max(0)
        for part in _slices(len(own)):
            here = own[part]
            cells = ((means[rows[here]] - low) / np.maximum(high - low, 1e-9) * 65535).astype(np.uint64)
            for axis in range(3):
                codes[here] |= binary.with_gaps(cells[:, axis]) << np.uint64(axis)
    return codes


# -- packed ----------------------------------------------------------------------------------------
#
# A fitted scene as few bytes as a browser needs to draw it: quantised per block of neighbours, laid out as planes, a
# blob per chunk, whose rows are cut into blocks of at most `BLOCK` rows of one node. Sections of a chunk's blob
# (little-endian; every one starts at a multiple of 4; n rows, b blocks):
#
#     block     f32[b, 12]   least position [3], step [3]; least natural logarithm of the scale [3], step [3]
#     block_of  u32[b, 2]    node and rows of each block
#     position  u8[6, n]     x y z low bytes, then x y z high bytes: least + value * step, metres, frame of the node
#     scale     u8[3, n]     least + value * step, natural logarithm of metres
#     rotation  u8[4, n]     bytes of a u32: the three smaller parts of the unit quaternion (w x y z) as 10 bits each,
#                            offset 512, and in the highest two bits which part is left out; it is positive
#     color     u8[4, n]     r - g, g, b - g of the constant band (modulo 256: most surfaces are nearly grey, so this
#                            compresses better); r g b are between ``color_low`` and ``color_high``; opacity of 255
#     class     u8[2, n]     channel of the likeliest class (255: none), and its lead over the second in `LEAD_STEP`
#     certainty u8[n]        of 255 (only if it was measured)
#     harmonics u8[3 (K - 1), n]   further bands, (value - 128) * ``harmonic_step`` (only above degree 0)
#
# and of the blob that belongs to all chunks: sky u8[rows, 2 rows, 3], panorama between 0 and 1 (only if there is one);
# keys and deform: see ``motion_sections``.

BLOCK: Final = 256
LEAD_STEP: Final = 0.1
"""Of class logits; a lead beyond 25.5 is cut."""
PLACE_STEP_M: Final = 0.0005
SCALE_STEP: Final = 0.01
"""Finest steps of places, metres, and of logarithms of scales."""
DEFORM_STEP_M: Final = 1e-4
"""Of displacements of what deforms; beyond 3.2 m they are cut."""
SAMPLE: Final = 100_000
"""Rows, evenly spread, that tell the step of further bands."""
COLOR_LIMITS: Final = (-0.5, 2.0)
"""Colours of Gaussians beyond these are cut; a Gaussian may be darker than black or brighter than white where others
cover it."""

Sections = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Packed:
    """A scene for the page; its chunks are made one at a time. ``model``: the scene, on the CPU. ``layout``: which
    Gaussians of it are on the page. ``sections``: what belongs to all chunks, see the module's docstring. ``facts``:
    JSON values that describe everything. ``notes``: sentences about what the page shows differently from the
    rasterizer."""

    model: SceneModel
    layout: Layout
    sections: Sections
    facts: dict[str, Any]
    notes: tuple[str, ...]

    @property
    def kept(self) -> int:
        """Gaussians on the page."""
        return len(self.layout.rows)

    def chunk(self, index: int) -> tuple[Sections, dict[str, Any]]:
        """Sections of a chunk, and its record: rows, level, box of what stands still (None: nothing does), whether
        something moves."""
        rows, columns, facts = self.layout.chunk(index), _columns(self.model), self.facts
        node = self.model.table.labels["node"].numpy()[rows].astype(np.int64)
        blocks = []
        for one in np.unique(node):  # rows are ordered by node
            own = np.flatnonzero(node == one)
            blocks += [(int(one), own[start : start + BLOCK]) for start in range(0, len(own), BLOCK)]
        owners = np.array([(one, len(own)) for one, own in blocks], np.uint32)
        sections = _geometry(columns, rows, [own for _, own in blocks]) | {"block_of": owners}
        shown = columns["sh_dc"][rows, 0] * SH_C0 + 0.5 - facts["color_low"]
        red, green, blue = to_u8(shown / (facts["color_high"] - facts["color_low"])).T
        opacity = to_u8(opacity_of(columns["logits"][rows]))
        sections["color"] = np.stack([red - green, green, blue - green, opacity])
        logits = columns.get("semantics")
        sections["class"] = np.full((2, len(rows)), [[255], [0]], np.uint8)
        if logits is not None and logits.shape[1] > 1:
            best = np.partition(logits[rows], -2, axis=1)[:, -2:]
            lead = np.clip(np.rint((best[:, 1] - best[:, 0]) / LEAD_STEP), 1, 255)
            sections["class"] = np.stack([logits[rows].argmax(1), lead]).astype(np.uint8)
        if self.model.certainty is not None:
            sections["certainty"] = to_u8(self.model.certainty[torch.from_numpy(rows)].float().numpy())
        if self.model.sh_degree:
            levels = np.rint(columns["sh_rest"][rows].reshape(len(rows), -1) / facts["harmonic_step"])
            sections["harmonics"] = (np.clip(levels, -127, 127) + 128).astype(np.uint8).T.copy()
        still = columns["means"][rows[node == 0]]
        box = [[round(float(v), 3) for v in corner] for corner in (still.min(0), still.max(0))] if len(still) else None
        return sections, {"rows": len(rows), "level": level_of(index), "box": box, "moves": bool((node != 0).any())}


def pack_scene(
    model: SceneModel, begin_s: float, path: NDArray[np.floating] | None = None, most: int = 0, chunk_rows: int = CHUNK
) -> Packed:
    """Prepare a fitted scene for the page. ``model``: on the CPU. ``begin_s``: time that becomes 0 in all sections,
    seconds. ``path``: positions of the cameras f64[m, 3]; which Gaussians are worth keeping depends on how near they
    are. ``most``: number of Gaussians to keep (0 = all that can be drawn). ``chunk_rows``: Gaussians per chunk.
    UsageError: more Gaussians than a page can hold."""
    columns = _columns(model)
    layout = lay_out(columns, model.table.labels["node"].numpy(), path, most, chunk_rows)
    low, high = 0.0, 1.0  # between which colours the page tells levels apart
    for index in range(len(layout)):
        rgb = columns["sh_dc"][layout.chunk(index), 0] * SH_C0 + 0.5
        low, high = min(low, float(rgb.min())), max(high, float(rgb.max()))
    low = max(low, COLOR_LIMITS[0]) if model.sh_degree else 0.0  # without further bands what is below 0 is drawn as 0
    high = min(high, COLOR_LIMITS[1])
    nodes, moving = motion_sections(model, begin_s)
    facts: dict[str, Any] = {
        "rows": len(layout.rows),
        "chunk_rows": layout.size,
        "degree": model.sh_degree,
        "classes": list(model.classes),
        "lead_step": LEAD_STEP,
        "color_low": low,
        "color_high": high,
        "certainty": model.certainty is not None,
        "antialias": bool(model.facts.get("drawing", {}).get("antialias", False)),
        "nodes": nodes,
        "deform_step": DEFORM_STEP_M,
    }
    if model.sh_degree:
        # nearly all values lie within 127 steps
        some = columns["sh_rest"][layout.rows[:: max(1, -(-len(layout.rows) // SAMPLE))]]
        facts["harmonic_step"] = max(float(np.percentile(np.abs(some), 99.95)) if some.size else 0.0, 1e-6) / 127
    if model.sky is not None:
        panorama = model.sky.table["panorama"].detach()[0].numpy()
        moving["sky"] = to_u8(panorama.transpose(1, 2, 0))
        facts["sky_rows"] = model.sky.rows
    notes = []
    if any(isinstance(node, (VibrationNode, HexPlaneNode, DeformedNode, BezierNode)) for node in model.nodes):
        rest = "The page shows them at rest; boxes still carry them."
        notes.append(f"Gaussians of this method change on their own with time. {rest}")
    return Packed(model, layout, moving, facts, tuple(notes))


def _columns(model: SceneModel) -> dict[str, NDArray[Any]]:
    """The table's columns, without copies."""
    return {name: value.detach().float().numpy() for name, value in model.table.columns.items()}


def _geometry(columns: Mapping[str, Any], rows: Any, blocks: Sequence[Any]) -> Sections:
    means, scales = columns["means"][rows].astype(np.float64), columns["log_scales"][rows].astype(np.float64)
    places, sizes = np.zeros((len(rows), 3), np.uint16), np.zeros((len(rows), 3), np.uint8)
    bounds = np.zeros((len(blocks), 12), np.float32)
    for index, own in enumerate(blocks):
        bounds[index, :3], bounds[index, 3:6], places[own] = _quantised(means[own], 65535, PLACE_STEP_M)
        bounds[index, 6:9], bounds[index, 9:], sizes[own] = _quantised(scales[own], 255, SCALE_STEP)
    bytes_of = np.concatenate([(places & 255).T, (places >> 8).T]).astype(np.uint8)
    turns = packed_turns(columns["quats"][rows])
    rotation = turns.view(np.uint8).reshape(-1, 4).T.copy()
    return {"block": bounds, "position": bytes_of, "scale": sizes.T.copy(), "rotation": rotation}


def _quantised(values: NDArray[np.float64], levels: int, least_step: float) -> tuple[Any, Any, Any]:
    """Least value, step (both as f32 holds them) and levels, per column. Few levels leave high bytes that compress
    well."""
    low = values.min(0).astype(np.float32)
    step = np.maximum((values.max(0) - low) / levels, least_step).astype(np.float32)
    return low, step, np.clip(np.rint((values - low) / step), 0, levels).astype(np.uint16 if levels > 255 else np.uint8)


def packed_turns(quats: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Quaternions [n, 4] (w x y z, any length) as u32[n]."""
    largest, others = binary.smallest_three(quats)
    level = (np.clip(np.rint(others * np.sqrt(2) * 511), -511, 511) + 512).astype(np.uint32)
    return level[:, 0] | level[:, 1] << 10 | level[:, 2] << 20 | largest.astype(np.uint32) << 30


def to_u8(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Values in [0, 1] as u8; what lies outside is cut."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


# -- motion ----------------------------------------------------------------------------------------
def motion_sections(model: SceneModel, begin_s: float) -> tuple[list[dict[str, Any]], Sections]:
    """What carries the rows of each node: one record per node (name, kind, label, size_m, ``keys``: first row and
    number of its keys in section "keys", ``grid``: first value and cells of its displacements in "deform"), and the
    sections: ``keys`` f32[k, 8] (time since ``begin_s``, position, quaternion w x y z, world from box), ``deform``
    i16[...] as [key, xyz, z, y, x] per deformable node, in `DEFORM_STEP_M`."""
    records, keys, grids = [], [np.zeros((0, 8), np.float32)], [np.zeros(0, np.int16)]
    for node in model.nodes:
        record: dict[str, Any] = {"name": node.name, "kind": node.kind}
        if isinstance(node, RigidNode):
            size_m, keyed = [round(float(v), 4) for v in node.size_m], [sum(map(len, keys)), len(node.times_s)]
            record |= {"label": node.label, "size_m": size_m, "keys": keyed}
            keys.append(key_rows(node.times_s - begin_s, node.corrected_keys()))
            if isinstance(node, DeformableNode):
                grid = node.offsets["deform"].detach().float().numpy()
                record["grid"] = [sum(map(len, grids)), list(grid.shape)]
                grids.append(np.clip(np.rint(grid.reshape(-1) / DEFORM_STEP_M), -32767, 32767).astype(np.int16))
        records.append(record)
    return records, {"keys": np.concatenate(keys), "deform": np.concatenate(grids)}


def key_rows(times_s: NDArray[np.floating], poses: NDArray[np.float64]) -> NDArray[np.float32]:
    """Poses [k, 4, 4] at times as f32[k, 8]: time, position, quaternion (w x y z)."""
    turns = np.array([geometry.quaternion_from_matrix(pose) for pose in poses]).reshape(-1, 4)
    return np.column_stack([np.asarray(times_s), poses[:, :3, 3], turns]).astype(np.float32)


# -- the blob --------------------------------------------------------------------------------------
def blob_of(sections: Mapping[str, NDArray[Any]]) -> tuple[bytes, dict[str, list[Any]]]:
    """All sections behind one another, and the directory: name -> offset in bytes, type, number of values."""
    parts, directory, at = [], {}, 0
    for name, values in sections.items():
        content = np.ascontiguousarray(values).tobytes()
        directory[name] = [at, values.dtype.str.lstrip("<|="), int(values.size)]
        padded = content + b"\0" * (-len(content) % 4)
        parts.append(padded)
        at += len(padded)
    return b"".join(parts), directory


# -- facts -----------------------------------------------------------------------------------------
#
# What the viewer page knows about a log besides Gaussians: cameras, frames with small images, boxes, the vehicle's
# path, LiDAR points. Times on the page are seconds since the first frame. Sections of the log's blob: ``keys`` f32[k,
# 8], ``lidar`` u16[3, m], places in the world as ``lidar_low + value * lidar_step``, ``ground`` u16[x, y] (see
# ``PageFacts.with_ground``).
WEBP_QUALITY: Final = 50
REACH_M: Final = 80.0
MOST_CELLS: Final = 4_000_000
MOST_POINTS: Final = 20_000
"""LiDAR points on a page, taken evenly from all sweeps."""
LEAST_STEP_M: Final = 5e-4
"""Of heights of the ground; ten times that of LiDAR points."""
UNKNOWN: Final = 65535
"""Level of the ground where its height is not known."""


@dataclass(frozen=True, slots=True)
class PageFacts:
    """The log for the page. ``facts``: JSON values. ``sections``: see the module's docstring. ``images``: all WebP
    files behind one another."""

    facts: dict[str, Any]
    sections: Sections
    images: bytes

    def with_ground(self, ground: HeightMap | None) -> PageFacts:
        """With heights of the ground, for objects that are moved on it; without them where they are not known or too
        many. Section ``ground``: world z as ``low + value * step``, steps of `LEAST_STEP_M`, larger where heights span
        more than 33 m; `UNKNOWN` where it is not known."""
        heights = np.zeros((0, 0)) if ground is None else ground.heights
        if ground is None or heights.size > MOST_CELLS or min(heights.shape) < 2 or not np.isfinite(heights).any():
            return replace(self, facts=self.facts | {"ground": None})
        low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
        step = max((high - low) / (UNKNOWN - 1), LEAST_STEP_M)
        levels = np.where(np.isfinite(heights), np.rint((heights - low) / step), UNKNOWN).astype(np.uint16)
        record = {"origin": ground.origin.tolist(), "cell_m": ground.cell_m, "shape": list(levels.shape)}
        facts = self.facts | {"ground": {**record, "low": low, "step": step}}
        return replace(self, facts=facts, sections=self.sections | {"ground": levels})


def begin_of(scene: Scene) -> float:
    """Time of the first frame, seconds; 0 on the page."""
    return min(frame.view.time_s for frame in scene.frames)


def log_facts(scene: Scene, colors: CameraColors, image_width: int, most_images: int) -> PageFacts:
    """Everything but the Gaussians. ``scene``: the log. ``colors``: of the fit. ``image_width``: of recorded images on
    the page, pixels. ``most_images``: how many images the page may hold; taken evenly."""
    begin = begin_of(scene)
    frames = sorted(scene.frames, key=lambda frame: (frame.view.camera.name, frame.view.time_s))
    keys, tracks = [key_rows(scene.ego.times_s - begin, scene.ego.world_from_ego)], []
    for track in scene.tracks:
        first = sum(map(len, keys))
        size_m = track.size_m.tolist()
        tracks.append({"id": track.id, "label": track.label, "size_m": size_m, "keys": [first, len(track.times_s)]})
        keys.append(key_rows(track.times_s - begin, track.world_from_object))
    places, images = _images(scene, frames, image_width, most_images)
    sweeps, points = _lidar(scene, begin)
    ramp = depth_colors(np.geomspace(NEAR_M, FAR_M, 256).astype(np.float32)[None], NEAR_M, FAR_M)[0].tolist()
    # random drops and flakes are those of a render
    particles = {
        name: [seeds.key(SEED, index, purpose) & 0x7FFFFFFF for index in range(len(edges) - 1)]
        for name, purpose, edges in (("rain", "rain", RAIN_EDGES_MM), ("snow", "flakes", FLAKE_EDGES_MM))
    }
    facts = {
        "title": scene.id,
        "end_s": max(frame.view.time_s for frame in frames) - begin,
        "begin_s": begin,
        "cameras": {name: _camera(camera, colors) for name, camera in scene.cameras.items()},
        "frames": [
            {
                "id": frame.id,
                "camera": frame.view.camera.name,
                "t": round(frame.view.time_s - begin, 6),
                "image": place,
                "split": scene.split.get(frame.id, "train"),
                "pose": np.round(frame.view.world_from_cam[:3], 7).ravel().tolist(),
            }
            for frame, place in zip(frames, places)
        ],
        "ego_keys": [0, len(scene.ego.times_s)],
        "tracks": tracks,
        **sweeps,
        "images": {"count": sum(p is not None for p in places)},
        "class_names": list(palette.CLASSES),
        "class_colors": palette.DISPLAY_COLORS.tolist(),
        "depth_range_m": [NEAR_M, FAR_M],
        "depth_colors": ramp,
        "particle_keys": particles,
    }
    return PageFacts(facts, {"keys": np.concatenate(keys), "lidar": points}, images)


def _camera(camera: Camera, colors: CameraColors) -> dict[str, Any]:
    known = colors.to_common.get(camera.name)
    shown = None if known is None else known.inverse()
    sizes = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    gain, offset = ([1, 1, 1], [0, 0, 0]) if shown is None else (list(shown.gain), list(shown.offset))
    return {**sizes, "gain": gain, "offset": offset}


def _images(scene: Scene, frames: Sequence[Frame], width: int, most: int) -> tuple[list[list[int] | None], bytes]:
    """Place [offset, length] of every frame's image, None where it has none, and the files."""
    chosen = {frame.id for frame in spread(frames, most)}
    places, parts, at = [], [], 0
    for frame in frames:
        if frame.id not in chosen:
            places.append(None)
            continue
        rgb = read_image(scene, frame)
        wide = min(width, rgb.shape[1])
        content = io.BytesIO()
        small = resize_area(rgb, wide, max(1, round(rgb.shape[0] * wide / rgb.shape[1])))
        Image.fromarray(small).save(content, "WEBP", quality=WEBP_QUALITY, method=4)
        parts.append(content.getvalue())
        places.append([at, len(parts[-1])])
        at += len(parts[-1])
    return places, b"".join(parts)


def _lidar(scene: Scene, begin: float) -> tuple[dict[str, Any], NDArray[np.uint16]]:
    """Records of the sweeps, and their points in the world, evenly thinned."""
    clouds, records, first = [np.zeros((0, 3))], [], 0
    share = max(1, MOST_POINTS // max(1, len(scene.sweeps)))
    for sweep in scene.sweeps:
        xyz = read_points(scene, sweep).xyz
        xyz = xyz[np.square(xyz).sum(1) < REACH_M**2]
        xyz = xyz[:: max(1, -(-len(xyz) // share))].astype(np.float64)
        clouds.append(xyz @ sweep.world_from_lidar[:3, :3].T + sweep.world_from_lidar[:3, 3])
        records.append({"t": round(sweep.time_s - begin, 6), "first": first, "count": len(xyz)})
        first += len(xyz)
    points = np.concatenate(clouds)
    low = points.min(0) if len(points) else np.zeros(3)
    step = np.maximum((points.max(0) - low if len(points) else np.ones(3)) / 65535, 10 * LEAST_STEP_M)
    levels = np.ascontiguousarray(np.rint((points - low) / step).astype(np.uint16).T)
    return {"lidar": records, "lidar_low": low.tolist(), "lidar_step": step.tolist()}, levels


# -- the page --------------------------------------------------------------------------------------
ONE_FILE_BYTES: Final = 32 * 2**20
"""A page larger than this becomes a folder: not every browser opens larger ones."""


@dataclass(frozen=True, slots=True)
class PageFile:
    """One data file of a page, gzipped where that helps. ``name``: of the element that holds it in a page of one file.
    ``content``: bytes."""

    name: str
    content: bytes

    @property
    def url(self) -> str:
        """Name of the file beside the page. It changes with the content: no store of old answers can mix two pages."""
        return f"{self.name}-{hashlib.sha256(self.content).hexdigest()[:8]}.bin"

    def record(self) -> dict[str, Any]:
        """How the page finds and checks the file."""
        digest = base64.b64encode(hashlib.sha256(self.content).digest()).decode()
        return {"name": self.name, "url": self.url, "bytes": len(self.content), "sha256": digest}


@dataclass(frozen=True, slots=True)
class ViewerPage:
    """What is to be written. ``title``, ``subtitle``, ``about``: texts. ``report``: relative address of the report, or
    empty. ``scenes``: (name, scene), the one that is shown first; at most two. ``log``: everything else. ``live``:
    settings of a server behind the page, or None."""

    title: str
    subtitle: str
    about: str
    report: str
    scenes: Sequence[tuple[str, Packed]]
    log: PageFacts
    live: Mapping[str, Any] | None = None

    def files(self, facts: dict[str, Any]) -> Iterator[PageFile]:
        """The data files, made one at a time; `facts` becomes what the page says about them and is complete after the
        last one."""
        facts |= self.log.facts | {"live": None if self.live is None else dict(self.live), "scenes": []}
        made = PageFile("images", self.log.images)
        facts["images"] = facts["images"] | {"file": made.record()}
        yield made
        made, facts["log"] = self._file("log", self.log.sections)
        yield made
        for index, (name, packed) in enumerate(self.scenes):
            made, record = self._file(f"scene-{index}", packed.sections)
            scene = {"name": name, **packed.facts, **record, "chunks": []}
            facts["scenes"].append(scene)
            yield made
            for number in range(len(packed.layout)):
                sections, about = packed.chunk(number)
                made, record = self._file(f"scene-{index}-{number:03d}", sections)
                scene["chunks"].append(record | about)
                yield made

    def _file(self, name: str, sections: Sections) -> tuple[PageFile, dict[str, Any]]:
        blob, directory = blob_of(sections)
        effort = 9 if self.live is None else 1  # nothing leaves this machine
        made = PageFile(name, gzip.compress(blob, effort, mtime=0))
        return made, {"file": made.record(), "directory": directory}

    def one_file(self, files: Iterable[PageFile], facts: Mapping[str, Any]) -> bytes:
        """The page with all data in it."""
        inside = [(file.name, base64.b64encode(file.content).decode()) for file in files]
        return self.html(facts, sum(3 * len(text) // 4 for _, text in inside), inside)

    def html(self, facts: Mapping[str, Any], size: int, inside: Sequence[tuple[str, str]] = ()) -> bytes:
        """The page. size: bytes of all data. inside: (name, base64) of the data that stand in it."""
        near, far = facts["depth_range_m"]
        imports, entry = import_map(), 'import "mudg/main";'
        text = html.render(
            "viewer.html.j2",
            title=self.title,
            subtitle=self.subtitle,
            about=self.about,
            report=self.report,
            css=Markup(asset("viewer.css")),  # noqa: S704
            import_map=Markup(imports),  # noqa: S704
            policy=policy(imports, entry),
            size=f"{size / 1e6:.1f} MB",
            near=f"{near:g}",
            far=f"{far:g}",
            class_legend=html.class_legend(),
            notes=[note for _, packed in self.scenes for note in packed.notes],
            payloads=inside,
            live=self.live is not None,
            facts=Markup(script_json(facts)),  # noqa: S704
            entry=Markup(entry),  # noqa: S704
        )
        return text.encode()


def asset(name: str) -> str:
    """A file of ``assets/viewer``."""
    return (files("mudg") / "assets" / "viewer" / name).read_text(encoding="utf-8")


def import_map() -> str:
    """The viewer's modules as an import map of data addresses: a page opened by double click may not load files beside
    it."""
    folder = files("mudg") / "assets" / "viewer"
    modules = sorted(file.name.removesuffix(".js") for file in folder.iterdir() if file.name.endswith(".js"))
    coded = lambda name: base64.b64encode(asset(f"{name}.js").encode()).decode()
    addresses = {f"mudg/{name}": "data:text/javascript;base64," + coded(name) for name in modules}
    return script_json({"imports": addresses})


def policy(*scripts: str) -> str:
    """A content security policy under which only these inline scripts run, and nothing is loaded from elsewhere."""
    digest = lambda text: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    hashes = " ".join(f"'sha256-{digest(text)}'" for text in scripts)
    return (
        f"default-src 'none'; script-src {hashes} data: blob:; worker-src blob:; style-src 'unsafe-inline'; img-src"
        " 'self' data: blob:; media-src blob:; connect-src 'self' data: blob:; base-uri 'none'; form-action 'none'"
    )


def script_json(value: Any) -> str:
    """JSON that may stand in a script element: nothing in it ends the element or begins a comment."""
    text = store.json_text(value, indent=None)
    for letter in "&<>\u2028\u2029":
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text
