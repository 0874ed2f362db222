"""Pages from the Jinja templates of ``report/templates``. Every value is escaped; CSS and scripts lie inside the page."""

from __future__ import annotations

import functools
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined

from mudg.base import palette

TONES: Final = ("truth", "nearest_fill", "street_gaussians", "mudg_r", "mudg_s")
"""Methods that have a colour of their own in ``page.css``."""


def render(template: str, **values: Any) -> str:
    """The text of a page.

    Args:
        template: file name in ``report/templates``. values: what the template names; one that is missing is an error.
    """
    return _environment().get_template(template).render(**values)


def class_legend() -> list[tuple[str, str]]:
    """Name and CSS colour of every class."""
    return [
        (name, f"rgb({r},{g},{b})")
        for name, (r, g, b) in zip(palette.CLASSES, palette.DISPLAY_COLORS.tolist(), strict=False)
    ]


@functools.cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("mudg.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["tone"] = lambda method: method if method in TONES else "soft"
    return environment
