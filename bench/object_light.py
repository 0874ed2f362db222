"""How well the light of a street is known for a vehicle from another one (``editing/apply.py``), on generated cities.

Every city is fitted as by `mudg bench edit`. Of its vehicle that shows most pixels the true mean light is known in its
own city, and, drawn in place of theirs (``CityWorld.recast``), in all others: their ratio per channel is the factor
that an inserted object needs. Printed is the root mean square of the logarithm of what is left of it after a guess:
none; the ratio of the roads' median light in the true images; the ratio of the surfaces' mean light in the fits; that
to the power that is used.

    python bench/object_light.py --cities 2000100 2000101 2000102 2000103 2000104 2000105 --work runs/light
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from mudg.base.palette import ID
from mudg.benchmarks.cities import EVERY_FRAMES, EditCase, case_of
from mudg.benchmarks.settings import BenchConfig
from mudg.city.world import CityWorld
from mudg.editing.apply import surface_light
from mudg.editing.model import LIGHT_EXPONENT, linear_of

FEWEST_PX = 100
WIDEST = np.log(4.0)


def vehicle_light(case: EditCase, world: CityWorld) -> np.ndarray | None:
    """True mean light f64[3] of the pixels of a city's vehicle, None where it hardly shows."""
    number, found = case.world.instance_of(case.name), []
    for frame in case.scene.frames[::EVERY_FRAMES]:
        truth = world.render(frame.view)
        found.append(truth.rgb[truth.instance == number])
    pixels = np.concatenate(found)
    return linear_of(pixels.astype(np.float64)).mean(0) if len(pixels) >= FEWEST_PX else None


def road_light(case: EditCase) -> np.ndarray:
    """Median light f64[3] of the road in true images."""
    truths = [case.world.render(frame.view) for frame in case.scene.frames[::EVERY_FRAMES]]
    return linear_of(
        np.median(np.concatenate([t.rgb[t.semantics == ID["road"]] for t in truths]).astype(np.float64), 0)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cities", type=int, nargs="+", required=True, help="seeds of generated cities")
    parser.add_argument("--work", type=Path, required=True, help="folder of the fits")
    asked = parser.parse_args()
    cases = [case_of(BenchConfig(), seed, asked.work) for seed in asked.cities]
    own = [vehicle_light(case, case.world) for case in cases]
    lights = {
        "roads": [road_light(case) for case in cases],
        "surfaces": [surface_light(case.model, [frame.view for frame in case.scene.frames]) for case in cases],
    }
    true: list[np.ndarray] = []
    guessed: dict[str, list[np.ndarray]] = {name: [] for name in lights}
    for i, here in enumerate(cases):
        for j, giver in enumerate(cases):
            light = None
            if i != j and own[j] is not None:
                look = giver.world.objects[giver.world.instance_of(giver.name) - 1]
                light = vehicle_light(here, here.world.recast(here.name, look))
            if light is not None:
                true.append(np.log(light / own[j]))
                for name, found in lights.items():
                    guessed[name].append(np.log(found[i] / found[j]).clip(-WIDEST, WIDEST))
    roads, surfaces = (np.array(guessed[name]) for name in ("roads", "surfaces"))
    left = {"none": 0 * roads, "ratio of roads": roads, "ratio of surfaces": surfaces}
    left[f"to the power {LIGHT_EXPONENT}"] = LIGHT_EXPONENT * surfaces
    best = (np.array(true) * surfaces).sum() / (surfaces**2).sum()
    sys.stdout.write(f"{len(true)} pairs of {len(cases)} cities; best power {best:.2f}\n")
    for name, guess in left.items():
        sys.stdout.write(f"{name:20} {np.sqrt(((np.array(true) - guess) ** 2).mean()):.3f}\n")


if __name__ == "__main__":
    main()
