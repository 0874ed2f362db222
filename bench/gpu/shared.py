"""What the scripts of this folder share: flags, the device, clocks that wait for it, and result files."""

from __future__ import annotations

import argparse
import datetime
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from mudg.base import seeds, store
from mudg.base.devices import choose_device
from mudg.base.versions import environment
from mudg.core.noise import ScheduleConfig
from mudg.diffusion.published import PublishedConfig, PublishedMDM, meta_model
from mudg.diffusion.published_network import AutoencoderConfig, ResamplerConfig, VideoUNetConfig
from mudg.networks.clip import TowerConfig

SMALL_PUBLISHED = PublishedConfig(
    net=VideoUNetConfig(
        width=32, multipliers=(1, 2), blocks=1, attention=(True, False), head_width=8, first_heads=2, context_width=16
    ),
    codec=AutoencoderConfig(width=32, multipliers=(1, 2), blocks=1),
    image_tokens=ResamplerConfig(
        width=16, layers=1, head_width=8, heads=2, tokens=2, frames=4, image_width=16, context_width=16
    ),
    image=TowerConfig(16, 2, 2),
    image_side=28,
    text=TowerConfig(16, 3, 2),
    schedule=ScheduleConfig(base_scale=0.7),
    width=12,
    height=8,
)
"""A network of the published kind that a CPU runs in a moment."""


def flags(document: str) -> argparse.ArgumentParser:
    """A parser with the flags of every script."""
    parser = argparse.ArgumentParser(description=document, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:N")
    parser.add_argument("--small", action="store_true", help="the same code at a tiny size, for a CPU")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--work", type=Path, help="folder for what is made on the way (default: a temporary one)")
    parser.add_argument("--repeats", type=int, default=3)
    return parser


def device_of(options: argparse.Namespace) -> torch.device:
    """The chosen device; says which."""
    return choose_device(options.device, Path(sys.argv[0]).stem)


def work_folder(options: argparse.Namespace) -> Path:
    """The folder for intermediate results; a given one is used again."""
    return options.work or Path(tempfile.mkdtemp(prefix="mudg-gpu-"))


def generator_of(purpose: str, device: torch.device) -> torch.Generator:
    """A generator on a device, always the same for a purpose."""
    return torch.Generator(device).manual_seed(seeds.key(0, 0, purpose))


def measured(function: Callable[[], object], device: torch.device, repeats: int) -> dict[str, float | None]:
    """Median seconds of a call after one to warm up, and the peak of the card's memory in GB (None elsewhere: not
    measured)."""
    on_card = device.type == "cuda"
    function()
    if on_card:
        torch.cuda.synchronize(device)
        torch.cuda.reset_peak_memory_stats(device)
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        function()
        if on_card:
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - began)
    return {
        "seconds": statistics.median(times),
        "peak_gb": torch.cuda.max_memory_allocated(device) / 1e9 if on_card else None,
    }


def drawn_model(config: PublishedConfig, device: torch.device, dtype: torch.dtype) -> PublishedMDM:
    """A network of the published kind on a device, every weight drawn."""
    model = meta_model(config, dtype).to_empty(device=device)
    generator = generator_of("weights", device)
    with torch.no_grad():
        for value in model.parameters():
            value.normal_(0.0, 0.02, generator=generator)
        model.text.zero_()
    return model


def finish(
    options: argparse.Namespace,
    device: torch.device,
    rows: Sequence[dict[str, Any]],
    digests: dict[str, str] | None = None,
) -> dict[str, Any]:
    """Print the rows as a table, and write them with card, versions and digests to ``--out``."""
    card = torch.cuda.get_device_name(device) if device.type == "cuda" else None
    result = {
        "script": Path(sys.argv[0]).name,
        "settings": {n: str(v) for n, v in vars(options).items() if n not in ("out", "work")},
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "device": device.type,
        "card": card,
        "small": options.small,
        "versions": {**environment(), "cuda": torch.version.cuda},
        "digests": digests or {},
        "rows": list(rows),
    }
    for row in rows:
        cells = (
            f"{n} {v:.4g}" if isinstance(v, float) else f"{n} {'not measured' if v is None else v}"
            for n, v in row.items()
        )
        sys.stdout.write("  ".join(cells) + "\n")
    sys.stdout.flush()
    if options.out:
        store.write_json(options.out, result)
    return result
