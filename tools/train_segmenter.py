"""Make the segmentation network that comes with the package: `mudg annotate --labeller embedded`.

python tools/train_segmenter.py data  WORK                       images of generated cities, some four seconds a city
python tools/train_segmenter.py train WORK                       goes on from the newest checkpoint
python tools/train_segmenter.py score WORK --list development    mIoU on city logs
python tools/train_segmenter.py ship  WORK --model FOLDER        calibrates confidences, writes model, weights and card

Every draw depends on (seed, step) alone: a run that was stopped ends as one that was not, and a second run gives the
same network on the same processor type at the same number of threads.
"""

from __future__ import annotations

import argparse
import collections
import concurrent.futures
import dataclasses
import itertools
import multiprocessing
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import segmenter_data
import segmenter_vary
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from mudg import native
from mudg.base import checkpoint, seeds, store
from mudg.base.errors import ResourceError
from mudg.base.palette import CLASSES, UNLABELLED
from mudg.city import logs as city_logs
from mudg.labels import street_net
from mudg.labels.evidence import encode
from mudg.labels.street_net import StreetLabeller, StreetNet, StreetNetConfig

RECIPE = ("seed", "size", "cities", "first_cities", "all_cities_at", "batch", "lr", "balance")
AVERAGE = 0.995
WARMUP = 60
FALL = 0.4


CARD = """# Small segmentation network for streets

Tells the Cityscapes classes of a picture from its colours and from measured evidence at every pixel: height above the
ground plane, dense depth and how far away it was measured, the surface's direction and roughness, distance to the
driven path and whether a step lies between, elevation of the ray, and tracked boxes (`labels/evidence.py`). Works, with
less, without LiDAR or boxes.
{parameters:.2f} million parameters, stored in float16.

**Training data**: generated cities only (numbers 0 to {last} of seed {seed}), {images} images at {size} pixels,
looked at in all directions, with 16 to 128 beams and 1 to 6 sweeps. No real image, and no weight of any other model,
was used.

**Recipe**: `python tools/train_segmenter.py`, settings in `model.json` under `facts.recipe`: {steps} steps of {batch}
crops of 192x288 pixels, AdamW, moving average, bfloat16, {minutes:.0f} minutes of one CPU core. Colours, sharpness,
noise and compression of the image are varied strongly; the image, the returns, boxes and the ground plane are left
out now and then.

**Confidence**: the class's probability; scores are divided by {temperature}, fitted on varied crops of cities
{held_first} to {held_last}, which were not trained on.

**Scores** on {images_each} image(s) of each of {logs} city logs (`{list}` list, 384x256 pixels, 6 sweeps, true boxes):

```
{scores}```

**Limits**: the train class never occurs in training; a box labelled so is still painted. Fences, walls and poles of
real streets look different from generated ones; on recorded images thin things and signs are found badly. Bonnets of
the own vehicle, tunnels, night, rain and snow were not trained on. Not for use in vehicles.

**Licence**: Apache-2.0, as the package.
"""


