"""Labels by the network that comes with the package: ``mudg annotate --labeller embedded``.

Images of a longer focal length than in training are made smaller, so that objects have the size they had there; the measured
evidence of ``models.labels.evidence`` has the same size. Rules then correct what evidence and colour decide (``settled``,
``settled_by_color``), and the probabilities are resampled to the image's size.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from mudg.base.palette import CLASSES, ID
from mudg.core.pictures import resize_area
from mudg.models.folders import CPU, Place
from mudg.models.labels import street_net
from mudg.models.labels.by_geometry import GRASS, GROUND_M, find_sky, greenness_of, label_by_network
from mudg.models.labels.evidence import BOX_GROUPS, GROUP_OF, Evidence, encode, gather
from mudg.models.labels.inputs import GAP_DEG, TRAIN_ID_OF, LabelInput, Labels
from mudg.models.labels.street_net import StreetNet

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
"""Remaining share where rules are better than the network on recorded roads: sunlit lanes resemble generated sidewalks, and dark
treetops resemble what the network takes for sky."""


class StreetLabeller:
    """A network ready for labelling; called with a ``LabelInput`` it returns ``Labels``."""

    def __init__(self, net: StreetNet, place: Place = CPU) -> None:
        """``place``: where the network computes; evidence is gathered on the processor."""
        self._net, self._place = net.to(place.ready()), place

    @classmethod
    def load(cls, folder: Path | str = "", place: Place = CPU) -> StreetLabeller:
        """From a folder, or, without one, from the package; errors as in ``street_net.load``."""
        return cls(street_net.load(folder or street_net.EMBEDDED), place)

    def __call__(self, given: LabelInput) -> Labels:
        return label_by_network(given, *self.classes(given))

    def classes(self, given: LabelInput) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Train ids u8[H, W] and the probability of each f32[H, W]."""
        small = reduced(given, self._net.config.focal_px)
        evidence = gather(small)
        with self._place.autocast():
            found = self._net.probabilities(small.rgb, encode(evidence))
        found = settled(found, evidence, any(track.label in TRAIN_ID_OF for track in given.tracks))
        return at_size(settled_by_color(found, small.rgb, evidence), given.rgb.shape[0], given.rgb.shape[1])


def reduced(given: LabelInput, focal_px: float) -> LabelInput:
    """The same at a focal length of at most ``focal_px``; colours are averaged over areas."""
    camera = given.view.camera
    scale = focal_px / max(camera.fx, camera.fy)
    if scale >= 1:
        return given
    width, height = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    rgb = resize_area(given.rgb, width, height)
    return dataclasses.replace(given, view=given.view.resized(width, height), rgb=rgb)


def settled(probabilities: NDArray[np.float32], evidence: Evidence, boxes_known: bool = False) -> NDArray[np.float32]:
    """Probabilities f32[19, H, W], with sum 1, without the classes that the evidence rules out.

    No sky at returns and below the horizon; no road high above the ground; the ground that was driven on is road; where the surface
    lies in a box, no classes but those of the box; where it lies beside or behind a box of a person or a bicycle, no such class.
    Ground that the path reaches directly is road rather than sidewalk; where the log has boxes (``boxes_known``), there is hardly
    anything outside them that boxes are drawn around.
    """
    found = probabilities.copy()
    measured = evidence.away_deg < RETURN_DEG
    found[ID["sky"], measured | (evidence.elevation_rad < BELOW_RAD)] *= _SMALL
    near = evidence.away_deg < 1
    for index in _FLAT:
        found[index, near & (evidence.height_m > ROAD_M)] *= _SMALL
    driven = near & (evidence.beside_m < CORRIDOR_M) & (np.abs(evidence.height_m) < GROUND_M) & (evidence.box == 0)
    found[ID["sidewalk"], driven & (evidence.elevation_rad < BELOW_RAD)] *= _SMALL
    found[ID["terrain"], driven & (evidence.elevation_rad < BELOW_RAD)] *= _SMALL
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
    """Probabilities f32[19, H, W], with sum 1, without the classes that the colours of the image u8[H, W, 3] contradict.

    Hardly any sky where the image does not look like it (``labellers.find_sky``: bright or blue, smooth), unless nothing in it does,
    as at night. Ground that the path reaches directly and that is not green is road rather than terrain.
    """
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
