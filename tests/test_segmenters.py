"""Segmentation networks from a folder: what is asked of the transformers package, and what is made of its answers.

Networks whose answer is known, under the package's names and output fields, show that classes arrive where they belong.
Tiny random networks of the package itself show that it is asked as it wants to be; they need the extra ``models``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from refusals import refused
from tiny_networks import NAMES as TINY_NAMES
from tiny_networks import mask2former, segformer

from mudg.base.errors import ResourceError
from mudg.base.palette import ID, UNLABELLED
from mudg.labels import segmenters
from mudg.labels.segmenters import KINDS, Segmenter, match_classes

NAMES = {"0": "Road", "1": "traffic light", "2": "sky", "3": "unicorn"}
MEAN, DEVIATION = [0.5, 0.5, 0.5], [0.25, 0.25, 0.25]


def scores(pixels: torch.Tensor) -> torch.Tensor:
    """Red pixels are class 0, green 1, blue 2; [B, 4, h, w] at a quarter of the size."""
    rgb = pixels * 0.25 + 0.5
    return torch.nn.functional.avg_pool2d(torch.cat([rgb, torch.zeros_like(rgb[:, :1])], 1) * 12, 4)


class Network(torch.nn.Module):
    """The parts of a network of transformers that are used."""

    def __init__(self, masks: bool) -> None:
        super().__init__()
        self.masks, self.seen = masks, []

    def forward(self, pixel_values: torch.Tensor) -> SimpleNamespace:
        self.seen.append(tuple(pixel_values.shape))
        logits = scores(pixel_values)
        if not self.masks:
            return SimpleNamespace(logits=logits)
        queries = torch.full((len(pixel_values), 4, 5), -9.0)
        queries[:, range(4), range(4)] = 9.0  # query n says class n; the last column is none
        return SimpleNamespace(class_queries_logits=queries, masks_queries_logits=logits * 2 - 12)


def folder_of(tmp_path: Path, kind: str) -> Path:
    config = {"model_type": kind, "id2label": NAMES}
    (tmp_path / "config.json").write_text(json.dumps(config))
    (tmp_path / "preprocessor_config.json").write_text(json.dumps({"image_mean": MEAN, "image_std": DEVIATION}))
    return tmp_path


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, dict[str, bool]]]:
    loaded: list[tuple[str, str, dict[str, bool]]] = []
    module = ModuleType("transformers")
    for kind, (class_name, _) in KINDS.items():

        def from_pretrained(path: str, _kind: str = kind, **named: bool) -> tuple[Network, dict[str, list[str]]]:
            loaded.append((_kind, path, named))
            return Network(masks=_kind != "segformer"), {"missing_keys": []}

        setattr(module, class_name, type(class_name, (), {"from_pretrained": staticmethod(from_pretrained)}))
    monkeypatch.setitem(sys.modules, "transformers", module)
    return loaded


def flag() -> np.ndarray:
    """Red, green and blue stripes, u8[64, 96, 3]."""
    return np.tile(np.repeat(255 * np.eye(3, dtype=np.uint8), 32, 0)[None], (64, 1, 1))


@pytest.mark.parametrize("kind", list(KINDS))
@pytest.mark.parametrize("tile_px", [1024, 40])
def test_classes_come_out_by_name_whole_and_in_tiles(
    package: list, kind: str, tile_px: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(segmenters, "TILE_PX", tile_px)
    folder = folder_of(tmp_path, kind)
    ids, confidence = Segmenter.load(folder).classes(flag())
    asked = {"local_files_only": True, "use_safetensors": True, "output_loading_info": True}
    assert package == [(kind, str(folder), asked)]
    for stripe, name in enumerate(("road", "traffic light", "sky")):
        inner = np.s_[:, 32 * stripe + 6 : 32 * stripe + 26]
        assert (ids[inner] == ID[name]).all() and (confidence[inner] > 0.9).all()
    assert ids.dtype == np.uint8 and confidence.dtype == np.float32 and ((confidence >= 0) & (confidence <= 1)).all()
    assert confidence[:, 31].max() < confidence[:, 10].min()  # less sure at the edge of a stripe


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("make", "size"), [(segformer, (64, 96)), (segformer, (45, 70)), (mask2former, (64, 96)), (mask2former, (45, 70))]
)
def test_real_networks_answer_as_the_package_says(
    make: Callable[[Path], Any], size: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One tile, against the package's own reading of its outputs, its post-processing; then several."""
    network = make(tmp_path)
    rgb = np.random.default_rng(4).integers(0, 255, (*size, 3), np.uint8)
    segmenter = Segmenter.load(tmp_path)
    ids, confidence = segmenter.classes(rgb)
    pixels = torch.from_numpy(rgb).permute(2, 0, 1)[None] / 255
    mean, deviation = (torch.tensor(v)[None, :, None, None] for v in ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]))
    with torch.inference_mode():
        output = network(pixel_values=(pixels - mean) / deviation)
    if make is segformer:
        logits = torch.nn.functional.interpolate(output.logits, size=size, mode="bilinear")
        expected = logits.softmax(1)[0]
    else:
        shares = output.class_queries_logits.softmax(-1)[0, :, : len(TINY_NAMES)]
        masks = torch.nn.functional.interpolate(output.masks_queries_logits, size=size, mode="bilinear").sigmoid()[0]
        expected = torch.einsum("qc,qhw->chw", shares, masks)
        expected = expected / expected.sum(0)
    best, which = expected[:3].max(0)  # the fourth is no class of ours
    ours = np.array([ID[TINY_NAMES[n].lower()] for n in range(3)])[which.numpy()]
    clear = (expected[:3].sort(0).values.diff(dim=0)[-1] > 1e-4).numpy()
    assert clear.mean() > 0.9 and (ids == ours)[clear].all()
    np.testing.assert_allclose(confidence, best.numpy(), atol=1e-5)
    monkeypatch.setattr(segmenters, "TILE_PX", 64)
    ids, confidence = segmenter.classes(np.tile(rgb, (2, 2, 1)))
    assert ids.shape == confidence.shape == (2 * size[0], 2 * size[1]) and np.isfinite(confidence).all()
    assert set(np.unique(ids)) <= {ID[TINY_NAMES[n].lower()] for n in range(3)}


@pytest.mark.filterwarnings("ignore")
def test_a_network_without_its_head_is_refused(tmp_path: Path) -> None:
    """As pretrained backbones are published: the package would leave the head random."""
    segformer(tmp_path).segformer.save_pretrained(str(tmp_path))
    settings = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**settings, "id2label": NAMES}))
    refused("decode_head", Segmenter.load, tmp_path)


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused("weights", Segmenter.load, "", raises=ResourceError)
    refused("another kind", Segmenter.load, folder_of(tmp_path, "bert"))
    folder_of(tmp_path, "segformer")
    monkeypatch.setitem(sys.modules, "transformers", None)
    refused("models", Segmenter.load, tmp_path, raises=ResourceError)
    assert match_classes(NAMES, "here").tolist() == [ID["road"], ID["traffic light"], ID["sky"], UNLABELLED]
    refused("Cityscapes", match_classes, {"0": "cat", "1": "dog"}, "here")
