"""The table of formats: what each is called, which axes its readers expect, what it carries, who writes and reads it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from mudg.base import geometry
from mudg.base.errors import InputError
from mudg.base.types import Scene
from mudg.core.ground import HeightMap
from mudg.data.splats import alpasim, bundle, compressed_ply, gltf, gltf_read, ply, sog, splat, spz, usd
from mudg.data.splats.cloud import SplatCloud, SplatNode, SplatScene

Axes = Literal["viewer", "world"]

_SIDES: Final[Mapping[str, NDArray[np.float64]]] = {
    "right, down, forward": np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], np.float64),
    "right, up, back": np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]], np.float64),
    "y up": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float64),
    "z up": np.eye(3),
}
"""What x, y, z of a file are called: rotation from the axes of this program (x forward, y left, z up)."""


@dataclass(frozen=True, slots=True, eq=False)
class WriteRequest:
    """What is to be written.

    Args:
        scene: with the axes of the file. time_s: the moment, or None = all of the motion. spz_version: 3 or 4. log: whose cameras are
            listed, where a format can. ground: where a format needs it.
    """

    scene: SplatScene
    time_s: float | None
    spz_version: int = 3
    log: Scene | None = None
    ground: HeightMap | None = None

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


@dataclass(frozen=True, slots=True, eq=False)
class SplatFormat:
    """One format.

    Args:
        suffixes: of its files, the usual one first. axes: of ``_SIDES``, what its readers expect. write: bytes of a request, or None:
            written elsewhere. read: Gaussians of bytes, or None: not read.
        carries: of ``motion``, ``deformation``, ``classes``, ``sky``, ``harmonics``, ``antialias``.
    """

    suffixes: tuple[str, ...]
    axes: str
    write: Callable[[WriteRequest], bytes]
    read: Callable[[bytes, str], SplatCloud] | None = None
    carries: frozenset[str] = field(default_factory=lambda: frozenset({"harmonics"}))


FORMATS: Final[Mapping[str, SplatFormat]] = {
    "ply": SplatFormat((".ply",), "right, down, forward", lambda r: ply.to_bytes(r.cloud, classes=True), ply.from_bytes,
                       frozenset({"harmonics", "classes"})),
    "bundle": SplatFormat((".zip",), "z up", lambda r: bundle.to_bytes(r.scene, r.log), None,
                          frozenset({"harmonics", "motion", "deformation", "classes", "sky"})),
    "spz": SplatFormat((".spz",), "right, up, back", lambda r: spz.to_bytes(r.cloud, r.spz_version, r.antialias),
                       spz.from_bytes, frozenset({"harmonics", "antialias"})),
    "glb": SplatFormat((".glb",), "y up", lambda r: gltf.to_bytes(r.scene, r.time_s), gltf_read.from_bytes,
                       frozenset({"harmonics", "motion"})),
    "usda": SplatFormat((".usda", ".usd"), "z up", lambda r: usd.to_text(r.scene, r.time_s, log=r.log), None,
                        frozenset({"harmonics", "motion", "deformation", "classes"})),
    "usdz": SplatFormat((".usdz",), "z up", lambda r: usd.to_package(r.scene, r.time_s, r.log), None,
                        frozenset({"harmonics", "motion", "deformation", "classes", "sky"})),
    "alpasim": SplatFormat((".usdz",), "z up", lambda r: alpasim.to_package(r.scene, r.log, r.ground), None,
                           frozenset({"harmonics", "motion", "deformation", "classes", "sky"})),
    "compressed-ply": SplatFormat((".compressed.ply", ".ply"), "right, down, forward", lambda r: compressed_ply.to_bytes(r.cloud),
                                  compressed_ply.from_bytes),
    "sog": SplatFormat((".sog",), "right, down, forward", lambda r: sog.to_bytes(r.cloud, r.antialias), sog.from_bytes,
                       frozenset({"harmonics", "antialias"})),
    "splat": SplatFormat((".splat",), "right, down, forward", lambda r: splat.to_bytes(r.cloud), splat.from_bytes, frozenset()),
}  # fmt: skip


def file_from_world(name: str, axes: Axes) -> NDArray[np.float64]:
    """From the axes of this program to those of a format, f64[4, 4]; ``world``: no change."""
    turn = np.eye(3) if axes == "world" else _SIDES[FORMATS[name].axes]
    return geometry.from_rotation_translation(turn, (0.0, 0.0, 0.0))


def format_of(content: bytes, name: str) -> str:
    """Which format a file is, by its first bytes, or by its name where it has no mark.

    Raises:
        InputError: none that is read.
    """
    suffix = PurePath(name).suffix.lower()
    if content[:3] == b"ply":
        return "compressed-ply" if compressed_ply.is_compressed(content) else "ply"
    for mark, found in ((b"\x1f\x8b", "spz"), (b"NGSP", "spz"), (b"glTF", "glb"), (b"PK\x03\x04", "sog")):
        if content.startswith(mark):
            return found
    if suffix == ".splat":
        return "splat"
    known = ", ".join(sorted({suffix for format_ in FORMATS.values() if format_.read for suffix in format_.suffixes}))
    raise InputError(
        "this is no file of Gaussians that can be read",
        where=name,
        expected=known,
        got=f"it begins with {content[:8]!r}",
    )


def read_cloud(content: bytes, name: str, axes: Axes = "viewer") -> tuple[SplatCloud, str]:
    """The Gaussians of a file in the axes of this program (z up), and the name of its format.

    Args:
        name: of the file, for messages and for formats without a mark. axes: ``viewer``: the file has the axes that viewers of its format
            expect; ``world``: those of this program.

    Raises:
        InputError: another or a damaged file. ResourceError: a package that this file needs is not installed.
    """
    found = format_of(content, name)
    read = FORMATS[found].read
    if read is None:  # no mark leads here
        raise InputError("files of this format are not read", where=name, got=found)
    with np.errstate(over="ignore", invalid="ignore"):  # readers check what comes of numbers that overflow or are none
        cloud = read(content, name)
    return cloud.moved(geometry.invert(file_from_world(found, axes))), found


def losses(name: str, request: WriteRequest) -> list[str]:
    """What of a scene its file does not hold, one sentence each."""
    carries, scene = FORMATS[name].carries, request.scene
    moving = [node for node in scene.nodes if node.moves]
    bent = [node for node in moving if node.displacement is not None]
    found = []
    if moving and request.time_s is not None:
        found.append(f"motion ({_objects(moving)} as at {request.time_s:g} s)")
    elif bent and "deformation" not in carries:
        found.append(f"deformation ({_objects(bent)} in the shape of the middle of the track)")
    if "classes" not in carries and any(node.cloud.class_ids is not None for node in scene.nodes):
        found.append("classes of the Gaussians")
    if "sky" not in carries and scene.sky is not None:
        found.append("the sky (--sky sphere adds it as Gaussians)")
    if "harmonics" not in carries and scene.degree > 0:
        found.append("colours that depend on the direction of view")
    if moving and request.time_s is None and scene.facts.get("harmonics") == "world":
        found.append("colours of objects that stay as they are while the object turns (they turn with it)")
    if kept := {key: value for key, value in request.drawing.items() if key not in carries}:
        found.append("how the fit draws Gaussians (" + ", ".join(f"{key} {value}" for key, value in kept.items()) + ")")
    return found


def _objects(nodes: list[SplatNode]) -> str:
    return nodes[0].name if len(nodes) == 1 else f"{len(nodes)} objects"