def say(line: str) -> None:
    """One line of the result, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


# --- data -----------------------------------------------------------------------------------------


def make_data(options: argparse.Namespace) -> None:
    """Write the images that are missing."""
    width, height = (int(side) for side in options.size.split("x"))
    for city in range(options.first, options.cities + options.held_out):
        if image_file(options.work, city, segmenter_data.VIEWS - 1).is_file():
            continue
        for number, made in enumerate(segmenter_data.samples(options.seed, city, width, height)):
            segmenter_data.save(image_file(options.work, city, number), made)
        say(f"city {city}")


# --- training -------------------------------------------------------------------------------------


def class_weights(files: list[Path], balance: float) -> Tensor:
    """share^-balance of each class over some files, f32[19], with mean 1 over pixels; absent classes weigh as the
    rarest."""
    counts = np.zeros(256)
    for path in files[:: max(1, len(files) // 60)]:
        counts += np.bincount(segmenter_data.load(path).truth.ravel(), minlength=256)
    share = counts[: len(CLASSES)] / counts[: len(CLASSES)].sum()
    weight = np.maximum(share, max(2e-4, float(share[share > 0].min()))) ** -balance
    return torch.tensor(weight / (weight * share).sum(), dtype=torch.float32)


def cities_at(options: argparse.Namespace, step: int) -> int:
    """How many cities may be drawn from at a step: images can still be in the making while training runs."""
    share = min(1.0, step / options.all_cities_at)
    return min(options.cities, options.first_cities + int((options.cities - options.first_cities) * share))


def image_file(work: Path, city: int, number: int) -> Path:
    """Where an image of a city lies."""
    return work / f"train/{city:05d}_{number}.safetensors"


Batch = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]


def draw(options: argparse.Namespace, step: int) -> Batch:
    """The batch of a step: colours, planes, classes."""
    parts = []
    for place in range(options.batch):
        rng = seeds.numpy_rng(options.seed, step, f"segmenter batch {place}")
        path = image_file(
            options.work, int(rng.integers(cities_at(options, step))), int(rng.integers(segmenter_data.VIEWS))
        )
        while not path.is_file():
            time.sleep(1)
        picked = segmenter_data.load(path)
        parts.append(segmenter_vary.varied(picked, rng, segmenter_vary.Rules()))
    rgb, planes, truth = (np.stack(column) for column in zip(*parts, strict=True))
    return rgb, planes, truth


def batches(options: argparse.Namespace, first: int) -> Iterator[Batch]:
    """The batches of all steps from ``first`` on; ``--workers`` processes make them ahead of time, which changes
    nothing in them."""
    steps = range(first, options.steps)
    if options.workers == 0:
        yield from (draw(options, step) for step in steps)
        return
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.workers, mp_context=context) as pool:
        waiting = collections.deque(pool.submit(draw, options, step) for step in steps[: options.workers + 1])
        for step in steps:
            batch = waiting.popleft().result()
            if step + options.workers + 1 < options.steps:
                waiting.append(pool.submit(draw, options, step + options.workers + 1))
            yield batch


def rate(step: int, steps: int, peak: float) -> float:
    """Learning rate: up over ``WARMUP`` steps, constant, and down to a fiftieth over the last ``FALL`` of all steps."""
    return peak * min(1.0, (step + 1) / WARMUP) * max(0.02, min(1.0, (1 - step / steps) / FALL))


def weights_of(net: StreetNet) -> dict[str, Tensor]:
    """The trained tensors, which share memory with the network."""
    return {name: parameter.detach() for name, parameter in net.named_parameters()}


def put(net: StreetNet, tensors: dict[str, Tensor]) -> None:
    """Set the trained tensors."""
    for name, held in weights_of(net).items():
        held.copy_(tensors[name])


def train(options: argparse.Namespace) -> None:
    """The loop."""
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False
    files = [image_file(options.work, city, 0) for city in range(options.first_cities)]
    with torch.random.fork_rng():
        torch.default_generator.manual_seed(seeds.key(options.seed, 0, "segmenter start"))
        net = StreetNet(StreetNetConfig()).to(memory_format=torch.channels_last)
    if options.start:
        put(net, weights_of(street_net.load(options.start)))
    optimizer = torch.optim.AdamW(net.parameters(), lr=options.lr, betas=(0.9, 0.99), weight_decay=0.02)
    average = {name: value.clone() for name, value in weights_of(net).items()}
    folder = options.work / options.run
    found = checkpoint.latest(folder)
    first, seconds = 0, 0.0
    if found is not None:
        first, seconds = found.step, float(found.state["processor_s"])
        put(net, found.tensors("net"))
        average = found.tensors("average")
        moments = found.tensors("moments")
        for n, parameter in enumerate(net.parameters()):
            optimizer.state[parameter] = {
                "step": torch.tensor(float(first)),
                "exp_avg": moments[f"{n}.first"],
                "exp_avg_sq": moments[f"{n}.second"],
            }
    weights = class_weights(files, options.balance)
    say(f"{options.cities} cities, {sum(p.numel() for p in net.parameters()):,} parameters, from step {first}")
    bf16 = bool(getattr(torch.cpu, "get_capabilities", dict)().get("amx_bf16", False))
    losses: list[float] = []
    for step, batch in enumerate(batches(options, first), first):
        rgb, planes, truth = (torch.from_numpy(array) for array in batch)
        for group in optimizer.param_groups:
            group["lr"] = rate(step, options.steps, options.lr)
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            scores = net(rgb, planes)
        flat = scores.float().permute(0, 2, 3, 1).reshape(-1, len(CLASSES))
        loss = functional.cross_entropy(flat, truth.flatten().long(), weights, ignore_index=UNLABELLED)
        optimizer.zero_grad()
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0, error_if_nonfinite=True)
        optimizer.step()
        losses.append(loss.item())
        keep = min(AVERAGE, (step + 1) / (step + 10))
        for name, value in weights_of(net).items():
            average[name].lerp_(value, 1 - keep)
        done = step + 1
        if done % 20 == 0:
            say(
                f"step {done}: loss {np.mean(losses[-20:]):.4f}, gradient {norm:.2f}, {time.process_time():.0f} s of"
                " processor time"
            )
        if done % options.checkpoint_every == 0 or done == options.steps:
            moments = {}
            for n, parameter in enumerate(net.parameters()):
                moments |= {
                    f"{n}.first": optimizer.state[parameter]["exp_avg"],
                    f"{n}.second": optimizer.state[parameter]["exp_avg_sq"],
                }
            groups = {"net": weights_of(net), "average": average, "moments": moments}
            whole = {k: {n: v.contiguous() for n, v in g.items()} for k, g in groups.items()}
            checkpoint.save(folder, done, whole, {"seed": options.seed, "processor_s": seconds + time.process_time()})


def trained(options: argparse.Namespace) -> tuple[StreetNet, int, float]:
    """The average of the newest checkpoint of a run, its step, and the processor seconds it took.

    Raises:
        ResourceError: there is none.
    """
    found = checkpoint.latest(options.work / options.run)
    if found is None:
        raise ResourceError("the run has no checkpoint", where=str(options.work / options.run), remedy="train first")
    net = StreetNet(StreetNetConfig())
    put(net, found.tensors("average"))
    return net.eval().to(memory_format=torch.channels_last), found.step, float(found.state["processor_s"])


# --- scores ---------------------------------------------------------------------------------------


def counted(found: NDArray[np.uint8], truth: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Pixels by (true class, found class), i64[19, 256]; unlabelled truth is left out."""
    known = truth != UNLABELLED
    pairs = truth[known].astype(np.int64) * 256 + found[known]
    return np.bincount(pairs, minlength=256 * 256).reshape(256, 256)[: len(CLASSES)]


