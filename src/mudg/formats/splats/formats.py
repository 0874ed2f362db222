"""The table of formats: what each is called, which axes its readers expect, what it carries, who writes and reads
it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry, log
from mudg.base.errors import InputError
from mudg.base.types import Scene
from mudg.core.edit import HeightMap
from mudg.core.harmonics import C0
from mudg.formats.exporters.alpasim import to_alpasim
from mudg.formats.splats import binary, gltf, ply, sog, spz, usd
from mudg.formats.splats import cloud as axes
from mudg.formats.splats.cloud import (
    SplatCloud,
    SplatFile,
    SplatNode,
    SplatScene,
    checked,
    doubtful_values,
    logarithms,
    logit,
    spacing_m,
)

# splat, of web viewers: f32 x y z, scales (metres); u8 r g b (of degree 0), opacity, round((wxyz + 1) / 2 * 255) ------


_SPLAT_ROW: Final = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def splat_bytes(cloud: SplatCloud) -> bytes:
    """A cloud as a .splat file, large and opaque Gaussians first: viewers show them while they load."""
    order = np.argsort(-(np.exp(cloud.log_scales.sum(1).astype(np.float64)) * cloud.opacity), kind="stable")
    cloud = cloud.take(order)
    rows = np.zeros(len(cloud), _SPLAT_ROW)
    rows["means"], rows["scales"] = cloud.means, np.exp(cloud.log_scales.astype(np.float64))
    color = np.concatenate([cloud.sh[:, 0] * C0 + 0.5, cloud.opacity[:, None]], 1)
    rows["rgba"] = np.round(color * 255).clip(0, 255)
    rows["quats"] = np.round((cloud.quats + 1) / 2 * 255).clip(0, 255)
    return rows.tobytes()


def splat_from_bytes(content: bytes, where: str) -> SplatFile:
    """The Gaussians of a .splat file. Raises InputError: no such file, or a damaged one."""
    if len(content) % _SPLAT_ROW.itemsize:
        what, got = "the length of a .splat file is a multiple of 32 bytes", f"{len(content)} bytes"
        raise InputError(what, where=where, got=got, remedy="it was cut off, or is another kind of file")
    binary.refuse_count(len(content) // _SPLAT_ROW.itemsize, where)
    rows = np.frombuffer(content, _SPLAT_ROW)
    logs, rgba = logarithms(rows["scales"].astype(np.float64), where), rows["rgba"] / 255
    stated = (rows["quats"] / 255 * 2 - 1, logs, logit(rgba[:, 3]), (rgba[:, None, :3] - 0.5) / C0)
    quats, logs, logits, sh = (values.astype(np.float32) for values in stated)
    cloud = checked(SplatCloud(rows["means"].astype(np.float64), quats, logs, logits, sh), where)
    return SplatFile(cloud, step_m=spacing_m(rows["means"]))


# formats -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class WriteRequest:
    """What is to be written. ``scene``: with the axes of the file. ``time_s``: the moment, or None = all of the motion.
    ``log``: whose cameras are listed, where a format can. ``ground``: where a format needs it. ``road``: points f[N, 3]
    of the road's surface, where a format holds a map."""

    scene: SplatScene
    time_s: float | None
    log: Scene | None = None
    ground: HeightMap | None = None
    road: NDArray[np.floating] | None = None

    @property
    def cloud(self) -> SplatCloud:
        """All Gaussians at the moment."""
        return self.scene.at(0.0 if self.time_s is None else self.time_s)

    @property
    def drawing(self) -> Mapping[str, object]:
        """How the fit draws Gaussians, where that is not the usual way."""
        return self.scene.facts.get("drawing", {})

    @property
    def antialias(self) -> bool:
        """Whether the fit draws antialiased."""
        return bool(self.drawing.get("antialias", False))

    @property
    def marks(self) -> list[str]:
        """Comments of a PLY file on what differs from the usual one: drawing, and the axes of this program."""
        z_up = np.array_equal(self.scene.file_from_world, np.eye(4))
        return ["SplatRenderMode: mip"] * self.antialias + ["Vertical Axis: z"] * z_up


