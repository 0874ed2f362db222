"""Labels by the network that comes with the package: ``mudg annotate --labeller embedded``. Images of a longer focal
length than in training are made smaller first. Rules then correct what evidence and colour decide (``settled``,
``settled_by_color``)."""

from __future__ import annotations

import dataclasses
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

from mudg.base import checkpoint, records, store, weights
from mudg.base.config import STRICT
from mudg.base.errors import InputError, ResourceError
from mudg.base.palette import CLASSES, ID
from mudg.core.pictures import resize_area
from mudg.labels.evidence import BOX_GROUPS, GROUP_OF, PLANE_COUNT, Evidence, encode, gather
from mudg.labels.inputs import (
    GAP_DEG,
    GRASS,
    GROUND_M,
    TRAIN_ID_OF,
    LabelInput,
    Labels,
    find_sky,
    greenness_of,
    label_by_network,
)
from mudg.networks.folders import CPU

# street net ---------------------------------------------------------------------------------------
#
# An encoder and decoder with skips at strides 2 to 32. Colour and the planes of ``evidence.py`` enter
# together as cells of 2x2 pixels, and the scores of a cell's four pixels leave together: nothing is computed at full
# size, and nothing of it is lost.

MODEL_FILE: Final = "model.json"
WEIGHTS_FILE: Final = "weights.safetensors"
EMBEDDED: Final = Path(__file__).resolve().parents[1] / "assets" / "segmenter_small"
"""The network that comes with the package."""
STRIDE: Final = 32
RGB_MEAN: Final = 0.42
RGB_SCALE: Final = 0.25
Width = Annotated[int, Field(ge=1, le=1024, multiple_of=8)]
BlockCount = Annotated[int, Field(ge=1, le=1024)]
Positive = Annotated[float, Field(gt=0, lt=1e5)]


@dataclass(frozen=True, config=STRICT)
class StreetNetConfig:
    """Shape of the network: channels at strides 2, 4, 8, 16 and 32, and residual blocks there, on the way down; the
    largest focal length it was trained at (images of a longer one are made smaller first); and what scores are divided
    by, so that probabilities tell how often the class is right."""

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
    """Class scores f32[N, 19, H, W] of colours f32[N, 3, H, W] in 0..1 and evidence f32[N, 17, H, W]; H, W in 32s."""

    def __init__(self, config: StreetNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = config.widths
        self.stem = nn.Conv2d(4 * (3 + PLANE_COUNT), widths[0], 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, 2, padding=1) for a, b in zip(widths, widths[1:]))
        sizes = zip(widths, config.blocks)
        self.encode = nn.ModuleList(nn.Sequential(*(_Block(w) for _ in range(n))) for w, n in sizes)
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
        """Probability of each class f32[19, H, W] of an image u8[H, W, 3] and its evidence f32[17, H, W]."""
        height, width = rgb.shape[:2]
        pad = (0, -width % STRIDE, 0, -height % STRIDE)
        color = functional.pad(torch.from_numpy(rgb.copy()).permute(2, 0, 1)[None].float() / 255, pad, mode="replicate")
        planes = functional.pad(torch.from_numpy(evidence)[None], pad, mode="replicate")
        device = self.head.weight.device
        scores = self(color.to(device), planes.to(device))[0, :, :height, :width].float()
        return (scores / self.config.temperature).softmax(0).cpu().numpy()


# files --------------------------------------------------------------------------------------------


def save(net: StreetNet, folder: Path, card: str, facts: Mapping[str, Any]) -> None:
    """Write a network as fp16 safetensors, ``model.json`` (shape, SHA-256 of the weights, facts) and MODEL_CARD.md."""
    weights = {name: value.half().contiguous() for name, value in net.state_dict().items()}
    store.write_safetensors(folder / WEIGHTS_FILE, weights)
    store.write_text(folder / "MODEL_CARD.md", card)
    files = {WEIGHTS_FILE: store.sha256_file(folder / WEIGHTS_FILE)}
    model = {"schema": 1, "kind": "street_net", "config": asdict(net.config), "files": files, "facts": dict(facts)}
    store.write_json(folder / MODEL_FILE, model)


