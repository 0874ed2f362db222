"""Batches in an object store: inputs fetched once, results uploaded, nothing left on the machine."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest
import yaml
from test_batches import Scenes

from mudg.base.errors import InputError, ResourceError
from mudg.base.location import Location
from mudg.fleet import status, work
from mudg.fleet.child import Ending, Stop
from mudg.fleet.plan import BatchPlan, BatchStage, Entry
from mudg.fleet.records import BatchFolder, Ended
from mudg.fleet.work import FOLDER, InputStore

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


@pytest.fixture
def bucket() -> Location:
    pytest.importorskip("fsspec").filesystem("memory").store.clear()
    return Location.of("memory://bucket")


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names of the addresses that were fetched, in order."""
    names: list[str] = []
    fetch = Location.fetch

    def noted(source: Location, to: Path, *, mirror: bool = False) -> None:
        names.append(source.name)
        fetch(source, to, mirror=mirror)

    monkeypatch.setattr(Location, "fetch", noted)
    return names


def put(bucket: Location, name: str, text: str = "some") -> Location:
    (bucket / name / "log.bin").save(text.encode())
    return bucket / name


def on_disk(root: Path) -> set[str]:
    """Names of the inputs that lie on this machine."""
    return {path.name for path in (root / FOLDER).glob("*/content/*")}


def test_an_input_is_fetched_once_per_driver_and_again_when_it_is_doubted(
    bucket: Location, tmp_path: Path, fetched: list[str]
) -> None:
    source, inputs, stop = put(bucket, "a", "one"), InputStore(tmp_path, "driver one"), Stop()
    for _ in range(2):
        with inputs.held(source, "", stop, keep=True) as path:
            assert (path / "log.bin").read_text() == "one"
    assert fetched == ["a"]
    put(bucket, "a", "two")
    (bucket / "a" / "more.bin").save(b"x")
    inputs.doubt(source, "")
    with inputs.held(source, "", stop, keep=True) as path:
        assert (path / "log.bin").read_text() == "two" and (path / "more.bin").exists()
    (bucket / "a" / "more.bin").remove()
    with InputStore(tmp_path, "driver two").held(source, "", stop) as path:
        assert not (path / "more.bin").exists(), "another driver compares it with the address"
    assert on_disk(tmp_path) == set(), "nobody else needs it"
    with pytest.raises(InputError, match="nothing is at"), inputs.held(bucket / "missing", "", stop):
        pass


def test_nothing_in_use_is_removed(bucket: Location, tmp_path: Path) -> None:
    inputs, stop = InputStore(tmp_path, "driver"), Stop()
    with inputs.held(put(bucket, "a"), "", stop):
        with inputs.held(bucket / "a", "", stop), inputs.held(put(bucket, "b"), "", stop, keep=True):
            pass
        assert on_disk(tmp_path) == {"a", "b"}
        inputs.clear()
        assert on_disk(tmp_path) == {"a"}
    inputs.clear()
    assert on_disk(tmp_path) == set()


def test_workers_that_want_the_same_fetch_it_once(
    bucket: Location, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, count, fetch = put(bucket, "weights"), [], Location.fetch

    def slow(source: Location, to: Path, *, mirror: bool = False) -> None:
        count.append(1)
        time.sleep(0.2)
        fetch(source, to, mirror=mirror)

    monkeypatch.setattr(Location, "fetch", slow)
    seen: list[bytes] = []

    def use() -> None:
        with InputStore(tmp_path, "driver").held(source, "", Stop(), keep=True) as path:
            seen.append((path / "log.bin").read_bytes())

    threads = [threading.Thread(target=use) for _ in range(5)]
    for one in threads:
        one.start()
    for one in threads:
        one.join(20)
    assert seen == [b"some"] * 5 and len(count) == 1


class TwoSteps(Scenes):
    """Three logs in a store; the second step reads what the first made."""

    def __init__(self, folder: Path, bucket: Location, settings: dict[str, object] | None = None) -> None:
        super().__init__(folder, 0, bucket / "runs")
        self.entries = [Entry(f"s{n}", str(put(bucket, f"logs/s{n}", f"log {n}"))) for n in range(3)]
        script = f'echo run >> {self.tally}/"$1.$2.runs"; [ -f {self.tally}/"$1.do" ] && . {self.tally}/"$1.do"'
        (folder / "step.sh").write_text(script + '\nmkdir $3 && cp "$4" $3/text')
        words = ("sh", str(folder / "step.sh"), "{name}")
        first = BatchStage("command", (*words, "first", "{out}", "{source}/log.bin"), (), settings or {})
        second = BatchStage("command", (*words, "second", "{out}", "{first}/text"), ("first",))
        object.__setattr__(first, "name", "first")
        self.plan = BatchPlan((first, second))

    def run(self, **more: object) -> dict[str, int]:
        return super().run(scratch=self.folder / "scratch", **more)


@pytest.fixture(autouse=True)
def _own_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BatchStage, "is_own", True)


