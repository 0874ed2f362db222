"""FVD's network: names in both layouts, TensorFlow's padding by hand, a twin of a unit, and FVD in the scorer."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import toy_views
from refusals import refused

from mudg.base import store
from mudg.base.errors import InputError
from mudg.editing.settings import ScoreConfig
from mudg.networks import folders, i3d
from mudg.scene.read import read_scene
from mudg.scoring import sets as videos
from mudg.scoring import tables as score_tables
from mudg.steps.render import Score
from mudg.viewer import report as page


def made_up() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, shape in i3d.tensor_shapes().items():
        noise = torch.randn(shape, generator=generator)
        scale = math.sqrt(2 / math.prod(shape[1:])) if name.endswith("conv3d.weight") else 0.1
        state[name] = 0.5 + noise.abs() if name.endswith(("running_var", "bn.weight")) else noise * scale
    return state


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    return made_up()


def renamed(name: str) -> str:
    """The other layout's name, written out once more."""
    for theirs, ours in (("b1a", "1.0"), ("b1b", "1.1"), ("b2a", "2.0"), ("b2b", "2.1"), ("b3b", "3.1"), ("b0", "0")):
        name = name.replace(f".{theirs}.", f".branch_{ours}.")
    name = name.replace(".bn.", ".batch3d.").replace("Mixed", "mixed")
    return name.replace("Conv3d_", "conv3d_").replace("logits", "conv3d_0c_1x1")


def test_tensors_and_values_are_those_of_the_published_files() -> None:
    shapes = i3d.tensor_shapes()
    assert len(shapes) == 287
    learned = sum(math.prod(shape) for name, shape in shapes.items() if "running" not in name)
    assert learned == 12_697_264


@pytest.mark.slow
def test_both_layouts_give_equal_features_and_the_epsilon_matters(state, monkeypatch) -> None:
    clip = torch.rand(1, 3, 9, 224, 224, generator=torch.Generator().manual_seed(1)) * 2 - 1
    with torch.no_grad():
        one = i3d.I3DFeatures(state)(clip)
        other = i3d.I3DFeatures({renamed(name): value for name, value in state.items()})(clip)
        monkeypatch.setattr(folders, "NORM_EPSILON", 1e-5)
        fine = i3d.I3DFeatures(state)(clip)
    assert one.shape == (1, 400) and torch.equal(one, other) and not torch.equal(one, fine)


def test_short_clips_and_other_sizes_are_refused(state) -> None:
    network = i3d.I3DFeatures(state)
    for shape in ((1, 3, 8, 224, 224), (1, 3, 16, 256, 256), (1, 16, 3, 224, 224)):
        with pytest.raises(InputError, match="clips of one size"):
            network(torch.zeros(shape))
    with pytest.raises(InputError, match="missing: Mixed_4e.b2a.bn.bias"):
        i3d.I3DFeatures({name: value for name, value in state.items() if name != "Mixed_4e.b2a.bn.bias"}, "mine")
    refused("extra", i3d.I3DFeatures, {**state, "extra": torch.zeros(1)})


@pytest.mark.parametrize(
    ("length", "kernel", "stride", "front", "back"),
    [(16, 7, 2, 2, 3), (9, 7, 2, 3, 3), (8, 3, 2, 0, 1), (5, 3, 2, 1, 1)]
    + [(5, 2, 2, 0, 1), (4, 2, 2, 0, 0), (6, 3, 1, 1, 1)],
)
def test_padding_of_the_rule_same(length: int, kernel: int, stride: int, front: int, back: int) -> None:
    row = torch.arange(1.0, length + 1).view(1, 1, length, 1, 1)
    found = i3d.same_padded(row, (kernel, 1, 1), (stride, 1, 1)).flatten().tolist()
    assert found == [0.0] * front + list(range(1, length + 1)) + [0.0] * back


