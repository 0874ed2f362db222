"""A small network that tells the Cityscapes classes of a street from colour and measured evidence.

An encoder and decoder with skips at strides 2 to 32. Colour and the planes of ``models.labels.evidence`` enter together as cells of
2x2 pixels, and the scores of a cell's four pixels leave together: nothing is computed at full size, and nothing of it is lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import store
from mudg.base.errors import InputError, IntegrityError, ResourceError
from mudg.base.palette import CLASSES
from mudg.models.labels.evidence import PLANE_COUNT

MODEL_FILE: Final = "model.json"
WEIGHTS_FILE: Final = "weights.safetensors"
EMBEDDED: Final = Path(__file__).resolve().parents[2] / "assets" / "segmenter_small"
"""The network that comes with the package."""
STRIDE: Final = 32
RGB_MEAN: Final = 0.42
RGB_SCALE: Final = 0.25


@dataclass(frozen=True)
class StreetNetConfig:
    """Shape of the network, the largest focal length it was trained at, and what its scores are divided by.

    Args:
        widths: channels at strides 2, 4, 8, 16 and 32.
        blocks: residual blocks there, on the way down.
        focal_px: images of a longer focal length are made smaller before they are looked at.
        temperature: scores are divided by this, so that probabilities tell how often the class is right.
    """

    widths: tuple[int, ...] = (32, 64, 96, 144, 144)
    blocks: tuple[int, ...] = (1, 2, 2, 2, 1)
    focal_px: float = 480.0
    temperature: float = 1.0


class _Block(nn.Module):
    """conv - norm - SiLU - conv around a residual."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.norm = nn.GroupNorm(8, width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.conv2.weight)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.conv2(functional.silu(self.norm(self.conv1(x))))


class StreetNet(nn.Module):
    """Class scores f32[N, 19, H, W] of colours f32[N, 3, H, W] in 0..1 and evidence f32[N, 17, H, W]; H, W multiples of 32."""

    def __init__(self, config: StreetNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = config.widths
        self.stem = nn.Conv2d(4 * (3 + PLANE_COUNT), widths[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, 2, padding=1) for a, b in zip(widths, widths[1:]))
        self.encode = nn.ModuleList(
            nn.Sequential(*(_Block(w) for _ in range(n))) for w, n in zip(widths, config.blocks)
        )
        self.context = nn.Linear(widths[-1], widths[-1])
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in zip(widths, widths[1:]))
        self.merge = nn.ModuleList(nn.Conv2d(2 * w, w, 3, padding=1) for w in widths[:-1])
        self.decode = nn.ModuleList(_Block(w) for w in widths[:-1])
        self.head = nn.Conv2d(widths[0], 4 * len(CLASSES), 1)

    def forward(self, rgb: Tensor, evidence: Tensor) -> Tensor:
        x = torch.cat([(rgb - RGB_MEAN) / RGB_SCALE, evidence], 1)
        x = self.stem(functional.pixel_unshuffle(x, 2).contiguous(memory_format=torch.channels_last))
        skips = []
        for level, blocks in enumerate(self.encode):
            x = blocks(x if level == 0 else self.down[level - 1](x))
            skips.append(x)
        x = x + self.context(functional.silu(x.mean((2, 3))))[:, :, None, None]
        for level in range(len(skips) - 2, -1, -1):
            x = functional.interpolate(self.up[level](x), scale_factor=2.0, mode="bilinear", align_corners=False)
            x = self.decode[level](functional.silu(self.merge[level](torch.cat([x, skips[level]], 1))))
        return functional.pixel_shuffle(self.head(functional.silu(x)), 2)

    @torch.inference_mode()
    def probabilities(self, rgb: NDArray[np.uint8], evidence: NDArray[np.float32]) -> NDArray[np.float32]:
        """Probability of each class f32[19, H, W] of an image u8[H, W, 3] and its evidence f32[17, H, W], of any size."""
        height, width = rgb.shape[:2]
        pad = (0, -width % STRIDE, 0, -height % STRIDE)
        color = functional.pad(torch.from_numpy(rgb.copy()).permute(2, 0, 1)[None].float() / 255, pad, mode="replicate")
        planes = functional.pad(torch.from_numpy(evidence)[None], pad, mode="replicate")
        device = self.head.weight.device
        scores = self(color.to(device), planes.to(device))[0, :, :height, :width].float()
        return (scores / self.config.temperature).softmax(0).cpu().numpy()


