"""Weather and light that a diffusion model corrects, on held-out generated cities, against the same cities generated in that weather.

python bench/effects.py --model MODEL --clips DIR                       three reported cities, about a minute each to make
python bench/effects.py --model MODEL --clips DIR --picture rows.png    and a picture: formulas, model without vector, with, truth

Every row is the mean over the clips of one kind of weather: four frames each at 192x128, on the recorded path or 2 to 4 m beside it, from
renders of a short fit. `formulas`: the render as `core.weather` edits it. `without`: corrected by the model without its effect vector.
`with`: as `mudg render --harmonize.weather` does it. The perceptual distance is that of the shipped codec's features.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mudg.base import store
from mudg.base.effects import EFFECTS
from mudg.base.types import Clip
from mudg.core import metrics
from mudg.core.perceptual import lpips_distance, unit_features
from mudg.data.clips import from_city, shards
from mudg.data.clips.from_city import CityClipRules
from mudg.models.diffusion import SampleRequest, StartClip, generated
from mudg.models.featnets import CodecFeatures
from mudg.models.mdm import files
from mudg.models.mdm.model import MDM
from mudg.stages.editing.harmonised_weather import changed_by
from mudg.stages.fitting.planes import FAR_M
from mudg.stages.learning.city_fits import write_fitted_city

RULES = CityClipRules(window=4, seed=5, clips=4, fitted=True, weathers=2, fit_steps=(100, 200))
WAYS = ("formulas", "without", "with")


def kind_of(effect: Tensor) -> str:
    """The kind of weather (`weathered.KINDS`) that a vector f32[8] stands for."""
    asked = dict(zip(EFFECTS, effect.tolist(), strict=True))
    if asked["night"]:
        return "night" if asked["night"] == 1 else "dusk"
    return next(
        name
        for key, name in (("cover", "snow"), ("rain", "rain"), ("fog", "fog"), ("wet", "wet"), ("cloud", "overcast"))
        if asked[key]
    )


def ways(model: MDM, clip: Clip, number: int, strength: float) -> dict[str, Tensor]:
    """A clip's images f32[T,3,H,W] made in each of `WAYS`."""
    given, shown = clip.condition, clip.condition.renders
    if shown is None:
        raise SystemExit("the clips have no renders: make them anew with this script")
    depth = torch.where(shown.alpha > 0.5, shown.depth, FAR_M)
    start = StartClip(shown.color, depth, shown.semantics, torch.full_like(depth, strength))
    made = {"formulas": shown.color}
    for name, condition in (("without", replace(given, effect=None)), ("with", given)):
        sample = generated(model, condition, SampleRequest(2, 0, number, start=start))
        made[name] = torch.stack([changed_by(render, rgb) for render, rgb in zip(shown.color, sample.rgb, strict=True)])
    return made


def scores(made: Tensor, truth: Tensor, codec: CodecFeatures) -> tuple[float, float]:
    """PSNR in dB and perceptual distance of a clip."""
    everywhere = torch.ones(1, *truth.shape[-2:])
    with torch.no_grad():
        apart = [
            lpips_distance(codec(a), unit_features(codec(b)), everywhere, over_weight=True)
            for a, b in zip(made, truth, strict=True)
        ]
    return float(metrics.psnr(made.double(), truth.double())), float(np.mean([float(x) for x in apart]))


def table(rows: list[tuple[str, dict[str, tuple[float, float]]]]) -> str:
    """Means per kind, and over all clips."""
    lines = [
        "| weather | clips | " + " | ".join(f"{way} [dB] | perceptual" for way in WAYS) + " |",
        "|---" * (2 + 2 * len(WAYS)) + "|",
    ]
    kinds = defaultdict(list)
    for kind, row in rows:
        kinds[kind].append(row)
        kinds["all"].append(row)
    for kind in [*sorted(set(kinds) - {"all"}), "all"]:
        means = {way: np.mean([row[way] for row in kinds[kind]], axis=0) for way in WAYS}
        lines.append(
            f"| {kind} | {len(kinds[kind])} | "
            + " | ".join(f"{means[w][0]:.2f} | {means[w][1]:.3f}" for w in WAYS)
            + " |"
        )
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="embedded")
    parser.add_argument("--clips", type=Path, required=True, help="folder of held-out clips; missing cities are made")
    parser.add_argument("--cities", type=int, nargs="*", default=list(from_city.REPORTED[:3]))
    parser.add_argument("--strength", type=float, default=1.0)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    model, codec = files.load(options.model), CodecFeatures(files.load("embedded").codec)
    rows, pictures = [], []
    for city in options.cities:
        if not shards.shard_path(options.clips, city).is_file():
            write_fitted_city(RULES, city, options.clips)
        for number in range(shards.clips_in(options.clips, city)):
            clip = shards.read_clip(options.clips, city, number, range(shards.frames_in(options.clips, city)))
            if clip.condition.effect is None:
                raise SystemExit(f"{options.clips}: clip {number} of city {city} is in no weather")
            made = ways(model, clip, number, options.strength)
            rows.append((kind_of(clip.condition.effect), {way: scores(made[way], clip.rgb, codec) for way in WAYS}))
            pictures.append(torch.cat([*(made[way][1] for way in WAYS), clip.rgb[1]], 2))
    sys.stdout.write(table(rows) + "\n")
    if options.picture is not None:
        store.write_image(
            options.picture, (torch.cat(pictures, 1).permute(1, 2, 0).clamp(0, 1) * 255 + 0.5).byte().numpy()
        )


if __name__ == "__main__":
    main()
