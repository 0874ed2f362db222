"""Starting values of a scene model: fused points become Gaussians, what LiDAR never reached is filled in, the sky is
painted.

What LiDAR does not reach in a street: facades above the topmost beam, and everything beyond its range. Both are filled
from the recorded images: a pixel that is neither sky nor a dynamic object and has no point near it takes the depth of
the surface of the same class below it in its column (walls, trees and poles stand upright, so their camera z hardly
changes upwards); where there is none it is put on a far shell. This needs semantic labels; without them nothing is
filled and the sky stands in.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from mudg.base import geometry, log, seeds
from mudg.base.errors import InputError
from mudg.base.palette import DYNAMIC_IDS, ID, UNLABELLED
from mudg.base.types import FusedCloud, PointCloud, Scene
from mudg.core.fusion import largest_beam_gap
from mudg.core.project import RULES as HIDING_RULES
from mudg.core.project import visible_depth
from mudg.core.table import Table
from mudg.gaussians.model import SceneModel
from mudg.gaussians.nodes import SYMMETRIC_LABELS, RigidNode, SkyNode, StaticNode, object_node
from mudg.gaussians.settings import METHODS, FitConfig
from mudg.gaussians.views import StoredView
from mudg.scene.read import read_points

SH_C0: Final = 0.28209479177387814
START_OPACITY: Final = 0.1


def voxel_filter(xyz: NDArray[np.float32], size_m: NDArray[np.floating] | float) -> NDArray[np.int64]:
    """Indices of one point per cube of side ``size_m`` (a number, or one per point, taken to powers of sqrt 2),
    sorted."""
    if np.isscalar(size_m):
        level, cell = np.zeros(len(xyz), np.int64), np.floor(xyz / float(size_m)).astype(np.int64)
    else:
        level = np.round(2 * np.log2(np.asarray(size_m, np.float64))).astype(np.int64)
        cell = np.floor(xyz / np.exp2(level / 2)[:, None]).astype(np.int64)
    keys = np.column_stack([level, cell])
    keys = keys - keys.min(0, initial=0)
    spans = keys.max(0, initial=0) + 1
    flat = ((keys[:, 0] * spans[1] + keys[:, 1]) * spans[2] + keys[:, 2]) * spans[3] + keys[:, 3]
    return np.sort(np.unique(flat, return_index=True)[1])


def neighbour_scale(xyz: NDArray[np.float32], smallest_m: float = 0.005, largest_m: float = 1.5) -> NDArray[np.float32]:
    """Root mean square distance to the three nearest other points, f32[N] metres, kept within bounds."""
    if len(xyz) < 4:
        return np.full(len(xyz), 0.1, np.float32)
    distance, _ = cKDTree(xyz).query(xyz, k=4, workers=1)
    return np.sqrt((distance[:, 1:] ** 2).mean(1)).clip(smallest_m, largest_m).astype(np.float32)


def box_grid(size_m: Sequence[float], rgb: Sequence[float]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points on the surface of a box, for an object that the LiDAR hardly saw: xyz f32[M, 3] in the box frame, one
    colour."""
    axis = np.linspace(-0.5, 0.5, 12)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    surface = grid[(np.abs(grid) > 0.5 - 1e-9).any(1)]
    xyz = (surface * 0.9 * np.asarray(size_m)).astype(np.float32)
    return xyz, np.broadcast_to(np.asarray(rgb, np.uint8), (len(xyz), 3)).copy()


# start --------------------------------------------------------------------------------------------

UPRIGHT_IDS = tuple(ID[n] for n in ("building", "wall", "fence", "pole", "traffic light", "traffic sign", "vegetation"))
GROUND_IDS = tuple(ID[n] for n in ("road", "sidewalk", "terrain"))
FILL_CELL_PX = 8
FILL_FRAMES = 30
FAR_M = 150.0
"""Depth at which pixels start that are neither sky nor within LiDAR range."""
SKY_ROWS = 192
FEWEST_OBJECT_POINTS = 150
MIRROR_APART_M = 0.25
SAME_DEPTH = 0.02
"""A point is seen by a camera whose nearest depth at its pixel differs by at most this share."""
MOMENT_FRAMES = 2
"""Frames that share one of the moments by which points are thinned a second time."""
LARGEST_M = 150.0


