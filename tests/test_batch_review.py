"""Results outside the bounds: put up with pictures, counted, accepted, rejected, tried again."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from mudg import app
from mudg.base.errors import InputError, UsageError
from mudg.base.location import Location
from mudg.stages import batch
from mudg.stages.batches import quality, review, status, work
from mudg.stages.batches.children import Ending
from mudg.stages.batches.folders import BatchFolder
from mudg.stages.batches.lists import Entry, read_list
from mudg.stages.batches.plan import BatchPlan, BatchStage
from mudg.stages.batches.scratch import WorkFolder

PLAN = BatchPlan((
    BatchStage("command", ("program", "{source}", "{out}")), BatchStage("score", ("after", "{command}", "{out}"), ("command",)),
))  # fmt: skip


def rejected(out: Location, scratch: Path | None = None) -> work.WorkRequest:
    """A batch of four scenes of which two are outside the bounds."""
    folder, entries = BatchFolder(out), [Entry(f"s{n}", f"/logs/{n}") for n in range(4)]
    folder.begin(PLAN, entries)
    rules = work.WorkRules(patience_s=0.0, bounds=quality.parse_bounds(["x.json:n>=2"]), scratch=scratch)
    asked = work.WorkRequest(folder, PLAN, entries, rules)
    assert work.Worker(asked, perform=writes).run() == {"done": 4, "rejected": 2}
    return asked


def writes(unit, folder: WorkFolder) -> Ending:
    if unit.stage.name == "score":
        folder.result.mkdir()
        (folder.result / "y.json").write_text("{}")
        return Ending(0)
    number = int(unit.entry.name[1:])
    (folder.result / "errors").mkdir(parents=True)
    (folder.result / "x.json").write_text(json.dumps({"n": number}))
    Image.new("RGB", (900, 600), (40 * number, 0, 0)).save(folder.result / "errors" / "0.png")
    (folder.result / "broken.png").write_bytes(b"no picture")
    return Ending(0, seconds=0.5, processor_s=0.25)


@pytest.fixture(params=["here", "store"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> Location:
    if request.param == "here":
        return Location.of(tmp_path / "out")
    pytest.importorskip("fsspec").filesystem("memory").store.clear()
    return Location.of("memory://bucket/runs")


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_what_is_outside_the_bounds_is_put_up_with_pictures(out: Location, tmp_path: Path) -> None:
    asked = rejected(out, None if out.local is not None else tmp_path)
    found = review.waiting(asked.folder)
    assert [(one.scene, one.stage, one.problems, one.pictures) for one in found] == [
        ("s0", "command", ("x.json:n>=2: it is 0",), ("1.jpg",)), ("s1", "command", ("x.json:n>=2: it is 1",), ("1.jpg",)),
    ]  # fmt: skip
    (out / "_review/s1.command/1.jpg").fetch(tmp_path / "1.jpg")
    with Image.open(tmp_path / "1.jpg") as picture:
        assert picture.size == (480, 320) and abs(picture.convert("RGB").getpixel((9, 9))[0] - 40) < 5
    state = status.read_status(asked.folder)
    assert [(words, count) for words, count, _ in state.reasons()] == [("quality: x.json:n>=2", 2)]
    assert (
        state.for_review == 2
        and "2 results wait for review" in status.text_of(state)
        and state.record()["for_review"] == 2
    )
    shown = batch.show_review(str(out))
    page = (out / "_review/index.html").load().decode()
    assert page.count("data:image/jpeg") == 2 and "x.json:n&gt;=2: it is 1" in page and "<script" not in page
    assert [one["scene"] for one in shown["waiting"]] == ["s0", "s1"] and "2 results wait" in shown["text"]


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_accepted_results_go_on_and_rejected_ones_stay_so(out: Location, tmp_path: Path) -> None:
    asked = rejected(out, None if out.local is not None else tmp_path)
    with pytest.raises(UsageError, match="name the scenes"):
        batch.judge(str(out), (), True)
    with pytest.raises(InputError, match="no such scene waits"):
        batch.judge(str(out), ("s3",), True)
    assert batch.judge(str(out), ("s0",), True)["scenes"] == ["s0"]
    assert batch.judge(str(out), ("*",), False)["scenes"] == ["s1"]
    state = status.read_status(asked.folder)
    assert (state.for_review, state.stages["command"].done, state.stages["command"].rejected) == (0, 3, 1)
    assert state.stages["command"].seconds == pytest.approx(1.5)
    assert work.Worker(asked, perform=writes).run() == {"done": 1}
    records = [json.loads(asked.folder.done(key).load()) for key in asked.folder.keys("done")]
    (accepted,) = (one for one in records if "accepted" in one)
    assert accepted["scene"] == "s0" and accepted["problems"] == ["x.json:n>=2: it is 0"] and "code" not in accepted
    (refused,) = (json.loads(asked.folder.failed(key).load()) for key in asked.folder.keys("failed"))
    assert refused["scene"] == "s1" and refused["reviewed"] is True


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_retry_holds_results_against_the_bounds_of_the_next_run(out: Location, tmp_path: Path) -> None:
    scratch = None if out.local is not None else tmp_path
    asked = rejected(out, scratch)
    assert batch.retry(str(out), "quality")["forgotten"] == 2
    assert review.waiting(asked.folder) == [] and status.read_status(asked.folder).for_review == 0
    rules = work.WorkRules(patience_s=0.0, bounds=quality.parse_bounds(["x.json:n>=1"]), scratch=scratch)
    kinder = work.WorkRequest(asked.folder, PLAN, asked.entries, rules)
    again: list[str] = []

    def noted(unit, folder: WorkFolder) -> Ending:
        again.append(f"{unit.entry.name} {unit.stage.name}")
        return writes(unit, folder)

    assert work.Worker(kinder, perform=noted).run() == {"done": 2, "rejected": 1}
    assert again == ["s1 score"], "what was made once is not made again"
    assert [one.scene for one in review.waiting(asked.folder)] == ["s0"]


def test_pictures_of_every_kind_are_chosen_first(tmp_path: Path) -> None:
    names = ["fit/preview/000001.png", "fit/preview/000002.png", "fit/preview/000003.png", "scene/contact_sheet.jpg", "fused/top.png",
             *(f"scene/images/front/{n:06d}.png" for n in range(9))]  # fmt: skip
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    chosen = [path.relative_to(tmp_path).as_posix() for path in review.pictures_of(tmp_path)]
    assert chosen == [
        "scene/contact_sheet.jpg",
        "fit/preview/000002.png",
        "fused/top.png",
        "scene/images/front/000000.png",
    ]
    assert review.pictures_of(tmp_path / "nothing") == []


def test_a_result_with_few_pictures_is_shown_with_those_it_was_made_of(tmp_path: Path) -> None:
    rejected(Location.of(tmp_path / "out"))
    made = BatchFolder(Location.of(tmp_path / "out"))
    (first, _), record = (
        review.waiting(made),
        {"scene": "x", "stage": "score", "key": "k", "problems": ["p"], "place": "x/score/k"},
    )
    (tmp_path / "inputs").mkdir()
    (tmp_path / "inputs/command").symlink_to(tmp_path / "out" / first.place)
    (tmp_path / "result").mkdir()
    review.put(made, record, tmp_path / "result", tmp_path / "inputs")
    assert [one.pictures for one in review.waiting(made) if one.scene == "x"] == [("1.jpg",)]


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert app.main(["batch", "review", str(out)]) == 3
    rejected(Location.of(out))
    capsys.readouterr()
    assert app.main(["batch", "review", str(out)]) == 0
    assert "s0 command: x.json:n>=2: it is 0" in capsys.readouterr().out
    assert app.main(["batch", "accept", str(out), "--scenes", "s0", "s1"]) == 0
    assert app.main(["batch", "reject", str(out), "--scenes", "s0"]) == 3
    assert "nothing waits" in capsys.readouterr().err
    assert [entry.name for entry in read_list(out)] == ["s0", "s1", "s2", "s3"], (
        "neither records nor reviews are sources"
    )