@dataclass(frozen=True, slots=True, eq=False)
class SplatFormat:
    """One format. ``suffixes``: of its files, the usual one first. ``axes``: of ``cloud.py``, what its readers expect.
    ``write``: bytes of a request. ``read``: Gaussians of bytes, or None: not read. ``carries``: of ``motion``,
    ``deformation``, ``classes``, ``sky``, ``harmonics``, ``antialias``."""

    suffixes: tuple[str, ...]
    axes: str
    write: Callable[[WriteRequest], bytes]
    read: Callable[[bytes, str], SplatFile] | None
    carries: frozenset[str]


_STILL: Final = frozenset(("harmonics", "antialias"))
_MOVING: Final = frozenset(("harmonics", "motion", "deformation", "classes"))

FORMATS: Final[Mapping[str, SplatFormat]] = {
    "ply": SplatFormat(
        (".ply",), "RDF", lambda r: ply.to_bytes(r.cloud, True, r.marks), ply.from_bytes, _STILL | {"classes"}
    ),
    "spz": SplatFormat((".spz",), "RUB", lambda r: spz.to_bytes(r.cloud, r.antialias), spz.from_bytes, _STILL),
    "glb": SplatFormat(
        (".glb",), "FUR", lambda r: gltf.to_bytes(r.scene, r.time_s), gltf.from_bytes, _STILL | {"motion"}
    ),
    "usda": SplatFormat(
        (".usda", ".usd"), axes.WORLD, lambda r: usd.to_text(r.scene, r.time_s, log=r.log), None, _MOVING
    ),
    "usdz": SplatFormat(
        (".usdz",), axes.WORLD, lambda r: usd.to_package(r.scene, r.time_s, r.log), None, _MOVING | {"sky"}
    ),
    "alpasim": SplatFormat(
        (".usdz",), axes.WORLD, lambda r: to_alpasim(r.scene, r.log, r.ground, r.road), None, _MOVING | {"sky"}
    ),
    "compressed-ply": SplatFormat(
        (".compressed.ply", ".ply"),
        "RDF",
        lambda r: ply.compressed_to_bytes(r.cloud, r.marks),
        ply.compressed_from_bytes,
        _STILL,
    ),
    "sog": SplatFormat((".sog",), "RDF", lambda r: sog.to_bytes(r.cloud, r.antialias), sog.from_bytes, _STILL),
    "splat": SplatFormat((".splat",), "RDF", lambda r: splat_bytes(r.cloud), splat_from_bytes, frozenset()),
}


_READERS: Final = {name: one.read for name, one in FORMATS.items() if one.read}
COARSE_M: Final = 1e-3
"""Steps between places beyond this are worth a word."""
_UNREAD: Final[Mapping[str, str]] = {
    ".json": "give the .sog file that holds meta.json and its pictures (splat-transform meta.json out.sog)",
    ".gltf": "pack it with its buffers into a .glb file",
    **dict.fromkeys((".ksplat", ".lcc"), "convert it, for example with splat-transform in.ksplat out.ply"),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "export it again as ply, spz or glb"),
    **dict.fromkeys((".ckpt", ".pt", ".pth", ".npz"), "export PLY from the program that trained the Gaussians"),
}
"""What to do with files of Gaussians, or that come with them, that are not read."""


def file_from_world(name: str, choice: str) -> NDArray[np.float64]:
    """From the axes of this program to those of a format (``viewer``), f64[4, 4]; ``world``: no change."""
    turn = axes.world_from_axes(axes.WORLD if choice == "world" else FORMATS[name].axes).T
    return geometry.from_rotation_translation(turn, (0.0, 0.0, 0.0))