def ious(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Intersection over union of each class, NaN for those that the truth lacks, f64[19]."""
    right = np.diag(counts[:, : len(CLASSES)])
    union = counts.sum(1) + counts[:, : len(CLASSES)].sum(0) - right
    return np.where(counts.sum(1) > 0, right / np.maximum(union, 1), np.nan)


def line_of(name: str, counts: NDArray[np.int64]) -> str:
    """Mean IoU over the classes present, accuracy, and each class."""
    found = ious(counts)
    accuracy = np.diag(counts[:, : len(CLASSES)]).sum() / counts.sum()
    each = ", ".join(f"{name} {value:.2f}" for name, value in zip(CLASSES, found, strict=True) if np.isfinite(value))
    return f"{name:28s} mIoU {np.nanmean(found):.3f}  accuracy {accuracy:.3f}  {each}"


def score(options: argparse.Namespace) -> None:
    """The labeller on the first logs of a list: with everything, without boxes, without LiDAR."""
    labeller = StreetLabeller(street_net.load(options.model) if options.model else trained(options)[0])
    totals: dict[str, NDArray[np.int64]] = {}
    surer = np.zeros((10, 3))
    for seed in city_logs.LISTS[options.list][: options.logs]:
        for given, truth in itertools.islice(segmenter_data.log_shots(seed), options.images):
            blind = dataclasses.replace(given, xyz_world=given.xyz_world[:0])
            cases = {"all": given, "no boxes": dataclasses.replace(given, tracks=()), "no LiDAR": blind}
            for name, case in cases.items():
                ids, confidence = labeller.classes(case)
                totals[name] = totals.get(name, 0) + counted(ids, truth)
                if name == "all":
                    place = np.minimum((confidence * 10).astype(int), 9)
                    for n, value in enumerate((np.ones_like(confidence), confidence, ids == truth)):
                        surer[:, n] += np.bincount(place.ravel(), value.ravel().astype(float), minlength=10)
        say(f"log {seed}")
    off = np.abs(surer[:, 1] - surer[:, 2]).sum() / surer[:, 0].sum()
    lines = [
        *(line_of(name, counts) for name, counts in totals.items()),
        f"confidence is off by {off:.3f} on average; right by tenths of confidence: "
        + ", ".join(f"{right / max(count, 1):.2f}" for count, _, right in surer),
    ]
    say("\n".join(lines))
    store.write_text(options.work / f"{options.run}_{options.list}.txt", "\n".join(lines) + "\n")


# --- shipping -------------------------------------------------------------------------------------


def temperature(net: StreetNet, options: argparse.Namespace) -> float:
    """What the network's scores are divided by so that the classes are likeliest, on varied images of cities that were
    not trained on."""
    kept, classes = [], []
    rules = segmenter_vary.Rules()
    for city in range(options.cities, options.cities + options.held_out):
        for number in range(segmenter_data.VIEWS):
            rng = seeds.numpy_rng(options.seed, city, f"segmenter calibration {number}")
            picked = segmenter_data.load(image_file(options.work, city, number))
            rgb = segmenter_vary.colored(picked.rgb.astype(np.float32) / 255, picked.truth, rng, rules)
            rgb = (np.clip(rgb, 0, 1) * 255).astype(np.uint8)
            found = net.probabilities(rgb, encode(segmenter_vary.disturbed(picked.evidence, rng, rules)))
            rows, columns = (rng.integers(size, size=2000) for size in picked.truth.shape)
            kept.append(np.log(np.maximum(found[:, rows, columns], 1e-12)))
            classes.append(picked.truth[rows, columns].astype(np.int64))
    scores, target = torch.from_numpy(np.concatenate(kept, 1).T), torch.from_numpy(np.concatenate(classes))
    choices = np.geomspace(0.5, 4, 32)
    losses = [float(functional.cross_entropy(scores / t, target, ignore_index=UNLABELLED)) for t in choices]
    return round(float(choices[int(np.argmin(losses))]), 3)


def ship(options: argparse.Namespace) -> None:
    """Write the network with its card into ``--model``."""
    net, steps, seconds = trained(options)
    net.config = dataclasses.replace(net.config, temperature=temperature(net, options))
    recipe = {name: vars(options)[name] for name in RECIPE} | {"steps": steps}
    facts = {"recipe": recipe, "processor_minutes": round(seconds / 60, 1)}
    scores = options.work / f"{options.run}_{options.list}.txt"
    found = scores.read_text(encoding="utf-8") if scores.is_file() else "not computed\n"
    street_net.save(
        net,
        Path(options.model),
        CARD.format(
            parameters=sum(p.numel() for p in net.parameters()) / 1e6,
            images=options.cities * segmenter_data.VIEWS,
            seed=options.seed,
            cities=options.cities,
            last=options.cities - 1,
            held_first=options.cities,
            held_last=options.cities + options.held_out - 1,
            steps=steps,
            batch=options.batch,
            minutes=seconds / 60,
            temperature=net.config.temperature,
            list=options.list,
            logs=options.logs,
            images_each=options.images,
            scores=found,
            size=options.size,
        ),
        facts,
    )
    say(f"temperature {net.config.temperature}, {options.model}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("verb", choices=("data", "train", "score", "ship"))
    parser.add_argument("work", type=Path)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--size", default="384x256")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cities", type=int, default=134)
    parser.add_argument("--first-cities", type=int, default=40, help="cities in use from the first step")
    parser.add_argument("--all-cities-at", type=int, default=500, help="step from which on all are in use")
    parser.add_argument("--run", default="run", help="folder of checkpoints in WORK")
    parser.add_argument("--start", default="", help="folder of a network to begin with")
    parser.add_argument("--workers", type=int, default=1, help="processes that make batches ahead of time")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--lr", type=float, default=2e-3)
    parser.add_argument("--balance", type=float, default=0.25)
    parser.add_argument("--checkpoint-every", type=int, default=100)
    parser.add_argument("--list", choices=tuple(city_logs.LISTS), default="development", help="score: city logs")
    parser.add_argument("--logs", type=int, default=6, help="score: how many of the list")
    parser.add_argument("--images", type=int, default=3, help="score: images of each log, one by each camera")
    parser.add_argument("--model", default="", help="ship: folder to write; score: folder to read instead of the run")
    parser.add_argument("--held-out", type=int, default=6, help="ship: cities after the last one for calibration")
    options = parser.parse_args()
    torch.set_num_threads(1)
    native.set_threads(1)
    {"data": make_data, "train": train, "score": score, "ship": ship}[options.verb](options)


if __name__ == "__main__":
    main()
