"""``mudg bench real``: what is hidden stays unused, measures with known answers, and the command end to end on a tiny
log."""

import dataclasses

import numpy as np
import pytest
import torch
import write_custom
from bench_logs import city_scene, fused
from refusals import refused
from tiny_networks import saved_mdm

from mudg.base import store
from mudg.base.errors import UsageError
from mudg.base.types import Camera, Observation, SweepPoints, View
from mudg.benchmarks import columns, places, real
from mudg.benchmarks.chain import FillViews
from mudg.benchmarks.places import PROTOCOLS, SPLITS
from mudg.benchmarks.rows import method_rows
from mudg.benchmarks.settings import BenchConfig
from mudg.city.world import CityWorld
from mudg.core import calibration, lidar
from mudg.core.fusion import STATIC
from mudg.diffusion.settings import SynthesizeConfig
from mudg.editing import render
from mudg.editing.settings import RenderConfig
from mudg.gaussians.settings import FitConfig
from mudg.scene.labels import read_label
from mudg.scene.observations import ObservationWriter
from mudg.scene.read import read_image, read_points, read_scene
from mudg.scene.write import SceneWriter, write_part

BY_NAME = {protocol.name: protocol for protocol in PROTOCOLS}


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    size = {"n_frames": 6, "width": 96, "height": 64, "lidar_azimuth_step_deg": 0.6}
    return city_scene(tmp_path_factory.mktemp("log") / "city", **size, cameras=("front", "front_left"))


@pytest.fixture(scope="module")
def scene(city):
    return read_scene(city)


def job_of(out, source, split, config, rows=()):
    """A log under a way of hiding."""
    return real.SplitJob(out, source, split, (), rows, config, False)


# ---- what is hidden ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("moments", "length", "blocks"), [(24, 1, 5), (24, 3, 3), (24, 5, 2), (16, 5, 1), (3, 1, 1), (4, 3, 0)]
)
def test_blocks_are_spread_and_leave_both_ends(moments, length, blocks):
    found = places.blocks_of(moments, length)
    assert all(len(block) == length for block in found) and len(found) == blocks
    hidden = {moment for block in found for moment in block}
    assert len(hidden) == length * len(found) and not hidden & {0, moments - 1}
    between = np.diff([-1, *sorted(hidden), moments]) - 1
    runs = between[between > 0]
    assert len(found) == 0 or (len(runs) == len(found) + 1 and runs.max() - runs.min() <= 1)


def test_a_block_hides_all_cameras_and_the_sweeps_of_its_moments(scene):
    held = places.held_out(scene, SPLITS["gap-3"], ())
    first, last = dict(held.facts)["blocks"][0]
    times = [frame.view.time_s for frame in scene.frames_of("front")]
    expected = {f.id for f in scene.frames if times[first] - 0.02 <= f.view.time_s <= times[last] + 0.02}
    assert set(held.frames) == expected and len(expected) == 6
    assert {s.id for s in scene.sweeps} - set(held.sweeps)
    assert all(times[first] - 0.05 <= s.time_s <= times[last] + 0.05 for s in scene.sweeps if s.id in held.sweeps)


def test_a_log_that_is_too_short_is_left_out_with_the_reason(scene):
    short = dataclasses.replace(scene, frames=scene.frames[:8])
    assert "too few" in places.held_out(short, SPLITS["gap-3"], ()).reason
    one = dataclasses.replace(scene, cameras={"front": scene.cameras["front"]}, frames=scene.frames_of("front"))
    assert "no camera besides" in places.held_out(one, SPLITS["camera"], ()).reason


