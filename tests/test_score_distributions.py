"""FID and KID in the scorer: what is compared, floors, refusals, kept features, words for missing numbers."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import toy_views

from mudg.base import store
from mudg.base.errors import InputError, UsageError
from mudg.base.types import Observation
from mudg.core import feature_distances
from mudg.editing.settings import ScoreConfig
from mudg.networks import inception
from mudg.scene.read import read_scene
from mudg.scoring import sets as distributions
from mudg.scoring import tables as score_tables
from mudg.scoring.sets import FeatureFiles, ImageSet, TrajectorySets
from mudg.steps.render import Score
from mudg.viewer import report as page

CPU = torch.device("cpu")


class Squares(torch.nn.Module):
    """Stands for the network: 48 means of squares, and how many images it saw."""

    seen = 0

    def __init__(self, _state: object, _where: str = "") -> None:
        super().__init__()

    def forward(self, images: torch.Tensor) -> dict[str, torch.Tensor]:
        Squares.seen += len(images)
        means = torch.nn.functional.adaptive_avg_pool2d(images, 4).flatten(1)
        return torch.nn.functional.pad(means, (0, inception.WIDTH - 48))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A weight file, and a network that takes no time."""
    monkeypatch.setattr(inception, "InceptionFeatures", Squares)
    Squares.seen = 0
    path = tmp_path / "weights.safetensors"
    store.write_safetensors(path, {"any": np.zeros(1, np.float32)})
    return path


def darker(_index: int, seen: Observation) -> Observation:
    return dataclasses.replace(seen, rgb=seen.rgb * 0.5)


def values(document: dict, trajectory: str, name: str) -> dict[str, object]:
    return {r["method"]: r["values"][name] for r in document["results"] if r["trajectory"] == trajectory}


def scored(tmp_path: Path, weights: Path, shifts: tuple[float, ...] = (0.0, 2.0), **more: object) -> tuple[Path, dict]:
    scene = toy_views.write_scene(tmp_path / "scene")
    methods = {
        "a": toy_views.write_views(scene, tmp_path / "a", "a", shifts),
        "b": toy_views.write_views(scene, tmp_path / "b", "b", shifts, darker),
    }
    config = ScoreConfig(fid_weights=str(weights), perceptual_views=0, error_pictures=False, **more)
    out = Score(scene=scene, views=methods, out=tmp_path / "score", settings=config).run()
    return out, store.read_json(out / "metrics.json")


def test_a_log_is_compared_with_its_recorded_frames_off_its_path_too(tmp_path: Path, quick: Path) -> None:
    out, document = scored(tmp_path, quick)
    shifted = values(document, "front_shift+2.0", "fid")
    assert values(document, "front_shift+2.0", "psnr")["a"] == score_tables.NO_TRUTH
    assert shifted["a"] == pytest.approx(0.0, abs=1e-5)  # the toy's views are its recorded images
    assert shifted["b"] > 1.0
    assert values(document, "front_shift+2.0", "kid")["a"] < values(document, "front_shift+2.0", "kid")["b"]
    sizes = {r["trajectory"]: (r["distribution"]["n"], r["distribution"]["n_reference"]) for r in document["results"]}
    # held-out frames against the whole recorded video
    assert sizes == {"front_recorded": (2, 4), "front_shift+2.0": (4, 4)}
    made = document["distributions"]
    assert made["weights_sha256"] == store.sha256_file(quick) and made["resize"] == "pytorch-fid"
    assert not made["published_weights"]
    words = ("weights that are not the published file", "pytorch-fid")
    assert any(all(word in rule for word in words) for rule in document["rules"])
    sets = {(one["trajectory"], one["method"]): one for one in made["sets"]}
    kept = lambda name: store.read_safetensors(out / "features" / name)["features"]
    of_b = sets["front_shift+2.0", "b"]
    again = feature_distances.frechet_distance(kept(of_b["made"]), kept(of_b["reference"]))
    assert shifted["b"] == pytest.approx(again, abs=1e-5)
    floor, reference = made["floors"][0], kept(of_b["reference"])
    assert floor["how"] == "every second recorded frame against the others"
    apart = feature_distances.frechet_distance(reference[::2], reference[1::2])
    assert floor["fid"] == pytest.approx(apart, abs=1e-5)
    text = (out / "metrics.md").read_text()
    assert "FID and KID: 4 views of every method against 4 recorded frames." in text
    assert score_tables.FLOOR in text


