"""The scene model: a static world, one rigid node per moving object, a sky; and how they become Gaussians at a time.

All Gaussians live in **one** row-aligned ``Table`` whose rows are ordered by node, so that composing a moment touches only what
moves: rotation and translation of the rows of rigid nodes. Everything else is passed to the renderer as it is. A node says
how its rows are placed in the world at a time; a new kind of node is a class with ``place`` and one row in ``NODES``.

Columns of the table (raw, unactivated):

    means [N, 3]      metres, in the node's own frame (world for static, box for rigid)
    quats [N, 4]      (w, x, y, z), any length
    log_scales [N, 3] natural logarithm of metres
    logits [N]        opacity = sigmoid
    sh_dc [N, 1, 3], sh_rest [N, K-1, 3]   spherical harmonics (sh_rest absent at degree 0)
    semantics [N, C]  class logits of the classes in ``SceneModel.classes``
    sh_time [M, F, 3] of the M rows of moving objects only: how the constant colour varies over time (partial column)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol, Self

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.palette import CLASSES, ID
from mudg.base.types import Gaussians, Track, View
from mudg.core import fused as kernels
from mudg.core.table import Table
from mudg.models.scene import motion

SH_C0: Final = 0.28209479177387814
SKY_LOGIT: Final = 10.0
"""Logit of the sky class where nothing covers it; large beside what a Gaussian learns."""
LIMBED_LABELS: Final = frozenset(
    {"pedestrian", "person", "person_sitting", "child", "adult", "cyclist", "rider", "bicyclist", "motorcyclist", "animal"}
)
"""Labels of tracks that change their shape while they move."""
SYMMETRIC_LABELS: Final = frozenset({"car", "van", "truck", "bus", "tram", "train", "vehicle", "trailer", "motorcycle"})
"""Labels of tracks whose two sides look alike."""
LEAST_NOISE_M: Final = 0.01
LEAST_NOISE_RAD: Final = 0.002
DEFORM_CELLS: Final = (2, 3, 6)
"""Cells of the control grid of a deformable node along, across and up its box."""
DEFORM_SMOOTHING: Final = 0.75
DEFORM_DECAY: Final = 0.02


class Node(Protocol):
    """Places a block of table rows in the world."""

    kind: str
    name: str

    def place(self, means: Tensor, quats: Tensor, time_s: float) -> tuple[Tensor, Tensor] | None:
        """World means ``[n, 3]`` m and rotations ``[n, 4]`` of local rows at a time; None: the node is not there then."""
        ...

    def parameters(self) -> Table | None:
        """The node's own optimisable table beside the shared one (pose offsets), or None."""
        ...

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """What rebuilds it: plain JSON values and tensors."""
        ...