def format_of(content: bytes, name: str) -> str:
    """Which format a file is, by its first bytes, or by its name where it has no mark. Raises InputError: none that is
    read."""
    suffix = PurePath(name).suffix.lower()
    if content[:3] == b"ply":
        header = content[: content.find(b"end_header", 0, ply.MAX_HEADER) + 1]
        return "compressed-ply" if b"element chunk" in header else "ply"
    for mark, found in ((b"\x1f\x8b", "spz"), (b"NGSP", "spz"), (b"glTF", "glb"), (b"PK\x03\x04", "sog")):
        if content.startswith(mark) and suffix != ".usdz":
            return found
    if suffix == ".splat":
        return "splat"
    known = ", ".join(sorted({suffix for one in _READERS for suffix in FORMATS[one].suffixes}))
    what, got = "this is no file of Gaussians that can be read", f"it begins with {content[:8]!r}"
    raise InputError(what, where=name, expected=known, got=got, remedy=_UNREAD.get(suffix, ""))


def read_cloud(content: bytes, name: str, choice: str = "file") -> tuple[SplatCloud, str]:
    """The Gaussians of a file in the axes of this program (z up), and the name of its format; ``means`` f64: take an
    origin near them away before they become f32. Says on stderr what was passed over or taken with doubt. ``name``: of
    the file, for messages and for formats without a mark. ``choice``: of axes. ``file``: what the file says, else those
    that viewers of its format expect; ``viewer``: these; ``world``: those of this program; or letters of ``cloud.py``.
    Raises InputError: another or a damaged file. ResourceError: a package that this file needs is not installed."""
    found = format_of(content, name)
    with np.errstate(over="ignore", invalid="ignore"):  # readers check what comes of numbers that overflow or are none
        file = _READERS[found](content, name)
        doubts = doubtful_values(file.cloud, name)
    usual = {"viewer": FORMATS[found].axes, "world": axes.WORLD, "file": file.axes or FORMATS[found].axes}
    chosen = usual.get(choice, choice)
    for note in file.notes:
        log.info(f"{name}: {note}")
    for warning in (*file.warnings, *doubts):
        log.warn(f"{name}: {warning}")
    if file.axes and file.axes != chosen:
        stated = f"{file.axes_by} says {axes.in_words(file.axes)}"
        log.warn(f"{name}: {stated}; --axes {choice} reads it as {axes.in_words(chosen)}")
    elif choice == "file" and file.axes and file.axes != FORMATS[found].axes:
        choices = f"as {file.axes_by} says; --axes viewer reads it as viewers of its format do"
        log.info(f"{name}: read as {axes.in_words(chosen)}, {choices}")
    if file.step_m > COARSE_M:
        steps = f"its places are stored in steps of {file.step_m * 1000:.3g} mm"
        log.warn(f"{name}: {steps}: take an offset away before the file is written")
    cloud, turn = file.cloud, axes.world_from_axes(chosen)
    if np.linalg.det(turn) < 0:
        cloud, turn = cloud.mirrored(), turn @ np.diag([1.0, -1.0, 1.0])
    return cloud.moved(geometry.from_rotation_translation(turn, (0.0, 0.0, 0.0))), found


def losses(name: str, request: WriteRequest) -> list[str]:
    """What of a scene its file does not hold, one sentence each."""
    carries, scene = FORMATS[name].carries, request.scene
    moving = [node for node in scene.nodes if node.moves]
    bent = [node for node in moving if node.displacement is not None]
    found = []

    def objects(nodes: list[SplatNode]) -> str:
        return nodes[0].name if len(nodes) == 1 else f"{len(nodes)} objects"

    if moving and request.time_s is not None:
        found.append(f"motion ({objects(moving)} as at {request.time_s:g} s)")
    elif bent and "deformation" not in carries:
        found.append(f"deformation ({objects(bent)} in the shape of the middle of the track)")
    if "classes" not in carries and any(node.cloud.class_ids is not None for node in scene.nodes):
        found.append("classes of the Gaussians")
    if "sky" not in carries and scene.sky is not None:
        found.append("the sky (--sky sphere adds it as Gaussians)")
    if "harmonics" not in carries and scene.degree > 0:
        found.append("colours that depend on the direction of view")
    if kept := {key: value for key, value in request.drawing.items() if key not in carries}:
        found.append("how the fit draws Gaussians (" + ", ".join(f"{key} {value}" for key, value in kept.items()) + ")")
    return found
