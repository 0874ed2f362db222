"""Records of a batch that a crash, a full disk or a hand has damaged: every command over it works, or ends in words."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_batches import Scenes
from test_damaged_models import ends_in_words

from mudg.base.errors import MudgError
from mudg.fleet import records as status
from mudg.fleet.work import peak_of
from mudg.steps import batching


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scenes = Scenes(tmp_path_factory.mktemp("batch"))
    scenes.does("s0", "echo 'error: it is cut off' >&2; exit 3")
    assert scenes.run() == {"failed": 1, "done": 2}
    owner = {"host": "elsewhere", "process": 1, "since": 1.0, "shard": [1, 3], "job": ""}
    (scenes.folder / "out/_batch/owner-1-of-3.json").write_text(json.dumps(owner))
    return scenes.folder / "out"


WHOLE = [b"", b"null", b"[]", b"{}", b'"x"', b"1", b"\xff", b"[[[1]]]", b'{"stages": [1]}', b'{"cut']
VALUES: list[Any] = [None, "x", -1, 1e300, 10**30, True, [1], {"x": "y"}, "../../precious", "\x1b[31m", {"1": 10**9}]


def damaged(content: bytes) -> Iterator[bytes]:
    """The record with other content altogether, and with each of its fields missing or of another type."""
    yield from WHOLE
    try:
        records = [json.loads(content)]
    except ValueError:
        records = [json.loads(line) for line in content.splitlines()]
    for number, record in enumerate(records):
        for name in record if isinstance(record, dict) and number in (0, len(records) - 1) else ():
            for value in [..., *VALUES]:
                changed = {key: kept for key, kept in record.items() if key != name or value is not ...}
                changed |= {name: value} if name in changed else {}
                rows = [*records[:number], changed, *records[number + 1 :]]
                yield "".join(f"{json.dumps(one)}\n" for one in rows).encode()


KINDS = ["plan.json", "list.*.json", "owner-*.json", "done/*.json", "failed/*.json"]


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_records_of_a_batch_end_in_words(kind: str, made: Path, tmp_path: Path) -> None:
    (tmp_path / "precious.json").write_text("keep me")
    out = tmp_path / "out"
    shutil.copytree(made, out)
    scenes = Scenes(tmp_path)
    file, *_ = sorted((out / "_batch").glob(kind))

    def all_of_it() -> None:
        state = status.read_status(scenes.batch)
        json.dumps(state, allow_nan=False)
        status.text_of(state)

    def drive() -> None:
        with scenes.batch.owned((0, 3)):
            pass

    tried = 0
    for tried, bad in enumerate(damaged(file.read_bytes())):
        file.write_bytes(bad)
        if bad == WHOLE[-1]:
            with pytest.raises(MudgError) as caught:
                status.read_status(scenes.batch)
            assert file.name in str(caught.value.where)
        ends_in_words(all_of_it)
        ends_in_words(drive)
        if tried % 25 == 0:
            ends_in_words(lambda: batching.retry(str(out)))
            ends_in_words(scenes.run)
            shutil.rmtree(out)
            shutil.copytree(made, out)
    assert tried >= len(WHOLE) - 1 and (tmp_path / "precious.json").read_text() == "keep me"


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("name", ["steps", "peak_bytes", "summary"])
def test_records_of_other_programs_have_no_peak(name: str, value: object, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps({name: value}))
    peak_of(tmp_path)
