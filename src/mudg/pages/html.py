"""Pages and model cards from the Jinja templates of ``pages/templates``. On pages every value is escaped; CSS and scripts lie inside."""

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
        template: file name in ``pages/templates``. values: what the template names; one that is missing is an error.
    """
    return _environment().get_template(template).render(**values)


def render_text(template: str, **values: Any) -> str:
    """The text of a Markdown file, where nothing is escaped; arguments as for ``render``."""
    return _environment().overlay(autoescape=False).get_template(template).render(**values) + "\n"


def class_legend() -> list[tuple[str, str]]:
    """Name and CSS colour of every class."""
    return [
        (name, f"rgb({r},{g},{b})")
        for name, (r, g, b) in zip(palette.CLASSES, palette.DISPLAY_COLORS.tolist(), strict=False)
    ]


@functools.cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("mudg.pages"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["tone"] = lambda method: method if method in TONES else "soft"
    return environment
