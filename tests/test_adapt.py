"""Adapting the diffusion model to a log: lessons, clips, the choice at the end; what is held out stays unread."""

from __future__ import annotations

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from faults import contents
from fit_settings import fit_config
from pretend_device import pretend_device

from mudg.base import palette, store
from mudg.base.errors import InputError, UsageError
from mudg.city.config import CityConfig
from mudg.city.world import CityWorld
from mudg.diffusion import adapt, clips, model_files
from mudg.diffusion.city_clips import HELD_OUT
from mudg.diffusion.models import extended
from mudg.diffusion.settings import AdaptConfig
from mudg.formats import ingest
from mudg.formats.settings import IngestConfig
from mudg.gaussians.storage import load_model
from mudg.scene.read import read_image, read_scene
from mudg.scene.settings import FuseConfig
from mudg.steps.fit import Fit
from mudg.steps.ingest import Fuse, Ingest
from mudg.steps.synthesize import Adapt, fit_scene


def drive(root, city, test_every, **fitting):
    """A small drive, its cloud, a fit to it, and a tiny model that uses renders."""
    ingesting = IngestConfig(city=city, test_every=test_every, contact_sheet=False)
    Ingest(log=ingest.CITY, out=root / "scene", settings=ingesting).run()
    Fuse(scene=root / "scene", out=root / "fuse", settings=FuseConfig()).run()
    few = fit_config(method="street_gaussians", **fitting)
    Fit(scene=root / "scene", fused=root / "fuse", out=root / "fit", settings=few).run()
    before, area = model_files.load("embedded-tiny"), city.width * city.height
    grown = replace(before.config, renders=True, finish_widths=(8, 16), finish_blocks=(1, 1), area_px=area)
    model_files.save(extended(before, grown), root / "tiny", "", {})
    return root


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    city = CityConfig(seed=5, n_frames=13, width=96, height=64, cameras=("front",), lidar_azimuth_step_deg=0.6)
    return drive(tmp_path_factory.mktemp("adapt"), city, 6, iterations=30, start__gaussians=8000)


def settings(log, **changes):
    plain = AdaptConfig(
        model=str(log / "tiny"),
        shifts_m=(1.0,),
        block=2,
        held_out_every=3,
        fit_iterations=8,
        steps=3,
        batch_frames=4,
        lr=1e-3,
        precision="float32",
        processes=1,
    )
    return replace(plain, **changes)


def adapted(log, out, **changes):
    return Adapt(
        scene=log / "scene", fused=log / "fuse", fitted=log / "fit", out=out, settings=settings(log, **changes)
    ).run()


def weights_of(model):
    """Digest of a model's weights."""
    return [store.sha256_file(path) for path in sorted(model.glob("*.safetensors"))]


@pytest.fixture(scope="module")
def result(log, tmp_path_factory):
    out = tmp_path_factory.mktemp("adapted") / "out"
    adapted(log, out)
    return out


# lessons ------------------------------------------------------------------------------------------


def test_lessons_show_some_frames_and_ask_for_others(log):
    scene = read_scene(log / "scene")
    held_out = {f.id for f in scene.frames_in("test")}
    found = {lesson.name: lesson for lesson in adapt.lessons_of(scene, settings(log))}
    assert set(found) == {"shift+1", "gap0", "gap1"}
    for lesson in found.values():
        asked = {name for _, ids in lesson.truth for name in ids}
        assert not held_out & (set(lesson.shown) | asked)
        assert not lesson.shift_m or set(lesson.shown) >= asked
        if not lesson.shift_m:
            assert not set(lesson.shown) & asked
    gaps = [{name for _, ids in found[n].truth for name in ids} for n in ("gap0", "gap1")]
    assert not gaps[0] & gaps[1] and gaps[0] | gaps[1] == set(found["shift+1"].shown)


def test_a_block_is_learned_or_scored_never_both(log):
    scene, config = read_scene(log / "scene"), settings(log)
    plan = adapt.plan_clips(adapt.lessons_of(scene, config), config)
    learned = {name for number, _, ids in plan if number < HELD_OUT for name in ids}
    scored = {name for number, _, ids in plan if number >= HELD_OUT for name in ids}
    assert learned and scored and not learned & scored
    assert sorted(n for n, _, _ in plan if n < HELD_OUT) == list(range(sum(n < HELD_OUT for n, _, _ in plan)))


