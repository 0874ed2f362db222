"""How training images are varied, so that what a network learns in generated cities holds for recorded images.

Colours, sharpness, noise and compression are drawn anew every time; now and then every class gets colours of its own,
or the image, the returns, the boxes or the ground plane are missing.
"""

from __future__ import annotations

import dataclasses
import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from segmenter_data import Sample

from mudg.base.palette import ID, UNLABELLED
from mudg.labels.evidence import LOW_M, Evidence, encode

_FLAT = (ID["road"], ID["sidewalk"])
CROP = (192, 288)
"""Rows and columns of a training crop."""


@dataclass(frozen=True)
class Rules:
    """How often (0..1) a sample goes without its image, colours, returns, boxes, or ground plane; or the step at the
    kerb is lost, or found where there is none."""

    no_image: float = 0.06
    grey: float = 0.1
    no_returns: float = 0.12
    no_boxes: float = 0.35
    no_ground: float = 0.04
    no_kerb: float = 0.1
    kerb_everywhere: float = 0.1
    recolored: float = 0.5
    largest_scale: float = 1.6


def varied(
    sample: Sample, rng: np.random.Generator, rules: Rules
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """A crop: colours f32[3, h, w] in 0..1, planes f32[C, h, w], classes u8[h, w]."""
    rgb, planes, truth = _cropped(sample, rng, rules)
    if rng.random() < 0.5:
        rgb, planes, truth = rgb[:, ::-1], planes[..., ::-1], truth[:, ::-1]
    if rng.random() < rules.no_image:
        rgb = np.broadcast_to(rng.random((1, 1, 3)), rgb.shape) + rng.normal(0, 0.03, rgb.shape)
    else:
        rgb = colored(rgb, truth, rng, rules)
    return (
        np.ascontiguousarray(rgb.transpose(2, 0, 1), np.float32),
        np.ascontiguousarray(planes),
        np.ascontiguousarray(truth),
    )


def disturbed(evidence: Evidence, rng: np.random.Generator, rules: Rules) -> Evidence:
    """Evidence with an error of the ground plane or kerbs, boxes left out, or without returns."""
    height = evidence.height_m + rng.normal(0, 0.05) + rng.normal(0, 0.004) * np.minimum(evidence.depth_m, 60)
    if rng.random() < rules.no_ground or not np.isfinite(height).all():
        height = np.zeros_like(evidence.height_m)
    reachable, luck = evidence.reachable, rng.random()
    if luck < rules.no_kerb:  # lowered, or hidden behind parked cars
        reachable = np.abs(evidence.height_m) < LOW_M
    elif luck < rules.no_kerb + rules.kerb_everywhere:
        reachable = reachable & (evidence.depth_m < rng.uniform(2, 30))
    raised = evidence.raised_m * rng.uniform(0.4, 1.6) + np.abs(rng.normal(0, 0.02)) * (evidence.raised_m > 0)
    kept = np.ones(256, bool)
    kept[1:] = rng.random(255) >= (1.0 if rng.random() < rules.no_boxes else rng.uniform(0, 0.5))
    kept = kept[evidence.box]
    evidence = dataclasses.replace(
        evidence,
        height_m=height.astype(np.float32),
        reachable=reachable,
        raised_m=raised.astype(np.float32),
        rough=evidence.rough * np.float32(rng.uniform(0.5, 1.5)),
        box=np.where(kept, evidence.box, 0).astype(np.uint8),
        in_box=evidence.in_box & kept,
    )
    if rng.random() >= rules.no_returns:
        return evidence
    zero = np.zeros_like(evidence.height_m)
    return dataclasses.replace(
        evidence,
        height_m=zero,
        depth_m=zero + np.float32(np.nan),
        away_deg=zero + 90,
        upwards=zero,
        beside_m=zero,
        reachable=np.zeros_like(reachable),
        direct=np.zeros_like(reachable),
        raised_m=zero,
        silent=np.zeros_like(evidence.silent),
        rough=zero,
        in_box=np.zeros_like(evidence.in_box),
    )


def _cropped(
    sample: Sample, rng: np.random.Generator, rules: Rules
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """A random part of the image, made larger or smaller; colours f32[h, w, 3] in 0..1."""
    rows, columns = sample.truth.shape
    least = max(CROP[0] / rows, CROP[1] / columns)
    scale = float(np.exp(rng.uniform(np.log(least), np.log(max(least, rules.largest_scale)))))
    height, width = min(rows, round(CROP[0] / scale)), min(columns, round(CROP[1] / scale))
    top, left = int(rng.integers(rows - height + 1)), int(rng.integers(columns - width + 1))
    window = (slice(top, top + height), slice(left, left + width))
    size = (CROP[1], CROP[0])
    rgb = np.asarray(Image.fromarray(sample.rgb[window]).resize(size, Image.Resampling.BILINEAR), np.float32) / 255
    v = np.minimum(((np.arange(CROP[0]) + 0.5) * height / CROP[0]).astype(int), height - 1)
    u = np.minimum(((np.arange(CROP[1]) + 0.5) * width / CROP[1]).astype(int), width - 1)
    planes = encode(disturbed(_window(sample.evidence, window), rng, rules))
    return rgb, planes[:, v[:, None], u], sample.truth[window][v[:, None], u]


def _window(evidence: Evidence, window: tuple[slice, slice]) -> Evidence:
    arrays = {name: value[window] if value.ndim == 2 else value for name, value in dataclasses.asdict(evidence).items()}
    return Evidence(**arrays)


def colored(
    rgb: NDArray[np.float32], truth: NDArray[np.uint8], rng: np.random.Generator, rules: Rules
) -> NDArray[np.float32]:
    """Colours f32[h, w, 3] in 0..1 as another camera, light or street might give them."""
    shape = rgb.shape[:2]
    if rng.random() < rules.recolored:  # each class its own tint, brightness and pattern
        gain = np.exp(rng.normal(0, 0.35, (256, 1)) + rng.normal(0, 0.15, (256, 3))).astype(np.float32)
        shift = (rng.normal(0, 0.08, (256, 1)) + rng.normal(0, 0.04, (256, 3))).astype(np.float32)
        # a road in the sun is as bright as any sidewalk
        gain[list(_FLAT)] *= np.exp(rng.normal(0, 0.3, (len(_FLAT), 1)))
        touched = rng.random(256) < rng.uniform(0.2, 1)
        gain[~touched], shift[~touched], shift[UNLABELLED] = 1, 0, 0
        strength = np.where(touched, np.abs(rng.normal(0, 0.15, 256)), 0).astype(np.float32)[truth][..., None]
        rgb = rgb * gain[truth] + shift[truth] + strength * _pattern(shape, rng)[..., None]
    rgb = np.clip(rgb, 0, 1) ** np.float32(np.exp(rng.normal(0, 0.3)))
    mix = np.eye(3) + rng.normal(0, 0.08, (3, 3)) * (rng.random() < 0.5)
    rgb = rgb @ (mix / mix.sum(1, keepdims=True)).astype(np.float32)
    saturation = 0.0 if rng.random() < rules.grey else float(rng.uniform(0.3, 1.6))
    grey = rgb.mean(2, keepdims=True)
    rgb = grey + saturation * (rgb - grey)
    rgb = rgb * np.exp(rng.normal(0, 0.1, 3) + rng.normal(0, 0.2)).astype(np.float32)
    rgb = (rgb - 0.45) * float(np.exp(rng.normal(0, 0.25))) + (0.45 + float(rng.normal(0, 0.05)))
    if rng.random() < 0.4:  # light and shade that belong to no surface
        rgb = rgb * np.exp(float(rng.uniform(0.1, 0.5)) * _pattern(shape, rng, coarse=True))[..., None]
    if rng.random() < 0.3:
        rgb = ndimage.gaussian_filter(rgb, (*(rng.uniform(0.3, 1.4),) * 2, 0))
    elif rng.random() < 0.3:
        rgb = rgb + float(rng.uniform(0.3, 1.5)) * (rgb - ndimage.gaussian_filter(rgb, (1, 1, 0)))
    if rng.random() < 0.5:
        rgb = rgb + np.float32(rng.uniform(0.005, 0.06)) * rng.standard_normal(rgb.shape, np.float32)
    rgb = np.clip(rgb, 0, 1)
    if rng.random() < 0.4:
        stream = io.BytesIO()
        Image.fromarray((rgb * 255).astype(np.uint8)).save(stream, "JPEG", quality=int(rng.integers(15, 80)))
        rgb = np.asarray(Image.open(stream), np.float32) / 255
    return rgb


def _pattern(shape: tuple[int, int], rng: np.random.Generator, coarse: bool = False) -> NDArray[np.float32]:
    """Smooth noise of about unit size at a random scale."""
    cells = int(rng.integers(2, 6)) if coarse else int(rng.choice([4, 12, 32, 96]))
    small = rng.normal(0, 1, (cells, cells * 3 // 2))
    image = Image.fromarray(small.astype(np.float32)).resize((shape[1], shape[0]), Image.Resampling.BICUBIC)
    return np.asarray(image, np.float32)
