"""Segmentation networks from a folder: what is asked of the transformers package, and what is made of its answers.

A stand-in with the package's names and output fields takes the place of the package, which is an extra.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from mudg.base.errors import InputError, ResourceError
from mudg.base.palette import ID, UNLABELLED
from mudg.models import segmenters
from mudg.models.segmenters import KINDS, Segmenter, match_classes, tile_starts

NAMES = {"0": "Road", "1": "traffic light", "2": "sky", "3": "unicorn"}
MEAN, DEVIATION = [0.5, 0.5, 0.5], [0.25, 0.25, 0.25]


def scores(pixels: torch.Tensor) -> torch.Tensor:
    """Red pixels are class 0, green 1, blue 2; [B, 4, h, w] at a quarter of the size."""
    rgb = pixels * 0.25 + 0.5
    return torch.nn.functional.avg_pool2d(torch.cat([rgb, torch.zeros_like(rgb[:, :1])], 1) * 12, 4)


class Network:
    """The parts of a network of transformers that are used."""

    def __init__(self, masks: bool) -> None:
        self.masks, self.seen = masks, []

    def eval(self) -> Network:
        return self

    def __call__(self, pixel_values: torch.Tensor) -> SimpleNamespace:
        self.seen.append(tuple(pixel_values.shape))
        logits = scores(pixel_values)
        if not self.masks:
            return SimpleNamespace(logits=logits)
        queries = torch.full((len(pixel_values), 4, 5), -9.0)
        queries[:, range(4), range(4)] = 9.0  # query n says class n; the last column is none
        return SimpleNamespace(class_queries_logits=queries, masks_queries_logits=logits * 2 - 12)


def folder_of(tmp_path: Path, kind: str, names: dict[str, str] | None = None) -> Path:
    (tmp_path / "config.json").write_text(
        json.dumps({"model_type": kind, "id2label": NAMES if names is None else names})
    )
    (tmp_path / "preprocessor_config.json").write_text(json.dumps({"image_mean": MEAN, "image_std": DEVIATION}))
    return tmp_path


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, dict[str, bool]]]:
    loaded: list[tuple[str, str, dict[str, bool]]] = []
    module = ModuleType("transformers")
    for kind, row in KINDS.items():

        def from_pretrained(path: str, _kind: str = kind, **named: bool) -> Network:
            loaded.append((_kind, path, named))
            return Network(masks=_kind != "segformer")

        setattr(module, row.class_name, SimpleNamespace(from_pretrained=from_pretrained))
    monkeypatch.setitem(sys.modules, "transformers", module)
    return loaded


def flag() -> np.ndarray:
    """Red, green and blue stripes, u8[64, 96, 3]."""
    rgb = np.zeros((64, 96, 3), np.uint8)
    for stripe in range(3):
        rgb[:, 32 * stripe : 32 * stripe + 32, stripe] = 255
    return rgb


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("tile_px", [1024, 40])
def test_classes_come_out_by_name_whole_and_in_tiles(
    package: list, kind: str, tile_px: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(segmenters, "TILE_PX", tile_px)
    folder = folder_of(tmp_path, kind)
    ids, confidence = Segmenter.load(folder).classes(flag())
    assert package == [(kind, str(folder), {"local_files_only": True, "use_safetensors": True})]
    for stripe, name in enumerate(("road", "traffic light", "sky")):
        inner = np.s_[:, 32 * stripe + 6 : 32 * stripe + 26]
        assert (ids[inner] == ID[name]).all()
        assert (confidence[inner] > 0.9).all()
    assert ids.dtype == np.uint8
    assert confidence.dtype == np.float32
    assert ((confidence >= 0) & (confidence <= 1)).all()
    assert confidence[:, 31].max() < confidence[:, 10].min()  # less sure at the edge of a stripe


def test_tiles_cover_everything_and_overlap() -> None:
    for length, tile in ((50, 64), (64, 64), (65, 64), (300, 64), (1920, 1024)):
        starts = tile_starts(length, tile)
        covered = np.zeros(length, bool)
        for start in starts:
            covered[start : start + tile] = True
        assert covered.all()
        assert starts[-1] == max(0, length - tile)
        assert all(b - a <= 0.75 * tile + 1 for a, b in zip(starts[:-1], starts[1:]))


def test_classes_without_a_name_of_ours_are_left_out() -> None:
    assert match_classes(NAMES, "here").tolist() == [ID["road"], ID["traffic light"], ID["sky"], UNLABELLED]
    with pytest.raises(InputError, match="Cityscapes"):
        match_classes({"0": "cat", "1": "dog"}, "here")


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ResourceError, match="weights"):
        Segmenter.load("")
    with pytest.raises(InputError, match="another kind"):
        Segmenter.load(folder_of(tmp_path, "bert"))
    folder_of(tmp_path, "eomt")
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ResourceError, match="models"):
        Segmenter.load(tmp_path)
