"""The scene model: one table of Gaussians, the nodes they belong to, a sky; and how they become what is rendered at a
time.

All Gaussians live in **one** row-aligned ``Table`` whose rows are ordered by node, so that composing a moment touches
only what moves. Everything else is passed to the renderer as it is.

Columns of the table (raw, unactivated):

    means [N, 3]      metres, in the node's own frame (world for static, box for rigid)
    quats [N, 4]      (w, x, y, z), any length
    log_scales [N, 3] natural logarithm of metres
    logits [N]        opacity = sigmoid
    sh_dc [N, 1, 3], sh_rest [N, K-1, 3]   spherical harmonics (sh_rest absent at degree 0) of directions in the node's
                                           own frame
    semantics [N, C]  class logits of the classes in ``SceneModel.classes``

and those that a kind of node needs (``baselines/pvg.py``, ...), which its ``at_time`` gets as ``NodeRows.own``.

Label columns: ``node`` i32[N], the index into ``SceneModel.nodes``; of a finished fit also ``certainty``
(``SceneModel.certainty``).
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError
from mudg.base.palette import CLASSES, ID
from mudg.base.types import SAME_COLORS, CameraColors, Gaussians, View
from mudg.core import native_ops
from mudg.core.table import Table
from mudg.core.trajectory import Readout, as_read, moved_by
from mudg.gaussians.nodes import NodeRows, RigidNode, SkyNode, StaticNode

NODES: Final[Mapping[str, str]] = {
    "static": "mudg.gaussians.nodes:StaticNode",
    "rigid": "mudg.gaussians.nodes:RigidNode",
    "deformable": "mudg.gaussians.nodes:DeformableNode",
    "sky": "mudg.gaussians.nodes:SkyNode",
    "vibration": "mudg.baselines.pvg:VibrationNode",
    "deformed": "mudg.baselines.omnire:DeformedNode",
    "deformation": "mudg.baselines.omnire:DeformationField",
    "hexplane": "mudg.baselines.s3gaussian:HexPlaneNode",
    "bezier": "mudg.baselines.bezier:BezierNode",
}
"""Where the class of every kind of node is; those of published methods are imported when a scene has them."""
COLUMNS: Final = frozenset({"means", "quats", "log_scales", "logits", "sh_dc", "sh_rest", "semantics"})
"""Columns that every scene may have; others belong to a kind of node (``NodeRows.own``)."""
CERTAINTY: Final = "certainty"
"""Label column of the table of a finished fit, f16[N]."""
SKY_LOGIT: Final = 10.0
"""Logit of the sky class where nothing covers it; large beside what a Gaussian learns."""


@dataclass
class SceneModel:
    """A fitted, or to be fitted, scene. ``table``: all Gaussians, rows ordered by node; label column ``node`` i32 is
    the index into ``nodes``. ``nodes``: static node first. ``sky``: or None (background black). ``classes``: train ids
    of the semantic channels, in channel order; empty = no semantics. ``sh_degree``: of the colour columns. ``facts``:
    JSON values kept with the model (method, scene id, ...). ``colors``: how the cameras of the log show the Gaussians'
    colours, which are common ones."""

    table: Table
    nodes: tuple[StaticNode | RigidNode, ...]
    sky: SkyNode | None
    classes: tuple[int, ...]
    sh_degree: int
    facts: dict[str, Any] = field(default_factory=dict)
    colors: CameraColors = SAME_COLORS
    _counted: tuple[Tensor, list[int]] | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self.nodes = tuple(node.linked(self.nodes) for node in self.nodes)

    @property
    def device(self) -> torch.device:
        """Where the Gaussians are, and all that is learnt."""
        return self.table.device

    def to(self, device: torch.device) -> SceneModel:
        """The same scene, moments included, on a device; itself if it is there already."""
        if self.device == device:
            return self
        sky, nodes = None if self.sky is None else self.sky.to(device), tuple(node.to(device) for node in self.nodes)
        return replace(self, table=self.table.to(device), nodes=nodes, sky=sky, facts=dict(self.facts))

    def counts(self) -> list[int]:
        """Rows of each node, in order; counted again only when rows were taken or appended."""
        owner = self.table.labels["node"]
        if self._counted is None or self._counted[0] is not owner:
            self._counted = owner, torch.bincount(owner.long(), minlength=len(self.nodes)).tolist()
        return list(self._counted[1])

    @property
    def certainty(self) -> Tensor | None:
        """How well the photographs constrain each Gaussian, f16[N] in [0, 1]; None: not known."""
        return self.table.labels.get(CERTAINTY)

    def sort_rows(self) -> None:
        """Bring rows back into node order after rows were appended (stable)."""
        self.table.take(torch.argsort(self.table.labels["node"], stable=True))

    def node_tables(self) -> dict[str, Table]:
        """The optimisable tables beside the shared one, by name (pose offsets; the sky's panorama)."""
        tables = {f"node.{node.name}": own for node in self.nodes if (own := node.learnt) is not None}
        return tables | ({"sky": self.sky.table} if self.sky is not None else {})

    def node_names(self) -> tuple[str, ...]:
        """Names of the dynamic objects."""
        return tuple(node.name for node in self.nodes if isinstance(node, RigidNode))

    def dynamic_object(self, name: str) -> RigidNode:
        """The node of a dynamic object. UsageError: an object that the scene has no node for (it may be parked, and so
        part of the background)."""
        for node in self.nodes:
            if isinstance(node, RigidNode) and node.name == name:
                return node
        known = ", ".join(self.node_names())
        what = f"the fitted scene has no dynamic object {name!r}"
        raise UsageError(what, expected=f"one of {known}" if known else "a scene with dynamic objects")

    def without_nodes(self, names: Sequence[str]) -> SceneModel:
        """A copy without the named dynamic objects (the rest keeps its parameters, not its moments). UsageError: an
        object that the scene has no node for."""
        gone = [self.dynamic_object(name) for name in names]
        kept = [index for index, node in enumerate(self.nodes) if node not in gone]
        renumber = torch.full((len(self.nodes),), -1, dtype=torch.int32)
        renumber[kept] = torch.arange(len(kept), dtype=torch.int32)
        owner = renumber.to(self.device)[self.table.labels["node"].long()]
        rows = (owner >= 0).nonzero()[:, 0]
        labels = {key: value[rows] for key, value in self.table.labels.items()} | {"node": owner[rows]}
        table = Table({key: value.detach()[rows] for key, value in self.table.columns.items()}, labels)
        return replace(self, table=table, nodes=tuple(self.nodes[i] for i in kept), facts=dict(self.facts))

    def with_nodes(self, nodes: tuple[StaticNode | RigidNode, ...]) -> SceneModel:
        """The same scene with other nodes for the same rows; it shares the table of Gaussians."""
        other = replace(self, nodes=nodes)
        other._counted = self._counted
        return other

    def with_object_moved(self, name: str, object_from_new: NDArray[np.float64]) -> SceneModel:
        """A copy with one dynamic object displaced in its own frame by a rigid 4x4; it shares the table of Gaussians.
        UsageError: an object that the scene has no node for."""
        moved = self.dynamic_object(name)
        nodes = tuple(moved.moved(object_from_new) if node is moved else node for node in self.nodes)
        return replace(self, nodes=nodes, facts=dict(self.facts))

    def state(self) -> tuple[dict[str, Any], dict[str, dict[str, Tensor]]]:
        """JSON values and named groups of tensors (``gaussians``, ``nodes``) that rebuild the model with its
        moments."""
        nodes, tensors = [], {}
        for index, node in enumerate((*self.nodes, *(() if self.sky is None else (self.sky,)))):
            facts, own = node.state()
            nodes.append({"kind": node.kind, **facts})
            tensors |= {f"{index}/{name}": value for name, value in own.items()}
        tensors.setdefault("none", torch.zeros(1))
        values = {"nodes": nodes, "classes": list(self.classes), "sh_degree": self.sh_degree, "facts": self.facts}
        if self.colors.to_common:
            values["camera_colors"] = self.colors.record()
        return values, {"gaussians": self.table.state(), "nodes": tensors}

    @classmethod
    def from_state(cls, values: Mapping[str, Any], groups: Mapping[str, Mapping[str, Tensor]]) -> SceneModel:
        """Inverse of ``state``. InputError: an unknown node kind, a class that does not exist, or rows that belong to
        no node."""
        nodes: list[StaticNode | RigidNode] = []
        sky: SkyNode | None = None
        for index, facts in enumerate(values["nodes"]):
            if facts["kind"] not in NODES:
                raise InputError("unknown kind of scene node", expected=", ".join(NODES), got=str(facts["kind"]))
            prefix = f"{index}/"
            own = {k.removeprefix(prefix): value for k, value in groups["nodes"].items() if k.startswith(prefix)}
            node = pkgutil.resolve_name(NODES[facts["kind"]]).from_state(facts, own)
            if isinstance(node, SkyNode):
                sky = node
            else:
                nodes.append(node)
        table = Table.from_state(groups["gaussians"])
        owner = table.labels["node"]
        if len(owner) and (int(owner.min()) < 0 or int(owner.max()) >= len(nodes)):
            got = f"node {int(owner.max())} of {len(nodes)}"
            raise InputError("a Gaussian belongs to no node of the scene", got=got)
        classes = tuple(int(value) for value in values["classes"])
        if any(not 0 <= value < len(CLASSES) for value in classes):
            raise InputError("a semantic class does not exist", expected=f"0..{len(CLASSES) - 1}", got=str(classes))
        if "semantics" in table.columns and table["semantics"].shape[1:] != (len(classes),):
            what = "the Gaussians have other classes than the scene"
            raise InputError(what, expected=f"{len(classes)} channels", got=str(tuple(table["semantics"].shape)))
        colors = CameraColors.of_record(values["camera_colors"]) if "camera_colors" in values else SAME_COLORS
        return cls(table, tuple(nodes), sky, classes, int(values["sh_degree"]), dict(values["facts"]), colors)


def compose(model: SceneModel, time_s: float, semantics: bool = True) -> Gaussians:
    """All Gaussians of the scene in the world at a time, activated, differentiable in every column. Objects that do not
    exist then stay in the rows with opacity 0. ``semantics``: add the class logits as ``extra`` channels."""
    table, counts = model.table, model.counts()
    whole = {name: table[name] for name in ("means", "quats", "sh_dc", *(["sh_rest"] if model.sh_degree > 0 else []))}
    whole["opacity"] = torch.sigmoid(table["logits"])
    blocks = {name: column.split(counts) for name, column in whole.items()}
    own = {name: column.split(counts) for name, column in table.columns.items() if name not in COLUMNS}
    given, found = [], []
    for index, node in enumerate(model.nodes):
        rows, mine = ({name: parts[index] for name, parts in group.items()} for group in (blocks, own))
        given.append(NodeRows(**rows, own=mine))
        now = node.at_time(given[-1], time_s)
        found.append(replace(given[-1], opacity=given[-1].opacity * 0.0) if now is None else now)

    def column(name: str) -> Tensor:
        """One column of all nodes; a column that no node changed is passed on without a copy."""
        parts = [getattr(rows, name) for rows in found]
        changed = any(part is not getattr(rows, name) for part, rows in zip(parts, given))
        return torch.cat(parts) if changed else whole[name]

    return Gaussians(
        means=column("means"),
        quats=column("quats"),
        scales=torch.exp(table["log_scales"]),
        opacity=column("opacity"),
        sh=column("sh_dc"),
        sh_rest=None if model.sh_degree == 0 else column("sh_rest"),
        extra=table["semantics"] if semantics and model.classes else None,
        node=table.labels["node"],
    )


def compose_as_read(model: SceneModel, view: View, readout: Readout | None, semantics: bool = True) -> Gaussians:
    """``compose`` at a view's time. With a read-out, every Gaussian is where the view's camera, standing still, sees it
    as its rolling shutter did (``core/trajectory.py``); how an object deforms meanwhile is left out."""
    gaussians = compose(model, view.time_s, semantics)
    if readout is None:
        return gaussians
    still, parts = readout.motion(view), []
    for node, means in zip(model.nodes, gaussians.means.split(model.counts())):
        motion = still
        if isinstance(node, RigidNode):
            begin, now, end = (node.pose_matrix(time_s) for time_s in (readout.begin_s, view.time_s, readout.end_s))
            if now is not None:
                first, last = (now if pose is None else pose for pose in (begin, end))
                motion = readout.motion(view, first @ geometry.invert(now), last @ geometry.invert(now))
        parts.append(moved_by(means, torch.from_numpy(motion).to(means)))
    return replace(gaussians, means=as_read(gaussians.means, torch.cat(parts), view))


def composite_sky(model: SceneModel, view: View, rgb: Tensor, alpha: Tensor) -> Tensor:
    """Colours ``[3, H, W]`` over the sky, ``rgb + (1 - alpha) * sky``, as the view's camera shows them."""
    common = rgb if model.sky is None else native_ops.over(rgb, alpha, model.sky.coarse_picture(view))
    return model.colors.image_of(view.camera.name, common)


def sky_lift(model: SceneModel, alpha: Tensor) -> tuple[int, Tensor] | None:
    """Channel of the sky among the class logits and what it gains ``[H, W]`` where nothing covers it; None without that
    class. No gradient goes through the opacity: classes do not carve geometry."""
    if ID["sky"] not in model.classes:
        return None
    return model.classes.index(ID["sky"]), SKY_LOGIT * (1 - alpha.detach()[0])


def composite_semantics(model: SceneModel, extra: Tensor, alpha: Tensor) -> Tensor:
    """Rendered class logits ``[C, H, W]`` with the sky's logit added where nothing covers it (``sky_lift``)."""
    lift = sky_lift(model, alpha)
    return extra if lift is None else extra.index_add(0, torch.full((1,), lift[0], device=extra.device), lift[1][None])