@dataclass(frozen=True, eq=False)
class StartPoints:
    """Points that become Gaussians, in the frame of their node: xyz f32[N, 3] and scale f32[N] in metres, rgb u8[N, 3],
    train ids u8[N]."""

    xyz: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    semantics: NDArray[np.uint8]
    scale_m: NDArray[np.float32]

    @classmethod
    def joined(cls, parts: Sequence[StartPoints]) -> StartPoints:
        """All points of the parts, in order."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def __len__(self) -> int:
        return len(self.xyz)

    def __getitem__(self, rows: NDArray[np.integer] | slice) -> StartPoints:
        """Copies of the points at these indices."""
        rows = np.arange(len(self))[rows] if isinstance(rows, slice) else rows
        return StartPoints(self.xyz[rows], self.rgb[rows], self.semantics[rows], self.scale_m[rows])

    def columns(self, classes: Sequence[int], sh_degree: int) -> dict[str, Tensor]:
        """Rows of the table of Gaussians: round, with colour and class of their point."""
        count = len(self)
        quats = torch.zeros(count, 4)
        quats[:, 0] = 1.0
        columns = {
            "means": torch.from_numpy(np.array(self.xyz, np.float32)),
            "quats": quats,
            "log_scales": torch.from_numpy(np.log(self.scale_m))[:, None].repeat(1, 3),
            "logits": torch.full((count,), float(np.log(START_OPACITY / (1 - START_OPACITY)))),
            "sh_dc": torch.from_numpy((self.rgb.astype(np.float32) / 255 - 0.5) / SH_C0)[:, None],
            "semantics": 3.0 * torch.from_numpy(self.semantics[:, None] == np.array(classes, np.uint8)).float(),
        }
        if sh_degree > 0:
            columns["sh_rest"] = torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3)
        return columns


def _labels(cloud: PointCloud) -> NDArray[np.uint8]:
    return np.full(len(cloud), UNLABELLED, np.uint8) if cloud.semantics is None else cloud.semantics


def mirrored_points(xyz: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Points reflected about y = 0 of the box, where no measured point is near: xyz f32[M, 3] and their sources."""
    if len(xyz) == 0:
        return xyz, np.zeros(0, np.int64)
    flipped = xyz * np.array([1, -1, 1], np.float32)
    distance, _ = cKDTree(xyz).query(flipped, k=1, workers=1)
    source = np.flatnonzero(distance > MIRROR_APART_M)
    return flipped[source], source


