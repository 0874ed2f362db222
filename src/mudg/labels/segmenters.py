"""Classes by a pretrained segmentation network from a folder on disk, as transformers writes it: SegFormer or
Mask2Former with Cityscapes classes, matched with ours by name. Large images are cut into overlapping tiles whose
probabilities are averaged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mudg.base.errors import InputError, ResourceError
from mudg.base.palette import CLASSES, UNLABELLED
from mudg.networks import folders
from mudg.networks.folders import CPU

TILE_PX: Final = 1024
OVERLAP: Final = 0.25
BATCH: Final = 2


def _dense(output: Any, size: tuple[int, int]) -> Tensor:
    """SegFormer: logits [B, C, h, w] -> probabilities [B, C, H, W]."""
    logits = functional.interpolate(output.logits.float(), size=size, mode="bilinear", align_corners=False)
    return logits.softmax(1)


def _masks(output: Any, size: tuple[int, int]) -> Tensor:
    """Mask2Former: classes [B, Q, C + 1] (the last: none), masks [B, Q, h, w] -> probabilities [B, C, H, W]."""
    classes = output.class_queries_logits.float().softmax(-1)[..., :-1]
    masks = functional.interpolate(output.masks_queries_logits.float(), size=size, mode="bilinear", align_corners=False)
    scores = torch.einsum("bqc,bqhw->bchw", classes, masks.sigmoid())
    return scores / scores.sum(1, keepdim=True).clamp(min=1e-6)


KINDS: Final[Mapping[str, tuple[str, Callable[[Any, tuple[int, int]], Tensor]]]] = {
    "segformer": ("SegformerForSemanticSegmentation", _dense),
    "mask2former": ("Mask2FormerForUniversalSegmentation", _masks),
}
"""``model_type`` of a folder's ``config.json`` -> class of transformers that holds the network, and how its output
becomes probabilities."""


class Segmenter:
    """A network ready for use; ``load`` makes one from a folder."""

    def __init__(
        self,
        network: Any,
        kind: str,
        train_ids: NDArray[np.intp],
        mean: Sequence[float],
        deviation: Sequence[float],
        device: torch.device = CPU,
    ) -> None:
        """``train_ids`` [C]: our class of each of the network's, UNLABELLED = none; mean and deviation of colours in
        0..1."""
        self._network, self._becomes, self._train_ids = network, KINDS[kind][1], train_ids
        self._mean = torch.tensor(mean, dtype=torch.float32)[:, None, None]
        self._deviation = torch.tensor(deviation, dtype=torch.float32)[:, None, None]
        self._device = device

    @classmethod
    def load(cls, folder: str | Path, device: torch.device = CPU) -> Segmenter:
        """Read a network from a folder. ResourceError: the folder or the transformers package is missing. InputError:
        another kind of network, one that lacks weights, or none of its class names is one of ours."""
        path = Path(folder)
        if not folder or not (path / "config.json").is_file():
            expected = "a folder with config.json and model.safetensors"
            given = "give the folder of a segmentation network with Cityscapes classes as --weights"
            remedy = f"{given}, or use --labeller embedded"
            what, where = "the labeller's weights are missing", str(folder) or "weights"
            raise ResourceError(what, where=where, expected=expected, remedy=remedy)
        settings = folders.read_settings(path / "config.json")
        kind = str(settings.get("model_type"))
        if kind not in KINDS:
            what = "the folder holds another kind of network"
            raise InputError(what, where=str(path / "config.json"), expected=", ".join(KINDS), got=kind)
        train_ids = match_classes(settings.get("id2label", {}), str(path / "config.json"))
        prepared = path / "preprocessor_config.json"
        colors = folders.read_settings(prepared) if prepared.is_file() else {}
        network_class = folders.member(folders.package("transformers"), KINDS[kind][0])
        network = folders.load_network(network_class, path, device)
        mean, deviation = colors.get("image_mean", folders.MEAN), colors.get("image_std", folders.DEVIATION)
        return cls(network, kind, train_ids, mean, deviation, device)

    def classes(self, rgb: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Train ids u8[H, W] and the probability of each f32[H, W] of an image u8[H, W, 3]."""
        image = torch.from_numpy(rgb.copy()).permute(2, 0, 1).float() / 255
        total = self._probabilities((image - self._mean) / self._deviation)
        confidence, ids = total.max(0)
        return ids.numpy().astype(np.uint8), confidence.clamp(0, 1).numpy()

    def _probabilities(self, image: Tensor) -> Tensor:
        """Probability of each of our classes [C, H, W] of a normalised image [3, H, W], tile by tile."""
        height, width = image.shape[1:]
        tile = (min(height, TILE_PX), min(width, TILE_PX))
        corners = [(y, x) for y in tile_starts(height, tile[0]) for x in tile_starts(width, tile[1])]
        total = torch.zeros(len(CLASSES), height, width)
        weight = torch.zeros(1, height, width)
        ours = torch.from_numpy(self._train_ids)
        known = ours != UNLABELLED
        rows, columns = (1 - torch.linspace(-1, 1, size).abs() * 0.95 for size in tile)
        fade = rows[:, None] * columns[None]  # the weight of a tile's pixels falls towards its edges
        for first in range(0, len(corners), BATCH):
            chosen = corners[first : first + BATCH]
            tiles = torch.stack([image[:, y : y + tile[0], x : x + tile[1]] for y, x in chosen])
            with torch.inference_mode():
                output = self._network(pixel_values=tiles.to(self._device))
                found = self._becomes(output, tile).cpu()
            for (y, x), probabilities in zip(chosen, found, strict=True):
                window = total[:, y : y + tile[0], x : x + tile[1]]
                window.index_add_(0, ours[known], probabilities[known] * fade)
                weight[:, y : y + tile[0], x : x + tile[1]] += fade
        return total / weight


def match_classes(names: Mapping[str, str], where: str) -> NDArray[np.intp]:
    """Our train id of each class of a network by its name, UNLABELLED where we have none; i64[C]. InputError: none of
    the names is one of ours."""
    wanted = {name.replace(" ", "").lower(): index for index, name in enumerate(CLASSES)}
    ordered = [names[key] for key in sorted(names, key=int)]
    found = [wanted.get(str(name).replace(" ", "").replace("_", "").lower(), UNLABELLED) for name in ordered]
    if set(found) <= {UNLABELLED}:
        expected, got = ", ".join(CLASSES), ", ".join(map(str, ordered[:8])) or "no id2label"
        raise InputError("none of the network's classes is a Cityscapes class", where=where, expected=expected, got=got)
    return np.array(found, np.intp)


def tile_starts(length: int, tile: int) -> list[int]:
    """First pixels of tiles that cover ``length``, evenly spread, overlapping by at least ``OVERLAP`` of a tile."""
    if length <= tile:
        return [0]
    count = 1 + int(np.ceil((length - tile) / (tile * (1 - OVERLAP))))
    return [round(at) for at in np.linspace(0, length - tile, count)]
