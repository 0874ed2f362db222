"""``mudg bench edit RUN ...``: edits of recorded drives by measures that need no truth. A small street stands for a
log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mudg.base import geometry, store
from mudg.base.errors import InputError, UsageError
from mudg.benchmarks import edit_runs
from mudg.benchmarks import run as bench
from mudg.benchmarks.edit_runs import RunCase, measured
from mudg.benchmarks.settings import BenchConfig
from mudg.core.table import Table
from mudg.editing.runs import find_run
from mudg.editing.script import parse_edits
from mudg.gaussians.storage import load_model

FRAMES = 4


@pytest.fixture(scope="module")
def case(street_run: Path) -> RunCase:
    """The run of a car that drives ahead."""
    return edit_runs.case_of("street", find_run(street_run), torch.device("cpu"))


def test_an_edit_that_does_nothing_changes_nothing(case: RunCase) -> None:
    seen: list[bool] = []
    script = parse_edits("- move: {id: car, along_m: 0, ground: false}", "nothing")
    row = measured(case, script, lambda _, old, new: seen.append(torch.equal(old.rgb, new.rgb)))
    assert seen == [True] * FRAMES and row["outside"] == 0.0
    assert row["warp"] == row["warp_before"] > 0 and row["lidar"] == row["lidar_before"] > 0
    assert row["overlap"] == row["overlap_before"] > 0.3
    assert row["uncovered"] is None and row["structure"] is None and (row["collisions"], row["warnings"]) == (0, 0)


def test_the_lead_vehicle_is_taken_away(case: RunCase) -> None:
    assert case.lead == "car"
    row = measured(case, parse_edits("- remove: {ids: [car], close_street: false}", "remove"))
    assert row["overlap"] is None and row["overlap_before"] > 0.3
    assert row["uncovered"] > 0 and row["outside"] < 0.05
    assert abs(row["lidar"] - row["lidar_before"]) < 0.1 * row["lidar_before"]
    closed = measured(case, parse_edits("- remove: {ids: [car], close_street: true}", "closed"))
    assert closed["overlap"] is None and closed["uncovered_psnr"] is not None


def test_colours_that_no_photograph_shows_behind_the_vehicle_are_errors(case: RunCase) -> None:
    script = parse_edits("- remove: {ids: [car]}", "remove")
    table = case.model.table
    still = (table.labels["node"] == 0)[:, None, None]
    painted = {**{name: value.detach() for name, value in table.columns.items()}}
    painted["sh_dc"] = torch.where(still, -painted["sh_dc"], painted["sh_dc"])
    negative = replace(case.model, table=Table(painted, dict(table.labels)))
    right, wrong = (measured(replace(case, model=model), script) for model in (case.model, negative))
    assert right["uncovered_psnr"] > wrong["uncovered_psnr"] + 2
    assert right["uncovered"] == wrong["uncovered"]


def test_a_vehicle_ahead_is_preferred_to_a_larger_one_beside(case: RunCase) -> None:
    view, car = case.frames[0].view, case.scene.track("car")
    pose = car.pose_at(view.time_s)
    assert pose is not None and edit_runs._is_ahead(car, view)
    beside, behind = (geometry.yaw_matrix(0.0, shift) @ pose for shift in ((0.0, 5.0, 0.0), (-20.0, 0.0, 0.0)))
    for other in (beside, behind):
        assert not edit_runs._is_ahead(replace(car, world_from_object=np.stack([other] * len(car.times_s))), view)


def test_a_moved_vehicle_is_in_its_box_and_a_crash_is_counted(case: RunCase) -> None:
    moved = measured(case, parse_edits("- move: {id: car, along_m: 3}", "move"))
    assert abs(moved["overlap"] - moved["overlap_before"]) < 0.15 and moved["collisions"] == 0
    crash = measured(case, parse_edits("- move: {id: car, along_m: -8, left_m: 1.9}", "crash"))
    assert crash["collisions"] == 1 and crash["warnings"] >= 1 and "overlap" in crash["notes"][0]


def test_fog_keeps_depth_and_loses_edges_with_its_density(case: RunCase) -> None:
    rows = [measured(case, parse_edits(f"- weather: {{fog: {{visibility_m: {far}}}}}", "fog")) for far in (1000, 30)]
    assert all(row["lidar"] == row["lidar_before"] and row["outside"] is None for row in rows)
    assert 1 > rows[0]["structure"] > rows[1]["structure"] > 0


def test_measures_of_two_images_by_hand() -> None:
    """Gradients agree under another exposure; a byte step is no change."""
    image = torch.from_numpy(np.random.default_rng(0).random((3, 12, 16), np.float32))
    assert edit_runs.gradient_correlation(0.5 * image + 0.1, image) == pytest.approx(1)
    assert edit_runs.gradient_correlation(1 - image, image) == pytest.approx(-1)
    assert edit_runs.gradient_correlation(torch.zeros_like(image), image) is None
    image = torch.full((3, 2, 2), 0.5)
    other = image.clone()
    other[0, 0, 0] += 1 / 255
    other[2, 1, 1] -= 2 / 255
    assert edit_runs.changed_pixels(other, image).tolist() == [[False, False], [False, True]]


def test_two_drives_give_a_table_a_page_and_resume(
    street_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other"
    other.symlink_to(street_run)
    monkeypatch.setattr(edit_runs, "EDITS", {name: edit_runs.EDITS[name] for name in ("move 1 m left", "insert")})
    out, rounds = tmp_path / "out", []
    inner = edit_runs.measured

    def stopped(*given: object) -> dict[str, object]:
        rounds.append(given)
        if len(rounds) == 2:
            raise KeyboardInterrupt
        return inner(*given)

    monkeypatch.setattr(edit_runs, "measured", stopped)
    with pytest.raises(KeyboardInterrupt):
        bench.run("edit", BenchConfig(device="cpu"), out, sources=[street_run, other])
    bench.run("edit", BenchConfig(device="cpu"), out, sources=[street_run, other])
    assert len(rounds) == 5  # the row that was finished was not measured again
    doc = store.read_json(out / "bench.json")
    assert [(row["run"], row["edit"], row["given_by"]) for row in doc["rows"]] == [
        ("street", "move 1 m left", None),
        ("street", "insert", "other"),
        ("other", "move 1 m left", None),
        ("other", "insert", "street"),
    ]
    assert doc["rows"][1]["overlap"] > 0.3 and doc["rows"][1]["overlap_before"] == doc["rows"][0]["overlap_before"]
    page, text = (out / "page.html").read_text(), (out / "bench.md").read_text()
    assert page.count("<img ") == 4 * 2 * 3 and "http" not in page.split("<main")[1] and text.count("\n| street |") == 2
    bench.run("edit", BenchConfig(device="cpu"), out, sources=[street_run, other])
    assert len(rounds) == 5


def test_what_cannot_be_measured_is_refused_in_words(
    street_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for source, config, error, said in (
        (tmp_path / "nothing", BenchConfig(), InputError, "no fitted scene"),
        (street_run / "fit" / "street_gaussians", BenchConfig(), InputError, "of a fit alone"),
        (street_run, BenchConfig(harmonize=True), UsageError, "harmonize"),
    ):
        with pytest.raises(error, match=said):
            bench.run("edit", config, tmp_path / "a", sources=[source])
    assert not (tmp_path / "a").exists()
    model = load_model(street_run / "fit" / "street_gaussians")
    parts = find_run(street_run)
    with monkeypatch.context() as patch:
        patch.setattr(edit_runs, "model_of_scene", lambda *_: replace(model, classes=()))
        with pytest.raises(InputError, match="without labels"):
            edit_runs.case_of("bare", parts, torch.device("cpu"))
    scene = edit_runs.case_of("street", parts, torch.device("cpu"))
    with pytest.raises(InputError, match="no vehicle moves"):
        edit_runs.lead_of(scene.scene, replace(model, nodes=model.nodes[:1]), scene.frames, scene.points)
