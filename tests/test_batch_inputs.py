"""Inputs from a store: fetched once, a scene ahead, and removed by size but never while they are used."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from mudg.base import transfer
from mudg.base.errors import InputError
from mudg.base.location import Location
from mudg.stages.batches import work
from mudg.stages.batches.children import Ending
from mudg.stages.batches.folders import BatchFolder
from mudg.stages.batches.inputs import FOLDER, InputStore
from mudg.stages.batches.lists import Entry
from mudg.stages.batches.plan import BatchPlan, BatchStage

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


@pytest.fixture
def bucket() -> Location:
    pytest.importorskip("fsspec").filesystem("memory").store.clear()
    return Location.of("memory://bucket")


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of the addresses that were fetched, in order."""
    names: list[str] = []
    fetch = transfer.fetch

    def noted(source: transfer.Side, to: Path) -> frozenset[str]:
        names.append(source.path.rpartition("/")[2])
        return fetch(source, to)

    monkeypatch.setattr(transfer, "fetch", noted)
    return names


def put(bucket: Location, name: str, size: int = 1000, text: str = "") -> Location:
    (bucket / name / "log.bin").save(text.encode() or bytes(size))
    return bucket / name


def kept(root: Path) -> set[str]:
    """Names of the inputs that lie on this machine."""
    return {path.name for path in (root / FOLDER).glob("*/content/*")}


def test_an_input_is_fetched_once_and_again_when_it_is_doubted(
    bucket: Location, tmp_path: Path, fetched: list[str]
) -> None:
    source, inputs = put(bucket, "a", text="one"), InputStore(tmp_path, 1e6)
    for _ in range(2):
        with inputs.held(source) as path:
            assert (path / "log.bin").read_text() == "one"
    assert fetched == ["a"]
    put(bucket, "a", text="two")
    (bucket / "a" / "more.bin").save(b"x")
    inputs.doubt(source)
    with inputs.held(source) as path:
        assert (path / "log.bin").read_text() == "two" and (path / "more.bin").exists()
    (bucket / "a" / "more.bin").remove()
    with InputStore(tmp_path, 1e6).held(source) as path:
        assert not (path / "more.bin").exists(), "another worker compares it with the address"
    with InputStore(tmp_path, 1e6).held(source, fixed=True):
        assert fetched == ["a", "a", "a"]
    with pytest.raises(InputError, match="nothing is at"), inputs.held(bucket / "missing"):
        pass


def test_what_was_used_least_recently_goes_first_and_nothing_in_use(
    bucket: Location, tmp_path: Path, fetched: list[str]
) -> None:
    inputs = InputStore(tmp_path, 2500.0)
    with inputs.held(put(bucket, "a")):
        for name in ("b", "c", "b", "d"):
            time.sleep(0.02)
            with inputs.held(put(bucket, name)):
                pass
        assert kept(tmp_path) == {"a", "b", "d"}, "c was used before b; a is in use"
        inputs.evict(0.0)
        assert kept(tmp_path) == {"a"}
    inputs.evict(0.0)
    assert kept(tmp_path) == set() and fetched == ["a", "b", "c", "d"]