def test_results_lie_in_the_store_and_nothing_here(bucket: Location, tmp_path: Path, fetched: list[str]) -> None:
    made = TwoSteps(tmp_path, bucket)
    assert made.run() == {"done": 6} and made.run() == {}
    for record in made.batch.records("done"):
        place = made.batch.out / record.place
        assert (place / "text").load() == f"log {record.scene[1:]}\n".strip().encode() and place.uploaded().complete
    assert status.read_status(made.batch).finished == 3
    assert sorted(fetched) == ["s0", "s1", "s2"], "each log once, and no result of a step that was made here"
    assert not [path for path in (tmp_path / "scratch").rglob("*") if path.is_file() and path.suffix != ".lock"]


def test_a_driver_that_died_between_the_steps_costs_no_step(bucket: Location, tmp_path: Path) -> None:
    made = TwoSteps(tmp_path, bucket)
    made.does("s1", '[ "$2" = second ] && exit 3')
    assert made.run() == {"done": 5, "failed": 1}
    shutil.rmtree(tmp_path / "scratch")  # another machine
    made.does("s1", "")
    (failed,) = made.batch.keys("failed")
    made.batch.record("failed", failed).remove()
    key = next(one.key for one in made.batch.records("done") if (one.scene, one.stage) == ("s2", "command"))
    made.batch.record("done", key).remove()  # published, not on record
    assert made.run() == {"done": 2}
    assert made.runs() == {"s0.first": 1, "s0.second": 1, "s1.first": 1, "s1.second": 2, "s2.first": 1, "s2.second": 1}


def test_a_bad_log_is_fetched_again_after_it_was_repaired(
    bucket: Location, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = TwoSteps(tmp_path, bucket)
    made.does("s1", 'grep -q repaired "$4" || [ "$2" = second ] || exit 4')
    run_step, codes = work.run_step, []

    def repaired(*args: object, **options: object) -> Ending:
        ending = run_step(*args, **options)
        codes.append(ending.code)
        if ending.code == 4:
            put(bucket, "logs/s1", "log 1 repaired")
        return ending

    monkeypatch.setattr(work, "run_step", repaired)
    assert made.run() == {"done": 6} and codes.count(4) == 1


def test_weights_at_an_address_are_fetched_once_for_all_scenes(
    bucket: Location, tmp_path: Path, fetched: list[str]
) -> None:
    put(bucket, "nets/small", "weights")
    settings = {"weights": "memory://bucket/nets/small", "nested": {"model": "memory:/bucket/nets/small"}, "n": 3}
    made = TwoSteps(tmp_path, bucket, settings)
    for name in ("s0", "s1", "s2"):
        copies = f"cat settings.yaml > {tmp_path}/{name}.yaml; cat weights/*/small/log.bin > {tmp_path}/{name}.bin"
        made.does(name, f'[ "$2" = first ] && {{ {copies}; }}')
    assert made.run() == {"done": 6} and fetched.count("small") == 1
    given = [yaml.safe_load((tmp_path / f"s{n}.yaml").read_text()) for n in range(3)]
    assert given[0] == given[1] == given[2] and (tmp_path / "s2.bin").read_text() == "weights"
    assert given[0]["nested"]["model"] == given[0]["weights"] and given[0]["n"] == 3
    assert given[0]["weights"].startswith("weights/")


def test_an_upload_that_fails_for_a_while_costs_no_second_run(
    bucket: Location, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Stop, "sleep", lambda *_: None)
    made, push, tries = TwoSteps(tmp_path, bucket), Location.push, []

    def fails(self: Location, frm: Path) -> None:
        tries.append(self.text)
        if len(tries) < 3:
            raise ResourceError("no connection")
        push(self, frm)

    monkeypatch.setattr(Location, "push", fails)
    end = BatchFolder.end

    def fails_once(self: BatchFolder, kind: Literal["done", "failed"], ended: Ended) -> None:
        if ended.scene == "s1" and ended.seconds and len(tries) < 100:
            tries.extend("x" * 100)
            raise ResourceError("no connection")
        end(self, kind, ended)

    monkeypatch.setattr(BatchFolder, "end", fails_once)
    assert made.run() == {"done": 6} and len(tries) == 108 and set(made.runs().values()) == {1}
