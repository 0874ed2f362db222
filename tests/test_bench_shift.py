"""``mudg bench shift``: lists, tables with known answers, and the command end to end on a tiny log."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from refusals import refused
from tiny_networks import saved_mdm

from mudg.base import seeds, store
from mudg.base.errors import UsageError
from mudg.base.geometry import yaw_matrix
from mudg.base.types import Camera, View
from mudg.benchmarks import run as bench
from mudg.benchmarks import shift
from mudg.benchmarks.rows import LONGER, method_rows
from mudg.benchmarks.settings import BenchConfig
from mudg.city import logs as city_logs
from mudg.city.config import CityConfig
from mudg.city.world import CityWorld
from mudg.core import metrics
from mudg.diffusion import city_clips
from mudg.gaussians.settings import METHODS, PUBLISHED
from mudg.scene.observations import list_observation_sets, read_observations
from mudg.scoring import truth as score_truth

TINY = CityConfig(n_frames=4, width=96, height=64, cameras=("front",))


# ---- lists ---------------------------------------------------------------------------------------


def test_lists_are_apart_from_each_other_and_from_all_training_cities():
    development, reported = city_logs.LISTS["development"], city_logs.LISTS["reported"]
    assert (len(development), len(reported)) == (4, 8) and not set(development) & set(reported)
    for seeds_ in (development, reported):
        turns = [city_logs.turn_deg(city_logs.log_config(seed)) for seed in seeds_]
        assert sum(turn >= city_logs.CURVED_DEG for turn in turns) == len(turns) / 2
    trained = {seeds.key(0, city, "city") & 0x7FFFFFFF for city in range(5000)}
    scored = {
        city_clips.city_config(city_clips.CityClipRules(), c).seed for of in city_clips.LISTS.values() for c in of
    }
    assert not (trained | scored) & set(development + reported)


@pytest.mark.parametrize(
    ("first", "name"), [(2_100_000, "development"), pytest.param(2_100_100, "reported", marks=pytest.mark.slow)]
)
def test_a_list_is_what_the_rule_gives(first, name):
    """Half of the list is curved; seeds are walked upwards."""
    kept, half, seed = {True: [], False: []}, len(city_logs.LISTS[name]) // 2, first
    while min(map(len, kept.values())) < half:
        config = city_logs.log_config(seed)
        curved = city_logs.turn_deg(config) >= city_logs.CURVED_DEG
        if len(kept[curved]) < half and city_logs.facts(CityWorld(config))["movers"] >= city_logs.MOVING:
            kept[curved].append(seed)
        seed += 1
    assert tuple(sorted(kept[True] + kept[False])) == city_logs.LISTS[name]


def test_moving_instances_are_those_of_the_generator():
    world = CityWorld(city_logs.log_config(city_logs.DEVELOPMENT[0], TINY))
    ways = [np.ptp(posed.keys[:, :2], axis=0).max() for posed in world.objects]
    still = {number for number, way in enumerate(ways, start=1) if way == 0}
    assert set(city_logs.moving_instances(world)) and not set(city_logs.moving_instances(world)) & still


# ---- rows ----------------------------------------------------------------------------------------


def test_rows_are_those_that_are_asked_for():
    rows = method_rows(BenchConfig(methods=("mudg_s", LONGER, "street_gaussians"), iterations=30))
    assert [row.name for row in rows] == ["street_gaussians", LONGER, "mudg_s"]
    assert rows[1].fit == rows[0].fit
    config = BenchConfig(methods=("pvg", "street_gaussians", "emernerf"), iterations=30)
    rows = {row.name: row.fit for row in method_rows(config)}
    assert list(rows) == ["street_gaussians", "pvg", "emernerf"]
    assert {name: (fit.method, fit.iterations) for name, fit in rows.items()} == {name: (name, 30) for name in rows}
    assert not set(PUBLISHED) & set(BenchConfig().methods)
    assert set(PUBLISHED) < set(METHODS)
    refused("unknown method", method_rows, BenchConfig(methods=("nerf",)), raises=UsageError)


# ---- tables --------------------------------------------------------------------------------------


def made_up(psnr, abs_rel):
    """Logs whose methods have the given numbers at 2 m and these plus 1 at 4 m; nothing else."""
    facts = {"turn_deg": 1.0, "length_m": 2.0, "movers": 3, "mover_share": 0.1, "words": "x"}
    places = (("0", 5), ("2", 0), ("4", 1))
    values = [
        {m: {p: {"psnr": psnr[m][log] + more, "abs_rel": abs_rel[m][log]} for p, more in places} for m in psnr}
        for log in range(len(psnr["a"]))
    ]
    return [{"log": log, **facts, "seconds": {}, "values": of} for log, of in enumerate(values)]


def test_differences_and_ratios_with_their_standard_errors_by_hand():
    logs = made_up({"a": [20.0, 22.0, 27.0], "b": [19.0, 20.0, 24.0]}, {"a": [0.1, 0.2, 0.3], "b": [0.2, 0.2, 0.2]})
    for entry in logs:
        entry["values"] = {m: shift.with_mean(of, ["2", "4"]) for m, of in entry["values"].items()}
    (difference,) = shift.against(logs, "a", "b", "shifted", "psnr")
    assert (difference["kind"], difference["value"]) == ("difference", pytest.approx(2.0))
    assert difference["standard_error"] == pytest.approx(np.std([1, 2, 3], ddof=1) / math.sqrt(3))
    (ratio,) = shift.against(logs, "a", "b", "2", "abs_rel")
    assert (ratio["kind"], ratio["value"]) == ("ratio", pytest.approx(1.0))
    left = [1.25, 1.0, 0.75]  # ratio of means without the first, second, third log
    assert ratio["standard_error"] == pytest.approx(math.sqrt(2 / 3 * sum((v - 1.0) ** 2 for v in left)))
    (one,) = shift.against(logs[:1], "a", "b", "2", "psnr")
    assert (one["value"], one["standard_error"]) == (1.0, None)


def test_what_a_log_lacks_is_left_out_and_named():
    logs = made_up({"a": [20.0, 22.0], "b": [19.0, 20.0]}, {"a": [0.1, 0.2], "b": [0.2, 0.2]})
    logs[1]["values"]["a"]["2"]["psnr"] = "no truth"
    rows = [{"name": "a", "title": "a", "fit": None}, {"name": "b", "title": "b", "fit": None}]
    settings = {"list": "x", "iterations": 1, "seed": 0, "frames": 4, "size_px": [8, 8], "cameras": ["front"]}
    settings |= {"held_out_every": 4, "guided_share": 1.5}
    document = shift.document(logs, rows, [2.0, 4.0], settings)
    assert document["pooled"]["a"]["2"]["psnr"] == {"mean": 20.0, "standard_error": None, "logs": 1}
    assert document["logs"][1]["values"]["a"]["shifted"]["psnr"] == "no truth"
    assert document["pooled"]["a"]["0"]["psnr"]["mean"] == pytest.approx(26.0)
    assert document["pooled"]["b"]["shifted"]["psnr"]["mean"] == pytest.approx(20.0)
    assert document["pooled"]["a"]["2"]["miou"] == "not produced"
    assert "not produced" in shift.markdown(document)


def test_flicker_is_change_relative_to_the_truth_and_leaves_movers_and_the_camera_out():
    """A wall 10 m ahead, the camera moving 0.5 m sideways (so 1 pixel) per frame: its picture moves, it does not
    change."""
    camera = Camera("front", 16, 12, 20.0, 20.0, 8.0, 6.0)
    views = [View(camera, yaw_matrix(0.0, (0.5 * t, 0, 0)), 0.1 * t) for t in range(3)]
    row = torch.rand(1, 3, 12, 19, generator=torch.Generator().manual_seed(0))
    rgb = torch.cat([row[..., t : t + 16] for t in range(3)])
    depth, ids = torch.full((1, 12, 16), 10.0), torch.full((12, 16), 2)
    frames, blinking = [metrics.TrueFrame(view, depth, ids) for view in views], rgb.clone()
    blinking[1] += 0.1
    for t in (0, 1):
        motion = metrics.pixel_motion(frames[t], frames[t + 1])
        assert metrics.change(rgb[t], rgb[t + 1], motion) == pytest.approx(0.0, abs=1e-3)
        assert metrics.change(blinking[t], blinking[t + 1], motion) == pytest.approx(0.1 * 12 * 15, rel=1e-3)
    noise = torch.randn(rgb.shape, generator=torch.Generator().manual_seed(1))
    made, truth = rgb + 0.3 * noise, rgb + 0.1 * noise
    assert metrics.flicker(made, truth, frames) == pytest.approx(3.0, rel=1e-3)
    cars = [dataclasses.replace(frame, ids=torch.full_like(ids, 13)) for frame in frames]
    assert math.isnan(metrics.flicker(made, truth, cars)) and math.isnan(
        metrics.flicker(made[:1], truth[:1], frames[:1])
    )


# ---- end to end ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("shift")
    config = BenchConfig(logs=1, iterations=30, processes=1, methods=("nearest_fill", "street_gaussians"))
    return shift.run(config, out, rules=TINY, distances_m=(3.0,)), config


@pytest.mark.slow
def test_the_command_compares_methods_and_reuses_what_is_there(made):
    out, config = made
    document = store.read_json(out / "bench.json")
    log = str(city_logs.DEVELOPMENT[0])
    for method in ("nearest_fill", "street_gaussians"):
        values = document["logs"][0]["values"][method]
        assert set(values) == {"0", "3", "shifted"}
        numbers = {m for m in document["metrics"] if isinstance(values["3"][m], float)}
        assert {"psnr", "ssim", "perceptual", "abs_rel", "miou", "flicker"} <= numbers
    better = {m: document["pooled"][m]["0"]["psnr"]["mean"] for m in ("nearest_fill", "street_gaussians")}
    assert better["street_gaussians"] > better["nearest_fill"]
    assert (out / log / "film" / "front_shift+3.0.jpg").is_file()
    before = (out / log / "fit" / "street_gaussians" / "run.json").stat().st_mtime_ns
    changes = {"methods": ("street_gaussians",), "videos": False}
    again = shift.run(dataclasses.replace(config, **changes), out, rules=TINY, distances_m=(3.0,))
    assert (out / log / "fit" / "street_gaussians" / "run.json").stat().st_mtime_ns == before
    assert [m["name"] for m in store.read_json(again / "bench.json")["methods"]] == ["street_gaussians"]
    other = dataclasses.replace(config, iterations=31)
    refused("another configuration", bench.run, "shift", other, out, raises=UsageError)


@pytest.mark.slow
def test_fits_under_virtual_views_begin_from_nothing_and_their_control_goes_on(made, tmp_path):
    out, config = made
    log = out / str(city_logs.DEVELOPMENT[0])
    changes = {"methods": ("mudg_s", "mudg_f", LONGER), "model": str(saved_mdm(tmp_path / "model")), "videos": False}
    shift.run(dataclasses.replace(config, **changes), out, rules=TINY, distances_m=(3.0,), overwrite=True)
    states = {name: store.read_json(log / "fit" / name / "run.json") for name in ("mudg_s", LONGER)}
    first = store.digest(log / "fit" / "street_gaussians")
    starts = {name: state["inputs"].get("start") for name, state in states.items()}
    assert starts == {"mudg_s": None, LONGER: first}
    steps = {name: state["summary"]["steps"] for name, state in states.items()}
    assert steps == {"mudg_s": 45, LONGER: 15}
    assert "fitted" not in store.read_json(log / "synthesize" / "run.json")["inputs"]
    repaired = store.read_json(log / "render" / "mudg_f" / "run.json")["inputs"]  # of the same fit
    assert repaired["model"] == store.digest(log / "fit" / "mudg_s") and not (log / "fit" / "mudg_f").exists()
    pooled = store.read_json(out / "bench.json")["pooled"]
    assert pooled["mudg_f"]["3"]["psnr"]["mean"] != pooled["mudg_s"]["3"]["psnr"]["mean"]


@pytest.mark.slow
def test_stored_truth_is_the_drawn_truth(made):
    out, _ = made
    log = out / str(city_logs.DEVELOPMENT[0])
    assert set(list_observation_sets(log / "truth")) == {"front_recorded", "front_shift+3.0", "front_shift-3.0"}
    stored = score_truth.stored_truth(log / "truth")
    world = CityWorld(city_logs.log_config(city_logs.DEVELOPMENT[0], TINY))
    view = read_observations(log / "truth" / "front_shift+3.0").views[2]
    found, drawn = stored.at_view(view, None, "front_shift+3.0"), world.render(view)
    assert np.array_equal(found.seen.semantics.numpy(), drawn.semantics)
    assert float((found.seen.rgb.permute(1, 2, 0).numpy() - drawn.rgb).__abs__().max()) <= 0.5 / 255 + 1e-6
    assert np.array_equal(found.moving[0].numpy(), np.isin(drawn.instance, city_logs.moving_instances(world)))
    later = dataclasses.replace(view, time_s=view.time_s + 0.05)
    refused("another view", stored.at_view, later, None, "front_shift+3.0")
    refused("lacks a trajectory", stored.at_view, view, None, "front_shift+9.0")
