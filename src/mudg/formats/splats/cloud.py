"""What files of Gaussians hold: Gaussians of one frame, the objects that they belong to, how these move, the sky."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.core import harmonics

# axes ---------------------------------------------------------------------------------------------
# Where x, y and z of a file point: three letters of Left, Right, Up, Down, Forward and Back, as seen along the road.
# ``RDF`` is x right, y down, z forward. The axes of this program are ``FLU``.


_WAYS: Final = {
    "F": ("forward", (1.0, 0.0, 0.0)),
    "B": ("back", (-1.0, 0.0, 0.0)),
    "L": ("left", (0.0, 1.0, 0.0)),
    "R": ("right", (0.0, -1.0, 0.0)),
    "U": ("up", (0.0, 0.0, 1.0)),
    "D": ("down", (0.0, 0.0, -1.0)),
}
WORLD: Final = "FLU"
VERTICAL: Final = {"z": WORLD, "-z": "FRD", "x": "UFL", "-x": "DFR", "-y": "RDF"}
"""Axes of which only the vertical one is known; where forward is, is chosen. ``y`` alone is ambiguous: programs that
mean down write it."""


def known(axes: str) -> bool:
    """Whether three letters name three directions at right angles."""
    named = len(axes) == 3 and all(letter in _WAYS for letter in axes)
    return named and abs(np.linalg.det(world_from_axes(axes))) > 0.5


def world_from_axes(axes: str) -> NDArray[np.float64]:
    """f64[3, 3], columns are the axes of a file in those of this program; of determinant -1 where they are
    left-handed."""
    return np.array([_WAYS[letter][1] for letter in axes]).T


def in_words(axes: str) -> str:
    """``RDF`` as *x right, y down, z forward*."""
    return ", ".join(f"{axis} {_WAYS[letter][0]}" for axis, letter in zip("xyz", axes))


# cloud --------------------------------------------------------------------------------------------

MAX_GAUSSIANS: Final = 50_000_000
LARGEST_M: Final = 1e8
"""Places and sizes beyond this are damage."""
LEAST_LOG: Final = -40.0
MOST_LOG: Final = 18.0
"""Natural logarithms of a size in metres outside of these are damage; zero sizes of files become the smallest."""
MOST_LOGIT: Final = 12.0
"""Opacities of 0 and 1 in files of bytes become this far."""

Matrix = NDArray[np.float64]
Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class SplatCloud:
    """Gaussians of one frame. ``means``: f32[n, 3] metres; f64 from a reader, until an origin near them is taken away.
    ``quats``: f32[n, 4] (w, x, y, z) of length 1. ``log_scales``: f32[n, 3], natural logarithm of metres. ``logits``:
    f32[n], opacity = sigmoid. ``sh``: f32[n, K, 3], K = 1, 4, 9 or 16 harmonics of directions of this frame.
    ``class_ids``: u8[n] train ids (255 = unknown), or None. ``antialias``: they are to be drawn antialiased."""

    means: Floats | Matrix
    quats: Floats
    log_scales: Floats
    logits: Floats
    sh: Floats
    class_ids: NDArray[np.uint8] | None = None
    antialias: bool = False

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return harmonics.degree_of(self.sh.shape[1])

    @property
    def opacity(self) -> Floats:
        """f32[n] in [0, 1]."""
        return sigmoid(self.logits)

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> SplatCloud:
        """Some rows, in the order given."""
        classes = None if self.class_ids is None else self.class_ids[rows]
        columns = (self.means[rows], self.quats[rows], self.log_scales[rows], self.logits[rows], self.sh[rows])
        return SplatCloud(*columns, class_ids=classes, antialias=self.antialias)

    def moved(self, a_from_b: Matrix) -> SplatCloud:
        """The same Gaussians in another frame: places, rotations and harmonics; ``a_from_b`` rigid f64[4, 4]."""
        turn = geometry.quaternion_from_matrix(a_from_b)
        sh = self.sh if self.degree == 0 else harmonics.rotated(self.sh, a_from_b[:3, :3])
        means = geometry.transform_points(a_from_b, self.means)
        return replace(self, means=means, quats=turned(turn, self.quats), sh=sh)

    def mirrored(self) -> SplatCloud:
        """The same Gaussians with y turned round: from left-handed axes to right-handed ones."""
        flip = np.array([1.0, -1.0, 1.0])
        quats = self.quats * np.array([1, -1, 1, -1], np.float32)  # an axis of rotation changes its sign once more
        sh = self.sh if self.degree == 0 else harmonics.rotated(self.sh, np.diag(flip))
        return replace(self, means=(self.means * flip).astype(self.means.dtype), quats=quats, sh=sh)

    def of_degree(self, degree: int) -> SplatCloud:
        """The same with harmonics of this degree: what is missing is zero, what is beyond is dropped."""
        wanted = (degree + 1) ** 2
        if wanted == self.sh.shape[1]:
            return self
        sh = np.zeros((len(self), wanted, 3), np.float32)
        kept = min(wanted, self.sh.shape[1])
        sh[:, :kept] = self.sh[:, :kept]
        return replace(self, sh=sh)


def joined(clouds: Sequence[SplatCloud]) -> SplatCloud:
    """Several clouds of one frame as one, of the highest degree among them; classes are kept where one of them has
    some."""
    if len(clouds) == 1:
        return clouds[0]
    degree = max(cloud.degree for cloud in clouds)
    parts, classes = [cloud.of_degree(degree) for cloud in clouds], None
    if any(cloud.class_ids is not None for cloud in parts):
        classes = np.concatenate(
            [np.full(len(c), 255, np.uint8) if c.class_ids is None else c.class_ids for c in parts]
        )
    names = ("means", "quats", "log_scales", "logits", "sh")
    columns = [np.concatenate([getattr(cloud, name) for cloud in parts]) for name in names]
    return SplatCloud(*columns, class_ids=classes, antialias=any(cloud.antialias for cloud in parts))


@dataclass(frozen=True, slots=True, eq=False)
class SplatFile:
    """What the reader of a format finds in a file: Gaussians in its axes, ``means`` f64. ``axes``: where x, y and z of
    the file point, a letter each, as ``axes_by`` states them; empty: nothing does. ``step_m``: distance of neighbouring
    numbers in which most places are stored; 0 = not worth a word. ``notes``: what a person may want to know.
    ``warnings``: what may have come in otherwise than its program meant it."""

    cloud: SplatCloud
    axes: str = ""
    axes_by: str = ""
    step_m: float = 0.0
    notes: Sequence[str] = ()
    warnings: Sequence[str] = ()


@dataclass(frozen=True, slots=True, eq=False)
class SplatNode:
    """Gaussians that move together, in the node's own frame. ``name``: of the object; the first node of a scene is what
    stands. ``label``: its class, empty for what stands. ``size_m``: length, width, height of its box. ``times_s``,
    ``world_from_node``: keys of its path, f64[K] and f64[K, 4, 4]; before the first and after the last it does not
    exist, between keys are straight lines and slerp. No keys: it is always there, in the world. ``displacement``:
    f32[K, n, 3] metres in the node's frame, what its Gaussians are moved by at every key; or None."""

    name: str
    cloud: SplatCloud
    label: str = ""
    size_m: tuple[float, float, float] = (1.0, 1.0, 1.0)
    times_s: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    world_from_node: Matrix = field(default_factory=lambda: np.zeros((0, 4, 4)))
    displacement: Floats | None = None

    @property
    def moves(self) -> bool:
        """Whether it has a path."""
        return len(self.times_s) > 0

    def at(self, time_s: float) -> SplatCloud | None:
        """Its Gaussians in the world at a time; None where it does not exist."""
        if not self.moves:
            return self.cloud
        pose = geometry.pose_at(self.times_s, self.world_from_node, time_s)
        if pose is None:
            return None
        cloud = self.cloud
        if self.displacement is not None:
            after = int(np.searchsorted(self.times_s, time_s).clip(1, max(len(self.times_s) - 1, 1)))
            before, after = after - 1, min(after, len(self.times_s) - 1)
            span = self.times_s[after] - self.times_s[before]
            u = float(np.clip((time_s - self.times_s[before]) / span, 0, 1)) if span > 0 else 0.0
            moved = (1 - u) * self.displacement[before] + u * self.displacement[after]
            cloud = replace(cloud, means=(cloud.means + moved).astype(np.float32))
        return cloud.moved(pose)


