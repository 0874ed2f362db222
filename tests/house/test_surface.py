"""What is frozen: public names in api.json, flags in cli.json, lines of each room in budget.json. A change is a
decision of its commit.

``MUDG_UPDATE_FROZEN=1 pytest tests/house`` writes the files anew.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import os
import re
import runpy
import types
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import pytest

import mudg
from mudg import app, steps
from mudg.steps import command, functions
from mudg.steps.step import documentation, flag_name, flag_of, options, signature

HERE = Path(__file__).parent
MAX_HELP_LINES = 45
SETTINGS_BUDGET = 326
"""Distinct settings over all verbs; lower it when settings go."""


def frozen(name: str, now: object) -> object:
    """What the file says; with MUDG_UPDATE_FROZEN it is written first."""
    path = HERE / name
    if os.environ.get("MUDG_UPDATE_FROZEN"):
        path.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    return json.loads(path.read_text(encoding="utf-8"))


def test_public_names_are_frozen() -> None:
    now = sorted(mudg.__all__)
    assert now == frozen("api.json", now) == dir(mudg)
    assert all(getattr(mudg, name) is not None for name in now)


def test_flags_are_frozen() -> None:
    common = [flag_name(option.name) for option in command.common_options()]
    now = {
        verb: sorted(
            {flag_name(one.name) for one in options(steps.step_class(verb)) if not is_word(verb, one.name)} | {*common}
        )
        for verb in steps.VERBS
    }
    assert now == frozen("cli.json", now)


def test_rooms_keep_their_line_budget() -> None:
    """budget.json holds the lines of Python that each room may have. Who raises one says why in the message of the same
    commit."""
    package = Path(mudg.__file__).parent
    now = {
        room.name: sum(path.read_text(encoding="utf-8").count("\n") for path in room.rglob("*.py"))
        for room in sorted(package.iterdir())
        if any(room.glob("*.py"))
    }
    budget = frozen("budget.json", now)
    assert isinstance(budget, dict) and budget.keys() == now.keys()
    told = {room: f"{lines} lines, budget {budget[room]}" for room, lines in now.items()}
    assert not [told[room] for room, lines in now.items() if not 0.97 * budget[room] <= lines <= budget[room]]


def is_word(verb: str, name: str) -> bool:
    """Whether a field is given without a flag."""
    cls = steps.step_class(verb)
    return name in inspect.get_annotations(cls) and flag_of(cls, name).position in ("first", "rest")


@pytest.mark.parametrize("verb", steps.VERBS)
def test_every_flag_has_an_explanation_and_help_is_short(verb: str) -> None:
    cls = steps.step_class(verb)
    names = [one.name for one in options(cls)]
    assert all(one.text for one in options(cls)) and len(names) == len(set(names))
    page, whole = command.help_page(cls, everything=False), command.help_page(cls, everything=True)
    assert f"usage: mudg {verb}" in page and len(page.splitlines()) <= MAX_HELP_LINES
    for one in options(cls):
        if not is_word(verb, one.name):
            last = one.name.rpartition(".")[2].replace("_", "-")
            assert re.search(rf"^  --\S*(\[no-\])?{re.escape(last)}(?![\w-])", whole, re.MULTILINE), one.name
    assert set(cls.short) <= set(names) and (not cls.short or "--help-all" in page)
    assert f"\n  {verb} " in app.overview()


def test_settings_stay_within_their_budget() -> None:
    """A setting counts once, whichever verbs take it."""
    own = {
        (verb, one.name)
        for verb in steps.VERBS
        if verb not in ("run", "demo", "bench")
        for one in options(steps.step_class(verb))
        if not one.own
    }
    own |= {("run", one.name) for one in options(steps.step_class("run")) if not one.own and "." not in one.name}
    own |= {("bench", one.name) for one in options(steps.step_class("bench")) if not one.own and "." not in one.name}
    assert len(own) <= SETTINGS_BUDGET, len(own)


def test_a_function_shows_its_settings_and_defaults() -> None:
    fit = inspect.signature(mudg.fit)
    assert list(fit.parameters)[:2] == ["scene", "fused"]
    out = fit.parameters["out"]
    assert out.kind is inspect.Parameter.KEYWORD_ONLY and out.default is inspect.Parameter.empty
    assert fit.parameters["iterations"].default == 2000 and "Optimisation steps" in (mudg.fit.__doc__ or "")


def stub() -> str:
    """The signatures of all functions, for type checkers and editors."""
    imports = "from collections.abc import Mapping\nfrom pathlib import Path\nfrom typing import Any, Literal"
    lines = ['"""Generated: `MUDG_UPDATE_FROZEN=1 pytest tests/house`."""', "", imports]
    for name, verb in functions.VERBS.items():
        lines += ["", f"def {name}("]
        star = False
        for parameter in signature(steps.step_class(verb)).parameters.values():
            if parameter.kind is inspect.Parameter.KEYWORD_ONLY and not star:
                lines, star = [*lines, "    *,"], True
            default = "" if parameter.default is inspect.Parameter.empty else f" = {written(parameter.default)}"
            lines.append(f"    {parameter.name}: {annotation(parameter.annotation)}{default},")
        text = documentation(steps.step_class(verb)).replace("\\", "\\\\").replace("\n", "\n    ")
        lines += [") -> Any:", *(line.rstrip() for line in f'    """{text}\n    """'.split("\n")), "    ..."]
    return "\n".join(lines) + "\n"


def annotation(kind: Any) -> str:
    """A type as source text; paths may be text, and groups of settings mappings."""
    origin, inside = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return annotation(inside[0])
    if kind is Path:
        return "str | Path"
    if origin is Literal:
        return f"Literal[{', '.join(map(repr, inside))}]"
    if dataclasses.is_dataclass(kind):
        return "Mapping[str, Any]"
    if origin in (Union, types.UnionType):
        return " | ".join("None" if one is type(None) else annotation(one) for one in inside)
    if origin is tuple:
        return f"tuple[{', '.join('...' if one is ... else annotation(one) for one in inside)}]"
    if origin is not None:
        return f"Mapping[{', '.join(annotation(one) for one in inside)}]"
    return kind.__name__


def written(value: Any) -> str:
    """A default as source text."""
    return repr(value) if isinstance(value, bool | int | float | str | tuple | None) else "..."


def test_the_stubs_are_what_the_package_says() -> None:
    names = [(module, name) for module, names in mudg.HOMES.items() for name in names.split()]
    homes = ["__version__: str", *(f"from {module} import {name} as {name}" for module, name in names)]
    for module, said in ((functions, stub()), (mudg, "\n".join(homes) + "\n")):
        path = Path(module.__file__ or "").with_suffix(".pyi")
        if os.environ.get("MUDG_UPDATE_FROZEN"):
            path.write_text(said, encoding="utf-8")
        assert path.read_text(encoding="utf-8") == said
    assert set(functions.VERBS) <= set(mudg.__all__)


@pytest.mark.parametrize("name", ["commands.md", "names.md"])
def test_the_reference_is_what_the_program_says(repository: Path, name: str) -> None:
    """``python tools/reference.py`` writes the pages; so does the variable that renews all frozen files."""
    said = runpy.run_path(str(repository / "tools" / "reference.py"))["PAGES"][name]()
    page = repository / "docs" / "reference" / name
    if os.environ.get("MUDG_UPDATE_FROZEN"):
        page.write_text(said, encoding="utf-8")
    assert page.read_text(encoding="utf-8") == said
