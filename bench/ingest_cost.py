"""What an import costs: seconds a frame and peak memory, measured in a process of its own.

    python bench/ingest_cost.py FORMAT SOURCE [--workers N] [--resolution R] [--frames a:b]

A frame is one image with its share of the sweeps. Processor seconds do not depend on what else the machine does; peak
memory is the largest resident size less that of the program with the importer loaded.
"""

from __future__ import annotations

import argparse
import importlib
import resource
import sys
import tempfile
import time
from pathlib import Path

from mudg.base import log
from mudg.formats.importers import IMPORTERS
from mudg.formats.importers.common import ImportOptions, parse_frame_range, parse_resolution


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("format", choices=sorted(IMPORTERS))
    parser.add_argument("source", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--resolution", default="")
    parser.add_argument("--frames", default="")
    parser.add_argument("--sequence", default="")
    asked = parser.parse_args()
    log.set_quiet(True)
    options = ImportOptions(
        frames=parse_frame_range(asked.frames),
        sequence=asked.sequence,
        workers=asked.workers,
        resolution=parse_resolution(asked.resolution),
    )
    for module in ("PIL.PngImagePlugin", "PIL.JpegImagePlugin", "safetensors.numpy", "scipy.sparse"):
        importlib.import_module(module)
    before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with tempfile.TemporaryDirectory() as folder:
        wall, cpu = time.perf_counter(), time.process_time()
        scene = IMPORTERS[asked.format](asked.source, Path(folder) / "scene", options)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib) / 1024
    frames = len(scene.frames)
    sys.stdout.write(
        f"{asked.format}: {frames} images, {len(scene.sweeps)} sweeps, {asked.workers} workers: {wall / frames:.3f} s a"
        f" frame ({cpu / frames:.3f} of the processor), peak memory {peak:.0f} MiB above {before_kib / 1024:.0f} MiB\n"
    )


if __name__ == "__main__":
    main()