def test_features_are_kept_by_content_and_not_computed_twice(tmp_path: Path, quick: Path) -> None:
    folder = tmp_path / "features"
    pictures = [toy_views.colors(i) for i in range(3)]
    files = FeatureFiles(quick, "tf1", folder, CPU)
    first = files.of(ImageSet(3, lambda n: pictures[n]))[1]
    assert Squares.seen == 3
    again = FeatureFiles(quick, "tf1", folder, CPU).of(ImageSet(3, lambda n: pictures[n].copy()))[1]
    assert Squares.seen == 3
    assert np.array_equal(first, again)
    files.of(ImageSet(3, lambda n: pictures[2 - n]))  # another order is another set
    FeatureFiles(quick, "clean", folder, CPU).of(ImageSet(3, lambda n: pictures[n]))
    assert Squares.seen == 9
    assert len(list(folder.glob("*.safetensors"))) == 3


def test_sets_of_different_size_are_refused_and_small_ones_have_no_number(tmp_path: Path, quick: Path) -> None:
    scene = read_scene(toy_views.write_scene(tmp_path / "scene"))
    found = distributions.distributions(scene, FeatureFiles(quick, "tf1", tmp_path / "features", CPU))
    some = {n: ImageSet(n, toy_views.colors) for n in (1, 3, 4)}
    sets = TrajectorySets("front_shift+2.0", "front", 48, 32, {"a": some[4], "b": some[3]}, None)
    with pytest.raises(InputError, match="a: 4, b: 3"):
        found.of(sets)
    assert found.of(dataclasses.replace(sets, methods={"a": some[1]})) == {"a": score_tables.TOO_FEW}
    assert found.of(dataclasses.replace(sets, camera="rear", methods={"a": some[4]})) == {"a": score_tables.NO_TRUTH}
    assert found.record()["floors"] == []
    truth = ImageSet(4, lambda n: toy_views.colors(n + 1))
    found.of(dataclasses.replace(sets, methods={"a": some[4]}, truth=truth))
    (floor,) = found.record()["floors"]
    assert floor["how"] == "true images of the same views"
    assert (floor["n"], floor["n_reference"]) == (4, 4)
    assert floor["fid"] > 0


def test_distances_with_different_n_are_not_averaged() -> None:
    courses = [{"name": name, "shift_m": shift} for name, shift in (("left", 2.0), ("right", -2.0))]
    rows = [
        {"trajectory": name, "method": "a", "values": {"fid": 5.0, "psnr": 20.0}, "distribution": {"n": n}}
        for name, n in (("left", 8), ("right", 7))
    ]
    (both,) = score_tables.by_distance(courses, ["a"], rows, ["psnr", "fid"])
    assert both["values"]["fid"] == score_tables.UNEQUAL
    assert both["values"]["psnr"] == 20.0
    rows[1]["distribution"]["n"] = 8
    assert score_tables.by_distance(courses, ["a"], rows, ["fid"])[0]["values"]["fid"] == 5.0


def test_large_sets_have_an_error() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((40, 3)), rng.standard_normal((64, 3))
    assert distributions.distances(a[:31], b)["kid_standard_error"] is not None
    assert distributions.distances(a[:24], b)["kid_standard_error"] is None  # three blocks


def test_without_weights_one_line_names_the_flags(tmp_path: Path) -> None:
    scene = toy_views.write_scene(tmp_path / "scene")
    views = toy_views.write_views(scene, tmp_path / "a", "a", (0.0,))
    out = Score(scene=scene, views={"a": views}, out=tmp_path / "score", settings=ScoreConfig(perceptual_views=0)).run()
    document = store.read_json(out / "metrics.json")
    for name in ("fid", "kid", "fvd", "lpips"):
        assert values(document, "front_recorded", name)["a"] == "not computed"
    assert "distributions" not in document
    assert not (out / "features").exists()
    assert "FVD (--fvd-weights)" in (out / "metrics.md").read_text()
    shown = page._score_values(document)
    assert "FID (Inception weights: mudg score --fid-weights FILE)" in shown["not_computed"]
    assert "Perceptual" not in [group["title"] for group in shown["score_groups"]]  # no table without a number


def test_weights_are_checked_before_the_work(tmp_path: Path) -> None:
    scene = toy_views.write_scene(tmp_path / "scene")
    views, out = {"a": toy_views.write_views(scene, tmp_path / "a", "a", (0.0,))}, tmp_path / "score"
    store.write_safetensors(tmp_path / "other.safetensors", {"conv1.weight": np.zeros(3, np.float32)})
    for weights, error, what in (
        (tmp_path / "nothing.pth", InputError, "nothing.pth"),
        (tmp_path / "other.safetensors", InputError, "Conv2d_1a_3x3.conv.weight"),
        (out / "weights.safetensors", UsageError, "fid-weights"),
    ):
        with pytest.raises(error, match=what):
            Score(scene=scene, views=views, out=out, settings=ScoreConfig(fid_weights=str(weights))).run()
        assert not (out / "truth").exists()