def test_a_photograph_carried_nowhere_is_itself(log):
    scene = read_scene(log / "scene")
    frame = scene.frames[3]
    photo = adapt.Photo(frame.view, read_image(scene, frame), None)
    carried = adapt.carried(photo, frame.view, load_model(log / "fit"), 10_000)
    assert np.abs(carried.rgb.astype(int) - photo.rgb).mean() < 1.0
    assert np.array_equal(carried.view.world_from_cam, photo.view.world_from_cam)


def test_a_photograph_carried_aside_is_nearer_to_the_truth_there(log):
    scene = read_scene(log / "scene")
    frame = scene.frames[3]
    target = adapt.moved_view(scene, frame.view, 1.0)
    photo = adapt.Photo(frame.view, read_image(scene, frame), None)
    carried = adapt.carried(photo, target, load_model(log / "fit"), 10_000)
    truth = CityWorld.from_source(scene.source).render(target).rgb * 255
    assert np.abs(carried.rgb - truth).mean() < 0.8 * np.abs(photo.rgb - truth).mean()


# clips --------------------------------------------------------------------------------------------


def test_truth_is_photographs_measured_depth_and_the_models_own_guesses(log, tmp_path):
    config = settings(log)
    planned = adapt.PlannedAdaptation.of(config, log / "scene", log / "fuse", log / "fit")
    model, learnt, lesson = planned.model, planned.learnt, planned.lessons[0]
    folder = adapt.fit_lesson(config, learnt, lesson, tmp_path / lesson.name, fit_scene)
    clip = adapt.ClipMaker(config, learnt, lesson, model, folder).make(lesson.truth[0][1], 0)
    scene = read_scene(log / "scene")
    photo = read_image(scene, next(f for f in scene.frames if f.id == lesson.truth[0][1][0]))
    small = torch.from_numpy(adapt.resize_area(photo, learnt.width_px, learnt.height_px)).permute(2, 0, 1) / 255
    assert torch.allclose(clip.rgb[0], small.float())
    measured, known = adapt.measured_depth(scene, clip.condition.views[0])
    assert known.any() and np.array_equal(clip.depth[0, 0].numpy()[known], measured[known])
    assert clip.condition.renders is not None and clip.fine is not None
    assert int(clip.semantics.max()) < palette.UNLABELLED  # classes are the model's own everywhere


# the verb -----------------------------------------------------------------------------------------


def test_the_model_is_ready_and_the_record_says_what_was_gained(log, result):
    record = store.read_json(result / "adapt.json")
    model = model_files.load(result / "model")
    before = model_files.load(log / "tiny")
    assert model.config == before.config
    gain = record["after"]["psnr"] - record["before"]["psnr"]
    assert record["adapted"] == (gain >= adapt.LEAST_GAIN_DB)
    same = all(
        torch.equal(a, b) for a, b in zip(model.state_dict().values(), before.state_dict().values(), strict=True)
    )
    assert same != record["adapted"]
    assert not (result / "work").exists() and (result / "before.png").is_file() and (result / "after.png").is_file()


@pytest.mark.slow
def test_adapting_on_a_device_is_adapting(log, result, tmp_path):
    with pretend_device():
        adapted(log, tmp_path / "out", device="pretend")
    here, there = (store.read_json(folder / "adapt.json") for folder in (result, tmp_path / "out"))
    assert here["adapted"] == there["adapted"] and here["clips"] == there["clips"]
    for name in ("before", "after"):
        assert there[name]["psnr"] == pytest.approx(here[name]["psnr"], abs=0.02)


@pytest.mark.slow
def test_a_model_that_gains_nothing_is_not_taken(log, tmp_path):
    adapted(log, tmp_path / "out", lr=1e-12, steps=1)
    record = store.read_json(tmp_path / "out" / "adapt.json")
    assert not record["adapted"]
    assert weights_of(tmp_path / "out" / "model") == weights_of(log / "tiny")


@pytest.mark.slow
def test_held_out_frames_are_never_read(log, result, tmp_path):
    damaged = tmp_path / "scene"
    shutil.copytree(log / "scene", damaged)
    for record in (store.MANIFEST, "run.json"):  # else the damage is found
        (damaged / record).unlink()
    scene = read_scene(damaged)
    for frame in scene.frames_in("test"):
        (damaged / frame.image.path).write_bytes(b"not a picture")
    again = Adapt(
        scene=damaged, fused=log / "fuse", fitted=log / "fit", out=tmp_path / "out", settings=settings(log)
    ).run()
    assert weights_of(again) == weights_of(result / "model")


