"""Vehicles of one generated city put into another, against that city drawn again with them (``CityWorld.recast``).

In every city the vehicle that shows the most pixels (`bench/edit.py`) is replaced by that of the next city of the list, which was fitted
there and knows nothing of this city but what `matched_light` tells. Truth is the city with a vehicle of that shape, size and paint on the
path of its own, in its own light. Beside it stands what the fit makes of its own vehicle, which was recorded there.

    psnr        PSNR in the pixels of the vehicle, and of the recorded one
    perceptual  perceptual distance there (features of the shipped codec, weighted by these pixels), and of the recorded one
    light       true mean light of the vehicle over that of the render, in linear light: 1 = as bright as it should be
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mudg.base import log, store
from mudg.bench.edit import EVERY_FRAMES, EditCase, case_of, distance_in, psnr_in, rendered
from mudg.data.city import CityWorld
from mudg.data.edits import parse_edits
from mudg.models.featnets import CodecFeatures
from mudg.models.mdm import files as mdm_files
from mudg.models.scene.edited import linear_of
from mudg.models.scene.model import SceneModel
from mudg.stages.config import BenchConfig
from mudg.stages.editing.assets import complete_asset, write_asset
from mudg.stages.editing.carried import carry_out

WAYS: Final = {"light matched": "true", "as recorded": "false"}
"""Name of a row -> `match_light`."""
Seen = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]
FEWEST_PX: Final = 30
"""A frame counts if it shows so many pixels of the vehicle."""
_AVERAGED: Final = ("psnr", "psnr_recorded", "perceptual", "perceptual_recorded")


def _rows_of_pair(case: EditCase, giver: EditCase, out: Path) -> list[dict[str, Any]]:
    """Scores of the vehicle of one city in another, with and without matched light."""
    asset = out / "edited" / f"{giver.city}_vehicle.safetensors"
    if not asset.is_file():
        write_asset(asset, complete_asset(giver.model, giver.name, [frame.view for frame in giver.scene.frames]))
    truth = case.world.recast(case.name, giver.world.objects[giver.world.instance_of(giver.name) - 1])
    usual = _seen(case, case.world, case.model)
    rows = []
    for way, match in WAYS.items():
        text = f"- replace: {{id: {case.name}, by: {{file: {asset}}}, match_light: {match}}}"
        drive = carry_out(parse_edits(text, way), case.model, case.scene)
        made = _seen(case, truth, drive.model(case.model))
        lights = f"{giver.world.light_name} to {case.world.light_name}"
        row = {"city": case.city, "object": case.name, "from": giver.city, "lights": lights, "way": way}
        rows.append({**row, **_scores(made, usual)})
    return rows


def _seen(case: EditCase, world: CityWorld, model: SceneModel) -> list[Seen]:
    """Render, truth and the vehicle's pixels in the frames that show it."""
    number, seen = case.world.instance_of(case.name), []
    for frame in case.scene.frames[::EVERY_FRAMES]:
        truth = world.render(frame.view)
        if (truth.instance == number).sum() >= FEWEST_PX:
            seen.append((rendered(model, frame.view), truth.rgb, truth.instance == number))
    return seen


def _scores(made: list[Seen], recorded: list[Seen]) -> dict[str, float | None]:
    codec = CodecFeatures(mdm_files.load("embedded").codec)
    found: dict[str, float | None] = {}
    for end, seen in (("", made), ("_recorded", recorded)):
        found["psnr" + end] = psnr_in([(image - true)[mask] for image, true, mask in seen])
        distances = [distance_in(codec, image, true, mask) for image, true, mask in seen]
        found["perceptual" + end] = float(np.mean(distances)) if distances else None
    light = [np.concatenate([linear_of(one[which][one[2]]) for one in made]).mean() for which in (0, 1)] if made else None
    return {**found, "light": None if light is None else float(light[1] / light[0])}


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means per way over the cities that show the vehicle; of light the root mean square factor."""
    made = []
    for way in WAYS:
        mine = [row for row in rows if row["way"] == way and row["psnr"] is not None]
        if mine:
            means = {key: float(np.mean([row[key] for row in mine])) for key in _AVERAGED}
            off = float(np.exp(np.sqrt(np.mean(np.log([row["light"] for row in mine]) ** 2))))
            made.append({"way": way, "cities": len(mine), **means, "light": off})
    return made


def table(rows: list[dict[str, Any]]) -> str:
    """The summary as text."""
    lines = [
        "", "## Vehicles of other cities", "",
        "| inserted | vehicle [dB] | recorded there | perceptual | recorded there | ratio | light off by |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for row in summary(rows):
        ratio = row["perceptual"] / row["perceptual_recorded"]
        lines.append(f"| {row['way']} | {row['psnr']:.2f} | {row['psnr_recorded']:.2f} | {row['perceptual']:.4f} | "
                     f"{row['perceptual_recorded']:.4f} | {ratio:.1f}x | {row['light']:.2f}x |")  # fmt: skip
    return "\n".join(lines) + "\n"


def measure(config: BenchConfig, cities: Sequence[int], out: Path) -> list[dict[str, Any]]:
    """Every city with the vehicle of the next one of the list; cities that an interrupted run finished are kept."""
    places = {city: out / "rows" / f"{city}_insert.json" for city in cities}
    with log.task("inserting vehicles of other cities", len(cities)) as bar:
        for city, giver in zip(cities, [*cities[1:], *cities[:1]], strict=True):
            if not places[city].is_file():
                store.write_json(places[city], _rows_of_pair(case_of(config, city, out), case_of(config, giver, out), out))
            bar.advance()
    return [row for place in places.values() for row in store.read_json(place)]
