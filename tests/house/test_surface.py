"""The public surface is frozen: names in api.json, flags in cli.json. A change is a decision made in the same commit.

``MUDG_UPDATE_FROZEN=1 pytest tests/house`` writes the files anew.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import re
from pathlib import Path
from typing import get_type_hints

import pytest

import mudg
from mudg import cli, flags

HERE = Path(__file__).parent


def frozen(name: str, now: object) -> object:
    """What the file says; with MUDG_UPDATE_FROZEN it is written first."""
    path = HERE / name
    if os.environ.get("MUDG_UPDATE_FROZEN"):
        path.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    return json.loads(path.read_text(encoding="utf-8"))


def help_text(verb: str) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pytest.raises(SystemExit) as stopped:
        flags.parse(verb, ["--help-all" if verb in flags.CHAINS else "--help"], "summary")
    assert stopped.value.code == 0
    return printed.getvalue()


@pytest.fixture(scope="module")
def help_texts() -> dict[str, str]:
    """Every verb's whole help."""
    return {verb: help_text(verb) for verb in cli.VERBS}


def test_public_names_are_frozen() -> None:
    now = sorted(mudg.__all__)
    assert now == frozen("api.json", now)
    for name in mudg.__all__:
        assert getattr(mudg, name) is not None
    assert set(now) <= set(dir(mudg))


def test_flags_are_frozen(help_texts: dict[str, str]) -> None:
    now = {verb: sorted(set(re.findall(r"--[a-z][\w.-]*", text))) for verb, text in help_texts.items()}
    assert now == frozen("cli.json", now)


def test_every_verb_has_flags_and_every_flag_an_explanation(help_texts: dict[str, str]) -> None:
    assert set(cli.VERBS) == set(flags.FLAGS)
    listed = [name for _, names in cli.SECTIONS for name in names]
    assert sorted(listed) == sorted(cli.VERBS)
    for verb, text in help_texts.items():
        assert "(default:" in text
        assert "usage: mudg " + verb in text


@pytest.mark.usefixtures("help_texts")
def test_every_field_has_a_text() -> None:
    bare = []
    for verb, kind in flags.FLAGS.items():
        todo = [(verb, kind)]
        while todo:
            name, of = todo.pop()
            inside = {n: t for n, t in get_type_hints(of).items() if dataclasses.is_dataclass(t)}
            todo += [(f"{name}.{n}", t) for n, t in inside.items()]
            bare += [f"{name}.{f.name}" for f in dataclasses.fields(of) if not f.metadata.get("help")]
    assert not bare


def test_help_reads_no_source_class_by_class(monkeypatch: pytest.MonkeyPatch) -> None:
    """What tyro does for a field without a text: it parses the module anew for every class, which took longer than all else."""

    def refuse(*_: object) -> None:
        raise AssertionError("the source of a class was asked for")

    monkeypatch.setattr("inspect.getsource", refuse)
    assert "Optimisation steps" in help_text("fit")
    assert "Hold out every n-th frame" in help_text("run")


def test_the_help_of_a_chain_is_short_and_says_where_the_rest_is(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in flags.CHAINS:
        with pytest.raises(SystemExit) as stopped:
            flags.parse(verb, ["--help"], "summary")
        assert stopped.value.code == 0
        text = capsys.readouterr().out
        assert "--fit.method" not in text
        assert f"mudg {verb} --help-all" in text.replace("\n", " ")
        assert ("--protocols" if verb == "bench" else "--shifts-m") in text


def test_help_lists_only_what_exists() -> None:
    overview = cli.overview()
    for name in cli.VERBS:
        assert f"\n  {name}" in overview
    for later in ("cluster",):
        assert f"\n  {later}" not in overview
