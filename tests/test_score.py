"""Scores with known answers."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import toy_views
from refusals import refused

from mudg.base import geometry, store
from mudg.base.errors import UsageError
from mudg.base.types import FusedCloud, Observation, PointCloud, View
from mudg.core.metrics import METRICS
from mudg.editing.settings import ScoreConfig
from mudg.scoring import score
from mudg.scoring import tables as score_tables
from mudg.steps.render import Score

PLAIN = ScoreConfig(perceptual_views=0)


def brighter(step: int) -> object:
    """Every channel of every pixel ``step`` grey values brighter: a mean squared error of exactly (step / 255)^2."""
    return lambda _, seen: dataclasses.replace(seen, rgb=seen.rgb + step / 255)


def scored(scene: Path, out: Path, settings: ScoreConfig = PLAIN, **views: Path) -> dict:
    return store.read_json(Score(scene=scene, views=views, out=out, settings=settings).run() / "metrics.json")


def of_one(scene: Path, folder: Path, *change: Any) -> dict:
    """Scores of a method on the recorded path."""
    return scored(scene, folder / "score", a=toy_views.write_views(scene, folder / "a", "a", (0.0,), *change))


def value(document: dict, method: str, trajectory: str, metric: str) -> object:
    (found,) = (r for r in document["results"] if (r["method"], r["trajectory"]) == (method, trajectory))
    return found["values"][metric]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return toy_views.write_scene(tmp_path / "scene")


def test_known_colour_error_gives_known_psnr(tmp_path: Path, scene: Path) -> None:
    plain = toy_views.write_views(scene, tmp_path / "a", "a", (0.0,), brighter(5))
    worse = toy_views.write_views(scene, tmp_path / "b", "b", (0.0,), brighter(20))
    document = scored(scene, tmp_path / "score", street_gaussians=plain, mudg_s=worse)
    for method, step in (("street_gaussians", 5), ("mudg_s", 20)):
        assert value(document, method, "front_recorded", "psnr") == pytest.approx(20 * math.log10(255 / step), abs=1e-4)
    assert value(document, "mudg_s", "front_recorded", "miou") == 1.0
    assert value(document, "mudg_s", "front_recorded", "abs_rel") == 0.0


def test_only_held_out_frames_count_on_the_recorded_path(tmp_path: Path, scene: Path) -> None:
    spoilt = lambda index, seen: seen if index % 2 else dataclasses.replace(seen, rgb=torch.zeros_like(seen.rgb))
    (found,) = of_one(scene, tmp_path, spoilt)["results"]  # in training frames
    assert (found["views"], found["values"]["psnr"]) == (2, 100.0)  # equal pictures


def test_a_recorded_log_has_no_truth_off_its_path(tmp_path: Path, scene: Path) -> None:
    views = toy_views.write_views(scene, tmp_path / "a", "a", (0.0, 2.0))
    out = Score(scene=scene, views={"a": views}, out=tmp_path / "score", settings=PLAIN).run()
    document = store.read_json(out / "metrics.json")
    assert document["truth"] == "recorded"
    assert value(document, "a", "front_shift+2.0", "psnr") == score_tables.NO_TRUTH
    assert value(document, "a", "front_shift+2.0", "fid") == "not computed"
    assert not (out / "truth" / "front_shift+2.0").exists()
    assert "no truth" in score.summary_table(out)


def test_what_a_method_does_not_produce_is_not_a_zero(tmp_path: Path, scene: Path) -> None:
    color_only = lambda _, seen: dataclasses.replace(seen, depth=None, semantics=None)
    values = of_one(scene, tmp_path, color_only)["results"][0]["values"]
    assert [values[name] for name in ("abs_rel", "miou", "psnr")] == ["not produced", "not produced", 100.0]


def test_labels_that_the_log_lacks_are_no_truth(tmp_path: Path) -> None:
    values = of_one(toy_views.write_scene(tmp_path / "scene", labels=False), tmp_path)["results"][0]["values"]
    assert values["miou"] == values["abs_rel"] == score_tables.NO_TRUTH


def test_missing_depth_counts_as_the_limit(tmp_path: Path, scene: Path) -> None:
    nowhere = lambda _, seen: dataclasses.replace(seen, depth=torch.full_like(seen.depth, torch.nan))
    document = of_one(scene, tmp_path, nowhere)
    true = toy_views.depths()[np.isfinite(toy_views.depths())].astype(np.float64)
    expected = float(np.mean((80.0 - true) / true))
    assert value(document, "a", "front_recorded", "abs_rel") == pytest.approx(expected, rel=1e-4)


def test_methods_of_other_sizes_are_compared_at_the_cameras_size(tmp_path: Path, scene: Path) -> None:
    def half(_index: int, seen: Observation) -> Observation:
        view, gray = seen.view.resized(toy_views.WIDTH // 2, toy_views.HEIGHT // 2), torch.full_like(seen.rgb, 0.5)
        planes = {"rgb": gray, **{name: getattr(seen, name) for name in ("depth", "semantics", "confidence", "mask")}}
        return dataclasses.replace(seen, view=view, **{name: of[..., ::2, ::2] for name, of in planes.items()})

    small = toy_views.write_views(scene, tmp_path / "a", "a", (0.0,), half)
    full = toy_views.write_views(scene, tmp_path / "b", "b", (0.0,))
    document = scored(scene, tmp_path / "score", a=small, b=full)
    course = document["trajectories"][0]
    assert (course["width"], course["height"]) == (toy_views.WIDTH, toy_views.HEIGHT)
    assert value(document, "b", "front_recorded", "psnr") == 100.0
    grey = [np.mean((128 / 255 - toy_views.colors(i) / 255) ** 2) for i in (1, 3)]  # stored as 8 bits: 0.5 becomes 128
    expected = float(np.mean([-10 * math.log10(e) for e in grey]))
    assert value(document, "a", "front_recorded", "psnr") == pytest.approx(expected, abs=1e-3)


def test_only_views_that_all_methods_have_are_compared(tmp_path: Path, scene: Path) -> None:
    full = toy_views.write_views(scene, tmp_path / "a", "a", (0.0,))
    part = toy_views.write_views(scene, tmp_path / "b", "b", (0.0,))
    index = store.read_json(part / "front_recorded" / "observations.json")
    index["observations"] = index["observations"][:3]
    store.write_json(part / "front_recorded" / "observations.json", index)
    document = scored(scene, tmp_path / "score", a=full, b=part)
    assert document["trajectories"][0]["views"] == 3
    assert {r["views"] for r in document["results"]} == {1}


def test_what_cannot_be_compared_is_refused(tmp_path: Path, scene: Path) -> None:
    here = toy_views.write_views(scene, tmp_path / "a", "a", (2.0,))
    there = toy_views.write_views(scene, tmp_path / "b", "b", (3.0,))
    (there / "front_shift+3.0").rename(there / "front_shift+2.0")
    (tmp_path / "empty").mkdir()
    refused("different positions", scored, scene, tmp_path / "score", a=here, b=there)
    refused("no views were given", scored, scene, tmp_path / "score", raises=UsageError)
    refused("none of the folders", scored, scene, tmp_path / "score", a=tmp_path / "empty")


def test_two_runs_give_the_same_bytes(tmp_path: Path, scene: Path) -> None:
    views = toy_views.write_views(scene, tmp_path / "a", "a", (0.0, -3.0), brighter(9))
    outs = (tmp_path / "one", tmp_path / "two")
    first, second = (Score(scene=scene, views={"a": views}, out=out, settings=ScoreConfig()).run() for out in outs)
    for name in ("metrics.json", "metrics.md", "errors/front_recorded.png"):
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_large_images_score_as_small_ones_do(tmp_path: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Views one after the other, methods beside each other."""
    shade = lambda name: toy_views.write_views(scene, tmp_path / name, name, (0.0,), brighter(9 * len(name)))
    views = {name: shade(name) for name in ("a", "bb")}
    small = scored(scene, tmp_path / "small", ScoreConfig(), **views)["results"]
    monkeypatch.setattr(score, "WHOLE_PIXELS", 0)
    large = scored(scene, tmp_path / "large", ScoreConfig(), **views)["results"]
    assert [one["method"] for one in small] == [one["method"] for one in large] == ["a", "bb"]
    for one, other in zip(small, large, strict=True):
        assert isinstance(one["values"]["perceptual"], float) and one == other


