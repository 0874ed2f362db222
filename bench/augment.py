"""What labelled views beside the path are worth: a segmenter trained with and without them, tested on exact views of
other cities.

python bench/augment.py --work /tmp/augment --cities 4 --tests 4 --steps 500

Rows: recorded images; the same and our views at 2 and 4 m to both sides; the same, without pixels that the recording
does not determine; the same and exact views at those places. All have exact labels but ours, which are rendered with
the image. The network is the labeller's (``StreetNet``), half as wide and without LiDAR, from nothing, always for as
many steps, on one thread. Cities and scenes are kept in ``--work``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

import mudg
from mudg import native
from mudg.base import seeds
from mudg.base.palette import CLASSES, UNLABELLED
from mudg.base.types import View
from mudg.city.world import CityWorld
from mudg.core import trajectory
from mudg.labels.evidence import PLANE_COUNT
from mudg.labels.street_net import StreetNet, StreetNetConfig
from mudg.sim.session import CERTAIN

SIZE = (256, 160)
SHIFTS_M = (2.0, -2.0, 4.0, -4.0)
TESTED_M = (0.0, 2.0, 4.0)
BATCH = 4
WIDTHS = (16, 32, 48, 64, 64)
LR = 2e-3
FIRST_TRAINED, FIRST_TESTED = 5100, 5200
Labelled = tuple[NDArray[np.uint8], NDArray[np.uint8]]
"""Image u8[H, W, 3] and classes u8[H, W]."""


def city(work: Path, seed: int) -> Path:
    """A generated log of one camera."""
    width, height = SIZE
    settings = {"seed": seed, "n_frames": 24, "width": width, "height": height, "cameras": ("front",)}
    return mudg.ingest("city", out=work / f"city{seed}", city=settings)


def reconstruction(work: Path, seed: int) -> Path:
    """The log as a run makes it, with virtual views."""
    out = work / f"run{seed}"
    mudg.run(str(city(work, seed)), out=out, fast=True, shifts_m=SHIFTS_M)
    return out


def beside(work: Path, seed: int, shifts_m: Sequence[float]) -> list[View]:
    """Views of a city's camera at shifts."""
    scene = mudg.read_scene(city(work, seed))
    return [view for shift in shifts_m for view in trajectory.at_shift(scene, "front", shift).views]


def exact(work: Path, seed: int, shifts_m: Sequence[float], every: int = 1) -> list[Labelled]:
    """What a camera would see in the city itself."""
    world = CityWorld.from_source(mudg.read_scene(city(work, seed)).source)
    found = (world.render(view, supersample=2) for view in beside(work, seed, shifts_m)[::every])
    return [(truth.rgb_u8, truth.semantics) for truth in found]


def recorded(work: Path, seed: int) -> list[Labelled]:
    """The log's images with exact labels."""
    scene = mudg.read_scene(city(work, seed))
    frames = scene.frames_of("front")
    return [(mudg.read_image(scene, frame), mudg.read_label(scene, frame, "semantics")) for frame in frames]


def rendered(work: Path, seed: int, determined: bool) -> list[Labelled]:
    """Our views; ``determined``: without the pixels that neither photographs nor LiDAR determine."""
    views = mudg.as_dataset(reconstruction(work, seed), cameras="front", shifts_m=SHIFTS_M)
    made = []
    for entry in (views[index] for index in range(len(views))):
        rgb = (entry["rgb"].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
        classes = entry["classes"].to(torch.uint8)
        if determined:
            classes = torch.where(entry["confidence"][0] >= CERTAIN, classes, UNLABELLED)
        made.append((rgb, classes.numpy()))
    return made


def network(images: Sequence[Labelled], steps: int, seed: int) -> StreetNet:
    """A segmenter trained on images."""
    torch.manual_seed(seeds.key(seed, 0, "segmenter") % 2**31)
    net = StreetNet(StreetNetConfig(widths=WIDTHS, blocks=(1, 1, 1, 1, 1))).train()
    optimizer = torch.optim.AdamW(net.parameters(), LR, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LR, steps, pct_start=0.1)
    for step in range(steps):
        rng = seeds.numpy_rng(seed, step, "images")
        chosen = [images[k] for k in rng.integers(0, len(images), BATCH)]
        flips = rng.random(BATCH) < 0.5
        pairs = [(rgb[:, ::-1], to[:, ::-1]) if flip else (rgb, to) for (rgb, to), flip in zip(chosen, flips)]
        target = torch.from_numpy(np.stack([to for _, to in pairs]).astype(np.int64))
        loss = functional.cross_entropy(scores(net, [rgb for rgb, _ in pairs]), target, ignore_index=UNLABELLED)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return net.eval()


def scores(net: StreetNet, images: Sequence[NDArray[np.uint8]]) -> torch.Tensor:
    """Scores f32[N, 19, H, W] without evidence of a LiDAR."""
    rgb = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 255
    return net(rgb, torch.zeros(len(rgb), PLANE_COUNT, *rgb.shape[2:]))


@torch.no_grad()
def mean_iou(net: StreetNet, images: Sequence[Labelled]) -> float:
    """Mean IoU over the classes that are there, in %."""
    count = np.zeros((len(CLASSES), len(CLASSES)))
    for rgb, truth in images:
        found = scores(net, [rgb])[0].argmax(0).numpy()
        known = truth != UNLABELLED
        np.add.at(count, (truth[known], found[known]), 1)
    both, there = np.diag(count), count.sum(1)
    return float(100 * (both / (there + count.sum(0) - both).clip(1))[there > 0].mean())


def main() -> None:
    """Train all rows and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--cities", type=int, default=4)
    parser.add_argument("--tests", type=int, default=4)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    work, trained = options.work, range(FIRST_TRAINED, FIRST_TRAINED + options.cities)
    gather: Callable[..., list[Labelled]] = lambda make, *more: [one for k in trained for one in make(work, k, *more)]
    base = gather(recorded)
    rows = {
        "recorded images": base,
        "and our views": base + gather(rendered, False),
        "and our views, determined pixels": base + gather(rendered, True),
        "and exact views": base + gather(exact, SHIFTS_M),
    }
    held = range(FIRST_TESTED, FIRST_TESTED + options.tests)
    tests = {m: [one for k in held for one in exact(work, k, (m, -m) if m else (0.0,), 4)] for m in TESTED_M}
    native.set_threads(1)
    torch.set_num_threads(1)
    sys.stdout.write(f"{'mIoU %, exact views of other cities':36s}" + "".join(f"{m:6.0f} m" for m in TESTED_M) + "\n")
    for name, images in rows.items():
        found = []
        for seed in range(options.repeats):
            net = network(images, options.steps, seed)
            found.append([mean_iou(net, tests[m]) for m in TESTED_M])
        middle, spread = np.mean(found, 0), np.ptp(found, 0)
        cells = "".join(f"{m:8.2f}" for m in middle) + "   spread " + "".join(f"{m:6.2f}" for m in spread)
        sys.stdout.write(f"{name:36s}{cells}   {len(images)} images\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