@dataclass(frozen=True, slots=True, eq=False)
class SplatScene:
    """What is written to a file of a whole scene. ``nodes``: in world axes; what stands first. ``file_from_world``:
    rigid f64[4, 4], from the axes of this program to those of the file. ``sky``: u8[H, 2 H, 3] panorama, zenith in row
    0, columns from longitude -pi to pi (growing to the left as one looks), or None. ``facts``: JSON values for people
    (method, times, versions)."""

    name: str
    nodes: tuple[SplatNode, ...]
    file_from_world: Matrix = field(default_factory=lambda: np.eye(4))
    sky: NDArray[np.uint8] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def degree(self) -> int:
        """Highest degree of its nodes."""
        return max(node.cloud.degree for node in self.nodes)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last key of what moves; (0, 0) if nothing does."""
        keys = [node.times_s for node in self.nodes if node.moves]
        return (0.0, 0.0) if not keys else (min(float(k[0]) for k in keys), max(float(k[-1]) for k in keys))

    def at(self, time_s: float) -> SplatCloud:
        """All Gaussians at a time, in the axes of the file."""
        there = [cloud for node in self.nodes if (cloud := node.at(time_s)) is not None]
        whole = joined(there) if there else self.nodes[0].cloud.take(np.zeros(0, np.intp))
        return whole if np.array_equal(self.file_from_world, np.eye(4)) else whole.moved(self.file_from_world)


# -- numbers ---------------------------------------------------------------------------------------


def sigmoid(logits: Floats) -> Floats:
    """Opacity of a logit."""
    return (1 / (1 + np.exp(-logits.astype(np.float64)))).astype(np.float32)


def logit(opacity: NDArray[np.floating]) -> Floats:
    """Logit of an opacity; 0 and 1 become `MOST_LOGIT` away from 0."""
    o = np.asarray(opacity, np.float64).clip(1e-12, 1 - 1e-12)
    return np.log(o / (1 - o)).clip(-MOST_LOGIT, MOST_LOGIT).astype(np.float32)


def logarithms(sizes: Matrix, where: str) -> Matrix:
    """Natural logarithms of sizes in metres [n, 3], of 0 the smallest. Raises InputError: a negative one."""
    what, remedy = "the size of a Gaussian is negative", "they look like logarithms: write exp(scale) into the file"
    refuse_rows((sizes < 0).any(1), what, where, sizes, "metres", remedy)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.maximum(np.log(sizes), LEAST_LOG)


def refuse_rows(bad: Any, what: str, where: str, values: NDArray[Any], expected: str = "", remedy: str = "") -> None:
    """InputError for the first Gaussian that is ``bad`` (bool[n]), if one is, with its ``values`` [n, c]."""
    if bad.any():
        row = int(bad.argmax())
        got = f"{values[row].tolist()[:6]}; {int(bad.sum())} of {len(bad)} are damaged"
        raise InputError(what, where=f"{where}: Gaussian {row}", expected=expected, got=got, remedy=remedy)


def turned(turn: NDArray[np.floating], quats: Floats) -> Floats:
    """Hamilton product of a quaternion [4] and quaternions [n, 4] (w, x, y, z)."""
    w, x, y, z = (float(value) for value in turn)
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return (quats.astype(np.float64) @ left.T).astype(np.float32)


def unit(quats: NDArray[np.floating], where: str) -> Floats:
    """Quaternions of length 1; InputError for one without a direction."""
    q = np.asarray(quats, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt((q * q).sum(1, keepdims=True))
    bad = ~(np.isfinite(length[:, 0]) & (length[:, 0] > 1e-12))
    expected, remedy = "four finite numbers, not all 0", "take them out, or write 1, 0, 0, 0"
    refuse_rows(bad, "a rotation is no quaternion", where, q, expected, remedy)
    return (q / length).astype(np.float32)


def checked(cloud: SplatCloud, where: str) -> SplatCloud:
    """A cloud as it was read, rotations brought to length 1. Opacities of exactly 0 and 1 and sizes of 0, whose logits
    and logarithms are infinite, become the nearest that can be worked with. Raises InputError: values that are not
    finite, or places and sizes that nothing has."""
    if len(cloud) == 0:
        raise InputError("the file holds no Gaussians", where=where)
    logits = np.nan_to_num(cloud.logits, nan=np.nan, posinf=MOST_LOGIT, neginf=-MOST_LOGIT)
    logs = np.where(np.isneginf(cloud.log_scales), np.float32(LEAST_LOG), cloud.log_scales)
    cloud = replace(cloud, logits=logits, log_scales=logs)
    columns = {"position": cloud.means, "scale": cloud.log_scales, "opacity": cloud.logits[:, None]}
    columns["color"] = cloud.sh.reshape(len(cloud), -1)
    remedy = "take them out, for example with splat-transform --filter-nan"
    for name, values in columns.items():
        bad = ~np.isfinite(values).all(1)
        refuse_rows(bad, f"the {name} of a Gaussian is not finite", where, values, remedy=remedy)
    far = (np.abs(cloud.means) > LARGEST_M).any(1) | (cloud.log_scales > MOST_LOG).any(1)
    expected = f"positions within {LARGEST_M:g} m, logarithms of sizes below {MOST_LOG:g}"
    values = np.concatenate([cloud.means, cloud.log_scales], 1)
    refuse_rows(far, "a Gaussian lies or reaches too far away", where, values, expected)
    return replace(cloud, quats=unit(cloud.quats, where), log_scales=cloud.log_scales.clip(LEAST_LOG))


def spacing_m(places: NDArray[np.floating], kind: type[np.floating] = np.float32) -> float:
    """Distance of neighbouring numbers of a kind, at the farthest places [n, 3] but for a tenth: outliers are far
    anyway."""
    return float(np.spacing(kind(np.quantile(np.abs(places).max(1), 0.9))))


def doubtful_values(cloud: SplatCloud, where: str) -> list[str]:
    """Sentences on values that a format stores as logarithms and logits, and that look as if they had not been taken.
    Raises InputError: neither sizes nor opacities can be what the format says."""
    plain_opacity = bool((cloud.logits >= 0).all() and (cloud.logits <= 1).all() and (cloud.logits > 0).any())
    plain_size = bool((cloud.log_scales[:, :2] > 0).all())  # the third is that of flat Gaussians
    if plain_opacity and plain_size:
        what = "sizes and opacities are plain values, where files of Gaussians hold logarithms and logits"
        expected = "negative numbers for sizes below 1 m and opacities below 0.5"
        got = f"sizes from {cloud.log_scales[:, :2].min():.3g}, opacities from {cloud.logits.min():.3g} to"
        remedy = "write log(scale) and log(opacity / (1 - opacity)) into the file"
        raise InputError(what, where=where, expected=expected, got=f"{got} {cloud.logits.max():.3g}", remedy=remedy)
    found, fog, stored = [], "if it looks like fog, write", "had been stored where"
    if plain_opacity:
        doubt = f"all opacities lie between 0.5 and 0.73, as if values from 0 to 1 {stored} logits are due"
        found.append(f"{doubt}: {fog} log(opacity / (1 - opacity)) into the file")
    if plain_size:
        doubt = f"all Gaussians are wider than 1 m, as if sizes {stored} their logarithms are due"
        found.append(f"{doubt}: {fog} log(scale) into the file")
    if (cloud.logits >= 0).all() and cloud.logits.max() > 2 * MOST_LOGIT:
        doubt = f"opacities reach {cloud.logits.max():.4g}, as if values from 0 to 255 {stored} logits are due"
        found.append(f"{doubt}: all Gaussians count as solid")
    if np.median(np.abs(cloud.sh[:, 0])) > 8:
        doubt = "colours lie far beyond black and white, as if values from 0 to 255 had been stored as f_dc"
        found.append(f"{doubt}: write (colour / 255 - 0.5) / 0.2821 into the file")
    return found


def each_once(names: Iterable[str]) -> list[str]:
    """Names that differ: the second of one name is NAME_2."""
    chosen: list[str] = []
    for name in names:
        candidate, count = name, 1
        while candidate in chosen:
            count += 1
            candidate = f"{name}_{count}"
        chosen.append(candidate)
    return chosen