def copied(scene, out, frames=(), sweeps=(), classes=False):
    """A copy of a scene in which some frames (with their labels) and sweeps are noise; ``classes``: points have
    some."""
    rng = np.random.default_rng(0)
    with SceneWriter(out, scene.id, scene.source) as writer:
        writer.copy_all_but_frames(dataclasses.replace(scene, sweeps=(), split={}))
        for sweep in scene.sweeps:
            points = read_points(scene, sweep)
            if sweep.id in sweeps:
                xyz = rng.uniform(-30, 30, points.xyz.shape).astype(np.float32)
                points = SweepPoints(xyz, points.intensity, points.dt_s)
            if classes:
                points = dataclasses.replace(points, classes=np.arange(len(points.xyz), dtype=np.uint8) % 19)
            writer.add_sweep(sweep.id, sweep.sensor, sweep.time_s, sweep.world_from_lidar, points)
        for frame in scene.frames:
            if frame.id not in frames:
                writer.copy_frame(scene, frame)
                continue
            shape = (frame.view.camera.height, frame.view.camera.width)
            labels = {name: read_label(scene, frame, name) for name in frame.labels}
            labels |= {"depth": rng.uniform(1, 50, shape), "semantics": rng.integers(0, 19, shape).astype(np.uint8)}
            writer.add_frame(frame.id, frame.view, rng.integers(0, 256, (*shape, 3)).astype(np.uint8), labels)
        return writer.finish()


