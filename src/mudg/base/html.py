"""Pages, with all values escaped and CSS and scripts inside, and model cards from ``assets/templates`` (Jinja)."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined

from mudg.base import palette

# tables -------------------------------------------------------------------------------------------
# No torch.

ARROWS: Final = {"higher": "↑", "lower": "↓", "one": "→ 1"}
SENSES: Final = {"higher": "higher is better", "lower": "lower is better", "one": "nearest to 1 is best"}
"""Which way the numbers of a column are better, as a sign and in words."""


def markdown_table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table of texts."""
    first, *others = ("| " + " | ".join(cells) + " |" for cells in (heads, *rows))
    return [first, "|---" * len(heads) + "|", *others]


def cells(row: Mapping[str, Any], forms: Mapping[str, str]) -> list[str]:
    """Values of a row by the format of each; ``-``: there is no such number."""
    return ["-" if row[key] is None else form.format(row[key]) for key, form in forms.items()]


def best_of(better: str, numbers: Mapping[str, float]) -> list[str]:
    """Names of the best of two or more numbers as they are shown. better: ``higher``, ``lower``, or ``one``: those near
    1."""
    apart = {name: {"higher": -number, "one": abs(number - 1)}.get(better, number) for name, number in numbers.items()}
    return [name for name, number in apart.items() if number == min(apart.values())] if len(apart) > 1 else []


# html ---------------------------------------------------------------------------------------------

TONES: Final = ("truth", "nearest_fill", "street_gaussians", "mudg_r", "mudg_s")
"""Methods that have a colour of their own in ``page.css``."""


def render(template: str, **values: Any) -> str:
    """The text of a page from a file in ``assets/templates`` and the values that it names, all of them."""
    return _environment().get_template(template).render(**values)


def render_text(template: str, **values: Any) -> str:
    """The text of a Markdown file, where nothing is escaped; arguments as for ``render``."""
    return _environment().overlay(autoescape=False).get_template(template).render(**values) + "\n"


def class_legend() -> list[tuple[str, str]]:
    """Name and CSS colour of every class."""
    colors = palette.DISPLAY_COLORS.tolist()
    return [(name, f"rgb({r},{g},{b})") for name, (r, g, b) in zip(palette.CLASSES, colors)]


@functools.cache
def _environment() -> Environment:
    loader = PackageLoader("mudg", "assets/templates")
    # what is loaded needs no file any more
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, auto_reload=False)
    environment.trim_blocks = environment.lstrip_blocks = True
    environment.globals |= {"arrows": ARROWS, "senses": SENSES}
    environment.globals["tone"] = lambda method: method if method in TONES else "soft"
    return environment
