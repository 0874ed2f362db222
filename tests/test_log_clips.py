"""Training clips of recorded logs: what is truth, what is given, what is held out."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_clips import tiny, write_clips
from toy_scene import ToyStreet

from mudg.base.errors import InputError, UsageError
from mudg.base.types import Source
from mudg.core import losses
from mudg.data.clips import from_log
from mudg.data.clips import shards as clip_shards
from mudg.data.clips.from_city import HELD_OUT
from mudg.data.clips.from_log import LogClipRules, LogSource
from mudg.data.scene import SceneWriter, photographs, read_image, read_label, read_points, read_scene
from mudg.models.mdm.model import MDM
from mudg.stages import fuse, learn
from mudg.stages.adapting import lessons
from mudg.stages.config import AdaptConfig, FuseConfig
from mudg.stages.learning import models as learn_models

RULES = LogClipRules(width=48, height=24, window=3, stride=2, held_out_every=4, farthest=2)
FRAMES = 16


def rewritten(scene, folder, *, black="", labels=("semantics", "depth", "sky")):
    """The scene again, one image black, some labels left out."""
    with SceneWriter(folder, "again", Source("toy", "none")) as writer:
        for camera in scene.cameras.values():
            writer.add_camera(camera)
        for frame in scene.frames:
            image = read_image(scene, frame)
            kept = {name: read_label(scene, frame, name) for name in frame.labels if name in labels}
            writer.add_frame(frame.id, frame.view, image * 0 if frame.id == black else image, kept)
        for sweep in scene.sweeps:
            writer.add_sweep(sweep.id, sweep.sensor, sweep.time_s, sweep.world_from_lidar, read_points(scene, sweep))
        for track in scene.tracks:
            writer.add_track(track)
        writer.set_ego(scene.ego)
        writer.set_split(scene.split)
        writer.finish()


@pytest.fixture(scope="module")
def measured(log, tmp_path_factory):
    """The log without labels of depth: only its sweeps tell."""
    root = tmp_path_factory.mktemp("measured")
    rewritten(read_scene(log[1].scene), root / "scene", labels=("semantics",))
    return log[0], LogSource(root / "scene", log[1].fused)


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    root = tmp_path_factory.mktemp("log")
    street = ToyStreet(car_start=(12.0, 3.0), car_velocity=(2.0, 0.0), times=[0.1 * n for n in range(FRAMES)])
    street.write(root / "scene", width=120, height=60)
    fuse.run(FuseConfig(min_object_points=1), root / "scene", root / "fuse")
    return street, LogSource(root / "scene", root / "fuse")


def test_windows_to_score_share_no_moment_with_those_to_train_on(log):
    scene = read_scene(log[1].scene)
    found = from_log.log_windows(scene, RULES)
    held = {name for w in found if w.held_out for name in w.frames}
    trained = {name for w in found if not w.held_out for name in w.frames}
    assert held and trained and not held & trained
    assert "front/000004" not in held | trained  # the scene holds it out
    assert all(len(w.frames) == 3 for w in found)
    everything = from_log.log_windows(scene, LogClipRules(48, 24, window=3, stride=2, held_out_every=0))
    assert [w.frames[0] for w in everything] == [f"front/{n:06d}" for n in (0, 2, 5, 7, 9, 11, 13)]
    with pytest.raises(InputError, match="too short"):
        from_log.log_windows(scene, LogClipRules(48, 24, window=30))
    with pytest.raises(InputError, match="too short to hold out"):
        from_log.plan_shards([log[1]], LogClipRules(48, 24, window=12, stride=1, held_out_every=2), HELD_OUT)


def test_images_that_an_edit_rendered_in_part_are_no_photographs(log):
    scene = read_scene(log[1].scene)
    one = next(f for f in scene.frames if f.id == "front/000006")
    edited = replace(one, labels={**one.labels, "rendered": next(iter(one.labels.values()))})
    changed = replace(scene, frames=tuple(edited if f is one else f for f in scene.frames))
    assert {f.id for f in scene.frames_in("train")} - {f.id for f in photographs(changed)} == {"front/000006"}
    assert all("front/000006" not in w.frames for w in from_log.log_windows(changed, RULES))
    assert any("front/000006" in w.frames for w in from_log.log_windows(scene, RULES))
    names = lambda of: {f.id for block in lessons.blocks_of(of, AdaptConfig()) for f in block}  # noqa: E731
    assert names(scene) - names(changed) == {"front/000006"}


def test_truth_is_what_was_recorded(measured):
    street, source = measured
    opened = from_log.OpenLog(source, replace(RULES, width=120, height=60))
    window = next(w for w in from_log.log_windows(opened.scene, RULES) if not w.held_out)
    clip = from_log.make_clip(opened, window, 0)
    for number, view in enumerate(clip.condition.views):
        _, ids, depth = street.image(view)  # exact, at the clip's size
        known = clip.depth_valid[number, 0].numpy()
        solid = known & np.isfinite(depth)
        relative = np.abs(clip.depth[number, 0].numpy() - depth)[solid] / depth[solid]
        assert np.median(relative) < 0.02  # a point anywhere in a pixel of the slanted ground
        assert (relative < 0.1).mean() > 0.95
        assert 0.1 < solid.mean() < 1.0
        assert (clip.depth[number, 0].numpy()[known & ~np.isfinite(depth)] >= 100).mean() > 0.9
        assert (clip.semantics[number].numpy() == ids).mean() > 0.97
    arrays = clip_shards.pack_clips([clip], gaps=True)
    unknown = (arrays["flags"] & clip_shards.FLAG_DEPTH_UNKNOWN) > 0
    assert np.array_equal(unknown[0], ~clip.depth_valid[:, 0].numpy())
    assert float(arrays["depth"][0][unknown[0]].max()) <= 100  # filled, not far away


def test_a_view_never_sees_its_own_image(log, tmp_path):
    """Paint over one image: the condition of its own view stays as it was, its truth does not."""
    _, source = log
    scene = read_scene(source.scene)
    rules = replace(RULES, farthest=1)  # neighbours' images are given
    opened = from_log.OpenLog(source, rules)
    window = next(w for w in from_log.log_windows(scene, rules) if not w.held_out)
    painted = window.frames[1]
    rewritten(scene, tmp_path / "scene", black=painted)
    other = from_log.OpenLog(LogSource(tmp_path / "scene", source.fused), rules)
    clip, again = (from_log.make_clip(x, window, 0) for x in (opened, other))
    assert torch.equal(clip.condition.color[1], again.condition.color[1])
    assert torch.equal(clip.condition.backdrop[1], again.condition.backdrop[1])
    assert not torch.equal(clip.condition.color, again.condition.color)  # its neighbours do see it
    assert float(again.rgb[1].max()) == 0.0 and torch.equal(clip.rgb[0], again.rgb[0])
    assert bool(clip.condition.warped[1].any())


def test_unknown_depth_has_no_part_in_the_loss(measured, tmp_path):
    opened = from_log.OpenLog(measured[1], replace(RULES, width=64, height=32))
    window = from_log.log_windows(opened.scene, RULES)[0]
    clip_shards.write_shard(tmp_path, 0, clip_shards.pack_clips([from_log.make_clip(opened, window, 0)], gaps=True))
    model = MDM(learn_models.model_config(tiny(tmp_path, width=64, height=32, window=3)))
    clip = clip_shards.read_clip(tmp_path, 0, 0, range(3))
    assert not bool(clip.depth_valid.all())

    def term(depth, known):
        filled = replace(clip, depth=torch.where(known, clip.depth, depth))
        truth = model.encode_truth([filled]).pixels
        return float(
            losses.depth_code_error(torch.zeros_like(truth.depth_code), truth.depth_code, truth.depth_known, 1.0)
        )

    assert term(torch.tensor(3.0), clip.depth_valid) == term(torch.tensor(90.0), clip.depth_valid)
    assert term(torch.tensor(3.0), ~clip.depth_valid) != term(torch.tensor(90.0), ~clip.depth_valid)
    mirrored = clip_shards.vary(clip, np.random.Generator(np.random.PCG64(1)))
    flipped = not torch.equal(mirrored.depth, clip.depth)
    wanted = clip.depth_valid.flip(-1) if flipped else clip.depth_valid
    assert torch.equal(mirrored.depth_valid, wanted)


def test_a_model_goes_on_learning_on_a_log(log, tmp_path):
    small = write_clips(tmp_path / "clips")
    first = learn.run(tiny(small, steps=1), tmp_path / "first")
    run = tmp_path / "run"
    run.mkdir()
    for name, folder in (("scene", log[1].scene), ("fuse", log[1].fused)):
        (run / name).symlink_to(folder)
    config = tiny(
        "", start=str(first), scenes=(str(run),), steps=2, score_every=1, log_every=1, stride=2, held_out_every=4, window=4,
        width=64, height=32,
    )  # fmt: skip
    made = learn.run(config, tmp_path / "tuned")
    index = json.loads((tmp_path / "tuned" / "clips" / "log_clips.json").read_text())
    assert index["rules"]["width"] == 64 and index["rules"]["height"] == 32  # the camera's aspect of 2
    card = (made / "MODEL_CARD.md").read_text()
    assert "recorded log" in card and "generated cities only" not in card
    scores = json.loads((made.parent / "metrics.json").read_text())
    assert scores["clips"] >= 1 and scores["average"]["psnr"] > 5
    assert (made.parent / "samples" / "0000001.png").is_file() and (made.parent / "loss.png").is_file()
    facts = json.loads((made / "model.json").read_text())["facts"]
    assert facts["recipe"]["data"]["scenes"] == [str(run)]
    with pytest.raises(UsageError, match="other logs or settings"):
        from_log.claim_folder(made.parent / "clips", RULES, [log[1]])
    with pytest.raises(InputError, match="no scene with a fused cloud"):
        learn.run(tiny("", start=str(first), scenes=(str(tmp_path),)), tmp_path / "none")
