"""A fitted scene as few bytes as a browser needs to draw it: quantised per block of neighbours, laid out as planes, a blob per chunk.

``chunks.py`` says which rows a chunk holds. Its rows are cut into blocks of at most `BLOCK` rows of one node. Sections of its blob
(little-endian; every one starts at a multiple of 4; n rows, b blocks):

    block     f32[b, 12]   least position [3], step [3]; least natural logarithm of the scale [3], step [3]
    block_of  u32[b, 2]    node and rows of each block
    position  u8[6, n]     x y z low bytes, then x y z high bytes: least + value * step, metres, frame of the node
    scale     u8[3, n]     least + value * step, natural logarithm of metres
    rotation  u8[4, n]     bytes of a u32: the three smaller parts of the unit quaternion (w x y z) as 10 bits each, offset 512, and in
                           the highest two bits which part is left out; it is positive
    color     u8[4, n]     r - g, g, b - g of the constant band (modulo 256: most surfaces are nearly grey, so this compresses better);
                           r g b are between ``color_low`` and ``color_high``; then opacity of 255
    class     u8[2, n]     channel of the likeliest class (255: none), and its lead over the second in `LEAD_STEP`
    certainty u8[n]        of 255 (only if it was measured)
    harmonics u8[3 (K - 1), n]   further bands, (value - 128) * ``harmonic_step`` (only above degree 0)

and of the blob that belongs to all chunks:

    sky       u8[rows, 2 rows, 3]   panorama between 0 and 1 (only if there is one)
    keys, deform: see ``motion_sections``
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.models.scene.bezier import BezierNode
from mudg.models.scene.deformed import DeformedNode
from mudg.models.scene.hexplane import HexPlaneNode
from mudg.models.scene.model import SceneModel
from mudg.models.scene.nodes import DeformableNode, RigidNode
from mudg.models.scene.vibration import VibrationNode
from mudg.pages.viewer.chunks import CHUNK, Layout, lay_out, level_of, opacity_of

BLOCK: Final = 256
LEAD_STEP: Final = 0.1
"""Of class logits; a lead beyond 25.5 is cut."""
PLACE_STEP_M: Final = 0.0005
SCALE_STEP: Final = 0.01
"""Finest steps of places, metres, and of logarithms of scales."""
DEFORM_STEP_M: Final = 1e-4
"""Of displacements of what deforms; beyond 3.2 m they are cut."""
SAMPLE: Final = 100_000
SH_BAND_0: Final = 0.28209479177387814
COLOR_LIMITS: Final = (-0.5, 2.0)
"""Colours of Gaussians beyond these are cut; a Gaussian may be darker than black or brighter than white where others cover it."""

Sections = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Packed:
    """A scene for the page; its chunks are made one at a time.

    Args:
        model: the scene, on the CPU. layout: which Gaussians of it are on the page.
        sections: what belongs to all chunks, see the module's docstring. facts: JSON values that describe everything.
        notes: sentences about what the page shows differently from the rasterizer.
    """

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
        """Sections of a chunk, and its record: rows, level, box of what stands still (None: nothing does), whether something moves."""
        rows, columns, facts = self.layout.chunk(index), _columns(self.model), self.facts
        node = self.model.table.labels["node"].numpy()[rows].astype(np.int64)
        blocks = list(_blocks(node))
        sections = _geometry(columns, rows, blocks) | {
            "block_of": np.array([(n, len(b)) for n, b in blocks], np.uint32)
        }
        sections["color"] = _colors(columns, rows, facts["color_low"], facts["color_high"])
        sections["class"] = _classes(columns.get("semantics"), rows)
        if self.model.certainty is not None:
            sections["certainty"] = to_u8(self.model.certainty[torch.from_numpy(rows)].float().numpy())
        if self.model.sh_degree:
            sections["harmonics"] = _harmonics(columns["sh_rest"][rows], facts["harmonic_step"])
        still = columns["means"][rows[node == 0]]
        box = [[round(float(v), 3) for v in corner] for corner in (still.min(0), still.max(0))] if len(still) else None
        return sections, {"rows": len(rows), "level": level_of(index), "box": box, "moves": bool((node != 0).any())}


def pack_scene(
    model: SceneModel, begin_s: float, path: NDArray[np.floating] | None = None, most: int = 0, chunk_rows: int = CHUNK
) -> Packed:
    """Prepare a fitted scene for the page.

    Args:
        model: on the CPU. begin_s: time that becomes 0 in all sections, seconds.
        path: positions of the cameras f64[m, 3]; which Gaussians are worth keeping depends on how near they are.
        most: number of Gaussians to keep (0 = all that can be drawn). chunk_rows: Gaussians per chunk.

    Raises:
        UsageError: more Gaussians than a page can hold.
    """
    columns = _columns(model)
    layout = lay_out(columns, model.table.labels["node"].numpy(), path, most, chunk_rows)
    low, high = _color_range(columns["sh_dc"], layout, model.sh_degree)
    nodes, moving = motion_sections(model, begin_s)
    facts: dict[str, Any] = {
        "rows": len(layout.rows), "chunk_rows": layout.size, "degree": model.sh_degree, "classes": list(model.classes),
        "lead_step": LEAD_STEP, "color_low": low, "color_high": high, "certainty": model.certainty is not None,
        "antialias": bool(_drawing(model).get("antialias", False)), "nodes": nodes, "deform_step": DEFORM_STEP_M,
    }  # fmt: skip
    if model.sh_degree:
        facts["harmonic_step"] = _harmonic_step(columns["sh_rest"], layout)
    if model.sky is not None:
        panorama = model.sky.table["panorama"].detach()[0].numpy()
        moving["sky"] = to_u8(panorama.transpose(1, 2, 0))
        facts["sky_rows"] = model.sky.rows
    return Packed(model, layout, moving, facts, _notes(model))


def _columns(model: SceneModel) -> dict[str, NDArray[Any]]:
    """The table's columns, without copies."""
    return {name: value.detach().float().numpy() for name, value in model.table.columns.items()}