def test_distances_average_both_sides_and_mark_the_best() -> None:
    courses = [{"name": n, "shift_m": s} for n, s in (("l", 2.0), ("r", -2.0), ("here", 0.0), ("odd", None))]
    of_a, of_b = {"l": 20.0, "r": 24.0, "here": 30.0}, {"l": 21.0, "r": "no truth"}
    pairs = [(m, t, v) for m, of in (("a", of_a), ("b", of_b)) for t, v in of.items()]
    results = [{"method": m, "trajectory": t, "values": {"psnr": v}} for m, t, v in pairs]
    table = score_tables.by_distance(courses, ["a", "b"], results, ["psnr"])
    found = {(row["method"], row["distance_m"]): row["values"]["psnr"] for row in table}
    assert found == {("a", 0.0): 30.0, ("b", 0.0): "not produced", ("a", 2.0): 22.0, ("b", 2.0): 21.0}
    sides = {row["distance_m"]: row["sides"] for row in table}
    assert sides == {0.0: "recorded", 2.0: "both"}
    document = {"by_distance": table, "scene": {"held_out": 0}}
    assert score_tables.distance_title(document, 2.0) == "2 m to either side"
    assert score_tables.distance_title(document, 0.0) == "recorded path, all frames"
    left = {"by_distance": score_tables.by_distance(courses[:1], ["a"], results, ["psnr"]), "scene": {"held_out": 1}}
    assert score_tables.distance_title(left, 2.0) == "2 m to the left"
    assert score_tables.best_of("higher", {"a": 1.0, "b": 2.0, "c": "not computed"}, "psnr") == {"b"}
    assert score_tables.best_of("lower", {"a": 0.1001, "b": 0.1004}, "abs_rel") == {"a", "b"}  # equal as shown
    assert score_tables.best_of("lower", {"a": 0.1}, "abs_rel") == set()
    flicker = {"steadier than the truth": 0.4, "near it": 0.9, "restless": 1.3}
    assert score_tables.best_of(METRICS["flicker"].better, flicker, "flicker") == {"near it"}


