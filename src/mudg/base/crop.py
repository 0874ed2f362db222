"""A rectangle of what the diffusion model is given."""

from __future__ import annotations

from dataclasses import replace

from mudg.base.types import Condition

_MAPS = ("color", "depth", "valid", "reference", "warped", "backdrop", "semantics", "backdrop_semantics")


def cropped(condition: Condition, rows: slice, columns: slice) -> Condition:
    """A rectangle of pixels of all views. Its cameras only say how large it is: they look straight ahead."""
    width, height = columns.stop - columns.start, rows.stop - rows.start
    lens = {"width": width, "height": height, "cx": width / 2, "cy": height / 2}
    views = tuple(replace(view, camera=replace(view.camera, **lens)) for view in condition.views)
    cut = lambda x: x[..., rows, columns].contiguous()
    found = {name: getattr(condition, name) for name in _MAPS}
    maps = {name: cut(x) for name, x in found.items() if x is not None}
    renders = None if condition.renders is None else condition.renders.map(cut)
    measured = None if condition.measured is None else condition.measured.map(cut)
    return replace(condition, views=views, renders=renders, measured=measured, **maps)