def test_an_interrupted_adaptation_continues_to_the_same_model(log, result, tmp_path, monkeypatch):
    write, made = clips.write_shard, []

    def stop_after_two(folder, number, arrays):
        write(folder, number, arrays)
        made.append(number)
        if len(made) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(adapt, "write_shard", stop_after_two)
    with pytest.raises(KeyboardInterrupt):
        adapted(log, tmp_path / "out")
    monkeypatch.setattr(adapt, "write_shard", write)
    again = adapted(log, tmp_path / "out")
    assert weights_of(again) == weights_of(result / "model")


@pytest.fixture(scope="module")
def short_log(tmp_path_factory):
    """The least that a model can be adapted to: six small frames."""
    city = CityConfig(seed=5, n_frames=6, width=64, height=48, cameras=("front",), lidar_azimuth_step_deg=1.2)
    return drive(tmp_path_factory.mktemp("short"), city, 0, iterations=4, start__gaussians=1000)


COMMANDS = """
import json, os, signal, sys
import test_adapt  # all that the commands need is loaded once: they are copies of this process
from mudg import app
for line in sys.stdin:
    child = os.fork()
    if not child:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a script starts in the background
        os._exit(app.main(json.loads(line)))
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@contextlib.contextmanager
def commands(log):
    """Runs ``mudg adapt`` with one thread into a folder, and sends it a signal after some seconds of work; gives the
    exit status."""
    environment = {**os.environ, "MUDG_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parent)}
    words = ["adapt", log / "scene", "--fused", log / "fuse", "--fitted", log / "fit", "--model", log / "tiny"]
    words += "--shifts-m 1 -1 --no-gaps --block 1 --held-out-every 3 --fit-iterations 4".split()
    words += "--steps 4 --batch-frames 2 --precision float32 --out".split()
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "bufsize": 1}
    with subprocess.Popen([sys.executable, "-c", COMMANDS], env=environment, **pipes) as server:
        orders, answers = server.stdin, server.stdout
        assert orders is not None and answers is not None

        def command(out, processes=1, sent=None, after_s=0.0):
            print(json.dumps([*map(str, words), str(out), "--processes", str(processes)]), file=orders, flush=True)
            child = int(answers.readline())
            if sent is not None:
                while not out.exists():
                    time.sleep(0.01)
                time.sleep(after_s)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(child, sent)
            # behind what the command prints
            return int(next(line for line in answers if line.strip().lstrip("-").isdigit()))

        yield command
        orders.close()


@pytest.mark.slow
def test_an_adaptation_stopped_at_random_moments_is_repeated_to_the_same_files(short_log, tmp_path):
    """Ctrl-C, SIGTERM and SIGKILL, the last with worker processes, which outlive their parent for a moment."""
    rng, stopped = random.Random(33), 0
    with commands(short_log) as command:
        since = time.monotonic()
        assert command(tmp_path / "whole") == 0
        took_s, whole = time.monotonic() - since, contents(tmp_path / "whole")
        assert {"adapt.json", "before.png", "model/model.json", "manifest.json"} <= whole.keys()
        for number, (sent, code) in enumerate([(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)] * 2):
            out, after_s = tmp_path / f"stopped{number}", rng.uniform(0, 0.9) * took_s
            status = command(out, 2 if sent == signal.SIGKILL else 1, sent, after_s)
            place = f"{sent.name} after {after_s:.2f} of {took_s:.2f} s: status {status}"
            assert status in (0, code), place
            stopped += status != 0
            assert command(out) == 0, place
            found = contents(out)
            assert found.keys() == whole.keys(), place
            assert [name for name in found if found[name] != whole[name] and name != "manifest.json"] == [], place
            store.verify_manifest(out)
    assert stopped >= 2  # of six; how many come in time depends on what else the machine does


def test_what_cannot_be_adapted_is_refused(log, tmp_path):
    with pytest.raises(UsageError, match="renders"):
        adapted(log, tmp_path / "a", model="embedded-tiny")
    with pytest.raises(InputError, match="too short|cannot be adapted"):
        adapted(log, tmp_path / "b", block=20)
    assert not (tmp_path / "b").exists()
    other = tmp_path / "other"
    city = CityConfig(seed=6, n_frames=2, width=48, height=32, cameras=("front",), lidar_beams=4)
    Ingest(log=ingest.CITY, out=other, settings=IngestConfig(city=city, contact_sheet=False)).run()
    with pytest.raises(InputError, match="another log"):
        Adapt(scene=other, fused=log / "fuse", fitted=log / "fit", out=tmp_path / "d", settings=settings(log)).run()
    with pytest.raises(InputError, match="camera"):
        adapted(log, tmp_path / "c", cameras=("rear",))
