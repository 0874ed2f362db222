"""The nodes of a scene: a static world, and one node per dynamic object. ``Node.at_time`` is the one place where time
changes a Gaussian: a rigid node moves its rows with its box, a deformable one also within it. A new kind of node is a
class with ``at_time`` and one row in ``model.NODES``."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Final, Self

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.types import Track, View
from mudg.core import harmonics
from mudg.core.harmonics import left_product_matrix, rotation_matrix, slerp
from mudg.core.table import Table

# motion -------------------------------------------------------------------------------------------
#
# A detector puts a box a little wrong at every key, each time anew; a car cannot follow such a path. Two sizes decide:
# that of the noise, which the track itself betrays, and that of usual accelerations. The likeliest path between the two
# minimises a sum of squares (the Whittaker smoother, on second differences), with a tail for sharp manoeuvres.

ACCELERATION_M_S2: Final = 2.0
"""Usual acceleration of road users (standard deviation); hard braking is three to four times as much."""
YAW_ACCELERATION_RAD_S2: Final = 0.3
TAIL: Final = 3.0
FEWEST_KEYS: Final = 8
"""Tracks with fewer keys tell nothing about their noise."""


def second_differences(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix f64[K-2, K] that maps values at K key times to their accelerations (per s^2) at the inner keys."""
    count = len(times_s)
    matrix = np.zeros((max(0, count - 2), count))
    for row in range(count - 2):
        before, after = np.diff(times_s[row : row + 3])
        middle = (before + after) / 2
        matrix[row, row : row + 3] = (1 / (before * middle), -(1 / before + 1 / after) / middle, 1 / (after * middle))
    return matrix