def load(folder: Path | str = EMBEDDED) -> StreetNet:
    """Read a network written by ``save``; without a folder, the one that comes with the package. ResourceError: no such
    folder. InputError: another kind of model, or other weights than its shape implies. IntegrityError: the weights do
    not match their recorded hash."""
    where = _described(folder)
    content = store.parse_json(store.read_bytes(where), str(where))
    if not isinstance(content, dict) or content.get("schema") != 1 or content.get("kind") != "street_net":
        expected = "kind street_net, schema 1"
        raise InputError("not a segmentation network of this package", where=str(where), expected=expected)
    with records.understood("a segmentation network", str(where)):
        net = StreetNet(records.parse_dataclass(StreetNetConfig, content.get("config"), f"{where}: config"))
    state = checkpoint.read_shards(where.parent, content.get("files"))
    weights.match_exactly(state, weights.shapes_of(net), str(where.parent), "its configuration")
    net.load_state_dict({name: value.float() for name, value in state.items()})
    return net.eval().to(memory_format=torch.channels_last)


def digest(folder: Path | str = EMBEDDED) -> str:
    """Digest of a network's description, which holds the hash of its weights. ResourceError: no such folder."""
    return store.digest(_described(folder))


def _described(folder: Path | str) -> Path:
    """The description in a folder."""
    where = Path(folder) / MODEL_FILE
    if not where.is_file():
        expected = f"a folder with {MODEL_FILE}"
        remedy = "leave out --weights to use the network that comes with the package"
        raise ResourceError("the labeller's weights are missing", where=str(folder), expected=expected, remedy=remedy)
    return where


# street labels ------------------------------------------------------------------------------------

RETURN_DEG: Final = 0.12
"""A pixel nearer than this to a return shows a surface, not the sky."""
BELOW_RAD: Final = -0.02
"""Rays below this elevation do not meet the sky."""
ROAD_M: Final = 0.8
"""A surface higher above the ground than this is neither road nor sidewalk."""
CORRIDOR_M: Final = 1.8
"""Flat ground nearer to the driven path than this is road: the vehicle drove there."""
_FLAT: Final = (ID["road"], ID["sidewalk"])
_THIN: Final = tuple(ID[name] for name in ("person", "rider", "motorcycle", "bicycle"))
"""Classes that fill little of their boxes: the measured surface counts, not the outline."""
_SMALL: Final = 1e-3
"""Remaining share of the probability of a class that is ruled out."""
_RARE: Final = 0.1
"""Remaining share where the evidence is sometimes wrong: objects that were not given a box."""
_RARER: Final = 0.02
"""Remaining share where rules are better than the network on recorded roads: sunlit lanes resemble generated sidewalks,
and dark treetops resemble what the network takes for sky."""