class StaticNode:
    """Rows already in the world."""

    kind = "static"

    def __init__(self, name: str = "background") -> None:
        self.name = name

    def place(self, means: Tensor, quats: Tensor, time_s: float) -> tuple[Tensor, Tensor]:
        """The rows as they are."""
        return means, quats

    def parameters(self) -> None:
        """None: nothing beside the shared rows."""
        return

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """See ``Node``."""
        return {"name": self.name}, {}

    @classmethod
    def from_state(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> StaticNode:
        """Inverse of ``state``."""
        return cls(str(facts["name"]))


class RigidNode:
    """A tracked moving object: rows in the frame of its box, carried by the box's pose.

    The pose at a time comes from the two neighbouring keys of the track. Each key may be corrected by offsets in
    the frame of the box, ``corrected = world_from_object @ (yaw about z, then dx dy dz)``; **both** neighbours' corrected
    positions and rotations are interpolated (straight line, slerp). Outside the track's span the object does not exist.

    The offsets, one row per key: ``shift`` [K, 3] metres and ``yaw`` [K] radians. ``learn_pose``: whether a fit may change them.
    """

    kind = "rigid"

    def __init__(
        self, name: str, label: str, size_m: Sequence[float], times_s: NDArray[np.float64],
        world_from_object: NDArray[np.float64], offsets: Table | None = None, learn_pose: bool = False,
    ) -> None:  # fmt: skip
        self.name = name
        self.label = label
        self.size_m = tuple(float(value) for value in size_m)
        self.times_s = np.asarray(times_s, np.float64)
        self.world_from_object = np.asarray(world_from_object, np.float64)
        self.learn_pose = learn_pose
        count = len(self.times_s)
        self.offsets = offsets or Table({"shift": torch.zeros(count, 3), "yaw": torch.zeros(count), **self._own_columns(count)})
        self._placements: dict[float, tuple[Tensor, Tensor, Tensor] | None] = {}
        self._quats = torch.from_numpy(np.stack([geometry.quaternion_from_matrix(m) for m in self.world_from_object])).float()
        self._rotations = torch.from_numpy(self.world_from_object[:, :3, :3].copy()).float()
        self._positions = torch.from_numpy(self.world_from_object[:, :3, 3].copy()).float()

    @classmethod
    def from_track(cls, track: Track, learn_pose: bool = False) -> Self:
        """A node that follows ``track``."""
        return cls(track.id, track.label, track.size_m.tolist(), track.times_s, track.world_from_object, learn_pose=learn_pose)

    @property
    def symmetric(self) -> bool:
        """Whether its left side looks like its right one."""
        return self.label.lower() in SYMMETRIC_LABELS

    def _own_columns(self, keys: int) -> dict[str, Tensor]:
        """Starting values of what a kind of node has per key besides the offsets."""
        return {}

    # -- pose -------------------------------------------------------------------------------------------------------

    def _key_pose(self, index: int) -> tuple[Tensor, Tensor]:
        """Corrected key: position ``[3]`` and unit quaternion ``[4]`` in the world."""
        position = self._positions[index] + self._rotations[index] @ self.offsets["shift"][index]
        half = self.offsets["yaw"][index] / 2
        zero = torch.zeros_like(half)
        turn = torch.stack([torch.cos(half), zero, zero, torch.sin(half)])
        return position, left_product_matrix(self._quats[index]) @ turn

    def keys_around(self, time_s: float) -> tuple[int, int, float] | None:
        """The two neighbouring keys and the fraction of the way between them (one key twice at its very time); None outside."""
        tolerance_s = 1e-6
        times = self.times_s
        if len(times) == 0 or time_s < times[0] - tolerance_s or time_s > times[-1] + tolerance_s:
            return None
        after = int(np.searchsorted(times, time_s))
        for near in (after, after - 1):
            if 0 <= near < len(times) and abs(times[near] - time_s) <= tolerance_s:
                return near, near, 0.0
        return after - 1, after, float((time_s - times[after - 1]) / (times[after] - times[after - 1]))

    def pose_at(self, time_s: float) -> tuple[Tensor, Tensor] | None:
        """Position ``[3]`` m and unit quaternion ``[4]`` at a time, differentiable in the offsets; None outside the span."""
        found = self.keys_around(time_s)
        if found is None:
            return None
        before, after, u = found
        position0, quat0 = self._key_pose(before)
        if before == after:
            return position0, quat0
        position1, quat1 = self._key_pose(after)
        return position0 + u * (position1 - position0), slerp(quat0, quat1, u)

    def corrected_keys(self) -> NDArray[np.float64]:
        """The keys with their offsets: world_from_object f64[K, 4, 4]."""
        return self._corrected(slice(None))

    @torch.no_grad()
    def _corrected(self, which: slice) -> NDArray[np.float64]:
        shift, yaw = self.offsets["shift"][which].double().numpy(), self.offsets["yaw"][which].double().numpy()
        return self.world_from_object[which] @ np.stack([geometry.yaw_matrix(float(turn), move) for turn, move in zip(yaw, shift)])

    def pose_matrix(self, time_s: float) -> NDArray[np.float64] | None:
        """Corrected world_from_object f64[4, 4] at a time; None outside the span."""
        found = self.keys_around(time_s)
        if found is None:
            return None
        before, after, u = found
        keys = self._corrected(slice(before, after + 1))
        return keys[0] if before == after else geometry.interpolate_pose(keys[0], keys[1], u)

    @torch.no_grad()
    def add_offsets(self, shift_m: NDArray[np.float64], yaw_rad: NDArray[np.float64]) -> None:
        """Move every key by ``shift_m`` [K, 3] and ``yaw_rad`` [K] in the frame of the box, in place."""
        self.offsets["shift"].add_(torch.from_numpy(shift_m).float())
        self.offsets["yaw"].add_(torch.from_numpy(yaw_rad).float())
        self._placements.clear()

    def settle(self) -> None:
        """Set the offsets to ``settled_offsets``: the best guess before any picture was seen."""
        shift, yaw = self.settled_offsets()
        now = [self.offsets[name].detach().double().numpy() for name in ("shift", "yaw")]
        self.add_offsets(shift - now[0], yaw - now[1])

    def settled_offsets(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Offsets that take independent noise out of the track: shift f64[K, 3] m and yaw f64[K] rad.

        The size of the noise is what the track itself betrays, at least `LEAST_NOISE_M` and `LEAST_NOISE_RAD`.
        """
        positions, heading = self.world_from_object[:, :3, 3], self.headings()
        noise = motion.key_noise(self.times_s, np.column_stack([positions, heading]))
        noise_m = max(float(np.sqrt((noise[:3] ** 2).mean())), LEAST_NOISE_M)
        noise_rad = max(float(noise[3]), LEAST_NOISE_RAD)
        path = motion.smoothed(self.times_s, positions, noise_m, motion.ACCELERATION_M_S2) - positions
        turn = motion.smoothed(self.times_s, heading[:, None], noise_rad, motion.YAW_ACCELERATION_RAD_S2)[:, 0] - heading
        return (self.world_from_object[:, :3, :3].transpose(0, 2, 1) @ path[..., None])[..., 0], turn

    def headings(self) -> NDArray[np.float64]:
        """Yaw of the given keys f64[K], radians, without jumps of 2 pi."""
        return np.unwrap([geometry.yaw_of(pose) for pose in self.world_from_object])

    def moved(self, object_from_new: NDArray[np.float64]) -> Self:
        """A node displaced in its own frame: key poses ``corrected @ object_from_new``; what its rows do inside the box stays."""
        columns = {name: value.detach() for name, value in self.offsets.columns.items()}
        columns |= {"shift": torch.zeros_like(columns["shift"]), "yaw": torch.zeros_like(columns["yaw"])}
        keys = self.corrected_keys() @ object_from_new
        return type(self)(self.name, self.label, self.size_m, self.times_s, keys, Table(columns), self.learn_pose)

    # -- rows -------------------------------------------------------------------------------------------------------

    def place(self, means: Tensor, quats: Tensor, time_s: float) -> tuple[Tensor, Tensor] | None:
        """See ``Node``."""
        placement = self._placement(time_s)
        if placement is None:
            return None
        position, rotation_t, product_t = placement
        return torch.addmm(position, means, rotation_t), quats @ product_t

    def _placement(self, time_s: float) -> tuple[Tensor, Tensor, Tensor] | None:
        """Position ``[3]``, transposed rotation ``[3, 3]`` and transposed quaternion product ``[4, 4]``, remembered per time."""
        if time_s not in self._placements:
            with torch.no_grad():
                pose = self.pose_at(time_s)
            place = None if pose is None else (pose[0], rotation_matrix(pose[1]).T, left_product_matrix(pose[1]).T)
            self._placements[time_s] = place
        return self._placements[time_s]

    def color_weights(self, time_s: float, terms: int) -> Tensor:
        """Values f32[terms] at a time that the coefficients of the time-varying colour are multiplied by."""
        return motion.periodic_weights(time_s, float(self.times_s[0]), float(self.times_s[-1]), terms)

    def parameters(self) -> Table | None:
        """None: offsets are not learnt by gradient steps but by ``stages.fit_poses``, which weighs what each picture can tell."""
        return None

    def after_step(self, share: float) -> None:
        """Regularise, in place, what a node learns by gradient steps; ``share`` in [0, 1] falls with the learning rate."""

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """See ``Node``."""
        facts = {"name": self.name, "label": self.label, "size_m": list(self.size_m), "learn_pose": self.learn_pose}
        tensors = {
            "times_s": torch.from_numpy(self.times_s.copy()),
            "world_from_object": torch.from_numpy(self.world_from_object.copy()),
        }
        return facts, tensors | {f"offsets.{key}": value for key, value in self.offsets.state().items()}

    @classmethod
    def from_state(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Self:
        """Inverse of ``state``. Scenes fitted before shift and yaw were two columns are read too."""
        offsets = {key.removeprefix("offsets."): value for key, value in tensors.items() if key.startswith("offsets.")}
        if "column.offsets" in offsets:
            offsets = {f"{part}.{name}": value[:, cut] for part in ("column", "moment1", "moment2")
                       if (value := offsets.get(f"{part}.offsets")) is not None
                       for name, cut in (("shift", slice(0, 3)), ("yaw", 3))}  # fmt: skip
        return cls(
            str(facts["name"]), str(facts["label"]), facts["size_m"], tensors["times_s"].numpy(),
            tensors["world_from_object"].numpy(), Table.from_state(offsets), bool(facts["learn_pose"]),
        )  # fmt: skip


class DeformableNode(RigidNode):
    """A person or a cyclist: a rigid node whose rows also move within the box, differently at every time.

    The deformation is a grid of control points that spans the box (the corners of `DEFORM_CELLS` cells); each has a displacement
    at every key of the track, and a row moves by what its place in the grid interpolates (three-linear in space, linear in time;
    free-form deformation, Sederberg & Parry 1986). The rows of the shared table need no column of their own for it, so cloning
    and splitting them changes nothing, and a static Gaussian pays nothing.

    Parameters: as ``RigidNode``, and ``deform`` [K, 3, z, y, x], metres in the frame of the box.
    """

    kind = "deformable"

    def _own_columns(self, keys: int) -> dict[str, Tensor]:
        along, across, up = (cells + 1 for cells in DEFORM_CELLS)
        return {"deform": torch.zeros(keys, 3, up, across, along)}

    def place(self, means: Tensor, quats: Tensor, time_s: float) -> tuple[Tensor, Tensor] | None:
        """See ``Node``."""
        if self.keys_around(time_s) is None:
            return None
        return super().place(means + self.displacement(means, time_s), quats, time_s)

    def displacement(self, means: Tensor, time_s: float) -> Tensor:
        """How far rows at ``means`` [n, 3] (frame of the box) are moved at a time, [n, 3] metres; differentiable in both."""
        found = self.keys_around(time_s)
        if found is None or len(means) == 0:
            return torch.zeros_like(means)
        before, after, u = found
        control = self.offsets["deform"][before]
        if after != before:
            control = torch.lerp(control, self.offsets["deform"][after], u)
        place = 2 * means / means.new_tensor(self.size_m)
        moved = F.grid_sample(control[None], place[None, None, None], mode="bilinear", padding_mode="border", align_corners=True)
        return moved[0, :, 0, 0].T

    def parameters(self) -> Table:
        """The table that holds the displacements; the offsets in it never have a gradient, and so stay."""
        return self.offsets

    @torch.no_grad()
    def after_step(self, share: float) -> None:
        """See ``RigidNode``; displacements shrink towards none and towards those of the neighbouring keys."""
        deform = self.offsets["deform"]
        if len(deform) > 2:
            inner = (deform[:-2] + deform[2:]) / 2 - deform[1:-1]
            deform[1:-1] += share * DEFORM_SMOOTHING * inner
        deform *= 1 - share * DEFORM_DECAY
        if self.learn_pose:  # what moves as a whole is the pose's to explain
            deform -= deform.mean((2, 3, 4), keepdim=True)


class SkyNode:
    """Colour of the sky by direction: a longitude-latitude panorama, seen wherever nothing covers it.

    Column ``panorama`` ``[1, 3, Hs, 2 Hs]``, colours around [0, 1] (raw; clamped when an image is written). Row 0 looks
    straight up, the last row straight down; the columns run from longitude -pi to pi (world x axis in the middle).
    """

    kind = "sky"

    def __init__(self, panorama: Table) -> None:
        self.table = panorama

    @classmethod
    def uniform(cls, rows: int, rgb: Sequence[float] = (0.6, 0.7, 0.8)) -> SkyNode:
        """A sky of one colour with ``rows`` rows of texels."""
        color = torch.tensor(list(rgb), dtype=torch.float32)
        return cls(Table({"panorama": color.view(1, 3, 1, 1).expand(1, 3, rows, 2 * rows).contiguous()}))

    @property
    def rows(self) -> int:
        """Rows of the panorama."""
        return int(self.table["panorama"].shape[2])

    def at(self, view: View) -> Tensor:
        """Sky colour ``[3, H, W]`` at every pixel of a view; differentiable in the panorama."""
        size = (view.camera.height, view.camera.width)
        return F.interpolate(self.coarsely_at(view)[None], size=size, mode="bilinear", align_corners=False)[0]

    def coarsely_at(self, view: View) -> Tensor:
        """Sky colour ``[3, h, w]`` on a coarse grid of a view's pixels; differentiable in the panorama.

        The panorama is far coarser than an image, so it is sampled for every s-by-s block of pixels (s chosen such that samples
        stay denser than texels), to be interpolated between them.
        """
        camera = view.camera
        texel_rad = np.pi / self.rows
        stride = int(np.clip(0.7 * texel_rad * min(camera.fx, camera.fy), 1, 8))
        height, width = -(-camera.height // stride), -(-camera.width // stride)
        grid = torch.from_numpy(self._grid(view, height, width)).to(self.table["panorama"])
        padded = F.pad(self.table["panorama"], (1, 1, 0, 0), mode="circular")
        return F.grid_sample(padded, grid[None], mode="bilinear", padding_mode="border", align_corners=False)[0]

    def _grid(self, view: View, height: int, width: int) -> NDArray[np.float32]:
        """Sampling positions in the padded panorama, ``f32[height, width, 2]`` in [-1, 1]."""
        camera = view.camera.resized(width, height)
        x = (np.arange(width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(height) + 0.5 - camera.cy) / camera.fy
        # Written out: a matrix product of this shape wakes the threads of BLAS at every step of a fit.
        right, down, ahead = view.world_from_cam[:3, 0], view.world_from_cam[:3, 1], view.world_from_cam[:3, 2]
        rays = x[None, :, None] * right + (y[:, None, None] * down + ahead)
        return self.panorama_grid(rays, padding=1)

    def panorama_grid(self, directions_world: NDArray[np.float64], padding: int = 0) -> NDArray[np.float32]:
        """Directions ``[..., 3]`` to panorama positions ``[..., 2]`` in [-1, 1] (x: longitude, y: from up to down)."""
        longitude = np.arctan2(directions_world[..., 1], directions_world[..., 0])
        elevation = np.arctan2(directions_world[..., 2], np.hypot(directions_world[..., 0], directions_world[..., 1]))
        columns = 2 * self.rows
        x = (longitude / np.pi) * columns / (columns + 2 * padding)
        return np.stack([x, -2 * elevation / np.pi], -1).astype(np.float32)

    def fill(self, directions_world: NDArray[np.float64], rgb: NDArray[np.float32]) -> None:
        """Start from measured sky colours: mean per texel; texels nobody saw take the nearest seen one's colour.

        Args:
            directions_world: ``[M, 3]``. rgb: f32[M, 3] in [0, 1].
        """
        if len(rgb) == 0:
            return
        from scipy.ndimage import distance_transform_edt

        rows, columns = self.rows, 2 * self.rows
        grid = self.panorama_grid(directions_world)
        column = np.clip(((grid[:, 0] + 1) / 2 * columns).astype(np.int64), 0, columns - 1)
        row = np.clip(((grid[:, 1] + 1) / 2 * rows).astype(np.int64), 0, rows - 1)
        texel = row * columns + column
        count = np.bincount(texel, minlength=rows * columns).astype(np.float64)
        mean = np.stack([np.bincount(texel, rgb[:, c], rows * columns) for c in range(3)]) / np.maximum(count, 1)
        seen = (count > 0).reshape(rows, columns)
        tiled = np.concatenate([seen, seen, seen], 1)  # longitude wraps round
        nearest = distance_transform_edt(~tiled, return_distances=False, return_indices=True)
        rows_of, columns_of = nearest[0][:, columns : 2 * columns], nearest[1][:, columns : 2 * columns] % columns
        filled = mean.reshape(3, rows, columns)[:, rows_of, columns_of]
        self.table.columns["panorama"].detach().copy_(torch.from_numpy(filled).float()[None])

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """See ``Node``."""
        return {"name": "sky"}, self.table.state()

    @classmethod
    def from_state(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> SkyNode:
        """Inverse of ``state``."""
        return cls(Table.from_state(tensors))


NODES: Final[dict[str, Any]] = {"static": StaticNode, "rigid": RigidNode, "deformable": DeformableNode, "sky": SkyNode}


def object_node(track: Track, learn_pose: bool = False, deformable: bool = False) -> RigidNode:
    """The node of a moving track: one that deforms for those who walk or ride, if asked for; else a rigid one."""
    kind = DeformableNode if deformable and track.label.lower() in LIMBED_LABELS else RigidNode
    node = kind.from_track(track, learn_pose)
    if learn_pose:
        node.settle()
    return node


@dataclass
class SceneModel:
    """A fitted, or to be fitted, scene.

    Args:
        table: all Gaussians, rows ordered by node; label column ``node`` i32 is the index into ``nodes``.
        nodes: static node first.
        sky: or None (background black).
        classes: train ids of the semantic channels, in channel order; empty = no semantics.
        sh_degree: of the colour columns.
        facts: JSON values kept with the model (method, scene id, ...).
    """

    table: Table
    nodes: tuple[StaticNode | RigidNode, ...]
    sky: SkyNode | None
    classes: tuple[int, ...]
    sh_degree: int
    facts: dict[str, Any] = field(default_factory=dict)
    _counted: tuple[Tensor, list[int]] | None = field(default=None, init=False, repr=False, compare=False)

    def counts(self) -> list[int]:
        """Rows of each node, in order; counted again only when rows were taken or appended."""
        owner = self.table.labels["node"]
        if self._counted is None or self._counted[0] is not owner:
            self._counted = owner, torch.bincount(owner.long(), minlength=len(self.nodes)).tolist()
        return list(self._counted[1])

    def sort_rows(self) -> None:
        """Bring rows back into node order after rows were appended (stable)."""
        self.table.take(torch.argsort(self.table.labels["node"], stable=True))

    def node_tables(self) -> dict[str, Table]:
        """The optimisable tables beside the shared one, by name (pose offsets; the sky's panorama)."""
        tables = {f"node.{node.name}": own for node in self.nodes if (own := node.parameters()) is not None}
        return tables | ({"sky": self.sky.table} if self.sky is not None else {})

    def node_names(self) -> tuple[str, ...]:
        """Names of the moving objects."""
        return tuple(node.name for node in self.nodes if node.kind != "static")

    def without_nodes(self, names: Sequence[str]) -> SceneModel:
        """A copy without the named objects (the rest keeps its parameters, not its moments)."""
        kept = [index for index, node in enumerate(self.nodes) if node.name not in names or node.kind == "static"]
        renumber = torch.full((len(self.nodes),), -1, dtype=torch.int32)
        renumber[kept] = torch.arange(len(kept), dtype=torch.int32)
        owner = renumber[self.table.labels["node"].long()]
        rows = (owner >= 0).nonzero()[:, 0]
        part = self.table.partial_index(rows) if self.table.partial else rows
        table = Table(
            {key: value.detach()[rows] for key, value in self.table.columns.items()}, {"node": owner[rows]},
            {key: value.detach()[part] for key, value in self.table.partial.items()},
        )  # fmt: skip
        return SceneModel(table, tuple(self.nodes[i] for i in kept), self.sky, self.classes, self.sh_degree, dict(self.facts))

    def with_node_moved(self, name: str, object_from_new: NDArray[np.float64]) -> SceneModel:
        """A copy with one object displaced in its own frame (it shares the table of Gaussians)."""
        nodes = tuple(
            node.moved(object_from_new) if isinstance(node, RigidNode) and node.name == name else node for node in self.nodes
        )
        return SceneModel(self.table, nodes, self.sky, self.classes, self.sh_degree, dict(self.facts))

    # -- state ------------------------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, Any], dict[str, dict[str, Tensor]]]:
        """JSON values and named groups of tensors (``gaussians``, ``nodes``) that rebuild the model with its moments."""
        nodes, tensors = [], {}
        for index, node in enumerate((*self.nodes, *(() if self.sky is None else (self.sky,)))):
            facts, own = node.state()
            nodes.append({"kind": node.kind, **facts})
            tensors |= {f"{index}/{name}": value for name, value in own.items()}
        tensors.setdefault("none", torch.zeros(1))
        values = {"nodes": nodes, "classes": list(self.classes), "sh_degree": self.sh_degree, "facts": self.facts}
        return values, {"gaussians": self.table.state(), "nodes": tensors}

    @classmethod
    def from_state(cls, values: Mapping[str, Any], groups: Mapping[str, Mapping[str, Tensor]]) -> SceneModel:
        """Inverse of ``state``.

        Raises:
            InputError: an unknown node kind, a class that does not exist, or rows that belong to no node.
        """
        nodes: list[StaticNode | RigidNode] = []
        sky: SkyNode | None = None
        for index, facts in enumerate(values["nodes"]):
            if facts["kind"] not in NODES:
                raise InputError("unknown kind of scene node", expected=", ".join(NODES), got=str(facts["kind"]))
            own = {key.partition("/")[2]: value for key, value in groups["nodes"].items() if key.startswith(f"{index}/")}
            node = NODES[facts["kind"]].from_state(facts, own)
            if isinstance(node, SkyNode):
                sky = node
            else:
                nodes.append(node)
        table = Table.from_state(groups["gaussians"])
        owner = table.labels["node"]
        if len(owner) and (int(owner.min()) < 0 or int(owner.max()) >= len(nodes)):
            raise InputError("a Gaussian belongs to no node of the scene", got=f"node {int(owner.max())} of {len(nodes)}")
        classes = tuple(int(value) for value in values["classes"])
        if any(not 0 <= value < len(CLASSES) for value in classes):
            raise InputError("a semantic class does not exist", expected=f"0..{len(CLASSES) - 1}", got=str(classes))
        return cls(table, tuple(nodes), sky, classes, int(values["sh_degree"]), dict(values["facts"]))


def compose(
    model: SceneModel, time_s: float, sh_degree: int | None = None, semantics: bool = True, mirrored: bool = False
) -> Gaussians:
    """All Gaussians of the scene in the world at a time, activated, differentiable in every column.

    Objects that do not exist at that time stay in the rows with opacity 0, so that rows always match the table.

    Args:
        sh_degree: use only bands up to this one (default: all).
        semantics: add the class logits as ``extra`` channels.
        mirrored: show symmetric objects reflected about the plane that runs along and up their boxes.
    """
    table = model.table
    counts = model.counts()
    degree = model.sh_degree if sh_degree is None else min(sh_degree, model.sh_degree)
    means, quats, present = [], [], []
    for node, local_means, local_quats in zip(model.nodes, table["means"].split(counts), table["quats"].split(counts)):
        if mirrored and isinstance(node, RigidNode) and node.symmetric:
            local_means, local_quats = reflected(local_means, local_quats)
        placed = node.place(local_means, local_quats, time_s)
        present.append(1.0 if placed is not None else 0.0)
        world_means, world_quats = placed if placed is not None else (local_means, local_quats)
        means.append(world_means)
        quats.append(world_quats)
    opacity = torch.sigmoid(table["logits"])
    if 0.0 in present:
        gate = torch.tensor(present, dtype=opacity.dtype).repeat_interleave(torch.tensor(counts))
        opacity = opacity * gate
    return Gaussians(
        means=torch.cat(means) if len(means) > 1 else means[0],
        quats=torch.cat(quats) if len(quats) > 1 else quats[0],
        scales=torch.exp(table["log_scales"]),
        opacity=opacity,
        sh=_colors_at(model, time_s, counts),
        sh_rest=table["sh_rest"][:, : (degree + 1) ** 2 - 1] if degree > 0 else None,
        extra=table["semantics"] if semantics and model.classes else None,
        node=table.labels["node"],
    )


def _colors_at(model: SceneModel, time_s: float, counts: Sequence[int]) -> Tensor:
    """Constant band of the colour ``[N, 1, 3]`` at a time: that of moving objects may vary."""
    table = model.table
    if "sh_time" not in table.partial:
        return table["sh_dc"]
    coefficients = table.partial["sh_time"]
    terms = coefficients.shape[1]
    weights = torch.stack([node.color_weights(time_s, terms) for node in model.nodes[1:]]) if len(model.nodes) > 1 else None
    if weights is None:
        return table["sh_dc"]
    rows = weights.to(coefficients.dtype).repeat_interleave(torch.tensor(counts[1:]), 0)
    static, moving = table["sh_dc"].split([counts[0], len(coefficients)])
    return torch.cat([static, moving + (rows[:, :, None] * coefficients).sum(1, keepdim=True)])


def reflected(means: Tensor, quats: Tensor) -> tuple[Tensor, Tensor]:
    """Gaussians reflected about the plane y = 0 of their frame: means ``[n, 3]``, quaternions ``[n, 4]`` (w, x, y, z).

    Axes of an ellipsoid have no direction, so the reflected one is the rotation S R S with S = diag(1, -1, 1).
    """
    return means * means.new_tensor([1.0, -1.0, 1.0]), quats * quats.new_tensor([1.0, -1.0, 1.0, -1.0])


def composite_sky(model: SceneModel, view: View, rgb: Tensor, alpha: Tensor) -> Tensor:
    """Colours ``[3, H, W]`` over the sky: ``rgb + (1 - alpha) * sky``."""
    return rgb if model.sky is None else kernels.over(rgb, alpha, model.sky.coarsely_at(view))


def sky_lift(model: SceneModel, alpha: Tensor) -> tuple[int, Tensor] | None:
    """Channel of the sky among the class logits and what it gains ``[H, W]`` where nothing covers it; None without that class.

    The opacity is taken as it is (no gradient through it from here): classes do not carve geometry.
    """
    return None if ID["sky"] not in model.classes else (model.classes.index(ID["sky"]), SKY_LOGIT * (1 - alpha.detach()[0]))


def composite_semantics(model: SceneModel, extra: Tensor, alpha: Tensor) -> Tensor:
    """Rendered class logits ``[C, H, W]`` with the sky's logit added where nothing covers it (``sky_lift``)."""
    lift = sky_lift(model, alpha)
    return extra if lift is None else extra.index_add(0, torch.tensor([lift[0]], device=extra.device), lift[1][None])


# ---- starting values ---------------------------------------------------------------------------------------------


def voxel_filter(xyz: NDArray[np.float32], size_m: NDArray[np.floating] | float) -> NDArray[np.int64]:
    """Indices of one point per cube of side ``size_m`` (a number, or one per point, taken to powers of sqrt 2), sorted."""
    if np.isscalar(size_m):
        level, cell = np.zeros(len(xyz), np.int64), np.floor(xyz / float(size_m)).astype(np.int64)  # type: ignore[arg-type]
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
    from scipy.spatial import cKDTree

    if len(xyz) < 4:
        return np.full(len(xyz), 0.1, np.float32)
    distance, _ = cKDTree(xyz).query(xyz, k=4, workers=1)
    return np.sqrt((distance[:, 1:] ** 2).mean(1)).clip(smallest_m, largest_m).astype(np.float32)


def columns_from_points(
    xyz: NDArray[np.float32], rgb: NDArray[np.uint8], semantics: NDArray[np.uint8] | None, classes: Sequence[int],
    sh_degree: int, opacity: float = 0.1, scale_m: NDArray[np.float32] | None = None,
) -> dict[str, Tensor]:  # fmt: skip
    """Starting columns for ``N`` coloured points: round, colour of the point, class of the point where known.

    Args:
        xyz: f32[N, 3] metres in the node's frame. rgb: u8[N, 3]. semantics: u8[N] train ids (255 = unknown) or None.
        scale_m: f32[N]; default from the three nearest neighbours.
    """
    count = len(xyz)
    scale = neighbour_scale(xyz) if scale_m is None else scale_m
    logits = np.zeros((count, len(classes)), np.float32)
    if semantics is not None:
        for channel, train_id in enumerate(classes):
            logits[semantics == train_id, channel] = 3.0
    quats = np.zeros((count, 4), np.float32)
    quats[:, 0] = 1.0
    columns = {
        "means": torch.from_numpy(np.array(xyz, np.float32)),
        "quats": torch.from_numpy(quats),
        "log_scales": torch.from_numpy(np.log(scale))[:, None].repeat(1, 3),
        "logits": torch.full((count,), float(np.log(opacity / (1 - opacity)))),
        "sh_dc": torch.from_numpy((rgb.astype(np.float32) / 255 - 0.5) / SH_C0)[:, None],
        "semantics": torch.from_numpy(logits),
    }
    if sh_degree > 0:
        columns["sh_rest"] = torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3)
    return columns


def box_grid(size_m: Sequence[float], rgb: Sequence[float], per_axis: int = 12) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points on the surface of a box, for an object that the LiDAR hardly saw: xyz f32[M, 3] in the box frame, one colour."""
    axis = np.linspace(-0.5, 0.5, per_axis)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    surface = grid[(np.abs(grid) > 0.5 - 1e-9).any(1)]
    xyz = (surface * 0.9 * np.asarray(size_m)).astype(np.float32)
    return xyz, np.broadcast_to(np.asarray(rgb, np.uint8), (len(xyz), 3)).copy()


# ---- quaternions in torch ----------------------------------------------------------------------------------------


def left_product_matrix(quat: Tensor) -> Tensor:
    """``[4, 4]`` matrix L with ``L @ p == quat * p`` (Hamilton product, w x y z)."""
    w, x, y, z = quat.unbind()
    return torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]).view(4, 4)


def rotation_matrix(quat: Tensor) -> Tensor:
    """Rotation ``[3, 3]`` of a quaternion ``[4]``, normalised here."""
    w, x, y, z = (quat / quat.norm()).unbind()
    return torch.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    ).view(3, 3)  # fmt: skip


def slerp(quat0: Tensor, quat1: Tensor, u: float) -> Tensor:
    """Spherical interpolation of unit quaternions ``[4]`` along the shorter arc, differentiable in both."""
    cosine = (quat0 * quat1).sum()
    if cosine.item() < 0:
        quat1, cosine = -quat1, -cosine
    if cosine.item() > 1 - 1e-6:  # nearly equal: the chord is the arc, and arccos has no gradient there
        mixed = (1 - u) * quat0 + u * quat1
        return mixed / mixed.norm()
    angle = torch.arccos(cosine)
    return (torch.sin((1 - u) * angle) * quat0 + torch.sin(u * angle) * quat1) / torch.sin(angle)