def test_workers_that_want_the_same_fetch_it_once(
    bucket: Location, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, count, fetch = put(bucket, "weights"), [], transfer.fetch

    def slow(side: transfer.Side, to: Path) -> frozenset[str]:
        count.append(1)
        time.sleep(0.2)
        return fetch(side, to)

    monkeypatch.setattr(transfer, "fetch", slow)
    seen: list[bytes] = []

    def use() -> None:
        with InputStore(tmp_path, 1e6).held(source, fixed=True) as path:
            seen.append((path / "log.bin").read_bytes())

    threads = [threading.Thread(target=use) for _ in range(5)]
    for one in threads:
        one.start()
    for one in threads:
        one.join(20)
    assert len(seen) == 5 and set(seen) == {bytes(1000)} and len(count) == 1


def batch(bucket: Location, scratch: Path, settings: dict[str, object] | None = None) -> work.WorkRequest:
    """Three logs, two steps; the second reads what the first made."""
    entries = [Entry(f"s{n}", str(put(bucket, f"logs/s{n}", text=f"log {n}"))) for n in range(3)]
    first = BatchStage("ingest", ("first", "{source}"), (), settings or {})
    plan = BatchPlan((first, BatchStage("fuse", ("second", "{ingest}"), ("ingest",))))
    folder = BatchFolder(bucket / "runs")
    folder.begin(plan, entries)
    return work.WorkRequest(folder, plan, entries, work.WorkRules(patience_s=0.0, scratch=scratch))


def reads(unit, folder) -> Ending:
    """A step that copies what it reads."""
    here = folder.path / ("inputs/ingest/text" if unit.stage.name == "fuse" else f"source/{unit.entry.name}/log.bin")
    folder.result.mkdir()
    (folder.result / "text").write_text(here.read_text())
    return Ending(0)


def test_the_next_log_comes_while_a_step_runs_and_results_stay_for_the_next_step(
    bucket: Location, tmp_path: Path, fetched: list[str]
) -> None:
    asked = batch(bucket, tmp_path)
    ahead: dict[str, bool] = {}

    def waits_for_the_next(unit, folder) -> Ending:
        following = f"s{int(unit.entry.name[1:]) + 1}"
        if unit.stage.name == "ingest" and following < "s3":
            end = time.monotonic() + 5
            while following not in fetched and time.monotonic() < end:
                time.sleep(0.01)
            ahead[following] = following in fetched
        return reads(unit, folder)

    assert work.Worker(asked, perform=waits_for_the_next).run() == {"done": 6}
    assert ahead == {"s1": True, "s2": True}
    assert sorted(fetched) == ["s0", "s1", "s2"], "each log once, and no result of a step made here"
    for key in asked.folder.keys("done"):
        record = json.loads(asked.folder.done(key).load())
        assert (bucket / "runs" / record["place"] / "text").load() == f"log {record['scene'][1:]}".encode()
    assert kept(tmp_path) == set(), "a worker that has nothing to do any more leaves nothing"


def test_a_bad_log_is_fetched_again_after_it_was_repaired(
    bucket: Location, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = batch(bucket, tmp_path)
    tries: list[str] = []

    def damaged_first(unit, folder) -> Ending:
        text = (folder.path / f"source/{unit.entry.name}/log.bin").read_text() if unit.stage.name == "ingest" else ""
        if unit.entry.name == "s1" and unit.stage.name == "ingest":
            tries.append(text)
            put(bucket, "logs/s1", text="log 1 repaired")
            if len(tries) == 1:
                return Ending(4, "it is damaged")
        return reads(unit, folder)

    assert work.Worker(asked, perform=damaged_first).run() == {"done": 6}
    assert tries == ["log 1", "log 1 repaired"]


def test_weights_at_an_address_are_fetched_once_for_all_scenes(
    bucket: Location, tmp_path: Path, fetched: list[str]
) -> None:
    put(bucket, "nets/small", text="weights")
    asked = batch(
        bucket,
        tmp_path,
        {"weights": "memory://bucket/nets/small", "nested": {"model": "memory:/bucket/nets/small"}, "n": 3},
    )
    given: list[dict] = []

    def looks(unit, folder) -> Ending:
        if unit.stage.name == "ingest":
            given.append(yaml.safe_load((folder.path / "settings.yaml").read_text()))
            assert (folder.path / given[-1]["weights"] / "log.bin").read_text() == "weights"
        return reads(unit, folder)

    assert work.Worker(asked, perform=looks).run() == {"done": 6}
    assert fetched.count("small") == 1 and len(given) == 3 and given[0] == given[2]
    assert (
        given[0]["nested"]["model"] == given[0]["weights"]
        and given[0]["weights"].startswith("weights/")
        and given[0]["n"] == 3
    )