class StreetLabeller:
    """A network ready for labelling; called with a ``LabelInput`` it returns ``Labels``."""

    def __init__(self, net: StreetNet, device: torch.device = CPU) -> None:
        """``device``: where the network computes; evidence is gathered on the processor."""
        self._net = net.to(device)

    @classmethod
    def load(cls, folder: Path | str = "", device: torch.device = CPU) -> StreetLabeller:
        """From a folder, or, without one, from the package; errors as in ``street_net.load``."""
        return cls(load(folder or EMBEDDED), device)

    def __call__(self, inputs: LabelInput) -> Labels:
        return label_by_network(inputs, *self.classes(inputs))

    def classes(self, inputs: LabelInput) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Train ids u8[H, W] and the probability of each f32[H, W]."""
        small = reduced(inputs, self._net.config.focal_px)
        evidence = gather(small)
        found = self._net.probabilities(small.rgb, encode(evidence))
        found = settled(found, evidence, any(track.label in TRAIN_ID_OF for track in inputs.tracks))
        return at_size(settled_by_color(found, small.rgb, evidence), inputs.rgb.shape[0], inputs.rgb.shape[1])


def reduced(inputs: LabelInput, focal_px: float) -> LabelInput:
    """The same at a focal length of at most ``focal_px``; colours are averaged over areas."""
    camera = inputs.view.camera
    scale = focal_px / max(camera.fx, camera.fy)
    if scale >= 1:
        return inputs
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    rgb = resize_area(inputs.rgb, width, height)
    return dataclasses.replace(inputs, view=inputs.view.resized(width, height), rgb=rgb)


def settled(probabilities: NDArray[np.float32], evidence: Evidence, boxes_known: bool = False) -> NDArray[np.float32]:
    """Probabilities f32[19, H, W], with sum 1, without the classes that the evidence rules out. No sky at returns and
    below the horizon; no road high above the ground; the ground that was driven on is road; where the surface lies in a
    box, no classes but those of the box; where it lies beside or behind a box of a person or a bicycle, no such class.
    Ground that the path reaches directly is road rather than sidewalk; where the log has boxes (``boxes_known``), there
    is hardly anything outside them that boxes are drawn around."""
    found = probabilities.copy()
    found[ID["sky"], (evidence.away_deg < RETURN_DEG) | (evidence.elevation_rad < BELOW_RAD)] *= _SMALL
    near = evidence.away_deg < 1
    for index in _FLAT:
        found[index, near & (evidence.height_m > ROAD_M)] *= _SMALL
    driven = near & (evidence.beside_m < CORRIDOR_M) & (np.abs(evidence.height_m) < GROUND_M) & (evidence.box == 0)
    for name in ("sidewalk", "terrain"):
        found[ID[name], driven & (evidence.elevation_rad < BELOW_RAD)] *= _SMALL
    _hand_over(found, evidence.direct, "sidewalk", "road", _RARER)
    if boxes_known:
        for index in GROUP_OF:
            found[index, evidence.box == 0] *= _RARE
    label = np.full(256, -1)
    label[1 : 1 + len(evidence.box_labels)] = evidence.box_labels
    around = near & (evidence.box > 0) & ~evidence.in_box & np.isin(label[evidence.box], _THIN)
    for index in _THIN:
        found[index, around] *= _SMALL
    inside = np.where(evidence.in_box, label[evidence.box], -1)
    for index in np.unique(inside[inside >= 0]):
        allowed = np.zeros(len(CLASSES), np.float32)
        allowed[[ID[name] for name in BOX_GROUPS[GROUP_OF[int(index)]]]] = 1
        found[:, inside == index] = (found[:, inside == index] + _SMALL) * allowed[:, None]
    return found / found.sum(0, keepdims=True)


def settled_by_color(
    probabilities: NDArray[np.float32], rgb: NDArray[np.uint8], evidence: Evidence
) -> NDArray[np.float32]:
    """Probabilities f32[19, H, W], with sum 1, without the classes that the colours of the image u8[H, W, 3]
    contradict. Hardly any sky where the image does not look like it (``find_sky``), unless nothing in it does, as at
    night. Ground that the path reaches directly and that is not green is road rather than terrain."""
    found = probabilities.copy()
    px_per_deg = 1 / max(1e-6, float(np.rad2deg(np.abs(np.diff(evidence.elevation_rad, axis=0)).max(initial=0))))
    away_px = np.where(np.isfinite(evidence.depth_m), evidence.away_deg * px_per_deg, np.inf).astype(np.float32)
    sky = find_sky(rgb, evidence.elevation_rad, away_px, max(1.5, GAP_DEG * px_per_deg))
    if sky.any():
        found[ID["sky"], ~sky] *= _RARER
    _hand_over(found, evidence.direct & (greenness_of(rgb) <= GRASS), "terrain", "road", _RARE)
    return found / found.sum(0, keepdims=True)


def _hand_over(found: NDArray[np.float32], where: NDArray[np.bool_], loser: str, winner: str, kept: float) -> None:
    """Give the probability of one class to another, but for the share ``kept``."""
    given = (1 - kept) * found[ID[loser], where]
    found[ID[winner], where] += given
    found[ID[loser], where] -= given


def at_size(
    probabilities: NDArray[np.float32], height: int, width: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Most probable classes u8[height, width] and their probabilities f32[height, width]."""
    maps = torch.from_numpy(probabilities)[None]
    if maps.shape[2:] != (height, width):
        maps = functional.interpolate(maps, size=(height, width), mode="bilinear", align_corners=False)
    confidence, ids = maps[0].max(0)
    return ids.numpy().astype(np.uint8), confidence.numpy()
