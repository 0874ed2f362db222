"""``mudg bench shift``, ``real`` and ``paper`` under presets and with a published-type model: what runs is what was
asked for, and what is on record; settings that change nothing are refused."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from bench_logs import city_scene, fused
from test_score_metrics import lpips_state
from toy_published import write_tiny

from mudg.app import parse
from mudg.base import config as configuration
from mudg.base import store
from mudg.base.errors import UsageError
from mudg.benchmarks import run as bench
from mudg.benchmarks.rows import LONGER, RECORDED, TABLES, method_fit, method_rows
from mudg.benchmarks.settings import BenchConfig, bench_preset
from mudg.diffusion import model_files
from mudg.diffusion.condition import ConditionRules, DriveInputs
from mudg.diffusion.published_network import VideoUNet
from mudg.diffusion.settings import SynthesizeConfig
from mudg.diffusion.views import conditions_of, recorded_images
from mudg.gaussians.settings import FitConfig
from mudg.scene.clouds import read_fused
from mudg.scene.read import read_image, read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps.settings import run_preset

MODALITIES = 3


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Folder of a published-type toy model (windows of 4 frames), and a file of LPIPS weights."""
    folder = tmp_path_factory.mktemp("published")
    lpips = {name: value.numpy() for name, value in lpips_state().items()}
    store.write_safetensors(folder / "lpips.safetensors", lpips)
    return write_tiny(folder), folder / "lpips.safetensors"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A log of six frames of one camera."""
    return city_scene(tmp_path_factory.mktemp("logs") / "city", n_frames=6)


@pytest.fixture
def passes(monkeypatch):
    """Videos that went through the denoising network, one number per call."""
    seen = []
    forward = VideoUNet.forward
    monkeypatch.setattr(VideoUNet, "forward", lambda net, x, *rest: (seen.append(len(x)), forward(net, x, *rest))[1])
    return seen


def published_set_up(weights, flags):
    """What ``mudg bench`` makes of ``--preset paper`` with few steps, and windows that share two frames."""
    few = "--synthesize.steps 3 --synthesize.overlap 2 --iterations 6 --processes 1 --no-videos"
    words = f"bench paper --out unused --preset paper --model {weights[0]} {few} {flags}"
    return parse(words.split())[0].settings


def videos(trajectories, guided=True):
    """Videos through the network: windows of 4 that share 2 of 6 frames are two; with guidance each goes through
    twice."""
    return 3 * MODALITIES * (2 if guided else 1) * 2 * trajectories


# ---- settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["fast", "quality", "paper"])
def test_a_preset_of_a_benchmark_is_that_of_a_run(preset):
    mine, run = bench_preset(preset), run_preset(preset)
    assert (mine.model, mine.iterations) == (run.synthesize.model, run.fit.iterations)
    assert (mine.fuse, mine.guided_share) == (run.fuse, run.guided_share)
    usual = {name: getattr(mine.synthesize, name) for name in ("model", "cameras")}
    assert mine.synthesize == dataclasses.replace(run.synthesize, **usual)
    assert mine.fit == dataclasses.replace(run.fit, iterations=mine.fit.iterations)


def test_every_setting_has_its_benchmarks():
    assert set(bench.USED) == {field.name for field in dataclasses.fields(BenchConfig)}
    assert {user for users in bench.USED.values() for user in users} == set(bench.BENCHES)


REFUSED = [
    ("real", ["--table", "mudg3"], "--table", "leave it out"),
    ("shift", ["--frames", "0:4"], "--frames", "leave it out"),
    ("shift", ["--fit.iterations", "5"], "--fit.iterations", "--iterations"),
    ("shift", ["--synthesize.shifts-m", "1"], "--synthesize.shifts-m", "leave it out"),
    ("shift", ["--methods", "gs3d", "--synthesize.steps", "4"], "--synthesize.steps", "leave it out"),
    ("shift", ["--methods", "gs3d", "--fit.virtual.probability", "0.3"], "--fit.virtual.probability", "leave it out"),
    ("shift", ["--methods", "mudg_s", LONGER, "--guided-share", "1"], "--methods", "leave it out"),
    ("shift", ["--methods", "difix", "--model", "embedded-tiny"], "--methods", "leave difix out"),
    ("shift", ["--synthesize.guidance", "7.5"], "--model", ""),
    ("shift", ["--preset", "paper"], "--model", "convert a checkpoint"),
    ("shift", ["--synthesize.memory-budget-gb", "8"], "--memory-budget-gb", "leave it out"),
    ("shift", ["--methods", "pvg", "--fit.poses.learn"], "poses.learn", "leave the setting out"),
    ("paper", ["--table", "mudg2", "--iterations", "7"], "--iterations", "leave it out"),
]


@pytest.mark.parametrize(
    ("name", "words", "where", "remedy"), REFUSED, ids=[f"{name} {' '.join(words)}" for name, words, *_ in REFUSED]
)
def test_a_setting_that_would_change_nothing_is_refused_before_anything_is_written(
    tmp_path, name, words, where, remedy
):
    sources = ("city:development",) if name == "paper" else ()
    args, _ = parse(["bench", name, *sources, "--out", str(tmp_path / "out"), *words])
    with pytest.raises(UsageError) as caught:
        bench.run(name, args.settings, args.out, sources=args.sources, preset=args.preset)
    assert caught.value.where == where and remedy in (caught.value.remedy or "")
    assert not (tmp_path / "out").exists()


def test_a_method_for_comparison_keeps_what_the_preset_sets_and_it_does_not_know():
    config = dataclasses.replace(bench_preset("paper"), methods=("pvg", "mudg_s"))
    fits = {row.name: row.fit for row in method_rows(config, "paper")}
    assert (fits["mudg_s"].poses.learn, fits["pvg"].poses.learn) == (True, False)
    assert fits["pvg"].start == fits["mudg_s"].start and fits["pvg"].iterations == fits["mudg_s"].iterations == 30_000
    with pytest.raises(UsageError, match="knows nothing of it"):
        method_fit(FitConfig(poses={"learn": True}), "pvg", "default")


# ---- the published model through all three -------------------------------------------------------


@pytest.mark.slow
def test_table_2_runs_with_a_published_type_model_as_recorded(weights, tmp_path, passes):
    config = published_set_up(weights, "--table mudg2 --logs 1 --frames 0:6 --resolution 64x48")
    config = dataclasses.replace(config, iterations=bench_preset("paper").iterations)
    out = bench.run("paper", config, tmp_path / "out", sources=("city:development",), preset="paper")
    assert sum(passes) == videos(len(TABLES["mudg2"].rows))
    document = store.read_json(out / "bench.json")
    asked = document["settings"]["synthesize"]
    assert document["settings"]["preset"] == "paper"
    sampling = {"steps": 3, "overlap": 2, "eta": 1.0, "guidance": 7.5, "guidance_rescale": 0.7}
    assert asked.items() >= {**sampling, "align_depth": False, "full_size": False}.items()
    log = out / document["logs"][0]["log"]
    assert not (log / "fit").exists()
    for row in TABLES["mudg2"].rows:
        ran = configuration.load(SynthesizeConfig, yaml_path=log / "generated" / f"{row.name}-{RECORDED}" / "run.yaml")
        assert ran.condition == row.changes.get("condition", "full")
        wanted = {name: value for name, value in asked.items() if name != "device"}
        assert {name: getattr(ran, name) for name in wanted} == wanted
    psnr = [document["cells"][row.name][RECORDED]["psnr"]["mean"] for row in TABLES["mudg2"].rows]
    assert len({round(value, 6) for value in psnr}) == len(psnr)  # every condition gives other views


@pytest.mark.slow
def test_table_3_runs_with_a_published_type_model_as_recorded(weights, tmp_path, passes):
    size = "--table mudg3 --logs 1 --frames 0:6 --resolution 64x48 --synthesize.width-px 48"
    config = published_set_up(weights, f"{size} --fit.virtual.lpips-weights {weights[1]}")
    out = bench.run("paper", config, tmp_path / "out", sources=("city:development",), preset="paper")
    assert sum(passes) == videos(2)  # 2 m to both sides, once for all rows
    document = store.read_json(out / "bench.json")
    log = out / document["logs"][0]["log"]
    for row in TABLES["mudg3"].rows:
        state = store.read_json(log / "fit" / row.name / "run.json")
        assert state["summary"]["steps"] == 6 and "start" not in state["inputs"]  # from nothing, with all steps
        ran = configuration.load(FitConfig, yaml_path=log / "fit" / row.name / "run.yaml")
        assert (ran.loss.semantic_weight, ran.sh_degree) == (0.0, 3)
        assert (ran.virtual.beside, ran.virtual.perception) == (False, "lpips")
        assert math.isfinite(document["cells"][row.name][RECORDED]["psnr"]["mean"])
    settings = document["settings"]
    loss, virtual, iterations = (settings["fit"][name] for name in ("loss", "virtual", "iterations"))
    assert (loss["object_weight"], virtual["probability"], iterations) == (0.1, 0.2, 6)
    assert (settings["fuse"]["box_growth_m"], settings["guided_share"]) == (0.0, 1.0)
    fused = configuration.load(FuseConfig, yaml_path=log / "fuse" / "run.yaml")
    assert (fused.box_growth_m, fused.occlusion_test) == (0.0, False)


@pytest.mark.slow
def test_real_runs_with_a_published_type_model_as_recorded(weights, scene, tmp_path, passes):
    flags = "--synthesize.shifts-m 2 --synthesize.guidance 1 --fit.virtual.perception filters"
    config = published_set_up(weights, flags)
    config = dataclasses.replace(config, videos=True, methods=("mudg_r", "mudg_s"), protocols=("lidar",))
    out = bench.run("real", config, tmp_path / "out", sources=(scene,), preset="paper")
    # the scored places (2 and 3 m to both sides), and the views that the fit learns from
    generated = 4 + 1
    assert sum(passes) == videos(generated, guided=False)
    document = store.read_json(out / "bench.json")
    assert document["settings"]["virtual_shifts_m"] == [2.0] and document["settings"]["synthesize"]["guidance"] == 1.0
    assert isinstance(document["protocols"]["lidar"]["pooled"]["mudg_s"]["abs_rel_static"], float)
    state = store.read_json(out / "city" / "all" / "fit" / "mudg_s" / "run.json")
    assert state["summary"]["steps"] == 6 and "start" not in state["inputs"]


# ---- parts of a published-type model's condition -------------------------------------------------


@pytest.fixture(scope="module")
def sources(scene, tmp_path_factory):
    """What conditions are made of, and the same with other points and with other recorded images."""
    loaded = read_scene(scene)
    cloud = read_fused(fused(scene, tmp_path_factory.mktemp("cloud") / "fuse"))
    photos = recorded_images(loaded, SynthesizeConfig())
    given = DriveInputs(cloud, loaded.tracks, photos)
    dark = dataclasses.replace(cloud.static, rgb=255 - np.asarray(cloud.static.rgb), xyz=cloud.static.xyz * 1.1)
    other_points = dataclasses.replace(given, cloud=dataclasses.replace(cloud, static=dark))
    negatives = [dataclasses.replace(photo, rgb=255 - photo.rgb) for photo in photos]
    other_images = dataclasses.replace(given, recorded=negatives)
    assert read_image(loaded, loaded.frames[0]).shape == (48, 64, 3)
    return [frame.view for frame in loaded.frames[:4]], given, other_points, other_images


@pytest.mark.parametrize(
    ("parts", "points", "tokens", "frame"),
    [
        *(("full", True, True, True), ("reference", False, True, True)),
        *(("points", True, False, False), ("concat", True, False, True)),
    ],
)
def test_a_part_that_is_switched_off_does_not_reach_a_published_type_network(
    weights, sources, parts, points, tokens, frame
):
    model = model_files.load_published(weights[0])
    views, *all_sources = sources

    def latents(given):
        condition = conditions_of(given, parts, views, ConditionRules(32, 32, 64, 48, published=True), {})[0]
        return model.encode_condition(condition, torch.Generator().manual_seed(0))

    usual, other_points, other_images = map(latents, all_sources)
    assert torch.equal(usual.planes[:, 1:], other_points.planes[:, 1:]) != points
    assert torch.equal(usual.planes[:, 1:], other_images.planes[:, 1:])
    assert torch.equal(usual.planes[:, 0], other_images.planes[:, 0]) != frame
    assert torch.equal(usual.features, other_images.features) != tokens
    assert torch.equal(usual.features, usual.grey) != tokens
    assert torch.equal(usual.features, other_points.features)