def _drawing(model: SceneModel) -> Mapping[str, Any]:
    """The settings of the rasterizer that the scene was fitted with, where they are not the usual ones."""
    return model.facts.get("drawing", {})


def _notes(model: SceneModel) -> tuple[str, ...]:
    notes = []
    if any(isinstance(node, (VibrationNode, HexPlaneNode, DeformedNode, BezierNode)) for node in model.nodes):
        notes.append(
            "Gaussians of this method change on their own with time. The page shows them at rest; boxes still carry them."
        )
    if set(_drawing(model)) - {"antialias", "packed"}:
        notes.append("This scene was fitted to be drawn along rays or as discs. The page draws the usual ellipsoids.")
    return tuple(notes)


def _blocks(node: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Node and positions of every block; rows are ordered by node."""
    for one in np.unique(node):
        own = np.flatnonzero(node == one)
        for start in range(0, len(own), BLOCK):
            yield int(one), own[start : start + BLOCK]


def _geometry(columns: Mapping[str, Any], rows: Any, blocks: list[tuple[int, Any]]) -> Sections:
    means, scales = columns["means"][rows].astype(np.float64), columns["log_scales"][rows].astype(np.float64)
    places, sizes = np.zeros((len(rows), 3), np.uint16), np.zeros((len(rows), 3), np.uint8)
    bounds = np.zeros((len(blocks), 12), np.float32)
    for index, (_, own) in enumerate(blocks):
        bounds[index, :3], bounds[index, 3:6], places[own] = _quantised(means[own], 65535, PLACE_STEP_M)
        bounds[index, 6:9], bounds[index, 9:], sizes[own] = _quantised(scales[own], 255, SCALE_STEP)
    bytes_of = np.concatenate([(places & 255).T, (places >> 8).T]).astype(np.uint8)
    turns = smallest_three(columns["quats"][rows].astype(np.float64))
    return {
        "block": bounds,
        "position": bytes_of,
        "scale": sizes.T.copy(),
        "rotation": turns.view(np.uint8).reshape(-1, 4).T.copy(),
    }


def _quantised(values: NDArray[np.float64], levels: int, least_step: float) -> tuple[Any, Any, Any]:
    """Least value, step (both as f32 holds them) and levels, per column. Few levels leave high bytes that compress well."""
    low = values.min(0).astype(np.float32)
    step = np.maximum((values.max(0) - low) / levels, least_step).astype(np.float32)
    return low, step, np.clip(np.rint((values - low) / step), 0, levels).astype(np.uint16 if levels > 255 else np.uint8)


def smallest_three(quats: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Quaternions [n, 4] (w x y z, any length) as u32[n]."""
    unit = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
    unit[np.abs(unit).max(1) == 0] = (1, 0, 0, 0)
    largest = np.abs(unit).argmax(1)
    unit *= np.where(np.take_along_axis(unit, largest[:, None], 1) < 0, -1.0, 1.0)
    others = unit[np.arange(4) != largest[:, None]].reshape(-1, 3)
    level = (np.clip(np.rint(others * np.sqrt(2) * 511), -511, 511) + 512).astype(np.uint32)
    return level[:, 0] | level[:, 1] << 10 | level[:, 2] << 20 | largest.astype(np.uint32) << 30


def _color_range(bands: Any, layout: Layout, degree: int) -> tuple[float, float]:
    """Between which colours the page tells levels apart. Without further bands what is below 0 is drawn as 0."""
    low, high = 0.0, 1.0
    for index in range(len(layout)):
        rgb = bands[layout.chunk(index), 0] * SH_BAND_0 + 0.5
        low, high = min(low, float(rgb.min())), max(high, float(rgb.max()))
    return max(low, COLOR_LIMITS[0]) if degree else 0.0, min(high, COLOR_LIMITS[1])


def _colors(columns: Mapping[str, Any], rows: Any, low: float, high: float) -> NDArray[np.uint8]:
    red, green, blue = to_u8((columns["sh_dc"][rows, 0] * SH_BAND_0 + 0.5 - low) / (high - low)).T
    return np.stack([red - green, green, blue - green, to_u8(opacity_of(columns["logits"][rows]))])


def _classes(logits: Any, rows: Any) -> NDArray[np.uint8]:
    if logits is None or logits.shape[1] < 2:
        return np.stack([np.full(len(rows), 255, np.uint8), np.zeros(len(rows), np.uint8)])
    here = logits[rows]
    best = np.partition(here, -2, axis=1)[:, -2:]
    lead = np.clip(np.rint((best[:, 1] - best[:, 0]) / LEAD_STEP), 1, 255)
    return np.stack([here.argmax(1), lead]).astype(np.uint8)


def _harmonic_step(rest: Any, layout: Layout) -> float:
    """Step of the levels: nearly all values lie within 127 of them. Taken from at most `SAMPLE` rows, evenly."""
    some = rest[layout.rows[:: max(1, -(-len(layout.rows) // SAMPLE))]]
    return max(float(np.percentile(np.abs(some), 99.95)) if some.size else 0.0, 1e-6) / 127


def _harmonics(rest: Any, step: float) -> NDArray[np.uint8]:
    return (np.clip(np.rint(rest.reshape(len(rest), -1) / step), -127, 127) + 128).astype(np.uint8).T.copy()


def to_u8(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Values in [0, 1] as u8; what lies outside is cut."""
    return np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)


# motion ---------------------------------------------------------------------------------------------------------------


def motion_sections(model: SceneModel, begin_s: float) -> tuple[list[dict[str, Any]], Sections]:
    """What carries the rows of each node.

    Returns:
        One record per node (name, kind, label, size_m, ``keys``: first row and number of its keys in section "keys", ``grid``: first
        value and cells of its displacements in "deform"), and the sections: ``keys`` f32[k, 8] (time since ``begin_s``, position,
        quaternion w x y z, world from box), ``deform`` i16[...] as [key, xyz, z, y, x] per deformable node, in `DEFORM_STEP_M`.
    """
    records, keys, grids = [], [np.zeros((0, 8), np.float32)], [np.zeros(0, np.int16)]
    for node in model.nodes:
        record: dict[str, Any] = {"name": node.name, "kind": node.kind}
        if isinstance(node, RigidNode):
            record |= {"label": node.label, "size_m": [round(float(v), 4) for v in node.size_m],
                       "keys": [sum(map(len, keys)), len(node.times_s)]}  # fmt: skip
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


# the blob -------------------------------------------------------------------------------------------------------------


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
