"""What reaches a terminal: foreign files cannot forge a line, command the terminal, or fill it."""

from __future__ import annotations

import io
import json
import pickle
import re
from pathlib import Path

import pytest
from refusals import refused
from rich.console import Console
from toy_scene import ToyStreet

from mudg import app
from mudg.base import log, store
from mudg.base.errors import InputError, MudgError, UsageError
from mudg.base.records import StrictRecord, parse_record
from mudg.editing.script import parse_edits

FORGED = "\x1b]0;title\x07\x1b[31m\nerror: forged\r\u2028\u202eline\x9b1m\u2066\x00"
OBEYED = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]|\nerror: forged")


class Named(StrictRecord):
    """A record with a name."""

    name: int


SOURCES = {
    "what": lambda text: InputError(f"there is no {text}"),
    "where": lambda text: InputError("bad", where=f"file.json: {text}.x"),
    "expected": lambda text: InputError("bad", expected=f"one of {text}, {text}"),
    "got": lambda text: InputError("bad", got=text),
    "remedy": lambda text: UsageError("bad", remedy=f"remove {text}"),
    "located": lambda text: InputError("bad").located(text),
    "pickled": lambda text: pickle.loads(pickle.dumps(InputError("bad", got=text, remedy=text))),
    "a record": lambda text: record({"name": text}, f"{text}: "),
    "an unknown field": lambda text: record({text: 1}),
    "a key that is no text": lambda text: record({1: text, None: text, (text,): 1}, f"{text}: "),
    "a missing field": lambda text: record(dict.fromkeys([f"{text}{n}" for n in range(9)])),
    "an edit": lambda text: edit({text[:9999]: {}}),
    "a field of an edit": lambda text: edit({"move": {text[:9999]: 1, "id": text[:9999]}}),
    "JSON": lambda text: refused(".", store.parse_json, f'{{"{text}": 1, "{text}": 1}}'.replace("\n", " "), text),
}


def record(value: object, where: str = "file: ") -> MudgError:
    return refused(".", parse_record, Named, value, where, raises=MudgError)


def edit(value: object) -> MudgError:
    return refused(".", parse_edits, json.dumps([value]), "file", raises=MudgError)


@pytest.mark.parametrize("source", SOURCES)
def test_values_in_errors_are_short_and_plain(source: str) -> None:
    assert not OBEYED.search(str(SOURCES[source](FORGED)))
    for value in ("x" * 1_000_000, "\x1b" * 1_000_000, "a b; c, " * 100_000):
        said = str(SOURCES[source](value))
        assert len(said) < 3000 and not re.search("x{201}", said) and not OBEYED.search(said)


def test_lines_of_a_remedy_and_short_values_stay_as_they_are() -> None:
    fields = {"where": "/x y/ü.json: a[0]", "expected": "one of a, b", "got": "'c'"}
    said = str(UsageError("a b", **fields, remedy="rename:\n    a -> b\n    c -> d"))
    lines = [f"  {name}: {value}" for name, value in fields.items()]
    assert said.split("\n") == ["a b", *lines, "  what to do: rename:", "    a -> b", "    c -> d"]


@pytest.mark.parametrize("terminal", [False, True])
def test_messages_and_progress_cannot_be_forged(terminal: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.StringIO()
    options = {"force_terminal": terminal, "width": 200, "color_system": None, "highlight": False}
    plain_console = Console(file=written, soft_wrap=True, **options)
    monkeypatch.setattr(log, "_console", lambda: plain_console)
    monkeypatch.setattr(log, "_quiet", False)
    log.info(f"a {FORGED}", "second line")
    log.warn(f"b {FORGED}")
    with log.task(f"[/x] [red]c {FORGED}", 2) as bar:  # markup of the library that draws it is none
        bar._last_line_s = 0.0
        bar.update(f"[/y] {FORGED}")
        bar.advance()
    said = written.getvalue()
    own = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]|\r", "", said) if terminal else said  # the bar's own movements
    assert not OBEYED.search(own), own
    assert "title" in said and "[red]c" in said and "\nsecond line\n" in said


def test_no_verb_prints_what_a_track_is_called_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Ids of tracks may hold anything; the same id twice is an error that names it."""
    scene, street = tmp_path / "scene", ToyStreet(car_start=(12.0, 0.0), times=[0.0, 0.1])
    street.write(scene, width=24, height=16, labels=False)
    tracks = store.read_json(scene / "tracks.json")
    for track in tracks["tracks"]:
        track["id"] += FORGED
    tracks["tracks"] *= 2
    (scene / "tracks.json").write_text(json.dumps(tracks))
    (scene / "manifest.json").unlink(missing_ok=True)
    named_so = str(tmp_path / FORGED[:9])
    for words in (["doctor", str(scene)], ["fuse", str(scene), "--out", named_so], ["doctor", named_so]):
        app.main(words)
        said = capsys.readouterr()
        assert "forged" in said.out + said.err or words[1] != str(scene)
        assert not OBEYED.search(said.out + said.err), ascii(said.out + said.err)


@pytest.mark.parametrize(
    "text",
    [
        '{"a": "\\ud800"}',
        '{"a": "\\udc00\\ud800"}',
        '{"\\ud800": 1}',
        b'{"a": "\xed\xa0\x80"}',
        '{"a": 1e999}',
        '{"a": -1e400}',
        f'{{"a": {"9" * 400}}}',
        f'{{"a": {"1" * 250}e100}}',
    ],
)
def test_json_that_no_file_or_float_can_hold_is_refused(text: str | bytes) -> None:
    refused("not valid JSON", store.parse_json, text, "here")


def test_json_at_the_limits_is_read() -> None:
    values = {"a": "\U0001f600", "b": 1e308, "c": "1e999", "d": 123}
    assert store.parse_json('{"a": "\\ud83d\\ude00", "b": 1e308, "c": "1e999", "d": 123}', "here") == values
    assert store.parse_json('"ü"'.encode("utf-16"), "here") == "ü"
