"""Files that would never end, or grow when read: pipes, devices and sockets where files should be, and YAML that
multiplies."""

from __future__ import annotations

import math
import os
import shutil
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

import kitti_folders
import pytest
import write_custom
import yaml
from toy_scene import ToyStreet

from mudg import app
from mudg.base import store
from mudg.base.errors import InputError, MudgError
from mudg.base.plain_yaml import DEEPEST, LARGEST_BYTES, parse_yaml
from mudg.diffusion.shard_sources import read_list
from mudg.editing.script import parse_edits
from mudg.formats.settings import IngestConfig
from mudg.steps.ingest import Ingest

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")


@contextmanager
def ends_within(seconds: float) -> Iterator[None]:
    """Fail instead of waiting for ever."""

    def late(_number: int, _frame: FrameType | None) -> None:
        raise AssertionError(f"still waiting after {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


# ---- the store -----------------------------------------------------------------------------------


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "nowhere").symlink_to("gone")
    (tmp_path / "folder").mkdir()
    with socket.socket(socket.AF_UNIX) as made, suppress(OSError):
        made.bind(str(tmp_path / "socket"))
    cases = {"pipe": "a named pipe", "link": "a named pipe", "folder": "a folder", "loop": "levels of symbolic"}
    cases |= {"nowhere": "not found", "gone": "not found"}
    cases |= {"socket": "a socket"} if (tmp_path / "socket").exists() else {}
    with ends_within(5):
        for name, words in cases.items():
            texts = (store.read_bytes, store.read_json, store.sha256_file)
            for read in (*texts, store.open_file, store.regular, store.read_safetensors):
                with pytest.raises(InputError, match=words) as refused:
                    read(tmp_path / name)
                assert str(tmp_path / name) in refused.value.where
        with pytest.raises(InputError, match="a device"):
            store.read_bytes(Path("/dev/zero"))
    (tmp_path / "file").write_bytes(b"content")
    (tmp_path / "good").symlink_to("file")
    assert store.read_bytes(tmp_path / "good") == b"content"


@pytest.mark.parametrize(
    "words",
    [
        ["fuse", "SCENE", "--out", "OUT", "--config", "PIPE"],
        ["fuse", "PIPE", "--out", "OUT"],
        ["batch", "run", "--list", "PIPE", "--out", "OUT"],
        ["doctor", "PIPE"],
        ["ingest", "PIPE", "OUT"],
        ["edit", "FIT", "PIPE", "--out", "OUT"],
        ["run", "PIPE", "--out", "OUT"],
    ],
    ids=" ".join,
)
def test_the_command_line_waits_for_no_pipe(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "PIPE")
    (tmp_path / "FIT").mkdir()
    with ends_within(20):
        code = app.main([str(tmp_path / word) if word.isupper() else word for word in words])
    assert code in (2, 3), capsys.readouterr().err
    assert "Traceback" not in capsys.readouterr().err


# ---- logs ----------------------------------------------------------------------------------------


def replaced_one_by_one(folder: Path) -> Iterator[str]:
    """One file of each kind and place is a pipe, then itself again."""
    seen = set()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        kind = (path.parent, path.suffix, path.stem if not path.stem.isdigit() else "")
        if kind in seen:
            continue
        seen.add(kind)
        path.rename(folder.parent / "kept")
        os.mkfifo(path)
        yield path.relative_to(folder).as_posix()
        path.unlink()
        (folder.parent / "kept").rename(path)


@pytest.mark.parametrize("kind", ["custom", "kitti"])
def test_no_import_waits_for_a_pipe(kind: str, tmp_path: Path) -> None:
    if kind == "kitti":
        log = kitti_folders.write_raw_drive(tmp_path / "in" / "day")
    else:
        street = ToyStreet(times=[0.0, 0.1]).write(tmp_path / "street", width=24, height=16, labels=False)
        log = write_custom.write_log(street, tmp_path / "in" / "day")
    refused, settings = [], IngestConfig(format=kind, workers=1, contact_sheet=False)
    for name in replaced_one_by_one(tmp_path / "in"):
        with ends_within(20):
            try:
                Ingest(log=log, out=tmp_path / "out", overwrite=True, settings=settings).run()
            except MudgError:
                refused.append(name)
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
    assert refused


# ---- YAML ----------------------------------------------------------------------------------------


