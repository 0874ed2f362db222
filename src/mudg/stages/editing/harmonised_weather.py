"""Views in other weather or light that a published-type diffusion model makes, after the formulas of `core.weather`.

The model is given points and a reference image in that weather, as in the paper's figure of edited backgrounds, and makes the view from
noise. It works at its own size: what it changes there is enlarged and added to the render, which so keeps its detail. Depth, classes and
confidence stay as rendered.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from mudg.base import log
from mudg.base.types import Observation, View
from mudg.data.clips.ablated import ConditionSources, conditions_of
from mudg.data.clips.condition import ConditionRules, WarpSource
from mudg.data.clips.weathered import InWeather
from mudg.models.diffusion import generated
from mudg.models.mdm.codec import Modality
from mudg.models.published.files import is_published
from mudg.stages.config.harmonize import HarmonizeConfig
from mudg.stages.editing.harmonised import PUBLISHED_OVERLAP, DrawPair, EditedSources, settings_of
from mudg.stages.editing.vacated import vacated_at
from mudg.stages.fitting.planes import render_planes
from mudg.stages.learning import loading
from mudg.stages.learning.views import EDITED_IMAGES_PER_VIEW, recorded_at_pose, windows


def harmonises_weather(config: HarmonizeConfig, how: InWeather) -> bool:
    """Whether a diffusion model corrects this weather; says so where it was asked for and cannot be."""
    if not how.settings.changes_air_ground_or_light:
        return False
    published = is_published(config.model)
    if config.weather > 0 and published:
        return True
    why = "--harmonize.weather is 0" if published else f"{config.model} is no published-type model"
    log.info(f"weather and light are those of the formulas alone: {why}")
    return False


class WeatherHarmoniser:
    """Corrects views in other weather, window after window along a path."""

    def __init__(
        self,
        sources: EditedSources,
        how: InWeather,
        config: HarmonizeConfig,
        size: tuple[int, int],
        device: str = "auto",
    ) -> None:
        """``size``: width and height of the views."""
        settings = loading.check_config(settings_of(config, device), fitted=False)
        self._model = loading.load_any(settings)
        self._request = loading.request_of(settings, loading.half_of(settings) == torch.bfloat16)
        width, height = self._model.image_size(*size, 0)
        rules = ConditionRules(width, height, *size, images_per_view=EDITED_IMAGES_PER_VIEW, published=True)
        self._given = ConditionSources(
            sources.cloud, sources.tracks, sources.photos, rules, functools.partial(render_planes, sources.fitted), None,
            vacated_at(sources.plan), how,
        )  # fmt: skip
        self._kept: dict[int, WarpSource] = {}

    def along(self, views: Sequence[View], draw: DrawPair) -> Iterator[Observation]:
        """The views of a path, in order, corrected; ``draw`` makes each without and with the weather."""
        done, tail = 0, dict[Modality, Tensor]()
        renders: dict[int, Observation] = {}
        window = self._model.config.window
        for number, span in enumerate(windows(len(views), window, min(PUBLISHED_OVERLAP, window - 1))):
            renders = {i: renders[i] if i in renders else draw(views[i])[1] for i in span}
            condition = conditions_of(self._given, "full", [views[i] for i in span], self._kept)[0]
            known = {m: z[-(done - span.start) :] for m, z in tail.items()} if tail and done > span.start else None
            clip = generated(self._model, condition, replace(self._request, index=number, known=known))
            elsewhere = not recorded_at_pose(views[span.start], self._given.recorded)  # frame 0 is the reference
            for i in span:
                if i >= done:
                    stays = elsewhere and i == span.start
                    yield renders[i] if stays else corrected(renders[i], clip.rgb[i - span.start])
            done, tail = span.stop, clip.latents


def corrected(render: Observation, made: Tensor) -> Observation:
    """A render with what `made` f32[3,h,w], of any size, changes of it (see `changed_by`)."""
    return replace(render, rgb=changed_by(render.rgb, made))


def changed_by(rgb: Tensor, made: Tensor) -> Tensor:
    """Colours f32[3,H,W] with what `made` f32[3,h,w], of any size, changes of them at that size."""
    area = functional.interpolate(rgb[None], size=made.shape[-2:], mode="area")
    change = functional.interpolate(made[None] - area, size=rgb.shape[-2:], mode="bilinear", align_corners=False)[0]
    return (rgb + change).clamp(0, 1)
