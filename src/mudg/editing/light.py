"""The light of a street, for objects that come from another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.types import View
from mudg.editing.apply import spread
from mudg.editing.model import light_gain, linear_of, matched_light
from mudg.editing.plan import EditPlan
from mudg.gaussians.model import SceneModel
from mudg.gaussians.rendering import raster_of, render_view

MOST_VIEWS: Final = 8
WIDTH_PX: Final = 160


def surface_light(model: SceneModel, views: Sequence[View]) -> NDArray[np.float64] | None:
    """Mean light f64[3] of the surfaces that a fitted scene shows, linear: of all pixels but sky, in some recorded
    views, drawn small.

    None without views, or where they show nothing.
    """
    total, count = np.zeros(3), 0
    for view in spread(views, MOST_VIEWS):
        width = min(WIDTH_PX, view.camera.width)
        small = view.resized(width, max(1, round(view.camera.height * width / view.camera.width)))
        seen = render_view(model, small, raster_of(model))
        if seen.depth is not None:
            surface = seen.rgb[:, seen.depth[0] > 0].numpy().astype(np.float64)
            total, count = total + linear_of(surface).sum(1), count + surface.shape[1]
    return total / count if count else None


def take_light(plan: EditPlan, model: SceneModel) -> None:
    """Give a plan's new objects, and those that are kept in another street, the light of the street where they will be.

    Args:
        plan: with the views of the recording. model: the fitted scene to be edited.
    """
    wanting = [name for name, insertion in plan.inserted.items() if insertion.match_light]
    if not wanting and not plan.match_objects:
        return
    here = surface_light(model, plan.views)
    there = here if plan.background is None else plan.background[0].light_rgb
    unknown = []
    for name in wanting:
        asset = plan.inserted[name].asset
        unknown += [name] if there is None or asset.light_rgb is None else []
        plan.inserted[name] = replace(plan.inserted[name], asset=matched_light(asset, there)[0], match_light=False)
    if plan.match_objects:
        plan.objects_gain = light_gain(here, there)
        unknown += [] if here is not None and there is not None else ["what was recorded"]
    if unknown:
        plan.notes.append(_unmatched(unknown))


def _unmatched(names: Sequence[str]) -> dict[str, Any]:
    text = (
        f"{', '.join(names)}: the colours stay as they were recorded, for the light of one of the two streets is not"
        " known (it takes recorded views: give --scene; export assets with --scene)"
    )
    return {"kind": "light not matched", "ids": list(names), "text": text}