def _cell_depth(stored: StoredView, xyz: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float64]:
    """Nearest depth of the points in each cell of the image; infinity where there is none. A cell beside a covered one
    in its row counts as covered (LiDAR lines are sparse)."""
    uv, z = geometry.project(stored.view, xyz)
    with np.errstate(invalid="ignore"):
        inside = ((uv >= 0) & (uv < (columns * FILL_CELL_PX, rows * FILL_CELL_PX))).all(1) & (z > 1.0)
    column, row = (uv[inside, 0] // FILL_CELL_PX).astype(int), (uv[inside, 1] // FILL_CELL_PX).astype(int)
    depth = np.full((rows, columns), np.inf)
    np.minimum.at(depth, (row, column), z[inside])
    padded = np.pad(depth, ((0, 0), (1, 1)), constant_values=np.inf)
    return np.where(np.isfinite(depth), depth, np.minimum(padded[:, :-2], padded[:, 2:]))


def frame_seconds(scene: Scene) -> float:
    """Seconds between frames; 0.1 where there is only one."""
    times = sorted({frame.view.time_s for frame in scene.frames})
    return (times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 0.1


@dataclass(frozen=True, eq=False)
class FitStart:
    """What a fit starts from, and the model made of it. ``fused``: of methods without boxes, only the colours of its
    cameras are used. ``classes``: train ids of the model's class channels."""

    config: FitConfig
    scene: Scene
    fused: FusedCloud
    views: Sequence[StoredView]
    classes: tuple[int, ...]

    def model(self) -> SceneModel:
        """The scene model of fused points. InputError: the fused cloud has no points at all."""
        config, cloud, kinds = self.config, self.fused.static, METHODS[self.config.method].nodes
        if len(cloud) == 0:
            what, remedy = "the fused cloud has no static points", "check the LiDAR of the scene"
            raise InputError(what, where=self.scene.root, remedy=remedy)
        rows = self._thinned(cloud.xyz, config.start.gaussians)
        points = StartPoints(cloud.xyz[rows], cloud.rgb[rows], _labels(cloud)[rows], neighbour_scale(cloud.xyz[rows]))
        points = StartPoints.joined([points, *self._unreached(points.xyz)])
        blocks = [points.columns(self.classes, config.sh_degree)]
        nodes: list[StaticNode | RigidNode] = [StaticNode()]
        if "objects" in kinds:
            share = config.start.gaussians // max(1, len(self.fused.objects))
            for track_id, cloud in sorted(self.fused.objects.items()):
                node = object_node(self.scene.track(track_id), config.poses.learn, config.objects.deformable)
                blocks.append(self._object_columns(node, cloud, min(share, 8000)))
                nodes.append(node)
        columns = {name: torch.cat([block[name] for block in blocks]) for name in blocks[0]}
        counts = torch.tensor([len(block["means"]) for block in blocks])
        owner = torch.arange(len(blocks), dtype=torch.int32).repeat_interleave(counts)
        static = int(counts[0])
        log.info(f"start: {static} static Gaussians, {len(owner) - static} on {len(nodes) - 1} dynamic objects")
        return self._model_of(Table(columns, {"node": owner}), tuple(nodes))

    def world_model(self, node: StaticNode, columns: Mapping[str, Tensor]) -> SceneModel:
        """A scene that is one node with these rows, and the sky that the method has."""
        table = Table(columns, {"node": torch.zeros(len(columns["means"]), dtype=torch.int32)})
        return self._model_of(table, (node,))

    def _model_of(self, table: Table, nodes: tuple[StaticNode | RigidNode, ...]) -> SceneModel:
        config, sky = self.config, None
        if "sky" in METHODS[config.method].nodes:  # starts with the mean recorded colour per direction
            sky = SkyNode.uniform(SKY_ROWS)
            sky.fill(self._sky_pixels(stored, stored.sky) for stored in self.views if stored.sky is not None)
        return SceneModel(table, nodes, sky, self.classes, config.sh_degree, colors=self.fused.colors)

    def _sky_pixels(
        self, stored: StoredView, shown: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Directions and common colours of every second row and column of the sky."""
        camera, (row, column) = stored.view.camera, (2 * index for index in shown[::2, ::2].nonzero())
        rays = np.stack([*geometry.pinhole_ray(camera.intrinsics, column + 0.5, row + 0.5), np.ones(len(row))], 1)
        rgb = self.fused.colors.bytes_to_common(camera.name, stored.rgb[row, column])
        return rays @ stored.view.world_from_cam[:3, :3].T, rgb.astype(np.float32) / 255

    def _thinned(self, xyz: NDArray[np.float32], most: int) -> NDArray[np.int64]:
        """Rows to keep: one point per voxel, voxels growing with the distance to the nearest camera."""
        centers = np.stack([stored.view.center_world for stored in self.views]).astype(np.float32)
        distance, _ = cKDTree(centers).query(xyz, k=1, workers=1)
        size = self.config.start.voxel_m * np.clip(distance / 20.0, 0.4, 3.0)
        for _ in range(12):
            rows = voxel_filter(xyz, size)
            if len(rows) <= most:
                return rows
            size = size * np.clip((len(rows) / most) ** 0.5, 1.08, 2.0)
        return rows[np.sort(seeds.numpy_rng(self.config.seed, 0, "thin").permutation(len(rows))[:most])]

    def _object_columns(self, node: RigidNode, cloud: PointCloud, most: int) -> Mapping[str, Tensor]:
        config, rows = self.config, voxel_filter(cloud.xyz, 0.06)
        rows = rows[np.sort(seeds.numpy_rng(config.seed, 0, f"object {node.name}").permutation(len(rows))[:most])]
        xyz, rgb, semantics = cloud.xyz[rows], cloud.rgb[rows], _labels(cloud)[rows]
        if config.objects.mirror_start and node.label.lower() in SYMMETRIC_LABELS:
            other, source = mirrored_points(xyz)
            xyz, rgb = np.concatenate([xyz, other]), np.concatenate([rgb, rgb[source]])
            semantics = np.concatenate([semantics, semantics[source]])
        if len(rows) < FEWEST_OBJECT_POINTS:
            grid_xyz, grid_rgb = box_grid(node.size_m, rgb.mean(0) if len(rgb) else np.array([127, 127, 127]))
            commonest = np.bincount(semantics, minlength=256).argmax() if len(semantics) else UNLABELLED
            xyz, rgb = np.concatenate([xyz, grid_xyz]), np.concatenate([rgb, grid_rgb])
            semantics = np.concatenate([semantics, np.full(len(grid_xyz), commonest, np.uint8)])
        scale_m = neighbour_scale(xyz, 0.02, 0.3)
        return StartPoints(xyz, rgb, semantics, scale_m).columns(self.classes, config.sh_degree)

    # beyond LiDAR ---------------------------------------------------------------------------------

    def _unreached(self, xyz: NDArray[np.float32]) -> list[StartPoints]:
        """Points for what is visible but has no LiDAR; see the module's text. Without labels there are none."""
        labelled = [stored for stored in self.views if stored.channels is not None] if self.classes else []
        chosen = labelled[:: max(1, len(labelled) // FILL_FRAMES)]
        if not chosen:
            return []
        points = StartPoints.joined([self._fill_view(stored, xyz) for stored in chosen])
        return [points[voxel_filter(points.xyz, np.maximum(points.scale_m * 2.0, 0.05))]]

    def _fill_view(self, stored: StoredView, xyz: NDArray[np.float32]) -> StartPoints:
        view, cell = stored.view, FILL_CELL_PX
        rows, columns = view.camera.height // cell, view.camera.width // cell
        center_row = (np.arange(rows) * cell + cell // 2)[:, None]
        center_column = (np.arange(columns) * cell + cell // 2)[None, :]
        label = stored.train_ids(center_row, center_column, self.classes)
        depth = _cell_depth(stored, xyz, rows, columns)
        covered = np.isfinite(depth)
        wanted = ~covered & np.isin(label, [i for i in range(19) if i not in (*DYNAMIC_IDS, *GROUND_IDS, ID["sky"])])
        if stored.mask is not None:
            wanted &= stored.mask[center_row, center_column]
        guess = np.full((rows, columns), FAR_M)
        below = np.full((256, columns), np.inf)  # per class: depth of the last covered cell below, in this column
        every = np.arange(columns)
        for row in range(rows - 1, -1, -1):
            known = covered[row] & np.isin(label[row], UPRIGHT_IDS)
            below[label[row, known], every[known]] = depth[row, known]
            surface = below[label[row], every]
            guess[row] = np.where(np.isfinite(surface), surface, FAR_M)
        row, column = wanted.nonzero()
        uv = np.stack([column * cell + cell / 2, row * cell + cell / 2], 1)
        z, pixels = guess[row, column], stored.rgb[row * cell + cell // 2, column * cell + cell // 2]
        color = self.fused.colors.bytes_to_common(view.camera.name, pixels)
        points = geometry.unproject(view, uv, z).astype(np.float32)
        return StartPoints(points, color, label[row, column], (0.5 * cell * z / view.camera.fx).astype(np.float32))

    # without boxes --------------------------------------------------------------------------------
    #
    # LiDAR points where and when they were measured, coloured by the photographs of that time. Nothing here knows
    # tracked boxes or the fused cloud (whose dynamic points lie in boxes): a point of a moving car stays where its
    # sweep met it. Colours come from training photographs at most half a frame from the sweep, so that a moving point
    # has the colour of its own moment; points that none of these shows are left out.

    def timed_points(self) -> tuple[StartPoints, NDArray[np.float64]]:
        """Starting points of a log and what LiDAR did not reach (as in ``model``); and when they were measured, f64[N]
        seconds, NaN where LiDAR did not reach.

        Half of them are one per cube of space, half one per cube and every few frames, so that what moves has points
        all along its way. InputError: no photograph shows any LiDAR point."""
        found = [part for part in self._measured() if len(part[0])]
        if not found:
            what = "no LiDAR point is seen by a training photograph of its time"
            raise InputError(what, where=self.scene.root, remedy="check the LiDAR of the scene and --cameras")
        xyz, rgb, semantics, time_s = (np.concatenate(column) for column in zip(*found))
        half = max(50, self.config.start.gaussians // 2)
        chosen = [self._thinned(xyz, half), *self._by_moment(xyz, time_s, half)]
        parts = [StartPoints(xyz[rows], rgb[rows], semantics[rows], neighbour_scale(xyz[rows])) for rows in chosen]
        unreached = self._unreached(xyz)
        times = [*(time_s[rows] for rows in chosen), *(np.full(len(part), np.nan) for part in unreached)]
        return StartPoints.joined([*parts, *unreached]), np.concatenate(times)

    def _measured(self) -> Iterator[tuple[NDArray[Any], ...]]:
        """Points of the sweeps: places f32[N, 3], common colours u8[N, 3], train ids u8[N], times f64[N]."""
        near_s = 0.5 * frame_seconds(self.scene) + 1e-3
        for sweep in self.scene.sweeps:
            apart = lambda stored: abs(stored.view.time_s - sweep.time_s)  # noqa: B023
            nearest: dict[str, StoredView] = {}
            for stored in sorted(self.views, key=apart):
                if apart(stored) <= near_s:
                    nearest.setdefault(stored.view.camera.name, stored)
            if not nearest:
                continue
            points = read_points(self.scene, sweep)
            xyz, gap = geometry.transform_points(sweep.world_from_lidar, points.xyz), largest_beam_gap(points.xyz)
            free = np.ones(len(xyz), bool)
            for stored in nearest.values():
                rows, rgb, semantics = self._seen(stored, xyz, gap)
                mine = free[rows]
                rows = rows[mine]
                free[rows] = False
                yield xyz[rows], rgb[mine], semantics[mine], sweep.time_s + points.dt_s[rows].astype(np.float64)

    def _seen(
        self, stored: StoredView, xyz: NDArray[np.float32], gap_deg: float
    ) -> tuple[NDArray[np.int64], NDArray[np.uint8], NDArray[np.uint8]]:
        """Rows of the points that a photograph shows, their common colours and train ids."""
        view, camera = stored.view, stored.view.camera
        uv, z = geometry.project(view, xyz)
        with np.errstate(invalid="ignore"):
            inside = ((uv >= 0) & (uv < (camera.width, camera.height))).all(1) & (z > 0.5) & (z < LARGEST_M)
        rows = np.flatnonzero(inside)
        column, row = uv[rows, 0].astype(int), uv[rows, 1].astype(int)
        nearest = visible_depth(view, xyz, HIDING_RULES["sweep"], gap_deg=gap_deg, far_m=LARGEST_M)[row, column]
        with np.errstate(invalid="ignore"):
            seen = np.abs(nearest - z[rows]) <= SAME_DEPTH * z[rows]
        if stored.mask is not None:
            seen &= stored.mask[row, column]
        rows, row, column = rows[seen], row[seen], column[seen]
        common = self.fused.colors.bytes_to_common(camera.name, stored.rgb[row, column])
        return rows, common, stored.train_ids(row, column, self.classes)

    def _by_moment(
        self, xyz: NDArray[np.float32], time_s: NDArray[np.float64], most: int
    ) -> Iterator[NDArray[np.int64]]:
        """Rows, one per cube of space, of every moment; at most so many in all."""
        span_s, parts = MOMENT_FRAMES * frame_seconds(self.scene), []
        moment = np.floor((time_s - time_s.min()) / span_s + 1e-6).astype(np.int64)
        for number in np.unique(moment):
            mine = np.flatnonzero(moment == number)
            parts.append(mine[voxel_filter(xyz[mine], 2 * self.config.start.voxel_m)])
        share = min(1.0, most / max(1, sum(map(len, parts))))
        for index, rows in enumerate(parts):
            order = seeds.numpy_rng(self.config.seed, index, "moment").permutation(len(rows))
            yield rows[np.sort(order[: max(4, int(share * len(rows)))])]