def key_noise(times_s: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation f64[C] of independent noise on the keys ``values`` f64[K, C]; 0 for fewer than `FEWEST_KEYS`
    keys. Third differences are blind to constant acceleration, and the median (Gaussian consistency 0.6745) to single
    jerks."""
    count = len(times_s)
    if count < FEWEST_KEYS:
        return np.zeros(values.shape[1])
    rows = []
    for row in range(count - 3):
        t = times_s[row : row + 4]
        weight = np.array([1 / np.prod([t[i] - t[j] for j in range(4) if j != i]) for i in range(4)])
        rows.append(weight / np.linalg.norm(weight) @ values[row : row + 4])
    return np.median(np.abs(np.stack(rows)), 0) / 0.6745


def motion_weights(accelerations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights [M] of the inner keys, from their accelerations f64[M, C] in units of the usual one: Student's t with
    `TAIL` degrees of freedom instead of a Gaussian, for turning into a side street is rare, not impossible."""
    return (TAIL + 1) / (TAIL + (accelerations**2).mean(1))


def smoothed(
    times_s: NDArray[np.float64], values: NDArray[np.float64], noise: float, acceleration: float
) -> NDArray[np.float64]:
    """The likeliest values f64[K, C] behind noisy keys, given the size of noise and of acceleration (standard
    deviations), by five rounds of reweighted least squares. No noise, or fewer than three keys: as given."""
    if noise <= 0 or len(times_s) < 3:
        return values.copy()
    difference = second_differences(times_s) * (noise / acceleration)
    weights, found = np.ones(len(difference)), values
    for _ in range(5):
        found = np.linalg.solve(np.eye(len(times_s)) + (difference.T * weights) @ difference, values)
        weights = motion_weights(difference @ found / noise)
    return found


# nodes --------------------------------------------------------------------------------------------

LIMBED_LABELS: Final = frozenset(
    "pedestrian person person_sitting child adult cyclist rider bicyclist motorcyclist animal".split()
)
"""Labels of tracks that change their shape while they move."""
SYMMETRIC_LABELS: Final = frozenset("car van truck bus tram train vehicle trailer motorcycle".split())
"""Labels of tracks whose two sides are alike."""
LEAST_NOISE_M: Final = 0.01
LEAST_NOISE_RAD: Final = 0.002
DEFORM_CELLS: Final = (2, 3, 6)
"""Cells of the control grid of a deformable node along, across and up its box."""
DEFORM_SMOOTHING: Final = 0.75
DEFORM_DECAY: Final = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class NodeRows:
    """The Gaussians of one node. ``means``: f32[n, 3] metres. ``quats``: f32[n, 4] (w, x, y, z), any length. Both in
    the frame of the node (world for a static one, box for a rigid one) before ``Node.at_time``, in the world after it.
    ``opacity``: f32[n] in [0, 1]. ``sh_dc``: f32[n, 1, 3], the constant band of the colour. ``own``: raw columns of the
    table, f32[n, ...], that only some kind of node knows. ``sh_rest``: f32[n, K - 1, 3], the bands of the colour that
    depend on the direction of view, or None; directions are those of the node's frame before ``Node.at_time``, of the
    world after it."""

    means: Tensor
    quats: Tensor
    opacity: Tensor
    sh_dc: Tensor
    own: Mapping[str, Tensor] = field(default_factory=dict)
    sh_rest: Tensor | None = None


class Node:
    """What all kinds of node share."""

    learnt: Table | None = None
    """The node's own optimisable table beside the shared one, or None."""

    def at_time(self, rows: NodeRows, time_s: float) -> NodeRows | None:
        """The rows as they are at a time, differentiable in all they hold; None: the node does not exist then."""
        return rows

    def linked(self, nodes: Sequence[StaticNode | RigidNode]) -> Self:
        """The same node as part of a scene of these nodes, for kinds that use what another node learns."""
        return self

    def to(self, device: torch.device) -> Self:
        """The same node with what it learns on a device."""
        return self if self.learnt is None else self.with_values(learnt=self.learnt.to(device))

    def with_values(self, **values: Any) -> Self:
        """The same node with other values of some attributes; it shares all else."""
        other = copy.copy(self)
        vars(other).update(values)
        return other


class StaticNode(Node):
    """Rows already in the world."""

    kind = "static"
    facts: ClassVar[tuple[str, ...]] = ("name",)
    """Attributes that rebuild the node, beside the table of what it learns."""
    short_life: ClassVar[float] = 0.0
    """Life span (column ``log_beta``) above which densification splits a Gaussian in time, below which it copies it."""

    def __init__(self, name: str = "background") -> None:
        self.name = str(name)

    def born_later(self, columns: Mapping[str, Tensor], noise: Tensor, late: bool) -> dict[str, Tensor]:
        """Children of split rows in time; Gaussians without a life span are there at all times."""
        return dict(columns)

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """What rebuilds the node: plain JSON values and tensors."""
        return {name: getattr(self, name) for name in self.facts}, {} if self.learnt is None else self.learnt.state()

    @classmethod
    def from_state(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Self:
        """Inverse of ``state``."""
        learnt = (Table.from_state(tensors),) if tensors else ()
        return cls(*(facts[name] for name in cls.facts), *learnt)


class RigidNode(Node):
    """A tracked dynamic object: rows in the frame of its box, carried by the box's pose.

    The pose at a time comes from the two neighbouring keys of the track. Each key may be corrected by offsets in the
    frame of the box, ``corrected = world_from_object @ (yaw about z, then dx dy dz)``; both neighbours' corrected
    positions and rotations are interpolated (straight line, slerp). Outside the track's span the object does not exist.

    The offsets, one row per key: ``shift`` [K, 3] metres and ``yaw`` [K] radians; ``learn_pose``: whether a fit may
    change them, not by gradient steps but by ``gaussians/corrections.py``. Poses are worked out on the CPU, also where
    the offsets are on another device: a copy is kept here, and what moves the rows at a time goes there once."""

    kind = "rigid"

    def __init__(
        self,
        name: str,
        label: str,
        size_m: Sequence[float],
        times_s: NDArray[np.float64],
        world_from_object: NDArray[np.float64],
        offsets: Table | None = None,
        learn_pose: bool = False,
    ) -> None:
        self.name, self.label, self.learn_pose = name, label, learn_pose
        self.size_m = tuple(float(value) for value in size_m)
        self.times_s = np.asarray(times_s, np.float64)
        self.world_from_object = np.asarray(world_from_object, np.float64)
        keys = len(self.times_s)
        columns = {"shift": torch.zeros(keys, 3), "yaw": torch.zeros(keys), **self._own_columns(keys)}
        self.offsets = offsets or Table(columns)
        self._placements: dict[float, tuple[Tensor, Tensor, Tensor] | None] = {}
        self._mixings: dict[tuple[float, int], Tensor] = {}
        self._copied: tuple[Tensor, Tensor] | None = None
        quats = np.stack([geometry.quaternion_from_matrix(pose) for pose in self.world_from_object])
        self._quats = torch.from_numpy(quats).float()
        self._rotations = torch.from_numpy(self.world_from_object[:, :3, :3].copy()).float()
        self._positions = torch.from_numpy(self.world_from_object[:, :3, 3].copy()).float()

    @classmethod
    def from_track(cls, track: Track, learn_pose: bool = False) -> Self:
        """A node that follows ``track``."""
        size_m, poses = track.size_m.tolist(), track.world_from_object
        return cls(track.id, track.label, size_m, track.times_s, poses, learn_pose=learn_pose)

    def _own_columns(self, keys: int) -> dict[str, Tensor]:
        """Starting values of what a kind of node has per key besides the offsets."""
        return {}

    def _offsets_here(self) -> tuple[Tensor, Tensor]:
        """Shift and yaw on the CPU: the columns themselves, or the copy of those of another device."""
        shift, yaw = self.offsets["shift"], self.offsets["yaw"]
        if shift.device.type == "cpu":
            return shift, yaw
        if self._copied is None:
            self._copied = shift.detach().cpu(), yaw.detach().cpu()
        return self._copied

    def offset_values(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The offsets: shift f64[K, 3] m and yaw f64[K] rad."""
        shift, yaw = (values.detach().double().numpy() for values in self._offsets_here())
        return shift, yaw

    def _key_pose(self, index: int) -> tuple[Tensor, Tensor]:
        """Corrected key: position ``[3]`` and unit quaternion ``[4]`` in the world."""
        shift, yaw = self._offsets_here()
        position = self._positions[index] + self._rotations[index] @ shift[index]
        half = yaw[index] / 2
        zero = torch.zeros_like(half)
        turn = torch.stack([torch.cos(half), zero, zero, torch.sin(half)])
        return position, left_product_matrix(self._quats[index]) @ turn

    def keys_around(self, time_s: float) -> tuple[int, int, float] | None:
        """The two neighbouring keys and the fraction of the way between them (one key twice at its very time); None
        outside."""
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
        """Position ``[3]`` m and unit quaternion ``[4]`` at a time, on the CPU; None outside the span."""
        found = self.keys_around(time_s)
        if found is None:
            return None
        before, after, u = found
        position0, quat0 = self._key_pose(before)
        if before == after:
            return position0, quat0
        position1, quat1 = self._key_pose(after)
        return position0 + u * (position1 - position0), slerp(quat0, quat1, u)

    @torch.no_grad()
    def corrected_keys(self, which: slice = slice(None)) -> NDArray[np.float64]:
        """The keys, or some of them, with their offsets: world_from_object f64[K, 4, 4]."""
        shift, yaw = (values[which].double().numpy() for values in self._offsets_here())
        moves = [geometry.yaw_matrix(float(turn), move) for turn, move in zip(yaw, shift)]
        return self.world_from_object[which] @ np.stack(moves)

    def pose_matrix(self, time_s: float) -> NDArray[np.float64] | None:
        """Corrected world_from_object f64[4, 4] at a time; None outside the span."""
        found = self.keys_around(time_s)
        if found is None:
            return None
        before, after, u = found
        keys = self.corrected_keys(slice(before, after + 1))
        return keys[0] if before == after else geometry.interpolate_pose(keys[0], keys[1], u)

    @torch.no_grad()
    def add_offsets(self, shift_m: NDArray[np.float64], yaw_rad: NDArray[np.float64]) -> None:
        """Move every key by ``shift_m`` [K, 3] and ``yaw_rad`` [K] in the frame of the box, in place."""
        for name, move in (("shift", shift_m), ("yaw", yaw_rad)):
            self.offsets[name].add_(torch.from_numpy(move).float().to(self.offsets.device))
        self._placements.clear()
        self._mixings.clear()
        self._copied = None

    def settle(self) -> None:
        """Set the offsets to ``settled_offsets``: the best guess before any picture was seen."""
        shift, yaw = self.settled_offsets()
        now = self.offset_values()
        self.add_offsets(shift - now[0], yaw - now[1])

    def settled_offsets(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Offsets that take independent noise out of the track, of the size that it betrays itself: shift f64[K, 3] m
        and yaw f64[K] rad."""
        positions = self.world_from_object[:, :3, 3]
        heading = np.unwrap([geometry.yaw_of(pose) for pose in self.world_from_object])
        noise = key_noise(self.times_s, np.column_stack([positions, heading]))
        noise_m = max(float(np.sqrt((noise[:3] ** 2).mean())), LEAST_NOISE_M)
        noise_rad = max(float(noise[3]), LEAST_NOISE_RAD)
        path = smoothed(self.times_s, positions, noise_m, ACCELERATION_M_S2) - positions
        turn = smoothed(self.times_s, heading[:, None], noise_rad, YAW_ACCELERATION_RAD_S2)[:, 0] - heading
        return (self.world_from_object[:, :3, :3].transpose(0, 2, 1) @ path[..., None])[..., 0], turn

    def at_time(self, rows: NodeRows, time_s: float) -> NodeRows | None:
        placement = self._placement(time_s)
        if placement is None:
            return None
        position, rotation_t, product_t = placement
        means = torch.addmm(position, rows.means, rotation_t)
        turned = self._colors_turned(rows.sh_rest, time_s)
        return replace(rows, means=means, quats=rows.quats @ product_t, sh_rest=turned)

    def _colors_turned(self, rest: Tensor | None, time_s: float) -> Tensor | None:
        """Bands of the colour that depend on the direction of view, from the directions of the box to those of the
        world."""
        if rest is None or rest.shape[1] == 0:
            return rest
        key = time_s, math.isqrt(rest.shape[1] + 1) - 1
        if key not in self._mixings:
            with torch.no_grad():
                pose = self.pose_at(time_s)
                if pose is None:
                    return rest
                self._mixings[key] = harmonics.mixing(rotation_matrix(pose[1]), key[1]).to(rest.device)
        return harmonics.turned(rest, self._mixings[key])

    def _placement(self, time_s: float) -> tuple[Tensor, Tensor, Tensor] | None:
        """Position ``[3]``, transposed rotation ``[3, 3]`` and transposed quaternion product ``[4, 4]``, where the rows
        are; remembered per time."""
        if time_s not in self._placements:
            with torch.no_grad():
                pose, device = self.pose_at(time_s), self.offsets.device
            self._placements[time_s] = None
            if pose is not None:
                parts = pose[0], rotation_matrix(pose[1]), left_product_matrix(pose[1])
                if device.type != "cpu":  # by one copy
                    packed = torch.cat([part.flatten() for part in parts]).to(device, non_blocking=True)
                    parts = packed[:3], packed[3:12].view(3, 3), packed[12:].view(4, 4)
                self._placements[time_s] = parts[0], parts[1].T, parts[2].T
        return self._placements[time_s]

    def place_in_box(self, means: Tensor) -> Tensor:
        """Places ``[n, 3]`` in the frame of the box as -1 to 1 within it."""
        return 2 * means / _size_there(self.size_m, means.dtype, means.device)

    def after_step(self, share: float) -> None:
        """Regularise, in place, what a node learns by gradient steps; ``share`` in [0, 1] falls with the learning
        rate."""

    def to(self, device: torch.device) -> Self:
        """See ``Node``. A copy, unless it is there already."""
        if self.offsets.device == device:
            return self
        return self.with_values(offsets=self.offsets.to(device), _placements={}, _mixings={}, _copied=None)

    def moved(self, object_from_new: NDArray[np.float64]) -> Self:
        """A node displaced in its own frame: key poses ``corrected @ object_from_new``; what its rows do inside the box
        stays."""
        columns = {name: value.detach() for name, value in self.offsets.columns.items()}
        columns |= {"shift": torch.zeros_like(columns["shift"]), "yaw": torch.zeros_like(columns["yaw"])}
        keys = self.corrected_keys() @ object_from_new
        return type(self)(self.name, self.label, self.size_m, self.times_s, keys, Table(columns), self.learn_pose)

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """What rebuilds the node: plain JSON values and tensors."""
        facts = {"name": self.name, "label": self.label, "size_m": list(self.size_m), "learn_pose": self.learn_pose}
        tensors = {name: torch.from_numpy(getattr(self, name).copy()) for name in ("times_s", "world_from_object")}
        return facts, tensors | {f"offsets.{key}": value for key, value in self.offsets.state().items()}

    @classmethod
    def from_state(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Self:
        """Inverse of ``state``."""
        offsets = {key.removeprefix("offsets."): value for key, value in tensors.items() if key.startswith("offsets.")}
        name, table = str(facts["name"]), Table.from_state(offsets)
        times, poses = tensors["times_s"].numpy(), tensors["world_from_object"].numpy()
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or (np.diff(times) < 0).any():
            what, where = "the times of an object are out of order", f"times_s of {name}"
            raise InputError(what, where=where, got=str(times.ravel()[:8]))
        fits = poses.shape == (len(times), 4, 4)
        problem = next(filter(None, map(geometry.rigid_problem, poses)), "") if fits else f"shape {poses.shape}"
        if problem or table["shift"].shape != (len(times), 3) or table["yaw"].shape != (len(times),):
            what, where = "the poses of an object do not fit its times", f"world_from_object of {name}"
            expected = f"a rigid pose, a shift and a yaw for each of {len(times)} times"
            raise InputError(what, where=where, got=problem, expected=expected)
        return cls(name, str(facts["label"]), facts["size_m"], times, poses, table, bool(facts["learn_pose"]))


class DeformableNode(RigidNode):
    """A person or a cyclist: a rigid node whose rows also move within the box, differently at every time: by a grid of
    control points that spans it (the corners of `DEFORM_CELLS` cells), each with a displacement at every key of the
    track (free-form deformation, Sederberg & Parry 1986). Column ``deform`` [K, 3, z, y, x], metres in the frame of the
    box, beside those of ``RigidNode``."""

    kind = "deformable"

    def _own_columns(self, keys: int) -> dict[str, Tensor]:
        along, across, up = (cells + 1 for cells in DEFORM_CELLS)
        return {"deform": torch.zeros(keys, 3, up, across, along)}

    def at_time(self, rows: NodeRows, time_s: float) -> NodeRows | None:
        if self.keys_around(time_s) is None:
            return None
        return super().at_time(replace(rows, means=rows.means + self.displacement(rows.means, time_s)), time_s)

    def displacement(self, means: Tensor, time_s: float) -> Tensor:
        """How far rows at ``means`` [n, 3] (frame of the box) are moved at a time, [n, 3] metres; differentiable in
        both."""
        found = self.keys_around(time_s)
        if found is None or len(means) == 0:
            return torch.zeros_like(means)
        before, after, u = found
        control = self.offsets["deform"][before]
        if after != before:
            control = torch.lerp(control, self.offsets["deform"][after], u)
        place = self.place_in_box(means)[None, None, None]
        moved = F.grid_sample(control[None], place, mode="bilinear", padding_mode="border", align_corners=True)
        return moved[0, :, 0, 0].T

    @property
    def learnt(self) -> Table:  # type: ignore[override]
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


@functools.lru_cache(maxsize=256)
def _size_there(size_m: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Size of a box as a tensor, sent to a device once."""
    return torch.tensor(size_m, dtype=dtype).to(device)


def object_node(track: Track, learn_pose: bool = False, deformable: bool = False) -> RigidNode:
    """The node of a dynamic track: with ``deformable``, one that deforms for those who walk or ride; else a rigid
    one."""
    kind = DeformableNode if deformable and track.label.lower() in LIMBED_LABELS else RigidNode
    node = kind.from_track(track, learn_pose)
    if learn_pose:
        node.settle()
    return node


# sky ----------------------------------------------------------------------------------------------


class SkyNode:
    """Colour of the sky by direction, seen wherever nothing covers it: a panorama, column ``panorama`` ``[1, 3, Hs, 2
    Hs]``, raw colours around [0, 1]. Row 0 looks straight up, the last row straight down; the columns run from
    longitude -pi to pi (world x axis in the middle)."""

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

    def coarse_picture(self, view: View) -> Tensor:
        """Sky colour ``[3, h, w]`` on a coarse grid of a view's pixels, to be interpolated between them (the panorama
        is far coarser than an image); differentiable in the panorama."""
        texel_rad = np.pi / self.rows
        stride = int(np.clip(0.7 * texel_rad * min(view.camera.fx, view.camera.fy), 1, 8))
        height, width = -(-view.camera.height // stride), -(-view.camera.width // stride)
        camera, panorama = view.camera.resized(width, height), self.table["panorama"]
        # computed where the panorama is, from plain numbers: nothing is copied there
        columns, rows = (torch.arange(n, dtype=torch.float64, device=panorama.device) + 0.5 for n in (width, height))
        across, down = geometry.pinhole_ray(camera.intrinsics, columns, rows)
        pose = view.world_from_cam[:3, :3].tolist()
        x, y, z = (across * right + (down[:, None] * below + ahead) for right, below, ahead in pose)
        longitude, elevation = torch.atan2(y, x), torch.atan2(z, torch.hypot(x, y))
        padded, texels = F.pad(panorama, (1, 1, 0, 0), mode="circular"), 2 * self.rows
        grid = torch.stack([(longitude / np.pi) * texels / (texels + 2), -2 * elevation / np.pi], -1)
        grid = grid.float().to(panorama.dtype)[None]
        return F.grid_sample(padded, grid, mode="bilinear", padding_mode="border", align_corners=False)[0]

    def fill(self, measured: Iterable[tuple[NDArray[np.float64], NDArray[np.float32]]]) -> None:
        """Start from measured sky colours: mean per texel; texels nobody saw take the nearest seen one's colour.
        ``measured``: portions of directions in the world ``[M, 3]`` and their colours f32[M, 3] in [0, 1]. How they are
        divided makes no difference."""
        rows, columns = self.rows, 2 * self.rows
        total, count = np.zeros((3, rows * columns)), np.zeros(rows * columns)
        for directions_world, rgb in measured:
            longitude = np.arctan2(directions_world[:, 1], directions_world[:, 0])
            elevation = np.arctan2(directions_world[:, 2], np.hypot(directions_world[:, 0], directions_world[:, 1]))
            grid = np.stack([longitude / np.pi, -2 * elevation / np.pi], -1).astype(np.float32)
            column = np.clip(((grid[:, 0] + 1) / 2 * columns).astype(np.int64), 0, columns - 1)
            row = np.clip(((grid[:, 1] + 1) / 2 * rows).astype(np.int64), 0, rows - 1)
            texel = row * columns + column
            count += np.bincount(texel, minlength=rows * columns)
            for channel in range(3):  # one after the other, as a single sum over all portions would be
                np.add.at(total[channel], texel, rgb[:, channel].astype(np.float64))
        if not count.any():
            return
        mean = total / np.maximum(count, 1)
        rows_of, columns_of = _nearest((count > 0).reshape(rows, columns))
        filled = mean.reshape(3, rows, columns)[:, rows_of, columns_of]
        self.table.columns["panorama"].detach().copy_(torch.from_numpy(filled).float()[None])

    def continued(self, unknown: NDArray[np.bool_], seen: NDArray[np.bool_]) -> SkyNode:
        """The same sky with unknown texels bool[Hs, 2 Hs] in the colour of the nearest seen one; itself where none
        is."""
        if not unknown.any() or not seen.any():
            return self
        rows_of, columns_of = (torch.from_numpy(index).to(self.table.device) for index in _nearest(seen))
        panorama = self.table["panorama"].detach()
        chosen = torch.from_numpy(unknown).to(panorama.device)
        return SkyNode(Table({"panorama": torch.where(chosen, panorama[:, :, rows_of, columns_of], panorama)}))

    def to(self, device: torch.device) -> SkyNode:
        """The same sky on a device."""
        return SkyNode(self.table.to(device))

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """What rebuilds the sky: plain JSON values and tensors."""
        return {"name": "sky"}, self.table.state()

    @classmethod
    def from_state(cls, facts: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> SkyNode:
        """Inverse of ``state``."""
        return cls(Table.from_state(tensors))


def _nearest(seen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column i64[H, W] of the nearest texel that was seen; longitude wraps round."""
    columns = seen.shape[1]
    nearest = distance_transform_edt(~np.tile(seen, 3), return_distances=False, return_indices=True)
    middle = np.asarray(nearest, np.int64)[:, :, columns : 2 * columns]
    return middle[0], middle[1] % columns
