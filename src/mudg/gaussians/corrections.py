"""Corrections that a fit learns: of single images (exposure and colour, camera poses), and of the boxes of dynamic
objects. None of those of images is used when a fitted scene is rendered."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.types import Gaussians, View
from mudg.core import losses
from mudg.core.harmonics import left_product_matrix
from mudg.core.raster.rasterize import RasterConfig, rasterize
from mudg.core.table import Table
from mudg.gaussians import nodes
from mudg.gaussians.model import SceneModel, compose_as_read, composite_sky
from mudg.gaussians.nodes import RigidNode
from mudg.gaussians.rendering import outline_mask
from mudg.gaussians.settings import AppearanceConfig
from mudg.gaussians.views import StoredView

# images -------------------------------------------------------------------------------------------
#
# Two corrections, each optional, each the identity at the start:
#
#     exposure   3x4 affine colour map per camera or per recorded image (Street Gaussians): A rgb + b, an L1 penalty on
#                the distance from the identity. The mean over all maps is held at the identity, so that the scene keeps
#                the average colour of the log instead of drifting against the maps.
#     cameras    6 numbers per recorded image: shift [m] and turn [rad] of the camera in its own frame.

COLOR: Final = "exposure"
POSE: Final = "cameras"


class Appearance:
    """The corrections of a fit. A group that is off is absent from ``tables``. ``names``: per group, what has a
    correction of its own: cameras or images. ``tables``: per group, one row per name: ``affine`` [n, 3, 4] (difference
    from the identity), or ``shift`` [n, 3] metres and ``turn`` [n, 3] radians; None = identity. InputError: a table
    does not fit its names."""

    def __init__(self, names: Mapping[str, Sequence[str]], tables: Mapping[str, Table] | None = None) -> None:
        self.names = {group: tuple(members) for group, members in names.items() if len(members)}
        self._row = {group: {name: row for row, name in enumerate(members)} for group, members in self.names.items()}
        if tables is None:
            columns = {COLOR: {"affine": (3, 4)}, POSE: {"shift": (3,), "turn": (3,)}}
            identity = lambda group, rows: {name: torch.zeros(rows, *of) for name, of in columns[group].items()}
            tables = {group: Table(identity(group, len(members))) for group, members in self.names.items()}
        self.tables = dict(tables)
        for group, members in self.names.items():
            if group not in self.tables or len(self.tables[group]) != len(members):
                what, expected = "corrections of appearance do not fit their names", f"{len(members)} rows"
                raise InputError(what, where=group, expected=expected)

    @classmethod
    def of_views(cls, recorded: Sequence[str], config: AppearanceConfig) -> Appearance:
        """Corrections for recorded views named ``camera/number``, all the identity."""
        images = tuple(dict.fromkeys(recorded))
        colored = {"none": (), "camera": tuple(dict.fromkeys(map(owner, recorded))), "image": images}[config.exposure]
        return cls({COLOR: colored, POSE: images if config.cameras else ()})

    def __bool__(self) -> bool:
        return bool(self.tables)

    def to(self, device: torch.device) -> Appearance:
        """The same corrections, with their moments, on a device."""
        return Appearance(self.names, {group: table.to(device) for group, table in self.tables.items()})

    def colored(self, rgb: Tensor, name: str, kind: str) -> Tensor:
        """A rendered picture ``[3, H, W]`` as the camera of view ``name`` would show it, differentiable."""
        affine = self._affine(name, kind)
        if affine is None:
            return rgb
        return rgb + torch.addmm(affine[:, 3:], affine[:, :3], rgb.flatten(1)).view_as(rgb)

    def penalty(self, name: str, kind: str) -> Tensor | None:
        """Mean distance of the view's colour map from the identity (scalar), or None where it has none."""
        affine = self._affine(name, kind)
        return None if affine is None else losses.identity_distance(affine)

    def world_from_cam(self, view: View, name: str) -> Tensor | None:
        """Corrected pose f32[4, 4] of a recorded view, differentiable; None where poses are not corrected."""
        row = self._row.get(POSE, {}).get(name)
        if row is None:
            return None
        shift, turn = (self.tables[POSE][column][row] for column in ("shift", "turn"))
        given = torch.from_numpy(view.world_from_cam.copy()).to(shift.dtype)
        return given.to(shift.device, non_blocking=True) @ rigid_motion(shift, turn)

    def _affine(self, name: str, kind: str) -> Tensor | None:
        """Difference ``[3, 4]`` of the view's colour map from the identity."""
        rows = self._row.get(COLOR)
        if rows is None or kind != "recorded":
            return None
        row = rows.get(name, rows.get(owner(name)))
        if row is None:
            raise InputError("a view has no colour map", where=name, expected=", ".join(list(rows)[:8]))
        affine = self.tables[COLOR]["affine"]
        return affine[row] - affine.mean(0)

    def adam_step(self, step: int, rates: Mapping[str, float]) -> None:
        """One Adam step on the rows that have a gradient (the others rest), then gradients are dropped."""
        for table in self.tables.values():
            gradients = [gradient.flatten(1).abs().sum(1) for gradient in table.gradients().values()]
            if gradients:
                table.adam_step(step, rates, torch.stack(gradients).sum(0) > 0)
            table.clear_gradients()

    def state(self) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """JSON values and tensors that rebuild it with its moments."""
        tensors = {
            f"{group}/{key}": value for group, table in self.tables.items() for key, value in table.state().items()
        }
        return {group: list(members) for group, members in self.names.items()}, tensors

    @classmethod
    def from_state(cls, values: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Appearance:
        """Inverse of ``state``."""
        tables = {}
        for group in values:
            own = {key.partition("/")[2]: value for key, value in tensors.items() if key.startswith(f"{group}/")}
            tables[group] = Table.from_state(own)
        return cls({group: tuple(map(str, members)) for group, members in values.items()}, tables)


UNCORRECTED: Final = Appearance({})


def owner(name: str) -> str:
    """Camera of a recorded view: what stands before the last slash of its name."""
    return name.rpartition("/")[0]


def rigid_motion(shift_m: Tensor, turn_rad: Tensor) -> Tensor:
    """Rigid ``[4, 4]`` with translation ``shift_m`` [3] and the rotation about ``turn_rad`` [3] by its length;
    differentiable, also at zero."""
    x, y, z = turn_rad.unbind()
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    top = torch.cat([torch.matrix_exp(skew), shift_m[:, None]], 1)
    return torch.cat([top, torch.eye(4, dtype=top.dtype, device=top.device)[3:]])


# boxes --------------------------------------------------------------------------------------------
#
# A few Gauss-Newton rounds in the course of a fit. A key of a track has four unknowns: a shift along the box's three
# axes, and a yaw. Three kinds of evidence are solved for together, each weighted by its expected error:
#
#     pictures   the rendered colours inside the box's outline should become the recorded ones
#     track      the correction should stay near the track, once the noise of the track is taken out
#                (``RigidNode.settled_offsets``)
#     motion     the correction should accelerate no more than road users do (so neighbouring keys are corrected alike)
#
# What the pictures cannot tell (the yaw of a distant car) therefore stays with the track and its neighbours in time; a
# gradient method that scales its steps to the gradients, as Adam does, walks at random there. Derivatives are
# differences of renders: all objects of a view are displaced together, so a view costs five pictures without gradients.
#
# LiDAR depth is not used: with a known scene, colours alone took 0.13 m of drift to under 0.02 m; with depths beside
# them it stayed above 0.06 m. At the edge of an object a rendered depth is a mean of near and far.

STEPS: tuple[float, ...] = (0.02, 0.02, 0.02, 0.005)
"""Displacements of the differences: metres along x, y, z of the box, radians of yaw."""
TRUST_M, TRUST_RAD = 0.1, 0.02
"""How far from the truth a track may be though it is smooth (drift of a filter, a labeller's taste)."""
LARGEST_M, LARGEST_RAD = 0.2, 0.05
"""A round moves a key by at most this."""
FEWEST_PX = 30
BLUR_PX = 3
COLOR_SIGMA = 0.03
COLOR_SHARE = 1 / 120
"""What one channel of one pixel counts for: neighbours are blurred together, and the model errs where they do."""


class PoseEvidence:
    """Sums of the pictures' normal equations: ``matrix`` f64[K, 4, 4] and ``vector`` f64[K, 4] per key of one object;
    ``views``: number of pictures."""

    def __init__(self, keys: int) -> None:
        self.matrix, self.vector, self.views = np.zeros((keys, 4, 4)), np.zeros((keys, 4)), 0

    def add(
        self, around: tuple[int, int, float] | None, matrix: NDArray[np.float64], vector: NDArray[np.float64]
    ) -> None:
        """Add that of a moment to the two keys around it, by their share in the pose; None: the object is not there."""
        if around is None:
            return
        before, after, u = around
        for key, share in ((before, 1.0 - u), (after, u)):
            self.matrix[key] += share**2 * matrix
            self.vector[key] += share * vector
        self.views += 1


@torch.no_grad()
def refine_poses(
    model: SceneModel, views: Sequence[StoredView], raster: RasterConfig, appearance: Appearance = UNCORRECTED
) -> float:
    """One round for every node that learns its pose, in place. Returns root mean square of the moves, metres."""
    learning = {i: node for i, node in enumerate(model.nodes) if isinstance(node, RigidNode) and node.learn_pose}
    evidence = {index: PoseEvidence(len(node.times_s)) for index, node in learning.items()}
    for stored in views:
        shown = _outlines(learning, stored)
        if shown:
            _add_evidence(model, stored, shown, evidence, raster, appearance)
    moves = [_move(node, evidence[index]) for index, node in learning.items() if evidence[index].views]
    return float(np.sqrt(np.mean(np.concatenate(moves) ** 2))) if moves else 0.0


Outlines = dict[int, tuple[NDArray[np.float64], NDArray[np.bool_]]]
"""By node index: the pose of an object, and bool[H, W], pixels inside the outline of its box that may be used."""


def _outlines(learning: dict[int, RigidNode], stored: StoredView) -> Outlines:
    """The objects that show enough pixels in a view."""
    found: Outlines = {}
    for index, node in learning.items():
        pose = node.pose_matrix(stored.view.time_s)
        mask = None if pose is None else outline_mask(stored.view, pose, node.size_m)
        if pose is None or mask is None:
            continue
        if stored.mask is not None:
            mask = mask & stored.mask
        if mask.sum() >= FEWEST_PX:
            found[index] = pose, mask
    return found


def _add_evidence(
    model: SceneModel,
    stored: StoredView,
    shown: Outlines,
    evidence: dict[int, PoseEvidence],
    raster: RasterConfig,
    appearance: Appearance,
) -> None:
    """Add what one recorded view tells about the objects in it."""
    here = compose_as_read(model, stored.view, stored.readout, semantics=False)
    poses = {index: pose for index, (pose, _) in shown.items()}

    def picture(gaussians: Gaussians) -> Tensor:
        """Blurred colour ``[3, H, W]``."""
        pose = appearance.world_from_cam(stored.view, stored.name)
        drawn = rasterize(gaussians, stored.view, raster, world_from_cam=pose)
        rgb = composite_sky(model, stored.view, drawn.rgb, drawn.alpha)
        return _blurred(appearance.colored(rgb, stored.name, "recorded"))

    color = picture(here)
    target = _blurred(torch.from_numpy(stored.rgb).to(model.device, non_blocking=True).permute(2, 0, 1).float() / 255)
    changes = [(picture(_displaced(here, poses, *move)) - color) / move[1] for move in enumerate(STEPS)]
    missing = target - color
    for index, (_, mask) in shown.items():
        outline = torch.from_numpy(mask).to(model.device, non_blocking=True)
        jacobian = torch.stack([change[:, outline].flatten() for change in changes], 1).double()
        matrix, vector = _normal_equations(jacobian, missing[:, outline].flatten().double())
        evidence[index].add(model.nodes[index].keys_around(stored.view.time_s), matrix, vector)


def _blurred(rgb: Tensor) -> Tensor:
    return F.avg_pool2d(rgb[None], BLUR_PX, stride=1, padding=BLUR_PX // 2, count_include_pad=False)[0]


def _displaced(gaussians: Gaussians, poses: Mapping[int, NDArray[np.float64]], axis: int, step: float) -> Gaussians:
    """The Gaussians with every listed object (node index -> pose) displaced in its own frame along (axis 0..2) or about
    z (axis 3)."""
    means, quats = gaussians.means.clone(), gaussians.quats.clone()
    shift = np.zeros(3)
    if axis < 3:
        shift[axis] = step
    move = geometry.yaw_matrix(step if axis == 3 else 0.0, shift)
    for index, pose in poses.items():
        mine, world = (gaussians.node == index).nonzero()[:, 0], pose @ move @ geometry.invert(pose)
        rotation, shift_m = (
            torch.from_numpy(part).float().to(means.device, non_blocking=True) for part in (world[:3, :3], world[:3, 3])
        )
        means[mine] = means[mine] @ rotation.T + shift_m
        if axis == 3:
            turn = left_product_matrix(torch.from_numpy(geometry.quaternion_from_matrix(world)).float())
            quats[mine] = quats[mine] @ turn.to(quats.device, non_blocking=True).T
    return replace(gaussians, means=means, quats=quats)


def _normal_equations(jacobian: Tensor, missing: Tensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``J^T W J`` and ``J^T W r`` with Huber weights: rows whose residual exceeds two sigma count less.

    Sigma is what the residuals themselves say (median, at least `COLOR_SIGMA`): a model that is still blurred has less
    to say.
    """
    sigma = max(COLOR_SIGMA, 1.4826 * float(missing.abs().median()))
    weight = COLOR_SHARE / sigma**2 * torch.clamp(2 * sigma / missing.abs().clamp_min(1e-9), max=1.0)
    weighted = jacobian * weight[:, None]
    return (jacobian.T @ weighted).cpu().numpy(), (weighted.T @ missing).cpu().numpy()


def _move(node: RigidNode, evidence: PoseEvidence) -> NDArray[np.float64]:
    """Solve for all keys of a track together and move them; returns the moves f64[K, 3] in metres.

    Unknown is the correction c of every key beyond ``settled_offsets``, which have weighed noise against motion
    already: the sum of squares of what the pictures miss, of c in units of `TRUST_M` and `TRUST_RAD`, and of its
    accelerations in usual ones.
    """
    keys, base = len(node.times_s), node.world_from_object
    settled = np.column_stack(node.settled_offsets())
    now = np.column_stack(node.offset_values()) - settled
    system = np.zeros((keys, 4, keys, 4))
    for key in range(keys):
        system[key, :, key, :] = evidence.matrix[key] + np.diag([TRUST_M**-2] * 3 + [TRUST_RAD**-2])
    difference = nodes.second_differences(node.times_s)
    path = np.einsum("mk,kwc->mwkc", difference, base[:, :3, :3]) / nodes.ACCELERATION_M_S2
    system[:, :3, :, :3] += np.einsum("mwkc,mwld->kcld", path, path, optimize=True)
    system[:, 3, :, 3] += difference.T @ difference / nodes.YAW_ACCELERATION_RAD_S2**2
    right = evidence.vector + np.einsum("kcd,kd->kc", evidence.matrix, now)
    found = np.linalg.solve(system.reshape(4 * keys, 4 * keys), right.reshape(4 * keys)).reshape(keys, 4)
    largest = np.array([LARGEST_M] * 3 + [LARGEST_RAD])
    moves = np.clip(found - now, -largest, largest)
    node.add_offsets(moves[:, :3], moves[:, 3])
    return moves[:, :3]