def test_a_part_holds_nothing_of_what_is_hidden_nor_classes_of_points(scene, tmp_path):
    held = places.held_out(scene, SPLITS["gap-3"], ())
    shown = {f.id for f in scene.frames} - set(held.frames)
    classed = copied(scene, tmp_path / "classed", classes=True)
    assert read_points(classed, classed.sweeps[0]).classes is not None
    kept = [s for s in scene.sweeps if s.id not in held.sweeps]
    part = write_part(classed, tmp_path / "part", shown, {s.id for s in kept}, held.places(scene))
    assert part.source.recipe is None and [s.id for s in part.sweeps] == [s.id for s in kept] != []
    for sweep, original in zip(part.sweeps, kept, strict=True):
        points = read_points(part, sweep)
        assert points.classes is None and np.array_equal(points.xyz, read_points(scene, original).xyz)
    originals = {frame.id: frame for frame in scene.frames}
    assert {frame.id for frame in part.frames_in("test")} == set(held.frames)
    assert {frame.id for frame in part.frames_in("train")} == shown
    for frame in part.frames_in("test"):
        assert not read_image(part, frame).any() and not frame.labels
    for frame in part.frames_in("train"):
        assert np.array_equal(read_image(part, frame), read_image(scene, originals[frame.id]))
        assert set(frame.labels) == set(originals[frame.id].labels)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A small model that uses renders."""
    return str(saved_mdm(tmp_path_factory.mktemp("model") / "model"))


def made_from(source, out, split, model):
    """Everything that methods make of a log under a split, by name, as bytes."""
    settings = {"fit": FitConfig(densify={"kind": "none"}), "synthesize": SynthesizeConfig(steps=1, shifts_m=(2.0,))}
    config = BenchConfig(model=model, iterations=6, methods=("nearest_fill", "mudg_s", "mudg_f"), **settings)
    job = job_of(out, source, split, config, method_rows(config))
    whole = read_scene(source)
    held = places.held_out(whole, split, ())
    job.write_seen(whole, held)
    chain, cameras = job.chain(), job.cameras(whole, held)
    chain.fuse()
    for row in job.rows:
        job.views(row, chain, cameras)
    kept = ("gaussians.safetensors", "nodes.safetensors", "static.safetensors")
    return {
        path.relative_to(out).as_posix(): path.read_bytes()
        for path in sorted(out.rglob("*"))
        if path.name in kept or path.suffix == ".png" or path.parent.name in ("data", "model")
    }


@pytest.mark.slow
@pytest.mark.parametrize("split", ["gap-3", "camera"])
def test_held_out_content_changes_no_fit_no_cloud_no_model_and_no_view(scene, city, model, tmp_path, split):
    split = SPLITS[split]
    plain, held = made_from(city, tmp_path / "plain", split, model), places.held_out(scene, split, ())
    copied(scene, tmp_path / "noise", held.frames, held.sweeps)
    assert any("fit/mudg_s" in name for name in plain) and any("virtual/" in name for name in plain)
    assert any("fuse/static" in name for name in plain)
    assert all(any(f"render/{name}/" in path for path in plain) for name in ("mudg_s", "mudg_f"))
    again = made_from(tmp_path / "noise", tmp_path / "out", split, model)
    assert [name for name in plain if again[name] != plain[name]] == [] and set(again) == set(plain)
    copied(scene, tmp_path / "seen", {"front/000000"})  # what is shown does count
    fitted = f"{split.name}/fit/mudg_s/gaussians.safetensors"
    assert made_from(tmp_path / "seen", tmp_path / "other", split, model)[fitted] != plain[fitted]


# ---- measures with known answers -----------------------------------------------------------------

CAMERA = Camera("front", 40, 30, 30.0, 30.0, 20.0, 15.0)
VIEW = View(CAMERA, np.eye(4), 0.0)


def test_a_point_is_seen_if_it_is_not_behind_the_surface():
    shown = [lidar.ShownFrame(VIEW, np.full((30, 40), 10.0, np.float32), np.full((30, 40, 3), 77, np.uint8))]
    xyz = np.array([[0, 0, 9.9], [0, 0, 10.5], [0, 0, 14.0], [100, 0, 5.0], [0, 0, -5.0]], np.float32)
    points = lidar.OwnedPoints(xyz, np.full(5, STATIC, np.int32), np.zeros(5, np.uint8), 0.4)
    place = lambda points, _: points.xyz
    seen, colors = lidar.seen_by(place, points, shown, 0.0)
    assert seen.tolist() == [True, True, False, False, False]
    assert colors[0].tolist() == [77, 77, 77] and not colors[2].any()


def test_the_mask_takes_the_answer_of_the_nearest_point_nearby():
    mask = lidar.spread(np.array([True, False]), np.array([5, 5]), np.array([10, 20]), (11, 100))
    assert mask[5, 8:14].all() and not mask[5, 16:24].any()
    assert not mask[5, 40:].any()  # no point is near


def test_a_color_map_is_found_under_noise_and_outliers():
    rng = np.random.default_rng(0)
    true = rng.uniform(0.1, 0.8, (20_000, 3))
    given = true + rng.normal(0, 0.04, true.shape)
    wanted = true * [0.8, 1.0, 1.1] + [0.1, 0.0, -0.05] + rng.normal(0, 0.04, true.shape)
    wanted[:2000] = rng.uniform(0.1, 0.9, (2000, 3))
    found = calibration.color_map(*((np.clip(c, 0, 1) * 255).round().astype(np.uint8) for c in (given, wanted)))
    assert found.gain == pytest.approx((0.8, 1.0, 1.1), abs=0.03)
    assert found.offset == pytest.approx((0.1, 0.0, -0.05), abs=0.02)
    loose = [rng.uniform(90, 110, (1000, 3)).astype(np.uint8) for _ in range(2)]
    loosely = calibration.color_map(loose[0], (loose[1] * 1.5).astype(np.uint8))
    assert loosely.gain == pytest.approx((1.5, 1.5, 1.5), abs=0.03) and loosely.offset == (0, 0, 0)
    few = calibration.color_map(np.full((10, 3), 50, np.uint8), np.full((10, 3), 90, np.uint8))
    assert (few.gain, few.pairs) == ((1.0, 1.0, 1.0), 10)


def sight(maps, *, depth=None, rgb=None, photo=None):
    rgb = torch.full((3, 30, 40), 0.5) if rgb is None else rgb
    return columns.Sight(maps, rgb, depth, photo, None)


def test_columns_by_hand():
    depth, dynamic = np.zeros((30, 40), np.float32), np.zeros((30, 40), np.uint8)
    depth[3, 4], depth[6, 7], dynamic[6, 7] = 10.0, 20.0, 1
    color = np.full((30, 40, 3), 102, np.uint8)  # 0.4
    maps = {"depth": depth, "dynamic": dynamic, "color": color, "colored": (depth > 0).astype(np.uint8)}
    seen = sight(maps, depth=torch.full((1, 30, 40), 12.0))
    value = lambda name: columns.COLUMNS[name].close(columns.COLUMNS[name].of(seen))
    assert value("abs_rel") == pytest.approx((0.2 + 0.4) / 2)
    assert (value("abs_rel_static"), value("abs_rel_dynamic")) == (pytest.approx(0.2), pytest.approx(0.4))
    assert (value("rmse_static"), value("rmse_dynamic")) == (pytest.approx(2.0), pytest.approx(8.0))
    assert (value("delta1_static"), value("delta1_dynamic")) == (1.0, 0.0)
    assert (value("point_abs_static"), value("point_psnr_static")) == (pytest.approx(0.1), pytest.approx(20.0))
    photo = torch.full((3, 30, 40), 0.5)
    photo[:, :10] = 0.6
    upper = sight({}, photo=photo)
    assert columns.COLUMNS["psnr_upper"].of(upper)[0] == pytest.approx(20.0, abs=1e-4)
    assert columns.COLUMNS["psnr_dynamic"].of(upper) is None
    assert columns.COLUMNS["psnr"].compared_text(20.5, 20.0) == "+0.50"
    assert columns.COLUMNS["perceptual"].compared_text(0.09, 0.1) == "x0.900"


def test_a_protocol_that_pools_weighs_cameras_by_what_was_seen_of_them():
    """Of one camera 30 pixels were seen, 0.1 off, of the other 10 pixels, 0.2 off; what was not seen is far off and
    does not count."""
    sums = {}
    for place, seen_px, off in (("left", 30, 0.1), ("back", 10, 0.2)):
        seen, depth = np.zeros((30, 40), np.uint8), np.full((30, 40), 10.0, np.float32)
        seen[0, :seen_px] = 1
        photo = torch.zeros((3, 30, 40))
        photo[:, 0, :seen_px] = 0.5 + off
        made = torch.full((1, 30, 40), 80.0)
        made[:, 0, :seen_px] = 10 * (1 + off)
        view = sight({"seen": seen, "depth": depth}, depth=made, photo=photo)
        view = dataclasses.replace(view, distance=lambda pair, d=off: d)
        sums[place] = {name: columns.COLUMNS[name].of(view) for name in BY_NAME["camera"].columns}
    found = columns.values_of(BY_NAME["camera"], sums)
    psnr = [found["places"][place]["psnr_seen"] for place in sums]
    assert psnr == pytest.approx([20.0, -20 * np.log10(0.2)], abs=1e-4)
    mean, off = found["mean"], (30 * 0.1 + 10 * 0.2) / 40
    assert mean["psnr_seen"] == pytest.approx(-10 * np.log10((30 * 0.01 + 10 * 0.04) / 40), abs=1e-4)
    assert mean["rmse_seen"] == pytest.approx(np.sqrt((30 * 1 + 10 * 4) / 40), abs=1e-4)
    assert (mean["abs_rel_seen"], mean["perceptual_seen"], mean["delta1_seen"]) == pytest.approx(
        (off, off, 1), abs=1e-5
    )
    averaged = columns.values_of(dataclasses.replace(BY_NAME["camera"], pooled=False), sums)["mean"]
    assert averaged["abs_rel_seen"] == pytest.approx(0.15, abs=1e-5)


# ---- the truth, scored as if it were a method ----------------------------------------------------


@pytest.fixture(scope="module")
def exact(city, scene, tmp_path_factory):
    """A function that scores the exact views of the city under a protocol."""

    def of(name):
        out, protocol = tmp_path_factory.mktemp(name), BY_NAME[name]
        split, world = SPLITS[protocol.split], CityWorld.from_source(scene.source)
        held, job = places.held_out(scene, split, ()), job_of(out, city, split, BenchConfig())
        job.write_seen(scene, held)
        cameras, seen = job.cameras(scene, held), job.folder / "scene"
        for path in render.trajectories(scene, RenderConfig(cameras=cameras, shifts_m=split.shifts_m)):
            with ObservationWriter(out / "views" / path.name, path.name, "truth") as writer:
                for view in path.views:
                    writer.add(world.observation(view, world.render(view)))
        of, held = {"log": city, "protocol": protocol}, tuple(held.frames)
        targets = columns.MakeTargets(**of, shown=seen, held=held, cameras=cameras, out=out / "truth").run()
        scored = columns.ScoreTargets(**of, truth=targets, views=out / "views", out=out / "score").run()
        return store.read_json(scored / "metrics.json")["mean"], columns.read_targets(targets)

    return of


def test_exact_views_are_right_on_held_out_frames(exact):
    found, targets = exact("gap-3")
    assert found["psnr"] > 45 and found["ssim"] > 0.99 and found["perceptual"] < 0.01
    # points lie beside pixel centres
    assert found["psnr_dynamic"] > 45 and found["psnr_upper"] > 45 and found["abs_rel"] < 0.06
    assert targets.facts["views"] == {"front": 3, "front_left": 3}


@pytest.mark.slow
def test_exact_views_are_right_for_a_camera_that_was_never_shown(exact):
    found, targets = exact("camera")
    assert list(targets.facts["views"]) == ["front_left"] and targets.facts["views"]["front_left"] == 3
    assert 0.05 < targets.facts["seen_share"]["front_left"] < 0.9
    assert targets.facts["weight"] == {"front_left": 1.0}
    # a colour map near the identity, fitted to noisy pairs
    assert found["psnr_seen"] > 25 and found["abs_rel_seen"] < 0.03
    assert targets.color_maps["front_left"].gain == pytest.approx((1, 1, 1), abs=0.12)


@pytest.mark.slow
def test_exact_views_are_right_beside_the_recorded_path(exact):
    found, targets = exact("lidar")
    assert targets.facts["views"] == {"2 m": 12, "3 m": 12}
    assert found["abs_rel_static"] < 0.05 and found["delta1_static"] > 0.97
    assert found["point_psnr_static"] > 20 and found["point_abs_static"] < 0.06


# ---- the command ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(city, tmp_path_factory):
    out = tmp_path_factory.mktemp("real")
    config = BenchConfig(methods=("nearest_fill", "street_gaussians"), iterations=10, processes=1)
    return real.run(config, [city], out), config


@pytest.mark.slow
def test_the_command_compares_methods_under_every_protocol(made, city):
    out, _ = made
    document = store.read_json(out / "bench.json")
    assert list(document["protocols"]) == ["gap-1", "gap-3", "gap-5", "camera", "lidar"]
    for name in ("gap-1", "gap-3", "camera", "lidar"):
        found = document["protocols"][name]
        assert set(found["logs"]["city"]["values"]) == {"nearest_fill", "street_gaussians"}
        assert found["against"]["nearest_fill"] and set(found["against"]) == {"nearest_fill"}
    gap = document["protocols"]["gap-1"]
    mean = gap["logs"]["city"]["values"]["nearest_fill"]["mean"]["psnr"]
    difference = mean - gap["pooled"]["street_gaussians"]["psnr"]
    assert gap["against"]["nearest_fill"]["psnr"] == pytest.approx(difference, abs=1e-5)
    assert "too few" in document["protocols"]["gap-5"]["left_out"]["city"]
    assert document["logs"][0]["digest"] == store.digest(city)
    text = (out / "bench.md").read_text()
    assert "city is left out: its 6 frames are too few" in text and "## gap-3" in text


@pytest.mark.slow
def test_finished_work_is_reused_and_a_method_can_be_added(made, city, model):
    out, config = made
    split = out / "city" / "gap-1"
    watched = [split / "fit" / "street_gaussians" / "run.json", out / "city" / "truth" / "lidar" / "run.json"]
    before = [path.stat().st_mtime_ns for path in watched]
    added = ("street_gaussians", "street_gaussians-longer", "mudg_s", "mudg_r", "mudg_f")
    settings = SynthesizeConfig(shifts_m=(2.0,))
    changes = {"methods": added, "protocols": ("gap-1",), "model": model, "synthesize": settings}
    real.run(dataclasses.replace(config, **changes), [city], out)
    assert [path.stat().st_mtime_ns for path in watched] == before
    document = store.read_json(out / "bench.json")
    assert [row["name"] for row in document["methods"]] == [*added[:2], "mudg_r", "mudg_s", "mudg_f"]
    assert isinstance(document["protocols"]["gap-1"]["against"]["mudg_s"]["psnr"], float)
    start = store.digest(split / "fit" / "street_gaussians")
    both = ("mudg_s", "street_gaussians-longer")
    guided, longer = (store.read_json(split / "fit" / name / "run.json") for name in both)
    assert [state["inputs"].get("start") for state in (guided, longer)] == [None, start]
    assert [s["summary"]["steps"] for s in (guided, longer)] == [config.iterations * 3 // 2, config.iterations // 2]
    assert not [name for name in longer["inputs"] if "virtual" in name or "observations" in name]
    assert "fitted" not in store.read_json(split / "virtual" / "run.json")["inputs"]


def test_a_dataset_log_is_imported_with_the_settings_of_the_command(city, tmp_path):
    log = write_custom.write_log(read_scene(city), tmp_path / "drive")
    config = BenchConfig(methods=("nearest_fill",), protocols=("gap-1",), frames="0:3", resolution="48", processes=1)
    out = real.run(config, [log], tmp_path / "out")
    facts = store.read_json(out / "bench.json")["logs"][0]
    assert {(tuple(c["size_px"]), c["frames"]) for c in facts["cameras"].values()} == {((48, 32), 3)}
    assert not read_scene(out / "drive" / "scene").frames_in("test")
    assert (out / "drive" / "gap-1" / "annotate" / "scene.json").is_file()  # the log has no labels
    refused("another configuration", real.run, dataclasses.replace(config, frames="0:5"), [log], out, raises=UsageError)


def test_other_folders_methods_and_names_are_refused(city, tmp_path):
    for config, logs, what in (
        (BenchConfig(methods=("nerf",)), [city], "unknown method"),
        (BenchConfig(protocols=("shift",)), [city], "unknown protocol"),
        (BenchConfig(), [], "no log"),
        (BenchConfig(), [city, city], "same name"),
        (BenchConfig(frames="0:2"), [city], "taken as it is"),
    ):
        refused(what, real.run, config, logs, tmp_path / "out", raises=UsageError)
    store.write_json(tmp_path / "other" / "bench.json", {"schema": 1, "methods": []})
    refused("do not belong", real.run, BenchConfig(), [city], tmp_path / "other", raises=UsageError)


def test_pooled_values_leave_out_logs_without_a_number():
    protocol, logs = BY_NAME["gap-1"], []
    for name, a, b in (("one", 20.0, 21.0), ("two", 22.0, "none")):
        nothing = dict.fromkeys(protocol.columns, "none")
        values = {m: {"mean": {**nothing, "psnr": v}} for m, v in (("street_gaussians", a), ("mudg_s", b))}
        logs.append({"log": name, "protocols": {"gap-1": {"values": values, "facts": {}}}})
    rows = [{"name": "street_gaussians"}, {"name": "mudg_s"}]
    found = real.document(logs, rows, [protocol], {})["protocols"]["gap-1"]
    assert found["pooled"]["street_gaussians"]["psnr"] == 21.0 and found["pooled"]["mudg_s"]["psnr"] == 21.0
    assert found["pooled"]["mudg_s"]["ssim"] == "none" and found["against"]["mudg_s"]["ssim"] is None


def test_a_view_that_a_method_lacks_is_an_error(city, tmp_path):
    paths = render.trajectories(read_scene(city), RenderConfig(cameras=("front",), shifts_m=(0.0,)))
    fill = FillViews(scene=city, fused=fused(city, tmp_path / "fuse"), paths=paths, out=tmp_path / "views")
    finder = columns.ViewFinder(fill.run())
    assert isinstance(finder.at(paths[0].views[1]), Observation)
    refused("lacks a view", finder.at, dataclasses.replace(paths[0].views[1], time_s=9.0))
