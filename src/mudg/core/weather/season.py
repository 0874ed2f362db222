"""Other seasons, as far as colours go: green leaves and grass take the colours of autumn or of winter.

Luminance is kept but for one factor per season, so light, shadow and texture stay; only chromaticity changes, and only as far as a
surface of class vegetation or terrain is green: bark, flowers and soil stay. Which tree turns yellow and which brown follows from
value noise over the ground, so that all frames and cameras agree. Shapes stay: bare trees keep closed crowns, in the colour of twigs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mudg.base.palette import ID
from mudg.base.types import View
from mudg.base.weather_settings import SeasonSettings
from mudg.core.weather.gbuffer import GBuffer, world_points
from mudg.core.weather.ground import noise_seed
from mudg.core.weather.noise import patches, smoothstep
from mudg.core.weather.tone import LUMINANCE

Array = NDArray[np.float64]
LEAVES: Final = {"autumn": ((0.62, 0.36, 0.06), (0.55, 0.17, 0.04), (0.30, 0.16, 0.06)), "bare": ((0.21, 0.18, 0.15), (0.25, 0.22, 0.19))}
"""Reflectances of what is left on trees, between which patches change."""
GRASS: Final = {"autumn": (0.30, 0.27, 0.11), "bare": (0.29, 0.25, 0.16)}
BRIGHTER: Final = {"autumn": 1.15, "bare": 0.8}
"""Luminance against that of summer."""
PATCH_M: Final = 3.0
GREEN_FROM, GREEN_TO = 0.02, 0.12
"""A surface is green by how far its green lies above the larger of red and blue, as a share of their sum."""


def greenness(color: NDArray[np.floating]) -> Array:
    """How green linear light [..., 3] is, f64 0 to 1."""
    total = np.maximum(color.sum(-1), 1e-6)
    return np.asarray(smoothstep(GREEN_FROM, GREEN_TO, (color[..., 1] - np.maximum(color[..., 0], color[..., 2])) / total), np.float64)


def in_season(gbuffer: GBuffer, view: View, season: SeasonSettings, seed: int) -> GBuffer:
    """The same surfaces in another season; what is no vegetation or terrain stays bit for bit.

    Args:
        gbuffer: as recorded in a leafy season; one without green stays.
    """
    plants = gbuffer.classes == ID["vegetation"]
    grass = gbuffer.classes == ID["terrain"]
    where = (plants | grass) & ~gbuffer.sky
    if not where.any() or season.amount == 0:
        return gbuffer
    color = gbuffer.color[where].astype(np.float64)
    places = world_points(view, gbuffer.depth)[where]
    kinds = np.array(LEAVES[season.leaves], np.float64)
    share = patches(places[:, 0], places[:, 1], PATCH_M, noise_seed(seed, "season")) * (len(kinds) - 1)
    first = np.clip(share.astype(np.int64), 0, len(kinds) - 2)
    leaf = kinds[first] + (share - first)[:, None] * (kinds[first + 1] - kinds[first])
    target = np.where(grass[where][:, None], np.array(GRASS[season.leaves]), leaf)
    target *= BRIGHTER[season.leaves] / (target @ LUMINANCE)[:, None]
    weight = (season.amount * greenness(color))[:, None]
    made = gbuffer.color.copy()
    made[where] = (color * (1 - weight) + (color @ LUMINANCE)[:, None] * target * weight).astype(np.float32)
    return replace(gbuffer, color=made)
