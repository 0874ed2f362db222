"""The methods that can be compared, as rows of plain values. Only what works is listed.

Every method ends in the same thing, folders of observations on named trajectories, so that one scorer serves all: a
method either fits a scene (``mudg fit``) and renders it, or generates its views directly (``mudg synthesize``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal


@dataclass(frozen=True)
class Method:
    """One row.

    Args:
        title: for tables.
        made_by: the verb that produces its views (``render`` after ``fit``, or ``synthesize``).
        nodes: what its scene consists of (objects: one rigid or deformable node per dynamic track); empty for a method
            without a scene.
        supervision: what its scene learns from; virtual: the views of mudg_r; repaired: its own renders beside the
            path, repaired.
        scene: what its scene is made of: Gaussians, or a radiance field that is marched along rays.
        boxes: whether it knows the tracked boxes, those of the scene and those that fusing used.
    """

    title: str
    made_by: Literal["render", "synthesize"]
    nodes: tuple[Literal["static", "objects", "sky"], ...] = ()
    supervision: tuple[Literal["color", "semantics", "lidar", "sky", "virtual", "repaired"], ...] = ()
    scene: Literal["gaussians", "radiance"] = "gaussians"
    boxes: bool = True


_STREET: Final = ("color", "semantics", "lidar", "sky")

METHODS: Final[dict[str, Method]] = {
    "gs3d": Method("3D Gaussians, static", "render", ("static",), ("color", "semantics"), boxes=False),
    "street_gaussians": Method("Gaussians without diffusion", "render", ("static", "objects", "sky"), _STREET),
    "pvg": Method("PVG, our sky model", "render", ("static", "sky"), _STREET, boxes=False),
    "s3gaussian": Method(
        "S3Gaussian without features", "render", ("static",), ("color", "semantics", "lidar"), boxes=False
    ),
    "bezier": Method("BezierGS", "render", ("static", "objects", "sky"), _STREET),
    "omnire": Method("OmniRe without SMPL", "render", ("static", "objects", "sky"), _STREET),
    "emernerf": Method("EmerNeRF, small", "render", (), ("color", "lidar", "sky"), "radiance", boxes=False),
    "difix": Method(
        "Difix3D scheme, our network, no last repair", "render", ("static", "objects", "sky"), (*_STREET, "repaired")
    ),
    "mudg_r": Method("Diffusion output", "synthesize"),
    "freevs": Method("FreeVS condition, our network", "synthesize"),
    "mudg_s": Method("Gaussians with diffusion", "render", ("static", "objects", "sky"), (*_STREET, "virtual")),
}

PUBLISHED: Final = ("pvg", "s3gaussian", "bezier", "omnire", "emernerf", "difix")
"""Published methods for comparison, fitted to recorded views alone; difix goes on under repaired renders."""
