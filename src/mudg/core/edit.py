"""Edits of a scene as pure functions: the scene stays as it is, a changed copy is returned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from mudg.base import geometry
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Scene, Track

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Editable(Protocol):
    """A fitted scene: has named nodes, and can leave some out (``models.nodes.SceneModel``)."""

    def node_names(self) -> tuple[str, ...]:
        """Names of the objects in the scene (track ids)."""
        ...

    def without_nodes(self, names: Sequence[str]) -> Editable:
        """A copy without the named objects."""
        ...

    def with_node_moved(self, name: str, object_from_new: NDArray[np.float64]) -> Editable:
        """A copy with one object displaced in its own frame."""
        ...


Model = TypeVar("Model", bound=Editable)


def without_tracks(model: Model, track_ids: Sequence[str]) -> Model:
    """The fitted scene without some moving objects.

    Raises:
        UsageError: a track that the scene has no node for (it may be parked, and so part of the background).
    """
    for track_id in track_ids:
        _has_object(model, track_id)
    return model.without_nodes(track_ids)  # type: ignore[return-value]


def object_moved(model: Model, track_id: str, object_from_new: NDArray[np.float64]) -> Model:
    """The fitted scene with one moving object displaced in its own frame at all times (``track_moved`` of a fitted scene).

    Raises:
        UsageError: the scene has no node for this track. InputError: the motion is not rigid.
    """
    _has_object(model, track_id)
    problem = geometry.rigid_problem(object_from_new)
    if problem:
        raise InputError(f"the displacement is not rigid: {problem}")
    return model.with_node_moved(track_id, object_from_new)  # type: ignore[return-value]


def _has_object(model: Editable, track_id: str) -> None:
    names = model.node_names()
    if track_id not in names:
        raise UsageError(
            f"the fitted scene has no moving object {track_id!r}",
            expected="one of " + ", ".join(names) if names else "a scene with moving objects",
        )


def track_removed(scene: Scene, track_id: str) -> Scene:
    """The scene without one track.

    Raises:
        InputError: no such track.
    """
    scene.track(track_id)
    return replace(scene, tracks=tuple(track for track in scene.tracks if track.id != track_id))


def track_moved(scene: Scene, track_id: str, object_from_new: NDArray[np.float64]) -> Scene:
    """The scene with one track displaced in its own frame (e.g. 3 m ahead: a translation along x).

    Args:
        object_from_new: rigid 4x4; the new box pose is ``world_from_object @ object_from_new`` at every key.

    Raises:
        InputError: no such track, or the motion is not rigid.
    """
    problem = geometry.rigid_problem(object_from_new)
    if problem:
        raise InputError(f"the displacement is not rigid: {problem}")
    old = scene.track(track_id)
    new = Track(old.id, old.label, old.size_m, old.times_s, old.world_from_object @ object_from_new)
    return replace(scene, tracks=tuple(new if track.id == track_id else track for track in scene.tracks))
