"""Views in other weather or light that a diffusion model corrects, after the formulas of `core.weather`.

The model is given the condition of the drive in that weather, with its effect vector, and begins from the render in that weather; every
pixel is free from the noise level on that ``HarmonizeConfig.weather`` says. A model that takes no effect vector is not told the weather;
it repairs the render alone, and only if ``HarmonizeConfig.weather_any_model`` asks for it. Models work at their own size: what they
change there is enlarged and added to the render, which so keeps its detail. Depth, classes and confidence stay as rendered.
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
from mudg.base.types import Observation, View
from mudg.data.clips.ablated import ConditionSources, conditions_of
from mudg.data.clips.condition import ConditionRules, WarpSource
from mudg.data.clips.weathered import InWeather, weathered
from mudg.models.diffusion import generated
from mudg.models.mdm.codec import Modality
from mudg.models.mdm.files import takes_effects
from mudg.models.published.files import is_published
from mudg.stages.config import SynthesizeConfig
from mudg.stages.config.harmonize import HarmonizeConfig
from mudg.stages.editing.harmonised import OVERLAP, DrawPair, EditedSources, start_clip
from mudg.stages.editing.vacated import vacated_at
from mudg.stages.fitting.planes import render_planes
from mudg.stages.learning import loading
from mudg.stages.synthesize import windows


def harmonises_weather(config: HarmonizeConfig, how: InWeather) -> bool:
    """Whether a diffusion model corrects this weather; says so where it was asked for and cannot be."""
    if effect_vector(how.settings) is None:
        return False
    told = not is_published(config.model) and takes_effects(config.model)
    able = told or (config.weather_any_model and not is_published(config.model))
    if config.weather > 0 and able:
        if not told:
            log.info(f"{config.model} takes no effect vector: it corrects views without knowing their weather and light")
        return True
    if able:
        why = "--harmonize.weather is 0"
    elif is_published(config.model):
        why = f"the published-type diffusion model {config.model} takes no effect vector"
    else:
        why = f"the diffusion model {config.model} takes no effect vector (--harmonize.weather-any-model lets it correct them all the same)"
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
        settings = SynthesizeConfig(
            model=config.model, steps=config.steps, precision=config.precision, seed=config.seed, device=device, processes=1
        )  # fmt: skip
        settings = loading.check_config(settings, fitted=True)
        self._model = loading.load_any(settings)
        self._request = loading.request_of(settings, loading.half_of(settings) == torch.bfloat16)
        self._how, self._freedom, self._told = how, config.weather, takes_effects(config.model)
        width, height = self._model.image_size(*size, 0)
        rules = ConditionRules(width, height, 2 * width, 2 * height, images_per_view=config.images_per_view)
        self._given = ConditionSources(
            sources.cloud, sources.tracks, sources.photos, rules, functools.partial(render_planes, sources.fitted), None,
            vacated_at(sources.plan),
        )  # fmt: skip
        self._kept: dict[int, WarpSource] = {}

    def along(self, views: Sequence[View], draw: DrawPair) -> Iterator[Observation]:
        """The views of a path, in order, corrected; ``draw`` makes each without and with the weather."""
        done, tail = 0, dict[Modality, Tensor]()
        renders: dict[int, Observation] = {}
        window = self._model.config.window
        for number, span in enumerate(windows(len(views), window, min(OVERLAP, window - 1))):
            renders = {i: renders[i] if i in renders else draw(views[i])[1] for i in span}
            condition = weathered(
                conditions_of(self._given, "full", [views[i] for i in span], self._kept)[0], self._how
            )
            condition = condition if self._told else replace(condition, effect=None)
            shown = list(renders.values())
            freedom = [torch.full_like(render.rgb[0], self._freedom) for render in shown]
            start = start_clip(shown, freedom, condition.color.shape[-2:])
            known = {m: z[-(done - span.start) :] for m, z in tail.items()} if tail and done > span.start else None
            clip = generated(self._model, condition, replace(self._request, index=number, known=known, start=start))
            for i in span:
                if i >= done:
                    yield corrected(renders[i], clip.rgb[i - span.start])
            done, tail = span.stop, clip.latents


def corrected(render: Observation, made: Tensor) -> Observation:
    """A render with what `made` f32[3,h,w], of any size, changes of it (see `changed_by`)."""
    return replace(render, rgb=changed_by(render.rgb, made))


def changed_by(rgb: Tensor, made: Tensor) -> Tensor:
    """Colours f32[3,H,W] with what `made` f32[3,h,w], of any size, changes of them at that size."""
    area = functional.interpolate(rgb[None], size=made.shape[-2:], mode="area")
    change = functional.interpolate(made[None] - area, size=rgb.shape[-2:], mode="bilinear", align_corners=False)[0]
    return (rgb + change).clamp(0, 1)
