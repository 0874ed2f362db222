"""Views in other weather or light that a diffusion model corrects, after the formulas of `core.weather`.

The model is given the condition of the drive in that weather, with its effect vector, and begins from the render in that weather; every
pixel is free from the noise level on that ``HarmonizeConfig.weather`` says. A model that takes no effect vector is not told the weather;
it repairs the render alone, and only if ``HarmonizeConfig.weather_any_model`` asks for it. A published-type model is given points and a
reference in that weather, as in the paper's figure of edited backgrounds, and makes the view from noise.

Models work at their own size: what they change there is enlarged and added to the render, which so keeps its detail. Depth, classes and
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
from mudg.base.effects import effect_vector
from mudg.base.types import Condition, Observation, View
from mudg.data.clips.ablated import ConditionSources, conditions_of
from mudg.data.clips.condition import ConditionRules, WarpSource
from mudg.data.clips.weathered import InWeather, weathered
from mudg.models.diffusion import generated
from mudg.models.mdm.codec import Modality
from mudg.models.mdm.files import takes_effects
from mudg.models.published.files import is_published
from mudg.stages.config.harmonize import HarmonizeConfig
from mudg.stages.editing.harmonised import OVERLAP, PUBLISHED_OVERLAP, DrawPair, EditedSources, settings_of, start_clip
from mudg.stages.editing.vacated import vacated_at
from mudg.stages.fitting.planes import render_planes
from mudg.stages.learning import loading
from mudg.stages.synthesize import recorded_at_pose, windows


def harmonises_weather(config: HarmonizeConfig, how: InWeather) -> bool:
    """Whether a diffusion model corrects this weather; says so where it was asked for and cannot be."""
    if effect_vector(how.settings) is None:
        return False
    published = is_published(config.model)
    told = not published and takes_effects(config.model)
    able = told or published or config.weather_any_model
    if config.weather > 0 and able:
        if not told and not published:
            log.info(f"{config.model} takes no effect vector: it corrects views without knowing their weather and light")
        return True
    why = "--harmonize.weather is 0" if able else (
        f"the diffusion model {config.model} takes no effect vector (--harmonize.weather-any-model lets it correct them all the same)"
    )  # fmt: skip
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
        published = is_published(config.model)
        settings = loading.check_config(settings_of(config, device), fitted=not published)
        self._model = loading.load_any(settings)
        self._request = loading.request_of(settings, loading.half_of(settings) == torch.bfloat16)
        self._how, self._freedom, self._told = how, config.weather, not published and takes_effects(config.model)
        width, height = self._model.image_size(*size, 0)
        fine = size if published else (2 * width, 2 * height)
        rules = ConditionRules(width, height, *fine, images_per_view=config.images_per_view, published=published)
        self._given = ConditionSources(
            sources.cloud, sources.tracks, sources.photos, rules, functools.partial(render_planes, sources.fitted), None,
            vacated_at(sources.plan), how if published else None,
        )  # fmt: skip
        self._kept: dict[int, WarpSource] = {}

    def _condition(self, views: Sequence[View]) -> Condition:
        """What the model is given, in this weather."""
        condition = conditions_of(self._given, "full", views, self._kept)[0]
        if self._model.points_alone:  # its points and its reference were edited already
            return condition
        condition = weathered(condition, self._how)
        return condition if self._told else replace(condition, effect=None)

    def along(self, views: Sequence[View], draw: DrawPair) -> Iterator[Observation]:
        """The views of a path, in order, corrected; ``draw`` makes each without and with the weather."""
        done, tail = 0, dict[Modality, Tensor]()
        renders: dict[int, Observation] = {}
        window, alone = self._model.config.window, self._model.points_alone
        for number, span in enumerate(windows(len(views), window, min(PUBLISHED_OVERLAP if alone else OVERLAP, window - 1))):
            renders = {i: renders[i] if i in renders else draw(views[i])[1] for i in span}
            condition = self._condition([views[i] for i in span])
            shown = list(renders.values())
            freedom = [torch.full_like(render.rgb[0], self._freedom) for render in shown]
            start = None if alone else start_clip(shown, freedom, condition.color.shape[-2:])
            known = {m: z[-(done - span.start) :] for m, z in tail.items()} if tail and done > span.start else None
            clip = generated(self._model, condition, replace(self._request, index=number, known=known, start=start))
            elsewhere = alone and not recorded_at_pose(views[span.start], self._given.recorded)  # frame 0 is the reference
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
