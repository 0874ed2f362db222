"""Records of a batch that a crash, a full disk or a hand has damaged: every command over it works, or ends in words."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from test_batches import request, writes

from mudg.base.errors import MudgError
from mudg.stages import batch
from mudg.stages.batches import claims, quality, status, work
from mudg.stages.batches.children import Ending
from mudg.stages.batches.quality import parse_bounds

BOUNDS = parse_bounds(["x.json:n<=7"])


def some(unit: Any, folder: Any) -> Ending:
    """One scene fails, one breaks a bound, the third is done."""
    if unit.entry.name == "scene000":
        return Ending(3, "it is cut off", "error: it is cut off\n")
    ending = writes(unit, folder)
    if unit.entry.name == "scene001":
        (folder.result / "x.json").write_text('{"n": 8}')
    return ending


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("batch") / "out"
    work.Worker(request(out, 3, bounds=BOUNDS), perform=some).run()
    claimed = claims.take(request(out, 3).folder.claims, "somekey", claims.Owner("elsewhere", "another", 1), 1000.0)
    assert isinstance(claimed, claims.Claim)
    return out


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
                changed = {key: value if key == name else kept for key, kept in record.items() if key != name or value is not ...}
                yield "".join(f"{json.dumps(one)}\n" for one in [*records[:number], changed, *records[number + 1 :]]).encode()


def ends_in_words(call: Callable[[], object]) -> None:
    with contextlib.suppress(MudgError):
        call()


KINDS = ["plan.json", "list.*.json", "claims/*.json", "done/*.json", "failed/*.json", "events/*.jsonl", "../_review/*/review.json"]


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_records_of_a_batch_end_in_words(kind: str, made: Path, tmp_path: Path) -> None:
    (tmp_path / "precious.command").mkdir()
    (tmp_path / "precious.command" / "file").write_text("keep me")
    (tmp_path / "precious.json").write_text("keep me")
    out = tmp_path / "out"
    shutil.copytree(made, out)
    folder = request(out).folder
    if kind == "done/*.json" or kind == "failed/*.json":  # else events tell what the records say
        shutil.rmtree(out / "_batch/events")
    (file, *_) = sorted((out / "_batch").glob(kind))
    content = file.read_bytes()

    def all_of_it() -> None:
        found = status.read_status(folder)
        json.dumps(found.record(), allow_nan=False)
        status.text_of(found)
        status.page_of(found)

    tried = 0
    for bad in damaged(content):
        file.write_bytes(bad)
        ends_in_words(all_of_it)
        ends_in_words(lambda: batch.show_cost(str(out), 1.0, 1.0))
        ends_in_words(lambda: batch.show_review(str(out)))
        ends_in_words(lambda: claims.take(folder.claims, "somekey", claims.Owner("here"), 1.0))
        if tried % 25 == 0:
            ends_in_words(lambda: batch.judge(str(out), ["*"], True))
            ends_in_words(lambda: batch.retry(str(out)))
            ends_in_words(lambda: work.Worker(request(out, 3, bounds=BOUNDS), perform=some).run())
            shutil.rmtree(out)
            shutil.copytree(made, out)
            if kind == "done/*.json" or kind == "failed/*.json":
                shutil.rmtree(out / "_batch/events")
        for left in (out / "_batch/claims").glob("somekey.[2-9]*.json"):
            left.unlink()
        tried += 1
    assert tried > len(WHOLE) or kind == "list.*.json"
    assert (tmp_path / "precious.command" / "file").read_text() == (tmp_path / "precious.json").read_text() == "keep me"


@pytest.mark.parametrize("content", ["[]", '{"by_distance": 1}', '{"by_distance": [1]}',
                                     '{"by_distance": [{"method": "m", "distance_m": "x"}]}',
                                     '{"by_distance": [{"method": "m", "distance_m": 0, "values": 3}]}'])  # fmt: skip
def test_scores_that_cannot_be_read_end_in_words(content: str, tmp_path: Path) -> None:
    (tmp_path / "metrics.json").write_text(content)
    ends_in_words(lambda: quality.problems(parse_bounds(["m.psnr@0>=20"]), tmp_path))


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("name", ["ego", "frames", "cameras", "source", "steps", "peak_bytes", "summary"])
def test_results_of_other_programs_have_no_facts(name: str, value: object, tmp_path: Path) -> None:
    (tmp_path / "scene.json").write_text(json.dumps({"frames": [], "ego": {"times_s": [0, 1]}, name: value}))
    (tmp_path / "run.json").write_text(json.dumps({name: value}))
    assert isinstance(quality.facts_of(tmp_path), dict) and isinstance(quality.spent_of(tmp_path), dict)
