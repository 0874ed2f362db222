"""``mudg bench mdm``: the diffusion model on held-out cities, 2, 3 and 4 m beside the recorded path, against exact
truth: with and without given classes, at several numbers of steps; and the seam between windows of a longer video."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mudg.base import log
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.benchmarks.settings import BenchConfig
from mudg.core import metrics
from mudg.diffusion import city_clips, model_files, score
from mudg.diffusion.city_clips import CityClipRules, fit_city
from mudg.diffusion.condition import ConditionRules, WarpSource, build_conditions
from mudg.diffusion.memory_plan import choose_bf16
from mudg.diffusion.model import MDM
from mudg.diffusion.requests import SampleRequest, generated
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import windows

SEAM_FRAMES, SEAM_SHIFT_M = 26, 3.0


def measure(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    """Scores of the model at every number of steps, with and without classes, and its seam; numbers and tables."""
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    bf16 = choose_bf16(config.precision, device)
    request = SampleRequest(1, config.seed, sampler=config.sampler, eta=config.eta, bf16=bf16)
    MDM.check_request(request)
    model = model_files.load(config.model).to(device)
    cities = city_clips.LISTS[config.cities][: config.count]
    rules = CityClipRules(window=model.config.window, fitted=model.config.renders)
    city_clips.write_missing(rules, cities, out / "clips", fit_city if rules.fitted else None)
    result: dict[str, Any] = {"cities": list(cities), "model": model_files.digest(config.model), "bf16": bf16}
    result["rows"] = []
    lines = [f"# Diffusion model on {len(cities)} held-out cities ({config.cities} list), exact truth", ""]
    with log.task("scoring", 2 * len(config.steps)) as bar:
        for given in (True, False):
            for steps in config.steps:
                picture = out / f"steps_{steps}_{'classes' if given else 'plain'}.png"
                started = time.perf_counter()
                scores = score.score(
                    model,
                    cities,
                    out / "clips",
                    replace(request, steps=steps),
                    prepare=None if given else score.without_classes,
                    picture=picture,
                )
                seconds = (time.perf_counter() - started) / scores["clips"]
                row = {"steps": steps, "given_classes": given, "seconds_per_clip": round(seconds, 2), "scores": scores}
                result["rows"].append(row)
                title = f"{steps} step{'s' if steps > 1 else ''}, classes {'given' if given else 'withheld'}"
                lines += [
                    f"## {title}, {seconds:.1f} s per clip with its scoring",
                    "",
                    "```",
                    score.table(scores),
                    "```",
                    "",
                ]
                bar.update(title)
                bar.advance()
    found = result["seam"] = seam(model, config, request)
    lines += [
        (
            f"Seam: static surfaces change {found['across']:.3f} times as much as in the truth across the seams of"
            f" windows, {found['inside']:.3f} times inside them (city {found['city']}, {SEAM_FRAMES} frames, 3 m,"
            f" {found['steps']} steps)."
        ),
        "",
    ]
    return result, "\n".join(lines)


def seam(model: MDM, config: BenchConfig, request: SampleRequest) -> dict[str, Any]:
    """Change of static surfaces across the seams of overlapping windows, against that inside windows.

    A video of `SEAM_FRAMES` frames 3 m beside the path of one city is made in windows and steps as synthesize takes
    them by default, with the sampler of the request. Returned per place: the mean of (change made / change of the
    truth) over pairs of frames; and the pairs themselves.
    """
    city, usual = city_clips.LISTS[config.cities][0], SynthesizeConfig()
    rules = CityClipRules(window=model.config.window)
    record = city_clips.make_log(rules, city, frames=SEAM_FRAMES)
    views = [city_clips.shifted_view(record.world, v, SEAM_SHIFT_M) for v in record.world.frame_views("front")]
    small = [view.resized(rules.width, rules.height) for view in views]
    truths = [record.world.render(view) for view in small]
    sizes = (rules.width, rules.height, rules.width * rules.fine, rules.height * rules.fine)
    sources: dict[int, WarpSource] = {}
    frames: list[torch.Tensor] = []
    tail: dict[Any, torch.Tensor] = {}
    spans = windows(len(views), model.config.window, usual.overlap)
    for number, span in enumerate(spans):
        condition = build_conditions(
            record.cloud,
            record.world.tracks(),
            [views[i] for i in span],
            record.recorded,
            ConditionRules(*sizes),
            sources,
        )[0]
        shared = len(frames) - span.start
        known = {m: z[-shared:] for m, z in tail.items()} if tail else None
        made = generated(model, condition, replace(request, steps=usual.steps, index=number, known=known))
        frames += list(made.rgb[shared if tail else 0 :])
        tail = dict(made.latents)
    rgb = torch.stack([torch.from_numpy(t.rgb.copy()).permute(2, 0, 1) for t in truths])
    depth = torch.stack([torch.from_numpy(t.depth.copy())[None] for t in truths]).clamp(max=1000.0)
    ids = torch.stack([torch.from_numpy(t.semantics.astype("int64")) for t in truths])
    true_frames = [metrics.TrueFrame.of(*one) for one in zip(small, depth, ids, strict=True)]
    pairs = metrics.changes(torch.stack(frames), rgb, true_frames)
    ratios = [m / t if t > 0 else math.nan for m, t in pairs]
    seams = {span.start + usual.overlap - 1 for span in spans[1:-1]} | {spans[-2].stop - 1}
    mean = lambda kept: sum(kept) / len(kept) if kept else math.nan  # noqa: E731
    across = mean([r for i, r in enumerate(ratios) if i in seams])
    within = mean([r for i, r in enumerate(ratios) if i not in seams])
    return {
        "city": city,
        "across": round(across, 4),
        "inside": round(within, 4),
        "steps": usual.steps,
        "seams": sorted(seams),
        "pairs": [round(r, 4) for r in ratios],
    }
