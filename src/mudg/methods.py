"""The methods that can be compared, as rows of plain values. Only what works is listed.

Every method ends in the same thing, folders of observations on named trajectories, so that one scorer serves all: a method
either fits a scene (``mudg fit``) and renders it, or generates its views directly (``mudg synthesize``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal


@dataclass(frozen=True)
class Method:
    """One row.

    Args:
        title: for tables. made_by: the verb that produces its views (``render`` after ``fit``, or ``synthesize``).
        nodes: what its scene consists of; empty for a method without a scene.
        supervision: what it learns from in this log. produces: modalities; others are reported "not produced".
    """

    title: str
    made_by: Literal["render", "synthesize"]
    nodes: tuple[str, ...]
    supervision: tuple[str, ...]
    produces: tuple[str, ...]


METHODS: Final[dict[str, Method]] = {
    "gs3d": Method(
        "3D Gaussians, static", "render", ("static",), ("recorded colour", "recorded semantics"), ("rgb", "depth", "semantics")
    ),
    "street_gaussians": Method(
        "Gaussians without diffusion", "render", ("static", "rigid per moving track", "sky"),
        ("recorded colour", "recorded semantics", "LiDAR depth", "sky"), ("rgb", "depth", "semantics"),
    ),
    "mudg_r": Method("Diffusion output", "synthesize", (), (), ("rgb", "depth", "semantics")),
    "mudg_s": Method(
        "Gaussians with diffusion", "render", ("static", "rigid per moving track", "sky"),
        ("recorded colour", "recorded semantics", "LiDAR depth", "sky", "virtual views of mudg_r"), ("rgb", "depth", "semantics"),
    ),
}  # fmt: skip


def fitted_methods() -> tuple[str, ...]:
    """Methods that ``mudg fit`` knows."""
    return tuple(name for name, method in METHODS.items() if method.made_by == "render")
