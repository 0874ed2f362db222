"""Steps per second of a training whose clips lie in an object store, against the same training on a local folder.

    python bench/streaming.py --address s3://bucket/clips          # an S3 of your own (AWS_ENDPOINT_URL)
    python bench/streaming.py --address s3://bucket/clips --cities 24 --steps 20 --rounds 4 -- \\
        --data.no-renders --network.no-renders --network.widths 32 48 64 --network.finish-widths

Clips are generated (a minute per city, seconds without renders), uploaded, and trained on: from the folder, from the
address with an empty cache, and from the address without reading ahead. The order changes every round. The losses of
all are compared: they must be the same numbers. What follows ``--`` are further settings of ``mudg learn``.
``tools/storage_tests.sh`` shows how to start an S3 server on this machine.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from mudg.base.location import Location

WAYS = ("local", "streamed", "no reading ahead")
FLAGS = {
    "codec.steps": 2,
    "codec.fit-batches": 1,
    "data.first-cities": 2,
    "data.held-out": 1,
    "score.steps": 1,
    "score.every": 10**6,
    "compute.log-every": 1,
    "compute.checkpoint-every": 10**6,
}


def say(line: str) -> None:
    """One line of the result, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def train(flags: dict[str, object], more: list[str]) -> None:
    """One training; the program's own words on failure."""
    words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
    done = subprocess.run(
        [sys.executable, "-m", "mudg", "learn", "--quiet", *words, *more], capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(done.stderr)


def rows_of(out: Path) -> list[dict[str, float]]:
    """The rows of the network's training."""
    rows = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    return [row for row in rows if "rate" in row]


def main() -> None:
    """Uploads, trains in turn, prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--address", required=True, help="where the clips are uploaded to: s3://BUCKET/FOLDER")
    parser.add_argument("--clips", type=Path, help="folder that keeps the generated clips (a temporary one)")
    parser.add_argument("--cities", type=int, default=48)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("more", nargs="*", help="settings of mudg learn, after --")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        clips = options.clips or work / "clips"
        flags = {**FLAGS, "data.cities": options.cities, "data.clips": clips, "steps": 1, "out": work / "first"}
        train(flags, options.more)
        Location.of(options.address).push(clips)
        size = sum(path.stat().st_size for path in clips.glob("*.safetensors"))
        say(f"{options.cities} cities, {size / 1e6:.0f} MB, {options.steps} steps")
        rates: dict[str, list[float]] = {way: [] for way in WAYS}
        losses: set[tuple[float, ...]] = set()
        for number in range(options.rounds):
            for way in WAYS[number % 3 :] + WAYS[: number % 3]:
                out = work / f"{number} {way}"
                source = clips if way == "local" else options.address
                ahead = {"compute.read-ahead": 0} if way == "no reading ahead" else {}
                train({**flags, **ahead, "data.clips": source, "steps": options.steps, "out": out}, options.more)
                rows = rows_of(out)
                rates[way].append(rows[-1]["rate"])
                losses.add(tuple(row["total"] for row in rows))
            say("  ".join(f"{way} {rates[way][-1]:.2f} steps/s" for way in WAYS))
    if len(losses) > 1:
        raise SystemExit("the losses differ")
    for way in WAYS[1:]:
        ratios = [a / b for a, b in zip(rates[way], rates["local"], strict=True)]
        say(
            f"{way}: {statistics.median(ratios):.3f} of local ({min(ratios):.3f} to {max(ratios):.3f}); the same losses"
        )


if __name__ == "__main__":
    main()