# files ----------------------------------------------------------------------------------------------------------------


def save(net: StreetNet, folder: Path, card: str, facts: Mapping[str, Any]) -> None:
    """Write a network as fp16 safetensors, ``model.json`` (shape, SHA-256 of the weights, facts) and MODEL_CARD.md."""
    store.write_safetensors(
        folder / WEIGHTS_FILE, {name: value.half().contiguous() for name, value in net.state_dict().items()}
    )
    store.write_text(folder / "MODEL_CARD.md", card)
    store.write_json(
        folder / MODEL_FILE,
        {"schema": 1, "kind": "street_net", "config": asdict(net.config),
         "files": {WEIGHTS_FILE: store.sha256_file(folder / WEIGHTS_FILE)}, "facts": dict(facts)},
    )  # fmt: skip


def load(folder: Path | str = EMBEDDED) -> StreetNet:
    """Read a network written by ``save``; without a folder, the one that comes with the package.

    Raises:
        ResourceError: no such folder. InputError: another kind of model, or other weights than its shape implies.
        IntegrityError: the weights do not match their recorded hash.
    """
    where = _described(folder)
    content = store.parse_json(store.read_bytes(where), str(where))
    if not isinstance(content, dict) or content.get("schema") != 1 or content.get("kind") != "street_net":
        raise InputError(
            "not a segmentation network of this package", where=str(where), expected="kind street_net, schema 1"
        )
    net = StreetNet(_config(content.get("config"), str(where)))
    file = where.parent / WEIGHTS_FILE
    digest = dict(content.get("files", {})).get(WEIGHTS_FILE)
    if not file.is_file() or store.sha256_file(file) != digest:
        raise IntegrityError(
            "a weight file is missing or altered", where=str(file), expected=f"sha256 {str(digest)[:16]}..."
        )
    state = {name: torch.from_numpy(value.copy()).float() for name, value in store.read_safetensors(file).items()}
    wanted = net.state_dict()
    wrong = sorted(set(wanted) ^ set(state)) or [n for n in wanted if wanted[n].shape != state[n].shape]
    if wrong:
        raise InputError("weights do not fit the configuration", where=str(folder), got=", ".join(wrong[:6]))
    net.load_state_dict(state)
    return net.eval().to(memory_format=torch.channels_last)


def digest(folder: Path | str = EMBEDDED) -> str:
    """Digest of a network's description, which holds the hash of its weights.

    Raises:
        ResourceError: no such folder.
    """
    return store.digest(_described(folder))


def _described(folder: Path | str) -> Path:
    """The description in a folder."""
    where = Path(folder) / MODEL_FILE
    if not where.is_file():
        raise ResourceError("the labeller's weights are missing", where=str(folder), expected=f"a folder with {MODEL_FILE}",
                            remedy="leave out --weights to use the network that comes with the package")  # fmt: skip
    return where


def _config(content: Any, where: str) -> StreetNetConfig:
    """The shape from a file, each number checked before anything is allocated."""
    names = {field.name for field in fields(StreetNetConfig)}
    if not isinstance(content, dict) or set(content) != names:
        raise InputError("the network's shape has other fields", where=where, expected=", ".join(sorted(names)))
    widths, blocks = content["widths"], content["blocks"]
    levels = [*widths, *blocks] if isinstance(widths, list) and isinstance(blocks, list) else []
    if (
        len(levels) != 10
        or len(widths) != 5
        or not all(type(n) is int and 1 <= n <= 1024 for n in levels)
        or any(w % 8 for w in widths)
    ):
        raise InputError("the network's shape is not possible", where=where,
                         expected="5 widths, multiples of 8 up to 1024, and 5 numbers of blocks", got=f"{widths}, {blocks}")  # fmt: skip
    focal, temperature = content["focal_px"], content["temperature"]
    if not all(isinstance(n, int | float) and 0 < n < 1e5 for n in (focal, temperature)):
        raise InputError("focal_px and temperature are positive numbers", where=where, got=f"{focal}, {temperature}")
    return StreetNetConfig(tuple(widths), tuple(blocks), float(focal), float(temperature))
