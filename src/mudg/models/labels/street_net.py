"""A small segmentation network: Cityscapes classes of a street from colour and measured evidence.

An encoder and decoder with skips at strides 2 to 32. Colour and the planes of ``models.labels.evidence`` enter together as cells of
2x2 pixels, and the scores of a cell's four pixels leave together: nothing is computed at full size, and nothing of it is lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from pydantic.dataclasses import dataclass
from torch import Tensor, nn
from torch.nn import functional

from mudg.base import records, shards, store
from mudg.base.config import STRICT
from mudg.base.errors import InputError, ResourceError
from mudg.base.palette import CLASSES
from mudg.models.labels.evidence import PLANE_COUNT

MODEL_FILE: Final = "model.json"
WEIGHTS_FILE: Final = "weights.safetensors"
EMBEDDED: Final = Path(__file__).resolve().parents[2] / "assets" / "segmenter_small"
"""The network that comes with the package."""
STRIDE: Final = 32
RGB_MEAN: Final = 0.42
RGB_SCALE: Final = 0.25
Width = Annotated[int, Field(ge=1, le=1024, multiple_of=8)]
BlockCount = Annotated[int, Field(ge=1, le=1024)]
Positive = Annotated[float, Field(gt=0, lt=1e5)]


@dataclass(frozen=True, config=STRICT)
class StreetNetConfig:
    """Shape of the network, the largest focal length it was trained at, and what its scores are divided by.

    Args:
        widths: channels at strides 2, 4, 8, 16 and 32.
        blocks: residual blocks there, on the way down.
        focal_px: images of a longer focal length are made smaller first.
        temperature: scores are divided by this, so that probabilities tell how often the class is right.
    """

    widths: tuple[Width, Width, Width, Width, Width] = (32, 64, 96, 144, 144)
    blocks: tuple[BlockCount, BlockCount, BlockCount, BlockCount, BlockCount] = (1, 2, 2, 2, 1)
    focal_px: Positive = 480.0
    temperature: Positive = 1.0


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
        raise InputError("not a segmentation network of this package", where=str(where), expected="kind street_net, schema 1")
    with records.understood("a segmentation network", str(where)):
        net = StreetNet(records.parse_dataclass(StreetNetConfig, content.get("config"), f"{where}: config"))
    state = shards.read_shards(where.parent, content.get("files"))
    shards.check_fit(state, net.state_dict(), where.parent)
    net.load_state_dict({name: value.float() for name, value in state.items()})
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
