"""``mudg bench``: measurements that print a table, each from one command.

mdm            the diffusion model on held-out cities, 2, 3 and 4 m beside the recorded path, against exact truth: with and
               without given classes, at several numbers of steps, and the seam between windows of a longer video
poses          how much of the error of tracked boxes a fit takes out (see `bench_poses`); needs no diffusion model
edit           edits of a fitted scene against the city regenerated with them (see `bench_edit`); needs no diffusion model. Of
               finished runs that are given: edits of recorded drives by measures that need no truth (see `bench_edit_runs`)
shift          whole methods beside the recorded path, on lists of logs (see `bench_shift`, which has its own folders)
real           whole methods on real logs, against what the methods did not see of them (see `bench_real`; own folders, too)
paper          a table of a paper, on generated cities or real logs (see `bench_paper`; own folders, too)

OUT/clips/ the generated clips   OUT/bench.json   OUT/bench.md   OUT/*.png pictures
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import torch

from mudg.base import log, store
from mudg.base.config import result_settings
from mudg.base.devices import NETWORK_KINDS, choose_device
from mudg.base.errors import UsageError
from mudg.base.run_folder import RunDir, VerbOutput, refuse_overlap
from mudg.bench import edit_diffusion, edit_runs
from mudg.bench import paper as bench_paper
from mudg.bench import poses as bench_poses
from mudg.bench import real as bench_real
from mudg.bench import shift as bench_shift
from mudg.bench.chain import changed_settings, flag_of, generator_of
from mudg.core import flicker
from mudg.data.clips import from_city
from mudg.data.clips.condition import ConditionRules, WarpSource, build_conditions
from mudg.data.clips.from_city import CityClipRules
from mudg.models.diffusion import SampleRequest, generated
from mudg.models.mdm import files as mdm_files
from mudg.models.mdm.model import MDM
from mudg.models.published.files import is_published
from mudg.stages.config import BenchConfig, FitConfig, PresetName, SynthesizeConfig, bench_preset
from mudg.stages.learning import score as learn_score
from mudg.stages.learning.city_fits import fit_city
from mudg.stages.learning.precision import choose_bf16
from mudg.stages.run import refuse_missing
from mudg.stages.synthesize import windows

_FILES = ("bench.json", "bench.md", "*.png", "clips/*", "cities/", "edited/", "fits/", "rows/*.json")
EDIT, SHIFT, REAL, PAPER = "edit", "shift", "real", "paper"
SEAM_FRAMES, SEAM_SHIFT_M = 26, 3.0
CHAINS = (SHIFT, REAL, PAPER)
"""Benchmarks of complete methods: they take the chain of `mudg run`, with its presets."""
RUNS = "edit RUN"
"""The benchmark edit of finished runs."""
USED: Final[Mapping[str, tuple[str, ...]]] = {
    "model": ("mdm", EDIT, *CHAINS), "cities": ("mdm", "poses", EDIT), "count": ("mdm", "poses", EDIT), "steps": ("mdm",),
    "sampler": ("mdm",), "eta": ("mdm",), "precision": ("mdm", *CHAINS), "harmonize": (EDIT, RUNS),
    "threads": ("mdm", "poses", EDIT, RUNS), "seed": ("mdm", "poses", EDIT, *CHAINS), "list": (SHIFT,), "logs": (SHIFT, PAPER),
    "methods": CHAINS, "iterations": CHAINS, "continue_fit": CHAINS, "ablation": (SHIFT, REAL), "variant": (SHIFT, REAL),
    "processes": CHAINS, "videos": (SHIFT, PAPER), "table": (PAPER,), "freevs_model": (PAPER,), "protocols": (REAL,), "shown": (REAL,),
    "resolution": (REAL, PAPER), "frames": (REAL, PAPER), "pose_iterations": ("poses", EDIT),
    "device": ("mdm", "poses", EDIT, RUNS, *CHAINS), "fuse": CHAINS, "synthesize": CHAINS, "fit": CHAINS, "score": (PAPER,),
}  # fmt: skip
"""Setting or group of settings -> the benchmarks that use it; the others refuse it."""
OWN: Final[Mapping[str, str]] = {
    **{f"synthesize.{name}": f"give --{name}" for name in ("model", "precision", "seed", "device", "processes")},
    **{f"fit.{name}": f"give --{name}" for name in ("iterations", "seed", "device")}, "fit.method": "give --methods",
    **dict.fromkeys((
        "synthesize.cameras", "synthesize.shifts_m", "synthesize.paths", "synthesize.condition",
        "score.baseline", "score.error_pictures", "score.perceptual_views",
    ), "leave it out"),
}  # fmt: skip
"""Settings of steps that a benchmark of complete methods chooses itself, and what to do instead."""


def run(
    name: str, config: BenchConfig, out: Path, *, sources: Sequence[Path] = (), preset: PresetName = "default", overwrite: bool = False
) -> Path:
    """Run one of `BENCHES`, shift, real or paper; returns the folder with `bench.json` and `bench.md`.

    Args:
        sources: logs, for real; logs or a list of cities, for paper; finished runs, for edit. preset: what the configuration started
            from, for shift, real and paper.

    Raises:
        UsageError: there is no such benchmark, a setting that it does not use, or logs were given to one that makes its own.
    """
    if name not in (*BENCHES, *CHAINS):
        raise UsageError("no such benchmark", expected=", ".join((*BENCHES, *CHAINS)), got=name)
    refuse_unused(RUNS if name == EDIT and sources else name, config, preset)
    if name == PAPER:
        return bench_paper.run(config, sources, out, preset=preset, overwrite=overwrite)
    if name == REAL:
        return bench_real.run(config, sources, out, preset=preset, overwrite=overwrite)
    if name == EDIT and sources:
        return edit_runs.run(config, sources, out, overwrite=overwrite)
    if sources:
        raise UsageError("this benchmark makes its own logs", where=f"mudg bench {name}", got=", ".join(map(str, sources)))
    if name == SHIFT:  # made of verbs that each keep their own folder
        return bench_shift.run(config, out, preset=preset, overwrite=overwrite)
    inputs = {"model": mdm_files.digest(config.model)} if name == "mdm" else {}  # poses reads no diffusion model
    refuse_overlap(out, {"model": mdm_files.folder_of(config.model) if inputs else ""})
    choose_device(config.device, "benchmark", NETWORK_KINDS)  # refused before anything is written
    directory = RunDir.open(out, VerbOutput(f"bench {name}", 1, _FILES), result_settings(config), inputs, overwrite)
    if directory.complete:
        return directory.reused()
    torch.set_num_threads(config.threads)
    result, text = BENCHES[name](config, directory.path)
    store.write_json(directory.path / "bench.json", result)
    store.write_text(directory.path / "bench.md", text)
    directory.finish({"measurement": name})
    return directory.path


def refuse_unused(name: str, config: BenchConfig, preset: PresetName) -> None:
    """UsageError for a preset, or a setting that differs from it, of which a benchmark makes no use, and where weights are missing.

    Args:
        name: of the benchmark; `RUNS` for edits of finished runs.
    """
    if name not in CHAINS and preset != "default":
        raise UsageError("only benchmarks of complete methods have presets", where="--preset", expected=", ".join(CHAINS), got=name,
                         remedy="leave it out")  # fmt: skip
    for setting in changed_settings(config, bench_preset(preset)):
        users, group = USED[setting.split(".")[0]], f"synthesize.{setting}"
        if name not in users:
            elsewhere = name in CHAINS and setting in ("steps", "sampler", "eta")
            raise UsageError(f"mudg bench {name} does not use this setting", where=flag_of(setting),
                             expected=" or ".join(f"mudg bench {one}" for one in users),
                             remedy=f"give {flag_of(group)}" if elsewhere else "leave it out")  # fmt: skip
        if setting in OWN and (setting, name) != ("synthesize.shifts_m", REAL):
            raise UsageError("the benchmark chooses this itself", where=flag_of(setting), remedy=OWN[setting])
    if name == EDIT and config.model != BenchConfig().model and not config.harmonize:
        raise UsageError("without --harmonize no diffusion model is used", where="--model", got=config.model, remedy="leave it out")
    if name in CHAINS:
        refuse_missing(generator_of(config), FitConfig(), "--model")
    if name == "mdm" and is_published(config.model):
        raise UsageError("mudg bench mdm measures small models", where="--model", got=config.model,
                         remedy="mudg bench paper --table mudg2 measures published-type ones")  # fmt: skip


def _mdm(config: BenchConfig, out: Path) -> tuple[dict[str, Any], str]:
    device = choose_device(config.device, "diffusion model", NETWORK_KINDS)
    bf16 = choose_bf16(config.precision, device)
    request = SampleRequest(1, config.seed, sampler=config.sampler, eta=config.eta, bf16=bf16)
    MDM.check_request(request)
    model = mdm_files.load(config.model).to(device)
    cities = from_city.LISTS[config.cities][: config.count]
    rules = CityClipRules(window=model.config.window, fitted=model.config.renders)
    from_city.write_missing(rules, cities, out / "clips", fit_city if rules.fitted else None)
    result: dict[str, Any] = {"cities": list(cities), "model": mdm_files.digest(config.model), "bf16": bf16, "rows": []}
    lines = [f"# Diffusion model on {len(cities)} held-out cities ({config.cities} list), exact truth", ""]
    with log.task("scoring", 2 * len(config.steps)) as bar:
        for given in (True, False):
            for steps in config.steps:
                picture = out / f"steps_{steps}_{'classes' if given else 'plain'}.png"
                started = time.perf_counter()
                scores = learn_score.score(
                    model, cities, out / "clips", replace(request, steps=steps),
                    prepare=None if given else learn_score.without_classes, picture=picture,
                )  # fmt: skip
                seconds = (time.perf_counter() - started) / scores["clips"]
                row = {"steps": steps, "given_classes": given, "seconds_per_clip": round(seconds, 2), "scores": scores}
                result["rows"].append(row)
                title = f"{steps} step{'s' if steps > 1 else ''}, classes {'given' if given else 'withheld'}"
                lines += [f"## {title}, {seconds:.1f} s per clip with its scoring", "", "```", learn_score.table(scores), "```", ""]
                bar.update(title)
                bar.advance()
    result["seam"] = seam(model, config, request)
    lines += [_seam_text(result["seam"]), ""]
    return result, "\n".join(lines)


def seam(model: MDM, config: BenchConfig, request: SampleRequest) -> dict[str, Any]:
    """Change of static surfaces across the seams of overlapping windows, against that inside windows.

    A video of `SEAM_FRAMES` frames 3 m beside the path of one city is made in windows and steps as synthesize takes them by default,
    with the sampler of the request. Returned
    per place: the mean of (change made / change of the truth) over pairs of frames; and the pairs themselves.
    """
    city, usual = from_city.LISTS[config.cities][0], SynthesizeConfig()
    rules = CityClipRules(window=model.config.window)
    record = from_city.make_log(rules, city, frames=SEAM_FRAMES)
    views = [from_city.shifted_view(record.world, v, SEAM_SHIFT_M) for v in record.world.frame_views("front")]
    small = [view.resized(rules.width, rules.height) for view in views]
    truths = [record.world.render(view) for view in small]
    sizes = (rules.width, rules.height, rules.width * rules.fine, rules.height * rules.fine)
    sources: dict[int, WarpSource] = {}
    frames: list[torch.Tensor] = []
    tail: dict[Any, torch.Tensor] = {}
    spans = windows(len(views), model.config.window, usual.overlap)
    for number, span in enumerate(spans):
        condition = build_conditions(
            record.cloud, record.world.tracks(), [views[i] for i in span], record.recorded, ConditionRules(*sizes), sources
        )[0]
        shared = len(frames) - span.start
        known = {m: z[-shared:] for m, z in tail.items()} if tail else None
        made = generated(model, condition, replace(request, steps=usual.steps, index=number, known=known))
        frames += list(made.rgb[shared if tail else 0 :])
        tail = dict(made.latents)
    rgb = torch.stack([torch.from_numpy(t.rgb.copy()).permute(2, 0, 1) for t in truths])
    depth = torch.stack([torch.from_numpy(t.depth.copy())[None] for t in truths]).clamp(max=1000.0)
    ids = torch.stack([torch.from_numpy(t.semantics.astype("int64")) for t in truths])
    true_frames = [flicker.TrueFrame.of(*one) for one in zip(small, depth, ids, strict=True)]
    pairs = flicker.changes(torch.stack(frames), rgb, true_frames)
    ratios = [m / t if t > 0 else math.nan for m, t in pairs]
    seams = {span.start + usual.overlap - 1 for span in spans[1:-1]} | {spans[-2].stop - 1}
    mean = lambda kept: sum(kept) / len(kept) if kept else math.nan  # noqa: E731
    across = mean([r for i, r in enumerate(ratios) if i in seams])
    within = mean([r for i, r in enumerate(ratios) if i not in seams])
    return {"city": city, "across": round(across, 4), "inside": round(within, 4), "steps": usual.steps, "seams": sorted(seams),
            "pairs": [round(r, 4) for r in ratios]}  # fmt: skip


def _seam_text(found: dict[str, Any]) -> str:
    return (
        f"Seam: static surfaces change {found['across']:.3f} times as much as in the truth across the seams of windows, "
        f"{found['inside']:.3f} times inside them (city {found['city']}, {SEAM_FRAMES} frames, 3 m, {found['steps']} steps)."
    )


BENCHES: dict[str, Callable[[BenchConfig, Path], tuple[dict[str, Any], str]]] = {
    "mdm": _mdm,
    "poses": bench_poses.measure,
    EDIT: edit_diffusion.measure,
}
"""Every measurement that is one folder, by name."""
