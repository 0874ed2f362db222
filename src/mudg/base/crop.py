"""A rectangle of what the diffusion model is given."""

from __future__ import annotations

from dataclasses import replace

from mudg.base.types import Condition


def cropped(condition: Condition, rows: slice, columns: slice) -> Condition:
    """A rectangle of pixels of all views. Its cameras only say how large it is: they look straight ahead."""
    width, height = columns.stop - columns.start, rows.stop - rows.start
    lens = {"width": width, "height": height, "cx": width / 2, "cy": height / 2}
    views = tuple(replace(view, camera=replace(view.camera, **lens)) for view in condition.views)
    return replace(condition.map(lambda x: x[..., rows, columns].contiguous()), views=views)