def test_rules_of_frames() -> None:
    wide = np.zeros((100, 200, 3), np.uint8)
    wide[:, 100:] = 255
    wide[:, :20] = wide[:, 180:] = 128
    cut, squashed = i3d.prepared_frame(wide, "videogpt"), i3d.prepared_frame(wide, "stylegan-v")
    assert cut.shape == squashed.shape == (3, 224, 224)
    assert set(cut[0, 100].round(decimals=1).unique().tolist()) >= {-1.0, 1.0}
    assert float(cut[0, 100, 0]) == -1.0  # what lies beside the middle is cut off
    assert float(squashed[0, 100, 0]) == pytest.approx(2 * 128 / 255 - 1, abs=1e-5)
    white = i3d.prepared_frame(np.full((37, 50, 3), 255, np.uint8), "google")
    assert float(white.min()) == pytest.approx(1.0, abs=1e-5)


class Means(torch.nn.Module):
    """Stands for the network: means of 16 frames, so that the order of time counts."""

    def __init__(self, _state: object, _where: str = "") -> None:
        super().__init__()

    def forward(self, clips: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.pad(clips.mean((3, 4)).flatten(1), (0, 400 - 48))


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file for ``Means``; toy scenes have 40 frames."""
    monkeypatch.setattr(i3d, "I3DFeatures", Means)
    monkeypatch.setattr(toy_views, "FRAMES", 40)
    store.write_safetensors(tmp_path / "weights.safetensors", {"any": np.zeros(1, np.float32)})
    return tmp_path / "weights.safetensors"


def test_clips_floor_and_reasons(weights: Path, tmp_path: Path) -> None:
    assert [videos.clip_count(n) for n in (0, 15, 16, 23, 24, 40)] == [0, 0, 1, 1, 2, 4]
    scene = read_scene(toy_views.write_scene(tmp_path / "scene"))
    found = videos.videos(scene, videos.ClipFiles(weights, "videogpt", tmp_path, torch.device("cpu")))
    same = videos.ImageSet(40, toy_views.colors)
    backwards = videos.ImageSet(40, lambda n: toy_views.colors(39 - n))
    sets = videos.TrajectorySets("front_shift+2.0", "front", 48, 32, {"a": same, "b": backwards}, None)
    values = found.of(sets)
    assert values["a"] == {"values": {"fvd": pytest.approx(0.0, abs=1e-5)}, "n": 4, "n_reference": 4}
    assert values["b"]["values"]["fvd"] > 1e-3
    (floor,) = found.record()["floors"]
    assert (floor["n"], floor["n_reference"]) == (2, 2)
    sets = {"a": videos.ImageSet(20, toy_views.colors)}
    short = videos.TrajectorySets("x", "front", 48, 32, sets, None)
    assert found.of(short) == {"a": score_tables.TOO_FEW}


def test_the_scorer_writes_fvd_with_its_sizes_and_floor(weights: Path, tmp_path: Path) -> None:
    scene = toy_views.write_scene(tmp_path / "scene")
    views = toy_views.write_views(scene, tmp_path / "a", "a", (0.0, 2.0))
    config = ScoreConfig(fvd_weights=str(weights), perceptual_views=0, error_pictures=False)
    out = Score(scene=scene, views={"a": views}, out=tmp_path / "score", settings=config).run()
    document = store.read_json(out / "metrics.json")
    for row in document["results"]:  # all views count, on the recorded path as well
        assert row["values"]["fvd"] == pytest.approx(0.0, abs=1e-5) and row["video"] == {"n": 4, "n_reference": 4}
        assert row["values"]["fid"] == "not computed"
    assert document["videos"]["weights_sha256"] == store.sha256_file(weights)
    assert [floor["trajectory"] for floor in document["videos"]["floors"]] == ["front_recorded", "front_shift+2.0"]
    text = (out / "metrics.md").read_text()
    assert "* FVD: 4 clips of every method against 4 recorded clips." in text
    assert f"* {score_tables.FLOOR}: FVD " in text
    group = next(g for g in page._score_values(document)["score_groups"] if g["title"] == "Distribution")
    assert [m["name"] for m in group["metrics"]] == ["fvd"]
