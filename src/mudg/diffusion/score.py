"""Scores, pictures and the model card of the `learn` verb."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mudg.base import palette, store
from mudg.base.types import Clip
from mudg.core import metrics
from mudg.core.metrics import TrueFrame, flicker
from mudg.core.pictures import class_colors, depth_colors, gray, to_bytes
from mudg.diffusion import clips
from mudg.diffusion.condition import filled_depth
from mudg.diffusion.model import MDM
from mudg.diffusion.published import PublishedMDM
from mudg.diffusion.requests import GeneratedClip, SampleRequest, generated

SKY = palette.ID["sky"]
SCORES = (
    ("psnr", "RGB PSNR dB"),
    ("psnr_seen", "- where seen"),
    ("psnr_unseen", "- unseen"),
    ("psnr_condition", "- of the condition"),
    ("psnr_points", "- nearest point"),
    ("psnr_reference", "- points + one image"),
    ("ssim", "SSIM"),
    ("sharpness", "sharpness (1 = truth)"),
    ("abs_rel", "depth AbsRel"),
    ("delta1", "delta1"),
    ("abs_rel_nearest", "AbsRel nearest fill"),
    ("delta1_nearest", "delta1 nearest fill"),
    ("miou", "mIoU"),
    ("accuracy", "accuracy"),
    ("flicker", "flicker (1 = truth)"),
    ("sky_near", "sky nearer 80 m"),
    ("edges_agree", "depth edges on class edges"),
    ("confidence_gap", "confidence AUC"),
)


def score(
    model: MDM | PublishedMDM,
    cities: Sequence[int],
    folder: Path | clips.ShardSource,
    request: SampleRequest,
    *,
    picture: Path | None = None,
) -> dict[str, Any]:
    """Generate all clips of some cities and compare with the truth.

    Args:
        request: how clips are sampled; the index is put in for each.

    Returns {"average": scores over the shifted clips, "by_shift": {shift: scores}, "clips": n, "steps": request.steps}.
    Keys as in `SCORES`; classes are pooled over all clips before the IoU. Draws a grid of up to 6 clips into `picture`.
    """
    rows: dict[str, list[dict[str, float]]] = {}
    counts: dict[str, Tensor] = {}
    pairs: list[tuple[Clip, GeneratedClip]] = []
    for city in cities:
        for number in range(clips.clips_in(folder, city)):
            frames = range(min(model.config.window, clips.frames_in(folder, city)))
            clip = clips.read_clip(folder, city, number, frames)
            sample = generated(model, clip.condition, replace(request, index=city * 16 + number))
            name = "recorded" if clip.shift_m == 0 else f"{abs(clip.shift_m):.0f} m"
            row, matrix = score_clip(clip, sample)
            rows.setdefault(name, []).append(row)
            counts[name] = counts.get(name, torch.zeros_like(matrix)) + matrix
            if len(pairs) < 6 and (clip.shift_m != 0 or number == 0):
                pairs.append((clip, sample))
    if picture is not None and pairs:
        save_grid(picture, pairs)
    by_shift = {name: _average(rows[name], counts[name]) for name in sorted(rows)}
    shifted = [n for n in rows if n != "recorded"] or list(rows)
    pooled = _average([r for n in shifted for r in rows[n]], sum(counts[n] for n in shifted))
    return {"average": pooled, "by_shift": by_shift, "clips": sum(map(len, rows.values())), "steps": request.steps}


def score_clip(clip: Clip, sample: GeneratedClip) -> tuple[dict[str, float], Tensor]:
    """Scores of one clip and its class confusion i64[19,20]."""
    rgb, ids, given, points = clip.rgb, clip.semantics, clip.condition, clip.point_color
    # far depth does not count, nor does guessed depth
    depth = torch.where(clip.depth_weight == 1, clip.depth, clips.FAR_M)
    seen = given.valid if given.warped is None else given.valid | given.warped
    backdrop = given.color if given.backdrop is None else given.backdrop
    frames = [TrueFrame(*one) for one in zip(given.views, depth, ids, strict=True)]
    solid = (depth < 90.0) & (ids.unsqueeze(1) != SKY)
    flat = lambda x: x.transpose(0, 1).flatten(1, 2)
    error = metrics.depth_errors(flat(sample.depth), flat(depth), flat(solid))
    filled = given.depth if given.measured is None else filled_depth(given.measured)
    nearest = metrics.depth_errors(flat(filled), flat(depth), flat(solid))
    matrix = metrics.confusion(sample.semantics.flatten(0, 1), ids.flatten(0, 1))
    sky = (ids == SKY).unsqueeze(1)
    wrong = (sample.rgb - rgb).abs().mean(1, keepdim=True)
    one_image = rgb if points is None else torch.where(given.valid, points, backdrop)
    row = {
        "psnr": metrics.psnr(flat(sample.rgb), flat(rgb)),
        "psnr_seen": metrics.psnr(flat(sample.rgb), flat(rgb), flat(seen)),
        "psnr_unseen": metrics.psnr(flat(sample.rgb), flat(rgb), flat(~seen)),
        "psnr_condition": metrics.psnr(flat(given.color), flat(rgb)),
        "psnr_points": math.nan if points is None else metrics.psnr(flat(points), flat(rgb)),
        "psnr_reference": math.nan if points is None else metrics.psnr(flat(one_image), flat(rgb)),
        "ssim": float(np.mean([metrics.ssim(a, b) for a, b in zip(sample.rgb, rgb)])),
        "sharpness": _gradient(sample.rgb) / max(_gradient(rgb), 1e-6),
        "abs_rel": error.abs_rel,
        "delta1": error.delta1,
        "abs_rel_nearest": nearest.abs_rel,
        "delta1_nearest": nearest.delta1,
        "flicker": flicker(sample.rgb, rgb, frames),
        "sky_near": float((sample.depth[sky] < 80).float().mean()) if bool(sky.any()) else math.nan,
        "edges_agree": edges_agree(sample.depth, sample.semantics),
        "confidence_gap": _auc(sample.confidence.flatten(), wrong.flatten()),
    }
    return row, matrix


def edges_agree(depth: Tensor, semantics: Tensor) -> float:
    """Share of depth edges (ratio of neighbours > 1.25) that lie within a pixel of a class edge. NaN without edges."""
    log_depth = depth.clamp(min=0.1).log()
    tall = ((log_depth[..., 1:, :] - log_depth[..., :-1, :]).abs() > 0.223)[..., :-1]
    wide = ((log_depth[..., 1:] - log_depth[..., :-1]).abs() > 0.223)[..., :-1, :]
    edge = tall | wide
    ids = semantics.unsqueeze(1)
    change = (ids[..., 1:, :-1] != ids[..., :-1, :-1]) | (ids[..., :-1, 1:] != ids[..., :-1, :-1])
    near = torch.nn.functional.max_pool2d(change.float(), 3, stride=1, padding=1) > 0
    return float((edge & near).sum() / edge.sum()) if bool(edge.any()) else math.nan


def _gradient(rgb: Tensor) -> float:
    return float((rgb[..., 1:] - rgb[..., :-1]).abs().mean() + (rgb[..., 1:, :] - rgb[..., :-1, :]).abs().mean())


def _auc(confidence: Tensor, error: Tensor, pairs: int = 20000) -> float:
    """Probability that of two pixels the one with more error has less confidence (0.5 = no use, 1 = perfect)."""
    generator = torch.Generator().manual_seed(0)
    a, b = torch.randint(len(error), (2, pairs), generator=generator)
    right = ((error[a] > error[b]) == (confidence[a] < confidence[b])).float()
    tie = confidence[a] == confidence[b]
    return float(torch.where(tie, torch.full_like(right, 0.5), right).mean())


def _average(rows: Sequence[Mapping[str, float]], counts: Tensor) -> dict[str, float]:
    result: dict[str, float] = {}
    for name in rows[0]:
        values = [r[name] for r in rows if math.isfinite(r[name])]
        if values:
            result[name] = round(float(np.mean(values)), 4)
    if not bool(counts.any()):  # logs without labels
        return result
    ious = metrics.iou_of(counts)
    frequent = {n: v for n, v in ious.items() if float(counts[palette.ID[n]].sum()) > 2e-4 * float(counts.sum())}
    result["miou"] = round(float(np.mean(list(frequent.values()))), 4)
    result["miou_all"] = round(float(np.mean(list(ious.values()))), 4)
    result["accuracy"] = round(float(counts[:, :-1].diagonal().sum() / counts.sum()), 4)
    return result | {f"iou {n}": round(v, 3) for n, v in ious.items()}


def table(scores: Mapping[str, Any]) -> str:
    """Scores as text, one column per shift."""
    columns = {**scores["by_shift"], "shifted": scores["average"]}
    lines = [f"{'':28s}" + "".join(f"{c:>11s}" for c in columns)]
    for key, title in SCORES:
        cells = (columns[c].get(key) for c in columns)
        lines.append(f"{title:28s}" + "".join(f"{'-' if v is None else format(v, '.3f'):>11s}" for v in cells))
    return "\n".join(lines)


# pictures -----------------------------------------------------------------------------------------


def save_grid(path: Path, pairs: Sequence[tuple[Clip, GeneratedClip]], frame: int = 4) -> None:
    """One row per clip: condition, made and true colour; condition, made and true depth; made and true classes;
    confidence."""
    rows = []
    for clip, sample in pairs:
        t = min(frame, len(sample.confidence) - 1)
        given = clip.condition
        measured = torch.where(given.measurement.valid[t], given.measurement.depth[t], 100.0)
        cells = [
            *(to_bytes(rgb) for rgb in (given.color[t], sample.rgb[t], clip.rgb[t])),
            *(depth_colors(depth[0].numpy()) for depth in (measured, sample.depth[t], clip.depth[t])),
            *(class_colors(ids.numpy()) for ids in (sample.semantics[t], clip.semantics[t])),
            gray(sample.confidence[t, 0].numpy()),
        ]
        rows.append(np.concatenate(cells, 1))
    store.write_image(path, np.concatenate(rows, 0))
