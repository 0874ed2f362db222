"""The whole chain on the generated city at 960x640, 60 frames, 30,000 iterations: minutes per step, and scores.

    python bench/gpu/city_run.py --device cuda --work runs/city --out city.json
    python bench/gpu/city_run.py --small --device cpu

It is `mudg run city --preset quality`. Repeat it with the same --work to go on after an interruption.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from shared import device_of, finish, flags, work_folder

import mudg
from mudg.base import store

TINY: dict[str, dict[str, Any]] = {
    "ingest": {"city": {"n_frames": 4, "width": 60, "height": 40, "cameras": ["front"]}},
    "fit": {"iterations": 4, "start": {"gaussians": 500, "voxel_m": 0.5}},
    "synthesize": {"model": "embedded-tiny", "steps": 1},
    "score": {"perceptual_views": 0},
}


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    """Read the flags, run, print."""
    parser = flags(__doc__)
    parser.add_argument("--preset", default="quality")
    options = parser.parse_args(words)
    device = device_of(options)
    settings: dict[str, Any] = {name: dict(group) for name, group in TINY.items()} if options.small else {}
    settings["device"] = str(device)
    if options.small:
        settings["shifts_m"] = (2.0,)
    out = work_folder(options) / "run"
    made = mudg.run("city", out=out, preset=options.preset, **settings)
    rows = [{"what": name, "seconds": seconds, "minutes": seconds / 60} for name, seconds in made["seconds"].items()]
    return finish(options, device, rows, {"metrics": store.digest(made["metrics"])})


if __name__ == "__main__":
    main()