def test_baseline_fills_holes_with_the_nearest_point_and_sees_nothing_behind(scene: Path) -> None:
    """Two walls of points, red at 10 m on the left and green at 20 m on the right."""
    view = View(toy_views.CAMERA, toy_views.EGO_FROM_CAM, 0.0)
    rows, columns = np.mgrid[2 : toy_views.HEIGHT : 4, 4:12:4]
    left = geometry.unproject(view, np.stack([columns, rows], -1).reshape(-1, 2) + 0.5, np.full(rows.size, 10.0))
    right = geometry.unproject(view, np.stack([columns + 32, rows], -1).reshape(-1, 2) + 0.5, np.full(rows.size, 20.0))
    xyz = np.concatenate([left, right]).astype(np.float32)
    rgb = np.repeat(np.array([[255, 0, 0], [0, 255, 0]], np.uint8), rows.size, 0)
    cloud = FusedCloud(PointCloud(xyz, rgb, "world", np.repeat(np.array([0, 13], np.uint8), rows.size)), {})
    seen = score.nearest_fill(cloud, {}, view)
    middle = (8 + 36) // 2 + 1
    assert bool((seen.rgb[0, :, : middle - 4] == 1).all())
    assert bool((seen.rgb[1, :, middle + 4 :] == 1).all())
    for column, depth in ((0, 10.0), (-1, 20.0)):
        assert torch.allclose(seen.depth[0, :, column], torch.tensor(depth))
    assert set(seen.semantics.unique().tolist()) == {0, 13}
    xyz, rgb = np.array([[-5.0, 0, 1]], np.float32), np.zeros((1, 3), np.uint8)
    behind = PointCloud(xyz, rgb, "world", np.zeros(1, np.uint8))
    seen = score.nearest_fill(FusedCloud(behind, {}), {}, view)
    assert seen.depth is not None and bool(torch.isnan(seen.depth).all())
    assert seen.semantics is not None and set(seen.semantics.unique().tolist()) == {255}


def test_lidar_is_the_depth_truth_of_a_log_without_depth_labels(tmp_path: Path) -> None:
    scene = toy_views.write_scene(tmp_path / "scene", labels=False, lidar=True)
    at_12_m = lambda _, seen: dataclasses.replace(seen, depth=torch.full_like(seen.depth, 12.0))
    document = of_one(scene, tmp_path, at_12_m)
    assert value(document, "a", "front_recorded", "rmse_m") == pytest.approx(2.0, abs=1e-4)  # the wall stands at 10 m
