"""Lists of logs: what a line says, what is refused, and how a list is shared out."""

from __future__ import annotations

from pathlib import Path

import pytest

from mudg.base.errors import InputError, UsageError
from mudg.fleet import plan as lists


def test_a_list_names_sources_folders_and_settings(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text(
        "# drives\n\na/drive_1\n'b/drive 2' name=two sequence=07\n/abs/drive_3.zip   # comment\ncity name=c\n"
    )
    entries = lists.read_list(tmp_path / "list.txt", ("sequence",))
    assert [(e.name, e.source, dict(e.settings)) for e in entries] == [
        ("drive_1", str(tmp_path / "a/drive_1"), {}),
        ("two", str(tmp_path / "b/drive 2"), {"sequence": "07"}),
        ("drive_3.zip", "/abs/drive_3.zip", {}),
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


def test_a_folder_as_list_leaves_out_what_a_batch_wrote_there(tmp_path: Path) -> None:
    for name in ("b", "a.tfrecord", "_batch", ".hidden", "status.yaml"):
        (tmp_path / name).write_text("")
    assert [Path(entry.source).name for entry in lists.read_list(tmp_path)] == ["a.tfrecord", "b", "status.yaml"]