MULTIPLYING = "x0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"x{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 9)
)
HOSTILE = {
    "a type": ("- a\n- !!bool x", "of which type.*line 2"),
    "a type of nothing": ('a: !!int ""', "of which type.*line 1"),
    "a type that is a date": ("a: !!timestamp x", "of which type.*line 1"),
    "a type that runs code": ("a: !!python/object/apply:os.system [ls]", "of which type.*line 1"),
    "a type of its own": ("a: !<!x> 1", "of which type.*line 1"),
    "a mark without a type": ("a: ! 1", "of which type.*line 1"),
    "a directive for types": ("%TAG !a! tag:x,2026:\n" * 4000 + "--- !a!b c", "directives.*line 1"),
    "half a letter": ('a:\n- "\\ud800"', "not valid YAML.*line 2"),
    "no letter": ('a: "\\UFFFFFFFF"', "not valid YAML.*line 1"),
    "half a letter, unescaped": (b"a: \xed\xa0\x80", "not valid YAML"),
    "a zero": ("a:\n- \0", "not valid YAML.*line 2"),
    "base 60": ("a: [1" + ":1" * 40_000 + "]", "too long.*line 1"),
    "base 60 with a point": ("a: 1" + ":1" * 40_000 + ".0", "too long.*line 1"),
    "digits": ("a: " + "9" * 5000, "number is too long.*line 1"),
    "digits behind a point": ("a: ." + "9" * 5000, "number is too long.*line 1"),
    "anchors": ("a: [" + ",".join(f"&a{n} 1" for n in range(9000)) + "]", "anchors and aliases.*line 1"),
    "documents": ("a: 1\n" + "---\n" * 20_000, "one YAML document.*line 2"),
    "values": ("a: [" + "1," * 22_000 + "]", "too many values.*line 1"),
    "a key twice": ("a: 1\nb: 1\na: 2", "'a' is given twice.*line 3"),
    "a number as key": ("a: {1: 2}", "key is no text.*line 1"),
    "nothing as key": ("a: {null: 2}", "key is no text.*line 1"),
    "a list as key": ("? [1]\n: 2", "key is no text.*line 1"),
    "a long key": ("? " + "k" * 90_000 + "\n: 1", "too long.*line 1"),
    "nested": ("a: " + "[" * 3000 + "]" * 3000, "nested too deeply"),
    "nested by lines": ("\n".join(" " * n + "a:" for n in range(400)), "nested too deeply"),
    "multiplied by aliases": (MULTIPLYING, "anchors and aliases"),
    "containing itself": ("a: &x [*x]", "anchors and aliases"),
    "large": ("a: " + "x" * 5_000_000, "too large"),
    "an alias of nothing": ("a: *x", "anchors and aliases"),
    "bytes that are no text": (b"a: \xff\xfe\x00", "not valid YAML"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_yaml_is_refused_at_once(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text, words = HOSTILE[name]
    content = text.encode() if isinstance(text, str) else text
    begun = time.process_time()
    with ends_within(30):
        with pytest.raises(InputError, match=f"(?s){words}") as refused:
            parse_yaml(text, "here")
        took = time.process_time() - begun
        with pytest.raises(InputError, match=f"(?s){words}"):
            parse_edits(content, "edits.yaml", tmp_path)
        (tmp_path / "c.yaml").write_bytes(content)
        assert app.main(["fuse", "scene", "--out", str(tmp_path / "out"), "--config", str(tmp_path / "c.yaml")]) == 3
        list_text = content.replace(b"a: ", b"scenes: ", 1)
        (tmp_path / "l.yaml").write_bytes(list_text)
        with pytest.raises(InputError):
            read_list(str(tmp_path / "l.yaml"))
    said = capsys.readouterr().err
    assert words.partition(".*")[0] in said and str(tmp_path / "c.yaml") in said
    assert len(str(refused.value)) < 600
    assert took < 0.5  # seconds of processor time; measured at most 0.1, for the 20,000 values that a file may hold


LARGE = {
    "edits": "- remove: {ids: [car-001]}\n",
    "numbers": "- 1\n",
    "maps": "- {a: {b: {c: {d: 1}}}}\n",
    "brackets": "- [[[[[[[[[[[[[[[[[[[[]]]]]]]]]]]]]]]]]]]]\n",
    "comments": "#\n",
}


@pytest.mark.parametrize("kind", LARGE)
def test_the_largest_yaml_is_read_or_refused_quickly(kind: str) -> None:
    """Somebody waits: the viewer parses what is typed. Five times the bound took 1.2 s."""
    text = "- 12345\n" + LARGE[kind] * ((LARGEST_BYTES - 8) // len(LARGE[kind]))
    assert LARGEST_BYTES - 150 < len(text) <= LARGEST_BYTES
    took = []
    for _ in range(3):
        begun = time.process_time()
        with suppress(InputError):
            parse_edits(text, "edits.yaml")
        took.append(time.process_time() - begun)
    assert min(took) < 0.3  # measured: 0.02 to 0.15 on two busy cores


@pytest.mark.parametrize("name", [name for name in HOSTILE if name != "values"])
def test_the_slow_parser_refuses_the_same(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """PyYAML is also installed without libyaml."""
    monkeypatch.delattr(yaml, "CSafeLoader", raising=False)
    text, words = HOSTILE[name]
    with ends_within(20), pytest.raises(InputError, match=f"(?s){words}"):
        parse_yaml(text, "here")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        *((text, text) for text in "1:30 2026-13-45 2026-01-02 0x10 010 0b1".split()),
        *(("-3", -3), ("1_000", 1000), ("0", 0), ("1.5", 1.5), ("-.5", -0.5), ("1.0e-05", 1e-05)),
        *(("-.inf", -math.inf), ("'1'", "1"), ("~", None), ("yes", True), ("Off", False), ("a b", "a b")),
        *(("'null'", "null"), ("", None), ("|\n a\n b\n", "a\nb\n"), ("[a, {b: }]", ["a", {"b": None}])),
    ],
)
def test_plain_values_are_read(text: str, value: object) -> None:
    """Numbers are decimal; dates and times of day are texts."""
    read = parse_yaml(f"k: {text}", "here")["k"]
    assert read == value and type(read) is type(value)


def test_plain_yaml_is_read() -> None:
    deep = "a: " + "[" * (DEEPEST - 1) + "]" * (DEEPEST - 1)
    assert parse_yaml("a: {b: [1, 2]}\nc: {}", "here") == {"a": {"b": [1, 2]}, "c": {}}
    assert parse_yaml(deep, "here")
    assert parse_yaml("", "here") is None
