"""One verb over many scenes: lists, shards, failures that stop nothing else, repeats that redo nothing, exit codes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import kitti_folders as made
import pytest
from toy_scene import ToyStreet

from mudg import app
from mudg.base.errors import InputError, UsageError
from mudg.fleet import plan as lists
from mudg.fleet.listed import run_listed
from mudg.fleet.plan import BatchPlan, BatchStage
from mudg.scene.read import read_scene

STEP = """
import os, signal, sys
source, out = sys.argv[1:3]
if source.endswith("bad"):
    sys.stderr.write("error: it is broken\\n  where: bad\\n  got: nothing\\n")
    sys.exit(3)
if source.endswith("killed"):
    os.kill(os.getpid(), signal.SIGKILL)
if source.endswith("bug"):
    raise ZeroDivisionError
os.makedirs(out)
open(os.path.join(out, "threads"), "w").write(os.environ["MUDG_THREADS"])
"""
"""Works, fails or dies as its source says."""


def test_a_list_names_sources_folders_and_settings(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text(
        "# drives\n\na/drive_1\n'b/drive 2' name=two sequence=07\n/abs/drive_3.zip   # comment\ncity name=c\n"
    )
    entries = lists.read_list(tmp_path / "list.txt", ("sequence",))
    assert [(e.name, e.source, dict(e.settings)) for e in entries] == [
        ("drive_1", str(tmp_path / "a/drive_1"), {}),
        ("two", str(tmp_path / "b/drive 2"), {"sequence": "07"}),
        ("drive_3", "/abs/drive_3.zip", {}),
        ("c", "city", {}),
    ]
    (tmp_path / "scenes").mkdir()
    for name in ("b", "a", ".hidden"):
        (tmp_path / "scenes" / name).mkdir()
    assert [e.name for e in lists.read_list(tmp_path / "scenes")] == ["a", "b"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "list is empty"),
        ("# nothing\n", "list is empty"),
        ("a/x\nb/x\n", "the same folder"),
        ("a b\n", "unknown setting"),
        ("a speed=3\n", "unknown setting"),
        ("'a\n", "cannot parse the line"),
        ("a name=../up\n", "folder name"),
    ],
)
def test_bad_lists_are_refused_with_their_line(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "list.txt").write_text(text)
    with pytest.raises(InputError, match=words):
        lists.read_list(tmp_path / "list.txt")


def test_shards_are_a_partition_that_growing_lists_keep() -> None:
    entries = [lists.Entry(str(n), str(n)) for n in range(60)]
    parts = [lists.shard(entries, (i, 3)) for i in range(3)]
    assert sorted(int(e.name) for part in parts for e in part) == list(range(60)) and min(map(len, parts)) >= 10
    for part, fewer in zip(parts, [lists.shard(entries[:20], (i, 3)) for i in range(3)], strict=True):
        assert part[: len(fewer)] == fewer
    for text in ("3/3", "1", "a/b", "-1/3", "1/0"):
        with pytest.raises(UsageError, match="shard"):
            lists.parse_shard(text)


def test_failures_are_told_and_stop_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "step.py").write_text(STEP)
    names = ("bad", "killed", "bug", "good")
    words = (sys.executable, str(tmp_path / "step.py"), "{source}", "{out}")
    plan = BatchPlan((BatchStage("command", words, direct=True),))
    entries = [lists.Entry(name, f"/logs/{name}") for name in names]
    result = run_listed(("ingest",), None, entries, tmp_path / "out", jobs=2, shard_text="0/1", plan=plan)
    assert result["exit_code"] == 13
    states = {record["name"]: (record["state"], record["words"]) for record in result["scenes"]}
    assert list(states) == ["bad", "killed", "bug", "good"]
    assert states["bad"] == ("failed", "it is broken; bad; got nothing")
    assert states["killed"][0] == "failed" and "signal 9" in states["killed"][1] and "memory" in states["killed"][1]
    assert states["bug"][0] == "failed" and "code 1" in states["bug"][1] and states["good"][0] == "done"
    assert "1 of 4 scenes are there, 3 failed" in result["text"]
    assert "ZeroDivisionError" in states["bug"][1] and "warning" in capfd.readouterr().err
    written = json.loads((tmp_path / "out/status-0-of-1.json").read_text())
    assert written["counts"] == {"done": 1, "reused": 0, "failed": 3}


@pytest.mark.slow
def test_many_logs_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("one", "two"):
        made.write_raw_drive(tmp_path / name)
    drives = [next(p for p in (tmp_path / name).iterdir() if p.is_dir()) for name in ("one", "two")]
    broken = drives[1] / "velodyne_points" / "data" / "0000000004.bin"
    content = broken.read_bytes()
    broken.write_bytes(content[:-5])
    (tmp_path / "list.txt").write_text(f"{drives[0]} name=first frames=0:3\n{drives[1]} name=second\n")
    words = (
        f"ingest kitti --list {tmp_path}/list.txt --out {tmp_path}/scenes --jobs 2 --no-contact-sheet --quiet".split()
    )
    assert app.main(words) == 11
    said = capsys.readouterr().out
    assert "1 of 2 scenes are there, 1 failed" in said and "cut off" in said
    assert len(read_scene(tmp_path / "scenes" / "first").frames) == 3
    assert not (tmp_path / "scenes" / "second" / "scene.json").exists()
    broken.write_bytes(content)
    assert app.main(words) == 0
    table = capsys.readouterr().out
    assert "reused" in table and "done" in table and len(read_scene(tmp_path / "scenes" / "second").frames) == 6


@pytest.mark.slow
def test_many_scenes_fused_by_shards(tmp_path: Path) -> None:
    for index, name in enumerate(("one", "two", "three")):
        ToyStreet(wall_x=20.0 + index).write(tmp_path / "scenes" / name, width=60, height=30)
    (tmp_path / "scenes" / "status.json").write_text("{}")
    first = [name for name in ("one", "two", "three") if lists.shard_of(name, 2) == 0]
    expected = sorted(["status-0-of-2.json", *first])
    words = ["fuse", "--list", str(tmp_path / "scenes"), "--out", str(tmp_path / "fused"), "--quiet", "--shard"]
    assert app.main([*words, "0/2"]) == 0 and sorted(p.name for p in (tmp_path / "fused").iterdir()) == expected
    assert app.main([*words, "1/2"]) == 0 and (tmp_path / "fused" / "three" / "static.safetensors").is_file()


def test_a_folder_as_list_leaves_out_what_an_earlier_list_wrote_there(tmp_path: Path) -> None:
    for name in ("b", "a.tfrecord", "_batch", "status.json", "status-3-of-8.json", ".hidden", "status.yaml"):
        (tmp_path / name).write_text("")
    assert [Path(entry.source).name for entry in lists.read_list(tmp_path)] == ["a.tfrecord", "b", "status.yaml"]


def test_list_flags_alone_make_no_sense(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene.json").write_text("{}")
    assert app.main(["fuse", str(tmp_path), "--out", str(tmp_path / "o"), "--shard", "0/2"]) == 2
    assert app.main(["annotate", "--out", str(tmp_path / "o")]) == 2
    assert app.main(["fuse", str(tmp_path), "--list", "x", "--out", str(tmp_path / "o")]) == 2
    assert "not both" in capsys.readouterr().err
