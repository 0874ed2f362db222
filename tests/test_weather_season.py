"""Seasons: chromaticity of what is green, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mudg.base import geometry
from mudg.base.palette import ID
from mudg.base.types import Camera, View
from mudg.base.weather_settings import Conditions, SeasonSettings
from mudg.core.weather import apply
from mudg.core.weather import light as season
from mudg.core.weather.gbuffer import from_render

LOOKING = geometry.from_rotation_translation(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), (0, 0, 1.5))


def scene(place: float = 0.0):
    """A hedge 10 m ahead of x = 0, left half; a green wall, right half; one row of bark."""
    pose = LOOKING.copy()
    pose[0, 3] += place
    view = View(Camera("front", 32, 16, 30.0, 30.0, 16.0, 8.0), pose, 0.0)
    rgb = np.zeros((16, 32, 3), np.float32) + np.array([0.1, 0.3, 0.05], np.float32)
    rgb[3] = (0.2, 0.15, 0.1)
    classes = np.full((16, 32), ID["vegetation"], np.uint8)
    classes[:, 16:] = ID["wall"]
    return view, from_render(view, rgb, np.full((16, 32), 10.0 - place, np.float32), classes)


@pytest.mark.parametrize("leaves", ["autumn", "bare"])
def test_only_green_plants_change_and_their_luminance_by_the_stated_factor(leaves: str) -> None:
    view, buffer = scene()
    made = season.in_season(buffer, view, SeasonSettings(leaves=leaves), 7)
    same = np.ones((16, 32), bool)
    same[:, :16] = False
    same[3] = True  # bark
    assert np.array_equal(made.color[same], buffer.color[same])
    before, after = (c[~same] @ season.LUMINANCE for c in (buffer.color, made.color))
    assert np.allclose(after, before * season.BRIGHTER[leaves], rtol=1e-5)
    assert (made.color[~same][:, 0] > made.color[~same][:, 1]).all()  # redder than green
    half = season.in_season(buffer, view, SeasonSettings(leaves=leaves, amount=0.5), 7)
    assert np.allclose(half.color, (buffer.color + made.color) / 2, atol=1e-6)


def test_views_agree_and_a_drive_without_green_stays() -> None:
    """The same place of the hedge has the same colour from 10 m and from 5 m."""
    colors = []
    for place in (0.0, 5.0):
        view, buffer = scene(place)
        made = season.in_season(buffer, view, SeasonSettings(leaves="autumn"), 7).color
        uv, _ = geometry.project(view, np.array([[10.0, 1.0, 0.8]]))
        colors.append(made[int(uv[0, 1]), int(uv[0, 0])])
    assert np.abs(colors[0] - colors[1]).max() < 0.05
    view, buffer = scene()
    grey = replace(buffer, color=np.full_like(buffer.color, 0.3))
    settings = Conditions(season=SeasonSettings(leaves="bare"))
    assert np.array_equal(season.in_season(grey, view, settings.season, 1).color, grey.color)
    assert not np.array_equal(apply(buffer, settings, view, 0.0, 1).color, buffer.color)
    assert np.array_equal(apply(buffer, Conditions(), view, 0.0, 1).color, buffer.color)
